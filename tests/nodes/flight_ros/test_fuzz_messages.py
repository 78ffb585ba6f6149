# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test the decoders with random payloads.

A payload is decoded or rejected with a reason, and the next valid message is decoded.
"""

from typing import Any

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from rclpy.serialization import deserialize_message
from tests.conftest import REPOSITORY, few
from tests.joint_states import vector
from tests.maps import named_map

from autopilot_bridge.channel_map import message_type, read_raw
from flight_core.vectors import ChannelError
from flight_ros.messages import Decoder, Encoder
from flight_ros.rclpy_private import DeserializationError

NAMES = ("q", "V", "p", "r")
REASONS = {"finite", "length", "malformed", "name", "order"}

many = settings(few, max_examples=300)


@st.composite
def payloads(draw: st.DrawFn) -> bytes:
    """Draw a valid payload with changed bytes, or a truncated or extended one."""
    names = draw(st.sampled_from([NAMES, NAMES[::-1], ("q",), ("q", "q", "V", "p", "r"), ()]))
    values = draw(st.lists(st.floats(), min_size=len(names), max_size=len(names)))
    stamp = draw(st.integers(-(2**31) * 10**9, 2**31 * 10**9 - 1))
    data = bytearray(
        vector(
            stamp,
            names,
            values,
            draw(st.text(st.characters(codec="utf-8", exclude_characters="\0"), max_size=4)),
        )
    )
    for _ in range(draw(st.integers(0, 3))):
        place = draw(st.integers(0, len(data)))
        match draw(st.sampled_from(("cut", "change", "length", "more"))):
            case "cut":
                del data[place:]
            case "change":
                data[place : place + 1] = draw(st.binary(min_size=1, max_size=1))
            case "length":
                data[place : place + 4] = draw(
                    st.sampled_from([0, 1, 255, 2**31, 2**32 - 1])
                ).to_bytes(4, "little")
            case "more":
                data += draw(st.binary(max_size=9))
    return bytes(data)


CORPUS = [
    path.read_bytes() for path in sorted((REPOSITORY / "tests" / "corpus" / "message").iterdir())
]


def decode_or_reject(decoder: Decoder, raw: bytes) -> None:
    """Decode a payload, or require that it is rejected with one of the counted reasons."""
    reason = ""
    try:
        sample = decoder.decode(raw)
    except ChannelError as error:
        reason = error.reason
    else:
        assert sample is None or np.isfinite(sample.value).all()
    assert reason in {"", *REASONS}


@many
@given(payloads() | st.binary(max_size=120) | st.sampled_from(CORPUS))
def test_any_payload_decoded_or_rejected_without_effect_on_next_one(raw: bytes) -> None:
    decoder = Decoder(NAMES)
    decode_or_reject(decoder, raw)
    good = Encoder(NAMES, "/aircraft#1").encode(7, np.array([1.0, 2.0, 3.0, 4.0]))
    for _ in range(2):  # first with an unknown layout, then with a known one
        sample = decoder.decode(good)
        assert sample is not None
        assert sample.value.tolist() == [1.0, 2.0, 3.0, 4.0]
        decode_or_reject(decoder, raw)


@many
@given(st.data())
def test_any_payload_of_autopilots_topic_is_value_or_rejected(data: st.DataObject) -> None:
    channel_map = named_map("ardupilot_2024")  # its message types are installed
    row = data.draw(st.sampled_from([*channel_map.outputs.values()]))
    kind: Any = message_type(row.type)
    raw = data.draw(payloads() | st.binary(max_size=200))
    try:
        message = deserialize_message(raw, kind)
    except DeserializationError:
        return
    reason = ""
    try:
        assert np.isfinite(read_raw(message, row.field, row.function))
    except ChannelError as error:
        reason = error.reason
    assert reason in {"", "field", "finite"}
