# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Record the outcome of a flight as its end, the reason for it, and the shortfalls.

The headline and the exit status follow from the record, so that nothing has to be parsed from a
sentence.
"""

import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Any

from flight_core.text import bounded

STATUS_BAD_INPUT = 2  # exit status of a command and of a node
STATUS_ENDED_EARLY = 3  # exit status of a command and of a node
STATUS_SHORTFALL = 4  # the flight reached its end, but has a shortfall
STATUS_LANDED = 5  # exit status of only the node of an aircraft, which ends with the landing
STATUS_LOST_CONTACT = 6  # exit status of only a node that ended because another node had ended
STATUS_HOST = 7  # nothing is wrong except that the host was too busy for a flight in real time
STATUS_INTERRUPTED = 130

SEVEREST = (0, STATUS_HOST, STATUS_SHORTFALL, STATUS_ENDED_EARLY, STATUS_INTERRUPTED)
"""Exit statuses of flights, with the severest last. A command that flies several flights ends with
the severest of their statuses."""


HEADLINE = 120  # largest number of characters of a headline, which is one line of a terminal


def _shortened(text: str) -> str:
    """Return a text that fits into a headline."""
    return text if len(text) <= HEADLINE else f"{text[: HEADLINE - 4].rstrip()} ..."


class End(StrEnum):
    """How a flight ended."""

    COMPLETED = "completed"  # the flight reached its duration
    LANDED = "landed"  # the aircraft landed softly, on its wheels
    ENDED_EARLY = "ended early"
    NEVER_FLEW = "never flew"
    INTERRUPTED = "interrupted"  # the user ended the flight
    HOST = "host"  # the host was too busy, so the flight says nothing about the law
    IMPORTED = "imported"  # a log that another program wrote
    UNKNOWN = "unknown"


class Aim(StrEnum):
    """A kind of requirement on a flight.

    The aims whose shortfalls are the most serious come first, because a shortfall of an aim can
    explain shortfalls of the later aims.
    """

    ENGAGEMENT = "engagement"  # the law flies while it should
    REFERENCE = "reference"  # y_m is as the scenario says
    GROUND = "ground"  # the aircraft stays above the ground
    SEPARATION = "separation"  # the aircraft keeps clear of the other aircraft of a fleet
    STALL = "stall"  # the airspeed stays above the stall speed
    FENCE = "fence"  # the aircraft stays inside the fence
    ALTITUDE = "altitude"  # the aircraft stays between the least and the largest altitude
    ERROR = "error"  # the error of each output is at most what the linear loop allows
    TOUCHDOWN = "touchdown"  # the aircraft lands in the zone of the landing
    GUIDANCE = "guidance"  # each step of guidance gives commands
    ROUTE = "route"  # every leg is flown
    ORBIT = "orbit"  # the last orbit is joined
    LOG = "log"  # the log holds the whole flight


@dataclass(frozen=True, kw_only=True)
class Shortfall:
    """A shortfall of a flight, as a sentence and as numbers in SI.

    `brief` replaces the sentence in a headline if the sentence is too long. `times` is the factor
    by which a value exceeds the allowed value. Of several shortfalls of an aim, the one with the
    largest factor is the worst.
    """

    aim: Aim
    sentence: str
    brief: str = ""
    times: float = 1.0
    figures: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Refusal:
    """The reason why something is refused, such as a sample, a model or an engagement.

    `str` gives the reason as a sentence for the user. A function that finds no reason returns None.
    """

    sentence: str

    def __str__(self) -> str:
        """Return the sentence."""
        return self.sentence


def joined(refusals: Iterable[Refusal | None]) -> Refusal | None:
    """Join all different refusals that are not None. Returns None if all are None."""
    found = dict.fromkeys(str(refusal) for refusal in refusals if refusal is not None)
    return Refusal("; ".join(found)) if found else None


@dataclass(frozen=True, kw_only=True)
class Allowance:
    """A large tracking error that is no shortfall.

    The linear loop would have such an error too, because of noise or wind.
    """

    sentence: str
    figures: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Outcome:
    """The outcome of a flight.

    `str` is a headline of at most HEADLINE characters. It says how the flight ended, how many
    shortfalls it has, and which is the worst. `details` are the sentences that did not fit into it.

    Examples:
        >>> tape = rise_di.simulate(rise_di.find_scenario("osprey_servo", duration=0.1))
        >>> str(tape.outcome), tape.outcome.status
        ('completed', 0)
    """

    end: End
    reason: str = ""  # a sentence on the reason, if the end alone does not show it
    shortfalls: tuple[Shortfall, ...] = ()
    # errors that are allowed, and do not change how the flight ended
    allowances: tuple[Allowance, ...] = field(default=(), compare=False)
    # for each output, the error in the worst part of the flight and the error allowed there, SI
    errors: tuple[Mapping[str, Any], ...] = field(default=(), compare=False)

    @property
    def has_reached_end(self) -> bool:
        """Whether the flight reached its duration or landed."""
        return self.end in {End.COMPLETED, End.LANDED}

    @property
    def status(self) -> int:
        """Exit status, which is 0 for a flight that reached its end without a shortfall.

        Spans in which the host was too busy are left out of the judgement, so a shortfall is not
        excused by such spans.
        """
        if self.end is End.INTERRUPTED:
            return STATUS_INTERRUPTED
        if self.end in {End.ENDED_EARLY, End.NEVER_FLEW}:
            return STATUS_ENDED_EARLY
        if self.end is End.HOST and not self.shortfalls:
            return STATUS_HOST
        return STATUS_SHORTFALL if self.shortfalls or self.end is End.UNKNOWN else 0

    def __str__(self) -> str:
        """Return the headline."""
        number = len(self.shortfalls)
        if not number:
            allowed = [each.sentence for each in self.allowances]
            whole = "; ".join([self._begin(), *allowed])
            if allowed and len(whole) > HEADLINE:
                whole = f"{self._begin()}; {len(allowed)} errors allowed for noise or wind"
            return _shortened(whole)
        order = list(Aim)
        worst = min(self.shortfalls, key=lambda each: (order.index(each.aim), -each.times))
        count = "" if number == 1 else f", {number} shortfalls"
        label = "" if number == 1 else "worst: "
        sentences = (worst.sentence, worst.brief or worst.sentence)
        for begin in (self._begin(), self.end.value):
            for sentence in sentences:
                headline = f"{begin}{count}; {label}{sentence}"
                if len(headline) <= HEADLINE:
                    return headline
        return _shortened(headline)

    def _begin(self) -> str:
        """Return the first words of the headline: how the flight ended, and why."""
        if self.end in {End.NEVER_FLEW, End.UNKNOWN} and self.reason:
            return f"{self.end}: {self.reason}"
        return self.reason or self.end.value

    @property
    def details(self) -> tuple[str, ...]:
        """Sentences that are not in the headline."""
        headline = str(self)
        sentences = (
            self._begin(),
            *(each.sentence for each in self.shortfalls),
            *(each.sentence for each in self.allowances),
        )
        return tuple(sentence for sentence in sentences if sentence not in headline)

    def as_json(self) -> dict[str, Any]:
        """Return the record for `summary.json`, with headline, details and exit status."""
        return {
            "end": self.end.value,
            "reason": self.reason,
            "shortfalls": [
                {"aim": each.aim.value, "sentence": each.sentence, "figures": dict(each.figures)}
                for each in self.shortfalls
            ],
            "allowances": [
                {"sentence": each.sentence, "figures": dict(each.figures)}
                for each in self.allowances
            ],
            "errors": [dict(figures) for figures in self.errors],
            "sentence": str(self),
            "details": list(self.details),
            "status": self.status,
        }

    def record(self) -> dict[str, str]:
        """Return what the log stores of the outcome: how the flight ended, and why.

        The shortfalls are left out, because they follow from the log itself.
        """
        return {"end": self.end.value, "reason": self.reason}

    def text(self) -> str:
        """Write the `record` as JSON."""
        return json.dumps(self.record())


COMPLETED = Outcome(End.COMPLETED)
INTERRUPTED = Outcome(End.INTERRUPTED)
UNKNOWN = Outcome(End.UNKNOWN, "neither the run nor the log has one")


def never_flew(reason: str) -> Outcome:
    """Return the outcome of a flight that never began."""
    return Outcome(End.NEVER_FLEW, bounded(reason))


def host_starved(reason: str) -> Outcome:
    """Return the outcome of a flight in real time on a host that was too busy for it."""
    return Outcome(End.HOST, bounded(reason))


def ended_early(reason: str) -> Outcome:
    """Return the outcome of a flight that ended before its duration."""
    return Outcome(End.ENDED_EARLY, bounded(reason))


def log_ends_at(end: float, duration: float) -> Outcome:
    """Return the outcome of a flight of `duration` s whose log ends early.

    The log holds y, y_m and u up to the flight time `end`, s. If `end` is -inf, it holds none.
    """
    part = f"up to t = {end:.3f} of" if end >= 0.0 else "of"
    verb = "holds" if end >= 0.0 else "does not hold"
    return ended_early(f"ended early: the log {verb} y, y_m and u {part} {duration:g} s")


def read_outcome(record: object) -> Outcome:
    """Read the outcome from a `record` of a log or of `summary.json`.

    Returns UNKNOWN if `record` is no such record.
    """
    if not isinstance(record, Mapping):
        return UNKNOWN
    try:
        end = End(record["end"])
        reason = bounded(str(record["reason"]))
    except (KeyError, ValueError):
        return UNKNOWN
    return UNKNOWN if end is End.UNKNOWN else Outcome(end, reason, _of_fleet(record))


def _of_fleet(record: Mapping[str, Any]) -> tuple[Shortfall, ...]:
    """Read the shortfalls of a record that the log of a single aircraft cannot show.

    Such a shortfall is a violated separation in a fleet.
    """
    shortfalls = []
    for each in record.get("shortfalls") or ():
        if isinstance(each, Mapping) and each.get("aim") == Aim.SEPARATION:
            sentence = bounded(str(each.get("sentence", "")))
            figures = each.get("figures")
            figures = dict(figures) if isinstance(figures, Mapping) else {}
            shortfalls.append(Shortfall(aim=Aim.SEPARATION, sentence=sentence, figures=figures))
    return tuple(shortfalls)


def parsed_outcome(text: str) -> Outcome:
    """Read the outcome from a record in JSON. Returns UNKNOWN if the text is no record."""
    try:
        return read_outcome(json.loads(text))
    except ValueError:
        return UNKNOWN


class FlightEnded(RuntimeError):  # noqa: N818 - the end of a flight is not a program error
    """Raised if a flight ends before its duration, with a landing or for another reason.

    The message is a sentence for the user, printable and bounded.
    """

    def __init__(self, sentence: str, end: End = End.ENDED_EARLY) -> None:
        super().__init__(bounded(sentence))
        self.end = end

    @property
    def outcome(self) -> Outcome:
        """The outcome of the flight."""
        return Outcome(self.end, str(self))

    @property
    def status(self) -> int:
        """The exit status of the node."""
        return STATUS_LANDED if self.end is End.LANDED else STATUS_ENDED_EARLY


class LostContact(FlightEnded):
    """Raised if a node ends because another node has ended."""

    @property
    def status(self) -> int:
        """The exit status of the node."""
        return STATUS_LOST_CONTACT
