# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test new models in flight: u stays, and observer and feedforward go on from the motion.

The numbers are by hand, for an engaged controller of one channel. Its law gives 0.2, its observer
0.4 and its feedforward 0.1 above a trim of 10.
"""

from typing import Any

import numpy as np
import pytest
from pytest import approx
from tests.closed_loop import law_params

from flight_analysis.closed_loop.scenario_library import find_scenario
from flight_core.modes import Mode
from flight_core.parameters import flatten
from flight_core.vectors import FloatArray, StampedVector
from rise_di_controller.extensions.feedforward import FeedforwardState, Nominal, nominal_model
from rise_di_controller.extensions.observer import (
    ObserverParams,
    ObserverState,
    PastTick,
    with_observer,
)
from rise_di_controller.guard.guard import ControllerState, GuardParams, initial_state, tick
from rise_di_controller.guard.retuning import retune_state
from rise_di_controller.law.control_law import TunedLaw
from rise_di_controller.law.law import CONTROL_LAWS, LawState, Sign, control
from rise_di_controller.law.saturation import Limits
from rise_di_controller.learning.proposals import DESIGNED
from rise_di_controller.rise_di_config import RiseDiConfig

DT = np.float64(0.1)
TRIM = 10.0
OF_LAW = 0.2
OF_OBSERVER = 0.4
OF_FEEDFORWARD = 0.1
LAW = with_observer(CONTROL_LAWS[Sign.SOFT])
HALF = law_params([5.0], [2.0], [3.0], [-1.0], input_scale=[0.5])
TICK = PastTick(e=np.array([2.0]), u=np.array([0.6]), y_m=np.array([7.0]), dt=DT)
"""A tick at rest: u less the trim and the feedforward is 0.6, from the law and the observer."""


def params(F: float = 3.0, **changes: Any) -> ObserverParams:
    """Return an observer with Phi = 0.5, Gamma = 2, H = 1, L = 0.25 and a u_o of at most 5."""
    Phi, Gamma, H, L = (np.array([[value]]) for value in (0.5, 2.0, 1.0, 0.25))
    bound = np.array([changes.pop("bound", 5.0)])
    return ObserverParams(
        law=HALF,
        Phi=Phi,
        Gamma=Gamma,
        H=H,
        L=L,
        F=np.array([[F]]),
        limits=Limits(-bound, bound, np.array([np.inf])),
        fade_rate=np.array(2.0),
    )._replace(**changes)


def model(drift: float, effect: float) -> Nominal:
    """Return the model x_dot = drift x + effect u, y = x."""
    one = np.eye(1)
    return nominal_model(drift * one, effect * one, one, 0.0 * one, np.zeros(1))


def engaged(u_o: float = OF_OBSERVER, y_m: tuple[float, float] = (7.0, 7.0)) -> ControllerState:
    """Return the state after two ticks with the given y_m."""
    # u = -D input_scale (K (e - e_0 + Lambda integral_e) + Pi) = 0.5 (5 (2 - 2) + Pi)
    of_law = OF_LAW + OF_OBSERVER - u_o
    e = np.array([2.0])
    law = LawState(e_0=e, e=e, integral_e=np.zeros(1), Pi=np.array([2.0 * of_law]))
    x = np.array([y_m[1]])
    u_ff = np.array([OF_FEEDFORWARD])
    return initial_state(1)._replace(
        mode=Mode.ENGAGED,
        law=ObserverState(law, np.array([1.0]), np.array([u_o]), np.array([0.3])),
        feedforward=FeedforwardState(
            x=x, u=u_ff, dt=DT, ticks=np.float64(9.0), u_0=np.array([0.3])
        ),
        y=StampedVector(0, np.array([9.0])),
        y_m=x,
        u_trim=np.array([TRIM]),
        u_ff=u_ff,
        u=np.array([TRIM + OF_FEEDFORWARD + OF_LAW + OF_OBSERVER]),
        history=tuple(TICK._replace(y_m=np.array([value])) for value in y_m),
    )


def guard(nominal: Nominal | None) -> GuardParams:
    return GuardParams(
        period_ns=100_000_000,
        max_age_ns=300_000_000,
        hold_ns=0,
        ramp_ns=0,
        deactivation_holds=False,
        limits=Limits(np.array([-50.0]), np.array([50.0]), np.array([np.inf])),
        samples=None,  # type: ignore[arg-type]
        nominal=nominal,
        history=2,
    )


def retuned(
    state: ControllerState,
    old: ObserverParams,
    new: ObserverParams,
    nominals: tuple[Nominal | None, Nominal | None] = (None, None),
) -> ControllerState:
    before, after = nominals
    return retune_state(
        state, TunedLaw(LAW, old), TunedLaw(LAW, new), (guard(before), guard(after))
    )


def contributions(state: ControllerState) -> tuple[float, float, float]:
    """Return what the law, the observer and the feedforward contribute to u."""
    law: FloatArray = control(state.law.law, state.law.law, HALF)
    return law.item(), state.law.u_o.item(), state.u_ff.item()


@pytest.mark.parametrize("change", [{"F": 4.0}, {"L": np.array([[0.5]])}])
def test_new_observer_goes_on_with_its_contribution(change: dict[str, Any]) -> None:
    new = params(**change)
    after = retuned(engaged(), params(), new)
    assert contributions(after) == approx((OF_LAW, OF_OBSERVER, OF_FEEDFORWARD))
    assert after.u_trim.item() == TRIM
    assert after.law.sigma.tolist() == [1.0]
    # At rest z = Phi (z + L (e - z)) + Gamma u: with L = 0.25 z = (0.25 + 1.2) / 0.625 = 2.32,
    # with L = 0.5 z = (0.5 + 1.2) / 0.75.
    assert after.law.z.item() == approx(2.32 if new.L.item() == 0.25 else 1.7 / 0.75)


def test_equal_observer_is_left_alone() -> None:
    before = engaged()
    assert retuned(before, params(), params()) == before


def test_first_observer_of_a_channel_takes_over_what_the_law_has_integrated() -> None:
    after = retuned(engaged(u_o=0.0), params(F=0.0, bound=0.0), params())
    assert contributions(after) == approx((0.0, OF_LAW + OF_OBSERVER, OF_FEEDFORWARD))


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_law_keeps_what_is_beyond_the_limits_of_the_observer(sign: float) -> None:
    new = params(bound=0.3)
    old = params(F=0.0, bound=0.0)
    before = engaged(u_o=0.0)
    before = before._replace(
        u=before.u_trim + before.u_ff + sign * (OF_LAW + OF_OBSERVER),
        law=before.law._replace(law=before.law.law._replace(Pi=sign * before.law.law.Pi)),
    )
    assert contributions(retuned(before, old, new)) == approx(
        (sign * 0.3, sign * 0.3, OF_FEEDFORWARD)
    )


def test_law_takes_over_from_an_observer_that_ends() -> None:
    after = retuned(engaged(), params(), params(F=0.0))
    assert contributions(after) == approx((OF_LAW + OF_OBSERVER, 0.0, OF_FEEDFORWARD))


def test_new_feedforward_goes_on_and_the_observer_gives_way_to_it() -> None:
    """y_m rises by 0.5 in a tick of 0.1 s, and the new feedforward takes this slope into account.

    u = (5 - (-2) 7.5) / 4 = 5, which is 4.7 more than at the engagement. The observer gives up what
    the feedforward adds.
    """
    before = engaged(y_m=(7.0, 7.5))
    after = retuned(before, params(), params(), (model(-1.0, 4.0), model(-2.0, 4.0)))
    assert contributions(after) == approx((OF_LAW, OF_OBSERVER - 4.6, 4.7))
    assert after.feedforward is not None
    assert after.feedforward.x.tolist() == [7.5]
    # The estimates are those for a u that lacks the 4.6: z = (0.25 - 8) / 0.625.
    assert after.law.z.item() == approx((0.25 + 2.0 * (0.6 - 4.6)) / 0.625)


def test_observer_takes_over_from_a_feedforward_that_ends() -> None:
    after = retuned(engaged(), params(), params(), (model(-1.0, 4.0), None))
    assert contributions(after) == approx((OF_LAW, OF_OBSERVER + OF_FEEDFORWARD, 0.0))
    assert after.feedforward is None


def test_equal_feedforward_is_left_alone() -> None:
    before = engaged()
    assert retuned(before, params(), params(), (model(-1.0, 4.0), model(-1.0, 4.0))) == before


def test_without_a_record_the_trim_takes_over_the_feedforward() -> None:
    """One tick does not show the slope of y_m, so the new feedforward begins again at y_m."""
    before = engaged()._replace(history=(TICK,))
    after = retuned(before, params(), params(), (model(-1.0, 4.0), model(-2.0, 4.0)))
    assert contributions(after) == approx((OF_LAW, OF_OBSERVER, 0.0))
    assert after.u_trim.item() == approx(TRIM + OF_FEEDFORWARD)
    assert after.feedforward is not None
    assert after.feedforward.x.tolist() == [7.0]
    assert after.feedforward.ticks.item() == 0.0
    assert retuned(before, params(), params(), (model(-1.0, 4.0), None)).feedforward is None


def test_record_holds_what_each_tick_had() -> None:
    """The record has seven ticks of 10 ms, one of them without y, and room for four."""
    flown = find_scenario("osprey_learn").rise_di()
    observed = dict(flatten(find_scenario("osprey_observer").rise_di().model_dump()))
    change = {name: value for name, value in observed.items() if name.split(".")[0] in DESIGNED}
    config = RiseDiConfig.validate_mapping(flown.changed(change), "learned")
    short = config.guard()._replace(history=4)
    state = initial_state(4)
    u = []
    for k in (0, 1, 2, 3, 5, 6):
        y_m = 0.01 * np.sin(k + np.arange(4.0))
        now = StampedVector(10_000_000 * k, y_m + 1e-3 * k)
        state, _ = tick(
            state, now.stamp_ns, now, [now._replace(value=y_m)], short, config.tuned_law()
        )
        u.append(state.u - state.u_trim - state.u_ff)
    assert state.u_ff.any()
    assert [None if past.e is None else past.e[0] for past in state.history] == approx(
        [3e-3, None, 5e-3, 6e-3]
    )
    assert [float(past.dt) for past in state.history] == approx([0.01, 0.01, 0.02, 0.01])
    # The tick without a y had the u and the y_m of the tick before it.
    for past, flown_u, k in zip(state.history, [u[3], u[3], u[4], u[5]], (3, 3, 5, 6), strict=True):
        assert past.u == approx(flown_u, abs=1e-15)
        assert past.y_m == approx(0.01 * np.sin(k + np.arange(4.0)))
