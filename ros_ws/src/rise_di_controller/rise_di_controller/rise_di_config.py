# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Validate the parameters of RISE-DI, and convert them to the arrays of the law."""

from collections.abc import Callable, Iterator, Mapping
from functools import partial
from itertools import pairwise
from typing import Annotated, Any, Literal, Self

import numpy as np

from flight_core.fields import Field, Problems
from flight_core.parameters import (
    Config,
    Numbers,
    ParameterError,
    Positive,
    Positives,
    require,
    require_length,
)
from flight_core.vectors import FloatArray
from rise_di_controller import internals
from rise_di_controller.extensions.feedforward import Nominal
from rise_di_controller.extensions.schedule import (
    OverSpeed,
    ScheduleParams,
    nominal_of,
    nominal_side_by_side,
    observer_of,
    over_speed,
    side_by_side,
    with_schedule,
)
from rise_di_controller.guard.guard import GuardParams
from rise_di_controller.law.control_law import ControlLaw, TunedLaw
from rise_di_controller.law.law import CONTROL_LAWS, LawParams, Sign, gain, total_lag
from rise_di_controller.params import ControllerConfig

# Length, s, of the recorded ticks on which a new observer is run before it is used. Then its
# estimates of the disturbances replace what the law has integrated.
HISTORY = 5.0


class SpeedConfig(Config):
    """The models of feedforward and observer at another airspeed.

    Values are in SI units. Matrices are row by row, as in the sections feedforward and observer.
    """

    ratio: Positive = Field(description="this airspeed divided by the trim speed")
    A: Numbers = Field(description="A of the feedforward")
    B: Numbers = Field(description="B of the feedforward")
    gravity: Numbers | None = Field(default=None, description="gravity of the feedforward")
    Phi: Numbers = Field(description="Phi of the observer")
    Gamma: Numbers = Field(description="Gamma of the observer")
    L: Numbers = Field(description="L of the observer")
    F: Numbers = Field(description="F of the observer")


class ScheduleConfig(Config):
    """The schedule of input_scale over dynamic pressure, an extension of the paper."""

    speed: Positive = Field(description="trim speed V0, at which input_scale holds, m/s")
    time: Positive = Field(
        default=1.0, description="time constant of the filter of dynamic pressure, s"
    )
    slow: SpeedConfig | None = Field(
        default=None,
        description="models at a speed below the trim speed, if there is an observer; between the "
        "speeds they are interpolated",
    )
    fast: SpeedConfig | None = Field(
        default=None, description="models at a speed above the trim speed, if there is an observer"
    )

    @property
    def models(self) -> tuple[SpeedConfig, ...]:
        """The models at two other speeds, or none."""
        return () if self.slow is None or self.fast is None else (self.slow, self.fast)


class PriorConfig(Config):
    """The rough model with which learning begins."""

    file: str | None = Field(
        default=None,
        description="airframe file of the model, such as `rise-di learn` writes; none: the file of "
        "the aircraft",
    )
    off: Annotated[float, Field(ge=0.05, le=1.0)] | None = Field(
        default=None,
        description="relative standard deviation of the entries; a value above 0.29 is the "
        "standard deviation of their logarithms; none: 0.29, which is the one of a uniform "
        "distribution within +-50 %",
    )
    sketch: bool = Field(
        default=False,
        description="whether the rough model is the one in the feedforward and not the airframe "
        "file; for an aircraft of JSBSim, a rule makes this model",
    )


# largest delay margin, s, that is required of a learned model if `learn.margin` is not set: two
# periods at 100 Hz
DEFAULT_MARGIN = 0.02


