# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Define the faults: injection, detection, response of u, and time of recovery.

A detection has a node, a way and a time. Among the faults are nodes killed and stopped (failsafe,
re-engagement), message storms and conflicting publishers (publisher lock), malformed samples,
incompatible QoS, overruns, a full disk and steps of the clock.
"""

import json
import math
import os
import subprocess
import sys
import time
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from enum import Enum
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import psutil
import pytest
from mcap.records import Message
from numpy.random import Generator
from rcl_interfaces.srv import SetParameters
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.serialization import serialize_message
from sensor_msgs.msg import JointState
from tests.conftest import REPOSITORY
from tests.ros.conftest import Process, logged
from tests.ros.flight_bringup.faults.flight import (
    INPUTS,
    MAX_AGE,
    OUTPUTS,
    OWN_SESSION,
    PUBLISHED,
    ROLES,
    U_MAX_AGE,
    Flight,
    Kind,
)
from tests.ros.peer import peer
from tests.small_disk import fill, small_disk

from flight_analysis.closed_loop.scenario import load_scenario
from flight_core.modes import Mode
from flight_core.rates import nanoseconds, seconds
from flight_core.vectors import FloatArray
from flight_log.scan import Scan
from flight_ros.event_loop import LATE_REQUEST_PAUSE
from flight_ros.messages import to_message
from flight_view.server import TOKEN_HEADER

SLACK = 0.05
"""s. From a node's tick to the probe, over the threads of the middleware: some milliseconds each.
Host scheduling delays (`Flight.host_delay`) are allowed in addition."""

# s, after which a refusal and incompatible QoS are logged again; with 0.1 s to spare
REFUSAL_PERIOD, QOS_PERIOD = (2.1, 5.1)
REPORT = 1.0  # s, the period of the diagnostics
DISCOVERY = 0.5  # s, of a new node by all others
# s, from being ready to full traffic, and until a recorder has received the history of the
# publishers
RESTART = 0.5
STOP = 1.2  # s: beyond the age limits, hold and ramp


class Response(Enum):
    """The response of u to a fault."""

    UNCHANGED = "unchanged: the law flies on"
    CONTROLLER_FAILSAFE = "held, then ramped to trim by the controller"
    AIRCRAFT_FAILSAFE = "held, then ramped to trim by the aircraft"
    LATE = "the law flies, late"
    WINGS_LEVELLED = "the law flies on: the reference model levels the wings"
    RELEASED = "released to the autopilot, and trim; engaged again by request"
    WITHIN_LIMITS = "the law flies on: guidance corrects the error within its limits"


Detection = Callable[[Flight], float | None]
Injection = Callable[[Flight, Generator], None]


class Case(NamedTuple):
    """One fault."""

    name: str
    inject: Injection  # from the begin of the fault to its end
    detection: Detection | None  # when the flight detected it; None where it has no means to
    within: float = 0.0  # s, from the begin of the fault to its detection
    response: Response = Response.UNCHANGED
    recovery: float = 0.0  # s, from the end of the fault until the law is engaged
    kind: Kind = Kind.PLAIN  # of the flight
    victim: str = ""  # the role that is killed or stopped
    needs: tuple[str, ...] = ()  # the roles that detect the fault, or that the injection needs
    alone: bool = False  # beside no other fault: it concerns every node, or the log of what it left
    # by which the time limits grow: the delays of two processes add up, of the node and of the
    # probe
    host_delays: float = 2.0


# Detection


def logs(role: str, pattern: str) -> Detection:
    """Return a detection by a log line of a node, on /rosout."""
    return lambda flight: flight.first_line(role, pattern, flight.begin - 0.1)


def enters(mode: Mode) -> Detection:
    """Return a detection by the mode of the controller."""

    def detection(flight: Flight) -> float | None:
        ticks = flight.ticks(flight.begin)
        in_mode = np.flatnonzero(ticks.mode == mode)
        return float(ticks.t[in_mode[0]]) if len(in_mode) else None

    return detection


def counts(role: str, key: str) -> Detection:
    """Return a detection by a counter in the diagnostics of a node."""

    def detection(flight: Flight) -> float | None:
        reports = flight.diagnostics(role, flight.begin - 2.5 * REPORT)
        values = [(at, float(report[key])) for at, _, report in reports if key in report]
        before = [value for at, value in values if at < flight.begin]
        return next(
            (at for at, value in values if at >= flight.begin and value > (before or [0.0])[-1]),
            None,
        )

    return detection


def refusal(topic: str, reason: str) -> str:
    """Return the pattern of the line that logs a refused sample."""
    return f"/{topic}: sample refused: .*{reason}"


def conflicting(topic: str, publisher: str) -> Detection:
    """Return a detection by the publisher lock's line about a conflicting publisher."""
    return logs(
        CONSUMERS[topic], refusal(topic, rf"conflicting publisher /{publisher}(#\d+)? ignored")
    )


