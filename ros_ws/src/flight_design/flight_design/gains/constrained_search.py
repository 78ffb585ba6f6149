# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""A search for factors on gains: the least cost of a loop that lacks nothing of a requirement.

A place is a tuple of whole exponents of STEP, two factors a channel, so that a search is
deterministic. The search is a pattern search: R. Hooke, T. A. Jeeves, Journal of the ACM 8(2),
1961.
"""

import math
from collections.abc import Callable, Sequence
from typing import Generic, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

Content = TypeVar("Content")
Place = tuple[int, ...]
IntArray = NDArray[np.int64]

STEP = 1.05  # factor of an exponent of 1
GAIN = 0.01  # least fall of cost or shortage that counts: a hundredth, or a hundredth of a goal
REACH = 16  # exponents, the longest move from a place with a shortage: a factor of 2.2
CHEAPER = ((-1, 0), (0, -1), (1, -1), (2, -1), (-3, 1))
MOVES = (*CHEAPER, (-1, 1), (1, 0), (0, 1))
"""Of the two exponents of a channel, a of the integral and b of the bandwidth. The error after a
slow disturbance grows with slower lower^2: only moves with a + 2 b <= 0 can lower the cost."""


class Trial(NamedTuple, Generic[Content]):
    """A place, and what the loop there lacks and costs."""

    place: Place
    shortage: float  # sum over the goals of 1 - found / needed where this is above 0
    cost: float  # a logarithm: the change counts; infinite with a shortage
    content: Content

    def is_better(self, trial: "Trial[Content]") -> bool:
        """Whether the shortage is less, or the cost where nothing is short, by GAIN."""
        if self.shortage == 0.0 or trial.shortage == 0.0:
            return self.shortage < trial.shortage or self.cost < trial.cost - GAIN
        return self.shortage < trial.shortage - GAIN * min(trial.shortage, 1.0)


Assess = Callable[[Sequence[Place]], list[Trial[Content]]]


def exponent(factor: float) -> int:
    """The largest exponent of STEP that does not exceed a factor."""
    return math.floor(math.log(factor) / math.log(STEP))


def descend(assess: Assess[Content], start: Trial[Content], highest: IntArray) -> Trial[Content]:
    """The trial that no move of one channel betters, from a start.

    `highest` (2, m) are the largest exponents of both factors, by channel; the least is 0. With a
    shortage the best move of all channels counts, and the reach doubles where none helps. Without a
    shortage each channel moves in turn, from the last reach on, and the reach is halved where none
    helps.
    """
    best = start
    reach = 1
    channels = range(highest.shape[1])
    while best.shortage:
        if reach > REACH:
            return best
        places = [place for i in channels for place in _moved(best.place, i, reach, MOVES, highest)]
        trials = assess(places)
        nearest = min(trials, key=lambda trial: (trial.shortage, trial.cost), default=best)
        if nearest.is_better(best):
            best = nearest
        else:
            reach *= 2
    while reach:
        before = best
        for i in channels:
            for trial in assess(_moved(best.place, i, reach, CHEAPER, highest)):
                best = trial if trial.is_better(best) else best
        if best is before:
            reach //= 2
    return best


def _moved(
    place: Place, channel: int, reach: int, moves: Sequence[tuple[int, int]], highest: IntArray
) -> list[Place]:
    """The places that moves of a channel lead to, other than the place itself."""
    moved = np.repeat(np.reshape(place, (1, 2, -1)), len(moves), axis=0)
    moved[:, :, channel] += reach * np.array(moves)
    rows = np.clip(moved, 0, highest).reshape(len(moves), -1).tolist()
    return [row for row in dict.fromkeys(map(tuple, rows)) if row != place]
