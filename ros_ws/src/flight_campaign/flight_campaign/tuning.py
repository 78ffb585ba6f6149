# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""One tuning procedure for every law: CMA-ES over the logarithms of its gains, on the nominal aircraft or around it."""

from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
import yaml

from aircraft_sim.plant import PlantParams
from aircraft_sim.uncertainty import KINEMATIC, nominal_and_sampled
from control_laws.catalogue import LAWS, Gains, Law, initial_gains
from control_laws.nominal_model import NominalModel
from flight_analysis.closed_loop.scenario import Scenario
from flight_analysis.design.gain_selection import law_order, with_feedforward
from flight_campaign import fleet, statistics
from flight_campaign.benchmark_course import Course, build_course
from flight_campaign.fleet import Fleet, FleetResult, Vehicle
from flight_campaign.statistics import score_units
from flight_core.files import read_yaml
from flight_core.parameters import ParameterError, require
from flight_core.vectors import FloatArray

TUNED = Path(__file__).parent / "tuned"  # folder of the tuned gains, one file a scenario

ACTIVITY_UNIT = {"deg": np.deg2rad(60.0), "rad": np.deg2rad(60.0), "%": 6.0, "1": 6.0}
"""rad/s and 1/s by the unit of an input: mean abs(u_dot) that costs as much as one unit of error. 60 deg/s and 600 %/s."""

NOMINAL, UNCERTAIN, LATE = "nominal", "uncertain", "late"

OBJECTIVES = {
    NOMINAL: "the nominal aircraft",
    UNCERTAIN: "the nominal and 6 uncertain aircraft at +-40 %, with late inputs on the nominal one",
    LATE: "the nominal and 6 uncertain aircraft at +-40 %, with late inputs on all of them",
}
"""The flights in each cost, in words."""

UNCERTAIN_AIRCRAFT, UNCERTAINTY, UNCERTAINTY_SEED = 6, 0.4, 40
"""Number, +-fraction and seed of the uncertain aircraft. Campaigns and comparisons use other seeds by default."""

EXTRA_DELAY_TICKS = 2
"""Delay of u in the delayed flights of a cost: 20 ms at 100 Hz. Without actuators it is one tick: the loop's lag is 15 ms."""

POPULATION, GENERATIONS, GENERATIONS_PER_GAIN, INITIAL_SIGMA = 16, 88, 6, 0.4
"""A search has GENERATIONS, or GENERATIONS_PER_GAIN times its gains if that is more: from 15 gains on. INITIAL_SIGMA is the
first standard deviation of log(gain)."""

MAX_COST = 1000.0  # cost of a flight that diverged, and upper bound of every other cost
STEP = 0.005  # s. Step of the integration, or one tick if that is shorter. The scores are within 1 % of those of a finer step.


class Benchmark(NamedTuple):
    """The setting in which laws are tuned and compared: one scenario with its gusts, channels in the law's order."""

    scenario: Scenario
    model: NominalModel
    unit: FloatArray  # (m,) of the errors in a score
    activity_unit: FloatArray  # (m,) of the mean abs(u_dot) in a cost
    plant: PlantParams
    vehicle: Vehicle
    courses: dict[bool, Course]  # without and with the feedforward
    extra_delay: int  # ticks, delay of u in the delayed flights of a cost


def build_benchmark(scenario: Scenario) -> Benchmark:
    """The benchmark of a scenario: its manoeuvre, gusts, actuators and noise; y, y_m and law at one rate, topics without delay.

    Raises ParameterError for a scenario that a campaign cannot fly, and for outputs whose unit has no score.
    """
    scenario = scenario.vary(
        aircraft={"rate": scenario.controller.rate, "step": min(STEP, 1.0 / scenario.controller.rate)},
        reference_model={"rate": scenario.controller.rate},
        controller={"delay": 0.0, "feedforward": None},
    )
    airframe, _ = scenario.aircraft.load()
    controller = scenario.controller
    with_model = scenario.vary(controller=with_feedforward(controller, airframe).model_dump())
    rows, columns = law_order(airframe, controller)
    actuators, m = scenario.aircraft.actuators, len(controller.inputs)

    def in_law_order(limits: Iterable[float], default: float) -> FloatArray:
        values = list(limits) or [default] * m
        return np.array([values[column] for column in columns])

    unit = score_units(controller.outputs, airframe.states)
    noise = scenario.aircraft.sensor_arrays().noise[rows]
    model = NominalModel(
        A=airframe.matrix_a(),
        B=airframe.matrix_b()[:, columns],
        C=airframe.matrix_c()[rows],
        gravity=airframe.matrix_gravity(),
        wind=np.stack([airframe.gust_direction(axis) for axis in airframe.gusts], axis=1),
        noise=np.where(noise > 0.0, noise, unit / 10.0),
        kinematic=np.array([float(state in KINEMATIC) for state in airframe.states]),
        size=np.array([1.0 if state_unit in {"m/s", "ft/s"} else 0.1 for state_unit in airframe.states.values()]),
        input_scale=np.array(controller.input_scale),
        D=np.array(controller.D, dtype=np.float64),
        lag=np.array(controller.lag),
        total_lag=np.array(controller.lag) + 1.5 / controller.rate,
        period=1.0 / controller.rate,
        lower=in_law_order(actuators.lower, -np.inf),
        upper=in_law_order(actuators.upper, np.inf),
    )
    return Benchmark(
        scenario,
        model,
        unit,
        np.array([ACTIVITY_UNIT[airframe.inputs[name].unit] for name in controller.inputs]),
        scenario.aircraft.plant(),
        fleet.vehicle(scenario),
        {False: build_course(scenario), True: build_course(with_model)},
        EXTRA_DELAY_TICKS if any(controller.lag) else 1,
    )


