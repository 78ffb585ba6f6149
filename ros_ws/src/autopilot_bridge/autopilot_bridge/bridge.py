# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""The bridge from sample to sample: y from what the autopilot said, what it is to be sent for u, and when nothing is.

No ROS and no clock: every instant is an argument, ns of one clock.
"""

from enum import IntEnum
from typing import NamedTuple

import numpy as np

from autopilot_bridge.channel_map import to_channel, to_raw
from autopilot_bridge.params import ChannelMap
from flight_core.rates import nanoseconds, seconds
from flight_core.vectors import ChannelError, FloatArray, StampedVector, require_newer


class Phase(IntEnum):
    """What the autopilot is sent."""

    DISENGAGED = 0  # nothing, but heartbeats that are sent before engagement too
    ENGAGED = 1  # u
    NEUTRAL = 2  # u has fallen silent: the neutral values
    RELEASE = 3  # the values that give the channels back


class Reading(NamedTuple):
    """A channel's newest value and the instant it belongs to."""

    stamp_ns: int
    value: float


class Bridge:
    """What has come, what goes out. Engaged by `engage` alone: what has ended an engagement never begins another one."""

    def __init__(self, channel_map: ChannelMap, *, dry_run: bool) -> None:
        self.channel_map = channel_map
        self.dry_run = dry_run
        self.outputs, self.inputs = tuple(channel_map.outputs), tuple(channel_map.inputs)
        self.phase = Phase.DISENGAGED
        self.reason = "not engaged yet"  # why it is not engaged
        self._readings: dict[str, Reading] = {}
        self._given_ns = -1  # the instant of the last y
        self._u: FloatArray = np.zeros(len(self.inputs))
        self._u_from: str | None = None
        self._u_ns = 0  # when it came
        self._pilot = ""  # the override with which the pilot has taken over
        self._phase_ns = 0  # when the phase began
        rows = channel_map.inputs.values()
        self._lower, self._upper = (np.array([getattr(row, key) for row in rows]) for key in ("lower", "upper"))
        self._max_age_ns = nanoseconds(channel_map.silence.max_age)

    # What comes

    def take_output(self, name: str, raw: float, stamp_ns: int, now_ns: int) -> None:
        """A new value of a channel of y, y = sign scale raw + offset.

        Raises ChannelError, reason "stamp" where its instant is further from now than its age limit, "order" where it is not
        newer than the last one.
        """
        row = self.channel_map.outputs[name]
        if abs(now_ns - stamp_ns) > nanoseconds(row.max_age):
            hint = "" if row.stamp == "arrival" else "; where the autopilot keeps another time, say stamp: arrival in the map"
            raise ChannelError("stamp", f"{name} is stamped {seconds(now_ns - stamp_ns):.3f} s before now{hint}")
        last = self._readings.get(name)
        if last is not None:
            require_newer(stamp_ns, last.stamp_ns, name)
        self._readings[name] = Reading(stamp_ns, to_channel(raw, row.line))

    def take_u(self, u: FloatArray, sender: str, now_ns: int) -> None:
        """A new u, shape (m,) in the map's order. Raises ChannelError, reason "sender", while another one flies."""
        if sender != self._u_from and not self.u_timed_out(now_ns):
            raise ChannelError("sender", f"conflicting publisher {sender} ignored: already receiving from {self._u_from}")
        self._u, self._u_from, self._u_ns = u, sender, now_ns

    def take_override(self, name: str, raw: float, now_ns: int) -> None:
        """The pilot's field: beyond its threshold the pilot has the aircraft, at once."""
        if self.channel_map.overrides[name].is_active(raw):
            self._pilot = name
            if self.phase in {Phase.ENGAGED, Phase.NEUTRAL}:
                self.disengage(f"the pilot has taken over by {name}", now_ns)
        elif self._pilot == name:
            self._pilot = ""

    # What is said of it

    def stale(self, now_ns: int) -> dict[str, str]:
        """Channels of y that are missing or older than their limit, each with what is wrong with it."""
        found = {}
        for name, row in self.channel_map.outputs.items():
            reading = self._readings.get(name)
            if reading is None:
                found[name] = f"{name} has not come yet ({row.topic})"
            elif now_ns - reading.stamp_ns > nanoseconds(row.max_age):
                found[name] = f"{name} is {seconds(now_ns - reading.stamp_ns):.2f} s old ({row.topic})"
        return found

    def u_timed_out(self, now_ns: int) -> bool:
        """Whether there is no u, or none for longer than its limit."""
        return self._u_from is None or now_ns - self._u_ns > self._max_age_ns

    def _silence(self, now_ns: int) -> tuple[str, ...]:
        """What is wrong with u, nothing where it is fresh."""
        if self._u_from is None:
            return ("u has not come yet",)
        return (f"u is {seconds(now_ns - self._u_ns):.2f} s old",) if self.u_timed_out(now_ns) else ()

    def ready(self, now_ns: int) -> bool:
        """Whether y and u are fresh."""
        return not self.stale(now_ns) and not self.u_timed_out(now_ns)

    def refusal(self, now_ns: int) -> str:
        """Why it would not engage now, empty where it would."""
        if self.dry_run:
            return "dry_run is true: nothing is sent"
        if self._pilot:
            return f"the pilot has the aircraft by {self._pilot}"
        if missing := (*self.stale(now_ns).values(), *self._silence(now_ns)):
            return "; ".join(missing)
        room = self.channel_map.engage_within * np.where(self._u > 0.0, self._upper, -self._lower)
        for name, u, most in zip(self.inputs, self._u, room, strict=True):
            if abs(u) > most:
                return f"u.{name} is {u:.3g} from trim, more than {most:.3g}: deactivate the controller until u is at trim"
        return ""

    def engage(self, now_ns: int) -> str:
        """Engage, unless there is something against it, which is returned as a sentence."""
        if self.phase is Phase.ENGAGED:
            return ""
        refusal = self.refusal(now_ns)
        if not refusal:
            self.reason = ""
            self._enter(Phase.ENGAGED, now_ns)
        return refusal

    def disengage(self, reason: str, now_ns: int) -> None:
        """Give the channels back, whatever phase it is."""
        if self.phase not in {Phase.DISENGAGED, Phase.RELEASE}:
            self.reason = reason
            self._enter(Phase.RELEASE, now_ns)

    def step(self, now_ns: int) -> Phase:
        """The phase at an instant: y or u too old ends an engagement; neutral and releasing values have their time."""
        if self.phase is Phase.ENGAGED:
            if stale := self.stale(now_ns):
                self.disengage("; ".join(stale.values()), now_ns)
            elif silence := self._silence(now_ns):
                self.reason = silence[0]
                self._enter(Phase.NEUTRAL, now_ns)
        times = self.channel_map.silence
        if self.phase is Phase.NEUTRAL and now_ns - self._phase_ns >= nanoseconds(times.neutral):
            self._enter(Phase.RELEASE, now_ns)
        if self.phase is Phase.RELEASE and now_ns - self._phase_ns >= nanoseconds(times.release):
            self._enter(Phase.DISENGAGED, now_ns)
        return self.phase

    # What goes out

    def y(self, now_ns: int) -> StampedVector | None:
        """The newest value of each output, at the instant of the map's `instant`; None where it was given, or one is stale."""
        newest = self._readings.get(self.channel_map.instant)
        if newest is None or newest.stamp_ns <= self._given_ns or self.stale(now_ns):
            return None
        self._given_ns = newest.stamp_ns
        return StampedVector(newest.stamp_ns, np.array([self._readings[name].value for name in self.outputs]))

    def raw_u(self) -> FloatArray:
        """The raw values for the newest u inside its limits, shape (m,): raw of trim + min(max(u, lower), upper)."""
        u = np.minimum(np.maximum(self._u, self._lower), self._upper)
        rows = self.channel_map.inputs.values()
        return np.array([to_raw(row.trim + one, row.line) for row, one in zip(rows, u.tolist(), strict=True)])

    def raw(self) -> FloatArray:
        """The raw values that this phase sends, shape (m,)."""
        if self.phase is Phase.ENGAGED:
            return self.raw_u()
        key = "neutral" if self.phase is Phase.NEUTRAL else "release"
        return np.array([getattr(row, key) for row in self.channel_map.inputs.values()])

    def sends(self, name: str, now_ns: int) -> bool:
        """Whether a message of the map is sent in this phase; in a dry run none is."""
        if self.dry_run:
            return False
        if self.channel_map.messages[name].when == "ready":
            return self.ready(now_ns)
        return self.phase is not Phase.DISENGAGED

    def _enter(self, phase: Phase, now_ns: int) -> None:
        self.phase, self._phase_ns = phase, now_ns
