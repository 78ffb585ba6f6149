# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""The flights of benchmarks.learning: uncertain aircraft that learn, and others that do not."""

import json
import math
import sys
import time
from collections.abc import Mapping, Sequence
from functools import cache, lru_cache
from pathlib import Path
from tempfile import TemporaryDirectory
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

from aircraft_sim.airframes.airframe import Airframe, load_airframe
from aircraft_sim.atmosphere.disturbance import AIR_STATE
from aircraft_sim.atmosphere.turbulence import MODERATE
from aircraft_sim.uncertainty import AIR_RELATIVE, as_yaml, wind_factors
from flight_analysis.closed_loop.learning_loop import Learn, Learner, LearnerResult
from flight_analysis.closed_loop.replay import replay
from flight_analysis.closed_loop.replay_ticks import vary
from flight_analysis.closed_loop.scenario import Scenario
from flight_analysis.closed_loop.scenario_library import find_scenario
from flight_analysis.closed_loop.simulate import simulate
from flight_analysis.linear_loop.loop_margins import law_order, linear_loop, loop_margins
from flight_campaign.single_flights import learned
from flight_campaign.statistics import LOSS_OF_TRACK_SCORE, score_units
from flight_core.outcome import COMPLETED
from flight_core.parameters import ParameterError
from flight_core.tape import Tape
from flight_core.vectors import FloatArray
from flight_design.gains.gain_design import selected_observer
from flight_design.learning.scenario_learner import learner
from rise_di_controller.law.linear_loop import LinearPlant, LoopTiming, is_stable, linear_law
from rise_di_controller.learning.proposals import Event
from rise_di_controller.params import ControllerConfig
from rise_di_controller.rise_di_config import RiseDiConfig

REPOSITORY = Path(__file__).parents[1]
SEED = 11  # seed of the deviations of all aircraft
# s: end of a flight that learns; the damage, the instant after it from which scores count, and the
# end of a flight with damage
LEARNED, DAMAGED, SETTLED, END = (64.0, 60.0, 75.0, 100.0)
WINDOWS = ((0.0, 14.0), (14.0, 30.0), (30.0, DAMAGED), (DAMAGED, SETTLED), (SETTLED, END))
"""Parts of a flight with damage, begin and end, s: before the first model, with the first models,
with the learned model, right after the damage, and with the model learned after it."""
UPDATE = 1.0  # largest mean processor time of an update of both parts of the osprey, s
# s by which u is late in the test of stability; delay margin of the design, s; largest ratio to the
# score of the true model that counts as near it
LATE, MARGIN, WITHIN = 0.02, 0.03, 1.1
REPEATED = 35.0  # time after which the commands of osprey_learn come again, s
ROUGH = 0.6  # standard deviation of the logarithms of the factors of a rough prior
# factor on the effect of a weak surface; size of an entry between the parts of a coupled aircraft
WEAK, COUPLING = 0.5, 0.1
ALARM_FLIGHT = 600.0  # duration of a flight without damage that counts false alarms, s
TRAIN = {  # speed, m/s; length, m; start and time from one gust to the next, s
    "vertical": {"start": 1.0, "speed": 8.0, "length": 15.0, "every": 4.7},
    "lateral": {"start": 2.5, "speed": 5.0, "length": 12.0, "every": 6.1},
    "longitudinal": {"start": 4.0, "speed": 4.0, "length": 25.0, "every": 9.7},
}
AIR: dict[str, dict[str, Any]] = {
    "turbulence": {"turbulence": MODERATE},
    "gusts": {"turbulence": None, "gusts": TRAIN},
    "calm": {"turbulence": None},
    "light turbulence": {"turbulence": MODERATE | {"wind": 7.7}},
    "severe turbulence": {"turbulence": MODERATE | {"wind": 23.1}},
    "turbulence and gusts": {"turbulence": MODERATE, "gusts": TRAIN},
    "air that turns": {"turbulence": MODERATE | {"rotary": True}},
}


class Cell(NamedTuple):
    """What the aircraft of a cell have in common."""

    kind: str  # "learn", "turning", "rough", "coupled", "untold", "weak", "dead" or "alarm"
    air: str  # a key of AIR
    uncertainty: float  # largest relative deviation of an entry of A or B
    share: float = 1.0  # number of aircraft, as a share of --aircraft
    most: int = sys.maxsize  # largest number of aircraft
    # keys of the scenario's aircraft that differ without the controller or the learner knowing it
    untold: Mapping[str, Any] = MappingProxyType({})


