# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Check the stamps of a topic in the order in which they were recorded.

The check finds steps of the clock that made the stamps, damaged stamps and equal stamps.
"""

from collections.abc import Iterator, Mapping
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from flight_core.rates import NANOSECONDS, seconds
from flight_core.tape import LostPart, Recording, Signal

STEP_NS = NANOSECONDS // 10  # ns, least backward step of a clock
# ns, least forward step of a clock, relative to the time of the recording
LEAP_NS = NANOSECONDS // 4
# ns. If the stamps go back by more than this for fewer than CONFIRMED messages, these stamps are
# damaged.
STRAY_NS = NANOSECONDS
LATE_NS = 4 * NANOSECONDS  # ns, largest delay of a recorder's first sample on a busy host
# Number of successive messages that confirm a step. Fewer messages come from another publisher, or
# have a damaged stamp.
CONFIRMED = 10
CONFIRMED_AT_END = 3  # number of messages that confirm a step at the end of a topic
SINCE_EPOCH_NS = 10**15  # larger stamps count from 1970, not from the start of the flight


class StampClock:
    """Finds which samples of a topic are usable, if the clock of their stamps makes a step.

    A sample with a damaged stamp is left out. The samples after a forward step stay, because only
    `without_leaps`, which sees all topics, can decide about these samples.
    """

    def __init__(self) -> None:
        self._count = self._unset = self._repeated = self._left_out = 0
        self._step_ns = self._step_at_ns = 0
        self._last_ns: int | None = None  # last usable stamp
        self._last_offset_ns = 0  # the last usable stamp minus the time of its recording
        self._offset_ns = -(2**62)  # largest lead of a stamp over the time of its recording
        self._is_history = False  # whether the last samples were recorded in a burst
        # last stamps before pauses in which no topic was received
        self._pauses_ns: set[int] = set()

    def usable(
        self,
        stamp_ns: NDArray[np.int64],
        log_ns: NDArray[np.int64],
        steps: NDArray[np.int64] | None = None,
        *,
        more: bool,
        end: bool = False,
    ) -> tuple[NDArray[np.bool_], int]:
        """Return a mask of the usable messages among the first K messages, shape (K,), and K.

        Give the messages after the first K to the next call again. It is not clear yet whether the
        clock has made a step there, so the messages that follow must decide. `more` says whether
        there are such messages, and if not, K is the number of all messages. `end` is true for the
        last messages of the topic. `steps` has the increase of the publisher's message number from
        message to message. If this number and both times go back together, the log is out of order
        there, and the clock made no step. If a forward jump of the stamps skips numbers, messages
        were lost, and the jump is a gap.
        """
        latest = np.maximum.accumulate(np.append(self._last_ns or 0, stamp_ns))[:-1]
        if self._step_ns:
            return self._taken(stamp_ns, self._is_after_step(stamp_ns), len(stamp_ns), 0)
        keep = (stamp_ns != 0) | (latest <= STEP_NS)
        places = np.flatnonzero(keep)
        stamps = stamp_ns[places]
        offsets = stamps - log_ns[places]
        has_time = log_ns[places] != 0
        offset_before = offsets[:1] if self._last_ns is None else self._last_offset_ns
        jumps = np.diff(stamps, prepend=stamps[:1] if self._last_ns is None else self._last_ns)
        leads = np.diff(offsets, prepend=offset_before)
        numbers = np.ones(len(stamps), dtype=np.int64) if steps is None else steps[places]
        back = (jumps < -STEP_NS) & ((numbers >= 0) | (np.abs(leads) > STEP_NS))
        forth = (jumps > STEP_NS) & ((leads > STEP_NS) | ~has_time) & (numbers <= 1)
        # If nothing is received meanwhile, the publisher or the host has paused, not the clock.
        with_reception = (jumps > LEAP_NS) & (leads <= LEAP_NS) & has_time
        self._pauses_ns.update((stamps - jumps)[with_reception].tolist())
        # At these indices the clock may have made a step.
        starts = np.flatnonzero(back | forth)
        edges = [0, *starts[starts > 0].tolist(), len(stamps)]
        for first, after in pairwise(edges if len(stamps) else []):
            is_last = after == len(stamps)
            jump_ns, is_ahead = self._jump_to(
                int(stamps[first]), int(offsets[first]), has_time=bool(has_time[first])
            )
            # If the clock continues, nothing needs a confirmation.
            goes_on = self._last_ns is not None and jump_ns >= 0 and not is_ahead
            is_short = after - first < (CONFIRMED_AT_END if is_last and end else CONFIRMED)
            if is_short and not (goes_on and first not in starts):
                if is_last and more and first > 0:
                    return self._taken(stamp_ns, keep[: places[first]], int(places[first]))
                if jump_ns < -STRAY_NS or is_ahead:
                    keep[places[first:after]] = False
                continue
            is_back = jump_ns < -STEP_NS and bool(back[first])
            if is_back and has_time[first]:
                is_late = self._catches_up(stamps[first:], offsets[first:])
                if is_late is None and more:  # the next messages will decide
                    return self._taken(stamp_ns, keep[: places[first]], int(places[first]))
                is_back = not is_late
            if is_back or is_ahead:
                self._step_ns = jump_ns
                self._step_at_ns = self._last_ns or 0
                after_step = int(places[first])
                keep[after_step:] = self._is_after_step(stamp_ns[after_step:])
                return self._taken(stamp_ns, keep, len(stamp_ns), after_step)
            # The first clock is confirmed here. Earlier messages only stay if they fit it.
            if self._last_ns is None:
                keep[places[:first]] &= _is_same_clock(stamps[: first + 1], offsets[: first + 1])
            self._follow(stamps[first:after], offsets[first:after])
        return self._taken(stamp_ns, keep, len(stamp_ns))

    def _follow(self, stamp_ns: NDArray[np.int64], offset_ns: NDArray[np.int64]) -> None:
        """Store the last stamp of successive messages that have the same clock, for later calls."""
        self._last_ns = int(stamp_ns[-1])
        self._last_offset_ns = int(offset_ns[-1])
        self._offset_ns = max(self._offset_ns, int(offset_ns.max()))
        if stamp_ns[-1] - stamp_ns[0] > STEP_NS:
            self._is_history = _is_in_burst(stamp_ns, offset_ns)

    def _catches_up(self, stamp_ns: NDArray[np.int64], offset_ns: NDArray[np.int64]) -> bool | None:
        """Return whether the samples after a backward step are only late.

        A late sample is at most STRAY_NS older than the previous one. After at most STRAY_NS of
        reception, such samples have caught up. If the clock was set back, the samples stay behind.
        Returns None if there are too few messages to decide.
        """
        if self._last_ns is None or stamp_ns[0] < self._last_ns - STRAY_NS:
            return False
        log_ns = stamp_ns - offset_ns
        within = log_ns <= log_ns[0] + STRAY_NS
        if np.any(offset_ns[within] >= self._last_offset_ns - STEP_NS):
            return True
        return None if within.all() else False

    def _jump_to(self, stamp_ns: int, offset_ns: int, *, has_time: bool) -> tuple[int, bool]:
        """Return how far a stamp is from the last usable stamp, ns, and whether the stamp leads.

        A stamp leads if it is too far ahead of the time of the recording, unless the last samples
        are a history that was recorded in a burst. The returned time is 0 if there is no usable
        stamp yet.
        """
        # There is no usable stamp yet, or only a stamp that was not set.
        if not self._last_ns:
            return 0, False
        jump_ns = stamp_ns - self._last_ns
        is_ahead = jump_ns > LEAP_NS and offset_ns > self._offset_ns + LEAP_NS
        return jump_ns, is_ahead and has_time and not self._is_history

    def _is_after_step(self, stamp_ns: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Return a mask of the samples that stay after a step of the clock.

        After a forward step, only samples with a stamp before the step are left out. After a
        backward step, all samples are left out.
        """
        return (stamp_ns > self._step_at_ns) & (self._step_ns > 0)

    def _taken(
        self,
        stamp_ns: NDArray[np.int64],
        keep: NDArray[np.bool_],
        count: int,
        after_step: int | None = None,
    ) -> tuple[NDArray[np.bool_], int]:
        before = count if after_step is None else after_step
        self._count += count
        self._repeated += int(np.count_nonzero(np.diff(stamp_ns[:count]) == 0))
        self._unset += int(np.count_nonzero(~keep[:before]))
        self._left_out += count - before
        return keep, count

    def recording(self, unset: int = 0) -> Recording:
        """Return what was found about the stamps.

        `unset` more messages are counted as messages without a stamp.
        """
        return Recording(
            found=self._count,
            unset=self._unset + unset,
            repeated=self._repeated,
            step_ns=self._step_ns,
            step_at_ns=self._step_at_ns,
            left_out=self._left_out,
            pauses_ns=tuple(sorted(self._pauses_ns)),
        )


