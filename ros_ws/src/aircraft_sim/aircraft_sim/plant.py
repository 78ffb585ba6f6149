# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""The aircraft in time: fixed steps of equation (1) under an input held between samples."""

from aircraft_sim.dynamics import Aircraft, x_dot
from flight_core.integrators import rk4
from flight_core.rates import divide, seconds
from flight_core.vectors import Array


def advance(t_ns: int, x: Array, u: Array, duration_ns: int, step_ns: int, params: Aircraft) -> Array:
    """x(t + duration) from x(t) with u held (zero-order hold), by Runge-Kutta steps of equation (1).

    Time is counted in ns so that steps add up exactly. Raises ParameterError where the step does not divide the duration.
    """
    for k in range(divide(duration_ns, step_ns, "step", "the duration")):
        x = rk4(x_dot, seconds(t_ns + k * step_ns), x, u, params, seconds(step_ns))
    return x
