# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
# ruff: noqa: N802 - functions have the symbols of the page as names
"""Test the observer of docs/theory.md in continuous time.

The tests cover the Proposition, Lemma A, Lemma B, and the error inside the softened sign.

Observers here are designed in this file, with the Riccati solver of scipy. Plants are random, with
stable zero dynamics, or the osprey. Loops are those of
`flight_design.gains.lyapunov.fly_known_plant`. The extended plant is a plant (1), so it flies like
one.
"""

from typing import NamedTuple

import numpy as np
import pytest
from pytest import approx
from scipy.linalg import block_diag, eigvals, solve_continuous_are, solve_continuous_lyapunov
from scipy.signal import lsim, place_poles
from tests.closed_loop import law_params

from aircraft_sim.airframes.airframe import Airframe, load_airframe
from flight_analysis.closed_loop.scenario import Scenario
from flight_analysis.closed_loop.scenario_library import find_scenario
from flight_campaign.comparison import law_comparison, tuning
from flight_core.vectors import FloatArray
from flight_design.gains.airframe_properties import invariant_zeros
from flight_design.gains.ideal_control import manoeuvre, study_airframe
from flight_design.gains.lyapunov import KnownPlant, fly_known_plant
from flight_design.gains.tuned_gains import TuningResult
from rise_di_controller.law.law import LawParams, Sign

pytestmark = pytest.mark.slow

N, M = 4, 2  # states and channels of a random plant
# 1/s, decay of angles and disturbances in a model, so that the Riccati equations have a solution
ZERO_LEAK = 0.01


class Plant(NamedTuple):
    """A plant (1) without f, and the factors of C B = S D U."""

    A: FloatArray  # (n, n)
    B: FloatArray  # (n, m)
    C: FloatArray  # (m, n)
    S: FloatArray  # (m, m)
    D: FloatArray  # (m,)
    U: FloatArray  # (m, m)


class Observer(NamedTuple):
    """zeta_dot = A_z zeta + B_z (u - u_ff) + L (e - H zeta), u_o = -F zeta."""

    A_z: FloatArray  # (s, s)
    B_z: FloatArray  # (s, m)
    H: FloatArray  # (m, s)
    F: FloatArray  # (m, s)
    L: FloatArray  # (s, m)

    @property
    def error_matrix(self) -> FloatArray:
        """Return A_z - L H, the dynamics of the error of the estimates."""
        return self.A_z - self.L @ self.H

    def sensitivity(self, s: complex) -> FloatArray:
        """Return S_o(s) = I + F (s I - A_z + L H)^-1 B_z, complex, (m, m)."""
        return np.asarray(
            np.eye(len(self.H))
            + self.F @ np.linalg.solve(s * np.eye(len(self.A_z)) - self.error_matrix, self.B_z)
        )


class Hidden(NamedTuple):
    """The plant in y and in n - m coordinates eta = T x on which B does not act: T B = 0."""

    T: FloatArray
    yy: FloatArray  # of y in y_dot
    y_eta: FloatArray  # of eta in y_dot
    eta_y: FloatArray  # of y in eta_dot, B_eta
    eta: FloatArray  # of eta in eta_dot, A_eta


def random_plant(seed: int, U_12: float = 0.0) -> Plant:
    """Return a random plant with D = diag(1, -1) and the given U_12.

    Its zeros have a real part of at most -1.
    """
    rng = np.random.default_rng(seed)
    zero_dynamics = rng.normal(size=(N - M, N - M))
    zero_dynamics -= (eigvals(zero_dynamics).real.max() + 1.0) * np.eye(N - M)
    top = rng.normal(size=(M, N))
    left_columns = rng.normal(size=(N - M, M))
    root = 0.3 * rng.normal(size=(M, M))
    S = np.eye(M) + root @ root.T
    D = np.array([1.0, -1.0])
    U = np.array([[1.0, U_12], [0.0, 1.0]])
    change = np.eye(N) + 0.3 * np.vstack([np.zeros((M, N)), rng.normal(size=(N - M, N))])
    A = np.vstack([top, np.hstack([left_columns, zero_dynamics])])
    back = np.linalg.inv(change)
    return Plant(
        A=back @ A @ change,
        B=back @ np.vstack([(S * D) @ U, np.zeros((N - M, M))]),
        C=np.eye(M, N) @ change,
        S=S,
        D=D,
        U=U,
    )


