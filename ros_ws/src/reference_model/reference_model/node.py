# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""The reference model node: publishes y_m of equation (2) in real time or in lockstep."""

from collections import deque

from diagnostic_msgs.msg import DiagnosticStatus

from flight_core.channels import ATTITUDE
from flight_core.publisher_lock import PublisherLock
from flight_core.rates import nanoseconds, period_ns
from flight_core.vectors import ChannelError, FloatArray, require_not_future, require_not_old
from flight_ros.flight_node import FlightNode
from flight_ros.messages import Decoder, stamp_of
from flight_ros.ticker import Tick
from flight_ros.topics import CLOCK, U_M, Y_M
from reference_model.params import ReferenceModelConfig
from reference_model.reference import Reference


class ReferenceModelNode(FlightNode[ReferenceModelConfig]):
    """Computes x_m(k) from x_m(k-1) at tick k and publishes y_m(k). Commands are the scenario's profile until u_m is received.

    In lockstep it publishes every y_m up to the instant of /clock and computes the next one ahead. Where `u_m_rate` is set it
    computes it once u_m has arrived: each instant of u_m has exactly one, without channels where there is no command.
    """

    def __init__(self) -> None:
        super().__init__("reference_model", ReferenceModelConfig)
        self._reference = Reference(self.parameters)
        self._publish_y_m = self.advertise(Y_M)
        self._encoder = self.encoder(self.parameters.outputs)
        (self._publisher_lock,) = self.publisher_locks = (PublisherLock(),)
        self._decoder = Decoder(self.parameters.outputs)
        self._attitude_decoder = Decoder(ATTITUDE)
        rate = self.parameters.u_m_rate
        self._u_m_ns = period_ns(rate, "u_m_rate") if rate else 0
        if self.parameters.lockstep:
            self._number, self._clock_ns = 0, -1
            self._next: FloatArray | None = None
            self._clock_subscription = self.subscribe(CLOCK)
        if self._u_m_ns or not self.parameters.lockstep:
            self._u_m_subscription = self.subscribe(U_M)
            self._u_m_due: deque[bytes] = deque()

    def period_ns(self) -> int:
        return self._reference.period_ns

    def start_ns(self) -> int:
        return nanoseconds(self.parameters.start_time) or super().start_ns()

    def tick(self, tick: Tick, now_ns: int) -> None:
        before = self._reference.source()
        self._publish_y_m(self._encoder.encode(now_ns, self._reference.sample(tick.number)))
        for received in self._u_m_subscription.take():
            self._take_u_m(received.message, now_ns, now_ns - tick.number * self.period_ns())
        if (source := self._reference.source()) != before:
            self._log_source(source)

    def _take_u_m(self, message: bytes, now_ns: int, start_ns: int) -> None:
        """Give a u_m to the reference, unless it is invalid, old or from a conflicting publisher."""
        live = self.parameters.live
        max_age_ns, takeover_ns = nanoseconds(live.max_age), nanoseconds(live.max_age + live.levelling)
        try:
            sample = self._decoder.decode(message)
            if sample is None:
                return
            self._publisher_lock.check(sample.sender, now_ns, max_age_ns, takeover_ns)
            require_not_future(sample.stamp_ns, now_ns, max_age_ns)
            require_not_old(sample.stamp_ns, now_ns, max_age_ns)
            self._reference.take(sample.stamp_ns - start_ns, sample.value, self._attitude(message))
            self._publisher_lock.refresh(sample.sender, now_ns)
        except ChannelError as error:
            self.reject(self._u_m_subscription, error.reason, str(error))

    def _attitude(self, message: bytes) -> FloatArray | None:
        """The attitude where the message has it. Read of accepted messages alone: a storm of others would delay y_m."""
        try:
            sample = self._attitude_decoder.decode(message)
        except ChannelError as error:
            if error.reason != "name":
                raise
            return None
        return None if sample is None else sample.value

    def _log_source(self, source: str) -> None:
        if source == "ending":
            levels = "wings are levelled, then" if self.parameters.live.speed is not None else "from now on"
            self.get_logger().error(f"{self._u_m_subscription.name} timed out: {levels} all commands are zero")
        else:
            self.get_logger().info(f"commands from {self._u_m_subscription.name} replace the profile")

    def advance(self) -> bool:
        self._clock_ns = max([self._clock_ns, *(stamp_of(received.message) for received in self._clock_subscription.take())])
        advanced = False
        while True:
            if self._next is None and self._commands_known():
                self._next = self._reference.sample(self._number)
            t_ns = self._number * self.period_ns()
            if self._next is None or t_ns > self._clock_ns:
                return advanced
            self._publish_y_m(self._encoder.encode(t_ns, self._next))
            self._number, self._next, advanced = self._number + 1, None, True

    def _commands_known(self) -> bool:
        """Lockstep: whether u_m of the instant before the next sample is here, if there is one; it is taken."""
        t_ns = (self._number - 1) * self.period_ns()
        if not self._u_m_ns or t_ns < 0 or t_ns % self._u_m_ns:
            return True
        if not self._u_m_due:
            self._u_m_due.extend(received.message for received in self._u_m_subscription.take())
        if not self._u_m_due:
            return False
        self._take_u_m(self._u_m_due.popleft(), t_ns, 0)
        return True

    def awaited_topic(self) -> str:
        waits = self._u_m_ns and self._next is None
        return (self._u_m_subscription if waits else self._clock_subscription).name

    def status(self) -> tuple[bytes, str, dict[str, object]]:
        level, _, figures = super().status()
        source = self._reference.source()
        return DiagnosticStatus.ERROR if source == "ending" else level, source, figures
