# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Publish y_m of equation (2) as a ROS 2 node, in real time or in lockstep."""

from collections import deque
from typing import NamedTuple

from diagnostic_msgs.msg import DiagnosticStatus

from flight_core.channels import ATTITUDE
from flight_core.publisher_lock import LockstepLock
from flight_core.rates import nanoseconds, period_ns
from flight_core.vectors import ChannelError, FloatArray
from flight_ros.flight_node import FlightNode
from flight_ros.messages import Decoder
from flight_ros.ticker import Tick
from flight_ros.topics import CLOCK, U_M, Y_M
from reference_model.params import ReferenceModelConfig
from reference_model.reference import Reference, Source


class LiveCommand(NamedTuple):
    """A received u_m, with the attitude of the aircraft if known."""

    stamp_ns: int
    u_m: FloatArray
    attitude: FloatArray | None  # phi and theta of the aircraft, if guidance sends them
    sender: str


class ReferenceModelNode(FlightNode[ReferenceModelConfig]):
    """Computes x_m(k) from x_m(k-1) at tick k, and publishes y_m(k).

    Until the first u_m is received, the commands come from the scenario's profile.

    In lockstep the node publishes y_m up to the instant of the clock, and computes the next y_m
    ahead. If `u_m_rate` is set, the node first waits for u_m. There must be exactly one message of
    u_m at each instant of this rate. A message without channels means that there is no command.
    """

    def __init__(self) -> None:
        super().__init__("reference_model", ReferenceModelConfig)
        self._reference = Reference(self.parameters)
        self._start_ns = 0  # time of the clock at the start of the flight, ns; 0 in lockstep
        self._publish_y_m = self.advertise(Y_M)
        self._encoder = self.encoder(self.parameters.outputs)
        self._decoder = Decoder(self.parameters.outputs)
        self._attitude_decoder = Decoder(ATTITUDE)
        rate = self.parameters.u_m_rate
        self._u_m_ns = period_ns(rate, "u_m_rate") if rate else 0
        if self.parameters.lockstep:
            self._number = 0
            self._clock_ns = -1
            self._next: FloatArray | None = None
            self._clock_subscription = self.subscribe(CLOCK)
            self._clock_lock = LockstepLock()
        if self._u_m_ns or not self.parameters.lockstep:
            lock = self.publisher_lock(self._timeouts_ns)
            self._u_m = self.receive(
                U_M, self._decode_u_m, self._take_u_m, lock=lock, max_age_ns=self._max_age_ns
            )
            self._u_m_due: deque[LiveCommand | None] = deque()

    def period_ns(self) -> int:
        return self._reference.period_ns

    def tick(self, tick: Tick, now_ns: int) -> None:
        before = self._reference.source()
        self._publish_y_m(self._encoder.encode(now_ns, self._sample(tick.number)))
        self._start_ns = now_ns - tick.number * self.period_ns()
        self._u_m.poll(now_ns)
        if (source := self._reference.source()) is not before:
            self._log_source(source)

    def _sample(self, number: int) -> FloatArray:
        y_m = self._reference.sample(number)
        if failure := self._reference.pop_failure():
            self.get_logger().error(str(failure))
        return y_m

    def _max_age_ns(self) -> int:
        return nanoseconds(self.parameters.live.max_age)

    def _timeouts_ns(self) -> tuple[int, int]:
        """Return the ages after which another publisher of u_m may take over from a silent one, ns.

        The first age holds for the same node in a new process. The second holds for another node,
        which may take over only after the wings are levelled.
        """
        live = self.parameters.live
        return nanoseconds(live.max_age), nanoseconds(live.max_age + live.levelling)

    def _decode_u_m(self, raw: bytes) -> LiveCommand | None:
        sample = self._decoder.decode(raw)
        if sample is None:
            return None
        return LiveCommand(sample.stamp_ns, sample.value, self._attitude(raw), sample.sender)

    def _attitude(self, raw: bytes) -> FloatArray | None:
        """Return the attitude that a message of u_m carries, or None if it carries none."""
        try:
            sample = self._attitude_decoder.decode(raw)
        except ChannelError as error:
            if error.reason != "name":
                raise
            return None
        return None if sample is None else sample.value

    def _take_u_m(self, command: LiveCommand, now_ns: int) -> None:
        self._reference.take(command.stamp_ns - self._start_ns, command.u_m, command.attitude)

    def _log_source(self, source: Source) -> None:
        if source is Source.ENDING:
            if self.parameters.live.speed is not None:
                levels = "wings are levelled, then"
            else:
                levels = "from now on"
            self.get_logger().error(f"{self._u_m.name} timed out: {levels} all commands are zero")
        else:
            self.get_logger().info(f"commands from {self._u_m.name} replace the profile")

    def advance(self) -> bool:
        subscription = self._clock_subscription
        stamps = self.refusals.stamps(subscription, subscription.take(), self._clock_lock)
        self._clock_ns = max([self._clock_ns, *stamps])
        advanced = False
        while True:
            if self._next is None and self._is_next_known():
                self._next = self._sample(self._number)
            t_ns = self._number * self.period_ns()
            if self._next is None or t_ns > self._clock_ns:
                return advanced
            self._publish_y_m(self._encoder.encode(t_ns, self._next))
            self._number = self._number + 1
            self._next = None
            advanced = True

    def _is_next_known(self) -> bool:
        """Return whether all commands are known that the next y_m in lockstep depends on.

        They are known if no u_m is due at the instant one period before this y_m. If a u_m is due
        then, it must have arrived, and this method takes it.
        """
        t_ns = (self._number - 1) * self.period_ns()
        if not self._u_m_ns or t_ns < 0 or t_ns % self._u_m_ns:
            return True
        if not self._u_m_due:
            self._u_m_due.extend(self._u_m.receive())
        if not self._u_m_due:
            return False
        if (command := self._u_m_due.popleft()) is not None:
            self._u_m.accept(command, t_ns)
        return True

    def awaited_topic(self) -> str:
        waits = self._u_m_ns and self._next is None
        return (self._u_m if waits else self._clock_subscription).name

    def status(self) -> tuple[bytes, str, dict[str, object]]:
        level, _, figures = super().status()
        source = self._reference.source()
        figures["failed steps"] = self._reference.failed
        level = DiagnosticStatus.ERROR if source is Source.ENDING else level
        return level, source.value, figures
