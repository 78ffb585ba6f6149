# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Identify an aircraft of JSBSim: its linear airframe, its gains and a scenario.

The airframe is the linearisation of JSBSim about the trim. The gains are the same as `rise-di
gains` would select for this airframe. No number in this module is specific to an aircraft.
"""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from aircraft_sim.airframes.airframe import Airframe
from aircraft_sim.atmosphere.turbulence import MODERATE_SIGMA
from aircraft_sim.jsbsim.jsbsim_aircraft import (
    INPUTS,
    NONE,
    OUTPUTS,
    FlightCondition,
    NamedProperties,
    require_aircraft,
)
from aircraft_sim.jsbsim.jsbsim_linearization import Linearization, linearize
from aircraft_sim.jsbsim.jsbsim_trim import NotBalanced, nearest_trim, trim_solution
from aircraft_sim.sections import Gust
from flight_analysis.closed_loop.scenario import Scenario, parse_scenario
from flight_core.outcome import COMPLETED, FlightEnded, Refusal
from flight_core.parameters import ParameterError
from flight_core.rates import nanoseconds
from flight_core.units import unit_sizes
from flight_core.vectors import FloatArray, selection_matrix
from flight_design.gains import gain_selection, gain_yaml, ideal_control
from flight_design.gains.airframe_properties import invariant_zeros
from flight_design.gains.first_scenario import (
    CONTROL_RATE,
    RATE,
    Channel,
    FirstCommands,
    Sections,
    first_commands,
    scenario_text,
    sensor_noise,
    unit_gains,
)
from flight_design.gains.gain_selection import LoopSetting, Selection
from flight_design.gains.ideal_control import Manoeuvre, Study
from flight_design.gains.observer_selection import with_extended_state_observer
from flight_design.gains.requirement import OBSERVER_REQUIREMENT, REQUIREMENT, Requirement
from flight_design.identification.manoeuvre import (
    CLIMB,
    CLIMB_START,
    GUST_LENGTH,
    GUST_SPEED,
    HEIGHTS,
    TURN,
    TURN_START,
    ManoeuvreResult,
    fly_all,
    moderate_turbulence,
)
from flight_design.identification.sketch import with_sketch
from reference_model.params import ReferenceModelConfig
from rise_di_controller.law.decomposition import coupling
from rise_di_controller.law.law import total_lag
from rise_di_controller.rise_di_config import LearnConfig, PriorConfig, RiseDiConfig

STEP = 1.0 / RATE
# s, delay over topics. At a tick y is up to 5 ms old, and u waits up to 5 ms. Half of these 10 ms
# counts, and 1 ms for transport.
DELAY = 0.006

THROTTLE = list(INPUTS).index("throttle")

# unit of an output divided by the noise that an observer expects, 1 mrad/s or 0.01 m/s
NOISE_SHARE = 100.0

# s, least delay margin of the observer's design loop. The observer's model without A has no
# damping, so this loop has a smaller margin than the loop around the aircraft.
STEP_MARGIN = 0.015
LATERAL = ("beta", "p", "r")
# damping that is added, as a multiple of the unstable zero: it reverses the zero's sign
HELD_FACTOR = 2.0
APART = 5.0  # s, time from one gust to the next


# The manoeuvre, by one rule for all aircraft

# rad, bandwidth of V times the lag of its loop. It costs 26 degrees of phase. It is not larger,
# because an engine responds more slowly than the lag of the loop says.
FASTEST_V = 0.46
LIGHT_SIGMA = 1.52  # m/s, light turbulence at high altitude, 5 ft/s, MIL-F-8785C 3.7.2


# Identification


class IdentifiedAircraft(NamedTuple):
    """An aircraft of JSBSim that was identified, with its scenario and flights."""

    linear: Linearization
    # max abs(U - I), with inputs scaled to unit response and outputs in units of the manoeuvre
    coupling: float
    selection: Selection
    text: str  # text of the scenario file
    # 1/s, growth rate of sideslip while p and r are held; if positive, Assumption 3 fails
    sideslip_zero: float
    flights: dict[str, ManoeuvreResult]  # results by air: "calm", "gust", "turbulence"

    @property
    def condition(self) -> FlightCondition:
        """The flight condition, without the rudder if the rudder moves nothing."""
        return self.linear.condition

    @property
    def D(self) -> tuple[int, ...]:  # noqa: N802 - the paper's name
        """D in the order of the flight condition's inputs."""
        controller = self.selection.chosen
        return tuple(
            controller.D[controller.inputs.index(name)] for name in self.condition.inputs()
        )

    def scenario(self) -> Scenario:
        """Load the scenario from its text."""
        return _load(self.text)

    @property
    def failure(self) -> Refusal | None:
        """Reason why the aircraft does not fly, or None if it flies.

        The aircraft flies if every flight completes, and if the rms error of each output in calm
        air is below the largest command of this output.
        """
        for title, flight in self.flights.items():
            if flight.outcome != str(COMPLETED):
                return Refusal(f"{title}: {flight.outcome}")
        pulses = self.scenario().reference_model.pulses.items()
        largest = HEIGHTS | {name: max(map(abs, pulse.value)) for name, pulse in pulses}
        too_large = [
            name for name, value in self.flights["calm"].rms.items() if not value < largest[name]
        ]
        if too_large:
            return Refusal(f"calm: the error of {', '.join(too_large)} is larger than the command")
        return None


