# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Fixtures of all tests: the default scenario."""

from pathlib import Path

import pytest
from hypothesis import settings

from flight_analysis.closed_loop.scenario import Scenario
from flight_bringup.scenarios import find_scenario

# The time of an example depends on the host, not on the code under test.
settings.register_profile("flight", deadline=None)
settings.load_profile("flight")

REPOSITORY = Path(__file__).resolve().parents[1]


@pytest.fixture(scope="session")
def osprey_gust() -> Scenario:
    """The default scenario."""
    return find_scenario("osprey_gust")
