# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Make the learner of a scenario.

The rough model of the learner is the airframe file or a sketch, which is a model from the effects
of the inputs and the trim speed alone. The observers of its designs have the gains of `rise-di
gains`.
"""

from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from aircraft_sim.airframes.airframe import Airframe, load_airframe
from aircraft_sim.jsbsim.jsbsim_aircraft import PREFIX
from aircraft_sim.uncertainty import as_yaml
from flight_analysis.closed_loop.learning_loop import Entry, Learn
from flight_analysis.closed_loop.replay import recorded_changes, recorded_parameters
from flight_analysis.closed_loop.replay_ticks import vary
from flight_analysis.closed_loop.scenario import Scenario
from flight_analysis.linear_loop.loop_margins import distribution
from flight_core.files import comment
from flight_core.modes import Mode
from flight_core.parameters import require
from flight_core.rates import NANOSECONDS
from flight_core.tape import Signal, Tape
from flight_core.vectors import FloatArray
from flight_design.gains.first_scenario import sensor_noise
from flight_design.gains.gain_design import selected_observer
from flight_design.gains.gain_selection import loop_setting
from flight_design.gains.observer_search import SelectedObserver
from flight_design.identification.innovation_filters import Actuation
from flight_design.identification.jsbsim_identification import STEP_MARGIN
from flight_design.identification.likelihood import KNOWN
from flight_design.identification.sketch import ROUGH, sketched, with_sketch
from flight_design.learning.designs import ACTIVITY, Goal, LearnedLoop, asked_margin
from flight_design.learning.learner import Learner
from flight_log.tape_reader import RecordedRun
from rise_di_controller.internals import GIVEN_UP
from rise_di_controller.learning.proposals import Updates
from rise_di_controller.rise_di_config import LearnConfig, PriorConfig, RiseDiConfig


def learner(scenario: Scenario, *, real_time: bool = False, quick: bool = False) -> Learn | None:
    """Return the function that `simulate` and `fly_and_report` take as `learn`, or None.

    The rough model is the published airframe, not the aircraft in flight. For an aircraft of
    JSBSim, and with `learn.prior.sketch`, the feedforward of the controller is the rough model. A
    file in `learn.prior.file` replaces either. If the flight is in real time, the loop has the
    delay of the section controller. If it is in one process or in lockstep, u acts at once.

    Args:
        scenario: The flight.
        real_time: Whether the learner works beside a controller in real time.
        quick: Whether an identification needs only one start if the air is the same in every
            second, as in a campaign.

    Returns:
        A function that makes a learner from the controller's parameters; None without learning.

    Raises:
        ParameterError: The schedule or the rough model does not fit the airframe.

    Examples:
        >>> scenario = rise_di.find_scenario("osprey_learn", duration=0.1)
        >>> rise_di.simulate(scenario, learn=rise_di.learner(scenario)).outcome.status
        0
    """
    controller = scenario.controller
    aircraft = scenario.aircraft
    if not isinstance(controller, RiseDiConfig) or controller.learn is None:
        return None
    prior = controller.learn.prior
    sketch = aircraft.is_jsbsim or (prior is not None and prior.sketch)
    if sketch:
        name = Path(aircraft.airframe.removeprefix(PREFIX)).stem
        airframe = sketched(name, controller, aircraft.channels().speed)
        rough = ROUGH
    else:
        airframe = with_law_inputs(load_airframe(aircraft.airframe), controller)
        rough = KNOWN
    if prior is not None and prior.file is not None:
        airframe = _prior(prior.file, airframe)
    if prior is not None and prior.off is not None:
        rough = rough._replace(error=prior.off, effect=prior.off)

    speeds = _speeds(controller, airframe)

    def design(start: RiseDiConfig, model: Airframe, goal: Goal) -> SelectedObserver:
        return selected_observer(
            start,
            scenario,
            model,
            goal.margin,
            goal.needed,
            uncertain=False,
            sketched=sketch,
            speeds=speeds,
            earlier_design=goal.first,
            is_free=goal.is_free,
            activity=ACTIVITY,
        )

    of_rough: dict[RiseDiConfig, SelectedObserver] = {}

    def design_of_rough(start: RiseDiConfig) -> SelectedObserver:
        """Return the design for the rough model, which allows for its errors.

        The design is made only once, also for the learners of many aircraft.
        """
        if start not in of_rough:
            margin = asked_margin(controller)
            of_rough[start] = selected_observer(start, scenario, airframe, margin, speeds=speeds)
        return of_rough[start]

    return lambda parameters: Learner(
        parameters,
        airframe,
        design,
        _actuation(scenario, airframe, parameters.delay if real_time else 0.0),
        rough,
        None if sketch else design_of_rough,
        quick=quick,
    )


def that_learns(scenario: Scenario) -> Scenario:
    """Turn a scenario that has only the law into one in which a model is learned in flight.

    No airframe file is needed:

        Omega = diag(D omega / input_scale),   V0 the trim speed

    The parameters of the law give the signs and sizes of Omega. The rough model is built from Omega
    and V0 by `sketch`. Raises ParameterError if the controller has an observer, or if the rough
    model lacks an output.
    """
    start = scenario.rise_di()
    expected = "none: a scenario of the law alone, whose signs and sizes are the rough model"
    require(start.observer is None, "learn", "an observer", expected)
    aircraft = scenario.aircraft
    channels = aircraft.channels()
    measured = aircraft.sensors.noise or (0.0,) * len(channels.outputs)
    by_name = dict(zip(channels.outputs, measured, strict=True))
    noise = np.array([by_name[name] or sensor_noise(name) for name in start.outputs])
    Omega = np.diag(np.array(start.D) * start.omega / start.input_scale)
    name = Path(aircraft.airframe.removeprefix(PREFIX)).stem
    sketched = with_sketch(start, name, Omega, channels.speed, noise, STEP_MARGIN)
    learn = LearnConfig(prior=PriorConfig(sketch=True))
    return scenario.vary(controller=sketched.model_copy(update={"learn": learn}))


def quick_learner(scenario: Scenario) -> Learn | None:
    """Return the learner for a campaign, whose identifications take less time."""
    return learner(scenario, quick=True)


def with_law_inputs(airframe: Airframe, controller: RiseDiConfig) -> Airframe:
    """Return the airframe with the inputs of the law, in the order of the airframe's outputs."""
    if controller.allocation is None:
        return airframe
    order = [controller.outputs.index(name) for name in airframe.outputs]
    T = distribution(airframe, controller)[:, order]
    return airframe.through(T, [controller.inputs[k] for k in order])


