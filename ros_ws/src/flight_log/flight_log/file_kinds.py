# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Name the kind of a file by its first bytes.

A file is a log, a packed log, or a file of another program.
"""

import struct
from datetime import UTC, datetime
from pathlib import Path
from types import MappingProxyType

from mcap.writer import MCAP0_MAGIC

from flight_core.files import open_nonblocking

MCAP = "an MCAP file"
SQLITE = "a database of SQLite, of which `ros2 bag convert` or `rosbags-convert` makes an MCAP file"
ZSTD = "a zstd file"
LZ4 = "an lz4 file"
EMPTY = "an empty file"
BEGUN = "the first bytes of an MCAP file"
UNREADABLE = "a file that cannot be read"

ULOG = "a ULog of PX4"
DATAFLASH = "a DataFlash log of ArduPilot"
TLOG = "a tlog of MAVLink"
IMPORTABLE = frozenset({ULOG, DATAFLASH, TLOG})
"""Kinds of logs of autopilots from which `rise-di import` makes a bag."""

PACKED = (ZSTD, LZ4)
"""Kinds of packed files, which can hold a log."""

ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"  # RFC 8878, section 3.1.1
LZ4_MAGIC = b"\x04\x22\x4d\x18"  # LZ4 frame format, Magic Number

MAGICS = MappingProxyType(
    {
        MCAP0_MAGIC: MCAP,
        b"SQLite format 3\0": SQLITE,
        ZSTD_MAGIC: ZSTD,
        LZ4_MAGIC: LZ4,
        b"ULog\x01\x12\x35": ULOG,  # PX4 guide, ULog file format
        # the head of a packet with the identity FMT (ArduPilot, AP_Logger/LogStructure.h)
        b"\xa3\x95\x80": DATAFLASH,
        b"FMT, 128, 89,": "a DataFlash log of ArduPilot as text",
        b"H Product:Blackbox": "a blackbox log of Betaflight or INAV",
        b"#ROSBAG V": "a bag of ROS 1",
        b"PK\x03\x04": "a ZIP archive",
        b"\x1f\x8b": "a gzip file",
        b"BZh": "a bzip2 file",
        b"\xfd7zXZ\0": "an xz file",
        b"7z\xbc\xaf\x27\x1c": "a 7z archive",
        b"\x89HDF\r\n\x1a\n": "an HDF5 file",
        b"MATLAB 5.0 MAT-file": "a MAT-file",
        b"PAR1": "a Parquet file",
        b"%PDF": "a PDF file",
        b"\x89PNG": "a PNG image",
        b"\xff\xd8\xff": "a JPEG image",
        b"\x7fELF": "a program",
        b"version https://git-lfs": "a pointer of Git LFS to a file that is not downloaded",
        b"<?xml": "an XML file",
        b"<": "an XML or HTML file",
        b"{": "a JSON file",
    }
)
"""Kinds of files by the first bytes."""

# POSIX.1-2017, pax, ustar Interchange Format
TAR_PLACE = 257
TAR = b"ustar"
# first byte of a packet of MAVLink 2 and of MAVLink 1 (MAVLink guide, Packet Serialization)
MAVLINK = (b"\xfd", b"\xfe")
# the time before each packet of a tlog, us since 1970 (MAVLink guide, mavlogdump)
TLOG_TIME = struct.Struct(">Q")
TLOG_YEARS = (2000, 2100)
HEAD_BYTES = 4096


def file_kind(path: Path) -> str:
    """Return the kind of a file with an article, as in "a ULog of PX4". Never raises."""
    try:
        with open_nonblocking(path) as stream:
            head = stream.read(HEAD_BYTES)
    except (OSError, ValueError):
        return UNREADABLE
    return kind_of_head(head)


def kind_of_head(head: bytes) -> str:
    """Return the kind of a file by its first HEAD_BYTES bytes.

    If the bytes are those of no known format, they are a text or unknown bytes.
    """
    # A recorder that is killed at its start leaves a file that has only the first bytes of an MCAP.
    if MCAP0_MAGIC.startswith(head):
        return BEGUN if head else EMPTY
    text = head.removeprefix(b"\xef\xbb\xbf").lstrip(b" \t\r\n")
    by_magic = next(
        (
            kind
            for magic, kind in MAGICS.items()
            if (text if magic.isascii() else head).startswith(magic)
        ),
        "",
    )
    if by_magic:
        return by_magic
    kinds = {
        "a file of zeros": not any(head),
        "a tar archive": head[TAR_PLACE : TAR_PLACE + len(TAR)] == TAR,
        TLOG: tlog_start(head) is not None,
        "a stream of MAVLink": head[:1] in MAVLINK,
    }
    return next((kind for kind, fits in kinds.items() if fits), "") or _text_kind(head)


def tlog_start(head: bytes) -> int | None:
    """Return the place of the first packet that has a time before it; None without a packet.

    A text that a radio sends at its start may come before this packet. In this case a second packet
    must follow.
    """
    for start in range(len(head) - TLOG_TIME.size):
        end = _packet_end(head, start)
        if end and (start == 0 or end + TLOG_TIME.size >= len(head) or _packet_end(head, end)):
            return start
    return None


def _packet_end(head: bytes, start: int) -> int:
    """Return the end of a MAVLink packet that follows its time; 0 if there is no packet."""
    place = start + TLOG_TIME.size
    magic = head[place : place + 1]
    if magic not in MAVLINK or not _is_time(*TLOG_TIME.unpack_from(head, start)):
        return 0
    # `frame` is the size of a packet without the payload (MAVLink guide, Packet Serialization). A
    # signature has 13 bytes.
    size, flags = (*head[place + 1 : place + 3], 0, 0)[:2]
    frame = 8 if magic == MAVLINK[1] else 12 + 13 * (flags & 1)
    return place + frame + size


def _is_time(microseconds: int) -> bool:
    first, last = (datetime(year, 1, 1, tzinfo=UTC).timestamp() * 1e6 for year in TLOG_YEARS)
    return first < microseconds < last


def _text_kind(head: bytes) -> str:
    """Name the kind of a text, or say that the bytes are no text."""
    try:
        text = head.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        # The last character may be cut at the end of the head.
        if error.start < len(head) - 4:
            return "a file of unknown content"
        text = head[: error.start].decode("utf-8-sig")
    if any(not (c.isprintable() or c in "\t\r\n\f") for c in text):
        return "a file of unknown content"
    lines = [line for line in text.splitlines() if line.strip()]
    for separator in ",;\t":
        if len(lines) > 1 and lines[0].count(separator) == lines[1].count(separator) > 0:
            return "a CSV file"
    return "a text file"
