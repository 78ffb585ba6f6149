# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""The faults: what is done to the flight, who notices and how, what u does meanwhile, how soon all is as before."""

import math
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from enum import Enum
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from mcap.records import Message
from numpy.random import Generator
from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue
from rcl_interfaces.srv import SetParameters
from rclpy.duration import Duration
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.serialization import serialize_message
from sensor_msgs.msg import JointState
from tests.conftest import REPOSITORY
from tests.ros.conftest import Process
from tests.ros.faults.flight import APART, INPUTS, MAX_AGE, OUTPUTS, SAYS, SILENCE, Flight, logged
from tests.ros.peer import peer
from tests.small_disk import fill, small_disk

from flight_core.rates import nanoseconds, seconds
from flight_core.vectors import FloatArray
from flight_log.scan import Scan
from flight_ros.messages import to_message
from rise_di_controller.guard import Mode

SLACK = 0.05
"""s. From a node's tick to the probe, over the middleware's threads: some milliseconds each. Where the machine holds processes
back, `Flight.held_back` comes on top."""

REFUSED, UNFIT = 2.1, 5.1  # s, after which a refusal, and who does not fit, are said again; and a tenth

REPORT = 1.0  # s, the period of the diagnostics

FOUND = 0.5  # s, in which a newcomer has announced itself to all

BACK = 0.5  # s, from being ready to full traffic, and until a recorder also has what publishers have kept

STOPPED = 1.2  # s: beyond the age limits, hold and ramp

STORM_RATE, STORM = 10_000.0, 2.0  # Hz, s


class Does(Enum):
    """What u does while the fault lasts."""

    FLIES = "unchanged: the law flies on"
    LETS_GO = "held, then ramped to trim by the controller"
    IS_LET_GO = "held, then ramped to trim by the aircraft"
    LATE = "the law flies, late"


Noticed = Callable[[Flight], float | None]


class Case(NamedTuple):
    """One fault."""

    name: str
    inject: Callable[[Flight, Generator], None]  # all of it, until there is no fault any more
    noticed: Noticed | None  # when the flight noticed, None where it has no reason to
    within: float  # s, of the fault
    does: Does
    recovers: float  # s, from the end of the fault until the law flies
    own_flight: bool = False  # with a clock that can be set


# How a fault is noticed


def says(role: str, pattern: str) -> Noticed:
    """By a line in the log of a node, on /rosout."""
    return lambda flight: flight.said(role, pattern, flight.begin - 0.1)


def enters(mode: Mode) -> Noticed:
    """By the mode of the controller."""

    def noticed(flight: Flight) -> float | None:
        flown = flight.flown(flight.begin)
        found = np.flatnonzero(flown.mode == mode)
        return float(flown.t[found[0]]) if len(found) else None

    return noticed


def grows(role: str, key: str) -> Noticed:
    """By a counter in the diagnostics of a node."""

    def noticed(flight: Flight) -> float | None:
        figures = flight.figure(role, key, flight.begin - 2.5 * REPORT)
        before = [value for at, value in figures if at < flight.begin]
        return next((at for at, value in figures if at >= flight.begin and value > (before or [0.0])[-1]), None)

    return noticed


# What is done


def refuses(topic: str, why: str) -> Noticed:
    """By the refusal of a sample, with its reason."""
    return says(TAKERS[topic], f"/{topic}: sample refused: .*{why}")


def intrudes(topic: str, other: str) -> Noticed:
    """By the refusal of the samples of a second publisher."""
    return refuses(topic, rf"conflicting publisher /{other}(#\d+)? ignored")


def unsaid(flight: Flight, role: str, pattern: str, repeated: float) -> None:
    """Wait until the same would be said again, at once."""
    flight.until(lambda: flight.said(role, pattern, time.time() - repeated) is None, 10.0, "the last fault forgotten")


def unrefused(flight: Flight, topic: str, why: str) -> None:
    """Wait until the refusal of a sample would be said again, at once."""
    unsaid(flight, TAKERS[topic], f"/{topic}: sample refused: .*{why}", REFUSED)


def at_random(flight: Flight, random: Generator) -> None:
    """An instant anywhere within a tick of the controller."""
    until = time.monotonic() + random.uniform(0.0, 0.01)
    flight.until(lambda: time.monotonic() >= until, 1.0, "the instant of the fault")


def let_go(flight: Flight) -> None:
    """Wait until u is at trim, as the aircraft's inputs say."""
    flight.until(lambda: flight.moved(time.time() - 1.0)[1][-1:].tolist() == [[0.0] * len(INPUTS)], 10.0, "u at trim")


