# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Run the observer's Kalman filter over a recorded flight, for many models side by side.

y and u have equal periods. The filters give the innovations of the models.
"""

from collections.abc import Iterable, Sequence
from functools import partial
from itertools import product
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse.csgraph import connected_components

from aircraft_sim.airframes.airframe import Airframe
from aircraft_sim.atmosphere.disturbance import AXES, ROTARY
from aircraft_sim.atmosphere.turbulence import MODERATE, dryden, roll_gust
from control_laws import observer_design
from control_laws.nominal_model import NominalModel
from control_laws.observer_design import Correction, Names, ObserverModel, Weights
from control_laws.riccati import correction_of, corrections_near
from flight_core.parameters import require, require_channels
from flight_core.rates import NANOSECONDS
from flight_core.tape import Tape
from flight_core.units import unit_sizes
from flight_core.vectors import FloatArray
from flight_design.gains.nominal import airframe_model
from flight_design.identification.output_filter import (
    behind_filter,
    filtered_correction,
    kept_share,
)
from rise_di_controller.law.linear_loop import LoopTiming

# s at the start of a recording whose innovations do not count, because the filter starts from y
# alone.
TRANSIENT = 0.5
MOST_GAPS = 10.0  # largest ratio of the length of a log, with its gaps, to the time that has a u
# Noises of the filter other than the wind, as in `observer_design.Weights`. They are small.
DRIFT = 0.003
LOOSE = 1.5e-4
# Least noise of y in the filter, as a share of 1 m/s or 0.1 rad/s. Even with a perfect sensor the
# model leaves something out.
MIN_NOISE = 1e-2
LEAK = 1e-3  # factor on observer_design.LEAK, because the filter must keep its angles for minutes
HOLD = 5  # periods of a block, over which sin(x) - x is held, because it changes slowly
# s, time constants with which the rate of a gust and the change of this rate decay
GUST_TIME = 0.5
RATE_TIME = 0.2
# m/s^3 per root s, negligible noise of the change of the rate, for a level without gusts
LEAST_RATE = 1e-4
LEVELS = np.array(
    [(strength, 0.0, 0.0) for strength in (0.002, 0.03, 0.1, 0.3, 1.0, 3.0)]
    + [(strength, 0.0, strength) for strength in (0.1, 0.3, 1.0, 3.0)]
    + [(0.03, strength, 0.0) for strength in (20.0, 40.0, 80.0, 160.0, 320.0)]
)
"""Winds of the filter, one row for each level, from calm air to gusts.

The columns are the noise of the wind relative to moderate turbulence, the noise of the change of
its rate, m/s^3 per root s, and the noise of the rotary gust relative to moderate turbulence. A gust
is smooth, so its noise acts on the change of the rate. If it acted on the wind or on the rate, the
model would have gusts as fast as the inputs, and the effects of the inputs would come out too weak.
"""


SHEARED = ("alpha", "q")
"""States that the slope of the vertical wind moves."""


class FlightData(NamedTuple):
    """A flight of T equal periods as deviations from trim, channels in the airframe's order."""

    period: float  # s
    t: FloatArray  # (T,) flight time, s
    y: FloatArray  # (T, m), NaN where a sample was lost
    u: FloatArray  # (T, m) as the actuators received it


