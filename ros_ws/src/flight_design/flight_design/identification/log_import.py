# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Import y, u and pose from the log of a flight that another program flew.

A channel map says which quantity of the log is which channel.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from autopilot_bridge.channel_map import LinearConversion, to_channel
from autopilot_bridge.map_rows import InputRow
from autopilot_bridge.params import ChannelMap
from flight_core.files import parse_yaml
from flight_core.parameters import ParameterError, require
from flight_core.rates import nanoseconds, seconds
from flight_core.tape import Signal, Tape
from flight_core.vectors import FloatArray
from flight_design.identification.parameter_agreement import (
    SAME_VALUE,
    Agreement,
    Servo,
    Stick,
    absence_sentence,
    change_sentences,
    compared,
    require_agreement,
    servo_of,
    stick_of,
)
from flight_log.bag import IMPORTED
from flight_log.tape_reader import RecordedRun
from flight_log.vehicle_tables import (
    ULOG_SOURCES,
    ULOG_TORQUES,
    VEHICLE_TYPES,
    LogField,
    OtherVehicle,
    VehicleKind,
    VehicleLog,
)

COMMANDS = "commands"  # topic with the commands trim + u, by input
# An aircraft counts as on the ground below this share of its typical airspeed, or, for a
# multicopter, of its typical thrust.
AIRBORNE = 0.5
# percentile of the samples that counts as the typical value. It is high, because a log may contain
# more time on the ground than in the air.
TYPICAL = 90.0
LEAST = 2.0  # s, length of the shortest stretch that is imported
# s. If the speed is too low for at most this time, the aircraft still counts as in the air, because
# no landing is that short.
BRIDGED = 1.0
AROUND = 5  # number of samples in a running median, which is never a damaged value

FLOWN_AS = LogField("vehicle_status", "vehicle_type")

PARAMETERS = "vehicle_parameters.yaml"  # file of the parameters in the folder, and name in the log

Stamps = NDArray[np.int64]


class Window(NamedTuple):
    """The part of a log that is imported, in s.

    Time 0 is the first sample of the output that the map calls `instant`. None means the beginning
    or the end of the flight that is found in the log.
    """

    start: float | None
    stop: float | None


@dataclass(frozen=True, kw_only=True)
class Imported:
    """The tape of a log, and what is known of its autopilot.

    The parameters of the autopilot have their values at the first sample. The notes are sentences
    on what stays unknown.
    """

    tape: Tape
    parameters: Mapping[str, float]
    notes: tuple[str, ...]


def kind_of_map(channel_map: ChannelMap) -> VehicleKind:
    """Return the kind of vehicle: plane for a map with airspeed, multicopter for one with climb."""
    has_airspeed = any(row.motion[0] == "V" for row in channel_map.outputs.values())
    return VehicleKind.PLANE if has_airspeed else VehicleKind.MULTICOPTER


def imported(
    channel_map: ChannelMap,
    log: VehicleLog,
    window: Window,
    show: Callable[[list[Agreement]], None],
    *,
    servos: bool,
) -> Imported:
    """Return y, u, `commands` and the pose of a log, as the bridge would have published them.

    The map's `instant` names an output. y has the newest value of each output at the stamps of the
    output `instant`. The pose has the newest values at the stamps of its first channel. u is the
    command minus its median. The command is

    - with PX4: the setpoint that the map names;
    - with ArduCopter: the output of the rate controllers;
    - with ArduPlane: the stick in MANUAL, or with `servos` the position of the servo, scaled like
      the stick.

    Without a window the longest stretch in the air is taken. If the command is the stick, this
    stretch must be in MANUAL. `show` gets the comparison of the log with the map before a mismatch
    is refused.

    Raises ParameterError if the log lacks a channel, is of another vehicle, or has no such stretch.
    It is also raised if the parameters differ from the map or change between the samples. If the
    log has lost data, the message of the error says so at its end.
    """
    start_ns = log.start_ns(channel_map.outputs[channel_map.instant].motion[0])
    losses = [] if log.loss is None else [log.loss.sentence(start_ns)]
    try:
        flight = _imported(channel_map, log, window, show, servos=servos)
    except ParameterError as error:
        raise ParameterError("; ".join([str(error), *losses])) from None
    gaps = [gap_sentence(name, flight.tape[name].stamp_ns, start_ns) for name in ("y", "u")]
    return replace(flight, notes=(*losses, *filter(None, gaps), *flight.notes))