def identify_jsbsim(
    name: str,
    speed: float,
    altitude: float,
    progress: Callable[[str], None] = lambda _: None,
    observer_margin: float | None = None,
    *,
    guided: bool = False,
    learns: bool = False,
    requirement: Requirement = REQUIREMENT,
    named: tuple[tuple[str, NamedProperties], ...] = (),
) -> IdentifiedAircraft:
    """Identify an aircraft of JSBSim in a flight condition, select gains, and fly it.

    The speed is in m/s, the altitude in m. The identification has four steps.

    1. Trim, first in a separate process, and linearise: `linearize` gives the airframe.

    2. Pair the channels, and take D from the leading minors of Omega.

    3. Select gains by the engineering procedure for the airframe behind the lags, along the
    commands and gusts: `gain_selection.gain_sets`. The beta of V follows from `airspeed_slew`. If
    `observer_margin` is given, the controller gets an extended-state observer for y_dot = Omega u.
    The loop around this model then has the delay margin `observer_margin`, s, and its margins meet
    `requirement`, except that 35 degrees of phase margin suffice.

    4. Simulate the result in calm air, with a gust, and in turbulence.

    If `guided`, guidance flies a turn by 90 degrees and a climb by 100 m in place of the pulses.
    `slowest_trim` gives the stall speed of guidance. The sideslip feedback of guidance can also fly
    an aircraft whose `sideslip_zero` is positive.

    If `learns`, which needs an `observer_margin`, the controller of step 3 gets no observer. The
    scenario in the result then begins with the gains alone, and a model is learned in moderate
    turbulence. The designs of the learner have the delay margin `observer_margin`, and the rough
    model of the learner is the `sketch` of Omega and speed. The flights of step 4 are without
    learning. `named` has properties that the user names for an input, in place of JSBSim's.

    Raises FlightEnded if the aircraft does not trim or does not respond, and ParameterError if its
    outputs and inputs cannot be paired, or if the speed is below guidance's speed floor.
    """
    condition = FlightCondition(
        name=require_aircraft(name),
        speed=speed,
        altitude=altitude,
        step_ns=nanoseconds(STEP),
        named=named,
    )
    linear = _linear(condition, progress)
    condition = linear.condition
    stall = slowest_trim(condition) if guided else None
    Omega = linear.Omega
    authority = float(linear.authority()[THROTTLE])
    heights = np.array([HEIGHTS[name] for name in condition.paired_outputs()])
    V_bandwidth = airspeed_bandwidth(authority, float(linear.lag[THROTTLE]))
    zero = sideslip_zero(linear.airframe)
    progress("gains")
    setting = _setting(linear, V_bandwidth)._replace(requirement=requirement)
    commands = _commands(linear, setting)
    studied = _study(with_sideslip_held(linear.airframe, zero), commands)
    slew = studied.slew.copy()
    has_observer = observer_margin is not None and not learns
    if has_observer:
        studied = _study(_integrators(linear), commands)
    slew[THROTTLE] = airspeed_slew(V_bandwidth, abs(float(Omega[THROTTLE, THROTTLE])))
    try:
        selection = gain_selection.gain_sets(studied._replace(slew=slew), setting)
    except ParameterError as error:
        raise ParameterError(f"{error}{_too_weak(linear)}") from None
    if observer_margin is not None and has_observer:
        selection = with_extended_state(selection, Omega, observer_margin)
    text = _text(linear, commands, selection, stall)
    flights = fly_all(_load(text), progress)
    if observer_margin is not None and learns:
        text = _text(
            linear,
            commands,
            learning_selection(selection, condition, Omega, observer_margin),
            stall,
        )
    return IdentifiedAircraft(
        linear=linear,
        coupling=coupling(Omega / heights[:, None]),
        selection=selection,
        text=text,
        sideslip_zero=zero,
        flights=flights,
    )


