# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""The account of a flight: the samples that its log should hold and holds, by topic, and the
outcome that follows.
"""

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from operator import itemgetter
from typing import Any, NamedTuple

import numpy as np

from flight_analysis.closed_loop.scenario import Scenario
from flight_analysis.metrics import TRUE_ERROR, best_error
from flight_analysis.report.guided import (
    FlownLeg,
    Outside,
    flown_legs,
    orbit_missed_by,
    time_outside,
    touched_beside,
    unflown_legs,
)
from flight_analysis.report.loop_lost import lost_parts
from flight_core.modes import Mode
from flight_core.outcome import (
    BESIDE,
    COMPLETED,
    INCOMPLETE,
    LANDED,
    LOOP_LOST,
    MISSED,
    NEVER_FLEW,
    NOT_FLOWN,
    NOT_JOINED,
    OUTSIDE,
    UNKNOWN,
    ended_early,
)
from flight_core.rates import NANOSECONDS, nanoseconds, period_ns, seconds
from flight_core.tape import Recording, Signal, Tape
from flight_log.clock import LEAPS, SINCE_EPOCH_NS
from flight_log.flight_processes import controller_starts

WHOLE = (
    0.99  # least share of the samples of a topic without a remark, unless a single one is missing
)
LEAST = 0.9  # a smaller share of a topic is a lack of the log, whatever the cause
SILENCE = 1.0  # s: a longer gap is named, also where the share is large
REPEATS = 0.01  # largest share of equal stamps of a topic whose stamps are all different
LATE_TICK_NS = NANOSECONDS // 10  # the last u of a whole flight may be so much older than its end
GUIDED = ("guidance", "u_m")  # topics of guidance
STEADY = ("y", "y_m", "truth", "pose")  # topics that no mode of the flight interrupts
PARTS = (" and missing", LEAPS, " is truncated: ")  # in notes of a log on its parts and its clock
AIRCRAFT = re.compile(
    r"/aircraft(#\d+)?$"
)  # of a process that is the simulated aircraft of the stack
OF_AIRCRAFT = ("truth", "pose")  # topics of the aircraft beside y, with its stamps
TICKS = ("u", "internals")  # topics of the controller: their stamps rest during a failsafe
APART = ("legs", "outside")  # in the section `guidance` of a summary
SHORTFALL = re.compile(
    rf", (?:{LOOP_LOST}: |{OUTSIDE} |{MISSED} leg |legs? \d+(?: to \d+)? {NOT_FLOWN}|{NOT_JOINED}|"
    rf"{BESIDE}|{INCOMPLETE}).*",
    re.DOTALL,
)  # of an outcome


class TopicAccount(NamedTuple):
    """The samples of a topic. Times in s of flight time; None without a sample."""

    expected: int | None  # None: unknown, as in a log without the rates or the begin of its flight
    found: int
    first: float | None
    last: float | None
    gap: float | None  # longest interval between two samples
    gap_at: float | None  # begin of the interval
    repeated: (
        int  # samples with the stamp of the sample before, except in a failsafe; not among `found`
    )
    unset: int  # samples without a usable stamp, left out
    step: float  # of the clock of the stamps, s; 0 without a step
    left_out: int  # samples after the step
    unsent: (
        int  # samples that the publisher left out on a busy host, by the numbers of the messages
    )

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


class ProcessAccount(NamedTuple):
    """A process of the flight. Flight times in s; None: unknown, or without output."""

    ready: float | None  # its event loop began
    first: float | None  # stamps of its first and last output
    last: float | None
    samples: int = 0  # on the topics of the aircraft


class Commands(NamedTuple):
    """Commands of a flight, without the legs of a route."""

    given: int  # edges of the scenario's pulses and of u_m
    flown: int  # those that began before the end of the flight
    targets: int  # messages of targets and routes in the log
    taken: int  # steps of guidance with a new command: of a target, a route or a service


class Account(NamedTuple):
    """What the log of a flight holds. `lacks` are the sentences on the parts that are missing, for
    the outcome.
    """

    end: float  # s, flight time of the end
    topics: dict[str, TopicAccount]
    lacks: tuple[str, ...]
    busy: str = ""  # the sentence on a host that left out samples and ticks
    unguided: bool = False  # the controller was engaged, and guidance took no step
    legs: tuple[FlownLeg, ...] = ()  # of the route, in order
    unflown: tuple[
        int, ...
    ] = ()  # numbers of the legs that were ahead when the flight ended, in order
    processes: Mapping[str, ProcessAccount] = {}
    commands: Commands | None = None
    late: float | None = (
        None  # s, flight time of the first u of a flight that flew less than half of its time
    )
    outside: Outside | None = None  # of the fence; None without one
    off_orbit: float = 0.0  # m from the last orbit at the end; 0 of an orbit that is joined
    beside: float = 0.0  # m from the touch-down zone, of a landing; 0 inside
    loop_lost: tuple[str, ...] = ()  # inputs between their limits, and errors that grow

    def over(self, *topics: str) -> str:
        """The part of these topics that a figure is taken over; empty for whole topics."""
        named = {name: self.topics[name] for name in topics if name in self.topics}
        parts = [
            f"{math.floor(100.0 * topic.share)} % of {name}"
            for name, topic in named.items()
            if topic.share is not None and not topic.holds(topic.found)
        ]
        return f"over {', '.join(parts)}" if parts else ""

    def notes(self) -> tuple[str, ...]:
        """Sentences for the user of a log."""
        lacks = [
            lack for lack in self.lacks if not any(part in lack for part in PARTS)
        ]  # which notes tell of
        return (*([self.busy] if self.busy else []), *(f"the log lacks {lack}" for lack in lacks))

    def as_json(self) -> dict[str, Any]:
        """The account for `summary.json`, which has the legs in `guidance`."""
        content = {name: value for name, value in self._asdict().items() if name not in APART}
        content["topics"] = {
            name: topic._asdict() | {"share": topic.share} for name, topic in self.topics.items()
        }
        content["processes"] = {name: each._asdict() for name, each in self.processes.items()}
        content["commands"] = None if self.commands is None else self.commands._asdict()
        return content


def best_error_over(tape: Tape) -> tuple[str, Signal]:
    """Name and signal of the best error on a tape: the true error, or else the measured error.

    Args:
        tape: A flight with y and y_m.

    Returns:
        "true error" or "measured error", of a log that lacks samples with the part of the flight,
        as "true error, over 49 % of truth", and e = y - y_m, shape (N, m), SI.

    Raises:
        ParameterError: `tape` is no Tape, or has no y and y_m.

    Examples:
        >>> tape = rise_di.simulate(rise_di.find_scenario("osprey_servo", duration=0.1))
        >>> kind, e = rise_di.best_error(tape)
        >>> kind, e["q"].shape
        ('true error', (51,))
    """
    kind, error = best_error(tape)
    part = ""
    if isinstance(tape.account, Account):
        part = tape.account.over("truth" if kind == TRUE_ERROR else "y", "y_m")
    return f"{kind}, {part}" if part else kind, error


def final_outcome(outcome: str, account: Account) -> str:
    """The outcome with the time outside of the fence, the legs missed and not flown, and with what
    the log lacks.

    As in "completed, missed leg 2 by 35 m, legs 4 to 6 not flown, log incomplete: ...".

    An early end stays as it is.
    """
    base = SHORTFALL.sub("", outcome)
    if base == COMPLETED and account.late is not None:
        return f"{NEVER_FLEW}: the first u came at t = {account.late:.3f} of {account.end:.3f} s"
    if base == COMPLETED and account.unguided:
        return (
            f"{NEVER_FLEW} guided: guidance took no step; see the ages of pose and y against "
            "guidance.max_age"
        )
    outing = account.outside if account.outside is not None and account.outside.left else None
    outside = (
        []
        if outing is None
        else [f"{OUTSIDE} for {outing.outside_s:.1f} s, {outing.farthest_m:.0f} m at most"]
    )
    if LANDED in base:
        missed = [f"{BESIDE} by {account.beside:.0f} m"] if account.beside else []
        return ", ".join([base, *outside, *missed])
    if not base.startswith((COMPLETED, UNKNOWN)):
        return base
    parts = [
        base,
        *([f"{LOOP_LOST}: {'; '.join(account.loop_lost)}"] if account.loop_lost else []),
        *outside,
        *(f"{MISSED} leg {leg.leg} by {leg.missed:.0f} m" for leg in account.legs if leg.missed),
    ]
    if account.unflown:
        first = account.unflown[0]
        last = account.unflown[-1]
        parts.append(
            f"leg {last} {NOT_FLOWN}" if first == last else f"legs {first} to {last} {NOT_FLOWN}"
        )
    if account.off_orbit:
        parts.append(f"{NOT_JOINED}: {account.off_orbit:.0f} m")
    if account.lacks:
        parts.append(f"{INCOMPLETE}: {'; '.join(account.lacks)}")
    return ", ".join(parts)


def outcome_of_log(tape: Tape, scenario: Scenario, *, simulated: bool) -> str:
    """The outcome of a flight that left none, as one of nodes that were started one by one; empty
    for a part of a flight.

    The flight is completed where the log holds y, y_m and u for the duration in the log, else that
    of the scenario. An autopilot may end the last engagement, and with it u, before.
    """
    is_part = bool(_lost_parts(tape.notes, planned=False)) or any(
        recording.step_ns for recording in tape.recording.values()
    )
    if simulated and not {*TICKS} & {*tape.signals}:
        return "" if is_part else f"{NEVER_FLEW}: the controller never engaged"
    loop = [
        tape[name].stamp_ns for name in ("y", "y_m", *(["u"] if simulated else [])) if name in tape
    ]
    held = min(
        (int(stamp_ns[-1]) if len(stamp_ns) else tape.start_ns for stamp_ns in loop),
        default=tape.start_ns,
    )
    planned = scenario.flight.duration if tape.duration is None else tape.duration
    if held >= tape.start_ns + nanoseconds(planned) - LATE_TICK_NS:
        return COMPLETED
    return "" if is_part else ended_early(seconds(held - tape.start_ns), planned)


def flown(tape: Tape) -> Tape:
    """The tape up to the controller's last tick: later samples belong to the shutdown of the
    processes.

    A u that ends much earlier than y and y_m, or before the end of a whole flight, is a gap of the
    log: nothing is cut there.
    """
    ticks = [
        int(tape[name].stamp_ns[-1]) for name in TICKS if name in tape and len(tape[name].stamp_ns)
    ]
    others = [
        int(tape[name].stamp_ns[-1])
        for name in ("y", "y_m")
        if name in tape and len(tape[name].stamp_ns)
    ]
    if not ticks:
        return tape
    # one tick publishes u and internals
    end_ns = max(ticks)
    planned_ns = _planned_ns(tape)
    if (
        planned_ns is not None
        and end_ns < planned_ns - LATE_TICK_NS
        and end_ns < max(others, default=0) - LATE_TICK_NS
    ):
        end_ns = planned_ns
    elif min(others, default=end_ns) - end_ns > nanoseconds(SILENCE):
        return tape
    return replace(
        tape, signals={name: signal.until(end_ns) for name, signal in tape.signals.items()}
    )


def _planned_ns(tape: Tape) -> int | None:
    """Stamp of the planned end; None where the log does not have it."""
    planned = (
        tape.scenario.flight.duration if isinstance(tape.scenario, Scenario) else tape.duration
    )
    return None if planned is None else tape.start_ns + nanoseconds(planned)


def account(
    tape: Tape, scenario: Scenario | None, outcome: str = COMPLETED, *, simulated: bool = True
) -> Account:
    """The account of a flight.

    The expected number of samples is rate times time, from t = 0 to the planned end where the log
    knows both, else from the first sample of the topic to the last sample of any. Ticks of the
    controller count from the first, without the ticks that a busy host left out, up to a tenth of
    the ticks. `simulated`: the aircraft of the scenario flew, no autopilot.
    """
    lasts = [
        int(signal.stamp_ns.max())
        for name, signal in tape.signals.items()
        if name in RATED and len(signal.stamp_ns)
    ]
    planned_ns = _planned_ns(tape)
    end_ns = max(lasts, default=tape.start_ns)
    from_start = planned_ns is not None and simulated
    if planned_ns is not None and simulated and outcome.startswith((COMPLETED, UNKNOWN)):
        end_ns = planned_ns
    expected = (
        {}
        if scenario is None
        else _expected(tape, scenario, end_ns, from_start=from_start, simulated=simulated)
    )
    names = [*dict.fromkeys([*(name for name in tape.signals if name in RATED), *expected])]
    begin_ns = tape.start_ns if from_start else None
    topics = {name: _topic(tape, name, expected.get(name), begin_ns, end_ns) for name in names}
    late = {} if scenario is None else _latest(scenario)
    has_clock = tape.start_ns > SINCE_EPOCH_NS and not any(
        clock.step_ns for clock in tape.recording.values()
    )
    if scenario is not None and has_clock:  # in real time
        for name, step_ns in _periods(tape, scenario, simulated=simulated).items():
            if ends_last(tape, name):
                continue
            refused = tape.refused.get(name, 0)
            topics[name] = _with_unsent(
                topics[name], step_ns, tape.recording.get(name, Recording(0)), refused
            )
            if unsent_at_end := _unsent_rest(tape, name, step_ns, end_ns):
                topics[name] = topics[name]._replace(unsent=topics[name].unsent + unsent_at_end)
                late[name] = seconds(end_ns)
    end = seconds(end_ns - tape.start_ns)
    failsafe = 0
    if "internals" in tape and "mode" in tape["internals"].names:
        failsafe = int(np.count_nonzero(tape["internals"]["mode"] != Mode.ENGAGED))
    for name, topic in topics.items():
        # Stamps rest during a failsafe. Further equal stamps are of a clock that stands, and no
        # sample is known to be new.
        repeated = max(topic.repeated - (failsafe if name in TICKS else 0), 0)
        topics[name] = topic._replace(found=max(topic.found - repeated, 0), repeated=repeated)
    guided = [topics[name] for name in GUIDED if name in topics]
    unguided = bool(guided) and all(
        topic.expected and not topic.found and not topic.unset for topic in guided
    )
    first = _late_first_u(tape, topics, scenario) if from_start else None
    lacks = [
        lack
        for name, topic in topics.items()
        if (lack := _lack(name, topic, end, late.get(name, 0.0), late_u=first is not None))
    ]
    busy = [
        f"{topic.unsent} of {topic.expected} {name} were never sent"
        for name, topic in topics.items()
        if topic.expected is not None and not topic.holds(topic.expected - topic.unsent)
    ]
    section = None if scenario is None else scenario.guidance
    legs = flown_legs(tape) if "guidance" in tape and len(tape["guidance"].stamp_ns) else []
    unflown = unflown_legs(tape, section) if legs and section is not None else ()
    off_orbit = orbit_missed_by(tape, section) if legs and section is not None else 0.0
    parts = _lost_parts(tape.notes, planned=planned_ns is not None)
    return Account(
        end, topics, (*parts, *lacks, *_absent(tape, scenario)), _too_busy(busy), unguided,
        tuple(legs), tuple(unflown),
        _processes(tape), late=first if first is not None and first > end / 2.0 else None,
        outside=time_outside(tape, section), off_orbit=off_orbit,
        beside=touched_beside(tape, section) if LANDED in outcome and section is not None else 0.0,
        loop_lost=lost_parts(tape),
    )  # fmt: skip


RATED = (
    "y",
    "y_m",
    "u",
    "internals",
    "truth",
    "pose",
    "guidance",
    "u_m",
)  # topics with a rate of the scenario


def _processes(tape: Tape) -> dict[str, ProcessAccount]:
    """The processes in flight time. In lockstep the stamps are no times of day, and when a process
    was ready is not known.
    """

    def flight_time(stamp_ns: int | None) -> float | None:
        return None if stamp_ns is None else seconds(stamp_ns - tape.start_ns)

    since_epoch = tape.start_ns > SINCE_EPOCH_NS
    return {
        name: ProcessAccount(
            flight_time(ready_ns) if since_epoch else None,
            flight_time(first),
            flight_time(last),
            samples,
        )
        for name, (ready_ns, first, last, samples) in tape.processes.items()
    }


def _too_busy(parts: Sequence[str]) -> str:
    return f"this host is too busy: {', '.join(parts)}; see docs/faults.md" if parts else ""


def _lost_parts(notes: Iterable[str], *, planned: bool) -> list[str]:
    """Parts of a bag that are missing, and leaps of the clock. A truncated end counts where no
    planned end does.
    """
    kinds = PARTS if not planned else PARTS[:2]
    missing = re.compile("|".join(map(re.escape, kinds)))
    return [
        note.partition(";")[0].partition(": later times")[0]
        for note in notes
        if missing.search(note)
    ]


def _absent(tape: Tape, scenario: Scenario | None) -> list[str]:
    """The channels of the scenario that the samples of y, y_m and u do not have, a sentence a
    topic.
    """
    if scenario is None:
        return []
    outputs = scenario.controller.outputs
    wanted = {"y": outputs, "y_m": outputs, "u": scenario.controller.effectors}
    sentences = []
    for topic, channels in wanted.items():
        absent = [name for name in channels if topic in tape and name not in tape[topic].names]
        if absent:
            sentences.append(f"{', '.join(absent)} of {topic}")
    return sentences


def _expected(
    tape: Tape, scenario: Scenario, end_ns: int, *, from_start: bool, simulated: bool
) -> dict[str, int]:
    """The number of samples by topic that the log of a flight should hold, where this is known."""
    sensors = scenario.aircraft.sensors
    pose = scenario.aircraft.pose
    expected = {}
    delays = {"y": sensors.delay, "pose": pose.delay}
    for name, step_ns in _periods(tape, scenario, simulated=simulated).items():
        first_ns = tape.start_ns
        if not from_start and name in tape:
            first_ns = int(tape[name].stamp_ns[0])
        delay_ns = nanoseconds(delays.get(name, 0.0))
        count = max((end_ns - delay_ns - first_ns) // step_ns + 1, 0)
        if name == "y" and sensors.dropout:
            mean = count * (1.0 - sensors.dropout)
            count = max(math.floor(mean - 4.0 * math.sqrt(mean * sensors.dropout)), 0)
        expected[name] = count
    if not simulated:  # the controller is inactive until the bridge engages
        return expected
    ticks, engaged = _ticks(tape, period_ns(scenario.controller.rate, "controller.rate"), end_ns)
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


def _with_unsent(
    topic: TopicAccount, step_ns: int, recording: Recording, refused: int
) -> TopicAccount:
    """The account of a topic with the instants between the first and the last sample that the
    publisher left out.

    The numbers of the messages are the proof: no number is missing beside lost messages and samples
    left out.
    """
    if (
        topic.first is None
        or topic.last is None
        or recording.lost is None
        or topic.expected is None
    ):
        return topic
    instants = round((topic.last - topic.first) * NANOSECONDS / step_ns) + 1
    return topic._replace(
        unsent=max(instants - topic.found - recording.lost - recording.unset - refused, 0)
    )


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


def _late_first_u(
    tape: Tape, topics: Mapping[str, TopicAccount], scenario: Scenario | None
) -> float | None:
    """Flight time of the first u where it came more than SILENCE after the first y could; None for
    one in time.

    The numbers of the ticks tell of a first u before the log. A controller that a user activates
    has none in time.
    """
    if scenario is None or not (scenario.controller.autostart and scenario.controller.start_active):
        return None
    firsts = [
        first for name in TICKS if name in topics and (first := topics[name].first) is not None
    ]
    if not firsts:
        return None
    before = 0.0
    if "internals" in tape and "number" in tape["internals"].names:
        before = (tape["internals"]["number"][0] - 1.0) / scenario.controller.rate
    first_u = min(firsts) - before
    return first_u if first_u - scenario.aircraft.sensors.delay > SILENCE else None


def _lack(name: str, topic: TopicAccount, end: float, late: float, *, late_u: bool) -> str:
    """What a topic lacks, as a sentence without a verb; empty for a whole topic.

    `late`: of the first and the last sample, s; `late_u`: the first u of the flight was late.
    """
    facts = []
    missing = not topic.holds(topic.found + topic.unsent) or (
        topic.share is not None and topic.share < LEAST
    )
    begins_late = missing and topic.first is not None and topic.first - late > SILENCE
    if begins_late or (name == "u" and late_u):
        facts.append(f"begins at t = {topic.first:.3f} of {end:.3f} s")
    if topic.step and topic.last is not None:
        facts.append(
            f"the clock of its stamps steps by {topic.step:+.3f} s after t = {topic.last:.3f} s"
        )
    if topic.unset:
        facts.append(f"{topic.unset} samples without a usable stamp")
    elif topic.repeated > REPEATS * topic.found:
        facts.append(f"{topic.repeated} samples with the stamp of the sample before")
    if missing or name in STEADY:
        tail = 0.0 if topic.last is None or topic.expected is None else end - topic.last
        if tail > min((1.0 - WHOLE) * end, SILENCE) + late:
            facts.append(f"ends at t = {topic.last:.3f} of {end:.3f} s")
        lost = end * (1.0 - topic.share) if missing and topic.share is not None else math.inf
        least = min(SILENCE, lost / 2.0)  # a shorter gap is named where it is most of the lack
        if topic.gap is not None and topic.gap_at is not None and topic.gap > least:
            facts.append(
                f"no sample from t = {topic.gap_at:.3f} to {topic.gap_at + topic.gap:.3f} s"
            )
    if not (facts or missing):
        return ""
    if missing and topic.unsent:
        facts.append(f"{topic.unsent} were never sent")
    if topic.expected is None:
        return f"{name}: {', '.join(facts)}"
    return ", ".join([f"{name} {topic.found} of {topic.expected} samples", *facts])


def account_of_json(summary: Mapping[str, Any]) -> Account | None:
    """The account in a summary; None for a summary of an earlier version."""
    content = summary.get("account")
    if content is None:
        return None
    fields_of = itemgetter(*TopicAccount._fields)
    guided = summary["guidance"] or {}
    values: dict[str, Any] = content | {
        "topics": {
            name: TopicAccount(*fields_of(topic)) for name, topic in content["topics"].items()
        },
        "processes": {
            name: ProcessAccount(**process)
            for name, process in content.get("processes", {}).items()
        },
        "commands": content.get("commands") and Commands(**content["commands"]),
        "legs": [FlownLeg(**leg) for leg in guided.get("legs", ())],
        "outside": guided.get("fence") and Outside(**guided["fence"]),
    }
    lists = {name: tuple(value) for name, value in values.items() if isinstance(value, list)}
    return Account(**(values | lists))