def _actuation(scenario: Scenario, airframe: Airframe, delay: float) -> Actuation:
    """Return the actuators of a scenario, in the airframe's order, with a delay of u, s."""
    loop = loop_setting(scenario)
    lag = np.array([loop.lag[name] for name in airframe.inputs])
    return Actuation(lag, delay, np.array([loop.rate_limit[name] for name in airframe.inputs]))


def _speeds(controller: RiseDiConfig, airframe: Airframe) -> tuple[float, float] | None:
    """Return the slow and the fast speed of a schedule's models, divided by the trim speed.

    Returns None if there is no schedule. Raises ParameterError if the schedule and the rough model
    have different speeds.
    """
    if controller.schedule is None:
        return None
    V0 = controller.schedule.speed
    expected = f"{airframe.speed:g} m/s, the speed of the model"
    require(airframe.speed == V0, "controller.schedule.speed", f"{V0:g} m/s", expected)
    slow, fast = controller.schedule.models
    return slow.ratio, fast.ratio


def _prior(path: str, flown: Airframe) -> Airframe:
    """Load the rough model from a file. Raises ParameterError if it is of another airframe."""
    prior = load_airframe(path)
    for key in ("name", "states", "inputs", "outputs", "speed"):
        same = getattr(prior, key) == getattr(flown, key)
        require(
            same,
            "controller.learn.prior.file",
            f"an airframe with another {key}",
            f"a model of {flown.name}",
        )
    return prior


class LearnStep(NamedTuple):
    """What the learner found at one time of the flight."""

    t: float  # s
    is_proposed: bool
    sentence: str


class LearnResult(NamedTuple):
    """What the learner found over a log, step by step, and its model at the end.

    The model is None if nothing was learned.
    """

    steps: tuple[LearnStep, ...]
    model: Airframe | None
    entries: tuple[Entry, ...]  # the entries of the last identification
    # the loop of the last proposal with a learned model; None if there was no such proposal
    loop: LearnedLoop | None = None


class _Ticks(NamedTuple):
    """The ticks of a log, and the parameters in use at each tick."""

    stamp_ns: NDArray[np.int64]
    instant_ns: NDArray[np.int64]
    mode: FloatArray
    y: FloatArray  # (N, m)
    u: FloatArray  # (N, m)
    flown: FloatArray | None  # digests; None if the learner in the log had other settings
    given_up: Signal

    def left(self, k: int) -> tuple[str, ...]:
        """Return the outputs whose learned models the controller no longer used at the tick k."""
        names = self.given_up.names
        return tuple(name for name in names if self.flown is not None and self.given_up[name][k])


