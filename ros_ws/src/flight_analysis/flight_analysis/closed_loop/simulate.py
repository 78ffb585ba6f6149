# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""The closed loop in one process, without ROS: the code of the nodes, called in the order of the data flow."""

import math
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress

import numpy as np

from aircraft_sim.simulator import Simulator
from flight_analysis.closed_loop.learning_loop import Learn, LearningLoop
from flight_analysis.closed_loop.scenario import Scenario, as_scenario, require_guidable
from flight_core.channels import ATTITUDE, POSE
from flight_core.outcome import COMPLETED, INTERRUPTED, FlightEnded
from flight_core.parameters import require
from flight_core.rates import NANOSECONDS, nanoseconds, seconds
from flight_core.tape import Signal, Tape
from flight_core.vectors import ChannelError, FloatArray, StampedVector, select
from flight_guidance.guidance import Guidance
from flight_guidance.params import GuidanceConfig
from reference_model.reference import Reference
from rise_di_controller.controller import Controller
from rise_di_controller.params import ControllerConfig
from rise_di_controller.proposals import AUTHORITY_TICKS, Event, authority_names
from rise_di_controller.rise_di_config import RiseDiConfig

Record = Callable[[Mapping[str, Signal]], None]
"""Takes the samples of a part of a flight, by topic."""


class _SignalBuilder:
    """Collects the samples of a topic."""

    def __init__(self, names: Sequence[str]) -> None:
        self.names = tuple(names)
        self.stamps: list[int] = []
        self.rows: list[FloatArray] = []

    def add(self, stamp_ns: int, row: FloatArray) -> None:
        self.stamps.append(stamp_ns)  # first: an interrupt before the next line leaves a stamp without a row
        self.rows.append(row)

    def take(self) -> Signal:
        """The samples since the last call."""
        values = np.array(self.rows) if self.rows else np.zeros((0, len(self.names)))
        signal = Signal(np.array(self.stamps[: len(values)], dtype=np.int64), self.names, values)
        self.stamps = []
        self.rows = []
        return signal


def simulate(
    scenario: Scenario,
    progress: Callable[[float], None] | None = None,
    guide: Callable[[GuidanceConfig], Guidance] = Guidance,
    control: Callable[[ControllerConfig], Controller] = Controller,
    learn: Learn | None = None,
    announce: Callable[[Event], None] = lambda event: None,
) -> Tape:
    """Fly a scenario and return the tape; `outcome` of the tape has the reason of an early end. The rest is as `fly` says.

    Raises ParameterError for what is no scenario.
    """
    as_scenario(scenario)
    change = 'a function of the flight time; scenario.vary(flight={"duration": ...}) changes the duration'
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
        signals[topic] = Signal(stamp_ns, last.names, np.concatenate([signal.values for signal in samples]))
    changes = tuple(event.change for event in events if event.change)
    return Tape(signals, outcome=outcome, scenario=scenario, changes=changes)


