# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Select two gain sets for an airframe, and assess gain sets.

The gain sets follow from the ideal control of the airframe along a manoeuvre.

`study_airframe` computes the rates of the ideal control, for the airframe as published and for
uncertain airframes around it. `gain_sets` derives one gain set by Theorem 1 and one by the
engineering procedure. `assess_scenario` assesses the gains of a scenario: conditions, stability and
delay margin. `gain_yaml.selection_yaml` writes a gain set as a section of a scenario file.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Generic, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from flight_analysis.closed_loop.scenario import Scenario
from flight_analysis.linear_loop.loop_margins import (
    LinearLoop,
    LoopMargins,
    as_compared,
    is_literal,
    law_order,
    linear_loop,
    loop_margins,
    with_box,
)
from flight_core.parameters import LARGEST, require
from flight_core.vectors import FloatArray
from flight_design.gains import gain_conditions
from flight_design.gains.channel_signs import signs_of_pairing
from flight_design.gains.feedforward_model import with_feedforward
from flight_design.gains.gain_conditions import Bounds, GainCondition, GainSet, Relation
from flight_design.gains.ideal_control import ChannelPairing, Study
from flight_design.gains.lyapunov import KnownPlant, decay_matrix
from flight_design.gains.requirement import NAMES as REQUIRED
from flight_design.gains.requirement import (
    OBSERVER_REQUIREMENT,
    Candidate,
    Requirement,
    above_zeros,
    margin_conditions,
    within_requirement,
)
from rise_di_controller.law.decomposition import DecompositionError, signs
from rise_di_controller.law.law import Sign
from rise_di_controller.law.linear_loop import LoopTiming, is_stable
from rise_di_controller.params import ControllerConfig
from rise_di_controller.rise_di_config import RiseDiConfig

CROSSOVER_LAG_PRODUCTS: Mapping[str, float] = {
    "q": 0.63,
    "p": 0.63,
    "r": 0.46,
    "V": 0.46,
    "climb": 0.46,
}
"""Bandwidth of a channel times the lag of its loop, rad, by output, where the search begins: 0.63
and 0.46 cost 36 and 26 degrees of phase at the crossover. That of yaw is lower because of the dutch
roll, and that of speed because of the engine. The integral (Lambda and the slope of the softened
sign) costs more phase. The search makes the integral slower, and lowers the bandwidth if that is
not enough, until the margins meet the requirement."""

DEFAULT_CROSSOVER_LAG_PRODUCT = 0.23  # rad, for an output that is not in CROSSOVER_LAG_PRODUCTS

SOFTENING = 2.75  # width of the softened sign at the start of the search, in total lags

BETA_TO_SLEW = 1.25
"""beta divided by the largest slew of the ideal control. The law needs at least 1. More than 1.5
gained nothing on the `osprey`."""

# limits of the controller, one per input; they are reordered with the inputs
INPUT_LIMITS = ("lower", "upper", "slew")


# step of V / V0 in the search for the largest speed with a delay margin
SPEED_STEP = 0.05
MAX_SPEED_RATIO = 3.0

# name of the condition on the fraction of uncertain aircraft whose loop is stable
STABILITY = "linear stability"

Controller = TypeVar("Controller", bound=ControllerConfig)


class LoopSetting(NamedTuple):
    """The loop for which gains are selected, and the settings of the selection."""

    base: ControllerConfig  # source of all parameters that are not selected: max_age, limits
    rate: float  # Hz
    lag: Mapping[str, float]  # s, by input; 0 for an input without lag
    delay: float  # s
    rate_limit: Mapping[str, float]  # SI, by input; an input without entry is not limited
    gamma_2: float = 0.0  # 1/s, an assumption: 0 gives the smallest bounds (29), (30)
    factor: float = BETA_TO_SLEW  # beta divided by the slew of the ideal control
    crossover_lag_products: Mapping[str, float] = CROSSOVER_LAG_PRODUCTS
    # input of each output, in the airframe's order; if empty, the airframe's pairing holds
    inputs: tuple[str, ...] = ()
    # whether the result uses the published airframe as model of a feedforward
    has_feedforward: bool = False
    requirement: Requirement = Requirement()


