# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Whether an aircraft has changed since its model was identified: a likelihood ratio over the last seconds of a flight."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from aircraft_sim.airframe import Airframe
from flight_analysis.design.innovation_filters import Actuation, Block, Recording, blocks, filter_model
from flight_analysis.design.model_identification import STARTS, Search, Unknown
from flight_core.vectors import FloatArray

RECORD = 10.0  # s, of the flight that is tested
LEAST_DEVIATION, FREE_DEVIATION = 0.03, 0.3  # 1, of an entry if the aircraft is the same, and if it has changed
MAX_GAIN = 15.0  # of log-likelihood: without a change 1 is usual and 10 was the largest of 80 tests; with a change 40 is usual
ANGLE = 0.3  # rad, standard deviation of pitch and bank at the begin of the record, which may lie in a turn
NO_EFFECT = 1e-6  # 1, of the effect of an input: 0 would have no input scale
DEAD_WITHIN = MAX_GAIN / 2.0  # of log-likelihood: so close to the refit a dead input explains the flight as well


class Change(NamedTuple):
    """The test of a part of the aircraft that does not couple with the rest."""

    outputs: tuple[str, ...]
    gain: float  # of log-likelihood by a change of the entries
    dead: str  # the input without any effect; empty where there is none

    @property
    def found(self) -> bool:
        """Whether the part has changed."""
        return self.gain > MAX_GAIN


def change_test(
    recorded: Recording,
    flown: Airframe,
    actuation: Actuation,
    deviation: Mapping[str, float],
    delays: Mapping[tuple[str, ...], float] | None = None,
) -> tuple[Change, ...]:
    """The gain G of log-likelihood of each part of the aircraft by a change of its entries, and an input without effect.

        J(theta; s) = -sum log p(y_k | y_1 .. y_k-1, theta) + |theta / s|^2 / 2,    theta relative to the flown model
        G = min J(theta; deviation) - min J(theta; FREE_DEVIATION),    LEAST_DEVIATION <= deviation <= FREE_DEVIATION

    Where G > MAX_GAIN, the input j is dead if the flown model with B[:, j] = 0 has a first J lower by more than MAX_GAIN, and a
    -sum log p at most DEAD_WITHIN above the changed one. Winds, and the angles at the begin of the record, are free in each J.
    Arguments: `deviation` of the entries by name, 1; `delays` of u by the outputs of a part, s, where it is not that of
    `actuation`.
    """
    found = []
    for block in blocks(filter_model(flown, actuation, recorded)):
        outputs = tuple(flown.outputs[i] for i in block.outputs)
        delay = (delays or {}).get(outputs, actuation.delay)
        search = _search(recorded, flown, actuation, block, delay)
        free = np.full(search.count, FREE_DEVIATION)
        near = np.clip([deviation.get(entry.name, 0.0) for entry in search.nominal_entries()], LEAST_DEVIATION, free)
        same, changed = _least(search, near), _least(search, free, starts=STARTS)
        if not np.array_equal(same.levels, changed.levels):
            # what another wind explains is no change: both hypotheses have the winds of both
            winds = same.levels, changed.levels
            same, changed = _less(same, _least(search, near, winds[1])), _less(changed, _least(search, free, winds[0]))
        dead, least = "", same.J - MAX_GAIN
        for name in search.names.inputs if least > changed.J else ():
            B = flown.matrix_b() * np.array([NO_EFFECT if column == name else 1.0 for column in flown.inputs])
            without = flown.with_matrices(flown.matrix_a(), B, np.ones((len(B), len(flown.gusts))))
            of_dead = _search(recorded, without, actuation, block, delay)
            held = _less(_least(of_dead, near), _least(of_dead, near, changed.levels))
            if least > held.J and held.cost < changed.cost + DEAD_WITHIN:
                dead, least = name, held.J
        found.append(Change(outputs, same.J - changed.J, dead))
    return tuple(found)


class Least(NamedTuple):
    """The least J of a hypothesis."""

    J: float
    cost: float  # -sum log p there
    levels: NDArray[np.int64]  # (spans,) of the wind


def _search(recorded: Recording, flown: Airframe, actuation: Actuation, block: Block, delay: float) -> Search:
    return Search(recorded, filter_model(flown, actuation, recorded), block, flown, delay, Unknown(angle=ANGLE))


def _least(search: Search, deviation: FloatArray, levels: NDArray[np.int64] | None = None, starts: Sequence[int] = ()) -> Least:
    """The least J with these standard deviations of the entries, in winds by theta or with `levels`."""
    search.believe(deviation)
    known = search.known()
    fit = search.fit(known, starts=starts, levels=levels)
    cost = -float(np.sum(fit.after.log_likelihood[known]))
    return Least(cost + float(np.sum((fit.theta / search.prior) ** 2)) / 2.0, cost, fit.levels)


def _less(first: Least, second: Least) -> Least:
    return min(first, second, key=lambda least: least.J)
