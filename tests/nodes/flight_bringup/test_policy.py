# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test the access control policy.

It has no wildcard and one client of services, and it allows the topics of the one table.
"""

import pytest
from tests.ros.flight_bringup.test_policy import allowed
from tools import topics


def test_the_policy_allows_no_wildcard() -> None:
    names = {name for access in allowed().values() for part in access for name in part}
    assert not [name for name in names if set(name) & set("*?[")]


@pytest.mark.parametrize("node", allowed())
def test_policy_allows_no_service_request_but_those_of_bridge_to_controller_and_autopilot(
    node: str,
) -> None:
    """The controller is active only while the bridge is engaged.

    ArduPilot is asked for a mode after a release.
    """
    requested = {"/controller/change_state", "/controller/get_state", "/ap/mode_switch"}
    assert allowed()[node].request == (frozenset(requested) if node == "bridge" else frozenset())


def test_policy_and_page_are_those_of_the_table_of_topics() -> None:
    for path, text in ((topics.POLICY, topics.policy()), (topics.PAGE, topics.page())):
        assert path.read_text() == text, "python -m tools.topics writes it again"
