# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Units and numbers of tables and figures."""

import math
from collections.abc import Mapping
from typing import NamedTuple

from flight_analysis.closed_loop.scenario import Scenario
from flight_analysis.report.guided import UNITS
from flight_core.units import si_per_unit

NO_VALUE = "-"


class DisplayUnit(NamedTuple):
    """Unit of tables and figures: displayed value = SI value * factor."""

    unit: str
    factor: float


NO_UNIT = DisplayUnit("", 1.0)  # for a channel of unknown unit: its SI value without a unit


QUANTITY_UNITS = {
    name: DisplayUnit("deg", 180.0 / math.pi) if unit == "rad" else DisplayUnit(unit, 1.0)
    for name, unit in UNITS.items()
}
"""Units of the quantities that guidance holds."""


def channel_label(name: str, units: Mapping[str, DisplayUnit]) -> str:
    """The name of a channel with the unit."""
    unit = units.get(name, NO_UNIT).unit
    return f"{name} ({unit})" if unit else name


def display_unit(unit: str) -> DisplayUnit:
    """The display unit of a unit of the airframe file: mrad/s for rad/s, otherwise the same
    unit.
    """
    return (
        DisplayUnit("mrad/s", 1e3)
        if unit == "rad/s"
        else DisplayUnit(unit, 1.0 / si_per_unit(unit))
    )


def display_units(scenario: Scenario) -> dict[str, DisplayUnit]:
    """Units of tables and figures by channel of y and u."""
    channels = scenario.aircraft.channels()
    return {
        name: display_unit(unit) for name, unit in {**channels.outputs, **channels.inputs}.items()
    }


def format_value(value: float | None, factor: float = 1.0) -> str:
    """A value with three digits, or NO_VALUE."""
    return NO_VALUE if value is None else f"{value * factor:#.3g}".rstrip(".")


def format_seconds(time: float | None) -> str:
    """A time in s with a digit, or that it is not known."""
    return "an unknown time" if time is None else f"{time:.1f} s"