class LearnConfig(Config):
    """Learning in the air, an extension of the paper.

    A and B are identified in flight, and the observer is designed again from them.
    """

    window: Annotated[float, Field(ge=6, le=600)] = Field(
        default=30.0, description="length of the record of y and u, s"
    )
    updates: Positives = Field(
        default=(10.0, 15.0, 20.0, 30.0, 60.0),
        description="when identifications begin, s from the first tick; then once per window",
    )
    check: Annotated[float, Field(ge=1, le=600)] = Field(
        default=2.0, description="period of the test for a changed aircraft, s"
    )
    prior: PriorConfig | None = Field(default=None, description="the rough model")
    margin: Annotated[float, Field(ge=0, le=0.5)] | None = Field(
        default=None,
        description="least delay margin of a learned model, s; none: the margin of the loop at the "
        "start, but at most 0.02 s",
    )
    without: tuple[str, ...] | None = Field(
        default=None,
        description="outputs that never get a learned model",
    )
    latency: Annotated[float, Field(ge=0, le=60)] = Field(
        default=4.0,
        description="in lockstep, time from the end of a window to its model, s",
    )

    def least_margin(self, margin: float) -> float:
        """Return the delay margin that a learned model must have, s.

        This is `learn.margin` if it is set. Otherwise it is the smaller of DEFAULT_MARGIN and
        `margin`, the delay margin of the loop at the start. More is not required, because the loop
        at the start has `margin` only around the model in the scenario, and perhaps not around the
        real aircraft.
        """
        return min(margin, DEFAULT_MARGIN) if self.margin is None else self.margin

    def spacing(self) -> float:
        """Return the shortest time between two of `updates`, s; `window` if there is only one."""
        return min(
            (after - before for before, after in pairwise(self.updates)), default=self.window
        )


