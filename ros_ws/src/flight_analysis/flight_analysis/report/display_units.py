# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Choose units and digits for tables and figures."""

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

from aircraft_sim.airframes.airframe import load_airframe
from flight_analysis.closed_loop.scenario import Scenario
from flight_analysis.report.guided import UNITS
from flight_core.units import si_per_unit

NO_VALUE = "-"


@dataclass(frozen=True, kw_only=True)
class DisplayUnit:
    """A unit of tables and figures: displayed value = SI value * factor."""

    unit: str
    factor: float


NO_UNIT = DisplayUnit(unit="", factor=1.0)  # for a channel with an unknown unit, which stays in SI
UNITLESS = DisplayUnit(unit="no unit", factor=1.0)  # an input of an imported log


QUANTITY_UNITS = {
    name: DisplayUnit(unit="deg", factor=180.0 / math.pi)
    if unit == "rad"
    else DisplayUnit(unit=unit, factor=1.0)
    for name, unit in UNITS.items()
}
"""Display units of the quantities that guidance holds."""


def channel_label(name: str, units: Mapping[str, DisplayUnit]) -> str:
    """Return the name of a channel with its unit."""
    unit = units.get(name, NO_UNIT).unit
    return f"{name} ({unit})" if unit else name


DEGREES = {"rad": "deg", "rad/s": "deg/s"}
"""Display units of angles and rates, by the unit in the airframe file."""


def display_unit(unit: str) -> DisplayUnit:
    """Return the unit in which tables and figures show a unit of the airframe file.

    Radians are shown in deg, and rad/s in deg/s. Any other unit stays.
    """
    shown = DEGREES.get(unit, unit)
    return DisplayUnit(unit=shown, factor=1.0 / si_per_unit(shown))


def display_units(scenario: Scenario) -> dict[str, DisplayUnit]:
    """Return the display unit of each channel of y and u, in the order of the controller."""
    channels = scenario.aircraft.channels()
    units = {
        name: display_unit(unit) for name, unit in {**channels.outputs, **channels.inputs}.items()
    }
    first = (*scenario.controller.outputs, *scenario.controller.inputs)
    return {name: units[name] for name in first if name in units} | units


def about_trim(scenario: Scenario) -> dict[str, str]:
    """Return the axis label of V for a figure of y, in a mapping with the key "V".

    y has the deviation from trim, so the label says that the trim speed is subtracted.
    """
    channels = scenario.aircraft.channels()
    return {"V": f"V - {channels.speed:g} (m/s)"} if "V" in channels.outputs else {}


def in_radians(units: Mapping[str, DisplayUnit]) -> dict[str, DisplayUnit]:
    """Return the units with deg replaced by rad, and deg/s by rad/s."""
    return {
        name: DisplayUnit(unit=shown.unit.replace("deg", "rad"), factor=1.0)
        if shown.unit.startswith("deg")
        else shown
        for name, shown in units.items()
    }


def plain_number(value: float, digits: int = 2) -> str:
    """Return a number as text, with at most `digits` significant digits and without an exponent.

    Examples:
        >>> plain_number(123.4), plain_number(0.0123, 1), plain_number(2.0)
        ('120', '0.01', '2')
    """
    if value == 0.0 or not math.isfinite(value):
        return f"{value:g}"
    places = digits - 1 - math.floor(math.log10(abs(value)))
    text = f"{round(value, places):.{max(places, 0)}f}"
    return text.rstrip("0").rstrip(".") if "." in text else text


def unlike_numbers(first: float, second: float) -> tuple[str, str]:
    """Return two numbers as texts, with the fewest digits that tell them apart.

    Each text has 2 to 6 digits. If 6 digits are not enough, the texts are the same.
    """
    for digits in range(2, 7):
        texts = (plain_number(first, digits), plain_number(second, digits))
        if texts[0] != texts[1]:
            break
    return texts


def aligned_numbers(first: float, second: float) -> tuple[str, str]:
    """Return two numbers as texts with the same number of decimals.

    The smaller number has two significant digits, or up to 6 if the texts would be equal with two.

    Examples:
        >>> aligned_numbers(1.0, 3.21), aligned_numbers(0.3012, 0.3021), aligned_numbers(9.0, 123.4)
        (('1.0', '3.2'), ('0.301', '0.302'), ('9.0', '123.4'))
    """
    smallest = min(abs(first), abs(second))
    exponent = math.floor(math.log10(smallest)) if 0.0 < smallest < math.inf else 0
    written = []
    for digits in range(2, 7):
        places = max(digits - 1 - exponent, 0)
        written.append((f"{first:.{places}f}", f"{second:.{places}f}"))
    return next((texts for texts in written if texts[0] != texts[1]), written[0])


STATES = {
    **dict.fromkeys(("alpha", "beta", "phi", "theta", "psi"), "rad"),
    **dict.fromkeys(("p", "q", "r"), "rad/s"),
    **dict.fromkeys(("V", "u", "v", "w", "climb"), "m/s"),
    **dict.fromkeys(("north", "east", "altitude"), "m"),
}
"""SI units of the states of an aircraft without an airframe file."""


POSE_UNITS = {
    name: display_unit(unit)
    for name, unit in {**STATES, **dict.fromkeys(("v_north", "v_east", "climb"), "m/s")}.items()
}
"""Display units of the channels of a pose."""


def state_units(scenario: Scenario) -> dict[str, DisplayUnit]:
    """Return the display units of the states of a simulated aircraft."""
    aircraft = scenario.aircraft
    states = STATES if aircraft.is_jsbsim else load_airframe(aircraft.airframe).states
    return {name: display_unit(unit) for name, unit in states.items()}


def in_order(names: Iterable[str], units: Mapping[str, DisplayUnit]) -> list[str]:
    """Sort channels in the order of `units`. Channels without a known unit come last."""
    places = {name: place for place, name in enumerate(units)}
    return sorted(names, key=lambda name: places.get(name, len(places)))


def format_value(value: float | None, factor: float = 1.0) -> str:
    """Write a value with three digits, or NO_VALUE for None."""
    return NO_VALUE if value is None else f"{value * factor:#.3g}".rstrip(".")


def format_seconds(time: float | None) -> str:
    """Write a time, s, with one digit after the point, or "an unknown time" for None."""
    return "an unknown time" if time is None else f"{time:.1f} s"
