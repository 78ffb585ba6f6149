# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""MCAP bag -> Tape, without ROS: also from a file that was never finished."""

import struct
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import zstandard
from mcap.exceptions import McapError
from mcap.records import Attachment, Channel, Message, Schema
from mcap.stream_reader import StreamReader
from rosbags.serde.errors import SerdeError
from rosbags.typesys import Stores, get_typestore

from flight_core.files import is_file
from flight_core.parameters import require
from flight_core.rates import NANOSECONDS, nanoseconds
from flight_core.tape import Signal, Tape
from flight_core.vectors import FloatArray
from flight_recorder.bag import SCENARIO

# What reading raises where a file was cut or its bytes were changed: between records, inside one, inside a compressed chunk.
UNFINISHED = (McapError, struct.error, zstandard.ZstdError, SerdeError, UnicodeDecodeError)
JOINT_STATE = "sensor_msgs/msg/JointState"


class StoredFile(NamedTuple):
    """A file stored inside the log, as it was."""

    name: str
    content: bytes


class Run(NamedTuple):
    """What a recorded run holds."""

    tape: Tape
    scenario: StoredFile | None


class _Rows:
    """Samples of one topic as they come."""

    def __init__(self, names: tuple[str, ...]) -> None:
        self.names = names
        self.stamps: list[int] = []
        self.values: list[FloatArray] = []
        self.refused = 0

    def signal(self) -> Signal:
        order = np.argsort(self.stamps, kind="stable")
        return Signal(np.array(self.stamps, dtype=np.int64)[order], self.names, np.array(self.values)[order])


def read_run(run: Path) -> Run:
    """Read the folder of a run, or an MCAP file: named vectors by topic name (without its namespace), samples by stamp.

    A file without an end is read up to its last whole chunk, and the tape's notes say so. Raises ParameterError where there
    is no such file, more than one, or no sample in it.
    """
    file, *others = sorted(run.glob("*.mcap")) or [run]
    require(is_file(file), str(run), "no .mcap file", "the folder of a run or an MCAP file")
    require(not others, str(run), f"{1 + len(others)} .mcap files", "exactly one in the folder of a run")
    store = get_typestore(Stores.ROS2_JAZZY)
    topics: dict[str, _Rows] = {}
    notes: list[str] = []
    scenario: StoredFile | None = None
    vector_channels: dict[int, str] = {}
    schemas: dict[int, str] = {}
    with file.open("rb") as stream:
        try:
            for record in StreamReader(stream).records:
                if isinstance(record, Schema):
                    schemas[record.id] = record.name
                elif isinstance(record, Channel) and schemas.get(record.schema_id) == JOINT_STATE:
                    vector_channels[record.id] = record.topic.rsplit("/", 1)[-1]
                elif isinstance(record, Message) and record.channel_id in vector_channels:
                    message: Any = store.deserialize_cdr(record.data, JOINT_STATE)
                    if not message.name and not len(message.position):
                        continue  # in lockstep: no sample at this instant
                    rows = topics.setdefault(vector_channels[record.channel_id], _Rows(tuple(message.name)))
                    if tuple(message.name) == rows.names and len(message.position) == len(rows.names):
                        rows.stamps.append(message.header.stamp.sec * NANOSECONDS + message.header.stamp.nanosec)
                        rows.values.append(message.position)
                    else:
                        rows.refused += 1
                elif isinstance(record, Attachment) and record.media_type == SCENARIO:
                    scenario = StoredFile(Path(record.name).name, record.data)
        except UNFINISHED as error:
            notes.append(f"{file.name} is damaged or has no end ({type(error).__name__}): read up to its last whole chunk")
    notes += [f"{name}: {rows.refused} samples with other names refused" for name, rows in topics.items() if rows.refused]
    signals = {name: rows.signal() for name, rows in topics.items() if rows.stamps}
    require(bool(signals), str(run), "; ".join(["no sample on any topic", *notes]), "a recorded flight")
    return Run(Tape(signals, _start_ns(signals), tuple(notes)), scenario)


def _start_ns(signals: dict[str, Signal]) -> int:
    """Stamp of flight time 0: what `truth` says, else the first sample of all."""
    truth = signals.get("truth")
    if truth is not None and "t" in truth.names:
        return int(truth.stamp_ns[0]) - nanoseconds(float(truth["t"][0]))
    return min(int(signal.stamp_ns[0]) for signal in signals.values())
