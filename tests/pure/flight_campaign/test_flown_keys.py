# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test that a campaign and an environment know each key that they compute.

They compute the aircraft in their own way. A key must be placed here when it is added to a
parameter set.
"""

from typing import Any

import pytest
from tests.conftest import refusing

from aircraft_sim.params import AircraftConfig
from flight_analysis.closed_loop.scenario_library import find_scenario
from flight_campaign.batch.campaign_course import (
    FLOWN,
    FLOWN_CONTROLLER,
    FLOWN_RISE_DI,
    IDLE,
    IDLE_CONTROLLER,
    require_flyable,
)
from flight_core.known_keys import keys_of
from flight_core.parameters import Config
from rise_di.flight_env import BY_TICK, _is_newest_last
from rise_di_controller.rise_di_config import RiseDiConfig

SERVO = find_scenario("osprey_servo")

JSBSIM = {"speed", "altitude", "commands"}
OVER_PLACE = {"over_airspeed"} | {
    key for key in keys_of(AircraftConfig) if key.startswith(("shear.", "microburst."))
}
"""The compiled loop has one wind for all places, and matrices of one airspeed."""
NEWER_THAN_LAST = {"sensors.delay", "sensors.dropout"} | {
    key for key in keys_of(AircraftConfig) if key.startswith(("drift.", "vanes."))
}
"""Beside these an environment measures every sample."""
OF_NODE = {"autostart", "start_active"}
"""A campaign flies a law that is active from the first tick."""
BEYOND_CONTROLLER = (
    OF_NODE
    | {"y_max"}
    | {
        key
        for key in keys_of(RiseDiConfig)
        if key.startswith(("probe.", "learn.", "schedule.slow.", "schedule.fast."))
    }
)


@pytest.mark.parametrize(
    ("schema", "sets"),
    [
        (AircraftConfig, (FLOWN, IDLE, JSBSIM, OVER_PLACE)),
        (RiseDiConfig, (FLOWN_CONTROLLER, FLOWN_RISE_DI, IDLE_CONTROLLER, BEYOND_CONTROLLER)),
        (AircraftConfig, (BY_TICK, NEWER_THAN_LAST, JSBSIM, OVER_PLACE)),
    ],
)
def test_every_key_is_in_one_set(schema: type[Config], sets: tuple[set[str], ...]) -> None:
    """A campaign flies a key, does not need it, or refuses it, so a new key must be placed."""
    placed = [key for part in sets for key in part]
    assert sorted(placed) == sorted(keys_of(schema))


@pytest.mark.parametrize(
    ("section", "values", "name"),
    [
        (
            "aircraft",
            {"shear": {"law": "power", "ground": 0, "reference": 10, "exponent": 0.1}},
            "shear",
        ),
        (
            "aircraft",
            {
                "microburst": {"ground": 0.0, "north": 0.0, "east": 0.0, "radius": 500.0}
                | {"speed": 10.0, "height": 50.0}
            },
            "microburst",
        ),
        ("aircraft", {"over_airspeed": "thrust"}, "over_airspeed"),
        ("controller", {"probe": {}}, "probe"),
        ("controller", {"start_active": False}, "start_active"),
        ("controller", {"autostart": False}, "autostart"),
        ("controller", {"y_max": [0.1, 1.0, 1.0, 1.0]}, "y_max"),
    ],
)
def test_a_campaign_refuses_what_it_does_not_fly(
    section: str, values: dict[str, Any], name: str
) -> None:
    sentence = (
        rf"^{section}\.{name}.*: found .*, expected .*: flights of many at once do not have it"
    )
    with refusing(sentence):
        require_flyable(SERVO.vary(**{section: values}))


def test_a_campaign_refuses_a_key_that_is_new(monkeypatch: pytest.MonkeyPatch) -> None:
    """A key that is in none of the lists of flown keys is refused.

    The quantisation stands for such a new key.
    """
    require_flyable(SERVO)
    new = SERVO.vary(aircraft={"sensors": {"quantisation": [0.01] * 4}})
    require_flyable(new)
    without = FLOWN - {"sensors.quantisation"}
    monkeypatch.setattr("flight_campaign.batch.campaign_course.FLOWN", without)
    with refusing(r"^aircraft\.sensors\.quantisation: found \(0\.01, 0\.01, 0\.01, 0\.01\)"):
        require_flyable(new)


@pytest.mark.parametrize(
    ("values", "expected"),
    [
        ({}, True),
        ({"actuators": {"faults": ["elevator stuck 1"]}}, True),
        ({"sensors": {"dropout": 0.1}}, False),
        ({"sensors": {"delay": 0.01}}, False),
        ({"over_airspeed": "thrust"}, False),
        ({"vanes": {"channels": ["alpha"]}, "sensors": {}}, False),
    ],
)
def test_an_environment_skips_samples_only_where_none_is_missed(
    values: dict[str, Any], expected: bool
) -> None:
    assert _is_newest_last(SERVO.vary(aircraft=values)) is expected
