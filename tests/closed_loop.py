# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Provide what the tests of the closed loop build.

This is parameters of the law, reference outputs, and flights without a scenario.
"""

import math
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from aircraft_sim.atmosphere.disturbance import Gusts
from aircraft_sim.plant import dynamics, plant
from aircraft_sim.plant.actuators import Actuators
from aircraft_sim.plant.dynamics import Aircraft
from aircraft_sim.plant.plant import AircraftState, PlantParams
from flight_analysis.closed_loop.scenario import Scenario, scenario_yaml
from flight_analysis.closed_loop.scenario_library import find_scenario
from flight_analysis.metrics.errors import true_error
from flight_core.rates import nanoseconds
from flight_core.tape import Signal, Tape
from flight_core.vectors import FloatArray
from reference_model import model
from reference_model.command import Profile, command
from rise_di_controller.law import law as rise
from rise_di_controller.law.law import LawParams, Sign

PROTOTYPE_GAINS = {
    "k_g": 1.0,
    "k_d": [16.0, 16.0, 7.0],
    "Lambda": [5.0, 5.0, 3.0, 0.5],
    "softening": 2.75,
}
"""Gains of the prototype of the law, 32 deg of phase margin in r, 26 in V. Tests and pages quote
its figures."""

PROTOTYPE_SERVO = find_scenario("osprey_servo").vary(controller=PROTOTYPE_GAINS)

CALM_SERVO = PROTOTYPE_SERVO.vary(
    aircraft={"sensors": {}, "gusts": {}, "rate": 100.0, "step": 0.005},
    reference_model={"rate": 100.0},
)
"""Scenario osprey_servo with these gains in calm air, without noise, at 100 Hz and in steps of 5
ms."""


def calm_osprey(
    duration: float, wind: tuple[float, float] = (0.0, 0.0), **guidance: Any
) -> Scenario:
    """Return the osprey of osprey_route in a steady wind without noise.

    Its steps are larger than the scenario's, and a section of guidance replaces the route.
    """
    return find_scenario("osprey_route").vary(
        flight={"duration": duration},
        aircraft={
            "rate": 100.0,
            "step": 0.005,
            "wind": [*wind],
            "turbulence": None,
            "sensors": {},
        },
        reference_model={"rate": 100.0},
        guidance={"route": None, "wind": math.hypot(*wind)} | guidance,
    )


def in_calm_air(path: Path, **guidance: object) -> Path:
    """Write a file of the osprey in calm air, without a route."""
    varied = find_scenario("osprey_route").vary(
        aircraft={"wind": [0.0, 0.0], "turbulence": None}, guidance={"route": None} | guidance
    )
    path.write_text(scenario_yaml(varied))
    return path


def law_params(
    K: Any, Lambda: Any, beta: Any, D: Any = 1.0, sign: Sign = Sign.IMPLICIT, **others: Any
) -> LawParams:
    """Return parameters of the law.

    A number applies to each channel. By default input_scale, omega and eps are 1.
    """
    values = {"K": np.atleast_1d(K), "Lambda": Lambda, "beta": beta, "D": D}
    values |= {"input_scale": 1.0, "omega": 1.0, "eps": 1.0} | others
    arrays = np.broadcast_arrays(
        *(np.asarray(value, dtype=np.float64) for value in values.values())
    )
    return LawParams(
        **dict(zip(values, (array.copy() for array in arrays), strict=True)), sign=sign
    )


def still_air(A: FloatArray, B: FloatArray, C: FloatArray, gravity: FloatArray) -> Aircraft:
    """Return an aircraft without gusts."""
    empty = np.zeros(0)
    return Aircraft(
        A=A,
        B=B,
        C=C,
        gravity=gravity,
        gust_direction=np.zeros((len(A), 0)),
        gusts=Gusts(empty, empty, empty),
        speed=np.array(1.0),
    )


def reference_outputs(
    params: model.ReferenceMatrices, profile: Profile, dt: float, steps: int
) -> FloatArray:
    """Return y_m at 0, dt, 2 dt, ..., (steps + 1, m), from rest."""
    x_m = np.zeros(len(params.A_m))
    matrices = model.stepper(dt, params)
    y_m = [model.output(x_m, params)]
    for k in range(steps):
        x_m = model.step(
            x_m, command((k + np.array([0.0, 0.5, 1.0])) * dt, profile).ravel(), matrices
        )
        y_m.append(model.output(x_m, params))
    return np.array(y_m)


def fly(
    aircraft: Aircraft,
    law: LawParams,
    y_m: Iterable[FloatArray],
    dt: float,
    bound: float,
    x_0: FloatArray | None = None,
) -> FloatArray:
    """Return the errors e at 0, dt, 2 dt, ..., (ticks, m).

    An error above the bound ends the flight. The law acts on the aircraft through ideal actuators.
    The flight starts from x_0, or from trim.
    """
    period_ns = nanoseconds(dt)
    m = len(law.K)
    references = iter(y_m)
    ideal = Actuators(np.zeros(m), np.full(m, -np.inf), np.full(m, np.inf), np.full(m, np.inf))
    hardware = PlantParams(aircraft, ideal, period_ns)
    u = np.zeros(m)
    simulated = AircraftState(np.zeros(len(aircraft.A)) if x_0 is None else x_0, u)
    state = rise.engage(dynamics.y(simulated.x, aircraft), next(references))
    errors = [state.e]
    for k, reference in enumerate(references):
        simulated = plant.advance(k * period_ns, simulated, u, period_ns, hardware)
        state, u = rise.step(state, dynamics.y(simulated.x, aircraft), reference, np.array(dt), law)
        errors.append(state.e)
        if np.abs(state.e).max() > bound:
            break
    return np.array(errors)


def error(tape: Tape) -> Signal:
    """Return the true error of a simulated flight."""
    signal = true_error(tape)
    assert signal is not None
    return signal
