# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Make tables of messages from the samples of an autopilot's log."""

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flight_core.rates import NANOSECONDS
from flight_core.vectors import FloatArray
from flight_log.vehicle_tables import PARAMETER, MessageTable, ParameterRecord, Parameters

LARGEST = 2**62  # largest stamp that is not damaged, ns
STEP_NS = NANOSECONDS  # ns; if the clock goes back by more, the autopilot has started again
LOST_NS = 60 * NANOSECONDS  # ns, longest gap between samples that agree, because a link may be lost
AGREEING = 5  # number of samples that must agree on another time before it counts as true

Sample = tuple[tuple[str, int], int, Any]
"""Name and instance, stamp in ns and content of a message. If the message is a PARAMETER, the
content is a name and a value."""

Instances = dict[str, dict[int, MessageTable]]
"""The tables of the messages, by name and by the number of the instance."""

SETTING = (PARAMETER, 0)


def tables_of(
    samples: Iterable[Sample], fields: Mapping[str, set[str]]
) -> tuple[Instances, Parameters, str]:
    """Return the tables of the messages, the parameters, and a note if parts were left out.

    If the clock goes back by more than STEP_NS, as when an autopilot starts again, a new part
    begins. Only the longest part is returned, and the third result says so. Otherwise the third
    result is "". A parameter belongs to the part of the next sample, because an autopilot writes
    its parameters first when it starts.

    Damaged samples are left out without a note. A stamp is damaged if fewer than AGREEING samples
    in a row agree with it. A table with fewer than AGREEING samples is damaged if another instance
    of its message has more. If the first message of a table lacks a field, the table lacks this
    field, too.
    """
    parts = [list[Sample]()]
    newest_ns = 0
    # the last samples, if they agree with each other but not with the current part
    strays: list[Sample] = []
    settings = [list[Sample]()]  # the parameters of each part
    next_settings: list[Sample] = []
    for sample in samples:
        if sample[0] == SETTING:
            next_settings.append(sample)
            continue
        if parts[-1] and abs(sample[1] - newest_ns) <= STEP_NS:
            parts[-1].append(sample)
            newest_ns = max(newest_ns, sample[1])
            strays = []
        else:
            if strays and -STEP_NS <= sample[1] - strays[-1][1] <= LOST_NS:
                strays = [*strays, sample]
            else:
                strays = [sample]
            if len(strays) < AGREEING:
                continue
            if parts[-1] and strays[0][1] < newest_ns:
                parts.append([])
                settings.append([])
            parts[-1] += strays
            newest_ns = max(stamp_ns for _, stamp_ns, _ in strays)
            strays = []
        settings[-1] += next_settings
        next_settings = []
    settings[-1] += next_settings
    note = f", the longest of {len(parts)} parts: its clock goes back" if len(parts) > 1 else ""
    longest = max(range(len(parts)), key=lambda number: len(parts[number]))
    return _columns(parts[longest] or strays, fields), parameters_of(settings[longest]), note


def parameters_of(records: Iterable[Sample]) -> Parameters:
    """Collect the records of each parameter, in their order."""
    parameters: dict[str, list[ParameterRecord]] = {}
    for _, stamp_ns, (name, value) in records:
        parameters.setdefault(name, []).append(ParameterRecord(stamp_ns, value))
    return {name: tuple(values) for name, values in parameters.items()}


def _columns(samples: Iterable[Sample], fields_of: Mapping[str, set[str]]) -> Instances:
    stamps: dict[tuple[str, int], list[int]] = {}
    columns: dict[tuple[str, int], dict[str, list[float]]] = {}
    for place, stamp_ns, message in samples:
        if place not in columns:
            columns[place] = {
                field: []
                for field in sorted(fields_of[place[0]])
                if is_number(getattr(message, field, None))
            }
        stamps.setdefault(place, []).append(stamp_ns)
        for field, values in columns[place].items():
            values.append(float(getattr(message, field)))
    tables: Instances = {}
    most: dict[str, int] = {}
    for (name, _), values_ns in stamps.items():
        most[name] = max(most.get(name, 0), len(values_ns))
    for (name, number), lists in columns.items():
        # A damaged number belongs to no sensor.
        if len(stamps[name, number]) < min(AGREEING, most[name]):
            continue
        fields = {field: np.array(values) for field, values in lists.items()}
        tables.setdefault(name, {})[number] = table_of(
            np.array(stamps[name, number], dtype=np.int64), fields
        )
    return tables


def is_number(value: object) -> bool:
    """Return whether a value of a message is a number."""
    return isinstance(value, int | float)


def is_near(stamp_ns: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Return a mask of the stamps that are near the median of the five stamps around them.

    A damaged stamp is far from this median.
    """
    if len(stamp_ns) <= 2:
        return np.ones(len(stamp_ns), dtype=bool)
    fives = np.lib.stride_tricks.sliding_window_view(np.pad(stamp_ns, 2, mode="reflect"), 5)
    distance = np.abs(stamp_ns - np.median(fives, axis=1))
    return distance <= STEP_NS + 2.0 * np.median(np.abs(np.diff(stamp_ns)))


def table_of(stamp_ns: NDArray[np.int64], fields: Mapping[str, FloatArray]) -> MessageTable:
    """Return a table in the order of its stamps.

    If several samples have the same stamp, the table has only the first of them.
    """
    stamps, places = np.unique(stamp_ns, return_index=True)
    return MessageTable(stamps, {name: values[places] for name, values in fields.items()})
