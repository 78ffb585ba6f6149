# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Provide what several tests build.

This is parameters and truth of the simulated aircraft, and errors of a flight.
"""

from typing import Any

import numpy as np
from tests.closed_loop import error

from aircraft_sim.params import AircraftConfig
from aircraft_sim.simulator import Simulator
from flight_analysis.metrics.errors import error_metrics
from flight_core.tape import Tape
from flight_core.vectors import FloatArray

MS = 1_000_000  # ns


def aircraft_parameters(**values: Any) -> AircraftConfig:
    """Return the osprey at 100 Hz with steps of 2 ms, and with other or further values."""
    return AircraftConfig.validate_mapping(
        {"airframe": "osprey", "rate": 100.0, "step": 0.002} | values, "aircraft"
    )


def truth_of(simulator: Simulator) -> dict[str, float]:
    return dict(zip(simulator.truth_names, simulator.truth(), strict=True))


def rms(tape: Tape) -> FloatArray:
    """Return the rms of the true error over the whole flight, q, V, p, r in mrad/s and m/s."""
    e = error(tape)
    return np.array(
        [
            error_metrics(e[name]).rms * (1.0 if name == "V" else 1e3)
            for name in ("q", "V", "p", "r")
        ]
    )
