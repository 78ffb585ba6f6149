# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Search for factors on gains with which a loop meets a requirement at the least cost.

Each of the m channels has k factors. A factor is STEP to the power of a whole number, its exponent,
so that the search is deterministic. A place in the search is a tuple of all k m exponents. Source
of the pattern search: R. Hooke, T. A. Jeeves, Journal of the ACM 8(2), 1961.
"""

import math
from collections.abc import Callable, Sequence
from typing import Generic, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

Content = TypeVar("Content")
Place = tuple[int, ...]
IntArray = NDArray[np.int64]

STEP = 1.05  # the factor that an exponent of 1 stands for
GAIN = 0.01  # least fall of cost or shortage that counts as better: 1 % of a cost or of a goal
REACH = 16  # largest change of an exponent by one move while there is a shortage: a factor of 2.2


class Moves(NamedTuple):
    """The moves that a search tries: k whole numbers each, added to a channel's exponents."""

    mending: Sequence[tuple[int, ...]]  # moves that may reduce a shortage
    cheaper: Sequence[tuple[int, ...]]  # moves that may lower the cost
    begin: int = 1  # reach of the first moves, which is the factor by which a move is multiplied
    is_joint: bool = False  # whether all channels may move together while there is a shortage


class Trial(NamedTuple, Generic[Content]):
    """A place that the search has tried, with its loop, the shortage of the loop, and its cost."""

    place: Place
    shortage: float  # sum of 1 - found / needed over the goals that the loop misses
    # cost of the loop as a logarithm, so that a difference of costs stands for a ratio; infinite if
    # there is a shortage
    cost: float
    content: Content

    def is_better(self, trial: "Trial[Content]") -> bool:
        """Return whether this trial is better than another one by at least GAIN.

        A smaller shortage is better. If neither trial has a shortage, a lower cost is better.
        """
        if self.shortage == 0.0 or trial.shortage == 0.0:
            return self.shortage < trial.shortage or self.cost < trial.cost - GAIN
        return self.shortage < trial.shortage - GAIN * min(trial.shortage, 1.0)


Assess = Callable[[Sequence[Place]], list[Trial[Content]]]


def exponent(factor: float) -> int:
    """Return the largest whole number k for which STEP^k does not exceed a factor."""
    return math.floor(math.log(factor) / math.log(STEP))


def descend(
    assess: Assess[Content],
    start: Trial[Content],
    moves: Moves,
    lowest: IntArray,
    highest: IntArray,
) -> Trial[Content]:
    """Search from a start until no move of a single channel helps, and return the last trial.

    `lowest` and `highest`, (k, m), bound the exponents. Each move is multiplied by a whole number,
    the reach. As long as there is a shortage, the search takes the best move of all channels. If no
    move helps, it doubles the reach. If no move helps up to the reach REACH, the last trial still
    has a shortage. Without a shortage, the channels move in turn. The reach then begins with the
    value that it had last, and is halved whenever no channel finds a move that helps.
    """
    best = start
    reach = moves.begin
    channels = range(highest.shape[1])
    bounds = lowest, highest
    while best.shortage:
        if reach > REACH:
            return best
        directions: list[int | list[int]] = [*channels]
        if moves.is_joint:
            directions.append([*channels])
        places = [
            place
            for i in directions
            for place in _neighbours(best.place, i, reach, moves.mending, bounds)
        ]
        trials = assess(places)
        nearest = min(trials, key=lambda trial: (trial.shortage, trial.cost), default=best)
        if nearest.is_better(best):
            best = nearest
        else:
            reach *= 2
    while reach:
        before = best
        for i in channels:
            for trial in assess(_neighbours(best.place, i, reach, moves.cheaper, bounds)):
                best = trial if trial.is_better(best) else best
        if best is before:
            reach //= 2
    return best


def _neighbours(
    place: Place,
    channels: int | list[int],
    reach: int,
    moves: Sequence[tuple[int, ...]],
    bounds: tuple[IntArray, IntArray],
) -> list[Place]:
    """List the places to which moves of one or several channels lead, except the place itself."""
    places = np.repeat(np.reshape(place, (1, *bounds[0].shape)), len(moves), axis=0)
    for channel in np.atleast_1d(channels):
        places[:, :, channel] += reach * np.array(moves)
    rows = np.clip(places, *bounds).reshape(len(moves), -1).tolist()
    return [row for row in dict.fromkeys(map(tuple, rows)) if row != place]
