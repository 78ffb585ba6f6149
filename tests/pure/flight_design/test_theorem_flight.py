# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test Theorem 1 in flight, with the F-4C of the tutorial in an ideal loop.

Its gains meet each condition.
"""

import re
from pathlib import Path

import numpy as np
import pytest
import yaml
from tests.conftest import REPOSITORY

from flight_analysis.closed_loop.scenario import (
    Scenario,
    limits_beyond_stops,
    load_scenario,
    opposite_signs,
)
from flight_analysis.closed_loop.scenario_library import find_scenario
from flight_analysis.closed_loop.simulate import simulate
from flight_analysis.metrics.errors import best_error
from flight_core.vectors import FloatArray
from flight_design.gains import gain_selection, gain_yaml
from flight_design.gains.gain_design import select_gains

pytestmark = pytest.mark.slow

PAGE = (REPOSITORY / "docs/tutorials/theorem.md").read_text()
FILES = dict(re.findall(r"^cat > (\S+) <<'EOF'\n(.*?)^EOF$", PAGE, re.MULTILINE | re.DOTALL))


@pytest.fixture(scope="module")
def selection(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, gain_selection.Selection]:
    """Return the files of the page, and both gain sets for the ideal loop."""
    folder = tmp_path_factory.mktemp("theorem")
    for name, text in FILES.items():
        (folder / name).write_text(text)
    return folder, select_gains(
        folder / "f4c.yaml", "osprey_gust", lag=0.0, delay=0.0, rate=100.0, samples=20
    )


def flown(folder: Path, selected: gain_selection.Selection, rate: float) -> FloatArray:
    """Return the largest errors with the gains of Theorem 1 at a rate in Hz, in the law's order."""
    text = gain_yaml.selection_yaml(selected, theorem=True).replace(
        "rate: 100.0  # Hz", f"rate: {rate}  # Hz"
    )
    path = folder / f"ideal_{rate:g}.yaml"
    path.write_text(FILES["sections.yaml"] + text)
    _, error = best_error(simulate(load_scenario(path)))
    return np.asarray(np.abs(error.values).max(axis=0))


def test_half_the_period_quarters_the_error(
    selection: tuple[Path, gain_selection.Selection], monkeypatch: pytest.MonkeyPatch
) -> None:
    # Second order in the period: a factor of 4. A first order has 2, a third order 8.
    folder, selected = selection
    monkeypatch.chdir(folder)
    assert not [condition for condition in selected.theorem.theorem if not condition.is_met]
    assert "V2_dot" in {condition.name for condition in selected.theorem.theorem}
    ratio = flown(folder, selected, 100.0) / flown(folder, selected, 200.0)
    assert ((ratio > 3.5) & (ratio < 4.5)).all(), ratio


def test_written_gains_are_those_of_the_theorem(
    selection: tuple[Path, gain_selection.Selection],
) -> None:
    _, selected = selection
    text = gain_yaml.selection_yaml(selected, theorem=True)
    section = yaml.safe_load(text)["/**/controller"]["ros__parameters"]
    assert "by Theorem 1" in text
    np.testing.assert_allclose(section["beta"], selected.literal.beta, rtol=1e-5)
    assert section["Lambda"] == [1.0] * 4


def test_signs_against_those_of_the_airframe_is_named() -> None:
    servo: Scenario = find_scenario("osprey_servo")
    assert opposite_signs(servo) == ()
    D = [-sign for sign in servo.controller.D]
    expected = f"controller.D: found {D}, expected {list(servo.controller.D)}, the signs of C B"
    assert opposite_signs(servo.vary(controller={"D": D})) == (expected,)


def test_limits_outside_end_stops_are_named() -> None:
    def beyond(**controller: object) -> tuple[str, ...]:
        servo: Scenario = find_scenario("osprey_servo")
        return limits_beyond_stops(servo.vary(controller=controller))

    assert beyond() == ()
    assert beyond(upper=[0.523599, 0.523599, 0.523599, 0.6]) == (
        "controller.upper of thrust: found 0.6, expected the end stop 0.5 or less far out",
    )
    assert beyond(lower=[-0.4, -0.523599, -0.523599, -0.5]) == ()  # a tighter limit is the user's
    none = beyond(lower=None, upper=None)
    assert len(none) == 8
    assert (
        none[0]
        == "controller.lower of elevator: found -inf, expected the end stop -0.523599 or less "
        "far out"
    )
