# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Show the margins of a linear loop as a table, as JSON, and as Bode and Nyquist plots."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from flight_analysis.linear_loop.guarantee import Guarantee, Unstable
from flight_analysis.linear_loop.input_margins import Margins, disk_gain, disk_phase, loop_transfer
from flight_analysis.linear_loop.loop_margins import LinearLoop, LoopMargins
from flight_analysis.report.display_units import NO_VALUE
from flight_analysis.report.figures import COLOURS
from flight_analysis.report.flown_models import FlownLoops
from flight_analysis.report.plotting import Figure, add_line, axis, is_first_in_legend, set_layout
from flight_analysis.report.summary_rows import Column
from flight_analysis.report.tables import MetricTable
from flight_core.vectors import FloatArray

MARGIN_COLUMNS = (
    Column(group="phase", head="deg"),
    Column(group="at", head="rad/s"),
    Column(group="gain", head="dB"),
    Column(group="largest", head="S"),
    Column(group="disk", head=""),
    Column(group="delay", head="ms"),
)
ALONE = ".3g"  # format of a column that does not show the worst aircraft
FORMATS = (".0f", ALONE, ".2g", ".2f", ".2f", ".0f")  # format of each of MARGIN_COLUMNS
ALL_INPUTS = "all inputs"
MARGIN_WORDS = ("phase", "gain", "largest S", "disk", "delay", ALL_INPUTS)
"""Words of the glossary that explain margins."""
SHOWN_DAMPING = 0.8  # slow modes with less damping are listed
FREQUENCIES_SHOWN = 240  # number of frequencies of Bode and Nyquist plots
LOWEST_SHOWN = 1e-3  # lowest frequency of the plots, as a fraction of pi / T
NYQUIST_RANGE = ((-3.0, 1.0), (-2.0, 2.0))  # real and imaginary range around the point -1
UNIT_CIRCLE = "#8c8c8c"
BOUND = "#444444"


def decibels(factor: FloatArray | float) -> FloatArray:
    """Convert a factor to decibels: 20 log10 of the factor."""
    with np.errstate(divide="ignore"):
        return np.asarray(20.0 * np.log10(factor))


def margin_rows(margins: LoopMargins) -> list[list[str]]:
    """Return a row of cells for each input, and a last row for ALL_INPUTS.

    A row has the cells that MARGIN_COLUMNS names. A cell has the value of the nominal aircraft, and
    in parentheses the value of the worst uncertain aircraft.
    """
    columns = _values(margins.nominal, (*margins.channel_delay, margins.delay))
    uncertain = columns
    if margins.worst is not None:
        uncertain = _values(
            margins.worst, (*[math.nan] * len(margins.inputs), margins.worst_delay or 0.0)
        )
    rows = []
    for i, name in enumerate((*margins.inputs, ALL_INPUTS)):
        pairs = zip(columns, uncertain, FORMATS, strict=True)
        rows.append(
            [
                name,
                *(
                    _cell(values[i], None if margins.worst is None else worst[i], form)
                    for values, worst, form in pairs
                ),
            ]
        )
    return rows


def _values(margins: Margins, delay: Sequence[float]) -> list[list[float]]:
    """Return a row of margins for each of MARGIN_COLUMNS, in its unit. NaN means no value."""
    phase = np.append(margins.phase, disk_phase(margins.disk_all))
    gain = np.append(margins.gain, disk_gain(margins.disk_all))
    return [
        np.degrees(phase).tolist(),
        [*margins.crossover.tolist(), math.nan],
        decibels(gain).tolist(),
        [*margins.sensitivity.tolist(), float(margins.sensitivity_all)],
        [*margins.disk.tolist(), float(margins.disk_all)],
        [1e3 * value for value in delay],
    ]


def _cell(value: float, worst: float | None, form: str) -> str:
    """Write a value, followed in parentheses by the value of the worst aircraft."""

    def text(number: float) -> str:
        if math.isnan(number):
            return NO_VALUE
        return "none" if math.isinf(number) else format(number, form)

    if worst is None or math.isnan(worst) or form == ALONE:
        return text(value)
    return f"{text(value)} ({text(worst)})"


