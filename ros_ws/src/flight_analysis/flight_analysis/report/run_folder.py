# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Create the folder of a run before its flight, read the run back, and write its report.

The folder gets the attachments of the log before the flight.
"""

import json
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, NamedTuple

from aircraft_sim.jsbsim.jsbsim_files import model_files
from aircraft_sim.uncertainty import as_yaml
from flight_analysis.closed_loop.replay import (
    is_controller_alone,
    later_aircraft,
    recorded_changes,
    recorded_parameters,
)
from flight_analysis.closed_loop.scenario import (
    ParameterOverrides,
    Scenario,
    parse_scenario,
    scenario_yaml,
)
from flight_analysis.report.account import Account, account
from flight_analysis.report.flight_outcome import (
    NEVER_ENGAGED,
    has_ticks,
    outcome_of_log,
    until_last_tick,
)
from flight_analysis.report.flown_models import FlownController, flown_controllers
from flight_analysis.report.model_spans import parameter_spans
from flight_analysis.report.sample_counts import is_real_time
from flight_analysis.report.summary import (
    RecordedFlight,
    empty_summary,
    engagement_notes,
    summarise,
    summarise_imported,
    summarise_own,
)
from flight_core.arguments import FilePath
from flight_core.channels import RATES_AND_SPEED
from flight_core.files import (
    comment,
    display_path,
    dump_yaml,
    link_latest,
    read_file,
    write_file,
    writing,
)
from flight_core.outcome import End, Outcome, never_flew, parsed_outcome, read_outcome
from flight_core.parameters import ParameterError, require
from flight_core.rates import NANOSECONDS
from flight_core.scenario_file import A_SCENARIO
from flight_core.tape import Tape
from flight_core.text import printable
from flight_guidance.guidance_log import require_channels
from flight_log.bag import CHANNEL_UNITS, IMPORTED, OUTCOME_FILE, LogAttachments
from flight_log.engagements import Engagement
from flight_log.log_messages import last_words
from flight_log.provenance import FLIGHT, provenance
from flight_log.rosbag2_metadata import bag_files
from flight_log.tape_reader import AIRCRAFT_TOPICS, PARAMETERS, RecordedRun, read_run

SUMMARY = "summary.json"
REPORT = "report.html"
# attachments of the log
AIRFRAME = "airframe.yaml"
AIRCRAFT = "aircraft.zip"
PROVENANCE = "provenance.yaml"


class FlightResult(NamedTuple):
    """A recorded flight with its log and its report.

    Attributes:
        flight: The flight with its tape and its metrics.
        mcap: Path of the log.
        report: Path of the page.
    """

    flight: RecordedFlight
    mcap: Path
    report: Path


class UnwrittenReportError(ParameterError):
    """A report could not be written, as on a full disk. `result` still has the flight."""

    def __init__(self, sentence: str, result: FlightResult) -> None:
        super().__init__(sentence)
        self.result = result


class UnflownError(ParameterError):
    """A log lacks y or y_m, so that only the `outcome` of the flight can be reported."""

    def __init__(self, sentence: str, outcome: Outcome) -> None:
        super().__init__(sentence)
        self.outcome = outcome


def new_run(scenario: Scenario, runs: Path, kind: str = "") -> Path:
    """Create the folder of a new run, runs/<UTC stamp>-<kind><scenario>.

    Raises ParameterError if the folder cannot be created.
    """
    place = str(runs.absolute())
    is_text = not any("\ud800" <= character <= "\udfff" for character in place)
    require(
        is_text, "runs", ascii(place), "a folder with a name in UTF-8, as logs and reports hold it"
    )
    latest = runs / "latest"
    is_free = latest.is_symlink() or not latest.exists()
    require(is_free, str(latest), "a folder", "no file of this name: it becomes a link to the run")
    stem = f"{datetime.now(UTC):%Y%m%dT%H%M%SZ}-{kind}{scenario.name}"
    for name in (stem, *(f"{stem}-{k}" for k in range(2, 100))):
        run = (runs / name).absolute()
        with writing("runs", runs, "a folder that can"), suppress(FileExistsError):
            run.mkdir(parents=True)
            return run
    raise ParameterError(f"runs: found a hundred runs of this second in {runs}, expected fewer")


def remove_empty(*runs: Path) -> None:
    """Remove the folders of runs that hold no file.

    The flights of such runs were interrupted before they began.
    """
    for run in runs:
        with suppress(OSError):
            run.rmdir()


def attachments_for(
    scenario: Scenario,
    run: Path,
    overrides: Mapping[str, ParameterOverrides] | None = None,
    further: Sequence[Path] = (),
    replaced: Sequence[str] = (),
) -> LogAttachments:
    """Return the attachments of the log of a flight, and write those that are no files yet.

    They are the scenario, the airframe or the user's model of JSBSim, every parameter after
    validation, the `further` files, and the provenance. The written ones lie in the folder of the
    run. `overrides` are parameters of the scenario's nodes by the name of the node, or None for a
    flight without nodes. `replaced` names the nodes of the stack that other nodes replaced, and the
    attachments state this. Raises ParameterError if a file cannot be written.
    """
    unflown = {
        name: comment([f"did not fly: {name}; another node took its place"]) for name in replaced
    }
    parameters = "".join(unflown.values()) + scenario_yaml(scenario, overrides)
    attached = [_write(run / PARAMETERS, parameters), *further]
    if not scenario.aircraft.is_jsbsim:
        airframe = as_yaml(scenario.aircraft.sampled_airframe())
        attached.append(_write(run / AIRFRAME, unflown.get("aircraft", "") + airframe))
    elif (model := Path(scenario.aircraft.flight_condition().name)).is_absolute():
        attached.append(_write(run / AIRCRAFT, model_files(model).archive()))
    notes = _write(run / PROVENANCE, dump_yaml(provenance(), flow=False))
    return LogAttachments(scenario.path, tuple(attached), notes)


def _write(path: Path, text: str | bytes) -> Path:
    with writing("", path, "a folder and a disk that can"):
        write_file(path, text)
    return path


def read_accounted(
    run: FilePath,
    namespace: str | None = None,
    scenario: FilePath | None = None,
    remaps: Mapping[str, str] = {},
) -> RecordedRun:
    """Read the folder or a file of a run, and return its signals, scenario and files.

    The signals are named vectors, by topic name without the namespace. The bag, which is the log as
    ROS stores it, comes from this stack or from `ros2 bag record`. It is MCAP, in one or several
    files, compressed or not. A truncated MCAP file is read up to the last complete chunk.
    In the result, `tape.account` has the number of samples of each topic, and `tape.notes` say what
    the log lacks. A log without a scenario has no account, unless it was imported.

    Args:
        run: Folder of a run, or a file of the bag.
        namespace: Namespace of the aircraft, for a log with several aircraft.
        scenario: Scenario file in place of the scenario in the log.
        remaps: Topics of the log by the names that the stack gives them, as in {"y": "/sensors/y"}.
            They are needed if the nodes were remapped.

    Returns:
        The content of the log: a tape with signals of shape (N, k), SI, the scenario and the files.

    Raises:
        ParameterError: The bag is missing or has no sample, the log has several aircraft and no
            `namespace` selects one, or the scenario file cannot be read.

    Examples:
        >>> flight = rise_di.fly(rise_di.find_scenario("osprey_servo", duration=0.1))
        >>> rise_di.read_run(flight.mcap).tape["u"].values.shape
        (11, 4)
    """
    recorded = read_run(run, namespace, scenario, remaps)
    flight_account = log_account(recorded)
    if flight_account is None:
        return recorded
    tape = recorded.tape
    notes = (*tape.notes, *flight_account.notes())
    return recorded._replace(tape=replace(tape, notes=notes, account=flight_account))


def read_flight(
    run: Path,
    outcome: Outcome | None = None,
    namespace: str | None = None,
    scenario: FilePath | None = None,
    remaps: Mapping[str, str] = {},
) -> RecordedFlight:
    """Read a recorded flight and summarise it, without writing a file.

    If no outcome is given, the outcome in the run's summary is kept. `namespace`, `scenario` and
    `remaps` have the same meaning as in `read_run`. Raises ParameterError if the log cannot be read
    or holds no scenario.
    """
    return _flight(read_run(run, namespace, scenario, remaps), run, outcome)


def _flight(recorded: RecordedRun, run: Path, outcome: Outcome | None) -> RecordedFlight:
    recorded.require()
    folder = _folder(run)
    name = printable(run.resolve().name if run.is_dir() else run.stem)
    # For an imported log only y and u can be summarised.
    if (source := recorded.metadata.get(IMPORTED)) is not None:
        recorded.require("y", "u")
        require(
            recorded.scenario is None,
            "scenario",
            "an imported log",
            "none: nothing of a scenario was flown",
        )
        summary = summarise_imported(recorded.tape, source)
        return RecordedFlight(
            name=name,
            scenario=None,
            tape=recorded.tape,
            summary=summary,
            si_units=recorded.metadata.get(CHANNEL_UNITS, {}),
        )
    if is_controller_alone(recorded.scenario_file()):
        return _own_flight(recorded, name, outcome or recorded.tape.outcome)
    scenario = _scenario_in(recorded, run)
    log = _with_times_of_messages(recorded)
    engagements = recorded.engagements
    outcome = outcome or _previous_outcome(recorded, folder, scenario)
    if outcome.end is End.COMPLETED and engagements is None and not has_ticks(log):
        outcome = NEVER_ENGAGED
    if "guidance" in log:
        require_channels(log["guidance"].names)
    # The account covers the whole log, but the metrics only its engaged part.
    tape = until_last_tick(log)
    flight_account = account(log, scenario, outcome, simulated=engagements is None)
    engaged_part = _engaged(tape, engagements or [])
    # An engagement may be shorter than a sample.
    has_figures = {"y", "y_m"} <= set(engaged_part.signals)
    part = engaged_part if has_figures else tape
    try:
        summary = summarise(part, scenario, outcome, flight_account)
    except ParameterError as error:
        raise _with_cause(error, recorded, run, outcome) from None
    summary["flight"] = _identity(recorded)
    if engagements is not None:
        summary["engagements"] = [_engagement(tape, engagement) for engagement in engagements]
        summary["notes"] = [
            *engagement_notes(summary["engagements"], has_figures=has_figures),
            *summary["notes"],
        ]
    controllers = _controllers(recorded, tape, scenario)
    return RecordedFlight(
        name=name,
        scenario=scenario,
        tape=tape,
        summary=summary,
        controllers=controllers,
        later_aircraft=later_aircraft(recorded, scenario),
        messages=recorded.messages,
    )


def _with_cause(
    error: ParameterError, recorded: RecordedRun, run: Path, outcome: Outcome
) -> ParameterError:
    """Return an UnflownError with the last messages of the nodes if the log lacks y or y_m.

    If the log has y and y_m, return the error itself.
    """
    if {"y", "y_m"} <= set(recorded.tape.signals):
        return error
    causes = last_words(recorded.messages)
    if causes and outcome == NEVER_ENGAGED:
        outcome = never_flew(f"{outcome.reason}; {causes[0]}")
    return UnflownError(
        f"{display_path(run.resolve())}: {'; '.join([str(error), *causes])}", outcome
    )


def _own_flight(recorded: RecordedRun, name: str, outcome: Outcome) -> RecordedFlight:
    """Return the flight of a user's aircraft, given a log that describes only the controller."""
    recorded.require("y", "u")
    controller = recorded_parameters(recorded.scenario_file(), recorded.namespace)
    summary = summarise_own(recorded.tape, controller.law, name, outcome)
    summary["flight"] = _identity(recorded)
    units = {channel: "m/s" if channel == "V" else "rad/s" for channel in RATES_AND_SPEED}
    return RecordedFlight(
        name=name, scenario=None, tape=recorded.tape, summary=summary, si_units=units
    )


