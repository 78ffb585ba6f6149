# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Serve a flight in progress to viewers of the Foxglove protocol.

Such viewers are Foxglove, Lichtblick and PlotJuggler. From the connection on, they get the messages
in the log, byte for byte. A viewer cannot send anything.
"""

import math
import signal
import threading
from collections.abc import Callable
from pathlib import Path

import foxglove

from flight_core.parameters import ParameterError, require
from flight_log.follow import Follower, Messages
from flight_view.server import ADDRESS, POLL_PERIOD

DEFAULT_PORT = 8765  # default port of the protocol
BACKLOG = 4096  # most messages that wait for a slow viewer; beyond, the oldest is dropped


def serve_foxglove(run: Path, port: int, announce: Callable[[str], None]) -> None:
    """Serve a run until the end of the recording, SIGINT or SIGTERM.

    `announce` gets a line for the user. Raises ParameterError if the port is taken, or if the
    recording has already ended.
    """
    end = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: end.set())
    follower = Follower(run, lambda topic, type_name: math.inf)
    # A record without data only defines a channel.
    before = {
        record.topic: record._replace(data=[])
        for record in follower.read()
        if isinstance(record, Messages)
    }
    require(
        not follower.complete,
        f"--foxglove: {run}",
        "a recording that has ended",
        "one in progress; viewers open its .mcap file",
    )
    context = foxglove.Context()
    channels: dict[str, foxglove.Channel] = {}
    try:
        server = foxglove.start_server(
            name=run.name,
            host=ADDRESS,
            port=port,
            capabilities=[],
            context=context,
            message_backlog_size=BACKLOG,
        )
    except RuntimeError:
        raise ParameterError(
            f"--port: {port} cannot be used, expected a free port of this host"
        ) from None
    announce(f"ws://{ADDRESS}:{server.port} for Foxglove, Lichtblick and PlotJuggler")
    try:
        for first in before.values():
            _channel(first, follower, channels, context)
        while not end.wait(POLL_PERIOD) and not follower.complete and not follower.fault:
            for record in follower.read():
                if (
                    channel := _channel(record, follower, channels, context)
                ) is not None and isinstance(record, Messages):
                    for sent_ns, data in zip(record.sent_ns, record.data, strict=True):
                        channel.log(data, log_time=sent_ns)
    finally:
        server.stop()
    require(not follower.fault, "--foxglove", follower.fault, "a log that can be read further")


def _channel(
    record: object,
    follower: Follower,
    channels: dict[str, foxglove.Channel],
    context: foxglove.Context,
) -> foxglove.Channel | None:
    """Return the channel of a record's topic, and advertise it with the first messages.

    Returns None if the record is of another kind than `Messages`.
    """
    if not isinstance(record, Messages):
        return None
    if record.topic not in channels:
        definition = follower.definitions.get(record.type_name, "").encode()
        schema = foxglove.Schema(name=record.type_name, encoding="ros2msg", data=definition)
        channels[record.topic] = foxglove.Channel(
            record.topic, schema=schema, message_encoding="cdr", context=context
        )
    return channels[record.topic]
