# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Find what the log of a flight holds and what it lacks.

An account also names the processes of the flight, its commands, and the legs of its route.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, NamedTuple

import numpy as np

from flight_analysis.closed_loop.scenario import Scenario
from flight_analysis.metrics.errors import TRUE_ERROR, best_error
from flight_analysis.report.sample_counts import (
    GUIDED,
    LEAST,
    RATED,
    SILENCE,
    TICKS,
    WHOLE,
    Leeway,
    Span,
    TopicAccount,
    topic_accounts,
)
from flight_analysis.report.starvation import Starvation, starvation
from flight_core.outcome import COMPLETED, End, Outcome
from flight_core.rates import nanoseconds, seconds
from flight_core.tape import Recording, Signal, Tape
from flight_log.clock import SINCE_EPOCH_NS

REPEATS = 0.01  # share of repeated stamps in a topic up to which they are not mentioned
STEADY = ("y", "y_m", "truth", "pose")  # topics that no mode of the flight interrupts


class ProcessAccount(NamedTuple):
    """When a process of the flight began, and when it sent its messages.

    The times are flight times in s. A time is None if it is unknown, or if the process sent
    nothing.
    """

    ready: float | None  # when its event loop began
    first: float | None  # stamps of its first and last output
    last: float | None
    samples: int | None = None  # on the topics of the aircraft


@dataclass(frozen=True, kw_only=True)
class Commands:
    """Numbers of commands in a flight. The legs of a route are not included."""

    given: int  # edges of the scenario's commands and of u_m
    flown: int  # edges that began before the end of the flight
    targets: int  # messages of targets and routes in the log
    taken: int  # steps of guidance with a new command: of a target, a route or a service


class Account(NamedTuple):
    """What the log of a flight holds and lacks. Each sentence in `lacks` names a missing piece."""

    end: float  # s, flight time of the end
    topics: dict[str, TopicAccount]
    lacks: tuple[str, ...]
    busy: str = ""  # sentence that is not empty if a busy host left out samples and ticks
    unguided: bool = False  # whether the controller was engaged but guidance took no step
    processes: Mapping[str, ProcessAccount] = {}
    commands: Commands | None = None
    # flight time of the first u, s, if the law flew less than half of the flight; else None
    late: float | None = None
    starved: tuple[tuple[float, float], ...] = ()  # s, spans in which the host starved the nodes
    host_lacks: tuple[str, ...] = ()  # sentences of `lacks` whose cause is the host
    lost_parts: tuple[str, ...] = ()  # sentences of `lacks` that are also notes of the tape

    @property
    def starvation(self) -> Starvation:
        """The spans in which the host was too busy to run the nodes in time."""
        return Starvation(self.starved)

    def over(self, *topics: str) -> str:
        """Say how much of each of the given topics the log has, as in "over 49 % of truth".

        Topics that the log has in full are left out. Returns "" if the log has all of them in full.
        """
        accounts = {name: self.topics[name] for name in topics if name in self.topics}
        parts = [
            f"{math.floor(100.0 * topic.share)} % of {name}"
            for name, topic in accounts.items()
            if topic.share is not None and not topic.is_enough(topic.found)
        ]
        return f"over {', '.join(parts)}" if parts else ""

    def notes(self) -> tuple[str, ...]:
        """Return the sentences about missing samples that a user of the log should read."""
        lacks = [lack for lack in self.lacks if lack not in self.lost_parts]
        busy = (self.busy,) if self.busy else ()
        return (*busy, *(f"the log lacks {lack}" for lack in lacks))

    def as_json(self) -> dict[str, Any]:
        """Return the account as a dict for `summary.json`."""
        content = self._asdict()
        del content["lost_parts"]  # these sentences are in "lacks" as well
        content["topics"] = {
            name: topic._asdict() | {"share": topic.share} for name, topic in self.topics.items()
        }
        content["processes"] = {name: each._asdict() for name, each in self.processes.items()}
        content["commands"] = None if self.commands is None else asdict(self.commands)
        return content