def _imported(
    channel_map: ChannelMap,
    log: VehicleLog,
    window: Window,
    show: Callable[[list[Agreement]], None],
    *,
    servos: bool,
) -> Imported:
    kind = kind_of_map(channel_map)
    logged_kind = log.vehicle
    _require_kind(logged_kind or kind, channel_map)
    log = log._replace(vehicle=kind)
    rows = channel_map.outputs
    sources = {name: _measured(log, row.motion[0], f"outputs.{name}") for name, row in rows.items()}
    stamps = log.tables[sources[channel_map.instant].message].stamp_ns
    speed = _speed(channel_map, log, sources, stamps, servos)
    has_sticks = log.format is not None and kind is VehicleKind.PLANE
    needs_manual = has_sticks and not servos
    taken, others = _flight(log, kind, stamps, speed, window, needs_manual=needs_manual)
    first, last = taken
    parameters = log.parameters_at(first)
    notes = [others, *change_sentences(log.parameters, int(stamps[0]), first, last)]
    if speed is not None and (is_lost := ~np.isfinite(speed) & (stamps >= first)).any():
        instant = seconds(int(stamps[is_lost.argmax()] - stamps[0]))
        notes.append(
            f"no airspeed or thrust at {is_lost.sum()} of {len(stamps)} samples, from "
            f"{instant:.1f} s of the log on"
        )
    sticks = [stick_of(channel_map, name) for name in channel_map.inputs if has_sticks]
    rows_compared = compared(sticks, log.parameters, parameters)
    show(
        [
            Agreement("vehicle", "" if logged_kind is None else str(logged_kind), kind),
            *(Agreement(taken.what, taken.sentence(), "") for taken in log.taken),
            *rows_compared,
        ]
    )
    try:
        readers = {
            name: _commands(channel_map, log, name, servos, parameters)
            for name in channel_map.inputs
        }
        require_agreement(channel_map.name, rows_compared)
    except ParameterError as error:
        raise ParameterError("; ".join([str(error), *filter(None, notes)])) from None
    notes.append(absence_sentence(rows_compared))
    tape = _tape(channel_map, log, sources, readers, taken)
    return Imported(tape=tape, parameters=parameters, notes=tuple(filter(None, notes)))


def _require_kind(vehicle: VehicleKind | OtherVehicle, channel_map: ChannelMap) -> None:
    """Raise ParameterError if the log is of another kind of vehicle than the map."""
    vehicle_found = f"one of a {vehicle}"
    flown = {VehicleKind.PLANE, VehicleKind.MULTICOPTER}
    require(vehicle in flown, "the log", vehicle_found, "one of a plane or a multicopter")
    kind = kind_of_map(channel_map)
    expected = f"one of a {kind}, as the map {channel_map.name} is for"
    require(vehicle is kind, "the log", vehicle_found, expected)


def _speed(
    channel_map: ChannelMap,
    log: VehicleLog,
    sources: Mapping[str, LogField],
    stamps: Stamps,
    servos: bool,
) -> FloatArray | None:
    """Return a signal that shows when the aircraft flies: the airspeed, or a multicopter's thrust.

    Returns None if the map has neither of them.
    """
    for name, row in channel_map.outputs.items():
        if row.motion[0] == "V":
            return log.at(sources[name], stamps)
    for name, lift in channel_map.inputs.items():
        if lift.motion[0] == "climb":
            return lift.motion[1] * _commands(channel_map, log, name, servos, {}).commands_at(
                stamps
            )
    return None


def _tape(
    channel_map: ChannelMap,
    log: VehicleLog,
    sources: Mapping[str, LogField],
    readers: Mapping[str, "_Reader"],
    ends: tuple[int, int],
) -> Tape:
    """Return the signals that a channel map finds in a log between two instants."""
    first, last = ends
    rows = channel_map.outputs
    stamps = log.tables[sources[channel_map.instant].message].stamp_ns
    y_stamps = stamps[(stamps >= first) & (stamps <= last)]
    y = np.column_stack(
        [row.motion[1] * log.at(sources[name], y_stamps) for name, row in rows.items()]
    )
    is_damaged = log.loss is not None
    y_stamps, y = _complete(y_stamps, y, is_damaged)
    require(len(y_stamps) > 1, "the log", "no instant with all outputs of the map", "a flight")
    for column, row in enumerate(rows.values()):
        y[:, column] += -np.median(y[:, column]) if row.captured else row.offset
    u_stamps = np.unique(np.concatenate([reader.stamp_ns for reader in readers.values()]))
    u_stamps = u_stamps[(u_stamps >= first) & (u_stamps <= last)]
    u_stamps, commands = _complete(
        u_stamps,
        np.column_stack([reader.commands_at(u_stamps) for reader in readers.values()]),
        is_damaged,
    )
    require(len(u_stamps) > 1, "the log", "no instant with all inputs of the map", "a flight")
    signals = {
        "y": Signal(y_stamps, tuple(rows), y),
        "u": Signal(u_stamps, tuple(readers), commands - np.median(commands, axis=0)),
        COMMANDS: Signal(u_stamps, tuple(readers), commands),
    }
    if (pose := _pose(channel_map, log, first, last)) is not None:
        signals["pose"] = pose
    return Tape(signals, int(y_stamps[0]))


