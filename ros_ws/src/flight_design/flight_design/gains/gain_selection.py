# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Gain selection for an airframe: its ideal control along a manoeuvre, two gain sets, and their assessment.

`study_airframe` finds the rates of the ideal control, on the airframe as published and on uncertain ones around it.
`select_gains` derives two gain sets, of Theorem 1 and of the engineering procedure. `check_gains` assesses the gain set of a
scenario: conditions, stability and delay margin. `as_yaml` writes a gain set as the section of a scenario file.
"""

import json
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Generic, NamedTuple, TypeVar

import numpy as np
from jinja2 import Environment, StrictUndefined, Template
from numpy.typing import NDArray

from aircraft_sim import dynamics
from aircraft_sim.airframe import Airframe
from aircraft_sim.disturbance import Gusts
from aircraft_sim.dynamics import Aircraft
from aircraft_sim.params import Gust
from aircraft_sim.uncertainty import nominal_and_sampled
from flight_analysis.closed_loop.loop_margins import (
    LoopMargins,
    is_literal,
    law_order,
    linear_loop,
    loop_assessment,
    loop_of,
)
from flight_analysis.closed_loop.scenario import Scenario
from flight_core.arguments import as_instance
from flight_core.files import parse_yaml
from flight_core.integrators import rk4
from flight_core.parameters import LARGEST, ParameterError, require
from flight_core.text import printable
from flight_core.vectors import Array, FloatArray
from flight_design.gains import gain_conditions
from flight_design.gains.airframe_properties import invariant_zeros, output_coordinates
from flight_design.gains.gain_conditions import Bounds, Condition, GainSet
from flight_design.gains.lyapunov import KnownPlant, decay_matrix
from flight_design.gains.requirement import NAMES as REQUIRED
from flight_design.gains.requirement import (
    OBSERVER_REQUIREMENT,
    Candidate,
    Requirement,
    above_zeros,
    conditions,
    within_requirement,
)
from reference_model import model
from reference_model.command import command
from reference_model.params import ReferenceModelConfig
from rise_di_controller.decomposition import MANY, DecompositionError, coupling, search, signs
from rise_di_controller.feedforward import ZERO_REAL_PART
from rise_di_controller.law import Sign
from rise_di_controller.linear_loop import Loop, is_stable
from rise_di_controller.params import AllocationConfig, ControllerConfig, FeedforwardConfig, ObserverConfig, VanesConfig
from rise_di_controller.rise_di_config import RiseDiConfig

CROSSOVER_LAG_PRODUCTS: Mapping[str, float] = {"q": 0.63, "p": 0.63, "r": 0.46, "V": 0.46, "climb": 0.46}
"""Bandwidth of a channel times the lag of its loop, rad, by output, at the begin of the search: 0.63 and 0.46 cost 36 and 26
degrees of phase at the crossover. Yaw has a margin for the dutch roll, speed for the engine. The integral, Lambda and the slope
of the softened sign, costs more: the search makes the integral slower, and lowers the bandwidth, until the margins meet the
requirement."""

DEFAULT_CROSSOVER_LAG_PRODUCT = 0.23  # rad, for an output that is not in CROSSOVER_LAG_PRODUCTS

SOFTENING = 2.75  # 1, width of the softened sign in total lags at the begin of the search

BETA_TO_SLEW = 1.25
"""beta / largest slew of the ideal control. The law needs at least 1; more than 1.5 gained nothing on the `osprey`."""

MAX_COUPLING = 10.0
"""Upper bound of max abs(U - I) for a pairing of inputs and outputs. The value is 25 on the `osprey` with aileron and rudder
swapped, 13.6 on the first edition's Aerosonde, which neither procedure stabilises behind servos, and at most 2.2 on the other
airframes of the library."""

STEP = 0.01
"""s, step of the ideal control. It resolves a gust of one second and hidden modes up to 10 1/s to 1e-6 of their size."""

INPUT_LIMITS = ("lower", "upper", "slew")  # limits of the controller, one an input. They are reordered with the inputs.


# of the search for the speed up to which the delay margin lasts
SPEED_STEP = 0.05
MAX_SPEED_RATIO = 3.0

Controller = TypeVar("Controller", bound=ControllerConfig)


class Manoeuvre(NamedTuple):
    """The commands and gusts that the gains are selected for."""

    reference: ReferenceModelConfig
    gusts: dict[str, Gust]
    duration: float  # s


class ChannelPairing(NamedTuple):
    """Outputs and inputs in the law's order, output i paired with input i."""

    outputs: tuple[str, ...]
    inputs: tuple[str, ...]


class LoopSetting(NamedTuple):
    """The loop that the gains are selected for, and the settings of the selection."""

    base: ControllerConfig  # source of all parameters that are not selected: max_age, limits
    rate: float  # Hz
    lag: Mapping[str, float]  # s, by input; 0 for an input without lag
    delay: float  # s
    rate_limit: Mapping[str, float]  # SI, by input; an input without entry is not limited
    gamma_2: float = 0.0  # 1/s, an assumption: 0 gives the smallest bounds (29), (30)
    factor: float = BETA_TO_SLEW  # beta / slew of the ideal control
    crossover_lag_products: Mapping[str, float] = CROSSOVER_LAG_PRODUCTS
    inputs: tuple[str, ...] = ()  # input of each output, in the airframe's order; empty: the airframe's pairing
    feedforward: bool = False  # whether the result has the published airframe as model of a feedforward
    requirement: Requirement = Requirement()


