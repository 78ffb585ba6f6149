# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Find which parameters the controller had during a flight, and build their linear loops.

Each linear loop is built around the aircraft of the airframe file, or around the true aircraft of a
simulation.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from aircraft_sim.airframes.airframe import Airframe, load_airframe
from aircraft_sim.params import AircraftConfig
from flight_analysis.closed_loop.replay_ticks import Change, vary
from flight_analysis.closed_loop.scenario import Scenario
from flight_analysis.linear_loop.certificate import beyond_kept
from flight_analysis.linear_loop.loop_margins import (
    LinearLoop,
    LoopMargins,
    distribution,
    linear_loop,
    loop_margins,
    scenario_loop,
    through_allocation,
)
from flight_analysis.linear_loop.told import FlightFacts, Standing
from flight_analysis.report.model_spans import parameter_spans
from flight_analysis.report.sample_counts import is_simulated
from flight_analysis.report.timing import age_metrics
from flight_core.parameters import ParameterError
from flight_core.rates import NANOSECONDS
from flight_core.tape import Tape
from rise_di_controller.law.linear_loop import LoopTiming
from rise_di_controller.params import ControllerConfig

ENTRY = re.compile(r"([AB])\[(.+), (.+)\]")  # an entry as the topic `learned` names it
FILE = "file"
TRUE = "true"


class FlownController(NamedTuple):
    """A set of parameters of the controller, and the spans of time in which it was used.

    A span is the time, s, of the first and of the last tick with these parameters.
    """

    name: str  # "start", "file", "model 1"
    spans: tuple[tuple[float, float], ...]
    controller: ControllerConfig

    @property
    def times(self) -> str:
        """The spans of time as text, s."""
        return ", ".join(f"{start:.1f} to {stop:.1f}" for start, stop in self.spans)


@dataclass(frozen=True, kw_only=True)
class FlownLoop:
    """The linear loop of an aircraft with controller parameters that were used."""

    name: str  # name of the parameters; empty if they were used for the whole flight
    times: str  # when the parameters were used, as text, s
    aircraft: str  # FILE or TRUE
    loop: LinearLoop

    @cached_property
    def margins(self) -> LoopMargins:
        """The margins of the loop, computed once for all parts of the page."""
        return loop_margins(self.loop)


def flown_controllers(
    tape: Tape, start: ControllerConfig, changes: Sequence[Change]
) -> tuple[FlownController, ...]:
    """Return the controller's parameters that were used, in order, and when each was used.

    `start` has the parameters with which the flight started, and `changes` has the changes in
    flight. The digest of the parameters in each tick shows when each set was used.
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


class FlownLoops(NamedTuple):
    """The linear loops of a flight, and how its aircraft differs from the controller's data."""

    loops: list[FlownLoop]  # empty without a linear model, or if the parameters are unknown
    sentences: tuple[str, ...]  # how the aircraft differs from what the controller was told


UNKNOWN_AIRCRAFT = (
    "the aircraft is not simulated: its lags, delay and end stops are taken as the controller was "
    "told"
)


def flown_loops(
    tape: Tape,
    scenario: Scenario,
    controllers: Sequence[FlownController],
    later: Sequence[AircraftConfig] = (),
) -> FlownLoops:
    """Return the linear loops of a flight, one for each set of parameters that was used.

    The loops have the lags and the delay of the aircraft that flew. If the true aircraft of a
    simulation differs from its airframe file, each set has a second loop, around the true aircraft.
    `later` has the parameters of the aircraft after each change in flight.
    """
    loops = []
    sentences: list[str] = []
    airframe = true_airframe(tape, scenario)
    parameter_sets = [(each.name, each.times, each.controller) for each in controllers]
    for name, times, controller in parameter_sets or [("", "", scenario.controller)]:
        facts = facts_of(tape, scenario.controller, controllers, later)
        try:
            around_file = scenario_loop(scenario, controller, flight=facts)
        except ParameterError:
            continue
        sentences += [each.sentence for each in around_file.differences]
        if any(each.standing is Standing.NO_LOOP for each in around_file.differences):
            continue
        sentences += beyond_kept(around_file)
        loops.append(FlownLoop(name=name, times=times, aircraft=FILE, loop=around_file))
        if airframe is not None:
            true = _loop_around(airframe, controller, around_file.loop)
            loops.append(FlownLoop(name=name, times=times, aircraft=TRUE, loop=true))
    if loops and not is_simulated(tape):
        sentences.append(UNKNOWN_AIRCRAFT)
    return FlownLoops(loops, tuple(dict.fromkeys(sentences)))


def facts_of(
    tape: Tape,
    start: ControllerConfig,
    controllers: Sequence[FlownController],
    later: Sequence[AircraftConfig] = (),
) -> FlightFacts:
    """Return facts about a flight that its log shows but its scenario does not."""
    known = {start.digest(), *(each.controller.digest() for each in controllers)}
    age = age_metrics(tape)
    return FlightFacts(
        is_simulated=is_simulated(tape),
        tick=_period_of_ticks(tape),
        y_period=None if is_simulated(tape) else _period_of(tape, "y"),
        age=None if age is None or not np.isfinite(age.mean) else age.mean,
        later=tuple(later),
        has_parameters=all(span.digest in known for span in parameter_spans(tape)),
    )


def _period_of_ticks(tape: Tape) -> float | None:
    """Return the median time between two ticks, s, or None if the log has fewer than two ticks."""
    if "internals" not in tape or "number" not in tape["internals"].names:
        return None
    steps = np.diff(tape["internals"]["number"])
    is_next = steps > 0.0
    if not is_next.any():
        return None
    return float(np.median(np.diff(tape.time("internals"))[is_next] / steps[is_next]))


def _period_of(tape: Tape, topic: str) -> float | None:
    """Return the median time between two samples of a topic, s, or None with fewer than two."""
    if topic not in tape or len(tape[topic].stamp_ns) < 2:
        return None
    return float(np.median(np.diff(tape[topic].stamp_ns))) / NANOSECONDS


def true_airframe(tape: Tape, scenario: Scenario) -> Airframe | None:
    """Return the airframe that was simulated, before any drift, if it differs from the file.

    Returns None if the simulated airframe does not differ from the file, or if no airframe file was
    simulated.
    """
    aircraft = scenario.aircraft
    uncertainty = aircraft.uncertainty
    differs = uncertainty.A > 0.0 or uncertainty.B > 0.0 or bool(uncertainty.entries)
    if aircraft.is_jsbsim or not differs or not is_simulated(tape):
        return None
    return aircraft.sampled_airframe()


def _loop_around(
    airframe: Airframe, controller: ControllerConfig, timing: LoopTiming
) -> LinearLoop:
    airframe_of_law = through_allocation(airframe, controller)
    B = airframe.matrix_b() @ distribution(airframe, controller)
    return linear_loop(controller, airframe_of_law, airframe.matrix_a()[None], B[None], timing)


def learned_lines(tape: Tape, scenario: Scenario) -> dict[str, dict[str, float]]:
    """Return the true and the nominal values of the entries of A and B that were learned, SI.

    The topic `learned` names the entries. The label FILE has the values of the airframe file. If
    the flight was simulated, the label TRUE has the values of the true aircraft. For an aircraft of
    JSBSim no values are known.
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
    """Return the entry of A or B with a name such as "B[q, elevator]", SI.

    Returns None if the airframe has no such entry.
    """
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
