# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Speed of the stack, each figure compared with a baseline: the least program that does the same on this host in one run.

    python -m benchmarks.speed [--only node] [--seconds 10] [--json FILE]

Ratios carry over to other hosts, the figures do not. Neither is valid on a host that is busy with other work.
The baselines (`floor`): one NumPy operation, a subscription of rclpy whose callback publishes the message again (an echo), an
empty timer of rclpy, a loop that only sleeps, a node of rclpy that only spins, the writer of rosbags.
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
from benchmarks.host_delays import Intervals, missed_excluding_delays
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
FLOOR_SECONDS = 15.0  # longest measurement of a baseline
NODE_RATE = 500.0  # Hz, at which callbacks are timed
WARM_UP = 1.0  # s, excluded from the measurement of a process
MATCHED_WITHIN = 20.0  # s
ENDS_WITHIN = 10.0  # s
OWN_MISSES = "missed excluding host delays"  # a column


@dataclass(frozen=True)
class Goal:
    """The maximum of a figure, or of its ratio to the baseline."""

    column: str
    at_most: float
    of_floor: bool = False


@dataclass(frozen=True)
class Row:
    """A row of a table: figures by column."""

    group: str
    what: str
    figures: Mapping[str, float]
    floor: str = ""  # `what` of the row of its baseline; its own for a baseline, empty without one
    goals: Sequence[Goal] = field(default=())


def us(values: Sequence[float] | FloatArray) -> dict[str, float]:
    """Percentiles of times in ns as columns in us."""
    low, high = np.percentile(np.asarray(values) / 1e3, (50, 99))
    return {"p50 (us)": float(low), "p99 (us)": float(high), "max (us)": float(np.max(values)) / 1e3}


class Child:
    """A role of benchmarks/speed_nodes.py, or a module (with a dot in its name), as a process; a context manager."""

    def __init__(self, role: str, *arguments: str, within: Sequence[str] = ()) -> None:
        self.begin = time.monotonic()
        module = (role,) if "." in role else ("benchmarks.speed_nodes", role)
        self.popen = psutil.Popen(
            [*within, sys.executable, "-m", *module, *arguments],
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            text=True,
        )

    def __enter__(self) -> "Child":
        return self

    def __exit__(self, *_: object) -> None:
        if self.popen.poll() is None:
            self.popen.terminate()  # a killed peer remains in the graph for two more seconds
        try:
            self.popen.communicate(timeout=ENDS_WITHIN)
        except subprocess.TimeoutExpired:
            self.popen.kill()
            self.popen.communicate()

    def cpu_ns(self) -> int:
        """Processor time of its running threads, ns."""
        return threads_ns(self.popen.pid)

    def figures(self, timeout: float = 20.0) -> dict[str, Any]:
        """Wait for its end and return its JSON output. Raises RuntimeError without any."""
        output, _ = self.popen.communicate(timeout=timeout)
        lines = [line for line in output.splitlines() if line.startswith("{")]
        if not lines:
            raise RuntimeError(f"{' '.join(self.popen.args)} ended with status {self.popen.returncode} and without output")
        figures: dict[str, Any] = json.loads(lines[-1])
        return figures

    def stop(self) -> dict[str, Any]:
        """Send SIGTERM and return its JSON output."""
        self.popen.terminate()
        return self.figures()


def threads_ns(pid: int) -> int:
    """Processor time of the threads of a process, ns, from the kernel's schedstat: psutil resolves 10 ms only."""
    total = 0
    for task in Path(f"/proc/{pid}/task").iterdir():
        with contextlib.suppress(FileNotFoundError):
            total += int((task / "schedstat").read_text(encoding="ascii").split()[0])
    return total


class Peer:
    """Publishes y and y_m at a rate as aircraft and reference model do, and receives u and internals; a context manager."""

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
        """Publish to a process for `seconds` after its first answer and WARM_UP. Raises RuntimeError without an answer."""
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
                if (stamp_ns := stamp_of(received.message)) >= since_ns:  # else it answers an earlier process
                    first_u = first_u or received.received_ns / NANOSECONDS
                    driven.received[stamp_ns] = received.received_ns
            for received in self._internals.take():
                sample = self._decoder.decode(received.message)
                if sample is not None:
                    driven.age[sample.stamp_ns], driven.late[sample.stamp_ns] = sample.value.tolist()
            if not first and driven.received and time.time() > first_u + WARM_UP:
                first = time.monotonic() - WARM_UP
                driven.clear()
                driven.start, cpu_ns, cpu_at = first_u, child.cpu_ns(), time.monotonic()
            if not driven.received and not first and time.monotonic() > begin + MATCHED_WITHIN:
                raise RuntimeError(f"no answer within {MATCHED_WITHIN:g} s")
        driven.cpu = (child.cpu_ns() - cpu_ns) / 1e9 / (time.monotonic() - cpu_at)
        driven.seconds = time.monotonic() - cpu_at
        return driven


