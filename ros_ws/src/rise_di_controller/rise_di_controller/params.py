# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Validate the parameters of the controller under any control law.

`controller_section` has the fields, and builds the arrays from them. The parameters of a particular
law are a subclass, which `AnyLaw.validate_mapping` finds by the name of the law.
"""

from collections.abc import Iterator, Sequence
from itertools import combinations

import numpy as np

from flight_core.arguments import as_instance
from flight_core.parameters import (
    ParameterError,
    require,
    require_distinct,
    require_length,
)
from flight_core.rates import divide, period_ns
from flight_core.vectors import selection_matrix
from rise_di_controller import internals
from rise_di_controller.controller_section import ControllerSection
from rise_di_controller.extensions.feedforward import (
    LONGEST_PART,
    ZERO_REAL_PART,
    Nominal,
    nominal_zeros,
)
from rise_di_controller.extensions.model_sections import (
    ObserverConfig,
)
from rise_di_controller.extensions.observer import (
    filter_matrix,
    without_frozen,
)
from rise_di_controller.guard.probe import LARGEST, ProbeConfig
from rise_di_controller.law.control_law import Measurements, TunedLaw, fields
from rise_di_controller.law.linear_loop import (
    LinearPlant,
    LoopTiming,
    is_stable,
    linear_law,
    spectral_radius,
)

# fractions of the delay margin at which the nominal loop with an observer must be stable
MARGIN_PARTS = (0.0, 0.5, 1.0)

MAX_DELAY_PERIODS = 100
"""Largest delay in periods. The linear loop has m states for each period of the delay. With four
channels, 100 periods take 3 s of processor time, and 1000 periods half a minute."""

MAX_STABLE_STEP = 2.5
"""Largest product of dt and abs(zero), for the fastest zero of the nominal model. dt is the longest
Runge-Kutta step of the feedforward, LONGEST_PART periods. A step is stable up to a product of
2.78."""


class ControllerConfig(ControllerSection):
    """The parameters that the controller node has under every control law.

    A subclass adds the parameters of a law as fields.

    Args:
        values: Values by name of the parameter.

    Raises:
        ParameterError: A value or a relation between values is invalid.

    Examples:
        >>> rise_di.find_scenario("osprey_servo").controller.outputs
        ('q', 'p', 'r', 'V')
    """

    @classmethod
    def tunable(cls) -> frozenset[str]:
        """Return the parameters of the law and of the guard, which may change in flight.

        The names of the channels and the signs D may not change.
        """
        common = {"lag", "delay", "max_age", "hold", "ramp", "lower", "upper", "slew", "y_max"}
        return frozenset(common | (set(cls.model_fields) - set(ControllerConfig.model_fields)))

    def _check(self) -> None:
        for _ in self.checks():
            pass

    def checks(self) -> Iterator[None]:
        """Check the relations between the values, in steps of at most about 1 ms.

        The generator yields after each step, so that a controller can fly meanwhile. Raises
        ParameterError.
        """
        period = period_ns(self.rate, "rate")
        if self.lockstep:
            require(self.y_rate > 0, "y_rate", "0 Hz", "the rate of y in lockstep")
            divide(period, period_ns(self.y_rate, "y_rate"), "y_rate", "1 / rate")
        longest = MAX_DELAY_PERIODS / self.rate
        require(
            self.delay <= longest,
            "delay",
            f"{self.delay:g} s",
            f"at most {longest:g} s, {MAX_DELAY_PERIODS} periods of rate",
        )
        self._check_names()
        require_length("inputs", self.inputs, self.outputs)
        for key in ("D", "input_scale", "lag"):
            require_length(key, getattr(self, key), self.outputs)
        for key in ("lower", "upper", "slew"):
            require_length(key, getattr(self, key) or self.inputs, self.inputs)
        require_length("y_max", self.y_max or self.outputs, self.outputs)
        for i, (low, high) in enumerate(zip(self.lower or (), self.upper or (), strict=False)):
            require(low < high, f"lower[{i}]", low, f"less than upper[{i}] = {high:g}")
        for i, low in enumerate(self.lower or ()):
            require(low <= 0, f"lower[{i}]", low, "at most 0, so that trim is inside the limits")
        for i, high in enumerate(self.upper or ()):
            require(high >= 0, f"upper[{i}]", high, "at least 0, so that trim is inside the limits")
        if self.allocation is not None:
            self.allocation.arrays(self.inputs)
        if self.probe is not None:
            self._check_probe(self.probe)
        self.check_law()
        self._check_state()
        yield
        nominal = self.nominal()
        if nominal is not None:
            self._check_nominal(nominal)
            yield
        if self.observer is not None:
            if nominal is None:
                raise ParameterError(
                    "observer: found no feedforward beside it, expected the section feedforward, "
                    "which has the model"
                )
            yield from self._check_observer(self.observer, nominal)

    def _check_names(self) -> None:
        """Raise ParameterError if two channels or states have the same name in the log."""
        require_distinct("outputs", self.outputs)
        require_distinct("inputs", self.inputs)
        for key, section in (("feedforward", self.feedforward), ("observer", self.observer)):
            require_distinct(f"{key}.states", () if section is None else section.states)

    def _check_state(self) -> None:
        """Raise ParameterError if the log cannot hold the state of the law.

        Each array must have one value per output, and a name that the log does not use.
        """
        zero = np.zeros(len(self.outputs))
        state = self.control_law().engage(
            Measurements(y=zero, y_m=zero, y_m_dot=zero, u_trim=zero, u_before=zero),
            self.law_params(),
        )
        for name, value in fields(state).items():
            require(
                name not in internals.RESERVED,
                "law",
                f"a state with {name}",
                "another name, which the log does not have",
            )
            shape = np.shape(value)
            require(
                shape == zero.shape,
                "law",
                f"a state with {name} of shape {shape}",
                f"{zero.shape}, one value an output",
            )

    def _check_probe(self, probe: ProbeConfig) -> None:
        require(
            self.allocation is None,
            "probe",
            "an allocation beside it",
            "none: a sine on an input of the law moves several effectors",
        )
        require_length("probe.effect", probe.effect or self.outputs, self.outputs)
        require(
            bool(probe.amplitudes(self.outputs).any()),
            "probe.effect",
            "no output to probe",
            "an amplitude above 0",
        )
        highest = float(probe.harmonics(self.outputs, self.input_scale).max()) / probe.window
        limit = min(LARGEST, self.rate / 4.0)
        require(
            highest <= limit,
            "probe.lowest",
            f"sines up to {highest:.3g} Hz",
            f"at most {limit:.3g} Hz: a lower one, or a longer window",
        )

    def _check_nominal(self, nominal: Nominal) -> None:
        zeros = nominal_zeros(nominal)
        rightmost = float(np.max(zeros.real, initial=-np.inf))
        fastest = float(np.max(np.abs(zeros), initial=0.0))
        require(
            rightmost <= ZERO_REAL_PART,
            "feedforward.A",
            f"zero dynamics with an eigenvalue at {rightmost:.3g} 1/s",
            "none in the right half plane: u_ff would grow without bound",
        )
        limit = MAX_STABLE_STEP / LONGEST_PART * self.rate
        require(
            fastest <= limit,
            "feedforward.A",
            f"zero dynamics as fast as {fastest:.3g} 1/s",
            f"at most {limit:.3g} 1/s, which ticks of {self.rate:g} Hz can follow",
        )

    def _check_observer(self, observer: ObserverConfig, nominal: Nominal) -> Iterator[None]:
        """Check sizes, stability of filter and feedback, and the delay margin of the nominal loop.

        The nominal loop must be stable if u is late by each of the fractions MARGIN_PARTS of
        `observer.margin`, or of `delay` if that is longer.
        """
        expected = (
            tuple(f"x.{name}" for name in self.feedforward.states) if self.feedforward else ()
        )
        require(
            observer.states[: len(expected)] == expected,
            "observer.states",
            ", ".join(observer.states[: len(expected)]),
            f"first the states of the feedforward: {', '.join(expected)}",
        )
        if observer.vanes is not None:
            observer.vanes.params(self.outputs, self._model_states(), len(observer.states))
        require(
            observer.rate == self.rate,
            "observer.rate",
            f"{observer.rate:g} Hz",
            f"controller.rate, {self.rate:g} Hz",
        )
        Phi, Gamma, H, L, F = observer.matrices(nominal)
        matrices = {"L": Phi @ (np.eye(len(Phi)) - L @ H)}
        if F.any(axis=1).all():  # a channel without F has only the law, see the loop below
            matrices["F"] = Phi - Gamma @ F
        for key, matrix in matrices.items():
            radius = spectral_radius(matrix)
            require(
                radius < 1.0,
                f"observer.{key}",
                f"a spectral radius of {radius:.6g}",
                "less than 1: it is unstable",
            )
        flies = not self.vanes or observer.part > 0.0
        require(flies, "observer.vanes", "part 0 beside it", "a part above 0: the observer flies")
        yield
        (law, params), period, m = self.tuned_law(), 1.0 / self.rate, len(self.inputs)
        readings = selection_matrix(self.vanes, self._model_states())
        plant = LinearPlant(
            nominal.A + nominal.gravity, nominal.B, np.vstack([nominal.C, readings])
        )
        loop = LoopTiming(np.array(self.lag), 0.0, period)
        for frozen in _subsets(self.vanes):
            law_params = without_frozen(params, [name in frozen for name in self.vanes])
            frozen_text = f" without {' and '.join(frozen)}" if frozen else ""
            radius = spectral_radius(filter_matrix(law_params))
            unstable = f"a spectral radius of {radius:.6g}{frozen_text}"
            require(radius < 1.0, "observer.vanes.L", unstable, "less than 1: it is unstable")
            linear = linear_law(TunedLaw(law, law_params), m, period)
            for part in MARGIN_PARTS:
                late = part * max(observer.margin, self.delay)
                stable = is_stable(plant, linear, loop, np.full(m, late))
                unstable_loop = (
                    f"a nominal loop that is unstable with u {1e3 * late:g} ms late{frozen_text}"
                )
                expected_margin = (
                    f"a delay margin of at least {1e3 * observer.margin:g} ms: a smaller F or K"
                )
                require(stable, "observer.margin", unstable_loop, expected_margin)
                yield

    def check_law(self) -> None:
        """Check the parameters of the law against each other and against the channels.

        Raises ParameterError if they do not fit.
        """


def _subsets(names: Sequence[str]) -> Iterator[tuple[str, ...]]:
    """Yield every subset of the names, from small to large."""
    for count in range(len(names) + 1):
        yield from combinations(names, count)


def as_controller(value: object, key: str) -> ControllerConfig:
    """Return the value if it holds the parameters of a controller, else raise ParameterError."""
    return as_instance(
        value, ControllerConfig, key, "the parameters of a controller, as scenario.controller"
    )