class Study(NamedTuple):
    """An airframe along a manoeuvre: the nominal one first, then N - 1 uncertain ones; airframe's order, SI."""

    airframe: Airframe
    A: FloatArray  # (N, n, n)
    B: FloatArray  # (N, n, m)
    C: FloatArray  # (m, n)
    gravity: FloatArray  # (n, n), the Jacobian of f at trim
    u_dot: FloatArray  # (T, N, m) rate of the ideal control, units of u / s
    slew: FloatArray  # (m,) largest abs(u_dot) of the nominal airframe
    slew_undisturbed: FloatArray  # (m,) the same without gusts
    stable: NDArray[np.bool_]  # (N,) whether no zero lies in the right half plane
    uncertainty: float

    @property
    def Omega(self) -> FloatArray:  # noqa: N802 - the paper's name
        """Omega = C B of the nominal airframe, shape (m, m), SI."""
        return np.asarray(self.C @ self.B[0])


class GainAssessment(NamedTuple, Generic[Controller]):
    """A controller, every condition on its gains, and the margins of its loop."""

    controller: Controller
    theorem: tuple[Condition, ...]  # empty for a law other than RISE-DI
    loop: tuple[Condition, ...]
    bounds: Bounds | None  # None for a law other than RISE-DI
    margins: LoopMargins | None  # None for the literal sign
    study: Study  # of the airframe

    @property
    def delay_margin(self) -> float | None:
        """Delay margin of the nominal aircraft with the delay in all channels, s; None for the literal sign."""
        return None if self.margins is None else self.margins.delay

    @property
    def channel_margins(self) -> tuple[float, ...]:
        """Delay margins of the nominal aircraft with the delay in one channel alone, s; none for the literal sign."""
        return () if self.margins is None else self.margins.channel_delay

    @property
    def has_requirement(self) -> bool:
        """Whether margins are asked of the loop: not of an ideal loop with the implicit or the literal sign."""
        return any(condition.name in REQUIRED for condition in self.loop)

    @property
    def unmet(self) -> tuple[Condition, ...]:
        """The margins of the requirement that the loop does not have."""
        return tuple(condition for condition in gain_conditions.failing(self.loop) if condition.name in REQUIRED)

    @property
    def failing(self) -> tuple[Condition, ...]:
        """Every condition that does not hold."""
        return gain_conditions.failing((*self.theorem, *self.loop))


@dataclass(frozen=True)
class Selection:
    """Both gain sets for an airframe. A set is assessed on first use, for the margins of all samples cost most."""

    study: Study
    setting: LoopSetting
    literal: RiseDiConfig  # the gain set of Theorem 1
    chosen: RiseDiConfig  # the engineering gains
    origin: str = ""  # of the gains beside an observer, a sentence

    @cached_property
    def theorem(self) -> GainAssessment[RiseDiConfig]:
        """The gain set of Theorem 1, assessed."""
        return assess_gains(self.study, self.literal, self.setting)

    @cached_property
    def engineering(self) -> GainAssessment[RiseDiConfig]:
        """The engineering gains, assessed."""
        return assess_gains(self.study, self.chosen, self.setting)


# The manoeuvre and the ideal control along it


def manoeuvre(scenario: Scenario, airframe: Airframe) -> Manoeuvre:
    """The commands and gusts of a scenario for the channels and gust axes that an airframe has.

    A coordinated turn stays if the airframe has both of its channels, at the airframe's own speed. Raises ParameterError for an
    output without command in the scenario.
    """
    commands = scenario.reference_model
    for name in airframe.outputs:
        require(
            name in commands.outputs,
            f"{scenario.name}: reference_model.outputs",
            ", ".join(commands.outputs),
            f"{name} too: --scenario has them",
        )
    values = commands.model_dump(exclude_none=True)
    if set(airframe.outputs) != set(commands.outputs):
        require("second_order" in values, f"{scenario.name}: reference_model", "linear", "second_order to leave channels out")
        rows = [commands.outputs.index(name) for name in airframe.outputs]
        values["outputs"] = airframe.outputs
        for key, row in values["second_order"].items():
            values["second_order"][key] = [row[i] for i in rows]
        for key in ("pulses", "sines"):
            values[key] = {name: signal for name, signal in values[key].items() if name in airframe.outputs}
    turn = commands.coordinated_turn
    if turn is not None:
        present = {turn.bank_rate, turn.turn_rate} <= set(airframe.outputs) and airframe.speed > 0.0
        values["coordinated_turn"] = turn.model_dump() | {"speed": airframe.speed} if present else None
    gusts = {name: gust for name, gust in scenario.aircraft.gusts.items() if name in airframe.gusts}
    reference = ReferenceModelConfig.validate_mapping(values, "reference_model")
    return Manoeuvre(reference, gusts, scenario.flight.duration)


