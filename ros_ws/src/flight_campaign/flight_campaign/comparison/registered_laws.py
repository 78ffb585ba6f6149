# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Prepare registered laws for a comparison with the laws of the catalogue.

A registered law is one that a scenario can fly. It has the gains of a scenario's controller.
"""

from collections.abc import Iterable, Mapping
from dataclasses import replace
from typing import Any

import jax
import numpy as np

from control_laws.catalogue import LAWS, FeedforwardModel, Gains, Law
from control_laws.nominal_model import NominalModel
from flight_analysis.closed_loop.scenario import Scenario
from flight_campaign.batch.campaign_course import build_course
from flight_campaign.comparison.tuning import Benchmark
from flight_core.parameters import ParameterError, require
from flight_core.vectors import FloatArray
from flight_design.gains.tuned_gains import TuningResult
from rise_di_controller import laws
from rise_di_controller.law.law import Sign
from rise_di_controller.params import ControllerConfig
from rise_di_controller.rise_di_config import RiseDiConfig


def own_gains(controller: ControllerConfig) -> dict[str, list[float]]:
    """Return the parameters of the law whose values are all positive, by name.

    Parameters that every controller has, and sections with matrices, are left out.
    """
    names = (
        name for name in type(controller).model_fields if name not in ControllerConfig.model_fields
    )
    values = {name: np.atleast_1d(getattr(controller, name)) for name in names}
    return {
        name: value.tolist()
        for name, value in values.items()
        if value.dtype == np.float64 and (value > 0.0).all()
    }


def registered_law(controller: ControllerConfig, name: str) -> Law:
    """Return the law of a controller, for a search that begins at the controller's gains.

    The search does not change the other parameters of the controller.
    """
    start = own_gains(controller)
    scalars = {key for key in start if not isinstance(getattr(controller, key), tuple)}

    def params(gains: Gains, model: NominalModel) -> Any:
        count = max(gain.shape[-1] for gain in gains.values()) if gains else 1
        wide = {key: np.broadcast_to(gain, (len(gain), count)) for key, gain in gains.items()}
        each = []
        for k in range(count):
            values = {key: _value(gain[:, k], key in scalars) for key, gain in wide.items()}
            controllers = (
                type(controller)
                .validate_mapping(controller.model_dump() | values, name)
                .tuned_law()
            )
            each.append(controllers.params)
        return jax.tree.map(_last, *each)

    return Law(
        title=f"law {controller.law}, gains of the scenario",
        law=controller.law,
        measurements="y",
        model_data="own parameters",
        control_law=lambda model: controller.tuned_law().control_law,
        params=params,
        tuned=tuple(start),
        feedforward=FeedforwardModel.NONE if controller.feedforward is None else name,
        initial={key: np.array(value)[:, None] for key, value in start.items()},
        is_linear=not isinstance(controller, RiseDiConfig)
        or controller.sampled_sign() is Sign.SOFT,
    )


def _value(gain: FloatArray, scalar: bool) -> float | list[float]:
    return float(gain[0]) if scalar else gain.tolist()


def _last(*leaves: Any) -> FloatArray:
    """Stack the values of a parameter of N candidates, with the candidates along the last axis.

    If all values are equal, one of them stands for all, with the shape (m, 1) for a vector (m,).
    """
    first = np.asarray(leaves[0], dtype=np.float64)
    if all(np.array_equal(first, leaf) for leaf in leaves):
        return first if first.ndim != 1 else first[:, None]
    return np.stack([np.asarray(leaf, dtype=np.float64) for leaf in leaves], axis=-1)


def find_laws(
    names: Iterable[str], scenario: Scenario, others: Mapping[str, Scenario]
) -> dict[str, ControllerConfig | None]:
    """Return the controller that flies for each name, or None for a law of the catalogue.

    A name may be a law of the catalogue, the law of the scenario's controller, or a key of
    `others`. Each scenario in `others` stands for the law of its controller. Raises ParameterError
    if a name is unknown, or if a controller has an allocation, another rate or another order of the
    channels.
    """
    effectors = "none: the laws that are compared command the effectors"
    require(scenario.controller.allocation is None, "controller.allocation", "a section", effectors)
    controllers: dict[str, ControllerConfig | None] = {}
    for name in names:
        if name in others:
            controller = others[name].controller
        elif name in LAWS:
            controllers[name] = None
            continue
        elif name == scenario.controller.law:
            controller = scenario.controller
        else:
            if name in laws.names():
                flyable = "the path of a scenario file whose controller flies it"
            else:
                flyable = "a scenario file"
            raise ParameterError(
                f"--laws: found {name!r}, expected laws among {', '.join(LAWS)}, or {flyable}"
            )
        for key in ("outputs", "inputs", "rate"):
            expected = getattr(scenario.controller, key)
            require(
                getattr(controller, key) == expected,
                f"--laws: {name}: {key}",
                getattr(controller, key),
                f"{expected}, as in {scenario.name}",
            )
        # in a benchmark, topics have no delay
        controllers[name] = controller.model_copy(update={"delay": 0.0})
    return controllers


def entries(controllers: Mapping[str, ControllerConfig | None]) -> dict[str, Law]:
    """Return the law for each name, from the catalogue or from a controller."""
    return {
        name: LAWS[name] if controller is None else registered_law(controller, name)
        for name, controller in controllers.items()
    }


def with_courses(
    benchmark: Benchmark, controllers: Mapping[str, ControllerConfig | None]
) -> Benchmark:
    """Add a course to the benchmark for the feedforward of each controller."""
    courses = {wind: dict(by_law) for wind, by_law in benchmark.courses.items()}
    for name, controller in controllers.items():
        if controller is not None and controller.feedforward is not None:
            for wind, scenario in benchmark.scenarios.items():
                courses[wind][name] = build_course(replace(scenario, controller=controller))
    return benchmark._replace(courses=courses)


def as_tuned(controller: ControllerConfig) -> TuningResult:
    """Return the gains of a controller as the result of a search, without a cost."""
    return TuningResult(
        gains=own_gains(controller), cost=float("nan"), seed=0, costs=[], evaluations=0
    )
