# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Tune every law by one procedure: CMA-ES over the logarithms of its gains.

The nominal aircraft flies, and uncertain aircraft around it.
"""

import os
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from itertools import product
from typing import Any, NamedTuple

import jax
import numpy as np

from aircraft_sim.atmosphere.turbulence import MODERATE
from aircraft_sim.plant.plant import PlantParams
from aircraft_sim.uncertainty import gust_directions, nominal_and_sampled
from control_laws.catalogue import FeedforwardModel, Gains, Law, initial_gains
from control_laws.nominal_model import NominalModel
from flight_analysis.closed_loop.scenario import Scenario
from flight_analysis.linear_loop.input_margins import Margins, input_margins
from flight_analysis.linear_loop.loop_margins import law_order
from flight_campaign import statistics
from flight_campaign.batch import batch, batch_matrices
from flight_campaign.batch.batch_loop import FleetResult, Vehicle
from flight_campaign.batch.batch_matrices import FleetMatrices
from flight_campaign.batch.campaign_course import Course, build_course, require_flyable
from flight_campaign.statistics import score_units
from flight_core.vectors import Array, FloatArray
from flight_design.gains.extended_state import integrator_model
from flight_design.gains.feedforward_model import with_feedforward
from flight_design.gains.nominal import activity_units, airframe_model
from flight_design.gains.requirement import REQUIREMENT, Requirement, least_fractions
from flight_design.gains.tuned_gains import TuningResult
from rise_di_controller.law.control_law import TunedLaw
from rise_di_controller.law.linear_loop import LinearPlant, LoopTiming, linear_law

GUST = "gust"
TURBULENCE = "turbulence"
"""Names of the two winds of a benchmark: GUST is the wind of its scenario, and TURBULENCE replaces
it."""

TUNING_TURBULENCE_SEED = 40  # seed of the turbulence in a cost; a comparison has a different seed


class Objective(NamedTuple):
    """The flights from which a cost is computed.

    Every aircraft flies without delay of u, and some fly with a delay as well.
    """

    title: str
    weights: dict[str, float]  # weight of each wind
    delay: int  # delay of u in the late flights, in multiples of `Benchmark.delay`
    # whether all aircraft also fly with late messages, and not only the nominal one
    is_all_late: bool
    # requirement that the nominal loop must meet if the law has margins
    requirement: Requirement | None = None


# Turbulence has half the weight, because scores in turbulence are about twice those in gusts.
OBJECTIVES = {
    "gust": Objective("gusts", {GUST: 1.0}, 1, is_all_late=False),
    "gust_turbulence": Objective(
        "gusts and turbulence", {GUST: 1.0, TURBULENCE: 0.5}, 1, is_all_late=False
    ),
    "delay": Objective(
        "gusts and turbulence with a large delay",
        {GUST: 1.0, TURBULENCE: 0.5},
        2,
        is_all_late=True,
    ),
    "margins": Objective(
        title="gusts and turbulence within margins of 45 deg and 6 dB",
        weights={GUST: 1.0, TURBULENCE: 0.5},
        delay=1,
        is_all_late=False,
        requirement=REQUIREMENT,
    ),
}

UNCERTAIN_AIRCRAFT = 12  # number of uncertain aircraft in a cost
UNCERTAINTY = 0.4  # largest relative deviation of an entry of these aircraft
UNCERTAINTY_SEED = 40  # seed of these aircraft; by default, campaigns and comparisons have others

DELAY_TICKS = 2
"""Delay of u in the late flights of a cost: 20 ms at 100 Hz. Without actuators it is one tick,
because the lag of the loop is 15 ms."""

POPULATION = 16
GENERATIONS = 88  # number of generations of a search for at most 14 gains
GENERATIONS_PER_GAIN = 6  # number of generations for each gain, if there are more gains
INITIAL_SIGMA = 0.4  # standard deviation of log(gain) at the start of a search

# Number of parts into which the candidates of a generation are divided. The parts fly side by side.
# In a smaller part, a flight takes more processor time.
PARTS = 2

# Cost of a flight that diverged, and of a loop without any margin. It is the upper bound of every
# cost.
MAX_COST = 1000.0
# s, step of the integration, but at most one tick. The scores differ by less than 1 % from those of
# a finer step.
STEP = 0.005


class Benchmark(NamedTuple):
    """The setting in which laws are tuned and compared, which is one scenario in two winds.

    Channels are in the law's order.
    """

    scenario: Scenario
    model: NominalModel
    unit: FloatArray  # (m,) units of the errors in the score
    activity_unit: FloatArray  # (m,) units of the mean abs(u_dot) in the cost
    plant: PlantParams
    vehicle: Vehicle
    scenarios: dict[str, Scenario]  # scenarios by wind
    courses: dict[str, dict[str, Course]]  # courses by wind and by the model of the feedforward
    delay: int  # ticks, delay of u in the late flights of a cost


def build_benchmark(scenario: Scenario, turbulence_seed: int = TUNING_TURBULENCE_SEED) -> Benchmark:
    """Build the benchmark of a scenario: its manoeuvre, actuators and noise.

    y, y_m and the law have the same rate, and topics have no delay. One wind comes from the
    scenario, and the other is the turbulence of `turbulence_of` with `turbulence_seed`. Raises
    ParameterError if a campaign cannot fly the scenario, or if an output has no unit in the score.
    """
    require_flyable(scenario)
    scenario = scenario.vary(
        aircraft={
            "rate": scenario.controller.rate,
            "step": min(STEP, 1.0 / scenario.controller.rate),
        },
        reference_model={"rate": scenario.controller.rate},
        controller={"delay": 0.0, "feedforward": None, "observer": None},
    )
    # Put the scenario into two winds, with the aircraft as the model of the feedforward.
    airframe, _ = scenario.aircraft.load()
    controller = scenario.controller
    with_model = scenario.vary(controller=with_feedforward(controller, airframe).model_dump())
    air = turbulence_of(scenario) | {"seed": turbulence_seed}
    turbulent = with_model.vary(aircraft={"gusts": {}, "turbulence": air})
    rows, columns = law_order(airframe, controller)
    actuators = scenario.aircraft.actuators
    m = len(controller.inputs)

    def in_law_order(limits: Iterable[float], default: float) -> FloatArray:
        values = list(limits) or [default] * m
        return np.array([values[column] for column in columns])

    # Build the nominal model in the order of the law, with its timing and its limits.
    unit = score_units(controller.outputs, airframe.units_of_outputs())
    noise = scenario.aircraft.sensor_arrays().noise[rows]
    loop = LoopTiming(np.array(controller.lag), 0.0, 1.0 / controller.rate)
    model = airframe_model(
        airframe,
        controller.outputs,
        controller.inputs,
        np.where(noise > 0.0, noise, unit / 10.0),
        loop,
    )
    model = model._replace(
        D=np.array(controller.D, dtype=np.float64),
        lower=in_law_order(actuators.lower, -np.inf),
        upper=in_law_order(actuators.upper, np.inf),
    )
    return Benchmark(
        scenario=scenario,
        model=model,
        unit=unit,
        activity_unit=activity_units(airframe)[columns],
        plant=scenario.aircraft.plant(),
        vehicle=batch.vehicle(scenario),
        scenarios={GUST: with_model, TURBULENCE: turbulent},
        courses={GUST: _courses(with_model), TURBULENCE: _courses(turbulent)},
        delay=DELAY_TICKS if any(controller.lag) else 1,
    )


def turbulence_of(scenario: Scenario) -> dict[str, float]:
    """Return the turbulence of a benchmark: the scenario's altitude and intensity.

    If the scenario has no turbulence, the result is moderate turbulence at 100 m.
    """
    turbulence = scenario.aircraft.turbulence
    if turbulence is None:
        return MODERATE
    return turbulence.model_dump(exclude={"seed"}, exclude_none=True)


def _courses(scenario: Scenario) -> dict[str, Course]:
    """Return the courses of a scenario, by the model of their feedforward.

    The controller of the scenario must have a feedforward with the model of the aircraft.
    """
    course, controller, (airframe, _) = (
        build_course(scenario),
        scenario.controller,
        scenario.aircraft.load(),
    )
    rows, columns = law_order(airframe, controller)
    Omega = airframe.matrix_c()[rows] @ airframe.matrix_b()[:, columns]
    integrators = scenario.vary(
        controller={"feedforward": integrator_model(controller, Omega).model_dump()}
    )
    none = course.segments._replace(u_ff=np.zeros_like(course.segments.u_ff))
    return {
        FeedforwardModel.NONE: course._replace(segments=none),
        FeedforwardModel.AIRCRAFT: course,
        FeedforwardModel.INTEGRATORS: build_course(integrators),
    }


def result_score(result: FleetResult, unit: FloatArray) -> FloatArray:
    """Return the score of each flight, (N,).

    The score is the sum over the channels of the rms of the true error divided by its unit, and
    infinite if the flight diverged.
    """
    total = statistics.score(np.asarray(result.rms), unit)
    return np.where(np.asarray(result.diverged) | ~np.isfinite(total), np.inf, total)


def cost(result: FleetResult, benchmark: Benchmark) -> FloatArray:
    """Return the cost of each flight, (N,), at most MAX_COST.

    The cost is the score plus the sum over the channels of mean abs(u_dot) / activity_unit.
    """
    activity = np.sum(np.asarray(result.slew) / benchmark.activity_unit[:, None], axis=0)
    total = result_score(result, benchmark.unit) + activity
    return np.where(np.isfinite(total), np.minimum(total, MAX_COST), MAX_COST)


def benchmark_fleet(
    A: FloatArray, B: FloatArray, late: Array, wind: str, benchmark: Benchmark
) -> FleetMatrices:
    """Return the matrices of aircraft in a wind of the benchmark, with u late by whole ticks.

    The shapes are as in `batch_matrices.assemble`.
    """
    aircraft = benchmark.scenario.aircraft
    directions = gust_directions(aircraft.sampled_airframe(), A, aircraft.uncertainty.wind)
    return batch_matrices.assemble(
        A,
        B,
        benchmark.plant,
        benchmark.courses[wind][FeedforwardModel.NONE],
        late=late,
        gust_directions=directions,
    )


class Evaluation(NamedTuple):
    """Flights in one wind, and the weight of each flight in the sum of the costs."""

    wind: str
    fleet: FleetMatrices
    weight: FloatArray  # (F,) weight of each flight's cost in the sum


def evaluations(objective: Objective, benchmark: Benchmark) -> list[Evaluation]:
    """Return which flights one evaluation of the cost makes in each wind, with their weights.

        cost = sum over the winds of weight (mean over the aircraft with u in time
                                            + mean over those with u late)

    No flight is in calm air only, because the flights with gusts begin with the manoeuvre in calm
    air.
    """
    airframe, _ = benchmark.scenario.aircraft.load()
    A, B = nominal_and_sampled(airframe, UNCERTAINTY, UNCERTAIN_AIRCRAFT, UNCERTAINTY_SEED)
    aircraft = np.arange(len(A))
    late_aircraft = aircraft if objective.is_all_late else aircraft[:1]
    numbers = np.concatenate([aircraft, late_aircraft])
    counts = [len(A), len(late_aircraft)]
    late = np.repeat([0, objective.delay * benchmark.delay], counts)
    share = np.repeat([1.0 / count for count in counts], counts)
    return [
        Evaluation(
            wind, benchmark_fleet(A[numbers], B[numbers], late, wind, benchmark), weight * share
        )
        for wind, weight in objective.weights.items()
    ]


def repeat_flights(flights: FleetMatrices, times: int) -> FleetMatrices:
    """Repeat a set of flights several times, one set after another."""
    tiled = jax.tree.map(
        lambda array: np.tile(np.asarray(array), times), flights._replace(blocks=())
    )
    return tiled._replace(blocks=flights.blocks)


def spread_over(params: Any, single: Any, flights: int) -> Any:
    """Spread the parameters of several candidates over all of their flights.

    On the last axis, the parameters of each candidate are repeated `flights` times before those of
    the next candidate follow. `single` has the parameters of one candidate. If a parameter has the
    same shape in `params` and `single`, all candidates share it, and it is not repeated.
    """

    def spread(leaf: FloatArray, single_leaf: FloatArray) -> FloatArray:
        return leaf if leaf.shape == single_leaf.shape else np.repeat(leaf, flights, axis=-1)

    return jax.tree.map(spread, params, single)


def generation_count(law: Law, benchmark: Benchmark) -> int:
    """Return the number of generations of a search."""
    return max(
        GENERATIONS,
        GENERATIONS_PER_GAIN * sum(map(len, initial_gains(law, benchmark.model).values())),
    )


def tune(
    law: Law,
    objective: Objective,
    benchmark: Benchmark,
    seeds: tuple[int, ...],
    generations: int | None = None,
    progress: Callable[[int, float], None] | None = None,
) -> TuningResult:
    """Find the gains of the smallest cost by CMA-ES, beginning at the law's initial gains.

    The result is the best of several seeds, which run together. The cost of a candidate is the
    weighted sum over the flights of `evaluations`. If a loop has only a fraction of the margins
    that the objective requires, the missing fraction times MAX_COST is added. Each thread flies a
    part of the candidates in one wind. `progress` receives the generation and the smallest
    cost so far. Source: N. Hansen, A. Ostermeier, Evolutionary Computation 9(2), 2001; the package
    `cma`.
    """
    import cma  # noqa: PLC0415 - it imports matplotlib, which nothing here uses

    begin = initial_gains(law, benchmark.model)
    origin = np.log(np.concatenate(list(begin.values()))[:, 0])
    ends = np.cumsum([len(gain) for gain in begin.values()])[:-1]

    def gains_of(vectors: FloatArray) -> Gains:
        """Return the gains by name, (size, N), for logarithms of shape (N, d)."""
        return dict(zip(begin, np.split(np.exp(vectors.T), ends), strict=True))

    together = POPULATION * len(seeds) // PARTS
    flights = [
        evaluation._replace(fleet=repeat_flights(evaluation.fleet, together))
        for evaluation in evaluations(objective, benchmark)
    ]
    each = len(flights[0].weight)
    control_law = law.control_law(benchmark.model)
    single = law.params(begin, benchmark.model)

    def costs(job: tuple[Any, Evaluation]) -> FloatArray:
        """Return the costs of a part of the candidates in one wind, one per candidate."""
        params, evaluation = job
        course = benchmark.courses[evaluation.wind][law.feedforward]
        result = batch.fly(evaluation.fleet, benchmark.vehicle, course, control_law, params)
        return cost(result, benchmark).reshape(together, each) @ evaluation.weight

    # Each seed has a separate search. All searches fly together, part by part.
    lacking = partial(_lacking, law, objective, benchmark)
    options = {"popsize": POPULATION, "verbose": -9}
    searches = [
        cma.CMAEvolutionStrategy(origin, INITIAL_SIGMA, options | {"seed": seed}) for seed in seeds
    ]
    best: list[tuple[float, FloatArray]] = [(np.inf, origin)] * len(seeds)
    generations = generation_count(law, benchmark) if generations is None else generations
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        for generation in range(generations):
            candidates = [np.array(search.ask()) for search in searches]
            parts = [gains_of(part) for part in np.split(np.concatenate(candidates), PARTS)]
            params = [
                spread_over(law.params(part, benchmark.model), single, each) for part in parts
            ]
            weighted = np.array(list(pool.map(costs, product(params, flights))))
            by_part = weighted.reshape(PARTS, len(flights), together).sum(axis=1)
            by_part += np.array(list(pool.map(lacking, parts)))
            by_search = by_part.reshape(len(seeds), POPULATION)
            best = [
                _after(*each) for each in zip(searches, candidates, by_search, best, strict=True)
            ]
            if progress is not None:
                progress(generation + 1, min(value for value, _ in best))
    return _best_result(best, seeds, generations * POPULATION, gains_of)


def _best_result(
    best: Sequence[tuple[float, FloatArray]],
    seeds: Sequence[int],
    evaluation_count: int,
    gains_of: Callable[[FloatArray], Gains],
) -> TuningResult:
    """Return the gains of the seed with the least cost.

    `best` has, for each seed, the least cost and the logarithms of its gains.
    """
    winner = int(np.argmin([value for value, _ in best]))
    gains = _rounded(gains_of(best[winner][1][None]))
    lowest = [round(value, 4) for value, _ in best]
    return TuningResult(
        gains=gains,
        cost=lowest[winner],
        seed=seeds[winner],
        costs=lowest,
        evaluations=evaluation_count,
    )


def nominal_margins(law: Law, gains: Gains, model: NominalModel) -> Margins:
    """Return the margins of a law around the nominal aircraft, for N sets of gains.

    The gains have shape (m, N) or (1, N), and the margins (N, m) or (N,). The margins of all inputs
    together are left out. As in a benchmark, u has no delay.
    """
    tuned_law = TunedLaw(law.control_law(model), law.params(gains, model))
    count = max((gain.shape[-1] for gain in gains.values()), default=1)
    plant = LinearPlant(model.A + model.gravity, model.B, model.C)
    candidates = linear_law(tuned_law, len(model.lag), model.period, count)
    loop = LoopTiming(model.lag, 0.0, model.period)
    return input_margins(plant, candidates, loop, together=False)


def _lacking(law: Law, objective: Objective, benchmark: Benchmark, gains: Gains) -> FloatArray:
    """Return the cost that each of N candidates gets for missing margins, (N,)."""
    if objective.requirement is None or not law.has_margins:
        return np.zeros(next(iter(gains.values())).shape[-1])
    margins = nominal_margins(law, gains, benchmark.model)
    fractions = least_fractions(margins, objective.requirement)
    return np.asarray(MAX_COST * (1.0 - np.minimum(fractions, 1.0)))


def _rounded(gains: Gains) -> dict[str, list[float]]:
    """Round the gains of the first candidate to five digits."""
    first = {}
    for name, gain in gains.items():
        first[name] = [float(f"{value:.5g}") for value in gain[:, 0]]
    return first


def _after(
    search: Any, point: FloatArray, values: FloatArray, best: tuple[float, FloatArray]
) -> tuple[float, FloatArray]:
    """Tell a search what its candidates cost, and return the best result so far.

    `point` has the logarithms of each candidate, and `values` the costs. `best` is the least cost
    before, with the logarithms of its candidate.
    """
    search.tell(list(point), list(values))
    least = int(np.argmin(values))
    return (float(values[least]), point[least]) if values[least] < best[0] else best


def as_gains(result: TuningResult) -> Gains:
    """Return the gains of a result as arrays of shape (m, 1) or (1, 1)."""
    return {name: np.array(values)[:, None] for name, values in result.gains.items()}
