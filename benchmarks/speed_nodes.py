# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""The processes of the benchmarks. Each prints one line of JSON at its end or on SIGTERM.

python -m benchmarks.speed_nodes ROLE [--executor single] [--hz 500] [--seconds 10]

Executors never spin without a timeout: without one the events executor of these wheels hangs.
"""

import argparse
import json
import os
import signal
import time
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from benchmarks.nodes import open_node, termination, ticks
from benchmarks.tables import parser_of
from rclpy.clock import Clock, ClockType
from rclpy.executors import MultiThreadedExecutor, SingleThreadedExecutor
from rclpy.experimental import EventsExecutor
from rclpy.node import Node

from flight_core.parameters import NodeConfig
from flight_core.rates import NANOSECONDS
from flight_ros.event_loop import run
from flight_ros.flight_node import FlightNode
from flight_ros.rclpy_private import WaitSet
from flight_ros.subscriptions import PolledSubscription
from flight_ros.ticker import Tick
from flight_ros.topics import LOCKSTEP, NEWEST_SAMPLES, PUBLISH, U, Y
from rise_di_controller.node import ControllerNode

EXECUTORS: dict[str, Callable[..., Any]] = {
    "single": SingleThreadedExecutor,
    "multi": partial(MultiThreadedExecutor, num_threads=2),
    "events": EventsExecutor,
}
PAUSE = 0.1  # s, the timeout of an executor
MONITOR_PERIOD = 0.0005  # s


def times(took_ns: list[int]) -> dict[str, float]:
    """Return median and 99th percentile of durations, us, without the warm-up."""
    took = np.array(took_ns[len(took_ns) // 20 :]) / 1e3
    return {
        "p50": float(np.percentile(took, 50)),
        "p99": float(np.percentile(took, 99)),
        "calls": len(took_ns),
    }


def lateness(late_ns: list[int], missed: int) -> dict[str, float]:
    """Return percentiles of the lateness of ticks, us, without the warm-up."""
    late = times(late_ns)
    most = max(late_ns[len(late_ns) // 20 :]) / 1e3
    return {
        "p50": late["p50"],
        "p99": late["p99"],
        "max": most,
        "missed": missed,
        "ticks": late["calls"],
    }


def executor_of(node: Node, kind: str) -> Any:
    """Return an executor that spins the node."""
    executor = EXECUTORS[kind](context=node.context)
    executor.add_node(node)
    return executor


def echo(kind: str, hz: float, *, timed: bool) -> dict[str, float]:
    """Run a subscription to y whose callback publishes each message on u.

    With `timed`, the executor spins once at each instant of a fixed rate. If a message has arrived
    by then, the time from the instant until it is published is measured. Without `timed` the
    executor spins as usual.
    """
    has_ended = termination()
    took: list[int] = []
    sent_ns = 0

    def answer(message: Any) -> None:
        nonlocal sent_ns
        publisher.publish(message)
        sent_ns = time.perf_counter_ns()

    with open_node("echo") as node:
        publisher = node.create_publisher(U.type, U.name, PUBLISH)
        node.create_subscription(Y.type, Y.name, answer, NEWEST_SAMPLES)
        executor = executor_of(node, kind)
        while not timed and not has_ended.is_set():
            executor.spin_once(timeout_sec=PAUSE)
        begin_ns = time.perf_counter_ns()
        for _ in ticks(hz):
            if has_ended.is_set():
                break
            # a message had arrived; checked late, since an executor may have threads
            if sent_ns > begin_ns:
                took.append(sent_ns - begin_ns)
            begin_ns = time.perf_counter_ns()
            executor.spin_once(timeout_sec=0.0)
    return times(took) if took else {}


def polled_echo() -> dict[str, float]:
    """Publish each message of y on u, with the publisher and the subscription of the stack."""
    has_ended = termination()
    with open_node("echo") as node:
        subscription = PolledSubscription(node, Y, LOCKSTEP, raw=True)
        publisher = node.create_publisher(U.type, U.name, PUBLISH)
        waiter = WaitSet([subscription.entity], node.context)
        while not has_ended.is_set():
            waiter.wait(20_000_000)
            for received in subscription.take():
                publisher.publish(received.message)
    return {}


def idle() -> dict[str, float]:
    """Run a node that only spins."""
    has_ended = termination()
    with open_node("idle") as node:
        executor = executor_of(node, "single")
        while not has_ended.is_set():
            executor.spin_once(timeout_sec=PAUSE)
    return {}


def timer(kind: str, hz: float, seconds: float) -> dict[str, float]:
    """Measure the lateness of an empty timer of rclpy on the steady clock."""
    has_ended = termination()
    period_ns = round(NANOSECONDS / hz)
    late: list[int] = []
    at: list[int] = []

    def tick() -> None:
        left_ns = node_timer.time_until_next_call()
        at.append(time.monotonic_ns())
        late.append(period_ns - left_ns)

    with open_node("timer") as node:
        node_timer = node.create_timer(
            1.0 / hz, tick, clock=Clock(clock_type=ClockType.STEADY_TIME)
        )
        executor = executor_of(node, kind)
        end = time.monotonic() + seconds
        while time.monotonic() < end and not has_ended.is_set():
            executor.spin_once(timeout_sec=PAUSE)
    due = round((at[-1] - at[0]) / period_ns) + 1
    return lateness(late, max(due - len(at), 0))


def bare_loop(hz: float, seconds: float) -> dict[str, float]:
    """Run a loop that only sleeps until the next deadline."""
    late = []
    missed_count = 0
    end = time.monotonic() + seconds
    for tick in ticks(hz):
        late.append(tick.late_ns)
        missed_count += tick.missed
        if time.monotonic() >= end:
            break
    return lateness(late, missed_count)


def ticker_node(hz: float, seconds: float) -> dict[str, Any]:
    """Run an empty node of the stack.

    It has the services, the diagnostics and the graph checks of its loop.
    """
    late: list[int] = []
    # from the first missed deadline to the next tick, monotonic ns
    skipped: list[tuple[int, int]] = []
    period = round(NANOSECONDS / hz)

    class Empty(FlightNode[NodeConfig]):
        def __init__(self) -> None:
            super().__init__("ticker", NodeConfig)

        def period_ns(self) -> int:
            return period

        def tick(self, tick: Tick, now_ns: int) -> None:
            late.append(tick.late_ns)
            if tick.missed:
                begin_ns = time.monotonic_ns()
                skipped.append((begin_ns - tick.late_ns - tick.missed * period, begin_ns))

    signal.signal(signal.SIGALRM, lambda *_: signal.raise_signal(signal.SIGTERM))
    signal.setitimer(signal.ITIMER_REAL, seconds + 1.0)
    run(Empty)
    missed_count = sum((until - since) // period for since, until in skipped)
    return lateness(late, missed_count) | {"skipped": skipped, "period_ns": period}


def delay_monitor(core: int) -> dict[str, Any]:
    """Measure the host delays of one core, monotonic ns.

    Each is an interval in which this process of the highest priority could not run. The kernel
    delayed it or, in a virtual machine, the machine below (steal time).
    """
    os.sched_setaffinity(0, {core})
    os.sched_setscheduler(
        0, os.SCHED_FIFO, os.sched_param(os.sched_get_priority_max(os.SCHED_FIFO))
    )
    has_ended = termination()
    delays = []
    last_ns = time.monotonic_ns()
    while not has_ended.is_set():
        time.sleep(MONITOR_PERIOD)
        now_ns = time.monotonic_ns()
        # a wake-up takes a twentieth to a fifth of a period
        if now_ns - last_ns > 1.5e9 * MONITOR_PERIOD:
            # the delay begins when the sleep had to end
            delays.append((last_ns + round(MONITOR_PERIOD * NANOSECONDS), now_ns))
        last_ns = now_ns
    return {"delays": delays}


def controller() -> dict[str, float]:
    """Run the controller's node, and measure its ticks.

    The times are those from the beginning of a tick until u is published, and until the tick ends.
    """
    until_u: list[int] = []
    tick_times: list[int] = []

    class Timed(ControllerNode):
        def __init__(self) -> None:
            super().__init__()
            publish_u = self._publish_u
            self._begin_ns = 0

            def timed(message: bytes) -> None:
                publish_u(message)
                until_u.append(time.perf_counter_ns() - self._begin_ns)

            self._publish_u = timed

        def tick(self, tick: Tick, now_ns: int) -> None:
            self._begin_ns, answers = time.perf_counter_ns(), len(until_u)
            super().tick(tick, now_ns)
            if len(until_u) > answers:
                tick_times.append(time.perf_counter_ns() - self._begin_ns)

    run(Timed)
    if not tick_times:
        return {}
    return times(until_u) | {f"whole {name}": value for name, value in times(tick_times).items()}


ROLES: dict[str, Callable[[argparse.Namespace], dict[str, Any]]] = {
    "echo": lambda of: echo(of.executor, of.hz, timed=False),
    "timed_echo": lambda of: echo(of.executor, of.hz, timed=True),
    "polled_echo": lambda of: polled_echo(),
    "idle": lambda of: idle(),
    "timer": lambda of: timer(of.executor, of.hz, of.seconds),
    "bare_loop": lambda of: bare_loop(of.hz, of.seconds),
    "ticker": lambda of: ticker_node(of.hz, of.seconds),
    "delay_monitor": lambda of: delay_monitor(of.core),
    "controller": lambda of: controller(),
}


def main() -> None:
    """Run one role."""
    parser = parser_of(__doc__)
    parser.add_argument("role", choices=ROLES)
    parser.add_argument("--executor", choices=EXECUTORS, default="single")
    parser.add_argument("--hz", type=float, default=500.0)
    parser.add_argument("--seconds", type=float, default=10.0)
    parser.add_argument("--core", type=int, default=0)
    options, _ = parser.parse_known_args()  # the others are arguments of ROS
    print(json.dumps(ROLES[options.role](options)), flush=True)


if __name__ == "__main__":
    main()
