# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Show a flight in the terminal.

The picture has the state, the mode, the outputs over their references, the inputs, the attitude and
the last events.
"""

import math
import time
from collections.abc import Sequence

from rich import box
from rich.console import Group, RenderableType
from rich.live import Live
from rich.table import Table
from rich.text import Text

from flight_core.rates import NANOSECONDS
from flight_view.flight import Flight
from rise_di_controller.internals import Saturation

REFRESH = 10.0  # rate at which the picture is drawn, Hz
EVENTS = 6  # number of last events that are shown
SATURATED = {float(kind): kind.name.lower() for kind in (Saturation.MAGNITUDE, Saturation.RATE)}
STYLES = {
    "recording": "bold green",
    "no data": "bold red",
    "interrupted": "bold yellow",
    "waiting": "yellow",
}


def show(flight: Flight) -> None:
    """Show a flight until its recording ends or is interrupted, or until Ctrl-C.

    Raises ParameterError as `Flight.update` does.
    """
    with Live(picture(flight), refresh_per_second=REFRESH, transient=False) as live:
        while True:
            flight.update()
            live.update(picture(flight))
            if flight.state() in {"ended", "interrupted"}:
                flight.update()
                flight.counted()
                live.update(picture(flight))
                break
            time.sleep(1.0 / REFRESH)


def picture(flight: Flight) -> RenderableType:
    """Return a picture of a flight in text, with its newest samples."""
    mode = flight.description["modes"][""].get(f"{_newest(flight, 'internals', 'mode'):.0f}", "")
    head = Text.assemble(
        (flight.name, "bold"),
        "  ",
        (flight.state().upper(), STYLES.get(flight.state(), "")),
        f"  {mode}  t = {flight.end:.1f} s",
    )
    parts: list[RenderableType] = [head, _outputs(flight), _inputs(flight)]
    if "pose" in flight.samples:
        parts.append(Text(_attitude(flight)))
    start_ns = flight.start_ns
    lines = [
        f"{(event.stamp_ns - start_ns) / NANOSECONDS:8.2f} s  {event.kind}: {event.text}"
        for event in flight.events[-EVENTS:]
    ]
    parts += [Text(line, style="dim") for line in lines]
    return Group(
        *parts, *(Text(f"note: {sentence}", style="yellow") for sentence in flight.faults())
    )


def _outputs(flight: Flight) -> Table:
    table = _table("output", "y", "y_m", "e", "band")
    for name in _names(flight, "y"):
        unit, factor = _unit(flight, name)
        values = [_newest_of(flight, group, name) for group in ("y", "y_m", "e")]
        inside = abs(values[2]) <= flight.bands.get(name, math.inf)
        cells = [_number(value * factor) for value in (*values, flight.bands.get(name, math.nan))]
        table.add_row(f"{name} {unit}", *cells, style="" if inside else "yellow")
    return table


def _inputs(flight: Flight) -> Table:
    table = _table("input", "u", "before limits", "saturated")
    for name in _names(flight, "u"):
        unit, factor = _unit(flight, name)
        values = [_newest_of(flight, group, name) * factor for group in ("u", "u_free")]
        saturated = SATURATED.get(_newest(flight, "internals", f"limited.{name}"), "")
        table.add_row(
            f"{name} {unit}", *map(_number, values), saturated, style="yellow" if saturated else ""
        )
    return table


def _attitude(flight: Flight) -> str:
    roll, pitch, heading = (
        math.degrees(_newest(flight, "pose", name)) for name in ("phi", "theta", "psi")
    )
    altitude, climb = (_newest(flight, "pose", name) for name in ("altitude", "climb"))
    # A pose may have no psi.
    heading_text = f"{round(heading) % 360:03d}" if math.isfinite(heading) else "-"
    angles = f"roll {roll:+.1f} deg, pitch {pitch:+.1f} deg, heading {heading_text} deg"
    place_text = (
        f", altitude {altitude:.1f} m, climb {climb:+.1f} m/s" if math.isfinite(altitude) else ""
    )
    return angles + place_text


def _table(first: str, *others: str) -> Table:
    table = Table(box=box.SIMPLE_HEAD, pad_edge=False)
    table.add_column(first, min_width=16)
    for name in others:
        table.add_column(name, justify="right", min_width=9)
    return table


def _names(flight: Flight, group: str) -> Sequence[str]:
    """Return the names of a group of channels.

    They come from the topic `internals`, or if the flight lacks it, from the topic of the group.
    """
    if "internals" not in flight.samples:
        return flight.samples[group].names if group in flight.samples else ()
    return [
        name.partition(".")[2]
        for name in flight.samples["internals"].names
        if name.startswith(f"{group}.")
    ]


def _newest_of(flight: Flight, group: str, name: str) -> float:
    """Return a channel's newest value in `internals` or, if that is absent, on its own topic."""
    if "internals" in flight.samples:
        return _newest(flight, "internals", f"{group}.{name}")
    return _newest(flight, group, name)


def _unit(flight: Flight, name: str) -> tuple[str, float]:
    unit = flight.description.get("units", {}).get(name, {"unit": "", "factor": 1.0})
    return (f"({unit['unit']})" if unit["unit"] else ""), unit["factor"]


def _newest(flight: Flight, topic: str, channel: str) -> float:
    """Return the newest value of a channel of a topic, or NaN if it is absent."""
    samples = flight.samples.get(topic)
    if samples is None or not samples.count or channel not in samples.names:
        return math.nan
    return float(samples.values[-1, samples.names.index(channel)])


def _number(value: float) -> str:
    return "-" if math.isnan(value) else f"{value:.3f}"
