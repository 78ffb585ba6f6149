# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Measure the speed of the stack, with each figure compared with a baseline.

The baseline is the least program that does the same on this host in one run.

    python -m benchmarks.speed [--only node] [--seconds 10] [--json FILE]

Ratios carry over to other hosts, the figures do not. Neither is valid on a host that is busy with
other work. The baselines (`floor`) are one NumPy operation, a subscription of rclpy whose callback
publishes the message again (an echo), an empty timer of rclpy, a loop that only sleeps, a node of
rclpy that only spins, the writer of rosbags, a right message.
"""

import contextlib
import json
import os
import resource
import signal
import subprocess
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import psutil
from benchmarks import evidence, law, lockstep, receiver, recorder
from benchmarks.host_delays import Intervals, missed_excluding_delays
from benchmarks.nodes import open_node, ticks
from benchmarks.processes import PRIORITY, RISE_DI, Child, delay_monitors, real_time, threads_ns
from benchmarks.tables import new_table, parser_of
from rclpy.node import Node
from rich.console import Console
from rosbags.rosbag2 import CompressionMode

from flight_analysis.closed_loop.scenario_library import find_scenario, save_scenario
from flight_bringup.graph import CONTROLLER
from flight_bringup.monitor import FlightMonitor
from flight_bringup.processes import FlightProcesses
from flight_core.rates import NANOSECONDS
from flight_core.vectors import FloatArray
from flight_ros import transport
from flight_ros.messages import Decoder, Encoder, stamp_of
from flight_ros.subscriptions import PolledSubscription
from flight_ros.topics import INTERNALS, PUBLISH, RECORD, Y_M, U, Y

SCENARIO = "osprey_gust"
RATES = (100, 500, 1000)  # Hz
EXECUTORS = ("single", "multi", "events")
FLOOR_SECONDS = 15.0  # longest measurement of a baseline of the ticks
ROUNDS = 3  # in which nodes and their baselines alternate, since the speed of the host drifts
NODE_RATE = 500.0  # Hz, at which callbacks are timed
OBSERVER_RATE = 100.0  # Hz, of the matrices of the shipped observer
OBSERVED = {
    "osprey_servo": "controller, whole tick, 100 Hz, RISE-DI",
    "osprey_observer": "controller, whole tick, 100 Hz, RISE-DI with feedforward and observer",
}
WARM_UP = 1.0  # s, excluded from the measurement of a process
IMPORTS = 9  # processes of each kind
PROCESS, IMPORT = "processor time (ms)", "import (ms)"  # columns
MATCHED_WITHIN = 20.0  # s
OWN_MISSES = "missed excluding host delays"  # a column
WITHOUT_BASELINE = ("missed", OWN_MISSES, "lost", "ticks", "max (us)", "answered (%)")


@dataclass(frozen=True)
class Goal:
    """The maximum of a figure, or of its ratio to the baseline."""

    column: str
    at_most: float
    of_floor: bool = False


@dataclass(frozen=True)
class Row:
    """A row of a table."""

    what: str
    figures: Mapping[str, float]  # by column
    floor: str = ""  # `what` of the row of its baseline; a baseline names itself; "" without one
    goals: Sequence[Goal] = field(default=())


def us(values: Sequence[float] | FloatArray) -> dict[str, float]:
    """Return percentiles of times in ns as columns in us."""
    low, high = np.percentile(np.asarray(values) / 1e3, (50, 99))
    return {
        "p50 (us)": float(low),
        "p99 (us)": float(high),
        "max (us)": float(np.max(values)) / 1e3,
    }


class Peer:
    """A node that publishes y and y_m at a rate, as aircraft and reference model do.

    It receives u and internals.
    """

    def __init__(self, node: Node) -> None:
        outputs = find_scenario(SCENARIO).controller.outputs
        self._y, self._y_m = (
            node.create_publisher(topic.type, topic.name, PUBLISH) for topic in (Y, Y_M)
        )
        self._y_encoder, self._y_m_encoder = (
            Encoder(outputs, f"/peer/{name}") for name in ("y", "y_m")
        )
        self._u = PolledSubscription(node, U, RECORD, raw=True)
        self._internals = PolledSubscription(node, INTERNALS, RECORD, raw=True)
        self._decoder = Decoder(("age", "late"))
        self._values = np.random.default_rng(1).normal(size=(1000, len(outputs))) * 1e-3

    def drive(self, hz: float, seconds: float, child: Child) -> "Driven":
        """Publish to a process for `seconds` after its first answer and WARM_UP.

        Raises RuntimeError without an answer.
        """
        begin = time.monotonic()
        first = 0.0
        since_ns = time.time_ns()
        total = Driven()
        zero = np.zeros(self._values.shape[1])
        for tick in ticks(hz):
            if first and time.monotonic() >= first + WARM_UP + seconds:
                break
            now_ns = time.time_ns()
            self._y_m.publish(self._y_m_encoder.encode(now_ns, zero))
            self._y.publish(
                self._y_encoder.encode(now_ns, self._values[tick.number % len(self._values)])
            )
            total.sent += 1
            for received in self._u.take():
                # else of an earlier process, or warm-up
                if (stamp_ns := stamp_of(received.message)) >= since_ns:
                    total.start = total.start or received.received_ns / NANOSECONDS
                    total.received[stamp_ns] = received.received_ns
            for received in self._internals.take():
                sample = self._decoder.decode(received.message)
                if sample is not None:
                    total.age[sample.stamp_ns], total.late[sample.stamp_ns] = sample.value.tolist()
            if not first and total.received and time.time() > total.start + WARM_UP:
                first = time.monotonic() - WARM_UP
                total = Driven(total.start)
                cpu_ns = child.cpu_ns()
                since_ns = time.time_ns()
            if not total.received and not first and time.monotonic() > begin + MATCHED_WITHIN:
                raise RuntimeError(f"no answer within {MATCHED_WITHIN:g} s")
        total.cpu_ns = child.cpu_ns() - cpu_ns
        return total


@dataclass
class Driven:
    """How a process answers samples of y. The key of each table is the stamp of the y, ns."""

    start: float = 0.0  # system time of the first u, s
    sent: int = 0  # number of samples of y
    received: dict[int, int] = field(default_factory=dict)  # when u was received, ns
    age: dict[int, float] = field(default_factory=dict)  # age of y at the tick, s
    late: dict[int, float] = field(default_factory=dict)  # lateness of the tick, s
    cpu_ns: int = 0  # processor time of the process

    def __add__(self, other: "Driven") -> "Driven":
        """Join the answers of both; no stamp is in both of them."""
        return Driven(
            self.start or other.start,
            self.sent + other.sent,
            self.received | other.received,
            self.age | other.age,
            self.late | other.late,
            self.cpu_ns + other.cpu_ns,
        )

    @property
    def round_trips(self) -> list[int]:
        """The times from y sent to u received, ns."""
        return [at - stamp for stamp, at in self.received.items()]

    @property
    def answers(self) -> list[float]:
        """The times from the beginning of the tick to u received, ns."""
        return [
            at - stamp - 1e9 * self.age[stamp]
            for stamp, at in self.received.items()
            if stamp in self.age
        ]

    @property
    def cpu_each(self) -> float:
        """The processor time of the process for each answer, us."""
        return 1e-3 * self.cpu_ns / max(len(self.received), 1)


@contextlib.contextmanager
def controller_at(
    hz: float, folder: Path, role: str = "controller", scenario_name: str = SCENARIO
) -> Iterator[Child]:
    """Start the controller of a scenario at a rate as a process."""
    # at least as fast as the controller, as a scenario demands; they do not run here
    others = {"rate": max(hz, 500.0)}
    rates = {
        "aircraft": others | {"step": 0.001},
        "reference_model": others,
        "controller": {"rate": hz},
    }
    scenario = save_scenario(
        find_scenario(scenario_name).vary(**rates), folder / f"{scenario_name}_at_{hz:g}_hz.yaml"
    )
    with Child(role, "--ros-args", "--params-file", str(scenario.path)) as child:
        yield child


def law_rows() -> Iterator[Row]:
    """Measure one step of the law, one inside its limits, and one whole tick."""
    times = law.measure() | {"guard.tick of osprey_observer": law.measure_observer()}
    for name, (median, high, most) in times.items():
        yield Row(name, {"p50 (us)": median, "p99.9 (us)": high, "max (us)": most}, law.FLOOR)


def receiver_rows() -> Iterator[Row]:
    """Measure a message of y that has arrived: a right one, and refused ones of any size."""
    for name, times in receiver.measure().items():
        at_most = receiver.AT_MOST.get(name, 2.0)
        goals = () if name == receiver.RIGHT else (Goal("p50 (us)", at_most, of_floor=True),)
        yield Row(name, us(times), receiver.RIGHT, goals)


def node_rows(seconds: float, folder: Path) -> Iterator[Row]:
    """Measure the controller's tick and an echo's callback.

    The time is from a y that has arrived to the message published.
    """
    length = min(seconds, 4.0)
    took: dict[str, list[dict[str, float]]] = {}
    with open_node("peer") as node:
        peer = Peer(node)
        for _ in range(ROUNDS):
            for executor in EXECUTORS:
                with Child("timed_echo", "--executor", executor, "--hz", f"{NODE_RATE}") as child:
                    peer.drive(NODE_RATE, length, child)
                    took.setdefault(f"bare echo, {executor}", []).append(child.stop())
            with controller_at(NODE_RATE, folder) as child:
                peer.drive(NODE_RATE, length, child)
                figures = child.stop()
            took.setdefault("controller, until u is published", []).append(figures)
            took.setdefault("controller, whole tick with internals", []).append(_whole(figures))
            for scenario, name in OBSERVED.items():
                with controller_at(OBSERVER_RATE, folder, scenario_name=scenario) as child:
                    peer.drive(OBSERVER_RATE, length, child)
                    took.setdefault(name, []).append(_whole(child.stop()))
    plain, observed = OBSERVED.values()
    for name, runs in took.items():
        figures = {
            f"{column} (us)": float(np.median([run[column] for run in runs]))
            for column in ("p50", "p99")
        }
        goals = () if name.startswith("bare") else (Goal("p50 (us)", 2.0, of_floor=True),)
        if name in {plain, observed}:
            yield Row(
                name,
                figures,
                plain,
                (Goal("p50 (us)", 1.5, of_floor=True),) if name == observed else (),
            )
        else:
            yield Row(name, figures, "bare echo, single", goals)


def _whole(figures: dict[str, float]) -> dict[str, float]:
    return {name: figures[f"whole {name}"] for name in ("p50", "p99")}


def latency_rows(seconds: float, folder: Path) -> Iterator[Row]:
    """Measure the time from y sent to u received, over DDS.

    The processor time for each answer is measured too.
    """
    with open_node("peer") as node:
        peer = Peer(node)
        for hz in RATES:
            total = Driven()
            echoed = dict.fromkeys(EXECUTORS, Driven())
            for _ in range(ROUNDS):
                for executor in EXECUTORS:
                    with Child("echo", "--executor", executor) as child:
                        echoed[executor] += peer.drive(hz, seconds / ROUNDS, child)
                with controller_at(hz, folder) as child:
                    total += peer.drive(hz, seconds / ROUNDS, child)
            floor = f"bare echo, single, {hz} Hz"
            for executor, of in echoed.items():
                yield Row(f"bare echo, {executor}, {hz} Hz", _latency(of, of.round_trips), floor)
            goals = (Goal("CPU (us each)", 2.0, of_floor=True),)
            yield Row(
                f"controller, tick to u, {hz} Hz", _latency(total, total.answers), floor, goals
            )
            yield Row(
                f"controller, y to u with the wait for the tick, {hz} Hz",
                us(total.round_trips),
                floor,
            )
            late = [1e9 * seconds_late for seconds_late in total.late.values()]
            yield Row(f"controller, lateness of the tick, {hz} Hz", us(late))


def _latency(driven: Driven, values: Sequence[float]) -> dict[str, float]:
    times = us(values) if values else {}  # none was answered
    return times | {
        "CPU (us each)": driven.cpu_each,
        "answered (%)": 100.0 * len(driven.received) / driven.sent,
    }


def tick_rows(seconds: float) -> Iterator[Row]:
    """Measure the lateness of ticks of an empty node of the stack, against rclpy's own timers."""
    short = min(seconds, FLOOR_SECONDS)
    prefix = real_time()
    for hz in RATES:
        options = ("--hz", str(hz), "--seconds")
        floor = f"empty timer, single, {hz} Hz"
        for executor in EXECUTORS:
            with Child("timer", *options, str(short), "--executor", executor) as child:
                yield Row(f"empty timer, {executor}, {hz} Hz", _ticks(child, short), floor)
        with Child("bare_loop", *options, str(short)) as child:
            yield Row(f"loop that only sleeps, {hz} Hz", _ticks(child, short), floor)
        goals = {
            500: [Goal(OWN_MISSES if prefix else "missed", 0)],
            1000: [Goal("p99 (us)", 100.0)],
        }.get(hz, [])
        with (
            delay_monitors(bool(prefix)) as delays,
            Child("ticker", *options, str(seconds)) as child,
        ):
            figures = _ticks(child, seconds, delays)
        yield Row(f"the stack's loop, {hz} Hz", figures, floor, goals)
    if not prefix:
        return
    with full_load():
        for name, role in (("empty timer, single", "timer"), ("the stack's loop", "ticker")):
            length = short if role == "timer" else seconds
            with Child(role, "--hz", "100", "--seconds", str(length), within=prefix) as child:
                goals = [Goal("p99 (us)", 50.0)] if role == "ticker" else []
                what, floor = (
                    f"{label}, 100 Hz, FIFO {PRIORITY}, full load"
                    for label in (name, "empty timer, single")
                )
                yield Row(what, _ticks(child, length), floor, goals)


