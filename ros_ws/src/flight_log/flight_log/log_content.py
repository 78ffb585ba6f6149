# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Read the content of a bag's files: samples by topic, scenario, attachments, metadata, notes."""

import re
import shlex
from collections import Counter, defaultdict
from collections.abc import Callable, Mapping
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from mcap.records import Attachment, Channel, McapRecord, Metadata, Schema
from numpy.typing import NDArray

from flight_core.files import is_file, is_folder
from flight_core.parameters import ParameterError
from flight_core.rates import NANOSECONDS, seconds
from flight_core.tape import LostPart, Recording, Signal
from flight_core.text import printable
from flight_log.age_of_u import DIAGNOSTICS, IN_MESSAGE
from flight_log.bag import (
    LOST_MESSAGES,
    SCENARIO_MEDIA_TYPE,
    SILENCES,
    SIMULATED_TIME,
    stack_topic,
)
from flight_log.clock import LATE_NS, SINCE_EPOCH_NS, StampClock
from flight_log.columns import Columns
from flight_log.flight_processes import SampleSpan
from flight_log.latency import TOPICS as TIMED_TOPICS
from flight_log.latency import Times
from flight_log.learning_messages import DIAGNOSTIC_ARRAY
from flight_log.log_messages import StoredText, has_texts
from flight_log.named_vectors import (
    PATH,
    STAMP,
    Decoder,
    Table,
    decode_routes,
    decoder,
    full_name,
    rows_by_sender,
    stamps_of,
)
from flight_log.open_log import (
    A_RUN,
    ROSBAG2,
    log_files,
    missing_parts,
    open_scan,
    plain_batches,
)
from flight_log.rosbag2_metadata import METADATA, bag_files, read_bag_metadata
from flight_log.scan import MessageBatch

ROUTE = "route"


# Number of messages that are decoded together. With 1024, the memory of a table would not be reused
# for the next one.
BATCH = 512


# Least difference between a stamp and its time of sending that shows a step of the system clock. A
# smaller difference is only the age of the sample.
LEAST_CLOCK_STEP_NS = NANOSECONDS


RESTING = ("u", "internals")  # topics whose stamps may repeat during a failsafe


UNSTAMPED = ("route",)  # topics that are often published without a stamp


SCENARIO_NAME = re.compile(r"(?!metadata\.yaml)[\w-][\w .()-]{0,99}\.yaml")
"""Permitted names of the file into which the scenario of a log is written, in the folder of the
log. A name must be neither metadata.yaml nor a path to another folder."""


MOST_PUBLISHERS = 64  # largest number of publishers of a topic that are counted separately


class StoredFile(NamedTuple):
    """A file that is attached to a log."""

    name: str
    content: bytes


