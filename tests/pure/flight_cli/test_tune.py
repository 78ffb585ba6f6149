# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test `rise-di tune`, from the log of an autopilot to its module.

The logs are of simulated aircraft whose A and B differ from the airframes of the scenarios by 10 to
15 %. They fly doublets of each rate under a rate controller in PX4's form.
"""

import math
import shutil
from pathlib import Path
from typing import NamedTuple
from unittest.mock import Mock

import numpy as np
import pytest
from pytest import approx
from scipy.linalg import expm
from scipy.signal import butter, sosfilt
from tests.conftest import REPOSITORY, invoke, refusing
from tests.vehicle_logs import write_dataflash, write_ulog

from aircraft_sim.airframes.airframe import load_airframe
from flight_analysis.closed_loop.scenario import scenario_yaml
from flight_analysis.closed_loop.scenario_library import find_scenario
from flight_analysis.linear_loop.guarantee import Guarantee
from flight_cli.cli import application
from flight_cli.tune_candidates import Candidate, best_of
from flight_cli.tune_page import guaranteed
from flight_core.vectors import FloatArray
from flight_design.identification.own_loop import own_loop
from flight_design.identification.rates_model import banking

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(shutil.which("gcc") is None, reason="no gcc, which export looks for"),
]
app = application(["tune", "gains", "export"])
PX4 = REPOSITORY / "examples" / "px4_airplane" / "rates.yaml"
PLANE = REPOSITORY / "examples" / "arduplane" / "rates.yaml"
STEPS = 8  # of the aircraft in a period
EFFECT, DAMPING = 0.85, 1.1  # of the row of B, and of the damping of each rate, over the nominal
CUTOFF = 40.0  # Hz, of the filter of PX4's gyro
APART = 3.0  # s, from a doublet to the next, which lasts 1 s


class Gains(NamedTuple):
    """Gains of the autopilot by output of the airframe: torque per rad/s, rad/s, rad."""

    FF: tuple[float, ...]
    P: tuple[float, ...]
    I: tuple[float, ...]  # noqa: E741 - as the parameters are named


class Flight(NamedTuple):
    """The y, rad/s, and the torque of a flight, one row for each stamp."""

    stamp_us: list[int]
    y: FloatArray
    torque: FloatArray


def flown(
    scenario: Path,
    gains: Gains,
    size: tuple[float, ...],
    noise: tuple[float, ...],
    length: float,
    cutoff: float,
    **effects: float,
) -> Flight:
    """Return a flight with doublets of the given sizes, rad/s.

    The gyro is behind a filter with the cut-off frequency, Hz. The row of B of a rate is `effects`
    times the nominal one, and EFFECT times it if the rate is not named.
    """
    flight = find_scenario(str(scenario))
    airframe = banking(load_airframe(flight.aircraft.airframe))
    A, B = airframe.matrix_a(), airframe.matrix_b()
    for name in airframe.outputs:  # mass and lift fix the other rows
        A[airframe.index(name), airframe.index(name)] *= DAMPING
        B[airframe.index(name)] *= effects.get(name, EFFECT)
    C = airframe.matrix_c()
    n, m = B.shape
    # PX4's simulator has no servo: the lag of the scenario stands for the filter
    lag = 1e-6 if scenario == PX4 else flight.aircraft.actuators.lag[0]
    end = np.array(flight.aircraft.actuators.upper)
    period = 1.0 / flight.controller.rate
    both = expm(np.block([[A, B], [np.zeros((m, n + m))]]) * period / STEPS)
    # In a step the position of the servos moves first: x and the position, and u beside them.
    fading = math.exp(-period / STEPS / lag)
    moved = np.block([[np.eye(n), np.zeros((n, m))], [np.zeros((m, n)), fading * np.eye(m)]])
    driven = np.vstack([np.zeros((n, m)), (1.0 - fading) * np.eye(m)])
    step = np.block([[both @ moved, both @ driven], [np.zeros((m, n + m)), np.eye(m)]])
    over_period = np.linalg.matrix_power(step, STEPS)[: n + m]
    rng = np.random.default_rng(3)
    state = np.zeros(n + m)
    integral = late = np.zeros(m)
    sections = butter(2, cutoff, fs=1.0 / period, output="sos")
    memory = np.zeros((1, 2, m))
    count = int(length / period)
    y, torque = np.zeros((count, m)), np.zeros((count, m))
    for k in range(count):
        number, phase = divmod(k * period, APART)
        setpoint = np.zeros(m)
        axis = int(number) % m
        setpoint[axis] = size[axis] * ((phase < 0.5) - (0.5 <= phase < 1.0))
        y[k] = C @ state[:n] + np.array(noise) * rng.normal(size=m)
        y[k : k + 1], memory = sosfilt(sections, y[k : k + 1], axis=0, zi=memory)
        error = setpoint - late
        late = y[k]
        integral = np.clip(integral + np.array(gains.I) * error * period, -0.4, 0.4)
        command = np.array(gains.FF) * setpoint + np.array(gains.P) * error + integral
        torque[k] = np.clip(command, -1.0, 1.0)
        state = over_period @ np.concatenate([state, end * torque[k]])
    stamps = [1_000_000 + round(1e6 * period) * k for k in range(count)]
    return Flight(stamps, y, torque)


PX4_GAINS = Gains((0.331, 0.206, 0.259), (0.086, 0.05, 0.4155), (1.19, 2.95, 10.0))  # q, p, r


def px4_log(
    path: Path,
    size: tuple[float, ...],
    length: float,
    noise: tuple[float, ...] = (0.02, 0.04, 0.01),
    *,
    still: int | None = None,
    lost: slice = slice(0, 0),
    every: int = 1,
    **effects: float,
) -> Path:
    """Return a ULog at 250 Hz. The noise of the gyro, rad/s, is added before its filter.

    PX4 does not control the rate with the number `still`. The log lacks the samples `lost`, and has
    every `every`-th torque.
    """
    own = PX4_GAINS
    if still is not None:
        own = Gains(*((*gains[:still], 0.0, *gains[still + 1 :]) for gains in PX4_GAINS))
    flight = flown(PX4, own, size, noise, length, CUTOFF, **effects)
    axes = [1, 0, 2]  # of PX4: roll, pitch, yaw
    ones = np.ones((len(flight.y), 1))

    def rows(values: FloatArray) -> list[tuple[int, FloatArray]]:
        samples = list(zip(flight.stamp_us, values, strict=True))
        return samples[: lost.start] + samples[lost.stop :]

    topics = {
        "vehicle_angular_velocity": ("float[3] xyz;", rows(flight.y[:, axes])),
        "vehicle_torque_setpoint": ("float[3] xyz;", rows(flight.torque[:, axes])[::every]),
        "airspeed_validated": ("float true_airspeed_m_s;", rows(11.5 * ones)),
    }
    yaw = {"FW_ACRO_YAW_EN": float(still is None)}
    parameters = yaw | {
        "IMU_GYRO_RATEMAX": 250.0,
        "IMU_GYRO_CUTOFF": CUTOFF,
        "FW_AIRSPD_TRIM": 11.5,
    }
    for k, axis in enumerate("PRY"):
        gains = {"FF": PX4_GAINS.FF[k], "P": PX4_GAINS.P[k], "I": PX4_GAINS.I[k], "IMAX": 0.4}
        parameters |= {f"FW_{axis}R_{name}": value for name, value in gains.items()}
    write_ulog(path, topics, parameters)
    return path


def ardupilot_log(path: Path, length: float) -> Path:
    """Write a DataFlash log whose servos 1 and 2 are aileron and elevator, 1000 to 2000 us.

    ArduPlane logs the gyro at the rate of its loop, 200 Hz, and the servos at 25 Hz.
    """
    gains = Gains((0.25, 0.2), (0.3, 0.2), (0.5, 0.5))
    flight = flown(PLANE, gains, (0.3, 0.6), (0.01, 0.01), length, 20.0, q=0.9, p=0.9)
    pulses = 1500.0 + 500.0 * flight.torque[:, [1, 0]]
    stamps = flight.stamp_us
    gyro = np.column_stack([flight.y[:, 1], flight.y[:, 0], np.zeros(len(stamps))])
    speed = [(stamp, (23.9, 1.0)) for stamp in stamps]
    messages = {
        "MODE": (("Mode", "ModeNum"), [(1, (5.0, 5.0))]),
        "IMU": (("GyrX", "GyrY", "GyrZ"), list(zip(stamps, gyro, strict=True))),
        "CTUN": (("As", "E2T"), speed),
        "RCOU": (("C1", "C2"), list(zip(stamps, pulses, strict=True))[::8]),
    }
    parameters = {"SCALING_SPEED": 23.9, "INS_GYRO_FILTER": 20.0}
    for number, function in ((1, 4.0), (2, 19.0)):
        limits = {"MIN": 1000.0, "MAX": 2000.0, "TRIM": 1500.0, "REVERSED": 0.0}
        parameters |= {f"SERVO{number}_{name}": value for name, value in limits.items()}
        parameters |= {f"RC{number}_{name}": value for name, value in limits.items()}
        parameters[f"SERVO{number}_FUNCTION"] = function
    factor = math.radians(45.0)  # a gain of 1 gives rad, 45 deg are the torque 1
    for k, axis in enumerate(("PTCH", "RLL")):
        values = {"FF": gains.FF[k], "P": gains.P[k], "I": gains.I[k]}
        parameters |= {f"{axis}_RATE_{name}": factor * value for name, value in values.items()}
    write_dataflash(path, messages, parameters, "ArduPlane V4.7.0 (1f2e3d4c)")
    return path


@pytest.fixture(autouse=True)
def _in_repository(monkeypatch: pytest.MonkeyPatch) -> None:
    """Change to the folder from which the scenarios name their airframes."""
    monkeypatch.chdir(REPOSITORY)


def brief(scenario: Path, folder: Path, **size: float) -> Path:
    """Return a scenario with one doublet of each output, in 4 or 5 s in place of 20 s."""
    doublets = {
        name: {"start": [0.5 + 1.5 * number], "width": [0.5], "value": [value]}
        for number, (name, value) in enumerate(size.items())
    }
    flight = find_scenario(str(scenario)).vary(
        flight={"duration": 0.5 + 1.5 * len(size)},
        reference_model={"pulses": {}, "doublets": doublets},
    )
    path = folder / "brief.yaml"
    path.write_text(scenario_yaml(flight))
    return path


def errors(output: str, air: str, name: str) -> FloatArray:
    """Return the errors of a controller in an air, from a table of `tune`, mrad/s."""
    lines = [line for line in output.splitlines() if f"{air}: " in line and name in line]
    (row,) = [line.split()[-3:] for line in lines]
    return np.array([float(cell) for cell in row])


class StoppedError(Exception):
    """Raised at the end of the part of the command that is tested."""


def test_log_of_px4_becomes_a_module_and_the_next_log_another_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The log shows the effects of the simulated aircraft, 15 % less than in the scenario.

    So the errors fall with the new gains.
    """
    pytest.importorskip("pyulog", reason="pyulog is not installed: make autopilot")
    log = px4_log(tmp_path / "flight.ulg", (0.3, 0.6, 0.2), 36.0)
    folder = tmp_path / "first"
    words = ["tune", str(log), "--px4", str(folder), "--calm", "--no-proof", "--lag", "0"]
    result = invoke(*words, "--scenario", brief(PX4, tmp_path, q=0.3, p=0.6, r=0.2))
    holds = "every aircraft is stable by the guarantee" in result.output
    assert result.exit_code == (0 if holds else 1), result.output
    nominal = load_airframe(str(REPOSITORY / "examples/px4_airplane/rates_airframe.yaml"))
    found = load_airframe(str(folder / "airframe.yaml"))
    for row, column in (("q", 0), ("p", 1), ("r", 2)):
        ratio = found.matrix_b()[found.index(row), column]
        ratio /= nominal.matrix_b()[nominal.index(row), column]
        # a mean over 8 ms in place of 4 ms, and a filter that stands for a delay
        assert ratio == approx(EFFECT, abs=0.08), row
    # alpha and beta are not in y: mass and lift, which move them, are believed
    rows = [nominal.index("alpha"), nominal.index("beta")]
    assert np.array_equal(found.matrix_a()[rows], nominal.matrix_a()[rows])
    scenario = find_scenario(str(folder / "scenario.yaml"))
    feedforward = scenario.rise_di().feedforward
    assert feedforward is not None
    assert scenario.rise_di().delay == approx(0.00963, abs=1e-5)  # of the log: filter and period
    # --lag reaches the controller and the aircraft, and the feedforward leads by half a period
    assert scenario.rise_di().lag == (0.0, 0.0, 0.0)
    assert scenario.aircraft.actuators.lag == (0.0, 0.0, 0.0)
    # As the gyro has it at 250 Hz, though every second sample is identified. Of 4,500 samples the
    # estimate scatters by 2 %, and the filter takes 3 % of the noise. That of r is the least one.
    assert scenario.aircraft.sensors.noise[:2] == approx((0.02, 0.04), rel=0.1)
    assert feedforward.lead == (0.002, 0.002, 0.002)
    assert (folder / "src" / "modules" / "rise_di_control" / "RiseDiControl.cpp").is_file()
    page = (folder / "tuning.html").read_text("utf-8")
    assert "set RDI_EN to 1" in page
    assert "To go back: RDI_EN 0" in page
    assert "FW_RR_FF 0.206, P 0.05, I 2.95" in page
    assert "Margins of the own loop" in page
    # Every rate is closer to its reference than under the loop of the log.
    module = errors(result.output, "calm", "the module")
    assert np.all(module < 0.9 * errors(result.output, "calm", "own loop"))
    words[3] = str(tmp_path / "second")
    chosen = Mock(side_effect=StoppedError)
    monkeypatch.setattr("flight_cli.tune.best_of", chosen)
    # Their margins are those of the first time.
    monkeypatch.setattr("flight_cli.tune_candidates.check_gains", Mock(return_value=Mock(unmet=())))
    next_result = invoke(*words, "--scenario", str(folder / "scenario.yaml"))
    assert isinstance(next_result.exception, StoppedError), next_result.output
    former, of_aircraft, new = chosen.call_args.args[0]
    # The same log chooses the same gains again, and nearly the same feedforward. A selection of new
    # gains on the same aircraft finds nothing that is better by more than this.
    assert former.score == approx(of_aircraft.score, rel=0.02)
    assert former.score < 1.02 * new.score


