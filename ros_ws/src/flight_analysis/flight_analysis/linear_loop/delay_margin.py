# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Find the longest delay of u at which a linear loop is still stable."""

import math

import numpy as np

from flight_core.vectors import FloatArray
from rise_di_controller.law.linear_loop import LinearLaw, LinearPlant, LoopTiming, is_stable

MAX_DELAY_MARGIN = 0.5
"""Upper end of the search for a delay margin, s. A loop that tolerates more is slower than any loop
of this stack."""

# first step of a search that begins at `near`, in multiples of the resolution
NEAR = 4


def delay_margin(
    plant: LinearPlant,
    law: LinearLaw,
    loop: LoopTiming,
    share: FloatArray | float = 1.0,
    longest: float = MAX_DELAY_MARGIN,
    near: float | None = None,
) -> float:
    """Find the delay margin: the delay beyond loop.delay, s, at the limit of stability.

    Input i is delayed by share_i times this delay, so you can delay all inputs alike or only some
    of them. `share` has the shape (m,). The margin is 0 if the loop is unstable without extra
    delay, and infinite if the loop tolerates a delay of `longest`, s. The search takes steps of
    half a period, then bisects down to 0.1 ms. If you give the margin of a similar loop as `near`,
    s, the search begins at this margin and takes a third of the time.
    """
    delayed = np.broadcast_to(share, loop.lag.shape)
    stride = 1  # in multiples of the resolution, which is 0.1 ms or less
    while loop.period / 2.0 / stride > 1e-4:
        stride *= 2
    part = loop.period / 2.0 / stride

    def is_stable_at(place: int) -> bool:
        return is_stable(plant, law, loop, place * part * delayed)

    lower = 0
    growth = 1
    if near is not None and 0.0 < near < longest:
        lower = round(near / part)
        stride = NEAR
        growth = 2
        while lower > 0 and not is_stable_at(lower):
            lower = max(lower - stride, 0)
            stride *= growth
        stride = max(stride // growth, NEAR)
    if lower == 0 and not is_stable_at(0):
        return 0.0
    while is_stable_at(lower + stride):
        lower += stride
        stride *= growth
        if lower * part > longest:
            return math.inf
    while stride > 1:
        stride //= 2
        if is_stable_at(lower + stride):
            lower += stride
    return lower * part
