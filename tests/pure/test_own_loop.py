# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test the controller in a loop of the user and in python-control.

The aircraft as an environment of gymnasium is tested, too.
"""

import re
import subprocess
import sys
from typing import Any

import control
import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from numpy.typing import ArrayLike
from pytest import approx
from tests.conftest import REPOSITORY

import rise_di
from aircraft_sim.simulator import Simulator
from flight_core.modes import Mode
from flight_core.outcome import FlightEnded
from flight_core.tape import Tape
from flight_core.vectors import FloatArray, select

SCENARIO = rise_di.find_scenario("osprey_servo", 3.0)
CONTROLLER = SCENARIO.controller
M = len(CONTROLLER.outputs)
FLIGHT = "rise_di.flight_env:rise_di/Flight-v0"


@pytest.fixture(scope="module")
def flown() -> Tape:
    """Return a flight with a pulse, noise and servos.

    y has no delay here, so each tick has the y of its instant.
    """
    return rise_di.simulate(SCENARIO)


def columns(tape: Tape, topic: str, names: tuple[str, ...]) -> FloatArray:
    """Return samples of a topic at the ticks, (N, m), in the law's order."""
    signal = tape[topic]
    at = np.isin(signal.stamp_ns, tape["u"].stamp_ns)
    return np.array([signal[name][at] for name in names]).T


def test_loop_gives_bits_of_simulation(flown: Tape) -> None:
    loop = rise_di.Loop(CONTROLLER)
    y = columns(flown, "y", CONTROLLER.outputs)
    y_m = columns(flown, "y_m", CONTROLLER.outputs)
    u = [loop.step(t, *row) for t, *row in zip(flown.time("u"), y, y_m, strict=True)]
    assert np.array_equal(u, flown["u"].values)
    assert loop.mode is Mode.ENGAGED
    assert loop.output is not None
    assert np.array_equal(loop.output.internals, flown["internals"].values[-1])


def test_lost_samples_start_failsafe() -> None:
    loop = rise_di.Loop(CONTROLLER)
    e = np.full(M, 0.01)
    for k in range(50):
        held = loop.step(k * loop.period, e, 0.0 * e)
    late = 0.5 + CONTROLLER.max_age + loop.period
    assert np.array_equal(loop.step(late, None, None), held)
    assert loop.mode.name == "HOLD"
    past = late + CONTROLLER.hold + CONTROLLER.ramp
    assert not loop.step(past, None, None).any()
    assert loop.mode.name == "TRIM"


@pytest.mark.parametrize(
    "t, y, sentence",
    [
        (
            1.0,
            [0.0, 0.0, np.nan, 0.0],
            "y: found [0.0, 0.0, nan, 0.0], expected 4 finite numbers: q, p, r, V",
        ),
        (0.0, np.zeros(4), "t: found 0 s, expected more than 0.5 s, the t of the last tick"),
    ],
)
def test_loop_refuses_wrong_sample(t: float, y: ArrayLike, sentence: str) -> None:
    loop = rise_di.Loop(CONTROLLER.model_dump())
    loop.step(0.5, np.zeros(M), np.zeros(M))
    with pytest.raises(rise_di.ParameterError) as refused:
        loop.step(t, y, np.zeros(M))
    assert str(refused.value) == sentence


def test_plant_of_own_flies_as_simulation(flown: Tape) -> None:
    aircraft = Simulator(SCENARIO.aircraft)
    numbers = iter(range(10_000))

    def plant(t: float, u: FloatArray, dt: float) -> FloatArray:
        held = select(aircraft.inputs, CONTROLLER.inputs, u)
        for _ in range(round(dt * SCENARIO.aircraft.rate) or 1):
            (sample,) = aircraft.sample(next(numbers), held)
        return select(CONTROLLER.outputs, aircraft.outputs, sample.value)

    tape = rise_di.fly_plant(plant, CONTROLLER, SCENARIO.reference_model, 3.0)
    assert np.array_equal(tape["u"].values, flown["u"].values)
    assert np.array_equal(tape["internals"].values, flown["internals"].values)
    assert rise_di.best_error(tape)[1].values.shape == (301, M)


