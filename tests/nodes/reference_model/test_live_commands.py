# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test live commands u_m of the reference model's node.

The tests cover one publisher, what happens when it falls silent, and lockstep.
"""

from pathlib import Path

import numpy as np
import pytest
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import JointState
from tests.nodes.world import OUTPUTS, diagnostics, world_of

from flight_analysis.closed_loop.scenario import load_scenario, scenario_yaml
from flight_analysis.closed_loop.scenario_library import find_scenario
from flight_core.channels import ATTITUDE
from flight_ros.messages import Encoder, instant
from reference_model import model
from reference_model.node import ReferenceModelNode
from reference_model.reference import Reference

NAMES = (*OUTPUTS, *ATTITUDE)
MS = 1_000_000  # ns


@pytest.fixture
def osprey(tmp_path: Path) -> Path:
    """Return the osprey with Euler's kinematics in calm air, whose reference levels the wings."""
    varied = find_scenario("osprey_servo").vary(
        aircraft={"kinematics": "euler", "gusts": {}},
        reference_model={
            "live": {"speed": 25.0, "bounds": {"p": 1.0}},
            "pulses": {},
            "coordinated_turn": None,
        },
    )
    path = tmp_path / "live.yaml"
    path.write_text(scenario_yaml(varied))
    return path


def command(p: float) -> dict[str, float]:
    return dict.fromkeys(NAMES, 0.0) | {"p": p}


def test_second_publisher_and_command_beyond_bound_refused_and_silence_ends_in_zero_commands(
    osprey: Path,
) -> None:
    with world_of("--params-file", str(osprey)) as world:
        node = world.start(ReferenceModelNode)
        world.run(0.5, lambda: world.send("/u_m", command(0.3), "/guidance#1"))
        assert "[INFO] commands from /u_m replace the profile" in node.log.lines

        def three() -> None:
            world.send("/u_m", command(0.3), "/guidance#1", age=0.001)
            world.send("/u_m", command(-0.5), "/other#2")
            world.send("/u_m", command(1.5), "/guidance#1")

        world.run(1.5, three)
        _, figures = diagnostics(world, "/reference_model")
        assert int(figures["refused u_m: sender"]) > 100
        assert int(figures["refused u_m: bounds"]) > 100
        assert any("conflicting publisher /other#2 ignored" in line for line in node.log.lines)
        assert min(y_m.channels["p"] for y_m in world.vectors("/y_m")) >= 0.0  # no roll to the left
        world.run(10.0)
        assert (
            "[ERROR] /u_m timed out: wings are levelled, then all commands are zero"
            in node.log.lines
        )
        assert diagnostics(world, "/reference_model")[0] == "ending"
        assert max(abs(value) for value in world.last("/y_m").values()) < 1e-3


def test_in_lockstep_reference_waits_for_u_m_and_repeats_bytes_of_one_process(osprey: Path) -> None:
    reference = Reference(load_scenario(osprey).reference_model)
    expected = [reference.sample(0)]
    for number in range(1, 31):  # 500 Hz; u_m at 50 Hz: at every tenth instant
        if (number - 1) % 10 == 0:
            reference.take(
                (number - 1) * 2 * MS, np.array([0.0, 0.0, 0.02 * number, 0.0]), np.zeros(2)
            )
        expected.append(reference.sample(number))
    with world_of(
        "--params-file", str(osprey), "-p", "lockstep:=true", "-p", "u_m_rate:=50.0"
    ) as world:
        node = world.make(ReferenceModelNode)
        clock = world.publisher(Clock, "/clock")
        u_m = world.publisher(JointState, "/u_m")
        for number in range(31):
            clock.publish(instant(number * 2 * MS))
        for number in range(0, 30, 10):
            while node.advance():
                pass
            assert len(world.sent["/y_m"]) == number + 1
            assert node.awaited_topic() == "/u_m"
            values = np.array([*command(0.02 * (number + 1)).values()])
            u_m.publish(Encoder(NAMES, "/guidance").encode(number * 2 * MS, values))
        while node.advance():
            pass
        received = world.vectors("/y_m")
    assert [sample.stamp_ns for sample in received] == [number * 2 * MS for number in range(31)]
    assert (
        np.array([[*sample.channels.values()] for sample in received]).tobytes()
        == np.array(expected).tobytes()
    )


def test_step_that_fails_leaves_the_last_y_m_and_the_node_goes_on(
    osprey: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with world_of("--params-file", str(osprey)) as world:
        node = world.start(ReferenceModelNode)
        world.run(0.5, lambda: world.send("/u_m", command(0.3), "/guidance#1"))
        before = world.vectors("/y_m")
        with monkeypatch.context() as patch:
            patch.setattr(model, "step", lambda x_m, u_m, matrices: np.full_like(x_m, np.nan))
            world.run(0.1, lambda: world.send("/u_m", command(0.3), "/guidance#1"))
        rows = world.vectors("/y_m")[len(before) :]
        assert len(rows) >= 45  # of 50 at 500 Hz
        assert all(sample.channels == before[-1].channels for sample in rows[1:-1])
        world.run(1.1, lambda: world.send("/u_m", command(0.3), "/guidance#1"))
        assert world.last("/y_m")["p"] > before[-1].channels["p"]
        lines = [line for line in node.log.lines if "a step of the reference model failed" in line]
        repeated = "a step of the reference model failed, the last y_m is repeated"
        assert lines == [f"[ERROR] {repeated}: ArithmeticError a value that is not finite"]
        _, figures = diagnostics(world, "/reference_model")
        assert int(figures["failed steps"]) >= 45
