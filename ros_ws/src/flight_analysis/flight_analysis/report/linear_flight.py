# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""The linear loop flies the commands, the noise and the wind of a log: the error to expect.

    x+ = A x + B u + integral_0^T exp(A s) ds d,  e = C x - y_m,  u = law(e + noise)

y_m, the noise of the sensors and d come from the log; d is the part of x_dot without x and u.
Limits of u, faults of the effectors and the state-dependent part of f are left out. The error of a
flight is 0.8 to 1.3 times this error in the scenarios of the package.
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
from flight_analysis.metrics import LONGEST_INTERVAL, best_error, noise_floor
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
WIND = "gust.longitudinal"  # of `truth`: the wind along the axis of the aircraft, m/s

NOISE_TIME = 1.0
"""s, over which the mean error of a sensor is a bias or a drift: white noise at 100 Hz loses a
hundredth of its variance."""


class Knowledge(NamedTuple):
    """What is known of a flight."""

    has_model: bool  # A and B of the aircraft
    has_wind: bool  # the log holds what moved the aircraft


class ErrorPair(NamedTuple):
    """The errors of a flight and of the linear loop at the ticks of the controller."""

    t: FloatArray  # (N,) flight time, s
    names: tuple[str, ...]
    e: FloatArray  # (N, m) of the flight, SI
    linear: FloatArray  # (N, m) of the linear loop, 0 where no linear loop is stable
    y_m: FloatArray  # (N, m)
    wind_error: FloatArray  # (N, m) of the linear loop without commands: by noise and wind
    is_flown: NDArray[np.bool_]  # (N,) the law was to fly, and the log has the error
    not_numbers: int  # ticks with an error that is not finite
    noise: FloatArray  # (m,) rms of the noise in e: 0 of a true error
    knowledge: Knowledge


