# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Mutation of the code as a measure of its tests: each change of benchmarks/mutants.yaml must fail a test.

python -m benchmarks.mutants                         # all, two at a time, in clones of the last commit
python -m benchmarks.mutants --file law.py guard.py  # of these files

A mutant replaces one place of a file of `ros_ws/src`. It is killed where one of the tests beside it fails, or where they hang.
One that survives is a missing test, or an equivalent: then `equivalent` says why no test can tell it from the original.
When a defect is mended, add the defect as a mutant. The exit status is 1 where a mutant survives, or an equivalent is killed.
"""

import argparse
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from queue import SimpleQueue
from typing import Any

import yaml
from rich.progress import track

REPOSITORY = Path(__file__).resolve().parents[1]
LIST = Path(__file__).with_suffix(".yaml")
SOURCE = "ros_ws/src"
TIMEOUT = 300  # s for the tests of a mutant; the longest take 40 s alone
KILLED, SURVIVED, HANGS = "killed", "survived", "hung"


@dataclass(frozen=True)
class Mutant:
    """`old`, which occurs once in `file` (PACKAGE/FILE.py), becomes `new`. `tests` are files below tests/."""

    file: str
    tests: tuple[str, ...]
    old: str
    new: str
    what: str
    equivalent: str = ""

    @property
    def path(self) -> str:
        """Of the file in the repository."""
        package, _, name = self.file.partition("/")
        return f"{SOURCE}/{package}/{package}/{name}"

    def mutated(self, text: str) -> str:
        """The file's text with the change. Raises ValueError where `old` does not occur once."""
        if (count := text.count(self.old)) != 1:
            raise ValueError(f"{self.file}: found {self.old!r} {count} times, expected once")
        return text.replace(self.old, self.new)


def mutants(path: Path = LIST) -> list[Mutant]:
    """The list, which groups mutants by file."""
    groups: list[dict[str, Any]] = yaml.safe_load(path.read_text(encoding="utf-8"))
    return [Mutant(group["file"], tuple(group["tests"]), **row) for group in groups for row in group["mutants"]]


@dataclass(frozen=True)
class Clones:
    """Clones of the last commit, for as many tests at a time."""

    folder: Path
    free: SimpleQueue[Path]

    @classmethod
    def of(cls, folder: Path, count: int) -> "Clones":
        """Make them. The objects of git are shared with the repository."""
        clones = cls(folder, SimpleQueue())
        for number in range(count):
            clone = folder / str(number)
            subprocess.run(["git", "clone", "--quiet", "--shared", REPOSITORY, clone], check=True)  # noqa: S603, S607
            clones.free.put(clone)
        return clones

    def verdict(self, tests: Sequence[str], mutant: Mutant | None = None) -> tuple[str, str]:
        """KILLED, SURVIVED or HANGS, and the test that failed first. The clone is left as it was."""
        clone = self.free.get()
        original = (clone / mutant.path).read_text(encoding="utf-8") if mutant else ""
        try:
            if mutant:
                (clone / mutant.path).write_text(mutant.mutated(original), encoding="utf-8")
            return _tested(tests, clone)
        finally:
            if mutant:
                (clone / mutant.path).write_text(original, encoding="utf-8")
            self.free.put(clone)


def _tested(tests: Sequence[str], clone: Path) -> tuple[str, str]:
    packages = os.pathsep.join(str(path.parent) for path in clone.glob(f"{SOURCE}/*/setup.py"))
    environment = os.environ | {"PYTHONPATH": packages, "PYTHONDONTWRITEBYTECODE": "1", "OPENBLAS_NUM_THREADS": "1"}
    command = [sys.executable, "-m", "pytest", "-x", "-q", "--no-header", "-p", "no:cacheprovider"]
    command += [f"tests/{name}" for name in tests]
    try:
        run = subprocess.run(  # noqa: S603
            command, cwd=clone, env=environment, capture_output=True, text=True, timeout=TIMEOUT, check=False
        )
    except subprocess.TimeoutExpired:
        return HANGS, ""
    failed = [line for line in run.stdout.splitlines() if line.startswith(("FAILED", "ERROR"))]
    return (KILLED, failed[0] if failed else run.stdout[-200:]) if run.returncode else (SURVIVED, "")


def verdicts(chosen: Sequence[Mutant], jobs: int) -> Iterator[tuple[Mutant, str, str]]:
    """Each mutant with its verdict, `jobs` at a time. Raises ValueError where tests fail without a mutant."""
    with tempfile.TemporaryDirectory(prefix="mutants-") as folder, ThreadPoolExecutor(jobs) as pool:
        clones = Clones.of(Path(folder), jobs)
        files = list(dict.fromkeys(mutant.tests for mutant in chosen))
        for tests, (result, test) in zip(files, pool.map(clones.verdict, files), strict=True):
            if result != SURVIVED:
                raise ValueError(f"{', '.join(tests)}: {test or result} without a mutant")
        results = pool.map(lambda mutant: clones.verdict(mutant.tests, mutant), chosen)
        for mutant, (result, test) in zip(chosen, results, strict=True):
            yield mutant, result, test


def main() -> None:
    """Run the list."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--file", nargs="+", default=[], help="names of files to mutate; without it all")
    parser.add_argument("--list", type=Path, default=LIST, help="another list")
    parser.add_argument("--jobs", type=int, default=2, help="mutants at a time")
    parser.add_argument("--verbose", action="store_true", help="print the killed ones too, with the test")
    arguments = parser.parse_args()
    chosen = [m for m in mutants(arguments.list) if not arguments.file or Path(m.file).name in arguments.file]
    if not chosen:
        parser.error(f"--file: no mutant of {', '.join(arguments.file)}")
    count = {KILLED: 0, SURVIVED: 0, HANGS: 0}
    wrong = 0
    for mutant, result, test in track(verdicts(chosen, arguments.jobs), "mutants", total=len(chosen)):
        count[result] += 1
        unexpected = (result == SURVIVED) == (not mutant.equivalent)
        wrong += unexpected
        if unexpected or arguments.verbose:
            print(f"{result}: {mutant.file}: {mutant.what}: {mutant.new!r} {test}", flush=True)
    equivalents = sum(bool(mutant.equivalent) for mutant in chosen)
    counts = ", ".join(f"{number} {result}" for result, number in count.items())
    print(f"{len(chosen)} mutants: {counts}; {equivalents} of them named equivalents")
    sys.exit(bool(wrong))


if __name__ == "__main__":
    main()
