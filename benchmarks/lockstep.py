# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Measure the speed of a lockstep flight.

It is compared with a bare echo of the same message on the same host.

The flight is the scenario osprey_gust with aircraft and reference model at the 100 Hz of the
controller (Runge-Kutta step 10 ms), recorded:

    four processes   aircraft, reference model, controller, recorder
    one process      the same four as objects in one process
    without ROS      the same parts in one loop
    bare echo
        a vector of four channels to another process and back, by the same publisher and
        subscription

    .venv/bin/python -m benchmarks.speed --only lockstep
"""

import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from benchmarks.nodes import open_node
from benchmarks.processes import Child
from mcap.records import Channel, Message
from mcap.stream_reader import StreamReader

from flight_analysis.closed_loop.scenario import Scenario
from flight_analysis.closed_loop.scenario_library import find_scenario, save_scenario
from flight_analysis.closed_loop.simulate import simulate
from flight_bringup.fly import fly_over_topics
from flight_core.outcome import End
from flight_ros.messages import Encoder
from flight_ros.rclpy_private import WaitSet
from flight_ros.subscriptions import PolledSubscription
from flight_ros.topics import LOCKSTEP, PUBLISH, U, Y

ECHOES = 5000
RATE = 100.0  # Hz, of the controller of osprey_gust
FLOOR = "bare echo, to another process and back"


def flight_steps_per_second(scenario: Scenario, run: Path, *, one_process: bool) -> float:
    """Return the steps of the controller per second of a lockstep flight.

    They are counted between its first and its last u in the log.
    """
    outcome = fly_over_topics(
        scenario, run, lambda t, u: None, lockstep=True, one_process=one_process
    )
    if outcome.end is not End.COMPLETED:
        sys.exit(f"error: {outcome}")
    topics: dict[int, str] = {}
    times = []
    with min(run.glob("*.mcap")).open("rb") as stream:
        for record in StreamReader(stream).records:
            if isinstance(record, Channel):
                topics[record.id] = record.topic
            elif isinstance(record, Message) and topics[record.channel_id] == "/u":
                times.append(record.publish_time)
    return (len(times) - 1) / ((times[-1] - times[0]) / 1e9)


def loop_steps_per_second(scenario: Scenario) -> float:
    """Return the steps of the controller per second of the loop without ROS."""
    begin = time.perf_counter()
    tape = simulate(scenario)
    return (len(tape["u"].stamp_ns) - 1) / (time.perf_counter() - begin)


def echo_steps_per_second() -> float:
    """Return the round trips per second of four channels to another process and back."""
    encoder = Encoder(("q", "V", "p", "r"), "requester")
    values = np.zeros(4)
    with open_node("requester") as node, Child("polled_echo"):
        subscription = PolledSubscription(node, U, LOCKSTEP, raw=True)
        publisher = node.create_publisher(Y.type, Y.name, PUBLISH)
        waiter = WaitSet([subscription.entity], node.context)
        for k in range(ECHOES):
            if k == 1:  # the first round trip includes discovery
                begin = time.perf_counter()
            publisher.publish(encoder.encode(k, values))
            while not list(subscription.take(1)):
                waiter.wait(20_000_000)
        return (ECHOES - 1) / (time.perf_counter() - begin)


def measure(folder: Path, duration: float, repeat: int) -> dict[str, float]:
    """Return the steps per second of the echo (FLOOR) and of each kind of flight.

    They are the median of `repeat` runs, interleaved.
    """
    aircraft = {"rate": RATE, "step": 1.0 / RATE}
    model = {"rate": RATE}
    scenario = find_scenario("osprey_gust", duration).vary(aircraft=aircraft, reference_model=model)
    scenario = save_scenario(scenario, folder / "at_100_hz.yaml")
    measurements: dict[str, Callable[[Path], float]] = {
        FLOOR: lambda run: echo_steps_per_second(),
        "lockstep, four processes": lambda run: flight_steps_per_second(
            scenario, run, one_process=False
        ),
        "lockstep, one process": lambda run: flight_steps_per_second(
            scenario, run, one_process=True
        ),
        "one loop without ROS": lambda run: loop_steps_per_second(scenario),
    }
    rates = [
        [of(folder / f"{name} {k}") for name, of in measurements.items()] for k in range(repeat)
    ]
    return dict(zip(measurements, np.median(rates, axis=0).tolist(), strict=True))
