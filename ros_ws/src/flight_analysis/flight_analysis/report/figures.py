# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""The pictures of a flight, drawn from its tape: what the tape does not hold is left out.

Nothing here knows an aircraft: channels are drawn under the names that they have.
"""

from collections.abc import Mapping, Sequence

import numpy as np
import plotly.graph_objects as go
from numpy.typing import NDArray

from flight_analysis.closed_loop.scenario import Scenario
from flight_analysis.metrics import Windows, spectra, tick_periods, tracking_error, true_error
from flight_analysis.report.plotting import Band, Curve, Samples, Scene, add_line, cell, framed, grid, is_new, spans, stack
from flight_analysis.report.summary import PLAIN, DisplayUnit
from flight_core.tape import Signal, Tape
from flight_core.vectors import FloatArray
from rise_di_controller.guard import Mode
from rise_di_controller.internals import Saturation

PLANT, REFERENCE, ERROR, MEASURED, WIND, GUST = "#123c52", "#f6a85f", "#8b1f4f", "#e3b6c9", "#2a7f62", "#7f7f7f"
END_STOP, LIMIT = "#bbbbbb", "#444444"
DARK = {
    PLANT: "#9edbff",
    REFERENCE: "#8f5820",
    ERROR: "#f285b3",
    MEASURED: "#70405a",
    WIND: "#63cba6",
    END_STOP: "#555c64",
    LIMIT: "#b9c0c7",
}
"""Colours of curves, and what the page draws in their place on a dark ground."""
MODE_COLOURS = {
    Mode.WAITING: "#b0b0b0",
    Mode.HOLD: "#f2c230",
    Mode.RAMP: "#ef7d17",
    Mode.TRIM: "#8a63b8",
    Mode.INACTIVE: "#5f6b73",
}
LIMITED_COLOURS = {Saturation.MAGNITUDE: "#d62728", Saturation.RATE: "#8a63b8"}
LIMIT_LINES = ({"color": END_STOP, "width": 4}, {"color": LIMIT, "width": 1.2, "dash": "dash"})
FLOOR_LINE = {"color": LIMIT, "width": 1.0, "dash": "dot"}
INTEGRALS = {"integral_e": "∫e", "Pi": "Pi"}  # groups of `internals`, and what their rows are called
FEWEST = 64  # samples that a spectrum is drawn of
BINS = 80  # of a histogram
FREQUENCIES = [digit * 10.0**power for power in range(-4, 4) for digit in (1, 2, 5)]  # Hz, that are marked in a spectrum
FINEST = 1 / 500  # of the flight, about two pixels: what is shorter is drawn as long, so that it is seen
IN_SIGHT = 3.0  # a limit is in view where u comes within this ratio of it; farther ones would leave little of u to see

Limits = Mapping[str, tuple[float, float]]
"""Lower and upper limit by input, SI; infinite where there is none."""


def flight_scene(tape: Tape, units: Mapping[str, DisplayUnit], gusts: Windows) -> Scene:
    """The scene of a flight: the gusts it came to and the modes of its controller are marked in every picture."""
    end = flight_end(tape)
    return Scene(tape, units, [*gust_bands(tape, gusts), *mode_bands(tape, end * FINEST)], end, Samples())


def flight_end(tape: Tape) -> float:
    """The last instant of any signal, s; 0 for a tape without a sample."""
    return max((float(tape.time(topic)[-1]) for topic in tape.signals if len(tape[topic].stamp_ns)), default=0.0)


def gust_bands(tape: Tape, gusts: Windows) -> list[Band]:
    """The gusts that the flight came to."""
    end = flight_end(tape)
    return [Band(f"{name} gust", start, min(stop, end), GUST, True) for name, (start, stop) in gusts.items() if start < end]


def mode_bands(tape: Tape, join: float = 0.0) -> list[Band]:
    """Stretches in which the controller was in a mode other than ENGAGED, mode by mode, by its `internals`."""
    if "internals" not in tape:
        return []
    t, mode = tape.time("internals"), tape["internals"]["mode"]
    return [
        Band(one.name.lower(), start, stop, colour, False)
        for one, colour in MODE_COLOURS.items()
        for start, stop in spans(t, mode == one, join)
    ]


def tracking_figure(scene: Scene) -> go.Figure:
    """Y over y_m of every output."""
    tape = scene.tape
    return stack(scene, {"y_m": Curve(tape["y_m"], REFERENCE, 6.0), "y": Curve(tape["y"], PLANT)})


def error_figure(scene: Scene, floors: Mapping[str, float] | None = None) -> go.Figure:
    """E = y - y_m of every output, and over it the true error where the sensors have errors that the tape knows.

    The floors, by channel in SI, are lines on both sides of 0 where they are wide enough to see.
    """
    measured, true = Curve(tracking_error(scene.tape), ERROR), true_error(scene.tape)
    curves = {"e": measured}
    if true is not None and _moving(scene.tape, "noise").names:
        curves = {"measured": measured._replace(colour=MEASURED), "true": Curve(true, ERROR)}
    figure = stack(scene, curves, height=110)
    for row, name in enumerate(measured.signal.names, start=1):
        floor, largest = (floors or {}).get(name, 0.0), np.max(np.abs(measured.signal[name]), initial=0.0)
        if floor > FINEST * largest > 0.0:
            shown = floor * scene.units.get(name, PLAIN).factor
            add_line(figure, row, "floor", [0.0, scene.end, None, 0.0, scene.end], [shown] * 3 + [-shown] * 2, FLOOR_LINE)
    return framed(figure, 110, labels=16)


def input_figure(scene: Scene, limits: Mapping[str, Limits]) -> go.Figure | None:
    """The actuators' positions over the command u, at most two kinds of limits as lines, and when which input was limited."""
    tape = scene.tape
    if "u" not in tape:
        return None
    curves = {"u": Curve(tape["u"], PLANT, held=True)}
    if (position := _group(tape, "actuator")).names:
        curves = {"command u": Curve(tape["u"], REFERENCE, 4.0, held=True), "actuator": Curve(position, PLANT)}
    figure = stack(scene, curves)
    for row, name in enumerate(tape["u"].names, start=1):
        factor = scene.units.get(name, PLAIN).factor
        values = [curve.signal[name] * factor for curve in curves.values() if name in curve.signal.names]
        bounds = {kind: np.array(of[name]) * factor for kind, of in limits.items() if name in of}
        low, high = _view(np.concatenate(values), np.concatenate([[], *bounds.values()]))
        for (kind, pair), line in zip(bounds.items(), LIMIT_LINES, strict=False):
            for bound in pair[np.isfinite(pair)]:
                add_line(figure, row, kind, [0.0, scene.end], [bound, bound], line)
        strip, top = high + 0.07 * (high - low), high + 0.14 * (high - low)
        for what, colour in LIMITED_COLOURS.items():
            hit = spans(*_limited(tape, name, what), scene.end * FINEST)
            x = [instant for start, stop in hit for instant in (start, stop, None)]
            add_line(figure, row, f"limited: {what.name.lower()}", x, [strip] * len(x), {"color": colour, "width": 9})
        figure.update_yaxes(range=[low, top], row=row, col=1)
    return framed(figure, 150, labels=16)


