# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Parameters of RISE-DI: validation, and conversion to the arrays of the law."""

from collections.abc import Sequence
from itertools import pairwise
from typing import Annotated, Literal

import numpy as np

from flight_core.fields import Field
from flight_core.parameters import Config, Positive, Positives, require, require_length
from rise_di_controller.control_law import ControlLaw, TunedLaw
from rise_di_controller.law import CONTROL_LAWS, LawParams, Sign, gain, total_lag
from rise_di_controller.params import ControllerConfig
from rise_di_controller.schedule import ScheduleParams, with_schedule

HISTORY = 5.0  # s, over which a new observer runs before it flies: its disturbances then hold what the law held


class ScheduleConfig(Config):
    """The schedule of input_scale over dynamic pressure, an extension of the paper."""

    speed: Positive = Field(description="the trim speed V0 at which input_scale holds, m/s: airspeed is speed + V of y")
    time: Positive = Field(default=1.0, description="time constant at which input_scale follows, s")

    def extended(self, law: TunedLaw, outputs: Sequence[str]) -> TunedLaw:
        """A law with the schedule."""
        airspeed = np.array([float(name == "V") for name in outputs])
        params = ScheduleParams(law.params, np.float64(self.speed), airspeed, np.float64(self.time))
        return TunedLaw(with_schedule(law.control_law), params)


class LearnConfig(Config):
    """Learning in the air, an extension of the paper: A and B are identified in flight, and the observer is designed again."""

    window: Annotated[float, Field(ge=6, le=600)] = Field(default=30.0, description="length of the record of y and u, s")
    updates: Positives = Field(
        default=(10.0, 15.0, 20.0, 30.0, 60.0),
        description="when the first identifications begin, from the first tick of the law, s; then one a window",
    )
    check: Annotated[float, Field(ge=1, le=600)] = Field(
        default=10.0, description="after the last of these times: how often it is tested whether the aircraft has changed, s"
    )
    prior: str | None = Field(
        default=None, description="the airframe file of the rough model, as `rise-di learn` writes it; none: the airframe's own"
    )
    latency: Annotated[float, Field(ge=0, le=60)] = Field(
        default=4.0,
        description="in lockstep and in one process: from the end of a window until the controller takes the model, s",
    )

    def spacing(self) -> float:
        """The shortest time between two identifications or tests, s."""
        times = (*self.updates, self.updates[-1] + self.check)
        return min(after - before for before, after in pairwise(times))


class RiseDiConfig(ControllerConfig):
    """The controller under RISE dynamic inversion, the paper's law."""

    k_g: Positive = Field(description="k_g of equation (22), 1/s")
    k_d: tuple[Positive, ...] = Field(description="k_d of equation (22), one per channel except the last, 1/s")
    Lambda: Positives = Field(description="the diagonal of Lambda (4), 1/s")
    beta: Positives = Field(description="the diagonal of beta (21) in scaled inputs, units of y / s^2")
    omega: Positives = Field(description="abs(Omega_ii) in scaled inputs, or an over-estimate (implicit sign)")
    sign: Literal["auto", "literal", "implicit", "soft"] = Field(
        description="how the sign of (21) is sampled; auto: implicit where lag and delay are below half a period, else soft"
    )
    softening: Positive | Positives = Field(
        description="width of the softened sign in total lags, one or one per channel; stable above 1, 3 is usual"
    )

    schedule: ScheduleConfig | None = Field(
        default=None, description="an extension of the paper: input_scale follows the dynamic pressure; off where absent"
    )

    learn: LearnConfig | None = Field(
        default=None, description="an extension of the paper: A and B are identified in flight; off where absent"
    )

    @classmethod
    def tunable(cls) -> frozenset[str]:
        """Also the models: a learner replaces them."""
        return (super().tunable() | {"input_scale", "feedforward", "observer"}) - {"learn"}

    def check_law(self) -> None:
        """A value per channel; k_d has no value for the last. A schedule needs V, and no model of the trim besides."""
        require_length("k_d", self.k_d, self.outputs[:-1])
        for key in ("Lambda", "beta", "omega"):
            require_length(key, getattr(self, key), self.outputs)
        if isinstance(self.softening, tuple):
            require_length("softening", self.softening, self.outputs)
        if self.schedule is not None:
            require("V" in self.outputs, "schedule", f"the outputs {', '.join(self.outputs)}", "V among them")
            alone = self.feedforward is None and self.observer is None
            require(alone, "schedule", "a feedforward or an observer beside it", "neither: their model holds at the trim speed")
        if self.learn is not None:
            require(self.observer is not None, "learn", "no observer", "one, with part 0 if it does not fly yet")
            require(
                self.allocation is None, "learn", "an allocation beside it", "none: A and B are those of the inputs of the law"
            )
            require(not self.vanes, "learn", "observer.vanes beside it", "none: a learner designs the observer of y alone")
            rising = list(self.learn.updates) == sorted(set(self.learn.updates))
            require(rising, "learn.updates", self.learn.updates, "rising times")
            spacing = self.learn.spacing()
            least = f"at most {spacing:g} s, the shortest time between two identifications"
            require(self.learn.latency <= spacing, "learn.latency", f"{self.learn.latency:g} s", least)

    def tuned_law(self) -> TunedLaw:
        """The law with parameters, extended by the observer or the schedule, if any."""
        law = super().tuned_law()
        return law if self.schedule is None else self.schedule.extended(law, self.outputs)

    def history_ticks(self) -> int:
        """HISTORY where the models are learned."""
        return 0 if self.learn is None else round(HISTORY * self.rate)

    def control_law(self) -> ControlLaw:
        """RISE-DI with the sampled sign."""
        return CONTROL_LAWS[self.sampled_sign()[0]]

    def law_params(self) -> LawParams:
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

    def summary(self) -> str:
        """How the sign is sampled, and the reason as a sentence; whether input_scale is scheduled."""
        return self.sampled_sign()[1] + ("" if self.schedule is None else "; input_scale follows the dynamic pressure")

    def sampled_sign(self) -> tuple[Sign, str]:
        """How the sign is sampled, and the reason as a sentence."""
        if self.sign != "auto":
            return Sign[self.sign.upper()], f"{self.sign} sign, as configured"
        lag, half = max(self.lag) + self.delay, 0.5 / self.rate
        if lag < half:
            return Sign.IMPLICIT, f"implicit sign, because lag and delay of {lag:g} s are below half a period ({half:g} s)"
        return Sign.SOFT, f"softened sign, because lag and delay of {lag:g} s reach half a period ({half:g} s)"