class _Publisher:
    """The messages of a publisher on a topic.

    It holds the messages that are not decoded yet, and counts all messages.
    """

    def __init__(self) -> None:
        # Tables of messages of equal length, with their log times and the steps of their numbers.
        self.batch: list[tuple[Table, NDArray[np.int64], NDArray[np.int64]]] = []
        self.batched = 0  # number of messages in `batch`
        self.clock = StampClock()
        self.name: str | None = None  # name of the publisher; None before its first sample
        self.zeros = 0  # number of samples with a zero stamp that `signal` leaves out
        self.refused = 0  # number of samples that are damaged or not finite
        # number of samples with each set of channels
        self.kept: Counter[tuple[str, ...]] = Counter()
        self.messages = 0
        # least and largest time by which a stamp is later than the reception of its message; None
        # if the log has no times of reception
        self.leads_ns: tuple[int, int] | None = None
        self._number: int | None = None  # number of the last message by the publisher
        self._numbered = self._restarted = False
        self._lost = 0

    def add(self, table: Table, log_ns: NDArray[np.int64], sequence: NDArray[np.int64]) -> None:
        """Add messages of one length."""
        steps = np.diff(sequence, prepend=sequence[:1] if self._number is None else self._number)
        self._lost += int((steps[steps > 1] - 1).sum())
        self._numbered = self._numbered or bool(sequence.any())
        self._number = int(sequence[-1])
        # If a number falls, the publisher has restarted under the same name.
        self._restarted = self._restarted or bool(np.any(steps < 0))
        self.messages += len(table)
        self.batch.append((table, log_ns, steps))
        self.batched += len(table)

    def lead(self, table: Table, log_ns: NDArray[np.int64]) -> None:
        """Note how far the stamps of messages are ahead of their reception."""
        leads_ns = stamps_of(table)[log_ns != 0] - log_ns[log_ns != 0]
        if len(leads_ns):
            least, largest = self.leads_ns or (2**62, -(2**62))
            self.leads_ns = min(least, int(leads_ns.min())), max(largest, int(leads_ns.max()))

    def has_clock_of(self, other: "_Publisher") -> bool:
        """Return whether two publishers may have stamped their messages by the same clock."""
        if self is other or self.leads_ns is None or other.leads_ns is None:
            return True
        (least, largest), (least_of_other, largest_of_other) = self.leads_ns, other.leads_ns
        return least_of_other - LATE_NS <= least and largest <= largest_of_other + LATE_NS

    def recording(self) -> Recording:
        """Return what the check of the stamps has found, in the order of the recording."""
        is_counted = self._numbered and not self._restarted
        return self.clock.recording(self.zeros)._replace(lost=self._lost if is_counted else None)


