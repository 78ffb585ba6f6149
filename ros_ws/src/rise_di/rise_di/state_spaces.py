# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Return the aircraft of a scenario and its whole loop as state spaces of python-control."""

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from flight_analysis.closed_loop.scenario import Scenario, as_scenario
from flight_analysis.linear_loop.loop_margins import scenario_loop
from flight_core.installation import require_package
from rise_di_controller.law.linear_loop import sampled_plant

if TYPE_CHECKING:
    import control


class LinearSystems(NamedTuple):
    """The parts of a scenario's linear loop, as discrete systems with the period of the law.

    Attributes:
        plant: The nominal aircraft from `u_NAME` to `y_NAME`, SI. It has the lags and the delay
            in the controller's parameters. It is the exact discretisation for a u that is held from
            tick to tick.
        law: The law near e = 0 at y_m = 0, from `y_NAME` to `u_NAME`.
        loop: The closed loop. Its inputs are `d_NAME`, a disturbance that is added to u, and
            `n_NAME`, a noise that is added to the measured y. Its outputs are y without the noise,
            `y_NAME`, and u of the law without the disturbance, `u_NAME`.
    """

    plant: "control.StateSpace"
    law: "control.StateSpace"
    loop: "control.StateSpace"


def linear_systems(scenario: Scenario) -> LinearSystems:
    """Return plant, law and closed loop of a scenario as linear systems of python-control.

    `margins` and `rise-di gains check` compute the margins of this loop. The systems are valid near
    y_m = 0 and while no limit acts. With an allocation, `u_NAME` are the channels of the law.

    Args:
        scenario: The aircraft and the controller.

    Returns:
        The three systems.

    Raises:
        ParameterError: python-control is missing, or `margins` would raise this error.

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
    # With vanes, the law has further measurements.
    measured = [*controller.outputs, *controller.vanes][: len(C)]
    y = [f"y_{name}" for name in measured]
    u = [f"u_{name}" for name in linear.inputs]
    n = [f"n_{name}" for name in measured]
    d = [f"d_{name}" for name in linear.inputs]
    dt = linear.loop.period
    no_feedthrough = np.zeros((len(y), len(u)))
    closed = (
        np.block([[A + B @ law.D @ C, B @ law.C], [law.B @ C, law.A]]),
        np.block([[B, B @ law.D], [np.zeros((len(law.A), len(d))), law.B]]),
        np.block([[C, np.zeros((len(y), len(law.A)))], [law.D @ C, law.C]]),
        np.block(
            [[no_feedthrough, np.zeros((len(y), len(n)))], [np.zeros((len(u), len(d))), law.D]]
        ),
    )
    return LinearSystems(
        plant=control.ss(A, B, C, no_feedthrough, dt, inputs=u, outputs=y, name="aircraft"),
        law=control.ss(*law, dt, inputs=y, outputs=u, name=controller.law),
        loop=control.ss(*closed, dt, inputs=[*d, *n], outputs=[*y, *u], name="loop"),
    )