class Driven:
    """Answers of a process, by stamp of the y."""

    def __init__(self) -> None:
        self.received: dict[int, int] = {}  # when u was received, ns
        self.age: dict[int, float] = {}  # of y at the tick, s
        self.late: dict[int, float] = {}  # lateness of the tick, s
        self.cpu = 0.0  # share of one core
        self.seconds = 0.0
        self.start = 0.0  # system time of the first u, s

    def clear(self) -> None:
        """Discard the answers so far."""
        for one in (self.received, self.age, self.late):
            one.clear()

    @property
    def round_trips(self) -> list[int]:
        """From y sent to u received, ns."""
        return [at - stamp for stamp, at in self.received.items()]

    @property
    def answers(self) -> list[float]:
        """From the beginning of the tick to u received, ns."""
        return [at - stamp - 1e9 * self.age[stamp] for stamp, at in self.received.items() if stamp in self.age]

    @property
    def cpu_each(self) -> float:
        """Processor time of the process for each answer, us."""
        return 1e6 * self.cpu * self.seconds / max(len(self.received), 1)


@contextlib.contextmanager
def controller_at(hz: float, folder: Path, role: str = "controller") -> Iterator[Child]:
    """The process of the controller at a rate."""
    file = folder / f"at_{hz:g}_hz.yaml"
    others = {"rate": max(hz, 500.0)}  # at least as fast as the controller, as a scenario demands; they do not run here
    rates = {"aircraft": others | {"step": 0.001}, "reference_model": others, "controller": {"rate": hz}}
    file.write_text(scenario_yaml(find_scenario(SCENARIO).vary(**rates)), encoding="utf-8")
    with Child(role, "--ros-args", "--params-file", str(file)) as child:
        yield child


def law_rows() -> Iterator[Row]:
    """One step of the law, one inside its limits, one whole tick."""
    for name, (median, high, most) in law.measure().items():
        yield Row("law", name, {"p50 (us)": median, "p99.9 (us)": high, "max (us)": most}, law.FLOOR)


def node_rows(seconds: float, folder: Path) -> Iterator[Row]:
    """The controller's tick and an echo's callback, from a y that has arrived to the message published."""
    length = min(seconds, 4.0)
    took: dict[str, list[dict[str, float]]] = {}
    with Peer() as peer:
        for _ in range(3):  # alternating, since the speed of the host drifts
            for executor in EXECUTORS:
                with Child("timed_echo", "--executor", executor, "--hz", f"{NODE_RATE}") as child:
                    peer.drive(NODE_RATE, length, child)
                    took.setdefault(f"bare echo, {executor}", []).append(child.stop())
            with controller_at(NODE_RATE, folder) as child:
                peer.drive(NODE_RATE, length, child)
                figures = child.stop()
            took.setdefault("controller, until u is published", []).append(figures)
            whole = {name: figures[f"whole {name}"] for name in ("p50", "p99")}
            took.setdefault("controller, whole tick with internals", []).append(whole)
    for name, runs in took.items():
        figures = {f"{column} (us)": float(np.median([run[column] for run in runs])) for column in ("p50", "p99")}
        goals = () if name.startswith("bare") else (Goal("p50 (us)", 2.0, of_floor=True),)
        yield Row("node", name, figures, "bare echo, single", goals)


