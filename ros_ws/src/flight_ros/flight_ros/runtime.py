# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""The skeleton of every node: parameters, topics, ticks, diagnostics, a clean end."""

import gc
import math
import os
import signal
import sys
import time
import traceback
from collections import Counter, deque
from collections.abc import Callable, Sequence
from types import FrameType
from typing import Any, Generic, TypeVar

import numpy as np
import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rcl_interfaces.msg import SetParametersResult
from rclpy.duration import Duration
from rclpy.exceptions import ParameterException
from rclpy.executors import SingleThreadedExecutor, TimeoutException
from rclpy.impl.implementation_singleton import rclpy_implementation as _rclpy
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.publisher import Publisher
from rclpy.qos import QoSCompatibility, QoSProfile, qos_check_compatible
from rclpy.signals import SignalHandlerOptions

from flight_core.outcome import FlightEnded
from flight_core.parameters import KeyedParameters, NodeParameters, ParameterError
from flight_core.rates import NANOSECONDS, nanoseconds, seconds
from flight_core.seal import Seal, read_key
from flight_ros import transport
from flight_ros.company import Company
from flight_ros.inbox import Inbox, Waiter
from flight_ros.messages import Decoder, Encoder
from flight_ros.parameters import changed, read_parameters
from flight_ros.source import SENDER
from flight_ros.ticker import Tick, Ticker, wake_on_time
from flight_ros.topics import DIAGNOSTICS, LISTEN, PUBLISH, STEP, Topic, published

P = TypeVar("P", bound=NodeParameters)

ENDED_EARLY = 3  # exit status

# What rclpy raises for arguments and parameter files that it cannot read.
REFUSALS = (ParameterException, _rclpy.RCLError, _rclpy.RCLInvalidROSArgsError, _rclpy.UnknownROSArgsError)

WAIT_BEFORE_SAYING_NS = 3 * NANOSECONDS  # processes of one flight start one after the other

OLDEST_START_NS = 10 * NANOSECONDS  # a node that comes late catches up with what it missed, but not with hours

START_PATIENCE_NS = 30 * NANOSECONDS  # in lockstep, for others that never come

ACKNOWLEDGED_WITHIN = Duration(seconds=0.5)  # at the end of a lockstep flight, what was sent is left time to arrive

BUSY_PAUSE = 0.1  # s, between two looks at signals of life and service calls while a lockstep flight moves

REPEAT_NS = 2 * NANOSECONDS  # before the same is said again

CLOCK_STEP_NS = NANOSECONDS // 20  # in a second a clock is slewed by a hundredth of it

NICE_PAUSE = 0.02  # s, the longest sleep, so that a signal or a service call is not left waiting


