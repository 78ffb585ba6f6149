# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""What all tests share: the default scenario."""

from pathlib import Path

import pytest
from hypothesis import settings

from flight_analysis.closed_loop.scenario import Scenario
from flight_bringup.scenarios import find_scenario

# How long an example takes says something of the machine, not of what is tested.
settings.register_profile("flight", deadline=None)
settings.load_profile("flight")

REPOSITORY = Path(__file__).resolve().parents[1]


@pytest.fixture(scope="session")
def osprey_gust() -> Scenario:
    """The default scenario."""
    return find_scenario("osprey_gust")
