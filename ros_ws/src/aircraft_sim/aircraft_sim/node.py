# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""The simulated aircraft's node: equation (1) in real time, u in, y and truth out."""

import numpy as np
from diagnostic_msgs.msg import DiagnosticStatus

from aircraft_sim import plant, truth
from aircraft_sim.params import AircraftParameters
from aircraft_sim.sensors import Underway, transmit
from flight_core.outcome import FlightEnded
from flight_core.rates import nanoseconds, period_ns, seconds
from flight_core.vectors import ChannelError
from flight_ros.messages import from_message, to_message
from flight_ros.runtime import FlightNode, run
from flight_ros.ticker import Tick
from flight_ros.topics import TRUTH, U, Y


class AircraftNode(FlightNode[AircraftParameters]):
    """At tick k: the state from t(k-1) to t(k) under the u held since then, y and truth out, then the newest u is taken."""

    def __init__(self) -> None:
        super().__init__("aircraft", AircraftParameters)
        self._airframe, _ = self.parameters.load()
        self._plant = self.parameters.plant()
        self._period_ns = period_ns(self.parameters.rate, "rate")
        self._truth_names = truth.names(self._airframe, self.parameters)
        self._state = plant.start(self._plant)
        self._underway: Underway = ()
        self._u = np.zeros(len(self._airframe.inputs))
        self._u_from: str | None = None
        self._u_ns = 0  # when the last u came
        self._u_inbox = self.inbox(U)
        self._y_publisher, self._truth_publisher = self.publisher(Y), self.publisher(TRUTH)

    def period_ns(self) -> int:
        return self._period_ns

    def start_ns(self) -> int:
        return nanoseconds(self.parameters.start_time)

    def tick(self, tick: Tick, now_ns: int) -> None:
        before_ns, t_ns = tick.previous * self._period_ns, tick.number * self._period_ns
        share = self.parameters.commanded_share(now_ns - self._u_ns)
        u = self._u if share == 1.0 else share * self._u
        self._state = plant.advance(before_ns, self._state, u, t_ns - before_ns, self._plant)
        if plant.diverged(self._state):
            raise FlightEnded(f"diverged at t = {seconds(t_ns):.2f} s")
        measured = plant.measure(tick.number, self._state, self._plant)
        self._underway, arrived = transmit(self._underway, now_ns, measured.y, self._plant.sensors)
        for sample in arrived:
            self._y_publisher.publish(to_message(sample.stamp_ns, self._airframe.outputs, sample.y, self.instance))
        values = truth.values(t_ns, self._state, measured.noise, self._plant.aircraft)
        self._truth_publisher.publish(to_message(now_ns, self._truth_names, values, self.instance))
        self._take_u(now_ns)

    def _take_u(self, now_ns: int) -> None:
        for received in self._u_inbox.take():
            sender = received.message.header.frame_id
            if sender != self._u_from and not self._silent(now_ns):
                self.reject(self._u_inbox, "sender", f"{sender} commands too, beside {self._u_from}")
                continue
            try:
                self._u = from_message(received.message, list(self._airframe.inputs)).value
            except ChannelError as error:
                self.reject(self._u_inbox, error.reason, str(error))
                continue
            self._u_ns = now_ns
            if sender != self._u_from:
                self._u_from = sender
                self.get_logger().info(f"flown by {sender}")
        if self._silent(now_ns):
            self.waiting_for(self._u_inbox)

    def _silent(self, now_ns: int) -> bool:
        return now_ns - self._u_ns > nanoseconds(self.parameters.max_age)

    def status(self) -> tuple[bytes, str, dict[str, object]]:
        if self._u_from is None:
            return DiagnosticStatus.WARN, "no u yet, flying in trim", {}
        if self._silent(self.get_clock().now().nanoseconds):
            return DiagnosticStatus.ERROR, f"{self._u_from} is silent: its last u is held, then let go to trim", {}
        return DiagnosticStatus.OK, f"flown by {self._u_from}", {}


def main() -> None:
    """Entry point of the executable `aircraft`."""
    run(AircraftNode)


if __name__ == "__main__":
    main()
