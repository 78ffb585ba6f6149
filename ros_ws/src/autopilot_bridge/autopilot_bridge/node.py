# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""The bridge node, in place of the aircraft node: y from an autopilot and setpoints for u to it, by a channel map."""

import time
from typing import Any

from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.serialization import deserialize_message
from sensor_msgs.msg import JointState
from std_srvs.srv import SetBool

from autopilot_bridge.bridge import Bridge, Phase
from autopilot_bridge.channel_map import get_field, message_type, read_raw, set_field
from autopilot_bridge.params import BridgeParameters, InputRow, MeasuredRow, MessageRow, OverrideRow, QosRow, load_map
from flight_core.parameters import ParameterError
from flight_core.rates import NANOSECONDS, nanoseconds, period_ns
from flight_core.vectors import ChannelError
from flight_ros.flight_node import FlightNode
from flight_ros.messages import Encoder
from flight_ros.rclpy_private import DeserializationError
from flight_ros.subscriptions import PolledSubscription
from flight_ros.ticker import Tick
from flight_ros.topics import POSE, Topic, U, Y

WOULD_SEND = Topic("bridge/would_send", JointState)
RELEASES_AT_SHUTDOWN = 5  # messages with release values at the end of the node; a single one may be lost

NamedRow = tuple[str, MeasuredRow | OverrideRow]


