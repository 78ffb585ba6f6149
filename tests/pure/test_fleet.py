# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Vectorised flights of N aircraft: each is the single-process simulation, independent of the others."""

from typing import Any, NamedTuple

import numpy as np
import pytest

from aircraft_sim.airframe import load_airframe
from aircraft_sim.uncertainty import sampled_matrices
from control_laws import rise_di
from flight_analysis.closed_loop.scenario import Scenario
from flight_analysis.closed_loop.simulate import simulate
from flight_analysis.design.gain_selection import with_feedforward
from flight_analysis.metrics import true_error
from flight_bringup.scenarios import find_scenario
from flight_campaign import fleet
from flight_campaign.benchmark_course import build_course
from flight_core.parameters import ParameterError
from flight_core.vectors import Array, FloatArray
from rise_di_controller.control_law import ControlLaw, Measurements

NUMBERS = (0, 1)  # of the sampled aircraft
SERVO = find_scenario("osprey_servo").vary(
    flight={"duration": 9.0},
    aircraft={
        "gusts": {
            "vertical": {"start": 3.0, "speed": 10.12, "length": 15.24},
            "lateral": {"start": 5.0, "speed": 4.0, "length": 15.24},
        }
    },
)
AT_TICKS = {"aircraft": {"rate": 100.0, "step": 0.002}}


class Flight(NamedTuple):
    """Figures of one flight, as `fleet.FleetResult` has them, (m,)."""

    rms: FloatArray
    max: FloatArray
    slew: FloatArray


def fly_fleet(scenario: Scenario, part: float = 0.3, seed: int = 5) -> fleet.FleetResult:
    """The aircraft NUMBERS of a seed, in one fleet."""
    course = build_course(scenario)
    A, B = sampled_matrices(load_airframe(scenario.aircraft.airframe), part, part, seed, NUMBERS[0], len(NUMBERS))
    aircraft = fleet.assemble(A, B, scenario.aircraft.plant(), course)
    control_law, params = rise_di.CONTROL_LAWS[scenario.controller.law().sign], rise_di.params(scenario.controller)
    return fleet.fly(aircraft, fleet.vehicle(scenario), course, control_law, params)


def alone(scenario: Scenario, number: int, part: float = 0.3, seed: int = 5) -> Flight:
    """One of them in the single-process simulation, evaluated at the ticks."""
    uncertainty = {"A": part, "B": part, "seed": seed, "number": number}
    tape = simulate(scenario.vary(aircraft={"uncertainty": uncertainty}))
    error, outputs = true_error(tape), scenario.controller.outputs
    assert error is not None
    period = round(1e9 / scenario.controller.rate)
    e = np.array([error[name][error.stamp_ns % period == 0] for name in outputs])
    u = np.array([tape["u"][name] for name in scenario.controller.inputs])
    moved = np.abs(np.diff(u, axis=1, prepend=0.0)).sum(axis=1)  # a tick without a new y publishes no u
    return Flight(np.sqrt((e**2).mean(axis=1)), np.abs(e).max(axis=1), moved / scenario.flight.duration)


FEEDFORWARD = with_feedforward(SERVO.controller, load_airframe("osprey")).model_dump()


@pytest.mark.parametrize(
    "scenario",
    [
        pytest.param(SERVO, id="servos, noise, gusts"),
        pytest.param(SERVO.vary(aircraft={"inertial_coupling": 1.0}), id="products of states"),
        pytest.param(SERVO.vary(controller=FEEDFORWARD), id="feedforward"),
        pytest.param(
            SERVO.vary(aircraft={"turbulence": {"altitude": 100.0, "wind": 7.7}}, flight={"duration": 6.0}), id="turbulence"
        ),
        pytest.param(
            SERVO.vary(
                aircraft={
                    "sensors": {
                        "noise": [0.0017, 0.03, 0.0017, 0.0017],
                        "bias": [0.001, 0.1, 0.0, 0.0],
                        "drift": [0.001, 0.01, 0.001, 0.001],
                        "quantisation": [0.001, 0.0, 0.002, 0.0],
                        "delay": 0.02,
                    }
                }
            ),
            id="bias, drift, coarse and late y",
        ),
        pytest.param(
            SERVO.vary(aircraft={**AT_TICKS["aircraft"], "sensors": {"dropout": 0.3, "seed": 3}}), id="dropout of 30 % of y"
        ),
        pytest.param(
            SERVO.vary(
                controller={"lower": [-0.05, -0.02, -0.05, -0.1], "upper": [0.05, 0.02, 0.05, 0.1]},
                aircraft={"actuators": {"lag": [0.02, 0.1, 0.02, 0.02], "rate": [0.4, 0.3, 0.2, 0.2]}},
            ),
            id="limits of u and of the actuators' rates",
        ),
        pytest.param(
            SERVO.vary(
                aircraft={
                    "bias": {"q": {"start": 1.0, "value": 0.5, "rise": 0.5}},
                    "sines": {"p": {"amplitude": 0.3, "frequency": 3.0}},
                    "actuators": {"lag": [0.02, 0.1, 0.02, 0.02], "stuck_at": [np.inf, 2.0, np.inf, np.inf]},
                }
            ),
            id="bias, sines, thrust stuck",
        ),
    ],
)
def test_each_aircraft_of_a_fleet_flies_as_in_the_single_process_simulation(scenario: Scenario) -> None:
    # A fleet holds the nonlinear remainder over a tick and the wind over a step of the integration (2 ms); the simulation
    # does not. In the gust the difference is at most 1e-4 of the error; 1e-3 bounds it. A quantised y sometimes rounds to the
    # next step, after which u differs: 2e-2.
    together, within = fly_fleet(scenario), 2e-2 if scenario.aircraft.sensors.quantisation else 1e-3
    for place, number in enumerate(NUMBERS):
        one = alone(scenario, number)
        for name, values in one._asdict().items():
            assert np.asarray(getattr(together, name))[:, place] == pytest.approx(values, rel=within), (number, name)
    assert not np.asarray(together.diverged).any()


