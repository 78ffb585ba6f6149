# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Message authentication codes against HMAC as RFC 2104 defines it, and key files."""

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
from flight_log.named_vectors import decoder, tables

pytestmark = pytest.mark.package("flight_core")

KEY = bytes(range(KEY_BYTES))


def hmac_sha256(key: bytes, text: bytes) -> bytes:
    """RFC 2104, 2: H(K xor opad, H(K xor ipad, text)), with blocks of 64 bytes."""
    padded = key + bytes(64 - len(key))
    inner = hashlib.sha256(bytes(byte ^ 0x36 for byte in padded) + text).digest()
    return hashlib.sha256(bytes(byte ^ 0x5C for byte in padded) + inner).digest()


def signed(stamp_ns: int, values: tuple[float, ...], authenticator: MessageAuthenticator) -> bytes:
    """A signed sample of an independent publisher."""
    blank = vector(stamp_ns, ("q", "V"), values, "/publisher" + BLANK)
    place = mac_slice(blank)
    return blank[: place.start] + authenticator.mac(blank) + blank[place.stop :]


@given(st.binary(min_size=KEY_BYTES, max_size=KEY_BYTES), st.text(max_size=30), st.binary(max_size=300))
def test_the_code_is_half_of_hmac_sha256_over_topic_and_message(key: bytes, topic: str, message: bytes) -> None:
    expected = hmac_sha256(key, topic.encode() + b"\x00" + message)[:16].hex().encode()
    assert MessageAuthenticator(key, topic, None).mac(message) == expected
    assert len(expected) == DIGITS


def test_a_message_passes_with_the_code_of_its_key_and_topic_alone() -> None:
    authenticator = MessageAuthenticator(KEY, "/y", None)
    message = signed(7, (0.5, -1.0), authenticator)
    authenticator.check(message)
    for other in (MessageAuthenticator(KEY, "/u", None), MessageAuthenticator(bytes(KEY_BYTES), "/y", None)):
        with pytest.raises(ChannelError) as rejected:
            other.check(message)
        assert rejected.value.reason == "mac"


@given(st.binary(max_size=100))
def test_the_slice_of_the_code_is_empty_or_whole_for_any_bytes(message: bytes) -> None:
    place = mac_slice(message)
    assert place.stop - place.start in (0, DIGITS)


def test_signed_samples_of_a_log_are_decoded_as_one_group() -> None:
    authenticator = MessageAuthenticator(KEY, "/y", None)
    decode = decoder(JOINT_STATE)
    assert decode is not None
    (table,) = tables([signed(k, (0.1 * k, -k), authenticator) for k in range(5)])
    decoded = decode(table)
    assert len(decoded.samples) == 1  # one layout, although the codes differ
    assert decoded.samples[0].stamp_ns.tolist() == list(range(5))
    assert np.array_equal(decoded.samples[0].values, [[0.1 * k, -k] for k in range(5)])


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
def test_a_key_file_with_open_mode_or_another_size_is_rejected(content: bytes, mode: int, found: str, tmp_path: Path) -> None:
    path = key_file(tmp_path, content, mode)
    with pytest.raises(ParameterError) as rejected:
        read_key(path, "controller.key_file")
    expected = "expected a file of 32 bytes that its owner alone can read (chmod 600)"
    assert str(rejected.value) == f"controller.key_file: found {path} {found}, {expected}"


def test_a_key_file_that_is_no_regular_file_is_rejected_without_blocking(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe", 0o600)
    for name, found in (("", "cannot be read"), ("absent", "cannot be read"), ("pipe", "is not a regular file")):
        with pytest.raises(ParameterError, match=found):
            read_key(str(tmp_path / name), "controller.key_file")


def test_the_key_file_does_not_change_the_parameter_digest(osprey_gust: Scenario) -> None:
    keyed = osprey_gust.vary(controller={"key_file": "/etc/key"})
    assert keyed.controller.digest() == osprey_gust.controller.digest()