def untold(air: str, uncertainty: float = 0.3, **keys: Any) -> Cell:
    """Return a cell whose aircraft differ by `keys`, which controller and learner do not know."""
    return Cell("untold", air, uncertainty, 0.25, untold=MappingProxyType(keys))


CELLS = {
    f"{air}, +-{100 * p:.0f} %": Cell("learn", air, p)
    for air in ("turbulence", "gusts", "calm")
    for p in (0.3, 0.5)
} | {
    "rough prior": Cell("rough", "turbulence", 0.3, 0.5),
    "air that turns": Cell("turning", "air that turns", 0.3, 0.25),
    "coupled": Cell("coupled", "turbulence", 0.3, 0.25),
    "u late": untold("turbulence", sensors={"delay": LATE}),
    **{
        f"servos {1e3 * late:.0f} ms late": untold("turbulence", actuators={"delay": late})
        for late in (0.02, 0.03, 0.04)
    },
    "loose elevator": untold("turbulence", actuators={"faults": ["elevator loose 0 0.01"]}),
    "slow servos": untold("turbulence", actuators={"lag": [0.04, 0.2, 0.04, 0.04]}),
    "noise x 3": untold("turbulence", sensors={"noise": [0.0051, 0.09, 0.0051, 0.0051]}),
    "y in steps": untold("turbulence", sensors={"quantisation": [0.005, 0.25, 0.005, 0.005]}),
    "severe turbulence, +-50 %": untold("severe turbulence", 0.5),
    "inertial coupling": untold("turbulence", inertial_coupling=1.0),
    "air that turns, inertial coupling": untold("air that turns", inertial_coupling=1.0),
    "weak": Cell("weak", "turbulence", 0.3, 0.5),
    "dead": Cell("dead", "turbulence", 0.3, 0.5),
    **{f"alarms in {air}": Cell("alarm", air, 0.3, 0.1, 2) for air in AIR},
}
# stands for any cell with the airframe, the actuators and the noise of the library
OSPREY = Cell("learn", "calm", 0.3)


class Row(NamedTuple):
    """One aircraft: its scores in the flight with gusts, or after damage.

    A score is NaN if its flight was not flown, and infinite if it ended early.
    """

    cell: str
    number: int
    alone: float = math.nan
    file: float = math.nan
    learner: float = math.nan
    true: float = math.nan
    late_alone: int = 0  # 1 if the linear loop is unstable with u late by LATE
    late_file: int = 0
    late_learner: int = 0
    late_true: int = 0
    # what `margin_left` returns, s; -1 if the loop is unstable
    margin_file: float = math.nan
    margin_learner: float = math.nan
    margin_true: float = math.nan
    first: float = math.nan  # instant from which the first model flew, s
    models: int = 0
    refused: int = 0
    alarms: int = 0  # alarms of the change test
    dead: str = ""  # the input without effect
    found: str = ""  # the input found to be without effect
    found_at: float = math.nan  # instant of this finding, s
    lost: int = 0  # 1 if the learner lost track and the law alone did not
    update: float = 0.0  # mean processor time of a step: identification, change test and design, s
    longest: float = 0.0  # longest processor time of such a step, s
    replayed: int = 0  # 1 if the flight replays
    # JSON of a flight with weak surfaces: the scores over WINDOWS, by "alone", "file", "true" and
    # "learner"
    windows: str = ""
    events: str = ""
    revision: str = ""  # commit of the code that flew


class Timed:
    """A learner that measures the processor time of its proposals, s."""

    def __init__(self, own: Learner) -> None:
        self._own, self.steps = own, list[float]()

    def take(self, stamp_ns: int, y: FloatArray, u: FloatArray, flown: int) -> None:
        """Take a tick, as the learner does."""
        self._own.take(stamp_ns, y, u, flown)

    def propose(self, flown: int, given_up: Sequence[str]) -> LearnerResult:
        """Propose a model, as the learner does."""
        begin = time.process_time()
        proposal = self._own.propose(flown, given_up)
        self.steps.append(time.process_time() - begin)
        return proposal