def latency_rows(seconds: float, folder: Path) -> Iterator[Row]:
    """From y sent to u received, over DDS, and the processor time for each answer."""
    with Peer() as peer:
        for hz in RATES:
            floor = f"bare echo, single, {hz} Hz"
            for executor in EXECUTORS:
                with Child("echo", "--executor", executor) as child:
                    driven = peer.drive(hz, min(seconds, FLOOR_SECONDS), child)
                yield Row("latency", f"bare echo, {executor}, {hz} Hz", _latency(driven, driven.round_trips), floor)
            with controller_at(hz, folder) as child:
                driven = peer.drive(hz, seconds, child)
            goals = (Goal("CPU (us each)", 2.0, of_floor=True),)
            yield Row("latency", f"controller, tick to u, {hz} Hz", _latency(driven, driven.answers), floor, goals)
            yield Row("latency", f"controller, y to u with the wait for the tick, {hz} Hz", us(driven.round_trips), floor)
            yield Row(
                "latency",
                f"controller, lateness of the tick, {hz} Hz",
                us([1e9 * late for late in driven.late.values()]),
            )


def _latency(driven: Driven, values: Sequence[float]) -> dict[str, float]:
    return us(values) | {"CPU (us each)": driven.cpu_each}


def tick_rows(seconds: float) -> Iterator[Row]:
    """Lateness of the ticks of an empty node of the stack, compared with rclpy's own timers."""
    short = min(seconds, FLOOR_SECONDS)
    chrt = shutil.which("chrt")
    if chrt is not None and subprocess.run([chrt, "-f", str(PRIORITY), "true"], check=False).returncode:  # noqa: S603
        chrt = None  # no right to real-time priority here
    for hz in RATES:
        options = ("--hz", str(hz), "--seconds")
        floor = f"empty timer, single, {hz} Hz"
        for executor in EXECUTORS:
            with Child("timer", *options, str(short), "--executor", executor) as child:
                yield Row("ticks", f"empty timer, {executor}, {hz} Hz", *_ticks(child, short), floor)
        with Child("bare_loop", *options, str(short)) as child:
            yield Row("ticks", f"loop that only sleeps, {hz} Hz", *_ticks(child, short), floor)
        goals = {500: [Goal(OWN_MISSES if chrt else "missed", 0)], 1000: [Goal("p99 (us)", 100.0)]}.get(hz, [])
        with delay_monitors(chrt is not None) as delays, Child("ticker", *options, str(seconds)) as child:
            figures = _ticks(child, seconds, delays)
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
def delay_monitors(allowed: bool) -> Iterator[Callable[[], Intervals] | None]:
    """Host delays, measured by a process of the highest priority on each core; None if not allowed."""
    if not allowed:
        yield None
        return
    with contextlib.ExitStack() as stack:
        monitors = [
            stack.enter_context(Child("delay_monitor", "--core", str(core))) for core in sorted(os.sched_getaffinity(0))
        ]
        yield lambda: [tuple(one) for child in monitors for one in child.stop()["delays"]]


def _ticks(child: Child, seconds: float, delays: Callable[[], Intervals] | None = None) -> tuple[dict[str, float]]:
    time.sleep(seconds / 2.0)
    cpu_ns, at = child.cpu_ns(), time.monotonic()
    time.sleep(seconds / 2.0)  # it started later, so it still runs
    share = (child.cpu_ns() - cpu_ns) / 1e9 / (time.monotonic() - at)
    output = child.figures(timeout=seconds + 20.0)
    figures = {f"{name} (us)": output[name] for name in ("p50", "p99", "max")}
    figures |= {"missed": output["missed"]}
    if delays is not None:
        figures[OWN_MISSES] = missed_excluding_delays(output["skipped"], delays(), output["period_ns"])
    return (figures | {"ticks": output["ticks"], "CPU (%)": 100.0 * share},)


@contextlib.contextmanager
def full_load() -> Iterator[None]:
    """Every core busy with other work at ordinary priority."""
    # Also where this program runs at real-time priority: else they would block the host.
    spin = "import os\nos.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))\nwhile True: pass"
    busy = [subprocess.Popen([sys.executable, "-c", spin]) for _ in range(os.cpu_count() or 1)]  # noqa: S603
    try:
        yield
    finally:
        for one in busy:
            one.kill()
            one.wait()


