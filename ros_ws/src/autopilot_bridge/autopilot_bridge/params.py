# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Define the schema of a channel map file, and the parameters of the bridge node."""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from importlib.resources import files
from itertools import chain
from pathlib import Path
from typing import Annotated, Any

from autopilot_bridge.channel_map import COMPONENTS, PATH, QUATERNION, to_raw
from autopilot_bridge.map_rows import (
    MAVLINK,
    ConditionRow,
    InputRow,
    Limits,
    LinkConfig,
    MeasuredRow,
    MessageRow,
    OutputRow,
    OverrideRow,
    ParameterRow,
    PoseRow,
    QosRow,
    SilenceConfig,
)
from flight_core.channels import POSE
from flight_core.fields import Field
from flight_core.files import find_file, names_in, read_yaml
from flight_core.parameters import Config, Name, NodeConfig, NonNegative, Positive, Rate, require

LIBRARY = Path(str(files("autopilot_bridge"))) / "maps"
# The name of a parameter of the autopilot, up to 16 characters (common.xml, PARAM_VALUE).
PARAMETER = re.compile(r"[A-Z][A-Z0-9_]{0,15}")


@dataclass(frozen=True, kw_only=True)
class UsedField:
    """A message field that a row of a map reads or sets."""

    key: str  # key of the row
    topic: str
    type: str
    path: str
    components: str | None = None  # a key of `COMPONENTS` if a function reads the field


