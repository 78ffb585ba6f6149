# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Fit a second-order response with a delay and a lag to the beginning of a step response."""

import math
from typing import Any, NamedTuple

import numpy as np
from scipy.optimize import least_squares

from flight_core.vectors import FloatArray

MAX_DELAY = 0.3  # s, largest delay in the fit
# This fraction of a covariance's largest eigenvalue is added to all of its eigenvalues, because
# smaller ones are rounding errors.
RANK = 1e-10
MAX_LAG = 1.0  # s, largest lag in the fit
RESOLUTION = 0.025  # s, time between the points of the step response that are fitted
# error that the windows of `response_identification` and the linear model leave, as a share of the
# step response's largest value
FLOOR = 0.01
STARTS_DELAY = (0.02, 0.1, 0.2)  # s
STARTS_LAG = (0.03, 0.2)  # s; the search starts from each pair
# The fitted response is Omega times the first response of `second_order_response`, plus the slow
# part times the second one. The bounds belong to delay, s, lag, s, Omega, damping, 1/s,
# stiffness, 1/s^2, and slow part. Omega and the slow part are relative to the largest value of the
# response.
LOWER = np.array([0.0, 0.003, -np.inf, -2.0, -20.0, -np.inf])
UPPER = np.array([MAX_DELAY, MAX_LAG, np.inf, 300.0, 5000.0, np.inf])
SCALE = np.array([0.05, 0.05, 5.0, 5.0, 50.0, 50.0])  # typical sizes, which scale the search
SPREAD = np.array([1.0, 0.2, 1e3, 50.0, 2500.0, 5000.0])  # prior standard deviations
# Which of these parameters are free in an integrator, in a model of first order, and in one of
# second order.
ORDERS = ((1, 1, 1, 0, 0, 0), (1, 1, 1, 1, 0, 0), (1, 1, 1, 1, 1, 1))
MIN_GAIN = 6.0  # decrease of chi squared per additional parameter that a higher order must bring
# Relative change of chi squared at which a search ends. It is so small that it changes neither the
# order that is chosen by MIN_GAIN nor a standard error.
TOLERANCE = 1e-6
EARLY = 0.3  # s after delay and lag; the response until then decides on the sign of Omega_jj
# s after delay and lag; the responses of the other outputs until then give the rest of Omega
COUPLING_SPAN = 0.25


class ResponseColumn(NamedTuple):
    """The responses of m outputs to one input, and the lag and delay of this input, s."""

    Omega: FloatArray  # (m,) column of Omega
    deviation: FloatArray  # (m,) standard errors of this column
    lag: float
    lag_deviation: float
    delay: float
    delay_deviation: float
    # How certain the sign of Omega_jj is: the size of the early response of the driven output, in
    # standard errors, or 0 if this response begins with the other sign
    sign_ratio: float


def no_column(m: int) -> ResponseColumn:
    """Return a column of NaN with a `sign_ratio` of 0, for an input without a result."""
    return ResponseColumn(
        Omega=np.full(m, np.nan),
        deviation=np.full(m, np.nan),
        lag=math.nan,
        lag_deviation=math.nan,
        delay=math.nan,
        delay_deviation=math.nan,
        sign_ratio=0.0,
    )


def second_order_response(
    t: FloatArray, delay: float, lag: float, damping: float, stiffness: float
) -> tuple[FloatArray, FloatArray]:
    """Return the step responses of two second-order systems behind a lag and a delay, (N,) each.

    The first system is y'' + damping y' + stiffness y = v', and the second has v in place of v'. In
    both, lag v' = u(t - delay) - v, and the system is at rest before the step.
    """
    begin = np.maximum(t - delay, 0.0)
    # the state z, z', v; the output is z' for the first response, z for the second
    A = np.array([[0.0, 1.0, 0.0], [-stiffness, -damping, 1.0], [0.0, 0.0, -1.0 / lag]])
    # The small terms make the eigenvalues distinct.
    values, vectors = np.linalg.eig(A + np.diag([0.0, 1e-3, 2e-3]))
    parts = np.linalg.solve(vectors, np.array([0.0, 0.0, 1.0 / lag]))
    product = values[:, None] * begin
    small = np.abs(product) < 1e-6
    growth = np.where(
        small, begin, np.expm1(product) / np.where(values == 0.0, 1.0, values)[:, None]
    )
    z = (vectors @ (parts[:, None] * growth)).real
    return z[1], z[0]


