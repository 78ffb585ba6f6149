# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Build the tables of a flight's report page as data, which page.html.jinja turns into HTML."""

import re
from collections.abc import Mapping, Sequence
from itertools import chain, groupby, product
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from flight_analysis.closed_loop.scenario import Scenario
from flight_analysis.metrics.errors import MEASURED_ERROR, TRUE_ERROR
from flight_analysis.metrics.time_spans import Windows
from flight_analysis.report.account import account_of_json
from flight_analysis.report.display_units import DisplayUnit, format_seconds, format_value
from flight_analysis.report.glossary import legend, words_in
from flight_analysis.report.guided import landing_results, leg_results
from flight_analysis.report.intervals import flight_end, gust_intervals, mode_intervals
from flight_analysis.report.summary import coverage_suffix, is_in_host_time, time_flown
from flight_analysis.report.summary_rows import (
    ERROR_COLUMNS,
    INPUT_COLUMNS,
    NOISE_FLOOR_COLUMN,
    SATURATION_COLUMN,
    SETTLING_COLUMNS,
    SWITCH_COLUMN,
    Column,
    columns_of,
    input_rows,
    model_rows,
    segment_table,
    slowest_settling,
    table_rows,
    timing_rows,
)
from flight_core.modes import Mode
from flight_core.tape import Tape
from flight_core.text import sentences
from flight_core.vectors import FloatArray
from rise_di_controller.internals import Saturation

MODEL_LEGEND = "Commands and wind of the spans differ"


TIMES = ("jitter", "age of y", "age of u")  # words of the glossary


class MetricTable(NamedTuple):
    """A table whose first column has the names of the rows. `columns` describes the other columns.

    `note` has remarks on this table. The glossary explains its headings, and the words `of_rows`,
    which occur in the names of the rows.
    """

    caption: str
    columns: Sequence[Column]
    rows: Sequence[Sequence[str]]
    note: str = ""
    of_rows: Sequence[str] = ()

    @property
    def words(self) -> tuple[str, ...]:
        """The words of this table that the glossary explains."""
        headings = ((each.group, each.head, each.label) for each in self.columns)
        return words_in([*chain.from_iterable(headings), *self.of_rows])

    @property
    def legend(self) -> str:
        """The text below the table in a terminal, with its note and the meanings of its words."""
        return ". ".join(filter(None, (self.note, legend(self.words))))

    @property
    def aligned(self) -> list[list[str]]:
        """The rows, with the decimal points of each column aligned."""
        if not self.rows:
            return []
        first, *columns = zip(*self.rows, strict=True)
        return [list(row) for row in zip(first, *map(aligned, columns), strict=True)]

    @property
    def groups(self) -> list[tuple[str, int]]:
        """The headings that neighbouring columns share, each with the number of these columns."""
        return [
            (group, len(list(columns)))
            for group, columns in groupby(self.columns, key=lambda column: column.group)
        ]

    @property
    def group_starts(self) -> list[bool]:
        """Whether each column starts a group of columns. A column without a group always does."""
        groups = [column.group for column in self.columns]
        return [
            not group or group != before
            for group, before in zip(groups, [None, *groups], strict=False)
        ]


FIGURE_SPACE = "\N{FIGURE SPACE}"  # as wide as a digit
PUNCTUATION_SPACE = "\N{PUNCTUATION SPACE}"  # as wide as a point
NUMBER = re.compile(r"[-+>\s]*\d+(?:\.(\d+))?")


def aligned(cells: Sequence[str]) -> list[str]:
    """Return the cells of a column, filled with spaces where a number has fewer decimals.

    So the decimal points are aligned if the column is aligned right. Cells that are not numbers
    stay as they are.
    """
    numbers = [NUMBER.fullmatch(cell) for cell in cells]
    decimals = [len(number[1] or "") if number else 0 for number in numbers]
    most = max(decimals, default=0)
    texts = []
    for cell, number, count in zip(cells, numbers, decimals, strict=True):
        point = PUNCTUATION_SPACE if most and not count else ""
        texts.append(f"{cell}{point}{FIGURE_SPACE * (most - count)}" if number else cell)
    return texts


class EventInterval(NamedTuple):
    """An event: a gust, a fault, a failsafe mode, a saturation, or a vane that stands still.

    The event lasts from `start` to `stop`, s.
    """

    name: str
    start: float
    stop: float
    extent: str


