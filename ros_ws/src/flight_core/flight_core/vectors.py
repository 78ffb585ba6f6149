# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Named vectors: values travel with their channel names and are matched by name, never by place."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import array_api_compat
import numpy as np
from numpy.typing import NDArray

NUMPY: Any = np  # NumPy 2 has the array API itself
if not hasattr(np, "concat"):
    import array_api_compat.numpy  # loads all of NumPy, 0.1 s

    NUMPY = array_api_compat.numpy

FloatArray = NDArray[np.float64]
Array = Any  # an array of whichever array namespace the caller flies with: NumPy, JAX


def array_namespace(array: Array) -> Any:
    """The array namespace of an array.

    NumPy's at once, for most of the time of a step of a few small arrays would go into looking what else it could be.
    """
    return NUMPY if isinstance(array, (np.ndarray, np.generic)) else array_api_compat.array_namespace(array)


class StampedVector(NamedTuple):
    """The values of a sample, shape (m,), the instant to which they belong, and the publisher that sent them."""

    stamp_ns: int
    value: FloatArray
    sender: str = ""  # empty where the sample was not received


class ChannelError(ValueError):
    """A sample that cannot be used: `reason` is a short word for counters, the message a sentence."""

    def __init__(self, reason: str, sentence: str) -> None:
        super().__init__(sentence)
        self.reason = reason


def select(wanted: Sequence[str], names: Sequence[str], values: Sequence[float] | FloatArray) -> FloatArray:
    """Values of the wanted channels, in the wanted order: v_i = values[names.index(wanted_i)], shape (len(wanted),).

    Raises ChannelError with reason "length" (names and values differ in number), "name" (a wanted channel is missing or
    stands twice) or "finite" (a wanted value is NaN or infinite).
    """
    if len(names) != len(values):
        raise ChannelError("length", f"{len(names)} names for {len(values)} values")
    if list(names) == list(wanted):
        selected = np.array(values, dtype=np.float64)
    else:
        for name in wanted:
            if list(names).count(name) != 1:
                raise ChannelError("name", f"channel {name} expected once among {', '.join(names) or 'no names'}")
        selected = np.array([values[list(names).index(name)] for name in wanted], dtype=np.float64)
    if not np.isfinite(selected).all():
        raise ChannelError("finite", f"{', '.join(wanted)} = {selected.tolist()} is not finite")
    return selected