class GainAssessment(NamedTuple, Generic[Controller]):
    """A controller, every condition on its gains, and the margins of its loop."""

    controller: Controller
    theorem: tuple[GainCondition, ...]  # empty for a law other than RISE-DI
    # rules of the engineering procedure; empty with an observer, and for a law other than RISE-DI
    rules: tuple[GainCondition, ...]
    loop: tuple[GainCondition, ...]
    bounds: Bounds | None  # None for a law other than RISE-DI
    margins: LoopMargins | None  # None if the law has the literal sign
    study: Study  # study of the airframe

    @property
    def delay_margin(self) -> float | None:
        """Largest delay in all channels at once that the nominal loop tolerates, s.

        It is None for the literal sign.
        """
        return None if self.margins is None else self.margins.delay

    @property
    def channel_margins(self) -> tuple[float, ...]:
        """Largest delay in each single channel that the nominal loop tolerates, s.

        The tuple is empty for the literal sign.
        """
        return () if self.margins is None else self.margins.channel_delay

    def loop_with_box(self) -> LinearLoop:
        """Return the linear loop of the controller, with the deviations of the study as its box.

        Raises ParameterError for the literal sign.
        """
        return loop_with_box(self.study, self.controller)

    @property
    def has_requirement(self) -> bool:
        """Whether the loop must have certain margins.

        If the law has the implicit or the literal sign, no margins are required.
        """
        return any(condition.name in REQUIRED for condition in self.loop)

    @property
    def unmet(self) -> tuple[GainCondition, ...]:
        """Required margins that the loop does not reach."""
        return tuple(
            condition
            for condition in gain_conditions.failing(self.loop)
            if condition.name in REQUIRED
        )

    @property
    def is_stable(self) -> bool:
        """Whether the loop is stable for the nominal and every uncertain aircraft.

        It is False for the literal sign, which has no linear loop.
        """
        named = (condition for condition in self.loop if condition.name == STABILITY)
        return self.margins is not None and all(condition.is_met for condition in named)


def loop_with_box(study: Study, controller: ControllerConfig) -> LinearLoop:
    """Return the linear loop of a controller, with the deviations of a study as its box."""
    timing = study.timing_of(controller)
    loop = linear_loop(controller, study.airframe, study.A, study.B, timing)
    airframe = study.airframe if study.effected is None else study.effected.airframe
    boxed = with_box(loop, airframe, controller, study.uncertainty, study.seed, study.spread)
    if study.flown is None:
        return boxed
    return as_compared(boxed, study.flown.scenario, study.flown.comparison)


@dataclass(frozen=True)
class Selection:
    """The two gain sets that are selected for an airframe.

    A gain set is assessed when it is first used, because the margins of all samples take most of
    the time.
    """

    study: Study
    setting: LoopSetting
    literal: RiseDiConfig  # the gain set of Theorem 1
    chosen: RiseDiConfig  # the engineering gains
    origin: str = ""  # with an observer: a sentence on how the gains of the law were selected

    @cached_property
    def theorem(self) -> GainAssessment[RiseDiConfig]:
        """The gain set of Theorem 1, with conditions and margins of its loop."""
        return assess_gains(self.study, self.literal, self.setting)

    @cached_property
    def engineering(self) -> GainAssessment[RiseDiConfig]:
        """The gain set of the engineering procedure, with conditions and margins of its loop."""
        return assess_gains(self.study, self.chosen, self.setting)


def gain_sets(study: Study, setting: LoopSetting) -> Selection:
    """Derive two gain sets for an airframe: by Theorem 1 and by the engineering procedure.

    The set by Theorem 1 has the literal sign. In both sets the fastest channel comes first, so the
    last has the smallest K. Inputs are scaled by 1 / abs(Omega_ii), and D follows from the leading
    minors of Omega. The theorem's set is `theorem_gains` with a Lambda of 1 (1/s), which needs the
    smallest k_g. The other set is `engineering_gains` with the `slew` of the nominal airframe.
    Behind servos, `within_requirement` searches for the integral gains and bandwidths with the
    least error. The margins must meet the requirement on the nominal airframe and on every sample.
    `omega` is the largest abs(Omega_ii) of the samples. Raises ParameterError as `signs_of_pairing`
    does, and for parameters that the controller does not accept.
    """
    pairs = _paired(study, setting)
    engineering = gain_candidates(study, setting)
    first = engineering(np.ones(len(pairs.rows)), np.ones(len(pairs.rows))).controller
    gains = first
    if first.sampled_sign() is Sign.SOFT:  # behind servos
        rates = study.u_dot[:, 0][:, pairs.columns]
        gains = within_requirement(engineering, setting.requirement, rates).controller
    gains = with_feedforward(gains, study.airframe) if setting.has_feedforward else gains
    return Selection(study, setting, _literal(study, setting, pairs), gains)


