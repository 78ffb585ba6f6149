# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""The controller's node: the law at a fixed rate, y and y_m in, u and internals out, as a lifecycle node."""

from collections import deque

from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.lifecycle import LifecycleNodeMixin, LifecycleState, TransitionCallbackReturn

from flight_core.rates import seconds
from flight_core.vectors import ChannelError
from flight_ros.inbox import Inbox
from flight_ros.messages import from_message, to_message
from flight_ros.runtime import FlightNode, run
from flight_ros.ticker import Tick
from flight_ros.topics import INTERNALS, Y_M, U, Y
from rise_di_controller import guard, internals
from rise_di_controller.guard import Mode, Sample
from rise_di_controller.law import retune
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
    """Takes the newest y and the last y_m at each tick, steps the law, publishes u with the stamp of y."""

    def __init__(self) -> None:
        FlightNode.__init__(self, "controller", ControllerParameters, TUNABLE)
        LifecycleNodeMixin.__init__(self)
        self._active = False
        self._law, self._guard = self.parameters.law(), self.parameters.guard()
        self._names = internals.names(self.parameters.outputs, self.parameters.inputs)
        self._state = guard.start(len(self.parameters.inputs))
        self._y: deque[Sample] = deque(maxlen=1)
        self._y_m: deque[Sample] = deque(maxlen=guard.KEPT_REFERENCES)
        self._y_inbox, self._y_m_inbox = self.inbox(Y), self.inbox(Y_M)
        self._u_publisher, self._internals_publisher = self.publisher(U), self.publisher(INTERNALS)
        if self.parameters.autostart:
            self.trigger_configure()
            self.trigger_activate()
        else:
            self.get_logger().info("unconfigured: waiting to be configured and activated (autostart is false)")

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """The parameters were checked as a whole when they were set; the law starts anew from them."""
        # u stays what it was: a node that is configured again does not jump either
        self._state = guard.start(len(self.parameters.inputs))._replace(u=self._state.u)
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
        law = parameters.law()
        if self._state.law is not None:
            self._state = self._state._replace(law=retune(self._state.law, self._law, law))
        self._law, self._guard = law, parameters.guard()

    def period_ns(self) -> int:
        return self._guard.period_ns

    def tick(self, tick: Tick, now_ns: int) -> None:
        now_ns += tick.late_ns
        self._collect(self._y_inbox, self._y, now_ns)
        self._collect(self._y_m_inbox, self._y_m, now_ns)
        y = self._y[-1] if self._y else None
        before = self._state.mode
        self._state, used = guard.tick(self._state, now_ns, y, list(self._y_m), self._guard, self._law, self._active)
        if self._state.mode is not before:
            self.get_logger().info(f"{before.name} -> {self._state.mode.name}")
        if self._active and self._state.mode is not Mode.ENGAGED:
            self._say_what_is_missing(now_ns)
        if used is None:
            return
        late, age = seconds(tick.late_ns), seconds(now_ns - used.stamp_ns)
        self._u_publisher.publish(to_message(used.stamp_ns, self.parameters.inputs, self._state.u, self.instance))
        values = internals.values(self._state, used, self._guard.limits, late, age)
        self._internals_publisher.publish(to_message(used.stamp_ns, self._names, values, self.instance))

    def _collect(self, inbox: Inbox, samples: deque[Sample], now_ns: int) -> None:
        for received in inbox.take():
            try:
                sample = Sample(*from_message(received.message, self.parameters.outputs))
            except ChannelError as error:
                self.reject(inbox, error.reason, str(error))
                continue
            if sample.stamp_ns > now_ns + self._guard.max_age_ns:
                self.reject(inbox, "future", f"stamp {seconds(sample.stamp_ns - now_ns):g} s ahead of the clock")
            elif samples and sample.stamp_ns <= samples[-1].stamp_ns:
                self.reject(inbox, "order", f"stamp {seconds(sample.stamp_ns - samples[-1].stamp_ns):g} s after the last one")
            else:
                samples.append(sample)

    def _say_what_is_missing(self, now_ns: int) -> None:
        complete = True
        for inbox, samples in ((self._y_inbox, self._y), (self._y_m_inbox, self._y_m)):
            if not samples or now_ns - samples[-1].stamp_ns > self._guard.max_age_ns:
                complete = False
                self.waiting_for(inbox)
        if complete:
            pair = f"no {self._y_m_inbox.name} at the stamp of {self._y_inbox.name}"
            self.get_logger().warning(f"{pair}: is one delayed, or stamped by another clock?", throttle_duration_sec=2.0)

    def status(self) -> tuple[bytes, str, dict[str, object]]:
        level = DiagnosticStatus.OK if self._state.mode is Mode.ENGAGED else DiagnosticStatus.WARN
        ages = {
            f"age of {inbox.topic.name} (s)": f"{seconds(self.get_clock().now().nanoseconds - samples[-1].stamp_ns):.4f}"
            for inbox, samples in ((self._y_inbox, self._y), (self._y_m_inbox, self._y_m))
            if samples
        }
        return level, self._state.mode.name, {"mode": self._state.mode.name, "sign": self._law.sign.name, **ages}


def main() -> None:
    """Entry point of the executable `controller`."""
    run(ControllerNode)


if __name__ == "__main__":
    main()