# Injection


def until_logged_again(flight: Flight, role: str, pattern: str, period: float) -> None:
    """Wait until the rate limit of a log line is over, so that a node would log it at once."""
    flight.until(
        lambda: flight.first_line(role, pattern, time.time() - period) is None,
        10.0,
        "end of the rate limit",
    )


def until_refusal_logged_again(flight: Flight, topic: str, reason: str) -> None:
    until_logged_again(flight, CONSUMERS[topic], refusal(topic, reason), REFUSAL_PERIOD)


def pause(flight: Flight, duration: float) -> None:
    """Wait, s."""
    until = time.monotonic() + duration
    flight.until(lambda: time.monotonic() >= until, duration + 2.0, f"{duration:g} s")


def at_random(flight: Flight, random: Generator) -> None:
    """Wait for an instant anywhere within a tick of the controller."""
    pause(flight, random.uniform(0.0, 0.01))


def kill(role: str) -> Injection:
    """Kill a node, and start it again when u is at trim. The recorder starts again at once."""

    def inject(flight: Flight, random: Generator) -> None:
        at_random(flight, random)
        begin = flight.begin_fault()
        flight.kill(role)
        if role in {"aircraft", "reference_model"}:
            flight.until(
                lambda: flight.ticks(begin).mode[-1:].tolist() == [Mode.TRIM], 10.0, "u at trim"
            )
        elif role == "controller":
            trim = [[0.0] * len(INPUTS)]
            flight.until(
                lambda: flight.actuator_positions(time.time() - 1.0)[1][-1:].tolist() == trim,
                10.0,
                "inputs at trim",
            )
        restart(flight, role)

    return inject


def restart(flight: Flight, role: str) -> None:
    """Start a killed node again. The fault ends when the node is ready."""
    started = flight.start(role)
    flight.processes[role].wait_for("ready")
    run, waited = flight.spent(role)
    flight.end_fault()
    ready = flight.until(
        lambda: ready_stamp(flight, role, started), 5.0, f"{role} ready, on /rosout"
    )
    traffic = flight.until(
        lambda: full_traffic(flight, role, ready), 5.0, f"full traffic of {role}"
    )
    # the first tick of a recorder writes what it received before it was ready
    traffic = max(traffic, ready)
    flight.end = ready
    flight.measured |= {"ready_to_traffic": traffic - ready, "exec_to_traffic": traffic - started}
    flight.measured |= {"exec_to_ready": ready - started, "start_run": run, "start_waited": waited}
    if role == "recorder":
        caught_up = flight.until(
            lambda: recorded_since(flight.runs[-1], ready), 5.0, "new samples in the log"
        )
        flight.measured["ready_to_caught_up"] = caught_up - ready


def disturb(flight: Flight, *words: str) -> float:
    """Run a process of `foreign.py`, which is the fault, and return how much it sent."""
    process = Process(
        "tests.ros.flight_bringup.faults.foreign", *words, cwd=REPOSITORY, within=OWN_SESSION
    )
    try:
        process.wait_for("begins at")
        flight.begin = float(process.lines[-1].split()[-1])
        process.wait_for("sent")
    finally:
        process.popen.kill()
        process.end()
    flight.end_fault()
    return float(process.lines[-1].split()[1])


BANK = 0.5  # rad, commanded in a roll-in; guidance flies at most 0.52
LEVEL = 10.0  # s after the loss of u_m, until the wings have to be level


def kill_in_a_roll_in(flight: Flight, random: Generator) -> None:
    """Kill guidance at any bank of a roll-in to either side.

    It is started again when the wings should be level.
    """
    bank = float(random.choice((-BANK, BANK)))
    fraction = random.uniform(0.0, 0.95)

    def rolled_in() -> bool:
        flight.probe.target(phi=bank)
        return bool((flight.bank(time.time() - 0.1)[1] / bank >= fraction).any())

    flight.until(rolled_in, 20.0, f"a bank of {bank * fraction:.2f} rad")
    flight.begin_fault()
    flight.kill("guidance")
    flight.until(
        lambda: flight.bank(flight.begin + LEVEL)[0].size, LEVEL + 5.0, "the end of the levelling"
    )
    restart(flight, "guidance")
    flight.until(flight.is_level, 20.0, "level flight under guidance")


