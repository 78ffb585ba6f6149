# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""From an aircraft that nothing is published about to a scenario that flies it: step tests, signs, lags, gains.

`identify` asks of the aircraft no more than to be flown: each input is stepped, and the steepest tangent of its own output
gives its column of Omega and its lag. The rest is the engineering procedure of `rise-di gains`, with one thing measured in
flight, the slew of the inputs. No number here belongs to one aircraft.
"""

import math
import tempfile
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from aircraft_sim.actuators import Actuators
from aircraft_sim.airframe import Airframe
from aircraft_sim.disturbance import AXES, Gusts
from aircraft_sim.jsbsim_aircraft import INPUTS, OUTPUTS, FlightCondition, Trim, WindModel
from aircraft_sim.jsbsim_model import JsbsimModel
from aircraft_sim.jsbsim_trim import sideslip_zero
from aircraft_sim.turbulence import HIGH, LOW, LOWEST
from flight_analysis.closed_loop.scenario import Scenario, load_scenario
from flight_analysis.closed_loop.simulate import simulate
from flight_analysis.design.gain_selection import (
    ChannelPairing,
    LoopSetting,
    Manoeuvre,
    Selection,
    Study,
    as_yaml,
    require_channels,
    select_gains,
    study_airframe,
    yaml_flow,
)
from flight_analysis.metrics import error_metrics, best_error
from flight_core.outcome import COMPLETED, FlightEnded
from flight_core.rates import divide, nanoseconds
from flight_core.tape import Tape
from flight_core.units import GRAVITY
from flight_core.vectors import FloatArray
from reference_model.params import ReferenceModelParameters
from rise_di_controller.decomposition import coupling
from rise_di_controller.law import total_lag
from rise_di_controller.params import ControllerParameters

# The step tests

SIZES = (0.05, 0.1, 0.2)
"""Steps, in normalised commands: the small ones stay linear, the large ones get over a hysteresis and use up a rate limit."""

MAX_STEP_FRACTION = 0.9  # of the way to a stop is the largest step, where 0.2 would be beyond it
WINDOWS = {"V": 10.0}  # s: engines and propellers take seconds to spin up
WINDOW = 0.5  # s, of a body rate
SPAN = 0.025  # s over which a slope is taken
TANGENT_CUTOFF = 0.7  # a slope that has fallen to this part of the largest so far is past the steepest tangent

RATE, CONTROL_RATE, STEP = 200.0, 100.0, 0.005  # Hz, Hz, s: of y, of the law, of the integration
SOFTENING = 2.75  # 1, width of the softened sign in total lags, that of osprey_servo
SAMPLES = 5  # uncertain aircraft around the one found: no more than its largest response is wanted of them
DELAY = 0.006  # s, topics: a tick finds y at most 5 ms old, u waits at most 5 ms; half of both, and the way

Fly = Callable[[FloatArray, float], FloatArray]
"""(u held from trim on, shape (m,); duration in s) -> y every `dt` from t = 0 on, shape (N + 1, m), deviations from trim."""


class Tangent(NamedTuple):
    """The steepest chord of a step response, which stands for its tangent: y = slope (t - lag)."""

    slope: float
    lag: float  # s
    first: int  # the samples that it joins
    last: int


class Responses(NamedTuple):
    """What the step tests show, outputs and inputs in their canonical order, output i driven by input i."""

    Omega: FloatArray  # (m, m) effective C B: slopes of y per unit of u
    lag: FloatArray  # (m,) s, of each input's own output
    size: FloatArray  # (m,) of the step whose tangent counted
    spread: FloatArray  # (m,) the smallest slope of all sizes beside the largest: 1 is linear
    rejected: tuple[str, ...]  # steps that show nothing, and why


def steepest_tangent(y: FloatArray, dt: float) -> Tangent | None:
    """The steepest tangent of a unit step response, y of shape (N,) every dt; None where nothing moves.

    A chord joins samples 25 ms apart. The first maximum of its slope counts, which is passed when the slope has fallen to 0.7
    of it. A response y_dot = slope (1 - exp(-t / lag)) gives back its slope and lag, but for exp(-t / lag) at the end.
    Source: the process reaction curve of J. G. Ziegler, N. B. Nichols, Trans. ASME 64, 1942.
    """
    count = max(round(SPAN / dt), 1)
    slopes = (y[count:] - y[:-count]) / (count * dt)
    sizes = np.abs(slopes)
    passed = np.flatnonzero(sizes < TANGENT_CUTOFF * np.maximum.accumulate(sizes))
    k = int(np.argmax(sizes[: passed[0]] if len(passed) else sizes))
    if sizes[k] == 0.0:
        return None
    lag = (k + count / 2.0) * dt - (y[k] + y[k + count]) / 2.0 / slopes[k]
    return Tangent(float(slopes[k]), max(float(lag), 0.0), k, k + count)


def step_responses(
    fly: Fly,
    lower: FloatArray,
    upper: FloatArray,
    outputs: Sequence[str],
    inputs: Sequence[str],
    dt: float,
    progress: Callable[[str], None] = lambda _: None,
) -> Responses:
    """Step each input both ways, by several sizes, and read Omega and the lags from the tangents of its own output.

    What counts is the odd part, (y(+s) - y(-s)) / 2s: trim that drifts, and whatever is even, drop out. Of all sizes the
    steepest gives the column, Omega_ij = y_i / (t - lag) at the middle of the chord of j, since too large an Omega costs
    little and too small a one stability; the longest lag counts, for the same reason. Raises FlightEnded where an output
    answers to no step.

    Arguments: `lower`, `upper` the end stops of u from trim, (m,); `dt` that of `fly`.
    """
    m = len(inputs)
    Omega, lag, size, spread = np.zeros((m, m)), np.zeros(m), np.zeros(m), np.zeros(m)
    rejected: list[str] = []
    for j, (output, name) in enumerate(zip(outputs, inputs, strict=True)):
        progress(f"steps of {name}")
        seen: list[tuple[Tangent, float, FloatArray]] = []
        for step in sorted({min(one, MAX_STEP_FRACTION * float(min(-lower[j], upper[j]))) for one in SIZES}):
            u = step * np.eye(m)[j]
            try:
                y = (fly(u, WINDOWS.get(output, WINDOW)) - fly(-u, WINDOWS.get(output, WINDOW))) / (2.0 * step)
            except FlightEnded as error:
                rejected.append(f"{name} by {step:.3g}: {error}")
                continue
            found = steepest_tangent(y[:, j], dt)
            if found is None:
                rejected.append(f"{name} by {step:.3g}: {output} does not move")
                continue
            middle = (found.first + found.last) / 2.0 * dt
            seen.append((found, step, (y[found.first] + y[found.last]) / 2.0 / (middle - found.lag)))
        if not seen:
            raise FlightEnded(f"{output} does not answer to {name}: {'; '.join(rejected)}")
        steepest, size[j], Omega[:, j] = max(seen, key=lambda one: abs(one[0].slope))
        lag[j] = max(one.lag for one, *_ in seen)
        spread[j] = min(abs(one.slope) for one, *_ in seen) / abs(steepest.slope)
    return Responses(Omega, lag, size, spread, tuple(rejected))


# The manoeuvre: one rule for all aircraft

Q, P, FASTER = 0.05, 0.15, 2.0  # rad/s, rad/s, m/s: heights of the pulses
HEIGHTS = {"q": Q, "V": FASTER, "p": P, "r": Q}  # and sizes of the outputs, for what a coupling is beside
NATURAL_FREQUENCY = {"q": 4.0, "V": 1.2, "p": 5.0, "r": 4.0}  # rad/s, as in osprey_gust
DAMPING = {"q": 0.9, "V": 1.0, "p": 0.9, "r": 0.9}
AUTHORITY_FRACTION = 1.0 / 3.0  # of the throttle's authority goes into the commanded V; the rest is for climbs, turns and gusts
DURATION = 60.0  # s
GUST_SPEED, GUST_LENGTH = 5.0, 30.48  # m/s down, and m to the peak: 100 ft, within the 30 to 350 ft of FAR/CS 25.341
GUST_START = 50.0  # s
MODERATE_WIND, MODERATE_SIGMA = 15.4, 3.05  # m/s, of moderate turbulence: 30 kt at 20 ft, MIL-F-8785C 3.7.3.4; 10 ft/s


def reference_parameters(speed: float, authority: float) -> dict[str, Any]:
    """Parameters of the reference model for an aircraft of a trim speed (m/s) and an authority of its throttle (m/s^2).

        q   0.05 rad/s, or 1 g / speed where that is less, up and down for 1 s each: the path is as it was after each pair
        V   2 m/s more for 20 s; its filter asks for 2 m/s omega / e at most, a third of the authority, omega up to 1.2 rad/s
        p   0.15 rad/s right and left for 1 s each: banks of 9 degrees
        r   the coordinated turn g/V0 sin(bank)

    The rest is that of osprey_gust. Banks are short because q of a coordinated turn is not commanded: the nose sinks in them.
    """
    q = min(Q, GRAVITY / speed)
    slow = min(NATURAL_FREQUENCY["V"], AUTHORITY_FRACTION * authority * math.e / FASTER)
    return {
        "rate": RATE,
        "outputs": list(OUTPUTS),
        "second_order": {
            "natural_frequency": [slow if name == "V" else NATURAL_FREQUENCY[name] for name in OUTPUTS],
            "damping": [DAMPING[name] for name in OUTPUTS],
        },
        "rise": 0.1,
        "pulses": {
            "q": {"start": [2.0, 4.0, 40.0, 42.0], "stop": [3.0, 5.0, 41.0, 43.0], "value": [q, -q, -q, q]},
            "V": {"start": [10.0], "stop": [30.0], "value": [FASTER]},
            "p": {"start": [12.0, 14.0, 18.0, 20.0], "stop": [13.0, 15.0, 19.0, 21.0], "value": [P, -P, -P, P]},
        },
        "coordinated_turn": {"bank_rate": "p", "turn_rate": "r", "speed": speed},
    }


def moderate_turbulence(altitude: float) -> dict[str, Any]:
    """Parameters of moderate turbulence at an altitude, m; at high altitude the intensity is 10 ft/s."""
    values: dict[str, Any] = {"altitude": max(altitude, LOWEST), "seed": 1}
    if altitude < HIGH:
        values["wind"] = MODERATE_WIND
    if altitude > LOW:
        values["sigma"] = MODERATE_SIGMA
    return values


# The whole of it


class ManoeuvreResult(NamedTuple):
    """A flight of the manoeuvre in one process."""

    outcome: str
    rms: dict[str, float]  # of the error by output, SI
    largest: dict[str, float]  # abs(u) by input


class IdentifiedAircraft(NamedTuple):
    """An aircraft, identified, and the scenario that flies it."""

    condition: FlightCondition
    trim: Trim
    responses: Responses
    coupling: float  # max abs(U - I), inputs of unit response, outputs in units of the manoeuvre
    selection: Selection
    text: str  # of the scenario file
    sideslip_zero: float  # 1/s, of sideslip with p and r held: positive, and Assumption 3 does not hold
    flights: dict[str, ManoeuvreResult]  # "calm", "gust", "turbulence"

    @property
    def D(self) -> tuple[int, ...]:  # noqa: N802 - the paper's name
        """D in the canonical order of the inputs."""
        controller = self.selection.engineering.controller
        return tuple(controller.D[controller.inputs.index(name)] for name in INPUTS)

    def scenario(self) -> Scenario:
        """What the scenario file holds."""
        return _load(self.text)

    @property
    def failure(self) -> str:
        """Why it does not fly the manoeuvre; empty where it does: each flight to its end, calm with less error than command."""
        for title, one in self.flights.items():
            if one.outcome != COMPLETED:
                return f"{title}: {one.outcome}"
        lost = [name for name, value in self.flights["calm"].rms.items() if not value < HEIGHTS[name]]
        return f"calm: the error of {', '.join(lost)} is larger than the command" if lost else ""


def identify(name: str, speed: float, altitude: float, progress: Callable[[str], None] = lambda _: None) -> IdentifiedAircraft:
    """Identify an aircraft of JSBSim in a flight condition and select its gains; speed in m/s, altitude in m.

    1. Trim, tried in another process first. 2. Step tests: `responses`. 3. The pairing, outputs scaled by the manoeuvre's
    sizes, and D from the minors. 4. Gains by the engineering procedure, the aircraft taken for y_dot = Omega u behind its lags:
    whatever else there is counts to f. 5. Moderate turbulence flown with K and Lambda alone: the slew of that u takes the place
    of the ideal control's, and gives beta. 6. The result flown: calm, with a gust, in turbulence.

    Raises FlightEnded where the aircraft does not trim or does not answer, ParameterError where its outputs and inputs cannot
    be paired.
    """
    point = FlightCondition(name, speed, altitude, nanoseconds(STEP))
    progress("trim")
    trim = _vehicle(point).trim

    def fly(u: FloatArray, duration: float) -> FloatArray:
        vehicle = _vehicle(point)
        rows = [vehicle.y()]
        for k in range(divide(nanoseconds(duration), point.step_ns, "step", "the step test")):
            vehicle.advance(k * point.step_ns, u, point.step_ns)
            rows.append(vehicle.y())
        return np.array(rows)

    outputs, inputs = tuple(OUTPUTS), tuple(INPUTS)
    found = step_responses(fly, trim.lower, trim.upper, outputs, inputs, STEP, progress)
    throttle = inputs.index("throttle")
    authority = abs(found.Omega[throttle, throttle]) * min(-trim.lower[throttle], trim.upper[throttle])
    commands = reference_parameters(speed, float(authority))
    scaled = found.Omega / np.array([HEIGHTS[name] for name in outputs])[:, None]
    require_channels(scaled, ChannelPairing(outputs, inputs))
    studied = _study(point, found.Omega, commands)
    setting = _setting(trim, found.lag)

    def scenario_text(selection: Selection) -> str:
        return _text(point, trim, found, commands, selection)

    progress("slew of the inputs")
    first = select_gains(studied, setting)
    turbulent = _load(scenario_text(first)).vary(aircraft={"turbulence": moderate_turbulence(altitude)})
    tape = simulate(without_beta(turbulent))
    chosen = select_gains(studied._replace(slew=_slew(tape, found.lag)), setting)
    text = scenario_text(chosen)
    flights = fly_all(_load(text), progress)
    return IdentifiedAircraft(point, trim, found, coupling(scaled), chosen, text, sideslip_zero(point), flights)


def fly_all(scenario: Scenario, progress: Callable[[str], None] = lambda _: None) -> dict[str, ManoeuvreResult]:
    """Fly a scenario of `identify` three times: "calm", with its "gust", and in moderate "turbulence" without the gust."""
    air = moderate_turbulence(scenario.aircraft.flight_condition().altitude)
    flights = {}
    for title, changes in (("calm", {"gusts": {}}), ("gust", {}), ("turbulence", {"gusts": {}, "turbulence": air})):
        progress(f"flight: {title}")
        flights[title] = flown(simulate(scenario.vary(aircraft=changes)))
    return flights


def flown(tape: Tape) -> ManoeuvreResult:
    """Figures of a tape: rms errors and the largest commands."""
    _, error = best_error(tape)
    rms = {name: error_metrics(error[name]).rms for name in error.names}
    largest = {name: float(np.max(np.abs(tape["u"][name]), initial=0.0)) for name in tape["u"].names}
    return ManoeuvreResult(tape.outcome, rms, largest)


def without_beta(scenario: Scenario) -> Scenario:
    """The same scenario with (almost) no beta, which leaves a PI with the same K and Lambda."""
    return scenario.vary(controller={"beta": [1e-9] * len(scenario.controller.beta)})


def _vehicle(point: FlightCondition) -> JsbsimModel:
    none = np.zeros(len(AXES))
    return JsbsimModel(point, Actuators(), WindModel(Gusts(none, none, none + 1.0), None))


def _study(point: FlightCondition, Omega: FloatArray, commands: Mapping[str, Any]) -> Study:
    """y_dot = Omega u along the manoeuvre, as the gain procedures take it."""
    airframe = Airframe.validate_mapping(
        {
            "name": point.title,
            "source": "step tests in JSBSim",
            "speed": point.speed,
            "states": dict(OUTPUTS),
            "inputs": {name: {"unit": "1", "positive": one.positive} for name, one in INPUTS.items()},
            "outputs": list(OUTPUTS),
            "A": np.zeros_like(Omega).tolist(),
            "B": Omega.tolist(),
        },
        f"airframe {point.title}",
    )
    manoeuvre = Manoeuvre(ReferenceModelParameters.validate_mapping(commands, "reference_model"), {}, DURATION)
    return study_airframe(airframe, manoeuvre, samples=SAMPLES)


def _setting(trim: Trim, lag: FloatArray) -> LoopSetting:
    """The loop that the gains are for. What the procedure selects stands here as ones."""
    inputs = list(INPUTS)
    ones = [1.0] * len(inputs)
    base = ControllerParameters.validate_mapping(
        dict.fromkeys(("Lambda", "beta", "input_scale", "omega"), ones)
        | {"rate": CONTROL_RATE, "outputs": list(OUTPUTS), "inputs": inputs, "k_g": 1.0, "k_d": ones[1:]}
        | {"D": [1] * len(inputs), "sign": "auto", "lag": lag.tolist(), "delay": DELAY, "softening": SOFTENING}
        | {"max_age": 0.1, "hold": 0.5, "ramp": 2.0, "lower": trim.lower.tolist(), "upper": trim.upper.tolist()},
        "controller",
    )
    return LoopSetting(base, CONTROL_RATE, dict(zip(inputs, lag.tolist(), strict=True)), DELAY, {})


def _slew(tape: Tape, lag: FloatArray) -> FloatArray:
    """Largest mean slew of each input over the lag of its loop, shape (m,), 1/s: what is faster, no loop could follow."""
    period = 1.0 / CONTROL_RATE
    slew = np.zeros(len(INPUTS))
    for j, (name, total) in enumerate(zip(INPUTS, total_lag(lag, DELAY, period), strict=True)):
        count, u = max(round(float(total) / period), 1), tape["u"][name]
        slew[j] = np.max(np.abs(u[count:] - u[:-count]), initial=0.0) / (count * period)
    return slew


def _load(text: str) -> Scenario:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "identified.yaml"
        path.write_text(text, encoding="utf-8")
        return load_scenario(path)


def _text(point: FlightCondition, trim: Trim, found: Responses, commands: Mapping[str, Any], selection: Selection) -> str:
    """The scenario file."""
    filters, pulses = commands["second_order"], commands["pulses"]
    trimmed = ", ".join(f"{name} {value:.3g}" for name, value in zip(INPUTS, trim.commands, strict=True))
    diagonal = ", ".join(
        f"{output} by {name} {value:.3g}" for output, name, value in zip(OUTPUTS, INPUTS, np.diag(found.Omega), strict=True)
    )
    shown_pulses = "\n".join(f"      {name}: {yaml_flow(one)}" for name, one in pulses.items())
    return f"""# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
