# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""y, u and pose of a channel map, from the log of an autopilot that the stack did not fly."""

import re
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from autopilot_bridge.channel_map import Line, to_channel
from autopilot_bridge.params import ChannelMap, InputRow
from flight_core.parameters import ParameterError, require
from flight_core.rates import nanoseconds
from flight_core.tape import Signal, Tape
from flight_core.vectors import FloatArray
from flight_log.vehicle_log import COPTER, PLANE, SERVOS, ULOG_TORQUES, Source, VehicleLog

COMMANDS = "commands"  # the topic with trim + u, by input
AIRBORNE = 0.5  # of the typical airspeed, of a multicopter the typical thrust: below, the aircraft is on the ground
TYPICAL = 90.0  # percentile of either in a log, which may have more time on the ground than in the air
CHANNEL = re.compile(r"channels\[(\d+)\]|chan(\d+)_raw")  # of a transmitter: Rc.msg from 0, MAVLink from 1
FUNCTIONS = {"ROLL": 4, "PITCH": 19, "THROTTLE": 70, "YAW": 21}  # SERVOn_FUNCTION by RCMAP: aileron, elevator, throttle, rudder
LEAST = 2.0  # s of flight that are worth a bag
PWM = {"MIN": 1100.0, "MAX": 1900.0, "REVERSED": 0.0}  # us, defaults of ArduPilot's RCn_ and SERVOn_

Stamps = NDArray[np.int64]


class Window(NamedTuple):
    """What is taken of a log, s since its first sample of the output `instant`; None: the flight that is found."""

    start: float | None
    stop: float | None


def imported(channel_map: ChannelMap, log: VehicleLog, window: Window, *, servos: bool) -> Tape:
    """y, u, `commands` and the pose of a log, as the bridge would have published them.

    y and the pose hold the newest values at the stamps of the map's `instant` and of the first channel of the pose. u is the
    command less its median: the setpoint of the map (PX4) or of the rate controllers (ArduCopter), else the stick in MANUAL, or
    with `servos` the servo's position, scaled as the stick. Without a window the longest stretch in the air is taken, for
    sticks in MANUAL. Raises ParameterError for a channel that the log does not have, for another vehicle, and without such a
    stretch.
    """
    require(log.vehicle in {PLANE, COPTER}, "the log", f"one of a {log.vehicle}", "one of a plane or a multicopter")
    rows = channel_map.outputs
    sources = {name: _measured(log, row.motion[0], f"outputs.{name}") for name, row in rows.items()}
    stamps = log.tables[sources[channel_map.instant].message].stamp_ns
    readers = {name: _commands(channel_map, log, name, servos) for name in channel_map.inputs}
    speed = next((log.at(sources[name], stamps) for name, row in rows.items() if row.motion[0] == "V"), None)
    if speed is None:  # a multicopter: its thrust
        lifts = {name: row.motion[1] for name, row in channel_map.inputs.items() if row.motion[0] == "climb"}
        speed = next((sign * readers[name].at(stamps) for name, sign in lifts.items()), None)
    needs_manual = log.format is not None and not servos and log.vehicle == PLANE
    first, last = _flight(log, stamps, speed, window, needs_manual=needs_manual)
    y_stamps = stamps[(stamps >= first) & (stamps <= last)]
    y = np.column_stack([row.motion[1] * log.at(sources[name], y_stamps) for name, row in rows.items()])
    y_stamps, y = _complete(y_stamps, y)
    require(len(y_stamps) > 1, "the log", "no instant with all outputs of the map", "a flight")
    for column, row in enumerate(rows.values()):
        y[:, column] += -np.median(y[:, column]) if row.captured else row.offset
    u_stamps = np.unique(np.concatenate([reader.stamp_ns for reader in readers.values()]))
    u_stamps = u_stamps[(u_stamps >= first) & (u_stamps <= last)]
    u_stamps, commands = _complete(u_stamps, np.column_stack([reader.at(u_stamps) for reader in readers.values()]))
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
    """The commands in trim by input: the medians of an imported flight, SI."""
    return {name: float(np.median(commands[name])) for name in commands.names}


