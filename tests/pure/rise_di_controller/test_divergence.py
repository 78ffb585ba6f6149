# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test how the error shows that a law with a learned model diverges or oscillates."""

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.signal import lfilter

from flight_core.vectors import FloatArray
from rise_di_controller.learning import divergence

DT, DURATION, BEFORE = 0.01, 30.0, 0.02  # s, s; rms of the error under the initial law, rad/s
T = DT * np.arange(round(DURATION / DT))
RANDOM = np.random.default_rng(3)
LEARNED = np.array([True])


@pytest.mark.parametrize(
    "errors, expected",
    [
        ((0.02, 0.01), False),  # twice the largest before, but small
        ((0.2, 0.07), False),  # less than three times
        ((0.2, 0.05), True),
    ],
)
def test_divergence_is_three_times_the_error_before(
    errors: tuple[float, float], expected: bool
) -> None:
    now, largest = (np.array([value**2, 0.0]) for value in errors)
    state = divergence.Errors(now, largest)
    least = divergence.least(("q", "V"))
    assert divergence.diverging(state, least, np.array([True, True])).tolist() == [expected, False]
    assert not divergence.diverging(
        state, least, np.array([False, True])
    ).any()  # the initial law controls q


def test_running_mean_square_reaches_that_of_a_constant_error() -> None:
    state = divergence.Errors(np.zeros(1), np.zeros(1))
    for _ in range(100):
        state = divergence.step(state, np.array([0.3]), 0.01, has_learned_model=False)
    assert state.now == pytest.approx(0.09 * (1.0 - np.exp(-1.0)))
    assert (
        divergence.step(state, np.array([9.0]), 0.01, has_learned_model=True).largest == state.now
    )


def noise(frequency: float, damping: float) -> FloatArray:
    """Return white noise behind a resonance, like the wind's effect on a loop.

    The frequency is in Hz, and the rms is 1.
    """
    pole = np.exp(2.0 * np.pi * frequency * DT * (-damping + 1j * np.sqrt(1.0 - damping**2)))
    x = lfilter([1.0], [1.0, -2.0 * pole.real, abs(pole) ** 2], RANDOM.normal(size=len(T)))
    return np.asarray(x / np.std(x))


def flown(
    e: FloatArray, learned: NDArray[np.bool_] = LEARNED, before: float = BEFORE
) -> divergence.Oscillations:
    """Return the error of 20 s under the initial law, followed by e under a learned model.

    The result ends where an oscillation is found.
    """
    oscillations = divergence.Oscillations(divergence.least(("q",)))
    for value in before * noise(1.0, 0.5)[:2000]:
        oscillations.take(np.array([value]), DT, None)
    for value in e:
        oscillations.take(np.array([value]), DT, learned)
        if oscillations.periods.any():
            break
    return oscillations


@pytest.mark.parametrize("frequency", [0.5, 1.7, 4.6])
def test_limit_cycle_is_found_with_its_period(frequency: float) -> None:
    e = 0.06 * np.sqrt(2.0) * np.sin(2.0 * np.pi * frequency * T) + 0.015 * noise(1.0, 0.5)
    # samples of 20 ms, and noise
    assert flown(e).periods == pytest.approx(1.0 / frequency, rel=0.1)


def test_limit_cycle_is_found_within_the_record_and_forgotten_by_the_law_of_the_start() -> None:
    e = 0.08 * np.sin(2.0 * np.pi * T)
    assert flown(e[:900]).periods == [0.0]
    oscillations = flown(e[:1100])
    assert oscillations.periods == pytest.approx([1.0], rel=0.05)
    oscillations.take(np.zeros(1), DT, None)
    assert oscillations.periods == [0.0]


@pytest.mark.parametrize(
    "e",
    [
        0.06
        * noise(1.0, 0.3),  # turbulence; a loop with a phase margin of 35 deg has a damping of 0.3
        0.06 * noise(3.0, 0.3),
        0.1 * (np.sin(2.0 * np.pi * T / 4.7) > 0.95),  # gusts, one every 4.7 s
        0.06 * np.sign(np.sin(2.0 * np.pi * T / 12.0)),  # the sign of a bias
        1.2 * BEFORE * np.sqrt(2.0) * np.sin(2.0 * np.pi * T),  # not clearly larger than before
    ],
)
def test_wind_and_small_oscillations_are_none(e: FloatArray) -> None:
    assert flown(e).periods == [0.0]


@pytest.mark.parametrize("amplitude, expected", [(0.05, True), (0.02, False)])
def test_record_oscillates_by_more_than_is_harmless(amplitude: float, expected: bool) -> None:
    """An oscillation is harmless up to an rms of 0.02 rad/s, an amplitude of 0.028 rad/s."""
    y = np.stack(
        [amplitude * np.sin(2.0 * np.pi * 2.2 * T), RANDOM.normal(0.0, 1.0, len(T))], axis=1
    )
    assert divergence.oscillating(y, divergence.least(("q", "p"))).tolist() == [expected, False]
