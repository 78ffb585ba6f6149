# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""The result of a flight in numbers: what `summary.json` and the table hold."""

import math
from typing import Any, NamedTuple

from flight_analysis.metrics import error_table, known_error, tick_figures
from flight_analysis.scenario import Scenario
from flight_core.parameters import require
from flight_core.rates import period_ns
from flight_core.tape import Tape
from flight_core.units import SI_PER_UNIT

PART_NAMES = ("whole", "calm", "gust")


class Shown(NamedTuple):
    """A unit for people: value_shown = value_SI * factor."""

    unit: str
    factor: float


def shown_units(scenario: Scenario) -> dict[str, Shown]:
    """Units for tables and pictures by channel of y and u: angular rates in mrad/s, inputs as the airframe file has them."""
    channels = scenario.aircraft.channels()
    units = {
        name: Shown("mrad/s", 1e3) if unit == "rad/s" else Shown(unit, 1.0 / SI_PER_UNIT[unit])
        for name, unit in channels.outputs.items()
    }
    return units | {name: Shown(unit, 1.0 / SI_PER_UNIT[unit]) for name, unit in channels.inputs.items()}


def summarise(scenario: Scenario, tape: Tape, outcome: str) -> dict[str, Any]:
    """Outcome, duration flown, errors (which, and by channel and part of the flight, SI), ticks, notes; ready for JSON."""
    for topic in ("y", "y_m"):
        require(topic in tape, "the log", f"no sample of {topic}", "a flight with y and y_m")
    errors = error_table(tape, scenario.gust_windows())
    ticks = tick_figures(tape, period_ns(scenario.controller.rate, "controller.rate")) if "internals" in tape else None
    flown = float(tape.time("y")[-1]) if len(tape["y"].stamp_ns) else 0.0
    return {
        "scenario": scenario.name,
        "outcome": outcome,
        "duration": flown,
        "error": known_error(tape)[0],
        "errors": {
            channel: {
                part: {key: _number(value) for key, value in figures._asdict().items()} for part, figures in parts.items()
            }
            for channel, parts in errors.items()
        },
        "ticks": ticks._asdict() if ticks is not None else None,
        "notes": list(tape.notes),
    }


def error_rows(summary: dict[str, Any], units: dict[str, Shown]) -> list[list[str]]:
    """Rows of the error table for people: channel with unit, then rms and max of each of PART_NAMES; "-" for no figure."""
    rows = []
    for channel, figures in summary["errors"].items():
        unit, factor = units[channel]
        values = [figures[part][key] for part in PART_NAMES for key in ("rms", "max")]
        rows.append([f"{channel} ({unit})", *("-" if value is None else f"{value * factor:.3g}" for value in values)])
    return rows


def _number(value: float) -> float | None:
    # JSON has no NaN: a part of the flight without a sample has no figure.
    return None if math.isnan(value) else value
