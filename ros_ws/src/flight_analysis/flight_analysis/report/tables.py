# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""The tables of the report, as HTML: figures of one flight, or of several beside each other."""

from collections.abc import Iterable, Mapping, Sequence
from html import escape
from itertools import groupby, product
from typing import Any, NamedTuple

from flight_analysis.metrics import BAND, NOISE_BAND, PARTS, SETTLE, Windows
from flight_analysis.report import figures
from flight_analysis.report.comparison import ComparisonBlock, ComparisonRow
from flight_analysis.report.summary import (
    ERROR_COLUMNS,
    INPUT_COLUMNS,
    MORE_ERROR_COLUMNS,
    Column,
    DisplayUnit,
    cell,
    limited_cell,
    slowest,
    table_rows,
)
from flight_core.tape import Tape
from rise_di_controller.internals import Saturation

READING = (
    f"{PARTS}. bound: the largest error in calm. switches: of the sign term's direction. settling: until the error stays for"
    f" {SETTLE:g} s within {BAND:.0%} of the largest y_m, or within {NOISE_BAND:g} floors where it is measured; the slowest"
)
FLOOR_READING = ". floor: what no error can be told from, the noise of y or its rounding"
INPUT_READING = "u about trim; rate: mean abs(u_dot), in the unit of the row a second"
LIMITED_READING = "; limited: ticks held back by magnitude / by rate"
ALIKE = 0.05  # share by which figures may differ and still be as good as each other


class Event(NamedTuple):
    """Something that happened in a flight, from its first to its last instant in s."""

    what: str
    start: float
    stop: float
    how_much: str


def events(tape: Tape, gusts: Windows) -> list[Event]:
    """Gusts, modes other than ENGAGED, and limits that the controller reached, one event each, by their first instant."""
    found = []
    marked = figures.gust_bands(tape, gusts) + figures.mode_bands(tape)
    for label, group in groupby(marked, key=lambda band: band.label):
        bands = list(group)
        times = f", {len(bands)} times" if len(bands) > 1 else ""
        found.append(Event(label, bands[0].start, bands[-1].stop, f"{sum(b.stop - b.start for b in bands):.2f} s{times}"))
    if "internals" in tape:
        limited, t = tape["internals"].group("limited"), tape.time("internals")
        for name, what in product(limited.names, (Saturation.MAGNITUDE, Saturation.RATE)):
            hit = limited[name] == what
            if hit.any():
                first, last = t[hit][[0, -1]]
                found.append(Event(f"{name} limited: {what.name.lower()}", first, last, f"{hit.sum()} of {len(hit)} ticks"))
    return sorted(found, key=lambda event: event.start)


def error_table(summary: Mapping[str, Any], units: Mapping[str, DisplayUnit]) -> str:
    """Figures of the error, a row a channel."""
    columns = ERROR_COLUMNS + MORE_ERROR_COLUMNS
    rows = [
        [*row, *(slowest(summary, channel, kind) for kind in ("command", "gust"))]
        for channel, row in zip(summary["errors"], table_rows(summary["errors"], columns, units), strict=True)
    ]
    settling = tuple(Column("settling (s)", head, ()) for head in ("command", "gust"))
    return table(f"Tracking error ({summary['error']})", columns + settling, rows, READING + FLOOR_READING)


def input_table(summary: Mapping[str, Any], units: Mapping[str, DisplayUnit]) -> str:
    """Figures of the inputs, a row an input; empty where none is known."""
    if not summary["inputs"]:
        return ""
    rows = [
        [*row, limited_cell(of)]
        for row, of in zip(table_rows(summary["inputs"], INPUT_COLUMNS, units), summary["inputs"].values(), strict=True)
    ]
    return table("Inputs", (*INPUT_COLUMNS, Column("limited", "%", ())), rows, INPUT_READING + LIMITED_READING)


def event_table(happened: Sequence[Event]) -> str:
    """What happened, a row an event; empty where nothing did."""
    if not happened:
        return ""
    columns = [Column("", head, ()) for head in ("from (s)", "to (s)", "")]
    rows = [(event.what, f"{event.start:.2f}", f"{event.stop:.2f}", event.how_much) for event in happened]
    return table("What happened", columns, rows)


