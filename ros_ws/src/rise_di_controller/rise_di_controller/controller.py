# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""The controller from sample to sample: what has come, one tick, what is to be published. Flown by the node and in process."""

from collections import deque
from collections.abc import Callable
from functools import partial
from typing import NamedTuple

from flight_core.rates import seconds
from flight_core.vectors import ChannelError, FloatArray, StampedVector
from rise_di_controller import guard, internals
from rise_di_controller.guard import Mode
from rise_di_controller.law import Sign, retune
from rise_di_controller.params import ControllerParameters


class ControlOutput(NamedTuple):
    """What a tick has to say."""

    stamp_ns: int  # that of the y it answers
    u: FloatArray  # (m,) in the order of the parameters' inputs
    log: Callable[[], FloatArray]

    @property
    def internals(self) -> FloatArray:
        """For the log, in the order of `Controller.names`; made when asked for, so that u need not wait."""
        return self.log()


class Controller:
    """`guard.tick` with its memory: the state, the last y and y_m."""

    def __init__(self, parameters: ControllerParameters) -> None:
        self._law, self._guard = parameters.law(), parameters.guard()
        self._state = guard.initial_state(len(parameters.inputs))
        self.names = internals.names(parameters.outputs, parameters.inputs)
        self.period_ns = self._guard.period_ns
        self._number = 0  # of the last `internals`
        self._digest = parameters.digest()
        self._y: deque[StampedVector] = deque(maxlen=guard.SAMPLE_BUFFER_SIZE)
        self._y_m: deque[StampedVector] = deque(maxlen=guard.SAMPLE_BUFFER_SIZE)

    @property
    def mode(self) -> Mode:
        """What it is doing."""
        return self._state.mode

    @property
    def sign(self) -> Sign:
        """How the sign is sampled."""
        return self._law.sign

    def restart(self) -> None:
        """Begin anew, but with u as it is: it does not jump."""
        self._state = guard.initial_state(len(self._state.u))._replace(u=self._state.u)

    def retune(self, parameters: ControllerParameters) -> None:
        """Take new parameters between two ticks, all at once and without a jump of u; the same ones change nothing."""
        law, digest = parameters.law(), parameters.digest()
        if digest == self._digest:
            return
        if self._state.law is not None:
            self._state = self._state._replace(law=retune(self._state.law, self._law, law))
        self._law, self._guard, self._digest = law, parameters.guard(), digest

    def take_y(self, sample: StampedVector, now_ns: int) -> None:
        """A sample of y, shape (m,), in the law's order.

        Raises ChannelError, "future" or "order", for a stamp ahead of the clock by more than the age limit, or not after the
        last one.
        """
        self._take(self._y, sample, now_ns)

    def take_y_m(self, sample: StampedVector, now_ns: int) -> None:
        """A sample of y_m, likewise."""
        self._take(self._y_m, sample, now_ns)

    def _take(self, samples: deque[StampedVector], sample: StampedVector, now_ns: int) -> None:
        if sample.stamp_ns > now_ns + self._guard.max_age_ns:
            raise ChannelError("future", f"stamp {seconds(sample.stamp_ns - now_ns):g} s ahead of the clock")
        if samples and sample.stamp_ns <= samples[-1].stamp_ns:
            raise ChannelError("order", f"stamp {seconds(sample.stamp_ns - samples[-1].stamp_ns):g} s after the last one")
        samples.append(sample)

    def tick(self, now_ns: int, late_ns: int = 0, *, active: bool = True) -> ControlOutput | None:
        """One tick at `now_ns`, `late_ns` after its deadline; None where nothing is to be published."""
        y = self._newest_pair()
        self._state, used = guard.tick(self._state, now_ns, y, list(self._y_m), self._guard, self._law, active)
        if used is None:
            return None
        self._number += 1
        age = seconds(now_ns - used.stamp_ns)
        limits, digest = self._guard.limits, self._digest
        log = partial(internals.values, self._state, used, limits, seconds(late_ns), age, self._number, digest)
        return ControlOutput(used.stamp_ns, self._state.u, log)

    def _newest_pair(self) -> StampedVector | None:
        """The newest y that y_m reaches; where y_m comes late, a tick takes the y before instead of letting go of u."""
        if not self._y_m:
            return self._y[-1] if self._y else None
        reached_ns = self._y_m[-1].stamp_ns + self._guard.period_ns
        return next((sample for sample in reversed(self._y) if sample.stamp_ns <= reached_ns), self._y[-1] if self._y else None)

    def ages(self, now_ns: int) -> dict[str, float]:
        """How old the newest y and y_m are, s; those that have come."""
        newest = {"y": self._y, "y_m": self._y_m}
        return {name: seconds(now_ns - samples[-1].stamp_ns) for name, samples in newest.items() if samples}

    def stale(self, now_ns: int) -> tuple[str, ...]:
        """Which of y and y_m has not come, or is too old."""
        ages, limit = self.ages(now_ns), seconds(self._guard.max_age_ns)
        return tuple(name for name in ("y", "y_m") if ages.get(name, limit + 1.0) > limit)
