# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Set the commands of an aircraft of JSBSim, and test their effect on its accelerations."""

from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from itertools import chain
from pathlib import Path
from xml.etree import ElementTree

import jsbsim
import numpy as np

from aircraft_sim.jsbsim.jsbsim_aircraft import RESIDUALS, Command
from aircraft_sim.jsbsim.jsbsim_files import model_files
from flight_core.vectors import FloatArray

FROZEN: Mapping[str, float] = {
    "simulation/integrator/rate/rotational": 0.0,  # the integration scheme: none
    "simulation/integrator/rate/translational": 0.0,
    "simulation/integrator/position/rotational": 0.0,
    "simulation/integrator/position/translational": 0.0,
    "propulsion/fuel_freeze": 1.0,
}
"""Properties that freeze position, velocity, attitude and fuel, while engines and flight control
systems run on."""

PART = 0.2  # change of a command by which its effect is tested
MOVED = 0.5  # s of frozen flight after this change, in which an engine begins to respond
AFTERWARDS = 10.0  # s of frozen flight after the test, in which an engine returns
# A change counts as an effect if it exceeds this multiple of the difference between two equal runs.
# Equal runs differ while an engine still settles.
NOISE = 2.0
SYSTEMS = ("flight_control", "autopilot", "system")
CONVENTION = "-cmd-norm"  # suffix of JSBSim's standard commands
LEAST = 1e-6  # least change of an acceleration that counts as an effect, m/s^2 or rad/s^2


@contextmanager
def frozen(fdm: jsbsim.FGFDMExec) -> Iterator[None]:
    """Hold position, velocity, attitude and fuel in this context; engines and systems run on."""
    before = {path: fdm[path] for path in FROZEN}
    for path, value in FROZEN.items():
        fdm[path] = value
    try:
        yield
    finally:
        for path, value in before.items():
            fdm[path] = value


def settle(fdm: jsbsim.FGFDMExec, duration: float) -> None:
    """Let engines and systems settle for `duration`, s, while the motion is frozen."""
    with frozen(fdm):
        for _ in range(round(duration / fdm.get_delta_t())):
            fdm.run()


def engine_count(fdm: jsbsim.FGFDMExec) -> int:
    """Return the number of engines of an aircraft."""
    return int(fdm.get_propulsion().get_num_engines())


def command_paths(command: Command, engines: int) -> list[tuple[str, float]]:
    """Return the properties of a command, each with the value that it has at the command 1.

    A command of the engines has one property for each engine.
    """
    if command.named:
        return list(command.named)
    if command.is_per_engine:
        return [(f"{command.property}[{i}]", 1.0) for i in range(engines)]
    return [(command.property, 1.0)]


def set_command(fdm: jsbsim.FGFDMExec, command: Command, value: float) -> None:
    """Give a command a value, by setting all of its properties."""
    for path, at_one in command_paths(command, engine_count(fdm)):
        fdm[path] = at_one * value


def residuals(fdm: jsbsim.FGFDMExec) -> FloatArray:
    """Return the accelerations in the order of RESIDUALS, SI, which are 0 in trim."""
    return np.array([fdm[f"accelerations/{name}"] * si for name, si in RESIDUALS.items()])


def commands_and_limits(
    fdm: jsbsim.FGFDMExec, inputs: Iterable[Command]
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the commands with their trims, and their lower and upper stops, (4,) each.

    The trim property of a command is added to it. A stop is a deviation from this sum, so the lower
    stops are at most 0.
    """
    inputs = list(inputs)
    first = [command_paths(command, 1)[0] for command in inputs]
    commands = np.array([fdm[path] / at_one for path, at_one in first])
    trim = np.array(
        [0.0 if command.trim_property is None else fdm[command.trim_property] for command in inputs]
    )
    lower = np.array([command.lower for command in inputs])
    upper = np.array([command.upper for command in inputs])
    return (
        commands + trim,
        lower - np.minimum(commands, commands + trim),
        upper - np.maximum(commands, commands + trim),
    )


def without_effect(fdm: jsbsim.FGFDMExec, commands: Mapping[str, Command]) -> list[str]:
    """Name the inputs that change no acceleration of the frozen aircraft, with engines running."""
    return [
        name
        for name, command in commands.items()
        if not _has_effect(
            fdm,
            command_paths(command, engine_count(fdm)),
            -PART if fdm[_first(command)] > PART else PART,
        )
    ]


def _first(command: Command) -> str:
    return command_paths(command, 1)[0][0]


def _has_effect(fdm: jsbsim.FGFDMExec, paths: Iterable[tuple[str, float]], part: float) -> bool:
    """Return whether a change of a command changes an acceleration.

    `paths` has the properties of the command with their values at the command 1, and `part` is the
    change of the command. Between two equal runs the accelerations differ a little, and the change
    must be larger.
    """
    before = {path: fdm[path] for path, _ in paths}
    runs = []
    for deflection in (0.0, 0.0, part):
        for path, at_one in paths:
            fdm[path] = before[path] + deflection * at_one
        settle(fdm, MOVED)
        runs.append(residuals(fdm))
    for path, value in before.items():
        fdm[path] = value
    settle(fdm, AFTERWARDS)
    first, again, third = runs
    return bool(np.max(np.abs(third - again)) > LEAST + NOISE * np.max(np.abs(again - first)))


def sentence_without_effect(
    fdm: jsbsim.FGFDMExec, commands: Mapping[str, Command], names: Iterable[str], model: Path | None
) -> str:
    """Write a sentence about inputs that have no effect.

    The sentence names the properties that have no effect, and the properties that the model reads.
    """
    parts = [
        f"{name}: {' and '.join(path for path, _ in command_paths(commands[name], 1))}"
        for name in names
    ]
    manager = fdm.get_property_manager()
    properties = (
        [] if model is None else [path for path in _read_by_model(model) if manager.hasNode(path)]
    )
    effective = [path for path in properties if _has_effect(fdm, [(path, 1.0)], PART)]
    if effective:
        reads = f"; its flight control reads {', '.join(effective)}: name them in `commands`"
    else:
        reads = ""
    return f"{', '.join(parts)} moves no acceleration{reads}"


def hysteresis_of(model: Path | None) -> str:
    """Name the servos of a model that have a hysteresis, as a clause about a failed trim.

    Such servos hold their output while a command changes little, so a solver may find no trim.
    Returns "" if no servo of the model has a hysteresis.
    """
    members = {} if model is None else model_files(model).members
    if not any(b"<hysteresis_width>" in content for content in members.values()):
        return ""
    return "; servos of the model have a hysteresis_width, which hides a small command: remove it"


def _read_by_model(model: Path) -> list[str]:
    """List the properties that the control systems of a model read or declare.

    Properties that a component writes are left out.
    """
    inputs_of_components: set[str] = set()
    written: set[str] = set()
    for content in model_files(model).members.values():
        tree = ElementTree.fromstring(content)  # noqa: S314 - model_files has read it
        for element in chain.from_iterable(
            section.iter() for section in tree.iter() if section.tag in SYSTEMS
        ):
            text = (element.text or "").strip()
            if element.tag in {"input", "p", "property"}:
                inputs_of_components.add(text.lstrip("-"))
            elif element.tag == "output":
                written.add(text)
            elif name := element.get("name"):
                written |= {name, f"fcs/{'-'.join(name.lower().split())}"}
    return sorted(
        path
        for path in inputs_of_components - written
        if path.startswith("fcs/") and not path.endswith(CONVENTION)
    )
