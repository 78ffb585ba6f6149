# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""A channel map as its file states it, checked as a whole, and the parameters of the bridge's node."""

from collections.abc import Mapping
from importlib.resources import files
from pathlib import Path
from types import MappingProxyType
from typing import Annotated, Any, Literal, Self

from pydantic import BeforeValidator, Field, model_validator

from autopilot_bridge.channel_map import Line, is_path, to_raw
from flight_core.files import is_file, read_yaml
from flight_core.parameters import KeyedParameters, NonNegative, Parameters, Positive, as_tuple, require

LIBRARY = Path(str(files("autopilot_bridge"))) / "maps"

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
]

MOTIONS: Mapping[str, tuple[str, int]] = MappingProxyType(
    {
        "nose up": ("q", 1),
        "nose down": ("q", -1),
        "roll right": ("p", 1),
        "roll left": ("p", -1),
        "nose right": ("r", 1),
        "nose left": ("r", -1),
        "faster": ("V", 1),
        "slower": ("V", -1),
        "more thrust": ("V", 1),
        "less thrust": ("V", -1),
    }
)
"""The output that a motion shows in, and its sign there: FRD, q nose up +, p roll right +, r nose right +, V faster +."""

Rate = Annotated[float, Field(ge=1, le=1000)]
MessageType = Annotated[str, Field(pattern=r"^[a-z]\w*/msg/[A-Z]\w*$")]
TopicName = Annotated[str, Field(pattern=r"^/?[A-Za-z_]\w*(/[A-Za-z_]\w*)*$")]
Raw = Annotated[float, Field(allow_inf_nan=True)]
Range = Annotated[tuple[Raw, Raw], BeforeValidator(as_tuple)]
Value = bool | int | Raw | str | Annotated[tuple[int, ...] | tuple[Raw, ...], BeforeValidator(as_tuple)]


class Row(Parameters):
    """What each row of a map says: y or u = sign scale raw + offset, and why."""

    field: str = Field(description="the path of the field in the message, such as twist.angular.y or axes[1]")
    positive: Motion = Field(description="what the aircraft does, or is made to do, as the raw value grows")
    frame: str = Field(description="the frame and the unit of the raw value, for people")
    sign: Literal[-1, 1] = Field(description="+1, or -1 where the channel falls as the raw value grows")
    scale: Positive = Field(description="units of the channel (SI, radians) per unit of the raw value")
    offset: float = Field(description="the value of the channel at raw = 0, SI")
    source: str = Field(min_length=1, description="where the row is from")

    @property
    def line(self) -> Line:
        """The arrays' side of the row."""
        return Line(self.sign, self.scale, self.offset)

    @property
    def motion(self) -> tuple[str, int]:
        """The output that a growing channel shows in (what a growing raw value does, times the sign), and its sign there."""
        output, sign = MOTIONS[self.positive]
        return output, sign * self.sign


class OutputRow(Row):
    """One channel of y, the deviation from trim: from which field of which topic."""

    topic: TopicName = Field(description="the autopilot's topic")
    type: MessageType = Field(description="its type, package/msg/Type")
    function: Literal["value", "norm", "airspeed_of_pressure"] = Field(
        default="value", description="how the raw value comes from the field: itself, a vector's length, a pressure's speed"
    )
    stamp: Literal["header", "arrival"] = Field(description="whose instant counts: the message's own, or that of its arrival")
    max_age: Positive = Field(description="the age beyond which the channel is stale, s")


class InputRow(Row):
    """One channel of u, the deviation from trim: to which field of which message; trim + u = sign scale raw + offset."""

    message: str = Field(description="the message that the field is in, one of `messages`")
    trim: float = Field(description="what is commanded in trim, to which u adds, SI")
    lower: Annotated[float, Field(le=0)] = Field(description="the lower limit of u around trim, SI")
    upper: Annotated[float, Field(ge=0)] = Field(description="the upper limit of u around trim, SI")
    range: Range = Field(description="the lowest and the highest raw value that the field takes")
    neutral: float = Field(description="the raw value that is sent when u has fallen silent")
    release: Raw = Field(description="the raw value that gives the channel back to the autopilot; NaN where the field says so")


