# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Identification of an unknown aircraft: step tests, signs, lags and gains, written as a scenario.

`identify` only needs to fly the aircraft. Every input is stepped; the steepest tangent of the
paired output gives the column of Omega and the lag of that input. The gains are those of the
engineering procedure of `rise-di gains`, with the slew of the inputs measured in flight. No number
in this module is specific to an aircraft.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from aircraft_sim.actuators import Actuators
from aircraft_sim.airframe import Airframe
from aircraft_sim.disturbance import AXES, Gusts
from aircraft_sim.jsbsim_aircraft import (
    INPUTS,
    NONE,
    OUTPUTS,
    FlightCondition,
    NamedProperties,
    Trim,
    WindModel,
    require_aircraft,
)
from aircraft_sim.jsbsim_model import JsbsimModel
from aircraft_sim.jsbsim_trim import NOT_BALANCED, nearest_trim, sideslip_zero, trim_solution
from aircraft_sim.turbulence import MODERATE_SIGMA
from flight_analysis.closed_loop.scenario import Scenario, parse_scenario
from flight_analysis.closed_loop.simulate import simulate
from flight_core.outcome import COMPLETED, FlightEnded
from flight_core.parameters import ParameterError
from flight_core.rates import divide, nanoseconds
from flight_core.tape import Tape
from flight_core.vectors import FloatArray
from flight_design.gains import gain_selection, gain_yaml, ideal_control
from flight_design.gains.channel_signs import require_channels
from flight_design.gains.gain_selection import LoopSetting, Selection
from flight_design.gains.ideal_control import ChannelPairing, Manoeuvre, Study
from flight_design.gains.nominal import sizes
from flight_design.gains.observer_selection import with_extended_state_observer
from flight_design.gains.requirement import OBSERVER_REQUIREMENT, REQUIREMENT, Requirement
from flight_design.identification.manoeuvre import (
    CLIMB,
    CLIMB_START,
    DURATION,
    GUST_LENGTH,
    GUST_SPEED,
    GUST_START,
    HEIGHTS,
    RATE,
    TURN,
    TURN_START,
    ManoeuvreResult,
    fly_all,
    moderate_turbulence,
    reference_parameters,
    unit_gains,
)
from flight_design.identification.sketch import with_sketch
from flight_design.identification.step_responses import Responses, step_responses
from reference_model.params import ReferenceModelConfig
from rise_di_controller.decomposition import coupling
from rise_di_controller.law import total_lag
from rise_di_controller.rise_di_config import LearnConfig, PriorConfig, RiseDiConfig

# The step tests


CONTROL_RATE = 100.0
STEP = 0.005
# uncertain aircraft around the identified one: only the largest response of them is used
SAMPLES = 5
# s, topics: y is at most 5 ms old at a tick, u waits at most 5 ms; half of both, and 1 ms of
# transport
DELAY = 0.006

THROTTLE = list(INPUTS).index("throttle")

# of the unit of an output to the noise that an observer expects: 1 mrad/s, 0.01 m/s
NOISE_SHARE = 100.0

# s, least delay margin: without A the model of the loop has no damping, and less margin than the
# aircraft
STEP_MARGIN = 0.015

NOISE = {"q": 0.001, "V": 0.05, "p": 0.001, "r": 0.001}
"""rad/s and m/s, rms a sample, of the sensors of an aircraft that learns, assumed: those of a first
flight."""


# The manoeuvre: one rule for all aircraft

# rad, bandwidth of V times the lag of its loop: it costs 26 degrees of phase, for an engine is no
# lag alone
FASTEST_V = 0.46
LIGHT_SIGMA = 1.52  # m/s, of light turbulence at high altitude: 5 ft/s, MIL-F-8785C 3.7.2


# Identification


