# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Design the allocation for an airframe that has more effectors than outputs.

The design gives the matrix T of u = T v. It also gives the inputs v, which the law uses, with their
limits and lags.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from aircraft_sim.airframes.airframe import Airframe
from flight_analysis.linear_loop.told import lag_through
from flight_core.arguments import as_numbers
from flight_core.parameters import require
from flight_core.vectors import FloatArray
from rise_di_controller.extensions.model_sections import AllocationConfig

LAW_INPUT = "v_"  # prefix of the names of the law's inputs: v_q belongs to the output q
DIGITS = 10  # digits of T and effect in a file, so that their product is I within 1e-9
# lag of a fast servo, s. The weights add it to each lag. Without it an ideal servo, which has no
# lag, would do all the work.
SERVO = 0.01
# An effector limits an input of the law only if its share is at least this fraction of the largest
# share of an effector.
SMALL = 1e-9


class Effectors(NamedTuple):
    """The limits and lags of an airframe's effectors, in the airframe's order, shape (p,) each.

    The values are in SI, and the stops are deviations from trim.
    """

    lower: FloatArray  # lower end stops
    upper: FloatArray
    rate: FloatArray  # largest rates, per s; infinite without a limit
    lag: FloatArray  # lags, s


class LawInputs(NamedTuple):
    """The inputs v of the law before an allocation, one per output, (m,), units of y / s."""

    names: tuple[str, ...]
    # limit of each input at which the first effector reaches its stop, if all other inputs are 0
    lower: FloatArray
    upper: FloatArray
    slew: FloatArray
    lag: FloatArray  # lags, s


def design_allocation(
    airframe: Airframe, effectors: Effectors, priority: Sequence[str] = ()
) -> tuple[AllocationConfig, LawInputs]:
    """Design the allocation and the inputs of the law, so that C B T = I.

    The allocation is the weighted pseudo-inverse of Omega = C B, (m, p).

        T = W^-1 Omega' (Omega W^-1 Omega')^-1,  W = diag(((lag_j + SERVO) / range_j)^2)

    The input v is the part of y_dot that the effectors cause, so D = S = U = I on this airframe.
    For a given v, T finds the u with the least sum of squares of (lag_j + SERVO) u_j / range_j.
    Here range_j is half the distance between the stops, and SERVO is the lag of a fast servo. So a
    slow effector is used little if a fast one can do the same. The lag of v_i is lag_i = sum_j
    Omega_ij T_ji lag_j, exact to first order. `priority` lists outputs. If an effector saturates,
    the input of the first output in the list is kept the longest. The outputs that are not listed
    follow in the airframe's order.

    Raises ParameterError for fewer effectors than outputs, for infinite stops, and for dependent
    rows of Omega. Source of the pseudo-inverse: M. W. Oppenheimer, D. B. Doman, M. A. Bolender,
    "Control allocation for over-actuated systems", Proc. 14th Mediterranean Conference on Control
    and Automation, 2006.
    """
    _require_effectors(airframe, effectors)
    Omega = airframe.matrix_c() @ airframe.matrix_b()
    T = _pseudo_inverse(airframe, Omega, effectors)
    law = tuple(f"{LAW_INPUT}{name}" for name in airframe.outputs)
    first = [f"{LAW_INPUT}{name}" for name in priority]
    config = AllocationConfig.validate_mapping(
        {
            "effectors": tuple(airframe.inputs),
            "T": _rounded(T),
            "effect": _rounded(Omega),
            "lower": effectors.lower.tolist(),
            "upper": effectors.upper.tolist(),
            "slew": effectors.rate.tolist() if np.isfinite(effectors.rate).all() else None,
            "priority": [*first, *(name for name in law if name not in first)] if first else None,
        },
        "allocation",
    )
    lag = lag_through(Omega, T, effectors.lag)
    lower, upper = (
        _alone(T, sides)
        for sides in ((effectors.upper, effectors.lower), (effectors.lower, effectors.upper))
    )
    return config, LawInputs(
        names=law,
        lower=-lower,
        upper=upper,
        slew=_alone(T, (effectors.rate, effectors.rate)),
        lag=lag,
    )


def _require_effectors(airframe: Airframe, effectors: Effectors) -> None:
    """Check that there is an effector for each output, and that all end stops are finite.

    Raises ParameterError if not.
    """
    names = tuple(airframe.inputs)
    m = len(airframe.outputs)
    require(
        len(names) >= m,
        f"airframe {airframe.name}: inputs",
        ", ".join(names),
        f"{m} or more, as many as outputs or more",
    )
    for name, low, high in zip(
        names, effectors.lower.tolist(), effectors.upper.tolist(), strict=True
    ):
        both = np.isfinite([low, high]).all() and low <= 0.0 <= high and low < high
        require(
            bool(both),
            f"aircraft.actuators of {name}",
            f"{low:g} to {high:g}",
            "both end stops: they weigh the effectors",
        )


def _pseudo_inverse(airframe: Airframe, Omega: FloatArray, effectors: Effectors) -> FloatArray:
    """Compute T, (p, m), with the weights of `design_allocation`.

    Raises ParameterError if rows of Omega depend on each other.
    """
    reach = (effectors.upper - effectors.lower) / 2.0 / (effectors.lag + SERVO)
    scaled_Omega = Omega * reach
    size = np.abs(scaled_Omega).max(axis=1, keepdims=True)
    rank = np.linalg.matrix_rank(scaled_Omega / np.where(size > 0.0, size, 1.0), 1e-6)
    require(
        bool((size > 0.0).all()) and rank == len(Omega),
        f"airframe {airframe.name}: C B",
        "rows that depend on each other",
        "inputs that move each output",
    )
    return np.asarray(reach[:, None] * np.linalg.pinv(scaled_Omega))


def _alone(T: FloatArray, sides: tuple[FloatArray, FloatArray]) -> FloatArray:
    """Return how large each v_i >= 0 may be while all effectors stay within their stops, (m,).

    All other inputs are 0. `sides` are two arrays of stops, one per effector. An effector with a
    negative T_ji moves towards its stop in the first array, and one with a positive T_ji towards
    its stop in the second. The signs of the stops are ignored.
    """
    against, along = (np.abs(side)[:, None] for side in sides)
    counts = np.abs(T) > SMALL * np.abs(T).max(axis=0)
    room = np.where(T > 0.0, along, against) / np.where(counts, np.abs(T), 1.0)
    return np.asarray(np.where(counts, room, np.inf).min(axis=0))


def _rounded(matrix: FloatArray) -> list[float]:
    small = SMALL * np.abs(matrix).max(axis=0)
    return [
        float(f"{value:.{DIGITS}g}")
        for value in np.where(np.abs(matrix) > small, matrix, 0.0).ravel()
    ]


def lags_by_input(lag: ArrayLike, airframe: Airframe) -> dict[str, float]:
    """Return the lag of each input, s, by the input's name.

    `lag` is one value for all inputs, or one for each. Raises ParameterError for a wrong number of
    values, and for a negative lag.
    """
    names = list(airframe.inputs)
    values = as_numbers(lag, "lag", expected := "seconds, 0 or more")
    values = values * len(names) if len(values) == 1 else values
    require(
        len(values) == len(names),
        "lag",
        f"{len(values)} values",
        f"one for all or one for each of {', '.join(names)}",
    )
    require(min(values) >= 0.0, "lag", lag, expected)
    return dict(zip(names, values, strict=True))