def gain_candidates(
    study: Study, setting: LoopSetting
) -> Callable[[FloatArray, FloatArray], Candidate[RiseDiConfig]]:
    """Return a function that builds engineering gains and their loop from `slower` and `lower`.

    Both arguments of this function are factors of shape (m,). `lower` divides the bandwidth, and
    both divide the integral gain. Raises ParameterError as `gain_sets` does.
    """
    pairs = _paired(study, setting)
    limits = (
        study.slew[pairs.columns] / pairs.unit,
        setting.factor,
        _by_name(setting.rate_limit, pairs.channels.inputs, math.inf) / pairs.unit,
    )
    controller = partial(_controller, setting, pairs)

    def engineering(slower: FloatArray, lower: FloatArray) -> Candidate[RiseDiConfig]:
        selected = gain_conditions.engineering_gains(pairs.bandwidth / lower, *limits, slower)
        # both terms of the integral fall with the bandwidth
        config = controller(*selected, slower * lower)
        return Candidate(config, linear_loop(config, study.airframe, study.A, study.B))

    return engineering


class _Paired(NamedTuple):
    """The channels of a selection, in the order of (22): the fastest one comes first.

    Equation (22) gives the last channel the smallest K.
    """

    channels: ChannelPairing
    rows: list[int]  # indices of the outputs, in the airframe's order
    columns: list[int]  # indices of the inputs
    bandwidth: FloatArray  # (m,) rad/s, at the start of the search
    D: FloatArray  # (m,)
    unit: FloatArray  # (m,) 1 / abs(Omega_ii)
    largest_response: FloatArray  # (m,) largest abs(Omega_ii) of the samples


def _paired(study: Study, setting: LoopSetting) -> _Paired:
    """Pair the outputs and inputs of a study, and order the channels, the fastest first.

    Raises ParameterError as `signs_of_pairing` does.
    """
    inputs = list(study.airframe.inputs)
    pairing = ChannelPairing(study.airframe.outputs, setting.inputs or tuple(inputs))
    require(
        sorted(pairing.inputs) == sorted(inputs),
        "inputs",
        ", ".join(pairing.inputs),
        f"{', '.join(inputs)} in any order",
    )
    paired = [inputs.index(name) for name in pairing.inputs]
    Omega = study.Omega[:, paired]
    signs_of_pairing(Omega, pairing)
    products = [
        setting.crossover_lag_products.get(name, DEFAULT_CROSSOVER_LAG_PRODUCT)
        for name in pairing.outputs
    ]
    loop = LoopTiming(_by_name(setting.lag, pairing.inputs, 0.0), setting.delay, 1.0 / setting.rate)
    bandwidth = gain_conditions.bandwidths(loop, np.array(products))
    rows = np.argsort(-bandwidth, kind="stable").tolist()
    channels = ChannelPairing(
        tuple(pairing.outputs[i] for i in rows), tuple(pairing.inputs[i] for i in rows)
    )
    columns = [paired[i] for i in rows]
    responses = np.einsum("Nii->Ni", (study.C @ study.B)[:, rows][..., columns])
    return _Paired(
        channels=channels,
        rows=rows,
        columns=columns,
        bandwidth=bandwidth[rows],
        D=signs_of_pairing(Omega[np.ix_(rows, rows)], channels),
        unit=1.0 / np.abs(np.diag(Omega))[rows],
        largest_response=np.abs(responses).max(axis=0),
    )