class IdentifiedAircraft(NamedTuple):
    """An identified aircraft with a scenario."""

    condition: FlightCondition
    trim: Trim
    responses: Responses
    coupling: float  # max abs(U - I), inputs of unit response, outputs in units of the manoeuvre
    selection: Selection
    text: str  # of the scenario file
    sideslip_zero: (
        float  # 1/s, of sideslip with p and r held; Assumption 3 does not hold if it is positive
    )
    flights: dict[str, ManoeuvreResult]  # "calm", "gust", "turbulence"

    @property
    def D(self) -> tuple[int, ...]:  # noqa: N802 - the paper's name
        """D in the canonical order of the inputs."""
        controller = self.selection.chosen
        return tuple(
            controller.D[controller.inputs.index(name)] for name in self.condition.inputs()
        )

    def scenario(self) -> Scenario:
        """The content of the scenario file."""
        return _load(self.text)

    @property
    def failure(self) -> str:
        """Reason of a failure, or "": every flight completes, and in calm air each error is below
        its command.
        """
        for title, flight in self.flights.items():
            if flight.outcome != str(COMPLETED):
                return f"{title}: {flight.outcome}"
        too_large = [
            name for name, value in self.flights["calm"].rms.items() if not value < HEIGHTS[name]
        ]
        return (
            f"calm: the error of {', '.join(too_large)} is larger than the command"
            if too_large
            else ""
        )


def identify(
    name: str,
    speed: float,
    altitude: float,
    progress: Callable[[str], None] = lambda _: None,
    observer_margin: float | None = None,
    *,
    guided: bool = False,
    learns: bool = False,
    needed: Requirement = REQUIREMENT,
    named: tuple[tuple[str, NamedProperties], ...] = (),
) -> IdentifiedAircraft:
    """Identify an aircraft of JSBSim in a flight condition and select its gains; speed in m/s,
    altitude in m.

    1. Trim, first in another process. 2. Step tests: `step_responses`. 3. The pairing, with outputs
    in units of the manoeuvre, and D from the minors. 4. Gains by the engineering procedure for
    y_dot = Omega u behind the lags; all other terms count as f. 5. A simulation in moderate
    turbulence with K and Lambda alone, whose slew of u gives beta: `_flown_slew`. With
    `observer_margin`, the delay margin in s of the loop on y_dot = Omega u, an extended-state
    observer and the gains beside it replace them. The margins of that loop meet `needed`, with 35
    degrees of phase beside an observer. 6. Simulations of the result: in calm air, with a gust, in
    turbulence. With `guided` the scenario has guidance by rule in place of the pulses: a turn by 90
    degrees and a climb by 100 m. Its stall speed is that of `slowest_trim`, and its sideslip
    feedback flies an aircraft whose `sideslip_zero` is positive, too. With `learns` the scenario
    learns in moderate turbulence: the gains begin alone, `observer_margin` is the margin of the
    designs, and the rough model is the `sketch` of Omega and speed.

    Raises FlightEnded if the aircraft does not trim or does not respond, ParameterError if its
    outputs and inputs cannot be paired, or if the speed is below guidance's speed floor.
    """
    condition = FlightCondition(require_aircraft(name), speed, altitude, nanoseconds(STEP), named)
    trim = _trim(condition, progress)
    if not has_rudder(condition):
        condition = condition._replace(named=(*named, ("rudder", ())))
    stall = slowest_trim(condition) if guided else None
    measured = _measured(condition, trim, progress)
    Omega = measured.Omega
    range_ = min(-trim.lower[THROTTLE], trim.upper[THROTTLE])
    authority = float(abs(Omega[THROTTLE, THROTTLE]) * range_)
    commands = reference_parameters(speed, authority, condition.paired_outputs())
    scaled = _in_units_of_the_manoeuvre(condition, Omega, trim)
    V_bandwidth = airspeed_bandwidth(authority, float(measured.lag[THROTTLE]))
    setting = _setting(condition, trim, measured.lag, V_bandwidth)._replace(requirement=needed)

    def scenario_text(selection: Selection) -> str:
        return _text(condition, trim, measured, commands, selection, stall)

    progress("slew of the inputs")
    studied = _study(condition, Omega, commands)
    first = gain_selection.select_gains(studied, setting)
    slew = _flown_slew(_load(scenario_text(first)), measured, V_bandwidth)
    chosen = gain_selection.select_gains(studied._replace(slew=slew), setting)
    if observer_margin is not None and not learns:
        chosen = with_observer(chosen, Omega, observer_margin)
    text = scenario_text(chosen)
    flights = fly_all(_load(text), progress)
    if observer_margin is not None and learns:
        text = scenario_text(that_learns(chosen, condition, Omega, observer_margin))
    return IdentifiedAircraft(
        condition, trim, measured, coupling(scaled), chosen, text, sideslip_zero(condition), flights
    )