def _ticks(
    child: Child, seconds: float, delays: Callable[[], Intervals] | None = None
) -> dict[str, float]:
    time.sleep(seconds / 2.0)
    cpu_ns = child.cpu_ns()
    at = time.monotonic()
    time.sleep(seconds / 2.0)  # it started later, so it still runs
    share = (child.cpu_ns() - cpu_ns) / 1e9 / (time.monotonic() - at)
    output = child.figures(timeout=seconds + 20.0)
    figures = {f"{name} (us)": output[name] for name in ("p50", "p99", "max")}
    figures["missed"] = output["missed"]
    if delays is not None:
        figures[OWN_MISSES] = missed_excluding_delays(
            output["skipped"], delays(), output["period_ns"]
        )
    return figures | {"ticks": output["ticks"], "CPU (%)": 100.0 * share}


@contextlib.contextmanager
def full_load() -> Iterator[None]:
    """Keep every core busy with other work at ordinary priority."""
    # If this program has a real-time priority, its children give it up: else they block the host.
    spin = (
        "import os\nos.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))\nwhile True: pass"
    )
    busy = [subprocess.Popen([sys.executable, "-c", spin]) for _ in range(os.cpu_count() or 1)]  # noqa: S603
    try:
        yield
    finally:
        for process in busy:
            process.kill()
            process.wait()


