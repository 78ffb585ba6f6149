# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""The processes of a flight: started together, watched, ended together; none outlives the command."""

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
from types import TracebackType
from typing import Self

from flight_analysis.closed_loop.scenario import ParameterOverrides, Scenario
from flight_bringup.graph import (
    BRIDGED,
    FIRST,
    ONE_PROCESS,
    READY,
    RECORDER,
    THEN,
    Autopilot,
    NodeSpec,
    parameters,
    start_lead,
)
from flight_core.parameters import ParameterError

STOP_TIMEOUT = 2.5  # s for all processes together; a node ends within 0.2 s
READY_TIMEOUT = 20.0  # s


def end_with_parent() -> list[str]:
    """Prefix of a command that is to end when this process is killed; util-linux, empty where that is missing."""
    setpriv = shutil.which("setpriv")
    return [setpriv, "--pdeathsig", "TERM"] if setpriv else []


class NodeProcess:
    """One node as a process of its own, its output kept in a file and in the last lines."""

    def __init__(self, node: NodeSpec, scenario_file: Path, told: ParameterOverrides, log: Path) -> None:
        self.node = node
        self.lines: deque[str] = deque(maxlen=20)
        self.ready = threading.Event()
        command = [*end_with_parent(), sys.executable, "-m", node.module, "--ros-args", "--params-file", str(scenario_file)]
        for name, value in told.items():
            command += ["-p", f"{name}:={json.dumps(value)}"]  # JSON is YAML, and quotes what needs it
        self._log = log.open("w", encoding="utf-8")
        self.popen = subprocess.Popen(  # noqa: S603 - our own interpreter and modules
            command,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            process_group=0,  # Ctrl-C reaches the command alone, which then ends the nodes in order
        )
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def _read(self) -> None:
        if self.popen.stdout is None:
            return
        for line in self.popen.stdout:
            self.lines.append(line.rstrip())
            with suppress(OSError):  # on a full disk the output is still taken, else the node would wait for it
                self._log.write(line)
                self._log.flush()
            if READY in line:
                self.ready.set()

    def finish(self) -> int:
        """Collect what is left of the output; the exit status."""
        status = self.popen.wait()
        self._reader.join(timeout=1.0)
        with suppress(OSError):
            self._log.close()
        if self.popen.stdout is not None:
            self.popen.stdout.close()
        return status


class FlightProcesses:
    """All processes of one flight. A context manager: leaving it ends them.

    `before_start` is called when the first nodes are ready, before aircraft and reference model start. With an autopilot its
    bridge starts in the aircraft's place.
    """

    def __init__(
        self,
        scenario: Scenario,
        run: Path,
        before_start: Callable[[], None],
        *,
        lockstep: bool,
        one_process: bool,
        autopilot: Autopilot | None = None,
    ) -> None:
        self._scenario, self._run, self._before_start = scenario, run, before_start
        self._lockstep, self._autopilot = lockstep, autopilot
        self._first: tuple[NodeSpec, ...] = () if one_process else FIRST
        self._then: tuple[NodeSpec, ...] = (ONE_PROCESS,) if one_process else THEN if autopilot is None else BRIDGED
        self.processes: list[NodeProcess] = []
        self.start_time = math.inf  # system time of t = 0, s; set once the first nodes are ready

    def __enter__(self) -> Self:
        try:
            begin = time.monotonic()
            first = [self._start(node) for node in self._first]
            while not all(process.ready.wait(0.02) for process in first):
                self._require_running()
                if time.monotonic() > begin + READY_TIMEOUT:
                    raise ParameterError(f"not ready after {READY_TIMEOUT:g} s; see the logs in {self._run / 'log'}")
            self._before_start()
            self.start_time = round(time.time() + start_lead(time.monotonic() - begin), 3)
            for node in self._then:
                self._start(node)
        except BaseException:
            self.stop()
            raise
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.stop()

    def _start(self, node: NodeSpec) -> NodeProcess:
        log = self._run / "log" / f"{node.executable}.log"
        log.parent.mkdir(parents=True, exist_ok=True)
        told = parameters(node, self._scenario, self._run, self.start_time, lockstep=self._lockstep, autopilot=self._autopilot)
        process = NodeProcess(node, self._scenario.path, told, log)
        self.processes.append(process)
        return process

    def ended_early(self) -> str | None:
        """A sentence for the first process that has ended by itself, None while all run."""
        for process in self.processes:
            if (status := process.popen.poll()) is not None:
                process.finish()
                if status < 0:
                    return f"{process.node.executable} was killed by {signal.Signals(-status).name}"
                if status == 0:
                    return f"{process.node.executable} was told to end"
                last = next((line for line in reversed(process.lines) if line.strip()), "no output")
                said = re.sub(r"^(\[[^]]*\] ?)*(: )?|^error: ", "", last)  # without the logger's brackets
                return f"{process.node.executable} ended with status {status}: {said}"
        return None

    def _require_running(self) -> None:
        if (sentence := self.ended_early()) is not None:
            raise ParameterError(sentence)

    def stop(self) -> None:
        """End all processes, the recorder after the others; SIGKILL for what does not end in time."""
        # A second Ctrl-C must not stop the stopping: it lasts STOP_TIMEOUT at most.
        before = {number: signal.signal(number, signal.SIG_IGN) for number in (signal.SIGINT, signal.SIGTERM)}
        deadline = time.monotonic() + STOP_TIMEOUT
        others = [process for process in self.processes if process.node is not RECORDER]
        recorder = [process for process in self.processes if process.node is RECORDER]
        for group in (others, recorder):
            for process in group:
                if process.popen.poll() is None:
                    process.popen.terminate()  # not SIGINT, which is a traceback while Python still imports
            for process in group:
                try:
                    process.popen.wait(max(deadline - time.monotonic(), 0.2))
                except subprocess.TimeoutExpired:
                    process.popen.kill()
                process.finish()
        self.processes = []
        for number, handler in before.items():
            signal.signal(number, handler)
