# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Predict the tracking error of a linear loop: along a manoeuvre, and in wind with noise."""

import math
from typing import NamedTuple

import numpy as np

from flight_analysis.linear_loop.loop_margins import LinearLoop
from flight_core.vectors import FloatArray
from flight_design.gains.ideal_control import STEP
from rise_di_controller.law.linear_loop import (
    LinearLaw,
    LinearPlant,
    LoopTiming,
    closed_loop,
    sampled_plant,
    zero_order_hold,
)

HORIZON = 20.0  # s, duration of turbulence and noise: longer than the slowest mode that counts
GUST_HORIZON = 8.0  # s, time for which the response to a gust counts
FLIGHT = 60.0  # s, length of a flight with a gust on each axis, over which the errors are averaged
TURBULENT = 0.5  # weight of errors in turbulence, which are about twice those in gusts
MEAN = math.sqrt(2.0 / math.pi)  # mean magnitude of a normal value, in standard deviations

GUST_TIME = 0.6  # s, time from the entry of a gust to its peak
GUST_LENGTHS = (9.1, 106.7)  # m, from the entry to the peak, CS 25.341 (a)(3): 30 to 350 ft
REFERENCE_GUST = 17.07  # m/s, at 106.7 m and sea level, CS 25.341 (a)(5): 56 ft/s


class Air(NamedTuple):
    """The wind that acts on a loop, and the noise of its measurements.

    The turbulence on each of G axes is a first-order process with a time constant and a standard
    deviation. Each axis also has a 1-cosine gust with a duration and a peak. A peak of 0 means no
    gust.
    """

    wind: FloatArray  # (n, G) effect of 1 m/s on x_dot
    # (m + k, G) effect of 1 m/s on the m outputs and k vanes, of which only vanes feel the wind
    reading: FloatArray
    time: FloatArray  # (G,) time constant of the turbulence, s
    sigma: FloatArray  # (G,) standard deviation of the turbulence, m/s
    noise: FloatArray  # (m + k,) rms per sample of the measurements, SI
    gust: FloatArray  # (G,) peaks, m/s
    gust_duration: float  # s


def discrete_gust(speed: float) -> tuple[float, float]:
    """Return the peak, m/s, and the duration, s, of a 1-cosine gust at a speed, m/s.

        U = REFERENCE_GUST (H / 106.7 m)^(1/6),  H = GUST_TIME speed within GUST_LENGTHS

    U is the peak, and H is the distance from the entry to the peak. Source: CS 25.341 (a), without
    the alleviation factor.
    """
    length = min(max(GUST_TIME * speed, GUST_LENGTHS[0]), GUST_LENGTHS[1])
    peak = REFERENCE_GUST * (length / GUST_LENGTHS[1]) ** (1.0 / 6.0)
    return peak, 2.0 * length / speed


class AirResponse(NamedTuple):
    """The error and the activity of a loop in wind and noise."""

    # (m,) rms of the outputs in gusts plus TURBULENT times their rms in turbulence, SI
    error: FloatArray
    activity: FloatArray  # (m,) mean abs(u_dot) in turbulence, SI


def air_response(plant: LinearPlant, law: LinearLaw, loop: LoopTiming, air: Air) -> AirResponse:
    """Compute the response of a stable loop to gusts, and to turbulence with noise.

    The response to turbulence begins at rest and lasts HORIZON.

        z+ = A z + N n,  P+ = A P A' + N N',  n white with unit variance

    z is the state of the loop and P its covariance. P after 2^j periods follows from P after
    2^(j-1) periods. n contains the noise of the measurements. The response to gusts is without
    noise.
    """
    none = np.zeros(len(loop.lag))
    matrix = closed_loop(plant, law, loop, none)
    _, B, C_sampled = sampled_plant(plant, loop, none)
    _, drive = zero_order_hold(plant.A, air.wind, loop.period)
    n = len(plant.A)
    size = len(matrix)
    C = plant.C[: len(loop.lag)]
    noise_input = np.vstack([B @ law.D, law.B])
    blown = noise_input @ air.reading
    blown[:n] += drive
    noise = noise_input * air.noise
    covariance, transition = _turbulent(matrix, blown, noise, loop.period, air)
    variance = np.einsum("ij,jk,ik->i", C, covariance[:n, :n], C)
    # u = K z + D v with the noise v. `after` is the covariance of z one tick later with u, and
    # twice `step` is the mean square of the change of u in a tick.
    K = np.hstack([law.D @ C_sampled, law.C, law.D @ air.reading])
    direct = law.D * air.noise
    after = transition @ covariance @ K.T
    after[:size] += noise @ direct.T
    step = (K @ covariance * K).sum(axis=1) + (direct**2).sum(axis=1) - (K * after.T).sum(axis=1)
    activity = MEAN * np.sqrt(2.0 * np.maximum(step, 0.0)) / loop.period
    gusts = np.sqrt(_gust_energy(matrix, blown * air.gust, C, loop.period, air) / FLIGHT)
    return AirResponse(gusts + TURBULENT * np.sqrt(np.maximum(variance, 0.0)), activity)


