# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""The graph of a flight: which nodes there are and what each is told. The launch file and the runner both read it here."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import yaml

from aircraft_sim.uncertainty import as_yaml
from flight_analysis.scenario import SCHEMAS, Scenario
from flight_bringup.provenance import provenance
from flight_core.parameters import ParameterError, Parameters
from flight_recorder.bag import Enclosed


class NodeSpec(NamedTuple):
    """One process of a flight."""

    package: str
    executable: str  # also the node's name, and its section in a scenario

    @property
    def module(self) -> str:
        """The Python module behind the executable."""
        return f"{self.package}.node"


RECORDER = NodeSpec("flight_recorder", "recorder")
AIRCRAFT = NodeSpec("aircraft_sim", "aircraft")
REFERENCE_MODEL = NodeSpec("reference_model", "reference_model")
CONTROLLER = NodeSpec("rise_di_controller", "controller")

# All four as objects in one process, for lockstep; each reads its own section of the scenario.
ONE_PROCESS = NodeSpec("flight_bringup", "one_process")

# These start first, and say that they are ready before the others start: the whole flight is then in the log, and the
# aircraft is never without its controller. The recorder ends last.
FIRST = (RECORDER, CONTROLLER)
THEN = (AIRCRAFT, REFERENCE_MODEL)

READY = "]: ready"  # what a node says in its log when its loop begins
FLOWN = "]: flown to its end"  # what the aircraft says at the end of a lockstep flight


def start_lead(startup: float) -> float:
    """Time to leave from starting the second two nodes to t = 0, s, given how long the first two took to be ready.

    As long again, half of that for a machine that got busier, and half a second for the nodes to find each other.
    """
    return 0.5 + 1.5 * startup


# Files made in the folder of a run, for its log
AIRFRAME = "airframe.yaml"
PARAMETERS = "parameters.yaml"
PROVENANCE = "provenance.yaml"

Told = dict[str, str | float | bool | list[str]]


def parameters(node: NodeSpec, scenario: Scenario, run: Path, start_time: float, *, lockstep: bool) -> Told:
    """What a process is told beside its section of the scenario file, by name; "node:name" where it holds several nodes.

    In real time those that start last are told the instant of t = 0. In lockstep the aircraft is told at which instants it
    waits for u and where the flight ends, and the controller how often y comes. The recorder is told what to store inside the
    log, which is made in the folder of the run.
    """
    together = node is ONE_PROCESS
    told_by = {one: _told(one, scenario, run, lockstep=lockstep, together=together) for one in (*FIRST, *THEN)}
    if node in (RECORDER, ONE_PROCESS):
        told_by[RECORDER] |= _stored(enclosed(scenario, run, {one.executable: told for one, told in told_by.items()}))
    if together:
        return {f"{one.executable}:{name}": value for one, told in told_by.items() for name, value in told.items()}
    return told_by[node] | ({"start_time": start_time} if node in THEN and not lockstep else {})


def _told(node: NodeSpec, scenario: Scenario, run: Path, *, lockstep: bool, together: bool) -> Told:
    told: Told = {"lockstep": lockstep}
    if node is RECORDER:
        told["directory"] = str(run)
    if node is AIRCRAFT and lockstep:
        told |= {"control_rate": scenario.controller.rate, "duration": scenario.flight.duration}
        told["recorded"] = not together  # a log in the same process is never behind
    if node is CONTROLLER and lockstep:
        told["y_rate"] = scenario.aircraft.rate
    return told


def _stored(files: Enclosed) -> Told:
    return {
        "scenario_file": str(files.scenario),
        "attach": [str(path) for path in files.attached],
        "metadata_file": str(files.metadata),
    }


def enclosed(scenario: Scenario, run: Path, told: Mapping[str, Told] | None = None) -> Enclosed:
    """What the log of a flight holds beside its messages; what is no file yet is made in the folder of the run.

    The scenario, the airframe that flies, every parameter as the nodes validate it (`told`, by the node's name, over the
    scenario; nothing where the flight has no nodes), and `provenance`. Raises ParameterError where it cannot be written.
    """
    attached = [_write(run / PARAMETERS, _as_flown(scenario, told or {}))]
    if not scenario.aircraft.is_jsbsim:
        attached.append(_write(run / AIRFRAME, as_yaml(scenario.aircraft.drawn())))
    notes = _write(run / PROVENANCE, yaml.safe_dump(provenance(), sort_keys=False))
    return Enclosed(scenario.path, tuple(attached), notes)


def _write(path: Path, text: str) -> Path:
    try:
        path.write_text(text, encoding="utf-8")
    except OSError as error:
        raise ParameterError(f"{path} cannot be written ({error.strerror}), expected a folder and a disk that can") from None
    return path


def _as_flown(scenario: Scenario, told: Mapping[str, Told]) -> str:
    """A scenario file with every parameter in it, also those by default; what is left out or none is so by default."""
    sections = {}
    for name, schema in SCHEMAS.items():
        given: Parameters = getattr(scenario, name)
        flown = schema.validate_mapping(given.model_dump() | told.get(name, {}), name)
        # The instant of t = 0 is not known before all nodes run; `truth` says it.
        sections[f"/**/{name}"] = {"ros__parameters": _plain(flown.model_dump(exclude={"start_time"}))}
    return yaml.safe_dump(sections, sort_keys=False, default_flow_style=None, width=128)


def _plain(values: Any) -> Any:
    """Values as YAML knows them, without those that stand for nothing: None, and empty texts, lists and mappings."""
    if isinstance(values, Mapping):
        plain = {key: _plain(value) for key, value in values.items()}
        return {key: value for key, value in plain.items() if value not in (None, "", [], {})}
    return [_plain(value) for value in values] if isinstance(values, tuple) else values
