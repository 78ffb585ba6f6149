# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Define the protocol of a control law as pure functions over a state.

Controller, replay and campaigns fly every law through this protocol.

A law with validated parameters is a subclass of `params.ControllerConfig`. The controller looks it
up by name under the entry point group `laws.GROUP`. See docs/laws.md.
"""

from collections.abc import Callable
from functools import lru_cache
from typing import Any, NamedTuple

from flight_core.vectors import Array, array_namespace
from rise_di_controller.law.saturation import Limits


class Measurements(NamedTuple):
    """Inputs of a law at a tick, as deviations from trim in SI, with channels in the law's order.

    Arrays have shape (m,) for a single aircraft. In a campaign the N aircraft are the last axis:
    (m, N), or (m, 1) for a value that all aircraft share. The fields from `position` to `y_dot` are
    not on the topics. Only campaigns fill them in, for laws that need more sensors.
    """

    y: Array  # measured outputs
    y_m: Array  # reference at the stamp of y
    y_m_dot: Array  # slope of y_m since the previous tick
    u_trim: Array  # u at engagement plus the feedforward, to which the law adds its output
    u_before: Array  # the last command, after saturation
    position: Array | None = None  # positions of the actuators
    # state, (n, N), with measured values of the outputs and true values of all other states
    x: Array | None = None
    x_air: Array | None = None  # x with alpha and beta relative to the air, (n, N)
    y_dot: Array | None = None  # true derivative of C x, free of noise and delay
    vane: Array | None = None  # readings of the vanes of an observer, (k,), rad
    # readings of the vanes in the reference motion of the feedforward's model, (k,)
    vane_m: Array | None = None


def _no_prediction(state: Any, measurements: Measurements, params: Any) -> Any:
    return state


class ControlLaw(NamedTuple):
    """A control law as pure functions of state and parameters, with NumPy and JAX arrays.

    The state is a NamedTuple of arrays, (m,) or (m, N). The log records the fields of the state by
    name, so that a replay can continue from any tick. The parameters can be any NamedTuple of
    arrays.

    `engage` makes the state at engagement, and the first u must equal u_trim. `step` advances the
    law by a tick of dt seconds without limits. `limited` advances the law inside limits, with its
    anti-windup. If no limit acts, `limited` must give the same bits as `step`. `retune` carries the
    state over to new parameters without a jump of u. `missed` predicts the state over one period
    without a sample, while u is held.
    """

    state: type[Any]
    engage: Callable[[Measurements, Any], Any]  # (measured, params) -> state
    # (state, measured, dt, params) -> (state, u)
    step: Callable[[Any, Measurements, Array, Any], tuple[Any, Array]]
    limited: Callable[[Any, Measurements, Array, Any, Limits], tuple[Any, Array, Array]]
    """(state, measured, dt, params, limits) -> (state, u before saturation, u)"""
    retune: Callable[[Any, Any, Any], Any]  # (state, old params, new params) -> state
    # (state, measured, params) -> state
    missed: Callable[[Any, Measurements, Any], Any] = _no_prediction
    # the law that this law extends, if any; the state field `law` holds the state of `inner`
    inner: "ControlLaw | None" = None


class TunedLaw(NamedTuple):
    """A control law with parameters.

    Attributes:
        control_law: The law.
        params: Parameters of the law, a NamedTuple of arrays.

    Examples:
        >>> rise_di.find_scenario("osprey_servo").controller.tuned_law().params.K.shape
        (4,)
    """

    control_law: ControlLaw
    params: Any


def without_limits(
    limited: Callable[[Any, Measurements, Array, Any, Limits], tuple[Any, Array, Array]],
) -> Callable[[Any, Measurements, Array, Any], tuple[Any, Array]]:
    """Derive the function `step` of a law from its function `limited`, with infinite limits.

    Args:
        limited: A tick inside limits: (state, measurements, dt, params, limits) -> (state, u before
            saturation, u).

    Returns:
        A tick without limits: (state, measurements, dt, params) -> (state, u), u of shape (m,).

    Examples:
        >>> law = rise_di.find_scenario("osprey_servo").controller.control_law()
        >>> callable(rise_di.without_limits(law.limited))
        True
    """

    def step(state: Any, measurements: Measurements, dt: Array, params: Any) -> tuple[Any, Array]:
        infinite = array_namespace(measurements.y).inf + 0.0 * measurements.y
        after, u, _ = limited(
            state, measurements, dt, params, Limits(-infinite, infinite, infinite)
        )
        return after, u

    return step


def fields(state: Any) -> dict[str, Array]:
    """Return the arrays of a law's state by name.

    If the law extends another law, the arrays of the extended law come first.
    """
    values: dict[str, Array] = {}
    for name, value in state._asdict().items():
        values |= fields(value) if hasattr(value, "_asdict") else {name: value}
    return values


def restored(law: ControlLaw, values: Any) -> Any:
    """Rebuild the state of a law from its arrays by name, the inverse of `fields`."""
    inner = {} if law.inner is None else {"law": restored(law.inner, values)}
    return law.state(
        **inner, **{name: values[name] for name in law.state._fields if name not in inner}
    )


@lru_cache(maxsize=64)
def field_names(law: ControlLaw) -> tuple[str, ...]:
    """Return the names of the arrays of a law's state, in the order of `fields`."""
    inner_names = () if law.inner is None else field_names(law.inner)
    return (
        *inner_names,
        *(name for name in law.state._fields if law.inner is None or name != "law"),
    )
