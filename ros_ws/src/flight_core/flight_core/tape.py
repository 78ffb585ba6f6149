# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Define the tape, which is the log of a flight in memory.

A tape comes from a flight in a single process, from a flight over topics, or from a bag, which is a
log of ROS 2.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from flight_core.arguments import as_instance
from flight_core.outcome import COMPLETED, Outcome
from flight_core.parameters import ParameterError, require
from flight_core.rates import NANOSECONDS
from flight_core.vectors import FloatArray


@dataclass(frozen=True)
class Signal:
    """The N samples of a topic in k named channels, in SI units and radians.

    Attributes:
        stamp_ns: Instants of the samples, shape (N,), int64, ns, ascending.
        names: The k channels.
        values: Samples, shape (N, k). In a log, each channel is contiguous in memory.
        sender: Number of the publisher of each sample, shape (N,). Publishers are numbered in the
            order of their first samples. None if there is one publisher.

    Examples:
        >>> q = rise_di.Signal(np.array([0, 2_000_000]), ("q",), np.array([[0.0], [0.1]]))
        >>> q["q"].tolist(), q.until(0)["q"].tolist()
        ([0.0, 0.1], [0.0])
    """

    stamp_ns: NDArray[np.int64]
    names: tuple[str, ...]
    values: FloatArray
    sender: NDArray[np.int16] | None = None

    def __getitem__(self, name: str) -> FloatArray:
        """Return the samples of a channel, (N,), or raise ParameterError with the channels."""
        if name not in self.names:
            raise ParameterError(
                f"the log: found no channel {name} among {', '.join(self.names)}, expected one"
            )
        return self.values[:, self.names.index(name)]

    def until(self, end_ns: int) -> "Signal":
        """Return the samples up to and including an instant.

        Args:
            end_ns: The last instant, ns.

        Returns:
            The signal, values of shape (n, k).
        """
        count = int(np.searchsorted(self.stamp_ns, end_ns, side="right"))
        sender = None if self.sender is None else self.sender[:count]
        return Signal(self.stamp_ns[:count], self.names, self.values[:count], sender)

    def where(self, keep: NDArray[np.bool_]) -> "Signal":
        """Return the samples where a mask is True.

        Args:
            keep: Mask, shape (N,), bool.

        Returns:
            The signal, values of shape (n, k).
        """
        sender = None if self.sender is None else self.sender[keep]
        return Signal(self.stamp_ns[keep], self.names, self.values[keep], sender)

    def after(self, earlier: "Signal | None") -> "Signal":
        """Return the signal with the samples of an earlier signal, if any, in front.

        Args:
            earlier: A signal with the same channels, or None.

        Returns:
            The signal, values of shape (n, k).
        """
        if earlier is None:
            return self
        stamp_ns = np.concatenate([earlier.stamp_ns, self.stamp_ns])
        return Signal(stamp_ns, self.names, np.concatenate([earlier.values, self.values]))

    def within(self, windows: Sequence[tuple[int, int]]) -> "Signal":
        """Return the samples that lie in any of some windows of time.

        Args:
            windows: First and last instant of each window, ns.

        Returns:
            The signal, values of shape (n, k).
        """
        inside = [(self.stamp_ns >= first) & (self.stamp_ns <= last) for first, last in windows]
        keep = (
            np.logical_or.reduce(inside, axis=0)
            if inside
            else np.zeros(len(self.stamp_ns), dtype=bool)
        )
        return self.where(keep)

    def group(self, prefix: str) -> "Signal":
        """Return the channels "prefix.name" as a signal with channels "name".

        Args:
            prefix: The part of the names before the dot.

        Returns:
            The signal of the group, values of shape (N, number of channels).
        """
        columns = [i for i, name in enumerate(self.names) if name.startswith(prefix + ".")]
        names = tuple(self.names[i].removeprefix(prefix + ".") for i in columns)
        # If the channels are adjacent, a slice selects them without a copy.
        adjacent = bool(columns) and columns[-1] - columns[0] < len(columns)
        return Signal(
            self.stamp_ns,
            names,
            self.values[:, slice(columns[0], columns[-1] + 1) if adjacent else columns],
            self.sender,
        )


