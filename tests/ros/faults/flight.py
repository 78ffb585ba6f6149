# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""A flight under test: four processes that can be killed and stopped, and a probe that hears and times all they say."""

import os
import re
import shutil
import signal
import struct
import subprocess
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import psutil
import rclpy
import yaml
from diagnostic_msgs.msg import DiagnosticStatus
from mcap.records import Channel, Message
from rcl_interfaces.msg import Log
from rclpy.context import Context
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from tests.ros.conftest import Process

from flight_bringup.processes import end_with_parent
from flight_core.rates import NANOSECONDS, nanoseconds, seconds
from flight_core.vectors import FloatArray
from flight_log.scan import Scan
from flight_ros import transport
from flight_ros.messages import Decoder
from flight_ros.rclpy_private import WaitSet
from flight_ros.subscriptions import PolledSubscription
from flight_ros.topics import DIAGNOSTICS, INTERNALS, TRUTH, Y_M, Topic, U, Y
from rise_di_controller.guard import Mode

PACKAGES = {
    "recorder": "flight_recorder",
    "controller": "rise_di_controller",
    "aircraft": "aircraft_sim",
    "reference_model": "reference_model",
}
OUTPUTS, INPUTS = ("q", "p", "r", "V"), ("elevator", "aileron", "rudder", "thrust")
LOGS = Topic("/rosout", Log)
TOPICS = (Y, Y_M, U, INTERNALS, TRUTH, DIAGNOSTICS, LOGS)

# In a session of its own Linux gives a process a share of a busy machine of its own too (man 7 sched, autogroup).
APART = (*(command for command in (shutil.which("setsid"),) if command), *end_with_parent())

SAYS = {"aircraft": ("truth", "y"), "reference_model": ("y_m",), "controller": ("internals", "u"), "recorder": ()}

SPEAKERS = tuple(role for role in PACKAGES if role != "recorder")  # it cannot record that it no longer records

TICK = 0.01  # s, the controller's, as in the default scenario
MAX_AGE = 0.1  # s, of y and y_m, as in the default scenario
SILENCE = 0.2  # s, of u, the aircraft's default
HOLD, RAMP = 0.2, 0.3  # s, of both: shorter than flown, so that a case sees all of it

TRACKING = 0.05
"""rad/s, m/s. An idle machine keeps the loop within 0.001 of trim, one with five times as much to do as it can within 0.04; a
restarted node comes back with 0.1."""

# s. What a reader's socket has dropped is asked for again after the publisher's next heartbeat, every 0.05 s
# (flight_ros/loopback.xml), and comes again after the pauses that Fast DDS makes before a question and before its answer, 5 ms
# each (heartbeatResponseDelay, nackResponseDelay). Nobody has to repeat what a killed publisher has sent since.
UNREPEATED = 0.05 + 2 * 0.005
BEFORE = 0.5  # s, well beyond

# The probe must not change what it watches: best effort, and deep enough for what a busy machine lets it miss.
WATCH = QoSProfile(depth=2000, reliability=ReliabilityPolicy.BEST_EFFORT)
WATCH_LOGS = QoSProfile(depth=1000, durability=DurabilityPolicy.TRANSIENT_LOCAL)
SAMPLED = 0.05  # s, how often it is looked who waits for a processor
KEPT = 120_000  # messages a topic: ten seconds of a storm


class Heard(NamedTuple):
    """A message, when it was sent and when the middleware had it (s of the system clock), its number of its publisher."""

    sent: float
    at: float
    message: Any
    sequence: int


