# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Count the failed steps of a node, and decide when to log a sentence about them."""

import math

DWELL = 10.0
"""Time without a failed step after which the next failed step is logged again, s."""


class Failures:
    """Counts failed steps, and tells when to log a sentence about them.

    A sentence is due at the first failed step. It is due again at a failed step if no step has
    failed in the time DWELL before it.
    """

    def __init__(self) -> None:
        self.count = 0
        self._last = -math.inf

    def add(self, t: float) -> bool:
        """Count a failed step at the flight time t, s, and return whether a sentence is due."""
        is_first = t - self._last > DWELL
        self.count += 1
        self._last = t
        return is_first


def sentence(error: Exception) -> str:
    """Write the kind and the message of an error on a single line."""
    return " ".join(f"{type(error).__name__} {error}".split())
