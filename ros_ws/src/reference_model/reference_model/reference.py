# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""The reference model from sample to sample. Flown by the node and in process."""

import numpy as np

from flight_core.rates import NANOSECONDS, period_ns, seconds
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
            middle_ns = self._number * self.period_ns + self.period_ns / 2.0
            u_m = np.concatenate(
                (self._u_m, self._commands([middle_ns / NANOSECONDS, seconds((self._number + 1) * self.period_ns)]))
            )
            self._x_m = model.step(self._x_m, u_m, self._stepper)
            self._u_m = u_m[-len(self._u_m) :]
            self._number += 1
        y_m: FloatArray = model.output(self._x_m, self._model)
        return y_m

    def _commands(self, t: list[float]) -> FloatArray:
        u_m = command(np.array(t), self._profile) if self.live is None else np.tile(self.live, (len(t), 1))
        return np.ravel(u_m)
