# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""The margins that a loop has to have, as conditions, and the search for gains whose measured
margins meet the requirement.

The margins are those of the sampled loop with actuators, delay and hold
(`rise_di_controller.margins`). 45 degrees and 6 dB are those of MIL-F-9490D, 3.1.3.6.1, for an
aerodynamic surface, a sensitivity of at most 2 that of K. J. Astrom, R. M. Murray, "Feedback
Systems", 12.3.
"""

import math
from collections.abc import Callable, Sequence
from typing import Generic, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from flight_analysis.closed_loop.loop_margins import LinearLoop, LoopMargins
from flight_core.arguments import as_number
from flight_core.parameters import require
from flight_core.vectors import FloatArray
from flight_design.gains.airframe_properties import invariant_zeros
from flight_design.gains.gain_conditions import Condition, failing
from rise_di_controller.linear_loop import LinearPlant
from rise_di_controller.margins import Margins, loop_margins
from rise_di_controller.params import ControllerConfig

Controller = TypeVar("Controller", bound=ControllerConfig)

PHASE_MARGIN = 45.0  # deg, the default
ACCEPTED_PHASE_MARGIN = 40.0  # deg: a requirement below this has to be accepted by name
PHASE_MARGINS = (
    5.0,
    80.0,
)  # deg, the range of a requirement: a loop that integrates behind a lag has less than 90

STEP = 1.05  # factor of the integral, and of the bandwidth, in a step of the search
MAX_SLOWER = 4.0  # largest factors of the search
MAX_LOWER = 18.0  # by which the integral and the bandwidth fall
WORST_STEP = math.radians(
    2.5
)  # by which the nominal phase margin rises while the worst aircraft has too little
MAX_WORST_STEPS = 8

OF_ZERO = 0.98  # of the damping of a zero that is asked for; 1/s
NO_MOTION = 1e-3  # of a zero at the origin up to rounding


class Requirement(NamedTuple):
    """The least margins of a loop, with one input open and with the worst input counting."""

    phase: float = math.radians(PHASE_MARGIN)  # rad, nominal aircraft
    gain: float = 10.0 ** (6.0 / 20.0)  # factor, up or down: 6 dB
    sensitivity: float = 2.0  # the largest abs(S_ii)
    damping: float = 0.4  # of the slow modes
    worst_phase: float = math.radians(30.0)  # rad, of the uncertain aircraft, by samples
    # by search over the corners: what 30 deg of uniform samples leave there in the shipped loops
    searched_phase: float = math.radians(28.0)

    @property
    def uncertain_phase(self) -> float:
        """Phase margin of the worst uncertain aircraft, rad: never above what is asked of the
        nominal aircraft.
        """
        return min(self.worst_phase, self.phase)


NAMES = (
    "phase margin (deg)",
    "gain margin (dB)",
    "largest sensitivity",
    "damping of slow modes",
    "phase margin of the worst aircraft (deg)",
)
"""Names of the `conditions` of a requirement."""

REQUIREMENT = Requirement()

OBSERVER_REQUIREMENT = Requirement(phase=math.radians(35.0))
"""Of a loop with an observer, beside the delay margin: the observer is a filter in the loop, and
costs phase."""


def requirement(phase_margin: float, *, accept: bool = False) -> Requirement:
    """The requirement with a phase margin in deg. Raises ParameterError for less than 40 deg
    without `accept`.
    """
    phase_margin = as_number(phase_margin, "phase_margin", *PHASE_MARGINS, "deg")
    expected = f"at least {ACCEPTED_PHASE_MARGIN:g} deg, or accept beside it"
    require(accept or phase_margin >= ACCEPTED_PHASE_MARGIN, "phase_margin", phase_margin, expected)
    return Requirement(math.radians(phase_margin))


def above_zeros(needed: Requirement, plant: LinearPlant) -> Requirement:
    """A requirement with a damping within reach of a loop around an aircraft: at most about the
    damping of the zeros.

    No feedback moves a zero, and a loop with small errors has modes near the zeros.
    """
    zeros = invariant_zeros(plant.A, plant.B, plant.C[: plant.B.shape[-1]])  # without vanes
    modes = zeros[(np.abs(zeros.imag) > NO_MOTION) & (np.abs(zeros) > NO_MOTION)]
    least = float(np.min(-modes.real / np.abs(modes), initial=1.0))
    return needed._replace(damping=min(needed.damping, OF_ZERO * max(least, 0.0)))


def fractions(margins: Margins, needed: Requirement) -> tuple[FloatArray, FloatArray, FloatArray]:
    """What is found over what is needed, at least 1 where the requirement holds, for m inputs,
    (..., m), (..., m), (...).

    The first is the lesser of phase and sensitivity, the second that of the gain, in dB, the third
    that of the damping.
    """
    with np.errstate(divide="ignore"):
        phase = np.minimum(margins.phase / needed.phase, needed.sensitivity / margins.sensitivity)
        return phase, np.log(margins.gain) / math.log(needed.gain), margins.damping / needed.damping


def least_fractions(margins: Margins, needed: Requirement) -> FloatArray:
    """The least of `fractions` of each loop, (...): at least 1 where the requirement holds, 0 for
    an unstable loop.
    """
    phase, gain, damping = fractions(margins, needed)
    least = np.minimum(np.minimum(phase.min(axis=-1), gain.min(axis=-1)), damping)
    return np.asarray(np.where(margins.stable, least, 0.0))


def least_fraction(margins: Margins, needed: Requirement) -> float:
    """The `least_fractions` of one loop."""
    return float(least_fractions(margins, needed))


def conditions(margins: LoopMargins, needed: Requirement) -> tuple[Condition, ...]:
    """The requirement as conditions, input by input, the nominal aircraft first."""
    nominal = nominal_conditions(margins.nominal, needed)
    if margins.worst is None:
        return nominal
    worst = math.degrees(float(margins.worst.phase.min()))
    least = needed.uncertain_phase
    if margins.by_search:
        least = min(least, needed.searched_phase)
    return (*nominal, Condition(NAMES[4], None, worst, math.degrees(least)))


def nominal_conditions(nominal: Margins, needed: Requirement) -> tuple[Condition, ...]:
    """The requirement on the margins of the nominal aircraft as conditions, input by input."""
    with np.errstate(divide="ignore"):
        decibels = 20.0 * np.log10(nominal.gain)
    rows: list[tuple[str, FloatArray, float, bool]] = [
        (NAMES[0], np.degrees(nominal.phase), math.degrees(needed.phase), True),
        (NAMES[1], decibels, 20.0 * math.log10(needed.gain), True),
        (NAMES[2], nominal.sensitivity, needed.sensitivity, False),
    ]
    by_input: list[Condition] = []
    for name, values, bound, at_least in rows:
        by_input += [
            Condition(name, i, float(value), bound, at_least) for i, value in enumerate(values)
        ]
    return (*by_input, Condition(NAMES[3], None, float(nominal.damping), needed.damping))


def unmet(margins: LoopMargins, needed: Requirement, outputs: Sequence[str]) -> str:
    """What a loop lacks, in sentences; "" for nothing. `outputs` of the law."""
    return "; ".join(
        condition.sentence(outputs) for condition in failing(conditions(margins, needed))
    )


class Candidate(NamedTuple, Generic[Controller]):
    """A controller of the search and the loop of the nominal and uncertain aircraft."""

    controller: Controller
    loop: LinearLoop


def within_requirement(
    build: Callable[[FloatArray, FloatArray], Candidate[Controller]], needed: Requirement
) -> Candidate[Controller]:
    """The first candidate whose measured margins meet a requirement; the nearest where none does.

    `build(slower, lower)` gives a controller with the integral slower by both factors, the
    bandwidth lower by the second, a factor a channel, (m,).
    A channel with too little phase margin or too large a sensitivity gets a slower integral by
    steps of 5 %, down to a fourth; one with too little gain margin, or with the slowest integral, a
    lower bandwidth. Too little damping counts for the channel with the smallest phase margin. While
    the worst uncertain aircraft has less than `worst_phase`, the nominal loop has to have 2.5
    degrees more.
    """
    target = needed
    best = _nominal_search(build, target)
    for _ in range(MAX_WORST_STEPS):
        if best.fraction < 1.0 or _worst_phase(best.candidate.loop) >= needed.uncertain_phase:
            break
        target = target._replace(phase=target.phase + WORST_STEP)
        following = _nominal_search(build, target, best.slower, best.lower)
        if following.fraction < 1.0:
            break
        best = following
    return best.candidate


class _Reached(NamedTuple, Generic[Controller]):
    candidate: Candidate[Controller]
    slower: FloatArray  # (m,)
    lower: FloatArray  # (m,)
    fraction: float  # `least_fraction`


def _nominal_search(
    build: Callable[[FloatArray, FloatArray], Candidate[Controller]],
    needed: Requirement,
    slower: FloatArray | None = None,
    lower: FloatArray | None = None,
) -> _Reached[Controller]:
    slower = np.ones(1) if slower is None else slower
    lower = np.ones(1) if lower is None else lower
    best: _Reached[Controller] | None = None
    while True:
        candidate = build(slower, lower)
        margins = loop_margins(
            candidate.loop.nominal, candidate.loop.law, candidate.loop.loop, together=False
        )
        fraction = least_fraction(margins, needed)
        if best is None or fraction > best.fraction:
            best = _Reached(candidate, slower, lower, fraction)
        if fraction >= 1.0 or lower.max() > MAX_LOWER:
            return best
        slower = np.broadcast_to(slower, margins.phase.shape)
        lower = np.broadcast_to(lower, margins.phase.shape)
        integral, bandwidth = _short(margins, needed)
        bandwidth |= integral & (slower >= MAX_SLOWER)
        slower = np.where(integral & ~bandwidth, STEP * slower, slower)
        lower = np.where(bandwidth, STEP * lower, lower)


def _short(margins: Margins, needed: Requirement) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Channels that need a slower integral, and channels that need a lower bandwidth, (m,)."""
    phase, gain, damping = fractions(margins, needed)
    integral = phase < 1.0
    bandwidth = gain < 1.0
    if damping < 1.0 and not (integral | bandwidth).any():
        integral = np.arange(len(phase)) == int(np.argmin(phase))
    return np.asarray(integral), np.asarray(bandwidth)


def _worst_phase(loop: LinearLoop) -> float:
    """Smallest phase margin of the uncertain aircraft, rad; infinite without any."""
    if len(loop.plant.A) == 1:
        return math.inf
    uncertain = loop.plant._replace(A=loop.plant.A[1:], B=loop.plant.B[1:])
    return float(loop_margins(uncertain, loop.law, loop.loop, together=False).phase.min())
