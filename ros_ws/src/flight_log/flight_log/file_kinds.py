# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Tell from its first bytes what kind of file a file is.

It may be a log, a packed log, or a file of another program.
"""

import struct
from datetime import UTC, datetime
from enum import Enum
from pathlib import Path
from types import MappingProxyType

from mcap.writer import MCAP0_MAGIC

from flight_core.files import open_nonblocking


class FileKind(Enum):
    """The kind of a file. Its value names the kind with an article, for a sentence."""

    MCAP = "an MCAP file"
    SQLITE = (
        "a database of SQLite, of which `ros2 bag convert` or `rosbags-convert` makes an MCAP file"
    )
    ZSTD = "a zstd file"
    LZ4 = "an lz4 file"
    EMPTY = "an empty file"
    BEGUN = "the first bytes of an MCAP file"
    UNREADABLE = "a file that cannot be read"
    ULOG = "a ULog of PX4"
    DATAFLASH = "a DataFlash log of ArduPilot"
    TLOG = "a tlog of MAVLink"
    DATAFLASH_TEXT = "a DataFlash log of ArduPilot as text"
    BLACKBOX = "a blackbox log of Betaflight or INAV"
    ROS_1_BAG = "a bag of ROS 1"
    ZIP = "a ZIP archive"
    GZIP = "a gzip file"
    BZIP2 = "a bzip2 file"
    XZ = "an xz file"
    SEVEN_ZIP = "a 7z archive"
    HDF5 = "an HDF5 file"
    MAT = "a MAT-file"
    PARQUET = "a Parquet file"
    PDF = "a PDF file"
    PNG = "a PNG image"
    JPEG = "a JPEG image"
    PROGRAM = "a program"
    GIT_LFS = "a pointer of Git LFS to a file that is not downloaded"
    XML = "an XML file"
    MARKUP = "an XML or HTML file"
    JSON = "a JSON file"
    ZEROS = "a file of zeros"
    TAR = "a tar archive"
    MAVLINK = "a stream of MAVLink"
    CSV = "a CSV file"
    TEXT = "a text file"
    UNKNOWN = "a file of unknown content"


IMPORTABLE = frozenset({FileKind.ULOG, FileKind.DATAFLASH, FileKind.DATAFLASH_TEXT, FileKind.TLOG})
"""Kinds of logs of autopilots from which `rise-di import` makes a bag."""

PACKED = frozenset({FileKind.ZSTD, FileKind.LZ4})
"""Kinds of packed files, which can hold a log."""

MCAP_BEGINS = frozenset({FileKind.MCAP, FileKind.EMPTY, FileKind.BEGUN})
"""Kinds of files that are an MCAP file or can become one as they grow."""

ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"  # RFC 8878, section 3.1.1
LZ4_MAGIC = b"\x04\x22\x4d\x18"  # LZ4 frame format, Magic Number

MAGICS = MappingProxyType(
    {
        MCAP0_MAGIC: FileKind.MCAP,
        b"SQLite format 3\0": FileKind.SQLITE,
        ZSTD_MAGIC: FileKind.ZSTD,
        LZ4_MAGIC: FileKind.LZ4,
        b"ULog\x01\x12\x35": FileKind.ULOG,  # PX4 guide, ULog file format
        # the head of a packet with the identity FMT (ArduPilot, AP_Logger/LogStructure.h)
        b"\xa3\x95\x80": FileKind.DATAFLASH,
        b"FMT, 128, 89,": FileKind.DATAFLASH_TEXT,
        b"H Product:Blackbox": FileKind.BLACKBOX,
        b"#ROSBAG V": FileKind.ROS_1_BAG,
        b"PK\x03\x04": FileKind.ZIP,
        b"\x1f\x8b": FileKind.GZIP,
        b"BZh": FileKind.BZIP2,
        b"\xfd7zXZ\0": FileKind.XZ,
        b"7z\xbc\xaf\x27\x1c": FileKind.SEVEN_ZIP,
        b"\x89HDF\r\n\x1a\n": FileKind.HDF5,
        b"MATLAB 5.0 MAT-file": FileKind.MAT,
        b"PAR1": FileKind.PARQUET,
        b"%PDF": FileKind.PDF,
        b"\x89PNG": FileKind.PNG,
        b"\xff\xd8\xff": FileKind.JPEG,
        b"\x7fELF": FileKind.PROGRAM,
        b"version https://git-lfs": FileKind.GIT_LFS,
        b"<?xml": FileKind.XML,
        b"<": FileKind.MARKUP,
        b"{": FileKind.JSON,
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


def file_kind(path: Path) -> FileKind:
    """Return the kind of a file. Never raises."""
    try:
        with open_nonblocking(path) as stream:
            head = stream.read(HEAD_BYTES)
    except (OSError, ValueError):
        return FileKind.UNREADABLE
    return kind_of_head(head)


def kind_of_head(head: bytes) -> FileKind:
    """Return the kind of a file by its first HEAD_BYTES bytes.

    If no known format begins with these bytes, the file is a text or has unknown bytes.
    """
    # A recorder that is killed at its start leaves a file that has only the first bytes of an MCAP.
    if MCAP0_MAGIC.startswith(head):
        return FileKind.BEGUN if head else FileKind.EMPTY
    text = head.removeprefix(b"\xef\xbb\xbf").lstrip(b" \t\r\n")
    by_magic = next(
        (
            kind
            for magic, kind in MAGICS.items()
            if (text if magic.isascii() else head).startswith(magic)
        ),
        None,
    )
    if by_magic is not None:
        return by_magic
    kinds = {
        FileKind.ZEROS: not any(head),
        FileKind.TAR: head[TAR_PLACE : TAR_PLACE + len(TAR)] == TAR,
        FileKind.TLOG: tlog_start(head) is not None,
        FileKind.MAVLINK: head[:1] in MAVLINK,
    }
    kind = next((kind for kind, fits in kinds.items() if fits), None)
    return _text_kind(head) if kind is None else kind


def tlog_start(head: bytes) -> int | None:
    """Return the place of the time before a tlog's first packet, or None if there is no packet.

    A radio may send a text before this time when it starts. A tlog with such a text must also have
    a second packet.
    """
    for start in range(len(head) - TLOG_TIME.size):
        end = _packet_end(head, start)
        if end and (start == 0 or end + TLOG_TIME.size >= len(head) or _packet_end(head, end)):
            return start
    return None


def _packet_end(head: bytes, start: int) -> int:
    """Return the end of a MAVLink packet that follows its time, or 0 if there is no packet."""
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


def _text_kind(head: bytes) -> FileKind:
    """Name the kind of a text, or say that the bytes are no text."""
    try:
        text = head.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        # The last character may be cut at the end of the head.
        if error.start < len(head) - 4:
            return FileKind.UNKNOWN
        text = head[: error.start].decode("utf-8-sig")
    if any(not (c.isprintable() or c in "\t\r\n\f") for c in text):
        return FileKind.UNKNOWN
    lines = [line for line in text.splitlines() if line.strip()]
    for separator in ",;\t":
        if len(lines) > 1 and lines[0].count(separator) == lines[1].count(separator) > 0:
            return FileKind.CSV
    return FileKind.TEXT
