# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Compute an airframe at other airspeeds than the trim speed.

The A, B and trim of the result hold in level flight at the altitude of the given airframe. The
entries of A and B follow powers of the airspeed, and the trim is integrated over the airspeed.
"""

from collections.abc import Mapping
from enum import Enum, auto
from typing import NamedTuple

import numpy as np

from aircraft_sim.airframes.airframe import Airframe
from aircraft_sim.atmosphere.disturbance import ROTARY
from aircraft_sim.plant.plant import OverAirspeed
from flight_core.parameters import require
from flight_core.vectors import FloatArray


class Kind(Enum):
    """The physical kind of a state. The exponents of its row and of its column depend on it."""

    SPEED = auto()
    INCIDENCE = auto()  # alpha or beta
    RATE = auto()
    ANGLE = auto()  # of the attitude


STATES: Mapping[str, Kind] = {
    "V": Kind.SPEED,
    "alpha": Kind.INCIDENCE,
    "beta": Kind.INCIDENCE,
    **dict.fromkeys(("p", "q", "r"), Kind.RATE),
    **dict.fromkeys(("theta", "phi", "psi"), Kind.ANGLE),
}
"""Kinds of the states whose exponents are known, by name."""

EXPONENTS: Mapping[Kind, Mapping[Kind, float]] = {
    Kind.SPEED: {Kind.SPEED: 1.0, Kind.INCIDENCE: 2.0, Kind.RATE: 1.0, Kind.ANGLE: 0.0},
    Kind.INCIDENCE: {Kind.SPEED: -2.0, Kind.INCIDENCE: 1.0, Kind.RATE: 0.0, Kind.ANGLE: -1.0},
    Kind.RATE: {Kind.SPEED: 1.0, Kind.INCIDENCE: 2.0, Kind.RATE: 1.0, Kind.ANGLE: 0.0},
    Kind.ANGLE: {Kind.SPEED: 0.0, Kind.INCIDENCE: 0.0, Kind.RATE: 0.0, Kind.ANGLE: 0.0},
}
"""Exponents of the ratio of airspeeds in an entry of A, by the kinds of its row and column.

In level flight alpha_dot = q - L / (m V) + g / V. In each trim the lift L equals the weight, and
around this trim it grows with V^2. A[alpha,V] is therefore -2 g / V^2.
"""

# Exponents in the column of B that belongs to a surface, and in the one that belongs to the thrust,
# by the kind of the row.
OF_SURFACE = {Kind.SPEED: 2.0, Kind.INCIDENCE: 1.0, Kind.RATE: 2.0, Kind.ANGLE: 0.0}
OF_THRUST = {Kind.SPEED: 0.0, Kind.INCIDENCE: -1.0, Kind.RATE: 0.0, Kind.ANGLE: 0.0}

WIND_STATE = {
    "longitudinal": Kind.SPEED,
    "lateral": Kind.INCIDENCE,
    "vertical": Kind.INCIDENCE,
    **dict.fromkeys(ROTARY, Kind.RATE),
}
"""Kind of the state, relative to the air, that wind along an axis changes."""

TRIM_STEPS = 20  # steps of the airspeed: the trim at 1.4 V0 is then exact to 1e-4 of its value
# V / V0 at which a simulated aircraft has trims; between them the trim is interpolated linearly
SLOWEST = 0.5
FASTEST = 2.0
SPACING = 0.05


class Exponents(NamedTuple):
    """Exponents by which the entries of an airframe's SI matrices follow the ratio of airspeeds."""

    A: FloatArray  # (n, n)
    B: FloatArray  # (n, p)
    gravity: FloatArray  # (n, n)
    wind: FloatArray  # (n, G)


def exponents(airframe: Airframe, thrust: str) -> Exponents:
    """Return the exponents for an airframe. `thrust` is the name of its input for the thrust.

    Raises ParameterError for a state whose exponents are not known.
    """
    unknown = [name for name in airframe.states if name not in STATES]
    require(
        not unknown,
        f"airframe {airframe.name}",
        f"the states {', '.join(unknown)}",
        f"some of {', '.join(STATES)}",
    )
    kinds = [STATES[name] for name in airframe.states]
    n = len(kinds)
    axes = [WIND_STATE[axis] for axis in airframe.gusts]
    effects = [OF_THRUST if name == thrust else OF_SURFACE for name in airframe.inputs]
    A = np.zeros((n, n))
    B = np.zeros((n, len(effects)))
    gravity = np.zeros((n, n))
    wind = np.zeros((n, len(axes)))
    for i, row in enumerate(kinds):
        A[i] = [EXPONENTS[row][column] for column in kinds]
        B[i] = [effect[row] for effect in effects]
        gravity[i] = EXPONENTS[row][Kind.ANGLE]
        wind[i] = [EXPONENTS[row][kind] - float(kind is Kind.INCIDENCE) for kind in axes]
    return Exponents(A, B, gravity, wind)