def test_part_that_the_log_does_not_improve_stays_nominal_and_is_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In the noise of PX4's simulator, doublets of q of 0.15 rad/s do not show 10 % of B."""
    pytest.importorskip("pyulog", reason="pyulog is not installed: make autopilot")
    monkeypatch.setattr("flight_cli.tune.candidates", Mock(side_effect=StoppedError))
    log = px4_log(tmp_path / "flight.ulg", (0.15, 0.6, 0.2), 36.0, (0.07, 0.14, 0.028), q=0.9)
    folder = tmp_path / "module"
    words = ["tune", str(log), "--px4", str(folder), "--calm", "--no-proof", "--lag", "0"]
    result = invoke(*words, "--scenario", str(PX4))
    assert isinstance(result.exception, StoppedError), result.output
    assert "warning: q: held-out samples: found a log-likelihood of" in result.output
    assert "the model stays nominal" in result.output
    nominal = load_airframe(str(REPOSITORY / "examples/px4_airplane/rates_airframe.yaml"))
    found = load_airframe(str(folder / "airframe.yaml"))
    q, p = found.index("q"), found.index("p")
    ratio = found.matrix_b()[[q, p], [0, 1]] / nominal.matrix_b()[[q, p], [0, 1]]
    assert ratio[0] == approx(1.0, rel=1e-5)
    assert ratio[1] == approx(EFFECT, abs=0.08)