class TopicSamples:
    """The samples of a topic, decoded in batches.

    The signal has the samples with the channels of the publisher that has the most samples (see
    `_names`), and the other samples are refused. Steps of the clock, lost numbers and damage are
    counted for each publisher, so that the faults of a foreign publisher are not attributed to
    another one.
    """

    def __init__(self, decode: Decoder, expected: int) -> None:
        self._decode = decode
        self._expected = expected
        self._publishers: dict[bytes, _Publisher] = {}  # by the bytes of their names
        self._samples: dict[tuple[str, ...], Columns] = {}  # by the names of the channels
        self.spans: dict[str, SampleSpan] = {}  # by the name of the publisher

    def add(self, table: Table, log_ns: NDArray[np.int64], sequence: NDArray[np.int64]) -> None:
        """Add messages of equal length, one per row, with their log times and sequence numbers."""
        for sender, rows in rows_by_sender(table):
            # A log with very many publishers may be an attack.
            known = sender in self._publishers or len(self._publishers) < MOST_PUBLISHERS
            publisher = self._publishers.setdefault(sender if known else b"", _Publisher())
            part = table if rows is None else table[rows]
            fits = not publisher.batch or publisher.batch[0][0].shape[1] == part.shape[1]
            if publisher.batched >= BATCH or not fits:
                self._decode_batch(publisher, more=fits)
            if rows is None:
                publisher.add(part, log_ns, sequence)
            else:
                publisher.add(part, log_ns[rows], sequence[rows])

    def _decode_batch(
        self, publisher: _Publisher, *, more: bool = False, end: bool = False
    ) -> None:
        if not publisher.batch:
            return
        table, log_ns, steps = (
            np.concatenate(arrays) for arrays in zip(*publisher.batch, strict=True)
        )
        publisher.batch = []
        publisher.batched = 0
        if table.shape[1] >= STAMP.stop:
            keep, count = publisher.clock.usable(
                stamps_of(table), log_ns, steps, more=more, end=end
            )
            if count < len(table):
                publisher.batch = [(table[count:], log_ns[count:], steps[count:])]
                publisher.batched = len(table) - count
            publisher.lead(table[:count][keep], log_ns[:count][keep])
            table = table[:count] if keep.all() else table[:count][keep]
        if not len(table):
            return
        decoded = self._decode(table)
        publisher.refused += decoded.unreadable
        for samples in decoded.samples:
            stamps, sender = samples.stamp_ns, samples.sender
            count = samples.values.shape[1]
            if count == len({*samples.names}) == len(samples.names):
                names, values = self._ordered(samples.names, samples.values)
                finite = np.isfinite(values).all(axis=1)
                publisher.refused += int(np.count_nonzero(~finite))
                stamp_ns, values = (
                    (stamps, values) if finite.all() else (stamps[finite], values[finite])
                )
                if not len(stamp_ns):
                    continue
                span = SampleSpan(
                    first_ns=int(stamp_ns.min()), last_ns=int(stamp_ns.max()), samples=len(stamp_ns)
                )
                self.spans[sender] = (
                    span.joined(self.spans[sender]) if sender in self.spans else span
                )
                publisher.name = sender
                publisher.kept[names] += len(stamp_ns)
                if names not in self._samples:
                    # Samples with other names are few, except in a hostile log.
                    expected = 0 if self._samples else self._expected
                    self._samples[names] = Columns(len(names), max(expected, len(values)))
                self._samples[names].append(stamp_ns, values, sender)
            else:
                publisher.refused += len(stamps)

    def _ordered(
        self, names: tuple[str, ...], values: NDArray[np.float64]
    ) -> tuple[tuple[str, ...], NDArray[np.float64]]:
        """Return names and values in the order of the first sample with the same set of names.

        Values are matched by name.
        """
        for first_names in self._samples:
            if first_names != names and sorted(first_names) == sorted(names):
                return first_names, values[:, [names.index(name) for name in first_names]]
        return names, values

    def signal(self, name: str) -> Signal | None:
        """Return the samples of a topic in the order of the stamps, or None if none has a stamp.

        A publisher that sets no stamps leaves its stamps at 0, and these samples are left out. But
        a single stamp of 0 may be the flight time 0. So may several stamps of 0 in RESTING topics,
        whose stamps may repeat. UNSTAMPED topics need no stamp.
        """
        for publisher in self._publishers.values():
            while publisher.batch:
                self._decode_batch(publisher, end=True)
        if not self._samples:
            return None
        names = self._names()
        columns = self._samples[names]
        signal = columns.signal(tuple(map(printable, names)))
        keep = ~self._is_unset(name, signal, columns)
        # The nodes refuse a publisher whose stamps are far from their clock.
        most = self._most()
        for publisher in self._publishers.values():
            if publisher.name in columns.senders and not publisher.has_clock_of(most):
                keep &= signal.sender != columns.senders.index(publisher.name)
        if not keep.all():
            signal = signal.where(keep)
            if not len(signal.stamp_ns):
                return None
        if np.any(signal.stamp_ns[1:] < signal.stamp_ns[:-1]):
            order = np.argsort(signal.stamp_ns, kind="stable")
            stamps = signal.stamp_ns[order]
            values = signal.values[order]
            # A span of the log may be present twice.
            again = (np.diff(stamps) == 0) & (np.diff(values, axis=0) == 0.0).all(axis=1)
            keep = np.append(True, ~again)
            sender = None if signal.sender is None else signal.sender[order][keep]
            signal = Signal(stamps[keep], signal.names, values[keep], sender)
        return signal

    def _is_unset(self, name: str, signal: Signal, columns: Columns) -> NDArray[np.bool_]:
        """Return a mask of the samples whose stamp was left at zero, shape (N,).

        The number of these samples is also stored for each publisher.
        """
        unset = np.zeros(len(signal.stamp_ns), dtype=np.bool_)
        if name in UNSTAMPED or not np.any(signal.stamp_ns == 0):
            return unset
        for number, sender in enumerate(columns.senders):
            of_sender = slice(None) if signal.sender is None else signal.sender == number
            stamps = signal.stamp_ns[of_sender]
            zero = stamps == 0
            zeros = int(np.count_nonzero(zero))
            usual = len(stamps) - 1 if name in RESTING else 1
            # A recorder may store each message twice.
            if zeros > usual:
                usual = int(np.unique(stamps[~zero], return_counts=True)[1].max(initial=usual))
            if zeros and (zeros > max(usual, 1) or stamps.max() > SINCE_EPOCH_NS):
                unset[of_sender] = zero
                for publisher in self._publishers.values():
                    if publisher.name == sender:
                        publisher.zeros = zeros
        return unset

    def _most(self) -> _Publisher:
        """Return the publisher with the most samples."""
        return max(self._publishers.values(), key=lambda publisher: publisher.kept.total())

    def _names(self) -> tuple[str, ...]:
        """Return the names of the channels of the publisher with the most samples.

        If its samples have different names, the result is the most frequent set that includes the
        names of the first sample.
        """
        most = self._most()
        first = next(iter(most.kept))
        return max(
            (names for names in most.kept if set(first) <= set(names)), key=most.kept.__getitem__
        )

    def of_flight(self, signal: Signal | None) -> list[_Publisher]:
        """Return the publishers whose samples the nodes admit.

        If there is no signal, all publishers are returned.
        """
        publishers = [*self._publishers.values()]
        if signal is None or not self._samples:
            return publishers
        columns = self._samples[self._names()]
        numbers = [0] if signal.sender is None else np.unique(signal.sender).tolist()
        names = {columns.senders[number] for number in numbers}
        return [publisher for publisher in publishers if publisher.name in names]

    def further_publishers(self, signal: Signal | None) -> list[str]:
        """Return the names of the publishers that are not admitted. A name may be ""."""
        of_flight = self.of_flight(signal)
        return [
            sender[:-1].decode(errors="replace") if publisher.name is None else publisher.name
            for sender, publisher in self._publishers.items()
            if publisher not in of_flight
        ]

    def has_overlap(self) -> bool:
        """Return whether two publishers sent samples at the same time."""
        spans = sorted(self.spans.values())
        return any(before.last_ns >= after.first_ns for before, after in pairwise(spans))

    def recording(self, signal: Signal | None = None) -> Recording:
        """Return what was found about the stamps of the flight. Call `signal` first."""
        recordings = [publisher.recording() for publisher in self.of_flight(signal)]
        if len(recordings) == 1:
            return recordings[0]
        step = next((each for each in recordings if each.step_ns), Recording(0))
        return Recording(
            found=sum(each.found for each in recordings),
            unset=sum(each.unset for each in recordings),
            repeated=sum(each.repeated for each in recordings),
            step_ns=step.step_ns,
            step_at_ns=step.step_at_ns,
            left_out=sum(each.left_out for each in recordings),
            lost=None,
            pauses_ns=tuple(sorted(set().union(*(each.pauses_ns for each in recordings)))),
        )

    def refused(self, signal: Signal | None = None) -> int:
        """Count the samples of the flight that are damaged, not finite, or of other channels."""
        names = self._names() if self._samples else ()
        return sum(
            publisher.refused + publisher.kept.total() - publisher.kept[names]
            for publisher in self.of_flight(signal)
        )


