# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Build the course that all aircraft of a campaign fly, tick by tick.

The course has the reference, the wind, the errors of the sensors and the feedforward. It does not
depend on the aircraft, so it is computed only once, by the functions of the simulation in one
process.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from aircraft_sim import sensors
from aircraft_sim.airframes.airframe import Airframe
from aircraft_sim.atmosphere import turbulence
from aircraft_sim.atmosphere.disturbance import AIR_STATE
from aircraft_sim.plant import plant as plant_model
from aircraft_sim.plant.plant import PlantParams
from aircraft_sim.sensors import Sensors
from flight_analysis.closed_loop.scenario import Scenario
from flight_core.known_keys import keys_of, require_known
from flight_core.parameters import require
from flight_core.rates import divide, nanoseconds, period_ns, seconds
from flight_core.vectors import FloatArray
from reference_model.reference import Reference
from rise_di_controller.extensions import feedforward
from rise_di_controller.extensions.feedforward import Nominal
from rise_di_controller.params import ControllerConfig
from rise_di_controller.rise_di_config import RiseDiConfig

HOLD, ENGAGE, STEP = range(3)
"""What a controller does at a tick: it holds u because there is no new y, it engages, or it takes a
step of its law."""


class Segments(NamedTuple):
    """The parts of a course that change from tick to tick."""

    t: FloatArray  # (T,) s
    phase: NDArray[np.int32]  # (T,) HOLD, ENGAGE or STEP
    dt: FloatArray  # (T,) s since the previous sample, limited to the controller's range
    y_m: FloatArray  # (T, m) the reference at the tick
    sampled_y_m: FloatArray  # (T, m) reference at the stamp of the tick's y, and its derivative
    sampled_y_m_dot: FloatArray  # (T, m)
    u_ff: FloatArray  # (T, m) feedforward
    error: FloatArray  # (T, m) error of the sensors in the tick's y
    noise: FloatArray  # (T, m) noise, which is a part of this error
    # (T, K r) mean forcing over each of the K steps until the next tick: first the g winds along
    # `axes`, then the other forcing along the directions `basis`
    forcing: FloatArray
    forcing_now: FloatArray  # (T, r) forcing at the tick
    air: FloatArray  # (T, n) contribution of the wind to alpha and beta, rad
    vane_m: FloatArray  # (T, k) angles that the vanes would measure in the reference motion, rad
    vane_error: FloatArray  # (T, k) sensor error of the vanes, rad


class Course(NamedTuple):
    """The course of T ticks of the controller; the last tick is at the end of the flight.

    Channels are in the law's order, and states in the airframe's order.
    """

    segments: Segments
    # (g,) indices of those axes of the airframe's gusts along which there is wind
    axes: NDArray[np.int64]
    # (n, r - g) orthonormal directions in x_dot of biases and sines, which are the part of f_time
    # without wind
    basis: FloatArray
    order: NDArray[np.int64]  # (m,) indices of the law's outputs in y
    late: int  # delay of y, ticks
    u_late: int  # delay of u, ticks
    period: float  # s, time between two ticks
    steps: int  # steps of the integration between two ticks


FLOWN = frozenset(
    {
        *("airframe", "rate", "step", "inertial_coupling", "kinematics"),
        *(f"gusts.*.{key}" for key in ("start", "speed", "length", "every")),
        *(f"turbulence.{key}" for key in ("altitude", "wind", "sigma", "rotary", "seed")),
        *(f"bias.*.{key}" for key in ("start", "value", "rise")),
        *(f"sines.*.{key}" for key in ("amplitude", "frequency", "phase")),
        *(f"drift.{key}" for key in ("start", "duration", "A", "B", "seed", "number")),
        *(f"actuators.{key}" for key in ("lag", "lower", "upper", "rate", "dead_zone", "faults")),
        "actuators.delay",
        *(f"sensors.{key}" for key in ("bias", "drift", "noise", "quantisation", "delay")),
        *(f"sensors.{key}" for key in ("dropout", "seed")),
        *(f"vanes.{key}" for key in ("channels", "frozen_at", "dropout")),
        *(f"uncertainty.{key}" for key in ("entries", "parts", "distribution", "wind")),
    }
)
"""Keys of the aircraft that a campaign flies as the simulator does. `build_course` refuses some of
their values."""

