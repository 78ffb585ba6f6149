# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Run code that reads foreign models and logs in an isolated subprocess.

The subprocess has limited time, memory, files and network.
"""

import json
import math
import os
import pickle
import resource
import signal
import subprocess
import sys
import tempfile
from collections.abc import Callable
from enum import Enum
from importlib import import_module
from pathlib import Path
from types import MappingProxyType, ModuleType
from typing import Any

from flight_core import confinement
from flight_core.memory import DATA_LIMIT, limit_memory
from flight_core.notes import note
from flight_core.outcome import FlightEnded
from flight_core.parameters import ParameterError

RESULT = "result"  # name of the file with the result, in the working folder
# If the subprocess raises one of these errors, the caller gets it, too.
ERRORS = MappingProxyType({"ended": FlightEnded, "refused": ParameterError})
# Longest wait in wall time, as a multiple of the limit of processor time. Other work can keep the
# subprocess from the processor for so long.
WAIT = 20.0
FILE_LIMIT = 1 << 30  # largest size of a file that the subprocess writes, bytes

NUMPY = frozenset({"_frombuffer", "_reconstruct", "dtype", "ndarray", "scalar"})
"""Names of functions and classes that a pickled array contains. Other names in a pickle could run
any code that the sender chooses, but these names cannot."""


class IsolatedCallError(RuntimeError):
    """The subprocess crashed or timed out.

    The message is the second half of a sentence, such as "was killed by SIGSEGV".
    """


def call(
    function: Callable[..., Any],
    *arguments: Any,
    timeout: float,
    memory: int = DATA_LIMIT,
    foreign: bool = True,
    records: ModuleType | None = None,
) -> Any:
    """Call function(*arguments) in a fresh process, confined to an empty working folder.

    The subprocess finds the function by module and name. Arguments must fit into JSON. The return
    value consists of plain values, arrays, and named tuples and enums of the module `records`, by
    default the module of the function. If the function raises FlightEnded or ParameterError, so
    does this call.

    The subprocess has `memory` bytes of data, files of at most FILE_LIMIT, and `timeout` seconds of
    processor time. It is also ended after WAIT times as many seconds of wall time. This ends a
    process that waits forever, but leaves a computation enough time on a busy machine. If the
    kernel permits, the subprocess has no network and writes only in its folder. If the kernel does
    not permit this and the data are `foreign`, one warning says so. Raises IsolatedCallError if the
    process crashes, by a segmentation fault or an exception, or does not return in time.
    """
    call_text = json.dumps([timeout, memory, function.__module__, function.__qualname__, arguments])
    with tempfile.TemporaryDirectory() as folder:
        try:
            process = subprocess.run(  # noqa: S603 - this interpreter and this module
                [sys.executable, "-P", "-m", __name__, call_text],
                capture_output=True,
                text=True,
                errors="replace",
                stdin=subprocess.DEVNULL,
                timeout=WAIT * timeout,
                cwd=folder,
                # each thread of OpenBLAS would take memory
                env=os.environ | {"TMPDIR": folder, "OPENBLAS_NUM_THREADS": "1"},
                check=False,
            )
        except subprocess.TimeoutExpired:
            raise IsolatedCallError(f"timed out after {WAIT * timeout:g} s") from None
        if process.returncode == -signal.SIGXCPU:
            raise IsolatedCallError(f"timed out after {timeout:g} s of processor time")
        if process.returncode < 0:
            raise IsolatedCallError(f"was killed by {signal.Signals(-process.returncode).name}")
        file = Path(folder) / RESULT
        if process.returncode or not file.is_file():
            last = (process.stderr.strip() or "no result").splitlines()[-1]
            raise IsolatedCallError(f"exited with status {process.returncode} ({last})")
        with file.open("rb") as stream:
            kind, value, warnings = _Reader(
                stream, records.__name__ if records else function.__module__
            ).load()
    for sentence in warnings if foreign else ():
        note(sentence)
    if kind in ERRORS:
        raise ERRORS[kind](value)
    return value


class _Reader(pickle.Unpickler):
    """Reads plain values, arrays, and named tuples and enums of a module.

    Raises IsolatedCallError if the data name anything else.
    """

    def __init__(self, stream: Any, module: str) -> None:
        super().__init__(stream)
        self._module = module

    def find_class(self, module: str, name: str) -> Any:
        if module.partition(".")[0] == "numpy" and name in NUMPY:
            return super().find_class(module, name)
        if (module, name) == ("builtins", "dict"):
            return dict
        member = (
            getattr(import_module(self._module), name, None) if module == self._module else None
        )
        # A class that the module only imports, such as StrEnum, would make new classes.
        if (
            isinstance(member, type)
            and issubclass(member, (tuple, Enum))
            and member.__module__ == module
        ):
            return member
        raise IsolatedCallError(f"returned {module}.{name}, which is no plain value")


class _Writer(pickle.Pickler):
    """Writes a read-only mapping as a dict, because pickle refuses a MappingProxyType."""

    def reducer_override(self, value: object) -> Any:
        return (dict, (dict(value),)) if isinstance(value, MappingProxyType) else NotImplemented


def main() -> None:
    """Run the subprocess: set the limits, then make the call that comes as JSON.

    The result goes into the file RESULT.
    """
    timeout, memory, module, name, arguments = json.loads(sys.argv[1])
    limit_memory(memory)
    limits = (
        (resource.RLIMIT_CPU, math.ceil(float(timeout))),
        (resource.RLIMIT_FSIZE, FILE_LIMIT),
        (resource.RLIMIT_CORE, 0),
    )
    for limit, most in limits:
        # The hard limit comes from the user, and no process can raise it.
        hard = resource.getrlimit(limit)[1]
        soft = most if hard == resource.RLIM_INFINITY else min(most, hard)
        resource.setrlimit(limit, (soft, hard))
    warnings = confinement.confine(Path.cwd())
    try:
        result = ("value", getattr(import_module(module), name)(*arguments), warnings)
    except FlightEnded as error:
        result = ("ended", str(error), warnings)
    except ParameterError as error:
        result = ("refused", str(error), warnings)
    with Path(RESULT).open("wb") as stream:
        _Writer(stream).dump(result)


if __name__ == "__main__":
    main()
