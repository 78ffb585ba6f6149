# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Send the bridge's messages to an autopilot, and check that messages have a map's fields."""

from typing import Any

from autopilot_bridge import mavlink_link
from autopilot_bridge.channel_map import get_field, message_type, set_field
from autopilot_bridge.map_rows import MAVLINK, InputRow, MeasuredRow, MessageRow, WatchedRow
from autopilot_bridge.params import ChannelMap
from flight_core.parameters import ParameterError
from flight_core.rates import NANOSECONDS, nanoseconds
from flight_core.vectors import ChannelError, SampleFault


class ServiceCaller:
    """A service of the autopilot, called with the interface of a publisher."""

    def __init__(self, client: Any) -> None:
        self._client = client
        self.topic_name = str(client.srv_name)

    def publish(self, request: Any) -> None:
        """Send a request without waiting for the answer.

        Raises ChannelError if the service is not there.
        """
        if not self._client.service_is_ready():
            raise ChannelError(SampleFault.SERVICE, f"{self.topic_name}: no such service")
        self._client.call_async(request)


class OutgoingMessage:
    """A message to the autopilot with its publisher. Its constant fields are set only once."""

    def __init__(
        self, publisher: Any, message: Any, row: MessageRow, inputs: list[tuple[int, InputRow]]
    ) -> None:
        self.publisher = publisher
        self.row = row
        self._message = message
        self._inputs = inputs
        self._period_ns = nanoseconds(1.0 / row.rate)
        self._sent_ns = 0

    def is_due(self, now_ns: int, slack_ns: int) -> bool:
        """Return whether the message's period has passed since the message was last sent.

        `slack_ns` is the tolerance of the period.
        """
        return now_ns - self._sent_ns >= self._period_ns - slack_ns

    def send(self, now_ns: int, raw: list[float]) -> None:
        """Send the message with the values of its inputs.

        `raw` has the raw values of all inputs.
        """
        for number, row in self._inputs:
            set_field(self._message, row.field, raw[number])
        if self.row.stamped:
            stamp = self._message.header.stamp
            stamp.sec, stamp.nanosec = divmod(now_ns, NANOSECONDS)
        self.publisher.publish(self._message)
        self._sent_ns = now_ns


def prepare_message(
    channel_map: ChannelMap, name: str, row: MessageRow
) -> tuple[Any, list[tuple[int, InputRow]]]:
    """Return a message of a map with its constant fields set, and the inputs that it carries.

    An input comes with its place in u. Raises ParameterError if a field is missing, or cannot hold
    its constant value.
    """
    kind = field_type(row.type)
    message = kind.Request() if row.is_service else kind()
    rows = [
        (number, channel)
        for number, channel in enumerate(channel_map.inputs.values())
        if channel.message == name
    ]
    try:
        for path, value in row.values.items():
            set_field(message, path, value)
        for _, channel in rows:
            for raw in (channel.neutral, channel.release, *channel.range):
                if isinstance(raw, float):
                    set_field(message, channel.field, raw)
        if row.stamped:
            get_field(message, "header.stamp")
    except ChannelError as error:
        raise ParameterError(
            f"map {channel_map.name}: messages.{name} of type {row.type}: {error}"
        ) from None
    return message, rows


def field_type(name: str) -> Any:
    """Return the class of a message that a map names, from a ROS package or from MAVLink."""
    package, _, kind = name.split("/")
    return mavlink_link.mavlink_type(kind) if package == MAVLINK else message_type(name)


def require_field(empty: Any, name: str, row: MeasuredRow | WatchedRow) -> None:
    """Check that a message has the fields of a row. Raises ParameterError if one is missing.

    A field inside a sequence cannot be checked before the first message comes.
    """
    if "[" in row.field:
        return
    try:
        get_field(empty, row.field)
        if isinstance(row, MeasuredRow) and row.turned_by is not None:
            get_field(empty, row.turned_by)
        if isinstance(row, MeasuredRow) and row.stamp == "header":
            get_field(empty, "header.stamp")
    except ChannelError as error:
        raise ParameterError(f"{name}.field: {error}, expected a field of {row.type}") from None
