# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Find how a flight ended from the signals in its log."""

from dataclasses import replace

from flight_analysis.closed_loop.scenario import Scenario
from flight_analysis.report.account import planned_end_ns
from flight_analysis.report.sample_counts import LATE_TICK_NS, SILENCE, TICKS
from flight_core.outcome import COMPLETED, UNKNOWN, Outcome, log_ends_at, never_flew
from flight_core.rates import nanoseconds, seconds
from flight_core.tape import Tape

NEVER_ENGAGED = never_flew("the controller never engaged")


def has_ticks(tape: Tape) -> bool:
    """Return whether the log has a sample of u or `internals`, so that the controller engaged."""
    return any(name in tape and len(tape[name].stamp_ns) for name in TICKS)


def outcome_of_log(tape: Tape, scenario: Scenario, *, simulated: bool) -> Outcome:
    """Return the outcome of a flight, found from its signals.

    This function is for a log without an outcome, for example if the nodes were started singly. The
    flight is completed if y, y_m and u last for its whole duration. The duration comes from the log
    or, if the log lacks it, from the scenario. If the log has only a part of the flight, the
    outcome is UNKNOWN. If the flight is not simulated, u need not last, because an autopilot may
    disengage the controller before the end.
    """
    is_part = bool(tape.lost_parts) or any(
        recording.step_ns for recording in tape.recording.values()
    )
    if simulated and not has_ticks(tape):
        return UNKNOWN if is_part else NEVER_ENGAGED
    names = ("y", "y_m", "u") if simulated else ("y", "y_m")
    stamps = [tape[name].stamp_ns for name in names if name in tape]
    last_ns = min(
        (int(stamp_ns[-1]) if len(stamp_ns) else tape.start_ns for stamp_ns in stamps),
        default=tape.start_ns,
    )
    duration = scenario.flight.duration if tape.duration is None else tape.duration
    if last_ns >= tape.start_ns + nanoseconds(duration) - LATE_TICK_NS:
        return COMPLETED
    return UNKNOWN if is_part else log_ends_at(seconds(last_ns - tape.start_ns), duration)


def until_last_tick(tape: Tape) -> Tape:
    """Cut the tape after the controller's last tick.

    Later samples belong to the shutdown of the processes. There are two exceptions:

    - If u ends more than LATE_TICK_NS earlier than planned, and y or y_m goes on, the log has a
      gap. The tape is then cut at the planned end.
    - If u does not end so early, but both y and y_m go on for more than SILENCE, nothing is cut.
    """
    ticks = [
        int(tape[name].stamp_ns[-1]) for name in TICKS if name in tape and len(tape[name].stamp_ns)
    ]
    others = [
        int(tape[name].stamp_ns[-1])
        for name in ("y", "y_m")
        if name in tape and len(tape[name].stamp_ns)
    ]
    if not ticks:
        return tape
    # One tick publishes both u and internals.
    end_ns = max(ticks)
    planned_ns = planned_end_ns(tape)
    if (
        planned_ns is not None
        and end_ns < planned_ns - LATE_TICK_NS
        and end_ns < max(others, default=0) - LATE_TICK_NS
    ):
        end_ns = planned_ns
    elif min(others, default=end_ns) - end_ns > nanoseconds(SILENCE):
        return tape
    return replace(
        tape, signals={name: signal.until(end_ns) for name, signal in tape.signals.items()}
    )
