# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test the Python interface `rise_di`.

The tests cover its names, lazy imports, types, flights, logs, and the sentences about wrong input.
"""

import re
from collections.abc import Callable
from typing import Any, assert_type

import numpy as np
import polars as pl
import pytest
from tests.conftest import REPOSITORY
from tests.pure.test_import_rule import modules_loaded_by

import rise_di

pytestmark = pytest.mark.slow

SCENARIO = rise_di.find_scenario("osprey_gust", duration=2.0)
SOFT = SCENARIO.vary(controller={"beta": np.array([2.0, 2.0, 1.0, 1.0])})


@pytest.fixture(scope="module")
def tape() -> rise_di.Tape:
    return rise_di.simulate(SOFT)


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> rise_di.FlightResult:
    """Return a run of a scenario that differs from its file."""
    return rise_di.fly(SOFT, runs=tmp_path_factory.mktemp("runs"))


@pytest.fixture(scope="module")
def run(flown: rise_di.FlightResult) -> rise_di.RecordedRun:
    return rise_di.read_run(flown.mcap.parent)


# Names


def test_every_name_loads() -> None:
    assert all(getattr(rise_di, name) is not None for name in rise_di.__all__)


def test_the_import_loads_no_library() -> None:
    of_python = modules_loaded_by("import ast, importlib, pathlib")
    assert modules_loaded_by("import rise_di") - of_python == {"rise_di"}


def test_the_interface_needs_no_ros() -> None:
    """All names of `rise_di` can be loaded without a module of ROS."""
    ros = {"rclpy", "flight_ros", "ament_index_python", "launch", "sensor_msgs"}
    assert (
        not modules_loaded_by("import rise_di\nfor name in dir(rise_di): getattr(rise_di, name)")
        & ros
    )


def test_an_unknown_name_is_an_attribute_error() -> None:
    with pytest.raises(AttributeError, match="module 'rise_di' has no attribute 'simulat'"):
        rise_di.simulat  # type: ignore[attr-defined]  # noqa: B018


def test_the_page_of_the_interface_has_every_name() -> None:
    page = (REPOSITORY / "docs" / "reference" / "python.md").read_text()
    assert sorted(re.findall(r"^::: rise_di\.(\w+)$", page, re.MULTILINE)) == rise_di.__all__


# A flight


def test_a_flight_has_types(tape: rise_di.Tape) -> None:
    assert_type(SCENARIO, rise_di.Scenario)
    assert_type(rise_di.data_frame(tape), pl.DataFrame)
    assert_type(rise_di.best_error(tape), tuple[str, rise_di.Signal])
    assert_type(rise_di.laws(), tuple[str, ...])
    assert tape["y"]["q"].shape == tape.time("y").shape == (1001,)  # 2 s at 500 Hz


def test_a_data_frame_has_the_samples_of_the_tape(tape: rise_di.Tape) -> None:
    frame = rise_di.data_frame(tape)
    assert frame["y.q"].drop_nulls().to_list() == tape["y"]["q"].tolist()
    assert frame["u.elevator"].drop_nulls().to_list() == tape["u"]["elevator"].tolist()


# A log


def test_a_log_has_the_samples_of_the_flight(run: rise_di.RecordedRun, tape: rise_di.Tape) -> None:
    assert run.tape.outcome == tape.outcome
    for topic in ("y", "y_m", "u", "internals"):
        assert (
            np.ascontiguousarray(run.tape[topic].values).tobytes() == tape[topic].values.tobytes()
        )


def test_other_gains_on_the_recorded_inputs_are_an_open_loop(run: rise_di.RecordedRun) -> None:
    slower = SOFT.vary(
        controller={"Lambda": SOFT.rise_di().Lambda[0] * np.ones(4, dtype=np.float32)}
    )
    again = rise_di.replay(run, others=slower.controller)
    assert not again.is_equal()
    assert again.notes[0].startswith("open loop")


# Laws, gains, campaigns


def test_numpy_is_accepted_wherever_numbers_are() -> None:
    """Arrays of any real type and shape give the same results as lists of Python numbers."""
    gains = {"beta": [2.0, 2.0, 1.0, 1.0], "D": [1, -1, 1, 1], "k_g": 3.0}
    arrays = {
        "beta": np.array(gains["beta"], dtype=np.float32),
        "D": np.array(gains["D"]),
        "k_g": np.float64(3.0),
    }
    varied = SCENARIO.vary(
        controller=arrays, flight={"duration": np.int64(3), "lockstep": np.True_}
    )
    assert varied == SCENARIO.vary(controller=gains, flight={"duration": 3.0, "lockstep": True})
    assert {type(value) for value in varied.rise_di().beta} == {float}
    assert rise_di.find_scenario("osprey_gust", duration=np.float64(2.0)) == SCENARIO
    assert (
        rise_di.decompose(np.eye(2)).D.tolist()
        == rise_di.decompose([[1.0, 0.0], [0.0, 1.0]]).D.tolist()
    )


# Wrong input


A_RUN = "expected the folder of a run or an MCAP file"
api: Any = rise_di
scenario: Any = SCENARIO
SENTENCES: dict[str, tuple[Callable[..., Any], str]] = {
    "unknown scenario": (
        lambda: api.find_scenario("osprey_gast"),
        "scenario: found 'osprey_gast', expected osprey_gust perhaps, or another of ",
    ),
    "no scenario": (lambda: api.find_scenario(None), "scenario: found None, expected one of "),
    "text as duration": (
        lambda: api.find_scenario("osprey_gust", "5"),
        "flight.duration: found '5', expected a number",
    ),
    "unknown section": (
        lambda: scenario.vary(controler={"rate": 1.0}),
        (
            "controler: found no such section, expected controller perhaps, or another of flight, "
            "aircraft, "
        ),
    ),
    "parameter as section": (
        lambda: scenario.vary(beta=[1.0]),
        "beta: found no such section, expected it in a section: vary(controller={'beta': ...})",
    ),
    "number as section": (
        lambda: scenario.vary(controller=3),
        "controller: found 3, expected a mapping of its parameters",
    ),
    "wrong set": (
        lambda: scenario.vary(controller=scenario.flight),
        "controller: found FlightConfig(",
    ),
    "matrix as list": (
        lambda: scenario.vary(controller={"beta": np.eye(4)}),
        "controller.beta[0]: found [1.0, 0.0, 0.0, 0.0], expected a number (and 3 more)",
    ),
    "name as scenario": (
        lambda: api.simulate("osprey_gust"),
        "scenario: found 'osprey_gust', expected a Scenario, ",
    ),
    "duration as progress": (
        lambda: api.simulate(scenario, 20),
        "progress: found 20, expected a function of the flight time",
    ),
    "folder as number": (
        lambda: api.fly(scenario, runs=3),
        "runs: found 3, expected the path of a folder",
    ),
    "missing run": (
        lambda: api.read_run("runs/latst"),
        f"runs/latst: found no such file or folder, {A_RUN}",
    ),
    "no run": (lambda: api.read_run(None), f"run: found None, {A_RUN}"),
    "empty path": (lambda: api.read_run(""), f"run: found '', {A_RUN}"),
    "NUL in a path": (
        lambda: api.read_run("a\0b"),
        f"a\\x00b: found no such file or folder, {A_RUN}",
    ),
    "run of a tape": (lambda run: api.recorded_scenario(run.tape), "run: found Tape("),
    "tape without parameters": (
        lambda run: api.replay(run.tape),
        "parameters: found None, expected the parameters of ",
    ),
    "scenario as parameters": (
        lambda run: api.replay(run, scenario),
        "parameters: found Scenario(",
    ),
    "mapping as parameters": (
        lambda run: api.replay(run, others={"beta": 1}),
        "others: found {'beta': 1}, expected the ",
    ),
    "number as changes": (
        lambda run: api.replay(run, changes=3),
        "changes: found 3, expected a list of changes, ",
    ),
    "run as tape": (lambda run: api.data_frame(tape=run), "tape: found RecordedRun("),
    "path as tape": (
        lambda: api.best_error("runs/latest"),
        "tape: found 'runs/latest', expected a Tape, ",
    ),
    "no samples": (lambda: api.data_frame(api.Tape({})), "tape: found no topic, expected a flight"),
    "tape of a log": (
        lambda run: api.summarise(run.tape),
        (
            "scenario: found no scenario for the tape of a log, expected one as the second "
            "argument, such as recorded_scenario(run)"
        ),
    ),
    "signal as samples": (lambda tape: api.error_metrics(tape["y"]), "errors: found Signal("),
    "channel as topic": (lambda tape: tape["q"], "the log: found no topic q among y, y_m, "),
    "list as topic": (lambda tape: tape[["y"]], "the log: found no topic ['y'] among y, y_m, "),
    "unknown channel": (
        lambda tape: tape["y"]["Q"],
        "the log: found no channel Q among q, V, p, r, expected one",
    ),
    "report of nothing": (api.report, f"runs: found none, {A_RUN}"),
    "list of runs": (lambda: api.report(["a"]), f"run: found ['a'], {A_RUN}"),
    "number as file": (lambda: api.report("a", csv=3), "csv: found 3, expected the path of a file"),
    "text as rate": (
        lambda: api.select_gains("osprey", rate="fast"),
        "rate: found 'fast', expected 1 to 1000 Hz",
    ),
    "text as lags": (
        lambda: api.select_gains("osprey", lag="0.1"),
        "lag: found '0.1', expected seconds, 0 or more",
    ),
    "too few lags": (
        lambda: api.select_gains("osprey", lag=[0.1, 0.2]),
        (
            "lag: found 2 values, expected one for all or one for each of elevator, thrust, "
            "aileron, rudder"
        ),
    ),
    "number as inputs": (
        lambda: api.select_gains("osprey", inputs=3),
        "inputs: found 3, expected the inputs elevator, ",
    ),
    "percent as part": (
        lambda: api.select_gains("osprey", uncertainty=30),
        "uncertainty: found 30, expected 0 to 1",
    ),
    "half a sample": (
        lambda: api.select_gains("osprey", samples=2.5),
        "samples: found 2.5, expected an integer from 0 ",
    ),
    "scenario as airframe": (lambda: api.select_gains(scenario), "airframe: found Scenario("),
    "name as loop": (
        lambda: api.margins("osprey_servo"),
        "scenario: found 'osprey_servo', expected a Scenario, ",
    ),
    "part of an aircraft": (
        lambda: api.margins(scenario, 0.5),
        "aircraft: found 0.5, expected an integer of 0 or more",
    ),
    "number as selection": (
        lambda: api.gains_yaml(3),
        "selection: found 3, expected a Selection, ",
    ),
    "no aircraft": (
        lambda: api.fly_campaign(scenario, 0),
        "campaign.aircraft: found 0, expected greater than ",
    ),
    "unknown wind": (
        lambda: api.fly_campaign(scenario, 2, wind="x"),
        "campaign.wind: found 'x', expected 'air_relative' or ",
    ),
    "text as sweep": (
        lambda: api.fly_campaign(scenario, 2, sweep="beta=1"),
        "sweep: found 'beta=1', expected one ",
    ),
    "unknown sweep": (
        lambda: api.fly_campaign(scenario, 2, sweep={"a": [1.0]}),
        "sweep: found a, expected a parameter of ",
    ),
    "number as factors": (
        lambda: api.fly_campaign(scenario, 2, sweep={"beta": 1}),
        "sweep.factors: found 1, expected a ",
    ),
    "a text as a unit": (
        lambda: api.fly_campaign(scenario, 2, score={"q": "x"}),
        "score.q: found 'x', expected ",
    ),
    "entries as a list": (
        lambda: api.fly_campaign(scenario, 2, entries=["A[q,q]"]),
        "entries: found ['A[q,q]'], expected numbers by name",
    ),
    "no threads": (
        lambda: api.fly_campaign(scenario, 2, workers=0),
        "workers: found 0, expected an integer of ",
    ),
    "missing campaign": (lambda: api.resume_campaign("nope"), "nope: found no campaign "),
    "text as matrix": (
        lambda: api.decompose("x"),
        "Omega: found 'x', expected a matrix of numbers, (m, m)",
    ),
    "ragged matrix": (
        lambda: api.decompose([[1, 2], [3]]),
        "Omega: found [[1, 2], [3]], expected a matrix ",
    ),
    "list as array": (
        lambda: api.engage([1.0], [1.0]),
        "found [1.0], expected an array of NumPy or of JAX",
    ),
    "scenario as controller": (lambda: api.Controller(scenario), "parameters: found Scenario("),
    "name as a file": (
        lambda: api.scenario_yaml("osprey_gust"),
        "scenario: found 'osprey_gust', expected a Scenario",
    ),
}


@pytest.mark.parametrize("call", SENTENCES)
def test_wrong_input_is_one_sentence(call: str, request: pytest.FixtureRequest) -> None:
    wrong, sentence = SENTENCES[call]
    names = (
        wrong.__code__.co_varnames[: wrong.__code__.co_argcount]
        if wrong.__name__ == "<lambda>"
        else ()
    )
    arguments = [request.getfixturevalue(name) for name in names]
    with pytest.raises(rise_di.ParameterError) as refused:
        wrong(*arguments)
    assert str(refused.value).startswith(sentence)
