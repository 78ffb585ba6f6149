# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""The topics of a flight: name, type and quality of service, in one place."""

from enum import StrEnum
from typing import NamedTuple

from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray, KeyValue
from geometry_msgs.msg import Vector3Stamped
from nav_msgs.msg import Odometry, Path
from rcl_interfaces.msg import Log
from rclpy.duration import Duration
from rclpy.qos import DurabilityPolicy, LivelinessPolicy, QoSProfile, ReliabilityPolicy
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import Imu, JointState, NavSatFix
from visualization_msgs.msg import MarkerArray

from flight_core.rates import NANOSECONDS

# Publishers are reliable and keep their last samples, so that a recorder that is matched late or delayed loses none. The depth
# is two seconds at 1 kHz, as that of the recorder; see `publisher_qos`.
PUBLISH = QoSProfile(depth=2000, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL)
# Control loops use the newest samples and no retransmissions. The depth covers the samples of y_m between two ticks, from which
# y_m is aligned to the stamp of y, and those of a conflicting publisher at 10 kHz, which would otherwise displace a u.
NEWEST_SAMPLES = QoSProfile(depth=128, reliability=ReliabilityPolicy.BEST_EFFORT)
# A lockstep flight needs every sample from the first one on, also of a subscriber that is matched late. The depth is for speed:
# with a full history, Fast DDS requests an acknowledgement of each sample.
LOCKSTEP = QoSProfile(depth=20_000, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL)
# The middleware reports the loss of liveliness. It asserts it every two thirds of the lease, so a process that the host stops
# for less than the other third, 0.6 s, is never lost. With a lease of 1 s, 2 of 20 stops of 0.4 s lost the process. The lease
# is shorter than that of the participant, 2 s, which does not tell a kill from a clean end. The only message of a node is the
# name of the role that it lost, before it ends.
LIVELINESS = QoSProfile(
    depth=1,
    reliability=ReliabilityPolicy.RELIABLE,
    liveliness=LivelinessPolicy.AUTOMATIC,
    liveliness_lease_duration=Duration(seconds=1.8),
)
RECORD = QoSProfile(depth=2000, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL)
# For topics of other publishers, which may not keep samples. If a publisher offers less, the recorder requests less.
RECORD_FOREIGN = QoSProfile(depth=2000, reliability=ReliabilityPolicy.RELIABLE)

# A proposal is rare, so none may be lost. One from before the start of the controller is void. The depth is as that of
# NEWEST_SAMPLES.
PROPOSALS = QoSProfile(depth=128, reliability=ReliabilityPolicy.RELIABLE)

# A late subscriber gets the last state of each node. The queue of a subscriber holds the states of many nodes.
STATE = QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL)
STATES = QoSProfile(depth=100, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL)

HISTORY_NS = 2 * NANOSECONDS


def publisher_qos(period_ns: int) -> QoSProfile:
    """PUBLISH at a rate, with a history of two seconds.

    A longer history would delay the flight when a recorder joins: the threads that send new samples send the history at once.
    """
    return QoSProfile(
        depth=min(max(HISTORY_NS // period_ns, 1), PUBLISH.depth),
        reliability=PUBLISH.reliability,
        durability=PUBLISH.durability,
    )


class NodeState(StrEnum):
    """State of a node on `node_state`, in order. READY: its event loop runs. MATCHED, in real time: each input has a publisher.

    FLYING: the aircraft has taken the first u of a flight in real time. COMPLETED: it has completed a lockstep flight.
    """

    READY = "ready"
    MATCHED = "matched"
    FLYING = "flying"
    COMPLETED = "completed"


class Topic(NamedTuple):
    """A topic by its relative name."""

    name: str
    type: type
    foreign: bool = False  # published by other nodes than those of this stack


Y = Topic("y", JointState)
Y_M = Topic("y_m", JointState)
U = Topic("u", JointState)
POSE = Topic("pose", JointState)  # phi, theta, psi, north, east, altitude, v_north, v_east, climb: those that are known
U_M = Topic("u_m", JointState, foreign=True)
TARGET = Topic("target", JointState, foreign=True)  # what to hold: channels of flight_guidance.modes.Target
ROUTE = Topic("route", Path, foreign=True)  # waypoints in the frame map: east, north, altitude
GUIDANCE = Topic("guidance", JointState)
ODOMETRY = Topic("odometry", Odometry)
PATH = Topic("path", Path)
MARKERS = Topic("markers", MarkerArray)
IMU = Topic("guidance/imu", Imu)
FIX = Topic("guidance/fix", NavSatFix)
WIND = Topic("guidance/wind", Vector3Stamped)
INTERNALS = Topic("internals", JointState)
TRUTH = Topic("truth", JointState)
DIAGNOSTICS = Topic("/diagnostics", DiagnosticArray, foreign=True)
ROSOUT = Topic("/rosout", Log, foreign=True)  # of ROS 2 itself
CLOCK = Topic("clock", Clock)  # relative: each aircraft in lockstep has its own
RECORDED = Topic("recorded", Time)  # in lockstep: the instant up to which the log is complete
CLOCKS = Topic("clocks", JointState)  # of each other node: the least (own clock at reception) - (its clock at sending), s
ENGAGEMENT = Topic("bridge/engagement", KeyValue)  # key: the phase of the bridge; value: why it is not engaged
PROPOSAL = Topic("proposal", DiagnosticArray)  # of a learner: flight_ros.reports
LEARNED = Topic("learned", JointState)  # the entries of A and B that a learner identified
LEARNING = Topic("learning", DiagnosticArray)  # what became of a proposal, and fallbacks
AUTHORITY = Topic("authority", JointState)  # what the inputs can do at least, as learned in flight: for guidance
START = Topic("start", Time)  # t = 0 of a flight in real time, once its nodes are matched
NODE_STATE = Topic("node_state", KeyValue)  # key: the process, "/controller#4711"; value: a NodeState

FLIGHT = (Y, Y_M, U, U_M, POSE, GUIDANCE, TARGET, ROUTE, INTERNALS, TRUTH, DIAGNOSTICS)
