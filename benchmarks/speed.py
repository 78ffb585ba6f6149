# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""How fast the stack is, each figure beside its floor: the least that does the same on the same machine, in the same run.

    python -m benchmarks.speed [--only node] [--seconds 10] [--json FILE]

Ratios travel from machine to machine, the figures do not; and neither holds on a machine that is busy with other work.
The floors: one NumPy operation, a subscription of rclpy whose callback publishes what it got (an echo), an empty timer of
rclpy, a loop that only sleeps, a node of rclpy that only spins, the writer of rosbags.
"""

import argparse
import contextlib
import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import rclpy
from benchmarks import campaign, law, lockstep, recorder
from benchmarks.held import Intervals, missed_by_itself
from benchmarks.sampling import new_table
from rclpy.context import Context
from rclpy.node import Node
from rich.console import Console
from rosbags.highlevel import AnyReader
from rosbags.rosbag2 import StoragePlugin, Writer

from flight_analysis.closed_loop.scenario import scenario_yaml
from flight_bringup.clients import FlightMonitor
from flight_bringup.graph import CONTROLLER
from flight_bringup.processes import FlightProcesses
from flight_bringup.scenarios import find_scenario
from flight_core.rates import NANOSECONDS, period_ns
from flight_core.vectors import FloatArray
from flight_ros import transport
from flight_ros.messages import Decoder, Encoder, stamp_of
from flight_ros.subscriptions import PolledSubscription
from flight_ros.ticker import Ticker
from flight_ros.topics import INTERNALS, PUBLISH, RECORD, Y_M, U, Y

SCENARIO = "osprey_gust"
RATES = (100, 500, 1000)  # Hz
EXECUTORS = ("single", "multi", "events")
PRIORITY = 50  # SCHED_FIFO, as that of ros2_control
FLOOR_SECONDS = 15.0  # floors are measured no longer than this
NODE_RATE = 500.0  # Hz, at which the callback of a node is timed
WARM_UP = 1.0  # s, left out of what is measured of a process
MATCHED_WITHIN = 20.0  # s
ENDS_WITHIN = 10.0  # s
BY_ITSELF = "by itself"  # column: ticks missed while the machine ran


@dataclass(frozen=True)
class Goal:
    """What a figure is to be at most, itself or as a multiple of the floor's."""

    column: str
    at_most: float
    of_floor: bool = False


@dataclass(frozen=True)
class Row:
    """Figures of one thing, by column."""

    group: str
    what: str
    figures: Mapping[str, float]
    floor: str = ""  # `what` of the row that it is measured beside; that row's own where it is a floor, empty without one
    goals: Sequence[Goal] = field(default=())


def us(values: Sequence[float] | FloatArray) -> dict[str, float]:
    """Percentiles of times in ns as columns in us."""
    low, high = np.percentile(np.asarray(values) / 1e3, (50, 99))
    return {"p50 (us)": float(low), "p99 (us)": float(high), "max (us)": float(np.max(values)) / 1e3}


class Child:
    """One of benchmarks/speed_nodes.py, or a module with a point in its name, as a process. A context manager that ends it."""

    def __init__(self, role: str, *arguments: str, within: Sequence[str] = ()) -> None:
        self.begin = time.monotonic()
        words = (role,) if "." in role else ("benchmarks.speed_nodes", role)
        self.popen = psutil.Popen(
            [*within, sys.executable, "-m", *words, *arguments],
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            text=True,
        )

    def __enter__(self) -> "Child":
        return self

    def __exit__(self, *_: object) -> None:
        if self.popen.poll() is None:
            self.popen.terminate()  # one that is killed seems to be there for two more seconds
        try:
            self.popen.communicate(timeout=ENDS_WITHIN)
        except subprocess.TimeoutExpired:
            self.popen.kill()
            self.popen.communicate()

    def cpu_ns(self) -> int:
        """Time that its threads have run, those that have ended left out, ns."""
        return threads_ns(self.popen.pid)

    def figures(self, timeout: float = 20.0) -> dict[str, Any]:
        """Wait for its end, and what it says. Raises RuntimeError where that is nothing."""
        said, _ = self.popen.communicate(timeout=timeout)
        lines = [line for line in said.splitlines() if line.startswith("{")]
        if not lines:
            raise RuntimeError(f"{' '.join(self.popen.args)} ended with status {self.popen.returncode} and said nothing")
        found: dict[str, Any] = json.loads(lines[-1])
        return found

    def stop(self) -> dict[str, Any]:
        """Tell it to end, and what it says then."""
        self.popen.terminate()
        return self.figures()


