# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Check the conditions and the pilot overrides of a channel map.

By conditions and overrides the autopilot and the pilot can refuse or end an engagement.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

from autopilot_bridge.map_rows import ConditionRow
from autopilot_bridge.params import ChannelMap
from flight_core.outcome import Refusal, joined
from flight_core.rates import nanoseconds, seconds


class Reading(NamedTuple):
    """The newest value of a field, with its stamp."""

    stamp_ns: int
    value: float


@dataclass(frozen=True)
class Stale(Refusal):
    """The fault of a field that is too old, or that was not received yet."""

    is_received: bool


class Conditions:
    """The newest values of the fields on which conditions and overrides of a map depend.

    The attribute `blind` says whether an engagement goes on if the pilot's transmitter is lost.
    """

    def __init__(self, channel_map: ChannelMap) -> None:
        self._map = channel_map
        self.blind = False
        self._conditions: dict[str, Reading] = {}
        self._overrides: dict[str, Reading] = {}
        self._at_engagement: dict[str, float] = {}  # values of the overrides at engagement
        self.watches_transmitter = any(row.transmitter for row in channel_map.conditions.values())

    def take_condition(self, name: str, raw: float, now_ns: int) -> None:
        """Take a new value of the field on which a condition depends."""
        self._conditions[name] = Reading(now_ns, raw)

    def take_override(self, name: str, raw: float, now_ns: int) -> None:
        """Take a new value of the field on which a pilot override depends."""
        self._overrides[name] = Reading(now_ns, raw)

    def engage(self, now_ns: int) -> None:
        """Store the values of the overrides at the engagement.

        An override with `moved` becomes active when its value has moved away from the stored one.
        """
        self._at_engagement = {
            name: reading.value
            for name, reading in self._overrides.items()
            if not self._is_silent(name, now_ns)
        }

    def violation(self, now_ns: int, *, awaited: bool) -> Refusal | None:
        """Say which conditions do not hold, or return None.

        If `awaited` is True, the conditions for which an engagement waits are checked. If it is
        False, all other conditions are checked.
        """
        rows = (
            (name, row)
            for name, row in self._map.conditions.items()
            if row.awaited is awaited and not (row.transmitter and self.blind)
        )
        return joined(self._violation_of(name, row, now_ns) for name, row in rows)

    def _violation_of(self, name: str, row: ConditionRow, now_ns: int) -> Refusal | None:
        reading = self._conditions.get(name)
        if stale := staleness(row.topic, reading, row.max_age, now_ns):
            return joined_faults({f"{name}: {row.field}": stale})
        if reading is None or row.is_met_by(reading.value):
            return None
        return Refusal(f"{row.sentence} ({row.field} is {reading.value:g})")

    def is_contradicted(self) -> bool:
        """Return whether the last received value contradicts a condition.

        A contradiction means that the pilot or the autopilot chose another mode, or that the
        aircraft has landed. A condition that shows the loss of the transmitter is ignored, because
        after this loss the pilot cannot take over.
        """
        rows = self._map.conditions.items()
        readings = ((row, self._conditions.get(name)) for name, row in rows if not row.transmitter)
        return any(
            reading is not None and not row.is_met_by(reading.value) for row, reading in readings
        )

    def is_active(self, name: str, now_ns: int, *, engaged: bool) -> bool:
        """Return whether a pilot override is active.

        An override is not active if its topic is silent, so that an old value does not block an
        engagement.
        """
        row = self._map.overrides[name]
        reading = self._overrides.get(name)
        if reading is None or self._is_silent(name, now_ns):
            return False
        at_engagement = self._at_engagement.setdefault(name, reading.value) if engaged else None
        return row.is_active(reading.value, at_engagement)

    def _is_silent(self, name: str, now_ns: int) -> bool:
        """Return whether the topic of an override is silent, so that the override cannot act."""
        row = self._map.overrides[name]
        return staleness(row.topic, self._overrides.get(name), row.max_age, now_ns) is not None

    def silent_overrides(self, now_ns: int) -> Refusal | None:
        """Say which overrides have no effect because their topics are silent, or return None."""
        silent = [
            f"no message on {row.topic} for {row.max_age:g} s"
            for name, row in self._map.overrides.items()
            if self._is_silent(name, now_ns)
        ]
        return Refusal(f"a pilot override has no effect: {'; '.join(silent)}") if silent else None

    def blindness(self, *, bounded: bool) -> Refusal | None:
        """Return a warning if an engagement does not notice the loss of the transmitter, else None.

        The warning also says what can still end the engagement. `bounded` says whether
        `max_engaged` ends the engagement.
        """
        if self.watches_transmitter and not self.blind:
            return None
        rows = self._map.overrides.items()
        dead = ", ".join(name for name, row in rows if row.transmitter)
        working = ", ".join(name for name, row in rows if not row.transmitter)
        conditions = ", ".join(
            name for name, row in self._map.conditions.items() if not row.transmitter
        )
        releases = (
            f"the override by {working}" if working else None,
            f"a lost condition ({conditions})" if conditions else None,
            "rise-di engage --off",
            f"max_engaged after {self._map.max_engaged:g} s" if bounded else None,
        )
        if self.watches_transmitter:
            where = "is not watched (--blind)"
        else:
            where = "cannot be seen over this link"
        blind_override = f", and the override by {dead} has no effect then" if dead else ""
        return Refusal(
            f"the loss of the transmitter {where}{blind_override}; released by "
            f"{', '.join(filter(None, releases))}"
        )


def staleness(topic: str, reading: Reading | None, max_age: float, now_ns: int) -> Stale | None:
    """Say how old a field is or that it was not received, or return None if it is fresh."""
    if reading is None:
        return Stale(f"not received yet ({topic})", is_received=False)
    age_ns = now_ns - reading.stamp_ns
    if age_ns <= nanoseconds(max_age):
        return None
    return Stale(f"{seconds(age_ns):.2f} s old ({topic})", is_received=True)


def joined_faults(faults: Mapping[str, Stale]) -> Refusal | None:
    """Join the faults of several channels, by name, to one sentence.

    Returns None if there is no fault.

    Channels with the same fault are named together.
    """
    names: dict[Stale, list[str]] = {}
    for name, fault in faults.items():
        names.setdefault(fault, []).append(name)
    reasons = []
    for fault, channels in names.items():
        verb = "is" if len(channels) == 1 else "are"
        predicate = f"{verb} {fault}" if fault.is_received else str(fault)
        reasons.append(Refusal(f"{', '.join(channels)} {predicate}"))
    return joined(reasons)
