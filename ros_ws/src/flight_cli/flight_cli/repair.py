# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Rebuild a log whose recorder was killed, as `rise-di report --repair` does.

Every rosbag2 reader accepts the result.
"""

from pathlib import Path

from flight_core.files import display_path
from flight_core.parameters import ParameterError
from flight_core.rates import seconds
from flight_core.text import printable
from flight_log.repair import FileRepair
from flight_log.repair import repair as repair_bag
from flight_log.rosbag2_metadata import METADATA
from flight_log.scan import Faults
from flight_log.tape_reader import read_run


def repair_log(run: Path) -> None:
    """Rebuild the log of a run if its recorder was killed or if it is damaged.

    An intact log stays as it is.
    """
    repairs = repair_bag(run)
    for file in repairs.files:
        if file.faults is not None and file.damaged is not None:
            print(
                f"{printable(file.path.name)} had {_faults_text(file.faults)}: {file.messages} "
                f"messages kept; the damaged file is {printable(file.damaged.name)}"
            )
    if repairs.has_new_metadata:
        print(f"{METADATA} written; {_missing_at_end(run, repairs.files[-1])}")
    elif not any(file.damaged for file in repairs.files) and not repairs.missing:
        print(f"{display_path(run)} is intact: nothing to repair")
    if repairs.missing:
        missing_files = printable(", ".join(repairs.missing))
        print(f"{missing_files}: missing, and nothing here restores it; {METADATA} keeps the name")


def _faults_text(faults: Faults) -> str:
    """Name the faults of a file, as in "a truncated end and 2 damaged parts"."""
    parts = ["a truncated end"] if faults.is_cut else []
    parts += [f"{faults.damaged} damaged parts"] if faults.damaged else []
    return " and ".join(parts)


def _missing_at_end(run: Path, last: FileRepair) -> str:
    """Return a text on the time that is missing at the end of the log.

    The end of the flight comes from the files or, if they lack it, from the scenario's duration.
    """
    if (missing := seconds(last.known_end_ns - last.last_ns)) > 0:
        return f"{missing:.3f} s are missing at its end"
    if last.faults is None:
        return "nothing is missing"
    try:
        tape = read_run(run).tape
    except ParameterError:
        return "it is unknown how much is missing at its end"
    end = max(float(tape.time(name)[-1]) for name in tape.signals)
    if tape.duration is not None:
        return f"the log ends at t = {end:.3f} s of the {tape.duration:g} s of the scenario"
    return f"the log ends at t = {end:.3f} s; it is unknown how much is missing"