def test_log_without_motion_names_the_doublets_to_fly(tmp_path: Path) -> None:
    pytest.importorskip("pyulog", reason="pyulog is not installed: make autopilot")
    log = px4_log(tmp_path / "flight.ulg", (0.0, 0.0, 0.0), 20.0)
    words = ["tune", str(log), "--px4", str(tmp_path / "module"), "--scenario", str(PX4)]
    with refusing(
        r"q: found that elevator explains .* of its motion, expected 5 %; p: found a peak of .*"
        r"; fly, 2 s apart, q: 3 doublets of 0.3 rad/s, 0.5 s each way, then p: "
    ):
        invoke(*words, catch_exceptions=False)
    assert not (tmp_path / "module").exists()


def test_log_without_yaw_control_names_the_parameter_before_any_search(tmp_path: Path) -> None:
    """The log has doublets of p and q but no torque about yaw.

    This is so with PX4's default of FW_ACRO_YAW_EN.
    """
    pytest.importorskip("pyulog", reason="pyulog is not installed: make autopilot")
    log = px4_log(tmp_path / "flight.ulg", (0.3, 0.6, 0.0), 30.0, still=2)
    words = ["tune", str(log), "--px4", str(tmp_path / "module"), "--scenario", str(PX4)]
    with refusing(
        r"r: found that rudder explains .* of its motion, expected 5 %; set FW_ACRO_YAW_EN to 1"
        r".*; fly, 2 s apart, r: 3 doublets of "
    ):
        invoke(*words, catch_exceptions=False)
    assert not (tmp_path / "module").exists()


