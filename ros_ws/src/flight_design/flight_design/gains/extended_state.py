# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Select gains of the law for a loop with an extended-state observer.

This observer models each output of the aircraft as the integral of its input times a gain. All that
the observer knows of the aircraft is the sign and the size of these gains.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from control_laws.observer_design import ExtendedStateWeights
from flight_core.vectors import FloatArray
from rise_di_controller.extensions.model_sections import FeedforwardConfig
from rise_di_controller.params import ControllerConfig


@dataclass(frozen=True, kw_only=True)
class WeightProducts:
    """The weights in `ExtendedStateWeights` of an output, made independent of the loop's lag.

    Each weight is multiplied or divided by the total lag T of the loop, s.
    """

    effort: float  # effort / T
    drift: float  # drift T
    rate_drift: float  # rate_drift T
    decay: float  # decay T


WEIGHT_PRODUCTS: Mapping[str, WeightProducts] = {
    "q": WeightProducts(effort=0.183, drift=0.0077, rate_drift=0.665, decay=0.256),
    "p": WeightProducts(effort=0.603, drift=0.0102, rate_drift=1.02, decay=0.098),
    "r": WeightProducts(effort=0.714, drift=0.0242, rate_drift=0.098, decay=0.161),
    "V": WeightProducts(effort=1.31, drift=0.0242, rate_drift=0.184, decay=0.667),
}
"""The products by output. A search on the `osprey` found them for T = 0.035 s, and 0.115 s in V,
with the cost of gusts and turbulence together. No other aircraft took part."""

OF_OTHERS = WEIGHT_PRODUCTS["p"]  # products of an output that is not in WEIGHT_PRODUCTS


def extended_state_weights(outputs: tuple[str, ...], T: FloatArray) -> ExtendedStateWeights:
    """Choose the weights of an extended-state observer by WEIGHT_PRODUCTS.

    T holds the total lags of the loop, (m,), s.
    """
    products = [WEIGHT_PRODUCTS.get(name, OF_OTHERS) for name in outputs]
    return ExtendedStateWeights(
        effort=np.array([of_output.effort for of_output in products]) * T,
        drift=np.array([of_output.drift for of_output in products]) / T,
        rate_drift=np.array([of_output.rate_drift for of_output in products]) / T,
        decay=np.array([of_output.decay for of_output in products]) / T,
    )


def integrator_model(controller: ControllerConfig, Omega: FloatArray) -> FeedforwardConfig:
    """Build the model y_dot = Omega u for a feedforward, with Omega (m, m) in the law's order.

    The lead of the feedforward is the sum of the lag, the delay and half a period.
    """
    return FeedforwardConfig(
        states=controller.outputs,
        A=(0.0,) * Omega.size,
        B=tuple(Omega.ravel().tolist()),
        lead=tuple(lag + controller.delay + 0.5 / controller.rate for lag in controller.lag),
    )
