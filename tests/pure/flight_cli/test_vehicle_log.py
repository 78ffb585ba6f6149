# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test `rise-di import`: a flight in each format of logs gives its y and u.

It also gives Omega of the aircraft.
"""

import json
import re
import struct
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
import pytest
import yaml
from numpy.testing import assert_array_equal
from pymavlink import DFReader
from pymavlink.dialects.v20 import ardupilotmega as mavlink
from pytest import approx
from tests.conftest import REPOSITORY, invoke, refusing
from tests.maps import named_map
from tests.vehicle_logs import Changes, write_dataflash, write_tlog, write_ulog
from typer.testing import Result

from autopilot_bridge.params import ChannelMap
from flight_cli.log_options import warn_of_lacks_in
from flight_core import isolated
from flight_core.rates import seconds
from flight_core.vectors import FloatArray
from flight_design.identification.log_import import require_map_of_import
from flight_design.identification.response_identification import MIN_RATIO
from flight_design.identification.sign_check import recorded_response
from flight_log.file_kinds import FileKind, file_kind
from flight_log.tape_reader import read_run
from flight_log.vehicle_log import read_vehicle_log
from flight_log.vehicle_tables import Reason, Taken
from flight_view.flight import Flight as View

pytestmark = pytest.mark.slow

OUTPUTS = ("q", "V", "p", "r")
INPUTS = ("elevator", "thrust", "aileron", "rudder")
OMEGA = np.array([40.0, 8.0, 80.0, 30.0])  # SI, by channel
DAMPING = np.array([6.0, 0.3, 8.0, 3.0])  # 1/s
# rad as in the maps ardupilot and px4; m/s; throttle in trim.
FULL, SPEED, THROTTLE = (0.523599, 25.0, 0.5)
EPOCH = 1_790_000_000_000_000  # us since 1970, of a tlog
GROUND, DURATION, RATE = 5.0, 12.0, 50  # s on the ground before the flight, s, Hz
LAG = 0.05  # s, of the servos


class Flight(NamedTuple):
    """A flight by known equations.

    It has stamps, us, y with V as the deviation from the trim speed, and u.
    """

    stamp_us: list[int]
    y: FloatArray  # (N, 4)
    u: FloatArray


@pytest.fixture(autouse=True)
def _in_this_process(monkeypatch: pytest.MonkeyPatch) -> None:
    """Decode logs in this process.

    test_foreign_logs.py tests the process of their own.
    """
    monkeypatch.setattr(isolated, "call", lambda function, *arguments, **_: function(*arguments))


@pytest.fixture(scope="module")
def flight() -> Flight:
    """Return a flight of DURATION."""
    return flown(DURATION)


@pytest.fixture(scope="module")
def long_flight() -> Flight:
    """Return a flight of 20 s, which is long enough to show Omega."""
    return flown(24.0)


def flown(duration: float) -> Flight:
    """Return first-order channels y_dot = -damping y + Omega v with held random inputs.

    The servos are v_dot = (u - v) / lag.
    """
    random = np.random.default_rng(1)
    steps = round(duration * RATE)
    dt = 1.0 / RATE
    held = np.repeat(random.choice([-1.0, 0.0, 1.0], (steps // 15 + 1, 4)), 15, axis=0)[:steps]
    u = held * [0.04, 0.1, 0.04, 0.06]
    y = np.zeros((steps, 4))
    v = np.zeros(4)
    for k in range(1, steps):
        v += (u[k - 1] - v) * -np.expm1(-dt / LAG)
        y[k] = y[k - 1] + dt * (OMEGA * v - DAMPING * y[k - 1])
    y += random.normal(0.0, [0.002, 0.01, 0.002, 0.002], y.shape)
    return Flight([round(1e6 * (1.0 + GROUND + k * dt)) for k in range(steps)], y, u)


def sticks(u: FloatArray) -> FloatArray:
    """Return the pulses of roll, pitch, throttle and yaw, us, as the map ardupilot has them.

    They are between RCn_MIN 1000 and RCn_MAX 2000.
    """
    elevator, thrust, aileron, rudder = u.T
    surfaces = (1500.0 + 500.0 * surface / FULL for surface in (aileron, elevator, rudder))
    roll, pitch, yaw = surfaces
    return np.column_stack([roll, pitch, 1000.0 + 1000.0 * (THROTTLE + thrust), yaw])


def on_ground(flight: Flight) -> Flight:
    """Return a time at rest before the flight, at the same rate."""
    count = round(GROUND * RATE)
    still = np.zeros((count, 4))
    still[:, 1] = -SPEED
    return Flight(
        [round(1e6 * (1.0 + k / RATE)) for k in range(count)], still, np.zeros((count, 4))
    )


# us, those of the map ardupilot.
ENDS = {"MIN": 1000.0, "TRIM": 1500.0, "MAX": 2000.0, "REVERSED": 0.0}
AXES = ("ROLL", "PITCH", "THROTTLE", "YAW")
PARAMETERS = {
    **{f"RCMAP_{axis}": float(number) for number, axis in enumerate(AXES, start=1)},
    **{
        f"SERVO{number}_FUNCTION": function
        for number, function in enumerate((4.0, 19.0, 70.0, 21.0), start=1)
    },
    **{
        f"{kind}{number}_{end}": value
        for kind in ("RC", "SERVO")
        for number in range(1, 5)
        for end, value in ENDS.items()
    },
    "SERVO2_REVERSED": 1.0,
}


def dataflash(
    path: Path,
    flight: Flight,
    mode: int = 0,
    parameters: Mapping[str, float] = PARAMETERS,
    changes: Changes = (),
) -> Path:
    """Write a log of ArduPlane.

    The servos follow the sticks as RCn_REVERSED and SERVOn_REVERSED of the first parameters say.
    """
    parts = (on_ground(flight), flight)
    stamps = [stamp for part in parts for stamp in part.stamp_us]
    y = np.concatenate([part.y for part in parts])
    pulses = np.concatenate([sticks(part.u) for part in parts])
    servos = pulses.copy()
    for column, number in enumerate(range(1, 5)):
        if parameters.get(f"RC{number}_REVERSED", 0.0) != parameters.get(
            f"SERVO{number}_REVERSED", 0.0
        ):
            servos[:, column] = 3000.0 - servos[:, column]
    speed = y[:, [1]] + SPEED
    messages = {
        "MODE": (("Mode", "ModeNum"), [(1, (mode, mode))]),
        "IMU": (("GyrX", "GyrY", "GyrZ"), list(zip(stamps, y[:, [2, 0, 3]], strict=True))),
        "CTUN": (
            ("As", "E2T"),
            list(
                zip(stamps, np.column_stack([speed / 1.05, np.full(len(speed), 1.05)]), strict=True)
            ),
        ),
        "ATT": (("Roll", "Pitch", "Yaw"), [(stamp, (5.0, -2.0, 350.0)) for stamp in stamps]),
        "RCIN": (("C1", "C2", "C3", "C4"), list(zip(stamps, pulses, strict=True))),
        "RCOU": (("C1", "C2", "C3", "C4"), list(zip(stamps, servos, strict=True))),
    }
    write_dataflash(path, messages, parameters, "ArduPlane V4.6.0 (1f2e3d4c)", changes)
    return path


def multicopter(path: Path, flight: Flight, firmware: str = "ArduCopter V4.5.7 (2a3dc4b7)") -> Path:
    """Write the flight as a log of a multicopter in STABILIZE.

    This mode has the same number as MANUAL of a plane.
    """
    parts = (on_ground(flight), flight)
    stamps = [stamp for part in parts for stamp in part.stamp_us]
    y = np.concatenate([part.y for part in parts])
    u = np.concatenate([part.u for part in parts])
    lift = u[:, 1] + THROTTLE * (np.array(stamps) >= flight.stamp_us[0])
    messages = {
        "MODE": (("Mode", "ModeNum"), [(1, (0, 0))]),
        "IMU": (("GyrX", "GyrY", "GyrZ"), list(zip(stamps, y[:, [2, 0, 3]], strict=True))),
        "XKF1": (("VD",), list(zip(stamps, -y[:, [1]], strict=True))),
        "RATE": (
            ("POut", "ROut", "YOut", "AOut"),
            list(zip(stamps, np.column_stack([u[:, [0, 2, 3]], lift]), strict=True)),
        ),
    }
    write_dataflash(path, messages, {}, firmware)
    return path


def tlog(
    path: Path,
    flight: Flight,
    parameters: Mapping[str, float] = MappingProxyType({}),
    system: int = 1,
) -> Path:
    messages: list[tuple[int, Any]] = [
        (EPOCH, mavlink.MAVLink_heartbeat_message(1, 3, 128, 0, 4, 3))
    ]
    count = len(parameters)
    for index, (name, value) in enumerate(parameters.items()):
        messages.append(
            (EPOCH, mavlink.MAVLink_param_value_message(name.encode(), value, 9, count, index))
        )
    for part in (on_ground(flight), flight):
        for stamp, y, pulses in zip(
            part.stamp_us, part.y, np.rint(sticks(part.u)).astype(int).tolist(), strict=True
        ):
            ms = stamp // 1000
            at = EPOCH + stamp
            messages.append(
                (at, mavlink.MAVLink_attitude_message(ms, 0.1, -0.03, -0.2, y[2], y[0], y[3]))
            )
            messages.append(
                (at, mavlink.MAVLink_vfr_hud_message(y[1] + SPEED, 0.0, 0, 50, 0.0, 0.0))
            )
            channels = [*pulses, *[0] * 14]
            messages.append((at, mavlink.MAVLink_rc_channels_message(ms, 16, *channels, 0)))
    write_tlog(path, messages, system)
    return path


def stamped(flight: Flight, values: FloatArray) -> list[tuple[int, FloatArray]]:
    return list(zip(flight.stamp_us, values, strict=True))


def ulog(path: Path, flight: Flight, changes: Changes = (), *, vtol: bool = False) -> Path:
    """Write a log of PX4.

    A VTOL flies the first half on its rotors. Their torques, in instance 0, oppose the rates until
    the end.
    """
    elevator, thrust, aileron, rudder = flight.u.T
    still = np.zeros(len(thrust))
    level = np.column_stack([np.ones(len(thrust)), still, still, still])
    topics = {
        "vehicle_angular_velocity": ("float[3] xyz;", stamped(flight, flight.y[:, [2, 0, 3]])),
        "airspeed_validated": (
            "float true_airspeed_m_s;",
            stamped(flight, flight.y[:, [1]] + SPEED),
        ),
        "vehicle_attitude": ("float[4] q;", stamped(flight, level)),
        "vehicle_torque_setpoint": (
            "float[3] xyz;",
            stamped(flight, np.column_stack([aileron, elevator, rudder]) / FULL),
        ),
        "vehicle_thrust_setpoint": (
            "float[3] xyz;",
            stamped(flight, np.column_stack([THROTTLE + thrust, still, still])),
        ),
    }
    second = {}
    if vtol:
        name = "vehicle_torque_setpoint"
        second[name] = topics[name][1]
        topics[name] = ("float[3] xyz;", stamped(flight, -0.1 * flight.y[:, [2, 0, 3]]))
        kinds = np.where(np.arange(len(thrust)) < len(thrust) // 2, 1.0, 2.0)
        topics["vehicle_status"] = (
            "float vehicle_type;float is_vtol;",
            stamped(flight, np.column_stack([kinds, kinds > 0])),
        )
    write_ulog(path, topics, {"FW_AIRSPD_TRIM": 25.0}, changes, second)
    return path


def packets_of(content: bytes) -> Iterator[tuple[int, bytes]]:
    """Yield the stamps, us, and packets of a tlog.

    A packet of MAVLink 2 has 12 bytes besides the payload.
    """
    start = 0
    while start < len(content):
        end = start + 8 + 12 + int(content[start + 9])
        yield int.from_bytes(content[start : start + 8], "big"), content[start + 8 : end]
        start = end


def in_order(packets: Iterable[tuple[int, bytes]]) -> bytes:
    """Return a tlog of packets in the order of their stamps."""
    ordered = sorted(packets, key=lambda packet: packet[0])
    return b"".join(struct.pack(">Q", stamp) + packet for stamp, packet in ordered)


def ulog_of_2020(path: Path, flight: Flight) -> Path:
    """Write a log as PX4 1.9 does.

    It has actuator_controls_0, airspeed, and the gyro in sensor_combined.
    """
    elevator, thrust, aileron, rudder = flight.u.T
    controls = np.column_stack([aileron / FULL, elevator / FULL, rudder / FULL, THROTTLE + thrust])
    topics = {
        "sensor_combined": ("float[3] gyro_rad;", stamped(flight, flight.y[:, [2, 0, 3]])),
        "airspeed": ("float true_airspeed_m_s;", stamped(flight, flight.y[:, [1]] + SPEED)),
        "actuator_controls_0": ("float[4] control;", stamped(flight, controls)),
    }
    write_ulog(path, topics, {})
    return path


def imported(log: Path, bag: Path, *options: str, map_name: str = "ardupilot") -> Result:
    """Run `rise-di import`."""
    return invoke("import", log, "--map", map_name, "--output", bag, *options)


def imported_bag(folder: Path, flight: Flight) -> Path:
    """Return the bag of a flight that was imported from a log of ArduPlane."""
    bag = folder / "bag"
    assert imported(dataflash(folder / "flight.bin", flight), bag).exit_code == 0
    return bag


WRITERS: Mapping[str, tuple[Callable[[Path, Flight], Path], str]] = {
    "flight.bin": (dataflash, "ardupilot"),
    "flight.tlog": (tlog, "ardupilot"),
    "flight.ulg": (ulog, "px4"),
    "2020.ulg": (ulog_of_2020, "px4"),
    "tlog.bin": (tlog, "ardupilot"),  # the content tells the kind, not the name
}


@pytest.mark.parametrize("name", WRITERS)
def test_flight_in_each_format_gives_y_and_u(name: str, flight: Flight, tmp_path: Path) -> None:
    write, map_name = WRITERS[name]
    path = write(tmp_path / name, flight)
    bag = tmp_path / "bag"
    result = imported(path, bag, map_name=map_name)
    assert result.exit_code == 0, result.output
    tape = read_run(bag).tape
    assert (tape["y"].names, tape["u"].names) == (OUTPUTS, INPUTS)
    assert len(tape["y"].stamp_ns) == len(flight.y)  # of the flight, without the time on the ground
    # The log has float32.
    assert tape["y"].values == approx(
        flight.y - [0.0, np.median(flight.y[:, 1]), 0.0, 0.0], abs=1e-5
    )
    resolution = 0.5 / 500.0 * FULL if write is tlog else 0.0  # rad: pulses are whole us in MAVLink
    assert tape["u"].values == approx(flight.u, abs=resolution + 1e-6)
    assert np.median(tape["commands"].values, axis=0) == approx([0.0, THROTTLE, 0.0, 0.0], abs=1e-6)


def test_ulog_with_a_cut_message_of_an_unknown_type_is_refused(tmp_path: Path) -> None:
    """Pyulog would go back from the end of such a file to its beginning without an end."""
    path = tmp_path / "cut.ulg"
    path.write_bytes(b"ULog\x01\x12\x35\x01" + bytes(8) + struct.pack("<HB", 17, 0))
    with refusing(r"found a ULog of PX4 that cannot be decoded \(a damaged message has no end\)"):
        read_vehicle_log(path)


def test_omega_of_a_ulog_is_that_of_the_aircraft(long_flight: Flight, tmp_path: Path) -> None:
    bag = tmp_path / "bag"
    assert imported(ulog(tmp_path / "flight.ulg", long_flight), bag, map_name="px4").exit_code == 0
    response = recorded_response(bag, OUTPUTS, INPUTS)
    assert (response.sign_ratio >= MIN_RATIO).all()
    # The least that the log of a real flight has to reach.
    assert response.Omega.diagonal() == approx(OMEGA, rel=0.15)


def test_sticks_outside_of_manual_are_no_commands(flight: Flight, tmp_path: Path) -> None:
    path = dataflash(tmp_path / "flight.bin", flight, mode=11)
    bag = tmp_path / "bag"
    refused = imported(path, bag)
    assert str(refused.exception) == (
        "the log: found no flight in MANUAL in the log, expected it, for only there the sticks "
        "are the commands, or --servos"
    )
    assert not bag.exists()


@pytest.mark.parametrize("servo_reversed", [0.0, 1.0])
@pytest.mark.parametrize("stick_reversed", [0.0, 1.0])
def test_servos_give_u_of_the_stick_that_moved_them(
    stick_reversed: float, servo_reversed: float, flight: Flight, tmp_path: Path
) -> None:
    """With RC2_REVERSED a longer pulse is nose down, as in the map of such an aircraft.

    u follows the pulse.
    """
    content = named_map("ardupilot").model_dump(mode="json", exclude_unset=True)
    content["inputs"]["elevator"]["positive"] = "nose down" if stick_reversed else "nose up"
    (tmp_path / "map.yaml").write_text(yaml.safe_dump(content, sort_keys=False))
    parameters = {**PARAMETERS, "RC2_REVERSED": stick_reversed, "SERVO2_REVERSED": servo_reversed}
    path = dataflash(tmp_path / "flight.bin", flight, mode=11, parameters=parameters)
    bag = tmp_path / "bag"
    assert imported(path, bag, "--servos", map_name=str(tmp_path / "map.yaml")).exit_code == 0
    tape = read_run(bag).tape
    assert tape["u"].names == INPUTS
    assert np.abs(tape["u"].values - flight.u).max() <= 1e-6


@pytest.mark.parametrize("option", [[], ["--servos"]], ids=["sticks", "servos"])
def test_log_whose_parameters_differ_from_the_map_is_refused(
    option: list[str], flight: Flight, tmp_path: Path
) -> None:
    path = dataflash(
        tmp_path / "flight.bin",
        flight,
        parameters=PARAMETERS | {"RC2_REVERSED": 1.0, "RC1_MIN": 1100.0},
    )
    sentence = (
        "the log: found RC2_REVERSED 1, RC1_MIN 1100, expected RC2_REVERSED 0, RC1_MIN "
        "1000 as in the map ardupilot:"
    )
    refused = imported(path, tmp_path / "bag", *option)
    assert str(refused.exception).startswith(sentence)
    assert not (tmp_path / "bag").exists()
    table = dict(re.findall(r"(\w+) +(.*?) *\n", refused.stdout))
    rows = {name: table[name].split() for name in ("RC1_MIN", "RC2_MIN", "vehicle")}
    assert rows == {
        "RC1_MIN": ["1100", "1000"],
        "RC2_MIN": ["1000", "1000"],
        "vehicle": ["plane", "plane"],
    }


def test_tlog_is_compared_with_the_map_too_and_says_what_it_lacks(
    flight: Flight, tmp_path: Path
) -> None:
    reversed_ = tlog(tmp_path / "reversed.tlog", flight, {"RC2_REVERSED": 1.0})
    refused = imported(reversed_, tmp_path / "bag", map_name="ardupilot_mavlink")
    assert "found RC2_REVERSED 1, expected RC2_REVERSED 0 as in the map ardupilot_mavlink" in str(
        refused.exception
    )
    path = tlog(
        tmp_path / "flight.tlog",
        flight,
        {name: value for name, value in PARAMETERS.items() if name != "RC4_TRIM"},
    )
    result = imported(path, tmp_path / "bag", map_name="ardupilot_mavlink")
    assert result.exit_code == 0
    assert (
        "warning: the log has no RC4_TRIM before the samples: compare the map with them yourself"
        in result.stderr
    )


def test_parameters_of_the_samples_count_and_not_the_last_ones(
    flight: Flight, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A servo was reversed in flight, and is not reversed afterwards.

    This happens if the aircraft is changed on the ground.
    """
    bag = tmp_path / "bag"
    end = flight.stamp_us[-1]
    changes = [(end + 20_000_000, "SERVO2_REVERSED", 0.0), (end + 20_000_000, "RC2_MIN", 1100.0)]
    path = dataflash(tmp_path / "flight.bin", flight, mode=11, changes=changes)
    result = imported(path, bag, "--servos")
    assert result.exit_code == 0, result.output
    assert np.abs(read_run(bag).tape["u"].values - flight.u).max() <= 1e-6
    sentence = (
        "SERVO2_REVERSED changes from 1 to 0 at 37.0 s of the log, after the samples: "
        "signs and effects apply to 1"
    )
    assert f"warning: {sentence}" in result.stderr
    assert yaml.safe_load((bag / "vehicle_parameters.yaml").read_text())["SERVO2_REVERSED"] == 1.0
    warn_of_lacks_in(bag, None)  # of check and identify
    assert sentence in capsys.readouterr().err


