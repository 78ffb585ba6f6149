# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Read a bag as a Tape, without ROS.

It reads bags of this stack and of `ros2 bag record`. A bag may be truncated.
"""

from collections import defaultdict
from collections.abc import Collection, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

from flight_core.arguments import FilePath, as_path
from flight_core.files import is_folder, parse_yaml, read_file
from flight_core.outcome import read_outcome
from flight_core.parameters import ParameterError, require
from flight_core.rates import seconds
from flight_core.scenario_file import A_SCENARIO
from flight_core.tape import Signal, Tape, refusal_note
from flight_core.text import bounded, printable
from flight_log.age_of_u import age_of_u
from flight_log.bag import (
    IMPORTED,
    OUTCOME,
    SIMULATED_TIME,
    full_names,
)
from flight_log.clock import (
    SINCE_EPOCH_NS,
    Leap,
    leap_note,
    lost_in_leap,
    recording_note,
    without_leaps,
)
from flight_log.engagements import ENGAGEMENT, Engagement, engagements_of
from flight_log.flight_processes import (
    INSTANCE,
    READY,
    ROSOUT,
    UNNAMED,
    SampleSpan,
    admitted,
    flight_processes,
    ready_times,
)
from flight_log.latency import TOPICS as TIMED_TOPICS
from flight_log.latency import latency
from flight_log.log_content import ROUTE, LogContent, StoredFile, TopicSamples, read_content
from flight_log.log_messages import LogMessage, last_words, log_messages
from flight_log.named_vectors import (
    JOINT_STATE,
    flight_start_ns,
)
from flight_log.open_log import (
    A_RUN,
    NAMED,
)

PARAMETERS = "parameters.yaml"  # attachment with every parameter of the flight
A_FLIGHT = f"a recorded flight: y, y_m and u as {JOINT_STATE}"
# A namespace that has one of these topics belongs to an aircraft.
AIRCRAFT_TOPICS = ("y", "y_m", "u", "u_m", "internals", "truth")


class RecordedRun(NamedTuple):
    """The content of a log for the aircraft in `namespace`, which is "" for the root.

    `metadata` holds the named sets of strings, and `attachments` the files except the scenario.
    `latency` is the latency of the loop from y to u, and `age_of_u` is the age of u at the
    aircraft. `engagements` has the engagements of a bridge. Each of these three is None if the log
    does not show it. `messages` are the warnings, errors and parameter changes in the log, and the
    messages about learning and a bridge. `path` is the path of the log, and `topics` has the types
    of all topics in the log by full name.
    """

    tape: Tape
    scenario: StoredFile | None
    metadata: Mapping[str, Mapping[str, str]] = {}
    attachments: tuple[StoredFile, ...] = ()
    latency: Signal | None = None
    engagements: list[Engagement] | None = None
    namespace: str = ""
    path: Path | None = None
    topics: Mapping[str, str] = {}
    age_of_u: Signal | None = None
    messages: tuple[LogMessage, ...] = ()

    @property
    def account(self) -> Any:
        """How much of each topic the log holds, and what it lacks.

        It is None unless `rise_di.read_run` has read the log.
        """
        return self.tape.account

    def require(self, *names: str) -> None:
        """Raise ParameterError if the log has no sample of a topic.

        The error message has the topics of the log, and the last warnings and errors of its nodes.

        Args:
            names: Topics that must have a sample. Without names, at least one topic of a flight
                must have one.

        Raises:
            ParameterError: A topic has no sample.
        """
        missing = [name for name in names if name not in self.tape]
        if missing or (not names and not {*AIRCRAFT_TOPICS} & {*self.tape.signals}):
            where = "the log" if self.path is None else str(self.path)
            has = topics_text(self.topics)
            lack = (
                f"no sample of {', '.join(missing) or 'a flight'}{f' among {has}' if has else ''}"
            )
            cause = "".join(f"; {text}" for text in last_words(self.messages))
            raise ParameterError(f"{where}: found {lack}, expected {A_FLIGHT}{cause}")

    def scenario_file(self) -> StoredFile:
        """Return the scenario in the log. Raises ParameterError for a log without one."""
        if self.scenario is None:
            where = "the log" if self.path is None else str(self.path)
            if IMPORTED in self.metadata:
                raise ParameterError(
                    f"{where}: found an imported log, expected a flight of the stack, which has "
                    "a scenario"
                )
            expected = "a run that was flown from one, or the scenario: --scenario FILE"
            raise ParameterError(f"{where}: found a log without its scenario, expected {expected}")
        return self.scenario


def topics_text(topics: Mapping[str, str]) -> str:
    """Return topics with their types as part of a sentence, or "" if there are no topics."""
    names = [f"{topic} ({type_name or 'no type'})" for topic, type_name in sorted(topics.items())]
    surplus = len(names) - NAMED
    return ", ".join(names[:NAMED]) + (f" and {surplus} more topics" if surplus > 0 else "")


def read_run(
    run: FilePath,
    namespace: str | None = None,
    scenario: FilePath | None = None,
    remaps: Mapping[str, str] = {},
) -> RecordedRun:
    """Read the folder or a file of a run as `rise_di.read_run` does, but without the account."""
    run = as_path(run, "run", A_RUN)
    replacement = (
        None if scenario is None else stored_scenario(as_path(scenario, "scenario", A_SCENARIO))
    )
    log = read_content(run, full_names(remaps))
    signals = {
        topic: signal
        for topic, samples in log.topics.items()
        if (signal := samples.signal(topic.rpartition("/")[2])) is not None
    }
    _require_samples(log, signals, run)
    aircraft = chosen_namespace(signals, namespace, str(run))
    names = names_within(aircraft, signals)
    require(
        bool(names),
        str(run),
        f"topics that begin with no slash: {', '.join(signals)}",
        "a recorded flight",
    )
    files = [] if log.scenario else files_beside(run)
    tape = _tape(log, aircraft, names, {name: signals[topic] for topic, name in names.items()})
    tape = replace(tape, duration=_duration([*log.attachments, *files]))
    has_step = any(tape.recording[name].step_ns for name in TIMED_TOPICS if name in tape.recording)
    sending_times = {
        topic: times for topic, times in log.sent.items() if names.get(topic) in TIMED_TOPICS
    }
    other_files = (file for file in files if file.name != PARAMETERS)
    return RecordedRun(
        tape=tape,
        scenario=replacement or log.scenario or next(other_files, None),
        metadata=log.metadata,
        attachments=tuple(log.attachments),
        latency=None if has_step else latency(sending_times),
        engagements=engagements_of(
            (text.sent_ns, text.data)
            for text in log.texts
            if text.topic == f"{aircraft}{ENGAGEMENT}"
        ),
        namespace=aircraft,
        path=run,
        topics=log.kinds,
        age_of_u=age_of_u(log.diagnostics, aircraft),
        messages=tuple(log_messages(log.texts, aircraft, tape.start_ns)),
    )


def _require_samples(log: LogContent, signals: Mapping[str, Signal], run: Path) -> None:
    """Raise ParameterError with the reasons for a log without a sample of a flight."""
    has = topics_text(log.kinds)
    lacks = [f"no sample of a flight among {has}" if has else "no sample on any topic"]
    for topic, samples in log.topics.items():
        if unset := samples.recording().unset:
            lacks.append(f"{topic}: {unset} samples without a usable stamp")
        if count := samples.refused():
            lacks.append(refusal_note(topic, count))
    require(bool(signals), str(run), "; ".join([*lacks, *log.notes_at(None)]), A_FLIGHT)


def _tape(
    log: LogContent, aircraft: str, names: Mapping[str, str], filled: Mapping[str, Signal]
) -> Tape:
    """Make the tape of an aircraft, without the duration.

    `names` has the name of each topic within the namespace. `filled` has the signals of the topics
    that have samples, by name.
    """
    samples_by_name = {
        name: log.topics[topic] for topic, name in names_within(aircraft, log.topics).items()
    }
    topics = {name: log.topics[topic] for topic, name in names.items()}
    signals = {printable(name): admitted(signal) for name, signal in filled.items()}
    of_flight = {name: signals.get(printable(name)) for name in samples_by_name}
    recordings = {
        printable(name): samples.recording(of_flight[name])
        for name, samples in samples_by_name.items()
    }
    recording = {name: clock for name, clock in recordings.items() if clock.found}
    leaps: list[Leap] = []
    # An imported log has no leaps, because the import numbered its messages. A lost
    # message leaves no gap in them, so a gap in its stamps would look like a step of the clock.
    if IMPORTED not in log.metadata:
        signals, recording, leaps = without_leaps(signals, recording)
    start_ns = _start_ns(signals)
    end = seconds(max(int(signal.stamp_ns[-1]) for signal in signals.values()) - start_ns)
    counts = {
        printable(name): samples.refused(of_flight[name])
        for name, samples in samples_by_name.items()
    }
    refusals = {name: count for name, count in counts.items() if count}
    lost_in_leaps = [lost_in_leap(leap, start_ns) for leap in leaps]
    lost_parts = [
        *log.truncated_at(end),
        *([] if log.missing is None else [log.missing]),
        *lost_in_leaps,
    ]
    notes = [
        *log.notes_at(end),
        *map(leap_note, lost_in_leaps),
        *(refusal_note(name, count) for name, count in refusals.items()),
        *(recording_note(name, clock, start_ns) for name, clock in recording.items()),
        *_publisher_notes({name: topics[name] for name in filled}, of_flight),
    ]
    outcome = read_outcome(log.metadata.get(OUTCOME))
    spans = _spans((name, topics[name].spans) for name in filled)
    lines = (text.data for text in log.texts if text.topic == ROSOUT and READY in text.data)
    processes = flight_processes(spans, ready_times(lines), aircraft)
    return Tape(
        signals,
        start_ns,
        tuple(map(printable, filter(None, notes))),
        outcome,
        recording=recording,
        processes={printable(name): process for name, process in processes.items()},
        refused=refusals,
        is_by_clock=SIMULATED_TIME in log.metadata or _is_stamped_by_clock(start_ns, spans),
        lost_parts=tuple(replace(lost, sentence=printable(lost.sentence)) for lost in lost_parts),
    )


def _publisher_notes(
    topics: Mapping[str, TopicSamples], of_flight: Mapping[str, Signal | None]
) -> list[str]:
    """Write notes on topics with several publishers.

    There is a note if the publishers sent samples at the same time, and if some have sent messages
    that are no samples of the flight. Topics that have the same publishers share a note.
    """
    conflicts = defaultdict[tuple[str, ...], list[str]](list)
    foreign = defaultdict[tuple[str, ...], list[str]](list)
    for name, samples in topics.items():
        if name in AIRCRAFT_TOPICS and samples.has_overlap():
            conflicts[tuple(sorted(samples.spans))].append(name)
        senders = samples.further_publishers(of_flight[name])
        silent = [sender for sender in senders if sender not in samples.spans]
        if silent:
            foreign[tuple(sorted({*silent}))].append(name)
    return [
        *(
            f"{', '.join(names)}: samples of {_publishers(senders)}: the figures are of the first, "
            "and of the next once that is silent, as the nodes admit them"
            for senders, names in conflicts.items()
        ),
        *(
            f"{', '.join(names)}: messages of {_publishers(senders)} without a sample of the flight"
            for senders, names in foreign.items()
        ),
    ]


def _publishers(senders: Sequence[str]) -> str:
    """Return the names of publishers as part of a sentence."""
    surplus = len(senders) - NAMED
    more = f" and {surplus} more publishers" if surplus > 0 else ""
    return ", ".join(bounded(sender) or UNNAMED for sender in senders[:NAMED]) + more


def _is_stamped_by_clock(start_ns: int, spans: Mapping[str, SampleSpan]) -> bool:
    """Return whether the processes took their stamps from /clock.

    The stamps then lie long before the present, and the names of the publishers have a process id.
    Stamps by the host's clock are times since 1970, and in lockstep the names have no process id.
    """
    return start_ns <= SINCE_EPOCH_NS and any(INSTANCE.fullmatch(sender) for sender in spans)


def _spans(topics: Iterable[tuple[str, Mapping[str, SampleSpan]]]) -> dict[str, SampleSpan]:
    """Return the span of each publisher's samples over all of its topics.

    `topics` are names of topics with the spans of their publishers. For programs outside of the
    stack, only the topics of aircraft are used.
    """
    spans: dict[str, SampleSpan] = {}
    for name, senders in topics:
        for sender, span in senders.items():
            if name in AIRCRAFT_TOPICS or INSTANCE.fullmatch(sender):
                spans[sender] = span.joined(spans[sender]) if sender in spans else span
    return spans


def stored_scenario(path: Path) -> StoredFile:
    """Read a scenario file as a StoredFile, the form in which a log holds an attached file.

    Raises ParameterError if it cannot be read.
    """
    return StoredFile(path.name, read_file(path, str(path), A_SCENARIO))


def files_beside(run: Path) -> list[StoredFile]:
    """Return the scenario and the parameters in files beside a log that has no attachments.

    A scenario is recognised by its content. If there are several scenarios, none is taken.
    """
    folder = run if is_folder(run) else run.parent
    files = []
    for path in sorted(folder.glob("*.yaml")):
        with suppress(ParameterError, OSError):
            file = stored_scenario(path)
            if path.name == PARAMETERS or all(
                section in file.content for section in (b"/aircraft:", b"/controller:")
            ):
                files.append(file)
    scenarios = [file for file in files if file.name != PARAMETERS]
    return files if len(scenarios) < 2 else [file for file in files if file.name == PARAMETERS]


def aircraft_namespaces(topics: Collection[str]) -> list[str]:
    """Return the namespaces of aircraft among the topics."""
    return sorted(
        {
            topic.rpartition("/")[0]
            for topic in topics
            if topic.rpartition("/")[2] in AIRCRAFT_TOPICS
        }
    )


def chosen_namespace(topics: Collection[str], namespace: str | None, where: str) -> str:
    """Return the namespace of an aircraft. The result is "" for the root namespace.

    It is also "" if the log has no aircraft. `namespace` is the choice of the caller, or None.
    Raises ParameterError if no aircraft is in the chosen namespace, or if there are several
    aircraft and no choice.
    """
    aircraft = aircraft_namespaces(topics)
    aircraft_names = ", ".join(name or "/" for name in aircraft) or "none"
    if namespace is None:
        require(
            len(aircraft) < 2,
            where,
            f"aircraft in the namespaces {aircraft_names}",
            "that one of them is asked for: --namespace NAME",
        )
        return aircraft[0] if aircraft else ""
    chosen = f"/{str(namespace).strip('/')}".rstrip("/")
    require(
        chosen in aircraft,
        where,
        f"aircraft in the namespaces {aircraft_names}",
        f"one in {namespace!r}",
    )
    return chosen


def names_within(namespace: str, topics: Collection[str]) -> dict[str, str]:
    """Map the full topic names of an aircraft to the names within its namespace.

    Topics of aircraft in a namespace below it are left out.
    """
    inner_aircraft = [
        f"{name}/" for name in aircraft_namespaces(topics) if name.startswith(f"{namespace}/")
    ]
    return {
        topic: topic.removeprefix(f"{namespace}/")
        for topic in topics
        if topic.startswith(f"{namespace}/") and not topic.startswith(tuple(inner_aircraft))
    }


def _duration(attachments: Sequence[StoredFile]) -> float | None:
    """Return the duration of the whole flight in the attached parameters, s.

    Returns None without them.
    """
    for file in attachments:
        if file.name == PARAMETERS:
            with suppress(ParameterError, LookupError, OverflowError, TypeError, ValueError):
                tree = parse_yaml(file.content, PARAMETERS, "parameters")
                return float(tree["/**/flight"]["ros__parameters"]["duration"])
    return None


def _start_ns(signals: Mapping[str, Signal]) -> int:
    """Return the stamp of flight time 0.

    It follows from `truth`. A log without `truth` begins at the first y_m, because the commands
    begin there, and a log without y_m begins at its earliest stamp.
    """
    truth = signals.get("truth")
    if truth is not None and "t" in truth.names:
        start_ns = flight_start_ns(int(truth.stamp_ns[0]), float(truth["t"][0]))
        if start_ns is not None:
            return start_ns
    if "y_m" in signals:
        return int(signals["y_m"].stamp_ns[0])
    stamps = {name: int(signal.stamp_ns[0]) for name, signal in signals.items()}
    # A route may have no stamp.
    return min([stamp_ns for name, stamp_ns in stamps.items() if name != ROUTE] or stamps.values())