def _with_times_of_messages(recorded: RecordedRun) -> Tape:
    """Return the tape with the latency and the age of u as further signals.

    In lockstep and in one process there is no latency, because the nodes wait for each other,
    however long the host takes.
    """
    latency = recorded.latency if is_real_time(recorded.tape) else None
    timed = {"latency": latency, "age_of_u": recorded.age_of_u}
    signals = {name: signal for name, signal in timed.items() if signal is not None}
    return replace(recorded.tape, signals={**recorded.tape.signals, **signals})


def _controllers(
    recorded: RecordedRun, tape: Tape, scenario: Scenario
) -> tuple[FlownController, ...]:
    """Return the parameters that flew, or () if they did not change in flight."""
    if len({span.digest for span in parameter_spans(tape)}) < 2:
        return ()
    changes = recorded_changes(recorded, scenario.controller)
    return flown_controllers(tape, scenario.controller, changes)


def log_account(recorded: RecordedRun) -> Account | None:
    """Return the account of what a log holds and lacks.

    Returns None if the log has no flight. An imported log needs no scenario. For any other log,
    returns None if it has no scenario that can be read.
    """
    if not {*AIRCRAFT_TOPICS} & {*recorded.tape.signals}:
        return None
    if IMPORTED in recorded.metadata:
        return account(recorded.tape, None)
    try:
        scenario = parse_scenario(
            recorded.scenario_file().content, Path(recorded.scenario_file().name)
        )
    except ParameterError:
        return None
    folder = None if recorded.path is None else _folder(recorded.path)
    outcome = _previous_outcome(recorded, folder, scenario)
    return account(recorded.tape, scenario, outcome, simulated=recorded.engagements is None)


