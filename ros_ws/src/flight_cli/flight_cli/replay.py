# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""`rise-di replay`: compute a recorded flight again and compare it bit by bit, or with other gains
in open loop.
"""

import csv
import io
import math
from collections import Counter
from itertools import product
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from rich.console import Console

from flight_analysis.closed_loop.guidance_replay import GuidanceReplay, replay_guidance
from flight_analysis.closed_loop.replay import (
    Difference,
    ReplayResult,
    recorded_parameters,
    recorded_scenario,
    vary,
)
from flight_analysis.closed_loop.replay import replay as recompute
from flight_analysis.metrics import error_metrics
from flight_analysis.report.account import WHOLE
from flight_analysis.report.run_folder import log_account
from flight_cli.log_options import LogNamespace, LogRemaps, LogScenario, remaps_of, scenario_file
from flight_cli.output import LATEST, new_table, print_json, stdout_for, write_text
from flight_cli.settings import Settings, parse_settings
from flight_cli.words import AsJson, argument, option
from flight_core.outcome import STATUS_INCOMPLETE
from flight_core.parameters import require
from flight_core.text import printable
from flight_log.tape_reader import read_run

DIFFERS = 1


def replay(
    run: Annotated[Path, argument("Folder of a run, or an MCAP file.")] = LATEST,
    settings: Settings = None,
    scenario: LogScenario = None,
    namespace: LogNamespace = None,
    remap: LogRemaps = None,
    csv_file: Annotated[
        Path | None,
        option("CSV file for u as recorded and as computed; - for standard output.", "--csv"),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Compute every tick of a recorded flight again, and every step of guidance, and compare it
    with the log bit by bit.

    --set computes u from the recorded y and y_m with other parameters. That is an open loop: the
    aircraft did not fly this u. Exit status: 0 every bit equal, 1 a tick differs or flew with other
    parameters, 2 bad input, 4 every bit equal, and less than 99 % of the ticks are in the log with
    y and u.
    """
    changes = parse_settings(settings, "controller")
    changed = {name.removeprefix("controller."): value for name, value in changes.items()}
    scenario_source = scenario_file(scenario)
    with Console(stderr=True, quiet=as_json).status(f"computing {printable(str(run))} again"):
        recorded = read_run(run, namespace, scenario_source, remaps_of(remap))
        recorded.require()
        parameters = recorded_parameters(recorded.scenario_file())
        others = vary(parameters, changed) if changed else None
        result = recompute(recorded, parameters, others)
        guided = None
        if others is None and "guidance" in recorded.tape:
            guided = replay_guidance(recorded.tape, recorded_scenario(recorded).guidance)
    require(
        bool(result.checked.any()),
        str(run),
        "no tick that could be checked",
        "a log with two successive ticks",
    )
    if csv_file is not None:
        _write_csv(csv_file, result, parameters.inputs)
    account = log_account(recorded)
    lacks = () if account is None else account.notes()
    ticks = max(
        len(result.number), 0 if account is None else account.topics["internals"].expected or 0
    )
    notes = (
        *recorded.tape.notes,
        *lacks,
        *result.notes,
        *_parameter_notes(result, open_loop=others is not None),
    )
    notes += () if guided is None else guided.notes
    with stdout_for(csv_file):
        if as_json:
            guidance_json = None if guided is None else _guidance_as_json(guided)
            replay_json = _as_json(result, notes, parameters.inputs, settings or [])
            print_json({**replay_json, "expected": ticks, "guidance": guidance_json})
        else:
            _show(result, notes, parameters.inputs, ticks, open_loop=others is not None)
            if guided is not None:
                _show_guidance(guided)
    equal = result.equal() and (guided is None or guided.equal())
    part = STATUS_INCOMPLETE if result.compared.sum() < WHOLE * ticks else 0
    raise typer.Exit(part if equal else DIFFERS)


def _show_guidance(guided: GuidanceReplay) -> None:
    first = guided.first
    summary = f"guidance: {guided.checked} of {guided.steps} steps checked"
    if first is None:
        print(f"{summary}, every bit equal")
    else:
        print(
            f"{summary}, {guided.differing} differ, the first at t = {first.t:.6g} s: "
            f"{_difference(first)}"
        )


def _difference(first: Difference) -> str:
    """A difference as a text."""
    distance = (
        "which is not a number"
        if first.ulps is None
        else f"{first.computed - first.recorded:+.3g}, {first.ulps} ULP"
    )
    return f"{first.channel} recorded {first.recorded!r}, computed {first.computed!r}, {distance}"


