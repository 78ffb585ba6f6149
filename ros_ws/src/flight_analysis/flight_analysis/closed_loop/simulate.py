# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Simulate the closed loop in one process, without ROS.

The code of the nodes is called in the order of the data flow.
"""

from collections.abc import Callable, Mapping

import numpy as np

from flight_analysis.closed_loop.learning_loop import Learn, LearnerStation, ProposalStation
from flight_analysis.closed_loop.scenario import Scenario, as_scenario, require_guidable
from flight_analysis.closed_loop.stations import (
    AircraftStation,
    ControllerStation,
    FlightLoop,
    GuidanceStation,
    ReferenceStation,
    Station,
    Topics,
)
from flight_core.outcome import COMPLETED, INTERRUPTED, FlightEnded, Outcome, ended_early
from flight_core.parameters import require
from flight_core.rates import NANOSECONDS, nanoseconds, seconds
from flight_core.tape import Signal, Tape
from flight_core.vectors import ChannelError
from flight_guidance.guidance import Guidance
from flight_guidance.params import GuidanceConfig
from rise_di_controller.controller import Controller
from rise_di_controller.learning.proposals import Event, Learning
from rise_di_controller.params import ControllerConfig
from rise_di_controller.rise_di_config import RiseDiConfig

Record = Callable[[Mapping[str, Signal]], None]
"""A function that takes the samples of a span of a flight, by topic."""


class _Recorder:
    """Calls `record` with the new samples every simulated second, then `progress`."""

    period_ns = NANOSECONDS

    def __init__(
        self, topics: Topics, record: Record, progress: Callable[[float], None] | None
    ) -> None:
        self._topics = topics
        self._record = record
        self._progress = progress

    def step(self, t_ns: int) -> None:
        """Call `record` with the new samples, then `progress` with the flight time, s."""
        self._record(self._topics.pop_signals())
        if self._progress is not None:
            self._progress(seconds(t_ns))


def simulate(
    scenario: Scenario,
    progress: Callable[[float], None] | None = None,
    guide: Callable[[GuidanceConfig], Guidance] = Guidance,
    control: Callable[[ControllerConfig], Controller] = Controller,
    learn: Learn | None = None,
    announce: Callable[[Event], None] = lambda event: None,
) -> Tape:
    """Simulate a flight in memory and return its tape, which also says how the flight ended.

    The tape has a signal for each topic, in SI and radians. `progress` is called with the flight
    time, s, once per simulated second. `guide`, `control` and `learn` make guidance, controller and
    learner. `announce` is called with each event of the learning. Raises ParameterError if
    `scenario` is no Scenario, or if its controller learns in flight and `learn` is None.
    """
    as_scenario(scenario)
    change = (
        'a function of the flight time; scenario.vary(flight={"duration": ...}) changes '
        "the duration"
    )
    require(progress is None or callable(progress), "progress", progress, change)
    parts: list[Mapping[str, Signal]] = []
    events: list[Event] = []

    def take(event: Event) -> None:
        events.append(event)
        announce(event)

    outcome = fly(scenario, parts.append, progress, guide, control, learn, take)
    signals = {}
    for topic, last in parts[-1].items():
        samples = [part[topic] for part in parts if topic in part]
        stamp_ns = np.concatenate([signal.stamp_ns for signal in samples])
        signals[topic] = Signal(
            stamp_ns, last.names, np.concatenate([signal.values for signal in samples])
        )
    changes = tuple(event.change for event in events if event.change)
    return Tape(signals, outcome=outcome, scenario=scenario, changes=changes)


def fly(
    scenario: Scenario,
    record: Record,
    progress: Callable[[float], None] | None = None,
    guide: Callable[[GuidanceConfig], Guidance] = Guidance,
    control: Callable[[ControllerConfig], Controller] = Controller,
    learn: Learn | None = None,
    announce: Callable[[Event], None] = lambda event: None,
) -> Outcome:
    """Fly a scenario and return the outcome.

    `record` is called with the new samples, by topic, once per simulated second and at the end.
    After each of these calls `progress` is called with the flight time, s. `guide` makes the
    guidance if the scenario has any. `control` makes the controller. `learn` makes the learner of a
    controller that learns in flight, and `announce` is called with each event of the learning.
    Raises ParameterError if the controller learns and `learn` is None.

    The order at an instant is: y of the aircraft, y_m of the reference model, u_m of guidance,
    proposals of the learner, u of the controller. A flight ends early if it diverges or is
    interrupted (Ctrl-C).
    """
    require_guidable(scenario)
    topics = Topics()
    stations: list[Station] = [
        AircraftStation(scenario.aircraft, topics),
        ReferenceStation(scenario.reference_model, topics),
    ]
    if scenario.guidance is not None:
        stations.append(GuidanceStation(guide(scenario.guidance), scenario.guidance, topics))
    controller = control(scenario.controller)
    control_station = ControllerStation(controller, topics)
    parameters = scenario.controller
    if isinstance(parameters, RiseDiConfig) and parameters.learn is not None:
        require(
            learn is not None,
            "controller.learn",
            "a flight without a learner",
            "one: learn=rise_di.learner(scenario)",
        )
        assert learn is not None  # noqa: S101 - for the type checker
        learning = Learning(parameters, announce, simulated=True)
        learner = LearnerStation(control_station, learning, learn(parameters), topics)
        stations += [ProposalStation(controller, learning, topics), control_station, learner]
    else:
        stations.append(control_station)
    loop = FlightLoop([*stations, _Recorder(topics, record, progress)])
    outcome = COMPLETED
    try:
        loop.run(nanoseconds(scenario.flight.duration))
    except KeyboardInterrupt:
        outcome = INTERRUPTED
    except FlightEnded as error:
        outcome = error.outcome
    except ChannelError as error:  # a command or the noise overflowed
        outcome = ended_early(f"ended at t = {seconds(loop.t_ns):.2f} s: {error}")
    record(topics.pop_signals())
    return outcome
