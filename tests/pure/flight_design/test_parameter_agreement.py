# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test the parameters of ArduPilot against the channel maps.

Expected values follow from its formulas for channels and servos.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np
import pytest
from tests.conftest import refusing
from tests.maps import named_map

from autopilot_bridge.params import ChannelMap
from flight_core.parameters import ParameterError
from flight_design.identification.parameter_agreement import (
    Servo,
    Stick,
    absence_sentence,
    change_sentences,
    compared,
    require_agreement,
    servo_of,
    stick_of,
)
from flight_log.vehicle_tables import ParameterRecord

MAPS = ("ardupilot", "ardupilot_mavlink")
AXES = {"elevator": "PITCH", "thrust": "THROTTLE", "aileron": "ROLL", "rudder": "YAW"}
ENDS = {"MIN": 1000.0, "TRIM": 1500.0, "MAX": 2000.0, "REVERSED": 0.0}  # us, of the shipped maps
PARAMETERS = {
    f"RC{number}_{end}": value for number in range(1, 5) for end, value in ENDS.items()
} | {"RCMAP_ROLL": 1.0, "RCMAP_PITCH": 2.0, "RCMAP_THROTTLE": 3.0, "RCMAP_YAW": 4.0}


def agreement(
    channel_map: ChannelMap, values: Mapping[str, float], later: Mapping[str, float] | None = None
) -> str | None:
    """Return the sentence on absent parameters if the parameters at the samples agree with the map.

    `later` are other values that the log has after the samples.
    """
    sticks = [stick_of(channel_map, name) for name in channel_map.inputs]
    recorded = {name: (ParameterRecord(0, value),) for name, value in values.items()}
    recorded |= {name: (ParameterRecord(10**12, value),) for name, value in (later or {}).items()}
    rows = compared(sticks, recorded, values)
    require_agreement(channel_map.name, rows)
    return absence_sentence(rows)


def changed(name: str, section: str, **values: Any) -> ChannelMap:
    """Return a shipped map with another row of the elevator."""
    content = named_map(name).model_dump()
    content[section]["elevator"] |= values
    return ChannelMap.validate_mapping(content, "map")


@pytest.mark.parametrize("name", MAPS)
def test_shipped_map_agrees_with_the_parameters_that_it_names(name: str) -> None:
    assert agreement(named_map(name), PARAMETERS) is None


@pytest.mark.parametrize(
    "parameter, value, expected, mend",
    [
        ("RC2_MIN", 1100.0, 1000.0, "change `range`, `scale` and `offset`"),
        ("RC4_TRIM", 1440.0, 1500.0, "calibrate the transmitter with its trims"),
        ("RC2_REVERSED", 1.0, 0.0, "change `positive`"),
        ("RCMAP_YAW", 5.0, 4.0, "change `field`"),
    ],
)
@pytest.mark.parametrize("name", MAPS)
def test_parameter_that_differs_is_refused_with_both_values_and_the_mend(
    name: str, parameter: str, value: float, expected: float, mend: str
) -> None:
    with pytest.raises(ParameterError) as refused:
        agreement(named_map(name), PARAMETERS | {parameter: value})
    sentence = str(refused.value)
    assert sentence.startswith(
        f"the log: found {parameter} {value:g}, expected {parameter} {expected:g} as in the map "
        f"{name}:"
    )
    assert f": {mend}" in sentence


def test_parameter_that_the_log_lacks_is_told_and_not_assumed() -> None:
    values = {
        name: value
        for name, value in PARAMETERS.items()
        if name not in {"RC1_REVERSED", "RCMAP_PITCH"}
    }
    sentence = (
        "the log has no RCMAP_PITCH, RC1_REVERSED before the samples: compare the map "
        "with them yourself"
    )
    assert agreement(named_map("ardupilot"), values) == sentence
    # it may have been another one
    assert agreement(named_map("ardupilot"), values, {"RC1_REVERSED": 0.0}) == sentence
    with refusing("found RC1_REVERSED 1, expected RC1_REVERSED 0"):
        agreement(named_map("ardupilot"), values, {"RC1_REVERSED": 1.0})


@pytest.mark.parametrize("name", MAPS)
def test_map_of_a_reversed_channel_agrees_with_the_reversal_alone(name: str) -> None:
    """With RC2_REVERSED a longer pulse is nose down.

    The row of the map has the same motion for an increasing raw value.
    """
    reversed_map = changed(name, "inputs", positive="nose down")
    assert agreement(reversed_map, PARAMETERS | {"RC2_REVERSED": 1.0}) is None
    with refusing("found RC2_REVERSED 0, expected RC2_REVERSED 1"):
        agreement(reversed_map, PARAMETERS)


SURFACE = {
    "SERVO5_FUNCTION": 19.0,
    "SERVO5_MIN": 1000.0,
    "SERVO5_TRIM": 1400.0,
    "SERVO5_MAX": 2000.0,
    "SERVO5_REVERSED": 0.0,
}
PULSES = np.array([1000.0, 1200.0, 1400.0, 1700.0, 2000.0])