def _is_still(measures: FloatArray, tape: Tape, time: float) -> NDArray[np.bool_]:
    """Return a mask of the ticks in which a vane stands still, shape (N,).

    After an engagement, a vane is only said to stand still once it has moved, or once `time` s have
    passed. `measures` is 1 in the ticks in which the vane is in use, and 0 while it stands still.
    """
    internals = tape["internals"]
    t = tape.time("internals")
    tick = np.arange(len(measures))
    engages = (internals["mode"] == Mode.ENGAGED) & (internals["dt"] == 0.0)
    engagement = np.maximum.accumulate(np.where(engages, tick, 0))
    has_moved = np.maximum.accumulate(np.where(measures > 0.0, tick, -1)) >= engagement
    still: NDArray[np.bool_] = (measures == 0.0) & (has_moved | (t - t[engagement] >= time))
    return still


def events(tape: Tape, gusts: Windows, scenario: Scenario | None = None) -> list[EventInterval]:
    """Return gusts, faults, modes except ENGAGED, saturated inputs and vanes that stand still.

    The events are sorted by their starts. If `scenario` is None, it is the scenario on the tape.
    The tape of a log has no scenario, so this argument is needed.
    """
    of_flight = scenario if scenario is not None else tape.scenario
    listed = []
    # Gusts and modes. All intervals of one name share a row.
    intervals = gust_intervals(tape, gusts) + mode_intervals(tape)
    for label, group in groupby(intervals, key=lambda interval: interval.label):
        spans = [(interval.start, interval.stop) for interval in group]
        times = f", {len(spans)} times" if len(spans) > 1 else ""
        listed.append(
            EventInterval(
                label,
                spans[0][0],
                spans[-1][1],
                f"{sum(stop - start for start, stop in spans):.2f} s{times}",
            )
        )
    # Faults last to the end of the flight.
    end = flight_end(tape)
    faults = of_flight.aircraft.actuators.read_faults() if isinstance(of_flight, Scenario) else ()
    listed += [
        EventInterval(f"fault: {fault.subject}", fault.at, end, fault.extent)
        for fault in faults
        if fault.at < end
    ]
    if "internals" in tape:
        # Saturations of the inputs, by kind.
        limits = tape["internals"].group("limited")
        t = tape.time("internals")
        for name, kind in product(limits.names, (Saturation.MAGNITUDE, Saturation.RATE)):
            saturated = limits[name] == kind
            if saturated.any():
                first, last = t[saturated][[0, -1]]
                extent = f"{saturated.sum()} of {len(saturated)} ticks"
                listed.append(
                    EventInterval(f"{name} saturated: {kind.name.lower()}", first, last, extent)
                )
        # Vanes that stand still.
        measures = tape["internals"].group("vane_measures")
        observer = of_flight.controller.observer if isinstance(of_flight, Scenario) else None
        time = 0.0 if observer is None or observer.vanes is None else observer.vanes.time
        for name in measures.names:
            if (still := _is_still(measures[name], tape, time)).any():
                first, last = t[still][[0, -1]]
                listed.append(
                    EventInterval(
                        f"vane {name} stands still: left out",
                        first,
                        last,
                        f"{still.sum()} of {len(still)} ticks",
                    )
                )
    return sorted(listed, key=lambda event: event.start)


def metric_tables(
    summary: Mapping[str, Any], units: Mapping[str, DisplayUnit]
) -> list[MetricTable]:
    """Return the tables of error, inputs, guidance, models and timing. Empty tables are left out.

    Both the page and the terminal show these tables.
    """
    inputs = (*columns_of(INPUT_COLUMNS, summary["inputs"]), SATURATION_COLUMN)
    tables = (
        _error_table(summary, units),
        MetricTable(
            f"Inputs{coverage_suffix(summary, 'inputs')}",
            inputs,
            input_rows(summary, units),
            "u minus its value at trim",
        ),
        _guidance_table(summary, units),
        model_table(summary["models"], units, coverage_suffix(summary, "errors")),
        _tick_table(summary),
    )
    return [table for table in tables if table.rows]


def flight_tables(
    summary: Mapping[str, Any],
    units: Mapping[str, DisplayUnit],
    event_list: Sequence[EventInterval],
) -> list[MetricTable]:
    """Return the tables of a flight, with metrics, events and processes."""
    times = [Column(group="", head=head) for head in ("from (s)", "to (s)", "")]
    rows = [
        (event.name, f"{event.start:.2f}", f"{event.stop:.2f}", event.extent)
        for event in event_list
    ]
    others = (
        MetricTable(f"Events{coverage_suffix(summary, 'ticks')}", times, rows),
        _process_table(summary),
    )
    return [*metric_tables(summary, units), *(table for table in others if table.rows)]