def _measured(condition: FlightCondition, trim: Trim, progress: Callable[[str], None]) -> Responses:
    """The step tests of an aircraft."""

    def fly(u: FloatArray, duration: float) -> FloatArray:
        vehicle = _vehicle(condition)
        rows = [vehicle.y()]
        for k in range(divide(nanoseconds(duration), condition.step_ns, "step", "the step test")):
            vehicle.advance(k * condition.step_ns, u, condition.step_ns)
            rows.append(vehicle.y())
        return np.array(rows)[:, : len(condition.inputs())]

    inputs = condition.inputs()
    lower, upper = (stops[: len(inputs)] for stops in (trim.lower, trim.upper))
    return step_responses(fly, lower, upper, condition.paired_outputs(), inputs, STEP, progress)


def has_rudder(condition: FlightCondition) -> bool:
    """Whether half of the rudder moves the aircraft within a second, or the user says none."""
    if "rudder" not in condition.inputs():
        return True  # the user has said so
    flown = []
    for rudder in (0.5, -0.5):
        vehicle = _vehicle(condition)
        vehicle.advance(0, np.array([0.0, 0.0, 0.0, rudder]), nanoseconds(1.0))
        flown.append(vehicle.y())
    return not np.array_equal(flown[0], flown[1])


def _in_units_of_the_manoeuvre(
    condition: FlightCondition, Omega: FloatArray, trim: Trim
) -> FloatArray:
    """Omega with outputs in units of the manoeuvre. Raises ParameterError where outputs and inputs
    cannot be paired.
    """
    outputs = condition.paired_outputs()
    inputs = condition.inputs()
    scaled = Omega / np.array([HEIGHTS[name] for name in outputs])[:, None]
    try:
        require_channels(scaled, ChannelPairing(outputs, inputs))
    except ParameterError as error:
        weak = _too_weak(Omega, trim, outputs, inputs)
        raise ParameterError(f"{error}{weak}") from None
    return np.asarray(scaled)


def _flown_slew(scenario: Scenario, measured: Responses, V_bandwidth: float) -> FloatArray:
    """The slew of the inputs in moderate turbulence by K and Lambda alone, (m,), 1/s.

    V holds the wind itself: beta = K bandwidth / 4 sigma, so that the sign moves the throttle no
    faster than the Lambda of the rule would, bandwidth / 4; the phase margin may ask for less
    Lambda.
    """
    turbulence = moderate_turbulence(scenario.aircraft.flight_condition().altitude)
    tape = simulate(without_beta(scenario.vary(aircraft={"turbulence": turbulence})))
    slew = _slew(tape, measured.lag)
    sign = V_bandwidth**2 / 4.0 * LIGHT_SIGMA  # m/s^3
    effect = abs(measured.Omega[THROTTLE, THROTTLE])
    slew[THROTTLE] = sign / (gain_selection.BETA_TO_SLEW * effect)
    return slew


def _trim(condition: FlightCondition, progress: Callable[[str], None]) -> Trim:
    """The trim of an aircraft. Raises FlightEnded, with the nearest condition that has a trim."""
    progress("trim")
    try:
        return _vehicle(condition).trim
    except FlightEnded as error:
        if NOT_BALANCED not in str(error):
            raise
        progress("trim beside the condition")
        nearest = nearest_trim(condition) or "no speed or altitude near it has a trim"
        raise FlightEnded(f"{error}; {nearest}") from None