def test_log_with_rare_torques_names_the_profile_before_any_search(tmp_path: Path) -> None:
    """The torques are as rare as with PX4's default of SDLOG_PROFILE."""
    pytest.importorskip("pyulog", reason="pyulog is not installed: make autopilot")
    log = px4_log(tmp_path / "flight.ulg", (0.3, 0.6, 0.2), 20.0, every=5)
    words = ["tune", str(log), "--px4", str(tmp_path / "module"), "--scenario", str(PX4)]
    with refusing(
        r"torque: found a sample each 20 ms, of a loop of 250 Hz, expected each one: set "
        "SDLOG_PROFILE to 17"
    ):
        invoke(*words, catch_exceptions=False)


def test_log_with_holes_is_told_as_one(tmp_path: Path) -> None:
    pytest.importorskip("pyulog", reason="pyulog is not installed: make autopilot")
    log = px4_log(tmp_path / "flight.ulg", (0.3, 0.6, 0.2), 30.0, lost=slice(2000, 4000))
    words = ["tune", str(log), "--px4", str(tmp_path / "module"), "--scenario", str(PX4)]
    with refusing(
        r"holes: found y lacks 2000 of 7500 samples: the longest gap, 8 s, .*, expected at most 10 "
        r"%: a part of the log without holes, by --from and --until"
    ):
        invoke(*words, catch_exceptions=False)


