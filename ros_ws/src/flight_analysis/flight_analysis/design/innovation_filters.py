# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""The observer's Kalman filter over a recorded flight: y and u in equal periods, innovations of many models side by side."""

from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse.csgraph import connected_components

from aircraft_sim.airframe import Airframe
from aircraft_sim.disturbance import AXES
from aircraft_sim.turbulence import MODERATE, dryden
from control_laws import observer_design
from control_laws.nominal_model import NominalModel
from control_laws.observer_design import Names, ObserverModel, Weights
from flight_analysis.design.nominal import nominal_model, sizes
from flight_core.parameters import require, require_channels
from flight_core.rates import NANOSECONDS
from flight_core.tape import Tape
from flight_core.vectors import FloatArray
from rise_di_controller.linear_loop import Loop

TRANSIENT = 0.5  # s at the begin of a recording whose innovations do not count: the filter starts from y alone
DRIFT, LOOSE = 0.003, 1.5e-4  # noises of the filter beside the wind, as `observer_design.Weights` has them: small
MIN_NOISE = 1e-2  # 1, noise of y in the filter, in units of 1 m/s or 0.1 rad/s: what the model leaves out of a perfect sensor
LEAK = 1e-3  # 1, of observer_design.LEAK: over a minute the filter must not forget its angles
HOLD = 5  # periods for which sin(x) - x is held: it changes slowly
LEVELS = np.array([0.002, 0.03, 0.1, 0.3, 1.0, 3.0, 10.0])  # 1, strengths of the wind in the filter, from calm air to gusts


class Recording(NamedTuple):
    """A flight in T equal periods, channels in the airframe's order, deviations from trim."""

    period: float  # s
    t: FloatArray  # (T,) flight time, s
    y: FloatArray  # (T, m), NaN where a sample was lost
    u: FloatArray  # (T, m) as the actuators received it


class Actuation(NamedTuple):
    """What lies between u and the aircraft."""

    lag: FloatArray  # (m,) time constants of the actuators in the airframe's order, s
    delay: float  # s


