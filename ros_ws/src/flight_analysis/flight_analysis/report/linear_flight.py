# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Simulate the linear loop with the commands, noise and wind of a log, to find the error to expect.

    x+ = A x + B u + integral_0^T exp(A s) ds d,  e = C x - y_m,  u = law(e + noise)

y_m, the noise of the sensors and d come from the log. d is the part of x_dot that depends neither
on x nor on u. Three things are left out: the limits of u, faults of the effectors and the part of f
that depends on the state. In the scenarios of the package, the error of a flight is 0.8 to 1.3
times the error of the linear loop.

Because the loop is linear, e is the sum of three errors, which the commands, the noise and the wind
cause. An error of the flight is excused if these three explain it. Noise and wind must not excuse
too much, so both are limited before they are applied. Noise is limited to the declared noise of the
sensor, and to what the actuators can follow of the law's response to it. Wind is limited to what
the travel of the actuators can counter. Gravity acts along the path of y_m, not along the path that
was flown, so a pitch angle that was not commanded excuses no error.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from aircraft_sim.airframes.airframe import Airframe
from aircraft_sim.params import AircraftConfig
from aircraft_sim.plant import dynamics
from flight_analysis.linear_loop.loop_margins import (
    distribution,
    is_literal,
    linear_loop,
    loop_of,
    through_allocation,
)
from flight_analysis.metrics.errors import best_error, noise_floor
from flight_analysis.metrics.time_spans import LONGEST_INTERVAL
from flight_core.modes import Mode
from flight_core.rates import NANOSECONDS
from flight_core.tape import Signal, Tape
from flight_core.units import GRAVITY
from flight_core.vectors import FloatArray
from rise_di_controller.law.linear_loop import (
    SPECTRAL_RADIUS_TOLERANCE,
    LinearLaw,
    LinearPlant,
    LoopTiming,
    closed_loop,
    linear_law,
    sampled_plant,
    spectral_radius,
    zero_order_hold,
)
from rise_di_controller.params import ControllerConfig
from rise_di_controller.rise_di_config import RiseDiConfig

AIRSPEED = "V"
WIND = "gust.longitudinal"  # channel of `truth` with the wind along the axis of the aircraft, m/s

NOISE_TIME = 1.0
"""The mean error of a sensor over this time, s, counts as bias or drift. White noise at 100 Hz
loses a hundredth of its variance if this mean is subtracted."""

DECLARED = 4.0
"""Number of standard deviations up to which a sensor's noise counts. One normal sample in 16,000
lies beyond it."""

NOISE_PEAK = 3.0
"""Number of standard deviations of an input due to noise that the actuators must follow, which is
99.7 % of the samples."""


class Knowledge(NamedTuple):
    """What is known about the aircraft and the wind of a flight."""

    has_model: bool  # whether A and B of the aircraft are known
    has_wind: bool  # whether the log has the wind that moved the aircraft


class ErrorPair(NamedTuple):
    """The errors of a flight and the errors of the linear loop, at the ticks of the controller."""

    t: FloatArray  # flight time, s, (N,)
    names: tuple[str, ...]
    e: FloatArray  # error of the flight, (N, m), SI
    y_m: FloatArray  # (N, m)
    linear: "LinearErrors"
    is_flown: NDArray[np.bool_]  # whether the law should fly and the log has the error, (N,)
    not_numbers: int  # number of ticks with an error that is not finite
    noise: FloatArray  # rms of the noise in e, (m,), which is 0 for a true error
    knowledge: Knowledge


class LinearErrors(NamedTuple):
    """Absolute errors of the linear loop, (N, m), SI, or 0 if the linear loop is unstable.

    If the aircraft drifts, there are two loops. One has the aircraft before the drift, over the
    whole flight. The other has the aircraft after the drift, from the start of the drift on. Each
    error is the larger one of the two.
    """

    whole: FloatArray
    command: FloatArray  # caused by the commands alone
    noise: FloatArray  # caused by the noise alone
    wind: FloatArray  # caused by the wind alone


