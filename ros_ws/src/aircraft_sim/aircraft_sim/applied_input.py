# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Compute the u that the aircraft applies from the u that it receives.

If no u comes for too long, the failsafe acts. When u comes again, it takes over without a bump.
"""

import numpy as np

from flight_core.failsafe import failsafe_scale
from flight_core.vectors import FloatArray


class AppliedInput:
    """The u that the aircraft applies, shape (m,).

        u_applied(t) = s(t - t_u) u + r(t - t_0) offset,    offset = u_applied(t_0) - u(t_0)

    u is the last received u, and t_u is the instant at which it was received. s is 1 for `hold_ns`,
    and then falls to 0 within `ramp_ns`. t_0 is the instant of the last bumpless transfer. There is
    a transfer when another publisher takes over, and when a u arrives after the ramp has begun. r
    falls from 1 to 0 within `ramp_ns`, so that u_applied does not jump at t_0.
    """

    def __init__(self, m: int, hold_ns: int, ramp_ns: int) -> None:
        self._hold_ns = hold_ns
        self._ramp_ns = ramp_ns
        self._u = self._offset = np.zeros(m)
        self._u_ns = self._transfer_ns = 0

    def take(self, u: FloatArray, now_ns: int, *, transfer: bool) -> None:
        """Take a received u; `transfer` is true if another publisher has sent it than before."""
        if transfer or self._scale(now_ns) < 1.0:
            self._offset = self.u_at(now_ns) - u
            self._transfer_ns = now_ns
        self._u = u
        self._u_ns = now_ns

    def u_at(self, now_ns: int) -> FloatArray:
        """Return the applied u at an instant."""
        scale = self._scale(now_ns)
        fading = failsafe_scale(now_ns - self._transfer_ns, 0, self._ramp_ns)
        u = self._u if scale == 1.0 else scale * self._u
        return u + fading * self._offset if fading > 0.0 and self._offset.any() else u

    def _scale(self, now_ns: int) -> float:
        return failsafe_scale(now_ns - self._u_ns, self._hold_ns, self._ramp_ns)
