# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""What a control law is to a fleet: a start, a step, and what it may look at. Arrays hold N aircraft in their last axis."""

from collections.abc import Callable
from typing import Any, NamedTuple

from flight_core.vectors import Array


class Measurements(NamedTuple):
    """What a law may look at, at a tick. Channels in the law's order, states in the airframe's; SI, deviations from trim."""

    y: Array  # (m, N) measured outputs
    y_m: Array  # (m, 1) reference
    y_m_dot: Array  # (m, 1) its derivative
    u_ff: Array  # (m, 1) feedforward along the reference, 0 where it is off
    u_before: Array  # (m, N) the last command, after limits
    position: Array  # (m, N) of the actuators
    x: Array  # (n, N) state: the outputs as measured, the others as they are
    x_air: Array  # (n, N) the same with alpha and beta relative to the air
    y_dot: Array  # (m, N) derivative of C x, as no sensor has it


class ControlLaw(NamedTuple):
    """A law. Its parameters are arrays of (m, 1), or of (m, N) where each aircraft has its own."""

    start: Callable[[Measurements, Any], Any]  # (seen, params) -> state, at engagement
    step: Callable[[Any, Measurements, Array, Any], tuple[Any, Array]]  # (state, seen, dt, params) -> (state, u after limits)