def test_controller_of_the_scenario_is_kept_where_it_is_better() -> None:
    """The candidate with the least error wins.

    A candidate without the margins is named, but not taken.
    """
    scenario = find_scenario(str(PX4))
    calm, gusty = np.array([10.0, 10.0]), np.array([100.0, 100.0])

    def candidate(name: str, factor: float, shortfall: str = "") -> Candidate:
        rms = {"calm": calm, "gusts": factor * gusty}
        return Candidate(name=name, scenario=scenario, origin="", shortfall=shortfall, rms=rms)

    former, worse, better = candidate("old", 1.0), candidate("worse", 1.2), candidate("new", 0.8)
    assert best_of([former, worse], accept=False) is former
    assert best_of([former, worse, better], accept=False) is better
    short = candidate("short", 0.5, "phase margin")
    assert best_of([former, better, short], accept=False) is better
    assert best_of([former, better, short], accept=True) is short
    with refusing("gains: found short: phase margin, expected --accept"):
        best_of([short], accept=False)


def test_airframe_without_effect_of_wind_is_tuned_without_an_observer(tmp_path: Path) -> None:
    """A multicopter has no effects of wind, so an observer would have no wind to estimate."""
    airframe = (REPOSITORY / "examples/px4_airplane/rates_airframe.yaml").read_text("utf-8")
    (tmp_path / "airframe.yaml").write_text(airframe.partition("gusts:")[0])
    scenario = find_scenario(str(PX4)).vary(aircraft={"airframe": str(tmp_path / "airframe.yaml")})
    (tmp_path / "rates.yaml").write_text(scenario_yaml(scenario))
    words = ["tune", "no.ulg", "--px4", str(tmp_path / "module"), "--scenario"]
    with refusing("found no gusts, expected --calm: an observer estimates the wind"):
        invoke(*words, str(tmp_path / "rates.yaml"), catch_exceptions=False)