def fitted_column(t: FloatArray, responses: FloatArray, j: int) -> ResponseColumn:
    """Fit delay, lag and Omega_jj of input j to output j, then Omega_ij to the other outputs.

    The fit takes the same delay and lag for the other outputs. t has shape (N,), and `responses` (1
    + DRAWS, N, m). The first response is the estimate, and the others are draws that show its error
    (`response_identification`).
    """
    step = responses[0]
    size = max(float(np.max(np.abs(step[:, j]))), np.finfo(float).tiny)
    whiten = _whitener(responses[:, :, j])
    best = _search(t, whiten, step[:, j] / size, size, ORDERS[0], None)
    for free in ORDERS[1:]:
        trial = _search(t, whiten, step[:, j] / size, size, free, best.theta)
        if best.chi_squared - trial.chi_squared > MIN_GAIN * (
            sum(free) - sum(best.free)
        ) and has_direction_of_Omega(t, trial.theta):
            best = trial
    inside = (np.array(best.free) > 0) & (best.theta > LOWER + 1e-6) & (best.theta < UPPER - 1e-6)
    # Standard errors grow by the Birge ratio, the root of chi squared per degree of freedom.
    # Source: R. T. Birge, Phys. Rev. 40, 1932.
    misfit = max(best.chi_squared / max(len(t) - sum(best.free), 1), 1.0)
    deviation = np.array([RESOLUTION, RESOLUTION, *np.zeros(4)])
    J = best.jacobian[:, inside]
    deviation[inside] = np.sqrt(misfit * np.diag(np.linalg.pinv(J.T @ J)))
    delay = float(best.theta[0])
    lag = float(best.theta[1])
    sign = math.sqrt(_significance(t, responses[:, :, j], best.theta, size) / misfit)
    early = (t > delay) & (t <= delay + lag + COUPLING_SPAN)
    basis = np.stack(second_order_response(t[early], delay, lag, 0.0, 0.0), axis=1)
    Omega = np.zeros(step.shape[1])
    error = np.zeros(step.shape[1])
    for i in range(step.shape[1]):
        whiten = _whitener(responses[:, early, i])
        solve = np.linalg.pinv(whiten @ basis)
        Omega[i] = (solve @ (whiten @ step[early, i]))[0]
        error[i] = np.linalg.norm(solve[0])
    Omega[j] = best.theta[2] * size
    error[j] = deviation[2] * size
    return ResponseColumn(
        Omega=Omega,
        deviation=error,
        lag=lag,
        lag_deviation=float(deviation[1]),
        delay=delay,
        delay_deviation=float(deviation[0]),
        sign_ratio=sign,
    )


def has_direction_of_Omega(t: FloatArray, theta: FloatArray) -> bool:  # noqa: N802 - the symbol
    """Return whether a fitted response begins in the direction of Omega.

    The direction is the sign of the sum of the response, up to the time EARLY after the delay and
    the lag. If this is not the sign of Omega, the response consists of the slow part alone. One of
    the two fitted poles then repeats the lag, and the true Omega is about 0.
    """
    delay, lag, Omega, damping, stiffness, slow = theta
    first, second = second_order_response(
        t[t <= delay + lag + EARLY], delay, lag, damping, stiffness
    )
    return bool(np.sum(Omega * first + slow * second) * Omega > 0.0)


