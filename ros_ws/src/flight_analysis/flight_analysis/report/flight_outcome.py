# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""The outcome of a flight by its log."""

import re
from dataclasses import replace

from flight_analysis.closed_loop.scenario import Scenario
from flight_analysis.report.account import SILENCE, Account, lost_log_parts, planned_end_ns
from flight_analysis.report.sample_counts import LATE_TICK_NS, TICKS
from flight_core.outcome import (
    BESIDE,
    COMPLETED,
    INCOMPLETE,
    LANDED,
    LOOP_LOST,
    MISSED,
    NEVER_FLEW,
    NOT_FLOWN,
    NOT_JOINED,
    OUTSIDE,
    UNKNOWN,
    ended_early,
)
from flight_core.rates import nanoseconds, seconds
from flight_core.tape import Tape

# of an outcome
SHORTFALL = re.compile(
    rf", (?:{LOOP_LOST}: |{OUTSIDE} |{MISSED} leg |legs? \d+(?: to \d+)? {NOT_FLOWN}|{NOT_JOINED}|"
    rf"{BESIDE}|{INCOMPLETE}).*",
    re.DOTALL,
)


def final_outcome(outcome: str, account: Account) -> str:
    """The outcome with the time outside of the fence, the legs missed and not flown, and with what
    the log lacks.

    As in "completed, missed leg 2 by 35 m, legs 4 to 6 not flown, log incomplete: ...".

    An early end stays as it is.
    """
    base = SHORTFALL.sub("", outcome)
    if base == COMPLETED and account.late is not None:
        return f"{NEVER_FLEW}: the first u came at t = {account.late:.3f} of {account.end:.3f} s"
    if base == COMPLETED and account.unguided:
        return (
            f"{NEVER_FLEW} guided: guidance took no step; see the ages of pose and y against "
            "guidance.max_age"
        )
    outing = account.outside if account.outside is not None and account.outside.left else None
    outside = (
        []
        if outing is None
        else [f"{OUTSIDE} for {outing.outside_s:.1f} s, {outing.farthest_m:.0f} m at most"]
    )
    if LANDED in base:
        missed = [f"{BESIDE} by {account.beside:.0f} m"] if account.beside else []
        return ", ".join([base, *outside, *missed])
    if not base.startswith((COMPLETED, UNKNOWN)):
        return base
    parts = [
        base,
        *([f"{LOOP_LOST}: {'; '.join(account.loop_lost)}"] if account.loop_lost else []),
        *outside,
        *(f"{MISSED} leg {leg.leg} by {leg.missed:.0f} m" for leg in account.legs if leg.missed),
    ]
    if account.unflown:
        first = account.unflown[0]
        last = account.unflown[-1]
        parts.append(
            f"leg {last} {NOT_FLOWN}" if first == last else f"legs {first} to {last} {NOT_FLOWN}"
        )
    if account.off_orbit:
        parts.append(f"{NOT_JOINED}: {account.off_orbit:.0f} m")
    if account.lacks:
        parts.append(f"{INCOMPLETE}: {'; '.join(account.lacks)}")
    return ", ".join(parts)


def outcome_of_log(tape: Tape, scenario: Scenario, *, simulated: bool) -> str:
    """The outcome of a flight that left none, as one of nodes that were started one by one; empty
    for a part of a flight.

    The flight is completed where the log holds y, y_m and u for the duration in the log, else that
    of the scenario. An autopilot may end the last engagement, and with it u, before.
    """
    is_part = bool(lost_log_parts(tape.notes, planned=False)) or any(
        recording.step_ns for recording in tape.recording.values()
    )
    if simulated and not {*TICKS} & {*tape.signals}:
        return "" if is_part else f"{NEVER_FLEW}: the controller never engaged"
    loop = [
        tape[name].stamp_ns for name in ("y", "y_m", *(["u"] if simulated else [])) if name in tape
    ]
    held = min(
        (int(stamp_ns[-1]) if len(stamp_ns) else tape.start_ns for stamp_ns in loop),
        default=tape.start_ns,
    )
    planned = scenario.flight.duration if tape.duration is None else tape.duration
    if held >= tape.start_ns + nanoseconds(planned) - LATE_TICK_NS:
        return COMPLETED
    return "" if is_part else ended_early(seconds(held - tape.start_ns), planned)


def flown(tape: Tape) -> Tape:
    """The tape up to the controller's last tick: later samples belong to the shutdown of the
    processes.

    A u that ends much earlier than y and y_m, or before the end of a whole flight, is a gap of the
    log: nothing is cut there.
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
    # one tick publishes u and internals
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
