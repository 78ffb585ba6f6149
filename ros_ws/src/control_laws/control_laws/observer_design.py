# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Design the observer, for many models and weights at once.

A design is a model in discrete time with two linear-quadratic gains, one for the estimates and one
for the feedback.

There are two models. `aircraft_observer` knows A, B, f, wind and lags of an airframe, and
`extended_state_observer` knows only Omega and lags. A, B, wind and the weights may have leading
axes, which are broadcast together, so that N aircraft or N sets of weights give N designs. Phi,
Gamma, H, L and F are the matrices of the observer of `rise_di_controller.extensions.observer`.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from control_laws.nominal_model import NominalModel
from control_laws.riccati import correction_of, diagonal, gain_of, transpose
from flight_core.vectors import FloatArray
from rise_di_controller.law.linear_loop import zero_order_hold

Correction = Callable[[FloatArray, FloatArray, FloatArray, FloatArray], FloatArray]
"""A function that computes the gain as `riccati.correction_of` does."""

# decay of the angles and the disturbances in the model, 1/s, so that every mode is observable or
# stable
LEAK = 0.01
MIN_LAG = 1e-4  # lag of an ideal actuator in the model, s
ACTUATOR_NOISE = 1e-6  # negligible noise of the actuators' positions, rad or 1 per root s


class Names(NamedTuple):
    """Names of the channels of a model, in the order of the arrays."""

    states: tuple[str, ...]  # n states
    inputs: tuple[str, ...]  # m inputs, in the order of the columns of B
    outputs: tuple[str, ...]  # m outputs, in the order of the rows of C
    winds: tuple[str, ...]  # G axes of the wind


class Weights(NamedTuple):
    """Weights of the design with the aircraft's model.

    "sizes" below are the units of the states, `NominalModel.size`.
    """

    # an input that gives y the rate of change a costs as much as an error of effort a, (.., m), s
    effort: FloatArray
    drift: FloatArray  # noise of the disturbances, (.., m), sizes/s per root s
    gust: FloatArray  # noise of the wind, (.., G), m/s per root s
    wind_time: FloatArray  # time constants of the wind, (.., G), s
    # noise of the states, which stands for the model error, sizes per root s, (.., n), or (.., 1)
    # if equal for every state
    loose: FloatArray


class ExtendedStateWeights(NamedTuple):
    """Weights of the design without the aircraft's A."""

    effort: FloatArray  # as in `Weights`, (.., m), s
    drift: FloatArray  # noise of the disturbances, (.., m), sizes/s per root s
    rate_drift: FloatArray  # noise of the disturbances' rates, (.., m), sizes/s^2 per root s
    decay: FloatArray  # decay of these rates, (.., m), 1/s


class ObserverModel(NamedTuple):
    """A model of the deviation from the reference, with u held over a period.

    z+ = Phi z + Gamma (u - u_ff), e = H z.
    """

    # names of the values of z, such as x.alpha, position.elevator, wind.vertical, disturbance.q
    states: tuple[str, ...]
    Phi: FloatArray  # (.., s, s)
    Gamma: FloatArray  # (.., s, m)
    H: FloatArray  # (m, s)


class ObserverDesign(NamedTuple):
    """A model with the gain L of the estimate z_hat, and the gain F of the feedback.

    z_hat = z + L (e - H z), u - u_ff = -F z_hat, z+ = Phi z_hat + Gamma (u - u_ff).
    """

    states: tuple[str, ...]
    Phi: FloatArray  # (.., s, s)
    Gamma: FloatArray  # (.., s, m)
    H: FloatArray  # (m, s)
    L: FloatArray  # (.., s, m)
    F: FloatArray  # (.., m, s)


