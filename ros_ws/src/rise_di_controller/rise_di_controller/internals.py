# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Define the controller's log, which is a named vector at each tick.

The log and the parameters are enough to compute u again.
"""

from collections.abc import Mapping, Sequence
from enum import IntEnum

import numpy as np

from flight_core.vectors import FloatArray
from rise_di_controller.guard.guard import ControllerState, GuardParams, TickInputs
from rise_di_controller.law.control_law import ControlLaw, field_names, fields

SCALARS = ("mode", "dt", "y_m_offset", "late", "age", "number", "parameters")
OUTPUT_GROUPS = ("y", "y_m", "e")
INPUT_GROUPS = ("u_free", "u", "u_trim", "limited", "u_ff")
OBSERVER_GROUPS = ("z", "u_o", "sigma")
EFFECTOR = "effector"  # group of channels of an allocation
# groups of channels of the vanes of an observer
VANE_STATE = ("vane_mean", "vane_square", "vane_measures")
VANE_READING = ("vane", "vane_m")
GIVEN_UP = "given_up"  # group of channels of a controller that learns
RESERVED = frozenset(
    {
        *SCALARS,
        *OUTPUT_GROUPS,
        *INPUT_GROUPS,
        *OBSERVER_GROUPS,
        *VANE_STATE,
        *VANE_READING,
        EFFECTOR,
        GIVEN_UP,
    }
) - {"e"}
"""Names that the log reserves, so that no law can use them in its state. A law may have a
state e, which must be y - y_m."""


class Saturation(IntEnum):
    """The limit that saturates an input in a tick, published as a number in `internals`."""

    NO = 0
    MAGNITUDE = 1
    RATE = 2


def groups(
    law: ControlLaw,
    outputs: Sequence[str],
    inputs: Sequence[str],
    estimates: Sequence[str],
    effectors: Sequence[str] = (),
    vanes: Sequence[str] = (),
) -> dict[str, tuple[str, ...]]:
    """Group the channels of `internals` and list the names in each group, in the order of the log.

    Each output has y, y_m, e = y - y_m, and then the state of the law. For RISE-DI this state is
    e_0 (e at engagement), integral_e (units of y times s) and Pi (scaled input). Each input has u
    before (u_free) and after saturation (u), u_trim, limited (Saturation) and u_ff (feedforward).
    An observer adds its estimates z, u_o for each input, and sigma, the fade-in. Vanes add the mean
    of their readings, the mean square around the mean, `vane_measures` (1 while a vane is in use),
    `vane` (its reading), and `vane_m` (what it would read in the reference motion). An allocation
    adds the group effector with the commands of the effectors.
    """
    state_groups = [
        name for name in field_names(law) if name not in ("e", *OBSERVER_GROUPS, *VANE_STATE)
    ]
    grouped = {group: tuple(outputs) for group in (*OUTPUT_GROUPS, *state_groups)}
    grouped |= {group: tuple(inputs) for group in INPUT_GROUPS}
    if "z" in field_names(law):
        grouped |= {"z": tuple(estimates), "u_o": tuple(inputs), "sigma": ("observer",)}
    if vanes:
        grouped |= {group: tuple(vanes) for group in (*VANE_STATE, *VANE_READING)}
    return grouped | ({EFFECTOR: tuple(effectors)} if effectors else {})


def names(grouped: Mapping[str, Sequence[str]]) -> tuple[str, ...]:
    """List the channel names of `internals`, first the scalars and then "group.name".

    The scalars are mode (flight_core.modes.Mode), dt (s), y_m_offset (s), late (by how much
    the tick came after its deadline, s), age (age of y at the tick, s), number and parameters
    (ControllerConfig.digest). The channel `number` counts the samples from 1 since the start, so a
    gap shows a lost sample.
    """
    channels = list(SCALARS)
    for group, members in grouped.items():
        channels += [f"{group}.{name}" for name in members]
    return tuple(channels)


def values(
    state: ControllerState,
    inputs: TickInputs,
    guard: GuardParams,
    late: float,
    age: float,
    number: int,
    parameters: int,
    given_up: FloatArray,
) -> FloatArray:
    """Return the values of the topic `internals`, in the order of `names`.

    `given_up` is 1 for each output that gets no learned model, (m,), and is empty without a
    learner. An input that saturates is shown as limited by MAGNITUDE if u_free is outside of its
    limits, or if any effector of an allocation is at a stop. Raises ValueError if the law was never
    engaged.
    """
    if state.law is None:
        raise ValueError(
            "internals: found a controller that was never engaged, expected an engaged one"
        )
    scalars = np.array(
        [
            float(state.mode),
            inputs.dt,
            inputs.y_m_offset,
            late,
            age,
            float(number),
            float(parameters),
        ]
    )
    limits = guard.limits
    at_stop = False
    if guard.allocation is not None and state.effectors is not None:
        stops = guard.allocation.limits
        at_stop = bool(((state.effectors <= stops.lower) | (state.effectors >= stops.upper)).any())
    inside = (state.u_free >= limits.lower) & (state.u_free <= limits.upper) & (not at_stop)
    limited = np.where(
        state.u == state.u_free,
        Saturation.NO,
        np.where(inside, Saturation.RATE, Saturation.MAGNITUDE),
    )
    state_values = fields(state.law)
    state_values.pop("e", None)
    observer_values = [
        state_values.pop(group)
        for group in (*OBSERVER_GROUPS, *VANE_STATE)
        if group in state_values
    ]
    readings = () if state.vanes is None else state.vanes
    by_output = (inputs.y, inputs.y_m, inputs.y - inputs.y_m, *state_values.values())
    by_input = (state.u_free, state.u, state.u_trim, limited, state.u_ff)
    effectors = () if state.effectors is None else (state.effectors,)
    return np.concatenate(
        [scalars, *by_output, *by_input, *observer_values, *readings, *effectors, given_up]
    )
