# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Learning in the air: uncertain aircraft that learn in every air, beside the law alone, the file's
model and the true one.

python -m benchmarks.learning  # every cell, 50 aircraft: at most 90 min on two idle cores
python -m benchmarks.learning --aircraft 6  # with fewer; run again, it flies what is missing
python -m benchmarks.learning --aircraft 20 --cell "rough prior"  # of one cell

An aircraft learns for 64 s of osprey_learn. The model that flies then is frozen and flies the
commands and the two gusts of osprey_observer, as the others do, and as the laws of `rise-di
compare` do with their gains for the airframe file. A row an aircraft goes to build/learning.csv.
The figures of the cells that were flown whole go to docs/evidence/learning.csv, and where the airs
of both uncertainties were, the picture goes to docs/images/learning.png. An aircraft takes 2 to 3
min of a core over all cells. For false alarms at most two aircraft fly 600 s without damage in each
air, 2 min of a core each.
"""

import csv
import json
import math
import sys
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from functools import lru_cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, Any, NamedTuple

import numpy as np
import typer
from benchmarks import evidence
from benchmarks.evidence import row
from benchmarks.tables import plain, save_picture
from matplotlib.figure import Figure
from rich.progress import track

from aircraft_sim.airframe import Airframe, load_airframe
from aircraft_sim.turbulence import MODERATE
from aircraft_sim.uncertainty import AIR_RELATIVE, as_yaml, sampled_matrices, wind_factors
from control_laws.catalogue import LAWS
from flight_analysis.closed_loop.learning_loop import Learn, Learner, LearnerResult
from flight_analysis.closed_loop.loop_margins import law_order
from flight_analysis.closed_loop.replay import replay
from flight_analysis.closed_loop.replay_ticks import vary
from flight_analysis.closed_loop.scenario import Scenario
from flight_analysis.closed_loop.scenario_library import find_scenario
from flight_analysis.closed_loop.simulate import simulate
from flight_campaign import batch, tuning
from flight_campaign.learning_flights import learned
from flight_campaign.statistics import LOSS_OF_TRACK_SCORE, score_units
from flight_core.outcome import COMPLETED
from flight_core.parameters import ParameterError
from flight_core.tape import Tape
from flight_core.vectors import FloatArray
from flight_design.gains.gain_design import observed
from flight_design.gains.tuned_gains import load, tuned_file
from flight_design.learning.scenario_learner import learner
from rise_di_controller.linear_loop import LinearPlant, Loop, is_stable, linear_law
from rise_di_controller.params import ControllerConfig
from rise_di_controller.proposals import Event
from rise_di_controller.rise_di_config import RiseDiConfig

REPOSITORY = Path(__file__).parents[1]
IMAGE = REPOSITORY / "docs" / "images" / "learning.png"
SEED = 11  # of the aircraft
LEARNED, DAMAGED, SETTLED, END = (
    64.0,
    60.0,
    75.0,
    100.0,
)  # s: when the last model flies; the fault, and what counts after it
WINDOWS = ((0.0, 14.0), (14.0, 30.0), (30.0, DAMAGED), (DAMAGED, SETTLED), (SETTLED, END))
"""s, of a flight with damage: before the first model, with the first ones, learned, from the damage
on, and learned again."""
UPDATE = 1.0  # s, of a core, for the two parts of the osprey
LATE, MARGIN, WITHIN = 0.02, 0.03, 1.1  # s, s; a score within 10 % of that of the true model
REPEATED = 35.0  # s, after which the commands of osprey_learn come again
ROUGH = 0.6  # deviation of the logarithms of the entries of a rough prior
WEAK, COUPLING = 0.5, 0.1
ALARM_FLIGHT = 600.0  # s
COLOURS = {"alone": "#888888", "file": "#d08020", "learner": "#2060b0", "true": "#208050"}
LABELS = {
    "alone": "the law alone",
    "file": "model of the file",
    "learner": "learner",
    "true": "true model",
}
RIVALS, OBJECTIVE = (
    ("rise", "pi", "l1", "indi", "mrac", "self_tuner", "lqg", "rise_observer"),
    "gust_turbulence",
)
"""Laws of the catalogue with the gains that ship, of a search with this cost on the airframe file
in the loop of osprey_servo. MRAC measures the full state, and INDI the actuators too."""
TRAIN = {  # m/s, m, s: a gust every 3 to 7 s
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

    kind: str  # "learn", "turning", "rough", "coupled", "late", "weak", "dead" or "alarm"
    air: str
    uncertainty: float
    share: float = 1.0  # of --aircraft
    most: int = sys.maxsize  # aircraft


CELLS = {
    f"{air}, +-{100 * p:.0f} %": Cell("learn", air, p)
    for air in ("turbulence", "gusts", "calm")
    for p in (0.3, 0.5)
} | {
    "rough prior": Cell("rough", "turbulence", 0.3, 0.5),
    "air that turns": Cell("turning", "air that turns", 0.3, 0.25),
    "coupled": Cell("coupled", "turbulence", 0.3, 0.25),
    "u late": Cell("late", "turbulence", 0.3, 0.25),
    "weak": Cell("weak", "turbulence", 0.3, 0.5),
    "dead": Cell("dead", "turbulence", 0.3, 0.5),
    **{f"alarms in {air}": Cell("alarm", air, 0.3, 0.1, 2) for air in AIR},
}


OSPREY = Cell(
    "learn", "calm", 0.3
)  # any cell with the airframe, the actuators and the noise of the library


class Row(NamedTuple):
    """One aircraft. Scores in the flight with gusts, or after damage; NaN for what was not
    flown.
    """

    cell: str
    number: int
    alone: float = math.nan
    file: float = math.nan
    learner: float = math.nan
    true: float = math.nan
    late_alone: int = 0  # 1: unstable with u LATE
    late_file: int = 0
    late_learner: int = 0
    late_true: int = 0
    first: float = math.nan  # s, when the first model flew
    models: int = 0
    refused: int = 0
    alarms: int = 0  # of the change test
    dead: str = ""  # the input without effect
    found: str = ""  # the input found to be without effect
    found_at: float = math.nan  # s
    lost: int = 0  # 1: with the learner alone of the two
    update: float = 0.0  # s of a core, mean: identification, test for a change and design
    longest: float = 0.0  # s of a core, the same
    replayed: int = 0
    windows: str = (
        ""  # JSON: the scores over WINDOWS of each, after half of elevator and aileron was lost
    )
    events: str = ""
    revision: str = ""  # of the code that flew


class Timed:
    """A learner, and how long its steps take on one core."""

    def __init__(self, own: Learner) -> None:
        self._own, self.steps = own, list[float]()

    def take(self, stamp_ns: int, y: FloatArray, u: FloatArray, flown: int) -> None:
        """Of the learner."""
        self._own.take(stamp_ns, y, u, flown)

    def propose(self, flown: int, given_up: Sequence[str]) -> LearnerResult:
        """Of the learner."""
        begin = time.process_time()
        proposal = self._own.propose(flown, given_up)
        self.steps.append(time.process_time() - begin)
        return proposal


def learning(cell: Cell, number: int, duration: float, **changed: Any) -> Scenario:
    """osprey_learn at 100 Hz with an aircraft, wind and noise of its own, and its commands again
    and again.
    """
    shipped, seed = find_scenario("osprey_learn"), {"seed": 1000 + number}
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
    sensors = (
        shipped.aircraft.sensors.model_dump()
        | seed
        | ({"delay": LATE} if cell.kind == "late" else {})
    )
    aircraft = (
        {"rate": 100.0, "step": 0.005, "uncertainty": sampled, "sensors": sensors} | air | changed
    )
    reference = {"rate": 100.0, "pulses": pulses}
    return shipped.vary(flight={"duration": duration}, aircraft=aircraft, reference_model=reference)


def evaluation(flown: Scenario) -> Scenario:
    """osprey_observer, its commands and two gusts, with the aircraft of a flight that learned and
    other noise.
    """
    shipped = find_scenario("osprey_observer")
    own = {
        key: getattr(flown.aircraft, key).model_dump()
        for key in ("uncertainty", "actuators", "sensors")
    }
    aircraft = own | {"airframe": flown.aircraft.airframe, "rate": 100.0, "step": 0.005}
    aircraft["sensors"]["seed"] += 5000
    return shipped.vary(aircraft=aircraft, reference_model={"rate": 100.0})


def score(
    tape: Tape, first: float = 0.0, without: Sequence[str] = (), end: float = math.inf
) -> float:
    """Sum over the outputs of the true rms error in units of a score; infinite for a flight that
    ended early.
    """
    if tape.outcome != COMPLETED:
        return math.inf
    y_m, truth, t = tape["y_m"], tape["truth"], tape.time("y_m")
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


@lru_cache(maxsize=4)
def file_design(cell: Cell) -> RiseDiConfig | None:
    """The start of a cell with feedforward and observer of the file."""
    chosen = learning(cell, 0, LEARNED)
    return designed(start_of(chosen), chosen, load_airframe("osprey"), uncertain=True)


def designed(
    start: RiseDiConfig, scenario: Scenario, model: Airframe, *, uncertain: bool = False
) -> RiseDiConfig | None:
    """The start with feedforward and observer of a model; None where no relaxation has the
    margins.
    """
    try:
        return observed(start, scenario, model, MARGIN, uncertain=uncertain)[0]
    except ParameterError:
        return None


def is_unstable(controller: ControllerConfig, aircraft: Airframe) -> int:
    """1 where the linear loop of an aircraft is unstable with u LATE, else 0."""
    rows, columns = law_order(aircraft, controller)
    plant = LinearPlant(
        aircraft.matrix_a() + aircraft.matrix_gravity(),
        aircraft.matrix_b()[:, columns],
        aircraft.matrix_c()[rows],
    )
    loop, m = Loop(np.array(controller.lag), 0.0, 1.0 / controller.rate), len(columns)
    return int(
        not is_stable(
            plant, linear_law(controller.tuned_law(), m, loop.period), loop, np.full(m, LATE)
        )
    )


class Learned(NamedTuple):
    """A flight that learned."""

    tape: Tape
    controller: RiseDiConfig  # at its end, without the section learn
    row: Row


def fly(name: str, number: int, chosen: Scenario) -> Learned:
    """Fly a scenario that learns."""
    make, events, timed = learner(chosen), list[Event](), list[Timed]()
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
        replayed=int(replay(tape).equal()),
        events=" | ".join(f"{event.stamp_ns / 1e9:g} s: {event.sentence}" for event in events),
    )
    return Learned(tape, controller.model_copy(update={"learn": None}), summary)


def start_of(chosen: Scenario) -> RiseDiConfig:
    """The controller of the start, without the section learn."""
    return chosen.rise_di().model_copy(update={"learn": None})


@lru_cache(maxsize=4)
def beside(uncertainty: float, number: int) -> dict[str, tuple[float, int]]:
    """Score in the flight with gusts, and whether unstable with u late, of what does not learn: the
    same in every air.
    """
    chosen = learning(Cell("learn", "calm", uncertainty), number, LEARNED)
    flight, aircraft, start = (
        evaluation(chosen),
        chosen.aircraft.sampled_airframe(),
        start_of(chosen),
    )
    controllers = {
        "alone": start,
        "file": file_design(OSPREY),
        "true": designed(start, chosen, aircraft),
    }
    return {key: frozen(controller, flight, aircraft) for key, controller in controllers.items()}


def frozen(
    controller: RiseDiConfig | None, flight: Scenario, aircraft: Airframe
) -> tuple[float, int]:
    """Score of a controller in a flight, and whether it is unstable with u late."""
    if controller is None:
        return math.nan, 0
    return score(simulate(flight.vary(controller=controller))), is_unstable(controller, aircraft)


def learn(name: str, cell: Cell, number: int) -> Row:
    """A learner beside what does not learn."""
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
        flight, aircraft, start = (
            evaluation(chosen),
            chosen.aircraft.sampled_airframe(),
            start_of(chosen),
        )
        if cell.kind == "rough":
            others = others | {"file": frozen(designed(start, chosen, prior), flight, aircraft)}
        if cell.kind in {"coupled", "late"}:
            models = {"file": load_airframe("osprey"), "true": aircraft}
            controllers = {"alone": start} | {
                key: designed(start, chosen, model) for key, model in models.items()
            }
            others = {
                key: frozen(controller, flight, aircraft) for key, controller in controllers.items()
            }
        others = others | {"learner": frozen(flown.controller, flight, aircraft)}
    values: dict[str, Any] = {key: value for key, (value, _) in others.items()}
    values |= {f"late_{key}": late for key, (_, late) in others.items()}
    return flown.row._replace(**values)


def with_prior(chosen: Scenario, folder: str) -> Scenario:
    """A scenario whose learner begins with the airframe of a file."""
    settings = chosen.rise_di().model_dump()["learn"] | {
        "prior": {"file": str(Path(folder, "prior.yaml"))}
    }
    return chosen.vary(controller={"learn": settings})


def rough(number: int) -> Airframe:
    """The osprey with every entry off by a factor exp(ROUGH N), those of C B by up to 30 %; rows of
    angles stay.
    """
    airframe, rng = load_airframe("osprey"), np.random.default_rng([SEED, number])
    A, B = airframe.matrix_a(), airframe.matrix_b()
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
    """The osprey with entries between its two parts of up to COUPLING of the largest effect on the
    row, in units of motion.
    """
    airframe, rng = load_airframe("osprey"), np.random.default_rng([SEED, number, 1])
    A, B, size = (
        airframe.matrix_a(),
        airframe.matrix_b(),
        np.array([1.0 if name == "V" else 0.1 for name in airframe.states]),
    )
    of_lon = np.array([name in {"V", "alpha", "q", "theta"} for name in airframe.states])
    other = of_lon[:, None] != of_lon[None, :]
    other_input = (
        of_lon[:, None]
        != np.array([name in {"elevator", "thrust"} for name in airframe.inputs])[None, :]
    )
    dynamic = np.array([name not in {"theta", "phi"} for name in airframe.states])
    row_A, row_B = np.sqrt(np.sum((A * size) ** 2, axis=1)), np.abs(B).max(axis=1)
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
    return airframe.with_matrices(A, B, wind_factors(airframe, A[None], AIR_RELATIVE)[0])


def damage(name: str, cell: Cell, number: int) -> Row:
    """A learner beside the others when elevator and aileron lose half of their effect, or one
    surface all of it.
    """
    inputs = tuple(load_airframe("osprey").inputs)
    surfaces = [key for key in inputs if key != "thrust"]
    dead = surfaces[number % len(surfaces)] if cell.kind == "dead" else ""
    hit = {dead} if dead else {"elevator", "aileron"}
    kind = "lost" if dead else "weak"
    actuators = find_scenario("osprey_learn").aircraft.actuators.model_dump()
    actuators["faults"] = [f"{channel} {kind} {DAMAGED:g}" for channel in inputs if channel in hit]
    chosen = learning(cell, number, END, actuators=actuators)
    flown, start = fly(name, number, chosen), start_of(chosen)
    aircraft = chosen.aircraft.sampled_airframe()
    B = aircraft.matrix_b() * np.array([WEAK if channel in hit else 1.0 for channel in inputs])
    damaged = aircraft.with_matrices(aircraft.matrix_a(), B, np.ones((len(B), len(aircraft.gusts))))
    controllers = {"alone": start, "file": file_design(OSPREY)}
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
    """Scores over WINDOWS; those of the true model until the damage with the model of the aircraft
    as it was.
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
    """A learner in a long flight without any damage."""
    return fly(name, number, learning(cell, number, ALARM_FLIGHT)).row


