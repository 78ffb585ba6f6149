# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Aircraft of JSBSim: names, channel tables, flight condition, wind. The import of JSBSim waits for the first use.

JSBSim uses feet and normalised commands from stop to stop. u, y and truth are deviations from trim in SI. The tables INPUTS and
STATES alone map between the two, with units and signs.
"""

import difflib
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import NamedTuple

from aircraft_sim.airframe import Unit
from aircraft_sim.disturbance import Gusts
from aircraft_sim.turbulence import Turbulence
from flight_core.parameters import ParameterError, require
from flight_core.units import FOOT
from flight_core.vectors import FloatArray

PREFIX = "jsbsim:"  # prefix of `airframe` in a scenario for an aircraft of JSBSim, as in jsbsim:c172p


class Command(NamedTuple):
    """An input: a normalised command of JSBSim, unit 1."""

    property: str
    trim_property: str | None  # the trim's own part of the command; JSBSim limits the sum of both
    lower: float  # end stops of the whole command
    upper: float
    each_engine: bool
    positive: str  # the effect of a positive value, in models that follow JSBSim's convention


class Quantity(NamedTuple):
    """A state: a property of JSBSim and the SI value of the unit."""

    property: str
    si: float
    unit: Unit | None  # the display unit of an output, None for other states


INPUTS: Mapping[str, Command] = {
    "elevator": Command("fcs/elevator-cmd-norm", "fcs/pitch-trim-cmd-norm", -1.0, 1.0, False, "nose down"),
    "throttle": Command("fcs/throttle-cmd-norm", None, 0.0, 1.0, True, "more thrust"),
    "aileron": Command("fcs/aileron-cmd-norm", "fcs/roll-trim-cmd-norm", -1.0, 1.0, False, "roll right"),
    "rudder": Command("fcs/rudder-cmd-norm", "fcs/yaw-trim-cmd-norm", -1.0, 1.0, False, "nose left"),
}

STATES: Mapping[str, Quantity] = {
    "q": Quantity("velocities/q-rad_sec", 1.0, "rad/s"),  # FRD body axes, nose up +
    "V": Quantity("velocities/vt-fps", FOOT, "m/s"),  # true airspeed
    "p": Quantity("velocities/p-rad_sec", 1.0, "rad/s"),  # roll right +
    "r": Quantity("velocities/r-rad_sec", 1.0, "rad/s"),  # nose right +
    "alpha": Quantity("aero/alpha-rad", 1.0, None),
    "theta": Quantity("attitude/theta-rad", 1.0, None),
    "beta": Quantity("aero/beta-rad", 1.0, None),
    "phi": Quantity("attitude/phi-rad", 1.0, None),
    "altitude": Quantity("position/h-sl-ft", FOOT, None),
}
"""States x.* of `truth`, deviations from trim: the outputs in the order of y, then the rest."""

OUTPUTS: Mapping[str, Unit] = {name: quantity.unit for name, quantity in STATES.items() if quantity.unit is not None}

RESIDUALS: Mapping[str, float] = {
    "udot-ft_sec2": FOOT,
    "vdot-ft_sec2": FOOT,
    "wdot-ft_sec2": FOOT,
    "pdot-rad_sec2": 1.0,
    "qdot-rad_sec2": 1.0,
    "rdot-rad_sec2": 1.0,
}
"""Accelerations that are zero in trim, with the SI value of their units."""


class FlightCondition(NamedTuple):
    """An aircraft of JSBSim in a flight condition: level, straight, gear up, engines running, heading north, no wind."""

    name: str  # of the aircraft, without PREFIX
    speed: float  # true airspeed, m/s
    altitude: float  # above sea level, m
    step_ns: int  # of the integration

    @property
    def title(self) -> str:
        """The aircraft's name in messages, with PREFIX."""
        return f"{PREFIX}{self.name}"


class Trim(NamedTuple):
    """A trimmed flight condition."""

    commands: FloatArray  # (4,) whole commands in the order of INPUTS
    lower: FloatArray  # (4,) end stops as deviations from them
    upper: FloatArray  # (4,)
    states: FloatArray  # (9,) in the order of STATES, SI
    residuals: FloatArray  # (6,) remaining accelerations in the order of RESIDUALS, SI


class WindModel(NamedTuple):
    """Wind along the AXES of `disturbance`."""

    gusts: Gusts
    turbulence: Turbulence | None  # of one step; None without turbulence


@cache
def aircraft_names() -> tuple[str, ...]:
    """Names of the aircraft of JSBSim. Raises ParameterError where JSBSim is not installed."""
    try:
        import jsbsim  # noqa: PLC0415 - other aircraft fly without it
    except ModuleNotFoundError:
        raise ParameterError("airframe: found no Python package jsbsim, expected it for an aircraft of JSBSim") from None

    library = Path(jsbsim.get_default_root_dir()) / "aircraft"
    return tuple(sorted(path.parent.name for path in library.glob("*/*.xml") if path.stem == path.parent.name))


def require_aircraft(airframe: str) -> str:
    """Name of the aircraft in "jsbsim:NAME". Raises ParameterError with the known names, the closest first."""
    name = airframe.removeprefix(PREFIX)
    near = difflib.get_close_matches(name, aircraft_names(), n=1, cutoff=0.4)
    listed = ", ".join(aircraft_names())
    require(
        name in aircraft_names(),
        "airframe",
        f"{airframe!r}",
        f"{PREFIX}{near[0]} perhaps, or {PREFIX} and another of {listed}" if near else f"{PREFIX} and one of {listed}",
    )
    return name
