# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Compute the sampled linear loop of a control law around a model, and whether it is stable.

The loop includes the actuators and the delay.
"""

from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

from flight_core.parameters import require
from flight_core.vectors import FloatArray
from rise_di_controller.extensions.observer import ObserverParams
from rise_di_controller.law.control_law import Measurements, TunedLaw, fields, restored
from rise_di_controller.law.law import LawParams, Sign, total_lag

SPECTRAL_RADIUS_TOLERANCE = 1e-6
"""A spectral radius above 1 by more than this is unstable. Angles that integrate the outputs give a
double eigenvalue 1, which rounding splits by the root of the rounding error, 1e-8."""

ROOT = np.sqrt(3.0)  # factor of the normalised second Legendre polynomial, ROOT (2 s - 1)

SMALL = 2.0**-40
"""Step with which `linear_law` differentiates. It is below every limit and every width of a soft
sign. A division by it loses no digit, because it is a power of two."""


class LinearPlant(NamedTuple):
    """A linear plant x_dot = A x + B u_a, y = C x, with an actuator for each input, SI.

    The channels are in the law's order, and the actuators have lag_i u_a,i_dot = u_i - u_a,i.
    """

    A: FloatArray  # (n, n)
    B: FloatArray  # (n, m)
    C: FloatArray  # (m, n), or (m + k, n) with k vanes


class LoopTiming(NamedTuple):
    """Actuators, delay and sampling between y and the response of the aircraft, over m channels."""

    lag: FloatArray  # time constants of the actuators, (m,), s; 0 without an actuator
    delay: float  # pure delay beyond sampling, s
    period: float  # period of the law, s

    @property
    def total(self) -> FloatArray:
        """Total lag of the loop, shape (m,), s."""
        return np.asarray(total_lag(self.lag, self.delay, self.period))


class LinearLaw(NamedTuple):
    """A law, linearised near e = 0 at y_m = 0, as z+ = A z + B y, u = C z + D y.

    The state z has k values. Leading axes are batches.
    """

    A: FloatArray  # (..., k, k)
    B: FloatArray  # (..., k, m); each vane adds a column here and in D
    C: FloatArray  # (..., m, k)
    D: FloatArray  # (..., m, m)


def linear_law(law: TunedLaw, m: int, period: float, candidates: int | None = None) -> LinearLaw:
    """Linearise the step of a law near e = 0 over m channels.

    Each column of the matrices is the response to a step of size SMALL in one value of the state or
    of y.

    The observer is taken as fully faded in, and its vanes as moving. Each vane adds a column after
    the columns of y. If `candidates` is N, the parameters hold N sets of gains in their last axis,
    and the matrices hold the N results in their first axis. Raises ParameterError for the literal
    sign, which is not linear anywhere.
    """
    control_law, params = law
    core = params
    while hasattr(core, "law"):  # an observer or a schedule extends another law
        core = core.law
    literal = isinstance(core, LawParams) and core.sign is Sign.LITERAL
    require(not literal, "sign", "literal", "soft or implicit, which are linear near e = 0")
    # Put the sets of gains in the last axis. Without sets, the last axis has the columns of the
    # matrix.
    sets = () if candidates is None else (candidates,)
    at_once = candidates is None and _has_columns(params)
    if at_once:
        params = _for_columns(params)
        sets = (1,)
    # Start from the equilibrium at engagement, with the observer faded in and the vanes in use.
    zero = np.zeros((m, *sets))
    vanes = getattr(params, "vanes", None)
    none = None if vanes is None else np.zeros((len(vanes.H), *sets))
    wide = m if none is None else m + len(none)
    if vanes is not None:
        params = params._replace(
            vanes=vanes._replace(least=np.where(np.isinf(vanes.least), np.inf, -1.0))
        )
    still = Measurements(
        y=zero, y_m=zero, y_m_dot=zero, u_trim=zero, u_before=zero, vane=none, vane_m=none
    )
    at_engagement = fields(control_law.engage(still, params))
    at_rest = {
        name: np.broadcast_to(value, (len(value), *sets)) for name, value in at_engagement.items()
    }
    if "sigma" in at_rest:
        at_rest["sigma"] = np.ones((1, *sets))
    # Write a step as a map from the vector of state and y to the vector of state and u.
    ends = np.cumsum([len(value) for value in at_rest.values()])
    size = int(ends[-1]) if len(ends) else 0

    def step(z: FloatArray, y: FloatArray) -> FloatArray:
        parts = dict(zip(at_rest, np.split(z, ends[:-1]), strict=True)) if size else {}
        now = still._replace(y=y[:m], vane=None if none is None else y[m:])
        state, u = control_law.step(restored(control_law, parts), now, np.float64(period), params)
        return np.concatenate([*fields(state).values(), u])

    # Differentiate the step, one column at a time.
    begin = np.concatenate([*at_rest.values(), np.zeros((wide, *sets))])
    equilibrium = step(begin[:size], begin[size:])
    if at_once:
        states = begin + SMALL * np.eye(size + wide)
        matrix = (step(states[:size], states[size:]) - equilibrium) / SMALL
    else:
        units = SMALL * np.eye(size + wide).reshape(size + wide, size + wide, *(1 for _ in sets))
        columns = [
            (step((begin + unit)[:size], (begin + unit)[size:]) - equilibrium) / SMALL
            for unit in units
        ]
        matrix = np.array(columns).T
    above = matrix[..., :size, :]
    below = matrix[..., size:, :]
    return LinearLaw(above[..., :size], above[..., size:], below[..., :size], below[..., size:])


def _has_columns(params: Any) -> bool:
    """Return whether the law can step many states at once, with one state in each column.

    RISE-DI can, alone or with an observer without vanes.
    """
    if isinstance(params, ObserverParams) and params.vanes is None:
        params = params.law
    return isinstance(params, LawParams)


def _for_columns(params: Any) -> Any:
    """Reshape the parameters of a law so that it steps states in columns: (k,) becomes (k, 1)."""
    values = []
    for value in params:
        if hasattr(value, "_asdict"):
            values.append(_for_columns(value))
        else:
            values.append(value[:, None] if np.ndim(value) == 1 else value)
    return type(params)(*values)


def zero_order_hold(A: FloatArray, B: FloatArray, period: float) -> tuple[FloatArray, FloatArray]:
    """Compute exp(A period) and integral_0^period exp(A s) ds B, for an input held over the period.

    Leading axes are batches. Source: C. Van Loan, IEEE TAC 23(3), 1978.
    """
    n, m = B.shape[-2:]
    block = np.zeros((*np.broadcast_shapes(A.shape[:-2], B.shape[:-2]), n + m, n + m))
    block[..., :n, :n] = A
    block[..., :n, n:] = B
    exponential = _exponential((block * period).tobytes(), block.shape)
    return exponential[..., :n, :n], exponential[..., :n, n:]


@lru_cache(maxsize=64)
def _exponential(matrices: bytes, shape: tuple[int, ...]) -> FloatArray:
    """Compute exp of matrices that are given as bytes with their shape.

    The results are cached by these bytes, because the matrices of the plant stay the same if gains
    change in flight.
    """
    from scipy.linalg import expm  # noqa: PLC0415 - a controller without an observer starts without it

    exponential = np.asarray(expm(np.frombuffer(matrices).reshape(shape).copy()), dtype=np.float64)
    exponential.flags.writeable = False  # the cache returns the array again
    return exponential


class SampledPlant(NamedTuple):
    """Aircraft, actuators and delay, sampled from tick to tick as x+ = A x + B u, y = C x.

    Leading axes are batches.
    """

    A: FloatArray  # (..., k, k)
    B: FloatArray  # (..., k, m)
    C: FloatArray  # (..., m, k)


def sampled_plant(
    plant: LinearPlant, loop: LoopTiming, extra: FloatArray, *, rising: bool = False
) -> SampledPlant:
    """Compute the exact motion of aircraft, actuators and delay over a period.

    The states are x, (n,), then the positions of the m actuators, and then u, (m,), of each earlier
    tick that still acts, the latest first.

    The u of a tick is held for a period and reaches actuator i after delay + extra_i, s, shape
    (m,). If `rising`, the u of a tick is not constant over the period: it is multiplied by the
    second Legendre polynomial ROOT (2 s - 1), where s rises from 0 to 1 over the period.

    Source: K. J. Astrom, B. Wittenmark, "Computer-Controlled Systems", section 2.3, for the
    sampling of a plant with delay.
    """
    n, m = plant.B.shape[-2:]
    batch = np.broadcast_shapes(plant.A.shape[:-2], plant.B.shape[:-2])
    has_lag = loop.lag > 0.0
    # an input without an actuator can have any rate here, which is not used
    rate = np.where(has_lag, 1.0 / np.where(has_lag, loop.lag, 1.0), 1.0)
    # Aircraft and actuators in continuous time.
    motion = np.zeros((*batch, n + m, n + m))
    drive = np.zeros((*batch, n + m, m))
    motion[..., :n, :n] = plant.A
    motion[..., :n, n:] = plant.B * has_lag
    motion[..., n:, n:] = -np.diag(rate)
    drive[..., :n, :] = plant.B * ~has_lag
    drive[..., n:, :] = np.diag(rate * has_lag)
    # Split the delay into whole periods and a remainder.
    ticks = np.floor((loop.delay + extra) / loop.period + 1e-9).astype(int)
    part = np.maximum(loop.delay + extra - ticks * loop.period, 0.0)
    kept_ticks = int(ticks.max()) + 1  # number of earlier ticks whose u still acts

    size = n + m + kept_ticks * m
    A = np.zeros((*batch, size, size))
    B = np.zeros((*batch, size, m))
    C = np.zeros((*batch, len(plant.C), size))
    C[..., :n] = plant.C
    A[..., : n + m, : n + m], _ = zero_order_hold(motion, drive, loop.period)
    # the effect of this tick's u, then of the u of each earlier tick
    inputs = np.zeros((*batch, n + m, m + kept_ticks * m))
    # The u that arrives within a period acts from the instant `split` before the end of the period.
    # Until then the u of the tick before acts.
    for i in range(m):
        split = loop.period - part[i]
        transition, new = _driven(motion, drive, split, 0.0, loop.period if rising else None)
        begin = split / loop.period
        _, old = _driven(motion, drive, part[i], begin, loop.period if rising else None)
        inputs[..., ticks[i] * m + i] += new[..., i]
        inputs[..., (ticks[i] + 1) * m + i] += (transition @ old)[..., i]
    B[..., : n + m, :] = inputs[..., :m]
    A[..., : n + m, n + m :] = inputs[..., m:]
    B[..., n + m : n + 2 * m, :] = np.eye(m)
    A[..., n + 2 * m :, n + m : -m] = np.eye((kept_ticks - 1) * m)
    return SampledPlant(A, B, C)


def _driven(
    motion: FloatArray, drive: FloatArray, time: float, begin: float, period: float | None
) -> tuple[FloatArray, FloatArray]:
    """Return the transition matrix over a time, s, and the response to an input held in this time.

    If `period` is given, the input is not constant but ROOT (2 s - 1), where s rises from `begin`
    by time / period.
    """
    transition, step = zero_order_hold(motion, drive, time)
    if period is None:
        return transition, step
    k, m = drive.shape
    ramp = np.zeros((k + m, k + m))
    ramp[:k, :k] = motion
    ramp[:k, k:] = drive
    slope = np.vstack([np.zeros((k, m)), np.eye(m) / period])
    risen = zero_order_hold(ramp, slope, time)[1][:k]
    return transition, ROOT * (2.0 * (begin * step + risen) - step)


def closed_loop(
    plant: LinearPlant, law: LinearLaw, loop: LoopTiming, extra: FloatArray
) -> FloatArray:
    """Return the matrix that advances the sampled loop by exactly one period.

    The loop is stable if no eigenvalue lies outside the unit circle. The state of the loop is the
    state of `sampled_plant`, followed by the state of the law. Leading axes of plant and law are
    batches.
    """
    A, B, C = sampled_plant(plant, loop, extra)
    k = A.shape[-1]
    size = A.shape[-1] + law.A.shape[-1]
    matrix = np.zeros((*np.broadcast_shapes(A.shape[:-2], law.A.shape[:-2]), size, size))
    matrix[..., :k, :k] = A + B @ law.D @ C
    matrix[..., :k, k:] = B @ law.C
    matrix[..., k:, :k] = law.B @ C
    matrix[..., k:, k:] = law.A
    return matrix


def spectral_radius(matrix: FloatArray) -> float:
    """Return the largest magnitude of an eigenvalue of a matrix."""
    return float(np.max(np.abs(np.linalg.eigvals(matrix)), initial=0.0))


def is_stable(plant: LinearPlant, law: LinearLaw, loop: LoopTiming, extra: FloatArray) -> bool:
    """Return whether no eigenvalue of `closed_loop` is outside the unit circle, up to rounding."""
    return spectral_radius(closed_loop(plant, law, loop, extra)) <= 1.0 + SPECTRAL_RADIUS_TOLERANCE
