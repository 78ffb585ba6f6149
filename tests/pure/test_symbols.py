# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""docs/symbols.md against the code: every name on it exists, and nothing that the law or the proof carries is missing."""

import ast
import importlib
import re
from collections.abc import Mapping, Sequence
from fnmatch import fnmatchcase
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple, get_args

import pytest

from aircraft_sim.simulator import Simulator
from flight_analysis.closed_loop.scenario import SCHEMAS, Scenario
from flight_analysis.design.gain_conditions import Bounds, GainSet
from flight_analysis.design.lyapunov import Evidence
from flight_core.parameters import Config
from rise_di_controller import internals
from rise_di_controller.law import LawParams, LawState
from rise_di_controller.observer import ObserverParams, ObserverState
from rise_di_controller.rise_di import RiseDiConfig

ROOT = Path(__file__).resolve().parents[2]
TOPICS = ROOT / "ros_ws" / "src" / "flight_ros" / "flight_ros" / "topics.py"
COLUMNS = ("code", "shape", "unit", "topic or parameter")  # behind equation, statement or symbol, meaning
EQUATIONS = {*range(1, 33), 40, 46, 47, 48}  # the others are steps of the proofs, as the page says


class Row(NamedTuple):
    """A row of one of the two tables with the rows that continue it; names are what stands in backticks."""

    table: str
    head: str
    code: tuple[str, ...]  # full dotted names
    shown: tuple[str, ...]  # topic fields, parameters and commands
    tests: tuple[str, ...]  # file::function


def quoted(cell: str) -> tuple[str, ...]:
    return tuple(re.findall(r"`([^`]+)`", cell))


def modules_of(text: str) -> dict[str, str]:
    """The package of each module that the names of code begin with."""
    legend = re.search(r"- \*\*Code\.\*\*(.*?)(?=\n- )", text, re.DOTALL)
    assert legend is not None
    return dict(re.findall(r"`(\w+)`\s+in\s+`([\w.]+)`", legend[1]))


def listed_tests(text: str) -> list[tuple[str, tuple[str, ...]]]:
    """The tests of each row, in the order of the tables."""
    items = re.findall(r"^- (.*?)(?=\n- |\n\n|\Z)", text.partition("\n## Tests\n")[2], re.DOTALL | re.MULTILINE)
    heads = [item.partition(": `")[0] for item in items]
    named = [[name.partition("::") for name in quoted(item[len(head) :])] for head, item in zip(heads, items, strict=True)]
    return [
        (head, tuple(f"{file if '/' in file else f'tests/pure/test_{file}.py'}::test_{name}" for file, _, name in names))
        for head, names in zip(heads, named, strict=True)
    ]


def rows_of(text: str) -> list[Row]:
    rows: list[list[Any]] = []
    table = ""
    for line in text.partition("\n## Tests\n")[0].splitlines():
        cells = [cell.strip() for cell in line.strip("|").split("|")]
        if not line.startswith("|"):
            table = ""
        elif not table:
            table = cells[0]
            assert tuple(cells[2:]) == COLUMNS
        elif set(line) != {"|", "-"}:
            assert len(cells) == 6, f"{cells[0]}: {len(cells)} cells, for a | stands in one of them"
            if cells[0]:
                rows.append([table, cells[0], (), ()])
            rows[-1][2] += quoted(cells[2])
            rows[-1][3] += quoted(cells[5])
    modules, tests = modules_of(text), listed_tests(text)
    assert [head for head, _ in tests] == [head for _, head, _, _ in rows]
    return [
        Row(table, head, tuple(f"{modules[name.split('.')[0]]}.{name}" for name in code), shown, named)
        for (table, head, code, shown), (_, named) in zip(rows, tests, strict=True)
    ]


PAGE = (ROOT / "docs" / "symbols.md").read_text(encoding="utf-8")
ROWS = rows_of(PAGE)
EVERY_ROW = pytest.mark.parametrize("row", ROWS, ids=lambda row: row.head)


def resolve(name: str) -> object:
    """What a dotted name stands for: a module, or what is in one; fields of models count. Raises LookupError."""
    parts = name.split(".")
    found: Any = importlib.import_module(parts[0])
    for k, part in enumerate(parts[1:], start=2):
        if hasattr(found, part):
            found = getattr(found, part)
        elif isinstance(found, type) and issubclass(found, Config) and part in found.model_fields:
            found = found.model_fields[part]
        elif part in getattr(found, "__dataclass_fields__", {}):
            found = found.__dataclass_fields__[part]
        elif hasattr(found, "__path__"):
            found = importlib.import_module(".".join(parts[:k]))  # raises ModuleNotFoundError, which says as much
        else:
            raise LookupError(f"{name}: nothing is called {part}")
    return found


@cache
def functions_of(path: Path) -> frozenset[str]:
    body = ast.parse(path.read_text(encoding="utf-8")).body
    return frozenset(node.name for node in body if isinstance(node, ast.FunctionDef) and node.name.startswith("test_"))


def schema_at(annotation: Any) -> Any:
    """The set inside an annotation such as `Set | None` or `dict[str, Set]`, else the annotation."""
    inside = (annotation, *map(schema_at, get_args(annotation)))
    return next((one for one in inside if isinstance(one, type) and issubclass(one, Config)), annotation)


