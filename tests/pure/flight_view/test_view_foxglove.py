# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test the log of a flight over the Foxglove protocol, with a client of another library.

The extra may not be installed.
"""

import asyncio
import json
import re
import struct
import subprocess
import sys
from contextlib import suppress
from importlib.util import find_spec
from io import BytesIO
from pathlib import Path
from typing import Any

import pytest
from mcap.records import Schema
from mcap_ros2.decoder import DecoderFactory
from tornado.httpclient import HTTPRequest
from tornado.websocket import websocket_connect

from flight_core.tape import Tape

needs_extra = pytest.mark.skipif(
    find_spec("foxglove") is None, reason="needs foxglove-sdk: make foxglove"
)
PROTOCOL = "foxglove.sdk.v1"
SUBSCRIBE, MESSAGE_DATA = "subscribe", 1
HEAD = struct.Struct("<BIQ")  # MessageData: opcode, subscription, log time


def command(*words: object) -> list[str]:
    return [sys.executable, "-m", "flight_cli.cli", "watch", *map(str, words)]


@needs_extra
def test_viewer_gets_messages_of_log_with_definitions(
    recorded: Path, tape: Tape, tmp_path: Path
) -> None:
    content = (recorded / "run_0.mcap").read_bytes()
    path = tmp_path / "run_0.mcap"
    path.write_bytes(content[: len(content) // 2])
    rest = BytesIO(content[len(content) // 2 :])

    async def view(address: str) -> tuple[dict[str, Any], list[tuple[int, bytes]]]:
        request = HTTPRequest(address)
        connection = await websocket_connect(request, subprotocols=[PROTOCOL])

        async def text() -> dict[str, Any]:
            return dict(json.loads(await connection.read_message() or "{}"))

        async def take() -> bool:
            """Receive once, and return False at the end of the connection."""
            data = await connection.read_message()
            if isinstance(data, bytes) and data[0] == MESSAGE_DATA:
                _, number, sent_ns = HEAD.unpack_from(data)
                assert number == 7
                messages.append((sent_ns, data[HEAD.size :]))
            return data is not None

        channels: dict[str, Any] = {}
        messages: list[tuple[int, bytes]] = []
        while "/y" not in channels:
            message = await text()
            channels |= {channel["topic"]: channel for channel in message.get("channels", ())}
            assert message.get("capabilities", []) == []  # nothing can be sent
        subscription = {"id": 7, "channelId": channels["/y"]["id"]}
        await connection.write_message(
            json.dumps({"op": SUBSCRIBE, "subscriptions": [subscription]})
        )
        # The protocol does not acknowledge a subscription: the log grows until messages come.
        with path.open("ab") as log:
            while not messages and (piece := rest.read(5000)):
                log.write(piece)
                log.flush()
                with suppress(TimeoutError):
                    await asyncio.wait_for(take(), 0.2)
            log.write(rest.read())
        while await take():
            pass
        connection.close()
        return channels, messages

    with subprocess.Popen(
        command(tmp_path, "--foxglove", "--port", 0), stdout=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout is not None
        address = re.match(r"ws://127\.0\.0\.1:\d+", process.stdout.readline())
        assert address is not None
        channels, messages = asyncio.run(asyncio.wait_for(view(address[0]), 60.0))
        assert process.wait(20.0) == 0  # with the recording
    y = channels["/y"]
    assert (y["encoding"], y["schemaName"], y["schemaEncoding"]) == (
        "cdr",
        "sensor_msgs/msg/JointState",
        "ros2msg",
    )
    decode = DecoderFactory().decoder_for(
        "cdr", Schema(data=y["schema"].encode(), encoding="ros2msg", id=1, name=y["schemaName"])
    )
    assert decode is not None
    values = [list(decode(data).position) for _, data in messages]
    assert len(values) > 100
    assert values == tape["y"].values[-len(values) :].tolist()


@needs_extra
def test_ended_recording_opened_by_viewer_itself(recorded: Path) -> None:
    ended = subprocess.run(
        command(recorded, "--foxglove"), capture_output=True, text=True, check=False
    )
    assert ended.returncode == 2
    assert (
        "found a recording that has ended, expected one in progress; viewers open its .mcap file"
        in ended.stderr
    )
