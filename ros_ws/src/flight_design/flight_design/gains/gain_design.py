# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Gains for an airframe in the loop of a scenario, as `rise-di gains` selects and checks them."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from aircraft_sim.airframes.airframe import Airframe, load_airframe
from aircraft_sim.uncertainty import UNIFORM, Spread
from control_laws.nominal_model import NominalModel
from flight_analysis.closed_loop.scenario import Scenario
from flight_analysis.closed_loop.scenario_library import find_scenario
from flight_analysis.linear_loop.delay_margin import MAX_DELAY_MARGIN
from flight_analysis.linear_loop.loop_margins import (
    distribution,
    loop_of,
    of_matrices_and_lags,
    through_allocation,
)
from flight_analysis.linear_loop.told import compare
from flight_core.arguments import (
    FilePath,
    as_count,
    as_names,
    as_number,
    as_numbers,
    as_numbers_by_name,
)
from flight_core.parameters import RATES, require
from flight_core.units import unit_sizes
from flight_core.vectors import FloatArray
from flight_design.gains import gain_selection, ideal_control, tuned_gains
from flight_design.gains.effectors import LAW_INPUT, Effectors, design_allocation, lags_by_input
from flight_design.gains.first_scenario import (
    airframe_to_check,
    controller_alone,
    scenario_to_check,
    scenario_to_design,
)
from flight_design.gains.gain_selection import GainAssessment, LoopSetting, Selection
from flight_design.gains.ideal_control import Effected, Flown, Study
from flight_design.gains.observer_gains import (
    ObserverGains,
    gains_beside_sketch,
    gains_by_rule,
    gains_of_search,
    read_gains,
)
from flight_design.gains.observer_search import SelectedObserver
from flight_design.gains.observer_selection import model_for, with_aircraft_observer
from flight_design.gains.requirement import (
    OBSERVER_REQUIREMENT,
    PHASE_MARGIN,
    Requirement,
    requirement,
)
from rise_di_controller.params import ControllerConfig
from rise_di_controller.rise_di_config import RiseDiConfig

OBSERVER_LAWS = ("rise_observer", "pi_observer")
OBJECTIVE = "gust_turbulence"
"""Objective of the tuned gains at which the search begins. Of the two laws that have such gains,
pi_observer is rise_observer with an integral in place of the sign."""
SLOWER = 1.8
"""Tuned gains are used only if the total lag of each channel is less than this multiple of the lag
with which they were found. On the `osprey` they were found with a lag of 38 ms in q. They have the
margins with 55 ms, but not with 65 and 75 ms. From 75 ms on, the gains of the rule have them."""
BY_RULE = "gains by a rule from the lags, a start"
STABLE = Requirement(phase=1e-3, gain=1.001, sensitivity=1e3, damping=1e-3, worst_phase=0.0)
"""What gains from a file need: only a stable loop."""
DIAGONAL, FULL = MIXINGS = ("diagonal", "full")
MESSAGES = 3.0  # least age limit of the law, in periods of y
MAX_SAMPLES = 10_000
PERFECT_VANE = 1e-4  # rad, noise of a vane that is called perfect
LEAST_SPEED, MOST_SPEED = 0.6, 1.8  # fractions of the trim speed, in the range of the schedule


