# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Fly real autopilots in software and write docs/evidence/autopilots-*.csv.

The figures are of gains, engagements, signs, pose and releases.

    python -m benchmarks.autopilots --sitl KIT                       # everything, about 80 minutes
    python -m benchmarks.autopilots --sitl KIT --only signs
        # one measurement; the others keep their figures

KIT is the folder of the kit of `make test-sitl` (docs/autopilots.md). build/autopilots/ has the
results and the runs.

The age limits of y and u are 1 s, because a busy host stops the autopilot for half a second. The
identified gains fly the scenario that `identify` writes: pulses of 50 mrad/s in q and 150 mrad/s in
p in coordinated turns, and a step of at most 2 m/s in V. The errors of PX4's airplane are those of
y, which the map filters with a low-pass; its true errors use the rates of the simulator.

The time of a release begins with the release in the bridge's log. The time of another event, such
as a killed bridge, begins with the event. RC_CHANNELS in the autopilot's log, each 0.1 s, shows
when the sticks act again, and nav_state shows when PX4's own law flies again.
"""

import json
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any
from xml.etree import ElementTree

import numpy as np
from benchmarks import evidence
from benchmarks.autopilot_flights import (
    EXAMPLE,
    FOLDER,
    REPOSITORY,
    arduplane,
    flying,
    on_the_ground,
    px4,
    tracking,
)
from benchmarks.autopilot_probe import probe
from benchmarks.autopilot_signs import TURBULENCE, counted, signs, signs_of_logs
from benchmarks.tables import parser_of

from autopilot_bridge.params import load_map
from flight_analysis.closed_loop.scenario import load_scenario, scenario_yaml
from flight_analysis.metrics.by_part import errors_by_part
from flight_analysis.metrics.time_spans import is_in_spans
from flight_analysis.report.disturbances import transients
from flight_analysis.report.guided import control_errors
from flight_core.rates import NANOSECONDS
from flight_core.tape import Signal
from flight_core.units import unit_sizes
from flight_design.gains.observer_selection import with_extended_state_observer
from flight_design.identification.jsbsim_identification import NOISE_SHARE
from flight_log.tape_reader import read_run

if TYPE_CHECKING:
    from tests.sitl.kit import Autopilot

PX4_MAP = REPOSITORY / "examples" / "px4_airplane" / "map.yaml"
ENGAGEMENTS = 20
WINDOW = (-0.3, 1.0)  # begin and end of the time in which steps count, s from an engagement
# s: time engaged under guidance, from one turn to the next, and from a turn's command until the
# errors count
GUIDED, EACH, SETTLED = (300.0, 60.0, 45.0)
# delay margin beyond the identified delay, s; SIM_WIND_TURB; flights with and without the observer
OBSERVER_MARGIN, OBSERVED_TURBULENCE, OBSERVED_PAIRS = (0.025, 0.5, 2)
# the faster cruise: equivalent airspeed, m/s, 15 % above the kit's AIRSPEED_CRUISE of 22, and the
# range of the throttle in which its level flight engages, %
FASTER = 25.3
FASTER_THROTTLE = (30.0, 85.0)
TRUE = 1.049  # ratio of true to equivalent airspeed at the kit's place
WINDS = {"calm": (0.0, 0.0), "SIM_WIND_SPD 8, SIM_WIND_TURB 0.5": (8.0, 0.5)}
HELD = {"heading": "rad", "altitude": "m", "V": "m/s"}
END = "the end of the flight"


# Measurements


def gains_of_arduplane(log: Path | None = None) -> dict[str, Any]:
    """Measure ArduPlane with fast servos, with gains of its own identification."""
    return identified(lambda: arduplane(0.03), FOLDER / "arduplane", "ardupilot", 24.0, log)


def gains_of_slow_servos(log: Path | None = None) -> dict[str, Any]:
    """Measure ArduPlane with its default servos, with gains of its own identification."""
    place = FOLDER / "slow_servos"
    return identified(lambda: arduplane(0.14, place), place, "ardupilot", 24.0, log)


def gains_of_px4(log: Path | None = None) -> dict[str, Any]:
    """Measure PX4's airplane, with gains of its own identification."""
    flights: list[tuple[Any, Callable[[], Signal]]] = []

    @contextmanager
    def watched() -> Iterator[Any]:
        with px4() as airplane, airplane.watching_truth() as truth:
            flights.append((airplane, truth))
            yield airplane

    result = identified(watched, FOLDER / "px4", str(PX4_MAP), 11.5, log)
    if "refused" in result:
        return result
    airplane, truth = flights[-1]
    return result | {"true_rms": true_errors(airplane, truth())}