def threads_ns(pid: int) -> int:
    """Time that the threads of a process have run, ns, from the scheduler's own books: psutil has hundredths of a second."""
    total = 0
    for task in Path(f"/proc/{pid}/task").iterdir():
        with contextlib.suppress(FileNotFoundError):
            total += int((task / "schedstat").read_text(encoding="ascii").split()[0])
    return total


class Peer:
    """Publishes y and y_m at a rate as aircraft and reference model do, and hears u and internals. A context manager."""

    def __init__(self) -> None:
        transport.prepare()
        self._context = Context()
        rclpy.init(context=self._context)
        self._node = Node("peer", context=self._context)
        outputs = find_scenario(SCENARIO).controller.outputs
        self._y, self._y_m = (self._node.create_publisher(one.type, one.name, PUBLISH) for one in (Y, Y_M))
        self._y_encoder, self._y_m_encoder = (Encoder(outputs, f"/peer/{name}") for name in ("y", "y_m"))
        self._u = PolledSubscription(self._node, U, RECORD, raw=True)
        self._internals = PolledSubscription(self._node, INTERNALS, RECORD, raw=True)
        self._decoder = Decoder(("age", "late"))
        self._values = np.random.default_rng(1).normal(size=(1000, len(outputs))) * 1e-3

    def __enter__(self) -> "Peer":
        return self

    def __exit__(self, *_: object) -> None:
        self._node.destroy_node()
        self._context.try_shutdown()

    def drive(self, hz: float, seconds: float, child: Child) -> "Driven":
        """Drive a process for so long, from its first answer and a while for it to warm up on.

        Raises RuntimeError where none comes.
        """
        ticker, k, begin = Ticker(period_ns(hz, "hz"), time.monotonic_ns()), 0, time.monotonic()
        first, first_u, since_ns = 0.0, 0.0, time.time_ns()
        driven = Driven()
        zero = np.zeros(self._values.shape[1])
        while not first or time.monotonic() < first + WARM_UP + seconds:
            if (pause := ticker.remaining()) > 0:
                time.sleep(pause)
            if ticker.due() is None:
                continue
            now_ns = time.time_ns()
            self._y_m.publish(self._y_m_encoder.encode(now_ns, zero))
            self._y.publish(self._y_encoder.encode(now_ns, self._values[k % len(self._values)]))
            k += 1
            for received in self._u.take():
                if (stamp_ns := stamp_of(received.message)) >= since_ns:  # else of the process before
                    first_u = first_u or received.received_ns / NANOSECONDS
                    driven.heard[stamp_ns] = received.received_ns
            for received in self._internals.take():
                sample = self._decoder.decode(received.message)
                if sample is not None:
                    driven.age[sample.stamp_ns], driven.late[sample.stamp_ns] = sample.value.tolist()
            if not first and driven.heard and time.time() > first_u + WARM_UP:
                first = time.monotonic() - WARM_UP
                driven.clear()
                driven.start, cpu_ns, cpu_at = first_u, child.cpu_ns(), time.monotonic()
            if not driven.heard and not first and time.monotonic() > begin + MATCHED_WITHIN:
                raise RuntimeError(f"no answer within {MATCHED_WITHIN:g} s")
        driven.cpu = (child.cpu_ns() - cpu_ns) / 1e9 / (time.monotonic() - cpu_at)
        driven.seconds = time.monotonic() - cpu_at
        return driven


class Driven:
    """What came of driving a process; by stamp of the y."""

    def __init__(self) -> None:
        self.heard: dict[int, int] = {}  # when u had come, ns
        self.age: dict[int, float] = {}  # of y at the tick, s
        self.late: dict[int, float] = {}  # the tick, s
        self.cpu = 0.0  # share of one core
        self.seconds = 0.0
        self.start = 0.0  # system time of the first u, s

    def clear(self) -> None:
        """Forget what was so far."""
        for one in (self.heard, self.age, self.late):
            one.clear()

    @property
    def round_trips(self) -> list[int]:
        """From y sent to u there, ns."""
        return [at - stamp for stamp, at in self.heard.items()]

    @property
    def answers(self) -> list[float]:
        """From the tick's beginning to u there, ns."""
        return [at - stamp - 1e9 * self.age[stamp] for stamp, at in self.heard.items() if stamp in self.age]

    @property
    def cpu_each(self) -> float:
        """Processor time of the whole process an answer, us."""
        return 1e6 * self.cpu * self.seconds / max(len(self.heard), 1)


