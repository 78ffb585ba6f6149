# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""The node of the simulated aircraft, in real time or in lockstep.

It subscribes to u, and publishes y, pose and truth. A watchdog measures the age of u. If u times
out, the failsafe holds the last value, and then ramps it to trim.
"""

from collections.abc import Sequence

import numpy as np
from diagnostic_msgs.msg import DiagnosticStatus

from aircraft_sim.applied_input import AppliedInput
from aircraft_sim.params import AircraftConfig
from aircraft_sim.pose import every
from aircraft_sim.simulator import Simulator
from flight_core import channels
from flight_core.publisher_lock import LockstepLock
from flight_core.rates import nanoseconds, period_ns, seconds
from flight_core.text import bounded
from flight_core.vectors import FloatArray, StampedVector
from flight_ros.flight_node import FlightNode
from flight_ros.messages import NO_CHANNELS, Decoder, instant
from flight_ros.subscriptions import PolledSubscription
from flight_ros.ticker import Tick
from flight_ros.topics import CLOCK, POSE, RECORDED, TRUTH, NodeState, U, Y

WINDOW = 100
"""Largest lead of a lockstep flight over its log, in samples. Publishers keep more samples than
this for a recorder that overruns, so none is lost."""


class AircraftNode(FlightNode[AircraftConfig]):
    """Flies the simulated aircraft from sample to sample.

    At tick k the node integrates from t(k-1) to t(k) with the last u held. Then it publishes y and
    truth, and takes the newest u. In lockstep this node sets the time, and publishes y, truth and
    pose at their instants. At each instant of the controller, the node waits for u and then
    publishes clock with the next instant. Each instant has exactly one y, which has no channels if
    no sample arrives.
    """

    def __init__(self) -> None:
        super().__init__("aircraft", AircraftConfig)
        self._simulator = Simulator(self.parameters)
        self._u = np.zeros(len(self._simulator.inputs))  # the newest u
        held_ns = nanoseconds(self.parameters.max_age + self.parameters.hold)
        self._applied = AppliedInput(len(self._u), held_ns, nanoseconds(self.parameters.ramp))
        self._publisher_lock = self.publisher_lock(self._timeouts_ns)
        self._timeout_logged = False
        # ages of the u since the last diagnostics, ns: time from the stamp of a u, which is that of
        # its y, to its arrival by this node's clock
        self._ages_of_u: list[int] = []
        decode = Decoder(self._simulator.inputs).decode
        self._u_receiver = self.receive(
            U, decode, self._accept_u, max_age_ns=self._max_u_age_ns, lock=self._publisher_lock
        )
        self._publish_y, self._publish_truth = self.advertise(Y), self.advertise(TRUTH)
        self._publish_pose, self._pose_encoder = self.advertise(POSE), self.encoder(channels.POSE)
        self._y_encoder = self.encoder(self._simulator.outputs)
        self._truth_encoder = self.encoder(self._simulator.truth_names)
        if self.parameters.lockstep:
            self._number = 0  # number of the next sample
            self._u_received = True
            self._completed = False
            self._recorded_ns = 0
            self._control_ns = period_ns(self.parameters.control_rate, "control_rate")
            self._end_ns = nanoseconds(self.parameters.duration) or None
            self._empty_encoder = self.encoder(())
            self._recorded_subscription = self.subscribe(RECORDED)
            self._recorded_lock = LockstepLock()
            self._publish_clock = self.advertise(CLOCK)

    def period_ns(self) -> int:
        return self._simulator.period_ns

    def inputs(self) -> Sequence[PolledSubscription]:
        return (self._u_receiver.subscription,)

    def on_parameters(self, parameters: AircraftConfig) -> None:
        """Use the changed faults and gusts from the next sample on."""
        self._simulator.retune(parameters)

    def tick(self, tick: Tick, now_ns: int) -> None:
        start_ns = now_ns - tick.number * self.period_ns()
        for message in self._fly_to(tick.number, start_ns, self._applied.u_at(now_ns)):
            self._publish_y(message)
        self._publish_motion(tick.number, start_ns)
        self._take_u(now_ns)

    def _fly_to(self, number: int, start_ns: int, u: FloatArray) -> list[bytes]:
        """Fly to a sample, and return the messages with the samples of y that arrive."""
        return [
            self._y_encoder.encode(start_ns + y.stamp_ns, y.value)
            for y in self._simulator.sample(number, u)
        ]

    def _publish_motion(self, number: int, start_ns: int) -> None:
        stamp_ns = start_ns + number * self.period_ns()
        poses = self._simulator.poses()
        for pose in poses:
            self._publish_pose(self._pose_encoder.encode(start_ns + pose.stamp_ns, pose.value))
        awaited = self.parameters.lockstep and number % every(self.parameters.rate) == 0
        if awaited and not (poses and start_ns + poses[-1].stamp_ns == stamp_ns):
            # An empty message says that no pose with the stamp of this instant will come.
            self._publish_pose(self._empty_encoder.encode(stamp_ns, NO_CHANNELS))
        self._publish_truth(self._truth_encoder.encode(stamp_ns, self._simulator.truth()))

    def advance(self) -> bool:
        if not self._u_received and not self._take_u((self._number - 1) * self.period_ns()):
            return False
        self._u_received = True
        if self._is_finished():
            self._complete()
            return False
        if self._is_ahead_of_log():
            return False
        # The next instant that needs a u follows.
        waits_ns = -(-self._number * self.period_ns() // self._control_ns) * self._control_ns
        until_ns = min(waits_ns, self._end_ns or waits_ns)
        # The clock comes first, so that the reference model can compute y_m during the integration.
        self._publish_clock(instant(until_ns))
        messages: list[bytes] = []
        while (t_ns := self._number * self.period_ns()) <= until_ns:
            messages += self._fly_to(self._number, 0, self._u) or [
                self._empty_encoder.encode(t_ns, NO_CHANNELS)
            ]
            self._publish_motion(self._number, 0)
            self._number += 1
        # Send the messages together, because each single y would wake up the controller.
        for message in messages:
            self._publish_y(message)
        self._u_received = until_ns % self._control_ns != 0
        return True

    def _complete(self) -> None:
        """Report once that the flight is complete: the u of its last instant has arrived."""
        if not self._completed:
            self._completed = True
            self.publish_state(NodeState.COMPLETED)
            self.get_logger().info(
                f"flight completed at t = {seconds((self._number - 1) * self.period_ns()):g} s"
            )

    def _is_finished(self) -> bool:
        return self._end_ns is not None and self._number * self.period_ns() > self._end_ns

    def _is_ahead_of_log(self) -> bool:
        if not self.parameters.recorded:
            return False
        subscription = self._recorded_subscription
        stamps = self.refusals.stamps(subscription, subscription.take(), self._recorded_lock)
        self._recorded_ns = stamps[-1] if stamps else self._recorded_ns
        return self._number * self.period_ns() >= self._recorded_ns + WINDOW * self.period_ns()

    def awaited_topic(self) -> str:
        return self._u_receiver.name if not self._u_received else self._recorded_subscription.name

    def _take_u(self, now_ns: int) -> bool:
        """Take the u that has arrived, and return whether there was a valid message.

        A message without channels is valid, too. In lockstep it says that the controller has no
        output at this instant.
        """
        publisher = self._publisher_lock.publisher
        u = self._u
        # In lockstep there is one u for each y, and a refused u does not count.
        most = 1 if self.parameters.lockstep else None
        valid = self._u_receiver.poll(now_ns, most)
        while most and valid == [False]:
            valid = self._u_receiver.poll(now_ns, most)
        if transfer := self._publisher_lock.publisher != publisher:
            self.get_logger().info(bounded(f"receiving u from {self._publisher_lock.publisher}"))
            if publisher is None and not self.parameters.lockstep:
                self.publish_state(NodeState.FLYING)
        if self._u is not u:
            self._applied.take(self._u, now_ns, transfer=transfer)
        if self._has_timed_out(now_ns):
            self.warn_no_publisher(self._u_receiver.subscription)
            if self._publisher_lock.publisher is not None and not self._timeout_logged:
                self._timeout_logged = True
                self.get_logger().error(self._failsafe_message)
        return any(valid)

    def _accept_u(self, sample: StampedVector, now_ns: int) -> None:
        self._u = sample.value
        self._timeout_logged = False
        if not self.parameters.lockstep:
            self._ages_of_u.append(now_ns - sample.stamp_ns)

    def _max_u_age_ns(self) -> int:
        """Return the age limit of u, ns, from the stamp of the y from which u was computed.

        The limit is needed because of suspended controllers: when such a process is resumed, its
        middleware first sends the last u from before.
        """
        return self._max_age_ns + nanoseconds(self.parameters.sensors.delay)

    @property
    def _max_age_ns(self) -> int:
        return nanoseconds(self.parameters.max_age)

    def _timeouts_ns(self) -> tuple[int, int]:
        """Return how long the publisher of u must be silent before another may take over, ns.

        The first value is for the same node in a new process, and the second for another node. By
        then the failsafe has brought u to trim.
        """
        return self._max_age_ns, self._max_age_ns + nanoseconds(
            self.parameters.hold + self.parameters.ramp
        )

    def _has_timed_out(self, now_ns: int) -> bool:
        return self._publisher_lock.has_timed_out(now_ns, self._max_age_ns)

    @property
    def _failsafe_message(self) -> str:
        return (
            f"failsafe: u from {self._publisher_lock.publisher} timed out: the last value is "
            "held, then ramped to trim"
        )

    def status(self) -> tuple[bytes, str, dict[str, object]]:
        if self._publisher_lock.publisher is None:
            return DiagnosticStatus.WARN, "no u received yet: flying in trim", {}
        if not self.parameters.lockstep and self._has_timed_out(self.now_ns()):
            return DiagnosticStatus.ERROR, self._failsafe_message, {}
        ages = self._ages_of_u
        self._ages_of_u = []
        figures: dict[str, object] = {}
        if ages:
            mean = seconds(round(sum(ages) / len(ages)))
            largest = seconds(max(ages))
            figures = {
                channels.AGE_OF_U["mean"]: f"{mean:.4f}",
                channels.AGE_OF_U["max"]: f"{largest:.4f}",
            }
        return (
            DiagnosticStatus.OK,
            bounded(f"receiving u from {self._publisher_lock.publisher}"),
            figures,
        )
