# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""MCAP bag -> Tape, without ROS: also from a file that was never finished."""

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from mcap.exceptions import McapError
from mcap.records import Attachment, Channel, Message, Metadata, Schema
from mcap.stream_reader import StreamReader
from rosbags.typesys import Stores, get_typestore

from flight_core.parameters import ParameterError
from flight_core.rates import NANOSECONDS
from flight_core.tape import Signal, Tape
from flight_core.vectors import FloatArray

JOINT_STATE = "sensor_msgs/msg/JointState"


class Run(NamedTuple):
    """What a recorded run holds."""

    tape: Tape
    scenario: bytes | None  # the scenario file stored inside, as it was


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
    is no such file, or no sample in it.
    """
    files = sorted(run.glob("*.mcap")) if run.is_dir() else [run]
    if not files or not files[0].is_file():
        raise ParameterError(f"{run}: found no .mcap file, expected the folder of a run or an MCAP file")
    store = get_typestore(Stores.ROS2_JAZZY)
    topics: dict[str, _Rows] = {}
    notes: list[str] = []
    start_ns, scenario = 0, None
    for file in files:
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
                        rows = topics.setdefault(vector_channels[record.channel_id], _Rows(tuple(message.name)))
                        if tuple(message.name) == rows.names and len(message.position) == len(rows.names):
                            rows.stamps.append(message.header.stamp.sec * NANOSECONDS + message.header.stamp.nanosec)
                            rows.values.append(message.position)
                        else:
                            rows.refused += 1
                    elif isinstance(record, Metadata) and record.name == "rise_di":
                        start_ns = int(record.metadata["start_ns"])
                    elif isinstance(record, Attachment) and record.media_type == "application/yaml":
                        scenario = record.data
            except McapError as error:
                notes.append(f"{file.name} has no end ({type(error).__name__}): read up to its last whole chunk")
    if not topics:
        raise ParameterError(f"{run}: found no sample on any topic, expected a recorded flight")
    notes += [f"{name}: {rows.refused} samples with other names refused" for name, rows in topics.items() if rows.refused]
    signals = {name: rows.signal() for name, rows in topics.items()}
    first_ns = min(int(signal.stamp_ns[0]) for signal in signals.values() if len(signal.stamp_ns))
    return Run(Tape(signals, start_ns or first_ns, tuple(notes)), scenario)
