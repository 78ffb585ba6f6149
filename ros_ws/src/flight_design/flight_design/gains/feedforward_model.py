# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Give a controller the feedforward of an airframe."""

from typing import TypeVar

import numpy as np

from aircraft_sim.airframes.airframe import Airframe
from flight_analysis.linear_loop.loop_margins import law_order
from flight_core.parameters import require
from rise_di_controller.extensions.model_sections import FeedforwardConfig
from rise_di_controller.params import ControllerConfig

Controller = TypeVar("Controller", bound=ControllerConfig)


def with_feedforward(controller: Controller, airframe: Airframe) -> Controller:
    """Return the controller with a feedforward whose nominal model is the airframe.

    The lead is lag + delay + half a period of the controller. Raises ParameterError if the airframe
    cannot be the model, for example because it has a zero in the right half plane.
    """
    for name in controller.outputs:
        require(
            name in airframe.states,
            "feedforward",
            f"the output {name}, a row of C",
            "outputs that are states of its model",
        )
    _, columns = law_order(airframe, controller)
    gravity = airframe.matrix_gravity()
    model = FeedforwardConfig(
        states=tuple(airframe.states),
        A=tuple(airframe.matrix_a().ravel().tolist()),
        B=tuple(airframe.matrix_b()[:, columns].ravel().tolist()),
        gravity=tuple(gravity.ravel().tolist()) if gravity.any() else None,
        lead=tuple(lag + controller.delay + 0.5 / controller.rate for lag in controller.lag),
    )
    return type(controller).validate_mapping(
        controller.model_dump() | {"feedforward": model.model_dump()}, "controller"
    )


def with_states_of(airframe: Airframe, model: FeedforwardConfig) -> Airframe:
    """Return the airframe with the further states that the model of a feedforward has.

    These states are angles such as the bank angle, which an airframe of body rates lacks. Their
    rows and columns of A come from the feedforward, and no input acts on them. Raises
    ParameterError if the feedforward has sine terms of gravity, which would be lost.
    """
    further = [name for name in model.states if name not in airframe.states]
    if not further:
        return airframe
    found, expected = f"gravity beside {', '.join(further)}", "an airframe with these states"
    require(model.gravity is None, "feedforward.gravity", found, expected)
    states = [*airframe.states, *further]
    n = len(airframe.states)
    shared = [name for name in states if name in model.states]
    here = [states.index(name) for name in shared]
    there = [model.states.index(name) for name in shared]
    of_model = np.reshape(model.A, (len(model.states), len(model.states)))
    A = np.zeros((len(states), len(states)))
    A[np.ix_(here, here)] = of_model[np.ix_(there, there)]
    A[:n, :n] = airframe.matrix_a()
    B = np.vstack([airframe.matrix_b(), np.zeros((len(further), len(airframe.inputs)))])
    return airframe.with_states(dict.fromkeys(further, "rad"), A, B)
