# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""An entry of the public benchmark: what flies a set, a law with parameters or a function of
Python.
"""

import ast
import hashlib
import importlib.util
import json
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from importlib.machinery import ModuleSpec
from pathlib import Path
from pkgutil import resolve_name
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

import flight_core
from control_laws.catalogue import LAWS
from flight_analysis.closed_loop.scenario import Scenario
from flight_campaign.benchmark_sets import Sets, frame
from flight_campaign.tuned_controller import REGISTERED, tuned_controller
from flight_campaign.tuning import build_benchmark
from flight_core.parameters import ParameterError, require
from flight_core.vectors import FloatArray, as_array
from flight_design.gains import tuned_gains
from rise_di_controller.laws import AnyLaw
from rise_di_controller.params import ControllerConfig

# the gains of a law of the comparison
TUNED_IN = "osprey_servo"
TUNED_FOR = "osprey"
TUNED_ON = "gust_turbulence"
FIXED = ("rate", "outputs", "inputs", "lower", "upper")  # keys of the frame that no law changes
NOT_STATED = "not stated"
GAINS = "controllers.json"  # among the sources of an entry
INSTALLED = {"site-packages", "dist-packages"}  # folders of libraries


class Task(NamedTuple):
    """What an entry may know of a set: channels, rate, and the parameters of the controller that
    every law gets.
    """

    set: str  # as "gusts"
    airframe: str  # as "osprey", or "jsbsim:f16"
    outputs: tuple[str, ...]
    inputs: tuple[str, ...]
    rate: float  # Hz
    controller: Mapping[str, Any]  # with D, input_scale = 1 / abs(Omega_ii), lag, lower and upper


Step = Callable[[float, FloatArray, FloatArray], ArrayLike]
"""step(t, y, y_m) -> u: t in s, the rest (m,), SI, deviations from trim, in the order of the
task."""

Enter = Callable[[Task], Mapping[str, Any] | Step | None]
"""A law for a task: a section `controller`, or a function that keeps the state of one aircraft;
None takes no part."""


class BenchmarkEntry(NamedTuple):
    """An entry."""

    name: str
    sees: str  # measurements beside y_m
    knows: str  # of the aircraft, beside D
    sources: Mapping[str, bytes]  # its gains and its modules by file name
    enter: Enter

    @property
    def source(self) -> str:
        """SHA-256 of the names, sizes and bytes of the sources in the order of the names, "" for
        none.
        """
        digest = hashlib.sha256()
        for name, content in sorted(self.sources.items()):
            digest.update(f"{name} {len(content)}\n".encode() + content)
        return digest.hexdigest() if self.sources else ""


def task_of(name: str, sets: Sets) -> Task:
    """The task of a set."""
    scenario = sets.scenario(name)
    controller = scenario.controller
    return Task(
        name,
        scenario.aircraft.airframe,
        controller.outputs,
        controller.inputs,
        controller.rate,
        frame(scenario),
    )


def entered(entry: BenchmarkEntry, task: Task) -> ControllerConfig | Step | None:
    """What flies a task. Raises ParameterError for a function that raises, a section that is none
    or changes the frame.
    """
    try:
        law = entry.enter(task)
    except ParameterError:
        raise
    except Exception as error:
        raised = f"{type(error).__name__}: {error}, for {task.set}"
        raise ParameterError(
            f"{entry.name}: found {raised}, expected a function of a task that returns a law"
        ) from error
    if law is None or not isinstance(law, Mapping):
        require(
            law is None or callable(law),
            entry.name,
            law,
            "a section `controller`, a function of t, y, y_m, or None",
        )
        return law
    controller = AnyLaw.validate_mapping({**task.controller, **law}, f"{entry.name}: controller")
    framed = AnyLaw.validate_mapping(
        {**task.controller, **law, **{key: task.controller[key] for key in FIXED}}, entry.name
    )
    for key in FIXED:
        value = getattr(controller, key)
        expected = getattr(framed, key)
        require(
            value == expected,
            f"{entry.name}: controller.{key}",
            value,
            f"{expected}, as every law of {task.set} has it",
        )
    return controller


def stepped(step: Step, t: float, y: FloatArray, y_m: FloatArray, task: Task) -> FloatArray:
    """The u of a function, (m,).

    Raises ParameterError for a function that raises, for a wrong shape, and for numbers that are
    not finite.
    """
    where = f"u in {task.set} at t = {t:g} s"
    expected = f"{len(task.inputs)} finite numbers: {', '.join(task.inputs)}"
    try:
        u = step(t, y.copy(), y_m.copy())
    except Exception as error:
        raise ParameterError(
            f"{where}: found {type(error).__name__}: {error}, expected {expected}"
        ) from error
    vector = as_array(u, where, expected)
    require(
        vector.shape == (len(task.inputs),) and bool(np.isfinite(vector).all()), where, u, expected
    )
    return vector


def find_entry(
    words: Sequence[str],
    sets: Sets,
    find: Callable[[str], Scenario],
    name: str | None = None,
    sees: str | None = None,
    knows: str | None = None,
) -> BenchmarkEntry:
    """The entry that words name: MODULE:FUNCTION, a law of the comparison, or scenarios, one for
    each airframe.

    `find` reads a scenario. Raises ParameterError for an unknown word.
    """
    first = words[0]
    if ":" in first and not first.endswith(".yaml"):
        require(len(words) == 1, "ENTRY", " ".join(words), "one MODULE:FUNCTION")
        enter = _function(first)
        sources = sources_of([first.partition(":")[0]])
        return BenchmarkEntry(
            name or first.replace(":", "."), sees or "y", knows or NOT_STATED, sources, enter
        )
    if first in REGISTERED:
        require(len(words) == 1, "ENTRY", " ".join(words), "one law, or scenarios alone")
        law = LAWS[first]
        tuned = _of_airframes({TUNED_FOR: _tuned(first, find(TUNED_IN))})
        return BenchmarkEntry(
            name or first, sees or law.measurements, knows or law.model_data, *tuned
        )
    scenarios = [find(word) for word in words]
    by_airframe = {scenario.aircraft.airframe: scenario.controller for scenario in scenarios}
    require(
        len(by_airframe) == len(words), "ENTRY", " ".join(words), "one scenario for each airframe"
    )
    known = sets.airframes()
    for airframe in by_airframe:
        require(
            airframe in known, "ENTRY", f"a scenario of {airframe}", f"one of {', '.join(known)}"
        )
    return BenchmarkEntry(
        name or Path(first).stem, sees or "y", knows or NOT_STATED, *_of_airframes(by_airframe)
    )


def _of_airframes(
    controllers: Mapping[str, ControllerConfig],
) -> tuple[dict[str, bytes], Enter]:
    """Sources and entry of controllers by airframe."""
    sections = {
        airframe: controller.model_dump(mode="json") for airframe, controller in controllers.items()
    }
    modules = {type(controller).__module__ for controller in controllers.values()}
    gains = {GAINS: json.dumps(sections, sort_keys=True, indent=1).encode()}
    fixed = {airframe: _without_delay(section) for airframe, section in sections.items()}
    return gains | sources_of(modules), lambda task: fixed.get(task.airframe)


def _without_delay(section: Mapping[str, Any]) -> dict[str, Any]:
    """A section without the delay of the topics: that of the frame applies."""
    return {key: value for key, value in section.items() if key != "delay"}


def _tuned(name: str, scenario: Scenario) -> ControllerConfig:
    tuned = tuned_gains.find(scenario, name, TUNED_ON)
    if tuned is None:
        raise ParameterError(
            f"ENTRY: found {name}, which has no gains for {TUNED_IN}, expected a law that has them"
        )
    return tuned_controller(name, tuned, build_benchmark(scenario))


def _function(text: str) -> Enter:
    """A function by MODULE:FUNCTION, of an installed package or of a file of this folder."""
    if "" not in sys.path:
        sys.path.insert(0, "")
    try:
        function = resolve_name(text)
    except (ImportError, AttributeError, ValueError, SyntaxError) as error:
        raise ParameterError(
            f"ENTRY: found {text!r} ({error}), expected MODULE:FUNCTION, of a package or a file "
            "here"
        ) from None
    require(callable(function), "ENTRY", text, "a function of a task")
    enter: Enter = function
    return enter


def sources_of(modules: Iterable[str]) -> dict[str, bytes]:
    """The source of some modules, and of each module imported by their statements at any depth,
    by file name.

    Modules of Python, of installed libraries and of the stack are left out: each version has one
    source. The package of a module named first counts wherever the package lies.
    """
    waiting = list(modules)
    packages = {name.partition(".")[0] for name in waiting}
    sources: dict[str, bytes] = {}
    seen: set[str] = set()
    while waiting:
        name = waiting.pop()
        spec = None if name in seen else _spec(name)
        seen.add(name)
        if spec is not None and (name.partition(".")[0] in packages or not _is_library(spec)):
            content = Path(str(spec.origin)).read_bytes()
            sources[f"{name}.py"] = content
            waiting += _imported(ast.parse(content), spec)
    return sources


def _spec(name: str) -> ModuleSpec | None:
    """Where a module with a source lies; None for any other name."""
    try:
        spec = importlib.util.find_spec(name)
    except (ImportError, ValueError):
        return None
    return spec if spec is not None and str(spec.origin).endswith(".py") else None


def _is_library(spec: ModuleSpec) -> bool:
    """Whether a module is of Python, installed, or of the stack."""
    path = Path(str(spec.origin)).resolve()
    stack = Path(flight_core.__file__).resolve().parents[2]
    of_python = spec.name.partition(".")[0] in sys.stdlib_module_names
    return of_python or bool(INSTALLED & {*path.parts}) or path.is_relative_to(stack)


def _imported(tree: ast.Module, spec: ModuleSpec) -> list[str]:
    """Names in the import statements of a module, of modules and of what may be a module."""
    package = spec.name if spec.submodule_search_locations else spec.name.rpartition(".")[0]
    names: list[str] = []
    for statement in ast.walk(tree):
        if isinstance(statement, ast.Import):
            names += [alias.name for alias in statement.names]
        elif isinstance(statement, ast.ImportFrom):
            relative = "." * statement.level + (statement.module or "")
            module = importlib.util.resolve_name(relative, package)
            names += [module, *(f"{module}.{alias.name}" for alias in statement.names)]
    return names + [name.rpartition(".")[0] for name in names if "." in name]
