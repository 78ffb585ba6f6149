# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Print guaranteed and found limits of the deviations of A and B as CSV.

Each row is a scenario that ships, or the F-4C of the tutorial (f4c). For a scenario of a linear
airframe, the program also flies an aircraft beyond the limit.

    python -m benchmarks.guarantee osprey_servo osprey_observer f4c
    python -m benchmarks.guarantee osprey_servo --corners 20000  # corners and samples at the limit
"""

import argparse
import csv
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import yaml

from aircraft_sim.airframes.airframe import Airframe, load_airframe
from aircraft_sim.uncertainty import as_yaml, with_entries
from flight_analysis.closed_loop.scenario import Scenario
from flight_analysis.closed_loop.scenario_library import find_scenario
from flight_analysis.closed_loop.simulate import simulate
from flight_analysis.linear_loop.guarantee import Unstable, loop_guarantee
from flight_analysis.linear_loop.loop_margins import (
    LinearLoop,
    scenario_loop,
)
from flight_analysis.linear_loop.uncertain_loop import plants_at
from flight_analysis.linear_loop.worst_case import worst_in_box
from flight_analysis.report.account import account
from flight_analysis.report.shortfalls import judge
from flight_design.gains.gain_design import select_gains
from rise_di_controller.law.linear_loop import SPECTRAL_RADIUS_TOLERANCE, closed_loop

UNCERTAINTY = 0.3
LATE = 0.01  # largest delay of u in the second guarantee, s
# factor from the deviations of the first unstable aircraft to those of the one that flies
FARTHER = 1.2
LARGEST = 0.99  # largest deviation of the aircraft that flies
BATCH = 500  # number of aircraft at once: so few that their matrices stay in the cache
F4C = "f4c"
PAGE = Path(__file__).parents[1] / "docs" / "tutorials" / "theorem.md"
HEADINGS = (
    "scenario",
    "entries",
    "stable for every aircraft within, %",
    "first unstable aircraft found, %",
    "its frequency, rad/s",
    "gap, %",
    "the same with u up to 10 ms late, another time at each tick, %",
    "first found with such a u, %",
    "guaranteed disk margin of all inputs within 30 %",
    "least found",
    "processor time, s",
    "outcome of an aircraft 1.2 times as far off",
    "unstable corners and samples at the guarantee",
)


def loop_of(name: str) -> tuple[LinearLoop, Scenario | None]:
    """Return the loop with its box of deviations, and the scenario, which is None for the F-4C."""
    if name == F4C:
        text = PAGE.read_text().split("cat > f4c.yaml <<'EOF'\n")[1].split("EOF")[0]
        frame = Airframe.validate_mapping(yaml.safe_load(text), F4C)
        return select_gains(frame, samples=20).engineering.loop_with_box(), None
    scenario = find_scenario(name)
    return scenario_loop(scenario, scenario.controller, 1, UNCERTAINTY), scenario


def flight(scenario: Scenario, first: Unstable) -> str:
    """Fly an aircraft with FARTHER times the deviations of the first unstable one.

    Returns the outcome.
    """
    factor = min(FARTHER, LARGEST / first.deviation)
    entries = {name: factor * part for name, part in first.entries.items()}
    frame = with_entries(load_airframe(scenario.aircraft.airframe), entries)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "airframe.yaml"
        path.write_text(as_yaml(frame))
        unstable = scenario.vary(aircraft={"airframe": str(path)})
        tape = simulate(unstable)
        return str(judge(tape.outcome, tape, unstable, account(tape, unstable)))


def beyond(linear: LinearLoop, stable: float, count: int) -> str:
    """Return how many of `count` aircraft within a guaranteed limit are unstable.

    Half of the aircraft have every deviation at the limit; those of the others are uniform samples.
    """
    box = linear.box
    assert box is not None  # noqa: S101 - for mypy
    generator = np.random.default_rng(3)
    still = np.zeros(len(linear.inputs))
    unstable = 0
    for k in range(0, count, BATCH):
        d = generator.uniform(-1.0, 1.0, (min(BATCH, count - k), len(box.names)))
        d = d if k % (2 * BATCH) else np.sign(d)
        aircraft = plants_at(linear.nominal, box, d * stable / box.largest)
        z = np.linalg.eigvals(closed_loop(aircraft, linear.law, linear.loop, still))
        radii = np.abs(z).max(axis=-1)
        unstable += int(np.count_nonzero(radii > 1.0 + SPECTRAL_RADIUS_TOLERANCE))
    return f"{unstable} of {count}"


def row(name: str, corners: int) -> list[str]:
    """Return the figures of a scenario in the order of HEADINGS.

    `corners` is the number of aircraft that `beyond` tries, or 0.
    """
    linear, scenario = loop_of(name)
    box = linear.box
    assert box is not None  # noqa: S101 - for mypy
    begin = time.process_time()
    guarantee = loop_guarantee(linear)
    seconds = time.process_time() - begin
    late = loop_guarantee(linear, LATE)
    worst = worst_in_box(linear.nominal, linear.law, linear.loop, box).worst
    first = guarantee.unstable
    flies = scenario is not None and not scenario.aircraft.is_jsbsim and first is not None
    return [
        name,
        str(len(box.names)),
        f"{100.0 * guarantee.stable:.1f}",
        _percent(first),
        "" if first is None else f"{first.frequency:.1f}",
        "" if first is None else f"{100.0 * (first.deviation / guarantee.stable - 1.0):.1f}",
        f"{100.0 * late.stable:.1f}",
        _percent(late.unstable),
        f"{guarantee.disk_all:.3f}",
        f"{float(worst.disk_all):.3f}",
        f"{seconds:.0f}",
        flight(scenario, first) if flies and scenario is not None and first is not None else "",
        beyond(linear, guarantee.stable, corners) if corners else "",
    ]


def _percent(first: Unstable | None) -> str:
    return "none" if first is None else f"{100.0 * first.deviation:.1f}"


def main() -> None:
    """Print a row for each scenario."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scenarios", nargs="+")
    parser.add_argument("--corners", type=int, default=0)
    options = parser.parse_args()
    writer = csv.writer(sys.stdout, lineterminator="\n")
    writer.writerow(HEADINGS)
    for name in options.scenarios:
        writer.writerow(row(name, options.corners))
        sys.stdout.flush()


if __name__ == "__main__":
    main()
