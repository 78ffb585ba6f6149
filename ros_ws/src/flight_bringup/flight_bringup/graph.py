# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Define which nodes a flight has, in which order they start, and with which parameters.

The launch files and `rise-di fly` share this module.
"""

import re
from collections.abc import Collection
from pathlib import Path
from typing import NamedTuple

from autopilot_bridge.params import ChannelMap, find_map, load_map
from flight_analysis.closed_loop.scenario import ParameterOverrides, Scenario, require_guidable
from flight_analysis.report.run_folder import attachments_for
from flight_core import topics
from flight_core.parameters import require
from rise_di_controller.learning.proposals import AUTHORITY_TICKS


class NodeSpec(NamedTuple):
    """Package and executable of a node of a flight, or of a process with all nodes."""

    package: str
    executable: str  # also the name of the node, and of its section in a scenario

    @property
    def module(self) -> str:
        """The Python module behind the executable."""
        return f"{self.package}.main"


RECORDER = NodeSpec("flight_recorder", "recorder")
AIRCRAFT = NodeSpec("aircraft_sim", "aircraft")
REFERENCE_MODEL = NodeSpec("reference_model", "reference_model")
GUIDANCE = NodeSpec("flight_guidance", "guidance")
CONTROLLER = NodeSpec("rise_di_controller", "controller")
LEARNER = NodeSpec("flight_design", "learner")
BRIDGE = NodeSpec("autopilot_bridge", "bridge")

# All nodes in one process. Each reads its section of the scenario.
ONE_PROCESS = NodeSpec("flight_bringup", "one_process")

# The second stage starts once every node of the first stage is ready. So the log holds the whole
# flight, and the aircraft always has a controller.
FIRST_STAGE = (RECORDER, CONTROLLER)
SECOND_STAGE = (AIRCRAFT, REFERENCE_MODEL)
SECOND_STAGE_WITH_BRIDGE = (BRIDGE, REFERENCE_MODEL)

# A word of a namespace. ROS 2 would permit _ at the ends of the word too.
NAME = re.compile(r"[A-Za-z](_?[A-Za-z0-9])*")


def absolute_namespace(namespace: str) -> str:
    """Return the namespace of an aircraft in the form "/uav1". The root namespace is "".

    Raises ParameterError if a word does not match NAME.
    """
    words = [word for word in namespace.split("/") if word]
    for word in words:
        require(
            bool(NAME.fullmatch(word)),
            "--namespace",
            repr(namespace),
            "words such as uav1: a letter, then letters and digits, with single _ between them",
        )
    return "".join(f"/{word}" for word in words)


class Autopilot(NamedTuple):
    """An autopilot that takes the place of the simulated aircraft."""

    channel_map: ChannelMap
    map_path: Path
    dry_run: bool  # whether the bridge only publishes on `bridge/would_send` what it would send

    @property
    def topics(self) -> list[str]:
        """The topics to record: the topics of the channel map and the topics of the bridge."""
        return [*self.channel_map.recorded_topics, *topics.recorded_with("bridge")]


def find_autopilot(map_name: str, *, dry_run: bool) -> Autopilot:
    """Find an autopilot by the name or the path of its channel map.

    Raises ParameterError if there is no such map, or if it is invalid.
    """
    return Autopilot(load_map(map_name), find_map(map_name), dry_run)


def require_limits(autopilot: Autopilot, scenario: Scenario) -> None:
    """Check that the bridge can send all that the controller may command.

    If the bridge could not, it would clip u, and the anti-windup of the law would not know of it.
    The limits of the scenario are not narrowed to those of the map, because the scenario in the log
    would then differ from the parameters in use. A dry run sends nothing, so it passes the check.
    The check fails for a controller that holds u while it is inactive, because the bridge engages
    only if u is near trim. Raises ParameterError if the check fails.
    """
    if autopilot.dry_run:
        return
    channel_map = autopilot.channel_map
    controller = scenario.controller
    key = f"scenario {scenario.name}: controller"
    on_deactivate = controller.on_deactivate
    require(
        on_deactivate == "trim",
        f"{key}.on_deactivate",
        repr(on_deactivate),
        "'trim' with a bridge, which engages only from a u near trim",
    )
    limits = controller.effector_limits()
    for name, low, high in zip(
        controller.effectors, limits.lower.tolist(), limits.upper.tolist(), strict=True
    ):
        if (row := channel_map.inputs.get(name)) is None:
            # A different check refuses channels that differ, and names them.
            continue
        of_map = (
            f"of {name} in the map {channel_map.name}: the law's anti-windup does not know what "
            "the bridge clips"
        )
        require(
            low >= row.lower,
            f"{key}.lower",
            f"{low:g}",
            f"at least {row.lower:g}, the lower limit {of_map}",
        )
        require(
            high <= row.upper,
            f"{key}.upper",
            f"{high:g}",
            f"at most {row.upper:g}, the upper limit {of_map}",
        )


def second_stage(scenario: Scenario, *, bridge: bool = False) -> tuple[NodeSpec, ...]:
    """Return the nodes that start second, when the recorder and the controller are ready.

    The nodes are the aircraft or the bridge, the reference model, and guidance and a learner if the
    scenario has them. Raises ParameterError if guidance cannot fly the simulated aircraft, or if a
    learner is to fly with a bridge.
    """
    if not bridge:
        require_guidable(scenario)
    learns = scenario.has_learner()
    expected = "a simulated aircraft: models from flights of autopilots fail the learner's checks"
    require(not (bridge and learns), "controller.learn", "a bridge", expected)
    stage = SECOND_STAGE_WITH_BRIDGE if bridge else SECOND_STAGE
    return (*stage, *_optional(scenario))


def _optional(scenario: Scenario) -> tuple[NodeSpec, ...]:
    """Return guidance and the learner if the scenario has them."""
    return tuple(
        node
        for node, has in (
            (GUIDANCE, scenario.guidance is not None),
            (LEARNER, scenario.has_learner()),
        )
        if has
    )


ON_START = -1.0  # `start_time` of nodes that wait for t = 0 on the topic `start`
# s, how long before t = 0 its instant is published on `start`, so that even a busy host delivers it
LEAD = 0.5


def start_lead(startup: float) -> float:
    """Return the time from the start of the second stage of nodes to t = 0, s.

    `startup` is the time, s, from the start of the first stage until its nodes were ready. The
    second stage gets 1.5 times this time, and half a second in which the nodes discover each other.
    """
    return 0.5 + 1.5 * startup


def start_instant(lead: float, now: float) -> float:
    """Return the time of t = 0, s, which is about `lead` after `now`.

    The result is a whole multiple of 0.01 s, so that nodes with and without `start_time` tick
    together.
    """
    return round(now + lead, 2)


def _airframe(scenario: Scenario) -> ParameterOverrides:
    """Return the path of the airframe as an override if it is absolute, else no override.

    The path is absolute if the file lies beside the scenario, in a folder that the nodes do not
    know.
    """
    airframe = scenario.aircraft.airframe
    return {"airframe": airframe} if Path(airframe).is_absolute() else {}


def parameter_overrides(
    spec: NodeSpec,
    scenario: Scenario,
    run: Path,
    start_time: float,
    *,
    lockstep: bool,
    use_sim_time: bool = False,
    autopilot: Autopilot | None = None,
    replaced: Collection[NodeSpec] = (),
) -> ParameterOverrides:
    """Return the parameters that a process needs beside its section of the scenario file.

    If several nodes share a process, the keys are "node:name". Each parameter goes to the nodes
    that need it:

    - In real time the nodes that begin at t = 0 get `start_time`, the instant of t = 0 or ON_START.
    - Every node but the bridge gets `lockstep`. In lockstep the aircraft gets the rate of u and the
      duration, controller and guidance get the rate of y, and the reference model gets the rate of
      u_m.
    - Guidance gets the parameters of `guidance_by_rule`. The learner gets the scenario.
    - The recorder gets the files to attach to the log. This function writes them into the folder of
      the run.
    - With an autopilot the bridge gets the channel map, the recorder the topics of the autopilot,
      and the controller starts inactive.
    - With `use_sim_time` every node ticks by /clock.

    `replaced` has the nodes that nodes of the user replace.
    """
    clock: ParameterOverrides = {"use_sim_time": True} if use_sim_time else {}
    if spec is BRIDGE:
        if autopilot is None:
            return clock
        return clock | {"map": str(autopilot.map_path), "dry_run": autopilot.dry_run}
    one_process = spec is ONE_PROCESS
    overrides = _stage_overrides(scenario, lockstep=lockstep)
    overrides[RECORDER] |= _recording(scenario, run, autopilot)
    if autopilot is not None:
        overrides[CONTROLLER]["start_active"] = False  # the bridge activates it, only while engaged
    if lockstep:
        for node, rates in _lockstep_rates(scenario).items():
            overrides[node] |= rates
        # A recorder in the same process never lags behind.
        overrides[AIRCRAFT]["recorded"] = not one_process
    if spec in (RECORDER, ONE_PROCESS):
        sections = {node.executable: values for node, values in overrides.items()}
        overrides[RECORDER] |= _attachments(scenario, run, sections, autopilot, replaced)
    if not lockstep:
        for node in (*SECOND_STAGE, GUIDANCE) if GUIDANCE in overrides else SECOND_STAGE:
            overrides[node]["start_time"] = start_time
    if not one_process:
        return overrides[spec] | clock
    if not lockstep:
        overrides.pop(LEARNER, None)  # the learner has a separate process
    return {
        f"{node.executable}:{name}": value
        for node, values in overrides.items()
        for name, value in (values | clock).items()
    }


def _stage_overrides(scenario: Scenario, *, lockstep: bool) -> dict[NodeSpec, ParameterOverrides]:
    """Return the parameters that the nodes of both stages need beside the scenario file, by node.

    Among them are the parameters of guidance that follow from other sections, and the learner's
    scenario file.
    """
    stages = (*FIRST_STAGE, *SECOND_STAGE, *_optional(scenario))
    overrides: dict[NodeSpec, ParameterOverrides] = {
        node: {"lockstep": lockstep} for node in stages
    }
    overrides[AIRCRAFT] |= _airframe(scenario)
    if scenario.guidance is not None:
        overrides[GUIDANCE] |= {
            name: list(value) if isinstance(value, tuple) else value
            for name, value in scenario.guidance.by_rule()
        }
        # Without a learner no controller publishes `authority`, so guidance must not wait for it.
        authority_rate = scenario.has_learner() * scenario.controller.rate / AUTHORITY_TICKS
        overrides[GUIDANCE]["authority_rate"] = authority_rate
    if scenario.has_learner():
        overrides[LEARNER]["scenario_file"] = str(scenario.path)
    return overrides


def _recording(scenario: Scenario, run: Path, autopilot: Autopilot | None) -> ParameterOverrides:
    """Return the recorder's parameters: its folder, and topics that not every flight has."""
    further: list[str] = []
    if scenario.guidance is not None:
        further += topics.recorded_with("guidance")
    if scenario.has_learner():
        further += topics.recorded_with("learner")
    if scenario.controller.probe:
        further += topics.recorded_with("probe")
    if autopilot is not None:
        further += autopilot.topics
    overrides = {"topics": [*scenario.recorder.topics, *further]} if further else {}
    return {"directory": str(run), **overrides}