def _too_weak(Omega: FloatArray, trim: Trim, outputs: Sequence[str], inputs: Sequence[str]) -> str:
    """The outputs whose own input, at full travel, moves the output less than a tenth of what
    another input does, in sentences after a "; ".
    """
    reach = Omega * np.minimum(-trim.lower, trim.upper)[: len(inputs)]
    sentences = []
    for i, (output, name) in enumerate(zip(outputs, inputs, strict=True)):
        if abs(reach[i, i]) < 0.1 * np.abs(reach[i]).max():
            unit = "m/s^2" if output == "V" else "rad/s^2"
            row = ", ".join(
                f"{key} {value:.2g}" for key, value in zip(inputs, reach[i], strict=True)
            )
            sentences.append(
                f"; {name} moves {output} by {reach[i, i]:.2g} {unit} at full travel, too weak at "
                f"this speed ({row})"
            )
    return "".join(sentences)


def slowest_trim(condition: FlightCondition) -> float:
    """The slowest airspeed at which an aircraft trims in level flight at an altitude, within 1 % of
    the condition's, m/s.

    Below it lift or thrust is not enough, so guidance takes it as the stall speed. By bisection,
    from 0.2 of the condition's.
    """
    slow = 0.2 * condition.speed
    fast = condition.speed
    while fast - slow > 0.01 * condition.speed:
        middle = (slow + fast) / 2.0
        try:
            trim_solution(condition._replace(speed=middle))
            fast = middle
        except FlightEnded:
            slow = middle
    return fast


def with_observer(selection: Selection, Omega: FloatArray, margin: float) -> Selection:
    """The selection with an extended-state observer in its engineering gains; Omega in the
    aircraft's order.
    """
    controller = selection.chosen
    size = sizes(OUTPUTS[name] for name in controller.outputs)
    needed = selection.setting.requirement
    needed = needed._replace(phase=min(needed.phase, OBSERVER_REQUIREMENT.phase))
    observed = with_extended_state_observer(
        controller, _in_law_order(Omega, controller), size / NOISE_SHARE, size, margin, needed
    )
    return replace(selection, chosen=observed.controller)


def _in_law_order(Omega: FloatArray, controller: RiseDiConfig) -> FloatArray:
    rows = [list(OUTPUTS).index(name) for name in controller.outputs]
    columns = [list(INPUTS).index(name) for name in controller.inputs]
    return Omega[np.ix_(rows, columns)]


def that_learns(
    selection: Selection, condition: FlightCondition, Omega: FloatArray, margin: float
) -> Selection:
    """A selection with feedforward and observer of a sketch, not yet flying, and `learn`; Omega in
    the aircraft's order.
    """
    start = selection.chosen
    name = Path(condition.name).stem
    noise = np.array([NOISE[output] for output in start.outputs])
    rough = _in_law_order(Omega, start)
    sketched = with_sketch(start, name, rough, condition.speed, noise, margin)
    learn = LearnConfig(prior=PriorConfig(sketch=True))
    return replace(selection, chosen=sketched.model_copy(update={"learn": learn}))


def without_beta(scenario: Scenario) -> Scenario:
    """The same scenario with a negligible beta: a PI controller with the same K and Lambda."""
    return scenario.vary(controller={"beta": [1e-9] * len(scenario.controller.outputs)})


def _vehicle(condition: FlightCondition) -> JsbsimModel:
    none = np.zeros(len(AXES))
    return JsbsimModel(condition, Actuators(), WindModel(Gusts(none, none, none + 1.0), None))


def _study(condition: FlightCondition, Omega: FloatArray, commands: Mapping[str, Any]) -> Study:
    """The study of y_dot = Omega u along the manoeuvre, input of the gain procedures."""
    airframe = Airframe.validate_mapping(
        {
            "name": condition.title,
            "source": "step tests in JSBSim",
            "speed": condition.speed,
            "states": {name: OUTPUTS[name] for name in condition.paired_outputs()},
            "inputs": {
                name: {"unit": "1", "positive": INPUTS[name].positive}
                for name in condition.inputs()
            },
            "outputs": list(condition.paired_outputs()),
            "A": np.zeros_like(Omega).tolist(),
            "B": Omega.tolist(),
        },
        f"airframe {condition.title}",
    )
    manoeuvre = Manoeuvre(
        ReferenceModelConfig.validate_mapping(commands, "reference_model"), {}, DURATION
    )
    return ideal_control.study_airframe(airframe, manoeuvre, samples=SAMPLES)


