# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Define the rows of a channel map: channels, messages, conditions and parameters."""

from collections.abc import Mapping
from itertools import product
from types import MappingProxyType
from typing import Annotated, Literal, get_args

from autopilot_bridge.channel_map import PATH, LinearConversion
from flight_core.fields import Field
from flight_core.parameters import Config, NonNegative, Number, Numbers, Positive, Rate, require

MAVLINK = "mavlink"  # package of MAVLink's message types, and first part of their topics

Motion = Literal[
    "nose up",
    "nose down",
    "roll right",
    "roll left",
    "nose right",
    "nose left",
    "faster",
    "slower",
    "more thrust",
    "less thrust",
    "climbs",
    "sinks",
]

MOTIONS: Mapping[str, tuple[str, int]] = MappingProxyType(
    dict(zip(get_args(Motion), product(("q", "p", "r", "V", "V", "climb"), (1, -1)), strict=True))
)
"""The output that shows a motion, and its sign: FRD, q nose up +, p roll right +, r nose right +, V
faster +, climb up +."""

UNITS: Mapping[str, str] = MappingProxyType(
    dict.fromkeys(("q", "p", "r"), "rad/s") | dict.fromkeys(("V", "climb"), "m/s")
)
"""The unit of the output that shows a motion."""

Function = Literal[
    "value",
    "norm",
    "airspeed_of_pressure",
    "roll_of_quaternion",
    "pitch_of_quaternion",
    "yaw_of_quaternion",
]
MessageType = Annotated[str, Field(pattern=r"^[a-z]\w*/msg/[A-Z]\w*$")]
SentType = Annotated[str, Field(pattern=r"^[a-z]\w*/(msg|srv)/[A-Z]\w*$")]
TopicName = Annotated[str, Field(pattern=r"^/?[A-Za-z_]\w*(/[A-Za-z_]\w*)*$")]
SystemId = Annotated[int, Field(ge=1, le=255)]
# A value of a message field. NaN, infinity and FLT_MAX may mean "no value".
Raw = Annotated[float, Field(allow_inf_nan=True)]
Integer = Annotated[int, Field(ge=-(2**63), lt=2**64)]  # a message field may be int64 to uint64
Mask = Annotated[int, Field(gt=0, lt=2**64)]
# The lowest rate of termios, and the highest of the USB converter FT232H.
Baud = Annotated[int, Field(ge=50, le=12_000_000)]
Limits = tuple[Number, Number]
Value = bool | Integer | Raw | str | tuple[Integer, ...] | tuple[Raw, ...]


class Row(Config):
    """Base of a row of a map that converts a channel: channel = sign scale raw + offset."""

    field: str = Field(
        description="the path of the field in the message, such as twist.angular.y or axes[1]"
    )
    frame: str = Field(
        description="the frame and the unit of the raw value, as a note for the reader"
    )
    sign: Literal[-1, 1] = Field(
        description="+1, or -1 if the channel decreases while the raw value increases"
    )
    scale: Positive = Field(
        description="units of the channel (SI, radians) per unit of the raw value"
    )
    offset: Number = Field(description="the value of the channel at raw = 0, SI")
    source: str = Field(min_length=1, description="where the row comes from")

    @property
    def conversion(self) -> LinearConversion:
        """The conversion between the raw value and the channel."""
        return LinearConversion(self.sign, self.scale, self.offset)


class MovingRow(Row):
    """A row whose sign can be checked in flight, by the motion of the aircraft."""

    positive: Motion = Field(description="motion of the aircraft for an increasing raw value")

    @property
    def motion(self) -> tuple[str, int]:
        """The motion that shows the sign of this channel: an output, and the sign of its change.

        The output is a key of UNITS. As the channel grows, the output grows if the sign is +1, and
        falls if the sign is -1. `positive` describes the motion for a growing raw value, so `sign`
        is applied to it.
        """
        output, sign = MOTIONS[self.positive]
        return output, sign * self.sign