def is_parameter(name: str) -> bool:
    """Whether the schemas have section.key, section.group.key or section.group.*.key."""
    section, *keys = name.split(".")
    model: Any = RiseDiConfig if section == "controller" else SCHEMAS.get(section)
    for place, key in enumerate(keys):
        fields = model.model_fields if isinstance(model, type) and issubclass(model, Config) else {}
        if key == "*" and place > 0:
            continue
        if key not in fields:
            return False
        model = schema_at(fields[key].annotation)
    return bool(keys)


def topics() -> set[str]:
    """Names of the flight's topics, read without ROS."""
    calls = (node for node in ast.walk(ast.parse(TOPICS.read_text(encoding="utf-8"))) if isinstance(node, ast.Call))
    named = [call.args[0] for call in calls if isinstance(call.func, ast.Name) and call.func.id == "Topic"]
    return {node.value for node in named if isinstance(node, ast.Constant) and isinstance(node.value, str)}


@pytest.fixture(scope="module")
def channels(osprey_gust: Scenario) -> Mapping[str, Sequence[str]]:
    """Channel names by topic, in the default scenario."""
    outputs, inputs = osprey_gust.controller.outputs, osprey_gust.controller.inputs
    return {
        "y": outputs,
        "y_m": outputs,
        "u_m": outputs,
        "u": inputs,
        "internals": internals.names(osprey_gust.controller.logged_groups()),
        "truth": Simulator(osprey_gust.aircraft).truth_names,
    }


def is_field(text: str, channels: Mapping[str, Sequence[str]]) -> bool:
    """Whether "topic: pattern" is at least one channel that the stack publishes."""
    topic, _, pattern = text.partition(": ")
    return topic in topics() and any(fnmatchcase(name, pattern) for name in channels[topic])


def numbers(head: str) -> set[int]:
    """Equation numbers of a row's head: "(5) to (9)" is five of them."""
    found: set[int] = set()
    for first, last in re.findall(r"\((\d+)\)(?: to \((\d+)\))?", head):
        found |= set(range(int(first), int(last or first) + 1))
    return found


@EVERY_ROW
def test_every_code_name_can_be_imported(row: Row) -> None:
    for name in row.code:
        resolve(name)


@EVERY_ROW
def test_every_row_names_a_test_and_every_test_exists(row: Row) -> None:
    assert row.tests
    for named in row.tests:
        path, _, function = named.partition("::")
        assert function in functions_of(ROOT / path), named


@EVERY_ROW
def test_topic_fields_are_published_and_parameters_are_in_their_schema(row: Row, channels: Mapping[str, Sequence[str]]) -> None:
    for name in row.shown:
        if not name.startswith("rise-di "):
            assert is_field(name, channels) if ": " in name else is_parameter(name), name


def test_names_in_the_text_around_the_tables_exist(channels: Mapping[str, Sequence[str]]) -> None:
    text = "\n".join(line for line in PAGE.splitlines() if not line.startswith("|"))
    for name in quoted(text):
        if ": " in name:
            assert is_field(name, channels), name
        elif name.startswith(("flight_analysis.", "rise_di_controller.")):
            resolve(name)
        elif name.startswith("controller."):
            assert is_parameter(name), name
        elif name.startswith("tests/"):
            assert (ROOT / name).is_file(), name


def test_every_equation_has_its_row_and_the_page_names_those_that_have_none() -> None:
    heads = [row.head for row in ROWS if row.table == "equation"]
    assert set().union(*map(numbers, heads)) == EQUATIONS
    for rest in ("Assumption 1", "Assumption 2", "Assumption 3", "Remark 1", "Theorem 1", "Lemma 1", "Lemma 2"):
        assert any(rest in head for head in heads), rest
    for rest in ("step 1", "step 2", "step 3"):
        assert any(rest in head for head in heads), rest
    assert "(33) to (39), (41) to (45), (49) and (50)" in PAGE


@pytest.mark.parametrize("fields", [LawParams, LawState, ObserverParams, ObserverState, GainSet, Bounds, Evidence])
def test_nothing_that_the_law_its_gains_or_the_proof_carry_is_left_out(fields: Any) -> None:
    module = fields.__module__
    named = {name for row in ROWS for name in row.code}
    for name in fields._fields:
        alike = {f"{module}.{fields.__name__}.{name}"}
        if fields is GainSet:  # the gains are those of the law, but for their parts
            alike.add(f"{LawParams.__module__}.LawParams.{name}")
        assert alike & named or name == "t", f"{fields.__name__}.{name}"


def test_nothing_that_is_published_is_left_out(channels: Mapping[str, Sequence[str]]) -> None:
    patterns = [name.split(": ") for row in ROWS for name in row.shown if ": " in name]
    for topic, names in channels.items():
        for name in names:
            assert any(topic == other and fnmatchcase(name, pattern) for other, pattern in patterns), f"{topic}: {name}"


def test_what_does_not_exist_is_noticed(channels: Mapping[str, Sequence[str]]) -> None:
    for name in ("rise_di_controller.law.LawParams.k", "rise_di_controller.laws.step", "aircraft_sim.airframe.Airframe.D"):
        with pytest.raises((LookupError, ModuleNotFoundError)):
            resolve(name)
    resolve("aircraft_sim.airframe.Airframe.gravity")  # a field of a model is no attribute of its class
    resolve("flight_analysis.closed_loop.scenario.Scenario.flight")
    assert not any(map(is_parameter, ("controller", "controller.K", "controler.k_g", "aircraft.gusts.*.width", "controller.*")))
    assert not any(is_field(name, channels) for name in ("internals: pi.*", "internal: Pi.*", "truth: z.*", "y: h"))
    assert not functions_of(Path(__file__)) & {"test_that_is_not_there"}
