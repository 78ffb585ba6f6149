# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Run nodes in the process of a test.

The test moves their time, and their topics are queues. Nothing else differs. A node is its class of
the stack on a node of rclpy, with its parameters, its services and its ticks. Three things are
replaced: the functions that make publishers, subscriptions and clients; the module `time`, as the
modules of the stack see it; and the logger. A message is serialised when it is published, and waits
in the queue of each subscription until the node takes it.
"""

import sys
import time
from collections import defaultdict, deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple, Self, TypeVar, cast

import numpy as np
import pytest
import rclpy
import rclpy.publisher
from rclpy.node import Node
from rclpy.qos import QoSProfile
from rclpy.serialization import deserialize_message, serialize_message
from rclpy.task import Future
from rclpy.topic_endpoint_info import TopicEndpointTypeEnum
from sensor_msgs.msg import JointState

from flight_core.rates import NANOSECONDS, nanoseconds
from flight_ros.endpoints import type_name
from flight_ros.event_loop import RealTime
from flight_ros.flight_node import FlightNode
from flight_ros.messages import Encoder, NamedDecoder, NamedSample
from flight_ros.topics import PUBLISH

T = TypeVar("T")
AnyNode = FlightNode[Any]

OUTPUTS = ("q", "V", "p", "r")
INPUTS = ("elevator", "thrust", "aileron", "rudder")
EPOCH_NS = 1_700_000_000 * NANOSECONDS  # of the system clock where the monotonic clock is 0
STEP = 0.005  # s, between two calls of what the test does meanwhile
LIMIT = 60.0  # s of the time of the test, until a wait fails


class Clock:
    """The time of the host, which replaces the module `time`.

    Other functions of the module are unchanged.
    """

    def __init__(self) -> None:
        self.now_ns = 1000 * NANOSECONDS
        self.step_ns = 0  # by which the system clock was set
        self.suspended_ns = 0  # of the host, in which the monotonic clock stands still

    def monotonic_ns(self) -> int:
        """Return the monotonic clock, ns."""
        return self.now_ns

    def time_ns(self) -> int:
        """Return the system clock, ns."""
        return EPOCH_NS + self.now_ns + self.step_ns

    def monotonic(self) -> float:
        """Return the monotonic clock, s."""
        return self.now_ns / NANOSECONDS

    def time(self) -> float:
        """Return the system clock, s."""
        return self.time_ns() / NANOSECONDS

    def clock_gettime_ns(self, clock: int) -> int:
        """Return CLOCK_BOOTTIME, ns."""
        return self.now_ns + self.suspended_ns

    def sleep(self, duration: float) -> None:
        """Move the time."""
        self.now_ns += nanoseconds(duration)

    def __getattr__(self, name: str) -> Any:
        return getattr(time, name)


class Endpoint(NamedTuple):
    """A publisher or subscription in the graph, as rclpy describes it."""

    topic: str
    topic_type: str
    qos_profile: QoSProfile
    node_name: str
    node_namespace: str
    endpoint_type: TopicEndpointTypeEnum


class Publisher(rclpy.publisher.Publisher):  # type: ignore[misc]
    """A publisher of a node, or of the test."""

    def __init__(
        self, world: "World", kind: type, topic: str, qos: QoSProfile | int, node: str
    ) -> None:
        self.kind = kind
        self.sequence = 0
        self._world = world
        self._topic = topic
        self.endpoint = world.endpoint(topic, kind, qos, node, TopicEndpointTypeEnum.PUBLISHER)

    @property
    def topic_name(self) -> str:
        """Return the full name."""
        return self._topic

    def publish(self, message: Any) -> None:
        """Put a message, or its bytes, into the queue of each subscription."""
        self.sequence += 1
        raw = message if isinstance(message, bytes) else serialize_message(message)
        self._world.deliver(self.topic_name, self.kind, raw, self.sequence)

    def lose(self, count: int) -> None:
        """Skip the numbers of messages that no subscription receives."""
        self.sequence += count

    def leave(self) -> None:
        """Leave the graph."""
        self._world.graph.remove(self.endpoint)

    def wait_for_all_acked(self, timeout: object) -> bool:
        """Return at once, because nothing waits."""
        return True


class Subscription:
    """A subscription of a node. Its `handle`, which rclpy has, is the subscription itself."""

    def __init__(
        self, world: "World", kind: type, topic: str, qos: QoSProfile | int, node: str, *, raw: bool
    ) -> None:
        self.topic_name = topic
        self.msg_type = kind
        self.raw = raw
        self.endpoint = world.endpoint(topic, kind, qos, node, TopicEndpointTypeEnum.SUBSCRIPTION)
        self.queue: deque[tuple[bytes, dict[str, int]]] = deque(
            maxlen=self.endpoint.qos_profile.depth
        )
        self._world = world

    @property
    def handle(self) -> Self:
        """Return the object that takes messages."""
        return self

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        return None

    def take_message(self, kind: type, raw: bool) -> tuple[Any, dict[str, int]] | None:
        """Return the oldest message with its metadata, or None if there is none."""
        if not self.queue:
            return None
        message, information = self.queue.popleft()
        return message if raw else deserialize_message(message, kind), information

    def get_publisher_count(self) -> int:
        """Return the number of publishers of the topic."""
        return len(self._world.publishers(self.topic_name))


class Client:
    """A client of a service of another node, or of a service that the test answers."""

    def __init__(self, world: "World", service: str) -> None:
        self._world = world
        self._service = service
        self.srv_name = service

    def service_is_ready(self) -> bool:
        """Return whether a service answers."""
        return self._service in self._world.services()

    def call_async(self, request: Any) -> Future:
        """Return the response at once. A service that returns None never answers."""
        future = Future()
        if (response := self._world.services()[self._service](request)) is not None:
            future.set_result(response)
        return future


class Log:
    """The logger of a node, which keeps the lines."""

    def __init__(self) -> None:
        self.lines: list[str] = []  # "[SEVERITY] text"

    def _keep(self, severity: str, line: str) -> None:
        self.lines.append(f"[{severity}] {line}")

    def __getattr__(self, severity: str) -> Callable[..., None]:
        return lambda line, **_: self._keep(severity.upper(), line)


class InWorld:
    """A base that comes before the class of a node.

    Publishers, subscriptions, clients and the logger are then those of the world.
    """

    world: "World"
    log: Log

    def get_logger(self) -> Log:
        """Return the logger, which has the lines."""
        return self.log

    def create_publisher(
        self: Any, kind: type, topic: str, qos: QoSProfile | int, **_: object
    ) -> Publisher:
        """Return a publisher of the world."""
        return Publisher(
            self.world, kind, self.resolve_topic_name(topic), qos, self.get_fully_qualified_name()
        )

    def create_subscription(
        self: Any,
        kind: type,
        topic: str,
        callback: object,
        qos: QoSProfile | int,
        *,
        raw: bool = False,
        **_: object,
    ) -> Subscription:
        """Return a subscription of the world."""
        name = self.resolve_topic_name(topic)
        node = self.get_fully_qualified_name()
        return cast("World", self.world).subscribe(kind, name, qos, node, raw=raw)

    def destroy_subscription(self, subscription: Subscription) -> None:
        """End a subscription."""
        self.world.subscriptions.remove(subscription)
        self.world.graph.remove(subscription.endpoint)

    def create_client(self: Any, kind: type, service: str, **_: object) -> Client:
        """Return a client of the world."""
        return Client(self.world, self.resolve_service_name(service))

    def count_publishers(self: Any, topic: str) -> int:
        """Return the number of publishers of a topic."""
        return len(self.world.publishers(self.resolve_topic_name(topic)))

    def count_subscribers(self: Any, topic: str) -> int:
        """Return the number of subscriptions of a topic."""
        return len(self.get_subscriptions_info_by_topic(self.resolve_topic_name(topic)))

    def get_publishers_info_by_topic(self, topic: str) -> list[Endpoint]:
        """Return the publishers of a topic by its full name."""
        return self.world.publishers(topic)

    def get_subscriptions_info_by_topic(self, topic: str) -> list[Endpoint]:
        """Return the subscriptions of a topic by its full name."""
        kind = TopicEndpointTypeEnum.SUBSCRIPTION
        return [
            each for each in self.world.graph if each.topic == topic and each.endpoint_type is kind
        ]


class World:
    """The nodes of a test, the graph between them, and their time.

    It keeps the messages that they have published.
    """

    def __init__(self, clock: Clock) -> None:
        self.clock = clock
        self.graph: list[Endpoint] = []
        self.subscriptions: list[Subscription] = []
        # by the full name of the topic
        self.sent: dict[str, list[tuple[type, bytes]]] = defaultdict(list)
        # services of the test, by their full names
        self.answers: dict[str, Callable[[Any], Any]] = {}
        self.loops: dict[AnyNode, RealTime] = {}
        self.nodes: list[AnyNode] = []
        # of the test, by full topic
        self.listeners: dict[str, list[Callable[[Any], object]]] = defaultdict(list)
        self._own: dict[tuple[str, type], Publisher] = {}  # publishers of the test

    # Nodes

    def make(self, node: type[AnyNode]) -> Any:
        """Return a node that does not run."""
        made = cast(Any, type(node.__name__, (InWorld, node), {"world": self, "log": Log()}))()
        self.nodes.append(made)
        return made

    def start(self, node: type[AnyNode]) -> Any:
        """Return a node that runs as the event loop runs it."""
        made = self.make(node)
        self.begin(made)
        return made

    def begin(self, node: AnyNode) -> None:
        """Run a node that was made."""
        self.loops[node] = RealTime(node, node.start_ns() or 0, spin=False)

    @contextmanager
    def stopped(self, node: AnyNode) -> Iterator[None]:
        """Stop a node, as SIGSTOP does, until the block is left."""
        loop = self.loops.pop(node)
        yield
        self.loops[node] = loop

    def end(self, node: AnyNode) -> None:
        """End a node, as SIGINT does."""
        self.loops.pop(node, None)
        self.nodes.remove(node)
        node.finish()
        node.destroy_node()

    def kill(self, node: AnyNode) -> None:
        """End a node as SIGKILL does.

        What the node published stays in the graph, as during the lease of a participant.
        """
        self.loops.pop(node, None)
        self.nodes.remove(node)
        node.destroy_node()

    # Time

    def run(self, duration: float, each: Callable[[], object] | None = None) -> None:
        """Run the nodes for a duration, s. `each` is called every STEP."""
        end_ns = self.clock.now_ns + nanoseconds(duration)
        self._run(lambda: self.clock.now_ns >= end_ns, each, end_ns)

    def until(
        self, condition: Callable[[], T], because: str, each: Callable[[], object] | None = None
    ) -> T:
        """Run the nodes until a condition is true, and return what it returned."""
        end_ns = self.clock.now_ns + nanoseconds(LIMIT)
        value = self._run(condition, each, end_ns)
        lines = [
            f"{node.get_name()}: {line}"
            for node in self.nodes
            for line in node.get_logger().lines[-20:]
        ]
        assert value, "\n".join([f"not within {LIMIT:g} s: {because}", *lines])
        return value

    def _run(self, condition: Callable[[], T], each: Callable[[], object] | None, end_ns: int) -> T:
        call_ns = self.clock.now_ns
        while not (value := condition()) and self.clock.now_ns < end_ns:
            if each is not None and self.clock.now_ns >= call_ns:
                call_ns = self.clock.now_ns + nanoseconds(STEP)
                each()
            for loop in list(self.loops.values()):
                while loop.run_due_tick():
                    loop.report()
            deadlines = [
                self.clock.now_ns + nanoseconds(loop.ticker.remaining())
                for loop in self.loops.values()
            ]
            self.clock.now_ns = max(
                min([*deadlines, end_ns, call_ns if each is not None else end_ns]),
                self.clock.now_ns + 1,
            )
        return value

    # Messages

    def endpoint(
        self, topic: str, kind: type, qos: QoSProfile | int, node: str, role: TopicEndpointTypeEnum
    ) -> Endpoint:
        """Add an endpoint to the graph."""
        namespace, _, name = node.rpartition("/")
        profile = QoSProfile(depth=qos) if isinstance(qos, int) else qos
        self.graph.append(Endpoint(topic, type_name(kind), profile, name, namespace or "/", role))
        return self.graph[-1]

    def publishers(self, topic: str) -> list[Endpoint]:
        """Return the publishers of a topic by its full name."""
        kind = TopicEndpointTypeEnum.PUBLISHER
        return [each for each in self.graph if each.topic == topic and each.endpoint_type is kind]

    def subscribe(
        self, kind: type, topic: str, qos: QoSProfile | int, node: str, *, raw: bool
    ) -> Subscription:
        """Add a subscription."""
        self.subscriptions.append(Subscription(self, kind, topic, qos, node, raw=raw))
        return self.subscriptions[-1]

    def deliver(self, topic: str, kind: type, raw: bytes, sequence: int) -> None:
        """Put a message into the queue of each subscription of its topic and type."""
        self.sent[topic].append((kind, raw))
        now_ns = self.clock.time_ns()
        information = {
            "source_timestamp": now_ns,
            "received_timestamp": now_ns,
            "publication_sequence_number": sequence,
        }
        for subscription in self.subscriptions:
            if subscription.topic_name == topic and subscription.msg_type is kind:
                subscription.queue.append((raw, information))
        for listener in self.listeners[topic]:
            listener(deserialize_message(raw, kind))

    def publisher(
        self, kind: type, topic: str, qos: QoSProfile | int = PUBLISH, node: str = "/peer"
    ) -> Publisher:
        """Return a publisher of the test."""
        return Publisher(self, kind, topic, qos, node)

    # As a node of rclpy has them, for what the test simulates

    def create_publisher(self, kind: type, topic: str, qos: QoSProfile | int) -> Publisher:
        """Return a publisher of the test."""
        return self.publisher(kind, topic, qos)

    def create_subscription(
        self, kind: type, topic: str, callback: Callable[[Any], object], qos: QoSProfile | int
    ) -> None:
        """Call back with each message of a topic."""
        self.listeners[topic].append(callback)

    def publish(self, topic: str, message: Any) -> None:
        """Publish a message of the test."""
        key = topic, type(message)
        if key not in self._own:
            self._own[key] = self.publisher(type(message), topic)
        self._own[key].publish(message)

    def send(
        self, topic: str, channels: Mapping[str, float], sender: str = "/peer#1", age: float = 0.0
    ) -> None:
        """Publish a named vector of the test with a stamp `age` s ago."""
        stamp_ns = self.clock.time_ns() - nanoseconds(age)
        raw = Encoder([*channels], sender).encode(
            stamp_ns, np.array([*channels.values()], dtype=np.float64)
        )
        key = topic, JointState
        if key not in self._own:
            self._own[key] = self.publisher(JointState, topic)
        self._own[key].publish(raw)

    def leave(self, topic: str) -> None:
        """End what the test publishes on a topic."""
        for key in [key for key in self._own if key[0] == topic]:
            self._own.pop(key).leave()

    def vectors(self, topic: str) -> list[NamedSample]:
        """Return the named vectors that were published on a topic."""
        return [NamedDecoder().decode(raw) for _, raw in self.sent[topic]]

    def last(self, topic: str) -> dict[str, float]:
        """Return the channels of the last named vector of a topic.

        Before the first, it is empty.
        """
        return NamedDecoder().decode(self.sent[topic][-1][1]).channels if self.sent[topic] else {}

    def messages(self, topic: str) -> list[Any]:
        """Return the messages that were published on a topic."""
        return [deserialize_message(raw, kind) for kind, raw in self.sent[topic]]

    # Services

    def services(self) -> dict[str, Callable[[Any], Any]]:
        """Return the functions that answer requests, by the full name of the service."""
        found = dict(self.answers)
        for node in self.nodes:
            for service in node.services:
                found[node.resolve_service_name(service.srv_name)] = partial(_answer, service)
        return found

    def call(self, service: str, request: Any) -> Any:
        """Return the response of a service by its full name."""
        return self.services()[service](request)


def _answer(service: Any, request: Any) -> Any:
    return service.callback(request, service.srv_type.Response())


def stamp_ns(message: Any) -> int:
    """Return the stamp of a message with a header."""
    return int(message.header.stamp.sec) * NANOSECONDS + int(message.header.stamp.nanosec)


def diagnostics(world: World, node: str) -> tuple[str, dict[str, str]]:
    """Return the sentence and the figures of the newest diagnostics of a node by its full name."""
    reports = [
        status
        for message in world.messages("/diagnostics")
        for status in message.status
        if status.name == node
    ]
    return (
        (reports[-1].message, {value.key: value.value for value in reports[-1].values})
        if reports
        else ("", {})
    )


@contextmanager
def clients_of(world: World) -> Iterator[None]:
    """Give clients of commands that are made in the block the endpoints of the world."""

    def create(name: str, **values: Any) -> Any:
        made = type("ClientNode", (InWorld, Node), {"world": world, "log": Log()})
        return made(name, **values)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(rclpy, "create_node", create)
        yield


@contextmanager
def world_of(*arguments: str) -> Iterator[World]:
    """Yield a world whose nodes have these arguments of ROS.

    Its time is the time of the stack's modules.
    """
    clock = Clock()
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "OFF")
        for module in modules_of_stack():
            if vars(module).get("time") is time:
                patch.setattr(module, "time", clock)
        rclpy.init(args=["--ros-args", *arguments])
        made = World(clock)
        try:
            yield made
        finally:
            for node in list(made.nodes):
                made.end(node)
            rclpy.try_shutdown()


SOURCES = Path(__file__).resolve().parents[2] / "ros_ws" / "src"
PACKAGES = {path.parent.name for path in SOURCES.glob("*/package.xml")}


def modules_of_stack() -> Iterable[Any]:
    """Return the loaded modules of the packages."""
    return [
        module for name, module in sys.modules.copy().items() if name.partition(".")[0] in PACKAGES
    ]


def parameters(values: Mapping[str, object]) -> Sequence[str]:
    """Return arguments that set parameters of nodes, by "NODE.NAME"."""
    return [
        word
        for key, value in values.items()
        for word in ("-p", f"{key.replace('.', ':', 1)}:={value}")
    ]
