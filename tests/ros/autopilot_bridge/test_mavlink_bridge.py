# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""The bridge over MAVLink: the map ardupilot_mavlink against a simulated autopilot on UDP."""

import math
import socket
from pathlib import Path

import pytest
import yaml
from std_srvs.srv import SetBool
from tests.conftest import REPOSITORY
from tests.maps import MAP_FILES
from tests.ros.conftest import Start
from tests.ros.peer import peer

SCENARIO = REPOSITORY / "tests" / "ros" / "slow_autopilot.yaml"
ELEVATOR = 0.02  # rad, within a tenth of its limit, as an engagement requires
PULSE = round(1500 + ELEVATOR / (math.radians(30.0) / 500.0))  # us: 30 deg are 500 us in the map
TRIM = "channels 1500 1500 1500 1500"  # us, the transmitter's


def test_engaged_bridge_overrides_sticks_and_gives_them_back_by_request_and_at_a_lost_link(
    start: Start, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    content = yaml.safe_load(MAP_FILES["ardupilot_mavlink"].read_text())
    content["link"]["url"] = f"udpin:127.0.0.1:{port}"
    for row in (content["silence"], *content["conditions"].values()):
        # s: a release by the age of u, or by a condition, would hide that by the link
        row["max_age"] = 5.0
    for row in (*content["outputs"].values(), *content["pose"].values()):
        row["max_age"] = 2.0  # s: a host pauses for up to a second
    (tmp_path / "map.yaml").write_text(yaml.safe_dump(content, sort_keys=False))
    monkeypatch.setenv("PYTHONPATH", str(REPOSITORY))
    autopilot = start("tests.ros.mavlink_autopilot", str(SCENARIO), str(port)).wait_for("ready")
    with peer(topics=("y", "u", "bridge/would_send", "mavlink/ATTITUDE")) as node:
        bridge = start(
            "autopilot_bridge.main",
            "--ros-args",
            "-p",
            f"map:={tmp_path / 'map.yaml'}",
            "-p",
            "dry_run:=false",
        ).wait_for("ready")

        def command() -> None:
            node.command(ELEVATOR, 0.0, 0.0, 0.0)

        def engage(on: bool) -> str:
            return str(
                node.call(SetBool, "bridge/engage", SetBool.Request(data=on), command).message
            )

        node.until(lambda: engage(on=True) == "", "an engagement", each=command)
        node.until(
            lambda: autopilot.has_logged(f"channels 1500 {PULSE} 1500 1500"),
            "the overridden sticks",
            each=command,
        )
        engage(on=False)
        node.until(
            lambda: autopilot.lines[-1] == TRIM, "the sticks of the transmitter", each=command
        )
        (y, attitude) = (node.last(topic) for topic in ("y", "mavlink/ATTITUDE"))
        assert list(y.name) == ["q", "V", "p", "r"]
        assert list(attitude.name) == [
            "time_boot_ms",
            "roll",
            "pitch",
            "yaw",
            "rollspeed",
            "pitchspeed",
            "yawspeed",
        ]

        node.until(lambda: engage(on=True) == "", "an engagement", each=command)
        autopilot.popen.kill()
        # The message that came first before the loss is the first that is too old.
        node.until(
            lambda: bridge.has_logged("ENGAGED -> RELEASE: ", " s old (mavlink/"),
            "the release at the lost link",
            each=command,
        )