#
# JSBSim's {point.name} at {point.speed:.6g} m/s and {point.altitude:.6g} m: commands on every channel, a gust from above.
# Written by: rise-di identify {point.title} --speed {point.speed:.6g} --altitude {point.altitude:.6g}
# Commands in trim: {trimmed}.
# Steepest response, in rad/s^2 and m/s^2 per unit of command: {diagonal}.

/**/flight:
  ros__parameters:
    duration: {yaml_flow(DURATION)}             # s

/**/aircraft:
  ros__parameters:
    airframe: {point.title}
    speed: {yaml_flow(point.speed)}  # m/s, true airspeed in trim
    altitude: {yaml_flow(point.altitude)}  # m, above sea level
    rate: {yaml_flow(RATE)}                # Hz, y and truth
    step: {yaml_flow(STEP)}                # s, of JSBSim
    gusts:                     # 1-cosine; entry in s, peak speed in m/s (down), distance H to the peak in m
      vertical: {yaml_flow({"start": GUST_START, "speed": GUST_SPEED, "length": GUST_LENGTH})}
    # turbulence: {yaml_flow(moderate_turbulence(point.altitude))}  # moderate, to fly in instead
    actuators:                 # elevator, throttle, aileron, rudder: deviations of the normalised commands from trim
      lower: {yaml_flow(trim.lower.tolist())}
      upper: {yaml_flow(trim.upper.tolist())}

/**/reference_model:
  ros__parameters:
    rate: {yaml_flow(RATE)}                # Hz
    outputs: {yaml_flow(commands["outputs"])}
    second_order:
      natural_frequency: {yaml_flow(filters["natural_frequency"])}  # rad/s; that of V asks for a third of the throttle's authority
      damping: {yaml_flow(filters["damping"])}
    rise: {yaml_flow(commands["rise"])}                  # s, edge of a pulse: bounds u_m_dot
    pulses:                    # s, s, and rad/s or m/s
{shown_pulses}
    coordinated_turn: {yaml_flow(commands["coordinated_turn"])}  # r += g/V0 sin(bank commanded)

# Omega and the lags are those of step tests; the slew behind beta is that of u with K and Lambda alone in moderate turbulence.
{as_yaml(selection)}
/**/recorder:
  ros__parameters:
    rate: 100.0                # Hz, how often the topics are emptied
"""