LEAST_MARGINS = {
    "phase margin, deg": ".0f",
    "gain margin, dB": ".2g",
    "largest sensitivity": ".2f",
    "disk margin, all inputs": ".2f",
    "damping of slow modes": ".2f",
    "delay margin, ms": ".0f",
}
"""The least margins of a loop, each with its format. They hold for the worst input, or for all
inputs at once."""


def least_margins(margins: LoopMargins | None) -> list[str]:
    """Return the margins of LEAST_MARGINS as text, with the worst aircraft in parentheses.

    LEAST_MARGINS are the columns of a table with one row for each loop.
    """
    if margins is None:
        return [NO_VALUE] * len(LEAST_MARGINS)
    nominal = _least(margins.nominal, margins.delay)
    worst = None if margins.worst is None else _least(margins.worst, margins.worst_delay or 0.0)
    formats = LEAST_MARGINS.values()
    uncertain = [None] * len(nominal) if worst is None else worst
    return [_cell(*values) for values in zip(nominal, uncertain, formats, strict=True)]


def _least(margins: Margins, delay: float) -> list[float]:
    """Return the margins of LEAST_MARGINS, each in the unit that its name states."""
    phase = np.degrees(margins.phase.min())
    gain = decibels(margins.gain.min())
    values = (
        phase,
        gain,
        margins.sensitivity.max(),
        margins.disk_all,
        margins.damping,
        1e3 * delay,
    )
    return [float(value) for value in values]


def modes_text(margins: LoopMargins) -> str:
    """Write a sentence on the slow modes that have little damping."""
    every = zip(margins.modes.frequency, margins.modes.damping, strict=True)
    slow_modes = [(w, zeta) for w, zeta in every if zeta < SHOWN_DAMPING]
    modes = ", ".join(f"{w:.3g} rad/s {zeta:.2f}" for w, zeta in slow_modes)
    if margins.worst is not None:
        least = f"; least of the uncertain aircraft {float(margins.worst.damping):.2f}"
    else:
        least = ""
    return f"slow modes and their damping: {modes or f'all above {SHOWN_DAMPING:g}'}{least}"


def margin_table(
    margins: LoopMargins, guarantee: Guarantee | None = None, differences: Sequence[str] = ()
) -> MetricTable:
    """Return the table of the margins of a flight's loop, with the guarantee for this loop.

    `differences` are sentences on how the aircraft differs from the controller's parameters.
    """
    sentences = [*differences, modes_text(margins)]
    sentences += [] if guarantee is None else guarantee_text(guarantee)
    return MetricTable(
        "Margins of the linear loop",
        MARGIN_COLUMNS,
        margin_rows(margins),
        ". ".join(sentences),
        MARGIN_WORDS,
    )


def flown_margin_table(flown: FlownLoops) -> MetricTable:
    """Return the table of the least margins of a flight's loops, with a row for each loop."""
    columns = [
        Column(group="used", head="from to (s)"),
        Column(group="", head="aircraft"),
        Column(group="phase", head="deg"),
        Column(group="gain", head="dB"),
        Column(group="largest", head="S"),
        Column(group="disk", head=""),
        Column(group="damping", head=""),
        Column(group="delay", head="ms"),
    ]
    rows = [
        [loop.name or "law", loop.times, loop.aircraft, *least_margins(loop.margins)]
        for loop in flown.loops
    ]
    note = (
        "Phase, gain and S belong to the worst input, and disk and delay to all inputs at "
        "once. The aircraft is the one of the file, or the true one as simulated before a drift"
    )
    note = ". ".join([*flown.sentences, note])
    return MetricTable("Margins of the linear loop, by the parameters in use", columns, rows, note)


def margins_as_json(margins: LoopMargins) -> dict[str, Any]:
    """Return the margins in SI as a dict that JSON can hold.

    Gains are factors, not dB. An infinite value is None.
    """
    nominal = _aircraft_as_json(margins.nominal, margins.inputs) | {
        "stable": bool(margins.nominal.stable)
    }
    nominal["modes"] = [
        {"frequency": w, "damping": zeta} for w, zeta in zip(*map(list, margins.modes), strict=True)
    ]
    nominal["delay"] = {
        "all": margins.delay,
        "inputs": dict(zip(margins.inputs, margins.channel_delay, strict=True)),
    }
    result: dict[str, Any] = {"nominal": nominal}
    if margins.worst is not None:
        result["worst"] = _aircraft_as_json(margins.worst, margins.inputs) | {
            "delay": {"all": margins.worst_delay}
        }
        result |= {"aircraft": margins.aircraft, "stable": margins.stable}
    return result


