# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test vectorised flights of N aircraft.

Each is equal to the simulation in one process, and independent of the others.
"""

from dataclasses import replace
from typing import Any, NamedTuple

import jax
import numpy as np
import pytest
from pytest import approx
from tests.closed_loop import error
from tests.conftest import refusing

from aircraft_sim.airframes.airframe import load_airframe
from aircraft_sim.uncertainty import gust_directions, sampled_matrices
from control_laws.nominal_model import campaign_law
from flight_analysis.closed_loop.scenario import Scenario
from flight_analysis.closed_loop.scenario_library import find_scenario
from flight_analysis.closed_loop.simulate import simulate
from flight_campaign.batch import batch, batch_allocation, batch_matrices, batch_schedule
from flight_campaign.batch.batch_loop import FleetResult
from flight_campaign.batch.campaign_course import build_course
from flight_core.vectors import Array, FloatArray
from flight_design.gains.feedforward_model import with_feedforward
from rise_di_controller.extensions.allocation import allocate, allocation
from rise_di_controller.law.control_law import ControlLaw, Measurements
from rise_di_controller.law.saturation import Limits

pytestmark = pytest.mark.slow

SERVO = find_scenario("osprey_servo").vary(
    flight={"duration": 7.0},
    aircraft={
        "rate": 100.0,
        "step": 0.002,
        "gusts": {
            "vertical": {"start": 3.0, "speed": 10.12, "length": 15.24},
            "lateral": {"start": 5.0, "speed": 4.0, "length": 15.24},
        },
    },
)
CONTROL_LAW, PARAMS = SERVO.controller.tuned_law()
PARAMS = batch.shared(PARAMS)


def sampled(
    part: float, seed: int, count: int, airframe: str = "osprey"
) -> tuple[FloatArray, FloatArray]:
    """Return A and B of the first aircraft of a seed."""
    return sampled_matrices(load_airframe(airframe), part, part, seed, 0, count)


def fly(
    scenario: Scenario,
    A: FloatArray,
    B: FloatArray,
    wind: Array = 1.0,
    late: Array = 0,
    control_law: ControlLaw = CONTROL_LAW,
    params: Any = PARAMS,
) -> FleetResult:
    course = build_course(scenario)
    directions = gust_directions(
        scenario.aircraft.nominal_airframe(), A, scenario.aircraft.uncertainty.wind
    )
    aircraft = batch_matrices.assemble(
        A, B, scenario.aircraft.plant(), course, wind, late, directions
    )
    return batch.fly(aircraft, batch.vehicle(scenario), course, control_law, params)


def alone(scenario: Scenario, number: int) -> dict[str, FloatArray]:
    """Fly one of the aircraft in the simulation in one process, and evaluate it at the ticks.

    The figures are those of `FleetResult`, (m,).
    """
    effect = scenario.aircraft.uncertainty.wind
    uncertainty = {"A": 0.3, "B": 0.3, "wind": effect, "seed": 5, "number": number}
    tape = simulate(scenario.vary(aircraft={"uncertainty": uncertainty}))
    true = error(tape)
    period = round(1e9 / scenario.controller.rate)
    e = np.array([true[name][true.stamp_ns % period == 0] for name in scenario.controller.outputs])
    u = np.array([tape["u"][name] for name in scenario.controller.effectors])
    # A tick without a new y publishes no u.
    after = np.abs(np.diff(u, axis=1, prepend=0.0)).sum(axis=1)
    slew = after / scenario.flight.duration
    return {"rms": np.sqrt((e**2).mean(axis=1)), "max": np.abs(e).max(axis=1), "slew": slew}


LAG = [0.02, 0.1, 0.02, 0.02]
DT = np.float64(0.01)
VARIATIONS: dict[str, dict[str, Any]] = {  # of servos, noise and gusts
    # In a gust from two sides p r and p q change the error by 3 %, else by less than the bound.
    "products of states, gusts with the published effect": {
        "aircraft": {
            "inertial_coupling": 1.0,
            "uncertainty": {"wind": "published"},
            "gusts": {"lateral": {"start": 3.0, "speed": 20.0, "length": 15.24}},
        },
    },
    "air that turns, limits of u and of the actuators' rates, thrust weak": {
        "controller": {"lower": [-0.05, -0.02, -0.05, -0.1], "upper": [0.05, 0.02, 0.05, 0.1]},
        "aircraft": {
            "turbulence": {"altitude": 100.0, "wind": 7.7, "rotary": True},
            "actuators": {
                "lag": LAG,
                "rate": [0.4, 0.3, 0.2, 0.2],
                "faults": ["thrust weak 2 0.3"],
            },
        },
    },
    "bias, drift, coarse and late y of 500 Hz": {
        "aircraft": {
            "rate": 500.0,
            "sensors": {
                "noise": [0.0017, 0.03, 0.0017, 0.0017],
                "bias": [0.001, 0.1, 0.0, 0.0],
                "drift": [0.001, 0.01, 0.001, 0.001],
                "quantisation": [0.001, 0.0, 0.002, 0.0],
                "delay": 0.02,
            },
        }
    },
    "dropout of 30 % of y, nonlinear kinematics": {
        "aircraft": {"sensors": {"dropout": 0.3, "seed": 3}, "kinematics": "euler"}
    },
    "feedforward, aileron weak, elevator loose, thrust and rudder lost, drift": {
        "controller": with_feedforward(SERVO.controller, load_airframe("osprey")).model_dump(),
        "aircraft": {
            "actuators": {
                "lag": LAG,
                "faults": [
                    "aileron weak 2",
                    "elevator loose 1 0.001",
                    "thrust failed 2",
                    "rudder lost 3",
                ],
            },
            "drift": {"start": 1.0, "duration": 4.0, "A": 0.3, "B": 0.3},
        },
    },
    "bias, sines, thrust stuck, rudder hard over, aileron slow": {
        "aircraft": {
            "bias": {"q": {"start": 1.0, "value": 2.0, "rise": 0.5}},
            "sines": {"p": {"amplitude": 0.3, "frequency": 3.0}},
            "actuators": {
                "lag": LAG,
                "rate": [0.1] * 4,
                "upper": [0.5, 0.5, 0.5, 0.02],
                "faults": ["thrust stuck 2", "rudder hard_over 1 upper", "aileron slow 2"],
            },
        }
    },
}


@pytest.mark.parametrize("name", VARIATIONS)
def test_each_aircraft_with_column_limits_flies_as_in_single_process_simulation(name: str) -> None:
    # A fleet holds the nonlinear remainder over a tick and the wind over a step of the integration
    # (2 ms); the simulation does not. In the gust the difference is at most 1e-4 of the error; 1e-3
    # bounds it. A quantised y sometimes rounds to the next step, after which u differs: 2e-2.
    scenario = SERVO.vary(**VARIATIONS[name])
    within = 2e-2 if scenario.aircraft.sensors.quantisation else 1e-3
    params = batch.shared(scenario.controller.law_params())
    together = fly(scenario, *sampled(0.3, 5, 2), params=params)
    # The second one: what would fly as the first differs.
    for key, values in alone(scenario, 1).items():
        assert np.asarray(getattr(together, key))[:, 1] == approx(values, rel=within), key
    assert not np.asarray(together.diverged).any()


def test_an_allocation_at_its_stops_flies_as_in_single_process_simulation() -> None:
    """The limits are reached in a tenth of the ticks for p and r, and in two fifths for V.

    The tolerance is the same as for the flights above.
    """
    twin = find_scenario("osprey_twin")
    stop = [0.01 if "aileron" in name else 0.5 for name in twin.controller.effectors]
    section = twin.controller.model_dump()["allocation"] | {
        "lower": [-value for value in stop],
        "upper": stop,
        "slew": [2.0] * 7,
    }
    scenario = twin.vary(controller={"allocation": section}, flight={"duration": 6.0})
    law, params = scenario.controller.tuned_law()
    together = fly(
        scenario, *sampled(0.3, 5, 2, "osprey_twin"), control_law=law, params=batch.shared(params)
    )
    for key, values in alone(scenario, 1).items():
        assert np.asarray(getattr(together, key))[:, 1] == approx(values, rel=1e-3), key


def test_an_allocation_of_a_fleet_is_that_of_each_aircraft() -> None:
    """A tick begins with random effectors, and demands up to 30 times what the stops allow."""
    generator = np.random.default_rng(1)
    stops = np.linspace(0.2, 1.0, 7)
    effect = generator.normal(size=(4, 7))
    T = stops[:, None] * np.linalg.pinv(effect * stops)
    params = allocation(T, effect, (2, 0, 3, 1), Limits(-stops, stops, np.full(7, 20.0)))
    of_effectors, before = (
        stops[:, None] * generator.uniform(-1.0, 1.0, (7, 40)) for _ in range(2)
    )
    v = effect @ of_effectors * generator.choice([0.05, 0.9, 3.0, 30.0], 40)
    u, given = jax.jit(batch_allocation.allocate)(
        v, before, DT, batch_allocation.with_column_limits(params)
    )
    for k in range(40):
        alone_u, alone_given = allocate(v[:, k], before[:, k], DT, params)
        assert np.asarray(u)[:, k] == approx(alone_u, abs=1e-9)  # sums in another order
        assert np.asarray(given)[:, k] == approx(alone_given, abs=1e-9)


def test_every_aircraft_can_have_own_gains_wind_and_delay() -> None:
    A, B = sampled(0.3, 5, 1)
    wind = np.array([1.0, 0.0, 1.0, 1.0])
    late = np.array([0, 0, 2, 0])
    beta = PARAMS.beta * np.array([1.0, 1.0, 1.0, 0.5])
    together = fly(
        SERVO, np.repeat(A, 4, 0), np.repeat(B, 4, 0), wind, late, params=PARAMS._replace(beta=beta)
    )
    for k in range(4):
        alike = np.full(4, k)  # four like it, so that the loop is compiled once
        apart = fly(
            SERVO,
            np.repeat(A, 4, 0),
            np.repeat(B, 4, 0),
            wind[alike],
            late[alike],
            params=PARAMS._replace(beta=beta[:, alike]),
        )
        # The same operations; only their order in sums may differ with the vector width of the CPU.
        assert np.asarray(together.rms)[:, k] == approx(np.asarray(apart.rms)[:, 0], rel=1e-9)
    rms = np.asarray(together.rms)
    assert rms[0, 1] < 0.5 * rms[0, 0]  # without the gust q has its largest error no more
    assert not np.allclose(rms[:, 2], rms[:, 0], rtol=1e-3)
    assert not np.allclose(rms[:, 3], rms[:, 0], rtol=1e-3)


LOSSY = SERVO.vary(aircraft={"sensors": {"dropout": 0.02, "seed": 3}})


def test_loop_without_branches_gives_the_bits_of_the_loop_with_branches(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The course has an engagement, gusts, a late y, and dropouts in some of its runs."""
    monkeypatch.setattr(batch_schedule, "UNROLL", 2)  # each tick unrolled compiles for a second
    sensors = {"dropout": 0.003, "seed": 4, "delay": 0.02}
    # 3 ticks until it is engaged, and runs of equal lengths, which share their loops
    scenario = SERVO.vary(aircraft={"sensors": sensors}, flight={"duration": 6.03})
    course = build_course(scenario)
    kinds = {run.pattern[0] for run in batch_schedule.without_branches(course) if run.length > 2}
    assert len({(kind.phase is None, kind.is_forced) for kind in kinds}) >= 3
    A, B = sampled(0.3, 5, 6)
    aircraft = batch_matrices.assemble(A, B, scenario.aircraft.plant(), course)
    results = [
        batch.fly(aircraft, batch.vehicle(scenario), course, CONTROL_LAW, PARAMS, schedule=schedule)
        for schedule in (batch_schedule.with_branches, batch_schedule.without_branches)
    ]
    for name in ("rms", "max", "slew", "diverged"):
        with_branches, without = (np.asarray(getattr(result, name)) for result in results)
        assert (with_branches == without).all(), name


