# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test the identification of a response against the aircraft that made the log."""

import numpy as np
import pytest
from scipy.signal import cont2discrete

from flight_core.rates import nanoseconds
from flight_core.tape import Signal
from flight_core.vectors import FloatArray
from flight_design.identification.response_identification import Response, identify_response
from flight_design.identification.step_response_fit import has_direction_of_Omega

OUTPUTS = ("p", "r")
INPUTS = ("aileron", "rudder")
OMEGA: FloatArray = np.array([[40.0, 3.0], [-2.0, 8.0]])  # rad/s^2 per rad
DAMPING = np.diag([6.0, 1.5])  # 1/s
LAG = np.array([0.03, 0.08])
DELAY = 0.12
STEP = 0.001  # s


def flown(
    doublets: float, noise: float = 1e-3, seed: int = 1, seconds: float = 40.0
) -> tuple[Signal, Signal]:
    """Return a log of y_dot = -DAMPING y + OMEGA v behind lags and a delay.

    The inputs are doublets in turn, and there are coloured disturbances. y arrives 50 times a
    second, irregularly. The motion is exact at every millisecond for inputs that are held.
    """
    generator = np.random.default_rng(seed)
    A = np.block([[-DAMPING, OMEGA], [np.zeros((2, 2)), -np.diag(1.0 / LAG)]])
    B = np.vstack([np.zeros((2, 2)), np.diag(1.0 / LAG)])
    Phi, Gamma, *_ = cont2discrete((A, B, np.eye(4), np.zeros((4, 2))), STEP)
    count = round(seconds / STEP)
    t = STEP * np.arange(count)
    phase = t % 4.0
    shape = np.where(phase < 0.5, 1.0, np.where(phase < 1.0, -1.0, 0.0))
    u = doublets * np.stack([shape * (t % 8.0 < 4.0), shape * (t % 8.0 >= 4.0)], axis=1)
    late = np.vstack([np.zeros((round(DELAY / STEP), 2)), u])[:count]
    x = np.zeros(4)
    gust = np.zeros(2)
    states = np.zeros((count, 2))
    for k in range(count):
        states[k] = x[:2]
        gust += STEP * -2.0 * gust + np.sqrt(STEP) * 0.2 * generator.standard_normal(2)
        x = Phi @ x + Gamma @ late[k]
        x[:2] += STEP * gust
    arrivals = np.cumsum(0.02 + 0.001 * generator.standard_normal(round(seconds / 0.02) - 10))
    places = np.round(arrivals / STEP).astype(int)
    y = states[places] + noise * generator.standard_normal((len(places), 2))
    stamps = np.array([nanoseconds(instant) for instant in STEP * places], dtype=np.int64)
    commanded = np.array([nanoseconds(instant) for instant in t[::20]], dtype=np.int64)
    return Signal(stamps, OUTPUTS, y), Signal(commanded, INPUTS, u[::20])


def identified(y: Signal, u: Signal) -> Response:
    return identify_response(y, u, OUTPUTS, INPUTS)


def test_doublets_in_open_loop_give_omega_lag_and_delay_back_within_errors() -> None:
    response = identified(*flown(0.1))
    assert not any(response.refusal)
    assert (np.abs(response.Omega - OMEGA) < 4.0 * response.Omega_deviation).all()
    assert (
        np.abs(np.diag(response.Omega) / np.diag(OMEGA) - 1.0) < 0.2
    ).all()  # known well enough for gains
    # u is held for 0.02 s and y_dot is known every 0.02 s: delay and lag apart are finer than that,
    # their sum is known better
    assert response.delay + response.lag == pytest.approx(DELAY + LAG, abs=0.015)


def test_only_time_in_which_u_acts_on_aircraft_counts() -> None:
    # From 20 s on the log holds a u that does not act, as that of a controller beside an autopilot
    # which flies by itself.
    y, u = flown(0.1)
    engaged_ns = nanoseconds(20.0)
    reversed_u = Signal(
        u.stamp_ns, u.names, np.where((u.stamp_ns > engaged_ns)[:, None], -u.values, u.values)
    )
    response = identify_response(y, reversed_u, OUTPUTS, INPUTS, engaged=[(0, engaged_ns)])
    assert not any(response.refusal)
    assert (
        np.abs(np.diag(response.Omega) / np.diag(OMEGA) - 1.0) < 0.3
    ).all()  # half of the time: 0.2 times sqrt(2)
    assert (
        np.diag(identified(y, reversed_u).Omega) / np.diag(OMEGA) < 0.5
    ).all()  # the two halves contradict each other
    assert (response.sign_ratio > 10.0).all()


def test_input_that_hardly_moves_refused_with_excitation_that_it_needs() -> None:
    response = identified(*flown(2e-4))
    assert all(
        "excite" in sentence and "times as strongly" in sentence
        for sentence in map(str, response.refusal)
    )


def test_response_whose_sign_is_not_that_of_omega_is_no_fit() -> None:
    # 1120 / (s^2 + 23 s + 267), all of it in the slow part: an elevator of 110 rad/s^2 per rad had
    # an Omega of -0.016
    t = np.arange(0.02, 0.8, 0.02)
    assert not has_direction_of_Omega(t, np.array([0.07, 0.003, -0.016, 23.0, 267.0, 1120.0]))
    assert has_direction_of_Omega(t, np.array([0.07, 0.04, 110.0, 23.0, 0.0, 0.0]))
    assert has_direction_of_Omega(t, np.array([0.07, 0.04, -48.0, 13.0, 104.0, -40.0]))
