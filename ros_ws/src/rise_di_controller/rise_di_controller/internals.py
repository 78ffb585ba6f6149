# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""The controller's log: one named vector a tick. With the parameters it is enough to recompute u."""

from collections.abc import Sequence
from enum import IntEnum

import numpy as np

from flight_core.vectors import FloatArray
from rise_di_controller.guard import ControllerState, Limits, TickInputs

SCALARS = ("mode", "dt", "y_m_offset", "late", "age", "number", "parameters")
OUTPUT_GROUPS = ("y", "y_m", "e", "e_0", "integral_e", "Pi")
INPUT_GROUPS = ("u_free", "u", "u_trim", "limited", "u_ff")


class Saturation(IntEnum):
    """Which limit saturated an input in a tick; published as a number in `internals`."""

    NO = 0
    MAGNITUDE = 1
    RATE = 2


def names(outputs: Sequence[str], inputs: Sequence[str]) -> tuple[str, ...]:
    """Channel names of `internals`: the scalars, then "group.output" and "group.input".

    Scalars: mode (guard.Mode), dt (s), y_m_offset (s), late (s, delay of the tick after its deadline), age (s, of y at the
    tick), number (counts the samples from 1 since the start: a gap is a lost sample), parameters (ControllerParameters.digest).
    By output: y, y_m, e = y - y_m, e_0 (e at engagement), integral_e (units of y times s), Pi (scaled input).
    By input: u before (u_free) and after saturation (u), u_trim, limited (Saturation), u_ff (feedforward).
    """
    by_output = (f"{group}.{name}" for group in OUTPUT_GROUPS for name in outputs)
    by_input = (f"{group}.{name}" for group in INPUT_GROUPS for name in inputs)
    return (*SCALARS, *by_output, *by_input)


def values(
    state: ControllerState, inputs: TickInputs, limits: Limits, late: float, age: float, number: int, parameters: int
) -> FloatArray:
    """Values of `internals` in the order of `names`. Raises ValueError for a state that was never engaged."""
    if state.law is None:
        raise ValueError("internals: found a controller that was never engaged, expected an engaged one")
    scalars = np.array([float(state.mode), inputs.dt, inputs.y_m_offset, late, age, float(number), float(parameters)])
    inside = (state.u_free >= limits.lower) & (state.u_free <= limits.upper)
    limited = np.where(state.u == state.u_free, Saturation.NO, np.where(inside, Saturation.RATE, Saturation.MAGNITUDE))
    by_output = (inputs.y, inputs.y_m, state.law.e, state.law.e_0, state.law.integral_e, state.law.Pi)
    return np.concatenate([scalars, *by_output, state.u_free, state.u, state.u_trim, limited, state.u_ff])
