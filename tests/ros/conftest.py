# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Provide fixtures for real processes over real DDS.

Each test has its own domain, and its processes are killed afterwards.
"""

import fcntl
import itertools
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Self, TypeVar

import psutil
import pytest
from _pytest.runner import runtestprotocol
from mcap.reader import make_reader
from mcap.records import Channel, Message
from tests.conftest import REPOSITORY
from tests.ros.peer import Peer, peer
from tests.ros.waiting import HANG, HOST, HostDelays, running, until

from flight_analysis.closed_loop.scenario import Scenario
from flight_bringup.processes import end_with_parent
from flight_log.scan import Scan

# a domain is used again late: processes may take a while to leave it
_numbers = itertools.count(os.getpid())

DEFAULT_SIGHUP = ("env", "--default-signal=HUP")
"""Prefix of a command under test: nohup ignores SIGHUP for all processes of the tests."""

Start = Callable[..., "Process"]
Recorder = Callable[..., "Process"]
T = TypeVar("T")


class Process:
    """A process under test and the lines of its output.

    It ends when pytest ends, even if no fixture ends it.
    """

    def __init__(
        self, *arguments: str, cwd: Path, within: Sequence[str] = (), stdin: int | None = None
    ) -> None:
        command = [*DEFAULT_SIGHUP, *within, *end_with_parent(), sys.executable, "-m", *arguments]
        pipe = subprocess.PIPE
        self.popen = subprocess.Popen(
            command, cwd=cwd, stdin=stdin, stdout=pipe, stderr=subprocess.STDOUT, text=True
        )
        self.arguments, self.lines = arguments, list[str]()
        self._reader = threading.Thread(target=self._read)
        self._reader.start()

    def _read(self) -> None:
        assert self.popen.stdout is not None
        for line in self.popen.stdout:
            self.lines.append(line.rstrip())

    @property
    def output(self) -> str:
        """Return the output so far."""
        return "\n".join(self.lines)

    def has_logged(self, *parts: str) -> bool:
        """Return whether a line contains all parts.

        If the process has ended without such a line, its output is raised as an error.
        """
        has_ended = not self._reader.is_alive()
        logged = any(all(part in line for part in parts) for line in list(self.lines))
        assert logged or not has_ended, f"ended without {parts}; output:\n{self.output}"
        return logged

    def wait_for(self, text: str, timeout: float = HANG) -> Self:
        """Wait until a line contains the text. The process must not end before."""
        until(lambda: self.has_logged(text), f"the line {text!r}", timeout=timeout)
        return self

    def children(self) -> list[psutil.Process]:
        """Return its child processes."""
        return psutil.Process(self.popen.pid).children(recursive=True)

    def child(self, module: str) -> psutil.Process:
        """Return its child process that runs this module."""
        return next(child for child in self.children() if module in child.cmdline())

    def until(self, condition: Callable[[], T | None], because: str, timeout: float = HANG) -> T:
        """Wait until a condition is true. The process must not end before."""

        def holds() -> T | None:
            value = condition()
            assert value or self.popen.poll() is None, self.output
            return value

        return until(holds, because, timeout=timeout)

    def wait_for_log(self, folder: Path, size: int) -> None:
        """Wait until the logs below a folder have this size in bytes."""
        self.until(
            lambda: sum(path.stat().st_size for path in folder.rglob("*.mcap")) >= size,
            f"a log of {size} bytes",
        )

    @contextmanager
    def stopped(self) -> Iterator[None]:
        """Stop the process, as SIGSTOP does, until the block is left."""
        self.popen.send_signal(signal.SIGSTOP)
        try:
            yield
        finally:
            self.popen.send_signal(signal.SIGCONT)

    def interrupt(self) -> Self:
        """Send SIGINT, as Ctrl-C does."""
        self.popen.send_signal(signal.SIGINT)
        return self

    def succeed(self, timeout: float = HANG) -> Self:
        """Wait for the end with status 0."""
        assert self.end(timeout) == 0, self.output
        return self

    def end(self, timeout: float = HANG) -> int:
        """Wait for the end, and return the exit status."""
        try:
            status = self.popen.wait(timeout)
        except subprocess.TimeoutExpired:
            pytest.fail(f"still running after {timeout} s; output:\n{self.output}")
        self._reader.join()
        assert self.popen.stdout is not None
        for stream in (self.popen.stdin, self.popen.stdout):
            if stream is not None:
                stream.close()
        return status


@pytest.fixture
def host_delays() -> HostDelays:
    """Return the delays of the host, by which a test extends its time limits."""
    return HOST


LONGEST_PAUSE = 0.1
"""s. The longest delay of the host that a test in real time bears, unless its mark `longest_pause`
has another: the age limit of y and y_m in the shipped scenarios."""

IN_REAL_TIME = Path(__file__).parent  # the folder of the tests that may be run again
ATTEMPTS = 3
INCONCLUSIVE = "inconclusive"  # key of the property of a report


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_protocol(item: pytest.Item, nextitem: pytest.Item | None) -> bool | None:
    """Run a test again if it failed during a longer delay of the host than it tolerates.

    A failure without such a delay is a failure. If the host delayed each of three attempts, the
    test is skipped as inconclusive. If all three failed alike, it fails, because then the host is
    not the cause. The summary names the test in both cases.
    """
    if not item.path.is_relative_to(IN_REAL_TIME):
        return None
    if not HOST.is_alive():
        HOST.start()
    mark = item.get_closest_marker("longest_pause")
    bears = float(mark.args[0]) if mark else LONGEST_PAUSE
    item.ihook.pytest_runtest_logstart(nodeid=item.nodeid, location=item.location)
    failures = set[str]()
    for attempt in range(1, ATTEMPTS + 1):
        begin = time.time()
        reports = runtestprotocol(item, log=False, nextitem=nextitem)
        pause = HOST.longest(begin)
        if pause <= bears or not any(report.failed for report in reports):
            break
        sentence = (
            f"the host paused for {pause:.2f} s, the test bears {bears:g} s, in attempt "
            f"{attempt} of {ATTEMPTS}"
        )
        item.user_properties.append((INCONCLUSIVE, sentence))
        failures.update(failure(report) for report in reports if report.failed)
    else:
        for report in reports:
            if report.failed and len(failures) > 1:
                report.outcome, report.longrepr = (
                    "skipped",
                    (str(item.path), 0, f"inconclusive: {sentence}"),
                )
    for report in reports:
        report.user_properties = list(item.user_properties)
        item.ihook.pytest_runtest_logreport(report=report)
    item.ihook.pytest_runtest_logfinish(nodeid=item.nodeid, location=item.location)
    return True


def failure(report: pytest.TestReport) -> str:
    """Return the first line of a failure without its numbers, which differ between attempts."""
    crash = getattr(report.longrepr, "reprcrash", None)
    return "" if crash is None else re.sub(r"[\d.]+", "#", str(crash.message).partition("\n")[0])


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """Name each attempt that the host made inconclusive."""
    lines = [
        f"{report.nodeid}: {sentence}"
        for reports in terminalreporter.stats.values()
        for report in reports
        if getattr(report, "when", "") == "teardown"
        for key, sentence in report.user_properties
        if key == INCONCLUSIVE
    ]
    if lines:
        terminalreporter.section("inconclusive attempts")
        terminalreporter.write_line("\n".join(lines))


def is_closed(run: Path) -> bool:
    """Return whether the recorder of a run has closed its file, by the reader of mcap.

    A closed file has a summary. The notes of a log do not show this, because they also say what a
    busy host left out.
    """
    with next(run.glob("*.mcap")).open("rb") as stream:
        return make_reader(stream).get_summary() is not None


def settable_clock(folder: Path) -> Path:
    """Return a library, from faults/clock.c, that gives processes a clock that can be set."""
    compiler = shutil.which("cc")
    if compiler is None:
        pytest.skip("no C compiler for a clock that can be set")
    library = folder / "clock.so"
    source = Path(__file__).parent / "flight_bringup" / "faults" / "clock.c"
    subprocess.run(
        [compiler, "-shared", "-fPIC", "-O2", "-o", library, source, "-ldl", "-lpthread"],
        check=True,
    )
    return library


@contextmanager
def reserved_domain() -> Iterator[int]:
    """Yield a ROS domain that no other test of this host has until the block is left.

    This includes tests of other workers and checkouts. The ports of domains 1 to 100 are below the
    ephemeral ports of Linux.
    """
    for number in (1 + next(_numbers) % 100 for _ in range(100)):
        with (Path(tempfile.gettempdir()) / f"ros_domain_{number}.lock").open("a") as lock:
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                continue
            yield number
            return
    pytest.fail("ROS domains 1 to 100: all reserved by other tests, expected a free one")


@pytest.fixture(autouse=True)
def domain(monkeypatch: pytest.MonkeyPatch) -> Iterator[int]:
    """Yield a ROS domain of this test alone."""
    with reserved_domain() as number:
        monkeypatch.setenv("ROS_DOMAIN_ID", str(number))
        yield number


@pytest.fixture
def start(tmp_path: Path) -> Iterator[Start]:
    """Start `python -m MODULE ...` in the test's folder, optionally `within` another command.

    Processes that still run at the end of the test are killed with their children.
    """
    started: list[Process] = []

    def begin(*arguments: str, within: Sequence[str] = ()) -> Process:
        started.append(Process(*arguments, cwd=tmp_path, within=within))
        running.append(started[-1])
        return started[-1]

    running[:] = []
    yield begin
    for process in started:
        if process.popen.poll() is None:
            for child in process.children():
                child.kill()
            process.popen.kill()
        # pytest shows it where the test failed
        print(*process.arguments, "ended with status", process.end())
        print(*process.lines[-30:], sep="\n")


@pytest.fixture
def start_node(start: Start, osprey_gust: Scenario) -> Start:
    """Start the node of a package with the parameters of the default scenario.

    More ROS arguments may follow.
    """
    return lambda package, *arguments, within=(): start(
        f"{package}.main",
        "--ros-args",
        "--params-file",
        str(osprey_gust.path),
        *arguments,
        within=within,
    )


@pytest.fixture
def recorder(start_node: Start) -> Recorder:
    """Start a recorder with a folder and further parameters."""
    return lambda folder, *parameters: start_node(
        "flight_recorder",
        *(
            word
            for parameter in (f"directory:={folder}", *parameters)
            for word in ("-p", parameter)
        ),
    )


@pytest.fixture
def publisher(domain: int) -> Iterator[subprocess.Popen[str]]:
    """Publish six topics at 1 kHz, as wide as those of a flight, until the test ends."""
    command = [sys.executable, "-m", "benchmarks.recorder", "1000", "120"]  # Hz, s
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, cwd=REPOSITORY)
    yield process
    process.terminate()
    process.communicate(timeout=20.0)


@pytest.fixture
def peer_node(request: pytest.FixtureRequest) -> Iterator[Peer]:
    """Yield a peer with subscriptions to the topics that the module names in PEER_TOPICS."""
    with peer(getattr(request.module, "PEER_TOPICS", ())) as node:
        yield node


def logged(run: Path) -> Iterator[tuple[str, Message]]:
    """Yield all messages of a log, which may still grow, with their topics."""
    for path in run.glob("*.mcap"):
        topics: dict[int, str] = {}
        for record in Scan(path).records():
            if isinstance(record, Channel):
                topics[record.id] = record.topic
            elif isinstance(record, Message):
                yield topics[record.channel_id], record
