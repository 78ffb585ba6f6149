# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Define the margins that a loop must have, and search for gains with these margins.

Every required margin gives a `GainCondition`. The search computes the margins of every loop that it
tries.

The margins are computed for the sampled loop with actuators, delay and hold
(`flight_analysis.linear_loop.input_margins`). The values of 45 degrees and 6 dB come from
MIL-F-9490D, 3.1.3.6.1, for an aerodynamic surface. A sensitivity of at most 2 comes from K. J.
Astrom, R. M. Murray, "Feedback Systems", 12.3.
"""

import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import Generic, NamedTuple, TypeVar

import numpy as np

from flight_analysis.linear_loop.input_margins import Margins, input_margins
from flight_analysis.linear_loop.loop_margins import LinearLoop, LoopMargins
from flight_core.arguments import as_number
from flight_core.outcome import Refusal, joined
from flight_core.parameters import require
from flight_core.vectors import FloatArray
from flight_design.gains.airframe_properties import invariant_zeros
from flight_design.gains.constrained_search import (
    STEP,
    Assess,
    Moves,
    Place,
    Trial,
    descend,
    exponent,
)
from flight_design.gains.gain_conditions import GainCondition, Relation, failing
from flight_design.gains.linear_error import linear_error
from rise_di_controller.law.linear_loop import LinearLaw, LinearPlant
from rise_di_controller.params import ControllerConfig

Controller = TypeVar("Controller", bound=ControllerConfig)

PHASE_MARGIN = 45.0  # deg, the default
ACCEPTED_PHASE_MARGIN = 40.0  # deg: a requirement below this must be accepted explicitly
# deg, range of a required phase margin: a loop that integrates behind a lag has less than 90
PHASE_MARGINS = (5.0, 80.0)

# Largest factors by which the search divides the integral gain and the bandwidth. A throttle that
# has little effect near its stop has a bandwidth 200 times below the integral gain of the rule.
# With a factor of 1000, V still has a phase margin of 85 deg.
MAX_SLOWER = 1000.0
MAX_LOWER = 18.0
# Pairs of exponents of `slower` and `lower`, for all channels, at which further searches start.
FURTHER_STARTS = (
    (exponent(8.0), 0),
    (exponent(2.0), exponent(2.0)),
    (exponent(8.0), exponent(8.0)),
)
CHEAPER = ((-1, 0), (0, -1), (1, -1), (2, -1), (-3, 1))
MOVES = Moves(mending=(*CHEAPER, (-1, 1), (1, 0), (0, 1)), cheaper=CHEAPER)
"""Moves of the two exponents of a channel: a belongs to `slower`, and b to `lower`. The
error after a slow disturbance is proportional to slower lower^2, so only moves with a + 2 b <= 0
can lower the cost."""

NO_ERROR = 1e-12  # SI: an error below it costs nothing
# step by which the nominal phase margin is raised while the worst aircraft has too little
WORST_STEP = math.radians(2.5)
MAX_WORST_STEPS = 8

OF_ZERO = 0.98  # required damping as a fraction of the damping of the zeros
# 1/s. A zero closer than this to the origin or to the real axis is no oscillation.
NO_MOTION = 1e-3


class Requirement(NamedTuple):
    """The margins that a loop must have when it is opened at any one of its inputs."""

    phase: float = math.radians(PHASE_MARGIN)  # rad, nominal aircraft
    gain: float = 10.0 ** (6.0 / 20.0)  # factor, up or down: 6 dB
    sensitivity: float = 2.0  # the largest abs(S_ii)
    damping: float = 0.4  # damping ratio of the slow modes
    # rad, least phase margin over the samples of uncertain aircraft
    worst_phase: float = math.radians(30.0)
    # rad, least phase margin that a search over the corners of the uncertainty finds. Shipped loops
    # whose samples have 30 deg have at least this much at the corners.
    searched_phase: float = math.radians(28.0)

    @property
    def uncertain_phase(self) -> float:
        """Phase margin that the worst uncertain aircraft must have, rad.

        It is at most the phase margin that the nominal aircraft must have.
        """
        return min(self.worst_phase, self.phase)


NAMES = (
    "phase margin (deg)",
    "gain margin (dB)",
    "largest sensitivity",
    "damping of slow modes",
    "phase margin of the worst aircraft (deg)",
)
"""Names of the `margin_conditions` of a requirement."""

REQUIREMENT = Requirement()

OBSERVER_REQUIREMENT = Requirement(phase=math.radians(35.0))
"""Requirement for a loop with an observer, beside the delay margin: the observer is a filter in the
loop, and costs phase."""


def requirement(phase_margin: float, *, accept: bool = False) -> Requirement:
    """Build the requirement for a phase margin in deg.

    A phase margin below 40 deg raises ParameterError, unless `accept` says that it is intended.
    """
    phase_margin = as_number(phase_margin, "phase_margin", *PHASE_MARGINS, "deg")
    expected = f"at least {ACCEPTED_PHASE_MARGIN:g} deg, or accept beside it"
    require(accept or phase_margin >= ACCEPTED_PHASE_MARGIN, "phase_margin", phase_margin, expected)
    return Requirement(math.radians(phase_margin))


def above_zeros(requirement: Requirement, plant: LinearPlant) -> Requirement:
    """Lower the required damping ratio to what a loop around an aircraft can reach.

    The ratio becomes at most about the damping ratio of the aircraft's least damped zero. No
    feedback moves a zero, and a loop with small errors has modes near the zeros.
    """
    zeros = invariant_zeros(plant.A, plant.B, plant.C[: plant.B.shape[-1]])  # without vanes
    modes = zeros[(np.abs(zeros.imag) > NO_MOTION) & (np.abs(zeros) > NO_MOTION)]
    least = float(np.min(-modes.real / np.abs(modes), initial=1.0))
    return requirement._replace(damping=min(requirement.damping, OF_ZERO * max(least, 0.0)))


def fractions(
    margins: Margins, requirement: Requirement
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Compare the margins of m inputs with the required ones: found / required.

    A fraction is at least 1 if the margin meets the requirement. The first result, (..., m), is the
    smaller fraction of phase and sensitivity, the second, (..., m), is the fraction of the gain, in
    dB, and the third, (...), is the fraction of the damping.
    """
    with np.errstate(divide="ignore"):
        phase = np.minimum(
            margins.phase / requirement.phase, requirement.sensitivity / margins.sensitivity
        )
        return (
            phase,
            np.log(margins.gain) / math.log(requirement.gain),
            margins.damping / requirement.damping,
        )


