# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Schema of a channel map file, and the parameters of the bridge node."""

import re
from collections.abc import Mapping
from importlib.resources import files
from itertools import chain, product
from pathlib import Path
from types import MappingProxyType
from typing import Annotated, Any, Literal, get_args

from autopilot_bridge.channel_map import COMPONENTS, PATH, QUATERNION, Line, to_raw
from flight_core.channels import POSE
from flight_core.fields import Field
from flight_core.files import find_file, names_in, read_yaml
from flight_core.parameters import (
    Config,
    Name,
    NodeConfig,
    NonNegative,
    Number,
    Numbers,
    Positive,
    require,
)

LIBRARY = Path(str(files("autopilot_bridge"))) / "maps"

MAVLINK = "mavlink"  # the package of the types of MAVLink messages, and the begin of their topics

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
"""What responds to a motion, and its sign: FRD, q nose up +, p roll right +, r nose right +, V
faster +, climb up +."""

UNITS: Mapping[str, str] = MappingProxyType(
    dict.fromkeys(("q", "p", "r"), "rad/s") | dict.fromkeys(("V", "climb"), "m/s")
)
"""The unit of what responds to a motion."""

Rate = Annotated[float, Field(ge=1, le=1000)]
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
PARAMETER = re.compile(
    r"[A-Z][A-Z0-9_]{0,15}"
)  # the name of a parameter; common.xml, PARAM_VALUE: 16 characters
SystemId = Annotated[int, Field(ge=1, le=255)]
Raw = Annotated[
    float, Field(allow_inf_nan=True)
]  # of a message field, which may be NaN, infinite or FLT_MAX for "no value"
Integer = Annotated[int, Field(ge=-(2**63), lt=2**64)]  # of a message field: from int64 to uint64
Mask = Annotated[int, Field(gt=0, lt=2**64)]
Baud = Annotated[
    int, Field(ge=50, le=12_000_000)
]  # the least of termios, the highest of the USB converter FT232H
Limits = tuple[Number, Number]
Value = bool | Integer | Raw | str | tuple[Integer, ...] | tuple[Raw, ...]


class Row(Config):
    """Common part of the rows of a map: channel = sign scale raw + offset, with frame and
    source.
    """

    field: str = Field(
        description="the path of the field in the message, such as twist.angular.y or axes[1]"
    )
    frame: str = Field(
        description="the frame and the unit of the raw value, as a note for the reader"
    )
    sign: Literal[-1, 1] = Field(
        description="+1, or -1 where the channel decreases for an increasing raw value"
    )
    scale: Positive = Field(
        description="units of the channel (SI, radians) per unit of the raw value"
    )
    offset: Number = Field(description="the value of the channel at raw = 0, SI")
    source: str = Field(min_length=1, description="where the row is from")

    @property
    def line(self) -> Line:
        """The conversion between the raw value and the channel."""
        return Line(self.sign, self.scale, self.offset)


class MovingRow(Row):
    """A row whose sign can be checked by a motion of the aircraft."""

    positive: Motion = Field(description="motion of the aircraft for an increasing raw value")

    @property
    def motion(self) -> tuple[str, int]:
        """What responds to an increasing channel, a key of UNITS, and the sign of its response."""
        output, sign = MOTIONS[self.positive]
        return output, sign * self.sign


