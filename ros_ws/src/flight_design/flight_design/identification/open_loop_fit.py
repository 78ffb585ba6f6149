# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Fit a low-order model to each channel of a log in which the inputs were excited one by one.

    lag v_dot = u(t - delay) - v,    z'' + damping z' + stiffness z = v,    y = Omega z' + slow z

The excitation is open loop. The output error is minimised: the model is simulated from u alone, and
the squares of y minus its output are summed. Without stiffness, lag and 1 / damping can change
places in the response. The lag is then the smaller of the two, which belongs to the faster pole.
Source: L. Ljung, "System Identification", 1999, 4.2 and 10.2.

Thrust also moves the airspeed through the climb that it causes, which is the phugoid. If the climb
is measured, the model of V excludes the phugoid:

    V_dot = -damping V + Omega v - g climb / speed

Source: B. Etkin, L. D. Reid, "Dynamics of Flight", 1996, 4.9 (the X equation along the flight
path).
"""

from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from flight_core.rates import NANOSECONDS
from flight_core.tape import Signal
from flight_core.vectors import FloatArray
from flight_design.identification.response_identification import BRIDGED

STEP = 0.004  # s, step of the simulation
# s; samples from this long before the excitation of an input to this long after it are used, too
BEFORE = 0.3
AFTER = 0.5
MIN_CERTAINTY = 5.0  # an estimate is certain if it is at least this many standard errors
# Frequency at which gain and phase have to be certain, as a multiple of 1 / (delay + lag). It is
# about the crossover frequency of the loops of `rise-di gains`.
LOOP_FREQUENCY = 0.5
MAX_ZERO_LAG = 0.5  # largest product of zero and lag; at 1 zero and lag would cancel
# 1/s, fastest zero that a feedforward of 100 Hz follows (rise_di_controller.params, _check_nominal)
FASTEST_ZERO = 25.0
# A second-order model is taken if its misfit is below this fraction of the first-order model's.
# Noise alone does not cause such a fraction in 10 s.
LARGEST_MISFIT_RATIO = 0.85
# Starts of the search: delay s, lag s, damping 1/s, stiffness 1/s^2 and zero 1/s. They are a
# short-period or Dutch roll mode of a transport, the same mode behind slow servos, and such a mode
# of a model aircraft.
STARTS = ((0.03, 0.03, 5.0, 30.0, 6.0), (0.1, 0.1, 5.0, 30.0, 6.0), (0.03, 0.01, 30.0, 400.0, 1.0))
# Bounds of delay s, lag s, Omega, damping 1/s, stiffness 1/s^2, slow.
LOWER = np.array([0.0, 0.003, -np.inf, 0.0, 0.0, -np.inf])
UPPER = np.array([0.4, 1.0, np.inf, 120.0, 3000.0, np.inf])
ORDERS = (4, 6)  # numbers of parameters of the models of first and of second order
SETTLED = 2.0  # s after a gap, until the response to the unknown u in it has decayed
CORRELATION = 0.5  # s over which errors of neighbouring samples count as correlated


class Estimate(NamedTuple):
    """A value and its standard error."""

    value: float
    deviation: float

    @property
    def is_certain(self) -> bool:
        """Whether the value is at least MIN_CERTAINTY times its standard error."""
        return self.value >= MIN_CERTAINTY * self.deviation


class ChannelModel(NamedTuple):
    """The model of a channel, SI, and the covariance of its parameters in the fields' order."""

    delay: float  # s
    lag: float  # s
    Omega: float
    damping: float  # 1/s
    stiffness: float  # 1/s^2; 0 if the first order is enough
    slow: float
    covariance: FloatArray  # (6, 6)
    misfit: float  # rms of the output error divided by the rms of y without its trend

    @property
    def is_usable(self) -> bool:
        """Whether the model can be used to select gains and to design a feedforward.

        Gain and phase of the loop must be certain, and a feedforward must be able to follow the
        zero. A model can be usable even if the noise is as large as y.
        """
        gain, phase = self.at_loop_frequency()
        is_certain = gain.is_certain and phase.deviation <= 1.0 / MIN_CERTAINTY
        return is_certain and 0.0 <= self.slow / self.Omega <= FASTEST_ZERO

    def at_loop_frequency(self) -> tuple[Estimate, Estimate]:
        """Return abs(y / u) and the phase lag of y behind u, rad, at LOOP_FREQUENCY.

        Omega, damping, lag and delay can compensate each other in a fit. So each of them may be
        uncertain while gain and phase, which the loop needs, are certain.
        """
        theta = np.array(self[:6])
        s = 1j * LOOP_FREQUENCY / (self.delay + self.lag)

        def logarithm(theta: FloatArray) -> complex:
            delay, lag, Omega, damping, stiffness, slow = theta
            ratio = (
                (abs(Omega) * s + np.sign(Omega) * slow)
                / (s**2 + damping * s + stiffness)
                / (lag * s + 1.0)
            )
            return complex(np.log(ratio) - s * delay)

        steps = 1e-6 * np.maximum(np.abs(theta), 1e-3)
        slope = np.array(
            [logarithm(theta + step) - logarithm(theta - step) for step in np.diag(steps)]
        ) / (2.0 * steps)
        gain, phase = (
            float(np.sqrt(part @ self.covariance @ part)) for part in (slope.real, slope.imag)
        )
        log_ratio = logarithm(theta)
        return Estimate(
            float(np.exp(log_ratio.real)), gain * float(np.exp(log_ratio.real))
        ), Estimate(-log_ratio.imag, phase)