def _aircraft_as_json(margins: Margins, inputs: Sequence[str]) -> dict[str, Any]:
    each = ("phase", "crossover", "gain_decrease", "gain_increase", "sensitivity", "disk")
    by_input = {}
    for i, name in enumerate(inputs):
        by_input[name] = {key: float(getattr(margins, key)[i]) for key in each}
    together = {"disk": float(margins.disk_all), "sensitivity": float(margins.sensitivity_all)}
    return {"inputs": by_input, "all": together, "damping": float(margins.damping)}


def guarantee_text(guarantee: Guarantee) -> list[str]:
    """Return a guarantee as sentences, which define stability and name the exact entries."""
    if guarantee.stable == 0.0:
        return ["guarantee: none, not even the aircraft of the file is proved stable"]
    late = f", u up to {1e3 * guarantee.late:g} ms late" if guarantee.late else ""
    lags = "lags, " if guarantee.has_exact_lags else ""
    zero = "each entry that is 0"
    within = (
        f"the linear loop is stable for every aircraft within {proved_percent(guarantee.stable)}"
    )
    if guarantee.zeros:
        zero = "each other entry that is 0"
        within += f", entries that are 0 within {proved_percent(guarantee.zeros)} of their rows"
    exact = ", ".join((*guarantee.exact, f"{lags}delay, period, {zero}"))
    lines = [
        f"guarantee: {within}{late} (certificate {guarantee.certificate})",
        f"stable: no mode grows by more than 1e-6 a tick; exact in every aircraft: {exact}",
        _first_found(guarantee.unstable),
    ]
    if (alone := guarantee.zeros_alone) is not None:
        lines.append(
            f"entries that are 0, beside exact others: stable within {proved_percent(alone.stable)}"
            f" of their rows (no certificate without --zeros); {_first_found(alone.unstable)}"
        )
    if not guarantee.is_proved:
        percent = 100.0 * guarantee.uncertainty
        lines.append(
            f"an aircraft within {percent:g} % may be unstable: no disk margin is guaranteed"
        )
    return lines


def proved_percent(part: float) -> str:
    """Write a proved deviation as a percentage, rounded down."""
    return f"{math.floor(1e3 * part) / 10.0:.1f} %"


def found_percent(part: float) -> str:
    """Write the deviation of an unstable aircraft as a percentage, rounded up."""
    return f"{math.ceil(1e3 * part) / 10.0:.1f} %"


def _first_found(first: Unstable | None) -> str:
    if first is None:
        return "no unstable aircraft found within 99 %"
    place = f"at {found_percent(first.deviation)} ({first.frequency:.2g} rad/s)"
    sequence = f", u late in a sequence of {len(first.late)} ticks" if first.late else ""
    return f"the first unstable aircraft found: {place}{sequence}"


def guarantee_rows(guarantee: Guarantee, margins: LoopMargins) -> list[tuple[str, float, float]]:
    """Return a row for each input, and a last row for ALL_INPUTS.

    A row has the name of the input, the guaranteed disk margin, and the least disk margin that a
    search has found.
    """
    worst = margins.worst
    least_disks = [math.nan] * (len(guarantee.disk) + 1)
    if worst is not None:
        least_disks = [*worst.disk.tolist(), float(worst.disk_all)]
    disks = guarantee.disk | {ALL_INPUTS: guarantee.disk_all}
    return list(zip(disks.keys(), disks.values(), least_disks, strict=True))


# Bode and Nyquist plots


