# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Run guidance as a node, which turns pose, y, target and route into u_m.

It runs in real time or in lockstep.
"""

from collections import deque
from collections.abc import Callable, Mapping, Sequence
from importlib.util import find_spec
from pkgutil import resolve_name
from typing import Any

import numpy as np
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import Point, PoseStamped, TransformStamped, Vector3Stamped
from nav_msgs.msg import Odometry, Path
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.serialization import deserialize_message
from sensor_msgs.msg import Imu, NavSatFix, NavSatStatus
from std_srvs.srv import SetBool, Trigger
from visualization_msgs.msg import Marker, MarkerArray

from flight_core import channels
from flight_core.modes import Mode
from flight_core.outcome import Refusal
from flight_core.parameters import ParameterError, require
from flight_core.publisher_lock import LockstepLock, require_sender
from flight_core.rates import NANOSECONDS, nanoseconds, period_ns, seconds
from flight_core.vectors import ChannelError, SampleFault, StampedVector, select
from flight_guidance.guidance import Guidance, GuidanceOutput
from flight_guidance.guidance_state import GuidanceMode
from flight_guidance.modes.modes import yaw_rate
from flight_guidance.odometry import BODY, MAP, ROUTE_FRAMES, body_velocity, quaternion
from flight_guidance.params import GuidanceConfig
from flight_guidance.reach import AUTHORITY as AUTHORITY_CHANNELS
from flight_guidance.routes.route_file import Origin, Waypoint, geographic
from flight_guidance.steering import path
from flight_ros.flight_node import FlightNode
from flight_ros.lockstep import LockstepInputs
from flight_ros.messages import NO_CHANNELS, Decoder, NamedDecoder, NamedSample, require_size
from flight_ros.rclpy_private import DeserializationError
from flight_ros.receiver import Receiver
from flight_ros.subscriptions import PolledSubscription
from flight_ros.ticker import Tick
from flight_ros.topics import (
    AUTHORITY,
    FIX,
    GUIDANCE,
    IMU,
    INTERNALS,
    LOCKSTEP,
    MARKERS,
    NEWEST_SAMPLES,
    ODOMETRY,
    PATH,
    POSE,
    ROUTE,
    STATE,
    TARGET,
    U_M,
    WIND,
    Topic,
    Y,
    publisher_qos,
)

# The package comes with a full ROS 2, or from `make messages`.
TFMessage: Any = resolve_name("tf2_msgs.msg:TFMessage") if find_spec("tf2_msgs") else None

TRANSFORMS = QoSProfile(depth=100, reliability=ReliabilityPolicy.RELIABLE)  # the same as in tf2_ros
# messages of target per tick; further messages wait, so that a flood delays no u_m
MAX_TARGETS = 16
MAX_ROUTE_SIZE = 65_536  # bytes, for 900 waypoints: decoding takes 0.14 ms per waypoint
CONTROLLER = "controller"  # the node of `internals` and `authority`
# Number of periods without a sample after which the last `authority` is void. One sample may be
# late, and one may be lost.
AUTHORITY_TIMEOUT_PERIODS = 3
ODOMETRY_PERIOD_NS = NANOSECONDS // 10
PATH_PERIOD_NS = NANOSECONDS
PATH_LENGTH = 120  # number of poses of the flown path, one per second

SENTENCES: Mapping[GuidanceMode, str] = {
    GuidanceMode.OFF: "no u_m: disengaged, or pose or y is missing",
    GuidanceMode.ENGAGED: "engaged",
    GuidanceMode.DEAD_RECKONING: "pose is stale: wings are levelled by the rates of y",
    GuidanceMode.POSE_LOST: "pose is lost: all rates are zero",
}
# All other modes have the level WARN.
LEVELS = {
    GuidanceMode.ENGAGED: DiagnosticStatus.OK,
    GuidanceMode.POSE_LOST: DiagnosticStatus.ERROR,
}


class GuidanceNode(FlightNode[GuidanceConfig]):
    """Steps `guidance.Guidance` at every tick, and publishes u_m and the topic guidance.

    The inputs of a step are the received y, pose, target and route. In real time guidance flies
    while the controller is ENGAGED. In lockstep, the time of the flight is the number of samples of
    y. A step then waits for the y and the pose of its instant, and publishes exactly one u_m. If
    guidance has no command, this u_m has no channels.
    """

    def __init__(self) -> None:
        super().__init__("guidance", GuidanceConfig)
        self._guidance = Guidance(self.parameters)
        outputs = self.parameters.outputs
        self._y_receiver = self._receive(Y, Decoder(outputs).decode, self._guidance.take_y)
        self._named_decoder = NamedDecoder()
        self._pose_receiver = self._receive(POSE, self._decode_pose, self._guidance.take_pose)
        # An operator uses the system clock, so there is no age limit with simulated time. Without
        # simulated time, a target that was sent before guidance stopped is void, because the
        # operator knows of the stop.
        max_age_ns = None if self.parameters.lockstep or self.simulated else self._max_age_ns
        self._target_receiver = self.receive(
            TARGET,
            self._named_decoder.decode,
            self._take_target,
            max_age_ns=max_age_ns,
            qos=NEWEST_SAMPLES,
        )
        self._route_subscription = self.subscribe(ROUTE, STATE)  # only the newest route
        self._publish_u_m, self._publish_log = self.advertise(U_M), self.advertise(GUIDANCE)
        self._u_m_encoder = self.encoder((*outputs, *channels.ATTITUDE))
        self._log_encoder = self.encoder(self._guidance.names)
        self._mode = GuidanceMode.OFF
        self._wait_reason: Refusal | None = None
        self._authority_receiver = self._make_authority_receiver()
        self._waiting_authority = deque[StampedVector]()
        # stamp of the last `authority`; -1 if none has come, or if the last one is void
        self._authority_stamp_ns = -1
        self._has_awaited_authority = True
        if self.parameters.lockstep:
            self._lockstep_inputs = LockstepInputs(
                y_period_ns=period_ns(self.parameters.y_rate, "y_rate"),
                period_ns=self.period_ns(),
                receive_y=self._y_receiver.receive,
                receive_other=self._pose_receiver.receive,
                is_ready=self._has_authority_for,
            )
            self._empty_encoder = self.encoder(())
        else:
            self._controller_mode = Mode.WAITING
            self._guidance.pause(paused=True, forget=False)
            self._internals_receiver = self._receive(
                INTERNALS, Decoder(["mode"]).decode, self._take_mode
            )
        self._advertise_views()
        self._advertise_services()

    def _advertise_views(self) -> None:
        """Advertise the topics of maps and 3-D views."""
        self._odometry_publisher = self._view_publisher(ODOMETRY)
        self._imu_publisher = self._view_publisher(IMU)
        self._fix_publisher = self._view_publisher(FIX)
        self._wind_publisher = self._view_publisher(WIND)
        self._path_publisher = self._view_publisher(PATH, PATH_PERIOD_NS)
        self._markers_publisher = self._view_publisher(MARKERS, PATH_PERIOD_NS)
        # REP 105: with several aircraft, each body frame has a prefix, and the aircraft share the
        # map
        self._body = f"{self.get_namespace()}/{BODY}".lstrip("/")
        if TFMessage is None:
            self._publish_transforms = None
        else:
            self._publish_transforms = self.create_publisher(TFMessage, "/tf", TRANSFORMS).publish
        if self._publish_transforms is None:
            self.get_logger().info("no transforms on /tf: the package tf2_msgs is not installed")
        self._path_poses: deque[PoseStamped] = deque(maxlen=PATH_LENGTH)

    def _advertise_services(self) -> None:
        for kind, name, answer in (
            (SetBool, "engage", self._engage),
            (Trigger, "hold", lambda _: self._guidance.hold() or "guidance does not fly"),
            (
                Trigger,
                "skip",
                lambda _: self._guidance.skip() or "no route with a further leg is flown",
            ),
            (
                Trigger,
                "resume",
                lambda _: (
                    self._guidance.resume() or "found no route to resume, or the route is flown"
                ),
            ),
            (Trigger, "home", lambda _: self._guidance.home() or "guidance does not fly"),
        ):
            self.create_service(kind, f"~/{name}", _service(answer, self._guidance.keep_link))

    def period_ns(self) -> int:
        return self._guidance.period_ns

    def inputs(self) -> Sequence[PolledSubscription]:
        return self._y_receiver.subscription, self._pose_receiver.subscription

    def tick(self, tick: Tick, now_ns: int) -> None:
        for receiver in (self._internals_receiver, self._y_receiver, self._pose_receiver):
            receiver.poll(now_ns)
        self._poll_authority(now_ns)
        if (output := self._step(now_ns, tick.number * self.period_ns())) is not None:
            self._publish(output, now_ns)

    def advance(self) -> bool:
        advanced = False
        for now_ns, is_due, y, poses in self._lockstep_inputs.complete():
            if y is not None:
                self._y_receiver.accept(y, now_ns)
            for pose in poses:
                # A pose without channels means that this instant has no pose.
                if pose.value.size:
                    self._pose_receiver.accept(pose, now_ns)
            if is_due and (output := self._step(now_ns, now_ns)) is not None:
                self._publish(output, now_ns)
            elif is_due:
                self._publish_u_m(self._empty_encoder.encode(now_ns, NO_CHANNELS))
            advanced = True
        return advanced

    def awaited_topic(self) -> str:
        if self._authority_receiver is not None and not self._has_awaited_authority:
            return self._authority_receiver.name
        return (self._pose_receiver if self._lockstep_inputs.has_y else self._y_receiver).name

    def _has_authority_for(self, now_ns: int) -> bool:
        """Return whether the `authority` that a step in lockstep needs has arrived.

        A controller that learns sends `authority` in equal periods.
        """
        if self._authority_receiver is None or not now_ns:
            return True
        self._authority_receiver.poll(now_ns)
        period = self._authority_period_ns
        last_ns = (now_ns - 1) // period * period
        self._has_awaited_authority = self._authority_stamp_ns >= last_ns
        return self._has_awaited_authority

    def _step(self, now_ns: int, t_ns: int) -> GuidanceOutput | None:
        # An `authority` with the stamp of this step may arrive before or after the step. So in
        # lockstep it acts from the next step on.
        while self._waiting_authority and (
            self._waiting_authority[0].stamp_ns < now_ns or not self.parameters.lockstep
        ):
            value = self._waiting_authority.popleft().value.tolist()
            self._guidance.take_authority(dict(zip(AUTHORITY_CHANNELS, value, strict=True)))
        self._target_receiver.poll(now_ns, MAX_TARGETS)
        self._take_routes()
        output = self._guidance.step(now_ns, t_ns)
        reason = self._guidance.reason_to_wait(now_ns)
        if reason is not None and self._wait_reason is None:
            self.get_logger().warning(str(reason))
        self._wait_reason = reason
        for notice in () if output is None else output.notices:
            self.get_logger().warning(notice)
        if (mode := self._guidance.mode) is not self._mode:
            sentence = f"{self._mode.name} -> {mode.name}: {SENTENCES[mode]}"
            if mode is GuidanceMode.ENGAGED:
                self.get_logger().info(sentence)
            else:
                self.get_logger().warning(sentence)
            self._mode = mode
        return output

    def _publish(self, output: GuidanceOutput, now_ns: int) -> None:
        self._publish_u_m(self._u_m_encoder.encode(now_ns, output.u_m))
        self._publish_log(self._log_encoder.encode(now_ns, output.log))
        step = self.period_ns()
        if now_ns % ODOMETRY_PERIOD_NS < step:
            odometry = self._odometry_of(now_ns)
            self._odometry_publisher.publish(odometry)
            self._publish_sensors(odometry)
            if self._publish_transforms is not None:
                self._publish_transforms(TFMessage(transforms=[_transform(odometry)]))
            if now_ns % PATH_PERIOD_NS < step:
                self._publish_path(odometry)

    # Received messages

    def _receive(
        self,
        topic: Topic,
        decode: Callable[[bytes], StampedVector | None],
        take: Callable[[StampedVector, int], None],
    ) -> Receiver[StampedVector]:
        lock = self.publisher_lock(self._timeouts_ns)
        return self.receive(topic, decode, take, max_age_ns=self._max_age_ns, lock=lock)

    def _decode_pose(self, raw: bytes) -> StampedVector:
        """Decode a pose into the order of `channels.POSE`. The pose may lack the sideslip."""
        sample = self._named_decoder.decode(raw)
        if self.parameters.lockstep and not sample.channels:
            return StampedVector(sample.stamp_ns, np.array(()), sample.sender)
        values = {"beta": 0.0} | sample.channels
        return StampedVector(
            sample.stamp_ns, select(channels.POSE, [*values], [*values.values()]), sample.sender
        )

    def _max_age_ns(self) -> int:
        return nanoseconds(self.parameters.max_age)

    def _timeouts_ns(self) -> tuple[int, int]:
        """Return the ages after which another publisher may take over from a silent one, ns.

        The ages hold for y, pose and internals. The first age is for the same node in a new
        process, and the second age is for a different node.
        """
        return self._max_age_ns(), self._max_age_ns() + nanoseconds(self.parameters.hold)

    def _take_target(self, sample: NamedSample, now_ns: int) -> None:
        # A target without channels only keeps the operator's link alive.
        if sample.channels:
            self._guidance.take_target(sample.channels)
        self._guidance.keep_link()

    def _take_routes(self) -> None:
        for arrival in self._route_subscription.take():
            try:
                require_size(arrival.message, MAX_ROUTE_SIZE)
                message = deserialize_message(arrival.message, Path)
                frame = message.header.frame_id
                require(
                    frame in ROUTE_FRAMES,
                    "route",
                    f"the frame {frame!r}",
                    f"{MAP!r}, or none named",
                )
                points = [stamped_pose.pose.position for stamped_pose in message.poses]
                route = self.parameters.plan(
                    [Waypoint(point.y, point.x, point.z) for point in points]
                )
            except ChannelError as error:
                self.refusals.add(self._route_subscription, error.reason, str(error))
            except (ParameterError, DeserializationError) as error:
                self.refusals.add(
                    self._route_subscription, SampleFault.ROUTE, " ".join(str(error).split())
                )
            else:
                self.get_logger().info(f"route of {len(points)} waypoints")
                self._guidance.take_route(route)
                self._guidance.keep_link()

    def _make_authority_receiver(self) -> Receiver[StampedVector] | None:
        """Make the receiver of `authority`, or return None in a flight without a learner.

        Without a learner the controller sends no `authority`, so a message would be from an
        unexpected publisher.
        """
        rate = self.parameters.authority_rate
        self._authority_period_ns = period_ns(rate, "authority_rate") if rate else 0
        if not rate:
            return None
        return self.receive(
            AUTHORITY,
            Decoder(AUTHORITY_CHANNELS).decode,
            self._take_authority,
            max_age_ns=None if self.parameters.lockstep else self._max_age_ns,
            # In real time, `_take_authority` accepts it only from the publisher of `internals`.
            lock=LockstepLock() if self.parameters.lockstep else None,
            qos=LOCKSTEP if self.parameters.lockstep else NEWEST_SAMPLES,
        )

    def _controller_name(self) -> str | None:
        """Return the name of the controller that flies; None before its first sample."""
        # In lockstep a sender's name has no process.
        if self.parameters.lockstep:
            return f"{self.get_namespace().rstrip('/')}/{CONTROLLER}"
        lock = self._internals_receiver.lock
        return None if lock is None else lock.publisher

    def _poll_authority(self, now_ns: int) -> None:
        """Take the `authority` that has arrived, if the flight is in real time.

        The last sample is valid for AUTHORITY_TIMEOUT_PERIODS periods plus the age limit.
        """
        if self._authority_receiver is None:
            return
        self._authority_receiver.poll(now_ns)
        longest_ns = AUTHORITY_TIMEOUT_PERIODS * self._authority_period_ns + self._max_age_ns()
        if 0 <= self._authority_stamp_ns < now_ns - longest_ns:
            self._authority_stamp_ns = -1
            self._waiting_authority.clear()
            self._guidance.take_authority(dict.fromkeys(AUTHORITY_CHANNELS, channels.UNKNOWN))
            self.get_logger().warning(
                f"{AUTHORITY.name}: none for {seconds(longest_ns):.2g} s: its limits are void"
            )

    def _take_authority(self, sample: StampedVector, now_ns: int) -> None:
        controller = self._controller_name()
        if controller is None:
            # Nothing flies yet, and the next sample will have the same content.
            return
        require_sender(sample.sender, controller)
        if np.any(sample.value < 0.0):
            raise ChannelError(
                SampleFault.BOUNDS,
                "authority: found a value below 0, expected what an input can do either way",
            )
        self._waiting_authority.append(sample)
        self._authority_stamp_ns = sample.stamp_ns

    def _take_mode(self, sample: StampedVector, now_ns: int) -> None:
        """Take the mode of the controller: guidance flies while it is ENGAGED.

        After INACTIVE, guidance holds the measured heading, altitude and airspeed. After a failsafe
        it continues with its last commands.
        """
        try:
            mode = Mode(int(sample.value[0]))
        except ValueError as error:
            raise ChannelError(SampleFault.MODE, str(error)) from None
        if mode is not self._controller_mode:
            self._controller_mode = mode
            self._guidance.pause(paused=mode is not Mode.ENGAGED, forget=mode is Mode.INACTIVE)

    def _engage(self, request: Any) -> bool | str:
        if (
            request.data
            and not self.parameters.lockstep
            and self._controller_mode is not Mode.ENGAGED
        ):
            return f"the controller is {self._controller_mode.name}, expected ENGAGED"
        self._guidance.engage(engaged=request.data)
        return True

    # For maps and 3-D views

    def _odometry_of(self, now_ns: int) -> Odometry:
        pose = self._guidance.pose()
        y = self._guidance.y()
        message = Odometry()
        message.header.stamp = _stamp(now_ns)
        message.header.frame_id = MAP
        message.child_frame_id = self._body
        pose_of_message = message.pose.pose
        pose_of_message.position = Point(x=pose["east"], y=pose["north"], z=pose["altitude"])
        for key, value in zip(
            "xyzw", quaternion(pose["phi"], pose["theta"], pose["psi"]), strict=True
        ):
            setattr(pose_of_message.orientation, key, value)
        for key, value in zip("xyz", body_velocity(pose), strict=True):
            setattr(message.twist.twist.linear, key, value)
        speed = self.parameters.speed + y.get("V", 0.0)  # a multicopter has no V, but measures r
        r = yaw_rate(y, pose["phi"], pose["theta"], speed)
        # axes forward, left, up (REP 103); the axes of y are forward, right, down
        for key, value in zip("xyz", (y["p"], -y["q"], -r), strict=True):
            setattr(message.twist.twist.angular, key, value)
        return message

    def _view_publisher(self, topic: Topic, period_ns: int = ODOMETRY_PERIOD_NS) -> Any:
        """Create the publisher of a topic for maps and 3-D views, with its period, ns."""
        return self.create_publisher(topic.type, topic.name, publisher_qos(period_ns))

    def _publish_sensors(self, odometry: Odometry) -> None:
        """Publish attitude and rates, the position on the Earth, and the estimated wind.

        The position is published only if an origin is given. The wind is the velocity of the air.
        """
        place = odometry.pose.pose
        twist = odometry.twist.twist
        imu = Imu(orientation=place.orientation, angular_velocity=twist.angular)
        imu.header.stamp = odometry.header.stamp
        imu.header.frame_id = self._body
        # -1 means no estimate, by the definition of the message
        imu.linear_acceleration_covariance[0] = -1.0
        self._imu_publisher.publish(imu)
        wind = Vector3Stamped(header=odometry.header)
        if (state := self._guidance.state) is not None:
            wind.vector.y, wind.vector.x = state.wind
            self._wind_publisher.publish(wind)
        if self.parameters.origin is None:
            return
        latitude, longitude, height = self.parameters.origin
        position = geographic(place.position.y, place.position.x, Origin(latitude, longitude))
        fix = NavSatFix(
            latitude=position.latitude,
            longitude=position.longitude,
            altitude=height + place.position.z,
        )
        fix.header.stamp = odometry.header.stamp
        fix.header.frame_id = self._body
        fix.status.status = NavSatStatus.STATUS_FIX
        self._fix_publisher.publish(fix)

    def _publish_path(self, odometry: Odometry) -> None:
        self._path_poses.append(PoseStamped(header=odometry.header, pose=odometry.pose.pose))
        path_message = Path(header=odometry.header, poses=list(self._path_poses))
        self._path_publisher.publish(path_message)
        if (route := self._guidance.route) is None:
            return
        marker = Marker(ns="route", type=Marker.LINE_STRIP, action=Marker.ADD)
        marker.header = path_message.header
        marker.pose.orientation.w = 1.0
        marker.scale.x = 3.0
        marker.color.r = marker.color.g = marker.color.a = 1.0
        start = (0.0, 0.0)
        for leg, altitude in zip(route.legs, route.altitude, strict=True):
            points = path.outline(leg, start)
            marker.points += [Point(x=east, y=north, z=altitude) for north, east in points]
            start = points[-1]
        self._markers_publisher.publish(MarkerArray(markers=[marker]))

    def status(self) -> tuple[bytes, str, dict[str, object]]:
        ages = {} if self.parameters.lockstep else self._guidance.ages(self.now_ns())
        further: dict[str, object] = {
            f"age of {name} (s)": f"{age:.4f}" for name, age in ages.items()
        }
        further["failed steps"] = self._guidance.failed
        if (state := self._guidance.state) is not None:
            further |= {
                "lateral": state.lateral.name,
                "vertical": state.vertical.name,
                "leg": state.leg,
            }
        return (
            LEVELS.get(self._mode, DiagnosticStatus.WARN),
            str(self._wait_reason or SENTENCES[self._mode]),
            further,
        )


def _service(
    answer: Callable[[Any], bool | str], before: Callable[[], None]
) -> Callable[[Any, Any], Any]:
    """Make the callback of a service from `answer`, which returns True or a sentence of refusal.

    Each call of the service calls the function `before` first.
    """

    def callback(request: Any, response: Any) -> Any:
        before()
        result = answer(request)
        response.success = result is True
        response.message = "" if result is True else str(result)
        return response

    return callback


def _transform(odometry: Odometry) -> TransformStamped:
    """Return the transform from the map to the body frame."""
    transform = TransformStamped(header=odometry.header, child_frame_id=odometry.child_frame_id)
    place = odometry.pose.pose
    translation = transform.transform
    translation.translation.x = place.position.x
    translation.translation.y = place.position.y
    translation.translation.z = place.position.z
    translation.rotation = place.orientation
    return transform


def _stamp(time_ns: int) -> Time:
    return Time(sec=time_ns // NANOSECONDS, nanosec=time_ns % NANOSECONDS)