def best_error_over(tape: Tape) -> tuple[str, Signal]:
    """Return the name and the signal of the most accurate error on a tape.

    This is the true error if the tape has it, else the measured error.

    Args:
        tape: A flight with y and y_m.

    Returns:
        "true error" or "measured error", and e = y - y_m, shape (N, m), SI. If the log lacks
        samples, the name also says how much of the flight the log has, as in "true error, over
        49 % of truth".

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


def planned_end_ns(tape: Tape) -> int | None:
    """Return the stamp at which the flight should have ended, or None if it is unknown."""
    duration = tape.duration
    if isinstance(tape.scenario, Scenario):
        duration = tape.scenario.flight.duration
    return None if duration is None else tape.start_ns + nanoseconds(duration)


def account(
    tape: Tape, scenario: Scenario | None, outcome: Outcome = COMPLETED, *, simulated: bool = True
) -> Account:
    """Find what the log of a flight holds, and what it lacks.

    If the log has both t = 0 and the planned end, the account covers the time between them. If not,
    it covers, for each topic, the time from the first sample of the topic to the last sample of any
    topic. `simulated` is False if an autopilot flew another aircraft than the scenario describes.
    """
    planned_ns = planned_end_ns(tape)
    span = _span(tape, planned_ns, outcome, simulated=simulated)
    topics, leeways = topic_accounts(tape, scenario, span)
    end = seconds(span.end_ns - tape.start_ns)
    guided = [topics[name] for name in GUIDED if name in topics]
    unguided = bool(guided) and all(
        topic.expected and not topic.found and not topic.unset for topic in guided
    )
    first = _late_first_u(tape, topics, scenario) if span.is_from_start else None
    starved = Starvation() if scenario is None else starvation(tape, scenario, topics, end)
    lacks = []
    host_lacks = []
    for name, topic in topics.items():
        leeway = leeways.get(name, Leeway())
        lack = _lack(name, topic, end, leeway, late_u=first is not None)
        if lack is None:
            continue
        lacks.append(lack)
        if _is_of_host(tape, name, topic, starved, end, leeway):
            host_lacks.append(lack)
    busy = [
        f"{topic.unsent} of {topic.expected} {name} were never sent"
        for name, topic in topics.items()
        if topic.expected is not None
        and topic.is_of_stack
        and not topic.is_enough(topic.expected - topic.unsent)
    ]
    # Given a planned end, a log that was cut off at its end is noticed as well.
    parts = [lost.sentence for lost in tape.lost_parts if planned_ns is None or not lost.is_end]
    return Account(
        end=end,
        topics=topics,
        lacks=(*parts, *lacks, *_absent(tape, scenario)),
        busy=_too_busy(busy),
        unguided=unguided,
        processes=_processes(tape),
        late=first if first is not None and first > end / 2.0 else None,
        starved=starved.spans,
        host_lacks=tuple(host_lacks),
        lost_parts=tuple(parts),
    )


def _span(tape: Tape, planned_ns: int | None, outcome: Outcome, *, simulated: bool) -> Span:
    """Return the time over which the samples of the flight are counted.

    If the flight was simulated and its planned end is known, this time begins at t = 0. If not, it
    begins, for each topic, at the first sample of the topic. A flight that begins at t = 0, and did
    not end early, is counted up to the planned end. Any other flight is counted up to its last
    sample.
    """
    lasts = [
        int(signal.stamp_ns.max())
        for name, signal in tape.signals.items()
        if name in RATED and len(signal.stamp_ns)
    ]
    if planned_ns is None or not simulated:
        return Span(max(lasts, default=tape.start_ns), is_from_start=False, is_simulated=simulated)
    if outcome.end in {End.COMPLETED, End.UNKNOWN}:
        return Span(planned_ns, is_from_start=True, is_simulated=True)
    return Span(max(lasts, default=tape.start_ns), is_from_start=True, is_simulated=True)


def _processes(tape: Tape) -> dict[str, ProcessAccount]:
    """Return when each process of a flight began and sent its messages, by name of the process.

    If the flight was in lockstep, its stamps are no times of day, so it is unknown when a process
    was ready. A process of which nothing is known, such as the recorder of a lockstep flight, is
    left out.
    """

    def flight_time(stamp_ns: int | None) -> float | None:
        return None if stamp_ns is None else seconds(stamp_ns - tape.start_ns)

    since_epoch = tape.start_ns > SINCE_EPOCH_NS
    processes = {
        name: ProcessAccount(
            flight_time(process.ready_ns) if since_epoch else None,
            flight_time(process.first_ns),
            flight_time(process.last_ns),
            process.samples,
        )
        for name, process in tape.processes.items()
    }
    unknown = ProcessAccount(None, None, None)
    return {name: process for name, process in processes.items() if process != unknown}


def _too_busy(parts: Sequence[str]) -> str:
    return f"this host is too busy: {', '.join(parts)}; see docs/faults.md" if parts else ""


def _absent(tape: Tape, scenario: Scenario | None) -> list[str]:
    """Return a sentence for each of the topics y, y_m and u whose channels are not complete."""
    if scenario is None:
        return []
    outputs = scenario.controller.outputs
    channels_by_topic = {"y": outputs, "y_m": outputs, "u": scenario.controller.effectors}
    sentences = []
    for topic, channels in channels_by_topic.items():
        absent = [name for name in channels if topic in tape and name not in tape[topic].names]
        if absent:
            sentences.append(f"{', '.join(absent)} of {topic}")
    return sentences


def _late_first_u(
    tape: Tape, topics: Mapping[str, TopicAccount], scenario: Scenario | None
) -> float | None:
    """Return the time of the first u, s, if it is more than SILENCE after the first possible y.

    Returns None if u came in time. If the log begins after the first u, the time of the first u
    follows from the number of the first tick in the log. If a user activates the controller, the
    result is always None.
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


