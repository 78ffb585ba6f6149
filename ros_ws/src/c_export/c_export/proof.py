# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Compile the exported C code, and compare it with the controller in Python.

C gets the same calls as Python. Every u and every state of C is compared bit by bit.
"""

import json
import shlex
import shutil
import subprocess
import tempfile
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import NamedTuple

import numpy as np

from c_export.constants import header, packed
from c_export.events import Recording
from flight_core.files import write_file, writing
from flight_core.parameters import ParameterError, require
from flight_core.vectors import FloatArray
from reference_model.params import ReferenceModelConfig
from rise_di_controller.guard.guard import SAMPLE_BUFFER_SIZE
from rise_di_controller.rise_di_config import RiseDiConfig

SOURCE = Path(str(files("c_export"))) / "source"
CODE = ("rise_di.h", "rise_di.c", "rise_di_table.c")
PARAMETERS = "rise_di_parameters.h"
# Files that are written together with the code.
REPORT = "proof.txt"
FMU = "rise_di.fmu"
CERTIFICATE = "certificate.json"  # certificate of the guarantee of the loop
COMPILERS = ("gcc", "clang")
FLAGS = ("-std=c99", "-O2", "-Wall", "-Wextra", "-Werror", "-pedantic", "-ffp-contract=off")
COUNTING_FLAGS = ("-x", "c++", "-std=c++20", "-O2", "-include", "counting.h")
LEAST_SAMPLES = 4  # least number of samples to keep, because the slope of y_m spans two periods

FLOAT32_BOUND = 2.0**-10
"""Largest difference of u at which C in float32 still agrees with Python, as a fraction of the
range of u in the flight."""


@dataclass(frozen=True, kw_only=True)
class Difference:
    """The first value of a recording that differs between C and Python."""

    tick: int  # number of the tick, from 0
    channel: str
    python: float
    c: float


class Comparison(NamedTuple):
    """The result of comparing C with Python over a recording of T ticks."""

    name: str
    ticks: int
    values: int  # number of compared values
    differing: int  # number of values that differ
    first: Difference | None
    deviation: float  # largest difference of any u, as a fraction of its range
    has_equal_integers: bool  # integers of the states are modes and times

    def is_met(self, *, float32: bool) -> bool:
        """Return whether C agrees with Python.

        In float64, every bit must be equal. In float32, every integer, such as the mode, must be
        equal, and u must be within FLOAT32_BOUND.
        """
        return (
            self.has_equal_integers and self.deviation <= FLOAT32_BOUND
            if float32
            else self.differing == 0
        )


def write_code(
    controller: RiseDiConfig,
    scenario: str,
    folder: Path,
    reference: ReferenceModelConfig | None = None,
    *,
    float32: bool,
    samples: int = SAMPLE_BUFFER_SIZE,
) -> list[Path]:
    """Write the C code of a controller and of a reference model to a folder.

    Report, FMI unit and certificate of earlier code in the folder are removed. The controller in C
    stores the last `samples` samples of y, and as many of y_m. Raises ParameterError if the files
    cannot be written.
    """
    require(samples >= LEAST_SAMPLES, "samples", samples, f"{LEAST_SAMPLES} or more")
    with writing("c", folder):
        folder.mkdir(parents=True, exist_ok=True)
        for name in (REPORT, FMU, CERTIFICATE):
            (folder / name).unlink(missing_ok=True)
        for name in CODE:
            shutil.copyfile(SOURCE / name, folder / name)
        text = header(controller, scenario, reference, float32=float32, samples=samples)
        write_file(folder / PARAMETERS, text)
    return [folder / name for name in (*CODE, PARAMETERS)]


def compilers(names: Sequence[str] = ()) -> list[list[str]]:
    """Return the commands of the C compilers to use.

    The result is `names` or, if this is empty, each command of COMPILERS that is on the PATH.
    Raises ParameterError if there is no compiler.
    """
    commands = [words(command) for command in names] or [
        [name] for name in COMPILERS if shutil.which(name)
    ]
    if not commands:
        raise ParameterError(
            f"compiler: found none of {', '.join(COMPILERS)} on the PATH, expected one for the "
            "proof; "
            "--no-proof writes the code without a proof"
        )
    return commands


def words(
    command: str, option: str = "compiler", expected: str = "the command of a C compiler"
) -> list[str]:
    """Split a command into words, as a shell does.

    Raises ParameterError if the command names no program.
    """
    try:
        parts = shlex.split(command)
    except ValueError as error:  # a quotation mark is missing
        raise ParameterError(
            f"{option}: found {command!r} ({error}), expected {expected}"
        ) from None
    require(
        bool(parts) and shutil.which(parts[0]) is not None,
        option,
        f"no program {command!r}",
        expected,
    )
    return parts


class Program:
    """A program that replays recordings in C: proof.c and the exported code, compiled together."""

    def __init__(
        self, code: Path, compiler: Sequence[str], sets: Sequence[RiseDiConfig], folder: Path, *,
        float32: bool = False,
        flags: Sequence[str] = FLAGS, source: str | None = None, runner: Sequence[str] = (),
    ) -> None:  # fmt: skip
        """Compile the program in the folder `folder`.

        `source` replaces the text of rise_di.c, and `runner` is a command that starts the program.
        Raises ParameterError if the compiler fails.
        """
        self._folder = folder
        self._runner = runner
        self._float32 = float32
        folder.mkdir(parents=True, exist_ok=True)
        for path in (
            *(code / name for name in (*CODE, PARAMETERS)),
            SOURCE / "proof.c",
            SOURCE / "counting.h",
        ):
            shutil.copyfile(path, folder / path.name)
        if source is not None:
            (folder / "rise_di.c").write_text(source, encoding="utf-8")
        self.take(sets)
        build([*compiler, *flags, "-o", "proof", "proof.c"], folder)

    def take(self, sets: Sequence[RiseDiConfig]) -> None:
        """Replace the parameter sets to which the program can change.

        The program ignores the first set, because it starts with the parameters in the exported
        header.
        """
        self._sets = sets
        content = b"".join(packed(controller, float32=self._float32) for controller in sets)
        (self._folder / "sets").write_bytes(content)

    def run(self, recording: Recording) -> tuple[np.ndarray, FloatArray, Mapping[str, int]]:
        """Run the program with a recording, and return the integers and the reals of its states.

        The integers and reals have the same form as in the recording. The third result has the
        numbers that the program prints, by name.
        """
        (self._folder / "events").write_bytes(recording.events.tobytes())
        (self._folder / "loaded").write_bytes(recording.loaded.tobytes())
        command = [*self._runner, "./proof", "sets", "events", "loaded", "states"]
        try:
            process = subprocess.run(  # noqa: S603 - a program built here
                command, cwd=self._folder, capture_output=True, text=True, check=False
            )
        except OSError as error:
            raise ParameterError(
                f"compiler: found a program that does not start here ({error.strerror}), expected "
                "a compiler for this machine"
            ) from None
        if process.returncode:
            raise ParameterError(
                f"the exported code: {(process.stderr or 'the program failed').strip()[-2000:]}"
            )
        integers = recording.integers.shape[1]
        states = np.fromfile(self._folder / "states", dtype=np.int64)
        states = states.reshape(-1, len(recording.names))
        reals = states[:, integers:].view(np.float64)
        return states[:, :integers], reals, json.loads(process.stdout)

    def compare(self, recording: Recording) -> Comparison:
        """Run the program with a recording, and compare its states with the states in Python."""
        integers, reals, _ = self.run(recording)
        m = len(self._sets[0].outputs)
        if len(integers) != recording.ticks:
            raise ParameterError(
                f"the exported code: found {len(integers)} ticks of {recording.ticks}, expected "
                "each"
            )
        integers_differ = integers != recording.integers
        reals_differ = reals.view(np.int64) != recording.reals.view(np.int64)
        differ = np.hstack([integers_differ, reals_differ])
        first = None
        if differ.any():
            tick, column = np.argwhere(differ)[0].tolist()
            python = np.hstack([recording.integers[tick], recording.reals[tick]])
            c = np.hstack([integers[tick], reals[tick]])
            first = Difference(
                tick=tick,
                channel=recording.names[column],
                python=float(python[column]),
                c=float(c[column]),
            )
        u = recording.reals[:, :m]
        with np.errstate(over="ignore", invalid="ignore"):  # wrong C code may give any number
            parts = np.abs(reals[:, :m] - u).max(axis=0) / np.maximum(
                np.ptp(u, axis=0), np.finfo(float).tiny
            )
        return Comparison(
            name=recording.name,
            ticks=recording.ticks,
            values=differ.size,
            differing=int(differ.sum()),
            first=first,
            deviation=float(parts.max()),
            has_equal_integers=not integers_differ.any(),
        )


class Proof(NamedTuple):
    """The results of a proof: compilers, comparisons, and measured sizes and operations."""

    compilers: tuple[str, ...]  # versions of the compilers
    comparisons: tuple[Comparison, ...]  # comparisons of all recordings for each compiler
    figures: Mapping[str, int]  # numbers of bytes and of operations, by name
    float32: bool

    @property
    def is_proved(self) -> bool:
        """Whether C agrees with Python in every comparison."""
        return all(comparison.is_met(float32=self.float32) for comparison in self.comparisons)


def prove(
    code: Path,
    commands: Sequence[Sequence[str]],
    sets: Sequence[RiseDiConfig],
    recordings: Iterable[Recording],
    *,
    float32: bool,
    runner: Sequence[str] = (),
) -> Proof:
    """Compile the code in a folder with each compiler, and compare it with the recordings.

    Every state of the C code is compared with the recorded state of the Python code. `runner`, such
    as qemu, starts the programs of a compiler for another machine. If g++ is installed and the code
    is in float64, a further program counts the operations on reals, and finds the largest number in
    one call.
    """
    comparisons: list[Comparison] = []
    with tempfile.TemporaryDirectory(prefix="rise_di_export_") as name:
        folder = Path(name)
        programs = [
            Program(code, command, sets, folder / str(k), float32=float32, runner=runner)
            for k, command in enumerate(commands)
        ]
        figures = footprint(code, commands[0], folder)
        counting = None
        if shutil.which("g++") is not None and not float32:
            counting = Program(code, ["g++"], sets, folder / "counting", flags=COUNTING_FLAGS)
        for recording in recordings:
            comparisons += [program.compare(recording) for program in programs]
            printed = (counting or programs[0]).run(recording)[2]
            figures |= {key: max(value, figures.get(key, 0)) for key, value in printed.items()}
    return Proof(
        tuple(" ".join([version(command), *command[1:]]) for command in commands),
        tuple(comparisons),
        figures,
        float32,
    )


FIGURES = {
    "code_bytes": "machine code and constants of the functions, bytes",
    "data_bytes": "global variables, bytes",
    "parameters_bytes": "struct rise_di_parameters, bytes",
    "controller_bytes": "struct rise_di_controller, bytes, with the samples kept",
    "stack_bytes": "stack at most, bytes (sum of the frames of all functions)",
    "add": "largest number of additions and subtractions in one call of the proof",
    "multiply": "largest number of multiplications in one call of the proof",
    "divide": "largest number of divisions in one call of the proof",
    "compare": "largest number of comparisons in one call of the proof",
}


def proof_report(proof: Proof, scenario: str) -> str:
    """Return the report of a proof as text."""
    precision = "float32" if proof.float32 else "float64"
    lines = [
        f"C code of the controller of {scenario}, {precision}, beside the controller in Python",
        "",
        *(f"compiler: {name}, {shlex.join(FLAGS)}" for name in proof.compilers),
        "",
    ]
    several = len(proof.compilers) > 1
    for k, comparison in enumerate(proof.comparisons):
        compiler = f", {proof.compilers[k % len(proof.compilers)]}" if several else ""
        difference = f", {comparison.differing} differ"
        if proof.float32:
            part_of_range = f"{comparison.deviation:.2g} of its range, bound {FLOAT32_BOUND:.2g}"
            difference = f"; u within {part_of_range}"
        ticks = f"{comparison.ticks} ticks, {comparison.values} values"
        lines.append(f"{comparison.name}{compiler}: {ticks}{difference}")
        if comparison.first is not None and not comparison.is_met(float32=proof.float32):
            first = comparison.first
            lines.append(
                f"    first in tick {first.tick}: {first.channel} is {first.python!r} in Python, "
                f"{first.c!r} in C"
            )
    lines += [
        "",
        *(f"{FIGURES[name]}: {proof.figures[name]}" for name in FIGURES if name in proof.figures),
    ]
    if proof.float32:
        result = f"every mode is equal and u is within {FLOAT32_BOUND:.2g} of its range"
    else:
        result = "every bit is equal"
    lines += ["", f"PROVED: {result}" if proof.is_proved else "NOT PROVED"]
    return "\n".join(lines) + "\n"


def build(command: Sequence[str], folder: Path) -> None:
    """Run a compiler in a folder. Raises ParameterError with the compiler's message if it fails."""
    process = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)  # noqa: S603 - the user's compiler
    if process.returncode:
        said = (process.stderr or process.stdout).strip() or f"exit status {process.returncode}"
        raise ParameterError(f"{shlex.join(command)}: {said[-2000:]}")


