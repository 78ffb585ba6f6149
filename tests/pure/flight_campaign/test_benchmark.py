# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""The public benchmark: frozen sets, entries of all kinds, the file of scores, a second plant
written from the equations.
"""

import hashlib
import json
import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import pytest
import yaml
from tests.conftest import REPOSITORY, invoke, refusing

from aircraft_sim.uncertainty import sampled_matrices
from flight_analysis.closed_loop.scenario_library import find_scenario
from flight_campaign import engines
from flight_campaign.benchmark_course import build_course
from flight_campaign.benchmark_entry import BenchmarkEntry, Enter, Task, find_entry, task_of
from flight_campaign.benchmark_scores import (
    CHUNKS,
    SCORES,
    Benchmark,
    Definition,
    Flights,
    define,
    drawn_release,
)
from flight_campaign.benchmark_sets import SCENARIOS, SETS, UNCERTAINTY, VERSION, Sets, seed_of
from flight_core.vectors import FloatArray
from rise_di_controller.control_law import ControlLaw, Measurements
from rise_di_controller.laws import AnyLaw
from rise_di_controller.saturation import Limits

pytestmark = pytest.mark.slow

PI = {"law": "pi", "K": [18.0, 18.0, 9.0, 2.0], "Lambda": [5.0, 5.0, 3.0, 0.5]}
LATE = (1, 0)  # the first aircraft of the second set of `brief`
GUST = {"vertical": {"start": 6.0, "speed": 10.12, "length": 15.24}}
OSPREY = (
    REPOSITORY / "ros_ws" / "src" / "aircraft_sim" / "aircraft_sim" / "airframes" / "osprey.yaml"
)


def entry(enter: Enter) -> BenchmarkEntry:
    return BenchmarkEntry("own", "y", "nothing", {}, enter)


@pytest.fixture
def brief(monkeypatch: pytest.MonkeyPatch) -> Sets:
    """The first 8 s of gusts, in time and late, with a gust in them."""
    for name in set(SETS) - {"gusts", "late"}:
        monkeypatch.delitem(SETS, name)
    short = find_scenario("osprey_servo", 8.0).vary(aircraft={"gusts": GUST})
    return Sets({"osprey_servo": short})


def own_steps(task: Task) -> Callable[[float, FloatArray, FloatArray], FloatArray]:
    """PI of the stack as a function, with the equations that the fleet compiles."""
    law, params, limits = _law({**task.controller, **PI})
    state = None
    u = np.zeros(4)
    none = np.zeros(4)

    def step(t: float, y: FloatArray, y_m: FloatArray) -> FloatArray:
        nonlocal state, u
        measured = Measurements(y, y_m, none, none, u)
        if state is None:
            state = law.engage(measured, params)
        else:
            state, _, u = law.limited(state, measured, np.float64(1.0 / task.rate), params, limits)
        return u

    return step


def _law(section: Mapping[str, Any]) -> tuple[ControlLaw, Any, Limits]:
    controller = AnyLaw.validate_mapping(section, "controller")
    return *controller.tuned_law(), controller.guard().limits


def test_sets_of_version_are_frozen() -> None:
    """A change of a scenario, an airframe or a rule needs another VERSION: published scores would
    mean something else.
    """
    assert VERSION == 1
    sets = Sets({name: find_scenario(name) for name in SCENARIOS})
    assert sets.digest() == "326ec8bceaff4f25d1a4501495846f404d3ab732d60d80df5b368c4472ec479f"


def test_seeds_come_from_the_hash_of_a_release() -> None:
    assert (
        seed_of("gusts", "", "noise")
        == int(hashlib.sha256(b"rise-di benchmark 1  gusts noise").hexdigest()[:16], 16) >> 1
    )
    release = hashlib.sha256(f"rise-di benchmark 1 {'a' * 40} gusts noise".encode()).hexdigest()
    assert seed_of("gusts", "a" * 40, "noise") == int(release[:16], 16) >> 1


def test_function_scores_as_the_registered_law(brief: Sets) -> None:
    """Tick by tick with u from outside as in the compiled loop; the order of sums of the compiler
    differs in last bits.
    """
    rows = []
    for enter in (own_steps, lambda task: PI):
        flights = Flights(entry(enter), brief)
        assert flights.not_flown() == {}
        rows.append(pl.read_parquet(flights.fly(LATE, 3)))
    function, registered = rows
    assert registered["score"].to_numpy().min() > 1.0
    np.testing.assert_allclose(function["score"], registered["score"], rtol=1e-9)
    np.testing.assert_allclose(function["slew.elevator"], registered["slew.elevator"], rtol=1e-9)


def test_entry_of_the_page_flies(
    brief: Sets, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    page = (REPOSITORY / "docs" / "benchmark.md").read_text()
    block = re.search(r"```python\n(.*?)```", page, re.DOTALL)
    assert block is not None
    (tmp_path / "law_of_the_page.py").write_text(block[1])
    monkeypatch.syspath_prepend(tmp_path)
    own = find_entry(["law_of_the_page:enter"], brief, find_scenario, knows="Omega_ii")
    assert (own.name, own.knows) == ("law_of_the_page.enter", "Omega_ii")
    flights = Flights(own, brief)
    assert flights.not_flown() == {}
    assert pl.read_parquet(flights.fly(LATE, 3))["score"].to_numpy().max() < 10.0  # none is lost


def test_digest_covers_each_module_that_the_entry_imports(
    brief: Sets, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also inside of a function, and relative to a package."""
    (tmp_path / "entry_of_parts").mkdir()
    files = {
        "entered_law.py": "def enter(task):\n    import numpy, entry_of_parts.gains\n",
        "entry_of_parts/__init__.py": "",
        "entry_of_parts/gains.py": "from . import rows\n",
        "entry_of_parts/rows.py": "K = 1.0\n",
    }
    for name, text in files.items():
        (tmp_path / name).write_text(text)
    monkeypatch.syspath_prepend(tmp_path)
    before = find_entry(["entered_law:enter"], brief, find_scenario)
    names = {"entered_law", "entry_of_parts", "entry_of_parts.gains", "entry_of_parts.rows"}
    assert set(before.sources) == {f"{name}.py" for name in names}
    (tmp_path / "entry_of_parts" / "rows.py").write_text("K = 2.0\n")
    assert find_entry(["entered_law:enter"], brief, find_scenario).source != before.source


