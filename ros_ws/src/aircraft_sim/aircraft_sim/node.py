# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""The simulated aircraft's node: u in, y and truth out, in real time or in lockstep, whatever kind of aircraft it is."""

import numpy as np
from diagnostic_msgs.msg import DiagnosticStatus

from aircraft_sim.params import AircraftParameters
from aircraft_sim.simulator import Simulator
from flight_core.rates import nanoseconds, period_ns, seconds
from flight_core.vectors import ChannelError, FloatArray, StampedVector
from flight_ros.flight_node import FlightNode
from flight_ros.messages import NO_CHANNELS, instant, stamp_of
from flight_ros.publisher_lock import PublisherLock
from flight_ros.ticker import Tick
from flight_ros.topics import CLOCK, RECORDED, TRUTH, NodeState, U, Y

WINDOW = 100
"""Samples that a lockstep flight may be ahead of its log: less than publishers keep for a recorder that is held up."""


class AircraftNode(FlightNode[AircraftParameters]):
    """At tick k: the state from t(k-1) to t(k) under the u held since then, y and truth out, then the newest u is taken.

    In lockstep it makes the time: /clock, y and truth at each of its instants, and at those of the controller it moves on when
    u has come. Each instant has exactly one y, one without channels where no sample arrives.
    """

    def __init__(self) -> None:
        super().__init__("aircraft", AircraftParameters)
        self._simulator = Simulator(self.parameters)
        self._u = np.zeros(len(self._simulator.inputs))
        self._source = PublisherLock()
        self._u_stamp_ns = 0  # of the last u
        self._said_silent = False
        self._u_subscription, self._decoder = self.subscribe(U), self.decoder(U, self._simulator.inputs)
        self._publish_y, self._publish_truth = self.advertise(Y), self.advertise(TRUTH)
        self._y_encoder = self.encoder(Y, self._simulator.outputs)
        self._truth_encoder = self.encoder(TRUTH, self._simulator.truth_names)
        if self.parameters.lockstep:
            self._number = 0  # of the sample that comes next
            self._answered = True
            self._recorded_ns = 0
            self._control_ns = period_ns(self.parameters.control_rate, "control_rate")
            self._end_ns = nanoseconds(self.parameters.duration) or None
            self._nothing = self.encoder(Y, ())
            self._recorded_subscription = self.subscribe(RECORDED)
            self._publish_clock = self.advertise(CLOCK)

    def period_ns(self) -> int:
        return self._simulator.period_ns

    def start_ns(self) -> int:
        return nanoseconds(self.parameters.start_time)

    def tick(self, tick: Tick, now_ns: int) -> None:
        share = self.parameters.failsafe_scale(self._source.silence_ns(now_ns))
        self._publish(tick.number, now_ns - tick.number * self.period_ns(), self._u if share == 1.0 else share * self._u)
        self._take_u(now_ns)

    def _publish(self, number: int, start_ns: int, u: FloatArray) -> bool:
        arrived = self._simulator.sample(number, u)
        for sample in arrived:
            self._publish_y(self._y_encoder.encode(start_ns + sample.stamp_ns, sample.value))
        stamp_ns = start_ns + number * self.period_ns()
        self._publish_truth(self._truth_encoder.encode(stamp_ns, self._simulator.truth()))
        return bool(arrived)

    def advance(self) -> bool:
        if not self._answered and not self._take_u(self._number * self.period_ns()):
            return False
        self._answered = True
        if self._finished() or self._ahead_of_the_log():
            return False
        t_ns = self._number * self.period_ns()
        self._publish_clock(instant(t_ns))  # first: y_m is made while the aircraft moves
        if not self._publish(self._number, 0, self._u):
            self._publish_y(self._nothing.encode(t_ns, NO_CHANNELS))
        self._answered = t_ns % self._control_ns != 0
        self._number += 1
        if self._finished():
            self.publish_state(NodeState.COMPLETED)
            self.get_logger().info(f"flown to its end at t = {seconds(t_ns):g} s")
        return True

    def _finished(self) -> bool:
        return self._end_ns is not None and self._number * self.period_ns() > self._end_ns

    def _ahead_of_the_log(self) -> bool:
        if not self.parameters.recorded:
            return False
        for received in self._recorded_subscription.take():
            self._recorded_ns = stamp_of(received.message)
        return self._number * self.period_ns() >= self._recorded_ns + WINDOW * self.period_ns()

    def awaited_topic(self) -> str:
        return self._u_subscription.name if not self._answered else self._recorded_subscription.name

    def _take_u(self, now_ns: int) -> bool:
        came = False
        for received in self._u_subscription.take(1 if self.parameters.lockstep else None):  # in lockstep there is one answer
            try:
                sample = self._decoder.decode(received.message)
                if sample is not None and not self.parameters.lockstep:
                    self._require_timely(sample, now_ns)
                if sample is not None:
                    self._source.require(sample.sender, now_ns, self._max_age_ns, self._strange_ns)
            except ChannelError as error:
                self.reject(self._u_subscription, error.reason, str(error))
                continue
            came = True
            if sample is not None:  # else the controller has nothing to say at this instant of a lockstep flight
                self._accept(sample, now_ns)
        if self._silent(now_ns):
            self.warn_no_publisher(self._u_subscription)
            if self._source.name is not None and not self._said_silent:
                self._said_silent = True
                self.get_logger().error(self._silence)
        return came

    def _require_timely(self, sample: StampedVector, now_ns: int) -> None:
        """Raise ChannelError where a u belongs to a time to come, or to one before the last u, by more than the age limit."""
        ahead_ns, behind_ns = sample.stamp_ns - now_ns, self._u_stamp_ns - sample.stamp_ns
        if ahead_ns > self._max_age_ns:
            raise ChannelError("future", f"stamp {seconds(ahead_ns):g} s ahead of the clock")
        if behind_ns > self._max_age_ns and not self._silent(now_ns):
            raise ChannelError("order", f"stamp {seconds(behind_ns):g} s before the last one")

    def _accept(self, sample: StampedVector, now_ns: int) -> None:
        self._u, self._u_stamp_ns, self._said_silent = sample.value, sample.stamp_ns, False
        if self._source.hear(sample.sender, now_ns):
            self.get_logger().info(f"flown by {self._source.name}")

    @property
    def _max_age_ns(self) -> int:
        return nanoseconds(self.parameters.max_age)

    @property
    def _strange_ns(self) -> int:
        """After which silence another node than the one before may fly it: once u is at trim."""
        return self._max_age_ns + nanoseconds(self.parameters.hold + self.parameters.ramp)

    def _silent(self, now_ns: int) -> bool:
        return self._source.silent(now_ns, self._max_age_ns)

    @property
    def _silence(self) -> str:
        return f"{self._source.name} is silent: its last u is held, then let go to trim"

    def status(self) -> tuple[bytes, str, dict[str, object]]:
        if self._source.name is None:
            return DiagnosticStatus.WARN, "no u yet, flying in trim", {}
        if not self.parameters.lockstep and self._silent(self.now_ns()):
            return DiagnosticStatus.ERROR, self._silence, {}
        return DiagnosticStatus.OK, f"flown by {self._source.name}", {}