def version(compiler: Sequence[str]) -> str:
    """Return the first line of a compiler's version text."""
    process = subprocess.run([*compiler, "--version"], capture_output=True, text=True, check=False)  # noqa: S603 - as above
    return (process.stdout or process.stderr).partition("\n")[0].strip()


def footprint(code: Path, compiler: Sequence[str], folder: Path) -> dict[str, int]:
    """Measure the memory of the exported code, in bytes.

    Under the names in FIGURES, the result has three numbers of bytes: of machine code with its
    constants, of global variables, and of the stack. The bytes of the stack are the sum of the
    frames of all functions. No function calls itself, so no chain of calls needs more than this
    sum. An unknown number is left out.
    """
    for name in (*CODE, PARAMETERS):
        shutil.copyfile(code / name, folder / name)
    try:
        build([*compiler, *FLAGS, "-fstack-usage", "-c", "-o", "rise_di.o", "rise_di.c"], folder)
    except ParameterError:  # the compiler has no -fstack-usage
        build([*compiler, *FLAGS, "-c", "-o", "rise_di.o", "rise_di.c"], folder)
    sizes = {}
    usage = folder / "rise_di.su"
    if usage.is_file():
        lines = [line.split("\t") for line in usage.read_text(encoding="utf-8").splitlines()]
        sizes["stack_bytes"] = sum(int(line[1]) for line in lines)
    if (size := shutil.which("size")) is not None:
        process = subprocess.run(  # noqa: S603 - of binutils
            [size, "rise_di.o"], cwd=folder, capture_output=True, text=True, check=False
        )
        if not process.returncode:  # `size` fails for files of another machine
            text, data, bss = (int(word) for word in process.stdout.splitlines()[1].split()[:3])
            sizes |= {"code_bytes": text, "data_bytes": data + bss}
    return sizes
