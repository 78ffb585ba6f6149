# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""One procedure by which every law is tuned: CMA-ES over the logarithms of its gains, on the nominal aircraft or around it."""

from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
import yaml

from aircraft_sim.plant import PlantParams
from aircraft_sim.uncertainty import KINEMATIC, nominal_and_sampled
from control_laws.catalogue import LAWS, Gains, Law, start
from control_laws.nominal_model import NominalModel
from flight_analysis.closed_loop.scenario import Scenario
from flight_analysis.design.gain_selection import with_feedforward
from flight_campaign import fleet, statistics
from flight_campaign.benchmark_course import Course, build_course
from flight_campaign.fleet import Fleet, FleetResult, Vehicle
from flight_campaign.statistics import score_units
from flight_core.files import read_yaml
from flight_core.parameters import ParameterError, require
from flight_core.vectors import FloatArray

TUNED = Path(__file__).parent / "tuned"
"""Where the gains that were found lie, a file a scenario."""

ACTIVITY_UNIT = {"deg": np.deg2rad(60.0), "rad": np.deg2rad(60.0), "%": 6.0, "1": 6.0}
"""rad/s and 1/s by the unit of an input: mean abs(u_dot) that costs as much as one unit of error. 60 deg/s and 600 %/s."""

NOMINAL, UNCERTAIN, LATE = "nominal", "uncertain", "late"
"""What a cost flies: the nominal aircraft; it and uncertain ones, late inputs with the nominal alone; late inputs with all."""

OBJECTIVES = {
    NOMINAL: "the nominal aircraft",
    UNCERTAIN: "the nominal and 6 uncertain aircraft at +-40 %, with late inputs on the nominal one",
    LATE: "the nominal and 6 uncertain aircraft at +-40 %, with late inputs on all of them",
}

UNCERTAIN_AIRCRAFT, UNCERTAINTY, UNCERTAINTY_SEED = 6, 0.4, 40
"""So many uncertain aircraft, at +-UNCERTAINTY, with a seed that no campaign and no comparison draws from by default."""

EXTRA_DELAY_TICKS = 2
"""Ticks by which u is late in the third of the three flights of a cost: 20 ms at 100 Hz. Without actuators one tick, for the
loop's own lag is then 15 ms."""

POPULATION, GENERATIONS, GENERATIONS_PER_GAIN, INITIAL_SIGMA = 16, 88, 6, 0.4
"""GENERATIONS, 1408 evaluations a law and seed, or GENERATIONS_PER_GAIN of them a gain where that is more, which it is from 15 gains on.
INITIAL_SIGMA is the first standard deviation of log(gain)."""

MAX_COST = 1000.0
"""Cost of a flight that diverged, and the most that any flight costs."""

STEP = 0.005
"""s, of the integration, or a tick where that is shorter: as few steps as keep scores within 1 %."""


class Benchmark(NamedTuple):
    """Where laws are compared: one scenario, calm and with its gusts; the law's order of channels."""

    scenario: Scenario
    known: NominalModel
    unit: FloatArray  # (m,) of the errors in a score
    activity_unit: FloatArray  # (m,) of the mean abs(u_dot) in a cost
    plant: PlantParams
    vehicle: Vehicle
    courses: dict[bool, Course]  # without and with the feedforward
    extra_delay: int  # ticks by which u is late in a cost


def benchmark(scenario: Scenario) -> Benchmark:
    """The benchmark of a scenario: its manoeuvre, gusts, actuators and noise; y, y_m and law at one rate, topics take no time.

    Raises ParameterError for a scenario that a fleet cannot fly, and for outputs in units that a score does not count.
    """
    scenario = scenario.vary(
        aircraft={"rate": scenario.controller.rate, "step": min(STEP, 1.0 / scenario.controller.rate)},
        reference_model={"rate": scenario.controller.rate},
        controller={"delay": 0.0, "feedforward": None},
    )
    airframe, _ = scenario.aircraft.load()
    controller = scenario.controller
    ahead = scenario.vary(controller=with_feedforward(controller, airframe).model_dump())
    columns = [list(airframe.inputs).index(name) for name in controller.inputs]
    rows = [list(airframe.outputs).index(name) for name in controller.outputs]
    states, limits, m = list(airframe.states), scenario.aircraft.actuators, len(controller.inputs)

    def of(values: Iterable[float], otherwise: float) -> FloatArray:
        given = list(values) or [otherwise] * m
        return np.array([given[column] for column in columns])

    unit = score_units(controller.outputs, airframe.states)
    noise = scenario.aircraft.sensor_arrays().noise[rows]
    known = NominalModel(
        airframe.matrix_a(),
        airframe.matrix_b()[:, columns],
        airframe.matrix_c()[rows],
        airframe.matrix_gravity(),
        np.stack([airframe.gust_direction(axis) for axis in airframe.gusts], axis=1),
        np.where(noise > 0.0, noise, unit / 10.0),
        np.array([float(state in KINEMATIC) for state in states]),
        np.array([1.0 if unit in {"m/s", "ft/s"} else 0.1 for unit in airframe.states.values()]),
        np.array(controller.input_scale),
        np.array(controller.D, dtype=np.float64),
        np.array(controller.lag),
        np.array(controller.lag) + 1.5 / controller.rate,
        1.0 / controller.rate,
        of(limits.lower, -np.inf),
        of(limits.upper, np.inf),
        np.full(m, np.inf),
    )
    return Benchmark(
        scenario,
        known,
        unit,
        np.array([ACTIVITY_UNIT[airframe.inputs[name].unit] for name in controller.inputs]),
        scenario.aircraft.plant(),
        fleet.vehicle(scenario),
        {False: build_course(scenario), True: build_course(ahead)},
        EXTRA_DELAY_TICKS if any(controller.lag) else 1,
    )


