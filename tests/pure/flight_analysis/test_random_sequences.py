# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test the controller with random sequences of samples, losses, faults of y and changes.

The tests check what u may do, and that the replay of the log is equal.
"""

from typing import Any, NamedTuple

import numpy as np
import pytest

from flight_analysis.closed_loop.replay import replay
from flight_analysis.closed_loop.scenario_library import find_scenario
from flight_core.modes import Mode
from flight_core.parameters import ParameterError
from flight_core.rates import seconds
from flight_core.tape import Signal, Tape
from flight_core.vectors import ChannelError, FloatArray, StampedVector
from rise_di_controller.controller import Controller
from rise_di_controller.guard.guard import LEAST_DT
from rise_di_controller.params import ControllerConfig

pytestmark = pytest.mark.slow

SIGNS = ("soft", "literal", "implicit", "auto")
ROUNDING = 1e-9  # of u, at most about 1


class Sample(NamedTuple):
    """A row of a topic."""

    stamp_ns: int
    value: FloatArray


class Sequence:
    """A controller, what it receives and sends, and a clock with jitter and overruns."""

    def __init__(self, parameters: ControllerConfig, seed: int) -> None:
        self.rng = np.random.default_rng(seed)
        self.controller = Controller(parameters)
        self.parameters = parameters
        self.changes: list[dict[str, Any]] = []
        self.rows: dict[str, list[Sample]] = {"y": [], "y_m": [], "u": [], "internals": []}
        self.now_ns = 10**9 + int(self.rng.integers(0, self.controller.period_ns))
        self.active = True
        self.restarts = 0
        self._silence = self._stands = 0
        self._y = np.zeros(len(parameters.measured))
        self._y_m = np.zeros(len(parameters.outputs))
        self._jump = np.zeros_like(self._y)

    def happens(self, share: float) -> bool:
        """Return whether an event with this probability per tick happens now."""
        return bool(self.rng.random() < share)

    def receive(self) -> None:
        """Receive a y and a y_m.

        They may be late, lost or repeated, and y may jump, stand still or not be a number.
        """
        rng = self.rng
        period_ns = self.controller.period_ns
        if self.happens(0.005):
            self._silence = int(rng.integers(1, 60))
        if self.happens(0.004):
            self._jump = rng.normal(size=len(self._jump)) * rng.choice([0.0, 0.1, 1.0, 30.0])
        if self.happens(0.004):
            self._stands = int(rng.integers(1, 40))
        y = 0.95 * self._y + 0.02 * rng.normal(size=len(self._y))
        self._y = self._y if self._stands else y
        self._stands = max(self._stands - 1, 0)
        self._y_m = 0.97 * self._y_m + 0.01 * rng.normal(size=len(self._y_m))
        if self._silence:
            self._silence -= 1
            return
        wrong = rng.choice([np.nan, 1e12, -4.0]) if self.happens(0.01) else 0.0
        vanes = len(self._y) - len(self._y_m)
        odd = wrong * (rng.random(len(self._y)) < 0.5)
        if vanes and self.happens(0.05):  # a vane that reads beyond half a turn
            odd[-vanes:] = 4.0
        late = int(rng.integers(0, period_ns)) if self.happens(0.3) else 0
        self._take("y", self._y + self._jump + odd, self.now_ns - late)
        late = int(rng.integers(0, 2 * period_ns)) if self.happens(0.3) else 0
        self._take("y_m", self._y_m.copy(), self.now_ns - late)

    def _take(self, topic: str, value: FloatArray, stamp_ns: int) -> None:
        take = {"y": self.controller.take_y, "y_m": self.controller.take_y_m}[topic]
        rows = self.rows[topic]
        if not rows or stamp_ns > rows[-1].stamp_ns:
            rows.append(Sample(stamp_ns, value))
        for _ in range(1 + self.happens(0.05)):
            try:
                take(StampedVector(stamp_ns, value), self.now_ns)
            except ChannelError:
                continue

    def change(self) -> None:
        """Sometimes change parameters without a jump of u, restart, or deactivate."""
        rng = self.rng
        if self.happens(0.004):
            self.active = not self.active
        if self.happens(0.002):
            self.controller.restart()
        if not self.happens(0.006):
            return
        change: dict[str, Any] = {
            "k_g": float(rng.uniform(0.1, 5.0)),
            "beta": rng.uniform(0.1, 40.0, len(self._y_m)).tolist(),
            "ramp": float(rng.choice([0.0, 0.5, 2.0])),
        }
        change = {"sign": str(rng.choice(SIGNS))} if self.happens(0.3) else change
        before = self.controller.state.command.copy()
        try:
            new = type(self.parameters).validate_mapping(
                self.parameters.changed(change), "controller"
            )
            self.controller.retune(new)
        except ParameterError:
            return
        self.parameters = new
        self.changes.append(change)
        assert np.array_equal(before, self.controller.state.command)

    def tick(self) -> None:
        """Run a tick.

        u must be finite and within its limits and rates, and must not jump at an engagement.
        """
        controller = self.controller
        state = controller.state
        limits = self.parameters.effector_limits()
        late_ns = int(self.rng.integers(0, 10**6))
        output = controller.tick(self.now_ns, late_ns, active=self.active)
        self.restarts += controller.pop_restart_reason() is not None
        u = controller.state.command
        move = np.abs(u - state.command)
        assert np.isfinite(u).all()
        assert (u <= limits.upper + ROUNDING).all()
        assert (u >= limits.lower - ROUNDING).all()
        if controller.mode is Mode.ENGAGED and state.mode is not Mode.ENGAGED:
            assert not move.any()
        elif controller.mode is Mode.ENGAGED and output is not None:
            least = LEAST_DT * seconds(controller.period_ns)
            assert (move <= limits.rate * max(output.inputs.dt, least) + ROUNDING).all()
        if output is not None:
            self.rows["u"].append(Sample(output.stamp_ns, output.u.copy()))
            if controller.has_internals:
                assert np.isfinite(output.internals).all()
                self.rows["internals"].append(Sample(output.stamp_ns, output.internals.copy()))

    def run(self, ticks: int) -> None:
        """Run ticks with the events before each.

        A fiftieth of them are late by up to 30 periods.
        """
        for _ in range(ticks):
            overrun = int(self.rng.integers(1, 30)) if self.happens(0.02) else 1
            self.now_ns += overrun * self.controller.period_ns
            self.receive()
            self.change()
            self.tick()

    def tape(self) -> Tape:
        """Return what the recorder would have stored."""
        parameters = self.parameters
        names = {
            "y": parameters.measured,
            "y_m": parameters.outputs,
            "u": parameters.effectors,
            "internals": self.controller.names,
        }
        signals = {}
        for topic, rows in self.rows.items():
            stamp_ns = np.array([row.stamp_ns for row in rows], dtype=np.int64)
            signals[topic] = Signal(stamp_ns, names[topic], np.array([row.value for row in rows]))
        return Tape(signals)


def with_probe(parameters: ControllerConfig) -> ControllerConfig:
    probed: dict[str, Any] = {**parameters.model_dump(), "probe": {}}
    return type(parameters).validate_mapping(probed, "controller")


@pytest.mark.parametrize(
    "name, probed",
    [
        ("osprey_servo", True),
        ("osprey_observer", False),
        ("osprey_vanes", False),
        ("osprey_gust", False),
        ("osprey_twin", False),
    ],
)
@pytest.mark.filterwarnings("ignore::RuntimeWarning")  # of NumPy, on what is not finite
def test_random_sequence_keeps_u_in_its_limits_and_is_replayed_to_the_bit(
    name: str, probed: bool
) -> None:
    parameters = find_scenario(name).controller
    sequence = Sequence(with_probe(parameters) if probed else parameters, 7 + probed)
    parameters = sequence.parameters
    sequence.run(1000)
    result = replay(sequence.tape(), parameters, changes=sequence.changes)
    assert result.first() is None
    assert result.is_equal()
    assert len(result.number) > 500
    assert (~result.checked).sum() <= 3  # up to the first engagement
    assert sequence.restarts  # a jump that stays has been among them


def test_replay_is_equal_where_a_vane_reads_beyond_pi_and_the_law_engages_again() -> None:
    """For an impossible reading the last one is used, also over an engagement."""
    parameters = find_scenario("osprey_vanes").controller
    sequence = Sequence(parameters, 3)
    controller = sequence.controller
    m = len(parameters.outputs)
    rng = np.random.default_rng(4)
    for k in range(1, 420):
        sequence.now_ns += controller.period_ns
        y = 0.002 * rng.normal(size=len(parameters.measured))
        y[m:] += 0.05 * np.sin(0.1 * k + np.arange(len(y) - m))
        y[1] += 3.0 * (k >= 300)
        if 298 <= k <= 310:
            y[m:] = 4.0
        for topic, value in (("y", y), ("y_m", np.zeros(m))):
            sequence._take(topic, value, sequence.now_ns)
        sequence.tick()
    assert sequence.restarts == 1
    assert controller.state.vanes is not None
    result = replay(sequence.tape(), parameters)
    assert result.first() is None
    assert result.checked.sum() > 400
