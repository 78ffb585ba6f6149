# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test the arithmetic that is promised: order of sums, sine and inverse.

It is compared with exact fractions and decimals.
"""

import math
from decimal import Decimal, localcontext
from fractions import Fraction

import jax
import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from tests.conftest import refusing

from flight_analysis.closed_loop.replay import replay
from flight_analysis.closed_loop.scenario import scenario_yaml
from flight_analysis.closed_loop.scenario_library import find_scenario
from flight_analysis.closed_loop.simulate import simulate
from flight_core.arithmetic import MAX_ANGLE, PI_HIGH, PI_LOW, inverse, product, sine
from flight_log.log_content import StoredFile
from flight_log.provenance import provenance
from flight_log.tape_reader import RecordedRun

NUMBERS = st.floats(-1e3, 1e3)
PI = Fraction("3.14159265358979323846264338327950288419716939937510582097494")


def exact_sine(x: float) -> float:
    """Return the Taylor series with 80 decimal digits."""
    with localcontext() as context:
        context.prec = 80
        angle = Decimal(x) - 2 * round(Fraction(x) / (2 * PI)) * Decimal(PI.numerator) / Decimal(
            PI.denominator
        )
        term = total = angle
        for k in range(1, 40):
            term *= -angle * angle / (2 * k * (2 * k + 1))
            total += term
        return float(total)


@given(arrays(np.float64, (3, 7), elements=NUMBERS), arrays(np.float64, (7,), elements=NUMBERS))
def test_sums_go_from_first_column_to_last(matrix: np.ndarray, vector: np.ndarray) -> None:
    expected = []
    for row in matrix.tolist():
        total = row[0] * float(vector[0])
        for a, x in zip(row[1:], vector[1:].tolist(), strict=True):
            total = total + a * x
        expected.append(total)
    assert product(matrix, vector).tobytes() == np.array(expected).tobytes()
    fleet = np.stack([vector, -vector], axis=1)
    assert product(matrix, fleet)[:, 0].tobytes() == np.array(expected).tobytes()
    every = np.stack([matrix, -matrix], axis=2)
    assert product(every, fleet)[:, 1].tobytes() == np.array(expected).tobytes()
    assert product(np.asfortranarray(matrix), vector).tobytes() == np.array(expected).tobytes()


@given(st.floats(-1e3, 1e3) | st.floats(-4.0, 4.0) | st.floats(-MAX_ANGLE, MAX_ANGLE))
def test_sine_is_within_stated_error(x: float) -> None:
    assert abs(sine(x) - exact_sine(x)) < 5e-16
    assert sine(np.array([x]))[0] == sine(x)
    assert sine(-x) == -sine(x)


def test_sine_of_any_number_is_bounded() -> None:
    assert sine(0.0) == sine(-0.0) == 0.0
    for x in (1e300, -1e300, math.inf, 1e17):
        assert abs(sine(x)) <= 1.0
    assert math.isnan(sine(np.array([math.nan]))[0])


def test_parts_of_pi() -> None:
    assert abs(Fraction(PI_HIGH) + Fraction(PI_LOW) - PI) < Fraction(2) ** -81
    assert all(
        (Fraction(k) * Fraction(PI_HIGH)) == Fraction(k * PI_HIGH)
        for k in (1, 319, 318309, 2**23 - 1)
    )


@given(arrays(np.float64, (4, 4), elements=st.floats(-1.0, 1.0)))
def test_inverse_of_dominant_matrix(part: np.ndarray) -> None:
    matrix = part + 5.0 * np.eye(4)
    assert np.abs(matrix @ inverse(matrix) - np.eye(4)).max() < 1e-14


def test_inverse_pivots() -> None:
    assert inverse(np.array([[0.0, 2.0], [-4.0, 0.0]])).tolist() == [[0.0, -0.25], [0.5, 0.0]]


def test_jax_is_near() -> None:
    """XLA may contract products and sums, so the bound is one rounding error per term."""
    rng = np.random.default_rng(5)
    with jax.enable_x64(True):
        for _ in range(20):
            matrix = rng.normal(size=(8, 8))
            vector = rng.normal(size=8)
            scale = np.abs(matrix) @ np.abs(vector)
            assert (
                np.abs(jax.jit(product)(matrix, vector) - product(matrix, vector))
                <= 8 * 2.0**-53 * scale
            ).all()
            x = rng.normal(size=50) * 100.0
            assert np.abs(jax.jit(sine)(x) - sine(x)).max() < 1e-15


def test_log_of_another_arithmetic_refused() -> None:
    scenario = find_scenario("osprey_servo", 0.5)
    stored = StoredFile("osprey_servo.yaml", scenario_yaml(scenario).encode())
    tape = simulate(scenario)
    assert replay(RecordedRun(tape, stored, provenance())).is_equal()
    with refusing("arithmetic: found 7, expected 1: a later version recorded the log"):
        replay(RecordedRun(tape, stored, {"rise_di_versions": {"arithmetic": "7"}}))
