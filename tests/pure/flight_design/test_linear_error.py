# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test the response of a linear loop to wind and noise, against closed forms of first order."""

import math

import numpy as np
import pytest
from pytest import approx

from flight_design.gains.linear_error import (
    FLIGHT,
    TURBULENT,
    Air,
    AirResponse,
    air_response,
    discrete_gust,
)
from rise_di_controller.law.linear_loop import LinearLaw, LinearPlant, LoopTiming

PERIOD = 0.001  # s: a sampled loop is then nearly the continuous one
GAIN = 4.0  # 1/s
ONE = np.ones((1, 1))


def response(sigma: float = 0.0, noise: float = 0.0, gust: float = 0.0) -> AirResponse:
    """Return the response of y_dot = u + w with u = -GAIN (y + v).

    The turbulence has a time of 2 s, and the gust lasts 5 s.
    """
    law = LinearLaw(np.zeros((0, 0)), np.zeros((0, 1)), np.zeros((1, 0)), -GAIN * ONE)
    loop = LoopTiming(np.zeros(1), 0.0, PERIOD)
    air = Air(
        wind=ONE,
        reading=0.0 * ONE,
        time=np.array([2.0]),
        sigma=np.array([sigma]),
        noise=np.array([noise]),
        gust=np.array([gust]),
        gust_duration=5.0,
    )
    return air_response(LinearPlant(0.0 * ONE, ONE, ONE), law, loop, air)


def test_error_in_turbulence_is_that_of_a_filtered_process() -> None:
    # variance of 1 / (s + k) over a first-order process: sigma^2 T / (k (1 + k T))
    expected = 0.7 * math.sqrt(2.0 / (GAIN * (1.0 + GAIN * 2.0)))
    assert response(sigma=0.7).error == approx(TURBULENT * expected, rel=0.005)


def test_noise_moves_u_from_tick_to_tick() -> None:
    # u_dot of white noise: sqrt(2 / pi) of the deviation sqrt(2) k sigma / T
    error = response(noise=0.01)
    assert error.activity == approx(2.0 / math.sqrt(math.pi) * GAIN * 0.01 / PERIOD, rel=0.005)
    # and y as the white noise of this intensity: k sigma sqrt(T / 2k)
    expected = GAIN * 0.01 * math.sqrt(PERIOD / (2.0 * GAIN))
    assert error.error == approx(TURBULENT * expected, rel=0.005)


def test_error_in_a_gust_is_that_of_a_fine_integration() -> None:
    step = 1e-4
    t = np.arange(0.0, 8.0, step)
    wind = np.where(t < 5.0, 3.0 * (1.0 - np.cos(2.0 * np.pi * t / 5.0)) / 2.0, 0.0)
    y = 0.0
    energy = 0.0
    for value in wind.tolist():
        y += step * (value - GAIN * y)
        energy += step * y**2
    assert response(gust=3.0).error == approx(math.sqrt(energy / FLIGHT), rel=0.005)


@pytest.mark.parametrize(
    "speed, peak, length", [(25.0, 12.32, 15.0), (10.0, 11.33, 9.1), (250.0, 17.07, 106.7)]
)
def test_gust_is_that_of_the_certification(speed: float, peak: float, length: float) -> None:
    """The gust is the one of CS 25.341 (a).

    It has 17.07 m/s (H / 350 ft)^(1/6), for H from 30 to 350 ft.
    """
    found, duration = discrete_gust(speed)
    assert found == approx(peak, rel=1e-3)
    assert duration * speed / 2.0 == approx(length)