class Recording(NamedTuple):
    """What the stamps of a topic's messages show, in the order of the recording.

    If the clock of the stamps steps, the signal ends before the step. Samples without a usable
    stamp are left out of the signal, too.
    """

    found: int  # number of messages
    unset: int = 0  # number of stamps that are zero or far from their neighbours
    repeated: int = 0  # number of stamps that equal the stamp of the message before
    step_ns: int = 0  # the first step of the clock, negative for a step back, or 0 if there is none
    step_at_ns: int = 0  # the last stamp before the step
    left_out: int = 0  # number of messages after the step
    # number of messages that the publisher's numbering shows as lost, or None without numbers
    lost: int | None = None
    # The last stamp before each pause that the stamps and the times of reception both show. Such a
    # pause is no step of the clock.
    pauses_ns: tuple[int, ...] = ()


@dataclass(frozen=True, kw_only=True)
class Process:
    """A process of a flight. Stamps are in ns, and None if unknown or if there is no sample."""

    ready_ns: int | None  # instant at which its event loop began
    first_ns: int | None  # stamp of its first sample
    last_ns: int | None  # stamp of its last sample
    samples: int | None = None  # number of its samples on the topics of the aircraft


@dataclass(frozen=True, kw_only=True)
class LostPart:
    """A part of a flight that is missing in its log, and why.

    A file, the end of a file, or the time of a forward step of the clock may be missing.
    """

    sentence: str
    # True if the end of a file is lost. If the flight has a planned end, this also shows by the
    # samples that are missing before the planned end.
    is_end: bool = False


@dataclass(frozen=True)
class Tape:
    """The log of a flight in memory, which has signals by topic name.

    `start_ns` is the stamp of flight time t = 0, and `outcome` comes from flight_core.outcome. A
    flight of `simulate` also has its `scenario`, and the `changes` of the controller's parameters
    in flight. The tape of a log also has the `recording` by topic, the `processes` by name, and how
    many samples of a topic were `refused`. The `duration` of the whole flight, s, is there too, if
    it is known. `is_by_clock` says whether the flight followed the simulated time of /clock.
    `lost_parts` are parts that the log lost, which the `notes` mention as well. `account` is what
    `rise_di.read_run` found in the log, and what the log lacks.

    Examples:
        >>> tape = rise_di.simulate(rise_di.find_scenario("osprey_servo", duration=0.1))
        >>> tape["y"].names, tape.time("y")[-1].item()
        (('q', 'V', 'p', 'r'), 0.1)
    """

    signals: Mapping[str, Signal]
    start_ns: int = 0
    notes: tuple[str, ...] = ()
    outcome: Outcome = COMPLETED
    scenario: object = None
    recording: Mapping[str, Recording] = field(default_factory=dict)
    duration: float | None = None
    changes: tuple[Mapping[str, Any], ...] = ()
    processes: Mapping[str, Process] = field(default_factory=dict)
    refused: Mapping[str, int] = field(default_factory=dict)
    account: Any = None
    is_by_clock: bool = False
    lost_parts: tuple[LostPart, ...] = ()

    def __getitem__(self, topic: str) -> Signal:
        """Return the signal of a topic, or raise ParameterError with the list of topics."""
        if topic not in self:
            raise ParameterError(
                f"the log: found no topic {topic} among {', '.join(self.signals) or 'none'}, "
                "expected one"
            )
        return self.signals[topic]

    def __contains__(self, topic: object) -> bool:
        return isinstance(topic, str) and topic in self.signals

    def time(self, topic: str) -> FloatArray:
        """Return the flight times of the samples of a topic: t = (stamp - start) / 1e9.

        Args:
            topic: Name of the topic.

        Returns:
            The times, shape (N,), s.

        Raises:
            ParameterError: The tape has no such topic.
        """
        return (self[topic].stamp_ns - self.start_ns) / NANOSECONDS


def refusal_note(topic: str, count: int) -> str:
    """Return the note about refused samples of a topic."""
    return f"{topic}: {count} samples refused: damaged, not finite, or of other channels"


def as_tape(value: object) -> Tape:
    """Return the value if it is a Tape with samples, or raise ParameterError."""
    tape = as_instance(
        value,
        Tape,
        "tape",
        "a Tape, as simulate returns one and as a RecordedRun has one: run.tape",
    )
    require(bool(tape.signals), "tape", "no topic", "a flight")
    return tape
