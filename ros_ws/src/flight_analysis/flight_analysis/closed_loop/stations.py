# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""The loop of a flight in one process: stations that act in the order of the data flow.

Each station has the code of a node, without ROS.
"""

import math
from collections import defaultdict
from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import cached_property
from typing import Protocol

import numpy as np

from aircraft_sim.params import AircraftConfig
from aircraft_sim.simulator import Simulator
from flight_core.channels import ATTITUDE, POSE
from flight_core.outcome import FlightEnded
from flight_core.rates import period_ns, seconds
from flight_core.tape import Signal
from flight_core.vectors import ChannelError, FloatArray, StampedVector, select
from flight_guidance.guidance import Guidance
from flight_guidance.params import GuidanceConfig
from reference_model.params import ReferenceModelConfig
from reference_model.reference import Reference
from rise_di_controller.controller import Controller, ControlOutput

Take = Callable[[StampedVector, int], object]
"""A function that takes a sample and the instant at which it arrives, ns."""


class Station(Protocol):
    """Interface of a part of the loop, such as the controller, that acts once a period."""

    @property
    def period_ns(self) -> int:
        """The period of the steps, ns."""

    def step(self, t_ns: int) -> None:
        """Act at flight time t, ns. Raises FlightEnded or ChannelError if the flight ends."""


class FlightLoop:
    """Steps, at each instant, the stations that are due, in the order of their list."""

    def __init__(self, stations: Sequence[Station]) -> None:
        self._stations = stations
        self._base_ns = math.gcd(*(station.period_ns for station in stations))
        self.t_ns = -self._base_ns

    def run(self, end_ns: int) -> None:
        """Step all stations from the present instant on, up to and including `end_ns`.

        The attribute `t_ns` is the present instant, ns. After an error it is the instant of the
        error.
        """
        for t_ns in range(self.t_ns + self._base_ns, end_ns + 1, self._base_ns):
            self.t_ns = t_ns
            for station in self._stations:
                if t_ns % station.period_ns == 0:
                    station.step(t_ns)


class Topics:
    """Passes samples to the subscribers of their topic, and keeps them if `recorded`."""

    def __init__(self, *, recorded: bool = True) -> None:
        self._recorded = recorded
        self._names: dict[str, tuple[str, ...]] = {}
        self._stamps: dict[str, list[int]] = defaultdict(list)
        self._rows: dict[str, list[FloatArray]] = defaultdict(list)
        self._subscriptions: dict[str, list[tuple[Sequence[str] | None, Take]]] = defaultdict(list)

    def advertise(self, topic: str, names: Sequence[str]) -> None:
        """Announce a topic with the names of its channels."""
        self._names[topic] = tuple(names)

    def names(self, topic: str) -> tuple[str, ...]:
        """Return the channels of a topic. Raises KeyError if it is not advertised yet."""
        return self._names[topic]

    def subscribe(self, topic: str, take: Take, channels: Sequence[str] | None = None) -> None:
        """Call `take` with each sample of a topic.

        `take` gets the values of `channels`, in this order, or of all channels if `channels` is
        None.
        """
        self._subscriptions[topic].append((channels, take))

    def is_taken(self, topic: str) -> bool:
        """Return whether the samples of a topic are needed: by a subscriber, or to be recorded."""
        return self._recorded or topic in self._subscriptions

    def publish(self, topic: str, sample: StampedVector, t_ns: int) -> None:
        """Record a sample, then call the subscribers.

        Raises ChannelError if the topic lacks a channel to which a station subscribes.
        """
        if self._recorded:
            # The stamp comes first: an interrupt before the next line leaves a stamp without a row.
            self._stamps[topic].append(sample.stamp_ns)
            self._rows[topic].append(sample.value)
        for channels, take in self._subscriptions.get(topic, ()):
            values = sample.value
            if channels is not None:
                values = select(channels, self._names[topic], values)
            take(StampedVector(sample.stamp_ns, values), t_ns)

    def pop_signals(self) -> dict[str, Signal]:
        """Return the samples recorded since the last call, by topic."""
        signals = {}
        for topic, names in self._names.items():
            rows = self._rows.pop(topic, [])
            values = np.array(rows) if rows else np.zeros((0, len(names)))
            signals[topic] = Signal(
                np.array(self._stamps.pop(topic, [])[: len(rows)], dtype=np.int64), names, values
            )
        return signals


def _or_refuse(take: Take) -> Take:
    """Wrap a subscriber so that a sample for which it raises ChannelError is dropped.

    A node drops such a sample as well.
    """

    def take_or_refuse(sample: StampedVector, t_ns: int) -> None:
        with suppress(ChannelError):
            take(sample, t_ns)

    return take_or_refuse


class AircraftStation:
    """The simulated aircraft, which publishes y, pose and truth, and holds the last u.

    A lost sample of y is not published. A delayed sample keeps the stamp of its measurement.
    `every_ns` replaces the period of the station by a longer one.
    """

    def __init__(
        self, parameters: AircraftConfig, topics: Topics, every_ns: int | None = None
    ) -> None:
        self._parameters = parameters
        self._topics = topics
        self.period_ns = every_ns or period_ns(parameters.rate, "rate")
        channels = parameters.channels()
        self._u = np.zeros(len(channels.inputs))
        topics.advertise("y", tuple(channels.outputs))
        topics.subscribe("u", self._take_u, tuple(channels.inputs))

    def _take_u(self, sample: StampedVector, _t_ns: int) -> None:
        self._u = sample.value

    @cached_property
    def _simulator(self) -> Simulator:
        """The simulator, in trim at t = 0. Raises FlightEnded if there is no trim."""
        simulator = Simulator(self._parameters)
        self._topics.advertise("truth", simulator.truth_names)
        self._topics.advertise("pose", POSE)
        return simulator

    def step(self, t_ns: int) -> None:
        """Simulate up to flight time t, and publish y.

        The topics `pose` and `truth` are only published if they are recorded or have a subscriber.
        """
        simulator = self._simulator
        for sample in simulator.sample(t_ns // simulator.period_ns, self._u):
            self._topics.publish("y", sample, t_ns)
        if self._topics.is_taken("pose"):
            for sample in simulator.poses():
                self._topics.publish("pose", sample, t_ns)
        if self._topics.is_taken("truth"):
            self._topics.publish("truth", StampedVector(t_ns, simulator.truth()), t_ns)


class ReferenceStation:
    """The reference model, which publishes y_m. A new u_m acts from the next step on."""

    def __init__(
        self, parameters: ReferenceModelConfig, topics: Topics, every_ns: int | None = None
    ) -> None:
        self._reference = Reference(parameters)
        self._topics = topics
        self.period_ns = every_ns or self._reference.period_ns
        topics.advertise("y_m", parameters.outputs)
        topics.subscribe("u_m", _or_refuse(self._take_u_m))

    def _take_u_m(self, sample: StampedVector, t_ns: int) -> None:
        u_m, attitude = np.split(sample.value, [-len(ATTITUDE)])
        self._reference.take(t_ns, u_m, attitude)

    def step(self, t_ns: int) -> None:
        """Compute y_m at flight time t, and publish it."""
        y_m = self._reference.sample(t_ns // self._reference.period_ns)
        self._topics.publish("y_m", StampedVector(t_ns, y_m), t_ns)


class GuidanceStation:
    """Guidance, which publishes u_m and the topic `guidance`, the log of its steps."""

    def __init__(self, guidance: Guidance, parameters: GuidanceConfig, topics: Topics) -> None:
        self._guidance = guidance
        self._topics = topics
        self.period_ns = guidance.period_ns
        topics.advertise("u_m", (*parameters.outputs, *ATTITUDE))
        topics.advertise("guidance", guidance.names)
        topics.subscribe("y", _or_refuse(guidance.take_y), parameters.outputs)
        topics.subscribe("pose", _or_refuse(guidance.take_pose))
        topics.subscribe("authority", self._take_authority)

    def _take_authority(self, sample: StampedVector, _t_ns: int) -> None:
        names = self._topics.names("authority")
        self._guidance.take_authority(dict(zip(names, sample.value.tolist(), strict=True)))

    def step(self, t_ns: int) -> None:
        """Take a step of guidance, and publish u_m.

        Raises FlightEnded if guidance has published no u_m for too long, for example if the pose is
        too old.
        """
        if reason := self._guidance.reason_to_wait(t_ns):
            raise FlightEnded(f"ended at t = {seconds(t_ns):.2f} s: {reason}")
        if (guided := self._guidance.step(t_ns, t_ns)) is not None:
            self._topics.publish("u_m", StampedVector(t_ns, guided.u_m), t_ns)
            self._topics.publish("guidance", StampedVector(t_ns, guided.log), t_ns)


class ControllerStation:
    """The controller, which publishes u and the topic `internals`, the log of its ticks.

    The attribute `output` is the output of the last tick, or None if that tick had none.
    """

    def __init__(self, controller: Controller, topics: Topics) -> None:
        parameters = controller.parameters
        self.controller = controller
        self._topics = topics
        self.period_ns = controller.period_ns
        self.output: ControlOutput | None = None
        topics.advertise("u", parameters.effectors)
        topics.advertise("internals", controller.names)
        if parameters.probe is not None:
            topics.advertise("effects", parameters.inputs)
        topics.subscribe("y", controller.take_y, parameters.measured)
        topics.subscribe("y_m", controller.take_y_m, parameters.outputs)

    def step(self, t_ns: int) -> None:
        """Compute a tick of the controller, and publish its u and its log if it has an output."""
        self.output = self.controller.tick(t_ns)
        if self.output is not None:
            self._topics.publish("u", StampedVector(self.output.stamp_ns, self.output.u), t_ns)
            self._topics.publish(
                "internals", StampedVector(self.output.stamp_ns, self.output.internals), t_ns
            )
            if self.output.effects is not None:
                sample = StampedVector(self.output.stamp_ns, self.output.effects)
                self._topics.publish("effects", sample, t_ns)
