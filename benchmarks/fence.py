# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Uncertain aircraft on a route that leads out of a fence, in wind and turbulence: how many leave the fence, and how far.

    .venv/bin/python -m benchmarks.fence [--aircraft 2000] [--wind 0.3] [--seed 7]

Every entry of A and B is off by up to 30 % (`aircraft_sim.uncertainty`), the turbulence is light (MIL-F-8785C, 7.7 m/s at
20 ft), the steady wind from behind is a share of V0. The fence is a square, the edge ahead is 500 m away, home is the start. A
route that leaves the fence is refused before a flight; so the fence is put round the mission afterwards. Exit status 1: an
aircraft left the fence, or diverged.
"""

import argparse
from dataclasses import replace

import numpy as np

from aircraft_sim.airframe import load_airframe
from aircraft_sim.uncertainty import gust_directions, sampled_matrices
from flight_bringup.scenarios import find_scenario
from flight_campaign import fleet, missions
from flight_campaign.benchmark_course import build_course
from flight_guidance.fence import Fence, Zone

FENCE = Fence((Zone((-400.0, 500.0, 500.0, -400.0), (-450.0, -450.0, 450.0, 450.0)),))
DURATION, CHUNK, UNCERTAINTY = 32.0, 250, 0.3
"""s: the aircraft meets the edge after 9 to 14 s, home follows; aircraft in one flight; share of the entries of A and B."""


def main() -> int:
    """Fly the chunks and print the figures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--aircraft", type=int, default=2000)
    parser.add_argument("--wind", type=float, default=0.3, help="share of V0")
    parser.add_argument("--seed", type=int, default=7)
    chosen = parser.parse_args()
    route = {"north": [0.0, 3000.0], "east": [0.0, 900.0], "altitude": [0.0, 0.0]}
    scenario, airframe = find_scenario("osprey_route"), load_airframe("osprey")
    wind = chosen.wind * scenario.aircraft.channels().speed
    scenario = scenario.vary(
        flight={"duration": DURATION}, aircraft={"wind": [wind, 0.0]}, guidance={"route": route, "wind": wind}
    )
    course, vehicle = build_course(scenario), fleet.vehicle(scenario)
    mission = missions.build(scenario, course)
    mission = replace(mission, guidance=mission.guidance._replace(fence=FENCE))
    control_law, params = scenario.controller.tuned_law()
    breaches, diverged, reached = [], 0, 0
    for first in range(0, chosen.aircraft, CHUNK):
        A, B = sampled_matrices(airframe, UNCERTAINTY, UNCERTAINTY, chosen.seed, first, CHUNK)
        directions = gust_directions(airframe, A, scenario.aircraft.uncertainty.wind)
        aircraft = fleet.assemble(A, B, scenario.aircraft.plant(), course, gust_directions=directions)
        result = fleet.fly(aircraft, vehicle, course, control_law, fleet.shared(params), mission)
        figures = result.mission or {}
        diverged += int(np.sum(np.asarray(result.diverged)))
        breaches += np.asarray(figures["max.breach"]).tolist()
        reached += int(np.sum(np.asarray(figures["max.phi"]) > 0.9 * mission.guidance.limits.bank))
        print(f"{len(breaches)} aircraft: {sum(breach > 0.0 for breach in breaches)} left the fence", flush=True)
    left = sum(breach > 0.0 for breach in breaches)
    print(
        f"farthest outside {max(breaches):.1f} m; {reached} turned at the largest bank; {diverged} diverged; wind {wind:g} m/s"
    )
    return 1 if left or diverged else 0


if __name__ == "__main__":
    raise SystemExit(main())
