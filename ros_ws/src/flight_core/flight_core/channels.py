# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Channels shared by several nodes, by name: docs/topics.md."""

from collections.abc import Sequence

from flight_core.outcome import Refusal

RATES_AND_SPEED = ("q", "V", "p", "r")
"""Channels of y, y_m and u_m in a guided flight: rad/s in body axes, and m/s from trim."""

WITHOUT_RUDDER = RATES_AND_SPEED[:3]
"""The same for an aircraft without rudder, such as a flying wing, whose r follows the bank."""

VERTICAL = {"vertical_speed": 1.0, "w": -1.0}
"""Channels that a multicopter has in place of V, with the climb, m/s, that 1 m/s of each means."""


def vertical(names: Sequence[str]) -> str:
    """Return the channel of VERTICAL among names; "" if there is none, as for an airplane."""
    return next((name for name in names if name in VERTICAL), "")


ATTITUDE = ("phi", "theta")
"""Channels of u_m beside the commands: bank, and pitch above the pitch of level flight, rad. They
only mark where u_m ends."""

SIDES = ("down", "up")
"""Beginnings of the channels of `authority`: down.V and up.V say how fast an input can at least
change V either way, units/s."""

UNKNOWN = 1e9
"""Value of `authority` for an output without a model learned in flight, and of `effects` for an
input that is not probed."""

LEAST_EFFECT = 0.4
"""Fraction of its effect below which an input counts as stuck: a healthy surface still has 0.44 at
two thirds of the trim speed."""


def reason_against_inputs(names: Sequence[str], effects: Sequence[float]) -> Refusal | None:
    """Refuse the inputs below LEAST_EFFECT in a sample of `effects`."""
    stuck = [
        f"{name} does not answer the probe: it has at most {100.0 * effect:.0f} % of its effect"
        for name, effect in zip(names, effects, strict=True)
        if effect < LEAST_EFFECT
    ]
    return Refusal("; ".join(stuck)) if stuck else None


POSE = ("phi", "theta", "psi", "north", "east", "altitude", "v_north", "v_east", "climb", "beta")
"""Channels of `pose`: attitude, rad (body FRD in NED, psi from true north in (-pi, pi]); position,
m; velocity over ground, m/s; sideslip, rad, which counts as 0 if it is not measured."""