def median_trims(commands: Signal) -> dict[str, float]:
    """Return the command of each input in trim, SI: its median over an imported flight."""
    return {name: float(np.median(commands[name])) for name in commands.names}


def _measured(log: VehicleLog, quantity: str, key: str) -> LogField:
    source = log.source(quantity)
    if source is None:
        mask = log.parameters.get("LOG_BITMASK")
        logged = "" if mask is None else f": LOG_BITMASK is {mask[0].value:.0f}"
        raise ParameterError(
            f"{key}: found no {quantity} in the log, expected {_messages(log, quantity)}{logged}"
        )
    return source


def _messages(log: VehicleLog, quantity: str) -> str:
    """Name the messages in this format of log that can have a quantity, for an error sentence."""
    sources = ULOG_SOURCES if log.format is None else log.format.sources
    return (
        " or ".join(dict.fromkeys(source.message for source in sources.get(quantity, ())))
        or "one that the format has"
    )


class _Reader(NamedTuple):
    """Reads the command of an input from a log, and converts it to SI by `conversion`.

    For a plane of ArduPilot, the command is first computed from the pulse of the stick or of the
    servo.
    """

    log: VehicleLog
    source: LogField
    conversion: LinearConversion
    stick: Stick | None = None
    servo: Servo | None = None

    @property
    def stamp_ns(self) -> Stamps:
        return self.log.tables[self.source.message].stamp_ns

    def commands_at(self, stamp_ns: Stamps) -> FloatArray:
        values = self.log.at(self.source, stamp_ns)
        if self.stick is not None and self.servo is not None:
            values = self.stick.raw(self.servo.deflection(values, self.stick))
        before = (
            self.stick.trim_conversion
            if self.stick is not None and self.servo is None
            else SAME_VALUE
        )
        return np.array(
            [to_channel(to_channel(value, before), self.conversion) for value in values.tolist()]
        )


def _commands(
    channel_map: ChannelMap,
    log: VehicleLog,
    name: str,
    servos: bool,
    parameters: Mapping[str, float],
) -> _Reader:
    row = channel_map.inputs[name]
    if log.format is None:
        topic = channel_map.messages[row.message].topic.rpartition("/")[2]
        source = LogField(topic, row.field)
        before_1_14 = ULOG_TORQUES.get((topic, row.field), source)
        source = source if log.has_field(source) or not log.has_field(before_1_14) else before_1_14
        require(
            log.has_field(source),
            f"inputs.{name}",
            f"no {topic}.{row.field} in the log",
            "this field: a map of the autopilot that wrote the log",
        )
        require(
            not servos,
            "servos as commands",
            "a ULog",
            "a log of ArduPilot: in a ULog the setpoints of torque and thrust are the commands",
        )
        return _Reader(log, source, row.conversion)
    if log.vehicle is VehicleKind.MULTICOPTER:
        return _torque(log, name, row, servos)
    stick = stick_of(channel_map, name)
    servo = servo_of(stick, name, parameters) if servos else None
    place, number = (
        (log.format.sticks, stick.channel) if servo is None else (log.format.servos, servo.output)
    )
    source = LogField(place.message, place.field.format(number))
    if servo is None:
        expected = (
            "the transmitter's channel (bit RC of LOG_BITMASK, messages of the tlog), or --servos"
        )
    else:
        expected = "its pulses"
    require(
        log.has_field(source),
        f"inputs.{name}",
        f"no {source.message}.{source.field} in the log",
        expected,
    )
    return _Reader(log=log, source=source, conversion=row.conversion, stick=stick, servo=servo)


