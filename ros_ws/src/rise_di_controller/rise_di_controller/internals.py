# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""The controller's log: one named vector a tick, enough to recompute u without anything else but the parameters."""

from collections.abc import Sequence
from enum import IntEnum

import numpy as np

from flight_core.vectors import FloatArray
from rise_di_controller.guard import ControllerState, Limits, TickInputs

SCALARS = ("mode", "dt", "y_m_offset", "late", "age", "number", "parameters")
OUTPUT_GROUPS = ("y", "y_m", "e", "e_0", "integral_e", "Pi")
INPUT_GROUPS = ("u_free", "u", "u_trim", "limited", "u_ff")


class Limited(IntEnum):
    """What held an input back in a tick; published as a number in `internals`."""

    NO = 0
    MAGNITUDE = 1
    RATE = 2


def names(outputs: Sequence[str], inputs: Sequence[str]) -> tuple[str, ...]:
    """Channel names of `internals`: the scalars, then "group.output" and "group.input".

    mode (guard.Mode), dt (s), y_m_offset (s), late (s, the tick after its deadline), age (s, of y at the tick), number (of
    this sample since the controller's start, from 1: a gap is a loss), parameters (ControllerParameters.digest); y and y_m as
    used, e = y - y_m, e_0 (e at engagement), integral_e (units s), Pi (scaled input); u before (u_free) and after limits,
    u_trim, limited (Limited), u_ff (what the feedforward adds to u_trim + the law's u).
    """
    by_output = (f"{group}.{name}" for group in OUTPUT_GROUPS for name in outputs)
    by_input = (f"{group}.{name}" for group in INPUT_GROUPS for name in inputs)
    return (*SCALARS, *by_output, *by_input)


def values(
    state: ControllerState, used: TickInputs, limits: Limits, late: float, age: float, number: int, parameters: int
) -> FloatArray:
    """Values of `internals` in the order of `names`. Raises ValueError for a state that was never engaged."""
    if state.law is None:
        raise ValueError("internals of a controller that was never engaged")
    scalars = np.array([float(state.mode), used.dt, used.y_m_offset, late, age, float(number), float(parameters)])
    inside = (state.u_free >= limits.lower) & (state.u_free <= limits.upper)
    limited = np.where(state.u == state.u_free, Limited.NO, np.where(inside, Limited.RATE, Limited.MAGNITUDE))
    by_output = (used.y, used.y_m, state.law.e, state.law.e_0, state.law.integral_e, state.law.Pi)
    return np.concatenate([scalars, *by_output, state.u_free, state.u, state.u_trim, limited, state.u_ff])
