# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""What disturbs a flight: engagements, commands, gusts and the rest of the air."""

import math

from flight_analysis.closed_loop.scenario import Scenario
from flight_analysis.metrics.transients import (
    Air,
    Transient,
    TransientKind,
    engagements,
    guided_transients,
    live_commands,
)
from flight_analysis.report.sample_counts import is_simulated
from flight_core.tape import Tape


def command_edges(scenario: Scenario) -> list[Transient]:
    """Return the changes of the scenario's commands as transients, in order of time.

    They are the edges of its pulses, doublets and ramps.
    """
    edges = [
        Transient(kind=TransientKind.COMMAND, name=name, start=edge.start, stop=edge.stop)
        for name, of_channel in scenario.reference_model.edges().items()
        for edge in of_channel
        if edge.change != 0.0
    ]
    return sorted(edges, key=lambda edge: edge.start)


def transients(scenario: Scenario, tape: Tape, *, follows_scenario: bool = True) -> list[Transient]:
    """Return the transients of a flight: engagements, commands and gusts.

    From the first live command on, live commands replace the commands of the scenario. In a guided
    flight, turns and captures replace commands. If `follows_scenario` is False, y_m did not follow
    the scenario's commands, so these commands are left out.
    """
    windows = scenario.gust_windows() if is_simulated(tape) else {}
    gusts = [
        Transient(kind=TransientKind.GUST, name=name, start=start, stop=stop)
        for name, (start, stop) in windows.items()
    ]
    if "guidance" in tape:
        return [*engagements(tape), *guided_transients(tape), *gusts]
    live = live_commands(tape)
    until = float(tape.time("u_m")[0]) if live else math.inf
    edges = command_edges(scenario) if follows_scenario else []
    return [
        *engagements(tape),
        *(edge for edge in edges if edge.start < until),
        *live,
        *gusts,
    ]


def air_of(scenario: Scenario, tape: Tape) -> Air:
    """Return the most violent disturbance of the air in a flight, except gusts."""
    if not is_simulated(tape):
        return Air.UNKNOWN
    aircraft = scenario.aircraft
    if aircraft.microburst is not None:
        return Air.MICROBURST
    if aircraft.turbulence is not None:
        return Air.TURBULENCE
    if aircraft.shear is not None:
        return Air.SHEAR
    return Air.WIND if any(aircraft.wind) else Air.CALM