def recording(tape: Tape, airframe: Airframe) -> Recording:
    """Y and u of a tape at the rate of u, from the first u on.

    y is the sample nearest to the instant, within half a period; u is the last one. Raises ParameterError for a log without
    the channels of the airframe, or one shorter than ten times the transient.
    """
    y, u = tape["y"], tape["u"]
    for topic, names, expected in (("y", y.names, airframe.outputs), ("u", u.names, tuple(airframe.inputs))):
        require_channels(f"topic {topic}", names, expected, f"the channels of the airframe {airframe.name}")
    require(len(u.stamp_ns) > 1 and len(y.stamp_ns) > 1, "the log", f"{len(u.stamp_ns)} samples of u", "a flight")
    period_ns = round(float(np.median(np.diff(u.stamp_ns))))
    require(period_ns > 0, "topic u", "samples with equal stamps", "one a period")
    instants = np.arange(u.stamp_ns[0], min(u.stamp_ns[-1], y.stamp_ns[-1]) + 1, period_ns)
    seconds = len(instants) * period_ns / NANOSECONDS
    require(seconds > 10.0 * TRANSIENT, "the log", f"{seconds:.3g} s with y and u", f"more than {10.0 * TRANSIENT:g} s")
    after = np.clip(np.searchsorted(y.stamp_ns, instants), 1, len(y.stamp_ns) - 1)
    nearest = after - (instants - y.stamp_ns[after - 1] <= y.stamp_ns[after] - instants)
    lost = 2 * np.abs(y.stamp_ns[nearest] - instants) > period_ns
    measured = np.stack([y[name] for name in airframe.outputs], axis=1)[nearest]
    measured[lost] = np.nan
    held = np.searchsorted(u.stamp_ns, instants + period_ns // 2, side="right") - 1
    commanded = np.stack([u[name] for name in airframe.inputs], axis=1)[held]
    return Recording(period_ns / NANOSECONDS, (instants - tape.start_ns) / NANOSECONDS, measured, commanded)


def filter_model(airframe: Airframe, actuation: Actuation, recorded: Recording) -> NominalModel:
    """The model of an airframe for its filter, channels in the airframe's order."""
    noise = measured_noise(recorded.y, airframe.matrix_c() @ sizes(airframe.states.values()))
    loop = Loop(actuation.lag, actuation.delay, recorded.period)
    return nominal_model(airframe, airframe.outputs, tuple(airframe.inputs), noise, loop)


def delayed(u: FloatArray, periods: float) -> FloatArray:
    """u, (T, m), some periods later: between two samples the mean that acts in a period."""
    whole, part = int(periods), periods % 1.0
    late = np.concatenate([np.repeat(u[:1], whole + 1, axis=0), u])
    return np.asarray((1.0 - part) * late[1 : len(u) + 1] + part * late[: len(u)])


def measured_noise(y: FloatArray, size: FloatArray) -> FloatArray:
    """Noise of each channel a sample, rms, from the third differences of y, shape (T, m): their variance is 20 times that of y.

    At least MIN_NOISE of `size`, the unit of the channel.
    """
    third = np.diff(y, n=3, axis=0)
    spread = np.nanmedian(np.abs(third), axis=0) / 0.6745  # of a normal distribution
    return np.asarray(np.maximum(spread / np.sqrt(20.0), MIN_NOISE * size))


class FilterBank(NamedTuple):
    """Stationary Kalman filters of N models at each of the levels of the wind."""

    sampled: ObserverModel  # Phi (N, 1, s, s), Gamma (N, 1, s, m)
    L: FloatArray  # (N, levels, s, m)
    covariance: FloatArray  # (N, levels, m, m) of the innovations
    gravity: FloatArray  # (n, n)
    period: float  # s

    def advance(
        self, z: FloatArray, y: FloatArray, u: FloatArray, member: NDArray[np.int64], level: NDArray[np.int64]
    ) -> tuple[FloatArray, FloatArray]:
        """Innovations of K periods, (K, F, m), and z after them, for F filters: `member` at `level`, z (F, s).

            r = y - H z,  z+ = Phi (z + L r) + Gamma u + period gravity (sin(x) - x)

        with r = 0 in the update where y, (K, m), is lost; u (K, m), or (F, K, m) where the filters have inputs of their own.
        """
        H, Phi, L = self.sampled.H, self.sampled.Phi[member, 0], self.L[member, level]
        n, s, angles = len(self.gravity), Phi.shape[1], np.flatnonzero(self.gravity.any(axis=0))
        size = s + len(angles)  # z, and sin(x) - x of the angles
        steps = np.tile(np.eye(size), (2, len(z), 1, 1))  # without and with y
        steps[:, :, :s, :s], steps[:, :, :n, s:] = [Phi, Phi - Phi @ L @ H], self.period * self.gravity[:, angles]
        seen = np.asarray(np.isfinite(y).all(axis=1))
        states = np.zeros((len(y) + 1, len(z), size, 1))
        states[0, :, :s, 0] = z
        states[1:, :, :s, 0] = np.einsum("fsm,km->kfs", Phi @ L, np.where(np.isfinite(y), y, 0.0))
        states[1:, :, :s, 0] += np.einsum(
            "fsm,km->kfs" if u.ndim == y.ndim else "fsm,fkm->kfs", self.sampled.Gamma[member, 0], u
        )
        step = [steps[int(k_seen)] for k_seen in seen.tolist()]
        moved = np.empty(states.shape[1:])
        for k, (now, following) in enumerate(pairwise(states)):
            if k % HOLD == 0:
                now[:, s:] = np.sin(now[:, angles]) - now[:, angles]
            np.add(np.matmul(step[k], now, out=moved), following, out=following)
        return y[:, None] - states[:-1, :, :s, 0] @ H.T, states[-1, :, :s, 0]


def wind_model(axes: Sequence[str], speed: float) -> tuple[FloatArray, FloatArray]:
    """Time constants, s, and noises, m/s per root s, of winds of first order like Dryden's moderate turbulence, (G,) each.

    They have its spectrum at low and at high frequencies. With T = L / V0 that is 2 sigma^2 T / (1 + (T omega)^2) along the
    flight and sigma^2 T (1 + 3 (T omega)^2) / (1 + (T omega)^2)^2 across it. Arguments: `speed` V0, m/s.
    """
    spectrum, places = dryden(**MODERATE, sigma=0.0), np.array([AXES.index(axis) for axis in axes], dtype=np.int64)
    time, along = spectrum.length[places] / speed, places == AXES.index("longitudinal")
    noise = spectrum.sigma[places] * np.sqrt(np.where(along, 2.0, 3.0) / time)
    return np.where(along, time, time / np.sqrt(3.0)), noise


def filter_bank(model: NominalModel, names: Names, speed: float, strength: FloatArray) -> FilterBank:
    """The filters of models with A (N, n, n), B (N, n, m) and wind (N, n, G) at the trim speed V0, m/s.

    `strength` (N, G) multiplies the levels of the wind.
    """
    wind_time, noise = wind_model(names.winds, speed)
    gust, m = LEVELS[:, None] * strength[:, None] * noise, model.B.shape[-1]
    each = model._replace(A=model.A[:, None], B=model.B[:, None], wind=model.wind[:, None], kinematic=LEAK * model.kinematic)
    sampled = observer_design.aircraft_model(each, names, wind_time)
    weights = Weights(np.ones(m), np.full(m, DRIFT), gust, wind_time, np.full(1, LOOSE))
    L = observer_design.aircraft_correction(sampled, each, weights)
    # L = S H'(H S H' + R)^-1 leaves I - H L = R (H S H' + R)^-1
    covariance = np.linalg.solve(np.eye(m) - sampled.H @ L, np.broadcast_to(np.diag(model.noise**2), (*L.shape[:2], m, m)))
    return FilterBank(sampled, L, np.asarray(covariance), model.gravity, model.period)


class Block(NamedTuple):
    """Indices of a part of the aircraft that does not couple with the rest."""

    states: NDArray[np.int64]
    inputs: NDArray[np.int64]
    outputs: NDArray[np.int64]
    winds: NDArray[np.int64]

    def of(self, model: NominalModel) -> NominalModel:
        """The model of this part alone."""
        x, u, y = self.states, self.inputs, self.outputs
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
            input_scale=model.input_scale[u],
            D=model.D[u],
            lag=model.lag[u],
            total_lag=model.total_lag[u],
            lower=model.lower[u],
            upper=model.upper[u],
        )


def blocks(model: NominalModel) -> list[Block]:
    """The parts of an aircraft that neither A, gravity, B, C nor the wind couple; one where a part is not square."""
    (n, m), G = model.B.shape, model.wind.shape[1]
    coupled = np.zeros((n + 2 * m + G, n + 2 * m + G))
    coupled[:n] = np.hstack([model.A + model.gravity, model.B, model.C.T, model.wind]) != 0.0
    _, labels = connected_components(coupled, directed=False)
    parts = np.split(labels, [n, n + m, n + 2 * m])
    found = [Block(*(np.flatnonzero(part == label) for part in parts)) for label in np.unique(labels)]
    if all(len(block.inputs) == len(block.outputs) > 0 for block in found):
        return found
    return [Block(*(np.arange(len(part)) for part in parts))]
