# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test docs/symbols.md against code and tests.

Each equation has a test and a docstring that names it, and each name exists.
"""

import ast
import importlib
import inspect
import re
from collections.abc import Mapping, Sequence
from fnmatch import fnmatchcase
from typing import Any

import pytest
from ros_ws.src.conftest import SOURCES, TESTS
from tests.conftest import REPOSITORY
from tools import parameters

from aircraft_sim.simulator import Simulator
from flight_analysis.closed_loop.scenario import Scenario
from rise_di_controller import internals

PAGE = (REPOSITORY / "docs" / "symbols.md").read_text()
TOPICS = (REPOSITORY / "docs" / "topics.md").read_text()
LAST_EQUATION = 52  # of the paper


def rows(page: str, heading: str) -> list[list[str]]:
    """Return the cells of the table whose first column has this heading."""
    table = re.search(rf"^\| {heading} \|.*\n\|---.*\n((?:\|.*\n)+)", page, re.MULTILINE)
    assert table is not None, heading
    return [line.strip("| ").split(" | ") for line in table[1].splitlines()]


def spans(text: str) -> list[str]:
    return re.findall(r"`([^`]+)`", text)


def numbers(text: str) -> set[int]:
    """Return the numbers of equations. "(5) to (9)" and "(5)-(9)" are five."""
    ends = re.findall(r"(?<!\w)\((\d+)\)(?:(?:-| to )\((\d+)\))?", text)
    return {number for first, last in ends for number in range(int(first), int(last or first) + 1)}


def resolve(name: str) -> Any:
    """Return the object of a name that begins with a module of the packages.

    For a field without a default, this is its annotation.
    """
    module, *parts = name.split(".")
    (path,) = SOURCES.glob(f"*/*/**/{module}.py")
    value: Any = importlib.import_module(
        ".".join(path.relative_to(SOURCES).with_suffix("").parts[1:])
    )
    for part in parts:
        value = (
            getattr(value, part) if hasattr(value, part) else inspect.get_annotations(value)[part]
        )
    return value


def marked() -> set[int | str]:
    """Return the arguments of all marks `equation` of the tests."""
    texts = (path.read_text() for path in TESTS.rglob("test_*.py"))
    trees = (ast.parse(text) for text in texts if "mark.equation" in text)
    calls = [node for tree in trees for node in ast.walk(tree) if isinstance(node, ast.Call)]
    marks = [call for call in calls if ast.unparse(call.func) == "pytest.mark.equation"]
    return {ast.literal_eval(argument) for mark in marks for argument in mark.args}


def test_the_page_names_every_equation() -> None:
    steps = re.search(r"^The others, (.*), are steps of the proofs", PAGE, re.MULTILINE)
    assert steps is not None
    assert numbers(steps[1]).isdisjoint(marked())
    assert numbers(steps[1]).union(*(numbers(head) for head, *_ in rows(PAGE, "equation"))) == set(
        range(1, LAST_EQUATION + 1)
    )


def test_each_equation_has_a_test() -> None:
    """A mark names a row of the page by its number, or by its words if it has none."""
    labels: set[int | str] = set()
    for head, *_ in rows(PAGE, "equation"):
        labels |= numbers(head) or {head}
    assert marked() == labels


def test_docstrings_name_their_equations() -> None:
    missing = []
    for head, _, code in rows(PAGE, "equation"):
        documented = numbers(" ".join(resolve(name).__doc__ for name in spans(code)))
        if spans(code) and not numbers(head) <= documented:
            missing.append(f"{head}: not in the docstrings of {code}")
    assert not missing, "\n".join(missing)


@pytest.fixture(scope="module")
def channels(osprey_gust: Scenario) -> Mapping[str, Sequence[str]]:
    """Return the channels by topic in the default scenario."""
    outputs = osprey_gust.controller.outputs
    inputs = osprey_gust.controller.inputs
    return {
        **dict.fromkeys(("y", "y_m", "u_m"), outputs),
        "u": inputs,
        "internals": internals.names(osprey_gust.controller.logged_groups()),
        "truth": Simulator(osprey_gust.aircraft).truth_names,
    }


def test_names_on_the_page_exist(channels: Mapping[str, Sequence[str]]) -> None:
    """The names are in the code, in a topic, or in the reference of the parameters."""
    sections = re.split(r"^## `(\w+)`", parameters.page(), flags=re.MULTILINE)[1:]
    keys = {
        f"{section}.{key}"
        for section, text in zip(sections[::2], sections[1::2], strict=True)
        for key in re.findall(r"^\| `([\w.]+)`", text, re.MULTILINE)
    }

    def exists(name: str) -> bool:
        if name.startswith("rise-di "):
            return True  # tests/docs/test_commands.py
        if ": " in name:
            topic, pattern = name.split(": ")
            return any(fnmatchcase(channel, pattern) for channel in channels[topic])
        if name.partition(".")[0] in sections:
            return name in keys
        try:
            return resolve(name) is not None
        except (ValueError, AttributeError, KeyError):
            return False

    cells = [
        cell
        for heading in ("equation", "symbol")
        for row in rows(PAGE, heading)
        for cell in row[2:]
    ]
    assert [name for cell in cells for name in spans(cell) if not exists(name)] == []


@pytest.mark.parametrize("topic", ["internals", "truth"])
def test_interfaces_explains_each_published_channel(
    topic: str, channels: Mapping[str, Sequence[str]]
) -> None:
    patterns = [
        pattern for head, _ in rows(TOPICS, f"channels of `{topic}`") for pattern in spans(head)
    ]
    assert [
        name
        for name in channels[topic]
        if not any(fnmatchcase(name, pattern) for pattern in patterns)
    ] == []