def _engaged(tape: Tape, engagements: Sequence[Engagement]) -> Tape:
    """Return the engaged part of a flight with a bridge, from which the metrics are computed.

    If there was no engagement, return the whole tape, so that the duration is known.
    """
    end_ns = max(
        (int(signal.stamp_ns[-1]) for signal in tape.signals.values() if len(signal.stamp_ns)),
        default=0,
    )
    windows = [(engagement.start_ns, engagement.stop_ns or end_ns) for engagement in engagements]
    signals = tape.signals
    if windows:
        signals = {name: signal.within(windows) for name, signal in tape.signals.items()}
    return replace(
        tape, signals={name: signal for name, signal in signals.items() if len(signal.stamp_ns)}
    )


def _engagement(tape: Tape, engagement: Engagement) -> dict[str, Any]:
    """Return when an engagement began and ended, in flight time, s, and why it ended."""
    start, stop = (
        (time_ns - tape.start_ns) / NANOSECONDS if time_ns else None
        for time_ns in (engagement.start_ns, engagement.stop_ns)
    )
    return {"start": start, "stop": stop, "reason": engagement.reason}


def extract_scenario(run: Path, namespace: str | None = None) -> Scenario:
    """Write the scenario that is stored in a log to a file beside the log, and return it.

    Raises ParameterError if the log holds none.
    """
    recorded = read_run(run, namespace)
    scenario = _scenario_in(recorded, run)
    _write_scenario(recorded, scenario.path)
    return scenario