class MessageRow(Parameters):
    """One message towards the autopilot; one that no input has a field in is a heartbeat."""

    topic: TopicName = Field(description="the autopilot's topic")
    type: MessageType = Field(description="its type, package/msg/Type")
    rate: Rate = Field(description="how often it is sent, Hz")
    when: Literal["engaged", "ready"] = Field(
        description="engaged: while u is flown and given back; ready: also before, while y and u are fresh"
    )
    stamped: bool = Field(description="whether header.stamp is set to the instant of sending")
    values: dict[str, Value] = Field(default={}, description="what its other fields hold, by their paths")


class OverrideRow(Parameters):
    """A field with which the pilot takes over: beyond the threshold the bridge disengages at once."""

    topic: TopicName = Field(description="the topic")
    type: MessageType = Field(description="its type, package/msg/Type")
    field: str = Field(description="the path of the field")
    above: float | None = Field(default=None, description="the pilot has it where the field is above this")
    below: float | None = Field(default=None, description="the pilot has it where the field is below this")
    bits: Annotated[int, Field(gt=0)] | None = Field(
        default=None, description="of a whole number that is a set of bits: those that count"
    )
    source: str = Field(min_length=1, description="where the row is from")

    def is_active(self, raw: float) -> bool:
        """Whether the pilot takes over."""
        if self.bits is not None:
            raw = float(int(raw) & self.bits)
        return (self.above is not None and raw > self.above) or (self.below is not None and raw < self.below)


class QosRow(Parameters):
    """The quality of service of a topic."""

    reliability: Literal["reliable", "best_effort"]
    durability: Literal["volatile", "transient_local"]
    depth: Annotated[int, Field(ge=1, le=1000)]


class SilenceParameters(Parameters):
    """What is sent when u falls silent while engaged: neutral values, then those that release, then nothing."""

    max_age: Positive = Field(description="how long without u until it counts as silent, s")
    neutral: NonNegative = Field(description="how long the neutral values are then sent, s; 0 is not at all")
    release: NonNegative = Field(description="how long the releasing values are then sent, s; 0 stops at once")


