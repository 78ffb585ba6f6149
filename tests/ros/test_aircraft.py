# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""The watchdog and failsafe of the aircraft's node when u times out, and its refusal of a conflicting publisher of u."""

import time
from collections.abc import Iterator

import numpy as np
import pytest
from tests.ros.conftest import Process, Start
from tests.ros.peer import Peer, peer

from flight_analysis.closed_loop.scenario import Scenario
from flight_ros.messages import to_message

INPUTS = ("elevator", "thrust", "aileron", "rudder")


@pytest.fixture
def peer_node() -> Iterator[Peer]:
    with peer(topics=("truth", "/diagnostics")) as made:
        yield made


def aircraft(start: Start, scenario: Scenario, *arguments: str) -> Process:
    return start("aircraft_sim.main", "--ros-args", "--params-file", str(scenario.path), *arguments)


def command(peer_node: Peer, sender: str, aileron: float) -> None:
    peer_node.publish("u", to_message(time.time_ns(), INPUTS, np.array([0.0, 0.0, aileron, 0.0]), sender))


def aileron(peer_node: Peer) -> list[float]:
    return [m.position[m.name.index("actuator.aileron")] for m in peer_node.received["truth"]]


def test_u_that_times_out_is_held_then_ramped_to_trim_and_may_return(
    start: Start, osprey_gust: Scenario, peer_node: Peer
) -> None:
    process = aircraft(start, osprey_gust, "-p", "max_age:=0.1", "-p", "hold:=0.1", "-p", "ramp:=0.2")
    peer_node.until(lambda: aileron(peer_node)[-1:] == [0.01], each=lambda: command(peer_node, "first", 0.01))
    peer_node.received["truth"].clear()
    peer_node.until(lambda: aileron(peer_node)[-1:] == [0.0])  # no u is published any more
    positions = aileron(peer_node)
    assert (np.diff(positions) <= 0).all()
    # 500 Hz over a ramp of 0.2 s: steps of 0.01 / 100; ten times that allows for scheduling delay of the host
    assert np.abs(np.diff(positions)).max() <= 1e-3
    process.wait_for("waiting for /u")
    peer_node.until(lambda: aileron(peer_node)[-1:] == [0.02], each=lambda: command(peer_node, "second", 0.02))
    process.wait_for("receiving u from second")


def test_a_second_controller_is_ignored_while_the_first_one_publishes(
    start: Start, osprey_gust: Scenario, peer_node: Peer
) -> None:
    process = aircraft(start, osprey_gust)
    peer_node.until(lambda: aileron(peer_node)[-1:] == [0.01], each=lambda: command(peer_node, "first", 0.01))

    def both() -> None:
        command(peer_node, "first", 0.01)
        command(peer_node, "second", -0.5)

    def refusals_reported() -> bool:
        values = [v for array in peer_node.received["/diagnostics"] for status in array.status for v in status.values]
        return any(value.key == "refused u: sender" and int(value.value) > 5 for value in values)

    peer_node.until(refusals_reported, each=both)
    process.wait_for("conflicting publisher second ignored: already receiving from first")
    assert min(aileron(peer_node)) == 0.0
