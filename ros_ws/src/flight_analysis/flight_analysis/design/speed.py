# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""An airframe at another airspeed: A and B of its trim speed scaled in level flight at the same altitude."""

from collections.abc import Mapping

import numpy as np

from aircraft_sim.airframe import Airframe
from flight_core.parameters import require
from flight_core.vectors import FloatArray

SPEED, INCIDENCE, RATE, ANGLE = "speed", "incidence", "rate", "angle"
STATES: Mapping[str, str] = {
    "V": SPEED,
    "alpha": INCIDENCE,
    "beta": INCIDENCE,
    **dict.fromkeys(("p", "q", "r"), RATE),
    **dict.fromkeys(("theta", "phi", "psi"), ANGLE),
}
"""Kinds of the states whose exponents are known, by name."""

EXPONENTS: Mapping[str, Mapping[str, float]] = {
    SPEED: {SPEED: 1.0, INCIDENCE: 2.0, RATE: 1.0, ANGLE: 0.0},
    INCIDENCE: {SPEED: -2.0, INCIDENCE: 1.0, RATE: 0.0, ANGLE: -1.0},
    RATE: {SPEED: 1.0, INCIDENCE: 2.0, RATE: 1.0, ANGLE: 0.0},
    ANGLE: {SPEED: 0.0, INCIDENCE: 0.0, RATE: 0.0, ANGLE: 0.0},
}
"""Exponents of the ratio of airspeeds in the entries of A, by the kinds of row and column.

In level flight lift is weight at any speed: alpha_dot = q - L / (m V) + g / V with L of V^2 about the trim, so A[alpha,V] is
-2 g / V^2.
"""

OF_SURFACE = {SPEED: 2.0, INCIDENCE: 1.0, RATE: 2.0, ANGLE: 0.0}
OF_THRUST = {SPEED: 0.0, INCIDENCE: -1.0, RATE: 0.0, ANGLE: 0.0}
"""The same of B, by the kind of the row."""


def at_speed(airframe: Airframe, ratio: float, thrust: str) -> Airframe:
    """The airframe trimmed at `ratio` times its speed V0, shape and units as before.

    Moments by an angle of incidence or by a surface grow with V^2, dampings with V, what a force does to an angle of incidence
    with the force over V; thrust, gravity and kinematics stay, and so does lift, the weight. Every entry is scaled by a power
    of the ratio: EXPONENTS, OF_SURFACE and OF_THRUST for the input `thrust`. Wind acts by the new A. Derivatives are those of
    the trim: no Mach number, none changes with C_L. Source: B. L. Stevens, F. L. Lewis, "Aircraft Control and Simulation",
    2.6, dimensional derivatives. Raises ParameterError for a state whose exponents are not known.
    """
    unknown = [name for name in airframe.states if name not in STATES]
    require(not unknown, f"airframe {airframe.name}", f"the states {', '.join(unknown)}", f"some of {', '.join(STATES)}")
    kinds = [STATES[name] for name in airframe.states]
    of_A = ratio ** np.array([[EXPONENTS[row][column] for column in kinds] for row in kinds])
    of_B = ratio ** np.array(
        [[(OF_THRUST if name == thrust else OF_SURFACE)[row] for name in airframe.inputs] for row in kinds]
    )
    by_axis = {"longitudinal": SPEED, "lateral": INCIDENCE, "vertical": INCIDENCE}
    # the file has the effect per w / V0
    wind: FloatArray = np.array([[EXPONENTS[row][by_axis[axis]] for axis in airframe.gusts] for row in kinds])
    wind = ratio ** (wind + np.array([float(by_axis[axis] == SPEED) for axis in airframe.gusts]))
    moved = airframe.with_matrices(airframe.matrix_a() * of_A, airframe.matrix_b() * of_B, wind)
    gravity = [
        {**term.model_dump(), "gain": term.gain * ratio ** EXPONENTS[STATES[term.into]][ANGLE]} for term in airframe.gravity
    ]
    changed = {"speed": ratio * airframe.speed, "gravity": gravity}
    return type(airframe).validate_mapping(moved.model_dump() | changed, f"airframe {airframe.name}")
