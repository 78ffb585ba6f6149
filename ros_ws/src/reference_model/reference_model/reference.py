# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Compute y_m sample by sample, without ROS.

The node and the simulation in a single process use it.
"""

import math
from enum import Enum

import numpy as np

from flight_core.failures import Failures, sentence
from flight_core.outcome import Refusal
from flight_core.rates import period_ns, seconds
from flight_core.vectors import FloatArray, is_finite, require_newer
from reference_model import live, model
from reference_model.command import command
from reference_model.live import Live
from reference_model.params import ReferenceModelConfig

LAST_REPEATED = "a step of the reference model failed, the last y_m is repeated"

BLOCK = 100  # number of steps for which the profile is evaluated at once


class Source(Enum):
    """Where the commands come from."""

    PROFILE = "profile"
    LIVE = "live commands"
    ENDING = "ending"  # u_m has timed out, so the commands go to zero


class Reference:
    """Equation (2) with the state x_m, which is known at whole periods.

    The commands come from the profile until the first live u_m.
    """

    def __init__(self, parameters: ReferenceModelConfig) -> None:
        self._model = parameters.model()
        self._profile = parameters.profile()
        self.period_ns = period_ns(parameters.rate, "rate")
        self._stepper = model.stepper(seconds(self.period_ns), self._model)
        self._x_m = np.zeros(len(self._model.A_m))  # the reference starts in trim
        self._number = 0
        self._u_m = self._block(0)
        self._begin = 0  # number of the first step in `_u_m`, the block of commands
        self._live_params = parameters.live_params()
        self._live: Live | None = None
        self._applied = np.zeros_like(self._u_m[0])  # u_m at the end of the last step
        self._failures = Failures()
        self._failure: Refusal | None = None

    def take(self, t_ns: int, u_m: FloatArray, attitude: FloatArray | None = None) -> None:
        """Take a live u_m, shape (m,), with the flight time t_ns. It acts from the next step on.

        `attitude` has the values of `channels.ATTITUDE`, or is None if they are not known. Raises
        ChannelError if u_m is old or out of bounds.
        """
        if self._live is not None:
            require_newer(t_ns, self._live.t_ns, "u_m")
        self._live = live.take(t_ns, u_m, attitude, self._live_params)

    @property
    def x_m(self) -> FloatArray:
        """State of the model at the last sample, shape (n,)."""
        return self._x_m

    def source(self) -> Source:
        """Return the source of the commands at the last sample."""
        if self._live is None:
            return Source.PROFILE
        aged = self._number * self.period_ns - self._live.t_ns > self._live_params.max_age_ns
        return Source.ENDING if aged else Source.LIVE

    def sample(self, number: int) -> FloatArray:
        """Compute y_m at sample `number`, shape (m,), in steps of a period.

        Between live commands, the attitude is dead-reckoned with the rates in y_m. If samples were
        skipped, the law has meanwhile tracked the last y_m before the gap, so the rates of this y_m
        hold for the whole gap. If a step raises an exception or gives a value that is not finite,
        the state stays and the last y_m is repeated.
        """
        tracked: FloatArray = model.output(self._x_m, self._model)
        while self._number < number:
            try:
                self._x_m, self._applied, self._live = self._stepped(tracked)
            except Exception as error:  # after any error, the next step is tried
                if self._failures.add(seconds(self._number * self.period_ns)):
                    self._failure = Refusal(f"{LAST_REPEATED}: {sentence(error)}")
            self._number += 1
        y_m: FloatArray = model.output(self._x_m, self._model)
        return y_m

    @property
    def failed(self) -> int:
        """Number of failed steps."""
        return self._failures.count

    def pop_failure(self) -> Refusal | None:
        """Return why steps have failed since the last report, or None if no step has failed."""
        failure, self._failure = self._failure, None
        return failure

    def _stepped(self, tracked: FloatArray) -> tuple[FloatArray, FloatArray, Live | None]:
        """Return x_m, the applied u_m and the live u_m a period later."""
        index = self._number % BLOCK
        if self._begin != self._number - index:
            self._u_m = self._block(self._number - index)
            self._begin = self._number - index
        after = self._live
        if self._live is None:
            u_m = self._u_m[2 * index : 2 * index + 3].ravel()
            applied = self._u_m[2 * index + 2]
        else:
            applied = self._live_u_m(self._live)
            u_m = np.concatenate([applied] * 3)
            after = live.dead_reckon(self._live, tracked, self.period_ns, self._live_params)
        with np.errstate(over="ignore", invalid="ignore"):
            x_m = model.step(self._x_m, u_m, self._stepper)
        attitude = () if after is None or after.attitude is None else after.attitude
        if not (is_finite(x_m) and is_finite(applied) and all(map(math.isfinite, attitude))):
            raise ArithmeticError("a value that is not finite")
        return x_m, applied, after

    def rate(self) -> FloatArray:
        """Compute the derivative of y_m at the last sample, (m,): C x_m_dot, equation (2)."""
        index = self._number % BLOCK
        u_m = self._block(self._number)[0] if index == 0 else self._u_m[2 * index]
        u_m = u_m if self._live is None else self._live_u_m(self._live)
        y_m_dot: FloatArray = model.output(
            model.x_m_dot(0.0, self._x_m, u_m, self._model), self._model
        )
        return y_m_dot

    def _live_u_m(self, state: Live) -> FloatArray:
        y_m = model.output(self._x_m, self._model)
        u_m = live.commands(self._number * self.period_ns, state, y_m, self._live_params)
        reach = self._live_params.reach
        applied: FloatArray = np.minimum(
            np.maximum(u_m, self._applied - reach), self._applied + reach
        )
        return applied

    def _block(self, number: int) -> FloatArray:
        """Compute the profile's commands at the starts, middles and ends of BLOCK steps.

        Computing a block at once is ten times faster than computing each step.
        """
        u_m: FloatArray = command(
            seconds(self.period_ns) * (number + np.arange(2 * BLOCK + 1) / 2.0), self._profile
        )
        return u_m
