# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Reads the logs that autopilots write: DataFlash of ArduPilot, tlogs of MAVLink, ULogs of PX4.

Sources: ArduPilot, libraries/AP_Logger/LogStructure.h and ArduPlane/Log.cpp; MAVLink, common.xml; PX4 guide, ULog file format,
and PX4's msg/*.msg. pymavlink and pyulog decode the files.
"""

import math
import os
import re
from collections.abc import Iterable, Iterator, Mapping
from contextlib import closing, contextmanager, redirect_stderr, redirect_stdout
from io import StringIO
from itertools import chain
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from flight_core import isolated
from flight_core.installation import require_package
from flight_core.parameters import ParameterError, require
from flight_core.rates import NANOSECONDS
from flight_core.vectors import FloatArray
from flight_log.file_kinds import file_kind

DEGREE = math.pi / 180.0
AUTOPILOT = 1  # MAV_COMP_ID_AUTOPILOT1, common.xml
# channels that are read
STICKS = 16
SERVOS = 16
LARGEST = 2**62  # ns, of a damaged stamp
ULOG_HEAD = 16  # bytes: magic, version and time


class Table(NamedTuple):
    """The samples of a message: stamps, ns, shape (N,), ascending, and the fields by name, each of shape (N,)."""

    stamp_ns: NDArray[np.int64]
    fields: Mapping[str, FloatArray]

    def at(self, field: str, stamp_ns: NDArray[np.int64]) -> FloatArray:
        """The newest value of a field at each of some instants, shape (n,); NaN before the first."""
        places = np.searchsorted(self.stamp_ns, stamp_ns, side="right") - 1
        return np.where(places < 0, np.nan, self.fields[field][places])


class ParameterRecord(NamedTuple):
    """A value of a parameter of the autopilot, and the instant of the record, ns."""

    stamp_ns: int
    value: float


Parameters = Mapping[str, tuple[ParameterRecord, ...]]
"""The records of the parameters by name, in the order of the log."""

PARAMETER = "PARM"  # a message of DataFlash; the samples of each format have their parameters by this name


class Source(NamedTuple):
    """Where a log has a quantity: value = scale field."""

    message: str
    field: str
    scale: float = 1.0


Sources = Mapping[str, tuple[Source, ...]]
"""By quantity the places that may have it, the first one first."""


class Format(NamedTuple):
    """A format of logs: what has y and pose in SI (body FRD; north, east, up), the transmitter's channels, the servos."""

    sources: Sources
    sticks: Source  # its field has the number of the channel in place of {}
    servos: Source
    mode: tuple[Source, ...]
    torques: Sources = MappingProxyType({})  # of a multicopter's rate controllers, normalised, by what responds to them


def _sources(**places: tuple[Source, ...] | Source) -> Sources:
    return MappingProxyType({name: (source,) if isinstance(source, Source) else source for name, source in places.items()})


def _estimator(field: str, scale: float = 1.0) -> tuple[Source, ...]:
    return tuple(Source(message, field, scale) for message in ("XKF1", "NKF1", "EKF1"))  # EKF3, EKF2, EKF2 of old releases


