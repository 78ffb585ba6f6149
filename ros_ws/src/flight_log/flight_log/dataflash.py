# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Find the messages of a DataFlash log on a card that lost bytes.

Source: ArduPilot, AP_Logger/LogStructure.h (log_Format). A packet has no checksum.
"""

import struct
from bisect import bisect_left
from collections.abc import Callable
from typing import Any

from pymavlink import DFReader

from flight_log.vehicle_tables import Loss

HEAD = b"\xa3\x95"
FORMAT = 0x80  # identity of a packet that declares a format
# A log counts as whole if it ends with fewer bytes than this that hold no packet (pymavlink,
# DFReader.py).
TAIL = 528


class Packets(DFReader.DFReader_binary):
    """The packets of a log, each followed by another packet or by the end of the log.

    pymavlink's own index would end where bytes are lost, because an unknown packet appears there.
    """

    def init_arrays(self, progress_callback: Callable[[int], None] | None = None) -> None:
        """Index the packets, and list the spans of bytes that hold no packet."""
        self.name_to_id: dict[str, int] = {}
        self.id_to_name: dict[int, str] = {}
        self.offsets: list[list[int]] = [[] for _ in range(256)]
        # first byte and end of each span without a packet, and the place of the previous packet
        self.lost: list[tuple[int, int, int]] = []
        here = before = 0
        while here < self.data_len:
            if length := self._length(here):
                self.offsets[self.data_map[here + 2]].append(here)
                before = here
                here += length
                continue
            start = here
            while here < self.data_len and not self._length(here):
                here = self.data_map.find(HEAD, here + 1)
                here = self.data_len if here < 0 else here
            self.lost.append((start, here, before))
        self.counts = [len(places) for places in self.offsets]
        self._count = sum(self.counts)
        self.offset = 0

    init_arrays_fast = init_arrays

    def _length(self, here: int) -> int:
        """Return the length of the packet at a place, bytes, or 0 if there is no whole packet."""
        form = self.formats.get(int.from_bytes(self.data_map[here + 2 : here + 3], "little"))
        if self.data_map[here : here + 2] != HEAD or form is None:
            return 0
        end = here + form.len
        if end > self.data_len or self.data_map[end : end + 2] not in (HEAD, b"", HEAD[:1]):
            return 0
        if form.type == FORMAT and not self._declare(self.data_map[here + 3 : end]):
            return 0
        return int(form.len)

    def _declare(self, content: bytes) -> bool:
        """Learn the format that a packet declares. Returns False if the format is damaged."""
        identity, length, *texts = struct.unpack(self.formats[FORMAT].msg_struct, content)
        name, types, columns = map(DFReader.null_term, texts)
        try:
            form = DFReader.DFFormat(
                identity, name, length, types, columns, oldfmt=self.formats.get(identity)
            )
        # pymavlink raises Exception for a format with unknown types
        except Exception:
            return False
        size = len(HEAD) + 1 + struct.calcsize(form.msg_struct)
        if not name or size != length or len(form.columns) != len(types):
            return False
        self.formats[identity] = form
        self.name_to_id[name] = identity
        self.id_to_name[identity] = name
        return True

    def _stamp_ns(self, place: int) -> int:
        """Return the stamp of the packet at a place, ns, or 0 if the packet has no stamp."""
        self.offset = place
        return round(1e3 * stamp_us(self._parse_next(), 0.0))

    def loss(self) -> Loss | None:
        """Return how many bytes hold no packet, and when, or None for a log without loss."""
        lost = self.lost
        if lost and lost[-1][1] == self.data_len and lost[-1][1] - lost[-1][0] < TAIL:
            lost = lost[:-1]
        if not lost:
            return None
        count = sum(end - start for start, end, _ in lost)
        places = f" at {len(lost)} places" if len(lost) > 1 else ""
        return Loss(
            f"{count} of {self.data_len} bytes{places} hold no message",
            self._stamp_ns(lost[0][2]),
            self._stamp_ns(lost[-1][2]),
        )


class Lines(DFReader.DFReader_text):
    """The lines of a text log that fit their format."""

    offset: int

    def init_arrays(self, progress_callback: Callable[[int], None] | None = None) -> None:
        """Index the lines, and count the lines without a message."""
        self.offsets: dict[str, list[int]] = {}
        self._places: list[int] = []
        self.lost_us: list[float] = []  # last stamp before each line without a message, us
        newest_us = 0.0
        here: int = self.offset
        self._count = 0
        while 0 <= here < self.data_len:
            end = self.data_map.find(b"\n", here)
            end = self.data_len if end < 0 else end
            line = self.data_map[here:end].strip()
            if (message := self._message(here, line)) is not None:
                newest_us = stamp_us(message, newest_us)
                self.offsets.setdefault(message.get_type(), []).append(here)
                self._places.append(here)
            elif line:
                self.lost_us.append(newest_us)
            self._count += bool(line)
            here = end + 1
        self.counts = {name: len(places) for name, places in self.offsets.items()}
        self.offset = 0

    def _parse_next(self) -> Any:
        """Return the message of the next line that holds a message."""
        place = bisect_left(self._places, self.offset)
        if place == len(self._places):
            self.offset = self.data_len
            return None
        self.offset = self._places[place]
        return super()._parse_next()

    def _message(self, here: int, line: bytes) -> Any:
        """Return the message of a line, or None if the line is damaged."""
        try:
            name, *values = line.decode().split(self.delimiter)
            form = self.formats.get(name)
            if form is None or len(values) < len(form.format):
                return None
            message = DFReader.DFMessage(form, values, False, self)
            # This converts each value, so that a damaged value raises an exception here.
            message.to_dict()
            if name == "FMT":
                self.offset = here
                super()._parse_next()
        # pymavlink raises Exception for a format with unknown types
        except Exception:
            return None
        return message

    def loss(self) -> Loss | None:
        """Return how many lines hold no message, and when, or None for a log without loss."""
        if not self.lost_us:
            return None
        what = f"{len(self.lost_us)} of {self._count} lines hold no message"
        return Loss(what, round(1e3 * self.lost_us[0]), round(1e3 * self.lost_us[-1]))


def stamp_us(message: Any, before_us: float) -> float:
    """Return the stamp of a message, us; `before_us` if the message has no stamp.

    In logs of 2014 and earlier, MODE has no stamp, and the other messages have a stamp in ms.
    """
    return float(getattr(message, "TimeUS", 1e3 * getattr(message, "TimeMS", 1e-3 * before_us)))
