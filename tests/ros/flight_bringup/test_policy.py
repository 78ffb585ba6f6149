# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test that the access control policy allows exactly the topics and services of the nodes."""

import json
import time
from pathlib import Path
from typing import NamedTuple
from xml.etree import ElementTree

from tests.conftest import REPOSITORY
from tests.maps import MAP_FILES, named_map
from tests.ros.conftest import Process, Start
from tests.ros.peer import Peer

from autopilot_bridge.map_rows import MAVLINK
from flight_analysis.closed_loop.scenario import Scenario
from flight_analysis.closed_loop.scenario_library import find_scenario
from flight_bringup.graph import GUIDANCE, LEARNER, ON_START, parameter_overrides
from flight_bringup.monitor import FlightMonitor

SETTLED = 1.0  # s without a change of the graph
POLICY = (
    REPOSITORY
    / "ros_ws"
    / "src"
    / "flight_bringup"
    / "flight_bringup"
    / "security"
    / "flight.policy.xml"
)


class Access(NamedTuple):
    """Full names."""

    publish: frozenset[str]
    subscribe: frozenset[str]
    reply: frozenset[str]
    request: frozenset[str]

    def merged(self, other: "Access") -> "Access":
        """Return the union of both."""
        return Access(*(names | more for names, more in zip(self, other, strict=True)))


def in_full(name: str, node: str) -> str:
    """Return the full name, resolved as in the policy format.

    "~" is the node's name, and the namespace is the root.
    """
    return f"/{node}/{name[1:]}" if name.startswith("~") else f"/{name.removeprefix('/')}"


def allowed() -> dict[str, Access]:
    """Return what the policy allows each node, by node name."""
    accesses = {}
    for enclave in ElementTree.parse(POLICY).getroot().findall("enclaves/enclave"):
        profiles = enclave.findall("profiles/profile")
        node = profiles[0].attrib["node"]
        assert enclave.attrib["path"] == f"/flight/{node}"
        assert len(profiles) == 1
        names = []
        for verb in Access._fields:
            lists = [part for part in profiles[0] if part.get(verb) is not None]
            assert {part.get(verb) for part in lists} <= {"ALLOW"}
            texts = [element.text or "" for part in lists for element in part]
            assert len(texts) == len(set(texts))
            names.append(frozenset(in_full(text, node) for text in texts))
        accesses[node] = Access(*names)
    return accesses


def graph(peer_node: Peer, node: str) -> Access:
    """Return the topics and services of a node in the ROS graph."""
    kinds = ("publisher", "subscriber", "service", "client")
    find = [getattr(peer_node.node, f"get_{kind}_names_and_types_by_node") for kind in kinds]
    return Access(*(frozenset(name for name, _ in names(node, "/")) for names in find))


def discovered(peer_node: Peer, nodes: tuple[str, ...]) -> dict[str, Access]:
    """Return the topics and services of the nodes after the discovery has settled.

    Endpoints are discovered one by one.
    """
    accesses: dict[str, Access] = {}
    changed_at = time.monotonic()

    def settled() -> bool:
        present = {name for name, _ in peer_node.node.get_node_names_and_namespaces()}
        if not present >= set(nodes):
            return False
        nonlocal changed_at
        before = dict(accesses)
        accesses.update({node: graph(peer_node, node) for node in nodes})
        if accesses != before or not all(
            access.publish and access.reply for access in accesses.values()
        ):
            changed_at = time.monotonic()
        return time.monotonic() - changed_at > SETTLED

    peer_node.until(settled, "a graph that does not change")
    return accesses


ROLES = ("aircraft", "reference_model", "controller", "recorder")
# nodes that few scenarios have
FURTHER = {"guidance": (GUIDANCE, "osprey_route"), "learner": (LEARNER, "osprey_learn")}


