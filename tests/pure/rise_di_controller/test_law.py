# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test a step of the law against numbers by hand and against closed forms."""

import copy
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pytest import approx
from tests.closed_loop import law_params

from rise_di_controller.law.law import (
    LawParams,
    LawState,
    Sign,
    control,
    engage,
    gain,
    retune,
    step,
    step_with_anti_windup,
)
from rise_di_controller.law.saturation import Limits, limited_integral

DT = 0.1


def one_channel(sign: Sign, D: float = -1.0) -> LawParams:
    """Return the law of one channel: K = 2, Lambda = 3, beta = 4 and an input scale of 1/2."""
    return law_params(
        gain(np.array(1.0), np.array([])), 3.0, 4.0, D, sign, input_scale=0.5, eps=0.1
    )


def respond(params: LawParams, errors: list[float], dt: float = DT) -> list[float]:
    """Return the inputs u of one channel for a series of errors, the first at the engagement."""
    state = engage(np.array([errors[0]]), np.zeros(1))
    inputs = []
    for e in errors[1:]:
        state, u = step(state, np.array([e]), np.zeros(1), np.array(dt), params)
        inputs.append(float(u[0]))
    return inputs


@pytest.mark.equation(22)
def test_gain_has_the_structure_of_equation_22() -> None:
    # K = I + k_g I + diag(k_d, 0): 1 + 2 + 5, 1 + 2 + 7, 1 + 2
    assert gain(np.array(2.0), np.array([5.0, 7.0])).tolist() == [8.0, 10.0, 3.0]


@pytest.mark.equation(3, 20, 21)
def test_literal_sign_gives_the_hand_worked_inputs() -> None:
    # e_0 = 1; e = 1.2: integral 0.1 (1.2 + 1)/2 = 0.11, Pi applied 0: v = 2 (0.2 + 3 0.11) = 1.06
    # e = 0.9: integral 0.11 + 0.1 (0.9 + 1.2)/2 = 0.215, Pi applied 0.1 4 = 0.4: v = 2 (-0.1 + 3
    # 0.215) + 0.4 = 1.49 D = -1, so -D = +1; u = v / 2
    assert respond(one_channel(Sign.LITERAL), [1.0, 1.2, 0.9]) == approx([0.53, 0.745], abs=1e-15)


def test_implicit_sign_applies_saturated_sign_in_same_tick() -> None:
    # e_hat = 1.2 + 0.2 - 0.1 2 (0.2 + 3 0.11) = 1.294, over dt^2 omega beta = 0.04 is above 1: s =
    # 1, Pi = 0.4 v = 1.06 + 0.4
    assert respond(one_channel(Sign.IMPLICIT), [1.0, 1.2]) == approx([0.73], abs=1e-15)


@pytest.mark.equation(21)
def test_implicit_sign_zeroes_predicted_error() -> None:
    # From rest, e = 0.01: integral 0.0005, e_hat = 0.01 + 0.01 - 0.2 (0.01 + 3 0.0005) = 0.0177
    # s = 0.0177 / 0.04 = 0.4425, Pi = 0.1 4 0.4425 = 0.177, v = -(2 (0.01 + 0.0015) + 0.177) = -0.2
    assert respond(one_channel(Sign.IMPLICIT, D=1.0), [0.0, 0.01]) == approx([-0.1], abs=1e-15)


@pytest.mark.equation(21)
def test_softened_sign_is_saturated_line() -> None:
    """The softened sign is proportional within its width, and +-1 outside."""
    # e = 0.05, eps = 0.1: s = 0.5, Pi = 0.1 4 0.5 = 0.2, integral 0.0025: v = 2 (0.05 + 3 0.0025) +
    # 0.2 = 0.315
    assert respond(one_channel(Sign.SOFT), [0.0, 0.05]) == approx([0.1575], abs=1e-15)
    # e = 1.2 from 1: s = 1, as with the implicit sign
    assert respond(one_channel(Sign.SOFT), [1.0, 1.2]) == approx([0.73], abs=1e-15)


@pytest.mark.equation(3)
def test_input_is_zero_at_engagement_whatever_error() -> None:
    # (20) with t = 0: u = -D K (e(0) - e(0)) - D Pi(0) = 0; the first step adds the integrals of
    # one tick only.
    state = engage(np.array([5.0, -3.0]), np.array([1.0, 1.0]))
    assert state.e_0.tolist() == [4.0, -4.0]
    assert state.integral_e.tolist() == [0.0, 0.0]
    assert state.Pi.tolist() == [0.0, 0.0]