def _linear(condition: FlightCondition, progress: Callable[[str], None]) -> Linearization:
    """Linearise the aircraft of a flight condition.

    If the condition has no trim, raises FlightEnded, which names the nearest condition that has
    one.
    """
    progress("trim and linearisation")
    try:
        return linearize(condition)
    except NotBalanced as error:
        progress("trim beside the condition")
        nearest = nearest_trim(condition) or "no speed or altitude near it has a trim"
        raise FlightEnded(f"{error}; {nearest}") from None


def sideslip_zero(airframe: Airframe) -> float:
    """Return the growth rate of sideslip while p and r are held, 1/s; negative if sideslip decays.

    The rate is a zero of the aircraft. Gravity is left out, because bank moves sideslip much more
    slowly. If the rate is positive, Assumption 3 does not hold. Without a rudder, only the aileron
    holds p, and r follows.
    """
    states = [airframe.index(name) for name in LATERAL]
    inputs = [i for i, name in enumerate(airframe.inputs) if name in {"aileron", "rudder"}]
    outputs = [name for name in airframe.outputs if name in {"p", "r"}]
    zeros = invariant_zeros(
        airframe.matrix_a()[np.ix_(states, states)],
        airframe.matrix_b()[np.ix_(states, inputs)],
        selection_matrix(outputs, LATERAL),
    )
    return float(zeros.real.max())


def with_sideslip_held(airframe: Airframe, zero: float) -> Airframe:
    """Return the airframe, with more damping of sideslip if its zero of sideslip is unstable.

    With such a zero, sideslip would diverge while the law holds p and r. The added damping stands
    for the sideslip feedback of guidance.
    """
    if zero <= 0.0:
        return airframe
    A = airframe.matrix_a()
    beta = airframe.index("beta")
    A[beta, beta] -= HELD_FACTOR * zero
    return airframe.with_matrices(A, airframe.matrix_b(), np.ones((len(A), len(airframe.gusts))))


def airspeed_slew(bandwidth: float, effect: float) -> float:
    """Return the slew of the throttle, 1/s, from which beta of V is chosen.

    `bandwidth` is the bandwidth of the loop of V, rad/s, and `effect` is the effect of the throttle
    on V_dot, m/s^2. The airspeed V contains the wind itself, so the slew is chosen for light
    turbulence: beta becomes K sigma bandwidth / 4, with sigma = LIGHT_SIGMA. The sign term then
    moves the throttle at most as fast as a Lambda of bandwidth / 4, which is the Lambda of the
    engineering procedure.
    """
    return bandwidth**2 / 4.0 * LIGHT_SIGMA / (gain_selection.BETA_TO_SLEW * effect)


