# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Fly aircraft towards a fence, in wind and turbulence: five shapes, four winds.

The figures say how many leave the fence, and how far.

    .venv/bin/python -m benchmarks.fence [--only osprey c172p f16 737] [--aircraft 20]
    .venv/bin/python -m benchmarks.fence --generated 60 [--seed 7]

The figures go to docs/evidence/guidance-fence-*.csv, with a row for each shape and wind. The osprey
flies as a fleet, in which every entry of A and B is off by up to 30 % (`aircraft_sim.uncertainty`).
An aircraft of JSBSim flies as it is, once. The turbulence is light (MIL-F-8785C, 1.5 m/s), and the
steady wind is a share of V0. The aircraft starts at the origin and flies to the north, where the
fence is 2 to 3 least radii away. No number is tuned to an aircraft. Exit status 1: an aircraft left
the fence, or was lost.

`--generated N` makes fences round home: triangles, slots, holes near home and polygons smaller than
a turn, until N are accepted. An osprey begins over home and flies a course of the seed; the figures
and the refusals are printed.
"""

import csv
import math
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from itertools import chain, cycle, product
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import yaml
from benchmarks import evidence
from benchmarks.guidance import aircraft_of, turbulence
from benchmarks.tables import parser_of

from flight_analysis.closed_loop.scenario import Scenario
from flight_analysis.closed_loop.scenario_library import find_scenario
from flight_analysis.closed_loop.simulate import simulate
from flight_core.outcome import COMPLETED
from flight_core.parameters import ParameterError
from flight_guidance.fence.zones import Fence, Zone

OSPREY = "osprey"
AIRCRAFT = (OSPREY, "c172p", "f16", "737")
UNCERTAINTY = 0.3  # largest deviation of an entry of A or B, as a share of the entry

HOME = (-1.0, 0.0)  # north and east, least radii


def zones_of(rows: Sequence[Mapping[str, Any]]) -> tuple[Zone, ...]:
    """Return the zones of the file of fences."""
    zones = []
    for row in rows:
        corners = {axis: tuple(row[axis]) for axis in ("north", "east")}
        zones.append(Zone(**{**row, **corners}))
    return tuple(zones)


FENCES = yaml.safe_load(Path(__file__).with_suffix(".yaml").read_text(encoding="utf-8"))
SHAPES = {name: zones_of(zones) for name, zones in FENCES["shapes"].items()}
OUTSIDE = {
    name: Fence(zones_of(fence["zones"]), tuple(fence["home"]))
    for name, fence in FENCES["outside"].items()
}
"""Fences by name, in least radii of the aircraft in the wind. The origin lies outside of those of
OUTSIDE."""

HOME_RADII = 1.5
"""Distance within which an aircraft counts as home, in radii of the orbit round home: the orbit
itself, and half a radius for an aircraft that still joins it."""

WINDS: Mapping[str, tuple[float, float]] = {
    "calm": (0.0, 0.0),
    "0.3 V from behind": (0.3, 0.0),
    "0.3 V across": (0.0, 0.3),
    "0.3 V from ahead": (-0.3, 0.0),
}
"""Velocity of the air to the north and to the east, each as a share of V0."""

DURATION, GENERATED_DURATION = 8.0, 12.0
"""Durations of a flight, as the number of radii that V0 covers. DURATION suffices for 3 radii to
the fence against the wind, a turn, and the way home. GENERATED_DURATION suffices to reach the
corners of most generated fences."""


class Row(NamedTuple):
    """The flights of an aircraft at a fence in a wind."""

    aircraft: str
    fence: str
    wind: str
    flights: int
    outside: int  # flights that left the fence
    farthest: float  # largest distance beyond the fence, m
    lost: int  # flights that did not complete
    home: int  # flights that ended within HOME_RADII of home

    def figures(self) -> Iterator[evidence.Row]:
        """Return the rows of evidence."""
        about = f"{self.fence}, {self.wind}"
        yield evidence.row(f"{about}: flights", self.flights)
        yield evidence.row(f"{about}: flights outside", self.outside, at_most=0)
        yield evidence.row(f"{about}: flights lost", self.lost, at_most=0)
        yield evidence.row(f"{about}: farthest outside", self.farthest, "m")


def of_radius(zones: tuple[Zone, ...], radius: float) -> tuple[Zone, ...]:
    """Return zones in m from zones in radii; `radius` is in m."""

    def scaled(values: tuple[float, ...]) -> tuple[float, ...]:
        return tuple(radius * value for value in values)

    return tuple(
        zone._replace(north=scaled(zone.north), east=scaled(zone.east), radius=radius * zone.radius)
        for zone in zones
    )


def windy(
    scenario: Scenario,
    wind: tuple[float, float],
    home: tuple[float, float],
    radii: float = DURATION,
) -> tuple[Scenario, float]:
    """Return a scenario in wind and turbulence without its route, and the least radius there, m.

    `wind` has the shares of V0 to the north and to the east, and `home` is north and east in radii.
    The flight lasts as long as V0 takes for `radii` radii.
    """
    if scenario.guidance is None:
        raise ValueError(f"{scenario.name} has no guidance")
    speed = scenario.guidance.speed
    north, east = (share * speed for share in wind)
    section = scenario.guidance.model_copy(update={"wind": math.hypot(north, east)})
    radius = float(math.ceil(section.least_radius()))
    varied = scenario.vary(
        flight={"duration": float(math.ceil(radii * radius / speed))},
        aircraft={"wind": [north, east], "turbulence": turbulence(scenario, 1)},
        guidance={
            "wind": section.wind,
            "route": None,
            "home": dict(zip(("north", "east"), at(home, radius), strict=True)),
        },
    )
    return varied, radius


def at(place: tuple[float, float], radius: float) -> tuple[float, float]:
    """Return a place in m from a place in radii; `radius` is in m."""
    return place[0] * radius, place[1] * radius


class Flight(NamedTuple):
    """A flight at a fence."""

    beyond: float  # largest distance beyond the fence, m
    lost: bool  # whether the flight did not complete
    is_home: bool  # whether it ended within HOME_RADII of home


def fly_fleet(shape: str, wind: str, aircraft: int, seed: int) -> Row:
    """Fly uncertain ospreys to the north, each in a flight of its own, and return their row.

    The flights run in parallel on all cores.
    """
    scenario, radius = windy(find_scenario("osprey_route"), WINDS[wind], HOME)
    with ProcessPoolExecutor() as pool:
        underway = []
        for number in range(aircraft):
            uncertainty = {"A": UNCERTAINTY, "B": UNCERTAINTY, "seed": seed, "number": number}
            uncertain = scenario.vary(aircraft={"uncertainty": uncertainty})
            underway.append(pool.submit(fly, (uncertain, radius), SHAPES[shape], 0.0))
        flights = [future.result() for future in underway]
    return row_of(OSPREY, shape, wind, flights)


def fly_alone(name: str, shape: str, wind: str) -> Row:
    """Fly an aircraft of JSBSim to the north, and return its row."""
    prepared = windy(aircraft_of(name), WINDS[wind], HOME)
    return row_of(name, shape, wind, [fly(prepared, SHAPES[shape], 0.0)])


def fly(prepared: tuple[Scenario, float], shape: tuple[Zone, ...], course: float) -> Flight:
    """Fly on a course, rad, inside of zones in radii.

    `prepared` is what `windy` returns. Raises ParameterError for a fence that is refused.
    """
    scenario, radius = prepared
    fence = {}
    for k, zone in enumerate(of_radius(shape, radius)):
        fence[f"zone{k}"] = zone._asdict() | {"radius": zone.radius or None}
    program = {"course": {"start": [0.1], "value": [course]}}
    tape = simulate(
        scenario.vary(
            guidance={"fence": fence, "program": program},
            aircraft={"start": {"heading": course}},
        )
    )
    distance = max(-float(tape["guidance"]["fence.clearance"].min()), 0.0)
    pose = tape["pose"]
    assert scenario.guidance is not None  # noqa: S101 - `windy` has made the section
    home = scenario.guidance.home
    to_home = math.hypot(pose["north"][-1] - home.north, pose["east"][-1] - home.east)
    return Flight(distance, tape.outcome != COMPLETED, to_home <= HOME_RADII * radius)


def polygon(
    rng: np.random.Generator, corners: int, radii: tuple[float, float], centre: float = 0.0
) -> Zone:
    """Return a polygon round a place that lies `centre` radii to the north of the origin.

    Its corners are at random angles round this place, at random distances within `radii`.
    """
    evenly = rng.uniform() + np.arange(corners) / corners
    angles = 2.0 * math.pi * (evenly + rng.uniform(-0.3, 0.3, corners) / corners)
    distances = rng.uniform(*radii, corners)
    north = centre + distances * np.cos(angles)
    return Zone(tuple(north.tolist()), tuple((distances * np.sin(angles)).tolist()))


def generated(kind: str, rng: np.random.Generator) -> tuple[Zone, ...]:
    """Return the zones of a random fence of a kind of GENERATED round the origin, in radii."""
    if kind == "triangle":
        return (polygon(rng, 3, (2.0, 12.0)),)
    if kind == "smaller than a turn":
        return (polygon(rng, int(rng.integers(3, 7)), (0.5, 2.5)),)
    width = rng.uniform(1.5, 3.5)
    length = rng.uniform(3.0, 15.0)
    offset = rng.uniform(-0.3, 0.3) * width
    ring = (length, length, -length, -length)
    slot = Zone(ring, (offset + width, offset - width, offset - width, offset + width))
    if kind == "slot":
        return (slot,)
    field = slot._replace(east=(length, -length, -length, length))
    hole = polygon(rng, int(rng.integers(3, 7)), (0.2, 1.0), rng.uniform(1.5, 4.0))
    return field, hole._replace(exclude=True)


GENERATED = ("triangle", "slot", "hole near home", "smaller than a turn")


def fly_generated(accepted: int, seed: int, show: Callable[[Row], Any]) -> bool:
    """Fly in generated fences until `accepted` of them were not refused.

    Returns whether every flight stayed inside and completed.
    """
    rows_flown = list[Row]()
    refusals = dict.fromkeys(GENERATED, 0)
    for number, kind in enumerate(cycle(GENERATED)):
        rng = np.random.default_rng([seed, number])
        wind = str(rng.choice([*WINDS]))
        course = rng.uniform(-math.pi, math.pi)
        prepared = windy(aircraft_of("osprey_servo"), WINDS[wind], (0.0, 0.0), GENERATED_DURATION)
        try:
            row = row_of(OSPREY, kind, wind, [fly(prepared, generated(kind, rng), course)])
        except ParameterError as refused:
            refusals[kind] += 1
            print(f"fence {number}, {kind}, {wind}: {refused}")
        else:
            rows_flown.append(row)
            show(row)
        sys.stdout.flush()
        if len(rows_flown) == accepted:
            break
    print(f"refused: {refusals}")
    return not any(row.outside or row.lost for row in rows_flown)


def row_of(name: str, shape: str, wind: str, flights: Sequence[Flight]) -> Row:
    """Return the row of some flights."""
    return Row(
        aircraft=name,
        fence=shape,
        wind=wind,
        flights=len(flights),
        outside=sum(flight.beyond > 0.0 for flight in flights),
        farthest=round(max(flight.beyond for flight in flights), 2),
        lost=sum(flight.lost for flight in flights),
        home=sum(flight.is_home for flight in flights),
    )


def main() -> int:
    """Fly, print the rows and store them."""
    parser = parser_of(__doc__)
    parser.add_argument("--only", nargs="*", choices=AIRCRAFT, default=[*AIRCRAFT], help="aircraft")
    parser.add_argument("--aircraft", type=int, default=20, help="ospreys in each row")
    parser.add_argument("--seed", type=int, default=7, help="of the ospreys")
    parser.add_argument(
        "--generated", type=int, metavar="N", help="fly in N generated fences; not stored"
    )
    arguments = parser.parse_args()
    writer = csv.writer(sys.stdout)
    failed = False
    writer.writerow(Row._fields)
    if arguments.generated:
        return int(not fly_generated(arguments.generated, arguments.seed, writer.writerow))
    for name in arguments.only:
        options = f" --aircraft {arguments.aircraft} --seed {arguments.seed}" * (name == OSPREY)
        start = evidence.origin(f"python -m benchmarks.fence --only {name}{options}")
        rows_flown = list[Row]()
        for shape, wind in product(SHAPES, WINDS):
            of_fleet = name == OSPREY
            row = (
                fly_fleet(shape, wind, arguments.aircraft, arguments.seed)
                if of_fleet
                else fly_alone(name, shape, wind)
            )
            rows_flown.append(row)
            writer.writerow(row)
            sys.stdout.flush()
            failed |= bool(row.outside or row.lost)
        evidence.write(
            f"guidance-fence-{name}",
            chain.from_iterable(row.figures() for row in rows_flown),
            start,
        )
    return int(failed)


if __name__ == "__main__":
    raise SystemExit(main())