def linear_quadratic(
    model: tuple[FloatArray, FloatArray, FloatArray],
    Q: FloatArray,
    R: FloatArray,
    process: FloatArray,
    noise: FloatArray,
) -> Observer:
    """Return F for the cost z'Q z + u'R u, and L for the given process and measurement noise.

    The model is (A_z, B_z, H).
    """
    A_z, B_z, H = model
    F = np.linalg.solve(R, B_z.T @ solve_continuous_are(A_z, B_z, Q, R))
    L = np.linalg.solve(noise, H @ solve_continuous_are(A_z.T, H.T, process, noise)).T
    return Observer(
        A_z=A_z, B_z=B_z, H=H, F=np.asarray(F, dtype=np.float64), L=np.asarray(L, dtype=np.float64)
    )


def observer_of(plant: Plant) -> Observer:
    """Return an observer of the states and of a disturbance of each y_dot, zeta = [x, d]."""
    A_z = np.block([[plant.A, plant.C.T], [np.zeros((M, N)), -ZERO_LEAK * np.eye(M)]])
    H = np.hstack([plant.C, np.zeros((M, M))])
    process = np.diag([0.01] * N + [4.0] * M)
    model = A_z, np.vstack([plant.B, np.zeros((M, M))]), H
    return linear_quadratic(model, H.T @ H, 0.1**2 * np.eye(M), process, 0.03**2 * np.eye(M))


def extended(plant: Plant, observer: Observer) -> Plant:
    """Return aircraft and observer as one plant with the input u_law, x_e = [x, zeta]."""
    A_z, B_z, H, F, L = observer
    A_e = np.block([[plant.A, -plant.B @ F], [L @ plant.C, A_z - L @ H - B_z @ F]])
    C_e = np.hstack([plant.C, np.zeros((len(H), len(A_z)))])
    return plant._replace(A=A_e, B=np.vstack([plant.B, B_z]), C=C_e)


def osprey() -> tuple[Airframe, Plant]:
    airframe = load_airframe("osprey")
    A = airframe.matrix_a() + airframe.matrix_gravity()
    B = airframe.matrix_b()
    C = airframe.matrix_c()
    return airframe, Plant(A=A, B=B, C=C, S=np.eye(4), D=np.ones(4), U=np.eye(4))


def osprey_observer() -> Observer:
    """Return an observer of states, wind along three axes, and a disturbance of each output.

    zeta = [x, w, d], and the actuators are ideal. The weights of q, V, p, r are the effort in s,
    and the drift in units/s per root s. Those of the wind are in m/s per root s and in s.
    """
    airframe, plant = osprey()
    unit = np.array([0.1, 1.0, 0.1, 0.1])
    noise = np.array([1.7e-3, 0.03, 1.7e-3, 1.7e-3])
    effort = np.array([0.03, 0.09, 0.065, 0.06])
    drift = np.array([0.26, 0.04, 2.0, 0.34])
    axes = {"vertical": (0.9, 4.7), "lateral": (0.44, 0.57), "longitudinal": (0.36, 1.9)}
    gust, time_constant = np.array([axes[name] for name in airframe.gusts]).T
    wind = np.column_stack([airframe.gust_direction(name) for name in airframe.gusts])
    (n, m), g = plant.B.shape, wind.shape[1]
    angles = np.diag([float(name in {"theta", "phi"}) for name in airframe.states])
    A_z = block_diag(
        plant.A - ZERO_LEAK * angles, -np.diag(1.0 / time_constant), -ZERO_LEAK * np.eye(m)
    )
    A_z[:n, n:] = np.hstack([wind, plant.C.T])
    H = np.hstack([plant.C, np.zeros((m, g + m))])
    scale = 1.0 / np.abs(np.diag(plant.C @ plant.B))
    loose = [0.005 * (1.0 if name == "V" else 0.1) for name in airframe.states]
    return linear_quadratic(
        (A_z, np.vstack([plant.B, np.zeros((g + m, m))]), H),
        H.T @ np.diag(unit**-2.0) @ H,
        np.diag((effort / (scale * unit)) ** 2),
        np.diag(np.array([*loose, *gust, *(drift * unit)]) ** 2),
        np.diag(0.01 * noise**2),  # per sample of 10 ms
    )


def hidden(plant: Plant) -> Hidden:
    m = len(plant.C)
    T = np.vstack([plant.C, np.linalg.svd(plant.B.T)[2][m:]])
    A = T @ plant.A @ np.linalg.inv(T)
    return Hidden(T=T[m:], yy=A[:m, :m], y_eta=A[:m, m:], eta_y=A[m:, :m], eta=A[m:, m:])


