# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""A scenario: the validated parameters of every node that one file holds, checked against each other."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import yaml
from pydantic import Field

from aircraft_sim.params import AircraftParameters
from flight_core.parameters import Parameters, require
from flight_core.rates import period_ns
from flight_core.scenario import read_sections
from flight_recorder.params import RecorderParameters
from reference_model.params import ReferenceModelParameters
from rise_di_controller.params import ControllerParameters

ParameterOverrides = dict[str, str | float | bool | list[str]]
"""Parameters of one node, by name, over those of its section in the scenario."""


class FlightParameters(Parameters):
    """What whoever runs the scenario needs to know."""

    duration: Annotated[float, Field(gt=0, le=1e6)] = Field(description="how long to fly, s")
    lockstep: bool = Field(default=False, description="fly as fast as the machine allows, in lockstep, instead of real time")


@dataclass(frozen=True)
class Scenario:
    """One scenario file, read and checked."""

    name: str
    path: Path
    flight: FlightParameters
    aircraft: AircraftParameters
    reference_model: ReferenceModelParameters
    controller: ControllerParameters
    recorder: RecorderParameters

    def vary(self, **sections: Mapping[str, Any]) -> "Scenario":
        """Replace some parameters of some sections, as in scenario.vary(controller={"rate": 200.0}).

        Everything is checked again. Raises ParameterError.
        """
        changed: dict[str, Any] = {
            name: SCHEMAS[name].validate_mapping(getattr(self, name).model_dump() | changes, name)
            for name, changes in sections.items()
        }
        varied = replace(self, **changed)
        check_together(varied)
        return varied

    def gust_windows(self) -> dict[str, tuple[float, float]]:
        """From when to when each gust blows, s: entry to entry + 2 H / V0."""
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
    """Read a scenario file and check each section alone and all of them together. Raises ParameterError with one sentence."""
    sections = read_sections(path, tuple(SCHEMAS))
    checked = {name: schema.validate_mapping(sections[name], name) for name, schema in SCHEMAS.items()}
    scenario = Scenario(name=path.stem, path=path, **checked)  # type: ignore[arg-type]  # SCHEMAS says which type each has
    check_together(scenario)
    return scenario


def scenario_yaml(scenario: Scenario, told: Mapping[str, Mapping[str, Any]] | None = None) -> str:
    """A scenario as the text of a file with every parameter in it, those by default too, but for what `told` says otherwise.

    What is none or empty is left out: it is so by default.
    """
    sections = {}
    for name, schema in SCHEMAS.items():
        given: Parameters = getattr(scenario, name)
        flown = schema.validate_mapping(given.model_dump() | dict((told or {}).get(name, {})), name)
        # The instant of t = 0 is not known before all nodes run; `truth` says it.
        sections[f"/**/{name}"] = {"ros__parameters": _plain(flown.model_dump(exclude={"start_time"}))}
    return yaml.safe_dump(sections, sort_keys=False, default_flow_style=None, width=128)


def _plain(values: Any) -> Any:
    """Values as YAML knows them, without those that stand for nothing: None, and empty texts, lists and mappings."""
    if isinstance(values, Mapping):
        plain = {key: _plain(value) for key, value in values.items()}
        return {key: value for key, value in plain.items() if value not in (None, "", [], {})}
    return [_plain(value) for value in values] if isinstance(values, tuple) else values


def check_together(scenario: Scenario) -> None:
    """Check the sections of a scenario against each other. Raises ParameterError."""
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
