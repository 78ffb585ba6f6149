# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test a landing on a line of the route.

The tests cover refusals, the flare, the alignment of the nose, and the go-around.
"""

import dataclasses
import math
from typing import Any

import numpy as np
import pytest
from pytest import approx
from tests.closed_loop import calm_osprey

from flight_analysis.closed_loop.guidance_replay import replay_guidance
from flight_analysis.closed_loop.scenario import Scenario
from flight_analysis.closed_loop.simulate import simulate
from flight_analysis.report.guided import landing_results, landing_touch
from flight_core.channels import POSE
from flight_core.outcome import End, Outcome
from flight_core.parameters import ParameterError
from flight_core.tape import Tape
from flight_guidance.guidance_state import Lateral
from flight_guidance.modes.landing import flare_climb, time_to_touch
from flight_guidance.modes.modes import holding
from flight_guidance.notices import LEARNED
from flight_guidance.params import GuidanceConfig
from flight_guidance.reach import Authority

GROUND = -40.0  # m; the osprey starts at 0
ROUTE = {
    "north": [0.0, 800.0, 1500.0, 2500.0],
    "east": [0.0, 0.0, 0.0, 0.0],
    "altitude": [0.0, GROUND, 0.0, 0.0],
}


@pytest.fixture(scope="module")
def across() -> Scenario:
    """Return an approach of the osprey in a crosswind of 4 m/s, at 100 Hz."""
    return calm_osprey(37.0, (0.0, 4.0), route=ROUTE, landing={"waypoint": 1})


@pytest.fixture(scope="module")
def approach(across: Scenario) -> Tape:
    return simulate(across)


def section_with(scenario: Scenario, **changes: Any) -> GuidanceConfig:
    section = scenario.vary(guidance=changes).guidance
    assert section is not None
    return section


def low(section: GuidanceConfig, height: float, north: float = 750.0) -> tuple[Any, ...]:
    """Return the lander, the state on the glide path at a height, the pose and the route."""
    route = section.plan(section.waypoints())
    pose = dict.fromkeys(POSE, 0.0) | {"v_north": section.speed, "climb": -1.2}
    pose |= {"north": north, "altitude": GROUND + height}
    state = holding(0, pose, section.speed, section.params())
    lander = section.lander(route)
    assert lander is not None
    return lander, state._replace(lateral=Lateral.ROUTE, leg=0), pose, route


def test_touch_is_soft_on_the_line_and_the_nose_along_it(approach: Tape) -> None:
    pose = approach["pose"]
    touch = int(np.argmax(pose["altitude"] <= GROUND))
    assert touch > 0
    assert 0.3 < -pose["climb"][touch] < 0.8  # m/s: 0.5 is commanded, 2.1 is a hard touch
    assert abs(pose["east"][touch]) < 3.0  # m; a held course ends 14 m beside
    assert abs(math.degrees(pose["psi"][touch])) < 2.0  # the crab is 9 deg
    crabbed = np.searchsorted(pose["altitude"][::-1], GROUND + 3.0)
    row = len(pose["psi"]) - 1 - int(crabbed)
    assert abs(pose["east"][row]) < 0.5  # the leg holds the line
    assert math.degrees(pose["psi"][row]) == approx(-9.2, abs=1.0)  # asin(4 / 25)


def test_landing_is_computed_again_from_the_log(across: Scenario, approach: Tape) -> None:
    assert across.guidance is not None
    replay = replay_guidance(approach, across.guidance)
    assert replay.checked > 1000
    assert replay.differing == 0


def test_figures_of_a_landing(across: Scenario, approach: Tape) -> None:
    assert landing_touch(approach, across.guidance) is None  # it did not land
    landed = dataclasses.replace(approach, outcome=Outcome(End.LANDED))
    touch = landing_touch(landed, across.guidance)
    assert touch is not None
    end = {name: float(approach["pose"][name][-1]) for name in approach["pose"].names}
    assert touch.beside == approx(end["east"])
    assert touch.beyond == approx(end["north"] - 800.0)
    assert touch.V_screen == approx(25.0, abs=0.5)
    assert "m beyond its waypoint" in landing_results(touch._asdict())


def test_flare_sinks_as_commanded_and_touches_in_the_time_said(across: Scenario) -> None:
    section = section_with(across)
    landing = section.landing_on(section.plan(section.waypoints()))
    assert landing is not None
    height = landing.flare
    elapsed = 0.0
    dt = 1e-3
    # Euler's method, without the lag of the flight path.
    while height > 0.0:
        height += dt * flare_climb(height, 1.25, landing)
        elapsed += dt
    assert flare_climb(0.0, 1.25, landing) == -0.5
    assert time_to_touch(landing.flare, 1.25, landing) == approx(elapsed, abs=0.01)


def test_box_ahead_is_flown_to_and_a_missed_box_goes_around(across: Scenario) -> None:
    ahead = {"north": [780.0, 1000.0, 1000.0, 780.0], "east": [-9.0, -9.0, 9.0, 9.0]}
    lander, state, pose, route = low(section_with(across, touchdown=ahead), 4.0)
    assert set(lander.commands(state, pose, route)) == {"climb", "V"}
    passed = ahead | {"north": [650.0, 740.0, 740.0, 650.0]}
    lander, state, pose, route = low(section_with(across, touchdown=passed), 4.0)
    assert lander.commands(state, pose, route) == {"leg": 1.0, "along": 0.0}
    beside = ahead | {"east": [5.0, 5.0, 20.0, 20.0]}
    lander, state, pose, route = low(section_with(across, touchdown=beside), 4.0)
    assert lander.commands(state, pose, route)["leg"] == 1.0
    notices = section_with(across, touchdown=beside).notices()
    unlearned = dict(zip(LEARNED, Authority(), strict=True))
    around = dict.fromkeys(notices.CHANNELS, 0.0) | unlearned | {"leg": 1.0}
    text = "goes around: no touch at the end of leg 0 in guidance.touchdown"
    assert [notice.text for notice in notices.take(1.0, around)] == [text]


@pytest.mark.parametrize("height, around", [(4.0, True), (1.0, False)])
def test_no_go_around_below_the_height_of_the_decrab(
    height: float, around: bool, across: Scenario
) -> None:
    """A metre above the ground, a drift out of the box ends on the ground beside it.

    The aircraft does not climb from there.
    """
    box = {"north": [700.0, 1000.0, 1000.0, 700.0], "east": [5.0, 5.0, 20.0, 20.0]}
    section = section_with(across, touchdown=box)
    lander, state, pose, route = low(section, height)
    landing = section.landing_on(route)
    assert landing is not None
    assert 1.0 < landing.decrab < 4.0
    assert ("leg" in lander.commands(state, pose, route)) is around


def test_lander_waits_above_the_flare_and_leaves_to_an_operator(across: Scenario) -> None:
    lander, state, pose, route = low(section_with(across), 20.0)
    assert lander.commands(state, pose, route) == {}
    lander, state, pose, route = low(section_with(across), 4.0)
    assert lander.commands(state, pose, route)
    lander.leave()
    assert lander.commands(state._replace(leg=1), pose, route) == {}  # a go-around by `leg=1`


@pytest.mark.parametrize(
    "route, landing, sentence",
    [
        ({"east": [0.0, 0.0, 700.0, 700.0]}, {}, "expected a line to it, and one on"),
        ({"altitude": [0.0, 0.0, 0.0, 0.0]}, {}, "expected one that descends"),
        ({}, {"waypoint": 3}, "expected one before the last"),
        ({}, {"V": 5.0}, "landing.V: found 5 m/s, expected 20 to 35 m/s"),
    ],
)
def test_landing_that_cannot_be_flown_is_refused(
    across: Scenario, route: dict[str, Any], landing: dict[str, Any], sentence: str
) -> None:
    with pytest.raises(ParameterError, match=sentence):
        across.vary(guidance={"route": ROUTE | route, "landing": {"waypoint": 1} | landing})
