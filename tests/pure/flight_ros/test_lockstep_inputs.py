# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test that y and a second signal of a lockstep flight are complete together.

The order in which they arrive does not matter.
"""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from flight_core.vectors import StampedVector
from flight_ros.lockstep import Instant, LockstepInputs

Y_NS, STEP_NS = 2, 10  # ns; y at five times the rate of the steps


def sample(stamp_ns: int) -> StampedVector:
    return StampedVector(stamp_ns, np.zeros(1))


class Arriving:
    """Two signals that arrive in parts."""

    def __init__(self) -> None:
        self.y: list[StampedVector | None] = []
        self.others: list[StampedVector | None] = []
        self.inputs = LockstepInputs(
            Y_NS, STEP_NS, lambda: self._take(self.y), lambda: self._take(self.others)
        )

    @staticmethod
    def _take(arrived: list[StampedVector | None]) -> list[StampedVector | None]:
        taken = arrived.copy()
        arrived.clear()
        return taken

    def instants(self) -> list[Instant]:
        """Return the instants that are complete now."""
        return list(self.inputs.complete())


def test_step_waits_for_second_signal_of_instant_and_other_instants_do_not() -> None:
    flight = Arriving()
    flight.others.append(sample(0))
    flight.y += [sample(Y_NS * k) for k in range(6)]
    assert [(instant.now_ns, instant.is_due) for instant in flight.instants()] == [
        (0, True),
        (2, False),
        (4, False),
        (6, False),
        (8, False),
    ]
    assert flight.inputs.has_y
    flight.others += [sample(STEP_NS), sample(STEP_NS + 1)]
    (instant,) = flight.instants()
    # the later one stays
    assert (instant.now_ns, [sample.stamp_ns for sample in instant.others]) == (STEP_NS, [STEP_NS])
    assert not flight.inputs.has_y


def test_empty_y_is_instant_and_invalid_sample_of_other_signal_is_none() -> None:
    flight = Arriving()
    flight.y += [None, sample(Y_NS)]
    flight.others += [None]
    assert not flight.instants()
    flight.others.append(sample(0))
    first, second = flight.instants()
    assert (first.y, first.is_due, second.now_ns) == (None, True, Y_NS)


@given(st.lists(st.booleans(), min_size=80, max_size=80))
def test_instants_do_not_depend_on_order_of_arrival(order: list[bool]) -> None:
    flight = Arriving()
    found = []
    y = [sample(Y_NS * k) for k in range(21)]
    others = [sample(Y_NS * k) for k in range(21)]
    for of_y in [*order, *[True] * 21, *[False] * 21]:
        if of_y and y:
            flight.y.append(y.pop(0))
        elif not of_y and others:
            flight.others.append(others.pop(0))
        found += flight.instants()
    assert [instant.now_ns for instant in found] == [Y_NS * k for k in range(21)]
    assert [instant.now_ns for instant in found if instant.is_due] == [0, 10, 20, 30, 40]
    assert all(sample.stamp_ns <= instant.now_ns for instant in found for sample in instant.others)
    received = [sample.stamp_ns for instant in found for sample in instant.others]
    assert received == [Y_NS * k for k in range(21)]
    assert [instant.y.stamp_ns for instant in found if instant.y is not None] == [
        instant.now_ns for instant in found
    ]
