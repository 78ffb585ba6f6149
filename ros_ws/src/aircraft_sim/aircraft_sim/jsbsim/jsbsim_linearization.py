# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Linearise an aircraft of JSBSim about its trim: an airframe, and the lags of its inputs.

The derivatives are central differences of the accelerations that JSBSim computes in frozen flight.
There, engines and flight control systems run, but the motion stands still.
"""

import math
from typing import NamedTuple

import jsbsim
import numpy as np

from aircraft_sim.airframes.airframe import AIRPLANE_STATES, Airframe
from aircraft_sim.atmosphere.disturbance import AIR_STATE, AXES
from aircraft_sim.atmosphere.wind_field import body_axes
from aircraft_sim.jsbsim.jsbsim_aircraft import INPUTS, OUTPUTS, FlightCondition, Trim
from aircraft_sim.jsbsim.jsbsim_aircraft import STATES as JSBSIM_STATES
from aircraft_sim.jsbsim.jsbsim_commands import (
    command_paths,
    engine_count,
    frozen,
    residuals,
    settle,
)
from aircraft_sim.jsbsim.jsbsim_trim import WIND, trim_solution, trimmed_fdm
from flight_core.outcome import FlightEnded
from flight_core.rates import seconds
from flight_core.units import FOOT, GRAVITY
from flight_core.vectors import FloatArray

RATES = ("p", "q", "r")
# change of a rate, rad/s, and of wind / V0, in the differences; small compared with the steps in a
# model's tables
MOTION = 0.01
SIZES = (0.05, 0.1, 0.2)
"""Sizes of the steps of a command. Small steps stay in the linear range. Large steps exceed a
hysteresis, or reach a rate limit."""
MAX_STEP_FRACTION = 0.9  # upper bound of a step, as a fraction of the distance to the end stop
SURFACE_TIME = 0.5  # s of frozen flight: long enough for flight control systems
ENGINE_TIME = 20.0  # s of frozen flight: a turbine at altitude spools up in less time
STILL = 1e-6  # m/s^2 or rad/s^2; a step that changes accelerations by less has no effect
LEAST = 1e-6  # an entry below this value is a rounding error, SI


class Linearization(NamedTuple):
    """The linear model of an aircraft of JSBSim: an airframe, and how steps of inputs move it."""

    condition: FlightCondition  # without the rudder if the rudder has no effect
    trim: Trim
    airframe: Airframe
    # (m,) s, lag from each input to its paired output, the longest of all sizes of steps
    lag: FloatArray
    size: FloatArray  # (m,) size of the step with the largest effect, from which B follows
    # (m,) ratio of the smallest to the largest effect per size of a step; 1 for a linear input
    spread: FloatArray
    still: tuple[str, ...]  # sentences on steps without an effect

    @property
    def Omega(self) -> FloatArray:  # noqa: N802 - the paper's name
        """Omega = C B, (m, m): y_dot per unit of each command."""
        return np.asarray(self.airframe.matrix_c() @ self.airframe.matrix_b())

    def travel(self) -> FloatArray:
        """Return the distance of each input to its nearer end stop, (m,)."""
        return np.minimum(-self.trim.lower, self.trim.upper)[: len(self.lag)]

    def authority(self) -> FloatArray:
        """Compute the y_dot that each input gives its output at its nearer stop, (m,), SI."""
        return np.abs(np.diag(self.Omega)) * self.travel()


def linearize(condition: FlightCondition) -> Linearization:
    """Linearise an aircraft about the trim of a flight condition.

        x = (V, alpha, q, theta, beta, p, r, phi),  x_dot = A x + gravity sin(x) + B u + wind w
        x_dot of V, alpha, beta: the accelerations in the axes of the flight path,
            (cos a u_dot + sin a w_dot,  (cos a w_dot - sin a u_dot) / V,  v_dot / V),  a = alpha
        columns of V, alpha, beta = -(1, V, V) wind, because air forces depend on the motion
            relative to the air
        theta_dot = q,  phi_dot = p + tan(theta) r,  gravity: V_dot -= g sin(theta),
            beta_dot += g cos(theta) / V sin(phi),  for the small bank of a trim
        B_j = x_dot(t_end) / size,  lag_j = step + integral of 1 - x_dot(t) / x_dot(t_end)

    u has the normalised commands as deviations from trim, and w is the wind along AXES in m/s. Each
    lag belongs to the output that the input drives. The integration step of JSBSim is part of the
    lag, because a command acts one step later. Attitude acts only through gravity, and altitude has
    no effect. Raises FlightEnded if there is no trim, or if an input does not move its output.
    """
    solution = trim_solution(condition)
    _, trim = trimmed_fdm(condition, solution)
    steps = [_steps(condition, trim, name) for name in condition.inputs()]
    if steps[-1] is None and condition.inputs()[-1] == "rudder":
        steps = steps[:-1]
        condition = condition._replace(named=(*condition.named, ("rudder", ())))
    for name, step in zip(condition.inputs(), steps, strict=True):
        if step is None:
            raise FlightEnded(
                f"{condition.title}: {driven(name)} does not respond to {name} within "
                f"{_duration(name):g} s, by steps of {SIZES[0]:g} to {SIZES[-1]:g}"
            )
    present_steps = [step for step in steps if step is not None]
    B = np.column_stack([step.effect for step in present_steps])
    return Linearization(
        condition=condition,
        trim=trim,
        airframe=_airframe(condition, trim, B),
        lag=np.array([step.lag for step in present_steps]),
        size=np.array([step.size for step in present_steps]),
        spread=np.array([step.spread for step in present_steps]),
        still=tuple(sentence for step in present_steps for sentence in step.still),
    )


def driven(name: str) -> str:
    """Return the name of the output that an input drives."""
    return list(OUTPUTS)[list(INPUTS).index(name)]


def _duration(name: str) -> float:
    return ENGINE_TIME if INPUTS[name].is_per_engine else SURFACE_TIME


class _InputSteps(NamedTuple):
    """The response of the aircraft to steps of an input."""

    effect: FloatArray  # (n,) column of B
    lag: float
    size: float
    spread: float
    still: tuple[str, ...]


def _steps(condition: FlightCondition, trim: Trim, name: str) -> _InputSteps | None:
    """Return the response to steps of an input in both directions, or None if no output moves."""
    output = driven(name)
    place = list(INPUTS).index(name)
    travel = MAX_STEP_FRACTION * float(min(-trim.lower[place], trim.upper[place]))
    row = list(AIRPLANE_STATES).index(output)
    responses = {}
    still = []
    for size in sorted({min(size, travel) for size in SIZES}):
        ends = [_response(condition, trim, name, sign * size) for sign in (1.0, -1.0)]
        response = (ends[0] - ends[1]) / (2.0 * size)
        if abs(response[-1, row]) > STILL:
            responses[size] = response
        else:
            still.append(f"{name} by {size:.3g}: {output} does not move")
    if not responses:
        return None
    effects = {size: abs(float(response[-1, row])) for size, response in responses.items()}
    size = max(effects, key=lambda key: effects[key])
    period = seconds(condition.step_ns)
    lags = [
        period * (1.0 + float(np.sum(1.0 - response[:, row] / response[-1, row])))
        for response in responses.values()
    ]
    return _InputSteps(
        effect=responses[size][-1],
        lag=max(*lags, 0.0),
        size=size,
        spread=min(effects.values()) / effects[size],
        still=tuple(still),
    )


def _response(condition: FlightCondition, trim: Trim, name: str, size: float) -> FloatArray:
    """Return x_dot at each integration step of frozen flight after a step input, (N, n)."""
    fdm, _ = trimmed_fdm(condition, trim_solution(condition))
    for path, at_one in command_paths(condition.commands()[name], engine_count(fdm)):
        fdm[path] += at_one * size
    count = round(_duration(name) / fdm.get_delta_t())
    rows = np.zeros((count, len(AIRPLANE_STATES)))
    with frozen(fdm):
        for row in rows:
            fdm.run()
            row[:] = _x_dot(fdm, condition, trim)
    return rows


def _x_dot(fdm: jsbsim.FGFDMExec, condition: FlightCondition, trim: Trim) -> FloatArray:
    """Compute x_dot, (n,), from the accelerations in frozen flight.

    The derivatives of the attitude angles are 0.
    """
    u_dot, v_dot, w_dot, p_dot, q_dot, r_dot = residuals(fdm)
    alpha = _trim_state(trim, "alpha")
    along = math.cos(alpha) * u_dot + math.sin(alpha) * w_dot
    across = math.cos(alpha) * w_dot - math.sin(alpha) * u_dot
    V = condition.speed
    return np.array([along, across / V, q_dot, 0.0, v_dot / V, p_dot, r_dot, 0.0])


def _trim_state(trim: Trim, name: str) -> float:
    return float(trim.states[list(JSBSIM_STATES).index(name)])


def _derivative(condition: FlightCondition, trim: Trim, name: str) -> FloatArray:
    """Compute the change of x_dot by 1 rad/s of a rate, or by 1 m/s of wind, shape (n,)."""
    ends = []
    for sign in (1.0, -1.0):
        fdm, _ = trimmed_fdm(condition, trim_solution(condition))
        if name in RATES:
            _set_rate(fdm, trim, name, sign * MOTION)
        else:
            axes = body_axes(_trim_state(trim, "phi"), 0.0, 0.0)
            wind = sign * MOTION * condition.speed * axes[AXES.index(name)]
            for path, value in zip(WIND, (wind / FOOT).tolist(), strict=True):
                fdm[path] = value
        settle(fdm, SURFACE_TIME)
        ends.append(_x_dot(fdm, condition, trim))
    size = MOTION if name in RATES else MOTION * condition.speed
    return np.asarray((ends[0] - ends[1]) / (2.0 * size))


def _set_rate(fdm: jsbsim.FGFDMExec, trim: Trim, name: str, value: float) -> None:
    """Set a body rate of an aircraft in trim, rad/s; engines and systems keep their state."""
    for key in ("alpha", "phi"):
        fdm[f"ic/{key}-rad"] = _trim_state(trim, key)
    fdm["ic/gamma-deg"] = fdm["ic/beta-rad"] = 0.0
    fdm[f"ic/{name}-rad_sec"] = value
    fdm.run_ic()


def _airframe(condition: FlightCondition, trim: Trim, B: FloatArray) -> Airframe:
    """Build the airframe about a trim. `B` has a column for each input, (n, m)."""
    places = {name: i for i, name in enumerate(AIRPLANE_STATES)}
    V = condition.speed
    wind = np.column_stack([_derivative(condition, trim, axis) for axis in AXES])
    A = np.zeros((len(AIRPLANE_STATES), len(AIRPLANE_STATES)))
    for axis, size, column in zip(AXES, (1.0, V, V), wind.T, strict=True):
        A[:, places[AIR_STATE[axis]]] = -size * column
    for name in RATES:
        A[:, places[name]] = _derivative(condition, trim, name)
    theta = _trim_state(trim, "theta")
    for into, by, gain in (("theta", "q", 1.0), ("phi", "p", 1.0), ("phi", "r", math.tan(theta))):
        A[places[into], places[by]] = gain
    gusts = {
        axis: {
            name: V * value
            for name, value in zip(AIRPLANE_STATES, column.tolist(), strict=True)
            if abs(value) > LEAST
        }
        for axis, column in zip(AXES, wind.T, strict=True)
    }
    values = {
        "name": condition.title,
        "source": f"linearisation of JSBSim at {V:g} m/s and {condition.altitude:g} m",
        "speed": V,
        "states": AIRPLANE_STATES,
        "inputs": {
            name: {"unit": "1", "positive": INPUTS[name].positive} for name in condition.inputs()
        },
        "outputs": list(condition.paired_outputs()),
        "A": _without_rounding(A).tolist(),
        "B": _without_rounding(B).tolist(),
        "gravity": [
            {"into": "V", "angle": "theta", "gain": -GRAVITY},
            {"into": "beta", "angle": "phi", "gain": GRAVITY * math.cos(theta) / V},
        ],
        "gusts": gusts,
    }
    return Airframe.validate_mapping(values, f"airframe {condition.title}")


def _without_rounding(matrix: FloatArray) -> FloatArray:
    return np.where(np.abs(matrix) < LEAST, 0.0, matrix)
