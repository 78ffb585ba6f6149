# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Failsafe for a stale input: hold the last value, then ramp to trim."""


def failsafe_scale(silence_ns: int, hold_ns: int, ramp_ns: int) -> float:
    """Compute the factor s of the failsafe input u = s u_last, where u is the deviation from trim.

    `silence_ns` is the time since the last sample. s is 1 for `hold_ns`, then falls linearly to 0
    within `ramp_ns`. If `ramp_ns` is 0, s falls to 0 in a step.
    """
    if silence_ns <= hold_ns:
        return 1.0
    if silence_ns >= hold_ns + ramp_ns:
        return 0.0
    return 1.0 - (silence_ns - hold_ns) / ramp_ns
