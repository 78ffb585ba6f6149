# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Compute the parameters of RISE-DI for many aircraft or many sets of gains."""

import numpy as np

from control_laws.nominal_model import NominalModel
from flight_core.vectors import FloatArray
from rise_di_controller.law.law import LawParams


def params_of(gains: dict[str, FloatArray], model: NominalModel) -> LawParams:
    """Return the parameters of RISE-DI for the gains of a search, in scaled inputs.

    The gains are K, Lambda, beta (m, N) and either softening, (m, N) or (1, N), or omega (1, N). If
    there is a softening, eps is the product of softening, beta / K and total_lag.
    """
    K = gains["K"]
    beta = gains["beta"]
    if "softening" in gains:
        eps = beta / K * gains["softening"] * model.total_lag[:, None]
    else:
        eps = np.ones_like(K)
    omega = gains.get("omega", 1.0) + 0.0 * K
    return LawParams(
        K=K,
        Lambda=gains["Lambda"],
        beta=beta,
        D=model.D[:, None],
        input_scale=model.input_scale[:, None],
        omega=omega,
        eps=eps,
        sign=None,
    )
