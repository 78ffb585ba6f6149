# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""The search for the relaxation of an observer's gains at which the loop has its margins.

Until then `effort` is raised, and K and the integral are lowered, in the channel in which that
gains most, and the disturbances of the extended-state observer are taken as slower.
"""

from collections.abc import Callable, Generator, Sequence
from itertools import product
from typing import Any, NamedTuple

import numpy as np

from control_laws.nominal_model import NominalModel
from control_laws.observer_design import ObserverDesign
from flight_analysis.closed_loop.loop_margins import loop_of
from flight_core.parameters import ParameterError, require
from flight_core.vectors import FloatArray
from flight_design.gains.gain_conditions import MIN_K, Condition, failing
from flight_design.gains.observer_gains import ObserverGains
from flight_design.gains.requirement import (
    Requirement,
    above_zeros,
    least_fraction,
    nominal_conditions,
)
from rise_di_controller.control_law import TunedLaw
from rise_di_controller.law import MIN_GAIN, gain
from rise_di_controller.linear_loop import (
    LinearLaw,
    LinearPlant,
    Loop,
    delay_margin,
    linear_law,
    spectral_radius,
)
from rise_di_controller.margins import loop_margins, phase_margins
from rise_di_controller.model_sections import FeedforwardConfig, ObserverConfig, VanesConfig
from rise_di_controller.observer import without_frozen
from rise_di_controller.rise_di_config import RiseDiConfig, SpeedConfig

RELAXATION = 1.05
"""Factor by which `effort` rises, and K and the integral fall, in a step of the search for the
margins."""

LATE = 1e-3  # of its fraction: what a delay margin that is too small counts in a quick search

RESOLUTION = 3e-4  # s: of the delay margin, and of what its digits in a file change

MAX_RELAXATION = 18.0  # of a channel: beyond it the search ends
# the search ends after so many steps in which the margins do not grow by this factor
PATIENCE = 20
PROGRESS = 1.01
MEND = (
    "give the loop less delay or lag, ask for a smaller delay margin, or fly the law without "
    "an observer"
)
DELAYS = 4.0  # of the delay margin that is asked for: how far the search looks for it
WORST_OF = 50  # uncertain aircraft whose least phase margin counts


class SelectedObserver(NamedTuple):
    """A controller with an observer, and what it tolerates."""

    controller: RiseDiConfig
    delay_margin: float  # s, of the nominal linear loop, the declared delay included
    phase_margin: float  # rad, the least of the nominal linear loop
    fraction: float  # the least of what is found over what is needed
    # (m,) factors by which the search raised `effort` and lowered K and the integral; 1: not at all
    relaxation: FloatArray
    place: int = 0  # of its gain set
    left_out: int = 0  # uncertain aircraft that no gains hold

    def not_counted(self) -> str:
        """A sentence on the aircraft left out; "" where none is."""
        if not self.left_out:
            return ""
        return (
            f"; {self.left_out} of {WORST_OF} uncertain aircraft do not count: they diverge while "
            f"{', '.join(self.controller.outputs)} are held, under any gains"
        )


class AtSpeed(NamedTuple):
    """The design at a ratio to the trim speed."""

    ratio: float
    plant: LinearPlant
    feedforward: FeedforwardConfig
    scale: FloatArray  # (m,) factors of input_scale
    design: Callable[[FloatArray], ObserverDesign]

    def model(self, slower: FloatArray) -> SpeedConfig:
        """The models of feedforward and observer."""
        nominal = {key: getattr(self.feedforward, key) for key in ("A", "B", "gravity")}
        return SpeedConfig(ratio=self.ratio, **nominal, **_matrices(self.design(slower)))

    def flown(self, controller: RiseDiConfig, slower: FloatArray) -> RiseDiConfig:
        """What flies at this speed; not checked."""
        assert controller.observer is not None  # noqa: S101 - it was designed
        changed = {
            "observer": controller.observer.model_copy(update=_matrices(self.design(slower))),
            "feedforward": self.feedforward,
            "input_scale": tuple((np.array(controller.input_scale) * self.scale).tolist()),
        }
        return controller.model_copy(update=changed)


class MarginSearch(NamedTuple):
    """The search for the relaxation of a gain set at which the loop has its margins."""

    base: RiseDiConfig  # the controller without an observer
    model: NominalModel
    plant: LinearPlant  # the nominal aircraft, then uncertain aircraft, if any
    gains: ObserverGains
    design: Callable[[FloatArray], ObserverDesign]  # the observer of a relaxation, (m,)
    margin: float  # s, least delay margin
    needed: Requirement
    vanes: VanesConfig | None = None
    others: Sequence[AtSpeed] = ()  # speeds whose margins count too
    quick: bool = False  # the delay margin alone counts until it is enough

    @property
    def nominal(self) -> LinearPlant:
        """The nominal aircraft."""
        return LinearPlant(self.plant.A[0], self.plant.B[0], self.plant.C)

    @property
    def loop(self) -> Loop:
        """The loop without its delay: the delay margin counts the declared delay too."""
        return Loop(self.model.lag, 0.0, self.model.period)

    def steps(self) -> Generator[SelectedObserver, None, SelectedObserver]:
        """The first relaxation with the margins: steps in the channel that gains most, or in all
        where none gains.

        Yields the state of the search before a step, and at the end. The channel with the least
        phase margin of uncertain aircraft is next once the nominal aircraft has its margins. The
        damping asked for is at most that of the zeros of the aircraft: no feedback moves a zero.
        Raises ParameterError for margins out of reach.
        """
        search = self._replace(needed=above_zeros(self.needed, self.nominal))
        steps = RELAXATION ** np.eye(len(self.model.lag))
        selected = search._best(np.ones((1, len(steps))))
        fractions = [selected.fraction]
        short = list[int]()
        while True:
            yield selected
            stalled = (
                len(fractions) > PATIENCE
                and selected.fraction < PROGRESS * fractions[-1 - PATIENCE]
            )
            if selected.relaxation.max() > MAX_RELAXATION or stalled:
                raise search._refusal(selected)
            if selected.fraction < 1.0:
                near = selected.delay_margin
                stepped = search._best(selected.relaxation * steps, near)
                selected = (
                    stepped
                    if stepped.fraction > selected.fraction
                    else search._best(selected.relaxation[None] * RELAXATION, near)
                )
                fractions.append(selected.fraction)
                continue
            weak, short = search._weak_channel(selected.controller, short if self.quick else ())
            if weak is None:
                return search._checked(selected)
            selected = search._best(selected.relaxation * steps[[weak]])
            fractions = []

    def _best(self, relaxations: FloatArray, near: float | None = None) -> SelectedObserver:
        """The first with the largest fraction; loop margins only where the delay margin leaves a
        chance. `near` is the delay margin of the step before.
        """
        controllers = [
            _parameters(
                self.base, self.model, self.gains, self.design(relaxation), relaxation, self.vanes
            )
            for relaxation in relaxations
        ]
        delayed = [self._delayed(controllers[0], self.nominal, near)]
        for controller in controllers[1:]:
            most = max(delay for _, delay in delayed)
            above = most if self.quick and self._delay_fraction(most) < 1.0 else None
            delayed.append(self._delayed(controller, self.nominal, near, above))
        fractions = [self._delay_fraction(delay) for _, delay in delayed]
        candidates: dict[int, SelectedObserver] = {}
        for k in sorted(range(len(delayed)), key=lambda k: -fractions[k]):
            best = max((each.fraction for each in candidates.values()), default=0.0)
            if candidates and fractions[k] < best:
                break
            laws, delay = delayed[k]
            if self.quick and fractions[k] < 1.0:
                late = LATE * fractions[k]
                return SelectedObserver(controllers[k], delay, np.nan, late, relaxations[k])
            phase, fraction = self._margin_fraction(controllers[k], laws, self.nominal)
            elsewhere = (
                self._fraction_at(speed, controllers[k], relaxations[k]) for speed in self.others
            )
            fraction = min([fractions[k], fraction, *elsewhere])
            candidates[k] = SelectedObserver(controllers[k], delay, phase, fraction, relaxations[k])
        return max(
            (candidates[k] for k in sorted(candidates)), key=lambda candidate: candidate.fraction
        )

    def _delayed(
        self,
        controller: RiseDiConfig,
        plant: LinearPlant,
        near: float | None = None,
        above: float | None = None,
    ) -> tuple[list[LinearLaw], float]:
        """The laws, for every set of vanes in use, and the least delay margin, s."""
        laws = _laws(controller)
        longest = DELAYS * self.margin
        return laws, min(
            delay_margin(plant, law, self.loop, longest=longest, near=near, above=above)
            for law in laws
        )

    def _delay_fraction(self, delay: float) -> float:
        return delay / (self.margin + RESOLUTION) if self.margin > 0.0 else 1.0

    def _margin_fraction(
        self, controller: RiseDiConfig, laws: Sequence[LinearLaw], plant: LinearPlant
    ) -> tuple[float, float]:
        """The least phase margin, and the least of what is found over what is needed beside the
        delay margin.
        """
        each = [loop_margins(plant, law, loop_of(controller), together=False) for law in laws]
        return min(float(margins.phase.min()) for margins in each), min(
            least_fraction(margins, self.needed) for margins in each
        )

    def _fraction_at(
        self, speed: AtSpeed, controller: RiseDiConfig, relaxation: FloatArray
    ) -> float:
        """The least of what is found over what is needed at another speed."""
        flown = speed.flown(controller, relaxation)
        laws, delay = self._delayed(flown, speed.plant)
        fraction = self._margin_fraction(flown, laws, speed.plant)[1]
        return min(self._delay_fraction(delay), fraction)

    def _weak_channel(
        self, controller: RiseDiConfig, short: Sequence[int] = ()
    ) -> tuple[int | None, list[int]]:
        """The channel with the least phase margin of uncertain aircraft, None if enough, and the
        places in `plant` of the aircraft with too little.

        Aircraft `short` in the step before come first, the rest once no margin is too small.
        """
        needed = self.needed.uncertain_phase
        for places in (list(short), list(range(1, len(self.plant.A)))):
            if not places:
                continue
            uncertain = self.plant._replace(A=self.plant.A[places], B=self.plant.B[places])
            loop = loop_of(controller)
            each = [phase_margins(uncertain, law, loop) for law in _laws(controller)]
            margins = np.min(each, axis=0)
            if margins.min() < needed:
                lacking = np.flatnonzero(margins.min(axis=1) < needed)
                channel = int(np.argmin(margins.min(axis=0)))
                return channel, [places[k] for k in lacking]
        return None, []

    def _refusal(self, selected: SelectedObserver) -> ParameterError:
        """What is missing at the last step of the search."""
        lacking = self._lacking(selected.controller)
        if self.others and not lacking:
            return ParameterError(
                "speeds: found less than the margins at another speed, expected speeds nearer to "
                "that of the trim"
            )
        uncertain = (
            f"of {WORST_OF} uncertain aircraft: found a phase margin below "
            f"{np.degrees(self.needed.uncertain_phase):.0f} deg, expected at least this"
        )
        return ParameterError(f"--margin: {lacking or uncertain}; {MEND}")

    def _lacking(self, controller: RiseDiConfig) -> str:
        """The margins missing around the nominal aircraft, in sentences."""
        lacking = []
        for law in _laws(controller):
            margins = loop_margins(self.nominal, law, loop_of(controller), together=False)
            delay = 1e3 * delay_margin(self.nominal, law, self.loop)
            late = Condition("delay margin (ms)", None, delay, 1e3 * self.margin)
            failed = failing((late, *nominal_conditions(margins, self.needed)))
            lacking += [condition.sentence(controller.outputs) for condition in failed]
        return "; ".join(dict.fromkeys(lacking))

    def _checked(self, selected: SelectedObserver) -> SelectedObserver:
        """The result with the delay margin that its controller states."""
        values = selected.controller.model_dump()
        values["observer"]["margin"] = self.margin
        final = RiseDiConfig.validate_mapping(values, "controller")
        near = selected.delay_margin
        delay = min(delay_margin(self.nominal, law, self.loop, near=near) for law in _laws(final))
        return selected._replace(controller=final, delay_margin=delay)


def least_relaxed(
    searches: Sequence[Generator[SelectedObserver, None, SelectedObserver]],
    progress: Callable[[str], None] = lambda _: None,
) -> SelectedObserver:
    """The result of the search with the least relaxation: the least relaxed search takes the next
    step.

    Raises the ParameterError of the last search where none has a result.
    """
    reached = dict.fromkeys(range(len(searches)), 1.0)
    refusal = ParameterError("found no gains, expected a set")
    while reached:
        place = min(reached, key=reached.__getitem__)
        try:
            now = next(searches[place])
        except StopIteration as end:
            selected: SelectedObserver = end.value
            return selected._replace(place=place)
        except ParameterError as error:  # another gain set may have the margins
            refusal = error
            del reached[place]
        else:
            reached[place] = float(np.prod(now.relaxation))
            reached_text = (
                f"least margin {now.fraction:.0%} of the needed"
                if now.fraction < 1.0
                else "margins met, uncertain aircraft"
            )
            progress(
                f"observer: {reached_text}, K and integral / "
                f"{', '.join(f'{factor:.2f}' for factor in now.relaxation)}"
            )
    raise refusal


def _laws(controller: RiseDiConfig) -> list[LinearLaw]:
    """The linear laws of a controller, for every set of vanes in use."""
    (law, params), period = controller.tuned_law(), 1.0 / controller.rate
    sets = product((False, True), repeat=len(controller.vanes))
    flown = (without_frozen(params, frozen) for frozen in sets)
    return [
        linear_law(TunedLaw(law, law_params), len(controller.outputs), period)
        for law_params in flown
    ]


def _matrices(design: ObserverDesign) -> dict[str, Any]:
    """The matrices of an observer, row by row."""
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
    """The parameters with gains and matrices. A K below MIN_K is MIN_K with a smaller input scale:
    the same loop.
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
