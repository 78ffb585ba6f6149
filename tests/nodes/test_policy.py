# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""The access control policy allows no wildcard, and one client of services."""

import pytest
from tests.ros.test_policy import allowed

pytestmark = pytest.mark.package("flight_bringup")


def test_the_policy_allows_no_wildcard() -> None:
    names = {name for access in allowed().values() for part in access for name in part}
    assert not [name for name in names if set(name) & set("*?[")]


@pytest.mark.parametrize("node", allowed())
def test_policy_allows_no_service_request_but_those_of_bridge_to_controller_and_autopilot(node: str) -> None:
    """The controller is active only while the bridge is engaged. ArduPilot is asked for a mode after a release."""
    requested = {"/controller/change_state", "/controller/get_state", "/ap/mode_switch"}
    assert allowed()[node].request == (frozenset(requested) if node == "bridge" else frozenset())
