# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Convert the arguments of public functions, or refuse them in one sentence."""

import math
import os
from collections.abc import Mapping
from pathlib import Path
from typing import TypeVar

from flight_core.fields import Problems, kind_of, short_repr
from flight_core.parameters import ParameterError, require

FilePath = str | os.PathLike[str]

T = TypeVar("T")


def as_path(value: FilePath, key: str, expected: str) -> Path:
    """Return a text or a path-like object as a path.

    Raises ParameterError if the value has another type or is an empty text.
    """
    text = os.fspath(value) if isinstance(value, str | os.PathLike) else b""
    require(isinstance(text, str) and text != "", key, short_repr(value), expected)
    return Path(value)


def as_number(
    value: object, key: str, least: float, most: float = math.inf, unit: str = ""
) -> float:
    """Return a finite number from `least` to `most`.

    Raises ParameterError, with the unit, for any other value.
    """
    if most == math.inf:
        expected = f"{least:g} or more" + (f", {unit}" if unit else "")
    else:
        expected = f"{least:g} to {most:g}" + (f" {unit}" if unit else "")
    return float(_bounded(float, value, key, least, most, expected))


def as_count(value: object, key: str, least: int, most: float = math.inf) -> int:
    """Return the value if it is an integer from `least` to `most`, or raise ParameterError."""
    bounds = f"of {least} or more" if most == math.inf else f"from {least} to {most:g}"
    return int(_bounded(int, value, key, least, most, f"an integer {bounds}"))


def _bounded(
    number: type[float], value: object, key: str, least: float, most: float, expected: str
) -> float:
    """Return the value if it is a `number` from `least` to `most`, or raise ParameterError.

    The error says what was `expected`.
    """
    problems = Problems()
    number_in_bounds: float = kind_of(number, {"ge": least, "le": most}).read(value, key, problems)
    require(not problems.sentences(), key, short_repr(value), expected)
    return number_in_bounds


def as_numbers(value: object, key: str, expected: str) -> tuple[float, ...]:
    """Return finite numbers from a list, a tuple or an array, or from a single number.

    Raises ParameterError for any other value.
    """
    problems = Problems()
    numbers = kind_of(float | tuple[float, ...]).read(value, key, problems)
    require(not problems.sentences(), key, short_repr(value), expected)
    return numbers if isinstance(numbers, tuple) else (float(numbers),)


def as_numbers_by_name(values: object, key: str, example: str) -> dict[str, float]:
    """Return finite numbers by name from a mapping, or raise ParameterError."""
    if not isinstance(values, Mapping):
        raise ParameterError(f"{key}: found {values!r}, expected numbers by name, as in {example}")
    return {
        str(name): as_number(value, f"{key}.{name}", -math.inf) for name, value in values.items()
    }


def as_names(value: object, key: str, expected: str) -> tuple[str, ...]:
    """Return names from a list, a tuple or an array, or from a text with commas.

    Raises ParameterError for any other value.
    """
    if isinstance(value, str):
        value = value.split(",") if value else ()
    problems = Problems()
    names: tuple[str, ...] = kind_of(tuple[str, ...]).read(value, key, problems)
    require(not problems.sentences(), key, short_repr(value), expected)
    return names


def as_instance(value: object, kind: type[T], key: str, expected: str) -> T:
    """Return the value if it is an instance of a class, or raise ParameterError."""
    if not isinstance(value, kind):
        raise ParameterError(f"{key}: found {short_repr(value)}, expected {expected}")
    return value
