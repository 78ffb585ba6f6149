# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Whether an aircraft has changed since its model was identified: a likelihood ratio over the last seconds of a flight."""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from aircraft_sim.airframe import Airframe
from flight_analysis.design.innovation_filters import TRANSIENT, Actuation, Recording, blocks, delayed, filter_model
from flight_analysis.design.model_identification import Fit, Search
from flight_core.vectors import FloatArray

RECORD = 10.0  # s, of the flight that is tested
LEAST_DEVIATION, FREE_DEVIATION = 0.03, 0.3  # 1, of an entry if the aircraft is the same, and if it has changed
MAX_GAIN = 15.0  # of log-likelihood: without a change 1 is usual and 10 was the largest of 80 tests; with a change 40 is usual
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
    recorded: Recording, flown: Airframe, actuation: Actuation, deviation: Mapping[str, float]
) -> tuple[Change, ...]:
    """The gain G of log-likelihood of each part of the aircraft by a change of its entries, and an input without effect.

        J(theta; s) = -sum log p(y_k | y_1 .. y_k-1, theta) + |theta / s|^2 / 2,    theta relative to the flown model
        G = min J(theta; max(deviation, LEAST_DEVIATION)) - min J(theta; FREE_DEVIATION)

    Where G > MAX_GAIN, the input j is dead if B[:, j] = 0 in the flown model has a J that is lower by more than MAX_GAIN, and
    at most DEAD_WITHIN above that of the refit. Arguments: `deviation` of the entries by name, 1.
    """
    recorded = recorded._replace(u=delayed(recorded.u, actuation.delay / recorded.period))
    model = filter_model(flown, actuation, recorded)
    known = np.isfinite(recorded.y).all(axis=1) & (recorded.t >= recorded.t[0] + TRANSIENT)
    found = []
    for block in blocks(model):
        search = Search(recorded, model, block, flown)

        def refit(s: FloatArray, search: Search = search) -> tuple[Fit, float]:
            search.believe(s)
            fit = search.fit(known, lambda: None)
            return fit, -float(np.sum(fit.after.log_likelihood[known])) + float(np.sum((fit.theta / search.prior) ** 2)) / 2.0

        def cost(theta: FloatArray, search: Search = search) -> float:
            return -float(np.sum(search.best_levels(theta).log_likelihood[known]))

        size = len(search.prior) - len(block.winds)
        free, changed = refit(np.full(size, FREE_DEVIATION))
        entries = search.entries(free)
        same = refit(np.array([max(deviation.get(entry.name, 0.0), LEAST_DEVIATION) for entry in entries]))[1]
        dead = ""
        if same - changed > MAX_GAIN:
            flown_cost, free_cost = cost(np.zeros(len(search.prior))), cost(free.theta)
            for name in search.names.inputs:
                without = [-float(entry.matrix == "B" and entry.column == name) for entry in entries]
                lost = cost(np.concatenate([without, np.zeros(len(block.winds))]))
                if flown_cost - lost > MAX_GAIN and lost < free_cost + DEAD_WITHIN:
                    dead = name
        found.append(Change(search.names.outputs, same - changed, dead))
    return tuple(found)
