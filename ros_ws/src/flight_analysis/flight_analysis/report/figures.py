# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Draw the figures of a flight from its tape.

A figure is None if the tape lacks its signals. Only the figures of tracking and of the error need y
and y_m. The figures do not depend on the kind of aircraft: channels are drawn under their own
names.
"""

from collections.abc import Callable, Mapping, Sequence
from itertools import chain, cycle, product
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flight_analysis.closed_loop.scenario import Scenario
from flight_analysis.metrics.errors import best_error, tracking_error, true_error
from flight_analysis.metrics.time_spans import mask_spans
from flight_analysis.report.display_units import (
    NO_UNIT,
    POSE_UNITS,
    DisplayUnit,
    in_order,
)
from flight_analysis.report.intervals import (
    fault_intervals,
    flight_end,
    gap_intervals,
    gust_intervals,
    mode_intervals,
    starved_intervals,
)
from flight_analysis.report.plotting import (
    SHOWS_ANGLES,
    Curve,
    Figure,
    Interval,
    PlotContext,
    Run,
    SampleStore,
    add_line,
    is_first_in_legend,
    set_layout,
    time_series_figure,
)
from flight_analysis.report.spectra import spectra
from flight_analysis.report.summary import RecordedFlight, common_units, labels
from flight_analysis.report.timing import tick_periods
from flight_core.tape import Signal, Tape
from flight_core.vectors import FloatArray
from rise_di_controller.internals import Saturation

# Colours of curves on a light page, by what the curve shows.
PLANT = "#123c52"
REFERENCE = "#d97b1c"
ERROR = "#8b1f4f"
MEASURED = "#c9799b"
WIND = "#2a7f62"
END_STOP = "#8c8c8c"
LIMIT = "#444444"
# Every line has a contrast of at least 3 to 1 with its page, as WCAG 2.2 requires of graphics
# (1.4.11). The colours of flights are the blue, the green and the pink of Okabe and Ito 2008, which
# the colour blind can tell apart, and a violet and an olive. On a dark page they are lighter.
FLIGHTS = {
    "#0072b2": "#4db3ea",
    "#5e3c99": "#b39ddb",
    "#009e73": "#3fcf9f",
    "#cc79a7": "#e8a3c8",
    "#7a6a00": "#d9c74a",
}
COLOURS = tuple(FLIGHTS)
"""Colours of flights that are compared."""
DARK = FLIGHTS | {
    PLANT: "#9edbff",
    REFERENCE: "#b8712b",
    ERROR: "#f285b3",
    MEASURED: "#9a6280",
    WIND: "#63cba6",
    END_STOP: "#737b84",
    LIMIT: "#b9c0c7",
}
"""Colours of curves on a light page, with those that replace them on a dark page."""
SATURATION_COLOURS = {Saturation.MAGNITUDE: "#d62728", Saturation.RATE: "#8a63b8"}
LIMIT_LINES = ({"color": END_STOP, "width": 4}, {"color": LIMIT, "width": 1.2, "dash": "dash"})
NOISE_FLOOR_LINE = {"color": LIMIT, "width": 1.0, "dash": "dot"}
INTEGRALS = {"integral_e": "∫e", "Pi": "Pi"}  # labels by group of `internals`
MIN_SPECTRUM_SAMPLES = 64
HISTOGRAM_BINS = 80
# tick marks of the frequency axis of a spectrum, Hz
FREQUENCIES = [digit * 10.0**power for power, digit in product(range(-4, 4), (1, 2, 5))]
# share of an axis, about two pixels: a shorter interval is lengthened to it, and a lower noise
# floor is not drawn
MIN_VISIBLE_FRACTION = 1 / 500
MOST_MARKED = 100  # largest number of marked messages, because plotly is slow with more shapes
LIMIT_VIEW_RATIO = 3.0  # a limit is in view if it is at most this many times the largest u

# lower and upper limit by input, SI; an input without a limit has infinite ones
Limits = Mapping[str, tuple[float, float]]

# references that differ by less than this fraction of the largest value are drawn as one curve
SAME_CURVE_TOLERANCE = 1e-3


def plot_context(flights: Sequence[RecordedFlight]) -> PlotContext:
    """Return what all figures of one or several flights share, such as units and shaded times.

    For one flight, the figures shade gusts, failsafe modes, faults, spans in which the host was too
    busy, and gaps, and they mark messages. For several flights, they shade only the gusts, and only
    if all flights had the same gusts.
    """
    longest = max((flight.tape for flight in flights), key=flight_end)
    end = flight_end(longest)
    gusts = flights[0].gusts
    intervals: list[Interval] = []
    if all(flight.gusts == gusts for flight in flights):
        intervals += gust_intervals(longest, gusts)
    if len(flights) == 1:
        intervals += mode_intervals(longest, end * MIN_VISIBLE_FRACTION)
        intervals += fault_intervals(flights[0], end)
        intervals += starved_intervals(flights[0])
        intervals += gap_intervals(longest)
    message_times = flights[0].message_times if len(flights) == 1 else []
    return PlotContext(
        runs=runs_of(flights),
        units=common_units(flights),
        intervals=intervals,
        end=end,
        samples=SampleStore(),
        messages=[time for time in dict.fromkeys(message_times) if 0.0 <= time <= end][
            :MOST_MARKED
        ],
    )


def runs_of(flights: Sequence[RecordedFlight]) -> dict[str, Run]:
    """Return the tape of each flight by its label, with the colour of its curves."""
    colours = cycle(COLOURS) if len(flights) > 1 else (PLANT,)
    return {
        label: Run(tape=flight.tape, period_ns=flight.period_ns, colour=colour)
        for label, flight, colour in zip(labels(flights), flights, colours, strict=False)
    }


def _curves(
    context: PlotContext, name: str, signal: Callable[[Tape], Signal | None], **style: Any
) -> dict[str, Curve]:
    """Return a curve for each flight that has a signal. `signal` takes this signal from a tape.

    If there is only one flight, its curve is called `name`. If there are several, their curves have
    the labels of the flights.
    """
    curves = {}
    for label, run in context.runs.items():
        if (samples := signal(run.tape)) is not None:
            curve = Curve(samples, run.colour, **style)
            curves[label if context.is_comparison else name] = curve._replace(
                start_ns=run.tape.start_ns
            )
    return curves


def _references(context: PlotContext) -> dict[str, Curve]:
    """Return the curves of y_m of all flights. Flights with equal y_m share one curve."""
    references: dict[str, Curve] = {}
    for label, curve in _curves(context, "y_m", lambda tape: tape["y_m"]).items():
        equal = next(
            (name for name, reference in references.items() if _is_same_curve(reference, curve)),
            label,
        )
        earlier = references.setdefault(equal, curve)
        if len(curve.signal.stamp_ns) > len(earlier.signal.stamp_ns):
            references[equal] = curve._replace(colour=earlier.colour)
    if len(references) == 1:
        (curve,) = references.values()
        return {"y_m": curve._replace(colour=REFERENCE, width=6.0)}
    return {
        f"y_m {label}": curve._replace(width=5.0, is_faint=True)
        for label, curve in references.items()
    }


def _is_same_curve(first: Curve, second: Curve) -> bool:
    """Return whether two curves of y_m are equal over the time that they share.

    A difference of up to the fraction SAME_CURVE_TOLERANCE of the largest value is allowed.
    """
    one, two = first.signal, second.signal
    if set(one.names) != set(two.names) or not (len(one.stamp_ns) and len(two.stamp_ns)):
        return False
    t_one, t_two = (curve.signal.stamp_ns - (curve.start_ns or 0) for curve in (first, second))
    instants = t_one[t_one <= t_two[-1]]
    for name in one.names:
        gap = one[name][: len(instants)] - np.interp(instants, t_two, two[name])
        if np.max(np.abs(gap), initial=0.0) > SAME_CURVE_TOLERANCE * np.max(np.abs(one[name])):
            return False
    return True


def tracking_figure(
    context: PlotContext, labels: Mapping[str, str] = MappingProxyType({})
) -> Figure:
    """Draw y and y_m of every output.

    For several flights, the figure has y of each flight, and each y_m that differs from the others.
    `labels` has axis labels that replace the names of channels.
    """
    y = _curves(context, "y", lambda tape: tape.signals.get("y"))
    return time_series_figure(context, _references(context) | y, labels=labels)


def overlay_figure(context: PlotContext, topic: str) -> Figure | None:
    """Draw the channels of a topic of several logs, or return None if no log has the topic."""
    curves = _curves(context, topic, lambda tape: tape.signals.get(topic))
    if topic == "pose":
        context = context._replace(units=POSE_UNITS)
    return time_series_figure(context, curves) if curves else None


def error_figure(context: PlotContext, floors: Mapping[str, float] | None = None) -> Figure:
    """Draw e = y - y_m of every output.

    For one simulated flight with errors of the sensors, the true error is drawn over the measured
    one. For several flights, only the most accurate error of each flight is drawn. `floors` has the
    noise floors by channel, SI. Each floor is drawn as two lines, above and below 0, if it is wide
    enough to see.
    """
    if context.is_comparison:
        errors = _curves(context, "e", lambda tape: best_error(tape)[1])
        return time_series_figure(context, errors, height=110)
    measured = Curve(tracking_error(context.tape), ERROR)
    true = true_error(context.tape)
    curves = {"e": measured}
    if true is not None and _nonzero_group(context.tape, "noise").names:
        curves = {"measured": measured._replace(colour=MEASURED), "true": Curve(true, ERROR)}
    figure = time_series_figure(context, curves, height=110)
    for index, name in enumerate(in_order(measured.signal.names, context.units)):
        floor = (floors or {}).get(name, 0.0)
        largest = np.max(np.abs(measured.signal[name]), initial=0.0)
        if floor > MIN_VISIBLE_FRACTION * largest > 0.0:
            level = floor * context.units.get(name, NO_UNIT).factor
            x = [0.0, context.end, None, 0.0, context.end]
            y = [level] * 3 + [-level] * 2
            add_line(figure, index, "noise floor", x, y, NOISE_FLOOR_LINE)
    return set_layout(figure, labels=16)


def input_figure(
    context: PlotContext, limits: Mapping[str, Limits] = MappingProxyType({})
) -> Figure | None:
    """Draw the command u and, for one flight, the actuator positions, limits and saturation.

    The positions are left out if the tape has none. `limits` has the limits of the inputs by kind.
    At most two kinds are drawn, as lines. Marks show where an input was saturated.
    """
    curves = _curves(context, "u", lambda tape: tape.signals.get("u"), is_held=True)
    if context.is_comparison or not curves:
        return time_series_figure(context, curves) if curves else None
    tape = context.tape
    if (position := _truth_group(tape, "actuator")).names:
        curves = {
            "command u": Curve(tape["u"], REFERENCE, 4.0, is_held=True),
            "actuator": Curve(position, PLANT),
        }
    figure = time_series_figure(context, curves)
    for index, name in enumerate(in_order(tape["u"].names, context.units)):
        factor = context.units.get(name, NO_UNIT).factor
        # The axis shows all curves, and the limits near them.
        values = [
            curve.signal[name] * factor for curve in curves.values() if name in curve.signal.names
        ]
        bounds = {
            kind: np.array(by_input[name]) * factor
            for kind, by_input in limits.items()
            if name in by_input
        }
        low, high = _axis_range(np.concatenate(values), np.concatenate([[], *bounds.values()]))
        for (kind, pair), style in zip(bounds.items(), LIMIT_LINES, strict=False):
            for bound in pair[np.isfinite(pair)]:
                add_line(figure, index, kind, [0.0, context.end], [bound, bound], style)
        # A bar above the curves marks each saturation.
        mark = high + 0.07 * (high - low)
        top = high + 0.14 * (high - low)
        for saturation, colour in SATURATION_COLOURS.items():
            spans = mask_spans(
                *_saturated(tape, name, saturation), context.end * MIN_VISIBLE_FRACTION
            )
            x: list[float | None] = []
            for start, stop in spans:
                x += [start, stop, None]
            add_line(
                figure,
                index,
                f"saturated: {saturation.name.lower()}",
                x,
                [mark] * len(x),
                {"color": colour, "width": 9},
            )
        figure.y[index]["range"] = [low, top]
    return set_layout(figure, labels=16)


def input_limits(scenario: Scenario, tape: Tape) -> dict[str, Limits]:
    """Return the lower and upper limit of each input, by the kind of limit.

    The kinds are the limits of the controller and, if the actuators are simulated, their end stops.
    """
    actuators = scenario.aircraft.actuators
    controller = scenario.controller
    commanded = controller.effector_limits()
    limits = {
        "limits of the controller": _limit_pairs(
            controller.effectors, commanded.lower.tolist(), commanded.upper.tolist()
        )
    }
    if not _truth_group(tape, "actuator").names:
        return limits
    return {
        "end stops": _limit_pairs(
            tuple(scenario.aircraft.channels().inputs), actuators.lower, actuators.upper
        )
    } | limits


def _limit_pairs(names: Sequence[str], lower: Sequence[float], upper: Sequence[float]) -> Limits:
    none = [float("inf")] * len(names)
    return dict(
        zip(
            names, zip(lower or [-bound for bound in none], upper or none, strict=True), strict=True
        )
    )


def integral_figure(context: PlotContext) -> Figure | None:
    """Draw the two integrals of the law for each output: the integral of e, and Pi."""
    if "internals" not in context.tape:
        return None
    internals = context.tape["internals"]
    outputs = in_order(internals.group("Pi").names, context.units)
    if not outputs:
        return None
    channels: dict[str, str] = {}
    units: dict[str, DisplayUnit] = {}
    for name in outputs:
        channels |= {f"{label} {name}": f"{group}.{name}" for group, label in INTEGRALS.items()}
        unit = context.units.get(name, NO_UNIT)
        text = unit.unit
        integrated = text.removesuffix("/s") if text.endswith("/s") else f"{text} s".strip()
        units |= {
            f"∫e {name}": DisplayUnit(unit=integrated, factor=unit.factor),
            f"Pi {name}": NO_UNIT,
        }
    values = np.stack([internals[channel] for channel in channels.values()]).T
    curve = Curve(Signal(internals.stamp_ns, tuple(channels), values), PLANT)
    return time_series_figure(context._replace(units=units), {"": curve}, columns=2, height=120)


def spectrum_figure(context: PlotContext) -> Figure | None:
    """Draw the amplitude spectral density of u of all flights, in a subplot for each channel.

    Both axes are logarithmic. A flight with fewer than MIN_SPECTRUM_SAMPLES is left out. Returns
    None if no flight remains.
    """
    units = context.units
    runs = {
        label: run
        for label, run in context.runs.items()
        if "u" in run.tape and len(run.tape["u"].stamp_ns) >= MIN_SPECTRUM_SAMPLES
    }
    if not runs:
        return None
    names = dict.fromkeys(chain.from_iterable(run.tape["u"].names for run in runs.values()))
    channels = in_order(names, units)
    columns = min(len(channels), 2)
    figure = Figure(len(channels), columns, 190, spacing=0.2)
    for label, run in runs.items():
        frequency, densities = spectra(run.tape["u"], run.period_ns)
        for name, density in densities.items():
            unit = units.get(name, NO_UNIT)
            style: dict[str, Any] = {
                "line": {"color": run.colour, "width": 1.4},
                "legendgroup": label,
                "showlegend": len(runs) > 1 and is_first_in_legend(figure, label),
                "hovertemplate": f"%{{y:.3g}} {unit.unit}/√Hz at %{{x:.3g}} Hz",
            }
            figure.add_scatter(
                label, frequency, density * unit.factor, channels.index(name), **style
            )
    for name, x, y in zip(channels, figure.x, figure.y, strict=True):
        title = {"text": f"{name} ({units.get(name, NO_UNIT).unit}/√Hz)"}
        y |= {"type": "log", "dtick": 1, "exponentformat": "power", "title": title}
        x |= {"type": "log", "tickvals": FREQUENCIES, "title": {"text": "Hz"}}
    figure.layout["meta"] = SHOWS_ANGLES
    return set_layout(figure, below=44)


def _timing_samples(tape: Tape, period_ns: int) -> dict[str, FloatArray]:
    """Return samples of the controller's timing, ms, by quantity.

    Quantities that are 0 throughout are left out.
    """
    samples: dict[str, FloatArray] = {}
    if "internals" in tape:
        periods = tick_periods(tape)
        samples["time between ticks, less whole periods"] = (
            periods - period_ns * np.round(periods / period_ns)
        ) / 1e6
        samples["tick after its deadline"] = tape["internals"]["late"] * 1e3
        samples["age of y at the tick"] = tape["internals"]["age"] * 1e3
    if "latency" in tape:
        samples["y sent to u sent"] = tape["latency"].values[:, 0] * 1e3
    return {
        quantity: values
        for quantity, values in samples.items()
        if len(values) and np.any(np.abs(values) > 1e-6)
    }


def timing_figure(context: PlotContext) -> Figure | None:
    """Draw histograms of the controller's timing, ms, or return None if all times are 0.

    Each quantity has a subplot, in which the flights share their bins. The axis with the number of
    ticks in a bin is logarithmic.
    """
    runs = context.runs
    timing = {label: _timing_samples(run.tape, run.period_ns) for label, run in runs.items()}
    quantities = list(dict.fromkeys(chain.from_iterable(timing.values())))
    if not quantities:
        return None
    columns = min(len(quantities), 2)
    figure = Figure(len(quantities), columns, 150, spacing=0.24)
    for index, quantity in enumerate(quantities):
        samples = {label: each[quantity] for label, each in timing.items() if quantity in each}
        edges = np.histogram_bin_edges(np.concatenate(list(samples.values())), bins=HISTOGRAM_BINS)
        for label, values in samples.items():
            counts = np.histogram(values, edges)[0].astype(float)
            width = edges[1] - edges[0]
            bars = {
                "type": "bar",
                "x": edges[:-1] + width / 2.0,
                "y": counts,
                "width": float(width),
                "name": label,
                "marker": {"color": runs[label].colour},
                "legendgroup": label,
                "showlegend": len(runs) > 1 and is_first_in_legend(figure, label),
                "opacity": 1.0 if len(runs) == 1 else 0.6,
                "hovertemplate": "%{y} ticks around %{x:.4g} ms",
            }
            figure.add(bars, index)
        figure.x[index]["title"] = {"text": f"{quantity} (ms)"}
        figure.y[index] |= {"type": "log", "title": {"text": "ticks"}}
    figure.layout["barmode"] = "overlay"
    return set_layout(figure, below=44)


def wind_figure(context: PlotContext) -> Figure | None:
    """Draw each component of the wind that is not always 0."""
    wind = _nonzero_group(context.tape, "gust")
    if not wind.names:
        return None
    units = dict.fromkeys(wind.names, DisplayUnit(unit="m/s", factor=1.0))
    return time_series_figure(context._replace(units=units), {"wind": Curve(wind, WIND)})


def state_figure(
    context: PlotContext, units: Mapping[str, DisplayUnit], labels: Mapping[str, str]
) -> Figure | None:
    """Draw the states of a simulated aircraft, beginning with the states that are outputs.

    `units` has the unit of each state. `labels` has axis labels that replace the names of channels.
    Returns None if the tape has no states.
    """
    x = _truth_group(context.tape, "x")
    outputs = {name: units[name] for name in context.units if name in units}
    context = context._replace(units={**outputs, **units})
    if not x.names:
        return None
    return time_series_figure(context, {"x": Curve(x, PLANT)}, columns=2, height=130, labels=labels)


def sensor_figure(context: PlotContext) -> Figure | None:
    """Draw the error of every sensor that has an error: y less the true output."""
    noise = _nonzero_group(context.tape, "noise")
    if noise.names:
        return time_series_figure(
            context, {"error": Curve(noise, ERROR, 0.8)}, columns=2, height=120
        )
    return None


def tick_figure(context: PlotContext) -> Figure | None:
    """Draw the lateness, the age of y and the dt of the controller's ticks.

    Returns None if each tick was in time and had a fresh y, and all dt are equal.
    """
    tape = context.tape
    channels = ("late", "age", "dt")
    if "internals" not in tape:
        return None
    ticks = tape["internals"]
    steps = ticks["dt"][ticks["dt"] > 0.0]
    if not (ticks["late"].any() or ticks["age"].any() or np.unique(steps).size > 1):
        return None
    signal = Signal(ticks.stamp_ns, channels, np.stack([ticks[name] for name in channels]).T)
    units = dict.fromkeys(channels, DisplayUnit(unit="ms", factor=1e3))
    return time_series_figure(
        context._replace(units=units), {"ticks": Curve(signal, PLANT, 1.0)}, height=100
    )


def _truth_group(tape: Tape, group: str) -> Signal:
    """Return the channels "group.NAME" of the topic `truth`, or no channels without this topic."""
    if "truth" in tape:
        return tape["truth"].group(group)
    return Signal(np.zeros(0, dtype=np.int64), (), np.zeros((0, 0)))


def _nonzero_group(tape: Tape, group: str) -> Signal:
    """Return the channels "group.NAME" of the topic `truth` that are not always 0."""
    signal = _truth_group(tape, group)
    nonzero = np.flatnonzero(signal.values.any(axis=0))
    return Signal(
        signal.stamp_ns, tuple(signal.names[i] for i in nonzero), signal.values[:, nonzero]
    )


def _saturated(tape: Tape, name: str, kind: Saturation) -> tuple[FloatArray, NDArray[np.bool_]]:
    """Return when one input was saturated in one way.

    The result has the times of the ticks, s, and a mask of the ticks with this kind of saturation.
    """
    channel = f"limited.{name}"
    if "internals" not in tape or channel not in tape["internals"].names:
        return np.zeros(0), np.zeros(0, dtype=bool)
    return tape.time("internals"), tape["internals"][channel] == kind


def _axis_range(values: FloatArray, bounds: FloatArray) -> tuple[float, float]:
    """Return the range of an axis that shows all values, and the bounds near the values."""
    low = float(values.min(initial=0.0))
    high = float(values.max(initial=0.0))
    near = [
        bound
        for bound in bounds
        if 0.0 < bound <= LIMIT_VIEW_RATIO * high or LIMIT_VIEW_RATIO * low <= bound < 0.0
    ]
    low = min([low, *near])
    high = max([high, *near])
    margin = 0.06 * (high - low) or 1.0
    return low - margin, high + margin
