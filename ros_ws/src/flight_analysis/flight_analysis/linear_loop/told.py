# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Compare what a controller's parameters say of its aircraft with the aircraft that flies.

The section `controller` of a scenario states lags and a delay, for which the controller was
designed. The section `aircraft` has the lags and the delay of the simulated aircraft, and a log
shows the measured ones. `compare` finds the differences, and the timing of the loop that flies.
Margins and guarantees refer to this timing. If something acts that no linear loop contains, such as
a fault, no guarantee is stated.
"""

from dataclasses import replace
from enum import Enum, auto
from typing import NamedTuple

import numpy as np

from aircraft_sim.airframes.airframe import load_airframe
from aircraft_sim.params import AircraftConfig
from flight_analysis.closed_loop.scenario import (
    STOP_TOLERANCE,
    Scenario,
    limits_beyond_stops,
    opposite_signs,
)
from flight_core.fields import short_repr
from flight_core.known_keys import unknown_keys
from flight_core.vectors import FloatArray
from rise_di_controller.law.linear_loop import LoopTiming
from rise_di_controller.params import ControllerConfig

SMALLEST = 1e-6  # s, difference of two times that is taken as 0: it changes no printed margin
# Relative difference of two periods that is taken as 0. The clocks of two hosts differ by only
# 1e-4, and a missed tick changes a period by much more.
SAME_PERIOD = 0.01
# longest wait in periods of the aircraft: y waits up to one period for a tick, and u up to one
# period to act
WAITS = 2.0

IN_LOOP = frozenset(
    {
        *("airframe", "speed", "altitude", "commands", "rate", "step"),
        *(f"actuators.{key}" for key in ("lag", "delay", "lower", "upper", "rate")),
        *("sensors.delay", "vanes.channels"),
        *(f"uncertainty.{key}" for key in ("A", "B", "seed", "number", "entries", "parts")),
        *("uncertainty.distribution", "uncertainty.wind"),
    }
)
"""Keys of the aircraft that a linear loop contains, or that are compared with the controller."""

OUTSIDE_LOOP = frozenset(
    {
        # Disturbances from outside do not change the modes of a linear loop.
        *(f"gusts.*.{key}" for key in ("start", "speed", "length", "every")),
        *(f"turbulence.{key}" for key in ("altitude", "wind", "sigma", "rotary", "seed")),
        *(f"bias.*.{key}" for key in ("start", "value", "rise")),
        *(f"sines.*.{key}" for key in ("amplitude", "frequency", "phase")),
        *(f"shear.{key}" for key in ("law", "ground", "reference", "roughness", "exponent")),
        *(f"shear.{key}" for key in ("height", "north", "east")),
        *(f"microburst.{key}" for key in ("ground", "north", "east", "radius", "speed", "height")),
        "wind",
        *(f"sensors.{key}" for key in ("bias", "drift", "noise", "seed")),
        # The inner loop does not read the position.
        *(f"start.{key}" for key in ("north", "east", "heading")),
        *(f"pose.{key}" for key in ("rate", "delay", "bias", "drift", "noise", "seed")),
        # Products of small rates and angles are of the second order about trim.
        *("inertial_coupling", "kinematics"),
        # These act only if u is missing.
        *("max_age", "hold", "ramp"),
        # These say how the node runs.
        *("start_time", "lockstep", "control_rate", "duration", "recorded"),
    }
)
"""Keys of the aircraft that do not change its linear loop about trim."""


class Standing(Enum):
    """What a difference means for the margins and the guarantee of a loop."""

    TAKEN = auto()  # the loop uses the value of the aircraft
    # no linear loop contains the fact: margins leave it out, and no guarantee is stated
    LEFT_OUT = auto()
    NO_LOOP = auto()  # the loop that flew is unknown: neither margins nor guarantee are stated


MEANING = {
    Standing.TAKEN: "margins and guarantee apply to the aircraft",
    Standing.LEFT_OUT: "the margins are without it, and no guarantee is stated",
    Standing.NO_LOOP: "neither margins nor a guarantee are stated",
}


class Difference(NamedTuple):
    """A fact about the aircraft that differs from the controller's parameters."""

    fact: str  # the key, with its value in the aircraft and its value in the controller
    standing: Standing

    @property
    def sentence(self) -> str:
        """Sentence that states the fact, and what it means for the margins and the guarantee."""
        return f"{self.fact}; {MEANING[self.standing]}"


class FlightFacts(NamedTuple):
    """Facts about a flight that only its log can show. A fact is None if the log lacks it."""

    is_simulated: bool = True  # whether the aircraft of the scenario flew
    tick: float | None = None  # s, median period of the ticks
    y_period: float | None = None  # s, median period of y
    age: float | None = None  # s, mean age of u at the aircraft
    # the aircraft after each change in flight
    later: tuple[AircraftConfig, ...] = ()
    has_parameters: bool = True  # whether the controller flew with the parameters of the file


PLANNED = FlightFacts()
"""The facts of a flight that goes exactly as its scenario says."""


class Comparison(NamedTuple):
    """The timing of the loop that flies, and its differences from the controller's parameters."""

    timing: LoopTiming
    differences: tuple[Difference, ...]


