# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""The controller's node: the law at a fixed rate or in lockstep, y and y_m in, u and internals out, as a lifecycle node."""

from collections import deque
from collections.abc import Callable, Iterator

from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.lifecycle import LifecycleNodeMixin, LifecycleState, TransitionCallbackReturn

from flight_core.rates import nanoseconds, period_ns, seconds
from flight_core.vectors import ChannelError, StampedVector
from flight_ros.flight_node import FlightNode
from flight_ros.messages import NO_CHANNELS, Decoder
from flight_ros.publisher_lock import PublisherLock
from flight_ros.subscriptions import PolledSubscription
from flight_ros.ticker import Tick
from flight_ros.topics import INTERNALS, Y_M, U, Y
from rise_di_controller.controller import Controller
from rise_di_controller.guard import Mode
from rise_di_controller.params import ControllerParameters

# What may be changed in flight: gains and guards. What decides the sign or the meaning of a channel may not.
TUNABLE = frozenset(
    (
        "k_g",
        "k_d",
        "Lambda",
        "beta",
        "omega",
        "sign",
        "lag",
        "delay",
        "softening",
        "max_age",
        "hold",
        "ramp",
        "lower",
        "upper",
        "slew",
    )
)


class ControllerNode(LifecycleNodeMixin, FlightNode[ControllerParameters]):
    """Takes the newest y and the last y_m at each tick, steps the law, publishes u with the stamp of y.

    In lockstep counting the y tells the time. A tick is taken when the y and the y_m of its instant have come, and has exactly
    one u, one without channels where the law has nothing to say.
    """

    def __init__(self) -> None:
        FlightNode.__init__(self, "controller", ControllerParameters, TUNABLE)
        LifecycleNodeMixin.__init__(self)
        self._active = False
        self._controller = Controller(self.parameters)
        outputs = self.parameters.outputs
        self._y_subscription, self._y_decoder = self.subscribe(Y), self.decoder(Y, outputs)
        self._y_m_subscription, self._y_m_decoder = self.subscribe(Y_M), self.decoder(Y_M, outputs)
        self._publish_u, self._publish_internals = self.advertise(U), self.advertise(INTERNALS)
        self._u_encoder = self.encoder(U, self.parameters.inputs)
        self._internals_encoder = self.encoder(INTERNALS, self._controller.names)
        if self.parameters.lockstep:
            self._nothing = self.encoder(U, ())
            self._number = 0  # of the y that comes next
            self._y_period_ns = period_ns(self.parameters.y_rate, "y_rate")
            self._y_due: deque[StampedVector | None] = deque()
            self._y_m_due: deque[StampedVector] = deque()
        self._y_source, self._y_m_source = PublisherLock(), PublisherLock()
        self._last_ns = 0  # of the last tick
        if self.parameters.autostart:
            self.trigger_configure()
            self.trigger_activate()
        else:
            self.get_logger().info("unconfigured: waiting to be configured and activated (autostart is false)")

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """The parameters were checked as a whole when they were set; the law starts anew from them."""
        self._controller.restart()  # u stays what it was: a node that is configured again does not jump either
        self.get_logger().info(self.parameters.sampled_sign()[1])
        return TransitionCallbackReturn.SUCCESS

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """From the next fresh y and y_m on the law flies."""
        self._active = True
        return TransitionCallbackReturn.SUCCESS

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """The law stops; u is held or goes to trim, as `on_deactivate` says."""
        self._active = False
        return TransitionCallbackReturn.SUCCESS

    on_shutdown = on_deactivate

    def on_parameters(self, parameters: ControllerParameters) -> None:
        """Take a new set, between two ticks, all at once and without a jump of u."""
        self._controller.retune(parameters)

    def period_ns(self) -> int:
        return self._controller.period_ns

    def tick(self, tick: Tick, now_ns: int) -> None:
        now_ns += tick.late_ns
        if self._last_ns and now_ns - self._last_ns > self._max_age_ns:
            self._catch_up(now_ns)
        self._last_ns = now_ns
        self._take_all(self._y_subscription, self._y_decoder, self._y_source, self._controller.take_y, now_ns)
        self._take_all(self._y_m_subscription, self._y_m_decoder, self._y_m_source, self._controller.take_y_m, now_ns)
        self._fly(now_ns, tick.late_ns)
        if self._active and self._controller.mode is not Mode.ENGAGED:
            self._say_what_is_missing(now_ns)

    @property
    def _max_age_ns(self) -> int:
        return nanoseconds(self.parameters.max_age)

    def _catch_up(self, now_ns: int) -> None:
        """After a time in which it was itself held up: the ticks in which it would have lost y and let go of u.

        The aircraft has let go of u meanwhile; the law then begins from where that is, not from where u was.
        """
        self.get_logger().warning(f"held up for {seconds(now_ns - self._last_ns):.3f} s: engages anew")
        self._fly(self._last_ns + self._max_age_ns + self.period_ns(), 0)
        self._fly(now_ns, 0)

    def _take_all(
        self,
        subscription: PolledSubscription,
        decoder: Decoder,
        source: PublisherLock,
        take: Callable[[StampedVector, int], None],
        now_ns: int,
    ) -> None:
        """All that has come, but for samples that are bad, or of a second publisher.

        Another node than the one before is listened to once u has gone to trim.
        """
        strange_ns = self._max_age_ns + nanoseconds(self.parameters.hold + self.parameters.ramp)
        for received in subscription.take():
            try:
                decoded = decoder.decode(received.message)
                if decoded is not None:
                    source.require(decoded.sender, now_ns, self._max_age_ns, strange_ns)
                    take(decoded, now_ns)
                    source.hear(decoded.sender, now_ns)
            except ChannelError as error:
                self.reject(subscription, error.reason, str(error))

    def _samples(self, subscription: PolledSubscription, decoder: Decoder) -> Iterator[StampedVector | None]:
        for received in subscription.take():
            try:
                decoded = decoder.decode(received.message)
            except ChannelError as error:
                self.reject(subscription, error.reason, str(error))
                yield None
            else:
                yield decoded

    def _take(
        self, subscription: PolledSubscription, take: Callable[[StampedVector, int], None], sample: StampedVector, now_ns: int
    ) -> None:
        try:
            take(sample, now_ns)
        except ChannelError as error:
            self.reject(subscription, error.reason, str(error))

    def _fly(self, now_ns: int, late_ns: int) -> bool:
        before = self._controller.mode
        commanded = self._controller.tick(now_ns, late_ns, active=self._active)
        if self._controller.mode is not before:
            self.get_logger().info(f"{before.name} -> {self._controller.mode.name}")
        if commanded is None:
            return False
        # One that was stopped does not send what it was about to: the aircraft has let go of u, and would jump back to it.
        if self.parameters.lockstep or self.now_ns() - now_ns <= self._max_age_ns:
            self._publish_u(self._u_encoder.encode(commanded.stamp_ns, commanded.u))
        self._publish_internals(self._internals_encoder.encode(commanded.stamp_ns, commanded.internals))
        return True

    def advance(self) -> bool:
        if not self._y_due:
            self._y_due.extend(self._samples(self._y_subscription, self._y_decoder))
        self._y_m_due.extend(
            sample for sample in self._samples(self._y_m_subscription, self._y_m_decoder) if sample is not None
        )
        moved = False
        while self._y_due:
            now_ns = self._number * self._y_period_ns
            due = now_ns % self.period_ns() == 0
            if due and not (self._y_m_due and self._y_m_due[-1].stamp_ns >= now_ns):
                break
            self._number += 1
            if (y := self._y_due.popleft()) is not None:
                self._take(self._y_subscription, self._controller.take_y, y, now_ns)
            while self._y_m_due and self._y_m_due[0].stamp_ns <= now_ns:
                self._take(self._y_m_subscription, self._controller.take_y_m, self._y_m_due.popleft(), now_ns)
            if due and not self._fly(now_ns, late_ns=0):
                self._publish_u(self._nothing.encode(now_ns, NO_CHANNELS))
            moved = True
        return moved

    def awaited_topic(self) -> str:
        return (self._y_m_subscription if self._y_due else self._y_subscription).name

    def _say_what_is_missing(self, now_ns: int) -> None:
        stale = self._controller.stale(now_ns)
        for subscription in (self._y_subscription, self._y_m_subscription):
            if subscription.topic.name in stale:
                self.warn_no_publisher(subscription)
        if not stale:
            pair = f"no {self._y_m_subscription.name} at the stamp of {self._y_subscription.name}"
            self.get_logger().warning(f"{pair}: is one delayed, or stamped by another clock?", throttle_duration_sec=2.0)

    def status(self) -> tuple[bytes, str, dict[str, object]]:
        mode = self._controller.mode
        level = DiagnosticStatus.OK if mode is Mode.ENGAGED else DiagnosticStatus.WARN
        ages = {}
        if not self.parameters.lockstep:
            found = self._controller.ages(self.now_ns())
            ages = {f"age of {name} (s)": f"{age:.4f}" for name, age in found.items()}
        return level, mode.name, {"mode": mode.name, "sign": self._controller.sign.name, **ages}