def at_speed(airframe: Airframe, ratio: float, thrust: str) -> Airframe:
    """Return an airframe at `ratio` times its trim speed V0, with the same states and units.

    Moments caused by an angle of incidence or by a surface grow with V^2, and dampings with V. The
    effect of a force on an angle of incidence is proportional to the force over V. The forces of
    thrust and gravity stay the same, and so does lift, which equals the weight. Every entry is
    scaled by a power of the ratio: EXPONENTS, OF_SURFACE, and OF_THRUST for the input `thrust`.
    Wind acts through the new A. The derivatives are taken as independent of the Mach number and of
    C_L, although C_L changes with V. Source: B. L. Stevens, F. L. Lewis, "Aircraft Control and
    Simulation", 2.6, dimensional derivatives. Raises as `exponents` does.
    """
    powers = exponents(airframe, thrust)
    wind = ratio ** (powers.wind + 1.0)  # the file gives the effect of wind per w / V0
    airframe_at_speed = airframe.with_matrices(
        airframe.matrix_a() * ratio**powers.A, airframe.matrix_b() * ratio**powers.B, wind
    )
    gravity = [
        {**term.model_dump(), "gain": term.gain * ratio ** EXPONENTS[STATES[term.into]][Kind.ANGLE]}
        for term in airframe.gravity
    ]
    changes = {"speed": ratio * airframe.speed, "gravity": gravity}
    return type(airframe).validate_mapping(
        airframe_at_speed.model_dump() | changes, f"airframe {airframe.name}"
    )


def level_flight(airframe: Airframe, ratio: float, thrust: str) -> tuple[FloatArray, FloatArray]:
    """Return how the trim changes from V0 to `ratio` times V0: dx, (n,), and du, (p,), SI.

        (A + gravity) dx + B du = 0

    The equation is solved by least squares. In level flight dx consists of the step dV and of
    dalpha = dtheta, and the other states keep their values. The airspeed changes in TRIM_STEPS
    steps. Each step takes A, gravity and B at its middle airspeed. If several inputs can keep the
    trim, each step takes the smallest (dalpha, du). Raises as `exponents` does.
    """
    names = list(airframe.states)
    powers = exponents(airframe, thrust)
    width = (ratio - 1.0) / TRIM_STEPS
    A = airframe.matrix_a()
    gravity = airframe.matrix_gravity()
    B = airframe.matrix_b()
    along_v = np.array([float(name == "V") for name in names])
    along_pitch = np.array([float(name in ("alpha", "theta")) for name in names])
    x = np.zeros(len(names))
    u = np.zeros(B.shape[1])
    for k in range(TRIM_STEPS):
        middle = 1.0 + width * (k + 0.5)
        matrix = A * middle**powers.A + gravity * middle**powers.gravity
        dx = airframe.speed * width * along_v
        change = np.linalg.lstsq(
            np.column_stack([matrix @ along_pitch, B * middle**powers.B]), -matrix @ dx, rcond=None
        )[0]
        x = x + dx + change[0] * along_pitch
        u = u + change[1:]
    return x, u


def over_airspeed(airframe: Airframe, thrust: str) -> OverAirspeed:
    """Return how A, B and the trim of an airframe follow the airspeed: exponents and trims.

    Raises ParameterError as `exponents` does, for an airframe without a state V or a trim speed,
    and for a `thrust` that is no input.
    """
    require(
        "V" in airframe.states and airframe.speed > 0.0,
        "over_airspeed",
        f"{airframe.name} without a state V or a trim speed",
        "an airframe with both",
    )
    require(
        thrust in airframe.inputs,
        "over_airspeed",
        thrust,
        f"an input: {', '.join(airframe.inputs)}",
    )
    ratio = np.arange(SLOWEST, FASTEST + SPACING / 2.0, SPACING)
    trims = [level_flight(airframe, float(part), thrust) for part in ratio]
    x, u = map(np.array, zip(*trims, strict=True))
    return OverAirspeed(
        speed=airframe.speed,
        place=airframe.index("V"),
        **exponents(airframe, thrust)._asdict(),
        ratio=ratio,
        x=x,
        u=u,
    )
