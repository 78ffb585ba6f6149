# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test the design of the observer.

Its models are compared with an integrator of scipy, and its gains with scipy's Riccati solver.
"""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.integrate import solve_ivp
from scipy.linalg import solve_discrete_are

from aircraft_sim.airframes.airframe import load_airframe
from aircraft_sim.uncertainty import KINEMATIC, nominal_and_sampled
from control_laws import observer_design
from control_laws.nominal_model import NominalModel
from control_laws.observer_design import ExtendedStateWeights, Names, Weights
from flight_core.vectors import FloatArray

AIRFRAME = load_airframe("osprey")
NAMES = Names(
    tuple(AIRFRAME.states), tuple(AIRFRAME.inputs), AIRFRAME.outputs, tuple(AIRFRAME.gusts)
)
M = 4


def osprey() -> NominalModel:
    """Return the osprey with the lags and noise of osprey_servo, with channels in its own order."""
    one = np.ones(M)
    return NominalModel(
        A=AIRFRAME.matrix_a(),
        B=AIRFRAME.matrix_b(),
        C=AIRFRAME.matrix_c(),
        gravity=AIRFRAME.matrix_gravity(),
        wind=np.stack([AIRFRAME.gust_direction(axis) for axis in AIRFRAME.gusts], axis=1),
        noise=np.array([0.0017, 0.03, 0.0017, 0.0017]),
        kinematic=np.array([float(state in KINEMATIC) for state in AIRFRAME.states]),
        size=np.array([1.0 if unit == "m/s" else 0.1 for unit in AIRFRAME.states.values()]),
        input_scale=np.array([0.0178096, 0.166667, 0.0116355, 0.102667]),
        D=one,
        lag=np.array([0.02, 0.1, 0.02, 0.02]),
        total_lag=np.array([0.035, 0.115, 0.035, 0.035]),
        period=0.01,
        lower=-one,
        upper=one,
    )


def weights(*batch: int) -> Weights:
    """Return the weights that a tuning found for the osprey.

    With leading axes they are random weights around these.
    """
    middle = Weights(
        *map(np.array, ([0.05] * M, [0.3] * M, [0.9, 0.4, 0.4], [4.7, 0.6, 1.9], [0.004]))
    )
    generator = np.random.default_rng(1)
    return Weights(
        *(
            weight * np.exp(0.3 * generator.standard_normal((*batch, len(weight))))
            if batch
            else weight
            for weight in middle
        )
    )


def extended_weights() -> ExtendedStateWeights:
    return ExtendedStateWeights(
        np.full(M, 0.02), np.full(M, 0.3), np.full(M, 10.0), np.full(M, 5.0)
    )


def uncertain(count: int) -> NominalModel:
    """Return models of the osprey and of `count` - 1 uncertain ones, as one array."""
    A, B = nominal_and_sampled(AIRFRAME, 0.4, count - 1, seed=1)
    return osprey()._replace(A=A, B=B)


def test_step_of_aircraft_model_is_motion_of_equations() -> None:
    model = osprey()
    wind_time = np.array([4.7, 0.6, 1.9])
    model_by_tick = observer_design.aircraft_model(model, NAMES, wind_time)
    generator = np.random.default_rng(2)
    z = 0.1 * generator.standard_normal(19)
    u = 0.1 * generator.standard_normal(4)

    def motion(_: float, z: FloatArray) -> FloatArray:
        x, position, wind, d = np.split(z, [8, 12, 15])
        x_dot = (
            model.A @ x + model.gravity @ x + model.B @ position + model.wind @ wind + model.C.T @ d
        )
        x_dot -= 0.01 * model.kinematic * x
        return np.concatenate([x_dot, (u - position) / model.lag, -wind / wind_time, -0.01 * d])

    solution = solve_ivp(motion, (0.0, model.period), z, method="DOP853", rtol=1e-12, atol=1e-14).y[
        :, -1
    ]
    assert_allclose(model_by_tick.Phi @ z + model_by_tick.Gamma @ u, solution, atol=1e-11)


def test_extended_state_step_solves_equations() -> None:
    model = osprey()
    decay = np.array([7.3, 5.8, 2.8, 4.6])
    model_by_tick = observer_design.extended_state_model(model, NAMES, decay)
    generator = np.random.default_rng(3)
    z = 0.1 * generator.standard_normal(16)
    u = 0.1 * generator.standard_normal(4)

    def motion(_: float, z: FloatArray) -> FloatArray:
        _y, position, d, rate = np.split(z, 4)
        return np.concatenate(
            [model.Omega @ position + d, (u - position) / model.lag, rate - 0.01 * d, -decay * rate]
        )

    solution = solve_ivp(motion, (0.0, model.period), z, method="DOP853", rtol=1e-12, atol=1e-14).y[
        :, -1
    ]
    assert_allclose(model_by_tick.Phi @ z + model_by_tick.Gamma @ u, solution, atol=1e-11)


@pytest.mark.parametrize("kind", ["aircraft", "extended state"])
def test_gains_are_those_of_riccati_solver_of_scipy(kind: str) -> None:
    model = osprey()
    size = np.array([0.1, 1.0, 0.1, 0.1])
    design_weights: Weights | ExtendedStateWeights
    if kind == "aircraft":
        design_weights = weights()
        design = observer_design.aircraft_observer(model, NAMES, design_weights)
        noise = [
            design_weights.loose * model.size,
            np.full(M, 1e-6),
            design_weights.gust,
            design_weights.drift * size,
        ]
    else:
        design_weights = extended_weights()
        design = observer_design.extended_state_observer(model, NAMES, design_weights)
        noise = [
            np.zeros(M),
            np.full(M, 1e-6),
            design_weights.drift * size,
            design_weights.rate_drift * size,
        ]
    Phi = design.Phi
    Gamma = design.Gamma
    H = design.H
    Q = H.T @ np.diag(1.0 / size**2) @ H
    R = np.diag((design_weights.effort / model.input_scale / size) ** 2)
    P = solve_discrete_are(Phi, Gamma, Q, R)
    expected = np.linalg.solve(R + Gamma.T @ P @ Gamma, Gamma.T @ P @ Phi)
    # scipy's own residuals are of that size: modes that decay with 0.01 1/s lie 1e-4 from the unit
    # circle
    assert_allclose(design.F, expected, rtol=1e-5, atol=1e-6 * np.abs(expected).max())
    process = np.diag(np.concatenate(noise) ** 2 * model.period)
    measured = np.diag(model.noise**2)
    S = solve_discrete_are(Phi.T, H.T, process, measured)
    expected = S @ H.T @ np.linalg.inv(H @ S @ H.T + measured)
    assert_allclose(design.L, expected, rtol=1e-5, atol=1e-6 * np.abs(expected).max())


def test_extended_state_observer_holds_aircraft_with_unknown_dynamics() -> None:
    # the osprey under a constant moment and force: the estimate of the disturbance contains them
    # and all of A
    model = osprey()
    design = observer_design.extended_state_observer(model, NAMES, extended_weights())
    plant = observer_design.aircraft_model(model, NAMES, np.ones(3))
    x = np.zeros(19)
    z = np.zeros(16)
    u = np.zeros(4)
    x[15:] = [0.5, 0.5, 0.5, 0.5]  # rad/s^2 and m/s^2
    largest = []
    for _ in range(3000):
        y = plant.H @ x
        z = z + design.L @ (y - design.H @ z)
        u = -design.F @ z
        z = design.Phi @ z + design.Gamma @ u
        x = plant.Phi @ x + plant.Gamma @ u
        largest.append(np.abs(y).max())
    # alone, the moment would turn the aircraft at 0.05 rad/s in 0.1 s and the force accelerate it
    # to 15 m/s in 30 s
    assert max(largest) < 0.2
    assert largest[-1] < 0.01
