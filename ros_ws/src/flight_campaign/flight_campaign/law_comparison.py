# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Tuned laws side by side: the same aircraft, course, noise and limits for each: a nominal, uncertain ones, late inputs."""

from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from aircraft_sim.uncertainty import uncertain
from control_laws.catalogue import LAWS
from flight_campaign import fleet
from flight_campaign.statistics import LOST
from flight_campaign.tuning import Benchmark, TuningResult, as_gains, fleet_of, score
from flight_core.vectors import FloatArray

TRIPLED = 3.0
"""Times the score without delay at which a law does not bear the delay."""

MOST_TICKS = 12
"""Ticks of delay up to which is looked: 120 ms at 100 Hz."""


class Level(NamedTuple):
    """How a law did on the uncertain aircraft of one level."""

    uncertainty: float
    mean: float  # score; infinite where one diverged
    worst: float
    worst_number: int  # of that aircraft, from 0 on
    diverged: float  # share of the aircraft
    lost: float  # share with a score above LOST, the diverged among them


class Compared(NamedTuple):
    """How one law did; channels in the law's order, SI."""

    law: str
    aims: str  # what it was tuned on
    score: float  # on the nominal aircraft
    levels: tuple[Level, ...]
    rms: FloatArray  # (m,) of the true error, nominal aircraft
    slew: FloatArray  # (m,) mean abs(u_dot), nominal aircraft
    delay: float  # s, the largest whole number of ticks up to which u may be late: the score stays below TRIPLED times its own


def compare(
    here: Benchmark, tuned: Mapping[str, Mapping[str, TuningResult]], aircraft: int, levels: Sequence[float], seed: int
) -> Iterator[Compared]:
    """Fly each law with each of its gain sets through the same flights, all of one gain set at once.

    The flights: the nominal aircraft with u late by 0 to MOST_TICKS ticks, and `aircraft` uncertain ones at each level, those
    of `seed`. Raises ParameterError for an uncertainty outside [0, 1).
    """
    airframe, _ = here.scenario.aircraft.load()
    drawn = [uncertain(airframe, level, aircraft, seed) for level in levels]
    nominal = [np.repeat(matrix[None], MOST_TICKS + 1, axis=0) for matrix in (airframe.matrix_a(), airframe.matrix_b())]
    A = np.concatenate([nominal[0], *(one[0][1:] for one in drawn)])
    B = np.concatenate([nominal[1], *(one[1][1:] for one in drawn)])
    late = np.concatenate([np.arange(MOST_TICKS + 1), np.zeros(aircraft * len(levels), dtype=int)])
    flights = fleet_of(A, B, np.ones(len(A)), late, here)
    parts = np.split(np.arange(MOST_TICKS + 1, len(A)), len(levels))
    for name, by_aim in tuned.items():
        law = LAWS[name]
        control_law = law.control_law(here.known)  # one for both gain sets: it is compiled once
        for aims, gains in by_aim.items():
            params = law.params(as_gains(gains), here.known)
            flown = fleet.fly(flights, here.vehicle, here.courses[law.ahead], control_law, params)
            scores, diverged = score(flown, here.unit), np.asarray(flown.diverged)
            yield Compared(
                name,
                aims,
                float(scores[0]),
                tuple(_level(level, scores[part], diverged[part]) for level, part in zip(levels, parts, strict=True)),
                np.asarray(flown.rms)[:, 0],
                np.asarray(flown.slew)[:, 0],
                _borne(scores[: MOST_TICKS + 1]) * here.known.period,
            )


def _level(uncertainty: float, scores: FloatArray, diverged: FloatArray) -> Level:
    worst = int(np.argmax(scores))
    lost = float(np.mean(scores > LOST))
    return Level(uncertainty, float(np.mean(scores)), float(scores[worst]), worst, float(np.mean(diverged)), lost)


def _borne(scores: FloatArray) -> int:
    """Ticks of delay before the first at which the score is TRIPLED."""
    beyond = np.flatnonzero(~(scores <= TRIPLED * scores[0]))
    return int(beyond[0]) - 1 if len(beyond) else len(scores) - 1