def pose_fault(word: str, *back: str) -> Injection:
    """Return a fault of the pose that lasts for some time.

    Guidance then logs that the pose is back.
    """

    def inject(flight: Flight, random: Generator) -> None:
        at_random(flight, random)
        flight.begin_fault()
        with flight.pose_fault(word):
            pause(flight, STOP)
        flight.end_fault()
        for line in back:
            returns = partial(flight.first_line, "guidance", line, flight.begin)
            flight.until(returns, 20.0, line)
        flight.until(flight.is_level, 20.0, "level flight under guidance")

    return inject


def reboot(flight: Flight, random: Generator) -> None:
    """Kill the autopilot, and start it again.

    The bridge engages when this is requested, and not before.
    """
    at_random(flight, random)
    begin = flight.begin_fault()
    flight.kill("autopilot")
    flight.until(
        lambda: flight.first_line("bridge", "RELEASE -> DISENGAGED", begin), 5.0, "disengaged"
    )
    started = flight.start("autopilot")
    back = flight.until(lambda: flight.first_message("y", started), 20.0, "y of the autopilot")
    flight.until(lambda: time.time() - back >= 1.0, 2.0, "a second with y")
    assert flight.first_line("bridge", "-> ENGAGED", begin) is None
    flight.engage()


# The live page


class Page(NamedTuple):
    """A server of the live page."""

    process: Process
    address: str

    def state(self) -> str:
        """Return what the page says about the recording, to a browser that has just loaded it.

        Without an answer, it is empty.
        """
        base, _, token = self.address.partition("#token=")
        request = urllib.request.Request(f"{base}data/0", headers={TOKEN_HEADER: token})  # noqa: S310 - http of this host
        try:
            with urllib.request.urlopen(request, timeout=10.0) as response:  # noqa: S310 - as above
                content = response.read()
        except OSError:
            return ""
        return str(json.loads(content[4 : 4 + int.from_bytes(content[:4], "little")])["state"])


@contextmanager
def live_page(flight: Flight) -> Iterator[Page]:
    """Run `rise-di watch` with the present recording, and check that it is shown."""
    words = ("flight_cli.cli", "watch", str(flight.runs[-1]), "--wait", "--port", "0")
    process = Process(*words, cwd=flight.folder, within=OWN_SESSION)
    try:
        process.wait_for("http://")
        page = Page(process, next(line for line in process.lines if line.startswith("http://")))
        flight.until(lambda: page.state() == "recording", 10.0, "a page that shows the recording")
        yield page
        process.popen.terminate()
        assert process.end() == 0, process.output
        assert "Traceback" not in process.output
    finally:
        process.popen.kill()
        process.end()


CONNECTIONS, PAGE_STORM = 1000, 2.0  # s


def storm_on_the_page(flight: Flight, random: Generator) -> None:
    """Open a thousand connections to the live page that request all samples and read nothing.

    The page must answer afterwards.
    """
    with live_page(flight) as page:
        disturb(flight, "clients", page.address, str(CONNECTIONS), str(PAGE_STORM))
        # The goal is 2 s. A busy host takes longer: each connection has one answer of some
        # megabytes ahead of this one.
        flight.until(lambda: page.state() == "recording", 60.0, "a page that answers again")
        flight.measured["page"] = time.time() - flight.end


def recorder_killed_under_the_page(flight: Flight, random: Generator) -> None:
    """The page says that its recording was interrupted, and a new page shows the new recording."""
    with live_page(flight) as page:
        at_random(flight, random)
        flight.begin_fault()
        flight.kill("recorder")
        restart(flight, "recorder")  # at once: publishers keep two seconds
        flight.until(lambda: page.state() == "interrupted", 10.0, "a page that says so")
        flight.measured["page"] = time.time() - flight.begin
        with live_page(flight):
            assert page.state() == "interrupted"


def ready_stamp(flight: Flight, role: str, begin: float) -> float | None:
    """Return the stamp of a node's line "ready".

    The line is received later, when the probe has discovered the node.
    """
    for arrival in flight.probe.since("/rosout", begin):
        if arrival.message.name == role and arrival.message.msg == "ready":
            stamp = arrival.message.stamp
            return float(stamp.sec + 1e-9 * stamp.nanosec)
    return None


