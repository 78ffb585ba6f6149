# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Simulate a multicopter: a linear airframe for rates and climb, and the tilt of the thrust.

The tilt moves the multicopter over ground.
"""

from collections.abc import Sequence

import numpy as np

from aircraft_sim.params import AircraftConfig
from aircraft_sim.plant.dynamics import Forcing
from aircraft_sim.state_space_model import POSE_STATES, StateSpaceModel
from flight_core.channels import VERTICAL, vertical
from flight_core.kinematics import euler_rates, thrust_axis
from flight_core.units import GRAVITY

PHI = POSE_STATES.index("phi")
THETA = POSE_STATES.index("theta")


class MulticopterModel(StateSpaceModel):
    """Equation (1) for p, q, r and the climb rate c, with attitude and horizontal velocity v.

        c_dot = A[c, c] c + T_c + (n_up - 1) T,  T = g + T_c,  T_c = (B u)[c]
        v_dot = T [n_north, n_east] + A[c, c] v

    The attitude follows Euler's equations, and n is the `thrust_axis` of the attitude. The damping
    of the climb acts in every direction. If A has the states phi and theta, they have no effect on
    the pose, because the model integrates a separate attitude. n and the rates are taken in the
    middle of a step.
    """

    def __init__(self, parameters: AircraftConfig) -> None:
        states = [*parameters.sampled_airframe().states]
        self._rates = [states.index(name) for name in ("p", "q", "r")]
        self._climb = states.index(vertical(states))
        self._up = VERTICAL[vertical(states)]
        self._into_climb = self._up * np.eye(len(states))[self._climb]
        self._phi = 0.0
        self._theta = 0.0
        self._level = np.zeros(2)  # m/s, velocity through the air, to the north and to the east
        super().__init__(parameters)

    def _thrust(self) -> float:
        """Return the specific thrust T, m/s^2."""
        row = self._plant.aircraft.B[self._climb]
        return GRAVITY + self._up * float(row @ self._state.position)

    def _tilted(self, forced: Forcing) -> Forcing:
        """Return the forcing of a step, with the loss of lift that a tilt causes."""
        up = thrust_axis(self._phi, self._theta, self._psi)[2]
        return forced._replace(rate=forced.rate + (up - 1.0) * self._thrust() * self._into_climb)

    def _fly_on(self, dt: float) -> None:
        """Integrate attitude and horizontal velocity over a step."""
        p, q, r = self._state.x[self._rates].tolist()
        phi_dot, theta_dot = euler_rates(self._phi, self._theta, p, q, r)
        half = dt / 2.0
        north, east, _ = thrust_axis(
            self._phi + half * phi_dot,
            self._theta + half * theta_dot,
            self._psi + half * self._psi_dot,
        )
        damping = self._plant.aircraft.A[self._climb, self._climb]
        self._phi += dt * phi_dot
        self._theta += dt * theta_dot
        self._level = self._level + dt * (
            self._thrust() * np.array([north, east]) + damping * self._level
        )

    def _states(self) -> list[float]:
        """Return the POSE_STATES, deviations from trim."""
        states = super()._states()
        states[PHI] = self._phi
        states[THETA] = self._theta
        return states

    def _air_velocity(self, states: Sequence[float]) -> tuple[float, float, float]:
        """Return the velocity relative to the air mass: north, east, up, m/s."""
        north, east = self._level.tolist()
        return north, east, self._up * float(self._state.x[self._climb])