def _literal(study: Study, setting: LoopSetting, pairs: _Paired) -> RiseDiConfig:
    """Return the gain set of Theorem 1."""
    ones = np.ones(len(pairs.rows))
    bounds, *_ = _bounds(
        study, pairs.rows, pairs.columns, pairs.unit, pairs.D, ones, setting.gamma_2
    )
    sufficient = gain_conditions.theorem_gains(bounds, ones)
    # The theorem may demand gains beyond those that a controller takes: for the f16 of JSBSim, k_d
    # is 2e17 1/s.
    rows = (sufficient.k_d, sufficient.Lambda, sufficient.beta)
    accepted = GainSet(
        min(sufficient.k_g, LARGEST), *(np.minimum(values, LARGEST) for values in rows)
    )
    exact = {name: tuple(getattr(sufficient, name).tolist()) for name in GainSet._fields[1:]}
    return _controller(setting, pairs, accepted, ones, ones).model_copy(
        update={"k_g": float(sufficient.k_g)} | exact
    )


def _controller(
    setting: LoopSetting,
    pairs: _Paired,
    gains: GainSet,
    scaled_response: FloatArray,
    slower: FloatArray,
) -> RiseDiConfig:
    """Build the controller with the gains.

    The integral gain is divided by `slower`. In the scaled inputs abs(Omega_ii) is
    `scaled_response`.
    """
    channels = pairs.channels
    scale = pairs.unit * scaled_response
    base_inputs = setting.base.inputs
    softening = (SOFTENING * np.broadcast_to(slower, scaled_response.shape)).tolist()
    has_limits = set(channels.inputs) <= set(base_inputs)
    limits = {key: getattr(setting.base, key) for key in INPUT_LIMITS} if has_limits else {}
    values = setting.base.model_dump(exclude=set(INPUT_LIMITS)) | {
        "rate": setting.rate,
        "outputs": channels.outputs,
        "inputs": channels.inputs,
        "k_g": gains.k_g,
        "k_d": gains.k_d.tolist(),
        "Lambda": gains.Lambda.tolist(),
        "beta": gains.beta.tolist(),
        "D": pairs.D.astype(int).tolist(),
        "input_scale": scale.tolist(),
        "omega": (pairs.largest_response * scale).tolist(),
        "sign": "auto",
        "lag": _by_name(setting.lag, channels.inputs, 0.0).tolist(),
        "delay": setting.delay,
        "softening": softening if len(set(softening)) > 1 else softening[0],
        "feedforward": None,
        "observer": None,
    }
    for key, row in limits.items():
        if row:
            values[key] = [row[base_inputs.index(name)] for name in channels.inputs]
    if setting.base.allocation is not None:
        values["allocation"] = setting.base.allocation.ordered(
            base_inputs, channels.inputs
        ).model_dump()
    return RiseDiConfig.validate_mapping(values, "controller")


def assess_scenario(
    scenario: Scenario, study: Study, gamma_2: float = 0.0
) -> GainAssessment[ControllerConfig]:
    """Evaluate every condition on the gains in a scenario's controller.

    The study must have the commands and gusts of the scenario, so the airframe must have its
    outputs. Raises ParameterError if D or the pairing contradicts the airframe.
    """
    return assess_gains(study, scenario.controller, loop_setting(scenario, gamma_2))


def loop_setting(scenario: Scenario, gamma_2: float = 0.0) -> LoopSetting:
    """Return the loop of a scenario.

    The rate limit of an input is the lower one of two limits: the controller's and the actuator's.
    """
    controller = scenario.controller
    rates = scenario.aircraft.actuators.rate
    slew = dict(zip(controller.inputs, controller.slew or (), strict=bool(controller.slew)))
    limits = dict(zip(scenario.aircraft.channels().inputs, rates, strict=bool(rates)))
    return LoopSetting(
        base=controller,
        rate=controller.rate,
        lag=dict(zip(controller.inputs, controller.lag, strict=True)),
        delay=controller.delay,
        rate_limit={
            name: min(slew.get(name, math.inf), limits.get(name, math.inf))
            for name in controller.inputs
        },
        gamma_2=gamma_2,
    )