@contextlib.contextmanager
def flown(hz: float, folder: Path, role: str = "controller") -> Iterator[Child]:
    """The controller's node at a rate."""
    file = folder / f"at_{hz:g}_hz.yaml"
    others = {"rate": max(hz, 500.0)}  # at least as fast as the controller, as a scenario demands; they do not fly here
    rates = {"aircraft": others | {"step": 0.001}, "reference_model": others, "controller": {"rate": hz}}
    file.write_text(scenario_yaml(find_scenario(SCENARIO).vary(**rates)), encoding="utf-8")
    with Child(role, "--ros-args", "--params-file", str(file)) as child:
        yield child


def law_rows() -> Iterator[Row]:
    """One step of the law, one inside its limits, one whole tick."""
    for name, (median, high, most) in law.measure().items():
        yield Row("law", name, {"p50 (us)": median, "p99.9 (us)": high, "max (us)": most}, law.FLOOR)


def node_rows(seconds: float, folder: Path) -> Iterator[Row]:
    """The controller's tick and an echo's callback, both from a y that is there to it published."""
    length = min(seconds, 4.0)
    took: dict[str, list[dict[str, float]]] = {}
    with Peer() as peer:
        for _ in range(3):  # in turn, for the machine's speed drifts
            for executor in EXECUTORS:
                with Child("timed_echo", "--executor", executor, "--hz", f"{NODE_RATE}") as child:
                    peer.drive(NODE_RATE, length, child)
                    took.setdefault(f"bare echo, {executor}", []).append(child.stop())
            with flown(NODE_RATE, folder) as child:
                peer.drive(NODE_RATE, length, child)
                found = child.stop()
            took.setdefault("controller, to u published", []).append(found)
            whole = {name: found[f"whole {name}"] for name in ("p50", "p99")}
            took.setdefault("controller, whole tick with internals", []).append(whole)
    for name, runs in took.items():
        figures = {f"{column} (us)": float(np.median([run[column] for run in runs])) for column in ("p50", "p99")}
        goals = () if name.startswith("bare") else (Goal("p50 (us)", 2.0, of_floor=True),)
        yield Row("node", name, figures, "bare echo, single", goals)


def latency_rows(seconds: float, folder: Path) -> Iterator[Row]:
    """From y sent to u there, over DDS, and what each answer costs the process that gives it."""
    with Peer() as peer:
        for hz in RATES:
            floor = f"bare echo, single, {hz} Hz"
            for executor in EXECUTORS:
                with Child("echo", "--executor", executor) as child:
                    driven = peer.drive(hz, min(seconds, FLOOR_SECONDS), child)
                yield Row("latency", f"bare echo, {executor}, {hz} Hz", _latency(driven, driven.round_trips), floor)
            with flown(hz, folder) as child:
                driven = peer.drive(hz, seconds, child)
            goals = (Goal("CPU (us each)", 2.0, of_floor=True),)
            yield Row("latency", f"controller, tick to u, {hz} Hz", _latency(driven, driven.answers), floor, goals)
            yield Row("latency", f"controller, y to u with the wait for the tick, {hz} Hz", us(driven.round_trips), floor)
            yield Row(
                "latency",
                f"controller, its tick after the deadline, {hz} Hz",
                us([1e9 * late for late in driven.late.values()]),
            )


def _latency(driven: Driven, values: Sequence[float]) -> dict[str, float]:
    return us(values) | {"CPU (us each)": driven.cpu_each}