def test_seeds_are_drawn_once_a_run(brief: Sets, tmp_path: Path) -> None:
    release = drawn_release(tmp_path)
    assert re.fullmatch("[0-9a-f]{40}", release)
    assert drawn_release(tmp_path) != release
    flights = Flights(
        entry(lambda task: PI), Sets({"osprey_servo": brief.scenario("gusts")}, release)
    )
    Benchmark(tmp_path, define(flights, 3, "0.0"), {"own.py": b"PI"})
    assert drawn_release(tmp_path) == release
    assert (tmp_path / "entry" / "own.py").read_bytes() == b"PI"


def test_interrupted_run_continues_to_the_same_file(brief: Sets, tmp_path: Path) -> None:
    flights = Flights(entry(lambda task: PI), brief)
    definition = define(flights, 3, "0.0")

    def flown(folder: Path, of: Definition) -> bytes:
        run = Benchmark(folder, of)
        list(run.fly(flights, engines.threads(1)))
        run.scores()
        return (folder / SCORES).read_bytes()

    once = flown(tmp_path / "once", definition)
    (tmp_path / "once" / CHUNKS / "late-000.parquet").unlink()
    assert len(Benchmark(tmp_path / "once", definition).missing()) == 1
    assert flown(tmp_path / "once", definition) == once == flown(tmp_path / "again", definition)
    found = json.loads(once)
    assert found["sets"]["gusts"]["aircraft"] == 3
    assert found["entry"] == {"name": "own", "sees": "y", "knows": "nothing", "source": ""}
    with refusing("with another entry, version or option"):
        Benchmark(tmp_path / "once", define(flights, 4, "0.0"))


@pytest.mark.parametrize(
    "enter, sentence",
    [
        (
            lambda task: PI | {"rate": 50.0},
            "own: controller.rate: found 50.0, expected 100.0, as every law of gusts has it",
        ),
        (lambda task: 3, "own: found 3, expected a section"),
        (
            lambda task: lambda t, y, y_m: [0.0],
            r"u in gusts at t = 0 s: found \[0.0\], expected 4 finite numbers: elevator",
        ),
        (
            lambda task: lambda t, y, y_m: 1 / 0,
            "u in gusts at t = 0 s: found ZeroDivisionError: division by zero",
        ),
    ],
)
def test_entry_that_does_not_fit_refused(enter: Enter, sentence: str, brief: Sets) -> None:
    flights = Flights(entry(enter), brief)

    def fly() -> None:
        define(flights, 1, "0.0")
        flights.fly((0, 0), 1)

    with refusing(sentence):
        fly()


@pytest.mark.parametrize(
    "words, sentence",
    [
        (["no_such_module:enter"], "found 'no_such_module:enter'"),
        (["osprey_servo", "osprey_gust"], "expected one scenario for each airframe"),
        (["pi", "--release", "abc"], "found abc, expected draw, or the hash of a commit, 40 hex"),
    ],
)
def test_command_refuses_with_a_sentence(words: list[str], sentence: str) -> None:
    with refusing(sentence):
        invoke("benchmark", *words, catch_exceptions=False)


