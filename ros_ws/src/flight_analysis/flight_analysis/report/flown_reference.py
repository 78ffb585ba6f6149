# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Check that the y_m of a flight is the y_m that its scenario commands.

The error e = y - y_m does not show that the reference model hangs or flies other commands, because
y follows any y_m. Therefore this module computes y_m again, by the code of the node. Until the
first u_m of the log it takes the commands of the scenario, and from then on the u_m of the log:

    x_m+ = Phi x_m + Gamma [u_m(t), u_m(t + T/2), u_m(t + T)],  y_m = C x_m      (2)

Every bit must be equal, except for ROUNDING. If the flight was in real time, the log does not show
before which step a u_m arrived. The computation finds the step, within the age limit of u_m, from
which on y_m has the right bits. If several steps give the right bits, it follows all of them until
they differ from the log. If the log lost a y_m or a u_m, the check only finds an error above
HARMLESS times the least rms error that is judged as a divergence (LEAST, LEAST_RATE).
"""

import copy
from collections.abc import Sequence
from contextlib import suppress
from enum import Enum
from typing import NamedTuple

import numpy as np

from flight_analysis.closed_loop.scenario import Scenario
from flight_analysis.report.display_units import STATES, display_unit, plain_number
from flight_analysis.report.sample_counts import is_sent_by_stack
from flight_core.channels import ATTITUDE
from flight_core.outcome import Aim, Shortfall
from flight_core.rates import NANOSECONDS, nanoseconds
from flight_core.tape import Tape
from flight_core.vectors import ChannelError, FloatArray
from flight_log.clock import SINCE_EPOCH_NS
from reference_model.params import ReferenceModelConfig
from reference_model.reference import Reference
from rise_di_controller.learning.divergence import HARMLESS, LEAST, LEAST_RATE

ROUNDING = 1e-9
"""Difference that counts as none, rad/s and m/s. Another build of NumPy can round the sine of a
command differently. An error that matters is a million times larger."""

AHEAD_NS = 5_000_000
"""Time by which the clock of u_m may be ahead. If clocks differ by more, the nodes report it."""

FITTING = 0.5
"""If a user started the node singly, an instant counts as its t = 0 if at least this share of the
samples is right."""

MOST_HISTORIES = 16
"""Largest number of hypotheses on the order of the u_m. Guidance sends ten u_m within their age
limit."""


class NotCompared(Enum):
    """The reason why y_m was not compared with the scenario."""

    ABSENT = "the log has no y_m"
    FOREIGN = "y_m comes from a reference model outside of the stack"
    OTHER_CHANNELS = "y_m lacks a channel of the scenario's reference model"
    NO_START = "the log does not hold the start of the reference model"

    def note(self) -> str:
        """Return the reason as a sentence for the report."""
        return f"y_m is not compared with the commands of the scenario: {self.value}"


class ReferenceErrors(NamedTuple):
    """The difference between the y_m of a log and the y_m of the scenario."""

    t: FloatArray  # flight time, s, (N,)
    outputs: tuple[str, ...]
    error: FloatArray  # y_m of the log less y_m of the scenario, (N, m), SI
    allowed: FloatArray  # largest abs(error) that is taken as 0, (m,), SI


class _Command(NamedTuple):
    """A message u_m of the log, with its time and the attitude that it commands."""

    t_ns: int  # flight time of its stamp
    u_m: FloatArray
    attitude: FloatArray | None


class _History(NamedTuple):
    """A hypothesis on how many messages u_m have arrived at the reference model so far."""

    reference: Reference
    taken: int  # number of u_m, in order, that have been taken or are too old


def reference_errors(tape: Tape, scenario: Scenario) -> ReferenceErrors | NotCompared:
    """Compute y_m again, and return how far the y_m of the log is from it.

    Returns a NotCompared if the two cannot be compared.
    """
    if (reason := _reason_in_signal(tape, scenario)) is not None:
        return reason
    outputs = scenario.reference_model.outputs
    y_m = np.stack([tape["y_m"][name] for name in outputs], axis=1)
    stamp_ns = tape["y_m"].stamp_ns
    starts = [tape.start_ns] if _has_known_start(tape) else [tape.start_ns, int(stamp_ns[0])]
    errors = []
    for start_ns in dict.fromkeys(starts):
        commands = _commands(tape, outputs, start_ns)
        expected = _explained(scenario.reference_model, stamp_ns - start_ns, y_m, commands)
        errors.append(y_m - expected)
    error = min(errors, key=lambda each: float(np.sum(each**2)))
    is_right = (np.abs(error) <= ROUNDING).all(axis=1)
    if not _has_known_start(tape) and np.mean(is_right) < FITTING:
        return NotCompared.NO_START
    harmless = [HARMLESS * LEAST.get(name, LEAST_RATE) for name in outputs]
    allowed = np.full(len(outputs), ROUNDING) if _is_whole(tape) else np.array(harmless)
    return ReferenceErrors(
        t=(stamp_ns - tape.start_ns) / NANOSECONDS, outputs=outputs, error=error, allowed=allowed
    )


def reference_shortfalls(tape: Tape, scenario: Scenario) -> list[Shortfall]:
    """Return a shortfall if the y_m of the log is not the y_m of the scenario, else [].

    The shortfall names the channel of y_m that is farthest off.
    """
    errors = reference_errors(tape, scenario)
    if not isinstance(errors, ReferenceErrors):
        return []
    # The negated comparison counts NaN as off, too.
    is_off = ~(np.abs(errors.error) <= errors.allowed)
    if not is_off.any():
        return []
    largest = np.nan_to_num(np.abs(errors.error), nan=np.inf)
    row, i = np.unravel_index(np.argmax(largest / errors.allowed), largest.shape)
    rows = np.flatnonzero(is_off.any(axis=1))
    name = errors.outputs[i]
    units = scenario.aircraft.channels().outputs
    unit = display_unit(units.get(name, STATES.get(name, "rad/s")))
    size = float(largest[row, i])
    start = float(errors.t[rows[0]])
    stop = float(errors.t[rows[-1]])
    size_shown = f"{plain_number(size * unit.factor)} {unit.unit}"
    brief = f"y_m differs from the scenario's: {name} off by {size_shown}"
    sentence = f"{brief} at most, from t = {start:.1f} to {stop:.1f} s"
    figures = {"output": name, "start": start, "stop": stop, "largest": size}
    return [Shortfall(aim=Aim.REFERENCE, sentence=sentence, brief=brief, figures=figures)]


def reason_not_compared(tape: Tape, scenario: Scenario) -> NotCompared | None:
    """Return why y_m cannot be compared with the scenario, or None if it can.

    The reason usually follows from the log alone. But if the log does not tell when t = 0 was, y_m
    has to be computed to find this instant.
    """
    reason = _reason_in_signal(tape, scenario)
    if reason is not None or _has_known_start(tape):
        return reason
    errors = reference_errors(tape, scenario)
    return errors if isinstance(errors, NotCompared) else None


def _reason_in_signal(tape: Tape, scenario: Scenario) -> NotCompared | None:
    """Return why y_m cannot be compared, judged only by its presence, sender and channels."""
    if "y_m" not in tape or not len(tape["y_m"].stamp_ns):
        return NotCompared.ABSENT
    if not is_sent_by_stack(tape, "y_m"):
        return NotCompared.FOREIGN
    if not set(scenario.reference_model.outputs) <= set(tape["y_m"].names):
        return NotCompared.OTHER_CHANNELS
    return None


def _is_whole(tape: Tape) -> bool:
    """Return whether the log shows which u_m acted at each step.

    The log of a flight in real time does not show it if a message of y_m or u_m was lost.
    """
    if "u_m" not in tape or tape.start_ns < SINCE_EPOCH_NS:
        return True
    return all(name in tape.recording and tape.recording[name].lost == 0 for name in ("y_m", "u_m"))


def _has_known_start(tape: Tape) -> bool:
    """Return whether t = 0 of the tape is known to be t = 0 of the reference model.

    t = 0 is known for a flight in one process, whose tape has the scenario. It is also known for a
    flight whose nodes were started together. You can tell such a flight by its log, which states
    the duration.
    """
    return tape.scenario is not None or tape.duration is not None


def _commands(tape: Tape, outputs: Sequence[str], start_ns: int) -> list[_Command]:
    """Return the u_m of the log in order, with their stamps converted to flight time."""
    if "u_m" not in tape or not set(outputs) <= set(tape["u_m"].names):
        return []
    log = tape["u_m"]
    u_m = np.stack([log[name] for name in outputs], axis=1)
    attitudes: Sequence[FloatArray | None] = [None] * len(u_m)
    if set(ATTITUDE) <= set(log.names):
        attitudes = list(np.stack([log[name] for name in ATTITUDE], axis=1))
    return [
        _Command(int(stamp) - start_ns, row, attitude)
        for stamp, row, attitude in zip(log.stamp_ns, u_m, attitudes, strict=True)
    ]


def _explained(
    parameters: ReferenceModelConfig,
    t_ns: np.ndarray[tuple[int], np.dtype[np.int64]],
    y_m: FloatArray,
    commands: Sequence[_Command],
) -> FloatArray:
    """Return the y_m that best explains the log, at the instants t_ns, (N, m).

    The result is the y_m of the reference model with `commands`. `y_m` is the y_m of the log. A
    history says in which order the u_m arrived. At first only one history is tried. It gives every
    bit of a flight in one process, where each u_m acts at once. If it does not give every bit, many
    histories are searched.
    """
    expected = _computed(parameters, t_ns, y_m, commands, most=1)
    if (expected != y_m).any():
        return _computed(parameters, t_ns, y_m, commands, most=MOST_HISTORIES)
    return expected


def _computed(
    parameters: ReferenceModelConfig,
    t_ns: np.ndarray[tuple[int], np.dtype[np.int64]],
    y_m: FloatArray,
    commands: Sequence[_Command],
    *,
    most: int,
) -> FloatArray:
    """Return y_m of the reference model at the instants t_ns, (N, m), by at most `most` histories.

    A history says which u_m had arrived before which sample. The argument `y_m` is the y_m of the
    log, (N, m). It only serves to choose the histories that give the right bits.
    """
    histories = [_History(Reference(parameters), 0)]
    max_age_ns = nanoseconds(parameters.live.max_age)
    period_ns = histories[0].reference.period_ns
    numbers = np.maximum(np.round(t_ns / period_ns), 0).astype(np.int64).tolist()
    expected = np.zeros_like(y_m)
    before_ns = 0
    for k, number in enumerate(numbers):
        trials = []
        for history in histories:
            for trial in _next_histories(history, commands, before_ns, max_age_ns):
                sample = trial.reference.sample(number)
                error = float(np.max(np.abs(y_m[k] - sample)))
                # With its arguments in this order, min turns an error that is NaN into inf.
                trials.append((min(np.inf, error), sample, trial))
        trials.sort(key=lambda each: each[0])
        least, expected[k], _ = trials[0]
        # All histories with the right bits are followed. One that took a u_m too early only differs
        # once this u_m differs from the one before. If none has the right bits, those within
        # ROUNDING count as right.
        bound = ROUNDING if 0.0 < least <= ROUNDING else least
        right = [trial for error, _, trial in trials if error <= bound]
        histories = _distinct(right)[:most]
        before_ns = number * period_ns
    return expected


def _next_histories(
    history: _History, commands: Sequence[_Command], before_ns: int, max_age_ns: int
) -> list[_History]:
    """Return the histories that can follow a history, up to the next sample of y_m.

    Since `before_ns`, the time of the last sample, one or more of the next u_m may have arrived.
    For each of these u_m, there is a history in which it is the newest. In a further history, none
    of them has arrived.
    """
    arrived = history.taken
    while arrived < len(commands) and commands[arrived].t_ns <= before_ns + AHEAD_NS:
        arrived += 1
    if arrived == history.taken:
        return [history]
    histories = []
    for count in range(arrived, history.taken, -1):
        if commands[count - 1].t_ns < before_ns - max_age_ns:
            break
        reference = copy.copy(history.reference)
        _take(reference, commands[count - 1])
        histories.append(_History(reference, count))
    return [*histories, history]


def _distinct(histories: Sequence[_History]) -> list[_History]:
    """Remove each history whose state equals the state of an earlier one in the list."""
    if len(histories) == 1:
        return list(histories)
    by_state: dict[tuple[int, bytes, bytes], _History] = {}
    for history in histories:
        reference = history.reference
        state = (history.taken, reference.x_m.tobytes(), reference.rate().tobytes())
        by_state.setdefault(state, history)
    return list(by_state.values())


def _take(reference: Reference, command: _Command) -> None:
    """Pass a u_m to the reference model. As in the node, the model may refuse it."""
    with suppress(ChannelError):
        reference.take(command.t_ns, command.u_m, command.attitude)
