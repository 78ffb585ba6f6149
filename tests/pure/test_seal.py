# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""The key of signed samples, and their code against HMAC as RFC 2104 writes it."""

import hashlib
import os
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from tests.joint_states import JOINT_STATE, vector

from flight_analysis.closed_loop.scenario import Scenario
from flight_core.authentication import BLANK, DIGITS, KEY_BYTES, MessageAuthenticator, mac_slice, read_key
from flight_core.parameters import ParameterError
from flight_core.vectors import ChannelError
from flight_log.named_vectors import decoder

KEY = bytes(range(KEY_BYTES))


def hmac_sha256(key: bytes, text: bytes) -> bytes:
    """RFC 2104, 2: H(K xor opad, H(K xor ipad, text)), with blocks of 64 bytes."""
    padded = key + bytes(64 - len(key))
    inner = hashlib.sha256(bytes(byte ^ 0x36 for byte in padded) + text).digest()
    return hashlib.sha256(bytes(byte ^ 0x5C for byte in padded) + inner).digest()


def signed(stamp_ns: int, values: tuple[float, ...], seal: MessageAuthenticator) -> bytes:
    """A sample of another publisher: blank, signed, put together."""
    blank = vector(stamp_ns, ("q", "V"), values, "/someone" + BLANK)
    place = mac_slice(blank)
    return blank[: place.start] + seal.mac(blank) + blank[place.stop :]


@given(st.binary(min_size=KEY_BYTES, max_size=KEY_BYTES), st.text(max_size=30), st.binary(max_size=300))
def test_the_code_is_half_of_hmac_sha256_over_topic_and_message(key: bytes, topic: str, message: bytes) -> None:
    expected = hmac_sha256(key, topic.encode() + b"\x00" + message)[:16].hex().encode()
    assert MessageAuthenticator(key, topic, None).mac(message) == expected
    assert len(expected) == DIGITS


def test_a_message_of_another_publisher_passes_with_its_code_and_no_other() -> None:
    seal = MessageAuthenticator(KEY, "/y", None)
    message = signed(7, (0.5, -1.0), seal)
    seal.check(message)
    for other in (MessageAuthenticator(KEY, "/u", None), MessageAuthenticator(bytes(KEY_BYTES), "/y", None)):
        with pytest.raises(ChannelError) as refused:
            other.check(message)
        assert refused.value.reason == "mac"


@given(st.binary(max_size=100))
def test_a_place_is_found_in_bytes_of_any_kind(message: bytes) -> None:
    place = mac_slice(message)
    assert place.stop - place.start in (0, DIGITS)


def test_signed_samples_of_a_log_are_read_as_others_are_and_at_once() -> None:
    seal = MessageAuthenticator(KEY, "/y", None)
    decode = decoder("/y", JOINT_STATE)
    assert decode is not None
    found = decode([signed(k, (0.1 * k, -k), seal) for k in range(5)])
    assert len(found.samples) == 1  # all of one layout, though each has its own code
    assert found.samples[0].stamp_ns.tolist() == list(range(5))
    assert np.array_equal(found.samples[0].values, [[0.1 * k, -k] for k in range(5)])


def key_file(folder: Path, content: bytes, mode: int) -> str:
    path = folder / "key"
    path.write_bytes(content)
    path.chmod(mode)
    return str(path)


@pytest.mark.parametrize("mode", [0o600, 0o400])
def test_a_key_is_the_32_bytes_of_its_file(mode: int, tmp_path: Path) -> None:
    assert read_key(key_file(tmp_path, KEY, mode), "controller.key_file") == KEY


@pytest.mark.parametrize(
    ("content", "mode", "found"),
    [
        (KEY, 0o640, "with mode 0640"),
        (KEY, 0o604, "with mode 0604"),
        (KEY[:31], 0o600, "of 31 bytes"),
        (KEY + b"\n", 0o600, "of more than 32 bytes"),
        (b"", 0o600, "of 0 bytes"),
    ],
)
def test_a_key_that_others_can_read_or_of_another_size_is_refused(
    content: bytes, mode: int, found: str, tmp_path: Path
) -> None:
    path = key_file(tmp_path, content, mode)
    with pytest.raises(ParameterError) as refused:
        read_key(path, "controller.key_file")
    expected = "expected a file of 32 bytes that its owner alone can read (chmod 600)"
    assert str(refused.value) == f"controller.key_file: found {path} {found}, {expected}"


def test_a_key_file_that_is_none_is_refused_and_no_pipe_is_waited_for(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe", 0o600)
    for path, found in (
        (tmp_path, "cannot be read"),
        (tmp_path / "absent", "cannot be read"),
        (tmp_path / "pipe", "is no file"),
    ):
        with pytest.raises(ParameterError, match=found):
            read_key(str(path), "controller.key_file")


def test_the_key_changes_nothing_of_what_is_said_to_fly(osprey_gust: Scenario) -> None:
    keyed = osprey_gust.vary(controller={"key_file": "/etc/key"})
    assert keyed.controller.digest() == osprey_gust.controller.digest()
