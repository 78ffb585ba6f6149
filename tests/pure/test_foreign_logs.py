# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test logs of autopilots from elsewhere, which are decoded in an isolated process.

Its time and memory follow from their size.
"""

import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.conftest import refusing
from tests.vehicle_logs import write_ulog

from flight_core import isolated
from flight_log.vehicle_log import read_foreign_log, read_vehicle_log

HEAD = b"ULog\x01\x12\x35\x01" + struct.pack("<Q", 0)


def message(kind: str, body: bytes) -> bytes:
    return struct.pack("<HB", len(body), ord(kind)) + body


def nested(count: int) -> bytes:
    """Return a ULog with `count` x `count` fields in a message.

    pyulog makes a name for each of them.
    """
    formats = (f"bomb:uint64_t timestamp;b[{count}] x;", f"b:float[{count}] y;")
    added = message("A", struct.pack("<BH", 0, 1) + b"bomb")
    return (
        HEAD
        + message("B", bytes(40))
        + b"".join(message("F", text.encode()) for text in formats)
        + added
    )


@pytest.mark.parametrize("count", [256, 3000, 65535])
def test_log_that_claims_more_values_than_a_message_holds_is_refused(
    count: int, tmp_path: Path
) -> None:
    """A log that claims more values than a message can have is refused.

    A message has at most 65,535 bytes, because its length has 16 bits (PX4 guide, ULog file
    format).
    """
    path = tmp_path / "nested.ulg"
    path.write_bytes(nested(count))
    with refusing(rf"cannot be decoded \(a message bomb of {count * count + 1} values\)"):
        read_vehicle_log(path)


def test_log_of_long_messages_is_read(tmp_path: Path) -> None:
    path = tmp_path / "nested.ulg"
    path.write_bytes(nested(255))  # 65,026 values
    with refusing("found a ULog of PX4 without a message of y or u"):
        read_vehicle_log(path)


def test_decoding_without_end_is_one_sentence(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "log.ulg"
    path.write_bytes(HEAD)
    monkeypatch.setattr(isolated, "WAIT", 0.0)
    with refusing(r"log\.ulg: found a ULog of PX4 whose decoding timed out after 0 s, expected"):
        read_foreign_log(path)


def test_limits_follow_from_the_size(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    limits_of_call: dict[str, Any] = {}
    monkeypatch.setattr(isolated, "call", lambda *_, **limits: limits_of_call.update(limits))
    path = tmp_path / "large.ulg"
    path.write_bytes(HEAD)
    with path.open("ab") as stream:
        stream.truncate(10_000_000)
    read_foreign_log(path)
    assert (limits_of_call["timeout"], limits_of_call["memory"]) == (
        5.0 + 60.0,
        (1 << 30) + 1_000_000_000,
    )


def test_log_from_the_isolated_process_is_that_of_this_one(tmp_path: Path) -> None:
    path = tmp_path / "flight.ulg"
    stamps = range(0, 2_000_000, 20_000)
    rows = [(stamp, (1.0, 0.01 * k, 0.0, 0.0)) for k, stamp in enumerate(stamps)]
    write_ulog(path, {"vehicle_attitude": ("float[4] q;", rows)}, {"FW_AIRSPD_TRIM": 25.0})
    direct = read_vehicle_log(path)
    foreign = read_foreign_log(path)
    assert foreign._replace(tables={}) == direct._replace(tables={})
    assert foreign.tables.keys() == direct.tables.keys()
    for name, table in direct.tables.items():
        assert np.array_equal(foreign.tables[name].stamp_ns, table.stamp_ns)
        assert all(
            np.array_equal(foreign.tables[name].fields[field], values)
            for field, values in table.fields.items()
        )
    assert foreign.source("theta") == direct.source("theta")


def test_file_that_is_no_log_is_one_sentence(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    path.write_text("a,b\n1,2\n")
    with refusing("found a CSV file, expected a DataFlash log"):
        read_foreign_log(path)
    with refusing("no such file"):
        read_foreign_log(tmp_path / "absent.bin")
