# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Experiment on the signs of ArduPlane's inputs.

The figures say whether `rise-di check` finds each sign, and whether it finds each sign that is
flipped on purpose.
"""

import time
from bisect import bisect
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from benchmarks.autopilot_flights import arduplane, stored

from autopilot_bridge.params import ChannelMap, load_map
from control_laws.excitation import ExcitationConfig
from flight_core.rates import seconds
from flight_core.tape import Signal, Tape
from flight_design.identification.bridge_identification import channel_pairs, experiment
from flight_design.identification.response_identification import MIN_RATIO, identify_response
from flight_design.identification.sign_check import check_signs
from flight_log.engagements import Engagement
from flight_log.tape_reader import read_run

PERIODS = {"elevator": 12.0, "thrust": 4.0, "aileron": 1.5, "rudder": 1.5}
"""Period of the multisine of each input, s. With 4 s for the elevator, 2 of 12 experiments were
unsure of its sign at SIM_WIND_TURB 0.5."""
# factor on the elevator's amplitude: at SIM_WIND_TURB 1 `rise-di check` asked for a factor 1.7
STRONGER_ELEVATOR = 2.0
# SIM_WIND_TURB of the experiments, in turn; a value of 2 would move q by 0.4 rad/s
TURBULENCE = (0.25, 0.5, 0.25, 0.5, 1.0)
EXCITED = 35.0  # shortest engagement that is judged, s
EXPERIMENT = 80.0  # longest time of an experiment, s: 39 s engaged, and back to level flight
MODERATE = 0.5  # SIM_WIND_TURB up to which a single experiment has to show every sign


def signs(experiments: int = 25) -> dict[str, Any]:
    """Fly short open-loop experiments, and collect what `rise-di check` says of each.

    The experiments take the values of TURBULENCE in turn. The results of earlier runs are kept. The
    simulator draws its turbulence from one stream of random numbers without a seed, so no two
    experiments meet the same turbulence.
    """
    with arduplane(0.03) as plane:
        channel_map = plane.patient_map("ardupilot")
        loaded = load_map(channel_map)
        airframe = plane.folder / "signs_airframe.yaml"
        scenario = plane.folder / "signs.yaml"
        plan = experiment(loaded, 24.0, 0.2, str(airframe))
        airframe.write_text(plan.airframe)
        content = yaml.safe_load(plan.scenario)
        controller = content["/**/controller"]["ros__parameters"]
        controller["pause"] = 1.0
        controller["period"] = [PERIODS[name] for name in controller["inputs"]]
        place = controller["inputs"].index("elevator")
        controller["amplitude"][place] *= STRONGER_ELEVATOR
        scenario.write_text(yaml.safe_dump(content))
        duration = ExcitationConfig.validate_mapping(controller, "controller").duration
        plane.say("param", "SIM_WIND_SPD", "5")
        run = plane.fly(scenario, channel_map, EXPERIMENT * experiments, "--send")
        run.wait_for("DISENGAGED")
        starts = []
        earlier = len(stored("signs").get("experiments", []))
        winds = [
            TURBULENCE[number % len(TURBULENCE)] for number in range(earlier, earlier + experiments)
        ]
        for wind in winds:
            plane.say("param", "SIM_WIND_TURB", f"{wind:g}")
            starts.append(time.time_ns())
            plane.level()
            plane.hand_over()
            while plane.engage().end() != 0:  # outside of the envelope, by a gust
                plane.level()
                plane.hand_over()
            time.sleep(duration)
            plane.engage("--off").succeed()
        plane.say("param", "SIM_WIND_TURB", "0")
        plane.level()
        run.interrupt()
        run.end(60.0)
    return signs_of_logs(
        [plane.run], lambda _, engaged: winds[bisect(starts, engaged.start_ns) - 1]
    )


def signs_of_logs(
    runs: Sequence[Path], wind_of: Callable[[int, Engagement], float]
) -> dict[str, Any]:
    """Return the stored experiments on signs, and those of the given runs.

    `wind_of` returns the turbulence of an engagement from its number in the run. An engagement
    shorter than EXCITED was ended by the bridge or with the flight, so it is counted but not
    judged. The engagements of a run in turbulence above MODERATE are also judged together, as
    `rise-di check` judges a log with several engagements.
    """
    earlier = stored("signs")
    channel_map = load_map("ardupilot")
    found, ended, together = (earlier.get(key, []) for key in ("experiments", "ended", "together"))
    for run in runs:
        log = read_run(run)
        strong = dict[float, list[Engagement]]()
        end_ns = int(log.tape["y"].stamp_ns[-1])
        for number, engagement in enumerate(log.engagements or []):
            turbulence = wind_of(number, engagement)
            about = {"run": run.name, "turbulence": turbulence, "reason": engagement.reason}
            if seconds((engagement.stop_ns or end_ns) - engagement.start_ns) < EXCITED:
                ended.append(about)
                continue
            found.append(about | judged(channel_map, log.tape, [engagement]))
            if turbulence > MODERATE:
                strong.setdefault(turbulence, []).append(engagement)
        for turbulence, some in strong.items():
            alike = {"run": run.name, "turbulence": turbulence, "count": len(some)}
            together.append(alike | judged(channel_map, log.tape, some))
    return {"experiments": found, "ended": ended, "together": together}


def judged(
    channel_map: ChannelMap, tape: Tape, engagements: Sequence[Engagement]
) -> dict[str, Any]:
    """Return what `rise-di check` says of every sign as flown, and with each sign flipped alone.

    To flip the sign of an input, its column of the recorded u is multiplied by -1.
    """
    pairing, expected = channel_pairs(channel_map)
    columns = [list(channel_map.inputs).index(name) for name in pairing.inputs]
    rows = [list(channel_map.outputs).index(name) for name in pairing.outputs]
    Omega = np.zeros((len(rows), len(columns)))
    Omega[rows, columns] = expected
    u = tape["u"]
    end_ns = int(tape["y"].stamp_ns[-1])
    spans = [(engaged.start_ns, engaged.stop_ns or end_ns) for engaged in engagements]

    def verdicts(flipped: str) -> dict[str, str]:
        flipped_u = Signal(
            u.stamp_ns, u.names, u.values * [-1.0 if name == flipped else 1.0 for name in u.names]
        )
        response = identify_response(
            tape["y"], flipped_u, pairing.outputs, pairing.inputs, engaged=spans
        )
        D = tuple(int(sign) for sign in expected)
        check = check_signs(channel_map, Omega, pairing.outputs, pairing.inputs, D, response)
        fraction = (
            (channel.input, channel.ratio or 0.0, (channel.measured or 0.0) * channel.effect)
            for channel in check.channels
        )
        return {
            name: "unsure" if ratio < MIN_RATIO else "right" if agrees > 0.0 else "wrong"
            for name, ratio, agrees in fraction
        }

    return {
        "seconds": sum(seconds(stop - start) for start, stop in spans),
        "as flown": verdicts(""),
        "flipped": {name: verdicts(name) for name in pairing.inputs},
    }


def shows_all(experiment: dict[str, Any]) -> bool:
    """Return whether `rise-di check` finds every sign as flown, and calls it right."""
    return set(experiment["as flown"].values()) == {"right"}


def finds_each(experiment: dict[str, Any]) -> bool:
    """Return whether `rise-di check` calls each flipped sign wrong."""
    return all(verdicts[name] == "wrong" for name, verdicts in experiment["flipped"].items())


def counted(result: dict[str, Any]) -> dict[str, Any]:
    """Return how many experiments have each result."""
    experiments = result["experiments"]
    moderate = [each for each in experiments if each["turbulence"] <= MODERATE]
    return {
        "experiments": len(experiments),
        "experiments that ended early": len(result["ended"]),
        "experiments that show every sign, right": sum(map(shows_all, experiments)),
        "experiments that find each flipped sign": sum(map(finds_each, experiments)),
        "experiments that call a right sign wrong": sum(
            "wrong" in each["as flown"].values() for each in experiments
        ),
        "moderate experiments that miss a sign": sum(
            not (shows_all(each) and finds_each(each)) for each in moderate
        ),
    }
