# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""The reference model from sample to sample. Flown by the node and in process."""

import numpy as np

from flight_core.rates import period_ns, seconds
from flight_core.vectors import FloatArray
from reference_model import model
from reference_model.command import command
from reference_model.params import ReferenceModelParameters, zero_state

BLOCK = 100  # steps


class Reference:
    """Equation (2) with its memory x_m, at the instants k periods; commands are the profile's until `live` is set."""

    def __init__(self, parameters: ReferenceModelParameters) -> None:
        self._model, self._profile = parameters.model(), parameters.profile()
        self.period_ns = period_ns(parameters.rate, "rate")
        self._stepper = model.stepper(seconds(self.period_ns), self._model)
        self._x_m = zero_state(self._model)
        self._number = 0
        self._u_m = self._block(0)
        self.live: FloatArray | None = None  # (m,) commands in place of the profile's

    def sample(self, number: int) -> FloatArray:
        """y_m at sample `number`, shape (m,), moved there in steps of one period."""
        while self._number < number:
            place = self._number % BLOCK
            if place == 0:
                self._u_m = self._block(self._number)
            u_m = self._u_m[2 * place : 2 * place + 3].ravel() if self.live is None else np.tile(self.live, 3)
            self._x_m = model.step(self._x_m, u_m, self._stepper)
            self._number += 1
        y_m: FloatArray = model.output(self._x_m, self._model)
        return y_m

    def rate(self) -> FloatArray:
        """The derivative of y_m at the instant of the last sample, shape (m,): C x_m_dot, equation (2)."""
        place = self._number % BLOCK
        u_m = self._block(self._number)[0] if place == 0 else self._u_m[2 * place]
        u_m = u_m if self.live is None else self.live
        y_m_dot: FloatArray = model.output(model.x_m_dot(0.0, self._x_m, u_m, self._model), self._model)
        return y_m_dot

    def _block(self, number: int) -> FloatArray:
        """The profile's commands at the beginnings, middles and ends of BLOCK steps, in a tenth of the time of one by one."""
        u_m: FloatArray = command(seconds(self.period_ns) * (number + np.arange(2 * BLOCK + 1) / 2.0), self._profile)
        return u_m