def fly(  # noqa: PLR0912, PLR0915 - a part a node
    scenario: Scenario,
    record: Record,
    progress: Callable[[float], None] | None = None,
    guide: Callable[[GuidanceConfig], Guidance] = Guidance,
    control: Callable[[ControllerConfig], Controller] = Controller,
    learn: Learn | None = None,
    announce: Callable[[Event], None] = lambda event: None,
) -> str:
    """Fly a scenario and return the outcome. `record` takes the samples once per simulated second and at the end.

    `progress` is called with the flight time after `record`. `guide` makes the guidance of a scenario with guidance;
    the default receives the true pose. `control` makes the controller. `learn` makes the learner of a scenario that learns, and
    `announce` takes what it does. Raises ParameterError for such a scenario without `learn`.

    Order at an instant: y of the aircraft, y_m of the reference model, u_m of guidance, proposals of the learner, u of the
    controller. The aircraft holds u until the next u. A lost sample of y is not recorded; a delayed sample keeps the stamp. A
    flight that diverges or is interrupted (Ctrl-C) ends early.
    """
    require_guidable(scenario)
    outputs, measured, inputs = scenario.controller.outputs, scenario.controller.measured, scenario.controller.effectors
    reference, controller = Reference(scenario.reference_model), control(scenario.controller)
    guidance = None if scenario.guidance is None else guide(scenario.guidance)
    learning = _learning(scenario.controller, learn, announce)
    signals = {
        "y": _SignalBuilder(tuple(scenario.aircraft.channels().outputs)),
        "y_m": _SignalBuilder(scenario.reference_model.outputs),
        "u": _SignalBuilder(inputs),
        "internals": _SignalBuilder(controller.names),
    }
    if guidance is not None:
        signals |= {
            "u_m": _SignalBuilder((*scenario.reference_model.outputs, *ATTITUDE)),
            "guidance": _SignalBuilder(guidance.names),
        }
    if learning is not None:
        signals["authority"] = _SignalBuilder(authority_names(scenario.controller.outputs))
    outcome, t_ns = COMPLETED, 0
    try:
        aircraft = Simulator(scenario.aircraft)
        signals["truth"], signals["pose"] = _SignalBuilder(aircraft.truth_names), _SignalBuilder(POSE)
        base_ns = math.gcd(aircraft.period_ns, reference.period_ns)
        u = np.zeros(len(inputs))
        for t_ns in range(0, nanoseconds(scenario.flight.duration) + 1, base_ns):
            if t_ns % aircraft.period_ns == 0:
                for sample in aircraft.sample(t_ns // aircraft.period_ns, u):
                    signals["y"].add(sample.stamp_ns, sample.value)
                    controller.take_y(StampedVector(sample.stamp_ns, select(measured, aircraft.outputs, sample.value)), t_ns)
                    if guidance is not None:
                        y = select(scenario.reference_model.outputs, aircraft.outputs, sample.value)
                        with suppress(ChannelError):  # refused, as by the node
                            guidance.take_y(StampedVector(sample.stamp_ns, y), t_ns)
                for pose in aircraft.poses():
                    signals["pose"].add(pose.stamp_ns, pose.value)
                    if guidance is not None:
                        with suppress(ChannelError):
                            guidance.take_pose(pose, t_ns)
                signals["truth"].add(t_ns, aircraft.truth())
            if t_ns % reference.period_ns == 0:
                y_m = reference.sample(t_ns // reference.period_ns)
                signals["y_m"].add(t_ns, y_m)
                controller.take_y_m(StampedVector(t_ns, select(outputs, scenario.reference_model.outputs, y_m)), t_ns)
            if guidance is not None and (waits := guidance.waits(t_ns)):
                raise FlightEnded(f"ended at t = {seconds(t_ns):.2f} s: {waits}")
            if guidance is not None and t_ns % guidance.period_ns == 0 and (guided := guidance.step(t_ns, t_ns)) is not None:
                signals["u_m"].add(t_ns, guided.u_m)
                signals["guidance"].add(t_ns, guided.log)
                m = len(scenario.reference_model.outputs)
                with suppress(ChannelError):
                    reference.take(t_ns, guided.u_m[:m], guided.u_m[m:])  # acts from the next step on: y_m of t is given
            if t_ns % controller.period_ns == 0:
                if learning is not None:
                    learning.before_tick(controller, t_ns)
                    if t_ns % (AUTHORITY_TICKS * controller.period_ns) == 0:
                        signals["authority"].add(t_ns, bounds := learning.authority(controller))
                        if guidance is not None:  # acts from its next step on
                            guidance.take_authority(dict(zip(signals["authority"].names, bounds.tolist(), strict=True)))
                if (output := controller.tick(t_ns)) is not None:
                    u = select(aircraft.inputs, inputs, output.u)
                    signals["u"].add(output.stamp_ns, output.u)
                    signals["internals"].add(output.stamp_ns, output.internals)
                if learning is not None and (identified := learning.after_tick(controller, output, t_ns)) is not None:
                    signals.setdefault("learned", _SignalBuilder(identified.names)).add(t_ns, identified.values)
            if t_ns % NANOSECONDS == 0:
                record({topic: builder.take() for topic, builder in signals.items()})
                if progress is not None:
                    progress(seconds(t_ns))
    except KeyboardInterrupt:
        outcome = INTERRUPTED
    except FlightEnded as error:
        outcome = str(error)
    except ChannelError as error:  # commands or noise overflow
        outcome = f"ended at t = {seconds(t_ns):.2f} s: {error}"
    record({topic: builder.take() for topic, builder in signals.items()})
    return outcome


def _learning(controller: ControllerConfig, learn: Learn | None, announce: Callable[[Event], None]) -> LearningLoop | None:
    if not isinstance(controller, RiseDiConfig) or controller.learn is None:
        return None
    require(learn is not None, "controller.learn", "a flight without a learner", "one: learn=rise_di.learner(scenario)")
    assert learn is not None  # noqa: S101 - for the type checker
    return LearningLoop(controller, learn, announce)
