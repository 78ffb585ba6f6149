# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Implement `rise-di export`, which writes the controller of a scenario as C99.

A proof shows that C and Python give the same bits.
"""

from dataclasses import asdict, dataclass
from enum import Enum
from pathlib import Path
from typing import Any

import typer
from rich.console import Console

from flight_cli.log_options import warn_of_lacks
from flight_cli.output import print_json
from flight_cli.words import (
    REQUIRED,
    argument,
    json_option,
    option,
    rare_option,
    scenario_names,
)
from flight_log.tape_reader import read_run
from rise_di.c_code import Exported
from rise_di.c_code import export as write_export

DIFFERS = 1


class Target(Enum):
    """What the code is written for. The value is the argument `autopilot` of the library."""

    C = None
    PX4 = "px4"
    ARDUPILOT = "ardupilot"


@dataclass(frozen=True, kw_only=True)
class Export:
    """Write the controller of a scenario as C99, and prove that C and Python give the same bits.

    The code is compiled. The proof feeds it with flights in one process (with lost samples, faults,
    new parameters, engagement, limits), with random calls and with random steps. It compares every
    u and every state. Exit status: 0 proved, or written with --no-proof; 1 a bit differs; 2 bad
    input.
    """

    scenario: str = argument(
        "Name of a scenario, or path of a scenario file (.yaml).",
        default=REQUIRED,
        autocompletion=scenario_names,
    )
    folder: Path | None = option(
        "Folder to write the C code and the report of the proof to.", "--c", "--output"
    )
    px4: Path | None = option("Folder to write an external module of PX4 to, in place of --c.")
    ardupilot: Path | None = option("Folder to write a fast task of ArduPlane to, in place of --c.")
    run: Path | None = option(
        "Prove with the ticks of a recorded run in place of flights. If its scenario learns, "
        "export the last model of the run."
    )
    float32: bool = option(
        "Compute in single precision. The proof then bounds the difference of u.", default=False
    )
    duration: float | None = rare_option(
        "Duration of each flight of the proof, s; by default as in the scenario, at most 20 s.",
        min=1.0,
    )
    drawn: int = rare_option(
        "Number of drawn steps in the proof.", default=50_000, min=1, max=10_000_000
    )
    seed: int = rare_option("Seed of the drawn inputs.", default=1, min=0)
    compiler: list[str] | None = option(
        "Command of a C compiler, as in 'python -m ziglang cc'; may be repeated. By default gcc "
        "and clang, if they are installed."
    )
    runner: str = rare_option(
        "Command that starts what the compiler makes, as in qemu-aarch64.", default=""
    )
    samples: int | None = rare_option(
        "Number of samples of y and of y_m that the controller keeps; by default 8 in a module, "
        "else 100.",
        min=4,
    )
    rate: float | None = rare_option(
        "Rate of the law, the reference model and y, Hz; the observer is discretised for it."
    )
    fmu: bool = option("Also write a co-simulation unit of FMI 2.0 (rise_di.fmu).", default=False)
    without_proof: bool = option("Write the code without a proof.", "--no-proof", default=False)
    as_json: bool = json_option()

    def execute(self) -> None:
        """Write the code, prove it, and print the proof."""
        folders = {
            Target.C: self.folder,
            Target.PX4: self.px4,
            Target.ARDUPILOT: self.ardupilot,
        }
        given = [(target, folder) for target, folder in folders.items() if folder is not None]
        if len(given) != 1:
            raise typer.BadParameter("expected --c FOLDER, --px4 FOLDER or --ardupilot FOLDER")
        ((target, folder),) = given
        recorded_run = None if self.run is None else read_run(self.run)
        if recorded_run is not None:
            warn_of_lacks(recorded_run)
        with Console(stderr=True, quiet=self.as_json).status("flying and comparing"):
            exported = write_export(
                self.scenario,
                folder,
                run=recorded_run,
                float32=self.float32,
                duration=self.duration,
                drawn=self.drawn,
                seed=self.seed,
                compiler=self.compiler or (),
                runner=self.runner,
                fmu=self.fmu,
                autopilot=target.value,
                samples=self.samples,
                rate=self.rate,
                proof=not self.without_proof,
            )
        if self.as_json:
            print_json(_as_json(exported))
        elif exported.proof is None:
            print(*exported.files, "not proved: --no-proof", sep="\n")
        else:
            print(exported.report, *exported.files, sep="\n")
        if exported.proof is not None:
            raise typer.Exit(0 if exported.proof.is_proved else DIFFERS)


def _as_json(exported: Exported) -> dict[str, Any]:
    """Return the written files and the results of the proof as a dict that JSON can hold."""
    proof = exported.proof
    files = {"files": [str(path) for path in exported.files]}
    if proof is None:
        return {**files, "proved": None}
    comparisons = [
        {**comparison._asdict(), "first": comparison.first and asdict(comparison.first)}
        for comparison in proof.comparisons
    ]
    return {
        **files,
        "proved": proof.is_proved,
        "compilers": proof.compilers,
        "comparisons": comparisons,
        "figures": proof.figures,
    }