def test_missing_log_leaves_no_folder(tmp_path: Path) -> None:
    folder = tmp_path / "module"
    with refusing("no.ulg: found no such file"):
        invoke(
            *("tune", str(tmp_path / "no.ulg"), "--px4", str(folder), "--scenario", str(PX4)),
            catch_exceptions=False,
        )
    assert not folder.exists()


def test_log_of_arduplane_becomes_a_task(tmp_path: Path) -> None:
    pytest.importorskip("pymavlink", reason="pymavlink is not installed: make autopilot")
    log = ardupilot_log(tmp_path / "flight.bin", 48.0)
    folder = tmp_path / "task"
    scenario = brief(PLANE, tmp_path, q=0.15, p=0.3)
    words = ["tune", str(log), "--ardupilot", str(folder), "--scenario", str(scenario), "--calm"]
    result = invoke(*words, "--float32", "--no-proof", "--accept")
    assert result.exit_code in (0, 1), result.output
    assert (folder / "ArduPlane" / "rise_di.cpp").is_file()
    nominal = load_airframe(str(REPOSITORY / "examples/arduplane/rates_airframe.yaml"))
    found = load_airframe(str(folder / "airframe.yaml"))
    for row, column in (("q", 0), ("p", 1)):
        ratio = found.matrix_b()[found.index(row), column]
        ratio /= nominal.matrix_b()[nominal.index(row), column]
        assert ratio == approx(0.9, abs=0.1), row
    assert "RLL_RATE_FF" in (folder / "tuning.html").read_text("utf-8")


@pytest.mark.parametrize("lag", ["0.01,0.02", "-1", "nan", "a"])
def test_lags_are_those_of_the_inputs(tmp_path: Path, lag: str) -> None:
    words = ["tune", "no.ulg", "--px4", str(tmp_path / "module"), "--scenario", str(PX4)]
    with refusing("lag: found"):
        invoke(*words, "--lag", lag, catch_exceptions=False)


@pytest.mark.parametrize("options", [[], ["--px4", "a", "--ardupilot", "b"]])
def test_one_autopilot_is_named(tmp_path: Path, options: list[str]) -> None:
    result = invoke("tune", str(tmp_path / "no.ulg"), "--scenario", str(PX4), *options)
    assert result.exit_code == 2
    assert "--px4 FOLDER or --ardupilot FOLDER" in result.output


@pytest.mark.parametrize("ratio", [1.0, 2.0])
def test_gains_of_arduplane_are_an_angle_of_45_deg_at_full_torque(ratio: float) -> None:
    """P and I follow the square of SCALING_SPEED over the trim speed, and FF follows the ratio.

    The gains give full torque for an angle of 45 deg.
    """
    scenario = find_scenario(str(PLANE))
    parameters = {"SCALING_SPEED": ratio * 23.9}
    for axis in ("PTCH", "RLL"):
        gains = dict.fromkeys(("FF", "P", "I"), math.radians(45.0))
        parameters |= {f"{axis}_RATE_{name}": value for name, value in gains.items()}
    loop = own_loop(parameters, scenario, "ardupilot")
    assert loop is not None
    assert approx([ratio, ratio]) == loop.FF
    assert approx([ratio**2] * 2) == loop.P
    assert approx([ratio**2] * 2) == loop.I
    del parameters["RLL_RATE_P"]
    assert own_loop(parameters, scenario, "ardupilot") is None


def test_deviations_that_are_covered_are_rounded_down() -> None:
    """A proof that covers 1.98 standard deviations does not cover 2."""
    guarantee = Guarantee(
        uncertainty=0.5, stable=0.495, unstable=None, disk={}, disk_all=0.0, loop=""
    )
    sentence = guaranteed(guarantee)
    assert "an aircraft may be unstable" in sentence
    assert sentence.endswith("which covers 1.9 of them")