def flight_rows(seconds: float, folder: Path) -> Iterator[Row]:
    """Measure CPU and memory of each process of a flight in real time."""
    scenario = find_scenario(SCENARIO, seconds)
    run = folder / "flight"
    run.mkdir()
    with Child("idle") as child:
        time.sleep(WARM_UP + 1.0)
        yield Row("node that only spins", _use([child.popen.pid], 3.0)[0], "node that only spins")
    scenario = save_scenario(scenario, folder / "scenario.yaml")
    with (
        FlightMonitor(
            scenario.controller.outputs, lockstep=True
        ) as monitor,  # without a subscription to internals
        FlightProcesses(scenario, run, monitor, lockstep=False, one_process=False) as flight,
    ):
        if reason := flight.begin():
            raise RuntimeError(reason)
        time.sleep(max(flight.start_time - time.time(), 0.0) + WARM_UP)
        processes = flight.processes
        for process, figures in zip(
            processes, _use([process.popen.pid for process in processes], seconds), strict=True
        ):
            yield Row(process.node.executable, figures, "node that only spins")


def _use(pids: Sequence[int], seconds: float) -> list[dict[str, float]]:
    before = [threads_ns(pid) for pid in pids]
    begin = time.monotonic()
    time.sleep(seconds)
    elapsed = time.monotonic() - begin
    shares = [
        (threads_ns(pid) - was) / 1e9 / elapsed for pid, was in zip(pids, before, strict=True)
    ]
    memory = [psutil.Process(pid).memory_full_info() for pid in pids]
    return [
        {"CPU (%)": 100.0 * share, "resident (MB)": of.rss / 1e6, "unique (MB)": of.uss / 1e6}
        for share, of in zip(shares, memory, strict=True)
    ]


