# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""The maps of PX4, MAVROS and ROSflight with the real message packages, where these are installed.

None of them is on PyPI; `make messages` builds each from its sources (docs/autopilots-reference.md). Without them
tests/pure/test_channel_map.py tests each row with the published fields.
"""

from importlib.util import find_spec
from types import SimpleNamespace
from typing import Any

import pytest
from rclpy.serialization import deserialize_message, serialize_message
from tests.maps import named_map
from tests.published_messages import PACKAGES, PUBLISHED, kind
from tests.pure.test_channel_map import AIRSPEED, MAPS, MOTION, RATES, SENT

from autopilot_bridge.channel_map import get_field, message_type, read_raw, set_field, to_channel, to_raw
from autopilot_bridge.params import ChannelMap

pytestmark = pytest.mark.package("autopilot_bridge")

AS_PYTHON = {"float32": "float", "bool": "boolean"}  # as rclpy names the types of a definition


ROS_MAPS = [name for name in MAPS if named_map(name).link is None]  # tests/pure/test_mavlink_link.py has those over MAVLink


def needs(*packages: str) -> None:
    """Skip where a message package is not installed."""
    for package in packages:
        if find_spec(package) is None:
            pytest.skip(f"no {package}: make messages PACKAGE={package} SOURCE=FOLDER, the sources of {PACKAGES[package]}")


def needs_packages_of(channel_map: ChannelMap) -> None:
    needs(*sorted({kind_.split("/")[0] for _, _, kind_ in channel_map.used_topics()} & PACKAGES.keys()))


@pytest.mark.parametrize("name", PUBLISHED)
def test_the_package_has_the_published_fields(name: str) -> None:
    needs(name.partition("/")[0])
    found: dict[str, str] = message_type(name).get_fields_and_field_types()  # type: ignore[attr-defined]
    for field, published in PUBLISHED[name].items():
        element, length, is_array, most = kind(published)
        element = AS_PYTHON.get(element, element)
        sequence = f"sequence<{element}, {most}>" if most else f"sequence<{element}>"
        expected = f"{element}[{length}]" if length else sequence if is_array else element
        assert found[field] == expected


def fill(message: Any, like: SimpleNamespace) -> Any:
    """Set the fields of a message to those of a plain object."""
    for name, value in vars(like).items():
        if isinstance(value, SimpleNamespace):
            fill(getattr(message, name), value)
        else:
            setattr(message, name, value)
    return message


@pytest.mark.parametrize("channels", ["qpr", "V"])
@pytest.mark.parametrize("name", ROS_MAPS)
def test_outputs_are_read_from_real_messages(name: str, channels: str) -> None:
    channel_map = named_map(name)
    needs_packages_of(channel_map)
    for channel in channels:
        row = channel_map.outputs[channel]
        message = fill(message_type(row.type)(), AIRSPEED[name] if channel == "V" else RATES[name])
        message = deserialize_message(serialize_message(message), type(message))
        value = to_channel(read_raw(message, row.field, row.function), row.line)
        assert value == pytest.approx(2.0 if channel == "V" else MOTION[channel], abs=1e-6)  # float32


@pytest.mark.parametrize("name", ROS_MAPS)
def test_inputs_are_written_into_real_messages(name: str) -> None:
    channel_map = named_map(name)
    needs_packages_of(channel_map)
    for (path, expected), row in zip(SENT[name].items(), channel_map.inputs.values(), strict=True):
        message = message_type(channel_map.messages[row.message].type)()
        for field, value in channel_map.messages[row.message].values.items():
            set_field(message, field, value)
        set_field(message, row.field, to_raw(row.trim + 0.1, row.line))
        message = deserialize_message(serialize_message(message), type(message))
        whole = name == "mavros"  # us
        assert get_field(message, row.field) == pytest.approx(expected, abs=0.5 if whole else 1e-3), path
