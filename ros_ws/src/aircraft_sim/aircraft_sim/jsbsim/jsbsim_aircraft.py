# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Define aircraft of JSBSim: names, tables of channels, flight condition, wind.

JSBSim is imported when it is first used. It works in feet, with commands that are normalised from
stop to stop. u, y and truth are deviations from trim in SI. Only the tables INPUTS and STATES
convert between JSBSim and these signals, with units and signs.
"""

import difflib
import math
import os
import re
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import NamedTuple
from xml.etree import ElementTree

from aircraft_sim.airframes.airframe import Unit
from aircraft_sim.atmosphere.disturbance import Gusts
from aircraft_sim.atmosphere.turbulence import Turbulence
from aircraft_sim.atmosphere.wind_field import RelativeWind
from flight_core.parameters import ParameterError, require
from flight_core.units import FOOT
from flight_core.vectors import FloatArray

# Prefix of `airframe` in a scenario for an aircraft of JSBSim, as in jsbsim:c172p.
PREFIX = "jsbsim:"
# Environment variable: a folder with aircraft, engine and systems that replaces the package's.
ROOT_VARIABLE = "JSBSIM_ROOT"
# Suffix of the file of a model.
SUFFIX = ".xml"
MODEL_ELEMENT = "fdm_config"


class Command(NamedTuple):
    """An input of the aircraft: a command of JSBSim that is normalised from stop to stop."""

    property: str
    # property of the trim, which JSBSim adds to `property` before it limits the sum; None without
    # one
    trim_property: str | None
    lower: float  # end stops of the whole command
    upper: float
    is_per_engine: bool
    positive: str  # the effect of a positive value in models that follow JSBSim's sign convention
    # properties named by the user, in place of `property` and `trim_property`; empty if none are
    named: "NamedProperties" = ()


NamedProperties = tuple[tuple[str, float], ...]
"""Properties of a model for an input, with the value of each at the command 1.

