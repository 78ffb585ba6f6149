# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Define the nominal model of a model-based law, and functions that several laws share.

These functions saturate u, and prevent the windup of integrals. Channels are in the law's order,
and states are in the airframe's order.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from flight_core.vectors import Array, FloatArray, array_namespace
from rise_di_controller.law import saturation
from rise_di_controller.law.control_law import ControlLaw, Measurements, without_limits
from rise_di_controller.law.saturation import Limits


class NominalModel(NamedTuple):
    """The nominal aircraft, SI, and the loop around it.

    `model_data` in the catalogue says what each law knows of it.
    """

    A: FloatArray  # (n, n)
    B: FloatArray  # (n, m)
    C: FloatArray  # (m, n), picks the outputs
    gravity: FloatArray  # (n, n), f(x) = gravity @ sin(x)
    wind: FloatArray  # x_dot for 1 m/s of wind along each of G axes, (n, G)
    # rms noise of the measured outputs per sample, (m,); for an output without noise, a tenth of
    # its unit in the score
    noise: FloatArray
    kinematic: FloatArray  # 1 for an angle that integrates rates, such as theta, else 0, (n,)
    size: FloatArray  # unit of each state in weights, (n,): 1 m/s, 0.1 rad or 0.1 rad/s
    input_scale: FloatArray  # u per scaled input, (m,)
    D: FloatArray  # (m,) +1 or -1
    lag: FloatArray  # time constants of the actuators, (m,), s
    total_lag: FloatArray  # lag of the loop, (m,), s: actuator + 1.5 periods + delay
    period: float  # period of the law, s
    lower: FloatArray  # least u from trim, (m,); infinite without a limit
    upper: FloatArray  # largest u from trim, (m,)

    @property
    def Omega(self) -> FloatArray:  # noqa: N802 - the paper's name
        """C B, equation (11), shape (m, m)."""
        product: FloatArray = self.C @ self.B
        return product

    @property
    def inverse(self) -> FloatArray:
        """Omega^-1, shape (m, m)."""
        return np.asarray(np.linalg.inv(self.Omega))

    @property
    def limits(self) -> Limits:
        """Limits of u for a law, shape (m, 1). The rate of u is not limited."""
        return Limits(
            self.lower[:, None], self.upper[:, None], np.full((len(self.lower), 1), np.inf)
        )


def campaign_law(
    state: type[Any],
    engage: Callable[[Measurements, Any], Any],
    limited: Callable[[Any, Measurements, Array, Any, Limits], tuple[Any, Array, Array]],
) -> ControlLaw:
    """Return a control law that only campaigns use, because no topic has its measurements.

    The law cannot be retuned in flight.
    """

    def retune(state: Any, old: Any, new: Any) -> Any:
        raise NotImplementedError("a law that only campaigns use has no retuning")

    return ControlLaw(
        state=state, engage=engage, step=without_limits(limited), limited=limited, retune=retune
    )


class ErrorIntegral(NamedTuple):
    """State of a law with an integral of the error, each field with the shape (m,)."""

    e: Array
    integral_e: Array


def start_integral(measurements: Measurements, _: Any) -> ErrorIntegral:
    """Return the state at engagement, with the present e and an integral of 0."""
    e = measurements.y - measurements.y_m
    return ErrorIntegral(e, array_namespace(e).zeros_like(e))


def state_of(measurements: Measurements, *, vanes: bool = False) -> Array:
    """Return the full state, shape (n, N). With `vanes`, the state is relative to the air.

    Raises ValueError if x is not measured.
    """
    x = measurements.x_air if vanes else measurements.x
    if x is None:
        raise ValueError("measurements: found no state, expected the full state")
    return x


def saturate_with_excess(
    u: Array, measurements: Measurements, dt: Array, limits: Limits
) -> tuple[Array, Array]:
    """Saturate u, shape (m,).

    Returns the u inside the limits, and by how much the given u exceeds this u.
    """
    commanded = saturation.saturate(u, measurements.u_before, dt, limits)
    return commanded, u - commanded


def conditional_integration(before: Array, after: Array, effect: Array, excess: Array) -> Array:
    """Return the integral after a step, or the one before if the step increases a saturation.

    The result is `before` if effect * excess > 0, else `after` (conditional integration). `effect`
    is the change of u (or of the scaled input) by the step. `excess` is the part of u beyond the
    limit, in the same units and channels. Source: K. J. Astrom, T. Hagglund, "Advanced PID
    Control", 3.5.
    """
    return array_namespace(before).where(effect * excess > 0.0, before, after)


def filter_gain(rate: Array, dt: Array) -> Array:
    """Compute 1 - exp(-rate dt), the gain of a first-order low-pass filter in a tick.

    This gain is exact for an input that is held over the tick.
    """
    return -array_namespace(rate).expm1(-rate * dt)