def least_fractions(margins: Margins, requirement: Requirement) -> FloatArray:
    """Return the least of the `fractions` of each loop, (...).

    The result is at least 1 if the loop meets the requirement, and 0 for an unstable loop.
    """
    phase, gain, damping = fractions(margins, requirement)
    least = np.minimum(np.minimum(phase.min(axis=-1), gain.min(axis=-1)), damping)
    return np.asarray(np.where(margins.stable, least, 0.0))


def least_fraction(margins: Margins, requirement: Requirement) -> float:
    """Return the least of the `fractions` of a single loop."""
    return float(least_fractions(margins, requirement))


def margin_conditions(margins: LoopMargins, requirement: Requirement) -> tuple[GainCondition, ...]:
    """Return the requirement as conditions, input by input, beginning with the nominal aircraft."""
    nominal = nominal_conditions(margins.nominal, requirement)
    if margins.worst is None:
        return nominal
    worst = math.degrees(float(margins.worst.phase.min()))
    least = requirement.uncertain_phase
    if margins.is_searched:
        least = min(least, requirement.searched_phase)
    return (*nominal, GainCondition(NAMES[4], None, worst, math.degrees(least)))


def nominal_conditions(nominal: Margins, requirement: Requirement) -> tuple[GainCondition, ...]:
    """Return the requirement on the nominal aircraft as conditions, input by input."""
    with np.errstate(divide="ignore"):
        decibels = 20.0 * np.log10(nominal.gain)
    rows: list[tuple[str, FloatArray, float, Relation]] = [
        (NAMES[0], np.degrees(nominal.phase), math.degrees(requirement.phase), Relation.AT_LEAST),
        (NAMES[1], decibels, 20.0 * math.log10(requirement.gain), Relation.AT_LEAST),
        (NAMES[2], nominal.sensitivity, requirement.sensitivity, Relation.AT_MOST),
    ]
    by_input: list[GainCondition] = []
    for name, values, bound, relation in rows:
        by_input += [
            GainCondition(name=name, channel=i, value=float(value), bound=bound, relation=relation)
            for i, value in enumerate(values)
        ]
    return (*by_input, GainCondition(NAMES[3], None, float(nominal.damping), requirement.damping))


