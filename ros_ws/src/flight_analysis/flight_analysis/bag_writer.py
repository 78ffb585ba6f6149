# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Tape -> MCAP bag, without ROS: a flight in one process leaves the same file as one over topics."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.typesys import Stores, get_typestore

from flight_analysis.bag_reader import JOINT_STATE
from flight_core.rates import NANOSECONDS
from flight_core.tape import Tape
from flight_recorder.bag import OTHER, SCENARIO, BagWriter


def write_run(tape: Tape, directory: Path, scenario_file: Path, attached: Sequence[Path] = ()) -> Path:
    """Write the tape, its scenario and what goes with it as a bag into a folder; returns the path of the MCAP file.

    Each sample becomes a message whose log time is its stamp, in order of time.
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
    with BagWriter(directory) as bag:
        bag.attach(scenario_file.name, SCENARIO, scenario_file.read_bytes(), tape.start_ns)
        for path in attached:
            bag.attach(path.name, OTHER, path.read_bytes(), tape.start_ns)
        for name, _ in signals:
            bag.add_topic(f"/{name}", JOINT_STATE, "")
        none = np.zeros(0)
        for stamp_ns, place, index in rows:
            name, signal = signals[place]
            stamp = time(sec=stamp_ns // NANOSECONDS, nanosec=stamp_ns % NANOSECONDS)
            message = vector(header(stamp, "in_process"), list(signal.names), signal.values[index], none, none)
            bag.write(f"/{name}", stamp_ns, stamp_ns, index + 1, bytes(store.serialize_cdr(message, JOINT_STATE)))
    return bag.path