def fit_channel(
    y: Signal,
    u: Signal,
    output: str,
    name: str,
    sign: float,
    gravity: Signal | None = None,
    *,
    first_order: bool = False,
) -> ChannelModel | None:
    """Fit a channel's model to the samples of its excitation, with the lowest sufficient order.

    Returns None if there is no excitation, or if the output is constant. The search begins with an
    Omega of the sign `sign`, and may end with the opposite sign. `gravity` is a channel that
    measures the part of y_dot that gravity causes. With `gravity` or `first_order`, the model is of
    first order.
    """
    # Take the time of the excitation, and a little before and after it.
    excited = np.flatnonzero(u[name] != 0.0)
    if not len(excited):
        return None
    first = int(u.stamp_ns[excited[0]] - BEFORE * NANOSECONDS)
    last = int(u.stamp_ns[excited[-1]] + AFTER * NANOSECONDS)
    y_of_channel = y.within([(first, last)])
    is_settled = _is_settled(y_of_channel.stamp_ns / NANOSECONDS)
    measured = y_of_channel[output][is_settled]
    if not len(measured) or not np.ptp(measured):
        return None
    t = (y_of_channel.stamp_ns[is_settled] - first) / NANOSECONDS
    t_u = (u.stamp_ns - first) / NANOSECONDS
    # u and gravity are resampled by their integrals, so that no short pulse is lost.
    impulse = np.concatenate([[0.0], np.cumsum(u[name][:-1] * np.diff(t_u))])
    trend = [np.ones(len(t)), t]
    if gravity is not None:
        t_g = (gravity.stamp_ns - first) / NANOSECONDS
        gained = np.concatenate([[0.0], np.cumsum(gravity.values[:-1, 0] * np.diff(t_g))])

    def response(theta: FloatArray) -> FloatArray:
        """Return the response of the model to u, plus the response to gravity."""
        to_u = _simulated(t, t_u, impulse, np.concatenate([theta, np.zeros(6 - len(theta))]))
        if gravity is None:
            return to_u
        return to_u + _simulated(t, t_g, gained, np.array([0.0, LOWER[1], 1.0, theta[3], 0.0, 0.0]))

    def residuals(theta: FloatArray) -> FloatArray:
        decay = [] if gravity is None else [_decay(t, theta[3])]
        q, _ = np.linalg.qr(np.stack(trend + decay, axis=1))
        e = measured - response(theta)
        return np.asarray(e - q @ (q.T @ e))

    # A model of second order must lower the misfit.
    orders = ORDERS[:1] if first_order or gravity is not None else ORDERS
    values = residuals(np.array([0.0, 1.0, 0.0, 0.0]))
    fits = [
        _search(residuals, values, order, sign * float(np.max(np.abs(u[name])))) for order in orders
    ]
    misfits = [float(np.linalg.norm(fit.fun) / np.linalg.norm(values)) for fit in fits]
    chosen = (
        1
        if misfits[-1] < LARGEST_MISFIT_RATIO * misfits[0] and _has_zero_of_its_own(fits[-1].x)
        else 0
    )
    return _model(fits[chosen], misfits[chosen], float(np.median(np.diff(t))))


