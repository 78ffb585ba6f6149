# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""The learner of a scenario: its airframe file is the rough model, and its observers have the gains of `rise-di gains`."""

from aircraft_sim.airframe import Airframe, load_airframe
from flight_analysis.closed_loop.learning import Learn
from flight_analysis.closed_loop.scenario import Scenario
from flight_analysis.design.learner import Learner
from flight_core.parameters import require
from rise_di.gain_design import observed
from rise_di_controller.rise_di import RiseDiConfig


def learner(scenario: Scenario, *, real_time: bool = False) -> Learn | None:
    """What `simulate` and `fly_and_report` take as `learn`; None for a scenario that does not learn.

    The published airframe is the rough model, not the aircraft that flies. In real time the loop has the delay of the
    controller's section; in one process and in lockstep u acts at once. Raises ParameterError for an aircraft of JSBSim.
    """
    controller, aircraft = scenario.controller, scenario.aircraft
    if not isinstance(controller, RiseDiConfig) or controller.learn is None:
        return None
    require(not aircraft.is_jsbsim, "controller.learn", "an aircraft of JSBSim", "an airframe file: it has the rough model")
    airframe, margin = load_airframe(aircraft.airframe), 0.0 if controller.observer is None else controller.observer.margin

    def design(start: RiseDiConfig, model: Airframe) -> RiseDiConfig:
        return observed(start, scenario, model, margin)[0]

    return lambda parameters: Learner(parameters, airframe, design, parameters.delay if real_time else 0.0)
