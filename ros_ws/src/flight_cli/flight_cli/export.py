# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""`rise-di export`: the controller of a scenario as C99, with a proof that C and Python give the same bits."""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from flight_analysis.c_export.constants import exportable
from flight_analysis.c_export.drawn import drawn_calls, drawn_steps
from flight_analysis.c_export.events import Recording, flight_recordings, parameter_sets, run_recording
from flight_analysis.c_export.library import build_fmu
from flight_analysis.c_export.proof import FMU, REPORT, compilers, prove, report, write_code
from flight_analysis.closed_loop.scenario import Scenario
from flight_bringup.scenarios import find_scenario
from flight_cli.log_options import warn_of_lacks
from flight_cli.output import options, print_json
from flight_core.files import write_file, writing
from flight_core.parameters import require
from flight_log.tape_reader import read_run
from rise_di_controller.rise_di import RiseDiConfig

DIFFERS = 1
PART = 50_000  # drawn steps of a recording
LONGEST = 20.0  # s, of a flight without --duration


def export(
    scenario: Annotated[str, typer.Argument(help="Name of a scenario, or path of a scenario file (.yaml).")],
    folder: Annotated[Path, typer.Option("--c", help="Folder to write the C code and the report of the proof to.")],
    run: Annotated[Path | None, typer.Option(help="Prove with the ticks of a recorded run, in place of flights.")] = None,
    float32: Annotated[
        bool, typer.Option("--float32", help="Compute in float. The proof then bounds the difference of u.")
    ] = False,
    duration: Annotated[
        float | None, typer.Option(min=1.0, help="Duration of a flight of the proof, s; else the scenario's, at most 20 s.")
    ] = None,
    drawn: Annotated[int, typer.Option(min=1, max=10_000_000, help="Number of drawn steps of the proof.")] = 50_000,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the drawn inputs.")] = 1,
    compiler: Annotated[
        list[str] | None,
        typer.Option(help="Command of a C compiler, as 'python -m ziglang cc'; may be repeated. Else gcc and clang, if there."),
    ] = None,
    fmu: Annotated[
        bool, typer.Option("--fmu", help="Write a co-simulation unit of FMI 2.0 (rise_di.fmu) beside the code.")
    ] = False,
    without_proof: Annotated[bool, typer.Option("--no-proof", help="Write the code without a proof.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print the result as JSON, nothing else.")] = False,
) -> None:
    """Write the controller of a scenario as C99, compile it, and prove that C and Python give the same bits.

    The proof feeds the code with flights in one process (with lost samples, faults, new parameters, engagement, limits), with
    drawn calls and with drawn steps. It compares every u and every state. Exit status: 0 proved, 1 a bit differs, 2 bad input.
    """
    chosen = find_scenario(scenario)
    controller = exportable(chosen.controller)
    with options("compiler", "c"):
        commands = [] if without_proof else compilers(compiler or ())
        paths = write_code(controller, chosen.name, folder, float32=float32)
        if fmu:
            paths.append(build_fmu(folder, (commands or compilers(compiler or ()))[0], controller, chosen.name, folder / FMU))
    if without_proof:
        if as_json:
            print_json({"files": [str(path) for path in paths], "proved": None})
        else:
            print("\n".join(map(str, paths)) + "\nnot proved: --no-proof")
        return
    length = min(chosen.flight.duration, LONGEST) if duration is None else duration
    with Console(stderr=True, quiet=as_json).status("flying and comparing"):
        if run is None:
            sets = parameter_sets(controller)
            recordings = _recordings(chosen.vary(flight={"duration": length}), sets, 0 if float32 else drawn, seed)
        else:
            recorded = read_run(run)
            warn_of_lacks(recorded)
            sets, recording, as_logged = run_recording(recorded)
            require(sets[0].digest() == controller.digest(), "--run", "a flight with other parameters", f"those of {scenario}")
            recordings = iter([recording])
        proof = prove(folder, commands, sets, recordings, float32=float32)
    text = report(proof, chosen.name)
    if run is not None:
        text += f"{as_logged} of {recording.ticks} ticks have the u of the log to the bit\n"
    with writing("c", folder, "a folder that can"):
        write_file(folder / REPORT, text)
    if as_json:
        comparisons = [
            {**comparison._asdict(), "first": comparison.first and comparison.first._asdict()}
            for comparison in proof.comparisons
        ]
        print_json(
            {
                "files": [str(path) for path in (*paths, folder / REPORT)],
                "proved": proof.holds,
                "compilers": proof.compilers,
                "comparisons": comparisons,
            }
            | {"figures": proof.figures}
        )
    else:
        print(text + "\n" + "\n".join(map(str, (*paths, folder / REPORT))))
    raise typer.Exit(0 if proof.holds else DIFFERS)


def _recordings(scenario: Scenario, sets: Sequence[RiseDiConfig], drawn: int, seed: int) -> Iterator[Recording]:
    """Flights; `drawn` steps and a tenth as many calls, in parts, so that a part fits in memory."""
    yield from flight_recordings(scenario, sets)
    if drawn:
        yield drawn_calls(sets, max(drawn // 10, 100), seed)
        each = -(-drawn // len(sets))
        for index in range(len(sets)):
            for begin in range(0, each, PART):
                yield drawn_steps(sets, index, min(PART, each - begin), seed + index + begin)
