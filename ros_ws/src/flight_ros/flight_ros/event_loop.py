# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Event loop of a node, with ticks on the monotonic clock or by /clock, or with lockstep steps.

Between ticks or steps the loop serves services, and its shutdown is clean.
"""

import gc
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

from flight_core.deadline import Deadline
from flight_core.outcome import STATUS_BAD_INPUT, STATUS_ENDED_EARLY, End, FlightEnded
from flight_core.parameters import ParameterError
from flight_core.rates import NANOSECONDS, nanoseconds, seconds
from flight_core.scheduling import disable_timer_slack, request_short_slices
from flight_core.signals import handle_shutdown
from flight_core.text import bounded
from flight_ros import transport
from flight_ros.flight_node import MAX_START_AGE_NS, FlightNode
from flight_ros.rclpy_private import (
    ARGUMENT_ERRORS,
    Participant,
    WaitSet,
    destroy_participant,
    ready_callback,
)
from flight_ros.simulated_time import ClockRestarted
from flight_ros.ticker import Ticker
from flight_ros.topics import NodeState

# longest wait of a lockstep flight for its first sample, or after a refused sample
PEER_TIMEOUT_NS = 30 * NANOSECONDS

# s, time in lockstep between two checks for service calls and liveliness; longest sleep of several
# nodes in one thread
SERVICE_POLL_PERIOD = 0.1

LATE_REQUEST_PAUSE = 10
"""Pause of the service after a request that delayed a tick, as a multiple of the time that the
request took. The middleware blocks for 0.1 s before a reply whose reader does not match
(rmw_fastrtps, `wait_for_subscription`). Without the pause, a client could take all of the time."""

LONGEST_PAUSE_NS = NANOSECONDS  # upper limit of that pause

REPORT_TIME_NS = NANOSECONDS // 2  # the reports of each second are spread over this time

STATUS_UNEXPECTED = 1  # exit status after an unexpected exception

TEARDOWN_TIME = 0.8
"""Longest time in which the middleware may shut down at the end of a node, s. It needs 0.2 s. If
other participants end at the same time, Fast DDS 2.14 can wait for ever while it holds the
interpreter (eProsima/Fast-DDS, issue 6513). The process is then ended, and the other nodes notice
this when the lease of 2 s expires."""

START_POLL_PERIOD = 0.005  # s, time between two polls of a node that waits for t = 0

IDLE_POLL_PERIOD = 0.02  # s, longest sleep, so that signals and service calls are handled soon


class _Stop:
    """A flag that a signal handler sets, without a lock.

    An Event has a lock, which deadlocks if a second signal interrupts the first handler.
    """

    is_requested = False

    def request(self, number: int, frame: FrameType | None) -> None:
        self.is_requested = True


def run(
    *make_nodes: Callable[[], FlightNode[Any]], early_participant: Participant | None = None
) -> None:
    """Run a node, or several nodes in one thread, until SIGINT, SIGTERM or SIGHUP.

    After such a signal the exit status is 0. It is 2 for invalid parameters, 3 for a flight that
    cannot continue, 5 for a landing, 6 after another node has ended, and 1 for an unexpected
    exception. The `early_participant` of flight_ros.startup is destroyed once the nodes exist.

    Ticks run in the main thread on the monotonic clock, and poll the subscriptions. In lockstep
    there are no ticks, and a node advances when its input has arrived. The executor serves
    parameters and services after a tick, and never blocks.
    """
    stop = _Stop()
    handle_shutdown(stop.request)
    while (status := _run_to_end(_make_nodes(make_nodes, early_participant), stop)) is None:
        early_participant = None
        gc.unfreeze()
        gc.collect()  # the services of the old nodes end with their objects
    rclpy.try_shutdown()
    sys.exit(status)


def _make_nodes(
    makes: Sequence[Callable[[], FlightNode[Any]]], early_participant: Participant | None
) -> list[FlightNode[Any]]:
    try:
        transport.prepare()
        if not rclpy.ok():
            rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
        nodes = [make() for make in makes]
        if early_participant is not None:
            destroy_participant(early_participant)
    except (ParameterError, FlightEnded, *ARGUMENT_ERRORS) as error:
        # write one sentence, because the messages of rclpy have several lines
        is_stack_error = isinstance(error, ParameterError | FlightEnded)
        print(
            f"error: {error if is_stack_error else ' '.join(str(error).split())}", file=sys.stderr
        )
        status = STATUS_ENDED_EARLY if isinstance(error, FlightEnded) else STATUS_BAD_INPUT
        Deadline(TEARDOWN_TIME, status)
        sys.exit(status)
    return nodes


def _run_to_end(nodes: Sequence[FlightNode[Any]], stop: _Stop) -> int | None:
    """Run nodes, and return the exit status.

    None means that the nodes must begin again with the same parameters.
    """
    node = nodes[0]
    status: int | None = 0
    try:
        if sockets := transport.open_to_network():
            node.get_logger().error(
                "the loopback profile has no effect: sockets open to the network: "
                f"{', '.join(sockets)}"
            )
        if node.is_in_lockstep():
            _run_lockstep(nodes, stop)
        else:
            _run_real_time(nodes, stop)
    except ParameterError as error:
        print(f"error: {error}", file=sys.stderr)
        status = STATUS_BAD_INPUT
    except FlightEnded as error:
        log = node.get_logger()
        (log.info if error.end is End.LANDED else log.fatal)(str(error))
        status = error.status
    except ClockRestarted as restart:
        node.get_logger().error(f"{restart}; this node begins again")
        status = None
    except Exception as error:
        # log only the first line, which names the exception; a traceback has many lines
        cause = bounded(" ".join("".join(traceback.format_exception_only(error)).split()))
        node.get_logger().fatal(
            f"unexpected exception, the node ends: {cause}\n{traceback.format_exc()}"
        )
        status = STATUS_UNEXPECTED
    for node in nodes:
        node.finish()
    # the log is closed, and u is not sent any more; only the middleware is left
    deadline = Deadline(TEARDOWN_TIME, STATUS_ENDED_EARLY if status is None else status)
    for node in nodes:
        node.destroy_node()
    if status is None:
        deadline.cancel()
    return status


def _serve(executor: SingleThreadedExecutor, node: FlightNode[Any], until_ns: int = 0) -> None:
    """Serve the requests to a node: at least a pending one, and more up to a given instant.

    `until_ns` is by the monotonic clock.
    """
    while True:
        if (execute := ready_callback(executor)) is None:
            return
        try:
            execute()
        except Exception as error:
            # rclpy cannot serve the request, such as an invalid lifecycle transition
            node.get_logger().error(bounded(f"request rejected: {' '.join(str(error).split())}"))
        if time.monotonic_ns() >= until_ns:
            return


def _start(nodes: Sequence[FlightNode[Any]]) -> SingleThreadedExecutor:
    executor = SingleThreadedExecutor()
    for node in nodes:
        executor.add_node(node)
    gc.freeze()  # later collections take microseconds instead of tens of milliseconds
    gc.enable()
    for node in nodes:
        node.publish_state(NodeState.READY)
        node.get_logger().info("ready")
    return executor


class _AwaitedInputs:
    """The messages that the nodes of a lockstep flight need next.

    The wait must be for these messages only. If it were for all messages, a message that its node
    takes only later would end the wait at once, again and again.
    """

    def __init__(self, nodes: Sequence[FlightNode[Any]]) -> None:
        self._nodes = nodes
        self._wait_sets: dict[tuple[str | None, ...], WaitSet] = {}

    def wait(self, duration: float) -> bool:
        """Wait at most `duration` s for one of these messages, and return whether one came."""
        topics = tuple(node.awaited_topic() for node in self._nodes)
        if not any(topics):
            time.sleep(duration)
            return False
        if topics not in self._wait_sets:
            entities = [
                subscription.entity
                for node, topic in zip(self._nodes, topics, strict=True)
                for subscription in node.polled_subscriptions
                if subscription.name == topic
            ]
            self._wait_sets[topics] = WaitSet(entities, self._nodes[0].context)
        return self._wait_sets[topics].wait(nanoseconds(duration))


def _run_lockstep(nodes: Sequence[FlightNode[Any]], stop: _Stop) -> None:
    executor = _start(nodes)
    inputs = _AwaitedInputs(nodes)
    now_ns = advance_ns = serve_ns = report_ns = time.monotonic_ns()
    has_begun = False
    while not stop.is_requested:
        # ask each of them, without a short circuit
        advances = [node.advance() for node in nodes]
        if any(advances):
            has_begun = True
            advance_ns = now_ns
        elif not inputs.wait(IDLE_POLL_PERIOD):
            serve_ns = 0  # without a message, check the liveliness of the peers now
        now_ns = time.monotonic_ns()
        if now_ns >= serve_ns:
            serve_ns = now_ns + nanoseconds(SERVICE_POLL_PERIOD)
            _serve(executor, nodes[0])
            for node in nodes:
                node.require_flight()
        if now_ns >= report_ns:
            report_ns = now_ns + NANOSECONDS
            for node in nodes:
                node.publish_diagnostics()
                for check in node.graph_checks():
                    check()
            if now_ns - advance_ns > PEER_TIMEOUT_NS:
                require_input(nodes, advance_ns, has_begun)


def require_input(nodes: Sequence[FlightNode[Any]], advance_ns: int, has_begun: bool) -> None:
    """Raise FlightEnded if a lockstep flight would wait for ever.

    It would wait for ever if a sample was refused, or if the first sample never comes. `advance_ns`
    is the instant at which the flight last advanced. A flight that has begun may wait without limit
    for a peer that is suspended, for example in a debugger.
    """
    for node in nodes:
        topic = node.awaited_topic()
        if topic is None or topic not in node.refusals.last:
            continue
        refused_ns, sentence = node.refusals.last[topic]
        if refused_ns >= advance_ns:
            raise FlightEnded(f"timed out waiting for {topic}: a sample was refused: {sentence}")
    if not has_begun:
        topic = nodes[0].awaited_topic()
        raise FlightEnded(
            f"timed out waiting for {topic}: no message in {seconds(PEER_TIMEOUT_NS):g} s"
        )


class RealTime:
    """The ticks of a node in real time, and its reports between them.

    With `spin`, the last part of a wait for a deadline is a busy-wait.
    """

    def __init__(self, node: FlightNode[Any], start_ns: int, *, spin: bool) -> None:
        host = node.host
        if (age := host.time_ns() - start_ns) > MAX_START_AGE_NS:
            key = f"{node.get_name()}.start_time"
            raise ParameterError(
                f"{key}: found an instant {seconds(age):.0f} s ago, expected a future one, or 0"
            )
        begin_ns = host.monotonic_ns() + start_ns - host.time_ns()
        node.time_offset_ns = start_ns - begin_ns
        self.node = node
        self._start_ns = start_ns
        self.ticker = Ticker(node.period_ns(), begin_ns, host, spin=spin and host is time)
        if (lead := start_ns - host.time_ns()) > nanoseconds(60):
            node.get_logger().warning(f"start_time is {seconds(lead):.0f} s ahead; waiting for it")
        self._report_ns = time.monotonic_ns()
        self._reports: deque[Callable[[], None]] = deque()
        self._after_each = 1  # number of reports after each tick

    def run_due_tick(self) -> bool:
        """Run a tick if one is due, and return whether there was one.

        If several are due, only the newest one runs.
        """
        if (tick := self.ticker.due()) is None:
            return False
        self.node.run_tick(tick, self._start_ns + tick.number * self.ticker.period_ns)
        return True

    def report(self) -> None:
        """Run the next few reports.

        Reports are spread over several ticks, because together they may take longer than a period
        of 2 ms.
        """
        now_ns = time.monotonic_ns()
        if now_ns >= self._report_ns:
            self._report_ns = now_ns + NANOSECONDS
            self._reports += (
                self.node.compare_clocks,
                self.node.publish_diagnostics,
                self.node.check_clock,
                *self.node.graph_checks(),
            )
            self._after_each = -(-len(self._reports) * self.ticker.period_ns // REPORT_TIME_NS)
        for _ in range(min(self._after_each, len(self._reports))):
            self._reports.popleft()()


def _start_instants(
    nodes: Sequence[FlightNode[Any]], executor: SingleThreadedExecutor, stop: _Stop
) -> list[int]:
    """Return the start of each node, ns of the system clock, as soon as all are known.

    Returns [] after a signal.
    """
    starts: dict[FlightNode[Any], int] = {}
    waiting = [node for node in nodes if node.is_waiting_for_start()]
    while not stop.is_requested:
        for node in nodes:
            node.warn_without_time()
        has_time = all(node.has_time() for node in nodes)
        for node in waiting:
            if has_time and node not in starts and (start_ns := node.start_ns()) is not None:
                starts[node] = start_ns
        if has_time and len(starts) == len(waiting):
            return [starts[node] if node in starts else node.start_ns() or 0 for node in nodes]
        for node in nodes:
            node.match()
        _serve(executor, nodes[0])
        time.sleep(START_POLL_PERIOD)
    return []


def _run_real_time(nodes: Sequence[FlightNode[Any]], stop: _Stop) -> None:
    """Run nodes in one thread, one tick after another.

    If the ticks of several nodes are due, the node that comes first in `nodes` ticks first.
    """
    executor = _start(nodes)
    starts = _start_instants(nodes, executor, stop)
    loops = [
        RealTime(node, start_ns, spin=len(nodes) == 1)
        for node, start_ns in zip(nodes, starts, strict=False)
    ]
    serve_ns = time.monotonic_ns()
    period_ns = nanoseconds(IDLE_POLL_PERIOD if len(nodes) == 1 else SERVICE_POLL_PERIOD)
    disable_timer_slack()
    request_short_slices()
    while not stop.is_requested:
        upcoming = min(loops, key=lambda each: each.ticker.remaining())
        upcoming.ticker.wait(IDLE_POLL_PERIOD)
        last = next((each for each in loops if each.run_due_tick()), upcoming)
        now_ns = time.monotonic_ns()
        if now_ns >= serve_ns:
            # Requests may take half of the time to the next tick.
            remaining = min(each.ticker.remaining() for each in loops)
            _serve(executor, nodes[0], now_ns + nanoseconds(max(remaining, 0.0) / 2.0))
            for node in nodes:
                node.require_flight()
                node.warn_without_time()
                node.match()
            duration_ns = time.monotonic_ns() - now_ns
            is_late = min(each.ticker.remaining() for each in loops) <= 0.0
            pause_ns = LATE_REQUEST_PAUSE * duration_ns if is_late else 0
            serve_ns = now_ns + max(period_ns, min(pause_ns, LONGEST_PAUSE_NS))
        last.report()