def _lack(
    name: str, topic: TopicAccount, end: float, leeway: Leeway, *, late_u: bool
) -> str | None:
    """Say what the log lacks of a topic, or return None if the topic is complete.

    The text continues "the log lacks ...". `late_u` is True if the first u of the flight was late.
    """
    facts = []
    missing = not topic.is_enough(topic.found + topic.unsent) or (
        topic.share is not None and topic.share < LEAST
    )
    begins_late = missing and topic.first is not None and topic.first - leeway.begin > SILENCE
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
        longest = min((1.0 - WHOLE) * end, SILENCE)
        if leeway.end is not None and tail > longest + leeway.end:
            facts.append(f"ends at t = {topic.last:.3f} of {end:.3f} s")
        silence = end * (1.0 - topic.share) if missing and topic.share is not None else math.inf
        # a gap is also named if it is more than half of what is missing
        least = min(SILENCE, silence / 2.0)
        if topic.gap is not None and topic.gap_at is not None and topic.gap > least:
            facts.append(
                f"no sample from t = {topic.gap_at:.3f} to {topic.gap_at + topic.gap:.3f} s"
            )
    if not (facts or missing):
        return None
    if missing and topic.unsent:
        facts.append(f"{topic.unsent} were never sent")
    if topic.expected is None:
        return f"{name}: {', '.join(facts)}"
    return ", ".join([f"{name} {topic.found} of {topic.expected} samples", *facts])


def _is_of_host(
    tape: Tape,
    name: str,
    topic: TopicAccount,
    starved: Starvation,
    end: float,
    leeway: Leeway,
) -> bool:
    """Return whether a busy host is the only cause of the samples that a topic lacks.

    Three conditions must hold. First, no message was lost and no stamp is wrong, so the missing
    samples were never sent. Second, the topic lasts to the `end` of the flight, s, except for its
    leeway. Third, it began in time, or it began late while the host starved the nodes of processor
    time.
    """
    is_whole = tape.recording.get(name, Recording(0)).lost == 0
    has_stamps = not (topic.step or topic.unset or topic.left_out or topic.repeated)
    if not (starved.spans and is_whole and has_stamps and topic.is_of_stack):
        return False
    if topic.first is None or topic.last is None:
        return False
    if leeway.end is not None and topic.last < end - leeway.end - SILENCE:
        return False
    before = np.array([topic.first - SILENCE / 2.0])
    return topic.first <= SILENCE or bool(starved.is_starved(before)[0])


def account_of_json(summary: Mapping[str, Any]) -> Account | None:
    """Return the account of a flight that its summary holds, or None if it holds none."""
    content = summary.get("account")
    if content is None:
        return None
    topics = {}
    for name, topic in content["topics"].items():
        topics[name] = TopicAccount(**{key: topic[key] for key in TopicAccount._fields})
    processes = {name: ProcessAccount(**each) for name, each in content["processes"].items()}
    values: dict[str, Any] = content | {
        "topics": topics,
        "processes": processes,
        "commands": content["commands"] and Commands(**content["commands"]),
    }
    lists = {name: tuple(value) for name, value in values.items() if isinstance(value, list)}
    return Account(**(values | lists))