def _is_same_clock(stamp_ns: NDArray[np.int64], offset_ns: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Return which of the samples before the last one may have the same clock as it has."""
    away_ns = stamp_ns[-1] - stamp_ns[:-1]
    lead_ns = offset_ns[-1] - offset_ns[:-1]
    is_near = (away_ns <= STRAY_NS) | (lead_ns <= LATE_NS)
    return np.asarray((away_ns >= -STEP_NS) & is_near)


def _is_in_burst(stamp_ns: NDArray[np.int64], offset_ns: NDArray[np.int64]) -> bool:
    """Return whether the last samples were recorded all at once, as the history of a publisher is.

    The last samples are taken over LEAP_NS by their stamps. In a burst they were recorded in less
    than half of this time. This happens when a recorder starts late, and receives the history of
    the publisher at once. A pause in such a history is no step of the clock.
    """
    recent = stamp_ns >= stamp_ns[-1] - LEAP_NS
    span_ns = stamp_ns[-1] - stamp_ns[recent][0]
    rise_ns = offset_ns[-1] - offset_ns[recent][0]
    return bool(rise_ns > max(STEP_NS, span_ns // 2))


def recording_note(name: str, recording: Recording, start_ns: int) -> str | None:
    """Write a sentence about the stamps of a topic, or return None if all of them are usable."""
    parts = []
    if recording.unset:
        parts.append(
            f"{recording.unset} of {recording.found} samples have no usable stamp and are left out"
        )
    if recording.step_ns:
        way = "back" if recording.step_ns < 0 else "forth"
        t = seconds(recording.step_at_ns - start_ns)
        step = (
            f"the clock of its stamps steps {way} by {abs(seconds(recording.step_ns)):.3f} s "
            f"at t = {t:.3f} s"
        )
        parts.append(f"{step}: the {recording.left_out} samples after the step are left out")
    return f"{name}: {'; '.join(parts)}" if parts else None


class Leap(NamedTuple):
    """A forward step of the clock that shows in the stamps of all topics at one instant."""

    at_ns: int  # the last stamp before the leap
    by_ns: int  # the size of the leap

    def undone(self, stamp_ns: NDArray[np.int64]) -> NDArray[np.int64]:
        """Convert stamps to the clock as it was before the leap."""
        return stamp_ns - np.where(stamp_ns > self.at_ns + STEP_NS, self.by_ns, 0)


LOOP = ("y", "y_m", "u", "internals", "truth")  # topics that must all show a leap of the clock


def without_leaps(
    signals: Mapping[str, Signal], recording: Mapping[str, Recording]
) -> tuple[dict[str, Signal], dict[str, Recording], list[Leap]]:
    """Take forward steps of the clock out of the stamps of all topics.

    Returns the signals, what is now known of each recording, and the leaps. A leap is a forward
    step that shows in all topics. If only a single topic shows a step, the samples of this topic
    after it are left out.
    """
    mended = dict(signals)
    clocks = dict(recording)
    leaps: list[Leap] = []
    for leap in _candidates(signals, recording):
        earlier = Leap(leap.at_ns - sum(before.by_ns for before in leaps), leap.by_ns)
        leaping = [name for name, signal in mended.items() if _has_gap(signal, earlier)]
        loop = [
            name
            for name in LOOP
            if name in mended and mended[name].stamp_ns[-1] > earlier.at_ns + STEP_NS
        ]
        # A single topic has its own clock.
        if len(loop) < 2 or not {*loop} <= {*leaping}:
            continue
        leaps.append(earlier)
        for name in leaping:
            signal = mended[name]
            mended[name] = Signal(
                earlier.undone(signal.stamp_ns), signal.names, signal.values, signal.sender
            )
            if name in clocks and clocks[name].step_ns > 0:
                clocks[name] = clocks[name]._replace(step_ns=0, step_at_ns=0, left_out=0)
    for name, clock in clocks.items():
        if clock.step_ns > 0 and name in mended:
            mended[name] = mended[name].until(clock.step_at_ns)
    return mended, clocks, leaps


def _candidates(
    signals: Mapping[str, Signal], recording: Mapping[str, Recording]
) -> Iterator[Leap]:
    """Yield possible leaps: instants at which the stamps jump ahead of a second measure of time.

    The second measure is the flight time in `truth`. Without `truth` it is a constant period of the
    messages, provided that no message is lost. A gap in which nothing was received is no leap,
    because the host was busy or suspended, but its clock continued.
    """
    name = next((name for name in ("truth", "y_m", "y") if name in signals), "")
    if not name:
        return
    stamp_ns = signals[name].stamp_ns
    elapsed_ns = np.diff(stamp_ns)
    if "t" in signals[name].names:
        # A damaged flight time can overflow.
        with np.errstate(over="ignore", invalid="ignore"):
            flown_ns = np.diff(np.round(signals[name]["t"] * NANOSECONDS))
    elif len(elapsed_ns) and all(
        recording[topic].lost == 0 for topic in LOOP if topic in recording
    ):
        flown_ns = np.full(len(elapsed_ns), np.median(elapsed_ns))
    else:
        return
    lead_ns = elapsed_ns - flown_ns
    if "t" not in signals[name].names and name in recording:
        lead_ns[np.isin(stamp_ns[:-1], recording[name].pauses_ns)] = 0
    for k in np.flatnonzero((lead_ns > LEAP_NS) & (lead_ns < 2**62)):
        yield Leap(int(stamp_ns[k]), int(lead_ns[k]))


def _has_gap(signal: Signal, leap: Leap) -> bool:
    """Return whether a topic has no sample within a leap."""
    after = int(np.searchsorted(signal.stamp_ns, leap.at_ns + STEP_NS, side="right"))
    if not 0 < after < len(signal.stamp_ns):
        return False
    return bool(signal.stamp_ns[after] - signal.stamp_ns[after - 1] >= leap.by_ns)


def lost_in_leap(leap: Leap, start_ns: int) -> LostPart:
    """Return the span of the flight that is lost in a leap of the clock."""
    times = f"{seconds(leap.by_ns):.3f} s at t = {seconds(leap.at_ns - start_ns):.3f} s"
    return LostPart(sentence=f"the clock of all stamps leaps forth by {times}")


def leap_note(lost: LostPart) -> str:
    """Write the note about a leap of the clock."""
    return f"{lost.sentence}: later times are by the clock before the leap"