def score(result: FleetResult, unit: FloatArray) -> FloatArray:
    """Sum over the channels of rms of the true error / unit, shape (N,); infinite if a flight diverged."""
    total = statistics.score(np.asarray(result.rms), unit)
    return np.where(np.asarray(result.diverged) | ~np.isfinite(total), np.inf, total)


def cost(result: FleetResult, benchmark: Benchmark) -> FloatArray:
    """Score + sum over the channels of mean abs(u_dot) / activity_unit, shape (N,), at most MAX_COST."""
    activity = np.sum(np.asarray(result.slew) / benchmark.activity_unit[:, None], axis=0)
    total = score(result, benchmark.unit) + activity
    return np.where(np.isfinite(total), np.minimum(total, MAX_COST), MAX_COST)


def benchmark_fleet(A: FloatArray, B: FloatArray, wind: FloatArray, late: FloatArray, benchmark: Benchmark) -> Fleet:
    """Aircraft in the benchmark, shapes as in `fleet.assemble`."""
    return fleet.assemble(A, B, benchmark.plant, benchmark.courses[False], wind, late)


class Evaluation(NamedTuple):
    """The flights of one evaluation of the cost, and their weights."""

    fleet: Fleet
    weight: FloatArray  # (F,) of their costs in the sum


def evaluation(objective: str, benchmark: Benchmark) -> Evaluation:
    """Flights of one evaluation: every aircraft in calm air and in gusts, some in gusts with u delayed by `extra_delay` ticks.

    The cost is the mean over the aircraft in calm air + the mean in gusts + the mean of the delayed flights.
    """
    airframe, _ = benchmark.scenario.aircraft.load()
    A, B = nominal_and_sampled(airframe, UNCERTAINTY, 0 if objective == NOMINAL else UNCERTAIN_AIRCRAFT, UNCERTAINTY_SEED)
    aircraft = np.arange(len(A))
    delayed = aircraft if objective == LATE else aircraft[:1]
    of = np.concatenate([aircraft, aircraft, delayed])
    counts = [len(A), len(A), len(delayed)]
    wind = np.repeat([0.0, 1.0, 1.0], counts)
    late = np.repeat([0, 0, benchmark.extra_delay], counts)
    weight = np.repeat([1.0 / count for count in counts], counts)
    return Evaluation(benchmark_fleet(A[of], B[of], wind, late, benchmark), weight)


def repeat_flights(flights: Fleet, times: int) -> Fleet:
    """The same flights several times, one set after the other."""
    tiled = jax.tree.map(lambda array: np.tile(np.asarray(array), times), flights._replace(blocks=()))
    return tiled._replace(blocks=flights.blocks, forced_rate=flights.forced_rate)


def spread_over(params: Any, flights: int, candidates: int) -> Any:
    """Parameters of several candidates, each for all of its flights: (.., candidates) -> (.., candidates flights)."""

    def spread(leaf: FloatArray) -> FloatArray:
        return np.repeat(leaf, flights, axis=-1) if leaf.shape[-1] == candidates else leaf

    return jax.tree.map(spread, params)


class TuningResult(NamedTuple):
    """Result of a search."""

    gains: dict[str, list[float]]
    cost: float
    seed: int  # of the best
    costs: list[float]  # of all seeds
    evaluations: int  # of each


def generation_count(law: Law, benchmark: Benchmark) -> int:
    """Generations of a search."""
    return max(GENERATIONS, GENERATIONS_PER_GAIN * sum(map(len, initial_gains(law, benchmark.model).values())))


