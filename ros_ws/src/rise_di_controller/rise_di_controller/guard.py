# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""What stands around the law: freshness of its inputs, engagement, and the time step it is given. Pure, like the law."""

from collections.abc import Sequence
from enum import IntEnum
from typing import NamedTuple

import numpy as np

from flight_core.rates import seconds
from flight_core.vectors import FloatArray
from rise_di_controller.law import LawParams, LawState, engage, step


class Mode(IntEnum):
    """What the controller is doing; published as a number in `internals`."""

    WAITING = 0  # y or y_m has not come yet
    ENGAGED = 1  # the law flies
    HOLD = 2  # y or y_m is stale: u is held and nothing is integrated


class Sample(NamedTuple):
    """Values that belong to an instant."""

    stamp_ns: int
    value: FloatArray


class GuardParams(NamedTuple):
    """Times in ns."""

    period_ns: int  # of the controller's ticks
    max_age_ns: int  # beyond which a sample is stale


# A measured dt is used as it is between these multiples of the period: a lost tick is integrated in full, and
# neither a burst nor a long gap can kick the sign term (pains of sampled controllers; lost ticks up to 3 in a row).
DT_RANGE = (0.2, 3.0)


class ControllerState(NamedTuple):
    """What the controller carries from tick to tick."""

    mode: Mode
    law: LawState | None  # None until engaged
    y: Sample | None  # the newest y used
    u: FloatArray


class Used(NamedTuple):
    """What one tick of the controller used, for the log: recomputing the tick from it gives u to the last bit."""

    stamp_ns: int  # of y, and so of u
    y: FloatArray
    y_m: FloatArray  # brought to the stamp of y
    y_m_offset: float  # stamp of the newest y_m used minus stamp of y, s
    dt: float  # s given to the law, 0 where it took no step


def start(m: int) -> ControllerState:
    """The state before the first sample: u = 0."""
    return ControllerState(Mode.WAITING, None, None, np.zeros(m))


def align(samples: Sequence[Sample], stamp_ns: int, reach_ns: int) -> FloatArray | None:
    """The signal at an instant, shape (m,), None where no sample reaches it.

    The sample of that stamp, else linear between its neighbours, else linear beyond the newest two by at most `reach_ns`;
    a single sample is held as far.

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
    elif len(older) == 1:
        return older[0].value
    else:
        before, after = older[-2:]
    fraction = (stamp_ns - before.stamp_ns) / (after.stamp_ns - before.stamp_ns)
    return before.value + fraction * (after.value - before.value)


def tick(
    state: ControllerState, now_ns: int, y: Sample | None, y_m: Sequence[Sample], guard: GuardParams, law: LawParams
) -> tuple[ControllerState, Used | None]:
    """One tick of the controller: (state, now, y, y_m) -> (state, what was used), u in state.u.

    WAITING until y and a y_m at its instant are fresh, then e_0 is latched with u = 0 (ENGAGED); each further sample is one
    step of the law with the measured dt, held inside DT_RANGE periods. Stale samples: HOLD, u kept, nothing integrated; the
    law goes on when they are fresh again. No new y: nothing changes. None is returned where y was not used.

    Arguments: `y` the newest sample, `y_m` the last ones with increasing stamps; both in the law's order.
    """
    reference = None
    if y is not None and y_m and now_ns - y.stamp_ns <= guard.max_age_ns and now_ns - y_m[-1].stamp_ns <= guard.max_age_ns:
        reference = align(y_m, y.stamp_ns, guard.period_ns)
    if y is None or reference is None:
        mode = Mode.WAITING if state.law is None else Mode.HOLD
        return state._replace(mode=mode), None
    if state.y is not None and y.stamp_ns <= state.y.stamp_ns:
        return state._replace(mode=Mode.ENGAGED), None
    dt = 0.0
    u = state.u
    if state.law is None or state.y is None:
        law_state = engage(y.value, reference)
    else:
        nominal = seconds(guard.period_ns)
        dt = min(max(seconds(y.stamp_ns - state.y.stamp_ns), DT_RANGE[0] * nominal), DT_RANGE[1] * nominal)
        law_state, u = step(state.law, y.value, reference, dt, law)
    used = Used(y.stamp_ns, y.value, reference, seconds(y_m[-1].stamp_ns - y.stamp_ns), dt)
    return ControllerState(Mode.ENGAGED, law_state, y, u), used