def study_airframe(
    airframe: Airframe, manoeuvre: Manoeuvre, uncertainty: float = 0.3, samples: int = 100, seed: int = 1
) -> Study:
    """Rates of the ideal control along a manoeuvre, on the airframe as published and on uncertain ones.

    The ideal control keeps y on y_m. With x = P y_m + N eta, eta the states beside the outputs (`output_coordinates`):

        eta_dot = H' (I - B Omega^-1 C) (A x + f(x, t)) + H' B Omega^-1 y_m_dot         the zero dynamics, eta(0) = 0
        u* = Omega^-1 (y_m_dot - C (A x + f)),  x_dot = A x + f + B u*
        u*_dot = Omega^-1 (y_m_ddot - C (A x_dot + f_dot)),  f_dot along (1, x_dot)

    Runge-Kutta in steps of 0.01 s; u*_dot is evaluated at the steps; only f_dot and u_m_dot are differences, central and over
    1e-5 s. f is that of the nominal airframe. Raises ParameterError if Omega is singular or if the nominal airframe has a zero
    in the right half plane: then Assumption 3 does not hold.
    """
    A, B = nominal_and_sampled(airframe, uncertainty, samples, seed)
    zeros = [invariant_zeros(*pair, airframe.matrix_c()).real.max(initial=-math.inf) for pair in zip(A, B, strict=True)]
    stable = np.array(zeros) <= ZERO_REAL_PART
    require(bool(stable[0]), f"airframe {airframe.name}", f"a zero at {zeros[0]:.3g} 1/s", "none in the right half plane")
    # The last column is the nominal airframe without gusts: their speed is 0 there.
    A = np.concatenate([A, A[:1]])
    B = np.concatenate([B, B[:1]])
    aircraft = _columns(airframe, manoeuvre.gusts, len(A))
    C = airframe.matrix_c()
    n = len(airframe.states)
    m = len(airframe.outputs)
    P, N, H = output_coordinates(C)
    Omega: FloatArray = np.einsum("ij,Njk->Nik", C, B)
    require(float(np.abs(np.linalg.det(Omega)).min()) > 0.0, "Omega", "a singular C B", "inputs that move all outputs")
    inverse = np.asarray(np.linalg.inv(Omega), dtype=np.float64)
    project = np.asarray(H.T @ (np.eye(n) - B @ inverse @ C), dtype=np.float64)
    follow = H.T @ B @ inverse
    y_m, y_m_dot, y_m_ddot = _references(manoeuvre, airframe)

    def times(matrices: FloatArray, columns: FloatArray) -> FloatArray:
        return np.asarray(np.einsum("Nij,jN->iN", matrices, columns))

    def state(k: int, eta: FloatArray) -> FloatArray:
        return np.asarray((P @ y_m[k])[:, None] + N @ eta)

    def drift(t: Any, x: FloatArray) -> FloatArray:
        return np.asarray(times(A, x) + dynamics.f(t, x, aircraft))

    def eta_dot(t: float, eta: Array, _: None, __: None) -> Array:
        k = round(2.0 * t / STEP)
        return times(project, drift(t, state(k, eta))) + (follow @ y_m_dot[k]).T

    steps = (len(y_m) - 1) // 2
    eta = np.zeros((n - m, len(A)))
    u_dot = np.zeros((steps + 1, len(A), m))
    near = 1e-5
    for k in range(steps + 1):
        t = k * STEP
        x = state(2 * k, eta)
        free = drift(t, x)
        u = times(inverse, np.asarray(y_m_dot[2 * k][:, None] - C @ free, dtype=np.float64))
        x_dot = free + times(B, u)
        ahead, behind = (dynamics.f(t + step, x + step * x_dot, aircraft) for step in (near, -near))
        drift_dot: FloatArray = times(A, x_dot) + (ahead - behind) / (2.0 * near)
        u_dot[k] = times(inverse, y_m_ddot[2 * k][:, None] - C @ drift_dot).T
        if k < steps and n > m:
            eta = rk4(eta_dot, t, eta, None, None, STEP)
    undisturbed, slew = (np.max(np.abs(u_dot[:, column]), axis=0) for column in (-1, 0))
    return Study(airframe, A[:-1], B[:-1], C, airframe.matrix_gravity(), u_dot[:, :-1], slew, undisturbed, stable, uncertainty)


def _references(manoeuvre: Manoeuvre, airframe: Airframe) -> tuple[FloatArray, FloatArray, FloatArray]:
    """y_m and its two derivatives every STEP / 2, for the stages of Runge-Kutta; airframe's order, each (2 T - 1, m)."""
    matrices = manoeuvre.reference.model()
    profile = manoeuvre.reference.profile()
    near = 1e-5
    step = model.stepper(STEP / 2.0, matrices)
    t = STEP / 2.0 * np.arange(2 * round(manoeuvre.duration / STEP) + 1)
    u_m = command(t, profile)
    half_later = command(t + STEP / 4.0, profile)
    u_m_dot = (command(t + near, profile) - command(t - near, profile)) / (2.0 * near)
    x = np.zeros((len(t), len(matrices.A_m)))
    for k, stages in enumerate(np.concatenate([u_m[:-1], half_later[:-1], u_m[1:]], axis=1)):
        x[k + 1] = model.step(x[k], stages, step)
    x_dot = model.x_m_dot(t, x.T, u_m.T, matrices)
    x_ddot = model.x_m_dot(t, x_dot, u_m_dot.T, matrices)  # (2) differentiated
    places = [manoeuvre.reference.outputs.index(name) for name in airframe.outputs]
    y_m, y_m_dot, y_m_ddot = (model.output(z, matrices)[places].T for z in (x.T, x_dot, x_ddot))
    return y_m, y_m_dot, y_m_ddot


