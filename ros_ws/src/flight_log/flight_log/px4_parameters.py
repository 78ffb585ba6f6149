# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Derive the rate of PX4's body-rate loop and the delay of its gyro filters from PX4's parameters.

Sources: PX4 guide, "MC Filter Tuning and Control Latency", and parameter reference; the parameter
file of QGroundControl: vehicle, component, name, value, type.
"""

import math
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import NamedTuple

from flight_core.files import read_file
from flight_core.parameters import require
from flight_log.file_kinds import FileKind, file_kind
from flight_log.vehicle_log import read_foreign_log

DEFAULTS: Mapping[str, float] = MappingProxyType(
    {
        "IMU_GYRO_RATEMAX": 400.0,
        "IMU_GYRO_CUTOFF": 40.0,
        "IMU_GYRO_NF0_FRQ": 0.0,
        "IMU_GYRO_NF0_BW": 20.0,
        "IMU_GYRO_NF1_FRQ": 0.0,
        "IMU_GYRO_NF1_BW": 20.0,
    }
)
"""Values of PX4 1.16 for parameters that a file leaves out."""

EXPECTED = "a parameter file of QGroundControl, or a ULog"
COLUMNS = 5  # number of columns in a row of a parameter file
# if the gyro is faster than the law by more than this factor, its samples are interpolated
# (rise_di_rates.c)
LIKE_PART = 1.05


class RateLoop(NamedTuple):
    """The timing of a law inside PX4."""

    rate: float  # rate of the law, Hz
    delay: float  # delay from the rates to the torque, s
    filters: float  # part of the delay that the filters of the gyro cause, s
    origin: str  # the file and the settings from which the numbers come


def rate_loop(path: Path, rate: float | None = None, logged: float = 0.0) -> RateLoop:
    """Return the timing of a law at `rate`, Hz, by default the rate of the gyro.

    The rate of the gyro is IMU_GYRO_RATEMAX. Samples of the gyro may be `logged` at a lower rate,
    Hz. If this lower rate suffices for the law, it is used as the rate of the gyro.

        delay = 1 / (sqrt(2) pi f) + sum_k b_k / (2 pi f_k^2) + 1 / rate + wait

    f is the cut-off of a second-order Butterworth filter, and the notches have the frequency f_k
    and the width b_k. If the gyro is faster than the law, a tick waits for the next sample, and
    `wait` is a period of the gyro. Otherwise `wait` is 0. Raises ParameterError if `rate` is above
    the rate of the gyro, or if the file cannot be read.
    """
    values = {**DEFAULTS, **_read(path)}
    fastest = values["IMU_GYRO_RATEMAX"]
    design_rate = fastest if rate is None else rate
    if design_rate <= LIKE_PART * logged < fastest:
        fastest = max(logged, design_rate)
    require(
        0.0 < design_rate <= fastest,
        "rate",
        design_rate,
        f"at most IMU_GYRO_RATEMAX, {fastest:g} Hz",
    )
    cutoff = values["IMU_GYRO_CUTOFF"]
    delay = low_pass_delay(cutoff)
    words = f"cut-off {cutoff:g} Hz" if cutoff > 0.0 else "no cut-off"
    for name in ("IMU_GYRO_NF0", "IMU_GYRO_NF1"):
        frequency = values[f"{name}_FRQ"]
        if frequency > 0.0:
            width = values[f"{name}_BW"]
            delay += width / (2.0 * math.pi * frequency**2)
            words += f", notch {frequency:g} Hz"
    filters = delay
    delay += 1.0 / design_rate
    if fastest > LIKE_PART * design_rate:
        delay += 1.0 / fastest
    origin = f"{path.name}: gyro at {fastest:g} Hz, {words}; delay {1e3 * delay:.3g} ms"
    return RateLoop(rate=design_rate, delay=delay, filters=filters, origin=origin)


def low_pass_delay(cutoff: float) -> float:
    """Compute the delay of a second-order Butterworth low-pass, 1 / (sqrt(2) pi f), s.

    The delay is 0 for a cut-off of 0 Hz, which means that there is no filter.
    """
    return 1.0 / (math.sqrt(2.0) * math.pi * cutoff) if cutoff > 0.0 else 0.0


def _read(path: Path) -> dict[str, float]:
    """Read the parameters of DEFAULTS that are in a file.

    Raises ParameterError if there is no such file, if it has no parameters, none of DEFAULTS, or
    one of DEFAULTS that is negative or infinite.
    """
    require(path.is_file(), "px4", f"no file {path}", EXPECTED)
    if file_kind(path) is FileKind.ULOG:
        parameters = read_foreign_log(path).parameters
        values = {name: records[-1].value for name, records in parameters.items()}
    else:
        lines = read_file(path, "px4", EXPECTED).decode("utf-8", "replace").splitlines()
        rows = [line.split("\t") for line in lines if line and not line.startswith("#")]
        is_table = bool(rows) and all(len(row) >= COLUMNS and _is_number(row[3]) for row in rows)
        require(is_table, "px4", f"{path}, which has no rows of parameters", EXPECTED)
        values = {row[2]: float(row[3]) for row in rows}
    defaults = {name: value for name, value in values.items() if name in DEFAULTS}
    require(bool(defaults), "px4", f"{path} without IMU_GYRO_ parameters", EXPECTED)
    wrong = [f"{name} {value}" for name, value in defaults.items() if not 0.0 <= value < math.inf]
    require(not wrong, "px4", ", ".join(wrong), "0 or more")
    return defaults


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True
