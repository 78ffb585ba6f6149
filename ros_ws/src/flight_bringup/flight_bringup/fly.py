# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Fly a scenario over topics, in real time or in lockstep, or in one process."""

import math
import re
import time
from collections.abc import Callable, Generator, Mapping
from enum import Enum, auto
from pathlib import Path
from typing import TYPE_CHECKING

from flight_analysis.closed_loop.learning_loop import Learn
from flight_analysis.closed_loop.scenario import Scenario, load_scenario
from flight_analysis.closed_loop.scenario_library import as_flown, find_scenario, save_scenario
from flight_analysis.closed_loop.simulate import fly
from flight_analysis.report.display_units import display_units
from flight_analysis.report.run_folder import attachments_for, new_run
from flight_analysis.report.run_report import FlightResult, write_report
from flight_bringup.graph import CONTROLLER, Autopilot
from flight_bringup.interrupt import DeferredInterrupt, handle_signals
from flight_bringup.processes import (
    FIRST_U,
    LOG_TIMEOUT,
    SEARCH_TIMEOUT,
    FlightProcesses,
    NotReadyError,
)
from flight_core.arguments import FilePath, as_path
from flight_core.environment import require_ros_environment
from flight_core.files import writing
from flight_core.outcome import (
    COMPLETED,
    INTERRUPTED,
    Outcome,
    ended_early,
    log_ends_at,
    never_flew,
)
from flight_core.parameters import ParameterError, require
from flight_core.rates import NANOSECONDS, seconds
from flight_core.tape import Signal
from flight_log.learning_messages import OK, WARN
from flight_log.tape_writer import EXPECTED, TapeWriter
from rise_di_controller.learning.proposals import Event

if TYPE_CHECKING:
    from flight_bringup.monitor import FlightMonitor

POLL_PERIOD = 0.05  # s, period of the progress bar
NUMBER = re.compile(r"-?\d+(\.\d+)?(e[-+]\d+)?")  # a number in a reason, such as "q is 0.30 s old"

STAMP_ERROR = 1e-5  # s, rounding error of a time of day as a float

STALL_TIMEOUT = 40.0
"""Time without progress after which a lockstep flight ends, s. If contact with a node is lost, the
flight ends within three seconds."""


Progress = Callable[[float, str], None]  # flight time in s, and the text beside it

Steps = Generator[None, None, Outcome]
"""A flight that is followed: each step checks it once, and the last step returns the outcome."""


def fly_over_topics(
    scenario: Scenario,
    run: Path,
    progress: Progress,
    *,
    lockstep: bool = False,
    one_process: bool = False,
    use_sim_time: bool = False,
    autopilot: Autopilot | None = None,
    namespace: str = "",
    announce: Callable[[str], None] = lambda line: None,
    engaged_for: float = math.inf,
) -> Outcome:
    """Fly a scenario over topics, record the bag into `run`, and return the outcome.

    The nodes are separate processes, or share one if `one_process` is True. By default they fly in
    real time. With `lockstep` they fly as fast as the machine allows, and with `use_sim_time` by
    the topic /clock. All nodes are in the `namespace`, such as "/uav1". In real time, an
    `autopilot` can take the place of the simulated aircraft.

    `announce` is called with a line when the phase of an engagement or its reason changes, except
    if only a number in the reason changes. It also gets a line on what became of a learner's
    proposal, and on a process that had to be killed. If `engaged_for`, s, is given, the flight ends
    this long after its first engagement, or when the engagement ends. If the law is
    not engaged by the duration minus `engaged_for`, the flight ends, too, because the engagement
    would be too short.

    The outcome is COMPLETED, LANDED or INTERRUPTED (by Ctrl-C, SIGTERM or SIGHUP), or says why the
    flight did not begin or ended early.
    """
    require_ros_environment()
    from flight_bringup.monitor import FlightMonitor  # noqa: PLC0415 - loads rclpy, which other commands do not need

    interrupt = DeferredInterrupt(only_in_pauses=True)
    try:
        with (
            handle_signals(interrupt),
            FlightMonitor(
                scenario.controller.outputs,
                lockstep=lockstep,
                use_sim_time=use_sim_time,
                learns=scenario.has_learner(),
                namespace=namespace,
            ) as monitor,
            FlightProcesses(
                scenario,
                run,
                monitor,
                lockstep=lockstep,
                one_process=one_process,
                autopilot=autopilot,
                namespace=namespace,
                announce=announce,
                pause=interrupt.pause,
            ) as processes,
        ):
            refusal = processes.begin()
            steps = follow(processes, progress, announce, engaged_for)
            processes.outcome = refusal or run_to_end(steps, interrupt.pause)
            return processes.outcome
    except KeyboardInterrupt:
        return INTERRUPTED
    except NotReadyError as error:
        return never_flew(str(error))