class Probe:
    """Listens in a thread of its own; `until` waits for what it hears."""

    def __init__(self) -> None:
        transport.prepare()
        self._context = Context()
        rclpy.init(context=self._context)
        self._node = Node("probe", context=self._context, start_parameter_services=False)
        qos = {DIAGNOSTICS: WATCH_LOGS, LOGS: WATCH_LOGS}
        self._polled_subscriptions = {
            topic.name: PolledSubscription(self._node, topic, qos.get(topic, WATCH), raw=topic not in (DIAGNOSTICS, LOGS))
            for topic in TOPICS
        }
        self.heard: dict[str, deque[Heard]] = {topic.name: deque(maxlen=KEPT) for topic in TOPICS}
        self.watched: list[Process] = []  # whose waiting for a processor is of interest, once they are ready
        self.waited: deque[tuple[float, float]] = deque(maxlen=KEPT)  # when, and the longest of them since the sample before, s
        self._waited_ns: dict[int, int] = {}
        self._changed = threading.Condition()
        self._ended = False
        self._thread = threading.Thread(target=self._listen, daemon=True)
        self._thread.start()

    def _listen(self) -> None:
        waiter = WaitSet([one.entity for one in self._polled_subscriptions.values()], self._context)
        sample = 0.0
        while not self._ended:
            waiter.wait(NANOSECONDS // 20)
            if time.monotonic() > sample:
                sample = time.monotonic() + SAMPLED
                self._look_who_waits()
            with self._changed:
                for name, subscription in self._polled_subscriptions.items():
                    self.heard[name].extend(
                        Heard(seconds(one.sent_ns), seconds(one.received_ns), one.message, one.sequence)
                        for one in subscription.take()
                    )
                self._changed.notify_all()

    def _look_who_waits(self) -> None:
        before = self._waited_ns
        ready = [one.popen.pid for one in list(self.watched) if "]: ready" in one.output]
        self._waited_ns = {process: _waited_ns(process) for process in (os.getpid(), *ready)}
        longest = max(waited - before.get(process, waited) for process, waited in self._waited_ns.items())
        self.waited.append((time.time(), longest / NANOSECONDS))

    def since(self, topic: str, begin: float, end: float = float("inf")) -> list[Heard]:
        """What came on a topic from one instant to another."""
        found: list[Heard] = []
        with self._changed:
            for one in reversed(self.heard[topic]):
                if one.at < begin:
                    break
                if one.at <= end:
                    found.append(one)
        return found[::-1]

    def until(self, condition: Callable[[], Any], timeout: float, what: str) -> Any:
        """Wait until the condition holds of what was heard; its value."""
        deadline = time.monotonic() + timeout
        while not (value := condition()):
            assert time.monotonic() < deadline, f"not within {timeout:g} s: {what}"
            with self._changed:
                self._changed.wait(0.05)
        return value

    def close(self) -> None:
        """Stop listening."""
        self._ended = True
        self._thread.join()
        self._node.destroy_node()
        self._context.try_shutdown()


def _waited_ns(process: int) -> int:
    waited = 0
    for path in Path(f"/proc/{process}/task").glob("*/schedstat"):
        with suppress(OSError):
            waited += int(path.read_text(encoding="ascii").split()[1])
    return waited


class Flown(NamedTuple):
    """The controller's ticks in a stretch of time, N of them."""

    t: FloatArray  # (N,) when heard, s of the system clock
    mode: FloatArray  # (N,)
    late: FloatArray  # (N,) s
    number: FloatArray  # (N,)
    e: FloatArray  # (N, m)
    u: FloatArray  # (N, m)
    y: FloatArray  # (N, m) as used
    y_m: FloatArray  # (N, m) as used

    @property
    def modes(self) -> list[Mode]:
        """The modes in their order, repeats left out."""
        return [Mode(int(mode)) for k, mode in enumerate(self.mode) if k == 0 or self.mode[k - 1] != mode]


def _flown(t: FloatArray, values: FloatArray) -> Flown:
    mode, late, number, e, u, y, y_m = np.split(values, [1, 2, 3, 7, 11, 15], axis=1)
    return Flown(t, mode[:, 0], late[:, 0], number[:, 0], e, u, y, y_m)


class Logged(NamedTuple):
    """A message in a log, when it was sent and written, s of the system clock."""

    topic: str
    sent: float
    written: float
    data: bytes


def logged(run: Path) -> Iterator[Logged]:
    """All messages of a log, which may still grow."""
    for path in run.glob("*.mcap"):
        topics: dict[int, str] = {}
        for record in Scan(path).records():
            if isinstance(record, Channel):
                topics[record.id] = record.topic
            elif isinstance(record, Message):
                yield Logged(topics[record.channel_id], seconds(record.publish_time), seconds(record.log_time), record.data)


WANTED = ("mode", "late", "number", *(f"e.{name}" for name in OUTPUTS), *(f"u.{name}" for name in INPUTS))
WANTED += tuple(f"{group}.{name}" for group in ("y", "y_m") for name in OUTPUTS)
ACTUATORS = tuple(f"actuator.{name}" for name in INPUTS)
STEP = struct.Struct("=q")  # of a clock, ns


@contextmanager
def environment(more: Mapping[str, str]) -> Iterator[None]:
    """Some more environment variables, for processes started meanwhile."""
    before = {name: os.environ.get(name) for name in more}
    os.environ.update(more)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


def scenario(source: Path, folder: Path) -> Path:
    """The default scenario in a steady flight 0.1 m/s above its trim, for ever: u rests away from 0, so that a change shows."""
    tree = yaml.safe_load(source.read_text(encoding="utf-8"))
    sections = {key.removeprefix("/**/"): content["ros__parameters"] for key, content in tree.items()}
    del sections["aircraft"]["gusts"]
    del sections["reference_model"]["coordinated_turn"]
    sections["aircraft"] |= {"rate": 200.0, "step": 0.005}  # leaves more of a busy machine to what is shown
    sections["reference_model"]["rate"] = 200.0
    sections["reference_model"]["second_order"]["natural_frequency"] = [4.0, 4.0, 5.0, 4.0]  # V sooner at rest
    sections["reference_model"]["pulses"] = {"V": {"start": [0.0], "stop": [1e5], "value": [0.1]}}
    sections["controller"] |= {"max_age": MAX_AGE, "hold": HOLD, "ramp": RAMP}
    sections["aircraft"] |= {"max_age": SILENCE, "hold": HOLD, "ramp": RAMP}
    path = folder / "steady.yaml"
    path.write_text(yaml.safe_dump(tree), encoding="utf-8")
    return path


class Witnessed(NamedTuple):
    """What was heard during a fault, but for what killed nodes said right before their end."""

    internals: set[bytes]  # of the flight's own controllers
    said: set[tuple[str, str]]  # by whom, and what
    last: list[list[bytes]]  # the `internals` right before the end, a list a killed node, in their order


class Killed(NamedTuple):
    """A node that was killed: it still lived at an instant, and no longer at another one, s."""

    role: str
    instance: str
    alive: float
    dead: float


class Flight:
    """Four processes and a probe. Instants are seconds of the system clock."""

    def __init__(self, folder: Path, source: Path, clock: Path | None = None) -> None:
        self.folder = folder
        self._clock = clock  # a library, with which the processes have a system clock that can be set
        self._step = folder / "clock"
        self._step.write_bytes(bytes(8))
        self.scenario = scenario(source, folder)
        self.probe = Probe()
        self.processes: dict[str, Process] = {}
        self.runs: list[Path] = []  # the folders of the recorders, in their order
        self.begin = self.end = time.time()  # of the last fault
        self.measured: dict[str, Any] = {}  # what a case adds to its row
        self.witnessed: dict[str, Witnessed] = {}  # what the log has to hold, by case
        self._all: list[Process] = []
        self._killed: list[Killed] = []
        self._ours: set[str] = set()  # instances of the four, of all that there were
        for role in PACKAGES:  # the aircraft is never without its controller, and all is in the log
            self.start(role)
            if role == "controller":
                self.processes["recorder"].wait_for("ready")
                self.processes["controller"].wait_for("ready")

    # Processes

    def node(self, role: str, *parameters: str) -> Process:
        """Start a node as `python -m PACKAGE.main`."""
        words = [word for one in parameters for word in ("-p", one)]
        preload = {} if self._clock is None else {"LD_PRELOAD": str(self._clock), "FAULTS_CLOCK": str(self._step)}
        with environment(preload):
            process = Process(
                f"{PACKAGES[role]}.main",
                *("--ros-args", "--params-file", str(self.scenario), *words),
                cwd=self.folder,
                within=APART,
            )
        self._all.append(process)
        self.probe.watched.append(process)
        return process

    def set_clock(self, by: float) -> None:
        """Set the system clock of the processes this far from the true one, s."""
        with self._step.open("r+b") as stream:
            stream.write(STEP.pack(nanoseconds(by)))

    def start(self, role: str, *parameters: str) -> float:
        """Start one of the four; when it was."""
        if role == "recorder" and not parameters:
            self.runs.append(self.folder / f"run{len(self.runs)}")
            parameters = (f"directory:={self.runs[-1]}", "min_free:=0.0")
        at = time.time()
        self.processes[role] = self.node(role, *parameters)
        self._ours.add(self.instance(role))
        return at

    def kill(self, role: str) -> None:
        """SIGKILL."""
        alive = time.time()
        self.processes[role].popen.kill()
        assert self.processes[role].end() == -signal.SIGKILL
        self._killed.append(Killed(role, self.instance(role), alive, time.time()))

    @contextmanager
    def stopped(self, role: str) -> Iterator[None]:
        """SIGSTOP until the block is left."""
        process = self.processes[role].popen
        process.send_signal(signal.SIGSTOP)
        try:
            yield
        finally:
            process.send_signal(signal.SIGCONT)

    def process(self, role: str) -> psutil.Process:
        """One of the four, to look at."""
        return psutil.Process(self.processes[role].popen.pid)

    def instance(self, role: str) -> str:
        """What stands in the `frame_id` of its messages."""
        return f"/{role}#{self.processes[role].popen.pid}"

    def close(self) -> None:
        """End all of it."""
        recorder = self.processes["recorder"]
        for process in (*(one for one in self._all if one is not recorder), recorder):  # that one takes what is still under way
            if process.popen.poll() is None:
                process.popen.send_signal(signal.SIGCONT)
                process.popen.terminate()
                with suppress(subprocess.TimeoutExpired):
                    process.popen.wait(20.0)
            process.popen.kill()
            process.end()
        self.probe.close()

    # The fault

    def fault(self) -> float:
        """Called by a case right before its fault."""
        self.begin = self.end = time.time()
        return self.begin

    def over(self) -> float:
        """Called by a case right after its fault; else that ends with the injection."""
        self.end = time.time()
        return self.end

    # What was heard

    def flown(self, begin: float, end: float = float("inf")) -> Flown:
        """The controller's ticks."""
        return _flown(*self._values("internals", WANTED, begin, end))

    def engaged_ticks(self, begin: float, until: float) -> Flown | None:
        """The ticks with the law from samples since, from the log, which has them all; None while it does not reach so far."""
        decoder, found = Decoder(WANTED), []
        for one in logged(self.runs[-1]):
            sample = decoder.decode(one.data) if one.topic == "/internals" else None
            if sample is not None and sample.sender in self._ours and seconds(sample.stamp_ns) >= begin - MAX_AGE:
                found.append(sample)
        if not found or seconds(found[-1].stamp_ns) < until:
            return None
        flown = _flown(np.array([seconds(one.stamp_ns) for one in found]), np.array([one.value for one in found]))
        return Flown(*(column[flown.mode == Mode.ENGAGED] for column in flown))

    def moved(self, begin: float, end: float = float("inf")) -> tuple[FloatArray, FloatArray]:
        """What the aircraft's inputs really did: when (N,), and their deviations from trim (N, m)."""
        return self._values("truth", ACTUATORS, begin, end)

    def _values(self, topic: str, names: tuple[str, ...], begin: float, end: float) -> tuple[FloatArray, FloatArray]:
        decoder, found = Decoder(names), []
        for one in self.probe.since(topic, begin, end):
            sample = decoder.decode(one.message)
            if sample is not None and sample.sender in self._ours:
                found.append((one.at, sample.value))
        return np.array([at for at, _ in found]), np.array([value for _, value in found]).reshape(-1, len(names))

    def pause(self, topic: str, begin: float, end: float) -> float:
        """The longest time without a message between two instants, s."""
        times = [begin, *(one.at for one in self.probe.since(topic, begin, end)), end]
        return float(np.diff(times).max())

    def held_back(self, begin: float, end: float) -> float:
        """How long the machine held one of the processes back between two instants at most, s: it was ready and had to wait.

        As Linux counts it (proc_pid_schedstat), all threads of a process together.
        """
        return max((waited for at, waited in list(self.probe.waited) if begin <= at <= end + 2.0 * SAMPLED), default=0.0)

    def said(self, role: str, pattern: str, begin: float) -> float | None:
        """When a node first said something in its log."""
        for one in self.probe.since("/rosout", begin):
            if one.message.name == role and re.search(pattern, one.message.msg):
                return one.at
        return None

    def witness(self, case: str, begin: float) -> None:
        """Keep what was heard since, and from BEFORE the end of a killed node on, to be looked for in the log."""
        decoder = Decoder(())
        ended = [one for one in self._killed if one.dead >= begin and one.role in SPEAKERS]
        begin = min([begin, *(one.alive - BEFORE for one in ended)])
        internals = self.probe.since("internals", begin)
        by = [sample.sender if (sample := decoder.decode(one.message)) is not None else "" for one in internals]
        lines = [one for one in self.probe.since("/rosout", begin) if one.message.name in SPEAKERS]
        last = []
        for killed in ended:
            # that of two processes one after the other, of the node and of the recorder
            since = killed.alive - UNREPEATED - 2.0 * self.held_back(killed.alive - MAX_AGE, killed.dead)
            mine = [one for one, sender in zip(internals, by, strict=True) if sender == killed.instance]
            last.append([one.message for one in mine if one.sent > since])
            lines = [one for one in lines if one.message.name != killed.role or not since < one.sent <= killed.dead]
        ours = {one.message for one, sender in zip(internals, by, strict=True) if sender in self._ours}
        said = {(one.message.name, one.message.msg) for one in lines}
        self.witnessed[case] = Witnessed(ours.difference(*last), said, last)

    def reports(self, role: str, begin: float) -> list[tuple[float, DiagnosticStatus]]:
        """The 1 Hz diagnostics of a node, with when they came."""
        heard = self.probe.since("/diagnostics", begin)
        return [(one.at, status) for one in heard for status in one.message.status if status.name == f"/{role}"]

    def figure(self, role: str, key: str, begin: float) -> list[tuple[float, float]]:
        """A figure in the diagnostics of a node, with when it came."""
        return [
            (at, float(value.value)) for at, status in self.reports(role, begin) for value in status.values if value.key == key
        ]

    def count(self, role: str, key: str) -> float:
        """The last value of a counter in the diagnostics of a node that runs now, 0 where it has none."""
        found = [
            (status.hardware_id, {value.key: value.value for value in status.values}) for _, status in self.reports(role, 0.0)
        ]
        mine = [figures for instance, figures in found if instance == self.instance(role)]
        return float(mine[-1].get(key, 0.0)) if mine else 0.0

    def first(self, topic: str, begin: float) -> float | None:
        """When the first message of a topic came."""
        heard = self.probe.since(topic, begin)
        return heard[0].at if heard else None

    def first_of(self, topic: str, instance: str, begin: float) -> float | None:
        """When the first message of one publisher came."""
        found = (one.at for one in self.probe.since(topic, begin) if f"{instance}\0".encode() in one.message)
        return next(found, None)

    def engaged(self, begin: float) -> float | None:
        """Since when the law flies without a break until now, None where it does not."""
        flown = self.flown(begin)
        if not len(flown.t) or flown.mode[-1] != Mode.ENGAGED:
            return None
        let_go = np.flatnonzero(
            np.diff(flown.t) > SILENCE + HOLD + RAMP
        )  # the aircraft has, where nothing was said for so long
        breaks = np.append(np.flatnonzero(flown.mode != Mode.ENGAGED), let_go)
        return float(flown.t[breaks.max() + 1] if len(breaks) else flown.t[0])

    def steady(self) -> bool:
        """Whether for 0.4 s the law has flown, and tracked; and the aircraft flies with it."""
        now = time.time()
        flown, (_, inputs) = self.flown(now - 0.4), self.moved(now - 0.1)
        return bool(
            len(flown.t) >= 10
            and len(inputs)
            and (flown.mode == Mode.ENGAGED).all()
            and (np.abs(flown.e) <= TRACKING).all()
            and (np.abs(flown.u[-10:] - inputs[-1]).max(axis=1) == 0.0).any()
        )

    def is_at_rest(self) -> bool:
        """Whether u has hardly moved in the last second."""
        u = self.flown(time.time() - 1.0).u
        return bool(len(u) and np.ptp(u, axis=0).max() <= 0.03)

    def is_near_trim(self) -> bool:
        """Whether no input has been far from trim in the last half second."""
        inputs = self.moved(time.time() - 0.5)[1]
        return bool(len(inputs) and np.abs(inputs).max() <= 0.2)

    def until(self, condition: Callable[[], Any], timeout: float, what: str) -> Any:
        """Wait for what the probe hears."""
        return self.probe.until(condition, timeout, what)

    def until_steady(self, timeout: float = 60.0) -> None:
        """Wait until it flies as if nothing had been."""
        begin = time.time()
        try:
            self.until(self.steady, timeout, "engaged and tracking again")
        except AssertionError as error:
            flown, held_back = self.flown(time.time() - 2.0), self.held_back(begin, time.time())
            e = np.abs(flown.e).max(axis=0, initial=0.0)
            raise AssertionError(f"{error}: {flown.modes}, e {e}, processes held back by up to {held_back:.2f} s") from None
