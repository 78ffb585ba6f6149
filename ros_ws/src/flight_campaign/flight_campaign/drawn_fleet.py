# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Draw the aircraft of a campaign on the host, and convert them to arrays on the device."""

from typing import NamedTuple

import numpy as np

from aircraft_sim.uncertainty import drawn_entries, gust_directions, sampled_matrices
from flight_analysis.closed_loop.scenario import Scenario
from flight_campaign import equipment
from flight_campaign.batch import batch, batch_matrices
from flight_campaign.batch.batch_loop import Vehicle
from flight_campaign.batch.batch_matrices import FleetMatrices
from flight_campaign.batch.campaign_course import Course
from flight_campaign.definition import Definition
from flight_core.vectors import FloatArray


class DrawnFleet(NamedTuple):
    """Drawn aircraft of a campaign, in the memory of the host.

    The host can draw them while the device flies other aircraft.
    """

    scenario: Scenario
    A: FloatArray  # (N, n, n)
    B: FloatArray  # (N, n, m)
    gust_directions: FloatArray  # (N, n, G) effect of wind on x_dot, see `gust_directions`
    equipment: dict[str, FloatArray]  # drawn lags, noise and delays by name, (N,) each

    def on_device(self, course: Course, vehicle: Vehicle) -> tuple[FleetMatrices, Vehicle]:
        """Return the drawn aircraft as the compiled loop takes them, and what all of them share."""
        delay = self.equipment.get(equipment.DELAY, np.zeros(1))
        fleet = batch_matrices.assemble(
            self.A,
            self.B,
            self.scenario.aircraft.plant(),
            course,
            late=np.round(delay / course.period).astype(np.int64),
            gust_directions=self.gust_directions,
        )
        return fleet, batch.with_equipment(vehicle, self.scenario, self.equipment)

    def entries(self) -> dict[str, FloatArray]:
        """Return all drawn values by name, (N,) each."""
        airframe = self.scenario.aircraft.nominal_airframe()
        return drawn_entries(airframe, self.A, self.B) | self.equipment


def drawn_fleet(definition: Definition, scenario: Scenario, first: int, count: int) -> DrawnFleet:
    """Draw `count` aircraft of a campaign, beginning with number `first`."""
    part = definition.uncertainty
    airframe = scenario.aircraft.nominal_airframe()
    A, B = sampled_matrices(
        airframe,
        part_A=part,
        part_B=part,
        seed=definition.seed,
        first=first,
        count=count,
        spread=definition.spread,
    )
    directions = gust_directions(airframe, A, definition.wind)
    equipped = definition.drawn_equipment(scenario, first, count)
    return DrawnFleet(scenario=scenario, A=A, B=B, gust_directions=directions, equipment=equipped)
