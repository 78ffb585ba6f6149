# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Define the modes of the controller.

The controller publishes its mode in `internals`, where guidance, the log and the page read it.
"""

from enum import IntEnum


class Mode(IntEnum):
    """Mode of the controller, which is published as a number in `internals`."""

    WAITING = 0  # no y or no y_m has been received yet, and nothing is commanded
    ENGAGED = 1  # the law commands u
    HOLD = 2  # failsafe: y or y_m is stale, u is held and nothing is integrated
    RAMP = 3  # failsafe: y or y_m is stale for longer than the hold time, and u ramps to trim
    TRIM = 4  # failsafe: u is at trim
    INACTIVE = 5  # deactivated: u is held or ramps to trim
