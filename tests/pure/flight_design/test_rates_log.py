# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""The rates of an autopilot's log as y and u of an identification."""

import numpy as np
import pytest
from pytest import approx
from scipy import signal

from flight_core.vectors import FloatArray
from flight_design.identification.innovation_filters import FlightData, coarser
from flight_design.identification.rates_log import BROAD, broadened, scaled_torques

RATE = 250.0  # Hz


def recorded(y: FloatArray) -> FlightData:
    t = np.arange(len(y)) / RATE
    return FlightData(1.0 / RATE, t, y, np.zeros_like(y))


def filtered(y: FloatArray, cutoff: float) -> FloatArray:
    """Y behind SciPy's Butterworth filter of second order."""
    b, a = signal.butter(2, cutoff, fs=RATE)
    return np.asarray(signal.lfilter(b, a, y, axis=0))


def correlation(y: FloatArray, lag: int) -> float:
    return float(np.corrcoef(y[lag:], y[:-lag])[0, 1])


@pytest.mark.parametrize("cutoff", [20.0, 40.0, 60.0])
def test_broadened_rates_are_those_behind_the_broad_filter(cutoff: float) -> None:
    """After the transient of the first sample, 0.1 s, to rounding."""
    y = np.random.default_rng(1).normal(size=(1000, 2))
    found, _ = broadened(recorded(filtered(y, cutoff)), cutoff)
    assert found.y[25:] == approx(filtered(y, BROAD)[25:], abs=1e-4)


def test_noise_behind_the_gyro_filter_becomes_white() -> None:
    """In means over 8 ms, as the identification takes them: 0.42 before, 0.01 after."""
    noise = recorded(filtered(np.random.default_rng(2).normal(size=(40_000, 1)), 40.0))
    found, _ = broadened(noise, 40.0)
    # 20,000 means show a correlation to 0.007
    assert correlation(coarser(noise, 2).y[100:, 0], 1) > 0.4
    assert abs(correlation(coarser(found, 2).y[100:, 0], 1)) < 0.05


def test_broadened_rates_are_earlier_by_the_phase_of_both_filters() -> None:
    """A slow sine comes earlier by the delay that is stated, by its phase."""
    omega = 2.0 * np.pi * 0.5
    t = np.arange(5000) / RATE
    late = filtered(np.sin(omega * t)[:, None], 40.0)
    found, advance = broadened(recorded(late), 40.0)
    basis = np.column_stack([np.sin(omega * t), np.cos(omega * t)])[1000:]
    phases = []
    for y in (late, found.y):
        sine, cosine = np.linalg.lstsq(basis, y[1000:, 0], rcond=None)[0]
        phases.append(np.arctan2(cosine, sine))
    assert (phases[1] - phases[0]) / omega == approx(advance, abs=2e-5)


def test_samples_that_a_lost_one_reaches_are_lost() -> None:
    y = np.random.default_rng(3).normal(size=(1000, 1))
    late = filtered(y, 40.0)
    late[500] = np.nan
    found, _ = broadened(recorded(late), 40.0)
    is_lost = np.isnan(found.y[:, 0])
    assert is_lost[500:510].all()
    assert not is_lost[:500].any()
    # an impulse of the lost sample's size is below 1e-4 then
    assert found.y[~is_lost][600:] == approx(filtered(y, BROAD)[~is_lost][600:], abs=1e-3)


def test_surface_that_ends_at_another_torque_is_named() -> None:
    parameters = {"CA_SV_CS0_TRQ_R": -0.5, "CA_SV_CS1_TRQ_P": 1.0, "CA_SV_CS2_TRQ_Y": 0.0}
    (sentence,) = scaled_torques(parameters)
    assert sentence.startswith("CA_SV_CS0_TRQ_R is -0.5: its surface reaches the end stop at")
    assert "set it to -1" in sentence