def kill(role: str) -> Callable[[Flight, Generator], None]:
    """SIGKILL, and a restart by hand when nothing flies any more."""

    def inject(flight: Flight, random: Generator) -> None:
        at_random(flight, random)
        begin = flight.fault()
        flight.kill(role)
        if role in {"aircraft", "reference_model"}:
            flight.until(lambda: flight.flown(begin).mode[-1:].tolist() == [Mode.TRIM], 10.0, "u at trim")
        elif role == "controller":
            let_go(flight)
        started = flight.start(role)
        flight.processes[role].wait_for("ready")
        flight.over()
        ready = flight.until(lambda: said_ready(flight, role, started), 5.0, f"{role} ready, on /rosout")
        back = flight.until(lambda: full_traffic(flight, role, ready), 5.0, f"{role} back to full traffic")
        back = max(back, ready)  # a recorder writes with its first tick what has come before that
        flight.end = ready
        flight.measured |= {"ready_to_traffic": back - ready, "exec_to_traffic": back - started}
        if role == "recorder":
            caught_up = flight.until(lambda: recorded_since(flight.runs[-1], ready), 5.0, "what is said now in the log")
            flight.measured["ready_to_caught_up"] = caught_up - ready

    return inject


def said_ready(flight: Flight, role: str, begin: float) -> float | None:
    """When a node stamped its line "ready"; it is heard a little later, once the probe has found the node."""
    for one in flight.probe.since("/rosout", begin):
        if one.message.name == role and one.message.msg == "ready":
            stamp = one.message.stamp
            return float(stamp.sec + 1e-9 * stamp.nanosec)
    return None


def full_traffic(flight: Flight, role: str, begin: float) -> float | None:
    """When the last of what a node says came for the first time; for the recorder, when all topics had begun to be written."""
    if role == "recorder":
        return recorded_since(flight.runs[-1], 0.0)
    firsts = [flight.first(topic, begin) for topic in SAYS[role]]
    return None if None in firsts else max(first for first in firsts if first is not None)


def recorded_since(run: Path, begin: float) -> float | None:
    """When a recorder first wrote down something sent after an instant, on the topic on which that was latest."""
    firsts: dict[str, float] = {}
    for one in logged(run):
        if one.sent >= begin:
            firsts.setdefault(one.topic, one.written)
    wanted = ("/y", "/y_m", "/u", "/internals", "/truth")
    return max(firsts[topic] for topic in wanted) if set(wanted) <= set(firsts) else None


def stop(role: str) -> Callable[[Flight, Generator], None]:
    """SIGSTOP, then SIGCONT."""

    def inject(flight: Flight, random: Generator) -> None:
        at_random(flight, random)
        begin = flight.fault()
        with flight.stopped(role):
            flight.until(lambda: time.time() - begin >= STOPPED, 5.0, "the end of the stop")
        flight.over()

    return inject


def storm(topic: str) -> Callable[[Flight, Generator], None]:
    """Ten thousand vectors a second from a foreign process, that look like those of the flight."""

    def inject(flight: Flight, random: Generator) -> None:
        seed = int(random.integers(2**31))
        words = ("tests.ros.faults.foreign", "storm", topic, str(STORM_RATE), str(STORM), str(seed))
        unrefused(flight, topic, "conflicting publisher")
        process = Process(*words, cwd=REPOSITORY, within=APART)
        try:
            process.wait_for("begins at")
            flight.begin = float(process.lines[-1].split()[-1])
            process.wait_for("sent")
        finally:
            process.popen.kill()
            process.end()
        flight.over()
        sent = float(process.lines[-1].split()[1])
        flight.measured["messages_per_second"] = sent / STORM
        assert sent >= 0.5 * STORM_RATE * STORM, "the machine is too busy for a storm"

    return inject


NAMES = {"y": OUTPUTS, "y_m": OUTPUTS, "u": INPUTS}
OWNERS = {"y": "aircraft", "y_m": "reference_model", "u": "controller"}
TAKERS = {"y": "controller", "y_m": "controller", "u": "aircraft"}


def not_a_number(stamp_ns: int, names: tuple[str, ...], sender: str, random: Generator) -> JointState:
    return to_message(stamp_ns, names, one_is(math.nan, names, random), sender)


def infinite(stamp_ns: int, names: tuple[str, ...], sender: str, random: Generator) -> JointState:
    return to_message(stamp_ns, names, one_is(random.choice((-math.inf, math.inf)), names, random), sender)


