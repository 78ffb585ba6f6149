# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Measure how long a receiver takes for one message of y that has arrived.

The controller takes a right message, and the receiver refuses the others.

python -m benchmarks.speed --only receiver
"""

import time
from functools import partial

import numpy as np
from benchmarks.nodes import open_node

from flight_analysis.closed_loop.scenario_library import find_scenario
from flight_core.publisher_lock import PublisherLock
from flight_core.vectors import FloatArray, StampedVector
from flight_ros.messages import MAX_SIZE, Decoder, Encoder
from flight_ros.receiver import Receiver, Refusals
from flight_ros.subscriptions import PolledSubscription
from flight_ros.topics import NEWEST_SAMPLES, Y
from rise_di_controller.controller import Controller

RIGHT = "right message, taken"
DECODED = "message under the name of the publisher, twice as long, decoded and refused"
AT_MOST = {DECODED: 6.0}
"""Largest permitted ratio of the time of a refused message to that of a right one. For a message
without an entry it is 2, because the receiver refuses it without decoding it."""
REPEATS, WARM_UP = 20_000, 200
OWN, FOREIGN = "/aircraft#1", "/foreign#2"
TAKEOVER_NS = 10**15  # no publisher times out


def long_message(sender: str, size: int) -> bytes:
    """Return a message of about `size` bytes, with channels that the controller does not want."""
    count = (size - 100) // 20  # 12 bytes a name, 8 a value
    return Encoder([f"c{k:05}" for k in range(count)], sender).encode(0, np.zeros(count))


def measure() -> dict[str, FloatArray]:
    """Return the times of a right message and of refused ones, ns for each."""
    parameters = find_scenario("osprey_gust").controller
    controller = Controller(parameters)
    encoder = Encoder(parameters.outputs, OWN)
    right = encoder.encode(0, np.zeros(4))
    refusals = {
        DECODED: right + bytes(len(right)),
        "message of a conflicting publisher, refused": Encoder(parameters.outputs, FOREIGN).encode(
            0, np.zeros(4)
        ),
        f"message of a conflicting publisher of {MAX_SIZE} bytes, refused": long_message(
            FOREIGN, MAX_SIZE
        ),
        "message of a conflicting publisher of 1.2 MB, refused": long_message(FOREIGN, 1_200_000),
        "message under the name of the publisher of 1.2 MB, refused": long_message(OWN, 1_200_000),
        f"message under the name of the publisher of {MAX_SIZE} bytes, refused": long_message(
            OWN, MAX_SIZE
        ),
    }
    took = {name: np.empty(REPEATS) for name in (RIGHT, *refusals)}

    def take(sample: StampedVector, now_ns: int) -> None:
        controller.take_y(sample, now_ns)  # none is lost: y moves slowly

    with open_node("receiver") as node:
        subscription = PolledSubscription(node, Y, NEWEST_SAMPLES, raw=True)
        lock = PublisherLock(lambda: (TAKEOVER_NS, TAKEOVER_NS))
        decode = Decoder(parameters.outputs).decode
        max_age_ns = partial(int, TAKEOVER_NS)
        receiver = Receiver(
            subscription, Refusals(node), decode, take, max_age_ns=max_age_ns, lock=lock
        )

        for k in range(REPEATS):  # in turn, since the speed of the host drifts
            for name, message in {
                RIGHT: encoder.encode(k, np.full(4, 1e-6 * k)),
                **refusals,
            }.items():
                begin_ns = time.perf_counter_ns()
                receiver.take_message(message, REPEATS)
                took[name][k] = time.perf_counter_ns() - begin_ns
    return {name: times[WARM_UP:] for name, times in took.items()}
