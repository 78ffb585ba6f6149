# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Draw the figures of a guided flight.

The figures show the ground track, the altitude, airspeed and attitude with their commands, and the
cross-track error.
"""

import math
from collections.abc import Mapping, Sequence

import numpy as np

from flight_analysis.closed_loop.guidance_replay import known_routes
from flight_analysis.closed_loop.scenario import Scenario
from flight_analysis.metrics.time_spans import mask_spans
from flight_analysis.report.display_units import QUANTITY_UNITS, DisplayUnit
from flight_analysis.report.figures import END_STOP, ERROR, PLANT, REFERENCE, WIND
from flight_analysis.report.guided import flown_speed
from flight_analysis.report.plotting import (
    INTERVAL_OPACITY,
    PAPER,
    Curve,
    Figure,
    Interval,
    PlotContext,
    axis,
    set_layout,
    time_series_figure,
)
from flight_core.tape import Signal, Tape
from flight_core.vectors import FloatArray
from flight_guidance.fence.fence import Fence
from flight_guidance.guidance_state import GuidanceMode, Lateral, Vertical
from flight_guidance.steering.path import Route, leg_places, route_outline
from flight_guidance.steering.wind import wind_of

TRACK_POINTS = 2400
TRACK_HEIGHT = 560  # pixels
WIND_ARROWS = 8
ARROW_PIXELS = 45.0  # length of the arrow of the strongest wind
LEG = "leg"  # name of the annotation with the number of a leg
LEAST_WIND = 0.3  # wind below which no arrow is drawn, m/s
# colours that differ from MODE_COLOURS, which are used in the same figures
MODE_SHADES = {
    GuidanceMode.DEAD_RECKONING: "#0072b2",
    GuidanceMode.POSE_LOST: "#cc79a7",
}

# least and largest command by channel, SI; infinite if there is no limit
Bounds = Mapping[str, tuple[float, float]]


def guided_context(context: PlotContext) -> PlotContext:
    """Add what figures of guidance need to a context: units, and the times of a stale pose.

    The units belong to the quantities that guidance holds, such as altitude.
    """
    t = context.tape.time("guidance")
    mode = context.tape["guidance"]["mode"]
    stale = []
    for shaded, colour in MODE_SHADES.items():
        label = f"guidance: {shaded.name.lower().replace('_', ' ')}"
        stale += [
            Interval(label=label, start=start, stop=stop, colour=colour, is_labelled=False)
            for start, stop in mask_spans(t, mode == shaded)
        ]
    return context._replace(units=QUANTITY_UNITS, intervals=[*context.intervals, *stale])


def bounds_of(scenario: Scenario | None) -> Bounds:
    """Return the limits of guidance's commands: airspeed, altitude, bank and pitch."""
    if scenario is None or scenario.guidance is None:
        return {}
    limits = scenario.guidance.params().limits
    return {
        "V": (limits.floor, limits.largest_speed),
        "altitude": (limits.lowest, limits.highest),
        "phi": (-limits.bank, limits.bank),
        "theta": (limits.least_pitch, limits.largest_pitch),
    }


def flown_routes(scenario: Scenario | None, tape: Tape) -> list[Route]:
    """Return the routes that were flown, according to the topic `guidance`.

    The routes themselves are in the scenario and on the topic `route`.
    """
    if scenario is None or scenario.guidance is None:
        return []
    numbers = set(tape["guidance"]["route"].tolist())
    return [
        route
        for digest, route in known_routes(tape, scenario.guidance).items()
        if digest in numbers
    ]


def track_figure(
    tape: Tape, routes: Sequence[Route], speed: float, fence: Fence | None = None
) -> Figure:
    """Draw the ground track, the routes with their fillets, and arrows of the wind.

    The two axes have the same scale. The legs are numbered, and start and end are marked. If there
    is a fence, it is drawn with the home position. `speed` is the trim speed V0, m/s.
    """
    figure = tracks_figure({"flown": (tape, PLANT)}, routes)
    pose = tape["guidance"].group("pose")
    for name, instant, symbol in (("start", 0, "circle-open"), ("end", -1, "square")):
        _add_mark(figure, name, pose["east"][instant], pose["north"][instant], PLANT, symbol)
    if fence is not None:
        _add_fence(figure, fence)
    _add_wind(figure, tape, speed)
    for route in routes:
        _add_numbers(figure, route)
    return set_layout(figure, labels=16)


