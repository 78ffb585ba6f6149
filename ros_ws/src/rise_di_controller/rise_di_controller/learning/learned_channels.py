# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Combine channels that use a learned model with channels that the initial law controls.

The initial law is the law with which the flight started.
"""

from collections.abc import Collection, Sequence
from typing import Any

import numpy as np

from flight_core.channels import SIDES, UNKNOWN
from flight_core.parameters import SMALLEST
from flight_core.vectors import FloatArray
from rise_di_controller.law.law import MIN_GAIN
from rise_di_controller.params import ControllerConfig
from rise_di_controller.rise_di_config import RiseDiConfig


def with_channels_of(
    start: RiseDiConfig, designed: RiseDiConfig, bare: Sequence[bool], dead: Sequence[bool]
) -> RiseDiConfig:
    """Give a designed controller the gains of `start` in the channels that `bare` marks.

    These channels get no feedforward and no observer. The result is not checked.

    By equation (22), no K may be below the K of the last channel. If the K in `start` is below the
    last K of `designed`, the channel gets a K slightly above this last K. Its input_scale, omega
    and beta are then scaled so that the loop stays the same. The inputs that `dead` marks have no
    effect. They get the least input scale, so that the law does not move them.
    """
    law = start.law_params()
    design = designed.law_params()
    last = design.K[-1]
    channels = np.array(bare)
    # Replace a K below the last K by the last K and a smaller input scale.
    K = np.where(channels, np.maximum(law.K, last + MIN_GAIN), design.K)
    K[-1] = last
    share = np.where(channels, law.K / K, 1.0)
    scale = np.where(channels, law.input_scale * share, design.input_scale)
    factors = {"beta": 1.0 / share, "Lambda": 1.0, "omega": share, "softening": 1.0}
    values: dict[str, Any] = {
        name: tuple(
            np.where(
                channels, np.array(getattr(start, name)) * factor, getattr(designed, name)
            ).tolist()
        )
        for name, factor in factors.items()
    }
    values["k_d"] = tuple((K[:-1] - last).tolist())
    values["input_scale"] = tuple(np.where(dead, SMALLEST, scale).tolist())
    observer = designed.observer
    feedforward = designed.feedforward
    schedule = designed.schedule
    if channels.any() and observer is not None and feedforward is not None:

        def without(F: Sequence[float]) -> dict[str, Any]:
            return {
                "F": tuple((np.reshape(F, (len(bare), -1)) * ~channels[:, None]).ravel().tolist())
            }

        acting = feedforward.inputs or start.inputs
        inputs = tuple(
            name
            for name, is_bare in zip(start.inputs, bare, strict=True)
            if name in acting and not is_bare
        )
        values["observer"] = observer.model_copy(update=without(observer.F))
        if schedule is not None and schedule.slow is not None and schedule.fast is not None:
            slow, fast = (model.model_copy(update=without(model.F)) for model in schedule.models)
            values["schedule"] = schedule.model_copy(update={"slow": slow, "fast": fast})
        values["feedforward"] = feedforward.model_copy(update={"inputs": inputs or None})
    return designed.model_copy(update=values)


def acting_inputs(parameters: RiseDiConfig) -> tuple[str, ...]:
    """Return the inputs on which a feedforward or an observer acts."""
    feedforward = parameters.feedforward
    observer = parameters.observer
    inputs = parameters.inputs
    fed = () if feedforward is None else feedforward.inputs or inputs
    models = () if parameters.schedule is None else parameters.schedule.models
    F = np.hstack(
        [
            np.reshape(model.F, (len(inputs), -1))
            for model in (observer, *models)
            if model is not None
        ]
    )
    return tuple(name for name, row in zip(inputs, F, strict=True) if name in fed or row.any())


def authority_names(outputs: Sequence[str]) -> tuple[str, ...]:
    """Return the names of the channels of the topic `authority`."""
    return tuple(f"{side}.{name}" for side in SIDES for name in outputs)


def authority(parameters: RiseDiConfig, start: RiseDiConfig) -> FloatArray:
    """Compute the y_dot that each input can surely give to its output, (2m,), units of y / s.

    The first m values hold for a falling output, the other m for a rising output:

        y_dot_i = abs(Omega_ii) exp(-2 s_i) abs(limit of u_i),
            Omega = C B of the model learned in flight

    s_i is the standard deviation of Omega_ii divided by abs(Omega_ii). For a small s_i the factor
    subtracts two deviations, and for any s_i it stays above 0. If there are models at other speeds,
    the least value over the speeds is returned. The result is 0 for an input without effect. It is
    UNKNOWN if the input has no limit, or if the output does not use a learned model.
    """
    m = len(parameters.outputs)
    model = parameters.feedforward
    acting = acting_inputs(parameters)
    dead = np.array(parameters.input_scale) <= SMALLEST
    bounds = np.where(dead, 0.0, np.full((2, m), UNKNOWN))
    if model is None or parameters.models() == start.models():
        return bounds.ravel()
    rows = [model.states.index(name) for name in parameters.outputs]
    both = (model.B, model.deviation or (0.0,) * len(model.B))
    B, deviation = (np.reshape(values, (-1, m))[rows].diagonal() for values in both)
    least = np.abs(B) * np.exp(-2.0 * deviation / np.abs(B))
    for scheduled in () if parameters.schedule is None else parameters.schedule.models:
        least = least * np.minimum(
            np.abs(np.reshape(scheduled.B, (-1, m))[rows].diagonal() / B), 1.0
        )
    for k, limits in enumerate((parameters.lower, parameters.upper)):
        if limits is None:
            continue
        side = np.where(B > 0.0, k, 1 - k)
        is_known = ~dead & [name in acting for name in parameters.inputs]
        bounds[side[is_known], np.flatnonzero(is_known)] = (least * np.abs(limits))[is_known]
    return bounds.ravel()


def with_fallback(
    start: RiseDiConfig, parameters: RiseDiConfig, bare: Sequence[bool]
) -> RiseDiConfig:
    """Return parameters in which the initial law controls the channels `bare` again.

    If no channel keeps a learned model, the result is `start` itself.
    """
    acting = acting_inputs(parameters)
    is_first = parameters.models() == start.models()
    if is_first or all(
        is_bare or name not in acting for name, is_bare in zip(parameters.inputs, bare, strict=True)
    ):
        return start
    mixed = with_channels_of(
        start, parameters, bare, [scale <= SMALLEST for scale in parameters.input_scale]
    )
    return RiseDiConfig.validate_mapping(mixed.model_dump(), "controller", check=False)


def outputs_given_up(parameters: ControllerConfig) -> tuple[str, ...]:
    """Return the outputs in `learn.without`, which get no learned model until the law restarts."""
    learn = parameters.learn if isinstance(parameters, RiseDiConfig) else None
    return () if learn is None else learn.without or ()


def without_models(
    start: RiseDiConfig, parameters: RiseDiConfig, outputs: Collection[str]
) -> RiseDiConfig:
    """Return parameters in which some outputs no longer use their learned model.

    The initial law controls these outputs until the law restarts, and their names are added to
    `learn.without`.
    """
    fallen = with_fallback(start, parameters, [name in outputs for name in start.outputs])
    assert start.learn is not None  # noqa: S101 - a controller that learns
    bare_outputs = tuple(
        name for name in start.outputs if name in {*outputs_given_up(parameters), *outputs}
    )
    return fallen.model_copy(
        update={"learn": start.learn.model_copy(update={"without": bare_outputs or None})}
    )


def coupled(parameters: RiseDiConfig, names: Collection[str]) -> list[bool]:
    """Return a mask, (m,), of the outputs that the model couples with the outputs `names`.

    Two outputs are coupled directly, or through other states. The model is the nominal model of the
    feedforward.
    """
    model = parameters.feedforward
    assert model is not None  # noqa: S101 - a learned model flies
    n = len(model.states)
    A, gravity, B = (
        np.reshape(values, (n, -1)) != 0.0
        for values in (model.A, model.gravity or np.zeros(n), model.B)
    )
    links = A | gravity | (B @ B.T) | np.eye(n, dtype=bool)
    is_coupled = np.linalg.matrix_power((links | links.T).astype(float), n) > 0.0
    states = [model.states.index(name) for name in names]
    return [
        bool(np.any(is_coupled[model.states.index(output), states]))
        for output in parameters.outputs
    ]
