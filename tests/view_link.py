# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Provide a flight in the air for the page's control.

It is a log whose recording seems to go on, and nodes in memory behind the `Link`.
"""

import threading
from collections.abc import Mapping, Sequence
from typing import Any

from flight_analysis.closed_loop.scenario import Scenario
from flight_core.outcome import Refusal
from flight_core.parameters import ParameterError, flatten, nest
from flight_view.flight import Flight


class InTheAir(Flight):
    """A recorded flight whose recording seems to go on."""

    def state(self) -> str:
        """Return what the recording does."""
        return "recording"


def in_the_air(flight: Flight) -> Flight:
    """Return the same flight, whose recording seems to go on."""
    other = InTheAir.__new__(InTheAir)
    other.__dict__ = flight.__dict__
    return other


class NodesInMemory:
    """Controller, aircraft, guidance and bridge that keep what they are told."""

    def __init__(self, scenario: Scenario, *names: str, dry_run: bool = True) -> None:
        self.names = list(names)
        self.schemas = {
            "controller": type(scenario.controller),
            "aircraft": type(scenario.aircraft),
        }
        self.values: dict[str, dict[str, Any]] = {
            "controller": dict(flatten(scenario.controller.model_dump(exclude_none=True))),
            "aircraft": dict(flatten(scenario.aircraft.model_dump(exclude_none=True))),
            "bridge": {"map": "maps/plane.yaml", "dry_run": dry_run},
        }
        self.done: list[tuple[str, Any]] = []
        self.notes: list[str] = []
        self.blocked, self.cancelled = threading.Event(), threading.Event()

    def nodes(self) -> list[str]:
        """Return the nodes that run."""
        return self.names

    def keep_link(self) -> None:
        """Do nothing, because no node in memory measures the time."""

    def parameters(self, node: str, names: Sequence[str]) -> dict[str, Any]:
        """Return the parameters that are set."""
        return {name: self.values[node][name] for name in names if name in self.values[node]}

    def set_parameters(self, node: str, values: Mapping[str, Any]) -> Refusal | None:
        """Set the parameters if the whole set is valid, as a node does.

        Otherwise nothing changes.
        """
        try:
            self.schemas[node].validate_mapping(nest(self.values[node] | dict(values)), node)
        except ParameterError as error:
            return Refusal(str(error))
        self.values[node] |= values
        return None

    def _keep(self, name: str, value: Any = None) -> Refusal | None:
        self.done.append((name, value))
        return None

    def activate(self, *, active: bool) -> Refusal | None:
        """Keep the request."""
        return self._keep("activate", active)

    def send_target(self, values: Mapping[str, float]) -> Refusal | None:
        """Keep the target."""
        return self._keep("target", values)

    def send_route(self, points: Sequence[Sequence[float]]) -> Refusal | None:
        """Keep the route."""
        return self._keep("route", points)

    def guide(self, service: str) -> Refusal | None:
        """Keep the request. `skip` is refused."""
        if service == "skip":
            return Refusal("no route with a further leg is flown")
        return self._keep(service)

    def engage(self) -> Refusal | None:
        """Wait until the request is cancelled."""
        self.blocked.set()
        self.cancelled.wait(20.0)
        raise ParameterError("cancelled by a later request")

    def disengage(self) -> Refusal | None:
        """Keep the request."""
        return self._keep("disengage")

    def cancel(self) -> None:
        """End the wait of `engage`."""
        self.cancelled.set()

    def resume(self) -> None:
        """Let `engage` wait again."""
        self.cancelled.clear()

    def note(self, text: str) -> None:
        """Keep the note."""
        self.notes.append(text)