def run_to_end(steps: Steps, pause: Callable[[float], None]) -> Outcome:
    """Follow a flight to its last step, with a `pause` between steps, and return the outcome."""
    while True:
        try:
            next(steps)
        except StopIteration as end:
            outcome: Outcome = end.value
            return outcome
        pause(POLL_PERIOD)


def follow(
    processes: FlightProcesses,
    progress: Progress,
    announce: Callable[[str], None] = lambda line: None,
    engaged_for: float = math.inf,
) -> Steps:
    """Return the steps that follow a started flight. The caller takes one every POLL_PERIOD.

    Each step checks the flight once. The arguments have the same meaning as for `fly_over_topics`.
    """
    if processes.lockstep:
        return _follow_lockstep(processes, progress, announce)
    scenario = processes.scenario
    must_begin = (
        processes.autopilot is None
        and scenario.controller.autostart
        and scenario.controller.start_active
    )
    span = _Span(scenario, processes, processes.monitor, must_begin=must_begin)
    return _follow_real_time(processes, progress, announce, engaged_for, span)


class _Phase(Enum):
    """Phase of a flight in real time, from its start until the aircraft takes u."""

    OPEN = auto()  # the flight need not begin: there may never be a u
    WAITING = auto()  # the controller has not published
    PUBLISHED = auto()  # the controller has published, but the aircraft has not taken u
    FLYING = auto()  # the aircraft takes u

    @property
    def is_awaited(self) -> bool:
        """Whether the flight must still begin."""
        return self in {_Phase.WAITING, _Phase.PUBLISHED}


class _Span:
    """Tells when a flight in real time has begun, and when it is over.

    A flight has begun when the aircraft takes u. It is over when the log holds y, y_m and u up to
    the end of the flight. With an autopilot, or with a controller that a user activates, there may
    never be a u. In these cases `must_begin` is False, and the phase is OPEN to the end.
    """

    def __init__(
        self,
        scenario: Scenario,
        processes: FlightProcesses,
        monitor: "FlightMonitor",
        *,
        must_begin: bool,
    ) -> None:
        self._duration = scenario.flight.duration
        self._processes = processes
        self._monitor = monitor
        self._until = -math.inf  # s, flight time up to which the log holds y, y_m and u
        self._last_change = (
            0.0 if must_begin else -math.inf
        )  # s, flight time at which _until last grew
        self._phase = _Phase.WAITING if must_begin else _Phase.OPEN

    def note_u(self) -> None:
        """Note that the controller has published u."""
        if self._phase is _Phase.WAITING:
            self._phase = _Phase.PUBLISHED

    def outcome(self, t: float) -> Outcome | None:
        """Return the outcome after a flight whose log is whole or no longer grows, else None."""
        if (
            stamp := self._monitor.recorded()
        ) is not None and stamp - self._processes.start_time > self._until:
            self._until = stamp - self._processes.start_time
            self._last_change = t
        if t < self._duration:
            return None
        if self._until >= self._duration - STAMP_ERROR:
            return COMPLETED
        if self._phase.is_awaited or t < self._last_change + LOG_TIMEOUT:
            return None
        if self._phase is _Phase.OPEN:
            return COMPLETED
        return log_ends_at(self._until, self._duration)

    def check_begin(self, t: float) -> Outcome | None:
        """Note whether the aircraft takes u, and return the outcome if it should but does not."""
        if self._phase.is_awaited and self._processes.is_flying():
            self._phase = _Phase.FLYING
        if not self._phase.is_awaited or t < FIRST_U:
            return None
        if self._phase is _Phase.PUBLISHED:
            return never_flew("u did not reach the aircraft")
        why = self._processes.last_words(CONTROLLER)
        return never_flew(f"y did not reach the controller{'' if why is None else f' ({why})'}")


