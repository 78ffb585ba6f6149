# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Connect to an autopilot by MAVLink, to receive and send the messages of a channel map.

A thread receives messages, sends a heartbeat each second, requests the rates of messages and reads
parameters. It sends as a companion computer of the autopilot, with one exception: the messages of
the map have the system number of the ground station, because ArduPilot takes RC overrides from no
other system. ArduPilot's failsafe FS_GCS_ENABL takes these overrides as heartbeats of the station,
but ignores the heartbeats of a companion. Sources: MAVLink guide (heartbeat and parameter
protocols, SET_MESSAGE_INTERVAL); common.xml and ardupilotmega.xml of pymavlink; ArduPilot,
GCS_Common.cpp, handle_rc_channels_override and handle_heartbeat. The link was tried with ArduPlane
in SITL.
"""

import hashlib
import time
from collections import deque
from collections.abc import Sequence
from copy import deepcopy
from pathlib import Path
from threading import Event, Lock, Thread
from typing import Any, NamedTuple

import numpy as np

from autopilot_bridge.autopilot_lock import AutopilotLock
from autopilot_bridge.map_rows import MAVLINK, LinkConfig
from autopilot_bridge.message_rates import MessageRates
from flight_core.files import read_file
from flight_core.installation import require_package
from flight_core.outcome import Refusal, joined
from flight_core.parameters import ParameterError
from flight_core.rates import nanoseconds
from flight_core.vectors import ChannelError

DIALECT = "ardupilotmega"
AUTOPILOT = 1  # MAV_COMP_ID_AUTOPILOT1
# MAV_COMP_ID_ONBOARD_COMPUTER4, because other companions mostly have 191. With the number of a
# ground station, such as 0 or 190, the link would keep ArduPilot from forwarding the heartbeats of
# the real station (MAVLink_routing.cpp, handle_heartbeat).
COMPANION = 194
SET_MESSAGE_INTERVAL = 511  # MAV_CMD
ACCEPTED = 0  # MAV_RESULT
SIGNED = 1  # MAVLINK_IFLAG_SIGNED in a header
GCS = 6  # MAV_TYPE_GCS
ONBOARD = 18  # MAV_TYPE_ONBOARD_CONTROLLER
INVALID = 8  # MAV_AUTOPILOT_INVALID
# Parameters that name the systems whose RC overrides ArduPilot takes. Since 4.7 this is the system
# MAV_GCS_SYSID, or those from MAV_GCS_SYSID to MAV_GCS_SYSID_HI if the latter is not 0. Before 4.7
# it is the system SYSID_MYGCS.
STATION, LAST_STATION, OLD_STATION = "MAV_GCS_SYSID", "MAV_GCS_SYSID_HI", "SYSID_MYGCS"
STATION_PARAMETERS = (STATION, LAST_STATION, OLD_STATION)
STICKS = frozenset({"RC_CHANNELS_OVERRIDE", "MANUAL_CONTROL"})  # messages of a joystick
BEAT = 1.0  # s, time between two heartbeats
ANSWER = 1.0  # s, longest wait for an answer, after which the request is repeated
# s. If the autopilot sends nothing for so long, all rates are requested again, and another sender
# can become the autopilot of this link.
SILENCE = 3.0
# s, time after which a parameter is read again, because a ground station may have set it
READ_AGAIN = 5.0
QUEUE = 256  # largest number of messages that are kept between two ticks
TAKEN = Refusal(
    "requested again; a ground station on this link requests rates of its own (MAVProxy: set "
    "streamrate -1), or the link is too slow: give the bridge a port of its own"
)
RETRIES = 2  # number of retries of a connection over TCP, 1 s each
POLL = 0.1  # s, longest wait for a packet
PACKET = 65535  # bytes, size of the largest packet of UDP


Address = tuple[Any, ...]
"""Host and port of a sender over UDP; otherwise the URL."""


class MavlinkMessage(NamedTuple):
    """A received message, and the instant of its arrival, ns by the system clock."""

    message: Any
    received_ns: int


def mavlink_type(name: str) -> Any:
    """Return a class for a MAVLink message, whose numeric fields are all zero.

    The attribute `fields` of the class has the names of the numeric fields. Raises ParameterError
    if there is no message with this name.
    """
    require_package("pymavlink")
    from pymavlink.dialects.v20 import ardupilotmega as dialect  # noqa: PLC0415 - an extra

    definition = dialect.mavlink_map.get(getattr(dialect, f"MAVLINK_MSG_ID_{name}", None))
    if definition is None:
        raise ParameterError(
            f"{MAVLINK}/msg/{name}: found no message {name}, expected one of the dialect {DIALECT}"
        )
    pairs = zip(definition.fieldnames, definition.fieldtypes, definition.array_lengths, strict=True)
    zeros = {field: _zero(kind) for field, kind, length in pairs if length == 0 and kind != "char"}

    def init(self: Any) -> None:
        vars(self).update(zeros)

    return type(name, (), {"__init__": init, "fields": tuple(zeros), "packed": definition})


def _text(address: Address) -> str:
    return ":".join(map(str, address))


def _zero(kind: str) -> Any:
    return 0.0 if kind in {"float", "double"} else np.dtype(kind.partition("_t")[0]).type(0)


def _connection(config: LinkConfig) -> Any:
    """Connect by pymavlink with MAVLink 2, and sign messages if a passphrase is set.

    Raises ParameterError if the address cannot be opened.
    """
    require_package("pymavlink")
    from pymavlink import mavutil  # noqa: PLC0415 - an extra
    from pymavlink.dialects.v20 import ardupilotmega as dialect  # noqa: PLC0415 - an extra

    try:
        connection = mavutil.mavlink_connection(
            config.url,
            baud=config.baud,
            source_system=config.system,
            source_component=COMPANION,
            dialect=DIALECT,
            autoreconnect=True,
            retries=RETRIES,
            force_connected=True,  # because the serial device may appear later
        )
    except (OSError, ValueError) as error:
        expected = "udpin:HOST:PORT, udpout:HOST:PORT, tcp:HOST:PORT or a serial device"
        raise ParameterError(
            f"link.url: found {config.url}, which cannot be opened ({error}), expected {expected}"
        ) from None
    # The MAVLink object of pymavlink is of version 1 until a packet of MAVLink 2 comes. It then
    # forgets the passphrase.
    connection.mav = dialect.MAVLink(connection, srcSystem=config.system, srcComponent=COMPANION)
    if config.passphrase_file is not None:
        passphrase = read_file(
            Path(config.passphrase_file), "link.passphrase_file", "a file with a passphrase"
        ).strip()
        connection.setup_signing(hashlib.sha256(passphrase).digest())
    return connection


class Link:
    """A MAVLink connection, which receives messages after `start` is called.

    The link only takes messages of the sender that `AutopilotLock` admits, and over UDP it sends to
    no other address. `parameters` names parameters of the autopilot that the link reads. `further`
    names more parameters, which some releases lack. If there is a passphrase, each message is
    signed, and messages without a valid signature are refused. Source: MAVLink guide, message
    signing. The key is derived from the passphrase as MAVProxy and Mission Planner do.
    """

    def __init__(
        self, config: LinkConfig, parameters: Sequence[str] = (), further: Sequence[str] = ()
    ) -> None:
        self._config = config
        self._is_udp = config.url.startswith("udp")
        self._connection = _connection(config)
        self._parser = self._new_parser(self._connection.mav.signing)
        self._lock = AutopilotLock(nanoseconds(SILENCE))
        # a conflict that only a change of the configuration can end
        self._clash: Refusal | None = None
        self._second: Refusal | None = None  # refusal of a second sender
        self._second_at = 0.0  # time of the last message from the second sender
        self.stations: set[int] = set()  # systems of other ground stations
        # the reason if the signature of the last message was refused
        self._refused: Refusal | None = None
        self._queues: dict[str, deque[MavlinkMessage]] = {}
        self.parameters: dict[str, float] = {}  # the last received parameters of the autopilot
        self._to_read = tuple(parameters)
        self._further = tuple(further)
        self._systems: set[int] = set()  # systems of autopilots that are not the map's
        self._to_request = dict(config.rates)
        # The message whose interval was requested, and the time of the request.
        self._requested: tuple[str, float] | None = None
        self._denied: dict[str, Refusal] = {}
        self._beat = 0.0
        self._alive = 0.0
        self._began = time.monotonic()
        self._rates = MessageRates(config.rates, self._began)
        self._read = 0.0  # time at which the parameters were requested
        # Time of the last message from a ground station whose RC overrides the autopilot takes.
        self._station_heard: float | None = None
        self._sending = Lock()
        self._closed = Event()
        self._thread = Thread(target=self._receive, name="mavlink", daemon=True)

    @property
    def conflict(self) -> Refusal | None:
        """A reason that prevents an engagement or ends it, or None.

        The reason names who else sends as the autopilot or as the bridge, or a setting of the
        autopilot that prevents every engagement.
        """
        second = self._second if time.monotonic() - self._second_at <= SILENCE else None
        return joined((self._clash, second))

    def listen(self, name: str) -> deque[MavlinkMessage]:
        """Return the queue in which the messages called `name` arrive."""
        return self._queues.setdefault(name, deque(maxlen=QUEUE))

    def start(self) -> None:
        """Begin to receive. Call this after the last `listen`."""
        self._thread.start()

    def send(self, message: Any) -> None:
        """Send a message of `mavlink_type` to the autopilot.

        The message is sent with the system number of the ground station.
        """
        fields = message.packed.fieldnames
        values = {field: getattr(message, field) for field in fields}
        values |= {"target_system": self._config.system, "target_component": AUTOPILOT}
        self._send(message.packed(*(values[field] for field in fields)), self._config.source_system)

    def close(self) -> None:
        """End the thread and the connection."""
        self._closed.set()
        if self._thread.is_alive():
            self._thread.join(2.0)
        self._connection.close()

    def problem(self, name: str | None = None) -> Refusal | None:
        """Say what is wrong with the link, or with the messages called `name`, or return None."""
        now = time.monotonic()
        silent = now - max(self._alive, self._began) > SILENCE
        if silent or (self._refused and not self._alive):
            silence = f"no message of system {self._config.system} over {self._config.url}"
            silence += f" for {SILENCE:g} s" if silent else " is taken"
            systems = ", ".join(map(str, sorted(self._systems)))
            other_systems = None
            if systems:
                other_systems = Refusal(f"an autopilot is system {systems} there: set link.system")
            return joined((Refusal(silence), other_systems, self._refused, self.conflict))
        names = list(self._config.rates) if name is None else [name]
        slow = [reason for message, reason in self._rates.slow(now).items() if message in names]
        refusals = {message: reason for message, reason in self._denied.items() if message in names}
        denied = [
            reason
            for message, reason in refusals.items()
            if not self._rates.is_coming(message, now)
        ]
        return joined((self.conflict, *slow, *denied, TAKEN if slow else None))

    def reason_against_engagement(self) -> Refusal | None:
        """Say why an engagement would lack messages or have no effect, or return None."""
        unknown = self._rates.unknown(time.monotonic())
        rates = Refusal(f"the rate of {', '.join(unknown)} is not known yet") if unknown else None
        return self.problem() or self._dropped_overrides() or rates

    def _station_numbers(self) -> range:
        """Return the numbers of the systems whose RC overrides the autopilot takes.

        The numbers come from the autopilot's parameters, or from the map if these parameters are
        not known.
        """
        first = self.parameters.get(STATION, self.parameters.get(OLD_STATION))
        if first is None:
            first = self._config.source_system
        last = max(first, self.parameters.get(LAST_STATION, 0.0))
        return range(int(first), int(last) + 1)

    def _dropped_overrides(self) -> Refusal | None:
        """Say why the autopilot drops the bridge's RC overrides, or return None if it does not."""
        numbers = self._station_numbers()
        system = self._config.source_system
        if system in numbers:
            return None
        name = STATION if STATION in self.parameters else OLD_STATION
        mend = f"{name} and {LAST_STATION} to a range with it"
        mend = mend if LAST_STATION in self.parameters else f"{name} to {system}"
        return Refusal(
            f"the autopilot drops RC overrides of system {system}: set link.source_system to "
            f"{self._stations_text()}, or {mend}"
        )

    def end_reason(self) -> Refusal | None:
        """Say why an engagement must end: slow messages, or a silent ground station.

        Returns None if there is no such reason.
        """
        now = time.monotonic()
        limit = self._config.station_silence
        silence = None
        if (
            limit is not None
            and self._station_heard is not None
            and now - self._station_heard > limit
        ):
            silence = Refusal(f"ground station {self._stations_text()} is silent for {limit:g} s")
        return joined((self._rates.lasting(now), silence))

    def station(self) -> str:
        """Say which ground station the autopilot's failsafe FS_GCS_ENABL watches.

        The sentence is true while RC overrides are sent.
        """
        system = self._stations_text()
        limit = self._config.station_silence
        effect = f"FS_GCS_ENABL takes RC overrides for heartbeats of ground station {system}"
        if self._station_heard is None:
            return (
                f"{effect}, and no such station is heard: it acts after each release, "
                "FS_LONG_TIMEOUT after the last override"
            )
        watched = (
            "is not watched" if limit is None else f"ends the engagement by {limit:g} s of silence"
        )
        return f"{effect}: station {system}, which is heard, {watched}"

    def _stations_text(self) -> str:
        numbers = self._station_numbers()
        return str(numbers[0]) if len(numbers) == 1 else f"{numbers[0]} to {numbers[-1]}"

    def _send(self, message: Any, system: int) -> None:
        """Send a message with a system number, and the component number COMPANION."""
        with self._sending:
            try:
                self._connection.mav.srcSystem = system
                self._connection.mav.send(message)
            except OSError:
                # The cable may be out. The ages of the received messages will show this.
                return

    def _receive(self) -> None:
        now = time.monotonic()
        while not self._closed.is_set():
            before = now
            now = time.monotonic()
            self._lock.overran(max(0, nanoseconds(now - before - POLL)))
            if now - self._beat >= BEAT:
                self._beat = now
                self._send(
                    self._connection.mav.heartbeat_encode(ONBOARD, INVALID, 0, 0, 0),
                    self._config.system,
                )
            self._request(now)
            self._request_parameters(now)
            try:
                data, address = self._packet()
            except OSError:
                self._closed.wait(POLL)
                continue
            received_ns = time.time_ns()
            for message in self._parsed(data, address):
                self._take(message, address, received_ns)

    def _packet(self) -> tuple[bytes, Address]:
        """Receive bytes, and return them with their sender.

        If no bytes come for the time POLL, the bytes are empty. For TCP and for a serial line, the
        sender is the URL.
        """
        if not self._connection.select(POLL):
            return b"", ()
        if self._is_udp:
            data, address = self._connection.port.recvfrom(PACKET)
            return data, address
        return self._connection.recv(self._parser.bytes_needed()), (self._config.url,)

    def _parsed(self, data: bytes, address: Address) -> Sequence[Any]:
        """Return the messages in received bytes.

        A message may span several packets only if its sender is the one that the lock admits.
        """
        if not self._is_udp or _text(address) == self._lock.address:
            return self._parser.parse_buffer(data) or ()
        # A copy of the signing state is used. Otherwise, after a forged signature with a late time,
        # each later signature of the autopilot would count as replayed.
        return self._new_parser(deepcopy(self._connection.mav.signing)).parse_buffer(data) or ()

    def _new_parser(self, signing: Any) -> Any:
        parser = type(self._connection.mav)(None)
        parser.robust_parsing = True
        parser.signing = signing
        return parser

    def _signature_fault(self, packet: bytes) -> Refusal:
        """Say why the signature of a packet was refused.

        A signature has 6 bytes for a time in units of 10 us, and 6 bytes for a hash (MAVLink
        guide).
        """
        signing = self._connection.mav.signing
        if hashlib.sha256(signing.secret_key + packet[:-6]).digest()[:6] != packet[-6:]:
            return Refusal(
                "messages without a valid signature come: the passphrase differs, or the "
                "autopilot does not sign"
            )
        behind = 1e-5 * (signing.timestamp - int.from_bytes(packet[-12:-6], "little"))
        before = "the last ones" if self._alive else "the clock of this computer"
        restart = (
            "the autopilot has started without the time, which a GPS or a ground station gives"
        )
        return Refusal(
            f"messages with the right passphrase come, signed {behind:.0f} s before {before}: "
            f"{restart}"
        )

    def _take(self, message: Any, address: Address, received_ns: int) -> None:
        name = message.get_type()
        now = time.monotonic()
        system = message.get_srcSystem()
        is_station = name == "HEARTBEAT" and message.type == GCS
        joystick = name in STICKS and system in self._station_numbers()
        namesake = name == "HEARTBEAT" and system == self._config.source_system
        # There may be other senders: a joystick, another bridge, a ground station, an autopilot.
        if joystick or (namesake and not is_station):
            self._clash = Refusal(
                f"another sender on {self._config.url} has system {system} too, and the "
                "autopilot takes its RC overrides:"
                " give it another number, or switch the joystick of a ground station off"
            )
        elif (system, message.get_srcComponent()) == (self._config.system, COMPANION):
            self._clash = Refusal(f"another bridge is on {self._config.url}: end it")
        elif is_station:
            self.stations.add(system)
            if system in self._station_numbers():
                self._station_heard = now
        elif name == "HEARTBEAT" and message.autopilot != INVALID and system != self._config.system:
            self._systems.add(system)
        if name == "BAD_DATA" and "signature" in str(message.reason):
            self._refused = self._signature_fault(bytes(message.data))
        # From here on, only messages of the autopilot from the locked sender count.
        if (message.get_srcSystem(), message.get_srcComponent()) != (
            self._config.system,
            AUTOPILOT,
        ) or name == "BAD_DATA":
            return
        if not self._is_admitted(message, address, now):
            return
        if message.get_header().incompat_flags & SIGNED and self._config.passphrase_file is None:
            self._clash = Refusal(
                "the autopilot signs its messages and drops others: set "
                "link.passphrase_file in the map"
            )
        self._alive = now
        if name == "COMMAND_ACK" and message.command == SET_MESSAGE_INTERVAL:
            self._answered(message.result)
        if name == "PARAM_VALUE":
            self.parameters[message.param_id] = message.param_value
        self._rates.take(name, now)
        if (queue := self._queues.get(name)) is not None:
            queue.append(MavlinkMessage(message, received_ns))

    def _is_admitted(self, message: Any, address: Address, now: float) -> bool:
        """Return whether a message of the autopilot comes from the sender that the lock admits.

        If the sender is new, the link requests the rates of its messages.
        """
        sender = _text(address)
        before = self._lock.address
        now_ns = nanoseconds(now)
        milliseconds = (
            getattr(message, "time_boot_ms", None) if message.get_type() in self._queues else None
        )
        since_boot_ns = None if milliseconds is None else 1_000_000 * milliseconds
        try:
            self._lock.check(sender, since_boot_ns, now_ns)
        except ChannelError as error:
            self._second = Refusal(str(error))
            self._second_at = now
            return False
        is_new_sender = self._lock.refresh(sender, since_boot_ns, now_ns)
        if is_new_sender:
            self._parser = self._new_parser(self._connection.mav.signing)
            if before is not None:
                self._second = Refusal(
                    f"the autopilot at {sender} is new, or has started again; before: {before}"
                )
                self._second_at = now
        if is_new_sender and self._is_udp:
            with self._sending:
                self._connection.clients = {address}
        if is_new_sender or now - self._alive > SILENCE:
            self._to_request = dict(self._config.rates)
            self._denied = {}
            self._began = now
            self._rates.begin(now)
            self.parameters.clear()
        return True

    def _request(self, now: float) -> None:
        """Request the rates of the messages one by one, and again for messages that are too slow.

        The requests cannot be sent together, because an answer does not say to which message it
        belongs.
        """
        self._to_request |= self._rates.step(now)
        if (
            not self._to_request
            or now - self._alive > SILENCE
            or (self._requested and now - self._requested[1] < ANSWER)
        ):
            return
        name, rate = next(iter(self._to_request.items()))
        identity = mavlink_type(name).packed.id
        self._requested = name, now
        encode = self._connection.mav.command_long_encode
        interval = encode(
            self._config.system,
            AUTOPILOT,
            SET_MESSAGE_INTERVAL,
            0,
            identity,
            1e6 / rate,
            0,
            0,
            0,
            0,
            0,
        )
        self._send(interval, self._config.system)

    def _request_parameters(self, now: float) -> None:
        """Request each parameter until it is known, and then again every READ_AGAIN."""
        has_all = all(name in self.parameters for name in self._to_read)
        if now - self._alive > SILENCE or now - self._read < (READ_AGAIN if has_all else ANSWER):
            return
        self._read = now
        for name in (*self._to_read, *self._further):
            encode = self._connection.mav.param_request_read_encode
            self._send(
                encode(self._config.system, AUTOPILOT, name.encode(), -1), self._config.system
            )

    def _answered(self, result: int) -> None:
        if self._requested is None:
            return
        name = self._requested[0]
        self._requested = None
        rate = self._to_request.pop(name, 0.0)
        if result != ACCEPTED:
            self._denied[name] = Refusal(
                f"the autopilot denied {rate:g} Hz of {name} (MAV_RESULT {result}): ArduPilot "
                "grants 0.8 SCHED_LOOP_RATE"
            )


class MavlinkReader:
    """The received messages of one name, read as from a subscription."""

    def __init__(self, link: Link, topic: Any) -> None:
        self.link = link
        self.topic = topic
        self.name = str(topic.name)
        self.message_name = topic.type.__name__
        self.fields = tuple(topic.type.fields)
        self._queue = link.listen(self.message_name)

    def take(self) -> list[MavlinkMessage]:
        """Return the messages that arrived since the last call, the oldest first."""
        return [self._queue.popleft() for _ in range(len(self._queue))]


class MavlinkPublisher:
    """Sends messages on a link, with the interface of a publisher."""

    def __init__(self, link: Link, topic: str) -> None:
        self._link = link
        self.topic_name = topic

    def publish(self, message: Any) -> None:
        """Send a message on the link."""
        self._link.send(message)
