# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test by a likelihood ratio whether inputs have lost effect since the model was identified."""

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
from flight_design.identification.model_refusals import MAX_DEVIATION

# s, length of the record that is tested. With 10 s, losses were found up to 4 s later, and halved
# effects were not found at all.
RECORD = 4.0
# Share of an input's effect. A loss of at most this share is taken as no change, since an accepted
# model may be wrong by this much: it is twice the largest standard deviation of its effects.
LOSS = 2.0 * MAX_DEVIATION
# Gain of log-likelihood above which a change is found. It stands for 4.9 standard deviations, see
# `change_test`. Healthy surfaces with a gust every 3 s had gains up to 10.3, and once 17.4, because
# a gust is no normal process. Surfaces with half their effect had gains of 18 and more.
MAX_GAIN = 12.0
# rad, standard deviation of pitch and bank at the beginning of the record, which may be in a turn
ANGLE = 0.3
# rad, standard deviation of alpha and beta at the beginning. With 0.3 rad, a gust before the record
# looked like a loss.
FLOW = 0.03
# Prior standard deviation of the relative change of an effect, in both hypotheses. With it, half of
# the effect and none of it are about equally probable.
FACTOR = 1.0
REVERSED = -2.0  # least relative change of an effect: the input acts the other way
DEAD = -1.0  # relative change of an effect that is lost
MOST = 2.0  # largest relative change of an effect
# Largest share of an effect that is taken as none. An accepted model may have a standard deviation
# as large as this.
NONE = MAX_DEVIATION
# A reversed effect of at most this share is taken as none. No surface reverses in flight, but a
# surface that is jammed off centre pushes steadily against the u that is to balance it. If it is
# jammed at 5 deg while u is at its stop of 30 deg, it looks like an effect of -17 %. This effect
# has a standard deviation of only 1 %, so a limit in standard deviations would not help.
OFF_CENTRE = 0.25
# Difference of log-likelihood up to which an input without effect explains the flight as well as
# the best loss does.
DEAD_WITHIN = 4.0


class Change(NamedTuple):
    """Result of a test for changes of one part of the aircraft.

    A part is a group of states and inputs that does not couple with the rest.
    """

    outputs: tuple[str, ...]
    gain: float  # log-likelihood that is gained if effects may fall by more than LOSS
    # most probable effect of each input, as a share of its effect in the model
    left: Mapping[str, float]
    dead: str  # the input that has no effect any more; empty if there is none

    @property
    def is_found(self) -> bool:
        """Whether the test finds that the part has changed."""
        return self.gain > MAX_GAIN


def change_test(
    recorded: FlightData,
    flown: Airframe,
    actuation: Actuation,
    delays: Mapping[tuple[str, ...], FloatArray] | None = None,
    drift: float = DRIFT,
) -> tuple[Change, ...]:
    """Test each part for a loss of effect, by the log-likelihood G that such a loss would gain.

        B[:, j] = (1 + kappa_j) B_flown[:, j]
        J(kappa) = N/2 sum_i log mean e_i^2 + 1/2 sum log det S + |kappa / FACTOR|^2 / 2
        G = min J(kappa_j >= -LOSS) - min J(kappa_j >= -2)

    with the normalised innovations e and their covariance S, as in `Search.fit`. A fault of an
    effector multiplies its column of B by a factor, so a part (a group of states and inputs that
    does not couple with the rest) has as many unknown factors as inputs. A is known. The winds and
    the angles at the beginning are also free. Each minimum is also sought with the levels of the
    wind that belong to the other minimum, so that no difference in the wind passes for a loss.

    G is 0 while the losses are within LOSS. If a loss is z standard deviations larger than LOSS, 2
    G = z^2, by S. S. Wilks (Ann. Math. Statist. 9(1), 1938). In one test a single input with a loss
    of LOSS gives a G above 12 with a probability of 5e-7. For two such inputs together the
    probability is 2e-6, and for smaller losses it is smaller.

    The input j is dead if the minimum of J for -OFF_CENTRE <= kappa_j + 1 <= NONE meets two
    conditions. This minimum is lower than the first minimum in G by more than MAX_GAIN, and at most
    DEAD_WITHIN above the second minimum in G. `delays` has the delays of u, s, by the outputs of a
    part. The default is the delay of `actuation`. `drift` is the noise of the disturbances, as in
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
            # A loss that another wind explains as well is no change.
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
    """The least J under a hypothesis, and the parameters for which J is least."""

    J: float
    # (p,) kappa of each input, logarithm of the strength of each wind, angles at the beginning
    theta: FloatArray
    levels: NDArray[np.int64]  # (spans,) levels of the wind


class Effects(Search):
    """The search for the factor by which each column of B has changed in a part of the aircraft."""

    def __init__(
        self,
        recorded: FlightData,
        flown: Airframe,
        actuation: Actuation,
        block: Block,
        delay: float | FloatArray,
        drift: float = DRIFT,
    ) -> None:
        """Set up the search. `delay` is the delay of u, s, `drift` the noise of disturbances."""
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
        """Return the flown model with the effects of its inputs changed by thetas, (N, p)."""
        A, wind = (
            np.repeat(matrix, len(thetas), axis=0) for matrix in (self._flown.A, self._flown.wind)
        )
        return self._flown._replace(
            A=A, B=self._flown.B * (1.0 + thetas[:, None, : self.count]), wind=wind
        )

    def most_probable(self, lower: float = REVERSED) -> Least:
        """Find the least J if every kappa is at least `lower`.

        With the winds that fit the flown model, a loss of effect may pass for gusts. Therefore the
        search has several starts: these winds, the same wind in every span, and each input dead.
        The end of a start with a dead input is ignored if its J exceeds the least J by CLOSE or
        more.
        """
        same = self.least(lower=lower, levels=np.full(len(self._spans), TURBULENT))
        best = least_of(self.least(lower=lower), self.least(same.theta, lower))
        for j in range(self.count):
            theta = np.where(np.arange(len(self.prior)) == j, DEAD, 0.0)
            if self.cost(theta, self.is_known()) < best.J + CLOSE:
                best = least_of(best, self.least(theta, lower))
        return best

    def least(
        self,
        theta: FloatArray | None = None,
        lower: float = REVERSED,
        dead: int | None = None,
        levels: NDArray[np.int64] | None = None,
    ) -> Least:
        """Minimise the J of `change_test`, beginning at theta, (p,), or at 0 if theta is None.

        Every kappa is at least `lower`. The input with the index `dead` has no effect. At each step
        the levels of the wind follow from theta, unless `levels` gives them.
        """
        self._lower[: self.count] = lower
        self._upper[: self.count] = MOST
        if dead is not None:
            self._lower[dead] = DEAD - OFF_CENTRE
            self._upper[dead] = DEAD + NONE
        theta = np.clip(
            np.zeros(len(self.prior)) if theta is None else theta, self._lower, self._upper
        )
        used = self.is_known()
        free = np.ones(len(theta), dtype=bool)
        for _ in range(STEPS):
            winds = self.levels(theta) if levels is None else levels
            theta, _, progressed = self._step(theta, winds, used, free)
            if progressed < PROGRESS:
                break
        (J,), _, _ = self._costs(self.passed(theta, winds), used, theta[None])
        return Least(float(J), theta, winds)


def least_of(first: Least, second: Least) -> Least:
    """Return the result with the lower J."""
    return min(first, second, key=lambda least: least.J)
