# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Comparison of control laws: cost and score, repeatable tuning, the shipped gains, the command."""

import json
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import yaml
from tests.closed_loop import error
from typer.testing import CliRunner

from control_laws.catalogue import LAWS, initial_gains
from flight_analysis.closed_loop.simulate import simulate
from flight_analysis.metrics import error_metrics
from flight_bringup.scenarios import find_scenario
from flight_campaign import fleet, law_comparison, tuning
from flight_campaign.fleet import FleetResult
from flight_campaign.tuning import Benchmark, TuningResult
from flight_cli.cli import COMMANDS, application
from flight_core.parameters import ParameterError

app = application([*COMMANDS])
SHIPPED = ("osprey_servo", "osprey_gust")


@pytest.fixture(scope="module")
def short() -> Benchmark:
    """The first 4 s of osprey_servo, with its vertical gust brought forward into them."""
    gust = {"vertical": {"start": 2.0, "speed": 10.12, "length": 15.24}}
    return tuning.build_benchmark(find_scenario("osprey_servo").vary(flight={"duration": 4.0}, aircraft={"gusts": gust}))


def test_a_score_counts_each_channel_in_its_unit_and_a_cost_adds_activity(short: Benchmark) -> None:
    # q, p, r, V: 10 mrad/s, 20 mrad/s, 10 mrad/s and 0.1 m/s are one each; 60 deg/s or 600 %/s of an input too
    rms = np.array([[0.01], [0.02], [0.01], [0.1]])
    slew = np.array([[np.deg2rad(60.0)], [0.0], [np.deg2rad(30.0)], [6.0]])
    result = FleetResult(rms, rms, slew, np.array([False]))
    assert tuning.score(result, short.unit) == pytest.approx([4.0])
    assert tuning.cost(result, short) == pytest.approx([6.5])
    diverged = result._replace(diverged=np.array([True]))
    assert tuning.score(diverged, short.unit) == [np.inf]
    assert tuning.cost(diverged, short) == [tuning.MAX_COST]
    assert tuning.cost(result._replace(rms=np.nan * rms), short) == [tuning.MAX_COST]


@pytest.mark.parametrize(("objective", "flights"), [("nominal", 3), ("uncertain", 15), ("late", 21)])
def test_an_evaluation_gives_equal_weights_to_aircraft_and_to_calm_air_gusts_and_delay(
    objective: str, flights: int, short: Benchmark
) -> None:
    evaluation = tuning.evaluation(objective, short)
    wind, late = np.asarray(evaluation.fleet.wind), np.asarray(evaluation.fleet.late)
    assert len(wind) == flights
    assert evaluation.weight.sum() == pytest.approx(3.0)
    for part in (wind == 0.0, (wind == 1.0) & (late == 0), late == tuning.EXTRA_DELAY_TICKS):
        assert evaluation.weight[part].sum() == pytest.approx(1.0)


def test_a_search_is_repeatable_and_lowers_the_cost_of_its_initial_gains(short: Benchmark) -> None:
    law, begin = LAWS["pi"], initial_gains(LAWS["pi"], short.model)
    found = [tuning.tune(law, tuning.NOMINAL, short, (3, 4), generations=6) for _ in range(2)]
    assert found[0] == found[1]
    assert found[0].cost == min(found[0].costs)
    assert found[0].evaluations == 6 * tuning.POPULATION
    flights, weight = tuning.evaluation(tuning.NOMINAL, short)
    fly = partial(fleet.fly, flights, short.vehicle, short.courses[False], law.control_law(short.model))
    params = (law.params(one, short.model) for one in (begin, tuning.as_gains(found[0])))
    costs = [float(tuning.cost(fly(one), short) @ weight) for one in params]
    assert costs[1] == pytest.approx(found[0].cost, rel=1e-3)  # gains are written with five digits
    assert costs[1] < 0.95 * costs[0]


def test_the_score_of_a_campaign_is_that_of_the_single_process_simulation(short: Benchmark) -> None:
    controller = short.scenario.controller
    gains = {key: list(getattr(controller, key)) for key in ("Lambda", "beta")}
    gains |= {"K": controller.law_params().K.tolist(), "softening": [short.scenario.rise_di().softening]}
    (found,) = law_comparison.compare(short, {"rise": {"nominal": TuningResult(gains, 0.0, 0, [], 0)}}, 1, [0.3], 1)
    true = error(simulate(short.scenario))
    rms = np.array([error_metrics(true[name]).rms for name in controller.outputs])
    # the campaign holds the nonlinear remainder over a tick, the simulation does not: far below the 1 % that a score needs
    np.testing.assert_allclose(found.rms, rms, rtol=2e-3)
    assert found.score == pytest.approx(float(np.sum(rms / short.unit)), rel=2e-3)