def learning(cell: Cell, number: int, duration: float, **changed: Any) -> Scenario:
    """Return osprey_learn at 100 Hz with an aircraft, wind and noise of its own.

    Its commands repeat.
    """
    shipped = find_scenario("osprey_learn")
    seed = {"seed": 1000 + number}
    sampled = {"A": cell.uncertainty, "B": cell.uncertainty, "seed": SEED, "number": number}
    air = AIR[cell.air]
    air = air | ({"turbulence": air["turbulence"] | seed} if air["turbulence"] else {})
    pulses: dict[str, dict[str, list[float]]] = {}
    for name, pulse in shipped.reference_model.pulses.items():
        begins = [REPEATED * k for k in range(math.ceil(duration / REPEATED))]
        times = {
            key: [begin + t for begin in begins for t in getattr(pulse, key)]
            for key in ("start", "stop")
        }
        pulses[name] = times | {"value": list(pulse.value) * len(begins)}
    aircraft: dict[str, Any] = {"rate": 100.0, "step": 0.005, "uncertainty": sampled}
    aircraft |= air | dict(cell.untold) | changed
    for key in ("sensors", "actuators"):
        section = getattr(shipped.aircraft, key).model_dump()
        aircraft[key] = section | aircraft.get(key, {})
    aircraft["sensors"] |= seed
    reference = {"rate": 100.0, "pulses": pulses}
    return shipped.vary(flight={"duration": duration}, aircraft=aircraft, reference_model=reference)


def evaluation(flown: Scenario) -> Scenario:
    """Return osprey_observer with the aircraft of a flight that learned.

    It has its own commands and two gusts. The noise differs from that of the flight.
    """
    shipped = find_scenario("osprey_observer")
    own = {
        key: getattr(flown.aircraft, key).model_dump()
        for key in ("uncertainty", "actuators", "sensors")
    }
    aircraft = own | {"airframe": flown.aircraft.airframe, "rate": 100.0, "step": 0.005}
    aircraft["inertial_coupling"] = flown.aircraft.inertial_coupling
    aircraft["sensors"]["seed"] += 5000
    return shipped.vary(aircraft=aircraft, reference_model={"rate": 100.0})


def score(
    tape: Tape, first: float = 0.0, without: Sequence[str] = (), end: float = math.inf
) -> float:
    """Return the sum of the true rms errors of the outputs, each in its unit of the score.

    It covers the instants from `first` until before `end`, s, and leaves out the outputs of
    `without`. It is infinite for a flight that ended early.
    """
    if tape.outcome != COMPLETED:
        return math.inf
    y_m = tape["y_m"]
    truth = tape["truth"]
    t = tape.time("y_m")
    outputs = tuple(name for name in y_m.names if name not in without)
    e = np.stack([truth[f"x.{name}"] - y_m[name] for name in outputs], axis=1)[
        (t >= first) & (t < end)
    ]
    return float(
        np.sum(
            np.sqrt(np.mean(e**2, axis=0))
            / score_units(outputs, load_airframe("osprey").units_of_outputs())
        )
    )


@cache
def file_design() -> RiseDiConfig | None:
    """Return the controller of the start, with feedforward and observer by the airframe file."""
    chosen = learning(OSPREY, 0, LEARNED)
    return designed(start_of(chosen), chosen, load_airframe("osprey"), uncertain=True)


def designed(
    start: RiseDiConfig, scenario: Scenario, model: Airframe, *, uncertain: bool = False
) -> RiseDiConfig | None:
    """Return the controller `start` with feedforward and observer by a model.

    Returns None if no relaxation of the observer has the margins.
    """
    try:
        return selected_observer(start, scenario, model, MARGIN, uncertain=uncertain).controller
    except ParameterError:
        return None


def is_unstable(controller: ControllerConfig, aircraft: Airframe) -> int:
    """Return 1 if the linear loop of an aircraft is unstable with u late by LATE, else 0."""
    rows, columns = law_order(aircraft, controller)
    plant = LinearPlant(
        aircraft.matrix_a() + aircraft.matrix_gravity(),
        aircraft.matrix_b()[:, columns],
        aircraft.matrix_c()[rows],
    )
    loop = LoopTiming(np.array(controller.lag), 0.0, 1.0 / controller.rate)
    m = len(columns)
    return int(
        not is_stable(
            plant, linear_law(controller.tuned_law(), m, loop.period), loop, np.full(m, LATE)
        )
    )


