# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Read a recorded run, and summarise its flight."""

import json
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

from flight_analysis.closed_loop.replay import (
    is_controller_alone,
    later_aircraft,
    recorded_changes,
    recorded_parameters,
)
from flight_analysis.closed_loop.scenario import Scenario, parse_scenario
from flight_analysis.report.account import Account, account
from flight_analysis.report.flight_outcome import (
    NEVER_ENGAGED,
    has_ticks,
    outcome_of_log,
    until_last_tick,
)
from flight_analysis.report.flown_models import FlownController, flown_controllers
from flight_analysis.report.model_spans import parameter_spans
from flight_analysis.report.run_folder import SUMMARY, folder_of
from flight_analysis.report.sample_counts import is_real_time
from flight_analysis.report.summary import (
    RecordedFlight,
    engagement_notes,
    summarise,
    summarise_imported,
    summarise_own,
)
from flight_core.arguments import FilePath
from flight_core.channels import RATES_AND_SPEED
from flight_core.files import display_path, read_file
from flight_core.outcome import End, Outcome, never_flew, parsed_outcome, read_outcome
from flight_core.parameters import ParameterError, require
from flight_core.rates import NANOSECONDS
from flight_core.tape import Tape
from flight_core.text import printable
from flight_guidance.guidance_log import require_channels
from flight_log.bag import CHANNEL_UNITS, IMPORTED, OUTCOME_FILE
from flight_log.engagements import Engagement
from flight_log.log_messages import last_words
from flight_log.provenance import FLIGHT
from flight_log.tape_reader import AIRCRAFT_TOPICS, RecordedRun, read_run


class UnflownError(ParameterError):
    """Raised if a log lacks y or y_m, so that only the `outcome` of the flight can be reported."""

    def __init__(self, sentence: str, outcome: Outcome) -> None:
        super().__init__(sentence)
        self.outcome = outcome


def read_accounted(
    run: FilePath,
    namespace: str | None = None,
    scenario: FilePath | None = None,
    remaps: Mapping[str, str] = {},
) -> RecordedRun:
    """Read the folder or a file of a run, and return its signals, scenario and files.

    The signals are named vectors, by topic name without the namespace. The bag, which is the log as
    ROS stores it, comes from this package or from `ros2 bag record`. It is MCAP, in one or several
    files, compressed or not. A truncated MCAP file is read up to the last complete chunk.

    In the result, `tape.account` has the number of samples of each topic, and `tape.notes` say what
    the log lacks. An imported log needs no scenario for its account. Any other log has no account
    if it lacks a scenario that can be read, and no log has one without a topic of an aircraft.

    Args:
        run: Folder of a run, or a file of the bag.
        namespace: Namespace of the aircraft, for a log with several aircraft.
        scenario: Scenario file in place of the scenario in the log.
        remaps: The names of topics in the log, by their names in this package, as in {"y":
            "/sensors/y"}. They are needed if the nodes were remapped.

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

    If `outcome` is None, the outcome is the one that the log, the summary or a launch stated, or
    the one that the samples show. `namespace`, `scenario` and `remaps` have the same meaning as in
    `read_accounted`. Raises ParameterError if the log cannot be read, or if it has no scenario and
    was not imported. If a flight of a scenario lacks y or y_m, UnflownError is raised. An imported
    log, and a log of the user's own aircraft, need y and u, else ParameterError is raised.
    """
    return flight_of(read_run(run, namespace, scenario, remaps), run, outcome)