def _too_weak(linear: Linearization) -> str:
    """Write a sentence, after a "; ", for each output that its own input hardly moves.

    At full travel, the input that is paired with such an output moves the output less than a tenth
    as much as another input does.
    """
    inputs = linear.condition.inputs()
    reach = linear.Omega * linear.travel()
    sentences = []
    for i, (output, name) in enumerate(zip(linear.airframe.outputs, inputs, strict=True)):
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
    """Find the slowest airspeed at which an aircraft trims in level flight at an altitude, m/s.

    Below this speed lift or thrust is not enough, so guidance takes it as the stall speed. The
    search is a bisection that begins at 0.2 of the condition's speed. The error of the result is at
    most 1 % of the condition's speed.
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


def with_extended_state(selection: Selection, Omega: FloatArray, margin: float) -> Selection:
    """Add an extended-state observer to the engineering gains of a selection.

    Omega has its channels in the aircraft's order.
    """
    controller = selection.chosen
    size = unit_sizes(OUTPUTS[name] for name in controller.outputs)
    requirement = selection.setting.requirement
    requirement = requirement._replace(phase=min(requirement.phase, OBSERVER_REQUIREMENT.phase))
    observed = with_extended_state_observer(
        controller, _in_law_order(Omega, controller), size / NOISE_SHARE, size, margin, requirement
    )
    return replace(selection, chosen=observed.controller)


def _in_law_order(Omega: FloatArray, controller: RiseDiConfig) -> FloatArray:
    rows = [list(OUTPUTS).index(name) for name in controller.outputs]
    columns = [list(INPUTS).index(name) for name in controller.inputs]
    return Omega[np.ix_(rows, columns)]


def learning_selection(
    selection: Selection, condition: FlightCondition, Omega: FloatArray, margin: float
) -> Selection:
    """Add the section `learn` to a selection, with the feedforward and observer of a rough model.

    The rough model is a `sketch`. `observer.part` is 0, so feedforward and observer do not act yet.
    Omega has its channels in the aircraft's order.
    """
    start = selection.chosen
    name = Path(condition.name).stem
    noise = np.array([sensor_noise(output) for output in start.outputs])
    rough = _in_law_order(Omega, start)
    sketched = with_sketch(start, name, rough, condition.speed, noise, margin)
    learn = LearnConfig(prior=PriorConfig(sketch=True))
    return replace(selection, chosen=sketched.model_copy(update={"learn": learn}))


def _study(airframe: Airframe, commands: FirstCommands) -> Study:
    """Study an airframe along the commands and gusts, without any uncertain aircraft.

    The airframe follows from the equations of the aircraft that flies. An uncertain aircraft, whose
    entries are 30 % off, can have an unstable zero of sideslip. No gains could hold its outputs.
    """
    reference = ReferenceModelConfig.validate_mapping(commands.reference, "reference_model")
    gusts = {
        axis: Gust(start=start, speed=GUST_SPEED, length=GUST_LENGTH)
        for axis, start in (("vertical", commands.gust), ("lateral", commands.gust + APART))
        if axis in airframe.gusts
    }
    manoeuvre = Manoeuvre(reference, gusts, commands.duration)
    return ideal_control.study_airframe(airframe, manoeuvre, uncertainty=0.0, samples=0)


def _integrators(linear: Linearization) -> Airframe:
    """Return the airframe y_dot = Omega u, which is the model of an extended-state observer."""
    airframe = linear.airframe
    units = airframe.units_of_outputs()
    m = len(units)
    values = airframe.model_dump(exclude={"states", "A", "B", "gravity", "gusts"}) | {
        "states": units,
        "A": np.zeros((m, m)).tolist(),
        "B": linear.Omega.tolist(),
    }
    return Airframe.validate_mapping(values, f"airframe {airframe.name}")


def airspeed_bandwidth(authority: float, lag: float) -> float:
    """Return the bandwidth of V, rad/s, for a throttle with an authority, m/s^2, and a lag, s.

    The bandwidth is min(0.46 / total, authority / sigma), where total is the total lag. V contains
    the wind along the path itself. So in moderate turbulence, sigma = 3.05 m/s rms, the throttle
    moves with an rms of up to its authority. With more bandwidth it would go from stop to stop, and
    the error of V would be twice the wind. This happened on the 737.
    """
    return min(
        FASTEST_V / float(total_lag(np.array(lag), DELAY, 1.0 / CONTROL_RATE)),
        authority / MODERATE_SIGMA,
    )


def _setting(linear: Linearization, V_bandwidth: float) -> LoopSetting:
    """Return the loop for which gains are selected. All its gains are 1 until the selection."""
    inputs = list(linear.condition.inputs())
    trim = linear.trim
    base = RiseDiConfig.validate_mapping(
        unit_gains(linear.lag.tolist(), DELAY)
        | {
            "rate": CONTROL_RATE,
            "outputs": list(linear.condition.paired_outputs()),
            "inputs": inputs,
            "max_age": 0.1,
            "hold": 0.5,
            "ramp": 2.0,
            "lower": trim.lower[: len(inputs)].tolist(),
            "upper": trim.upper[: len(inputs)].tolist(),
        },
        "controller",
    )
    total = total_lag(linear.lag, DELAY, 1.0 / CONTROL_RATE)
    products = {
        **gain_selection.CROSSOVER_LAG_PRODUCTS,
        "V": V_bandwidth * float(total[inputs.index("throttle")]),
    }
    return LoopSetting(
        base=base,
        rate=CONTROL_RATE,
        lag=dict(zip(inputs, linear.lag.tolist(), strict=True)),
        delay=DELAY,
        rate_limit={},
        crossover_lag_products=products,
    )


def _load(text: str) -> Scenario:
    return parse_scenario(text.encode(), Path("identified.yaml"))


def _commands(linear: Linearization, setting: LoopSetting) -> FirstCommands:
    """Return the commands for the linear aircraft in its loop."""
    condition = linear.condition
    products = setting.crossover_lag_products
    total = total_lag(linear.lag, setting.delay, 1.0 / setting.rate)
    damping = -np.diag(linear.airframe.matrix_a())
    channels = {
        name: Channel(
            motion=name,
            authority=float(authority),
            bandwidth=products[name] / float(lag),
            damping=max(float(damping[linear.airframe.index(name)]), 0.0),
        )
        for name, authority, lag in zip(
            condition.paired_outputs(), linear.authority(), total, strict=True
        )
    }
    return first_commands(channels, condition.speed, RATE, banks=True)


def _text(
    linear: Linearization, commands: FirstCommands, selection: Selection, stall: float | None
) -> str:
    """Write the scenario file. `stall` is V_s, m/s, or None if the flight is not guided."""
    condition = linear.condition
    learns = selection.chosen.learn is not None
    reference = dict(commands.reference)
    guidance: dict[str, dict[str, Any]] = {}
    if stall is not None:
        for key in ("pulses", "coordinated_turn"):
            reference.pop(key, None)
        reference["live"] = {"speed": condition.speed}
        program = {
            "heading": {"start": [TURN_START], "value": [TURN]},
            "altitude": {"start": [CLIMB_START], "value": [condition.altitude + CLIMB]},
        }
        guidance["guidance"] = {"rate": 50.0, "stall_speed": stall, "program": program}
    gust = {"start": commands.gust, "speed": GUST_SPEED, "length": GUST_LENGTH}
    air: dict[str, Any] = {"gusts": {"vertical": gust}}
    if learns:
        air = {
            "turbulence": moderate_turbulence(condition.altitude),
            "sensors": {"noise": [sensor_noise(name) for name in OUTPUTS], "seed": 1},
        }
    count = len(condition.inputs())
    stops = {"lower": linear.trim.lower, "upper": linear.trim.upper}
    aircraft = {
        "airframe": condition.title,
        "speed": condition.speed,
        "altitude": condition.altitude,
        "commands": {
            name: " ".join(f"{path}={at_one!r}" for path, at_one in paths) or NONE
            for name, paths in condition.named
        },
        "rate": RATE,
        "step": STEP,
        **air,
        "actuators": {key: values[:count].tolist() for key, values in stops.items()},
    }
    sections: Sections = {
        "flight": {"duration": commands.duration},
        "aircraft": aircraft,
        "reference_model": reference,
        "controller": gain_yaml.selection_yaml(selection),
        **guidance,
        "recorder": {"rate": 100.0},
    }
    return scenario_text(_heading(linear, selection, stall), sections)


def _heading(linear: Linearization, selection: Selection, stall: float | None) -> list[str]:
    """Write the first lines of the scenario file."""
    condition = linear.condition
    learns = selection.chosen.learn is not None
    assessed = selection.engineering
    at = f"{condition.speed:.6g} m/s and {condition.altitude:.6g} m"
    flight = "commands on every channel" if stall is None else "guidance turns and climbs"
    if learns:
        air = "moderate turbulence. It learns A and B in flight: docs/learning.md"
    else:
        air = "a gust from above"
    observes = selection.chosen.observer is not None and not learns
    options = f"{' --guidance' * (stall is not None)}{' --learn' * learns}"
    options += " --observer" * observes
    trims = zip(condition.inputs(), linear.trim.commands.tolist(), strict=False)
    effects = zip(
        condition.paired_outputs(),
        condition.inputs(),
        np.diag(linear.Omega).tolist(),
        strict=True,
    )
    return [
        gain_yaml.below_requirement(assessed.unmet, assessed.controller.outputs),
        f"JSBSim's {condition.name} at {at}: {flight}, {air}.",
        (
            f"Written by: rise-di identify jsbsim {condition.name} --speed {condition.speed:.6g} "
            f"--altitude {condition.altitude:.6g}{options}"
        ),
        f"Commands in trim: {', '.join(f'{name} {value:.3g}' for name, value in trims)}.",
        (
            "Effects of the linearisation, in rad/s^2 and m/s^2 per unit of command: "
            f"{', '.join(f'{output} by {name} {value:.3g}' for output, name, value in effects)}."
        ),
        (
            f"beta holds gusts of {GUST_SPEED:g} m/s from above and from the side. That of V is "
            "K bandwidth / 4 times the rms of a light turbulence,"
        ),
        "for V holds the wind itself: more drives the throttle from stop to stop.",
    ]
