# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""The graph of a flight: which nodes there are and what each is told. The launch file and the runner both read it here."""

from pathlib import Path
from typing import NamedTuple

from aircraft_sim.uncertainty import as_yaml
from flight_analysis.scenario import Scenario


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


Told = dict[str, str | float | bool | list[str]]


def parameters(node: NodeSpec, scenario: Scenario, run: Path, start_time: float, *, lockstep: bool) -> Told:
    """What a process is told beside its section of the scenario file, by name; "node:name" where it holds several nodes.

    In real time those that start last are told the instant of t = 0. In lockstep the aircraft is told at which instants it
    waits for u and where the flight ends, and the controller how often y comes.
    """
    if node is ONE_PROCESS:
        told_by = {one: parameters(one, scenario, run, start_time, lockstep=lockstep) for one in (*FIRST, *THEN)}
        told_by[AIRCRAFT]["recorded"] = False  # a log in the same process is never behind
        return {f"{one.executable}:{name}": value for one, told in told_by.items() for name, value in told.items()}
    told: Told = {"lockstep": lockstep}
    if node is RECORDER:
        told |= {"directory": str(run), "scenario_file": str(scenario.path)}
        if attached := attachments(scenario, run):
            told["attach"] = [str(path) for path in attached]
    if node is AIRCRAFT and lockstep:
        told |= {"control_rate": scenario.controller.rate, "duration": scenario.flight.duration, "recorded": True}
    if node is CONTROLLER and lockstep:
        told["y_rate"] = scenario.aircraft.rate
    if node in THEN and not lockstep:
        told["start_time"] = start_time
    return told


def attachments(scenario: Scenario, run: Path) -> list[Path]:
    """Files that belong into the log beside the scenario, made in the folder of the run: the airframe drawn where it is one."""
    chance = scenario.aircraft.uncertainty
    if chance.A == chance.B == 0.0:
        return []
    path = run / "airframe.yaml"
    path.write_text(as_yaml(scenario.aircraft.drawn()), encoding="utf-8")
    return [path]
