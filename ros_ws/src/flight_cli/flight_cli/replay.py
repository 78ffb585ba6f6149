# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Implement `rise-di replay`, which computes a recorded flight again, bit by bit.

With other gains, it computes the flight in open loop.
"""

import io
import math
from collections import Counter
from collections.abc import Sequence
from csv import writer as csv_writer
from dataclasses import asdict, dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import typer
from rich.console import Console

from flight_analysis.closed_loop.guidance_replay import GuidanceReplay, replay_guidance
from flight_analysis.closed_loop.replay import (
    ReplayDifference,
    ReplayResult,
    is_controller_alone,
    later_aircraft,
    recorded_parameters,
    recorded_scenario,
)
from flight_analysis.closed_loop.replay import replay as recompute
from flight_analysis.closed_loop.replay_ticks import vary
from flight_analysis.linear_loop.certificate import kept_guarantee
from flight_analysis.linear_loop.guarantee import Guarantee
from flight_analysis.metrics.errors import error_metrics
from flight_analysis.report.flown_models import flown_loops
from flight_analysis.report.model_spans import parameter_spans
from flight_analysis.report.recorded_flight import log_account
from flight_analysis.report.sample_counts import WHOLE
from flight_cli.log_options import REMAP, log_namespace, log_scenario, remaps_of, scenario_file
from flight_cli.output import LATEST, new_table, print_json, print_table, stdout_for, write_text
from flight_cli.settings import parse_settings, settings_option
from flight_cli.words import argument, json_option, option
from flight_core.outcome import STATUS_SHORTFALL
from flight_core.parameters import require
from flight_core.text import printable
from flight_log.tape_reader import RecordedRun, read_run

DIFFERS = 1


@dataclass(frozen=True, kw_only=True)
class Replay:
    """Compute every tick of a recorded flight again and compare it with the log bit by bit.

    Every step of guidance is computed and compared, too. --set computes u from the recorded y and
    y_m with other parameters. That is an open loop, because the aircraft did not fly this u. Exit
    status: 0 every bit is equal; 1 a tick differs or flew with other parameters; 2 bad input; 4
    every bit is equal, but less than 99 % of the ticks are in the log with y and u.
    """

    run: Path = argument("Folder of a run, or an MCAP file.", default=LATEST)
    settings: list[str] | None = settings_option()
    scenario: str | None = log_scenario()
    namespace: str | None = log_namespace()
    remap: list[str] | None = option(REMAP, metavar="NAME:=TOPIC")
    csv: Path | None = option("CSV file for u as recorded and as computed; - is standard output.")
    as_json: bool = json_option()

    def execute(self) -> None:
        """Compute every tick again, print what differs, and exit with the status."""
        changes = parse_settings(self.settings, "controller")
        controller_changes = {
            name.removeprefix("controller."): value for name, value in changes.items()
        }
        source = scenario_file(self.scenario)
        name = printable(str(self.run))
        with Console(stderr=True, quiet=self.as_json).status(f"computing {name} again"):
            recorded_run = read_run(self.run, self.namespace, source, remaps_of(self.remap))
            recorded_run.require()
            stored = recorded_run.scenario_file()
            parameters = recorded_parameters(stored, recorded_run.namespace)
            others = vary(parameters, controller_changes) if controller_changes else None
            result = recompute(recorded_run, parameters, others)
            guidance_replay = None
            if others is None and "guidance" in recorded_run.tape:
                guidance_replay = replay_guidance(
                    recorded_run.tape, recorded_scenario(recorded_run).guidance
                )
        has_check = bool(result.checked.any())
        expected = "a log with two successive ticks"
        require(has_check, str(self.run), "no tick that could be checked", expected)
        if self.csv is not None:
            _write_csv(self.csv, result, parameters.inputs)
        account = log_account(recorded_run)
        expected_ticks = None if account is None else account.topics["internals"].expected
        guarantee, differences = (None, ()) if others is not None else _claims_of(recorded_run)
        answer = Shown(
            result,
            parameters.inputs,
            ticks=max(len(result.number), expected_ticks or 0),
            is_open_loop=others is not None,
            guided=guidance_replay,
            guarantee=guarantee if result.is_equal() else None,
            differences=differences if result.is_equal() else (),
        )
        lacks = () if account is None else account.notes()
        notes = (*recorded_run.tape.notes, *lacks, *answer.notes())
        with stdout_for(self.csv):
            if self.as_json:
                print_json(_as_json(answer, notes, self.settings or []))
            else:
                _show(answer, notes)
        equal = result.is_equal() and (guidance_replay is None or guidance_replay.is_equal())
        part = STATUS_SHORTFALL if result.is_compared.sum() < WHOLE * answer.ticks else 0
        raise typer.Exit(part if equal else DIFFERS)


class Shown(NamedTuple):
    """What the command prints: the ticks that were computed again, and steps of guidance."""

    result: ReplayResult
    inputs: tuple[str, ...]
    ticks: int  # number of ticks that were flown; the log may lack some
    is_open_loop: bool  # whether u was computed with other parameters
    guided: GuidanceReplay | None
    guarantee: Guarantee | None  # guarantee that was kept for the loop of the flight, if any
    differences: tuple[str, ...] = ()  # how the aircraft differs from what the controller knew

    def notes(self) -> list[str]:
        """Return notes on the computation, and on ticks that had other parameters."""
        result = self.result
        notes = [*result.notes, *(() if self.guided is None else self.guided.notes)]
        rows = np.flatnonzero(result.other_parameters)
        if not self.is_open_loop and len(rows):
            begin = f"from tick {result.number[rows[0]]} at t = {result.t[rows[0]]:.6g} s on"
            if rows[0]:
                why = (
                    "they were changed in flight (`ros2 param set`), or the controller began again "
                    "with others"
                )
            else:
                why = (
                    "the controller got another file than the recorder (with its file: `rise-di "
                    "replay RUN --scenario FILE`), or values on its command line or before it "
                    "engaged, or is of a revision of the stack with other keys (rise_di_revision "
                    "of the log)"
                )
            notes.append(
                f"{len(rows)} ticks, {begin}, had other parameters than the log holds: {why}"
            )
        return notes


def _claims_of(run: RecordedRun) -> tuple[Guarantee | None, tuple[str, ...]]:
    """Return the guarantee of a flight's loop, and sentences on the aircraft.

    The sentences say how the aircraft differs from what the controller was told. The guarantee is
    None if none was computed, if there is no linear model, if the parameters changed in flight, or
    if it does not hold for the aircraft that flew.
    """
    if len({span.digest for span in parameter_spans(run.tape)}) > 1:
        return None, ()
    tape = run.tape
    if run.age_of_u is not None:
        tape = replace(tape, signals={**tape.signals, "age_of_u": run.age_of_u})
    if is_controller_alone(run.scenario_file()):
        return None, ()
    scenario = recorded_scenario(run)
    flown = flown_loops(tape, scenario, (), later_aircraft(run, scenario))
    guarantee = kept_guarantee(flown.loops[0].loop) if flown.loops else None
    return guarantee, flown.sentences


def _show_guidance(replay_of_guidance: GuidanceReplay) -> None:
    first = replay_of_guidance.first
    summary = f"guidance: {replay_of_guidance.checked} of {replay_of_guidance.steps} steps checked"
    if first is None:
        print(f"{summary}, every bit equal")
    else:
        print(
            f"{summary}, {replay_of_guidance.differing} differ, the first at t = {first.t:.6g} s: "
            f"{_difference(first)}"
        )


def _difference(first: ReplayDifference) -> str:
    """Describe the difference between a recorded and a computed value."""
    if first.ulps is None:
        distance = "which is not a number"
    else:
        distance = f"{first.computed - first.recorded:+.3g}, {first.ulps} ULP"
    return f"{first.channel} recorded {first.recorded!r}, computed {first.computed!r}, {distance}"


def _guidance_as_json(replay_of_guidance: GuidanceReplay) -> dict[str, Any]:
    first = replay_of_guidance.first
    difference = None if first is None else {**asdict(first), "ulps": first.ulps}
    return {
        "steps": replay_of_guidance.steps,
        "checked": replay_of_guidance.checked,
        "differing": replay_of_guidance.differing,
        "first": difference,
    }


def _show(answer: Shown, notes: Sequence[str]) -> None:
    from flight_analysis.report.margin_figures import guarantee_text  # noqa: PLC0415 - loads plots

    console = Console(soft_wrap=True, highlight=False)
    result = answer.result
    first = result.first()
    compared_count = int(result.is_compared.sum())
    summary = f"{compared_count} ticks"
    if compared_count != answer.ticks:
        summary = f"{compared_count} of {answer.ticks} ticks checked"
    if first is None:
        equal = ", every bit equal" if compared_count else ": the log holds no tick with y and u"
        others = ", yet with other parameters" if result.other_parameters.any() else ""
        console.print(f"{summary}{equal}{others}")
    else:
        rows = np.flatnonzero(result.is_different().any(axis=1))
        console.print(
            f"tick {first.number} differs first, at t = {first.t:.6g} s: {_difference(first)}"
        )
        groups = ", ".join(f"{name} in {count}" for name, count in _count_by_group(result).items())
        last = result.t[rows[-1]]
        console.print(f"{summary}, {len(rows)} differ, the last at t = {last:.6g} s; {groups}")
    if answer.is_open_loop:
        headings = ("input", "rms", "max", "at t (s)", "rms recorded")
        table = new_table("u computed minus u recorded", headings)
        for name, figures in _u_figures(result, answer.inputs).items():
            table.add_row(name, *(f"{value:.4g}" for value in figures.values()))
        print_table(console, table)
    for note in notes:
        console.print(f"note: {note}")
    if answer.guided is not None:
        _show_guidance(answer.guided)
    for sentence in answer.differences:
        console.print(sentence)
    if answer.guarantee is not None:
        console.print(guarantee_text(answer.guarantee)[0])


def _count_by_group(result: ReplayResult) -> dict[str, int]:
    """Count the ticks in which each group of channels differs."""
    different = result.is_different()
    groups = [name.split(".")[0] for name in result.names]
    ticks = {group: different[:, np.array(groups) == group].any(axis=1) for group in groups}
    counts = Counter({group: int(differs.sum()) for group, differs in ticks.items()})
    return {name: count for name, count in counts.most_common() if count}


def _u_figures(result: ReplayResult, inputs: tuple[str, ...]) -> dict[str, dict[str, float]]:
    """Return by how much the computed u differs from the recorded u, by input.

    The figures are the rms of the difference, the largest difference with its time, and the rms of
    the recorded u, in the input's unit. They are NaN if there is no u.
    """
    is_finite = np.isfinite(result.computed).all(axis=1)
    u_recorded = result.group(result.recorded[is_finite], "u")
    u_computed = result.group(result.computed[is_finite], "u")
    figures = {}
    for name in inputs:
        difference = u_computed[name] - u_recorded[name]
        errors = error_metrics(difference)
        if len(difference):
            t_max = float(result.t[is_finite][np.argmax(np.abs(difference))])
        else:
            t_max = math.nan
        figures[name] = {
            "rms": errors.rms,
            "max": errors.max,
            "t_max": t_max,
            "rms_recorded": error_metrics(u_recorded[name]).rms,
        }
    return figures


def _as_json(answer: Shown, notes: Sequence[str], settings: list[str]) -> dict[str, Any]:
    result = answer.result
    replay_of_guidance = answer.guided
    first = result.first()
    return {
        "open_loop": bool(settings),
        "set": settings,
        "ticks": len(result.number),
        "checked": int(result.is_compared.sum()),
        "equal": result.is_equal(),
        "other_parameters": int(result.other_parameters.sum()),
        "differing": int(result.is_different().any(axis=1).sum()),
        "differing_by_group": _count_by_group(result),
        "first": None if first is None else {**asdict(first), "ulps": first.ulps},
        "u_difference": _u_figures(result, answer.inputs),
        "notes": list(notes),
        "expected": answer.ticks,
        "guidance": None if replay_of_guidance is None else _guidance_as_json(replay_of_guidance),
        "differences": list(answer.differences),
        "guarantee": None if answer.guarantee is None else answer.guarantee.as_json(),
    }


def _write_csv(path: Path, result: ReplayResult, inputs: tuple[str, ...]) -> None:
    """Write a CSV file with a row for each tick.

    A row has the number of the tick, t, and each input as recorded and as computed. The numbers
    have enough digits to restore every bit.
    """
    columns = [result.names.index(f"u.{name}") for name in inputs]
    text = io.StringIO(newline="")
    writer = csv_writer(text)
    writer.writerow(
        [
            "number",
            "t",
            *(f"u.{name}.{what}" for name, what in product(inputs, ("recorded", "computed"))),
        ]
    )
    pairs = np.dstack([result.recorded[:, columns], result.computed[:, columns]]).reshape(
        len(result.number), -1
    )
    rows = zip(result.number.tolist(), result.t.tolist(), pairs.tolist(), strict=True)
    writer.writerows([number, t, *values] for number, t, values in rows)
    write_text("--csv", path, text.getvalue())