def coarser(recorded: FlightData, factor: int) -> FlightData:
    """Average a flight over groups of `factor` periods.

    Each y is the mean over a group, and stands for the middle of the group. A u acts from one
    sample of y to the next, so each u is the mean from this middle to the next middle.
    """
    count = len(recorded.t) // factor
    leads = [
        np.concatenate([recorded.u[k:], np.repeat(recorded.u[-1:], k, axis=0)])
        for k in ((factor - 1) // 2, factor // 2)
    ]
    t, y, u = (
        values[: count * factor].reshape(count, factor, *values.shape[1:]).mean(axis=1)
        for values in (recorded.t, recorded.y, (leads[0] + leads[1]) / 2.0)
    )
    return FlightData(factor * recorded.period, t, y, u)


class Actuation(NamedTuple):
    """The lags, the delay and the rate limits between u and the aircraft."""

    lag: FloatArray  # (m,) time constants of the actuators in the airframe's order, s
    delay: float  # s
    rate_limit: FloatArray | None = None  # (m,) units of u / s; None if no actuator has a limit


def recording(tape: Tape, airframe: Airframe) -> FlightData:
    """Return y and u of a tape at the rate of u, beginning with the first u.

    At each instant y is the nearest sample, within half a period, and u is the last sample. Raises
    ParameterError if the log lacks a channel of the airframe, is shorter than ten times TRANSIENT,
    or has more gaps than MOST_GAPS allows.
    """
    y = tape["y"]
    u = tape["u"]
    for topic, names, expected in (
        ("y", y.names, airframe.outputs),
        ("u", u.names, tuple(airframe.inputs)),
    ):
        require_channels(
            f"topic {topic}", names, expected, f"the channels of the airframe {airframe.name}"
        )
    require(
        len(u.stamp_ns) > 1 and len(y.stamp_ns) > 1,
        "the log",
        f"{len(u.stamp_ns)} samples of u",
        "a flight",
    )
    period_ns = round(float(np.median(np.diff(u.stamp_ns))))
    require(period_ns > 0, "topic u", "samples with equal stamps", "one a period")
    end_ns = min(u.stamp_ns[-1], y.stamp_ns[-1])
    seconds = (end_ns - u.stamp_ns[0]) / NANOSECONDS
    length = len(u.stamp_ns) * period_ns / NANOSECONDS
    require(
        seconds < MOST_GAPS * length,
        "the log",
        f"{length:.3g} s of u in {seconds:.3g} s",
        "a log without long gaps",
    )
    instants = np.arange(u.stamp_ns[0], end_ns + 1, period_ns)
    seconds = len(instants) * period_ns / NANOSECONDS
    require(
        seconds > 10.0 * TRANSIENT,
        "the log",
        f"{seconds:.3g} s with y and u",
        f"more than {10.0 * TRANSIENT:g} s",
    )
    after = np.clip(np.searchsorted(y.stamp_ns, instants), 1, len(y.stamp_ns) - 1)
    nearest = after - (instants - y.stamp_ns[after - 1] <= y.stamp_ns[after] - instants)
    is_lost = 2 * np.abs(y.stamp_ns[nearest] - instants) > period_ns
    y_rows = np.stack([y[name] for name in airframe.outputs], axis=1)[nearest]
    y_rows[is_lost] = np.nan
    places = np.searchsorted(u.stamp_ns, instants + period_ns // 2, side="right") - 1
    commanded = np.stack([u[name] for name in airframe.inputs], axis=1)[places]
    return FlightData(
        period_ns / NANOSECONDS, (instants - tape.start_ns) / NANOSECONDS, y_rows, commanded
    )


def filter_model(airframe: Airframe, actuation: Actuation, recorded: FlightData) -> NominalModel:
    """Return the model with which the filter of an airframe predicts, in the airframe's order."""
    noise = measured_noise(recorded.y, airframe.matrix_c() @ unit_sizes(airframe.states.values()))
    loop = LoopTiming(actuation.lag, actuation.delay, recorded.period)
    return airframe_model(airframe, airframe.outputs, tuple(airframe.inputs), noise, loop)


def delayed(u: FloatArray, periods: float) -> FloatArray:
    """Return u, (T, m), delayed by a number of periods.

    If the number is not whole, the result is the mean of u over each period.
    """
    full_periods = int(periods)
    part = periods % 1.0
    late = np.concatenate([np.repeat(u[:1], full_periods + 1, axis=0), u])
    return np.asarray((1.0 - part) * late[1 : len(u) + 1] + part * late[: len(u)])


def measured_noise(y: FloatArray, size: FloatArray) -> FloatArray:
    """Estimate the noise of each channel from the third differences of y, (T, m), rms per sample.

    The variance of the third differences is 20 times the variance of the noise. If y is rounded to
    steps larger than its noise, y often stays the same, and the differences do not show the noise.
    So the result is at least the rms error of rounding, step / sqrt(12), where the step is the
    least change of y. It is also at least MIN_NOISE times `size`, the unit of the channel.
    """
    third = np.diff(y, n=3, axis=0)
    # 0.6745 sigma is the median magnitude of a normal value
    spread = np.nanmedian(np.abs(third), axis=0) / 0.6745
    change = np.abs(np.diff(y, axis=0))
    step = np.min(change, axis=0, where=change > 0.0, initial=np.inf)
    rounding = np.where(np.isfinite(step), step, 0.0) / np.sqrt(12.0)
    return np.asarray(np.maximum.reduce([spread / np.sqrt(20.0), rounding, MIN_NOISE * size]))


class FilterBank(NamedTuple):
    """Stationary Kalman filters of N models at each level of the wind."""

    sampled: ObserverModel  # Phi (N, 1, s, s) and Gamma (N, 1, s, m) of s states
    L: FloatArray  # (N, levels, s, m)
    covariance: FloatArray  # (N, levels, m, m) covariance of the innovations
    gravity: FloatArray  # (n, n)
    period: float  # s

    def by_level(self) -> "FilterBank":
        """Return a bank that has one filter of the first model for each level of the wind.

        In this bank the levels of the wind are along the axis of the models.
        """
        levels = self.L.shape[1]
        Phi, Gamma = (
            np.repeat(matrix[:1], levels, axis=0)
            for matrix in (self.sampled.Phi, self.sampled.Gamma)
        )
        sampled = self.sampled._replace(Phi=Phi, Gamma=Gamma)
        return self._replace(
            sampled=sampled,
            L=np.swapaxes(self.L[:1], 0, 1),
            covariance=np.swapaxes(self.covariance[:1], 0, 1),
        )

    def lifted(self, level: int, seen: Sequence[bool]) -> FloatArray:
        """Return the linear map of HOLD periods of each filter, (N, HOLD m + s, ..).

        The map takes z, the y and u of the periods, and sin(x) - x, stacked in this order. It gives
        the innovations r of the periods and then the z after them. `seen` says in which periods y
        was received.
        """
        H = self.sampled.H
        Phi = self.sampled.Phi[:, 0]
        Gamma = self.sampled.Gamma[:, 0]
        L = self.L[:, level]
        (m, s), angles = H.shape, np.flatnonzero(self.gravity.any(axis=0))
        z = np.zeros((len(Phi), s, s + 2 * HOLD * m + len(angles)))
        z[:, :, :s] = np.eye(s)
        rows = []
        for j in range(HOLD):
            r = -H @ z
            r[:, np.arange(m), s + j * m + np.arange(m)] += 1.0
            z = Phi @ (z + L @ r if seen[j] else z)
            z[:, :, s + (HOLD + j) * m : s + (HOLD + j + 1) * m] += Gamma
            z[:, : len(self.gravity), s + 2 * HOLD * m :] += self.period * self.gravity[:, angles]
            rows.append(r)
        return np.concatenate([*rows, z], axis=1)


class Passage:
    """A run of the filters of a bank over a flight.

        r = y - H z,  z+ = Phi (z + L r) + Gamma u + period gravity (sin(x) - x)

    y has the shape (T, m). u has the shape (T, m), or (N, T, m) if it differs between the N models.
    If y is lost, r does not correct z. The flight is a sequence of blocks of HOLD periods, and
    `level` has the level of the wind in each block. sin(x) - x is held over a block, so that a
    block is linear. Blocks with the same level and the same lost samples share a matrix.
    """

    def __init__(
        self, bank: FilterBank, y: FloatArray, u: FloatArray, level: NDArray[np.int64]
    ) -> None:
        (T, m), (N, _, s, _), blocks = y.shape, bank.L.shape, len(level)
        self._angles = np.flatnonzero(bank.gravity.any(axis=0))
        # Fill the last block with lost samples.
        short = blocks * HOLD - T
        self._shape = (N, m, s)
        y = np.vstack([y, np.full((short, m), np.nan)])
        u = np.concatenate([u, np.zeros((*u.shape[:-2], short, m))], axis=-2)
        self._seen: NDArray[np.bool_] = np.asarray(np.isfinite(y).all(axis=1))
        known = np.where(self._seen[:, None], y, 0.0).reshape(blocks, HOLD * m).T
        u_blocks = np.swapaxes(u.reshape(*u.shape[:-2], blocks, HOLD * m), -1, -2)
        inputs = np.concatenate([np.broadcast_to(known, u_blocks.shape), u_blocks], axis=-2)
        code = level << HOLD | self._seen.reshape(blocks, HOLD) @ (1 << np.arange(HOLD))
        kinds, self._kind = np.unique(code, return_inverse=True)
        lifted = []
        for kind in kinds.tolist():
            is_seen = [bool(kind >> j & 1) for j in range(HOLD)]
            lifted.append(bank.lifted(kind >> HOLD, is_seen))
        self._forced, self._states = (
            np.empty((N, HOLD * m, blocks)),
            np.zeros((blocks + 1, N, s + len(self._angles), 1)),
        )
        state_columns = np.r_[:s, s + 2 * HOLD * m : lifted[0].shape[-1]]
        driven = slice(s, s + 2 * HOLD * m)
        # z, followed by its angles a second time, which become sin(x) - x
        following = HOLD * m + np.append(np.arange(s), self._angles)
        for k, matrix in enumerate(lifted):
            columns = np.flatnonzero(self._kind == k)
            forced = matrix[..., driven] @ inputs[..., columns]
            self._forced[..., columns] = forced[:, :-s]
            self._states[columns + 1, ..., 0] = np.moveaxis(forced[:, following], -1, 0)
        self._steps = [
            np.ascontiguousarray(matrix[:, following][..., state_columns]) for matrix in lifted
        ]
        self._outputs = [np.ascontiguousarray(matrix[:, :-s, state_columns]) for matrix in lifted]

    def run(
        self, z: FloatArray, first: int = 0, last: int | None = None
    ) -> tuple[FloatArray, FloatArray]:
        """Return the innovations in blocks `first` to `last`, (N, periods, m), and z after them.

        The filters start from z, (N, s). The innovations are NaN where y is lost.
        """
        (N, m, s), steps = self._shape, self._steps
        kind = self._kind[first:last]
        states = self._states[first : first + len(kind) + 1]
        states[0, ..., 0] = np.concatenate([z, z[:, self._angles]], axis=1)
        sine = np.empty(states[0, :, s:].shape)
        next_state = np.empty(states[0].shape)
        # This loop takes half the time of a search, so it allocates no arrays.
        for k, now, turned, following in zip(
            kind.tolist(), states[:-1], states[:-1, :, s:], states[1:], strict=True
        ):
            np.subtract(np.sin(turned, sine), turned, turned)
            np.add(following, np.matmul(steps[k], now, next_state), following)
        r = self._forced[..., first : first + len(kind)].copy()
        x = np.moveaxis(states[:-1, ..., 0], 0, -1)
        for k in np.unique(kind).tolist():
            same_kind = kind == k
            r[..., same_kind] += self._outputs[k] @ x[..., same_kind]
        r = np.moveaxis(r, -1, 1).reshape(N, len(kind) * HOLD, m)
        r[:, ~self._seen[HOLD * first : HOLD * first + r.shape[1]]] = np.nan
        return r, states[-1, :, :s, 0]


def in_rolling_air(airframe: Airframe) -> Airframe:
    """Add the rotary gust in roll to an airframe, if its span is known.

    The rotary gust in pitch follows from the vertical wind, see `filter_bank`. The rotary gust in
    yaw is small compared with the lateral wind.
    """
    return airframe if airframe.span is None else airframe.with_rotary_gusts(ROTARY[:1])


def wind_model(
    axes: Sequence[str], speed: float, span: float | None = None
) -> tuple[FloatArray, FloatArray]:
    """Return the time constants, s, and noises, m/s per root s, of first-order winds, (G,) each.

    The winds approximate Dryden's moderate turbulence: they have its spectrum at low and at high
    frequencies. With T = L / V0, Dryden's spectrum is 2 sigma^2 T / (1 + (T omega)^2) along the
    flight path, and sigma^2 T (1 + 3 (T omega)^2) / (1 + (T omega)^2)^2 across it. The rotary gust
    in roll, rad/s, comes from `roll_gust`. `speed` is V0 and `span` the wing span, both in SI.
    """
    if not axes:
        # A multicopter hovers at a speed of 0.
        return np.zeros(0), np.zeros(0)
    spectrum = dryden(**MODERATE, sigma=0.0)
    along = np.array([axis == "longitudinal" for axis in AXES])
    time = spectrum.length / speed
    noise = spectrum.sigma * np.sqrt(np.where(along, 2.0, 3.0) / time)
    constants = dict(zip(AXES, np.where(along, time, time / np.sqrt(3.0)), strict=True))
    noises = dict(zip(AXES, noise, strict=True))
    if span is not None:
        sigma, lag = roll_gust(spectrum, speed, span)
        constants["roll"] = lag
        noises["roll"] = sigma * np.sqrt(2.0 / lag)
    return np.array([constants[axis] for axis in axes]), np.array([noises[axis] for axis in axes])


class FilterAir:
    """The states of the wind in a filter, and how they move the aircraft, see `filter_bank`."""

    def __init__(
        self, names: Names, speed: float, span: float | None, shear: FloatArray | None
    ) -> None:
        self._names = names
        self._speed = speed
        self._span = span
        self._shear = shear
        self._time, self._noise = wind_model(names.winds, speed, span)
        self._is_rotary = np.array([axis in ROTARY for axis in names.winds], dtype=bool)
        self._smooth = np.flatnonzero(~self._is_rotary)
        smooth_axes = [names.winds[k] for k in self._smooth]
        self.states = (
            *(f"wind.{axis}" for axis in names.winds),
            *(f"{kind}.{axis}" for kind, axis in product(("rate", "change"), smooth_axes)),
            *("slow.vertical",) * (shear is not None),
        )

    def around(self, model: NominalModel) -> NominalModel:
        """Add the states of the winds to the models: A becomes (N, 1, s, s), and B (N, 1, s, m)."""
        (N, n, m), G = model.B.shape, model.wind.shape[-1]
        s = n + len(self.states)
        x, w, v, a, slow = np.split(np.arange(s), np.cumsum([n, G, *2 * [len(self._smooth)]]))
        A = np.zeros((N, s, s))
        B = np.zeros((N, s, m))
        gravity = np.zeros((s, s))
        A[:, x[:, None], x] = model.A
        A[:, x[:, None], w] = model.wind
        B[:, x] = model.B
        gravity[:n, :n] = model.gravity
        A[:, w, w] = -1.0 / self._time
        A[:, v, v] = -1.0 / GUST_TIME
        A[:, a, a] = -1.0 / RATE_TIME
        A[:, w[self._smooth], v] = A[:, v, a] = 1.0
        if self._shear is not None and self._span is not None:
            lag = 4.0 * self._span / (np.pi * self._speed)
            alpha, q = (self._names.states.index(name) for name in SHEARED)
            vertical = w[self._names.winds.index("vertical")]
            turning = np.stack([self._shear[:, 0], self._shear[:, 1] * model.A[:, q, q]], axis=1)
            effects = turning / (self._speed * lag)
            A[:, [alpha, q], vertical] -= effects
            A[:, [alpha, q], slow] += effects
            A[:, slow, vertical] = 1.0 / lag
            A[:, slow, slow] = -1.0 / lag
        return model._replace(
            A=A[:, None],
            B=B[:, None],
            C=np.hstack([model.C, np.zeros((m, s - n))]),
            gravity=gravity,
            wind=np.zeros((s, 0)),
            kinematic=np.concatenate([LEAK * model.kinematic, np.zeros(s - n)]),
            size=np.concatenate([model.size, np.ones(s - n)]),
        )

    def noises(self, strength: FloatArray, levels: NDArray[np.int64] | slice) -> FloatArray:
        """Return the noises of all s states at each level, (N, levels, s).

        `strength`, (N, G), multiplies the noise of each wind.
        """
        winds, changes, rolls = (LEVELS[levels, None, k] for k in range(3))
        noise = self._noise
        smooth = self._smooth
        gust = strength[:, None] * np.where(self._is_rotary, rolls, winds) * noise
        largest = np.max(noise[smooth], initial=0.0)
        change = strength[:, None, smooth] * changes * (noise[smooth] / largest)
        aircraft = np.full((*gust.shape[:2], len(self._names.states)), LOOSE)
        slow = np.zeros((*gust.shape[:2], int(self._shear is not None)))
        parts = [aircraft, gust, 0.0 * change, change + LEAST_RATE, slow]
        return np.concatenate(parts, axis=-1)


def filter_bank(
    model: NominalModel,
    names: Names,
    speed: float,
    strength: FloatArray,
    levels: NDArray[np.int64] | slice = slice(None),
    drift: float = DRIFT,
    *,
    near: bool = False,
    span: float | None = None,
    shear: FloatArray | None = None,
    lag: FloatArray | None = None,
) -> FilterBank:
    """Design the filters of models with A (N, n, n), B (N, n, m) and wind (N, n, G).

    The models hold at the trim speed V0, m/s. The state z = [x, w, v, a, ..] has the aircraft's
    state x, the wind w, the rate v of the wind in a gust, and the change a of this rate.

        w_dot = v - w / wind_time + noise,  v_dot = a - v / GUST_TIME,
            a_dot = -a / RATE_TIME + noise

    `wind_time` is the time constant of `wind_model`. A rotary gust has neither v nor a. With a
    `shear`, (N, 2), the slope of the vertical wind w along the path acts on the aircraft as a pitch
    rate q_g of the air. It acts behind the lag T = 4b / (pi V0), where b is the span.

        q_g = (w - l) / (V0 T),  l_dot = (w - l) / T
        alpha_dot -= shear_1 q_g,  q_dot -= shear_2 A[q, q] q_g

    A frozen field of wind has the shear (0, -1). MIL-F-8785C gives q_g the opposite sign, and in
    other models of the air the slope also moves alpha. The noises of the wind are the rows `levels`
    of LEVELS, multiplied by `strength`, (N, G). `drift` has the meaning that it has in
    `observer_design.Weights`. If the models are `near` the first one, their gains are computed from
    the gains of the first model, exact to first order. With a `lag`, (N,), s, the outputs reach y
    through a filter, see `behind_filter`.
    """
    air = FilterAir(names, speed, span, shear)
    m = model.B.shape[-1]
    each = air.around(model)
    sampled = observer_design.aircraft_model(
        each, names._replace(states=names.states + air.states, winds=()), np.zeros(0)
    )
    loose = air.noises(strength, levels)
    weights = Weights(
        effort=np.ones(m),
        drift=np.full(m, drift),
        gust=np.zeros(0),
        wind_time=np.zeros(0),
        loose=loose,
    )
    correction: Correction = corrections_near if near else correction_of
    if lag is not None:
        keep = kept_share(lag, model.period)
        correction = partial(filtered_correction, keep, correction)
    L = observer_design.aircraft_correction(sampled, each, weights, correction)
    if lag is not None:
        sampled = behind_filter(sampled, keep)
    # S is the covariance. L = S H'(H S H' + R)^-1, so I - H L = R (H S H' + R)^-1.
    covariance = np.linalg.solve(
        np.eye(m) - sampled.H @ L, np.broadcast_to(np.diag(model.noise**2), (*L.shape[:2], m, m))
    )
    return FilterBank(
        sampled=sampled,
        L=L,
        covariance=np.asarray(covariance),
        gravity=each.gravity,
        period=model.period,
    )


OF_INPUTS = (
    "input_scale",
    "D",
    "lag",
    "total_lag",
    "lower",
    "upper",
)  # parameters of a model that are vectors over its inputs


class Block(NamedTuple):
    """Indices of the states, channels and winds of a block.

    A block is a part of the aircraft that does not couple with the rest.
    """

    states: NDArray[np.int64]
    inputs: NDArray[np.int64]
    outputs: NDArray[np.int64]
    winds: NDArray[np.int64]

    def named(self, airframe: Airframe) -> Names:
        """Return the names of the states, channels and winds in this block."""
        every: tuple[Iterable[str], ...] = (
            airframe.states,
            airframe.inputs,
            airframe.outputs,
            airframe.gusts,
        )
        parts = (
            tuple(np.array(list(names), dtype=object)[places].tolist())
            for names, places in zip(every, self, strict=True)
        )
        return Names(*parts)

    def restricted(self, model: NominalModel) -> NominalModel:
        """Return the part of a model that belongs to this block."""
        x = self.states
        u = self.inputs
        y = self.outputs
        square = np.ix_(x, x)
        return model._replace(
            A=model.A[square],
            B=model.B[np.ix_(x, u)],
            C=model.C[np.ix_(y, x)],
            gravity=model.gravity[square],
            wind=model.wind[np.ix_(x, self.winds)],
            noise=model.noise[y],
            kinematic=model.kinematic[x],
            size=model.size[x],
            **{name: getattr(model, name)[u] for name in OF_INPUTS},
        )


def _block(parts: Sequence[NDArray[np.int32]], label: np.int32) -> Block:
    """Return the block that has a label: its states, inputs, outputs and winds."""
    return Block(*(np.flatnonzero(part == label) for part in parts))


def blocks(model: NominalModel) -> list[Block]:
    """Split an aircraft into the parts that A, gravity, B, C and the wind do not couple.

    If a part has not as many inputs as outputs, the whole aircraft is returned as one part.
    """
    (n, m), G = model.B.shape, model.wind.shape[1]
    coupled = np.zeros((n + 2 * m + G, n + 2 * m + G))
    coupled[:n] = np.hstack([model.A + model.gravity, model.B, model.C.T, model.wind]) != 0.0
    _, labels = connected_components(coupled, directed=False)
    parts = np.split(labels, [n, n + m, n + 2 * m])
    independent = [_block(parts, label) for label in np.unique(labels)]
    if all(len(block.inputs) == len(block.outputs) > 0 for block in independent):
        return independent
    return [whole_aircraft(model)]


def whole_aircraft(model: NominalModel) -> Block:
    """Return the whole aircraft as one part."""
    (n, m), G = model.B.shape, model.wind.shape[1]
    return Block(*map(np.arange, (n, m, m, G)))
