# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Foreign code that may crash or hang, tried in a process of its own first."""

import json
import signal
import subprocess
import sys
import tempfile
from collections.abc import Callable
from importlib import import_module
from typing import Any

from flight_core.outcome import FlightEnded

ANSWER = "answer: "  # begins the line that the answer stands on, whatever else the code prints


class Crashed(RuntimeError):  # noqa: N818 - the message is the rest of a sentence: "died of SIGSEGV"
    """The process died, or did not answer in time."""


def call(function: Callable[..., Any], *arguments: Any, timeout: float) -> Any:
    """function(*arguments) in a fresh process with an empty working folder; what it returns, as JSON has it.

    The function is found by its module and name; arguments are what JSON holds. Its own FlightEnded is raised here too.
    Raises Crashed where the process dies (a segmentation fault, an exception) or gives no answer within `timeout` seconds.
    """
    command = [sys.executable, "-m", "aircraft_sim.guarded", function.__module__, function.__qualname__, json.dumps(arguments)]
    with tempfile.TemporaryDirectory() as folder:
        try:
            done = subprocess.run(  # noqa: S603 - this interpreter and this module
                command,
                capture_output=True,
                text=True,
                errors="replace",
                stdin=subprocess.DEVNULL,
                timeout=timeout,
                cwd=folder,
                check=False,
            )
        except subprocess.TimeoutExpired:
            raise Crashed(f"gave no answer within {timeout:g} s") from None
    if done.returncode < 0:
        raise Crashed(f"died of {signal.Signals(-done.returncode).name}")
    answers = [line.removeprefix(ANSWER) for line in done.stdout.splitlines() if line.startswith(ANSWER)]
    if done.returncode or not answers:
        last = (done.stderr.strip() or "no answer").splitlines()[-1]
        raise Crashed(f"ended with status {done.returncode} ({last})")
    answer = json.loads(answers[-1])
    if "ended" in answer:
        raise FlightEnded(answer["ended"])
    return answer["value"]


def main() -> None:
    """What runs in the process: module, function, arguments as JSON -> a line of JSON."""
    module, name, arguments = sys.argv[1:]
    answer: dict[str, Any]
    try:
        answer = {"value": getattr(import_module(module), name)(*json.loads(arguments))}
    except FlightEnded as error:
        answer = {"ended": str(error)}
    print(f"\n{ANSWER}{json.dumps(answer)}")


if __name__ == "__main__":
    main()
