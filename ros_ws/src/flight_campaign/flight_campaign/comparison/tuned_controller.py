# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Convert gains that were tuned in a comparison to the controller of a scenario.

The controller has the registered law with the same equations.
"""

from typing import Any

import numpy as np

from control_laws.catalogue import LAWS, FeedforwardModel
from control_laws.observed import PART, aircraft_design, extended_state_design
from control_laws.observer_design import Names
from flight_campaign.comparison.tuning import Benchmark, as_gains
from flight_core.parameters import require
from flight_core.vectors import FloatArray
from flight_design.gains.extended_state import integrator_model
from flight_design.gains.feedforward_model import with_feedforward
from flight_design.gains.gain_conditions import MIN_K, split_gain
from flight_design.gains.tuned_gains import TuningResult
from rise_di_controller.extensions.model_sections import FeedforwardConfig, ObserverConfig
from rise_di_controller.law.law import MIN_GAIN
from rise_di_controller.laws import AnyLaw
from rise_di_controller.params import ControllerConfig

FROM_Y = ("rise_di", "pi", "l1", "lqg")
REGISTERED = {name: law.law for name, law in LAWS.items() if law.law in FROM_Y}
"""The registered law for a law of the catalogue, if it measures nothing but y and a scenario can
fly it."""

RISE_DI_GAINS = ("K", "Lambda", "beta", "softening", "omega")
DESIGNS = {
    "rise_observer": aircraft_design,
    "pi_observer": aircraft_design,
    "lqg": aircraft_design,
    "eso": extended_state_design,
}


def require_registered(name: str) -> None:
    """Check that a scenario can fly a law. Raises ParameterError if none can."""
    require(name in REGISTERED, "--write", f"the law {name}", f"one of {', '.join(REGISTERED)}")


def tuned_controller(name: str, result: TuningResult, benchmark: Benchmark) -> ControllerConfig:
    """Return the controller that flies like a law of the catalogue with tuned gains.

    As in the benchmark, its inputs are scaled by 1 / abs(Omega_ii), and topics have no delay.
    Raises ParameterError if no scenario can fly the law.
    """
    require_registered(name)
    model = benchmark.model
    base = benchmark.scenario.controller
    shared = set(ControllerConfig.model_fields) - {"law", "feedforward", "observer"}
    values = {
        key: value for key, value in base.model_dump(exclude_none=True).items() if key in shared
    }
    values |= {
        "law": REGISTERED[name],
        "input_scale": model.input_scale.tolist(),
        "D": [int(sign) for sign in model.D],
    }
    feedforward = _feedforward(name, benchmark)
    if feedforward is not None:
        values["feedforward"] = feedforward.model_dump(exclude_none=True)
    if name in DESIGNS:
        values["observer"] = _observer(name, result, benchmark).model_dump()
    gains = as_gains(result)
    if REGISTERED[name] == "rise_di":
        law_gains = {
            key: np.broadcast_to(gains[key][:, 0], model.lag.shape)
            for key in RISE_DI_GAINS
            if key in gains
        }
        values |= _rise_di(law_gains, model.input_scale)
    elif REGISTERED[name] != "lqg":
        values |= {
            key: result.gains[key] for key in ("K", "Lambda", "bandwidth") if key in result.gains
        }
    if REGISTERED[name] == "l1":
        values["Omega"] = model.Omega.ravel().tolist()
    return AnyLaw.validate_mapping(values, "controller")


def _rise_di(gains: dict[str, FloatArray], input_scale: FloatArray) -> dict[str, Any]:
    """Return the parameters of RISE-DI.

    If (22) does not allow a K, it is replaced by a larger K with a smaller input scale, which gives
    the same loop.
    """
    K = gains["K"]
    least = max(MIN_K, float(K[-1]))
    K_permitted = np.maximum(K, least + np.append(np.full(len(K) - 1, MIN_GAIN), 0.0))
    share = K / K_permitted
    k_g, k_d = split_gain(K_permitted)
    return {
        "k_g": k_g,
        "k_d": k_d.tolist(),
        "Lambda": gains["Lambda"].tolist(),
        "beta": (gains["beta"] / share).tolist(),
        "omega": (gains["omega"] * share if "omega" in gains else share).tolist(),
        "input_scale": (input_scale * share).tolist(),
        "softening": gains["softening"].tolist() if "softening" in gains else 1.0,
        "sign": "soft" if "softening" in gains else "implicit",
    }


def _feedforward(name: str, benchmark: Benchmark) -> FeedforwardConfig | None:
    """Return the model of a law's feedforward, or None for a law without one."""
    controller = benchmark.scenario.controller
    if LAWS[name].feedforward is FeedforwardModel.AIRCRAFT:
        return with_feedforward(controller, benchmark.scenario.aircraft.load()[0]).feedforward
    if LAWS[name].feedforward is FeedforwardModel.INTEGRATORS:
        return integrator_model(controller, benchmark.model.Omega)
    return None


def _observer(name: str, result: TuningResult, benchmark: Benchmark) -> ObserverConfig:
    """Return the observer of a law, with its bound on u_o.

    The search has already met the delay margin, so the controller need not require one.
    """
    controller = benchmark.scenario.controller
    airframe = benchmark.scenario.aircraft.load()[0]
    integrators = LAWS[name].feedforward is FeedforwardModel.INTEGRATORS
    states, axes = (
        (controller.outputs, ()) if integrators else (tuple(airframe.states), tuple(airframe.gusts))
    )
    design = DESIGNS[name](
        as_gains(result),
        benchmark.model,
        Names(states, controller.inputs, controller.outputs, axes),
    )
    matrices = {
        key: np.asarray(getattr(design, key)).ravel().tolist() for key in ("Phi", "Gamma", "L", "F")
    }
    part = 1.0 if name == "lqg" else PART
    return ObserverConfig.validate_mapping(
        matrices | {"rate": controller.rate, "states": design.states, "part": part, "margin": 0.0},
        "observer",
    )
