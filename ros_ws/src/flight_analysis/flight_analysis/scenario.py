# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""A scenario: the validated parameters of every node that one file holds, checked against each other."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

from pydantic import Field

from aircraft_sim.params import AircraftParameters
from flight_core.parameters import Parameters, require
from flight_core.rates import period_ns
from flight_core.scenario import read_sections
from flight_recorder.params import RecorderParameters
from reference_model.params import ReferenceModelParameters
from rise_di_controller.params import ControllerParameters


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
        _check_together(varied)
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
    _check_together(scenario)
    return scenario


def _check_together(scenario: Scenario) -> None:
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
