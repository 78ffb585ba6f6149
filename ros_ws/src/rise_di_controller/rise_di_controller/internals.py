# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""The controller's log: one named vector a tick, enough to recompute u without anything else but the parameters."""

from collections.abc import Sequence

import numpy as np

from flight_core.vectors import FloatArray
from rise_di_controller.guard import ControllerState, Used

SCALARS = ("mode", "dt", "y_m_offset", "late", "age")
GROUPS = ("y", "y_m", "e", "integral_e", "Pi")


def names(outputs: Sequence[str]) -> tuple[str, ...]:
    """Channel names of `internals`: the scalars, then "group.output" for each group.

    mode (Mode), dt (s), y_m_offset (s), late (s, the tick after its deadline), age (s, of y at the tick); y and y_m as used,
    e = y - y_m, integral_e (units s), Pi (scaled input).
    """
    return (*SCALARS, *(f"{group}.{output}" for group in GROUPS for output in outputs))


def values(state: ControllerState, used: Used, late: float, age: float) -> FloatArray:
    """Values of `internals` in the order of `names`. Raises ValueError for a state that was never engaged."""
    if state.law is None:
        raise ValueError("internals of a controller that was never engaged")
    scalars = np.array([float(state.mode), used.dt, used.y_m_offset, late, age])
    return np.concatenate([scalars, used.y, used.y_m, state.law.e, state.law.integral_e, state.law.Pi])