def test_change_between_the_samples_is_refused_and_left_out_by_the_window(
    flight: Flight, tmp_path: Path
) -> None:
    bag = tmp_path / "bag"
    half = flight.stamp_us[len(flight.stamp_us) // 2]
    path = dataflash(tmp_path / "flight.bin", flight, changes=[(half, "SERVO2_REVERSED", 0.0)])
    assert str(imported(path, bag).exception) == (
        "the log: found SERVO2_REVERSED changes from 1 to 0 at 11.0 s of the log, expected no "
        "change between the samples: leave it out by --from and --until"
    )
    assert imported(path, bag, "--from", "6", "--until", "10").exit_code == 0
    assert imported(path, tmp_path / "later", "--servos", "--from", "12").exit_code == 0
    u = read_run(tmp_path / "later").tape["u"]["elevator"]
    # The pulses have not changed, their meaning has.
    assert np.abs(u + flight.u[-len(u) :, 0]).max() <= 1e-6


def test_log_without_the_mode_is_not_taken_for_manual(flight: Flight, tmp_path: Path) -> None:
    path = dataflash(tmp_path / "flight.bin", flight)
    path.write_bytes(path.read_bytes().replace(b"MODE", b"XODE", 1))
    assert "the log: found no message with the mode, expected" in str(
        imported(path, tmp_path / "bag").exception
    )
    assert imported(path, tmp_path / "bag", "--servos").exit_code == 0


def test_imported_log_is_read_with_the_map_of_its_import_alone(
    flight: Flight, tmp_path: Path
) -> None:
    """The bag has the u of the map with which it was imported.

    Signs and effects with another map would belong to another u.
    """
    bag = imported_bag(tmp_path, flight)
    content = named_map("ardupilot").model_dump(mode="json", exclude_unset=True)
    content["inputs"]["elevator"]["trim"] = 0.01  # measured at each engagement
    require_map_of_import(ChannelMap.validate_mapping(content, "map"), read_run(bag))
    identify = ["--run", str(bag), "--speed", "25", "--write", str(tmp_path / "found")]
    for key, value in (("sign", -1), ("scale", 0.4), ("positive", "nose down")):
        path = tmp_path / f"{key}.yaml"
        inputs = content["inputs"]
        inputs_by_another = inputs | {"elevator": inputs["elevator"] | {key: value}}
        path.write_text(
            yaml.safe_dump(content | {"inputs": inputs_by_another}, sort_keys=False),
        )
        for arguments in (
            ["check", str(path), "--run", str(bag)],
            ["identify", "bridge", str(path), *identify],
        ):
            refused = str(invoke(*arguments).exception)
            assert f"found inputs.elevator.{key} " in refused
            assert refused.endswith(
                f"expected {value}, as in the map ardupilot: import the log again, with --map"
            )


def test_gains_from_imported_log_state_for_which_link_they_are(
    long_flight: Flight, tmp_path: Path
) -> None:
    bag = imported_bag(tmp_path, long_flight)
    identify = ["identify", "bridge", "ardupilot", "--run", str(bag), "--speed", "25", "--accept"]
    result = invoke(*identify, "--write", tmp_path / "found")
    assert "for 50 ms of further delay over the link (link_delay)" in result.output
    assert result.exit_code == 0


def test_multicopter_gives_outputs_of_its_rate_controllers_in_any_mode(
    flight: Flight, tmp_path: Path
) -> None:
    """Mode 0 of ArduCopter is STABILIZE, in which the sticks command angles.

    The multicopter is in the air if it has more than half of its usual thrust.
    """
    quadrotor = str(REPOSITORY / "examples" / "px4_quadrotor" / "map.yaml")
    bag = tmp_path / "bag"
    log = multicopter(tmp_path / "flight.bin", flight)
    assert imported(log, bag, map_name=quadrotor).exit_code == 0
    tape = read_run(bag).tape
    assert (tape["y"].names, tape["u"].names) == (
        ("q", "vertical_speed", "p", "r"),
        ("pitch", "thrust", "roll", "yaw"),
    )
    assert len(tape["y"].stamp_ns) == len(flight.y)  # without the time on the ground
    assert tape["y"].values == approx(flight.y, abs=1e-5)
    assert tape["u"].values == approx(flight.u, abs=1e-6)
    rover = multicopter(tmp_path / "rover.bin", flight, "ArduRover V4.5.7 (2a3dc4b7)")
    servos = imported(log, tmp_path / "no", "--servos", map_name=quadrotor)
    assert "servos as commands: found a multicopter, expected a plane" in str(servos.exception)
    refused = imported(rover, tmp_path / "no", map_name=quadrotor)
    assert "found one of a rover, expected one of a plane or a multicopter" in str(
        refused.exception
    )


def test_log_whose_clock_goes_back_is_its_longest_part(flight: Flight, tmp_path: Path) -> None:
    whole = dataflash(tmp_path / "whole.bin", flight)
    short = dataflash(
        tmp_path / "short.bin", Flight(flight.stamp_us[:200], flight.y[:200], flight.u[:200])
    )
    (tmp_path / "both.bin").write_bytes(short.read_bytes() + whole.read_bytes())
    both, single = (read_vehicle_log(tmp_path / name) for name in ("both.bin", "whole.bin"))
    assert both.kind == "a DataFlash log of ArduPilot, the longest of 2 parts: its clock goes back"
    assert_array_equal(both.tables["IMU"].stamp_ns, single.tables["IMU"].stamp_ns)


@pytest.mark.parametrize(
    "places",
    [[(500, 2**50)], [(500, 1_030_000_000)], [(500, 0), (501, 0)], [(0, 0)]],
    ids=["ahead", "half a minute ahead", "two back", "at the begin"],
)
def test_samples_with_damaged_stamps_are_left_out(
    places: list[tuple[int, int]], flight: Flight, tmp_path: Path
) -> None:
    flown = flight._replace(stamp_us=[stamp + 1_000_000_000 for stamp in flight.stamp_us])
    rows = list(zip(flown.stamp_us, flown.y[:, [2, 0, 3]], strict=True))
    write_dataflash(
        tmp_path / "whole.bin",
        {"IMU": (("GyrX", "GyrY", "GyrZ"), rows)},
        {},
        "ArduPlane V4.6.0 (1f2e3d4c)",
    )
    whole = (tmp_path / "whole.bin").read_bytes()
    for place, stamp in places:
        whole = whole.replace(struct.pack("<Q", flown.stamp_us[place]), struct.pack("<Q", stamp), 1)
    (tmp_path / "damaged.bin").write_bytes(whole)
    damaged, single = (read_vehicle_log(tmp_path / f"{name}.bin") for name in ("damaged", "whole"))
    assert damaged.kind == single.kind
    kept = np.delete(single.tables["IMU"].stamp_ns, [place for place, _ in places])
    assert_array_equal(damaged.tables["IMU"].stamp_ns, kept)


def test_imported_log_has_pose_and_parameters_of_vehicle(flight: Flight, tmp_path: Path) -> None:
    bag = tmp_path / "bag"
    assert (
        imported(
            dataflash(tmp_path / "flight.bin", flight), bag, "--from", "10", "--until", "15"
        ).exit_code
        == 0
    )
    tape = read_run(bag).tape
    assert tape.time("y")[-1] == approx(5.0)
    assert tape["pose"].names == ("phi", "theta", "psi")
    assert tape["pose"].values[0] == approx(np.radians([5.0, -2.0, -10.0]), abs=1e-6)
    assert yaml.safe_load((bag / "vehicle_parameters.yaml").read_text())["SERVO2_REVERSED"] == 1.0


def test_report_of_imported_flight_shows_y_and_u_and_no_error(
    flight: Flight, tmp_path: Path
) -> None:
    bag = imported_bag(tmp_path, flight)
    result = invoke("report", bag, "--png", tmp_path / "flight.png", "--json")
    assert result.exit_code == 0, result.output
    summary = json.loads(result.output)
    assert (summary["outcome"]["sentence"], summary["scenario"], summary["errors"]) == (
        "imported",
        None,
        {},
    )
    assert summary["duration"] == approx(DURATION, abs=2.0 / RATE)
    for key, values in (
        ("outputs", flight.y - [0.0, np.median(flight.y[:, 1]), 0.0, 0.0]),
        ("inputs", flight.u),
    ):
        rms = [metrics["whole"]["rms"] for metrics in summary[key].values()]
        assert rms == approx(np.sqrt(np.mean(values**2, axis=0)), rel=1e-3)
    page = (bag / "report.html").read_text()
    assert re.findall(r"<h2 id=[^>]*>([^<]*)</h2>", page) == [
        "Output y",
        "Replay",
        "Input u",
        "Pose",
        "Spectrum of u",
        "All figures",
        "Words",
    ]
    assert "<h1>flight.bin</h1>" in page
    assert "a DataFlash log of ArduPilot, by the map ardupilot" in page
    view = View(bag)
    view.update()
    assert view.description["units"]["q"]["unit"] == "deg/s"
    refused = str(invoke("replay", str(bag)).exception)
    assert "found an imported log, expected a flight of the stack" in refused
    # Two logs are laid over each other; this one does not differ from itself.
    assert (
        invoke("report", str(bag), str(bag), "--page", str(tmp_path / "both.html")).exit_code == 0
    )
    both = (tmp_path / "both.html").read_text()
    assert "2 logs over each other" in both
    differences = re.findall(r"<tr><th scope=\"row\">(?:y|u|pose) [^<]*</th>(.*?)</tr>", both)
    assert len(differences) >= 8
    assert all(re.fullmatch(r"(<td[^>]*>[0.]+\s*</td>){2}.*", row) for row in differences)


def test_log_cut_in_the_middle_gives_what_it_has(flight: Flight, tmp_path: Path) -> None:
    whole = ulog(tmp_path / "whole.ulg", flight).read_bytes()
    (tmp_path / "cut.ulg").write_bytes(whole[: len(whole) // 2 + 3])  # inside a message
    rates = [
        len(read_vehicle_log(tmp_path / name).tables["vehicle_angular_velocity"].stamp_ns)
        for name in ("cut.ulg", "whole.ulg")
    ]
    assert rates[0] == approx(rates[1] / 2, rel=0.02)  # the head has the definitions


def two_systems(folder: Path, flight: Flight, second: Flight) -> tuple[Path, Path]:
    """Write a tlog of the systems 1 and 7, and one of the system 1 alone.

    RC2 of system 7 is reversed.
    """
    single = tlog(folder / "one.tlog", flight, {"RC2_REVERSED": 0.0})
    other = tlog(folder / "other.tlog", second, {"RC2_REVERSED": 1.0}, system=7)
    (folder / "both.tlog").write_bytes(
        in_order(packets_of(other.read_bytes() + single.read_bytes()))
    )
    return folder / "both.tlog", single


def test_system_of_a_tlog_that_flew_is_taken_and_named(flight: Flight, tmp_path: Path) -> None:
    """The other system stands, and its gyroscopes have only noise.

    Its samples are half a period later.
    """
    still = Flight([stamp + 10_000 for stamp in flight.stamp_us], 0.01 * flight.y, flight.u)
    path, single = two_systems(tmp_path, flight, still)
    both = read_vehicle_log(path)
    expected = read_vehicle_log(single)
    assert both.taken == (Taken("system", (1,), (7, 1), Reason.SYSTEM_MOVES),)
    assert both.parameters == expected.parameters
    for name, table in expected.tables.items():
        for field, values in table.fields.items():
            assert_array_equal(both.tables[name].fields[field], values)
    result = imported(path, tmp_path / "bag")
    assert result.exit_code == 0
    assert "1 of 7 and 1: it alone moves" in result.stdout


def test_two_systems_that_flew_are_refused_but_for_the_one_that_the_user_names(
    flight: Flight, tmp_path: Path
) -> None:
    later = Flight([stamp + 10_000 for stamp in flight.stamp_us], -flight.y, -flight.u)
    path, _ = two_systems(tmp_path, flight, later)
    sentence = (
        "the log: found several systems that moved, 7 and 1, "
        "expected a choice: --system 7 or --system 1"
    )
    assert str(imported(path, tmp_path / "bag").exception) == sentence
    assert "--system: found 3, expected one of 7 and 1" in str(
        imported(path, tmp_path / "bag", "--system", "3").exception
    )
    assert imported(path, tmp_path / "bag", "--system", "1").exit_code == 0
    assert "found RC2_REVERSED 1" in str(
        imported(path, tmp_path / "other", "--system", "7").exception
    )
    other = dataflash(tmp_path / "flight.bin", flight)
    assert "--system: found 1, expected none" in str(
        imported(other, tmp_path / "no", "--system", "1").exception
    )
    assert "--instance: found 'IMU', expected" in str(
        imported(other, tmp_path / "no", "--instance", "IMU").exception
    )
    assert "--instance IMU: found 3, expected one of 0" in str(
        imported(other, tmp_path / "no", "--instance", "IMU=3").exception
    )


def arrivals(
    path: Path, arrival: Callable[[int], int], *, copies: Callable[[int], int] | None = None
) -> Path:
    """Give a tlog other times of arrival, us.

    With `copies`, a second link delivers each message again at its own time.
    """
    clocks = [clock for clock in (arrival, copies) if clock is not None]
    packets = packets_of(path.read_bytes())
    path.write_bytes(
        in_order((clock(stamp), packet) for stamp, packet in packets for clock in clocks)
    )
    return path


@pytest.mark.parametrize(
    "arrival, copies",
    [
        (lambda stamp: (stamp // 500_000 + 1) * 500_000, None),
        (lambda stamp: stamp, lambda stamp: stamp + 250_000),
        (lambda stamp: stamp, lambda stamp: stamp + 3_000_000),
        (
            lambda stamp: stamp + 40_000 * (stamp // 1_000_000 % 3),
            lambda stamp: (stamp // 300_000 + 1) * 300_000,
        ),
    ],
    ids=["bunched", "second link", "slow second link", "both links uneven"],
)
def test_messages_of_a_tlog_have_the_time_of_their_autopilot(
    arrival: Callable[[int], int],
    copies: Callable[[int], int] | None,
    flight: Flight,
    tmp_path: Path,
) -> None:
    bag = tmp_path / "bag"
    assert (
        imported(arrivals(tlog(tmp_path / "a.tlog", flight), arrival, copies=copies), bag).exit_code
        == 0
    )
    tape = read_run(bag).tape
    # V, alone, comes without the time of the autopilot: 0.1 s earlier or later it differs by 0.08.
    # The pulses of u are whole us.
    for topic, values, bound in (
        ("y", flight.y, [1e-5, 0.1, 1e-5, 1e-5]),
        ("u", flight.u, [1e-3] * 4),
    ):
        read = tape[topic]
        assert np.diff(read.stamp_ns) == approx(1e9 / RATE)
        assert len(read.stamp_ns) == len(values)
        error = read.values - values
        assert (np.abs(error - np.median(error, axis=0)).max(axis=0) < bound).all()


def sensors(
    path: Path,
    flight: Flight,
    name: str,
    parameters: Mapping[str, float],
    *instances: FloatArray,
    **flags: Any,
) -> Path:
    """Write a log of ArduPlane with several sensors.

    The values are given by instance, (N, fields). A flag has a value for each instance.
    """
    fields = {"ARSP": ("Airspeed",), "IMU": ("GyrX", "GyrY", "GyrZ")}[name]
    rows = []
    for number, values in enumerate(instances):
        flag_values = [flag[number] for flag in flags.values()]
        rows += [
            (stamp, (number, *row, *flag_values))
            for stamp, row in zip(flight.stamp_us, values, strict=True)
        ]
    messages: dict[str, tuple[tuple[str, ...], Any]] = {
        "MODE": (("Mode", "ModeNum"), [(1, (0, 0))]),
        "IMU": (("GyrX", "GyrY", "GyrZ"), stamped(flight, flight.y[:, [2, 0, 3]])),
        "CTUN": (
            ("Aspd", "E2T"),
            stamped(flight, np.column_stack([flight.y[:, 1] + SPEED, np.ones(len(flight.y))])),
        ),
        "RCIN": (("C1", "C2", "C3", "C4"), stamped(flight, sticks(flight.u))),
    } | {name: (("I", *fields, *flags), rows)}
    write_dataflash(path, messages, {**PARAMETERS, **parameters}, "ArduPlane V4.6.0 (1f2e3d4c)")
    return path


DEAD = np.random.default_rng(3).normal(2.0, 0.3, (round(DURATION * RATE), 1))  # m/s


@pytest.mark.parametrize(
    "flags, reason",
    [
        ({"H": (0, 1), "U": (0, 1), "Pri": (1, 1)}, Reason.PRIMARY),
        ({"H": (0, 1), "U": (1, 1), "Pri": (0, 0)}, Reason.USED),
        ({"H": (1, 1), "U": (0, 1)}, Reason.USED),
        ({}, Reason.USED),
    ],
    ids=["primary", "dead primary", "not used", "no flags"],
)
def test_airspeed_is_that_of_the_sensor_that_measures(
    flags: Mapping[str, tuple[int, int]], reason: Reason, flight: Flight, tmp_path: Path
) -> None:
    path = sensors(tmp_path / "a.bin", flight, "ARSP", {}, DEAD, flight.y[:, [1]] + SPEED, **flags)
    log = read_vehicle_log(path)
    assert log.taken == (Taken("ARSP", (1,), (0, 1), reason),)
    assert log.tables["ARSP"].fields["Airspeed"] == approx(flight.y[:, 1] + SPEED, abs=1e-4)


def test_airspeed_of_a_primary_that_changes_in_flight_is_that_of_each_instant(
    flight: Flight, tmp_path: Path
) -> None:
    half = len(flight.y) // 2
    dies = np.vstack([flight.y[:half, [1]] + SPEED, DEAD[half:]])
    path = sensors(
        tmp_path / "a.bin",
        flight,
        "ARSP",
        {},
        dies,
        flight.y[:, [1]] + SPEED,
        H=(1, 1),
        U=(1, 1),
        Pri=(0, 0),
    )
    assert (
        "found different instances 0 and 1 of ARSP, expected a choice: --instance ARSP=0 or "
        "--instance ARSP=1" in str(imported(path, tmp_path / "no").exception)
    )
    assert imported(path, tmp_path / "bag", "--instance", "ARSP=1").exit_code == 0
    rows = [
        (
            stamp,
            (
                number,
                dies[k, 0] if number == 0 else flight.y[k, 1] + SPEED,
                number or k < half,
                1,
                int(k >= half),
            ),
        )
        for k, stamp in enumerate(flight.stamp_us)
        for number in (0, 1)
    ]
    write_dataflash(
        path,
        {"ARSP": (("I", "Airspeed", "H", "U", "Pri"), rows)},
        {},
        "ArduPlane V4.6.0 (1f2e3d4c)",
    )
    log = read_vehicle_log(path)
    assert log.taken == (Taken("ARSP", (0, 1), (0, 1), Reason.PRIMARY),)
    assert log.taken[0].sentence() == "0 and 1 of 0 and 1: the primary"
    assert log.tables["ARSP"].fields["Airspeed"] == approx(flight.y[:, 1] + SPEED, abs=1e-4)


def test_gyroscope_is_one_that_is_used_and_two_that_differ_are_refused(
    flight: Flight, tmp_path: Path
) -> None:
    rates = flight.y[:, [2, 0, 3]]
    not_used = sensors(
        tmp_path / "a.bin", flight, "IMU", {"INS_USE": 0.0, "INS_USE2": 1.0}, -rates, rates
    )
    log = read_vehicle_log(not_used)
    assert log.taken == (Taken("IMU", (1,), (0, 1), Reason.MOVES),)
    assert log.tables["IMU"].fields["GyrY"] == approx(rates[:, 1], abs=1e-6)
    turned = sensors(tmp_path / "b.bin", flight, "IMU", {}, rates, -rates)
    with refusing(
        "found different instances 0 and 1 of IMU, expected a choice: --instance IMU=0 or"
    ):
        read_vehicle_log(turned)
    equal = sensors(tmp_path / "c.bin", flight, "IMU", {}, rates, rates + 0.001)
    assert read_vehicle_log(equal).taken == (Taken("IMU", (0,), (0, 1), Reason.AGREES),)


def test_vtol_of_px4_is_flown_by_its_surfaces_as_a_plane(flight: Flight, tmp_path: Path) -> None:
    path = ulog(tmp_path / "vtol.ulg", flight, vtol=True)
    bag = tmp_path / "bag"
    result = imported(path, bag, map_name="px4")
    assert result.exit_code == 0, result.output
    assert "1 of 0 and 1: the surfaces of a VTOL" in " ".join(result.stdout.split())
    tape = read_run(bag).tape
    half = len(flight.u) // 2  # the first half is flown on the rotors
    assert tape["u"].values == approx(
        flight.u[half:] - np.median(flight.u[half:], axis=0), abs=1e-5
    )


def test_log_of_the_other_kind_of_vehicle_than_the_map_is_refused(
    flight: Flight, tmp_path: Path
) -> None:
    path = multicopter(tmp_path / "copter.bin", flight)
    sentence = (
        "the log: found one of a multicopter, expected one of a plane, as the map ardupilot is for"
    )
    assert str(imported(path, tmp_path / "no").exception) == sentence


def test_log_without_the_gyroscope_names_the_mask_of_the_log(
    flight: Flight, tmp_path: Path
) -> None:
    path = dataflash(
        tmp_path / "flight.bin", flight, parameters=PARAMETERS | {"LOG_BITMASK": 65407.0}
    )
    path.write_bytes(path.read_bytes().replace(b"IMU\0", b"XMU\0", 1))
    sentence = "outputs.q: found no q in the log, expected IMU: LOG_BITMASK is 65407"
    assert str(imported(path, tmp_path / "no").exception) == sentence


def test_log_of_px4_before_2017_is_named(flight: Flight, tmp_path: Path) -> None:
    rows = stamped(flight, flight.y[:, [2, 0, 3]])
    write_dataflash(tmp_path / "old.px4log", {"IMU": (("GyroX", "GyroY", "GyroZ"), rows)}, {}, "")
    with refusing(r"found a log of PX4 before 2017 .*, expected a ULog"):
        read_vehicle_log(tmp_path / "old.px4log")


def test_second_flight_of_a_log_is_told_and_taken_by_its_window(
    flight: Flight, tmp_path: Path
) -> None:
    """The second flight has half the length of the first, and begins after 5 s on the ground."""
    ground, half = on_ground(flight), len(flight.stamp_us) // 2
    pause_us = flight.stamp_us[-1] + 10_000
    both = Flight(
        [
            *flight.stamp_us,
            *(stamp - ground.stamp_us[0] + pause_us for stamp in ground.stamp_us),
            *(
                stamp - flight.stamp_us[0] + pause_us + round(1e6 * GROUND)
                for stamp in flight.stamp_us[:half]
            ),
        ],
        np.concatenate([flight.y, ground.y, flight.y[:half]]),
        np.concatenate([flight.u, ground.u, flight.u[:half]]),
    )
    path = dataflash(tmp_path / "both.bin", both)
    result = imported(path, tmp_path / "bag")
    told = re.search(r"the log has 2 flights, .*: (\d+\.\d) to (\d+\.\d) s", result.stderr)
    assert told
    first, last = map(float, told.groups())
    assert last - first == approx(half / RATE, abs=0.5)
    window = ("--from", f"{first}", "--until", f"{last}")
    second = imported(path, tmp_path / "second", *window)
    assert second.exit_code == 0
    assert "flights" not in second.stderr
    y = read_run(tmp_path / "second").tape["y"]
    assert seconds(int(y.stamp_ns[-1] - y.stamp_ns[0])) == approx(last - first, abs=0.1)


def test_loss_of_airspeed_is_told_with_the_instant(flight: Flight, tmp_path: Path) -> None:
    lost = flight.y.copy()
    lost[len(lost) // 2 :, 1] = np.nan
    result = imported(
        ulog(tmp_path / "a.ulg", flight._replace(y=lost)), tmp_path / "bag", map_name="px4"
    )
    assert result.exit_code == 0
    sentence = "warning: no airspeed or thrust at 300 of 600 samples, from 6.0 s of the log on"
    assert sentence in result.stderr


def test_log_without_what_the_map_needs_is_one_sentence(flight: Flight, tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("a,b\n1,2\n")
    with refusing("found a CSV file, expected a DataFlash log"):
        read_vehicle_log(tmp_path / "a.csv")
    path = tmp_path / "cut.ulg"
    path.write_bytes(ulog(tmp_path / "flight.ulg", flight).read_bytes()[:100])
    with refusing("a ULog of PX4"):
        read_vehicle_log(path)
    path.write_bytes(path.read_bytes()[:10])
    with refusing("a ULog of PX4 that cannot be decoded"):
        read_vehicle_log(path)
    for name, map_name, sentence in (
        ("flight.ulg", "ardupilot", "inputs.elevator: found no joy.axes"),
        ("absent.bin", "ardupilot", "no such file"),
    ):
        assert sentence in str(
            imported(tmp_path / name, tmp_path / "no", map_name=map_name).exception
        )


def as_text(path: Path, flight: Flight) -> Path:
    """Return a log of ArduPlane as the text that Mission Planner makes of it."""
    reader = DFReader.DFReader_binary(str(dataflash(path.with_suffix(".bin"), flight)))
    lines = []
    while (message := reader.recv_msg()) is not None:
        name, *values = message.to_dict().values()
        lines.append(", ".join([name, *map(str, values)]))
    reader.close()
    path.write_text("\n".join(lines) + "\n")
    return path


def overwritten(content: bytes, places: Sequence[int], filling: bytes) -> bytes:
    data = bytearray(content)
    for place in places:
        data[place : place + len(filling)] = filling
    return bytes(data)


def removed(content: bytes, places: Sequence[int], filling: bytes) -> bytes:
    data = bytearray(content)
    for place in reversed(places):
        del data[place : place + len(filling)]
    return bytes(data)


LOSSES: Mapping[str, tuple[Callable[[bytes, Sequence[int], bytes], bytes], int, bytes]] = {
    "zeros in places": (overwritten, 60, bytes(20)),
    "erased places": (overwritten, 40, bytes([0xFF]) * 20),
    "bytes that are missing": (removed, 40, bytes(37)),
    "other bytes": (overwritten, 40, np.random.default_rng(5).bytes(20)),
    "blocks of a card": (overwritten, 3, bytes(4096)),
}


@pytest.mark.parametrize(
    "name, loss",
    [
        *(("flight.bin", loss) for loss in LOSSES),
        ("flight.log", "zeros in places"),
        ("flight.log", "other bytes"),
        ("flight.log", "bytes that are missing"),
        ("flight.ulg", "zeros in places"),
        ("flight.ulg", "erased places"),
        ("flight.ulg", "bytes that are missing"),
        ("flight.ulg", "blocks of a card"),
        ("flight.tlog", "erased places"),
        ("flight.tlog", "bytes that are missing"),
    ],
)
def test_log_with_lost_bytes_is_read_on_and_gives_the_aircraft(
    name: str, loss: str, long_flight: Flight, tmp_path: Path
) -> None:
    """The remaining samples are those of the flight, and Omega is right in spite of the holes.

    A DataFlash log has no checksum, so a message whose values are overwritten has wrong values.
    """
    write, map_name = {**WRITERS, "flight.log": (as_text, "ardupilot")}[name]
    damage, count, filling = LOSSES[loss]
    flight = long_flight
    if identified := (name, loss) == ("flight.bin", "blocks of a card"):
        flight = flown(40.0)  # Omega takes 18 s of known u, with 2 s before, between the holes
    path = write(tmp_path / name, flight)
    content = path.read_bytes()
    random = np.random.default_rng(2)
    first = len(content) // 4  # behind the formats and the parameters
    places = sorted(random.integers(first, len(content) - len(filling), count).tolist())
    path.write_bytes(damage(content, places, filling))
    bag = tmp_path / "bag"
    result = imported(path, bag, map_name=map_name)
    assert result.exit_code == 0, result.output
    tape = read_run(bag).tape
    lost = len(filling) * count / len(content)
    # A place of 20 bytes may cost a part of two messages each.
    assert len(tape["y"].stamp_ns) >= (1.0 - 4.0 * lost - 0.02) * len(flight.y)
    assert tape.time("y")[-1] == approx(len(flight.y) / RATE, abs=1.5)
    assert re.search(
        r"warning: y lacks \d+ of \d+ samples: the longest gap, [\d.]+ s, begins at", result.stderr
    )
    if not name.endswith(".tlog"):  # whose packets have a checksum and no order
        assert re.search(
            r"warning: the log is incomplete: \d+ of \d+ (bytes|lines).* hold no message, "
            r"(from [\d.]+ to|at) [\d.]+ s of the log",
            result.stderr,
        )
    numbers = np.clip(np.rint(tape.time("y") * RATE).astype(int), 0, len(flight.y) - 1)
    error = np.stack([tape["y"][name] for name in OUTPUTS], axis=1) - flight.y[numbers]
    error -= np.median(error, axis=0)  # the speed of trim
    # A lost V, which has a message of its own, is the one before.
    is_wrong = np.abs(error) > [1e-3, 0.5, 1e-3, 1e-3]
    assert is_wrong.sum() <= 2, is_wrong.sum(axis=0)
    if identified:
        response = recorded_response(bag, OUTPUTS, INPUTS)
        deviations = response.Omega_deviation.diagonal()
        errors = np.abs(response.Omega.diagonal() - OMEGA) / deviations
        assert errors == approx(np.zeros(4), abs=3.0)


def test_refusal_of_an_incomplete_log_tells_the_loss(flight: Flight, tmp_path: Path) -> None:
    path = dataflash(tmp_path / "flight.bin", flight, mode=11)
    content = path.read_bytes()
    path.write_bytes(overwritten(content, [len(content) // 2], bytes(2000)))
    refused = str(imported(path, tmp_path / "bag").exception)
    assert "found no flight in MANUAL" in refused
    assert re.search(r"; the log is incomplete: 20\d\d of \d+ bytes hold no message, at ", refused)


def test_dropouts_of_a_logger_are_told(flight: Flight, tmp_path: Path) -> None:
    """The message O has the duration of a dropout, ms (PX4 guide, ULog file format)."""
    path = ulog(tmp_path / "a.ulg", flight)
    content = path.read_bytes()
    sample = content.index(b"D", len(content) // 2) - 2
    while content[sample + 2 : sample + 3] != b"D" or content[sample : sample + 2] != b"\x16\x00":
        sample = content.index(b"D", sample + 3) - 2
    dropout = struct.pack("<HcH", 2, b"O", 250)
    path.write_bytes(content[:sample] + dropout + content[sample:])
    result = imported(path, tmp_path / "bag", map_name="px4")
    assert result.exit_code == 0, result.output
    assert (
        "the log is incomplete: a dropout of the logger, 0.25 s in all, at 5.9 s" in result.stderr
    )


def test_sample_of_no_airspeed_does_not_end_the_flight(flight: Flight, tmp_path: Path) -> None:
    """An aircraft does not land and take off again within a second, but it may in a longer time."""
    for samples, expected in ((RATE // 2, len(flight.y)), (3 * RATE, len(flight.y) * 3 // 4)):
        y = flight.y.copy()
        y[len(y) // 4 - samples : len(y) // 4, 1] = -SPEED
        bag = tmp_path / str(samples)
        assert imported(dataflash(tmp_path / "a.bin", flight._replace(y=y)), bag).exit_code == 0
        assert len(read_run(bag).tape["y"].stamp_ns) == expected


def test_tlog_behind_the_text_of_a_radio_is_one(flight: Flight, tmp_path: Path) -> None:
    path = tlog(tmp_path / "a.tlog", flight)
    whole = read_vehicle_log(path)
    for text in (b"SiK 2.2 on HM-TRP\r\nBOARD: HM-TRP\r\n", b"\xfd\x00\xff", b"+++OK"):
        (tmp_path / "b.tlog").write_bytes(text + path.read_bytes())
        assert file_kind(tmp_path / "b.tlog") is FileKind.TLOG
        log = read_vehicle_log(tmp_path / "b.tlog")
        assert_array_equal(log.tables["ATTITUDE"].stamp_ns, whole.tables["ATTITUDE"].stamp_ns)


@pytest.mark.parametrize(
    "flags, parameters, reason",
    [
        ({}, {"ARSPD_USE": 0.0}, "0 is not used, ARSPD_USE 0"),
        ({"H": (1,), "U": (0,)}, {"ARSPD_USE": 0.0}, "0 is not used, ARSPD_USE 0"),
        ({"H": (0,), "U": (1,)}, {"ARSPD_USE": 1.0}, "0 is not healthy, ARSPD_USE 1"),
    ],
    ids=["parameter", "flag", "not healthy"],
)
def test_airspeed_without_a_sensor_in_use_is_the_estimate_of_the_autopilot(
    flags: Mapping[str, tuple[int]],
    parameters: Mapping[str, float],
    reason: str,
    flight: Flight,
    tmp_path: Path,
) -> None:
    path = sensors(tmp_path / "a.bin", flight, "ARSP", parameters, DEAD, **flags)
    bag = tmp_path / "bag"
    result = imported(path, bag)
    assert result.exit_code == 0, result.output
    assert f"{reason}: V is the estimate in CTUN" in " ".join(result.stdout.split())
    y = read_run(bag).tape["y"]
    assert len(y.stamp_ns) == len(flight.y)
    assert y["V"] == approx(flight.y[:, 1] - np.median(flight.y[:, 1]), abs=1e-5)
    assert imported(path, tmp_path / "dead", "--instance", "ARSP=0").exit_code == 0
    path.write_bytes(path.read_bytes().replace(b"CTUN", b"XTUN", 1))
    refused = str(imported(path, tmp_path / "no").exception)
    assert f"found no airspeed sensor in use ({reason}), expected an estimate of the" in refused


def test_damaged_bytes_cost_what_they_hold_and_print_nothing(
    flight: Flight, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    path = dataflash(tmp_path / "flight.bin", flight)
    whole = sum(len(table.stamp_ns) for table in read_vehicle_log(path).tables.values())
    content = bytearray(path.read_bytes())
    content[len(content) // 2 : len(content) // 2 + 40] = bytes(40)
    path.write_bytes(content)
    assert (
        0 < whole - sum(len(table.stamp_ns) for table in read_vehicle_log(path).tables.values()) < 5
    )
    path = ulog(tmp_path / "flight.ulg", flight)
    path.write_bytes(path.read_bytes().replace(b"float FW_AIRSPD_TRIM", b"fl0at FW_AIRSPD_TRIM"))
    assert read_vehicle_log(path).parameters == {}
    assert capfd.readouterr() == ("", "")
