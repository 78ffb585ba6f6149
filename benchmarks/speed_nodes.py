# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""The processes that benchmarks/speed.py measures; each prints one line of JSON when it ends, by SIGTERM or by itself.

python -m benchmarks.speed_nodes ROLE [--executor single] [--hz 500] [--seconds 10]

Executors are never spun without a timeout: without one the events executor of these wheels hangs.
"""

import argparse
import json
import os
import signal
import threading
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import rclpy
from rclpy.clock import Clock, ClockType
from rclpy.executors import MultiThreadedExecutor, SingleThreadedExecutor
from rclpy.experimental import EventsExecutor
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions

from flight_core.parameters import NodeParameters
from flight_core.rates import NANOSECONDS
from flight_ros import transport
from flight_ros.event_loop import run
from flight_ros.flight_node import FlightNode
from flight_ros.ticker import Tick, Ticker
from flight_ros.topics import NEWEST_SAMPLES, PUBLISH, U, Y
from rise_di_controller.node import ControllerNode

EXECUTORS: dict[str, Callable[[], Any]] = {
    "single": SingleThreadedExecutor,
    "multi": lambda: MultiThreadedExecutor(num_threads=2),
    "events": EventsExecutor,
}
ROLES = ("echo", "timed_echo", "idle", "timer", "bare_loop", "ticker", "sentinel", "controller")
PAUSE = 0.1  # s, the longest that an executor waits
SENTINEL_PERIOD = 0.0005  # s


def lateness(late_ns: list[int], missed: int) -> dict[str, float]:
    """Percentiles of how late ticks were, us, the first ones left out: the process is still warming up."""
    late = np.array(late_ns[len(late_ns) // 20 :]) / 1e3
    return {
        "p50": float(np.percentile(late, 50)),
        "p99": float(np.percentile(late, 99)),
        "max": float(late.max()),
        "missed": missed,
        "ticks": len(late_ns),
    }


def times(took_ns: list[int]) -> dict[str, float]:
    """Median and 99th percentile of what something took, us."""
    took = np.array(took_ns[len(took_ns) // 20 :]) / 1e3
    return {"p50": float(np.percentile(took, 50)), "p99": float(np.percentile(took, 99)), "calls": len(took_ns)}


def until_told() -> threading.Event:
    """Set by SIGTERM or SIGINT."""
    ended = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: ended.set())
    return ended


def bare_node(name: str) -> Node:
    """A node of rclpy as it comes, on the stack's transport."""
    transport.prepare()
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    return Node(name)


def echo(executor: str, hz: float, *, timed: bool) -> dict[str, float]:
    """Whatever comes on y goes back on u, as the callback of a subscription.

    Timed: the executor is looked after at a fixed rate, so that a message is there, and the time from there to the end of the
    callback is taken; else it is spun as usual.
    """
    ended, node = until_told(), bare_node("echo")
    publisher = node.create_publisher(U.type, U.name, PUBLISH)
    sent_ns = [0]

    def answer(message: Any) -> None:
        publisher.publish(message)
        sent_ns[0] = time.perf_counter_ns()

    node.create_subscription(Y.type, Y.name, answer, NEWEST_SAMPLES)
    spun = EXECUTORS[executor]()
    spun.add_node(node)
    took: list[int] = []
    ticker, begin_ns = Ticker(round(NANOSECONDS / hz), time.monotonic_ns()), time.perf_counter_ns()
    while not ended.is_set():
        if not timed:
            spun.spin_once(timeout_sec=PAUSE)
            continue
        if (pause := ticker.remaining()) > 0:
            time.sleep(pause)
        ticker.due()
        if sent_ns[0] > begin_ns:  # a message was there; looked at late, for an executor may have threads
            took.append(sent_ns[0] - begin_ns)
        begin_ns = time.perf_counter_ns()
        spun.spin_once(timeout_sec=0.0)
    node.destroy_node()
    rclpy.try_shutdown()
    return times(took) if took else {}


def idle() -> dict[str, float]:
    """A node that does nothing but spin."""
    ended, node = until_told(), bare_node("idle")
    spun = SingleThreadedExecutor()
    spun.add_node(node)
    print("ready", flush=True)
    while not ended.is_set():
        spun.spin_once(timeout_sec=PAUSE)
    node.destroy_node()
    rclpy.try_shutdown()
    return {}