def test_every_aircraft_can_have_its_own_gains_wind_and_delay() -> None:
    course, vehicle, plant = build_course(SERVO), fleet.vehicle(SERVO), SERVO.aircraft.plant()
    A, B = sampled_matrices(load_airframe("osprey"), 0.3, 0.3, 5, 0, 1)
    control_law, params = rise_di.CONTROL_LAWS[SERVO.controller.law().sign], rise_di.params(SERVO.controller)
    wind, late = np.array([1.0, 0.0, 1.0, 1.0]), np.array([0, 0, 2, 0])
    beta = params.beta * np.array([1.0, 1.0, 1.0, 0.5])
    aircraft = fleet.assemble(np.repeat(A, 4, 0), np.repeat(B, 4, 0), plant, course, wind, late)
    together = fleet.fly(aircraft, vehicle, course, control_law, params._replace(beta=beta))
    for k in range(4):
        single = fleet.assemble(A, B, plant, course, wind[k], late[k])
        apart = fleet.fly(single, vehicle, course, control_law, params._replace(beta=beta[:, k : k + 1]))
        # The same operations; only their order in sums may differ with the vector width of the CPU.
        assert np.asarray(together.rms)[:, k] == pytest.approx(np.asarray(apart.rms)[:, 0], rel=1e-9)
    rms = np.asarray(together.rms)
    assert rms[0, 1] < 0.5 * rms[0, 0]  # without the gust q has its largest error no more
    assert not np.allclose(rms[:, 2], rms[:, 0], rtol=1e-3)
    assert not np.allclose(rms[:, 3], rms[:, 0], rtol=1e-3)


def _pulse(delay: int) -> ControlLaw:
    """An open-loop control law: one pulse of the elevator, delayed by so many ticks."""

    def start(measured: Measurements, params: Any) -> Array:
        return 0.0 * measured.y[:1] + 1.0

    def step(state: Array, measured: Measurements, dt: Array, params: Any) -> tuple[Array, Array]:
        inside = (state >= 10.0 + delay) & (state < 30.0 + delay)
        return state + 1.0, 0.0 * measured.y + 0.05 * inside * np.array([[1.0], [0.0], [0.0], [0.0]])

    return ControlLaw(start, step)


def test_a_late_u_acts_that_many_ticks_later() -> None:
    undisturbed = SERVO.vary(aircraft={"gusts": {}}, flight={"duration": 2.0})
    course, vehicle, plant = build_course(undisturbed), fleet.vehicle(undisturbed), undisturbed.aircraft.plant()
    A, B = sampled_matrices(load_airframe("osprey"), 0.0, 0.0, 1, 0, 1)
    late = fleet.fly(fleet.assemble(A, B, plant, course, late=3), vehicle, course, _pulse(0), ())
    later = fleet.fly(fleet.assemble(A, B, plant, course), vehicle, course, _pulse(3), ())
    for name in ("rms", "max"):
        assert np.asarray(getattr(late, name)) == pytest.approx(np.asarray(getattr(later, name)), rel=1e-12)
    assert np.asarray(late.max)[0, 0] > 0.01  # it did move


def test_an_aircraft_that_diverges_is_marked_and_does_not_affect_the_others() -> None:
    course, vehicle, plant = build_course(SERVO), fleet.vehicle(SERVO), SERVO.aircraft.plant()
    A, B = sampled_matrices(load_airframe("osprey"), 0.0, 0.0, 1, 0, 2)
    B = B * np.array([1.0, -1.0])[:, None, None]  # every sign is wrong: the loop is unstable
    vehicle = vehicle._replace(actuators=vehicle.actuators._replace(lower=None, upper=None, rate=None))
    params = rise_di.params(SERVO.controller)
    free = params.limits._replace(lower=-np.inf + 0.0 * params.D, upper=np.inf + 0.0 * params.D)
    aircraft = fleet.assemble(A, B, plant, course)
    both = fleet.fly(aircraft, vehicle, course, rise_di.CONTROL_LAWS[SERVO.controller.law().sign], params._replace(limits=free))
    assert np.asarray(both.diverged).tolist() == [False, True]
    assert np.isfinite(np.asarray(both.rms)[:, 0]).all()


@pytest.mark.parametrize(
    ("sections", "sentence"),
    [
        ({"aircraft": {"sensors": {"dropout": 0.1}}}, "aircraft.rate: found 500 Hz, expected controller.rate"),
        ({"aircraft": {"sensors": {"delay": 0.004}}}, "sensors.delay: found 0.01 s"),
    ],
)
def test_a_scenario_that_a_fleet_cannot_fly_is_refused(sections: dict[str, Any], sentence: str) -> None:
    with pytest.raises(ParameterError, match=f"^{sentence}"):
        build_course(SERVO.vary(**sections))


def test_an_aircraft_of_jsbsim_is_refused() -> None:
    with pytest.raises(ParameterError, match=r"^airframe: found jsbsim:c172p, expected an airframe with matrices"):
        build_course(find_scenario("jsbsim_c172p"))