class Reach(NamedTuple):
    """Limits of how far and how fast the actuators can move each input of the law, (m,).

    The values are in the unit of the input, and infinite if there is no limit.
    """

    travel: FloatArray
    rate: FloatArray  # per s


def error_pair(
    tape: Tape,
    controller: ControllerConfig,
    aircraft: AircraftConfig | None,
    *,
    may_pause: bool = True,
) -> ErrorPair | None:
    """Return the errors of a flight, and the errors that the linear loop would have had.

    Returns None if the log has no error, or if the law has no feedback. `aircraft` is the simulated
    aircraft, or None if the plant is unknown. If `may_pause` is True, ticks of an inactive
    controller are left out.
    """
    kind, error = best_error(tape)
    names = tuple(name for name in controller.outputs if name in error.names)
    if len(error.stamp_ns) < 2 or names != controller.outputs or not _has_feedback(controller):
        return None
    seconds_of = (error.stamp_ns - tape.start_ns) / NANOSECONDS
    ticks = np.arange(seconds_of[0], seconds_of[-1], 1.0 / controller.rate)
    e = np.stack([np.interp(ticks, seconds_of, error[name]) for name in names], axis=1)
    is_finite = np.isfinite(e).all(axis=1)
    e[~is_finite] = 0.0
    y_m = np.stack([_at(tape, "y_m", name, ticks) for name in names], axis=1)
    airframes = _airframes(tape, aircraft)
    knowledge = Knowledge(bool(airframes), _has_wind(tape, aircraft))
    floor = noise_floor(tape)
    is_true = kind == "true error"
    return ErrorPair(
        t=ticks,
        names=names,
        e=e,
        y_m=y_m,
        linear=_linear_errors(tape, controller, aircraft, airframes, ticks, y_m, e[0]),
        is_flown=_is_flown(tape, ticks, may_pause=may_pause)
        & _is_sampled(seconds_of, ticks)
        & is_finite,
        not_numbers=int(np.count_nonzero(~is_finite)),
        noise=np.array([0.0 if is_true else floor.get(name, 0.0) for name in names]),
        knowledge=knowledge,
    )


def _has_feedback(controller: ControllerConfig) -> bool:
    """Return whether u depends on y. It does, except in laws that only excite the aircraft."""
    if is_literal(controller):
        return True
    law = linear_law(controller.tuned_law(), len(controller.outputs), 1.0 / controller.rate)
    responses = [law.D]
    state = law.B
    for _ in range(len(law.A)):
        responses.append(law.C @ state)
        state = law.A @ state
    return any(response.any() for response in responses)


def _airframes(tape: Tape, aircraft: AircraftConfig | None) -> list[Airframe]:
    """Return the simulated airframe, and the airframe after a drift, if there is one.

    The result is empty if the airframe is unknown.
    """
    if aircraft is None or aircraft.is_jsbsim or "truth" not in tape:
        return []
    names = {f"{group}.{state}" for group in "xf" for state in aircraft.sampled_airframe().states}
    if not names <= set(tape["truth"].names):
        return []
    if aircraft.drift:
        return [aircraft.sampled_airframe(), aircraft.drifted_airframe()]
    return [aircraft.sampled_airframe()]


def _has_wind(tape: Tape, aircraft: AircraftConfig | None) -> bool:
    """Return whether the log comes from a simulation and has the wind that acted."""
    if aircraft is None or "truth" not in tape:
        return False
    return bool(_airframes(tape, aircraft)) or {"x.theta", WIND} <= set(tape["truth"].names)