class FlightNode(Node, Generic[P]):
    """A node that works at fixed ticks, or in lockstep. A subclass says at which rate, and what one tick or step does."""

    def __init__(self, name: str, schema: type[P], tunable: frozenset[str] = frozenset()) -> None:
        Node.__init__(self, name, automatically_declare_parameters_from_overrides=True)
        self.parameters = read_parameters(self, schema, tunable)
        if tunable:
            self.add_on_set_parameters_callback(self._change_parameters)
        self.company = Company(self, name) if self.parameters.lockstep else None
        # In lockstep the same flight gives the same bytes, so the process is left out.
        process = "" if self.parameters.lockstep else f"#{os.getpid()}"
        self.instance = self.get_fully_qualified_name() + process
        key_file = self.parameters.key_file if isinstance(self.parameters, KeyedParameters) else ""
        self._key = read_key(key_file, f"{name}.key_file") if key_file else None
        # Samples of the time before this node are not flown. Lockstep has no such time: it begins at 0, with all that was sent.
        self._since_ns = None if self.parameters.lockstep else time.time_ns()
        if self._key is not None:
            self.get_logger().info(f"samples are signed, and those that are not refused, with the key in {key_file}")
        self.rejected: Counter[str] = Counter()
        self._rejected_said_ns: dict[str, int] = {}
        self._intruder = ""  # who publishes beside the one that is listened to, since the last report
        self._inboxes: list[Inbox] = []
        self._outlets: list[Publisher] = []
        self._waiting: dict[str, tuple[int, int]] = {}  # by topic: last call, and when to say it next
        self._diagnostics = self.create_publisher(DIAGNOSTICS.type, DIAGNOSTICS.name, PUBLISH)
        self._periods: list[int] = []
        self._compute: list[int] = []
        self._missed = 0
        self._last_tick_ns: int | None = None
        self._ahead_ns = 0  # of the time of the ticks before the monotonic clock
        self._clock_ns = 0  # how far the system clock was set since the start

    # What a subclass says

    def period_ns(self) -> int:
        """The period of the ticks."""
        raise NotImplementedError

    def start_ns(self) -> int:
        """System time of tick 0 in ns; 0 starts at once."""
        return 0

    def tick(self, tick: Tick, now_ns: int) -> None:
        """One tick; `now_ns` is the nominal instant of tick.number on the system clock's scale."""
        raise NotImplementedError

    def advance(self) -> bool:
        """In lockstep: do all that can be done with what has come. Whether that was anything."""
        raise NotImplementedError

    def awaits(self) -> str:
        """In lockstep: what it waits for, for people; empty where it waits for nothing any more."""
        return ""

    def status(self) -> tuple[bytes, str, dict[str, object]]:
        """Level, sentence and further figures for the 1 Hz diagnostics."""
        return DiagnosticStatus.OK, "running", {}

    def close(self) -> None:
        """Called once when the node ends, whatever ended it."""

    def on_parameters(self, parameters: P) -> None:
        """Called with a set that was accepted in flight, before it becomes `self.parameters`."""

    # What a subclass uses

    def outlet(self, topic: Topic) -> Callable[[bytes], None]:
        """A publisher of serialised messages on a topic of the flight, as the function that publishes one."""
        qos = STEP if self.parameters.lockstep else published(self.period_ns())
        publisher = self.create_publisher(topic.type, topic.name, qos)
        self._outlets.append(publisher)
        publish: Callable[[bytes], None] = publisher.handle.publish_raw
        return publish

    def inbox(self, topic: Topic, qos: QoSProfile | None = None) -> Inbox:
        """A subscription that is read at the tick, as bytes; its publishers are checked once a second."""
        inbox = Inbox(self, topic, qos or (STEP if self.parameters.lockstep else LISTEN), raw=True)
        self._inboxes.append(inbox)
        return inbox

    def encoder(self, topic: Topic, names: Sequence[str]) -> Encoder:
        """Samples of a topic as messages of this node, signed where it has a key."""
        return Encoder(names, self.instance, self._seal(topic))

    def decoder(self, topic: Topic, wanted: Sequence[str]) -> Decoder:
        """Messages of a topic as samples; where the node has a key, those alone that are signed with it, each once."""
        return Decoder(wanted, self._seal(topic))

    def _seal(self, topic: Topic) -> Seal | None:
        return None if self._key is None else Seal(self._key, self.resolve_topic_name(topic.name), self._since_ns)

    def reject(self, inbox: Inbox, reason: str, sentence: str) -> None:
        """Count a sample that cannot be used, and say so, of each topic and reason at most once in 2 s.

        A second publisher is an alarm: an ERROR here and in the diagnostics.
        """
        what, now_ns = f"{inbox.topic.name}: {reason}", time.monotonic_ns()
        self.rejected[what] += 1
        if reason == SENDER:
            self._intruder = f"{inbox.name}: {sentence}"
        if now_ns - self._rejected_said_ns.get(what, -REPEAT_NS) < REPEAT_NS:
            return
        self._rejected_said_ns[what] = now_ns
        if reason == SENDER:
            self.get_logger().error(f"{inbox.name}: sample refused: {sentence}")
        else:
            self.get_logger().warning(f"{inbox.name}: sample refused: {sentence}")

    def now_ns(self) -> int:
        """The time of the ticks, ns: the system clock as it was at the start, gone on with the monotonic clock."""
        return time.monotonic_ns() + self._ahead_ns

    def waiting_for(self, inbox: Inbox) -> None:
        """Called at each tick while nothing comes on a topic: says so after 3 s, then every 2 s, and who is there."""
        now_ns = time.monotonic_ns()
        last_ns, say_ns = self._waiting.get(inbox.name, (0, 0))
        if now_ns - last_ns > NANOSECONDS:  # the first call since it came
            say_ns = now_ns + WAIT_BEFORE_SAYING_NS
        self._waiting[inbox.name] = now_ns, say_ns if now_ns < say_ns else now_ns + 2 * NANOSECONDS
        if now_ns < say_ns:
            return
        count = self.count_publishers(inbox.name)
        who = "its publisher sends nothing" if count else "no publisher there"
        self.get_logger().warning(f"waiting for {inbox.name}: {who}")

    def _change_parameters(self, changes: list[Parameter]) -> SetParametersResult:
        """Accept a change of tunable parameters as a whole, or refuse it with a sentence and leave everything as it was."""
        try:
            parameters = changed(self, self.parameters, changes)
        except ParameterError as error:
            self.get_logger().warning(f"parameters refused: {error}")
            return SetParametersResult(successful=False, reason=str(error))
        self.on_parameters(parameters)
        for change in changes:
            old = self.get_parameter_or(change.name).value
            self.get_logger().info(f"{change.name}: {old} -> {change.value}")
        self.parameters = parameters
        return SetParametersResult(successful=True)

    # What the loop does

    def run_tick(self, tick: Tick, now_ns: int) -> None:
        """One tick, timed."""
        begin_ns = time.monotonic_ns()
        if self._last_tick_ns is not None:
            self._periods.append(begin_ns - self._last_tick_ns)
        self._last_tick_ns = begin_ns
        self._missed += tick.missed
        self.tick(tick, now_ns)
        self._compute.append(time.monotonic_ns() - begin_ns)

    def keep_time(self, start_ns: int, monotonic_ns: int) -> None:
        """Ticks count from here: one instant on both clocks."""
        self._ahead_ns = start_ns - monotonic_ns

    def check_clock(self) -> None:
        """Say where the system clock was set: the node goes on with the time it began with, one started now does not."""
        set_ns = time.time_ns() - self.now_ns()
        if abs(set_ns - self._clock_ns) > CLOCK_STEP_NS:
            by = f"the system clock was set by {seconds(set_ns - self._clock_ns):+.3f} s"
            rest = (
                "it is right again" if abs(set_ns) <= CLOCK_STEP_NS else "this node goes on with its own; restart all or none"
            )
            self.get_logger().error(f"{by}: {rest}")
            self._clock_ns = set_ns

    def check_graph(self) -> None:
        """Say what keeps a topic silent for ever: another type, or an incompatible quality of service."""
        for publisher in self._outlets:
            self._check_listeners(publisher)
        for inbox in self._inboxes:
            wanted = f"{inbox.topic.type.__module__.split('.')[0]}/msg/{inbox.topic.type.__name__}"
            for peer in self.get_publishers_info_by_topic(inbox.name):
                node = f"{peer.node_namespace.rstrip('/')}/{peer.node_name}"
                if peer.topic_type != wanted:
                    self.get_logger().error(
                        f"{inbox.name}: {node} publishes {peer.topic_type}, expected {wanted}", throttle_duration_sec=5.0
                    )
                    continue
                compatibility, reason = qos_check_compatible(peer.qos_profile, inbox.qos)
                if compatibility == QoSCompatibility.ERROR:
                    self.get_logger().error(
                        f"{inbox.name}: quality of service of {node} does not fit: {reason}", throttle_duration_sec=5.0
                    )

    def _check_listeners(self, publisher: Publisher) -> None:
        known = self.get_publishers_info_by_topic(publisher.topic_name)
        offered = next((one.qos_profile for one in known if one.node_name == self.get_name()), None)
        if offered is None:  # the graph does not know of it yet; it tells of both sides in the same terms
            return
        for peer in self.get_subscriptions_info_by_topic(publisher.topic_name):
            compatibility, reason = qos_check_compatible(offered, peer.qos_profile)
            if compatibility == QoSCompatibility.ERROR:
                node = f"{peer.node_namespace.rstrip('/')}/{peer.node_name}"
                self.get_logger().error(
                    f"{publisher.topic_name}: quality of service of {node}, which listens, does not fit: {reason}",
                    throttle_duration_sec=5.0,
                )

    def steps(self) -> bool:
        """Whether it moves by `advance` in lockstep; else by `tick` in real time."""
        return self.parameters.lockstep

    def inboxes(self) -> list[Inbox]:
        """What it listens to."""
        return self._inboxes

    def require_company(self) -> None:
        """Raise FlightEnded where a node that took part in lockstep is gone."""
        if self.company is not None and (role := self.company.missing()):
            raise FlightEnded(f"{role} is gone")

    def finish(self) -> None:
        """The end of the node: in lockstep what was sent is left time to arrive."""
        self.close()
        if self.parameters.lockstep and not (self.company and self.company.missing()):
            for publisher in self.publishers:
                publisher.wait_for_all_acked(ACKNOWLEDGED_WITHIN)

    def publish_diagnostics(self) -> None:
        """The 1 Hz report: loop period, compute time, missed ticks, refused samples, and what the node adds."""
        level, sentence, figures = self.status()
        if self._intruder:
            level, sentence, self._intruder = DiagnosticStatus.ERROR, self._intruder, ""
        shown: dict[str, object] = {"missed ticks": self._missed}
        for key, sample in (("period", self._periods), ("compute time", self._compute)):
            if sample:
                values = np.sort(sample) * 1e-9
                nearest = math.ceil(0.99 * len(values)) - 1  # np.percentile would load numpy.ma in the middle of a tick
                shown |= {
                    f"{key} mean (s)": f"{values.mean():.6f}",
                    f"{key} p99 (s)": f"{values[nearest]:.6f}",
                    f"{key} max (s)": f"{values[-1]:.6f}",
                }
                sample.clear()
        shown |= {f"refused {reason}": count for reason, count in self.rejected.items()} | figures
        message = DiagnosticArray()
        message.header.stamp = self.get_clock().now().to_msg()
        message.header.frame_id = self.instance
        message.status = [
            DiagnosticStatus(
                level=level,
                name=self.get_fully_qualified_name(),
                message=sentence,
                hardware_id=self.instance,
                values=[KeyValue(key=key, value=str(value)) for key, value in shown.items()],
            )
        ]
        self._diagnostics.publish(message)