class MeasuredRow(Row):
    """A channel that the autopilot publishes: topic and field of its source."""

    topic: TopicName = Field(description="the autopilot's topic")
    type: MessageType = Field(description="its type, package/msg/Type")
    function: Function = Field(
        default="value",
        description="conversion of the field to the raw value: none, vector length, airspeed of "
        "a pressure, an Euler angle",
    )
    turned_by: str | None = Field(
        default=None,
        description="the path of the quaternion that turns a vector in body axes to the world; "
        "`field` is a component of it",
    )
    stamp: Literal["header", "arrival"] = Field(
        description="stamp of the sample: that of the message header, or its arrival"
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
    """A channel of the pose, an absolute value. `sign` and `offset` bring it to FRD, north, east,
    up from the frame it has.
    """


class OutputRow(MeasuredRow, MovingRow):
    """A channel of y, the deviation from trim."""

    captured: bool = Field(
        default=False,
        description="whether the channel begins at 0 at each engagement, in place of the trim "
        "in `offset`",
    )
    held: bool = Field(
        default=False,
        description="whether y repeats the last value of a stale channel: for a vane, which the "
        "observer then leaves out",
    )
    low_pass: NonNegative = Field(
        default=0.0,
        description="time constant of a low-pass filter of first order, s: y is later by it; 0 "
        "without",
    )


class InputRow(MovingRow):
    """A channel of u, the deviation from trim: message and field of its setpoint. trim + u = sign
    scale raw + offset.
    """

    message: str = Field(description="the message with the field, one of `messages`")
    trim: Number = Field(
        description="the command in trim, to which u is added, SI; a row of `trims` replaces it"
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
        description="how long u may stay at one of its limits while engaged, s: then the bridge "
        "disengages",
    )
    release: Raw | None = Field(
        description="the raw value that returns the channel to the autopilot, for example NaN; "
        "null where nothing is sent"
    )


class MessageRow(Config):
    """A message to the autopilot, or a request of a service. A message without a field of an input
    is a heartbeat.
    """

    topic: TopicName = Field(description="the autopilot's topic or service")
    type: SentType = Field(description="its type, package/msg/Type or package/srv/Type")
    rate: Rate = Field(description="the rate at which it is sent, Hz")
    when: Literal["engaged", "heartbeat", "engaging", "release", "failsafe"] = Field(
        description="engaged: from engagement to the end of the release; heartbeat: from the "
        "request to the release; engaging:"
        " while the engagement waits for a condition; release: during the release while the "
        "conditions hold; failsafe: the same"
        " after a release that no pilot requested, also where the conditions are not reported "
        "any more"
    )
    stamped: bool = Field(description="whether header.stamp is set to the instant of sending")
    values: dict[str, Value] = Field(
        default={}, description="values of its other fields, by their paths"
    )

    @property
    def is_service(self) -> bool:
        """Whether it is a request of a service."""
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
    """A field of the autopilot that decides on the engagement."""

    topic: TopicName = Field(description="the topic")
    type: MessageType = Field(description="its type, package/msg/Type")
    field: str = Field(description="the path of the field")
    source: str = Field(min_length=1, description="where the row is from")
    bits: Mask | None = Field(
        default=None, description="for a bit field: mask of the bits that count"
    )

    def masked(self, raw: float) -> float:
        """The value of the bits that count."""
        return raw if self.bits is None else float(int(raw) & self.bits)


class ConditionRow(WatchedRow):
    """A condition of the engagement: the field has one of some values. The bridge disengages where
    it has not.
    """

    one_of: Numbers = Field(
        default=(),
        description="the values with which the condition holds; false is 0 and true is 1",
    )
    within: Limits | None = Field(
        default=None, description="in place of `one_of`: the limits within which it holds"
    )
    sentence: str = Field(
        min_length=1, description="what is wrong where the condition does not hold"
    )
    max_age: Positive = Field(description="the age above which the field is stale, s")
    awaited: bool = Field(
        default=False,
        description="whether an engagement waits for the condition, up to `engage_timeout`, "
        "instead of a refusal",
    )
    transmitter: bool = Field(
        default=False,
        description="whether the field tells the loss of the pilot's transmitter: an engagement "
        "with `--blind` ignores the row",
    )

    def holds(self, raw: float) -> bool:
        """Whether the condition holds."""
        value = self.masked(raw)
        return (
            value in self.one_of
            if self.within is None
            else self.within[0] <= value <= self.within[1]
        )


class OverrideRow(WatchedRow):
    """A pilot override: the bridge disengages at once where the field is beyond the threshold."""

    above: Number | None = Field(
        default=None, description="the override is active where the field is above this"
    )
    below: Number | None = Field(
        default=None, description="the override is active where the field is below this"
    )
    moved: Positive | None = Field(
        default=None,
        description="the override is active where the field has moved by more than this since "
        "engagement",
    )
    max_age: Positive = Field(
        default=1.0, description="the age above which the override is not active any more, s"
    )
    transmitter: bool = Field(
        default=True,
        description="whether the override has no effect without the pilot's transmitter",
    )

    def is_active(self, raw: float, at_engagement: float | None) -> bool:
        """Whether the override is active. `at_engagement` is its value at engagement; None where it
        is not engaged.
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
    sentence: str = Field(min_length=1, description="what another value does, and how to mend it")
    source: str = Field(min_length=1, description="where the row is from")


class QosRow(Config):
    """The quality of service of a topic."""

    reliability: Literal["reliable", "best_effort"]
    durability: Literal["volatile", "transient_local"]
    depth: Annotated[int, Field(ge=1, le=1000)]


class LinkConfig(Config):
    """A MAVLink link, for rows with the type mavlink/msg/NAME."""

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
        description="the system of the map's messages: ArduPilot takes RC overrides of its "
        "ground station alone, MAV_GCS_SYSID,"
        " 255 by default. All else is sent as the autopilot's companion computer",
    )
    station_silence: Positive | None = Field(
        default=None,
        description="how long the ground station with the number `source_system` may be silent, "
        "once it was heard, s: then the"
        " bridge disengages, because the autopilot takes the RC overrides for heartbeats of the "
        "station; null: without end",
    )
    passphrase_file: str | None = Field(
        default=None,
        description="a file with the passphrase of an autopilot that signs; its key is the "
        "SHA-256 of the passphrase",
    )
    rates: dict[str, Rate] = Field(default={}, description="requested rates by message, Hz")


class SilenceConfig(Config):
    """Failsafe for a u that times out while engaged: neutral values, then release values, then
    nothing.
    """

    max_age: Positive = Field(description="the age above which u has timed out, s")
    neutral: NonNegative = Field(
        description="how long the neutral values are then sent, s; 0 skips them"
    )
    release: NonNegative = Field(
        description="how long the release values are then sent, s; 0 skips them"
    )


class ChannelMap(Config):
    """A channel map: the topic and field of each channel of y and u."""

    name: str
    source: str = Field(
        min_length=1, description="where the map is from, and the releases for which it is valid"
    )
    dry_run: bool = Field(
        default=True, description="publish what would be sent, and send nothing to the autopilot"
    )
    rate: Rate = Field(
        description="the rate at which the topics are polled, Hz; the highest rate of y"
    )
    instant: str = Field(description="the output whose newest stamp is the stamp of y")
    engage_within: Annotated[float, Field(gt=0, le=1)] = Field(
        description="the largest deviation of u from trim at engagement, as a fraction of its "
        "limits"
    )
    engage_timeout: Positive = Field(
        default=5.0,
        description="how long an engagement waits for its awaited conditions, s; then it is "
        "refused",
    )
    max_engaged: Positive | None = Field(
        default=None,
        description="how long an engagement lasts, s; needed without `--blind` where no "
        "condition tells the transmitter's loss",
    )
    silence: SilenceConfig = Field(description="failsafe for a u that times out")
    outputs: Annotated[dict[Name, OutputRow], Field(min_length=1)] = Field(
        description="the channels of y"
    )
    pose: dict[str, PoseRow] = Field(
        default={},
        description="the channels of the pose; the newest stamp of the first row is the stamp "
        "of the pose",
    )
    sensors: dict[Name, PoseRow] = Field(
        default={},
        description="further measured channels, absolute values, for `envelope` and `engage_if` "
        "alone",
    )
    envelope: dict[str, Limits] = Field(
        default={},
        description="limits of channels of the pose, of y or of the sensors: the bridge "
        "disengages beyond them",
    )
    engage_if: dict[str, Limits] = Field(
        default={},
        description="limits of the same channels at an engagement alone: outside it is refused",
    )
    inputs: Annotated[dict[Name, InputRow], Field(min_length=1)] = Field(
        description="the channels of u"
    )
    trims: dict[str, MeasuredRow] = Field(
        default={},
        description="sources of the raw values of inputs in trim, by input: captured at each "
        "engagement",
    )
    messages: Annotated[dict[str, MessageRow], Field(min_length=1)] = Field(
        description="the messages to the autopilot"
    )
    conditions: dict[str, ConditionRow] = Field(
        default={}, description="the conditions of an engagement"
    )
    overrides: dict[str, OverrideRow] = Field(default={}, description="the pilot overrides")
    parameters: dict[str, ParameterRow] = Field(
        default={}, description="parameters of the autopilot that an engagement needs, by name"
    )
    topics: dict[str, QosRow] = Field(
        default={}, description="the quality of service by topic; none for MAVLink"
    )
    link: LinkConfig | None = Field(
        default=None, description="the MAVLink link of rows with a type mavlink/msg/NAME"
    )

    def _check(self) -> None:
        outputs = ", ".join(self.outputs)
        require(
            self.instant in self.outputs,
            "instant",
            f"{self.instant!r}",
            f"one of the outputs {outputs}",
        )
        instant_row = self.outputs[self.instant]
        require(
            not instant_row.held,
            f"outputs.{self.instant}.held",
            "true",
            "false: its stamp is that of y",
        )
        self._check_fields()
        self._check_topics()
        self._check_inputs()
        self._check_channels()
        self._check_limits()
        self._check_conditions()
        self._check_parameters()

    def _check_inputs(self) -> None:
        """Check the fields of the inputs, and the values in trim and at the limits against the
        range of the field.
        """
        messages = ", ".join(self.messages)
        owners: dict[tuple[str, str], str] = {}
        for name, row in self.inputs.items():
            key = f"inputs.{name}"
            require(
                row.message in self.messages,
                f"{key}.message",
                f"{row.message!r}",
                f"one of the messages {messages}",
            )
            when = self.messages[row.message].when
            moving = "one sent when engaged: it moves the aircraft"
            require(when == "engaged", f"{key}.message", f"one sent when {when}", moving)
            owner = owners.setdefault((row.message, row.field), name)
            require(
                owner == name, f"{key}.field", f"{row.field}, that of {owner}", "a field of its own"
            )
            low, high = row.range
            require(
                low < high, f"{key}.range", list(row.range), "the lower end before the upper one"
            )
            for limit, u in (("trim", 0.0), ("lower", row.lower), ("upper", row.upper)):
                raw = to_raw(row.trim + u, row.line)
                inside = low - ROUNDING <= raw <= high + ROUNDING
                require(
                    inside,
                    f"{key}.{limit}",
                    f"{row.field} = {raw:.6g}",
                    f"one in the range [{low:g}, {high:g}]",
                )
            neutral = low if row.neutral == "trim" else row.neutral
            require(
                low <= neutral <= high,
                f"{key}.neutral",
                row.neutral,
                f"one in the range [{low:g}, {high:g}]",
            )

    def _check_channels(self) -> None:
        """Check the names of channels by section."""
        for name in self.trims:
            require(
                name in self.inputs,
                f"trims.{name}",
                "a channel",
                f"one of the inputs {', '.join(self.inputs)}",
            )
        for name in self.pose:
            require(name in POSE, f"pose.{name}", "a channel", f"one of {', '.join(POSE)}")
        for name in self.outputs:
            require(
                name not in self.pose,
                f"outputs.{name}",
                "a channel of the pose too",
                "a name of its own",
            )
        for name in self.sensors:
            require(
                name not in {**self.pose, **self.outputs},
                f"sensors.{name}",
                "a channel of y or of the pose too",
                "a name of its own",
            )

    def _check_limits(self) -> None:
        """Check the limits of watched channels."""
        watched = [*self.pose, *self.outputs, *self.sensors]
        for section, limits in (("envelope", self.envelope), ("engage_if", self.engage_if)):
            for name, (lower, upper) in limits.items():
                require(
                    name in watched,
                    f"{section}.{name}",
                    "a channel",
                    f"one of the pose, of y or of the sensors: {', '.join(watched)}",
                )
                require(
                    lower < upper,
                    f"{section}.{name}",
                    [lower, upper],
                    "the lower end before the upper one",
                )

    def _check_conditions(self) -> None:
        """Check the thresholds of conditions and overrides."""
        for name, condition in self.conditions.items():
            ways = "both" if condition.one_of else "neither"
            require(
                bool(condition.one_of) is (condition.within is None),
                f"conditions.{name}",
                ways,
                "one of one_of and within",
            )
        for name, override in self.overrides.items():
            thresholds = [
                key for key in ("above", "below", "moved") if getattr(override, key) is not None
            ]
            threshold_text = " and ".join(thresholds) or "no threshold"
            require(
                len(thresholds) == 1,
                f"overrides.{name}",
                threshold_text,
                "one of above, below and moved",
            )

    def _check_parameters(self) -> None:
        """Check the names and the limits of parameters of the autopilot."""
        for parameter, required in self.parameters.items():
            is_name = PARAMETER.fullmatch(parameter) is not None
            require(
                is_name,
                f"parameters.{parameter}",
                "no name of a parameter",
                "one such as RC_OVERRIDE_TIME",
            )
            require(self.link is not None, "link", "none", f"one, for parameters.{parameter}")
            lower, upper = required.within
            require(
                lower <= upper,
                f"parameters.{parameter}.within",
                [lower, upper],
                "the lower end before the upper one",
            )

    def _check_fields(self) -> None:
        rows = self._readers() | {"inputs": self.inputs}
        paths: dict[str, str] = {}
        for kind, named in rows.items():
            paths |= {f"{kind}.{name}.field": row.field for name, row in named.items()}
        for name, message in self.messages.items():
            paths |= {f"messages.{name}.values.{path}": path for path in message.values}
        for key, path in paths.items():
            is_path = PATH.fullmatch(path) is not None
            require(
                is_path, key, f"{path!r}", "the path of a field, such as twist.angular.y or axes[1]"
            )

    def _check_topics(self) -> None:
        types: dict[str, str] = {}
        for key, topic, kind in self.used_topics():
            if kind.startswith(f"{MAVLINK}/"):
                self._check_mavlink(key, topic, kind)
            elif "/msg/" in kind:
                require(
                    topic in self.topics,
                    f"{key}.topic",
                    topic,
                    "one with a quality of service in `topics`",
                )
            first_type = types.setdefault(topic, kind)
            require(
                first_type == kind,
                f"{key}.type",
                kind,
                f"{first_type}, as elsewhere in this map for {topic}",
            )
        for topic in self.topics:
            require(topic in types, f"topics.{topic}", "a topic", "one that a row uses")

        rates = {} if self.link is None else self.link.rates
        for name in rates:
            require(
                f"{MAVLINK}/{name}" in types,
                f"link.rates.{name}",
                "a message",
                "one that a row uses",
            )

    def _check_mavlink(self, key: str, topic: str, kind: str) -> None:
        name = kind.rpartition("/")[2]
        require(self.link is not None, "link", "none", f"one, for {key} of type {kind}")
        require(
            topic == f"{MAVLINK}/{name}",
            f"{key}.topic",
            topic,
            f"{MAVLINK}/{name}, for its type {kind}",
        )

    @property
    def recorded_topics(self) -> list[str]:
        """The topics that the log has: those with a quality of service, and what comes over
        MAVLink.
        """
        rows = chain.from_iterable(named.values() for named in self._readers().values())
        read = [row.topic for row in rows if row.topic.startswith(f"{MAVLINK}/")]
        return [*self.topics, *dict.fromkeys(read)]

    def _readers(self) -> dict[str, Mapping[str, Any]]:
        """The sections whose rows read a field of a topic."""
        kinds = ("outputs", "pose", "sensors", "trims", "conditions", "overrides")
        return {kind: getattr(self, kind) for kind in kinds}

    def used_topics(self) -> list[tuple[str, str, str]]:
        """(key of the row, topic, type) of each row that names a topic."""
        rows = self._readers() | {"messages": self.messages}
        topics: list[tuple[str, str, str]] = []
        for kind, named in rows.items():
            topics += [(f"{kind}.{name}", row.topic, row.type) for name, row in named.items()]
        return topics

    def used_fields(self) -> list[tuple[str, str, str, str, str | None]]:
        """(key of the row, topic, type, path of the field, its components) of each field that is
        read or set.

        The components are those of `COMPONENTS` for a field that a function reads, None for another
        one.
        """
        fields: list[tuple[str, str, str, str, str | None]] = []
        for kind, named in self._readers().items():
            for name, row in named.items():
                components = COMPONENTS[getattr(row, "function", "value")]
                fields.append((f"{kind}.{name}", row.topic, row.type, row.field, components))
                if (turned_by := getattr(row, "turned_by", None)) is not None:
                    fields.append((f"{kind}.{name}", row.topic, row.type, turned_by, QUATERNION))
                if getattr(row, "stamp", "") == "header":
                    fields.append((f"{kind}.{name}", row.topic, row.type, "header.stamp", None))
        set_fields = [("inputs", name, row.message, row.field) for name, row in self.inputs.items()]
        for name, row in self.messages.items():
            set_fields += [
                ("messages", name, name, path)
                for path in (*row.values, *(["header.stamp"] if row.stamped else []))
            ]
        for kind, name, message, path in set_fields:
            fields.append(
                (
                    f"{kind}.{name}",
                    self.messages[message].topic,
                    self.messages[message].type,
                    path,
                    None,
                )
            )
        return fields


ROUNDING = 1e-6  # tolerance for limits with six digits that are the ends of a range


def maps() -> list[str]:
    """Names of the channel maps of the library."""
    return names_in(LIBRARY)


def find_map(name: str) -> Path:
    """The file of a channel map, by its name in the library or by its path, which ends in .yaml.
    Raises ParameterError.
    """
    return find_file(name, LIBRARY, "map", "a channel map").absolute()


def load_map(name: str) -> ChannelMap:
    """A channel map by its name in the library, or by the path of a file. Raises ParameterError."""
    path = find_map(name)
    content = read_yaml(path, f"map {path}", "a channel map")
    require(isinstance(content, dict), f"map {path}", type(content).__name__, "a mapping")
    return ChannelMap.validate_mapping(content, f"map {path.stem}")


class BridgeConfig(NodeConfig):
    """All parameters of the bridge node."""

    map: str = Field(description="the name of the library, or path of a file ending in .yaml")
    dry_run: bool | None = Field(default=None, description="replaces dry_run of the map")
    first_y: NonNegative = Field(default=0.0, description="wait for the first y, s; 0: without end")

    def _check(self) -> None:
        require(not self.lockstep, "lockstep", "true", "false: a real autopilot does not wait")
        load_map(self.map)