def _columns(airframe: Airframe, gusts: Mapping[str, Gust], columns: int) -> Aircraft:
    """The aircraft with f for states in columns, shape (n, columns), the last column without gusts."""
    gust_on = np.append(np.ones(columns - 1), 0.0)
    profiles = np.array([(gust.start, gust.speed, gust.length) for gust in gusts.values()]).reshape(-1, 3)
    start, speed, length = np.split(profiles, 3, axis=1)
    directions = [airframe.gust_direction(name) for name in gusts]
    return Aircraft(
        airframe.matrix_a(),
        airframe.matrix_b(),
        airframe.matrix_c(),
        airframe.matrix_gravity(),
        np.reshape(directions, (len(gusts), len(airframe.states))).T,
        Gusts(start, speed * gust_on, length),
        np.array(airframe.speed),
    )


# Signs and pairing


def require_channels(
    Omega: FloatArray, channels: ChannelPairing, D: Sequence[int] | None = None, input_signs: Sequence[int] | None = None
) -> FloatArray:
    """D of a pairing of channels, shape (m,). Raises ParameterError with the contradiction to Omega and a choice that fits.

    Omega = C B in the order of the channels, (m, m), with the airframe's signs of the inputs. `input_signs` are -1 for an input
    whose sign is flipped between law and airframe; this flips D_k and nothing else. The checks, in this order: the pairing has
    a D and max abs(U - I) at most 10; the input signs fit the D given; D fits.
    """
    m = len(Omega)
    flips = np.ones(m) if input_signs is None else np.array(input_signs, dtype=np.float64)
    try:
        largest = coupling(Omega)
        problem = f"max abs(U - I) = {largest:.3g}" if largest > MAX_COUPLING else ""
    except DecompositionError as error:
        problem = f"no D, for leading minor {error.minor} is zero"
    if problem:
        named = ", ".join(f"{output}-{name}" for output, name in zip(*channels, strict=True))
        fits = f"inputs that can be paired: {'no order of these' if m <= MANY else 'none of three orders that were tried'} can"
        if better := search(Omega, MAX_COUPLING):
            pairs = (f"{channels.outputs[i]}-{channels.inputs[j]}" for i, j in zip(*better[:2], strict=True))
            fits = f"another pairing: {', '.join(pairs)}"
        raise ParameterError(f"controller.inputs: found {named} with {problem}, expected {fits}")
    actual = signs(Omega) * flips
    stated = actual if D is None else np.array(D, dtype=np.float64)
    wrong = [name for name, a, b in zip(channels.inputs, actual, stated, strict=True) if a != b]
    if input_signs is not None:
        fit = (flips * actual * stated).astype(int).tolist()
        expected = f"{fit} for D = {stated.astype(int).tolist()}: {', '.join(wrong)} the other way"
        require(not wrong, "input_signs", list(input_signs), expected)
    expected = f"{actual.astype(int).tolist()}, the signs of the minors of C B; or flip {', '.join(wrong)} and keep D"
    require(not wrong, "controller.D", stated.astype(int).tolist(), expected)
    return np.asarray(actual)


# Selection and assessment


def select_gains(study: Study, setting: LoopSetting) -> Selection:
    """Two gain sets for an airframe: the literal one of Theorem 1 and that of the engineering procedure.

    Both have the same channels (the fastest first, so that the last has the smallest K), inputs scaled by 1 / abs(Omega_ii)
    and D from the minors. The theorem's set is `theorem_gains` with Lambda = 1 1/s, which needs the smallest k_g. The other
    one is `engineering_gains` with the slew of the nominal airframe; behind servos, `within_requirement` makes the integral
    slower and the bandwidth lower until the margins meet the setting's requirement, on the samples too. `omega` is the largest
    abs(Omega_ii) of the samples.
    Raises ParameterError as `require_channels` does, and for parameters that the controller does not accept.
    """
    airframe = study.airframe
    inputs = list(airframe.inputs)
    pairing = ChannelPairing(airframe.outputs, setting.inputs or tuple(inputs))
    require(sorted(pairing.inputs) == sorted(inputs), "inputs", ", ".join(pairing.inputs), f"{', '.join(inputs)} in any order")
    paired = [inputs.index(name) for name in pairing.inputs]
    Omega = study.Omega[:, paired]
    slew = study.slew[paired]
    require_channels(Omega, pairing)
    products = np.array([setting.crossover_lag_products.get(name, DEFAULT_CROSSOVER_LAG_PRODUCT) for name in pairing.outputs])
    loop = Loop(_by_name(setting.lag, pairing.inputs, 0.0), setting.delay, 1.0 / setting.rate)
    bandwidth = gain_conditions.bandwidths(loop, products)
    places = np.argsort(-bandwidth, kind="stable").tolist()  # the fastest first: (22) gives the last channel the smallest K
    channels = ChannelPairing(
        tuple(pairing.outputs[i] for i in places),
        tuple(pairing.inputs[i] for i in places),
    )
    columns = [paired[i] for i in places]
    D = require_channels(Omega[np.ix_(places, places)], channels)
    unit = 1.0 / np.abs(np.diag(Omega))[places]
    rate_limit = _by_name(setting.rate_limit, channels.inputs, math.inf)
    spread = np.abs(np.einsum("Nii->Ni", (study.C @ study.B)[:, places][..., columns])).max(axis=0)

    def controller(gains: GainSet, response: FloatArray, slower: FloatArray) -> RiseDiConfig:
        scale = unit * response
        base_inputs = setting.base.inputs
        softening = (SOFTENING * np.broadcast_to(slower, response.shape)).tolist()
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
            "D": D.astype(int).tolist(),
            "input_scale": scale.tolist(),
            "omega": (spread * scale).tolist(),
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
            values["allocation"] = setting.base.allocation.ordered(base_inputs, channels.inputs).model_dump()
        return RiseDiConfig.validate_mapping(values, "controller")

    def engineering(slower: FloatArray, lower: FloatArray) -> Candidate[RiseDiConfig]:
        limits = slew[places] / unit, setting.factor, rate_limit / unit
        selected = gain_conditions.engineering_gains(bandwidth[places] / lower, *limits, slower)
        chosen = controller(*selected, slower * lower)  # both parts of the integral fall with the bandwidth
        return Candidate(chosen, linear_loop(chosen, airframe, study.A, study.B))

    ones = np.ones(len(places))
    bounds, *_ = _bounds(study, places, columns, unit, D, ones, setting.gamma_2)
    sufficient = gain_conditions.theorem_gains(bounds, ones)
    first = engineering(ones, ones)
    # The theorem may ask for gains beyond those that a controller takes, as k_d of 2e17 1/s for the f16 of JSBSim.
    accepted = GainSet(
        min(sufficient.k_g, LARGEST),
        *(np.minimum(values, LARGEST) for values in (sufficient.k_d, sufficient.Lambda, sufficient.beta)),
    )
    literal = controller(accepted, ones, ones).model_copy(
        update={"k_g": float(sufficient.k_g)}
        | {name: tuple(getattr(sufficient, name).tolist()) for name in ("k_d", "Lambda", "beta")}
    )
    behind_servos = first.controller.sampled_sign()[0] is Sign.SOFT
    chosen = (within_requirement(engineering, setting.requirement) if behind_servos else first).controller
    chosen = with_feedforward(chosen, airframe) if setting.feedforward else chosen
    return Selection(study, setting, literal, chosen)


