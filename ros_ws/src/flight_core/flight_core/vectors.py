# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Handle named vectors, which are values with channel names.

Channels are matched by name, never by position.
"""

import math
from collections.abc import Sequence
from enum import StrEnum
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from flight_core.fields import short_repr
from flight_core.parameters import ParameterError
from flight_core.rates import seconds
from flight_core.text import bounded

FloatArray = NDArray[np.float64]
Array = Any
"""An array of NumPy or of JAX."""
Scalar = Any  # a Python float, or an array with a value for each aircraft of a fleet


class _NumPy1:
    """NumPy 1 with `concat` added, which this stack uses and NumPy 1 lacks."""

    concat = staticmethod(np.concatenate)

    def __getattr__(self, name: str) -> Any:
        return getattr(np, name)


_NUMPY: Any = np if hasattr(np, "concat") else _NumPy1()


class _Floats:
    """Elementary functions of the array API standard for Python floats."""

    acos = math.acos
    asin = math.asin
    atan = math.atan
    atan2 = math.atan2
    sin = math.sin
    cos = math.cos
    tan = math.tan
    sqrt = math.sqrt
    hypot = math.hypot
    copysign = math.copysign
    minimum = min
    maximum = max

    @staticmethod
    def where(condition: bool, x1: float, x2: float) -> float:
        return x1 if condition else x2


_NAMESPACES: dict[type, Any] = {np.ndarray: _NUMPY, np.float64: _NUMPY, float: _Floats}
"""Namespaces of the most frequent types, which a dict finds faster than `isinstance`."""


def array_namespace(array: Scalar) -> Any:
    """Return the array namespace of an array by the array API standard, or `_Floats` for a float.

    It also works for arrays of NumPy 1, which lack `__array_namespace__`.

    Args:
        array: An array of NumPy or of JAX, or a float.

    Returns:
        The namespace with the functions for arrays of this type.

    Raises:
        ParameterError: `array` is a list.

    Examples:
        >>> rise_di.array_namespace(np.ones(2)).sign(-2.0 * np.ones(2)).tolist()
        [-1.0, -1.0]
    """
    if (namespace := _NAMESPACES.get(type(array))) is not None:
        return namespace
    if isinstance(array, (np.ndarray, np.generic)):
        return _NUMPY
    if isinstance(array, (float, int)):
        return _Floats
    if not hasattr(array, "__array_namespace__"):
        raise ParameterError(f"found {short_repr(array)}, expected an array of NumPy or of JAX")
    return array.__array_namespace__()


def as_array(value: Any, key: str, expected: str) -> FloatArray:
    """Convert a value to an array of float64.

    Raises ParameterError if it is no array of real numbers.
    """
    try:
        if not np.iscomplexobj(value):
            return np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError):  # a text, rows of different lengths, objects
        pass
    raise ParameterError(f"{key}: found {short_repr(value)}, expected {expected}")


class StampedVector(NamedTuple):
    """A sample with the instant of its values, shape (m,), and its publisher.

    Attributes:
        stamp_ns: Instant, ns.
        value: Values, shape (m,), SI.
        sender: Publisher.

    Examples:
        >>> rise_di.StampedVector(2_000_000, np.zeros(4)).value.shape
        (4,)
    """

    stamp_ns: int
    value: FloatArray
    sender: str = ""  # empty if the sample was not received


class SampleFault(StrEnum):
    """Why a sample or a message is refused. Counters of refusals group by it."""

    BOUNDS = "bounds"  # a value outside its limits
    FIELD = "field"  # the message has no such field, or it holds no number
    FINITE = "finite"  # NaN or infinity
    FROZEN = "frozen"  # no value has changed since the last sample
    FUTURE = "future"  # a stamp ahead of the clock
    IMPLAUSIBLE = "implausible"  # y changes faster than an aircraft can
    LENGTH = "length"  # not as many names as values
    MALFORMED = "malformed"  # bytes that cannot be decoded
    MODE = "mode"  # a command that the flight mode does not take
    NAME = "name"  # a channel is missing, unknown or there twice
    OLD = "old"  # a stamp beyond the age limit
    ORDER = "order"  # a stamp that is not newer than the last one
    RANGE = "range"  # a number that the type of a field cannot hold
    RATE = "rate"  # more messages than a tick takes
    ROUTE = "route"  # a route that cannot be flown
    SENDER = "sender"  # a conflicting publisher
    SERVICE = "service"  # no such service
    SIZE = "size"  # a message above the size limit
    STAMP = "stamp"  # a stamp too far from the clock


class ChannelError(ValueError):
    """An invalid sample.

    `reason` is its fault. The message is a sentence, printable and of limited length.
    """

    def __init__(self, reason: SampleFault, sentence: str) -> None:
        super().__init__(bounded(sentence))
        self.reason = reason


def require_newer(stamp_ns: int, last_ns: int, what: str = "sample") -> None:
    """Raise ChannelError, reason "order", if a stamp is not newer than the last stamp.

    `what` names the sample.
    """
    if stamp_ns <= last_ns:
        raise ChannelError(
            SampleFault.ORDER,
            f"{what}: stamp {seconds(last_ns - stamp_ns):g} s before the last one",
        )


def require_not_future(stamp_ns: int, now_ns: int, max_age_ns: int) -> None:
    """Raise ChannelError, reason "future", for a stamp too far ahead of the clock.

    A stamp is too far ahead if it leads by more than the age limit.
    """
    if stamp_ns > now_ns + max_age_ns:
        raise ChannelError(
            SampleFault.FUTURE, f"stamp {seconds(stamp_ns - now_ns):g} s ahead of the clock"
        )


def require_not_old(stamp_ns: int, now_ns: int, max_age_ns: int) -> None:
    """Raise ChannelError, reason "old", for a stamp behind the clock by more than the age limit."""
    if now_ns - stamp_ns > max_age_ns:
        age = (
            f"stamp {seconds(now_ns - stamp_ns):g} s old"
            if stamp_ns
            else "no stamp, expected the instant of the sample"
        )
        raise ChannelError(SampleFault.OLD, age)


def select(
    channels: Sequence[str], names: Sequence[str], values: Sequence[float] | FloatArray
) -> FloatArray:
    """Return the values of the channels, in the order of `channels`, shape (len(channels),).

    v_i = values[names.index(channels[i])]. Raises ChannelError with reason "length" if names and
    values differ in number, "name" if a channel is missing or duplicated, or "finite" if a value of
    the channels is NaN or infinite.
    """
    if len(names) != len(values):
        raise ChannelError(SampleFault.LENGTH, f"{len(names)} names for {len(values)} values")
    vector = np.asarray(values, dtype=np.float64)[_places(tuple(channels), tuple(names))]
    if not is_finite(vector):
        raise ChannelError(
            SampleFault.FINITE, f"{', '.join(channels)} = {vector.tolist()} is not finite"
        )
    return vector


def is_finite(vector: FloatArray) -> bool:
    """Return whether all values are finite. For a few values NumPy takes three times as long."""
    return all(map(math.isfinite, vector.tolist()))


def selection_matrix(channels: Sequence[str], names: Sequence[str]) -> FloatArray:
    """Return the matrix whose product with values selects the channels.

    An entry is 1 if its row of `channels` and its column of `names` are the same channel, else 0.
    """
    matrix = np.zeros((len(channels), len(names)))
    for row, channel in zip(matrix, channels, strict=True):
        row[:] = [name == channel for name in names]
    return matrix


@lru_cache(maxsize=256)
def _places(channels: tuple[str, ...], names: tuple[str, ...]) -> NDArray[np.intp]:
    """Find the indices of the channels among the names. Raises ChannelError as `select` does."""
    for name in channels:
        if names.count(name) != 1:
            raise ChannelError(
                SampleFault.NAME,
                f"channel {name} expected once among {', '.join(names) or 'no names'}",
            )
    return np.array([names.index(name) for name in channels], dtype=np.intp)
