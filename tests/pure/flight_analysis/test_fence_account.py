# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test what a flight tells about its fence, altitudes and places, as figures and notices."""

import numpy as np
import pytest
from tests.closed_loop import calm_osprey
from tests.conftest import refusing

import rise_di
from flight_analysis.report.guided import (
    Outside,
    altitude_excess,
    orbit_missed_by,
    time_outside,
    touched_beside,
)
from flight_core.rates import nanoseconds
from flight_core.tape import Signal, Tape
from flight_guidance.guidance import digest
from flight_guidance.guidance_state import LARGEST, Lateral
from flight_guidance.notices import Notices
from flight_guidance.params import GuidanceConfig
from flight_guidance.sections import RouteConfig, ZoneConfig

SECTION = GuidanceConfig.validate_mapping(
    {
        "natural_frequency": [4.0, 1.2, 5.0, 4.0],
        "speed": 25.0,
        "fence": {
            "field": {
                "north": [-500.0, 500.0, 500.0, -500.0],
                "east": [-500.0, -500.0, 500.0, 500.0],
            }
        },
    },
    "guidance",
)


def flown(*north: float, engaged: int = 0) -> Tape:
    """Return a flight with one pose per second at the given places to the north.

    The topic of guidance begins with the sample `engaged`.
    """
    stamp_ns = np.arange(len(north)) * nanoseconds(1.0)
    pose = Signal(stamp_ns, ("north", "east"), np.column_stack([north, np.zeros(len(north))]))
    steps = Signal(stamp_ns[engaged:], ("mode",), np.zeros((len(north) - engaged, 1)))
    return Tape({"pose": pose, "guidance": steps}, 0)


@pytest.mark.parametrize(
    "north, outside",
    [
        ((0.0, 400.0, 0.0), Outside(0.0, 0.0)),
        ((490.0, 510.0, 520.0, 490.0), Outside(2.0, 20.0)),
        # The flight begins outside, and comes inside.
        (
            (520.0, 510.0, 490.0),
            Outside(2.0, 20.0),
        ),
        ((520.0, 490.0, 500.5, 400.0), Outside(2.0, 20.0)),  # a second time
        ((520.0, 540.0), Outside(1.0, 40.0)),  # ends outside
    ],
)
def test_time_outside_of_fence(north: tuple[float, ...], outside: Outside) -> None:
    assert time_outside(flown(*north), SECTION) == pytest.approx(outside)


def test_time_outside_counts_while_guidance_flies() -> None:
    assert time_outside(flown(600.0, 490.0, 480.0, engaged=1), SECTION) == Outside(0.0, 0.0)
    assert time_outside(flown(600.0, 490.0), SECTION.model_copy(update={"fence": {}})) is None
    assert time_outside(Tape({}, 0), SECTION) is None


def test_true_pose_tells_where_the_simulation_knows_it() -> None:
    """The true pose is used where the simulation has it, because the measured one is 30 m off."""
    measured = flown(490.0, 490.0, 490.0)
    north = 520.0 * np.ones(3)
    height = np.zeros(3)
    truth = Signal(
        measured["pose"].stamp_ns,
        ("t", "pose.north", "pose.east", "pose.altitude"),
        np.column_stack([np.arange(3.0), north, height, height - 15.0]),
    )
    tape = Tape(dict(measured.signals) | {"truth": truth}, 0)
    assert time_outside(tape, SECTION) == Outside(2.0, 20.0)
    floor = SECTION.model_copy(update={"altitude_floor": -10.0})
    assert altitude_excess(tape, floor) == Outside(2.0, 5.0)
    zone = ZoneConfig(north=(480.0, 500.0, 500.0, 480.0), east=(-10.0, -10.0, 10.0, 10.0))
    landing = SECTION.model_copy(update={"touchdown": zone})
    assert touched_beside(tape, landing) == pytest.approx(20.0)
    assert touched_beside(measured, landing) == 0.0