def _ticks(tape: Tape, controller: RiseDiConfig) -> _Ticks:
    """Return the ticks of a log. Raises ParameterError if the log has no internals."""
    flew = "internals" in tape and len(tape["internals"].stamp_ns) > 0
    require(flew, "the log", "no sample of internals", "a flight with a controller that engaged")
    ticks = tape["internals"]
    flown = ticks["parameters"]
    is_of_log = bool(np.any(flown == controller.digest()))
    given_up = ticks.group(GIVEN_UP)
    require(
        not is_of_log or given_up.names == controller.outputs,
        "the log",
        f"no channels {GIVEN_UP}.* of internals",
        "a log that has the outputs that the controller gave up",
    )
    return _Ticks(
        ticks.stamp_ns,
        ticks.stamp_ns + np.round(ticks["age"] * NANOSECONDS).astype(np.int64),
        ticks["mode"],
        ticks.group("y").values,
        ticks.group("u").values,
        flown if is_of_log else None,
        given_up,
    )


def learn_again(tape: Tape, scenario: Scenario) -> LearnResult:
    """Run the learner of a scenario on the ticks of a log, with their y and u.

    Ticks in which the law was not engaged are left out. As in flight, the record ends if the law is
    deactivated. If the flight in the log was without a learner, or its learner had other settings
    than the scenario, each proposal is treated as if it had flown. Raises ParameterError if nothing
    can be learned from the log.
    """
    # Simulated time begins at 0.
    make = learner(scenario, real_time=tape.start_ns > 0)
    controller = scenario.rise_di()
    require(make is not None, "controller.learn", "no section", "one")
    assert make is not None  # noqa: S101 - for the type checker
    settings = controller.learn
    assert settings is not None  # noqa: S101 - there is a learner

    def begun() -> tuple[Learner, Updates]:
        made = make(controller)
        assert isinstance(made, Learner)  # noqa: S101 - `learner` makes no other
        return made, Updates(settings)

    ticks = _ticks(tape, controller)
    steps = list[LearnStep]()
    learned, updates = begun()
    proposed = controller.digest()
    begin_ns = int(ticks.instant_ns[0])
    longest_ns = 0
    for k, now_ns in enumerate(ticks.instant_ns.tolist()):
        if ticks.mode[k] == Mode.INACTIVE:
            continue
        if k and ticks.mode[k - 1] == Mode.INACTIVE:
            learned, updates = begun()
            proposed = controller.digest()
            begin_ns = now_ns
        longest_ns = max(longest_ns, now_ns - begin_ns)
        flown = proposed if ticks.flown is None else int(ticks.flown[k])
        if ticks.mode[k] == Mode.ENGAGED:
            learned.take(int(ticks.stamp_ns[k]), ticks.y[k].copy(), ticks.u[k].copy(), flown)
        if updates.is_due(now_ns):
            proposal = learned.propose(flown, ticks.left(k))
            proposed = proposed if proposal.controller is None else proposal.controller.digest()
            t = (now_ns - tape.start_ns) / NANOSECONDS
            # The rough model is proposed before there is a record, so it has taught nothing.
            if proposal.sentence is not None and now_ns > begin_ns:
                steps.append(LearnStep(t, proposal.controller is not None, proposal.sentence))
    first = f"{settings.updates[0]:g} s or more, the first of learn.updates"
    length = f"at most {longest_ns / NANOSECONDS:.3g} s of ticks of an active controller"
    require(bool(steps), "the log", length, first)
    last = learned.identification
    entries = () if last is None else last.entries
    return LearnResult(tuple(steps), learned.model, entries, learned.proposed_loop)


def with_last_model(scenario: Scenario, run: RecordedRun) -> Scenario:
    """Return a scenario with the parameters that one of its runs used last, and without `learn`.

    Raises ParameterError if the run had another controller.
    """
    start = scenario.rise_di()
    recorded = recorded_parameters(run.scenario_file())
    same = recorded.digest() == start.digest()
    require(same, "run", "a flight with other parameters", f"the parameters of {scenario.name}")
    flown = recorded
    for change in recorded_changes(run, start):
        flown = vary(flown, change)
    return scenario.vary(controller=flown.model_copy(update={"learn": None}))


def learned_yaml(result: LearnResult, origin: str) -> str:
    """Write the learned model as an airframe file, whose heading lists the steps of the learner.

    Raises ParameterError if there is no model.
    """
    require(result.model is not None, "the learner", "no model", "one")
    assert result.model is not None  # noqa: S101 - for the type checker
    lines = [f"The airframe {result.model.name}, with A and B learned from {origin}.", ""]
    lines += [
        f"t = {step.t:.2f} s: {'' if step.is_proposed else 'no model: '}{step.sentence}"
        for step in result.steps
    ]
    return comment(lines) + as_yaml(result.model)