def select_gains(
    airframe: FilePath | Airframe,
    scenario: FilePath | Scenario = "osprey_servo",
    *,
    uncertainty: float = 0.3,
    rate: float | None = None,
    y_rate: float | None = None,
    lag: ArrayLike | None = None,
    delay: float | None = None,
    inputs: str | Sequence[str] = (),
    gamma_2: float = 0.0,
    samples: int = 100,
    seed: int = 1,
    feedforward: bool = False,
    observer: bool = False,
    model: FilePath | Airframe | None = None,
    margin: float = 0.03,
    speeds: ArrayLike = (),
    weights: FilePath | None = None,
    phase_margin: float = PHASE_MARGIN,
    accept: bool = False,
    mixing: str = DIAGONAL,
    progress: Callable[[str], None] = lambda _: None,
) -> Selection:
    """Select gains for an airframe by Theorem 1 and by the engineering procedure.

    Each gain set comes with every condition. Commands, gusts and loop come from the scenario.
    `scenario.vary(controller=selection.chosen)` flies the engineering gains; `gains_yaml` writes
    them as a section of a scenario file.

    Args:
        airframe: Name in the library, path of an airframe file (.yaml), or an Airframe.
        scenario: Name, path of a file (.yaml) whose controller may lack the gains, or a Scenario.
        uncertainty: Largest relative deviation of each entry of A and B, 0 to 1.
        rate: Rate of the law in Hz. If None, the scenario's rate is used.
        y_rate: Rate of y in Hz. If its period is longer than the law's, the difference counts as
            delay; y is stale after three of its periods.
        lag: Lags of the actuators in s, one for all or one per input in the airframe's order. If
            None, the scenario's lags are used.
        delay: Pure delay in s. If None, the scenario's delay is used.
        inputs: Input of each output, in the airframe's order: a list, or a text with commas. If
            empty, the scenario says the pairs. If its channels differ, they follow from the
            airframe.
        gamma_2: gamma_2 of Lemma 1 in 1/s, an assumption.
        samples: Number of uncertain airframes for the bounds of the theorem, at most 10,000.
        seed: Seed of the uncertain airframes.
        feedforward: Whether the engineering gains use the airframe as the model of a feedforward.
        observer: Whether a feedforward and an observer are added to the gains.
        model: Airframe that the observer takes as its model; None for `airframe`.
        margin: Least delay margin that the nominal loop with the observer must have, s.
        speeds: Two fractions of the trim speed, one below 1 and one above. The observer then has
            models of these speeds and a schedule. If empty, it holds only at the trim speed.
        weights: File of gains and weights at which the search for the margins begins
            (`observer_gains.read_gains`). With `accept` they are taken as they are. If None, the
            search begins at tuned gains of the scenario, or else at gains by a rule from the lags.
        phase_margin: Least phase margin of the nominal loop behind servos, deg; with the observer
            35 suffice. The loop must also have a gain margin of at least 6 dB, a sensitivity of at
            most 2, and a damping of at least 0.4.
        accept: Whether a `phase_margin` below 40 deg is accepted.
        mixing: "diagonal" for one input per output, "full" for an allocation u = T v by the
            pseudo-inverse of C B. With more inputs than outputs there is always an allocation.
        progress: Called with a sentence before each step of the search for the observer.

    Returns:
        The gain set of Theorem 1 and the engineering gains, with the conditions on the gains.

    Raises:
        ParameterError: An argument is invalid, or inputs cannot be paired with outputs.

    Examples:
        >>> selection = rise_di.select_gains("osprey", samples=1)
        >>> len(selection.chosen.beta)
        4
    """
    flight = scenario_to_design(scenario)
    frame = load_airframe(airframe)
    flight.rise_di()
    require(callable(progress), "progress", progress, "a function of a text")
    require(mixing in MIXINGS, "mixing", mixing, " or ".join(MIXINGS))
    loop = _mixed(_loop(flight, frame, rate, y_rate, lag, delay), flight, frame, mixing)
    airframe_of_law = through_allocation(frame, loop.base)
    setting = loop._replace(
        inputs=_pairing(inputs, flight.controller, airframe_of_law),
        gamma_2=as_number(gamma_2, "gamma_2", 0.0, unit="1/s"),
        has_feedforward=feedforward,
        requirement=requirement(phase_margin, accept=accept),
    )
    require(observer or weights is None, "weights", weights, "an observer too: it has the weights")
    require(observer or model is None, "model", model, "an observer too: it estimates by the model")
    margin = as_number(margin, "margin", 0.0, MAX_DELAY_MARGIN, "s")
    pair = _two_speeds(speeds, observer=observer)
    known_model = frame if model is None else load_airframe(model)
    studied = study(frame, flight, setting.base, uncertainty, samples, seed)
    selection = gain_selection.gain_sets(studied, setting)
    if not observer:
        return selection
    needed = _beside_observer(setting.requirement, as_read=weights is not None and accept)
    beside = selected_observer(
        selection.chosen,
        flight,
        known_model,
        margin,
        needed,
        speeds=pair,
        weights=weights,
        progress=progress,
    )
    return replace(selection, chosen=beside.controller, origin=beside.origin)


def _beside_observer(required: Requirement, *, as_read: bool) -> Requirement:
    """Lower a required phase margin to at most the margin that suffices with an observer.

    If the gains are taken `as_read` from a file, the loop only needs to be stable.
    """
    if as_read:
        return STABLE
    return required._replace(phase=min(required.phase, OBSERVER_REQUIREMENT.phase))