def _add_mark(
    figure: Figure, name: str, east: float, north: float, colour: str, symbol: str
) -> None:
    """Mark a position. Its name stands in the legend, where it covers no number of a leg."""
    mark = {"color": colour, "size": 9, "symbol": symbol}
    figure.add_scatter(name, [east], [north], mode="markers", marker=mark, hoverinfo="skip")


def _add_numbers(figure: Figure, route: Route) -> None:
    """Write the numbers of the legs. Call this last, so that the wind arrows lie below them."""
    for number, (north, east) in enumerate(leg_places(route)):
        place = {"x": east, "y": north, "text": f"{number}", "showarrow": False}
        box = {"bgcolor": PAPER, "bordercolor": REFERENCE, "borderwidth": 1.5, "borderpad": 2}
        figure.layout["annotations"].append(place | box | {"name": LEG})


def _add_fence(figure: Figure, fence: Fence) -> None:
    for zone in fence.zones:
        turn = np.linspace(0.0, 2.0 * math.pi, 73)
        north = np.array([*zone.north, zone.north[0]])
        east = np.array([*zone.east, zone.east[0]])
        if zone.radius:
            north = zone.north[0] + zone.radius * np.cos(turn)
            east = zone.east[0] + zone.radius * np.sin(turn)
        line = {"color": END_STOP, "width": 2.0, "dash": "dot" if zone.exclude else "solid"}
        name = "keep out" if zone.exclude else "fence"
        figure.add_scatter(name, east, north, line=line, hoverinfo="skip")
    home_north, home_east = fence.home
    _add_mark(figure, "home", home_east, home_north, END_STOP, "diamond")


def tracks_figure(tracks: Mapping[str, tuple[Tape, str]], routes: Sequence[Route]) -> Figure:
    """Draw the ground tracks of several flights over routes, with the same scale on both axes.

    `tracks` has the tape and the colour of each guided flight, by label.
    """
    figure = Figure(1, 1, TRACK_HEIGHT)
    for route in routes:
        line = {"color": REFERENCE, "width": 6.0}
        north, east, _ = (
            np.array(values, dtype=np.float32) for values in zip(*route_outline(route), strict=True)
        )
        figure.add_scatter("route", east, north, line=line, hoverinfo="skip")
    for label, (tape, colour) in tracks.items():
        t = tape.time("guidance")
        pose = tape["guidance"].group("pose")
        keep = np.unique(np.linspace(0, len(t) - 1, TRACK_POINTS).astype(int))
        north, east = (pose[name][keep].astype(np.float32) for name in ("north", "east"))
        line = {"color": colour, "width": 1.4}
        instants = [f"t = {instant:.1f} s" for instant in t[keep]]
        figure.add_scatter(label, east, north, line=line, text=instants, hoverinfo="x+y+text")
    figure.x[0]["title"] = {"text": "east (m)"}
    figure.y[0] |= {"title": {"text": "north (m)"}, "scaleanchor": "x", "scaleratio": 1.0}
    return set_layout(figure, labels=16)


def mean_wind(tape: Tape, speed: float, parts: int = WIND_ARROWS) -> FloatArray:
    """Return the mean wind, north and east, in each of equal parts of the flight, m/s, (parts, 2).

    The wind is the velocity over ground less the velocity through the air. The velocity through the
    air has the size (V0 + V) cos(gamma), where V comes from y, and the direction psi + beta.
    `speed` is the trim speed V0, m/s. If the aircraft is a multicopter, the wind comes from the
    log.
    """
    log = tape["guidance"]
    pose = log.group("pose")
    heading = log["pose.psi"] + log["pose.beta"]
    wind = np.column_stack([log["wind.north"], log["wind.east"]])  # a multicopter logs its wind
    if "y.V" in log.names:
        flown = flown_speed(tape, speed)
        wind = np.column_stack(
            wind_of(pose["v_north"], pose["v_east"], pose["climb"], heading, flown)
        )
    return np.array([part.mean(axis=0) for part in np.array_split(wind, min(parts, len(wind)))])


