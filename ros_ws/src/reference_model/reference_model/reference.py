# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""The reference model from sample to sample. Flown by the node and in process."""

import numpy as np

from flight_core.rates import period_ns, seconds
from flight_core.vectors import FloatArray
from reference_model import model
from reference_model.command import command
from reference_model.params import ReferenceModelParameters, zero_state


class Reference:
    """Equation (2) with its memory x_m, at the instants k periods; commands are the profile's until `live` is set."""

    def __init__(self, parameters: ReferenceModelParameters) -> None:
        self._model, self._profile = parameters.model(), parameters.profile()
        self.period_ns = period_ns(parameters.rate, "rate")
        self._stepper = model.stepper(seconds(self.period_ns), self._model)
        self._x_m = zero_state(self._model)
        self._number = 0
        self._u_m = command(0.0, self._profile)  # at the instant of `number`
        self.live: FloatArray | None = None  # (m,) commands in place of the profile's

    def sample(self, number: int) -> FloatArray:
        """y_m at sample `number`, shape (m,), moved there in steps of one period."""
        while self._number < number:
            half_ns = self.period_ns * (2 * self._number + 1)
            middle, end = self._command(seconds(half_ns) / 2.0), self._command(seconds(half_ns + self.period_ns) / 2.0)
            self._x_m = model.step(self._x_m, np.concatenate((self._u_m, middle, end)), self._stepper)
            self._u_m = end
            self._number += 1
        y_m: FloatArray = model.output(self._x_m, self._model)
        return y_m

    def _command(self, t: float) -> FloatArray:
        return command(t, self._profile) if self.live is None else self.live
