# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""The graph of a flight: which nodes there are and what each is told. The launch file and the runner both read it here."""

from collections.abc import Collection, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import NamedTuple

from autopilot_bridge.params import ChannelMap, find_map, load_map
from flight_analysis.closed_loop.scenario import ParameterOverrides, Scenario
from flight_analysis.report.run_folder import enclosed
from flight_log.bag import Enclosed


class NodeSpec(NamedTuple):
    """One process of a flight."""

    package: str
    executable: str  # also the node's name, and its section in a scenario

    @property
    def module(self) -> str:
        """The Python module behind the executable."""
        return f"{self.package}.main"


RECORDER = NodeSpec("flight_recorder", "recorder")
AIRCRAFT = NodeSpec("aircraft_sim", "aircraft")
REFERENCE_MODEL = NodeSpec("reference_model", "reference_model")
CONTROLLER = NodeSpec("rise_di_controller", "controller")
BRIDGE = NodeSpec("autopilot_bridge", "bridge")

# All four as objects in one process, for lockstep; each reads its own section of the scenario.
ONE_PROCESS = NodeSpec("flight_bringup", "one_process")

# These start first, and say that they are ready before the others start: the whole flight is then in the log, and the
# aircraft is never without its controller. The recorder ends last.
FIRST = (RECORDER, CONTROLLER)
THEN = (AIRCRAFT, REFERENCE_MODEL)
BRIDGED = (BRIDGE, REFERENCE_MODEL)  # with an autopilot in the aircraft's place

WOULD_SEND = "bridge/would_send"

# What each node says of a flight; the bridge also what its map sends to the autopilot.
PUBLISHED_TOPICS: Mapping[NodeSpec, tuple[str, ...]] = MappingProxyType(
    {
        AIRCRAFT: ("y", "truth"),
        REFERENCE_MODEL: ("y_m",),
        CONTROLLER: ("u", "internals"),
        BRIDGE: ("y", WOULD_SEND),
        RECORDER: ("recorded",),
    }
)

READY = "]: ready"  # what a node says in its log when its loop begins
FLOWN = "]: flown to its end"  # what the aircraft says at the end of a lockstep flight


class Autopilot(NamedTuple):
    """What flies in the aircraft's place."""

    channel_map: ChannelMap
    path: Path  # of the map
    dry_run: bool  # say what would be sent, and send nothing

    @property
    def topics(self) -> list[str]:
        """What is recorded of it: the autopilot's own topics, and what the bridge makes of u for them."""
        return [*self.channel_map.topics, WOULD_SEND]


def find_autopilot(map_name: str, *, dry_run: bool) -> Autopilot:
    """An autopilot by the name of its channel map, or the path of one. Raises ParameterError."""
    return Autopilot(load_map(map_name), find_map(map_name), dry_run)


def start_lead(startup: float) -> float:
    """Time to leave from starting the second two nodes to t = 0, s, given how long the first two took to be ready.

    As long again, half of that for a machine that got busier, and half a second for the nodes to find each other.
    """
    return 0.5 + 1.5 * startup


def parameters(
    node: NodeSpec, scenario: Scenario, run: Path, start_time: float, *, lockstep: bool, autopilot: Autopilot | None = None
) -> ParameterOverrides:
    """What a process is told beside its section of the scenario file, by name; "node:name" where it holds several nodes.

    In real time those that start last are told the instant of t = 0. In lockstep the aircraft is told at which instants it
    waits for u and where the flight ends, and the controller how often y comes. The recorder is told what to store inside the
    log, which is made in the folder of the run. With an autopilot in the aircraft's place the bridge is told its map, and the
    recorder the topics of the autopilot.
    """
    if node is BRIDGE:
        return {} if autopilot is None else {"map": str(autopilot.path), "dry_run": autopilot.dry_run}
    together = node is ONE_PROCESS
    told_by = {one: _told(one, scenario, run, lockstep=lockstep, together=together) for one in (*FIRST, *THEN)}
    if node in (RECORDER, ONE_PROCESS):
        further = () if autopilot is None else (autopilot.path,)
        if autopilot is not None:
            told_by[RECORDER]["topics"] = [*scenario.recorder.topics, *autopilot.topics]
        told_by[RECORDER] |= _stored(enclosed(scenario, run, {one.executable: told for one, told in told_by.items()}, further))
    if together:
        return {f"{one.executable}:{name}": value for one, told in told_by.items() for name, value in told.items()}
    return told_by[node] | ({"start_time": start_time} if node in THEN and not lockstep else {})


def to_play(
    known: Collection[str], nodes: Collection[NodeSpec], namespace: str = "", autopilot: Autopilot | None = None
) -> list[str]:
    """Which of the topics of a log are played to nodes: those that none of the nodes says itself; full names, in order.

    `known` are the topics of the log by their full names, `namespace` is that of the nodes. With a bridge among the nodes what
    its map sends is left out too.
    """
    within = f"/{namespace.strip('/')}/".replace("//", "/")
    said = {within + name for node in nodes for name in PUBLISHED_TOPICS[node]}
    if BRIDGE in nodes and autopilot is not None:
        sent = (message.topic for message in autopilot.channel_map.messages.values())
        said |= {topic if topic.startswith("/") else within + topic for topic in sent}
    return sorted(set(known) - said)


def _told(node: NodeSpec, scenario: Scenario, run: Path, *, lockstep: bool, together: bool) -> ParameterOverrides:
    told: ParameterOverrides = {"lockstep": lockstep}
    if node is RECORDER:
        told["directory"] = str(run)
    if node is AIRCRAFT and lockstep:
        told |= {"control_rate": scenario.controller.rate, "duration": scenario.flight.duration}
        told["recorded"] = not together  # a log in the same process is never behind
    if node is CONTROLLER and lockstep:
        told["y_rate"] = scenario.aircraft.rate
    return told


def _stored(files: Enclosed) -> ParameterOverrides:
    return {
        "scenario_file": str(files.scenario),
        "attach": [str(path) for path in files.attached],
        "metadata_file": str(files.metadata),
    }