def _guidance_as_json(guided: GuidanceReplay) -> dict[str, Any]:
    first = guided.first
    shown = None if first is None else {**first._asdict(), "ulps": first.ulps}
    return {
        "steps": guided.steps,
        "checked": guided.checked,
        "differing": guided.differing,
        "first": shown,
    }


def _parameter_notes(result: ReplayResult, *, open_loop: bool) -> list[str]:
    """A note for ticks that flew with other parameters than those of the log."""
    rows = np.flatnonzero(result.other_parameters)
    if open_loop or len(rows) == 0:
        return []
    first = rows[0]
    since = f"{len(rows)} ticks, from tick {result.number[first]} at t = {result.t[first]:.6g} s on"
    why = "changed in flight (`ros2 param set`), or set on the command line of the node"
    return [f"{since}, flew with other parameters than the log holds: {why}"]


def _show(
    result: ReplayResult,
    notes: tuple[str, ...],
    inputs: tuple[str, ...],
    ticks: int,
    *,
    open_loop: bool,
) -> None:
    console = Console(soft_wrap=True, highlight=False)
    first = result.first()
    checked = int(result.compared.sum())
    summary = f"{checked} ticks" if checked == ticks else f"{checked} of {ticks} ticks checked"
    if first is None:
        console.print(
            (
                f"{summary}, every bit equal"
                if checked
                else f"{summary}: the log holds no tick with y and u"
            )
            + (", yet with other parameters" if result.other_parameters.any() else "")
        )
    else:
        different = result.different()
        rows = np.flatnonzero(different.any(axis=1))
        console.print(
            f"tick {first.number} differs first, at t = {first.t:.6g} s: {_difference(first)}"
        )
        by_group = ", ".join(
            f"{name} in {count}" for name, count in _count_by_group(result).items()
        )
        console.print(
            f"{summary}, {len(rows)} differ, the last at t = {result.t[rows[-1]]:.6g} s; {by_group}"
        )
    if open_loop:
        headings = ("input", "rms", "max", "at t (s)", "rms recorded")
        table = new_table("u computed minus u recorded", headings)
        for name, figures in _u_figures(result, inputs).items():
            table.add_row(name, *(f"{value:.4g}" for value in figures.values()))
        console.print(table)
    for note in notes:
        console.print(f"note: {note}")


def _count_by_group(result: ReplayResult) -> dict[str, int]:
    """Number of ticks in which each group of channels differs."""
    different = result.different()
    groups = [name.split(".")[0] for name in result.names]
    ticks = {group: different[:, np.array(groups) == group].any(axis=1) for group in groups}
    counts = Counter({group: int(differs.sum()) for group, differs in ticks.items()})
    return {name: count for name, count in counts.most_common() if count}


def _u_figures(result: ReplayResult, inputs: tuple[str, ...]) -> dict[str, dict[str, float]]:
    """Difference of u by input, in its unit: rms, largest, its time, and the rms of the recorded u;
    NaN without a u.
    """
    known = np.isfinite(result.computed).all(axis=1)
    recorded = result.group(result.recorded[known], "u")
    computed = result.group(result.computed[known], "u")
    figures = {}
    for name in inputs:
        difference = computed[name] - recorded[name]
        rms, largest = error_metrics(difference)
        t_max = (
            float(result.t[known][np.argmax(np.abs(difference))]) if len(difference) else math.nan
        )
        figures[name] = {
            "rms": rms,
            "max": largest,
            "t_max": t_max,
            "rms_recorded": error_metrics(recorded[name]).rms,
        }
    return figures


def _as_json(
    result: ReplayResult, notes: tuple[str, ...], inputs: tuple[str, ...], settings: list[str]
) -> dict[str, Any]:
    first = result.first()
    return {
        "open_loop": bool(settings),
        "set": settings,
        "ticks": len(result.number),
        "checked": int(result.compared.sum()),
        "equal": result.equal(),
        "other_parameters": int(result.other_parameters.sum()),
        "differing": int(result.different().any(axis=1).sum()),
        "differing_by_group": _count_by_group(result),
        "first": None if first is None else {**first._asdict(), "ulps": first.ulps},
        "u_difference": _u_figures(result, inputs),
        "notes": list(notes),
    }


def _write_csv(path: Path, result: ReplayResult, inputs: tuple[str, ...]) -> None:
    """One row a tick: number, t, then each input as recorded and as computed, in digits that
    restore every bit.
    """
    columns = [result.names.index(f"u.{name}") for name in inputs]
    text = io.StringIO(newline="")
    writer = csv.writer(text)
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
