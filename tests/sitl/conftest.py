# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test with a real autopilot in software: `make test-sitl`.

The tests are skipped, with the reason, if the kit cannot run.
"""

import os
from collections.abc import Iterator
from pathlib import Path

import pytest
from tests.sitl.kit import ArduPlane, Px4, missing


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Skip the tests if something is missing.

    The hook of a folder gets the tests of the whole session.
    """
    items_here = [item for item in items if Path(__file__).parent in item.path.parents]
    if items_here and (reason := missing()):
        for item in items_here:
            item.add_marker(pytest.mark.skip(reason=reason))


@pytest.fixture(autouse=True, scope="session")
def domain_of_the_autopilots() -> None:
    """Use domain 0, in which the autopilots are, in networks of their own."""
    os.environ.pop("ROS_DOMAIN_ID", None)


@pytest.fixture(scope="module")
def plane(tmp_path_factory: pytest.TempPathFactory) -> Iterator[ArduPlane]:
    """Yield an ArduPlane in flight, with servos of 0.03 s."""
    autopilot = ArduPlane(tmp_path_factory.mktemp("run"))
    try:
        autopilot.up(SIM_SERVO_SPEED=0.03)
        autopilot.take_off()
        yield autopilot
    finally:
        autopilot.down()


@pytest.fixture(scope="module")
def px4(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Px4]:
    """Yield PX4's airplane in flight.

    Without a stick it goes on, and without an offboard heartbeat it changes to Hold.
    """
    autopilot = Px4(tmp_path_factory.mktemp("run"))
    try:
        autopilot.up(COM_RCL_EXCEPT=7, COM_OBL_RC_ACT=5)
        autopilot.take_off()
        yield autopilot
    finally:
        autopilot.down()