def full_traffic(flight: Flight, role: str, begin: float) -> float | None:
    """Return when the last of a node's topics had its first message.

    For the recorder, this is when the log had a message of every topic.
    """
    if role == "recorder":
        return recorded_since(flight.runs[-1], 0.0)
    firsts = [flight.first_message(topic, begin) for topic in PUBLISHED[role]]
    return None if None in firsts else max(first for first in firsts if first is not None)


def recorded_since(run: Path, begin: float) -> float | None:
    """Return when the log had a message of every topic that was sent after an instant."""
    firsts: dict[str, float] = {}
    for topic, record in logged(run):
        if seconds(record.publish_time) >= begin:
            firsts.setdefault(topic, seconds(record.log_time))
    topics = ("/y", "/y_m", "/u", "/internals", "/truth")
    return max(firsts[topic] for topic in topics) if set(topics) <= set(firsts) else None


def stop(role: str) -> Injection:
    """Stop a node with SIGSTOP, and continue it with SIGCONT."""

    def inject(flight: Flight, random: Generator) -> None:
        at_random(flight, random)
        flight.begin_fault()
        with flight.processes[role].stopped():
            pause(flight, STOP)
        flight.end_fault()

    return inject


STORM_RATE, STORM_DURATION = 10_000.0, 2.0  # Hz, s
STORM_ATTEMPTS = 3  # a host that other work delays may send too few once


def storm(topic: str, reason: str = "conflicting publisher") -> Injection:
    """Ten thousand vectors a second from an unexpected publisher, refused for a reason."""

    def inject(flight: Flight, random: Generator) -> None:
        seed = int(random.integers(2**31))
        for _ in range(STORM_ATTEMPTS):
            until_refusal_logged_again(flight, topic, reason)
            message_count = disturb(
                flight, "storm", topic, str(STORM_RATE), str(STORM_DURATION), str(seed)
            )
            if message_count >= 0.5 * STORM_RATE * STORM_DURATION:
                return
        pytest.fail("the host is too busy for a storm")

    return inject


NAMES = {"y": OUTPUTS, "y_m": OUTPUTS, "u": INPUTS}
PUBLISHERS = {
    "y": "aircraft",
    "y_m": "reference_model",
    "u": "controller",
    "u_m": "guidance",
    "proposal": "learner",
}
CONSUMERS = {
    "y": "controller",
    "y_m": "controller",
    "u": "aircraft",
    "u_m": "reference_model",
    "target": "guidance",
}
CONSUMERS["proposal"] = "controller"

Names = tuple[str, ...]
# the offset of its stamp from the present, s; names; values
BadSample = tuple[float, Names, FloatArray]


def not_finite(values: tuple[float, ...], names: Names, random: Generator) -> BadSample:
    value = random.choice(values)
    bad = random.uniform(-1.0, 1.0, len(names))
    bad[random.integers(len(names))] = value
    return 0.0, names, bad


def wrong_names(names: Names, random: Generator) -> BadSample:
    bad = list(names)
    bad[random.integers(len(names))] = random.choice(
        ("", "x", f"{names[0]} ", "q_deg", "\N{GREEK SMALL LETTER DELTA}")
    )
    return 0.0, tuple(bad), random.uniform(-1.0, 1.0, len(names))


def wrong_length(names: Names, random: Generator) -> BadSample:
    length = random.choice((0, 1, len(names) - 1, len(names) + 1, 2 * len(names)))
    return 0.0, names, random.uniform(-1.0, 1.0, length)


def too_long(names: Names, random: Generator) -> BadSample:
    channels = (*names, *(f"c{k:05}" for k in range(random.integers(20, 800))))  # 800 have 16 kB
    return 0.0, channels, random.uniform(-1.0, 1.0, len(channels))


def wrong_stamp(sign: float, names: Names, random: Generator) -> BadSample:
    return sign * 10.0 ** random.uniform(0.0, 8.0), names, random.uniform(-1.0, 1.0, len(names))


BAD: dict[
    str, tuple[Callable[[Names, Generator], BadSample], str, str]
] = {  # sample, key of the counter, log line
    "NaN": (partial(not_finite, (math.nan,)), "finite", "is not finite"),
    "wrong names": (wrong_names, "name", "expected once among"),
    "wrong length": (wrong_length, "length", "names for"),
    "past stamps": (partial(wrong_stamp, -1.0), "old", "stamp [^ ]+ s old"),
    "future stamps": (partial(wrong_stamp, 1.0), "future", "ahead of the clock"),
    "Inf": (partial(not_finite, (-math.inf, math.inf)), "finite", "is not finite"),
    "long messages": (too_long, "size", "a message of"),
}
BAD_COUNT = 20


