# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Convert rates and periods. A period is an integer in ns, so that k periods add up exactly."""

from flight_core.parameters import ParameterError, require

NANOSECONDS = 1_000_000_000


def seconds(time_ns: int) -> float:
    """Convert nanoseconds to seconds as a float, with a single rounding: t = time_ns / 1e9."""
    return time_ns / NANOSECONDS


def nanoseconds(time: float) -> int:
    """Convert seconds to the nearest whole number of nanoseconds."""
    return round(time * NANOSECONDS)


def period_ns(rate: float, key: str) -> int:
    """Return the period of a rate in Hz, ns.

    Raises ParameterError, which names `key`, if 1e9 / rate is not an integer.
    """
    period = nanoseconds(1.0 / rate)
    is_whole = abs(period * rate - NANOSECONDS) < 1e-3
    require(is_whole, key, f"{rate:g} Hz", "a rate whose period is a whole number of nanoseconds")
    return period


def divide(whole_ns: int, part_ns: int, key: str, whole_name: str) -> int:
    """Return how often a part fits into the whole.

    Raises ParameterError, which names `key`, if this is not an integer number of times.
    """
    # The test comes first, because writing the sentence takes longer than the division.
    if part_ns <= 0 or whole_ns % part_ns:
        expected = f"a whole fraction of {whole_name} ({seconds(whole_ns):g} s)"
        raise ParameterError(f"{key}: found {seconds(part_ns):g} s, expected {expected}")
    return whole_ns // part_ns
