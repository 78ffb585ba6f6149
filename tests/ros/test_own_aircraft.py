# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""The aircraft of docs/ros.md, a node of rclpy alone, flies as it stands under the reference model and the controller."""

import re
from pathlib import Path

import pytest
from sensor_msgs.msg import JointState
from tests.conftest import REPOSITORY
from tests.ros.conftest import Start
from tests.ros.peer import Peer

pytestmark = pytest.mark.package("flight_bringup")

PEER_TOPICS = ("y", "y_m")


def pitch_rate(message: JointState | None) -> float:
    """Q of a named vector, rad/s; 0 before the first."""
    return 0.0 if message is None else float(message.position[message.name.index("q")])


def test_aircraft_of_page_tracks_reference_model(start: Start, start_node: Start, peer_node: Peer, tmp_path: Path) -> None:
    (program,) = re.findall(
        r"^```python\n(.*?)^```$", (REPOSITORY / "docs" / "ros.md").read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL
    )
    (tmp_path / "my_aircraft.py").write_text(program, encoding="utf-8")
    start("my_aircraft")
    start_node("rise_di_controller").wait_for("ready")
    start_node("reference_model")
    # Half of the first command of the scenario, then most of that by the aircraft: without control its q would stay 0.
    peer_node.until(lambda: pitch_rate(peer_node.last("y_m")) > 0.05, "a command")
    peer_node.until(lambda: pitch_rate(peer_node.last("y")) > 0.04, "the aircraft follows it")
