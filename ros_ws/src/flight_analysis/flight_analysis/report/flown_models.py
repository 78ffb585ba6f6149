# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""The parameters of the controller that flew, with the linear loops.

A loop is around the aircraft of the file, or around the true aircraft of a simulation.
"""

import re
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from aircraft_sim.airframes.airframe import Airframe, load_airframe
from flight_analysis.closed_loop.replay_ticks import Change, vary
from flight_analysis.closed_loop.scenario import Scenario
from flight_analysis.linear_loop.loop_margins import (
    LinearLoop,
    distribution,
    linear_loop,
    scenario_loop,
    through_allocation,
)
from flight_analysis.report.model_spans import parameter_spans
from flight_analysis.report.sample_counts import is_simulated
from flight_core.parameters import ParameterError
from flight_core.tape import Tape
from rise_di_controller.params import ControllerConfig

ENTRY = re.compile(r"([AB])\[(.+), (.+)\]")  # as in the topic `learned`
FILE = "file"
TRUE = "true"


class FlownController(NamedTuple):
    """The parameters of a controller, and when they flew: first and last instants, s."""

    name: str  # "start", "file", "model 1"
    spans: tuple[tuple[float, float], ...]
    controller: ControllerConfig

    @property
    def times(self) -> str:
        """The spans as text, in s."""
        return ", ".join(f"{start:.1f} to {stop:.1f}" for start, stop in self.spans)


class FlownLoop(NamedTuple):
    """The linear loop of flown parameters, around an aircraft."""

    name: str  # of the parameters; empty for those of the whole flight
    times: str  # of the parameters, s
    aircraft: str  # FILE or TRUE
    loop: LinearLoop


def flown_controllers(
    tape: Tape, start: ControllerConfig, changes: Sequence[Change]
) -> tuple[FlownController, ...]:
    """The parameters that flew in order: of the start and after the changes in flight.

    The digests of the ticks tell them.
    """
    by_digest = {start.digest(): start}
    latest = start
    for change in changes:
        latest = vary(latest, change)
        by_digest[latest.digest()] = latest
    spans: dict[tuple[str, int], list[tuple[float, float]]] = {}
    for span in parameter_spans(tape):
        spans.setdefault((span.name, span.digest), []).append((span.start, span.stop))
    return tuple(
        FlownController(name, tuple(times), by_digest[digest])
        for (name, digest), times in spans.items()
        if digest in by_digest
    )


def flown_loops(
    tape: Tape, scenario: Scenario, controllers: Sequence[FlownController]
) -> list[FlownLoop]:
    """The linear loops of a flight; none without a linear model."""
    loops = []
    airframe = true_airframe(tape, scenario)
    parameter_sets = [(each.name, each.times, each.controller) for each in controllers]
    for name, times, controller in parameter_sets or [("", "", scenario.controller)]:
        try:
            around_file = scenario_loop(scenario, controller)
            loops.append(FlownLoop(name, times, FILE, around_file))
            if airframe is not None:
                loops.append(FlownLoop(name, times, TRUE, _loop_around(airframe, controller)))
        except ParameterError:
            continue
    return loops


def true_airframe(tape: Tape, scenario: Scenario) -> Airframe | None:
    """The simulated airframe before a drift, where unlike the file; else None."""
    aircraft = scenario.aircraft
    uncertainty = aircraft.uncertainty
    differs = uncertainty.A > 0.0 or uncertainty.B > 0.0 or bool(uncertainty.entries)
    if aircraft.is_jsbsim or not differs or not is_simulated(tape):
        return None
    return aircraft.sampled_airframe()


def _loop_around(airframe: Airframe, controller: ControllerConfig) -> LinearLoop:
    airframe_of_law = through_allocation(airframe, controller)
    B = airframe.matrix_b() @ distribution(airframe, controller)
    return linear_loop(controller, airframe_of_law, airframe.matrix_a()[None], B[None])


def learned_lines(tape: Tape, scenario: Scenario) -> dict[str, dict[str, float]]:
    """The values of the entries in the topic `learned`, SI.

    The file has values, and the true aircraft where a simulation flew. Empty for an aircraft of
    JSBSim.
    """
    if "learned" not in tape or scenario.aircraft.is_jsbsim:
        return {}
    airframe = load_airframe(scenario.aircraft.airframe)
    airframes = {FILE: airframe}
    if is_simulated(tape):
        airframes = {TRUE: true_airframe(tape, scenario) or airframe, FILE: airframe}
    names = tape["learned"].group("value").names
    lines = {}
    for label, each in airframes.items():
        values = {name: _entry(each, name) for name in names}
        lines[label] = {name: value for name, value in values.items() if value is not None}
    return lines


def _entry(airframe: Airframe, name: str) -> float | None:
    """The value of an entry, SI; None where the airframe has no such entry."""
    parts = ENTRY.fullmatch(name)
    if parts is None:
        return None
    matrix, row, column = parts.groups()
    values = {"A": airframe.matrix_a, "B": airframe.matrix_b}[matrix]()
    columns = list(airframe.states if matrix == "A" else airframe.inputs)
    states = list(airframe.states)
    if row not in states or column not in columns:
        return None
    return float(np.asarray(values)[states.index(row), columns.index(column)])