def malformed(topic: str, kind: str) -> Injection:
    """Send twenty bad samples with the `frame_id` of the expected publisher."""
    make, reason, sentence = BAD[kind]

    def inject(flight: Flight, random: Generator) -> None:
        consumer = CONSUMERS[topic]
        key = f"refused {topic}: {reason}"
        with relay(topic) as publish:
            until_refusal_logged_again(flight, topic, sentence)
            before = flight.count(consumer, key)
            flight.begin_fault()
            for k in range(BAD_COUNT):
                offset, names, bad = make(NAMES[topic], random)
                publish(
                    to_message(
                        time.time_ns() + nanoseconds(offset),
                        names,
                        bad,
                        flight.instance(PUBLISHERS[topic]),
                    )
                )
                at = flight.begin + 0.01 * k  # good samples arrive between the bad ones
                flight.until(lambda at=at: time.time() >= at, 1.0, "the next bad sample")  # type: ignore[misc]
            flight.end_fault()
            least = before + BAD_COUNT // 2  # best effort: a busy host may lose some
            flight.until(
                lambda: flight.count(consumer, key) >= least,
                10.0,
                f"{BAD_COUNT // 2} more of {key!r}",
            )

    return inject


@contextmanager
def relay(topic: str) -> Iterator[Callable[[JointState], None]]:
    """Start a second publisher of a topic in its own process, and wait until it is discovered."""
    process = Process(
        "tests.ros.flight_bringup.faults.foreign",
        "relay",
        topic,
        cwd=REPOSITORY,
        within=OWN_SESSION,
        stdin=subprocess.PIPE,
    )
    stdin = process.popen.stdin
    assert stdin is not None

    def publish(message: JointState) -> None:
        print(serialize_message(message).hex(), file=stdin, flush=True)

    try:
        process.wait_for("begins at")
        yield publish
        stdin.close()
        assert process.end() == 0, process.output
    finally:
        stdin.close()
        process.popen.kill()
        process.end()


def learner_killed(flight: Flight, random: Generator) -> None:
    """Kill the learner, and start it again a second later."""
    at_random(flight, random)
    flight.begin_fault()
    flight.kill("learner")
    pause(flight, 1.0)
    flight.start("learner")
    flight.processes["learner"].wait_for("ready")
    flight.end_fault()


def second_learner(flight: Flight, random: Generator) -> None:
    """Run a second learner for two seconds after its first proposal."""
    flight.processes["learner"].wait_for("no model")  # the publisher that is locked
    until_refusal_logged_again(flight, "proposal", "conflicting publisher")
    process = flight.node("learner")
    process.wait_for("no model")
    flight.begin_fault()
    pause(flight, 2.0)
    process.popen.terminate()
    assert process.end() == 0, process.output
    flight.end_fault()


def second(role: str, topic: str) -> Injection:
    """Run a second node of the same role, which publishes for two seconds."""

    def inject(flight: Flight, random: Generator) -> None:
        until_refusal_logged_again(flight, topic, "conflicting publisher")
        started = flight.begin_fault()
        process = flight.node(role)
        first = partial(flight.first_message, topic, started, f"/{role}#{process.popen.pid}")
        received = flight.until(first, 30.0, f"{topic} of a second {role}")
        # the flight's node may have discovered the second publisher before the probe has
        flight.begin = min(received, conflicting(topic, role)(flight) or received)
        flight.until(
            lambda: time.time() - flight.begin >= 2.0, 5.0, "two seconds with two publishers"
        )
        process.popen.terminate()
        assert process.end() == 0, process.output
        flight.end_fault()

    return inject


def incompatible_qos(
    role: str, create: Callable[[Node], object], detection: Detection
) -> Injection:
    """Create a publisher or a subscriber whose quality of service does not fit a node's."""

    def inject(flight: Flight, random: Generator) -> None:
        until_logged_again(flight, role, "quality of service", QOS_PERIOD)
        with peer(topics=()) as peer_node:
            flight.begin_fault()
            create(peer_node.node)
            flight.until(
                lambda: detection(flight), 20.0, "a report of the incompatible quality of service"
            )
        flight.end_fault()

    return inject


# the recorder requests a reliable publisher of y
WEAK = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
# the controller does not offer a deadline for u
STRONG = QoSProfile(depth=1, deadline=Duration(seconds=0.02))
UNRELIABLE = logs("recorder", r"/y: .*/peer .*[Rr]eliab")
DEADLINE = logs("controller", r"/u: .*/peer.*[Dd]eadline")
weaker_qos = incompatible_qos(
    "recorder", lambda node: node.create_publisher(JointState, "y", WEAK), UNRELIABLE
)
stronger_qos = incompatible_qos(
    "controller",
    lambda node: node.create_subscription(JointState, "u", lambda _: None, STRONG),
    DEADLINE,
)