FLIGHTS = {
    "learn": learn,
    "turning": learn,
    "rough": learn,
    "coupled": learn,
    "late": learn,
    "weak": damage,
    "dead": damage,
    "alarm": alarms,
}


def count(name: str, aircraft: int) -> int:
    """The number of aircraft in a cell."""
    return min(math.ceil(CELLS[name].share * aircraft), CELLS[name].most)


def flown_rows(names: Sequence[str], number: int) -> list[Row]:
    """The rows of an aircraft in some cells."""
    return [FLIGHTS[CELLS[name].kind](name, CELLS[name], number) for name in names]


def code() -> list[str]:
    """The paths of the code that flies: this file, and the packages of this stack that it
    imports.
    """
    sources = REPOSITORY / "ros_ws" / "src"
    imported = {name.partition(".")[0] for name in sys.modules} & {
        folder.name for folder in sources.iterdir()
    }
    return [
        f"benchmarks/{Path(__file__).name}",
        *(f"ros_ws/src/{name}" for name in sorted(imported)),
    ]


# The results


def read(path: Path) -> list[Row]:
    """The rows of a file of results; none of a file with other columns, which an earlier version
    wrote.
    """
    if not path.exists():
        return []
    with path.open(newline="") as stream:
        lines = csv.DictReader(stream)
        if tuple(lines.fieldnames or ()) != Row._fields:
            return []
        return [
            Row(*(kind(value) for kind, value in zip(KINDS, line.values(), strict=True)))
            for line in lines
        ]


