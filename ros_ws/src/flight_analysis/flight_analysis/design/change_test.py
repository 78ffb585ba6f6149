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
EXACT = 1e-4  # 1, standard deviation of an entry that is what it is
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
        G = min J(theta; max(deviation, LEAST_DEVIATION)) - min J(theta; FREE_DEVIATION)

    Where G > MAX_GAIN, the input j is dead if B[:, j] = 0 in the flown model has a J that is lower by more than MAX_GAIN, and
    at most DEAD_WITHIN above that of the refit. Winds, and the angles at the begin of the record, are free in each J.
    Arguments: `deviation` of the entries by name, 1; `delays` of u by the outputs of a part, s, where it is not that of
    `actuation`.
    """
    found = []
    for block in blocks(filter_model(flown, actuation, recorded)):
        outputs = tuple(flown.outputs[i] for i in block.outputs)
        delay = (delays or {}).get(outputs, actuation.delay)
        search = _search(recorded, flown, actuation, block, delay)
        near = np.array([max(deviation.get(entry.name, 0.0), LEAST_DEVIATION) for entry in search.nominal_entries()])
        changed, changed_cost, levels = _least(search, np.full(search.count, FREE_DEVIATION), STARTS)
        same, _, _ = _least(search, near, levels=levels)
        dead = ""
        if same - changed > MAX_GAIN:
            _, flown_cost, _ = _least(search, np.full(search.count, EXACT), levels=levels)
            for name in search.names.inputs:
                B = flown.matrix_b() * np.array([NO_EFFECT if column == name else 1.0 for column in flown.inputs])
                without = flown.with_matrices(flown.matrix_a(), B, np.ones((len(B), len(flown.gusts))))
                of_dead = _search(recorded, without, actuation, block, delay)
                _, cost, _ = _least(of_dead, np.full(of_dead.count, EXACT), levels=levels)
                if flown_cost - cost > MAX_GAIN and cost < changed_cost + DEAD_WITHIN:
                    dead = name
        found.append(Change(outputs, same - changed, dead))
    return tuple(found)


def _search(recorded: Recording, flown: Airframe, actuation: Actuation, block: Block, delay: float) -> Search:
    return Search(recorded, filter_model(flown, actuation, recorded), block, flown, delay, Unknown(angle=ANGLE))


def _least(
    search: Search, deviation: FloatArray, starts: Sequence[int] = (), levels: NDArray[np.int64] | None = None
) -> tuple[float, float, NDArray[np.int64]]:
    """The least J with these standard deviations of the entries, the -sum log p there, and the levels of the wind.

    Also with `levels`, of an alternative hypothesis: another wind is no change.
    """
    search.believe(deviation)
    known, found = search.known(), []
    for each in (None,) if levels is None else (None, levels):
        fit = search.fit(known, starts=starts, levels=each)
        cost = -float(np.sum(fit.after.log_likelihood[known]))
        found.append((cost + float(np.sum((fit.theta / search.prior) ** 2)) / 2.0, cost, fit.levels))
    return min(found, key=lambda least: least[0])
