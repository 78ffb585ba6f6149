# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Decide which samples of y and y_m the controller takes.

A sample that is impossible for an aircraft is dropped, and counts as one that did not arrive.

- `bound_violation` finds a value beyond the bound of its output. No sensor gives such a value.
- `step` finds a y that changes faster than an aircraft can. The test compares y with the y before
  it, and uses no model, so a wrong model does not lock any sample out. If y really jumps, two
  samples are dropped. The controller takes the third sample in a row that agrees with the sample
  before it.
- `step` also finds a y that stands still. Such a y repeats every bit of every value, although each
  sample before brought a change.
"""

from collections.abc import Sequence
from enum import IntEnum
from typing import NamedTuple

import numpy as np

from flight_core import plausible
from flight_core.outcome import Refusal
from flight_core.rates import NANOSECONDS, seconds
from flight_core.vectors import FloatArray, StampedVector

TIMES = 5.0
"""Factor by which a change may exceed the largest change of the last minute. Noise changes by up to
four standard deviations in a minute, so a factor of 5 allows 20 of them. In flights of seven of the
scenarios no change exceeded a quarter of the limit."""

MEMORY = 60.0  # time constant with which the largest change fades, s
FIRST_NS = NANOSECONDS  # time after the first sample, in which y shows how it changes
AUTHORITY = 2.0
"""Largest possible change of y in a period, divided by the change that full inputs cause. Wind can
move an aircraft as much as its inputs do."""

UNLIMITED = 1.0  # full input without a limit, SI: 57 deg, or thrust equal to weight

LEAST = {"V": 1.0}
"""Change that is always possible, m/s per sample. An airspeed may come in whole knots."""

LEAST_RATE = 0.1
"""Change of any other output that is always possible, rad/s per sample. It is 20 times the noise of
a gyro, 0.005 rad/s."""
AGREEING = 3  # number of samples in a row that must agree after a jump

STILL = 5
"""Number of samples in a row that must equal the sample before, so that y counts as frozen. They
must also span this number of periods."""

MOVING = 100
"""Number of changing samples in a row which show that this y never stands still by itself.

