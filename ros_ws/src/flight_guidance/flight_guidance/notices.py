# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Write the notices of guidance: sentences on events of a flight.

They report a missed leg, a go-around, an action of the fence, an aircraft that the wind carries
back, a strong wind, a lost link, and new limits. The node logs the sentences as warnings. The
summary of a flight makes the same sentences from the log.
"""

import math
from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np

from flight_core.failures import Failures
from flight_core.vectors import Array, Scalar, array_namespace
from flight_guidance.fence.fence import FenceAction
from flight_guidance.guidance_state import LARGEST, Lateral
from flight_guidance.modes.landing import Landing
from flight_guidance.reach import Authority

DWELL = 10.0
"""A condition must last this long before a notice, and be over as long before the next one, s."""

LEARNED = tuple(f"authority.{name}" for name in Authority._fields)
"""Channels of `guidance`: what the inputs can do, as learned in flight."""

FAILED = "failed"
"""Channel of `guidance`: number of failed steps."""

LAST_REPEATED = "a step of guidance failed, the last u_m is repeated"

LINK_AGE = "age.link"
"""Channel of `guidance`: time since the last message of an operator, s, 0 without a limit."""

TILTED = math.radians(8.0)
"""A multicopter whose tilt exceeds its limit by this much does not follow its commands: a step of
the command to the largest tilt, 30 deg, overshoots by only 1 deg."""

STALE_TIME = 2.0
"""Time for which a pose must be older than its limit before a notice, s."""


class Notice(NamedTuple):
    """A sentence for the log, and the flight time to which it belongs."""

    t: float  # s
    text: str


def is_blown_back(log: Mapping[str, Scalar]) -> Scalar:
    """Return whether a strong wind carries an aircraft back along its path.

    Such an aircraft flies ahead through the air, but goes back over ground. `log` has the channels
    of `guidance`, as values or arrays.
    """
    track = log["track"]
    lateral = log["mode.lateral"]
    xp = array_namespace(track)
    along, wind = (
        log[north] * xp.cos(track) + log[east] * xp.sin(track)
        for north, east in (("pose.v_north", "pose.v_east"), ("wind.north", "wind.east"))
    )
    on_path = (lateral == float(Lateral.ROUTE)) | (lateral == float(Lateral.ORBIT))
    return on_path & (along < 0.0) & (along > wind)


TURNS = {FenceAction.RIGHT, FenceAction.LEFT}


class _Lasting:
    """Decides when to give a notice: once after a condition has held for the time `dwell`, s.

    The notice can be given again only after the condition has not held for `dwell`.
    """

    def __init__(self, dwell: float = DWELL) -> None:
        self._dwell = dwell
        self._holds = False
        self._since = -math.inf
        self._said = False

    def is_due(self, t: float, *, holds: bool) -> bool:
        """Return whether a notice is due at the flight time t, s."""
        if holds != self._holds:
            self._holds = holds
            self._since = t
        if t - self._since < self._dwell:
            return False
        before = self._said
        self._said = holds
        return holds and not before


class Notices:
    """The notices of a flight, made from the log of guidance row by row.

    `wind` and `max_age` are the parameters guidance.wind, m/s, and guidance.max_age, s, and
    `link_timeout` is guidance.home.link_timeout, s. `largest_wind` is a function from a commanded
    airspeed to the largest wind in which the aircraft can fly its route, both in m/s. `reach` is
    the function `targets.reach_sentence`. `largest_tilt` is the largest tilt of a multicopter, rad,
    and `landing` the landing on the route.
    """

    CHANNELS = (
        "leg",
        "missed",
        "mode.lateral",
        "track",
        "V_c",
        "pose.v_north",
        "pose.v_east",
        "wind.north",
        "wind.east",
        "fence.action",
        "fence.clearance",
        "age.pose",
        "pose.phi",
        "pose.theta",
        LINK_AGE,
        *LEARNED,
    )

    def __init__(
        self,
        wind: float,
        max_age: float,
        largest_wind: Callable[[float], float],
        link_timeout: float = math.inf,
        reach: Callable[[Authority], str | None] = lambda authority: None,
        largest_tilt: float = math.inf,
        landing: Landing | None = None,
    ) -> None:
        self._landing = landing
        self._largest_tilt = largest_tilt
        self._tilted = _Lasting(0.0)
        self._reach = reach
        self._authority = Authority()
        self._reach_text: str | None = None
        self._wind = wind
        self._max_age = max_age
        self._largest_wind = largest_wind
        self._link_timeout = link_timeout
        self._link = _Lasting(0.0)
        self._stale = _Lasting(STALE_TIME)
        self._blown = _Lasting()
        self._strong = _Lasting()
        self._leg = 0
        self._action = FenceAction.NONE
        # flight time at which the aircraft left the fence, s; NaN while it is inside
        self._outside_from = math.nan
        self._farthest = 0.0

    def take(self, t: float, log: Mapping[str, float]) -> list[Notice]:
        """Return the notices of a sample at the flight time t, s, from the CHANNELS of the log."""
        before = self._leg
        self._leg = int(log["leg"])
        texts = []
        # The events of this step are a leg, the landing, the fence and new limits.
        if log["missed"] > 0.0:
            texts.append(f"leg {before} missed by {log['missed']:.0f} m")
        if self._landing is not None and before == self._landing.leg < self._leg:
            box = "" if self._landing.box is None else " in guidance.touchdown"
            texts.append(f"goes around: no touch at the end of leg {before}{box}")
        action = self._action
        self._action = FenceAction(int(log["fence.action"]))
        if self._action in TURNS and self._action is not action:
            side = self._action.name.lower()
            texts.append(
                f"fence {log['fence.clearance']:.0f} m away: turns to the {side}, then home"
            )
        texts += self._outside(t, log["fence.clearance"])
        wind = math.hypot(log["wind.north"], log["wind.east"])
        largest = self._largest_wind(log["V_c"])
        authority = Authority(*(log[name] for name in LEARNED))
        if authority != self._authority:
            earlier = self._reach_text
            self._authority = authority
            self._reach_text = self._reach(authority)
            if self._reach_text != earlier:
                texts.append(f"from now on {self._reach_text or 'own limits again'}")
        # The conditions on the link, the pose, the tilt and the wind must last.
        if self._link.is_due(t, holds=log[LINK_AGE] > self._link_timeout):
            texts.append(f"no message of an operator for {self._link_timeout:g} s: home")
        if self._stale.is_due(t, holds=log["age.pose"] > self._max_age):
            texts.append(
                f"pose is {log['age.pose']:.2f} s old, guidance.max_age {self._max_age:g} s"
            )
        tilt = math.acos(math.cos(log["pose.phi"]) * math.cos(log["pose.theta"]))
        if self._tilted.is_due(t, holds=tilt > self._largest_tilt + TILTED):
            texts.append(
                f"the tilt is {math.degrees(tilt):.0f} deg, its limit "
                f"{math.degrees(self._largest_tilt):.0f} deg: a rotor may be lost"
            )
        if self._blown.is_due(t, holds=bool(is_blown_back(log))):
            texts.append(
                f"the ground speed along the path is below 0 for {DWELL:g} s, in a wind of "
                f"{wind:.1f} m/s"
            )
        if self._strong.is_due(t, holds=wind > largest):
            lacks = "circles of the least radius take more than the largest bank"
            if self._largest_tilt < math.inf:
                lacks = "the largest tilt does not hold the speed"
            consequence = f"above {largest:.1f} m/s {lacks}"
            texts.append(f"wind {wind:.1f} m/s, guidance.wind {self._wind:g} m/s: {consequence}")
        return [Notice(t, text) for text in texts]

    def _outside(self, t: float, clearance: float) -> list[str]:
        """Return a sentence if the aircraft has left the fence or is back inside, else nothing.

        While the pose is lost, there is no sentence, because the position is unknown.
        """
        if clearance >= LARGEST:
            return []
        is_outside = clearance < 0.0
        was_outside = not math.isnan(self._outside_from)
        self._farthest = max(self._farthest, -clearance)
        if is_outside and not was_outside:
            self._outside_from = t
            self._farthest = -clearance
            return ["outside of the fence: the shortest way inside, then home"]
        if was_outside and not is_outside:
            lasted = t - self._outside_from
            self._outside_from = math.nan
            return [
                f"inside of the fence after {lasted:.1f} s outside, {self._farthest:.0f} m at most"
            ]
        return []

    def read_log(self, t: Array, log: Mapping[str, Array]) -> list[Notice]:
        """Return the notices of a whole log, whose channels are arrays."""
        columns = [log[name].tolist() for name in self.CHANNELS]
        notices: list[Notice] = []
        for instant, *row in zip(t.tolist(), *columns, strict=True):
            notices += self.take(instant, dict(zip(self.CHANNELS, row, strict=True)))
        failures = Failures()
        rises = t[np.diff(log[FAILED], prepend=0.0) > 0.0]
        notices += [Notice(at, LAST_REPEATED) for at in rises.tolist() if failures.add(at)]
        return sorted(notices, key=lambda notice: notice.t)