def airspeed_bandwidth(authority: float, lag: float) -> float:
    """Bandwidth of V, rad/s, for an authority of the throttle (m/s^2) behind its lag (s): min(0.46
    / total, authority / sigma).

    The airspeed holds the wind along the path itself. In moderate turbulence, sigma = 3.05 m/s rms,
    the throttle then moves by its authority rms; with more it goes from stop to stop, and V is off
    by twice the wind (737).
    """
    return min(
        FASTEST_V / float(total_lag(np.array(lag), DELAY, 1.0 / CONTROL_RATE)),
        authority / MODERATE_SIGMA,
    )


def _setting(
    condition: FlightCondition, trim: Trim, lag: FloatArray, V_bandwidth: float
) -> LoopSetting:
    """The loop of the gains. The parameters to be selected are 1."""
    inputs = list(condition.inputs())
    base = RiseDiConfig.validate_mapping(
        unit_gains(lag.tolist(), DELAY)
        | {
            "rate": CONTROL_RATE,
            "outputs": list(condition.paired_outputs()),
            "inputs": inputs,
            "max_age": 0.1,
            "hold": 0.5,
            "ramp": 2.0,
            "lower": trim.lower[: len(inputs)].tolist(),
            "upper": trim.upper[: len(inputs)].tolist(),
        },
        "controller",
    )
    total = total_lag(lag, DELAY, 1.0 / CONTROL_RATE)
    products = {
        **gain_selection.CROSSOVER_LAG_PRODUCTS,
        "V": V_bandwidth * float(total[inputs.index("throttle")]),
    }
    return LoopSetting(
        base,
        CONTROL_RATE,
        dict(zip(inputs, lag.tolist(), strict=True)),
        DELAY,
        {},
        crossover_lag_products=products,
    )


def _slew(tape: Tape, lag: FloatArray) -> FloatArray:
    """Largest mean slew of each input over the lag of its loop, shape (m,), 1/s: no loop follows a
    faster one.
    """
    period = 1.0 / CONTROL_RATE
    slew = np.zeros(len(lag))
    totals = total_lag(lag, DELAY, period)
    for j, (name, total) in enumerate(zip(INPUTS, totals, strict=False)):  # without rudder
        count = max(round(float(total) / period), 1)
        u = tape["u"][name]
        slew[j] = np.max(np.abs(u[count:] - u[:-count]), initial=0.0) / (count * period)
    return slew


def _load(text: str) -> Scenario:
    return parse_scenario(text.encode(), Path("identified.yaml"))