def _follow_real_time(
    processes: FlightProcesses,
    progress: Progress,
    announce: Callable[[str], None],
    engaged_for: float,
    span: _Span,
) -> Steps:
    scenario = processes.scenario
    monitor = processes.monitor
    units = display_units(scenario)
    outputs = scenario.controller.outputs
    text = "starting"
    phase = ""
    why = ""
    announced = ""
    engaged_at = math.inf
    while True:
        _announce_learned(processes, processes.start_time, announce)
        t = seconds(monitor.clock.monotonic_ns()) - processes.started
        if outcome := span.outcome(t) or processes.ended() or span.check_begin(t):
            return outcome
        for phase, why in monitor.engagement():
            line = f"{phase}{f': {why}' if why else ''}"
            if (kind := NUMBER.sub("", line)) != announced:
                announce(line)
            announced = kind
            if phase == "ENGAGED":
                engaged_at = min(engaged_at, t)
        if t > engaged_at + engaged_for or (
            engaged_for < math.inf and engaged_at < math.inf and phase != "ENGAGED"
        ):
            return COMPLETED
        if engaged_at == math.inf and t > (latest := scenario.flight.duration - engaged_for) > 0.0:
            return ended_early(f"not engaged within {latest:.3g} s")
        if phase not in {"", "ENGAGED"}:
            text = f"{phase}: {why}"
        elif (status := monitor.newest()) is not None:
            mode, values = status
            span.note_u()
            errors = (
                f"{name} {e * units[name].factor:+.2f}"
                for name, e in zip(outputs, values, strict=True)
            )
            text = f"{mode}  e: {', '.join(errors)}"
        progress(min(max(t, 0.0), scenario.flight.duration), text)
        yield


def _announce_learned(
    processes: FlightProcesses,
    start_time: float,
    announce: Callable[[str], None],
) -> None:
    """Announce what became of the learner's proposals since the last call.

    If the learner's process has ended, its end is announced as well, because the flight goes on
    without a learner.
    """
    for instant, sentence in processes.monitor.learned():
        announce(f"t = {instant - start_time:.2f} s: {sentence}")
    if (outcome := processes.pop_end_of_learner()) is not None:
        announce(f"{outcome.reason}: the law continues with the model that it has")


def _follow_lockstep(
    processes: FlightProcesses,
    progress: Progress,
    announce: Callable[[str], None],
) -> Steps:
    """Follow a lockstep flight from its first instant to its last.

    The text of `progress` has the real-time factor since the first instant in the log. The flight
    ends when the aircraft has taken the last u and the log is complete.
    """
    scenario = processes.scenario
    # The last instant is the beginning of the aircraft's last whole period.
    end = scenario.flight.duration - 1.0 / scenario.aircraft.rate
    t = 0.0
    last_change = time.monotonic()
    text = "lockstep, starting"
    timeout = SEARCH_TIMEOUT if scenario.has_learner() else STALL_TIMEOUT
    # monotonic time and flight time of the first instant, s
    first: tuple[float, float] | None = None
    while t < end or not processes.is_completed():
        if (outcome := processes.ended()) is not None:
            return outcome
        now = time.monotonic()
        if (recorded_t := processes.monitor.recorded()) is not None:
            t = recorded_t
            last_change = now
            if first is None:
                first = now, t
            else:
                text = f"lockstep, {(t - first[1]) / (now - first[0]):.1f} times real time"
        elif now > last_change + timeout:
            return ended_early(f"no progress for {timeout:g} s at t = {t:g} s")
        _announce_learned(processes, 0.0, announce)
        progress(t, text)
        yield
    _announce_learned(processes, 0.0, announce)
    return COMPLETED


