# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test the comparison of control laws.

The tests cover cost and score, repeatable tuning, delayed inputs, the shipped gains and the
command.
"""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
import yaml
from numpy.testing import assert_allclose
from pytest import approx
from tests.closed_loop import error
from tests.conftest import invoke, refusing
from tests.other_laws import SECTIONS

from aircraft_sim.atmosphere.turbulence import MODERATE
from control_laws.catalogue import LAWS, Gains, initial_gains
from flight_analysis.closed_loop.scenario import Scenario
from flight_analysis.closed_loop.scenario_library import find_scenario
from flight_analysis.closed_loop.simulate import simulate
from flight_analysis.linear_loop.loop_margins import margins
from flight_analysis.metrics.errors import error_metrics
from flight_campaign.batch import batch
from flight_campaign.comparison import law_comparison, registered_laws, tuned_controller, tuning
from flight_campaign.comparison.tuning import (
    GUST,
    OBJECTIVES,
    TURBULENCE,
    Benchmark,
    nominal_margins,
)
from flight_core.parameters import ParameterError
from flight_design.gains import tuned_gains
from flight_design.gains.gain_yaml import section_yaml
from flight_design.gains.requirement import REQUIREMENT, least_fraction
from flight_design.gains.tuned_gains import TuningResult
from rise_di_controller.law.control_law import Measurements
from rise_di_controller.laws import AnyLaw

pytestmark = pytest.mark.slow

SHIPPED = sorted(path.stem for path in tuned_gains.TUNED.glob("*.yaml"))


@pytest.fixture(scope="module")
def short() -> Benchmark:
    """Return a benchmark of 4 s of osprey_servo, whose vertical gust begins earlier."""
    return tuning.build_benchmark(first_seconds(find_scenario("osprey_servo")))


def first_seconds(scenario: Scenario) -> Scenario:
    """Return the first 4 s of a scenario, with a vertical gust."""
    gust = {"vertical": {"start": 2.0, "speed": 10.12, "length": 15.24}}
    return scenario.vary(flight={"duration": 4.0}, aircraft={"gusts": gust})


def tuning_result(gains: Gains, **changes: Any) -> TuningResult:
    """Return a tuning result with these gains."""
    return TuningResult(
        gains={name: value[:, 0].tolist() for name, value in gains.items()},
        cost=1.0,
        seed=1,
        costs=[1.0],
        evaluations=0,
    )._replace(**changes)


def initial_result(name: str, benchmark: Benchmark, **changes: Any) -> TuningResult:
    """Return a tuning result with the initial gains of a law."""
    return tuning_result(initial_gains(LAWS[name], benchmark.model), **changes)


def test_search_is_repeatable_and_lowers_cost_of_initial_gains(short: Benchmark) -> None:
    law = LAWS["pi"]
    begin = initial_gains(LAWS["pi"], short.model)
    objective = OBJECTIVES["gust_turbulence"]
    results = [tuning.tune(law, objective, short, (3, 4), generations=4) for _ in range(2)]
    assert results[0] == results[1]
    assert results[0].cost == min(results[0].costs)
    assert results[0].evaluations == 4 * tuning.POPULATION
    control_law = law.control_law(short.model)

    def cost(gains: Gains) -> float:
        params = law.params(gains, short.model)
        total = 0.0
        for part in tuning.evaluations(objective, short):
            course = short.courses[part.wind][law.feedforward]
            result = batch.fly(part.fleet, short.vehicle, course, control_law, params)
            total += float(tuning.cost(result, short) @ part.weight)
        return total

    after = cost(tuning.as_gains(results[0]))
    assert after == approx(results[0].cost, rel=1e-3)  # gains are written with five digits
    assert after < 0.95 * cost(begin)


@pytest.mark.parametrize("wind", [GUST, TURBULENCE])
def test_score_of_campaign_is_that_of_single_process_simulation(
    wind: str, short: Benchmark
) -> None:
    controller = short.scenario.controller
    gains = {key: np.array([getattr(controller, key)]).T for key in ("Lambda", "beta")}
    gains |= {
        "K": np.array([controller.law_params().K]).T,
        "softening": np.atleast_2d(short.scenario.rise_di().softening).T,
    }
    (result,) = law_comparison.compare(short, {"rise": {"gust": tuning_result(gains)}}, 1, [0.3], 1)
    turbulence = MODERATE | {"seed": tuning.TUNING_TURBULENCE_SEED}
    parts = (
        short.scenario
        if wind == GUST
        else short.scenario.vary(aircraft={"gusts": {}, "turbulence": turbulence})
    )
    true = error(simulate(parts))
    rms = np.array([error_metrics(true[name]).rms for name in controller.outputs])
    # The campaign holds the nonlinear remainder over a tick, the simulation does not: far below the
    # 1 % that a score needs.
    assert result.scores[wind] == approx(float(np.sum(rms / short.unit)), rel=2e-3)
    if wind == GUST:
        assert_allclose(result.rms, rms, rtol=2e-3)


def test_scenario_with_turbulence_is_compared_in_its_own(short: Benchmark) -> None:
    own = short.scenario.vary(
        flight={"duration": 0.1},
        aircraft={"turbulence": {"altitude": 3000.0, "sigma": 1.5, "seed": 9}},
    )
    aircraft = tuning.build_benchmark(own, 3).scenarios[TURBULENCE].aircraft
    assert aircraft.turbulence is not None
    assert (aircraft.turbulence.altitude, aircraft.turbulence.sigma, aircraft.turbulence.seed) == (
        3000.0,
        1.5,
        3,
    )
    assert aircraft.gusts == {}


def test_share_of_lost_aircraft_is_that_of_first_level_by_delay_of_u(short: Benchmark) -> None:
    # K of 40 1/s and the 35 ms of the loop of q are 1.4 rad at the crossover: stable below pi/2;
    # with 60 ms more it is unstable
    fast = tuning_result({"K": np.full((4, 1), 40.0), "Lambda": np.ones((4, 1))})
    (result,) = law_comparison.compare(
        short, {"pi": {"gust": fast}}, 3, [0.3, 0.5], 1, delays=(0, 6)
    )
    assert result.lost_late == {0.0: 0.0, 0.06: 1.0}
    assert result.levels[0].scores[GUST].lost == 0.0


def test_tuned_gains_written_to_new_folder_or_refused_in_sentence(tmp_path: Path) -> None:
    path = tmp_path / "one" / "two" / "gains.yaml"
    result = TuningResult(gains={"K": [1.0]}, cost=2.0, seed=1, costs=[2.0, 3.0], evaluations=100)
    tuned_gains.save(path, {"pi": {"gust": result}}, ["gust"], "a command")
    assert tuned_gains.load(path) == {"pi": {"gust": result}}
    with refusing(r"cannot be written \(.*\), expected a writable file of tuned gains$"):
        tuned_gains.save(path / "gains.yaml", {"pi": {"gust": result}}, ["gust"], "a command")


@pytest.mark.parametrize("name", SHIPPED)
def test_shipped_gains_are_those_of_the_catalogue(name: str) -> None:
    benchmark = tuning.build_benchmark(find_scenario(name).vary(flight={"duration": 0.1}))
    for law, by_aim in tuned_gains.load(tuned_gains.TUNED / f"{name}.yaml").items():
        for result in by_aim.values():
            assert result.cost == min(result.costs) < tuning.MAX_COST
            assert len(result.costs) >= 3  # seeds, so that the spread of the search is known
            expected = {
                key: len(gain) for key, gain in initial_gains(LAWS[law], benchmark.model).items()
            }
            assert {key: len(values) for key, values in result.gains.items()} == expected
            assert all(value > 0.0 for values in result.gains.values() for value in values)


@pytest.mark.parametrize(
    "arguments, words",
    [
        (["--laws", "rise,magic"], "'magic'"),
        (["--uncertainty", "0.3,1"], "0 and below 1"),
        (["--gains", "nowhere.yaml", "--laws", "pi"], "--tune"),
    ],
)
def test_bad_input_is_one_sentence(arguments: list[str], words: str) -> None:
    result = invoke("compare", "osprey_servo", *arguments)
    assert isinstance(result.exception, ParameterError)
    assert words in str(result.exception)


@pytest.fixture(scope="module")
def gains_file(short: Benchmark, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a file with gains of three laws."""
    path = tmp_path_factory.mktemp("gains") / "gains.yaml"
    tuned = {
        name: {"gust": initial_result(name, short, cost=7.25, costs=[7.375, 7.25])}
        for name in ("rise", "l1", "indi")
    }
    tuned_gains.save(path, tuned, list(OBJECTIVES), "a test")
    return path