IDLE = frozenset(
    {
        # Every aircraft of a campaign has a separate draw.
        *(f"uncertainty.{key}" for key in ("A", "B", "seed", "number")),
        # The place has no effect on a law, a command or a figure. Guided aircraft, for which it
        # matters, fly one by one.
        *(f"start.{key}" for key in ("north", "east", "heading")),
        "wind",
        *(f"pose.{key}" for key in ("rate", "delay", "bias", "drift", "noise", "seed")),
        # Every tick has a u, so no u times out.
        *("max_age", "hold", "ramp"),
        # These keys say how the node runs.
        *("start_time", "lockstep", "control_rate", "duration", "recorded"),
    }
)
"""Keys of the aircraft that have no effect in a campaign."""

FLOWN_CONTROLLER = frozenset(
    {
        *("rate", "law", "outputs", "inputs", "D", "input_scale", "lag", "delay"),
        *("lower", "upper", "slew"),
        *(f"allocation.{key}" for key in ("effectors", "T", "effect", "lower", "upper", "slew")),
        "allocation.priority",
        *(f"feedforward.{key}" for key in ("states", "A", "B", "gravity", "lead", "inputs")),
        *(f"observer.{key}" for key in ("rate", "states", "Phi", "Gamma", "L", "F", "part")),
        *(f"observer.{key}" for key in ("within", "fade", "margin")),
        *(f"observer.vanes.{key}" for key in ("channels", "H", "L", "least", "time")),
    }
)
"""Keys of a controller under any law that a campaign flies."""

FLOWN_RISE_DI = frozenset(
    {"k_g", "k_d", "Lambda", "beta", "omega", "sign", "softening", "schedule.speed"}
    | {"schedule.time"}
)
"""Keys of RISE-DI that a campaign flies. The keys of any other law go to its step unread."""

IDLE_CONTROLLER = frozenset(
    {
        # `build_course` ensures that y is never older than max_age, so the law stays active.
        *("max_age", "hold", "ramp", "on_deactivate"),
        # These keys say how the node runs.
        *("lockstep", "y_rate"),
        # Only a learner uses the deviations of the model.
        "feedforward.deviation",
    }
)
"""Keys of a controller that have no effect in a campaign."""


ONE_AT_A_TIME = "flights of many at once do not have it, flights of rise-di fly do"


def require_flyable(scenario: Scenario) -> None:
    """Check that a campaign can fly an aircraft or a controller. Raises ParameterError if not.

    A campaign supports the keys of FLOWN and FLOWN_CONTROLLER. If any other key has a value with an
    effect, the error names this key.
    """
    aircraft = scenario.aircraft
    controller = scenario.controller
    require(
        not aircraft.is_jsbsim,
        "airframe",
        aircraft.airframe,
        "an airframe with matrices: JSBSim flies one at a time",
    )
    require_known(aircraft, FLOWN | IDLE, "aircraft", ONE_AT_A_TIME)
    expected = "linear or euler: a campaign flies no multicopter"
    flies = aircraft.kinematics in {"linear", "euler"}
    require(flies, "aircraft.kinematics", aircraft.kinematics, expected)
    if isinstance(controller, RiseDiConfig):
        of_law = FLOWN_RISE_DI
    else:
        of_law = keys_of(type(controller)) - keys_of(ControllerConfig)
    require_known(
        controller,
        FLOWN_CONTROLLER | of_law | IDLE_CONTROLLER,
        "controller",
        ONE_AT_A_TIME,
    )


