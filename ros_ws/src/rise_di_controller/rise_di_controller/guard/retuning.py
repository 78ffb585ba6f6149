# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Change the parameters of a law in flight without a jump of u (bumpless transfer)."""

from typing import Any

import numpy as np

from flight_core.vectors import Array, FloatArray
from rise_di_controller.extensions import feedforward, observer
from rise_di_controller.extensions.feedforward import Nominal
from rise_di_controller.extensions.observer import ObserverParams, ObserverState
from rise_di_controller.extensions.schedule import ScheduleState, law_at, observers_of
from rise_di_controller.guard.guard import ControllerState, GuardParams, nominal_at_speed
from rise_di_controller.law.control_law import TunedLaw
from rise_di_controller.law.law import LawState, shifted


def retune_state(
    state: ControllerState,
    old: TunedLaw,
    new: TunedLaw,
    guards: tuple[GuardParams, GuardParams] | None = None,
) -> ControllerState:
    """Carry the state over to new parameters of the law, without a jump of u (bumpless transfer).

    | change | with a history of ticks | without a history |
    |---|---|---|
    | same matrices of the observer | the observer continues | the observer continues |
    | new observer | z from the new filter, u_o continues | starts from the present e |
    | new feedforward | continues the same motion | u_ff becomes part of u_trim |

    When an observer starts from the present error, its former output u_o becomes a part of u_trim.
    With a schedule, the state continues with the models of the present speed, while the run over
    the history uses at each tick the models of the speed at that tick. `guards` are the old and the
    new parameters of the guard, which hold the models of the feedforward.
    """
    y = state.y
    y_m = state.y_m
    if state.law is None or y is None or y_m is None:
        return state
    law = new.control_law.retune(state.law, old.params, new.params)
    before, after = (
        (None, None) if guards is None else (nominal_at_speed(guard, law) for guard in guards)
    )
    has_new_nominal = not _has_same_arrays(before, after)
    inner = law  # state of the law that a schedule may wrap
    observers = (old.params, new.params)
    if isinstance(law, ScheduleState):
        inner, observers = law.law, tuple(law_at(params, law.scale) for params in observers)
    has_new_observer = isinstance(
        inner, (ObserverState, observer.VaneObserverState)
    ) and _is_replaced(*observers)
    if (
        len(state.history) > 1
        and isinstance(inner, ObserverState)
        and isinstance(inner.law, LawState)
    ):
        # With a history, the observer and the feedforward continue in the same motion.
        change: Array = np.zeros_like(state.u)  # change of u_ff
        if has_new_nominal:
            state, change = _with_nominal(state, y_m, after)
        if has_new_observer or has_new_nominal:
            filters = observers_of(new.params, [tick.scale for tick in state.history])
            z = observer.estimates_after(state.history, change, filters)
            inner = _with_estimates(state, inner, z, change, observers)
    else:
        # Without a history both begin again, and their contributions become part of u_trim.
        if has_new_observer and not _has_same_model(*observers):
            z = observer.initial_estimates(y.value - y_m, observers[1])
            state = state._replace(u_trim=state.u_trim + inner.u_o)
            inner = inner._replace(
                z=z, u_o=np.zeros_like(inner.u_o), sigma=np.zeros_like(inner.sigma)
            )
        if has_new_nominal:
            start = None if after is None else feedforward.initial_state(y_m, after)
            state = state._replace(
                u_trim=state.u_trim + state.u_ff, u_ff=np.zeros_like(state.u_ff), feedforward=start
            )
    if isinstance(law, ScheduleState):
        inner = law._replace(law=inner)
    return state._replace(law=inner)


def _with_estimates(
    state: ControllerState,
    observer_state: ObserverState,
    z: Array,
    change: Array,
    observers: tuple[ObserverParams, ...],
) -> ObserverState:
    """Return the state with which a new observer continues the motion of the old one.

    `z` has the estimates of the new observer, and `change` says by how much u_ff changes, (m,).
    `observers` has the old and the new parameters. From here on, u_o moves to -F z at its rate
    limit. In a channel that had no observer before, u_o takes over what the law has integrated.
    Otherwise the integral would stay in the law, and the observer would need a long time to build
    it up.
    """
    law_part = state.u - state.u_trim - state.u_ff
    limits = observers[1].limits
    was_acting, is_acting = (
        (params.limits.upper > 0.0) & np.any(params.F, axis=1) for params in observers
    )
    continued = np.where(was_acting, observer_state.u_o - change, law_part)
    u_o = np.where(is_acting, np.clip(continued, limits.lower, limits.upper), 0.0)
    law_state = shifted(
        observer_state.law,
        law_part - u_o - (law_part + change - observer_state.u_o),
        observers[1].law,
    )
    return ObserverState(law_state, z, u_o, np.ones_like(observer_state.sigma))


def _with_nominal(
    state: ControllerState, y_m: FloatArray, nominal: Nominal | None
) -> tuple[ControllerState, Array]:
    """Return a state in which the feedforward continues its motion with another model.

    If `nominal` is None, there is no feedforward any more. The second result says by how much u_ff
    changes, (m,).
    """
    u_ff = np.zeros_like(state.u)
    continued = None
    if nominal is not None:
        earlier = state.history[-2]
        last = state.history[-1]
        continued = feedforward.with_new_model(
            state.feedforward, y_m, (last.y_m - earlier.y_m) / last.dt, last.dt, nominal
        )
        u_ff = feedforward.of_active_inputs(continued.u - continued.u_0, nominal)
    return state._replace(u_ff=u_ff, feedforward=continued), u_ff - state.u_ff


def _is_replaced(old: ObserverParams, new: ObserverParams) -> bool:
    """Return whether the model of the observer changes, or the observer begins or ceases to act.

    An observer does not act if the limits of its u_o are 0.
    """
    return not _has_same_model(old, new) or bool(
        np.any(old.limits.upper) != np.any(new.limits.upper)
    )


def _has_same_model(old: ObserverParams, new: ObserverParams) -> bool:
    same = all(
        np.array_equal(getattr(old, name), getattr(new, name))
        for name in ("Phi", "Gamma", "H", "L", "F")
    )
    return same and _has_same_arrays(old.vanes, new.vanes)


def _has_same_arrays(old: tuple[Any, ...] | None, new: tuple[Any, ...] | None) -> bool:
    if old is None or new is None:
        return old is new
    return all(np.array_equal(before, after) for before, after in zip(old, new, strict=True))