class LogContent:
    """The content of the files of a bag."""

    def __init__(self, stack_names: Mapping[str, str]) -> None:
        self.stack_names = stack_names
        self.topics: dict[str, TopicSamples] = {}  # by full topic name
        self.notes: list[str] = []
        self.scenario: StoredFile | None = None
        self.metadata: dict[str, Mapping[str, str]] = {}
        self.attachments: list[StoredFile] = []
        self.truncated: list[str] = []  # names of the truncated files
        self.missing: LostPart | None = None  # number and names of files that the folder lacks
        self.last_ns = 0  # log time of the last message
        self.known_end_ns = 0  # latest log time in any index or in the metadata
        # stamps and times of sending of y and u, by full topic name
        self.sent = defaultdict[str, list[Times]](list)
        self.texts: list[StoredText] = []  # messages that hold text
        self.diagnostics: list[bytes] = []  # messages of /diagnostics with an age of u
        self.times: Times | None = None  # times of the last batch of y or u
        self.kinds: dict[str, str] = {}  # types of all topics, by full name

    def reader_of(
        self, topic: str, type_name: str, expected: int
    ) -> Callable[[MessageBatch], None] | None:
        """Return a function that takes the messages of a topic, or None if the topic is not used.

        `expected` is the number of messages in the index.
        """
        samples = self.samples_of(topic, type_name, expected)
        is_timed = topic.rpartition("/")[2] in TIMED_TOPICS
        if samples is not None:

            def take(batch: MessageBatch) -> None:
                samples.add(batch.data, batch.log_ns, batch.sequence)
                if is_timed and batch.data.shape[1] >= STAMP.stop:
                    self.times = Times(stamps_of(batch.data), batch.sent_ns)
                    if batch.publish_ns.all():
                        self.sent[topic].append(self.times)

            return take
        if topic == DIAGNOSTICS and type_name == DIAGNOSTIC_ARRAY:
            return lambda batch: self.diagnostics.extend(
                data for data in map(bytes, batch.data) if IN_MESSAGE in data
            )
        if has_texts(topic, type_name):
            return lambda batch: self.texts.extend(
                StoredText(
                    topic=topic,
                    type_name=type_name,
                    sent_ns=self._time_of_stamps(sent_ns),
                    data=data,
                )
                for sent_ns, data in zip(batch.sent_ns, map(bytes, batch.data), strict=True)
            )
        return None

    def _time_of_stamps(self, sent_ns: np.int64) -> int:
        """Convert a time of sending to the clock of the stamps.

        The two clocks differ if the system clock is set in flight, because the nodes keep their
        time.
        """
        if self.times is not None:
            nearest = np.argmin(np.abs(self.times.sent_ns - sent_ns))
            offset_ns = self.times.sent_ns[nearest] - self.times.stamp_ns[nearest]
            if abs(offset_ns) > LEAST_CLOCK_STEP_NS:
                return int(sent_ns - offset_ns)
        return int(sent_ns)

    def samples_of(self, topic: str, type_name: str, expected: int = 0) -> TopicSamples | None:
        """Return the samples of a topic.

        Returns None if its type is no named vector and no waypoints.
        """
        is_route = topic.rpartition("/")[2] == ROUTE and type_name == PATH
        if (
            topic not in self.topics
            and (decode := decode_routes if is_route else decoder(type_name)) is not None
        ):
            self.topics[topic] = TopicSamples(decode, expected)
        return self.topics.get(topic)

    def add(self, record: McapRecord) -> None:
        """Add an attachment or a metadata record."""
        if isinstance(record, Metadata):
            self.metadata[record.name] = record.metadata
        elif isinstance(record, Attachment):
            name = Path(record.name).name
            if record.media_type == SCENARIO_MEDIA_TYPE:
                self.scenario = StoredFile(
                    name if SCENARIO_NAME.fullmatch(name) else "scenario.yaml", record.data
                )
            else:
                self.attachments.append(StoredFile(name, record.data))

    def truncated_at(self, end: float | None) -> list[LostPart]:
        """Return which parts of the flight are lost at the ends of truncated files.

        `end` is the flight time of the last sample, s; None if there is no sample.
        """
        where = "" if end is None else f", t = {end:.3f} s"
        text = f"is truncated: read up to its last complete chunk{where}"
        return [LostPart(sentence=f"{name} {text}", is_end=True) for name in self.truncated]

    def notes_at(self, end: float | None) -> list[str]:
        """Return the notes about the log.

        `end` is the flight time of the last sample, s; None if there is no sample.
        """
        missing = seconds(self.known_end_ns - self.last_ns)
        more = f"; {missing:.3f} s are missing after it" if missing > 0 and self.last_ns else ""
        truncated = [f"{lost.sentence}{more}" for lost in self.truncated_at(end)]
        losses = [
            f"{topic}: the recorder lost {count} messages"
            for topic, count in self.metadata.get(LOST_MESSAGES, {}).items()
        ]
        silent = [
            f"{topic}: the recorder received nothing {text}"
            for topic, text in self.metadata.get(SILENCES, {}).items()
        ]
        simulated = []
        if (clock := self.metadata.get(SIMULATED_TIME)) is not None:
            speed = f", at {clock['speed']} times real time" if "speed" in clock else ""
            simulated = [f"flown by the simulated time of {clock.get('topic', '')}{speed}"]
        return [*truncated, *self.notes, *losses, *silent, *simulated]