def _two_speeds(speeds: ArrayLike, *, observer: bool) -> tuple[float, float] | None:
    """Return the two fractions of the trim speed, or None if `speeds` is empty.

    Raises ParameterError unless one is below 1 and one above, or if there is no observer.
    """
    expected = "two parts of the trim speed, one below 1 and one above: 0.7,1.4"
    ratios = as_numbers(speeds, "speeds", expected)
    require(
        observer or not ratios,
        "speeds",
        speeds,
        "an observer too: the law alone follows the airspeed by a schedule",
    )
    pair = (ratios[0], ratios[1]) if len(ratios) == 2 else None
    fits = not ratios or (pair is not None and LEAST_SPEED <= pair[0] < 1.0 < pair[1] <= MOST_SPEED)
    require(fits, "speeds", speeds, f"{expected}, from {LEAST_SPEED:g} to {MOST_SPEED:g}")
    return pair


def check_gains(
    airframe: FilePath | Airframe,
    scenario: FilePath | Scenario = "osprey_servo",
    *,
    uncertainty: float = 0.3,
    gamma_2: float = 0.0,
    samples: int = 100,
    seed: int = 1,
    entries: Mapping[str, float] = UNIFORM.entries,
    zeros: float = 0.0,
    as_told: bool = False,
) -> GainAssessment[ControllerConfig]:
    """Evaluate all conditions on the gains of a scenario, and the margins of its loop.

    The law need not be RISE-DI. Lags and delay come from the scenario's aircraft, even if the
    controller was designed for others.

    Args:
        airframe: Name in the library, path of an airframe file (.yaml), or an Airframe. If the
            scenario flies an aircraft of JSBSim, you can name it, as jsbsim:c172p; the model is
            then y_dot = Omega u.
        scenario: Name, path of a scenario file (.yaml), or a Scenario. A controller that is alone
            in its file gets the commands, gusts and rate limits of osprey_servo.
        uncertainty: Largest relative deviation of each entry of A and B, 0 to 1.
        gamma_2: gamma_2 of Lemma 1 in 1/s, an assumption.
        samples: Number of uncertain airframes for the bounds of the theorem, at most 10,000.
        seed: Seed of the uncertain airframes.
        entries: Largest relative deviations, {"A[q,alpha]": 0.6, "1/lag[elevator]": 0.3}.
        zeros: Largest value of an entry that is 0 in the file, as a fraction of its row's size.
        as_told: Whether to take lags and delay from the controller, not from the aircraft in the
            scenario. Set it if this aircraft only stands in for your own.

    Returns:
        The controller, the conditions and the margins.

    Raises:
        ParameterError: An argument is invalid.

    Examples:
        >>> rise_di.check_gains("osprey", samples=1).delay_margin > 0.03
        True
    """
    flight = scenario_to_check(scenario)
    frame = airframe_to_check(airframe, flight)
    gamma_2 = as_number(gamma_2, "gamma_2", 0.0, unit="1/s")
    parts = as_numbers_by_name(entries, "entries", '{"1/lag[elevator]": 0.3}')
    spread = Spread(parts, zeros=as_number(zeros, "zeros", 0.0, 1.0))
    is_flown = not as_told and controller_alone(scenario) is None
    flown = Flown(flight, compare(flight, flight.controller)) if is_flown else None
    studied = study(frame, flight, flight.controller, uncertainty, samples, seed, spread, flown)
    return gain_selection.assess_scenario(flight, studied, gamma_2)


def study(
    airframe: Airframe,
    scenario: Scenario,
    controller: ControllerConfig,
    uncertainty: float,
    samples: int,
    seed: int,
    spread: Spread = UNIFORM,
    flown: Flown | None = None,
) -> Study:
    """Compute the `Study` of an airframe and of uncertain airframes around it.

    The inputs are the inputs of the law, before an allocation. Commands and gusts come from the
    scenario. Lags and delay come from `flown` or, if it is None, from the controller. Raises
    ParameterError.
    """
    timing = loop_of(controller) if flown is None else flown.comparison.timing
    matrices, _ = of_matrices_and_lags(spread, timing, controller.inputs)
    effective = through_allocation(airframe, controller)
    behind = None
    if effective is not airframe:
        behind = Effected(airframe, distribution(airframe, controller))
    return ideal_control.study_airframe(
        effective,
        ideal_control.manoeuvre(scenario, effective),
        as_number(uncertainty, "uncertainty", 0.0, 1.0),
        as_count(samples, "samples", 0, MAX_SAMPLES),
        as_count(seed, "seed", 0),
        behind,
        matrices,
    )._replace(spread=spread, flown=flown)