SCENARIO_YAML = gain_yaml.yaml_template("""\
# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
#
{% if below %}
# {{ below }}
{% endif %}
# JSBSim's {{ condition.name | line }} at {{ condition.speed | digits(6) }} m/s and {{ condition.altitude | digits(6) }} m: \
{{ "guidance turns and climbs" if guided else "commands on every channel" }}, \
{{ "moderate turbulence. It learns A and B in flight: docs/learning.md" if learns else "a gust from above" }}.
# Written by: rise-di identify {{ condition.title | line }} --speed {{ condition.speed | digits(6) }} \
--altitude {{ condition.altitude | digits(6) }}{{ " --guidance" if guided }}{{ " --learn" if learns }}
# Commands in trim: {% for name in inputs %}{{ name }} {{ trim.commands[loop.index0] | digits(3) }}\
{{ ", " if not loop.last }}{% endfor %}.
# Steepest response, in rad/s^2 and m/s^2 per unit of command: {% for name in outputs %}{{ name }} by \
{{ inputs[loop.index0] }} {{ Omega[loop.index0, loop.index0] | digits(3) }}{{ ", " if not loop.last }}{% endfor %}.

/**/flight:
  ros__parameters:
    duration: {{ duration | flow }}             # s

/**/aircraft:
  ros__parameters:
    airframe: {{ condition.title | flow }}
    speed: {{ condition.speed | flow }}  # m/s, true airspeed in trim
    altitude: {{ condition.altitude | flow }}  # m, above sea level
{% if named %}
    commands: {{ named | flow }}  # the model's own properties, with their values at the command 1
{% endif %}
    rate: {{ rate | flow }}                # Hz, y and truth
    step: {{ step | flow }}                # s, of JSBSim
{% if learns %}
    turbulence: {{ turbulence | flow }}  # moderate
    sensors: {noise: {{ noise | flow }}, seed: 1}  # q, V, p, r, rms a sample in SI, assumed
{% else %}
    gusts:                     # 1-cosine; entry in s, peak speed in m/s (down), distance H to the peak in m
      vertical: {{ gust | flow }}
    # turbulence: {{ turbulence | flow }}  # moderate, to fly in instead
{% endif %}
    actuators:                 # {{ inputs | join(", ") }}: deviations of the normalised commands from trim
      lower: {{ trim.lower[:inputs | length].tolist() | flow }}
      upper: {{ trim.upper[:inputs | length].tolist() | flow }}

/**/reference_model:
  ros__parameters:
    rate: {{ rate | flow }}                # Hz
    outputs: {{ commands.outputs | flow }}
    second_order:
      natural_frequency: {{ commands.second_order.natural_frequency | flow }}  \
# rad/s; that of V asks for a third of the throttle's authority
      damping: {{ commands.second_order.damping | flow }}
    rise: {{ commands.rise | flow }}                  # s, edge of a pulse: bounds u_m_dot
{% if guided %}
    live: {speed: {{ condition.speed | flow }}}          # m/s: the wings are levelled when guidance is lost
{% else %}
    pulses:                    # s, s, and rad/s or m/s
{% for name, pulse in commands.pulses.items() %}
      {{ name }}: {{ pulse | flow }}
{% endfor %}
{% if commands.coordinated_turn %}
    coordinated_turn: {{ commands.coordinated_turn | flow }}  # r += g/V0 sin(bank commanded)
{% endif %}
{% endif %}

# Omega and the lags are those of step tests; the slew behind beta is that of u with K and Lambda alone in moderate turbulence.
# beta of V is K bandwidth / 4 times the rms of a light one, for V holds the wind itself: more drives it from stop to stop.
{{ controller }}
{% if guided %}
/**/guidance:                  # what is left out follows by rule: docs/guidance.md
  ros__parameters:
    rate: 50.0                 # Hz
    stall_speed: {{ stall | digits(4) }}          # m/s, the slowest airspeed at which it trims in level flight there
    program:                   # s, rad, m
      heading: {{ program.heading | flow }}
      altitude: {{ program.altitude | flow }}

{% endif %}
/**/recorder:
  ros__parameters:
    rate: 100.0                # Hz, polling of the subscriptions
""")  # noqa: E501 - a text as it is written


def _text(
    condition: FlightCondition,
    trim: Trim,
    steps: Responses,
    commands: Mapping[str, Any],
    selection: Selection,
    stall: float | None,
) -> str:
    """The scenario file. `stall`: V_s, m/s; guided where it is not None."""
    assessed = selection.engineering
    return SCENARIO_YAML.render(
        condition=condition,
        below=gain_yaml.below_requirement(assessed.unmet, assessed.controller.outputs),
        named={
            name: " ".join(f"{path}={at_one!r}" for path, at_one in paths) or NONE
            for name, paths in condition.named
        },
        trim=trim,
        inputs=list(condition.inputs()),
        outputs=list(condition.paired_outputs()),
        Omega=steps.Omega,
        duration=DURATION,
        rate=RATE,
        step=STEP,
        gust={"start": GUST_START, "speed": GUST_SPEED, "length": GUST_LENGTH},
        turbulence=moderate_turbulence(condition.altitude),
        commands=commands,
        guided=stall is not None,
        learns=selection.chosen.learn is not None,
        noise=[NOISE[name] for name in OUTPUTS],
        stall=stall,
        program={
            "heading": {"start": [TURN_START], "value": [TURN]},
            "altitude": {"start": [CLIMB_START], "value": [condition.altitude + CLIMB]},
        },
        controller=gain_yaml.as_yaml(selection),
    )