class _Stop:
    """Set by a signal handler. No lock: an Event's would hang for ever when a second signal comes inside the first handler."""

    requested = False

    def request(self, number: int, frame: FrameType | None) -> None:
        self.requested = True


def run(*make_nodes: Callable[[], FlightNode[Any]], herald: _rclpy.Node | None = None) -> None:
    """Run a node, or several in lockstep, until SIGINT or SIGTERM, then leave with exit status 0.

    Otherwise 2 for bad parameters, 3 for a flight that cannot go on, 1 for a fault. `herald` has come before them and goes when
    they are there (flight_ros.start).

    Ticks run on the monotonic clock in the main thread; what comes over topics is taken at the tick. In lockstep there are no
    ticks: a node moves when what it needs has come. The executor serves parameters and services, after ticks and without ever
    waiting.
    """
    stop = _Stop()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, stop.request)
    try:
        nodes = _made(make_nodes, herald)
    except ParameterError as error:
        sys.exit(_refuse(str(error)))
    except FlightEnded as error:
        _refuse(str(error))
        sys.exit(ENDED_EARLY)
    except REFUSALS as error:
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


def _made(make_nodes: Sequence[Callable[[], FlightNode[Any]]], herald: _rclpy.Node | None) -> list[FlightNode[Any]]:
    transport.prepare()
    if not rclpy.ok():
        rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    nodes = [make_node() for make_node in make_nodes]
    if herald is not None:
        herald.destroy_when_not_in_use()
    return nodes


