# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test that any bytes on any topic are refused and counted. They end no node and no command.

Every subscription that receives bytes is tested: those of the nodes in real time, in lockstep and
by /clock, and those of the commands' clients.
"""

import json
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from tests.conftest import few
from tests.maps import MAP_FILES
from tests.nodes.flight_ros.test_fuzz_messages import CORPUS, payloads
from tests.nodes.world import OUTPUTS, World, clients_of, parameters, world_of

from aircraft_sim.node import AircraftNode
from autopilot_bridge.client import EngagementClient
from autopilot_bridge.node import BridgeNode
from flight_analysis.closed_loop.scenario import Scenario
from flight_analysis.closed_loop.scenario_library import find_scenario, save_scenario
from flight_bringup.graph import ON_START, ONE_PROCESS, parameter_overrides
from flight_bringup.monitor import FlightMonitor
from flight_core.vectors import ChannelError
from flight_design.learning.node import LearnerNode
from flight_guidance.client import TargetClient
from flight_guidance.node import GuidanceNode
from flight_recorder.node import RecorderNode
from flight_ros.event_loop import RealTime
from flight_ros.messages import instant, stamp_of
from reference_model.node import ReferenceModelNode
from rise_di_controller.node import ControllerNode

FLIGHT = (RecorderNode, ControllerNode, AircraftNode, ReferenceModelNode, GuidanceNode, LearnerNode)
STAMPED = instant(7_000_000_001)  # twelve bytes: no shorter message has a stamp
SHORT = [STAMPED[:size] for size in range(len(STAMPED))]
FOREIGN = b"\x07\x00" + STAMPED[2:]  # no plain CDR


def learning_and_guided(folder: Path) -> Scenario:
    """Return a scenario with every node except the bridge."""
    guided = find_scenario("osprey_route")
    assert guided.guidance is not None
    scenario = find_scenario("osprey_learn").vary(
        guidance=guided.guidance, reference_model=guided.reference_model
    )
    return save_scenario(scenario, folder / "learn_and_guide.yaml")


def arguments(scenario: Scenario, folder: Path, **options: Any) -> list[str]:
    """Return the arguments of all nodes of a flight."""
    (folder / "run").mkdir()
    start = 0.0 if options["lockstep"] else ON_START
    values = parameter_overrides(ONE_PROCESS, scenario, folder / "run", start, **options)
    words = [
        word for name, value in values.items() for word in ("-p", f"{name}:={json.dumps(value)}")
    ]
    return [
        "--params-file",
        str(scenario.path),
        *words,
        "-p",
        f"learner:scenario_file:={scenario.path}",
    ]


class Attack:
    """A world, and a function that lets its nodes and clients take what was sent."""

    def __init__(self, world: World, take: Callable[[], object]) -> None:
        self.world = world
        self.take = take

    def send(self, *bodies: bytes) -> None:
        """Put messages into the queue of every subscription of bytes, and let them be taken."""
        information = {
            "source_timestamp": self.world.clock.time_ns(),
            "received_timestamp": self.world.clock.time_ns(),
            "publication_sequence_number": 1,
        }
        for body in bodies:
            for subscription in self.world.subscriptions:
                if subscription.raw:
                    subscription.queue.append((body, information))
        self.take()

    def now(self) -> bytes:
        """Return the present instant as a message for t = 0, and for the time of a simulator."""
        return instant(self.world.clock.time_ns())

    def topics(self, node: str) -> set[str]:
        """Return the topics of a node's subscriptions of bytes."""
        return {
            each.topic_name
            for each in self.world.subscriptions
            if each.raw and each.endpoint.node_name == node
        }


@contextmanager
def nodes_in_real_time(folder: Path, *, use_sim_time: bool = False) -> Iterator[Attack]:
    """Yield all nodes except the bridge, and the clients of the commands.

    The nodes are before t = 0 and after it.
    """
    scenario = learning_and_guided(folder)
    words = arguments(scenario, folder, lockstep=False, use_sim_time=use_sim_time)
    with world_of(*words) as world, clients_of(world):
        nodes = [world.make(node) for node in FLIGHT]
        monitor = FlightMonitor(OUTPUTS, lockstep=False, use_sim_time=use_sim_time, learns=True)
        operator = TargetClient()
        engagement = EngagementClient()

        def take() -> None:
            monitor.newest(), monitor.learned(), monitor.recorded(), monitor.has_time()
            operator._received(), engagement._received_u()
            for node in nodes:
                waits = node not in world.loops and node.has_time()
                if waits and (start_ns := node.start_ns()) is not None:
                    world.loops[node] = RealTime(node, start_ns, spin=False)
            world.run(0.05)

        yield Attack(world, take)


