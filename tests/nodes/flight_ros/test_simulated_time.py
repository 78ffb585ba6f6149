# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test nodes that run by the /clock of a simulator, at any speed.

The tests cover the same flight, a pause, a restart, and the log.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rclpy.parameter import Parameter
from rosgraph_msgs.msg import Clock
from tests.nodes.world import World, stamp_ns, world_of
from tests.recordings import messages

from aircraft_sim.node import AircraftNode
from flight_analysis.closed_loop.scenario import Scenario
from flight_core.modes import Mode
from flight_core.rates import NANOSECONDS
from flight_log.tape_reader import read_run
from flight_recorder.node import RecorderNode
from flight_ros.messages import instant, stamp_of
from flight_ros.simulated_time import ClockRestarted
from reference_model.node import ReferenceModelNode
from rise_di_controller.node import ControllerNode

STEP_NS = 2_000_000  # of /clock


class Simulation:
    """A simulator whose /clock is `speed` times as fast as the time of the host."""

    def __init__(self, world: World, speed: float = 1.0) -> None:
        self.world = world
        self.speed = speed
        self.now_ns = 0
        self.publisher = world.publisher(Clock, "/clock")

    def run(self, duration: float) -> None:
        """Run for a duration of simulated time, s."""
        for _ in range(round(duration * NANOSECONDS / STEP_NS)):
            self.now_ns += STEP_NS
            self.publisher.publish(instant(self.now_ns))
            self.world.run(STEP_NS / NANOSECONDS / self.speed)

    def start(self, *nodes: type[Any]) -> list[Any]:
        """Start nodes, and let them know the time."""
        made = [self.world.make(node) for node in nodes]
        assert not any(node.has_time() for node in made if not isinstance(node, RecorderNode))
        self.run(0.01)
        assert all(node.has_time() for node in made)
        for node in made:
            self.world.begin(node)
        return made


@contextmanager
def simulation(scenario: Scenario, *arguments: str, speed: float = 1.0) -> Iterator[Simulation]:
    """Yield a world that runs by /clock."""
    with world_of(
        "--params-file", str(scenario.path), "-p", "use_sim_time:=true", *arguments
    ) as world:
        yield Simulation(world, speed)


def flown(scenario: Scenario, speed: float) -> tuple[list[bytes], float]:
    """Return what the controller sent in 2.5 s of simulated time.

    The second result is how long this took on the host, s.
    """
    with simulation(scenario, speed=speed) as simulator:
        simulator.start(AircraftNode, ReferenceModelNode, ControllerNode)
        begin = simulator.world.clock.monotonic()
        simulator.run(2.5)
        assert simulator.world.last("/internals")["mode"] == Mode.ENGAGED
        return [
            raw for _, raw in simulator.world.sent["/internals"]
        ], simulator.world.clock.monotonic() - begin


def test_same_ticks_at_any_speed(osprey_gust: Scenario) -> None:
    (usual, _), (slow, slow_time), (fast, fast_time) = (
        flown(osprey_gust, speed) for speed in (1.0, 0.3, 3.0)
    )
    assert len(usual) > 200
    assert slow == usual == fast
    assert slow_time == pytest.approx(2.5 / 0.3, rel=0.01)
    assert fast_time == pytest.approx(2.5 / 3.0, rel=0.01)


def test_pause_of_clock_is_a_pause(osprey_gust: Scenario) -> None:
    with simulation(osprey_gust) as simulator:
        aircraft, _, controller = simulator.start(AircraftNode, ReferenceModelNode, ControllerNode)
        simulator.run(1.0)
        before = {topic: len(simulator.world.sent[topic]) for topic in ("/y", "/y_m", "/u")}
        simulator.world.run(5.0)  # 50 times the age limits, on the host
        assert {topic: len(simulator.world.sent[topic]) for topic in before} == before
        simulator.run(1.0)
        assert not [
            line
            for node in (aircraft, controller)
            for line in node.log.lines
            if "HOLD" in line or "failsafe" in line
        ]
        assert simulator.world.last("/internals")["mode"] == Mode.ENGAGED
        instants = [stamp_ns(message) for message in simulator.world.messages("/u")]
        assert np.diff(instants).max() == 10_000_000


@pytest.mark.parametrize("jump", [-0.5, 61.0])
def test_jump_of_clock_ends_the_simulation(jump: float, osprey_gust: Scenario) -> None:
    with simulation(osprey_gust) as simulator:
        (controller,) = simulator.start(ControllerNode)
        simulator.run(1.0)
        controller.require_flight()
        simulator.now_ns += round(jump * NANOSECONDS)
        simulator.run(0.002)
        with pytest.raises(
            ClockRestarted,
            match=rf"/clock jumped by \{jump + 0.002:+.3f} s: another simulation begins",
        ):
            controller.require_flight()


def test_missing_clock_is_named_after_seconds(osprey_gust: Scenario) -> None:
    with simulation(osprey_gust) as simulator:
        controller = simulator.world.make(ControllerNode)
        simulator.publisher.leave()
        for _ in range(50):
            controller.warn_without_time()
            simulator.world.clock.sleep(0.1)
        assert [line for line in controller.log.lines if "clock" in line] == [
            "[WARNING] waiting for /clock: no publisher"
        ]


def test_malformed_clock_is_ignored(osprey_gust: Scenario) -> None:
    with simulation(osprey_gust) as simulator:
        controller = simulator.world.make(ControllerNode)
        simulator.publisher.publish(b"\x00\x01\x00\x00\x01")
        assert not controller.has_time()


def test_recorder_stamps_by_clock(osprey_gust: Scenario, tmp_path: Path) -> None:
    with simulation(
        osprey_gust, "-p", f"recorder:directory:={tmp_path / 'run'}", speed=3.0
    ) as simulator:
        nodes = simulator.start(AircraftNode, ReferenceModelNode, ControllerNode, RecorderNode)
        simulator.run(2.0)
        simulator.world.run(5.0)  # a pause
        simulator.run(1.0)
        assert not [line for line in nodes[-1].log.lines if "no message" in line or "no y" in line]
        simulator.world.end(nodes[-1])
        again = simulator.world.make(RecorderNode)  # of the next simulation
        assert again.log.lines[0].endswith("run-2/run-2_0.mcap")
        assert (tmp_path / "run" / "run_0.mcap").exists()
    run = read_run(tmp_path / "run")
    assert any(
        note.startswith("flown by the simulated time of /clock, at ") for note in run.tape.notes
    )
    logged = [
        (time_ns, stamp_of(data))
        for topic, time_ns, data in messages(tmp_path / "run")
        if topic == "/u"
    ]
    assert len(logged) > 200
    assert all(0 <= time_ns - stamp <= 2 * STEP_NS for time_ns, stamp in logged)


def test_clock_of_a_running_node_is_fixed(osprey_gust: Scenario) -> None:
    with simulation(osprey_gust) as simulator:
        (controller,) = simulator.start(ControllerNode)
        results = controller.set_parameters(
            [Parameter("use_sim_time", value=value) for value in (True, False)]
        )
        assert [result.successful for result in results] == [True, False]
        assert (
            "use_sim_time: found False, expected no change: a node chooses its clock when it starts"
            in results[1].reason
        )
