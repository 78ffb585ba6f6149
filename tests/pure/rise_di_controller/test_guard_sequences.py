# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test any sequence of samples, losses, overruns and activations.

The tests check when the guard engages, how far u moves, when u is at trim, and that no stamp of u
goes back.
"""

import numpy as np
import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, rule

from flight_analysis.closed_loop.scenario_library import find_scenario
from flight_core.modes import Mode
from flight_core.rates import seconds
from flight_core.vectors import FloatArray, StampedVector
from rise_di_controller.guard import guard

MS = 1_000_000
SLEW = 0.5  # limit of abs(u_dot), rad/s and 1/s
CONFIG = find_scenario("osprey_gust").controller.model_copy(
    update={
        "max_age": 0.03,
        "hold": 0.05,
        "ramp": 0.2,
        "slew": (SLEW,) * 4,
        "lower": (-0.1,) * 4,
        "upper": (0.2,) * 4,
    }
)
PARAMS = {
    policy: CONFIG.model_copy(update={"on_deactivate": policy}).guard()
    for policy in ("trim", "hold")
}
LAW = CONFIG.tuned_law()
AGE = CONFIG.guard().max_age_ns
EXACT = 1e-12  # u is below 1: rounding is some 1e-16

# ns from the clock
STAMPS = st.sampled_from([0, 0, 0, -AGE, AGE, -AGE - 1, AGE + 1, -MS, MS, -1000 * MS, 1000 * MS])
VALUES = st.sampled_from([-0.3, 0.0, 0.05, 1.0, 1e9])  # rad/s and m/s


class Sequence(RuleBasedStateMachine):
    """A guard with its clock, its newest samples and the instant at which the failsafe began."""

    def __init__(self) -> None:
        super().__init__()
        self.state = guard.initial_state(4)
        self.guard = PARAMS["trim"]
        self.now_ns = 10_000 * MS
        self.active = True
        self.y: StampedVector | None = None
        self.y_m: list[StampedVector] = []
        self.begin_ns, self.begin_u, self.hold = 0, np.zeros(4), 0.0
        self.stamp_ns = 0  # of the last u

    @rule(active=st.booleans(), policy=st.sampled_from([*PARAMS]))
    def activate(self, active: bool, policy: str) -> None:
        """Activate or deactivate the guard, with a policy for u after a deactivation.

        A held u must not turn into a ramp.
        """
        if self.state.mode is not Mode.INACTIVE:
            self.guard = PARAMS[policy]
        self.active = active

    @rule(duration=st.integers(1, 1000))
    def overrun(self, duration: int) -> None:
        """Let `duration` ms pass without a tick."""
        self.now_ns += duration * MS

    @rule(offset=STAMPS, value=VALUES)
    def receive_y(self, offset: int, value: float) -> None:
        """Receive a y, which may be old or ahead of the clock."""
        self.y = StampedVector(self.now_ns + offset, np.full(4, value))

    @rule(offset=STAMPS, value=VALUES)
    def receive_y_m(self, offset: int, value: float) -> None:
        """Receive a y_m, which is kept if it is newer."""
        self._keep_y_m(StampedVector(self.now_ns + offset, np.full(4, value)))

    @rule(count=st.integers(1, 12), offset=STAMPS, y=VALUES, y_m=VALUES)
    def fly(self, count: int, offset: int, y: float, y_m: float) -> None:
        """Run ticks, each with a new y and a new y_m of the same stamp. No y_m is newer than y."""
        for k in range(count):
            stamp_ns = self.now_ns + offset
            self.y = StampedVector(stamp_ns, np.full(4, y))
            self.y_m = [sample for sample in self.y_m if sample.stamp_ns < stamp_ns]
            self._keep_y_m(StampedVector(stamp_ns, np.full(4, y_m)))
            # A y from before the last u waits, at most for the lead of that u and its own age.
            has_waited = k * self.guard.period_ns >= 2 * AGE
            waits = self.state.mode is not Mode.ENGAGED and stamp_ns < self.stamp_ns
            self.tick()
            is_fresh = self.active and abs(offset) <= AGE
            assert (self.state.mode is Mode.ENGAGED) == (is_fresh and not waits)
            assert not (is_fresh and has_waited and waits)

    @rule(count=st.integers(1, 12))
    def wait(self, count: int) -> None:
        """Run ticks without a new sample."""
        for _ in range(count):
            self.tick()

    def _keep_y_m(self, sample: StampedVector) -> None:
        if not self.y_m or sample.stamp_ns > self.y_m[-1].stamp_ns:
            self.y_m = [*self.y_m, sample][-guard.SAMPLE_BUFFER_SIZE :]

    def tick(self) -> None:
        """Run a tick, check the new state, and advance the clock by a period."""
        before = self.state
        self.state, inputs = guard.tick(
            before, self.now_ns, self.y, self.y_m, self.guard, LAW, self.active
        )
        if inputs is not None:
            assert inputs.stamp_ns >= self.stamp_ns
            self.stamp_ns = inputs.stamp_ns
        if self.state.mode is Mode.ENGAGED:
            self._check_law(before, 0.0 if inputs is None else inputs.dt)
        elif self.state.law is None:
            assert self.state.mode is (Mode.WAITING if self.active else Mode.INACTIVE)
            assert not self.state.u.any()
        else:
            self._check_failsafe(before)
        self.now_ns += self.guard.period_ns

    def _check_law(self, before: guard.ControllerState, dt: float) -> None:
        assert self.active
        assert self.y is not None
        assert all(abs(self.now_ns - sample.stamp_ns) <= AGE for sample in (self.y, self.y_m[-1]))
        assert (np.abs(self.state.u - before.u) <= SLEW * dt + EXACT).all()
        assert (self.state.u >= np.array(CONFIG.lower)).all()
        assert (self.state.u <= np.array(CONFIG.upper)).all()

    def _check_failsafe(self, before: guard.ControllerState) -> None:
        if before.mode is Mode.ENGAGED or (before.mode is Mode.INACTIVE) == self.active:
            self.begin_ns = self.now_ns
            self.begin_u = before.u
            self.hold = CONFIG.hold if self.active else 0.0
        if not self.active and self.guard.deactivation_holds:
            expected = self.begin_u
            mode = Mode.INACTIVE
        else:
            expected, mode = self._expected(seconds(self.now_ns - self.begin_ns) - self.hold)
        assert self.state.mode is mode
        assert self.state.u == pytest.approx(expected, rel=0.0, abs=EXACT)

    def _expected(self, ramped: float) -> tuple[FloatArray, Mode]:
        """Return the expected u and mode, `ramped` s after the end of the hold.

        u moves to trim along a straight line.
        """
        part = min(max(ramped / CONFIG.ramp, 0.0), 1.0)
        mode = Mode.HOLD if ramped <= 0.0 else Mode.RAMP if part < 1.0 else Mode.TRIM
        return (1.0 - part) * self.begin_u, mode if self.active else Mode.INACTIVE


TestSequence = Sequence.TestCase
TestSequence.settings = settings(max_examples=150, stateful_step_count=30, deadline=None)
