# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""The result of a flight in numbers: what `summary.json` and the tables hold."""

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from flight_analysis.closed_loop.scenario import Scenario
from flight_analysis.metrics import (
    Transient,
    engagements,
    error_table,
    input_table,
    known_error,
    latency_figures,
    limited_shares,
    live_commands,
    noise_floor,
    settled,
    settling_bands,
    sign_switches,
    tick_figures,
)
from flight_core.parameters import require
from flight_core.rates import period_ns
from flight_core.tape import Tape
from flight_core.units import SI_PER_UNIT

NONE = "-"  # where there is no figure


class DisplayUnit(NamedTuple):
    """A unit for people: value_shown = value_SI * factor."""

    unit: str
    factor: float


PLAIN = DisplayUnit("", 1.0)
"""That of a channel whose unit is not known: SI, and none is said."""


def titled(name: str, units: Mapping[str, DisplayUnit]) -> str:
    """The name of a channel with its unit."""
    unit = units.get(name, PLAIN).unit
    return f"{name} ({unit})" if unit else name


def display_units(scenario: Scenario) -> dict[str, DisplayUnit]:
    """Units for tables and pictures by channel of y and u: angular rates in mrad/s, inputs as the airframe file has them."""
    channels = scenario.aircraft.channels()
    units = {
        name: DisplayUnit("mrad/s", 1e3) if unit == "rad/s" else DisplayUnit(unit, 1.0 / SI_PER_UNIT[unit])
        for name, unit in channels.outputs.items()
    }
    return units | {name: DisplayUnit(unit, 1.0 / SI_PER_UNIT[unit]) for name, unit in channels.inputs.items()}


def commanded(scenario: Scenario) -> list[Transient]:
    """The edges of the scenario's pulses, in the order of time."""
    profile = scenario.reference_model.profile()
    edges = [
        Transient("command", name, float(time), float(time + profile.rise))
        for name, times, changes in zip(scenario.reference_model.outputs, profile.time, profile.change, strict=True)
        for time, change in zip(times, changes, strict=True)
        if change != 0.0
    ]
    return sorted(edges, key=lambda edge: edge.start)


def transients(scenario: Scenario, tape: Tape) -> list[Transient]:
    """Engagements, commands and gusts: the scenario's commands up to the first live one, then those."""
    live = live_commands(tape)
    until = float(tape.time("u_m")[0]) if live else math.inf
    gusts = [Transient("gust", name, *window) for name, window in scenario.gust_windows().items()]
    return [*engagements(tape), *(edge for edge in commanded(scenario) if edge.start < until), *live, *gusts]


def summarise(scenario: Scenario, tape: Tape, outcome: str) -> dict[str, Any]:
    """All figures of a flight, SI, ready for JSON: docs/interfaces.md, Figures, says what each key means."""
    for topic in ("y", "y_m"):
        require(topic in tape, "the log", f"no sample of {topic}", "a flight with y and y_m")
    happened = transients(scenario, tape)
    came_of = settled(tape, happened)
    ticks = tick_figures(tape, period_ns(scenario.controller.rate, "controller.rate")) if "internals" in tape else None
    latency = latency_figures(tape)
    summary = {
        "scenario": scenario.name,
        "outcome": outcome,
        "duration": float(tape.time("y")[-1]) if len(tape["y"].stamp_ns) else 0.0,
        "error": known_error(tape)[0],
        "errors": _errors(tape, happened),
        "inputs": _inputs(tape, happened),
        "transients": [one.transient._asdict() | {"until": one.until, "settling": one.time} for one in came_of],
        "ticks": None if ticks is None or not np.isfinite(ticks).all() else ticks._asdict(),
        "latency": None if latency is None or not np.isfinite(latency).all() else latency._asdict(),
        "notes": list(tape.notes),
    }
    return {key: _known(value) for key, value in summary.items()}


def summarise_unflown(scenario: Scenario, outcome: str) -> dict[str, Any]:
    """The summary of a flight that ended before its first sample."""
    return {
        "scenario": scenario.name,
        "outcome": outcome,
        "duration": 0.0,
        "error": None,
        "errors": {},
        "inputs": {},
        "transients": [],
        "ticks": None,
        "latency": None,
        "notes": [],
    }


