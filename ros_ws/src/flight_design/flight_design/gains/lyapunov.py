# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Compute the paper's Lyapunov functions along a flight of a known plant.

They are evidence for the theorem, and the law does not use them.

All quantities are in the law's channel order and its scaled inputs v (u = input_scale v), with
Omega = C B in these inputs. Time derivatives are central differences over the samples of a flight.
y_dot jumps with u at a sample, and the difference then gives the mean of the values before and
after the jump. The differences are exact up to terms that vanish with the sampling period.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from aircraft_sim.plant import dynamics
from flight_analysis.closed_loop.scenario import Scenario
from flight_core.integrators import rk4
from flight_core.tape import Tape
from flight_core.vectors import FloatArray
from rise_di_controller.law.decomposition import decompose
from rise_di_controller.law.law import LawParams, Sign, engage, step


class KnownPlant(NamedTuple):
    """A plant as in equation (1), x_dot = A x + f(t, x) + B v, y = C x.

    Outputs and scaled inputs v are in the law's order.
    """

    A: FloatArray  # (n, n)
    B: FloatArray  # (n, m), per scaled input
    C: FloatArray  # (m, n), of full row rank
    f: Callable[[float, FloatArray], FloatArray]  # (t, x) -> (n,)


class FlightSamples(NamedTuple):
    """Signals of a flight at N >= 3 ticks of the law, from which `evidence` is computed.

    The law engages at the first tick.
    """

    t: FloatArray  # (N,) s
    x: FloatArray  # (N, n)
    f: FloatArray  # (N, n), f(x, t) of equation (1)
    y_m: FloatArray  # (N, m)
    Pi: FloatArray  # (N, m), equation (21), scaled input


class Evidence(NamedTuple):
    """The signals of the stability proof along a flight of N ticks."""

    t: FloatArray  # (N,) s
    e: FloatArray  # (N, m), equation (3)
    e_dot: FloatArray  # (N, m)
    r: FloatArray  # (N, m), equation (4)
    N_d: FloatArray  # (N, m), equation (17) with all reference terms
    L: FloatArray  # (N,), equation (46)
    V1: FloatArray  # (N,), equation (31)
    P: FloatArray  # (N,), equation (47)
    V2: FloatArray  # (N,), equation (48)


def from_tape(scenario: Scenario, tape: Tape) -> tuple[KnownPlant, FlightSamples]:
    """Read plant and samples at the ticks of the law from the recorded topics of a scenario.

    The channels are in the law's order, in scaled inputs. The tape must come from a simulation in
    one process, or from a bag with an exact clock. Raises ValueError if a tick has no sample of
    `truth` or `y_m` with its stamp.
    """
    airframe, aircraft = scenario.aircraft.load()
    controller = scenario.controller
    outputs = [airframe.outputs.index(name) for name in controller.outputs]
    inputs = [list(airframe.inputs).index(name) for name in controller.inputs]
    stamps = tape["internals"].stamp_ns
    ticks = {
        name: np.flatnonzero(np.isin(tape[name].stamp_ns, stamps)) for name in ("truth", "y_m")
    }
    for name, indices in ticks.items():
        if len(indices) != len(stamps):
            raise ValueError(f"{name}: samples at {len(indices)} of {len(stamps)} ticks of the law")
    plant = KnownPlant(
        aircraft.A,
        aircraft.B[:, inputs] * controller.law_params().input_scale,
        aircraft.C[outputs],
        lambda t, x: np.asarray(dynamics.f(t, x, aircraft)),
    )
    truth = tape["truth"]
    internals = tape["internals"]
    y_m = np.column_stack([tape["y_m"][name][ticks["y_m"]] for name in controller.outputs])
    x, f = (truth.group(name).values[ticks["truth"]] for name in ("x", "f"))
    return plant, FlightSamples(
        t=tape.time("internals"), x=x, f=f, y_m=y_m, Pi=internals.group("Pi").values
    )