def known_limits(scenario: Scenario, tape: Tape) -> dict[str, Limits]:
    """Limits of u by whose they are and by input: of the actuators where they are simulated, and of the controller."""
    actuators, controller = scenario.aircraft.actuators, scenario.controller
    limits = {"limits of the controller": _pairs(controller.inputs, controller.lower or (), controller.upper or ())}
    if not _group(tape, "actuator").names:
        return limits
    return {"end stops": _pairs(tuple(scenario.aircraft.channels().inputs), actuators.lower, actuators.upper)} | limits


def _pairs(names: Sequence[str], lower: Sequence[float], upper: Sequence[float]) -> Limits:
    none = [float("inf")] * len(names)
    return dict(zip(names, zip(lower or [-bound for bound in none], upper or none, strict=True), strict=True))


def integral_figure(scene: Scene) -> go.Figure | None:
    """Both integrals of the law, by output: that of e beside that of the sign."""
    if "internals" not in scene.tape:
        return None
    internals = scene.tape["internals"]
    outputs = internals.group("Pi").names
    shown = {f"{label} {name}": f"{group}.{name}" for name in outputs for group, label in INTEGRALS.items()}
    if not outputs:
        return None
    curve = Signal(internals.stamp_ns, tuple(shown), np.column_stack([internals[channel] for channel in shown.values()]))
    return stack(scene, {"": Curve(curve, PLANT)}, columns=2, height=120)