class RiseDiConfig(ControllerConfig):
    """The parameters of a controller that flies by RISE dynamic inversion, the paper's law.

    Args:
        values: Values by name of the parameter.

    Raises:
        ParameterError: A value or a relation between values is invalid.

    Examples:
        >>> rise_di.find_scenario("osprey_servo").rise_di().law_params().K.shape
        (4,)
    """

    k_g: Positive = Field(description="k_g of equation (22), 1/s")
    k_d: tuple[Positive, ...] = Field(
        description="k_d of equation (22), one per channel except the last, 1/s"
    )
    Lambda: Positives = Field(description="the diagonal of Lambda (4), 1/s")
    beta: Positives = Field(
        description="the diagonal of beta (21) in scaled inputs, units of y / s^2"
    )
    # omega is 1 if input_scale is 1 / abs(Omega_ii). If omega is left out, `read` sets it to 1.
    omega: Positives = Field(
        default=(),
        description="abs(Omega_ii) in scaled inputs, or an over-estimate (implicit sign); by "
        "default 1 for each output",
    )
    # The lag decides whether the implicit or the soft sign is stable.
    sign: Literal["auto", "literal", "implicit", "soft"] = Field(
        default="auto", description="how the sign of (21) is sampled; auto: implicit or soft"
    )
    # At a width of one total lag, the loop of the sign and the lags is at the limit of stability.
    softening: Positive | Positives = Field(
        default=3.0,
        description="width of the softened sign in total lags; stable above 1, 3 is usual",
    )

    schedule: ScheduleConfig | None = Field(
        default=None, description="extension: input_scale follows the dynamic pressure"
    )

    learn: LearnConfig | None = Field(
        default=None, description="extension: A and B are identified in flight"
    )

    @classmethod
    def read(
        cls, values: Mapping[Any, Any], key: str, problems: Problems, *, check: bool = True
    ) -> Self | None:
        """Read the parameters. An omega that is left out is 1 for each output.

        Args:
            values: The nested mapping.
            key: Name of the set in errors.
            problems: Takes a sentence for each value that is not permitted.
            check: Whether relations between the values are checked.

        Returns:
            The set, or None with a sentence in `problems`.
        """
        outputs = values.get("outputs")
        if "omega" not in values and isinstance(outputs, (list, tuple)):
            values = {**values, "omega": [1.0] * len(outputs)}
        return super().read(values, key, problems, check=check)

    @classmethod
    def tunable(cls) -> frozenset[str]:
        """Return the names of the parameters that may change in flight.

        They are the tunable parameters of every law, and input_scale, but not `learn`.
        """
        return (super().tunable() | {"input_scale"}) - {"learn"}

    @classmethod
    def changed_by_node(cls) -> frozenset[str]:
        """Return the names of the parameters that hold a model.

        In flight only proposals of a learner may change them. A change by an operator would bypass
        the certification.
        """
        return frozenset({"feedforward", "observer"})

    def check_law(self) -> None:
        """Check that each key has one value for each channel.

        k_d has no value for the last channel. A schedule needs the output V, and a learner needs an
        observer without vanes.
        """
        require_length("k_d", self.k_d, self.outputs[:-1])
        for key in ("Lambda", "beta", "omega"):
            require_length(key, getattr(self, key), self.outputs)
        if isinstance(self.softening, tuple):
            require_length("softening", self.softening, self.outputs)
        if self.schedule is not None:
            self._check_schedule(self.schedule)
        if self.learn is not None:
            require(
                self.observer is not None,
                "learn",
                "no observer",
                "an observer, whose `part` is 0 if its estimates are not used yet",
            )
            require(
                not self.vanes,
                "learn",
                "observer.vanes beside it",
                "none: a learner designs the observer of y alone",
            )
            rising = list(self.learn.updates) == sorted(set(self.learn.updates))
            require(rising, "learn.updates", self.learn.updates, "rising times")
            are_outputs = set(self.learn.without or ()) <= set(self.outputs)
            require(
                are_outputs,
                "learn.without",
                self.learn.without,
                f"outputs among {', '.join(self.outputs)}",
            )
            spacing = self.learn.spacing()
            least = f"at most {spacing:g} s, the shortest time between two of learn.updates"
            require(
                self.learn.latency <= spacing, "learn.latency", f"{self.learn.latency:g} s", least
            )

    def _check_schedule(self, schedule: ScheduleConfig) -> None:
        """Check that the outputs suit a schedule, and that the schedule has models at two speeds.

        The outputs must be V and at least one other. A controller with a feedforward or an observer
        needs a model below the trim speed and one above the trim speed.
        """
        followed = "V" in self.outputs and len(self.outputs) > 1
        require(
            followed,
            "schedule",
            f"the outputs {', '.join(self.outputs)}",
            "V and at least one other output",
        )
        if self.feedforward is None and self.observer is None:
            require(
                schedule.slow is None and schedule.fast is None,
                "schedule",
                "models at other speeds",
                "none without an observer",
            )
            return
        both = self.observer is not None and len(schedule.models) == len(("slow", "fast"))
        expected = (
            "an observer with slow and fast, as rise-di gains select --observer "
            "--speeds LOW,HIGH writes them"
        )
        require(
            both,
            "schedule",
            "a feedforward or an observer that holds at the trim speed alone",
            expected,
        )
        slow, fast = (model.ratio for model in schedule.models)
        require(
            slow < 1.0 < fast,
            "schedule",
            f"ratios of {slow:g} and {fast:g}",
            "one below 1 and one above",
        )
        require(
            not self.vanes,
            "observer.vanes",
            "a schedule beside them",
            "none: they read the model of the trim speed",
        )

    def checks(self) -> Iterator[None]:
        """Check the controller, at five speeds if it has models at other speeds.

        The five speeds are the trim speed, the two other speeds, and the two halfway to them.
        """
        if self.schedule is None or not self.schedule.models:
            yield from super().checks()
            return
        yield from self.model_copy(update={"schedule": None}).checks()
        self.check_law()
        for name, model in zip(("slow", "fast"), self.schedule.models, strict=True):
            yield
            try:
                self._with_models(model).tuned_law()
            except ParameterError as error:  # its key is feedforward.KEY or observer.KEY
                raise ParameterError(f"schedule.{name}.{str(error).partition('.')[2]}") from None
        yield
        observer = self.tuned_law().params.observer
        yield
        feedforward = self._nominal_over_speed(self.known_nominal())
        slow, fast = (model.ratio for model in self.schedule.models)
        for ratio in (slow, (1.0 + slow) / 2.0, (1.0 + fast) / 2.0, fast):
            yield
            try:
                yield from self._at_speed(ratio, feedforward, observer).checks()
            except ParameterError as error:
                raise ParameterError(
                    f"schedule, at {ratio:.3g} of the trim speed: {error}"
                ) from None

    def at_speed(self, ratio: float) -> Self:
        """Return parameters for steady flight at a fraction of the trim speed.

        They have the models of that speed and no schedule.

        Args:
            ratio: Airspeed as a fraction of the trim speed.

        Returns:
            A copy with the models at that speed.
        """
        return self._at_speed(
            ratio, self._nominal_over_speed(self.known_nominal()), self.tuned_law().params.observer
        )

    def _at_speed(self, ratio: float, feedforward: OverSpeed, observer: OverSpeed) -> Self:
        airspeed = self._is_airspeed()
        scale = airspeed + (1.0 - airspeed) / ratio**2
        sections: dict[str, Any] = {}
        for key, matrices, names in (
            ("feedforward", feedforward.at_scale(scale), ("A", "B", "gravity")),
            ("observer", observer.at_scale(scale), ("Phi", "Gamma", "L", "F")),
        ):
            values = {name: tuple(getattr(matrices, name).ravel().tolist()) for name in names}
            sections[key] = getattr(self, key).model_copy(update=values)
        input_scale = tuple((np.array(self.input_scale) * scale).tolist())
        return self.model_copy(update=sections | {"input_scale": input_scale, "schedule": None})

    def _with_models(self, models: SpeedConfig) -> Self:
        """Return the parameters with `models` in place of the models of the trim speed.

        The result has no schedule.
        """
        sections: dict[str, Any] = {"schedule": None}
        for key, names in (
            ("feedforward", ("A", "B", "gravity")),
            ("observer", ("Phi", "Gamma", "L", "F")),
        ):
            sections[key] = getattr(self, key).model_copy(
                update={name: getattr(models, name) for name in names}
            )
        return self.model_copy(update=sections)

    def _is_airspeed(self) -> FloatArray:
        """Return 1 for the output V, and 0 for each other output, (m,)."""
        return np.array([float(name == "V") for name in self.outputs])

    def _over_speed(
        self,
        matrices: Callable[["RiseDiConfig", FloatArray], FloatArray],
        model: Callable[[FloatArray, FloatArray], Any],
    ) -> OverSpeed:
        """Interpolate a model from its matrices at the trim speed and the scheduled speeds."""
        assert self.schedule is not None  # noqa: S101 - for the type checker
        is_airspeed, (slow, fast) = self._is_airspeed(), self.schedule.models
        at_trim = matrices(self.model_copy(update={"schedule": None}), np.ones(len(self.outputs)))
        at_slow = matrices(
            self._with_models(slow), is_airspeed + (1.0 - is_airspeed) / slow.ratio**2
        )
        at_fast = matrices(
            self._with_models(fast), is_airspeed + (1.0 - is_airspeed) / fast.ratio**2
        )
        return over_speed((slow.ratio, fast.ratio), (at_trim, at_slow, at_fast), is_airspeed, model)

    def _nominal_over_speed(self, at_trim: Nominal) -> OverSpeed:
        """Return the nominal model of the feedforward as a function of the airspeed.

        Its leads, and the inputs in which it acts, are taken from the model at the trim speed.
        """

        def matrices(config: RiseDiConfig, scale: FloatArray) -> FloatArray:
            return nominal_side_by_side(config.known_nominal(), scale)

        return self._over_speed(matrices, partial(nominal_of, at_trim))

    def models(self) -> tuple[Any, ...]:
        """Return the models of the base class and, as one more element, those at other speeds."""
        return (*super().models(), () if self.schedule is None else self.schedule.models)

    def guard(self) -> GuardParams:
        """Return the parameters of the guard.

        With a schedule, they also have the model of the feedforward as a function of the airspeed.
        """
        guard = super().guard()
        if guard.nominal is None or self.schedule is None or not self.schedule.models:
            return guard
        return guard._replace(over_speed=self._nominal_over_speed(guard.nominal))

    def known_nominal(self) -> Nominal:
        """Return the nominal model of the feedforward of a controller that surely has one."""
        nominal = self.nominal()
        assert nominal is not None  # noqa: S101 - an observer needs a feedforward
        return nominal

    def tuned_law(self) -> TunedLaw:
        """Return the law with its parameters, extended by the observer and the schedule, if any."""
        law = super().tuned_law()
        if self.schedule is None:
            return law
        over = None
        if self.schedule.models:
            over = self._over_speed(
                lambda config, scale: side_by_side(config.tuned_law().params, scale),
                partial(observer_of, law.params),
            )
        speed = np.float64(self.schedule.speed)
        time = np.float64(self.schedule.time)
        return TunedLaw(
            with_schedule(law.control_law),
            ScheduleParams(
                law=law.params,
                speed=speed,
                is_airspeed=self._is_airspeed(),
                time=time,
                observer=over,
            ),
        )

    def logged_groups(self, law: ControlLaw | None = None) -> dict[str, tuple[str, ...]]:
        """Return the groups of the base class. If the controller learns, `given_up` is added.

        Args:
            law: As in `ControllerConfig.logged_groups`.

        Returns:
            Names of the channels by group.
        """
        grouped = super().logged_groups(law)
        return grouped if self.learn is None else grouped | {internals.GIVEN_UP: self.outputs}

    def given_up(self) -> FloatArray:
        """Return 1 for each output in `learn.without` and 0 for every other one, shape (m,).

        The array is empty if nothing is learned.
        """
        if self.learn is None:
            return np.zeros(0)
        return np.array([float(name in (self.learn.without or ())) for name in self.outputs])

    def history_ticks(self) -> int:
        """Return the number of ticks in HISTORY if the models are learned, else 0."""
        return 0 if self.learn is None else round(HISTORY * self.rate)

    def control_law(self) -> ControlLaw:
        """Return the law RISE-DI, which samples the sign in the way that the parameters choose."""
        return CONTROL_LAWS[self.sampled_sign()]

    def law_params(self) -> LawParams:
        """Return the arrays of the law."""
        K = gain(np.array(self.k_g), np.array(self.k_d, dtype=np.float64))
        return LawParams(
            K=K,
            Lambda=np.array(self.Lambda),
            beta=np.array(self.beta),
            D=np.array(self.D, dtype=np.float64),
            input_scale=np.array(self.input_scale),
            omega=np.array(self.omega),
            eps=np.array(self.beta)
            / K
            * self.softening
            * total_lag(np.array(self.lag), self.delay, 1.0 / self.rate),
            sign=self.sampled_sign(),
        )

    def summary(self) -> str:
        """Return a sentence on how the sign is sampled and why.

        The sentence also says whether input_scale is scheduled.
        """
        scaling = "" if self.schedule is None else "; input_scale follows the dynamic pressure"
        if self.sign != "auto":
            return f"{self.sign} sign, as configured{scaling}"
        late = f"because lag and delay of {self._largest_lateness():g} s"
        half = f"half a period ({0.5 / self.rate:g} s)"
        if self.sampled_sign() is Sign.IMPLICIT:
            return f"implicit sign, {late} are below {half}{scaling}"
        return f"softened sign, {late} reach {half}{scaling}"

    def sampled_sign(self) -> Sign:
        """Choose how the sign is sampled.

        If `sign` is "auto", the sign is implicit if lag and delay are below half a period, and
        softened if they are not.
        """
        if self.sign != "auto":
            return Sign[self.sign.upper()]
        return Sign.IMPLICIT if self._largest_lateness() < 0.5 / self.rate else Sign.SOFT

    def _largest_lateness(self) -> float:
        """Return the largest lag plus the delay, s."""
        return max(self.lag) + self.delay