def timer(executor: str, hz: float, seconds: float) -> dict[str, float]:
    """An empty timer of rclpy, on the steady clock: how late its callback begins."""
    ended, node = until_told(), bare_node("timer")
    period_ns = round(NANOSECONDS / hz)
    late: list[int] = []
    at: list[int] = []

    def tick() -> None:
        left_ns = made.time_until_next_call()
        at.append(time.monotonic_ns())
        late.append(period_ns - left_ns)

    made = node.create_timer(1.0 / hz, tick, clock=Clock(clock_type=ClockType.STEADY_TIME))
    spun = EXECUTORS[executor]()
    spun.add_node(node)
    end = time.monotonic() + seconds
    while time.monotonic() < end and not ended.is_set():
        spun.spin_once(timeout_sec=PAUSE)
    node.destroy_node()
    rclpy.try_shutdown()
    due = round((at[-1] - at[0]) / period_ns) + 1
    return lateness(late, max(due - len(at), 0))


def bare_loop(hz: float, seconds: float) -> dict[str, float]:
    """Nothing but sleeping until the next deadline."""
    ticker, late, missed = Ticker(round(NANOSECONDS / hz), time.monotonic_ns()), [], 0
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        if (pause := ticker.remaining()) > 0:
            time.sleep(pause)
        if (tick := ticker.due()) is not None:
            late.append(tick.late_ns)
            missed += tick.missed
    return lateness(late, missed)


def ticker_node(hz: float, seconds: float) -> dict[str, Any]:
    """An empty node of the stack, with all that its loop does beside the ticks: services, diagnostics, a look at the graph."""
    late: list[int] = []
    skipped: list[tuple[int, int]] = []  # from the first deadline that was missed until the tick that came, monotonic ns
    period = round(NANOSECONDS / hz)

    class Empty(FlightNode[NodeParameters]):
        def __init__(self) -> None:
            super().__init__("ticker", NodeParameters)

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
    missed = sum((until - since) // period for since, until in skipped)
    return lateness(late, missed) | {"skipped": skipped, "period_ns": period}


def sentinel(core: int) -> dict[str, Any]:
    """On one core, before everything else: intervals in which it did not run, monotonic ns; nothing ran then on that core.

    What holds it back is the kernel or, in a virtual machine, the host that runs something else.
    """
    os.sched_setaffinity(0, {core})
    os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(os.sched_get_priority_max(os.SCHED_FIFO)))
    ended, held = until_told(), []
    last_ns = time.monotonic_ns()
    while not ended.is_set():
        time.sleep(SENTINEL_PERIOD)
        now_ns = time.monotonic_ns()
        if now_ns - last_ns > 1.5e9 * SENTINEL_PERIOD:  # being woken takes it a twentieth to a fifth of a period
            held.append((last_ns, now_ns))
        last_ns = now_ns
    return {"held": held}


def controller() -> dict[str, float]:
    """The controller's node: what its tick takes, from before y is taken until u is published, and until the tick ends."""
    until_u: list[int] = []
    whole: list[int] = []

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
                whole.append(time.perf_counter_ns() - self._begin_ns)

    run(Timed)
    if not whole:
        return {}
    return times(until_u) | {f"whole {name}": value for name, value in times(whole).items()}


def main() -> None:
    """Do as one of them."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("role", choices=ROLES)
    parser.add_argument("--executor", choices=EXECUTORS, default="single")
    parser.add_argument("--hz", type=float, default=500.0)
    parser.add_argument("--seconds", type=float, default=10.0)
    parser.add_argument("--core", type=int, default=0)
    asked, _ = parser.parse_known_args()  # the rest is for ROS
    roles: dict[str, Callable[[], dict[str, Any]]] = {
        "echo": lambda: echo(asked.executor, asked.hz, timed=False),
        "timed_echo": lambda: echo(asked.executor, asked.hz, timed=True),
        "idle": idle,
        "timer": lambda: timer(asked.executor, asked.hz, asked.seconds),
        "bare_loop": lambda: bare_loop(asked.hz, asked.seconds),
        "ticker": lambda: ticker_node(asked.hz, asked.seconds),
        "sentinel": lambda: sentinel(asked.core),
        "controller": controller,
    }
    print(json.dumps(roles[asked.role]()), flush=True)


if __name__ == "__main__":
    main()