def tick_table(summary: Mapping[str, Any]) -> str:
    """Figures of the controller's time; empty where there are none."""
    ticks, latency = summary["ticks"], summary["latency"]
    if ticks is None:
        return ""

    def ms(*values: float) -> str:
        return " / ".join(f"{value * 1e3:.3f}" for value in values)

    rows = [
        ("ticks", f"{ticks['ticks']}"),
        ("periods without a new y", f"{ticks['without_new_y']}"),
        ("period mean / p99 / max (ms)", ms(ticks["period_mean"], ticks["period_p99"], ticks["period_max"])),
        ("jitter rms (ms)", ms(ticks["jitter"])),
        ("after the deadline p99 / max (ms)", ms(ticks["late_p99"], ticks["late_max"])),
        ("age of y p99 (ms)", ms(ticks["age_p99"])),
    ]
    if latency is not None:
        rows.append(("y sent to u sent median / p99 / max (ms)", ms(*latency.values())))
    return table("Ticks of the controller", [Column("", "", ())], rows)


def compared_tables(blocks: Sequence[ComparisonBlock], dots: Sequence[str]) -> str:
    """A table a block: the figure of each flight under its dot, from the second on with its ratio to the first."""
    head = "".join(f'<th class="first">{dot}</th>{"<th></th>" * (k > 0)}' for k, dot in enumerate(dots))
    return "".join(
        _framed(
            block.name,
            f"<tr><th></th>{head}</tr>",
            "".join(f"<tr><td>{escape(row.what)}</td>{_compared_cells(row)}</tr>" for row in block.rows),
        )
        for block in blocks
    )


def dot(colour: str, in_the_dark: str) -> str:
    """The mark of a flight."""
    return f'<span class="dot" style="background: {colour}; background: light-dark({colour}, {in_the_dark})"></span>'


def _compared_cells(row: ComparisonRow) -> str:
    cells = ""
    for k, (text, ratio) in enumerate(zip(row.texts, row.ratios, strict=True)):
        cells += f'<td class="first">{escape(text)}</td>'
        if k > 0:
            times = "" if ratio is None else f"&times;{cell(ratio) if ratio < 100.0 else f'{ratio:.0f}'}"
            cells += f'<td class="{_verdict(ratio, row.judged)}">{times}</td>'
    return cells


def _verdict(ratio: float | None, judged: bool) -> str:
    if ratio is None or not judged or abs(ratio - 1.0) < ALIKE:
        return "same"
    return "better" if ratio < 1.0 else "worse"


def table(caption: str, columns: Sequence[Column], rows: Iterable[Sequence[str]], said: str = "") -> str:
    """A table whose first column is the rows' names; neighbours of one group share a head."""
    groups = [(group, len(list(of))) for group, of in groupby(columns, key=lambda column: column.group)]
    firsts = {k for k, column in enumerate(columns) if k == 0 or not column.group or column.group != columns[k - 1].group}

    def cells(texts: Sequence[str], tag: str) -> str:
        marks = (' class="first"' if k in firsts else "" for k in range(len(texts)))
        return "".join(f"<{tag}{mark}>{escape(text)}</{tag}>" for mark, text in zip(marks, texts, strict=True))

    over = "".join(f'<th class="group" colspan="{count}">{escape(group)}</th>' for group, count in groups)
    head = f"<tr><th></th>{over}</tr>" if any(group for group, _ in groups) else ""
    if any(column.head for column in columns):
        head += f"<tr><th></th>{cells([column.head for column in columns], 'th')}</tr>"
    body = "".join(f"<tr><td>{escape(name)}</td>{cells(texts, 'td')}</tr>" for name, *texts in rows)
    return _framed(caption, head, body, said)


def _framed(caption: str, head: str, body: str, said: str = "") -> str:
    hint = f'<p class="hint">{escape(said)}</p>' if said else ""
    return f"<div><table><caption>{escape(caption)}</caption><thead>{head}</thead><tbody>{body}</tbody></table>{hint}</div>"