def aircraft_model(model: NominalModel, names: Names, wind_time: FloatArray) -> ObserverModel:
    """Model the aircraft around the reference, with actuators, wind and output disturbances.

        z = [x, position, w, d]
        x_dot        = (A + gravity) x + B position + wind w + C' d
        position_dot = (u - u_ff - position) / lag,  w_dot = -w / wind_time,  d_dot = -LEAK d

    Angles also decay with LEAK. u_ff produces the motion along the reference, so the model holds
    for small deviations from this motion. z has n + m + G + m values. A, B and wind of the model
    and `wind_time`, (.., G), may have leading axes.
    """
    A, (n, m), G = (
        model.A + model.gravity - LEAK * np.diag(model.kinematic),
        model.B.shape[-2:],
        model.wind.shape[-1],
    )
    x, p, w, d = np.split(np.arange(n + m + G + m), [n, n + m, n + m + G])
    batch = np.broadcast_shapes(
        A.shape[:-2], model.B.shape[:-2], model.wind.shape[:-2], wind_time.shape[:-1]
    )
    motion = np.zeros((*batch, n + m + G + m, n + m + G + m))
    motion[..., x[:, None], x] = A
    motion[..., x[:, None], p] = model.B
    motion[..., x[:, None], w] = model.wind
    motion[..., x[:, None], d] = model.C.T
    motion[..., w, w] = -1.0 / wind_time
    motion[..., d, d] = -LEAK
    groups = {
        "x": names.states,
        "position": names.inputs,
        "wind": names.winds,
        "disturbance": names.outputs,
    }
    return _sampled(groups, motion, p, model.C, model)


def extended_state_model(model: NominalModel, names: Names, decay: FloatArray) -> ObserverModel:
    """Model each output as the integral of Omega times the actuators, plus a disturbance.

    The disturbances are of second order:

        z = [x, position, d, disturbance_rate]
        x_dot        = Omega position + d,  position_dot = (u - u_ff - position) / lag
        d_dot        = disturbance_rate - LEAK d,  disturbance_rate_dot = -decay disturbance_rate

    x are the outputs, and z has 4 m values. Only Omega, the lags and the period of `model` are
    used. `decay` (.., m) is in 1/s. Source: J. Han, "From PID to Active Disturbance Rejection
    Control", IEEE Trans. Industrial Electronics 56(3), 2009.
    """
    m = len(model.C)
    x, p, d, rate = np.split(np.arange(4 * m), 4)
    motion = np.zeros(
        (*np.broadcast_shapes(model.Omega.shape[:-2], decay.shape[:-1]), 4 * m, 4 * m)
    )
    motion[..., x[:, None], p] = model.Omega
    motion[..., x, d] = 1.0
    motion[..., d, rate] = 1.0
    motion[..., d, d] = -LEAK
    motion[..., rate, rate] = -decay
    groups = {
        "x": names.outputs,
        "position": names.inputs,
        "disturbance": names.outputs,
        "disturbance_rate": names.outputs,
    }
    return _sampled(groups, motion, p, np.eye(m), model)


def _sampled(
    groups: dict[str, tuple[str, ...]],
    motion: FloatArray,
    p: NDArray[np.int64],
    C: FloatArray,
    model: NominalModel,
) -> ObserverModel:
    """Sample a model in continuous time over a period.

    The states with the indices p are the positions of the actuators. The outputs are C times the
    first states.
    """
    lag, (m, n) = np.maximum(model.lag, MIN_LAG), C.shape
    drive = np.zeros((motion.shape[-1], m))
    H = np.zeros((m, motion.shape[-1]))
    motion[..., p, p] = -1.0 / lag
    drive[p, np.arange(m)] = 1.0 / lag
    H[:, :n] = C
    states: list[str] = []
    for group, members in groups.items():
        states += [f"{group}.{name}" for name in members]
    return ObserverModel(tuple(states), *zero_order_hold(motion, drive, model.period), H)


