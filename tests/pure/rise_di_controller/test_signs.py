# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test flights with the right D, which track, and with a wrong D, which diverge.

There are three aircraft: the Osprey with the elevator sign of textbooks (trailing edge down
positive), the Osprey with rudder and aileron exchanged, and a plant whose Omega = C B has a
positive diagonal and a negative determinant.
"""

import math
from pathlib import Path

import numpy as np
import pytest
import yaml
from tests.closed_loop import CALM_SERVO, error, fly, law_params, still_air

from aircraft_sim.airframes.airframe import LIBRARY
from flight_analysis.closed_loop.scenario import Scenario
from flight_analysis.closed_loop.simulate import simulate
from flight_analysis.metrics.errors import error_metrics
from flight_core.vectors import FloatArray

pytestmark = pytest.mark.slow

# Trailing edge down positive. The first command of q rises at 2 s.

UNLIMITED = CALM_SERVO.vary(aircraft={"actuators": {}}, controller={"lower": None, "upper": None})


def trailing_edge_down(scenario: Scenario, folder: Path) -> Scenario:
    """Return the same flight with an airframe whose positive elevator pitches the nose down.

    D is unchanged.
    """
    airframe = yaml.safe_load((LIBRARY / "osprey.yaml").read_text())
    elevator = list(airframe["inputs"]).index("elevator")
    airframe["inputs"]["elevator"]["positive"] = "trailing edge down"
    for row in airframe["B"]:
        row[elevator] = -row[elevator]
    path = folder / "trailing_edge_down.yaml"
    path.write_text(yaml.safe_dump(airframe, sort_keys=False))
    return scenario.vary(aircraft={"airframe": str(path)})


def first(t: FloatArray, values: FloatArray, bound: float) -> float:
    """Return the first instant at which abs(values) is above a bound, or inf."""
    is_beyond = np.abs(values) > bound
    return float(t[is_beyond][0]) if is_beyond.any() else math.inf


@pytest.mark.parametrize(
    "scenario", [pytest.param(CALM_SERVO, id="servos"), pytest.param(UNLIMITED, id="no limits")]
)
def test_flipped_elevator_tracks_with_right_d(scenario: Scenario, tmp_path: Path) -> None:
    """With the trailing edge down positive, the flight tracks with D = (-1, 1, 1, 1)."""
    # D = (-1, 1, 1, 1). Measured rms of q: 1.97 mrad/s through servos, 1.95 without limits; the
    # prototype: 2.0 and 2.2.
    right = trailing_edge_down(scenario, tmp_path).vary(
        controller={"D": [-1, 1, 1, 1]}, flight={"duration": 30.0}
    )
    # no events for q after 30 s
    sixty_seconds = error_metrics(error(simulate(right))["q"]).rms * math.sqrt(30.0 / 60.0)
    assert sixty_seconds <= 0.0022


def test_sign_in_airframe_and_d_cancels(tmp_path: Path) -> None:
    """A change of a sign both in the airframe and in D gives the same flight to the last bit."""
    original = CALM_SERVO.vary(flight={"duration": 4.0})
    flipped = trailing_edge_down(original, tmp_path).vary(controller={"D": [-1, 1, 1, 1]})
    nose_up = simulate(original)
    nose_down = simulate(flipped)
    assert nose_down["y"].values.tobytes() == nose_up["y"].values.tobytes()
    assert (nose_down["u"]["elevator"] == -nose_up["u"]["elevator"]).all()
    assert np.abs(nose_up["u"]["elevator"]).max() > 0.0


def test_flipped_elevator_diverges_with_identity_d(tmp_path: Path) -> None:
    """With the trailing edge down positive and D = I, the flight diverges at the first command."""
    # Diverged: abs(e_q) above 1 rad/s, ten times the command. Measured at 2.38 s, 0.38 s after it;
    # the prototype: 2.38 s. It grows further, by a factor of e each 0.08 s: 34.9 rad/s, where the
    # aircraft is lost, 0.08 ln 34.9 = 0.28 s later.
    tape = simulate(trailing_edge_down(UNLIMITED, tmp_path).vary(flight={"duration": 3.4}))
    t = tape.time("truth")
    e = error(tape)["q"]
    assert np.abs(e[t < 2.0]).max() < 1e-3
    assert first(t, e, 1.0) == pytest.approx(2.38, abs=0.05)
    assert str(tape.outcome).startswith("diverged at t = ")
    assert t[-1] == pytest.approx(2.38 + 0.28, abs=0.1)


# Below: the law and the plant without a scenario, at periods and gains that scenarios do not allow.

# Rudder before aileron: [q, V, p, r] driven by [elevator, thrust, rudder, aileron], as in the
# paper, dt = 0.5 ms, 4 s. q 0.1 rad/s from 0.5 s to 1.5 s, p 0.4 rad/s from 1 s to 2.5 s, r
# coordinated. Diverged: abs(e_i) above 1, rad/s or m/s.


# CB = [[1, 2], [2, 1]]: x1_dot = -x1 + 0.5 x3 + u1 + 2 u2, x2_dot = -x2 - 0.5 x3 + 2 u1 + u2,
# x3_dot = 0.5 (x1 + x2) - x3, y = (x1, x2), y_m = 0.1 (sin t, sin 1.3t), dt = 10 ms, 12 s.
# Diverged: abs(e_i) above 10, a hundred times the reference.

OMEGA = np.array([[1.0, 2.0], [2.0, 1.0]])
SMALL = still_air(
    A=np.array([[-1.0, 0.0, 0.5], [0.0, -1.0, -0.5], [0.5, 0.5, -1.0]]),
    B=np.vstack([OMEGA, np.zeros(2)]),
    C=np.eye(2, 3),
    gravity=np.zeros((3, 3)),
)
SINES: FloatArray = 0.1 * np.sin(np.outer(0.01 * np.arange(1200), [1.0, 1.3]))


def fly_small(D: list[float], K: list[float]) -> FloatArray:
    # beta_1 is far above U_12 beta_2 = 4 beta_2, as (30) requires
    return fly(SMALL, law_params(K, 1.0, [2.0, 0.2], D, omega=2.0), SINES, 0.01, bound=10.0)


@pytest.mark.parametrize("K", [[1.0, 1.0], [20.0, 5.0]], ids=str)
def test_negative_determinant_diverges_with_identity_d(K: list[float]) -> None:
    """With a negative determinant and D = I, the flight diverges for every K."""
    # det(Omega K) < 0 means an unstable exponential for any K. Measured at 0.37 to 3.2 s; the
    # prototype: 0.66 to 1.6 s.
    assert len(fly_small([1.0, 1.0], K)) * 0.01 < 4.0


def test_negative_determinant_converges_with_22() -> None:
    """A flight with a negative determinant and the right D converges if K has the order of (22)."""
    # Measured in the last 3 s: 1.3e-3, a hundredth of the reference.
    errors = fly_small([1.0, -1.0], [20.0, 5.0])
    assert len(errors) == len(SINES)
    assert np.abs(errors[-300:]).max() < 0.002


def test_negative_determinant_diverges_without_22() -> None:
    """With a negative determinant and the right D, a flight without the order of (22) diverges."""
    # K = (5, 5) is not of the form (22), which has the larger gain first: trace(Omega D K) = 5 - 5
    # leaves the damping to A. Measured slow divergence at 7.4 s; the prototype: at 7.5 s.
    assert 6.0 < len(fly_small([1.0, -1.0], [5.0, 5.0])) * 0.01 < 9.0