def margin_left(controller: RiseDiConfig, chosen: Scenario) -> float:
    """Return the delay margin that the loop of the true aircraft has left, s.

    It is the delay margin of the linear loop with the true lags, less the delays of the actuators
    and of y. It is -1 if the loop is unstable with these delays.
    """
    aircraft = chosen.aircraft
    true = aircraft.sampled_airframe()
    linear = linear_loop(controller, true, true.matrix_a()[None], true.matrix_b()[None])
    _, columns = law_order(true, controller)
    lag = np.array(aircraft.actuators.lag)[columns]
    period = 1.0 / controller.rate
    late = aircraft.actuators.delay + aircraft.sensors.delay
    plant = linear.plant._replace(A=linear.plant.A[0], B=linear.plant.B[0])
    if not is_stable(plant, linear.law, LoopTiming(lag, 0.0, period), np.full(len(lag), late)):
        return -1.0
    return loop_margins(linear._replace(loop=LoopTiming(lag, 0.0, period))).delay - late


class Learned(NamedTuple):
    """A flight that learned."""

    tape: Tape
    controller: RiseDiConfig  # the controller at the end of the flight, without the section learn
    row: Row


def fly(name: str, number: int, chosen: Scenario) -> Learned:
    """Fly a scenario that learns."""
    make = learner(chosen)
    events = list[Event]()
    timed = list[Timed]()
    assert make is not None  # noqa: S101 - for the type checker

    def watched(parameters: RiseDiConfig, make: Learn = make) -> Learner:
        timed.append(Timed(make(parameters)))
        return timed[0]

    tape = simulate(chosen, learn=watched, announce=events.append)
    controller: ControllerConfig = chosen.controller
    for change in tape.changes:
        controller = vary(controller, change)
    assert isinstance(controller, RiseDiConfig)  # noqa: S101 - for the type checker
    account = learned(tape, events)
    dead = [event for event in events if "has no effect" in event.sentence]
    found = dead[0].sentence.partition(" has no effect")[0].split()[-1] if dead else ""
    summary = Row(
        name,
        number,
        first=account.first_model,
        models=account.models,
        refused=account.refused,
        alarms=sum("changed, log-likelihood" in event.sentence for event in events),
        found=found,
        found_at=dead[0].stamp_ns / 1e9 if dead else math.nan,
        update=float(np.mean(timed[0].steps)),
        longest=max(timed[0].steps),
        replayed=int(replay(tape).is_equal()),
        events=" | ".join(f"{event.stamp_ns / 1e9:g} s: {event.sentence}" for event in events),
    )
    return Learned(tape, controller.model_copy(update={"learn": None}), summary)


def start_of(chosen: Scenario) -> RiseDiConfig:
    """Return the controller of the start, without the section learn."""
    return chosen.rise_di().model_copy(update={"learn": None})


@lru_cache(maxsize=4)
def beside(uncertainty: float, number: int) -> dict[str, tuple[float, int]]:
    """Fly an aircraft with the law alone, with the model of the file and with the true model.

    Returns the score in the flight with gusts, and 1 if the loop is unstable with u late by LATE,
    by "alone", "file" and "true". These are the same for every air in which the learner flies.
    """
    chosen = learning(Cell("learn", "calm", uncertainty), number, LEARNED)
    flight = evaluation(chosen)
    aircraft = chosen.aircraft.sampled_airframe()
    start = start_of(chosen)
    controllers = {
        "alone": start,
        "file": file_design(),
        "true": designed(start, chosen, aircraft),
    }
    return {key: frozen(controller, flight, aircraft) for key, controller in controllers.items()}


def frozen(
    controller: RiseDiConfig | None, flight: Scenario, aircraft: Airframe
) -> tuple[float, int]:
    """Return the score of a controller in a flight, and 1 if it is unstable with u late by LATE.

    The score is NaN without a controller.
    """
    if controller is None:
        return math.nan, 0
    return score(simulate(flight.vary(controller=controller))), is_unstable(controller, aircraft)