def _loop(
    scenario: Scenario,
    airframe: Airframe,
    rate: float | None,
    y_rate: float | None,
    lag: ArrayLike | None,
    delay: float | None,
) -> LoopSetting:
    """Return the loop of a scenario, with the changes that the arguments ask for.

    `rate` and `y_rate` are rates of the law and of y, Hz; `lag` and `delay` are in s. The law runs
    once per sample of y, so sampling causes a lag of 1.5 periods of y. The loop includes only 1.5
    periods of the law, so the difference is added to the delay. Raises ParameterError if a rate,
    the delay or a lag is out of its range.
    """
    loop = gain_selection.loop_setting(scenario)
    if rate is not None:
        loop = loop._replace(rate=as_number(rate, "rate", *RATES, "Hz"))
    if delay is not None:
        loop = loop._replace(delay=as_number(delay, "delay", 0.0, MAX_DELAY_MARGIN, "s"))
    if lag is not None:
        loop = loop._replace(lag=lags_by_input(lag, airframe))
    if y_rate is not None:
        y_rate = as_number(y_rate, "y_rate", *RATES, "Hz")
        age = max(loop.base.max_age, MESSAGES / y_rate)
        loop = loop._replace(
            delay=loop.delay + 1.5 * max(1.0 / y_rate - 1.0 / loop.rate, 0.0),
            base=loop.base.model_copy(update={"max_age": age}),
        )
    return loop


def _mixed(loop: LoopSetting, scenario: Scenario, airframe: Airframe, mixing: str) -> LoopSetting:
    """Add an allocation to the loop if it needs one, and limits of the actuators if it does not."""
    if mixing == FULL or len(airframe.inputs) > len(airframe.outputs):
        return _allocated(loop, scenario, airframe)
    return _with_limits(_without_allocation(loop, scenario), scenario, airframe)


def _with_limits(loop: LoopSetting, scenario: Scenario, airframe: Airframe) -> LoopSetting:
    """Limit u within the end stops of the scenario's actuators.

    If the scenario flies another aircraft than this airframe, the loop gets no limits.
    """
    aircraft = scenario.aircraft
    if aircraft.is_jsbsim or load_airframe(aircraft.airframe).name != airframe.name:
        return loop._replace(
            base=loop.base.model_copy(update=dict.fromkeys(gain_selection.INPUT_LIMITS))
        )
    limits = {}
    for key, tighter in (("lower", max), ("upper", min)):
        stops = getattr(aircraft.actuators, key)
        if stops:
            by_input = dict(zip(aircraft.channels().inputs, stops, strict=True))
            bounds = getattr(loop.base, key) or [by_input[name] for name in loop.base.inputs]
            limits[key] = tuple(
                tighter(value, by_input[name])
                for value, name in zip(bounds, loop.base.inputs, strict=True)
            )
    return loop._replace(base=loop.base.model_copy(update=limits))


def _pairing(
    inputs: str | Sequence[str], controller: ControllerConfig, airframe: Airframe
) -> tuple[str, ...]:
    """Return the input of each output: from `inputs`, or if that is empty, from the controller.

    The result is () if the controller is used but has an allocation or other inputs.
    """
    names = as_names(inputs, "inputs", f"the inputs {', '.join(airframe.inputs)} in any order")
    if names:
        return names
    pairs = dict(zip(controller.outputs, controller.inputs, strict=True))
    drivers = tuple(pairs.get(name, "") for name in airframe.outputs)
    same = controller.allocation is None and sorted(drivers) == sorted(airframe.inputs)
    return drivers if same else ()


def _without_allocation(loop: LoopSetting, scenario: Scenario) -> LoopSetting:
    """Return a loop without its allocation. It has the inputs and lags of the actuators."""
    if loop.base.allocation is None:
        return loop
    names = tuple(scenario.aircraft.channels().inputs)
    actuators = scenario.aircraft.actuators
    plain = {"allocation": None, "inputs": names, **dict.fromkeys(gain_selection.INPUT_LIMITS)}
    lag = dict(zip(names, actuators.lag or [0.0] * len(names), strict=True))
    return loop._replace(base=loop.base.model_copy(update=plain), lag=lag | dict(loop.lag))