def reason_against_margins(
    margins: LoopMargins, requirement: Requirement, outputs: Sequence[str]
) -> Refusal | None:
    """Say which required margins a loop lacks, or return None if it lacks none.

    `outputs` are the names of the law's outputs.
    """
    return joined(
        Refusal(condition.sentence(outputs))
        for condition in failing(margin_conditions(margins, requirement))
    )


class Candidate(NamedTuple, Generic[Controller]):
    """A controller that the search tries, with its loop around nominal and uncertain aircraft."""

    controller: Controller
    loop: LinearLoop


def within_requirement(
    build: Callable[[FloatArray, FloatArray], Candidate[Controller]],
    requirement: Requirement,
    u_dot: FloatArray,
) -> Candidate[Controller]:
    """Search for the candidate with the least error among those that meet a requirement.

    If no candidate meets the requirement, the candidate with the least shortage is returned.

    `build(slower, lower)` makes a controller. It divides the integral gain by both factors, and the
    bandwidth by `lower`. Each factor has a value of 1 or more for each channel, (m,). If both
    factors are 1, the gains follow from the engineering procedure, the rule. The error is the
    product of the `linear_error` of all outputs along `u_dot`, (T, m), with inputs in the law's
    order. The required damping is lowered by `above_zeros`.

    The search begins with the bandwidths of the rule, and with the largest integral gains with
    which each channel has its margins. If a margin is missing at the end, the search tries other
    starts. While the phase margin of the worst uncertain aircraft is below `uncertain_phase`, the
    required phase margin of the nominal loop is raised in steps of 2.5 degrees.
    """
    loops = _Loops(build, u_dot)
    target = above_zeros(requirement, loops.start.loop.nominal)
    best = loops.search(target)
    for _ in range(MAX_WORST_STEPS):
        if (
            best.shortage
            or _worst_phase(best.content.candidate.loop) >= requirement.uncertain_phase
        ):
            break
        target = target._replace(phase=target.phase + WORST_STEP)
        following = loops.search(target)
        if following.shortage:
            break
        best = following
    return best.content.candidate


class _Measured(NamedTuple, Generic[Controller]):
    candidate: Candidate[Controller]
    reached: FloatArray  # (m,) least found / needed, for each channel alone


