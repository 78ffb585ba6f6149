# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test the docstrings of the names of `rise_di`: Google's sections, and examples that run."""

import doctest
import inspect
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import rise_di
from flight_analysis.closed_loop.simulate import simulate
from rise_di import own_airframe

pytestmark = pytest.mark.slow

PUBLIC = {name: getattr(rise_di, name) for name in rise_di.__all__}
CLASSES = {name: value for name, value in PUBLIC.items() if inspect.isclass(value)}
FUNCTIONS = {name: value for name, value in PUBLIC.items() if inspect.isfunction(value)}
METHODS = {
    f"{name}.{key}": getattr(method, "__func__", method)
    for name, public in CLASSES.items()
    for key, method in vars(public).items()
    if not key.startswith("_") and inspect.isfunction(getattr(method, "__func__", method))
}
EXAMPLES = sorted(name for name, value in PUBLIC.items() if ">>> " in (inspect.getdoc(value) or ""))


def section(documented: object, title: str) -> str | None:
    """Return the lines of a section of a docstring, or None without such a section."""
    text = inspect.getdoc(documented) or ""
    match = re.search(rf"^{title}:\n((?:(?: .*)?\n)*(?: .*)?)", text, re.MULTILINE)
    return match and match[1]


def parameters(function: Callable[..., Any]) -> list[str]:
    """Return the names of the parameters of a function, without self and cls."""
    return [name for name in inspect.signature(function).parameters if name not in {"self", "cls"}]


@pytest.mark.parametrize("name", [*FUNCTIONS, *METHODS])
def test_sections_fit_the_signature(name: str) -> None:
    function = (FUNCTIONS | METHODS)[name]
    names = re.findall(r"^ {4}(\w+): ", section(function, "Args") or "", re.MULTILINE)
    assert names == parameters(function)
    returns_nothing = inspect.signature(function).return_annotation in {None, "None"}
    if name in FUNCTIONS or names:
        assert (section(function, "Returns") is None) == returns_nothing


DESCRIBED = [name for name in CLASSES if section(CLASSES[name], "Attributes")]


@pytest.mark.parametrize("name", DESCRIBED)
def test_attributes_fit_the_fields(name: str) -> None:
    attributes = section(CLASSES[name], "Attributes") or ""
    assert re.findall(r"^ {4}(\w+): ", attributes, re.MULTILINE) == parameters(CLASSES[name])


def test_every_function_has_an_example() -> None:
    assert set(FUNCTIONS) <= set(EXAMPLES)


@pytest.mark.parametrize("name", EXAMPLES)
def test_the_example_runs(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    # of a new airframe: one size of the commands, no samples, and two seconds of flight
    monkeypatch.setattr(
        own_airframe, "simulate", lambda each: simulate(each.vary(flight={"duration": 2.0}))
    )
    monkeypatch.setattr(own_airframe, "SIZES", (0.125,))
    monkeypatch.setattr(own_airframe, "SAMPLES", 0)
    text = inspect.getdoc(PUBLIC[name]) or ""
    names = {"rise_di": rise_di, "np": np}
    example = doctest.DocTestParser().get_doctest(text, names, name, None, None)
    output: list[str] = []
    runner = doctest.DocTestRunner(optionflags=doctest.ELLIPSIS)
    runner.run(example, out=output.append)
    assert example.examples
    assert not runner.failures, "".join(output)