def fly_in_process(
    scenario: Scenario,
    run: Path,
    progress: Progress,
    learn: Learn | None = None,
    announce: Callable[[str], None] = lambda line: None,
) -> Outcome:
    """Fly in one process without ROS, write the bag into `run`, and return the outcome.

    The flight is as fast as the machine allows. `learn` makes the learner if the scenario has one.
    Each action of the learner is announced as a line, and written to log/learner.log.
    """
    interrupt = DeferredInterrupt()

    def record(signals: Mapping[str, Signal]) -> None:
        with interrupt.deferred():
            writer.write(signals)

    def learned(event: Event) -> None:
        line = f"t = {event.stamp_ns / NANOSECONDS:.2f} s: {event.sentence}"
        with interrupt.deferred():
            level = OK if event.change else WARN
            writer.write_learning(event.stamp_ns, event.kind, event.sentence, level=level)
            if event.change:
                writer.write_changes(event.stamp_ns, f"/{CONTROLLER.executable}", event.change)
            (run / "log").mkdir(exist_ok=True)
            with (run / "log" / "learner.log").open("a", encoding="utf-8") as log:
                log.write(f"{line}\n")
        announce(line)

    with (
        writing("", run, EXPECTED),
        TapeWriter(run, attachments_for(scenario, run)) as writer,
        handle_signals(interrupt),
    ):
        outcome = fly(
            scenario, record, lambda t: progress(t, "in one process"), learn=learn, announce=learned
        )
        with interrupt.deferred():
            writer.add_outcome(outcome)
    return outcome


def fly_and_report(
    scenario: FilePath | Scenario,
    runs: FilePath = "runs",
    progress: Callable[[float], None] | None = None,
    learn: Learn | None = None,
) -> FlightResult:
    """Fly a scenario in one process, with log and report in a new folder of `runs`.

    The command `rise-di fly --in-process` does the same. A scenario that differs from its file is
    written beside the log. If the flight ended early, the log holds this outcome.

    Args:
        scenario: Name, path of a scenario file (.yaml), or a Scenario.
        runs: Folder in which the folder of the run is created.
        progress: Called with the flight time, s, once per simulated second.
        learn: Makes the learner, if the scenario has one, as for `simulate`.

    Returns:
        The flight, and the paths of log and report.

    Raises:
        ParameterError: The folder cannot be written, or the flight ended before the first sample.

    Examples:
        >>> flight = rise_di.fly(rise_di.find_scenario("osprey_servo", duration=0.1))
        >>> str(flight.flight.tape.outcome), flight.report.name
        ('completed', 'report.html')
    """
    require(
        progress is None or callable(progress),
        "progress",
        progress,
        "a function of the flight time in s",
    )
    found = find_scenario(scenario)
    run = new_run(found, as_path(runs, "runs", "the path of a folder"))
    flown = with_file(found, run)
    outcome = fly_in_process(
        flown, run, lambda t, _: None if progress is None else progress(t), learn
    )
    return write_report(run, outcome)


def _equals_its_file(scenario: Scenario) -> bool:
    """Return whether a scenario still equals the content of its file."""
    try:
        return load_scenario(scenario.path) == scenario
    except ParameterError:
        return False


def with_file(scenario: Scenario, run: Path, namespace: str = "") -> Scenario:
    """Return the scenario with a parameter file that the nodes in the namespace can read.

    If the scenario equals its own file, `as_flown` adapts this file if necessary. If it does not,
    the scenario is written to a new file in the folder of the run. Raises ParameterError if no file
    can be written.
    """
    if _equals_its_file(scenario):
        return as_flown(scenario, run, namespace)
    return save_scenario(scenario, run / f"{scenario.name}.yaml")
