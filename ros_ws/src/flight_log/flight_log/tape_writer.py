# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Write a Tape as an MCAP bag, without ROS.

A flight in one process and a flight over topics thus leave the same kind of log.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Self

import numpy as np

from flight_core.files import writing
from flight_core.outcome import Outcome
from flight_core.rates import NANOSECONDS
from flight_core.tape import Signal, Tape
from flight_log.bag import OUTCOME, BagChannel, BagWriter, LogAttachments
from flight_log.learning_messages import DIAGNOSTIC_ARRAY, LEARNING, learning_message
from flight_log.named_vectors import JOINT_STATE, Samples, encoded
from flight_log.stored_messages import PARAMETER_EVENT, PARAMETER_EVENTS, parameter_event

EXPECTED = "a writable folder and space on the disk"

DELAY_NS = NANOSECONDS
"""Longest time by which a sample may come late, ns. Samples of the last DELAY_NS are written with
the next part, so that the messages of the log stay in the order of their stamps."""


def write_run(tape: Tape, directory: Path, attachments: LogAttachments) -> Path:
    """Write the tape and the attachments as a bag into a folder, and return its MCAP file's path.

    Raises ParameterError if the bag cannot be written.
    """
    with (
        writing("", directory, EXPECTED),
        TapeWriter(directory, attachments, tape.start_ns) as writer,
    ):
        writer.write(tape.signals)
    return writer.path


class TapeWriter:
    """Writes a flight as a bag, part by part.

    Each sample becomes a message whose log time is its stamp. The messages are in the order of
    time, so the samples of the last DELAY_NS wait for the next part. Raises OSError if the bag
    cannot be written.
    """

    def __init__(self, directory: Path, attachments: LogAttachments, start_ns: int = 0) -> None:
        self._bag = BagWriter(directory)
        try:
            self._bag.add_attachments(attachments, start_ns)
        except BaseException:
            self._bag.close()
            raise
        self._channels: dict[str, BagChannel] = {}
        self._waiting: dict[str, Signal] = {}
        self.path = self._bag.path

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        try:
            self._write(self._waiting)
        finally:
            self._bag.close()

    def write(self, signals: Mapping[str, Signal]) -> None:
        """Write the samples of a part of a flight, by topic."""
        parts = {topic: signal.after(self._waiting.get(topic)) for topic, signal in signals.items()}
        newest_ns = max(
            (int(signal.stamp_ns.max()) for signal in parts.values() if len(signal.stamp_ns)),
            default=0,
        )
        due = {topic: signal.stamp_ns <= newest_ns - DELAY_NS for topic, signal in parts.items()}
        self._waiting = {topic: signal.where(~due[topic]) for topic, signal in parts.items()}
        self._write({topic: signal.where(due[topic]) for topic, signal in parts.items()})

    def write_changes(self, stamp_ns: int, node: str, changes: Mapping[str, Any]) -> None:
        """Write a change of a node's parameters in flight, as the node would publish it."""
        self._write_message(
            PARAMETER_EVENTS, PARAMETER_EVENT, stamp_ns, parameter_event(stamp_ns, node, changes)
        )

    def write_learning(self, stamp_ns: int, kind: str, sentence: str, *, level: int) -> None:
        """Write what became of a learner's proposal, as a controller would publish it.

        `level` is the level of the message, OK or WARN of `learning_messages`.
        """
        message = learning_message(stamp_ns, kind, sentence, level=level)
        self._write_message(f"/{LEARNING}", DIAGNOSTIC_ARRAY, stamp_ns, message)

    def _write_message(self, topic: str, type_name: str, stamp_ns: int, data: bytes) -> None:
        if topic not in self._channels:
            self._channels[topic] = self._bag.add_topic(topic, type_name, "")
        channel = self._channels[topic]
        self._bag.write(channel, stamp_ns, stamp_ns, channel.messages + 1, data)

    def add_outcome(self, outcome: Outcome) -> None:
        """Store the outcome of the flight in the log."""
        self._bag.add_metadata(OUTCOME, outcome.record())

    def _write(self, signals: Mapping[str, Signal]) -> None:
        for topic in signals:
            if topic not in self._channels:
                self._channels[topic] = self._bag.add_topic(f"/{topic}", JOINT_STATE, "")
        messages = [
            encoded(
                Samples(
                    names=part.names,
                    stamp_ns=part.stamp_ns,
                    values=part.values,
                    sender="in_process",
                )
            )
            for part in signals.values()
        ]
        channels = [self._channels[topic] for topic in signals]
        counts = [len(signal.stamp_ns) for signal in signals.values()]
        stamps = np.concatenate([signal.stamp_ns for signal in signals.values()])
        columns = np.repeat(np.arange(len(counts)), counts)
        indexes = np.concatenate([np.arange(count) for count in counts])
        order = np.argsort(stamps, kind="stable")
        for stamp_ns, column, index in zip(
            *(values[order].tolist() for values in (stamps, columns, indexes)), strict=True
        ):
            channel = channels[column]
            self._bag.write(
                channel, stamp_ns, stamp_ns, channel.messages + 1, messages[column][index].tobytes()
            )
