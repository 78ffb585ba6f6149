# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Read the logs that autopilots write: DataFlash of ArduPilot, tlogs of MAVLink, ULogs of PX4.

Sources: ArduPilot, libraries/AP_Logger/LogStructure.h and ArduPlane/Log.cpp; MAVLink, common.xml;
PX4 guide, ULog file format, and PX4's msg/*.msg. pymavlink and pyulog decode the files.
"""

import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from io import StringIO
from pathlib import Path

from flight_core import isolated
from flight_core.parameters import ParameterError, require
from flight_log import vehicle_tables
from flight_log.file_kinds import FileKind, file_kind
from flight_log.vehicle_readers import READERS
from flight_log.vehicle_tables import ANY, Choice, VehicleKind, VehicleLog

EXPECTED = "a DataFlash log (.bin, .log), a tlog or a ULog"


def read_vehicle_log(path: Path, choice: Choice = ANY) -> VehicleLog:
    """Read the log of an autopilot.

    Raises ParameterError if the file is no such log, if no message can be decoded, or if it is
    unclear which of two systems or sensors flew.
    """
    require(path.is_file(), str(path), "no such file", EXPECTED)
    kind = file_kind(path)
    if kind not in READERS:
        raise ParameterError(f"{path}: found {kind.value}, expected {EXPECTED}")
    only = "none: the log is of one autopilot"
    require(choice.system is None or kind is FileKind.TLOG, "--system", choice.system, only)
    try:
        with _silent():
            log = READERS[kind](path, kind, choice)
    except ParameterError:
        raise
    except Exception as error:
        # pymavlink raises a bare Exception for a damaged format.
        reason = str(error) or type(error).__name__
        raise ParameterError(
            f"{path}: found {kind.value} that cannot be decoded ({reason}), expected {EXPECTED}"
        ) from None
    found = f"{kind.value} without a message of y or u"
    require(bool(log.tables), str(path), found, "the log of a flight")
    return log


@contextmanager
def _silent() -> Iterator[None]:
    """Discard what pymavlink and pyulog print about a damaged file, even from C.

    They print a line for each byte that belongs to no message.
    """
    with (
        redirect_stdout(StringIO()) as text,
        redirect_stderr(text),
        Path(os.devnull).open("wb") as null,
    ):
        try:
            stderr = os.dup(2)
        except OSError:
            # Standard error is closed.
            yield
            return
        os.dup2(null.fileno(), 2)
        try:
            yield
        finally:
            os.dup2(stderr, 2)
            os.close(stderr)


LIMITS = (5.0, 6.0)
"""Limit of the processor time of the decoding, in two parts: a time in s, and a further time in s
for each megabyte of the log. pymavlink takes 1.2 s for a megabyte of DataFlash here."""

MEMORY = (1 << 30, 100)
"""Limit of the memory of the decoding, in two parts: a number of bytes, and further bytes for each
byte of the log. pymavlink takes some 35."""


def read_foreign_log(path: Path, choice: Choice = ANY) -> VehicleLog:
    """Read a log by `read_vehicle_log` in an isolated process, as a guard against hostile logs.

    A log of a few bytes may claim billions of values. Raises ParameterError as `read_vehicle_log`
    does, and if the decoding exceeds LIMITS or MEMORY.
    """
    require(path.is_file(), str(path), "no such file", EXPECTED)
    size = path.stat().st_size
    timeout = LIMITS[0] + LIMITS[1] * size / 1e6
    memory = MEMORY[0] + MEMORY[1] * size
    plain = choice._replace(instances=dict(choice.instances))
    try:
        return isolated.call(
            _read_absolute,
            str(path.absolute()),
            plain,
            timeout=timeout,
            memory=memory,
            records=vehicle_tables,
        )
    except isolated.IsolatedCallError as error:
        raise ParameterError(
            f"{path}: found {file_kind(path).value} whose decoding {error}, expected {EXPECTED}"
        ) from None


def _read_absolute(path: str, choice: tuple[int | None, Mapping[str, int], str]) -> VehicleLog:
    system, instances, vehicle = choice
    return read_vehicle_log(Path(path), Choice(system, instances, VehicleKind(vehicle)))
