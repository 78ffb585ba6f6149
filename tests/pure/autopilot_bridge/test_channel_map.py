# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test channel maps: each row of each map against values by hand.

The conversion and the refusals of invalid maps are tested, too. Plain objects with the published
fields (tests/published_messages.py) replace the messages, because px4_msgs may not be installed.
tests/nodes/autopilot_bridge/test_bridge.py and test_published_messages.py test real messages.
"""

import json
import math
from functools import cache
from pathlib import Path
from types import SimpleNamespace as Message

import numpy as np
import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st
from pytest import approx
from scipy.spatial.transform import Rotation
from tests.conftest import invoke, refusing
from tests.maps import MAP_FILES, named_map
from tests.published_messages import FOREIGN_MAPS, PUBLISHED, blank, kind

from autopilot_bridge.bridge import Bridge
from autopilot_bridge.channel_map import (
    STEP,
    LinearConversion,
    get_field,
    message_type,
    read_raw,
    set_field,
    to_channel,
    to_raw,
)
from autopilot_bridge.map_check import check_map, definitions_below
from autopilot_bridge.map_rows import MeasuredRow, OverrideRow
from autopilot_bridge.params import BridgeConfig, ChannelMap, load_map
from flight_core import installation
from flight_core.outcome import Refusal
from flight_core.vectors import ChannelError

MAPS = sorted(MAP_FILES)
CONVERSIONS = st.builds(
    LinearConversion, st.sampled_from((-1, 1)), st.floats(1e-3, 1e3), st.floats(-1e3, 1e3)
)
FLU = Message(x=0.3, y=-0.2, z=-0.1)  # roll right at 0.3 rad/s, nose up at 0.2, nose right at 0.1
FRD = np.array([0.3, 0.2, 0.1], dtype=np.float32)  # the same motion as a fixed array of a message
MOTION = {"p": 0.3, "q": 0.2, "r": 0.1}  # the expected channels for each map
RATES = {
    "ardupilot": Message(angular_velocity=Message(x=0.3, y=0.2, z=0.1)),
    "ardupilot_2024": Message(twist=Message(linear=Message(x=9.0, y=9.0, z=9.0), angular=FLU)),
    "ardupilot_mavlink": Message(rollspeed=0.3, pitchspeed=0.2, yawspeed=0.1),
    "odometry": Message(angular_velocity=FLU),
    "px4": Message(angular_velocity=FRD),
}
AIRSPEED = {  # 27 m/s, 2 m/s above the trim of 25 m/s
    # 9 (2, 2, 1), of length 27.
    "ardupilot": Message(true_airspeed=Message(x=-18.0, y=18.0, z=-9.0)),
    "ardupilot_2024": Message(vector=Message(x=-18.0, y=18.0, z=-9.0)),
    "ardupilot_mavlink": Message(airspeed=27.0),
    "odometry": Message(twist=Message(twist=Message(linear=Message(x=-18.0, y=18.0, z=-9.0)))),
    "px4": Message(true_airspeed_m_s=27.0, calibrated_airspeed_m_s=26.0),
}
# Elevator 0.1 rad nose up, thrust 10 % above half, aileron 0.1 rad to the right, rudder 0.1 rad to
# the right.
SENT = {
    "ardupilot": {
        "axes[1]": 0.1 / 0.523599,
        "axes[2]": 0.2,
        "axes[0]": 0.1 / 0.523599,
        "axes[3]": 0.1 / 0.523599,
    },
    "px4": {
        "torque.xyz[1]": 0.1 / 0.523599,
        "thrust.xyz[0]": 0.6,
        "torque.xyz[0]": 0.1 / 0.523599,
        "torque.xyz[2]": 0.190986,
    },
    "ardupilot_mavlink": {
        "chan2_raw": 1595.493,
        "chan3_raw": 1600.0,
        "chan1_raw": 1595.493,
        "chan4_raw": 1595.493,
    },
    # 12 of 20 N.
    "odometry": {
        "elevator.data": 0.1,
        "thrust.data": 12.0,
        "aileron.data": 0.1,
        "rudder.data": 0.1,
    },
}
SENT["ardupilot_2024"] = SENT["ardupilot"]


@pytest.mark.parametrize("name", MAPS)
@pytest.mark.parametrize("channel", ["q", "V", "p", "r"])
def test_each_output_comes_in_si_and_frd(name: str, channel: str) -> None:
    row = named_map(name).outputs[channel]
    message = AIRSPEED[name] if channel == "V" else RATES[name]
    value = to_channel(read_raw(message, row.field, row.function), row.conversion)
    # A value is float32 in a message of PX4.
    assert value == approx(2.0 if channel == "V" else MOTION[channel], abs=1e-6)


@pytest.mark.parametrize("name", MAPS)
def test_each_input_sent_in_autopilots_unit_and_sign(name: str) -> None:
    for (path, expected), row in zip(
        SENT[name].items(), named_map(name).inputs.values(), strict=True
    ):
        assert path in (row.field, f"{row.message}.{row.field}")
        # The fields in us are integers.
        assert to_raw(row.trim + 0.1, row.conversion) == approx(expected, abs=1e-3)


@pytest.mark.parametrize("name", FOREIGN_MAPS)
def test_each_field_of_map_published_and_accepts_values_of_map(name: str) -> None:
    """A float32 has 24 bits, so that a value is kept to 1e-7 of its size.

    An integer field rounds to half a unit.
    """
    channel_map = named_map(name)
    foreign = {key: kind_ for key, _, kind_ in channel_map.used_topics() if kind_ in PUBLISHED}
    messages = {key: blank(kind_) for key, kind_ in foreign.items()}
    for key, row in channel_map.messages.items():
        message = messages[f"messages.{key}"]
        for path, value in row.values.items():
            set_field(message, path, list(value) if isinstance(value, tuple) else value)
            assert path in PUBLISHED[row.type]
        assert not row.stamped or "header" in PUBLISHED[row.type]
    for channel, input_row in channel_map.inputs.items():
        message = messages[f"messages.{input_row.message}"]
        kind_ = channel_map.messages[input_row.message].type
        ((field, place), *_) = STEP.findall(input_row.field)
        element, length, is_array, _ = kind(PUBLISHED[kind_][field])
        assert is_array, channel
        assert int(place) < (length or 0), channel
        for raw in (
            *input_row.range,
            input_row.neutral,
            input_row.release,
            to_raw(input_row.trim + 0.123, input_row.conversion),
        ):
            # Trim, or nothing to be sent.
            if not isinstance(raw, float):
                continue
            set_field(message, input_row.field, raw)
            error = 1e-7 * abs(raw) if element == "float32" else 0.5
            assert get_field(message, input_row.field) == approx(
                raw, rel=0.0, abs=error, nan_ok=True
            )
    readers: dict[str, MeasuredRow | OverrideRow] = {
        "outputs." + channel: row for channel, row in channel_map.outputs.items()
    }
    readers |= {
        "pose." + angle: row for angle, row in channel_map.pose.items() if row.function == "value"
    }
    readers |= {"overrides." + channel: row for channel, row in channel_map.overrides.items()}
    for key, reader in readers.items():
        if key in messages:
            assert read_raw(messages[key], reader.field, "value") == 0.0
            needs_header = getattr(reader, "stamp", "arrival") == "header"
            assert not needs_header or "header" in PUBLISHED[reader.type], key


@pytest.mark.parametrize("name", MAPS)
def test_each_input_of_map_states_own_trim_and_sign(name: str) -> None:
    """A merged row would pass a changed trim or sign of the elevator to the other inputs."""
    inputs = MAP_FILES[name].read_text().split("\ninputs:\n")[1].split("\n\n")[0]
    assert [inputs.count(f"\n    {key}: ") for key in ("trim", "sign")] == 2 * [
        len(named_map(name).inputs)
    ]


MEASURED = {  # Hz, as the stack receives them from PX4 1.16.0 and ArduPlane 4.8.0-dev in SITL
    "px4": {"vehicle_odometry": 99.2, "airspeed_validated": 9.9, "vehicle_status_v1": 2.0},
    "ardupilot_mavlink": {
        "ATTITUDE": 40.0,
        "VFR_HUD": 20.0,
        "LOCAL_POSITION_NED": 20.0,
        "HEARTBEAT": 5.0,
        "EXTENDED_SYS_STATE": 2.0,
    },
    "ardupilot": {
        "imu/experimental/data": 139.0,
        "airspeed": 28.4,
        "pose/filtered": 28.4,
        "rc": 9.6,
        "status": 1.9,
    },
}


@pytest.mark.parametrize("name", MEASURED)
def test_lost_message_does_not_end_engagement(name: str) -> None:
    """Each age limit is longer than two periods at the measured rate."""
    channel_map = named_map(name)
    rows = (*channel_map.outputs.values(), *channel_map.pose.values(), *channel_map.trims.values())
    ages = [(row.topic, row.max_age) for row in rows] + [
        (row.topic, row.max_age) for row in channel_map.conditions.values()
    ]
    for topic, rate in MEASURED[name].items():
        result = [
            age
            for full, age in ages
            if full.removeprefix("/fmu/out/").removeprefix("/ap/").removeprefix("mavlink/") == topic
        ]
        assert result, topic
        assert min(result) > 2.0 / rate, topic


def test_check_map_tells_which_rows_hold_for_each_release(tmp_path: Path) -> None:
    """The definitions are as a release publishes them.

    "2" has another topic for the status, and no true airspeed.
    """
    versions = {"1": {"VehicleStatus": 1}, "2": {"VehicleStatus": 4}}
    for release, of_release in versions.items():
        messages = tmp_path / release / "msg"
        messages.mkdir(parents=True)
        (messages.parent / "package.xml").write_text("<package><name>px4_msgs</name></package>")
        for type_name, fields in PUBLISHED.items():
            if type_name.startswith("px4_msgs/"):
                name = type_name.rpartition("/")[2]
                lines = [
                    f"uint32 MESSAGE_VERSION = {of_release.get(name, 0)}",
                    "uint8 ARMING_STATE_ARMED = 2",
                ]
                lines += [
                    f"{of} {field}"
                    for field, of in fields.items()
                    if (release, field) != ("2", "true_airspeed_m_s")
                ]
                (messages / f"{name}.msg").write_text("\n".join(lines))
    options = [word for release in versions for word in ("--definitions", str(tmp_path / release))]
    result = invoke("check", "px4", *options, "--json")
    assert result.exit_code == 1
    status = "/fmu/out/vehicle_status_v1: version 4, whose topic is /fmu/out/vehicle_status_v4"
    found = {
        row["key"]: row["faults"] for row in json.loads(result.output)["rows"] if any(row["faults"])
    }
    assert found == {
        "outputs.V": ["", "no true_airspeed_m_s"],
        "conditions.armed": ["", status],
        "conditions.offboard": ["", status],
    }
    single = invoke("check", "px4", *options[:2])
    assert single.exit_code == 0
    assert "1: 24 of 24 rows hold" in single.output
    refused = invoke("check", "px4", "--definitions", str(tmp_path / "1" / "msg"))
    assert "expected a folder with the sources of a message package" in str(refused.exception)


def test_check_map_of_mavlink_without_pymavlink_is_one_sentence(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(installation, "find_spec", lambda name: None)
    result = invoke("check", "ardupilot_mavlink", "--definitions", "installed")
    assert str(result.exception) == "the Python package pymavlink is not installed: make autopilot"


@pytest.mark.parametrize(
    "key, change, fault",
    [
        ("v_north", {"turned_by": "pose.pose.orientatoin"}, "no orientatoin"),
        ("phi", {"field": "pose.covariance"}, "pose.covariance: no w, x, y, z"),
        ("north", {"field": "pose.pose.position"}, "pose.pose.position: no number"),
    ],
)
def test_check_map_finds_field_that_row_cannot_use(
    key: str, change: dict[str, str], fault: str, tmp_path: Path
) -> None:
    content = yaml.safe_load(MAP_FILES["odometry"].read_text())
    content["pose"][key] |= change
    (tmp_path / "changed.yaml").write_text(yaml.safe_dump(content))
    result = invoke("check", str(tmp_path / "changed.yaml"), "--definitions", "installed", "--json")
    found = {
        row["key"]: row["faults"] for row in json.loads(result.output)["rows"] if any(row["faults"])
    }
    assert found == {f"pose.{key}": [fault]}


def test_request_of_a_service_is_checked_against_the_sources_of_a_package(tmp_path: Path) -> None:
    """The fields of the answer, below the line ---, are not checked."""
    (tmp_path / "package.xml").write_text("<package><name>ardupilot_msgs</name></package>")
    for section in ("msg", "srv"):
        (tmp_path / section).mkdir()
    service = tmp_path / "srv" / "ModeSwitch.srv"
    channel_map = named_map("ardupilot")
    for text, fault in (
        ("uint8 mode\n---\nbool status", None),
        ("uint8 number\n---\nuint8 mode", Refusal("no mode")),
    ):
        service.write_text(text)
        kinds = [kind for _, _, kind in channel_map.used_topics()]
        rows = check_map(channel_map, [definitions_below(tmp_path, kinds)])
        assert [row.faults for row in rows if row.key == "messages.mode_after"] == [(fault,)]


def test_service_is_requested_and_does_not_fly() -> None:
    """The answer takes a round trip, so setpoints and heartbeats must be messages."""
    content = named_map("ardupilot").model_dump()
    assert [name for name, row in named_map("ardupilot").messages.items() if row.is_service] == [
        "mode_after"
    ]
    content["messages"]["mode_after"]["when"] = "heartbeat"
    with refusing(r"messages\.mode_after\.type: found the service ardupilot_msgs/srv/ModeSwitch"):
        ChannelMap.validate_mapping(content, "map")


shipped = cache(named_map)  # parsed once, not for each example
ANGLE = st.floats(-math.pi, math.pi)
# x east, y north, z up.
TURN_NED_ENU = Rotation.from_matrix([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
TURN_FLU_FRD = Rotation.from_matrix(np.diag([1.0, -1.0, -1.0]))


@pytest.mark.parametrize("name", ["ardupilot", "odometry", "px4"])
@given(phi=ANGLE, theta=st.floats(-1.5, 1.5), psi=ANGLE)
def test_attitude_of_map_is_that_of_body_frd_in_ned(
    name: str, phi: float, theta: float, psi: float
) -> None:
    """The attitude is checked by SciPy's rotations.

    PX4 publishes body FRD in NED, and the others body FLU in ENU (REP 103).
    """
    frd_in_ned = Rotation.from_euler("ZYX", [psi, theta, phi])
    channel_map = shipped(name)
    x, y, z, w = (
        (frd_in_ned if name == "px4" else TURN_NED_ENU * frd_in_ned * TURN_FLU_FRD)
        .as_quat()
        .tolist()
    )
    quaternion = [w, x, y, z] if name == "px4" else Message(w=w, x=x, y=y, z=z)
    bridge = Bridge(channel_map, dry_run=True)
    for channel in ("phi", "theta", "psi"):
        bridge.take_output(
            channel, read_raw(Message(q=quaternion), "q", channel_map.pose[channel].function), 1, 1
        )
    names, pose = bridge.pose(1) or ((), None)
    assert names == ("phi", "theta", "psi")
    assert pose is not None
    expected = np.array([phi, theta, psi])
    error = np.array(
        [math.remainder(difference, math.tau) for difference in (pose.value - expected).tolist()]
    )
    assert np.abs(error).max() < 2e-6  # the offset of psi in a map has seven digits
    assert np.abs(pose.value).max() <= math.pi


# 40 m north and 30 m east of the origin, 20 m above it; 4 m/s north, 3 m/s east, climbing at 2 m/s
POSES = {
    "ardupilot": Message(
        pose=Message(position=Message(x=30.0, y=40.0, z=20.0)),
        twist=Message(linear=Message(x=3.0, y=4.0, z=2.0)),
    ),
    "px4": Message(position=[40.0, 30.0, -20.0], velocity=[4.0, 3.0, -2.0]),
}


@pytest.mark.parametrize("name", POSES)
def test_position_and_velocity_are_north_east_and_up(name: str) -> None:
    rows = named_map(name).pose
    expected = {
        "north": 40.0,
        "east": 30.0,
        "altitude": 20.0,
        "v_north": 4.0,
        "v_east": 3.0,
        "climb": 2.0,
    }
    for channel, value in expected.items():
        row = rows[channel]
        assert to_channel(read_raw(POSES[name], row.field, row.function), row.conversion) == value


@given(phi=ANGLE, theta=st.floats(-1.5, 1.5), psi=ANGLE)
def test_velocity_in_body_axes_of_odometry_is_turned_to_the_world(
    phi: float, theta: float, psi: float
) -> None:
    """Odometry has its twist in the body frame, FLU (nav_msgs, REP 103).

    SciPy turns 4 m/s north, 3 east and 2 up into this frame.
    """
    flu_in_enu = TURN_NED_ENU * Rotation.from_euler("ZYX", [psi, theta, phi]) * TURN_FLU_FRD
    x, y, z, w = (2.0 * flu_in_enu.as_quat()).tolist()  # a quaternion of any length
    forward, left, up = flu_in_enu.inv().apply([3.0, 4.0, 2.0]).tolist()
    odometry = Message(
        pose=Message(pose=Message(orientation=Message(w=w, x=x, y=y, z=z))),
        twist=Message(twist=Message(linear=Message(x=forward, y=left, z=up))),
    )
    for channel, expected in (("v_north", 4.0), ("v_east", 3.0), ("climb", 2.0)):
        row = shipped("odometry").pose[channel]
        raw = read_raw(odometry, row.field, row.function, row.turned_by)
        assert to_channel(raw, row.conversion) == approx(expected, abs=1e-12)


@pytest.mark.parametrize("quaternion", [[0.0] * 4, [math.nan, 0.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
def test_a_quaternion_without_an_attitude_is_refused(quaternion: list[float]) -> None:
    for function in ("roll_of_quaternion", "pitch_of_quaternion", "yaw_of_quaternion"):
        with pytest.raises(ChannelError, match="cannot convert q"):
            read_raw(Message(q=quaternion), "q", function)
    with pytest.raises(ChannelError, match=r"v\.x of \w+ cannot be turned by q"):
        read_raw(Message(q=quaternion, v=Message(x=1.0, y=0.0, z=0.0)), "v.x", "value", "q")


@given(CONVERSIONS, st.floats(-1e4, 1e4))
def test_sending_value_and_reading_it_back_gives_value(
    conversion: LinearConversion, channel: float
) -> None:
    assert to_channel(to_raw(channel, conversion), conversion) == approx(
        channel, rel=1e-12, abs=1e-9
    )


@given(st.floats(0.0, 300.0))
def test_speed_of_dynamic_pressure_is_one_that_makes_it(speed: float) -> None:
    message = Message(fluid_pressure=0.5 * 1.225 * speed**2)
    assert read_raw(message, "fluid_pressure", "airspeed_of_pressure") == approx(speed, abs=1e-6)


def test_fields_are_reached_by_their_paths() -> None:
    message = Message(
        twist=Message(angular=Message(y=1.5)), axes=[0.0, 2.5], parts=[Message(z=3.5)]
    )
    assert get_field(message, "twist.angular.y") == 1.5
    assert get_field(message, "axes[1]") == 2.5
    set_field(message, "parts[0].z", 4.5)
    assert message.parts[0].z == 4.5
    for path in ("twist.linear.y", "axes[2]", "axes.x", "twist[0]"):
        with pytest.raises(ChannelError, match="has no"):
            get_field(message, path)


def test_values_of_integer_fields_rounded_and_never_wrapped() -> None:
    message = Message(channels=np.zeros(18, dtype=np.uint16))
    set_field(message, "channels[1]", 1595.5001)
    assert message.channels[1] == 1596
    for wrong in (math.nan, -1.0, 70000.0):
        with pytest.raises(ChannelError):
            set_field(message, "channels[1]", wrong)
    assert message.channels[1] == 1596


@pytest.mark.parametrize("raw", [math.nan, math.inf])
def test_value_that_is_not_finite_refused(raw: float) -> None:
    with pytest.raises(ChannelError, match="not finite") as error:
        read_raw(Message(q=raw), "q", "value")
    assert error.value.reason == "finite"


def test_missing_message_package_is_one_sentence_that_tells_how_to_get_it() -> None:
    expected = (
        r"absent_msgs/msg/State: .*make messages PACKAGE=absent_msgs SOURCE=FOLDER "
        r".*ros-jazzy-absent-msgs"
    )
    with refusing(expected):
        message_type("absent_msgs/msg/State")


ROW = load_map("ardupilot").pose["phi"].model_dump()
# Invalid values: (key path, value) and the sentence of the refusal.
REFUSALS: tuple[tuple[tuple[str, ...], object, str], ...] = (
    (("outputs", "q", "sign"), 2, r"map test\.outputs\.q\.sign: found 2, expected 1 or -1|-1 or 1"),
    (("outputs", "q", "type"), "TwistStamped", r"map test\.outputs\.q\.type"),
    (
        ("inputs", "elevator", "field"),
        "axes[0]",
        r"map test\.inputs\.aileron\.field: found axes\[0\], the field of elevator",
    ),
    (("inputs", "elevator", "lower"), 0.1, r"map test\.inputs\.elevator\.lower: found 0\.1"),
    (
        ("messages", "joy", "when"),
        "heartbeat",
        r"map test\.inputs\.elevator\.message: found one sent when heartbeat",
    ),
    (
        ("overrides", "gamepad", "moved"),
        0.1,
        r"map test\.overrides\.gamepad: found above and moved",
    ),
    (("topics", "/ap/joy", "depth"), 0, r"map test\.topics\./ap/joy\.depth"),
    (
        ("envelope",),
        {"beta": [-0.1, 0.1]},
        r"map test\.envelope\.beta: found a channel, expected one of .* phi, .*, r",
    ),
    (
        ("outputs", "phi"),
        ROW | {"positive": "roll right"},
        r"map test\.outputs\.phi: found a channel of the pose too",
    ),
)


@pytest.mark.parametrize(
    "place, value, sentence",
    REFUSALS,
    ids=lambda argument: ".".join(argument) if isinstance(argument, tuple) else "",
)
def test_bad_map_is_one_sentence_that_names_row(
    place: tuple[str, ...], value: object, sentence: str
) -> None:
    content = yaml.safe_load(MAP_FILES["ardupilot_2024"].read_text())
    part = content
    for key in place[:-1]:
        part[key] = dict(part[key])  # merged keys share one object
        part = part[key]
    part[place[-1]] = value
    with refusing(sentence) as error:
        ChannelMap.validate_mapping(content, "map test")
    assert "\n" not in str(error.value)


def test_a_missing_map_is_one_sentence() -> None:
    sentence = (
        r"bridge\.map: found 'nowhere', expected one of ardupilot, ardupilot_mavlink, "
        r"px4, or the path of a channel map"
    )
    with refusing(sentence):
        BridgeConfig.validate_mapping({"map": "nowhere"}, "bridge")
    with refusing("lockstep"):
        BridgeConfig.validate_mapping({"map": "px4", "lockstep": True}, "bridge")


def test_message_that_the_installed_package_lacks_is_refused() -> None:
    with refusing("found no Airspeed in the installed px4_msgs"):
        message_type("px4_msgs/msg/Airspeed", lambda name: Message(Airspeed=0))
