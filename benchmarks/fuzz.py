# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Coverage-guided fuzzing of what reads input from outside (tests/fuzz/targets.py), with atheris.

python -m benchmarks.fuzz mcap --seconds 60          # mcap, metadata, scenario, airframe, map or message
python -m benchmarks.fuzz mcap --replay FILE ...     # these inputs once each, under the same limits, without atheris

A fuzzer begins with the inputs of the stack's own writers and those of tests/corpus/<target>/. It ends, with a status that is
not 0, at an input that raises, hangs or takes too much memory, and keeps it in runs/fuzz/<target>/: mend, and put it into the
corpus.
"""

import argparse
import resource
import signal
import sys
import tempfile
from pathlib import Path
from types import FrameType

REPOSITORY = Path(__file__).resolve().parents[1]
CORPUS = REPOSITORY / "tests" / "corpus"
FOUND = REPOSITORY / "runs" / "fuzz"

SECONDS_AN_INPUT = 20  # inputs are a few kB; of the processor in a replay, else of a machine that may be busy
MEMORY_MB = 1500  # of the process; the readers' libraries alone take 250
LONGEST = 16 * 1024  # bytes of an input
INSTRUMENTED = ["aircraft_sim", "autopilot_bridge", "flight_analysis", "flight_core", "flight_recorder", "mcap", "rosbags"]


def main() -> None:
    """Fuzz, or replay."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("target", help="mcap, metadata, scenario, airframe, map or message")
    parser.add_argument("--seconds", type=int, default=60, help="how long to fuzz")
    parser.add_argument("--replay", type=Path, nargs="*", help="inputs to try once each, instead of fuzzing")
    parser.add_argument("--keep", action="store_true", help="keep new inputs in runs/fuzz/<target>/inputs, to go on from")
    asked = parser.parse_args()
    if asked.replay is not None:
        replay(asked.target, asked.replay)
    else:
        fuzz(asked.target, asked.seconds, keep=asked.keep)


def replay(target: str, files: list[Path]) -> None:
    """Try inputs once each. Raises what a target raises, MemoryError and TimeoutError."""
    from tests.fuzz.targets import TARGETS  # noqa: PLC0415 - it is instrumented when fuzzing

    def late(number: int, frame: FrameType | None) -> None:
        raise TimeoutError(f"more than {SECONDS_AN_INPUT} s of the processor")

    signal.signal(signal.SIGPROF, late)
    resource.setrlimit(resource.RLIMIT_DATA, (MEMORY_MB << 20, MEMORY_MB << 20))
    with tempfile.TemporaryDirectory(prefix="fuzz") as folder:
        for file in files:
            signal.setitimer(signal.ITIMER_PROF, SECONDS_AN_INPUT)
            try:
                TARGETS[target](file.read_bytes(), Path(folder))
            except Exception:
                print(f"{target}: {file}", file=sys.stderr)
                raise
            signal.setitimer(signal.ITIMER_PROF, 0)
    print(f"{target}: {len(files)} inputs read or refused")


def fuzz(target: str, seconds: int, *, keep: bool) -> None:
    """Fuzz for so long; never returns."""
    import atheris  # noqa: PLC0415 - a replay does without it

    with atheris.instrument_imports(include=INSTRUMENTED):
        from tests.fuzz.targets import SEEDS, TARGETS  # noqa: PLC0415 - as above

    found = FOUND / target
    found.mkdir(parents=True, exist_ok=True)
    inputs = found / "inputs" if keep else Path(tempfile.mkdtemp(prefix=f"fuzz-{target}-"))
    inputs.mkdir(parents=True, exist_ok=True)
    for k, seed in enumerate(SEEDS[target]()):
        (inputs / f"seed-{k}").write_bytes(seed)
    given = [str(inputs), *(str(path) for path in [CORPUS / target] if path.is_dir())]
    folder = Path(tempfile.mkdtemp(prefix="fuzz", dir="/dev/shm" if Path("/dev/shm").is_dir() else None))  # noqa: S108 - for speed
    options = {
        "max_total_time": seconds,
        "timeout": SECONDS_AN_INPUT,
        "rss_limit_mb": MEMORY_MB,
        "max_len": LONGEST,
        "artifact_prefix": f"{found}/",
        "print_final_stats": 1,
    }
    arguments = [sys.argv[0], *(f"-{name}={value}" for name, value in options.items()), *given]
    atheris.Setup(arguments, lambda data: TARGETS[target](data, folder))
    atheris.Fuzz()


if __name__ == "__main__":
    main()