class MeasuredRow(Row):
    """A channel that the autopilot publishes, with its topic and its field."""

    topic: TopicName = Field(description="the autopilot's topic")
    type: MessageType = Field(description="its type, package/msg/Type")
    function: Function = Field(
        default="value",
        description="how the field becomes the raw value: as it is, by the length of a vector, the "
        "airspeed of a pressure, or an Euler angle",
    )
    turned_by: str | None = Field(
        default=None,
        description="the path of the quaternion that turns a vector from body axes to the world; "
        "`field` is a component of this vector",
    )
    stamp: Literal["header", "arrival"] = Field(
        description="stamp of the sample: the stamp in the message's header, or its arrival"
    )
    max_age: Positive = Field(description="the age above which the channel is stale, s")

    def _check(self) -> None:
        if self.turned_by is not None:
            component = self.field.endswith((".x", ".y", ".z")) and self.function == "value"
            require(
                component,
                "turned_by",
                f"{self.field} ({self.function})",
                "a component x, y or z of a vector (value)",
            )
            is_path = PATH.fullmatch(self.turned_by) is not None
            require(
                is_path,
                "turned_by",
                repr(self.turned_by),
                "the path of a quaternion, such as pose.pose.orientation",
            )


class PoseRow(MeasuredRow):
    """A channel of the pose, which is an absolute value.

    `sign` and `offset` convert the channel from the frame of the message to FRD, north, east, up.
    """


class OutputRow(MeasuredRow, MovingRow):
    """A channel of y, which is a deviation from trim."""

    captured: bool = Field(
        default=False,
        description="whether the channel begins at 0 at each engagement, instead of with the trim "
        "in `offset`",
    )
    held: bool = Field(
        default=False,
        description="whether y repeats the last value of a stale channel; use it for a vane, which "
        "the observer then leaves out",
    )
    low_pass: NonNegative = Field(
        default=0.0,
        description="time constant of a first-order low-pass filter, which delays y by this time, "
        "s; 0 for no filter",
    )


class InputRow(MovingRow):
    """A channel of u, which is a deviation from trim: trim + u = sign scale raw + offset.

    The row also has the message and the field of the setpoint.
    """

    message: str = Field(description="the message that has the field, one of `messages`")
    trim: Number = Field(
        description="the command in trim, to which u is added, SI; a row in `trims` replaces it"
    )
    lower: Annotated[Number, Field(le=0)] = Field(
        description="the lower limit of u around trim, SI"
    )
    upper: NonNegative = Field(description="the upper limit of u around trim, SI")
    range: Limits = Field(description="the lowest and the highest raw value of the field")
    neutral: Number | Literal["trim"] = Field(
        description="failsafe: the raw value that is sent when u has timed out, or trim"
    )
    at_limit: Positive | None = Field(
        default=None,
        description="how long u may stay at a limit while engaged, s; then the bridge disengages",
    )
    release: Raw | None = Field(
        description="the raw value that returns the channel to the autopilot, for example NaN; "
        "null if nothing is sent"
    )


class MessageRow(Config):
    """A message to the autopilot, or a request of a service.

    A message that carries no input is a heartbeat.
    """

    topic: TopicName = Field(description="the autopilot's topic or service")
    type: SentType = Field(description="its type, package/msg/Type or package/srv/Type")
    rate: Rate = Field(description="the rate at which it is sent, Hz")
    when: Literal["engaged", "heartbeat", "engaging", "release", "failsafe"] = Field(
        description="when it is sent. engaged: from the engagement to the end of the release; "
        "heartbeat: from the request to the release; engaging: while the engagement waits for a "
        "condition; release: during the release while the conditions hold; failsafe: like release, "
        "after a release that no pilot requested, even if the conditions are no longer reported"
    )
    stamped: bool = Field(description="whether header.stamp is set to the instant of sending")
    values: dict[str, Value] = Field(
        default={}, description="values of its other fields, by their paths"
    )

    @property
    def is_service(self) -> bool:
        """Whether the message is a request of a service."""
        return "/srv/" in self.type

    def _check(self) -> None:
        flies = self.is_service and self.when in {"engaged", "heartbeat"}
        require(
            not flies,
            "type",
            f"the service {self.type}",
            f"a message: an answer takes too long for when: {self.when}",
        )


class WatchedRow(Config):
    """A field of the autopilot's messages on which the engagement depends."""

    topic: TopicName = Field(description="the topic")
    type: MessageType = Field(description="its type, package/msg/Type")
    field: str = Field(description="the path of the field")
    source: str = Field(min_length=1, description="where the row comes from")
    bits: Mask | None = Field(
        default=None, description="for a bit field: mask of the bits that count"
    )

    def masked(self, raw: float) -> float:
        """Return the value of the bits in the mask."""
        return raw if self.bits is None else float(int(raw) & self.bits)