def with_feedforward(controller: Controller, airframe: Airframe) -> Controller:
    """The same controller with the airframe as the nominal model of its feedforward, an extension of the paper.

    lead = lag + delay + half a period, of the controller. Raises ParameterError for an airframe that cannot be the
    model, such as one with a zero in the right half plane.
    """
    for name in controller.outputs:
        require(
            name in airframe.states, "feedforward", f"the output {name}, a row of C", "outputs that are states of its model"
        )
    _, columns = law_order(airframe, controller)
    gravity = airframe.matrix_gravity()
    model = FeedforwardConfig(
        states=tuple(airframe.states),
        A=tuple(airframe.matrix_a().ravel().tolist()),
        B=tuple(airframe.matrix_b()[:, columns].ravel().tolist()),
        gravity=tuple(gravity.ravel().tolist()) if gravity.any() else None,
        lead=tuple(lag + controller.delay + 0.5 / controller.rate for lag in controller.lag),
    )
    return type(controller).validate_mapping(controller.model_dump() | {"feedforward": model.model_dump()}, "controller")


def check_gains(scenario: Scenario, study: Study, gamma_2: float = 0.0) -> GainAssessment[ControllerConfig]:
    """Every condition on the gain set of a scenario's controller, for an airframe studied along the scenario's manoeuvre.

    Raises ParameterError for other outputs than those of the airframe, and if D or the pairing contradict the airframe.
    """
    known = scenario.controller.outputs
    frame = study.airframe
    fits = f"the outputs {', '.join(known)}"
    require(sorted(known) == sorted(frame.outputs), f"airframe {frame.name}", ", ".join(frame.outputs), fits)
    return assess_gains(study, scenario.controller, loop_setting(scenario, gamma_2))


def loop_setting(scenario: Scenario, gamma_2: float = 0.0) -> LoopSetting:
    """The loop of a scenario: its controller, and the rate limits of controller and actuators."""
    controller = scenario.controller
    rates = scenario.aircraft.actuators.rate
    slew = dict(zip(controller.inputs, controller.slew or (), strict=bool(controller.slew)))
    limits = dict(zip(scenario.aircraft.channels().inputs, rates, strict=bool(rates)))
    return LoopSetting(
        controller,
        controller.rate,
        dict(zip(controller.inputs, controller.lag, strict=True)),
        controller.delay,
        {name: min(slew.get(name, math.inf), limits.get(name, math.inf)) for name in controller.inputs},
        gamma_2,
    )


def assess_gains(study: Study, controller: Controller, setting: LoopSetting) -> GainAssessment[Controller]:
    """Every condition on a gain set. Rate, lag and delay are the controller's; gamma_2 and rate limits are the setting's.

    Theorem: see `_theorem`. Loop: `check_loop` without an observer, the fraction of the samples for which the linear loop is
    stable, and its delay margin on the nominal airframe, which should be at least one period, a missed tick, or what an
    observer requires beyond the delay, and the margins of the setting's requirement, 35 degrees of phase with an observer.
    With the implicit sign the linear loop is the one inside the width of the sign,
    dt^2 omega beta. Its margin is then the delay at which chatter begins, and at most half a period. A law other than RISE-DI
    has the conditions of the linear loop alone.
    """
    rows, columns = law_order(study.airframe, controller)
    channels = ChannelPairing(controller.outputs, controller.inputs)
    D = require_channels(study.Omega[np.ix_(rows, columns)], channels, controller.D)
    theorem: tuple[Condition, ...] = ()
    loop_conditions: tuple[Condition, ...] = ()
    bounds = None
    if isinstance(controller, RiseDiConfig):
        theorem, loop_conditions, bounds = _rise_di_conditions(study, controller, setting, D)
    if is_literal(controller):
        return GainAssessment(controller, theorem, loop_conditions, bounds, None, study)
    loop = linear_loop(controller, study.airframe, study.A, study.B)
    margins = loop_assessment(loop)
    stable = (margins.stable + float(margins.nominal.stable)) / len(study.A)
    loop_conditions += (Condition("linear stability", None, stable, 1.0),)
    if not (isinstance(controller, RiseDiConfig) and controller.sampled_sign()[0] is Sign.IMPLICIT):
        observer = controller.observer
        needed = above_zeros(setting.requirement, loop.nominal)
        least = 1.0 / controller.rate if observer is None else observer.margin - controller.delay
        needed = needed if observer is None else needed._replace(phase=min(needed.phase, OBSERVER_REQUIREMENT.phase))
        loop_conditions += (Condition("delay margin", None, margins.delay, least), *conditions(margins, needed))
    return GainAssessment(controller, theorem, loop_conditions, bounds, margins, study)


