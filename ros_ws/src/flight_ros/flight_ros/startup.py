# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""The start of a node's process: it joins the others first and loads what it flies with then.

The others need a fifth of a second to find a process, and it needs as long to load NumPy and pydantic: both at a time, so that
a node that was killed is back the sooner. Hence this module loads rclpy and little else.
"""

import gc
import os
import signal
from contextlib import suppress
from pkgutil import resolve_name
from types import FrameType

import rclpy
from rclpy.signals import SignalHandlerOptions
from rclpy.utilities import get_default_context

from flight_ros import transport
from flight_ros.rclpy_private import Participant, create_participant


def start_nodes(*nodes: str, early: bool = True) -> None:
    """Run nodes, each "module:class", as `flight_ros.event_loop.run` does; stopped before that, it leaves with status 0 too.

    `early`: join the others before the nodes are loaded.
    """
    gc.disable()  # `run` enables it: a tenth of the way there is collections that find nothing
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, _leave)
    os.environ.setdefault("PYDANTIC_DISABLE_PLUGINS", "__all__")  # else each start looks for some in all that is installed
    early_participant = _join() if early else None
    run = resolve_name("flight_ros.event_loop:run")
    make_nodes = [resolve_name(node) for node in nodes]
    run(*make_nodes, early_participant=early_participant)


def _join() -> Participant | None:
    """A node without topics, hidden as its name begins with _ (ROS 2 design, topic and service names)."""
    with suppress(Exception):  # `run` meets it again, and has the sentence for it
        transport.prepare()
        rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
        return create_participant(f"_start_{os.getpid()}", get_default_context())
    return None


def _leave(number: int, frame: FrameType | None) -> None:
    os._exit(0)  # nothing is open yet that would have to be closed
