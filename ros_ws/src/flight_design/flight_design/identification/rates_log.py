# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Read y and u of a scenario of body rates from the rates and torques in an autopilot's log.

A torque of 1 means u at the upper end stop, as in the module of `rise-di export`.
"""

import math
from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
from scipy import signal

from aircraft_sim.airframes.airframe import Airframe
from autopilot_bridge.params import ChannelMap, load_map
from flight_analysis.closed_loop.scenario import Scenario
from flight_core.parameters import require
from flight_core.rates import NANOSECONDS
from flight_core.tape import Signal, Tape
from flight_core.vectors import FloatArray
from flight_design.identification.innovation_filters import FlightData, coarser, recording
from flight_design.identification.log_import import Imported, Window, imported
from flight_design.identification.parameter_agreement import Agreement
from flight_log.vehicle_tables import VehicleLog
from rise_di_controller.extensions.schedule import TORQUE_SPEEDS

MAPS: Mapping[str, str] = MappingProxyType({"px4": "px4", "ardupilot": "ardupilot"})
"""The channel map that has the topics of an autopilot."""
CUTOFFS: Mapping[str, str] = MappingProxyType(
    {"px4": "IMU_GYRO_CUTOFF", "ardupilot": "INS_GYRO_FILTER"}
)
"""The parameter that holds the cut-off frequency of the gyro's low-pass."""
PERIOD = 0.008  # s, least period of the identification: more samples make the search longer
SPARSE = 1.5  # largest period of a log that has every u, in periods of the law
# cut-off in Hz of a filter behind which the noise of samples a PERIOD apart is white
BROAD = 90.0
# least rate of a log, as a multiple of the cut-off, from which the filter can be removed
OVER = 2.2
PERIODS = 6.0  # after so many periods of the cut-off, the filter's impulse response is below 1e-5

MOST_SURFACES = 8  # largest number of surfaces of PX4, taken if the log lacks CA_SV_CS_COUNT
SAME_END = 1e-3  # largest rounding error of a servo's position of 1 at a torque of 1
AXES: Mapping[str, str] = MappingProxyType({"R": "roll", "P": "pitch", "Y": "yaw"})
"""The axis that a letter of PX4's parameters stands for."""


class RatesLog(NamedTuple):
    """y and u from the rates and torques of a log, with what is known about them."""

    recorded: FlightData
    taken: Imported
    rate: float  # rate of the samples of y, Hz
    cutoff: float  # cut-off of the gyro's second-order low-pass, Hz; 0 if the log names none
    advance: float  # s, time by which y is earlier than it was behind this filter
    # s, standard deviation of the instant at which u acts, which is anywhere in a period of the log
    timing: float
    every: float  # s, time between two samples of u


def rates_map(scenario: Scenario, autopilot: str) -> ChannelMap:
    """Return the channel map of an autopilot with the channels and end stops of a scenario.

    The map of a fixed wing keeps V, which shows when the aircraft flies. Raises ParameterError if
    an input has no end stop, or if no row of the autopilot's map moves its output.
    """
    base = load_map(MAPS[autopilot])
    controller = scenario.controller
    channels = scenario.aircraft.channels()
    upper = dict(zip(channels.inputs, scenario.aircraft.actuators.upper or (), strict=False))
    by_motion = {row.motion[0]: row for row in base.inputs.values()}
    inputs = {}
    for output, name, sign in zip(
        controller.outputs, controller.inputs, scenario.rise_di().D, strict=True
    ):
        expected = f"a rate that the map {base.name} has an input of"
        require(output in by_motion, "controller.outputs", output, expected)
        end = upper.get(name) or 0.0
        require(
            end > 0.0,
            "aircraft.actuators.upper",
            f"no end stop of {name}",
            "the deflection at a torque of 1",
        )
        row = by_motion[output]
        signed = 1 if row.sign * sign > 0 else -1
        inputs[name] = row.model_copy(update={"scale": end, "sign": signed})
    speed = {"V"} if channels.speed > 0.0 else set()
    names = {*controller.outputs, *speed}
    outputs = {name: row for name, row in base.outputs.items() if name in names}
    return base.model_copy(update={"outputs": outputs, "inputs": inputs, "pose": {}})