Noise changes every sample. If a quantised sensor changes a share c of its samples at rest, 100
changes followed by 5 repeats have the probability c^100 (1 - c)^5, at most 1e-9, at c = 0.95. A y
that a bridge repeats, and a simulation without noise in trim, do not have 100 changes in a row and
so never count as frozen. A simulation settles by ever rarer changes of the last bit.
"""


class SampleLimits(NamedTuple):
    """Bounds of the m outputs of y and of y_m."""

    largest: FloatArray  # largest abs(y), (m,)
    reach: FloatArray  # change of y in a period that is always possible, (m,), units of y
    period_ns: int  # period of the ticks


class SampleChange(IntEnum):
    """How a sample of y compares with the samples before it: near, a jump, or frozen."""

    NEAR = 0  # taken
    FAR = 1  # lost
    JUMPED = 2  # taken: y has jumped, and the law engages again
    FROZEN = 3  # lost: y stands still


class Stillness(NamedTuple):
    """A record of whether y changes from sample to sample."""

    since_ns: int  # stamp of the first sample with the present values
    changes: int = 0  # number of samples in a row with a change, at most MOVING
    equal: int = 0  # number of equal samples in a row after that, at most STILL
    is_frozen: bool = False


class SampleState(NamedTuple):
    """What the controller remembers of the earlier samples of y, to judge the next one."""

    begin_ns: int  # stamp of the first sample
    last: StampedVector  # the last sample taken
    # largest change per period of the samples taken, (m,), units of y, which fades with time
    change: FloatArray
    # The last sample that was compared, which differs from `last` if it was lost. A sample with the
    # same stamp is refused, so that a wrong sample that is sent three times does not count as three
    # that agree.
    far: StampedVector
    # number of lost samples in a row that agree each with the one before; the last of them is `far`
    agreeing: int
    stillness: Stillness


def sample_limits(
    names: Sequence[str], authority: FloatArray, largest: Sequence[float] | None, period_ns: int
) -> SampleLimits:
    """Return the limits within which the samples of the outputs `names` must be.

    `authority` is the y_dot that full inputs give, (m,), units of y / s. `largest` holds the bounds
    from the parameters. If `largest` is None, plausible bounds are used.
    """
    least = [LEAST.get(name, LEAST_RATE) for name in names]
    reach = np.maximum(AUTHORITY * authority * seconds(period_ns), least)
    bounds = plausible.largest(names) if largest is None else np.array(largest, dtype=np.float64)
    return SampleLimits(bounds, reach, period_ns)


def bound_violation(
    value: FloatArray, names: Sequence[str], limits: SampleLimits
) -> Refusal | None:
    """Return a refusal for the first of m values that is NaN or beyond its bound, or None."""
    is_inside = np.abs(value) <= limits.largest
    if is_inside.all():
        return None
    i = int(np.argmin(is_inside))
    return Refusal(
        f"{names[i]} = {value[i]:g} is beyond {limits.largest[i]:g}, the bound of {names[i]} "
        "(controller.y_max)"
    )


def jump(before: StampedVector, sample: StampedVector, names: Sequence[str]) -> str:
    """Describe the changes between two samples in a sentence."""
    values = zip(names, before.value.tolist(), sample.value.tolist(), strict=True)
    moves = ", ".join(f"{name} from {old:g} to {new:g}" for name, old, new in values)
    return f"a jump of y in {seconds(sample.stamp_ns - before.stamp_ns):g} s: {moves}"


def standstill(state: SampleState, sample: StampedVector) -> Refusal:
    """Return a refusal which says that a sample is dropped because y stands still."""
    span = seconds(sample.stamp_ns - state.stillness.since_ns)
    return Refusal(
        f"y: found every value as before for {span:g} s, expected an aircraft that moves"
    )


def first_state(sample: StampedVector) -> SampleState:
    """Return the state after the first sample."""
    stillness = Stillness(sample.stamp_ns)
    return SampleState(
        begin_ns=sample.stamp_ns,
        last=sample,
        change=np.zeros_like(sample.value),
        far=sample,
        agreeing=0,
        stillness=stillness,
    )


def step(
    state: SampleState, sample: StampedVector, limits: SampleLimits
) -> tuple[SampleState, SampleChange]:
    """Judge a sample of y with a later stamp, and return the new state with the judgement.

        change = abs(y - last) / periods,  periods = max(stamp - last stamp, period) / period
        NEAR if change <= max(TIMES largest, reach) in all outputs, and then largest = max(change,
        faded largest)

    `largest` is `state.change`, and `reach` and the period come from `limits`. The change that is
    allowed grows with the time since the last sample that was taken, so no sensor is locked out for
    ever. After dropped samples, `largest` takes the whole change instead of the change per period.
    The samples may have been dropped because y is noisy, and the changes of noise do not grow with
    time.

    The samples within the first FIRST_NS are always NEAR. A gyro may start with wrong values, so
    during this time `largest` takes at most `reach` of a near change, and nothing of a larger
    change.

    A sample is FROZEN if y has moved and now stands still. y has moved if at least MOVING samples
    in a row differed from the one before. y stands still if no value has changed since then, for
    STILL samples and for as many periods.
    """
    stillness = _next_stillness(state.stillness, sample, state.last, limits)
    state = state._replace(stillness=stillness)
    if stillness.is_frozen:
        return state._replace(far=sample, agreeing=0), SampleChange.FROZEN
    is_near, change = _comparison(state.last, sample, state.change, limits)
    is_first = sample.stamp_ns - state.begin_ns < FIRST_NS
    if is_near or is_first:
        if is_first:
            change = np.minimum(change, limits.reach) if is_near else np.zeros_like(change)
        elif state.agreeing:
            change = np.abs(sample.value - state.last.value)
        fading = 1.0 - min(seconds(sample.stamp_ns - state.last.stamp_ns) / MEMORY, 1.0)
        largest = np.maximum(change, fading * state.change)
        return state._replace(
            last=sample, change=largest, far=sample, agreeing=0
        ), SampleChange.NEAR
    # If no sample was lost before, `far` has the values of `last`, so the sample is far from both.
    agrees = _comparison(state.far, sample, state.change, limits)[0]
    agreeing = state.agreeing + 1 if agrees else 1
    if agreeing < AGREEING:
        return state._replace(far=sample, agreeing=agreeing), SampleChange.FAR
    return state._replace(last=sample, far=sample, agreeing=0), SampleChange.JUMPED


def _next_stillness(
    before: Stillness, sample: StampedVector, last: StampedVector, limits: SampleLimits
) -> Stillness:
    """Update the record of whether y changes, from a new sample and the last sample taken."""
    if not np.array_equal(sample.value, last.value):
        is_moving = before.is_frozen or before.equal == 0
        changes = min(before.changes + 1, MOVING) if is_moving else 1
        return Stillness(sample.stamp_ns, changes)
    equal = min(before.equal + 1, STILL)
    has_lasted = equal == STILL and sample.stamp_ns - before.since_ns >= STILL * limits.period_ns
    return before._replace(equal=equal, is_frozen=has_lasted and before.changes == MOVING)


def _comparison(
    before: StampedVector, sample: StampedVector, largest: FloatArray, limits: SampleLimits
) -> tuple[bool, FloatArray]:
    """Compare a sample with the sample before it.

    Returns whether the sample is near, and its change per period, (m,).
    """
    periods = max((sample.stamp_ns - before.stamp_ns) / limits.period_ns, 1.0)
    change = np.abs(sample.value - before.value) / periods
    return bool((change <= np.maximum(TIMES * largest, limits.reach)).all()), change