def bode_figure(loops: Mapping[str, LinearLoop]) -> Figure:
    """Draw gain and phase of L_i over the frequency for the nominal aircraft.

    Each input has a column, with a curve for each loop by label.
    """
    inputs = _inputs(loops)
    count = len(inputs)
    figure = Figure(2 * count, count, 220, spacing=0.06)
    for (label, loop), colour in zip(loops.items(), _colours(list(loops)), strict=True):
        w, L = _response(loop)
        for k in range(count):
            phase = np.degrees(np.unwrap(np.angle(L[:, k])))
            phase -= 360.0 * np.ceil(phase[0] / 360.0)
            add_curve(figure, k, label, w, decibels(np.abs(L[:, k])), colour, "dB")
            add_curve(figure, k + count, label, w, phase, colour, "deg")
    ends = [float(w[0]), float(w[-1])]
    for place in range(2 * count):
        level = 0.0 if place < count else -180.0
        add_line(
            figure, place, "", ends, [level, level], {"color": BOUND, "width": 1.0, "dash": "dot"}
        )
        figure.data[-1]["showlegend"] = False
        figure.x[place] |= {
            "type": "log",
            "range": [math.log10(end) for end in ends],
            "showticklabels": place >= count,
        }
    for k, name in enumerate(inputs):
        figure.x[k + count] |= {"title": {"text": f"{name}, rad/s"}, "matches": None}
        figure.y[k] |= {"range": [-60.0, 60.0]}
        figure.y[k + count] |= {"dtick": 90.0}
    figure.y[0] |= {"title": {"text": "gain (dB)"}}
    figure.y[count] |= {"title": {"text": "phase (deg)"}}
    return set_layout(figure, below=44)


def nyquist_figure(loops: Mapping[str, LinearLoop]) -> Figure:
    """Draw L_i around the point -1, with the unit circle and the circle of sensitivity 2.

    Each input has a subplot, with a curve for each loop by label.
    """
    inputs = _inputs(loops)
    figure = Figure(len(inputs), min(len(inputs), 2), 420, spacing=0.08)
    turn = np.linspace(0.0, 2.0 * np.pi, 181)
    circles = {
        "abs(L) = 1": (np.cos(turn), np.sin(turn), UNIT_CIRCLE),
        "S = 2": (0.5 * np.cos(turn) - 1.0, 0.5 * np.sin(turn), BOUND),
    }
    across, up = NYQUIST_RANGE
    point = {"symbol": "cross", "size": 9, "color": BOUND}
    for k, name in enumerate(inputs):
        for label, (x, y, colour) in circles.items():
            line = {"color": colour, "width": 1.0, "dash": "dot"}
            add_line(figure, k, label, x.tolist(), y.tolist(), line)
        figure.add_scatter("-1", [-1.0], [0.0], k, "markers", marker=point, showlegend=False)
        figure.x[k] |= {
            "title": {"text": f"{name}, Re L"},
            "range": list(across),
            "constrain": "domain",
        }
        figure.y[k] |= {
            "title": {"text": "Im L"},
            "range": list(up),
            "scaleanchor": axis("x", k),
        }
    for (label, loop), colour in zip(loops.items(), _colours(list(loops)), strict=True):
        _, L = _response(loop)
        for k in range(len(inputs)):
            near = np.abs(L[:, k]) < 10.0
            x, y = L[near, k].real, L[near, k].imag
            add_curve(figure, k, label, x, y, colour, "")
    return set_layout(figure, below=44)


def _inputs(loops: Mapping[str, LinearLoop]) -> tuple[str, ...]:
    return next(iter(loops.values())).inputs


def add_curve(
    figure: Figure, place: int, label: str, x: FloatArray, y: FloatArray, colour: str, unit: str
) -> None:
    """Add a curve of a loop to a subplot. Curves with the same label share a legend entry."""
    hover = f"%{{y:.3g}} {unit} at %{{x:.3g}} rad/s" if unit else "%{x:.3g} %{y:+.3g} j"
    figure.add_scatter(
        label, x, y, place, legendgroup=label, line={"color": colour, "width": 1.4},
        showlegend=bool(label) and is_first_in_legend(figure, label), hovertemplate=hover,
    )  # fmt: skip


def _response(loop: LinearLoop) -> tuple[FloatArray, Any]:
    highest = math.pi / loop.loop.period
    w = np.geomspace(LOWEST_SHOWN * highest, highest, FREQUENCIES_SHOWN)
    return w, loop_transfer(loop.nominal, loop.law, loop.loop, w)


def _colours(names: Sequence[str]) -> list[str]:
    return [COLOURS[k % len(COLOURS)] for k in range(len(names))]
