# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Simulate Dryden turbulence of MIL-F-8785C and MIL-HDBK-1797.

The module has intensities, scale lengths, and shaping filters driven by white noise. Turbulence
lies outside the theorem, because Assumption 2 requires a bounded f with a bounded derivative. A
Gaussian process has no bound. None of the three winds has a derivative either, because the filters
have one pole more than zeros.

The rotary gusts p_g, q_g, r_g act only if a scenario has `turbulence.rotary`, because they depend
on the span, which some airframe files do not state. Their effect is not small. At 100 m and for a
span of 3 m, p_g gives the `osprey` seven times the roll acceleration (rms) of v_g. q_g adds two
fifths to the pitch acceleration of w_g, and r_g adds a sixteenth in yaw. So without rotary gusts an
aircraft rolls less in turbulence than a real one.
"""

from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from aircraft_sim import random_streams
from flight_core.vectors import Array, FloatArray

FOOT = 0.3048  # m, exact
# Heights, m. The model for low altitude holds from LOWEST to LOW, and the model for high altitude
# from HIGH on. Source: MIL-F-8785C 3.7.3.4, 3.7.2.
LOWEST = 10.0 * FOOT
LOW = 1000.0 * FOOT
HIGH = 2000.0 * FOOT

HIGH_LENGTH = 1750.0 * FOOT  # m, MIL-F-8785C 3.7.2.1, Dryden form

MODERATE_WIND = 15.4
MODERATE_SIGMA = 3.05
"""Moderate turbulence, m/s: the wind W_20 of 30 kt (MIL-F-8785C 3.7.3.4) and, at high altitude, the
intensity of 10 ft/s."""

MODERATE = {"altitude": 100.0, "wind": MODERATE_WIND}  # altitude in m above the ground, wind in m/s

STATES = 5  # one state of the longitudinal filter, two of the lateral, two of the vertical filter
ROTARY_STATES = 3  # p_g divided by its intensity, and the vertical and the lateral wind behind lags
# number of steps that share a random generator, because making one takes as long as drawing
# hundreds of numbers
BLOCK = 64


class Dryden(NamedTuple):
    """Parameters of the Dryden spectra in the order longitudinal, lateral, vertical."""

    length: FloatArray  # (3,) scale lengths L of MIL-F-8785C, m
    sigma: FloatArray  # (3,) intensities: standard deviations, m/s


class Turbulence(NamedTuple):
    """Turbulence filters for the winds on G axes, discretised for one step.

    The state z has shape (s,), with s = 5, or 8 with rotary gusts. The first five states have a
    variance of at most 1.
    """

    transition: Array  # (s, s) transition matrix of a step
    spread: Array  # (s, k), lower triangular, multiplies the k = 5 or 6 normal numbers of a step
    stationary: Array  # (s, s), lower triangular root of the stationary covariance
    output: Array  # (G, s) gives the winds from the state, m/s, and rad/s for rotary gusts
    seed: int


def dryden(altitude: float, wind: float, sigma: float) -> Dryden:
    """Return lengths and intensities at an altitude h above the ground, m.

    `wind` is W_20 at 20 ft (6.1 m) above the ground, m/s: 7.7 light, 15.4 moderate, 23.1 severe
    turbulence (15, 30, 45 kt). `sigma` is the intensity at high altitude, m/s, from the
    specification's chart by altitude and exceedance.

        h <= 1000 ft    L_w = h,  L_u = L_v = h / c^1.2,  sigma_w = 0.1 W_20,
            sigma_u = sigma_v = sigma_w / c^0.4
                        with c = 0.177 + 0.000823 h / ft
        h >= 2000 ft    L_u = L_v = L_w = 1750 ft,  sigma_u = sigma_v = sigma_w = sigma
        in between      linear interpolation of L and of sigma

    Source: MIL-F-8785C, 3.7.2 and 3.7.3.4. MIL-HDBK-1797 defines L_v and L_w as half of these
    lengths, and writes 2 L in the spectra, which gives the same result. The axes along and across
    the wind are taken to be those along and across the trimmed flight.
    """
    low = min(altitude, LOW)
    c = 0.177 + 0.000823 * low / FOOT
    weight = min(max((altitude - LOW) / (HIGH - LOW), 0.0), 1.0)
    length = (1.0 - weight) * np.array([low / c**1.2, low / c**1.2, low]) + weight * HIGH_LENGTH
    intensity = (1.0 - weight) * 0.1 * wind * np.array([c**-0.4, c**-0.4, 1.0]) + weight * sigma
    return Dryden(length, intensity)


def roll_gust(spectrum: Dryden, airspeed: float, span: float) -> tuple[float, float]:
    """Return the intensity, rad/s, and the time constant, s, of the first-order gust p_g.

        Phi_p = sigma_w^2 / (L_w V0) 0.8 (pi L_w / 4b)^(1/3) / (1 + (T omega)^2),  T = 4b / (pi V0)

    `span` is b, m. Source: MIL-F-8785C, 3.7.1.2 and 3.7.4, one-sided in omega.
    """
    L = spectrum.length[2]
    T = 4.0 * span / (np.pi * airspeed)
    level = spectrum.sigma[2] ** 2 / (L * airspeed) * 0.8 * np.cbrt(np.pi * L / (4.0 * span))
    return float(np.sqrt(level * np.pi / (2.0 * T))), T


def filters(
    spectrum: Dryden,
    airspeed: float,
    dt: float,
    axes: Sequence[int],
    seed: int,
    span: float | None = None,
) -> Turbulence:
    """Build the shaping filters, discretised exactly.

    At multiples of dt the winds are distributed as in continuous time. With a = V0/L for each axis
    and white noise n of unit intensity, the filters are

        u       z_dot = -a z + sqrt(2a) n,  u = sigma z
        v, w    z1_dot = -a z1 + sqrt(2a) n,  z2_dot = a (z1 - z2),
            v = sigma/sqrt(2) (sqrt(3) z1 + (1 - sqrt(3)) z2)

    The filters have the published spectra, one-sided in omega, with T = L/V0:

        Phi_u = sigma^2 2T/pi / (1 + (T omega)^2)
        Phi_v = sigma^2 T/pi (1 + 3 (T omega)^2) / (1 + (T omega)^2)^2,  Phi_w alike

    In a step, z+ = F z + S n, with n normal and of unit variance. F is `transition`, and S is
    `spread`. For v and w these matrices follow from h = a dt. For u they have only the first entry:

        F = exp(-h) [[1, 0], [h, 1]],  S S' = [[g_1, g_2/2], [g_2/2, g_3/2]]

    Here g_k = gammainc(k, 2h), from the integrals of 2 s^(k-1) exp(-2s) from 0 to h. `stationary`
    is S for h = inf.

    `airspeed` is V0, m/s, and `dt` is in s. `axes` are the required axes as indices in AXES and
    then ROTARY. `span` is b, m, for the rotary gusts, which `_with_rotary` adds. Source:
    MIL-F-8785C, 3.7.1.2.
    """
    steps = airspeed / spectrum.length * dt
    p = np.sqrt(1.5)
    q = (1.0 - np.sqrt(3.0)) / np.sqrt(2.0)
    output = (
        np.array([[1.0, 0.0, 0.0, 0.0, 0.0], [0.0, p, q, 0.0, 0.0], [0.0, 0.0, 0.0, p, q]])
        * spectrum.sigma[:, None]
    )
    winds = Turbulence(
        transition=_axes([np.exp(-h) * np.array([[1.0, 0.0], [h, 1.0]]) for h in steps]),
        spread=_axes([_spread(h) for h in steps]),
        stationary=_axes([_spread(np.inf)] * len(steps)),
        output=np.vstack([output, np.zeros((ROTARY_STATES, STATES))]),  # no rotary gusts yet
        seed=seed,
    )
    every = winds if span is None else _with_rotary(winds, spectrum, airspeed, dt, span)
    return every._replace(output=every.output[list(axes)])


def _with_rotary(
    winds: Turbulence, spectrum: Dryden, airspeed: float, dt: float, span: float
) -> Turbulence:
    """Add the rotary gusts for a span b, m, to the filters of all axes.

        p_g of first order, `roll_gust`
        q_g = -s / V0 / (1 + T_q s) w_g,  T_q = 4b / (pi V0)
        r_g =  s / V0 / (1 + T_r s) v_g,  T_r = 3b / (pi V0)

    The air turns nose up if w_g falls along the flight, and nose right if v_g rises. The lags of
    q_g and r_g take the wind as constant over a step. Source: MIL-F-8785C, 3.7.1.2, for FRD axes.
    """
    from scipy.linalg import solve_discrete_lyapunov  # noqa: PLC0415 - slow to load, only for this

    size = STATES + ROTARY_STATES
    roll, vertical, lateral = range(STATES, size)
    sigma, T = roll_gust(spectrum, airspeed, span)
    lags = {vertical: (2, -1.0, T), lateral: (1, 1.0, 0.75 * T)}  # wind, sign, time constant
    transition = np.zeros((size, size))
    spread = np.zeros((size, STATES + 1))
    output = np.zeros((len(winds.output), size))
    transition[:STATES, :STATES] = winds.transition
    spread[:STATES, :STATES] = winds.spread
    output[:, :STATES] = winds.output
    transition[roll, roll] = np.exp(-dt / T)
    spread[roll, STATES] = np.sqrt(-np.expm1(-2.0 * dt / T))
    first_row = len(output) - ROTARY_STATES
    output[first_row, roll] = sigma
    for row, (state, (wind, sign, constant)) in enumerate(lags.items(), first_row + 1):
        decay = np.exp(-dt / constant)
        transition[state, state] = decay
        transition[state, :STATES] = (1.0 - decay) * winds.output[wind]
        output[row, :STATES] = sign / (airspeed * constant) * winds.output[wind]
        output[row, state] = -sign / (airspeed * constant)
    covariance = solve_discrete_lyapunov(transition, spread @ spread.T)
    return Turbulence(
        transition=transition,
        spread=spread,
        stationary=np.linalg.cholesky(covariance),
        output=output,
        seed=winds.seed,
    )


def initial_state(params: Turbulence) -> FloatArray:
    """Draw the state at t = 0 from the stationary distribution, shape (s,)."""
    streams = [(random_streams.TURBULENCE_START, STATES)]
    if (more := len(params.stationary) - STATES) > 0:
        streams.append((random_streams.ROTARY_START, more))
    normal = [
        random_streams.generator(0, stream, params.seed).standard_normal(count)
        for stream, count in streams
    ]
    return np.asarray(params.stationary @ np.concatenate(normal))


def normals(first: int, count: int, params: Turbulence) -> FloatArray:
    """Draw the standard normal numbers of `count` steps, beginning at `first`, shape (count, k).

    The numbers of a step depend only on the seed and on the number of the step. Rotary gusts add
    numbers, but the numbers for the three winds stay the same.
    """
    offset = first % BLOCK
    streams = [(random_streams.TURBULENCE, STATES)]
    if (more := params.spread.shape[1] - STATES) > 0:
        streams.append((random_streams.ROTARY, more))
    columns = []
    for stream, width in streams:
        blocks = [
            _block(block, params.seed, stream, width)
            for block in range(first // BLOCK, (first + count - 1) // BLOCK + 1)
        ]
        columns.append(np.concatenate(blocks)[offset : offset + count])
    return columns[0] if len(columns) == 1 else np.hstack(columns)


def step(z: Array, normal: Array, params: Turbulence) -> Array:
    """Advance the state by a step, shape (s,): transition z + spread n.

    n is standard normal, shape (k,).
    """
    return params.transition @ z + params.spread @ normal


def wind(z: Array, params: Turbulence) -> Array:
    """Return output z, shape (G,): the winds along the G axes, m/s, and rotary gusts, rad/s."""
    return params.output @ z


@lru_cache(maxsize=64)
def _block(block: int, seed: int, stream: int, width: int) -> FloatArray:
    numbers = random_streams.generator(block, stream, seed).standard_normal((BLOCK, width))
    numbers.flags.writeable = False  # because the cache returns the same array again
    return numbers


def _spread(h: float) -> FloatArray:
    from scipy.special import gammainc  # noqa: PLC0415 - takes a tenth of a second, which flights without turbulence do not need

    g_1, g_2, g_3 = gammainc([1.0, 2.0, 3.0], 2.0 * h)
    return np.linalg.cholesky(np.array([[g_1, g_2 / 2.0], [g_2 / 2.0, g_3 / 2.0]]))


def _axes(matrices: Sequence[FloatArray]) -> FloatArray:
    """Build the block diagonal of the 2 x 2 matrices of the three axes, (5, 5).

    Only the first entry of the first matrix is used.
    """
    block = np.zeros((STATES, STATES))
    block[0, 0] = matrices[0][0, 0]
    block[1:3, 1:3], block[3:, 3:] = matrices[1:]
    return block