def _lockstep_rates(scenario: Scenario) -> dict[NodeSpec, ParameterOverrides]:
    """Return, for each node of a lockstep flight, the rates of the inputs for which it waits.

    The aircraft also gets the duration of the flight.
    """
    guidance = scenario.guidance
    control_rate = scenario.controller.rate
    y_rate: ParameterOverrides = {"y_rate": scenario.aircraft.rate}
    rates: dict[NodeSpec, ParameterOverrides] = {
        AIRCRAFT: {"control_rate": control_rate, "duration": scenario.flight.duration},
        CONTROLLER: y_rate,
    }
    if guidance is not None:
        rates[GUIDANCE] = y_rate
        rates[REFERENCE_MODEL] = {"u_m_rate": guidance.rate}
    return rates


def _attachments(
    scenario: Scenario,
    run: Path,
    overrides: dict[str, ParameterOverrides],
    autopilot: Autopilot | None,
    replaced: Collection[NodeSpec],
) -> ParameterOverrides:
    """Write the files that the recorder attaches to the log, and return its parameters for them."""
    maps = () if autopilot is None else (autopilot.map_path,)
    others = replaced if autopilot is None else (AIRCRAFT,)
    names = [spec.executable for spec in others]
    files = attachments_for(scenario, run, overrides, maps, names)
    return {
        "scenario_file": str(files.scenario),
        "attach": [str(path) for path in files.files],
        "metadata_file": str(files.metadata),
    }


def replayed_topics(
    topics_of_log: Collection[str],
    nodes: Collection[NodeSpec],
    namespace: str = "",
    autopilot: Autopilot | None = None,
) -> list[str]:
    """Return the topics of a log that none of the nodes publishes, with full names, in order.

    `namespace` is the namespace of the nodes. If a bridge is among the nodes, it also publishes the
    messages of its channel map.
    """
    prefix = f"/{namespace.strip('/')}/".replace("//", "/")
    names = {name for node in nodes for name in topics.published_by(node.executable)}
    # Other nodes also publish on topics with an absolute name, so these topics of the log are
    # played.
    topics_of_nodes = {prefix + name for name in names if not name.startswith("/")}
    if BRIDGE in nodes and autopilot is not None:
        setpoint_topics = (message.topic for message in autopilot.channel_map.messages.values())
        topics_of_nodes |= {
            topic if topic.startswith("/") else prefix + topic for topic in setpoint_topics
        }
    return sorted(set(topics_of_log) - topics_of_nodes)
