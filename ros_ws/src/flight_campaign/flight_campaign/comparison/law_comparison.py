# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Compare tuned laws on the same aircraft, winds, noise and limits.

The aircraft are the nominal one, uncertain ones, and aircraft whose inputs are late.
"""

import os
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from aircraft_sim.uncertainty import nominal_and_sampled
from control_laws.catalogue import LAWS, Law
from flight_analysis.linear_loop.input_margins import Margins
from flight_campaign.batch import batch
from flight_campaign.batch.batch_matrices import FleetMatrices
from flight_campaign.comparison.tuning import (
    GUST,
    TURBULENCE,
    Benchmark,
    as_gains,
    benchmark_fleet,
    nominal_margins,
    result_score,
)
from flight_campaign.statistics import LOSS_OF_TRACK_SCORE
from flight_core.vectors import FloatArray
from flight_design.gains.tuned_gains import TuningResult
from rise_di_controller.law.control_law import ControlLaw

DELAY_TICKS = (1, 2, 3, 4, 6)  # delays of u: 10 to 60 ms at 100 Hz
TURBULENCE_SEED = 3  # seed of a comparison's turbulence; the tuning has another seed


class Scores(NamedTuple):
    """The scores of all uncertain aircraft of one level of uncertainty, in one wind."""

    mean: float  # infinite if an aircraft diverged
    worst: float
    # Share of the aircraft that diverged or lost track, which means a score above
    # LOSS_OF_TRACK_SCORE.
    lost: float


class Level(NamedTuple):
    """Results of a law on the aircraft of a level of uncertainty, without additional delay of u."""

    uncertainty: float
    scores: dict[str, Scores]  # scores by wind


class LawResult(NamedTuple):
    """Results of one law in a comparison, SI, with the channels in the order of the law."""

    law: str
    objective: str  # name of the objective for which it was tuned
    costs: list[float]  # cost of each seed of its tuning; empty for gains of a scenario
    scores: dict[str, float]  # scores of the nominal aircraft by wind
    levels: tuple[Level, ...]
    # By delay of u in s: the share of the first level's aircraft that lose track in gusts.
    lost_late: dict[float, float]
    rms: FloatArray  # (m,) rms of the true error of the nominal aircraft in gusts
    slew: FloatArray  # (m,) mean abs(u_dot) of the nominal aircraft in gusts
    # Margins of the nominal aircraft; None if the law has no linear loop from y to u.
    margins: Margins | None


def compare(
    benchmark: Benchmark,
    gains_by_law: Mapping[str, Mapping[str, TuningResult]],
    aircraft: int,
    levels: Sequence[float],
    seed: int,
    delays: Sequence[int] = DELAY_TICKS,
    laws: Mapping[str, Law] = LAWS,
) -> Iterator[LawResult]:
    """Simulate the laws with their gain sets on the same flights, one law in each thread.

    In each wind the nominal aircraft flies, and so do `aircraft` uncertain aircraft of `seed` for
    each level of uncertainty. In gusts, the aircraft of the first level also fly with u late by
    `delays`, ticks. Raises ParameterError if an uncertainty is outside [0, 1).
    """
    airframe, _ = benchmark.scenario.aircraft.load()
    sampled = [nominal_and_sampled(airframe, level, aircraft, seed) for level in levels]
    A_by_level, B_by_level = zip(*sampled, strict=True)
    A = _nominal_once(A_by_level)
    B = _nominal_once(B_by_level)
    in_time = np.arange(len(A))
    parts = np.split(in_time[1:], len(levels))
    first = in_time[1 : 1 + aircraft]
    numbers = np.concatenate([in_time, np.tile(first, len(delays))])
    late = np.concatenate([0 * in_time, np.repeat(np.array(delays, dtype=int), aircraft)])
    flights = {
        GUST: benchmark_fleet(A[numbers], B[numbers], late, GUST, benchmark),
        TURBULENCE: benchmark_fleet(A, B, 0 * in_time, TURBULENCE, benchmark),
    }

    study = _LawStudy(
        benchmark=benchmark, flights=flights, levels=levels, parts=parts, delays=delays
    )

    def results(name: str) -> list[LawResult]:
        # One control law serves all gain sets, so it is compiled only once.
        control_law = laws[name].control_law(benchmark.model)
        return [
            study.result(name, laws[name], control_law, objective, gains)
            for objective, gains in gains_by_law[name].items()
        ]

    with ThreadPoolExecutor(os.cpu_count()) as pool:
        for scored in pool.map(results, gains_by_law):
            yield from scored


class _LawStudy(NamedTuple):
    """The setting of a comparison, with the flights that every law flies."""

    benchmark: Benchmark
    flights: Mapping[str, FleetMatrices]  # aircraft of all flights, by wind
    levels: Sequence[float]
    parts: Sequence[NDArray[np.int64]]  # indices of the aircraft of each level
    delays: Sequence[int]

    def result(
        self,
        name: str,
        law: Law,
        control_law: ControlLaw,
        objective: str,
        gains: TuningResult,
    ) -> LawResult:
        """Return the scores and metrics of a law with a gain set."""
        benchmark = self.benchmark
        params = law.params(as_gains(gains), benchmark.model)
        results = {}
        for wind, disturbed in self.flights.items():
            course = benchmark.courses[wind][law.feedforward]
            results[wind] = batch.fly(disturbed, benchmark.vehicle, course, control_law, params)
        scores = {wind: result_score(each, benchmark.unit) for wind, each in results.items()}
        in_time = 1 + sum(map(len, self.parts))
        delayed_scores = scores[GUST][in_time:].reshape(len(self.delays), len(self.parts[0]))
        by_level = []
        for level, part in zip(self.levels, self.parts, strict=True):
            costs = {wind: _scores(of_wind[part]) for wind, of_wind in scores.items()}
            by_level.append(Level(level, costs))
        losses = {}
        for ticks, costs_late in zip(self.delays, delayed_scores, strict=True):
            losses[ticks * benchmark.model.period] = _lost(costs_late)
        return LawResult(
            law=name,
            objective=objective,
            costs=gains.costs,
            scores={wind: float(costs[0]) for wind, costs in scores.items()},
            levels=tuple(by_level),
            lost_late=losses,
            rms=np.asarray(results[GUST].rms)[:, 0],
            slew=np.asarray(results[GUST].slew)[:, 0],
            margins=_margins(law, gains, benchmark),
        )


def _nominal_once(matrices: Sequence[FloatArray]) -> FloatArray:
    """Join the matrices of all levels in their order, with the nominal aircraft only once."""
    return np.concatenate([matrices[0], *(level[1:] for level in matrices[1:])])


def score_cells(result: LawResult) -> list[str]:
    """Return the scores of a law as cells of a table.

    For each wind, the first cell is the score of the nominal aircraft. A cell for each level of
    uncertainty follows, with the mean score and, in parentheses, the worst one.
    """
    cells = []
    for wind, nominal in result.scores.items():
        uncertain = (level.scores[wind] for level in result.levels)
        cells += [
            f"{nominal:.2f}",
            *(f"{scores.mean:.2f} ({scores.worst:.2f})" for scores in uncertain),
        ]
    return cells


def _margins(law: Law, gains: TuningResult, benchmark: Benchmark) -> Margins | None:
    if not law.has_margins:
        return None
    return nominal_margins(law, as_gains(gains), benchmark.model).at(0)


def _scores(scores: FloatArray) -> Scores:
    return Scores(float(np.mean(scores)), float(np.max(scores)), _lost(scores))


def _lost(scores: FloatArray) -> float:
    return float(np.mean(scores > LOSS_OF_TRACK_SCORE))
