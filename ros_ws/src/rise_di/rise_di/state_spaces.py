# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""The aircraft of a scenario and its whole loop as state spaces of python-control."""

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from flight_analysis.closed_loop.scenario import Scenario, as_scenario
from flight_analysis.linear_loop.loop_margins import scenario_loop
from flight_core.installation import require_package
from rise_di_controller.law.linear_loop import sampled_plant

if TYPE_CHECKING:
    import control


class LinearSystems(NamedTuple):
    """The linear loop of a scenario in parts, as discrete systems with the period of the law.

    Attributes:
        plant: `u_NAME` -> `y_NAME`, SI: the nominal aircraft with the lags and the delay of the
            controller, exact between the ticks.
        law: `y_NAME` -> `u_NAME`: the law near e = 0, at y_m = 0.
        loop: `d_NAME`, added to u, and `n_NAME`, added to the measured y, -> `y_NAME` and
            `u_NAME`, the u of the law. From n_q to u_elevator it is the law in the loop.
    """

    plant: "control.StateSpace"
    law: "control.StateSpace"
    loop: "control.StateSpace"


def linear_systems(scenario: Scenario) -> LinearSystems:
    """Return the linear loop of a scenario for python-control: plant, law, and both closed.

    The margins of `margins` and of `rise-di gains check` are those of this loop, at y_m = 0 and
    inside all limits. With an allocation, `u_NAME` are the channels of the law.

    Args:
        scenario: The aircraft and the controller.

    Returns:
        The three systems.

    Raises:
        ParameterError: python-control is missing, or as in `margins`.

    Examples:
        >>> systems = rise_di.linear_systems(rise_di.find_scenario("osprey_servo"))
        >>> bool(abs(systems.loop.poles()).max() < 1.0 + 1e-6)
        True
    """
    require_package("control")
    import control  # noqa: PLC0415 - an extra

    flight = as_scenario(scenario)
    controller = flight.controller
    linear = scenario_loop(flight, controller)
    A, B, C = sampled_plant(linear.nominal, linear.loop, np.zeros(len(linear.inputs)))
    law = linear.law
    # With vanes, the law has more measurements.
    measured = [*controller.outputs, *controller.vanes][: len(C)]
    y = [f"y_{name}" for name in measured]
    u = [f"u_{name}" for name in linear.inputs]
    n = [f"n_{name}" for name in measured]
    d = [f"d_{name}" for name in linear.inputs]
    dt = linear.loop.period
    none = np.zeros((len(y), len(u)))
    closed = (
        np.block([[A + B @ law.D @ C, B @ law.C], [law.B @ C, law.A]]),
        np.block([[B, B @ law.D], [np.zeros((len(law.A), len(d))), law.B]]),
        np.block([[C, np.zeros((len(y), len(law.A)))], [law.D @ C, law.C]]),
        np.block([[none, np.zeros((len(y), len(n)))], [np.zeros((len(u), len(d))), law.D]]),
    )
    return LinearSystems(
        plant=control.ss(A, B, C, none, dt, inputs=u, outputs=y, name="aircraft"),
        law=control.ss(*law, dt, inputs=y, outputs=u, name=controller.law),
        loop=control.ss(*closed, dt, inputs=[*d, *n], outputs=[*y, *u], name="loop"),
    )
