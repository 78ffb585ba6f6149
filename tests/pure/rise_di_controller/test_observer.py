# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test ticks of the observer against numbers by hand, around a law that gives the trim."""

from typing import Any

import numpy as np
from pytest import approx

from flight_core.vectors import FloatArray, StampedVector
from rise_di_controller.extensions.observer import (
    ObserverParams,
    ObserverState,
    PastTick,
    estimates_after,
    with_observer,
)
from rise_di_controller.guard.guard import initial_state
from rise_di_controller.guard.retuning import retune_state
from rise_di_controller.law.control_law import ControlLaw, Measurements, TunedLaw
from rise_di_controller.law.saturation import Limits

DT = np.float64(0.1)
TRIM = 10.0
TRIM_LAW: Any = ControlLaw(
    state=tuple,
    engage=lambda measured, params: (),
    step=lambda state, measured, dt, params: (state, measured.u_trim),
    limited=lambda state, measured, dt, params, limits: (state, measured.u_trim, measured.u_trim),
    retune=lambda state, old, new: state,
    missed=lambda state, measured, params: state,
)


def vector(value: float) -> FloatArray:
    return np.array([value])


def params(bound: float = np.inf, rate: float = np.inf) -> ObserverParams:
    """Return an observer with Phi = 0.5, Gamma = 2, H = 1, L = 0.25 and F = 3.

    It has its full effect after 0.5 s.
    """
    Phi, Gamma, H, L, F = (np.array([[value]]) for value in (0.5, 2.0, 1.0, 0.25, 3.0))
    return ObserverParams(
        law=(),
        Phi=Phi,
        Gamma=Gamma,
        H=H,
        L=L,
        F=F,
        limits=Limits(vector(-bound), vector(bound), vector(rate)),
        fade_rate=np.array(2.0),
    )


def measured(e: float, u_before: float = TRIM) -> Measurements:
    y_m = 7.0  # the observer takes the difference alone
    return Measurements(
        y=vector(e + y_m),
        y_m=vector(y_m),
        y_m_dot=vector(0.0),
        u_trim=vector(TRIM),
        u_before=vector(u_before),
    )


def respond(errors: list[float], observer: ObserverParams) -> list[float]:
    """Return the inputs u minus the trim for a series of errors, the first at the engagement."""
    law = with_observer(TRIM_LAW)
    state = law.engage(measured(errors[0]), observer)
    inputs = []
    for e in errors[1:]:
        state, u = law.step(state, measured(e), DT, observer)
        inputs.append(float(u[0]) - TRIM)
    return inputs


def test_contribution_fades_in_and_follows_the_estimate() -> None:
    # z = 1 at engagement. e = 1.4: z = 1 + 0.25 0.4 = 1.1, sigma = 0.2, u_o = -0.2 3 1.1 = -0.66,
    # z+ = 0.55 - 1.32 = -0.77 e = -0.5: z = -0.77 + 0.25 0.27 = -0.7025, sigma = 0.4, u_o = 0.4 3
    # 0.7025 = 0.843
    assert respond([1.0, 1.4, -0.5], params()) == approx([-0.66, 0.843], abs=1e-14)


def test_contribution_is_full_after_its_fade_in() -> None:
    # without an effect of u (Gamma = 0) and for a constant e the corrected z = 0.75 (0.5 z) + 0.25
    # e tends to 0.25 e / 0.625
    steady = respond([1.0] * 60, params()._replace(Gamma=np.zeros((1, 1))))[-1]
    assert steady == approx(-3.0 * 0.4, abs=1e-12)


def test_contribution_keeps_its_limits_of_size_and_rate() -> None:
    # 3 per s reach 0.3 a tick; the estimate of a constant e = -10 asks for more in each tick
    responses = respond([-10.0] * 5, params(bound=0.5, rate=3.0)._replace(Gamma=np.zeros((1, 1))))
    assert responses == approx([0.3, 0.5, 0.5, 0.5], abs=1e-14)


def test_missed_tick_predicts_with_the_u_that_was_held() -> None:
    law = with_observer(TRIM_LAW)
    observer = params()
    state = law.engage(measured(1.0), observer)
    # z+ = 0.5 1 + 2 (10.5 - 10) = 1.5
    assert law.missed(state, measured(0.0, u_before=10.5), observer).z == approx([1.5], abs=1e-15)


def test_filter_over_the_record_is_that_of_each_tick() -> None:
    law = with_observer(TRIM_LAW)
    slow = params()
    fast = slow._replace(Phi=0.6 * slow.Phi, Gamma=2.0 * slow.Gamma)
    filters = [slow] * 40 + [fast] * 3 + [slow, fast] * 2
    record = []
    state = law.engage(measured(1.0), slow)
    for e, of_tick in zip(np.sin(np.arange(47.0)), filters, strict=True):
        state, u = law.step(state, measured(e), DT, of_tick)
        record.append(PastTick(vector(e), u - TRIM, vector(7.0), DT))
    assert estimates_after(tuple(record), vector(0.0), filters) == approx(state.z, abs=1e-14)


def test_filter_starts_in_its_steady_state_and_predicts_where_no_y_came() -> None:
    # change 0.1, means e = 2 and u = 0.15: z = (0.5 0.25 2 + 2 0.15) / (1 - 0.375) = 0.88
    # without y: z+ = 0.5 0.88 + 2 0.1 = 0.64. e = 2: z = 0.64 + 0.25 1.36 = 0.98, z+ = 0.49 + 2
    # (0.3 - 0.1) = 0.89
    record = (
        PastTick(None, vector(0.2), vector(7.0), DT),
        PastTick(vector(2.0), vector(0.3), vector(7.0), DT),
    )
    assert estimates_after(record, vector(0.1), [params()] * len(record)) == approx(
        [0.89], abs=1e-14
    )


def test_new_observer_without_record_starts_from_error_and_trim_keeps_contribution() -> None:
    """A new observer without a record starts from the error, z = H'e = 0.5, as at an engagement.

    u keeps the 10.7 that it has after the first tick.
    """
    law = with_observer(TRIM_LAW)
    old = params()
    state = initial_state(1)._replace(
        law=ObserverState((), vector(0.4), vector(0.7), vector(1.0)),
        y=StampedVector(0, vector(7.5)),
        y_m=vector(7.0),
        u=vector(TRIM + 0.7),
        u_trim=vector(TRIM),
    )
    after = retune_state(
        state, TunedLaw(law, old), TunedLaw(law, old._replace(L=np.array([[0.5]])))
    )
    assert (after.u_trim.item(), after.law.u_o.item(), after.law.z.item()) == approx(
        (TRIM + 0.7, 0.0, 0.5)
    )