def _measured(log: VehicleLog, quantity: str, key: str) -> Source:
    source = log.source(quantity)
    if source is None:
        raise ParameterError(f"{key}: found no {quantity} in the log, expected {_messages(log, quantity)}")
    return source


def _messages(log: VehicleLog, quantity: str) -> str:
    """The messages of a log's format that have a quantity, as a sentence."""
    from flight_log.vehicle_log import ULOG_SOURCES  # noqa: PLC0415 - of this sentence alone

    sources = ULOG_SOURCES if log.format is None else log.format.sources
    return " or ".join(dict.fromkeys(at.message for at in sources.get(quantity, ()))) or "one that the format has"


class _Reader(NamedTuple):
    """The command of an input: SI = line(before(scale field))."""

    log: VehicleLog
    source: Source
    before: Line  # from the log's value to that of the field of the map
    line: Line

    @property
    def stamp_ns(self) -> Stamps:
        return self.log.tables[self.source.message].stamp_ns

    def at(self, stamp_ns: Stamps) -> FloatArray:
        raw = self.log.at(self.source, stamp_ns)
        return np.array([to_channel(to_channel(value, self.before), self.line) for value in raw.tolist()])


def _commands(channel_map: ChannelMap, log: VehicleLog, name: str, servos: bool) -> _Reader:
    row = channel_map.inputs[name]
    same = Line(1, 1.0, 0.0)
    if log.format is None:
        topic = channel_map.messages[row.message].topic.rpartition("/")[2]
        source = Source(topic, row.field)
        before_1_14 = ULOG_TORQUES.get((topic, row.field), source)
        source = source if log.has(source) or not log.has(before_1_14) else before_1_14
        require(log.has(source), f"inputs.{name}", f"no {topic}.{row.field} in the log", "it: the map and the log fit together")
        require(not servos, "--servos", "a ULog", "none: its setpoints of torque and thrust are the commands")
        return _Reader(log, source, same, row.line)
    if log.vehicle == COPTER:
        return _torque(log, name, row, servos)
    trim = channel_map.trims.get(name)
    match = CHANNEL.fullmatch(row.field if trim is None else trim.field)
    if match is None:
        raise ParameterError(
            f"trims.{name}: found none with a channel of the transmitter, expected a field such as channels[1]"
        )
    number = int(match[1]) + 1 if match[1] else int(match[2])
    before = same if trim is None else trim.line
    if servos:
        source, scaled = _servo(log, number, name)
        # sign scale (us of the servo) + offset are us of the stick
        before = Line(before.sign * scaled.sign, before.scale * scaled.scale, to_channel(scaled.offset, before))
        return _Reader(log, source, before, row.line)
    source = Source(log.format.sticks.message, log.format.sticks.field.format(number))
    expected = "the transmitter's channel (bit RC of LOG_BITMASK, messages of the tlog), or --servos"
    require(log.has(source), f"inputs.{name}", f"no {source.message}.{source.field} in the log", expected)
    return _Reader(log, source, before, row.line)


def _torque(log: VehicleLog, name: str, row: InputRow, servos: bool) -> _Reader:
    """The output of a multicopter's rate controller: no mode has sticks that are commands. It is normalised as PX4's."""
    quantity, sign = row.motion
    source = next((at for at in log.format.torques.get(quantity, ()) if log.has(at)), None) if log.format else None
    if source is None:
        expected = "a DataFlash log with RATE: sticks of a multicopter command angles or rates"
        raise ParameterError(f"inputs.{name}: found a multicopter's log without RATE of {quantity}, expected {expected}")
    require(not servos, "--servos", "a multicopter", "none: the outputs of its rate controllers are the commands")
    return _Reader(log, source, Line(1, 1.0, 0.0), Line(1 if sign > 0 else -1, row.scale, 0.0))


