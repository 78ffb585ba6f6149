# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Print what is proved with any limits of one input, by scenario and input, as CSV.

Each certificate is written to a folder, and checked there by examples/check_certificate.py, which
needs no code of the stack.

    python -m benchmarks.saturation FOLDER osprey_servo osprey_observer jsbsim_c172p
"""

import csv
import subprocess
import sys
import time
from pathlib import Path

from flight_analysis.closed_loop.scenario_library import find_scenario
from flight_analysis.linear_loop.certificate import limit_certificate
from flight_analysis.linear_loop.loop_margins import scenario_loop
from flight_analysis.linear_loop.saturation import SLOWEST, limit_guarantee

# relative deviations of A and B that are tried, the largest first
SIZES = (0.3, 0.25, 0.2, 0.15, 0.11, 0.1, 0.05)
CHECKER = Path(__file__).parents[1] / "examples" / "check_certificate.py"
CLAIMS = {"settles": 0.0, "no periodic motion of up to 126 s": SLOWEST}
HEADINGS = (
    "scenario",
    "input",
    "proved by the checker",
    "for every aircraft within, %",
    "taps",
    "steps",
    "file, kB",
    "processor time to make, s",
    "bounds of the check",
)


def row(folder: Path, name: str, limited: str, claim: str) -> list[str]:
    """Return the figures of a claim for the largest of SIZES for which it is proved.

    They are in the order of HEADINGS, with "none" if it is proved for none of SIZES.
    """
    scenario = find_scenario(name)
    for size in SIZES:
        linear = scenario_loop(scenario, scenario.controller, 1, size)
        begin = time.process_time()
        guarantee = limit_guarantee(linear, limited, 1.0, CLAIMS[claim])
        if guarantee is None:
            continue
        seconds = time.process_time() - begin
        path = folder / f"{name}_{limited}_{claim.split(maxsplit=1)[0]}.json"
        path.write_text(limit_certificate(linear, guarantee, {}))
        command = [sys.executable, str(CHECKER), str(path)]
        done = subprocess.run(  # noqa: S603 - ours
            command, capture_output=True, text=True, check=False
        )
        bounds = done.stdout.split()[2] if done.returncode == 0 else done.stderr.strip()
        steps = sum(len(part["steps"]) for part in guarantee.proof)
        return [
            name,
            limited,
            claim,
            f"{100.0 * size:g}",
            str(len(guarantee.multiplier.taps)),
            str(steps),
            f"{path.stat().st_size / 1e3:.0f}",
            f"{seconds:.0f}",
            bounds,
        ]
    return [name, limited, claim, "none", *[""] * 5]


def main() -> None:
    """Print a row for each scenario, input and claim."""
    folder = Path(sys.argv[1])
    folder.mkdir(parents=True, exist_ok=True)
    writer = csv.writer(sys.stdout, lineterminator="\n")
    writer.writerow(HEADINGS)
    for name in sys.argv[2:]:
        for limited in find_scenario(name).controller.inputs:
            for claim in CLAIMS:
                writer.writerow(row(folder, name, limited, claim))
                sys.stdout.flush()


if __name__ == "__main__":
    main()
