# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""The parameter sections with a model: feedforward, observer, vanes and allocation."""

from collections.abc import Mapping, Sequence
from typing import Annotated

import numpy as np

from flight_core.fields import Field
from flight_core.parameters import (
    Config,
    Names,
    NonNegatives,
    Numbers,
    ParameterError,
    Positive,
    Positives,
    require,
    require_channels,
    require_distinct,
    require_length,
)
from flight_core.vectors import FloatArray, selection_matrix
from rise_di_controller.extensions.allocation import Allocation, allocation
from rise_di_controller.extensions.feedforward import Nominal, nominal_model
from rise_di_controller.extensions.observer import VaneParams
from rise_di_controller.law.decomposition import DecompositionError, signs
from rise_di_controller.law.saturation import Limits

# Largest difference between an entry of the product of `effect` and T and the entry of I. If the
# file has ten digits, it is about 1e-9.
MAX_INVERSE_ERROR = 1e-6


def _require_sizes(section: Config, key: str, sizes: Mapping[str, tuple[int, int]]) -> None:
    """Raise ParameterError if a matrix, given row by row, has a wrong number of entries."""
    for name, (rows, columns) in sizes.items():
        values = getattr(section, name)
        require(
            values is None or len(values) == rows * columns,
            f"{key}.{name}",
            f"{len(values or ())} values",
            f"{rows * columns}: {rows} rows of {columns}",
        )


def require_same_signs(Omega: FloatArray, D: Sequence[int], where: str) -> None:
    """Check that C B of a model has a D, and that it equals the D of the controller.

    Raises ParameterError if not. `where` names the model in the sentence of the error.
    """
    try:
        signs_of_model = [int(sign) for sign in signs(Omega)]
    except DecompositionError as error:
        raise ParameterError(
            f"{where}: found a C B without a D ({error}), expected D = {list(D)}"
        ) from None
    require(
        signs_of_model == list(D),
        where,
        f"a C B with D = {signs_of_model}",
        f"D = {list(D)}, the D of the controller",
    )


class FeedforwardConfig(Config):
    """The nominal model of the feedforward, an extension of the paper.

    Values are in SI units, matrices row by row.
    """

    states: Names = Field(description="states of the model, with the outputs among them")
    A: Numbers = Field(description="A, one row per state")
    B: Numbers = Field(description="B, one row per state, columns as in controller.inputs")
    gravity: Numbers | None = Field(
        default=None, description="sine terms, x_dot += gravity sin(x), one row per state"
    )
    lead: NonNegatives = Field(
        description="time from a tick until its input acts, s: half a period, delay and lag"
    )
    inputs: Names | None = Field(
        default=None, description="inputs with a feedforward; none: all of them"
    )
    deviation: NonNegatives | None = Field(
        default=None, description="standard deviations of B, from which guidance takes its limits"
    )

    def nominal(self, outputs: Sequence[str], inputs: Sequence[str], D: Sequence[int]) -> Nominal:
        """Return the nominal model as arrays.

        Raises ParameterError if sizes do not match, or if C B of the model has another D than the
        controller.
        """
        n = len(self.states)
        m = len(outputs)
        for name in outputs:
            require(
                self.states.count(name) == 1,
                "feedforward.states",
                ", ".join(self.states),
                f"the output {name} once",
            )
        sizes = {"A": (n, n), "B": (n, m), "gravity": (n, n), "deviation": (n, m)}
        _require_sizes(self, "feedforward", sizes)
        require_length("feedforward.lead", self.lead, inputs)
        A = np.reshape(self.A, (n, n))
        B = np.reshape(self.B, (n, m))
        gravity = np.zeros((n, n)) if self.gravity is None else np.reshape(self.gravity, (n, n))
        C = selection_matrix(outputs, self.states)
        require_same_signs(C @ B, D, "feedforward.B")
        unknown = [name for name in self.inputs or () if name not in inputs]
        require(
            not unknown, "feedforward.inputs", ", ".join(unknown), f"some of {', '.join(inputs)}"
        )
        if self.inputs is None:
            acts = None
        else:
            acts = np.array([float(name in self.inputs) for name in inputs])
        return nominal_model(A, B, C, gravity, np.array(self.lead), acts)