# The Proposition


def rosenbrock(plant: Plant, s: complex) -> FloatArray:
    n, m = plant.B.shape
    return np.block([[plant.A - s * np.eye(n), plant.B], [plant.C, np.zeros((m, m))]])


@pytest.mark.parametrize("seed", range(5))
def test_observer_keeps_C_B_and_so_S_D_U_and_relative_degree(seed: int) -> None:
    plant = random_plant(seed, U_12=0.7)
    both = extended(plant, observer_of(plant))
    assert np.array_equal(both.C @ both.B, plant.C @ plant.B)


def arbitrary_observer(rng: np.random.Generator) -> Observer:
    """Return an observer of random matrices whose filter has random stable poles.

    The model need not be the aircraft's.
    """
    s = N + M
    A_z = rng.normal(size=(s, s))
    H = rng.normal(size=(M, s))
    L = place_poles(A_z.T, H.T, -rng.uniform(0.5, 5.0, size=s)).gain_matrix.T
    return Observer(
        A_z=A_z, B_z=rng.normal(size=(s, M)), H=H, F=10.0 * rng.normal(size=(M, s)), L=L
    )


def test_zeros_with_observer_are_those_of_aircraft_and_poles_of_filter() -> None:
    unstable = 0
    for seed in range(5):
        rng = np.random.default_rng(seed)
        plant = random_plant(seed, U_12=0.7)
        observer = arbitrary_observer(rng)
        both = extended(plant, observer)
        filter_matrix = observer.error_matrix
        expected = np.concatenate(
            [invariant_zeros(plant.A, plant.B, plant.C), eigvals(filter_matrix)]
        )
        zeros = invariant_zeros(both.A, both.B, both.C)
        assert len(zeros) == len(expected)
        assert all(np.min(np.abs(zeros - zero)) < 1e-6 for zero in expected)
        # the same without an eigenvalue problem: the determinants of the pencils are equal for
        # every s
        for s in rng.normal(size=(5, 2)) @ np.array([1.0, 1.0j]):
            product = np.linalg.det(rosenbrock(plant, s)) * np.linalg.det(
                filter_matrix - s * np.eye(N + M)
            )
            assert np.linalg.det(rosenbrock(both, s)) == approx(product, rel=1e-8)
        unstable += eigvals(filter_matrix - observer.B_z @ observer.F).real.max() > 0.0
    assert unstable > 0  # the zeros do not depend on the stability of the compensator


def test_on_osprey_observer_adds_only_own_filter_to_zeros() -> None:
    _, plant = osprey()
    observer = osprey_observer()
    both = extended(plant, observer)
    poles = eigvals(observer.error_matrix)
    assert np.array_equal(both.C @ both.B, plant.C @ plant.B)
    expected = np.concatenate([[-7.188, -0.69, 0.0, 0.0], poles])
    zeros = invariant_zeros(both.A, both.B, both.C)
    assert len(zeros) == len(expected) == 19
    assert all(np.min(np.abs(zeros - zero)) < 1e-3 for zero in expected)
    assert poles.real.max() < -0.009  # the disturbances' own leak


class Wave(NamedTuple):
    """Phasors of a sine of time in f, in y_m and in u_ff."""

    omega: float
    f: FloatArray
    y_m: FloatArray
    u_ff: FloatArray = np.zeros(M)


