# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Guaranteed and found limits of the deviations of A and B, for scenarios that ship: CSV on
standard output.

python -m benchmarks.guarantee osprey_servo osprey_observer
"""

import argparse
import csv
import sys
import time

from aircraft_sim.airframe import load_airframe
from flight_analysis.closed_loop.guarantee import guarantee
from flight_analysis.closed_loop.loop_margins import box_of, scenario_loop
from flight_analysis.closed_loop.scenario_library import find_scenario
from rise_di_controller.worst_case import worst_in_box

UNCERTAINTY = 0.3
HEADINGS = (
    "scenario",
    "entries",
    "stable for every aircraft within, %",
    "first unstable aircraft found, %",
    "its frequency, rad/s",
    "guaranteed disk margin of all inputs within 30 %",
    "least found",
    "processor time, s",
)


def row(name: str) -> list[str]:
    """The figures of a scenario of an airframe file."""
    scenario = find_scenario(name)
    controller = scenario.controller
    frame = load_airframe(scenario.aircraft.airframe)
    begin = time.process_time()
    box = box_of(frame, controller, UNCERTAINTY)
    linear = scenario_loop(scenario, controller)._replace(box=box)
    promise = guarantee(linear)
    worst = worst_in_box(linear.nominal, linear.law, linear.loop, box).worst
    first = promise.unstable
    return [
        name,
        str(len(box.names)),
        f"{100.0 * promise.stable:.1f}",
        "none" if first is None else f"{100.0 * first.deviation:.1f}",
        "" if first is None else f"{first.frequency:.1f}",
        f"{promise.disk_all:.3f}",
        f"{float(worst.disk_all):.3f}",
        f"{time.process_time() - begin:.0f}",
    ]


def main() -> None:
    """Print a row a scenario."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scenarios", nargs="+")
    writer = csv.writer(sys.stdout, lineterminator="\n")
    writer.writerow(HEADINGS)
    for name in parser.parse_args().scenarios:
        writer.writerow(row(name))
        sys.stdout.flush()


if __name__ == "__main__":
    main()
