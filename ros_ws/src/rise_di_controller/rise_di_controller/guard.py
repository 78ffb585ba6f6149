# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""What stands around the law: limits and anti-windup, freshness of its inputs, engagement. Pure, like the law."""

from collections.abc import Sequence
from enum import IntEnum
from typing import NamedTuple

import numpy as np

from flight_core.failsafe import failsafe_scale
from flight_core.rates import seconds
from flight_core.vectors import Array, FloatArray, StampedVector, array_namespace
from rise_di_controller import feedforward
from rise_di_controller import law as rise
from rise_di_controller.feedforward import FeedforwardState, Nominal
from rise_di_controller.law import LawParams, LawState


class Mode(IntEnum):
    """What the controller is doing; published as a number in `internals`."""

    WAITING = 0  # y or y_m has not come yet; nothing is commanded
    ENGAGED = 1  # the law flies
    HOLD = 2  # y or y_m is stale: u is held and nothing is integrated
    RAMP = 3  # stale for longer: u goes to trim
    TRIM = 4  # u is at trim
    INACTIVE = 5  # deactivated: u is held or goes to trim


class Limits(NamedTuple):
    """What may be commanded, deviations from trim in units of u; infinite where there is no limit."""

    lower: Array  # (m,)
    upper: Array  # (m,)
    rate: Array  # (m,) per s


# Part of the reach: a slope from samples closer to each other would be more noise than slope, 20 times as much further on.
MIN_SLOPE_SPAN = 0.05

# Reference samples to keep, so that one of the stamp of y is among them: 0.1 s at 1 kHz, more where y_m is slower.
SAMPLE_BUFFER_SIZE = 100


class GuardParams(NamedTuple):
    """Times in ns, the limits, and the nominal model of the feedforward."""

    period_ns: int  # of the controller's ticks
    max_age_ns: int  # beyond which a sample is stale
    hold_ns: int  # for how long u is held then
    ramp_ns: int  # and how long it takes to trim
    deactivation_holds: bool  # whether u is held when deactivated, else it ramps to trim
    limits: Limits
    nominal: Nominal | None = None  # None: no feedforward


# A measured dt is used as it is between these multiples of the period: lost ticks are integrated in full (at half of them
# lost a ceiling of 3 costs 15 % in q and 22 % in r), and a burst cannot kick the sign term. A gap beyond the age limit
# engages afresh anyway.
DT_RANGE = (0.2, 10.0)


class ControllerState(NamedTuple):
    """What the controller carries from tick to tick."""

    mode: Mode
    law: LawState | None  # None until engaged
    y: StampedVector | None  # the newest y used
    y_m: FloatArray | None  # the reference at its stamp
    u: FloatArray  # commanded, after limits
    u_free: FloatArray  # before limits
    u_trim: FloatArray  # u at engagement, to which the law adds
    lost_ns: int  # when the inputs were lost, or the controller deactivated
    u_lost: FloatArray  # u at that instant
    u_ff: FloatArray  # what the feedforward adds, 0 where there is none
    feedforward: FeedforwardState | None = None


class TickInputs(NamedTuple):
    """What one tick of the controller used, for the log: recomputing the tick from it gives u to the last bit."""

    stamp_ns: int  # of y, and so of u; of the tick where no y is used
    y: FloatArray
    y_m: FloatArray  # brought to the stamp of y
    y_m_offset: float  # stamp of the newest y_m used minus stamp of y, s
    dt: float  # s given to the law, 0 where it took no step


def initial_state(m: int) -> ControllerState:
    """The state before the first sample: u = 0."""
    zero = np.zeros(m)
    return ControllerState(Mode.WAITING, None, None, None, zero, zero, zero, 0, zero, zero)