class _Loops(Generic[Controller]):
    """The loops of a search, each built and assessed once.

    A place is a point of the search: the exponents of `slower`, followed by the exponents of
    `lower`.
    """

    def __init__(
        self, build: Callable[[FloatArray, FloatArray], Candidate[Controller]], u_dot: FloatArray
    ) -> None:
        self._build = build
        self._u_dot = u_dot
        self._measured: dict[Place, tuple[Candidate[Controller], Margins]] = {}
        self._costs: dict[Place, float] = {}
        self.start = build(np.ones(1), np.ones(1))
        self.m = self.start.loop.law.D.shape[-2]
        self.highest = np.repeat([[exponent(MAX_SLOWER)], [exponent(MAX_LOWER)]], self.m, axis=1)

    def search(self, requirement: Requirement) -> Trial[_Measured[Controller]]:
        """Find the trial of least cost that meets a requirement, or the trial of least shortage."""
        assess = partial(self.assess, requirement)
        lowest = np.zeros_like(self.highest)
        best = descend(assess, self._fastest_integrals(assess), MOVES, lowest, self.highest)
        for slower, lower in FURTHER_STARTS:
            if best.shortage == 0.0:
                break
            place = np.minimum([[slower], [lower]], self.highest)
            (start,) = assess([tuple(place.ravel().tolist())])
            end = descend(assess, start, MOVES, lowest, self.highest)
            best = end if end.is_better(best) else best
        return best

    def assess(
        self, requirement: Requirement, places: Sequence[Place]
    ) -> list[Trial[_Measured[Controller]]]:
        """Evaluate the trials at some places."""
        self._measure([place for place in dict.fromkeys(places) if place not in self._measured])
        candidates = []
        shortages = []
        for place in places:
            candidate, margins = self._measured[place]
            phase, gain, damping = fractions(margins, requirement)
            # Each channel integrates, so its loop has a crossover. If none was found, it lies below
            # the frequencies that were evaluated, and the margin is unknown.
            is_certain = margins.stable & np.isfinite(margins.phase)
            fraction = np.where(is_certain, np.minimum(phase, gain), 0.0)
            goals = np.append(fraction, damping if margins.stable else 0.0)
            candidates.append(_Measured(candidate, fraction))
            shortages.append(float(np.maximum(1.0 - goals, 0.0).sum()))
        places_within = [
            place for place, shortage in zip(places, shortages, strict=True) if not shortage
        ]
        self._count_costs(
            [place for place in dict.fromkeys(places_within) if place not in self._costs]
        )
        return [
            Trial(place, shortage, math.inf if shortage else self._costs[place], row)
            for place, shortage, row in zip(places, shortages, candidates, strict=True)
        ]

    def _measure(self, places: Sequence[Place]) -> None:
        factors = [STEP ** np.reshape(place, (2, self.m)) for place in places]
        candidates = [self._build(slower, lower) for slower, lower in factors]
        if candidates:
            loop = _stacked(candidates)
            margins = input_margins(loop.nominal, loop.law, loop.loop, together=False)
            for k, (place, candidate) in enumerate(zip(places, candidates, strict=True)):
                self._measured[place] = candidate, margins.at(k)

    def _count_costs(self, places: Sequence[Place]) -> None:
        if places:
            loop = _stacked([self._measured[place][0] for place in places])
            errors = np.log(linear_error(loop, self._u_dot) + NO_ERROR)
            self._costs.update(zip(places, errors.sum(axis=-1).tolist(), strict=True))

    def _fastest_integrals(
        self, assess: Assess[_Measured[Controller]]
    ) -> Trial[_Measured[Controller]]:
        """Find the trial with the bandwidths of the rule and the largest possible integral gains.

        Here every channel alone must have its margins. A channel for which no integral gain
        suffices gets the integral gain of the rule.

        The exponents of all channels are doubled and bisected at once, because channels couple
        little. If the result lacks a margin, its channel gets a smaller integral gain, step by
        step.
        """
        highest = self.highest[0]
        rule = np.zeros(self.m, dtype=np.int64)
        short = rule - 1  # the largest exponents so far with which a margin is missing
        enough = highest + 1  # the least exponents so far with which no margin is missing
        tried = rule
        while True:
            (trial,) = assess([(*tried.tolist(), *rule.tolist())])
            has = trial.content.reached >= 1.0
            enough = np.where(has, np.minimum(enough, tried), enough)
            short = np.where(has, short, np.maximum(short, tried))
            unknown = enough - short > 1
            if not unknown.any():
                break
            doubled = np.minimum(2 * np.maximum(short, 0) + 1, highest)
            bisected = np.where(unknown, (short + enough) // 2, enough)
            tried = np.where(enough > highest, doubled, bisected)
        slower = np.where(enough > highest, 0, enough)
        (best,) = assess([(*slower.tolist(), *rule.tolist())])
        while (lacking := (best.content.reached < 1.0) & (enough <= highest)).any():
            slower = np.minimum(slower + lacking, highest)
            (following,) = assess([(*slower.tolist(), *rule.tolist())])
            if not following.is_better(best):
                break
            best = following
        return best


def _stacked(candidates: Sequence[Candidate[Controller]]) -> LinearLoop:
    """Join the loops of several candidates around the same aircraft into one with several laws."""
    laws = zip(*(candidate.loop.law for candidate in candidates), strict=True)
    return candidates[0].loop._replace(law=LinearLaw(*(np.stack(matrices) for matrices in laws)))


def _worst_phase(loop: LinearLoop) -> float:
    """Return the smallest phase margin of the uncertain aircraft, rad.

    It is infinite if the loop has only the nominal aircraft.
    """
    if len(loop.plant.A) == 1:
        return math.inf
    uncertain = loop.plant._replace(A=loop.plant.A[1:], B=loop.plant.B[1:])
    return float(input_margins(uncertain, loop.law, loop.loop, together=False).phase.min())
