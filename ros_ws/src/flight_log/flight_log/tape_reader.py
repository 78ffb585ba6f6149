# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Bag -> Tape, without ROS: of this stack and of `ros2 bag record`, also from files that were never finished."""

import re
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from mcap.records import Attachment, Channel, McapRecord, Message, Metadata, Schema
from numpy.typing import NDArray
from rosbags.rosbag2 import Reader

from flight_core.files import is_file, is_folder
from flight_core.parameters import ParameterError, printable, require
from flight_core.rates import seconds
from flight_core.tape import Signal, Tape
from flight_core.vectors import FloatArray
from flight_log.bag import LOST, METADATA, SCENARIO, bag_files, read_information
from flight_log.named_vectors import Decoder, Samples, decoder, flight_start_ns
from flight_log.scan import Scan

BLOCK = 4096  # messages that are decoded together

FLOWN = ("y", "y_m", "u", "u_m", "internals", "truth")
"""Topics that make a namespace that of an aircraft; any one of them does."""


SCENARIO_NAME = re.compile(r"(?!metadata\.yaml)[\w-][\w.-]{0,99}\.yaml")
"""Names under which a scenario of a log may be laid beside it: none of the log's own files, and nothing in another folder."""


class StoredFile(NamedTuple):
    """A file stored inside the log, as it was."""

    name: str
    content: bytes


class Run(NamedTuple):
    """What a recorded run holds. Metadata are the log's named sets of strings, attachments all files but the scenario."""

    tape: Tape
    scenario: StoredFile | None
    metadata: Mapping[str, Mapping[str, str]] = {}
    attachments: tuple[StoredFile, ...] = ()


def read_run(run: Path, namespace: str | None = None) -> Run:
    """Read the folder of a run, or one of its files: named vectors by topic name (without the namespace), samples by stamp.

    A bag of this stack, or one of `ros2 bag record`: MCAP in one file or several, or SQLite. MCAP files without an end are read
    up to their last whole chunk; the tape's notes say so. Raises ParameterError where there is no bag, no sample in it, or more
    than one aircraft, each in its namespace, and `namespace` names none of them.
    """
    log = _read(run)
    filled = {topic: signal for topic, rows in log.rows.items() if (signal := rows.signal()) is not None}
    require(bool(filled), str(run), "; ".join(["no sample on any topic", *log.notes_at(None)]), "a recorded flight")
    names = _names_of_one_aircraft(filled, namespace, str(run))
    require(bool(names), str(run), f"topics that begin with no slash: {', '.join(filled)}", "a recorded flight")
    signals = {name: filled[topic] for topic, name in names.items()}
    start_ns = _start_ns(signals)
    end = seconds(max(int(signal.stamp_ns[-1]) for signal in signals.values()) - start_ns)
    notes = [*log.notes_at(end), *(note for topic, name in names.items() if (note := log.rows[topic].note(name)))]
    return Run(Tape(signals, start_ns, tuple(map(printable, notes))), log.scenario, log.metadata, tuple(log.attachments))


def _names_of_one_aircraft(topics: Collection[str], namespace: str | None, where: str) -> dict[str, str]:
    """Names within the namespace of one aircraft, by full topic name; of a bag without any, names without a slash in front."""
    flown = sorted({topic.rpartition("/")[0] for topic in topics if topic.rpartition("/")[2] in FLOWN})
    known = ", ".join(one or "/" for one in flown) or "none"
    if namespace is None:
        require(len(flown) < 2, where, f"aircraft in the namespaces {known}", "that one of them is asked for")
        chosen = flown[0] if flown else ""
    else:
        chosen = f"/{namespace.strip('/')}".rstrip("/")
        require(chosen in flown, where, f"aircraft in the namespaces {known}", f"one in {namespace!r}")
    within = [f"{other}/" for other in flown if other.startswith(f"{chosen}/")]
    return {
        topic: topic.removeprefix(f"{chosen}/")
        for topic in topics
        if topic.startswith(f"{chosen}/") and not topic.startswith(tuple(within))
    }


class _Rows:
    """Samples of one topic as they come."""

    def __init__(self, decode: Decoder) -> None:
        self._decode = decode
        self._waiting: list[bytes] = []
        self._names: tuple[str, ...] | None = None
        self._stamps: list[NDArray[np.int64]] = []
        self._values: list[FloatArray] = []
        self._refused = 0

    def add(self, message: bytes) -> None:
        self._waiting.append(message)
        if len(self._waiting) == BLOCK:
            self._empty()

    def _empty(self) -> None:
        decoded = self._decode(self._waiting)
        self._waiting = []
        self._refused += decoded.unreadable
        for samples in decoded.samples:
            self._take(samples)

    def _take(self, samples: Samples) -> None:
        names, stamp_ns, values = samples
        self._names = self._names or names
        if names == self._names and values.shape[1] == len(names):
            self._stamps.append(stamp_ns)
            self._values.append(values)
        else:
            self._refused += len(stamp_ns)

    def signal(self) -> Signal | None:
        """All samples in the order of their stamps; None where there is none."""
        self._empty()
        if self._names is None or not self._stamps:
            return None
        stamp_ns = np.concatenate(self._stamps)
        order = np.argsort(stamp_ns, kind="stable")
        return Signal(stamp_ns[order], self._names, np.concatenate(self._values)[order])

    def note(self, name: str) -> str:
        """What is to be said of the topic, empty where nothing is."""
        return f"{name}: {self._refused} samples with other names refused" if self._refused else ""


