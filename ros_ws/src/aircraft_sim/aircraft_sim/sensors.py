# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Sensors between the aircraft and y: noise, loss and delay of samples.

Random numbers come from a counter-based generator: those of sample k depend on the seed and on k alone, so that two runs
agree whatever either of them missed before. It is NumPy's and stays outside the maths that other array types run.
"""

from typing import NamedTuple

import numpy as np

from flight_core.vectors import FloatArray

NOISE_STREAM, LOSS_STREAM = 0, 1


class Sensors(NamedTuple):
    """Parameters of the sensors of m outputs. Ideal ones have noise 0, delay 0 and dropout 0."""

    noise: FloatArray  # (m,) standard deviation per sample, SI
    delay_ns: int  # from the instant of a sample to its arrival
    dropout: float  # probability that a sample is lost, all channels together
    seed: int


class Sample(NamedTuple):
    """A measured y and the instant it belongs to."""

    stamp_ns: int
    y: FloatArray  # (m,)


Underway = tuple[Sample, ...]


def noise(number: int, params: Sensors) -> FloatArray:
    """Error of sample `number` >= 0: noise_i n_i with n_i standard normal, white over channels and samples; shape (m,).

    Source of the generator: Salmon et al., Parallel random numbers: as easy as 1, 2, 3, SC11 (Philox).
    """
    if not params.noise.any():
        return np.zeros_like(params.noise)
    return params.noise * _generator(number, NOISE_STREAM, params.seed).standard_normal(len(params.noise))


def arrives(number: int, params: Sensors) -> bool:
    """Whether sample `number` >= 0 is not lost: v >= dropout with v uniform in [0, 1), independent of the noise."""
    return params.dropout == 0.0 or _generator(number, LOSS_STREAM, params.seed).random() >= params.dropout


def transmit(underway: Underway, now_ns: int, y: FloatArray | None, params: Sensors) -> tuple[Underway, Underway]:
    """One sample instant of the way from the sensors: (under way, now, y) -> (under way, arrived).

    The y of now, None where it is lost, sets out with the stamp now; whatever has been under way for the delay arrives, the
    oldest first. A stamp stays the instant that its sample belongs to.
    """
    sent = underway if y is None else (*underway, Sample(now_ns, y))
    arrived = sum(sample.stamp_ns + params.delay_ns <= now_ns for sample in sent)
    return sent[arrived:], sent[:arrived]


def _generator(number: int, stream: int, seed: int) -> np.random.Generator:
    # The counter's lowest word counts the draws within a sample.
    return np.random.Generator(np.random.Philox(key=seed, counter=[0, number, stream, 0]))