PARTS: dict[str, Any] = {
    "flight": {"duration": 3.0},
    "aircraft": SCENARIO.aircraft,
    "reference_model": SCENARIO.reference_model.model_dump(),
    "controller": CONTROLLER,
}


def test_scenario_of_parts_flies_as_its_file(flown: Tape) -> None:
    assert np.array_equal(
        rise_di.simulate(rise_di.Scenario.from_parts("own", **PARTS))["u"].values, flown["u"].values
    )


@pytest.mark.parametrize(
    "parts, sentence",
    [
        (
            {},
            (
                "own: found no section flight, aircraft, reference_model, controller, expected the "
                "sections flight"
            ),
        ),
        (PARTS | {"controller": {"rate": 100.0}}, "controller."),
    ],
)
def test_wrong_parts_are_refused(parts: dict[str, Any], sentence: str) -> None:
    with pytest.raises(rise_di.ParameterError, match=f"^{sentence}"):
        rise_di.Scenario.from_parts("own", **parts)


# python-control


def test_python_control_flies_law_to_rounding(flown: Tape) -> None:
    law = rise_di.as_control(CONTROLLER)
    y = columns(flown, "y", CONTROLLER.outputs)
    y_m = columns(flown, "y_m", CONTROLLER.outputs)
    # from trim: the engagement of x = 0 has y = y_m = 0
    v = np.concatenate([y - y[0], y_m], axis=1).T
    loop = rise_di.Loop(CONTROLLER)
    u = np.array(
        [loop.step(t, *np.split(row, 2)) for t, row in zip(flown.time("u"), v.T, strict=True)]
    )
    response = control.input_output_response(law, np.arange(v.shape[1]) / CONTROLLER.rate, v)
    # stamps in ns against t = k T: dt of the law differs in the last bits
    np.testing.assert_allclose(response.outputs.T, u, atol=1e-9)


@pytest.mark.parametrize("name", ["osprey_servo", "osprey_observer", "osprey_twin"])
def test_linear_systems_have_the_eigenvalues_and_margins_of_the_loop(name: str) -> None:
    """python-control closes plant and law by itself, and the margins are those of the product."""
    scenario = rise_di.find_scenario(name)
    plant, law, loop = rise_di.linear_systems(scenario)
    m = len(plant.input_labels)
    closed = control.feedback(plant, law, sign=1)
    expected = np.sort_complex(closed.poles())
    assert np.sort(np.abs(loop.poles())) == approx(np.sort(np.abs(expected)), abs=1e-6)
    nominal = rise_di.margins(scenario).nominal
    frequencies = np.geomspace(0.01, 0.999 * np.pi / float(loop.dt), 4000)
    for i, channel in enumerate(plant.input_labels):
        response = loop[channel, f"d_{channel[2:]}"](np.exp(1j * frequencies * float(loop.dt)))
        # S of the loop opened at an input alone: u of the law, with the disturbance of u.
        assert np.abs(1.0 + response).max() == approx(nominal.sensitivity[i], rel=1e-2)
    assert loop.input_labels[:m] == [f"d_{label[2:]}" for label in plant.input_labels]
    assert law.input_labels == plant.output_labels


# gymnasium


@pytest.mark.filterwarnings("ignore:.*we recommend using a symmetric and normalized space")
def test_environment_passes_checks_of_gymnasium() -> None:
    named = gymnasium.make(FLIGHT, duration=1.0, uncertainty=0.3, render_mode="ansi")
    check_env(named.unwrapped)


@pytest.mark.parametrize(
    ("modules", "name"),
    [
        ("rise_di, gymnasium", FLIGHT),
        ("gymnasium", FLIGHT),
        ("gymnasium, rise_di", "rise_di/Flight-v0"),
    ],
)
def test_environment_is_found_by_name(modules: str, name: str) -> None:
    """The environment is found in any order of imports, if the module stands before the colon."""
    code = f"import {modules}; print(gymnasium.make({name!r}).spec.id)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.stdout.strip() == "rise_di/Flight-v0", done.stderr


