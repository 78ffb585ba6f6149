# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""`rise-di export`: the controller of a scenario as C99, with a proof that C and Python give the
same bits.
"""

from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from flight_cli.log_options import warn_of_lacks
from flight_cli.output import print_json
from flight_cli.words import AsJson, argument, option, setting
from flight_log.tape_reader import read_run
from rise_di.c_code import export as write_export

DIFFERS = 1


def export(
    scenario: Annotated[str, argument("Name of a scenario, or path of a scenario file (.yaml).")],
    folder: Annotated[
        Path | None,
        option("Folder to write the C code and the report of the proof to.", "--c", "--output"),
    ] = None,
    px4: Annotated[
        Path | None, option("Folder to write an external module of PX4 to, in place of --c.")
    ] = None,
    run: Annotated[
        Path | None, option("Prove with the ticks of a recorded run, in place of flights.")
    ] = None,
    float32: Annotated[
        bool, option("Compute in float. The proof then bounds the difference of u.", "--float32")
    ] = False,
    duration: Annotated[
        float | None,
        option("Duration of a flight of the proof, s; else the scenario's, at most 20 s.", min=1.0),
    ] = None,
    drawn: Annotated[
        int, setting("drawn", "Number of drawn steps of the proof.", min=1, max=10_000_000)
    ] = 50_000,
    seed: Annotated[int, setting("seed", "Seed of the drawn inputs.", min=0)] = 1,
    compiler: Annotated[
        list[str] | None,
        option(
            "Command of a C compiler, as 'python -m ziglang cc'; may be repeated. Else gcc "
            "and clang, if there."
        ),
    ] = None,
    runner: Annotated[
        str, setting("runner", "Command that starts what the compiler makes, as qemu-aarch64.")
    ] = "",
    samples: Annotated[
        int | None,
        typer.Option(
            "--set samples",
            min=4,
            help="Samples of y and of y_m that the controller keeps; else 8 of a module, or 100.",
        ),
    ] = None,
    fmu: Annotated[
        bool,
        option("Write a co-simulation unit of FMI 2.0 (rise_di.fmu) beside the code.", "--fmu"),
    ] = False,
    without_proof: Annotated[bool, option("Write the code without a proof.", "--no-proof")] = False,
    as_json: AsJson = False,
) -> None:
    """Write the controller of a scenario as C99, compile it, and prove that C and Python give the
    same bits.

    The proof feeds the code with flights in one process (with lost samples, faults, new parameters,
    engagement, limits), with drawn calls and with drawn steps. It compares every u and every state.
    Exit status: 0 proved, 1 a bit differs, 2 bad input.
    """
    chosen = folder or px4
    if chosen is None or (folder and px4):
        raise typer.BadParameter("expected --c FOLDER or --px4 FOLDER")
    recorded = None if run is None else read_run(run)
    if recorded is not None:
        warn_of_lacks(recorded)
    with Console(stderr=True, quiet=as_json).status("flying and comparing"):
        files, proof, text = write_export(
            scenario,
            chosen,
            run=recorded,
            float32=float32,
            duration=duration,
            drawn=drawn,
            seed=seed,
            compiler=compiler or (),
            runner=runner,
            samples=samples,
            fmu=fmu,
            px4=px4 is not None,
            proof=not without_proof,
        )
    if proof is None:
        if as_json:
            print_json({"files": [str(path) for path in files], "proved": None})
        else:
            print("\n".join(map(str, files)) + "\nnot proved: --no-proof")
        return
    if as_json:
        comparisons = [
            {**comparison._asdict(), "first": comparison.first and comparison.first._asdict()}
            for comparison in proof.comparisons
        ]
        print_json(
            {
                "files": [str(path) for path in files],
                "proved": proof.holds,
                "compilers": proof.compilers,
                "comparisons": comparisons,
            }
            | {"figures": proof.figures}
        )
    else:
        print(text + "\n" + "\n".join(map(str, files)))
    raise typer.Exit(0 if proof.holds else DIFFERS)
