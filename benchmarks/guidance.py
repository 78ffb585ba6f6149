# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test the acceptance of guidance: holds, a rectangle and an orbit, with numbers only by rule.

The air is calm, or has turbulence of 1.5 m/s.

    .venv/bin/python -m benchmarks.guidance [--only osprey_servo c172p] [--manoeuvres heading orbit]
    [--seeds 5]
    .venv/bin/python -m benchmarks.guidance --route
        # another route, on aircraft that guidance was not built with

The figures go to docs/evidence/guidance-*.csv, and docs/evidence.md is written from them. Each
flight is simulated in one process. Each row is a figure with its limit; in turbulence it is the
worst of all seeds. The rectangle is flown without wind, and with a wind of a fifth of the airspeed
across its first leg. No number is tuned to an aircraft. The 737 is identified first, which takes
some minutes.
"""

import math
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import ProcessPoolExecutor
from functools import cache, partial
from itertools import groupby
from pathlib import Path
from typing import Any, NamedTuple

from benchmarks import evidence
from benchmarks.evidence import row, split
from benchmarks.manoeuvres import (
    LOW,
    LOW_WIND,
    MANOEUVRES,
    OTHER_ROUTE,
    RANGES,
    SIGMA,
    Air,
    FaultyPose,
    Figure,
    Manoeuvre,
    of_limits,
    of_switch,
)
from benchmarks.tables import new_table, parser_of
from rich.console import Console

from flight_analysis.closed_loop.scenario import Scenario, parse_scenario
from flight_analysis.closed_loop.scenario_library import find_scenario
from flight_analysis.closed_loop.simulate import simulate
from flight_core.outcome import COMPLETED


def prepared(scenario: Scenario) -> Scenario:
    """Return a scenario with guidance by rule in calm air.

    It lacks its own commands and gusts.
    """
    aircraft: dict[str, Any] = {"gusts": {}, "turbulence": None}
    if not scenario.aircraft.is_jsbsim:
        aircraft |= {"kinematics": "euler"}
    live = {"speed": scenario.aircraft.channels().speed}
    reference = {"live": live, "pulses": {}, "sines": {}, "coordinated_turn": None}
    return scenario.vary(aircraft=aircraft, reference_model=reference).vary(guidance={})


@cache
def aircraft_of(name: str) -> Scenario:
    """Return the scenario of an aircraft, with guidance.

    The stall speed is the one that `rise-di identify jsbsim --guidance` writes.
    """
    scenario = prepared(original_of(name))
    if name not in CONDITIONS:
        return scenario
    from flight_design.identification.jsbsim_identification import slowest_trim  # noqa: PLC0415 - for these aircraft alone

    return scenario.vary(
        guidance={"stall_speed": slowest_trim(scenario.aircraft.flight_condition())}
    )


@cache
def original_of(name: str) -> Scenario:
    """Return the scenario of an aircraft, with its own commands and gusts."""
    if name == "osprey_servo":
        # y comes at the rate of the law, so that the flight takes a quarter of the time of 500 Hz
        slower = {"rate": 100.0, "step": 0.005}
        return find_scenario(name).vary(aircraft=slower, reference_model={"rate": 100.0})
    if name in {"c172p", "f16"}:
        return find_scenario(f"jsbsim_{name}")
    from flight_design.identification.jsbsim_identification import identify_jsbsim  # noqa: PLC0415 - for this aircraft alone

    return parse_scenario(
        identify_jsbsim(name, *CONDITIONS[name]).text.encode(), Path(f"jsbsim_{name}.yaml")
    )


AIRCRAFT = ("osprey_servo", "c172p", "737", "f16")
OTHERS = {"c182": (56.6, 1219.0), "A320": (154.0, 6096.0), "F4N": (180.0, 4572.0)}
"""Aircraft of JSBSim on which nothing of guidance was tried while it was built: a light aircraft,
an airliner, a fighter."""

CONDITIONS: Mapping[str, tuple[float, float]] = {"737": (154.0, 6096.0), **OTHERS}
"""Trim speed, m/s, and altitude, m, of the aircraft that are identified."""


def flown(scenario: Scenario, manoeuvre: Manoeuvre, air: Air) -> Iterator[Figure]:
    """Fly a manoeuvre, and yield its figures; a lost flight has one figure that says so."""
    guidance = scenario.guidance
    if guidance is None:
        raise ValueError(f"{scenario.name} has no guidance")
    speed = guidance.speed
    altitude = scenario.aircraft.altitude or 0.0
    section, duration = manoeuvre.plan(guidance.model_copy(update={"wind": air.across * speed}))
    section |= {"wind": air.across * speed, "max_age": manoeuvre.pose.max_age}
    for name in ("altitude", "theta"):
        if name in section.get("program", {}):
            offset = altitude if name == "altitude" else trim_pitch(scenario)
            section["program"][name]["value"] = [
                offset + value for value in section["program"][name]["value"]
            ]
    if "route" in section:
        section["route"]["altitude"] = [altitude + above for above in section["route"]["altitude"]]
    aircraft: dict[str, Any] = {
        "wind": [0.0, air.across * speed],
        "pose": dict(manoeuvre.pose.measured),
    }
    if manoeuvre.figures is of_switch:
        aircraft["sensors"] = {}  # without noise, which moves u too
    if air.seed is not None:
        aircraft["turbulence"] = turbulence(scenario, air.seed)
    varied = scenario.vary(flight={"duration": duration}, aircraft=aircraft, guidance=section)
    controller = scenario.controller
    RANGES.clear()
    if controller.lower and controller.upper:
        RANGES.update(
            {
                name: high - low
                for name, low, high in zip(
                    controller.inputs, controller.lower, controller.upper, strict=True
                )
            }
        )
    tape = simulate(varied, guide=partial(FaultyPose, manoeuvre.pose))
    if tape.outcome != COMPLETED:
        yield Figure(f"lost: {tape.outcome}", math.inf, 0.0)
        return
    calm = air.seed is None
    yield from manoeuvre.figures(tape, guidance, calm)
    yield from of_limits(tape, guidance, calm, manoeuvre.pose)


def turbulence(scenario: Scenario, seed: int) -> dict[str, Any]:
    """Return the section `aircraft.turbulence`, with SIGMA."""
    altitude = scenario.aircraft.altitude or 0.0
    low = (
        {"altitude": LOW, "wind": LOW_WIND}
        if altitude == 0.0
        else {"altitude": altitude, "sigma": SIGMA}
    )
    return low | {"seed": seed}


def trim_pitch(scenario: Scenario) -> float:
    """Return the pitch in trim, rad."""
    return float(simulate(scenario.vary(flight={"duration": 0.1}))["guidance"]["pose.theta"][0])


EXEMPT = {("f16", "heading", "altitude (m)"): 40.0, ("f16", "orbit", "rms (s)"): 0.05}
"""Wider limits, by aircraft, manoeuvre and figure. The f16's own yaw damper feeds r back without a
washout, so that its rudder is at its stop in turns."""


class Row(NamedTuple):
    """The worst value of a figure over the seeds."""

    aircraft: str
    manoeuvre: str
    air: str
    figure: Figure


class Job(NamedTuple):
    """One flight of a manoeuvre."""

    title: str  # of the manoeuvre
    shown: str  # how the row names the air
    air: Air


def jobs(manoeuvres: Mapping[str, Manoeuvre], seeds: int) -> Iterator[Job]:
    """Yield the flights of one aircraft, so that those of one row come one after another."""
    for title, manoeuvre in manoeuvres.items():
        for across in manoeuvre.winds:
            wind = f", wind {across:g} V" if across else ""
            yield Job(title, f"calm{wind}", Air("calm", None, across))
            for seed in range(seeds if manoeuvre.turbulent else 0):
                yield Job(
                    title, f"turbulence{wind}, {seeds} seeds", Air("turbulence", seed + 1, across)
                )


def fly(scenario: Scenario, job: Job) -> list[Figure]:
    """Return the figures of one flight."""
    return list(flown(scenario, {**MANOEUVRES, **OTHER_ROUTE}[job.title], job.air))


def rows(
    name: str,
    manoeuvres: Mapping[str, Manoeuvre],
    seeds: int,
    over: Callable[..., Iterable[list[Figure]]] = map,
) -> Iterator[Row]:
    """Fly the manoeuvres of an aircraft, and yield all its rows.

    `over` maps a function over the flights: it is `map`, or the `map` of a pool of processes.
    """
    several = list(jobs(manoeuvres, seeds))
    flights = zip(several, over(partial(fly, aircraft_of(name)), several), strict=True)
    for (title, shown), those in groupby(flights, key=lambda flight: flight[0][:2]):
        worst: dict[str, Figure] = {}
        for figure in (figure for _, figures in those for figure in figures):
            limit = max(figure.limit, EXEMPT.get((name, title, figure.name), figure.limit))
            worst[figure.name] = max(
                figure._replace(limit=limit),
                worst.get(figure.name, figure),
                key=lambda same: same.value,
            )
        yield from (Row(name, title, shown, figure) for figure in worst.values())


def main() -> None:
    """Fly, store the results and write the page.

    Exit status 1 if a limit is not met or a point is lost.
    """
    parser = parser_of(__doc__)
    parser.add_argument("--only", nargs="*", choices=AIRCRAFT, default=AIRCRAFT, help="aircraft")
    parser.add_argument(
        "--manoeuvres",
        nargs="*",
        choices=[*MANOEUVRES],
        default=[*MANOEUVRES],
        help="manoeuvres; not stored",
    )
    parser.add_argument("--seeds", type=int, default=5, help="of the turbulence")
    parser.add_argument(
        "--route", action="store_true", help=f"another route, on {', '.join(OTHERS)}, instead"
    )
    options = parser.parse_args()
    if options.route:
        start = origin(f"--route --seeds {options.seeds}")
        rows_flown = [
            row for name in OTHERS for row in fly_manoeuvres(name, OTHER_ROUTE, options.seeds)
        ]
        store("route", (figure_row(row.aircraft, row) for row in rows_flown), start)
        sys.exit(any(row.figure.missed for row in rows_flown))
    failed = 0
    for name in options.only:
        start = origin(f"--only {name} --seeds {options.seeds}")
        rows_flown = fly_manoeuvres(
            name, {title: MANOEUVRES[title] for title in options.manoeuvres}, options.seeds
        )
        if len(options.manoeuvres) == len(MANOEUVRES):
            store(name, (figure_row(row.manoeuvre, row) for row in rows_flown), start)
        failed += any(row.figure.missed for row in rows_flown)
    sys.exit(failed > 0)


def origin(options: str) -> evidence.Origin:
    """Return the origin of the figures of this program, which starts now with these options."""
    return evidence.origin(f"python -m benchmarks.guidance {options}")


def store(name: str, figures: Iterable[evidence.Row], begun: evidence.Origin) -> None:
    """Write the rows of evidence of a measurement, and the page."""
    evidence.write(f"guidance-{name}", figures, begun)


def figure_row(about: str, flown: Row) -> evidence.Row:
    """Return the row of evidence of a figure; a limit that is infinite is left out."""
    name, unit = split(flown.figure.name)
    limit = None if flown.figure.limit == math.inf else flown.figure.limit
    return row(f"{about}, {flown.air}: {name}", float(flown.figure.value), unit, at_most=limit)


def fly_manoeuvres(name: str, manoeuvres: Mapping[str, Manoeuvre], seeds: int) -> list[Row]:
    """Fly the manoeuvres of an aircraft and print the table."""
    table = new_table(
        f"Guidance by rule, {name}", ("manoeuvre", "air", "figure", "worst", "limit", ""), texts=3
    )
    kept_rows = []
    with ProcessPoolExecutor() as pool:
        for row in rows(name, manoeuvres, seeds, pool.map):
            figure = row.figure
            verdict = "missed" if figure.missed else ""
            cells = (
                row.manoeuvre,
                row.air,
                figure.name,
                f"{figure.value:.3g}",
                f"{figure.limit:.3g}",
                verdict,
            )
            print(name, *cells, sep="\t", file=sys.stderr, flush=True)
            table.add_row(*cells)
            kept_rows.append(row)
    Console().print(table)
    return kept_rows


if __name__ == "__main__":
    main()
