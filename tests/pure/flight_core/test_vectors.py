# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test that vectors are matched by name, and an invalid sample is rejected with a reason."""

import math

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from flight_core.vectors import (
    ChannelError,
    array_namespace,
    require_newer,
    require_not_future,
    select,
)


def test_values_matched_by_name_not_by_position() -> None:
    assert select(["q", "V"], ["V", "r", "q"], [1.0, 2.0, 3.0]).tolist() == [3.0, 1.0]


@given(values=st.permutations([("q", 1.0), ("V", 2.0), ("p", 3.0), ("r", 4.0)]))
def test_order_of_publisher_does_not_matter(values: list[tuple[str, float]]) -> None:
    names, numbers = zip(*values, strict=True)
    assert select(["q", "V", "p", "r"], names, numbers).tolist() == [1.0, 2.0, 3.0, 4.0]


@pytest.mark.parametrize(
    "names, values, reason",
    [
        (["q", "V"], [1.0], "length"),
        (["q", "W"], [1.0, 2.0], "name"),
        (["q", "V", "V"], [1.0, 2.0, 3.0], "name"),
        (["q", "V"], [1.0, math.nan], "finite"),
    ],
)
def test_invalid_sample_rejected_with_reason(
    names: list[str], values: list[float], reason: str
) -> None:
    with pytest.raises(ChannelError) as rejected:
        select(["q", "V"], names, values)
    assert rejected.value.reason == reason


def test_unwanted_channel_may_have_any_value() -> None:
    assert select(["q"], ["q", "T"], [1.0, math.nan]).tolist() == [1.0]


def test_array_namespace_is_that_of_library_of_array() -> None:
    assert array_namespace(np.zeros(2)) is array_namespace(np.float64(0.0)) is np
    assert array_namespace(jnp.zeros(2)) is jnp


def test_float_functions_equal_array_functions() -> None:
    """The functions for a Python float give the same values as those for arrays."""
    xp = array_namespace(0.5)
    for name in ("acos", "asin", "atan", "sin", "cos", "tan", "sqrt"):
        # JAX in 32 bit
        assert getattr(xp, name)(0.5) == pytest.approx(float(getattr(jnp, name)(0.5)), rel=1e-6), (
            name
        )
    for name in ("atan2", "hypot", "copysign", "minimum", "maximum"):
        assert getattr(xp, name)(0.5, -2.0) == pytest.approx(
            float(getattr(jnp, name)(0.5, -2.0)), rel=1e-6
        ), name
    assert [xp.where(condition, 1.0, 2.0) for condition in (True, False)] == [1.0, 2.0]


def test_stamps_misordered_or_ahead_rejected() -> None:
    """A stamp out of order is rejected, and so is a stamp ahead of the clock."""
    require_newer(1, 0)
    require_not_future(12, 10, 2)
    with pytest.raises(ChannelError, match="V: stamp 1 s before the last one") as rejected:
        require_newer(10**9, 2 * 10**9, "V")
    assert rejected.value.reason == "order"
    with pytest.raises(ChannelError, match="stamp 2 s ahead of the clock") as rejected:
        require_not_future(2 * 10**9, 0, 10**9)
    assert rejected.value.reason == "future"
