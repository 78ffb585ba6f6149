# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""The topics of a flight: name, type and quality of service, in one place."""

from typing import NamedTuple

from diagnostic_msgs.msg import DiagnosticArray
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import JointState

# Publishers are reliable, so that a recorder loses nothing; depth covers 0.5 s at 1 kHz of a reader that is held up.
PUBLISH = QoSProfile(depth=500, reliability=ReliabilityPolicy.RELIABLE)
# Control loops want the newest samples and never a retransmission. The depth covers the samples between two ticks
# that are needed to bring y_m to the stamp of y.
LISTEN = QoSProfile(depth=16, reliability=ReliabilityPolicy.BEST_EFFORT)
RECORD = QoSProfile(depth=2000, reliability=ReliabilityPolicy.RELIABLE)


class Topic(NamedTuple):
    """A topic by its relative name."""

    name: str
    type: type


Y = Topic("y", JointState)
Y_M = Topic("y_m", JointState)
U = Topic("u", JointState)
U_M = Topic("u_m", JointState)
INTERNALS = Topic("internals", JointState)
TRUTH = Topic("truth", JointState)
DIAGNOSTICS = Topic("/diagnostics", DiagnosticArray)

FLIGHT = (Y, Y_M, U, U_M, INTERNALS, TRUTH, DIAGNOSTICS)
