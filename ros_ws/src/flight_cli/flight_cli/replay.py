# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""`rise-di replay`: a recorded flight computed again and compared bit by bit, or with other gains as an open loop."""

import csv
import json
from collections import Counter
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from rich import box
from rich.console import Console
from rich.table import Table

from flight_analysis.closed_loop.replay import OPEN_LOOP, Difference, Replayed, recorded_parameters, vary
from flight_analysis.closed_loop.replay import replay as recompute
from flight_analysis.metrics import error_figures
from flight_core.files import parse_yaml
from flight_core.parameters import ParameterError, require
from flight_log.stored_messages import parameter_changes
from flight_log.tape_reader import read_run
from rise_di_controller.params import ControllerParameters

DIFFERS = 1


def replay(
    run: Annotated[Path, typer.Argument(help="Folder of a run, or an MCAP file.")],
    settings: Annotated[
        list[str] | None,
        typer.Option(
            "--set", help="A parameter to fly with instead, as in controller.Lambda='[5, 5, 3, 1]'; several times for several."
        ),
    ] = None,
    namespace: Annotated[str | None, typer.Option(help="Of the aircraft, where the log holds several.")] = None,
    csv_file: Annotated[Path | None, typer.Option("--csv", help="Write u as recorded and as computed to a CSV file.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print the result as JSON, nothing else.")] = False,
) -> None:
    """Compute every tick of a recorded flight again and compare it with the log bit by bit.

    With --set: fly the recorded inputs with other parameters, as an open loop: the recorded aircraft did not fly that u.
    Exit status: 0 every bit equal, 1 a tick differs or flew with other parameters, 2 bad input.
    """
    with Console(stderr=True, quiet=as_json).status(f"computing {run} again"):
        recorded = read_run(run, namespace)
        if recorded.scenario is None:
            raise ParameterError(f"{run}: found a log without its scenario, expected a run that was flown from one")
        parameters = recorded_parameters(recorded.scenario)
        others = vary(parameters, dict(map(_setting, settings))) if settings else None
        changes = parameter_changes(run, "controller", ControllerParameters.model_fields) if others is None else []
        result = recompute(recorded.tape, parameters, others, changes)
    require(bool(result.checked.any()), str(run), "no tick that could be checked", "a log with two successive ticks")
    if csv_file is not None:
        _write_csv(csv_file, result, parameters.inputs)
    notes = (*recorded.tape.notes, *result.notes, *_other_parameters(result, open_loop=others is not None))
    if as_json:
        print(json.dumps(_plain(result, notes, parameters.inputs, settings or [])))
    else:
        _show(result, notes, parameters.inputs, open_loop=others is not None)
    raise typer.Exit(0 if result.equal() else DIFFERS)


def _setting(text: str) -> tuple[str, Any]:
    name, equals, value = text.partition("=")
    key = name.strip().removeprefix("controller.")
    fits = bool(equals) and key != name.strip()
    require(fits, "--set", repr(text), "a parameter of the controller and its value, as in controller.k_g=2.0")
    return key, parse_yaml(value, f"--set {text!r}", "a value")


def _other_parameters(result: Replayed, *, open_loop: bool) -> list[str]:
    """Which ticks flew with other parameters than those that they are computed with."""
    rows = np.flatnonzero(result.other_parameters)
    if open_loop or len(rows) == 0:
        return []
    first = rows[0]
    since = f"{len(rows)} ticks, from tick {result.number[first]} at t = {result.t[first]:.6g} s on"
    why = "changed in flight (`ros2 param set`), or given to the node beside the scenario"
    return [f"{since}, flew with other parameters than the log holds: {why}"]


