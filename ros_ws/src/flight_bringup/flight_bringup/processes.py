# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Start the processes of a flight in two stages, watch them and stop them.

No process outlives the command.
"""

import json
import math
import re
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Self

from flight_analysis.closed_loop.scenario import ParameterOverrides, Scenario
from flight_bringup.graph import (
    AIRCRAFT,
    BRIDGE,
    FIRST_STAGE,
    LEAD,
    LEARNER,
    ON_START,
    ONE_PROCESS,
    RECORDER,
    Autopilot,
    NodeSpec,
    parameter_overrides,
    second_stage,
    start_instant,
    start_lead,
)
from flight_bringup.interrupt import handle_signals
from flight_core.files import dump_yaml, write_file
from flight_core.outcome import (
    COMPLETED,
    INTERRUPTED,
    STATUS_BAD_INPUT,
    STATUS_LANDED,
    STATUS_LOST_CONTACT,
    End,
    Outcome,
    ended_early,
    never_flew,
)
from flight_core.parameters import ParameterError, nest
from flight_core.rates import seconds
from flight_core.scheduling import leave_real_time_priority
from flight_log.bag import OUTCOME_FILE

if TYPE_CHECKING:
    from flight_bringup.monitor import FlightMonitor

STOP_TIMEOUT = 2.5  # s for all processes together except the recorder; a node needs 0.2 s
# s for the recorder. It needs 0.2 s, but must also close its log on a busy host or disk.
CLOSE_TIMEOUT = 30.0
SEARCH_TIMEOUT = 300.0  # s for a learner in lockstep; a search takes 5 s of a core
READY_TIMEOUT = 20.0  # s
NO_CLOCK = "/clock: no message of a simulator"
FIRST_Y = 20.0  # s for which a bridge waits for the first y of its autopilot
# Largest share of the duration for which a bridge waits for the first y. So in a short flight the
# bridge still ends before the flight does, and says why.
BEFORE_END = 0.8
FIRST_U = 5.0  # s, longest time from t = 0 until the aircraft takes its first u
LOG_TIMEOUT = 5.0  # s without a change of the log, after the duration
POLL_PERIOD = 0.005  # s, time between two checks while nodes start


def end_with_parent() -> list[str]:
    """Return the beginning of a command that must end when this process dies.

    The words are put before the command, which then gets SIGTERM when this process dies. The result
    is empty if the host has no setpriv of util-linux.
    """
    setpriv = shutil.which("setpriv")
    return [setpriv, "--pdeathsig", "TERM"] if setpriv else []


def start_instants(lead: float, monitor: "FlightMonitor") -> tuple[float, float]:
    """Return the instant of t = 0 by the clock of the stamps and by the clock of the ticks, s.

    t = 0 is `lead` s from now by the host's clock.
    """
    clock = monitor.clock
    lead = monitor.ahead(lead)
    return start_instant(lead, seconds(clock.time_ns())), seconds(clock.monotonic_ns()) + lead


def leave_outcome(run: Path, outcome: Outcome) -> None:
    """Write the outcome of a flight to the folder `run`, where the recorder reads it.

    Without a recorder, `run` is `Path()`, and nothing is written. If the disk is full, only the
    outcome is missing in the log.
    """
    if run.name:
        with suppress(OSError, ParameterError):
            write_file(run / OUTCOME_FILE, outcome.text())


# The beginning of the line in which a node says why it ends.
CAUSE = re.compile(r"\[FATAL\]|error: ")


class NotReadyError(ParameterError):
    """Raised if a node is not ready in time, or ends before it is ready, with valid parameters."""


class NodeProcess:
    """A process that runs a node, or several nodes.

    The output of the process goes to a file. `lines` has its last lines. `cause` is the line that
    says why the process ended, even if a long traceback follows this line.
    """

    def __init__(
        self,
        node: NodeSpec,
        scenario_file: Path,
        overrides: ParameterOverrides,
        log: Path,
        namespace: str = "",
    ) -> None:
        self.node = node
        self.lines: deque[str] = deque(maxlen=20)
        self.cause = ""
        # -P, because a package in the working folder must not replace a package of the stack
        module = ["-P", "-m", node.module]
        command = [*end_with_parent(), sys.executable, *module]
        arguments = ["--ros-args", "--params-file", str(scenario_file)]
        if namespace:
            arguments += ["-r", f"__ns:={namespace}"]
        # `-p node:name` would address a node without a namespace.
        if node is ONE_PROCESS:
            sections = nest({name.replace(":", ".", 1): value for name, value in overrides.items()})
            file = log.with_suffix(".yaml")
            write_file(
                file,
                dump_yaml(
                    {
                        f"/**/{name}": {"ros__parameters": values}
                        for name, values in sections.items()
                    }
                ),
            )
            arguments = [*sections, *arguments, "--params-file", str(file)]
            overrides = {}
        for name, value in overrides.items():
            # JSON is valid YAML, and has quotes wherever they are needed
            arguments += ["-p", f"{name}:={json.dumps(value)}"]
        self._log = log.open("x", encoding="utf-8")
        self.popen = subprocess.Popen(  # noqa: S603 - our own interpreter and modules
            [*command, *arguments],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            # Ctrl-C must reach only the command, which then stops the nodes in their order
            process_group=0,
        )
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def _read(self) -> None:
        if self.popen.stdout is None:
            return
        for line in self.popen.stdout:
            self.lines.append(line.rstrip())
            if CAUSE.match(line):
                self.cause = line.rstrip()
            # A full disk must not block the pipe, and with it the node.
            with suppress(OSError):
                self._log.write(line)
                self._log.flush()

    def finish(self) -> int:
        """Wait for the end of the process, read the rest of its output, and return its status."""
        status = self.popen.wait()
        self._reader.join(timeout=1.0)
        with suppress(OSError):
            self._log.close()
        if self.popen.stdout is not None:
            self.popen.stdout.close()
        return status


class FlightProcesses:
    """All processes of one flight, as a context manager that stops them when it exits.

    `monitor` reports which nodes are ready, and must be in the same `namespace`. With an autopilot,
    the bridge starts in place of the simulated aircraft. If a simulated aircraft flies in real
    time, `match` waits until the flight is ready, and `begin` then sets t = 0. `announce` gets a
    line if processes had to be killed. `pause` sleeps for a duration, s, between two checks of
    nodes that start.
    """

    def __init__(
        self,
        scenario: Scenario,
        run: Path,
        monitor: "FlightMonitor",
        *,
        lockstep: bool,
        one_process: bool,
        autopilot: Autopilot | None = None,
        namespace: str = "",
        announce: Callable[[str], None] = lambda line: None,
        pause: Callable[[float], None] = time.sleep,
    ) -> None:
        self._announce = announce
        self._pause = pause
        self.scenario = scenario
        self._run = run
        self.monitor = monitor
        self._namespace = namespace
        self.lockstep = lockstep
        self.autopilot = autopilot
        self._first: tuple[NodeSpec, ...] = FIRST_STAGE
        self._second = second_stage(scenario, bridge=autopilot is not None)
        # In the same process, a search of the learner would delay ticks.
        apart = (LEARNER,) if LEARNER in self._second and not lockstep else ()
        self._in_one_process = [
            spec.executable for spec in (*self._first, *self._second) if spec not in apart
        ]
        if one_process:
            self._first = ()
            self._second = (ONE_PROCESS, *apart)
        self.processes: list[NodeProcess] = []
        self.outcome = INTERRUPTED  # outcome of the flight in the log
        self.start_time = math.inf  # time of t = 0 by the stamps, s
        # The same by the clock of the ticks, so that a step of the system clock does not change t.
        self.started = math.inf
        self._on_start = not lockstep and autopilot is None

    def __enter__(self) -> Self:
        try:
            # Check before any node starts, because a controller would engage on the y and y_m of
            # another flight.
            self.monitor.require_free_domain()
            begin = time.monotonic()
            for node in self._first:
                self._start(node)
            self._wait_until_ready(begin + READY_TIMEOUT)
            self.monitor.require_free_domain()  # another flight may have begun in the meantime
            if not self._on_start:
                lead = start_lead(time.monotonic() - begin)
                self._set_start(start_instants(lead, self.monitor))
            for node in self._second:
                self._start(node)
        except BaseException as error:
            if isinstance(error, ParameterError):
                self.outcome = never_flew(str(error))
            self.stop()
            raise
        return self

    def _set_start(self, start: tuple[float, float]) -> None:
        self.start_time, self.started = start

    def match(self) -> Outcome | None:
        """Wait until each node is ready and each input has a publisher.

        Returns an outcome if the flight cannot begin, else None.
        """
        deadline = time.monotonic() + READY_TIMEOUT
        while self._on_start and (waiting := self._unmatched()):
            if (outcome := self.ended()) is not None:
                return outcome
            if time.monotonic() > deadline:
                return never_flew(f"{'; '.join(waiting)} after {READY_TIMEOUT:g} s")
            self._pause(POLL_PERIOD)
        return None

    def begin(self, start: tuple[float, float] | None = None) -> Outcome | None:
        """Set t = 0 after `match`. Returns an outcome if the flight cannot begin, else None.

        `start` has t = 0 by the system clock and by the monotonic clock, s. It is given if several
        flights share t = 0. If it is None, t = 0 is LEAD from now.
        """
        leave_real_time_priority()  # the nodes have this priority
        outcome = self.match()
        if outcome is None and self._on_start:
            self._set_start(start or start_instants(LEAD, self.monitor))
            self.monitor.start(self.start_time)
        return outcome

    def _names(self, process: NodeProcess) -> list[str]:
        """Return the names of the nodes in a process."""
        return self._in_one_process if process.node is ONE_PROCESS else [process.node.executable]

    def _nodes(self) -> list[tuple[str, int]]:
        """Return the name and the process id of each node."""
        nodes: list[tuple[str, int]] = []
        for process in self.processes:
            nodes += [(name, process.popen.pid) for name in self._names(process)]
        return nodes

    def _unmatched(self) -> list[str]:
        """Say what each node lacks for which the flight still waits."""
        names = self._nodes()
        ready = {name: self.monitor.is_ready(name, pid) for name, pid in names}
        unmatched = [name for name, pid in names if not self.monitor.is_matched(name, pid)]
        return [
            f"{name} {'has an input without a publisher' if ready[name] else 'not ready'}"
            for name in unmatched
        ]

    def __exit__(self, *_: object) -> None:
        self.stop()

    def _start(self, node: NodeSpec) -> None:
        log = self._run / "log" / f"{node.executable}.log"
        log.parent.mkdir(parents=True, exist_ok=True)
        start = ON_START if self._on_start else self.start_time
        overrides = parameter_overrides(
            node,
            self.scenario,
            self._run,
            start,
            lockstep=self.lockstep,
            use_sim_time=self.monitor.by_clock,
            autopilot=self.autopilot,
        )
        if node is BRIDGE:
            first_y = min(FIRST_Y, BEFORE_END * self.scenario.flight.duration)
            overrides = {**overrides, "first_y": first_y}
        self.processes.append(
            NodeProcess(
                node=node,
                scenario_file=self.scenario.path,
                overrides=overrides,
                log=log,
                namespace=self._namespace,
            )
        )

    def _wait_until_ready(self, deadline: float) -> None:
        while (waiting := self.waiting()) or not self.monitor.has_time():
            if (outcome := self.ended()) is not None:
                statuses = {process.popen.poll() for process in self.processes}
                error = ParameterError if STATUS_BAD_INPUT in statuses else NotReadyError
                raise error(outcome.reason)
            if time.monotonic() > deadline:
                if waiting:
                    late = f"timed out waiting for {', '.join(waiting)}: not ready"
                else:
                    late = NO_CLOCK
                raise NotReadyError(
                    f"{late} after {READY_TIMEOUT:g} s; see the logs in {self._run / 'log'}"
                )
            self._pause(POLL_PERIOD)

    def ended(self) -> Outcome | None:
        """Return the outcome if a process or the simulated time has ended, else None.

        If a flight is in real time, the end of a learner is no outcome, because the law flies on.
        On a busy host several processes may have ended since the last call. In this case a landing
        is taken as the cause of the end. A process that only lost contact with another process is
        not.
        """
        processes = [
            process for process in self.processes if self.lockstep or process.node is not LEARNER
        ]
        ended_processes = [process for process in processes if process.popen.poll() is not None]
        causes = {STATUS_LANDED: 0, STATUS_LOST_CONTACT: 2}
        ended_processes.sort(key=lambda process: causes.get(process.popen.returncode, 1))
        if ended_processes:
            return _outcome(ended_processes[0])
        return self.monitor.end_of_clock()

    def pop_end_of_learner(self) -> Outcome | None:
        """Return how the learner has ended, at the first call after its end, else None."""
        for process in self.processes:
            if process.node is LEARNER and process.popen.poll() is not None:
                self.processes.remove(process)
                return _outcome(process)
        return None

    def waiting(self) -> list[str]:
        """Return the names of the nodes that are not ready yet."""
        return [name for name, pid in self._nodes() if not self.monitor.is_ready(name, pid)]

    def is_flying(self) -> bool:
        """Return whether the aircraft has taken a u."""
        return any(
            self.monitor.is_flying(name, pid)
            for name, pid in self._nodes()
            if name == AIRCRAFT.executable
        )

    def is_completed(self) -> bool:
        """Return whether the aircraft has completed a lockstep flight by taking the last u."""
        return any(
            self.monitor.is_completed(name, pid)
            for name, pid in self._nodes()
            if name == AIRCRAFT.executable
        )

    def last_words(self, node: NodeSpec) -> str | None:
        """Return the last line in which a node waits for a topic or refuses a sample, or None."""
        lines: list[str] = []
        for process in self.processes:
            if node.executable in self._names(process):
                lines += process.lines
        for line in reversed(lines):
            if "waiting for" in line or "refused" in line:
                return re.sub(r"^(\[[^]]*\] ?)*(: )?", "", line)
        return None

    def stop(self) -> None:
        """Stop all processes, the recorder last.

        A process that has not ended after STOP_TIMEOUT is killed, and the recorder after
        CLOSE_TIMEOUT. At the end of a lockstep flight, a learner first completes its search.
        """
        # A second Ctrl-C must not interrupt this, because it would truncate the log.
        with handle_signals(signal.SIG_IGN):
            if self.processes:
                leave_outcome(self._run, self.outcome)
            searches = self.lockstep and self.outcome == COMPLETED and self.scenario.has_learner()
            last = {
                RECORDER: CLOSE_TIMEOUT,
                ONE_PROCESS: SEARCH_TIMEOUT if searches else CLOSE_TIMEOUT,
            }
            first = {LEARNER: SEARCH_TIMEOUT} if searches else {}
            middle = {
                process.node: STOP_TIMEOUT
                for process in self.processes
                if process.node not in last | first
            }
            killed: list[str] = []
            for timeouts in (first, middle, last):
                deadline = time.monotonic() + max(timeouts.values(), default=0.0)
                group = [process for process in self.processes if process.node in timeouts]
                for process in group:
                    if process.popen.poll() is None:
                        # SIGINT would print a traceback while Python is still importing.
                        process.popen.terminate()
                for process in group:
                    try:
                        process.popen.wait(max(deadline - time.monotonic(), 0.2))
                    except subprocess.TimeoutExpired:
                        process.popen.kill()
                        killed.append(process.node.executable)
                    process.finish()
            if killed:
                count = f"{len(killed)} of {len(self.processes)} processes"
                self._announce(f"{count} did not end and had to be killed: {', '.join(killed)}")
            self.processes = []


def _outcome(process: NodeProcess) -> Outcome:
    """Return the outcome of a flight, given the process that ended it."""
    name = process.node.executable
    status = process.finish()
    if status < 0:
        return ended_early(f"{name} was killed by {signal.Signals(-status).name}")
    if status == 0:
        return ended_early(f"{name} was shut down")
    lines = [line for line in process.lines if line.strip()] or ["no output"]
    cause = process.cause or lines[-1]
    message = re.sub(r"^(\[[^]]*\] ?)*(: )?|^error: ", "", cause)  # without the logger's brackets
    if status == STATUS_LANDED:
        return Outcome(End.LANDED, message)
    return ended_early(f"{name} ended with status {status}: {message}")
