# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Give the places of all aircraft of a fleet, for the map of a page.

The rest of the page shows the flight of one aircraft.
"""

from collections.abc import Mapping, Sequence
from typing import Any

from flight_core.rates import NANOSECONDS
from flight_log.log_messages import LogMessage
from flight_view.flight import POSE, Flight
from flight_view.series import Series


class FleetView:
    """The poses of several flights, in the form of a single `Flight` with a topic for each."""

    def __init__(self, flights: Sequence[Flight]) -> None:
        self.flights = flights
        self.events: list[LogMessage] = []
        self.bands: Mapping[str, float] = {}
        self.models: Mapping[str, Any] = {}

    @property
    def samples(self) -> dict[str, Series]:
        """The poses by the number of the aircraft, from "0" on."""
        return {
            str(k): flight.samples[POSE]
            for k, flight in enumerate(self.flights)
            if POSE in flight.samples
        }

    @property
    def start_ns(self) -> int:
        """Stamp of flight time 0 of the first aircraft that has begun.

        The stamps of all aircraft are from the same clock.
        """
        return min((flight.start_ns for flight in self.flights if flight.samples), default=0)

    @property
    def description(self) -> dict[str, Any]:
        """The name of each aircraft, and the instant of its flight time 0, s.

        The instant is in the clock of the stamps.
        """
        return {
            "aircraft": [
                [flight.aircraft, flight.start_ns / NANOSECONDS] for flight in self.flights
            ]
        }

    @property
    def described(self) -> int:
        """A number that changes whenever `description` changes."""
        return hash(tuple(map(tuple, self.description["aircraft"])))

    def state(self) -> str:
        """Return an empty text, because each flight has its own state."""
        return ""

    def faults(self) -> list[str]:
        """Return an empty list, because each flight has its own faults."""
        return []