def tick_rows(seconds: float) -> Iterator[Row]:
    """How late ticks begin, of a node of the stack that does nothing in them, beside rclpy's own timers."""
    short = min(seconds, FLOOR_SECONDS)
    chrt = shutil.which("chrt")
    if chrt is not None and subprocess.run([chrt, "-f", str(PRIORITY), "true"], check=False).returncode:  # noqa: S603
        chrt = None  # no right to real-time priority here
    for hz in RATES:
        told = ("--hz", str(hz), "--seconds")
        floor = f"empty timer, single, {hz} Hz"
        for executor in EXECUTORS:
            with Child("timer", *told, str(short), "--executor", executor) as child:
                yield Row("ticks", f"empty timer, {executor}, {hz} Hz", *_ticks(child, short), floor)
        with Child("bare_loop", *told, str(short)) as child:
            yield Row("ticks", f"loop that only sleeps, {hz} Hz", *_ticks(child, short), floor)
        goals = {500: [Goal(BY_ITSELF if chrt else "missed", 0)], 1000: [Goal("p99 (us)", 100.0)]}.get(hz, [])
        with sentinels(chrt is not None) as held, Child("ticker", *told, str(seconds)) as child:
            figures = _ticks(child, seconds, held)
        yield Row("ticks", f"the stack's loop, {hz} Hz", *figures, floor, goals)
    if chrt is None:
        return
    within = (chrt, "-f", str(PRIORITY))
    with full_load():
        for name, role in (("empty timer, single", "timer"), ("the stack's loop", "ticker")):
            length = short if role == "timer" else seconds
            with Child(role, "--hz", "100", "--seconds", str(length), within=within) as child:
                goals = [Goal("p99 (us)", 50.0)] if role == "ticker" else []
                what, floor = (f"{one}, 100 Hz, FIFO {PRIORITY}, full load" for one in (name, "empty timer, single"))
                yield Row("ticks", what, *_ticks(child, length), floor, goals)


@contextlib.contextmanager
def sentinels(allowed: bool) -> Iterator[Callable[[], Intervals] | None]:
    """When the machine was held back, by a process on each core that goes before all others; None if not allowed."""
    if not allowed:
        yield None
        return
    with contextlib.ExitStack() as stack:
        watching = [stack.enter_context(Child("sentinel", "--core", str(core))) for core in sorted(os.sched_getaffinity(0))]
        yield lambda: [tuple(one) for child in watching for one in child.stop()["held"]]


def _ticks(child: Child, seconds: float, held: Callable[[], Intervals] | None = None) -> tuple[dict[str, float]]:
    time.sleep(seconds / 2.0)
    cpu_ns, at = child.cpu_ns(), time.monotonic()
    time.sleep(seconds / 2.0)  # and then, having started later, it still runs
    share = (child.cpu_ns() - cpu_ns) / 1e9 / (time.monotonic() - at)
    found = child.figures(timeout=seconds + 20.0)
    shown = {f"{name} (us)": found[name] for name in ("p50", "p99", "max")}
    shown |= {"missed": found["missed"]}
    if held is not None:
        shown[BY_ITSELF] = missed_by_itself(found["skipped"], held(), found["period_ns"])
    return (shown | {"ticks": found["ticks"], "CPU (%)": 100.0 * share},)


@contextlib.contextmanager
def full_load() -> Iterator[None]:
    """Every core busy with something else, at ordinary priority."""
    # At ordinary priority also where this program runs at a real-time one: they would take the machine.
    spin = "import os\nos.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))\nwhile True: pass"
    busy = [subprocess.Popen([sys.executable, "-c", spin]) for _ in range(os.cpu_count() or 1)]  # noqa: S603
    try:
        yield
    finally:
        for one in busy:
            one.kill()
            one.wait()


def flight_rows(seconds: float, folder: Path) -> Iterator[Row]:
    """Share of a core and memory of each process of a flight in real time."""
    scenario = find_scenario(SCENARIO).vary(flight={"duration": seconds})
    run = folder / "flight"
    run.mkdir()
    with Child("idle") as child:
        time.sleep(WARM_UP + 1.0)
        yield Row("flight", "node that only spins", _use([child.popen.pid], 3.0)[0], "node that only spins")
    path = folder / "flown.yaml"
    path.write_text(scenario_yaml(scenario), encoding="utf-8")
    scenario = find_scenario(str(path))
    with (
        FlightMonitor(scenario.controller.outputs, lockstep=True) as monitor,  # without a subscription to internals
        FlightProcesses(scenario, run, monitor, lockstep=False, one_process=False) as flight,
    ):
        time.sleep(max(flight.start_time - time.time(), 0.0) + WARM_UP)
        processes = flight.processes
        for process, figures in zip(processes, _use([one.popen.pid for one in processes], seconds), strict=True):
            yield Row("flight", process.node.executable, figures, "node that only spins")


