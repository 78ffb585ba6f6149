# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""What a paper needs of flights: a figure as vectors in the width of a column, a MAT-file, a table
a topic, LaTeX.
"""

import re
from collections.abc import Iterable, Mapping, Sequence
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from flight_analysis.metrics import best_error
from flight_analysis.report import comparison
from flight_analysis.report.display_units import NO_UNIT, channel_label
from flight_analysis.report.figures import GUST, REFERENCE, flight_end, gust_intervals
from flight_analysis.report.summary import RecordedFlight, taken_over
from flight_analysis.report.summary_rows import ERROR_COLUMNS, INPUT_COLUMNS, columns_of, table_rows
from flight_core.arguments import as_names
from flight_core.files import replacing, write_file
from flight_core.parameters import one_of, require
from flight_core.rates import NANOSECONDS
from flight_core.tape import Signal, Tape
from flight_core.text import printable
from flight_core.units import FOOT, in_si

if TYPE_CHECKING:  # it loads in some tenths of a second
    from matplotlib.axes import Axes

FORMATS = ("pdf", "svg", "eps", "png")
WIDTH = "88mm"  # a column of IEEE and of many journals
# m
NARROWEST = 0.03
WIDEST = 1.0
# height of a channel over the width; inches
ROW_RATIO = 0.42
LEGEND_HEIGHT = 0.35
FONT_SIZE = 8.0  # points
LINE_WIDTH = 0.8  # points
DPI = 300.0  # of PNG
STYLE: Any = {
    "font.size": FONT_SIZE,
    "axes.linewidth": 0.5,
    "xtick.major.width": 0.5,
    "ytick.major.width": 0.5,
    "pdf.fonttype": 42,  # TrueType: publishers refuse Type 3
    "ps.fonttype": 42,
    "svg.fonttype": "none",  # text stays text
    "svg.hashsalt": "rise-di",  # the same file for the same flight
}
MATLAB_NAME = 63  # characters of a name at most
MATLAB_KEYWORDS = (
    "break case catch classdef continue else elseif end for function global if otherwise parfor "
    "persistent return spmd switch try while"
)


def write_figure(
    path: Path,
    flights: Sequence[RecordedFlight],
    width: str | float = WIDTH,
    channels: str | Sequence[str] = (),
) -> None:
    """Write a figure for a paper: a row a channel, y over y_m, the error or u, in the width of a
    column.

    Args:
        path: File: .pdf, .svg and .eps have vectors and text, .png pixels.
        flights: The flights, one curve each.
        width: Width of the figure, with a unit ("88mm", "3.5in") or in m.
        channels: Names of outputs (y over y_m) and inputs (u), and "e.NAME" for the error of an
            output; empty: each output.

    Raises ParameterError for a different ending, an unknown channel and a width that is not 30 mm
    to 1 m.
    """
    import matplotlib as mpl  # noqa: PLC0415
    from matplotlib.figure import Figure  # noqa: PLC0415

    suffix = path.suffix.removeprefix(".").lower()
    require(
        suffix in FORMATS,
        "figure",
        f"{path.name}",
        f"a name that ends in {', '.join(f'.{name}' for name in FORMATS)}",
    )
    metres = in_si(width, "width", "m")
    require(
        NARROWEST <= metres <= WIDEST, "width", f"{width}", "30 mm to 1 m, with a unit as in 88mm"
    )
    outputs, errors, inputs = channels_by_title(flights).values()
    known = [*outputs, *inputs, *errors]
    wanted = as_names(channels, "channels", "names of channels: q,V,elevator") or tuple(outputs)
    for name in wanted:
        require(name in known, "channels", f"{name!r}", one_of(known, name))
    inches = metres / (FOOT / 12.0)
    with mpl.rc_context(STYLE):
        figure = Figure(
            figsize=(inches, ROW_RATIO * inches * len(wanted) + LEGEND_HEIGHT), layout="constrained"
        )
        grid = figure.subplots(len(wanted), 1, sharex=True, squeeze=False)[:, 0]
        for axes, name in zip(grid, wanted, strict=True):
            draw_channel(axes, flights, name)
        grid[-1].set_xlabel("t (s)")
        grid[-1].set_xlim(0.0, last_instant(flights))
        handles: dict[str, Any] = {}
        for axes in grid:
            lines, labels = axes.get_legend_handles_labels()
            handles |= dict(zip(labels, lines, strict=True))
        figure.legend(
            handles.values(), handles.keys(), loc="outside upper left", ncols=2, frameon=False
        )
        stamps = {"pdf": {"CreationDate": None}, "svg": {"Date": None}}.get(suffix, {})
        with replacing(path) as stream:
            figure.savefig(stream, format=suffix, dpi=DPI, metadata=stamps or None)


def channels_by_title(flights: Sequence[RecordedFlight]) -> dict[str, list[str]]:
    """Names of outputs, errors ("e.NAME") and inputs of all flights, by title."""
    names: dict[str, dict[str, None]] = {"y": {}, "y_m": {}, "u": {}}
    for flight in flights:
        for topic in names.keys() & flight.tape.signals.keys():
            names[topic] |= dict.fromkeys(flight.tape[topic].names)
    errors = [f"e.{name}" for name in names["y"] if names["y_m"]]
    return {"y, over y_m": [*names["y"]], "e = y - y_m": errors, "u": [*names["u"]]}


def last_instant(flights: Sequence[RecordedFlight]) -> float:
    """The end of the longest flight, s; 1 without samples."""
    return max(flight_end(flight.tape) for flight in flights) or 1.0


def draw_channel(
    axes: "Axes", flights: Sequence[RecordedFlight], name: str, line_width: float = LINE_WIDTH
) -> None:
    """Draw a channel of each flight, with the reference and the gusts of the first."""
    units = comparison.units(flights)
    plain = name.removeprefix("e.")
    is_error = name != plain
    first = flights[0]
    is_output = any(plain in flight.tape["y"].names for flight in flights if "y" in flight.tape)
    factor = units.get(plain, NO_UNIT).factor

    def plot(tape: Tape, signal: Signal, **style: Any) -> None:
        axes.plot((signal.stamp_ns - tape.start_ns) / NANOSECONDS, signal[plain] * factor, **style)

    for gust in gust_intervals(first.tape, first.gusts):
        axes.axvspan(gust.start, gust.stop, color=GUST, alpha=0.2, linewidth=0)
    if is_output and not is_error and "y_m" in first.tape and plain in first.tape["y_m"].names:
        plot(
            first.tape, first.tape["y_m"], color=REFERENCE, linewidth=3.0 * line_width, label="y_m"
        )
    for (label, colour), flight in zip(comparison.colours(flights).items(), flights, strict=True):
        tape = flight.tape
        signal = best_error(tape)[1] if is_error else tape.signals.get("y" if is_output else "u")
        if signal is not None and plain in signal.names:
            drawn = {} if is_output else {"drawstyle": "steps-post"}
            shown = label if len(flights) > 1 else ("y" if is_output and not is_error else "")
            plot(tape, signal, color=colour, linewidth=line_width, label=shown, **drawn)
    axes.set_ylabel(("e of " if is_error else "") + channel_label(plain, units))
    axes.grid(alpha=0.3, linewidth=0.4)
    axes.spines[["top", "right"]].set_visible(False)


def write_mat(path: Path, flights: Sequence[RecordedFlight]) -> None:
    """Write a MAT-file of version 5: a structure a topic with stamp_ns, t in s and a column a
    channel, SI.

    Several flights are structures run_1, run_2, ... with the name of the run in `name`. Names are
    those that MATLAB permits: "Pi.q" is Pi_q. `channels` has the names of the log by the names of
    MATLAB.
    """
    from scipy.io import savemat  # noqa: PLC0415

    require(path.suffix == ".mat", "mat", f"{path.name}", "a name that ends in .mat")
    runs = [_mat_structure(flight) for flight in flights]
    content = (
        runs[0] if len(runs) == 1 else {f"run_{k}": run for k, run in enumerate(runs, start=1)}
    )
    buffer: Any = BytesIO()
    savemat(buffer, content, do_compression=True, long_field_names=True, oned_as="column")
    write_file(path, buffer.getvalue())


def _mat_structure(flight: RecordedFlight) -> dict[str, Any]:
    """Structures by topic of a flight."""
    structure: dict[str, Any] = {}
    topics = matlab_names(flight.tape.signals)
    original: dict[str, dict[str, str]] = {}
    for topic, signal in flight.tape.signals.items():
        names = matlab_names(signal.names, used_names=("stamp_ns", "t"))
        columns = {names[name]: np.asarray(signal[name], dtype=np.float64) for name in signal.names}
        t = (signal.stamp_ns - flight.tape.start_ns) / NANOSECONDS
        structure[topics[topic]] = {"stamp_ns": signal.stamp_ns.astype(np.int64), "t": t, **columns}
        original[topics[topic]] = {permitted: name for name, permitted in names.items()}
    units = {name: unit.unit for name, unit in flight.units.items()}
    notes: dict[str, Any] = {
        "name": flight.name,
        "outcome": str(flight.summary["outcome"]["sentence"]),
    }
    notes |= {"scenario": flight.summary["scenario"] or ""}
    free = matlab_names(("info",), used_names=structure)
    notes |= {
        "units_of_report": {matlab_names((name,))[name]: unit for name, unit in units.items()},
        "channels": original,
    }
    return structure | {free["info"]: notes}


def matlab_names(names: Iterable[str], used_names: Iterable[str] = ()) -> dict[str, str]:
    """Names that MATLAB permits by name: letters, digits and _, a letter first, 63 characters, no
    keyword, each once.
    """
    used = set(used_names)
    permitted = {}
    for name in names:
        plain = re.sub(r"[^A-Za-z0-9_]", "_", name)
        plain = (
            plain
            if re.match(r"[A-Za-z]", plain) and plain not in MATLAB_KEYWORDS.split()
            else f"x_{plain}"
        )
        plain = plain[:MATLAB_NAME]
        count = 1
        while plain in used:
            count += 1
            plain = f"{plain[: MATLAB_NAME - 4].removesuffix(f'_{count - 1}')}_{count}"
        used.add(plain)
        permitted[name] = plain
    return permitted


def write_tables(folder: Path, flights: Sequence[RecordedFlight]) -> None:
    """Write a CSV a topic, RUN_TOPIC.csv of several flights and TOPIC.csv of one: stamp_ns, t in s
    and the channels, SI.

    A table has the rows of its own topic, so no cell is empty.
    """
    import polars as pl  # noqa: PLC0415

    folder.mkdir(parents=True, exist_ok=True)
    for label, flight in zip(comparison.labels(flights), flights, strict=True):
        for topic, signal in flight.tape.signals.items():
            t = (signal.stamp_ns - flight.tape.start_ns) / NANOSECONDS
            columns = {
                "stamp_ns": signal.stamp_ns,
                "t": t,
                **{name: signal[name] for name in signal.names},
            }
            stem = topic if len(flights) == 1 else f"{label}_{topic}"
            with replacing(folder / f"{re.sub(r'[^A-Za-z0-9_.() -]', '_', stem)}.csv") as stream:
                pl.DataFrame(columns).write_csv(stream)


def write_latex(path: Path, flights: Sequence[RecordedFlight]) -> None:
    """Write the tables of errors and of inputs as LaTeX, a tabular each, with the rules of
    booktabs.
    """
    parts = []
    for label, flight in zip(comparison.labels(flights), flights, strict=True):
        units = flight.units
        for title, key, known in (
            ("Tracking error", "errors", ERROR_COLUMNS),
            ("Inputs about trim", "inputs", INPUT_COLUMNS),
        ):
            if not flight.summary[key]:
                continue
            columns = columns_of(known, flight.summary[key])
            heads = [" ".join(filter(None, (column.group, column.head))) for column in columns]
            rows = table_rows(flight.summary[key], columns, units)
            caption = f"{title}, {label}{taken_over(flight.summary, key)}"
            parts.append(_tabular(caption, ["channel", *heads], rows))
    write_file(path, "% needs \\usepackage{booktabs}\n" + "\n".join(parts))


def _tabular(title: str, heads: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    lines = [" & ".join(map(latex_text, row)) + r" \\" for row in (heads, *rows)]
    body = [
        f"% {printable(title)}",
        rf"\begin{{tabular}}{{l{'r' * (len(heads) - 1)}}}",
        r"\toprule",
        lines[0],
        r"\midrule",
        *lines[1:],
    ]
    return "\n".join([*body, r"\bottomrule", r"\end{tabular}", ""])


LATEX: Mapping[str, str] = {
    "\\": r"\textbackslash{}",
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
    **{sign: f"\\{sign}" for sign in "&%$#_{}"},
}
"""What stands for the characters that LaTeX reads as commands."""


def latex_text(text: str) -> str:
    """A text as LaTeX prints it."""
    return "".join(LATEX.get(sign, sign) for sign in text)