def _torque(log: VehicleLog, name: str, row: InputRow, servos: bool) -> _Reader:
    """Return the reader of a multicopter's torque, the normalised output of its rate controller.

    The sticks of a multicopter do not command its inputs in any mode. Raises ParameterError if the
    log does not have the torque, or if `servos` asks for the position of the servos.
    """
    quantity, sign = row.motion
    sources = log.format.torques.get(quantity, ()) if log.format else ()
    source = next(filter(log.has_field, sources), None)
    if source is None:
        expected = "a DataFlash log with RATE: sticks of a multicopter command angles or rates"
        raise ParameterError(
            f"inputs.{name}: found a multicopter's log without RATE of {quantity}, expected "
            f"{expected}"
        )
    require(
        not servos,
        "servos as commands",
        "a multicopter",
        "a plane: of a multicopter the outputs of the rate controllers are the commands",
    )
    return _Reader(log, source, LinearConversion(1 if sign > 0 else -1, row.scale, 0.0))


def _flight(
    log: VehicleLog,
    kind: VehicleKind,
    stamps: Stamps,
    speed: FloatArray | None,
    window: Window,
    *,
    needs_manual: bool,
) -> tuple[tuple[int, int], str | None]:
    """Return the first and the last instant to import, and a sentence on other flights.

    The longest stretch in the window is imported, or without a window the longest stretch in the
    air. If `needs_manual`, stretches outside the mode MANUAL are ignored.
    """
    start_ns = int(stamps[0])
    keep = np.ones(len(stamps), dtype=bool)
    if window.start is not None:
        keep &= stamps >= start_ns + nanoseconds(window.start)
    if window.stop is not None:
        keep &= stamps <= start_ns + nanoseconds(window.stop)
    where = "in the window" if window != (None, None) else "in the log"
    require(
        int(keep.sum()) > 1,
        "--from, --until",
        "no sample",
        f"a part of the {1e-9 * (stamps[-1] - start_ns):.0f} s of the log",
    )
    # Without a window, the flight is the time in which the speed is high enough to fly.
    if speed is not None and window.start is None and window.stop is None:
        require(
            bool(np.isfinite(speed).any()),
            "the log",
            "no airspeed or thrust at the samples of y",
            "one of them, as in a flight",
        )
        in_air = speed > AIRBORNE * np.nanpercentile(speed, TYPICAL)
        keep &= _is_bridged(stamps, in_air)
    if log.has_field(FLOWN_AS):  # A VTOL flies as a plane and as a multicopter.
        keep &= log.at(FLOWN_AS, stamps) == VEHICLE_TYPES[kind]
    require(
        bool(keep.any()),
        "the log",
        f"no time in the air {where}",
        "a flight, or --from and --until",
    )
    # The sticks are the commands only in MANUAL.
    if needs_manual:
        expected = "it, for only there the sticks are the commands, or --servos"
        modes = () if log.format is None else log.format.mode
        mode = next(filter(log.has_field, modes), None)
        if mode is None:
            raise ParameterError(
                f"the log: found no message with the mode, expected MANUAL in {expected}"
            )
        keep &= log.at(mode, stamps) == log.manual
        require(bool(keep.any()), "the log", f"no flight in MANUAL {where}", expected)
    runs = _runs(stamps, keep)
    taken = max(runs, key=_length)
    require(
        _length(taken) >= LEAST,
        "the log",
        f"{_length(taken):.1f} s of flight {where}",
        f"{LEAST:g} s or more in one stretch",
    )
    return taken, _other_flights(runs, taken, start_ns)