class ConditionRow(WatchedRow):
    """A condition of the engagement: the field must have a value that the row permits.

    If the field has another value, the bridge disengages.
    """

    one_of: Numbers = Field(
        default=(),
        description="the values with which the condition holds; false is 0 and true is 1",
    )
    within: Limits | None = Field(
        default=None, description="instead of `one_of`, the limits within which it holds"
    )
    sentence: str = Field(min_length=1, description="what is wrong if the condition does not hold")
    max_age: Positive = Field(description="the age above which the field is stale, s")
    awaited: bool = Field(
        default=False,
        description="whether an engagement waits for the condition, up to `engage_timeout`, "
        "instead of being refused",
    )
    transmitter: bool = Field(
        default=False,
        description="whether the field tells the loss of the pilot's transmitter; an engagement "
        "with `--blind` ignores such a row",
    )

    def is_met_by(self, raw: float) -> bool:
        """Return whether a raw value meets the condition."""
        value = self.masked(raw)
        if self.within is None:
            return value in self.one_of
        return self.within[0] <= value <= self.within[1]


class OverrideRow(WatchedRow):
    """A pilot override: the bridge disengages at once when the field exceeds the threshold."""

    above: Number | None = Field(
        default=None, description="the override is active if the field is above this"
    )
    below: Number | None = Field(
        default=None, description="the override is active if the field is below this"
    )
    moved: Positive | None = Field(
        default=None,
        description="the override is active if the field has moved by more than this since the "
        "engagement",
    )
    max_age: Positive = Field(
        default=1.0, description="the age above which the override is no longer active, s"
    )
    transmitter: bool = Field(
        default=True,
        description="whether the override has no effect without the pilot's transmitter",
    )

    def is_active(self, raw: float, at_engagement: float | None) -> bool:
        """Return whether the override is active at a raw value.

        `at_engagement` is the raw value at the engagement, or None if the bridge is not engaged.
        """
        raw = self.masked(raw)
        if self.moved is not None:
            return at_engagement is not None and abs(raw - self.masked(at_engagement)) > self.moved
        return (self.above is not None and raw > self.above) or (
            self.below is not None and raw < self.below
        )


class ParameterRow(Config):
    """A parameter of the autopilot that an engagement needs, read over the MAVLink link."""

    within: Limits = Field(
        description="the least and the greatest value with which the bridge engages"
    )
    sentence: str = Field(
        min_length=1, description="what another value does, and how to correct it"
    )
    source: str = Field(min_length=1, description="where the row comes from")


class QosRow(Config):
    """The quality of service of a topic."""

    reliability: Literal["reliable", "best_effort"]
    durability: Literal["volatile", "transient_local"]
    depth: Annotated[int, Field(ge=1, le=1000)]


class LinkConfig(Config):
    """The settings of a MAVLink link, for rows with the type mavlink/msg/NAME."""

    url: str = Field(
        pattern=r"^((udpin|udpout|tcp|tcpin):[^:]+:\d+|/dev/\S+)$",
        description="udpin:HOST:PORT, udpout:HOST:PORT, tcp:HOST:PORT or a serial device",
    )
    baud: Baud = Field(default=57600, description="the rate of a serial device, bit/s")
    system: SystemId = Field(
        default=1, description="the autopilot's system, MAV_SYSID; its component is 1"
    )
    source_system: SystemId = Field(
        default=255,
        description="the system that the map's messages come from: ArduPilot takes RC overrides "
        "only from its ground station, MAV_GCS_SYSID, by default 255. Everything else is sent as "
        "the autopilot's companion computer",
    )
    station_silence: Positive | None = Field(
        default=None,
        description="how long the ground station with the number `source_system` may be silent "
        "once it was heard, s. Then the bridge disengages, because the autopilot takes the RC "
        "overrides for heartbeats of the station. null: for any time",
    )
    passphrase_file: str | None = Field(
        default=None,
        description="a file with the passphrase of an autopilot that signs; the key is the SHA-256 "
        "of the passphrase",
    )
    rates: dict[str, Rate] = Field(default={}, description="requested rates by message, Hz")


class SilenceConfig(Config):
    """The failsafe that acts if u times out while the bridge is engaged.

    When it acts, the bridge sends neutral values, then release values, and then nothing.
    """

    max_age: Positive = Field(description="the age above which u has timed out, s")
    neutral: NonNegative = Field(
        description="how long the neutral values are then sent, s; 0 skips them"
    )
    release: NonNegative = Field(
        description="how long the release values are then sent, s; 0 skips them"
    )
