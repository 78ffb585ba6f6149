# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""The access control policy allows no wildcard, one client of services, and the topics of the graph of a flight."""

import re

import pytest
from tests.conftest import REPOSITORY
from tests.ros.test_policy import allowed

from flight_bringup.graph import BRIDGE, PUBLISHED_TOPICS, NodeSpec

pytestmark = pytest.mark.package("flight_bringup")

OF_EACH_NODE = frozenset({"clocks", "node_state", "diagnostics", "parameter_events", "rosout", "clock", "tf"})
"""Also the clock of a lockstep flight, and the transforms of guidance."""


def test_the_policy_allows_no_wildcard() -> None:
    names = {name for access in allowed().values() for part in access for name in part}
    assert not [name for name in names if set(name) & set("*?[")]


@pytest.mark.parametrize("node", allowed())
def test_policy_allows_no_service_request_but_those_of_bridge_to_controller_and_autopilot(node: str) -> None:
    """The controller is active only while the bridge is engaged. ArduPilot is asked for a mode after a release."""
    requested = {"/controller/change_state", "/controller/get_state", "/ap/mode_switch"}
    assert allowed()[node].request == (frozenset(requested) if node == "bridge" else frozenset())


@pytest.mark.parametrize("node", PUBLISHED_TOPICS, ids=lambda node: node.executable)
def test_topics_of_a_node_are_those_of_policy_and_of_page(node: NodeSpec) -> None:
    """The bridge also has the topics of the channel maps, which no table lists."""
    names = set(PUBLISHED_TOPICS[node])
    published = {name.removeprefix("/") for name in allowed()[node.executable].publish} - OF_EACH_NODE
    published -= {f"alive/{node.executable}", f"{node.executable}/transition_event"}
    assert names <= published if node is BRIDGE else names == published
    page = (REPOSITORY / "docs" / "interfaces.md").read_text(encoding="utf-8")
    listed = {name for row in page.splitlines() if row.startswith("| `") for name in re.findall("`([^`]+)`", row.split("|")[1])}
    assert names <= listed