def loop_of(controller: ControllerConfig) -> LoopTiming:
    """Return the lags, the delay and the period in the parameters of a controller."""
    lag = np.array(controller.lag, dtype=np.float64)
    return LoopTiming(lag, controller.delay, 1.0 / controller.rate)


def compare(
    scenario: Scenario, controller: ControllerConfig, flight: FlightFacts = PLANNED
) -> Comparison:
    """Compare lags, delay and effects in a controller's parameters with the aircraft that flies.

    If the two agree, the timing of the result equals the timing in the parameters to the last bit.
    """
    timing = loop_of(controller)
    differences = [*_of_log(controller, flight)]
    if flight.is_simulated:
        lag, others = _compare_lags(scenario, controller)
        timing = timing._replace(lag=lag)
        flown = [scenario, *(replace(scenario, aircraft=each) for each in flight.later)]
        for each in flown:
            others += _beyond_loop(each, controller)
        differences += others
    delay, late = _compare_delays(scenario, controller, flight)
    differences += late
    return Comparison(timing._replace(delay=delay), tuple(dict.fromkeys(differences)))


def lag_through(effect: FloatArray, T: FloatArray, lag: FloatArray) -> FloatArray:
    """Return the lags of the inputs v of a law whose allocation is u = T v, (m,), s.

        lag_i = sum_j effect_ij T_ji lag_j / sum_j effect_ij T_ji,  exact to first order in the lags

    `effect` (m, p) is the effect of the p effectors u on the outputs, T has the shape (p, m), and
    `lag` (p,) has the lags of the effectors, s. If no effector has an effect on output i, lag_i is
    the longest lag of an effector.
    """
    share = effect * T.T
    total = share.sum(axis=1)
    mean = np.maximum(share @ lag, 0.0) / np.where(total > 0.0, total, 1.0)
    return np.where(total > 0.0, mean, np.max(lag, initial=0.0))


def flown_lag(aircraft: AircraftConfig, controller: ControllerConfig) -> FloatArray:
    """Return the lag of the aircraft's actuators for each input of the law, (m,), s."""
    names = tuple(aircraft.channels().inputs)
    lags = dict(zip(names, aircraft.actuators.lag or (0.0,) * len(names), strict=True))
    lag = np.array([lags[name] for name in controller.effectors])
    allocation = controller.allocation
    if allocation is None:
        return lag
    T = np.reshape(allocation.T, (len(lag), -1))
    if aircraft.is_jsbsim:
        return lag_through(np.reshape(allocation.effect, (-1, len(lag))), T, lag)
    return lag_through(_effect(aircraft, controller), T, lag)


def _compare_lags(
    scenario: Scenario, controller: ControllerConfig
) -> tuple[FloatArray, list[Difference]]:
    """Compare the lags of the actuators, and return the actual lags, (m,), s, and the differences.

    A model of JSBSim contains actuators of its own, whose lag is not among the parameters of the
    scenario. So the lag in the controller's parameters can be longer than the lag in the scenario's
    section `aircraft`, but not shorter.
    """
    lag = np.array(controller.lag, dtype=np.float64)
    flown = flown_lag(scenario.aircraft, controller)
    differences = []
    for i, name in enumerate(controller.inputs):
        least, most = flown[i], np.inf if scenario.aircraft.is_jsbsim else flown[i]
        if _is_within(lag[i], least, most):
            continue
        fact = (
            f"aircraft.actuators.lag: the aircraft has {flown[i]:.6g} s in {name}, "
            f"controller.lag {lag[i]:.6g} s"
        )
        lag[i] = flown[i]
        differences.append(Difference(fact, Standing.TAKEN))
    return lag, differences


def _compare_delays(
    scenario: Scenario, controller: ControllerConfig, flight: FlightFacts
) -> tuple[float, list[Difference]]:
    """Compare the delays beyond sampling, and return the actual delay, s, and the differences.

    In simulation, y waits for the next tick and u for the next step of the aircraft, each up to a
    period of the aircraft. Any controller.delay within this range is accepted. For any other
    controller.delay, the longest delay of the range is assumed. For a user's own aircraft, the
    delay of its sensors and actuators is unknown, so controller.delay is accepted.

    The law steps with each y. If y comes less often than the ticks, the delay of one and a half
    ticks becomes one and a half periods of y.
    """
    aircraft = scenario.aircraft
    told_delay = controller.delay
    least, most, parts = 0.0, np.inf, []
    if flight.is_simulated:
        least = aircraft.sensors.delay + aircraft.actuators.delay
        most = least + WAITS / aircraft.rate
        parts.append("aircraft.sensors.delay, actuators.delay")
    rare = 1.5 * ((flight.y_period or 0.0) - 1.0 / controller.rate)
    if rare > SAME_PERIOD / controller.rate:
        least, most = least + rare, most + rare
        parts.append(f"y every {1e3 * (flight.y_period or 0.0):.3g} ms")
    differences = []
    delay = told_delay
    if not _is_within(told_delay, least, most):
        delay = most if np.isfinite(most) else least
        span = f"{least:.6g} s to {most:.6g} s" if np.isfinite(most) else f"{least:.6g} s or more"
        fact = f"{', '.join(parts)}: {span} in flight, controller.delay {told_delay:.6g} s"
        differences.append(Difference(fact, Standing.TAKEN))
    # u is held for a tick, so a mean age that is off by less than a tick shows no other delay
    if flight.age is not None and flight.age - delay >= 1.0 / controller.rate:
        delay = flight.age
        fact = f"age of u: {flight.age:.3g} s in the log, controller.delay {told_delay:.6g} s"
        differences.append(Difference(fact, Standing.TAKEN))
    return float(delay), differences