def test_function_flies_an_aircraft_of_jsbsim_as_its_law() -> None:
    """The law behind its guard and the same equations as a function: the guard adds nothing where
    no sample is lost.
    """
    pytest.importorskip("jsbsim")
    name = "jsbsim_c172p"
    sets = Sets({scenario: find_scenario(scenario, 3.0) for scenario in SCENARIOS})
    task = task_of(name, sets)
    assert (task.airframe, task.inputs[-1]) == ("jsbsim:c172p", "throttle")
    flights = Flights(
        entry(lambda task: (lambda t, y, y_m: 0.0 * y) if task.set == name else None), sets
    )
    flights.not_flown()
    row = pl.read_parquet(flights.fly(([*SETS].index(name), 0), 1))
    assert not row["diverged"][0]
    assert row["slew.throttle"][0] == 0.0  # u of the function flies, and nothing else
    assert row["rms.q"][0] > 0.01  # the first command, 0.05 rad/s, is not tracked


def test_second_plant_agrees_within_2_percent(brief: Sets) -> None:
    """The plant written again from the equations, with the numbers of the file and noise of its
    own: the mean score agrees.
    """
    flights = Flights(find_entry(["osprey_servo"], brief, find_scenario), brief)
    flights.not_flown()
    own = pl.read_parquet(flights.fly(LATE, 50))["score"].to_numpy()
    assert np.mean(second_plant_scores(brief, "late", len(own), 2)) == pytest.approx(
        np.mean(own), rel=0.02
    )


def second_plant_scores(sets: Sets, name: str, count: int, late: int) -> FloatArray:
    """Scores of the aircraft of a set: x_dot = A x + gravity + wind + B p, p_dot = (u - p) / lag;
    Runge-Kutta in 2.5 ms.
    """
    scenario = sets.scenario(name)
    published: dict[str, Any] = yaml.safe_load(OSPREY.read_text())
    states = list(published["states"])
    V0 = published["speed"]
    v, alpha, q, theta, beta, p, r, phi = range(8)
    A, B = (
        np.moveaxis(values, 0, -1)
        for values in sampled_matrices(
            scenario.aircraft.load()[0],
            UNCERTAINTY,
            UNCERTAINTY,
            seed_of(name, "", "aircraft"),
            0,
            count,
        )
    )
    wind = np.zeros((8, count))
    for state, effect in published["gusts"]["vertical"].items():
        wind[states.index(state)] = (
            effect / V0 * A[states.index(state), alpha] / published["A"][states.index(state)][alpha]
        )
    actuators = scenario.aircraft.actuators
    rng = np.random.default_rng(1)
    lag, stop, fastest = (
        np.array(values)[:, None] for values in (actuators.lag, actuators.upper, actuators.rate)
    )

    def gust(t: float) -> float:
        along = V0 * (t - GUST["vertical"]["start"]) / GUST["vertical"]["length"]
        return 5.06 * (1.0 - np.cos(np.pi * along)) if 0.0 < along < 2.0 else 0.0

    def x_dot(t: float, x: FloatArray, u: FloatArray) -> FloatArray:
        aircraft = x[:8]
        position = x[8:]
        change = (
            np.einsum("ijn,jn->in", A, aircraft)
            + np.einsum("ijn,jn->in", B, position)
            + wind * gust(t)
        )
        change[v] -= 9.81 * np.sin(aircraft[theta])
        change[beta] += 0.39 * np.sin(aircraft[phi])
        return np.concatenate([change, np.clip((u - position) / lag, -fastest, fastest)])

    law, params, limits = _law(scenario.controller.model_dump())
    params = type(params)(
        *(np.asarray(value)[:, None] if np.ndim(value) == 1 else value for value in params)
    )
    limits = Limits(*(values[:, None] for values in limits))
    y_m = build_course(scenario).segments.y_m
    h = 0.0025
    x = np.zeros((12, count))
    u = np.zeros((4, count))
    state = None
    squares = np.zeros((4, count))
    sent = [u] * (late + 1)
    for k, wanted in enumerate(y_m):
        true = x[[q, p, r, v]]
        squares += (true - wanted[:, None]) ** 2
        y = true + np.array([[0.0017], [0.0017], [0.0017], [0.03]]) * rng.standard_normal(
            (4, count)
        )
        slope = (wanted - y_m[k - 1])[:, None] / 0.01 if k else 0.0 * wanted[:, None]
        measured = Measurements(y, wanted[:, None], slope, 0.0 * y, u)
        if state is None:
            state = law.engage(measured, params)
        else:
            state, _, u = law.limited(state, measured, np.float64(0.01), params, limits)
        sent = [u, *sent[:-1]]
        held = sent[-1][[0, 3, 1, 2]]  # elevator, thrust, aileron, rudder
        for t in 0.01 * k + h * np.arange(4):
            k1 = x_dot(t, x, held)
            k2 = x_dot(t + h / 2, x + h / 2 * k1, held)
            k3 = x_dot(t + h / 2, x + h / 2 * k2, held)
            x = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + x_dot(t + h, x + h * k3, held))
            x[8:] = np.clip(x[8:], -stop, stop)
    return np.asarray(np.sqrt(squares / len(y_m)).T @ (1.0 / np.array([0.01, 0.02, 0.01, 0.1])))
