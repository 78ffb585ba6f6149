# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Aircraft that fly out of a fence, in wind and turbulence: five shapes, four winds; how many leave
the fence, and how far.

    .venv/bin/python -m benchmarks.fence [--only osprey c172p f16 737] [--shapes square ell]
    [--aircraft 2000] .venv/bin/python -m benchmarks.fence --from-outside [--aircraft 1]

The figures go to docs/evidence/guidance-fence-*.csv, where all fences and winds are flown. A row a
shape and a wind. Of the osprey a fleet flies: every entry of A and B is off by up to 30 %
(`aircraft_sim.uncertainty`). An aircraft of JSBSim flies as it is, once. The turbulence is light
(MIL-F-8785C, 1.5 m/s), the steady wind a share of V0. The aircraft starts at the origin to the
north, 2 to 3 least radii before the fence. No number belongs to an aircraft. Exit status 1: an
aircraft left the fence, or was lost.

`--from-outside` starts ospreys outside of five fences, in a wind of 0.4 V from four sides; the
figures are printed. A flight is home that is within HOME_RADII of home at the end. Exit status 1:
an aircraft did not come home.
"""

import csv
import math
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import chain, product
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import yaml
from benchmarks import evidence
from benchmarks.guidance import aircraft_of, turbulence
from benchmarks.tables import parser_of

from aircraft_sim.airframe import load_airframe
from aircraft_sim.uncertainty import gust_directions, sampled_matrices
from flight_analysis.closed_loop.scenario import Scenario
from flight_analysis.closed_loop.scenario_library import find_scenario
from flight_analysis.closed_loop.simulate import simulate
from flight_campaign import batch, batch_matrices, missions
from flight_campaign.benchmark_course import build_course
from flight_core.outcome import COMPLETED
from flight_guidance.params import GuidanceConfig
from flight_guidance.zones import Fence, Zone

OSPREY = "osprey"
AIRCRAFT = (OSPREY, "c172p", "f16", "737")
CHUNK, UNCERTAINTY = 250, 0.3
"""Aircraft in one flight; share of the entries of A and B."""

HOME = (-1.0, 0.0)  # radii


def zones_of(rows: Sequence[Mapping[str, Any]]) -> tuple[Zone, ...]:
    """Zones of the file of fences."""
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
"""Fences by name, those of OUTSIDE with the origin outside, in least radii of the aircraft in the
wind."""

OUTSIDE_WINDS: Mapping[str, tuple[float, float]] = {
    "0.4 V from behind": (0.4, 0.0),
    "0.4 V from the left": (0.0, 0.4),
    "0.4 V from ahead": (-0.4, 0.0),
    "0.4 V from the right": (0.0, -0.4),
}

HOME_RADII = 1.5
"""Largest distance from home, in radii of the orbit round home: the orbit, and half a radius to
join it."""

WINDS: Mapping[str, tuple[float, float]] = {
    "calm": (0.0, 0.0),
    "0.3 V from behind": (0.3, 0.0),
    "0.3 V across": (0.0, 0.3),
    "0.3 V from ahead": (-0.3, 0.0),
}
"""Where the air moves to: north and east, of V0."""

DURATION, HOMEWARD_DURATION = 8.0, 25.0
"""Radii at V0: 3 to the fence against the wind, a turn, and the way home; 14 round the U against
0.4 V."""


class Row(NamedTuple):
    """The flights of an aircraft at a fence in a wind."""

    aircraft: str
    fence: str
    wind: str
    flights: int
    outside: int  # flights
    farthest: float  # m beyond the fence
    turned: int  # flights with a bank of nine tenths of the largest
    lost: int  # flights
    home: int  # flights within HOME_RADII at the end

    def figures(self) -> Iterator[evidence.Row]:
        """The rows of evidence."""
        about = f"{self.fence}, {self.wind}"
        yield evidence.row(f"{about}: flights", self.flights)
        yield evidence.row(f"{about}: flights outside", self.outside, at_most=0)
        yield evidence.row(f"{about}: flights lost", self.lost, at_most=0)
        yield evidence.row(f"{about}: farthest outside", self.farthest, "m")


def of_radius(zones: tuple[Zone, ...], radius: float) -> tuple[Zone, ...]:
    """Zones in m."""

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
) -> tuple[Scenario, GuidanceConfig, float]:
    """A scenario in a wind, share of V0, without a route, that flies to the north; its section, and
    the least radius, m.

    `home` in radii; `radii`: the duration, at V0.
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
    return varied, section, radius


def at(place: tuple[float, float], radius: float) -> tuple[float, float]:
    """A place in m."""
    return place[0] * radius, place[1] * radius


