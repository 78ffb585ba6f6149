# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test that no event in any mode makes u jump.

The tests check the u of the controller, the u that the aircraft applies, and the u that a bridge
sends.

In each tick, the u of the controller changes at most by a step of the law, by the ramp to trim or
by the rate limit.
"""

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from tests.maps import named_map

from aircraft_sim.applied_input import AppliedInput
from autopilot_bridge.bridge import Bridge, Phase
from autopilot_bridge.channel_map import to_channel
from autopilot_bridge.params import ChannelMap
from flight_analysis.closed_loop.scenario_library import find_scenario
from flight_core.modes import Mode
from flight_core.outcome import Refusal
from flight_core.rates import nanoseconds, seconds
from flight_core.vectors import ChannelError, FloatArray, StampedVector
from rise_di_controller.controller import Controller

SLEW = 0.5  # limit of abs(u_dot), rad/s and 1/s
SCENARIO = find_scenario("osprey_gust").vary(
    controller={"max_age": 0.03, "hold": 0.05, "ramp": 0.2, "slew": [SLEW] * 4, "sign": "soft"}
)
Y = 0.05  # rad/s and m/s, each output: u is not 0, and moves
EXACT = 1e-12  # u is a sum of about ten terms of at most 1

RETUNED: Mapping[str, Mapping[str, Any]] = {
    "other gains": {"k_g": 3.0, "Lambda": [1.0, 1.0, 1.0, 1.0], "beta": [10.0, 10.0, 10.0, 5.0]},
    "longer failsafe": {"hold": 0.3, "ramp": 3.0},
    "shorter failsafe": {"hold": 0.0, "ramp": 0.02},
    "longer age limit": {"max_age": 0.2},
    "narrower limits": {"lower": [-0.002] * 4, "upper": [0.002] * 4},
}


class Loop:
    """Run a controller at 100 Hz as its node does, and check each u."""

    def __init__(self, **changes: Any) -> None:
        self._scenario = SCENARIO.vary(controller=changes)
        self._controller = Controller(self._scenario.controller)
        self._now_ns = nanoseconds(1.0)
        self._last_ns = 0
        self._active = True
        self._has_y = True
        self._has_y_m = True
        self._offset = 0.0
        self._u = np.zeros(4)
        self._u_ns = 0
        self._e = np.zeros(4)
        self._excess = np.zeros(4)  # what the limits kept back
        # of the present failsafe: the largest abs(u), and the time to trim, s
        self._ramp = (np.zeros(4), 0.0)
        self._was_active = True  # at the last tick
        self._silent_ns = 0  # time without u
        self._dt = 0.0

    @property
    def mode(self) -> Mode:
        """Return the mode of the controller."""
        return self._controller.mode

    @property
    def u(self) -> FloatArray:
        """Return the last u."""
        return self._u

    @property
    def dt(self) -> float:
        """Return the step of the law in the last tick, s. At an engagement it is 0."""
        return self._dt

    def retune(self, name: str) -> None:
        """Replace parameters by a set of RETUNED."""
        self._scenario = self._scenario.vary(controller=dict(RETUNED[name]))
        self._controller.retune(self._scenario.controller)

    def activate(self, *, active: bool) -> None:
        """Activate or deactivate."""
        self._active = active

    def configure(self, *, active: bool) -> None:
        """Deactivate, clean up and configure between two ticks, and activate again if `active`."""
        self._controller.restart()
        self.activate(active=active)

    def receive(self, *, y: bool = True, y_m: bool = True) -> None:
        """Choose which topics have samples from now on."""
        self._has_y = y
        self._has_y_m = y_m

    def replace_publisher(self) -> None:
        """Replace the publisher of y by one with other sensor errors."""
        self._offset = 0.03 - self._offset

    def overrun(self, duration: float) -> None:
        """Let `duration` s pass without a tick."""
        self._now_ns += nanoseconds(duration)

    def ticks(self, count: int) -> None:
        """Run ticks."""
        for _ in range(count):
            for instant_ns in (
                self._controller.overrun(self._last_ns, self._now_ns) if self._last_ns else ()
            ):
                self._tick(instant_ns)
            if self._has_y:
                self._controller.take_y(
                    StampedVector(self._now_ns, np.full(4, Y + self._offset)), self._now_ns
                )
            if self._has_y_m:
                self._controller.take_y_m(StampedVector(self._now_ns, np.zeros(4)), self._now_ns)
            self._tick(self._now_ns)
            self._last_ns = self._now_ns
            self._now_ns += self._controller.period_ns

    def _tick(self, now_ns: int) -> None:
        before = self.mode
        output = self._controller.tick(now_ns, active=self._active)
        if output is None:
            self._silent_ns += self._controller.period_ns
            silent = self._u.any() and seconds(self._silent_ns) > self._scenario.controller.max_age
            assert not silent, (
                f"{self.mode.name}: u is {self._u} and not published, so that the aircraft "
                "starts its own failsafe"
            )
            return
        self._silent_ns = 0
        if before in {Mode.ENGAGED, Mode.WAITING} or self._was_active is not self._active:
            self._ramp = np.abs(self._u), self._scenario.controller.ramp
        self._was_active = self._active
        if self.mode is Mode.ENGAGED:
            allowed = self._step_of_the_law(
                dict(zip(self._controller.names, output.internals, strict=True))
            )
        else:
            u, ramp = self._ramp
            allowed = u * min(seconds(now_ns - self._u_ns) / ramp, 1.0)
        du = np.abs(output.u - self._u)
        assert (du <= allowed + EXACT).all(), (
            f"{before.name} -> {self.mode.name}: u moves by {du}, above {allowed}"
        )
        self._u = output.u
        self._u_ns = now_ns

    def _step_of_the_law(self, logged: Mapping[str, float]) -> FloatArray:
        """Return the largest change of u that a tick may make, (m,).

        It is input_scale (K abs(e - e_p + Lambda dt (e + e_p) / 2) + dt beta), from equation (23),
        plus the part that the limits held back one tick ago, and at most SLEW dt. e_p is the error
        one tick ago. If u is outside of new limits, it is SLEW dt. At an engagement dt is 0, and so
        is the result.
        """
        law = self._scenario.rise_di().law_params()
        limits = self._scenario.controller.guard().limits
        e_p = self._e
        self._e = np.array([logged[f"e.{name}"] for name in SCENARIO.controller.outputs])
        u, u_free = (
            np.array([logged[f"{key}.{name}"] for name in SCENARIO.controller.inputs])
            for key in ("u", "u_free")
        )
        excess = self._excess
        self._excess = np.abs(u_free - u)
        self._dt = dt = logged["dt"]
        change = self._e - e_p + law.Lambda * dt * (self._e + e_p) / 2.0
        step = law.input_scale * (law.K * np.abs(change) + dt * law.beta) + excess
        outside = (self._u < limits.lower) | (self._u > limits.upper)
        return np.where(outside, SLEW * dt, np.minimum(step, SLEW * dt)) if dt else np.zeros(4)


EVENTS: Mapping[str, Callable[[Loop], None]] = {
    "deactivated": lambda loop: loop.activate(active=False),
    "activated": lambda loop: loop.activate(active=True),
    "configured": lambda loop: loop.configure(active=False),
    "configured and activated": lambda loop: loop.configure(active=True),
    "y lost": lambda loop: loop.receive(y=False),
    "y_m lost": lambda loop: loop.receive(y_m=False),
    "y and y_m": Loop.receive,
    "another publisher of y": Loop.replace_publisher,
    "overrun of 0.02 s": lambda loop: loop.overrun(0.02),
    "overrun of 0.1 s": lambda loop: loop.overrun(0.1),
    "overrun of 1 s": lambda loop: loop.overrun(1.0),
    **{name: lambda loop, name=name: loop.retune(name) for name in RETUNED},  # type: ignore[misc]
}


def waiting_loop() -> Loop:
    return Loop()


def engaged_loop(**changes: Any) -> Loop:
    loop = Loop(**changes)
    loop.ticks(20)
    return loop


def stale_loop(count: int) -> Loop:
    loop = engaged_loop()
    loop.receive(y=False, y_m=False)
    loop.ticks(count)
    return loop


def inactive_loop(count: int, **changes: Any) -> Loop:
    loop = engaged_loop(**changes)
    loop.activate(active=False)
    loop.ticks(count)
    return loop


STATES: Mapping[str, tuple[Callable[[], Loop], Mode]] = {
    "waiting": (waiting_loop, Mode.WAITING),
    "engaged": (engaged_loop, Mode.ENGAGED),
    "hold": (lambda: stale_loop(5), Mode.HOLD),
    "ramp": (lambda: stale_loop(15), Mode.RAMP),
    "trim": (lambda: stale_loop(40), Mode.TRIM),
    "inactive, in the ramp": (lambda: inactive_loop(8), Mode.INACTIVE),
    "inactive, at trim": (lambda: inactive_loop(40), Mode.INACTIVE),
    "inactive, held": (lambda: inactive_loop(8, on_deactivate="hold"), Mode.INACTIVE),
}


@pytest.mark.parametrize("event", EVENTS)
@pytest.mark.parametrize("state", STATES)
def test_no_event_makes_u_jump(state: str, event: str) -> None:
    make, mode = STATES[state]
    loop = make()
    assert loop.mode is mode
    EVENTS[event](loop)
    loop.ticks(60)  # beyond age limit, hold and ramp
    loop.receive()
    loop.activate(active=True)
    loop.ticks(20)
    assert loop.mode is Mode.ENGAGED
    assert np.abs(loop.u).min() > 0.0


@settings(deadline=None)
@given(
    policy=st.sampled_from(["trim", "hold"]),
    events=st.lists(st.tuples(st.sampled_from([*EVENTS]), st.integers(0, 12)), max_size=20),
)
# y is stale before the law engages again.
@example(policy="trim", events=[("y lost", 1), ("configured and activated", 10)])
def test_no_sequence_of_events_makes_u_jump(policy: str, events: list[tuple[str, int]]) -> None:
    loop = engaged_loop(on_deactivate=policy)
    for name, count in events:
        EVENTS[name](loop)
        loop.ticks(count)


def test_configuration_engages_the_law_again() -> None:
    loop = engaged_loop()
    loop.configure(active=True)
    loop.ticks(1)
    assert loop.dt == 0.0
    loop.ticks(1)
    assert loop.dt > 0.0


# The aircraft

HELD, RAMP = 0.25, 0.4  # s, of the failsafe of the aircraft; HELD includes the age limit
STEP = 0.005  # s, of the aircraft
PUBLISHED = {"first": 0.1, "restarted": -0.1, "standby": 0.05}  # u, constant, by publisher
LARGEST = 0.1
# largest step of u: the ramp to trim, and the fading offset of a transfer
FADING = (LARGEST + 2.0 * LARGEST) * STEP / RAMP


class Applied:
    """Record the u that the aircraft applies at each step, while messages arrive at 100 Hz."""

    def __init__(self) -> None:
        self._input = AppliedInput(1, nanoseconds(HELD), nanoseconds(RAMP))
        self._publisher, self._number = "", 0
        self.u: list[float] = []

    def fly(self, duration: float, publisher: str | None = None, u: float | None = None) -> None:
        """Fly with the messages of a publisher, or without messages if `publisher` is None.

        If `u` is given, it replaces the u of PUBLISHED.
        """
        for _ in range(round(duration / STEP)):
            now_ns = nanoseconds(self._number * STEP)
            if publisher is not None and self._number % 2 == 0:
                value = np.array([PUBLISHED[publisher] if u is None else u])
                self._input.take(value, now_ns, transfer=publisher != self._publisher)
                self._publisher = publisher
            self.u.append(float(self._input.u_at(now_ns)[0]))
            self._number += 1


# s: in time, held, in the ramp twice, at trim
@pytest.mark.parametrize("silence", [0.0, 0.1, 0.3, 0.5, 1.0])
@pytest.mark.parametrize("publisher", ["first", "restarted"])
def test_u_that_returns_does_not_jump(publisher: str, silence: float) -> None:
    """A publisher sends another u after the ramp has begun, and u does not jump.

    A restarted publisher may do so at any time.
    """
    u = PUBLISHED["first" if publisher == "first" and silence < HELD else "restarted"]
    aircraft = Applied()
    aircraft.fly(1.0, "first")
    aircraft.fly(silence)
    aircraft.fly(1.0, publisher, u)
    assert np.abs(np.diff(aircraft.u)).max() <= FADING + EXACT
    assert aircraft.u[-1] == u


@settings(deadline=None)
@given(st.lists(st.tuples(st.sampled_from([None, *PUBLISHED]), st.integers(1, 150)), max_size=20))
def test_no_sequence_of_publishers_and_silences_makes_applied_u_jump(
    parts: list[tuple[str | None, int]],
) -> None:
    aircraft = Applied()
    for publisher, steps in parts:
        aircraft.fly(steps * STEP, publisher)
    u = np.array([0.0, *aircraft.u])  # in trim before
    assert np.abs(np.diff(u)).max(initial=0.0) <= FADING + EXACT
    assert np.abs(u).max() <= LARGEST + EXACT


@pytest.mark.parametrize("duration", [0.05, 0.12, 0.2, 1.0])
def test_overrun_leaves_u_where_aircraft_has_it(duration: float) -> None:
    """After an overrun, controller and aircraft have the same u within two periods of the ramp.

    They have the same age limit, hold and ramp.
    """
    loop = engaged_loop()
    before = loop.u
    guard = SCENARIO.controller.guard()
    aircraft = AppliedInput(4, guard.max_age_ns + guard.hold_ns, guard.ramp_ns)
    aircraft.take(before, 0, transfer=False)
    loop.overrun(duration)
    loop.receive(y=False, y_m=False)
    loop.ticks(1)
    late = np.abs(before) * 2 * guard.period_ns / guard.ramp_ns
    assert (
        np.abs(loop.u - aircraft.u_at(nanoseconds(duration) + guard.period_ns)) <= late + EXACT
    ).all()


# The bridge

TICK = 0.01  # s, of the bridge
RATE = 4.0  # abs(u_dot) of the controller that the bridge receives, 1/s and rad/s
COMMANDED = 1.5  # u of the active controller, beyond the limits of each input of the map


class Engagement:
    """Run a bridge at 100 Hz with y, a controller, and another controller with the opposite u.

    The aircraft is far from trim while the bridge is ENGAGED. The bridge's node activates the
    controller at an engagement. Each sent u is checked.
    """

    def __init__(self) -> None:
        content = named_map("ardupilot_2024").model_dump()
        content["silence"] = {"max_age": 0.05, "neutral": 0.1, "release": 0.1}
        self._map = ChannelMap.validate_mapping(content, "map")
        self.bridge = Bridge(self._map, dry_run=False)
        self.receives = {"y": True, "u": True, "conflicting u": False}
        self._t = 0.0
        # of the controller, and the instant of the last u that the bridge took
        self._u, self._received_t = (0.0, 0.0)
        # the last u sent while ENGAGED, and the instant of receipt
        self._sent: tuple[FloatArray, float] | None = None

    def ticks(self, count: int) -> None:
        """Run ticks."""
        for _ in range(count):
            self._t += TICK
            now_ns = nanoseconds(1000.0 + self._t)
            if self.receives["y"]:
                for name in self._map.outputs:
                    self.bridge.take_output(name, 0.0, now_ns, now_ns)
            target = COMMANDED if self.bridge.phase is Phase.ENGAGED else 0.0
            self._u += min(max(target - self._u, -RATE * TICK), RATE * TICK)
            if self.receives["u"]:
                self._receive_u("/controller#1", self._u, now_ns)
            if self.receives["conflicting u"]:
                self._receive_u("/controller#2", -self._u, now_ns)
            self.bridge.step(now_ns)
            self._check_sent(now_ns)

    def now_ns(self) -> int:
        """Return the instant of the last tick, ns."""
        return nanoseconds(1000.0 + self._t)

    def _receive_u(self, sender: str, u: float, now_ns: int) -> None:
        """Take or refuse a u as the receiver of the node does."""
        try:
            self.bridge.u_lock.check(sender, now_ns)
        except ChannelError:
            return
        self.bridge.take_u(StampedVector(now_ns, np.full(len(self._map.inputs), u), sender), now_ns)
        self.bridge.u_lock.refresh(sender, now_ns)
        self._received_t = self._t

    def _check_sent(self, now_ns: int) -> None:
        rows = list(self._map.inputs.values())
        phase = self.bridge.phase
        assert self.bridge.is_sent("joy", now_ns) == (phase is not Phase.DISENGAGED)
        raw = self.bridge.raw()
        if phase is not Phase.ENGAGED:
            self._sent = None
            resting = [row.neutral if phase is Phase.NEUTRAL else row.release for row in rows]
            np.testing.assert_array_equal(raw, np.array(resting))
            return
        u = np.array(
            [
                to_channel(raw_i, row.conversion) - row.trim
                for raw_i, row in zip(raw.tolist(), rows, strict=True)
            ]
        )
        lower, upper = (np.array([getattr(row, key) for row in rows]) for key in ("lower", "upper"))
        assert ((u >= lower - EXACT) & (u <= upper + EXACT)).all()
        # From trim at the engagement, and by the controller in the tick after.
        allowed = self._map.engage_within * np.where(u > 0.0, upper, -lower) + RATE * TICK
        du = u
        if self._sent is not None:
            du = u - self._sent[0]
            allowed = np.full(len(rows), RATE * (self._received_t - self._sent[1]))
        assert (np.abs(du) <= allowed + EXACT).all(), (
            f"u sent to the autopilot moves by {du}, above {allowed}"
        )
        self._sent = u, self._received_t


def switch(key: str) -> Callable[[Engagement], None]:
    def toggle(loop: Engagement) -> None:
        loop.receives[key] = not loop.receives[key]

    return toggle


REQUESTS: Mapping[str, Callable[[Engagement], object]] = {
    "engage": lambda loop: loop.bridge.engage(loop.now_ns()),
    "disengage": lambda loop: loop.bridge.disengage(Refusal("by request"), loop.now_ns()),
    **{key: switch(key) for key in ("y", "u", "conflicting u")},
}


@settings(deadline=None)
@given(st.lists(st.tuples(st.sampled_from([*REQUESTS]), st.integers(0, 25)), max_size=30))
@example([("engage", 2), ("u", 3), ("u", 4)])  # u returns within the age limit
# The second publisher comes at the timeout of u.
@example([("engage", 3), ("u", 3), ("conflicting u", 9), ("engage", 9)])
def test_no_sequence_of_events_makes_sent_u_jump(events: list[tuple[str, int]]) -> None:
    loop = Engagement()
    loop.ticks(1)
    for name, count in events:
        REQUESTS[name](loop)
        loop.ticks(count)


def test_engagement_of_sequences_sends_u() -> None:
    loop = Engagement()
    loop.ticks(1)
    assert loop.bridge.engage(loop.now_ns()) is None
    loop.ticks(20)
    assert loop.bridge.phase is Phase.ENGAGED
    assert loop.bridge.raw().any()
