# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""List what the page reads of a log: topics with their highest rates, and channels."""

import math

LEARNED = "learned"  # entries of A and B, as identified in flight
RATE = 50.0  # highest rate of most topics on the page, Hz
RATES = {
    "internals": math.inf,
    LEARNED: math.inf,
    **dict.fromkeys(("guidance", "pose", "truth", "u", "y", "y_m"), RATE),
}
"""Topics that are read, and the highest rate of each. All ticks are read, because a peak between
two drawn samples would be hidden otherwise."""

IN_TICKS = (
    "u",
    "y",
    "y_m",
)  # topics that are not read after the first tick, because the ticks contain them

GROUPS = {
    "internals": ("mode", "late", "y", "y_m", "e", "u_free", "u", "limited"),
    "truth": ("actuator", "gust", "x.phi", "x.theta"),
    "guidance": (
        "mode",
        "leg",
        "joining",
        "missed",
        "xtrack",
        "to_go",
        "phi_c",
        "theta_c",
        "climb_c",
        "V_c",
        "y",
        "limited",
        "target",
        "wind",
        "fence",
    ),
}
"""Channels and groups of channels that are kept. Topics that are not listed keep all channels."""