KINDS = tuple(Row.__annotations__.values())


def write(path: Path, rows: Sequence[Row]) -> None:
    """Write the rows, sorted."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w", newline="") as stream:
        writer = csv.writer(stream, lineterminator="\n")
        writer.writerows(
            (
                Row._fields,
                *sorted(rows, key=lambda each: (list(CELLS).index(each.cell), each.number)),
            )
        )


def figures(rows: Sequence[Row]) -> Iterator[evidence.Row]:
    """The figures of every cell, with their goals."""
    for name, cell in CELLS.items():
        chosen = [each for each in rows if each.cell == name]
        if chosen:
            yield row(f"{name}: aircraft", float(len(chosen)))
            yield row(
                f"{name}: replay equal",
                float(np.mean([each.replayed for each in chosen])),
                at_least=1.0,
            )
            yield row(
                f"{name}: update, mean",
                float(np.mean([each.update for each in chosen])),
                "s",
                at_most=UPDATE,
            )
            yield row(f"{name}: update, longest", max(each.longest for each in chosen), "s")
            yield from CELL_FIGURES[cell.kind](name, cell, chosen)


def learn_figures(name: str, cell: Cell, chosen: Sequence[Row]) -> Iterator[evidence.Row]:
    """Scores beside those of the others."""
    yield from scores(name, chosen)
    known = [each for each in chosen if not math.isnan(each.true)]
    shares = {"learn": 0.95 if cell.uncertainty < 0.5 else 0.9, "turning": 0.75, "rough": 0.75}
    near = shares.get(cell.kind)
    within = COUPLED_WITHIN if cell.kind == "coupled" else WITHIN
    share = float(np.mean([each.learner <= within * each.true for each in known]))
    yield row(
        f"{name}: share within {100 * (within - 1.0):.0f} % of the true model", share, at_least=near
    )
    yield row(
        f"{name}: worse than the law alone",
        float(sum(each.learner > each.alone for each in chosen)),
        at_most=0.0,
    )
    for key, label in LABELS.items():
        unstable = float(np.mean([getattr(each, f"late_{key}") for each in chosen]))
        limit = (0.0 if cell.uncertainty < 0.5 else 0.01) if key == "learner" else None
        yield row(
            f"{name}: share unstable with u {1e3 * LATE:.0f} ms late, {label}",
            unstable,
            at_most=limit,
        )
    begun = [each.first for each in chosen if not math.isnan(each.first)]
    yield row(f"{name}: without a model", float(len(chosen) - len(begun)))
    if begun:
        yield row(f"{name}: first model, median", float(np.median(begun)), "s")


def scores(name: str, chosen: Sequence[Row]) -> Iterator[evidence.Row]:
    """Lost flights, and mean and largest score of the flights to the end, of each."""
    for key, label in LABELS.items():
        values = np.array([getattr(each, key) for each in chosen])
        flown, whole = values[~np.isnan(values)], values[np.isfinite(values)]
        if len(flown):
            lost = float(len(flown) - len(whole))
            yield row(f"{name}: lost, {label}", lost, at_most=0.0 if key == "learner" else None)
        if len(whole):
            yield row(f"{name}: score, {label}", float(np.mean(whole)))
            yield row(f"{name}: largest score, {label}", float(np.max(whole)))


def damage_figures(name: str, cell: Cell, chosen: Sequence[Row]) -> Iterator[evidence.Row]:
    """Scores from SETTLED on; whether a dead input was found in time."""
    yield from scores(name, chosen)
    yield row(
        f"{name}: lost with the learner and not with the law alone",
        float(sum(each.lost for each in chosen)),
        at_most=0.0,
    )
    if cell.kind == "weak":
        ratio = np.mean([each.learner for each in chosen]) / np.mean([each.true for each in chosen])
        yield row(f"{name}: mean over that of the true model", float(ratio), at_most=1.05)
        yield row(
            f"{name}: share found to have changed",
            float(np.mean([each.alarms > 0 for each in chosen])),
        )
        flown = [json.loads(each.windows) for each in chosen]
        for key, label in LABELS.items():
            yield from window_figures(
                name, label, np.array([each[key] for each in flown if key in each])
            )
        return
    right = [each.found == each.dead and each.found_at <= SETTLED for each in chosen]
    yield row(
        f"{name}: share found within {SETTLED - DAMAGED:.0f} s",
        float(np.mean(right)),
        at_least=0.95,
    )
    wrong = [each.found not in {"", each.dead} for each in chosen]
    yield row(f"{name}: another input found", float(sum(wrong)), at_most=0.0)


def window_figures(name: str, label: str, values: FloatArray) -> Iterator[evidence.Row]:
    """Mean scores over WINDOWS of the flights to the end, of scores (N, W)."""
    if len(whole := values[np.isfinite(values).all(axis=1)]):
        for (first, end), mean in zip(WINDOWS, whole.mean(axis=0), strict=True):
            yield row(f"{name}: score from {first:g} to {end:g} s, {label}", float(mean))


def alarm_figures(name: str, cell: Cell, chosen: Sequence[Row]) -> Iterator[evidence.Row]:
    """Alarms without damage."""
    yield row(f"{name}: flight time", ALARM_FLIGHT / 60.0 * len(chosen), "min")
    yield row(
        f"{name}: false alarms",
        float(sum(each.alarms + (each.found != "") for each in chosen)),
        at_most=0.0,
    )


COUPLED_WITHIN = 1.15
CELL_FIGURES = {
    "learn": learn_figures,
    "turning": learn_figures,
    "rough": learn_figures,
    "coupled": learn_figures,
    "late": learn_figures,
    "weak": damage_figures,
    "dead": damage_figures,
    "alarm": alarm_figures,
}


def rival_figures(uncertainty: float, numbers: Sequence[int]) -> Iterator[evidence.Row]:
    """Scores of the laws of RIVALS in the flight with gusts, and the share that loses track there
    with u LATE.

    All aircraft have the same noise. Each law has its model and gains by the airframe file.
    """
    benchmark = tuning.build_benchmark(find_scenario("osprey_observer"))
    tuned = load(tuned_file(find_scenario("osprey_servo")))
    A, B = sampled_matrices(
        load_airframe("osprey"), uncertainty, uncertainty, SEED, 0, max(numbers) + 1
    )
    of = np.tile(np.array(numbers), 2)
    late = np.repeat([0, round(LATE / benchmark.model.period)], len(numbers))
    flights = tuning.benchmark_fleet(A[of], B[of], late, tuning.GUST, benchmark)
    for name in RIVALS:
        law = LAWS[name]
        params = law.params(tuning.as_gains(tuned[name][OBJECTIVE]), benchmark.model)
        course = benchmark.courses[tuning.GUST][law.feedforward]
        flown = batch.fly(
            flights, benchmark.vehicle, course, law.control_law(benchmark.model), params
        )
        in_time, delayed = np.split(tuning.score(flown, benchmark.unit), 2)
        subject = f"rivals, +-{100 * uncertainty:.0f} %"
        yield row(f"{subject}: score, {law.title}", float(np.mean(in_time)))
        yield row(f"{subject}: largest score, {law.title}", float(np.max(in_time)))
        lost = float(np.mean(delayed > LOSS_OF_TRACK_SCORE))
        yield row(f"{subject}: share lost with u {1e3 * LATE:.0f} ms late, {law.title}", lost)


def plot(rows: Sequence[Row]) -> Figure:
    """The score of every aircraft in the flight with gusts, a panel an uncertainty; the bar is the
    mean.
    """
    figure = Figure(figsize=(9.0, 3.6), layout="constrained")
    for axis, uncertainty in zip(figure.subplots(1, 2, sharey=True), (0.3, 0.5), strict=True):
        columns: dict[str, tuple[str, list[float]]] = {}
        for name, cell in CELLS.items():
            if cell.kind == "learn" and cell.uncertainty == uncertainty:
                chosen = [each for each in rows if each.cell == name]
                for key in ("alone", "file", "true"):
                    columns.setdefault(
                        LABELS[key].replace(" of", "\nof"),
                        (COLOURS[key], [getattr(each, key) for each in chosen]),
                    )
                columns[f"learned in\n{cell.air}"] = (
                    COLOURS["learner"],
                    [each.learner for each in chosen],
                )
        for place, (colour, values) in enumerate(columns.values()):
            spread = place + 0.5 * (np.arange(len(values)) / max(len(values) - 1, 1) - 0.5)
            axis.plot(spread, values, ".", color=colour, markersize=3, alpha=0.6)
            axis.plot(
                [place - 0.35, place + 0.35], [np.nanmean(values)] * 2, color=colour, linewidth=2.2
            )
        axis.set_xticks(range(len(columns)), list(columns), fontsize=7)
        plain(axis, f"A and B +-{100 * uncertainty:g} %: score", lines="y")
    axis.set_ylim(
        bottom=0.0
    )  # of both panels, once all points are drawn: it ends the automatic limits
    return figure


def main(
    aircraft: Annotated[
        int, typer.Option(min=1, help="Aircraft of a cell; some have a part of it.")
    ] = 50,
    cell: Annotated[list[str], typer.Option(help="Cells; all where absent.")] = list(CELLS),  # noqa: B006 - typer copies it
    results: Annotated[Path, typer.Option(help="File of results, a row an aircraft.")] = REPOSITORY
    / "build"
    / "learning.csv",
    jobs: Annotated[int, typer.Option(min=1, help="Processes.")] = 2,
) -> None:
    """Fly the aircraft that are missing in the results, and write the figures and the picture.

    Rows that other code flew are flown again, and all where that code is not committed: the
    revision of a row is the last one that touched the code that flies.
    """
    if unknown := [name for name in cell if name not in CELLS]:
        raise typer.BadParameter(
            f"found {', '.join(unknown)}, expected cells among {', '.join(CELLS)}"
        )
    begun = evidence.origin(f"python -m benchmarks.learning --aircraft {aircraft}")
    flown_by = evidence.revision(*code())
    rows = [
        each
        for each in read(results)
        if each.revision == flown_by and not flown_by.endswith(evidence.DIRTY)
    ]
    known = {(each.cell, each.number) for each in rows}
    # aircraft by aircraft, so that a run that ends early has some of each cell
    cases: dict[tuple[int, float, str], list[str]] = {}
    for n in range(aircraft):
        for name in cell:
            if n < count(name, aircraft) and (name, n) not in known:
                # what flies beside is the same in all cells of an uncertainty
                shared = "" if CELLS[name].kind == "learn" else name
                cases.setdefault((n, CELLS[name].uncertainty, shared), []).append(name)
    with ProcessPoolExecutor(jobs) as pool:
        pending = [pool.submit(flown_rows, names, n) for (n, _, _), names in cases.items()]
        for future in track(as_completed(pending), "aircraft", total=len(pending)):
            rows += [each._replace(revision=flown_by) for each in future.result()]
            write(results, rows)
    rows = [each for each in rows if each.number < count(each.cell, aircraft)]
    whole = [
        name for name in CELLS if sum(each.cell == name for each in rows) == count(name, aircraft)
    ]
    rows = [each for each in rows if each.cell in whole]
    found, airs = list(figures(rows)), [name for name in CELLS if CELLS[name].kind == "learn"]
    for uncertainty in sorted({CELLS[name].uncertainty for name in airs if name in whole}):
        found += rival_figures(uncertainty, range(aircraft))
    for each in found:
        print(each.name, each.value, each.unit, each.goal and f"(goal {each.goal})")
    if found:
        evidence.write("learning", found, begun)
    if set(airs) <= set(whole):
        save_picture(plot(rows), IMAGE, colours=32)


if __name__ == "__main__":
    typer.run(main)
