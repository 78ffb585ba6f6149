# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Live commands u_m over topics: one publisher, the ending when it falls silent, and lockstep."""

import math
import time
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from rosgraph_msgs.msg import Clock
from tests.ros.conftest import Start
from tests.ros.peer import OUTPUTS, Peer, peer, stamp_ns

from flight_analysis.closed_loop.scenario import load_scenario, scenario_yaml
from flight_bringup.scenarios import find_scenario
from flight_core.channels import ATTITUDE
from flight_core.units import GRAVITY
from flight_ros.messages import instant, to_message
from flight_ros.topics import LOCKSTEP
from reference_model.reference import Reference

pytestmark = pytest.mark.package("reference_model")

PEER_TOPICS = ("pose", "y_m", "/diagnostics")
SPEED = 25.0  # m/s, the osprey's trim
BANK = math.radians(35.0)
MS = 1_000_000  # ns


def commands(peer_node: Peer, sender: str = "/guidance#1", p: float | None = None) -> None:
    """Publish u_m that rolls to BANK in a coordinated turn, by the last pose."""
    last = peer_node.received["pose"][-1:]
    channels = dict(zip(last[0].name, last[0].position, strict=True)) if last else {"phi": 0.0, "theta": 0.0}
    phi, theta = channels["phi"], channels["theta"]
    turn = GRAVITY * math.tan(phi) / SPEED
    roll = min(1.25 * (BANK - phi), 0.6) if p is None else p
    values = np.array([turn * math.sin(phi), 0.0, roll, turn * math.cos(phi), phi, theta])
    peer_node.publish("u_m", to_message(time.time_ns(), (*OUTPUTS, *ATTITUDE), values, sender))


def bank(peer_node: Peer) -> float:
    """The last phi of pose, rad; 0 before the first pose."""
    last = peer_node.received["pose"][-1:]
    return float(last[0].position[last[0].name.index("phi")]) if last else 0.0


@pytest.fixture
def osprey(tmp_path: Path) -> Path:
    """The osprey with Euler's kinematics in calm air, whose reference levels the wings."""
    varied = find_scenario("osprey_servo").vary(
        aircraft={"kinematics": "euler", "gusts": {}},
        reference_model={"live": {"speed": SPEED, "bounds": {"p": 1.0}}, "pulses": {}, "coordinated_turn": None},
    )
    path = tmp_path / "live.yaml"
    path.write_text(scenario_yaml(varied), encoding="utf-8")
    return path


def test_second_publisher_and_command_beyond_bound_refused(osprey: Path, start: Start, peer_node: Peer) -> None:
    patient = ("-p", "live.max_age:=1000.0")  # a delay of the host does not level the wings, which rolls to the left
    process = start("reference_model.main", "--ros-args", "--params-file", str(osprey), *patient)
    place = OUTPUTS.index("p")

    def rolls() -> list[float]:
        return [message.position[place] for message in peer_node.received["y_m"]]

    # The first publisher whose message arrives is the one that is followed.
    peer_node.until(lambda: max(rolls(), default=0.0) > 0.0, each=lambda: commands(peer_node))

    def three() -> None:
        commands(peer_node)
        commands(peer_node, "/other#2", p=-0.5)
        commands(peer_node, p=1.5)

    def counted(reason: str) -> bool:
        return peer_node.counted(f"refused u_m: {reason}", 5)

    peer_node.until(lambda: counted("sender") and counted("bounds"), each=three)
    process.wait_for("conflicting publisher /other#2 ignored")
    assert min(rolls()) >= 0.0  # no roll to the left


def test_in_lockstep_reference_waits_for_u_m_and_repeats_bytes_of_one_process(osprey: Path, start: Start) -> None:
    reference = Reference(load_scenario(osprey).reference_model)
    expected = [reference.sample(0)]
    for number in range(1, 31):  # 500 Hz; u_m at 50 Hz: at every tenth instant
        if (number - 1) % 10 == 0:
            reference.take((number - 1) * 2 * MS, np.array([0.0, 0.0, 0.02 * number, 0.0]), np.zeros(2))
        expected.append(reference.sample(number))
    with peer(("y_m",), LOCKSTEP) as lockstep_peer:
        clock = lockstep_peer.node.create_publisher(Clock, "/clock", LOCKSTEP)
        u_m = lockstep_peer.node.create_publisher(type(to_message(0, (), np.zeros(0), "")), "u_m", LOCKSTEP)
        start(
            "reference_model.main", "--ros-args", "--params-file", str(osprey), "-p", "lockstep:=true", "-p", "u_m_rate:=50.0"
        )
        received = lockstep_peer.received["y_m"]

        def arrived(count: int) -> bool:
            return len(received) == count

        for number in range(31):
            clock.publish(instant(number * 2 * MS))
        for number in range(0, 30, 10):
            lockstep_peer.until(partial(arrived, number + 1))
            values = np.array([0.0, 0.0, 0.02 * (number + 1), 0.0, 0.0, 0.0])
            u_m.publish(to_message(number * 2 * MS, (*OUTPUTS, *ATTITUDE), values, "/guidance"))
        lockstep_peer.until(partial(arrived, 31))
    assert [stamp_ns(message) for message in received] == [number * 2 * MS for number in range(31)]
    assert np.array([message.position for message in received]).tobytes() == np.array(expected).tobytes()