def learn(name: str, cell: Cell, number: int) -> Row:
    """Fly a learner, then its frozen model and what does not learn in the flight with gusts."""
    with TemporaryDirectory() as folder:
        chosen = learning(cell, number, LEARNED)
        others = (
            beside(cell.uncertainty, number) if cell.kind in {"learn", "turning", "rough"} else {}
        )
        if cell.kind == "rough":
            prior = rough(number)
            Path(folder, "prior.yaml").write_text(as_yaml(prior))
            chosen = with_prior(chosen, folder)
        elif cell.kind == "coupled":
            Path(folder, "prior.yaml").write_text(as_yaml(load_airframe("osprey")))
            Path(folder, "coupled.yaml").write_text(as_yaml(coupled(number)))
            chosen = with_prior(
                learning(cell, number, LEARNED, airframe=str(Path(folder, "coupled.yaml"))), folder
            )
        flown = fly(name, number, chosen)
        flight = evaluation(chosen)
        aircraft = chosen.aircraft.sampled_airframe()
        start = start_of(chosen)
        file = file_design()
        true = designed(start, chosen, aircraft)
        if cell.kind == "rough":
            file = designed(start, chosen, prior)
            others = others | {"file": frozen(file, flight, aircraft)}
        if cell.kind in {"coupled", "untold"}:
            controllers = {"alone": start, "file": file, "true": true}
            others = {
                key: frozen(controller, flight, aircraft) for key, controller in controllers.items()
            }
        others = others | {"learner": frozen(flown.controller, flight, aircraft)}
        loops = {"file": file, "learner": flown.controller, "true": true}
        values: dict[str, Any] = {
            f"margin_{key}": margin_left(controller, chosen)
            for key, controller in loops.items()
            if controller is not None
        }
    values |= {key: value for key, (value, _) in others.items()}
    values |= {f"late_{key}": late for key, (_, late) in others.items()}
    return flown.row._replace(**values)


def with_prior(chosen: Scenario, folder: str) -> Scenario:
    """Return a scenario whose learner begins with the airframe of a file."""
    settings = chosen.rise_di().model_dump()["learn"] | {
        "prior": {"file": str(Path(folder, "prior.yaml"))}
    }
    return chosen.vary(controller={"learn": settings})


def rough(number: int) -> Airframe:
    """Return a rough model of the osprey.

    Each entry of A and B has a random factor exp(ROUGH n), with n normal of variance 1. An entry of
    B that acts on an output directly is off by up to 30 % instead. The rows of theta and phi stay.
    """
    airframe = load_airframe("osprey")
    rng = np.random.default_rng([SEED, number])
    A = airframe.matrix_a()
    B = airframe.matrix_b()
    dynamic = np.array([[float(state not in {"theta", "phi"})] for state in airframe.states])
    direct = np.array([[float(state in airframe.outputs)] for state in airframe.states]) * (
        np.abs(B) > 0.0
    )
    of_A, of_B = (np.exp(ROUGH * dynamic * rng.standard_normal(matrix.shape)) for matrix in (A, B))
    of_B = np.where(direct > 0.0, 1.0 + rng.uniform(-0.3, 0.3, B.shape), of_B)
    return airframe.with_matrices(
        A * of_A, B * of_B, wind_factors(airframe, (A * of_A)[None], AIR_RELATIVE)[0]
    )


def coupled(number: int) -> Airframe:
    """Return the osprey with random entries of A and B that couple its two parts.

    An entry of B is at most COUPLING times the largest of its row. For A the row's root sum of
    squares takes its place, with V in m/s and the other states in 0.1 rad or 0.1 rad/s.
    As in the file, the effect of wind along an axis is minus a column of A.
    """
    airframe = load_airframe("osprey")
    rng = np.random.default_rng([SEED, number, 1])
    A = airframe.matrix_a()
    B = airframe.matrix_b()
    size = np.array([1.0 if name == "V" else 0.1 for name in airframe.states])
    of_lon = np.array([name in {"V", "alpha", "q", "theta"} for name in airframe.states])
    other = of_lon[:, None] != of_lon[None, :]
    other_input = (
        of_lon[:, None]
        != np.array([name in {"elevator", "thrust"} for name in airframe.inputs])[None, :]
    )
    dynamic = np.array([name not in {"theta", "phi"} for name in airframe.states])
    row_A = np.sqrt(np.sum((A * size) ** 2, axis=1))
    row_B = np.abs(B).max(axis=1)
    A = (
        A
        + COUPLING
        * rng.uniform(-1.0, 1.0, A.shape)
        * (row_A * dynamic)[:, None]
        / size
        * other
        * dynamic[None, :]
    )
    B = B + COUPLING * rng.uniform(-1.0, 1.0, B.shape) * (row_B * dynamic)[:, None] * other_input
    flown = airframe.with_matrices(A, B, wind_factors(airframe, A[None], AIR_RELATIVE)[0])
    gusts = {}
    for axis in flown.gusts:
        column = -A[:, flown.index(AIR_STATE[axis])] * (
            flown.speed if axis == "longitudinal" else 1.0
        )
        effects = zip(flown.states, column.tolist(), dynamic.tolist(), strict=True)
        gusts[axis] = {name: effect for name, effect, is_dynamic in effects if is_dynamic}
    return flown.model_copy(update={"gusts": gusts})


