# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test the topic `node_state`, which says when a node is ready or has completed.

Late subscribers and the process runner read it.
"""

import json
import time
from pathlib import Path

from diagnostic_msgs.msg import KeyValue
from tests.ros.conftest import Start
from tests.ros.peer import Peer, peer, stamp_ns

from flight_analysis.closed_loop.scenario import Scenario
from flight_bringup.graph import ONE_PROCESS, parameter_overrides
from flight_bringup.monitor import FlightMonitor
from flight_ros.messages import instant
from flight_ros.topics import NODE_STATE, START, STATE, STATES


def received_states(peer_node: Peer, topic: str = NODE_STATE.name) -> dict[str, str]:
    """Return the newest state by process, which is updated while the peer spins."""
    states: dict[str, str] = {}
    peer_node.node.create_subscription(
        KeyValue, topic, lambda message: states.update({message.key: message.value}), STATES
    )
    return states


def test_state_of_each_process_for_late_subscriber_and_monitor_and_aircraft_that_waits_for_start(
    start_node: Start, osprey_gust: Scenario
) -> None:
    """The aircraft is matched with the publisher of u before t = 0.

    Its first y has the stamp of t = 0.
    """
    in_namespace = ("-r", "__ns:=/one")
    nodes = {
        "controller": start_node("rise_di_controller", *in_namespace),
        "aircraft": start_node("aircraft_sim", *in_namespace, "-p", "start_time:=-1.0"),
    }
    for node in nodes.values():
        node.wait_for("ready")
    with peer(topics=("/one/y",)) as peer_node:
        states = received_states(peer_node, "/one/node_state")
        send = peer_node.node.create_publisher(START.type, f"/one/{START.name}", STATE)
        # the controller lacks the publisher of y_m
        expected = {"controller": "ready", "aircraft": "matched"}
        peer_node.until(
            lambda: (
                states
                == {f"/one/{name}#{node.popen.pid}": expected[name] for name, node in nodes.items()}
            ),
            "the state of each process",
        )
        with FlightMonitor(
            osprey_gust.controller.outputs, lockstep=True, namespace="one"
        ) as monitor:
            pid = nodes["controller"].popen.pid
            nodes["controller"].until(
                lambda: monitor.is_ready("controller", pid), "a controller that is ready"
            )
            assert not monitor.is_ready("controller", pid + 1)
            assert not monitor.is_ready("recorder", pid)
        assert peer_node.received["/one/y"] == []
        start_ns = time.time_ns() + 200_000_000
        send.publish(instant(start_ns))
        first, *_ = peer_node.until(lambda: peer_node.received["/one/y"], "a y")
        since_ns = stamp_ns(first) - start_ns  # whole periods of 2 ms: on a busy host not the first
        assert since_ns >= 0
        assert since_ns % 2_000_000 == 0


def test_aircraft_completes_lockstep_flight_and_process_has_id(
    start_node: Start, osprey_gust: Scenario, tmp_path: Path
) -> None:
    short = osprey_gust.vary(flight={"duration": 0.2})
    overrides = parameter_overrides(ONE_PROCESS, short, tmp_path, 0.0, lockstep=True)
    words = [
        word for name, value in overrides.items() for word in ("-p", f"{name}:={json.dumps(value)}")
    ]
    flight = start_node("flight_bringup", *words).wait_for("flight completed at t = 0.2 s")
    with peer(topics=()) as peer_node:
        states = received_states(peer_node)
        roles = ("aircraft", "controller", "recorder", "reference_model")
        expected = {
            f"/{role}#{flight.popen.pid}": "completed" if role == "aircraft" else "ready"
            for role in roles
        }
        peer_node.until(lambda: states == expected, "the completed flight and the ready nodes")