def read_content(run: Path, stack_names: Mapping[str, str]) -> LogContent:
    """Read every file of a bag.

    `stack_names` has full names of the stack by topic of the log. Raises ParameterError if the path
    has no log, or if a file cannot be read.
    """
    log = LogContent(stack_names)
    files = log_files(run)
    if is_folder(run):
        for folder in dict.fromkeys(file.parent for file in files):
            _add_metadata(folder, log)
    for file in files:
        _read_file(file, log)
    return log


def _add_metadata(folder: Path, log: LogContent) -> None:
    """Add what metadata.yaml says about a bag.

    If the file cannot be read, a note names the repair command.
    """
    information: Mapping[str, Any] = {}
    try:
        information, end_ns = read_bag_metadata(folder)
        log.known_end_ns = max(log.known_end_ns, end_ns)
    except ParameterError:
        fault = "cannot be read" if is_file(folder / METADATA) else "is missing"
        is_plain = bag_files(folder)[0].suffix == ".mcap"
        mend = f": rise-di report --repair {shlex.quote(str(folder))}" if is_plain else ""
        log.notes.append(f"{METADATA} {fault}{mend}")
    if missing := missing_parts(bag_files(folder), information):
        evidence = f"named in {METADATA}" if information else "a number before the last"
        log.missing = LostPart(sentence=f"{', '.join(missing)}: {evidence} and missing")
        log.notes.append(f"{log.missing.sentence}; the log is a part of the recording")


