# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test the margins of the shipped scenarios and examples.

Behind servos the requirement must be met, or a line of the first comment must say why not.
"""

import math
from collections.abc import Iterator
from pathlib import Path

import pytest
from tests.conftest import REPOSITORY
from tests.other_laws import example_installed

from aircraft_sim.uncertainty import UNIFORM
from flight_analysis.closed_loop.scenario import Scenario
from flight_analysis.closed_loop.scenario_library import LIBRARY, find_scenario
from flight_analysis.linear_loop.loop_margins import LoopMargins, loop_margins, scenario_loop
from rise_di_controller.law.law import Sign
from rise_di_controller.rise_di_config import RiseDiConfig

pytestmark = pytest.mark.slow

CONTROLLER = "/**/controller"
EXAMPLES = [
    path for path in sorted(REPOSITORY.glob("examples/*/*.yaml")) if CONTROLLER in path.read_text()
]
FILES = [*sorted(LIBRARY.glob("*.yaml")), *EXAMPLES]
# How a line of the first comment names a loop without the margins.
STATED = ("An ideal loop", "Margins below the requirement")
NOMINAL, OBSERVED = 40.0, 35.0  # deg
WORST = 28.0  # deg, the worst found in the box: what 30 deg of uniform samples leave at its corners
SENSITIVITY = 2.0


@pytest.fixture(scope="module", autouse=True)
def _example(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    with example_installed(tmp_path_factory.mktemp("installed")):
        yield


@pytest.fixture(scope="module")
def of_loops() -> dict[str, LoopMargins]:
    """Return the margins found so far, by the digest of the loop, which several files share."""
    return {}


def states(path: Path, begin: str) -> bool:
    """Return whether a line of the comments begins with this text."""
    return any(line.startswith(f"# {begin}") for line in path.read_text().splitlines())


def has_softened_loop(scenario: Scenario) -> bool:
    controller = scenario.controller
    return not isinstance(controller, RiseDiConfig) or controller.sampled_sign() is Sign.SOFT


def test_every_file_is_found() -> None:
    assert {"osprey_servo", "osprey_observer", "jsbsim_f16", "scenario", "osprey_pid"} <= {
        path.stem for path in FILES
    }


@pytest.mark.parametrize("path", FILES, ids=[f"{path.parent.name}_{path.stem}" for path in FILES])
def test_margins_of_what_ships(
    path: Path, of_loops: dict[str, LoopMargins], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(REPOSITORY)  # the examples name their airframes from there
    scenario = find_scenario(str(path))
    if not has_softened_loop(scenario):
        assert states(path, STATED[0])
        return
    loop = scenario_loop(scenario, scenario.controller, 1, 0.3, 1, UNIFORM)
    of = of_loops.get(loop.digest) or loop_margins(loop)
    of_loops[loop.digest] = of
    assert of.worst is not None
    nominal, worst = (math.degrees(margins_of.phase.min()) for margins_of in (of.nominal, of.worst))
    needed = NOMINAL if scenario.controller.observer is None else OBSERVED
    meets = nominal >= needed and worst >= WORST and of.nominal.sensitivity.max() <= SENSITIVITY
    result = f"{nominal:.1f} deg, worst {worst:.1f} deg, S {of.nominal.sensitivity.max():.2f}"
    assert meets != states(path, STATED[1]), result
