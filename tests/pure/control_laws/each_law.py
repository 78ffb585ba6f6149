# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Each control law with a valid section, and what its tests fly."""

from functools import cache
from typing import Any

import jax
import numpy as np
import pytest
from tests.closed_loop import PROTOTYPE_SERVO
from tests.other_laws import COMMON, OWN_LAW, SECTIONS
from tests.pure.flight_analysis.test_replay import BUSY

from aircraft_sim.airframes.airframe import load_airframe
from flight_core.vectors import FloatArray, StampedVector
from flight_design.gains.feedforward_model import with_feedforward
from flight_design.gains.observer_gains import gains_by_rule
from flight_design.gains.observer_selection import model_for, with_aircraft_observer
from rise_di_controller.guard import guard
from rise_di_controller.guard.guard import ControllerState, GuardParams
from rise_di_controller.law.control_law import Measurements, TunedLaw, fields
from rise_di_controller.law.law import gain
from rise_di_controller.laws import AnyLaw
from rise_di_controller.params import ControllerConfig

# as the campaigns set it, also where they are not loaded
jax.config.update("jax_enable_x64", True)  # type: ignore[no-untyped-call]

AIRFRAME = load_airframe("osprey")
SERVO = PROTOTYPE_SERVO.vary(
    flight={"duration": 2.0},
    aircraft={
        "rate": 100.0,
        "step": 0.005,
        "gusts": {"vertical": {"start": 1.0, "speed": 10.12, "length": 15.24}},
    },
    reference_model={"rate": 100.0, "pulses": BUSY},
)
MS, DT = 1_000_000, 0.01  # ns; s, the period of the controller
NOISE = np.array([0.0017, 0.0017, 0.0017, 0.03])  # of osprey_servo


@cache
def sections() -> dict[str, dict[str, Any]]:
    """Return sections of a controller by name.

    A name with "observer" has the observer for osprey_servo by rule, with a margin of 20 ms.
    """
    rise = SERVO.rise_di()
    leading = with_feedforward(rise, AIRFRAME).model_dump()
    gains = gains_by_rule(model_for(AIRFRAME, rise, NOISE), tuple(AIRFRAME.gusts), speed=25.0)
    observed = with_aircraft_observer(rise, AIRFRAME, [gains], NOISE, 0.02).controller.model_dump()
    extended = {key: observed[key] for key in ("feedforward", "observer")}
    pi = SECTIONS["pi"]
    l1 = SECTIONS["l1"]
    return {
        "rise_di": rise.model_dump(),
        "rise_di, implicit": rise.model_dump() | {"sign": "implicit"},
        "pi": pi,
        "l1": l1,
        "l1, feedforward": l1 | {"feedforward": leading["feedforward"]},
        "pid": SECTIONS["pid"],
        "own": SECTIONS.get("own", {}),
        "lqg, observer": COMMON | extended | {"law": "lqg"},
        "rise_di, observer": observed,
        "pi, observer": pi | extended | {"K": gains.K.tolist(), "Lambda": gains.Lambda.tolist()},
    }


NAMES = (
    "rise_di",
    "rise_di, implicit",
    "pi",
    "l1",
    "l1, feedforward",
    "pid",
    *(["own"] if OWN_LAW else []),
)
OBSERVED = ("lqg, observer", "rise_di, observer", "pi, observer")
EVERY_LAW = pytest.mark.parametrize("name", [*NAMES, *OBSERVED])


def controller(name: str, **changes: Any) -> ControllerConfig:
    return (
        AnyLaw.validate_mapping(sections()[name] | changes, "controller")
        if changes
        else valid(name)
    )


@cache
def valid(name: str) -> ControllerConfig:
    return AnyLaw.validate_mapping(sections()[name], "controller")


@cache
def prepared(parameters: ControllerConfig) -> tuple[GuardParams, TunedLaw]:
    return parameters.guard(), parameters.tuned_law()


def at(y: Any, **others: Any) -> Measurements:
    """Return measurements of four channels, in which a field that is not given is 0."""
    zero = np.zeros(4)
    fields = {"y_m": zero, "y_m_dot": zero, "u_trim": zero, "u_before": zero} | others
    return Measurements(y + zero, **{key: value + zero for key, value in fields.items()})


def sample(ms: float, value: Any) -> StampedVector:
    return StampedVector(round(ms * MS), value + np.zeros(4))


def tick(
    parameters: ControllerConfig, state: ControllerState, ms: float, y: Any, y_m: Any = 0.0
) -> ControllerState:
    """Return the state after a tick with fresh y and y_m."""
    return guard.tick(
        state, round(ms * MS), sample(ms, y), [sample(ms, y_m)], *prepared(parameters)
    )[0]


def random_flight(law: TunedLaw, size: float, ticks: int = 20) -> tuple[Any, Measurements]:
    """Return the state of a law after some ticks without limits, and the last measurements."""
    generator = np.random.default_rng(1)
    measurements = at(size * generator.standard_normal(4))
    state = law.control_law.engage(measurements, law.params)
    for _ in range(ticks):
        y, y_m, y_m_dot, u_trim = size * generator.standard_normal((4, 4))
        measurements = Measurements(
            y=y, y_m=y_m, y_m_dot=y_m_dot, u_trim=u_trim, u_before=measurements.u_before
        )
        state, u = law.control_law.step(state, measurements, np.float64(DT), law.params)
        measurements = measurements._replace(u_before=u)
    return state, measurements


def bits(state: Any) -> dict[str, bytes]:
    return {name: np.asarray(value).tobytes() for name, value in fields(state).items()}


def first_change(name: str, parameters: Any, e: FloatArray, u: FloatArray) -> FloatArray:
    """Return the largest change of u in the first tick after an engagement at a constant error.

    It is computed from the gains alone.
    """
    law = name.partition(",")[0]
    if law == "lqg":
        return np.zeros(4)
    scale = np.array(parameters.input_scale)
    # the filter releases -K e; the pole of the adaptation leaves dt / 2 of Omega u unestimated
    if law == "l1":
        decay = 1.0 - np.exp(-np.array(parameters.bandwidth) * DT)
        Omega = np.reshape(parameters.Omega, (4, 4))
        change = np.array(parameters.K) * np.abs(e) + DT / 2.0 * (np.abs(Omega) @ np.abs(u))
        return np.asarray(np.abs(np.linalg.inv(Omega)) @ (decay * change))
    K = (
        gain(np.array(parameters.k_g), np.array(parameters.k_d))
        if law == "rise_di"
        else np.array(parameters.K)
    )
    sign = DT * np.array(parameters.beta) if law == "rise_di" else 0.0
    return np.asarray(scale * (K * np.array(parameters.Lambda) * np.abs(e) * DT + sign))
