# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Fly every scenario in lockstep over topics, replay it from its log, and print JSON.

python -m benchmarks.replays
"""

import json
import subprocess
import tempfile
from typing import Any

from benchmarks.processes import RISE_DI

from flight_analysis.closed_loop.scenario_library import scenarios


def _run(*command: str) -> dict[str, Any]:
    """Return the JSON that a command prints; without any, the figure that misses the goal."""
    process = subprocess.run(  # noqa: S603 - ours
        (RISE_DI, *command, "--json"), check=False, capture_output=True, text=True
    )
    return (
        json.loads(process.stdout)
        if process.stdout.startswith("{")
        else {"differing": None, "error": process.stderr.strip()}
    )


def main() -> None:
    """Fly and print the ticks that differ by scenario."""
    results = {}
    for name in scenarios():
        with tempfile.TemporaryDirectory() as runs:
            flight = _run("fly", name, "--lockstep", "--composed", "--runs", str(runs))
            replayed = {"differing": 0} | _run("replay", f"{runs}/latest")
        results[name] = replayed | {"completed": flight.get("outcome", {}).get("status") == 0}
    print(json.dumps(results, indent=1))


if __name__ == "__main__":
    main()
