# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Start of a node's process: an early DDS participant starts discovery while the modules of the node are imported.

Discovery takes 0.2 s, and the import of NumPy and of a node nearly as long. Both run at the same time, so that a node restarts
sooner. For this reason this module imports rclpy and little else.
"""

import gc
import os
from contextlib import suppress
from pkgutil import resolve_name
from types import FrameType

import rclpy
from rclpy.signals import SignalHandlerOptions
from rclpy.utilities import get_default_context

from flight_core.scheduling import lower_real_time_priority
from flight_core.signals import handle_shutdown
from flight_ros import transport
from flight_ros.rclpy_private import Participant, create_participant


def start_nodes(*nodes: str, early: bool = True, lower_by: int = 0) -> None:
    """Run nodes, each "module:class", by `flight_ros.event_loop.run`. A signal during the start ends with exit status 0 too.

    `early`: create a DDS participant before the imports. `lower_by`: levels of real-time priority, more for
    nodes of a longer period.
    """
    lower_real_time_priority(lower_by)
    gc.disable()  # `run` enables it; collections during the imports find nothing and take a tenth of the time
    handle_shutdown(_exit)
    early_participant = _create_early_participant() if early else None
    run = resolve_name("flight_ros.event_loop:run")
    make_nodes = [resolve_name(node) for node in nodes]
    run(*make_nodes, early_participant=early_participant)


def _create_early_participant() -> Participant | None:
    """A node without topics. It is hidden, as its name begins with _ (ROS 2 design, topic and service names)."""
    with suppress(Exception):  # the same exception occurs in `run`, which reports it
        transport.prepare()
        rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
        return create_participant(f"_start_{os.getpid()}", get_default_context())
    return None


def _exit(number: int, frame: FrameType | None) -> None:
    os._exit(0)  # there is nothing to close yet
