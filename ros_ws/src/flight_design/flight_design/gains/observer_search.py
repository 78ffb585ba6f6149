# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Search for the factors on the gains of a law with an observer that give the least error.

The loop must have the required margins. The factor of a channel is its relaxation. It divides K and
the integral gain, and multiplies the observer's weight `effort`. A relaxation above 1 makes the
loop slower, and one below 1 makes it faster. A relaxation above or below 1 may be needed, because
the inputs of an aircraft may act less or more than the inputs of the aircraft for which the gains
were found.
"""

import math
from collections.abc import Callable, Sequence
from itertools import product
from typing import Any, NamedTuple

import numpy as np

from control_laws.nominal_model import NominalModel
from control_laws.observer_design import ObserverDesign
from flight_analysis.linear_loop.delay_margin import delay_margin
from flight_analysis.linear_loop.input_margins import input_margins, phase_margins
from flight_analysis.linear_loop.loop_margins import loop_of
from flight_core.outcome import Refusal, joined
from flight_core.parameters import ParameterError, require
from flight_core.vectors import FloatArray
from flight_design.gains.constrained_search import (
    GAIN,
    STEP,
    Moves,
    Place,
    Trial,
    descend,
    exponent,
)
from flight_design.gains.gain_conditions import MIN_K, GainCondition, failing
from flight_design.gains.linear_error import Air, air_response
from flight_design.gains.nominal import ERROR_SHARE
from flight_design.gains.observer_gains import ObserverGains
from flight_design.gains.requirement import (
    Requirement,
    above_zeros,
    fractions,
    nominal_conditions,
)
from rise_di_controller.extensions.model_sections import (
    FeedforwardConfig,
    ObserverConfig,
    VanesConfig,
)
from rise_di_controller.extensions.observer import without_frozen
from rise_di_controller.law.control_law import TunedLaw
from rise_di_controller.law.law import MIN_GAIN, gain
from rise_di_controller.law.linear_loop import (
    LinearLaw,
    LinearPlant,
    LoopTiming,
    is_stable,
    linear_law,
    spectral_radius,
)
from rise_di_controller.rise_di_config import RiseDiConfig, SpeedConfig

MOVES = Moves(mending=((1,),), cheaper=((-1,), (1,)), begin=4, is_joint=True)
SLOWER = Moves(mending=((1,),), cheaper=((-1,),), is_joint=True)
"""Moves of the relaxation of a channel. MOVES may lower the cost by more or by less relaxation.
SLOWER relaxes only where the margins need it."""

# s, resolution of the delay margin; the rounding of gains in a file changes the margin by less
RESOLUTION = 3e-4

MAX_RELAXATION = 18.0  # largest relaxation of a channel
# 1 / least relaxation of a channel, for inputs that have a fourth of the effect
MAX_QUICKENING = 4.0
MEND = (
    "give the loop less delay or lag, ask for a smaller delay margin, or fly the law without "
    "an observer"
)
WORST_OF = 50  # number of uncertain aircraft whose least phase margin counts


class SelectedObserver(NamedTuple):
    """A controller with an observer, and the delay and phase margins of its loop."""

    controller: RiseDiConfig
    # s, delay margin of the nominal linear loop; it includes the declared delay
    delay_margin: float
    phase_margin: float  # rad, least phase margin of the nominal linear loop
    # (m,) factors by which `effort` is multiplied, and by which K and the integral are divided
    relaxation: FloatArray
    cost: float  # logarithm of error and activity in wind and noise
    place: int = 0  # index of the gain set from which the search began
    origin: str = ""  # a sentence on where the gains come from
    left_out: int = 0  # number of uncertain aircraft that no gains can hold

    def not_counted(self) -> str:
        """Say how many uncertain aircraft were left out of the margins; return "" if none was.

        An aircraft is left out if it diverges under any gains while its outputs are held.
        """
        if not self.left_out:
            return ""
        return (
            f"; {self.left_out} of {WORST_OF} uncertain aircraft do not count: they diverge while "
            f"{', '.join(self.controller.outputs)} are held, under any gains"
        )


class AtSpeed(NamedTuple):
    """An observer that is designed for another airspeed, `ratio` times the trim speed."""

    ratio: float
    plant: LinearPlant
    feedforward: FeedforwardConfig
    scale: FloatArray  # (m,) factors on input_scale
    design: Callable[[FloatArray], ObserverDesign]

    def model(self, slower: FloatArray) -> SpeedConfig:
        """Return the models of feedforward and observer at this speed."""
        nominal = {key: getattr(self.feedforward, key) for key in ("A", "B", "gravity")}
        return SpeedConfig(ratio=self.ratio, **nominal, **_matrices(self.design(slower)))

    def flown(self, controller: RiseDiConfig, slower: FloatArray) -> RiseDiConfig:
        """Return the controller with the models of this speed. The parameters are not validated."""
        assert controller.observer is not None  # noqa: S101 - it was designed
        values = {
            "observer": controller.observer.model_copy(update=_matrices(self.design(slower))),
            "feedforward": self.feedforward,
            "input_scale": tuple((np.array(controller.input_scale) * self.scale).tolist()),
        }
        return controller.model_copy(update=values)


class _Loops(NamedTuple):
    """A controller that the search tries, with its loop around the aircraft at each speed."""

    controller: RiseDiConfig
    relaxation: FloatArray
    # the loops at the trim speed, then those at each of `others`. At each speed, the loop with all
    # vanes in use comes first.
    around: list[tuple[LinearPlant, LinearLaw]]


class ObserverSearch(NamedTuple):
    """The search for factors on gains that give the least error within the required margins.

    The factor of a channel is its relaxation.
    """

    base: RiseDiConfig  # the controller without an observer
    model: NominalModel
    plant: LinearPlant  # the nominal aircraft, then the uncertain aircraft if there are any
    gains: ObserverGains
    design: Callable[[FloatArray], ObserverDesign]  # designs the observer for a relaxation, (m,)
    margin: FloatArray  # (m,) s, least delay margin of each input
    needed: Requirement
    vanes: VanesConfig | None = None
    others: Sequence[AtSpeed] = ()  # designs at other speeds, whose margins count too
    # wind and noise; if it is None, gains stay as they are, and only get slower if the margins need
    # it
    air: Air | None = None
    # (m,) mean abs(u_dot) that costs as much as a unit of error, SI
    activity_unit: FloatArray | float = math.inf
    # the search begins at the loop of this design; if it is None, it begins at a relaxation of 1
    earlier_design: SelectedObserver | None = None
    # (m,) whether the relaxation of a channel may change; None if it may change in every channel
    is_free: Sequence[bool] | None = None

    @property
    def nominal(self) -> LinearPlant:
        """Nominal aircraft."""
        return LinearPlant(self.plant.A[0], self.plant.B[0], self.plant.C)

    @property
    def loop(self) -> LoopTiming:
        """Timing of the loop without its delay, because the required margin contains the delay."""
        return LoopTiming(self.model.lag, 0.0, self.model.period)

    def best(self, progress: Callable[[str], None] = lambda _: None) -> Trial[_Loops]:
        """Find the trial with the least error among those that have the required margins.

        If no trial has the margins, the result is the trial with the least shortage. The required
        damping is lowered to about the damping of the aircraft's zeros if necessary, because no
        feedback moves a zero. Without `air`, the least relaxed trial is best. `progress` gets a
        sentence for each loop.
        """
        m = len(self.model.lag)
        free = np.ones((1, m)) if self.is_free is None else np.array([self.is_free])
        moves = SLOWER if self.air is None else MOVES
        lowest = 0 if self.air is None else -exponent(MAX_QUICKENING)
        lowest_of = (free * lowest).astype(np.int64)
        highest_of = (free * exponent(MAX_RELAXATION)).astype(np.int64)
        requirement = above_zeros(self.needed, self.nominal)
        trials: dict[Place, Trial[_Loops]] = {}
        least = math.inf  # least cost so far of a trial that meets the margins

        def assess(places: Sequence[Place]) -> list[Trial[_Loops]]:
            nonlocal least
            for place in places:
                if place not in trials:
                    progress(f"observer: {len(trials) + 1} loops")
                    trials[place] = self._trial(place, requirement, least)
                    least = min(least, trials[place].cost)
            return [trials[place] for place in places]

        (start,) = assess([(0,) * m])
        return descend(assess, start, moves, lowest_of, highest_of)

    def _trial(self, place: Place, requirement: Requirement, least: float) -> Trial[_Loops]:
        """Evaluate the loops at a place in the search.

        `least` is the least cost so far of a trial that meets the margins, and is infinite if there
        is no such trial yet. If `least` is finite, a trial is rejected before its margins are
        computed in two cases: if it costs no less, or if a loop is unstable when each input is late
        by the delay margin that it needs.
        """
        loops = self._loops(place)
        if least < math.inf:
            if not self._is_tolerant(loops):
                return Trial(place, math.inf, math.inf, loops)
            cost = self._cost(loops)
            if not cost < least - GAIN:
                return Trial(place, 0.0, math.inf, loops)
        shortage = self._shortage(loops, requirement)
        if not shortage:
            shortage = max(requirement.uncertain_phase - self._worst_phase(loops), 0.0)  # rad
        cost = math.inf if shortage else self._cost(loops)
        return Trial(place, shortage, cost, loops)

    def selected(self, best: Trial[_Loops]) -> SelectedObserver:
        """Return the controller of a trial, with the delay margin of its loop.

        Raises ParameterError if the trial misses a required margin.
        """
        if best.shortage:
            raise self._refusal(best.content)
        values = best.content.controller.model_dump()
        values["observer"]["margin"] = float(self.margin.min())
        final = RiseDiConfig.validate_mapping(values, "controller")
        laws = _laws(final)
        loop = loop_of(final)
        return SelectedObserver(
            controller=final,
            delay_margin=min(delay_margin(self.nominal, law, self.loop) for law in laws),
            phase_margin=min(float(phase_margins(self.nominal, law, loop).min()) for law in laws),
            relaxation=best.content.relaxation,
            cost=best.cost,
        )

    def _loops(self, place: Place) -> _Loops:
        """Build the loops for given exponents of the relaxation.

        At the start of the search, the loops have the controller of the earlier design, if there is
        one, with the new feedforward.
        """
        earlier = self.earlier_design
        begin = np.ones(len(place)) if earlier is None else earlier.relaxation
        relaxation = begin * STEP ** np.array(place, dtype=np.float64)
        if earlier is not None and not any(place):
            changes = {"feedforward": self.base.feedforward, "schedule": None}
            controller = earlier.controller.model_copy(update=changes)
        else:
            controller = _parameters(
                self.base, self.model, self.gains, self.design(relaxation), relaxation, self.vanes
            )
        around = [(self.nominal, law) for law in _laws(controller)]
        for speed in self.others:
            at_speed = speed.flown(controller, relaxation)
            around += [(speed.plant, law) for law in _laws(at_speed)]
        return _Loops(controller, relaxation, around)

    def _is_tolerant(self, loops: _Loops) -> bool:
        """Return whether each loop stays stable when every u is late by its required margin."""
        late = self.margin + RESOLUTION
        return all(is_stable(plant, law, self.loop, late) for plant, law in loops.around)

    def _delay_fraction(self, plant: LinearPlant, law: LinearLaw) -> float:
        """Return the delay margin as a fraction of the required delay margin, at most 1.

        The delays of the inputs are in proportion to the delay margins that they need.
        """
        longest = float(self.margin.max())
        if longest == 0.0 or is_stable(plant, law, self.loop, self.margin + RESOLUTION):
            return 1.0
        margin = delay_margin(plant, law, self.loop, self.margin / longest)
        return min(margin / (longest + RESOLUTION), 1.0)

    def _shortage(self, loops: _Loops, requirement: Requirement) -> float:
        """Sum 1 - found / required over the margins that the loops miss."""
        loop = loop_of(loops.controller)
        goals = [np.array([self._delay_fraction(plant, law) for plant, law in loops.around])]
        for plant, law in loops.around:
            margins = input_margins(plant, law, loop, together=False)
            phase, gain_fraction, damping = fractions(margins, requirement)
            each = np.append(np.minimum(phase, gain_fraction), damping)
            goals.append(np.where(margins.stable, each, 0.0))
        return float(np.maximum(1.0 - np.concatenate(goals), 0.0).sum())

    def _cost(self, loops: _Loops) -> float:
        """Return the cost of a trial, which is the sum of log(error + activity) over the channels.

        Error and activity come from the response to wind and noise, and each is divided by its
        unit. Without `air`, the cost is the sum of log(relaxation).
        """
        if self.air is None:
            return float(np.log(loops.relaxation).sum())
        response = air_response(*loops.around[0], loop_of(loops.controller), self.air)
        unit = ERROR_SHARE * (self.model.C @ self.model.size)
        return float(np.log(response.error / unit + response.activity / self.activity_unit).sum())

    def _worst_phase(self, loops: _Loops) -> float:
        """Return the least phase margin of uncertain aircraft, rad.

        Returns infinity if there are none.
        """
        uncertain = self.plant._replace(A=self.plant.A[1:], B=self.plant.B[1:])
        if not len(uncertain.A):
            return math.inf
        loop = loop_of(loops.controller)
        laws = _laws(loops.controller)
        return min(float(phase_margins(uncertain, law, loop).min()) for law in laws)

    def _refusal(self, loops: _Loops) -> ParameterError:
        """Return an error that says which margins are missing at the end of the search."""
        lack = self._lack(loops)
        if self.others and lack is None:
            return ParameterError(
                "speeds: found less than the margins at another speed, expected speeds nearer to "
                "the trim speed"
            )
        uncertain = (
            f"of {WORST_OF} uncertain aircraft: found a phase margin below "
            f"{np.degrees(self.needed.uncertain_phase):.0f} deg, expected at least this"
        )
        return ParameterError(f"--margin: {lack or uncertain}; {MEND}")

    def _lack(self, loops: _Loops) -> Refusal | None:
        """List the margins that are missing around the nominal aircraft.

        Returns None if none is.
        """
        requirement = above_zeros(self.needed, self.nominal)
        longest = float(self.margin.max())
        lacking = list[Refusal]()
        for law in _laws(loops.controller):
            margins = input_margins(self.nominal, law, loop_of(loops.controller), together=False)
            share = self.margin / longest if longest else 1.0
            delay = 1e3 * delay_margin(self.nominal, law, self.loop, share)
            late = GainCondition("delay margin (ms)", None, delay, 1e3 * (longest + RESOLUTION))
            failed = failing((late, *nominal_conditions(margins, requirement)))
            outputs = loops.controller.outputs
            lacking += [Refusal(condition.sentence(outputs)) for condition in failed]
        return joined(dict.fromkeys(lacking))


def least_error(
    searches: Sequence[ObserverSearch], progress: Callable[[str], None] = lambda _: None
) -> SelectedObserver:
    """Return the best result of the searches of several gain sets.

    Raises ParameterError if no result meets the margins.
    """
    trials = [search.best(progress) for search in searches]
    place = 0
    for k, trial in enumerate(trials):
        place = k if trial.is_better(trials[place]) else place
    return searches[place].selected(trials[place])._replace(place=place)


def _laws(controller: RiseDiConfig) -> list[LinearLaw]:
    """Linearise the law of a controller for every set of vanes in use."""
    (law, params), period = controller.tuned_law(), 1.0 / controller.rate
    sets = product((False, True), repeat=len(controller.vanes))
    laws = (without_frozen(params, frozen) for frozen in sets)
    return [
        linear_law(TunedLaw(law, law_params), len(controller.outputs), period)
        for law_params in laws
    ]


def _matrices(design: ObserverDesign) -> dict[str, Any]:
    """Return the matrices of an observer, row by row."""
    names = ("Phi", "Gamma", "L", "F")
    return {name: tuple(getattr(design, name).ravel().tolist()) for name in names}


def _parameters(
    base: RiseDiConfig,
    model: NominalModel,
    gains: ObserverGains,
    design: ObserverDesign,
    relaxation: FloatArray,
    vanes: VanesConfig | None,
) -> RiseDiConfig:
    """Return a controller's parameters with given gains and the matrices of a designed observer.

    A K below MIN_K becomes MIN_K with a smaller input scale, which gives the same loop.
    """
    K = gains.K / relaxation
    permitted = np.maximum(K, MIN_K + MIN_GAIN)
    permitted[-1] = MIN_K
    share = K / permitted
    k_g = MIN_K - 1.0
    require(
        spectral_radius(design.Phi - design.Gamma @ design.F) < 1.0,
        "observer.F",
        "an unstable feedback",
        "a stable one",
    )
    observer = ObserverConfig(
        rate=base.rate,
        states=design.states,
        **_matrices(design),
        margin=0.0,
        vanes=vanes,
    )
    changes: dict[str, Any] = {
        "k_g": k_g,
        "k_d": tuple((permitted[:-1] - gain(np.array(k_g), np.zeros(len(K) - 1))[:-1]).tolist()),
        "Lambda": tuple((gains.Lambda / relaxation).tolist()),
        "beta": tuple((gains.beta / relaxation / share).tolist()),
        "softening": tuple((gains.softening * relaxation).tolist()),
        "input_scale": tuple((model.input_scale * share).tolist()),
        "omega": tuple(share.tolist()),
        "sign": "soft",
        "observer": observer,
    }
    return base.model_copy(update=changes)
