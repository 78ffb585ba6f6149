# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Decide whether a flight that ends on the ground is a landing or a crash."""

import math

from flight_core.outcome import End, FlightEnded
from flight_core.rates import seconds
from flight_core.units import FOOT

SOFT = 7.0 * FOOT
"""Largest sink of a landing, m/s: the least descent velocity for which a landing gear must be
built, 14 CFR 23.473(d), 7 ft/s."""

LEVEL = math.radians(22.0)
"""Largest bank of a landing, rad, if there is no model of the gear. At 22 deg, the tip of a low
wing touches the ground, if the wing reaches 2.5 m to the side per metre of its height."""


def touch(title: str, t_ns: int, sink: float, *, is_on_wheels: bool) -> FlightEnded:
    """Return how a flight ends that touches the ground at t with the sink rate `sink`, m/s.

    The aircraft has landed if it is on its wheels and the sink rate is at most SOFT. Otherwise it
    has hit the ground. `title` names the aircraft in the sentence.
    """
    has_landed = is_on_wheels and sink <= SOFT
    verb = "landed" if has_landed else "hit the ground"
    sentence = f"{title} {verb} at t = {seconds(t_ns):.2f} s, with a sink of {sink:.2f} m/s"
    return FlightEnded(sentence, End.LANDED if has_landed else End.ENDED_EARLY)
