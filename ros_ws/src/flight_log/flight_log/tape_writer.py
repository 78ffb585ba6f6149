# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Writes a Tape as an MCAP bag, without ROS. A flight in one process and one over topics leave the same kind of log."""

from pathlib import Path
from typing import Any

import numpy as np

from flight_core.files import writing
from flight_core.rates import NANOSECONDS
from flight_core.tape import Tape
from flight_log.bag import BagWriter, LogAttachments
from flight_log.named_vectors import JOINT_STATE, typestore


def write_run(tape: Tape, directory: Path, attachments: LogAttachments) -> Path:
    """Write the tape and the attachments as a bag into a folder; return the path of the MCAP file.

    Each sample becomes a message. Its log time is its stamp. Messages are in the order of time. Raises ParameterError when the
    bag cannot be written.
    """
    store = typestore()
    types: dict[str, Any] = store.types
    vector, header, time = types[JOINT_STATE], types["std_msgs/msg/Header"], types["builtin_interfaces/msg/Time"]
    rows = sorted(
        (int(stamp_ns), column, index)
        for column, signal in enumerate(tape.signals.values())
        for index, stamp_ns in enumerate(signal.stamp_ns)
    )
    signals = list(tape.signals.values())
    with writing("", directory, "a folder and a disk that can"), BagWriter(directory) as bag:
        bag.add_attachments(attachments, tape.start_ns)
        channels = [bag.add_topic(f"/{name}", JOINT_STATE, "") for name in tape.signals]
        empty = np.zeros(0)
        for stamp_ns, column, index in rows:
            signal = signals[column]
            stamp = time(sec=stamp_ns // NANOSECONDS, nanosec=stamp_ns % NANOSECONDS)
            message = vector(header(stamp, "in_process"), list(signal.names), signal.values[index], empty, empty)
            bag.write(channels[column], stamp_ns, stamp_ns, index + 1, bytes(store.serialize_cdr(message, JOINT_STATE)))
    return bag.path