def _is_bridged(stamps: Stamps, keep: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Close the gaps of at most BRIDGED between two kept samples in a mask (N,)."""
    before = np.maximum.accumulate(np.where(keep, stamps, np.iinfo(np.int64).min // 2))
    after = np.minimum.accumulate(np.where(keep, stamps, np.iinfo(np.int64).max // 2)[::-1])[::-1]
    return keep | (after - before <= nanoseconds(BRIDGED))


def _runs(stamps: Stamps, keep: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """Return the first and the last instant of each stretch that a mask (N,) keeps."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], keep, [False]]).astype(np.int8)))
    return [
        (int(stamps[first]), int(stamps[end - 1]))
        for first, end in zip(edges[::2], edges[1::2], strict=True)
    ]


def _length(run: tuple[int, int]) -> float:
    """Return the length of a stretch, s."""
    return seconds(run[1] - run[0])


def _other_flights(
    runs: Sequence[tuple[int, int]], taken: tuple[int, int], start_ns: int
) -> str | None:
    """Return a sentence on the flights of a log that are not imported.

    Returns None if there are none.
    """
    others = [
        f"{seconds(first - start_ns):.1f} to {seconds(last - start_ns):.1f} s"
        for first, last in runs
        if (first, last) != taken and _length((first, last)) >= LEAST
    ]
    if not others:
        return None
    window = "take another by --from and --until"
    return f"the log has {len(others) + 1} flights, {window}: {', '.join(others)}"


def _complete(stamp_ns: Stamps, values: FloatArray, is_damaged: bool) -> tuple[Stamps, FloatArray]:
    """Return the samples in which every channel has a value.

    Bytes that are lost within a message leave wrong values. In a damaged log, the running medians
    over AROUND samples span a range, from the lowest to the highest median. A value is taken as
    wrong if it lies farther outside this range than the range is wide.
    """
    is_known = np.isfinite(values).all(axis=1)
    stamp_ns, values = stamp_ns[is_known], values[is_known]
    if not is_damaged or len(values) < AROUND:
        return stamp_ns, values
    medians = np.median(sliding_window_view(values, AROUND, axis=0), axis=-1)
    lowest, highest = medians.min(axis=0), medians.max(axis=0)
    middle, reach = (highest + lowest) / 2.0, 1.5 * (highest - lowest)
    is_near = (np.abs(values - middle) <= reach).all(axis=1)
    return stamp_ns[is_near], values[is_near]


def gap_sentence(name: str, stamp_ns: Stamps, start_ns: int) -> str | None:
    """Say how many samples a topic lacks, judged by its usual period.

    Returns None if it lacks none.
    """
    gaps = np.diff(stamp_ns)
    period = float(np.median(gaps))
    expected = _expected(stamp_ns)
    if expected <= len(stamp_ns) or gaps.max() < 1.5 * period:
        return None
    instant = seconds(int(stamp_ns[gaps.argmax()]) - start_ns)
    return (
        f"{name} lacks {expected - len(stamp_ns)} of {expected} samples: the longest gap, "
        f"{seconds(int(gaps.max())):.2g} s, begins at {instant:.1f} s of the log"
    )


def lost_share(stamp_ns: Stamps) -> float:
    """Return the fraction of the samples that a topic lacks, judged by its usual period."""
    return max(1.0 - len(stamp_ns) / _expected(stamp_ns), 0.0)


def _expected(stamp_ns: Stamps) -> int:
    """Return how many samples a topic without gaps would have."""
    return round(float(stamp_ns[-1] - stamp_ns[0]) / float(np.median(np.diff(stamp_ns)))) + 1


def _pose(channel_map: ChannelMap, log: VehicleLog, first: int, last: int) -> Signal | None:
    """Return the channels of the pose that a log has, NaN until the first value of each."""
    sources = {
        name: source for name in channel_map.pose if (source := log.source(name)) is not None
    }
    if not sources:
        return None
    stamps = log.tables[next(iter(sources.values())).message].stamp_ns
    stamps = stamps[(stamps >= first) & (stamps <= last)]
    values = [log.at(source, stamps) for source in sources.values()]
    return Signal(stamps, tuple(sources), np.column_stack(values)) if len(stamps) else None


def require_map_of_import(channel_map: ChannelMap, recorded: RecordedRun) -> None:
    """Check that a channel map still has the rows with which the u of a log was imported.

    Raises ParameterError if the log was imported with other rows.
    """
    source = recorded.metadata.get(IMPORTED)
    if source is None:
        return
    key = str(recorded.path or "the log")
    again = f"as in the map {channel_map.name}: import the log again, with --map"
    maps = [stored.content for stored in recorded.attachments if stored.name != PARAMETERS]
    require(len(maps) == 1, key, f"{len(maps)} maps in the log", "only the map of the import")
    content = parse_yaml(maps[0], key, "a channel map")
    before = _rows_of_import(ChannelMap.validate_mapping(content, key))
    for name, value in _rows_of_import(channel_map).items():
        require(
            before.get(name) == value,
            key,
            f"{name} {before.get(name)} in the map of the import",
            f"{value}, {again}",
        )


def _rows_of_import(channel_map: ChannelMap) -> dict[str, object]:
    """Return the rows of a channel map that an import uses, by key."""
    keys = {
        "outputs": {"positive", "sign"},
        "inputs": {"field", "positive", "sign", "scale", "offset", "range"},
        "trims": {"field", "sign", "scale", "offset"},
    }
    values: dict[str, object] = {}
    for kind, fields in keys.items():
        for name, row in getattr(channel_map, kind).items():
            values |= {f"{kind}.{name}.{key}": getattr(row, key) for key in sorted(fields)}
    return values