class VanesConfig(Config):
    """Vanes of an observer: channels of y beside the outputs, which only the observer uses.

    Values are in SI units, row by row.
    """

    channels: Names = Field(
        description="channels of y that are also states of the feedforward, such as alpha"
    )
    H: Numbers = Field(description="H z = reading minus the reference's reading, one row per vane")
    L: Numbers = Field(
        description="added to L for each vane: one row per estimate, columns for outputs and vane"
    )
    least: NonNegatives = Field(
        description="rms motion of a reading below which its vane counts as frozen"
    )
    time: Positive = Field(default=1.0, description="time over which the motion is averaged, s")

    def params(self, outputs: Sequence[str], states: Sequence[str], estimates: int) -> VaneParams:
        """Return the parameters of the vanes as arrays.

        Raises ParameterError if a vane has no state of the same name, or if a size is wrong.
        """
        k = len(self.channels)
        s = estimates
        m = len(outputs)
        others = [name for name in states if name not in outputs]
        expected = f"states of the feedforward that are no outputs: {', '.join(others)}"
        are_states = set(self.channels) <= set(others) and len(set(self.channels)) == k
        require(are_states, "observer.vanes.channels", ", ".join(self.channels), expected)
        for key, size in (("H", k * s), ("L", k * s * (m + 1)), ("least", k)):
            entries = len(getattr(self, key))
            require(
                entries == size,
                f"observer.vanes.{key}",
                f"{entries} values",
                f"{size} for {k} vanes, {s} estimates",
            )
        least = np.array(self.least) ** 2
        L = np.reshape(self.L, (k, s, m + 1))
        return VaneParams(np.reshape(self.H, (k, s)), L, least, np.float64(self.time))


class ObserverConfig(Config):
    """An observer of the nominal model, an extension of the paper.

    The matrices come from a finished design, in SI units, row by row.
    """

    rate: Positive = Field(description="rate of the law for which the matrices hold, Hz")
    states: Names = Field(
        description="names of the estimates: first the states of the feedforward, as x.alpha"
    )
    Phi: Numbers = Field(description="estimates one period later without input")
    Gamma: Numbers = Field(description="effect of u, held over the period, on the estimates")
    L: Numbers = Field(description="correction of the estimates by the errors of the outputs")
    F: Numbers = Field(description="u_o = -F z, one row per input, one column per estimate")
    part: Annotated[float, Field(ge=0, le=1)] = Field(
        default=0.6,
        description="bound of u_o, as a fraction of u's limits; 0: neither u_o nor u_ff",
    )
    within: Positive = Field(
        default=0.1, description="least time in which u_o goes from 0 to its bound, s"
    )
    fade: Annotated[float, Field(ge=0, le=1e6)] = Field(
        default=1.0, description="time in which u_o fades in after engagement, s"
    )
    margin: Annotated[float, Field(ge=0, le=0.5)] = Field(
        default=0.03, description="least delay margin of the nominal loop, including `delay`, s"
    )
    vanes: VanesConfig | None = Field(default=None, description="vanes in addition to y")

    def matrices(self, nominal: Nominal) -> tuple[FloatArray, ...]:
        """Return Phi, Gamma, H, L and F. Raises ParameterError if their sizes do not match."""
        s, (n, m) = len(self.states), nominal.B.shape
        sizes = {"Phi": (s, s), "Gamma": (s, m), "L": (s, m), "F": (m, s)}
        _require_sizes(self, "observer", sizes)
        H = np.hstack([nominal.C, np.zeros((m, s - n))])
        Phi, Gamma, L = (np.reshape(values, (s, -1)) for values in (self.Phi, self.Gamma, self.L))
        return Phi, Gamma, H, L, np.reshape(self.F, (m, s))

    def at_rate(self, rate: float, nominal: Nominal) -> "ObserverConfig":
        """Convert the observer to another rate.

        Let a = self.rate / rate be the ratio of the new period to the old one. The matrices with
        the index a hold at the new rate:

            [Phi_a, Gamma_a; 0, I] = [Phi, Gamma; 0, I]^a,  I - L_a H = (I - L H)^a,  F_a = F
        """
        from scipy.linalg import fractional_matrix_power  # noqa: PLC0415 - few flights need it

        Phi, Gamma, H, L, _ = self.matrices(nominal)
        s, m = Gamma.shape
        periods = self.rate / rate
        transition = np.eye(s + m)
        transition[:s] = np.hstack([Phi, Gamma])
        transition = fractional_matrix_power(transition, periods).real
        correction = H @ L
        remainder = fractional_matrix_power(np.eye(m) - correction, periods).real
        matrices = {
            "Phi": transition[:s, :s],
            "Gamma": transition[:s, s:],
            "L": L @ (np.eye(m) - remainder) @ np.linalg.inv(correction),
        }
        changes = {name: tuple(values.ravel().tolist()) for name, values in matrices.items()}
        return self.model_copy(update={"rate": rate, **changes})


