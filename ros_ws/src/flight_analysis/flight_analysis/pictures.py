# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""The pictures of a flight, drawn from its tape: what the tape does not hold is left out.

Nothing here knows an aircraft: channels are drawn under the names that they have.
"""

from collections.abc import Mapping

import numpy as np
import plotly.graph_objects as go
from numpy.typing import NDArray

from flight_analysis.drawing import PLAIN, Band, Curve, Scene, add_line, spans, stack
from flight_analysis.metrics import Windows, tracking_error, true_error
from flight_analysis.summary import Shown
from flight_core.tape import Signal, Tape
from flight_core.vectors import FloatArray
from rise_di_controller.guard import Mode
from rise_di_controller.internals import Limited

PLANT, REFERENCE, ERROR, MEASURED, WIND, GUST = "#123c52", "#f6a85f", "#8b1f4f", "#e3b6c9", "#2a7f62", "#7f7f7f"
MODE_COLOURS = {
    Mode.WAITING: "#b0b0b0",
    Mode.HOLD: "#f2c230",
    Mode.RAMP: "#ef7d17",
    Mode.TRIM: "#8a63b8",
    Mode.INACTIVE: "#5f6b73",
}
LIMITED_COLOURS = {Limited.MAGNITUDE: "#d62728", Limited.RATE: "#8a63b8"}
LIMIT_LINES = ({"color": "#bbbbbb", "width": 4}, {"color": "#444444", "width": 1.2, "dash": "dash"})
FINEST = 1 / 500  # of the flight, about two pixels: what is shorter is drawn as long, so that it is seen
IN_SIGHT = 3.0  # a limit is in view where u comes within this ratio of it; farther ones would leave little of u to see

Limits = Mapping[str, tuple[float, float]]
"""Lower and upper limit by input, SI; infinite where there is none."""


def flight_scene(tape: Tape, units: Mapping[str, Shown], gusts: Windows) -> Scene:
    """The scene of a flight: the gusts it came to and the modes of its controller are marked in every picture."""
    end = flight_end(tape)
    return Scene(tape, units, [*gust_bands(tape, gusts), *mode_bands(tape, end * FINEST)], end)


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


def tracking_picture(scene: Scene) -> go.Figure:
    """Y over y_m of every output."""
    tape = scene.tape
    return stack(scene, {"y_m": Curve(tape["y_m"], REFERENCE, 6.0), "y": Curve(tape["y"], PLANT)})


def error_picture(scene: Scene) -> go.Figure:
    """E = y - y_m of every output, and over it the true error where the sensors have errors that the tape knows."""
    measured, true = Curve(tracking_error(scene.tape), ERROR), true_error(scene.tape)
    if true is None or not _moving(scene.tape, "noise").names:
        return stack(scene, {"e": measured}, height=110)
    return stack(scene, {"measured": measured._replace(colour=MEASURED), "true": Curve(true, ERROR)}, height=110)


def input_picture(scene: Scene, limits: Mapping[str, Limits]) -> go.Figure | None:
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
    return figure


def wind_picture(scene: Scene) -> go.Figure | None:
    """Every component of the wind that blew, whatever it is called."""
    wind = _moving(scene.tape, "gust")
    units = dict.fromkeys(wind.names, Shown("m/s", 1.0))
    return stack(scene._replace(units=units), {"wind": Curve(wind, WIND)}, height=110) if wind.names else None


def state_picture(scene: Scene) -> go.Figure | None:
    """All states of a simulated aircraft."""
    x = _group(scene.tape, "x")
    return stack(scene, {"x": Curve(x, PLANT)}, columns=2, height=130) if x.names else None


def sensor_picture(scene: Scene) -> go.Figure | None:
    """Y less the true output, of every sensor that has an error."""
    noise = _moving(scene.tape, "noise")
    return stack(scene, {"error": Curve(noise, ERROR, 0.8)}, columns=2, height=120) if noise.names else None


def tick_picture(scene: Scene) -> go.Figure | None:
    """How late the controller's ticks were, how old their y, and their dt; None where all were on time with a fresh y."""
    tape, shown = scene.tape, ("late", "age", "dt")
    if "internals" not in tape:
        return None
    ticks = tape["internals"]
    stepped = ticks["dt"][ticks["dt"] > 0.0]
    if not (ticks["late"].any() or ticks["age"].any() or np.unique(stepped).size > 1):
        return None
    chosen = Signal(ticks.stamp_ns, shown, np.column_stack([ticks[name] for name in shown]))
    units = dict.fromkeys(shown, Shown("ms", 1e3))
    return stack(scene._replace(units=units), {"ticks": Curve(chosen, PLANT, 1.0)}, height=100)


def _group(tape: Tape, group: str) -> Signal:
    """The channels "group.name" of `truth`; none where nobody knows the truth."""
    return tape["truth"].group(group) if "truth" in tape else Signal(np.zeros(0, dtype=np.int64), (), np.zeros((0, 0)))


def _moving(tape: Tape, group: str) -> Signal:
    """Those of them that are not zero all along."""
    signal = _group(tape, group)
    moving = np.flatnonzero(signal.values.any(axis=0))
    return Signal(signal.stamp_ns, tuple(signal.names[i] for i in moving), signal.values[:, moving])


def _limited(tape: Tape, name: str, what: Limited) -> tuple[FloatArray, NDArray[np.bool_]]:
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
