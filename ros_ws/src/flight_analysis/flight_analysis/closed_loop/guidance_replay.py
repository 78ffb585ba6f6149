# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Recompute every step of guidance that a log contains, to check that the log is complete.

The inputs of a step come from its own sample in the log, and its initial state comes from the
sample before it.
"""

from collections.abc import Iterator, Mapping
from contextlib import suppress
from typing import NamedTuple

import numpy as np

from flight_analysis.closed_loop.replay import ReplayDifference
from flight_core.channels import ATTITUDE
from flight_core.parameters import ParameterError
from flight_core.tape import Tape
from flight_core.vectors import FloatArray
from flight_guidance import guidance, guidance_log
from flight_guidance.guidance_state import Begin, GuidanceState, Inputs, StepCommands
from flight_guidance.notices import FAILED, LINK_AGE
from flight_guidance.params import GuidanceConfig
from flight_guidance.routes.route_file import Waypoint
from flight_guidance.steering.path import Route


class GuidanceReplay(NamedTuple):
    """The result of a replay of guidance: the numbers of checked and of differing steps."""

    steps: int
    checked: int
    differing: int
    first: ReplayDifference | None
    notes: tuple[str, ...]

    def is_equal(self) -> bool:
        """Return whether all checked steps are equal to the log in every bit."""
        return self.differing == 0


def _waypoints(rows: FloatArray) -> list[Waypoint]:
    """Return the waypoints of a route from samples of the topic `route`, (number, *waypoint)."""
    return [Waypoint(*row[1:]) for row in rows.tolist()]


def known_routes(tape: Tape, parameters: GuidanceConfig) -> dict[int, Route]:
    """Return the routes that guidance could fly in this flight, by their digests.

    One route can be in the section `guidance` of the scenario, and further ones on the topic
    `route`. The log of guidance names the route of each step by its digest.
    """
    lists = [list(parameters.waypoints())]
    if "route" in tape:
        received = tape["route"]
        starts = np.flatnonzero(received["number"] == 0.0)[1:]
        lists += [_waypoints(rows) for rows in np.split(received.values, starts)]
    routes = []
    for waypoints in filter(None, lists):
        with suppress(ParameterError):  # guidance refused this route, too
            routes.append(parameters.plan(waypoints))
    return {guidance.digest(route): route for route in routes}


def replay_guidance(tape: Tape, parameters: GuidanceConfig | None) -> GuidanceReplay:
    """Recompute every step of the topic `guidance`, and its u_m, and compare both with the log.

    If a step failed in flight, the replay checks that the state of guidance did not change and that
    the last u_m was published again. A step is not checked if the log lacks its route or the state
    before it. No step is checked if the log is from a version whose topic `guidance` had other
    channels. Raises ParameterError if the log lacks the scenario's section of guidance.
    """
    if parameters is None:
        raise ParameterError("the log: found guidance, expected its section in the scenario too")
    steps = len(tape.time("guidance"))
    if tape["guidance"].names != guidance_log.names(parameters.outputs):
        why = "the log has other channels of guidance"
        return GuidanceReplay(
            steps=steps,
            checked=0,
            differing=0,
            first=None,
            notes=(f"{steps} steps of guidance not checked: {why}",),
        )
    comparison = _Comparison(tape, parameters)
    differences = [*comparison.differences()]
    missing = steps - comparison.checked
    why = "the log does not hold their route, or the state before them"
    notes = [f"{missing} steps of guidance not checked: {why}"] if missing else []
    if comparison.failed:
        notes.append(f"{comparison.failed} steps of guidance failed: the last u_m went on")
    first = next(iter(differences), None)
    return GuidanceReplay(
        steps=steps,
        checked=comparison.checked,
        differing=len(differences),
        first=first,
        notes=tuple(notes),
    )


class _Comparison:
    """Compares the recorded steps of guidance, and their u_m, with computed ones."""

    def __init__(self, tape: Tape, parameters: GuidanceConfig) -> None:
        self.checked = 0
        self.failed = 0
        self._signal = tape["guidance"]
        self._t = tape.time("guidance")
        self._names = self._signal.names
        self._outputs = parameters.outputs
        self._params = parameters.params()
        self._legs = {guidance.digest(None): None} | known_routes(tape, parameters)
        u_m = tape.signals.get("u_m")
        self._published = (
            {} if u_m is None else dict(zip(u_m.stamp_ns.tolist(), u_m.values, strict=True))
        )

    def differences(self) -> Iterator[ReplayDifference]:
        """Yield, for each step that differs from the log, the first channel that differs."""
        previous: GuidanceState | None = None
        failed_before = 0.0
        rows = zip(self._signal.stamp_ns.tolist(), self._signal.values, strict=True)
        for k, (stamp_ns, row) in enumerate(rows):
            channels = dict(zip(self._names, row.tolist(), strict=True))
            inputs, recorded = guidance_log.restored(stamp_ns, channels, self._outputs)
            begins = previous is not None or inputs.begin is Begin.HOLD
            # The log has the count of failed steps. If a failed step has no sample in the log, the
            # count rises at the next step, although this step did not fail. Its filters begin
            # again.
            failed = channels[FAILED]
            goes_on = failed > failed_before and inputs.begin is Begin.NO
            failed_before = failed
            self.failed += goes_on
            if int(channels["route"]) in self._legs and begins:
                self.checked += 1
                computed = self._computed(previous, inputs, channels, goes_on=goes_on)
                u_m = self._published.get(stamp_ns, guidance.u_m(recorded))
                if difference := self._difference(k, np.append(row, u_m), computed):
                    yield difference
            previous = previous if goes_on else recorded

    def _computed(
        self,
        previous: GuidanceState | None,
        inputs: Inputs,
        channels: Mapping[str, float],
        *,
        goes_on: bool,
    ) -> FloatArray:
        """Compute the step that follows the state `previous`, and return its channels and u_m.

        If `goes_on` is True, the step failed in flight, so the result has the state and the u_m of
        the step before.
        """
        route = int(channels["route"])
        if goes_on and previous is not None:
            state, commands = previous, StepCommands()
        else:
            state, commands = guidance.step(previous, inputs, self._legs[route], self._params)
        sample = guidance_log.GuidanceSample(
            inputs=inputs,
            state=state,
            commands=commands,
            route=route,
            link_age=channels[LINK_AGE],
            failed=int(channels[FAILED]),
        )
        return np.append(guidance_log.row(sample, self._outputs), guidance.u_m(state))

    def _difference(
        self, k: int, recorded: FloatArray, computed: FloatArray
    ) -> ReplayDifference | None:
        """Return the first channel of step k whose recorded and computed values differ in a bit."""
        columns = np.flatnonzero(recorded.view(np.int64) != computed.view(np.int64))
        if len(columns) == 0:
            return None
        column = int(columns[0])
        published = (f"published.{name}" for name in (*self._outputs, *ATTITUDE))
        channel = (*self._names, *published)[column]
        return ReplayDifference(
            number=k + 1,
            t=float(self._t[k]),
            channel=channel,
            recorded=float(recorded[column]),
            computed=float(computed[column]),
        )
