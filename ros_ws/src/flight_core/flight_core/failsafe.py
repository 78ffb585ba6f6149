# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""What is done with an input whose source has gone silent: hold it for a while, then let it go to trim."""


def failsafe_scale(silence_ns: int, hold_ns: int, ramp_ns: int) -> float:
    """Share of the last input that is still commanded after a silence: 1 up to hold, then linear to 0 over ramp.

    u = u_last fade, u being the deviation from trim. With ramp 0 it drops at once.
    """
    if silence_ns <= hold_ns:
        return 1.0
    if silence_ns >= hold_ns + ramp_ns:
        return 0.0
    return 1.0 - (silence_ns - hold_ns) / ramp_ns
