# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test rate and delay of the body rates from the parameters of PX4."""

import math
from pathlib import Path

import numpy as np
import pytest
from pytest import approx
from scipy.signal import butter, freqz, iirnotch
from tests.conftest import refusing
from tests.vehicle_logs import write_ulog

from flight_cli import gains
from flight_core.parameters import ParameterError
from flight_log.px4_parameters import rate_loop

HEAD = "# Onboard parameters for Vehicle 1\n#\n"


def written(path: Path, **values: float) -> Path:
    rows = [f"1\t1\t{name}\t{value!r}\t9\n" for name, value in values.items()]
    path.write_text(HEAD + "".join(rows))
    return path


def filter_delay(cutoff: float, notches: dict[float, float]) -> float:
    """Return the delay of PX4's digital filters at 8 kHz, from their phase at 1 Hz."""
    sampling = 8000.0
    filters = [butter(2, cutoff, fs=sampling)]
    filters += [iirnotch(f, f / width, fs=sampling) for f, width in notches.items()]
    phase = sum(np.angle(freqz(b, a, worN=[1.0], fs=sampling)[1][0]) for b, a in filters)
    return float(-phase / (2.0 * math.pi))


@pytest.mark.parametrize("notches", [{}, {60.0: 20.0}, {60.0: 20.0, 120.0: 30.0}])
def test_delay_is_the_phase_of_the_filters_and_a_period(
    tmp_path: Path, notches: dict[float, float]
) -> None:
    """At low frequencies, the phase of SciPy's filters is the phase of a delay."""
    values = {"IMU_GYRO_RATEMAX": 250.0, "IMU_GYRO_CUTOFF": 40.0}
    for k, (frequency, width) in enumerate(notches.items()):
        values |= {f"IMU_GYRO_NF{k}_FRQ": frequency, f"IMU_GYRO_NF{k}_BW": width}
    loop = rate_loop(written(tmp_path / "plane.params", **values))
    assert loop.rate == 250.0
    assert loop.delay == approx(filter_delay(40.0, notches) + 0.004, rel=0.01)


def test_defaults_are_those_of_px4(tmp_path: Path) -> None:
    """The cut-off is 40 Hz, and the rate 400 Hz. A law with a lower rate waits longer."""
    path = written(tmp_path / "plane.params", IMU_GYRO_NF0_FRQ=0.0)
    assert rate_loop(path).rate == 400.0
    assert rate_loop(path).delay == approx(0.0056 + 0.0025, abs=5e-5)
    # a tick waits for the next sample of the faster gyro, 2.5 ms at most
    assert rate_loop(path, 200.0).delay == approx(0.0056 + 0.005 + 0.0025, abs=5e-5)


@pytest.mark.parametrize(
    ("logged", "wait"),
    [
        # SITL's gyro has 250 Hz, whatever IMU_GYRO_RATEMAX says
        (250.0, 0.0),
        # a gyro at that parameter, and a log that leaves samples out
        (400.0, 0.0025),
        (50.0, 0.0025),
    ],
)
def test_gyro_is_as_slow_as_its_samples_in_the_log(
    tmp_path: Path, logged: float, wait: float
) -> None:
    path = written(tmp_path / "plane.params", IMU_GYRO_CUTOFF=40.0)
    delay = rate_loop(path, 250.0, logged).delay
    assert delay == approx(filter_delay(40.0, {}) + 0.004 + wait, abs=5e-5)


def test_parameters_come_from_a_ulog(tmp_path: Path) -> None:
    rows = [(1000 * k, (0.0, 0.0, 0.0)) for k in range(1, 20)]
    topics = {"vehicle_angular_velocity": ("float[3] xyz;", rows)}
    write_ulog(tmp_path / "a.ulg", topics, {"IMU_GYRO_CUTOFF": 20.0, "IMU_GYRO_RATEMAX": 800.0})
    loop = rate_loop(tmp_path / "a.ulg")
    assert loop.rate == 800.0
    assert loop.delay == approx(0.01125 + 0.00125, abs=1e-4)


@pytest.mark.parametrize(
    "values, rate, words",
    [
        (
            {"IMU_GYRO_RATEMAX": 250.0},
            400.0,
            "found 400.0, expected at most IMU_GYRO_RATEMAX",
        ),
        ({"FW_RR_P": 0.1}, None, "without IMU_GYRO_ parameters"),
        ({"IMU_GYRO_CUTOFF": math.nan}, None, "found IMU_GYRO_CUTOFF nan, expected 0 or more"),
    ],
)
def test_refuses(tmp_path: Path, values: dict[str, float], rate: float | None, words: str) -> None:
    with refusing(words):
        rate_loop(written(tmp_path / "plane.params", **values), rate)


def test_refuses_a_file_of_another_kind(tmp_path: Path) -> None:
    path = tmp_path / "a.txt"
    path.write_text("hello\n")
    with refusing("which has no rows of parameters"):
        rate_loop(path)
    with refusing("px4: found no file"):
        rate_loop(tmp_path / "none")


def test_gains_take_the_loop_of_a_parameter_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Rate and delay reach the selection. A delay that is given as well is refused."""
    path = written(tmp_path / "plane.params", IMU_GYRO_RATEMAX=250.0, IMU_GYRO_CUTOFF=40.0)
    asked: list[dict[str, object]] = []

    def select(*_: object, **loop: object) -> None:
        asked.append(loop)
        raise ParameterError("stop")

    monkeypatch.setattr(gains, "select_gains", select)
    with refusing("stop"):
        gains.Select(airframe="osprey", px4=path).execute()
    assert asked[0]["rate"] == 250.0
    assert asked[0]["delay"] == approx(0.00963, abs=1e-5)
    with refusing("px4: found --delay beside it"):
        gains.Select(airframe="osprey", px4=path, delay=0.01).execute()
