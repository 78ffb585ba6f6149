# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Define a campaign: everything on which its results depend."""

from collections.abc import Iterator
from itertools import product
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from aircraft_sim.uncertainty import (
    Distribution,
    Spread,
    WindEffect,
)
from flight_analysis.closed_loop.scenario import Scenario, scenario_of
from flight_campaign import equipment
from flight_campaign.engines import Job
from flight_campaign.statistics import score, score_units
from flight_core.fields import Field
from flight_core.parameters import Config, Positive, Positives, require
from flight_core.vectors import FloatArray
from rise_di_controller.params import ControllerConfig


def swept_parameters(controller: ControllerConfig) -> list[str]:
    """Return the parameters that a sweep may multiply: numbers of the law and input_scale."""
    names = [
        name for name in type(controller).model_fields if name not in ControllerConfig.model_fields
    ]
    values = ((name, np.atleast_1d(getattr(controller, name))) for name in names)
    return [*(name for name, value in values if value.dtype == np.float64), "input_scale"]


class Sweep(Config):
    """Factors on one parameter of the controller, or on its value in one channel.

    Every aircraft flies once with each factor.
    """

    parameter: str = Field(
        description="its name, as in beta, or with a channel of y or u, as in beta[V]"
    )
    factors: Positives

    @property
    def name(self) -> str:
        """Name of the parameter, without the channel."""
        return self.parameter.partition("[")[0]

    def scaled(self, controller: ControllerConfig, factor: float) -> float | tuple[float, ...]:
        """Multiply the swept parameter by a factor, or only its value in a channel that is named.

        If the channel is an input, the value for the paired output is returned. Raises
        ParameterError if the parameter or the channel cannot be swept.
        """
        swept = swept_parameters(controller)
        require(
            self.name in swept,
            "sweep",
            self.parameter,
            f"a parameter of the controller: {', '.join(swept)}",
        )
        value = getattr(controller, self.name)
        if self.name == self.parameter:
            if isinstance(value, tuple):
                return tuple(factor * number for number in value)
            return factor * float(value)
        m = len(controller.outputs)
        # k_d of (22) has no value for the last channel
        by_channel = isinstance(value, tuple) and len(value) in (m - 1, m)
        require(
            by_channel, "sweep", self.parameter, f"{self.name}: it does not have a value a channel"
        )
        values = [
            *enumerate(controller.outputs[: len(value)]),
            *enumerate(controller.inputs[: len(value)]),
        ]
        places = [k for k, name in values if f"{self.name}[{name}]" == self.parameter]
        names = ", ".join(name for _, name in values)
        require(
            bool(places), "sweep", self.parameter, f"{self.name}[CHANNEL], CHANNEL one of {names}"
        )
        return tuple(
            factor * number if k == places[0] else number for k, number in enumerate(value)
        )


class Definition(Config):
    """Everything on which the results of a campaign depend.

    The version of the stack and the arithmetic of the CPU are no part of the definition.
    """

    name: str  # name of the scenario
    sections: dict[str, dict[str, object]]  # sections of the scenario with all parameters
    aircraft: int = Field(ge=1, le=2**32, description="how many aircraft fly")
    uncertainty: float = Field(
        ge=0, lt=1, description="the largest relative deviation of an entry of A and of B"
    )
    wind: WindEffect = Field(
        description="whose A the wind acts through: each aircraft's own, or the airframe's"
    )
    seed: int = Field(ge=0, lt=2**63, description="the seed of the aircraft")
    chunk: int = Field(ge=1, le=1_000_000, description="how many aircraft fly at once")
    sweep: Sweep | None = None
    entries: dict[str, Annotated[float, Field(ge=0, lt=1)]] = Field(
        default={},
        description="the largest relative deviation of entries that have their own, by name",
    )
    distribution: Distribution = Field(
        default="uniform", description="how the deviations are distributed, up to the largest"
    )
    score_units: dict[str, Positive] = Field(
        default={},
        description="units of rms errors in the score by output, SI, that differ from the usual",
    )

    @property
    def spread(self) -> Spread:
        """Distribution from which the entries of A and B are drawn."""
        return Spread(equipment.matrix_entries(self.entries), self.distribution)

    def drawn_equipment(self, scenario: Scenario, first: int, count: int) -> dict[str, FloatArray]:
        """Draw the lags, noise and delays of the aircraft in a case, as `equipment.drawn` does."""
        return equipment.drawn(
            scenario, Spread(self.entries, self.distribution), self.seed, first, count
        )

    def scenario(self, case: int = 0) -> Scenario:
        """Return the scenario of a case of the sweep, with the published airframe."""
        scenario = scenario_of(self.name, Path(self.name), self.sections)
        if self.sweep is None:
            return scenario
        controller = self.sweep.scaled(scenario.controller, self.factor(case))
        return scenario.vary(controller={self.sweep.name: controller})

    def aircraft_scenario(self, number: int, case: int = 0) -> Scenario:
        """Return the scenario of one aircraft of the campaign, which `rise-di fly` can fly."""
        uncertainty: dict[str, Any] = {
            "A": self.uncertainty,
            "B": self.uncertainty,
            "wind": self.wind,
            "seed": self.seed,
            "number": number,
        }
        entries = self.spread.entries
        scenario = self.scenario(case)
        uncertainty |= {
            "entries": [*entries],
            "parts": [*entries.values()],
            "distribution": self.distribution,
        }
        equipment_values = self.drawn_equipment(scenario, number, 1)
        equipped = equipment.scenario_with_equipment(
            scenario, {name: float(value[0]) for name, value in equipment_values.items()}
        )
        return equipped.vary(aircraft={"uncertainty": uncertainty})

    def score(self, rms: FloatArray) -> FloatArray:
        """Return the scores of N aircraft, (N,), from their rms errors, (m, N)."""
        scenario = self.scenario()
        units = scenario.aircraft.channels().outputs
        return score(rms, score_units(scenario.controller.outputs, units, self.score_units))

    @property
    def cases(self) -> int:
        """Number of cases, which is the number of flights of each aircraft."""
        return 1 if self.sweep is None else len(self.sweep.factors)

    def factor(self, case: int) -> float:
        """Factor of the swept parameter in a case."""
        return 1.0 if self.sweep is None else self.sweep.factors[case]

    def label(self, case: int) -> str:
        """Return the name of a case in tables."""
        return (
            self.name if self.sweep is None else f"{self.sweep.parameter} x {self.factor(case):g}"
        )

    def size(self, job: Job) -> int:
        """Return the number of aircraft in a chunk."""
        return min(self.chunk, self.aircraft - job[1] * self.chunk)

    def jobs(self) -> Iterator[Job]:
        """Yield the chunks of all cases, each as (case, chunk)."""
        chunks = -(-self.aircraft // self.chunk)
        return product(range(self.cases), range(chunks))