For the rudder of a `FlightCondition`, () means that the model has no rudder."""

NONE = "none"  # in place of the rudder's properties: the model has no rudder


# A property outside of JSBSim's settings, as a pattern.
PROPERTY = re.compile(r"(?!simulation/)[A-Za-z][\w-]*(\[\d+\])?(/[A-Za-z][\w-]*(\[\d+\])?)+")


def named_properties(
    commands: Mapping[str, str], key: str
) -> tuple[tuple[str, NamedProperties], ...]:
    """Read the properties that the user names for inputs.

    `commands` has a text for each input, such as "fcs/cmdAilR_rad=0.5 fcs/cmdAilL_rad=-0.5". The
    number is the value of the property at the command 1, and 1 if it is left out. "none" for the
    rudder stands for a model without a rudder. Raises ParameterError for an unknown input, for
    anything that is no property of an aircraft, and for the value 0.
    """
    properties = list[tuple[str, NamedProperties]]()
    for name, text in commands.items():
        require(name in INPUTS, key, repr(name), f"an input: {', '.join(INPUTS)}")
        paths = []
        if (name, text.strip()) == ("rudder", NONE):
            properties.append((name, ()))
            continue
        for word in text.split():
            path, _, number = word.partition("=")
            at_one = _number(number or "1")
            fits = PROPERTY.fullmatch(path) is not None and math.isfinite(at_one) and at_one != 0.0
            require(
                fits,
                f"{key}.{name}",
                repr(word),
                "PROPERTY=VALUE of the aircraft, as fcs/cmdElev_rad=0.5",
            )
            paths.append((path, at_one))
        require(bool(paths), f"{key}.{name}", repr(text), "a property of the aircraft")
        properties.append((name, tuple(paths)))
    return tuple(properties)


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return math.nan


class JsbsimQuantity(NamedTuple):
    """A quantity of JSBSim: its property, and the factor that converts its unit to SI."""

    property: str
    si: float
    unit: Unit | None  # display unit if the quantity is an output; None for other states


INPUTS: Mapping[str, Command] = {
    "elevator": Command(
        property="fcs/elevator-cmd-norm",
        trim_property="fcs/pitch-trim-cmd-norm",
        lower=-1.0,
        upper=1.0,
        is_per_engine=False,
        positive="nose down",
    ),
    "throttle": Command(
        property="fcs/throttle-cmd-norm",
        trim_property=None,
        lower=0.0,
        upper=1.0,
        is_per_engine=True,
        positive="more thrust",
    ),
    "aileron": Command(
        property="fcs/aileron-cmd-norm",
        trim_property="fcs/roll-trim-cmd-norm",
        lower=-1.0,
        upper=1.0,
        is_per_engine=False,
        positive="roll right",
    ),
    "rudder": Command(
        property="fcs/rudder-cmd-norm",
        trim_property="fcs/yaw-trim-cmd-norm",
        lower=-1.0,
        upper=1.0,
        is_per_engine=False,
        positive="nose left",
    ),
}

STATES: Mapping[str, JsbsimQuantity] = {
    "q": JsbsimQuantity("velocities/q-rad_sec", 1.0, "rad/s"),  # FRD body axes, positive nose up
    "V": JsbsimQuantity("velocities/vt-fps", FOOT, "m/s"),  # true airspeed
    "p": JsbsimQuantity("velocities/p-rad_sec", 1.0, "rad/s"),  # positive roll right
    "r": JsbsimQuantity("velocities/r-rad_sec", 1.0, "rad/s"),  # positive nose right
    "alpha": JsbsimQuantity("aero/alpha-rad", 1.0, None),
    "theta": JsbsimQuantity("attitude/theta-rad", 1.0, None),
    "beta": JsbsimQuantity("aero/beta-rad", 1.0, None),
    "phi": JsbsimQuantity("attitude/phi-rad", 1.0, None),
    "altitude": JsbsimQuantity("position/h-sl-ft", FOOT, None),
}
"""States x.* of `truth`, deviations from trim: first the outputs in the order of y, then the
rest."""

OUTPUTS: Mapping[str, Unit] = {
    name: quantity.unit for name, quantity in STATES.items() if quantity.unit is not None
}

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
    """The flight condition in which an aircraft of JSBSim is trimmed.

    The flight is level and straight, heading north, with gear up, engines running and no wind.
    """

    name: str  # name of the aircraft without PREFIX, or the absolute path of its model
    speed: float  # true airspeed, m/s
    altitude: float  # above sea level, m
    step_ns: int  # integration step
    named: tuple[tuple[str, NamedProperties], ...] = ()  # properties that the user names, by input

    @property
    def title(self) -> str:
        """Name of the aircraft in messages, which begins with PREFIX."""
        return f"{PREFIX}{self.name}"

    def commands(self) -> dict[str, Command]:
        """Return the commands in INPUTS, with properties that the user names in their place."""
        properties = dict(self.named)
        return {
            name: command._replace(trim_property=None, named=properties[name])
            if properties.get(name)
            else command
            for name, command in INPUTS.items()
        }

    def inputs(self) -> tuple[str, ...]:
        """Return the names of the inputs in the order of INPUTS, without a missing rudder."""
        return tuple(INPUTS)[:-1] if ("rudder", ()) in self.named else tuple(INPUTS)

    def paired_outputs(self) -> tuple[str, ...]:
        """Return the names of the outputs paired with `inputs`, in the order of OUTPUTS."""
        return tuple(OUTPUTS)[: len(self.inputs())]


class Trim(NamedTuple):
    """The commands and states of a trimmed flight condition."""

    commands: FloatArray  # (4,) whole commands in the order of INPUTS
    lower: FloatArray  # (4,) lower end stops as deviations from the trim commands
    upper: FloatArray  # (4,) upper end stops as deviations from the trim commands
    states: FloatArray  # (9,) in the order of STATES, SI
    residuals: FloatArray  # (6,) remaining accelerations in the order of RESIDUALS, SI


class WindModel(NamedTuple):
    """The sources of the wind on an aircraft of JSBSim, each along the AXES of `disturbance`."""

    gusts: Gusts
    turbulence: Turbulence | None  # filters for one step; None without turbulence
    over_place: RelativeWind | None = None  # None if the wind is the same everywhere


@cache
def aircraft_names() -> tuple[str, ...]:
    """Return the names of JSBSim's aircraft. Raises ParameterError if JSBSim is not installed."""
    return tuple(
        sorted(
            path.parent.name
            for path in (root() / "aircraft").glob("*/*.xml")
            if path.stem == path.parent.name
        )
    )