def _gust_energy(
    matrix: FloatArray, response: FloatArray, C: FloatArray, period: float, air: Air
) -> FloatArray:
    """Return the integral of the square of each output in a gust, shape (m,).

    The gusts on the axes come one at a time, and their integrals are summed.
    """
    state = np.zeros(response.shape)
    energy = np.zeros(len(C))
    for k in range(round(GUST_HORIZON / period)):
        turn = 2.0 * np.pi * (k + 0.5) * period / air.gust_duration
        state = matrix @ state
        if turn < 2.0 * np.pi:
            state += response * (0.5 * (1.0 - math.cos(turn)))
        energy += ((C @ state[: C.shape[1]]) ** 2).sum(axis=1)
    return energy * period


def _turbulent(
    matrix: FloatArray, blown: FloatArray, noise: FloatArray, period: float, air: Air
) -> tuple[FloatArray, FloatArray]:
    """Return the covariance of a loop's state in turbulence and noise, and its transition matrix.

    In the extended state, the wind comes after the state of the loop.
    """
    size, G = blown.shape
    decay = np.exp(-period / air.time)
    transition = np.zeros((size + G, size + G))
    transition[:size, :size] = matrix
    transition[:size, size:] = blown
    transition[size:, size:] = np.diag(decay)
    drive = np.zeros((size + G, noise.shape[1] + G))
    drive[:size, : noise.shape[1]] = noise
    drive[size:, noise.shape[1] :] = np.diag(air.sigma * np.sqrt(1.0 - decay**2))
    covariance = drive @ drive.T
    power = transition
    for _ in range(round(math.log2(HORIZON / period))):
        covariance = covariance + power @ covariance @ power.T
        power = power @ power
    return covariance, transition


def linear_error(loop: LinearLoop, u_dot: FloatArray) -> FloatArray:
    """Compute the rms of e of the nominal linear loop along a manoeuvre, (..., m), SI.

    The ideal control u* keeps y on y_m, but the loop must produce u* by feedback. So e is the
    response of the loop to the disturbance -u* at the input of the aircraft, starting from trim.
    `u_dot`, (T, m), is the rate of u* every STEP, with the inputs in the law's order. If the loop
    has several laws, the result has the leading axes of their matrices.
    """
    period = loop.loop.period
    u = np.concatenate(
        [np.zeros((1, u_dot.shape[1])), np.cumsum((u_dot[1:] + u_dot[:-1]) / 2.0 * STEP, axis=0)]
    )
    t = period * (np.arange(int((len(u) - 1) * STEP / period)) + 0.5)
    u_by_tick = np.array([np.interp(t, STEP * np.arange(len(u)), column) for column in u.T]).T
    step = closed_loop(loop.nominal, loop.law, loop.loop, np.zeros(u.shape[1]))
    _, drive = zero_order_hold(loop.nominal.A, loop.nominal.B, period)
    n = len(loop.nominal.A)
    state = np.zeros((*step.shape[:-1], 1))
    x = np.empty((len(t), *step.shape[:-2], n))
    for k, disturbance in enumerate(-(u_by_tick @ drive.T)):
        state = step @ state
        state[..., :n, 0] += disturbance
        x[k] = state[..., :n, 0]
    return np.asarray(np.sqrt(np.mean((x @ loop.nominal.C.T) ** 2, axis=0)))
