# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""The topics of a flight: name, type and quality of service, in one place."""

from enum import StrEnum
from typing import NamedTuple

from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray, KeyValue
from rclpy.duration import Duration
from rclpy.qos import DurabilityPolicy, LivelinessPolicy, QoSProfile, ReliabilityPolicy
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import JointState

from flight_core.rates import NANOSECONDS

# Publishers are reliable and keep their last samples, so that a recorder that is matched a moment late, or held up, loses
# nothing. The depth covers two seconds at 1 kHz, as that of the recorder does; see `publisher_qos`.
PUBLISH = QoSProfile(depth=2000, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL)
# Control loops want the newest samples and never a retransmission. The depth covers the samples between two ticks
# that are needed to bring y_m to the stamp of y, and those of a stranger at 10 kHz beside them: a u that these had displaced
# would be lost.
NEWEST_SAMPLES = QoSProfile(depth=128, reliability=ReliabilityPolicy.BEST_EFFORT)
# In lockstep every sample counts, from the first one on, whoever is matched late. The depth is for speed: with a history that
# is full, Fast DDS asks for an acknowledgement of each sample.
LOCKSTEP = QoSProfile(depth=20_000, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL)
# Nothing is ever sent with it: the middleware itself says when the process behind it no longer lives. Long enough for one
# that a busy machine leaves waiting, short enough to end the others within two seconds.
LIVELINESS = QoSProfile(depth=1, liveliness=LivelinessPolicy.AUTOMATIC, liveliness_lease_duration=Duration(seconds=1.0))
RECORD = QoSProfile(depth=2000, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL)
# For topics that others publish, whose kept samples cannot be counted on; where one of them offers less, the recorder asks for
# less.
RECORD_FOREIGN = QoSProfile(depth=2000, reliability=ReliabilityPolicy.RELIABLE)

# A late subscriber gets the last state of each node. The queue of a subscriber holds the states of many nodes.
STATE = QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL)
STATES = QoSProfile(depth=100, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL)

HISTORY_NS = 2 * NANOSECONDS


def publisher_qos(period_ns: int) -> QoSProfile:
    """PUBLISH at a rate: it keeps what it publisher_qos in the last two seconds.

    More would hold a flight back when a recorder comes: it is sent at once, by the threads that send what is new.
    """
    return QoSProfile(
        depth=min(max(HISTORY_NS // period_ns, 1), PUBLISH.depth),
        reliability=PUBLISH.reliability,
        durability=PUBLISH.durability,
    )


class NodeState(StrEnum):
    """What a node publishes on `node_state`: its loop begins; the aircraft has flown a lockstep flight to its end."""

    READY = "ready"
    COMPLETED = "completed"


class Topic(NamedTuple):
    """A topic by its relative name."""

    name: str
    type: type
    foreign: bool = False  # publisher_qos by others than this stack's nodes


Y = Topic("y", JointState)
Y_M = Topic("y_m", JointState)
U = Topic("u", JointState)
U_M = Topic("u_m", JointState, foreign=True)
INTERNALS = Topic("internals", JointState)
TRUTH = Topic("truth", JointState)
DIAGNOSTICS = Topic("/diagnostics", DiagnosticArray, foreign=True)
CLOCK = Topic("/clock", Clock)
RECORDED = Topic("recorded", Time)  # in lockstep: the instant up to which the log is complete
NODE_STATE = Topic("node_state", KeyValue)  # key: the process, "/controller#4711"; value: a NodeState

FLIGHT = (Y, Y_M, U, U_M, INTERNALS, TRUTH, DIAGNOSTICS)