def _linear_errors(
    tape: Tape,
    controller: ControllerConfig,
    aircraft: AircraftConfig | None,
    airframes: list[Airframe],
    ticks: FloatArray,
    y_m: FloatArray,
    e_0: FloatArray,
) -> LinearErrors:
    """Simulate the linear loop around the aircraft and, after a drift, around the changed aircraft.

    `e_0` is the error of the flight at its first tick.
    """
    config = controller
    if is_literal(controller):
        # The literal sign is the limit of the implicit sign, which has a linear law.
        config = controller.model_copy(update={"sign": "implicit"})
    noise = _noise(tape, controller, aircraft, ticks)
    still = np.zeros_like(y_m)
    largest = LinearErrors(still, still, still, still)
    for number, airframe in enumerate(airframes or [None]):
        parts = _bare_loop(config) if airframe is None else _known_loop(config, airframe)
        plant, law, loop = parts
        matrix = closed_loop(plant, law, loop, np.zeros(len(loop.lag)))
        if spectral_radius(matrix) > 1.0 + SPECTRAL_RADIUS_TOLERANCE:
            continue
        if airframe is None:
            wind = _slope_of_wind(tape, controller, ticks)
            along_path = _gravity_along_path(tape, controller, ticks, y_m)
        else:
            wind = _disturbance(tape, aircraft, ticks, len(plant.A))
            along_path = np.zeros_like(wind)
        calm = 0.0 * wind
        in_trim = 0.0 * e_0
        by_command = _flight(
            tape, parts, ticks, d=along_path, noise=still, y_m=y_m, e_0=e_0, probed=controller
        )
        by_noise = _flight(tape, parts, ticks, d=calm, noise=noise, y_m=still, e_0=in_trim)
        by_wind = _flight(tape, parts, ticks, d=wind, noise=still, y_m=still, e_0=in_trim)
        reach = _reach(controller, aircraft)
        held_noise = _share_within(reach, by_noise.u, loop.period) * by_noise.e
        held_wind = _share_within_travel(reach, by_wind.u) * by_wind.e
        errors = [
            np.abs(error)
            for error in (
                by_command.e + held_noise + held_wind,
                by_command.e,
                held_noise,
                held_wind,
            )
        ]
        if number and aircraft is not None and aircraft.drift is not None:
            for error in errors:
                error[ticks < aircraft.drift.start] = 0.0
        largest = LinearErrors(*map(np.maximum, largest, errors))
    return largest


def _reach(controller: ControllerConfig, aircraft: AircraftConfig | None) -> Reach:
    """Return how far and how fast the actuators can follow each input of the law.

    If an allocation distributes an input over several effectors, the input reaches only as far as
    the first effector that comes to its limit.
    """
    m = len(controller.inputs)
    if aircraft is None:
        return Reach(np.full(m, np.inf), np.full(m, np.inf))
    names = tuple(aircraft.channels().inputs)
    allocation = controller.allocation
    if allocation is None or set(names) == set(controller.inputs):
        parts = np.array([[float(name == each) for each in controller.inputs] for name in names])
    else:
        T = np.abs(np.reshape(allocation.T, (len(allocation.effectors), m)))
        parts = T[[allocation.effectors.index(name) for name in names]]
    actuators = aircraft.actuators
    travel = np.full(len(names), np.inf)
    if actuators.lower and actuators.upper:
        travel = np.minimum(-np.array(actuators.lower), np.array(actuators.upper))
    rate = np.array(actuators.rate) if actuators.rate else np.full(len(names), np.inf)
    with np.errstate(divide="ignore", invalid="ignore"):
        return Reach(np.min(travel[:, None] / parts, axis=0), np.min(rate[:, None] / parts, axis=0))