def _servo(log: VehicleLog, number: int, name: str) -> tuple[Source, Line]:
    """The servo that a channel of the transmitter moves, and the stick's pulse by the servo's: both from end to end."""
    parameters = log.parameters
    by_number = {round(parameters.get(f"RCMAP_{key}", default)): key for default, key in enumerate(FUNCTIONS, start=1)}
    require(number in by_number, f"inputs.{name}", f"channel {number}", "one of RCMAP_ROLL, PITCH, THROTTLE and YAW")
    function = FUNCTIONS[by_number[number]]
    servos = [n for n in range(1, SERVOS + 1) if parameters.get(f"SERVO{n}_FUNCTION") == function]
    if log.format is None or not servos:
        raise ParameterError(
            f"inputs.{name}: found no servo with SERVOn_FUNCTION {function} in the log, expected one, or the sticks in MANUAL"
        )
    source = Source(log.format.servos.message, log.format.servos.field.format(servos[0]))
    require(log.has(source), f"inputs.{name}", f"no {source.message}.{source.field} in the log", "the servo's pulses")
    ends = {
        at: [parameters.get(f"{at}_{key}", PWM[key]) for key in ("MIN", "MAX")] for at in (f"SERVO{servos[0]}", f"RC{number}")
    }
    (low, high), (stick_low, stick_high) = ends.values()
    require(low < high, f"SERVO{servos[0]}_MIN", low, f"less than its MAX, {high:g}")
    reversed_ = [parameters.get(f"{at}_REVERSED", 0.0) == 1.0 for at in ends]
    sign = -1 if reversed_[0] != reversed_[1] else 1
    scale = (stick_high - stick_low) / (high - low)
    return source, Line(sign, scale, (stick_high + stick_low) / 2 - sign * scale * (high + low) / 2)


def _flight(
    log: VehicleLog, stamps: Stamps, speed: FloatArray | None, window: Window, *, needs_manual: bool
) -> tuple[int, int]:
    """First and last instant that are taken: the window, or the longest stretch in the air, for sticks in MANUAL."""
    start_ns = int(stamps[0])
    keep = np.ones(len(stamps), dtype=bool)
    if window.start is not None:
        keep &= stamps >= start_ns + nanoseconds(window.start)
    if window.stop is not None:
        keep &= stamps <= start_ns + nanoseconds(window.stop)
    where = "in the window" if window != (None, None) else "in the log"
    require(
        int(keep.sum()) > 1, "--from, --until", "no sample", f"a part of the {1e-9 * (stamps[-1] - start_ns):.0f} s of the log"
    )
    if speed is not None and window.start is None and window.stop is None:
        require(bool(np.isfinite(speed).any()), "the log", "no airspeed or thrust at the samples of y", "a flight")
        keep &= speed > AIRBORNE * np.nanpercentile(speed, TYPICAL)
    if needs_manual:
        mode = next((at for at in log.format.mode if log.has(at)), None) if log.format is not None else None
        if mode is not None:
            keep &= log.at(mode, stamps) == log.manual
        expected = "it, for only there the sticks are the commands, or --servos"
        require(bool(keep.any()), "the log", f"no flight in MANUAL {where}", expected)
    require(bool(keep.any()), "the log", f"no time in the air {where}", "a flight, or --from and --until")
    edges = np.flatnonzero(np.diff(np.concatenate([[False], keep, [False]]).astype(np.int8)))
    runs = [(int(stamps[first]), int(stamps[end - 1])) for first, end in zip(edges[::2], edges[1::2], strict=True)]
    first, last = max(runs, key=lambda run: run[1] - run[0])
    length = 1e-9 * (last - first)
    require(length >= LEAST, "the log", f"{length:.1f} s of flight {where}", f"{LEAST:g} s or more in one stretch")
    return first, last


def _complete(stamp_ns: Stamps, values: FloatArray) -> tuple[Stamps, FloatArray]:
    """The samples in which every channel is known."""
    known = np.isfinite(values).all(axis=1)
    return stamp_ns[known], values[known]


def _pose(channel_map: ChannelMap, log: VehicleLog, first: int, last: int) -> Signal | None:
    """The channels of the map's pose that the log has, NaN where one is not known yet."""
    sources = {name: source for name in channel_map.pose if (source := log.source(name)) is not None}
    if not sources:
        return None
    stamps = log.tables[next(iter(sources.values())).message].stamp_ns
    stamps = stamps[(stamps >= first) & (stamps <= last)]
    values = [log.at(source, stamps) for source in sources.values()]
    return Signal(stamps, tuple(sources), np.column_stack(values)) if len(stamps) else None
