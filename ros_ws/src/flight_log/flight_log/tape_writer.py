# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Writes a Tape as an MCAP bag, without ROS. A flight in one process and one over topics leave the same kind of log."""

from pathlib import Path

import numpy as np

from flight_core.files import writing
from flight_core.tape import Tape
from flight_log.bag import BagWriter, LogAttachments
from flight_log.named_vectors import JOINT_STATE, Samples, encoded


def write_run(tape: Tape, directory: Path, attachments: LogAttachments) -> Path:
    """Write the tape and the attachments as a bag into a folder; return the path of the MCAP file.

    Each sample becomes a message. Its log time is its stamp. Messages are in the order of time. Raises ParameterError when the
    bag cannot be written.
    """
    signals = list(tape.signals.values())
    messages = [encoded(Samples(one.names, one.stamp_ns, one.values, "in_process")) for one in signals]
    stamps = np.concatenate([one.stamp_ns for one in signals])
    columns = np.repeat(np.arange(len(signals)), [len(one.stamp_ns) for one in signals])
    indexes = np.concatenate([np.arange(len(one.stamp_ns)) for one in signals])
    order = np.argsort(stamps, kind="stable")
    rows = zip(*(values[order].tolist() for values in (stamps, columns, indexes)), strict=True)
    with writing("", directory, "a folder and a disk that can"), BagWriter(directory) as bag:
        bag.add_attachments(attachments, tape.start_ns)
        channels = [bag.add_topic(f"/{name}", JOINT_STATE, "") for name in tape.signals]
        for stamp_ns, column, index in rows:
            bag.write(channels[column], stamp_ns, stamp_ns, index + 1, messages[column][index].tobytes())
    return bag.path
