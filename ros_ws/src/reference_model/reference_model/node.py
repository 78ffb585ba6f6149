# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""The reference model's node: equation (2) in real time, y_m out."""

from flight_core.rates import nanoseconds, period_ns, seconds
from flight_core.vectors import Array, ChannelError, FloatArray
from flight_ros.messages import from_message, to_message
from flight_ros.runtime import FlightNode, run
from flight_ros.ticker import Tick
from flight_ros.topics import U_M, Y_M
from reference_model import model
from reference_model.command import command
from reference_model.params import ReferenceModelParameters, zero_state


class ReferenceModelNode(FlightNode[ReferenceModelParameters]):
    """At tick k: x_m from t(k-1) to t(k), y_m(k) out. Commands are the scenario's profile until one comes on u_m."""

    def __init__(self) -> None:
        super().__init__("reference_model", ReferenceModelParameters)
        self._model, self._profile = self.parameters.model(), self.parameters.profile()
        self._period_ns = period_ns(self.parameters.rate, "rate")
        self._x_m = zero_state(self._model)
        self._live: FloatArray | None = None
        self._u_m_inbox = self.inbox(U_M)
        self._y_m_publisher = self.publisher(Y_M)

    def period_ns(self) -> int:
        return self._period_ns

    def start_ns(self) -> int:
        return nanoseconds(self.parameters.start_time)

    def tick(self, tick: Tick, now_ns: int) -> None:
        for number in range(tick.previous, tick.number):
            t = seconds(number * self._period_ns)
            self._x_m = model.step(t, self._x_m, self._command, seconds(self._period_ns), self._model)
        y_m = model.output(self._x_m, self._model)
        self._y_m_publisher.publish(to_message(now_ns, self.parameters.outputs, y_m, self.instance))
        for received in self._u_m_inbox.take():
            try:
                live = from_message(received.message, self.parameters.outputs).value
            except ChannelError as error:
                self.reject(self._u_m_inbox, error.reason, str(error))
                continue
            if self._live is None:
                self.get_logger().info(f"commands come from {self._u_m_inbox.name} now, in place of the profile")
            self._live = live

    def _command(self, t: Array) -> Array:
        return command(t, self._profile) if self._live is None else self._live

    def status(self) -> tuple[bytes, str, dict[str, object]]:
        level, _, figures = super().status()
        return level, "profile" if self._live is None else "live commands", figures


def main() -> None:
    """Entry point of the executable `reference_model`."""
    run(ReferenceModelNode)


if __name__ == "__main__":
    main()
