# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""The access control policy that is shipped names what the nodes have, no less and no more."""

from pathlib import Path
from typing import NamedTuple
from xml.etree import ElementTree

import pytest
from tests.conftest import REPOSITORY
from tests.ros.conftest import Start
from tests.ros.peer import Peer, peer

from autopilot_bridge.params import LIBRARY, load_map
from flight_analysis.closed_loop.scenario import Scenario
from flight_bringup.clients import FlightMonitor

POLICY = REPOSITORY / "ros_ws" / "src" / "flight_bringup" / "security" / "flight.policy.xml"


class Access(NamedTuple):
    """Names in full."""

    publish: frozenset[str]
    subscribe: frozenset[str]
    reply: frozenset[str]
    request: frozenset[str]

    def merged(self, other: "Access") -> "Access":
        """What either has."""
        return Access(*(one | more for one, more in zip(self, other, strict=True)))


def in_full(name: str, node: str) -> str:
    """As the policy's format resolves it: behind "~" by the node's name, else by the namespace, which is the root here."""
    return f"/{node}/{name[1:]}" if name.startswith("~") else f"/{name.removeprefix('/')}"


def allowed() -> dict[str, Access]:
    """What each node may do, by its name."""
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
            texts = [one.text or "" for part in lists for one in part]
            assert len(texts) == len(set(texts))
            names.append(frozenset(in_full(text, node) for text in texts))
        found[node] = Access(*names)
    return found


def graph(peer_node: Peer, node: str) -> Access:
    """What a node has."""
    lists = []
    for kind in ("publisher", "subscriber", "service", "client"):
        find = getattr(peer_node.node, f"get_{kind}_names_and_types_by_node")
        lists.append(frozenset(name for name, _ in find(node, "/")))
    return Access(*lists)


def seen(peer_node: Peer, nodes: tuple[str, ...], policy: dict[str, Access]) -> dict[str, Access]:
    """What the nodes have, once all that is allowed in either way of flying has been found, or nothing more comes."""
    found: dict[str, Access] = {}

    def stands() -> bool:
        there = {name for name, _ in peer_node.node.get_node_names_and_namespaces()}
        if not there >= set(nodes):
            return False
        before = dict(found)
        found.update({node: graph(peer_node, node) for node in nodes})
        return found == before and all(one.publish and one.reply for one in found.values())

    for _ in range(3):  # endpoints of a node come one by one
        peer_node.until(stands, timeout=60.0)
        waited = peer_node.node.get_clock().now().nanoseconds + 500_000_000
        peer_node.until(lambda end=waited: peer_node.node.get_clock().now().nanoseconds > end)  # type: ignore[misc]
    return found


ROLES = ("aircraft", "reference_model", "controller", "recorder")


def test_the_policy_names_every_topic_and_service_of_a_flight_and_no_other(
    start: Start, osprey_gust: Scenario, tmp_path: Path
) -> None:
    policy, file = allowed(), str(osprey_gust.path)
    modules = {"rise_di_controller": "controller", "reference_model": "reference_model", "aircraft_sim": "aircraft"}
    with peer(topics=()) as peer_node:
        processes = [start(f"{module}.main", "--ros-args", "--params-file", file) for module in modules]
        processes.append(start("flight_recorder.main", "--ros-args", "--params-file", file))
        for process in processes:
            process.wait_for("ready", timeout=60.0)
        real_time = seen(peer_node, ROLES, policy)
        for process in processes:
            process.interrupt()
            process.end()
        told = [f"{role}:lockstep:=true" for role in ROLES] + ["aircraft:control_rate:=100.0", "controller:y_rate:=500.0"]
        told.append(f"recorder:directory:={tmp_path / 'run'}")
        start("flight_bringup.main", "--ros-args", "--params-file", file, *(word for one in told for word in ("-p", one)))
        lockstep = seen(peer_node, ROLES, policy)
    for role in ROLES:
        assert real_time[role].merged(lockstep[role]) == policy[role], role


def test_the_policy_names_what_the_monitor_of_a_flight_has(osprey_gust: Scenario) -> None:
    with peer(topics=()) as peer_node, FlightMonitor(osprey_gust.controller.outputs, lockstep=False):
        assert seen(peer_node, ("monitor",), allowed())["monitor"] == allowed()["monitor"]


def test_the_policy_names_what_the_bridge_has_with_every_map(start: Start) -> None:
    maps = [load_map(path.stem) for path in sorted(LIBRARY.glob("*.yaml"))]
    used = [row for channel_map in maps for row in channel_map.used_topics()]
    sent = {topic for key, topic, _ in used if key.startswith("messages.")}
    heard = {topic for key, topic, _ in used if not key.startswith("messages.")}
    policy = allowed()["bridge"]
    with peer(topics=()) as peer_node:
        start("autopilot_bridge.main", "--ros-args", "-p", "map:=ardupilot").wait_for("dry run")  # its message types are here
        own = seen(peer_node, ("bridge",), allowed())["bridge"]
    assert own.publish | sent == policy.publish
    assert own.subscribe | heard == policy.subscribe
    assert (own.reply, own.request) == (policy.reply, policy.request)


def test_the_policy_allows_no_wildcard() -> None:
    names = {name for access in allowed().values() for part in access for name in part}
    assert not [name for name in names if set(name) & set("*?[")]


@pytest.mark.parametrize("node", allowed())
def test_nobody_may_ask_a_service(node: str) -> None:
    assert not allowed()[node].request