class AllocationConfig(Config):
    """An allocation, which distributes the inputs of the law over at least as many effectors.

    It is an extension of the paper. Values are in SI units, row by row.
    """

    effectors: Names = Field(description="channels of u that are published")
    T: Numbers = Field(description="u = T v, one row per effector, one column per input")
    effect: Numbers = Field(
        description="v = effect u, one row per input, one column per effector; effect T = I"
    )
    lower: Numbers = Field(description="lower end stops of the effectors, from trim")
    upper: Numbers = Field(description="upper end stops of the effectors, from trim")
    slew: Positives | None = Field(default=None, description="limits of abs(u_dot), units of u / s")
    priority: Names | None = Field(
        default=None,
        description="inputs by priority, the first keeps its effect longest; none: in order",
    )

    def ordered(self, inputs: Sequence[str], order: Sequence[str]) -> "AllocationConfig":
        """Return the allocation with its inputs reordered from `inputs` to `order`."""
        places = [list(inputs).index(name) for name in order]
        p = len(self.effectors)
        T = np.reshape(self.T, (p, -1))[:, places]
        effect = np.reshape(self.effect, (-1, p))[places]
        return self.model_copy(
            update={"T": tuple(T.ravel().tolist()), "effect": tuple(effect.ravel().tolist())}
        )

    def arrays(self, inputs: Sequence[str]) -> Allocation:
        """Return the parameters of the allocation as arrays.

        Raises ParameterError if sizes do not match, or if effect T is not I.
        """
        p = len(self.effectors)
        m = len(inputs)
        require(
            p >= m,
            "allocation.effectors",
            ", ".join(self.effectors),
            f"{m} or more, for {', '.join(inputs)}",
        )
        require_distinct("allocation.effectors", self.effectors)
        _require_sizes(self, "allocation", {"T": (p, m), "effect": (m, p)})
        for key in ("lower", "upper", "slew"):
            require_length(
                f"allocation.{key}", getattr(self, key) or self.effectors, self.effectors
            )
        for name, low, high in zip(self.effectors, self.lower, self.upper, strict=True):
            spans_trim = low <= 0.0 <= high and low < high
            require(
                spans_trim,
                "allocation.lower",
                f"{low:g} and upper {high:g} of {name}",
                "a range with trim, 0, inside",
            )
        priority = self.priority or tuple(inputs)
        require_channels("allocation.priority", priority, inputs, "the inputs of the law")
        T = np.reshape(self.T, (p, m))
        effect = np.reshape(self.effect, (m, p))
        error = float(np.abs(effect @ T - np.eye(m)).max())
        require(
            error < MAX_INVERSE_ERROR,
            "allocation.T",
            f"effect T that is off I by {error:.3g}",
            "T with effect T = I",
        )
        slew = (np.inf,) * p if self.slew is None else self.slew
        limits = Limits(np.array(self.lower), np.array(self.upper), np.array(slew))
        return allocation(T, effect, [inputs.index(name) for name in priority], limits)