def _allocated(loop: LoopSetting, scenario: Scenario, airframe: Airframe) -> LoopSetting:
    """Add an allocation to the loop, from the airframe's C B.

    A lag that the loop lacks comes from the actuators. Raises ParameterError if the actuators have
    no end stops.
    """
    actuators = scenario.aircraft.actuators
    names = list(airframe.inputs)
    # The effectors have the end stops, rates and lags of the scenario's actuators.
    same_airframe = (
        not scenario.aircraft.is_jsbsim
        and load_airframe(scenario.aircraft.airframe).name == airframe.name
    )
    stops = same_airframe and actuators.lower and actuators.upper
    require(
        bool(stops),
        "scenario",
        scenario.name,
        f"a scenario of {airframe.name} with aircraft.actuators, lower and upper",
    )
    lags = dict(zip(names, actuators.lag or [0.0] * len(names), strict=True)) | dict(loop.lag)
    rate = np.array(actuators.rate or [np.inf] * len(names))
    lag = np.array([lags[name] for name in names])
    effectors = Effectors(np.array(actuators.lower), np.array(actuators.upper), rate, lag)
    earlier = loop.base.allocation
    ranked = () if earlier is None or earlier.priority is None else earlier.priority
    priority = [name.removeprefix(LAW_INPUT) for name in ranked]
    allocation, law = design_allocation(airframe, effectors, priority)
    m = len(law.names)
    slew = dict(zip(law.names, law.slew.tolist(), strict=True))
    # The law has other inputs now, so models and gains still have to be selected.
    base = {
        "outputs": airframe.outputs,
        "inputs": law.names,
        "allocation": allocation.model_dump(),
        "lower": law.lower.tolist(),
        "upper": law.upper.tolist(),
        "slew": None,
        "D": [1] * m,
        "lag": law.lag.tolist(),
        "k_d": [1.0] * (m - 1),
        **dict.fromkeys(("Lambda", "beta", "omega", "input_scale"), [1.0] * m),
        "softening": 1.0,
        "feedforward": None,
        "observer": None,
        "learn": None,
        "schedule": None,
    }
    return loop._replace(
        base=RiseDiConfig.validate_mapping(scenario.rise_di().model_dump() | base, "controller"),
        lag=dict(zip(law.names, law.lag.tolist(), strict=True)),
        rate_limit={name: limit for name, limit in slew.items() if np.isfinite(limit)},
    )


def selected_observer(
    controller: RiseDiConfig,
    scenario: Scenario,
    model: Airframe,
    margin: float | FloatArray,
    requirement: Requirement = OBSERVER_REQUIREMENT,
    *,
    uncertain: bool = True,
    sketched: bool = False,
    speeds: tuple[float, float] | None = None,
    weights: FilePath | None = None,
    earlier_design: SelectedObserver | None = None,
    is_free: Sequence[bool] | None = None,
    activity: float = 1.0,
    progress: Callable[[str], None] = lambda _: None,
) -> SelectedObserver:
    """Add the feedforward and observer of a model to a controller.

    The result also has a text that says where the gains come from. The search for the least error
    begins at these gain sets:

    - If there is a file `weights`: the gains in the file.
    - If `sketched`: gains for a model that is only a rough sketch of the aircraft.
    - In other cases: the gains that `rise-di compare --tune` found in the scenario, or in a shipped
      one with the same airframe and lags. If the model has other states, or at least SLOWER times
      the total lag of that search, a rule derives gains from the lags.

    The gains of a file or for a sketch only change if the margins need lower gains. Channels that
    are not free keep their gains. The other arguments are as for `with_aircraft_observer`.
    """
    seen = through_allocation(model, controller)
    noise, vanes = _noise(controller, scenario, seen)
    nominal = model_for(seen, controller, noise)
    if weights is None:
        candidates = _gain_sets(controller, scenario, seen, nominal, sketched=sketched)
    else:
        gains = read_gains(Path(weights), nominal.total_lag, len(model.gusts), len(model.states))
        candidates = [(gains, f"gains of {Path(weights).name}")]
    if earlier_design is not None and not all(is_free or ()):
        candidates = [candidates[earlier_design.place]]
    sets, origins = zip(*candidates, strict=True)
    selected = with_aircraft_observer(
        controller,
        model,
        sets,
        noise,
        margin,
        requirement,
        vanes,
        uncertain=uncertain,
        speeds=speeds,
        keeps_gains=sketched or weights is not None,
        earlier_design=earlier_design,
        is_free=is_free,
        activity=activity,
        progress=progress,
    )
    origin = origins[selected.place]
    factors = zip(selected.controller.outputs, selected.relaxation.tolist(), strict=True)
    listing = ", ".join(f"{output} {factor:.2f}" for output, factor in factors if factor != 1.0)
    changes = f"; K and integral /, effort x {listing}" if listing else ""
    margins = (
        f"delay margin {1e3 * selected.delay_margin:.0f} ms, phase margin "
        f"{np.degrees(selected.phase_margin):.0f} deg"
    )
    vane_text = f" with vanes for {' and '.join(vanes)}" if vanes else ""
    sentence = f"{origin}{changes}; {margins}{selected.not_counted()}"
    return selected._replace(origin=f"observer of {model.name}{vane_text}: {sentence}")


