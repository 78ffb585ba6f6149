# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""The topics of a flight.

Each row has the name, the message, the publishers, the subscribers and the meaning of a topic.
Transport, recorder and launch read this table. From it, `python -m tools.topics` writes the table
of docs/topics.md and the access control policy.
"""

from importlib import import_module
from typing import Any, NamedTuple

EXTERNAL = "external"  # publishers and subscribers that do not belong to the stack
NODES = ("aircraft", "reference_model", "guidance", "controller", "learner", "recorder", "bridge")
LOG = "log"  # stands for the recorder among the subscribers
HISTORY = "2 s"  # a publisher keeps the samples of two seconds for a late subscriber
LAST = "last"  # a publisher keeps the last message for a late subscriber
NOTHING = "-"  # a publisher keeps nothing, and nothing is sent again

VECTOR = "sensor_msgs/msg/JointState"
DIAGNOSTIC = "diagnostic_msgs/msg/DiagnosticArray"
KEY_VALUE = "diagnostic_msgs/msg/KeyValue"
TIME = "builtin_interfaces/msg/Time"
PLAN = "nav_msgs/msg/Path"


class Topic(NamedTuple):
    """A topic, with its name relative to the namespace."""

    name: str
    message: str | type  # class of the message, or its name, such as "sensor_msgs/msg/JointState"
    # publishers and subscribers, such as "aircraft, bridge -> controller, log", where "nodes"
    # stands for all NODES
    ends: str = "->"
    meaning: str = ""  # channels, units and use, in Markdown
    keeps: str = HISTORY  # what a publisher keeps for a late subscriber
    only_with: str = ""  # the topic is recorded only with this node or section

    @property
    def publishers(self) -> list[str]:
        """Names of the nodes that publish the topic."""
        return _names(self.ends.partition("->")[0])

    @property
    def subscribers(self) -> list[str]:
        """Names of the nodes that subscribe to the topic, and LOG if it is recorded."""
        return _names(self.ends.partition("->")[2])

    @property
    def is_foreign(self) -> bool:
        """Whether programs outside of the stack publish the topic, possibly at another QoS."""
        return EXTERNAL in self.publishers

    @property
    def type(self) -> Any:
        """Class of the messages.

        Raises ImportError or AttributeError if the package lacks the message.
        """
        if not isinstance(self.message, str):
            return self.message
        package, _, name = self.message.partition("/msg/")
        return getattr(import_module(f"{package}.msg"), name)


def _names(end: str) -> list[str]:
    return end.replace("nodes", ",".join(NODES)).replace(",", " ").split()


Y = Topic(
    "y", VECTOR, "aircraft, bridge -> controller, guidance, log",
    "outputs: q, V, p, r (rad/s, m/s)",
)  # fmt: skip
Y_M = Topic("y_m", VECTOR, "reference_model -> controller, log", "the same")
U = Topic(
    "u", VECTOR, "controller -> aircraft, bridge, log",
    "elevator, aileron, rudder (rad), thrust (1); stamp = [that of its y](#time)",
)  # fmt: skip
U_M = Topic(
    "u_m", VECTOR, "guidance, external -> reference_model, log",
    "[live commands](#live-commands) by output; optional phi, theta (rad)",
)  # fmt: skip
POSE = Topic(
    "pose", VECTOR, "aircraft, bridge -> guidance, log",
    "[known](#pose-and-wind) of phi, theta, psi, beta (rad), north, east, altitude (m), v_north, "
    "v_east, climb (m/s)",
)  # fmt: skip
GUIDANCE = Topic(
    "guidance", VECTOR, "guidance -> log",
    "modes, leg, fence, errors, commands, limits, wind, y and pose as used: "
    "`flight_guidance.guidance_log.names`",
)  # fmt: skip
TARGET = Topic(
    "target", VECTOR, "external -> guidance, log",
    "phi (and r), heading or course (rad), leg (joined at `along`, m), or orbit (north, "
    "east, radius, m); theta, climb or altitude; V",
)  # fmt: skip
ROUTE = Topic(
    "route", PLAN, "external -> guidance, log",
    "in the frame `map` (east, north, altitude)",
)  # fmt: skip
ODOMETRY = Topic(
    "odometry", "nav_msgs/msg/Odometry", "guidance -> external, log",
    "at 10 Hz, east-north-up",
    only_with="guidance",
)  # fmt: skip
PATH = Topic(
    "path", PLAN, "guidance -> external, log",
    "at 1 Hz, east-north-up",
    only_with="guidance",
)  # fmt: skip
MARKERS = Topic(
    "markers", "visualization_msgs/msg/MarkerArray", "guidance -> external, log",
    "at 1 Hz, east-north-up",
    only_with="guidance",
)  # fmt: skip
IMU = Topic(
    "guidance/imu", "sensor_msgs/msg/Imu", "guidance -> external, log",
    "at 10 Hz",
    only_with="guidance",
)  # fmt: skip
FIX = Topic(
    "guidance/fix", "sensor_msgs/msg/NavSatFix", "guidance -> external, log",
    "at 10 Hz",
    only_with="guidance",
)  # fmt: skip
WIND = Topic(
    "guidance/wind", "geometry_msgs/msg/Vector3Stamped", "guidance -> external, log",
    "at 10 Hz",
    only_with="guidance",
)  # fmt: skip
INTERNALS = Topic("internals", VECTOR, "controller -> guidance, learner, monitor, log", "below")
TRUTH = Topic("truth", VECTOR, "aircraft -> log", "below")
PROPOSAL = Topic(
    "proposal", DIAGNOSTIC, "learner -> controller, log",
    "what was learned, digests, parameters as JSON",
    only_with="learner",
)  # fmt: skip
LEARNED = Topic(
    "learned", VECTOR, "learner -> log",
    "`proposed` (1 or 0), `value.*` and `deviation.*` of each learned entry of A and B, SI, "
    "`parameters` that are proposed, [`guarantee.*`](learning.md#the-guarantee-of-a-model)",
    only_with="learner",
)  # fmt: skip
LEARNING = Topic(
    "learning", DIAGNOSTIC, "controller -> monitor, log",
    "what became of a proposal, and fallbacks; the kind is the value `event`",
    only_with="learner",
)  # fmt: skip
AUTHORITY = Topic(
    "authority", VECTOR, "controller -> guidance, log",
    "`down.*`, `up.*` by output: [least change](guidance.md#limits-that-were-learned) by its "
    "input, units/s",
    only_with="learner",
)  # fmt: skip
EFFECTS = Topic(
    "effects", VECTOR, "controller -> bridge, log",
    "by input: the largest [part of its effect](laws.md#stuck-surfaces) that fits the last "
    "seconds, 1e9 without a probe",
    only_with="probe",
)  # fmt: skip
DIAGNOSTICS = Topic(
    "/diagnostics", DIAGNOSTIC, "nodes, external -> log",
    "at 1 Hz: times of ticks, refused samples by reason, mode, law",
)  # fmt: skip
ROSOUT = Topic(
    "/rosout", "rcl_interfaces/msg/Log", "nodes, monitor, external -> log",
    "log lines",
)  # fmt: skip
PARAMETER_EVENTS = Topic(
    "/parameter_events", "rcl_interfaces/msg/ParameterEvent", "nodes, monitor, external -> log",
    "changes of parameters",
)  # fmt: skip
WOULD_SEND = Topic(
    "bridge/would_send", VECTOR, "bridge -> log",
    "raw values of the autopilot's fields for the newest u, also in a dry run",
    only_with="bridge",
)  # fmt: skip
ENGAGEMENT = Topic(
    "bridge/engagement", KEY_VALUE, "bridge -> monitor, log",
    "DISENGAGED, ENGAGING, ENGAGED, NEUTRAL or RELEASE, and why",
    only_with="bridge",
)  # fmt: skip
START = Topic(
    "start", TIME, "monitor -> aircraft, reference_model, guidance",
    "t = 0 of a flight in real time",
    keeps=LAST,
)  # fmt: skip
NODE_STATE = Topic(
    "node_state", KEY_VALUE, "nodes -> monitor",
    "instance, and `ready`, `matched`, `flying` or `completed`",
    keeps=LAST,
)  # fmt: skip
CLOCKS = Topic(
    "clocks", VECTOR, "nodes -> nodes",
    "in real time, at 1 Hz: least [reception less sending](fleets.md#two-hosts) by node, s",
    keeps=NOTHING,
)  # fmt: skip
CLOCK = Topic(
    "clock", "rosgraph_msgs/msg/Clock", "aircraft -> reference_model",
    "in lockstep: the instant up to which the aircraft flies without another u",
)  # fmt: skip
SIMULATED_CLOCK = Topic(
    "/clock", "rosgraph_msgs/msg/Clock", "external -> nodes",
    "with `use_sim_time`: the time of [a simulator](ros.md#by-the-clock-of-a-simulator)",
    NOTHING,
)  # fmt: skip
RECORDED = Topic(
    "recorded", TIME, "recorder -> aircraft, monitor",
    "the instant up to which the log is complete",
)  # fmt: skip

TOPICS = tuple(row for row in list(globals().values()) if isinstance(row, Topic))
FLIGHT = tuple(topic for topic in TOPICS if LOG in topic.subscribers and not topic.only_with)


def recorded_with(node: str) -> list[str]:
    """List the topics that are recorded only if a flight has a certain node or section."""
    return [topic.name for topic in TOPICS if topic.only_with == node]


def published_by(node: str) -> list[str]:
    """List the topics that a node publishes."""
    return [topic.name for topic in TOPICS if node in topic.publishers]