def start_rows(folder: Path) -> Iterator[Row]:
    """Measure the time from the start of a process to its first u."""
    floor = "python, import rclpy, rclpy.init"
    begin = time.perf_counter()
    for _ in range(5):
        subprocess.run(
            [sys.executable, "-c", "import rclpy; rclpy.init(); rclpy.shutdown()"], check=True
        )
    yield Row(floor, {"seconds": (time.perf_counter() - begin) / 5}, floor)
    with open_node("peer") as node:
        peer = Peer(node)
        waits = []
        for _ in range(5):
            begin = time.time()
            with controller_at(100.0, folder, CONTROLLER.module) as child:
                waits.append(peer.drive(100.0, 0.1, child).start - begin)
        yield Row("controller, to its first u", {"seconds": float(np.median(waits))}, floor)
    yield Row(
        "rise-di fly, to its first u",
        {"seconds": float(np.median([seconds_to_first_u() for _ in range(5)]))},
        floor,
    )


def seconds_to_first_u() -> float:
    """Return the time from the start of the command to the first u of its flight, s."""
    with open_node("subscriber") as node, tempfile.TemporaryDirectory() as runs:
        subscription = PolledSubscription(node, U, RECORD, raw=True)
        begin = time.time()
        command = [RISE_DI, "fly", SCENARIO, "--real-time", "--duration", "30", "--runs", str(runs)]
        flight = subprocess.Popen(  # noqa: S603 - this stack
            command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True
        )
        try:
            while not (received := subscription.take()) and flight.poll() is None:
                time.sleep(0.005)
        finally:
            flight.send_signal(signal.SIGINT)
            _, output = flight.communicate()
    if not received:
        raise RuntimeError(
            f"rise-di fly ended before its first u: {output.strip().splitlines()[-1:]}"
        )
    return received[0].received_ns / NANOSECONDS - begin


