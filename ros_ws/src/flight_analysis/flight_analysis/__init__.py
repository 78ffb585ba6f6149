# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Flights without ROS: fly a scenario in one process, read a log, compare figures, replay a controller.

The names below are the Python interface of the stack. They keep their meaning within a minor version; see CHANGELOG.md.

    from flight_analysis import data_frame, read_run, simulate
    from flight_bringup.scenarios import find_scenario

    scenario = find_scenario("osprey_gust").vary(controller={"beta": [2.0, 2.0, 1.0, 1.0]})
    tape = simulate(scenario)          # a Tape: tape["y"]["q"] is an array, tape.time("y") its times
    frame = data_frame(tape)           # all signals as one table of polars
    run = read_run(Path("runs/latest"))
"""

from flight_analysis.closed_loop.replay import ReplayResult, recorded_scenario, replay
from flight_analysis.closed_loop.scenario import Scenario, load_scenario
from flight_analysis.closed_loop.simulate import simulate
from flight_analysis.metrics import best_error, error_metrics
from flight_analysis.report.data_frame import data_frame
from flight_analysis.report.summary import summarise
from flight_core.tape import Signal, Tape
from flight_log.tape_reader import RecordedRun, read_run

__all__ = [
    "RecordedRun",
    "ReplayResult",
    "Scenario",
    "Signal",
    "Tape",
    "best_error",
    "data_frame",
    "error_metrics",
    "load_scenario",
    "read_run",
    "recorded_scenario",
    "replay",
    "simulate",
    "summarise",
]
