# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""The folder of a run: made before a flight, filled with what its log stores, read back and reported on after it."""

import json
import os
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import NamedTuple

import yaml

from aircraft_sim.uncertainty import as_yaml
from flight_analysis.closed_loop.scenario import ParameterOverrides, Scenario, load_scenario, scenario_yaml
from flight_analysis.report.recorded_flight import RecordedFlight
from flight_analysis.report.summary import summarise, summarise_unflown
from flight_core.files import writing
from flight_core.outcome import COMPLETED
from flight_core.parameters import ParameterError, printable
from flight_core.tape import Tape
from flight_log.bag import Enclosed, bag_files
from flight_log.latency import latency
from flight_log.provenance import provenance
from flight_log.tape_reader import StoredFile, read_run

SUMMARY, REPORT = "summary.json", "report.html"

# Files made in the folder of a run, for its log
AIRFRAME = "airframe.yaml"
PARAMETERS = "parameters.yaml"
PROVENANCE = "provenance.yaml"


class FlightResult(NamedTuple):
    """A flight that has ended, however, and where it lies."""

    flight: RecordedFlight
    mcap: Path
    report: Path


def new_run(scenario: Scenario, runs: Path, kind: str = "") -> Path:
    """Make the folder of a new run, runs/<UTC stamp>-<kind><scenario>. Raises ParameterError where that cannot be."""
    stem = f"{datetime.now(UTC):%Y%m%dT%H%M%SZ}-{kind}{scenario.name}"
    for name in (stem, *(f"{stem}-{k}" for k in range(2, 100))):
        run = (runs / name).absolute()
        with writing("runs", runs, "a folder that can"), suppress(FileExistsError):
            run.mkdir(parents=True)
            return run
    raise ParameterError(f"runs: found a hundred runs of this second in {runs}, expected fewer")


def enclosed(
    scenario: Scenario, run: Path, told: Mapping[str, ParameterOverrides] | None = None, further: Sequence[Path] = ()
) -> Enclosed:
    """What the log of a flight holds beside its messages; what is no file yet is made in the folder of the run.

    The scenario, the airframe that flies, every parameter as the nodes validate it (`told`, by the node's name, over the
    scenario; nothing where the flight has no nodes), `further` files, and `provenance`. Raises ParameterError where it cannot
    be written.
    """
    attached = [_write(run / PARAMETERS, scenario_yaml(scenario, told)), *further]
    if not scenario.aircraft.is_jsbsim:
        attached.append(_write(run / AIRFRAME, as_yaml(scenario.aircraft.sampled_airframe())))
    notes = _write(run / PROVENANCE, yaml.safe_dump(provenance(), sort_keys=False))
    return Enclosed(scenario.path, tuple(attached), notes)


def _write(path: Path, text: str) -> Path:
    with writing("", path, "a folder and a disk that can"):
        path.write_text(text, encoding="utf-8")
    return path


def read_flight(run: Path, outcome: str | None = None) -> RecordedFlight:
    """A recorded flight with its summary; its scenario is written beside the log.

    Without an outcome, that of the run's summary is kept. Raises ParameterError where the log cannot be read, or holds no
    scenario.
    """
    recorded = read_run(run)
    if recorded.scenario is None:
        raise ParameterError(f"{run}: found a log without its scenario, expected a run that was flown from one")
    folder = _folder(run)
    scenario = _written(recorded.scenario, folder)
    waited = latency(run)
    signals = recorded.tape.signals if waited is None else {**recorded.tape.signals, "latency": waited}
    tape = _until_last_input(replace(recorded.tape, signals=signals))
    if outcome == COMPLETED and "internals" not in tape:
        outcome = "the controller never engaged"
    name = folder.name if run.is_dir() else run.stem
    return RecordedFlight(name, scenario, tape, summarise(scenario, tape, outcome or _outcome_before(folder / SUMMARY)))


def recorded_scenario(run: Path, namespace: str | None = None) -> Scenario:
    """The scenario inside a log, which is written beside it. Raises ParameterError where the log holds none."""
    stored = read_run(run, namespace).scenario
    if stored is None:
        raise ParameterError(f"{run}: found a log without its scenario, expected a run that was flown from one")
    return _written(stored, _folder(run))


def _written(stored: StoredFile, folder: Path) -> Scenario:
    path = folder / stored.name
    with writing("", folder, "a folder that can"):
        path.write_bytes(stored.content)
    return load_scenario(path)


def conclude(run: Path, outcome: str | None = None) -> FlightResult:
    """Read the bag back, write its scenario, summary.json and report.html beside it, point runs/latest at the run.

    Without an outcome it is the report of an old run that is written again. Raises ParameterError as `read_flight` does.
    """
    from flight_analysis.report.page import write_page  # noqa: PLC0415 - loads plotly, which a flight does without

    flight, folder = read_flight(run, outcome), _folder(run)
    with writing("", folder, "a folder that can"):
        (folder / SUMMARY).write_text(json.dumps(flight.summary, indent=2, allow_nan=False) + "\n", encoding="utf-8")
        write_page(folder / REPORT, [flight])
        if outcome is not None:
            _point_latest(folder)
    return FlightResult(flight, min(bag_files(run), default=folder), folder / REPORT)


def conclude_unflown(run: Path, scenario: Scenario, outcome: str) -> Path:
    """Write summary.json of a flight that ended before its first sample; its path. The log, such as it is, stays."""
    path = run / SUMMARY
    path.write_text(json.dumps(summarise_unflown(scenario, outcome), indent=2) + "\n", encoding="utf-8")
    _point_latest(run)
    return path


def _folder(run: Path) -> Path:
    """The folder of a run, which may be named by its log; runs/latest is a link."""
    return run.resolve() if run.is_dir() else run.resolve().parent


def _outcome_before(summary: Path) -> str:
    try:
        return printable(str(json.loads(summary.read_text(encoding="utf-8"))["outcome"]))
    except (OSError, ValueError, TypeError, KeyError):
        return "ended as its log does"


def _until_last_input(tape: Tape) -> Tape:
    """The tape up to the controller's last u: what the aircraft does while the processes are being ended is no flight."""
    if "u" not in tape:
        return tape
    end_ns = tape["u"].stamp_ns[-1]
    return replace(tape, signals={name: signal_.until(end_ns) for name, signal_ in tape.signals.items()})


def _point_latest(run: Path) -> None:
    latest, fresh = run.parent / "latest", run.parent / f".latest-{os.getpid()}"
    fresh.symlink_to(run.name)
    try:
        fresh.replace(latest)
    except OSError:
        fresh.unlink()
        raise
