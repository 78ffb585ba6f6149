# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Convert between a field of a message, given by its path, and a channel of y or u.

The functions work on any object that has the published field names, so they need no message
package. Arrays of a message may be lists, array.array or NumPy arrays.
"""

import importlib
import math
import re
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

from flight_core.environment import PROFILE_VARIABLE
from flight_core.installation import missing
from flight_core.outcome import Refusal
from flight_core.parameters import ParameterError
from flight_core.vectors import ChannelError, SampleFault

# The path of a field: names separated by dots. Each name may have an index in brackets.
PATH = re.compile(r"[A-Za-z]\w*(\[\d+\])?(\.[A-Za-z]\w*(\[\d+\])?)*")
STEP = re.compile(r"(\w+)(?:\[(\d+)\])?")
VERSION = re.compile(r"_v\d+$")  # suffix of a versioned topic of PX4
# kg/m^3, ISO 2533. With this density, the speed of a dynamic pressure is the indicated airspeed.
SEA_LEVEL_DENSITY = 1.225


class LinearConversion(NamedTuple):
    """The conversion from a raw value to a channel: channel = sign scale raw + offset.

    The channel is in SI and radians, and the raw value is in the autopilot's unit.
    """

    sign: int  # +1 or -1
    scale: float  # above 0, units of the channel per unit of the raw value
    offset: float  # unit of the channel


def to_channel(raw: float, conversion: LinearConversion) -> float:
    """Convert a raw value to a channel: sign scale raw + offset."""
    return conversion.sign * conversion.scale * raw + conversion.offset


def to_raw(channel: float, conversion: LinearConversion) -> float:
    """Convert a channel to a raw value: sign (channel - offset) / scale."""
    return conversion.sign * (channel - conversion.offset) / conversion.scale


def get_field(message: Any, path: str) -> Any:
    """Return the value at a path such as "twist.angular.y" or "axes[1]".

    Raises ChannelError with the reason "field" if there is no value at the path.
    """
    value = message
    for name, place in STEP.findall(path):
        try:
            value = getattr(value, name)
            if place:
                value = value[int(place)]
        except (AttributeError, IndexError, TypeError):
            raise ChannelError(
                SampleFault.FIELD, f"{type(message).__name__} has no {path}"
            ) from None
    return value


def set_field(message: Any, path: str, value: Any) -> None:
    """Set the value at a path.

    If the field is an integer, a number is rounded, and NaN, infinity and values outside the range
    of the type are refused. Raises ChannelError with the reason "field" or "range".
    """
    current = get_field(message, path)
    if isinstance(current, int | np.integer) and isinstance(value, float):
        if not math.isfinite(value):
            raise ChannelError(SampleFault.RANGE, f"{path} takes integers, not {value:g}")
        value = round(value)
    # NumPy 1.26 would wrap a value beyond the range.
    if (
        isinstance(current, np.integer)
        and not np.iinfo(current).min <= value <= np.iinfo(current).max
    ):
        raise ChannelError(
            SampleFault.RANGE, f"{path} cannot be {value!r}, which {current.dtype} does not hold"
        )
    parents, _, last = path.rpartition(".")
    parent, ((name, place),) = get_field(message, parents), STEP.findall(last)
    try:
        if place:
            getattr(parent, name)[int(place)] = value
        else:
            setattr(parent, name, value)
    except (AssertionError, OverflowError, TypeError, ValueError) as error:
        raise ChannelError(SampleFault.RANGE, f"{path} cannot be {value!r} ({error})") from None


def _norm(vector: Any) -> float:
    """Return sqrt(x^2 + y^2 + z^2) of a vector with members x, y, z or with three elements."""
    parts = (vector.x, vector.y, vector.z) if hasattr(vector, "x") else vector
    return math.hypot(*(float(part) for part in parts))


def _airspeed_of_pressure(pressure: Any) -> float:
    """Return the indicated airspeed sqrt(2 dp / rho_0), m/s, for a dynamic pressure in Pa.

    For a negative pressure, which is noise, the result is 0.
    """
    return math.sqrt(2.0 * max(float(pressure), 0.0) / SEA_LEVEL_DENSITY)


def _quaternion(field: Any) -> tuple[float, float, float, float]:
    """Return (w, x, y, z) of a quaternion, scaled to the length 1.

    The field has members w, x, y, z. It may also have four elements in this order, as PX4 publishes
    them.
    """
    w, x, y, z = (field.w, field.x, field.y, field.z) if hasattr(field, "w") else field
    w, x, y, z = float(w), float(x), float(y), float(z)
    # The squares of the components might underflow or overflow.
    if not 0.0 < (length := math.hypot(w, x, y, z)) < math.inf:
        raise ValueError("a quaternion of length 0, infinity or NaN has no angles")
    return w / length, x / length, y / length, z / length


def _roll(field: Any) -> float:
    """Return the roll angle of a quaternion, rad.

    Roll is the last of the rotations about z, y, x from the world to the body.
    """
    w, x, y, z = _quaternion(field)
    return math.atan2(2.0 * (w * x + y * z), w * w - x * x - y * y + z * z)


def _pitch(field: Any) -> float:
    """Return the pitch angle of a quaternion, rad, in -pi/2..pi/2."""
    w, x, y, z = _quaternion(field)
    return math.asin(max(-1.0, min(1.0, 2.0 * (w * y - x * z))))


def _yaw(field: Any) -> float:
    """Return the yaw angle of a quaternion, rad."""
    w, x, y, z = _quaternion(field)
    return math.atan2(2.0 * (w * z + x * y), w * w + x * x - y * y - z * z)


DERIVED: Mapping[str, Callable[[Any], float]] = MappingProxyType(
    {
        "value": float,
        "norm": _norm,
        "airspeed_of_pressure": _airspeed_of_pressure,
        "roll_of_quaternion": _roll,
        "pitch_of_quaternion": _pitch,
        "yaw_of_quaternion": _yaw,
    }
)
"""Functions from a field to the raw value.