DATAFLASH = Format(
    sources=_sources(
        q=Source("IMU", "GyrY"),
        p=Source("IMU", "GyrX"),
        r=Source("IMU", "GyrZ"),
        V=(Source("ARSP", "Airspeed"), Source("CTUN", "As"), Source("CTUN", "Aspd")),  # equivalent: _true_airspeed
        phi=Source("ATT", "Roll", DEGREE),
        theta=Source("ATT", "Pitch", DEGREE),
        psi=Source("ATT", "Yaw", DEGREE),
        north=_estimator("PN"),
        east=_estimator("PE"),
        altitude=_estimator("PD", -1.0),
        v_north=_estimator("VN"),
        v_east=_estimator("VE"),
        climb=_estimator("VD", -1.0),
    ),
    sticks=Source("RCIN", "C{}"),
    servos=Source("RCOU", "C{}"),
    mode=(Source("MODE", "ModeNum"), Source("MODE", "Mode")),
    torques=_sources(
        q=Source("RATE", "POut"), p=Source("RATE", "ROut"), r=Source("RATE", "YOut"), climb=Source("RATE", "AOut")
    ),
)
TLOG = Format(
    sources=_sources(
        q=Source("ATTITUDE", "pitchspeed"),
        p=Source("ATTITUDE", "rollspeed"),
        r=Source("ATTITUDE", "yawspeed"),
        V=Source("VFR_HUD", "airspeed"),
        phi=Source("ATTITUDE", "roll"),
        theta=Source("ATTITUDE", "pitch"),
        psi=Source("ATTITUDE", "yaw"),
        north=Source("LOCAL_POSITION_NED", "x"),
        east=Source("LOCAL_POSITION_NED", "y"),
        altitude=Source("LOCAL_POSITION_NED", "z", -1.0),
        v_north=Source("LOCAL_POSITION_NED", "vx"),
        v_east=Source("LOCAL_POSITION_NED", "vy"),
        climb=Source("LOCAL_POSITION_NED", "vz", -1.0),
    ),
    sticks=Source("RC_CHANNELS", "chan{}_raw"),
    servos=Source("SERVO_OUTPUT_RAW", "servo{}_raw"),
    mode=(Source("HEARTBEAT", "custom_mode"),),
)


def _rate(axis: int) -> tuple[Source, ...]:
    return Source("vehicle_angular_velocity", f"xyz[{axis}]"), Source("sensor_combined", f"gyro_rad[{axis}]")  # before 1.10


ULOG_SOURCES = _sources(
    q=_rate(1),
    p=_rate(0),
    r=_rate(2),
    V=(Source("airspeed_validated", "true_airspeed_m_s"), Source("airspeed", "true_airspeed_m_s")),
    phi=Source("vehicle_attitude", "phi"),
    theta=Source("vehicle_attitude", "theta"),
    psi=Source("vehicle_attitude", "psi"),
    north=Source("vehicle_local_position", "x"),
    east=Source("vehicle_local_position", "y"),
    altitude=Source("vehicle_local_position", "z", -1.0),
    v_north=Source("vehicle_local_position", "vx"),
    v_east=Source("vehicle_local_position", "vy"),
    climb=Source("vehicle_local_position", "vz", -1.0),
)


ULOG_TORQUES: Mapping[tuple[str, str], Source] = MappingProxyType(
    {("vehicle_torque_setpoint", f"xyz[{axis}]"): Source("actuator_controls_0", f"control[{axis}]") for axis in range(3)}
    | {("vehicle_thrust_setpoint", "xyz[0]"): Source("actuator_controls_0", "control[3]")}
    | {("vehicle_thrust_setpoint", "xyz[2]"): Source("actuator_controls_0", "control[3]", -1.0)}
)
"""Where PX4 before 1.14 has the setpoints of torque and thrust (actuator_controls.msg: roll, pitch, yaw, thrust)."""

PLANE = "plane"
COPTER = "multicopter"
FIRMWARE = re.compile(r"(?:Ardu|APM:)(Plane|Copter|Rover|Sub)")  # in a MSG of ArduPilot
FIRMWARES = MappingProxyType({"Plane": PLANE, "Copter": COPTER, "Rover": "rover", "Sub": "submarine"})
MAV_TYPES: Mapping[int, str] = MappingProxyType(
    dict.fromkeys((1, 19, 20, 21, 22, 23, 24, 25), PLANE)  # fixed wing, VTOL
    | dict.fromkeys((2, 3, 4, 13, 14, 15, 29, 35), COPTER)
    | dict.fromkeys((10, 11), "rover")
    | {12: "submarine"}
)
"""Kinds of vehicles by MAV_TYPE, common.xml."""

