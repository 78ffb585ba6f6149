# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test the rates of an autopilot's log as y and u of an identification."""

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
    """Return y behind SciPy's Butterworth filter of second order."""
    b, a = signal.butter(2, cutoff, fs=RATE)
    return np.asarray(signal.lfilter(b, a, y, axis=0))


def correlation(y: FloatArray, lag: int) -> float:
    return float(np.corrcoef(y[lag:], y[:-lag])[0, 1])


@pytest.mark.parametrize("cutoff", [20.0, 40.0, 60.0])
def test_broadened_rates_are_those_behind_the_broad_filter(cutoff: float) -> None:
    """They agree to rounding after the transient of the first sample, 0.1 s."""
    y = np.random.default_rng(1).normal(size=(1000, 2))
    found, _ = broadened(recorded(filtered(y, cutoff)), cutoff)
    assert found.y[25:] == approx(filtered(y, BROAD)[25:], abs=1e-4)


def test_noise_behind_the_gyro_filter_becomes_white() -> None:
    """The noise behind the gyro's filter becomes white.

    The identification uses means over 8 ms. Their correlation falls from 0.42 to 0.01.
    """
    noise = recorded(filtered(np.random.default_rng(2).normal(size=(40_000, 1)), 40.0))
    found, _ = broadened(noise, 40.0)
    # 20,000 means show a correlation to 0.007
    assert correlation(coarser(noise, 2).y[100:, 0], 1) > 0.4
    assert abs(correlation(coarser(found, 2).y[100:, 0], 1)) < 0.05


def test_broadened_rates_are_earlier_by_the_phase_of_both_filters() -> None:
    """A slow sine shows by its phase that y is earlier by the stated delay."""
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


def surfaces(**rows: tuple[float, ...]) -> dict[str, float]:
    """Return the parameters of PX4's surfaces, with the effects of each of them on an axis."""
    parameters = {"CA_SV_CS_COUNT": float(max(map(len, rows.values())))}
    for axis, effects in rows.items():
        parameters |= {f"CA_SV_CS{k}_TRQ_{axis}": effect for k, effect in enumerate(effects)}
    return parameters


STANDARD_PLANE = surfaces(R=(-0.5, 0.5, 0, 0), P=(0, 0, 1.0, 0), Y=(0, 0, 0, 1.0))


@pytest.mark.parametrize(
    "parameters",
    [
        surfaces(R=(1.0, 0, 0), P=(0, -1.0, 0), Y=(0, 0, 1.0)),
        # measured in SITL: a torque of 1 is a servo of 1.000
        STANDARD_PLANE,
        surfaces(R=(-0.5, 0.5), P=(0.5, 0.5)),
        surfaces(R=(-0.5, 0.5, 0, 0), P=(0, 0, 0.5, 0.5), Y=(0, 0, 0.5, -0.5)),
        # rows beyond the count are those of an airframe that was chosen before
        surfaces(R=(1.0,)) | {"CA_SV_CS1_TRQ_R": 1.0},
        {"IMU_GYRO_CUTOFF": 40.0},
    ],
    ids=["single", "2100_standard_plane", "elevons", "V-tail", "beyond the count", "no surface"],
)
def test_surfaces_whose_end_stop_is_a_torque_of_1_are_not_named(
    parameters: dict[str, float],
) -> None:
    assert scaled_torques(parameters) == []


@pytest.mark.parametrize(
    ("parameters", "axis", "end", "factor"),
    [
        (surfaces(R=(-0.5, 0), P=(0, 1.0)), "R", 0.5, 2.0),
        # measured in SITL: a torque of 1 is a servo of 0.500
        (surfaces(R=(-1.0, 1.0, 0), P=(0, 0, 1.0)), "R", 2.0, 0.5),
        (surfaces(R=(-0.5, 0.5), P=(1.0, 1.0)), "P", 2.0, 0.5),
        (surfaces(P=(0.5, 0.5), Y=(0.25, -0.25)), "Y", 0.5, 2.0),
    ],
    ids=["half an aileron", "two whole ailerons", "elevons", "V-tail"],
)
def test_axis_whose_end_stop_is_another_torque_is_named_with_its_factor(
    parameters: dict[str, float], axis: str, end: float, factor: float
) -> None:
    (sentence,) = scaled_torques(parameters)
    assert f"a torque of {end:g} is the end stop" in sentence
    assert f"multiply each CA_SV_CSk_TRQ_{axis} by {factor:g}" in sentence
    rows = {name: value * factor for name, value in parameters.items() if name.endswith(axis)}
    assert scaled_torques(parameters | rows) == []