def _rise_di_conditions(
    study: Study, controller: RiseDiConfig, setting: LoopSetting, D: FloatArray
) -> tuple[tuple[Condition, ...], tuple[Condition, ...], Bounds]:
    """The conditions of Theorem 1, those of `check_loop`, and the bounds of the theorem.

    "D" and "zero dynamics" are the fractions of the samples for which they hold. The bounds of (29), (30), steps 2 and 3 are
    the largest over the samples for which both hold. "V2_dot" is the smallest eigenvalue of Q in V2_dot = -z'Qz over these
    samples; steps 2 and 3 are sufficient for Q > 0.
    """
    rows, columns = law_order(study.airframe, controller)
    params = controller.law_params()
    bounds, holds, counts = _bounds(study, rows, columns, params.input_scale, D, params.Lambda, setting.gamma_2)
    gains = GainSet(controller.k_g, np.array(controller.k_d), params.Lambda, params.beta)
    C = study.C[rows]
    Bs = study.B[:, :, columns]
    known = [
        KnownPlant(A, B * params.input_scale, C, lambda _, x: 0.0 * x) for A, B in zip(study.A[counts], Bs[counts], strict=True)
    ]
    decay_rate = min(float(np.linalg.eigvalsh(decay_matrix(plant, params)).min()) for plant in known)
    theorem = (
        Condition("D (11)", None, float(np.mean(holds)), 1.0),
        Condition("zero dynamics", None, float(np.mean(study.stable)), 1.0),
        *gain_conditions.check(gains, bounds),
        Condition("V2_dot", None, decay_rate, 0.0, strict=True),
    )
    if controller.observer is not None:  # the engineering rules are those of a law that has no other feedback beside it
        return theorem, (), bounds
    responses = np.abs(np.einsum("Nii->Ni", C @ Bs))[counts] * params.input_scale
    rate_limit = _by_name(setting.rate_limit, controller.inputs, math.inf)
    limits = tuple(values / params.input_scale for values in (study.slew[columns], rate_limit))
    conditions = gain_conditions.check_loop(params, loop_of(controller), responses[0], responses.max(axis=0), *limits)
    return theorem, conditions, bounds


def response(study: Study, controller: ControllerConfig) -> FloatArray:
    """abs(Omega_ii) in the scaled inputs of a controller, law's order, (m,): 1, or less in a channel too slow for (22)."""
    rows, columns = law_order(study.airframe, controller)
    scale = getattr(controller, "input_scale", 1.0)
    return np.asarray(np.abs(study.Omega[rows, columns]) * scale)


def stable_speed_ratio(study: Study, controller: ControllerConfig) -> float:
    """Airspeed over that of the trim up to which the delay margin lasts with fixed gains; 0 without one at trim.

    The response to every input but that of V grows with V^2, all else is that of the trim. The answer is rounded down to
    SPEED_STEP, and infinite where the linear loop is stable up to MAX_SPEED_RATIO. Raises ParameterError for the literal sign.
    """
    loop = linear_loop(controller, study.airframe, study.A[:1], study.B[:1])
    steps = round(1.0 / SPEED_STEP)
    surfaces = np.array([name != "V" for name in controller.outputs])
    no_delay = np.zeros(len(loop.inputs))
    for step in range(steps, round(MAX_SPEED_RATIO * steps) + 1):
        response = np.where(surfaces, (step / steps) ** 2, 1.0)
        if not is_stable(loop.nominal._replace(B=loop.nominal.B * response), loop.law, loop.loop, no_delay):
            return (step - 1) / steps if step > steps else 0.0
    return math.inf


def _bounds(
    study: Study, rows: list[int], columns: list[int], scale: FloatArray, D: FloatArray, Lambda: FloatArray, gamma_2: float
) -> tuple[Bounds, NDArray[np.bool_], NDArray[np.bool_]]:
    """Bounds of Theorem 1 in inputs scaled by `scale` (m,); which samples have this D; which of them have stable zeros too."""
    C = study.C[rows]
    Omegas = C @ study.B[:, :, columns] * scale
    holds = np.array([_has_signs(Omega, D) for Omega in Omegas])
    counts = holds & study.stable
    Omegas = Omegas[counts]
    v_dot = np.moveaxis(study.u_dot[..., columns], 1, 0)[counts] / scale
    CAC = C @ study.A[counts] @ C.T
    bounds = Bounds(
        U=gain_conditions.bound_U(Omegas),
        N_d=np.max([np.abs(gain_conditions.N_d(*pair)).max(axis=0) for pair in zip(Omegas, v_dot, strict=True)], axis=0),
        rho=max(gain_conditions.rho(*pair, Lambda) for pair in zip(Omegas, CAC, strict=True)),
        gamma_2=np.full(len(rows), gamma_2),
    )
    return bounds, holds, counts


