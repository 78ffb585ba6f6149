# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Define the quality of service of the topics in flight_core.topics."""

from enum import StrEnum

from rclpy.duration import Duration
from rclpy.qos import DurabilityPolicy, LivelinessPolicy, QoSProfile, ReliabilityPolicy

from flight_core import topics as table
from flight_core.rates import NANOSECONDS
from flight_core.topics import *  # noqa: F403 - a node imports both from here


def kept(depth: int) -> QoSProfile:
    """Return a reliable profile that keeps the last `depth` messages for a late subscriber."""
    return QoSProfile(
        depth=depth,
        reliability=ReliabilityPolicy.RELIABLE,
        durability=DurabilityPolicy.TRANSIENT_LOCAL,
    )


# Publishers are reliable and keep their last samples, so that a recorder which is matched late or
# delayed loses no sample. The depth holds two seconds at 1 kHz, for publishers and for the
# recorder. See `publisher_qos`.
PUBLISH = RECORD = kept(2000)
# Control loops use the newest samples and no retransmissions. The depth suffices for the samples of
# y_m between two ticks, from which y_m is aligned to the stamp of y. It also suffices for a
# conflicting publisher at 10 kHz, whose samples would otherwise displace a u.
NEWEST_SAMPLES = QoSProfile(depth=128, reliability=ReliabilityPolicy.BEST_EFFORT)
# A lockstep flight needs every sample from the first one on, even if a subscriber is matched late.
# The depth is large for speed, because with a full history Fast DDS requests an acknowledgement of
# each sample.
LOCKSTEP = kept(20_000)
# The middleware asserts liveliness, and reports its loss. It asserts liveliness every two thirds of
# the lease. So a process that the host stops for less than the other third, 0.6 s, is never lost.
# With a lease of 1 s, 2 of 20 stops of 0.4 s lost the process. The lease must be shorter than the
# lease of the participant, 2 s, because the end of the participant does not distinguish a kill from
# a clean end. A node sends a single message before it ends, with the name of the role that it lost.
LIVELINESS = QoSProfile(
    depth=1,
    reliability=ReliabilityPolicy.RELIABLE,
    liveliness=LivelinessPolicy.AUTOMATIC,
    liveliness_lease_duration=Duration(seconds=1.8),
)
# For topics of foreign publishers, which may not keep samples. If a publisher offers less, the
# recorder requests less.
RECORD_FOREIGN = QoSProfile(depth=2000, reliability=ReliabilityPolicy.RELIABLE)

# A proposal is rare, so none may be lost. A proposal from before the start of the controller is
# void. The depth is the same as in NEWEST_SAMPLES.
PROPOSALS = QoSProfile(depth=128, reliability=ReliabilityPolicy.RELIABLE)

# A late subscriber gets the last state of each node. The queue of a subscriber holds the states of
# many nodes.
STATE = kept(1)
STATES = kept(100)

HISTORY_NS = 2 * NANOSECONDS
PROFILES = {table.HISTORY: PUBLISH, table.LAST: STATE, table.NOTHING: NEWEST_SAMPLES}


def offered(topic: table.Topic) -> QoSProfile:
    """Return the quality of service that publishers of a topic offer at the highest rate."""
    return PROFILES[topic.keeps]


def publisher_qos(period_ns: int) -> QoSProfile:
    """Return the profile PUBLISH for a period, with a history of two seconds.

    A longer history would delay the flight when a recorder joins. The threads that send new samples
    also send the whole history at once.
    """
    return kept(min(max(HISTORY_NS // period_ns, 1), PUBLISH.depth))


class NodeState(StrEnum):
    """State of a node on `node_state`, in the order of time.

    READY means that the event loop of the node runs. MATCHED, in real time, means that each input
    has a publisher. FLYING means that the aircraft has taken the first u of a flight in real time.
    COMPLETED means that the aircraft has completed a lockstep flight.
    """

    READY = "ready"
    MATCHED = "matched"
    FLYING = "flying"
    COMPLETED = "completed"
