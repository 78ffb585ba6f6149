# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Read faults of effectors from a list of sentences in a scenario, as arrays of `actuators`.

    faults: [aileron lost 60, elevator weak 60 0.3, rudder hard_over 20 upper]

A fault is INPUT KIND AT, with AT in s of flight time. Some kinds also state how strong the fault
is.
"""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from flight_core.parameters import LARGEST, one_of, require
from flight_core.vectors import FloatArray


class FaultKind(NamedTuple):
    """A kind of fault: its fields in `actuators.Actuators`, and the range of its strength."""

    begin: str
    strength: str = ""  # field of the strength; "" if the kind has no strength
    default: float = math.nan  # default of the strength; nan if the fault must state its strength
    least: float = 0.0
    most: float = LARGEST


HARD_OVER = "hard_over"
ENDS = ("lower", "upper")
"""Ends to which an effector can run away, which are also the keys of its end stops."""

KINDS = {
    "stuck": FaultKind("stuck_at"),
    "lost": FaultKind("lost_at"),
    "failed": FaultKind("lost_at"),
    HARD_OVER: FaultKind("hard_over_at", "hard_over_to"),
    "weak": FaultKind(begin="weak_at", strength="weak_effect", default=0.5, least=-2.0, most=2.0),
    "slow": FaultKind("slow_at", "slow_lag", 0.2),
    "loose": FaultKind("loose_at", "loose_play", 0.01),
}
"""The kinds of faults. These strengths hold if a sentence states none: `weak` leaves half of the
effect. `slow` has the lag 0.2 s, ten times the lag of a servo of the osprey. `loose` has the
half-width 0.01, which is 0.57 deg or 1 % of thrust."""

STOPPED = frozenset({"stuck", "lost", "failed", HARD_OVER})
"""The kinds after which an input no longer follows u."""

FORM = "INPUT KIND AT, as aileron lost 60"


class Fault(NamedTuple):
    """A fault of an effector, as read from a sentence."""

    input: str
    kind: str
    at: float  # s of flight time
    strength: float | None = None  # SI; None for a kind without a strength
    end: str = ""  # end of a runaway: one of ENDS

    @property
    def subject(self) -> str:
        """Subject of a sentence, such as "aileron lost"."""
        return f"{self.input} {self.kind}"

    @property
    def extent(self) -> str:
        """Strength of the fault as text, or "" for a kind without a strength."""
        return self.end or ("" if self.strength is None else f"{self.strength:g}")


def read_fault(sentence: str, key: str) -> Fault:
    """Read a fault from a sentence. Raises ParameterError if it does not have the FORM."""
    words = sentence.split()
    require(len(words) in {3, 4}, key, repr(sentence), FORM)
    name, kind_name, at, *how = words
    require(kind_name in KINDS, key, repr(kind_name), one_of(tuple(KINDS), kind_name))
    kind = KINDS[kind_name]
    begin = _number(at, key, "a time in s, as 60")
    require(begin >= 0.0, key, f"{begin:g} s", "a time from 0 on")
    if kind_name == HARD_OVER:
        end = how[0] if how else "no end stop"
        require(end in ENDS, key, end, f"{name} {kind_name} {at} lower, or upper")
        return Fault(name, kind_name, begin, end=end)
    require(not how or bool(kind.strength), key, repr(sentence), f"{name} {kind_name} {at} alone")
    if not kind.strength:
        return Fault(name, kind_name, begin)
    strength = _number(how[0], key, f"{kind.strength} as a number") if how else kind.default
    bounds = f"{kind.strength} from {kind.least:g} to {kind.most:g}"
    require(kind.least <= strength <= kind.most, key, f"{strength:g}", bounds)
    return Fault(name, kind_name, begin, strength)


def _number(word: str, key: str, expected: str) -> float:
    try:
        value = float(word)
    except ValueError:
        value = math.nan
    require(math.isfinite(value), key, repr(word), expected)
    return value


def require_possible(
    faults: Sequence[Fault],
    stops: dict[str, Sequence[float]],
    inputs: Sequence[str],
    no_thrust: FloatArray,
    owner: str,
) -> None:
    """Check that the inputs of `owner` can have the given faults. Raises ParameterError if not.

    `stops` has the end stops by ENDS. `no_thrust` has the position of each input at which it gives
    no thrust, nan if unknown, and 0 for a surface.
    """
    effects = [(fault.input, KINDS[fault.kind].begin) for fault in faults]
    for number, fault in enumerate(faults):
        key = f"actuators.faults[{number}]"
        require(fault.input in inputs, key, repr(fault.input), one_of(tuple(inputs), fault.input))
        is_first = effects.index(effects[number]) == number
        require(is_first, key, f"a second fault {fault.kind} of {fault.input}", "one of each kind")
        place = list(inputs).index(fault.input)
        position = no_thrust[place]
        meant = f"{fault.subject} at {fault.at:g} s"
        if fault.kind in {"lost", "failed", "weak"}:
            meaning = "its value without thrust, from trim; 0 for a surface"
            expected = f"no_thrust of {fault.input} in {owner}: {meaning}"
            require(bool(np.isfinite(position)), key, meant, expected)
        is_surface = position == 0.0
        require(fault.kind != "failed" or is_surface == 0.0, key, meant, "lost, of a surface")
        require(fault.kind != "lost" or is_surface, key, meant, "failed, of a thrust")
        if fault.kind == HARD_OVER:
            values = stops[fault.end]
            is_bounded = bool(values) and math.isfinite(values[place])
            expected = f"an end stop of {fault.input} in actuators.{fault.end}"
            require(is_bounded, key, meant, expected)


def arrays(
    faults: Sequence[Fault], stops: dict[str, Sequence[float]], inputs: Sequence[str]
) -> dict[str, Any]:
    """Return the faults as fields of `actuators.Actuators`, each of shape (m,).

    If an input never has a fault of some kind, the time of this fault is infinite.
    """
    columns: dict[str, Any] = {}
    for fault in faults:
        kind = KINDS[fault.kind]
        place = list(inputs).index(fault.input)
        begins = columns.setdefault(kind.begin, np.full(len(inputs), np.inf))
        begins[place] = min(begins[place], fault.at)
        if kind.strength:
            strengths = columns.setdefault(kind.strength, np.zeros(len(inputs)))
            strengths[place] = stops[fault.end][place] if fault.end else fault.strength
    return columns
