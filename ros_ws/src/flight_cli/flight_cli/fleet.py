# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Fly several aircraft at once, as `rise-di fly` does with a fleet file."""

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from flight_analysis.report.run_report import (
    UnwrittenReportError,
    write_empty_summary,
    write_report,
)
from flight_analysis.report.separation import Track, place_of, separation_shortfalls
from flight_analysis.report.summary import coverage_suffix
from flight_bringup.fleet import Fleet, MemberFlight, fly_fleet, read_fleet
from flight_cli.output import CLOCK_COLUMNS, NAME_COLUMN, clock, new_table, print_json, progress_bar
from flight_cli.words import warn
from flight_core.environment import require_ros_environment
from flight_core.files import display_path
from flight_core.installation import require_package
from flight_core.modes import Mode
from flight_core.outcome import SEVEREST, STATUS_INTERRUPTED, never_flew
from flight_core.parameters import ParameterError


def open_fleet(file: str, duration: float | None, *, use_sim_time: bool) -> Fleet:
    """Read a fleet from a file. Raises ParameterError if it cannot be flown on this host."""
    require_package("rclpy", "")
    require_ros_environment()
    return read_fleet(file, duration, use_sim_time=use_sim_time)


def fly_fleet_file(fleet: Fleet, runs: Sequence[Path], *, as_json: bool) -> int:
    """Fly a fleet, and return the severest exit status of its aircraft.

    Each aircraft has a separate namespace, and separate nodes, log and report.
    """
    totals = {member.name: member.scenario.flight.duration for member in fleet.members}
    with progress_bar(NAME_COLUMN, *CLOCK_COLUMNS, quiet=as_json) as bar:
        tasks = {
            name: bar.add_task(name, total=total, clock="", shown="")
            for name, total in totals.items()
        }

        def progress(name: str, t: float, text: str) -> None:
            bar.update(tasks[name], completed=t, clock=clock(t, totals[name]), shown=text)

        flights = fly_fleet(fleet, runs, progress)
        for each in flights:
            bar.update(tasks[each.member.name], shown=f"{each.outcome}, report to write")
        reported: dict[str, _AircraftResult] = {}
        with suppress(KeyboardInterrupt):
            for each in flights:
                reported[each.member.name] = _report(each)
            reported |= _separated(fleet, flights, reported)
    results = {each.member.name: _unreported(each) for each in flights} | reported
    if as_json:
        print_json({name: result.summary for name, result in results.items()})
    else:
        _show(fleet.name, flights, results)
    statuses: list[int] = [result.summary["outcome"]["status"] for result in reported.values()]
    statuses += [STATUS_INTERRUPTED] if len(reported) < len(flights) else []
    return max(statuses, key=SEVEREST.index)


@dataclass(frozen=True, kw_only=True)
class _AircraftResult:
    """The summary of an aircraft, and in which share of its ticks the controller was ENGAGED.

    The share `engaged` is None if there are no ticks. `track` is where the aircraft was, or None
    without a pose.
    """

    summary: dict[str, Any]
    engaged: float | None
    track: Track | None = None


def _separated(
    fleet: Fleet, flights: Sequence[MemberFlight], reported: Mapping[str, _AircraftResult]
) -> dict[str, _AircraftResult]:
    """Rewrite the reports of the aircraft that violated the separation of the fleet."""
    tracks = {name: result.track for name, result in reported.items() if result.track is not None}
    shortfalls = separation_shortfalls(tracks, fleet.separation)
    return {
        each.member.name: _report(
            replace(each, outcome=replace(each.outcome, shortfalls=(shortfalls[each.member.name],)))
        )
        for each in flights
        if each.member.name in shortfalls
    }


def _unreported(flight: MemberFlight) -> _AircraftResult:
    """Return what is known of an aircraft before its report is written."""
    outcome = flight.outcome.as_json()
    outcome["sentence"] = f"{flight.outcome}, no report: rise-di report writes it"
    return _AircraftResult(
        summary={"outcome": outcome, "duration": None, "ticks": None, "account": None}, engaged=None
    )


def _report(member_flight: MemberFlight) -> _AircraftResult:
    """Write the report of an aircraft, and return its result."""
    try:
        flight = write_report(member_flight.run, member_flight.outcome).flight
    except UnwrittenReportError as error:
        flight = error.result.flight
        warn(f"error: {member_flight.member.name}: no report: {error}")
    except ParameterError as error:
        # The flight ended before the first sample.
        outcome = (
            never_flew(str(error)) if member_flight.outcome.status == 0 else member_flight.outcome
        )
        try:
            summary = write_empty_summary(member_flight.run, member_flight.member.scenario, outcome)
        except ParameterError as unwritten:
            warn(f"error: {member_flight.member.name}: no summary: {unwritten}")
            return _unreported(replace(member_flight, outcome=outcome))
        return _AircraftResult(summary=summary, engaged=None)
    internals = flight.tape.signals.get("internals")
    guidance = member_flight.member.scenario.guidance
    place = place_of(flight.tape)
    return _AircraftResult(
        summary=flight.summary,
        engaged=None if internals is None else float(np.mean(internals["mode"] == Mode.ENGAGED)),
        track=None
        if place is None or not len(place.stamp_ns)
        else Track(flight.tape.start_ns, place, None if guidance is None else guidance.origin),
    )


def _show(
    name: str, flights: Sequence[MemberFlight], results: Mapping[str, _AircraftResult]
) -> None:
    """Print a line for each aircraft, the folders of the runs, and effects of a busy host."""
    headings = ("aircraft", "flown (s)", "ticks", "engaged", "outcome")
    table = new_table(f"Fleet {name}", headings, ("aircraft", "outcome"), ("outcome",))
    lines = []
    for each in flights:
        result = results[each.member.name]
        summary = result.summary
        ticks = summary["ticks"]
        table.add_row(
            each.member.name,
            "-" if summary["duration"] is None else f"{summary['duration']:.1f}",
            "-" if ticks is None else str(ticks["ticks"]),
            "-"
            if result.engaged is None
            else f"{100.0 * result.engaged:.4g} %{coverage_suffix(summary, 'ticks')}",
            summary["outcome"]["sentence"],
        )
        lines.append(f"{each.member.name}: {display_path(each.run)}")
        if sentence := (summary["account"] or {}).get("busy"):
            lines.append(f"  {sentence}")
    Console().print(table)
    print(
        *lines,
        *foreign_samples({name: result.summary for name, result in results.items()}),
        sep="\n",
    )


def foreign_samples(summaries: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """Return sentences on the samples that foreign nodes sent on the topics of an aircraft.

    A foreign node is outside the aircraft's namespace. The result is empty if no log says which
    process sent how many samples.
    """
    sentences = []
    total = 0
    for name, summary in summaries.items():
        processes = (summary["account"] or {}).get("processes", {})
        total += sum(process["samples"] or 0 for process in processes.values())
        foreign = sum(
            process["samples"] or 0
            for node, process in processes.items()
            if node.rpartition("/")[0] != f"/{name}"
        )
        sentences += [f"{name}: {foreign} samples from outside of /{name}"] if foreign else []
    return sentences or ([f"samples from outside of the aircraft: 0 of {total}"] if total else [])
