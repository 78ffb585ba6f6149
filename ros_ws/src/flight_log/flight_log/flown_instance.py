# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Find the sensor by which the autopilot flew, if its log has several of a kind.

Each such sensor is an instance of a message.

Sources: ArduPilot, AP_Logger/LogStructure.h (ARSP: H healthy, U used, Pri primary; IMU: GH),
AP_InertialSensor.cpp (INS_USE), AP_Airspeed.cpp (ARSPD_USE); ArduPlane/Log.cpp (CTUN.As: the
airspeed sensor if used and healthy, else the estimate by wind and ground speed); PX4,
vtol_att_control (instance 0 of the setpoints of torque is of the rotors, 1 of the surfaces).
"""

from collections.abc import Mapping, Set

import numpy as np

from flight_core.parameters import ParameterError, require
from flight_log.log_samples import Instances
from flight_log.vehicle_tables import (
    Choice,
    MessageTable,
    Parameters,
    Reason,
    Taken,
    UnusedSensor,
    VehicleKind,
    enumeration,
)

# The autopilot did not fly by an instance whose signals change by less than this fraction of the
# changes in the instance that changes most.
STILL = 0.1
# Two sensors agree if they differ by at most this fraction of the standard deviation of the
# quantity.
UNLIKE = 0.4
# A flag is taken as set if it is set in at least this fraction of the samples. A pitot tube was in
# the airflow if its typical airspeed is at least this fraction of the fastest tube's.
MOST = 0.5
AIRSPEEDS = frozenset({"Airspeed", "true_airspeed_m_s"})
TYPICAL = 90.0  # percentile that counts as the typical value of an airspeed
# messages of PX4 whose instance 1 belongs to the surfaces of a VTOL
SURFACES = ("vehicle_torque_setpoint", "actuator_controls_0")
CORES = ("XKF1", "NKF1", "EKF1")


def instances_of_flight(
    instances: Instances, fields: Mapping[str, Set[str]], parameters: Parameters, choice: Choice
) -> tuple[dict[str, MessageTable], list[Taken]]:
    """Return a table for each message, and which instance was taken and why.

    `fields` has the fields that are read, by message. For a message that is not in `fields`, and
    for the cores of the EKF, the first instance is taken. Raises ParameterError if instances that
    differ are left after all rules, if `choice` names an instance that the log lacks, if no IMU was
    in use, or if no airspeed sensor was in use and the log has no estimate of the airspeed.
    """
    for name in choice.instances:
        require(
            name in instances,
            "--instance",
            name,
            f"a message of the log, as {', '.join([*instances][:8])}",
        )
    tables: dict[str, MessageTable] = {}
    choices: list[Taken] = []
    for name, sensors in instances.items():
        among = tuple(sorted(sensors))
        number = choice.instances.get(name)
        reason: Reason | None = Reason.BY_INSTANCE
        if number is not None:
            require(
                number in sensors,
                f"--instance {name}",
                number,
                f"one of {enumeration(among)}",
            )
        elif name == "ARSP":
            unused = _unused_sensors(sensors, parameters)
            if unused and _has_estimate(instances):
                choices.append(Taken(name, (), among, Reason.ESTIMATE, unused))
                continue
            ways_out = "an estimate of the airspeed in CTUN, or --instance ARSP=0"
            reasons = "; ".join(sensor.sentence() for sensor in unused)
            require(not unused, "the log", f"no airspeed sensor in use ({reasons})", ways_out)
            tables[name], numbers, reason = _airspeed(sensors)
            if len(sensors) > 1:
                choices.append(Taken(name, numbers, among, reason))
            continue
        elif len(sensors) == 1 or name not in fields or name in CORES:
            number = min(sensors)
            reason = Reason.FIRST if name in fields and len(sensors) > 1 else None
        elif name in SURFACES:
            if choice.vehicle is VehicleKind.PLANE:
                number, reason = 1, Reason.SURFACES
            else:
                number, reason = 0, Reason.ROTORS
        else:
            usable = _usable_sensors(sensors, parameters) if name == "IMU" else set(sensors)
            number, reason = _of_motion(name, {k: sensors[k] for k in sorted(usable)}, fields[name])
        tables[name] = sensors[number]
        if reason is not None:
            choices.append(Taken(name, (number,), among, reason))
    return tables, choices


def _of_motion(
    name: str, tables: Mapping[int, MessageTable], fields: Set[str]
) -> tuple[int, Reason]:
    """Choose the instance whose signals change, and return its number and the reason.

    If several instances change and agree, the first of them is chosen. Raises ParameterError if the
    changing instances differ.
    """
    motions = {number: _motion(table, fields) for number, table in tables.items()}
    moving = {
        number: tables[number]
        for number in moving_numbers(motions, MOST if fields & AIRSPEEDS else STILL)
    }
    first, *others = moving
    if all(_is_same_sensor(moving[first], moving[number], fields) for number in others):
        return first, Reason.AGREES if others else Reason.MOVES
    ways_out = " or ".join(f"--instance {name}={number}" for number in moving)
    raise ParameterError(
        f"the log: found different instances {enumeration(sorted(moving))} of {name}, expected "
        f"a choice: {ways_out}"
    )


def moving_numbers(motions: Mapping[int, float], least: float = STILL) -> list[int]:
    """Return the numbers of the instances with at least `least` times the largest motion."""
    return [number for number, motion in motions.items() if motion >= least * max(motions.values())]


def _motion(table: MessageTable, fields: Set[str]) -> float:
    """Return a measure of how much an instance moves.

    For an airspeed it is the typical value, which is 0 for a dead sensor. For other messages it is
    the sum of the standard deviations of the fields.
    """
    for field in fields & AIRSPEEDS & table.fields.keys():
        finite = table.fields[field][np.isfinite(table.fields[field])]
        return float(np.percentile(finite, TYPICAL)) if len(finite) else 0.0
    return sum(_deviation(table.fields[field]) for field in fields & table.fields.keys())


def _deviation(values: np.ndarray) -> float:
    finite = values[np.isfinite(values)]
    return float(finite.std()) if len(finite) else 0.0


def _is_same_sensor(first: MessageTable, second: MessageTable, fields: Set[str]) -> bool:
    """Return whether two sensors agree in each field.

    They agree if the rms difference of each field is at most UNLIKE times the standard deviation of
    the first sensor.
    """
    for field in fields & first.fields.keys() & second.fields.keys():
        values = first.fields[field]
        difference = values - second.at(field, first.stamp_ns)
        is_finite = np.isfinite(difference)
        if is_finite.any() and np.sqrt(np.mean(difference[is_finite] ** 2)) > UNLIKE * _deviation(
            values[is_finite]
        ):
            return False
    return True


def _usable_sensors(tables: Mapping[int, MessageTable], parameters: Parameters) -> set[int]:
    """Return the numbers of the healthy gyroscopes in use, by INS_USE, INS_USE2 and INS_USE3."""
    names = {number: f"INS_USE{number + 1 if number else ''}" for number in tables}
    numbers = {
        number
        for number, name in names.items()
        if name not in parameters or parameters[name][0].value
    }
    healthy = {number for number in numbers if _share(tables[number], "GH") >= MOST}
    settings = ", ".join(
        f"{name} {parameters[name][0].value:g}" for name in names.values() if name in parameters
    )
    require(
        bool(healthy),
        "the log",
        f"no IMU that is used and healthy ({settings})",
        "one, or --instance IMU=0",
    )
    return healthy


def _share(table: MessageTable, field: str) -> float:
    """Return the fraction of the samples in which a flag is set; 1 if there is no such flag."""
    return float(np.mean(table.fields[field] != 0.0)) if field in table.fields else 1.0


def _airspeed(
    sensors: Mapping[int, MessageTable],
) -> tuple[MessageTable, tuple[int, ...], Reason]:
    """Return the airspeed of the primary sensor, or of another healthy sensor.

    Another sensor is taken if the primary one was mostly not healthy, or if a sensor in use differs
    from it. The primary sensor may change in flight. The airspeed is NaN while the sensor is not
    healthy. The further results are the numbers of the sensors that were taken, and why.
    """
    tables = {number: _healthy(table) for number, table in sensors.items()}
    live = {
        number: table
        for number, table in tables.items()
        if np.isfinite(table.fields["Airspeed"]).mean() >= MOST
    }
    candidates = {
        number: table for number, table in live.items() if _share(table, "U") >= MOST
    } or live
    primary = _primary(tables)
    if primary is not None and np.isfinite(primary[1].fields["Airspeed"]).mean() >= MOST:
        numbers, table = primary
        unlike = [
            number
            for number in candidates
            if number not in numbers
            and not _is_same_sensor(candidates[number], table, {"Airspeed"})
        ]
        if not unlike:
            return table, tuple(sorted(numbers)), Reason.PRIMARY
        candidates = {number: tables[number] for number in (*numbers, *unlike)}
    number, _ = _of_motion("ARSP", candidates, {"Airspeed"})
    return tables[number], (number,), Reason.USED


def _unused_sensors(
    sensors: Mapping[int, MessageTable], parameters: Parameters
) -> tuple[UnusedSensor, ...]:
    """Return all airspeed sensors if the autopilot used none of them.

    A sensor was used if the flags U and H say so. In a log without U, the parameter ARSPD_USE
    replaces it. If a sensor was used, or if the log does not tell, the result is empty.
    """
    unused = []
    for number, table in sorted(sensors.items()):
        setting = f"ARSPD{number + 1 if number else ''}_USE"
        records = parameters.get(setting, ())
        if "U" in table.fields:
            is_used = _share(table, "U") >= MOST
        else:
            is_used = not records or records[0].value != 0.0
        if is_used and _share(table, "H") >= MOST:
            return ()
        value = records[0].value if records else None
        unused.append(UnusedSensor(number, is_used, setting, value))
    return tuple(unused)


def _has_estimate(instances: Instances) -> bool:
    """Return whether CTUN has an airspeed, which is the estimate by which ArduPlane flies."""
    return any({"As", "Aspd"} & table.fields.keys() for table in instances.get("CTUN", {}).values())


def _healthy(table: MessageTable) -> MessageTable:
    healthy = table.fields.get("H", np.ones(len(table.stamp_ns))) != 0.0
    return table._replace(
        fields={**table.fields, "Airspeed": np.where(healthy, table.fields["Airspeed"], np.nan)}
    )


def _primary(tables: Mapping[int, MessageTable]) -> tuple[list[int], MessageTable] | None:
    """Return the numbers of all sensors that were primary, and the samples of the primary one.

    Returns None if the log has no `Pri`, or if `Pri` names none of the sensors.
    """
    if not all("Pri" in table.fields for table in tables.values()):
        return None
    masks = {number: table.fields["Pri"] == number for number, table in tables.items()}
    numbers = [number for number, mask in masks.items() if mask.any()]
    if not numbers:
        return None
    stamps = np.concatenate([tables[number].stamp_ns[masks[number]] for number in numbers])
    airspeed = np.concatenate(
        [tables[number].fields["Airspeed"][masks[number]] for number in numbers]
    )
    order = np.argsort(stamps, kind="stable")
    return numbers, MessageTable(stamps[order], {"Airspeed": airspeed[order]})