def score(flown: FleetResult, unit: FloatArray) -> FloatArray:
    """Sum over the channels of rms of the true error / unit, shape (N,); infinite where a flight diverged."""
    total = statistics.score(np.asarray(flown.rms), unit)
    return np.where(np.asarray(flown.diverged) | ~np.isfinite(total), np.inf, total)


def cost(flown: FleetResult, here: Benchmark) -> FloatArray:
    """Score + sum over the channels of mean abs(u_dot) / activity_unit, shape (N,), at most MAX_COST."""
    activity = np.sum(np.asarray(flown.slew) / here.activity_unit[:, None], axis=0)
    total = score(flown, here.unit) + activity
    return np.where(np.isfinite(total), np.minimum(total, MAX_COST), MAX_COST)


def benchmark_fleet(A: FloatArray, B: FloatArray, wind: FloatArray, late: FloatArray, here: Benchmark) -> Fleet:
    """Aircraft in the benchmark, shapes as in `fleet.assemble`."""
    return fleet.assemble(A, B, here.plant, here.courses[False], wind, late)


class Evaluation(NamedTuple):
    """The flights of one evaluation and what each weighs."""

    fleet: Fleet
    weight: FloatArray  # (F,) of their costs in the sum


def evaluation(objective: str, here: Benchmark) -> Evaluation:
    """The flights of one evaluation: every aircraft in calm air and in gusts, some in gusts with u late by `extra_delay` ticks.

    The cost is the mean over the aircraft in calm air + that in the gusts + that of late flights.
    """
    airframe, _ = here.scenario.aircraft.load()
    A, B = nominal_and_sampled(airframe, UNCERTAINTY, 0 if objective == NOMINAL else UNCERTAIN_AIRCRAFT, UNCERTAINTY_SEED)
    aircraft = np.arange(len(A))
    delayed = aircraft if objective == LATE else aircraft[:1]
    of = np.concatenate([aircraft, aircraft, delayed])
    wind = np.repeat([0.0, 1.0, 1.0], [len(A), len(A), len(delayed)])
    late = np.repeat([0, 0, here.extra_delay], [len(A), len(A), len(delayed)])
    weight = np.repeat([1.0 / len(A), 1.0 / len(A), 1.0 / len(delayed)], [len(A), len(A), len(delayed)])
    return Evaluation(benchmark_fleet(A[of], B[of], wind, late, here), weight)


def repeat_flights(flights: Fleet, times: int) -> Fleet:
    """The same flights so many times over, one set after the other."""

    def tiled(one: FloatArray) -> FloatArray:
        return np.tile(np.asarray(one), times)

    return flights._replace(
        tick=tuple(tiled(block) for block in flights.tick),
        forced=tiled(flights.forced),
        rate=tiled(flights.rate),
        wind=tiled(flights.wind),
        late=tiled(flights.late),
    )


def spread_over(params: Any, flights: int, candidates: int) -> Any:
    """Parameters of so many candidates, each for all of its flights: (.., candidates) -> (.., candidates flights)."""

    def spread(leaf: FloatArray) -> FloatArray:
        return np.repeat(leaf, flights, axis=-1) if leaf.shape[-1] == candidates else leaf

    return jax.tree.map(spread, params)


class SearchSpace(NamedTuple):
    """Gains as one vector of logarithms."""

    names: tuple[str, ...]
    sizes: tuple[int, ...]
    origin: FloatArray

    def gains(self, vectors: FloatArray) -> Gains:
        """Gains by name, shape (size, N), of vectors (N, d)."""
        ends = np.cumsum(self.sizes)[:-1]
        return dict(zip(self.names, np.split(np.exp(vectors.T), ends), strict=True))


def space(begin: Gains) -> SearchSpace:
    """The search space around gains of shape (m, 1) or (1, 1)."""
    return SearchSpace(
        tuple(begin), tuple(len(gain) for gain in begin.values()), np.log(np.concatenate(list(begin.values()))[:, 0])
    )


