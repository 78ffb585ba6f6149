# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test that the page's table of what refuses the section `learn` agrees with the code."""

import re
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from pytest import approx
from tests.conftest import REPOSITORY, refusing

from aircraft_sim.airframes.airframe import load_airframe
from c_export.constants import exportable
from flight_analysis.closed_loop.scenario import load_scenario
from flight_analysis.closed_loop.scenario_library import find_scenario
from flight_bringup.graph import second_stage
from flight_campaign import single_flights
from flight_campaign.comparison import tuning
from flight_design.learning import scenario_learner

PAGE = REPOSITORY / "docs" / "learning.md"


def learning() -> dict[str, Any]:
    """Return the section `learn` of a scenario."""
    section = find_scenario("osprey_learn").rise_di().learn
    assert section is not None
    return section.model_dump()


REFUSALS: dict[str, tuple[Callable[[], Any], str]] = {
    "`rise-di compare`": (
        lambda: tuning.build_benchmark(find_scenario("osprey_learn")),
        r"controller\.learn: found a section, expected none: flights of many at once do not",
    ),
    "`rise-di export` without `--run RUN`": (
        lambda: exportable(find_scenario("osprey_learn").rise_di()),
        r"learn: found a section, expected none: C code replaces no model in flight",
    ),
    "`observer.vanes`": (
        lambda: find_scenario("osprey_vanes").vary(controller={"learn": learning()}),
        r"learn: found observer\.vanes beside it, expected none: a learner designs",
    ),
    "a campaign of JSBSim": (
        lambda: single_flights.require_single_flights(find_scenario("jsbsim_c172p_learn")),
        r"airframe: found jsbsim:c172p, expected an airframe with matrices",
    ),
    "a flight behind a bridge": (
        lambda: second_stage(find_scenario("osprey_learn"), bridge=True),
        r"controller\.learn: found a bridge, expected a simulated aircraft",
    ),
    "`--learn` with an observer": (
        lambda: scenario_learner.that_learns(find_scenario("osprey_observer")),
        r"learn: found an observer, expected none: a scenario of the law alone",
    ),
    "`--learn` of outputs other than q, V, p, r": (
        lambda: scenario_learner.that_learns(
            load_scenario(REPOSITORY / "examples/hexarotor/hexarotor_flight.yaml").vary(
                aircraft={"sensors": {"noise": []}}
            )
        ),
        r"airframe hexarotor: found the outputs q, p, r, w, expected q, V, p, r",
    ),
}


def test_table_has_every_refusal() -> None:
    table = PAGE.read_text().partition("These refuse the section `learn`")[2]
    rows = re.findall(r"^\| (.+?) \| .+ \|$", table, re.MULTILINE)
    assert rows[0] == "refused"
    assert set(rows[1:]) == set(REFUSALS)


@pytest.mark.parametrize("pair", REFUSALS)
def test_row_of_the_table_is_refused(pair: str) -> None:
    refuse, sentence = REFUSALS[pair]
    with refusing(sentence):
        refuse()


def test_learner_beside_an_allocation_sees_the_inputs_of_the_law() -> None:
    vtail = find_scenario("osprey_vtail")
    allocation = vtail.controller.allocation
    assert allocation is not None
    effectors = load_airframe("osprey_vtail")
    rough = scenario_learner.with_law_inputs(effectors, vtail.rise_di())
    T = np.reshape(allocation.T, (len(allocation.effectors), -1))
    columns = [list(effectors.inputs).index(name) for name in allocation.effectors]
    seen = [vtail.controller.inputs.index(name) for name in rough.inputs]
    assert rough.matrix_b() == approx((effectors.matrix_b()[:, columns] @ T)[:, seen])