def _add_wind(figure: Figure, tape: Tape, speed: float) -> None:
    wind = mean_wind(tape, speed)
    strength = np.hypot(wind[:, 0], wind[:, 1])
    if (strongest := float(strength.max())) < LEAST_WIND:
        return
    pose = tape["guidance"].group("pose")
    middles = [
        int(part[len(part) // 2])
        for part in np.array_split(np.arange(len(pose.stamp_ns)), len(wind))
    ]
    for k, (to_north, to_east) in zip(middles, wind * (ARROW_PIXELS / strongest), strict=True):
        # ay points down
        arrow = {
            "x": pose["east"][k],
            "y": pose["north"][k],
            "ax": -to_east,
            "ay": to_north,
            "text": "",
        }
        arrow |= {"showarrow": True, "arrowhead": 2, "arrowwidth": 1.6, "arrowcolor": WIND}
        figure.layout["annotations"].append(arrow)
    label = f"wind, the longest arrow {strongest:.2g} m/s"
    figure.add_scatter(label, [None], [None], line={"color": WIND})


AIRSPEED = "airspeed"  # name of the absolute speed, because V is the deviation from the trim speed


def vertical_figure(context: PlotContext, speed: float, bounds: Bounds) -> Figure:
    """Draw altitude and airspeed with their commands, and the limits of these commands.

    `speed` is the trim speed V0, m/s.
    """
    log = context.tape["guidance"]
    commanded = np.where(
        np.isin(log["mode.vertical"], [Vertical.ALTITUDE, Vertical.PROFILE]),
        log["target.altitude"],
        np.nan,
    )
    commands = {"altitude": commanded, AIRSPEED: log["V_c"]}
    values = {"altitude": log["pose.altitude"], AIRSPEED: flown_speed(context.tape, speed)}
    units = {**context.units, AIRSPEED: DisplayUnit(unit="m/s", factor=1.0)}
    limits = {**bounds, AIRSPEED: bounds["V"]} if "V" in bounds else bounds
    return _over_commands(context._replace(units=units), commands, values, limits)


def attitude_figure(context: PlotContext, bounds: Bounds) -> Figure:
    """Draw bank and pitch with their commands, and the limits of these commands."""
    log = context.tape["guidance"]
    names = ("phi", "theta")
    return _over_commands(
        context,
        {name: log[f"{name}_c"] for name in names},
        {name: log[f"pose.{name}"] for name in names},
        bounds,
    )


def cross_track_figure(context: PlotContext) -> Figure | None:
    """Draw the cross-track error while a path is followed, with a curve for each leg.

    Returns None if the flight followed no path.
    """
    log = context.tape["guidance"]
    lateral = log["mode.lateral"]
    on_path = np.isin(lateral, [Lateral.ORBIT, Lateral.ROUTE])
    on_path &= log["joining"] == 0.0  # on the way to a leg there is no cross-track error
    if not on_path.any():
        return None
    error = Curve(_signal(context, {"xtrack": np.where(on_path, log["xtrack"], np.nan)}), ERROR)
    t = context.tape.time("guidance")
    legs = np.where(lateral == Lateral.ROUTE, log["leg"], -1.0)
    spans = []
    for leg in np.unique(legs[legs >= 0.0]):
        colour = END_STOP if leg % 2 else "#ffffff"
        spans += [
            Interval(label=f"{int(leg)}", start=start, stop=stop, colour=colour, is_labelled=True)
            for start, stop in mask_spans(t, legs == leg)
        ]
    return time_series_figure(context._replace(intervals=[*context.intervals, *spans]), {"": error})


def _signal(context: PlotContext, channels: Mapping[str, FloatArray]) -> Signal:
    return Signal(
        context.tape["guidance"].stamp_ns, tuple(channels), np.stack(list(channels.values())).T
    )


def _over_commands(
    context: PlotContext,
    commands: Mapping[str, FloatArray],
    samples: Mapping[str, FloatArray],
    bounds: Bounds,
) -> Figure:
    curves = {
        "command": Curve(_signal(context, commands), REFERENCE, 5.0),
        "flown": Curve(_signal(context, samples), PLANT),
    }
    figure = time_series_figure(context, curves)
    for index, name in enumerate(samples):
        factor = context.units[name].factor
        values = np.concatenate([samples[name], commands[name]]) * factor
        low = float(np.nanmin(values))
        high = float(np.nanmax(values))
        lower, upper = (bound * factor for bound in bounds.get(name, (-math.inf, math.inf)))
        low = min([low, *filter(math.isfinite, (lower,))])
        high = max([high, *filter(math.isfinite, (upper,))])
        margin = 0.06 * (high - low) or 1.0
        view = (low - margin, high + margin)
        for bound, edge in zip((lower, upper), view, strict=True):
            if math.isfinite(bound):
                shape = {
                    "type": "rect",
                    "x0": 0.0,
                    "x1": context.end,
                    "y0": bound,
                    "y1": edge,
                    "layer": "below",
                }
                shape |= {"xref": axis("x", index), "yref": axis("y", index), "line": {"width": 0}}
                figure.layout["shapes"].append(
                    shape | {"fillcolor": END_STOP, "opacity": INTERVAL_OPACITY}
                )
        figure.y[index]["range"] = view
    return set_layout(figure, labels=16)
