# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Select gains of the law for a loop with an extended-state observer.

This observer models each output of the aircraft as an integrator of its input. Of the aircraft it
knows only the sign and the size of the integrator's gain.
"""

from collections.abc import Mapping

import numpy as np

from control_laws.observer_design import ExtendedStateWeights
from flight_core.vectors import FloatArray
from rise_di_controller.extensions.model_sections import FeedforwardConfig
from rise_di_controller.params import ControllerConfig

EXTENDED_STATE_PRODUCTS: Mapping[str, tuple[float, ...]] = {
    "q": (0.183, 0.0077, 0.665, 0.256),
    "p": (0.603, 0.0102, 1.02, 0.098),
    "r": (0.714, 0.0242, 0.098, 0.161),
    "V": (1.31, 0.0242, 0.184, 0.667),
}
"""effort / T, drift T, rate_drift T and decay T with the total lag T, by output. A search on the
`osprey` found them for T = 0.035 s, and 0.115 s in V, with the cost of gusts and turbulence
together; no other aircraft took part."""


# products for an output that is not in EXTENDED_STATE_PRODUCTS
DEFAULT_PRODUCTS = EXTENDED_STATE_PRODUCTS["p"]


def extended_state_weights(outputs: tuple[str, ...], T: FloatArray) -> ExtendedStateWeights:
    """Choose the weights of an extended-state observer by EXTENDED_STATE_PRODUCTS.

    T holds the total lags of the loop, (m,), s.
    """
    products = np.array([EXTENDED_STATE_PRODUCTS.get(name, DEFAULT_PRODUCTS) for name in outputs]).T
    return ExtendedStateWeights(products[0] * T, *(products[1:] / T))


def integrator_model(controller: ControllerConfig, Omega: FloatArray) -> FeedforwardConfig:
    """Build the model y_dot = Omega u of a feedforward, Omega (m, m) in the law's order.

    The feedforward leads by the lag, the delay and half a period.
    """
    return FeedforwardConfig(
        states=controller.outputs,
        A=(0.0,) * Omega.size,
        B=tuple(Omega.ravel().tolist()),
        lead=tuple(lag + controller.delay + 0.5 / controller.rate for lag in controller.lag),
    )
