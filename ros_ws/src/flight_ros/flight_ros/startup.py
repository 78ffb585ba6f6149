# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Start the process of a node, with a DDS participant that starts discovery early.

Meanwhile the modules of the node are imported. Discovery takes 0.2 s, and the import of NumPy and
of a node takes nearly as long. Both run at the same time, so that a node restarts sooner. For this
reason this module imports little except rclpy.
"""

import gc
import os
import sys
from contextlib import suppress
from pkgutil import resolve_name
from types import FrameType
from typing import TYPE_CHECKING

from flight_core.environment import require_ros_environment
from flight_core.memory import limit_memory
from flight_core.scheduling import compute_in_one_thread, lower_real_time_priority
from flight_core.signals import handle_shutdown
from flight_ros import transport

if TYPE_CHECKING:
    from flight_ros.rclpy_private import Participant

USAGE = """usage: {program} --ros-args --params-file SCENARIO.yaml [-p NAME:=VALUE ...] [-r __ns:=/NAMESPACE] [-r NAME:=TOPIC]
       {program} --print-parameters > MINE.yaml

A node of a flight. --print-parameters prints the keys of the node with their meanings, to be filled in. SCENARIO.yaml has a section for each node, by its name; -p replaces a parameter of it. The parameters are in
docs/reference/parameters.md, the topics in docs/topics.md. `rise-di fly` starts all nodes of a scenario."""  # noqa: E501 - a text as it is written

PRINT_PARAMETERS = "--print-parameters"

BAD_ENVIRONMENT = 2  # exit status, the same as for invalid parameters


def start_nodes(
    *nodes: str, early: bool = True, lower_by: int = 0, parameters: tuple[str, str] | None = None
) -> None:
    """Run nodes, each "module:class", by `flight_ros.event_loop.run`.

    `--print-parameters` prints a parameter file for the user to fill in. `parameters` holds the
    name of the node and the "module:class" of its parameter set.

    A signal during the start also ends the process with exit status 0. With `early`, a DDS
    participant is created before the imports. The real-time priority is lowered by `lower_by`
    levels. A node with a longer period has a larger `lower_by`.
    """
    if {"--help", "-h"} & {*sys.argv[1:]}:
        print(USAGE.format(program=os.path.basename(sys.argv[0])))  # noqa: PTH119 - pathlib takes as long to import as the rest
        return
    if PRINT_PARAMETERS in sys.argv and parameters is not None:
        name, schema = parameters
        template = resolve_name("flight_core.parameter_template:parameter_template")
        print(template(name, resolve_name(schema)), end="")
        return
    try:
        require_ros_environment()
    except ValueError as error:  # a ParameterError, whose module is loaded later
        print(f"error: {error}", file=sys.stderr)
        sys.exit(BAD_ENVIRONMENT)
    compute_in_one_thread()
    lower_real_time_priority(lower_by)
    limit_memory()
    # `run` enables it again; collections during the imports find nothing, and take a tenth of the
    # time
    gc.disable()
    handle_shutdown(_exit)
    early_participant = _create_early_participant() if early else None
    run = resolve_name("flight_ros.event_loop:run")
    make_nodes = [resolve_name(node) for node in nodes]
    run(*make_nodes, early_participant=early_participant)


def _create_early_participant() -> "Participant | None":
    """Create a node without topics.

    The node is hidden, because its name begins with _ (ROS 2 design, topic and service names).
    """
    import rclpy  # noqa: PLC0415 - on a full /dev/shm the import itself is a bus error
    from rclpy.signals import SignalHandlerOptions  # noqa: PLC0415
    from rclpy.utilities import get_default_context  # noqa: PLC0415

    from flight_ros.rclpy_private import create_participant  # noqa: PLC0415

    with suppress(Exception):  # the same exception occurs in `run`, which reports it
        transport.prepare()
        rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
        return create_participant(f"_start_{os.getpid()}", get_default_context())
    return None


def _exit(number: int, frame: FrameType | None) -> None:
    os._exit(0)  # there is nothing to close yet