def _use(pids: Sequence[int], seconds: float) -> list[dict[str, float]]:
    before, begin = [threads_ns(pid) for pid in pids], time.monotonic()
    time.sleep(seconds)
    lasted = time.monotonic() - begin
    shares = [(threads_ns(pid) - was) / 1e9 / lasted for pid, was in zip(pids, before, strict=True)]
    memory = [psutil.Process(pid).memory_full_info() for pid in pids]
    return [
        {"CPU (%)": 100.0 * share, "resident (MB)": of.rss / 1e6, "its own (MB)": of.uss / 1e6}
        for share, of in zip(shares, memory, strict=True)
    ]


def start_rows(folder: Path) -> Iterator[Row]:
    """From the start of a process to its first u."""
    floor = "python, import rclpy, rclpy.init"
    begin = time.perf_counter()
    for _ in range(5):
        subprocess.run([sys.executable, "-c", "import rclpy; rclpy.init(); rclpy.shutdown()"], check=True)
    yield Row("start", floor, {"seconds": (time.perf_counter() - begin) / 5}, floor)
    with Peer() as peer:
        waits = []
        for _ in range(5):
            begin = time.time()
            with flown(100.0, folder, CONTROLLER.module) as child:
                waits.append(peer.drive(100.0, 0.1, child).start - begin)
        yield Row("start", "controller, to its first u", {"seconds": float(np.median(waits))}, floor)
    yield Row("start", "rise-di fly, to its first u", {"seconds": whole_flight()}, floor)


def whole_flight() -> float:
    """From the start of the command to the first u of its flight, s."""
    context = Context()
    rclpy.init(context=context)
    node = Node("listener", context=context)
    subscription = PolledSubscription(node, U, RECORD, raw=True)
    with tempfile.TemporaryDirectory() as runs:
        begin = time.time()
        command = [str(Path(sys.executable).parent / "rise-di"), "fly", SCENARIO, "--duration", "30", "--runs", runs]
        flight = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)  # noqa: S603 - this stack
        try:
            while not (came := subscription.take()) and flight.poll() is None:
                time.sleep(0.005)
        finally:
            flight.send_signal(signal.SIGINT)
            _, said = flight.communicate()
    node.destroy_node()
    context.try_shutdown()
    if not came:
        raise RuntimeError(f"rise-di fly ended before its first u: {said.strip().splitlines()[-1:]}")
    return came[0].received_ns / NANOSECONDS - begin


def lockstep_rows(seconds: float, folder: Path) -> Iterator[Row]:
    """Steps a second of a flight that waits for nobody, over topics and without them."""
    scenario = lockstep.at_the_rate_of_the_controller(folder, max(seconds, 10.0))
    runs = iter(range(9))
    measured: dict[str, Callable[[], float]] = {
        "bare echo, to another process and back": lockstep.echoed_steps_per_second,
        "lockstep, four processes": lambda: lockstep.flown_steps_per_second(
            scenario, folder / f"four {next(runs)}", one_process=False
        ),
        "lockstep, one process": lambda: lockstep.flown_steps_per_second(
            scenario, folder / f"one {next(runs)}", one_process=True
        ),
        "one loop without ROS": lambda: lockstep.looped_steps_per_second(scenario),
    }
    found: dict[str, list[float]] = {}
    for _ in range(3):
        for name, measure in measured.items():
            found.setdefault(name, []).append(measure())
    floor = next(iter(measured))
    for name, speeds in found.items():
        speed = float(np.median(speeds))
        real_time = {} if name == floor else {"times real time": speed / scenario.controller.rate}
        yield Row("lockstep", name, {"steps/s": speed} | real_time, floor)


