# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Fly a scenario: over topics in real time or in lockstep, or in one process."""

import signal
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING

from flight_analysis.closed_loop.scenario import Scenario
from flight_analysis.closed_loop.simulate import simulate
from flight_analysis.report.run_folder import enclosed
from flight_analysis.report.summary import display_units
from flight_bringup.graph import Autopilot
from flight_bringup.processes import FlightProcesses
from flight_core.outcome import COMPLETED, INTERRUPTED
from flight_log.tape_writer import write_run

if TYPE_CHECKING:
    from flight_bringup.clients import FlightMonitor

POLL_PERIOD = 0.05  # s, of the progress bar

STALL_TIMEOUT = 40.0
"""s. A lockstep flight in which nothing moves for as long ends; a peer that is gone ends it within two seconds."""

Progress = Callable[[float, str], None]  # flight time in s, and what to show beside it


@contextmanager
def _signals_as_interrupt() -> Iterator[None]:
    # SIGINT too: a shell starts background commands with it ignored, and then Python leaves it so.
    def interrupt(number: int, frame: FrameType | None) -> None:
        raise KeyboardInterrupt

    before = {number: signal.signal(number, interrupt) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def fly_over_topics(
    scenario: Scenario,
    run: Path,
    progress: Progress,
    *,
    lockstep: bool = False,
    one_process: bool = False,
    autopilot: Autopilot | None = None,
) -> str:
    """Fly over topics, as separate processes, and record the bag into `run`. Returns the outcome.

    In real time, or in `lockstep` as fast as the machine allows; `one_process` holds all nodes in one process, for lockstep
    alone; `autopilot` flies in the aircraft's place, in real time alone. "completed", "interrupted" (Ctrl-C or SIGTERM), or a
    sentence naming the process that ended early.
    """
    from flight_bringup.clients import FlightMonitor  # noqa: PLC0415 - loads rclpy, which no other command needs

    try:
        with (
            _signals_as_interrupt(),
            FlightMonitor(scenario.controller.outputs, lockstep=lockstep) as monitor,
            FlightProcesses(
                scenario,
                run,
                before_start=monitor.require_free_domain,
                lockstep=lockstep,
                one_process=one_process,
                autopilot=autopilot,
            ) as flight,
        ):
            follow = _follow_lockstep if lockstep else _follow_real_time
            return follow(scenario, flight, monitor, progress)
    except KeyboardInterrupt:
        return INTERRUPTED


def _follow_real_time(scenario: Scenario, flight: FlightProcesses, monitor: "FlightMonitor", progress: Progress) -> str:
    units, outputs = display_units(scenario), scenario.controller.outputs
    shown = "starting"
    while (t := time.time() - flight.start_time) < scenario.flight.duration:
        if (sentence := flight.ended_early()) is not None:
            return sentence
        if (seen := monitor.newest()) is not None:
            errors = ", ".join(f"{name} {value * units[name].factor:+.2f}" for name, value in zip(outputs, seen.e, strict=True))
            shown = f"{seen.mode}  e: {errors}"
        progress(max(t, 0.0), shown)
        time.sleep(POLL_PERIOD)
    return COMPLETED


def _follow_lockstep(scenario: Scenario, flight: FlightProcesses, monitor: "FlightMonitor", progress: Progress) -> str:
    """The real-time factor shown is that since the first instant in the log."""
    end = scenario.flight.duration
    flown, first, moved, shown = 0.0, 0.0, time.monotonic(), "lockstep, starting"
    begin = moved
    # The last instant is the last whole period of the aircraft.
    while flown < end - 1.0 / scenario.aircraft.rate:
        if (sentence := flight.ended_early()) is not None:
            return sentence
        now = time.monotonic()
        if (recorded := monitor.recorded()) is not None:
            if moved == begin:
                begin, first = now, recorded
            flown, moved = recorded, now
            if now > begin:
                shown = f"lockstep, {(flown - first) / (now - begin):.1f} times real time"
        elif now > moved + STALL_TIMEOUT:
            return f"stuck at t = {flown:g} s: nothing has moved for {STALL_TIMEOUT:g} s"
        progress(flown, shown)
        time.sleep(POLL_PERIOD)
    return COMPLETED


def fly_in_process(scenario: Scenario, run: Path, progress: Progress) -> str:
    """Fly in one process without ROS, as fast as it goes, and write the bag into `run`. Returns the outcome."""
    with _signals_as_interrupt():
        tape = simulate(scenario, lambda t: progress(t, "in one process"))
    write_run(tape, run, enclosed(scenario, run))
    return tape.outcome