def spectrum_figure(scene: Scene, period_ns: int) -> go.Figure | None:
    """Amplitude spectral density of u, both axes logarithmic; None without as many samples as tell one."""
    if "u" not in scene.tape or len(scene.tape["u"].stamp_ns) < FEWEST:
        return None
    return draw_spectra({"u": (scene.tape["u"], period_ns)}, {"u": PLANT}, scene.units)


def draw_spectra(
    runs: Mapping[str, tuple[Signal, int]], colours: Mapping[str, str], units: Mapping[str, DisplayUnit]
) -> go.Figure:
    """A cell a channel, in it the spectra of all runs that have it: of a signal with its period in ns each."""
    channels = list(dict.fromkeys(name for signal, _ in runs.values() for name in signal.names))
    columns = min(len(channels), 2)
    figure = grid(len(channels), columns, 190, vertical_spacing=0.2)
    for label, (signal, period_ns) in runs.items():
        frequency, densities = spectra(signal, period_ns)
        for name, density in densities.items():
            unit, factor = units.get(name, PLAIN)
            line = go.Scatter(
                x=frequency, y=density * factor, mode="lines", name=label, line={"color": colours[label], "width": 1.4}
            )
            line.update(
                legendgroup=label,
                showlegend=len(runs) > 1 and is_new(figure, label),
                hovertemplate=f"%{{y:.3g}} {unit}/√Hz at %{{x:.3g}} Hz",
            )
            figure.add_trace(line, **cell(channels.index(name), columns))
    for place, name in enumerate(channels):
        unit = units.get(name, PLAIN).unit
        at = cell(place, columns)
        figure.update_yaxes(type="log", dtick=1, exponentformat="power", title_text=f"{name} ({unit}/√Hz)", **at)
        figure.update_xaxes(type="log", tickvals=FREQUENCIES, title_text="Hz", **at)
    return framed(figure, 190, below=44)


def timing_figure(scene: Scene, period_ns: int) -> go.Figure | None:
    """How the controller's time was spread, by the number of ticks: None where all ticks were on time and none waited."""
    shown = timing(scene.tape, period_ns)
    return draw_histograms({"": shown}, {"": PLANT}) if shown else None


def timing(tape: Tape, period_ns: int) -> dict[str, FloatArray]:
    """What there is to say of a controller's time, in ms, by what it is; nothing where all of it is 0."""
    found: dict[str, FloatArray] = {}
    if "internals" in tape:
        periods = tick_periods(tape)
        found["tick to tick, off a whole period"] = (periods - period_ns * np.round(periods / period_ns)) / 1e6
        found["tick after its deadline"] = tape["internals"]["late"] * 1e3
        found["age of y at the tick"] = tape["internals"]["age"] * 1e3
    if "latency" in tape:
        found["y sent to u sent"] = tape["latency"].values[:, 0] * 1e3
    return {what: values for what, values in found.items() if len(values) and np.any(np.abs(values) > 1e-6)}