def recorder_rows(seconds: float, folder: Path) -> Iterator[Row]:
    """What the recorder costs, loses and takes up at 1 kHz on six topics, beside rosbags' writer fed from memory."""
    run = folder / "recorded"
    sent, processor = recorder.record(run, 1000.0, seconds)
    names = {f"/{topic.name}" for topic in recorder.TOPICS}
    with AnyReader([run]) as reader:
        known = [one for one in reader.connections if one.topic in names]
        messages = [(one, stamp_ns, data) for one, stamp_ns, data in reader.messages(known)]
        size = sum(path.stat().st_size for path in run.glob("*.mcap"))
        floor = "rosbags' Writer, MCAP"
        bag = folder / "rosbags"
        begin_ns = time.process_time_ns()
        with Writer(bag, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
            made = {one.id: writer.add_connection(one.topic, one.msgtype, typestore=reader.typestore) for one in known}
            for one, stamp_ns, data in messages:
                writer.write(made[one.id], stamp_ns, data)
        took = (time.process_time_ns() - begin_ns) / 1e3
    count = len(messages)
    weight = sum(path.stat().st_size for path in bag.rglob("*.mcap"))
    yield Row("recorder", floor, {"CPU (us each)": took / count, "bytes each": weight / count}, floor)
    figures = {"CPU (us each)": 1e6 * processor / count, "bytes each": size / count, "lost": sent["sent"] - count}
    yield Row("recorder", "recorder, from topics to disk", figures, floor, (Goal("lost", 0),))


def campaign_rows(seconds: float) -> Iterator[Row]:
    """Flights of uncertain aircraft a second, many at once, beside one after the other in the loop."""
    scenario = find_scenario("osprey_servo")
    floor, workers = "one flight in the loop", psutil.cpu_count() or 1
    aircraft = 4000 if seconds >= 10.0 else 1000
    yield Row("campaign", floor, {"aircraft-s/s": max(campaign.alone(scenario)[0] for _ in range(2))}, floor)
    many = campaign.speed(scenario, aircraft, aircraft // (5 * workers), workers)
    what = f"campaign of {aircraft} aircraft, {workers} threads"
    yield Row("campaign", f"{what}, with compiling", {"aircraft-s/s": many.whole}, floor)
    yield Row("campaign", what, {"aircraft-s/s": many.flown}, floor)


Group = Callable[[float, Path], Iterator[Row]]
GROUPS: dict[str, Group] = {
    "law": lambda seconds, folder: law_rows(),
    "node": node_rows,
    "latency": latency_rows,
    "ticks": lambda seconds, folder: tick_rows(seconds),
    "flight": flight_rows,
    "start": lambda seconds, folder: start_rows(folder),
    "lockstep": lockstep_rows,
    "recorder": recorder_rows,
    "campaign": lambda seconds, folder: campaign_rows(seconds),
}


def show(console: Console, name: str, rows: Sequence[Row]) -> None:
    """Print the rows of a group, ratios to the floor beside each figure."""
    columns = list(dict.fromkeys(column for row in rows for column in row.figures))
    table = new_table(name, ("", *columns), texts=1)
    by_name = {row.what: row.figures for row in rows}
    for row in rows:
        floor = by_name.get(row.floor, {})
        cells = []
        for column in columns:
            if column not in row.figures:
                cells.append("")
                continue
            value, least = row.figures[column], floor.get(column)
            cells.append(f"{value:.4g}" + (f"  x{value / least:.3g}" if least else ""))
        table.add_row(row.what, *cells)
    console.print(table)


def main() -> None:
    """Measure, print, and write the figures to a file."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", choices=GROUPS, help="this group alone")
    parser.add_argument("--seconds", type=float, default=10.0, help="how long each figure of a running process is measured")
    parser.add_argument("--json", type=Path, help="file to write the figures to")
    asked = parser.parse_args()
    # a domain of its own, among those whose ports Linux gives to nobody else
    os.environ.setdefault("ROS_DOMAIN_ID", str(1 + os.getpid() % 100))
    os.environ.update(transport.environment())
    console = Console(width=None if sys.stdout.isatty() else 160)
    found: list[Row] = []
    for name in [asked.only] if asked.only else GROUPS:
        with tempfile.TemporaryDirectory() as folder:
            rows = list(GROUPS[name](asked.seconds, Path(folder)))
        show(console, name, rows)
        found += rows
    if asked.json is not None:
        plain: list[dict[str, Any]] = [asdict(row) for row in found]
        asked.json.write_text(json.dumps({"seconds": asked.seconds, "rows": plain}, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