PX4 = 12  # MAV_AUTOPILOT_PX4
PX4_MANUAL = 1 << 16  # and its custom_mode with the main mode MANUAL (px4_custom_mode.h)
# an autopilot that goes back by a step has started again; a link may be lost
STEP_NS = NANOSECONDS
LOST_NS = 60 * NANOSECONDS
AGREEING = 5  # samples, after which another time is that of the clock


class VehicleLog(NamedTuple):
    """A log of an autopilot. `format` is None for a ULog, whose messages have the names of PX4's topics."""

    kind: str
    tables: Mapping[str, Table]
    parameters: Parameters
    format: Format | None
    vehicle: str = PLANE
    manual: int = 0  # the number of the mode in which the sticks of a plane are the commands: 0 of ArduPlane (mode.h)

    def source(self, quantity: str) -> Source | None:
        """The place in this log that has a quantity of y or of the pose; None where it has none."""
        sources = ULOG_SOURCES if self.format is None else self.format.sources
        return next((source for source in sources.get(quantity, ()) if self.has(source)), None)

    def start_ns(self, quantity: str) -> int:
        """The first stamp of a quantity that the log has."""
        source = self.source(quantity)
        return 0 if source is None else int(self.tables[source.message].stamp_ns[0])

    def parameters_at(self, stamp_ns: int) -> dict[str, float]:
        """The values of the parameters at an instant, without parameters whose first record comes later."""
        values: dict[str, float] = {}
        for name, records in self.parameters.items():
            known = [record.value for record in records if record.stamp_ns <= stamp_ns]
            if known:
                values[name] = known[-1]
        return values

    def has(self, source: Source) -> bool:
        """Whether the log has samples of a field."""
        return source.message in self.tables and source.field in self.tables[source.message].fields

    def at(self, source: Source, stamp_ns: NDArray[np.int64]) -> FloatArray:
        """The newest value of a place at each of some instants, shape (n,); NaN before the first."""
        return source.scale * self.tables[source.message].at(source.field, stamp_ns)


EXPECTED = "a DataFlash log (.bin, .log), a tlog or a ULog"


def read_vehicle_log(path: Path) -> VehicleLog:
    """Read the log of an autopilot. Raises ParameterError for another file, and where no message can be decoded."""
    require(path.is_file(), str(path), "no such file", EXPECTED)
    kind = file_kind(path)
    readers = {"ULog": _read_ulog, "DataFlash": _read_dataflash, "tlog": _read_tlog}
    read = next((reader for word, reader in readers.items() if f" {word} " in f"{kind} "), None)
    if read is None:
        raise ParameterError(f"{path}: found {kind}, expected {EXPECTED}")
    try:
        with _silent():
            log = read(path, kind)
    except ParameterError:  # of a package that is missing
        raise
    except Exception as error:  # pymavlink raises Exception itself for a damaged format
        reason = str(error) or type(error).__name__
        raise ParameterError(f"{path}: found {kind} that cannot be decoded ({reason}), expected {EXPECTED}") from None
    require(bool(log.tables), str(path), f"{kind} without a message of y or u", "the log of a flight")
    return log


@contextmanager
def _silent() -> Iterator[None]:
    """Discard what pymavlink and pyulog print of a damaged file, a line for each byte without a message, from C too."""
    with redirect_stdout(StringIO()) as text, redirect_stderr(text), Path(os.devnull).open("wb") as null:
        try:
            stderr = os.dup(2)
        except OSError:  # it is closed
            yield
            return
        os.dup2(null.fileno(), 2)
        try:
            yield
        finally:
            os.dup2(stderr, 2)
            os.close(stderr)