def draw_histograms(runs: Mapping[str, Mapping[str, FloatArray]], colours: Mapping[str, str]) -> go.Figure:
    """A cell a quantity, in ms, in it the counts of every run that has it, on the same bins; logarithmic."""
    quantities = list(dict.fromkeys(what for run in runs.values() for what in run))
    columns = min(len(quantities), 2)
    figure = grid(len(quantities), columns, 150, vertical_spacing=0.24)
    for place, what in enumerate(quantities):
        of = {label: run[what] for label, run in runs.items() if what in run}
        edges = np.histogram_bin_edges(np.concatenate(list(of.values())), bins=BINS)
        for label, values in of.items():
            counts, width = np.histogram(values, edges)[0].astype(float), edges[1] - edges[0]
            bars = go.Bar(x=edges[:-1] + width / 2.0, y=counts, width=width, name=label, marker={"color": colours[label]})
            bars.update(legendgroup=label, showlegend=len(runs) > 1 and is_new(figure, label))
            bars.update(opacity=1.0 if len(runs) == 1 else 0.6)
            figure.add_trace(bars.update(hovertemplate="%{y} ticks around %{x:.4g} ms"), **cell(place, columns))
        figure.update_xaxes(title_text=f"{what} (ms)", **cell(place, columns))
    figure.update_yaxes(type="log", title_text="ticks")
    figure.update_layout(barmode="overlay")
    return framed(figure, 150, below=44)


def wind_figure(scene: Scene) -> go.Figure | None:
    """Every component of the wind that blew, whatever it is called."""
    wind = _moving(scene.tape, "gust")
    units = dict.fromkeys(wind.names, DisplayUnit("m/s", 1.0))
    return stack(scene._replace(units=units), {"wind": Curve(wind, WIND)}, height=110) if wind.names else None


def state_figure(scene: Scene) -> go.Figure | None:
    """All states of a simulated aircraft."""
    x = _group(scene.tape, "x")
    return stack(scene, {"x": Curve(x, PLANT)}, columns=2, height=130) if x.names else None


def sensor_figure(scene: Scene) -> go.Figure | None:
    """Y less the true output, of every sensor that has an error."""
    noise = _moving(scene.tape, "noise")
    return stack(scene, {"error": Curve(noise, ERROR, 0.8)}, columns=2, height=120) if noise.names else None


def tick_figure(scene: Scene) -> go.Figure | None:
    """How late the controller's ticks were, how old their y, and their dt; None where all were on time with a fresh y."""
    tape, shown = scene.tape, ("late", "age", "dt")
    if "internals" not in tape:
        return None
    ticks = tape["internals"]
    stepped = ticks["dt"][ticks["dt"] > 0.0]
    if not (ticks["late"].any() or ticks["age"].any() or np.unique(stepped).size > 1):
        return None
    chosen = Signal(ticks.stamp_ns, shown, np.column_stack([ticks[name] for name in shown]))
    units = dict.fromkeys(shown, DisplayUnit("ms", 1e3))
    return stack(scene._replace(units=units), {"ticks": Curve(chosen, PLANT, 1.0)}, height=100)


def _group(tape: Tape, group: str) -> Signal:
    """The channels "group.name" of `truth`; none where nobody knows the truth."""
    return tape["truth"].group(group) if "truth" in tape else Signal(np.zeros(0, dtype=np.int64), (), np.zeros((0, 0)))


def _moving(tape: Tape, group: str) -> Signal:
    """Those of them that are not zero all along."""
    signal = _group(tape, group)
    moving = np.flatnonzero(signal.values.any(axis=0))
    return Signal(signal.stamp_ns, tuple(signal.names[i] for i in moving), signal.values[:, moving])


def _limited(tape: Tape, name: str, what: Saturation) -> tuple[FloatArray, NDArray[np.bool_]]:
    """The instants of `internals`, and at which of them an input was limited so."""
    channel = f"limited.{name}"
    if "internals" not in tape or channel not in tape["internals"].names:
        return np.zeros(0), np.zeros(0, dtype=bool)
    return tape.time("internals"), tape["internals"][channel] == what


def _view(values: FloatArray, bounds: FloatArray) -> tuple[float, float]:
    """What to show of an axis: the values, and the bounds that they come near."""
    low, high = float(values.min(initial=0.0)), float(values.max(initial=0.0))
    near = [bound for bound in bounds if 0.0 < bound <= IN_SIGHT * high or IN_SIGHT * low <= bound < 0.0]
    low, high = min([low, *near]), max([high, *near])
    margin = 0.06 * (high - low) or 1.0
    return low - margin, high + margin
