# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test the controller's node with another law.

The tests are about a controller that it cannot fly, and about new gains for a law of another
package.
"""

from pathlib import Path
from typing import Any

import pytest
import yaml
from tests.nodes.rise_di_controller.test_controller import Flight
from tests.nodes.world import world_of
from tests.other_laws import SECTIONS, example_installed

from flight_analysis.closed_loop.scenario_library import find_scenario
from flight_core.parameters import ParameterError
from rise_di_controller.node import ControllerNode


def scenario_file(path: Path, controller: dict[str, Any]) -> Path:
    """Return a scenario with another controller."""
    tree = yaml.safe_load(find_scenario("osprey_servo").path.read_text())
    tree["/**/controller"]["ros__parameters"] = controller
    path.write_text(yaml.safe_dump(tree))
    return path


@pytest.mark.parametrize(
    "law, sentence",
    [
        (
            "pid",
            (
                "found 'pid', expected a registered law: excitation, indi, l1, lqg, lqi, "
                "mackunis, pi, rise_di"
            ),
        ),
        (
            "lqi",
            (
                "found 'lqi', which needs the full state, expected a law of y and y_m: the topics "
                "have no more"
            ),
        ),
    ],
)
def test_law_that_controller_cannot_fly_is_one_sentence(
    law: str, sentence: str, tmp_path: Path
) -> None:
    file = scenario_file(tmp_path / "other.yaml", SECTIONS["pid"] | {"law": law})
    with world_of("--params-file", str(file)) as world, pytest.raises(ParameterError) as refused:
        world.make(ControllerNode)
    assert str(refused.value) == f"controller.law: {sentence}"


def test_node_names_law_of_another_package_and_takes_new_gains_of_it_in_flight(
    tmp_path: Path,
) -> None:
    file = scenario_file(tmp_path / "pid.yaml", SECTIONS["pid"])
    with example_installed(tmp_path), world_of("--params-file", str(file)) as world:
        flight = Flight(world).engage()
        assert any("law pid" in line for line in flight.node.log.lines)
        assert flight.set(lead=[0.0, 0.0, 0.0, 0.0]) == (True, "")
        flight.run(0.3)
        digest = flight.column("parameters")
        state = flight.column("integral_e.q")
        assert digest[-1] != digest[0]
        assert state[-1] > state[0] >= 0.0  # the law's own
        assert not flight.set(law="pi")[0]  # at a restart only
