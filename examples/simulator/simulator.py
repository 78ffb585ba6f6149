# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""A simulator with its own clock.

`python simulator.py 3` flies at 3 times real time, `python simulator.py 0` in lockstep.
"""

import signal
import sys
import time
from threading import Event

import rclpy
from rclpy.qos import DurabilityPolicy, QoSProfile
from rclpy.signals import SignalHandlerOptions
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import JointState

SECOND = 1_000_000_000  # ns
STEP = SECOND // 200  # of the simulation and of /clock
SAMPLE = 2 * STEP  # of y and of the servos
EFFECTS = {
    "q": ("elevator", 56.15),
    "p": ("aileron", 85.94),
    "r": ("rudder", 9.74),
    "V": ("thrust", 6.0),
}
DAMPING = 0.5  # 1/s
# in lockstep no sample may be lost
KEPT = QoSProfile(depth=2000, durability=DurabilityPolicy.TRANSIENT_LOCAL)

speed = float(sys.argv[1])
y, u = dict.fromkeys(EFFECTS, 0.0), {}
received = {"u": JointState()}


def answered() -> int:
    """Return the stamp of the last u, ns, which is that of its y."""
    stamp = received["u"].header.stamp
    return stamp.sec * SECOND + stamp.nanosec if received["u"].header.frame_id else -1


rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
node = rclpy.create_node("simulator")
# by /clock all aircraft fly in one time; in lockstep each namespace has its own
clock_publisher = node.create_publisher(Clock, "/clock" if speed else "clock", KEPT)
y_publisher = node.create_publisher(JointState, "y", KEPT)
node.create_subscription(JointState, "u", lambda message: received.update(u=message), KEPT)
t, due = 0, time.monotonic()
# an exception of a signal may arise inside of rclpy, which then reports another one
ended = Event()
signal.signal(signal.SIGINT, lambda *_: ended.set())
while not ended.is_set():
    clock = Clock()
    clock.clock.sec, clock.clock.nanosec = divmod(t, SECOND)
    if t % SAMPLE == 0:
        # the servos take the u of the last sample
        u = dict(zip(received["u"].name, received["u"].position, strict=True))
        sample = JointState(name=list(y), position=list(y.values()))
        sample.header.stamp = clock.clock
        y_publisher.publish(sample)  # before the clock: a node then finds y at its tick
    clock_publisher.publish(clock)
    # a pause is not caught up with
    due = max(due + STEP / SECOND / speed, time.monotonic()) if speed else 0.0
    rclpy.spin_once(node, timeout_sec=0.0)
    # lockstep: u answers this y
    waits = not speed and t % SAMPLE == 0
    while not ended.is_set() and (time.monotonic() < due or (waits and answered() < t)):
        rclpy.spin_once(node, timeout_sec=0.0005)
    for output, (name, effect) in EFFECTS.items():
        y[output] += STEP / SECOND * (effect * u.get(name, 0.0) - DAMPING * y[output])
    t += STEP