class BridgeNode(FlightNode[BridgeParameters]):
    """At each tick it polls the autopilot's topics, publishes a new y, takes the newest u and sends the due messages."""

    def __init__(self) -> None:
        super().__init__("bridge", BridgeParameters)
        self._map = load_map(self.parameters.map)
        dry_run = self._map.dry_run if self.parameters.dry_run is None else self.parameters.dry_run
        self._bridge = Bridge(self._map, dry_run=dry_run)
        self._logged_phase = self._bridge.phase
        named: list[NamedRow] = [*self._map.outputs.items(), *self._map.pose.items(), *self._map.overrides.items()]
        rows_by_topic: dict[str, list[NamedRow]] = {}
        for name, row in named:
            rows_by_topic.setdefault(row.topic, []).append((name, row))
        self._readers: list[tuple[PolledSubscription, list[NamedRow]]] = []
        for topic, rows in rows_by_topic.items():
            kind = message_type(rows[0][1].type)
            for name, row in rows:
                _require_field(kind(), name, row)
            self._readers.append((self.subscribe(Topic(topic, kind, foreign=True), _qos(self._map.topics[topic])), rows))
        self._outgoing = {name: self._make(name, row) for name, row in self._map.messages.items()}
        self._u_subscription, self._decoder = self.subscribe(U), self.decoder(U, self._bridge.inputs)
        self._publish_y, self._publish_would_send = self.advertise(Y), self.advertise(WOULD_SEND)
        self._y_encoder = self.encoder(Y, self._bridge.outputs)
        self._publish_pose = self.advertise(POSE) if self._map.pose else None
        self._pose_encoders: dict[tuple[str, ...], Encoder] = {}  # by the names of the fresh channels
        names = [f"{row.message}.{row.field}" for row in self._map.inputs.values()]
        self._would_send_encoder = self.encoder(WOULD_SEND, names)
        self.create_service(SetBool, "~/engage", self._engage)
        self.get_logger().info(
            f"map {self._map.name}: "
            + ("dry run, nothing is sent" if dry_run else f"disengaged, waiting for {self.get_name()}/engage")
        )

    def _make(self, name: str, row: MessageRow) -> "OutgoingMessage":
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
        return OutgoingMessage(publisher, message, row, rows)

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
        if self._publish_pose is not None and (fresh := self._bridge.pose(now_ns)) is not None:
            names, pose = fresh
            if names not in self._pose_encoders:
                self._pose_encoders[names] = self.encoder(POSE, names)
            self._publish_pose(self._pose_encoders[names].encode(pose.stamp_ns, pose.value))
        if self._take_u(now_ns):
            self._publish_would_send(self._would_send_encoder.encode(now_ns, self._bridge.raw_u()))
        self._bridge.step(now_ns)
        self._log_phase()
        self._send(now_ns, self.period_ns() // 2)
        self._warn_stale_inputs(now_ns)

    def _read(self, subscription: PolledSubscription, rows: list[NamedRow], raw: bytes, arrived_ns: int, now_ns: int) -> None:
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
        """Take the received u; whether there was a valid one."""
        accepted = False
        for received in self._u_subscription.take():
            try:
                sample = self._decoder.decode(received.message)
                if sample is not None:
                    self._bridge.take_u(sample.value, sample.sender, now_ns)
                    accepted = True
            except ChannelError as error:
                self.reject(self._u_subscription, error.reason, str(error))
        return accepted

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
            self._bridge.disengage("disengaged by request", now_ns)
        response.success = not response.message
        if response.message:
            self.get_logger().warning(f"not engaged: {response.message}")
        self._log_phase()
        return response

    def _log_phase(self) -> None:
        phase = self._bridge.phase
        if phase is not self._logged_phase:
            sentence = f"{self._logged_phase.name} -> {phase.name}"
            if phase is Phase.ENGAGED:
                self.get_logger().info(sentence)
            else:
                self.get_logger().warning(f"{sentence}: {self._bridge.reason}")
            self._logged_phase = phase

    def _warn_stale_inputs(self, now_ns: int) -> None:
        stale = self._bridge.stale(now_ns)
        for subscription, rows in self._readers:
            if any(name in stale for name, row in rows if isinstance(row, MeasuredRow)):
                self.warn_no_publisher(subscription)
        if self._bridge.u_timed_out(now_ns):
            self.warn_no_publisher(self._u_subscription)

    def check_graph(self) -> None:
        """Also report a topic to which the autopilot subscribes with another type or an incompatible quality of service."""
        super().check_graph()
        for outgoing in self._outgoing.values():
            self.check_subscribers(outgoing.publisher)

    def status(self) -> tuple[bytes, str, dict[str, object]]:
        bridge, now_ns = self._bridge, self.get_clock().now().nanoseconds
        refusal = "" if bridge.phase is Phase.ENGAGED else bridge.refusal(now_ns)
        level = DiagnosticStatus.OK if bridge.phase is Phase.ENGAGED else DiagnosticStatus.WARN
        sentence = "ENGAGED" if bridge.phase is Phase.ENGAGED else f"{bridge.phase.name}: {bridge.reason}"
        return level, sentence, {"phase": bridge.phase.name, "map": self._map.name, "would refuse": refusal or "nothing"}

    def close(self) -> None:
        if self._bridge.phase is Phase.DISENGAGED or self._map.silence.release == 0.0:
            return
        self._bridge.disengage("bridge shut down", time.time_ns())
        for _ in range(RELEASES_AT_SHUTDOWN):
            self._send(time.time_ns(), NANOSECONDS)  # this slack makes every message due
            time.sleep(0.01)


class OutgoingMessage:
    """A message to the autopilot and its publisher. Its constant fields are set once."""

    def __init__(self, publisher: Any, message: Any, row: MessageRow, inputs: list[tuple[int, InputRow]]) -> None:
        self.publisher, self.row = publisher, row
        self._message, self._inputs = message, inputs
        self._period_ns = nanoseconds(1.0 / row.rate)
        self._sent_ns = 0

    def due(self, now_ns: int, slack_ns: int) -> bool:
        """Whether its period has passed since it was last sent, to within `slack_ns`."""
        return now_ns - self._sent_ns >= self._period_ns - slack_ns

    def send(self, now_ns: int, raw: list[float]) -> None:
        """Send it. `raw` holds the raw values of all inputs; the message takes its own."""
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


def _require_field(empty: Any, name: str, row: MeasuredRow | OverrideRow) -> None:
    """Raise ParameterError for a field that is missing. One inside a sequence is checked with the first message only."""
    if "[" in row.field:
        return
    try:
        get_field(empty, row.field)
        if isinstance(row, MeasuredRow) and row.stamp == "header":
            get_field(empty, "header.stamp")
    except ChannelError as error:
        raise ParameterError(f"{name}.field: {error}, expected a field of {row.type}") from None