They give the number itself, the length of a vector, the airspeed for a dynamic pressure, or the
Euler angles (z, y, x) of a quaternion. A message may have the angles of body FLU in ENU. These are
roll, -pitch and pi/2 - yaw of body FRD in NED, so the row converts them by its sign and its offset.
"""

QUATERNION = "wxyz"
COMPONENTS: Mapping[str, str] = MappingProxyType(
    dict.fromkeys(DERIVED, "")
    | {name: QUATERNION for name in DERIVED if name.endswith("quaternion")}
    | {"norm": "xyz"}
)
"""The members that the field must have for each function; none if it is a number."""


def _turned(message: Any, path: str, attitude: str) -> float:
    """Return a component of R(q) v: the vector v rotated from the body to the world.

    `path` ends in .x, .y or .z after the path of v. `attitude` is the path of the quaternion q.
    R(q) v = v + 2 (w r x v + r x (r x v)) with q = (w, r), |q| = 1.
    """
    vector, _, axis = path.rpartition(".")
    v = np.array([float(get_field(message, f"{vector}.{name}")) for name in "xyz"])
    w, *r = _quaternion(get_field(message, attitude))
    across = np.cross(r, v)
    v_world = v + 2.0 * (w * across + np.cross(r, across))
    return float(v_world["xyz".index(axis)])


def read_raw(message: Any, path: str, function: str, turned_by: str | None = None) -> float:
    """Return the raw value of a row: `function` of the field at `path`.

    If `turned_by` is given, it is the path of a quaternion that rotates a vector from the body to
    the world. The raw value is then the component of the rotated vector that `path` names. Raises
    ChannelError, with the reason "field" if the field is missing or cannot be converted, and
    "finite" if its value is not finite.
    """
    value = get_field(message, path)
    try:
        raw = DERIVED[function](value) if turned_by is None else _turned(message, path, turned_by)
    except (AttributeError, TypeError, ValueError):
        field = f"{path} of {type(message).__name__}"
        cause = f"function {function} cannot convert {field}"
        if turned_by is not None:
            cause = f"{field} cannot be turned by {turned_by}"
        raise ChannelError(SampleFault.FIELD, cause) from None
    if not math.isfinite(raw):
        raise ChannelError(SampleFault.FINITE, f"{path} = {raw} is not finite")
    return raw


def message_type(name: str, load: Callable[[str], Any] = importlib.import_module) -> type:
    """Return the class of "package/msg/Type" or "package/srv/Type".

    Raises ParameterError if the package is not installed or has no such type. The message of the
    error names the package.
    """
    package, section, kind = name.split("/")
    try:
        module = load(f"{package}.{section}")
    except ModuleNotFoundError:
        raise ParameterError(f"{name}: {missing(package)}") from None
    message_class = getattr(module, kind, None)
    if not isinstance(message_class, type):
        raise ParameterError(
            f"{name}: found no {kind} in the installed {package}, expected another version of "
            f"{package}"
        )
    return message_class


def versioned_topic(topic: str, version: int) -> str:
    """Return the name of a PX4 topic for a version of its message definition.

    The name is /fmu/.../NAME_vVERSION, and version 0 has no suffix. Names of other topics stay as
    they are. A definition states its version as MESSAGE_VERSION. Source: PX4 guide, PX4 ROS 2
    message translation node.
    """
    if topic.startswith("/fmu/"):
        return VERSION.sub("", topic) + (f"_v{version}" if version else "")
    return topic


def version_fault(topic: str, message_class: Any) -> Refusal | None:
    """Say why the version in the name of a PX4 topic is wrong, or return None if it is right."""
    version = getattr(message_class, "MESSAGE_VERSION", None)
    if version is None:
        return None
    expected = versioned_topic(topic, version)
    definition = f"the installed {message_class.__name__} has version {version}"
    if topic == expected:
        return None
    return Refusal(
        f"{topic}: {definition}, whose topic is {expected}: change the map, or install "
        "the message package of the autopilot's release"
    )


def version_faults(
    topics: Iterable[tuple[str, str]], load: Callable[[str], Any] = importlib.import_module
) -> list[Refusal]:
    """Return the faults of the topics whose name has the wrong version, as in `version_fault`.

    Topics whose message package is not installed cannot be checked, so they are left out.
    """
    faults = []
    for topic, kind in dict.fromkeys(topics):
        with suppress(ParameterError):
            faults.append(version_fault(topic, message_type(kind, load)))
    return [fault for fault in faults if fault is not None]


def no_publisher(environment: Mapping[str, str]) -> str:
    """Say why a topic of an autopilot may have no publisher."""
    domain = environment.get("ROS_DOMAIN_ID") or "0"
    if domain != "0":
        return (
            f"no publisher in domain {domain}. The autopilot's agent is in domain 0 unless "
            "DDS_DOMAIN_ID (ArduPilot) or UXRCE_DDS_DOM_ID (PX4) has another: unset ROS_DOMAIN_ID"
        )
    return (
        "no publisher. The autopilot's agent needs the same DDS profile, "
        f"{PROFILE_VARIABLE}={environment.get(PROFILE_VARIABLE, '')}, and DDS_DOMAIN_ID "
        "(ArduPilot) or UXRCE_DDS_DOM_ID (PX4) 0"
    )
