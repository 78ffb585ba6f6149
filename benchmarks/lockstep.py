# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Speed of a lockstep flight, compared with a bare echo of the same message on the same host.

The scenario osprey_gust with aircraft and reference model at the 100 Hz of the controller (Runge-Kutta step 10 ms), recorded:

    four processes   aircraft, reference model, controller, recorder
    one process      the same four as objects in one process
    without ROS      the same parts in one loop
    bare echo        a vector of four channels to another process and back, by the same publisher and subscription

    .venv/bin/python benchmarks/lockstep.py [--duration 60] [--repeat 3]
"""

import argparse
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import rclpy
import yaml
from mcap.records import Channel, Message
from mcap.stream_reader import StreamReader
from rclpy.context import Context
from rclpy.node import Node

from flight_analysis.closed_loop.scenario import Scenario, load_scenario
from flight_analysis.closed_loop.simulate import simulate
from flight_bringup.fly import fly_over_topics
from flight_bringup.scenarios import find_scenario
from flight_ros import transport
from flight_ros.messages import Encoder
from flight_ros.rclpy_private import WaitSet
from flight_ros.subscriptions import PolledSubscription
from flight_ros.topics import LOCKSTEP, PUBLISH, U, Y

ECHOES = 5000


def scenario_at_controller_rate(folder: Path, duration: float) -> Scenario:
    """The scenario osprey_gust with one sample of aircraft and reference model a tick."""
    tree = yaml.safe_load(find_scenario("osprey_gust").path.read_text(encoding="utf-8"))
    tree["/**/flight"]["ros__parameters"]["duration"] = duration
    tree["/**/aircraft"]["ros__parameters"] |= {"rate": 100.0, "step": 0.01}
    tree["/**/reference_model"]["ros__parameters"]["rate"] = 100.0
    path = folder / "at_100_hz.yaml"
    path.write_text(yaml.safe_dump(tree), encoding="utf-8")
    return load_scenario(path)


def flight_steps_per_second(scenario: Scenario, run: Path, *, one_process: bool) -> float:
    """Steps of the controller per second of a lockstep flight, between its first and its last u in the log."""
    outcome = fly_over_topics(scenario, run, lambda t, u: None, lockstep=True, one_process=one_process)
    if outcome != "completed":
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
    """Steps of the controller per second of the loop without ROS."""
    begin = time.perf_counter()
    tape = simulate(scenario)
    return (len(tape["u"].stamp_ns) - 1) / (time.perf_counter() - begin)


def echo() -> None:
    """The other process: it publishes each message of y on u until the parent closes the pipe."""
    os.set_blocking(sys.stdin.fileno(), False)
    context, node = _node("echo")
    subscription, publisher = PolledSubscription(node, Y, LOCKSTEP, raw=True), node.create_publisher(U.type, U.name, PUBLISH)
    waiter = WaitSet([subscription.entity], context)
    while sys.stdin.buffer.read(1) is None:  # b"" at its end
        waiter.wait(20_000_000)
        for received in subscription.take():
            publisher.publish(received.message)
    node.destroy_node()
    context.try_shutdown()


def echo_steps_per_second() -> float:
    """Round trips per second of four channels to another process and back."""
    context, node = _node("requester")
    subscription, publisher = PolledSubscription(node, U, LOCKSTEP, raw=True), node.create_publisher(Y.type, Y.name, PUBLISH)
    waiter, encoder, values = WaitSet([subscription.entity], context), Encoder(("q", "V", "p", "r"), "requester"), np.zeros(4)
    other = subprocess.Popen([sys.executable, __file__, "--echo"], stdin=subprocess.PIPE)  # noqa: S603 - this file
    try:
        begin = 0.0
        for k in range(ECHOES):
            if k == 1:  # the first round trip includes discovery
                begin = time.perf_counter()
            publisher.publish(encoder.encode(k, values))
            while not list(subscription.take(1)):
                waiter.wait(20_000_000)
        return (ECHOES - 1) / (time.perf_counter() - begin)
    finally:
        other.communicate()
        node.destroy_node()
        context.try_shutdown()


def _node(name: str) -> tuple[Context, Node]:
    transport.prepare()
    context = Context()
    rclpy.init(context=context)
    return context, Node(name, context=context)


def main() -> None:
    """Measure all four, interleaved, and print medians."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--duration", type=float, default=60.0, help="flight time, s")
    parser.add_argument("--repeat", type=int, default=3)
    parser.add_argument("--echo", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.echo:
        echo()
        return
    rates_of: dict[str, list[float]] = {"bare echo": [], "four processes": [], "one process": [], "without ROS": []}
    with tempfile.TemporaryDirectory() as folder:
        scenario = scenario_at_controller_rate(Path(folder), options.duration)
        for k in range(options.repeat):
            rates_of["bare echo"].append(echo_steps_per_second())
            for name in ("four processes", "one process"):
                run = Path(folder) / f"{name} {k}"
                rates_of[name].append(flight_steps_per_second(scenario, run, one_process=name == "one process"))
            rates_of["without ROS"].append(loop_steps_per_second(scenario))
    floor = float(np.median(rates_of["bare echo"]))
    print(f"median of {options.repeat}, {options.duration:g} s of flight each")
    print(f"{'':16}{'steps/s':>9}{'to the echo':>13}{'times real time':>17}")
    for name, rates in rates_of.items():
        rate = float(np.median(rates))
        real_time = "" if name == "bare echo" else f"{rate / scenario.controller.rate:.1f}"
        print(f"{name:16}{rate:9.0f}{rate / floor:13.2f}{real_time:>17}")


if __name__ == "__main__":
    main()