def step_of_clock(by: float) -> Injection:
    """Set the system clock of all processes of the flight by so many seconds.

    It is set back when all nodes have logged the step.
    """

    def inject(flight: Flight, random: Generator) -> None:
        at_random(flight, random)
        flight.begin_fault()
        flight.set_clock(by)
        until_all_log(flight, "clock was set by", flight.begin)
        flight.set_clock(0.0)
        flight.end_fault()
        until_all_log(flight, "it is correct again", flight.end)

    return inject


def until_all_log(flight: Flight, pattern: str, begin: float) -> None:
    """Wait until each node has logged a line that matches the pattern."""
    roles = ROLES[flight.kind]
    flight.until(
        lambda: all(flight.first_line(role, pattern, begin) for role in roles),
        5.0,
        f"{pattern!r} of all nodes",
    )


def starve(flight: Flight, random: Generator) -> None:
    """Put all nodes on one core, together with six busy processes."""
    core = max(os.sched_getaffinity(0))
    nodes = [psutil.Process(process.popen.pid) for process in flight.processes.values()]
    before = [node.cpu_affinity() for node in nodes]
    busy = [
        subprocess.Popen([sys.executable, "-S", "-c", "while True: pass"], start_new_session=True)
        for _ in range(6)
    ]
    try:
        for process in busy:
            os.sched_setaffinity(process.pid, {core})
        flight.begin_fault()
        for node in nodes:
            node.cpu_affinity([core])
            for thread in node.threads():
                os.sched_setaffinity(thread.id, {core})
        pause(flight, 3.0)
    finally:
        for process in busy:
            process.kill()
            process.wait()
        flight.end_fault()
        for node, cores in zip(nodes, before, strict=True):
            for thread in node.threads():
                os.sched_setaffinity(thread.id, set(cores or ()))


def full_disk(flight: Flight, random: Generator) -> None:
    """Fill the disk of the recorder. Afterwards a new recorder uses another disk."""
    with small_disk(flight.folder / f"disk{len(flight.runs)}", 4_000_000) as folder:
        flight.processes["recorder"].popen.terminate()
        assert flight.processes["recorder"].end() == 0
        flight.runs.append(folder / "run")
        flight.start("recorder", f"directory:={flight.runs[-1]}", "min_free:=0.0")
        flight.processes["recorder"].wait_for("ready")
        flight.until(lambda: recorded_since(folder / "run", 0.0), 5.0, "all topics in the log")
        flight.begin_fault()
        fill(folder / "other")
        flight.until(
            lambda: flight.first_line("recorder", "recording ended", flight.begin),
            5.0,
            "the end of the recording",
        )
        flight.processes["recorder"].popen.terminate()
        assert flight.processes["recorder"].end() == 0
        flight.runs.pop()
        flight.start("recorder")  # before the log is read: publishers keep two seconds for it
        (file,) = (folder / "run").glob("*.mcap")
        scan = Scan(file)
        times = [record.log_time for record in scan.records() if isinstance(record, Message)]
        assert scan.complete, "the log on the full disk has its footer"
        assert flight.begin - seconds(max(times)) <= 0.3, "and all messages until the fault"
        flight.end_fault()
    flight.processes["recorder"].wait_for("ready")
    flight.until(
        lambda: recorded_since(flight.runs[-1], time.time() - 1.0),
        10.0,
        "the last two seconds in the new log",
    )


CHANGES, IN_FLIGHT = 300, 8  # requests; a service queues ten