def _read_dataflash(path: Path, kind: str) -> VehicleLog:
    require_package("pymavlink")
    from pymavlink import DFReader  # noqa: PLC0415 - an extra

    wanted = _wanted(DATAFLASH)
    wanted.setdefault("CTUN", set()).add("E2T")
    firmwares: dict[str, None] = {}

    def samples() -> Iterator[Sample]:
        stamp_us = 0.0
        reader = DFReader.DFReader_text(str(path)) if "text" in kind else DFReader.DFReader_binary(str(path))
        with closing(reader):
            while (message := reader.recv_match(type=[*wanted, PARAMETER, "MSG"])) is not None:
                name = message.get_type()
                if name == "MSG":
                    firmwares.update(dict.fromkeys(FIRMWARE.findall(str(message.Message))))
                elif not (getattr(message, "I", 0) or getattr(message, "C", 0)):  # of the first sensor and of the first core
                    # Logs of 2014 and before have ms, and MODE has no time: that of the message before.
                    stamp_us = getattr(message, "TimeUS", 1e3 * getattr(message, "TimeMS", 1e-3 * stamp_us))
                    content = (message.Name, float(message.Value)) if name == PARAMETER else message
                    yield name, min(round(1e3 * stamp_us), LARGEST), content

    tables, parameters, parts = _tables(samples(), wanted)
    _true_airspeed(tables)
    vehicle = FIRMWARES[next(iter(firmwares), "Plane")]
    if (attitude := tables.get("ATT")) is not None:
        attitude.fields["Yaw"][:] = np.remainder(attitude.fields["Yaw"] + 180.0, 360.0) - 180.0
    return VehicleLog(kind + parts, tables, parameters, DATAFLASH, vehicle)


def _true_airspeed(tables: Mapping[str, Table]) -> None:
    """Turn equivalent into true airspeed by the ratio in CTUN, in place."""
    control = tables.get("CTUN")
    if control is None or "E2T" not in control.fields:
        return
    for name, field in (("ARSP", "Airspeed"), ("CTUN", "As"), ("CTUN", "Aspd")):
        if name in tables and field in tables[name].fields:
            ratio = control.at("E2T", tables[name].stamp_ns)
            tables[name].fields[field][:] *= np.where(np.isfinite(ratio), ratio, 1.0)


def _read_tlog(path: Path, kind: str) -> VehicleLog:
    require_package("pymavlink")
    from pymavlink import mavutil  # noqa: PLC0415 - an extra

    wanted = _wanted(TLOG)
    autopilots: dict[int, tuple[int, int]] = {}  # MAV_AUTOPILOT and MAV_TYPE of systems in the order of their heartbeats

    def samples() -> Iterator[Sample]:
        mavutil.set_dialect("ardupilotmega")
        with closing(mavutil.mavlogfile(str(path))) as reader:  # by its content, not by its name
            while (message := reader.recv_match(type=[*wanted, "PARAM_VALUE"])) is not None:
                name = message.get_type()
                if message.get_srcComponent() != AUTOPILOT:
                    continue
                if name == "HEARTBEAT":
                    autopilots.setdefault(message.get_srcSystem(), (message.autopilot, message.type))
                if message.get_srcSystem() != next(iter(autopilots), None):
                    continue
                stamp_ns = min(round(NANOSECONDS * message._timestamp), LARGEST)
                if name == "PARAM_VALUE":
                    yield PARAMETER, stamp_ns, (message.param_id, float(message.param_value))
                else:
                    yield name, stamp_ns, message

    tables, parameters, parts = _tables(samples(), wanted)
    first, *others = map(str, autopilots) if autopilots else ("none",)
    left_out = f", system {first} alone; it also has {', '.join(others)}" if others else ""
    autopilot, mav_type = next(iter(autopilots.values()), (0, 1))
    vehicle = MAV_TYPES.get(mav_type, f"vehicle of MAV_TYPE {mav_type}")
    manual = PX4_MANUAL if autopilot == PX4 else 0
    return VehicleLog(kind + left_out + parts, tables, parameters, TLOG, vehicle, manual)


