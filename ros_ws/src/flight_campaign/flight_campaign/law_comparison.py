# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Comparison of tuned laws on the same aircraft, course, noise and limits: nominal, uncertain, and with delayed inputs."""

from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from aircraft_sim.uncertainty import nominal_and_sampled
from control_laws.catalogue import LAWS
from flight_campaign import fleet
from flight_campaign.statistics import LOSS_OF_TRACK_SCORE
from flight_campaign.tuning import Benchmark, TuningResult, as_gains, benchmark_fleet, score
from flight_core.vectors import FloatArray

MAX_SCORE_RATIO = 3.0  # a delay is tolerated if the score is below this factor times the score without delay
MAX_DELAY_TICKS = 12  # largest delay of the search: 120 ms at 100 Hz


class Level(NamedTuple):
    """Results of a law on the uncertain aircraft of one level."""

    uncertainty: float
    mean: float  # score; infinite if one diverged
    worst: float
    worst_number: int  # index of that aircraft, from 0
    diverged: float  # fraction of the aircraft
    lost: float  # fraction with loss of track, a score above LOSS_OF_TRACK_SCORE; includes diverged ones


class LawResult(NamedTuple):
    """Results of one law; channels in the law's order, SI."""

    law: str
    objective: str  # what it was tuned on
    score: float  # on the nominal aircraft
    levels: tuple[Level, ...]
    rms: FloatArray  # (m,) of the true error, nominal aircraft
    slew: FloatArray  # (m,) mean abs(u_dot), nominal aircraft
    delay: float  # s, largest tolerated delay of u in whole ticks: the score is below MAX_SCORE_RATIO times that without


def compare(
    benchmark: Benchmark, tuned: Mapping[str, Mapping[str, TuningResult]], aircraft: int, levels: Sequence[float], seed: int
) -> Iterator[LawResult]:
    """Simulate each law with each of its gain sets on the same flights, all of one gain set at once.

    The flights: the nominal aircraft with u delayed by 0 to MAX_DELAY_TICKS ticks, and `aircraft` uncertain ones of `seed` at
    each level. Raises ParameterError for an uncertainty outside [0, 1).
    """
    airframe, _ = benchmark.scenario.aircraft.load()
    sampled = [nominal_and_sampled(airframe, level, aircraft, seed) for level in levels]
    nominal = [np.repeat(matrix[None], MAX_DELAY_TICKS + 1, axis=0) for matrix in (airframe.matrix_a(), airframe.matrix_b())]
    A = np.concatenate([nominal[0], *(one[0][1:] for one in sampled)])
    B = np.concatenate([nominal[1], *(one[1][1:] for one in sampled)])
    late = np.concatenate([np.arange(MAX_DELAY_TICKS + 1), np.zeros(aircraft * len(levels), dtype=int)])
    flights = benchmark_fleet(A, B, np.ones(len(A)), late, benchmark)
    parts = np.split(np.arange(MAX_DELAY_TICKS + 1, len(A)), len(levels))
    for name, by_aim in tuned.items():
        law = LAWS[name]
        control_law = law.control_law(benchmark.model)  # one for all gain sets: it is compiled once
        for objective, gains in by_aim.items():
            params = law.params(as_gains(gains), benchmark.model)
            result = fleet.fly(flights, benchmark.vehicle, benchmark.courses[law.feedforward], control_law, params)
            scores, diverged = score(result, benchmark.unit), np.asarray(result.diverged)
            yield LawResult(
                name,
                objective,
                float(scores[0]),
                tuple(_level(level, scores[part], diverged[part]) for level, part in zip(levels, parts, strict=True)),
                np.asarray(result.rms)[:, 0],
                np.asarray(result.slew)[:, 0],
                _tolerated_delay(scores[: MAX_DELAY_TICKS + 1]) * benchmark.model.period,
            )


def _level(uncertainty: float, scores: FloatArray, diverged: FloatArray) -> Level:
    worst = int(np.argmax(scores))
    track_lost = float(np.mean(scores > LOSS_OF_TRACK_SCORE))
    return Level(uncertainty, float(np.mean(scores)), float(scores[worst]), worst, float(np.mean(diverged)), track_lost)


def _tolerated_delay(scores: FloatArray) -> int:
    """Ticks of delay before the first one with a score above MAX_SCORE_RATIO times that without delay."""
    beyond = np.flatnonzero(~(scores <= MAX_SCORE_RATIO * scores[0]))
    return int(beyond[0]) - 1 if len(beyond) else len(scores) - 1