def align(samples: Sequence[StampedVector], stamp_ns: int, reach_ns: int) -> FloatArray | None:
    """The signal at an instant, shape (m,), None where no sample reaches it.

    The sample of that stamp, else linear between its neighbours, else linear beyond the newest by at most `reach_ns`, by the
    slope from the newest that is MIN_SLOPE_SPAN of it older; where there is none, the newest is held as far.

    Arguments: samples with increasing stamps.
    """
    for sample in reversed(samples):
        if sample.stamp_ns == stamp_ns:
            return sample.value
    older = [sample for sample in samples if sample.stamp_ns < stamp_ns]
    newer = [sample for sample in samples if sample.stamp_ns > stamp_ns]
    if older and newer:
        before, after = older[-1], newer[0]
    elif not older or stamp_ns - older[-1].stamp_ns > reach_ns:
        return None
    else:
        after = older[-1]
        apart = [sample for sample in older if after.stamp_ns - sample.stamp_ns >= MIN_SLOPE_SPAN * reach_ns]
        if not apart:
            return after.value
        before = apart[-1]
    fraction = (stamp_ns - before.stamp_ns) / (after.stamp_ns - before.stamp_ns)
    return before.value + fraction * (after.value - before.value)


def limit(u: Array, u_before: Array, dt: Array, limits: Limits) -> Array:
    """U held inside [lower, upper] and within rate dt of the u before, shape (m,); u itself, to the last bit, where inside."""
    xp = array_namespace(u)
    reach = limits.rate * dt
    low = xp.minimum(xp.maximum(limits.lower, u_before - reach), limits.upper)
    high = xp.maximum(xp.minimum(limits.upper, u_before + reach), limits.lower)
    return xp.minimum(xp.maximum(u, low), high)


def guarded_step(
    state: LawState, y: Array, y_m: Array, dt: Array, u_trim: Array, u_before: Array, law: LawParams, limits: Limits
) -> tuple[LawState, Array, Array]:
    """One tick of the law inside its limits: (law state, u before limits, u commanded), all shape (m,).

    The law takes its step. Where u_trim + u is beyond a limit of magnitude or rate, the increments of the integrals (of
    integral_e and of Pi, each by itself) that move u further beyond are cut; those that move it inwards stay. That of
    integral_e is taken back; that of Pi, the faster one, keeps the share that ends at the limit, so that u reaches it:

        left  = max(abs(beyond) - abs(what the increment of integral_e moves u by), 0)
        moved = abs(what the increment of Pi moves u by)
        Pi+   = Pi + max(moved - left, 0) / moved times that increment

    Without saturation every bit is that of the law alone. Theorem 1 does not speak of limits.
    """
    xp = array_namespace(y)
    after, u = rise.step(state, y, y_m, dt, law)
    total = u_trim + u
    beyond = total - limit(total, u_before, dt, limits)
    increment, increment_Pi = after.integral_e - state.integral_e, after.Pi - state.Pi
    moves = -law.input_scale * law.D * law.K * law.Lambda * increment
    moves_Pi = -law.input_scale * law.D * increment_Pi
    outward, outward_Pi = moves * beyond > 0, moves_Pi * beyond > 0
    none = xp.zeros_like(total)
    left = xp.maximum(xp.abs(beyond) - xp.where(outward, xp.abs(moves), none), none)
    moved = xp.where(outward_Pi, xp.abs(moves_Pi), none)
    keep = xp.maximum(moved - left, none) / xp.where(moved > 0, moved, none + 1.0)
    after = after._replace(
        integral_e=xp.where(outward, state.integral_e, after.integral_e),
        Pi=xp.where(outward_Pi, state.Pi + keep * increment_Pi, after.Pi),
    )
    u_free = u_trim + rise.control(state, after, law)
    return after, u_free, limit(u_free, u_before, dt, limits)