def true_errors(autopilot: "Autopilot", truth: Signal) -> dict[str, float]:
    """Return the rms of the simulator's own rates less y_m while commanded, rad/s."""
    log = read_run(autopilot.run)
    (one,) = log.engagements or []
    tape = replace(
        log.tape,
        signals={"y": truth.within([(one.start_ns, one.stop_ns or 2**62)]), "y_m": log.tape["y_m"]},
    )
    events = transients(load_scenario(autopilot.run / "scenario.yaml"), log.tape)
    return {name: parts["command"].rms for name, parts in errors_by_part(tape, events).items()}


def identified(
    flying: Callable[[], AbstractContextManager["Autopilot"]],
    place: Path,
    map_name: str,
    speed: float,
    log: Path | None,
) -> dict[str, Any]:
    """Fly an experiment, identify gains from its log, fly them, and replay the flight.

    The commands are those of docs/autopilots.md. `log` is the run of an earlier experiment of this
    command; without it, a new experiment is flown. The gains are identified after the autopilot has
    stopped.
    """
    results = place / "found"
    channel_map = place / f"{Path(map_name).stem}.yaml"
    command = (
        "identify",
        "bridge",
        str(channel_map),
        "--speed",
        f"{speed:g}",
        "--write",
        str(results),
    )
    if log is None:
        with flying() as autopilot:
            autopilot.patient_map(map_name)
            autopilot.experiment(*command)
    run = (log or REPOSITORY / "runs" / "latest").resolve()
    gain_result = on_the_ground(*command, "--run", str(run), "--json")
    if gain_result.returncode:
        return {"refused": gain_result.stderr}
    result = json.loads(gain_result.stdout)
    with (
        flying() as autopilot,
        autopilot.engaged(results / "scenario.yaml", str(results / "map.yaml"), 75.0) as flight,
    ):
        flight.end(150.0)
    others = {
        key: result["controller"][key]
        for key in ("outputs", "k_g", "k_d", "Lambda", "delay", "lag")
    }
    return {
        "controller": others,
        "channels": result["channels"],
        "delay_margin": result["delay_margin"],
        **tracking(autopilot),
    }