def test_more_aircraft_do_not_change_the_results_of_the_first_ones(short: Benchmark) -> None:
    gains = tuning.load(tuning.TUNED / "osprey_servo.yaml")
    one = {"pi": {"nominal": gains["pi"]["nominal"]}}
    few, more = (next(iter(law_comparison.compare(short, one, count, [0.3, 0.5], 7))) for count in (2, 3))
    assert few.score == more.score
    for level, wider in zip(few.levels, more.levels, strict=True):
        assert level.worst <= wider.worst
        assert level.diverged == wider.diverged == 0.0


@pytest.mark.parametrize("name", SHIPPED)
def test_every_law_ships_with_gains_for_the_nominal_and_the_uncertain_objective(name: str) -> None:
    shipped = tuning.load(tuning.TUNED / f"{name}.yaml")
    assert set(shipped) == set(LAWS)
    benchmark = tuning.build_benchmark(find_scenario(name).vary(flight={"duration": 0.1}))
    for law, by_aim in shipped.items():
        assert {"nominal", "uncertain"} <= set(by_aim), law
        for found in by_aim.values():
            assert found.cost == min(found.costs) < tuning.MAX_COST
            expected = {key: len(gain) for key, gain in initial_gains(LAWS[law], benchmark.model).items()}
            assert {key: len(values) for key, values in found.gains.items()} == expected
            assert all(value > 0.0 for values in found.gains.values() for value in values)


def test_gains_read_back_as_they_were_written(tmp_path: Path) -> None:
    pi = TuningResult({"K": [9.0, 0.1 + 0.2], "Lambda": [2e-07, 1e22]}, 4.5, 2, [4.75, 4.5], 32)
    tuned = {"pi": {"nominal": pi, "late": pi._replace(cost=1 / 3)}, "l1": {"nominal": pi}}
    path = tmp_path / "made" / "gains.yaml"
    tuning.save(path, tuned, "a command")
    assert tuning.load(path) == tuned
    assert "# Made by: a command" in path.read_text(encoding="utf-8")
    assert repr(tuning.load(path)) == repr(tuned)  # to the last bit
    assert tuning.load(tmp_path / "none.yaml") == {}
    path.write_text("laws: {pi: {nominal: {gains: {}}}}", encoding="utf-8")
    with pytest.raises(ParameterError, match=r"gains\.yaml"):
        tuning.load(path)


@pytest.mark.parametrize("name", SHIPPED)
def test_shipped_gains_are_in_the_form_that_save_writes(name: str, tmp_path: Path) -> None:
    text = (tuning.TUNED / f"{name}.yaml").read_text(encoding="utf-8")
    (command,) = [line.removeprefix("# Made by: ") for line in text.splitlines() if line.startswith("# Made by: ")]
    tuned = tuning.load(tuning.TUNED / f"{name}.yaml")
    tuning.save(tmp_path / "again.yaml", tuned, command)
    assert (tmp_path / "again.yaml").read_text(encoding="utf-8") == text
    assert max(len(line) for line in text.splitlines()) <= 200
    assert len(text.splitlines()) <= 6 + sum(1 + 2 * len(sets) for sets in tuned.values())  # a gain set in one or two lines
    assert list(yaml.safe_load(text)["laws"]["rise"]) == [key for key in tuning.OBJECTIVES if key in tuned["rise"]]


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--laws", "rise,magic"], "'magic'"),
        (["--uncertainty", "0.3,1"], "0 and below 1"),
        (["--uncertainty", "much"], "'much'"),
        (["--tuning", "best"], "nominal, uncertain, late"),
        (["--gains", "nowhere.yaml", "--laws", "pi"], "--tune"),
    ],
)
def test_bad_input_is_one_sentence(arguments: list[str], words: str) -> None:
    result = CliRunner().invoke(app, ["compare", "osprey_servo", *arguments])
    assert isinstance(result.exception, ParameterError)
    assert words in str(result.exception)


def test_the_command_writes_what_it_shows(tmp_path: Path) -> None:
    path = tmp_path / "compared.json"
    arguments = ["--laws", "rise,l1", "--aircraft", "2", "--uncertainty", "0.3", "--tuning", "nominal", "--json", str(path)]
    result = CliRunner().invoke(app, ["compare", "osprey_servo", *arguments])
    assert result.exit_code == 0, result.output
    found = json.loads(path.read_text(encoding="utf-8"))
    assert [row["law"] for row in found["laws"]] == ["rise", "l1"]
    for row in found["laws"]:
        assert f"{row['score']:.2f}" in result.stdout
        (level,) = row["levels"]
        assert f"{level['mean']:.2f} ({level['worst']:.2f})" in result.stdout
        assert set(row["slew"]) == {"elevator", "thrust", "aileron", "rudder"}