def _errors(tape: Tape, happened: Sequence[Transient]) -> dict[str, Any]:
    bands, floors, switches = settling_bands(tape), noise_floor(tape), sign_switches(tape)
    return {
        channel: {part: figures._asdict() for part, figures in parts.items()}
        | {"bound": parts["calm"].max, "band": bands[channel], "floor": floors[channel]}
        | {"sign_switches": switches.get(channel)}
        for channel, parts in error_table(tape, happened).items()
    }


def _inputs(tape: Tape, happened: Sequence[Transient]) -> dict[str, Any]:
    limited = limited_shares(tape)
    return {
        name: {part: figures._asdict() for part, figures in parts.items()} | {"limited": limited.get(name)}
        for name, parts in input_table(tape, happened).items()
    }


def _known(value: Any) -> Any:
    # JSON has no NaN and no infinity: a part of the flight without a sample has no figure, nor has one with values beyond all.
    if isinstance(value, Mapping):
        return {key: _known(one) for key, one in value.items()}
    if isinstance(value, list | tuple):
        return [_known(one) for one in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


class Column(NamedTuple):
    """A column of a table for people: its head, above it what the columns share that have it, and the path of its figure."""

    group: str
    head: str
    path: tuple[str, ...]
    scaled: bool = True  # in the unit of its row


ERROR_COLUMNS = (
    Column("rms", "whole", ("whole", "rms")),
    Column("rms", "calm", ("calm", "rms")),
    Column("rms", "command", ("command", "rms")),
    Column("rms", "gust", ("gust", "rms")),
    Column("max", "command", ("command", "max")),
    Column("max", "gust", ("gust", "max")),
    Column("", "bound", ("bound",)),
)
"""What every table of errors shows."""

SWITCHES = Column("", "switches (1/s)", ("sign_switches",), scaled=False)

MORE_ERROR_COLUMNS = (Column("", "floor", ("floor",)), SWITCHES)
"""What the report shows of them beside it."""

INPUT_COLUMNS = (
    Column("rms", "whole", ("whole", "rms")),
    Column("rms", "calm", ("calm", "rms")),
    Column("rms", "command", ("command", "rms")),
    Column("rms", "gust", ("gust", "rms")),
    Column("", "max", ("whole", "max")),
    Column("rate", "whole", ("whole", "rate")),
    Column("rate", "calm", ("calm", "rate")),
)
"""What every table of inputs shows, but for how long each was limited."""


def figure(summary: Mapping[str, Any], *path: str) -> float | None:
    """A figure by its path in a summary; None where the summary has none there."""
    found: Any = summary
    for key in path:
        found = found.get(key) if isinstance(found, Mapping) else None
    return found if isinstance(found, float | int) else None


def cell(value: float | None, factor: float = 1.0) -> str:
    """A figure in three digits; NONE for none."""
    return NONE if value is None else f"{value * factor:#.3g}".rstrip(".")


def table_rows(figures: Mapping[str, Any], columns: Sequence[Column], units: Mapping[str, DisplayUnit]) -> list[list[str]]:
    """Rows for people of "errors" or "inputs" of a summary: the channel with its unit, then a cell a column."""
    return [
        [
            titled(name, units),
            *(cell(figure(of, *column.path), units.get(name, PLAIN).factor if column.scaled else 1.0) for column in columns),
        ]
        for name, of in figures.items()
    ]


def limited_cell(of: Mapping[str, Any]) -> str:
    """How many ticks in a hundred an input was limited in, by its magnitude and by its rate."""
    limited = of["limited"]
    return NONE if limited is None else " / ".join(f"{100.0 * limited[kind]:.3g}" for kind in ("magnitude", "rate"))


def slowest(summary: Mapping[str, Any], channel: str, kind: str) -> str:
    """The longest settling time of a channel after transients of a kind, s; "> x" where x s were too short to settle once."""
    found: list[float] = []
    too_short: list[float] = []
    for one in summary["transients"]:
        if one["kind"] == kind and channel in one["settling"]:
            time = one["settling"][channel]
            (too_short if time is None else found).append(one["until"][channel] - one["start"] if time is None else time)
    if too_short:
        return f"> {max([*too_short, *found]):.2f}"
    return f"{max(found):.2f}" if found else NONE
