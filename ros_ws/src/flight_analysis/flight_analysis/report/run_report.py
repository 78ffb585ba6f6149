# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Write the report of a run: its scenario, summary.json and report.html."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

from flight_analysis.closed_loop.scenario import Scenario
from flight_analysis.report.recorded_flight import UnflownError, flight_of, scenario_in
from flight_analysis.report.run_folder import REPORT, SUMMARY, folder_of
from flight_analysis.report.summary import RecordedFlight, empty_summary
from flight_core.arguments import FilePath
from flight_core.files import link_latest, read_file, write_file, writing
from flight_core.outcome import Outcome
from flight_core.parameters import ParameterError, require
from flight_core.scenario_file import A_SCENARIO
from flight_log.rosbag2_metadata import bag_files
from flight_log.tape_reader import RecordedRun, read_run


class FlightResult(NamedTuple):
    """A recorded flight, its log and its report.

    Attributes:
        flight: The flight with its tape and its metrics.
        mcap: Path of the log.
        report: Path of the page.
    """

    flight: RecordedFlight
    mcap: Path
    report: Path


class UnwrittenReportError(ParameterError):
    """Raised if a report cannot be written, as on a full disk. `result` still has the flight."""

    def __init__(self, sentence: str, result: FlightResult) -> None:
        super().__init__(sentence)
        self.result = result


def write_report(run: Path, outcome: Outcome) -> FlightResult:
    """Write scenario, summary.json and report.html of a flight that has just ended.

    runs/latest becomes a link to the run. Raises ParameterError as `read_flight` does, before any
    file is written, UnflownError if the run lacks y or y_m, and UnwrittenReportError if a file
    cannot be written.
    """
    recorded = read_run(run)
    folder = folder_of(run)
    flight = flight_of(recorded, run, outcome)
    return _written(recorded, run, flight, folder, kept_scenario=flight.scenario, is_latest=True)


def rewrite_report(
    run: Path,
    output: Path | None = None,
    namespace: str | None = None,
    scenario: FilePath | None = None,
    remaps: Mapping[str, str] = {},
) -> FlightResult:
    """Write scenario, summary.json and report.html of an earlier flight.

    The files are written beside the log, or into the new folder `output`. The link runs/latest does
    not change. If `scenario` replaces the scenario in the log, no scenario is written. Raises
    ParameterError as `read_flight` does, before any file is written, and UnwrittenReportError if a
    file cannot be written. If the run lacks y or y_m, only summary.json is written, with the
    outcome alone, and UnflownError is raised.
    """
    recorded = read_run(run, namespace, scenario, remaps)
    folder = output or folder_of(run)
    try:
        flight = flight_of(recorded, run)
    except UnflownError as error:
        summary = empty_summary(scenario_in(recorded, run), error.outcome)
        with writing("", folder):
            folder.mkdir(parents=True, exist_ok=True)
            _write_summary(folder, summary)
        raise
    kept_scenario = flight.scenario if scenario is None else None
    return _written(recorded, run, flight, folder, kept_scenario=kept_scenario, is_latest=False)


def _written(
    recorded: RecordedRun,
    run: Path,
    flight: RecordedFlight,
    folder: Path,
    *,
    kept_scenario: Scenario | None,
    is_latest: bool,
) -> FlightResult:
    """Write the files of a report into a folder, and return the flight with its paths.

    `kept_scenario` is the scenario of the log, or None if it is not written to a file. If
    `is_latest` is True, runs/latest becomes a link to the folder. Raises UnwrittenReportError if a
    file cannot be written.
    """
    from flight_analysis.report.html import write_page  # noqa: PLC0415 - loads jinja2, which a flight does not need

    result = FlightResult(flight, min(bag_files(run), default=folder), folder / REPORT)
    try:
        with writing("", folder):
            folder.mkdir(parents=True, exist_ok=True)
            if kept_scenario is not None:
                _write_scenario(recorded, folder / kept_scenario.path.name)
            _write_summary(folder, flight.summary)
            write_page(folder / REPORT, [flight])
        if is_latest:
            link_latest(folder)
    except ParameterError as error:
        raise UnwrittenReportError(str(error), result) from None
    return result


def write_empty_summary(run: Path, scenario: Scenario, outcome: Outcome) -> dict[str, Any]:
    """Write summary.json of a flight that ended before its first sample, and return its content.

    The log does not change. Raises ParameterError if the file cannot be written.
    """
    summary = empty_summary(scenario, outcome)
    with writing("", run):
        _write_summary(run, summary)
    link_latest(run)
    return summary


def _write_summary(folder: Path, summary: Mapping[str, Any]) -> None:
    """Write summary.json into a folder. Raises OSError if this fails."""
    write_file(folder / SUMMARY, json.dumps(summary, indent=2, allow_nan=False) + "\n")


def extract_scenario(run: Path, namespace: str | None = None) -> Scenario:
    """Write the scenario that is stored in a log to a file beside the log, and return it.

    Raises ParameterError if the log has no scenario.
    """
    recorded = read_run(run, namespace)
    scenario = scenario_in(recorded, run)
    _write_scenario(recorded, scenario.path)
    return scenario


def _write_scenario(recorded: RecordedRun, path: Path) -> None:
    """Write the scenario of a log to a file, if the file does not exist yet.

    Raises ParameterError if the file exists and has another content.
    """
    if recorded.scenario is None:
        return
    if path.is_symlink() or not path.exists():
        with writing("", path.parent):
            write_file(path, recorded.scenario.content)
        return
    require(
        read_file(path, str(path), A_SCENARIO) == recorded.scenario.content,
        str(path),
        "a file that is not the scenario of the log",
        "no file of this name: the scenario is written there",
    )
