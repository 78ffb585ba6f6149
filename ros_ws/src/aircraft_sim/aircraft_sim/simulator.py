# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Simulate an aircraft at the sample instants, by a flight dynamics model and sensors.

The node and the loop in one process use this module, for every kind of aircraft.
"""

import math
from collections import deque
from typing import Protocol

import numpy as np

from aircraft_sim import pose, sensors, vanes
from aircraft_sim.ground import LEVEL, touch
from aircraft_sim.multicopter import MulticopterModel
from aircraft_sim.params import AircraftConfig
from aircraft_sim.sensors import DelayLine
from aircraft_sim.state_space_model import StateSpaceModel
from flight_core import plausible
from flight_core.channels import POSE
from flight_core.outcome import End, FlightEnded
from flight_core.parameters import require
from flight_core.rates import nanoseconds, period_ns, seconds
from flight_core.vectors import FloatArray, StampedVector

WRAPPED = [POSE.index(name) for name in ("phi", "psi")]
"""Indices in pose of the angles that are wrapped to (-pi, pi]."""


class FlightDynamicsModel(Protocol):
    """What the simulator needs of an aircraft, from the command u to outputs without sensors."""

    @property
    def truth_names(self) -> tuple[str, ...]:
        """Names of the channels of `truth`, each as "group.name"."""

    def advance(self, t_ns: int, u: FloatArray, duration_ns: int) -> None:
        """Fly from t to t + duration with the command u held, deviations from trim, SI."""

    def y(self) -> FloatArray:
        """Return the outputs before the sensors, deviations from trim, shape (m,), SI."""

    def air_angles(self, t_ns: int) -> FloatArray:
        """Return alpha and beta relative to the air, deviations from trim, rad, shape (2,)."""

    def truth(self, t_ns: int) -> FloatArray:
        """Return the values in the order of `truth_names`."""

    def pose(self) -> FloatArray:
        """Return the pose relative to the air mass, SI, in the order of `channels.POSE`.

        The values are absolute, not deviations from trim.
        """

    def has_diverged(self) -> bool:
        """Return whether the state is not finite, or too large for a flight."""

    def retune(self, t_ns: int, parameters: AircraftConfig) -> None:
        """Use the actuator faults and the gusts of `parameters` from t on."""


class Simulator:
    """A flight dynamics model with its sensors, advanced from sample to sample."""

    def __init__(self, parameters: AircraftConfig) -> None:
        channels = parameters.channels()
        self.outputs = tuple(channels.outputs)
        self.inputs = tuple(channels.inputs)
        self.period_ns = period_ns(parameters.rate, "rate")
        self._largest = plausible.largest(self.outputs)
        self._model: FlightDynamicsModel  # in trim at t = 0
        if parameters.is_jsbsim:
            from aircraft_sim.jsbsim.jsbsim_model import JsbsimModel  # noqa: PLC0415 - other aircraft fly without JSBSim

            self._model = JsbsimModel(
                parameters.flight_condition(), parameters.actuator_model(), parameters.wind_model()
            )
        elif parameters.kinematics == "thrust":
            self._model = MulticopterModel(parameters)
        else:
            self._model = StateSpaceModel(parameters)
        over_place = parameters.relative_wind()
        self._wind = parameters.wind if over_place is None else over_place.carried
        self._title = parameters.airframe
        self._ground = None if parameters.is_jsbsim else parameters.ground()
        self._is_above_ground = False
        self._gusts = parameters.gusts
        self._speed = channels.speed
        self._drift_section = parameters.drift
        self._start = pose.Start(**parameters.start.model_dump())
        self._pose_every = parameters.pose_every()
        self._pose_sensors = parameters.pose_sensors()
        self._poses: DelayLine = ()
        self._sensors = parameters.sensor_arrays()
        self._vanes = parameters.vanes.arrays(parameters.sensors.seed)
        self._vane_state = None if self._vanes is None else vanes.initial_state(self._vanes)
        self.truth_names = (
            "t",
            *self._model.truth_names,
            *(f"pose.{name}" for name in POSE),
            *(f"noise.{name}" for name in self.outputs),
        )
        if self._pose_sensors is not None:
            self.truth_names += tuple(f"noise.pose.{name}" for name in POSE)
            self._pose_drift = sensors.initial_drift(self._pose_sensors)
            self._pose_error = np.zeros(len(POSE))
        self._drift = sensors.initial_drift(self._sensors)
        self._delay_line: DelayLine = ()
        self._error = np.zeros(len(self.outputs))
        self._number = 0
        self._pose: FloatArray | None = None  # at the last sample, once it is computed
        late = nanoseconds(parameters.actuators.delay) // self.period_ns
        # values of u on the way to the actuators
        self._commands = deque([np.zeros(len(self.inputs))] * late)
        self._require_above_ground(0)

    def retune(self, parameters: AircraftConfig) -> None:
        """Use the faults and gusts of `parameters` from now on.

        Raises ParameterError if a fault or a gust would change the past.
        """
        now_ns = self._number * self.period_ns
        t = seconds(now_ns)
        for axis, gust in parameters.gusts.items():
            gust_before = self._gusts.get(axis)
            if gust == gust_before:
                continue
            require(
                gust.start >= t, f"gusts.{axis}.start", f"{gust.start:g} s", f"at least t = {t:g} s"
            )
            if gust_before is not None and gust_before.speed:
                end = gust_before.start + 2.0 * gust_before.length / self._speed
            else:
                end = t
            if gust_before is not None and gust_before.speed and math.isfinite(gust_before.every):
                end = math.inf
            over = gust_before is None or t <= gust_before.start or end <= t
            require(
                over,
                f"gusts.{axis}",
                "a change of a gust that acts",
                f"one after its end at t = {end:g} s",
            )
        if (drift := parameters.drift) != (before := self._drift_section):
            require(
                drift is None or drift.start >= t,
                "drift.start",
                f"{drift and drift.start:g} s",
                f"at least t = {t:g} s",
            )
            acts = before is not None and before.start < t
            require(not acts, "drift", "a change of a drift that acts", "one before its start")
        self._drift_section = drift
        self._gusts = parameters.gusts
        self._sensors = parameters.sensor_arrays()
        self._vanes = parameters.vanes.arrays(parameters.sensors.seed)
        self._model.retune(now_ns, parameters)

    def sample(self, number: int, u: FloatArray) -> DelayLine:
        """Advance to sample `number` with u held since the last sample, and measure.

        The flight time of the sample is `number` periods. Returns the samples of y that arrive, the
        oldest first, with stamps in flight time. Raises FlightEnded if the aircraft touches the
        ground, if its state has diverged, or if an output is beyond `flight_core.plausible`.
        """
        t_ns = number * self.period_ns
        self._advance(number, u)
        self._number = number
        self._pose = None
        true = self._model.y()
        # The comparison is also false for NaN.
        if self._model.has_diverged() or not (np.abs(true) <= self._largest[: len(true)]).all():
            raise FlightEnded(f"diverged at t = {seconds(t_ns):.2f} s")
        if self._vanes is not None and self._vane_state is not None:
            angles = self._model.air_angles(t_ns)
            self._vane_state = vanes.turned(seconds(t_ns), angles, self._vane_state, self._vanes)
            true = np.concatenate([true, self._vane_state.angle])
        measurement = sensors.measure(number, true, self._drift, self._sensors)
        measured = measurement.y
        self._error, self._drift = measurement.error, measurement.drift
        if self._vanes is not None and self._vane_state is not None:
            size_y = len(measured) - len(self._vanes.places)
            self._vane_state = vanes.read_vanes(
                number, measured[size_y:], self._vane_state, self._vanes
            )
            measured = np.concatenate([measured[:size_y], self._vane_state.reading])
        y = measured if sensors.has_arrived(number, self._sensors) else None
        self._delay_line, arrived = sensors.transmit(self._delay_line, t_ns, y, self._sensors)
        return arrived

    def _advance(self, number: int, u: FloatArray) -> None:
        """Advance the model to a sample.

        If u is delayed, the u that acts can change in each period, so the model advances period by
        period.
        """
        step = 1 if self._commands else max(number - self._number, 1)
        self._pose = None
        for k in range(self._number, number, step):
            self._commands.append(u)
            late = self._commands.popleft()
            try:
                self._model.advance(k * self.period_ns, late, step * self.period_ns)
            except FlightEnded as ended:
                self._number = k + step
                self._pose = None
                raise self._with_place(ended) from None
        self._require_above_ground(number * self.period_ns)

    def _require_above_ground(self, t_ns: int) -> None:
        """Raise FlightEnded if the aircraft comes down on the ground of the scenario."""
        if self._ground is None:
            return
        at = dict(zip(POSE, self.pose().tolist(), strict=True))
        was_above = self._is_above_ground
        self._is_above_ground = at["altitude"] > self._ground
        if was_above and not self._is_above_ground:
            is_level = abs(at["phi"]) < LEVEL
            end = touch(self._title, t_ns, -at["climb"], is_on_wheels=is_level)
            raise self._with_place(end)

    def _with_place(self, end: FlightEnded) -> FlightEnded:
        """Add lateral speed and place to the sentence of a flight that ends as a landing."""
        if end.end is not End.LANDED:
            return end
        at = dict(zip(POSE, self.pose().tolist(), strict=True))
        across = at["v_east"] * math.cos(at["psi"]) - at["v_north"] * math.sin(at["psi"])
        place = f"north {at['north']:.0f} m, east {at['east']:.1f} m"
        return FlightEnded(f"{end}, {abs(across):.1f} m/s sideways, at {place}", end.end)

    def pose(self) -> FloatArray:
        """Return the true pose at the last sample, in the order of `channels.POSE`."""
        if self._pose is None:
            t = seconds(self._number * self.period_ns)
            self._pose = pose.over_ground(self._model.pose(), t, self._wind, self._start)
        return self._pose

    def poses(self) -> DelayLine:
        """Return the measured poses that arrive at the last sample, the oldest first.

        Their stamps are in flight time.
        """
        due = self._number % self._pose_every == 0
        t_ns = self._number * self.period_ns
        if self._pose_sensors is None:
            return (StampedVector(t_ns, self.pose()),) if due else ()
        measured_pose = None
        if due:
            number = self._number // self._pose_every
            measurement = sensors.measure(number, self.pose(), self._pose_drift, self._pose_sensors)
            measured_pose = measurement.y
            self._pose_error, self._pose_drift = measurement.error, measurement.drift
            for k in WRAPPED:
                measured_pose[k] = pose.wrapped(float(measured_pose[k]))
        self._poses, arrived = sensors.transmit(
            self._poses, t_ns, measured_pose, self._pose_sensors
        )
        return arrived

    def truth(self) -> FloatArray:
        """Return the true values at the last sample, in the order of `truth_names`."""
        t_ns = self._number * self.period_ns
        pose_errors = () if self._pose_sensors is None else (self._pose_error,)
        return np.concatenate(
            [[seconds(t_ns)], self._model.truth(t_ns), self.pose(), self._error, *pose_errors]
        )