def ideal(
    plant: Plant, omega: float, f: FloatArray, y_m: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return the phasors of the state and of the input that keep y on y_m."""
    n = len(plant.A)
    solved = np.linalg.solve(rosenbrock(plant, 1j * omega), np.concatenate([-f, y_m]))
    return solved[:n], solved[n:]


def slew_left(plant: Plant, wave: Wave, observer: Observer | None) -> FloatArray:
    """Return the phasor of N_d at e = 0 by (c).

    It is -D U S_o j omega (u* - u_ff), with S_o = I without an observer.
    """
    u = ideal(plant, wave.omega, wave.f, wave.y_m)[1] - wave.u_ff
    remainder = u if observer is None else observer.sensitivity(1j * wave.omega) @ u
    return np.asarray(-plant.D * (plant.U @ (1j * wave.omega * remainder)))


@pytest.mark.parametrize("omega", [0.3, 3.0, 30.0])
def test_N_d_of_extended_plant_is_slew_that_feedforward_and_observer_leave(omega: float) -> None:
    # The right side of (c) against the definition of N_d, (17) with all reference terms, on the
    # extended plant.
    rng = np.random.default_rng(7)
    for seed in range(3):
        plant = random_plant(seed, U_12=0.7)
        observer = arbitrary_observer(rng)
        f, y_m, u_ff = (rng.normal(size=(k, 2)) @ np.array([1.0, 1.0j]) for k in (N, M, M))
        both = extended(plant, observer)
        s = 1j * omega
        f_e = np.concatenate([f + plant.B @ u_ff, -observer.L @ y_m])
        x_e, _ = ideal(both, omega, f_e, y_m)
        N_d = np.linalg.solve(plant.S, both.C @ (both.A @ (s * x_e) + s * f_e) - s**2 * y_m)
        assert slew_left(plant, Wave(omega, f, y_m, u_ff), observer) == approx(N_d, rel=1e-9)


def short() -> Scenario:
    """Return osprey_servo for 8 s, with one pulse on each channel and both gusts."""
    servo = find_scenario("osprey_servo")
    pulses = {
        "q": (1.0, 2.0, 0.1),
        "V": (0.5, 5.0, 1.5),
        "p": (1.5, 2.5, 0.4),
        "r": (3.0, 3.5, 0.03),
    }
    starts = {"vertical": 4.0, "lateral": 6.0}
    return servo.vary(
        flight={"duration": 8.0},
        reference_model={
            "pulses": {
                name: {"start": [start], "stop": [stop], "value": [value]}
                for name, (start, stop, value) in pulses.items()
            }
        },
        aircraft={
            "gusts": {
                name: servo.aircraft.gusts[name].model_dump() | {"start": at}
                for name, at in starts.items()
            }
        },
    )


def slews_of_the_osprey() -> tuple[FloatArray, FloatArray]:
    """Return the largest rates of u*, u* - u_ff and u_law* = S_o (u* - u_ff), rows, by input.

    The first result is nominal, and the second is the mean of 20 aircraft at +-30 %.
    """
    airframe, _ = osprey()
    observer = osprey_observer()
    course = manoeuvre(short(), airframe)
    study = study_airframe(airframe, course, 0.3, 21)
    calm = study_airframe(airframe, course._replace(gusts={}), 0.0, 1)
    filtered = (observer.error_matrix, observer.B_z, observer.F, np.eye(4))
    degrees = np.array([100.0 if name == "thrust" else np.degrees(1.0) for name in airframe.inputs])
    rows = []
    for k in range(21):
        u_dot = study.u_dot[:, k]
        remainder = u_dot - calm.u_dot[:, 0]
        of_law = lsim(
            filtered, remainder, np.asarray(0.01 * np.arange(len(remainder)), dtype=np.float64)
        )[1]
        rows.append([np.abs(rate).max(axis=0) * degrees for rate in (u_dot, remainder, of_law)])
    return np.array(rows[0]), np.mean(rows[1:], axis=0)


def test_on_osprey_observer_halves_slew_of_elevator_and_rudder_in_gusts() -> None:
    # Pulses and gusts of osprey_servo within 8 s, ideal actuators: elevator, aileron, rudder in
    # deg/s, thrust in %/s
    nominal, samples = slews_of_the_osprey()
    names = list(load_airframe("osprey").inputs)
    assert names == ["elevator", "thrust", "aileron", "rudder"]
    assert nominal == approx(
        np.array([[23.3, 115, 7.7, 43.6], [23.3, 114, 0.331, 43.7], [12.4, 60.3, 0.367, 22.2]]),
        rel=0.05,
    )
    assert samples == approx(
        np.array([[26.5, 126, 8.1, 45.6], [26.6, 125, 1.6, 45.7], [14.2, 123, 0.8, 23.2]]), rel=0.05
    )


def test_without_fade_in_observer_moves_inputs_at_once() -> None:
    # zeta(0) = H'e(0) for e(0) = 0.1, 0.2, 0.1 rad/s of q, p, r and 2 m/s: -F H'e(0)
    airframe, _ = osprey()
    observer = osprey_observer()
    e_0 = {"q": 0.1, "p": 0.2, "r": 0.1, "V": 2.0}
    u_o = -observer.F @ observer.H.T @ np.array([e_0[name] for name in airframe.outputs])
    jump = dict(zip(airframe.inputs, u_o, strict=True))
    assert jump["thrust"] == approx(-3.65, rel=0.01)  # of 1: 365 %
    assert np.degrees(jump["rudder"]) == approx(-8.7, rel=0.01)


# Lemma A


class CrossTerms(NamedTuple):
    """G and W(s) = W_e + W_eta (s I - A_eta)^-1 B_eta of Lemma A.

    They are in z = [e, r] and eta, with Lambda = I.
    """

    G: FloatArray
    W_e: FloatArray
    W_eta: FloatArray
    A_eta: FloatArray
    B_eta: FloatArray

    def at(self, omega: float) -> FloatArray:
        """Return W(j omega), complex, (m, m)."""
        path = np.linalg.solve(1j * omega * np.eye(len(self.A_eta)) - self.A_eta, self.B_eta)
        return np.asarray(self.W_e + self.W_eta @ path)


def cross_terms(plant: Plant) -> CrossTerms:
    part = hidden(plant)
    M_ = np.linalg.inv(plant.S)
    one = np.eye(len(plant.C))
    G = M_ @ (part.yy + one)
    return CrossTerms(
        G=G,
        W_e=G - one - M_ @ part.y_eta @ part.eta_y,
        W_eta=-M_ @ part.y_eta @ part.eta,
        A_eta=part.eta,
        B_eta=part.eta_y,
    )


def least_gain(plant: Plant) -> float:
    """Return k* of Lemma A for Lambda = I.

    It is lambda_max(G + G')/2 + max norm(W(j omega))^2 / 4, on a grid of 1e-3 to 1e4 rad/s.
    """
    terms = cross_terms(plant)
    size = max(
        float(np.linalg.norm(terms.at(omega), 2))
        for omega in np.r_[0.0, np.geomspace(1e-3, 1e4, 700)]
    )
    return float(np.linalg.eigvalsh(terms.G + terms.G.T).max()) / 2.0 + size**2 / 4.0


def form_of(terms: CrossTerms, of_r: FloatArray, P: FloatArray) -> FloatArray:
    """Return Q_w for w = [e, r, eta] and Lambda = I.

    The form is e'e + r'(of_r - G) r + r'(W_e e + W_eta eta) - eta'(A'P + P A) eta - 2 eta'P B e.
    """
    m = len(terms.G)
    n = len(terms.A_eta)
    lower = -P @ terms.A_eta - terms.A_eta.T @ P
    Q = np.block(
        [
            [np.eye(m), np.zeros((m, m + n))],
            [terms.W_e, of_r - terms.G, terms.W_eta],
            [-2.0 * P @ terms.B_eta, np.zeros((n, m)), lower],
        ]
    )
    return np.asarray((Q + Q.T) / 2.0)


@pytest.mark.parametrize("with_observer", [False, True])
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_above_k_star_matrix_P_makes_form_of_lemma_A_positive(
    seed: int, with_observer: bool
) -> None:
    # The lemma of Kalman, Yakubovich and Popov, by its Riccati equation: r is eliminated, then e.
    plant = random_plant(seed)
    extended_plant = extended(plant, observer_of(plant)) if with_observer else plant
    terms = cross_terms(extended_plant)
    k = 1.01 * least_gain(extended_plant)
    inverse = np.linalg.inv(k * np.eye(M) - (terms.G + terms.G.T) / 2.0) / 4.0
    R = np.eye(M) - terms.W_e.T @ inverse @ terms.W_e
    cross = terms.W_eta.T @ inverse @ terms.W_e
    Q = terms.W_eta.T @ inverse @ terms.W_eta + 1e-9 * np.eye(len(terms.A_eta))
    P = np.asarray(
        -solve_continuous_are(terms.A_eta, terms.B_eta, -Q, R, s=-cross), dtype=np.float64
    )
    assert np.linalg.eigvalsh(P).min() > 0.0
    assert np.linalg.eigvalsh(form_of(terms, k * np.eye(M), P)).min() > -1e-9


def waves(seed: int) -> tuple[Wave, Wave]:
    """Return an f of 0.5 rad/s and a y_m of 0.8 rad/s."""
    rng = np.random.default_rng(100 + seed)
    return Wave(0.5, rng.normal(size=N), np.zeros(M)), Wave(0.8, np.zeros(N), np.array([0.5, 0.4]))


def classical_beta(
    plant: Plant, seed: int, observer: Observer | None
) -> tuple[FloatArray, FloatArray]:
    """Return the bounds of abs(N_d) and of abs(N_d) + abs(N_d_dot) / Lambda by channel.

    Lambda is 1, and the bounds are sums of amplitudes.
    """
    sizes = [(wave.omega, np.abs(slew_left(plant, wave, observer))) for wave in waves(seed)]
    return np.sum([size for _, size in sizes], axis=0), np.sum(
        [(1.0 + omega) * size for omega, size in sizes], axis=0
    )


def flown_error(
    plant: Plant, seed: int, observer: Observer | None, params: LawParams, dt: float = 0.01
) -> tuple[FloatArray, FloatArray]:
    """Return times and e, (ticks, M), between 12 and 16 s.

    The law is sampled, and plant and observer are in continuous time.
    """
    push, reference = waves(seed)
    t: FloatArray = np.asarray(dt * np.arange(round(16.0 / dt) + 1), dtype=np.float64)
    y_m = np.cos(reference.omega * t)[:, None] * reference.y_m

    def f(now: float, _: FloatArray) -> FloatArray:
        of_x: FloatArray = push.f * np.cos(push.omega * now)
        if observer is None:
            return of_x
        return np.concatenate([of_x, -observer.L @ (reference.y_m * np.cos(reference.omega * now))])

    extended_plant = plant if observer is None else extended(plant, observer)
    x_0 = np.zeros(len(extended_plant.A))
    x_0[:N] = 0.3
    flight = fly_known_plant(
        KnownPlant(extended_plant.A, extended_plant.B, extended_plant.C, f), y_m, dt, params, x_0
    )
    late = t > 12.0
    e = np.asarray(flight.x @ extended_plant.C.T - y_m)
    return t[late], e[late]


def largest_error(
    plant: Plant, seed: int, observer: Observer | None, params: LawParams, dt: float = 0.01
) -> FloatArray:
    """Return the largest abs(e) of `flown_error` by channel."""
    return np.asarray(np.abs(flown_error(plant, seed, observer, params, dt)[1]).max(axis=0))


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_with_gains_of_lemma_A_error_falls_with_square_of_period(seed: int) -> None:
    plant = random_plant(seed)
    observer = observer_of(plant)
    K = 1.2 * least_gain(extended(plant, observer))
    omega = 1.2 * np.abs(np.diag(plant.C @ plant.B))
    least, beta = classical_beta(plant, seed, observer)
    params = law_params(K, 1.0, 1.1 * beta, plant.D, omega=omega)
    coarse, fine = (largest_error(plant, seed, observer, params, dt) for dt in (0.01, 0.005))
    assert coarse / fine == approx([4.0, 4.0], rel=0.02)  # measured 3.99 to 4.00
    # half of what N_d needs leaves an error that no period reduces
    below = params._replace(beta=0.5 * least)
    assert np.all(largest_error(plant, seed, observer, below) > 20.0 * coarse)
    # without observer the lemma asks for 2.3 to 3.2 times the beta, and the same beta is below the
    # slew that it has to exceed
    assert np.all(np.abs(classical_beta(plant, seed, None)[1] / beta - 2.75) < 0.5)
    assert np.all(classical_beta(plant, seed, None)[0] > params.beta)
    assert np.all(largest_error(plant, seed, None, params) > 50.0 * coarse)


# Lemma B


NU = np.array([5.0, 5.0])
BETA = np.array([0.3, 0.2])
EPS = np.array([0.01, 0.01])


def ultimate_bound(plant: Plant, K: FloatArray, zeta: float) -> float:
    """Return the smallest bound of Lemma B over a grid of kappa and k_2.

    P solves A_eta' P + P A_eta = -kappa I.
    """
    U = np.abs(plant.U)
    terms = cross_terms(plant)
    DUDK = (plant.D[:, None] * plant.U * plant.D) * K
    b = zeta + float(np.linalg.norm(U @ NU) + np.linalg.norm(U @ BETA))
    bounds = []
    for kappa in np.geomspace(1e-3, 1e2, 40):
        P = kappa * solve_continuous_lyapunov(terms.A_eta.T, -np.eye(N - M))
        Q = form_of(terms, DUDK, P)
        of_V = np.linalg.eigvalsh(block_diag(np.eye(M), np.linalg.inv(plant.S), 2.0 * P))
        for k_2 in np.linspace(0.1, 0.95, 10) * K.min():
            mu = np.linalg.eigvalsh(
                Q - k_2 * np.diag([0.0] * M + [1.0] * M + [0.0] * (N - M))
            ).min()
            if mu > 0.0:
                bounds.append(np.sqrt(of_V.max() / of_V.min()) * b / (2.0 * np.sqrt(k_2 * mu)))
    return float(min(bounds))


def largest_w(plant: Plant, K: FloatArray, kind: str) -> tuple[float, float]:
    """Return the largest norm of w after 6 of 12 s under a u_o, and the bound of abs(N_d).

    abs(u_o_dot) = NU, and the sign is softened. An adverse u_o_dot is NU sgn((D U)' r), which
    raises r' D U u_o_dot most. A bounded one is the same between limits of 0.5. A square one
    alternates every pi s.
    """
    push = Wave(0.5, np.random.default_rng(50).normal(size=N), np.zeros(M))
    dt = 4e-3
    state, _ = ideal(plant, push.omega, push.f, push.y_m)
    amplitude = slew_left(plant, push, None)
    turn = np.exp(1j * np.linspace(0.0, np.pi, 200))
    zeta = float(np.max(np.linalg.norm((amplitude * turn[:, None]).real, axis=1)))
    DU = plant.D[:, None] * plant.U
    T = hidden(plant).T

    def rates(t: float, w: FloatArray) -> tuple[FloatArray, FloatArray]:
        x, u_law, u_o = np.split(w, [N, N + M])
        x_dot = plant.A @ x + (push.f * np.exp(1j * push.omega * t)).real + plant.B @ (u_law + u_o)
        e = plant.C @ x
        r = plant.C @ (x_dot + x)
        u_o_dot = NU * (np.sign(np.sin(t)) if kind == "square" else np.sign(DU.T @ r))
        if kind == "bounded":
            u_o_dot = np.where((np.abs(u_o) >= 0.5) & (u_o_dot * u_o > 0.0), 0.0, u_o_dot)
        u_law_dot = -plant.D * (K * r + BETA * np.clip(e / EPS, -1.0, 1.0))  # (23)
        eta = T @ (x - (state * np.exp(1j * push.omega * t)).real)
        return np.concatenate([x_dot, u_law_dot, u_o_dot]), np.concatenate([e, r, eta])

    w = np.zeros(N + 2 * M)
    largest = 0.0
    for k in range(round(12.0 / dt)):
        slope, signals = rates(k * dt, w)
        w = w + dt * rates((k + 0.5) * dt, w + dt / 2.0 * slope)[0]
        if k * dt > 6.0:
            largest = max(largest, float(np.linalg.norm(signals)))
    return largest, zeta


@pytest.mark.parametrize("seed", [1, 2])
def test_error_stays_within_lemma_B_for_any_bounded_slew_of_observer(seed: int) -> None:
    plant = random_plant(seed, U_12=0.5)
    K = np.array([40.0, 30.0])
    results = {kind: largest_w(plant, K, kind) for kind in ("adverse", "bounded", "square")}
    limit = ultimate_bound(plant, K, results["adverse"][1])
    assert all(largest < limit for largest, _ in results.values())
    assert results["adverse"][0] > 0.05 * limit
    assert results["adverse"][0] == max(largest for largest, _ in results.values())


# The error inside the softened sign, and what remains of the sign


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_inside_softened_sign_error_is_N_d_over_integral_gain(seed: int) -> None:
    # e_i = N_d,i / (K_i (Lambda_i + 1 / T_eps,i)) for a slow N_d and a K that is large against the
    # other terms of (24)
    plant = random_plant(seed)
    K = 40.0
    T_eps = 0.1
    for observer in (None, observer_of(plant)):
        beta = 5.0 * classical_beta(plant, seed, observer)[1]
        params = law_params(K, 1.0, beta, plant.D, Sign.SOFT, eps=beta / K * T_eps)
        t, e = flown_error(plant, seed, observer, params)
        N_d = sum(
            (np.exp(1j * w.omega * t)[:, None] * slew_left(plant, w, observer)).real
            for w in waves(seed)
        )
        predicted = N_d / (K * (1.0 + 1.0 / T_eps))
        # measured 0.06 to 0.09
        assert np.all(np.abs(e - predicted) < 0.1 * np.abs(predicted).max())


@pytest.fixture(scope="module")
def course() -> tuning.Benchmark:
    """Return the 60 s of osprey_servo, with servos, limits, noise and gusts."""
    return tuning.build_benchmark(find_scenario("osprey_servo"))


def gain_set(
    K: str, Lambda: str, beta: str, softening: float, observer: dict[str, list[float]] | None = None
) -> TuningResult:
    """Return gains of q, p, r, V as the result of a search."""
    of_law = {
        name: [float(gain) for gain in text.split()]
        for name, text in (("K", K), ("Lambda", Lambda), ("beta", beta))
    }
    return TuningResult(
        gains=of_law | {"softening": [softening]} | (observer or {}),
        cost=1.0,
        seed=1,
        costs=[1.0],
        evaluations=0,
    )


GAINS = {
    "rise": {
        "nominal": gain_set("22.8 23.6 9.11 3.19", "4.80 8.75 0.957 0.212", "30.7 13.8 7.95 1.22",
        1.32),
        "uncertain": gain_set("21.4 23.4 10.8 3.86", "12.5 15.1 5.82 0.240", "21.0 45.0 12.5 16.1",
        1.92),
        "late": gain_set("18.0 20.7 10.1 3.41", "4.46 3.69 2.97 0.401", "46.6 21.6 13.4 1.39",
        1.44),
    },
    "rise_observer": {
        "uncertain": gain_set(
            "3.69 1.96 0.230 0.0556", "3.91 1.62 876 0.303", "31.6 181 7.69 0.169", 0.232,
            {
                "effort": [0.0217, 0.0658, 0.0565, 0.119], "gust": [0.00941, 0.129, 0.735],
                "wind_time": [0.6, 0.6, 0.6],
                "drift": [1.18, 1.99, 0.130, 0.00428], "loose": [0.00199],
            },
        ),
        "late": gain_set(
            "2.30 2.75 0.997 0.219", "8.21 6.14 69.0 0.00662", "256 8.16 1240 17.9", 0.139,
            {
                "effort": [0.0449, 0.0132, 0.0499, 0.0982], "gust": [0.439, 0.0855, 0.888],
                "wind_time": [0.6, 0.6, 0.6],
                "drift": [0.00177, 0.678, 0.00445, 0.0143], "loose": [0.00208],
            },
        ),
    },
}  # fmt: skip
"""Gains by law and aircraft of their search: the nominal one, uncertain ones too, u late on all of
them; in the gusts alone."""


def as_pi(course: tuning.Benchmark, law: str, objective: str, channels: int) -> FloatArray:
    """Return factors of the score if the softened sign is linear in the first channels.

    The first is nominal, and the second is the mean of four aircraft at +-30 %.
    """
    tuned = GAINS[law][objective]
    gains = {name: np.array(values) for name, values in tuned.gains.items()}
    T_eps = gains["softening"] * course.model.total_lag
    replaced = np.arange(4) < channels
    Lambda = np.where(replaced, gains["Lambda"] + 1.0 / T_eps, gains["Lambda"])
    linear = tuned.gains | {
        "Lambda": Lambda.tolist(),
        "beta": np.where(replaced, 1e-9, gains["beta"]).tolist(),
    }
    scores = []
    for law_gains in (linear, tuned.gains):
        (found,) = law_comparison.compare(
            course, {law: {objective: tuned._replace(gains=law_gains)}}, 4, [0.3], 1, delays=()
        )
        scores.append([found.scores[tuning.GUST], found.levels[0].scores[tuning.GUST].mean])
    return np.asarray(np.array(scores[0]) / np.array(scores[1]))


@pytest.mark.parametrize(
    "law, objective, channels",
    [
        ("rise", "nominal", 3),  # the fourth channel, the airspeed, is below
        ("rise", "uncertain", 4),
        ("rise", "late", 3),
        ("rise_observer", "uncertain", 4),
        ("rise_observer", "late", 4),
    ],
)
def test_behind_servos_tuned_law_scores_as_PI_with_integral_gain(
    course: tuning.Benchmark, law: str, objective: str, channels: int
) -> None:
    # Lambda + 1 / T_eps in place of Lambda, and no sign. Measured -1.4 to 1.3 %, and -4.3 % on
    # uncertain aircraft with the first gains: their thrust saturates, and the anti-windup of PI
    # differs from that of both integrals.
    assert as_pi(course, law, objective, channels) == approx([1.0, 1.0], abs=0.05)


@pytest.mark.parametrize("objective", ["nominal", "late"])
def test_airspeed_saturates_sign_with_gains_tuned_on_nominal_aircraft(
    course: tuning.Benchmark, objective: str
) -> None:
    # Its softened sign is 0.06 m/s wide. Without the limit of the sign the score is 13 and 10 %
    # larger.
    assert as_pi(course, "rise", objective, 4)[0] > 1.05
