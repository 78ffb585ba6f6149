# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Process isolation: foreign code runs in a subprocess with a time limit, since the code may crash or hang."""

import json
import math
import resource
import signal
import subprocess
import sys
import tempfile
from collections.abc import Callable
from importlib import import_module
from typing import Any

from flight_core.outcome import FlightEnded

RESULT = "result: "  # prefix of the line that holds the result, whatever else the code prints
WAIT = 20.0  # times the processor time is waited for: so long may other work keep the processor from the subprocess


class IsolatedCallError(RuntimeError):
    """The subprocess crashed or timed out. The message is the rest of a sentence: "was killed by SIGSEGV"."""


def call(function: Callable[..., Any], *arguments: Any, timeout: float) -> Any:
    """Return value of function(*arguments) in a fresh process with an empty working folder, decoded from JSON.

    The subprocess finds the function by module and name. Arguments and return value must fit JSON. A FlightEnded of the
    function is raised here too. Raises IsolatedCallError where the process crashes (a segmentation fault, an exception) or
    returns nothing within `timeout` seconds of processor time, or WAIT times as many of wall time: an endless computation is
    found on a busy machine too, and a finite computation gets enough time.
    """
    command = [
        sys.executable,
        "-P",
        "-m",
        __name__,
        str(timeout),
        function.__module__,
        function.__qualname__,
        json.dumps(arguments),
    ]
    with tempfile.TemporaryDirectory() as folder:
        try:
            process = subprocess.run(  # noqa: S603 - this interpreter and this module
                command,
                capture_output=True,
                text=True,
                errors="replace",
                stdin=subprocess.DEVNULL,
                timeout=WAIT * timeout,
                cwd=folder,
                check=False,
            )
        except subprocess.TimeoutExpired:
            raise IsolatedCallError(f"timed out after {WAIT * timeout:g} s") from None
    if process.returncode == -signal.SIGXCPU:
        raise IsolatedCallError(f"timed out after {timeout:g} s of processor time")
    if process.returncode < 0:
        raise IsolatedCallError(f"was killed by {signal.Signals(-process.returncode).name}")
    results = [line.removeprefix(RESULT) for line in process.stdout.splitlines() if line.startswith(RESULT)]
    if process.returncode or not results:
        last = (process.stderr.strip() or "no result").splitlines()[-1]
        raise IsolatedCallError(f"exited with status {process.returncode} ({last})")
    result = json.loads(results[-1])
    if "ended" in result:
        raise FlightEnded(result["ended"])
    return result["value"]


def main() -> None:
    """Entry point of the subprocess: processor time in s, module, function, arguments as JSON -> a line of JSON."""
    timeout, module, name, arguments = sys.argv[1:]
    hard = resource.getrlimit(resource.RLIMIT_CPU)[1]  # that of the user, which no process may raise
    soft = math.ceil(float(timeout))
    resource.setrlimit(resource.RLIMIT_CPU, (soft if hard == resource.RLIM_INFINITY else min(soft, hard), hard))
    result: dict[str, Any]
    try:
        result = {"value": getattr(import_module(module), name)(*json.loads(arguments))}
    except FlightEnded as error:
        result = {"ended": str(error)}
    print(f"\n{RESULT}{json.dumps(result)}")


if __name__ == "__main__":
    main()
