# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Tape -> MCAP bag, without ROS: a flight in one process leaves the same file as one over topics."""

from pathlib import Path
from typing import Any

import numpy as np
from rosbags.typesys import Stores, get_typestore

from flight_core.files import writing
from flight_core.rates import NANOSECONDS
from flight_core.tape import Tape
from flight_log.bag import BagWriter, Enclosed
from flight_log.named_vectors import JOINT_STATE


def write_run(tape: Tape, directory: Path, enclosed: Enclosed) -> Path:
    """Write the tape, and what is enclosed, as a bag into a folder; returns the path of the MCAP file.

    Each sample becomes a message whose log time is its stamp, in order of time. Raises ParameterError where it cannot be
    written.
    """
    store = get_typestore(Stores.ROS2_JAZZY)
    types: dict[str, Any] = store.types
    vector, header, time = types[JOINT_STATE], types["std_msgs/msg/Header"], types["builtin_interfaces/msg/Time"]
    rows = sorted(
        (int(stamp_ns), place, index)
        for place, signal in enumerate(tape.signals.values())
        for index, stamp_ns in enumerate(signal.stamp_ns)
    )
    signals = list(tape.signals.items())
    with writing("", directory, "a folder and a disk that can"), BagWriter(directory) as bag:
        bag.enclose(enclosed, tape.start_ns)
        channels = [bag.add_topic(f"/{name}", JOINT_STATE, "") for name, _ in signals]
        none = np.zeros(0)
        for stamp_ns, place, index in rows:
            _, signal = signals[place]
            stamp = time(sec=stamp_ns // NANOSECONDS, nanosec=stamp_ns % NANOSECONDS)
            message = vector(header(stamp, "in_process"), list(signal.names), signal.values[index], none, none)
            bag.write(channels[place], stamp_ns, stamp_ns, index + 1, bytes(store.serialize_cdr(message, JOINT_STATE)))
    return bag.path
