# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Decode the logs of autopilots, and find the system, the sensors and the clock of the flight.

Sources: as in `vehicle_log`; MAVLink, common.xml (time_boot_ms), MAVLink guide, Serialization
(the sequence of a link).
"""

import re
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from io import BytesIO
from itertools import chain
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from flight_core.installation import require_package
from flight_core.parameters import ParameterError, require
from flight_core.rates import NANOSECONDS
from flight_core.vectors import FloatArray
from flight_log.file_kinds import HEAD_BYTES, FileKind, tlog_start
from flight_log.flown_instance import instances_of_flight, moving_numbers
from flight_log.log_samples import (
    LARGEST,
    SETTING,
    Instances,
    Sample,
    is_near,
    is_number,
    parameters_of,
    table_of,
    tables_of,
)
from flight_log.ulog_messages import whole_messages
from flight_log.vehicle_tables import (
    DATAFLASH,
    PARAMETER,
    SERVOS,
    STICKS,
    TLOG,
    ULOG_SOURCES,
    ULOG_TORQUES,
    VEHICLE_TYPES,
    Choice,
    Format,
    Loss,
    MessageTable,
    OtherVehicle,
    Reason,
    Taken,
    VehicleKind,
    VehicleLog,
    enumeration,
)

AUTOPILOT = 1  # MAV_COMP_ID_AUTOPILOT1, common.xml
NO_AUTOPILOT = 8  # MAV_AUTOPILOT_INVALID of a ground station and of other components
ULOG_HEAD = 16  # bytes of magic, version and time at the beginning of a ULog
# Reads that pyulog may make for each byte of a log. In damaged data it starts a search at each
# byte. The head of a message and the message after it are then read twice.
READS_PER_BYTE = 4
FIRMWARE = re.compile(r"(?:Ardu|APM:)(Plane|Copter|Rover|Sub)")  # in a MSG of ArduPilot
FIRMWARES: Mapping[str, VehicleKind] = MappingProxyType(
    {
        "Plane": VehicleKind.PLANE,
        "Copter": VehicleKind.MULTICOPTER,
        "Rover": VehicleKind.ROVER,
        "Sub": VehicleKind.SUBMARINE,
    }
)
MAV_TYPES: Mapping[int, VehicleKind] = MappingProxyType(
    dict.fromkeys((1, 19, 20, 21, 22, 23, 24, 25), VehicleKind.PLANE)  # fixed wing, VTOL
    | dict.fromkeys((2, 3, 4, 13, 14, 15, 29, 35), VehicleKind.MULTICOPTER)
    | dict.fromkeys((10, 11), VehicleKind.ROVER)
    | {12: VehicleKind.SUBMARINE}
)
"""Kinds of vehicles by MAV_TYPE, common.xml."""

PX4 = 12  # MAV_AUTOPILOT_PX4
PX4_MANUAL = 1 << 16  # flag of the main mode MANUAL in its custom_mode (px4_custom_mode.h)

OLD_NAMES = MappingProxyType({"IMU2": ("IMU", 1), "IMU3": ("IMU", 2), "ASP2": ("ARSP", 1)})
"""Messages of the second and the third sensor of ArduPilot before 4.0: name and instance."""

FLAGS: Mapping[str, set[str]] = MappingProxyType(
    {"ARSP": {"H", "U", "Pri"}, "IMU": {"GH"}, "CTUN": {"E2T"}}
)
"""More fields of DataFlash that are read: flags of the sensors, and the ratio of true to equivalent
airspeed."""


def _read_dataflash(path: Path, kind: FileKind, choice: Choice) -> VehicleLog:
    require_package("pymavlink")
    from flight_log.dataflash import Lines, Packets, stamp_us  # noqa: PLC0415 - an extra

    fields = _wanted(DATAFLASH)
    fields_and_flags = {
        name: fields.get(name, set()) | FLAGS.get(name, set()) for name in (*fields, *FLAGS)
    }
    firmwares: dict[str, None] = {}
    reader = Lines(str(path)) if kind is FileKind.DATAFLASH_TEXT else Packets(str(path))
    loss = reader.loss()

    def samples() -> Iterator[Sample]:
        newest_us = 0.0
        with closing(reader):
            while (
                message := reader.recv_match(type=[*fields_and_flags, *OLD_NAMES, PARAMETER, "MSG"])
            ) is not None:
                name = message.get_type()
                if name == "MSG":
                    firmwares.update(dict.fromkeys(FIRMWARE.findall(str(message.Message))))
                    continue
                newest_us = stamp_us(message, newest_us)
                stamp_ns = min(round(1e3 * newest_us), LARGEST)
                # The number of an instance is the number of the sensor or of the core.
                number = int(getattr(message, "I", 0) or getattr(message, "C", 0))
                if name == PARAMETER:
                    yield SETTING, stamp_ns, (message.Name, float(message.Value))
                else:
                    yield OLD_NAMES.get(name, (name, number)), stamp_ns, message
            columns = {form.name: form.columns for form in reader.formats.values()}
            is_old = "StartTime" in columns.get("TIME", ()) or "GyroX" in columns.get("IMU", ())
            require(
                not is_old,
                str(path),
                "a log of PX4 before 2017 (sdlog2)",
                "a ULog, which PX4 has written since then",
            )

    instances, parameters, parts = tables_of(samples(), fields_and_flags)
    tables, choices = instances_of_flight(instances, fields, parameters, choice)
    _convert_to_true_airspeed(tables)
    vehicle = FIRMWARES.get(next(iter(firmwares), ""))
    if (attitude := tables.get("ATT")) is not None:
        attitude.fields["Yaw"][:] = np.remainder(attitude.fields["Yaw"] + 180.0, 360.0) - 180.0
    return VehicleLog(
        kind=kind.value + parts,
        tables=tables,
        parameters=parameters,
        format=DATAFLASH,
        vehicle=vehicle,
        taken=tuple(choices),
        loss=loss,
    )


def _convert_to_true_airspeed(tables: Mapping[str, MessageTable]) -> None:
    """Convert equivalent airspeed to true airspeed in place, by the ratio in CTUN."""
    control = tables.get("CTUN")
    if control is None or "E2T" not in control.fields:
        return
    for name, field in (("ARSP", "Airspeed"), ("CTUN", "As"), ("CTUN", "Aspd")):
        if name in tables and field in tables[name].fields:
            ratio = control.at("E2T", tables[name].stamp_ns)
            tables[name].fields[field][:] *= np.where(np.isfinite(ratio), ratio, 1.0)


@dataclass(frozen=True, kw_only=True)
class Received:
    """A message of an autopilot in a tlog."""

    name: str
    sequence: int  # sequence number on its link, 0 to 255
    arrival_ns: int
    content: Any


def _read_tlog(path: Path, kind: FileKind, choice: Choice) -> VehicleLog:
    require_package("pymavlink")
    from pymavlink import mavutil  # noqa: PLC0415 - an extra

    fields = _wanted(TLOG)
    # MAV_AUTOPILOT and MAV_TYPE of systems in the order of their heartbeats
    autopilots: dict[int, tuple[int, int]] = {}
    messages: dict[int, list[Received]] = {}
    mavutil.set_dialect("ardupilotmega")
    # mavlogfile would not skip bytes before the first message.
    with path.open("rb") as stream:
        start = tlog_start(stream.read(HEAD_BYTES)) or 0
    with closing(mavutil.mavlogfile(str(path))) as reader:
        reader.f.seek(start)
        while (message := reader.recv_match(type=[*fields, "PARAM_VALUE"])) is not None:
            name = message.get_type()
            if message.get_srcComponent() == AUTOPILOT:
                system = message.get_srcSystem()
                if name == "HEARTBEAT" and message.autopilot != NO_AUTOPILOT:
                    autopilots.setdefault(system, (message.autopilot, message.type))
                stamp_ns = min(round(NANOSECONDS * message._timestamp), LARGEST)
                messages.setdefault(system, []).append(
                    Received(
                        name=name, sequence=message.get_seq(), arrival_ns=stamp_ns, content=message
                    )
                )
    system, choices = _flown_system(
        {number: messages[number] for number in autopilots}, choice.system
    )
    instances, parameters, parts = tables_of(_dated(messages.get(system, [])), fields)
    tables, _ = instances_of_flight(instances, fields, parameters, choice)
    autopilot, mav_type = autopilots.get(system, (0, -1))
    of_type = MAV_TYPES.get(mav_type) or OtherVehicle("MAV_TYPE", mav_type)
    vehicle = None if mav_type < 0 else of_type
    manual = PX4_MANUAL if autopilot == PX4 else 0
    return VehicleLog(
        kind=kind.value + parts,
        tables=tables,
        parameters=parameters,
        format=TLOG,
        vehicle=vehicle,
        manual=manual,
        taken=choices,
    )


def _flown_system(
    messages_of: Mapping[int, list[Received]], choice: int | None
) -> tuple[int, tuple[Taken, ...]]:
    """Choose which system of a tlog flew, and return its number.

    `choice` is the user's choice. The number is 0 if no autopilot sent a heartbeat. The second
    result says what was taken and why. It is empty if there was nothing to choose. Raises
    ParameterError if two systems moved, or if the log lacks the system that the user chose.
    """
    among = tuple(messages_of)
    if choice is not None:
        numbers = enumeration(among) or "none with a heartbeat"
        require(choice in messages_of, "--system", choice, f"one of {numbers}")
        return choice, (Taken("system", (choice,), among, Reason.BY_SYSTEM),)
    motions = {}
    for system, messages in messages_of.items():
        attitudes = [message.content for message in messages if message.name == "ATTITUDE"]
        rates = [
            [attitude.rollspeed, attitude.pitchspeed, attitude.yawspeed] for attitude in attitudes
        ]
        motions[system] = float(np.std(rates, axis=0).sum()) if rates else 0.0
    if not messages_of:
        return 0, ()
    moving = moving_numbers(motions)
    if len(moving) > 1:
        ways_out = " or ".join(f"--system {system}" for system in moving)
        raise ParameterError(
            f"the log: found several systems that moved, {enumeration(moving)}, expected a choice: "
            f"{ways_out}"
        )
    if len(among) == 1:
        return moving[0], ()
    return moving[0], (Taken("system", (moving[0],), among, Reason.SYSTEM_MOVES),)


# The clock is taken to stand still if at most this share of the messages with a time have different
# times.
LEAST_TIMES = 0.1
# number of recent messages with a time, from which a message without a time gets its time
RECENT = 16
# ns; a message that arrives again within this time, with the same name and time, is a repetition
AGAIN_NS = 30 * NANOSECONDS


def _dated(messages: list[Received]) -> Iterator[Sample]:
    """Yield the samples with stamps by the clock of the autopilot.

    The times of arrival cannot serve: a radio may bunch messages, and a second link repeats
    messages later. The sequence numbers show which message came before on the same link. A message
    without a time gets the time of that one. The stamp of the first message with a time is its
    arrival. If no message has a time, or if the clock stands still, each stamp is an arrival.
    """
    with_time = [message for message in messages if hasattr(message.content, "time_boot_ms")]
    times = {message.content.time_boot_ms for message in with_time}
    by_arrival = len(times) <= LEAST_TIMES * len(with_time)
    if not with_time:
        offset_ns = 0
    else:
        offset_ns = with_time[0].arrival_ns - 1_000_000 * with_time[0].content.time_boot_ms
    newest_ns = with_time[0].arrival_ns if with_time else 0
    # Sequences and stamps. The stamp of a repetition is None.
    recent = deque[tuple[int, int | None]](maxlen=RECENT)
    arrivals: dict[tuple[str, int], int] = {}  # ns, by name and time, without repetitions
    for message in messages:
        name, content, arrival_ns = message.name, message.content, message.arrival_ns
        stamp_ns: int | None
        if by_arrival:
            stamp_ns = newest_ns = arrival_ns
        elif (boot_ms := getattr(content, "time_boot_ms", None)) is not None:
            before_ns = arrivals.get((name, boot_ms))
            repeated = before_ns is not None and arrival_ns - before_ns <= AGAIN_NS
            if not repeated:
                arrivals[name, boot_ms] = arrival_ns
            stamp_ns = None if repeated else offset_ns + 1_000_000 * boot_ms
            newest_ns = newest_ns if stamp_ns is None else stamp_ns
            recent.appendleft((message.sequence, stamp_ns))
        else:
            preceding = min(
                recent,
                key=lambda place: (message.sequence - place[0]) % 256,
                default=(0, newest_ns),
            )
            stamp_ns = preceding[1]
        if name == "PARAM_VALUE":
            yield (
                SETTING,
                newest_ns if stamp_ns is None else stamp_ns,
                (content.param_id, float(content.param_value)),
            )
        elif stamp_ns is not None:
            yield (name, 0), stamp_ns, content


def _read_ulog(path: Path, kind: FileKind, choice: Choice) -> VehicleLog:
    require_package("pyulog")
    from pyulog import ULog  # noqa: PLC0415 - an extra
    from pyulog.core import ULogException  # noqa: PLC0415

    if path.stat().st_size < ULOG_HEAD:
        raise ValueError("the head of the file is cut short")
    messages = whole_messages(path.read_bytes())
    loss = messages.loss
    try:
        _require_short(ULog(UlogContent(messages.content), parse_header_only=True).message_formats)
        log = ULog(UlogContent(messages.content))
    except (ULogException, EOFError) as error:
        raise ValueError(error) from None
    damage = ", damaged: only a part can be read" if log.file_corruption else ""
    if log.dropouts:
        loss = _with_dropouts(loss, log.dropouts)
    instances: Instances = {}
    for data in log.data_list:
        columns = {name: np.asarray(values, dtype=np.float64) for name, values in data.data.items()}
        stamps = 1000 * data.data["timestamp"].astype(np.int64)
        keep = is_near(stamps)
        table = table_of(stamps[keep], {name: values[keep] for name, values in columns.items()})
        instances.setdefault(data.name, {})[data.multi_id] = table
    vehicle, is_vtol = _vehicle(instances)
    # Logs before PX4 1.14.
    if is_vtol and "actuator_controls_1" in instances:
        instances["actuator_controls_0"] |= {1: instances["actuator_controls_1"][0]}
    initial = [(0, name, value) for name, value in log.initial_parameters.items()]
    records = [
        (SETTING, 1000 * stamp_us, (name, float(value)))
        for stamp_us, name, value in (*initial, *log.changed_parameters)
        # A value that is no number is damaged.
        if is_number(value)
    ]
    parameters = parameters_of(records)
    sources = chain(*ULOG_SOURCES.values(), ULOG_TORQUES.values())
    places = [(source.message, source.field) for source in sources]
    fields = _by_message([*places, *ULOG_TORQUES])
    tables, choices = instances_of_flight(instances, fields, parameters, choice)
    if (attitude := tables.get("vehicle_attitude")) is not None:
        tables["vehicle_attitude"] = MessageTable(
            attitude.stamp_ns, {**attitude.fields, **_angles(attitude)}
        )
    return VehicleLog(
        kind=kind.value + damage,
        tables=tables,
        parameters=parameters,
        format=None,
        vehicle=vehicle,
        taken=tuple(choices),
        loss=loss,
    )


class UlogContent(BytesIO):
    """The content of a ULog as a stream, which ends after too many reads.

    Without this limit, pyulog may read the same truncated message again for ever.
    """

    def __init__(self, content: bytes) -> None:
        """Permit READS_PER_BYTE reads for each byte, more than any readable log needs."""
        super().__init__(content)
        self._left = READS_PER_BYTE * len(content)

    def read(self, size: int | None = -1, /) -> bytes:
        """Read as usual. Raises EOFError after too many reads."""
        self._left -= 1
        if self._left < 0:
            raise EOFError("a damaged message has no end")
        return super().read(size)


def _with_dropouts(loss: Loss | None, dropouts: Sequence[Any]) -> Loss:
    """Combine the loss of bytes with the dropouts that the logger reports, message O of a ULog."""
    seconds = 1e-3 * sum(dropout.duration for dropout in dropouts)
    count = "a dropout" if len(dropouts) == 1 else f"{len(dropouts)} dropouts"
    what = f"{count} of the logger, {seconds:.2g} s in all"
    stamps = [1000 * int(dropout.timestamp) for dropout in dropouts]
    if loss is None:
        return Loss(what, min(stamps), max(stamps))
    return Loss(
        f"{loss.what}, and {what}",
        min(loss.first_ns, *stamps),
        max(loss.last_ns, *stamps),
    )


def _angles(attitude: MessageTable) -> dict[str, FloatArray]:
    """Compute Euler angles in the order z, y, x, as autopilot_bridge.channel_map does."""
    w, x, y, z = (attitude.fields[f"q[{k}]"] for k in range(4))
    return {
        "phi": np.arctan2(2 * (w * x + y * z), w * w - x * x - y * y + z * z),
        "theta": np.arcsin(np.clip(2 * (w * y - x * z), -1.0, 1.0)),
        "psi": np.arctan2(2 * (w * z + x * y), w * w + x * x - y * y - z * z),
    }


def _vehicle(instances: Instances) -> tuple[VehicleKind | OtherVehicle | None, bool]:
    """Return the kind of vehicle in `vehicle_status`, if known, and whether it is a VTOL.

    The kind of a VTOL is None, because it changes in flight. In a log before PX4 1.10, this adds
    the field `vehicle_type` to the table.
    """
    table = instances.get("vehicle_status", {}).get(0)
    if table is None:
        return None, False
    fields = dict(table.fields)
    # Logs before PX4 1.10.
    if "vehicle_type" not in fields and "is_rotary_wing" in fields:
        fields["vehicle_type"] = np.where(
            fields["is_rotary_wing"] != 0.0,
            VEHICLE_TYPES[VehicleKind.MULTICOPTER],
            VEHICLE_TYPES[VehicleKind.PLANE],
        )
        instances["vehicle_status"][0] = table._replace(fields=fields)
    if fields.get("is_vtol", np.zeros(1)).any():
        return None, True
    number = int(np.median(fields.get("vehicle_type", np.zeros(1))))
    if number == 0:
        return None, False
    kinds = {code: kind for kind, code in VEHICLE_TYPES.items()}
    return kinds.get(number) or OtherVehicle("vehicle_type", number), False


def _by_message(places: Iterable[tuple[str, str]]) -> dict[str, set[str]]:
    """Group the given fields by the message that has them."""
    fields: dict[str, set[str]] = {}
    for message, field in places:
        fields.setdefault(message, set()).add(field)
    return fields


def _wanted(log_format: Format) -> dict[str, set[str]]:
    """Return the fields that are read from a format, by message."""
    sources = (*log_format.sources.values(), *log_format.torques.values(), log_format.mode)
    places = [(source.message, source.field) for source in chain(*sources)]
    for source, count in ((log_format.sticks, STICKS), (log_format.servos, SERVOS)):
        places += [(source.message, source.field.format(k)) for k in range(1, count + 1)]
    return _by_message(places)


ULOG_VALUES = 65535
"""Most values in a message of a ULog, because its length in bytes is a number of 16 bits."""


def _require_short(formats: Mapping[str, Any]) -> None:
    """Raise ValueError for a format with more values than a message can hold.

    pyulog would make a field for each value.
    """
    counts: dict[str, int] = {}

    def count(name: str) -> int:
        if name not in counts and name in formats:
            counts[name] = sum(max(size, 1) * count(kind) for kind, size, _ in formats[name].fields)
        return counts.get(name, 1)

    for name in formats:
        if count(name) > ULOG_VALUES:
            raise ValueError(f"a message {name} of {count(name)} values")


READERS: Mapping[FileKind, Callable[[Path, FileKind, Choice], VehicleLog]] = MappingProxyType(
    {
        FileKind.ULOG: _read_ulog,
        FileKind.DATAFLASH: _read_dataflash,
        FileKind.DATAFLASH_TEXT: _read_dataflash,
        FileKind.TLOG: _read_tlog,
    }
)
"""Readers by the kind of a file."""
