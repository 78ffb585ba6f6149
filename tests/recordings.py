# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Provide signals, scenario files and damaged logs for the tests of logs and reports."""

from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from mcap.reader import make_reader
from mcap.summary import Summary
from numpy.typing import ArrayLike
from rosbags.highlevel import AnyReader

from flight_core.tape import Signal, Tape

MS = 1_000_000  # ns
# ns, a stamp of today, which float64 cannot hold to the ns; in seconds it resolves 0.2 us
EPOCH = 1_795_000_000_000_000_000


def signal(stamps_ms: Sequence[float], **channels: ArrayLike) -> Signal:
    """Return channels with stamps in ms after EPOCH. A number applies to all stamps."""
    stamps = EPOCH + np.array([round(stamp * MS) for stamp in stamps_ms], dtype=np.int64)
    values = [
        np.broadcast_to(np.asarray(channel, dtype=float), stamps.shape)
        for channel in channels.values()
    ]
    return Signal(stamps, tuple(channels), np.column_stack(values))


def scenario_file(path: Path, base: Path, **sections: Mapping[str, Any]) -> Path:
    """Write a scenario file with changes to the sections of another one."""
    tree = yaml.safe_load(base.read_text())
    for name, changes in sections.items():
        tree[f"/**/{name}"]["ros__parameters"] |= changes
    path.write_text(yaml.safe_dump(tree))
    return path


def truncate(run: Path, fraction: float) -> bytes:
    """Leave what a killed recorder leaves.

    This is the beginning of the file, which is returned, without metadata.yaml.
    """
    file = run / "run_0.mcap"
    content = file.read_bytes()
    beginning = content[: int(len(content) * fraction)]
    file.write_bytes(beginning)
    (run / "metadata.yaml").unlink()
    return beginning


def summary_of(file: Path) -> Summary:
    """Return the summary section of an MCAP file, as the library mcap reads it."""
    with file.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None
    return summary


def messages(run: Path) -> list[tuple[str, int, bytes]]:
    """Return topic, log time and bytes of all messages, as rosbags reads them.

    Each can be deserialised.
    """
    with AnyReader([run]) as reader:
        assert sum(connection.msgcount for connection in reader.connections) == reader.message_count
        messages_read = [
            (connection.topic, stamp_ns, data) for connection, stamp_ns, data in reader.messages()
        ]
        for connection, _, data in reader.messages():
            reader.deserialize(data, connection.msgtype)
    return messages_read


def count_messages(run: Path) -> Counter[str]:
    """Return the number of messages in a log, by topic."""
    return Counter(topic for topic, _, _ in messages(run))


def require_equal_bits(recorded: Tape, flown: Tape) -> None:
    """Require that a log has every signal of a flight, to the last bit."""
    for name, signal in flown.signals.items():
        assert signal.names == recorded[name].names
        assert signal.stamp_ns.tobytes() == recorded[name].stamp_ns.tobytes(), name
        assert signal.values.tobytes() == recorded[name].values.tobytes(), name
