# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""A scenario: one file with the parameters of every node, validated section by section and against each other."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import yaml
from pydantic import Field

from aircraft_sim.params import AircraftParameters
from flight_core.parameters import ParameterError, Parameters, require
from flight_core.rates import period_ns
from flight_core.scenario import read_sections
from flight_recorder.params import RecorderParameters
from reference_model.params import ReferenceModelParameters
from rise_di_controller.params import ControllerParameters
from rise_di_controller.rise_di import RiseDiParameters

ParameterOverrides = dict[str, str | float | bool | list[str]]
"""Parameters of one node by name that replace those of its section in the scenario."""


class FlightParameters(Parameters):
    """How to run the scenario."""

    duration: Annotated[float, Field(gt=0, le=1e6)] = Field(description="how long to fly, s")
    lockstep: bool = Field(default=False, description="fly as fast as the machine allows, in lockstep, instead of real time")


@dataclass(frozen=True)
class Scenario:
    """One scenario file, read and validated."""

    name: str
    path: Path
    flight: FlightParameters
    aircraft: AircraftParameters
    reference_model: ReferenceModelParameters
    controller: ControllerParameters
    recorder: RecorderParameters

    def vary(self, **sections: Mapping[str, Any]) -> "Scenario":
        """A copy with some parameters replaced, as in scenario.vary(controller={"rate": 200.0}).

        The copy is validated. Raises ParameterError.
        """
        changed: dict[str, Any] = {
            name: SCHEMAS[name].validate_mapping(getattr(self, name).model_dump() | changes, name)
            for name, changes in sections.items()
        }
        varied = replace(self, **changed)
        check_together(varied)
        return varied

    def rise_di(self) -> RiseDiParameters:
        """The parameters of a controller that flies RISE-DI. Raises ParameterError for another law."""
        if not isinstance(self.controller, RiseDiParameters):
            expected = "rise_di, which has the gains of (20) to (22)"
            raise ParameterError(f"{self.name}: found the law {self.controller.law}, expected {expected}")
        return self.controller

    def gust_windows(self) -> dict[str, tuple[float, float]]:
        """Start and stop of each gust, s: entry and entry + 2 H / V0."""
        speed = self.aircraft.channels().speed
        return {name: (gust.start, gust.start + 2.0 * gust.length / speed) for name, gust in self.aircraft.gusts.items()}


SCHEMAS: dict[str, type[Parameters]] = {
    "flight": FlightParameters,
    "aircraft": AircraftParameters,
    "reference_model": ReferenceModelParameters,
    "controller": ControllerParameters,
    "recorder": RecorderParameters,
}


def load_scenario(path: Path) -> Scenario:
    """Read a scenario file and validate it. Raises ParameterError with one sentence."""
    sections = read_sections(path, tuple(SCHEMAS))
    checked = {name: schema.validate_mapping(sections[name], name) for name, schema in SCHEMAS.items()}
    scenario = Scenario(name=path.stem, path=path, **checked)  # type: ignore[arg-type]  # SCHEMAS says which type each has
    check_together(scenario)
    return scenario


def scenario_yaml(scenario: Scenario, overrides: Mapping[str, Mapping[str, Any]] | None = None) -> str:
    """The text of a scenario file with every parameter, defaults included. `overrides` replace parameters by section.

    A parameter that is None or empty is left out, for that is its default.
    """
    sections = {}
    for name, schema in SCHEMAS.items():
        section: Parameters = getattr(scenario, name)
        merged = schema.validate_mapping(section.model_dump() | dict((overrides or {}).get(name, {})), name)
        # The start time is known only once all nodes run; `truth` holds it.
        sections[f"/**/{name}"] = {"ros__parameters": _yaml_values(merged.model_dump(exclude={"start_time"}))}
    return yaml.safe_dump(sections, sort_keys=False, default_flow_style=None, width=128)


def _yaml_values(values: Any) -> Any:
    """Values with lists for tuples, and without None and empty texts, lists and mappings."""
    if isinstance(values, Mapping):
        converted = {key: _yaml_values(value) for key, value in values.items()}
        return {key: value for key, value in converted.items() if value not in (None, "", [], {})}
    return [_yaml_values(value) for value in values] if isinstance(values, tuple) else values


def check_together(scenario: Scenario) -> None:
    """Check the channels and rates of the sections against each other. Raises ParameterError."""
    channels = scenario.aircraft.channels()
    controller, reference = scenario.controller, scenario.reference_model
    for key, found, expected in (
        ("controller.outputs", controller.outputs, tuple(channels.outputs)),
        ("controller.inputs", controller.inputs, tuple(channels.inputs)),
        ("reference_model.outputs", reference.outputs, tuple(channels.outputs)),
    ):
        require(
            sorted(found) == sorted(expected),
            key,
            ", ".join(found),
            f"the channels of the airframe {scenario.aircraft.airframe} in any order: {', '.join(expected)}",
        )
    control_ns = period_ns(controller.rate, "controller.rate")
    for key, rate in (("aircraft.rate", scenario.aircraft.rate), ("reference_model.rate", reference.rate)):
        divides = control_ns % period_ns(rate, key) == 0
        require(divides, key, f"{rate:g} Hz", f"a whole multiple of controller.rate ({controller.rate:g} Hz)")
