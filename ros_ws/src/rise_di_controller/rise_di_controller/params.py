# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Parameters of the controller, validated once, and the arrays that the law takes."""

from typing import Annotated, Literal, Self

import numpy as np
from pydantic import BeforeValidator, Field, model_validator

from flight_core.parameters import Names, Parameters, Positive, Positives, Signs, as_tuple, require, require_length
from flight_core.rates import nanoseconds, period_ns
from rise_di_controller.guard import GuardParams
from rise_di_controller.law import LawParams, Sign, gain


class ControllerParameters(Parameters):
    """All parameters of the controller's node."""

    rate: Annotated[float, Field(ge=1, le=1000)] = Field(description="the rate of the law, Hz")
    outputs: Names = Field(description="the channels of y in the order of the law; the last has the smallest gain (22)")
    inputs: Names = Field(description="the channels of u, paired with the outputs")
    k_g: Positive = Field(description="k_g of equation (22), 1/s")
    k_d: Annotated[tuple[Annotated[float, Field(gt=0)], ...], BeforeValidator(as_tuple)] = Field(
        description="k_d of equation (22), one a channel but the last, 1/s"
    )
    Lambda: Positives = Field(description="the diagonal of Lambda (4), 1/s")
    beta: Positives = Field(description="the diagonal of beta (21) in scaled inputs, units of y / s^2")
    D: Signs = Field(description="the diagonal of D (11), +1 or -1")
    input_scale: Positives = Field(description="how much u changes y_dot by one, diagonal: 1 / abs(Omega_ii)")
    omega: Positives = Field(description="abs(Omega_ii) in scaled inputs, over-estimated by 1.5 to 2 (implicit sign)")
    sign: Literal["literal", "implicit"] = Field(description="how the sign of (21) is sampled")
    max_age: Positive = Field(description="the age beyond which y or y_m is stale, s")

    @model_validator(mode="after")
    def _check(self) -> Self:
        period_ns(self.rate, "rate")
        require_length("inputs", self.inputs, self.outputs)
        require_length("k_d", self.k_d, self.outputs[:-1])
        for key in ("Lambda", "beta", "D", "input_scale", "omega"):
            require_length(key, getattr(self, key), self.outputs)
        for i, sign in enumerate(self.D):
            require(sign in (-1, 1), f"D[{i}]", sign, "+1 or -1")
        return self

    def law(self) -> LawParams:
        """The arrays of the law."""
        return LawParams(
            K=gain(np.array(self.k_g), np.array(self.k_d, dtype=np.float64)),
            Lambda=np.array(self.Lambda),
            beta=np.array(self.beta),
            D=np.array(self.D, dtype=np.float64),
            input_scale=np.array(self.input_scale),
            omega=np.array(self.omega),
            sign=Sign[self.sign.upper()],
        )

    def guard(self) -> GuardParams:
        """Period and age limit."""
        return GuardParams(period_ns(self.rate, "rate"), nanoseconds(self.max_age))
