# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Give a controller the feedforward of an airframe."""

from collections.abc import Sequence
from typing import TypeVar

import numpy as np

from aircraft_sim.airframes.airframe import Airframe
from flight_analysis.linear_loop.loop_margins import law_order
from flight_core.parameters import require
from flight_core.vectors import FloatArray
from rise_di_controller.extensions.model_sections import FeedforwardConfig
from rise_di_controller.params import ControllerConfig

Controller = TypeVar("Controller", bound=ControllerConfig)


def with_feedforward(controller: Controller, airframe: Airframe) -> Controller:
    """Return the same controller with the airframe as the nominal model of its feedforward.

    If the controller has a feedforward already, states of it that the airframe lacks stay in the
    model, for example the bank angle, which an airframe of body rates does without. The lead is
    lag + delay + half a period of the controller. Raises ParameterError if the airframe cannot be
    the model, for example because it has a zero in the right half plane.
    """
    for name in controller.outputs:
        require(
            name in airframe.states,
            "feedforward",
            f"the output {name}, a row of C",
            "outputs that are states of its model",
        )
    _, columns = law_order(airframe, controller)
    states = list(airframe.states)
    A, B = airframe.matrix_a(), airframe.matrix_b()[:, columns]
    gravity = airframe.matrix_gravity()
    former = controller.feedforward
    if former is not None and not set(former.states) <= set(states):
        states += [name for name in former.states if name not in states]
        A = _enlarged(A, former, states, former.A)
        gravity = _enlarged(gravity, former, states, former.gravity or (0.0,) * len(former.A))
        B = np.vstack([B, _rows(former, states[len(B) :], B.shape[1])])
    model = FeedforwardConfig(
        states=tuple(states),
        A=tuple(A.ravel().tolist()),
        B=tuple(B.ravel().tolist()),
        gravity=tuple(gravity.ravel().tolist()) if gravity.any() else None,
        lead=tuple(lag + controller.delay + 0.5 / controller.rate for lag in controller.lag),
    )
    return type(controller).validate_mapping(
        controller.model_dump() | {"feedforward": model.model_dump()}, "controller"
    )


def _enlarged(
    matrix: FloatArray, former: FeedforwardConfig, states: list[str], values: Sequence[float]
) -> FloatArray:
    """Return a matrix for all `states`, of which those of `matrix` are the first.

    The other entries are `values`, those of the former model, row by row. They are 0 where the
    former model lacks a state.
    """
    n = len(former.states)
    target = [number for number, name in enumerate(states) if name in former.states]
    source = [former.states.index(states[number]) for number in target]
    large = np.zeros((len(states), len(states)))
    large[np.ix_(target, target)] = np.reshape(values, (n, n))[np.ix_(source, source)]
    large[: len(matrix), : len(matrix)] = matrix
    return large


def _rows(former: FeedforwardConfig, states: list[str], m: int) -> FloatArray:
    """Return the rows of B of some states of the former model, (len(states), m)."""
    B = np.reshape(former.B, (len(former.states), m))
    return B[[former.states.index(name) for name in states]]
