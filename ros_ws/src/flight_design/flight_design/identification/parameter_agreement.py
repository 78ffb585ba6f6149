# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Compare the parameters of ArduPilot in a log with what a channel map says of the transmitter.

Sources: ArduPilot, RC_Channel.cpp and SRV_Channel.cpp (ends, trim, reversal), RCMapper.cpp,
SRV_Channel.h (functions of servos); ArduPlane, mode_fbwa.cpp (if RCn_REVERSED is 0, high is roll
right, nose up, more thrust, nose right).
"""

import re
from collections.abc import Iterable, Mapping
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from autopilot_bridge.channel_map import LinearConversion, to_raw
from autopilot_bridge.map_rows import MOTIONS
from autopilot_bridge.params import ChannelMap
from flight_core.parameters import ParameterError, require
from flight_core.rates import seconds
from flight_core.vectors import FloatArray
from flight_log.vehicle_tables import SERVOS, Parameters

# Channel of a transmitter in a message. Rc.msg counts from 0, MAVLink from 1.
CHANNEL = re.compile(r"channels\[(\d+)\]|chan(\d+)_raw")
# axis of RCMAP, by the output that responds
AXES: Mapping[str, str] = {"p": "ROLL", "q": "PITCH", "V": "THROTTLE", "r": "YAW"}
# SERVOn_FUNCTION: aileron, elevator, throttle, rudder
FUNCTIONS = {"ROLL": 4, "PITCH": 19, "THROTTLE": 70, "YAW": 21}
# conversion of an input without a row of `trims`: its raw value is the pulse
SAME_VALUE = LinearConversion(1, 1.0, 0.0)

# Largest difference of an end of the range, as a share of half the range. The effect of the input
# differs by the same share, which is less than the standard errors of `identify`.
END_TOLERANCE = 0.01
# Largest difference of the trim, as a share of half the range. The effects on either side of the
# trim differ from their mean by the same share.
TRIM_TOLERANCE = 0.05

DECISIVE = re.compile(r"RCMAP_\w+|(RC|SERVO)\d+_(FUNCTION|MIN|MAX|TRIM|REVERSED)|(CA|PWM)_\w+")
"""Parameters of ArduPilot and PX4 between a command and the surface.