def _significance(t: FloatArray, responses: FloatArray, theta: FloatArray, size: float) -> float:
    """Return by how much a fitted response lowers chi squared, minus 6 for its parameters.

    The response is examined up to the time EARLY after the delay and the lag. A negative result
    becomes 0. The result is also 0 if the response does not begin with the sign of Omega.
    """
    early = t <= theta[0] + theta[1] + EARLY
    first, second = second_order_response(t[early], *theta[[0, 1, 3, 4]])
    fitted = size * (theta[2] * first + theta[5] * second)
    whiten = _whitener(responses[:, early])
    none = whiten @ responses[0, early]
    misfit = whiten @ (responses[0, early] - fitted)
    if has_direction_of_Omega(t, theta):
        return max(float(none @ none - misfit @ misfit) - len(theta), 0.0)
    return 0.0


def _whitener(responses: FloatArray) -> FloatArray:
    """Return W, (N, N), with which the error W (s - true s) of a response s has covariance I.

    The covariance follows from responses, (1 + DRAWS, N). An error of FLOOR times the largest value
    is added to the covariance. W is 0 for the responses of a constant output.
    """
    values, vectors = np.linalg.eigh(np.atleast_2d(np.cov(responses[1:].T)))
    floor = (FLOOR * np.max(np.abs(responses[0]))) ** 2 + RANK * values[-1]
    deviations = np.sqrt(np.maximum(values, 0.0) + floor)
    return np.asarray(vectors.T / np.where(deviations > 0.0, deviations, np.inf)[:, None])


class _Curve(NamedTuple):
    """A fitted step response; theta is delay, lag, Omega, damping, stiffness, slow part."""

    theta: FloatArray
    free: tuple[int, ...]  # 1 for each entry of theta that is fitted, else 0
    # sum of the squares of the whitened residuals and of theta / SPREAD
    chi_squared: float
    jacobian: FloatArray


def _search(
    t: FloatArray,
    whiten: FloatArray,
    step: FloatArray,
    size: float,
    free: tuple[int, ...],
    start: FloatArray | None,
) -> _Curve:
    """Fit the free entries of theta by least squares, with the prior SPREAD around 0.

    `step` is the response divided by `size`, its largest value. The search starts from several
    delays and lags, and from `start`.
    """
    fitted = np.array(free, dtype=bool)

    def expanded(theta: FloatArray) -> FloatArray:
        values = np.zeros(len(free))
        values[fitted] = theta
        return values

    def residuals(theta: FloatArray) -> FloatArray:
        delay, lag, Omega, damping, stiffness, slow = expanded(theta)
        first, second = second_order_response(t, delay, lag, damping, stiffness)
        return np.concatenate(
            [size * (whiten @ (Omega * first + slow * second - step)), theta / SPREAD[fitted]]
        )

    # Start at each pair of delay and lag, with a damping of 2 1/s, no stiffness, no slow part, and
    # Omega by least squares.
    starts = [] if start is None else [start]
    for delay in STARTS_DELAY:
        for lag in STARTS_LAG:
            first, _ = second_order_response(t, delay, lag, 2.0, 0.0)
            weighted = whiten @ first
            slope = float(weighted @ whiten @ step) / max(
                float(weighted @ weighted), np.finfo(float).tiny
            )
            starts.append(np.array([delay, lag, slope, 2.0, 0.0, 0.0]))
    bounds = LOWER[fitted], UPPER[fitted]
    # Take the best end of all starts.
    best: Any = min(
        (
            least_squares(
                residuals,
                np.clip(start[fitted], *bounds),
                bounds=bounds,
                x_scale=SCALE[fitted],
                ftol=TOLERANCE,
            )
            for start in starts
        ),
        key=lambda fit: float(fit.cost),
    )
    jacobian = np.zeros((len(best.fun), len(free)))
    jacobian[:, fitted] = best.jac
    return _Curve(expanded(best.x), free, 2.0 * float(best.cost), jacobian)
