# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""The access control policy allows exactly the topics and services that the nodes have."""

import json
import time
from pathlib import Path
from typing import NamedTuple
from xml.etree import ElementTree

import pytest
from tests.conftest import REPOSITORY
from tests.maps import MAP_FILES, named_map
from tests.ros.conftest import Start
from tests.ros.peer import Peer

from autopilot_bridge.params import MAVLINK
from flight_analysis.closed_loop.scenario import Scenario
from flight_analysis.closed_loop.scenario_library import find_scenario
from flight_bringup.graph import GUIDANCE, LEARNER, ON_START, NodeSpec, parameter_overrides
from flight_bringup.monitor import FlightMonitor

pytestmark = pytest.mark.package("flight_bringup")

SETTLED = 1.0  # s without a change of the graph
POLICY = REPOSITORY / "ros_ws" / "src" / "flight_bringup" / "flight_bringup" / "security" / "flight.policy.xml"


class Access(NamedTuple):
    """Names in full."""

    publish: frozenset[str]
    subscribe: frozenset[str]
    reply: frozenset[str]
    request: frozenset[str]

    def merged(self, other: "Access") -> "Access":
        """The union of both."""
        return Access(*(names | more for names, more in zip(self, other, strict=True)))


def in_full(name: str, node: str) -> str:
    """The full name, resolved as in the policy format: "~" is the node's name; the namespace is the root."""
    return f"/{node}/{name[1:]}" if name.startswith("~") else f"/{name.removeprefix('/')}"


def allowed() -> dict[str, Access]:
    """What the policy allows each node, by node name."""
    found = {}
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
        found[node] = Access(*names)
    return found


def graph(peer_node: Peer, node: str) -> Access:
    """The topics and services of a node in the ROS graph."""
    kinds = ("publisher", "subscriber", "service", "client")
    find = [getattr(peer_node.node, f"get_{kind}_names_and_types_by_node") for kind in kinds]
    return Access(*(frozenset(name for name, _ in names(node, "/")) for names in find))


def discovered(peer_node: Peer, nodes: tuple[str, ...]) -> dict[str, Access]:
    """The topics and services of the nodes, once the discovery has settled: its endpoints are discovered one by one."""
    found: dict[str, Access] = {}
    changed = time.monotonic()

    def settled() -> bool:
        present = {name for name, _ in peer_node.node.get_node_names_and_namespaces()}
        if not present >= set(nodes):
            return False
        nonlocal changed
        before = dict(found)
        found.update({node: graph(peer_node, node) for node in nodes})
        if found != before or not all(access.publish and access.reply for access in found.values()):
            changed = time.monotonic()
        return time.monotonic() - changed > SETTLED

    peer_node.until(settled, "a graph that does not change")
    return found


ROLES = ("aircraft", "reference_model", "controller", "recorder")


def test_policy_allows_exactly_topics_and_services_of_nodes(start_node: Start, tmp_path: Path, peer_node: Peer) -> None:
    policy, packages = allowed(), ("rise_di_controller", "reference_model", "aircraft_sim", "flight_recorder")
    processes = [start_node(package, "-p", "start_time:=-1.0") for package in packages[1:3]]
    processes += [start_node(package) for package in (packages[0], packages[3])]
    for process in processes:
        process.wait_for("ready")
    real_time = discovered(peer_node, ROLES)
    for process in processes:
        process.interrupt()
        process.end()
    overrides = [f"{role}:lockstep:=true" for role in ROLES] + ["aircraft:control_rate:=100.0", "controller:y_rate:=500.0"]
    overrides.append(f"recorder:directory:={tmp_path / 'run'}")
    start_node("flight_bringup", *(word for override in overrides for word in ("-p", override)))
    lockstep = discovered(peer_node, ROLES)
    beside_learner = {
        "controller": Access(frozenset({"/learning", "/authority"}), frozenset({"/proposal"}), frozenset(), frozenset())
    }
    for role in ROLES:
        further = beside_learner.get(role, real_time[role])
        assert real_time[role].merged(lockstep[role]).merged(further) == policy[role], role


def test_the_policy_allows_exactly_those_of_guidance(start: Start, tmp_path: Path, peer_node: Peer) -> None:
    found = optional_node(GUIDANCE, "osprey_route", start, tmp_path, peer_node)
    transforms = Access(frozenset({"/tf"}), *[frozenset()] * 3)  # where tf2_msgs is installed
    assert found.merged(transforms) == allowed()["guidance"]


def test_policy_allows_exactly_those_of_learner(start: Start, tmp_path: Path, peer_node: Peer) -> None:
    scenario = find_scenario("osprey_learn")
    start("rise_di_controller.main", "--ros-args", "--params-file", str(scenario.path)).wait_for("ready")
    controller = discovered(peer_node, ("controller",))["controller"]
    assert {"/learning", "/authority"} <= controller.publish
    assert {"/proposal"} <= controller.subscribe
    assert optional_node(LEARNER, "osprey_learn", start, tmp_path, peer_node) == allowed()["learner"]


def optional_node(spec: NodeSpec, name: str, start: Start, run: Path, peer_node: Peer) -> Access:
    """The topics and services of a node that few scenarios have, in real time and in lockstep."""
    scenario, found = find_scenario(name), Access(*[frozenset()] * 4)
    for lockstep in (False, True):
        overrides = parameter_overrides(spec, scenario, run, ON_START, lockstep=lockstep)
        words = (word for key, value in overrides.items() for word in ("-p", f"{key}:={json.dumps(value)}"))
        node = start(spec.module, "--ros-args", "--params-file", str(scenario.path), *words).wait_for("ready")
        found = found.merged(discovered(peer_node, (spec.executable,))[spec.executable])
        node.interrupt()
        node.end()
    return found


def test_policy_allows_exactly_those_of_flight_monitor(osprey_gust: Scenario, peer_node: Peer) -> None:
    with FlightMonitor(osprey_gust.controller.outputs, lockstep=False, learns=True):
        assert discovered(peer_node, ("monitor",))["monitor"] == allowed()["monitor"]


def test_policy_allows_exactly_those_of_bridge_with_every_map(start: Start, peer_node: Peer) -> None:
    maps = [named_map(name) for name in MAP_FILES]
    used = [row for channel_map in maps for row in channel_map.used_topics()]
    sent, received = ([row for row in used if row[0].startswith("messages.") is is_sent] for is_sent in (True, False))
    # what comes over MAVLink is published for the recorder, and what goes over MAVLink is no topic
    requested = {topic for _, topic, kind in sent if "/srv/" in kind}
    published = {in_full(topic, "bridge") for _, topic, kind in sent if not kind.startswith(f"{MAVLINK}/")} - requested
    published |= {in_full(topic, "bridge") for _, topic, kind in received if kind.startswith(f"{MAVLINK}/")}
    subscribed = {in_full(topic, "bridge") for _, topic, kind in received if not kind.startswith(f"{MAVLINK}/")}
    policy = allowed()["bridge"]
    start("autopilot_bridge.main", "--ros-args", "-p", f"map:={MAP_FILES['ardupilot_2024']}").wait_for("dry run")
    own = discovered(peer_node, ("bridge",))["bridge"]
    assert own.publish | published == policy.publish
    assert own.subscribe | subscribed == policy.subscribe
    assert (own.reply, own.request | requested) == (policy.reply, policy.request)