def _scenario_in(recorded: RecordedRun, run: Path) -> Scenario:
    """Return the scenario that is stored in a log, with a path beside the log.

    Raises ParameterError if the log has no valid scenario.
    """
    stored = recorded.scenario_file()
    return parse_scenario(stored.content, _folder(run) / stored.name)


def _write_scenario(recorded: RecordedRun, path: Path) -> None:
    """Write the scenario of a log to a file, if the file does not exist yet.

    Raises ParameterError if the file exists and has another content.
    """
    if recorded.scenario is None:
        return
    if path.is_symlink() or not path.exists():
        with writing("", path.parent, "a folder that can"):
            write_file(path, recorded.scenario.content)
        return
    require(
        read_file(path, str(path), A_SCENARIO) == recorded.scenario.content,
        str(path),
        "a file that is not the scenario of the log",
        "no file of this name: the scenario is written there",
    )


def write_report(
    run: Path,
    outcome: Outcome | None = None,
    output: Path | None = None,
    namespace: str | None = None,
    scenario: FilePath | None = None,
    remaps: Mapping[str, str] = {},
) -> FlightResult:
    """Read the bag back and write scenario, summary.json and report.html.

    runs/latest becomes a link to the run. The files are written beside the log, or into the new
    folder `output`. If no outcome is given, the report of an old run is written again, and
    runs/latest stays. A `scenario` that replaces the one in the log is not written. Raises
    ParameterError as `read_flight` does, before any file is written, and UnwrittenReportError if a
    file cannot be written. If a run lacks y or y_m, UnflownError is raised. Before that,
    summary.json gets the outcome alone, unless `outcome` is given.
    """
    from flight_analysis.report.html import write_page  # noqa: PLC0415 - loads jinja2, which a flight does not need

    recorded = read_run(run, namespace, scenario, remaps)
    folder = output or _folder(run)
    try:
        flight = _flight(recorded, run, outcome)
    except UnflownError as error:
        if outcome is None:
            summary = empty_summary(_scenario_in(recorded, run), error.outcome)
            with writing("", folder, "a folder that can"):
                folder.mkdir(parents=True, exist_ok=True)
                _write_summary(folder, summary)
        raise
    result = FlightResult(flight, min(bag_files(run), default=folder), folder / REPORT)
    try:
        with writing("", folder, "a folder that can"):
            folder.mkdir(parents=True, exist_ok=True)
            if scenario is None and flight.scenario is not None:
                _write_scenario(recorded, folder / flight.scenario.path.name)
            _write_summary(folder, flight.summary)
            write_page(folder / REPORT, [flight])
        if outcome is not None:
            link_latest(folder)
    except ParameterError as error:
        raise UnwrittenReportError(str(error), result) from None
    return result


