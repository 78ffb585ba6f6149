# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""The simulated aircraft at the sample instants: a flight dynamics model and sensors.

The node and the loop in one process use this simulator, for every kind of aircraft.
"""

import math
from collections import deque
from collections.abc import Sequence
from typing import Protocol

import numpy as np

from aircraft_sim import plant, pose, sensors, truth, turbulence, vanes, wind_field
from aircraft_sim.disturbance import AXES
from aircraft_sim.dynamics import Forcing
from aircraft_sim.ground import LEVEL, touch
from aircraft_sim.params import AircraftConfig
from aircraft_sim.sensors import DelayLine
from flight_core import plausible
from flight_core.channels import POSE
from flight_core.kinematics import heading_rate
from flight_core.outcome import End, FlightEnded
from flight_core.parameters import require
from flight_core.rates import divide, nanoseconds, period_ns, seconds
from flight_core.vectors import FloatArray, StampedVector

BLOCK = 100  # steps
POSE_STATES = ("V", "alpha", "beta", "phi", "theta", "q", "r")
"""States of an airframe from which its pose follows."""

WRAPPED = [POSE.index(name) for name in ("phi", "psi")]
"""Channels of pose within half a turn."""


class FlightDynamicsModel(Protocol):
    """The interface of an aircraft between command and sensors."""

    @property
    def truth_names(self) -> tuple[str, ...]:
        """Channels of `truth`: "group.name"."""

    def advance(self, t_ns: int, u: FloatArray, duration_ns: int) -> None:
        """From t to t + duration with the command u held, deviations from trim, SI."""

    def y(self) -> FloatArray:
        """The outputs before the sensors, deviations from trim, shape (m,), SI."""

    def air_angles(self, t_ns: int) -> FloatArray:
        """Alpha and beta relative to the air, deviations from trim, rad, shape (2,)."""

    def truth(self, t_ns: int) -> FloatArray:
        """Values in the order of `truth_names`."""

    def pose(self) -> FloatArray:
        """The pose relative to the air mass, in the order of `channels.POSE`, absolute values,
        SI.
        """

    def diverged(self) -> bool:
        """Whether the state is not finite or too large for a flight."""

    def retune(self, t_ns: int, parameters: AircraftConfig) -> None:
        """Take the actuator faults and the gusts of these parameters from t on."""


class StateSpaceModel:
    """Equation (1) with the matrices of an airframe, behind actuators.

    The forcing is computed for BLOCK steps together, which takes a tenth of the time. Heading,
    position and altitude, no states of an airframe, are integrated by the trapezoidal rule over
    `advance`, from 0. States missing in the airframe are 0, as in trim.
    """

    def __init__(self, parameters: AircraftConfig) -> None:
        self._plant = parameters.plant()
        self._state = plant.initial_state(self._plant)
        self._block_ns = 0
        self._block = plant.forcing(0, BLOCK, self._plant)
        airframe = parameters.sampled_airframe()
        self.truth_names = truth.names(airframe)
        states = list(airframe.states)
        self._places = [states.index(name) if name in states else None for name in POSE_STATES]
        self._axes = list(airframe.gusts)
        self._angles = [
            (POSE_STATES.index(name), self._axes.index(axis) if axis in self._axes else None)
            for name, axis in zip(vanes.ANGLES, ("vertical", "lateral"), strict=True)
        ]
        self._speed = airframe.speed
        self._euler = parameters.kinematics != "linear"
        # north, east, altitude
        self._psi = 0.0
        self._position = [0.0, 0.0, 0.0]
        self._over_place = parameters.relative_wind()
        self._wind_here = self._wind_at(0)
        self._wind_dot = np.zeros(3)
        self._into = np.zeros((len(states), 3))  # of a change of the wind forward, right, down
        for k, name in enumerate(("V", "beta", "alpha")):
            if name in states:
                self._into[states.index(name), k] = -1.0 if name == "V" else -1.0 / self._speed
        self._psi_dot, self._velocity = (
            self._heading_rate(self._states()),
            self._air_velocity(self._states()),
        )

    def advance(self, t_ns: int, u: FloatArray, duration_ns: int) -> None:
        """See FlightDynamicsModel."""
        steps = divide(duration_ns, self._plant.step_ns, "step", "the duration")
        begin = (t_ns - self._block_ns) // self._plant.step_ns
        if not 0 <= begin <= begin + steps <= BLOCK or self._drifts(t_ns):
            self._block_ns = t_ns
            begin = 0
            self._block = plant.forcing(t_ns, max(steps, BLOCK), self._plant, self._state.x)
        forced = Forcing(*(part[2 * begin : 2 * (begin + steps) + 1] for part in self._block))
        if self._over_place is not None:
            forced = forced._replace(rate=forced.rate + self._rate_by_wind())
        self._state = plant.advance(
            t_ns, self._state, u, duration_ns, self._plant, self._tilted(forced)
        )
        half = seconds(duration_ns) / 2.0
        self._fly_on(2.0 * half)
        psi_dot = self._psi_dot
        velocity = self._velocity
        states = self._states()
        self._psi_dot = self._heading_rate(states)
        self._psi += half * (psi_dot + self._psi_dot)
        self._velocity = self._air_velocity(states)
        self._position = [
            x + half * (v + w)
            for x, v, w in zip(self._position, velocity, self._velocity, strict=True)
        ]
        if self._over_place is not None:
            before = self._wind_here
            self._position = [
                x + 2.0 * half * w
                for x, w in zip(self._position, (*before[:2], -before[2]), strict=True)
            ]
            self._wind_here = self._wind_at(t_ns + duration_ns)
            self._wind_dot = (self._wind_here - before) / (2.0 * half)

    def _tilted(self, forced: Forcing) -> Forcing:
        """The forcing of a step, with what a tilt takes from the lift: nothing of an airplane."""
        return forced

    def _fly_on(self, dt: float) -> None:
        """Integrate over a step what no state of the airframe holds, beside heading and place."""

    def _wind_at(self, t_ns: int) -> FloatArray:
        """The wind against that of the start, to the north, to the east and down, m/s."""
        if self._over_place is None:
            return np.zeros(3)
        return self._over_place.at(seconds(t_ns), *self._position)

    def _rate_by_wind(self) -> FloatArray:
        """x_dot by the change of the wind along the flight, shape (n,): the states V, beta and
        alpha are relative to the air.

        V_dot -= W_dot forward, beta_dot -= W_dot right / V0, alpha_dot -= W_dot down / V0. W_dot is
        that over the period before. Source: B. Etkin, Dynamics of Atmospheric Flight (1972), 5.5.
        """
        _, _, _, phi, theta, *_ = self._states()
        return self._into @ (wind_field.body_axes(phi, theta, self._psi) @ self._wind_dot)

    def _drifts(self, t_ns: int) -> bool:
        """Whether the aircraft at t differs from that of the block."""
        drift = self._plant.drift
        if drift is None:
            return False
        now, before = plant.share(
            np.array([seconds(t_ns), seconds(self._block_ns)]), drift.start, drift.duration
        )
        return bool(now != before)

    def pose(self) -> FloatArray:
        """See FlightDynamicsModel."""
        _, _, beta, phi, theta, *_ = self._states()
        attitude = (pose.wrapped(phi), theta, pose.wrapped(self._psi))
        velocity = np.array(self._velocity)
        if self._over_place is not None:
            velocity += self._wind_here * [1.0, 1.0, -1.0]
        return np.array([*attitude, *self._position, *velocity, beta])

    def _states(self) -> list[float]:
        """The POSE_STATES, deviations from trim."""
        x = self._state.x.tolist()
        return [0.0 if place is None else x[place] for place in self._places]

    def _heading_rate(self, states: Sequence[float]) -> float:
        """psi_dot in rad/s from the POSE_STATES; r with the linear kinematics."""
        *_, phi, theta, q, r = states
        return heading_rate(phi, theta, q, r) if self._euler else r

    def _air_velocity(self, states: Sequence[float]) -> tuple[float, float, float]:
        """Velocity relative to the air mass: north, east, up, m/s."""
        V, alpha, beta, phi, theta, *_ = states
        return pose.velocity(self._speed + V, alpha, beta, phi, theta, self._psi)

    def y(self) -> FloatArray:
        """See FlightDynamicsModel."""
        y: FloatArray = plant.output(self._state, self._plant)
        return y

    def air_angles(self, t_ns: int) -> FloatArray:
        """See FlightDynamicsModel: x less the wind along the axis of the angle over V0,
        `disturbance.AIR_STATE`.
        """
        x = self._states()
        wind = self._block.wind[2 * ((t_ns - self._block_ns) // self._plant.step_ns)]
        if self._plant.turbulence is not None:
            wind = wind + turbulence.wind(self._state.turbulence, self._plant.turbulence)
        return np.array(
            [
                x[place] - (0.0 if axis is None else wind[axis] / self._speed)
                for place, axis in self._angles
            ]
        )

    def truth(self, t_ns: int) -> FloatArray:
        """See FlightDynamicsModel."""
        index = 2 * ((t_ns - self._block_ns) // self._plant.step_ns)
        flown = self._plant._replace(aircraft=plant.aircraft_at(t_ns, self._plant, self._state.x))
        rate = self._block.rate[index]
        wind = self._block.wind[index]
        if self._over_place is not None:
            rate = rate + self._rate_by_wind()
            along = wind_field.body_axes(0.0, 0.0, self._psi) @ self._wind_here
            blown = [place for place, axis in enumerate(self._axes) if axis in AXES]
            wind = wind.copy()
            wind[blown] += along[[AXES.index(self._axes[place]) for place in blown]]
        return truth.values(self._state, wind, rate, flown)

    def diverged(self) -> bool:
        """See FlightDynamicsModel."""
        return plant.diverged(self._state)

    def retune(self, t_ns: int, parameters: AircraftConfig) -> None:
        """See FlightDynamicsModel."""
        aircraft = self._plant.aircraft._replace(gusts=parameters.gust_arrays(self._axes))
        self._plant = self._plant._replace(
            aircraft=aircraft,
            actuators=parameters.actuator_model(),
            drift=parameters.drift_factors(),
        )
        self._block_ns, self._block = t_ns, plant.forcing(t_ns, BLOCK, self._plant, self._state.x)


class Simulator:
    """A flight dynamics model and sensors, sample by sample."""

    def __init__(self, parameters: AircraftConfig) -> None:
        channels = parameters.channels()
        self.outputs = tuple(channels.outputs)
        self.inputs = tuple(channels.inputs)
        self.period_ns = period_ns(parameters.rate, "rate")
        self._largest = plausible.largest(self.outputs)
        self._model: FlightDynamicsModel  # in trim at t = 0
        if parameters.is_jsbsim:
            from aircraft_sim.jsbsim_model import JsbsimModel  # noqa: PLC0415 - other aircraft fly without JSBSim

            self._model = JsbsimModel(
                parameters.flight_condition(), parameters.actuator_model(), parameters.wind_model()
            )
        elif parameters.kinematics == "thrust":
            from aircraft_sim.multicopter import MulticopterModel  # noqa: PLC0415 - has this module's model as base

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
        late = nanoseconds(parameters.actuators.delay) // self.period_ns
        self._commands = deque([np.zeros(len(self.inputs))] * late)  # on the way to the actuators
        self._require_above_ground(0)

    def retune(self, parameters: AircraftConfig) -> None:
        """Take faults and gusts of these parameters from now on. Raises ParameterError where one
        would change the past.
        """
        now_ns = self._number * self.period_ns
        t = seconds(now_ns)
        for axis, gust in parameters.gusts.items():
            old = self._gusts.get(axis)
            if gust == old:
                continue
            require(
                gust.start >= t, f"gusts.{axis}.start", f"{gust.start:g} s", f"at least t = {t:g} s"
            )
            end = old.start + 2.0 * old.length / self._speed if old is not None and old.speed else t
            end = math.inf if old is not None and old.speed and math.isfinite(old.every) else end
            over = old is None or t <= old.start or end <= t
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
        """Advance to sample `number`, at number periods of flight time, with u held since the last
        sample, and measure.

        Returns the arriving y, the oldest first; their stamps are flight time. Raises FlightEnded
        on the ground, and where the aircraft has diverged: its state, or an output beyond
        `flight_core.plausible`.
        """
        t_ns = number * self.period_ns
        self._advance(number, u)
        self._number = number
        true = self._model.y()
        # false for NaN too
        if self._model.diverged() or not (np.abs(true) <= self._largest[: len(true)]).all():
            raise FlightEnded(f"diverged at t = {seconds(t_ns):.2f} s")
        if self._vanes is not None and self._vane_state is not None:
            angles = self._model.air_angles(t_ns)
            self._vane_state = vanes.turned(seconds(t_ns), angles, self._vane_state, self._vanes)
            true = np.concatenate([true, self._vane_state.angle])
        measured, self._error, self._drift = sensors.measure(
            number, true, self._drift, self._sensors
        )
        if self._vanes is not None and self._vane_state is not None:
            size_y = len(measured) - len(self._vanes.places)
            self._vane_state = vanes.read(number, measured[size_y:], self._vane_state, self._vanes)
            measured = np.concatenate([measured[:size_y], self._vane_state.reading])
        y = measured if sensors.arrives(number, self._sensors) else None
        self._delay_line, arrived = sensors.transmit(self._delay_line, t_ns, y, self._sensors)
        return arrived

    def _advance(self, number: int, u: FloatArray) -> None:
        """The model to a sample, period by period where u is late."""
        step = 1 if self._commands else max(number - self._number, 1)
        for k in range(self._number, number, step):
            self._commands.append(u)
            late = self._commands.popleft()
            try:
                self._model.advance(k * self.period_ns, late, step * self.period_ns)
            except FlightEnded as ended:
                self._number = k + step
                raise self._with_place(ended) from None
        self._require_above_ground(number * self.period_ns)

    def _require_above_ground(self, t_ns: int) -> None:
        """Raise FlightEnded where the aircraft comes down on the ground of the scenario."""
        if self._ground is None:
            return
        at = dict(zip(POSE, self.pose().tolist(), strict=True))
        was_above = self._is_above_ground
        self._is_above_ground = at["altitude"] > self._ground
        if was_above and not self._is_above_ground:
            is_level = abs(at["phi"]) < LEVEL
            ended = touch(self._title, t_ns, -at["climb"], is_on_wheels=is_level)
            raise self._with_place(ended)

    def _with_place(self, ended: FlightEnded) -> FlightEnded:
        """The end with the speed across the heading and the place, where it is a landing."""
        if ended.end is not End.LANDED:
            return ended
        at = dict(zip(POSE, self.pose().tolist(), strict=True))
        across = at["v_east"] * math.cos(at["psi"]) - at["v_north"] * math.sin(at["psi"])
        place = f"north {at['north']:.0f} m, east {at['east']:.1f} m"
        return FlightEnded(f"{ended}, {abs(across):.1f} m/s sideways, at {place}", ended.end)

    def pose(self) -> FloatArray:
        """The true pose at the instant of the last sample, in the order of `channels.POSE`."""
        return pose.over_ground(
            self._model.pose(), seconds(self._number * self.period_ns), self._wind, self._start
        )

    def poses(self) -> DelayLine:
        """The poses that arrive at the instant of the last sample, the oldest first, as measured;
        stamps are flight time.
        """
        due = self._number % self._pose_every == 0
        t_ns = self._number * self.period_ns
        if self._pose_sensors is None:
            return (StampedVector(t_ns, self.pose()),) if due else ()
        measured = None
        if due:
            number = self._number // self._pose_every
            measured, self._pose_error, self._pose_drift = sensors.measure(
                number, self.pose(), self._pose_drift, self._pose_sensors
            )
            for k in WRAPPED:
                measured[k] = pose.wrapped(float(measured[k]))
        self._poses, arrived = sensors.transmit(self._poses, t_ns, measured, self._pose_sensors)
        return arrived

    def truth(self) -> FloatArray:
        """The true values at the instant of the last sample, in the order of `truth_names`."""
        t_ns = self._number * self.period_ns
        pose_errors = () if self._pose_sensors is None else (self._pose_error,)
        return np.concatenate([[seconds(t_ns)], self._model.truth(t_ns), self._error, *pose_errors])
