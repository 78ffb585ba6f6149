# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Parameters of the controller: validation, and conversion to the arrays of law, guard and feedforward."""

import json
from collections.abc import Sequence
from hashlib import blake2b
from typing import Annotated, Literal, Self

import numpy as np
from pydantic import BeforeValidator, Field, model_validator

from flight_core.parameters import (
    KeyedParameters,
    Names,
    NonNegatives,
    Numbers,
    ParameterError,
    Parameters,
    Positive,
    Positives,
    Signs,
    as_tuple,
    flatten,
    require,
    require_length,
)
from flight_core.rates import divide, nanoseconds, period_ns
from rise_di_controller.decomposition import DecompositionError, signs
from rise_di_controller.feedforward import ZERO_REAL_PART, Nominal, zero_dynamics
from rise_di_controller.guard import DT_RANGE, GuardParams, Limits
from rise_di_controller.law import LawParams, Sign, gain, total_lag

MAX_STABLE_STEP = 2.5
"""Largest product of dt and the fastest zero. A Runge-Kutta step is stable up to 2.78; dt is the longest that the law takes."""


class FeedforwardParameters(Parameters):
    """The nominal model of the feedforward, an extension of the paper. SI units, matrices row by row."""

    states: Names = Field(description="the states of the nominal model, the outputs among them")
    A: Numbers = Field(description="A, a row a state")
    B: Numbers = Field(description="B, a row a state, the columns in the order of controller.inputs")
    gravity: Numbers | None = Field(default=None, description="sine terms, x_dot += gravity sin(x), a row a state")
    lead: NonNegatives = Field(description="time from a tick until its input acts, s: half a period, delay and lag")

    def nominal(self, outputs: Sequence[str], inputs: Sequence[str], D: Sequence[int]) -> Nominal:
        """The arrays of the feedforward. Raises ParameterError for sizes that do not match and for a C B whose D differs."""
        n, m = len(self.states), len(outputs)
        for name in outputs:
            require(self.states.count(name) == 1, "feedforward.states", ", ".join(self.states), f"the output {name} once")
        for key, columns in (("A", n), ("B", m), ("gravity", n)):
            values = getattr(self, key)
            fits = values is None or len(values) == n * columns
            require(fits, f"feedforward.{key}", f"{len(values or ())} values", f"{n * columns}: {n} rows of {columns}")
        require_length("feedforward.lead", self.lead, inputs)
        A, B = np.reshape(self.A, (n, n)), np.reshape(self.B, (n, m))
        gravity = np.zeros((n, n)) if self.gravity is None else np.reshape(self.gravity, (n, n))
        C = np.array([[float(state == name) for state in self.states] for name in outputs])
        try:
            nominal_D = [int(sign) for sign in signs(C @ B)]
        except DecompositionError as error:
            raise ParameterError(f"feedforward.B: found a C B without a D ({error}), expected D = {list(D)}") from None
        require(nominal_D == list(D), "feedforward.B", f"a C B with D = {nominal_D}", f"D = {list(D)}, that of the controller")
        return Nominal(A, B, C, gravity, np.linalg.inv(C @ B), np.array(self.lead))


