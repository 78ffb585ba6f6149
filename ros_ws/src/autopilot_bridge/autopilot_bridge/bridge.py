# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""The bridge to an autopilot, without ROS: it makes y from messages, and setpoints from u.

It has the engagement, the pilot override and the failsafe. It reads no clock, because every instant
is an argument, in ns on the same clock. An engagement can end because y or u is too old.
"""

import math
import sys
from collections.abc import Callable
from enum import IntEnum

import numpy as np

from autopilot_bridge.channel_map import to_channel, to_raw
from autopilot_bridge.conditions import Conditions, Reading, Stale, joined_faults, staleness
from autopilot_bridge.map_rows import InputRow, MeasuredRow, OutputRow
from autopilot_bridge.params import ROUNDING, ChannelMap
from flight_core.channels import reason_against_inputs
from flight_core.outcome import Refusal, joined
from flight_core.publisher_lock import PublisherLock
from flight_core.rates import NANOSECONDS, nanoseconds, seconds
from flight_core.vectors import ChannelError, FloatArray, SampleFault, StampedVector, require_newer

UNBOUNDED = Refusal(
    "the loss of the transmitter cannot be seen over this link: set max_engaged in the "
    "map, or engage with --blind"
)
# If a u does not change and exceeds this share of the map's limits, it counts as being at a limit
# of the law. The amplitudes of experiments are smaller.
LARGE = 0.5
# time from the warning to the end of an engagement by `max_engaged`
END_WARNING_NS = 10 * NANOSECONDS


class Phase(IntEnum):
    """The phase of the engagement. It determines what the bridge sends."""

    DISENGAGED = 0  # nothing is sent
    ENGAGED = 1  # u is sent
    NEUTRAL = 2  # failsafe: u has timed out, and the neutral values are sent
    RELEASE = 3  # release values are sent, which return the channels to the autopilot
    ENGAGING = 4  # heartbeats and requests are sent until the awaited conditions hold


def trim_key(name: str) -> str:
    """Return the name of the channel with the trim of an input, for `Bridge.take_output`.

    The map names the field of the autopilot from which this trim is read.
    """
    return f"trim of {name}"


class Bridge:
    """The state of a bridge: the newest y and u, the phase of the engagement, and pilot overrides.

    Only a call of `engage` engages the bridge. It never engages again by itself.
    """

    def __init__(self, channel_map: ChannelMap, *, dry_run: bool) -> None:
        self.channel_map = channel_map
        self.dry_run = dry_run
        self.outputs = tuple(channel_map.outputs)
        self.inputs = tuple(channel_map.inputs)
        self.phase = Phase.DISENGAGED
        # Why the bridge is not engaged, or for what an engagement still waits.
        self.reason: Refusal | None = Refusal("not engaged yet")
        # A reason that refuses and ends an engagement, such as another publisher. The node sets
        # this.
        self.conflict: Refusal | None = None
        # A reason that refuses an engagement but does not end one yet, such as a slow rate of the
        # link. The node sets this.
        self.problem: Refusal | None = None
        sources = {trim_key(name): row for name, row in channel_map.trims.items()}
        self._rows: dict[str, MeasuredRow] = {
            **channel_map.pose,
            **channel_map.sensors,
            **channel_map.outputs,
            **sources,
        }
        self._readings: dict[str, Reading] = {}
        self._zero: dict[str, float] = {}  # value at engagement of each captured output
        self._trim: dict[str, float] = {}  # trim at engagement of each captured input
        self._last_y_ns = -1  # stamp of the last y
        self._last_pose_ns = -1  # stamp of the last pose
        self._u: FloatArray = np.zeros(len(self.inputs))
        # Whether each input of the newest u differs from the previous u.
        self._moves = np.ones(len(self.inputs), dtype=bool)
        self.u_lock = PublisherLock(self._u_timeouts_ns)
        self.conditions = Conditions(channel_map)
        self._parameters: dict[str, float] = {}
        self._phase_ns = 0  # instant at which the phase began
        # Whether a release leaves the autopilot in its mode. It does if the pilot chose the mode,
        # or if no u was sent yet.
        self._keeps_mode = True
        self._limit_ns: dict[str, int] = {}  # instants since which inputs are at a limit
        self._end_ns: int | None = None  # instant at which `max_engaged` ends the engagement
        rows = channel_map.inputs.values()
        self._lower = np.array([row.lower for row in rows])
        self._upper = np.array([row.upper for row in rows])
        self._max_age_ns = nanoseconds(channel_map.silence.max_age)
        self._max_y_age_ns = nanoseconds(max(row.max_age for row in channel_map.outputs.values()))

    # Inputs

    def take_output(self, name: str, raw: float, stamp_ns: int, now_ns: int) -> None:
        """Take a value of a channel of y, of a channel of the pose, or of the trim of an input.

        The channel becomes sign scale raw + offset, after the low-pass filter of its row if there
        is one. Raises ChannelError with the reason "stamp" if the stamp differs from the present by
        more than the age limit. The reason is "order" if the stamp is not later than the previous
        one.
        """
        row = self._rows[name]
        if abs(now_ns - stamp_ns) > nanoseconds(row.max_age):
            if row.stamp == "arrival":
                hint = ""
            else:
                hint = "; set stamp: arrival in the map if the autopilot has another clock"
            side = "before" if stamp_ns < now_ns else "after"
            raise ChannelError(
                SampleFault.STAMP,
                f"{name} is stamped {seconds(abs(now_ns - stamp_ns)):.3f} s {side} now{hint}",
            )
        last = self._readings.get(name)
        value = to_channel(raw, row.conversion)
        if last is not None:
            require_newer(stamp_ns, last.stamp_ns, name)
            if isinstance(row, OutputRow) and row.low_pass > 0.0:
                value = last.value - math.expm1(
                    -seconds(stamp_ns - last.stamp_ns) / row.low_pass
                ) * (value - last.value)
        self._readings[name] = Reading(stamp_ns, value)

    def _u_timeouts_ns(self) -> tuple[int, int]:
        """Return how long the publisher of u must be silent until another may take over, ns.

        The first value is for the same node in a new process, and the second for another node.
        While the bridge is engaged, no publisher may take over, because u would jump. In this phase
        a u that is too old ends the engagement.
        """
        takeover_ns = sys.maxsize if self.phase is Phase.ENGAGED else self._max_age_ns
        return takeover_ns, takeover_ns

    def max_u_age_ns(self) -> int:
        """Return the age limit of a u, ns.

        The age is measured from the stamp of u, which is the instant of its y. This limit prevents
        the playback of a log from flying the autopilot.
        """
        return self._max_age_ns + self._max_y_age_ns

    def take_u(self, sample: StampedVector, now_ns: int) -> None:
        """Take u, shape (m,), in the map's order, from the publisher that `u_lock` admits."""
        self._moves = sample.value != self._u
        self._u = sample.value

    def take_effects(self, sample: StampedVector, now_ns: int) -> None:
        """Take the effect of each input, (m,), as the controller's probe has found it.

        The inputs are in the order of the map. If an input has no effect, an engagement ends.
        """
        stuck = reason_against_inputs(self.inputs, sample.value.tolist())
        if stuck and self.phase is Phase.ENGAGED:
            self.disengage(stuck, now_ns)

    def take_condition(self, name: str, raw: float, now_ns: int) -> None:
        """Take a new value of the field on which a condition depends.

        If the condition does not hold any more, the next step ends an engagement.
        """
        self.conditions.take_condition(name, raw, now_ns)

    def take_parameter(self, name: str, value: float) -> None:
        """Take the value of a parameter of the autopilot."""
        self._parameters[name] = value

    def take_override(self, name: str, raw: float, now_ns: int) -> None:
        """Take a new value of the field on which a pilot override depends.

        If the value is beyond the threshold of the override, the bridge disengages immediately.
        """
        self.conditions.take_override(name, raw, now_ns)
        if self._is_active(name, now_ns):
            self.disengage(Refusal(f"pilot override by {name}"), now_ns, by_pilot=True)

    # State

    def stale(self, now_ns: int) -> dict[str, Stale]:
        """Return the stale channels of y and of the envelope, each with its fault.

        An example of a fault is "0.30 s old (/topic)".
        """
        watched = dict.fromkeys((*self.outputs, *self.channel_map.envelope))
        return {name: reason for name in watched if (reason := self._staleness(name, now_ns))}

    def _staleness(self, name: str, now_ns: int) -> Stale | None:
        """Return the fault of a channel that is too old, or None if the channel is fresh.

        A channel with `held` in the map is never too old, because y repeats its last value.
        """
        row = self._rows[name]
        if isinstance(row, OutputRow) and row.held and name in self._readings:
            return None
        return staleness(row.topic, self._readings.get(name), row.max_age, now_ns)

    def _reason_against_values(self, section: str = "envelope") -> Refusal | None:
        """Say which channels are outside the limits that a section of the map gives for them.

        All channels of the section must have been received before. Returns None if all are inside.
        """
        what = "the envelope" if section == "envelope" else section
        values = (
            (name, self._value(name), limits)
            for name, limits in getattr(self.channel_map, section).items()
        )
        return joined(
            Refusal(f"{name} is {value:.3g}, outside {what} [{lower:g}, {upper:g}]")
            for name, value, (lower, upper) in values
            if not lower <= value <= upper
        )

    def _reason_against_inputs(self, now_ns: int) -> Refusal | None:
        """Say which inputs have stayed at a limit for longer than their rows allow, or return None.

        The aircraft does not answer to such an input any more. The limits of the law may be
        narrower than the limits in the map, so a large u that does not change is also taken to be
        at a limit.
        """
        reasons = []
        inside, small = (
            (factor * self._lower < self._u) & (self._u < factor * self._upper)
            for factor in (1.0, LARGE)
        )
        for name, answers in zip(self.inputs, inside & (small | self._moves), strict=True):
            row = self.channel_map.inputs[name]
            if row.at_limit is None or answers:
                self._limit_ns.pop(name, None)
            elif now_ns - self._limit_ns.setdefault(name, now_ns) >= nanoseconds(row.at_limit):
                reasons.append(
                    Refusal(
                        f"{name} is at its limit for {row.at_limit:g} s, {row.motion[0]} does not "
                        "answer"
                    )
                )
        return joined(reasons)

    def _reason_against_commands(self, now_ns: int) -> Refusal | None:
        """Say why the autopilot must not be commanded any more, whatever y and u are."""
        violations = (
            self.conditions.violation(now_ns, awaited=awaited) for awaited in (False, True)
        )
        return joined((self.conflict, *violations))

    def _is_active(self, name: str, now_ns: int) -> bool:
        is_engaged = self.phase in {Phase.ENGAGED, Phase.NEUTRAL}
        return self.conditions.is_active(name, now_ns, engaged=is_engaged)

    def _lack(self, now_ns: int) -> Refusal | None:
        """Return the warning of an engaged bridge, or None if there is nothing to warn of.

        The bridge warns if `max_engaged` will soon end the engagement, if there is a `problem`, and
        if overrides get no messages. It also warns if it cannot notice the loss of the transmitter.
        """
        warning = None
        if self._end_ns is not None and now_ns >= self._end_ns - END_WARNING_NS:
            warning = Refusal(
                f"max_engaged releases in {seconds(END_WARNING_NS):g} s, unless engaged again"
            )
        silent = self.conditions.silent_overrides(now_ns)
        blindness = self.conditions.blindness(bounded=self._end_ns is not None)
        return joined((warning, self.problem, silent, blindness))

    def has_u_timed_out(self, now_ns: int) -> bool:
        """Return whether the last u is older than its age limit, or no u was received yet."""
        return self.u_lock.has_timed_out(now_ns, self._max_age_ns)

    def _u_timeout(self, now_ns: int) -> Refusal | None:
        """Say why u is too old or absent, or return None if it is fresh."""
        if self.u_lock.publisher is None:
            return Refusal("u not received yet")
        if self.has_u_timed_out(now_ns):
            return Refusal(f"u is {seconds(self.u_lock.age_ns(now_ns)):.2f} s old")
        return None

    def reason_against_engagement(self, now_ns: int) -> Refusal | None:
        """Say why `engage` would be refused now, or return None.

        Conditions for which an engagement waits are no such reason. If the bridge makes a dry run,
        the text says first that nothing is sent, and then the reason that would remain with
        `dry_run: false`.
        """
        checks: tuple[Callable[[], Refusal | None], ...] = (
            lambda: self.conflict,
            lambda: self._active_overrides(now_ns),
            lambda: self.conditions.violation(now_ns, awaited=False),
            lambda: self.problem,
            self._reason_against_parameters,
            self._reason_against_endless_engagement,
            lambda: self._stale_inputs(now_ns),
            self._reason_against_values,
            lambda: self._reason_against_values("engage_if"),
            self._reason_against_u,
            lambda: joined(map(self._reason_against_trim, self.channel_map.trims)),
        )
        dry_run = Refusal("dry_run is true: nothing is sent") if self.dry_run else None
        return joined((dry_run, next(filter(None, (check() for check in checks)), None)))

    def _reason_against_endless_engagement(self) -> Refusal | None:
        is_bounded = bool(self.channel_map.max_engaged)
        if is_bounded or self.conditions.blind or self.conditions.watches_transmitter:
            return None
        return UNBOUNDED

    def _reason_against_parameters(self) -> Refusal | None:
        """Say which parameters of the autopilot prevent the engagement."""
        reasons = []
        for name, row in self.channel_map.parameters.items():
            value = self._parameters.get(name)
            lower, upper = row.within
            if value is None:
                reasons.append(
                    Refusal(
                        f"{name} not received yet: the autopilot does not answer, or has no such "
                        "parameter"
                    )
                )
            elif not lower <= value <= upper:
                reasons.append(
                    Refusal(f"{name} is {value:g}, expected {lower:g} to {upper:g}: {row.sentence}")
                )
        return joined(reasons)

    def _active_overrides(self, now_ns: int) -> Refusal | None:
        active = [name for name in self.channel_map.overrides if self._is_active(name, now_ns)]
        return Refusal(f"pilot override active: {', '.join(active)}") if active else None

    def _stale_inputs(self, now_ns: int) -> Refusal | None:
        """Say which of the values that an engagement needs are stale, or return None.

        An engagement needs y, the envelope, the conditions of `engage_if`, the trims that the
        autopilot sends, and u.
        """
        keys = (*map(trim_key, self.channel_map.trims), *self.channel_map.engage_if)
        sources = {key: stale for key in keys if (stale := self._staleness(key, now_ns))}
        return joined((joined_faults(self.stale(now_ns) | sources), self._u_timeout(now_ns)))

    def _reason_against_u(self) -> Refusal | None:
        """Say which input is too far from trim to engage, or return None."""
        limits = self.channel_map.engage_within * np.where(self._u > 0.0, self._upper, -self._lower)
        for name, u, limit in zip(self.inputs, self._u, limits, strict=True):
            if abs(u) > limit:
                return Refusal(
                    f"u.{name} is {u:.3g} from trim, more than {limit:.3g}: deactivate the "
                    "controller until u is at trim"
                )
        return None

    def _reason_against_trim(self, name: str) -> Refusal | None:
        """Return a refusal of the trim that the autopilot sends for an input, or None.

        It is refused if the trim plus a limit of u lies outside the range of the field.
        """
        row = self.channel_map.inputs[name]
        trim = self.trim(name)
        (low, high), ends = row.range, (trim + row.lower, trim + row.upper)
        if all(low - ROUNDING <= to_raw(end, row.conversion) <= high + ROUNDING for end in ends):
            return None
        return Refusal(
            f"{name}: its trim is {trim:.3g} now, and the limits [{row.lower:g}, "
            f"{row.upper:g}] around it leave its range"
        )

    def engage(self, now_ns: int, *, blind: bool = False) -> Refusal | None:
        """Engage or begin to engage, or return the reason why not.

        The attribute `phase` shows whether the bridge is engaged already or still begins to engage.
        If `blind` is True, the engagement ignores a loss of the transmitter, and has no time limit.
        A request while the bridge is engaged starts the time of `max_engaged` again.
        """
        if self.phase is Phase.ENGAGED:
            self.conditions.blind |= blind
            self._begin_time(now_ns)
        if self.phase in {Phase.ENGAGED, Phase.ENGAGING}:
            return None
        before = self.conditions.blind
        self.conditions.blind = blind
        if refusal := self.reason_against_engagement(now_ns):
            self.conditions.blind = before
            return refusal
        self._enter(Phase.ENGAGING, now_ns)
        self._continue_engagement(now_ns)
        return None

    def _begin_time(self, now_ns: int) -> None:
        bound = None if self.conditions.blind else self.channel_map.max_engaged
        self._end_ns = None if bound is None else now_ns + nanoseconds(bound)

    def _continue_engagement(self, now_ns: int) -> None:
        """Engage as soon as the conditions hold for which an engagement waits.

        The bridge stops waiting when the time to wait is over, or if there is another reason
        against an engagement.
        """
        self.reason = self.conditions.violation(now_ns, awaited=True)
        timed_out = now_ns - self._phase_ns > nanoseconds(self.channel_map.engage_timeout)
        if refusal := self.reason_against_engagement(now_ns):
            self.disengage(refusal, now_ns)
        elif self.reason is not None and timed_out:
            timeout = f"{self.channel_map.engage_timeout:g} s"
            self.disengage(Refusal(f"{self.reason}, after {timeout}"), now_ns)
        elif self.reason is None:
            self._trim = {name: self.trim(name) for name in self.channel_map.trims}
            self._zero = {
                name: self._readings[name].value
                for name, row in self.channel_map.outputs.items()
                if row.captured
            }
            self.conditions.engage(now_ns)
            self._enter(Phase.ENGAGED, now_ns)

    def disengage(self, reason: Refusal, now_ns: int, *, by_pilot: bool = False) -> None:
        """Disengage from any phase, and return the channels to the autopilot.

        If `by_pilot` is True, the pilot has requested this, and the autopilot's mode stays as it
        is.
        """
        self._keeps_mode |= by_pilot
        if self.phase not in {Phase.DISENGAGED, Phase.RELEASE}:
            self.reason = reason
            self._enter(Phase.RELEASE, now_ns)

    def step(self, now_ns: int) -> Phase:
        """Advance the engagement to an instant, and return the phase.

        ENGAGED becomes NEUTRAL if u has timed out. It becomes RELEASE if y is stale, if a value is
        outside the envelope, or if an input stays at its limit. It also becomes RELEASE if a
        condition is lost, if there is a second publisher, or if the time `max_engaged` is over.
        ENGAGING, NEUTRAL and RELEASE end after their times. NEUTRAL also ends if a condition is
        lost or if there is a second publisher.
        """
        if self.phase is Phase.ENGAGING:
            self._continue_engagement(now_ns)
        elif self.phase is Phase.NEUTRAL and (reason := self._reason_against_commands(now_ns)):
            self.disengage(reason, now_ns)
        elif self.phase is Phase.ENGAGED:
            faults = joined_faults(self.stale(now_ns))
            cause = self.problem if faults else None
            lost = joined((self._reason_against_commands(now_ns), faults, cause))
            outside = lost or self._reason_against_values()
            if end_reason := outside or self._reason_against_inputs(now_ns):
                self.disengage(end_reason, now_ns)
            elif timeout := self._u_timeout(now_ns):
                self.reason = timeout
                self._enter(Phase.NEUTRAL, now_ns)
            elif self._end_ns is not None and now_ns >= self._end_ns:
                length = f"{self.channel_map.max_engaged:g} s"
                self.disengage(Refusal(f"engaged for {length}, max_engaged of the map"), now_ns)
            else:
                self.reason = self._lack(now_ns)
        times = self.channel_map.silence
        if self.phase is Phase.NEUTRAL and now_ns - self._phase_ns >= nanoseconds(times.neutral):
            self._enter(Phase.RELEASE, now_ns)
        if self.phase is Phase.RELEASE and now_ns - self._phase_ns >= nanoseconds(times.release):
            self._enter(Phase.DISENGAGED, now_ns)
        return self.phase

    # Outputs

    def y(self, now_ns: int) -> StampedVector | None:
        """Return a new sample of y, stamped with the instant of one output.

        The map names this output as `instant`. Returns None if this sample has been returned
        before, or if a channel is stale.
        """
        newest = self._readings.get(self.channel_map.instant)
        if (
            newest is None
            or newest.stamp_ns <= self._last_y_ns
            or any(self._staleness(name, now_ns) for name in self.outputs)
        ):
            return None
        self._last_y_ns = newest.stamp_ns
        return StampedVector(
            newest.stamp_ns, np.array([self._value(name) for name in self.outputs])
        )

    def _value(self, name: str) -> float:
        """Return the newest value of a channel of y.

        A captured output is the change since the engagement. It is 0 before the engagement.
        """
        value = self._readings[name].value
        row = self.channel_map.outputs.get(name)
        if row is None or not row.captured:
            return value
        return value - self._zero[name] if self._is_captured() else 0.0

    def _is_captured(self) -> bool:
        """Return whether the trims are held at their values at the engagement.

        In other phases the trims follow the values that the autopilot sends.
        """
        return self.phase in {Phase.ENGAGED, Phase.NEUTRAL, Phase.RELEASE} and bool(
            self._zero or self._trim
        )

    def trim(self, name: str) -> float:
        """Return the trim of an input.

        If `trims` in the map has a field for it, the trim follows this field until the bridge
        engages.
        """
        row = self.channel_map.inputs[name]
        source = self._readings.get(trim_key(name))
        if name in self._trim and self._is_captured():
            return self._trim[name]
        return row.trim if source is None else to_channel(source.value, row.conversion)

    def pose(self, now_ns: int) -> tuple[tuple[str, ...], StampedVector] | None:
        """Return the names and the values of the pose's fresh channels.

        Their stamp is the stamp of the first row of the pose in the map. Returns None if this stamp
        is not new. psi is in -pi..pi. A channel is left out if it is stale or has not been received
        yet.
        """
        first = next(iter(self.channel_map.pose), None)
        newest = None if first is None else self._readings.get(first)
        if newest is None or newest.stamp_ns <= self._last_pose_ns:
            return None
        self._last_pose_ns = newest.stamp_ns
        names = tuple(name for name in self.channel_map.pose if not self._staleness(name, now_ns))
        values = {name: self._readings[name].value for name in names}
        if "psi" in values:
            values["psi"] = math.remainder(values["psi"], math.tau)
        return names, StampedVector(newest.stamp_ns, np.array(list(values.values())))

    def raw_u(self) -> FloatArray:
        """Return the newest u, limited and converted to the raw values of the fields, (m,).

        Before the conversion, the values are trim + min(max(u, lower), upper).
        """
        u = np.minimum(np.maximum(self._u, self._lower), self._upper)
        return np.array(
            [self._raw(name, u_i) for name, u_i in zip(self.inputs, u.tolist(), strict=True)]
        )

    def _raw(self, name: str, u: float) -> float:
        return to_raw(self.trim(name) + u, self.channel_map.inputs[name].conversion)

    def raw(self) -> FloatArray:
        """Return the raw values of the inputs that are sent in this phase, (m,)."""
        if self.phase is Phase.ENGAGED:
            return self.raw_u()
        return np.array([self._resting(name, row) for name, row in self.channel_map.inputs.items()])

    def _resting(self, name: str, row: InputRow) -> float:
        """Return the raw value of an input outside the phase ENGAGED: neutral or release value."""
        if self.phase is not Phase.NEUTRAL:
            return math.nan if row.release is None else row.release
        return self._raw(name, 0.0) if row.neutral == "trim" else row.neutral

    def is_sent(self, name: str, now_ns: int) -> bool:
        """Return whether a message of the map is sent in this phase. A dry run sends no message."""
        if self.dry_run:
            return False
        when = self.channel_map.messages[name].when
        phase = self.phase
        if when == "heartbeat":
            return phase in {Phase.ENGAGING, Phase.ENGAGED, Phase.NEUTRAL}
        if when == "engaging":
            return phase is Phase.ENGAGING
        if when == "release":
            return phase is Phase.RELEASE and not self.conditions.violation(now_ns, awaited=True)
        if when == "failsafe":
            return phase is Phase.RELEASE and not (
                self._keeps_mode or self.conditions.is_contradicted()
            )
        releases = [row.release for row in self.channel_map.inputs.values() if row.message == name]
        return phase in {Phase.ENGAGED, Phase.NEUTRAL} or (
            phase is Phase.RELEASE and None not in releases
        )

    def _enter(self, phase: Phase, now_ns: int) -> None:
        self.phase = phase
        self._phase_ns = now_ns
        if phase in {Phase.ENGAGING, Phase.ENGAGED}:
            self._keeps_mode = phase is Phase.ENGAGING
        if phase is Phase.ENGAGED:
            self._limit_ns = {}
            self._begin_time(now_ns)
            self.reason = self._lack(now_ns)
        elif phase in {Phase.RELEASE, Phase.DISENGAGED}:
            self.conditions.blind = False
