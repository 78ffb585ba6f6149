# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Write the bag of a flight, with its folder and attachments, and watch the disk space.

A bag is the log of a flight as ROS 2 stores it.
"""

import time
from collections.abc import Callable, Mapping
from datetime import UTC, datetime
from itertools import count
from pathlib import Path

from flight_core.files import is_file, link_latest, read_file, writing
from flight_core.outcome import UNKNOWN, Outcome, Refusal, joined, parsed_outcome
from flight_core.parameters import ParameterError, require
from flight_log.bag import (
    OUTCOME,
    OUTCOME_FILE,
    SIMULATED_TIME,
    BagWriter,
    LogAttachments,
)
from flight_log.disk import free_bytes
from flight_recorder.params import RecorderConfig

MEGABYTE = 1e6

Records = Mapping[str, Mapping[str, str]]
"""Named sets of strings, as MCAP stores them."""


class FlightBag:
    """The bag of a flight. It ends on an error or a full disk, and the node goes on without it.

    `clock` is the topic of simulated time, if there is one. `last_records` returns the records that
    are written at the end of the bag. `report` takes the line that says why the bag ended early.
    """

    def __init__(
        self,
        parameters: RecorderConfig,
        *,
        clock: str | None,
        last_records: Callable[[], Records],
        report: Callable[[str], object],
    ) -> None:
        """Open the bag and write the attachments. Raises ParameterError if this fails."""
        self.end_reason: Refusal | None = None  # why recording ended
        self._parameters = parameters
        self._clock = clock
        self._last_records = last_records
        self._report = report
        attachments = LogAttachments(
            _file(parameters.scenario_file, "scenario_file"),
            tuple(path for name in parameters.attach if (path := _file(name, "attach"))),
            _file(parameters.metadata_file, "metadata_file"),
        )
        default = f"runs/{datetime.now(UTC):%Y%m%dT%H%M%SZ}-recording"
        directory = Path(parameters.directory or default).absolute()
        with writing("recorder.directory", directory):
            directory.mkdir(parents=True, exist_ok=True)
            if shortage := self._space_shortage(directory):
                raise ParameterError(f"recorder.min_free: {shortage}")
            self._writer = BagWriter(self._free_folder(directory))
            self._writer.add_attachments(attachments, time.time_ns())
            if clock is not None:
                self._writer.add_metadata(SIMULATED_TIME, {"topic": clock})
            self._writer.flush()
            if not parameters.directory:
                link_latest(directory)
        self.path = self._writer.path
        self.channels = self._writer.channels
        self.write = self._writer.write
        self.add_topic = self._writer.add_topic

    def _free_folder(self, directory: Path) -> Path:
        """Return a folder for the bag: `directory`, or if it is in use, a new folder beside it.

        `directory` is in use if it already has the log of a simulation that has ended.
        """
        folders = (directory.with_name(f"{directory.name}-{number}") for number in count(2))
        has_log = self._clock is not None and any(directory.glob("*.mcap"))
        return next(folder for folder in folders if not folder.exists()) if has_log else directory

    def _space_shortage(self, directory: Path) -> Refusal | None:
        """Return a refusal if the disk of a folder has too little free space, else None."""
        free = free_bytes(directory) / MEGABYTE
        least = self._parameters.min_free
        if free >= least:
            return None
        return Refusal(f"found {free:.1f} MB free in {directory}, expected at least {least:g} MB")

    def write_or_end(self, write: Callable[[], None]) -> None:
        """Call `write` if the bag has not ended, and end the bag on an error or a full disk."""
        if self.end_reason is not None:
            return
        try:
            write()
        except OSError as error:
            self._end(f"{self.path} cannot be written ({error.strerror})")
        else:
            if self._writer.is_full:
                self._end(f"no space left for {self.path}")

    def flush(self) -> None:
        """Write the received messages to the disk, or end the bag if this fails."""
        self.write_or_end(self._writer.flush)

    def check_disk(self) -> None:
        """End the bag if the disk has too little free space."""
        self.write_or_end(self._require_space)

    def _require_space(self) -> None:
        if shortage := self._space_shortage(self._writer.directory):
            self._end(f"min_free: {shortage}")

    def _end(self, reason: str) -> None:
        if self.end_reason is None:
            end_reason = Refusal(f"recording ended: {reason}")
            self.end_reason = joined((end_reason, self._finish()))
            self._report(str(self.end_reason))

    def close(self) -> None:
        """Finish the bag if it has not ended yet."""
        if self.end_reason is None:
            self.end_reason = Refusal("recording ended")
            if fault := self._finish():
                self._report(f"{self.end_reason}; {fault}")

    def message_count(self) -> int:
        """Return the number of messages in the bag."""
        return self._writer.contents().messages

    def _finish(self) -> Refusal | None:
        """Finish the bag, or return why it cannot be finished."""
        try:
            for name, values in self._last_records().items():
                self._writer.add_metadata(name, values)
            if (outcome := self._told_outcome()) is not UNKNOWN:
                self._writer.add_metadata(OUTCOME, outcome.record())
            self._writer.close()
        except OSError as error:
            name = self.path.name
            return Refusal(f"{name} is truncated: it cannot be written ({error.strerror})")
        return None

    def _told_outcome(self) -> Outcome:
        """Return the outcome that the flight has left for its log, or UNKNOWN if there is none."""
        file = self._writer.directory / OUTCOME_FILE
        if not is_file(file):
            return UNKNOWN
        try:
            text = read_file(file, OUTCOME_FILE, "an outcome").decode(errors="replace")
            file.unlink()
        except (OSError, ParameterError):
            return UNKNOWN
        return parsed_outcome(text)


def _file(name: str, key: str) -> Path | None:
    require(not name or is_file(Path(name)), f"recorder.{key}", f"{name!r}", "the path of a file")
    return Path(name) if name else None
