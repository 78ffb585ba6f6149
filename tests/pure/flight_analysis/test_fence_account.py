# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""What a flight says of its fence: figures, notices, outcome and exit status."""

import numpy as np
import pytest

from flight_analysis.report.account import Account, account_of_json
from flight_analysis.report.flight_outcome import final_outcome
from flight_analysis.report.guided import Outside, orbit_missed_by, time_outside, touched_beside
from flight_core.outcome import (
    COMPLETED,
    INTERRUPTED,
    STATUS_INCOMPLETE,
    STATUS_INTERRUPTED,
    exit_status,
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
LEFT = Outside(2.0, 20.0, left=True)


def flown(*north: float, engaged: int = 0) -> Tape:
    """A pose a second at places to the north; guidance steps from the sample `engaged` on."""
    stamp_ns = np.arange(len(north)) * nanoseconds(1.0)
    pose = Signal(stamp_ns, ("north", "east"), np.column_stack([north, np.zeros(len(north))]))
    steps = Signal(stamp_ns[engaged:], ("mode",), np.zeros((len(north) - engaged, 1)))
    return Tape({"pose": pose, "guidance": steps}, 0)


@pytest.mark.parametrize(
    "north, outside",
    [
        ((0.0, 400.0, 0.0), Outside(0.0, 0.0, left=False)),
        ((490.0, 510.0, 520.0, 490.0), LEFT),
        (
            (520.0, 510.0, 490.0),
            Outside(2.0, 20.0, left=False),
        ),  # which begins outside, and comes inside
        ((520.0, 490.0, 500.5, 400.0), Outside(2.0, 20.0, left=True)),  # a second time
        ((520.0, 540.0), Outside(1.0, 40.0, left=True)),  # ends outside
    ],
)
def test_time_outside_of_fence(north: tuple[float, ...], outside: Outside) -> None:
    assert time_outside(flown(*north), SECTION) == pytest.approx(outside)


def test_time_outside_counts_while_guidance_flies() -> None:
    assert time_outside(flown(600.0, 490.0, 480.0, engaged=1), SECTION) == Outside(
        0.0, 0.0, left=False
    )
    assert time_outside(flown(600.0, 490.0), SECTION.model_copy(update={"fence": {}})) is None
    assert time_outside(Tape({}, 0), SECTION) is None


def test_flight_that_left_its_fence_is_not_completed() -> None:
    of = Account(10.0, {}, (), "", outside=LEFT)
    outcome = final_outcome(COMPLETED, of)
    assert outcome == "completed, outside of the fence for 2.0 s, 20 m at most"
    assert exit_status(outcome) == STATUS_INCOMPLETE
    assert final_outcome(outcome, of) == outcome
    landed = final_outcome("osprey landed at t = 9 s", of)
    assert (landed, exit_status(landed)) == (
        "osprey landed at t = 9 s, outside of the fence for 2.0 s, 20 m at most",
        STATUS_INCOMPLETE,
    )
    assert exit_status(final_outcome(INTERRUPTED, of)) == STATUS_INTERRUPTED
    inside = of._replace(outside=LEFT._replace(left=False))
    assert exit_status(final_outcome(COMPLETED, inside)) == 0


def test_account_of_summary_has_time_outside() -> None:
    content = Account(10.0, {}, (), "").as_json()
    of = account_of_json({"account": content, "guidance": {"legs": [], "fence": LEFT._asdict()}})
    assert of is not None
    assert of.outside == LEFT


def test_notices_say_when_an_aircraft_is_outside() -> None:
    """While the pose is lost, `fence.clearance` is LARGEST: unknown."""
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
    """An orbit of 180 m is joined within a radius of the circle."""
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
    outcome = final_outcome(COMPLETED, Account(10.0, {}, (), off_orbit=720.0))
    assert outcome == "completed, the last orbit not joined: 720 m"
    assert exit_status(outcome) == STATUS_INCOMPLETE
    assert final_outcome(outcome, Account(10.0, {}, ())) == COMPLETED


def test_landing_beside_its_touch_down_zone_says_so() -> None:
    """A zone of 400 by 20 m from the threshold on; the wheels touch 300 m on and 14 m beside."""
    zone = {"north": [0.0, 400.0, 400.0, 0.0], "east": [-10.0, -10.0, 10.0, 10.0]}
    touchdown = ZoneConfig.validate_mapping(zone, "touchdown")
    section = SECTION.model_copy(update={"touchdown": touchdown})
    place = Signal(np.zeros(1, dtype=np.int64), ("north", "east"), np.array([[300.0, 14.0]]))
    beside = touched_beside(Tape({"pose": place}, 0), section)
    assert beside == pytest.approx(4.0)
    assert touched_beside(Tape({"pose": place}, 0), SECTION) == 0.0
    landed = "osprey landed at t = 9 s"
    outcome = final_outcome(landed, Account(10.0, {}, (), beside=beside))
    assert outcome == f"{landed}, outside of the touch-down zone by 4 m"
    assert exit_status(outcome) == STATUS_INCOMPLETE
    assert final_outcome(outcome, Account(10.0, {}, ())) == landed
