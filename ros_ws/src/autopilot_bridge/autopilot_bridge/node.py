# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""The bridge node, which takes the place of the aircraft node.

With a channel map, it makes y from the messages of an autopilot, and setpoints from u.
"""

import os
import time
from collections import Counter, defaultdict
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticStatus, KeyValue
from lifecycle_msgs.msg import State, Transition
from lifecycle_msgs.srv import ChangeState, GetState
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.serialization import deserialize_message
from rclpy.task import Future
from sensor_msgs.msg import JointState
from std_srvs.srv import SetBool, Trigger

from autopilot_bridge import mavlink_link
from autopilot_bridge.bridge import Bridge, Phase, trim_key
from autopilot_bridge.channel_map import get_field, no_publisher, read_raw, version_fault
from autopilot_bridge.map_rows import (
    MAVLINK,
    ConditionRow,
    MeasuredRow,
    MessageRow,
    OverrideRow,
    QosRow,
    WatchedRow,
)
from autopilot_bridge.mavlink_link import MavlinkPublisher, MavlinkReader
from autopilot_bridge.outgoing import (
    OutgoingMessage,
    ServiceCaller,
    field_type,
    prepare_message,
    require_field,
)
from autopilot_bridge.params import BridgeConfig, load_map
from flight_core.outcome import FlightEnded, Refusal, joined
from flight_core.parameters import require
from flight_core.publisher_lock import require_sender
from flight_core.rates import NANOSECONDS, nanoseconds, period_ns, seconds
from flight_core.text import bounded
from flight_core.vectors import ChannelError, SampleFault, StampedVector
from flight_ros.flight_node import FlightNode
from flight_ros.messages import Decoder, Encoder
from flight_ros.rclpy_private import DeserializationError
from flight_ros.subscriptions import PolledSubscription
from flight_ros.ticker import Tick
from flight_ros.topics import EFFECTS, ENGAGEMENT, EXTERNAL, POSE, PUBLISH, WOULD_SEND, Topic, U, Y

LEFT = (
    "no publisher any more. Where the autopilot flies on, its client may not come back by "
    "itself: start its agent again"
)
RC_OVERRIDE = f"{MAVLINK}/RC_CHANNELS_OVERRIDE"  # topic of the overrides
# Number of messages with release values when the node ends, as a single one may be lost.
RELEASES_AT_SHUTDOWN = 5

NOT_ACTIVATED = Refusal("the controller refused to activate, or was active already: see its log")
ACTIVATION_TIMED_OUT = Refusal("timed out waiting for the controller to activate")

# ns, longest wait for the controller to be active at an engagement; it answers within some ticks.
ACTIVATION_TIMEOUT_NS = NANOSECONDS

NamedRow = tuple[str, MeasuredRow | WatchedRow]


class BridgeNode(FlightNode[BridgeConfig]):
    """The ROS node around a `Bridge`.

    At each tick it polls the autopilot's topics, publishes a new y, takes the newest u and sends
    the messages that are due.
    """

    def __init__(self) -> None:
        super().__init__("bridge", BridgeConfig)
        self._map = load_map(self.parameters.map)
        dry_run = self._map.dry_run if self.parameters.dry_run is None else self.parameters.dry_run
        self._bridge = Bridge(self._map, dry_run=dry_run)
        self._logged = self._bridge.phase, self._bridge.reason
        self._longest_pause_ns = nanoseconds(self._map.silence.max_age)
        self._began_ns = self._boot_ns()
        self._overrides_sticks = any(
            message.topic == RC_OVERRIDE for message in self._map.messages.values()
        )
        self._link = self._open_link()
        # Systems of ground stations that were reported already.
        self._known_stations: set[int] = set()
        self._conflict: Refusal | None = None  # which topics have two publishers
        # For the log: publisher and encoder of each MAVLink topic, as named vectors.
        self._recorded: dict[str, tuple[Callable[[bytes], None], Encoder]] = {}
        self._readers = self._read_topics()
        self._outgoing = {name: self._make(name, row) for name, row in self._map.messages.items()}
        decode = Decoder(self._bridge.inputs).decode
        self._u = self.receive(
            U,
            decode,
            self._bridge.take_u,
            max_age_ns=self._bridge.max_u_age_ns,
            lock=self._bridge.u_lock,
        )
        self._effects = self.receive(
            EFFECTS,
            decode,
            self._take_effects,
            max_age_ns=self._bridge.max_u_age_ns,
            lock=None,
        )
        self._advertise_all()
        self._first_y = False
        self._start_ns = 0
        self._report_ns = 0  # instant of the last report of the engagement
        self._controller = self.create_client(ChangeState, "controller/change_state")
        self._controller_state = self.create_client(GetState, "controller/get_state")
        self._controller_ready = False
        self._u_sender: str | None = None
        self._activation: Any = None  # the pending activation of the controller
        self._activation_ns = 0
        self._awaits_controller = False  # whether an engaged bridge lacks the controller so far
        if self._link is not None:
            self._link.start()
        waits = f"disengaged, waiting for {self.get_name()}/engage"
        state = "dry run, nothing is sent" if dry_run else waits
        self.get_logger().info(f"map {self._map.name}: {state}")

    def _advertise_all(self) -> None:
        """Create the publishers with their encoders, and the services."""
        self._publish_y = self.advertise(Y)
        self._publish_would_send = self.advertise(WOULD_SEND)
        self._y_encoder = self.encoder(self._bridge.outputs)
        self._publish_pose = self.advertise(POSE) if self._map.pose else None
        # Encoders by the names of the fresh channels.
        self._pose_encoders: dict[tuple[str, ...], Encoder] = {}
        names = [f"{row.message}.{row.field}" for row in self._map.inputs.values()]
        self._would_send_encoder = self.encoder(names)
        self.create_service(SetBool, "~/engage", self._engage)
        self.create_service(Trigger, "~/engage_blind", self._engage_blind)
        self._engagement = self.create_publisher(ENGAGEMENT.type, ENGAGEMENT.name, PUBLISH)

    def _open_link(self) -> mavlink_link.Link | None:
        """Open the MAVLink link of the map, or return None if the map has no link."""
        if self._map.link is None:
            return None
        key = f"{self.get_name()}.use_sim_time"
        cause = "false: an autopilot on MAVLink ticks by its own clock"
        require(self.simulated is None, key, "true", cause)
        further = mavlink_link.STATION_PARAMETERS if self._overrides_sticks else ()
        return mavlink_link.Link(self._map.link, tuple(self._map.parameters), further)

    def _read_topics(self) -> list[tuple[PolledSubscription | MavlinkReader, list[NamedRow]]]:
        """Subscribe to the topics of the map, and return each with its rows."""
        named_rows: list[NamedRow] = [
            *self._map.outputs.items(),
            *self._map.pose.items(),
            *self._map.sensors.items(),
            *((trim_key(name), row) for name, row in self._map.trims.items()),
            *self._map.conditions.items(),
            *self._map.overrides.items(),
        ]
        rows_by_topic: dict[str, list[NamedRow]] = {}
        for name, row in named_rows:
            rows_by_topic.setdefault(row.topic, []).append((name, row))
        readers: list[tuple[PolledSubscription | MavlinkReader, list[NamedRow]]] = []
        for topic, rows in rows_by_topic.items():
            kind = field_type(rows[0][1].type)
            for name, row in rows:
                require_field(kind(), name, row)
            if fault := version_fault(topic, kind):
                self.get_logger().warning(str(fault))
            readers.append((self._reader(Topic(topic, kind, EXTERNAL)), rows))
        return readers

    def _reader(self, topic: Topic) -> PolledSubscription | MavlinkReader:
        if self._link is None or not topic.name.startswith(f"{MAVLINK}/"):
            return self.subscribe(topic, _qos(self._map.topics[topic.name]))
        reader = MavlinkReader(self._link, topic)
        self._recorded[topic.name] = (
            self.advertise(Topic(topic.name, JointState)),
            self.encoder(reader.fields),
        )
        return reader

    def _make(self, name: str, row: MessageRow) -> OutgoingMessage:
        message, rows = prepare_message(self._map, name, row)
        if self._link is not None and row.topic.startswith(f"{MAVLINK}/"):
            return OutgoingMessage(MavlinkPublisher(self._link, row.topic), message, row, rows)
        if row.is_service:
            return OutgoingMessage(
                ServiceCaller(self.create_client(field_type(row.type), row.topic)),
                message,
                row,
                rows,
            )
        publisher = self.create_publisher(
            type(message), row.topic, _qos(self._map.topics[row.topic])
        )
        return OutgoingMessage(publisher, message, row, rows)

    def period_ns(self) -> int:
        return period_ns(self._map.rate, "rate")

    def tick(self, tick: Tick, now_ns: int) -> None:
        now_ns += tick.late_ns
        self._disengage_after_pause(now_ns)
        step_ns = self.clock_step_ns()
        for subscription, rows in self._readers:
            for arrival in subscription.take():
                self._read(
                    subscription,
                    rows,
                    arrival.message,
                    self._arrived_ns(arrival, now_ns),
                    now_ns,
                    step_ns,
                )
        self._watch_link()
        sample = self._bridge.y(now_ns)
        if sample is None:
            self._require_first_y(now_ns)
        else:
            self._first_y = True
            self._publish_y(self._y_encoder.encode(sample.stamp_ns, sample.value))
        if self._publish_pose is not None and (fresh := self._bridge.pose(now_ns)) is not None:
            names, pose = fresh
            if names not in self._pose_encoders:
                self._pose_encoders[names] = self.encoder(names)
            self._publish_pose(self._pose_encoders[names].encode(pose.stamp_ns, pose.value))
        if any(self._u.poll(now_ns)):
            self._publish_would_send(self._would_send_encoder.encode(now_ns, self._bridge.raw_u()))
        self._effects.poll(now_ns)
        self._bridge.step(now_ns)
        self._check_activation(now_ns)
        self._log_phase()
        if now_ns - self._report_ns >= NANOSECONDS:
            self._report(now_ns)
        # If the host has stopped this tick half-way, the u that it took may be old.
        if self._pause_ns() <= self._longest_pause_ns:
            self._send(now_ns, self.period_ns() // 2)
        self._warn_stale_inputs(now_ns)

    def _take_effects(self, sample: StampedVector, now_ns: int) -> None:
        """Take the effects of the inputs if their sender is the controller that sends u."""
        controller = self._bridge.u_lock.publisher
        if controller is None:
            # Nothing flies yet.
            return
        require_sender(sample.sender, controller)
        self._bridge.take_effects(sample, now_ns)

    def _pause_ns(self) -> int:
        """Return the time since the previous tick began, ns.

        A time in which the host was suspended is included, although the clock of the ticks stops in
        it.
        """
        return self._boot_ns() - self._began_ns

    def _boot_ns(self) -> int:
        if self.simulated is None:
            return time.clock_gettime_ns(time.CLOCK_BOOTTIME)
        return self.simulated.time_ns()

    def _arrived_ns(self, arrival: Any, now_ns: int) -> int:
        """Return the arrival of a message, ns, by the clock with which headers are stamped."""
        if not arrival.received_ns:
            return now_ns + self.clock_step_ns()
        return int(
            arrival.received_ns
            if self.simulated is None
            else self.simulated.at(arrival.received_ns)
        )

    def _disengage_after_pause(self, now_ns: int) -> None:
        """Disengage if the bridge did not run for a while.

        During such a pause the autopilot or its pilot may have flown without the bridge.
        """
        pause_ns = self._pause_ns()
        self._began_ns += pause_ns
        if pause_ns > self._longest_pause_ns:
            pause = Refusal(f"the bridge did not run for {seconds(pause_ns):.2f} s")
            self._bridge.disengage(pause, now_ns)

    def _read(
        self,
        subscription: PolledSubscription | MavlinkReader,
        rows: list[NamedRow],
        raw: Any,
        arrived_ns: int,
        now_ns: int,
        step_ns: int,
    ) -> None:
        """Pass the fields of a message to the bridge.

        The message's stamps are by the system clock, which is ahead of the ticks' time by
        `step_ns`.
        """
        if isinstance(subscription, MavlinkReader):
            message = raw
            publish, encoder = self._recorded[subscription.topic.name]
            publish(
                encoder.encode(
                    arrived_ns,
                    np.array(
                        [getattr(raw, field) for field in subscription.fields], dtype=np.float64
                    ),
                )
            )
        else:
            try:
                message = deserialize_message(raw, subscription.topic.type)
            except DeserializationError as error:
                self.refusals.add(subscription, SampleFault.MALFORMED, " ".join(str(error).split()))
                return
        for name, row in rows:
            try:
                if isinstance(row, WatchedRow):
                    if isinstance(row, ConditionRow):
                        take = self._bridge.take_condition
                    else:
                        take = self._bridge.take_override
                    take(name, read_raw(message, row.field, "value"), now_ns)
                    continue
                stamp_ns = arrived_ns
                if row.stamp == "header":
                    stamp = get_field(message, "header.stamp")
                    stamp_ns = stamp.sec * NANOSECONDS + stamp.nanosec
                raw_value = read_raw(message, row.field, row.function, row.turned_by)
                self._bridge.take_output(name, raw_value, stamp_ns - step_ns, now_ns)
            except ChannelError as error:
                self.refusals.add(subscription, error.reason, str(error))

    def _send(self, now_ns: int, slack_ns: int) -> None:
        for name, outgoing in self._outgoing.items():
            if self._bridge.is_sent(name, now_ns) and outgoing.is_due(now_ns, slack_ns):
                try:
                    outgoing.send(now_ns, self._bridge.raw().tolist())
                except ChannelError as error:
                    self.get_logger().error(
                        f"messages.{name} not sent: {error}", throttle_duration_sec=2.0
                    )

    def _engage(self, request: Any, response: Any) -> Any:
        if request.data:
            return self._request_engagement(response, blind=False)
        request_reason = Refusal("disengaged by request")
        self._bridge.disengage(request_reason, self.now_ns(), by_pilot=True)
        response.success = True
        self._log_phase()
        return response

    def _engage_blind(self, request: Any, response: Any) -> Any:
        return self._request_engagement(response, blind=True)

    def _request_engagement(self, response: Any, *, blind: bool) -> Any:
        self._find_conflicts()
        refusal = self._bridge.engage(self.now_ns(), blind=blind)
        response.success = refusal is None
        if refusal is not None:
            response.message = str(refusal)
            self.get_logger().warning(f"not engaged: {refusal}")
        self._log_phase()
        return response

    def _activate(self, active: bool) -> None:
        """Ask the controller to become active or inactive.

        The controller is active only while engaged, so that its integrals do not wind up.
        """
        self._awaits_controller = active and not self._controller.service_is_ready()
        if not self._controller.service_is_ready():
            # The controller is not discovered yet, or u comes from a node without a lifecycle.
            return
        transition = Transition.TRANSITION_ACTIVATE if active else Transition.TRANSITION_DEACTIVATE
        future = self._controller.call_async(
            ChangeState.Request(transition=Transition(id=transition))
        )
        self._activation, self._activation_ns = (future, self.now_ns()) if active else (None, 0)

    def _check_activation(self, now_ns: int) -> None:
        """Disengage if the controller did not activate, because u would then stay at trim."""
        if self._activation is None:
            return
        if self._activation.done():
            success = self._activation.result().success
            self._activation = None
            if not success:
                self._bridge.disengage(NOT_ACTIVATED, now_ns)
        elif now_ns - self._activation_ns > ACTIVATION_TIMEOUT_NS:
            self._activation = None
            self._bridge.disengage(ACTIVATION_TIMED_OUT, now_ns)

    def _report(self, now_ns: int) -> None:
        """Publish the phase, its reason, and the reason against an engagement.

        This is called once a second. It also deactivates a controller that has just appeared, and
        activates the controller for which an engaged bridge waits.
        """
        bridge = self._bridge
        self._report_ns = now_ns
        refusal = None
        if bridge.phase not in {Phase.ENGAGED, Phase.ENGAGING}:
            refusal = bridge.reason_against_engagement(now_ns)
        parts = [str(part) for part in (bridge.reason, refusal) if part is not None]
        value = "; would refuse: ".join(parts)
        self._engagement.publish(KeyValue(key=bridge.phase.name, value=value))
        ready = self._controller.service_is_ready() and self._controller_state.service_is_ready()
        before = self._u_sender
        self._u_sender = bridge.u_lock.publisher
        # After a quick restart, the service is back before its loss is noticed.
        restarted = bool(before) and self._u_sender != before
        if (
            ready
            and (restarted or not self._controller_ready)
            and bridge.phase is not Phase.ENGAGED
        ):
            self._controller_state.call_async(GetState.Request()).add_done_callback(
                self._deactivate_unengaged
            )
        self._controller_ready = ready
        if self._awaits_controller and bridge.phase is Phase.ENGAGED:
            self._activate(active=True)

    def _deactivate_unengaged(self, state: Future) -> None:
        """Deactivate a controller that is active without an engagement.

        Such a controller was started by `ros2 run`, for example.
        """
        if (
            state.result().current_state.id == State.PRIMARY_STATE_ACTIVE
            and self._bridge.phase is not Phase.ENGAGED
        ):
            self._activate(active=False)

    def _log_phase(self) -> None:
        phase = self._bridge.phase
        reason = self._bridge.reason
        before, lacked = self._logged
        self._logged = phase, reason
        if phase is before and (phase is not Phase.ENGAGED or reason == lacked):
            return
        sentence = phase.name if phase is before else f"{before.name} -> {phase.name}"
        if reason is None:
            self.get_logger().info(sentence)
        else:
            self.get_logger().warning(bounded(f"{sentence}: {reason}"))
        begins = phase is Phase.ENGAGED and before is not Phase.ENGAGED
        if begins and self._link is not None and self._overrides_sticks:
            self.get_logger().info(self._link.station())
        if phase is not before and Phase.ENGAGED in (phase, before):
            self._activate(active=phase is Phase.ENGAGED)
        self._engagement.publish(KeyValue(key=phase.name, value=str(reason or "")))

    def _warn_stale_inputs(self, now_ns: int) -> None:
        stale = self._bridge.stale(now_ns)
        for subscription, rows in self._readers:
            is_stale = any(name in stale for name, row in rows if isinstance(row, MeasuredRow))
            if is_stale and isinstance(subscription, PolledSubscription):
                self.warn_no_publisher(subscription, LEFT if self._first_y else "no publisher")
        if self._link is not None:
            if problem := self._link.problem():
                self.get_logger().warning(f"link: {problem}", throttle_duration_sec=10.0)
            for station in sorted(self._link.stations - self._known_stations):
                self._known_stations.add(station)
                self.get_logger().info(
                    f"link: a ground station beside the bridge, system {station}: it may change "
                    "mode and rates"
                )
        if self._bridge.has_u_timed_out(now_ns):
            self.warn_no_publisher(self._u.subscription)

    def _require_first_y(self, now_ns: int) -> None:
        """Raise FlightEnded, with the reasons, if y is incomplete after the time `first_y`."""
        self._start_ns = self._start_ns or now_ns
        limit = self.parameters.first_y
        if self._first_y or limit == 0.0 or now_ns - self._start_ns < nanoseconds(limit):
            return
        stale = self._bridge.stale(now_ns)
        causes = defaultdict[str, list[str]](list)
        for subscription, rows in self._readers:
            if any(name in stale for name, _ in rows):
                causes[self._cause(subscription)].append(subscription.name)
        sentences = (f"{', '.join(names)}: {cause}" for cause, names in causes.items())
        raise FlightEnded(f"no y after {limit:g} s: {'; '.join(sentences)}")

    def _cause(self, subscription: PolledSubscription | MavlinkReader) -> str:
        """Say why no sample of a topic was accepted."""
        name = subscription.topic.name
        refusals = [what for what in self.refusals.counts if what.startswith(f"{name}: ")]
        if isinstance(subscription, MavlinkReader):
            problem = subscription.link.problem(subscription.message_name)
            return str(problem or (*refusals, "no such message comes")[0])
        if not self.get_publishers_info_by_topic(subscription.name):
            fault = version_fault(subscription.name, subscription.topic.type)
            return f"no publisher. {fault}" if fault else no_publisher(os.environ)
        faults = self.endpoints.mismatches(subscription)
        return str((*faults, *refusals, "no sample of its publisher arrives")[0])

    def graph_checks(self) -> list[Callable[[], None]]:
        """Return checks of the ROS graph, which include the topics that the autopilot must receive.

        The autopilot cannot receive a topic if it subscribes with another type or an incompatible
        quality of service. A second publisher of a topic ends the engagement.
        """
        outgoing = (
            partial(self.endpoints.check_subscribers, outgoing_message.publisher)
            for outgoing_message in self._outgoing.values()
            if isinstance(outgoing_message.publisher, Publisher)
        )
        return [*super().graph_checks(), *outgoing, self._find_conflicts]

    def _find_conflicts(self) -> None:
        """Inform the bridge which topics have a second publisher.

        With two autopilots, y would be mixed, and both autopilots would be flown. So the topics
        that the bridge reads and the topics of setpoints are checked. Overrides and requests of a
        mode may have several publishers.
        """
        read_topics = set()
        for subscription, rows in self._readers:
            overrides_alone = all(isinstance(row, OverrideRow) for _, row in rows)
            if isinstance(subscription, PolledSubscription) and not overrides_alone:
                read_topics.add(subscription.name)
        publishers = [self._outgoing[row.message].publisher for row in self._map.inputs.values()]
        setpoints = {
            publisher.topic_name for publisher in publishers if isinstance(publisher, Publisher)
        }
        # Two messages may share a topic.
        publishers_here = Counter(
            outgoing.publisher.topic_name for outgoing in self._outgoing.values()
        )
        counts = {
            topic: self.count_publishers(topic) - publishers_here[topic]
            for topic in sorted(read_topics | setpoints)
        }
        conflicts = [
            f"{topic} has {count} "
            f"publishers{' beside this bridge' if topic in setpoints else ''}, expected "
            f"{'none' if topic in setpoints else 'the autopilot alone'}"
            for topic, count in counts.items()
            if count > (topic not in setpoints)
        ]
        self._conflict = Refusal("; ".join(conflicts)) if conflicts else None
        self._watch_link()

    def _watch_link(self) -> None:
        """Inform the bridge what is wrong with topics, link and parameters of the autopilot."""
        bridge = self._bridge
        link = self._link
        bridge.conflict = self._conflict
        if link is None:
            return
        bridge.conflict = joined((self._conflict, link.conflict, link.end_reason()))
        bridge.problem = link.reason_against_engagement()
        for name, value in tuple(link.parameters.items()):
            bridge.take_parameter(name, value)

    def status(self) -> tuple[bytes, str, dict[str, object]]:
        bridge = self._bridge
        now_ns = self.now_ns()
        is_engaged = bridge.phase is Phase.ENGAGED
        refusal = None if is_engaged else bridge.reason_against_engagement(now_ns)
        is_ok = is_engaged and bridge.reason is None
        phase = bridge.phase.name
        return (
            DiagnosticStatus.OK if is_ok else DiagnosticStatus.WARN,
            phase if bridge.reason is None else f"{phase}: {bridge.reason}",
            {
                "phase": phase,
                "map": self._map.name,
                "would refuse": str(refusal or "nothing"),
            },
        )

    def close(self) -> None:
        if self._bridge.phase is not Phase.DISENGAGED and self._map.silence.release > 0.0:
            self._bridge.disengage(Refusal("bridge shut down"), self.now_ns())
            for _ in range(RELEASES_AT_SHUTDOWN):
                self._send(self.now_ns(), NANOSECONDS)  # this slack makes every message due
                time.sleep(0.01)
        if self._link is not None:
            self._link.close()


def _qos(row: QosRow) -> QoSProfile:
    return QoSProfile(
        depth=row.depth,
        reliability=ReliabilityPolicy[row.reliability.upper()],
        durability=DurabilityPolicy[row.durability.upper()],
    )
