# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Bridge to an autopilot, without ROS: y from its messages, setpoints for u, engagement, pilot override and failsafe.

It reads no clock: every instant is an argument, in ns of one clock. The watchdogs of y and u end an engagement.
"""

import math
from enum import IntEnum
from typing import NamedTuple

import numpy as np

from autopilot_bridge.channel_map import to_channel, to_raw
from autopilot_bridge.params import ChannelMap, MeasuredRow
from flight_core.rates import nanoseconds, seconds
from flight_core.vectors import ChannelError, FloatArray, StampedVector, require_newer


class Phase(IntEnum):
    """Phase of the engagement: what the autopilot is sent."""

    DISENGAGED = 0  # nothing, except an offboard heartbeat
    ENGAGED = 1  # u
    NEUTRAL = 2  # failsafe: u timed out, the neutral values are sent
    RELEASE = 3  # the release values, which return the channels to the autopilot


class Reading(NamedTuple):
    """The newest value of a channel and the instant to which it belongs."""

    stamp_ns: int
    value: float


class Bridge:
    """The newest y and u, the phase and the pilot override. Only `engage` engages: the bridge never re-engages by itself."""

    def __init__(self, channel_map: ChannelMap, *, dry_run: bool) -> None:
        self.channel_map = channel_map
        self.dry_run = dry_run
        self.outputs, self.inputs = tuple(channel_map.outputs), tuple(channel_map.inputs)
        self.phase = Phase.DISENGAGED
        self.reason = "not engaged yet"  # why the bridge is not engaged
        self._rows: dict[str, MeasuredRow] = {**channel_map.pose, **channel_map.outputs}
        self._readings: dict[str, Reading] = {}
        self._last_y_ns = -1  # stamp of the last y
        self._last_pose_ns = -1  # stamp of the last pose
        self._u: FloatArray = np.zeros(len(self.inputs))
        self._u_sender: str | None = None
        self._u_ns = 0  # when u was received
        self._active_override = ""  # name of the pilot override
        self._phase_ns = 0  # start of the phase
        rows = channel_map.inputs.values()
        self._lower, self._upper = (np.array([getattr(row, key) for row in rows]) for key in ("lower", "upper"))
        self._max_age_ns = nanoseconds(channel_map.silence.max_age)

    # Inputs

    def take_output(self, name: str, raw: float, stamp_ns: int, now_ns: int) -> None:
        """Take a value of a channel of y or of the pose: sign scale raw + offset.

        Raises ChannelError: reason "stamp" where the stamp differs from now by more than the age limit, reason "order" where it
        is not later than the previous one.
        """
        row = self._rows[name]
        if abs(now_ns - stamp_ns) > nanoseconds(row.max_age):
            hint = "" if row.stamp == "arrival" else "; set stamp: arrival in the map if the autopilot has another clock"
            raise ChannelError("stamp", f"{name} is stamped {seconds(now_ns - stamp_ns):.3f} s before now{hint}")
        last = self._readings.get(name)
        if last is not None:
            require_newer(stamp_ns, last.stamp_ns, name)
        self._readings[name] = Reading(stamp_ns, to_channel(raw, row.line))

    def take_u(self, u: FloatArray, sender: str, now_ns: int) -> None:
        """Take u, shape (m,) in the map's order. Raises ChannelError, reason "sender", for a conflicting publisher."""
        if sender != self._u_sender and not self.u_timed_out(now_ns):
            raise ChannelError("sender", f"conflicting publisher {sender} ignored: already receiving from {self._u_sender}")
        self._u, self._u_sender, self._u_ns = u, sender, now_ns

    def take_override(self, name: str, raw: float, now_ns: int) -> None:
        """Take the field of a pilot override. Beyond its threshold the bridge disengages at once."""
        if self.channel_map.overrides[name].is_active(raw):
            self._active_override = name
            if self.phase in {Phase.ENGAGED, Phase.NEUTRAL}:
                self.disengage(f"pilot override by {name}", now_ns)
        elif self._active_override == name:
            self._active_override = ""

    # State

    def stale(self, now_ns: int) -> dict[str, str]:
        """The stale channels of y and of the envelope, each with the reason as a sentence."""
        watched = dict.fromkeys((*self.outputs, *self.channel_map.envelope))
        return {name: reason for name in watched if (reason := self._staleness(name, now_ns))}

    def _staleness(self, name: str, now_ns: int) -> str:
        """Why a channel of y or of the pose is stale, as a sentence; empty where it is fresh."""
        row, reading = self._rows[name], self._readings.get(name)
        if reading is None:
            return f"{name} not received yet ({row.topic})"
        if now_ns - reading.stamp_ns > nanoseconds(row.max_age):
            return f"{name} is {seconds(now_ns - reading.stamp_ns):.2f} s old ({row.topic})"
        return ""

    def _outside(self) -> str:
        """The fresh channels that are outside the envelope, as a sentence; empty where none is."""
        values = ((name, self._readings[name].value, limits) for name, limits in self.channel_map.envelope.items())
        return "; ".join(
            f"{name} is {value:.3g}, outside the envelope [{lower:g}, {upper:g}]"
            for name, value, (lower, upper) in values
            if not lower <= value <= upper
        )

    def u_timed_out(self, now_ns: int) -> bool:
        """Whether no u was received, or none for longer than its age limit."""
        return self._u_sender is None or now_ns - self._u_ns > self._max_age_ns

    def _u_timeout(self, now_ns: int) -> str:
        """The reason why u has timed out, as a sentence; empty where u is fresh."""
        if self._u_sender is None:
            return "u not received yet"
        return f"u is {seconds(now_ns - self._u_ns):.2f} s old" if self.u_timed_out(now_ns) else ""

    def ready(self, now_ns: int) -> bool:
        """Whether y and u are fresh."""
        return not self.stale(now_ns) and not self.u_timed_out(now_ns)

    def refusal(self, now_ns: int) -> str:
        """The reason why `engage` would be refused now; empty where it would not."""
        if self.dry_run:
            return "dry_run is true: nothing is sent"
        if self._active_override:
            return f"pilot override active: {self._active_override}"
        if stale := "; ".join(filter(None, (*self.stale(now_ns).values(), self._u_timeout(now_ns)))):
            return stale
        if outside := self._outside():
            return outside
        limits = self.channel_map.engage_within * np.where(self._u > 0.0, self._upper, -self._lower)
        for name, u, limit in zip(self.inputs, self._u, limits, strict=True):
            if abs(u) > limit:
                return f"u.{name} is {u:.3g} from trim, more than {limit:.3g}: deactivate the controller until u is at trim"
        return ""

    def engage(self, now_ns: int) -> str:
        """Engage. Returns the reason of a refusal as a sentence, empty where it engaged."""
        if self.phase is Phase.ENGAGED:
            return ""
        refusal = self.refusal(now_ns)
        if not refusal:
            self.reason = ""
            self._enter(Phase.ENGAGED, now_ns)
        return refusal

    def disengage(self, reason: str, now_ns: int) -> None:
        """Disengage from any phase: return the channels to the autopilot."""
        if self.phase not in {Phase.DISENGAGED, Phase.RELEASE}:
            self.reason = reason
            self._enter(Phase.RELEASE, now_ns)

    def step(self, now_ns: int) -> Phase:
        """Phase at an instant. A stale y or u ends an engagement, and the phases NEUTRAL and RELEASE end after their times."""
        if self.phase is Phase.ENGAGED:
            if stale := self.stale(now_ns):
                self.disengage("; ".join(stale.values()), now_ns)
            elif outside := self._outside():
                self.disengage(outside, now_ns)
            elif timeout := self._u_timeout(now_ns):
                self.reason = timeout
                self._enter(Phase.NEUTRAL, now_ns)
        times = self.channel_map.silence
        if self.phase is Phase.NEUTRAL and now_ns - self._phase_ns >= nanoseconds(times.neutral):
            self._enter(Phase.RELEASE, now_ns)
        if self.phase is Phase.RELEASE and now_ns - self._phase_ns >= nanoseconds(times.release):
            self._enter(Phase.DISENGAGED, now_ns)
        return self.phase

    # Outputs

    def y(self, now_ns: int) -> StampedVector | None:
        """Sample of y at the stamp of the map's output `instant`; None where it was returned before or a channel is stale."""
        newest = self._readings.get(self.channel_map.instant)
        if newest is None or newest.stamp_ns <= self._last_y_ns or any(self._staleness(name, now_ns) for name in self.outputs):
            return None
        self._last_y_ns = newest.stamp_ns
        return StampedVector(newest.stamp_ns, np.array([self._readings[name].value for name in self.outputs]))

    def pose(self, now_ns: int) -> tuple[tuple[str, ...], StampedVector] | None:
        """Names and values of the fresh channels of the pose, at the stamp of its first row; None where that is not new.

        psi is in -pi..pi. A channel that was not received or is stale is left out.
        """
        first = next(iter(self.channel_map.pose), None)
        newest = None if first is None else self._readings.get(first)
        if newest is None or newest.stamp_ns <= self._last_pose_ns:
            return None
        self._last_pose_ns = newest.stamp_ns
        names = tuple(name for name in self.channel_map.pose if not self._staleness(name, now_ns))
        values = {name: self._readings[name].value for name in names}
        if "psi" in values:
            values["psi"] = math.remainder(values["psi"], math.tau)
        return names, StampedVector(newest.stamp_ns, np.array(list(values.values())))

    def raw_u(self) -> FloatArray:
        """Raw values of the newest u after saturation, shape (m,): raw of trim + min(max(u, lower), upper)."""
        u = np.minimum(np.maximum(self._u, self._lower), self._upper)
        rows = self.channel_map.inputs.values()
        return np.array([to_raw(row.trim + u_i, row.line) for row, u_i in zip(rows, u.tolist(), strict=True)])

    def raw(self) -> FloatArray:
        """Raw values that are sent in this phase, shape (m,)."""
        if self.phase is Phase.ENGAGED:
            return self.raw_u()
        key = "neutral" if self.phase is Phase.NEUTRAL else "release"
        return np.array([getattr(row, key) for row in self.channel_map.inputs.values()])

    def sends(self, name: str, now_ns: int) -> bool:
        """Whether a message of the map is sent now. A dry run sends none."""
        if self.dry_run:
            return False
        if self.channel_map.messages[name].when == "ready":
            return self.ready(now_ns)
        return self.phase is not Phase.DISENGAGED

    def _enter(self, phase: Phase, now_ns: int) -> None:
        self.phase, self._phase_ns = phase, now_ns