def _read_ulog(path: Path, kind: str) -> VehicleLog:
    require_package("pyulog")
    from pyulog import ULog  # noqa: PLC0415 - an extra
    from pyulog.core import ULogException  # noqa: PLC0415

    if path.stat().st_size < ULOG_HEAD:
        raise ValueError("its head is cut")
    try:
        _require_short(ULog(str(path), parse_header_only=True).message_formats)
        log = ULog(str(path))
    except ULogException as error:
        raise ValueError(error) from None
    if log.file_corruption:
        kind += ", damaged: what can be read"
    tables = {}
    for data in log.data_list:
        if data.multi_id == 0:
            columns = {name: np.asarray(values, dtype=np.float64) for name, values in data.data.items()}
            stamps = 1000 * data.data["timestamp"].astype(np.int64)
            keep = _near(stamps)
            tables[data.name] = _table(stamps[keep], {name: values[keep] for name, values in columns.items()})
    attitude = tables.get("vehicle_attitude")
    if attitude is not None:
        w, x, y, z = (attitude.fields[f"q[{k}]"] for k in range(4))
        angles = {  # z, y, x, as of autopilot_bridge.channel_map
            "phi": np.arctan2(2 * (w * x + y * z), w * w - x * x - y * y + z * z),
            "theta": np.arcsin(np.clip(2 * (w * y - x * z), -1.0, 1.0)),
            "psi": np.arctan2(2 * (w * z + x * y), w * w + x * x - y * y - z * z),
        }
        tables["vehicle_attitude"] = Table(attitude.stamp_ns, {**attitude.fields, **angles})
    initial = [(0, name, value) for name, value in log.initial_parameters.items()]
    records = [
        (PARAMETER, 1000 * stamp_us, (name, float(value)))
        for stamp_us, name, value in (*initial, *log.changed_parameters)
        if _is_number(value)  # else it is damaged
    ]
    return VehicleLog(kind, tables, _parameters(records), None)


def _wanted(log_format: Format) -> dict[str, set[str]]:
    """The fields that are read, by message."""
    sources = (*log_format.sources.values(), *log_format.torques.values(), log_format.mode)
    places = [*chain.from_iterable(sources)]
    for source, count in ((log_format.sticks, STICKS), (log_format.servos, SERVOS)):
        places += [Source(source.message, source.field.format(number)) for number in range(1, count + 1)]
    wanted: dict[str, set[str]] = {}
    for source in places:
        wanted.setdefault(source.message, set()).add(source.field)
    return wanted


Sample = tuple[str, int, Any]
"""Name, stamp in ns and content of a message; the content of a PARAMETER is a name and a value."""


def _tables(samples: Iterable[Sample], wanted: Mapping[str, set[str]]) -> tuple[dict[str, Table], Parameters, str]:
    """Tables of messages, parameters, and a note. A field that its first message lacks is absent.

    Where the clock goes back by more than STEP_NS, as of an autopilot that started again, the longest part counts alone. A
    stamp is damaged, and its sample is left out, where fewer than AGREEING samples in a row agree with it. A parameter belongs
    to the part of the next sample: an autopilot that starts writes its parameters first.
    """
    parts = [list[Sample]()]
    newest_ns = 0
    apart: list[Sample] = []  # the samples before, near each other and not near those of the part
    settings = [list[Sample]()]  # by part
    next_settings: list[Sample] = []
    for sample in samples:
        if sample[0] == PARAMETER:
            next_settings.append(sample)
            continue
        if parts[-1] and abs(sample[1] - newest_ns) <= STEP_NS:
            parts[-1].append(sample)
            newest_ns = max(newest_ns, sample[1])
            apart = []
        else:
            apart = [*apart, sample] if apart and -STEP_NS <= sample[1] - apart[-1][1] <= LOST_NS else [sample]
            if len(apart) < AGREEING:
                continue
            if parts[-1] and apart[0][1] < newest_ns:
                parts.append([])
                settings.append([])
            parts[-1] += apart
            newest_ns, apart = max(stamp_ns for _, stamp_ns, _ in apart), []
        settings[-1] += next_settings
        next_settings = []
    settings[-1] += next_settings
    note = f", the longest of {len(parts)} parts: its clock goes back" if len(parts) > 1 else ""
    longest = max(range(len(parts)), key=lambda number: len(parts[number]))
    return _columns(parts[longest] or apart, wanted), _parameters(settings[longest]), note