def own_log() -> dict[str, Any]:
    """Measure ArduPlane at a cruise 15 % faster, over DDS and over MAVLink, calm and in wind.

    Both ways have an experiment of their own, whose gains fly. The errors are measured in the log
    of the stack and in the autopilot's own log. The autopilot's DataFlash log of the experiment is
    imported, and Omega is identified from it too.
    """
    from tests.sitl.kit import OVERRIDE_TIME, ArduPlane  # noqa: PLC0415 - after the kit's place is known

    results: dict[str, Any] = {}
    for name in ("ardupilot", "ardupilot_mavlink"):
        plane = ArduPlane(FOLDER / f"own_log_{name}")
        plane.throttle = FASTER_THROTTLE
        with flying(
            plane, SIM_SERVO_SPEED=0.03, AIRSPEED_CRUISE=FASTER, RC_OVERRIDE_TIME=OVERRIDE_TIME
        ):
            # limit of the thrust, whose trim is 0.63 to 0.75 at this cruise
            narrower = ("    upper: 0.3\n", "    upper: 0.2\n")
            channel_map = (
                plane.patient_map(name, narrower)
                if name == "ardupilot"
                else plane.mavlink_map(narrower)
            )
            folder = plane.folder / "found"
            command = ("identify", "bridge", channel_map, "--speed", f"{FASTER * TRUE:g}")
            plane.experiment(*command, "--write", str(folder)).succeed(300.0)
            run = (REPOSITORY / "runs" / "latest").resolve()
            log = plane.folder / "experiment.BIN"
            shutil.copy(plane.dataflash(), log)
            results[name] = {"experiment": run.name, "flights": {}}
            for wind, (speed, turbulence) in WINDS.items():
                plane.say("param", "SIM_WIND_SPD", f"{speed:g}")
                plane.say("param", "SIM_WIND_TURB", f"{turbulence:g}")
                with plane.engaged(
                    folder / "scenario.yaml", str(folder / "map.yaml"), 90.0
                ) as flight:
                    flight.end(150.0)
                errors = plane.own_errors(TRUE if name == "ardupilot" else 1.0)
                results[name]["flights"][wind] = tracking(plane) | {
                    "own": {channel: rms for channel, (rms, _) in errors.items()}
                }
        results[name] |= imported_beside(command, log, run, plane.folder)
    return results


def imported_beside(command: Sequence[str], log: Path, run: Path, place: Path) -> dict[str, Any]:
    """Identify Omega from the autopilot's own log of an experiment and from the log of the stack.

    Returns both by input, and their relative difference.
    """
    bag = place / "imported"
    shutil.rmtree(bag, ignore_errors=True)
    imported = on_the_ground("import", str(log), "--map", command[2], "--output", str(bag))
    if imported.returncode:
        return {"refused": imported.stderr}
    omega: dict[str, dict[str, float]] = {}
    for name, source in (("stack", run), ("imported", bag)):
        identification = on_the_ground(
            *command,
            "--run",
            str(source),
            "--write",
            str(place / f"of_{name}"),
            "--accept",
            "--json",
        )
        if identification.returncode:
            return {"refused": f"{name}: {identification.stderr}"}
        result = json.loads(identification.stdout)
        Omega = np.array(result["channels"]["Omega"])
        omega[name] = dict(
            zip(
                result["inputs"],
                (np.diag(Omega) if Omega.ndim > 1 else Omega).tolist(),
                strict=True,
            )
        )
    ratios = {
        name: abs(value / omega["stack"][name] - 1.0) for name, value in omega["imported"].items()
    }
    return {"Omega": omega, "difference": ratios}


def guided() -> dict[str, Any]:
    """Fly ArduPlane under guidance for GUIDED s: turns, climbs and changes of V.

    All numbers of guidance are by rule. The gains are those of the last identification.
    """
    from tests.sitl.kit import ALTITUDE, guided_scenario  # noqa: PLC0415 - after the kit's place is known

    starts = np.arange(15.0, GUIDED, EACH).tolist()
    with arduplane(0.03) as plane:
        results = plane.folder / "found"
        scenario = plane.folder / "guided.yaml"
        program = plane.turns(starts, ALTITUDE + 20.0, 24.0)
        scenario.write_text(guided_scenario(results / "scenario.yaml", program, 24.0))
        with plane.engaged(scenario, str(results / "map.yaml"), GUIDED) as flight:
            flight.end(GUIDED + 100.0)
    return held_figures(plane.run, starts)


def held_figures(run: Path, starts: Sequence[float]) -> dict[str, Any]:
    """Return rms and maximum of the errors of heading, altitude and V in a guided flight.

    `starts` are the times at which its turns are commanded, s. The errors count from SETTLED s
    after each of them until the next turn. Also returns whether the flight replays.
    """
    (one,) = json.loads((run / "summary.json").read_text())["engagements"]
    tape = read_run(run).tape
    t = tape.time("guidance")
    errors = control_errors(tape)
    stop = one["stop"] or GUIDED
    is_held = is_in_spans(
        t,
        [(start + SETTLED, min(start + EACH, stop)) for start in starts if start + SETTLED < stop],
    )
    return {
        "seconds": stop - one["start"],
        "reason": one["reason"],
        "turns": len(starts),
        "rms": {name: float(np.sqrt(np.mean(errors[name][is_held] ** 2))) for name in HELD},
        "max": {name: float(np.max(np.abs(errors[name][is_held]))) for name in HELD},
        "replayed": on_the_ground("replay", str(run)).returncode == 0,
    }