def _has_signs(Omega: FloatArray, D: FloatArray) -> bool:
    try:
        return bool((signs(Omega) == D).all())
    except DecompositionError:
        return False


def _by_name(values: Mapping[str, float], names: Sequence[str], default: float) -> FloatArray:
    return np.array([values.get(name, default) for name in names])


# YAML


PLAIN = re.compile(r"[A-Za-z/][A-Za-z0-9_./:-]*")  # a string that needs no quotes, unless it is a word such as true


def yaml_flow(value: Any, precision: int = 6) -> str:
    """A value in YAML's flow style. Floats have six digits and always a point, which YAML 1.1 requires of a float."""
    if isinstance(value, (list, tuple)):
        return f"[{', '.join(yaml_flow(entry, precision) for entry in value)}]"
    if isinstance(value, dict):
        return "{" + ", ".join(f"{key}: {yaml_flow(entry, precision)}" for key, entry in value.items()) + "}"
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, float):
        digits, mark, exponent = f"{value:.{precision}g}".partition("e")
        return (digits if "." in digits else digits + ".0") + mark + exponent
    if isinstance(value, str) and not (PLAIN.fullmatch(value) and parse_yaml(value, "", "") == value):
        return json.dumps(value, ensure_ascii=False)  # which is YAML too
    return str(value)


def yaml_template(text: str) -> Template:
    """A template of a YAML file.

    "{{ value | flow }}" is `yaml_flow`, "| digits(3)" a number with three digits, "| line" a text without a line end.
    """
    environment = Environment(trim_blocks=True, keep_trailing_newline=True, undefined=StrictUndefined, autoescape=False)  # noqa: S701 - no HTML
    environment.filters["flow"] = yaml_flow
    environment.filters["line"] = printable
    environment.filters["digits"] = lambda value, count: f"{value:.{count}g}"
    return environment.from_string(text)


CONTROLLER_YAML = yaml_template("""\
{% macro listed(keys, indent) %}
{% for key, rows in keys.items() %}
{{ " " * indent }}{{ key }}:
{%- if rows is mapping %}

{{ listed(rows, indent + 2) }}
{%- else %} {{ rows if rows is string else "[" ~ rows | join(",\n" ~ " " * (indent + 3 + key | length)) ~ "]" }}
{% endif %}
{% endfor %}
{% endmacro %}
# Gains for the airframe {{ airframe }} {{ origin }}.
{%- if delay_margin is not none %} Predicted delay margin {{ "%.0f" | format(1e3 * delay_margin) }} ms.{% endif %}
{%- if margins %}

# {{ margins }}
{%- endif %}

/**/controller:
  ros__parameters:
{% for key, value, comment in parameters %}
    {{ key }}: {{ value | flow }}{{ "  # " ~ comment if comment }}
{% endfor %}
{% for name, (comment, keys) in sections.items() %}
    {{ name }}:  # an extension of the paper: {{ comment }}
{{ listed(keys, 6) }}
{%- endfor %}
""")


def _listed(values: FloatArray) -> str:
    return ", ".join(f"{value:.3g}" for value in values)


def as_yaml(selection: Selection, *, theorem: bool = False) -> str:
    """The engineering gain set as the section `/**/controller` of a scenario file, with units and reasons in comments.

    With `theorem` the gain set of Theorem 1 in place of the engineering gains.
    """
    as_instance(selection, Selection, "selection", "a Selection, as select_gains returns one")
    assessed = selection.theorem if theorem else selection.engineering
    controller = assessed.controller
    study = selection.study
    params = controller.law_params()
    _, columns = law_order(study.airframe, controller)
    responses = response(study, controller)
    K = _listed(params.K)
    bandwidth = _listed(params.K * responses)
    slew = _listed(study.slew[columns] / params.input_scale)
    comments = {
        "rate": "Hz",
        "outputs": "the fastest first: the last one has the smallest gain, as (22) has it",
        "inputs": "",
        "k_g": f"1/s; K = ({K}) by (22), bandwidths ({bandwidth}) rad/s",
        "k_d": "1/s",
        "Lambda": "1/s, a quarter of the bandwidths, or less for the phase margin",
        "beta": f"units of y / s^2; {selection.setting.factor:g} x the ideal control's slew ({slew}), within 0.7 x rate limit",
        "D": "signs of the leading minors of C B",
        "input_scale": f"units of u s / units of y: {_shown_response(responses)} / abs(Omega_ii), Omega = C B",
        "omega": f"abs(Omega_ii) in scaled inputs, the largest within +-{100 * study.uncertainty:g} %",
        "sign": controller.sampled_sign()[0].name.lower() + " with this lag and delay",
        "lag": "s, actuators",
        "delay": "s, beyond sampling",
        "softening": "1, width of the softened sign in total lags: wider for the phase margin",
    }
    if theorem:
        comments |= {"Lambda": "1/s", "beta": "units of y / s^2; the least of (29) and (30)"}
    has_observer = controller.observer is not None and controller.observer.part > 0.0  # else the observer of a learner, later
    if has_observer:
        unscaled = "units of u s / units of y; for a K of (22) that is above 1"
        comments |= {
            "Lambda": "1/s",
            "beta": "units of y / s^2",
            "omega": "abs(Omega_ii) in scaled inputs",
            "input_scale": unscaled,
        }
    origin = "by Theorem 1" if theorem else "beside an observer" if has_observer else "by the engineering procedure"
    return section_yaml(controller, study.airframe, assessed.margins, origin, comments)