class ControllerParameters(KeyedParameters):
    """All parameters of the controller node."""

    rate: Annotated[float, Field(ge=1, le=1000)] = Field(description="the rate of the law, Hz")
    y_rate: Annotated[float, Field(ge=0, le=1000)] = Field(
        default=0.0, description="in lockstep: the rate of y, Hz; the node derives the time from the number of samples"
    )
    outputs: Names = Field(description="the channels of y in the order of the law; the last one has the smallest gain (22)")
    inputs: Names = Field(description="the channels of u, paired with the outputs")
    k_g: Positive = Field(description="k_g of equation (22), 1/s")
    k_d: Annotated[tuple[Annotated[float, Field(gt=0)], ...], BeforeValidator(as_tuple)] = Field(
        description="k_d of equation (22), one per channel except the last, 1/s"
    )
    Lambda: Positives = Field(description="the diagonal of Lambda (4), 1/s")
    beta: Positives = Field(description="the diagonal of beta (21) in scaled inputs, units of y / s^2")
    D: Signs = Field(description="the diagonal of D (11), +1 or -1")
    input_scale: Positives = Field(description="the change of u that changes y_dot by one, diagonal: 1 / abs(Omega_ii)")
    omega: Positives = Field(description="abs(Omega_ii) in scaled inputs, or an over-estimate (implicit sign)")
    sign: Literal["auto", "literal", "implicit", "soft"] = Field(
        description="how the sign of (21) is sampled; auto: implicit where lag and delay are below half a period, else soft"
    )
    lag: NonNegatives = Field(description="time constants of the actuators, s, one per channel; 0 for an actuator without lag")
    delay: Annotated[float, Field(ge=0)] = Field(description="pure delay from y to the actuators in addition to sampling, s")
    softening: Positive = Field(description="width of the softened sign in total lags; stable above 1, 3 is usual")
    max_age: Annotated[float, Field(gt=0, le=1e6)] = Field(description="the age above which y or y_m is stale, s")
    hold: Annotated[float, Field(ge=0, le=1e6)] = Field(description="failsafe: how long u is held when y or y_m is stale, s")
    ramp: Annotated[float, Field(ge=0, le=1e6)] = Field(description="failsafe: how long u then takes to ramp to trim, s")
    lower: Numbers | None = Field(default=None, description="lower limits of u from trim, units of u; none where absent")
    upper: Numbers | None = Field(default=None, description="upper limits of u from trim, units of u; none where absent")
    slew: Positives | None = Field(default=None, description="limits of abs(u_dot), units of u / s; none where absent")
    on_deactivate: Literal["trim", "hold"] = Field(default="trim", description="u after deactivation: ramped to trim or held")
    autostart: bool = Field(default=True, description="whether the node configures and activates itself at start")
    feedforward: FeedforwardParameters | None = Field(
        default=None, description="an extension of the paper: adds the input of a nominal model along y_m; off where absent"
    )

    @model_validator(mode="after")
    def _check(self) -> Self:
        period = period_ns(self.rate, "rate")
        if self.lockstep:
            require(self.y_rate > 0, "y_rate", "0 Hz", "the rate of y in lockstep")
            divide(period, period_ns(self.y_rate, "y_rate"), "y_rate", "1 / rate")
        require_length("inputs", self.inputs, self.outputs)
        require_length("k_d", self.k_d, self.outputs[:-1])
        for key in ("Lambda", "beta", "D", "input_scale", "omega", "lag"):
            require_length(key, getattr(self, key), self.outputs)
        for key in ("lower", "upper", "slew"):
            require_length(key, getattr(self, key) or self.inputs, self.inputs)
        for i, (low, high) in enumerate(zip(self.lower or (), self.upper or (), strict=False)):
            require(low < high, f"lower[{i}]", low, f"less than upper[{i}] = {high:g}")
        for i, low in enumerate(self.lower or ()):
            require(low <= 0, f"lower[{i}]", low, "at most 0, so that trim is inside the limits")
        for i, high in enumerate(self.upper or ()):
            require(high >= 0, f"upper[{i}]", high, "at least 0, so that trim is inside the limits")
        for i, sign in enumerate(self.D):
            require(sign in (-1, 1), f"D[{i}]", sign, "+1 or -1")
        nominal = self.nominal()
        if nominal is not None:
            self._check_nominal(nominal)
        return self

    def _check_nominal(self, nominal: Nominal) -> None:
        zeros = zero_dynamics(nominal)
        rightmost, fastest = float(np.max(zeros.real, initial=-np.inf)), float(np.max(np.abs(zeros), initial=0.0))
        stable = "none in the right half plane: u_ff would grow without bound"
        eigenvalue = f"zero dynamics with an eigenvalue at {rightmost:.3g} 1/s"
        require(rightmost <= ZERO_REAL_PART, "feedforward.A", eigenvalue, stable)
        limit = MAX_STABLE_STEP / DT_RANGE[1] * self.rate
        slow = f"at most {limit:.3g} 1/s, which ticks of {self.rate:g} Hz can follow"
        require(fastest <= limit, "feedforward.A", f"zero dynamics as fast as {fastest:.3g} 1/s", slow)

    def nominal(self) -> Nominal | None:
        """The arrays of the feedforward, None where there is none."""
        return None if self.feedforward is None else self.feedforward.nominal(self.outputs, self.inputs, self.D)

    def digest(self) -> int:
        """Hash of the parameters of the law and its guard, 0 to 2^48 - 1, exact as a float64.

        BLAKE2b of names and values. It changes with any bit of any gain. Parameters that concern only the node are left out.
        """
        content = self.model_dump(exclude={"lockstep", "y_rate", "autostart", "key_file"})
        return int.from_bytes(blake2b(json.dumps(sorted(flatten(content))).encode(), digest_size=6).digest(), "big")

    def law(self) -> LawParams:
        """The arrays of the law."""
        K = gain(np.array(self.k_g), np.array(self.k_d, dtype=np.float64))
        return LawParams(
            K=K,
            Lambda=np.array(self.Lambda),
            beta=np.array(self.beta),
            D=np.array(self.D, dtype=np.float64),
            input_scale=np.array(self.input_scale),
            omega=np.array(self.omega),
            eps=np.array(self.beta) / K * self.softening * total_lag(np.array(self.lag), self.delay, 1.0 / self.rate),
            sign=self.sampled_sign()[0],
        )

    def sampled_sign(self) -> tuple[Sign, str]:
        """How the sign is sampled, and the reason as a sentence."""
        if self.sign != "auto":
            return Sign[self.sign.upper()], f"{self.sign} sign, as configured"
        lag, half = max(self.lag) + self.delay, 0.5 / self.rate
        if lag < half:
            return Sign.IMPLICIT, f"implicit sign, because lag and delay of {lag:g} s are below half a period ({half:g} s)"
        return Sign.SOFT, f"softened sign, because lag and delay of {lag:g} s reach half a period ({half:g} s)"

    def guard(self) -> GuardParams:
        """Times, limits and nominal model of the guard."""
        unlimited = (np.inf,) * len(self.inputs)
        return GuardParams(
            period_ns=period_ns(self.rate, "rate"),
            max_age_ns=nanoseconds(self.max_age),
            hold_ns=nanoseconds(self.hold),
            ramp_ns=nanoseconds(self.ramp),
            deactivation_holds=self.on_deactivate == "hold",
            limits=Limits(
                -np.array(unlimited) if self.lower is None else np.array(self.lower),
                np.array(self.upper or unlimited),
                np.array(self.slew or unlimited),
            ),
            nominal=self.nominal(),
        )
