# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""The names of the channels that several nodes share, as listed in docs/topics.md."""

from collections.abc import Sequence

from flight_core.outcome import Refusal

RATES_AND_SPEED = ("q", "V", "p", "r")
"""Channels of y, y_m and u_m in a guided flight. The rates q, p and r are in rad/s in body axes. V
is the deviation of the airspeed from trim, m/s."""

WITHOUT_RUDDER = RATES_AND_SPEED[:3]
"""The channels of an aircraft without rudder, such as a flying wing, whose r follows from the
bank."""

VERTICAL = {"vertical_speed": 1.0, "w": -1.0}
"""A multicopter has one of these channels in place of V. The value is the rate of climb, m/s, if
the channel is 1 m/s."""


def vertical(names: Sequence[str]) -> str:
    """Return the name of the vertical speed among `names`.

    Returns "" for an airplane, which has none.
    """
    return next((name for name in names if name in VERTICAL), "")


ATTITUDE = ("phi", "theta")
"""Channels of u_m after the commands: the bank, and the pitch minus the pitch of level flight, rad.
The reference model only uses them when u_m ends."""

AGE_OF_U = {"mean": "age of u mean (s)", "max": "age of u max (s)"}
"""Keys in the diagnostics of the aircraft, by the statistic of the ages of u since the last
report."""

SIDES = ("down", "up")
"""Beginnings of the channels of `authority`. For example, down.V and up.V are the rates, units/s,
at which the input can at least decrease and increase V."""

UNKNOWN = 1e9
"""Value of `authority` for an output without a model learned in flight, and of `effects` for an
input that is not probed."""

LEAST_EFFECT = 0.4
"""An input counts as stuck if it has less than this fraction of its effect at trim. A healthy
surface still has 0.44 at two thirds of the trim speed."""


def reason_against_inputs(names: Sequence[str], effects: Sequence[float]) -> Refusal | None:
    """Return a refusal of the inputs whose measured effect is below LEAST_EFFECT.

    `effects` are the values of a sample of the topic `effects`, one for each of the inputs `names`.
    Each is a fraction of the input's effect at trim. Returns None if there is no such input.
    """
    stuck = [
        f"{name} does not answer the probe: it has at most {100.0 * effect:.0f} % of its effect"
        for name, effect in zip(names, effects, strict=True)
        if effect < LEAST_EFFECT
    ]
    return Refusal("; ".join(stuck)) if stuck else None


POSE = ("phi", "theta", "psi", "north", "east", "altitude", "v_north", "v_east", "climb", "beta")
"""Channels of `pose`. They are the attitude, rad, of the body axes FRD in NED, with psi from true
north in (-pi, pi], the position, m, the velocity over ground, m/s, and the sideslip, rad. The
sideslip counts as 0 if it is not measured."""