def parameters(flight: Flight, random: Generator) -> None:
    """Send three hundred changes of gains, half of them invalid, and the first one invalid.

    Eight requests are sent at once.
    """
    valid = random.random(CHANGES) < 0.5
    valid[0] = False
    with peer(topics=()) as peer_node:
        client = peer_node.node.create_client(SetParameters, "controller/set_parameters")

        def request(name: str, value: object) -> Any:
            return client.call_async(
                SetParameters.Request(parameters=[Parameter(name, value=value).to_parameter_msg()])
            )

        peer_node.until(client.service_is_ready, "the service of parameters")
        k_g = load_scenario(flight.scenario).rise_di().k_g
        first = request("k_g", k_g)
        # both ends of the service have discovered each other
        peer_node.until(first.done, "the first answer")
        flight.begin_fault()
        futures: list[Any] = []
        count = 0

        def feed() -> None:
            nonlocal count
            while count < len(futures) and futures[count].done():
                count += 1
            while len(futures) < CHANGES and len(futures) - count < IN_FLIGHT:
                # a larger one may cost an observer's loop its margin
                lower = ("k_g", k_g * float(random.uniform(0.8, 1.0)))
                futures.append(request(*(lower if valid[len(futures)] else invalid_change(random))))

        feed()
        peer_node.until(lambda: count == CHANGES, "an answer to each request", each=feed)
        flight.end_fault()
        accepted = [future.result().results[0].successful for future in futures]
        assert accepted == valid.tolist()
        peer_node.until(request("k_g", k_g).done, "the gain of before")


def invalid_change(random: Generator) -> tuple[str, object]:
    """Return a change that is out of range, not finite, read-only, unknown or of a wrong type.

    It may also have a wrong length.
    """
    gains = (("k_g", -1.0), ("k_g", math.nan), ("k_g", math.inf))
    changes = (*gains, ("rate", 200.0), ("k_gg", 1.0), ("k_g", "much"), ("beta", [1.0]))
    return changes[random.integers(len(changes))]


# The table

U_STALE = U_MAX_AGE + 0.005  # s, and a tick, until the aircraft logs the timeout of u
STALE = MAX_AGE + 0.01  # s, and a tick, until the controller holds u

RELEASE = logs("bridge", "ENGAGED -> RELEASE")
MAP_MAX_AGE = 0.2 + 0.005  # s, of y in the map of the autopilot, and a tick of the bridge
POSE_IS_BACK, UNKNOWN = "DEAD_RECKONING -> ENGAGED", "expected some of"
UNKNOWN_TARGET = logs("guidance", refusal("target", UNKNOWN))
LIVE_MAX_AGE = 0.2  # s, of u_m, and of the pose in guidance: the defaults
STALE_U_M = (logs("reference_model", "u_m timed out"), LIVE_MAX_AGE + 0.005)  # and a tick
STALE_POSE = (logs("guidance", "pose is stale"), LIVE_MAX_AGE + 0.02)  # and a tick

STALE_INPUT = (enters(Mode.HOLD), STALE, Response.CONTROLLER_FAILSAFE)
STALE_U = (logs("aircraft", "failsafe: u from"), U_STALE, Response.AIRCRAFT_FAILSAFE)

AIRCRAFT: dict[str, Any] = {"victim": "aircraft", "needs": ("controller",)}
REFERENCE_MODEL: dict[str, Any] = {"victim": "reference_model", "needs": ("controller",)}
CONTROLLER: dict[str, Any] = {"victim": "controller", "needs": ("aircraft",)}
GUIDANCE: dict[str, Any] = {"victim": "guidance", "needs": ("reference_model", "aircraft")}
RECORDER: dict[str, Any] = {"victim": "recorder"}
GUIDED: dict[str, Any] = {"kind": Kind.GUIDED}
LEARNING: dict[str, Any] = {"kind": Kind.LEARNING}
POSE_GATE: dict[str, Any] = {"victim": "gate", "needs": ("guidance",)}
POSE_BENCHMARK = GUIDED | POSE_GATE


def ends_of(topic: str) -> tuple[str, str]:
    """Return the publisher and the subscriber of a topic."""
    return PUBLISHERS[topic], CONSUMERS[topic]


IN_SUITE = {
    "aircraft killed",
    "reference model killed",
    "controller killed",
    "recorder killed",
    "controller stopped",
    "storm on u",
    "storm of parameters",
    "CPU starved",
    "guidance killed in a roll-in",
}
"""The cases of each test run: what processes, the middleware and the host do to a flight. The
benchmark injects the others too, whose checks tests/nodes makes on the nodes alone."""