def imported_tables(
    summary: Mapping[str, Any], units: Mapping[str, DisplayUnit]
) -> list[MetricTable]:
    """Return tables of y, u and the topics of an imported flight."""
    tables = []
    titles = {
        "e": "Measured errors",
        "outputs": "Outputs about trim",
        "inputs": "Inputs about trim",
    }
    for key, title in titles.items():
        if key not in summary:
            continue
        columns = columns_of(INPUT_COLUMNS, summary[key])
        rows = table_rows(summary[key], columns, units)
        caption = f"{title}, {format_seconds(summary['duration'])}"
        of_rows = ("measured error",) if key == "e" else ("trim",)
        tables.append(MetricTable(caption, columns, rows, of_rows=of_rows))
    flight_account = account_of_json(summary)
    counts = []
    for name, topic in ({} if flight_account is None else flight_account.topics).items():
        length = (topic.last or 0.0) - (topic.first or 0.0)
        rate = (topic.found - 1) / length if length else None
        counts.append([name, f"{topic.found}", format_value(rate), format_value(topic.gap)])
    columns_of_topics = [
        Column(group="", head=head) for head in ("samples", "Hz", "longest gap (s)")
    ]
    return [*tables, MetricTable("Topics", columns_of_topics, counts)]


def _error_table(summary: Mapping[str, Any], units: Mapping[str, DisplayUnit]) -> MetricTable:
    is_true = summary["error"].startswith(TRUE_ERROR)
    # The true error has no noise of y, so it can be smaller than the noise floor.
    floor = () if is_true else (NOISE_FLOOR_COLUMN,)
    columns = columns_of((*ERROR_COLUMNS, *floor, SWITCH_COLUMN), summary["errors"])
    kinds = {transient["kind"] for transient in summary["transients"]}
    settling = [kind for kind in SETTLING_COLUMNS if kind in kinds]
    rows = table_rows(summary["errors"], columns, units)
    for channel, row in zip(summary["errors"], rows, strict=True):
        row.extend(slowest_settling(summary, channel, kind) for kind in settling)
    caption = f"Tracking error ({summary['error']}), {time_flown(summary)}"
    settling_columns = [SETTLING_COLUMNS[kind] for kind in settling]
    word = TRUE_ERROR if is_true else MEASURED_ERROR
    return MetricTable(caption, (*columns, *settling_columns), rows, of_rows=(word,))


def _guidance_table(summary: Mapping[str, Any], units: Mapping[str, DisplayUnit]) -> MetricTable:
    guidance = summary["guidance"] or {"segments": (), "legs": ()}
    columns, rows = segment_table(guidance["segments"], units)
    results = (landing_results(guidance.get("landing")), leg_results(guidance["legs"]))
    caption = f"Guidance by segment{coverage_suffix(summary, 'guidance')}"
    return MetricTable(caption, columns, rows, sentences(*results), of_rows=("segment",))


def model_table(
    models: Sequence[Mapping[str, Any]], units: Mapping[str, DisplayUnit], part: str
) -> MetricTable:
    """Return a table of rms errors: before the first learned model, and with each model.

    `part` is appended to the caption, as in ", over 49 % of truth". It is empty if the log has the
    whole flight.
    """
    headings, rows = model_rows(models, units)
    columns = [Column(group="", head=head) for head in headings]
    return MetricTable(
        f"Rms of the error by model{part}", columns, rows, MODEL_LEGEND, ("initial law",)
    )


def _tick_table(summary: Mapping[str, Any]) -> MetricTable:
    """Return the table of the controller's timing. Without the host's clock, it has no times."""
    caption = f"Ticks of the controller{coverage_suffix(summary, 'ticks')}"
    rows = []
    for topic, label, text in timing_rows(summary, is_timed=is_in_host_time(summary)):
        part = "" if topic == "ticks" else coverage_suffix(summary, topic)
        rows.append((f"{label}{part}", text))
    labels = [label for label, _ in rows]
    of_rows = [word for word in TIMES if any(label.startswith(word) for label in labels)]
    return MetricTable(caption, [Column(group="", head="")], rows, of_rows=of_rows)


def _process_table(summary: Mapping[str, Any]) -> MetricTable:
    flight_account = account_of_json(summary)
    processes = {} if flight_account is None else flight_account.processes
    # In lockstep it is unknown when a process was ready, and all processes run to the end.
    if not is_in_host_time(summary):
        processes = {}
    columns = [
        Column(group="", head="ready (s)"),
        *(Column(group="output", head=head) for head in ("first (s)", "last (s)", "samples")),
    ]
    rows = []
    for name, process in processes.items():
        times = (process.ready, process.first, process.last)
        cells = ["" if time is None else f"{time:.3f}" for time in times]
        rows.append([name, *cells, "" if process.samples is None else f"{process.samples}"])
    return MetricTable("Processes", columns, rows)
