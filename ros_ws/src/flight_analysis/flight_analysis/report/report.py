# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Write the report page of a run or of a comparison of runs, and files for other programs."""

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import partial
from itertools import chain, count
from pathlib import Path
from typing import NamedTuple

from flight_analysis.report.export import write_csv, write_parquet, write_png
from flight_analysis.report.html import write_page
from flight_analysis.report.paper import WIDTH, write_figure
from flight_analysis.report.recorded_flight import read_flight
from flight_analysis.report.run_report import rewrite_report
from flight_analysis.report.summary import RecordedFlight
from flight_core.arguments import FilePath, as_path
from flight_core.files import writing
from flight_core.parameters import require
from flight_log.open_log import A_RUN

A_FILE = "the path of a file"
COMPARISON = "comparison.html"


class File(NamedTuple):
    """A file beside the page: its name in error messages, its path, and its writing function."""

    key: str
    path: Path
    write: Callable[[Path, Sequence[RecordedFlight]], object]


@dataclass(frozen=True, kw_only=True)
class Report:
    """A report that has been written.

    Attributes:
        page: Path of the page.
        flights: The flights on the page.
    """

    page: Path
    flights: list[RecordedFlight]


def report(
    *runs: FilePath,
    html: FilePath | None = None,
    output: FilePath | None = None,
    png: FilePath | None = None,
    csv: FilePath | None = None,
    parquet: FilePath | None = None,
    figure: FilePath | None = None,
    width: str | float = WIDTH,
    channels: str | Sequence[str] = (),
    namespace: str | None = None,
    remaps: Mapping[str, str] = {},
    scenario: FilePath | None = None,
    tolerances: Mapping[str, float] = {},
) -> Report:
    """Write the report page of a recorded run, or of a comparison of several runs.

    Several runs are compared with the first, as `rise-di report` does. If one of them is an
    imported log, signals with the same name are drawn over each other.

    Args:
        runs: Folders of runs, or MCAP files.
        html: Path of the page. One run then gets only this page. If None, a comparison is written
            to comparison.html in a new folder beside the first run.
        output: Folder for the report of one run. If None, it is the folder of the log.
        png: Path of a figure with y over y_m, e and u.
        csv: Path of a table of all signals, with a row per instant and a column per channel.
        parquet: Path of the same table as Parquet.
        figure: Path of a figure for a paper: .pdf, .svg or .eps for vectors, or .png.
        width: Width of the figure, with a unit ("88mm") or in m.
        channels: Channels of the figure: outputs, inputs, and "e.NAME" for the error of an output.
            If empty, the figure has every output.
        namespace: Namespace of the aircraft, for logs with several aircraft.
        remaps: Topics of the log by the names that the nodes of this package give them, as in
            {"y": "/sensors/y"}. They are needed if the nodes were remapped.
        scenario: Scenario file of the flights, for logs without a scenario. If None, each log has
            its scenario.
        tolerances: Tolerance of the difference between several runs by channel, SI, as in {"q":
            0.02}. For any other channel it is 2 % of the largest value in the first run.

    Returns:
        The path of the page, and the flights on the page.

    Raises:
        ParameterError: A run cannot be read, or a file cannot be written.

    Examples:
        >>> flight = rise_di.fly(rise_di.find_scenario("osprey_servo", duration=0.1))
        >>> rise_di.report(flight.mcap, csv="flight.csv").page.name
        'report.html'
    """
    require(bool(runs), "runs", "none", A_RUN)
    folders = [as_path(run, "run", A_RUN) for run in runs]
    if figure is None:
        _require_no_figure(channels, width)
    require(not tolerances or len(folders) > 1, "tolerances", "a single run", "several runs")
    page_of = partial(write_page, tolerances=tolerances)
    files = [
        File(key, as_path(path, key, A_FILE), write)
        for key, path, write in (
            ("html", html, page_of),
            ("png", png, write_png),
            ("csv", csv, write_csv),
            ("parquet", parquet, write_parquet),
            ("figure", figure, partial(write_figure, width=width, channels=channels)),
        )
        if path is not None
    ]
    # One run gets its report, or only a page if `html` is given.
    is_single = len(folders) == 1 and html is None
    require(
        output is None or is_single,
        "output",
        "a comparison",
        "one run; html is the page of several",
    )
    read_one = partial(read_flight, namespace=namespace, scenario=scenario, remaps=remaps)
    if is_single:
        folder = None if output is None else as_path(output, "output", "the path of a folder")
        result = rewrite_report(
            folders[0], output=folder, namespace=namespace, scenario=scenario, remaps=remaps
        )
        page = result.report
        flights = [result.flight]
    else:
        flights = [read_one(folder) for folder in folders]
        if html is None:
            page = _comparison_folder(folders[0]) / COMPARISON
            files.insert(0, File("html", page, page_of))
        else:
            page = Path(html)
    for file in files:
        with writing(file.key, file.path, A_FILE):
            file.write(file.path, flights)
    return Report(page=page, flights=flights)


def _require_no_figure(channels: str | Sequence[str], width: str | float) -> None:
    """Check that no channels and no width are given, because only a figure uses them.

    Raises ParameterError if one of them is given.
    """
    key = "channels" if channels else "width"
    is_default = not channels and width == WIDTH
    require(is_default, key, "no figure to use it for", "a path for figure too")


def _comparison_folder(first: Path) -> Path:
    """Create a new folder for a comparison beside the first run, and return its path."""
    folder = first.absolute().parent
    stem = f"{datetime.now(UTC):%Y%m%dT%H%M%SZ}-comparison"
    for name in chain([stem], (f"{stem}-{number}" for number in count(2))):
        with writing("runs", folder), suppress(FileExistsError):
            (folder / name).mkdir()
            return folder / name
    raise AssertionError("the names go on for ever")  # for mypy
