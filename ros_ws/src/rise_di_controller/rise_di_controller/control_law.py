# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Protocol of a control law, for Monte Carlo campaigns: a function for engagement, a function for a step, and their inputs.

Each law of `control_laws` returns a `ControlLaw`. Every array holds N aircraft in its last axis, so that one call steps all of
them. The functions are pure: they keep no state of their own, and work with NumPy and JAX arrays.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

from flight_core.vectors import Array


class Measurements(NamedTuple):
    """Inputs of a law at a tick: SI units, deviations from trim.

    Channels are in the law's order, states in the airframe's order. RISE-DI uses y, y_m, u_ff and u_before only; the other
    fields serve laws that need more sensors.
    """

    y: Array  # (m, N) measured outputs
    y_m: Array  # (m, 1) reference
    y_m_dot: Array  # (m, 1) derivative of y_m
    u_ff: Array  # (m, 1) feedforward along the reference, 0 where it is off
    u_before: Array  # (m, N) the last command, after saturation
    position: Array  # (m, N) positions of the actuators
    x: Array  # (n, N) state: measured values of the outputs, true values of the other states
    x_air: Array  # (n, N) x with alpha and beta relative to the air
    y_dot: Array  # (m, N) true derivative of C x, free of noise and delay


class ControlLaw(NamedTuple):
    """A control law as two pure functions.

    `start` makes the state of the law at engagement. `step` takes one tick of dt seconds and returns the new state and u after
    saturation, shape (m, N). The parameters are arrays of (m, 1), or of (m, N) where each aircraft has its own.
    """

    start: Callable[[Measurements, Any], Any]  # (measurements, params) -> state
    step: Callable[[Any, Measurements, Array, Any], tuple[Any, Array]]  # (state, measurements, dt, params) -> (state, u)
