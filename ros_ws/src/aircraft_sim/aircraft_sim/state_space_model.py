# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""The flight dynamics model of an airframe: equation (1) with wind and pose."""

from collections.abc import Sequence

import numpy as np

from aircraft_sim import pose, truth, vanes
from aircraft_sim.atmosphere import turbulence, wind_field
from aircraft_sim.atmosphere.disturbance import AXES
from aircraft_sim.params import AircraftConfig
from aircraft_sim.plant import plant
from aircraft_sim.plant.dynamics import Forcing
from flight_core.kinematics import heading_rate
from flight_core.rates import divide, seconds
from flight_core.vectors import FloatArray

BLOCK = 100  # number of steps for which the forcing is computed at once
POSE_STATES = ("V", "alpha", "beta", "phi", "theta", "q", "r")
"""States of an airframe from which its pose follows."""


class StateSpaceModel:
    """Equation (1) with the matrices of an airframe, behind actuators.

    The forcing is computed for BLOCK steps at once, in a tenth of the time that single steps take.
    An airframe has no states for heading, position and altitude. They begin at 0, and each call of
    `advance` integrates them by the trapezoidal rule. States that the airframe lacks are 0, as in
    trim.
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
        self._psi = 0.0
        self._position = [0.0, 0.0, 0.0]  # north, east, altitude
        self._over_place = parameters.relative_wind()
        self._wind_here = self._wind_at(0)
        self._wind_dot = np.zeros(3)
        # effect on x_dot of a change of the wind: forward, right, down
        self._into = np.zeros((len(states), 3))
        for k, name in enumerate(("V", "beta", "alpha")):
            if name in states:
                self._into[states.index(name), k] = -1.0 if name == "V" else -1.0 / self._speed
        self._psi_dot, self._velocity = (
            self._heading_rate(self._states()),
            self._air_velocity(self._states()),
        )

    def advance(self, t_ns: int, u: FloatArray, duration_ns: int) -> None:
        """Fly from t to t + duration with u held, deviations from trim, SI."""
        steps = divide(duration_ns, self._plant.step_ns, "step", "the duration")
        begin = (t_ns - self._block_ns) // self._plant.step_ns
        if not 0 <= begin <= begin + steps <= BLOCK or self._is_drifting(t_ns):
            self._block_ns = t_ns
            begin = 0
            self._block = plant.forcing(t_ns, max(steps, BLOCK), self._plant, self._state.x)
        forcing = Forcing(*(part[2 * begin : 2 * (begin + steps) + 1] for part in self._block))
        if self._over_place is not None:
            forcing = forcing._replace(rate=forcing.rate + self._rate_by_wind())
        self._state = plant.advance(
            t_ns, self._state, u, duration_ns, self._plant, self._tilted(forcing)
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
        """Return the forcing of a step; a subclass adds the loss of lift in a tilt."""
        return forced

    def _fly_on(self, dt: float) -> None:
        """Integrate over a step the motion that a subclass adds to the states of the airframe."""

    def _wind_at(self, t_ns: int) -> FloatArray:
        """Return the wind minus the wind at the start: north, east and down, m/s."""
        if self._over_place is None:
            return np.zeros(3)
        return self._over_place.at(seconds(t_ns), *self._position)

    def _rate_by_wind(self) -> FloatArray:
        """Compute x_dot caused by the change of the wind along the flight, shape (n,).

        The states V, beta and alpha are relative to the air: V_dot -= W_dot forward, beta_dot -=
        W_dot right / V0, alpha_dot -= W_dot down / V0. W_dot is that over the previous period.
        Source: B. Etkin, Dynamics of Atmospheric Flight (1972), 5.5.
        """
        _, _, _, phi, theta, *_ = self._states()
        return self._into @ (wind_field.body_axes(phi, theta, self._psi) @ self._wind_dot)

    def _is_drifting(self, t_ns: int) -> bool:
        """Return whether the drift at t differs from the one that the block was computed with."""
        drift = self._plant.drift
        if drift is None:
            return False
        now, before = plant.share(
            np.array([seconds(t_ns), seconds(self._block_ns)]), drift.start, drift.duration
        )
        return bool(now != before)

    def pose(self) -> FloatArray:
        """Return the pose relative to the air mass, in the order of `channels.POSE`."""
        _, _, beta, phi, theta, *_ = self._states()
        attitude = (pose.wrapped(phi), theta, pose.wrapped(self._psi))
        velocity = np.array(self._velocity)
        if self._over_place is not None:
            velocity += self._wind_here * [1.0, 1.0, -1.0]
        return np.array([*attitude, *self._position, *velocity, beta])

    def _states(self) -> list[float]:
        """Return the POSE_STATES, deviations from trim."""
        x = self._state.x.tolist()
        return [0.0 if place is None else x[place] for place in self._places]

    def _heading_rate(self, states: Sequence[float]) -> float:
        """Compute psi_dot, rad/s, from the POSE_STATES; with linear kinematics it is r."""
        *_, phi, theta, q, r = states
        return heading_rate(phi, theta, q, r) if self._euler else r

    def _air_velocity(self, states: Sequence[float]) -> tuple[float, float, float]:
        """Return the velocity relative to the air mass: north, east, up, m/s."""
        V, alpha, beta, phi, theta, *_ = states
        return pose.velocity(self._speed + V, alpha, beta, phi, theta, self._psi)

    def y(self) -> FloatArray:
        """Return the outputs before the sensors, deviations from trim, shape (m,), SI."""
        y: FloatArray = plant.output(self._state, self._plant)
        return y

    def air_angles(self, t_ns: int) -> FloatArray:
        """Return alpha and beta relative to the air, deviations from trim, rad, shape (2,).

        Each angle is the state of this name, minus w / V0. w is the wind along the axis that
        belongs to the angle in `disturbance.AIR_STATE`.
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
        """Return the values of `truth` in the order of `truth_names`."""
        index = 2 * ((t_ns - self._block_ns) // self._plant.step_ns)
        plant_now = self._plant._replace(
            aircraft=plant.aircraft_at(t_ns, self._plant, self._state.x)
        )
        rate = self._block.rate[index]
        wind = self._block.wind[index]
        if self._over_place is not None:
            rate = rate + self._rate_by_wind()
            along = wind_field.body_axes(0.0, 0.0, self._psi) @ self._wind_here
            blown = [place for place, axis in enumerate(self._axes) if axis in AXES]
            wind = wind.copy()
            wind[blown] += along[[AXES.index(self._axes[place]) for place in blown]]
        return truth.values(self._state, wind, rate, plant_now)

    def has_diverged(self) -> bool:
        """Return whether the state is not finite, or too large for a flight."""
        return plant.has_diverged(self._state)

    def retune(self, t_ns: int, parameters: AircraftConfig) -> None:
        """Use the actuator faults and the gusts of `parameters` from t on."""
        aircraft = self._plant.aircraft._replace(gusts=parameters.gust_arrays(self._axes))
        self._plant = self._plant._replace(
            aircraft=aircraft,
            actuators=parameters.actuator_model(),
            drift=parameters.drift_factors(),
        )
        self._block_ns, self._block = t_ns, plant.forcing(t_ns, BLOCK, self._plant, self._state.x)
