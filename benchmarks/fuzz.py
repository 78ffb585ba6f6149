# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Fuzz all readers of external input (tests/fuzz/targets.py), coverage-guided, with atheris.

python -m benchmarks.fuzz mcap --seconds 60          # or any other target of tests/fuzz/targets.py
python -m benchmarks.fuzz all --seconds 60  # every target, a core each; prints statistics as JSON
python -m benchmarks.fuzz mcap --replay FILE ...
    # each input once, under the same limits, without atheris
python -m benchmarks.fuzz all --replay      # the corpus of every target

A fuzzer starts from outputs of the stack's own writers and from tests/corpus/<target>/. At an input
that raises, hangs or takes too much memory it ends with a status other than 0 and keeps the input
in runs/fuzz/<target>/. Fix the reader and add the input to the corpus.
"""

import hashlib
import json
import os
import re
import resource
import signal
import subprocess
import sys
import tempfile
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from multiprocessing import get_context
from pathlib import Path
from types import FrameType

from benchmarks.tables import parser_of

REPOSITORY = Path(__file__).resolve().parents[1]
CORPUS = REPOSITORY / "tests" / "corpus"
FINDINGS = REPOSITORY / "runs" / "fuzz"

TIMEOUT = 20  # s an input of a few kB; processor time in a replay, wall time when fuzzing
MEMORY_MB = 1500  # of the process; the libraries of the readers take 250
MAX_LENGTH = 16 * 1024  # bytes of an input
STACK = [
    *(
        "aircraft_sim",
        "autopilot_bridge",
        "flight_analysis",
        "flight_core",
        "flight_log",
        "flight_recorder",
        "flight_view",
    ),
    *("flight_guidance", "rise_di_controller"),
]


def main() -> None:
    """Fuzz, or replay."""
    parser = parser_of(__doc__)
    names = (
        "mcap, metadata, scenario, airframe, export, map, message, route, vehicle_log, "
        "targets, control, page or all"
    )
    parser.add_argument("target", help=names)
    parser.add_argument("--seconds", type=int, default=60, help="how long to fuzz")
    parser.add_argument(
        "--replay",
        type=Path,
        nargs="*",
        help="read each of these inputs, or the corpus, once instead of fuzzing",
    )
    arguments = parser.parse_args()
    if arguments.replay is not None:
        replay(arguments.target, arguments.replay)
    elif arguments.target == "all":
        fuzz_all(arguments.seconds)
    else:
        sys.exit(fuzz(arguments.target, arguments.seconds))


def replay(name: str, files: list[Path]) -> None:
    """Read each input once: the files, or the corpus of the target, or of every target.

    Raises the errors of a target, MemoryError and TimeoutError.
    """
    from tests.fuzz.targets import TARGETS  # noqa: PLC0415 - instrumented when fuzzing

    def expire(number: int, frame: FrameType | None) -> None:
        raise TimeoutError(f"more than {TIMEOUT} s of processor time")

    signal.signal(signal.SIGPROF, expire)
    resource.setrlimit(resource.RLIMIT_DATA, (MEMORY_MB << 20, MEMORY_MB << 20))
    for target in TARGETS if name == "all" else [name]:
        inputs = files or sorted((CORPUS / target).iterdir())
        with tempfile.TemporaryDirectory(prefix="fuzz") as folder:
            for file in inputs:
                signal.setitimer(signal.ITIMER_PROF, TIMEOUT)
                try:
                    TARGETS[target](file.read_bytes(), Path(folder))
                except Exception:
                    print(f"{target}: {file}", file=sys.stderr)
                    raise
                signal.setitimer(signal.ITIMER_PROF, 0)
        print(f"{target}: {len(inputs)} inputs read or refused")


def fuzz_all(seconds: int) -> None:
    """Fuzz every target in a process of its own.

    Print the statistics and the exit status of each fuzzer.
    """
    from tests.fuzz.targets import TARGETS  # noqa: PLC0415 - as above

    def statistics(target: str) -> dict[str, int]:
        command = [sys.executable, "-m", "benchmarks.fuzz", target, "--seconds", str(seconds)]
        process = subprocess.run(  # noqa: S603 - ours
            command, cwd=REPOSITORY, check=False, capture_output=True, text=True
        )
        if process.returncode:
            print(process.stderr[-10_000:], file=sys.stderr)
        counts = re.findall(r"^stat::(\w+):\s+(\d+)", process.stderr, re.MULTILINE)
        counts += [("covered", count) for count in re.findall(r"cov: (\d+)", process.stderr)]
        return {"status": process.returncode} | {name: int(count) for name, count in counts}

    with ThreadPoolExecutor(os.cpu_count()) as pool:
        print(json.dumps(dict(zip(TARGETS, pool.map(statistics, TARGETS), strict=True)), indent=1))


def fuzz(target: str, seconds: int) -> int:
    """Fuzz for `seconds` in another process, whose files are removed afterwards.

    Returns its exit status.
    """
    memory = Path("/dev/shm")  # noqa: S108 - for speed
    with tempfile.TemporaryDirectory(
        prefix=f"fuzz-{target}-", dir=memory if memory.is_dir() else None
    ) as folder:
        process = get_context("fork").Process(target=_fuzz, args=(target, seconds, Path(folder)))
        process.start()
        # Ctrl-C has reached the fuzzer too, which ends with its statistics
        with suppress(KeyboardInterrupt):
            process.join()
        process.join()
    return process.exitcode or 0


def _fuzz(target: str, seconds: int, scratch: Path) -> None:
    """Fuzz with files in a folder; never returns."""
    import atheris  # noqa: PLC0415 - a replay does not need it

    with atheris.instrument_imports(include=[*STACK, "mcap", "rosbags"]):
        from tests.fuzz.targets import SEEDS, TARGETS  # noqa: PLC0415 - as above

    tempfile.tempdir = str(scratch)
    findings = FINDINGS / target
    findings.mkdir(parents=True, exist_ok=True)
    inputs = scratch / "inputs"
    inputs.mkdir()
    for k, seed in enumerate(SEEDS[target]()):
        (inputs / f"seed-{k}").write_bytes(seed)
    corpora = [str(path) for path in (inputs, CORPUS / target) if path.is_dir()]
    folder = scratch / "read"
    folder.mkdir()
    limits = {
        "max_total_time": seconds,
        "timeout": TIMEOUT,
        "rss_limit_mb": MEMORY_MB,
        "max_len": MAX_LENGTH,
    }
    options = limits | {"artifact_prefix": f"{findings}/", "print_final_stats": 1}
    arguments = [sys.argv[0], *(f"-{name}={value}" for name, value in options.items()), *corpora]

    def read(data: bytes) -> None:
        try:
            TARGETS[target](data, folder)
        except Exception:  # the fuzzer itself does not always keep the input
            (findings / f"raised-{hashlib.sha256(data).hexdigest()[:16]}").write_bytes(data)
            raise

    atheris.Setup(arguments, read)
    atheris.Fuzz()


if __name__ == "__main__":
    main()
