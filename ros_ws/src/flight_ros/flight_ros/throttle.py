# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Limit how often a log line is repeated.

The throttle of rclpy distinguishes lines of code, and not topics and reasons.
"""

import time


class Throttle:
    """Lets a line of the log pass once in a period."""

    def __init__(self, period_ns: int) -> None:
        self._period_ns = period_ns
        self._passed_ns: dict[str, int] = {}  # instant at which a line last passed, by its text

    def is_due(self, line: str) -> bool:
        """Return whether a line may be logged, because it was not logged for a period.

        If the result is True, the line is remembered as logged now.
        """
        now_ns = time.monotonic_ns()
        is_due = now_ns - self._passed_ns.get(line, -self._period_ns) >= self._period_ns
        if is_due:
            self._passed_ns[line] = now_ns
        return is_due
