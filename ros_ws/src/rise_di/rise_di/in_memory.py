# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Simulate a flight in memory, with the outcome that `rise-di fly` reports."""

from collections.abc import Callable
from dataclasses import replace

from flight_analysis.closed_loop.learning_loop import Learn
from flight_analysis.closed_loop.scenario import Scenario
from flight_analysis.closed_loop.simulate import simulate as fly_in_memory
from flight_analysis.report.account import account
from flight_analysis.report.flight_outcome import NEVER_ENGAGED, has_ticks
from flight_analysis.report.shortfalls import judge
from flight_core.outcome import End
from flight_core.tape import Tape
from flight_guidance.guidance import Guidance
from flight_guidance.params import GuidanceConfig
from rise_di_controller.controller import Controller
from rise_di_controller.learning.proposals import Event
from rise_di_controller.params import ControllerConfig


def simulate(
    scenario: Scenario,
    progress: Callable[[float], None] | None = None,
    guide: Callable[[GuidanceConfig], Guidance] = Guidance,
    control: Callable[[ControllerConfig], Controller] = Controller,
    learn: Learn | None = None,
    announce: Callable[[Event], None] = lambda event: None,
) -> Tape:
    """Simulate a scenario in memory. The flight ends early if it diverges or at Ctrl-C.

    Args:
        scenario: The scenario to fly.
        progress: Called with the flight time, s, once per simulated second.
        guide: Makes the guidance from its parameters, if the scenario has guidance.
        control: Makes the controller from its parameters.
        learn: Makes the learner if the scenario learns. `learner` returns such a function.
        announce: Takes the events of the learning.

    Returns:
        The tape, with signals of shape (N, k) in SI and radians. As in `rise-di fly`, its `outcome`
        says how the flight ended, and in what it falls short.

    Raises:
        ParameterError: `scenario` is no Scenario, or it learns and `learn` is None.

    Examples:
        >>> tape = rise_di.simulate(rise_di.find_scenario("osprey_servo", duration=0.1))
        >>> str(tape.outcome), tape["y"]["q"].shape
        ('completed', (51,))
    """
    tape = fly_in_memory(scenario, progress, guide, control, learn, announce)
    outcome = tape.outcome
    if outcome.end is End.COMPLETED and not has_ticks(tape):
        outcome = NEVER_ENGAGED
    flight_account = account(tape, scenario, outcome)
    return replace(tape, outcome=judge(outcome, tape, scenario, flight_account))