def log_account(recorded: RecordedRun) -> Account | None:
    """Return an account of what a log holds and what it lacks.

    Returns None if the log has no flight, or has no scenario that can be read. An imported log
    needs no scenario.
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
    folder = None if recorded.path is None else folder_of(recorded.path)
    outcome = _previous_outcome(recorded, folder, scenario)
    return account(recorded.tape, scenario, outcome, simulated=recorded.engagements is None)


def scenario_in(recorded: RecordedRun, run: Path) -> Scenario:
    """Return the scenario that is stored in a log, or the scenario that `read_run` got instead.

    Its relative paths begin in the folder of the log. Raises ParameterError if the log has no valid
    scenario.
    """
    stored = recorded.scenario_file()
    return parse_scenario(stored.content, folder_of(run) / stored.name)


def flight_of(recorded: RecordedRun, run: Path, outcome: Outcome | None = None) -> RecordedFlight:
    """Summarise a recorded flight, as `read_flight` does.

    `run` is the path of the log, or the folder of the run.
    """
    recorded.require()
    name = printable(run.resolve().name if run.is_dir() else run.stem)
    if (source := recorded.metadata.get(IMPORTED)) is not None:
        return _imported_flight(recorded, name, source)
    if is_controller_alone(recorded.scenario_file()):
        return _own_aircraft_flight(recorded, name, outcome or recorded.tape.outcome)
    scenario = scenario_in(recorded, run)
    outcome = outcome or _previous_outcome(recorded, folder_of(run), scenario)
    return _scenario_flight(recorded, run, name, scenario, outcome)


def _imported_flight(recorded: RecordedRun, name: str, source: Mapping[str, str]) -> RecordedFlight:
    """Return the flight of an imported log. Only its y and u can be summarised."""
    recorded.require("y", "u")
    has_no_scenario = recorded.scenario is None
    expected = "none: an imported log flew no scenario"
    require(has_no_scenario, "scenario", "a scenario for an imported log", expected)
    return RecordedFlight(
        name=name,
        scenario=None,
        tape=recorded.tape,
        summary=summarise_imported(recorded.tape, source),
        si_units=recorded.metadata.get(CHANNEL_UNITS, {}),
    )


def _own_aircraft_flight(recorded: RecordedRun, name: str, outcome: Outcome) -> RecordedFlight:
    """Return the flight of a user's own aircraft. The log describes only the controller."""
    recorded.require("y", "u")
    controller = recorded_parameters(recorded.scenario_file(), recorded.namespace)
    summary = summarise_own(recorded.tape, controller.law, name, outcome)
    summary["flight"] = _identity(recorded)
    units = {channel: "m/s" if channel == "V" else "rad/s" for channel in RATES_AND_SPEED}
    return RecordedFlight(
        name=name, scenario=None, tape=recorded.tape, summary=summary, si_units=units
    )