def assess_gains(
    study: Study, controller: Controller, setting: LoopSetting
) -> GainAssessment[Controller]:
    """Evaluate every condition on a gain set.

    Rate, lag and delay come from the controller, gamma_2 and rate limits from the setting.

    If the law is RISE-DI, the conditions of `_rise_di_conditions` are evaluated. The linear loop of
    any law must be stable for every sample, and have the required margins. With an observer, 35
    degrees of phase margin suffice. The delay margin of the nominal loop must be at least one
    period, so that a tick may be missed. With an observer it must be at least the margin that the
    observer declares, less the delay. With the implicit sign, the loop is linear only inside the
    sign's width, dt^2 omega beta, and no margins are required. The delay margin is then the delay
    at which chatter begins, at most half a period.
    """
    rows, columns = law_order(study.airframe, controller)
    channels = ChannelPairing(controller.outputs, controller.inputs)
    D = signs_of_pairing(study.Omega[np.ix_(rows, columns)], channels, controller.D)
    theorem: tuple[GainCondition, ...] = ()
    rules: tuple[GainCondition, ...] = ()
    loop_conditions: tuple[GainCondition, ...] = ()
    bounds = None
    if isinstance(controller, RiseDiConfig):
        theorem, rules, loop_conditions, bounds = _rise_di_conditions(study, controller, setting, D)
    if is_literal(controller):
        return GainAssessment(
            controller=controller,
            theorem=theorem,
            rules=rules,
            loop=loop_conditions,
            bounds=bounds,
            margins=None,
            study=study,
        )
    loop = loop_with_box(study, controller)
    margins = loop_margins(loop)
    stable = (margins.stable + float(margins.nominal.stable)) / len(study.A)
    loop_conditions += (GainCondition(STABILITY, None, stable, 1.0),)
    if not (isinstance(controller, RiseDiConfig) and controller.sampled_sign() is Sign.IMPLICIT):
        observer = controller.observer
        requirement = above_zeros(setting.requirement, loop.nominal)
        least = 1.0 / controller.rate if observer is None else observer.margin - loop.loop.delay
        if observer is not None:
            phase = min(requirement.phase, OBSERVER_REQUIREMENT.phase)
            requirement = requirement._replace(phase=phase)
        loop_conditions += (
            GainCondition("delay margin", None, margins.delay, least),
            *margin_conditions(margins, requirement),
        )
    return GainAssessment(
        controller=controller,
        theorem=theorem,
        rules=rules,
        loop=loop_conditions,
        bounds=bounds,
        margins=margins,
        study=study,
    )


def _rise_di_conditions(
    study: Study, controller: RiseDiConfig, setting: LoopSetting, D: FloatArray
) -> tuple[tuple[GainCondition, ...], tuple[GainCondition, ...], tuple[GainCondition, ...], Bounds]:
    """Evaluate the conditions of Theorem 1, `check_rules` and `check_loop`, in this order.

    The last entry of the result has the bounds of the theorem. `check_rules` and `check_loop` apply
    only without an observer.

    The value of the condition "D" is the fraction of the samples whose Omega has the signs D. The
    value of "zero dynamics" is the fraction whose zeros are stable. The bounds of (29), (30), steps
    2 and 3 are the largest over the samples that meet both conditions. "V2_dot" is the smallest
    eigenvalue of Q in V2_dot = -z'Qz over these samples; steps 2 and 3 are sufficient for Q > 0.
    """
    rows, columns = law_order(study.airframe, controller)
    params = controller.law_params()
    bounds, has_signs, is_counted = _bounds(
        study, rows, columns, params.input_scale, D, params.Lambda, setting.gamma_2
    )
    gains = GainSet(controller.k_g, np.array(controller.k_d), params.Lambda, params.beta)
    C = study.C[rows]
    Bs = study.B[:, :, columns]
    plants = [
        KnownPlant(A, B * params.input_scale, C, lambda _, x: 0.0 * x)
        for A, B in zip(study.A[is_counted], Bs[is_counted], strict=True)
    ]
    decay_rate = min(
        float(np.linalg.eigvalsh(decay_matrix(plant, params)).min()) for plant in plants
    )
    theorem = (
        GainCondition("D (11)", None, float(np.mean(has_signs)), 1.0),
        GainCondition("zero dynamics", None, float(np.mean(study.stable)), 1.0),
        *gain_conditions.check_theorem(gains, bounds),
        GainCondition("V2_dot", None, decay_rate, 0.0, Relation.ABOVE),
    )
    # the engineering rules hold only without an observer
    if controller.observer is not None:
        return theorem, (), (), bounds
    responses = np.abs(np.einsum("Nii->Ni", C @ Bs))[is_counted] * params.input_scale
    rate_limit = _by_name(setting.rate_limit, controller.inputs, math.inf)
    slew, fastest = (values / params.input_scale for values in (study.slew[columns], rate_limit))
    timing = study.timing_of(controller)
    rules = gain_conditions.check_rules(params, timing, responses[0], slew)
    conditions = gain_conditions.check_loop(
        params, timing, responses[0], responses.max(axis=0), fastest
    )
    return theorem, rules, conditions, bounds


