# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Count, for each topic of a flight, the samples that were planned, logged and never sent."""

import math
import re
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from flight_analysis.closed_loop.scenario import Scenario
from flight_core.modes import Mode
from flight_core.rates import NANOSECONDS, nanoseconds, period_ns, seconds
from flight_core.tape import Recording, Signal, Tape
from flight_log.clock import SINCE_EPOCH_NS
from flight_log.flight_processes import controller_starts

# share of its samples from which on a topic counts as whole; a single missing sample does not count
WHOLE = 0.99
LEAST = 0.9  # with a smaller share, the log lacks the topic, whatever the cause
SILENCE = 1.0  # s; a longer gap is named even if the share is large
LATE_TICK_NS = NANOSECONDS // 10  # largest age of the last u at the end of a whole flight
GUIDED = ("guidance", "u_m")  # topics of guidance
OF_AIRCRAFT = ("truth", "pose")  # further topics of the aircraft, with the stamps of y
TICKS = ("u", "internals")  # topics of the controller, whose stamps stand still in a failsafe
# the node of the stack that sends each topic with a rate
SENDERS = {
    "y": "aircraft",
    "y_m": "reference_model",
    **dict.fromkeys(TICKS, "controller"),
    **dict.fromkeys(OF_AIRCRAFT, "aircraft"),
    **dict.fromkeys(GUIDED, "guidance"),
}
RATED = tuple(SENDERS)
# length of a run of samples; a steady publisher takes about the same time for each such run
STEADY_RUN = 60
# length of a short run; if a publisher leaves out 30 % of the samples, a tenth of such runs is
# still whole
SHORT_RUN = 6


class TopicAccount(NamedTuple):
    """Numbers of samples of a topic that were planned, logged and never sent.

    Times are flight times in s. A time is None if there is no sample.
    """

    # None if unknown, as in a log without the rates or the start of its flight
    expected: int | None
    found: int
    first: float | None
    last: float | None
    gap: float | None  # longest interval between two samples
    gap_at: float | None  # when this interval begins
    # samples with the same stamp as the sample before, except in a failsafe; `found` does not count
    # them
    repeated: int
    unset: int  # number of samples without a usable stamp, which are left out
    step: float  # step in the clock of the stamps, s; 0 if there is none
    left_out: int  # samples after the step, which are left out
    # samples that the publisher never sent, as the numbers of the messages show
    unsent: int
    is_of_stack: bool = True  # whether a node of the stack sent the topic

    @property
    def share(self) -> float | None:
        """The fraction of the expected samples that the log has, at most 1.

        It is None if the expected number of samples is unknown.
        """
        return None if self.expected is None else min(self.found / max(self.expected, 1), 1.0)

    def is_enough(self, count: int) -> bool:
        """Return whether `count` samples are as good as all that were expected.

        This is also the case if the expected number is unknown. If the topic is short, one missing
        sample is accepted, because the first instant may lie just before the beginning of the
        flight, or the last instant just after its end.
        """
        return self.expected is None or count >= min(
            WHOLE * self.expected, max(self.expected - 1, 1)
        )


class Span(NamedTuple):
    """The part of a flight in which samples are counted. It has one end for all topics.

    It begins at t = 0, or for each topic at the first sample of the topic.
    """

    end_ns: int  # stamp of the end
    is_from_start: bool  # whether it begins at t = 0, not at the first sample of a topic
    is_simulated: bool  # whether the aircraft of the scenario flew, no autopilot


class Leeway(NamedTuple):
    """Times at the beginning and at the end of a span in which a topic need not have samples."""

    begin: float = 0.0  # time from the beginning of the span to the first sample
    # time from the last sample to the end of the span; None if it may be any time
    end: float | None = 0.0


