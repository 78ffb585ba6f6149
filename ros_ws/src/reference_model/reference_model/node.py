# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""The reference model node: publishes y_m of equation (2) in real time or in lockstep."""

from flight_core.rates import nanoseconds
from flight_core.vectors import ChannelError
from flight_ros.flight_node import FlightNode
from flight_ros.messages import stamp_of
from flight_ros.ticker import Tick
from flight_ros.topics import CLOCK, U_M, Y_M
from reference_model.params import ReferenceModelParameters
from reference_model.reference import Reference


class ReferenceModelNode(FlightNode[ReferenceModelParameters]):
    """Computes x_m(k) from x_m(k-1) at tick k and publishes y_m(k). Commands are the scenario's profile until u_m is received.

    In lockstep it publishes every y_m up to the instant of /clock and computes the next one ahead, from the profile only.
    """

    def __init__(self) -> None:
        super().__init__("reference_model", ReferenceModelParameters)
        self._reference = Reference(self.parameters)
        self._publish_y_m = self.advertise(Y_M)
        self._encoder = self.encoder(Y_M, self.parameters.outputs)
        if self.parameters.lockstep:
            self._number, self._next = 0, self._reference.sample(0)
            self._clock_subscription = self.subscribe(CLOCK)
        else:
            self._u_m_subscription, self._decoder = self.subscribe(U_M), self.decoder(U_M, self.parameters.outputs)

    def period_ns(self) -> int:
        return self._reference.period_ns

    def start_ns(self) -> int:
        return nanoseconds(self.parameters.start_time)

    def tick(self, tick: Tick, now_ns: int) -> None:
        self._publish_y_m(self._encoder.encode(now_ns, self._reference.sample(tick.number)))
        for received in self._u_m_subscription.take():
            try:
                sample = self._decoder.decode(received.message)
            except ChannelError as error:
                self.reject(self._u_m_subscription, error.reason, str(error))
                continue
            if sample is None:
                continue
            if self._reference.live is None:
                self.get_logger().info(f"commands from {self._u_m_subscription.name} replace the profile")
            self._reference.live = sample.value

    def advance(self) -> bool:
        now_ns = max((stamp_of(received.message) for received in self._clock_subscription.take()), default=-1)
        if now_ns < 0:
            return False
        while self._number * self.period_ns() <= now_ns:
            self._publish_y_m(self._encoder.encode(self._number * self.period_ns(), self._next))
            self._number += 1
            self._next = self._reference.sample(self._number)
        return True

    def awaited_topic(self) -> str:
        return self._clock_subscription.name

    def status(self) -> tuple[bytes, str, dict[str, object]]:
        level, _, figures = super().status()
        return level, "profile" if self._reference.live is None else "live commands", figures