def tune(
    law: Law,
    objective: str,
    benchmark: Benchmark,
    seeds: tuple[int, ...],
    generations: int | None = None,
    progress: Callable[[int, float], None] | None = None,
) -> TuningResult:
    """Gains of the smallest cost that CMA-ES finds from the initial ones, the best of several seeds; all seeds run together.

    The cost of a candidate is the weighted sum over the flights of `evaluation`. `progress` receives the generation and the
    smallest cost so far. Source: N. Hansen, A. Ostermeier, Evolutionary Computation 9(2), 2001; the package `cma`.
    """
    import cma  # noqa: PLC0415 - it imports matplotlib, which nothing here uses

    begin = initial_gains(law, benchmark.model)
    origin, ends = np.log(np.concatenate(list(begin.values()))[:, 0]), np.cumsum([len(gain) for gain in begin.values()])[:-1]

    def gains_of(vectors: FloatArray) -> Gains:
        """Gains by name, shape (size, N), of logarithms (N, d)."""
        return dict(zip(begin, np.split(np.exp(vectors.T), ends), strict=True))

    flights, weight = evaluation(objective, benchmark)
    each, candidates = len(weight), POPULATION * len(seeds)
    repeated, control_law = repeat_flights(flights, candidates), law.control_law(benchmark.model)
    course = benchmark.courses[law.feedforward]
    options = {"popsize": POPULATION, "verbose": -9}
    searches = [cma.CMAEvolutionStrategy(origin, INITIAL_SIGMA, options | {"seed": seed}) for seed in seeds]
    best: list[tuple[float, FloatArray]] = [(np.inf, origin)] * len(seeds)
    generations = generation_count(law, benchmark) if generations is None else generations
    for generation in range(generations):
        asked = [np.array(search.ask()) for search in searches]
        params = spread_over(law.params(gains_of(np.concatenate(asked)), benchmark.model), each, candidates)
        costs = cost(fleet.fly(repeated, benchmark.vehicle, course, control_law, params), benchmark)
        of_each = costs.reshape(candidates, each) @ weight
        for k, (search, values) in enumerate(zip(searches, np.split(of_each, len(seeds)), strict=True)):
            search.tell(list(asked[k]), list(values))
            least = int(np.argmin(values))
            if values[least] < best[k][0]:
                best[k] = (float(values[least]), asked[k][least])
        if progress is not None:
            progress(generation + 1, min(value for value, _ in best))
    winner = int(np.argmin([value for value, _ in best]))
    gains = {name: [float(f"{v:.5g}") for v in gain[:, 0]] for name, gain in gains_of(best[winner][1][None]).items()}
    lowest = [round(value, 4) for value, _ in best]
    return TuningResult(gains, lowest[winner], seeds[winner], lowest, generations * POPULATION)


# Files of tuned gains


class _Dumper(yaml.SafeDumper):
    """Writes a tuning result in flow style: one or two lines a gain set."""


_Dumper.add_representer(
    TuningResult, lambda dumper, result: dumper.represent_mapping("tag:yaml.org,2002:map", result._asdict(), flow_style=True)
)


def tuned_file(scenario: Scenario) -> Path:
    """Path of the tuned gains of a scenario."""
    return TUNED / f"{scenario.name}.yaml"


def load(path: Path) -> dict[str, dict[str, TuningResult]]:
    """Tuned gains by law and objective; empty if there is no file. Raises ParameterError for a file that cannot be read."""
    if not path.exists():
        return {}
    content = read_yaml(path, path.name, "a file of tuned gains")
    try:
        laws = content["laws"].items()
        return {law: {objective: TuningResult(**entry) for objective, entry in sets.items()} for law, sets in laws}
    except (TypeError, KeyError, AttributeError) as error:
        raise ParameterError(f"{path.name}: found {error}, expected laws, each with gains by objective") from None


def save(path: Path, tuned: Mapping[str, Mapping[str, TuningResult]], command: str) -> None:
    """Write tuned gains, their costs and the command that finds them."""
    path.parent.mkdir(exist_ok=True)
    head = (
        "# SPDX-FileCopyrightText: RISE-DI contributors\n# SPDX-License-Identifier: Apache-2.0\n#\n"
        "# Gains found by CMA-ES, in the law's order of channels and its scaled inputs; cost, seed, evaluations of a search.\n"
        f"# Made by: {command}\n"
    )
    laws = {law: dict(sets) for law, sets in tuned.items()}
    text = yaml.dump({"laws": laws}, Dumper=_Dumper, sort_keys=False, default_flow_style=False, width=160)
    path.write_text(head + text, encoding="utf-8")


def as_gains(tuned: TuningResult) -> Gains:
    """Gains of shape (m, 1) and (1, 1)."""
    return {name: np.array(values)[:, None] for name, values in tuned.gains.items()}


def require_laws(names: Iterable[str]) -> None:
    """Raise ParameterError for the name of an unknown law."""
    for name in names:
        require(name in LAWS, "--laws", f"{name!r}", f"laws among {', '.join(LAWS)}")
