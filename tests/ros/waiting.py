# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Provide the only way in which a test in real time waits, and the delays that it allows for."""

import threading
import time
from collections.abc import Callable
from typing import Protocol, TypeVar

T = TypeVar("T")

# s, until a test ends that makes no progress: a guard and no limit, which a busy host must not
# reach
HANG = 150.0
LOOK = 0.005  # s, between two looks at a condition


class HostDelays(threading.Thread):
    """Delays of the host, measured by a thread that is due every 10 ms.

    All processes of a test have them. What this process itself computes meanwhile is no delay of
    the host, because another thread may have held the interpreter.
    """

    def __init__(self) -> None:
        super().__init__(daemon=True)
        self._delays: list[tuple[float, float]] = []

    def run(self) -> None:
        """Measure until the process ends."""
        period = 0.01
        begin = time.time()
        processor_time = time.process_time()
        while True:
            time.sleep(period)
            begin, before = time.time(), begin
            processor_time, computed_before = time.process_time(), processor_time
            if (delay := begin - before - period - (processor_time - computed_before)) > period:
                self._delays.append((begin, delay))

    def since(self, t: float) -> float:
        """Return the sum of the delays that ended after an instant of the system clock, s."""
        return sum(delay for end, delay in self._delays if end > t)

    def longest(self, t: float) -> float:
        """Return the longest delay that ended after an instant of the system clock, s."""
        return max((delay for end, delay in self._delays if end > t), default=0.0)


HOST = HostDelays()
"""The delays of the host. The hook of tests/ros/conftest.py starts it with the first test."""


class Logging(Protocol):
    """A process under test."""

    arguments: tuple[str, ...]

    @property
    def output(self) -> str:
        """Return what it has printed."""


running: list[Logging] = []
"""The processes of the present test."""


def until(
    condition: Callable[[], T | None],
    because: str,
    each: Callable[[], object] = lambda: time.sleep(LOOK),
    timeout: float = HANG,
) -> T:
    """Wait until a condition is true, and return its value.

    `each` is called between two looks and takes some milliseconds. `because` says what the test
    waits for. The limit grows by the delays of the host. If the wait ends without the condition,
    the test fails with the output of all its processes.
    """
    begin = time.monotonic()
    began = time.time()
    while not (value := condition()):
        each()
        if time.monotonic() - begin > timeout + HOST.since(began):
            outputs = (f"{' '.join(process.arguments)}:\n{process.output}" for process in running)
            raise AssertionError("\n".join([f"not within {timeout:g} s: {because}", *outputs]))
    return value