def aircraft_observer(model: NominalModel, names: Names, weights: Weights) -> ObserverDesign:
    """Design the observer with the model `aircraft_model` and the gains of two Riccati equations.

    F minimises the sum of (e / size)^2 + (effort (u - u_ff) / (input_scale size))^2, and L
    minimises the variance of the estimate. White noise drives the wind (`gust`), the disturbances
    (`drift`) and the states (`loose`), and e has the noise of the model. Source: H. Kwakernaak, R.
    Sivan, "Linear Optimal Control Systems", ch. 5 and 6.
    """
    model_by_tick = aircraft_model(model, names, weights.wind_time)
    return ObserverDesign(
        *model_by_tick,
        aircraft_correction(model_by_tick, model, weights),
        feedback_gain(model_by_tick, model, weights.effort),
    )


def aircraft_correction(
    model_by_tick: ObserverModel,
    model: NominalModel,
    weights: Weights,
    correction: Correction = correction_of,
) -> FloatArray:
    """Compute L of `aircraft_observer`, shape (.., s, m)."""
    positions = np.full(len(model.lag), ACTUATOR_NOISE)
    intensities = [
        weights.loose * model.size,
        positions,
        weights.gust,
        weights.drift * (model.C @ model.size),
    ]
    return _correction(model_by_tick, model, intensities, correction)


def vane_correction(
    model_by_tick: ObserverModel,
    model: NominalModel,
    weights: tuple[Weights, Weights],
    row: FloatArray,
    noise: float,
) -> FloatArray:
    """Compute the gains that a vane adds to L of `aircraft_correction`, (s, m + 1).

    An observer of y and the vane has other gains than an observer of y alone. The result is the
    difference. The last column acts on the reading of the vane. The observer takes the deviation of
    this reading from its value in the reference motion. This deviation is `row` z plus white noise
    with the rms `noise`, where `row` has the shape (s,). `weights` has the weights without the
    vane, and then the weights with the vane.
    """
    without_vane = aircraft_correction(model_by_tick, model, weights[0])
    with_vane = model_by_tick._replace(H=np.vstack([model_by_tick.H, row]))
    both = aircraft_correction(
        with_vane, model._replace(noise=np.append(model.noise, noise)), weights[1]
    )
    return np.asarray(both - np.column_stack([without_vane, np.zeros(len(without_vane))]))


def extended_state_observer(
    model: NominalModel, names: Names, weights: ExtendedStateWeights
) -> ObserverDesign:
    """Design the observer with the model `extended_state_model`.

    The method is the same as in `aircraft_observer`.
    """
    model_by_tick = extended_state_model(model, names, weights.decay)
    size = model.C @ model.size
    intensities = [
        0.0 * size,
        np.full(len(size), ACTUATOR_NOISE),
        weights.drift * size,
        weights.rate_drift * size,
    ]
    L = _correction(model_by_tick, model, intensities)
    return ObserverDesign(*model_by_tick, L, feedback_gain(model_by_tick, model, weights.effort))


def feedback_gain(
    model_by_tick: ObserverModel, model: NominalModel, effort: FloatArray
) -> FloatArray:
    """Compute F of `aircraft_observer`, shape (.., m, s), for `effort` (.., m), s."""
    size = model.C @ model.size
    Q = transpose(model_by_tick.H) @ np.diag(1.0 / size**2) @ model_by_tick.H
    return gain_of(
        model_by_tick.Phi,
        model_by_tick.Gamma,
        Q,
        diagonal((effort / model.input_scale / size) ** 2),
    )


def _correction(
    model_by_tick: ObserverModel,
    model: NominalModel,
    intensities: list[FloatArray],
    correction: Correction = correction_of,
) -> FloatArray:
    """Compute L for white noise that acts on the states.

    `intensities` is a list of arrays, (.., k). Each has the noise of k successive states, and
    together they have the noise of all states, SI per root s.
    """
    batch = np.broadcast_shapes(*(intensity.shape[:-1] for intensity in intensities))
    process = np.concatenate(
        [np.broadcast_to(intensity, (*batch, intensity.shape[-1])) for intensity in intensities],
        axis=-1,
    )
    return correction(
        model_by_tick.Phi,
        model_by_tick.H,
        diagonal(process**2 * model.period),
        np.diag(model.noise**2),
    )