def fly_known_plant(
    plant: KnownPlant, y_m: FloatArray, dt: float, params: LawParams, x_0: FloatArray
) -> FlightSamples:
    """Fly the plant under the law from the state x_0, engaged at t = 0.

    In each period dt, the law computes v at the tick, and a Runge-Kutta step integrates the plant
    while v is held. `y_m` is the reference at the ticks, shape (N, m), and `dt` is in s. `params`
    must have input_scale 1, because B acts on v. `x_0` has shape (n,).
    """

    def x_dot(t: float, x: FloatArray, v: FloatArray, _: None) -> FloatArray:
        return plant.A @ x + plant.f(t, x) + plant.B @ v

    x = x_0
    state = engage(plant.C @ x_0, y_m[0])
    v = np.zeros(y_m.shape[1])
    t = np.asarray(dt * np.arange(len(y_m)), dtype=np.float64)
    xs = [x]
    Pis = [state.Pi]
    for k in range(1, len(t)):
        x = rk4(x_dot, t[k - 1], x, v, None, dt)
        state, v = step(state, plant.C @ x, y_m[k], dt, params)
        xs.append(x)
        Pis.append(state.Pi)
    f = [plant.f(float(time), x) for time, x in zip(t, xs, strict=True)]
    return FlightSamples(t=t, x=np.array(xs), f=np.array(f), y_m=y_m, Pi=np.array(Pis))


def evidence(
    plant: KnownPlant, flight: FlightSamples, params: LawParams, zeta_b: float = 0.0
) -> Evidence:
    """Compute the signals of the proof along a flight, with Omega = C B = S D U (11), M = S^-1.

        e = C x - y_m (3),  r = e_dot + Lambda e (4)
        N_d = M (C A (x_dot - C^+ e_dot) + C f_dot - y_m_ddot)
            (17), with the reference term of (18)
        V1 = (e'e + r'M r) / 2                                            (31)
        L = r' (N_d - D U D Pi_dot)  (46), beta Sgn(e) being Pi_dot by (21)
        P = zeta_b - integral_0^t L  (trapezoid),  V2 = V1 + P            (47), (48)

    C^+ is the pseudo-inverse, and C^+ e_dot is the part of x_dot that appears in e_dot. Lemma 2
    claims that P >= 0 if zeta_b is the constant of `lemma_2`. With the default 0, P and V2 are
    known up to a constant. The shapes are given at the fields of `Evidence`. Raises
    DecompositionError if Omega has no decomposition S D U.
    """
    S, D, U = decompose(plant.C @ plant.B)
    M = np.linalg.inv(S)
    t = flight.t

    def derivative(signal: FloatArray) -> FloatArray:
        return np.asarray(np.gradient(signal, t, axis=0, edge_order=2))

    e = flight.x @ plant.C.T - flight.y_m
    e_dot = derivative(e)
    r = e_dot + params.Lambda * e
    hidden = derivative(flight.x) - e_dot @ np.linalg.pinv(plant.C).T
    y_m_ddot = derivative(derivative(flight.y_m))
    N_d = (hidden @ (plant.C @ plant.A).T + derivative(flight.f) @ plant.C.T - y_m_ddot) @ M.T
    V1 = (np.sum(e * e, axis=1) + np.sum(r * (r @ M.T), axis=1)) / 2.0
    L = np.sum(r * (N_d - derivative(flight.Pi) @ (D[:, None] * U * D).T), axis=1)
    P = zeta_b - integral(L, t)
    return Evidence(t=t, e=e, e_dot=e_dot, r=r, N_d=N_d, L=L, V1=V1, P=P, V2=V1 + P)


def decay_matrix(plant: KnownPlant, params: LawParams) -> FloatArray:
    """Compute Q of V2_dot = -z' Q z along every flight of the continuous law, shape (2m, 2m).

    z = [e; r], and Q is symmetric.

    z' Q z = e' Lambda e - r' N~ + r' D U D K r with N~ = G (r - Lambda e) + e, G = M (C A C^+ +
    Lambda). Q contains neither beta nor N_d. Steps 2 and 3 of Theorem 1 are sufficient for Q > 0:
    step 2 makes k_g large compared with N~, and step 3 makes k_d large compared with the
    off-diagonal entries of U. Source: (24), (31), (32), (46)-(48).
    """
    S, D, U = decompose(plant.C @ plant.B)
    m = len(D)
    G = np.linalg.inv(S) @ (plant.C @ plant.A @ np.linalg.pinv(plant.C) + np.diag(params.Lambda))
    rows = [
        [np.diag(params.Lambda), np.zeros((m, m))],
        [G * params.Lambda - np.eye(m), (D[:, None] * U * D) * params.K - G],
    ]
    Q = np.block(rows)
    return np.asarray((Q + Q.T) / 2.0)