def root() -> Path:
    """Return the folder that contains JSBSim's folders aircraft, engine and systems.

    It is $JSBSIM_ROOT, or the folder in the package jsbsim. Raises ParameterError if JSBSim is not
    installed, or if $JSBSIM_ROOT is no such folder.
    """
    try:
        import jsbsim  # noqa: PLC0415 - other aircraft fly without it
    except ModuleNotFoundError:
        raise ParameterError(
            "airframe: the Python package jsbsim is not installed: an aircraft of JSBSim needs it"
        ) from None
    root_folder = os.environ.get(ROOT_VARIABLE)
    if not root_folder:
        return Path(jsbsim.get_default_root_dir())
    folder = Path(root_folder).expanduser().absolute()
    parts = ("aircraft", "engine")
    require(
        all((folder / part).is_dir() for part in parts),
        ROOT_VARIABLE,
        root_folder,
        f"a folder with {' and '.join(parts)}",
    )
    return folder


def require_aircraft(airframe: str) -> str:
    """Return the name in "jsbsim:NAME", or the absolute path of the model in "jsbsim:PATH".

    PATH is the XML file of a model, or its folder. A text with a "/", or that ends with ".xml", is
    taken as a PATH. Raises ParameterError if there is no such aircraft. For an unknown name, the
    message has the closest known name. For a path, it says what is there.
    """
    name = airframe.removeprefix(PREFIX)
    if "/" in name or name.endswith(SUFFIX):
        return str(_model_file(Path(name).expanduser().absolute(), airframe))
    near = difflib.get_close_matches(name, aircraft_names(), n=1, cutoff=0.4)
    form = f"{PREFIX}PATH with a /, the XML file or the folder of your own"
    near = [f"./{name}"] if Path(name).is_dir() else near
    guess = f"{PREFIX}{near[0]} perhaps" if near else f"a name in {root() / 'aircraft'}"
    require(name in aircraft_names(), "airframe", f"{airframe!r}", f"{guess}, or {form}")
    return name


def foreign_model(name: str) -> Path | None:
    """Return the file of an aircraft's model if it does not come from the package jsbsim.

    Such a file is named by the user, or lies in $JSBSIM_ROOT. For other models the result is None.
    """
    if Path(name).is_absolute():
        return Path(name)
    return root() / "aircraft" / name / f"{name}{SUFFIX}" if os.environ.get(ROOT_VARIABLE) else None


def root_of(model: Path) -> Path:
    """Return the folder of the engines and systems of a model.

    It is $JSBSIM_ROOT, the ROOT in ROOT/aircraft/NAME/NAME.xml, or the folder of the package.
    JSBSim looks beside the model first for files that the model names.
    """
    # The parent of the top folder is the top folder itself.
    aircraft_folder = model.parent.parent
    folder = aircraft_folder.parent
    is_tree = (
        not os.environ.get(ROOT_VARIABLE)
        and aircraft_folder.name == "aircraft"
        and (folder / "engine").is_dir()
    )
    return folder if is_tree else root()


def _model_file(path: Path, airframe: str) -> Path:
    """Find the XML file of a model from its path or its folder.

    Raises ParameterError if the file is no model, or if the folder does not have exactly one.
    """
    expected = "the XML file of an aircraft of JSBSim (fdm_config), or its folder"
    if not path.is_dir():
        require(path.is_file(), "airframe", f"{airframe!r}, where no file is", expected)
        element = _first_element(path)
        require(
            element == MODEL_ELEMENT,
            "airframe",
            f"{airframe!r}, a file with {element or 'no XML'}",
            expected,
        )
        return path
    named_file = path / f"{path.name}{SUFFIX}"
    if named_file.is_file():
        return _model_file(named_file, airframe)
    models = sorted(
        file for file in path.glob(f"*{SUFFIX}") if _first_element(file) == MODEL_ELEMENT
    )
    names = ", ".join(model.name for model in models) or "no model"
    require(
        len(models) == 1,
        "airframe",
        f"{airframe!r}, a folder with {names}",
        f"a folder with one model, or {expected}",
    )
    return models[0]


def _first_element(path: Path) -> str:
    """Read the name of the first element of an XML file, or return "" if the file is not XML."""
    try:
        _, element = next(ElementTree.iterparse(path, events=("start",)))  # noqa: S314 - no entity is in a first element
        return str(element.tag)
    except (ElementTree.ParseError, OSError, StopIteration, UnicodeError):
        return ""