def flight_rows(seconds: float, folder: Path) -> Iterator[Row]:
    """CPU and memory of each process of a flight in real time."""
    scenario = find_scenario(SCENARIO).vary(flight={"duration": seconds})
    run = folder / "flight"
    run.mkdir()
    with Child("idle") as child:
        time.sleep(WARM_UP + 1.0)
        yield Row("flight", "node that only spins", _use([child.popen.pid], 3.0)[0], "node that only spins")
    path = folder / "scenario.yaml"
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
    elapsed = time.monotonic() - begin
    shares = [(threads_ns(pid) - was) / 1e9 / elapsed for pid, was in zip(pids, before, strict=True)]
    memory = [psutil.Process(pid).memory_full_info() for pid in pids]
    return [
        {"CPU (%)": 100.0 * share, "resident (MB)": of.rss / 1e6, "unique (MB)": of.uss / 1e6}
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
            with controller_at(100.0, folder, CONTROLLER.module) as child:
                waits.append(peer.drive(100.0, 0.1, child).start - begin)
        yield Row("start", "controller, to its first u", {"seconds": float(np.median(waits))}, floor)
    yield Row("start", "rise-di fly, to its first u", {"seconds": seconds_to_first_u()}, floor)


def seconds_to_first_u() -> float:
    """From the start of the command to the first u of its flight, s."""
    context = Context()
    rclpy.init(context=context)
    node = Node("subscriber", context=context)
    subscription = PolledSubscription(node, U, RECORD, raw=True)
    with tempfile.TemporaryDirectory() as runs:
        begin = time.time()
        command = [str(Path(sys.executable).parent / "rise-di"), "fly", SCENARIO, "--duration", "30", "--runs", runs]
        flight = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)  # noqa: S603 - this stack
        try:
            while not (received := subscription.take()) and flight.poll() is None:
                time.sleep(0.005)
        finally:
            flight.send_signal(signal.SIGINT)
            _, output = flight.communicate()
    node.destroy_node()
    context.try_shutdown()
    if not received:
        raise RuntimeError(f"rise-di fly ended before its first u: {output.strip().splitlines()[-1:]}")
    return received[0].received_ns / NANOSECONDS - begin


def lockstep_rows(seconds: float, folder: Path) -> Iterator[Row]:
    """Steps a second of lockstep flights, over topics and without them."""
    scenario = lockstep.scenario_at_controller_rate(folder, max(seconds, 10.0))
    runs = iter(range(9))
    measured: dict[str, Callable[[], float]] = {
        "bare echo, to another process and back": lockstep.echo_steps_per_second,
        "lockstep, four processes": lambda: lockstep.flight_steps_per_second(
            scenario, folder / f"four {next(runs)}", one_process=False
        ),
        "lockstep, one process": lambda: lockstep.flight_steps_per_second(
            scenario, folder / f"one {next(runs)}", one_process=True
        ),
        "one loop without ROS": lambda: lockstep.loop_steps_per_second(scenario),
    }
    rates: dict[str, list[float]] = {}
    for _ in range(3):
        for name, measure in measured.items():
            rates.setdefault(name, []).append(measure())
    floor = next(iter(measured))
    for name, speeds in rates.items():
        speed = float(np.median(speeds))
        real_time = {} if name == floor else {"times real time": speed / scenario.controller.rate}
        yield Row("lockstep", name, {"steps/s": speed} | real_time, floor)


def recorder_rows(seconds: float, folder: Path) -> Iterator[Row]:
    """CPU time, losses and size of the recorder at 1 kHz on six topics, compared with rosbags' writer fed from memory."""
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
    """Flights of uncertain aircraft a second, many at once, compared with one after the other in the loop."""
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
    """Print the rows of a group, each figure with its ratio to the baseline."""
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
    parser.add_argument("--only", choices=GROUPS, help="measure only this group")
    parser.add_argument("--seconds", type=float, default=10.0, help="how long each figure of a running process is measured")
    parser.add_argument("--json", type=Path, help="file to write the figures to")
    options = parser.parse_args()
    # its own domain, among those whose ports are outside Linux's ephemeral range
    os.environ.setdefault("ROS_DOMAIN_ID", str(1 + os.getpid() % 100))
    os.environ.update(transport.environment())
    console = Console(width=None if sys.stdout.isatty() else 160)
    measured: list[Row] = []
    for name in [options.only] if options.only else GROUPS:
        with tempfile.TemporaryDirectory() as folder:
            rows = list(GROUPS[name](options.seconds, Path(folder)))
        show(console, name, rows)
        measured += rows
    if options.json is not None:
        as_json: list[dict[str, Any]] = [asdict(row) for row in measured]
        options.json.write_text(json.dumps({"seconds": options.seconds, "rows": as_json}, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
