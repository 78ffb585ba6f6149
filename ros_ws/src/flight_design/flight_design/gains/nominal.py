# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""The nominal model of an airframe, for observers, filters and model-based laws."""

from collections.abc import Iterable, Sequence

import numpy as np

from aircraft_sim.airframes.airframe import Airframe
from aircraft_sim.uncertainty import KINEMATIC
from control_laws.nominal_model import NominalModel
from flight_core.units import LENGTH, SPEED, quantity
from flight_core.vectors import FloatArray
from rise_di_controller.law.linear_loop import LoopTiming

SIZES = {SPEED: 1.0, LENGTH: 1.0}  # m/s, m: the units of states in weights, "sizes"
ANGLE_SIZE = 0.1  # rad (/s), and of states without a dimension
ERROR_SHARE = 0.1  # of a size: the unit of an error in a score, 0.1 m/s or 0.01 rad/s

ACTIVITY_UNIT = {"deg": np.deg2rad(60.0), "rad": np.deg2rad(60.0), "%": 6.0, "1": 6.0}
"""rad/s and 1/s by the unit of an input: mean abs(u_dot) that costs as much as one unit of error.
60 deg/s and 600 %/s."""


def unit_sizes(units: Iterable[str]) -> FloatArray:
    """Sizes of values with these units."""
    return np.array([SIZES.get(quantity(unit).dimension, ANGLE_SIZE) for unit in units])


def airframe_model(
    airframe: Airframe,
    outputs: Sequence[str],
    inputs: Sequence[str],
    noise: FloatArray,
    loop: LoopTiming,
) -> NominalModel:
    """The model of an airframe with channels in this order, without limits.

    D = I until a caller sets D. Arguments: `noise` of the outputs, (m,), rms per sample, and
    `loop`, in this order.
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
