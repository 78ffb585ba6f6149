# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""What disturbs a flight, as a process of its own.

An unexpected publisher, a faulty relay, clients of a live page.

python -m tests.ros.flight_bringup.faults.foreign storm TOPIC RATE SECONDS SEED
    # valid vectors of random values
python -m tests.ros.flight_bringup.faults.foreign relay TOPIC
    # the messages on standard input, one a line, in hex
python -m tests.ros.flight_bringup.faults.foreign gate SOURCE TOPIC
    # relays, with the fault that standard input names: FAULTS
python -m tests.ros.flight_bringup.faults.foreign clients ADDRESS COUNT SECONDS
    # connections to a page, each asks for all samples
"""

import socket
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from urllib.parse import urlsplit

import numpy as np
import rclpy
from rclpy.context import Context
from rclpy.node import Node
from rclpy.publisher import Publisher

from flight_core.rates import NANOSECONDS
from flight_ros import transport
from flight_ros.messages import Encoder, NamedDecoder
from flight_ros.rclpy_private import WaitSet
from flight_ros.subscriptions import PolledSubscription
from flight_ros.ticker import Ticker
from flight_ros.topics import PROPOSAL, PUBLISH, TARGET, U_M, Y_M, Topic, U, Y

OUTPUTS = ("q", "V", "p", "r")  # of `target` V alone is a channel: its storm is refused
NAMES = {
    "y": OUTPUTS,
    "y_m": OUTPUTS,
    "u_m": OUTPUTS,
    "target": OUTPUTS,
    "u": ("elevator", "aileron", "rudder", "thrust"),
}
NAMES["proposal"] = OUTPUTS  # no proposal but for its header, by which it is refused
SUBSCRIBERS = dict.fromkeys(NAMES, 3) | {"target": 2, "proposal": 1}
"""The node that uses the topic, the recorder, the probe. The probe publishes `target`; only the
controller takes `proposal`."""
# a thousand bursts a second: the sleep of Python cannot time single messages at 10 kHz
BURST_NS = 1_000_000
REPORT_PERIOD = 10.0  # s, of the lines that report missing subscribers


@contextmanager
def matched_publisher(topic: str) -> Iterator[Publisher]:
    """Yield a publisher that all subscribers have discovered."""
    transport.prepare()
    context = Context()
    rclpy.init(context=context)
    node = Node("foreign", context=context)
    kind = {endpoint.name: endpoint for endpoint in (Y, Y_M, U, U_M, TARGET, PROPOSAL)}[topic]
    subscribers = SUBSCRIBERS[topic]
    publisher = node.create_publisher(kind.type, kind.name, PUBLISH)
    report = time.monotonic() + REPORT_PERIOD
    while publisher.get_subscription_count() < subscribers:
        time.sleep(0.005)
        if time.monotonic() > report:
            report += REPORT_PERIOD
            fault_names = sorted(
                subscription.node_name
                for subscription in node.get_subscriptions_info_by_topic(topic)
            )
            print(
                f"{publisher.get_subscription_count()} of {subscribers} subscribers matched, "
                f"known: {fault_names}",
                flush=True,
            )
    print(f"begins at {time.time():.6f}", flush=True)
    yield publisher
    node.destroy_node()
    context.try_shutdown()


def storm(topic: str, rate: float, duration: float, seed: int) -> None:
    """Flood a topic."""
    values = np.random.default_rng(seed).uniform(-1.0, 1.0, (1000, 4))
    encoder = Encoder(NAMES[topic], "/foreign")
    with matched_publisher(topic) as publisher:
        ticker = Ticker(BURST_NS, time.monotonic_ns())
        count = 0
        begin = time.monotonic()
        while time.monotonic() - begin < duration:
            if (pause := ticker.remaining()) > 0:
                time.sleep(pause)
            # On a busy host the rate is not reached: the storm ends nevertheless.
            while count < rate * (since := time.monotonic() - begin) and since < duration:
                publisher.publish(encoder.encode(time.time_ns(), values[count % len(values)]))
                count += 1
            ticker.due()
        print(f"sent {count} in {(time.monotonic() - begin):.3f} s", flush=True)


def relay(topic: str) -> None:
    """Publish the messages on standard input."""
    with matched_publisher(topic) as publisher:
        for line in sys.stdin:
            publisher.publish(bytes.fromhex(line))


JUMP = {"phi": 0.1, "psi": 0.52, "north": 100.0, "east": 100.0, "altitude": 30.0}  # rad, m
FAULTS = ("pass", "repeat", "freeze", "jump", "hold")
"""Relay; repeat the last message; the same with new stamps; add JUMP; nothing."""


def gate(source: str, target: str) -> None:
    """Relay a named vector with the fault that was named last."""
    transport.prepare()
    rclpy.init()
    node = Node("gate")
    subscription = PolledSubscription(node, Topic(source, Y.type), PUBLISH, raw=True)
    publisher = node.create_publisher(Y.type, target, PUBLISH)
    waiter = WaitSet([subscription.entity], node.context)
    decoder = NamedDecoder()
    fault = ["pass"]
    last = b""

    def read() -> None:
        for line in sys.stdin:
            assert line.strip() in FAULTS
            fault[0] = line.strip()

    threading.Thread(target=read, daemon=True).start()
    while rclpy.ok():
        waiter.wait(NANOSECONDS // 10)
        for received in subscription.take():
            word = fault[0]
            if word in {"pass", "jump"}:
                last = received.message
            if word in {"freeze", "jump"}:
                stamp_ns, channels, sender = decoder.decode(last)
                if word == "freeze":
                    stamp_ns = decoder.decode(received.message).stamp_ns
                else:
                    channels = {
                        name: value + JUMP.get(name, 0.0) for name, value in channels.items()
                    }
                publisher.publish(
                    Encoder([*channels], sender).encode(stamp_ns, np.array([*channels.values()]))
                )
            elif word != "hold":
                publisher.publish(last)


def clients(address: str, count: int, duration: float) -> None:
    """Open `count` connections to a page within `duration` s or longer.

    The server closes all beyond its limit. Each sends requests for all samples as fast as the
    server reads them, and reads no answer.
    """
    parts = urlsplit(address)
    token = parts.fragment.removeprefix("token=")
    request = (
        f"GET /data/0 HTTP/1.1\r\nHost: {parts.netloc}\r\nX-Page-Token: {token}\r\n\r\n".encode()
    )
    print(f"begins at {time.time():.6f}", flush=True)
    until = time.monotonic() + duration
    request_count = 0
    opened = 0
    connections: list[socket.socket] = []
    while opened < count or time.monotonic() < until:
        if opened < count:
            with suppress(OSError):  # the server accepts no more for the moment
                connections.append(
                    socket.create_connection((parts.hostname or "", parts.port or 0), timeout=0.1)
                )
                connections[-1].setblocking(False)
                opened += 1
        for place in reversed(range(len(connections))):
            try:
                connections[place].send(request)
                request_count += 1
            except BlockingIOError:
                continue
            except OSError:  # the server has closed it
                connections.pop(place).close()
        time.sleep(0.001)
    print(
        f"sent {request_count} on {opened} connections, {len(connections)} at the end", flush=True
    )


if __name__ == "__main__":
    command, topic_name, *options = sys.argv[1:]
    if command == "storm":
        storm(topic_name, float(options[0]), float(options[1]), int(options[2]))
    elif command == "gate":
        gate(topic_name, options[0])
    elif command == "clients":
        clients(topic_name, int(options[0]), float(options[1]))
    else:
        relay(topic_name)
