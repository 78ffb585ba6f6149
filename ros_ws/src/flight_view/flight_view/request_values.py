# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Check that values in a request of a page are well formed and in range."""

import math
from collections.abc import Collection, Mapping, Sequence
from http import HTTPStatus
from typing import Any

from flight_core.fields import short_repr

RANGE = (0.5, 2.0)
"""Factors on a gain of the scenario, between which the page can set this gain."""


class RefusedError(Exception):
    """Raised if a request is refused, with the HTTP status and a sentence."""

    def __init__(self, status: HTTPStatus, sentence: str) -> None:
        super().__init__(sentence)
        self.status = status
        self.sentence = sentence


def require_form(holds: bool, sentence: str) -> None:
    """Check that a request is well formed: raise RefusedError unless `holds`."""
    if not holds:
        raise RefusedError(HTTPStatus.BAD_REQUEST, sentence)


def require_known(name: str, known: Collection[str], kind: str) -> None:
    """Raise RefusedError if a name is not among the known names of a kind."""
    require_form(
        name in known, f"{short_repr(name)}: no {kind}, expected one of {', '.join(known)}"
    )


def as_list(value: Any) -> Sequence[Any]:
    """Return the value of a parameter as a sequence."""
    return value if isinstance(value, list | tuple) else [value]


def permitted_range(value: float) -> list[float]:
    """Return the least and the largest permitted value of a gain, given its scenario value."""
    return sorted(factor * value for factor in RANGE)


def require_range(name: str, value: Any, base: Any) -> None:
    """Check that a gain is inside the `permitted_range` of its value `base` in the scenario.

    Raises RefusedError if not.
    """
    for number, middle in zip(as_list(value), as_list(base), strict=True):
        low, high = permitted_range(middle)
        require_form(
            low <= number <= high,
            f"{name}: found {number:g}, expected {low:g} to {high:g}, {RANGE[0]:g} to "
            f"{RANGE[1]:g} times the scenario's",
        )


def like_parameter(name: str, base: Any, value: Any) -> Any:
    """Convert a value to a float or a list, as the parameter's value `base` in the scenario is."""
    values = as_list(finite_numbers(name, value))
    expected = len(as_list(base))
    require_form(
        len(values) == expected, f"{name}: found {len(values)} values, expected {expected}"
    )
    return values if isinstance(base, tuple) else values[0]


def values_by_name(request: Mapping[str, Any], key: str) -> dict[str, Any]:
    """Return the mapping that a request has under a key."""
    values = request.get(key)
    if not isinstance(values, dict) or not values:
        raise RefusedError(HTTPStatus.BAD_REQUEST, f"{key}: expected values by name")
    return values


def finite_number(name: str, value: Any) -> float:
    """Return a finite number of a request."""
    number = math.nan
    if isinstance(value, int | float) and not isinstance(value, bool):
        # An integer with hundreds of digits is too large for a float.
        try:
            number = float(value)
        except OverflowError:
            number = math.inf
    require_form(
        math.isfinite(number), f"{short_repr(name)}: found {short_repr(value)}, expected a number"
    )
    return number


def is_sentences(value: Any) -> bool:
    """Return whether a value is a list of sentences, such as faults."""
    return isinstance(value, list) and all(isinstance(fault, str) for fault in value)


def finite_numbers(name: str, value: Any) -> Any:
    """Return a finite number, or a list of numbers, in which null becomes infinity."""
    if not isinstance(value, list):
        return finite_number(name, value)
    return [math.inf if number is None else finite_number(name, number) for number in value]