def _share_within(reach: Reach, u: FloatArray, period: float) -> FloatArray:
    """Return the fraction of a noisy u that the actuators can follow, (m,), at most 1.

    u has the shape (N, m). The result is a factor on u. With this factor, NOISE_PEAK standard
    deviations of u lie within the travel of the actuators, and NOISE_PEAK standard deviations of
    its rate within their rate limit.
    """
    if len(u) < 2:
        return np.ones(u.shape[1])
    size = NOISE_PEAK * np.sqrt(np.mean(u**2, axis=0))
    rate = NOISE_PEAK * np.sqrt(np.mean(np.diff(u, axis=0) ** 2, axis=0)) / period
    return np.asarray(1.0 / np.maximum(np.maximum(size / reach.travel, rate / reach.rate), 1.0))


def _share_within_travel(reach: Reach, u: FloatArray) -> FloatArray:
    """Return the fraction of u, (N, m), within the travel of the actuators, (m,), at most 1.

    The fraction follows from the largest abs(u), because a gust has a peak rather than a standard
    deviation. The rate limit is not applied, because a slow engine cannot follow a gust.
    """
    return np.asarray(1.0 / np.maximum(np.abs(u).max(axis=0, initial=0.0) / reach.travel, 1.0))


def _known_loop(
    controller: ControllerConfig, airframe: Airframe
) -> tuple[LinearPlant, LinearLaw, LoopTiming]:
    """Return the linear loop around a known airframe."""
    A = airframe.matrix_a()[None]
    B = airframe.matrix_b()[None] @ distribution(airframe, controller)
    linear = linear_loop(controller, through_allocation(airframe, controller), A, B)
    return linear.nominal, linear.law, linear.loop


def _bare_loop(controller: ControllerConfig) -> tuple[LinearPlant, LinearLaw, LoopTiming]:
    """Return the linear loop around y_dot = Omega u, for an aircraft that is unknown.

    Omega follows from the parameters of the controller: abs(Omega_ii) = omega / input_scale.
    """
    if controller.vanes:
        controller = controller.without_vanes()
    m = len(controller.outputs)
    Omega = 1.0 / np.array(controller.input_scale)
    if isinstance(controller, RiseDiConfig):
        Omega = Omega * np.array(controller.D) * np.array(controller.omega)
    loop = loop_of(controller)
    law = linear_law(controller.tuned_law(), m, loop.period)
    return LinearPlant(np.zeros((m, m)), np.diag(Omega), np.eye(m)), law, loop


class _LinearFlight(NamedTuple):
    """The error and the input of the linear loop at each tick."""

    e: FloatArray  # (N, m)
    u: FloatArray  # (N, m)


def _flight(
    tape: Tape,
    parts: tuple[LinearPlant, LinearLaw, LoopTiming],
    ticks: FloatArray,
    *,
    d: FloatArray,
    noise: FloatArray,
    y_m: FloatArray,
    e_0: FloatArray,
    probed: ControllerConfig | None = None,
) -> _LinearFlight:
    """Simulate the linear loop, x_dot = A x + B u + d, with d (N, n) and noise (N, m).

    The simulation begins with the error `e_0`. If the probe of a controller acts on u, this
    controller is given as `probed`.
    """
    plant, law, loop = parts
    n, m = plant.B.shape
    delay = np.zeros(m)
    motion = closed_loop(plant, law, loop, delay)
    by_tick = sampled_plant(plant, loop, delay)
    size = len(by_tick.A)
    # Vanes add columns to y. These columns have neither noise nor y_m.
    vanes = len(by_tick.C) - m
    shift = np.concatenate([noise - y_m, np.zeros((len(ticks), vanes))], axis=1)
    # What enters does not depend on the state, so all of it is known before the flight.
    probing = np.zeros((len(ticks), m))
    if probed is not None and (probe := probed.guard().probe) is not None:
        probing[:] = [probe.at(tape.start_ns + round(t * NANOSECONDS)) for t in ticks]
    entering = np.zeros((len(ticks), len(motion)))
    _, step = zero_order_hold(plant.A, np.eye(n), loop.period)
    entering[:, :n] = d @ step.T
    entering[:, :size] += (shift @ law.D.T + probing) @ by_tick.B.T
    entering[:, size:] = shift @ law.B.T
    state = np.zeros(len(motion))
    state[:n] = np.linalg.pinv(plant.C[:m]) @ (e_0 + y_m[0])
    states = np.zeros((len(ticks), len(motion)))
    for k in range(len(ticks)):
        states[k] = state
        state = motion.dot(state) + entering[k]
    y = states[:, :size] @ by_tick.C.T
    u = states[:, size:] @ law.C.T + (y + shift) @ law.D.T + probing
    return _LinearFlight(y[:, :m] - y_m, u)


