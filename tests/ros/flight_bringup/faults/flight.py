# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Provide a flight under test: processes that can be killed and stopped, and a probe.

The probe receives and times their messages.
"""

import os
import re
import shutil
import signal
import struct
import subprocess
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from enum import Enum
from pathlib import Path
from typing import Any, NamedTuple
from unittest.mock import patch

import numpy as np
import rclpy
import yaml
from rcl_interfaces.msg import Log
from rclpy.context import Context
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from std_srvs.srv import SetBool
from tests.conftest import REPOSITORY
from tests.maps import MAP_FILES
from tests.ros.conftest import Process, logged
from tests.ros.peer import peer
from tests.ros.waiting import until

from flight_analysis.closed_loop.scenario import load_scenario, scenario_yaml
from flight_bringup.graph import (
    AIRCRAFT,
    BRIDGE,
    CONTROLLER,
    GUIDANCE,
    LEARNER,
    RECORDER,
    REFERENCE_MODEL,
)
from flight_core.modes import Mode
from flight_core.rates import NANOSECONDS, nanoseconds, period_ns, seconds
from flight_core.vectors import FloatArray, StampedVector
from flight_ros import transport
from flight_ros.messages import Decoder, to_message
from flight_ros.rclpy_private import WaitSet
from flight_ros.subscriptions import PolledSubscription
from flight_ros.topics import (
    DIAGNOSTICS,
    HISTORY_NS,
    INTERNALS,
    POSE,
    PUBLISH,
    TARGET,
    TRUTH,
    U_M,
    Y_M,
    Topic,
    U,
    Y,
)


class Kind(Enum):
    """What flies."""

    PLAIN = "four nodes and a profile of commands"
    OWN_CLOCK = "the same, with a clock that can be set"
    GUIDED = "guidance beside them"
    LEARNING = "a learner beside the four; without noise of sensors it refuses each record"
    BRIDGED = "the bridge and a simulated autopilot in place of the aircraft"


MODULES = {
    node.executable: node.module
    for node in (RECORDER, CONTROLLER, AIRCRAFT, REFERENCE_MODEL, GUIDANCE, LEARNER, BRIDGE)
}
FOUR: tuple[str, ...] = ("recorder", "controller", "aircraft", "reference_model")
ROLES = {
    Kind.PLAIN: FOUR,
    Kind.OWN_CLOCK: FOUR,
    Kind.GUIDED: (*FOUR, "guidance"),
    Kind.LEARNING: (*FOUR, "learner"),
    Kind.BRIDGED: ("recorder", "controller", "reference_model", "autopilot", "bridge"),
}
OUTPUTS = ("q", "p", "r", "V")
INPUTS = ("elevator", "aileron", "rudder", "thrust")
ROSOUT = Topic("/rosout", Log)
# of the aircraft in a guided flight: a gate relays it as `pose`
TRUE_POSE = Topic("true_pose", POSE.type)
TOPICS = (Y, Y_M, U, U_M, TRUE_POSE, INTERNALS, TRUTH, DIAGNOSTICS, ROSOUT)


# Linux gives a process in its own session its own share of a busy processor (man 7 sched,
# autogroup).
OWN_SESSION = tuple(command for command in (shutil.which("setsid"),) if command)

PUBLISHED = {
    "aircraft": ("truth", "y"),
    "reference_model": ("y_m",),
    "controller": ("internals", "u"),
    "guidance": ("u_m",),
    "bridge": ("y",),
}

TICK = 0.01  # s, the controller's, as in the default scenario
MAX_AGE = 0.1  # s, of y and y_m, as in the default scenario
RATE = 200.0  # Hz, of aircraft and reference model
U_MAX_AGE = 0.2  # s, of u, the aircraft's default
LEVEL = 0.01  # rad, of wings
# s, of both failsafes: shorter than the defaults, so that a case sees all of them
HOLD, RAMP = (0.2, 0.3)

TRACKING = 0.05
"""rad/s, m/s. On an idle host the loop stays within 0.001 of trim, on one with five times its load
within 0.04. A restarted node begins at 0.1."""

# s. A sample that a subscriber's socket dropped is requested again after the publisher's next
# heartbeat, every 0.05 s
# (flight_ros/loopback.xml). Fast DDS pauses 5 ms before the request and 5 ms before the response
# (heartbeatResponseDelay, nackResponseDelay). What a killed publisher sent within this time is not
# retransmitted.
NOT_RETRANSMITTED = 0.05 + 2 * 0.005
HISTORY = 0.5  # s before the end of a killed node: well beyond NOT_RETRANSMITTED

# The probe must not affect the flight: best effort, with queues for the delays of a busy host.
PROBE_QOS = QoSProfile(depth=2000, reliability=ReliabilityPolicy.BEST_EFFORT)
PROBE_LOG_QOS = QoSProfile(depth=1000, durability=DurabilityPolicy.TRANSIENT_LOCAL)
DELAY_PERIOD = 0.05  # s, of the samples of the host's scheduling delays
BUFFER_SIZE = 120_000  # messages a topic: ten seconds of a storm


class Received(NamedTuple):
    """A message, when it was sent and when the middleware received it, s of the system clock."""

    sent: float
    at: float
    message: Any


class Probe:
    """A receiver of the flight's topics in its own thread.

    `until` waits for a condition on them.
    """

    def __init__(self) -> None:
        transport.prepare()
        self._context = Context()
        rclpy.init(context=self._context)
        self._node = Node("probe", context=self._context, start_parameter_services=False)
        self._target = self._node.create_publisher(TARGET.type, TARGET.name, PUBLISH)
        qos = {DIAGNOSTICS: PROBE_LOG_QOS, ROSOUT: PROBE_LOG_QOS}
        self._subscriptions = {
            topic.name: PolledSubscription(
                self._node, topic, qos.get(topic, PROBE_QOS), raw=topic not in qos
            )
            for topic in TOPICS
        }
        self.received: dict[str, deque[Received]] = {
            topic.name: deque(maxlen=BUFFER_SIZE) for topic in TOPICS
        }
        # their scheduling delays are sampled once they are ready
        self.monitored: list[Process] = []
        # when, and the longest since the sample before, s
        self.delays: deque[tuple[float, float]] = deque(maxlen=BUFFER_SIZE)
        self._waited_ns: dict[int, int] = {}
        self._changed = threading.Condition()
        self._closed = False
        self._thread = threading.Thread(target=self._receive, daemon=True)
        self._thread.start()

    def _receive(self) -> None:
        waiter = WaitSet(
            [subscription.entity for subscription in self._subscriptions.values()], self._context
        )
        sample = 0.0
        while not self._closed:
            waiter.wait(NANOSECONDS // 20)
            if time.monotonic() > sample:
                sample = time.monotonic() + DELAY_PERIOD
                self._sample_delays()
            with self._changed:
                for name, subscription in self._subscriptions.items():
                    self.received[name].extend(
                        Received(
                            seconds(arrival.sent_ns), seconds(arrival.received_ns), arrival.message
                        )
                        for arrival in subscription.take()
                    )
                self._changed.notify_all()

    def _sample_delays(self) -> None:
        before = self._waited_ns
        ready = [
            process.popen.pid for process in list(self.monitored) if "]: ready" in process.output
        ]
        self._waited_ns = {process: _waited_ns(process) for process in (os.getpid(), *ready)}
        longest = max(
            waited - before.get(process, waited) for process, waited in self._waited_ns.items()
        )
        self.delays.append((time.time(), longest / NANOSECONDS))

    def since(self, topic: str, begin: float, end: float = float("inf")) -> list[Received]:
        """Return the messages of a topic between two instants."""
        messages: list[Received] = []
        with self._changed:
            for arrival in reversed(self.received[topic]):
                if arrival.at < begin:
                    break
                if arrival.at <= end:
                    messages.append(arrival)
        return messages[::-1]

    def until(self, condition: Callable[[], Any], timeout: float, what: str) -> Any:
        """Wait until the condition on the received messages is true, and return its value."""

        def change() -> None:
            with self._changed:
                self._changed.wait(0.05)

        return until(condition, what, change, timeout)

    def target(self, **values: float) -> None:
        """Command guidance by channel."""
        self._target.publish(
            to_message(time.time_ns(), [*values], np.array([*values.values()]), "/probe")
        )

    def close(self) -> None:
        """End the thread and the node."""
        self._closed = True
        self._thread.join()
        self._node.destroy_node()
        self._context.try_shutdown()


def _waited_ns(process: int) -> int:
    waited = 0
    with suppress(OSError):  # a process that has just been killed
        for path in Path(f"/proc/{process}/task").glob("*/schedstat"):
            with suppress(OSError):  # a thread that has just ended
                waited += _scheduled_ns(path)[1]
    return waited


def _scheduled_ns(path: Path) -> tuple[int, int]:
    """Return how long a thread ran, and how long it was ready and waited for a processor, ns.

    Source: proc_pid_schedstat.
    """
    run, waited, _ = map(int, path.read_text(encoding="ascii").split())
    return run, waited


class Ticks(NamedTuple):
    """N ticks of the controller, from `internals`."""

    t: FloatArray  # (N,) when received, s of the system clock
    mode: FloatArray  # (N,)
    e: FloatArray  # (N, m)
    u: FloatArray  # (N, m)
    y: FloatArray  # (N, m) as used
    y_m: FloatArray  # (N, m) as used

    @property
    def modes(self) -> list[Mode]:
        """Return the modes in their order, without repetitions."""
        return [
            Mode(int(mode))
            for k, mode in enumerate(self.mode)
            if k == 0 or self.mode[k - 1] != mode
        ]


def _ticks(t: FloatArray, values: FloatArray) -> Ticks:
    mode, e, u, y, y_m = np.split(values, [1, 5, 9, 13], axis=1)
    return Ticks(t, mode[:, 0], e, u, y, y_m)


def tick_channels(inputs: tuple[str, ...]) -> tuple[str, ...]:
    """Return the channels of `internals` in the order of `Ticks`."""
    groups = (("e", OUTPUTS), ("u", inputs), ("y", OUTPUTS), ("y_m", OUTPUTS))
    return ("mode", *(f"{group}.{name}" for group, names in groups for name in names))


def steady_scenario(source: Path, folder: Path) -> Path:
    """Return a scenario in a steady flight 0.1 m/s above trim, without an end.

    u is not 0, so that a change of it shows. If the scenario has a section for guidance, guidance
    commands this flight with level wings.
    """
    tree = yaml.safe_load(source.read_text())
    sections = {
        key.removeprefix("/**/"): content["ros__parameters"] for key, content in tree.items()
    }
    aircraft = sections["aircraft"]
    reference = sections["reference_model"]
    # Noise would hide a change of u, and a probe finds u in the positions of ideal actuators.
    for disturbance in ("gusts", "turbulence", "wind", "sensors", "actuators"):
        aircraft.pop(disturbance, None)
    reference.pop("coordinated_turn", None)
    aircraft |= {"rate": RATE, "step": 1.0 / RATE}  # a lower load, for busy hosts
    reference["rate"] = RATE
    if (guidance := sections.get("guidance")) is None:
        reference["second_order"]["natural_frequency"] = [4.0, 4.0, 5.0, 4.0]  # V settles sooner
        reference["pulses"] = {"V": {"start": [0.0], "stop": [1e5], "value": [0.1]}}
    else:
        guidance.pop("route", None)
        level = {"phi": 0.0, "climb": 0.0, "V": reference["live"]["speed"] + 0.1}
        guidance["program"] = {
            name: {"start": [0.0], "value": [value]} for name, value in level.items()
        }
    sections["controller"] |= {"max_age": MAX_AGE, "hold": HOLD, "ramp": RAMP}
    sections["aircraft"] |= {"max_age": U_MAX_AGE, "hold": HOLD, "ramp": RAMP}
    path = folder / "steady.yaml"
    path.write_text(yaml.safe_dump(tree))
    if guidance is not None:  # the section by itself, with what follows from the others
        path.write_text(scenario_yaml(load_scenario(path)))
    return path


RELEASE_AFTER = 3.0  # s without a message: RC_OVERRIDE_TIME of ArduPilot


def fast_map(folder: Path) -> Path:
    """Return the map of the simulated autopilot with 200 messages per second.

    The loop of an observer with a small delay needs them.
    """
    content = yaml.safe_load(MAP_FILES["ardupilot_2024"].read_text())
    content["messages"]["joy"]["rate"] = 200.0
    path = folder / "map.yaml"
    path.write_text(yaml.safe_dump(content))
    return path


class ExpectedLog(NamedTuple):
    """What the log must have from the time of a fault."""

    internals: set[bytes]  # of the flight's own controllers, except `last`
    # node and log line, except those right before the end of a killed node
    lines: set[tuple[str, str]]
    # for each killed node its `internals` right before the end, in their order
    last: list[list[bytes]]


class Killed(NamedTuple):
    """A killed node, which still ran at one instant and no longer at another, s."""

    role: str
    instance: str
    alive: float
    dead: float


class Flight:
    """The processes of a kind of flight, and a probe. Instants are seconds of the system clock."""

    def __init__(self, folder: Path, source: Path, kind: Kind, clock: Path | None = None) -> None:
        self.folder = folder
        self.kind = kind
        self._clock = clock  # a library that gives the processes a system clock that can be set
        self._step = folder / "clock"
        self._step.write_bytes(bytes(8))
        self.scenario = steady_scenario(source, folder)
        inputs = load_scenario(self.scenario).controller.inputs
        self._tick_channels, self._actuators = (
            tick_channels(inputs),
            tuple(f"actuator.{name}" for name in inputs),
        )
        self.probe = Probe()
        self.until = self.probe.until
        self.processes: dict[str, Process] = {}
        self.runs: list[Path] = []  # the folders of the recorders, in their order
        self.begin = self.end = time.time()  # of the last fault
        self.measured: dict[str, Any] = {}  # what a case adds to its row
        self.expected_logs: dict[str, ExpectedLog] = {}  # by case
        # A process ends with the thread that started it (man 2 PR_SET_PDEATHSIG): one thread starts
        # all.
        self._starter = ThreadPoolExecutor(1)
        self._all: list[Process] = []
        self._killed: list[Killed] = []
        self._instances: set[str] = set()  # of the roles, including restarts
        words = ("tests.ros.flight_bringup.faults.foreign", "gate", TRUE_POSE.name, POSE.name)
        self.gate = (
            self._run(*words, cwd=REPOSITORY, stdin=subprocess.PIPE)
            if kind is Kind.GUIDED
            else None
        )
        for role in ROLES[kind]:  # the recorder first, and no aircraft without its controller
            self.start(role)
            if role == "controller":
                self.processes["recorder"].wait_for("ready")
                self.processes["controller"].wait_for("ready")
        if kind is Kind.BRIDGED:
            self.engage()

    # Processes

    def node(self, role: str, *parameters: str) -> Process:
        """Start a node as `python -m PACKAGE.main`."""
        if role == "autopilot":
            return self._run(
                "tests.ros.autopilot", str(self.scenario), str(RELEASE_AFTER), cwd=REPOSITORY
            )
        if role == "bridge":
            parameters = (f"map:={fast_map(self.folder)}", "dry_run:=false")
        if role == "learner":
            parameters = (f"scenario_file:={self.scenario}",)
        words = [word for parameter in parameters for word in ("-p", parameter)]
        if role == "aircraft" and self.gate is not None:
            words += ["-r", f"{POSE.name}:={TRUE_POSE.name}"]
        preload = (
            {}
            if self._clock is None
            else {"LD_PRELOAD": str(self._clock), "FAULTS_CLOCK": str(self._step)}
        )
        with patch.dict(os.environ, preload):
            arguments = (MODULES[role], "--ros-args", "--params-file", str(self.scenario), *words)
            process = self._run(*arguments, cwd=self.folder)
        self.probe.monitored.append(process)
        return process

    def _run(self, *words: str, cwd: Path, stdin: int | None = None) -> Process:
        """Start a process of the flight, which lasts until the flight ends."""
        process = self._starter.submit(
            Process, *words, cwd=cwd, within=OWN_SESSION, stdin=stdin
        ).result()
        self._all.append(process)
        return process

    @contextmanager
    def pose_fault(self, word: str) -> Iterator[None]:
        """Cause a fault of the relayed pose during the block."""
        assert self.gate is not None
        stdin = self.gate.popen.stdin
        assert stdin is not None
        print(word, file=stdin, flush=True)
        yield
        print("pass", file=stdin, flush=True)

    def set_clock(self, by: float) -> None:
        """Set the system clock of the processes to this offset from the true one, s."""
        with self._step.open("r+b") as stream:
            stream.write(struct.pack("=q", nanoseconds(by)))

    def start(self, role: str, *parameters: str) -> float:
        """Start one of the roles, and return the instant of the start."""
        if role == "recorder" and not parameters:
            self.runs.append(self.folder / f"run{len(self.runs)}")
            parameters = (f"directory:={self.runs[-1]}", "min_free:=0.0")
        at = time.time()
        self.processes[role] = self.node(role, *parameters)
        self._instances.add(self.instance(role))
        return at

    def spent(self, role: str) -> tuple[float, float]:
        """Return the processor time of a process's main thread, and how long it waited, s.

        It waits while it is ready and has no processor.
        """
        run, waited = _scheduled_ns(Path(f"/proc/{self.processes[role].popen.pid}/schedstat"))
        return seconds(run), seconds(waited)

    def kill(self, role: str) -> None:
        """Kill a node, as SIGKILL does."""
        alive = time.time()
        self.processes[role].popen.kill()
        assert self.processes[role].end() == -signal.SIGKILL
        self._killed.append(Killed(role, self.instance(role), alive, time.time()))

    def instance(self, role: str) -> str:
        """Return the `frame_id` of the messages of a role's present process."""
        return f"/{role}#{self.processes[role].popen.pid}"

    def close(self) -> None:
        """End all processes, the recorder last, and the probe."""
        recorder = self.processes["recorder"]
        for process in (*(process for process in self._all if process is not recorder), recorder):
            if process.popen.poll() is None:
                process.popen.send_signal(signal.SIGCONT)
                process.popen.terminate()
                with suppress(subprocess.TimeoutExpired):
                    process.popen.wait(20.0)
            process.popen.kill()
            process.end()
        self._starter.shutdown()
        self.probe.close()

    def engage(self) -> None:
        """Engage through the bridge as soon as it permits this.

        The fault ends with the last request.
        """

        def requested() -> bool:
            self.end_fault()
            return bool(
                peer_node.call(SetBool, "bridge/engage", SetBool.Request(data=True)).success
            )

        with peer(topics=()) as peer_node:
            self.until(requested, 30.0, "engaged through the bridge")

    # The fault

    def begin_fault(self) -> float:
        """Mark the beginning of the fault. A case calls this immediately before it."""
        self.begin = self.end = time.time()
        return self.begin

    def end_fault(self) -> None:
        """Mark the end of the fault. A case calls this immediately after it."""
        self.end = time.time()

    # Received messages

    def ticks(self, begin: float, end: float = float("inf")) -> Ticks:
        """Return the controller's ticks."""
        return _ticks(*self._values("internals", self._tick_channels, begin, end))

    def foreign_y(self, begin: float, end: float) -> list[StampedVector]:
        """Return the engaged ticks with the y of another publisher.

        Their stamp, which is the stamp of y, is none of the aircraft's instants.
        """
        (instant, *_) = (sample.stamp_ns for _, sample in self._samples("truth", (), begin, end))
        ticks = [
            tick
            for _, tick in self._samples("internals", ("mode",), begin, end)
            if tick.value[0] == Mode.ENGAGED
        ]
        return [tick for tick in ticks if (tick.stamp_ns - instant) % period_ns(RATE, "rate")]

    def engaged_ticks(self, begin: float, until: float) -> Ticks | None:
        """Return the engaged ticks with samples from `begin` on, from the log, which is complete.

        Before the log reaches `until`, this is None.
        """
        decoder = Decoder(self._tick_channels)
        tables = []
        for topic, record in logged(self.runs[-1]):
            sample = self._decode(decoder, record.data) if topic == "/internals" else None
            if sample is not None and seconds(sample.stamp_ns) >= begin - MAX_AGE:
                tables.append(sample)
        if not tables or seconds(tables[-1].stamp_ns) < until:
            return None
        ticks = _ticks(
            np.array([seconds(sample.stamp_ns) for sample in tables]),
            np.array([sample.value for sample in tables]),
        )
        return Ticks(*(column[ticks.mode == Mode.ENGAGED] for column in ticks))

    def actuator_positions(
        self, begin: float, end: float = float("inf")
    ) -> tuple[FloatArray, FloatArray]:
        """Return when the aircraft applied inputs, (N,), and their deviations from trim, (N, m)."""
        return self._values("truth", self._actuators, begin, end)

    def bank(self, begin: float, end: float = float("inf")) -> tuple[FloatArray, FloatArray]:
        """Return the true bank of the aircraft in a guided flight: when (N,), and rad (N,)."""
        t, phi = self._values(TRUE_POSE.name, ("phi",), begin, end)
        return t, phi[:, 0]

    def _values(
        self, topic: str, names: tuple[str, ...], begin: float, end: float
    ) -> tuple[FloatArray, FloatArray]:
        samples = [(at, sample.value) for at, sample in self._samples(topic, names, begin, end)]
        return np.array([at for at, _ in samples]), np.array(
            [value for _, value in samples]
        ).reshape(-1, len(names))

    def _samples(
        self, topic: str, names: tuple[str, ...], begin: float, end: float
    ) -> Iterator[tuple[float, StampedVector]]:
        """Yield the samples of the flight's own nodes, and when they were received."""
        decoder = Decoder(names)
        for arrival in self.probe.since(topic, begin, end):
            if (sample := self._decode(decoder, arrival.message)) is not None:
                yield arrival.at, sample

    def _decode(self, decoder: Decoder, data: bytes) -> StampedVector | None:
        """Return a message of the flight's own nodes, or None for any other message."""
        sample = decoder.decode(data)
        return sample if sample is not None and sample.sender in self._instances else None

    def pause(self, topic: str, begin: float, end: float) -> float:
        """Return the longest time without a message between two instants, s."""
        times = [begin, *(arrival.at for arrival in self.probe.since(topic, begin, end)), end]
        return float(np.diff(times).max())

    def host_delay(self, begin: float, end: float) -> float:
        """Return the longest scheduling delay of a process between two instants, s.

        In this time the process was ready and waited for a processor, as Linux counts it
        (proc_pid_schedstat) for all threads together. The result is at least the time in which the
        probe had no sample of this count, because the probe itself waited then. It is also at least
        the time without a message from any node. The nodes are separate processes. All of them
        pause at once if the host of a virtual machine withholds its processors, which Linux in this
        machine does not count, or if the middleware of the probe waits.
        """
        end += 2.0 * DELAY_PERIOD
        samples = [
            (at, delay)
            for at, delay in list(self.probe.delays)
            if begin - 2.0 * DELAY_PERIOD <= at <= end
        ]
        gaps = np.diff([at for at, _ in samples]) - 2.0 * DELAY_PERIOD
        topics = {topic for published in PUBLISHED.values() for topic in published}
        arrivals = (
            arrival.at for topic in topics for arrival in self.probe.since(topic, begin, end)
        )
        silences = np.diff(sorted([begin, *arrivals])) - 2.0 * TICK
        return float(max([0.0, *gaps, *silences, *(delay for at, delay in samples if at >= begin)]))

    def waited(self, begin: float, end: float) -> float:
        """Return how long a process waited for a processor at most between two instants, s.

        All its delays are added.
        """
        return sum(
            delay for at, delay in list(self.probe.delays) if begin <= at <= end + DELAY_PERIOD
        )

    def first_line(self, role: str, pattern: str, begin: float) -> float | None:
        """Return when a node first logged a line that matches the pattern."""
        for arrival in self.probe.since("/rosout", begin):
            if arrival.message.name == role and re.search(pattern, arrival.message.msg):
                return arrival.at
        return None

    def expect_in_log(self, case: str) -> None:
        """Keep what was received since the beginning of the fault.

        For a killed node, messages from the time HISTORY before its end are kept.
        """
        decoder = Decoder(())
        killed_nodes = [
            node for node in self._killed if node.dead >= self.begin and node.role in PUBLISHED
        ]
        begin = min([self.begin, *(node.alive - HISTORY for node in killed_nodes)])
        received = [
            (arrival, sample.sender)
            for arrival in self.probe.since("internals", begin)
            if (sample := self._decode(decoder, arrival.message)) is not None
        ]
        lines = [
            line for line in self.probe.since("/rosout", begin) if line.message.name in PUBLISHED
        ]
        last = []
        for killed in killed_nodes:
            # the delays of two processes add up: of the node and of the recorder
            since = (
                killed.alive
                - NOT_RETRANSMITTED
                - 2.0 * self.host_delay(killed.alive - MAX_AGE, killed.dead)
            )
            last.append(
                [
                    arrival.message
                    for arrival, sender in received
                    if sender == killed.instance and arrival.sent > since
                ]
            )
            lines = [
                line
                for line in lines
                if line.message.name != killed.role or not since < line.sent <= killed.dead
            ]
        # A new recorder receives what the publishers still keep. On a busy host it may start later
        # than that.
        for killed in (
            node for node in self._killed if node.role == "recorder" and node.dead >= self.begin
        ):
            joined_at = min(
                seconds(record.log_time)
                for topic, record in logged(self.runs[-1])
                if topic == "/internals"
            )
            kept_from = joined_at - seconds(HISTORY_NS) + self.host_delay(killed.alive, joined_at)
            received = [
                (arrival, sender)
                for arrival, sender in received
                if not killed.alive - HISTORY < arrival.sent < kept_from
            ]
        internals = {arrival.message for arrival, _ in received}
        logged_lines = {(line.message.name, line.message.msg) for line in lines}
        self.expected_logs[case] = ExpectedLog(internals.difference(*last), logged_lines, last)

    def diagnostics(self, role: str, begin: float) -> list[tuple[float, str, dict[str, str]]]:
        """Return the diagnostics of a node: when received, the instance, and the values by key."""
        return [
            (
                arrival.at,
                arrival.message.header.frame_id,
                {value.key: value.value for value in status.values},
            )
            for arrival in self.probe.since("/diagnostics", begin)
            for status in arrival.message.status
            if status.name == f"/{role}"
        ]

    def count(self, role: str, key: str) -> float:
        """Return the last value of a counter in the diagnostics of a role's present process.

        If there is none, it is 0.
        """
        instance = self.instance(role)
        reports = [
            values for _, sender, values in self.diagnostics(role, 0.0) if sender == instance
        ]
        return float(reports[-1].get(key, 0.0)) if reports else 0.0

    def first_message(self, topic: str, begin: float, instance: str = "") -> float | None:
        """Return when the first message of a topic was received, from any publisher or from one."""
        sender = f"{instance}\0".encode() if instance else b""
        return next(
            (arrival.at for arrival in self.probe.since(topic, begin) if sender in arrival.message),
            None,
        )

    def engaged_since(self, begin: float) -> float | None:
        """Return since when the law has been engaged without a break, or None if it is not."""
        ticks = self.ticks(begin)
        if not len(ticks.t) or ticks.mode[-1] != Mode.ENGAGED:
            return None
        # a pause in which the failsafe of the aircraft has reached trim is a break, too
        pauses = np.flatnonzero(np.diff(ticks.t) > U_MAX_AGE + HOLD + RAMP)
        breaks = np.append(np.flatnonzero(ticks.mode != Mode.ENGAGED), pauses)
        return float(ticks.t[breaks.max() + 1] if len(breaks) else ticks.t[0])

    def is_steady(self) -> bool:
        """Return whether the law has been engaged and has tracked for 0.4 s.

        The aircraft must apply its u.
        """
        now = time.time()
        ticks, (_, inputs) = self.ticks(now - 0.4), self.actuator_positions(now - 0.1)
        tracks = (
            len(ticks.t) >= 10
            and (ticks.mode == Mode.ENGAGED).all()
            and (np.abs(ticks.e) <= TRACKING).all()
        )
        if self.kind is Kind.BRIDGED:  # its aircraft publishes no truth
            return bool(tracks)
        if self.kind is Kind.GUIDED and not self.probe.since("u_m", now - 0.2):
            return False
        return bool(
            tracks and len(inputs) and (np.abs(ticks.u[-10:] - inputs[-1]).max(axis=1) == 0.0).any()
        )

    def is_level(self) -> bool:
        """Return whether a guided flight has had level wings for half a second."""
        t, phi = self.bank(time.time() - 0.5)
        return bool(len(t) and np.abs(phi).max() <= LEVEL)

    def is_at_rest(self) -> bool:
        """Return whether u has hardly moved in the last second."""
        u = self.ticks(time.time() - 1.0).u
        return bool(len(u) and np.ptp(u, axis=0).max() <= 0.03)

    def is_near_trim(self) -> bool:
        """Return whether no input has been far from trim in the last half second."""
        begin = time.time() - 0.5
        inputs = (
            self.ticks(begin).u if self.kind is Kind.BRIDGED else self.actuator_positions(begin)[1]
        )
        return bool(len(inputs) and np.abs(inputs).max() <= 0.2)

    def until_steady(self, timeout: float = 60.0) -> None:
        """Wait until the flight is steady, as it is without a fault."""
        begin = time.time()
        try:
            self.until(self.is_steady, timeout, "engaged and tracking again")
        except AssertionError as error:
            ticks = self.ticks(time.time() - 2.0)
            delay = self.host_delay(begin, time.time())
            e = np.abs(ticks.e).max(axis=0, initial=0.0)
            dead = [
                f"\n{role}: {process.output}"
                for role, process in self.processes.items()
                if process.popen.poll() is not None
            ]
            raise AssertionError(
                f"{error}: {ticks.modes}, e {e}, host scheduling delay up to {delay:.2f} "
                f"s{''.join(dead)}"
            ) from None
