# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Define tables of the messages in autopilots' logs, and where each format has a quantity.

Sources: ArduPilot, libraries/AP_Logger/LogStructure.h and ArduPlane/Log.cpp; MAVLink, common.xml;
PX4 guide, ULog file format, and PX4's msg/*.msg.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from enum import StrEnum
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
import yaml
from numpy.typing import NDArray

from flight_core.rates import seconds
from flight_core.vectors import FloatArray

DEGREE = math.pi / 180.0
STICKS = 16  # number of channels of the transmitter that are read
SERVOS = 16  # number of servos that are read


class MessageTable(NamedTuple):
    """The samples of a message.

    The stamps, ns, have shape (N,) and ascend. Each field has shape (N,); the fields are stored by
    name.
    """

    stamp_ns: NDArray[np.int64]
    fields: Mapping[str, FloatArray]

    def at(self, field: str, stamp_ns: NDArray[np.int64]) -> FloatArray:
        """Return the newest value of a field at some instants, (n,); NaN before the first."""
        places = np.searchsorted(self.stamp_ns, stamp_ns, side="right") - 1
        return np.where(places < 0, np.nan, self.fields[field][places])


class ParameterRecord(NamedTuple):
    """A value of a parameter of the autopilot, and when it was recorded, ns."""

    stamp_ns: int
    value: float


Parameters = Mapping[str, tuple[ParameterRecord, ...]]
"""The records of the parameters by name, in the order of the log."""

# A message name of DataFlash. The samples of every format have their parameters under this name.
PARAMETER = "PARM"


class LogField(NamedTuple):
    """Where a log has a quantity: a field of a message, and the factor that converts it."""

    message: str
    field: str
    scale: float = 1.0


Sources = Mapping[str, tuple[LogField, ...]]
"""For each quantity the places that may have it, the first one first."""


class Format(NamedTuple):
    """A format of logs, with the place of each quantity.

    The quantities are y and pose in SI (body FRD; north, east, up), the channels of the
    transmitter, and the servos.
    """

    sources: Sources
    sticks: LogField  # its field has {} in place of the number of the channel
    servos: LogField
    mode: tuple[LogField, ...]
    # Normalised outputs of a multicopter's rate controllers, by the output that responds.
    torques: Sources = MappingProxyType({})


def _source(place: str) -> LogField:
    message, field, *factors = place.split()
    return LogField(message, field, *(DEGREE if text == "deg" else float(text) for text in factors))


def _sources(places: Mapping[str, Sequence[str]]) -> Sources:
    return {name: tuple(map(_source, texts)) for name, texts in places.items()}


def _format(rows: Mapping[str, Any]) -> Format:
    return Format(
        sources=_sources(rows["sources"]),
        sticks=_source(rows["sticks"]),
        servos=_source(rows["servos"]),
        mode=tuple(map(_source, rows["mode"])),
        torques=_sources(rows.get("torques", {})),
    )


_PLACES = yaml.safe_load(Path(__file__).with_name("vehicle_logs.yaml").read_text(encoding="utf-8"))
DATAFLASH = _format(_PLACES["dataflash"])
TLOG = _format(_PLACES["tlog"])
ULOG_SOURCES = _sources(_PLACES["ulog"]["sources"])

ULOG_TORQUES: Mapping[tuple[str, str], LogField] = MappingProxyType(
    {
        ("vehicle_torque_setpoint", f"xyz[{axis}]"): LogField(
            "actuator_controls_0", f"control[{axis}]"
        )
        for axis in range(3)
    }
    | {("vehicle_thrust_setpoint", "xyz[0]"): LogField("actuator_controls_0", "control[3]")}
    | {("vehicle_thrust_setpoint", "xyz[2]"): LogField("actuator_controls_0", "control[3]", -1.0)}
)
"""Where PX4 before 1.14 has the setpoints of torque and thrust (actuator_controls.msg: roll, pitch,
yaw, thrust)."""


class VehicleKind(StrEnum):
    """A kind of vehicle that an autopilot flies or drives."""

    PLANE = "plane"
    MULTICOPTER = "multicopter"
    ROVER = "rover"
    SUBMARINE = "submarine"


VEHICLE_TYPES: Mapping[VehicleKind, int] = MappingProxyType(
    {VehicleKind.MULTICOPTER: 1, VehicleKind.PLANE: 2, VehicleKind.ROVER: 3}
)
"""Values of vehicle_type of vehicle_status (PX4, VehicleStatus.msg), 0 if unknown. A VTOL has that
of the kind as which it flies."""


class OtherVehicle(NamedTuple):
    """A vehicle of no known kind, by its number in a field of the log."""

    field: str
    number: int

    def __str__(self) -> str:
        """Name the vehicle by its number, as in "vehicle of MAV_TYPE 7"."""
        return f"vehicle of {self.field} {self.number}"