def _refuse(sentence: str) -> int:
    print(f"error: {sentence}", file=sys.stderr)
    rclpy.try_shutdown()
    return 2


def _serve(executor: SingleThreadedExecutor, node: FlightNode[Any], until_ns: int = 0) -> None:
    """Serve one request, where there is one, and further ones until an instant of the monotonic clock."""
    while True:
        try:
            handler, _, _ = executor.wait_for_ready_callbacks(0, None, lambda: False)
        except TimeoutException:
            return
        try:
            handler()
            handler.result()  # raises what it has raised
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
        node.get_logger().info("ready")
    return executor


def _step(nodes: Sequence[FlightNode[Any]], stop: _Stop) -> None:
    executor = _begin(nodes)
    waiter = Waiter([inbox for node in nodes for inbox in node.inboxes()], nodes[0].context)
    begin_ns = serve_ns = report_ns = time.monotonic_ns()
    moved = False
    while not stop.requested:
        moving = [node.advance() for node in nodes]
        if any(moving):
            moved = True
        elif not waiter.wait(nanoseconds(NICE_PAUSE)):
            serve_ns = 0  # nothing comes: perhaps one of the others is gone
        now_ns = time.monotonic_ns()
        if now_ns >= serve_ns:
            serve_ns = now_ns + nanoseconds(BUSY_PAUSE)
            _serve(executor, nodes[0])
            for node in nodes:
                node.require_company()
        if now_ns >= report_ns:
            report_ns = now_ns + NANOSECONDS
            for node in nodes:
                node.publish_diagnostics()
                node.check_graph()
            if not moved and now_ns - begin_ns > START_PATIENCE_NS:
                raise FlightEnded(f"waited {seconds(START_PATIENCE_NS):g} s for {nodes[0].awaits()}: nobody there")


def _loop(node: FlightNode[Any], stop: _Stop) -> None:
    executor = _begin([node])
    start_ns = node.start_ns() or time.time_ns()
    if (past := time.time_ns() - start_ns) > OLDEST_START_NS:
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
    wake_on_time()
    while not stop.requested:
        ticker.wait(NICE_PAUSE)
        if (tick := ticker.due()) is not None:
            node.run_tick(tick, start_ns + tick.number * ticker.period_ns)
        now_ns = time.monotonic_ns()
        if now_ns >= serve_ns:
            serve_ns = now_ns + nanoseconds(NICE_PAUSE)
            # half of what is left to the next tick, which no request may hold up
            _serve(executor, node, now_ns + nanoseconds(max(ticker.remaining(), 0.0) / 2.0))
            node.require_company()
        if now_ns >= report_ns:
            report_ns = now_ns + NANOSECONDS
            chores += (node.publish_diagnostics, node.check_graph, node.check_clock)
        if chores:  # one a tick: together they may outlast a period of 2 ms
            chores.popleft()()
