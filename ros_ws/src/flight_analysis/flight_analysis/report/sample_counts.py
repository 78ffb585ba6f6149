# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""The samples of a flight by topic: how many its log should hold, how many it holds, and how many
were never sent.
"""

import math
import re
from typing import NamedTuple

import numpy as np

from flight_analysis.closed_loop.scenario import Scenario
from flight_core.modes import Mode
from flight_core.rates import NANOSECONDS, nanoseconds, period_ns, seconds
from flight_core.tape import Recording, Signal, Tape
from flight_log.clock import SINCE_EPOCH_NS
from flight_log.flight_processes import controller_starts

# least share of the samples of a topic without a remark, unless a single one is missing
WHOLE = 0.99
LEAST = 0.9  # a smaller share of a topic is a lack of the log, whatever the cause
LATE_TICK_NS = NANOSECONDS // 10  # the last u of a whole flight may be so much older than its end
GUIDED = ("guidance", "u_m")  # topics of guidance
# of a process that is the simulated aircraft of the stack
AIRCRAFT = re.compile(r"/aircraft(#\d+)?$")
OF_AIRCRAFT = ("truth", "pose")  # topics of the aircraft beside y, with its stamps
TICKS = ("u", "internals")  # topics of the controller: their stamps rest during a failsafe
# topics with a rate of the scenario
RATED = ("y", "y_m", "u", "internals", "truth", "pose", "guidance", "u_m")


class TopicAccount(NamedTuple):
    """The samples of a topic. Times in s of flight time; None without a sample."""

    expected: int | None  # None: unknown, as in a log without the rates or the begin of its flight
    found: int
    first: float | None
    last: float | None
    gap: float | None  # longest interval between two samples
    gap_at: float | None  # begin of the interval
    # samples with the stamp of the sample before, except in a failsafe; not among `found`
    repeated: int
    unset: int  # samples without a usable stamp, left out
    step: float  # of the clock of the stamps, s; 0 without a step
    left_out: int  # samples after the step
    # samples that the publisher left out on a busy host, by the numbers of the messages
    unsent: int

    @property
    def share(self) -> float | None:
        """Share of the expected samples, at most 1; None where the number is unknown."""
        return None if self.expected is None else min(self.found / max(self.expected, 1), 1.0)

    def holds(self, count: int) -> bool:
        """Whether `count` samples are the whole topic, or their expected number is unknown.

        One missing sample is no lack of a short topic: the first or the last instant of a flight
        may fall on either side of its begin or end.
        """
        return self.expected is None or count >= min(
            WHOLE * self.expected, max(self.expected - 1, 1)
        )


class Span(NamedTuple):
    """The part of a flight that the account is over."""

    end_ns: int  # stamp of the end
    from_start: bool  # from t = 0; else from the first sample of a topic
    simulated: bool  # the aircraft of the scenario flew, no autopilot


def topic_accounts(
    tape: Tape, scenario: Scenario | None, span: Span
) -> tuple[dict[str, TopicAccount], dict[str, float]]:
    """The accounts by topic, and how long before the end a last sample may be stamped, s.

    The expected number of samples is rate times time. Ticks of the controller count from the first,
    without the ticks that a busy host left out, up to a tenth of the ticks.
    """
    expected = {} if scenario is None else _expected(tape, scenario, span)
    names = [*dict.fromkeys([*(name for name in tape.signals if name in RATED), *expected])]
    begin_ns = tape.start_ns if span.from_start else None
    topics = {name: _topic(tape, name, expected.get(name), begin_ns, span.end_ns) for name in names}
    late = {} if scenario is None else _latest(scenario)
    has_clock = tape.start_ns > SINCE_EPOCH_NS and not any(
        clock.step_ns for clock in tape.recording.values()
    )
    if scenario is not None and has_clock:  # in real time
        for name, step_ns in _periods(tape, scenario, simulated=span.simulated).items():
            if ends_last(tape, name):
                continue
            topics[name] = _with_unsent(tape, name, topics[name], step_ns)
            if unsent_at_end := _unsent_rest(tape, name, step_ns, span.end_ns):
                topics[name] = topics[name]._replace(unsent=topics[name].unsent + unsent_at_end)
                late[name] = seconds(span.end_ns)
    failsafe = 0
    if "internals" in tape and "mode" in tape["internals"].names:
        failsafe = int(np.count_nonzero(tape["internals"]["mode"] != Mode.ENGAGED))
    for name, topic in topics.items():
        # Stamps rest during a failsafe. Further equal stamps are of a clock that stands, and no
        # sample is known to be new.
        repeated = max(topic.repeated - (failsafe if name in TICKS else 0), 0)
        topics[name] = topic._replace(found=max(topic.found - repeated, 0), repeated=repeated)
    return topics, late


def _expected(tape: Tape, scenario: Scenario, span: Span) -> dict[str, int]:
    """The number of samples by topic that the log of a flight should hold, where this is known."""
    sensors = scenario.aircraft.sensors
    pose = scenario.aircraft.pose
    expected = {}
    delays = {"y": sensors.delay, "pose": pose.delay}
    for name, step_ns in _periods(tape, scenario, simulated=span.simulated).items():
        first_ns = tape.start_ns
        if not span.from_start and name in tape:
            first_ns = int(tape[name].stamp_ns[0])
        delay_ns = nanoseconds(delays.get(name, 0.0))
        count = max((span.end_ns - delay_ns - first_ns) // step_ns + 1, 0)
        if name == "y" and sensors.dropout:
            mean = count * (1.0 - sensors.dropout)
            count = max(math.floor(mean - 4.0 * math.sqrt(mean * sensors.dropout)), 0)
        expected[name] = count
    if not span.simulated:  # the controller is inactive until the bridge engages
        return expected
    ticks, engaged = _ticks(
        tape, period_ns(scenario.controller.rate, "controller.rate"), span.end_ns
    )
    expected |= dict.fromkeys(TICKS, ticks)
    if scenario.guidance is not None:
        before_pose = math.ceil(pose.delay * scenario.guidance.rate)
        steps = max(
            math.floor(engaged * scenario.guidance.rate / scenario.controller.rate)
            - 2
            - before_pose,
            0,
        )
        expected |= dict.fromkeys(GUIDED, steps)
    return expected


def _periods(tape: Tape, scenario: Scenario, *, simulated: bool) -> dict[str, int]:
    """Periods of the topics with a sample at each instant of a rate, ns.

    A foreign aircraft has the rates of the log, and may have no truth and no pose.
    """
    periods = {"y_m": period_ns(scenario.reference_model.rate, "reference_model.rate")}
    if not simulated:
        return periods
    y_ns = period_ns(scenario.aircraft.rate, "aircraft.rate")
    aircraft_periods = {"y": y_ns, "truth": y_ns, "pose": scenario.aircraft.pose_every() * y_ns}
    is_of_stack = _is_of_stack(tape)
    recorded = {"y", *tape.signals, *tape.recording, *(["truth"] if is_of_stack else [])}
    for name, step_ns in aircraft_periods.items():
        if name in recorded:
            periods[name] = step_ns if is_of_stack else _period_in_log(tape, name, step_ns)
    return periods


def _is_of_stack(tape: Tape) -> bool:
    """Whether the simulated aircraft of the stack flew, by the names of the processes; a flight in
    one process has no names.
    """
    if tape.processes:
        return any(AIRCRAFT.search(name) for name in tape.processes)
    return tape.duration is not None or "truth" in tape.recording


def _period_in_log(tape: Tape, name: str, otherwise: int) -> int:
    """The median interval of the samples of a topic, by the numbers of the messages without the
    lost messages, ns.
    """
    intervals_ns = np.diff(tape[name].stamp_ns) if name in tape else np.zeros(0)
    if not np.any(intervals_ns > 0):
        return otherwise
    lost = tape.recording.get(name, Recording(0)).lost or 0
    share = (len(intervals_ns) + 1) / (len(intervals_ns) + 1 + lost)
    median_ns = float(np.median(intervals_ns[intervals_ns > 0]))
    return max(round(median_ns * share) if share < LEAST else round(median_ns), 1)


def _with_unsent(tape: Tape, name: str, topic: TopicAccount, step_ns: int) -> TopicAccount:
    """The account of a topic with the instants between the first and the last sample that the
    publisher left out.

    The numbers of the messages are the proof: no number is missing beside lost messages and samples
    left out.
    """
    recording = tape.recording.get(name, Recording(0))
    if (
        topic.first is None
        or topic.last is None
        or recording.lost is None
        or topic.expected is None
    ):
        return topic
    instants = round((topic.last - topic.first) * NANOSECONDS / step_ns) + 1
    stored = topic.found + recording.lost + recording.unset + tape.refused.get(name, 0)
    return topic._replace(unsent=max(instants - stored, 0))


def ends_last(tape: Tape, name: str) -> bool:
    """Whether a topic ends later than every further topic of the flight: a leap of the clock may be
    the gap.
    """
    ends = {
        topic: int(signal.stamp_ns[-1])
        for topic, signal in tape.signals.items()
        if topic in RATED and len(signal.stamp_ns)
    }
    further = [end_ns for topic, end_ns in ends.items() if topic != name]
    return bool(further) and ends.get(name, 0) > max(further) + LATE_TICK_NS


def _unsent_rest(tape: Tape, name: str, step_ns: int, end_ns: int) -> int:
    """The number of instants from the last sample of a topic to the end, where the publisher left
    them out.

    The numbers of the messages are the proof: the next sample comes after the end, or the aircraft
    sent y at further instants alone. A log that ends with the topic proves nothing.
    """
    signal = tape.signals.get(name)
    if signal is None or tape.recording.get(name, Recording(0)).lost != 0:
        return 0
    held_ns = signal.until(end_ns).stamp_ns
    if not len(held_ns):
        return 0
    last_ns = int(held_ns[-1])
    if len(signal.stamp_ns) > len(held_ns):
        return max((end_ns - last_ns) // step_ns, 0)
    if (
        name not in OF_AIRCRAFT
        or "y" not in tape
        or tape.recording.get("y", Recording(0)).lost != 0
    ):
        return 0
    later_ns = tape["y"].until(end_ns).stamp_ns - last_ns
    was_sent = bool(np.any((later_ns > 0) & (later_ns % step_ns == 0)))
    return 0 if was_sent else max(int(later_ns[-1]) // step_ns, 0)


def _ticks(tape: Tape, step_ns: int, end_ns: int) -> tuple[int, float]:
    """The number of ticks of the controller up to the end, and the number of engaged ticks."""
    begins = [
        int(tape[name].stamp_ns[0]) for name in TICKS if name in tape and len(tape[name].stamp_ns)
    ]
    if not begins:
        return max((end_ns - tape.start_ns) // step_ns + 1, 0), 0.0
    begin_ns = min(begins)
    instants = max((end_ns - begin_ns) // step_ns + 1, 1)
    if "internals" not in tape or not {"number", "age", "mode"} <= set(tape["internals"].names):
        return instants, float(instants)
    log = tape["internals"].until(end_ns)
    if not len(log.stamp_ns):
        return instants, float(instants)
    count = instants
    if "y" in tape and not _is_of_stack(tape):
        count = min(instants, _instants_with_y(tape, log, step_ns))
    by_controller = np.split(log["number"], controller_starts(log["number"]))
    missing = sum(float(np.ptp(numbers)) + 1.0 - len(numbers) for numbers in by_controller)
    before = float(by_controller[0].min()) - 1.0
    last_ns = int(log.stamp_ns[-1]) + round(float(log["age"][-1]) * NANOSECONDS)
    goes_on = int(tape["internals"].stamp_ns[-1]) > end_ns
    after = 0 if goes_on else max((end_ns - last_ns) // step_ns, 0) * count // instants
    ticks = int(len(log.stamp_ns) + max(missing, 0.0) + before + after)
    ticks = count if ticks < LEAST * count else ticks
    engaged = float(np.mean(log["mode"] == Mode.ENGAGED))
    return ticks, engaged * ticks * instants / count


def _instants_with_y(tape: Tape, internals: Signal, step_ns: int) -> int:
    """The number of ticks with a new y or in a failsafe: a foreign aircraft has a rate of y of its
    own, and the controller publishes u with a new y alone.
    """
    age_ns = internals["age"] * NANOSECONDS
    first_tick_ns = internals.stamp_ns[0] + age_ns[0]
    y = tape["y"].until(int(internals.stamp_ns[-1]))
    arrival_ns = y.stamp_ns[y.stamp_ns >= internals.stamp_ns[0]] + age_ns.min()
    with_y = len(np.unique((arrival_ns - first_tick_ns) // step_ns))
    lost = tape.recording.get("y", Recording(0)).lost or 0
    return with_y + lost + int(np.count_nonzero(internals["mode"] != Mode.ENGAGED))


def _topic(
    tape: Tape, name: str, expected: int | None, begin_ns: int | None, end_ns: int
) -> TopicAccount:
    recording = tape.recording.get(name, Recording(0))
    signal = tape.signals.get(
        name, Signal(np.zeros(0, dtype=np.int64), (), np.zeros((0, 0)))
    ).until(end_ns)
    early = 0 if begin_ns is None else int(np.searchsorted(signal.stamp_ns, begin_ns))
    count = len(signal.stamp_ns)
    t = (signal.stamp_ns - tape.start_ns) / NANOSECONDS
    gaps = np.diff(t)
    longest = int(np.argmax(gaps)) if len(gaps) else None
    return TopicAccount(
        expected, count - early,
        float(t[0]) if count else None, float(t[-1]) if count else None,
        None if longest is None else float(gaps[longest]),
        None if longest is None else float(t[longest]),
        recording.repeated if recording.found else int(np.count_nonzero(gaps == 0.0)),
        recording.unset, seconds(recording.step_ns), recording.left_out, 0,
    )  # fmt: skip


def _latest(scenario: Scenario) -> dict[str, float]:
    """How long before the end the last sample of a topic may be stamped, s: the delay, and the
    period of a slow pose.
    """
    aircraft = scenario.aircraft
    return {
        "y": aircraft.sensors.delay,
        "pose": aircraft.pose.delay + aircraft.pose_every() / aircraft.rate,
    }