def _at(tape: Tape, topic: str, name: str, ticks: FloatArray) -> FloatArray:
    """Return a channel of a topic at the ticks, (N,), interpolated between finite samples."""
    return _between(tape, tape[topic], tape[topic][name], ticks)


def _between(tape: Tape, signal: Signal, values: FloatArray, ticks: FloatArray) -> FloatArray:
    """Interpolate the values of a signal's samples, (K,), to the ticks, (N,).

    Only finite values are used. If there is none, the result is 0.
    """
    is_finite = np.isfinite(values)
    if not is_finite.any():
        return np.zeros(len(ticks))
    t = (signal.stamp_ns[is_finite] - tape.start_ns) / NANOSECONDS
    return np.interp(ticks, t, values[is_finite])


def _noise(
    tape: Tape, controller: ControllerConfig, aircraft: AircraftConfig | None, ticks: FloatArray
) -> FloatArray:
    """Return the noise of the sensors in the log, (N, m), in the units of y.

    The noise is the error of each sensor less its moving mean over NOISE_TIME, or 0 if the log has
    no errors of sensors. Bias and drift are no noise in this sense: the law follows them, so the
    aircraft is off by as much. The noise is limited to the declared one, because more is a fault.
    """
    count = max(round(NOISE_TIME * controller.rate), 1)
    noise = np.zeros((len(ticks), len(controller.outputs)))
    truth = tape.signals.get("truth")
    if truth is None or aircraft is None:
        return noise
    declared = dict(zip(aircraft.channels().outputs, _declared_noise(aircraft), strict=True))
    for i, name in enumerate(controller.outputs):
        if f"noise.{name}" in truth.names:
            errors = _at(tape, "truth", f"noise.{name}", ticks)
            errors -= _moving_mean(errors, count)
            noise[:, i] = np.clip(errors, -declared[name], declared[name])
    return noise


def _moving_mean(values: FloatArray, count: int) -> FloatArray:
    """Return the mean of the `count` values around each value, (N,).

    Beyond the ends, the first and the last value are repeated.
    """
    before = count // 2
    padded = np.pad(values, (before, count - 1 - before), mode="edge")
    return np.convolve(padded, np.full(count, 1.0 / count), mode="valid")


def _declared_noise(aircraft: AircraftConfig) -> list[float]:
    """Return the largest noise of each output that the sensor's parameters declare, SI.

    The result is DECLARED sqrt(noise^2 + drift^2 rate NOISE_TIME) + quantisation.
    """
    sensors = aircraft.sensor_arrays()
    steps = aircraft.rate * NOISE_TIME
    drift = np.zeros_like(sensors.noise) if sensors.drift is None else sensors.drift
    quantum = np.zeros_like(sensors.noise) if sensors.quantum is None else sensors.quantum
    largest = DECLARED * np.sqrt(sensors.noise**2 + drift**2 * steps) + quantum
    return [float(value) for value in largest[: len(aircraft.channels().outputs)]]


def _disturbance(
    tape: Tape, aircraft: AircraftConfig | None, ticks: FloatArray, n: int
) -> FloatArray:
    """Return the disturbance d, (N, n): f of the topic `truth` less its part that depends on x."""
    truth: Signal = tape["truth"]
    d = np.zeros((len(ticks), n))
    if aircraft is None:
        return d
    airframe, arrays = aircraft.load()
    x = np.stack([truth[f"x.{state}"] for state in airframe.states])
    f = np.stack([truth[f"f.{state}"] for state in airframe.states])
    for i, row in enumerate(f - dynamics.f_state(x, arrays)):
        d[:, i] = _between(tape, truth, row, ticks)
    return d


