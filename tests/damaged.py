# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Damage a topic of a log: samples are missing, or stamps are of a clock that was set."""

import struct
from collections.abc import Callable, Mapping
from pathlib import Path

from mcap.reader import make_reader
from mcap.writer import Writer

from flight_core.rates import NANOSECONDS
from flight_log.named_vectors import STAMP, stamp_in

STEP_NS = 5 * NANOSECONDS
Damage = Callable[[int, int, bytes], bytes | None]
"""The message k of n of a topic, or None where it is missing."""


def restamped(data: bytes, stamp_ns: int) -> bytes:
    """Return a message with another stamp."""
    stamp = struct.pack("<iI", *divmod(stamp_ns, NANOSECONDS))
    return data[: STAMP.start] + stamp + data[STAMP.stop :]


DAMAGES: Mapping[str, Damage] = {
    "ends at a third": lambda k, n, data: data if k < n // 3 else None,
    "ends in the middle": lambda k, n, data: data if k < n // 2 else None,
    "ends before the end": lambda k, n, data: data if k < n - n // 20 else None,
    "without a third": lambda k, n, data: None if n // 3 <= k < 2 * n // 3 else data,
    "without its begin": lambda k, n, data: data if k >= n // 3 else None,
    "every second sample": lambda k, n, data: data if k % 2 == 0 else None,
    "stamps are zero": lambda k, n, data: restamped(data, 0),
    "stamps are zero from the middle": lambda k, n, data: (
        restamped(data, 0) if k >= n // 2 else data
    ),
    "stamps are zero to the middle": lambda k, n, data: restamped(data, 0) if k < n // 2 else data,
    "clock back": lambda k, n, data: (
        restamped(data, stamp_in(data) - STEP_NS) if k >= n // 2 else data
    ),
    "clock forth": lambda k, n, data: (
        restamped(data, stamp_in(data) + STEP_NS) if k >= n // 2 else data
    ),
    "clock back and forth": lambda k, n, data: (
        restamped(data, stamp_in(data) - STEP_NS) if n // 3 <= k < 2 * n // 3 else data
    ),
    "clock forth and back": lambda k, n, data: (
        restamped(data, stamp_in(data) + STEP_NS) if n // 3 <= k < 2 * n // 3 else data
    ),
}
"""Damages by their names."""


def damage(log: Path, copy: Path, topic: str, change: Damage, *, from_ns: int = 0) -> Path:
    """Write a copy of a log with a damaged topic. An empty `topic` damages all topics.

    The stamps are counted from `from_ns`.
    """
    copy.parent.mkdir(parents=True, exist_ok=True)
    with log.open("rb") as source, copy.open("wb") as target:
        reader = make_reader(source)
        writer = Writer(target)
        writer.start(profile="ros2", library="damaged")
        for attachment in reader.iter_attachments():
            writer.add_attachment(
                attachment.log_time,
                attachment.create_time,
                attachment.name,
                attachment.media_type,
                attachment.data,
            )
        for record in reader.iter_metadata():
            if record.name != "rosbag2":
                writer.add_metadata(record.name, record.metadata)
        messages = list(reader.iter_messages(log_time_order=False))
        counts: dict[str, int] = {}
        for _, channel, _ in messages:
            counts[channel.topic] = counts.get(channel.topic, 0) + 1
        schemas: dict[int, int] = {}
        channels: dict[int, int] = {}
        places: dict[str, int] = {}
        for schema, channel, message in messages:
            if schema is None:
                continue
            if schema.id not in schemas:
                schemas[schema.id] = writer.register_schema(
                    schema.name, schema.encoding, schema.data
                )
            if channel.id not in channels:
                channels[channel.id] = writer.register_channel(
                    channel.topic, channel.message_encoding, schemas[schema.id], channel.metadata
                )
            k = places[channel.topic] = places.get(channel.topic, -1) + 1
            data: bytes | None = (
                restamped(message.data, stamp_in(message.data) + from_ns)
                if from_ns
                else message.data
            )
            if data is not None and topic in {"", channel.topic}:
                data = change(k, counts[channel.topic], data)
            if data is not None:
                times = message.log_time + from_ns, data, message.publish_time + from_ns
                writer.add_message(channels[channel.id], *times, message.sequence)
        writer.finish()  # type: ignore[no-untyped-call]
    return copy
