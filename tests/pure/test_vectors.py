# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Named vectors are matched by name; what cannot be used is refused with a reason."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from flight_core.vectors import ChannelError, select


def test_values_are_matched_by_name_not_by_place() -> None:
    assert select(["q", "V"], ["V", "r", "q"], [1.0, 2.0, 3.0]).tolist() == [3.0, 1.0]


@given(values=st.permutations([("q", 1.0), ("V", 2.0), ("p", 3.0), ("r", 4.0)]))
def test_order_of_the_sender_does_not_matter(values: list[tuple[str, float]]) -> None:
    names, numbers = zip(*values, strict=True)
    assert select(["q", "V", "p", "r"], names, numbers).tolist() == [1.0, 2.0, 3.0, 4.0]


@pytest.mark.parametrize(
    ("names", "values", "reason"),
    [
        (["q", "V"], [1.0], "length"),
        (["q"], [1.0, 2.0], "length"),
        (["q", "W"], [1.0, 2.0], "name"),
        (["q", "V", "V"], [1.0, 2.0, 3.0], "name"),
        ([], [], "name"),
        (["q", "V"], [1.0, math.nan], "finite"),
        (["q", "V"], [-math.inf, 1.0], "finite"),
    ],
)
def test_a_sample_that_cannot_be_used_is_refused_with_its_reason(names: list[str], values: list[float], reason: str) -> None:
    with pytest.raises(ChannelError) as refused:
        select(["q", "V"], names, values)
    assert refused.value.reason == reason


def test_a_channel_nobody_asked_for_may_hold_anything() -> None:
    assert select(["q"], ["q", "T"], [1.0, math.nan]).tolist() == [1.0]