def damage(name: str, cell: Cell, number: int) -> Row:
    """Fly a learner, and what does not learn, when surfaces are damaged at DAMAGED s.

    In a cell of kind "weak" elevator and aileron lose half of their effect; in one of kind "dead"
    one surface loses all of it.
    """
    inputs = tuple(load_airframe("osprey").inputs)
    surfaces = [key for key in inputs if key != "thrust"]
    dead = surfaces[number % len(surfaces)] if cell.kind == "dead" else ""
    hit = {dead} if dead else {"elevator", "aileron"}
    kind = "lost" if dead else "weak"
    actuators = find_scenario("osprey_learn").aircraft.actuators.model_dump()
    actuators["faults"] = [f"{channel} {kind} {DAMAGED:g}" for channel in inputs if channel in hit]
    chosen = learning(cell, number, END, actuators=actuators)
    flown = fly(name, number, chosen)
    start = start_of(chosen)
    aircraft = chosen.aircraft.sampled_airframe()
    B = aircraft.matrix_b() * np.array([WEAK if channel in hit else 1.0 for channel in inputs])
    damaged = aircraft.with_matrices(aircraft.matrix_a(), B, np.ones((len(B), len(aircraft.gusts))))
    controllers = {"alone": start, "file": file_design()}
    controllers |= {} if dead else {"true": designed(start, chosen, damaged)}
    tapes = {
        key: simulate(chosen.vary(controller=value))
        for key, value in controllers.items()
        if value is not None
    }
    without = {"elevator": "q", "aileron": "p", "rudder": "r"}.get(dead, "")
    found: dict[str, Any] = {
        key: score(tape, SETTLED, (without,))
        for key, tape in (tapes | {"learner": flown.tape}).items()
    }
    lost = int(found["learner"] > LOSS_OF_TRACK_SCORE >= found["alone"])
    windows = (
        "" if dead else json.dumps(over_windows(tapes | {"learner": flown.tape}, chosen, aircraft))
    )
    return flown.row._replace(**found, dead=dead, lost=lost, windows=windows)


def over_windows(
    tapes: dict[str, Tape], chosen: Scenario, aircraft: Airframe
) -> dict[str, list[float]]:
    """Return the scores over WINDOWS of each flight, by its name.

    Before the damage, the scores of the true model are those of a flight with the model of the
    undamaged aircraft.
    """
    found = {
        key: [score(tape, first, (), end) for first, end in WINDOWS] for key, tape in tapes.items()
    }
    before = designed(start_of(chosen), chosen, aircraft)
    if "true" in found and before is not None:
        whole = simulate(chosen.vary(controller=before))
        found["true"] = [
            score(whole, first, (), end) if end <= DAMAGED else value
            for (first, end), value in zip(WINDOWS, found["true"], strict=True)
        ]
    return found


def alarms(name: str, cell: Cell, number: int) -> Row:
    """Fly a learner in a long flight without any damage."""
    return fly(name, number, learning(cell, number, ALARM_FLIGHT)).row


FLIGHTS = {
    "learn": learn,
    "turning": learn,
    "rough": learn,
    "coupled": learn,
    "untold": learn,
    "weak": damage,
    "dead": damage,
    "alarm": alarms,
}


def flown_rows(names: Sequence[str], number: int) -> list[Row]:
    """Return the rows of an aircraft in some cells."""
    return [FLIGHTS[CELLS[name].kind](name, CELLS[name], number) for name in names]
