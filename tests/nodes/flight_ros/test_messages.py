# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test named vectors as bytes.

They are compared with the independent serialisation of rosbags, and with the middleware.
"""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from rclpy.serialization import deserialize_message
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import JointState
from tests.joint_states import vector

from flight_core.rates import NANOSECONDS
from flight_core.vectors import ChannelError, StampedVector
from flight_ros import rclpy_private
from flight_ros.messages import (
    NO_CHANNELS,
    Decoder,
    Encoder,
    instant,
    sender_of,
    stamp_of,
    to_message,
)

NAMES = st.lists(
    st.text(st.characters(codec="utf-8", exclude_characters="\0"), max_size=12),
    max_size=6,
    unique=True,
)
STAMPS = st.integers(0, 2**31 * 10**9 - 1)


def decoded(decoder: Decoder, raw: bytes) -> StampedVector:
    sample = decoder.decode(raw)
    assert sample is not None
    return sample


@given(
    NAMES,
    st.data(),
    STAMPS,
    st.text(st.characters(codec="utf-8", exclude_characters="\0"), max_size=20),
)
def test_sample_encoded_as_independent_library_encodes_it(
    names: list[str], data: st.DataObject, stamp_ns: int, frame_id: str
) -> None:
    values = data.draw(st.lists(st.floats(), min_size=len(names), max_size=len(names)))
    encoder = Encoder(names, frame_id)
    encoder.encode(1, np.zeros(len(names)))  # an earlier sample leaves no trace
    assert encoder.encode(stamp_ns, np.array(values)) == vector(stamp_ns, names, values, frame_id)


def test_bytes_that_are_no_message_raise_error_that_nodes_catch() -> None:
    with pytest.raises(rclpy_private.DeserializationError):
        deserialize_message(b"\x00", JointState)


def test_the_middleware_reads_what_was_encoded() -> None:
    message = deserialize_message(
        Encoder(("q", "V"), "aircraft").encode(1_500_000_000, np.array([1.5, -2.0])), JointState
    )
    assert message == to_message(1_500_000_000, ("q", "V"), np.array([1.5, -2.0]), "aircraft")
    assert deserialize_message(instant(2_000_000_001), Clock).clock.nanosec == 1
    assert stamp_of(instant(2_000_000_001)) == 2_000_000_001


@given(
    st.permutations(["q", "V", "p", "r"]),
    st.lists(st.floats(-1e9, 1e9), min_size=4, max_size=4),
    STAMPS,
)
def test_wanted_channels_decoded_by_name_with_and_without_known_layout(
    names: list[str], values: list[float], stamp_ns: int
) -> None:
    decoder = Decoder(("p", "V"))
    encoder = Encoder(names, "/aircraft#1")
    for _ in range(2):  # the second sample has a known layout
        sample = decoded(decoder, encoder.encode(stamp_ns, np.array(values)))
        assert (sample.stamp_ns, sample.sender) == (stamp_ns, "/aircraft#1")
        assert sample.value.tolist() == [values[names.index("p")], values[names.index("V")]]


def test_decoder_follows_change_of_channel_names_or_publisher() -> None:
    decoder = Decoder(("q",))
    for names, frame_id in ((("q", "V"), "a"), (("V", "q"), "a"), (("q",), "b"), (("q", "V"), "a")):
        sample = decoded(
            decoder,
            Encoder(names, frame_id).encode(5, np.array([float(name == "q") for name in names])),
        )
        assert (sample.value.tolist(), sample.sender) == ([1.0], frame_id)


@given(st.binary(max_size=100))
def test_sender_of_any_bytes_is_text_or_none(raw: bytes) -> None:
    assert isinstance(sender_of(raw), str | None)


def test_a_vector_without_channels_is_no_sample() -> None:
    assert Decoder(("q",)).decode(Encoder((), "aircraft").encode(7, NO_CHANNELS)) is None


GOOD = Encoder(("q", "V"), "a").encode(1, np.array([1.0, 2.0]))


def invalid_samples() -> list[tuple[str, bytes]]:
    return [
        ("finite", Encoder(("q", "V"), "a").encode(2, np.array([np.nan, 2.0]))),
        ("name", Encoder(("q", "x"), "a").encode(1, np.zeros(2))),
        ("malformed", GOOD[:40]),
        ("malformed", b""),
        ("length", vector(1, ["q", "V"], [1.0], "a")),
    ]


@pytest.mark.parametrize("reason, raw", invalid_samples())
@pytest.mark.parametrize("known_layout", [False, True])
def test_invalid_message_rejected_with_reason(reason: str, raw: bytes, known_layout: bool) -> None:
    decoder = Decoder(("q", "V"))
    if known_layout:
        decoder.decode(GOOD)
    with pytest.raises(ChannelError) as rejected:
        decoder.decode(raw)
    assert rejected.value.reason == reason
    assert decoded(decoder, GOOD).value.tolist() == [1.0, 2.0]


def test_message_with_velocities_read_by_positions() -> None:
    decoder = Decoder(("q",))
    raw = vector(NANOSECONDS, ["q"], [3.0], "x", velocity=[9.0])
    for _ in range(2):
        assert decoded(decoder, raw).value.tolist() == [3.0]
