# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""A recorded flight: what figures, tables, exports and comparisons are made of."""

from typing import Any, NamedTuple

from flight_analysis.closed_loop.scenario import Scenario
from flight_core.rates import period_ns
from flight_core.tape import Tape


class RecordedFlight(NamedTuple):
    """A flight under the name of its run."""

    name: str
    scenario: Scenario
    tape: Tape
    summary: dict[str, Any]  # `summary.summarise`

    @property
    def period_ns(self) -> int:
        """Period of the controller's ticks, ns."""
        return period_ns(self.scenario.controller.rate, "controller.rate")
