# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""The loop of a node's process: ticks on the monotonic clock or lockstep steps, services in between, a clean shutdown."""

import gc
import signal
import sys
import time
import traceback
from collections import deque
from collections.abc import Callable, Sequence
from types import FrameType
from typing import Any

import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.signals import SignalHandlerOptions

from flight_core.outcome import FlightEnded
from flight_core.parameters import ParameterError
from flight_core.rates import NANOSECONDS, nanoseconds, seconds
from flight_ros import transport
from flight_ros.flight_node import FlightNode
from flight_ros.rclpy_private import ARGUMENT_ERRORS, Participant, WaitSet, destroy_participant, ready_callback
from flight_ros.ticker import Ticker, disable_timer_slack
from flight_ros.topics import NodeState

ENDED_EARLY = 3  # exit status

MAX_START_AGE_NS = 10 * NANOSECONDS  # a node that comes late catches up with what it missed, but not with hours

PEER_TIMEOUT_NS = 30 * NANOSECONDS  # in lockstep, for others that never come

SERVICE_POLL_PERIOD = 0.1  # s, between two looks at signals of life and service calls while a lockstep flight moves

IDLE_POLL_PERIOD = 0.02  # s, the longest sleep, so that a signal or a service call is not left waiting


class _Stop:
    """Set by a signal handler. No lock: an Event's would hang for ever when a second signal comes inside the first handler."""

    requested = False

    def request(self, number: int, frame: FrameType | None) -> None:
        self.requested = True


def run(*make_nodes: Callable[[], FlightNode[Any]], early_participant: Participant | None = None) -> None:
    """Run a node, or several in lockstep, until SIGINT or SIGTERM, then leave with exit status 0.

    Otherwise 2 for bad parameters, 3 for a flight that cannot go on, 1 for a fault. `early_participant` joined before them and
    is destroyed once they exist (flight_ros.startup).

    Ticks run on the monotonic clock in the main thread; what comes over topics is taken at the tick. In lockstep there are no
    ticks: a node moves when what it needs has come. The executor serves parameters and services, after ticks and without ever
    waiting.
    """
    stop = _Stop()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, stop.request)
    try:
        nodes = _made(make_nodes, early_participant)
    except ParameterError as error:
        sys.exit(_refuse(str(error)))
    except FlightEnded as error:
        _refuse(str(error))
        sys.exit(ENDED_EARLY)
    except ARGUMENT_ERRORS as error:
        sys.exit(_refuse(" ".join(str(error).split())))
    node = nodes[0]
    try:
        if sockets := transport.open_to_network():
            node.get_logger().error(f"the loopback profile is not in force: sockets open to the network: {', '.join(sockets)}")
        if node.steps():
            _step(nodes, stop)
        else:
            _loop(node, stop)
    except ParameterError as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(2)
    except FlightEnded as error:
        node.get_logger().fatal(str(error))
        sys.exit(ENDED_EARLY)
    except Exception:
        node.get_logger().fatal(f"fault, the node ends: {traceback.format_exc()}")
        sys.exit(1)
    finally:
        for one in nodes:
            one.finish()
            one.destroy_node()
        rclpy.try_shutdown()


def _made(make_nodes: Sequence[Callable[[], FlightNode[Any]]], early_participant: Participant | None) -> list[FlightNode[Any]]:
    transport.prepare()
    if not rclpy.ok():
        rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    nodes = [make_node() for make_node in make_nodes]
    if early_participant is not None:
        destroy_participant(early_participant)
    return nodes


def _refuse(sentence: str) -> int:
    print(f"error: {sentence}", file=sys.stderr)
    rclpy.try_shutdown()
    return 2


def _serve(executor: SingleThreadedExecutor, node: FlightNode[Any], until_ns: int = 0) -> None:
    """Serve one request, where there is one, and further ones until an instant of the monotonic clock."""
    while True:
        if (execute := ready_callback(executor)) is None:
            return
        try:
            execute()
        except Exception as error:  # a service request that rclpy cannot serve, such as an invalid lifecycle transition
            node.get_logger().error(f"request refused: {' '.join(str(error).split())}")
        if time.monotonic_ns() >= until_ns:
            return


def _begin(nodes: Sequence[FlightNode[Any]]) -> SingleThreadedExecutor:
    executor = SingleThreadedExecutor()
    for node in nodes:
        executor.add_node(node)
    gc.freeze()  # a collection then takes microseconds, not tens of milliseconds, as the one of now would
    gc.enable()
    for node in nodes:
        node.publish_state(NodeState.READY)
        node.get_logger().info("ready")
    return executor


def _step(nodes: Sequence[FlightNode[Any]], stop: _Stop) -> None:
    executor = _begin(nodes)
    wait_set = WaitSet(
        [subscription.entity for node in nodes for subscription in node.polled_subscriptions()], nodes[0].context
    )
    begin_ns = serve_ns = report_ns = time.monotonic_ns()
    moved = False
    while not stop.requested:
        moving = [node.advance() for node in nodes]
        if any(moving):
            moved = True
        elif not wait_set.wait(nanoseconds(IDLE_POLL_PERIOD)):
            serve_ns = 0  # nothing comes: perhaps one of the others is gone
        now_ns = time.monotonic_ns()
        if now_ns >= serve_ns:
            serve_ns = now_ns + nanoseconds(SERVICE_POLL_PERIOD)
            _serve(executor, nodes[0])
            for node in nodes:
                node.require_peers()
        if now_ns >= report_ns:
            report_ns = now_ns + NANOSECONDS
            for node in nodes:
                node.publish_diagnostics()
                node.check_graph()
            if not moved and now_ns - begin_ns > PEER_TIMEOUT_NS:
                raise FlightEnded(f"waited {seconds(PEER_TIMEOUT_NS):g} s for {nodes[0].awaited_topic()}: nobody there")


def _loop(node: FlightNode[Any], stop: _Stop) -> None:
    executor = _begin([node])
    start_ns = node.start_ns() or time.time_ns()
    if (past := time.time_ns() - start_ns) > MAX_START_AGE_NS:
        raise ParameterError(
            f"{node.get_name()}.start_time: found an instant {seconds(past):.0f} s ago, expected one to come, or 0"
        )
    begin_ns = time.monotonic_ns() + start_ns - time.time_ns()
    node.keep_time(start_ns, begin_ns)
    ticker = Ticker(node.period_ns(), begin_ns)
    if (lead := start_ns - time.time_ns()) > nanoseconds(60):
        node.get_logger().warning(f"start_time is {seconds(lead):.0f} s ahead; waiting for it")
    serve_ns = report_ns = time.monotonic_ns()
    chores: deque[Callable[[], None]] = deque()
    disable_timer_slack()
    while not stop.requested:
        ticker.wait(IDLE_POLL_PERIOD)
        if (tick := ticker.due()) is not None:
            node.run_tick(tick, start_ns + tick.number * ticker.period_ns)
        now_ns = time.monotonic_ns()
        if now_ns >= serve_ns:
            serve_ns = now_ns + nanoseconds(IDLE_POLL_PERIOD)
            # half of what is left to the next tick, which no request may hold up
            _serve(executor, node, now_ns + nanoseconds(max(ticker.remaining(), 0.0) / 2.0))
            node.require_peers()
        if now_ns >= report_ns:
            report_ns = now_ns + NANOSECONDS
            chores += (node.publish_diagnostics, node.check_graph, node.check_clock)
        if chores:  # one a tick: together they may outlast a period of 2 ms
            chores.popleft()()
