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
from rclpy.impl.implementation_singleton import rclpy_implementation as _rclpy
from rclpy.signals import SignalHandlerOptions
from rclpy.utilities import get_default_context

from flight_ros import transport


def start(*nodes: str, early: bool = True) -> None:
    """Run nodes, each "module:class", as `flight_ros.runtime.run` does; stopped before that, it leaves with status 0 too.

    `early`: join the others before the nodes are loaded.
    """
    gc.disable()  # `run` enables it: a tenth of the way there is collections that find nothing
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, _leave)
    os.environ.setdefault("PYDANTIC_DISABLE_PLUGINS", "__all__")  # else each start looks for some in all that is installed
    herald = _join() if early else None
    run = resolve_name("flight_ros.runtime:run")
    make_nodes = [resolve_name(node) for node in nodes]
    run(*make_nodes, herald=herald)


def _join() -> _rclpy.Node | None:
    """A node without topics, hidden as its name begins with _ (ROS 2 design, topic and service names)."""
    with suppress(Exception):  # `run` meets it again, and has the sentence for it
        transport.prepare()
        rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
        context = get_default_context().handle
        with context:
            return _rclpy.Node(f"_start_{os.getpid()}", "", context, None, False, False)
    return None


def _leave(number: int, frame: FrameType | None) -> None:
    os._exit(0)  # nothing is open yet that would have to be closed