def wrong_names(stamp_ns: int, names: tuple[str, ...], sender: str, random: Generator) -> JointState:
    others = list(names)
    others[random.integers(len(names))] = random.choice(("", "x", f"{names[0]} ", "q_deg", "\N{GREEK SMALL LETTER DELTA}"))
    return to_message(stamp_ns, others, random.uniform(-1.0, 1.0, len(names)), sender)


def wrong_length(stamp_ns: int, names: tuple[str, ...], sender: str, random: Generator) -> JointState:
    length = random.choice((0, 1, len(names) - 1, len(names) + 1, 1000))
    return to_message(stamp_ns, names, random.uniform(-1.0, 1.0, length), sender)


def past(stamp_ns: int, names: tuple[str, ...], sender: str, random: Generator) -> JointState:
    early = nanoseconds(10.0 ** random.uniform(0.0, 8.0))
    return to_message(stamp_ns - early, names, random.uniform(-1.0, 1.0, len(names)), sender)


def future(stamp_ns: int, names: tuple[str, ...], sender: str, random: Generator) -> JointState:
    ahead = nanoseconds(10.0 ** random.uniform(0.0, 8.0))
    return to_message(stamp_ns + ahead, names, random.uniform(-1.0, 1.0, len(names)), sender)


def one_is(value: float, names: tuple[str, ...], random: Generator) -> FloatArray:
    values = random.uniform(-1.0, 1.0, len(names))
    values[random.integers(len(names))] = value
    return values


BAD = {
    "NaN": (not_a_number, "finite", "is not finite"),
    "wrong names": (wrong_names, "name", "expected once among"),
    "wrong length": (wrong_length, "length", "names for"),
    "past stamps": (past, "order", "(after|before) the last one"),
    "future stamps": (future, "future", "ahead of the clock"),
    "Inf": (infinite, "finite", "is not finite"),
}
BAD_COUNT = 20


def malformed(topic: str, kind: str) -> Callable[[Flight, Generator], None]:
    """Twenty bad samples that bear the name of the node that flies."""
    make, reason, sentence = BAD[kind]

    def inject(flight: Flight, random: Generator) -> None:
        taker, key = TAKERS[topic], f"refused {topic}: {reason}"
        with relay(topic) as publish:
            unrefused(flight, topic, sentence)
            before = flight.count(taker, key)
            flight.fault()
            for k in range(BAD_COUNT):
                publish(make(time.time_ns(), NAMES[topic], flight.instance(OWNERS[topic]), random))
                at = flight.begin + 0.01 * k  # two ticks are never without good samples between bad ones
                flight.until(lambda at=at: time.time() >= at, 1.0, "the next bad sample")  # type: ignore[misc]
            flight.over()
            least = before + BAD_COUNT // 2  # best effort: a machine that is held up may lose some
            flight.until(lambda: flight.count(taker, key) >= least, 10.0, f"{BAD_COUNT // 2} more of {key!r}")

    return inject


@contextmanager
def relay(topic: str) -> Iterator[Callable[[JointState], None]]:
    """A further publisher of a topic, a process of its own as any would be, found by all who listen."""
    process = Process("tests.ros.faults.foreign", "relay", topic, cwd=REPOSITORY, within=APART, stdin=subprocess.PIPE)
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


def second(role: str, topic: str) -> Callable[[Flight, Generator], None]:
    """A second node of the same kind, that publishes for two seconds."""

    def inject(flight: Flight, random: Generator) -> None:
        unrefused(flight, topic, "conflicting publisher")
        started = flight.fault()
        process = flight.node(role)
        first = partial(flight.first_of, topic, f"/{role}#{process.popen.pid}", started)
        heard = flight.until(first, 30.0, f"{topic} of a second {role}")
        # the node may have found the newcomer before the probe has
        flight.begin = min(heard, intrudes(topic, role)(flight) or heard)
        flight.until(lambda: time.time() - flight.begin >= 2.0, 5.0, "two seconds with two")
        process.popen.terminate()
        assert process.end() == 0, process.output
        flight.over()

    return inject


def weak_publisher(flight: Flight, random: Generator) -> None:
    """A publisher of y that is best effort, which the recorder cannot take reliably."""
    unsaid(flight, "recorder", QUALITY, UNFIT)
    with peer(topics=()) as peer_node:
        flight.fault()
        peer_node.node.create_publisher(JointState, "y", QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT))
        flight.until(lambda: WEAK(flight), 20.0, "the weak publisher named")
    flight.over()