def test_aircraft_with_a_pose_that_is_off_leaves_its_lane() -> None:
    """Guidance tracks the measured line, which is 40 m beside the true one in a lane of 60 m."""
    lane = ZoneConfig(north=(-50.0, 900.0, 900.0, -50.0), east=(-30.0, -30.0, 30.0, 30.0))
    route = {"north": [0.0, 800.0, 1600.0], "east": [0.0] * 3, "altitude": [0.0] * 3}
    scenario = calm_osprey(15.0, route=route)
    assert scenario.guidance is not None
    section = scenario.guidance.model_copy(update={"fence": {"lane": lane}})
    assert time_outside(rise_di.simulate(scenario), section) == Outside(0.0, 0.0)
    off = rise_di.simulate(scenario.vary(aircraft={"pose": {"bias": {"east": 40.0}}}))
    outing = time_outside(off, section)
    assert outing is not None
    assert outing.farthest_m > 5.0


def test_time_outside_of_altitudes() -> None:
    section = SECTION.model_copy(update={"altitude_floor": -10.0, "ceiling": 25.0})
    stamp_ns = np.arange(5) * nanoseconds(1.0)
    altitude = np.array([[0.0], [30.0], [20.0], [-25.0], [0.0]])
    pose = Signal(stamp_ns, ("altitude",), altitude)
    steps = Signal(stamp_ns, ("mode",), np.zeros((5, 1)))
    tape = Tape({"pose": pose, "guidance": steps}, 0)
    assert altitude_excess(tape, section) == Outside(2.0, 15.0)
    assert altitude_excess(tape, SECTION) is None


def test_home_lies_between_the_altitudes() -> None:
    values = {"natural_frequency": [4.0, 1.2, 5.0, 4.0], "speed": 25.0, "ceiling": 25.0}
    with refusing("guidance.home.altitude: found 60 m, expected -inf to 25 m"):
        GuidanceConfig.validate_mapping(values | {"home": {"altitude": 60.0}}, "guidance")


def test_notices_say_when_an_aircraft_is_outside() -> None:
    """While the pose is lost, `fence.clearance` is LARGEST, which means unknown."""
    notices = Notices(0.0, 0.2, lambda speed: 100.0)
    log = dict.fromkeys(Notices.CHANNELS, 0.0)
    texts = [
        notice.text
        for t, clearance in enumerate((5.0, -5.0, LARGEST, -300.0, -20.0, 3.0, 50.0))
        for notice in notices.take(float(t), log | {"fence.clearance": clearance, "V_c": 25.0})
    ]
    assert texts == [
        "outside of the fence: the shortest way inside, then home",
        "inside of the fence after 4.0 s outside, 300 m at most",
    ]


def test_flight_that_ends_far_from_its_last_orbit_is_not_completed() -> None:
    """An orbit of 180 m counts as joined within one radius of the circle."""
    route = {"north": [0.0, 1000.0], "east": [0.0, 0.0], "altitude": [0.0, 0.0]}
    section = SECTION.model_copy(
        update={"fence": {}, "route": RouteConfig.validate_mapping(route, "route"), "radius": 180}
    )
    planned = section.plan(section.waypoints())
    names = ("mode.lateral", "joining", "leg", "route", "xtrack")

    def off(distance: float, leg: int = len(planned.legs) - 1) -> float:
        values = np.array([[float(Lateral.ROUTE), 0.0, leg, float(digest(planned)), distance]])
        return orbit_missed_by(
            Tape({"guidance": Signal(np.zeros(1, dtype=np.int64), names, values)}, 0), section
        )

    assert (off(-720.0), off(170.0), off(190.0), off(720.0, 0)) == (720.0, 0.0, 190.0, 0.0)


def test_landing_beside_its_touch_down_zone_says_so() -> None:
    """The zone begins at the threshold and is 400 m long and 20 m wide.

    The wheels touch after 300 m, 14 m beside the centre line.
    """
    zone = {"north": [0.0, 400.0, 400.0, 0.0], "east": [-10.0, -10.0, 10.0, 10.0]}
    touchdown = ZoneConfig.validate_mapping(zone, "touchdown")
    section = SECTION.model_copy(update={"touchdown": touchdown})
    place = Signal(np.zeros(1, dtype=np.int64), ("north", "east"), np.array([[300.0, 14.0]]))
    distance = touched_beside(Tape({"pose": place}, 0), section)
    assert distance == pytest.approx(4.0)
    assert touched_beside(Tape({"pose": place}, 0), SECTION) == 0.0