def start_further(start: Start, run: Path, *, lockstep: bool) -> list[Process]:
    """Start the nodes that few scenarios have, and the bridge for a flight in real time."""
    processes = []
    for spec, name in FURTHER.values():
        scenario = find_scenario(name)
        overrides = parameter_overrides(spec, scenario, run, ON_START, lockstep=lockstep)
        if spec is GUIDANCE:  # of a flight that learns, too
            overrides = {**overrides, "authority_rate": 10.0}
        words = (
            word
            for key, value in overrides.items()
            for word in ("-p", f"{key}:={json.dumps(value)}")
        )
        processes.append(
            start(spec.module, "--ros-args", "--params-file", str(scenario.path), *words)
        )
    if not lockstep:
        processes.append(
            start(
                "autopilot_bridge.main", "--ros-args", "-p", f"map:={MAP_FILES['ardupilot_2024']}"
            )
        )
    return processes


def test_policy_allows_exactly_topics_and_services_of_nodes(
    start: Start, start_node: Start, osprey_gust: Scenario, tmp_path: Path, peer_node: Peer
) -> None:
    """One flight is in real time with a learner and a probe, and one in lockstep without them."""
    policy = allowed()
    learning = str(find_scenario("osprey_learn").path)
    processes = [
        start_node(package, "-p", "start_time:=-1.0")
        for package in ("reference_model", "aircraft_sim")
    ]
    processes += [
        start(
            "rise_di_controller.main",
            "--ros-args",
            "--params-file",
            learning,
            "-p",
            "probe.window:=6.0",
        ),
        start_node("flight_recorder"),
    ]
    processes += start_further(start, tmp_path, lockstep=False)
    with FlightMonitor(osprey_gust.controller.outputs, lockstep=False, learns=True):
        for process in processes:
            process.wait_for(": ready")  # with all of its topics
        real_time = discovered(peer_node, (*ROLES, *FURTHER, "bridge", "monitor"))
    assert real_time["monitor"] == policy["monitor"]
    check_bridge(real_time["bridge"], policy["bridge"])
    for process in processes:
        process.interrupt()
    for process in processes:
        process.end()
    peer_node.until(lambda: peer_node.node.get_node_names() == ["peer"], "the end of the nodes")

    overrides = [f"{role}:lockstep:=true" for role in ROLES] + [
        "aircraft:control_rate:=100.0",
        "controller:y_rate:=500.0",
    ]
    overrides.append(f"recorder:directory:={tmp_path / 'run'}")
    start_node("flight_bringup", *(word for override in overrides for word in ("-p", override)))
    start_further(start, tmp_path, lockstep=True)
    lockstep = discovered(peer_node, (*ROLES, *FURTHER))
    # where tf2_msgs is installed
    further = {"guidance": Access(frozenset({"/tf"}), *[frozenset()] * 3)}
    empty = frozenset[str]()
    by_clock = Access(empty, frozenset({"/clock"}), empty, empty)  # by use_sim_time
    for role in lockstep:
        observed = real_time[role].merged(lockstep[role]).merged(by_clock)
        assert observed.merged(further.get(role, by_clock)) == policy[role], role


def check_bridge(own: Access, policy: Access) -> None:
    """Check the bridge's policy: what it needs for one map, and what the other maps add."""
    rows = [row for name in MAP_FILES for row in named_map(name).used_topics()]
    sent_topics, received_topics = (
        [row for row in rows if row[0].startswith("messages.") is is_sent]
        for is_sent in (True, False)
    )
    # what comes over MAVLink is published for the recorder, and what goes over MAVLink is no topic
    requested = {topic for _, topic, kind in sent_topics if "/srv/" in kind}
    published = {
        in_full(topic, "bridge")
        for _, topic, kind in sent_topics
        if not kind.startswith(f"{MAVLINK}/")
    } - requested
    published |= {
        in_full(topic, "bridge")
        for _, topic, kind in received_topics
        if kind.startswith(f"{MAVLINK}/")
    }
    subscribed = {
        in_full(topic, "bridge")
        for _, topic, kind in received_topics
        if not kind.startswith(f"{MAVLINK}/")
    }
    assert own.publish | published == policy.publish
    subscribed |= {"/clock"}  # by use_sim_time
    assert own.subscribe | subscribed == policy.subscribe
    assert (own.reply, own.request | requested) == (policy.reply, policy.request)