def _noise(
    controller: RiseDiConfig, scenario: Scenario, model: Airframe
) -> tuple[FloatArray, dict[str, float]]:
    """Return the noise of the outputs, (m,), and the noise of the vanes by channel, rms per sample.

    A vane is left out if its angle is not a state of the model. A perfect sensor gets a small
    value.
    """
    channels = scenario.aircraft.channels().outputs
    measured = scenario.aircraft.sensors.noise or (0.0,) * len(channels)
    by_name = dict(zip(channels, measured, strict=True))
    perfect = unit_sizes(model.units_of_outputs()[name] for name in controller.outputs) / 100.0
    noise = np.array(
        [by_name[name] or least for name, least in zip(controller.outputs, perfect, strict=True)]
    )
    vanes = [name for name in scenario.aircraft.vanes.channels if name in model.states]
    return noise, {name: by_name[name] or PERFECT_VANE for name in vanes}


def _gain_sets(
    controller: RiseDiConfig,
    scenario: Scenario,
    model: Airframe,
    nominal: NominalModel,
    *,
    sketched: bool,
) -> list[tuple[ObserverGains, str]]:
    """Return the gain sets at which the search begins, each with a sentence on its origin."""
    axes = tuple(model.gusts)
    if sketched:
        gains = gains_beside_sketch(nominal, controller.outputs, axes, model.speed)
        return [(gains, BY_RULE)]
    flight = _tuned_scenario(scenario)
    results = {law: tuned_gains.find(flight, law, OBJECTIVE) for law in OBSERVER_LAWS}
    searched = [(law, result) for law, result in results.items() if result is not None]
    searched.sort(key=lambda row: row[1].cost)
    tuned_lag = dict(zip(flight.controller.outputs, loop_of(flight.controller).total, strict=True))
    ratios = [
        lag / tuned_lag.get(name, np.inf)
        for name, lag in zip(controller.outputs, nominal.total_lag, strict=True)
    ]
    states = tuple(scenario.aircraft.load()[0].states)
    if not searched or max(ratios) >= SLOWER or states != tuple(model.states):
        return [(gains_by_rule(nominal, axes, model.speed), BY_RULE)]
    return [
        (
            gains_of_search(result.gains, nominal.total_lag),
            f"gains of a search in {flight.name}, law {law} on {OBJECTIVE}",
        )
        for law, result in searched
    ]


@lru_cache
def _shipped(name: str) -> Scenario:
    """Read a scenario of the library, and cache it, because a learner designs every few seconds."""
    return find_scenario(name)


def _tuned_scenario(scenario: Scenario) -> Scenario:
    """Return a scenario that has tuned gains: the given scenario, or a shipped one.

    A shipped scenario must have the same airframe and actuators.
    """
    shipped = (_shipped(path.stem) for path in sorted(tuned_gains.TUNED.glob("*.yaml")))
    model = scenario.aircraft.airframe, scenario.aircraft.actuators.lag
    equal = (
        candidate
        for candidate in shipped
        if (candidate.aircraft.airframe, candidate.aircraft.actuators.lag) == model
    )
    return next(
        (
            candidate
            for candidate in (scenario, *equal)
            if tuned_gains.load(tuned_gains.tuned_file(candidate))
        ),
        scenario,
    )