class ChannelMap(Config):
    """A channel map: a file that states the topic and the field of each channel of y and u."""

    name: str
    source: str = Field(
        min_length=1, description="where the map comes from, and for which releases it is valid"
    )
    dry_run: bool = Field(
        default=True,
        description="whether to publish what would be sent, and send nothing to the autopilot",
    )
    rate: Rate = Field(
        description="the rate at which the topics are polled, Hz, which is the highest rate of y"
    )
    instant: str = Field(description="the output whose newest stamp is the stamp of y")
    engage_within: Annotated[float, Field(gt=0, le=1)] = Field(
        description="the largest deviation of u from trim at engagement, as a fraction of its "
        "limits"
    )
    engage_timeout: Positive = Field(
        default=5.0,
        description="how long an engagement waits for its awaited conditions before it is refused, "
        "s",
    )
    max_engaged: Positive | None = Field(
        default=None,
        description="how long an engagement lasts, s; needed, unless there is `--blind`, if no "
        "condition tells the loss of the transmitter",
    )
    silence: SilenceConfig = Field(description="the failsafe if u times out")
    link_delay: NonNegative | None = Field(
        default=None,
        description="delay that the link adds to the one in a log of the board, s; each is a delay "
        "from y on the board to u on the surface, and gains from such a log allow for their sum",
    )
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
        description="other measured channels, as absolute values, only for `envelope` and "
        "`engage_if`",
    )
    envelope: dict[str, Limits] = Field(
        default={},
        description="limits of channels of the pose, of y or of the sensors, beyond which the "
        "bridge disengages",
    )
    engage_if: dict[str, Limits] = Field(
        default={},
        description="limits of the same channels outside which an engagement is refused",
    )
    inputs: Annotated[dict[Name, InputRow], Field(min_length=1)] = Field(
        description="the channels of u"
    )
    trims: dict[str, MeasuredRow] = Field(
        default={},
        description="sources of the raw values of inputs in trim, by input; they are captured at "
        "each engagement",
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
        require(
            self.instant in self.outputs,
            "instant",
            f"{self.instant!r}",
            f"one of the outputs {', '.join(self.outputs)}",
        )
        instant_row = self.outputs[self.instant]
        require(
            not instant_row.held,
            f"outputs.{self.instant}.held",
            "true",
            "false: it has the stamp of y",
        )
        self._check_fields()
        self._check_topics()
        self._check_inputs()
        self._check_channels()
        self._check_limits()
        self._check_conditions()
        self._check_parameters()

    def _check_inputs(self) -> None:
        """Check the fields of the inputs, and that u fits them in trim and at its limits."""
        owners: dict[tuple[str, str], str] = {}
        for name, row in self.inputs.items():
            key = f"inputs.{name}"
            require(
                row.message in self.messages,
                f"{key}.message",
                f"{row.message!r}",
                f"one of the messages {', '.join(self.messages)}",
            )
            when = self.messages[row.message].when
            require(
                when == "engaged",
                f"{key}.message",
                f"one sent when {when}",
                "one sent when engaged: it moves the aircraft",
            )
            owner = owners.setdefault((row.message, row.field), name)
            require(
                owner == name,
                f"{key}.field",
                f"{row.field}, the field of {owner}",
                "a field of its own",
            )
            low, high = row.range
            require(
                low < high, f"{key}.range", list(row.range), "the lower end before the upper one"
            )
            for limit, u in (("trim", 0.0), ("lower", row.lower), ("upper", row.upper)):
                raw = to_raw(row.trim + u, row.conversion)
                require(
                    low - ROUNDING <= raw <= high + ROUNDING,
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
        """Check the names of the channels in each section."""
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
        """Check the sections `envelope` and `engage_if`, which have limits of channels."""
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
            require(
                len(thresholds) == 1,
                f"overrides.{name}",
                " and ".join(thresholds) or "no threshold",
                "one of above, below and moved",
            )

    def _check_parameters(self) -> None:
        """Check the names and the limits of parameters of the autopilot."""
        for parameter, required in self.parameters.items():
            require(
                PARAMETER.fullmatch(parameter) is not None,
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
        for kind, rows_by_name in rows.items():
            paths |= {f"{kind}.{name}.field": row.field for name, row in rows_by_name.items()}
        for name, message in self.messages.items():
            paths |= {f"messages.{name}.values.{path}": path for path in message.values}
        for key, path in paths.items():
            require(
                PATH.fullmatch(path) is not None,
                key,
                f"{path!r}",
                "the path of a field, such as twist.angular.y or axes[1]",
            )

    def _check_topics(self) -> None:
        types: dict[str, str] = {}
        for key, topic, kind in self.used_topics():
            if kind.startswith(f"{MAVLINK}/"):
                require(self.link is not None, "link", "none", f"one, for {key} of type {kind}")
                expected = f"{MAVLINK}/{kind.rpartition('/')[2]}"
                require(
                    topic == expected, f"{key}.topic", topic, f"{expected}, for its type {kind}"
                )
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

    @property
    def recorded_topics(self) -> list[str]:
        """List the topics that the log records.

        These are the topics for which the map gives a quality of service, and the topics of MAVLink
        messages.
        """
        rows = chain.from_iterable(
            rows_by_name.values() for rows_by_name in self._readers().values()
        )
        mavlink_topics = [row.topic for row in rows if row.topic.startswith(f"{MAVLINK}/")]
        return [*self.topics, *dict.fromkeys(mavlink_topics)]

    def _readers(self) -> dict[str, Mapping[str, Any]]:
        """Return the sections of the map whose rows read a field of a topic."""
        kinds = ("outputs", "pose", "sensors", "trims", "conditions", "overrides")
        return {kind: getattr(self, kind) for kind in kinds}

    def used_topics(self) -> list[tuple[str, str, str]]:
        """Return (key of the row, topic, type) for each row that names a topic."""
        rows = self._readers() | {"messages": self.messages}
        topics: list[tuple[str, str, str]] = []
        for kind, rows_by_name in rows.items():
            topics += [
                (f"{kind}.{name}", row.topic, row.type) for name, row in rows_by_name.items()
            ]
        return topics

    def used_fields(self) -> list[UsedField]:
        """Return each field of a message that a row reads or sets."""
        fields: list[UsedField] = []
        for kind, rows_by_name in self._readers().items():
            for name, row in rows_by_name.items():
                of_row = partial(UsedField, key=f"{kind}.{name}", topic=row.topic, type=row.type)
                components = COMPONENTS[getattr(row, "function", "value")]
                fields.append(of_row(path=row.field, components=components))
                if (turned_by := getattr(row, "turned_by", None)) is not None:
                    fields.append(of_row(path=turned_by, components=QUATERNION))
                if getattr(row, "stamp", "") == "header":
                    fields.append(of_row(path="header.stamp"))
        set_fields = [
            (f"inputs.{name}", row.message, row.field) for name, row in self.inputs.items()
        ]
        for name, row in self.messages.items():
            paths = [*row.values, *["header.stamp"] * row.stamped]
            set_fields += [(f"messages.{name}", name, path) for path in paths]
        for key, name, path in set_fields:
            message = self.messages[name]
            fields.append(UsedField(key=key, topic=message.topic, type=message.type, path=path))
        return fields


ROUNDING = 1e-6  # tolerance at the ends of a range, because the limits are rounded to six digits


def maps() -> list[str]:
    """Return the names of the channel maps in the library."""
    return names_in(LIBRARY)


def find_map(name: str) -> Path:
    """Return the file of a channel map, by its name in the library or by a path ending in .yaml.

    Raises ParameterError if there is no such file.
    """
    return find_file(name, LIBRARY, "map", "a channel map").absolute()


def load_map(name: str) -> ChannelMap:
    """Load a channel map, given its name in the library or its path.

    Raises ParameterError if there is no such file, or if it is no valid channel map.
    """
    path = find_map(name)
    content = read_yaml(path, f"map {path}", "a channel map")
    require(isinstance(content, dict), f"map {path}", type(content).__name__, "a mapping")
    return ChannelMap.validate_mapping(content, f"map {path.stem}")


class BridgeConfig(NodeConfig):
    """All parameters of the bridge node."""

    map: str = Field(description="the name of a channel map, or path of its .yaml file")
    dry_run: bool | None = Field(
        default=None, description="whether to send nothing; replaces dry_run of the map"
    )
    first_y: NonNegative = Field(
        default=0.0, description="how long to wait for the first y, s; 0: for any time"
    )

    def _check(self) -> None:
        require(not self.lockstep, "lockstep", "true", "false: a real autopilot does not wait")
        load_map(self.map)
