# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Replay of guidance: every step computed again from the logged inputs and the state of the sample
before.
"""

from contextlib import suppress
from typing import NamedTuple

import numpy as np

from flight_analysis.closed_loop.replay import Difference
from flight_core.channels import ATTITUDE
from flight_core.parameters import ParameterError
from flight_core.tape import Tape
from flight_core.vectors import FloatArray
from flight_guidance import guidance, modes
from flight_guidance.guidance_state import Begin, GuidanceState, Lateral
from flight_guidance.notices import LINK_AGE
from flight_guidance.params import GuidanceConfig
from flight_guidance.path import Route
from flight_guidance.route_file import Waypoint


class GuidanceReplay(NamedTuple):
    """The steps of `guidance` as recorded and as computed; u_m is among their channels."""

    steps: int
    checked: int
    differing: int
    first: Difference | None
    notes: tuple[str, ...]

    def equal(self) -> bool:
        """Whether every checked bit is equal."""
        return self.differing == 0


def _waypoints(rows: FloatArray) -> list[Waypoint]:
    """The waypoints of a route from its messages, a row each."""
    return [Waypoint(*row[1:]) for row in rows.tolist()]


def known_routes(tape: Tape, parameters: GuidanceConfig) -> dict[int, Route]:
    """The route of the section and the routes of the topic `route`, by digest, as `guidance` logs
    them.
    """
    lists = [list(parameters.waypoints())]
    if "route" in tape:
        received = tape["route"]
        starts = np.flatnonzero(received["number"] == 0.0)[1:]
        lists += [_waypoints(rows) for rows in np.split(received.values, starts)]
    routes = []
    for waypoints in filter(None, lists):
        with suppress(ParameterError):  # guidance has refused it, too
            routes.append(parameters.plan(waypoints))
    return {guidance.digest(route): route for route in routes}


def replay_guidance(tape: Tape, parameters: GuidanceConfig | None) -> GuidanceReplay:
    """Compute every step of the topic `guidance` again, and the published u_m of the instant.

    Steps on a route outside the log are not checked, nor steps with the channels of a different
    version; a log may lack `guidance.ADDED`; without `guidance.HEADING` the steps that hold a
    heading are not checked. Raises ParameterError for a log without the scenario's section of
    guidance.
    """
    if parameters is None:
        raise ParameterError("the log: found guidance, expected its section in the scenario too")
    signal = tape["guidance"]
    t = tape.time("guidance")
    outputs = parameters.outputs
    names = signal.names
    if (
        tuple(
            name for name in guidance.names(outputs) if name in names or name not in guidance.ADDED
        )
        != names
    ):
        why = "a different version recorded their channels"
        return GuidanceReplay(
            len(t), 0, 0, None, (f"{len(t)} steps of guidance not checked: {why}",)
        )
    legs = {guidance.digest(None): None} | known_routes(tape, parameters)
    published = (
        {}
        if "u_m" not in tape
        else dict(zip(tape["u_m"].stamp_ns.tolist(), tape["u_m"].values, strict=True))
    )
    recorded_of = [name in names for name in guidance.names(outputs)]
    params = parameters.params()
    checked = 0
    differing = 0
    first: Difference | None = None
    previous: GuidanceState | None = None
    for k, (stamp_ns, row) in enumerate(zip(signal.stamp_ns.tolist(), signal.values, strict=True)):
        inputs, recorded = guidance.restored(
            stamp_ns, dict(zip(names, row.tolist(), strict=True)), outputs
        )
        flown = int(row[names.index("route")])
        without_heading = recorded.lateral is Lateral.HEADING and guidance.HEADING not in names
        if (
            flown in legs
            and not without_heading
            and (previous is not None or inputs.begin is Begin.HOLD)
        ):
            checked += 1
            link_age = row[names.index(LINK_AGE)] if LINK_AGE in names else 0.0
            state, commands = modes.step(previous, inputs, legs[flown], params)
            both = (
                np.append(row, published.get(stamp_ns, guidance.u_m(recorded))),
                np.append(
                    guidance.row(inputs, state, commands, flown, link_age)[recorded_of],
                    guidance.u_m(state),
                ),
            )
            columns = np.flatnonzero(both[0].view(np.int64) != both[1].view(np.int64))
            if len(columns):
                differing += 1
                column = int(columns[0])
                channel = (*names, *(f"published.{name}" for name in (*outputs, *ATTITUDE)))[column]
                first = first or Difference(
                    k + 1, float(t[k]), channel, float(both[0][column]), float(both[1][column])
                )
        previous = recorded
    missing = len(t) - checked
    why = "the log does not hold their route, or the state before them"
    notes = (f"{missing} steps of guidance not checked: {why}",) if missing else ()
    return GuidanceReplay(len(t), checked, differing, first, notes)