def _is_settled(t: FloatArray) -> NDArray[np.bool_]:
    """Return the mask (N,) of the samples that come at least SETTLED s after each long gap."""
    if len(t) < 2:
        return np.ones(len(t), dtype=bool)
    gaps = np.diff(t)
    ends = np.concatenate([[-np.inf], t[1:][gaps > BRIDGED + np.median(gaps)]])
    return np.asarray(t - ends[np.searchsorted(ends, t, side="right") - 1] >= SETTLED)


def _decay(t: FloatArray, damping: float) -> FloatArray:
    """Return (exp(-d t) - 1 + d t) / d^2 at the times t with d = `damping`, or t^2 / 2 for d = 0.

    With a constant and t, it can represent the decay exp(-d t) of an initial value.
    """
    x = damping * t
    return np.where(x > 1e-4, (np.expm1(-x) + x) / max(damping, 1e-9) ** 2, 0.5 * t**2)


def _has_zero_of_its_own(theta: FloatArray) -> bool:
    """Return whether the zero of a second-order model is stable and does not cancel the lag.

    The zero cancels the lag if it is about as fast as the lag.
    """
    _, lag, Omega, _, _, slow = theta
    return bool(0.0 <= slow * Omega * lag <= MAX_ZERO_LAG * Omega**2)


def _simulated(
    t: FloatArray, t_u: FloatArray, impulse: FloatArray, theta: FloatArray
) -> FloatArray:
    """Return the output of the model at the instants t, (N,), starting at rest.

    `impulse` is the integral of u at the instants t_u.
    """
    delay, lag, Omega, damping, stiffness, slow = theta
    grid = np.arange(0.0, t[-1] + 2.0 * STEP, STEP)
    u = np.diff(np.interp(grid - delay, t_u, impulse)) / STEP
    A = np.array([[0.0, 1.0, 0.0], [-stiffness, -damping, 1.0], [0.0, 0.0, -1.0 / lag]])
    from scipy.signal import cont2discrete, lfilter, ss2tf  # noqa: PLC0415 - half a second

    plant = (
        A,
        np.array([[0.0], [0.0], [1.0 / lag]]),
        np.array([[slow, Omega, 0.0]]),
        np.zeros((1, 1)),
    )
    numerator, denominator = ss2tf(*cont2discrete(plant, STEP)[:4])
    return np.asarray(np.interp(t, grid[:-1], lfilter(numerator[0], denominator, u)))


def _search(residuals: Any, values: FloatArray, order: int, amplitude: float) -> Any:
    size = float(np.ptp(values)) / amplitude
    scale = np.array([0.05, 0.05, 5.0 * abs(size), 10.0, 100.0, 50.0 * abs(size)])[:order]
    bounds = LOWER[:order], UPPER[:order]
    search = partial(least_squares, residuals, bounds=bounds, x_scale=scale, max_nfev=60)
    fits = []
    for delay, lag, damping, stiffness, zero in STARTS:
        Omega = damping * size
        start = np.array([delay, lag, Omega, damping, stiffness, zero * Omega])
        fits.append(search(start[:order]))
    best = min(fits, key=lambda fit: float(fit.cost))
    if order == ORDERS[0] and best.x[1] * best.x[3] > 1.0:
        delay, lag, Omega, damping = best.x
        # With the lag and 1 / damping exchanged, the response is the same.
        best = search(np.array([delay, 1.0 / damping, Omega / (lag * damping), 1.0 / lag]))
    return best


def _model(fit: Any, misfit: float, period: float) -> ChannelModel:
    """Convert a fit to the model of a channel.

    Its standard errors are larger if the errors are correlated in time. Source: L. Ljung, 9.4
    (coloured errors).
    """
    e = fit.fun
    lags = max(round(CORRELATION / period), 1)
    rho = np.correlate(e, e, "full")[len(e) : len(e) + lags] / (e @ e)
    inflation = 1.0 + 2.0 * float(np.sum(np.maximum(rho, 0.0)))
    J = fit.jac
    covariance = np.zeros((6, 6))
    variance = float(e @ e) / (len(e) - len(fit.x)) * inflation
    covariance[: len(fit.x), : len(fit.x)] = variance * np.linalg.pinv(J.T @ J)
    delay, lag, Omega, damping, stiffness, slow = np.concatenate(
        [fit.x, np.zeros(6 - len(fit.x))]
    ).tolist()
    return ChannelModel(
        delay=delay,
        lag=lag,
        Omega=Omega,
        damping=damping,
        stiffness=stiffness,
        slow=slow,
        covariance=covariance,
        misfit=misfit,
    )