def lemma_2(plant: KnownPlant, signals: Evidence, params: LawParams) -> float:
    """Compute the constant zeta_b of (47) that Lemma 2 gives for a flight.

    With this constant, P >= 0 follows from (29), (30).

        zeta_i = max_t abs(N_d,i) + sum_(j>i) abs(U_ij) beta_j
        gamma_2,i = Lambda_i (beta_i / zeta_i - 1)
        gamma_1,i = max_t (integral abs(e_dot_i) - gamma_2,i integral abs(e_i) - abs(e_i))
        zeta_b = sum_i beta_i abs(e_i(0)) + gamma_1,i zeta_i

    zeta_i is the lower bound of beta_i in (29), (30). gamma_2,i is the largest value that (29),
    (30) allow, and gamma_1,i is the smallest value with which (40) holds.

    Raises ValueError, which names the channel, if beta_i < zeta_i, because no gamma_2 >= 0 meets
    (29), (30) then.
    """
    U = decompose(plant.C @ plant.B).U
    zeta = np.max(np.abs(signals.N_d), axis=0) + np.triu(np.abs(U), 1) @ params.beta
    for i, (beta, bound) in enumerate(zip(params.beta, zeta, strict=True)):
        if beta < bound:
            raise ValueError(
                f"beta[{i}]: found {beta:.3g}, expected at least {bound:.3g} for (29), (30)"
            )
    gamma_2 = params.Lambda * (params.beta / zeta - 1.0)
    size = np.abs(signals.e)
    slack = integral(np.abs(signals.e_dot), signals.t) - gamma_2 * integral(size, signals.t) - size
    return float(params.beta @ size[0] + np.max(slack, axis=0) @ zeta)


def integral(signal: FloatArray, t: FloatArray) -> FloatArray:
    """Integrate a sampled signal from the first sample to each t by the trapezoid rule.

    The result is 0 at the first sample, and has the shape of the signal: (N,) or (N, m).
    """
    means = (signal[1:] + signal[:-1]) / 2.0
    result = np.zeros_like(signal)
    np.cumsum((np.diff(t) * means.T).T, axis=0, out=result[1:])
    return result


class Example(NamedTuple):
    """An example flight: the plant and the other arguments of `fly_known_plant`."""

    plant: KnownPlant
    y_m: FloatArray  # (N, m) at the ticks
    params: LawParams
    x_0: FloatArray  # (n,)


def example(dt: float, duration: float) -> Example:
    """Build an example plant with four states and two inputs, D = diag(1, -1), and a full U.

    The disturbance and the reference are persistent. The plant is well conditioned (M between 0.8
    and 1.3, zeros -1.48 and -1.02). The gains meet the conditions of Theorem 1 on this flight:
    `decay_matrix` is positive definite and `lemma_2` finds a constant. Times are in s.
    """
    D = np.array([1.0, -1.0])
    U = np.array([[1.0, 0.4], [0.0, 1.0]])
    S = np.array([[1.2, 0.2], [0.2, 0.9]])
    A = np.array(
        [
            [-1.0, 0.3, 0.5, -0.2],
            [0.2, -0.8, 0.3, 0.4],
            [0.4, -0.3, -1.5, 0.2],
            [0.1, 0.5, -0.2, -1.0],
        ]
    )
    B = np.vstack([S * D @ U, 0.1 * np.eye(2)])

    def f(t: float, x: FloatArray) -> FloatArray:
        pushes = [np.sin(0.9 * t), np.cos(0.7 * t), 0.0, 0.0]
        return np.asarray(np.array([0.3, 0.4, 0.2, 0.1]) * np.sin(x[[2, 0, 3, 1]]) + pushes)

    t = dt * np.arange(round(duration / dt) + 1)
    y_m = np.column_stack([0.5 * np.sin(t), 0.4 * np.sin(0.6 * t + 1.0)])
    K = np.array([6.0, 4.0])
    beta = np.array([5.0, 3.0])
    ones = np.ones(2)
    eps = beta / K * 3.0 * 1.5 * dt
    params = LawParams(
        K=K,
        Lambda=ones,
        beta=beta,
        D=D,
        input_scale=ones,
        omega=2.0 * ones,
        eps=eps,
        sign=Sign.IMPLICIT,
    )
    return Example(KnownPlant(A, B, np.eye(2, 4), f), y_m, params, np.array([0.5, 0.0, 0.0, 0.0]))
