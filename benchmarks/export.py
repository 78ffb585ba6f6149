# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Time of a replayed tick in C, as a shared library, beside the Python controller, in one run.

python -m benchmarks.export
"""

import tempfile
import time
from pathlib import Path

import numpy as np
from benchmarks.sampling import new_table
from rich.console import Console

from c_export.constants import exportable
from c_export.events import Recorder, Recording
from c_export.library import CController, build_library
from c_export.proof import compilers, write_code
from flight_analysis.closed_loop.scenario_library import find_scenario
from flight_core.vectors import StampedVector
from rise_di_controller import guard

TICKS = 5000


def ratio(scenario: str) -> tuple[float, float]:
    """Median time of a tick in Python and mean time in C, us, with the same samples."""
    controller = exportable(find_scenario(scenario).controller)
    rng, m = np.random.default_rng(1), len(controller.outputs)
    y, y_m = 0.01 * rng.normal(size=(2, TICKS, m))
    recorder, tuned, limits = Recorder([controller]), controller.tuned_law(), controller.guard()
    stamps = [k * limits.period_ns for k in range(TICKS)]
    state, took = guard.initial_state(m), np.empty(TICKS)
    for k, stamp_ns in enumerate(stamps):
        recorder.guard_tick(stamp_ns, (stamp_ns, y[k], y_m[k], 0), active=True)
        samples = StampedVector(stamp_ns, y[k]), [StampedVector(stamp_ns, y_m[k])]
        begin = time.perf_counter_ns()
        state, _ = guard.tick(state, stamp_ns, *samples, limits, tuned)
        took[k] = (time.perf_counter_ns() - begin) * 1e-3
    with tempfile.TemporaryDirectory() as name:
        write_code(controller, scenario, Path(name), float32=False)
        c = CController(build_library(Path(name), compilers()[0], Path(name) / "rise_di.so"), m)
    recording = recorder.recording(scenario)
    best = min(_time(c, recording) for _ in range(20))
    return float(np.median(took)), best / TICKS


def _time(c: CController, recording: Recording) -> float:
    begin = time.perf_counter_ns()
    c.replay(recording)
    return (time.perf_counter_ns() - begin) * 1e-3


def main() -> None:
    """Measure and print."""
    table = new_table("One tick, us", ("scenario", "NumPy", "C", "NumPy / C"), texts=1)
    for scenario in ("osprey_servo", "osprey_observer"):
        python, c = ratio(scenario)
        table.add_row(scenario, f"{python:.1f}", f"{c:.2f}", f"{python / c:.0f}")
    Console().print(table)


if __name__ == "__main__":
    main()