def test_environment_has_a_name_bounds_facts_and_a_line_of_text() -> None:
    env = gymnasium.make(FLIGHT, scenario="osprey_gust", duration=0.05, render_mode="ansi")
    observed, info = env.reset(seed=1)
    space: Any = env.observation_space
    assert np.isfinite(space.low).all()
    assert space.low == approx(-space.high)
    assert info["error"] == approx(observed[:M] - observed[M:])
    ended = False
    while not ended:
        observed, _, _, ended, info = env.step(np.zeros(M))
        assert info["error"] == approx(observed[:M] - observed[M:])
        assert ("outcome" in info) == ended
    assert info["outcome"] == "completed"
    text = str(env.render())
    assert text.startswith("t 0.05 s  ")
    # y and y_m of each output, with the four decimals of the line
    numbers = [float(number) for number in re.findall("[+-][0-9.]+", text)]
    assert numbers == approx(np.column_stack(np.split(observed, 2)).ravel(), abs=1e-4)
    with pytest.raises(rise_di.ParameterError, match="render_mode: found human, expected ansi"):
        rise_di.FlightEnv(SCENARIO, render_mode="human")


def test_aircraft_beyond_its_bounds_terminates_with_an_observation_within_them() -> None:
    flights = gymnasium.make_vec(
        FLIGHT,
        num_envs=2,
        vectorization_mode="vector_entry_point",
        scenario="osprey_gust",
        duration=3.0,
    )
    flights.reset(seed=1)
    has_terminated = np.zeros(2, dtype=bool)
    for _ in range(20):
        observed, _, terminated, _, info = flights.step(np.array([[0.0] * M, [1e9] * M]))
        assert flights.observation_space.contains(observed)
        assert info["error"].shape == (2, M)
        has_terminated |= terminated
    assert has_terminated.tolist() == [False, True]


def test_example_trains_a_policy() -> None:
    """Each generation draws around the best of the last one, so the best mean return rises."""
    process = subprocess.run(
        [sys.executable, REPOSITORY / "examples/gymnasium/cross_entropy.py", "2"],
        capture_output=True,
        text=True,
        check=True,
    )
    lines = process.stdout.splitlines()
    scores = [[float(x) for x in re.findall(r"-[0-9.]+", line)] for line in lines[:2]]
    # The worst that the fleet may do is to leave u at 0.
    assert scores[1][0] > scores[0][0] > scores[0][1]


def test_environment_under_law_flies_as_simulation(flown: Tape) -> None:
    env = rise_di.FlightEnv(SCENARIO)
    loop = rise_di.Loop(CONTROLLER)
    observed, _ = env.reset()
    flight = []
    ended = False
    reward = 0.0
    while not ended:
        flight.append(observed)
        u = loop.step((len(flight) - 1) * loop.period, observed[:M], observed[M:])
        observed, step_reward, terminated, ended, _ = env.step(u)
        reward += step_reward
        assert not terminated
    y = columns(flown, "y", CONTROLLER.outputs)
    y_m = columns(flown, "y_m", CONTROLLER.outputs)
    assert np.array_equal([*flight, observed], np.concatenate([y, y_m], axis=1))
    units = np.array([{"p": 0.02, "V": 0.1}.get(name, 0.01) for name in CONTROLLER.outputs])
    assert reward == approx(-np.sum(np.abs(y - y_m)[1:] / units) / CONTROLLER.rate)


def test_diverged_aircraft_terminates_episode(monkeypatch: pytest.MonkeyPatch) -> None:
    env = rise_di.FlightEnv(SCENARIO)
    env.reset()
    u = np.zeros(M)
    assert not env.step(u)[2]

    def diverge(self: Simulator, number: int, u: FloatArray) -> None:
        raise FlightEnded("diverged at t = 0.02 s")

    monkeypatch.setattr(Simulator, "sample", diverge)
    _, reward, terminated, truncated, info = env.step(u)
    assert (terminated, truncated) == (True, False)
    assert info["outcome"] == "diverged at t = 0.02 s"
    # the score of a loss of track for the seconds from the last tick on
    assert reward == approx(-10.0 * (3.0 - 0.01))
    with pytest.raises(rise_di.ParameterError, match="expected reset"):
        env.step(u)