def elevator() -> Stick:
    return stick_of(named_map("ardupilot"), "elevator")


@pytest.mark.parametrize("is_reversed, sign", [(0.0, 1.0), (1.0, -1.0)])
def test_deflection_of_a_surface_is_that_about_its_trim(is_reversed: float, sign: float) -> None:
    """SRV_Channel::pwm_from_angle has a slope of its own from the trim to each end."""
    servo = servo_of(elevator(), "elevator", SURFACE | {"SERVO5_REVERSED": is_reversed})
    assert servo.output == 5
    np.testing.assert_allclose(
        servo.deflection(PULSES, elevator()), sign * np.array([-1.0, -0.5, 0.0, 0.5, 1.0])
    )


@pytest.mark.parametrize("is_reversed, part", [(False, 0.25), (True, 0.75)])
def test_deflection_of_a_throttle_is_that_from_its_end(is_reversed: bool, part: float) -> None:
    """By SRV_Channel::pwm_from_range, a reversed throttle is open at its lower end."""
    stick = stick_of(named_map("ardupilot"), "thrust")
    servo = Servo(output=3, low=1000.0, trim=1000.0, high=2000.0, is_reversed=is_reversed)
    assert servo.deflection(np.array([1250.0]), stick) == pytest.approx([part])


@pytest.mark.parametrize(
    "name, positive, raw",
    [
        ("ardupilot", "nose up", 0.5),
        ("ardupilot", "nose down", -0.5),
        ("ardupilot_mavlink", "nose up", 1750.0),
        ("ardupilot_mavlink", "nose down", 1250.0),
    ],
)
def test_raw_value_of_half_a_deflection(name: str, positive: str, raw: float) -> None:
    stick = stick_of(changed(name, "inputs", positive=positive), "elevator")
    assert stick.raw(np.array([0.5])) == pytest.approx([raw])


@pytest.mark.parametrize("absent", [name for name in SURFACE if name != "SERVO5_FUNCTION"])
def test_servo_without_one_of_its_parameters_is_refused(absent: str) -> None:
    values = {name: value for name, value in SURFACE.items() if name != absent}
    cause = f"inputs.elevator: found no {absent} in the log before the samples"
    with refusing(f"{cause}, expected these parameters"):
        servo_of(elevator(), "elevator", values)


@pytest.mark.parametrize(
    "values, sentence",
    [
        ({"SERVO5_FUNCTION": 77.0}, "found no servo with SERVOn_FUNCTION 19 in the log"),
        (
            {"SERVO5_TRIM": 2000.0},
            r"SERVO5_MIN, TRIM, MAX: found \[1000.0, 2000.0, 2000.0\], expected ascending values",
        ),
    ],
)
def test_servo_that_has_no_sense_is_refused(values: dict[str, float], sentence: str) -> None:
    with refusing(sentence):
        servo_of(elevator(), "elevator", SURFACE | values)


SECOND = 1_000_000_000


def test_changes_are_told_with_the_value_of_the_samples() -> None:
    """The log begins at 10 s, and the samples are from 30 to 60 s."""
    recorded = {
        "SERVO2_REVERSED": (
            ParameterRecord(0, 1.0),
            ParameterRecord(20 * SECOND, 0.0),
            ParameterRecord(65 * SECOND, 1.0),
        ),
        # The same value comes once more.
        "RC1_MIN": (
            ParameterRecord(0, 1000.0),
            ParameterRecord(40 * SECOND, 1000.0),
        ),
        # This parameter is not between u and the surface.
        "TECS_SPDWEIGHT": (
            ParameterRecord(0, 1.0),
            ParameterRecord(40 * SECOND, 2.0),
        ),
    }
    assert change_sentences(recorded, 10 * SECOND, 30 * SECOND, 60 * SECOND) == [
        (
            "SERVO2_REVERSED changes from 1 to 0 at 10.0 s of the log, before the samples: signs "
            "and effects apply to 0"
        ),
        (
            "SERVO2_REVERSED changes from 0 to 1 at 55.0 s of the log, after the samples: signs "
            "and effects apply to 0"
        ),
    ]


@pytest.mark.parametrize("name", ["RCMAP_PITCH", "SERVO1_REVERSED", "PWM_MAIN_REV"])
def test_change_between_the_samples_is_refused(name: str) -> None:
    recorded = {name: (ParameterRecord(0, 1.0), ParameterRecord(60 * SECOND, 2.0))}
    with refusing(f"found {name} changes from 1 to 2 at 50.0 s of the log, expected no change"):
        change_sentences(recorded, 10 * SECOND, 30 * SECOND, 60 * SECOND)
    assert len(change_sentences(recorded, 10 * SECOND, 60 * SECOND, 90 * SECOND)) == 1
