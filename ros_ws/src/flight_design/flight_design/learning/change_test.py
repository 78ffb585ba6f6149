# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Whether inputs have lost effect since the model was identified: a likelihood ratio."""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from aircraft_sim.airframes.airframe import Airframe
from control_laws.nominal_model import NominalModel
from flight_core.vectors import FloatArray
from flight_design.identification.innovation_filters import (
    DRIFT,
    Actuation,
    Block,
    FlightData,
    blocks,
    filter_model,
    in_rolling_air,
)
from flight_design.identification.likelihood import Unknown
from flight_design.identification.likelihood_search import (
    CLOSE,
    PROGRESS,
    STEPS,
    TURBULENT,
    Search,
)
from flight_design.identification.model_quality import MAX_DEVIATION

# s, of the flight that is tested: with 10 s losses showed up to 4 s later, and halved effects not
RECORD = 4.0
# 1, of the effect of an input: up to two deviations of an accepted model are no change
LOSS = 2.0 * MAX_DEVIATION
# of log-likelihood: 4.9 standard deviations, see `change_test`. Healthy surfaces in a gust every
# 3 s had up to 10.3, once 17.4, for a gust is no normal process; those of half effect from 18 on
MAX_GAIN = 12.0
# rad, standard deviation of pitch and bank at the begin of the record, which may lie in a turn
ANGLE = 0.3
# rad, the same of alpha and beta: with 0.3 a gust before the record passed for a loss of effect
FLOW = 0.03
# 1, standard deviation of a change of effect, in both hypotheses: half of it and none are as
# probable
FACTOR = 1.0
REVERSED = -2.0  # 1, the least change of effect: the input acts the other way
DEAD = -1.0  # 1
MOST = 2.0  # 1, the largest change of effect
NONE = MAX_DEVIATION  # 1, of an effect: what is known no better is none
# of log-likelihood: so close to the best loss an input without effect explains the flight as well
DEAD_WITHIN = 4.0


class Change(NamedTuple):
    """The test of a part of the aircraft without coupling with the rest."""

    outputs: tuple[str, ...]
    gain: float  # of log-likelihood by a loss of effect beyond LOSS
    # 1, the most probable effect of each input in parts of that of the model
    left: Mapping[str, float]
    dead: str  # the input without any effect; empty where there is none

    @property
    def is_found(self) -> bool:
        """Whether the part has changed."""
        return self.gain > MAX_GAIN


def change_test(
    recorded: FlightData,
    flown: Airframe,
    actuation: Actuation,
    delays: Mapping[tuple[str, ...], FloatArray] | None = None,
    drift: float = DRIFT,
) -> tuple[Change, ...]:
    """Test the parts for a loss of effect, by the gain of log-likelihood G that one brings.

        B[:, j] = (1 + kappa_j) B_flown[:, j]
        J(kappa) = N/2 sum_i log mean e_i^2 + 1/2 sum log det S + |kappa / FACTOR|^2 / 2
        G = min J(kappa_j >= -LOSS) - min J(kappa_j >= -2)

    with e the normalised innovations and S their covariance, as in `Search.fit`. A fault of an
    effector changes a column by a factor, so a part has as many unknowns as inputs. A is known.
    Winds, and angles at the begin, are free in the two J, which have the same winds. G is 0 while
    the losses are within LOSS. For a loss z standard deviations beyond, 2 G = z^2, by S. S. Wilks
    (Ann. Math. Statist. 9(1), 1938): an input with a loss of LOSS exceeds G = 12 with a probability
    of 5e-7, and a lesser loss more seldom.

    The input j is dead if abs(kappa_j + 1) <= NONE has a J lower than the first J by more than
    MAX_GAIN, and at most DEAD_WITHIN above the second. Arguments: `delays` of u by the outputs of a
    part, s, by default the delay of `actuation`; `drift` is the noise of the disturbances, as in
    `Unknown`.
    """
    changes = []
    flown = in_rolling_air(flown)
    for block in blocks(filter_model(flown, actuation, recorded)):
        outputs = tuple(flown.outputs[i] for i in block.outputs)
        delay = (delays or {}).get(outputs, actuation.delay)
        effects = Effects(recorded, flown, actuation, block, delay, drift)
        inputs = effects.names.inputs
        gain = 0.0
        dead = ""
        lost = effects.most_probable()
        if lost.theta[: len(inputs)].min() < -LOSS:
            # what another wind explains is no change
            kept = least_of(
                effects.most_probable(-LOSS), effects.least(lost.theta, -LOSS, levels=lost.levels)
            )
            lost = least_of(lost, effects.least(lost.theta, levels=kept.levels))
            gain = kept.J - lost.J
            without = [
                effects.least(lost.theta, dead=j, levels=lost.levels).J for j in range(len(inputs))
            ]
            if min(without) < min(kept.J - MAX_GAIN, lost.J + DEAD_WITHIN):
                dead = inputs[int(np.argmin(without))]
        left = dict(zip(inputs, (1.0 + lost.theta).tolist(), strict=False))
        changes.append(Change(outputs, gain, left, dead))
    return tuple(changes)