def test_environments_draw_entries_of_scenario() -> None:
    """An entry is at one of its limits.

    After the same thrust, V shows 10 % or 190 % of the effect.
    """
    own = SCENARIO.vary(
        aircraft={
            "uncertainty": {"entries": ["B[V,thrust]"], "parts": [0.9], "distribution": "corners"}
        }
    )
    calm = own.vary(aircraft={"sensors": {}})
    u = 0.1 * np.eye(M)[CONTROLLER.inputs.index("thrust")]
    place = CONTROLLER.outputs.index("V")
    flights = rise_di.FlightVectorEnv(calm, 8, uncertainty=0.0)
    alone = rise_di.FlightEnv(calm, uncertainty=0.0)
    flights.reset(seed=1)
    together = [flights.step(np.tile(u, (8, 1)))[0] for _ in range(50)][-1][:, place]
    one_by_one = []
    for seed in range(8):
        alone.reset(seed=seed)
        one_by_one.append([alone.step(u)[0][place] for _ in range(50)][-1])
    for V in (together, np.array(one_by_one)):
        assert len(np.unique(V.round(6))) == 2
        assert V.max() == approx(19.0 * V.min(), rel=0.1)


def test_vector_environment_flies_as_environments_one_by_one() -> None:
    """The fleet has linear steps, and the simulator integrates.

    They differ by as much as the figures of a campaign do.
    """
    flights = rise_di.FlightVectorEnv(SCENARIO, 3, uncertainty=0.0)
    alone = rise_di.FlightEnv(SCENARIO)
    observed, _ = flights.reset(seed=1)
    expected, _ = alone.reset(seed=1)
    assert flights.observation_space.contains(observed)
    generator = np.random.default_rng(0)
    for _ in range(100):
        # rad/s and m/s; y is of the order of 1e-2
        assert observed == approx(np.tile(expected, (3, 1)), abs=1e-6)
        u = 0.01 * generator.standard_normal(M)
        observed, rewards, terminated, truncated, _ = flights.step(np.tile(u, (3, 1)))
        expected, reward, *_ = alone.step(u)
        assert rewards == approx(np.full(3, reward), rel=1e-3, abs=1e-6)
        assert not terminated.any()
        assert not truncated.any()
    assert flights.t == approx(alone.t)


def test_vector_environment_starts_diverged_aircraft_and_ended_flight_again() -> None:
    # without end stops
    flights = rise_di.FlightVectorEnv(rise_di.find_scenario("osprey_gust", 3.0), 2)
    first, _ = flights.reset(seed=3)
    u = np.zeros((2, M))
    terminations = 0
    still = None
    # far beyond the limits of the law, so that the second aircraft leaves every bound within
    # some steps
    u[1] = 1e9
    for k in range(1, round(3.0 * CONTROLLER.rate) + 1):
        observed, rewards, terminated, truncated, _ = flights.step(u)
        if still is not None:
            assert np.all(np.abs(observed[1, :M]) < np.abs(still) / 2)  # trim, but for noise
            assert rewards[1] == 0.0
        still = observed[1, :M] if terminated[1] else None
        if terminated[1]:
            assert rewards[1] == approx(-10.0 * (3.0 - (k - 1) / CONTROLLER.rate))
        terminations += terminated.sum()
        assert not terminated[0]
    assert terminations > 1
    assert truncated[0]
    again, rewards, terminated, truncated, _ = flights.step(u)
    assert not np.any([terminated, truncated, rewards != 0.0])
    assert flights.t == 0.0
    assert again.shape == first.shape


@pytest.mark.parametrize("name, actions", [("osprey_learn", 4), ("osprey_twin", 7)])
def test_vector_environment_takes_a_learner_and_an_allocation(name: str, actions: int) -> None:
    """The agent replaces the learner, and commands the effectors of the allocation."""
    flights = rise_di.FlightVectorEnv(rise_di.find_scenario(name, 1.0), 2)
    assert flights.action_space.shape == (2, actions)


@pytest.mark.parametrize("actions, expected", [(np.full((2, M), np.nan), "finite")])
def test_vector_environment_refuses_actions(actions: FloatArray, expected: str) -> None:
    flights = rise_di.FlightVectorEnv(SCENARIO, 2)
    with pytest.raises(rise_di.ParameterError, match="reset"):
        flights.step(np.zeros((2, M)))
    flights.reset(seed=1)
    with pytest.raises(rise_di.ParameterError, match=expected):
        flights.step(actions)