def response(study: Study, controller: ControllerConfig) -> FloatArray:
    """Compute abs(Omega_ii) in a controller's scaled inputs, in the law's order, shape (m,).

    The value is less than 1 in a channel that is too slow for (22), and 1 in all others.
    """
    rows, columns = law_order(study.airframe, controller)
    scale = getattr(controller, "input_scale", 1.0)
    return np.asarray(np.abs(study.Omega[rows, columns]) * scale)


def stable_speed_ratio(study: Study, controller: ControllerConfig) -> float:
    """Return the largest V / V0 up to which the same gains have a positive delay margin.

    The response to every input grows with V^2, except the response to the input of V. Everything
    else stays as in trim. The result is a multiple of SPEED_STEP. It is 0 if there is no delay
    margin in trim, and infinite if the linear loop is stable up to MAX_SPEED_RATIO. Raises
    ParameterError for the literal sign.
    """
    timing = study.timing_of(controller)
    loop = linear_loop(controller, study.airframe, study.A[:1], study.B[:1], timing)
    steps = round(1.0 / SPEED_STEP)
    surfaces = np.array([name != "V" for name in controller.outputs])
    no_delay = np.zeros(len(loop.inputs))
    for step in range(steps, round(MAX_SPEED_RATIO * steps) + 1):
        factor = np.where(surfaces, (step / steps) ** 2, 1.0)
        if not is_stable(
            loop.nominal._replace(B=loop.nominal.B * factor), loop.law, loop.loop, no_delay
        ):
            return (step - 1) / steps if step > steps else 0.0
    return math.inf


def _bounds(
    study: Study,
    rows: list[int],
    columns: list[int],
    scale: FloatArray,
    D: FloatArray,
    Lambda: FloatArray,
    gamma_2: float,
) -> tuple[Bounds, NDArray[np.bool_], NDArray[np.bool_]]:
    """Compute the bounds of Theorem 1 for inputs divided by `scale`, with two masks of samples.

    `scale` is (m,). The first mask marks the samples whose Omega has the signs D. The second mask
    marks the samples of the first mask that also have stable zeros.
    """
    C = study.C[rows]
    Omegas = C @ study.B[:, :, columns] * scale
    has_signs = np.array([_has_signs(Omega, D) for Omega in Omegas])
    is_counted = has_signs & study.stable
    Omegas = Omegas[is_counted]
    v_dot = np.moveaxis(study.u_dot[..., columns], 1, 0)[is_counted] / scale
    CAC = C @ study.A[is_counted] @ C.T
    bounds = Bounds(
        U=gain_conditions.bound_U(Omegas),
        N_d=np.max(
            [
                np.abs(gain_conditions.N_d(*pair)).max(axis=0)
                for pair in zip(Omegas, v_dot, strict=True)
            ],
            axis=0,
        ),
        rho=max(gain_conditions.rho(*pair, Lambda) for pair in zip(Omegas, CAC, strict=True)),
        gamma_2=np.full(len(rows), gamma_2),
    )
    return bounds, has_signs, is_counted


def _has_signs(Omega: FloatArray, D: FloatArray) -> bool:
    try:
        return bool((signs(Omega) == D).all())
    except DecompositionError:
        return False


def _by_name(values: Mapping[str, float], names: Sequence[str], default: float) -> FloatArray:
    return np.array([values.get(name, default) for name in names])