@pytest.fixture(scope="module")
def brief_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a scenario file with the first 4 s of osprey_servo."""
    path = tmp_path_factory.mktemp("brief") / "brief.yaml"
    text = find_scenario("osprey_servo").path.read_text()
    path.write_text(text.replace("duration: 60.0 ", "duration: 4.0 "))
    return path


def test_the_command_writes_what_it_shows(
    gains_file: Path, brief_file: Path, tmp_path: Path
) -> None:
    path = tmp_path / "compared.json"
    options = "--laws rise,l1 --aircraft 2 --uncertainty 0.3 --tuning gust --wind published"
    arguments = [*options.split(), "--gains", str(gains_file)]
    result = invoke("compare", brief_file, *arguments, "--json", path)
    assert result.exit_code == 0, result.output
    results = json.loads(path.read_text())
    assert results["wind"] == "published"
    assert "effect of wind on x_dot from the airframe file" in result.stdout
    assert [row["law"] for row in results["laws"]] == ["rise", "l1"]
    assert [row["knows"] for row in results["laws"]] == [
        LAWS[name].model_data for name in ("rise", "l1")
    ]
    for row in results["laws"]:
        (level,) = row["levels"]
        for wind in (GUST, TURBULENCE):
            assert f"{row['score'][wind]:.2f}" in result.stdout
            assert f"{level[wind]['mean']:.2f} ({level[wind]['worst']:.2f})" in result.stdout
        late = [level[GUST]["lost"], *(delayed["lost"] for delayed in row["late"])]
        assert "/".join(f"{100.0 * share:.3g}" for share in late) in result.stdout
        assert [delayed["delay"] for delayed in row["late"]] == approx(
            [0.01, 0.02, 0.03, 0.04, 0.06]
        )
        assert (row["cost"], row["spread"]) == (7.25, 0.125)
        assert "7.25 +0.12" in result.stdout
        assert set(row["slew"]) == {"elevator", "thrust", "aileron", "rudder"}


def test_registered_law_flies_as_that_of_catalogue(short: Benchmark) -> None:
    # RISE-DI as a registered law, with the gains of the catalogue's: K = 1 + k_g + k_d is rounded
    # once more
    gains = initial_gains(LAWS["rise"], short.model)
    K, Lambda, beta, softening = (gain[:, 0].tolist() for gain in gains.values())
    own = {
        "Lambda": Lambda,
        "beta": beta,
        "softening": softening[0],
        "k_g": K[-1] - 1.0,
        "k_d": [k - K[-1] for k in K[:-1]],
    }
    scale = short.model.input_scale.tolist()
    scenario = short.scenario.vary(controller={**own, "input_scale": scale, "sign": "soft"})
    controllers = registered_laws.find_laws(["rise", "rise_di"], scenario, {})
    laws = registered_laws.entries(controllers)
    tuned = {
        "rise": {"gust": tuning_result(gains)},
        "rise_di": {"gust": registered_laws.as_tuned(scenario.controller)},
    }
    catalogue, registered = law_comparison.compare(short, tuned, 2, [0.3], 1, delays=(), laws=laws)
    assert registered.costs == []
    assert registered.scores == approx(catalogue.scores, rel=1e-6)
    assert registered.levels[0].scores[GUST] == approx(catalogue.levels[0].scores[GUST], rel=1e-6)


class ComparingError(Exception):
    """Raised when all laws are tuned and their comparison begins."""


def test_interrupted_tuning_resumes_with_missing_laws(
    short: Benchmark, brief_file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "gains.yaml"
    tuned = list[str]()
    names = {law.title: name for name, law in LAWS.items()}

    def tune(law: Any, objective: Any, benchmark: Any, seeds: Any, progress: Any) -> TuningResult:
        tuned.append(names[law.title])
        if tuned == ["rise", "pi"]:
            raise KeyboardInterrupt
        return initial_result(names[law.title], short)

    monkeypatch.setattr(tuning, "tune", tune)
    monkeypatch.setattr(law_comparison, "compare", Mock(side_effect=ComparingError))
    options = "--laws rise,pi,l1 --aircraft 1 --tune --gains"
    arguments = ["compare", str(brief_file), *options.split(), str(path)]
    invoke(*arguments)
    assert list(tuned_gains.load(path)) == ["rise"]
    result = invoke(*arguments)
    assert isinstance(result.exception, ComparingError), result.output
    assert list(tuned_gains.load(path)) == ["rise", "pi", "l1"]
    assert tuned == ["rise", "pi", "pi", "l1"]


def test_margins_of_tuned_gains_are_those_of_the_registered_law(short: Benchmark) -> None:
    # The catalogue's laws for many sets of gains at once, the registered laws one controller at a
    # time
    lag = short.model.lag.tolist()
    D = [int(sign) for sign in short.model.D]
    scale = short.model.input_scale.tolist()
    Omega = short.model.Omega.ravel().tolist()
    for name, own in (("pi", {"input_scale": scale}), ("l1", {"Omega": Omega})):
        gains = initial_gains(LAWS[name], short.model)
        values = {key: gain[:, 0].tolist() for key, gain in gains.items()}
        section = SECTIONS[name] | {"lag": lag, "D": D, "delay": 0.0} | values | own
        expected = margins(
            replace(short.scenario, controller=AnyLaw.validate_mapping(section, "controller"))
        ).nominal
        wide = {key: np.concatenate([0.9 * gain, gain], axis=1) for key, gain in gains.items()}
        result = nominal_margins(LAWS[name], wide, short.model)
        assert result.phase.shape == (2, 4)
        for key in ("phase", "sensitivity", "damping"):
            assert_allclose(getattr(result, key)[1], getattr(expected, key), rtol=1e-6)


def test_search_within_margins_has_them(short: Benchmark) -> None:
    law = LAWS["pi"]._replace(
        initial={
            "K": np.array([[22.0], [18.0], [13.0], [3.0]]),
            "Lambda": np.array([[6.0, 11.0, 5.0, 2.0]]).T,
        }
    )

    def least(gains: Gains) -> float:
        results = nominal_margins(law, gains, short.model)
        return least_fraction(results.at(0), REQUIREMENT)

    assert least(initial_gains(law, short.model)) < 0.98  # 43 degrees for 45
    result = tuning.tune(law, OBJECTIVES["margins"], short, (3, 4), generations=8)
    assert least(tuning.as_gains(result)) >= 1.0 - 1e-3  # gains are written with five digits


@pytest.mark.parametrize("name", tuned_controller.REGISTERED)
def test_written_controller_is_the_law_that_was_tuned(name: str, short: Benchmark) -> None:
    result = tuned_gains.load(tuned_gains.TUNED / "osprey_servo.yaml")[name]["gust_turbulence"]
    controller = tuned_controller.tuned_controller(name, result, short)
    text = section_yaml(controller, short.scenario.aircraft.load()[0], None, "by a test", {})
    contents = AnyLaw.validate_mapping(
        yaml.safe_load(text)["/**/controller"]["ros__parameters"], "controller"
    )
    assert (contents.feedforward is None) == (LAWS[name].feedforward == "none")
    law, params = contents.tuned_law()
    of_catalogue = LAWS[name].control_law(short.model)
    sets = LAWS[name].params(tuning.as_gains(result), short.model)
    generator = np.random.default_rng(1)
    dt = np.float64(short.model.period)
    y = np.cumsum(0.002 * generator.standard_normal((60, 4)), axis=0)
    zero = np.zeros(4)
    none = np.zeros((4, 1))
    state = law.engage(
        Measurements(y=y[0], y_m=zero, y_m_dot=zero, u_trim=zero, u_before=zero), params
    )
    wide = of_catalogue.engage(
        Measurements(y=y[0][:, None], y_m=none, y_m_dot=none, u_trim=none, u_before=none), sets
    )
    u = zero
    results = none
    for sample in y[1:]:
        state, u = law.step(
            state,
            Measurements(y=sample, y_m=zero, y_m_dot=zero, u_trim=zero, u_before=u),
            dt,
            params,
        )
        wide, results = of_catalogue.step(
            wide,
            Measurements(y=sample[:, None], y_m=none, y_m_dot=none, u_trim=none, u_before=results),
            dt,
            sets,
        )
    assert_allclose(u, results[:, 0], rtol=2e-4, atol=1e-7)  # a file has six digits
