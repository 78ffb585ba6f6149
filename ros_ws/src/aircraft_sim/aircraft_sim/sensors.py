# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Model the sensors between the aircraft and y.

They add bias, drift, noise and quantisation, and then lose and delay samples.
"""

from typing import NamedTuple

import numpy as np

from aircraft_sim import random_streams
from flight_core.vectors import Array, FloatArray, StampedVector, array_namespace


class Sensors(NamedTuple):
    """Parameters of the sensors of m outputs.

    Ideal sensors have noise 0, delay 0 and dropout 0. An error that is None is absent.
    """

    noise: FloatArray  # (m,) standard deviation per sample, SI
    delay_ns: int  # transport delay, from the instant of a sample to its arrival
    dropout: float  # probability that a sample, with all of its channels, is dropped
    seed: int
    bias: FloatArray | None = None  # (m,) constant bias, SI
    # (m,) standard deviation of the random walk's step from sample to sample, SI
    drift: FloatArray | None = None
    quantum: FloatArray | None = None  # (m,) step of the quantisation, SI, 0 = none


class RandomWalk(NamedTuple):
    """The value of the random walk by which the sensors drift, at one of their samples."""

    number: int  # number of the sample
    value: FloatArray  # (m,) value of the walk, SI


class Measured(NamedTuple):
    """A measured value, and by how much it is wrong."""

    y: FloatArray  # (m,)
    error: FloatArray  # (m,) measured y minus C x
    drift: RandomWalk


# Samples that have been measured and have not arrived yet, the oldest first.
DelayLine = tuple[StampedVector, ...]


def initial_drift(params: Sensors) -> RandomWalk:
    """Return the random walk at sample 0, which starts from zero."""
    return RandomWalk(0, np.zeros_like(params.noise))


def measure(number: int, y: FloatArray, drift: RandomWalk, params: Sensors) -> Measured:
    """Measure y = C x, shape (m,), at sample `number`.

        measured = quantised(y + error(number))

    The sample must not be earlier than the sample of `drift`. The error of a quantised sample is
    the measured value minus y. Ideal sensors return y exactly.
    """
    added, drift = error(number, drift, params)
    y_measured = y + added
    if params.quantum is not None:
        y_measured = quantised(y_measured, params.quantum)
        added = np.where(params.quantum > 0.0, y_measured - y, added)
    return Measured(y_measured, added, drift)


def error(number: int, drift: RandomWalk, params: Sensors) -> tuple[FloatArray, RandomWalk]:
    """Compute what is added to y at sample `number`: bias + walk(number) + noise(number), (m,).

    Also returns the random walk at this sample, for the next call. The error does not depend on y.
    """
    drift = walk(number, drift, params)
    added = noise(number, params)
    if params.bias is not None:
        added = added + params.bias
    return (added if params.drift is None else added + drift.value), drift


def quantised(measured: Array, quantum: Array) -> Array:
    """Round to multiples of the quantum, half to even; a quantum of 0 changes nothing.

    The result is quantum round(measured / quantum). The function takes any array type.
    """
    xp = array_namespace(measured)
    coarse = quantum > 0.0
    return xp.where(
        coarse,
        quantum * xp.round(measured / xp.where(coarse, quantum, xp.ones_like(quantum))),
        measured,
    )


def noise(number: int, params: Sensors) -> FloatArray:
    """Draw the noise of sample `number` >= 0, shape (m,): noise_i n_i.

    The numbers n_i are standard normal, and independent over channels and samples.
    """
    # For a few channels, this form takes a seventh of the time of .any().
    if not any(params.noise.tolist()):
        return params.noise
    return params.noise * random_streams.generator(
        number, random_streams.NOISE, params.seed
    ).standard_normal(len(params.noise))


def walk(number: int, drift: RandomWalk, params: Sensors) -> RandomWalk:
    """Advance the random walk to sample `number`: w(0) = 0, w(k) = w(k-1) + drift_i n_i(k).

    The numbers n are standard normal and independent. The steps of skipped samples are added too,
    so the walk does not depend on which samples are measured.
    """
    if params.drift is None:
        return drift
    value = drift.value
    for k in range(drift.number + 1, number + 1):
        generator = random_streams.generator(k, random_streams.DRIFT, params.seed)
        value = value + params.drift * generator.standard_normal(len(value))
    return RandomWalk(number, value)


def has_arrived(number: int, params: Sensors) -> bool:
    """Return whether sample `number` >= 0 arrives, or is lost at random.

    It arrives if v >= dropout, where v is uniform in [0, 1), and independent of the noise.
    """
    return (
        params.dropout == 0.0
        or random_streams.generator(number, random_streams.LOSS, params.seed).random()
        >= params.dropout
    )


def transmit(
    delay_line: DelayLine, now_ns: int, y: FloatArray | None, params: Sensors
) -> tuple[DelayLine, DelayLine]:
    """Delay samples: put y into the delay line, and take out the samples that arrive now.

    y gets the stamp `now_ns`. If y is None, the sample is dropped. A sample arrives when it is as
    old as the delay. The oldest samples come first, and each keeps the instant of its measurement
    as its stamp. Returns the new delay line, and the samples that arrive.
    """
    line = delay_line if y is None else (*delay_line, StampedVector(now_ns, y))
    arrived = sum(sample.stamp_ns + params.delay_ns <= now_ns for sample in line)
    return line[arrived:], line[:arrived]
