# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""The topic `node_state`: readiness and completion of nodes, for late subscribers and for the process runner."""

import json
import time
from pathlib import Path

import pytest
from diagnostic_msgs.msg import KeyValue
from sensor_msgs.msg import JointState
from tests.ros.conftest import Start
from tests.ros.peer import Peer, peer, stamp_ns

from flight_analysis.closed_loop.scenario import Scenario
from flight_bringup.graph import ONE_PROCESS, parameter_overrides
from flight_bringup.monitor import FlightMonitor
from flight_ros.messages import instant
from flight_ros.topics import NODE_STATE, PUBLISH, START, STATE, STATES

pytestmark = pytest.mark.package("flight_bringup")

PEER_TOPICS = ("/y",)


def received_states(peer_node: Peer, topic: str = NODE_STATE.name) -> dict[str, str]:
    """The newest state by process, filled while the peer spins."""
    states: dict[str, str] = {}
    peer_node.node.create_subscription(KeyValue, topic, lambda message: states.update({message.key: message.value}), STATES)
    return states


def test_late_subscriber_gets_state_of_each_process(start_node: Start) -> None:
    packages = {"controller": "rise_di_controller", "aircraft": "aircraft_sim"}
    nodes = {name: start_node(package, "-r", "__ns:=/one") for name, package in packages.items()}
    for node in nodes.values():
        node.wait_for("ready")
    with peer(topics=()) as peer_node:
        states = received_states(peer_node, "/one/node_state")
        # The aircraft has the publisher of u; the controller lacks that of y_m.
        expected = {"controller": "ready", "aircraft": "matched"}
        peer_node.until(
            lambda: states == {f"/one/{name}#{node.popen.pid}": expected[name] for name, node in nodes.items()},
            "the state of each process",
        )


def test_aircraft_completes_lockstep_flight_and_process_has_id(
    start_node: Start, osprey_gust: Scenario, tmp_path: Path
) -> None:
    short = osprey_gust.vary(flight={"duration": 0.2})
    overrides = parameter_overrides(ONE_PROCESS, short, tmp_path, 0.0, lockstep=True)
    words = [word for name, value in overrides.items() for word in ("-p", f"{name}:={json.dumps(value)}")]
    flight = start_node("flight_bringup", *words).wait_for("flight completed at t = 0.2 s")
    with peer(topics=()) as peer_node:
        states = received_states(peer_node)
        roles = ("aircraft", "controller", "recorder", "reference_model")
        expected = {f"/{role}#{flight.popen.pid}": "completed" if role == "aircraft" else "ready" for role in roles}
        peer_node.until(lambda: states == expected, "the completed flight and the ready nodes")


def test_monitor_tells_node_from_one_of_another_flight(start_node: Start, osprey_gust: Scenario) -> None:
    node = start_node("rise_di_controller")
    with FlightMonitor(osprey_gust.controller.outputs, lockstep=True) as monitor:
        pid = node.popen.pid
        node.until(lambda: monitor.is_ready("controller", pid), "a controller that is ready")
        assert not monitor.is_ready("controller", pid + 1)
        assert not monitor.is_ready("recorder", pid)


def test_aircraft_waits_for_start(start_node: Start, peer_node: Peer) -> None:
    """It is matched with the publisher of u, and its y have stamps from t = 0 on."""
    aircraft = start_node("aircraft_sim", "-p", "start_time:=-1.0").wait_for("ready")
    states = received_states(peer_node)
    send = peer_node.node.create_publisher(START.type, START.name, STATE)
    peer_node.until(lambda: set(states.values()) == {"ready"}, "an aircraft that is ready")
    peer_node.node.create_publisher(JointState, "u", PUBLISH)
    peer_node.until(lambda: states[f"/aircraft#{aircraft.popen.pid}"] == "matched", "an aircraft that is matched")
    assert peer_node.received["/y"] == []
    start_ns = time.time_ns() + 200_000_000
    send.publish(instant(start_ns))
    first, *_ = peer_node.until(lambda: peer_node.received["/y"], "a y")
    since_ns = stamp_ns(first) - start_ns  # whole periods of 2 ms: on a busy host not the first
    assert since_ns >= 0
    assert since_ns % 2_000_000 == 0