def import_rows() -> Iterator[Row]:
    """Measure the processor time of an import, and of `rise-di --help`.

    The import is measured alone and with the start of Python. The figures are medians.
    """
    floor, ours, usage = "python, import numpy", "python, import rise_di", "rise-di --help"
    imports = (
        "import time; begin = time.process_time(); import {}; print(1e3 * "
        "(time.process_time() - begin))"
    )
    commands = {
        name: [sys.executable, "-c", imports.format(name.split()[-1])] for name in (floor, ours)
    }
    commands[usage] = [RISE_DI, "--help"]
    time_series = defaultdict(list)
    imported = defaultdict(list)
    for _ in range(IMPORTS):  # in turns, since the speed of the host drifts
        for name, command in commands.items():
            before = resource.getrusage(resource.RUSAGE_CHILDREN)
            output = subprocess.run(command, check=True, capture_output=True, text=True).stdout  # noqa: S603 - this stack
            after = resource.getrusage(resource.RUSAGE_CHILDREN)
            time_series[name].append(
                1e3 * (after.ru_utime - before.ru_utime + after.ru_stime - before.ru_stime)
            )
            if name != usage:
                imported[name].append(float(output))
    figures = {name: {PROCESS: float(np.median(times))} for name, times in time_series.items()}
    figures |= {
        name: figures[name] | {IMPORT: float(np.median(times))} for name, times in imported.items()
    }
    yield Row(floor, figures[floor], floor)
    yield Row(ours, figures[ours], floor, (Goal(IMPORT, 50.0), Goal(PROCESS, 0.6, of_floor=True)))
    yield Row(usage, figures[usage], goals=(Goal(PROCESS, 300.0),))


def lockstep_rows(seconds: float, folder: Path) -> Iterator[Row]:
    """Measure the steps a second of lockstep flights, over topics and without them."""
    for name, speed in lockstep.measure(folder, max(seconds, 10.0), 3).items():
        real_time = {} if name == lockstep.FLOOR else {"times real time": speed / lockstep.RATE}
        yield Row(name, {"steps/s": speed} | real_time, lockstep.FLOOR)


