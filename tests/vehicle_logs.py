# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Write the logs of autopilots, by the published formats."""

import struct
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink

Rows = Sequence[tuple[int, Any]]  # stamp, us, and the values of the fields
Changes = Sequence[tuple[int, str, float]]  # of parameters: stamp, us, name and value

FMT = struct.Struct("<3sBB4s16s64s")  # ArduPilot, AP_Logger/LogStructure.h, log_Format
HEAD = b"\xa3\x95"


def write_dataflash(
    path: Path,
    messages: Mapping[str, tuple[Sequence[str], Rows]],
    parameters: Mapping[str, float],
    firmware: str,
    changes: Changes = (),
) -> None:
    """Write a DataFlash log in which every field is a float.

    Messages are in the order of their stamps, after the firmware and the parameters.
    """

    def format_of(identity: int, size: int, name: bytes, types: bytes, labels: bytes) -> None:
        packet = FMT.pack(HEAD + b"\x80", identity, size, name, types, labels)
        packets.append((-1, packet))

    packets: list[tuple[int, bytes]] = []
    format_of(0x80, FMT.size, b"FMT", b"BBnNZ", b"Type,Length,Name,Format,Columns")
    text = struct.Struct("<3sQ64s")
    format_of(0x7F, text.size, b"MSG", b"QZ", b"TimeUS,Message")
    packets.append((0, text.pack(HEAD + b"\x7f", 0, firmware.encode())))
    row = struct.Struct("<3sQ16sf")
    format_of(0x81, row.size, b"PARM", b"QNf", b"TimeUS,Name,Value")
    records = [*((0, name, value) for name, value in parameters.items()), *changes]
    packets += [
        (stamp, row.pack(HEAD + b"\x81", stamp, name.encode(), value))
        for stamp, name, value in records
    ]
    for identity, (name, (fields, rows)) in enumerate(messages.items(), start=0x82):
        packet = struct.Struct(f"<3sQ{len(fields)}f")
        labels = ",".join(("TimeUS", *fields)).encode()
        format_of(identity, packet.size, name.encode(), b"Q" + b"f" * len(fields), labels)
        packets += [
            (stamp, packet.pack(HEAD + bytes([identity]), stamp, *values)) for stamp, values in rows
        ]
    path.write_bytes(b"".join(packet for _, packet in sorted(packets, key=lambda pair: pair[0])))


def write_ulog(
    path: Path,
    topics: Mapping[str, tuple[str, Rows]],
    parameters: Mapping[str, float],
    changes: Changes = (),
    second: Mapping[str, Rows] = MappingProxyType({}),
) -> None:
    """Write a ULog with topics by name.

    The fields are as PX4 declares them, and all are float (PX4 guide, ULog file format). `second`
    has the samples of the instance 1 by topic.
    """

    def message(kind: bytes, content: bytes) -> bytes:
        return struct.pack("<H", len(content)) + kind + content

    def key_value(key: str, value: bytes) -> bytes:
        return bytes([len(key)]) + key.encode() + value

    parts = [b"ULog\x01\x12\x35\x01" + struct.pack("<Q", 0), message(b"B", bytes(40))]
    parts += [
        message(b"F", f"{name}:uint64_t timestamp;{fields}".encode())
        for name, (fields, _) in topics.items()
    ]

    def parameter(name: str, value: float) -> bytes:
        return message(b"P", key_value(f"float {name}", struct.pack("<f", value)))

    parts += [parameter(name, value) for name, value in parameters.items()]
    series = [
        *((0, name, rows) for name, (_, rows) in topics.items()),
        *((1, name, rows) for name, rows in second.items()),
    ]
    parts += [
        message(b"A", bytes([i]) + struct.pack("<H", k) + name.encode())
        for k, (i, name, _) in enumerate(series)
    ]
    samples = [
        (stamp, k, message(b"D", struct.pack(f"<HQ{len(values)}f", k, stamp, *values)))
        for k, (_, _, rows) in enumerate(series)
        for stamp, values in rows
    ]
    # after samples of its stamp
    samples += [(stamp, len(series), parameter(name, value)) for stamp, name, value in changes]
    path.write_bytes(
        b"".join(
            [*parts, *(packet for _, _, packet in sorted(samples, key=lambda sample: sample[:2]))]
        )
    )


def write_tlog(path: Path, messages: Sequence[tuple[int, Any]], system: int = 1) -> None:
    """Write a tlog, with the time before each packet, us since 1970 (MAVLink guide).

    The messages are those of pymavlink.
    """
    sender = mavlink.MAVLink(None, srcSystem=system, srcComponent=1)
    ordered = sorted(messages, key=lambda pair: pair[0])
    path.write_bytes(
        b"".join(struct.pack(">Q", stamp) + message.pack(sender) for stamp, message in ordered)
    )