def tick(
    state: ControllerState,
    now_ns: int,
    y: StampedVector | None,
    y_m: Sequence[StampedVector],
    guard: GuardParams,
    law: LawParams,
    active: bool = True,
) -> tuple[ControllerState, TickInputs | None]:
    """One tick of the controller: (state, now, y, y_m) -> (state, what was used), u in state.u.

    Fresh inputs engage it, at any time, with e_0 = e, both integrals 0 and u_trim = u as it was: u does not jump. Each
    further sample is one step of the law with the measured dt, held inside DT_RANGE periods, from u_trim, or u_trim + u_ff
    where there is a feedforward; without a new y nothing changes.
    Stale inputs: HOLD (u kept, nothing integrated), then RAMP to trim, then TRIM; fresh ones engage it again. Not `active`:
    INACTIVE, u held or ramped to trim as the parameters say. None is returned where nothing is to be published.

    Arguments: `y` the newest sample, `y_m` the last ones with increasing stamps; both in the law's order.
    """
    reference = None
    if y is not None and y_m and max(abs(now_ns - sample.stamp_ns) for sample in (y, y_m[-1])) <= guard.max_age_ns:
        reference = align(y_m, y.stamp_ns, guard.period_ns)
    if not active or y is None or reference is None:
        return _without_inputs(state, now_ns, guard, active)
    offset = seconds(y_m[-1].stamp_ns - y.stamp_ns)
    if state.law is None or state.y is None or state.mode is not Mode.ENGAGED:
        engaged = state._replace(
            mode=Mode.ENGAGED,
            law=rise.engage(y.value, reference),
            y=y,
            y_m=reference,
            u_trim=state.u,
            u_free=state.u,
            u_ff=np.zeros_like(state.u),
            feedforward=None if guard.nominal is None else feedforward.initial_state(reference, guard.nominal),
        )
        return engaged, TickInputs(y.stamp_ns, y.value, reference, offset, 0.0)
    if y.stamp_ns <= state.y.stamp_ns:
        return state, None
    nominal = seconds(guard.period_ns)
    dt = min(max(seconds(y.stamp_ns - state.y.stamp_ns), DT_RANGE[0] * nominal), DT_RANGE[1] * nominal)
    u_trim, u_ff, ahead = state.u_trim, state.u_ff, state.feedforward
    if guard.nominal is not None and ahead is not None:
        ahead, u_ff = feedforward.step(ahead, reference, dt, guard.nominal)
        u_trim = u_trim + u_ff
    law_state, u = rise.step(state.law, y.value, reference, dt, law)
    u_free = u_trim + u
    u = limit(u_free, state.u, dt, guard.limits)
    if not np.array_equal(u, u_free):  # else the guarded step is the law alone, and takes three times as long
        law_state, u_free, u = guarded_step(state.law, y.value, reference, dt, u_trim, state.u, law, guard.limits)
    flown = state._replace(law=law_state, y=y, y_m=reference, u=u, u_free=u_free, u_ff=u_ff, feedforward=ahead)
    return flown, TickInputs(y.stamp_ns, y.value, reference, offset, dt)


def _without_inputs(
    state: ControllerState, now_ns: int, guard: GuardParams, active: bool
) -> tuple[ControllerState, TickInputs | None]:
    y, y_m = state.y, state.y_m
    if y is None or y_m is None:
        return state._replace(mode=Mode.WAITING if active else Mode.INACTIVE), None
    was_active = state.mode is not Mode.INACTIVE
    if state.mode is Mode.ENGAGED or was_active != active:
        state = state._replace(lost_ns=now_ns, u_lost=state.u)
    hold_ns = guard.hold_ns if active else 0
    share = 1.0 if not active and guard.deactivation_holds else failsafe_scale(now_ns - state.lost_ns, hold_ns, guard.ramp_ns)
    if not active:
        mode = Mode.INACTIVE
    elif share == 1.0:
        mode = Mode.HOLD
    else:
        mode = Mode.RAMP if share > 0.0 else Mode.TRIM
    u = state.u_lost if share == 1.0 else share * state.u_lost
    return state._replace(mode=mode, u=u, u_free=u), TickInputs(now_ns, y.value, y_m, 0.0, 0.0)
