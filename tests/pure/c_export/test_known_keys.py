# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test the keys of the C code, which is a second controller and has their constants."""

import pytest
from tests.conftest import refusing

from c_export.constants import IDLE_IN_C, IN_C, exportable
from flight_analysis.closed_loop.scenario_library import find_scenario
from flight_core.known_keys import keys_of
from rise_di_controller.rise_di_config import RiseDiConfig

BEYOND_C = {
    key
    for key in keys_of(RiseDiConfig)
    if key.startswith(("learn.", "probe.", "observer.vanes.", "schedule.slow.", "schedule.fast."))
} | {"feedforward.inputs"}


def test_every_key_is_in_one_set() -> None:
    """A new key is in the C code, is not needed there, or is refused."""
    assert sorted([*IN_C, *IDLE_IN_C, *BEYOND_C]) == sorted(keys_of(RiseDiConfig))


@pytest.mark.parametrize(
    ("scenario", "key"),
    [
        ("osprey_vanes", r"observer\.vanes"),
        ("osprey_learn_speeds", "learn"),
        ("osprey_learn", "learn"),
    ],
)
def test_a_key_that_the_c_code_does_not_know_is_refused_by_name(scenario: str, key: str) -> None:
    with refusing(rf"^controller\.{key}: found a section, expected none: "):
        exportable(find_scenario(scenario).controller)


def test_a_key_that_is_new_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    controller = find_scenario("osprey_servo").vary(controller={"slew": [5.0] * 4}).controller
    exportable(controller)
    monkeypatch.setattr("c_export.constants.IN_C", IN_C - {"slew"})
    with refusing(
        r"^controller\.slew: found \(5\.0, 5\.0, 5\.0, 5\.0\), expected none: the C code"
    ):
        exportable(controller)