@pytest.mark.equation(20)
@pytest.mark.parametrize("sign", list(Sign))
def test_constant_error_gives_a_ramp(sign: Sign) -> None:
    # (20), (21) with e = e_0 = 2: u = -D (K Lambda e + beta) t, so v grows by 2 3 2 0.1 + 4 0.1 =
    # 1.6 a tick, u by 0.8.
    inputs = np.array(respond(one_channel(sign), [2.0] * 50))
    assert np.diff(inputs) == approx(0.8, rel=1e-12)
    # The literal sign uses Pi as it stands, one tick later than the implicit sign.
    assert inputs[0] == approx(0.6 if sign is Sign.LITERAL else 0.8, rel=1e-12)


@pytest.mark.parametrize("sign", list(Sign))
def test_zero_error_leaves_the_input_at_zero(sign: Sign) -> None:
    assert respond(one_channel(sign), [0.0] * 100) == [0.0] * 99


@pytest.mark.parametrize("sign", list(Sign))
@given(errors=st.lists(st.floats(-10, 10), min_size=3, max_size=20))
def test_the_law_is_odd_in_the_error(sign: Sign, errors: list[float]) -> None:
    # Every term of (20), (21) is odd in e, and so is each sampling of them.
    assert respond(one_channel(sign), [-e for e in errors]) == [
        -u for u in respond(one_channel(sign), errors)
    ]


@given(e=st.lists(st.floats(-1, 1), min_size=2, max_size=2))
def test_channels_do_not_mix(e: list[float]) -> None:
    # K, Lambda, beta and D are diagonal: the first of two channels equals a single channel.
    single = one_channel(Sign.IMPLICIT)
    doubled: dict[str, Any] = {
        name: np.repeat(getattr(single, name), 2) for name in single._fields if name != "sign"
    }
    both = single._replace(**doubled)
    zero = np.zeros(2)
    _, u = step(engage(zero, zero), np.array(e), zero, np.array(DT), both)
    assert u[0] == respond(one_channel(Sign.IMPLICIT), [0.0, e[0]])[0]


@pytest.mark.parametrize("sign", [*Sign])
def test_a_step_changes_none_of_its_arguments(sign: Sign) -> None:
    """A step changes neither the state, y and y_m nor a parameter.

    All ticks and all aircraft share the gains.
    """
    params = one_channel(sign)
    state = LawState(*(np.array([value]) for value in (1.0, 2.0, 3.0, 4.0)))
    y, y_m, dt, u_trim, u_before = (np.array([value]) for value in (1.5, 0.5, DT, 0.2, 0.1))
    limits = Limits(*(np.array([value]) for value in (-0.3, 0.3, 2.0)))
    arguments = (*state, y, y_m, dt, u_trim, u_before, *limits, *params)
    before = copy.deepcopy(arguments)
    step(state, y, y_m, dt, params)
    step_with_anti_windup(state, y, y_m, dt, u_trim, u_before, params, limits)
    retune(state, params, params._replace(K=2.0 * params.K))
    assert all(map(np.array_equal, arguments, before))


def test_retuned_law_keeps_its_input_also_where_the_sign_of_an_effect_changes() -> None:
    old = one_channel(Sign.LITERAL, D=-1.0)
    new = one_channel(Sign.LITERAL, D=1.0)._replace(K=np.array([5.0]))
    state, _ = step(
        engage(np.array([1.0]), np.zeros(1)), np.array([1.2]), np.zeros(1), np.array(DT), old
    )
    retuned = retune(state, old, new)
    assert control(retuned, retuned, new) == approx(control(state, state, old), abs=1e-15)


@pytest.mark.parametrize(
    "before, after, change, beyond, expected",
    [
        (1.0, 3.0, 0.5, 0.2, 2.2),  # 0.2 of 0.5 beyond: 60 % of the increment of 2 are kept
        (1.0, 3.0, -0.5, -0.2, 2.2),
        (-1.0, -3.0, -0.5, -0.125, -2.5),  # 75 % are kept
        (1.0, 3.0, 0.5, 0.5, 1.0),
        (1.0, 3.0, 0.5, 0.8, 1.0),  # more than the increment is beyond: nothing is kept
        (1.0, 3.0, 0.5, -0.2, 3.0),  # inward
        (1.0, 3.0, 0.5, 0.0, 3.0),
        (1.0, 3.0, 0.0, 0.3, 3.0),
    ],
)
def test_outward_increment_is_reduced_by_what_is_beyond(
    before: float, after: float, change: float, beyond: float, expected: float
) -> None:
    """The increment is reduced as the formula of the docstring says, or `after` stays to the bit.

    It is reduced if `change` and `beyond` have the same sign.
    """
    values = (np.array([value]) for value in (before, after, change, beyond))
    integral = limited_integral(*values)
    assert integral[0] == (approx(expected, rel=1e-12) if change * beyond > 0 else expected)