def _references(scenario: Scenario, ticks: int, tick_ns: int) -> tuple[FloatArray, FloatArray]:
    """Return y_m and its derivative at the ticks, in the law's order, (T, m) each."""
    reference = Reference(scenario.reference_model)
    places = [scenario.reference_model.outputs.index(name) for name in scenario.controller.outputs]
    y_m = np.zeros((ticks, len(places)))
    y_m_dot = np.zeros_like(y_m)
    for k in range(ticks):
        y_m[k] = reference.sample(k * tick_ns // reference.period_ns)[places]
        y_m_dot[k] = reference.rate()[places]
    return y_m, y_m_dot


def build_course(scenario: Scenario) -> Course:
    """Build the course of a scenario, with the feedforward of the controller.

    Raises ParameterError if a campaign cannot fly the scenario because of

    - an aircraft of JSBSim,
    - a delay of y or u that is not a whole number of ticks,
    - dropouts of a y whose rate is not that of the ticks,
    - dropouts longer than the age limit, or
    - vanes with faults.
    """
    aircraft = scenario.aircraft
    controller = scenario.controller
    require_flyable(scenario)
    airframe = aircraft.load()[0]
    plant = aircraft.plant()
    tick_ns = period_ns(controller.rate, "controller.rate")
    sample_ns = period_ns(aircraft.rate, "aircraft.rate")
    ticks = nanoseconds(scenario.flight.duration) // tick_ns + 1
    steps = divide(tick_ns, plant.step_ns, "step", "a tick")
    outputs = list(aircraft.channels().outputs)
    order = np.array([outputs.index(name) for name in controller.outputs])

    errors = aircraft.sensor_arrays()
    late = _whole_ticks(errors.delay_ns, tick_ns, "sensors.delay")
    _require_lossless(scenario, errors)
    u_late = _whole_ticks(nanoseconds(aircraft.actuators.delay), tick_ns, "actuators.delay")
    vanes = [outputs.index(name) for name in controller.vanes]
    _require_plain_vanes(scenario, late)
    # Compute tick by tick all that does not depend on the aircraft.
    error, noise = _sensor_errors(errors, ticks, tick_ns // sample_ns, len(outputs))
    y_m, y_m_dot = _references(scenario, ticks, tick_ns)
    arrives = [sensors.has_arrived(k, errors) for k in range(ticks)]
    phase, dt = _phases(ticks, late, seconds(tick_ns), scenario.controller.max_age, arrives)
    delayed_ticks = np.maximum(np.arange(ticks) - late, 0)
    wind, forcing = _forcing(ticks, steps, plant)
    axes, basis, (over_step, now) = _reduced(wind, forcing)
    guard = controller.guard()
    u_ff, x_m = _feedforward(guard.nominal, phase, dt, y_m[delayed_ticks], seconds(tick_ns))
    segments = Segments(
        t=np.arange(ticks) * np.float64(seconds(tick_ns)),
        phase=phase,
        dt=dt,
        y_m=y_m,
        sampled_y_m=y_m[delayed_ticks],
        sampled_y_m_dot=y_m_dot[delayed_ticks],
        u_ff=u_ff,
        error=error[:, order],
        noise=noise[:, order],
        forcing=over_step.reshape(ticks, -1),
        forcing_now=now,
        air=_air_angles(wind.at_tick, airframe),
        vane_m=x_m[:, guard.vanes],
        vane_error=error[:, vanes],
    )
    return Course(
        segments=segments,
        axes=axes,
        basis=basis,
        order=order,
        late=late,
        u_late=u_late,
        period=seconds(tick_ns),
        steps=steps,
    )


def _whole_ticks(delay_ns: int, tick_ns: int, key: str) -> int:
    """Convert a delay to ticks. Raises ParameterError if it is not a whole number of ticks."""
    return divide(delay_ns, tick_ns, key, "a tick") if delay_ns else 0


def _require_lossless(scenario: Scenario, errors: sensors.Sensors) -> None:
    """Check that no y is lost if y has another rate than the ticks.

    Raises ParameterError if y has dropouts.
    """
    y_rate = scenario.aircraft.rate
    rate = scenario.controller.rate
    has_same_rate = period_ns(rate, "controller.rate") == period_ns(y_rate, "aircraft.rate")
    require(
        errors.dropout == 0.0 or has_same_rate,
        "aircraft.rate",
        f"{y_rate:g} Hz",
        f"controller.rate ({rate:g} Hz) with dropouts",
    )


def _phases(
    ticks: int, late: int, period: float, max_age: float, arrives: list[bool]
) -> tuple[NDArray[np.int32], FloatArray]:
    phase = np.full(ticks, HOLD, dtype=np.int32)
    dt = np.zeros(ticks)
    last: int | None = None
    for k in range(late, ticks):
        if not arrives[k - late]:
            continue
        if last is None:
            phase[k] = ENGAGE
        else:
            gap = (k - last + late) * period
            require(gap <= max_age, "sensors.dropout", f"{gap:g} s without y", "less than max_age")
            phase[k] = STEP
            dt[k] = (k - last) * period
        last = k
    return phase, dt


def _require_plain_vanes(scenario: Scenario, late: int) -> None:
    """Check that vanes have no delay, icing, lost readings or quantisation.

    Raises ParameterError if they have.
    """
    vanes = scenario.aircraft.vanes
    sensors_of = scenario.aircraft.sensors
    key = "aircraft.vanes"
    if scenario.controller.vanes:
        require(
            not late,
            "sensors.delay",
            f"{sensors_of.delay:g} s beside vanes",
            "0: a campaign has no late vanes",
        )
        plain = (
            vanes.dropout == 0.0
            and not np.isfinite(vanes.frozen_at).any()
            and not any(sensors_of.quantisation)
        )
        require(
            plain,
            key,
            "a vane that freezes, loses readings or has steps",
            "none: rise-di fly --in-process has these",
        )


def _feedforward(
    nominal: Nominal | None,
    phase: NDArray[np.int32],
    dt: FloatArray,
    y_m: FloatArray,
    period: float,
) -> tuple[FloatArray, FloatArray]:
    """Return u_ff at the ticks, (T, m), and the state of the nominal model, (T, n).

    If there is no nominal model, n is 0.
    """
    u_ff = np.zeros_like(y_m)
    if nominal is None:
        return u_ff, np.zeros((len(y_m), 0))
    x_m = np.zeros((len(y_m), len(nominal.A)))
    state = feedforward.initial_state(y_m[0], nominal)
    for k, action in enumerate(phase):
        if action == ENGAGE:
            state = feedforward.initial_state(y_m[k], nominal)
        elif action == STEP:
            parts = feedforward.step_count(round(dt[k] / period), 1)
            state, u_ff[k] = feedforward.step(state, y_m[k], dt[k], nominal, parts)
        elif k:
            u_ff[k] = u_ff[k - 1]
        x_m[k] = state.x
    return u_ff, x_m


def _sensor_errors(
    errors: Sensors, ticks: int, samples: int, channels: int
) -> tuple[FloatArray, FloatArray]:
    """Return the errors of y at the ticks, and the noise in them, (T, channels) each."""
    error = np.zeros((ticks, channels))
    noise = np.zeros_like(error)
    drift = sensors.initial_drift(errors)
    bias = 0.0 if errors.bias is None else errors.bias
    for k in range(ticks):
        error[k], drift = sensors.error(k * samples, drift, errors)
        noise[k] = error[k] - bias - drift.value
    return error, noise


class _Forcing(NamedTuple):
    """A part of the forcing, given as a function of time."""

    over_step: FloatArray  # (T K, ...) mean over each step of the integration
    at_tick: FloatArray  # (T, ...)


def _reduced(
    wind: _Forcing, forcing_over_time: _Forcing
) -> tuple[NDArray[np.int64], FloatArray, tuple[FloatArray, FloatArray]]:
    """Leave out the axes and directions along which there is never any forcing.

    Returns `axes` and `basis` of a course, and the forcing along them: means over the steps, and
    values at the ticks.
    """
    axes = np.flatnonzero(wind.over_step.any(axis=0))
    _, sizes, rows = np.linalg.svd(forcing_over_time.over_step, full_matrices=False)
    basis = rows[sizes > 1e-12 * max(sizes[0], 1e-300)].T
    over_step, now = (
        np.concatenate([blowing[:, axes], forcing @ basis], axis=1)
        for blowing, forcing in zip(wind, forcing_over_time, strict=True)
    )
    return axes, basis, (over_step, now)


def _forcing(ticks: int, steps: int, plant: PlantParams) -> tuple[_Forcing, _Forcing]:
    """Compute the forcing of the whole flight in two parts.

    The first is the wind along the G axes, m/s. The second is f_time without the wind, with n
    values in units of x_dot.
    """
    no_effect = np.zeros_like(plant.aircraft.gust_direction)
    forced = plant_model.forcing(
        0, ticks * steps, plant._replace(aircraft=plant.aircraft._replace(gust_direction=no_effect))
    )
    # Simpson's rule, as in Runge-Kutta.
    wind, timed = (
        _Forcing((part[:-1:2] + 4.0 * part[1::2] + part[2::2]) / 6.0, part[: -1 : 2 * steps])
        for part in forced
    )
    if (air := plant.turbulence) is not None:
        turbulent = np.zeros_like(wind.over_step)
        z = turbulence.initial_state(air)
        normals = turbulence.normals(0, ticks * steps, air)
        for k in range(ticks * steps):
            turbulent[k] = turbulence.wind(z, air)
            z = turbulence.step(z, normals[k], air)
        wind = _Forcing(wind.over_step + turbulent, wind.at_tick + turbulent[::steps])
    return wind, timed


def _air_angles(wind: FloatArray, airframe: Airframe) -> FloatArray:
    """Return the alpha and beta that the wind causes at the ticks, rad, by state, (T, n).

    `wind` has a column for each axis of the gusts, (T, G). The columns of other states are 0.
    """
    angles = np.zeros((len(wind), len(airframe.states)))
    for place, axis in enumerate(airframe.gusts):
        if axis in {"lateral", "vertical"} and AIR_STATE[axis] in airframe.states:
            angles[:, airframe.index(AIR_STATE[axis])] = wind[:, place] / airframe.speed
    return angles
