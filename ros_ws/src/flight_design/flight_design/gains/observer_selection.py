# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Observer selection: the sections feedforward and observer of a controller, and the gains of the
law beside it.

`with_aircraft_observer` takes the model of an airframe, `with_extended_state_observer` Omega and
the lags alone. Both give a controller whose nominal linear loop has a delay margin and meets a
requirement on phase, gain, sensitivity and damping. Until then `effort` is raised, and K and the
integral are lowered, in the channel in which that gains most, and the disturbances of the
extended-state observer are taken as slower.
"""

from collections.abc import Callable, Generator, Mapping, Sequence
from itertools import product
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

from aircraft_sim.airframe import Airframe
from aircraft_sim.airspeed import at_speed
from aircraft_sim.disturbance import AIR_STATE
from aircraft_sim.turbulence import MODERATE, dryden
from aircraft_sim.uncertainty import nominal_and_sampled
from control_laws.nominal_model import NominalModel
from control_laws.observer_design import (
    Names,
    ObserverDesign,
    ObserverModel,
    Weights,
    aircraft_model,
    aircraft_observer,
    extended_state_observer,
    feedback_gain,
    vane_correction,
)
from flight_analysis.closed_loop.loop_margins import law_order, loop_of
from flight_core.parameters import ParameterError, require
from flight_core.vectors import FloatArray
from flight_design.gains.extended_state import extended_state_weights, integrator_model
from flight_design.gains.gain_conditions import MIN_K, Condition, failing
from flight_design.gains.gain_selection import with_feedforward
from flight_design.gains.nominal import nominal_model
from flight_design.gains.requirement import (
    OBSERVER_REQUIREMENT,
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
from rise_di_controller.model_sections import (
    FeedforwardConfig,
    ObserverConfig,
    VanesConfig,
    require_signs,
)
from rise_di_controller.observer import without_frozen
from rise_di_controller.params import ControllerConfig
from rise_di_controller.rise_di_config import RiseDiConfig, SpeedConfig

RELAXATION = 1.05
"""Factor by which `effort` rises, and K and the integral fall, in a step of the search for the
margins."""

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

# uncertain aircraft whose least phase margin counts
WORST_OF = 50
WORST_UNCERTAINTY = 0.3
WORST_SEED = 1

# factor on the noise of the wind of a filter that has a vane: with 10 u moves three times as much
GUST_WITH_VANE = 2.0
STILL = 1.4  # of the noise of a vane: a motion of less counts as none

SHARE = 0.9  # of the integral gain of PI that is Lambda; the rest is the slope of the softened sign


class ObserverGains(NamedTuple):
    """Gains of the law in scaled inputs with abs(Omega_ii) of 1, and weights of the observer; the
    law's order.
    """

    K: FloatArray  # (m,) 1/s
    Lambda: FloatArray  # (m,) 1/s
    beta: FloatArray  # (m,) units of y / s^2
    softening: FloatArray  # (m,) total lags
    weights: Weights


def gains_by_rule(model: NominalModel, axes: tuple[str, ...], speed: float) -> ObserverGains:
    """Gains from the lags of the loop, as a start: they were found on the `osprey` and scale with
    the total lag T.

        effort = 0.38 T,  drift = 0.4 0.035 s / T,  loose = 0.0036,  K = 0.026 / T,  Lambda = K / 4
        wind: 0.12 of Dryden's noise sqrt(2 V0 / L) sigma, with 17 times its time L / V0
        beta = K / T, and a softened sign of 3 T: eps is 3 units of y / s times T

    Arguments: `axes` of the wind in the order of the model's columns; `speed` V0, m/s.
    """
    T = model.total_lag
    spectrum = dryden(**MODERATE, sigma=0.0)
    order = {"longitudinal": 0, "lateral": 1, "vertical": 2}
    places = [order[axis] for axis in axes]
    length = spectrum.length[places]
    sigma = spectrum.sigma[places]
    gust = 0.12 * sigma * np.sqrt(2.0 * speed / length)
    weights = Weights(0.38 * T, 0.4 * 0.035 / T, gust, 17.0 * length / speed, np.array([0.0036]))
    K = 0.026 / T
    return ObserverGains(K, K / 4.0, K / T, np.full(len(T), 3.0), weights)


BESIDE_SKETCH = {"effort": (0.25, 4.0), "K": (16.0, 1.0)}
"""Factors on `gains_by_rule` beside a sketch, for a body rate and for V, found on the c172p and the
737 of JSBSim: the law of the rates keeps two thirds of its bandwidth, because a sketch leaves out
more than a model does."""


def gains_beside_sketch(
    model: NominalModel, outputs: tuple[str, ...], axes: tuple[str, ...], speed: float
) -> ObserverGains:
    """Gains from the lags for a model from a sketch: `gains_by_rule` times BESIDE_SKETCH."""
    by_rule = gains_by_rule(model, axes, speed)
    airspeed = [name == "V" for name in outputs]
    effort, K = (np.where(airspeed, *reversed(BESIDE_SKETCH[key])) for key in ("effort", "K"))
    weights = by_rule.weights._replace(effort=effort * by_rule.weights.effort)
    return by_rule._replace(
        K=K * by_rule.K, Lambda=K * by_rule.Lambda, beta=K * by_rule.beta, weights=weights
    )


def gains_of_search(gains: Mapping[str, list[float]], T: FloatArray) -> ObserverGains:
    """Gains as `rise-di compare --tune` finds them for rise_observer or pi_observer, by name; T the
    total lag, (m,), s.

    PI with K and Lambda is RISE-DI inside its softened sign with the same K, SHARE Lambda, and 1 /
    (softening T) of the rest.
    """
    values = {name: np.array(row, dtype=np.float64) for name, row in gains.items()}
    weights = Weights(**{name: values[name] for name in Weights._fields})
    K = values["K"]
    Lambda = values["Lambda"]
    if "beta" in values:
        return ObserverGains(
            K, Lambda, values["beta"], np.broadcast_to(values["softening"], K.shape), weights
        )
    return ObserverGains(K, SHARE * Lambda, K / T, 1.0 / ((1.0 - SHARE) * Lambda * T), weights)


def model_for(airframe: Airframe, controller: ControllerConfig, noise: FloatArray) -> NominalModel:
    """The model of an airframe for a controller, in the law's order. `noise` of the measured
    outputs, (m,), rms per sample.
    """
    model = nominal_model(
        airframe, controller.outputs, controller.inputs, noise, loop_of(controller)
    )
    return _limited(model, controller)


def _limited(model: NominalModel, controller: ControllerConfig) -> NominalModel:
    """A model with the limits and D of a controller."""
    limits = controller.guard().limits
    return model._replace(
        D=np.array(controller.D, dtype=np.float64), lower=limits.lower, upper=limits.upper
    )


class SelectedObserver(NamedTuple):
    """A controller with an observer, and what it tolerates."""

    controller: RiseDiConfig
    delay_margin: float  # s, of the nominal linear loop, the declared delay included
    phase_margin: float  # rad, the least of the nominal linear loop
    fraction: float  # the least of what is found over what is needed
    # (m,) factors by which the search raised `effort` and lowered K and the integral; 1: not at all
    relaxation: FloatArray
    place: int = 0  # of its gain set


def with_aircraft_observer(
    controller: RiseDiConfig,
    airframe: Airframe,
    sets: Sequence[ObserverGains],
    noise: FloatArray,
    margin: float,
    needed: Requirement = OBSERVER_REQUIREMENT,
    vanes: Mapping[str, float] = MappingProxyType({}),
    *,
    uncertain: bool = True,
    speeds: tuple[float, float] | None = None,
    progress: Callable[[str], None] = lambda _: None,
) -> SelectedObserver:
    """The controller with the feedforward and the observer of an airframe, and the gains of the law
    beside it.

    Of several gain sets the margins choose: the least product of the factors of `relaxation`, then
    the first. `vanes` has the noise of each vane, rms per sample in rad, by its channel, alpha or
    beta. The phase margin is also that of WORST_OF uncertain aircraft where the airframe is
    `uncertain`. `speeds` are two ratios to the trim speed: the controller has a schedule then, and
    the margins at these speeds too. `progress` gets a sentence before a step of the search. Raises
    ParameterError for an airframe with another D or without a wind, one that a feedforward refuses,
    and for margins that no relaxation reaches.
    """
    require(
        bool(airframe.gusts),
        f"airframe {airframe.name}",
        "no gusts",
        "the effect of wind: the observer estimates it",
    )
    rows, columns = law_order(airframe, controller)
    Omega = airframe.matrix_c()[rows] @ airframe.matrix_b()[:, columns]
    require_signs(Omega, controller.D, f"airframe {airframe.name}")
    base = with_feedforward(
        controller.model_copy(update={"observer": None, "schedule": None}), airframe
    )
    names = Names(
        tuple(airframe.states), controller.inputs, controller.outputs, tuple(airframe.gusts)
    )

    def designer(
        model: NominalModel, gains: ObserverGains
    ) -> Callable[[FloatArray], ObserverDesign]:
        observer = aircraft_observer(model, names, gains.weights)
        sampled = ObserverModel(observer.states, observer.Phi, observer.Gamma, observer.H)
        return lambda slower: observer._replace(
            F=feedback_gain(sampled, model, slower * gains.weights.effort)
        )

    def model_at(ratio: float, gains: ObserverGains) -> AtSpeed:
        frame = at_speed(airframe, ratio, controller.inputs[controller.outputs.index("V")])
        model = model_for(frame, controller, noise)
        feedforward = with_feedforward(base, frame).feedforward
        assert feedforward is not None  # noqa: S101 - it was added
        plant = LinearPlant(model.A + model.gravity, model.B, model.C)
        scale = np.array([1.0 if name == "V" else ratio**-2.0 for name in controller.outputs])
        return AtSpeed(ratio, plant, feedforward, scale, designer(model, gains))

    model = model_for(airframe, controller, noise)
    if speeds is not None:
        require(
            not vanes,
            "speeds",
            f"the vanes {', '.join(vanes)}",
            "none: they read the model of the trim speed",
        )
        require(
            "V" in controller.outputs,
            "speeds",
            f"the outputs {', '.join(controller.outputs)}",
            "V among them",
        )
    A, B = nominal_and_sampled(airframe, WORST_UNCERTAINTY, WORST_OF * uncertain, WORST_SEED)
    states = np.array(list(airframe.states))
    vane_rows = [(states == name).astype(np.float64) for name in vanes]
    plant = LinearPlant(A + model.gravity, B[:, :, columns], np.vstack([model.C, *vane_rows]))

    others = []
    searches = []
    for gains in sets:
        elsewhere = [model_at(ratio, gains) for ratio in speeds or ()]
        others.append(elsewhere)
        section = _vanes(airframe, model, names, gains.weights, vanes) if vanes else None
        design = designer(model, gains)
        searches.append(
            _within_margin(base, model, plant, gains, design, margin, needed, section, elsewhere)
        )
    selected = _least_relaxed(searches, progress)
    if speeds is None:
        return selected
    slow, fast = (speed.model(selected.relaxation).model_dump() for speed in others[selected.place])
    schedule = {"speed": airframe.speed, "slow": slow, "fast": fast}
    if controller.schedule is not None:
        schedule["time"] = controller.schedule.time
    scheduled = RiseDiConfig.validate_mapping(
        selected.controller.model_dump() | {"schedule": schedule}, "controller"
    )
    return selected._replace(controller=scheduled)


def _vanes(
    airframe: Airframe,
    model: NominalModel,
    names: Names,
    weights: Weights,
    vanes: Mapping[str, float],
) -> VanesConfig:
    """The section of the vanes: alpha and beta less the wind along their axes over V0."""
    sampled = aircraft_model(model, names, weights.wind_time)
    H = []
    L = []
    blowing = {AIR_STATE[axis]: f"wind.{axis}" for axis in airframe.gusts}
    for name, noise in vanes.items():
        parts = {f"x.{name}": 1.0, blowing.get(name, ""): -1.0 / airframe.speed}
        row = np.array([parts.get(state, 0.0) for state in sampled.states])
        with_vane = weights._replace(gust=GUST_WITH_VANE * weights.gust)
        H += row.tolist()
        L += vane_correction(sampled, model, (weights, with_vane), row, noise).ravel().tolist()
    least = [STILL * noise for noise in vanes.values()]
    return VanesConfig(channels=tuple(vanes), H=tuple(H), L=tuple(L), least=tuple(least))


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


def with_extended_state_observer(
    controller: RiseDiConfig,
    Omega: FloatArray,
    noise: FloatArray,
    size: FloatArray,
    margin: float,
    needed: Requirement = OBSERVER_REQUIREMENT,
) -> SelectedObserver:
    """The controller with an observer from Omega and lags alone: no A, no f, no wind. Its gains
    stay, but for the margin.

    The model of its feedforward is y_dot = Omega u, that of its observer y_dot = diag(Omega) u:
    with all of Omega the elevator would correct V, and turn the aircraft for it. Arguments: Omega
    (m, m) in the law's order; `noise` of the outputs, (m,), rms per sample; `size` (m,), their
    units, 1 m/s or 0.1 rad/s. Raises ParameterError as `with_aircraft_observer`.
    """
    m = len(controller.outputs)
    require_signs(Omega, controller.D, "Omega")
    values = controller.model_dump() | {
        "observer": None,
        "feedforward": integrator_model(controller, Omega).model_dump(),
    }
    base = RiseDiConfig.validate_mapping(values, "controller")
    none = np.zeros((m, m))
    eye = np.eye(m)
    loop = loop_of(controller)
    ones = np.ones(m)
    effects = np.diag(Omega)
    model = NominalModel(
        A=none,
        B=np.diag(effects),
        C=eye,
        gravity=none,
        wind=np.zeros((m, 0)),
        noise=noise,
        kinematic=np.zeros(m),
        size=size,
        input_scale=1.0 / np.abs(effects),
        D=ones,
        lag=loop.lag,
        total_lag=loop.total,
        period=loop.period,
        lower=-ones,
        upper=ones,
    )
    model = _limited(model, controller)
    names = Names(controller.outputs, controller.inputs, controller.outputs, ())
    law = controller.law_params()
    weights = extended_state_weights(controller.outputs, model.total_lag)
    response = (
        np.abs(effects) * law.input_scale
    )  # y_dot by a unit of scaled input: the gains are those for a unit response
    unused = Weights(weights.effort, weights.drift, np.zeros(0), np.zeros(0), np.zeros(1))
    softening = np.broadcast_to(controller.softening, (m,))
    gains = ObserverGains(law.K * response, law.Lambda, law.beta * response, softening, unused)

    def design(slower: FloatArray) -> ObserverDesign:
        drift = weights.drift / slower
        rate_drift = weights.rate_drift / slower**2
        changed = weights._replace(
            effort=slower * weights.effort, drift=drift, rate_drift=rate_drift
        )
        return extended_state_observer(model, names, changed)

    return _least_relaxed(
        [
            _within_margin(
                base,
                model,
                LinearPlant(none[None], Omega[None], eye),
                gains,
                design,
                margin,
                needed,
            )
        ]
    )


def _least_relaxed(
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


def _within_margin(
    base: RiseDiConfig,
    model: NominalModel,
    plant: LinearPlant,
    gains: ObserverGains,
    design: Callable[[FloatArray], ObserverDesign],
    margin: float,
    needed: Requirement,
    vanes: VanesConfig | None = None,
    others: Sequence[AtSpeed] = (),
) -> Generator[SelectedObserver, None, SelectedObserver]:
    """The first relaxation with the margins: steps in the channel that gains most, or in all where
    none gains.

    Yields the state of the search before a step, and at the end. Raises ParameterError for margins
    out of reach. The plant is the nominal aircraft, then uncertain aircraft, if any: the channel
    with the least phase margin there is next. The damping asked for is at most the damping of the
    zeros of the aircraft: no feedback moves a zero.
    """
    loop = Loop(model.lag, 0.0, model.period)  # the delay margin counts the declared delay too
    m, nominal = len(model.lag), LinearPlant(plant.A[0], plant.B[0], plant.C)
    needed = above_zeros(needed, nominal)

    def delayed(controller: RiseDiConfig, plant: LinearPlant) -> tuple[list[LinearLaw], float]:
        """The laws, for every set of vanes in use, and the least delay margin, s."""
        laws = _laws(controller)
        return laws, min(delay_margin(plant, law, loop, longest=DELAYS * margin) for law in laws)

    def delay_fraction(delay: float) -> float:
        return delay / (margin + RESOLUTION) if margin > 0.0 else 1.0

    def margin_fraction(
        controller: RiseDiConfig, laws: Sequence[LinearLaw], plant: LinearPlant
    ) -> tuple[float, float]:
        """The least phase margin, and the least of what is found over what is needed beside the
        delay margin.
        """
        each = [loop_margins(plant, law, loop_of(controller), together=False) for law in laws]
        return min(float(margins.phase.min()) for margins in each), min(
            least_fraction(margins, needed) for margins in each
        )

    def assessed(speed_model: AtSpeed, controller: RiseDiConfig, relaxation: FloatArray) -> float:
        flown = speed_model.flown(controller, relaxation)
        laws, delay = delayed(flown, speed_model.plant)
        return min(delay_fraction(delay), margin_fraction(flown, laws, speed_model.plant)[1])

    def best(relaxations: FloatArray) -> SelectedObserver:
        """The first with the largest fraction; loop margins only where the delay margin leaves a
        chance.
        """
        controllers = [
            _parameters(base, model, gains, design(relaxation), relaxation, vanes)
            for relaxation in relaxations
        ]
        each, candidates = (
            [delayed(controller, nominal) for controller in controllers],
            dict[int, SelectedObserver](),
        )
        for k in sorted(range(len(each)), key=lambda k: -delay_fraction(each[k][1])):
            (laws, delay), controller, relaxation = each[k], controllers[k], relaxations[k]
            if candidates and delay_fraction(delay) < max(
                candidate.fraction for candidate in candidates.values()
            ):
                break
            phase, fraction = margin_fraction(controller, laws, nominal)
            elsewhere = (assessed(speed_model, controller, relaxation) for speed_model in others)
            fraction = min([delay_fraction(delay), fraction, *elsewhere])
            candidates[k] = SelectedObserver(controller, delay, phase, fraction, relaxation)
        return max(
            (candidates[k] for k in sorted(candidates)), key=lambda candidate: candidate.fraction
        )

    def worst_phases(controller: RiseDiConfig) -> FloatArray:
        uncertain = plant._replace(A=plant.A[1:], B=plant.B[1:])
        each = [
            phase_margins(uncertain, law, loop_of(controller)).min(axis=0)
            for law in _laws(controller)
        ]
        return np.asarray(np.min(each, axis=0))

    steps = RELAXATION ** np.eye(m)
    selected = best(np.ones((1, m)))
    fractions = [selected.fraction]
    while True:
        yield selected
        ended = (
            len(fractions) > PATIENCE and selected.fraction < PROGRESS * fractions[-1 - PATIENCE]
        )
        if selected.relaxation.max() > MAX_RELAXATION or ended:
            lacking = _lacking(selected, nominal, loop, margin, needed)
            uncertain = (
                f"of {WORST_OF} uncertain aircraft: found a phase margin below "
                f"{np.degrees(needed.uncertain_phase):.0f} deg, expected at least this"
            )
            raise ParameterError(
                "speeds: found less than the margins at another speed, expected speeds nearer to "
                "that of the trim"
                if others and not lacking
                else f"--margin: {lacking or uncertain}; {MEND}"
            )
        if selected.fraction < 1.0:
            stepped = best(selected.relaxation * steps)
            selected = (
                stepped
                if stepped.fraction > selected.fraction
                else best(selected.relaxation[None] * RELAXATION)
            )
            fractions.append(selected.fraction)
        elif (
            len(plant.A) > 1
            and (worst := worst_phases(selected.controller)).min() < needed.uncertain_phase
        ):
            selected, fractions = best(selected.relaxation * steps[[int(np.argmin(worst))]]), []
        else:
            break
    checked = selected.controller.model_dump()
    checked["observer"]["margin"] = margin
    final = RiseDiConfig.validate_mapping(checked, "controller")
    return selected._replace(
        controller=final,
        delay_margin=min(delay_margin(nominal, law, loop) for law in _laws(final)),
    )


def _laws(controller: RiseDiConfig) -> list[LinearLaw]:
    """The linear laws of a controller, for every set of vanes in use."""
    (law, params), period = controller.tuned_law(), 1.0 / controller.rate
    sets = product((False, True), repeat=len(controller.vanes))
    flown = (without_frozen(params, frozen) for frozen in sets)
    return [
        linear_law(TunedLaw(law, law_params), len(controller.outputs), period)
        for law_params in flown
    ]


def _lacking(
    selected: SelectedObserver, nominal: LinearPlant, loop: Loop, margin: float, needed: Requirement
) -> str:
    """The margins missing around the nominal aircraft at the last step of the search, in
    sentences.
    """
    controller = selected.controller
    lacking = []
    for law in _laws(controller):
        margins = loop_margins(nominal, law, loop_of(controller), together=False)
        delay = Condition(
            "delay margin (ms)", None, 1e3 * delay_margin(nominal, law, loop), 1e3 * margin
        )
        failed = failing((delay, *nominal_conditions(margins, needed)))
        lacking += [condition.sentence(controller.outputs) for condition in failed]
    return "; ".join(dict.fromkeys(lacking))


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
