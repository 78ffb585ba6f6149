# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test the map and the scenario of `examples/px4_quadrotor` against PX4's quadrotor.

It changes from Hold to offboard, follows commands, and changes back.
"""

from collections.abc import Iterator

import pytest
from tests.conftest import REPOSITORY
from tests.sitl.kit import HOLD, OFFBOARD, Quadrotor, followed

from flight_analysis.closed_loop.scenario_library import find_scenario
from flight_log.tape_reader import read_run

EXAMPLE = REPOSITORY / "examples" / "px4_quadrotor"
SCENARIO = find_scenario(str(EXAMPLE / "scenario.yaml"))


@pytest.fixture(scope="module")
def quadrotor(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Quadrotor]:
    """Yield PX4's quadrotor in hover.

    Without a stick it goes on, and without an offboard heartbeat it changes to Hold.
    """
    autopilot = Quadrotor(tmp_path_factory.mktemp("run"))
    try:
        autopilot.up(COM_RCL_EXCEPT=7, COM_OBL_RC_ACT=5, MIS_TAKEOFF_ALT=autopilot.hover)
        autopilot.take_off()
        yield autopilot
    finally:
        autopilot.down()


def test_quadrotor_follows_rates_and_vertical_speed(quadrotor: Quadrotor) -> None:
    """The part of y that follows y_m has half to one and a half of its size.

    The limits are those for the airplane, and the ticks replay.
    """
    channel_map = quadrotor.patient_map(str(EXAMPLE / "map.yaml"))
    with quadrotor.engaged(SCENARIO.path, channel_map, SCENARIO.flight.duration) as flight:
        assert quadrotor.state()["nav_state"] == OFFBOARD
        flight.succeed(SCENARIO.flight.duration + 30.0)
        quadrotor.until(lambda state: state["nav_state"] == HOLD, timeout=1.0)
    (engagement,) = quadrotor.summary()["engagements"]
    assert engagement["stop"] is None, engagement["reason"]
    tape = read_run(quadrotor.run).tape
    for name, pulse in SCENARIO.reference_model.pulses.items():
        assert 0.5 < followed(tape, name, pulse.start[0], pulse.stop[-1] + 1.0) < 1.5, name
    quadrotor.start("replay", str(quadrotor.run)).succeed(60.0)