class Choice(NamedTuple):
    """What the user chooses of a log: a system, sensors, and the kind of vehicle.

    The kind of vehicle comes from the channel map.
    """

    system: int | None = None  # number of the system in a tlog; None for the system that flew
    # Number of the chosen instance, such as a sensor, by message. For any other message, the
    # instance by which the autopilot flew is found.
    instances: Mapping[str, int] = MappingProxyType({})
    vehicle: VehicleKind = VehicleKind.PLANE


ANY = Choice()


class Reason(StrEnum):
    """Why a system, a sensor or an instance of a log was taken."""

    BY_SYSTEM = "by --system"
    BY_INSTANCE = "by --instance"
    SYSTEM_MOVES = "it alone moves"
    FIRST = "the first"
    SURFACES = "the surfaces of a VTOL"
    ROTORS = "the rotors of a VTOL"
    AGREES = "the first of those that agree"
    MOVES = "it alone is used and moves"
    PRIMARY = "the primary"
    USED = "healthy and used"
    ESTIMATE = "V is the estimate in CTUN"


class UnusedSensor(NamedTuple):
    """An airspeed sensor by which the autopilot did not fly."""

    number: int
    is_used: bool  # whether the autopilot would use it, but it is not healthy
    setting: str  # name of the parameter ARSPD..._USE
    value: float | None  # value of the parameter; None if the log lacks it

    def sentence(self) -> str:
        """Say why the sensor was not taken, as in "0 is not used, ARSPD_USE 0"."""
        value = "" if self.value is None else f", {self.setting} {self.value:g}"
        return f"{self.number} is not {'healthy' if self.is_used else 'used'}{value}"


class Taken(NamedTuple):
    """What was taken among several systems, sensors or instances of a log, and why."""

    what: str  # name of the message, or "system"
    numbers: tuple[int, ...]  # those that were taken; none if an estimate replaces the sensors
    among: tuple[int, ...]  # the instances in the log
    reason: Reason
    unused: tuple[UnusedSensor, ...] = ()  # the sensors that an estimate replaces

    def sentence(self) -> str:
        """Say what was taken and why, as in "1 of 0 and 1: the primary"."""
        if self.reason is Reason.ESTIMATE:
            taken = "; ".join(sensor.sentence() for sensor in self.unused)
        else:
            taken = f"{enumeration(self.numbers)} of {enumeration(self.among)}"
        return f"{taken}: {self.reason}"


def enumeration(numbers: Iterable[int]) -> str:
    """Write numbers as in "0 and 1"."""
    return " and ".join(map(str, numbers))


class Loss(NamedTuple):
    """What a log has lost, and the last stamps before the first and before the last loss, ns."""

    what: str
    first_ns: int
    last_ns: int

    def sentence(self, start_ns: int) -> str:
        """Write the loss with its times since the beginning of the log."""
        first, last = (
            max(seconds(stamp_ns - start_ns), 0.0) for stamp_ns in (self.first_ns, self.last_ns)
        )
        span = f"at {first:.1f} s" if first == last else f"from {first:.1f} to {last:.1f} s"
        return f"the log is incomplete: {self.what}, {span} of the log"


class VehicleLog(NamedTuple):
    """A log of an autopilot.

    `format` is None for a ULog, whose messages have the names of PX4's topics.
    """

    kind: str
    tables: Mapping[str, MessageTable]
    parameters: Parameters
    format: Format | None
    # None if the log does not say what flew
    vehicle: VehicleKind | OtherVehicle | None = VehicleKind.PLANE
    # Number of the mode in which the sticks of a plane are the commands; ArduPlane's is 0 (mode.h).
    manual: int = 0
    taken: tuple[Taken, ...] = ()
    loss: Loss | None = None

    def source(self, quantity: str) -> LogField | None:
        """Return the place of a quantity of y or of the pose, or None if the log lacks it."""
        sources = ULOG_SOURCES if self.format is None else self.format.sources
        return next(
            (source for source in sources.get(quantity, ()) if self.has_field(source)), None
        )

    def start_ns(self, quantity: str) -> int:
        """Return the first stamp of a quantity, which the log must have."""
        source = self.source(quantity)
        return 0 if source is None else int(self.tables[source.message].stamp_ns[0])

    def parameters_at(self, stamp_ns: int) -> dict[str, float]:
        """Return the values of the parameters at an instant.

        A parameter whose first record comes later is left out.
        """
        values: dict[str, float] = {}
        for name, records in self.parameters.items():
            earlier = [record.value for record in records if record.stamp_ns <= stamp_ns]
            if earlier:
                values[name] = earlier[-1]
        return values

    def has_field(self, source: LogField) -> bool:
        """Return whether the log has samples of a field."""
        return source.message in self.tables and source.field in self.tables[source.message].fields

    def at(self, source: LogField, stamp_ns: NDArray[np.int64]) -> FloatArray:
        """Return the newest value of a field at some instants, (n,); NaN before the first."""
        return source.scale * self.tables[source.message].at(source.field, stamp_ns)
