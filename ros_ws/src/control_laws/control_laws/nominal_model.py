# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""What a model-based law knows of the aircraft, and what all laws share: limits and how their integrals stop at them.

Arrays hold N aircraft in their last axis. Channels are in the law's order, states in the airframe's.
"""

from typing import NamedTuple

import numpy as np

from flight_core.vectors import Array, FloatArray, array_namespace
from rise_di_controller import guard
from rise_di_controller.control_law import Measurements
from rise_di_controller.guard import Limits


class NominalModel(NamedTuple):
    """The nominal aircraft, SI, and the loop around it. No law sees more of it than its docstring says."""

    A: FloatArray  # (n, n)
    B: FloatArray  # (n, m)
    C: FloatArray  # (m, n), picks the outputs
    gravity: FloatArray  # (n, n), f(x) = gravity @ sin(x)
    wind: FloatArray  # (n, G), what 1 m/s of wind along each axis adds to x_dot
    noise: FloatArray  # (m,) of the measured outputs, rms per sample; a tenth of the unit of a score where there is none
    kinematic: FloatArray  # (n,) 1 where a state is an angle that integrates rates, such as theta, else 0
    size: FloatArray  # (n,) 1 m/s or 0.1 rad (/s): what a state is counted in, so that one gain fits all of them
    input_scale: FloatArray  # (m,) u per scaled input
    D: FloatArray  # (m,) +1 or -1
    lag: FloatArray  # (m,) time constants of the actuators, s
    total_lag: FloatArray  # (m,) that of the loop: actuator + 1.5 periods + delay, s
    period: float  # of the law, s
    lower: FloatArray  # (m,) limits of u, deviations from trim; infinite where there is none
    upper: FloatArray  # (m,)
    rate: FloatArray  # (m,) per s

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
        """The limits as laws take them, shape (m, 1)."""
        return Limits(self.lower[:, None], self.upper[:, None], self.rate[:, None])


def saturate(u: Array, measured: Measurements, dt: Array, limits: Limits) -> tuple[Array, Array]:
    """The u that is commanded and what of the u asked for lies beyond it, both shape (m, N)."""
    commanded = guard.saturate(u, measured.u_before, dt, limits)
    return commanded, u - commanded


def conditional_integration(before: Array, after: Array, effect: Array, beyond: Array) -> Array:
    """An integral that stops where it would push further against a limit: `before` where effect * beyond > 0, else `after`.

    Conditional integration. Arguments: what the increment moves u (or the scaled input) by and what lies beyond the limit, in
    the same units and channels. Source: K. J. Astrom, T. Hagglund, "Advanced PID Control", 3.5.
    """
    return array_namespace(before).where(effect * beyond > 0.0, before, after)


def filter_gain(rate: Array, dt: Array) -> Array:
    """1 - exp(-rate dt): what a low-pass filter of first order takes of its input in one tick, exact for a held input."""
    return -array_namespace(rate).expm1(-rate * dt)
