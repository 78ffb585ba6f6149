# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Build a rough model of an aircraft that has no airframe file. The model is called a sketch.

A sketch follows from Omega and the trim speed alone. A learner begins with it.
"""

from collections.abc import Sequence

import numpy as np

from aircraft_sim.airframes.airframe import AIRPLANE_STATES, Airframe
from aircraft_sim.atmosphere.disturbance import AIR_STATE, AXES
from aircraft_sim.jsbsim.jsbsim_aircraft import INPUTS
from aircraft_sim.uncertainty import KINEMATIC
from flight_core.parameters import require
from flight_core.units import GRAVITY
from flight_core.vectors import FloatArray
from flight_design.gains.observer_gains import gains_beside_sketch
from flight_design.gains.observer_selection import model_for, with_aircraft_observer
from flight_design.identification.likelihood import Unknown
from rise_di_controller.params import ControllerConfig
from rise_di_controller.rise_di_config import RiseDiConfig

PARTS = (("q",), ("V",), ("p", "r"))  # outputs that couple through B

ROUGH = Unknown(effect=0.1, drift=0.5)
"""What is unknown about a sketch.

The deviation of an entry of B is relative; the noise of the disturbances is in sizes/s per root s.
A sketch leaves out slipstream and the change of the trim with dynamic pressure. On the c172p of
JSBSim in moderate turbulence these are 0.03 to 0.1 rad/s^2 rms over some seconds.
"""


def sketch(
    name: str, Omega: FloatArray, outputs: Sequence[str], inputs: Sequence[str], speed: float
) -> Airframe:
    """Build a rough airframe, a sketch, that has the zeros of a rigid symmetric aircraft.

    The sketch needs only Omega = C B and the trim speed V0, m/s.

        V_dot     = -0.26 n V + Omega_V u                          n = g / V0
        alpha_dot = -11 n alpha + q
        q_dot     = -2.6 |Omega_q| alpha - 20 n q + Omega_q u
        beta_dot  = -0.17 beta + 0.05 p - r + n sin(phi)
        p_dot     = -2.3 |Omega_p| beta - P p + 0.37 P r + Omega_p u,  P = 1.4 sqrt(11 n |Omega_p|)
        r_dot     = 6 |Omega_r| beta - 0.05 P p - R r + Omega_r u,  R = 0.95 sqrt(11 n |Omega_r|)

    In these equations, 11 is the lift slope divided by the lift coefficient, 0.17 is in 1/s, and
    0.05 is the angle of attack in trim, rad. V depends on no other state, because the effects of
    alpha and theta on V hardly show in y beside the wind in the airspeed. The factors are geometric
    means over the twelve aircraft of `benchmarks.jsbsim_gains`, from differences of their
    accelerations in trim. The entries of a single aircraft differ from these means by a factor of
    1.3 to 3. Omega (m, m) has rows `outputs` and columns `inputs`; input i drives output i. Raises
    ParameterError for other outputs than q, V, p, r.
    """
    require(
        sorted(outputs) == ["V", "p", "q", "r"],
        f"airframe {name}",
        f"the outputs {', '.join(outputs)}",
        "q, V, p, r",
    )
    n = GRAVITY / speed
    size = dict(zip(outputs, np.abs(np.diag(Omega)).tolist(), strict=True))
    lift = 11.0 * n
    P = 1.4 * np.sqrt(lift * size["p"])
    R = 0.95 * np.sqrt(lift * size["r"])
    rows = {
        "V": {"V": -0.26 * n},
        "alpha": {"alpha": -lift, "q": 1.0},
        "q": {"alpha": -2.6 * size["q"], "q": -20.0 * n},
        "theta": {"q": 1.0},
        "beta": {"beta": -0.17, "p": 0.05, "r": -1.0},
        "p": {"beta": -2.3 * size["p"], "p": -P, "r": 0.37 * P},
        "r": {"beta": 6.0 * size["r"], "p": -0.05 * P, "r": -R},
        "phi": {"p": 1.0},
    }
    places = list(AIRPLANE_STATES)
    A = np.zeros((len(AIRPLANE_STATES), len(AIRPLANE_STATES)))
    for row, effects in rows.items():
        for column, effect in effects.items():
            A[places.index(row), places.index(column)] = effect
    gravity = np.zeros_like(A)
    B = np.zeros((len(AIRPLANE_STATES), len(inputs)))
    gravity[places.index("beta"), places.index("phi")] = n
    for part in PARTS:
        columns = [outputs.index(output) for output in part]
        for i in columns:
            B[places.index(outputs[i]), columns] = Omega[i, columns]
    return _airframe(
        name, "Omega and trim speed", speed, A, B, gravity, tuple(AIRPLANE_STATES), outputs, inputs
    )


def sketched(name: str, controller: ControllerConfig, speed: float) -> Airframe:
    """Return the airframe of a controller's feedforward, which came from a sketch (a rough model).

    `speed` is the trim speed V0, m/s. The wind acts on the states through the columns V, alpha and
    beta of A. Raises ParameterError if the controller has no feedforward, or if the feedforward has
    other states than a sketch.
    """
    model = controller.feedforward
    require(
        model is not None,
        "controller.feedforward",
        "none",
        "the rough model of an aircraft without an airframe file",
    )
    assert model is not None  # noqa: S101 - for the type checker
    unknown = [state for state in model.states if state not in AIRPLANE_STATES]
    require(
        not unknown,
        "controller.feedforward.states",
        ", ".join(unknown),
        f"some of {', '.join(AIRPLANE_STATES)}",
    )
    n = len(model.states)
    A = np.reshape(model.A, (n, n))
    B = np.reshape(model.B, (n, -1))
    gravity = np.zeros((n, n)) if model.gravity is None else np.reshape(model.gravity, (n, n))
    return _airframe(
        name,
        "the feedforward of a controller",
        speed,
        A,
        B,
        gravity,
        model.states,
        controller.outputs,
        controller.inputs,
    )


def with_sketch(
    start: RiseDiConfig,
    name: str,
    Omega: FloatArray,
    speed: float,
    noise: FloatArray,
    margin: float,
) -> RiseDiConfig:
    """Add feedforward and observer of a sketch (a rough model) to a controller, not yet acting.

    They do not act because `observer.part` is 0. Omega (m, m) and `noise`, (m,), the rms per
    sample, are in the law's order. `margin` is the least delay margin, s. Raises ParameterError as
    `sketch` and `with_aircraft_observer` do.
    """
    rough = sketch(name, Omega, start.outputs, start.inputs, speed)
    model = model_for(rough, start, noise)
    gains = gains_beside_sketch(model, start.outputs, tuple(rough.gusts), speed)
    designed = with_aircraft_observer(
        start, rough, [gains], noise, margin, uncertain=False, keeps_gains=True
    ).controller
    assert designed.observer is not None  # noqa: S101 - it was designed
    observer = designed.observer.model_copy(update={"part": 0.0})
    return start.model_copy(update={"feedforward": designed.feedforward, "observer": observer})


def _positive(name: str) -> str:
    """Say how a positive value of an input moves the aircraft."""
    return INPUTS[name].positive if name in INPUTS else f"more {name}"


def _airframe(
    name: str,
    source: str,
    speed: float,
    A: FloatArray,
    B: FloatArray,
    gravity: FloatArray,
    states: Sequence[str],
    outputs: Sequence[str],
    inputs: Sequence[str],
) -> Airframe:
    """Build an airframe from matrices in SI."""
    gusts = {}
    for axis in AXES:
        state = AIR_STATE[axis]
        if state in states:
            column = A[:, list(states).index(state)] * (speed if state == "V" else 1.0)
            effect = zip(states, (-column).tolist(), strict=True)
            gusts[axis] = {
                row: value for row, value in effect if value != 0.0 and row not in KINEMATIC
            }
    values = {
        "name": name,
        "source": source,
        "speed": speed,
        "states": {state: AIRPLANE_STATES[state] for state in states},
        "inputs": {name: {"unit": "1", "positive": _positive(name)} for name in inputs},
        "outputs": list(outputs),
        "A": A.tolist(),
        "B": B.tolist(),
        "gravity": [
            {"into": states[i], "angle": states[j], "gain": float(gravity[i, j])}
            for i, j in np.argwhere(gravity != 0.0)
        ],
        "gusts": gusts,
        "identities": False,
    }
    return Airframe.validate_mapping(values, f"airframe {name}")
