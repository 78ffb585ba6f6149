# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test that a node ends with its exit status when it is told to, even if the middleware blocks."""

import signal
from collections.abc import Callable
from itertools import cycle
from pathlib import Path

import pytest
from rosgraph_msgs.msg import Clock
from tests.ros.conftest import Process, Start, is_closed
from tests.ros.peer import Peer

from flight_analysis.closed_loop.scenario import Scenario
from flight_core.outcome import STATUS_BAD_INPUT, STATUS_ENDED_EARLY
from flight_core.rates import NANOSECONDS
from flight_ros.messages import instant

# Fast DDS spins likewise: the interpreter is held, so no thread and no handler of Python runs
STUCK = """
import ctypes

from rclpy.node import Node

Node.destroy_node = lambda self: ctypes.PyDLL(None).sleep(600)

from {package}.main import main

main()
"""
LIMIT = 30.0  # s, twenty times what the middleware gets at the end: the host may be busy

StartStuck = Callable[..., Process]


@pytest.fixture
def start_stuck(start: Start, osprey_gust: Scenario, tmp_path: Path) -> StartStuck:
    """Start a node whose middleware never returns from the end of a node."""

    def begin(package: str, *words: str) -> Process:
        (tmp_path / "stuck.py").write_text(STUCK.format(package=package))
        return start("stuck", "--ros-args", "--params-file", str(osprey_gust.path), *words)

    return begin


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_signal_ends_a_node_whose_middleware_never_returns(
    number: int, start_stuck: StartStuck
) -> None:
    node = start_stuck("reference_model").wait_for("ready")
    node.popen.send_signal(number)
    assert node.end(LIMIT) == 0
    assert "destroy_node" in node.output or "stuck.py" in node.output, "what held it is told"


def test_recorder_whose_middleware_never_returns_has_closed_its_log(
    start_stuck: StartStuck, tmp_path: Path
) -> None:
    run = tmp_path / "run"
    recorder = start_stuck("flight_recorder", "-p", f"directory:={run}").wait_for("ready")
    recorder.popen.terminate()
    assert recorder.end(LIMIT) == 0
    assert is_closed(run)


def test_bad_input_keeps_its_status_where_the_middleware_never_returns(
    start_stuck: StartStuck,
) -> None:
    assert start_stuck("aircraft_sim", "-p", "start_time:=1.0").end(LIMIT) == STATUS_BAD_INPUT


def test_node_that_cannot_begin_again_by_the_clock_of_another_simulation_ends(
    start_stuck: StartStuck, peer_node: Peer
) -> None:
    node = start_stuck("reference_model", "-p", "use_sim_time:=true").wait_for("ready")
    publish = peer_node.node.create_publisher(Clock, "/clock", 10).publish
    # again and again: the node may see the publisher after the first ones
    times = cycle([100] * 20 + [5] * 20)
    peer_node.until(
        lambda: publish(instant(next(times) * NANOSECONDS)) or node.has_logged("begins again"),
        "the end of the simulation",
    )
    assert node.end(LIMIT) == STATUS_ENDED_EARLY
