# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""RISE dynamic inversion over N aircraft: the controller's step with anti-windup and feedforward; with beta = 0 a PI."""

from typing import Any, NamedTuple

import numpy as np

from control_laws.nominal_model import NominalModel
from flight_core.vectors import Array, FloatArray
from rise_di_controller import law
from rise_di_controller.control_law import ControlLaw, Measurements
from rise_di_controller.guard import Limits, step_with_anti_windup
from rise_di_controller.law import LawParams, LawState, Sign
from rise_di_controller.params import ControllerParameters


class RiseParams(NamedTuple):
    """LawParams without the sign, which selects the control law, and the limits; each (m, 1), or (m, N)."""

    K: Array
    Lambda: Array
    beta: Array
    D: Array
    input_scale: Array
    omega: Array
    eps: Array
    limits: Limits


def params(controller: ControllerParameters) -> RiseParams:
    """Parameters of a controller, shape (m, 1)."""

    def column(values: Any) -> Any:
        return np.asarray(values)[:, None]

    named = controller.law()._asdict()
    limits = Limits(*(column(values) for values in controller.guard().limits))
    return RiseParams(limits=limits, **{key: column(named[key]) for key in RiseParams._fields[:-1]})


def of_gains(gains: dict[str, FloatArray], model: NominalModel) -> RiseParams:
    """Parameters from gains K, Lambda, beta (m, N) and softening or omega (1, N), the paper's in scaled inputs.

    eps = beta / K softening total_lag. Without beta, a PI controller: u = -input_scale D K (e - e_0 + Lambda integral_e).
    """
    K = gains["K"]
    beta = gains.get("beta", 0.0 * K)
    eps = beta / K * gains["softening"] * model.total_lag[:, None] if "softening" in gains else 1.0 + 0.0 * K
    omega = gains.get("omega", 1.0) + 0.0 * K
    return RiseParams(K, gains["Lambda"], beta, model.D[:, None], model.input_scale[:, None], omega, eps, model.limits)


def _control_law(sign: Sign) -> ControlLaw:
    def start(measured: Measurements, params: RiseParams) -> LawState:
        return law.engage(measured.y, measured.y_m)

    def step(state: LawState, measured: Measurements, dt: Array, params: RiseParams) -> tuple[LawState, Array]:
        of_law = LawParams(*params[:-1], sign)
        after, _, u = step_with_anti_windup(
            state, measured.y, measured.y_m, dt, measured.u_ff, measured.u_before, of_law, params.limits
        )
        return after, u

    return ControlLaw(start, step)


CONTROL_LAWS = {sign: _control_law(sign) for sign in Sign}
"""The law by the sampling of its sign: u = u_ff + what `step_with_anti_windup` commands inside the limits."""


def control_law(_: NominalModel, *, sign: Sign) -> ControlLaw:
    """The law of CONTROL_LAWS, which does not depend on the model."""
    return CONTROL_LAWS[sign]