def test_runs_of_a_course_cover_each_tick_once_with_its_phase_and_forcing() -> None:
    course = build_course(LOSSY)
    segments = course.segments
    k = 0
    kinds = set()
    for run in batch_schedule.without_branches(course):
        kinds.add(run)
        for tick in range(k, k + run.length):
            kind = run.pattern[(tick - k) % len(run.pattern)]
            assert kind.phase in {None, segments.phase[tick]}
            assert kind.is_forced or not segments.forcing[tick].any()
        k += run.length
    assert k == len(segments.t)
    assert any(run.pattern[0].phase is None for run in kinds)  # a run with a dropout asks
    assert len(kinds) <= 8  # each is compiled, a few seconds


def test_matrices_compiled_for_a_device_are_those_of_numpy(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    scenario = SERVO.vary(aircraft={"drift": {"start": 1.0, "duration": 4.0, "A": 0.3, "B": 0.3}})
    course = build_course(scenario)
    plant = scenario.aircraft.plant()
    A, B = sampled(0.3, 5, 3)
    on_host = batch_matrices.assemble(A, B, plant, course)
    monkeypatch.setattr(batch_matrices, "is_cpu", lambda: False)
    on_device = batch_matrices.assemble(A, B, plant, course)
    assert on_device.blocks == on_host.blocks
    leaves = (jax.tree.leaves(fleet._replace(blocks=())) for fleet in (on_host, on_device))
    for numpy_values, values in zip(*leaves, strict=True):
        # A fused multiply-add rounds once where NumPy rounds twice.
        assert np.asarray(values) == approx(np.asarray(numpy_values), rel=1e-13, abs=1e-15)


class Ticks(NamedTuple):
    """State of the pulse."""

    count: Array


def test_wind_acts_on_x_dot_by_own_directions_of_each_aircraft() -> None:
    course = build_course(SERVO)
    plant = SERVO.aircraft.plant()
    A, B = sampled(0.3, 5, 2)
    directions = gust_directions(load_airframe("osprey"), A, "air_relative")
    assembled = batch_matrices.assemble(A, B, plant, course, gust_directions=directions)
    assert [list(load_airframe("osprey").gusts)[axis] for axis in course.axes] == [
        "vertical",
        "lateral",
    ]
    C = plant.aircraft.C[course.order]
    for k in range(2):
        assert np.asarray(assembled.forced_rate)[..., k] == approx(
            C @ directions[k][:, course.axes], rel=1e-14
        )
    # Without directions the plant's own act on all.
    shared = np.asarray(batch_matrices.assemble(A, B, plant, course).forced_rate)
    assert (shared == (C @ plant.aircraft.gust_direction[:, course.axes])[..., None]).all()


def _pulse(delay: int) -> ControlLaw:
    """Return an open-loop control law that sends one pulse of the elevator, `delay` ticks late."""

    def engage(measured: Measurements, params: Any) -> Ticks:
        return Ticks(0.0 * measured.y[:1] + 1.0)

    def limited(
        state: Ticks, measured: Measurements, dt: Array, params: Any, limits: Limits
    ) -> tuple[Ticks, Array, Array]:
        inside = (state.count >= 10.0 + delay) & (state.count < 30.0 + delay)
        u = 0.0 * measured.y + 0.05 * inside * np.array([[1.0], [0.0], [0.0], [0.0]])
        return Ticks(state.count + 1.0), u, u

    return campaign_law(Ticks, engage, limited)


def test_late_u_acts_that_many_ticks_later() -> None:
    undisturbed = SERVO.vary(aircraft={"gusts": {}}, flight={"duration": 2.0})
    late = fly(undisturbed, *sampled(0.0, 1, 1), late=3, control_law=_pulse(0), params=())
    later = fly(undisturbed, *sampled(0.0, 1, 1), control_law=_pulse(3), params=())
    for name in ("rms", "max"):
        assert np.asarray(getattr(late, name)) == approx(
            np.asarray(getattr(later, name)), rel=1e-12
        )
    assert np.asarray(late.max)[0, 0] > 0.01  # it did move


def test_aircraft_that_diverges_marked_and_does_not_affect_others() -> None:
    course = build_course(SERVO)
    vehicle = batch.vehicle(SERVO)
    A, B = sampled(0.0, 1, 2)
    B = B * np.array([1.0, -1.0])[:, None, None]  # every sign is wrong: the loop is unstable
    unlimited = vehicle.actuators._replace(lower=None, upper=None, rate=None)
    vehicle = replace(vehicle, actuators=unlimited)
    infinite = np.full((4, 1), np.inf)
    vehicle = replace(vehicle, limits=Limits(-infinite, infinite, infinite))
    aircraft = batch_matrices.assemble(A, B, SERVO.aircraft.plant(), course)
    both = batch.fly(aircraft, vehicle, course, CONTROL_LAW, PARAMS)
    assert np.asarray(both.diverged).tolist() == [False, True]
    assert np.isfinite(np.asarray(both.rms)[:, 0]).all()


@pytest.mark.parametrize(
    "scenario, sentence",
    [
        (
            SERVO.vary(aircraft={"rate": 500.0, "sensors": {"dropout": 0.1}}),
            "aircraft.rate: found 500 Hz, expected controller.rate",
        ),
        (
            SERVO.vary(aircraft={"rate": 500.0, "sensors": {"delay": 0.004}}),
            "sensors.delay: found 0.01 s",
        ),
        (
            find_scenario("jsbsim_c172p"),
            "airframe: found jsbsim:c172p, expected an airframe with matrices",
        ),
    ],
)
def test_scenario_that_fleet_cannot_fly_refused(scenario: Scenario, sentence: str) -> None:
    with refusing(f"^{sentence}"):
        build_course(scenario)
