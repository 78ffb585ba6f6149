# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Compute margins and simulated errors of an autopilot's rate loop from its parameters.

    torque = FF r + P (r - y) + I integral of (r - y),  abs(I integral) <= IMAX

Sources: PX4 1.16, fw_rate_control and mc_rate_control with lib/rate_control; ArduPilot,
APM_Control/AP_RollController.cpp and AP_PitchController.cpp, AC_PID. D, filters and slew limits are
left out.
"""

import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from scipy.linalg import expm

from aircraft_sim.airframes.airframe import Airframe
from flight_analysis.closed_loop.scenario import Scenario
from flight_core.vectors import FloatArray

STEPS = 8  # integration steps of the aircraft in a period of the law
SCALING_SPEED = 15.0  # m/s, the default of ArduPlane
END = math.radians(45.0)  # a full deflection of ArduPlane, whose gains give an angle
FIXED_WING = {name: (f"FW_{k}R_", f"FW_{k}R_IMAX") for name, k in zip("pqr", "RPY", strict=True)}
MULTICOPTER = {
    "p": ("MC_ROLLRATE_", "MC_RR_INT_LIM"),
    "q": ("MC_PITCHRATE_", "MC_PR_INT_LIM"),
    "r": ("MC_YAWRATE_", "MC_YR_INT_LIM"),
}
ARDUPLANE = {
    name: (f"{axis}_RATE_", f"{axis}_RATE_IMAX")
    for name, axis in zip("pqr", ("RLL", "PTCH", "YAW"), strict=True)
}
"""Prefix of the gains, and name of the limit of the integral, of each axis by firmware."""


class OwnLoop(NamedTuple):
    """Gains of an autopilot's rate loop in the order of a law.

    The gains multiply errors in rad/s and their integrals in rad, and give a torque.
    """

    FF: FloatArray
    P: FloatArray
    I: FloatArray  # noqa: E741 - as the parameters are named
    imax: FloatArray
    source: str  # the parameters from which the gains come

    def in_place(self, scenario: Scenario) -> Scenario:
        """Return the scenario with the gains of this loop, as the law `pi`, in place of its law.

        The law computes u, which is the torque multiplied by the u at a torque of 1.
        """
        controller = scenario.rise_di()
        end = _ends(scenario)
        gain = end * self.P / np.array(controller.input_scale)
        pi = {
            "law": "pi",
            "K": gain,
            "Lambda": self.I / self.P,
            "D": controller.D,
            "input_scale": controller.input_scale,
        }
        return scenario.vary(controller=pi)

    def flown(
        self,
        scenario: Scenario,
        airframe: Airframe,
        y_m: FloatArray,
        noise: FloatArray,
        f: FloatArray,
    ) -> FloatArray:
        """Simulate the aircraft in this loop with the setpoint y_m, (N, m); return y - y_m, (N, m).

        Each row is a period of the controller. y has the noise, (m,) rms. y is late by the delay of
        the scenario minus a period, and u acts from the next period on. f, (N, n), is the
        disturbance of x_dot, SI.
        """
        controller = scenario.rise_di()
        period = 1.0 / controller.rate
        step = period / STEPS
        order = [list(airframe.inputs).index(name) for name in controller.inputs]
        A, B = airframe.matrix_a(), airframe.matrix_b()[:, order]
        rows = [airframe.outputs.index(name) for name in controller.outputs]
        C = airframe.matrix_c()[rows]
        n, m = len(A), len(order)
        both = expm(np.block([[A, B], [np.zeros((m, n + m))]]) * step)
        lag = np.array(controller.lag)
        follows = 1.0 - np.exp(-step / np.where(lag > 0.0, lag, 1e-9))
        late = max(0, round(controller.delay / period) - 1)
        rng = np.random.default_rng(1)
        measured = [np.zeros(m)] * (late + 1)
        x, position, integral, u = np.zeros(n), np.zeros(m), np.zeros(m), np.zeros(m)
        end = _ends(scenario)
        error = np.zeros_like(y_m)
        for k, setpoint in enumerate(y_m):
            y = C @ x
            error[k] = y - setpoint
            measured = [*measured[1:], y + noise * rng.normal(size=m)]
            e = setpoint - measured[0]
            integral = np.clip(integral + self.I * e * period, -self.imax, self.imax)
            before, u = u, end * np.clip(self.FF * setpoint + self.P * e + integral, -1.0, 1.0)
            for _ in range(STEPS):
                position = position + follows * (before - position)
                x = both[:n, :n] @ x + both[:n, n:] @ position + step * f[k]
        return error


def _ends(scenario: Scenario) -> FloatArray:
    """Return the u that a torque of 1 stands for, for each input of the law, with the sign of D."""
    controller = scenario.rise_di()
    inputs = scenario.aircraft.channels().inputs
    upper = dict(zip(inputs, scenario.aircraft.actuators.upper or (), strict=False))
    ends = np.array([upper[name] for name in controller.inputs], dtype=np.float64)
    return np.asarray(ends * np.array(controller.D))


def own_loop(parameters: Mapping[str, float], scenario: Scenario, autopilot: str) -> OwnLoop | None:
    """Read the rate loop of an autopilot from its log, or return None if a parameter is missing.

    PX4 and ArduPlane multiply FF by a reference speed over the airspeed, and P and I by the square
    of this ratio. The result has the gains at the trim speed.
    """
    speed = scenario.aircraft.channels().speed
    names = ARDUPLANE if autopilot == "ardupilot" else FIXED_WING if speed > 0.0 else MULTICOPTER
    trim, factor = speed, 1.0
    if autopilot == "ardupilot":
        trim, factor = parameters.get("SCALING_SPEED", SCALING_SPEED), 1.0 / END
    elif speed > 0.0:
        trim = parameters.get("FW_AIRSPD_TRIM", speed)
    ratio = trim / speed if speed > 0.0 else 1.0
    rows = [
        [parameters.get(f"{prefix}{gain}", math.nan) for gain in ("FF", "P", "I")]
        for prefix, _ in (names[name] for name in scenario.controller.outputs)
    ]
    gains = np.array(rows).T
    if not (np.isfinite(gains).all() and (gains[1] > 0.0).all()):
        return None
    limits = [parameters.get(names[name][1], 1.0) for name in scenario.controller.outputs]
    texts = [
        f"{names[name][0]}FF {row[0]:.3g}, P {row[1]:.3g}, I {row[2]:.3g}"
        for name, row in zip(scenario.controller.outputs, rows, strict=True)
    ]
    return OwnLoop(
        FF=factor * ratio * gains[0],
        P=factor * ratio**2 * gains[1],
        I=factor * ratio**2 * gains[2],
        imax=factor * np.array(limits),
        source="; ".join(texts),
    )