class _Log:
    """All that the files of a bag hold."""

    def __init__(self) -> None:
        self.rows: dict[str, _Rows] = {}  # by full topic name
        self.notes: list[str] = []
        self.scenario: StoredFile | None = None
        self.metadata: dict[str, Mapping[str, str]] = {}
        self.attachments: list[StoredFile] = []
        self.cut: list[str] = []  # files without an end
        self.last_ns = 0  # log time of the last message
        self.known_end_ns = 0  # the latest log time that anything speaks of

    def rows_of(self, topic: str, type_name: str) -> _Rows | None:
        """Where the messages of a topic go; None where they are no named vectors."""
        if topic not in self.rows and (decode := decoder(topic, type_name)) is not None:
            self.rows[topic] = _Rows(decode)
        return self.rows.get(topic)

    def keep(self, record: McapRecord) -> None:
        """Keep what is no message."""
        if isinstance(record, Metadata):
            self.metadata[record.name] = record.metadata
        elif isinstance(record, Attachment):
            name = Path(record.name).name
            if record.media_type == SCENARIO:
                self.scenario = StoredFile(name if SCENARIO_NAME.fullmatch(name) else "scenario.yaml", record.data)
            else:
                self.attachments.append(StoredFile(name, record.data))

    def notes_at(self, end: float | None) -> list[str]:
        """The notes, given the flight time of the last sample in s, None where there is none."""
        where = "" if end is None else f", t = {end:.3f} s"
        missing = seconds(self.known_end_ns - self.last_ns)
        more = f"; {missing:.3f} s are missing behind it" if missing > 0 else ""
        cut = [f"{name} has no end: read up to its last whole chunk{where}{more}" for name in self.cut]
        lost = [
            f"{topic}: {count} messages lost on the way to the recorder" for topic, count in self.metadata.get(LOST, {}).items()
        ]
        return [*cut, *self.notes, *lost]


def _read(run: Path) -> _Log:
    log = _Log()
    files = bag_files(run)
    information = _information(run, log) if files and is_folder(run) else {}
    packed = str(information.get("compression_mode") or "none").lower() != "none"
    if packed or run.suffix == ".db3" or (not files and is_file(run / METADATA)):
        _read_other(run, log)
    else:
        require(bool(files), str(run), "no .mcap file", "the folder of a run or an MCAP file")
        for file in files:
            _read_mcap(file, log)
    return log


def _information(run: Path, log: _Log) -> Mapping[str, Any]:
    """What metadata.yaml says; where it cannot be read the notes tell what to do."""
    try:
        information, log.known_end_ns = read_information(run)
    except ParameterError:
        fault = "cannot be read" if is_file(run / METADATA) else "is missing"
        log.notes.append(f"{METADATA} {fault}: rise-di repair {run}")
        return {}
    return information


def _read_mcap(file: Path, log: _Log) -> None:
    schemas: dict[int, str] = {}
    rows: dict[int, _Rows] = {}
    scan = Scan(file)
    try:
        for record in scan.records():
            if isinstance(record, Message):
                log.last_ns = max(log.last_ns, record.log_time)
                if record.channel_id in rows:
                    rows[record.channel_id].add(record.data)
            elif isinstance(record, Schema):
                schemas[record.id] = record.name
            elif isinstance(record, Channel):
                if (found := log.rows_of(record.topic, schemas.get(record.schema_id, ""))) is not None:
                    rows[record.id] = found
            else:
                log.keep(record)
    except OSError as error:
        raise ParameterError(f"{file}: cannot be read ({error.strerror}), expected an MCAP file") from None
    if not scan.whole:
        log.cut.append(file.name)
    if scan.damaged:
        log.notes.append(f"{file.name} is damaged: {scan.damaged} of its parts left out")
    log.known_end_ns = max(log.known_end_ns, scan.known_end_ns)


def _read_other(run: Path, log: _Log) -> None:
    """A bag of any other storage of rosbag2."""
    try:
        with Reader(run) as reader:
            for connection, _, message in reader.messages():
                if (rows := log.rows_of(connection.topic, connection.msgtype)) is not None:
                    rows.add(bytes(message))
    except Exception as error:  # of SQLite, of YAML, of a decompressor: of its content anything may be wrong
        raise ParameterError(f"{run}: cannot be read ({error or type(error).__name__}), expected a bag of rosbag2") from None


def _start_ns(signals: Mapping[str, Signal]) -> int:
    """Stamp of flight time 0: what `truth` says, else the first sample of all."""
    truth = signals.get("truth")
    if truth is not None and "t" in truth.names:
        start_ns = flight_start_ns(int(truth.stamp_ns[0]), float(truth["t"][0]))
        if start_ns is not None:
            return start_ns
    return min(int(signal.stamp_ns[0]) for signal in signals.values())
