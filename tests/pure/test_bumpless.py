# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Each event in each mode of the controller: u moves by a step of the law, by the ramp to trim or by the rate limit."""

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from flight_bringup.scenarios import find_scenario
from flight_core.modes import Mode
from flight_core.rates import nanoseconds, seconds
from flight_core.vectors import FloatArray, StampedVector
from rise_di_controller.controller import Controller

pytestmark = pytest.mark.package("rise_di_controller")

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
    """A controller at 100 Hz, as its node runs it. Each u is checked."""

    def __init__(self, **changes: Any) -> None:
        self._scenario = SCENARIO.vary(controller=changes)
        self._controller = Controller(self._scenario.controller)
        self._now_ns, self._last_ns = nanoseconds(1.0), 0
        self._active, self._has_y, self._has_y_m, self._offset = True, True, True, 0.0
        self._u, self._u_ns, self._e, self._beyond = np.zeros(4), 0, np.zeros(4), np.zeros(4)
        self._ramp = np.zeros(4), 0.0  # of the present failsafe: the largest abs(u), and the time to trim, s
        self._was_active = True  # at the last tick
        self._silent_ns = 0  # time without u
        self._dt = 0.0

    @property
    def mode(self) -> Mode:
        """Mode of the controller."""
        return self._controller.mode

    @property
    def u(self) -> FloatArray:
        """The last u."""
        return self._u

    @property
    def dt(self) -> float:
        """The step of the law in the last tick, s; 0 at an engagement."""
        return self._dt

    def retune(self, name: str) -> None:
        """Replace parameters by those of RETUNED."""
        self._scenario = self._scenario.vary(controller=dict(RETUNED[name]))
        self._controller.retune(self._scenario.controller)

    def activate(self, *, active: bool) -> None:
        """Activate or deactivate."""
        self._active = active

    def configure(self, *, active: bool) -> None:
        """Deactivate, clean up and configure between two ticks; activate too where `active`."""
        self._controller.restart()
        self.activate(active=active)

    def receive(self, *, y: bool = True, y_m: bool = True) -> None:
        """Receive the samples of these topics from now on."""
        self._has_y, self._has_y_m = y, y_m

    def replace_publisher(self) -> None:
        """Another publisher of y, whose sensors differ."""
        self._offset = 0.03 - self._offset

    def overrun(self, duration: float) -> None:
        """Run no tick for some seconds."""
        self._now_ns += nanoseconds(duration)

    def ticks(self, count: int) -> None:
        """Run ticks."""
        for _ in range(count):
            for instant_ns in self._controller.overrun(self._last_ns, self._now_ns) if self._last_ns else ():
                self._tick(instant_ns)
            if self._has_y:
                self._controller.take_y(StampedVector(self._now_ns, np.full(4, Y + self._offset)), self._now_ns)
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
                f"{self.mode.name}: u is {self._u} and not published, so that the aircraft starts its own failsafe"
            )
            return
        self._silent_ns = 0
        if before in {Mode.ENGAGED, Mode.WAITING} or self._was_active is not self._active:
            self._ramp = np.abs(self._u), self._scenario.controller.ramp
        self._was_active = self._active
        if self.mode is Mode.ENGAGED:
            allowed = self._step_of_the_law(dict(zip(self._controller.names, output.internals, strict=True)))
        else:
            u, ramp = self._ramp
            allowed = u * min(seconds(now_ns - self._u_ns) / ramp, 1.0)
        du = np.abs(output.u - self._u)
        assert (du <= allowed + EXACT).all(), f"{before.name} -> {self.mode.name}: u moves by {du}, above {allowed}"
        self._u, self._u_ns = output.u, now_ns

    def _step_of_the_law(self, logged: Mapping[str, float]) -> FloatArray:
        """The largest change of u in a tick of dt, e_p the error one tick ago; 0 at an engagement, where dt is 0.

        input_scale (K abs(e - e_p + Lambda dt (e + e_p) / 2) + dt beta), equation (23), and what the limits kept back one tick
        ago; but at most SLEW dt. SLEW dt where u is outside of new limits.
        """
        law, limits = self._scenario.rise_di().law_params(), self._scenario.controller.guard().limits
        e_p, self._e = self._e, np.array([logged[f"e.{name}"] for name in SCENARIO.controller.outputs])
        u, u_free = (np.array([logged[f"{key}.{name}"] for name in SCENARIO.controller.inputs]) for key in ("u", "u_free"))
        beyond, self._beyond = self._beyond, np.abs(u_free - u)
        self._dt = dt = logged["dt"]
        change = self._e - e_p + law.Lambda * dt * (self._e + e_p) / 2.0
        step = law.input_scale * (law.K * np.abs(change) + dt * law.beta) + beyond
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


def waiting() -> Loop:
    return Loop()


def engaged(**changes: Any) -> Loop:
    loop = Loop(**changes)
    loop.ticks(20)
    return loop


def stale(count: int) -> Loop:
    loop = engaged()
    loop.receive(y=False, y_m=False)
    loop.ticks(count)
    return loop


def inactive(count: int, **changes: Any) -> Loop:
    loop = engaged(**changes)
    loop.activate(active=False)
    loop.ticks(count)
    return loop


STATES: Mapping[str, tuple[Callable[[], Loop], Mode]] = {
    "waiting": (waiting, Mode.WAITING),
    "engaged": (engaged, Mode.ENGAGED),
    "hold": (lambda: stale(5), Mode.HOLD),
    "ramp": (lambda: stale(15), Mode.RAMP),
    "trim": (lambda: stale(40), Mode.TRIM),
    "inactive, in the ramp": (lambda: inactive(8), Mode.INACTIVE),
    "inactive, at trim": (lambda: inactive(40), Mode.INACTIVE),
    "inactive, held": (lambda: inactive(8, on_deactivate="hold"), Mode.INACTIVE),
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
@example(policy="trim", events=[("y lost", 1), ("configured and activated", 10)])  # stale before the law engages again
def test_no_sequence_of_events_makes_u_jump(policy: str, events: list[tuple[str, int]]) -> None:
    loop = engaged(on_deactivate=policy)
    for name, count in events:
        EVENTS[name](loop)
        loop.ticks(count)


def test_configuration_engages_the_law_again() -> None:
    loop = engaged()
    loop.configure(active=True)
    loop.ticks(1)
    assert loop.dt == 0.0
    loop.ticks(1)
    assert loop.dt > 0.0