def recorder_rows(seconds: float, folder: Path) -> Iterator[Row]:
    """Measure CPU time, losses and size of the recorder at 1 kHz on six topics.

    They are compared with rosbags' writer fed from memory.
    """
    run = folder / "recorded"
    floor = "rosbags' Writer, MCAP"
    sent_count, processor = recorder.record(run, 1000.0, seconds)
    rewritten = recorder.rewrite(run, folder / "rosbags", CompressionMode.NONE)
    count = rewritten.counts.total()
    yield Row(floor, {"CPU (us each)": rewritten.cpu, "bytes each": rewritten.size}, floor)
    figures = {
        "CPU (us each)": 1e6 * processor / count,
        "bytes each": recorder.mcap_size(run) / count,
    }
    yield Row(
        "recorder, from topics to disk",
        figures | {"lost": sent_count["sent"] - count},
        floor,
        (Goal("lost", 0),),
    )


def evidence_rows(rows: Sequence[Row]) -> Iterator[evidence.Row]:
    """Return the rows of evidence; counts, single outliers and shares have no baseline."""
    by_name = {row.what: row.figures for row in rows}
    for row in rows:
        goals = {
            goal.column: f"<= {goal.at_most:g}" + evidence.BASELINE * goal.of_floor
            for goal in row.goals
        }
        for column, value in row.figures.items():
            name, unit = evidence.split(column)
            compared = (
                row.floor != row.what
                and column in by_name.get(row.floor, {})
                and column not in WITHOUT_BASELINE
            )
            baseline = f"{row.floor}: {name}" if compared else ""
            yield evidence.Row(
                f"{row.what}: {name}", f"{value:.6g}", unit, baseline, goals.get(column, "")
            )


Group = Callable[[float, Path], Iterator[Row]]
GROUPS: dict[str, Group] = {
    "law": lambda seconds, folder: law_rows(),
    "receiver": lambda seconds, folder: receiver_rows(),
    "node": node_rows,
    "latency": latency_rows,
    "ticks": lambda seconds, folder: tick_rows(seconds),
    "flight": flight_rows,
    "start": lambda seconds, folder: start_rows(folder),
    "import": lambda seconds, folder: import_rows(),
    "lockstep": lockstep_rows,
    "recorder": recorder_rows,
}


def show(console: Console, name: str, rows: Sequence[Row]) -> None:
    """Print the rows of a group, each figure with its ratio to the baseline."""
    columns = list(dict.fromkeys(column for row in rows for column in row.figures))
    table = new_table(name, ("", *columns), texts=1)
    by_name = {row.what: row.figures for row in rows}
    for row in rows:
        floor = by_name.get(row.floor, {})
        table.add_row(
            row.what, *(_cell(row.figures.get(column), floor.get(column)) for column in columns)
        )
    console.print(table)


def _cell(value: float | None, floor: float | None) -> str:
    if value is None:
        return ""
    return f"{value:.4g}" + (f"  x{value / floor:.3g}" if floor else "")


def main() -> None:
    """Measure, print, and write the figures to a file."""
    parser = parser_of(__doc__)
    parser.add_argument("--only", choices=GROUPS, help="measure only this group")
    parser.add_argument(
        "--seconds",
        type=float,
        default=10.0,
        help="how long each figure of a running process is measured",
    )
    parser.add_argument("--json", type=Path, help="file to write the figures to")
    options = parser.parse_args()
    # its own domain, among those whose ports are outside Linux's ephemeral range
    os.environ.setdefault("ROS_DOMAIN_ID", str(1 + os.getpid() % 100))
    os.environ.update(transport.environment())
    console = Console(width=None if sys.stdout.isatty() else 160)
    rows_measured: list[evidence.Row] = []
    for name in [options.only] if options.only else GROUPS:
        with tempfile.TemporaryDirectory() as folder:
            rows = list(GROUPS[name](options.seconds, Path(folder)))
        show(console, name, rows)
        rows_measured += evidence_rows(rows)
    if options.json is not None:
        options.json.write_text(json.dumps({"evidence": rows_measured}, indent=1) + "\n")


if __name__ == "__main__":
    main()