def topic_accounts(
    tape: Tape, scenario: Scenario | None, span: Span
) -> tuple[dict[str, TopicAccount], dict[str, Leeway]]:
    """Return the account of each topic, and the leeway of each topic that has one.

    The expected number of samples is rate times time. If a node of this package sends the samples
    in the host's time, the rate comes from the scenario. If not, the rate comes from the log. For
    ticks of the controller, the time begins at the first tick. If a controller or a publisher
    outside this package leaves out up to a tenth of the samples, none is taken as missing.
    """
    periods = {} if scenario is None else _periods(tape, scenario, simulated=span.is_simulated)
    expected = {} if scenario is None else _expected(tape, scenario, span, periods)
    names = [*dict.fromkeys([*(name for name in tape.signals if name in RATED), *expected])]
    begin_ns = tape.start_ns if span.is_from_start else None
    topics = {name: _topic(tape, name, expected.get(name), begin_ns, span.end_ns) for name in names}
    leeways = {} if scenario is None else _leeways(scenario)
    has_clock = tape.is_by_clock or (
        tape.start_ns > SINCE_EPOCH_NS
        and not any(clock.step_ns for clock in tape.recording.values())
    )
    if has_clock:
        for name, step_ns in periods.items():
            if is_last_to_end(tape, name):
                continue
            topics[name] = _with_unsent(tape, name, topics[name], step_ns)
            if unsent_at_end := _unsent_rest(tape, name, step_ns, span.end_ns):
                topics[name] = topics[name]._replace(unsent=topics[name].unsent + unsent_at_end)
                # They count as never sent, so the last sample may be as early as it is.
                leeways[name] = leeways.get(name, Leeway())._replace(end=None)
            if not is_sent_by_stack(tape, name):
                topics[name] = _of_foreign(topics[name])
    failsafe = 0
    if "internals" in tape and "mode" in tape["internals"].names:
        failsafe = int(np.count_nonzero(tape["internals"]["mode"] != Mode.ENGAGED))
    for name, topic in topics.items():
        # During a failsafe stamps stand still. If other stamps are equal, the clock stood still,
        # and it is unknown whether a sample is new.
        repeated = max(topic.repeated - (failsafe if name in TICKS else 0), 0)
        topics[name] = topic._replace(found=max(topic.found - repeated, 0), repeated=repeated)
    return topics, leeways


