# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Collect the inputs of a node in lockstep, where the number of samples of y gives the time."""

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from typing import NamedTuple

from flight_core.vectors import StampedVector


class Instant(NamedTuple):
    """A sample of y, and the `others`: the new samples of a second signal up to its instant."""

    now_ns: int
    is_due: bool  # whether the node steps at this instant
    y: StampedVector | None  # None if a sample did not arrive, or is invalid
    others: list[StampedVector]


class LockstepInputs:
    """Matches the samples of y with the samples of a second signal.

    A step waits for the y of its instant, and for all samples of the second signal up to this
    instant.
    """

    def __init__(
        self,
        y_period_ns: int,
        period_ns: int,
        receive_y: Callable[[], Iterable[StampedVector | None]],
        receive_other: Callable[[], Iterable[StampedVector | None]],
        is_ready: Callable[[int], bool] = lambda now_ns: True,
    ) -> None:
        """Prepare to match the samples of y and of the second signal.

        `is_ready` is called with the instant of a step, ns, and says whether all other inputs of
        the step have arrived.
        """
        self._is_ready = is_ready
        self._y_period_ns = y_period_ns
        self._period_ns = period_ns
        self._receive_y = receive_y
        self._receive_other = receive_other
        self._number = 0  # index of the next y
        self._y_due: deque[StampedVector | None] = deque()
        self._others_due: deque[StampedVector] = deque()

    def complete(self) -> Iterator[Instant]:
        """Yield the instants whose inputs have arrived, each once, in the order of time."""
        if not self._y_due:
            self._y_due.extend(self._receive_y())
        self._others_due.extend(sample for sample in self._receive_other() if sample is not None)
        while self._y_due:
            now_ns = self._number * self._y_period_ns
            is_due = now_ns % self._period_ns == 0
            if is_due and not (
                self._others_due
                and self._others_due[-1].stamp_ns >= now_ns
                and self._is_ready(now_ns)
            ):
                return
            self._number += 1
            others = []
            while self._others_due and self._others_due[0].stamp_ns <= now_ns:
                others.append(self._others_due.popleft())
            yield Instant(now_ns, is_due, self._y_due.popleft(), others)

    @property
    def has_y(self) -> bool:
        """Whether a y has arrived whose step still waits for other inputs."""
        return bool(self._y_due)