CASES = (
    Case("aircraft killed", kill("aircraft"), *STALE_INPUT, RESTART, **AIRCRAFT),
    Case(
        "reference model killed", kill("reference_model"), *STALE_INPUT, RESTART, **REFERENCE_MODEL
    ),
    Case("controller killed", kill("controller"), *STALE_U, RESTART, **CONTROLLER),
    Case("recorder killed", kill("recorder"), None, **RECORDER),
    Case("aircraft stopped", stop("aircraft"), *STALE_INPUT, **AIRCRAFT),
    Case("reference model stopped", stop("reference_model"), *STALE_INPUT, **REFERENCE_MODEL),
    Case("controller stopped", stop("controller"), *STALE_U, **CONTROLLER),
    Case("recorder stopped", stop("recorder"), None, **RECORDER),
    *(
        Case(f"storm on {topic}", storm(topic), conflicting(topic, "foreign"), needs=ends_of(topic))
        for topic in NAMES
    ),
    *(
        Case(
            f"{kind} on {topic}",
            malformed(topic, kind),
            logs(CONSUMERS[topic], refusal(topic, BAD[kind][2])),
            needs=ends_of(topic),
        )
        for topic in NAMES
        for kind in BAD
    ),
    Case(
        "second controller",
        second("controller", "u"),
        conflicting("u", "controller"),
        needs=ends_of("u"),
    ),
    Case(
        "second aircraft", second("aircraft", "y"), conflicting("y", "aircraft"), needs=ends_of("y")
    ),
    Case(
        "weaker quality of service", weaker_qos, UNRELIABLE, REPORT + DISCOVERY, needs=("recorder",)
    ),
    Case(
        "stronger quality of service",
        stronger_qos,
        DEADLINE,
        REPORT + DISCOVERY,
        needs=("controller",),
    ),
    Case(
        "CPU starved",
        starve,
        counts("aircraft", "missed ticks"),
        REPORT + 3.0,
        Response.LATE,
        0.5,
        alone=True,
    ),
    Case("disk full", full_disk, logs("recorder", "recording ended"), 0.1, alone=True),
    # A request that the host delays is followed by a pause without requests.
    Case(
        "storm of parameters",
        parameters,
        logs("controller", "parameters rejected"),
        needs=("controller",),
        host_delays=2.0 + LATE_REQUEST_PAUSE,
    ),
    Case(
        "clock set back",
        step_of_clock(-5.0),
        logs("controller", r"clock was set by -5\S* s: (?!it is correct)"),
        REPORT,
        kind=Kind.OWN_CLOCK,
        alone=True,
    ),
    Case(
        "clock set forth",
        step_of_clock(5.0),
        logs("controller", r"clock was set by \+5\S* s: (?!it is correct)"),
        REPORT,
        kind=Kind.OWN_CLOCK,
        alone=True,
    ),
    Case("storm on the live page", storm_on_the_page, None, needs=("recorder",)),
    Case(
        "recorder killed under a live page", recorder_killed_under_the_page, None, victim="recorder"
    ),
    Case(
        "guidance killed in a roll-in",
        kill_in_a_roll_in,
        *STALE_U_M,
        Response.WINGS_LEVELLED,
        kind=Kind.GUIDED,
        **GUIDANCE,
    ),
    Case("guidance stopped", stop("guidance"), *STALE_U_M, kind=Kind.GUIDED, **GUIDANCE),
    Case(
        "second guidance",
        second("guidance", "u_m"),
        conflicting("u_m", "guidance"),
        **GUIDED,
        needs=ends_of("u_m"),
    ),
    Case(
        "storm on u_m", storm("u_m"), conflicting("u_m", "foreign"), **GUIDED, needs=ends_of("u_m")
    ),
    Case(
        "storm on target", storm("target", UNKNOWN), UNKNOWN_TARGET, **GUIDED, needs=("guidance",)
    ),
    Case(
        "pose frozen",
        pose_fault("repeat", POSE_IS_BACK),
        *STALE_POSE,
        kind=Kind.GUIDED,
        **POSE_GATE,
    ),
    Case(
        "pose frozen, new stamps", pose_fault("freeze", POSE_IS_BACK), *STALE_POSE, **POSE_BENCHMARK
    ),
    Case("pose stale", pose_fault("hold", POSE_IS_BACK), *STALE_POSE, **POSE_BENCHMARK),
    Case(
        "pose jumping", pose_fault("jump"), None, response=Response.WITHIN_LIMITS, **POSE_BENCHMARK
    ),
    Case("learner killed", learner_killed, None, **LEARNING, victim="learner"),
    Case("learner stopped", stop("learner"), None, **LEARNING, victim="learner"),
    Case(
        "second learner",
        second_learner,
        conflicting("proposal", "learner"),
        0.02,
        **LEARNING,
        needs=ends_of("proposal"),
    ),
    Case(
        "storm on proposal",
        storm("proposal"),
        conflicting("proposal", "foreign"),
        **LEARNING,
        needs=ends_of("proposal"),
    ),
    Case(
        "autopilot rebooted", reboot, RELEASE, MAP_MAX_AGE, Response.RELEASED, RESTART, Kind.BRIDGED
    ),
)