def _show(result: Replayed, notes: tuple[str, ...], inputs: tuple[str, ...], *, open_loop: bool) -> None:
    console = Console(soft_wrap=True, highlight=False)
    first, checked, ticks = result.first(), int(result.checked.sum()), len(result.number)
    of = f"{checked} ticks" if checked == ticks else f"{checked} of {ticks} ticks checked"
    if first is None:
        console.print(f"{of}, every bit equal" + (", yet with other parameters" if result.other_parameters.any() else ""))
    else:
        different = result.different()
        rows = np.flatnonzero(different.any(axis=1))
        console.print(
            f"tick {first.number} differs first, at t = {first.t:.6g} s: {first.channel} recorded {first.recorded!r},"
            f" computed {first.computed!r}, {_distance(first)}"
        )
        by_group = ", ".join(f"{name} in {count}" for name, count in _by_group(result).items())
        console.print(f"{of}, {len(rows)} differ, the last at t = {result.t[rows[-1]]:.6g} s; {by_group}")
    if open_loop:
        table = Table(title=f"u computed less u recorded, {OPEN_LOOP}", title_justify="left", box=box.SIMPLE_HEAD)
        for heading in ("input", "rms", "max", "at t (s)", "rms recorded"):
            table.add_column(heading, justify="left" if heading == "input" else "right", no_wrap=True)
        for name, figures in _u_figures(result, inputs).items():
            table.add_row(name, *(f"{value:.4g}" for value in figures.values()))
        console.print(table)
    for note in notes:
        console.print(f"note: {note}")


def _distance(first: Difference) -> str:
    if first.ulps is None:
        return "which is no number"
    return f"{first.computed - first.recorded:+.3g}, {first.ulps} ULP"


def _by_group(result: Replayed) -> dict[str, int]:
    """In how many ticks each group of channels differs."""
    different = result.different()
    groups: dict[str, list[int]] = {}
    for column, name in enumerate(result.names):
        groups.setdefault(name.split(".")[0], []).append(column)
    counts = Counter({name: int(different[:, columns].any(axis=1).sum()) for name, columns in groups.items()})
    return {name: count for name, count in counts.most_common() if count}


def _u_figures(result: Replayed, inputs: tuple[str, ...]) -> dict[str, dict[str, float]]:
    """By how much u differs, by input, in its unit: rms, largest, when, and the rms of the recorded u itself."""
    known = np.isfinite(result.computed).all(axis=1)
    recorded, computed = result.group(result.recorded[known], "u"), result.group(result.computed[known], "u")
    figures = {}
    for name in inputs:
        difference = computed[name] - recorded[name]
        rms, largest = error_figures(difference)
        at = float(result.t[known][np.argmax(np.abs(difference))])
        figures[name] = {"rms": rms, "max": largest, "t_max": at, "rms_recorded": error_figures(recorded[name]).rms}
    return figures


def _plain(result: Replayed, notes: tuple[str, ...], inputs: tuple[str, ...], settings: list[str]) -> dict[str, Any]:
    first = result.first()
    return {
        "open_loop": bool(settings),
        "set": settings,
        "ticks": len(result.number),
        "checked": int(result.checked.sum()),
        "equal": result.equal(),
        "other_parameters": int(result.other_parameters.sum()),
        "differing": int(result.different().any(axis=1).sum()),
        "differing_by_group": _by_group(result),
        "first": None if first is None else _first(first),
        "u_difference": _u_figures(result, inputs),
        "notes": list(notes),
    }


def _first(first: Difference) -> dict[str, Any]:
    computed = None if np.isnan(first.computed) else first.computed  # JSON has no NaN
    return first._asdict() | {"computed": computed, "ulps": first.ulps}


def _write_csv(path: Path, result: Replayed, inputs: tuple[str, ...]) -> None:
    """A row a tick: number, t, then each input as recorded and as computed, in digits that come back to the last bit."""
    columns = [result.names.index(f"u.{name}") for name in inputs]
    try:
        with path.open("w", newline="", encoding="utf-8") as stream:
            writer = csv.writer(stream)
            writer.writerow(["number", "t", *(f"u.{name}.{what}" for name in inputs for what in ("recorded", "computed"))])
            for row in range(len(result.number)):
                pairs = ((result.recorded[row, column], result.computed[row, column]) for column in columns)
                values = [float(value) for pair in pairs for value in pair]
                writer.writerow([int(result.number[row]), float(result.t[row]), *values])
    except OSError as error:
        raise ParameterError(f"--csv: {path} cannot be written ({error.strerror}), expected the path of a file") from None
