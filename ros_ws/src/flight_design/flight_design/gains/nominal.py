# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Build the nominal model of an airframe for observers, filters and model-based laws."""

import math
from collections.abc import Sequence

import numpy as np

from aircraft_sim.airframes.airframe import Airframe
from aircraft_sim.uncertainty import KINEMATIC
from control_laws.nominal_model import NominalModel
from flight_core.units import ANGLE, DIMENSIONLESS, quantity, unit_sizes
from flight_core.vectors import FloatArray
from rise_di_controller.law.linear_loop import LoopTiming

# share of an output's size that is one unit of error in a score: 0.1 m/s or 0.01 rad/s
ERROR_SHARE = 0.1

# mean abs(u_dot) that costs as much as one unit of error, by the kind of input
SURFACE_ACTIVITY = np.deg2rad(60.0)  # rad/s
THROTTLE_ACTIVITY = 6.0  # 1/s: 600 %/s
# 1/s, relative to the thrust in trim. It equals 600 %/s of the throttle if trim needs half of the
# thrust.
THRUST_ACTIVITY = 12.0


def activity_units(airframe: Airframe) -> FloatArray:
    """Return the unit of activity of each input, (p,).

    The unit is the mean abs(u_dot) that costs as much as a unit of error. Each value has the unit
    of its input, in SI, per s. If the file has no `no_thrust`, a thrust in newtons has an infinite
    unit, so that its activity costs nothing.
    """
    units = []
    channels = zip(airframe.inputs.values(), airframe.no_thrust(), strict=True)
    for channel, no_thrust in channels:
        dimension = quantity(channel.unit).dimension
        if dimension == ANGLE:
            units.append(SURFACE_ACTIVITY)
        elif dimension == DIMENSIONLESS:
            units.append(THROTTLE_ACTIVITY)
        else:
            units.append(math.inf if np.isnan(no_thrust) else THRUST_ACTIVITY * abs(no_thrust))
    return np.array(units)


def airframe_model(
    airframe: Airframe,
    outputs: Sequence[str],
    inputs: Sequence[str],
    noise: FloatArray,
    loop: LoopTiming,
) -> NominalModel:
    """Build the model of an airframe without limits, with the channels in the given order.

    D is I until the caller sets it. `noise`, (m,), is the noise of the outputs, rms per sample. The
    channels of `loop` must also be in the given order.
    """
    rows = [airframe.outputs.index(name) for name in outputs]
    columns = [list(airframe.inputs).index(name) for name in inputs]
    B = airframe.matrix_b()[:, columns]
    C = airframe.matrix_c()[rows]
    unlimited = np.full(len(columns), np.inf)
    return NominalModel(
        A=airframe.matrix_a(),
        B=B,
        C=C,
        gravity=airframe.matrix_gravity(),
        wind=airframe.matrix_gusts(),
        noise=noise,
        kinematic=np.array([float(state in KINEMATIC) for state in airframe.states]),
        size=unit_sizes(airframe.states.values()),
        input_scale=1.0 / np.abs(np.diag(C @ B)),
        D=np.ones(len(columns)),
        lag=loop.lag,
        total_lag=loop.total,
        period=loop.period,
        lower=-unlimited,
        upper=unlimited,
    )