def observed() -> dict[str, Any]:
    """Fly the last identified gains with and without an extended-state observer, in turbulence.

    The observer has the identified Omega and lags.
    """
    folder = FOLDER / "arduplane" / "found"
    results = []
    plain = load_scenario(folder / "scenario.yaml")
    controller = plain.rise_di()
    model = controller.feedforward
    if model is None:
        sys.exit(f"error: {folder}: found no feedforward, expected a scenario of identify bridge")
    rows = [model.states.index(name) for name in controller.outputs]
    Omega = np.reshape(model.B, (len(model.states), -1))[rows]
    size = unit_sizes("m/s" if name == "V" else "rad/s" for name in controller.outputs)
    observer = with_extended_state_observer(
        controller, Omega, size / NOISE_SHARE, size, controller.delay + OBSERVER_MARGIN
    )
    scenarios = {"without": plain, "with": replace(plain, controller=observer.controller)}
    with arduplane(0.03) as plane:
        plane.say("param", "SIM_WIND_SPD", "5")
        plane.say("param", "SIM_WIND_TURB", f"{OBSERVED_TURBULENCE:g}")
        for name in [*scenarios] * OBSERVED_PAIRS:
            scenario = plane.folder / f"{name}_observer.yaml"
            scenario.write_text(scenario_yaml(scenarios[name]))
            with plane.engaged(scenario, str(folder / "map.yaml"), 75.0) as flight:
                flight.end(150.0)
            results.append({"observer": name, **tracking(plane)})
    return {
        "flights": results,
        "relaxation": dict(zip(controller.outputs, observer.relaxation.tolist(), strict=True)),
    }


def bumpless() -> dict[str, Any]:
    """Engage and release ENGAGEMENTS times in one flight.

    The figures are the largest step of a setpoint around each engagement, as a part of its range.
    """
    with arduplane(0.03) as plane:
        channel_map = plane.patient_map("ardupilot")
        run = plane.fly(EXAMPLE, channel_map, 1000.0, "--send")
        run.wait_for("DISENGAGED")
        for _ in range(ENGAGEMENTS):
            plane.level()
            plane.hand_over()
            plane.engage().succeed()
            time.sleep(WINDOW[1] + 0.5)
            plane.engage("--off").succeed()
        plane.level()
        run.interrupt()
        run.end(60.0)
        log = read_run(plane.run)
        inputs = load_map(channel_map).inputs.values()
        ranges = {f"{row.message}.{row.field}": row.range[1] - row.range[0] for row in inputs}
        return {
            "steps": [
                step(log.tape["bridge/would_send"], ranges, engaged.start_ns)
                for engaged in log.engagements or []
            ]
        }


def step(sent: Signal, ranges: dict[str, float], engaged_ns: int) -> float:
    """Return the largest step of a setpoint around an engagement, as a part of its range.

    Before the engagement the setpoint is that of the stick.
    """
    begin, end = (engaged_ns + int(edge * NANOSECONDS) for edge in WINDOW)
    around = sent.within([(begin, end)])
    return max(float(np.max(np.abs(np.diff(around[name])))) / size for name, size in ranges.items())


