# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""The clock of the stamps of a topic, followed in the order of the recording: steps, damaged stamps, equal stamps."""

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from flight_core.rates import NANOSECONDS, seconds
from flight_core.tape import Recording

STEP_NS = NANOSECONDS // 10  # back: late samples are less late
LEAP_NS = NANOSECONDS // 2  # forth, beside the time of the recording
STRAY_NS = NANOSECONDS  # back: fewer messages than CONFIRMED that are so much older have a damaged stamp
CONFIRMED = 10  # successive messages after a step; fewer are those of a further publisher, or have a damaged stamp
CONFIRMED_AT_END = 3
SINCE_EPOCH_NS = 10**15  # larger stamps count from 1970, not from the start of the flight


class StampClock:
    """Follows the stamps of a topic. A step of the clock ends the usable part of the topic; a damaged stamp is left out."""

    def __init__(self) -> None:
        self._found = self._unset = self._repeated = self._left_out = 0
        self._step_ns = self._step_at_ns = 0
        self._last_ns: int | None = None  # of the usable part
        self._last_offset_ns = 0
        self._offset_ns = -(2**62)  # the largest lead of a stamp over the time of the recording

    def usable(
        self, stamp_ns: NDArray[np.int64], log_ns: NDArray[np.int64], *, more: bool, end: bool = False
    ) -> tuple[NDArray[np.bool_], int]:
        """Mask of the usable messages of the next K messages, shape (K,), and K.

        With `more` messages to come at once, K is less than the number of messages where the last messages confirm no step.
        `end`: the messages are the last messages of the topic.
        """
        unset = (stamp_ns == 0) & ((self._last_ns or 0) > STEP_NS)
        if self._step_ns:
            return self._taken(stamp_ns, np.zeros(len(stamp_ns), dtype=bool), len(stamp_ns))
        known = np.flatnonzero(~unset)
        stamps = stamp_ns[known]
        offsets = stamp_ns[known] - log_ns[known]
        timed = log_ns[known] != 0
        before = stamps[:1] if self._last_ns is None else self._last_ns
        offset_before = offsets[:1] if self._last_ns is None else self._last_offset_ns
        jumps = np.diff(stamps, prepend=before)
        leads = np.diff(offsets, prepend=offset_before) > STEP_NS
        starts = np.flatnonzero((jumps < -STEP_NS) | ((jumps > STEP_NS) & (leads | ~timed)))  # of messages with one clock
        edges = [0, *starts[starts > 0].tolist(), len(stamps)]
        keep = ~unset
        for first, after in pairwise(edges if len(stamps) else []):
            is_last = after == len(stamps)
            jump_ns, is_ahead = self._jump_to(int(stamps[first]), int(offsets[first]), has_time=bool(timed[first]))
            if after - first < (CONFIRMED_AT_END if is_last and end else CONFIRMED):
                if is_last and more and first > 0:
                    return self._taken(stamp_ns, keep[: known[first]], int(known[first]))
                if jump_ns < -STRAY_NS or is_ahead:
                    keep[known[first:after]] = False
                continue
            if jump_ns < -STEP_NS or is_ahead:
                self._step_ns = jump_ns
                self._step_at_ns = self._last_ns or 0
                keep[known[first] :] = False
                break
            if self._last_ns is None:  # the messages before are too few to be the begin of the clock
                away_ns = stamps[first] - stamps[:first]
                lead_ns = offsets[first] - offsets[:first]
                # a recorder on a busy host stores its first sample late: a lead below STRAY_NS is no damage
                keep[known[:first]] &= (away_ns >= -STEP_NS) & ((away_ns <= STRAY_NS) | (lead_ns <= STRAY_NS))
            self._last_ns = int(stamps[after - 1])
            self._last_offset_ns = int(offsets[after - 1])
            self._offset_ns = max(self._offset_ns, int(offsets[first:after].max()))
        return self._taken(stamp_ns, keep, len(stamp_ns))

    def _jump_to(self, stamp_ns: int, offset_ns: int, *, has_time: bool) -> tuple[int, bool]:
        """From the usable part to a stamp, ns, 0 without one; and whether the stamp is ahead of the clock."""
        if self._last_ns is None:
            return 0, False
        jump_ns = stamp_ns - self._last_ns
        return jump_ns, jump_ns > LEAP_NS and has_time and offset_ns > self._offset_ns + LEAP_NS

    def _taken(self, stamp_ns: NDArray[np.int64], keep: NDArray[np.bool_], count: int) -> tuple[NDArray[np.bool_], int]:
        counted_ns = stamp_ns[:count]
        self._found += count
        self._repeated += int(np.count_nonzero(np.diff(counted_ns) == 0))
        if self._step_ns:
            self._left_out += int(np.count_nonzero(~keep))
        else:
            self._unset += int(np.count_nonzero(~keep))
        return keep, count

    def recording(self, unset: int = 0) -> Recording:
        """The result; `unset`: further messages without a usable stamp."""
        return Recording(self._found, self._unset + unset, self._repeated, self._step_ns, self._step_at_ns, self._left_out)


def recording_note(name: str, recording: Recording, start_ns: int) -> str:
    """The sentence on the stamps of a topic; empty for a clock without steps and damaged stamps."""
    parts = []
    if recording.unset:
        parts.append(f"{recording.unset} of {recording.found} samples have no usable stamp and are left out")
    if recording.step_ns:
        way = "back" if recording.step_ns < 0 else "forth"
        t = seconds(recording.step_at_ns - start_ns)
        step = f"the clock of its stamps steps {way} by {abs(seconds(recording.step_ns)):.3f} s at t = {t:.3f} s"
        parts.append(f"{step}: the {recording.left_out} samples after the step are left out")
    return f"{name}: {'; '.join(parts)}" if parts else ""