class TuningResult(NamedTuple):
    """What a search came to."""

    gains: dict[str, list[float]]
    cost: float
    seed: int  # of the best
    costs: list[float]  # of all seeds
    evaluations: int  # of each


def generation_count(law: Law, here: Benchmark) -> int:
    """Generations of a search."""
    return max(GENERATIONS, GENERATIONS_PER_GAIN * len(space(start(law, here.known)).origin))


def tune(
    law: Law,
    objective: str,
    here: Benchmark,
    seeds: tuple[int, ...],
    generations: int | None = None,
    begin: Gains | None = None,
    progress: Callable[[int, float], None] | None = None,
) -> TuningResult:
    """The gains of least cost that CMA-ES finds from `begin`, the best of several seeds; all seeds fly together.

    The cost of a candidate is the weighted sum over the flights of `evaluation`. `progress` is told the generation and the least
    cost so far. Source: N. Hansen, A. Ostermeier, Evolutionary Computation 9(2), 2001; the package `cma`.
    """
    import cma  # noqa: PLC0415 - it takes its plotting along, which nothing here draws with

    searched = space(start(law, here.known) if begin is None else begin)
    flights, weight = evaluation(objective, here)
    each, candidates = len(weight), POPULATION * len(seeds)
    flown, control_law, course = repeat_flights(flights, candidates), law.control_law(here.known), here.courses[law.feedforward]
    searches = [
        cma.CMAEvolutionStrategy(searched.origin, INITIAL_SIGMA, {"seed": seed, "popsize": POPULATION, "verbose": -9})
        for seed in seeds
    ]
    best: list[tuple[float, FloatArray]] = [(np.inf, searched.origin)] * len(seeds)
    generations = generation_count(law, here) if generations is None else generations
    for generation in range(generations):
        asked = [np.array(search.ask()) for search in searches]
        vectors = np.concatenate(asked)
        params = spread_over(law.params(searched.gains(vectors), here.known), each, candidates)
        costs = cost(fleet.fly(flown, here.vehicle, course, control_law, params), here)
        of_each = costs.reshape(candidates, each) @ weight
        for k, (search, found) in enumerate(zip(searches, np.split(of_each, len(seeds)), strict=True)):
            search.tell(list(asked[k]), list(found))
            least = int(np.argmin(found))
            if found[least] < best[k][0]:
                best[k] = (float(found[least]), asked[k][least])
        if progress is not None:
            progress(generation + 1, min(value for value, _ in best))
    winner = int(np.argmin([value for value, _ in best]))
    gains = {name: [float(f"{v:.5g}") for v in gain[:, 0]] for name, gain in searched.gains(best[winner][1][None]).items()}
    values = [round(value, 4) for value, _ in best]
    return TuningResult(gains, values[winner], seeds[winner], values, generations * POPULATION)


# The files of gains


def tuned_file(scenario: Scenario) -> Path:
    """Where the tuned gains of a scenario lie."""
    return TUNED / f"{scenario.name}.yaml"


def load(path: Path) -> dict[str, dict[str, TuningResult]]:
    """TuningResult gains by law and aim; empty where there is no file. Raises ParameterError for one that cannot be read."""
    if not path.exists():
        return {}
    found = read_yaml(path, path.name, "a file of tuned gains")
    try:
        return {law: {objective: TuningResult(**entry) for objective, entry in by_aim.items()} for law, by_aim in found["laws"].items()}
    except (TypeError, KeyError, AttributeError) as error:
        raise ParameterError(f"{path.name}: found {error}, expected laws, each with gains by aim") from None


def save(path: Path, tuned: Mapping[str, Mapping[str, TuningResult]], command: str) -> None:
    """Write tuned gains, what they cost and the command that finds them."""
    path.parent.mkdir(exist_ok=True)
    laws = {law: {objective: entry._asdict() for objective, entry in by_aim.items()} for law, by_aim in tuned.items()}
    head = (
        "# SPDX-FileCopyrightText: RISE-DI contributors\n# SPDX-License-Identifier: Apache-2.0\n#\n"
        "# Gains found by CMA-ES, in the law's order of channels and its scaled inputs; cost, seed, evaluations of a search.\n"
        f"# Made by: {command}\n"
    )
    text = yaml.safe_dump({"laws": laws}, sort_keys=False, default_flow_style=None, width=128)
    path.write_text(head + text, encoding="utf-8")


def as_gains(tuned: TuningResult) -> Gains:
    """Gains of shape (m, 1) and (1, 1)."""
    return {name: np.array(values)[:, None] for name, values in tuned.gains.items()}


def require_laws(names: Iterable[str]) -> None:
    """Raises ParameterError for a law that is not known."""
    for name in names:
        require(name in LAWS, "--laws", f"{name!r}", f"laws among {', '.join(LAWS)}")
