# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test that a channel may not be named twice: no log and no replay could tell the two apart."""

from collections.abc import Sequence
from typing import Any

import pytest
from tests.conftest import refusing

from flight_analysis.closed_loop.scenario_library import find_scenario
from rise_di_controller.laws import AnyLaw
from rise_di_controller.params import ControllerConfig


def twice(names: Sequence[str]) -> list[str]:
    """Return the names with the last but one repeated in place of the last."""
    return [*names[:-1], names[-2]]


def section(parameters: ControllerConfig, name: str) -> dict[str, Any]:
    return dict(parameters.model_dump()[name])


@pytest.mark.parametrize("scenario", ["osprey_servo", "osprey_observer", "osprey_vanes"])
@pytest.mark.parametrize("key", ["outputs", "inputs"])
def test_output_or_input_named_twice_refused(scenario: str, key: str) -> None:
    parameters = find_scenario(scenario).controller
    names = twice(getattr(parameters, key))
    with refusing(f"controller.{key}: found {', '.join(names)}, expected different names"):
        AnyLaw.validate_mapping(parameters.model_dump() | {key: names}, "controller")


@pytest.mark.parametrize("name", ["observer", "feedforward"])
def test_state_of_a_model_named_twice_refused(name: str) -> None:
    parameters = find_scenario("osprey_observer").controller
    model = section(parameters, name)
    model["states"] = twice(model["states"])
    with refusing(f"controller.{name}.states: found .*, expected different names"):
        AnyLaw.validate_mapping(parameters.model_dump() | {name: model}, "controller")


@pytest.mark.parametrize("law", ["pi", "pid", "l1"])
def test_other_laws_refuse_it_too(law: str) -> None:
    """Every controller has this rule, whichever law it flies."""
    parameters = find_scenario("osprey_servo").controller
    common = {key: getattr(parameters, key) for key in ControllerConfig.model_fields}
    names = twice(parameters.outputs)
    with refusing("outputs: found .*, expected different names"):
        ControllerConfig.validate_mapping(common | {"outputs": names, "law": law}, "controller")


def test_reference_model_refuses_it() -> None:
    model = find_scenario("osprey_servo").reference_model
    names = twice(model.outputs)
    with refusing("reference_model.outputs: found .*, expected different names"):
        type(model).validate_mapping(model.model_dump() | {"outputs": names}, "reference_model")
