# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""The bridge's node: y from the topics of an autopilot, u to them, by a channel map; in the place of the aircraft's node."""

import time
from typing import Any

from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.qos import DurabilityPolicy, QoSCompatibility, QoSProfile, ReliabilityPolicy, qos_check_compatible
from rclpy.serialization import deserialize_message
from sensor_msgs.msg import JointState
from std_srvs.srv import SetBool

from autopilot_bridge.bridge import Bridge, Phase
from autopilot_bridge.channel_map import get_field, message_type, read_raw, set_field
from autopilot_bridge.params import BridgeParameters, InputRow, MessageRow, OutputRow, OverrideRow, QosRow, load_map
from flight_core.parameters import ParameterError
from flight_core.rates import NANOSECONDS, nanoseconds, period_ns
from flight_core.vectors import ChannelError
from flight_ros.flight_node import FlightNode
from flight_ros.rclpy_private import DeserializationError
from flight_ros.subscriptions import PolledSubscription
from flight_ros.ticker import Tick
from flight_ros.topics import Topic, U, Y

WOULD_SEND = Topic("bridge/would_send", JointState)
FAREWELL = 5  # messages that give the channels back when the node ends: one alone may be lost


class BridgeNode(FlightNode[BridgeParameters]):
    """At each tick: what the autopilot said, y out when it is new, the newest u, and the messages that are due."""

    def __init__(self) -> None:
        super().__init__("bridge", BridgeParameters)
        self._map = load_map(self.parameters.map)
        dry_run = self._map.dry_run if self.parameters.dry_run is None else self.parameters.dry_run
        self._bridge = Bridge(self._map, dry_run=dry_run)
        self._said_phase = self._bridge.phase
        named: list[tuple[str, OutputRow | OverrideRow]] = [*self._map.outputs.items(), *self._map.overrides.items()]
        readers: dict[str, list[tuple[str, OutputRow | OverrideRow]]] = {}
        for name, row in named:
            readers.setdefault(row.topic, []).append((name, row))
        self._readers: list[tuple[PolledSubscription, list[tuple[str, OutputRow | OverrideRow]]]] = []
        for topic, rows in readers.items():
            kind = message_type(rows[0][1].type)
            for name, row in rows:
                _require_field(kind(), name, row)
            self._readers.append((self.subscribe(Topic(topic, kind, foreign=True), _qos(self._map.topics[topic])), rows))
        self._outgoing = {name: self._make(name, row) for name, row in self._map.messages.items()}
        self._u_subscription, self._decoder = self.subscribe(U), self.decoder(U, self._bridge.inputs)
        self._publish_y, self._publish_would_send = self.advertise(Y), self.advertise(WOULD_SEND)
        self._y_encoder = self.encoder(Y, self._bridge.outputs)
        names = [f"{row.message}.{row.field}" for row in self._map.inputs.values()]
        self._would_send_encoder = self.encoder(WOULD_SEND, names)
        self.create_service(SetBool, "~/engage", self._engage)
        self.get_logger().info(
            f"map {self._map.name}: "
            + ("dry run, nothing is sent" if dry_run else f"disengaged, waiting for {self.get_name()}/engage")
        )

    def _make(self, name: str, row: MessageRow) -> "Outgoing":
        message = message_type(row.type)()
        rows = [(number, one) for number, one in enumerate(self._map.inputs.values()) if one.message == name]
        try:
            for path, value in row.values.items():
                set_field(message, path, value)
            for _, one in rows:
                for raw in (one.neutral, one.release, *one.range):
                    set_field(message, one.field, raw)
            if row.stamped:
                get_field(message, "header.stamp")
        except ChannelError as error:
            raise ParameterError(f"map {self._map.name}: messages.{name} of type {row.type}: {error}") from None
        publisher = self.create_publisher(type(message), row.topic, _qos(self._map.topics[row.topic]))
        return Outgoing(publisher, message, row, rows)

    def period_ns(self) -> int:
        return period_ns(self._map.rate, "rate")

    def tick(self, tick: Tick, now_ns: int) -> None:
        now_ns += tick.late_ns
        for subscription, rows in self._readers:
            for received in subscription.take():
                self._read(subscription, rows, received.message, received.received_ns or now_ns, now_ns)
        sample = self._bridge.y(now_ns)
        if sample is not None:
            self._publish_y(self._y_encoder.encode(sample.stamp_ns, sample.value))
        if self._take_u(now_ns):
            self._publish_would_send(self._would_send_encoder.encode(now_ns, self._bridge.raw_u()))
        self._bridge.step(now_ns)
        self._say_phase()
        self._send(now_ns, self.period_ns() // 2)
        self._say_what_is_missing(now_ns)

    def _read(
        self,
        subscription: PolledSubscription,
        rows: list[tuple[str, OutputRow | OverrideRow]],
        raw: bytes,
        arrived_ns: int,
        now_ns: int,
    ) -> None:
        try:
            message = deserialize_message(raw, subscription.topic.type)
        except DeserializationError as error:
            self.reject(subscription, "malformed", " ".join(str(error).split()))
            return
        for name, row in rows:
            try:
                if isinstance(row, OverrideRow):
                    self._bridge.take_override(name, read_raw(message, row.field, "value"), now_ns)
                    continue
                stamp_ns = arrived_ns
                if row.stamp == "header":
                    stamp = get_field(message, "header.stamp")
                    stamp_ns = stamp.sec * NANOSECONDS + stamp.nanosec
                self._bridge.take_output(name, read_raw(message, row.field, row.function), stamp_ns, now_ns)
            except ChannelError as error:
                self.reject(subscription, error.reason, str(error))

    def _take_u(self, now_ns: int) -> bool:
        came = False
        for received in self._u_subscription.take():
            try:
                sample = self._decoder.decode(received.message)
                if sample is not None:
                    self._bridge.take_u(sample.value, sample.sender, now_ns)
                    came = True
            except ChannelError as error:
                self.reject(self._u_subscription, error.reason, str(error))
        return came

    def _send(self, now_ns: int, slack_ns: int) -> None:
        for name, outgoing in self._outgoing.items():
            if self._bridge.sends(name, now_ns) and outgoing.due(now_ns, slack_ns):
                try:
                    outgoing.send(now_ns, self._bridge.raw().tolist())
                except ChannelError as error:
                    self.get_logger().error(f"messages.{name} not sent: {error}", throttle_duration_sec=2.0)

    def _engage(self, request: Any, response: Any) -> Any:
        now_ns = self.get_clock().now().nanoseconds
        if request.data:
            response.message = self._bridge.engage(now_ns)
        else:
            self._bridge.disengage("told to disengage", now_ns)
        response.success = not response.message
        if response.message:
            self.get_logger().warning(f"not engaged: {response.message}")
        self._say_phase()
        return response

    def _say_phase(self) -> None:
        phase = self._bridge.phase
        if phase is not self._said_phase:
            sentence = f"{self._said_phase.name} -> {phase.name}"
            if phase is Phase.ENGAGED:
                self.get_logger().info(sentence)
            else:
                self.get_logger().warning(f"{sentence}: {self._bridge.reason}")
            self._said_phase = phase

    def _say_what_is_missing(self, now_ns: int) -> None:
        stale = self._bridge.stale(now_ns)
        for subscription, rows in self._readers:
            if any(name in stale for name, row in rows if isinstance(row, OutputRow)):
                self.warn_no_publisher(subscription)
        if self._bridge.u_timed_out(now_ns):
            self.warn_no_publisher(self._u_subscription)

    def check_graph(self) -> None:
        """Also what keeps the autopilot from hearing: a topic that it takes in another type, or another quality of service."""
        super().check_graph()
        for outgoing in self._outgoing.values():
            topic = outgoing.publisher.topic_name
            for peer in self.get_subscriptions_info_by_topic(topic):
                node = f"{peer.node_namespace.rstrip('/')}/{peer.node_name}"
                if peer.topic_type != outgoing.row.type:
                    self.get_logger().error(
                        f"{topic}: {node} takes {peer.topic_type}, the map {self._map.name} sends {outgoing.row.type}",
                        throttle_duration_sec=5.0,
                    )
                    continue
                offered, wanted = _qos(self._map.topics[outgoing.row.topic]), peer.qos_profile
                asked = QoSProfile(depth=1, reliability=wanted.reliability, durability=wanted.durability)
                compatibility, reason = qos_check_compatible(offered, asked)
                if compatibility == QoSCompatibility.ERROR:
                    self.get_logger().error(
                        f"{topic}: quality of service of {node} does not fit: {reason}", throttle_duration_sec=5.0
                    )

    def status(self) -> tuple[bytes, str, dict[str, object]]:
        bridge, now_ns = self._bridge, self.get_clock().now().nanoseconds
        refusal = "" if bridge.phase is Phase.ENGAGED else bridge.refusal(now_ns)
        level = DiagnosticStatus.OK if bridge.phase is Phase.ENGAGED else DiagnosticStatus.WARN
        sentence = "ENGAGED" if bridge.phase is Phase.ENGAGED else f"{bridge.phase.name}: {bridge.reason}"
        return level, sentence, {"phase": bridge.phase.name, "map": self._map.name, "would refuse": refusal or "nothing"}

    def close(self) -> None:
        if self._bridge.phase is Phase.DISENGAGED or self._map.silence.release == 0.0:
            return
        self._bridge.disengage("the bridge ends", time.time_ns())
        for _ in range(FAREWELL):
            self._send(time.time_ns(), NANOSECONDS)  # due whenever the last one was
            time.sleep(0.01)


class Outgoing:
    """One message towards the autopilot, laid out once."""

    def __init__(self, publisher: Any, message: Any, row: MessageRow, inputs: list[tuple[int, InputRow]]) -> None:
        self.publisher, self.row = publisher, row
        self._message, self._inputs = message, inputs
        self._period_ns = nanoseconds(1.0 / row.rate)
        self._sent_ns = 0

    def due(self, now_ns: int, slack_ns: int) -> bool:
        """Whether its period has passed since it was sent, to within half a tick."""
        return now_ns - self._sent_ns >= self._period_ns - slack_ns

    def send(self, now_ns: int, raw: list[float]) -> None:
        """Send it with the raw values of all inputs, of which it takes its own."""
        for number, row in self._inputs:
            set_field(self._message, row.field, raw[number])
        if self.row.stamped:
            stamp = self._message.header.stamp
            stamp.sec, stamp.nanosec = divmod(now_ns, NANOSECONDS)
        self.publisher.publish(self._message)
        self._sent_ns = now_ns


def _qos(row: QosRow) -> QoSProfile:
    return QoSProfile(
        depth=row.depth,
        reliability=ReliabilityPolicy[row.reliability.upper()],
        durability=DurabilityPolicy[row.durability.upper()],
    )


def _require_field(empty: Any, name: str, row: OutputRow | OverrideRow) -> None:
    """Where a field lies behind a sequence, which is empty here, the first message tells; else it has to be there."""
    if "[" in row.field:
        return
    try:
        get_field(empty, row.field)
        if isinstance(row, OutputRow) and row.stamp == "header":
            get_field(empty, "header.stamp")
    except ChannelError as error:
        raise ParameterError(f"{name}.field: {error}, expected a field of {row.type}") from None