def section_yaml(
    controller: ControllerConfig, airframe: Airframe, margins: LoopMargins | None, origin: str, comments: Mapping[str, str]
) -> str:
    """A controller as the section `/**/controller` of a scenario file; the description of a parameter without a comment."""
    parameters = [
        (key, value, comments.get(key, type(controller).model_fields[key].description))
        for key, value in controller.model_dump(
            exclude_defaults=True, exclude={"allocation", "feedforward", "observer", "schedule", "learn"}
        ).items()
    ]
    return CONTROLLER_YAML.render(
        airframe=airframe.name,
        origin=origin,
        delay_margin=None if margins is None else margins.delay,
        margins=margins_sentence(controller, margins),
        parameters=parameters,
        sections=_sections(controller, airframe),
    )


def margins_sentence(controller: ControllerConfig, margins: LoopMargins | None) -> str:
    """The margins of a loop in a sentence: nominal and worst phase margins; "" without a softened sign, or unstable."""
    implicit = isinstance(controller, RiseDiConfig) and controller.sampled_sign()[0] is Sign.IMPLICIT
    if margins is None or implicit or not margins.nominal.stable:
        return ""
    each = zip(margins.inputs, np.degrees(margins.nominal.phase).tolist(), strict=True)
    phases = ", ".join(f"{name} {phase:.0f}" for name, phase in each)
    largest = float(margins.nominal.sensitivity.max())
    damping = float(margins.nominal.damping)
    worst = "" if margins.worst is None else f"; worst of {margins.aircraft} {np.degrees(margins.worst.phase.min()):.0f} deg"
    return f"Phase margins {phases} deg{worst}; largest sensitivity {largest:.2f}, damping {damping:.2f}."


def _shown_response(responses: FloatArray) -> str:
    """The factors of 1 / abs(Omega_ii): 1, or less in a channel that is too slow for a K of (22)."""
    factors = [f"{value:.3g}" for value in responses]
    return "1" if set(factors) == {"1"} else f"({', '.join(factors)})"


def _sections(controller: ControllerConfig, airframe: Airframe) -> dict[str, tuple[str, dict[str, Any]]]:
    """The sections allocation, feedforward and observer, if any: a comment, and each parameter in flow style."""
    along = f"the input of {airframe.name} along y_m is added; SI, a line a state, lead in s"
    corrects = "estimates correct the trim; SI, a line an estimate, of F a line an input; within, fade, margin in s"
    distributes = "u = T v, v = effect u; SI, of T a line an effector, of effect a line an input of the law"
    comments = {"allocation": distributes, "feedforward": along, "observer": corrects}
    sections = {
        name: (comment, _matrix_rows(section, len(controller.inputs)))
        for name, comment in comments.items()
        if (section := getattr(controller, name)) is not None
    }
    if isinstance(controller, RiseDiConfig) and (schedule := controller.schedule) is not None:
        rows: dict[str, str | list[str]] = {"speed": yaml_flow(schedule.speed), "time": yaml_flow(schedule.time)}
        for name, model in (("slow", schedule.slow), ("fast", schedule.fast)):
            if model is not None:
                values = (f"{key}: {yaml_flow(value, 10)}" for key, value in model.model_dump(exclude_none=True).items())
                rows[name] = "{" + ",\n             ".join(values) + "}"
        sections["schedule"] = ("input_scale, and the models of the sections above, follow the airspeed; m/s, s", rows)
    if isinstance(controller, RiseDiConfig) and controller.learn is not None:
        settings = controller.learn.model_dump(exclude_none=True)
        rows = {key: yaml_flow(value) for key, value in settings.items()}
        sections["learn"] = ("A and B are identified in flight, and feedforward and observer designed again; s", rows)
    return sections


def _columns_of(section: AllocationConfig | FeedforwardConfig | ObserverConfig | VanesConfig, m: int) -> dict[str, int]:
    """The columns of each matrix of a section."""
    if isinstance(section, VanesConfig):
        return {"H": len(section.H) // len(section.channels), "L": m + 1}
    if isinstance(section, AllocationConfig):
        return {"T": m, "effect": len(section.effectors)}
    n = len(section.states)
    if isinstance(section, FeedforwardConfig):
        return {"A": n, "B": m, "gravity": n}
    return {"Phi": n, "Gamma": m, "L": m, "F": n}


def _matrix_rows(section: AllocationConfig | FeedforwardConfig | ObserverConfig | VanesConfig, m: int) -> dict[str, Any]:
    """Entries of each parameter in flow style, a matrix in rows; ten digits in an allocation and an observer."""
    rows: dict[str, Any] = {}
    columns_of = _columns_of(section, m)
    for key, value in section.model_dump(exclude_none=True).items():
        if isinstance(value, dict):
            rows[key] = _matrix_rows(getattr(section, key), m)
            continue
        if not isinstance(value, tuple):
            rows[key] = yaml_flow(value)
            continue
        columns = columns_of.get(key, len(value))
        digits = 6 if isinstance(section, FeedforwardConfig) else 10
        rows[key] = [yaml_flow(value[i : i + columns], digits)[1:-1] for i in range(0, len(value), columns)]
    return rows