@contextmanager
def nodes_by_clock(folder: Path) -> Iterator[Attack]:
    """Yield the same nodes in simulated time, before the first message of /clock."""
    with nodes_in_real_time(folder, use_sim_time=True) as attack:
        yield attack


@contextmanager
def nodes_in_lockstep(folder: Path) -> Iterator[Attack]:
    """Yield all nodes except the bridge."""
    scenario = learning_and_guided(folder)
    words = [
        *arguments(scenario, folder, lockstep=True),
        *parameters({"aircraft.recorded": "true"}),
    ]
    with world_of(*words) as world, clients_of(world):
        nodes = [world.make(node) for node in FLIGHT]
        monitor = FlightMonitor(OUTPUTS, lockstep=True, learns=True)

        def take() -> None:
            monitor.learned(), monitor.recorded()
            for node in nodes:
                node.advance()
                for receiver in node.receivers:  # also of one that waits for its instant
                    receiver.poll(0)
            world.run(0.05)

        yield Attack(world, take)


@contextmanager
def a_bridge(folder: Path) -> Iterator[Attack]:
    """Yield a bridge with an autopilot whose message types are installed."""
    with world_of(*parameters({"bridge.map": MAP_FILES["ardupilot_2024"]})) as world:
        world.start(BridgeNode)
        yield Attack(world, lambda: world.run(0.05))


WORLDS = [nodes_in_real_time, nodes_by_clock, nodes_in_lockstep, a_bridge]


@pytest.fixture(params=WORLDS, ids=lambda make: str(make.__name__))
def attack(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Attack]:
    with request.param(tmp_path) as made:
        yield made


def test_no_message_without_a_stamp_has_one() -> None:
    assert stamp_of(STAMPED) == 7_000_000_001
    assert stamp_of(instant(-1)) == -1
    big_endian = b"\x00\x00\x00\x00" + (-2).to_bytes(4, "big", signed=True) + (5).to_bytes(4, "big")
    assert stamp_of(big_endian) == -1_999_999_995
    for raw in (*SHORT, FOREIGN):
        with pytest.raises(ChannelError, match="expected a stamp in plain CDR") as error:
            stamp_of(raw)
        assert error.value.reason == "malformed"


def test_short_messages_end_nothing_and_are_counted_as_refused(attack: Attack) -> None:
    attack.send(*SHORT, FOREIGN)
    attack.send(attack.now())
    attack.send(*SHORT, FOREIGN, attack.now())
    assert attack.world.nodes
    for node in attack.world.nodes:
        refused = {node.resolve_topic_name(key.partition(": ")[0]) for key in node.refusals.counts}
        topics = attack.topics(node.get_name())
        if node.get_name() == "recorder":  # any bytes are evidence: it reads some stamps alone
            topics &= {"/truth"} if node.parameters.lockstep else {"/y", "/y_m", "/u", "/clock"}
        if node.simulated is not None:
            topics -= {"/start"}  # it keeps the last message alone, until there is a time
        assert topics
        assert topics <= refused, node.get_name()


@settings(few, max_examples=15)
@given(st.lists(payloads() | st.binary(max_size=40) | st.sampled_from(CORPUS), max_size=20))
def test_no_bytes_end_a_node_or_a_command(attack: Attack, bodies: list[bytes]) -> None:
    attack.send(*bodies, attack.now())


def test_log_holds_the_bytes_that_were_refused(tmp_path: Path) -> None:
    """A log should also be evidence of an attack."""
    with nodes_in_real_time(tmp_path) as attack:
        attack.send(*SHORT)
        attack.send(attack.now())
    (file,) = (tmp_path / "run").glob("*.mcap")
    with file.open("rb") as stream:
        stored = [message.data for _, _, message in make_reader(stream).iter_messages(["/y_m"])]
    assert stored[: len(SHORT)] == SHORT
