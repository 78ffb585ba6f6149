# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test Theorem 1 on random aircraft, with the right D and with gains by the rules.

The error e must converge to the ultimate bound of a sampled law.

An aircraft is drawn in coordinates (y, z) that show its zero dynamics, z_dot = A_zy y + A_zz z at y
= y_m, and is then rotated. The law only knows D and the gains. `gains` computes them from the true
aircraft, because these tests check the theorem and not an identification.
"""

from typing import NamedTuple

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from tests import closed_loop
from tests.closed_loop import law_params, still_air

from aircraft_sim.plant import dynamics
from aircraft_sim.plant.dynamics import Aircraft
from flight_core.integrators import rk4
from flight_core.vectors import FloatArray
from rise_di_controller.law.decomposition import decompose, leading_minors, signs
from rise_di_controller.law.law import LawParams, Sign, gain

pytestmark = pytest.mark.slow

MIN_DAMPING = 0.5  # 1/s, of the aircraft and of its zero dynamics
# s, length of a flight and the time at which e has settled: ten time constants of Lambda
DURATION, SETTLED = (8.0, 5.0)
DT = 0.008  # s; the tests also use half of it


class Sines(NamedTuple):
    """The reference y_m = amplitude sin(frequency t + phase)."""

    amplitude: FloatArray  # (m,)
    frequency: FloatArray  # (m,) rad/s
    phase: FloatArray  # (m,)

    def at(self, t: float) -> FloatArray:
        """Return y_m at the time t, (m,)."""
        return self.amplitude * np.sin(self.frequency * t + self.phase)

    def rate(self, t: float) -> FloatArray:
        """Return the derivative of y_m at the time t, (m,)."""
        return self.amplitude * self.frequency * np.cos(self.frequency * t + self.phase)


class Task(NamedTuple):
    """A random aircraft, its reference and its initial error."""

    aircraft: Aircraft
    D: FloatArray  # (m,) used to build C B
    rotation: FloatArray  # (n, n) from (y, z) to x
    reference: Sines
    e_0: FloatArray  # (m,)


def abscissa(matrix: FloatArray) -> float:
    """Return the largest real part of the eigenvalues, or -inf for an empty matrix."""
    return float(np.linalg.eigvals(matrix).real.max()) if matrix.size else -np.inf


def random_task(n: int, m: int, seed: int) -> Task:
    """Return a random task of relative degree one, with C B = S D U.

    The aircraft and its zero dynamics have at least MIN_DAMPING.
    """
    m = min(m, n - 1)
    rng = np.random.default_rng(seed)  # n > m
    directions = np.linalg.qr(rng.standard_normal((m, m)))[0]
    S = directions * rng.uniform(0.5, 2.0, m) @ directions.T
    D = rng.choice([-1.0, 1.0], m)
    U = np.triu(rng.uniform(-0.5, 0.5, (m, m)), 1) + np.eye(m)
    A = rng.standard_normal((n, n))
    A -= (max(abscissa(A), abscissa(A[m:, m:])) + MIN_DAMPING) * np.eye(n)
    rotation = np.linalg.qr(rng.standard_normal((n, n)))[0]
    aircraft = still_air(
        A=rotation @ A @ rotation.T,
        B=rotation[:, :m] @ S @ np.diag(D) @ U,
        C=rotation[:, :m].T,
        gravity=0.1 / n * rng.uniform(-1.0, 1.0, (n, n)),  # f: at most 0.1 in each x_dot
    )
    reference = Sines(
        rng.uniform(0.2, 1.0, m), rng.uniform(0.5, 2.0, m), rng.uniform(0.0, 2.0 * np.pi, m)
    )
    return Task(
        aircraft=aircraft,
        D=D,
        rotation=rotation,
        reference=reference,
        e_0=rng.choice([-1.0, 1.0], m) * rng.uniform(0.1, 0.3, m),
    )


def slew_of_the_ideal_control(task: Task, scale: FloatArray) -> FloatArray:
    """Return the slew v*_dot of the ideal control over a flight, (N, m).

    The input v* = u / scale keeps e = 0. Its slew is found with finite differences.
    """
    aircraft = task.aircraft
    rotation = task.rotation
    dt = 0.01
    m = len(task.D)

    def x_free(t: float, z: FloatArray) -> tuple[FloatArray, FloatArray]:
        x = rotation @ np.concatenate([task.reference.at(t), z])
        return x, dynamics.x_dot(t, x, np.zeros(m), aircraft)

    def z_dot(t: float, z: FloatArray, u: None, params: None) -> FloatArray:
        rate: FloatArray = rotation[:, m:].T @ x_free(t, z)[1]
        return rate

    z = np.zeros(len(rotation) - m)
    v = []
    Omega = aircraft.C @ aircraft.B * scale
    for k in range(round(DURATION / dt)):
        v.append(
            np.linalg.solve(Omega, task.reference.rate(k * dt) - aircraft.C @ x_free(k * dt, z)[1])
        )
        z = rk4(z_dot, k * dt, z, None, None, dt)
    slew: FloatArray = np.gradient(np.array(v), dt, axis=0)
    return slew


def gains(task: Task, sign: Sign) -> LawParams:
    """Return gains by rule, last channel first, with V = D U D of the scaled Omega.

    Inputs are scaled by the pivots of Omega, abs(Delta_k / Delta_(k-1)), which are never zero,
    although Omega_kk may be zero. K is from (22): K_m = 10 1/s and k_d,i = 1 + (m - 1) sum_{j>i}
    V_ij^2 K_j. Then the symmetric part of V K is positive definite, because 2 abs(V_ij) K_j abs(r_i
    r_j) <= (m - 1) V_ij^2 K_j r_i^2 + K_j r_j^2 / (m - 1). beta is from (30) with a margin of one
    half, where zeta_Nd,i = max abs((D U v*_dot)_i) is N_d at e = 0. Lambda is 2 1/s. omega is
    estimated too large by a factor of 2, because it must not be too small.
    """
    m = len(task.D)
    Omega = task.aircraft.C @ task.aircraft.B
    minors = leading_minors(Omega)
    scale = 1.0 / np.abs(minors / np.concatenate([[1.0], minors[:-1]]))
    U = decompose(Omega * scale).U
    V = np.abs(task.D[:, None] * U * task.D)
    zeta = np.abs(slew_of_the_ideal_control(task, scale) @ (task.D[:, None] * U).T).max(axis=0)
    K_min = 10.0
    K = np.full(m, K_min)
    k_d = np.zeros(m)
    beta = np.zeros(m)
    for i in reversed(range(m)):
        beta[i] = 1.5 * zeta[i] + V[i, i + 1 :] @ beta[i + 1 :]
        k_d[i] = 1.0 + (m - 1) * V[i, i + 1 :] ** 2 @ K[i + 1 :] if i < m - 1 else 0.0
        K[i] = K_min + k_d[i]
    return law_params(
        gain(np.array(K_min - 1.0), k_d[:-1]), 2.0, beta, task.D, sign, input_scale=scale, omega=2.0
    )


def fly(task: Task, law: LawParams, dt: float) -> FloatArray:
    """Return the errors e at 0, dt, 2 dt, ..., (ticks, m).

    A flight ends if an error is above 100.
    """
    y_m = [task.reference.at(k * dt) for k in range(round(DURATION / dt) + 1)]
    x_0 = task.rotation[:, : len(task.D)] @ (y_m[0] + task.e_0)
    return closed_loop.fly(task.aircraft, law, y_m, dt, bound=100.0, x_0=x_0)


def ultimate_bound(task: Task, law: LawParams, dt: float) -> float:
    """Return the largest error after the time SETTLED."""
    return float(np.abs(fly(task, law, dt)[round(SETTLED / dt) :]).max())


TASKS = st.builds(random_task, st.integers(2, 10), st.integers(1, 4), st.integers(0, 10**6))
settle = settings(max_examples=6, deadline=None, derandomize=True)


@settle
@given(task=TASKS)
def test_signs_of_omega_are_as_built(task: Task) -> None:
    """The signs of Omega = C B are the D of the random factors S D U behind it."""
    assert (signs(task.aircraft.C @ task.aircraft.B) == task.D).all()
    assert abscissa(task.aircraft.A) < 0.0


@pytest.mark.parametrize(
    "sign, largest, low, high",
    [
        # Measured with 74 aircraft: ratios 3.98 to 4.00, so 3 % is ten times their scatter and
        # excludes any other order. The ultimate bound at 8 ms is 2e-5 to 1.3e-3, for signals of
        # size 0.2 to 1.
        pytest.param(Sign.IMPLICIT, 0.005, 3.88, 4.12, id="implicit sign, with the square of dt"),
        # A chaotic limit cycle: measured with 74 aircraft, ratios are 1.4 to 2.5 with a mean of
        # 1.9. No improvement would be 1, second order 4. The ultimate bound at 8 ms is 6e-4 to
        # 0.032.
        pytest.param(Sign.LITERAL, 0.1, 1.2, 3.2, id="literal sign, with dt"),
    ],
)
@settle
@given(task=TASKS)
def test_the_ultimate_bound_falls_with_dt(
    sign: Sign, largest: float, low: float, high: float, task: Task
) -> None:
    law = gains(task, sign)
    coarse = ultimate_bound(task, law, DT)
    fine = ultimate_bound(task, law, DT / 2)
    assert coarse < largest
    assert low < coarse / fine < high


@settle
@given(task=TASKS)
def test_error_decreases_from_engagement_to_ultimate_bound(task: Task) -> None:
    # Largest errors in the first second, in the third, and after 5 s. exp(-Lambda t) is 0.018 at 2
    # s, and the sign term is faster: measured with 150 aircraft at most 0.005 in the third second,
    # often the ultimate bound, and 0.006 after 5 s.
    errors = np.abs(fly(task, gains(task, Sign.IMPLICIT), DT)).max(axis=1)
    second = round(1.0 / DT)
    first = errors[:second].max()
    third = errors[2 * second : 3 * second].max()
    largest = errors[5 * second :].max()
    assert third < 0.02 * first
    assert largest < 0.02 * first


@settle
@given(task=TASKS, flipped=st.integers(0, 3))
def test_one_wrong_sign_in_d_diverges(task: Task, flipped: int) -> None:
    # An odd number of wrong signs makes det(Omega D K Lambda) < 0, so the loop has a real unstable
    # pole. Diverged: an error above 100, a hundred times the largest reference, within the 8 s
    # after which the right D has settled.
    assume(flipped < len(task.D))
    law = gains(task, Sign.IMPLICIT)
    wrong = law._replace(D=np.where(np.arange(len(task.D)) == flipped, -task.D, task.D))
    assert np.abs(fly(task, wrong, DT)[-1]).max() > 100.0