def _parameters(records: Iterable[Sample]) -> Parameters:
    """The records of each parameter, in their order."""
    parameters: dict[str, list[ParameterRecord]] = {}
    for _, stamp_ns, (name, value) in records:
        parameters.setdefault(name, []).append(ParameterRecord(stamp_ns, value))
    return {name: tuple(values) for name, values in parameters.items()}


def _columns(samples: Iterable[Sample], wanted: Mapping[str, set[str]]) -> dict[str, Table]:
    stamps: dict[str, list[int]] = {}
    columns: dict[str, dict[str, list[float]]] = {}
    for name, stamp_ns, message in samples:
        if name not in columns:
            columns[name] = {field: [] for field in sorted(wanted[name]) if _is_number(getattr(message, field, None))}
        stamps.setdefault(name, []).append(stamp_ns)
        for field, values in columns[name].items():
            values.append(float(getattr(message, field)))
    tables = {}
    for name, lists in columns.items():
        fields = {field: np.array(values) for field, values in lists.items()}
        tables[name] = _table(np.array(stamps[name], dtype=np.int64), fields)
    return tables


def _is_number(value: object) -> bool:
    return isinstance(value, int | float)


def _near(stamp_ns: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Which stamps are near the median of the five around them: a damaged stamp is not."""
    around = np.lib.stride_tricks.sliding_window_view(np.pad(stamp_ns, 2, mode="reflect"), 5) if len(stamp_ns) > 2 else None
    if around is None:
        return np.ones(len(stamp_ns), dtype=bool)
    return np.abs(stamp_ns - np.median(around, axis=1)) <= STEP_NS + 2.0 * np.median(np.abs(np.diff(stamp_ns)))


def _table(stamp_ns: NDArray[np.int64], fields: Mapping[str, FloatArray]) -> Table:
    """A table in the order of its stamps, without samples of a repeated stamp."""
    stamps, places = np.unique(stamp_ns, return_index=True)
    return Table(stamps, {name: values[places] for name, values in fields.items()})


ULOG_VALUES = 65535
"""Values of a message of a ULog at most: its length in bytes is a number of 16 bits."""


def _require_short(formats: Mapping[str, Any]) -> None:
    """Raise ValueError for a format with more values than a message holds: pyulog makes a field of each value."""
    counts: dict[str, int] = {}

    def count(name: str) -> int:
        if name not in counts and name in formats:
            counts[name] = sum(max(size, 1) * count(kind) for kind, size, _ in formats[name].fields)
        return counts.get(name, 1)

    for name in formats:
        if count(name) > ULOG_VALUES:
            raise ValueError(f"a message {name} of {count(name)} values")


LIMITS = (5.0, 6.0)
"""Processor time of the decoding, s, and s a megabyte of the log: pymavlink takes 1.2 s a megabyte of DataFlash here."""

MEMORY = (1 << 30, 100)
"""Data of the decoding, bytes, and bytes a byte of the log: pymavlink takes some 35."""


def read_foreign_log(path: Path) -> VehicleLog:
    """`read_vehicle_log` in an isolated process: a log of a few bytes may claim billions of values. Raises ParameterError."""
    require(path.is_file(), str(path), "no such file", EXPECTED)
    size = path.stat().st_size
    timeout = LIMITS[0] + LIMITS[1] * size / 1e6
    memory = MEMORY[0] + MEMORY[1] * size
    try:
        return isolated.call(_read_absolute, str(path.absolute()), timeout=timeout, memory=memory)
    except isolated.IsolatedCallError as error:
        raise ParameterError(f"{path}: found {file_kind(path)} whose decoding {error}, expected {EXPECTED}") from None


def _read_absolute(path: str) -> VehicleLog:
    return read_vehicle_log(Path(path))