If one of them changes, so does the sign or the effect.
"""

CALIBRATE = (
    "change `range`, `scale` and `offset` of the rows of `inputs` and `trims`, or "
    "calibrate the transmitter and fly again"
)
# Remedies by a part of the parameter's name. None of them reverses the pilot's stick.
MENDS = {
    "REVERSED": "change `positive` of the row of `inputs`, and not the parameter",
    "TRIM": "calibrate the transmitter with its trims in the middle and fly again",
    "MIN": CALIBRATE,
    "MAX": CALIBRATE,
    "RCMAP": "change `field` of the rows of `inputs` and `trims`",
}


class Stick(NamedTuple):
    """What a channel map says about an input and its channel of the transmitter.

    `trim_conversion`, from the input's row of `trims`, converts the pulse, us, to the raw value.
    """

    axis: str  # ROLL, PITCH, THROTTLE or YAW
    channel: int  # channel of the transmitter, from 1
    trim_conversion: LinearConversion
    raw_range: tuple[float, float]
    raw_sign: int  # +1 if a higher raw value is roll right, nose up, more thrust, nose right

    @property
    def is_centred(self) -> bool:
        """Whether ArduPilot measures the channel from its trim, and not from its lower end."""
        return self.axis != "THROTTLE"

    def parameters(self) -> dict[str, tuple[float, float]]:
        """Return which parameters of ArduPilot the map asks for: (value, tolerance) by name."""
        low, high = sorted(to_raw(raw, self.trim_conversion) for raw in self.raw_range)
        half = (high - low) / 2.0
        name = f"RC{self.channel}"
        trim = {f"{name}_TRIM": (low + half, TRIM_TOLERANCE * half)} if self.is_centred else {}
        is_reversed = self.raw_sign * self.trim_conversion.sign < 0
        return {
            f"RCMAP_{self.axis}": (float(self.channel), 0.0),
            f"{name}_MIN": (low, END_TOLERANCE * half),
            f"{name}_MAX": (high, END_TOLERANCE * half),
            **trim,
            f"{name}_REVERSED": (float(is_reversed), 0.0),
        }

    def raw(self, deflection: FloatArray) -> FloatArray:
        """Return the raw value of the stick at a fraction of full deflection.

        The fraction is -1 to 1 about the middle. For a throttle it is 0 to 1 from the lower end.
        """
        low, high = self.raw_range
        part = (1.0 + self.raw_sign * deflection) / 2.0 if self.is_centred else deflection
        return low + (high - low) * (part if self.is_centred or self.raw_sign > 0 else 1.0 - part)


def stick_of(channel_map: ChannelMap, name: str) -> Stick:
    """Return what a channel map says about the transmitter's channel for an input.

    Raises ParameterError if the input has no channel.
    """
    row = channel_map.inputs[name]
    trim = channel_map.trims.get(name)
    match = CHANNEL.fullmatch(row.field if trim is None else trim.field)
    if match is None:
        expected = "a field such as channels[1]"
        raise ParameterError(
            f"trims.{name}: found no channel of the transmitter, expected {expected}"
        )
    responds, raw_sign = MOTIONS[row.positive]
    motions = "a motion of roll, pitch, yaw or thrust: the log is of a plane"
    require(responds in AXES, f"inputs.{name}.positive", f"{row.positive!r}", motions)
    channel = int(match[1]) + 1 if match[1] else int(match[2])
    return Stick(
        axis=AXES[responds],
        channel=channel,
        trim_conversion=SAME_VALUE if trim is None else trim.conversion,
        raw_range=row.range,
        raw_sign=raw_sign,
    )


class Servo(NamedTuple):
    """A servo of ArduPilot: the number of its output, from 1, and its ends and trim, us."""

    output: int
    low: float
    trim: float
    high: float
    is_reversed: bool

    def deflection(self, pulse: FloatArray, stick: Stick) -> FloatArray:
        """Return the deflection of the servo for a pulse, us, as a fraction of full deflection.

        The fraction is -1 to 1, and for a throttle 0 to 1.
        """
        if not stick.is_centred:
            part = (pulse - self.low) / (self.high - self.low)
            return 1.0 - part if self.is_reversed else part
        side = np.where(pulse > self.trim, self.high - self.trim, self.trim - self.low)
        return (-1.0 if self.is_reversed else 1.0) * (pulse - self.trim) / side


def servo_of(stick: Stick, name: str, values: Mapping[str, float]) -> Servo:
    """Return the servo that an input's stick moves: the first servo with the stick's function.

    `values` has the parameters at the time of the samples. Raises ParameterError if there is no
    servo with this function, or if one of its parameters is missing.
    """
    function = FUNCTIONS[stick.axis]
    outputs = [
        number
        for number in range(1, SERVOS + 1)
        if values.get(f"SERVO{number}_FUNCTION") == function
    ]
    sticks_instead = "or a log in MANUAL, where the sticks are the commands"
    if not outputs:
        missing = f"found no servo with SERVOn_FUNCTION {function} in the log"
        raise ParameterError(f"inputs.{name}: {missing}, expected one, {sticks_instead}")
    keys = ["MIN", "TRIM", "MAX", "REVERSED"] if stick.is_centred else ["MIN", "MAX", "REVERSED"]
    names = [f"SERVO{outputs[0]}_{key}" for key in keys]
    absent = [key for key in names if key not in values]
    require(
        not absent,
        f"inputs.{name}",
        f"no {', '.join(absent)} in the log before the samples",
        f"these parameters, {sticks_instead}",
    )
    low, *trim, high, is_reversed = (values[key] for key in names)
    ends = [low, *trim, high]
    ascending = all(before < after for before, after in pairwise(ends))
    require(
        ascending, f"SERVO{outputs[0]}_MIN, TRIM, MAX", ends, f"ascending values, {sticks_instead}"
    )
    require(is_reversed in {0.0, 1.0}, f"SERVO{outputs[0]}_REVERSED", f"{is_reversed:g}", "0 or 1")
    return Servo(
        output=outputs[0],
        low=low,
        trim=trim[0] if trim else low,
        high=high,
        is_reversed=is_reversed == 1.0,
    )


class Agreement(NamedTuple):
    """A parameter in a log, compared with what a channel map says."""

    what: str  # the parameter, or the quantity that is taken from the log
    logged: str  # the value in the log; "" if the log has no record
    mapped: str  # the value in the map; "" if the map has none
    is_different: bool = False
    is_known: bool = True  # whether a record before the samples gives the value


def compared(
    sticks: Iterable[Stick], recorded: Parameters, values: Mapping[str, float]
) -> list[Agreement]:
    """Compare the transmitter's parameters in a log with a map.

    `values` has the parameters at the time of the samples. If a parameter has no value then, its
    first record after the samples is compared. No default value replaces a missing record.
    """
    parameters = {name: records[0].value for name, records in recorded.items()} | dict(values)
    rows = []
    for stick in sticks:
        for name, (value, tolerance) in stick.parameters().items():
            is_different = name in parameters and not abs(parameters[name] - value) <= tolerance
            logged = f"{parameters[name]:g}" if name in parameters else ""
            rows.append(
                Agreement(
                    what=name,
                    logged=logged,
                    mapped=f"{value:g}",
                    is_different=is_different,
                    is_known=name in values,
                )
            )
    return rows


def require_agreement(name_of_map: str, rows: Iterable[Agreement]) -> None:
    """Raise ParameterError if a parameter in the log differs from what the map says."""
    differing = [row for row in rows if row.is_different]
    if differing:
        logged = ", ".join(f"{row.what} {row.logged}" for row in differing)
        expected = ", ".join(f"{row.what} {row.mapped}" for row in differing)
        mends: dict[str, None] = {}
        for row in differing:
            mends |= dict.fromkeys(
                mend for end, mend in MENDS.items() if end in row.what.split("_")
            )
        raise ParameterError(
            f"the log: found {logged}, expected {expected} as in the map {name_of_map}: "
            f"{'; '.join(mends)}"
        )


def absence_sentence(rows: Iterable[Agreement]) -> str | None:
    """Write a sentence on the parameters without a value at the samples, or return None."""
    absent = ", ".join(row.what for row in rows if not row.is_known)
    if not absent:
        return None
    return f"the log has no {absent} before the samples: compare the map with them yourself"


def change_sentences(recorded: Parameters, start_ns: int, first_ns: int, last_ns: int) -> list[str]:
    """Say which decisive parameters change before or after the samples.

    A parameter is decisive if the signs or effects in the samples depend on it. `first_ns` and
    `last_ns` are the first and the last sample, and `start_ns` is the beginning of the log. Raises
    ParameterError if a decisive parameter changes between the samples.
    """
    between = []
    outside = []
    for name, records in sorted(recorded.items()):
        for before, after in pairwise(records if DECISIVE.fullmatch(name) else ()):
            if before.value == after.value:
                continue
            instant = seconds(after.stamp_ns - start_ns)
            change = (
                f"{name} changes from {before.value:g} to {after.value:g} at {instant:.1f} "
                "s of the log"
            )
            if first_ns < after.stamp_ns <= last_ns:
                between.append(change)
            else:
                side, value = (
                    ("before", after.value)
                    if after.stamp_ns <= first_ns
                    else ("after", before.value)
                )
                outside.append(
                    f"{change}, {side} the samples: signs and effects apply to {value:g}"
                )
    require(
        not between,
        "the log",
        "; ".join(between),
        "no change between the samples: leave it out by --from and --until",
    )
    return outside