class Least(NamedTuple):
    """The least J of a hypothesis."""

    J: float
    # (p,) kappa of the inputs, logarithms of the strengths of the winds, angles at the begin
    theta: FloatArray
    levels: NDArray[np.int64]  # (spans,) of the wind


class Effects(Search):
    """The search for a factor of every column of B of a part."""

    def __init__(
        self,
        recorded: FlightData,
        flown: Airframe,
        actuation: Actuation,
        block: Block,
        delay: float | FloatArray,
        drift: float = DRIFT,
    ) -> None:
        """`delay` of u, s, and the noise of the disturbances."""
        model = filter_model(flown, actuation, recorded)
        unknown = Unknown(angle=ANGLE, drift=drift)
        super().__init__(recorded, model, block, flown, delay, unknown, factor=1)
        self._flown = super().with_errors(np.zeros((1, len(self.prior))))
        self._angles = np.flatnonzero(~model.C[np.ix_(block.outputs, block.states)].any(axis=0))
        self.believe(np.ones(self.count))
        entries = self.count
        self.count = len(block.inputs)
        self.prior, self._lower, self._upper = (
            np.concatenate([np.full(self.count, of_inputs), values[entries:]])
            for of_inputs, values in (
                (FACTOR, self.prior),
                (REVERSED, self._lower),
                (MOST, self._upper),
            )
        )
        self.centre = np.zeros(len(self.prior))
        self._errors = np.arange(len(self.prior)) < self.count
        self._winds, self._shear, self._begin = (
            slice(part.start - entries + self.count, part.stop - entries + self.count)
            for part in (self._winds, self._shear, self._begin)
        )
        turned = np.any(self._model.gravity[:, self._angles], axis=0)
        self.prior[self._begin] = np.where(turned, 1.0, FLOW / ANGLE)

    def with_errors(self, thetas: FloatArray) -> NominalModel:
        """Return the flown model with other effects of its inputs, thetas (N, p)."""
        A, wind = (
            np.repeat(matrix, len(thetas), axis=0) for matrix in (self._flown.A, self._flown.wind)
        )
        return self._flown._replace(
            A=A, B=self._flown.B * (1.0 + thetas[:, None, : self.count]), wind=wind
        )

    def most_probable(self, lower: float = REVERSED) -> Least:
        """Find the least J of kappa >= `lower`.

        The flown model takes a loss for gusts. So the search begins with the winds of this model,
        with the same wind in every span, and also with a dead input if its J is CLOSE.
        """
        same = self.least(lower=lower, levels=np.full(len(self._spans), TURBULENT))
        best = least_of(self.least(lower=lower), self.least(same.theta, lower))
        for j in range(self.count):
            theta = np.where(np.arange(len(self.prior)) == j, DEAD, 0.0)
            if self.cost(theta, self.known()) < best.J + CLOSE:
                best = least_of(best, self.least(theta, lower))
        return best

    def least(
        self,
        theta: FloatArray | None = None,
        lower: float = REVERSED,
        dead: int | None = None,
        levels: NDArray[np.int64] | None = None,
    ) -> Least:
        """Minimise J from theta, (p,), or 0 on, for kappa >= `lower` or with one input dead.

        The winds are those by theta, unless `levels` gives them.
        """
        self._lower[: self.count] = lower
        self._upper[: self.count] = MOST
        if dead is not None:
            self._lower[dead] = DEAD - NONE
            self._upper[dead] = DEAD + NONE
        theta = np.clip(
            np.zeros(len(self.prior)) if theta is None else theta, self._lower, self._upper
        )
        used = self.known()
        free = np.ones(len(theta), dtype=bool)
        for _ in range(STEPS):
            winds = self.levels(theta) if levels is None else levels
            theta, _, progressed = self._step(theta, winds, used, free)
            if progressed < PROGRESS:
                break
        (J,), _, _ = self._costs(self.passed(theta, winds), used, theta[None])
        return Least(float(J), theta, winds)


def least_of(first: Least, second: Least) -> Least:
    """Return the lesser J."""
    return min(first, second, key=lambda least: least.J)