def _read_file(file: Path, log: LogContent) -> None:
    channels: dict[int, Callable[[MessageBatch], None]] = {}
    schemas: dict[int, str] = {}
    before_ns = log.last_ns
    first_ns = 2**63
    try:
        with open_scan(file) as scan:
            for record in scan.batches():
                if isinstance(record, MessageBatch):
                    log.last_ns = max(log.last_ns, int(record.log_ns.max()))
                    first_ns = min(first_ns, int(record.log_ns.min()))
                    if (take := channels.get(record.channel_id)) is not None:
                        for batch in plain_batches(record):
                            take(batch)
                elif isinstance(record, Schema):
                    schemas[record.id] = record.name
                elif isinstance(record, Channel):
                    expected = scan.message_counts.get(record.id, 0)
                    type_name = schemas.get(record.schema_id, "")
                    is_cdr = record.message_encoding == "cdr"
                    topic = stack_topic(record, log.stack_names)
                    log.kinds.setdefault(
                        topic, type_name if is_cdr else f"{type_name} in {record.message_encoding}"
                    )
                    if (
                        is_cdr
                        and (take := log.reader_of(topic, full_name(type_name), expected))
                        is not None
                    ):
                        channels[record.id] = take
                else:
                    log.add(record)
    except OSError as error:
        raise ParameterError(
            f"{file}: cannot be read ({error.strerror}), expected {A_RUN}"
        ) from None
    # Add to the notes on the whole log what this file shows.
    if first_ns < before_ns - NANOSECONDS and file.parent.name != ROSBAG2:
        log.notes.append(
            f"{file.name} begins before the end of the part before: the parts are out of order, "
            "or there twice"
        )
    if not scan.complete:
        log.truncated.append(file.name)
    if scan.damaged:
        log.notes.append(f"{file.name} is damaged: {scan.damaged} of its parts left out")
    log.known_end_ns = max(log.known_end_ns, scan.known_end_ns)