def rates_of_log(
    log: VehicleLog,
    scenario: Scenario,
    airframe: Airframe,
    autopilot: str,
    window: Window,
    show: Callable[[list[Agreement]], None] = lambda _: None,
) -> RatesLog:
    """Return y and u of a log for the identification of an airframe, together with the log.

        u = sign(D) end torque (V / V0)^2

    `end` is the upper end stop of an input. V / V0 is clipped as in the exported module. If the
    autopilot is ArduPlane, the position of the servo takes the place of the torque. Raises
    ParameterError as `rates_map`, `log_import.imported` and `innovation_filters.recording` do.
    """
    channel_map = rates_map(scenario, autopilot)
    taken = imported(channel_map, log, window, show, servos=autopilot == "ardupilot")
    tape = taken.tape
    u = tape["u"]
    values = np.column_stack([u[name] for name in airframe.inputs])
    values = values * _pressure(log, scenario, u)[:, None]
    y = tape["y"]
    signals = {
        "y": Signal(
            y.stamp_ns, airframe.outputs, np.column_stack([y[name] for name in airframe.outputs])
        ),
        "u": Signal(u.stamp_ns, tuple(airframe.inputs), values),
    }
    recorded = recording(Tape(signals, tape.start_ns), airframe)
    every = recorded.period
    timing = every / math.sqrt(12.0)
    if recorded.period > SPARSE / scenario.controller.rate:
        # The loop changes u between two samples. Their mean is exact if u is linear between them.
        following = np.vstack([recorded.u[1:], recorded.u[-1:]])
        recorded = recorded._replace(u=(recorded.u + following) / 2.0)
        timing /= 2.0  # u is known at both ends of the period
    cutoff = taken.parameters.get(CUTOFFS[autopilot], 0.0)
    advance = 0.0
    if 0.0 < cutoff < BROAD < 1.0 / (OVER * recorded.period):
        recorded, advance = broadened(recorded, cutoff)
    factor = max(1, round(PERIOD / recorded.period))
    return RatesLog(
        recorded=coarser(recorded, factor),
        taken=taken,
        rate=NANOSECONDS / float(np.median(np.diff(y.stamp_ns))),
        cutoff=cutoff,
        advance=advance,
        timing=timing,
        every=every,
    )


def scaled_torques(parameters: Mapping[str, float]) -> list[str]:
    """Name the axes on which PX4 moves a surface to its stop at another torque than 1.

        servo = M^+ torque, M^+ the pseudo-inverse of the CA_SV_CSk_TRQ, (axes, surfaces)

    A servo of 1 is the end stop, so the largest entry in the column of an axis must be 1. If the
    row of an axis in M is multiplied by a factor, its column in M^+ is divided by this factor.
    Source: PX4 1.16, ActuatorEffectivenessControlSurfaces.cpp, ControlAllocationPseudoInverse.cpp.
    """
    surfaces = int(parameters.get("CA_SV_CS_COUNT", MOST_SURFACES))
    axes = []
    for letter in "RPY":
        names = [f"CA_SV_CS{k}_TRQ_{letter}" for k in range(surfaces)]
        row = [parameters.get(name, 0.0) for name in names]
        if any(row):
            axes.append((letter, row))
    if not axes:
        return []
    inverse = np.linalg.pinv(np.array([row for _, row in axes]))
    sentences = []
    for (letter, _), largest in zip(axes, np.abs(inverse).max(axis=0).tolist(), strict=True):
        if abs(largest - 1.0) > SAME_END:
            sentences.append(
                f"{AXES[letter]}: a torque of {1.0 / largest:.3g} is the end stop of a surface, "
                f"expected 1: multiply each CA_SV_CSk_TRQ_{letter} by {largest:.3g}, and log again"
            )
    return sentences


def broadened(recorded: FlightData, cutoff: float) -> tuple[FlightData, float]:
    """Replace the low-pass of the gyro, whose cut-off is `cutoff`, by a faster one at BROAD, Hz.

        y' = F_BROAD(z) / F_cutoff(z) y,  F is a Butterworth filter of second order

    Returns the flight with the new y, and the time, s, by which the new y is ahead of the old one.

    Behind a narrow filter the noise of y is coloured, and so are the innovations. The zeros of the
    two filters at z = -1 cancel. A sample that depends on a lost sample becomes a lost sample.
    """
    rate = 1.0 / recorded.period
    narrow = signal.butter(2, cutoff, fs=rate)
    broad = signal.butter(2, BROAD, fs=rate)
    numerator = narrow[1] * broad[0][0] / narrow[0][0]
    is_lost = np.asarray(~np.isfinite(recorded.y).all(axis=1))
    begin = np.nanmean(recorded.y, axis=0)
    y = np.where(is_lost[:, None], 0.0, recorded.y - begin)
    y = begin + signal.lfilter(numerator, broad[1], y, axis=0)
    reach = math.ceil(PERIODS * rate / BROAD)
    y[np.convolve(is_lost, np.ones(reach))[: len(y)] > 0.0] = np.nan
    delays = [signal.group_delay(low_pass, w=[0.0], fs=rate)[1] for low_pass in (narrow, broad)]
    return recorded._replace(y=y), (delays[0] - delays[1]).item() / rate


def _pressure(log: VehicleLog, scenario: Scenario, u: Signal) -> FloatArray:
    """Return (V / V0)^2 at the stamps of u, (N,); 1 in hover, or if the airspeed is unknown."""
    speed = scenario.aircraft.channels().speed
    source = log.source("V")
    if speed <= 0.0 or source is None:
        return np.ones(len(u.stamp_ns))
    ratio = np.clip(log.at(source, u.stamp_ns) / speed, *TORQUE_SPEEDS)
    return np.asarray(np.where(np.isfinite(ratio), ratio, 1.0) ** 2)