def _slope_of_wind(tape: Tape, controller: ControllerConfig, ticks: FloatArray) -> FloatArray:
    """Compute the disturbance d that the wind of JSBSim causes in y_dot = Omega u + d, (N, m).

        V_dot = -W_dot

    d is 0 for the rates q, p, r. If the log has no wind, d is also 0 for V.
    """
    d = np.zeros((len(ticks), len(controller.outputs)))
    if _has_path(tape, controller) and len(ticks) > 1:
        wind = _at(tape, "truth", WIND, ticks)
        d[:, controller.outputs.index(AIRSPEED)] = -np.gradient(wind, ticks)
    return d


def _gravity_along_path(
    tape: Tape, controller: ControllerConfig, ticks: FloatArray, y_m: FloatArray
) -> FloatArray:
    """Compute the disturbance d that gravity causes in y_dot = Omega u + d along y_m, (N, m).

        theta_dot = q_m cos(phi) - r_m sin(phi),   V_dot = -g sin(theta)

    theta is the deviation from trim. Its first value comes from the log, and phi comes from the log
    throughout. If the aircraft has no rudder, there is no r_m, so the true r replaces r_m. If the
    law has an integral of e, it keeps the true theta within 0.01 rad of this computed theta,
    whatever the gusts.
    """
    d = np.zeros((len(ticks), len(controller.outputs)))
    names = controller.outputs
    if not _has_path(tape, controller):
        return d
    q, r = (
        y_m[:, names.index(name)] if name in names else _at(tape, "truth", f"x.{name}", ticks)
        for name in ("q", "r")
    )
    phi = _at(tape, "truth", "x.phi", ticks)
    theta_dot = q * np.cos(phi) - r * np.sin(phi)
    theta = float(_at(tape, "truth", "x.theta", ticks[:1])[0]) + np.concatenate(
        [[0.0], np.cumsum(theta_dot[:-1] * np.diff(ticks))]
    )
    d[:, names.index(AIRSPEED)] = -GRAVITY * np.sin(theta)
    return d


def _has_path(tape: Tape, controller: ControllerConfig) -> bool:
    """Return whether V is an output, and the log has the attitude and the wind of JSBSim."""
    truth = tape.signals.get("truth")
    if truth is None or AIRSPEED not in controller.outputs:
        return False
    return {"x.theta", "x.phi", WIND} <= set(truth.names)


def _is_flown(tape: Tape, ticks: FloatArray, *, may_pause: bool) -> NDArray[np.bool_]:
    """Return a mask of the ticks from the first engagement on.

    If `may_pause` is True, the ticks of an inactive controller are left out. If the log has no
    topic `internals`, the mask is False throughout.
    """
    if "internals" not in tape:
        return np.zeros(len(ticks), dtype=bool)
    mode = tape["internals"]["mode"]
    t = tape.time("internals")
    is_engaged = mode == Mode.ENGAGED
    if not is_engaged.any():
        return np.zeros(len(ticks), dtype=bool)
    before = np.maximum(np.searchsorted(t, ticks, side="right") - 1, 0)
    is_begun: NDArray[np.bool_] = ticks >= float(t[np.argmax(is_engaged)])
    return is_begun & (mode[before] != Mode.INACTIVE) if may_pause else is_begun


def _is_sampled(t: FloatArray, ticks: FloatArray) -> NDArray[np.bool_]:
    """Return a mask of the ticks, (N,), that lie in no gap between the samples at the times t."""
    after = np.clip(np.searchsorted(t, ticks), 1, len(t) - 1)
    return t[after] - t[after - 1] <= LONGEST_INTERVAL