def demanding_listener(flight: Flight, random: Generator) -> None:
    """A listener of u that asks for a deadline that the controller does not offer, and so never hears it."""
    unsaid(flight, "controller", QUALITY, UNFIT)
    with peer(topics=()) as peer_node:
        flight.fault()
        asked = QoSProfile(depth=1, deadline=Duration(seconds=0.02))
        peer_node.node.create_subscription(JointState, "u", lambda _: None, asked)
        flight.until(lambda: DEMANDING(flight), 20.0, "the demanding listener named")
    flight.over()


QUALITY = "quality of service"
WEAK = says("recorder", r"/y: .*/peer .*[Rr]eliab")
DEMANDING = says("controller", r"/u: .*/peer.*[Dd]eadline")


def step_of_clock(by: float) -> Callable[[Flight, Generator], None]:
    """The system clock of all processes of the flight, set by so many seconds and, two seconds later, set right."""

    def inject(flight: Flight, random: Generator) -> None:
        at_random(flight, random)
        begin = flight.fault()
        flight.set_clock(by)
        flight.until(lambda: time.time() - begin >= 3.0, 5.0, "three seconds with the wrong clock")
        flight.set_clock(0.0)
        flight.over()
        flight.until(lambda: flight.said("controller", "it is correct again", flight.end), 5.0, "the right clock noticed")

    return inject


def starve(flight: Flight, random: Generator) -> None:
    """All nodes on one core, together with six processes that want all of it."""
    core = max(os.sched_getaffinity(0))
    nodes = [flight.process(role) for role in flight.processes]
    before = [node.cpu_affinity() for node in nodes]
    busy = [subprocess.Popen([sys.executable, "-S", "-c", "while True: pass"], start_new_session=True) for _ in range(6)]
    try:
        for one in busy:
            os.sched_setaffinity(one.pid, {core})
        begin = flight.fault()
        for node in nodes:
            node.cpu_affinity([core])
            for thread in node.threads():
                os.sched_setaffinity(thread.id, {core})
        flight.until(lambda: time.time() - begin >= 3.0, 5.0, "three hungry seconds")
    finally:
        for one in busy:
            one.kill()
            one.wait()
        flight.over()
        for node, cores in zip(nodes, before, strict=True):
            for thread in node.threads():
                os.sched_setaffinity(thread.id, set(cores or ()))


def full_disk(flight: Flight, random: Generator) -> None:
    """The disk of the recorder runs full. It then records on another one."""
    with small_disk(flight.folder / f"disk{len(flight.runs)}", 4_000_000) as folder:
        flight.processes["recorder"].popen.terminate()
        assert flight.processes["recorder"].end() == 0
        flight.runs.append(folder / "run")
        flight.start("recorder", f"directory:={flight.runs[-1]}", "min_free:=0.0")
        flight.processes["recorder"].wait_for("ready")
        flight.until(lambda: recorded_since(folder / "run", 0.0), 5.0, "a recorder that records")
        flight.fault()
        fill(folder / "other")
        flight.until(lambda: flight.said("recorder", "recording ended", flight.begin), 5.0, "the full disk")
        flight.processes["recorder"].popen.terminate()
        assert flight.processes["recorder"].end() == 0
        (file,) = (folder / "run").glob("*.mcap")
        scan = Scan(file)
        times = [record.log_time for record in scan.records() if isinstance(record, Message)]
        assert scan.complete, "the log on the full disk has its end"
        assert flight.begin - seconds(max(times)) <= 0.3, "and all until then"
        flight.runs.pop()
        flight.over()
    flight.start("recorder")
    flight.processes["recorder"].wait_for("ready")


STORM_OF_PARAMETERS, UNDER_WAY = 2000, 8  # a service keeps ten requests


def parameters(flight: Flight, random: Generator) -> None:
    """Two thousand changes of the controller's gains, half of them bad, the first one too; eight always under way."""
    valid = random.random(STORM_OF_PARAMETERS) < 0.5
    valid[0] = False
    with peer(topics=()) as peer_node:
        client = peer_node.node.create_client(SetParameters, "controller/set_parameters")
        peer_node.until(client.service_is_ready)
        first = client.call_async(SetParameters.Request(parameters=[number("k_g", 1.0)]))
        peer_node.until(first.done)  # from then on each knows of the other
        flight.fault()
        futures: list[Any] = []
        done = 0

        def feed() -> None:
            nonlocal done
            while done < len(futures) and futures[done].done():
                done += 1
            while len(futures) < STORM_OF_PARAMETERS and len(futures) - done < UNDER_WAY:
                change = good_change(random) if valid[len(futures)] else bad_change(random)
                futures.append(client.call_async(SetParameters.Request(parameters=[change])))

        feed()
        peer_node.until(lambda: done == STORM_OF_PARAMETERS, 100.0, each=feed)
        flight.over()
        flight.measured["changes_per_second"] = STORM_OF_PARAMETERS / (flight.end - flight.begin)
        accepted = [future.result().results[0].successful for future in futures]
        assert accepted == valid.tolist()
        future = client.call_async(SetParameters.Request(parameters=[number("k_g", 1.0)]))
        peer_node.until(future.done)