def _scenario_flight(
    recorded: RecordedRun, run: Path, name: str, scenario: Scenario, outcome: Outcome
) -> RecordedFlight:
    """Return a flight whose log has a scenario, with its summary."""
    log = _with_times_of_messages(recorded)
    engagements = recorded.engagements
    if outcome.end is End.COMPLETED and engagements is None and not has_ticks(log):
        outcome = NEVER_ENGAGED
    if "guidance" in log:
        require_channels(log["guidance"].names)
    # The account covers the whole log. The metrics cover the engaged part, or the whole flight if
    # the engaged part is too short to contain y and y_m.
    tape = until_last_tick(log)
    flight_account = account(log, scenario, outcome, simulated=engagements is None)
    engaged_part = _engaged(tape, engagements or [])
    is_y_engaged = {"y", "y_m"} <= set(engaged_part.signals)
    part = engaged_part if is_y_engaged else tape
    try:
        summary = summarise(part, scenario, outcome, flight_account)
    except ParameterError as error:
        raise _with_cause(error, recorded, run, outcome) from None
    summary["flight"] = _identity(recorded)
    if engagements is not None:
        summary["engagements"] = [_engagement(tape, engagement) for engagement in engagements]
        summary["notes"] = [
            *engagement_notes(summary["engagements"], is_y_engaged=is_y_engaged),
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
    """Turn an error into an UnflownError with the last messages of the nodes.

    If the log has both y and y_m, the error is returned as it is.
    """
    if {"y", "y_m"} <= set(recorded.tape.signals):
        return error
    causes = last_words(recorded.messages)
    if causes and outcome == NEVER_ENGAGED:
        outcome = never_flew(f"{outcome.reason}; {causes[0]}")
    return UnflownError(
        f"{display_path(run.resolve())}: {'; '.join([str(error), *causes])}", outcome
    )


def _with_times_of_messages(recorded: RecordedRun) -> Tape:
    """Return the tape with the latency and the age of u as further signals.

    If the flight was in lockstep or in one process, there is no latency, because the nodes wait for
    each other.
    """
    latency = recorded.latency if is_real_time(recorded.tape) else None
    timed = {"latency": latency, "age_of_u": recorded.age_of_u}
    signals = {name: signal for name, signal in timed.items() if signal is not None}
    return replace(recorded.tape, signals={**recorded.tape.signals, **signals})


def _controllers(
    recorded: RecordedRun, tape: Tape, scenario: Scenario
) -> tuple[FlownController, ...]:
    """Return the controller's parameters that were used, or () if they did not change in flight."""
    if len({span.digest for span in parameter_spans(tape)}) < 2:
        return ()
    changes = recorded_changes(recorded, scenario.controller)
    return flown_controllers(tape, scenario.controller, changes)


def _engaged(tape: Tape, engagements: Sequence[Engagement]) -> Tape:
    """Return the engaged part of a flight behind a bridge. The metrics are computed from this part.

    Without engagements, as in every simulated flight, nothing is cut. Signals without samples are
    left out.
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
    """Return the beginning and the end of an engagement, flight time in s, and why it ended."""
    start, stop = (
        (time_ns - tape.start_ns) / NANOSECONDS if time_ns else None
        for time_ns in (engagement.start_ns, engagement.stop_ns)
    )
    return {"start": start, "stop": stop, "reason": engagement.reason}


def _identity(recorded: RecordedRun) -> dict[str, Any]:
    """Return the values by which a flight is recognised.

    The values are the stamp of t = 0, ns, and the time of day at which the flight started, if the
    log has this time.
    """
    started = recorded.metadata.get(FLIGHT, {}).get("start")
    return {"start_ns": recorded.tape.start_ns, "started": started}


def _previous_outcome(recorded: RecordedRun, folder: Path | None, scenario: Scenario) -> Outcome:
    """Return the outcome that was stated earlier for a flight, or find it from the samples.

    The log, the summary and a launch can state an outcome. The first of them that does, in this
    order, is used. If nodes were started by hand, only the samples of the log show how the flight
    ended.
    """
    stated = _stated_outcomes(recorded, folder)
    known = next((outcome for outcome in stated if outcome.end is not End.UNKNOWN), None)
    if known is None:
        is_simulated = recorded.engagements is None
        return outcome_of_log(recorded.tape, scenario, simulated=is_simulated)
    return known


def _stated_outcomes(recorded: RecordedRun, folder: Path | None) -> Iterator[Outcome]:
    """Yield the outcomes that the log, the summary and the file of a launch state."""
    if folder is None:
        yield recorded.tape.outcome
        return
    in_summary = _outcome_in_summary(recorded, folder)
    if in_summary is None:
        yield recorded.tape.outcome
    else:
        # The shortfalls of the summary are kept, because some, such as those of a fleet, do not
        # show in the log of one aircraft.
        yield replace(recorded.tape.outcome, shortfalls=in_summary.shortfalls)
        yield in_summary
    # A launch leaves a file with its outcome beside the log. It counts only if the folder has a log
    # that is named after it, as a launch names its log.
    if (folder / f"{folder.name}_0.mcap").is_file():
        with suppress(ParameterError):
            content = read_file(folder / OUTCOME_FILE, OUTCOME_FILE, "an outcome")
            yield parsed_outcome(content.decode(errors="replace"))


def _outcome_in_summary(recorded: RecordedRun, folder: Path) -> Outcome | None:
    """Return the outcome in a run's summary, or None if the summary is of another flight."""
    with suppress(OSError, ValueError, TypeError, KeyError):
        summary = json.loads((folder / SUMMARY).read_text(encoding="utf-8"))
        if summary["flight"] == _identity(recorded):
            return read_outcome(summary["outcome"])
    return None