def _expected(
    tape: Tape, scenario: Scenario, span: Span, periods: Mapping[str, int]
) -> dict[str, int]:
    """Return how many samples of each topic the log should hold, if this is known."""
    sensors = scenario.aircraft.sensors
    pose = scenario.aircraft.pose
    expected = {}
    delays = {"y": sensors.delay, "pose": pose.delay}
    for name, step_ns in periods.items():
        is_of_stack = is_sent_by_stack(tape, name)
        first_ns = tape.start_ns
        if name in tape and (name in TICKS or not span.is_from_start):
            first_ns = int(tape[name].stamp_ns[0])
            if span.is_from_start:
                first_ns = max(first_ns, tape.start_ns)
        delay_ns = nanoseconds(delays.get(name, 0.0)) if is_of_stack else 0
        count = max((span.end_ns - delay_ns - first_ns) // step_ns + 1, 0)
        if name == "y" and is_of_stack and sensors.dropout:
            mean = count * (1.0 - sensors.dropout)
            count = max(math.floor(mean - 4.0 * math.sqrt(mean * sensors.dropout)), 0)
        expected[name] = count
    if not span.is_simulated:  # then the controller is inactive until the bridge engages
        return expected
    guided_time = seconds(span.end_ns - tape.start_ns)
    if is_sent_by_stack(tape, "u"):
        ticks, engaged_time = _ticks(tape, scenario, span)
        expected |= dict.fromkeys(TICKS, ticks)
        # In lockstep and in one process guidance steps in any mode of the controller.
        if is_real_time(tape):
            guided_time = engaged_time
    if scenario.guidance is not None:
        step_ns = period_ns(scenario.guidance.rate, "guidance.rate")
        for name in GUIDED:
            if name not in tape or is_sent_by_stack(tape, name):
                rate = NANOSECONDS / _period(tape, name, step_ns)
                before_pose = math.ceil(pose.delay * rate)
                expected[name] = max(math.floor(guided_time * rate) - 2 - before_pose, 0)
    return expected


def is_real_time(tape: Tape) -> bool:
    """Return whether the nodes flew by a clock, either the host's clock or /clock."""
    return tape.is_by_clock or tape.start_ns > SINCE_EPOCH_NS


def _periods(tape: Tape, scenario: Scenario, *, simulated: bool) -> dict[str, int]:
    """Return the period of each topic that has samples at a fixed rate, ns.

    An aircraft outside this package may publish no truth and no pose. Commands u_m from outside
    have no rate.
    """
    y_m_ns = period_ns(scenario.reference_model.rate, "reference_model.rate")
    if not simulated:
        return {"y_m": _period(tape, "y_m", y_m_ns)}
    y_ns = period_ns(scenario.aircraft.rate, "aircraft.rate")
    has_truth = is_sent_by_stack(tape, "truth")
    recorded = {"y", "y_m", *tape.signals, *tape.recording}
    if has_truth:
        recorded.add("truth")
    nominal_ns = {"y": y_ns, "truth": y_ns, "pose": scenario.aircraft.pose_every() * y_ns}
    if not is_sent_by_stack(tape, "u"):
        nominal_ns["u"] = period_ns(scenario.controller.rate, "controller.rate")
    return {
        name: _period(tape, name, step_ns)
        for name, step_ns in ({"y_m": y_m_ns} | nominal_ns).items()
        if name in recorded
    }


def is_sent_by_stack(tape: Tape, name: str) -> bool:
    """Return whether a node of this package sent a topic. The log names the nodes that flew.

    A flight in one process has no such names, and is taken as sent by this package. A controller
    outside this package publishes no topic `internals`.
    """
    if name in TICKS and ("internals" in tape or "u" not in tape):
        return True
    if tape.processes:
        node = re.compile(rf"/{SENDERS[name]}(#\d+)?$")
        return any(node.search(process) for process in tape.processes)
    is_in_memory = not tape.recording and "truth" in tape.signals
    return is_in_memory or tape.duration is not None or "truth" in tape.recording


def is_simulated(tape: Tape) -> bool:
    """Return whether the simulated aircraft of this package flew, in the wind of the scenario."""
    return tape.scenario is not None or "truth" in tape or is_sent_by_stack(tape, "y")


def _period(tape: Tape, name: str, nominal_ns: int) -> int:
    """Return the period of the samples of a topic, ns.

    If a node of this package flies in the host's time, it has the period of its parameters. If the
    time comes from the topic /clock, a node skips the instants between two messages of the clock,
    so its period can be longer.
    """
    is_of_stack = is_sent_by_stack(tape, name)
    if is_of_stack and not tape.is_by_clock:
        return nominal_ns
    recorded_ns = nominal_ns
    if name in tape:
        lost = tape.recording.get(name, Recording(0)).lost or 0
        recorded_ns = period_of(tape[name].stamp_ns, lost, nominal_ns)
    return max(nominal_ns, recorded_ns) if is_of_stack else recorded_ns


def period_of(stamp_ns: NDArray[np.int64], lost: int, otherwise_ns: int) -> int:
    """Estimate the period at which a publisher sent samples, ns, given their stamps, (N,).

    `lost` is the number of lost messages. A steady publisher takes the same time for any STEADY_RUN
    samples, to within an interval, even if a coarse clock makes the intervals differ. If samples
    are missing, these times scatter, so the period follows from the quickest tenth of short runs of
    samples. If there are too few samples, the result is `otherwise_ns`.
    """
    stamp_ns = np.unique(stamp_ns)
    intervals_ns = np.diff(stamp_ns)
    if len(intervals_ns) < 2:
        return otherwise_ns
    count = min(STEADY_RUN, len(intervals_ns) // 2)
    run_ns = stamp_ns[count:] - stamp_ns[:-count]
    lower, middle, upper = np.quantile(run_ns, [0.25, 0.5, 0.75])
    shortest, longest = np.quantile(intervals_ns, [0.05, 0.95])
    if upper - lower <= longest - shortest:
        step_ns = middle / count
    else:
        count = min(SHORT_RUN, count)
        step_ns = np.quantile(stamp_ns[count:] - stamp_ns[:-count], 0.1) / count
    if lost:
        step_ns = min(step_ns, (stamp_ns[-1] - stamp_ns[0]) / (len(intervals_ns) + lost))
    return max(round(float(step_ns)), 1)


def _with_unsent(tape: Tape, name: str, topic: TopicAccount, step_ns: int) -> TopicAccount:
    """Return the account of a topic with `unsent`, the number of samples that were never sent.

    This is the number of instants without a sample between the first and the last sample, less the
    lost messages, which the numbers of the messages show. Samples with unusable stamps were sent,
    so they are not included.
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


def _of_foreign(topic: TopicAccount) -> TopicAccount:
    """Return the account of a topic whose publisher is outside this package.

    It is unknown how many samples such a publisher planned. The samples that it sent are taken as
    complete if it left out at most a tenth of them, and no gap is longer than SILENCE.
    """
    is_silent = topic.gap is not None and topic.gap > SILENCE
    if topic.expected is None or is_silent or topic.unsent > (1.0 - LEAST) * topic.expected:
        return topic._replace(is_of_stack=False)
    return topic._replace(expected=topic.expected - topic.unsent, unsent=0, is_of_stack=False)


def is_last_to_end(tape: Tape, name: str) -> bool:
    """Return whether a topic ends later than all other topics of the flight.

    In this case a gap in the topic may be a jump of the clock.
    """
    ends = {
        topic: int(signal.stamp_ns[-1])
        for topic, signal in tape.signals.items()
        if topic in RATED and len(signal.stamp_ns)
    }
    further = [end_ns for topic, end_ns in ends.items() if topic != name]
    return bool(further) and ends.get(name, 0) > max(further) + LATE_TICK_NS


def _unsent_rest(tape: Tape, name: str, step_ns: int, end_ns: int) -> int:
    """Return at how many instants, from the last sample to the end, a publisher sent nothing.

    The result is 0 unless the log proves that the publisher did not send. For this, the numbers of
    the messages must show that no message was lost, and the topic must have a sample after the end.
    A topic of OF_AIRCRAFT needs no sample after the end if the log has every y. The instants of
    such a topic are counted up to the last y, but only if y has no sample at any of them.
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


def _ticks(tape: Tape, scenario: Scenario, span: Span) -> tuple[int, float]:
    """Return the number of the controller's ticks up to the end, and the engaged time, s.

    Each controller numbers its ticks from 1, so the ticks are counted for each publisher. If y and
    y_m come from nodes of the user, the controller can fly before t = 0. If the flight is counted
    from t = 0 on, the ticks before t = 0 are left out.
    """
    end_ns = span.end_ns
    step_ns = period_ns(scenario.controller.rate, "controller.rate")
    begins = [
        int(tape[name].stamp_ns[0]) for name in TICKS if name in tape and len(tape[name].stamp_ns)
    ]
    if not begins:
        return max((end_ns - tape.start_ns) // step_ns + 1, 0), 0.0
    first_ns = tape.start_ns if span.is_from_start else min(begins)
    begin_ns = max(min(begins), first_ns)
    if "internals" not in tape or not {"number", "age", "mode"} <= set(tape["internals"].names):
        instants = max((end_ns - begin_ns) // step_ns + 1, 1)
        return instants, seconds(instants * step_ns)
    log = tape["internals"].until(end_ns)
    is_early = log.stamp_ns < first_ns
    log = log.where(~is_early)
    tick_ns = log.stamp_ns + np.round(log["age"] * NANOSECONDS).astype(np.int64)
    if tape.is_by_clock:
        step_ns = max(step_ns, period_of(tick_ns, 0, step_ns))
    instants = max((end_ns - begin_ns) // step_ns + 1, 1)
    if not len(log.stamp_ns):
        return instants, seconds(instants * step_ns)
    count = instants
    drops = scenario.aircraft.sensors.dropout > 0.0
    if "y" in tape and (drops or not is_sent_by_stack(tape, "y")):
        count = min(instants, _instants_with_y(tape, log, step_ns))
    number = log["number"]
    senders = () if log.sender is None else np.unique(log.sender)
    by_sender = [number[log.sender == sender] for sender in senders] or [number]
    by_controller = [
        part for numbers in by_sender for part in np.split(numbers, controller_starts(numbers))
    ]
    missing = sum(float(np.ptp(numbers)) + 1.0 - len(numbers) for numbers in by_controller)
    before = 0.0 if is_early.any() else float(by_controller[0].min()) - 1.0
    goes_on = int(tape["internals"].stamp_ns[-1]) > end_ns
    last_ns = int(tick_ns[-1])
    after = 0 if goes_on else max((end_ns - last_ns) // step_ns, 0) * count // instants
    ticks = int(len(log.stamp_ns) + max(missing, 0.0) + before + after)
    ticks = count if ticks < LEAST * count else ticks
    engaged_share = float(np.mean(log["mode"] == Mode.ENGAGED))
    return ticks, engaged_share * ticks * instants / count * seconds(step_ns)


def _instants_with_y(tape: Tape, internals: Signal, step_ns: int) -> int:
    """Return the number of ticks that have a new y or are in a failsafe.

    The controller publishes u only in these ticks. The number is needed if an aircraft outside this
    package has another rate of y, or if a sensor is declared to drop samples. A y that only the log
    lost is included, because the controller received it.
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
    repeated = int(np.count_nonzero(gaps == 0.0))
    if recording.found and signal.sender is None:
        repeated = recording.repeated
    return TopicAccount(
        expected=expected,
        found=count - early,
        first=float(t[0]) if count else None,
        last=float(t[-1]) if count else None,
        gap=None if longest is None else float(gaps[longest]),
        gap_at=None if longest is None else float(t[longest]),
        repeated=repeated,
        unset=recording.unset,
        step=seconds(recording.step_ns),
        left_out=recording.left_out,
        unsent=0,
    )


def _leeways(scenario: Scenario) -> dict[str, Leeway]:
    """Return the leeway of each topic whose samples are delayed.

    The leeway is the delay of the topic. The pose also has a leeway of one of its periods.
    """
    aircraft = scenario.aircraft
    of_y = aircraft.sensors.delay
    of_pose = aircraft.pose.delay + aircraft.pose_every() / aircraft.rate
    return {"y": Leeway(of_y, of_y), "pose": Leeway(of_pose, of_pose)}