def write_empty_summary(run: Path, scenario: Scenario, outcome: Outcome) -> dict[str, Any]:
    """Write summary.json of a flight that ended before its first sample.

    The log does not change. Raises ParameterError if the file cannot be written.
    """
    summary = empty_summary(scenario, outcome)
    with writing("", run, "a folder that can"):
        _write_summary(run, summary)
    link_latest(run)
    return summary


def _write_summary(folder: Path, summary: Mapping[str, Any]) -> None:
    """Write summary.json into a folder. Raises OSError if this fails."""
    write_file(folder / SUMMARY, json.dumps(summary, indent=2, allow_nan=False) + "\n")


def _folder(run: Path) -> Path:
    """Return the folder of a run, given this folder, its log, or a link such as runs/latest."""
    return run.resolve() if run.is_dir() else run.resolve().parent


def _identity(recorded: RecordedRun) -> dict[str, Any]:
    """Return the values that identify a flight.

    They are the stamp of t = 0, ns, and the time of day at which the flight started, if it is
    logged.
    """
    started = recorded.metadata.get(FLIGHT, {}).get("start")
    return {"start_ns": recorded.tape.start_ns, "started": started}


def _previous_outcome(recorded: RecordedRun, folder: Path | None, scenario: Scenario) -> Outcome:
    """Return the outcome of a flight from the log, the summary, a launch, or the samples.

    The first of these that has an outcome counts. The summary must be that of this flight. A launch
    leaves a file with its outcome beside the log. This file counts only if the log is named after
    the folder. If nodes were started by hand, only the samples in the log show the outcome.
    """
    tape = recorded.tape
    outcome = tape.outcome
    if folder is not None:
        with suppress(OSError, ValueError, TypeError, KeyError):
            summary = json.loads((folder / SUMMARY).read_text(encoding="utf-8"))
            if summary["flight"] == _identity(recorded):
                before = read_outcome(summary["outcome"])
                # The shortfalls of the summary are kept, because some, such as those of a fleet, do
                # not show in the log of one aircraft.
                outcome = replace(outcome, shortfalls=before.shortfalls)
                outcome = before if outcome.end is End.UNKNOWN else outcome
    has_folder = folder is not None and (folder / f"{folder.name}_0.mcap").is_file()
    if outcome.end is End.UNKNOWN and folder is not None and has_folder:
        with suppress(ParameterError):
            content = read_file(folder / OUTCOME_FILE, OUTCOME_FILE, "an outcome")
            outcome = parsed_outcome(content.decode(errors="replace"))
    if outcome.end is End.UNKNOWN:
        outcome = outcome_of_log(tape, scenario, simulated=recorded.engagements is None)
    return outcome