def fly_fleet(
    shape: str, wind: str, aircraft: int, seed: int, *, from_outside: bool = False
) -> Row:
    """The row of uncertain ospreys. The fence is put round the mission afterwards, as guidance
    refuses a route out of it.
    """
    fence = OUTSIDE[shape] if from_outside else Fence(SHAPES[shape], HOME)
    share, radii = (
        (OUTSIDE_WINDS[wind], HOMEWARD_DURATION) if from_outside else (WINDS[wind], DURATION)
    )
    scenario, _, radius = windy(find_scenario("osprey_route"), share, fence.home, radii)
    route = {"north": [0.0, 40.0 * radius], "east": [0.0, 0.0], "altitude": [0.0, 0.0]}
    scenario = scenario.vary(guidance={"route": route})
    airframe = load_airframe("osprey")
    course = build_course(scenario)
    vehicle = batch.vehicle(scenario)
    mission = missions.build(scenario, course)
    fence = Fence(of_radius(fence.zones, radius), at(fence.home, radius), radius)
    mission = replace(mission, guidance=mission.guidance._replace(fence=fence))
    control_law, params = scenario.controller.tuned_law()
    beyond = []
    banks = []
    lost = 0
    home = 0
    for first in range(0, aircraft, CHUNK):
        A, B = sampled_matrices(
            airframe, UNCERTAINTY, UNCERTAINTY, seed, first, min(CHUNK, aircraft - first)
        )
        directions = gust_directions(airframe, A, scenario.aircraft.uncertainty.wind)
        assembled = batch_matrices.assemble(
            A, B, scenario.aircraft.plant(), course, gust_directions=directions
        )
        result = batch.fly(assembled, vehicle, course, control_law, batch.shared(params), mission)
        figures = result.mission or {}
        beyond += np.asarray(figures["max.breach"]).tolist()
        banks += np.asarray(figures["max.phi"]).tolist()
        lost += int(np.sum(np.asarray(result.diverged)))
        home += int(np.sum(np.asarray(figures["home"]) <= HOME_RADII * radius))
    return row_of(OSPREY, shape, wind, beyond, banks, lost, mission.guidance.limits.bank)._replace(
        home=home
    )


def fly_alone(name: str, shape: str, wind: str) -> Row:
    """The row of an aircraft of JSBSim, which flies to the north."""
    scenario, section, radius = windy(aircraft_of(name), WINDS[wind], HOME)
    zones = of_radius(SHAPES[shape], radius)
    fence = {
        f"zone{k}": {
            "north": zone.north,
            "east": zone.east,
            "radius": zone.radius or None,
            "exclude": zone.exclude,
        }
        for k, zone in enumerate(zones)
    }
    program = {"course": {"start": [0.1], "value": [0.0]}}
    tape = simulate(scenario.vary(guidance={"fence": fence, "program": program}))
    beyond = max(-float(tape["guidance"]["fence.clearance"].min()), 0.0)
    bank = float(np.abs(tape["pose"]["phi"]).max())
    pose = tape["pose"]
    home = at(HOME, radius)
    to_home = math.hypot(pose["north"][-1] - home[0], pose["east"][-1] - home[1])
    row = row_of(name, shape, wind, [beyond], [bank], int(tape.outcome != COMPLETED), section.bank)
    return row._replace(home=int(to_home <= HOME_RADII * radius))


def fly_home(aircraft: int, seed: int, show: Callable[[Row], Any]) -> list[bool]:
    """Whether all ospreys that start outside come home, by fence and wind."""
    homes = []
    for number, (shape, wind) in enumerate(product(OUTSIDE, OUTSIDE_WINDS)):
        row = fly_fleet(shape, wind, aircraft, seed + number, from_outside=True)
        show(row)
        sys.stdout.flush()
        homes.append(row.home == row.flights)
    return homes


def row_of(
    name: str,
    shape: str,
    wind: str,
    beyond: list[float],
    banks: list[float],
    lost: int,
    largest: float,
) -> Row:
    """A row from the distances beyond the fence, m, and the largest banks of the flights."""
    outside = sum(distance > 0.0 for distance in beyond)
    turned = sum(bank > 0.9 * largest for bank in banks)
    return Row(name, shape, wind, len(beyond), outside, round(max(beyond), 2), turned, lost, 0)


def main() -> int:
    """Fly, print the rows and store them."""
    parser = parser_of(__doc__)
    parser.add_argument("--only", nargs="*", choices=AIRCRAFT, default=[*AIRCRAFT], help="aircraft")
    parser.add_argument(
        "--shapes", nargs="*", choices=[*SHAPES], default=[*SHAPES], help="fences; not stored"
    )
    parser.add_argument(
        "--winds", nargs="*", choices=[*WINDS], default=[*WINDS], help="winds; not stored"
    )
    parser.add_argument("--aircraft", type=int, default=2000, help="ospreys in each row")
    parser.add_argument("--seed", type=int, default=7, help="of the ospreys")
    parser.add_argument(
        "--from-outside", action="store_true", help="start ospreys outside of a fence; not stored"
    )
    chosen = parser.parse_args()
    writer = csv.writer(sys.stdout)
    failed = False
    writer.writerow(Row._fields)
    if chosen.from_outside:
        return int(not all(fly_home(chosen.aircraft, chosen.seed, writer.writerow)))
    for name in chosen.only:
        options = f" --aircraft {chosen.aircraft} --seed {chosen.seed}" * (name == OSPREY)
        begun = evidence.origin(f"python -m benchmarks.fence --only {name}{options}")
        flown = list[Row]()
        for shape, wind in product(chosen.shapes, chosen.winds):
            of_fleet = name == OSPREY
            row = (
                fly_fleet(shape, wind, chosen.aircraft, chosen.seed)
                if of_fleet
                else fly_alone(name, shape, wind)
            )
            flown.append(row)
            writer.writerow(row)
            sys.stdout.flush()
            failed |= bool(row.outside or row.lost)
        if len(flown) == len(SHAPES) * len(WINDS):
            evidence.write(
                f"guidance-fence-{name}", chain.from_iterable(row.figures() for row in flown), begun
            )
    return int(failed)


if __name__ == "__main__":
    raise SystemExit(main())
