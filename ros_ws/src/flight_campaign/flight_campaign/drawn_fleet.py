# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""The drawn aircraft of a campaign as arrays for the compiled loop."""

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from aircraft_sim.uncertainty import drawn_entries, gust_directions, sampled_matrices
from flight_analysis.closed_loop.scenario import Scenario
from flight_campaign import batch, batch_matrices, equipment
from flight_campaign.batch_loop import Vehicle
from flight_campaign.batch_matrices import Fleet
from flight_campaign.benchmark_course import Course
from flight_core.vectors import FloatArray

if TYPE_CHECKING:
    from flight_campaign.campaign import Definition


class DrawnFleet(NamedTuple):
    """Aircraft of a campaign."""

    fleet: Fleet
    vehicle: Vehicle  # with their equipment
    entries: dict[str, FloatArray]  # what was drawn, by name, (N,) each


def drawn_fleet(
    definition: "Definition",
    scenario: Scenario,
    course: Course,
    vehicle: Vehicle,
    first: int,
    count: int,
) -> DrawnFleet:
    """The `count` aircraft of a campaign from number `first`."""
    part = definition.uncertainty
    airframe = scenario.aircraft.nominal_airframe()
    A, B = sampled_matrices(airframe, part, part, definition.seed, first, count, definition.spread)
    directions = gust_directions(airframe, A, definition.wind)
    equipped = definition.drawn_equipment(scenario, first, count)
    late = np.round(equipped.get(equipment.DELAY, np.zeros(1)) / course.period).astype(np.int64)
    fleet = batch_matrices.assemble(
        A, B, scenario.aircraft.plant(), course, late=late, gust_directions=directions
    )
    entries = drawn_entries(airframe, A, B) | equipped
    return DrawnFleet(fleet, batch.with_equipment(vehicle, scenario, equipped), entries)