def _is_within(value: float, least: float, most: float) -> bool:
    """Return whether a value is in a range, with a tolerance for the few digits of a file."""
    slack = max(SMALLEST, STOP_TOLERANCE * abs(value))
    return bool(least - slack <= value <= most + slack)


def _of_log(controller: ControllerConfig, flight: FlightFacts) -> list[Difference]:
    """Return how the period and the parameters of the controller differ from those in a log."""
    differences = []
    period = 1.0 / controller.rate
    if flight.tick is not None and abs(flight.tick - period) > SAME_PERIOD * period:
        fact = (
            f"ticks every {1e3 * flight.tick:.3g} ms in the log, controller.rate: every "
            f"{1e3 * period:.3g} ms"
        )
        differences.append(Difference(fact, Standing.NO_LOOP))
    if not flight.has_parameters:
        fact = "parameters of the controller: the flight had other ones than the file"
        differences.append(Difference(fact, Standing.NO_LOOP))
    return differences


def _beyond_loop(scenario: Scenario, controller: ControllerConfig) -> list[Difference]:
    """Return the differences in end stops, rate limits and signs, and what no linear loop contains.

    An example of what a linear loop cannot contain is a fault of the aircraft.
    """
    aircraft = scenario.aircraft
    known = IN_LOOP | OUTSIDE_LOOP
    if not controller.vanes:
        known |= {"vanes.frozen_at", "vanes.dropout"}
    differences = [
        Difference(
            f"aircraft.{each.name}: the aircraft has {short_repr(each.value)}, the loop none",
            Standing.LEFT_OUT,
        )
        for each in unknown_keys(aircraft, known)
    ]
    flies = replace(scenario, controller=controller)
    beyond = (*limits_beyond_stops(flies), *_slew_beyond_rates(flies))
    differences += [Difference(sentence, Standing.LEFT_OUT) for sentence in beyond]
    # The loop already takes B from the airframe and D from the law, so these are TAKEN.
    signs = (*opposite_signs(flies), *_other_effect(flies))
    differences += [Difference(sentence, Standing.TAKEN) for sentence in signs]
    return differences


def _other_effect(scenario: Scenario) -> list[str]:
    """Return a sentence for each output whose row in allocation.effect differs from its row in C B.

    Rows that differ only by a positive factor are accepted as equal, because input_scale contains
    this factor.
    """
    controller = scenario.controller
    allocation = controller.allocation
    if allocation is None or scenario.aircraft.is_jsbsim:
        return []
    effects = np.reshape(allocation.effect, (-1, len(allocation.effectors)))
    sentences = []
    for name, effect, row in zip(
        controller.outputs, effects, _effect(scenario.aircraft, controller), strict=True
    ):
        factor = effect @ row / max(effect @ effect, np.finfo(float).tiny)
        off = np.abs(row - factor * effect).max()
        if factor <= 0.0 or off > STOP_TOLERANCE * np.abs(row).max():
            values = ", ".join(f"{value:.4g}" for value in row)
            told_values = ", ".join(f"{value:.4g}" for value in factor * effect)
            sentences.append(
                f"effect of the effectors on {name}: the aircraft has {values}, "
                f"controller.allocation.effect {told_values}"
            )
    return sentences


def _effect(aircraft: AircraftConfig, controller: ControllerConfig) -> FloatArray:
    """Return C B of the airframe file, (m, p): the effect of the effectors on the law's outputs."""
    airframe = load_airframe(aircraft.airframe)
    rows = [airframe.outputs.index(name) for name in controller.outputs]
    columns = [list(airframe.inputs).index(name) for name in controller.effectors]
    return np.asarray((airframe.matrix_c() @ airframe.matrix_b())[np.ix_(rows, columns)])


def _slew_beyond_rates(scenario: Scenario) -> list[str]:
    """Return a sentence for each rate limit of the controller that exceeds the actuator's."""
    controller = scenario.controller
    names = tuple(scenario.aircraft.channels().inputs)
    rates = dict(zip(names, scenario.aircraft.actuators.rate or (), strict=False))
    slews = controller.effector_limits().rate
    section = "controller" if controller.allocation is None else "controller.allocation"
    return [
        f"{section}.slew of {name}: found {slew:g}, expected aircraft.actuators.rate, "
        f"{rates[name]:g}, or less"
        for name, slew in zip(controller.effectors, slews.tolist(), strict=True)
        if name in rates and np.isfinite(slew) and slew > rates[name] * (1.0 + STOP_TOLERANCE)
    ]
