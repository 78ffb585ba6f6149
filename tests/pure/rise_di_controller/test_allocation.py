# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test the allocation of the inputs of a law to a larger number of effectors.

The tests cover stops, rates, priority, and a flight whose replay is equal to the bit.
"""

from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.optimize import linprog
from tests.conftest import REPOSITORY, refusing
from tests.maps import named_map

from aircraft_sim.airframes.airframe import load_airframe
from flight_analysis.closed_loop.replay import replay
from flight_analysis.closed_loop.scenario_library import find_scenario
from flight_analysis.closed_loop.simulate import simulate
from flight_core.vectors import FloatArray
from flight_design.identification.sign_check import check_scenario
from rise_di_controller.extensions.allocation import Allocation, allocate, allocation
from rise_di_controller.law.saturation import Limits

DT = 0.01


def drawn(generator: np.random.Generator, m: int, p: int, rate: float = np.inf) -> Allocation:
    """Return an allocation for a random C B of full rank.

    Its pseudo-inverse is weighted by the ranges of the effectors.
    """
    stops = generator.uniform(0.2, 1.0, p)
    Omega = generator.normal(size=(m, p))
    T = stops[:, None] * np.linalg.pinv(Omega * stops)
    return allocation(T, Omega, range(m), Limits(-stops, stops, np.full(p, rate)))


def demands(
    seed: int, count: int, size: float, rate: float = np.inf
) -> list[tuple[Allocation, FloatArray]]:
    """Return allocations, each with a demand that is `size` times the v of a reachable position."""
    generator = np.random.default_rng(seed)
    pairs = []
    for _ in range(count):
        m = int(generator.integers(2, 5))
        params = drawn(generator, m, int(generator.integers(m, 9)), rate)
        pairs.append(
            (
                params,
                size
                * params.effect
                @ (params.limits.upper * generator.uniform(-1.0, 1.0, len(params.T))),
            )
        )
    return pairs


def test_a_demand_inside_the_limits_is_t_v_to_the_last_bit() -> None:
    for params, v in demands(1, 20, 0.05):
        u, effect = allocate(v, np.zeros(len(params.T)), DT, params)
        assert effect.tobytes() == v.tobytes()
        assert_allclose(u, params.T @ v, rtol=1e-12, atol=1e-14)  # a sum in another order


@pytest.mark.parametrize("size", [0.9, 3.0])
def test_effectors_stay_inside_stops_and_rates_and_give_what_is_returned(size: float) -> None:
    for params, v in demands(2, 40, size, rate=5.0):
        u_before = np.zeros(len(params.T))
        for _ in range(4):
            u, effect = allocate(v, u_before, DT, params)
            assert (np.abs(u) <= params.limits.upper).all()
            assert (np.abs(u - u_before) <= 5.0 * DT + 1e-12).all()
            assert_allclose(params.effect @ u, effect, rtol=1e-9, atol=1e-12)
            u_before = u


def test_effectors_beyond_their_stops_leave_the_others_the_whole_demand() -> None:
    """An effector beyond its new stop does not reduce what the others are asked for.

    With the new stops of 0.5, the first effector stands at 0.6 and moves back to between 0.4 and
    0.5 in one tick. The demanded change of the effect is measured from its position inside the
    stops, and not from 0.6.
    """
    T = np.array([[0.5], [0.5]])
    limits = Limits(np.full(2, -0.5), np.full(2, 0.5), np.full(2, 0.2 / DT))
    params = allocation(T, np.ones((1, 2)), range(1), limits)
    u, v = allocate(np.array([0.6]), np.array([0.6, 0.0]), DT, params)
    assert_allclose(v, [0.6], rtol=1e-9)
    assert (u <= [0.5, 0.2]).all()
    assert (u >= [0.4, -0.2]).all()


def most(params: Allocation, v: FloatArray) -> float:
    """Return the largest s for which some u inside the stops gives s v.

    It is found with a linear program.
    """
    m, p = params.effect.shape
    stops = [(-stop, stop) for stop in params.limits.upper]
    equal: dict[str, Any] = {"A_eq": np.column_stack([params.effect, -v]), "b_eq": np.zeros(m)}
    return float(linprog(-np.eye(1, p + 1, p)[0], bounds=[*stops, (0.0, None)], **equal).x[-1])


def test_what_some_effectors_inside_the_stops_give_is_given() -> None:
    """A demand is met if the effectors can meet it within their stops.

    Ten sweeps met 98.8 % of 500 demands to 1 %. This test has about 50 demands at 0.9 of the limit
    that a linear program finds, and at most three of them may be missed.
    """
    misses = hard = 0
    for params, v in demands(3, 100, 1.0):
        demand = 0.9 * most(params, v) * v
        if (np.abs(params.T @ demand) <= params.limits.upper).all():
            continue
        hard += 1
        _, effect = allocate(demand, np.zeros(len(params.T)), DT, params)
        misses += bool(np.linalg.norm(effect - demand) > 0.01 * np.linalg.norm(demand))
    assert hard > 25
    assert misses <= 3


def test_beyond_the_stops_the_first_input_keeps_what_a_linear_program_finds_for_it() -> None:
    """The first input keeps as much of its demand as a linear program finds possible.

    The tolerance is 1/16, because the halvings resolve 1/32 of a demand, and the sweeps do not
    converge fully.
    """
    compared = 0
    for params, v in demands(4, 40, 3.0):
        if most(params, v) >= 1.0:
            continue
        _, effect = allocate(v, np.zeros(len(params.T)), DT, params)
        assert effect[0] / v[0] >= min(most(params, np.eye(len(v))[0] * v), 1.0) - 1.0 / 16.0
        compared += 1
    assert compared > 20


def full_mixing(**changes: Any) -> dict[str, Any]:
    """Return a controller section of osprey_servo whose inputs are v = C B u.

    The inverse is computed by NumPy alone.
    """
    # per deg and %
    Omega = np.array(
        [[0.98, 0, 0, 0], [0.003, 0.06, 0, 0], [0, 0, 1.5, -0.02], [0, 0, -0.09, 0.17]]
    )
    unit = np.array([np.pi / 180.0, 0.01, np.pi / 180.0, np.pi / 180.0])
    Omega[[0, 2, 3]] /= unit  # q, p, r: rad/s^2 per unit, SI
    Omega[1] /= unit
    stop = [0.3, 0.5, 0.3, 0.3]
    section = {
        "effectors": ["elevator", "thrust", "aileron", "rudder"],
        "T": np.linalg.inv(Omega).ravel().tolist(),
        "effect": Omega.ravel().tolist(),
        "lower": [-value for value in stop],
        "upper": stop,
    }
    return section | changes


def mixed(**changes: Any) -> dict[str, Any]:
    """Return the changes that make the controller of osprey_servo use this allocation."""
    return {
        "outputs": ["q", "V", "p", "r"],
        "inputs": ["v_q", "v_V", "v_p", "v_r"],
        "D": [1, 1, 1, 1],
        "input_scale": [1.0, 1.0, 1.0, 1.0],
        "omega": [1.3] * 4,
        "lag": [0.02, 0.1, 0.02, 0.02],
        "k_g": 1.0,
        "k_d": [12.0, 1.0, 12.0],
        "Lambda": [4.0, 0.4, 4.0, 2.0],
        "beta": [28.0, 8.0, 18.0, 3.0],
        "softening": 3.0,
        "lower": None,
        "upper": None,
        "slew": None,
        "allocation": full_mixing(**changes),
    }


def test_a_flight_with_an_allocation_at_its_stops_tracks_and_replays_to_the_bit() -> None:
    """The flight tracks although the elevator has a third of the range that the commands need.

    The allocation is at its stops, and the integrals of q do not wind up.
    """
    stop = [0.01, 0.5, 0.3, 0.3]
    scenario = find_scenario("osprey_servo", 10.0).vary(
        controller=mixed(lower=[-value for value in stop], upper=stop, slew=[1.0, 1.0, 1.0, 1.0]),
        aircraft={"rate": 100.0, "step": 0.005},
        reference_model={"rate": 100.0},
    )
    tape = simulate(scenario)
    assert tape.outcome.status == 0
    assert tape["u"].names == ("elevator", "thrust", "aileron", "rudder")
    assert np.abs(tape["u"]["elevator"]).max() == 0.01
    is_limited = tape["internals"].group("limited")["v_q"] > 0.0
    assert 0.1 < is_limited.mean() < 0.9
    assert replay(tape).is_equal()
    # The command ends at 8 s, and q needs no elevator soon after: with integrals that wind up e
    # would stay large.
    assert np.abs(tape["internals"]["e.q"][tape.time("internals") > 9.5]).max() < 0.01


@pytest.mark.parametrize(
    "name, effector, channel",
    [
        ("osprey_twin", "left_elevator", "q"),
        ("osprey_vtail", "left_aileron", "p"),
        ("x8_elevons", "right_outer", "q"),
    ],
)
def test_shipped_aircraft_track_without_an_effector(name: str, effector: str, channel: str) -> None:
    """The shipped aircraft still track when an effector has lost its whole effect.

    The remaining effectors keep half of the effect, for which D = I is still right. The error is at
    most twice the 15 mrad/s of the undamaged aircraft, and u stays inside the limits.
    """
    scenario = find_scenario(name)
    actuators = scenario.aircraft.actuators.model_dump() | {"faults": [f"{effector} lost 1"]}
    scenario = scenario.vary(
        aircraft={"actuators": actuators, "rate": 200.0, "step": 0.005},
        reference_model={"rate": 200.0},
        flight={"duration": 5.0},
    )
    tape = simulate(scenario)
    assert tape.outcome.status == 0
    assert np.abs(tape["internals"][f"e.{channel}"]).max() < 0.03
    limits = scenario.controller.effector_limits()
    assert ((tape["u"].values >= limits.lower) & (tape["u"].values <= limits.upper)).all()


def test_a_vehicle_that_is_no_aeroplane_flies_and_replays(monkeypatch: pytest.MonkeyPatch) -> None:
    """A hexarotor flies, which has no channel V and no guidance.

    The commands are two pulses of 0.5 rad/s. The error is 64 mrad/s at most, and the bound is a
    sixth of the commands.
    """
    monkeypatch.chdir(REPOSITORY)  # the scenario names its airframe from there
    path = "examples/hexarotor/hexarotor_flight.yaml"
    scenario = find_scenario(path, 3.0)
    tape = simulate(scenario)
    assert tape.outcome.status == 0
    assert max(np.abs(tape["internals"][f"e.{name}"]).max() for name in "pq") < 0.5 / 6.0
    assert replay(tape).is_equal()


@pytest.mark.parametrize(
    "changes, sentence",
    [
        ({"T": [1.0] * 15}, "allocation.T: found 15 values, expected 16: 4 rows of 4"),
        ({"effect": [1.0] * 16}, "allocation.T: found effect T that is off I"),
        (
            {"lower": [0.1] * 4},
            (
                "allocation.lower: found 0.1 and upper 0.3 of elevator, expected a range with "
                "trim, 0, inside"
            ),
        ),
    ],
)
def test_an_allocation_that_does_not_fit_is_refused_with_a_sentence(
    changes: dict[str, Any], sentence: str
) -> None:
    with refusing(sentence):
        find_scenario("osprey_servo").vary(controller=mixed(**changes))


def test_a_map_with_a_wrong_sign_contradicts_the_effect_of_an_effector() -> None:
    """A wrong sign of an effector is found in `effect`.

    D of the law is I for either sign, so that it cannot show the sign.
    """
    channel_map = named_map("ardupilot")
    frame = load_airframe("osprey")
    assert not check_scenario(
        channel_map, find_scenario("osprey_servo").vary(controller=mixed()), frame, None
    ).contradictions
    flip = np.diag([1.0, 1.0, -1.0, 1.0])
    effect = (np.reshape(full_mixing()["effect"], (4, 4)) @ flip).ravel().tolist()
    T = (flip @ np.reshape(full_mixing()["T"], (4, 4))).ravel().tolist()
    scenario = find_scenario("osprey_servo").vary(controller=mixed(effect=effect, T=T))
    (sentence,) = check_scenario(channel_map, scenario, frame, None).contradictions
    assert (
        "aileron has +85.9 on p_dot, allocation.effect has -85.9: a positive aileron means roll "
        "right" in sentence
    )