def number(name: str, value: float) -> Parameter:
    return Parameter(name=name, value=ParameterValue(type=ParameterType.PARAMETER_DOUBLE, double_value=value))


def good_change(random: Generator) -> Parameter:
    """A gain within a tenth of what it is."""
    return number("k_g", float(random.uniform(0.9, 1.1)))


def bad_change(random: Generator) -> Parameter:
    """Out of range, not finite, read-only, unknown, or of another type."""
    text = ParameterValue(type=ParameterType.PARAMETER_STRING, string_value="much")
    short = ParameterValue(type=ParameterType.PARAMETER_DOUBLE_ARRAY, double_array_value=[1.0])
    changes = (
        number("k_g", -1.0),
        number("k_g", math.nan),
        number("k_g", math.inf),
        number("rate", 200.0),
        number("k_gg", 1.0),
        Parameter(name="k_g", value=text),
        Parameter(name="beta", value=short),
    )
    return changes[random.integers(len(changes))]


# The table

HELD = SILENCE + 0.005  # s, and a tick, until the aircraft logs the timeout of u
STALE = MAX_AGE + 0.01  # s, and a tick, until the controller holds u

CASES = (
    Case("aircraft killed", kill("aircraft"), enters(Mode.HOLD), STALE, Does.LETS_GO, BACK),
    Case("reference model killed", kill("reference_model"), enters(Mode.HOLD), STALE, Does.LETS_GO, BACK),
    Case("controller killed", kill("controller"), says("aircraft", "failsafe: u from"), HELD, Does.IS_LET_GO, BACK),
    Case("recorder killed", kill("recorder"), None, 0.0, Does.FLIES, 0.0),
    Case("aircraft stopped", stop("aircraft"), enters(Mode.HOLD), STALE, Does.LETS_GO, 0.0),
    Case("reference model stopped", stop("reference_model"), enters(Mode.HOLD), STALE, Does.LETS_GO, 0.0),
    Case("controller stopped", stop("controller"), says("aircraft", "failsafe: u from"), HELD, Does.IS_LET_GO, 0.0),
    Case("recorder stopped", stop("recorder"), None, 0.0, Does.FLIES, 0.0),
    *(Case(f"storm on {topic}", storm(topic), intrudes(topic, "foreign"), 0.0, Does.FLIES, 0.0) for topic in NAMES),
    *(
        Case(f"{kind} on {topic}", malformed(topic, kind), refuses(topic, BAD[kind][2]), 0.0, Does.FLIES, 0.0)
        for topic in NAMES
        for kind in BAD
    ),
    Case("second controller", second("controller", "u"), intrudes("u", "controller"), 0.0, Does.FLIES, 0.0),
    Case("second aircraft", second("aircraft", "y"), intrudes("y", "aircraft"), 0.0, Does.FLIES, 0.0),
    Case("weaker quality of service", weak_publisher, WEAK, REPORT + FOUND, Does.FLIES, 0.0),
    Case("stronger quality of service", demanding_listener, DEMANDING, REPORT + FOUND, Does.FLIES, 0.0),
    Case("CPU starved", starve, grows("aircraft", "missed ticks"), REPORT + 3.0, Does.LATE, 0.5),
    Case("disk full", full_disk, says("recorder", "recording ended"), 0.1, Does.FLIES, 0.0),
    Case("storm of parameters", parameters, says("controller", "parameters rejected"), 0.0, Does.FLIES, 0.0),
    Case(
        "clock set back",
        step_of_clock(-5.0),
        says("controller", "clock was set by -5"),
        REPORT,
        Does.FLIES,
        0.0,
        own_flight=True,
    ),
    Case(
        "clock set forth",
        step_of_clock(5.0),
        says("controller", r"clock was set by \+5"),
        REPORT,
        Does.FLIES,
        0.0,
        own_flight=True,
    ),
)
