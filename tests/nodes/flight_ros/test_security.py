# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test that sockets open to the network are found, and that a replayed u is refused."""

import socket

import psutil
import pytest
from builtin_interfaces.msg import Time
from sensor_msgs.msg import JointState
from tests.nodes.aircraft_sim.test_aircraft import MAX_AGE, flying
from tests.nodes.world import world_of

from aircraft_sim.node import AircraftNode
from flight_analysis.closed_loop.scenario import Scenario
from flight_ros.messages import instant
from flight_ros.topics import STATE
from flight_ros.transport import LOOPBACK_PROFILE, open_to_network


class EarlierProcess(psutil.Process):
    """A process as psutil describes it before release 6."""

    connections = psutil.Process.net_connections

    @property
    def net_connections(self) -> None:  # type: ignore[override]
        """Raise AttributeError."""
        raise AttributeError


@pytest.mark.parametrize("process", [psutil.Process, EarlierProcess])
def test_socket_on_all_interfaces_found_in_spite_of_loopback_profile(
    process: type[psutil.Process], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(psutil, "Process", process)
    monkeypatch.setenv("FASTRTPS_DEFAULT_PROFILES_FILE", str(LOOPBACK_PROFILE))
    with (
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as opened,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as local,
    ):
        opened.bind(("0.0.0.0", 0))  # noqa: S104 - on purpose, for nothing to read
        local.bind(("127.0.0.1", 0))
        found = open_to_network()
        assert f"0.0.0.0:{opened.getsockname()[1]}" in found
        assert not any(address.endswith(f":{local.getsockname()[1]}") for address in found)


def test_replayed_u_refused_by_stamp(osprey_gust: Scenario) -> None:
    """A restarted aircraft, which does not remember the last stamp, refuses it, too."""
    with flying(osprey_gust, max_age=MAX_AGE) as flight:
        publisher = flight.world.publisher(JointState, "/u")
        flight.fly(0.01)
        _, recorded = flight.world.sent["/u"][0]
        taken = len(flight.node.log.lines)
        flight.world.run(0.1, lambda: publisher.publish(recorded))
        assert flight.node.refusals.counts["u: old"] > 10
        assert any("/u: sample refused: " in line for line in flight.node.log.lines[taken:])

        flight.world.end(flight.node)
        restarted = flight.world.start(AircraftNode)
        flight.world.run(0.1, lambda: publisher.publish(recorded))
        assert restarted.refusals.counts["u: old"] > 10
        assert not any("receiving u from" in line for line in restarted.log.lines)


def test_start_that_nodes_of_two_names_publish_is_told(osprey_gust: Scenario) -> None:
    """The message does not name its publisher. A node that was started again has the same name."""
    arguments = ("--params-file", str(osprey_gust.path), "-p", "start_time:=-1.0")
    with world_of(*arguments) as world:
        aircraft = world.make(AircraftNode)
        starts = [world.publisher(Time, "/start", STATE, "/monitor") for _ in range(2)]
        starts[0].publish(instant(world.clock.time_ns()))
        assert aircraft.start_ns() == world.clock.time_ns()
        assert not aircraft.log.lines
        world.publisher(Time, "/start", STATE, "/rogue").publish(instant(world.clock.time_ns()))
        assert aircraft.start_ns() == world.clock.time_ns()
        told = "[ERROR] /start: published by /monitor, /rogue, expected one node"
        assert aircraft.log.lines == [told]