def error_pair(
    tape: Tape, controller: ControllerConfig, aircraft: AircraftConfig | None
) -> ErrorPair | None:
    """The errors of a flight and of the linear loop.

    None without an error, and of a law without feedback. `aircraft`: of the simulation; None of an
    unknown plant.
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
        linear=_linear_error(tape, controller, aircraft, airframes, ticks, y_m, e[0]),
        y_m=y_m,
        wind_error=_linear_error(
            tape, controller, aircraft, airframes, ticks, 0.0 * y_m, 0.0 * e[0]
        ),
        is_flown=_active(tape, ticks) & _sampled(seconds_of, ticks) & is_finite,
        not_numbers=int(np.count_nonzero(~is_finite)),
        noise=np.array([0.0 if is_true else floor.get(name, 0.0) for name in names]),
        knowledge=knowledge,
    )


def _has_feedback(controller: ControllerConfig) -> bool:
    """Whether u of a law depends on y, unlike the excitation of an identification."""
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
    """The simulated aircraft, before and after a drift; empty for an unknown aircraft."""
    if aircraft is None or aircraft.is_jsbsim or "truth" not in tape:
        return []
    names = {f"{group}.{state}" for group in "xf" for state in aircraft.sampled_airframe().states}
    if not names <= set(tape["truth"].names):
        return []
    if aircraft.drift:
        return [aircraft.sampled_airframe(), aircraft.drifted_airframe()]
    return [aircraft.sampled_airframe()]


def _has_wind(tape: Tape, aircraft: AircraftConfig | None) -> bool:
    """Whether the log is of a simulation and holds the wind."""
    if aircraft is None or "truth" not in tape:
        return False
    return bool(_airframes(tape, aircraft)) or {"x.theta", WIND} <= set(tape["truth"].names)


def _linear_error(
    tape: Tape,
    controller: ControllerConfig,
    aircraft: AircraftConfig | None,
    airframes: list[Airframe],
    ticks: FloatArray,
    y_m: FloatArray,
    e_0: FloatArray,
) -> FloatArray:
    """The error of the linear loop around the aircraft, (N, m).

    From the drift on the larger error of the loops before and after counts.
    """
    config = controller
    if is_literal(controller):
        # the literal sign is the limit of the implicit one
        config = controller.model_copy(update={"sign": "implicit"})
    loops = [_known_loop(config, airframe) for airframe in airframes] or [_bare_loop(config)]
    largest = np.zeros_like(y_m)
    for number, (plant, law, loop) in enumerate(loops):
        matrix = closed_loop(plant, law, loop, np.zeros(len(loop.lag)))
        if spectral_radius(matrix) > 1.0 + SPECTRAL_RADIUS_TOLERANCE:
            continue
        if airframes:
            d = _disturbance(tape, aircraft, ticks, len(plant.A))
        else:
            d = _disturbance_of_speed(tape, controller, ticks)
        error = np.abs(_flight(tape, controller, (plant, law, loop), ticks, d, y_m, e_0))
        if number and aircraft is not None and aircraft.drift is not None:
            error[ticks < aircraft.drift.start] = 0.0
        largest = np.maximum(largest, error)
    return largest


def _known_loop(
    controller: ControllerConfig, airframe: Airframe
) -> tuple[LinearPlant, LinearLaw, LoopTiming]:
    """The loop around the airframe of a simulation."""
    A = airframe.matrix_a()[None]
    B = airframe.matrix_b()[None] @ distribution(airframe, controller)
    linear = linear_loop(controller, through_allocation(airframe, controller), A, B)
    return linear.nominal, linear.law, linear.loop


def _bare_loop(controller: ControllerConfig) -> tuple[LinearPlant, LinearLaw, LoopTiming]:
    """The loop around y_dot = Omega u, abs(Omega_ii) = omega / input_scale, of the controller."""
    if controller.vanes:
        controller = controller.without_vanes()
    m = len(controller.outputs)
    Omega = 1.0 / np.array(controller.input_scale)
    if isinstance(controller, RiseDiConfig):
        Omega = Omega * np.array(controller.D) * np.array(controller.omega)
    loop = loop_of(controller)
    law = linear_law(controller.tuned_law(), m, loop.period)
    return LinearPlant(np.zeros((m, m)), np.diag(Omega), np.eye(m)), law, loop


def _flight(
    tape: Tape,
    controller: ControllerConfig,
    parts: tuple[LinearPlant, LinearLaw, LoopTiming],
    ticks: FloatArray,
    d: FloatArray,
    y_m: FloatArray,
    e_0: FloatArray,
) -> FloatArray:
    """The error e of the linear loop at the ticks, (N, m), x_dot = A x + B u + d; d: (N, n)."""
    plant, law, loop = parts
    n, m = plant.B.shape
    by_tick = sampled_plant(plant, loop, np.zeros(m))
    _, step = zero_order_hold(plant.A, np.eye(n), loop.period)
    drive = np.zeros((len(ticks), len(by_tick.A)))
    drive[:, :n] = d @ step.T
    # vanes add columns to y, which see the motion alone
    vanes = len(by_tick.C) - m
    noise = _noise(tape, controller, ticks)
    shift = np.concatenate([noise - y_m, np.zeros((len(ticks), vanes))], axis=1)
    probe = controller.guard().probe
    x = np.zeros(len(by_tick.A))
    x[:n] = np.linalg.pinv(plant.C[:m]) @ (e_0 + y_m[0])
    z = np.zeros(law.A.shape[-1])
    e = np.zeros((len(ticks), m))
    for k, t in enumerate(ticks):
        y = by_tick.C @ x
        e[k] = y[:m] - y_m[k]
        measured = y + shift[k]
        u = law.C @ z + law.D @ measured
        z = law.A @ z + law.B @ measured
        if probe is not None:
            u = u + probe.at(tape.start_ns + round(t * NANOSECONDS))
        x = by_tick.A @ x + by_tick.B @ u + drive[k]
    return e


def _at(tape: Tape, topic: str, name: str, ticks: FloatArray) -> FloatArray:
    """A channel of a topic at the ticks, (N,), between its finite samples."""
    return _between(tape, tape[topic], tape[topic][name], ticks)


def _between(tape: Tape, signal: Signal, values: FloatArray, ticks: FloatArray) -> FloatArray:
    """Values at the samples of a signal, (K,), at the ticks, (N,), between the finite ones.

    They are 0 without any.
    """
    is_finite = np.isfinite(values)
    if not is_finite.any():
        return np.zeros(len(ticks))
    t = (signal.stamp_ns[is_finite] - tape.start_ns) / NANOSECONDS
    return np.interp(ticks, t, values[is_finite])


def _noise(tape: Tape, controller: ControllerConfig, ticks: FloatArray) -> FloatArray:
    """The errors of the sensors in the log less the mean over NOISE_TIME, (N, m).

    They have the units of y, and are 0 where the log has none. A bias and a drift are no noise: the
    law follows them, and the aircraft is off by as much.
    """
    from scipy.ndimage import uniform_filter1d  # noqa: PLC0415 - loads SciPy, which few flights need

    count = max(round(NOISE_TIME * controller.rate), 1)
    noise = np.zeros((len(ticks), len(controller.outputs)))
    truth = tape.signals.get("truth")
    for i, name in enumerate(controller.outputs):
        if truth is not None and f"noise.{name}" in truth.names:
            errors = _at(tape, "truth", f"noise.{name}", ticks)
            noise[:, i] = errors - uniform_filter1d(errors, count, mode="nearest")
    return noise


def _disturbance(
    tape: Tape, aircraft: AircraftConfig | None, ticks: FloatArray, n: int
) -> FloatArray:
    """The disturbance d = f(x, t) less the part that depends on x, (N, n), by `truth`."""
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


def _disturbance_of_speed(
    tape: Tape, controller: ControllerConfig, ticks: FloatArray
) -> FloatArray:
    """The disturbance d of y_dot = Omega u + d, (N, m), by `truth` of JSBSim.

    Weight along the flight path and wind act on the airspeed. d is 0 for the rates, and where the
    log has neither.

        V_dot = -g sin(theta) - W_dot
    """
    d = np.zeros((len(ticks), len(controller.outputs)))
    truth = tape.signals.get("truth")
    if truth is None or AIRSPEED not in controller.outputs:
        return d
    if not {"x.theta", WIND} <= set(truth.names):
        return d
    wind = _at(tape, "truth", WIND, ticks)
    theta = _at(tape, "truth", "x.theta", ticks)
    slope = np.gradient(wind, ticks) if len(ticks) > 1 else np.zeros_like(wind)
    d[:, controller.outputs.index(AIRSPEED)] = -GRAVITY * np.sin(theta) - slope
    return d


def _active(tape: Tape, ticks: FloatArray) -> NDArray[np.bool_]:
    """Mask of the ticks from the first engagement on without those of an inactive controller.

    No tick counts without `internals`.
    """
    if "internals" not in tape:
        return np.zeros(len(ticks), dtype=bool)
    mode = tape["internals"]["mode"]
    t = tape.time("internals")
    is_engaged = mode == Mode.ENGAGED
    if not is_engaged.any():
        return np.zeros(len(ticks), dtype=bool)
    before = np.maximum(np.searchsorted(t, ticks, side="right") - 1, 0)
    is_active: NDArray[np.bool_] = mode[before] != Mode.INACTIVE
    return is_active & (ticks >= float(t[np.argmax(is_engaged)]))


def _sampled(t: FloatArray, ticks: FloatArray) -> NDArray[np.bool_]:
    """Mask of the ticks that lie in no gap between the samples at t."""
    after = np.clip(np.searchsorted(t, ticks), 1, len(t) - 1)
    return t[after] - t[after - 1] <= LONGEST_INTERVAL