class ChannelMap(Parameters):
    """A channel map: which field of which topic each channel of y and u is."""

    name: str
    source: str = Field(min_length=1, description="where the map is from, and for which releases")
    dry_run: bool = Field(default=True, description="say what would be sent, and send nothing to the autopilot")
    rate: Rate = Field(description="how often the topics are looked at, Hz; y comes no faster")
    instant: str = Field(description="the output whose newest sample gives the instant of y")
    engage_within: Annotated[float, Field(gt=0, le=1)] = Field(
        description="how far u may be from trim at engagement, as a part of its limits"
    )
    silence: SilenceParameters = Field(description="what is sent when u falls silent")
    outputs: Annotated[dict[str, OutputRow], Field(min_length=1)] = Field(description="the channels of y")
    inputs: Annotated[dict[str, InputRow], Field(min_length=1)] = Field(description="the channels of u")
    messages: Annotated[dict[str, MessageRow], Field(min_length=1)] = Field(description="what goes to the autopilot")
    overrides: dict[str, OverrideRow] = Field(default={}, description="how the pilot takes over")
    topics: dict[str, QosRow] = Field(description="the quality of service by topic")

    @model_validator(mode="after")
    def _check(self) -> Self:
        outputs = ", ".join(self.outputs)
        require(self.instant in self.outputs, "instant", f"{self.instant!r}", f"one of the outputs {outputs}")
        self._check_fields()
        self._check_topics()
        taken: dict[tuple[str, str], str] = {}
        for name, row in self.inputs.items():
            key = f"inputs.{name}"
            messages = ", ".join(self.messages)
            require(row.message in self.messages, f"{key}.message", f"{row.message!r}", f"one of the messages {messages}")
            when = self.messages[row.message].when
            require(
                when == "engaged", f"{key}.message", f"one sent when {when}", "one sent when engaged: it moves the aircraft"
            )
            other = taken.setdefault((row.message, row.field), name)
            require(other == name, f"{key}.field", f"{row.field}, that of {other}", "a field of its own")
            low, high = row.range
            require(low < high, f"{key}.range", list(row.range), "the lower end before the upper one")
            for what, u in (("trim", 0.0), ("lower", row.lower), ("upper", row.upper)):
                raw = to_raw(row.trim + u, row.line)
                inside = low - ROUNDING <= raw <= high + ROUNDING
                require(inside, f"{key}.{what}", f"{row.field} = {raw:.6g}", f"one in the range [{low:g}, {high:g}]")
            require(low <= row.neutral <= high, f"{key}.neutral", row.neutral, f"one in the range [{low:g}, {high:g}]")
        for name, override in self.overrides.items():
            given = (override.above is None) != (override.below is None)
            require(given, f"overrides.{name}", "above and below, or neither", "one of the two")
        return self

    def _check_fields(self) -> None:
        paths = {f"{kind}.{name}.field": row.field for kind, rows in self._rows() for name, row in rows.items()}
        paths |= {f"messages.{name}.values.{path}": path for name, row in self.messages.items() for path in row.values}
        for key, path in paths.items():
            require(is_path(path), key, f"{path!r}", "the path of a field, such as twist.angular.y or axes[1]")

    def _check_topics(self) -> None:
        types: dict[str, str] = {}
        for key, topic, kind in self.used_topics():
            require(topic in self.topics, f"{key}.topic", topic, "one with a quality of service in `topics`")
            other = types.setdefault(topic, kind)
            require(other == kind, f"{key}.type", kind, f"{other}, as elsewhere in this map for {topic}")
        for topic in self.topics:
            require(topic in types, f"topics.{topic}", "a topic", "one that a row uses")

    def _rows(self) -> tuple[tuple[str, Mapping[str, Any]], ...]:
        return ("outputs", self.outputs), ("inputs", self.inputs), ("overrides", self.overrides)

    def used_topics(self) -> list[tuple[str, str, str]]:
        """(key of the row, topic, type) of each row that names a topic."""
        rows: list[tuple[str, Mapping[str, Any]]] = [
            ("outputs", self.outputs),
            ("messages", self.messages),
            ("overrides", self.overrides),
        ]
        return [(f"{kind}.{name}", row.topic, row.type) for kind, named in rows for name, row in named.items()]


ROUNDING = 1e-6
"""Limits may be written with six digits where they are the ends of a range."""


def maps() -> list[str]:
    """Names of the channel maps of the library."""
    return sorted(file.stem for file in LIBRARY.glob("*.yaml"))


def find_map(name: str) -> Path:
    """The file of a channel map, by its name in the library or by its path, which ends in .yaml. Raises ParameterError."""
    path = Path(name) if name.endswith(".yaml") else LIBRARY / f"{name}.yaml"
    require(is_file(path), "map", f"{name!r}", f"one of {', '.join(maps())}, or the path of a channel map ending in .yaml")
    return path.absolute()


def load_map(name: str) -> ChannelMap:
    """A channel map by its name in the library, or by the path of a file. Raises ParameterError."""
    path = find_map(name)
    content = read_yaml(path, f"map {path}", "a channel map")
    require(isinstance(content, dict), f"map {path}", type(content).__name__, "a mapping")
    return ChannelMap.validate_mapping(content, f"map {path.stem}")


class BridgeParameters(KeyedParameters):
    """All parameters of the bridge's node."""

    map: str = Field(description="the name of a channel map of the library, or the path of a file ending in .yaml")
    dry_run: bool | None = Field(default=None, description="in place of the map's: say what would be sent, and send nothing")

    @model_validator(mode="after")
    def _check(self) -> Self:
        require(not self.lockstep, "lockstep", "true", "false: a real autopilot does not wait")
        load_map(self.map)
        return self