def pose() -> dict[str, Any]:
    """Compare the rates and the pose that the map `ardupilot` gives with the autopilot's log.

    ArduPlane flies turns and climbs meanwhile.
    """
    with arduplane(0.03) as plane:
        run = plane.fly(EXAMPLE, plane.patient_map("ardupilot"), 60.0)
        run.wait_for("DISENGAGED")
        plane.wander(run)
        fits = {name: fit._asdict() for name, fit in plane.compare().items()}
    return fits | {
        "slopes of the rates, largest difference from 1": max(
            abs(fits[name]["slope"] - 1.0) for name in "pqr"
        )
    }


def releases() -> dict[str, Any]:
    """Run `make test-sitl`.

    Returns what failed, and the times until the pilot or PX4's own law flies again, s.
    """
    report = FOLDER / "releases.xml"
    python = sys.executable
    command = [python, "-m", "pytest", "tests/sitl", "-m", "not long", f"--junitxml={report}"]
    subprocess.run(command, cwd=REPOSITORY, check=False)  # noqa: S603 - our own arguments; a failure is in the report
    suite = next(ElementTree.parse(report).getroot().iter("testsuite"))  # noqa: S314 - written by pytest just now
    goals = evidence.goals_of("autopilots-releases")
    # a time that is missing misses its goal
    times: dict[str, float | None] = {
        name.removeprefix("times: "): None for name in goals if name.startswith("times: ")
    }
    times |= {
        timed.attrib["name"]: float(timed.attrib["value"]) for timed in suite.iter("property")
    }
    counts = {name: int(suite.attrib[name]) for name in ("tests", "failures", "errors", "skipped")}
    return counts | {
        "failed": [case.attrib["name"] for case in suite.iter("testcase") if len(case)],
        "times": times,
    }


IDENTIFICATIONS: dict[str, Callable[..., dict[str, Any]]] = {
    "arduplane": gains_of_arduplane,
    "slow_servos": gains_of_slow_servos,
    "px4": gains_of_px4,
}
MEASUREMENTS: dict[str, Callable[..., dict[str, Any]]] = {
    **IDENTIFICATIONS,
    "guided": guided,
    "observer": observed,
    "engagements": bumpless,
    "signs": signs,
    "pose": pose,
    "probe": probe,
    "own_log": own_log,
    "releases": releases,
}


def main() -> None:
    """Measure, and write the rows and the page of evidence."""
    parser = parser_of(__doc__)
    parser.add_argument("--sitl", type=Path, help="folder of the kit")
    parser.add_argument("--only", action="append", choices=MEASUREMENTS, help="repeatable")
    parser.add_argument(
        "--experiments", type=int, default=25, help="number of further ones on signs, a minute each"
    )
    parser.add_argument(
        "--log",
        type=Path,
        action="append",
        help="with --only: a flown experiment in place of a new one",
    )
    arguments = parser.parse_args()
    FOLDER.mkdir(parents=True, exist_ok=True)
    if arguments.sitl is not None:
        os.environ["RISE_DI_SITL"] = str(arguments.sitl.resolve())
    # the autopilots are in domain 0, in networks of their own
    os.environ.pop("ROS_DOMAIN_ID", None)
    from tests.sitl.kit import missing  # noqa: PLC0415 - after the kit's place is known

    if reason := missing():
        sys.exit(f"error: {reason}")
    for name in arguments.only or MEASUREMENTS:
        start = evidence.origin(f"python -m benchmarks.autopilots --only {name}")
        if name == "signs":
            result = (
                signs_of_logs(arguments.log, lambda number, _: TURBULENCE[number % len(TURBULENCE)])
                if arguments.log
                else signs(arguments.experiments)
            )
        elif arguments.log:
            result = IDENTIFICATIONS[name](arguments.log[0])
        else:
            result = MEASUREMENTS[name]()
        (FOLDER / f"{name}.json").write_text(json.dumps({"result": result}, indent=1))
        print(name, json.dumps(result), flush=True)
        figures = counted(result) if name == "signs" else result
        evidence.write(
            f"autopilots-{name}",
            evidence.rows(figures, evidence.goals_of(f"autopilots-{name}")),
            start,
        )


if __name__ == "__main__":
    main()
