# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Measure the cost of watching a flight.

The figures are of opening a long log, of the server beside a flight, of delays to the screen and of
missed ticks.

.venv/bin/python -m benchmarks.view                      # all
.venv/bin/python -m benchmarks.view open --hours 1       # `rise-di watch` of a log of that length
.venv/bin/python -m benchmarks.view live --seconds 30
    # a flight in real time, a client, and a browser where there is one
.venv/bin/python -m benchmarks.view frozen
    # a page whose process stops for 10 s, and how it comes back
.venv/bin/python -m benchmarks.view flights --count 10
    # that many flights, with a client for half of the time
"""

import asyncio
import itertools
import json
import os
import subprocess
import tempfile
import threading
import time
import urllib.parse
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import psutil
from benchmarks.host_delays import Intervals, excluding_delays, missed_excluding_delays
from benchmarks.processes import RISE_DI, delay_monitors, real_time, threads_ns
from benchmarks.tables import parser_of
from numpy.typing import NDArray
from scipy.stats import quantile_test
from tests.browser import CHROMIUM, Browser
from tornado.httpclient import HTTPRequest
from tornado.websocket import WebSocketClientConnection, WebSocketClosedError, websocket_connect

from flight_analysis.closed_loop.scenario_library import find_scenario
from flight_analysis.closed_loop.simulate import simulate
from flight_analysis.report.run_folder import attachments_for
from flight_core.rates import NANOSECONDS, nanoseconds
from flight_core.tape import Signal
from flight_core.vectors import FloatArray
from flight_log.bag import BagWriter
from flight_log.named_vectors import JOINT_STATE, STAMP
from flight_log.stored_messages import StoredMessage, stored_messages
from flight_log.tape_reader import read_run
from flight_log.tape_writer import write_run

SCENARIO = "osprey_servo"  # y, y_m and truth at 500 Hz, ticks at 100 Hz, noise
PIECE = 60.0  # duration of the flight whose repetitions make a long log, s
FLUSH_PERIOD_NS = nanoseconds(0.1)  # as the recorder
START_S = 1_795_000_000  # first stamp of a long log, s: about today
POLLS = 60.0  # rate of the client, Hz: the page asks again one frame after it got an answer
# s: how long the process of a page stops, and the delay below which the page has recovered
FREEZE, RECOVERED = (10.0, 0.3)
BEGUN = 3.0  # time until a flight has begun, s
FLIGHT_SECONDS = 60.0  # duration of each of the flights whose ticks are compared, s
TURN = 2.5  # time with a client, then the same time without one, s
STARTED = 7.0  # time until the server has started and its client has the flight so far, s


# A long log


def write_long_log(run: Path, hours: float) -> None:
    """Write a log of `hours` that repeats a flight of PIECE s with later stamps.

    A chunk is written each 0.1 s of flight, as by the recorder.
    """
    scenario = find_scenario(SCENARIO, PIECE)
    with tempfile.TemporaryDirectory() as folder:
        write_run(simulate(scenario), Path(folder), attachments_for(scenario, Path(folder)))
        messages = [
            message
            for message in stored_messages(Path(folder))
            if message.received_ns < nanoseconds(PIECE)
        ]
    with BagWriter(run) as bag:
        bag.add_attachments(attachments_for(scenario, run), 0)
        channels = {
            topic: bag.add_topic(topic, JOINT_STATE, "")
            for topic in dict.fromkeys(message.topic for message in messages)
        }
        flushed_ns = 0
        for k in range(round(hours * 3600.0 / PIECE)):
            for message in messages:
                now_ns = message.received_ns + nanoseconds((k * PIECE) + START_S)
                if now_ns - flushed_ns >= FLUSH_PERIOD_NS:
                    bag.flush()
                    flushed_ns = now_ns
                bag.write(channels[message.topic], now_ns, now_ns, 0, moved(message, now_ns))


def moved(one: StoredMessage, now_ns: int) -> bytes:
    """Return the message with another stamp.

    Its channel t, if it has one, stays, because only the first t of a flight counts.
    """
    seconds, rest = divmod(now_ns, NANOSECONDS)
    return (
        one.data[: STAMP.start]
        + seconds.to_bytes(4, "little")
        + rest.to_bytes(4, "little")
        + one.data[STAMP.stop :]
    )


def open_log(hours: float) -> dict[str, Any]:
    """Open a long log with `rise-di watch`, and return how long its answers take, s.

    "first samples" is the time from the start of the program to the first answer with samples, and
    "whole log" that to the first answer with the state "ended". The figures also have the processor
    time, s, and the memory of the server, MB.
    """
    with tempfile.TemporaryDirectory() as folder:
        run = Path(folder) / "run"
        write_long_log(run, hours)
        begin = time.monotonic()
        times = dict[str, float]()
        with watching(run) as (server, address):
            client = Client(address)
            head = dict[str, Any]()
            while head.get("state") != "ended":
                head = client.news()
                if head["topics"]:
                    times.setdefault("first samples", time.monotonic() - begin)
                time.sleep(1.0 / POLLS)
            times["whole log"] = time.monotonic() - begin
            processor = server.cpu_times()
            memory = server.memory_info().rss / 1e6
        size = sum(path.stat().st_size for path in run.glob("*.mcap")) / 1e6
    return times | {
        "processor": processor.user + processor.system,
        "memory": memory,
        "flight": 3600.0 * hours,
        "log": size,
    }


# Beside a flight


class Client(threading.Thread):
    """Asks for news as the page does, until stopped."""

    def __init__(self, address: str) -> None:
        super().__init__(daemon=True)
        parts = urllib.parse.urlsplit(address)
        self._loop = asyncio.Runner()
        self._socket = self._loop.run(
            self._connect(parts.netloc, parts.fragment.removeprefix("token="))
        )
        self._ended = threading.Event()
        self.asks = True
        self._head: dict[str, Any] = {}
        self._rows: dict[str, int] = {}
        self.bytes = 0

    async def _connect(self, netloc: str, token: str) -> WebSocketClientConnection:
        request = HTTPRequest(f"ws://{netloc}/news/0", headers={"Origin": f"http://{netloc}"})
        opened = await websocket_connect(request)
        await opened.write_message(token)
        return opened

    def run(self) -> None:
        """Ask until stopped, or until the server ends; pause while `asks` is off."""
        # this thread has the lowest priority, because in use the browser runs on another host
        os.sched_setscheduler(0, os.SCHED_IDLE, os.sched_param(0))
        while not self._ended.wait(1.0 / POLLS):
            try:
                if self.asks:
                    self.news()
            except EOFError:
                break

    def news(self) -> dict[str, Any]:
        """Ask for what is new since the last answer, and return the head of the answer.

        Raises EOFError if the server has ended.
        """
        client_state = {
            name: self._head.get(name, "") for name in ("epoch", "state", "described")
        } | self._rows
        content = self.ask(urllib.parse.urlencode(client_state))
        self.bytes += len(content)
        size = int.from_bytes(content[:4], "little")
        head: dict[str, Any] = json.loads(content[4 : 4 + size])
        self._rows["events"] = head["first_event"] + len(head["events"])
        self._rows |= {topic["name"]: topic["first"] + topic["count"] for topic in head["topics"]}
        self._head = head
        return head

    def ask(self, query: str = "") -> bytes:
        """Return the server's answer to a client; `query` says what the client has already.

        Raises EOFError if the server has ended.
        """
        return self._loop.run(self._ask(query))

    async def _ask(self, query: str) -> bytes:
        try:
            await self._socket.write_message(query)
        except WebSocketClosedError:
            raise EOFError("the server has ended") from None
        content = await self._socket.read_message()
        if isinstance(content, bytes):
            return content
        raise EOFError("the server has ended")

    def stop(self) -> None:
        """Ask no more."""
        self._ended.set()
        self.join()
        self._socket.close()
        self._loop.close()


@contextmanager
def flying(
    runs: Path, seconds: float, *options: str
) -> Iterator[tuple["subprocess.Popen[str]", Path]]:
    """Fly over topics, in real time unless `options` say otherwise, and yield the folder."""
    command = [
        RISE_DI,
        "fly",
        SCENARIO,
        "--duration",
        f"{seconds:g}",
        "--runs",
        str(runs),
        "--json",
        *(options or ("--real-time",)),
    ]
    runs_before = set(runs.iterdir())
    with subprocess.Popen(  # noqa: S603
        command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
    ) as flight:
        while not (new := set(runs.iterdir()) - runs_before):
            time.sleep(0.02)
        yield flight, new.pop()


@contextmanager
def watching(*runs: Path) -> Iterator[tuple[psutil.Popen, str]]:
    """Serve a run, or a run and its ghost, and yield the address."""
    command = [RISE_DI, "watch", *map(str, runs), "--wait", "--port", "0"]
    server = psutil.Popen(command, stdout=subprocess.PIPE, text=True)
    try:
        yield server, server.stdout.readline().strip()
    finally:
        server.terminate()
        server.wait()


MEASURE = """(start => {
    const delays = window.delays = [], time = document.getElementById('time');
    let before = '';
    (function look() {
        if (time.textContent !== before) {
            before = time.textContent;
            delays.push(Date.now() / 1e3 - start - parseFloat(before.slice(4)));
            (window.instants ??= []).push(Date.now() / 1e3);
        }
        requestAnimationFrame(look);
    })();
})"""


def live(seconds: float, *, browser: bool) -> dict[str, Any]:
    """Measure processor share and memory (MB) of the server beside a flight.

    Traffic and delays to the screen are measured too.
    """
    with (
        tempfile.TemporaryDirectory() as folder,
        flying(Path(folder), seconds) as (flight, run),
        watching(run) as (server, address),
    ):
        client = Client(address)
        delays = []
        client.start()
        time.sleep(BEGUN)
        before = threads_ns(server.pid)
        begin = time.monotonic()
        if browser:
            with Browser(Path(folder) / "profile") as page:
                page.open(address)
                page.wait_for("document.getElementById('state')?.textContent === 'LIVE'")
                page.run(f"{MEASURE}({start_of(address)})")
                time.sleep(seconds - 8.0)
                delays = page.run("delays")
        else:
            time.sleep(seconds - 6.0)
        share = (threads_ns(server.pid) - before) / (time.monotonic() - begin) / NANOSECONDS
        memory = server.memory_info().rss / 1e6
        flight.communicate()
        client.stop()
        traffic = client.bytes / seconds
    figures: dict[str, Any] = {
        "flight": seconds,
        "processor": share,
        "memory": memory,
        "traffic": traffic,
    }
    return figures | (
        {"to the screen": {f"p{k}": float(np.percentile(delays, k)) for k in (50, 99)}}
        if browser
        else {}
    )


def frozen(seconds: float = FREEZE) -> dict[str, Any]:
    """Stop the process of a page for some seconds.

    Returns the time from when the process goes on until the delay of the page is below RECOVERED
    again, s.
    """
    with (
        tempfile.TemporaryDirectory() as folder,
        flying(Path(folder), seconds + 60.0) as (flight, run),
        watching(run) as (_, address),
        Browser(Path(folder) / "profile") as page,
    ):
        page.open(address)
        page.wait_for("document.getElementById('state')?.textContent === 'LIVE'")
        page.run(f"{MEASURE}({start_of(address)})")
        time.sleep(3.0)
        renderers = [
            process
            for process in psutil.Process(page.pid).children(recursive=True)
            if "--type=renderer" in process.cmdline()
        ]
        for renderer in renderers:
            renderer.suspend()
        time.sleep(seconds)
        resumed = time.time()
        for renderer in renderers:
            renderer.resume()
        page.wait_for(
            f"window.delays.length > 0 && delays.at(-1) < {RECOVERED} && instants.at(-1) > "
            f"{resumed}"
        )
        instants, delays = page.run("[instants, delays]")
        flight.terminate()
        flight.communicate()
    back = (
        at - resumed
        for at, delay in zip(instants, delays, strict=True)
        if at > resumed and delay < RECOVERED
    )
    return {"frozen": seconds, "recovered after": next(back)}


def start_of(address: str) -> float:
    """Return the system time of t = 0, s, as the page has it."""
    content = Client(address).ask()
    size = int.from_bytes(content[:4], "little")
    return int(json.loads(content[4 : 4 + size])["epoch"].partition(".")[0]) / NANOSECONDS


def flights(count: int, seconds: float) -> dict[str, Any]:
    """Compare the ticks of flights with and without a watching client.

    The figures are missed ticks, and the 99th percentile of the lateness of ticks, s. In each
    flight, client and server run for TURN s, then stop for TURN s, and so on. The phases of the
    nodes' timers differ from flight to flight. In one flight they are the same with a client and
    without one, and a drift of the host cancels. "start included" also counts the time in which the
    server starts; any program that starts needs such processor time.
    """
    period_ns = nanoseconds(1.0 / find_scenario(SCENARIO).controller.rate)
    tables: dict[str, list[dict[str, float]]] = {"without": [], "with": [], "start included": []}
    starting: list[float] = []  # s
    for number in range(count):
        # system time, ns; without and with a client
        turns: dict[bool, list[tuple[int, int]]] = {False: [], True: []}
        with (
            tempfile.TemporaryDirectory() as folder,
            delay_monitors(bool(real_time())) as delays,
            flying(Path(folder), BEGUN + STARTED + seconds) as (flight, run),
        ):
            time.sleep(BEGUN)
            starts = time.time_ns()
            with watching(run) as (server, address):
                client = Client(address)
                while client.news()["state"] != "recording":
                    time.sleep(1.0 / POLLS)
                joins = time.time_ns()
                client.start()
                try:
                    for turn in range(round(seconds / TURN)):
                        client.asks = watched = (turn + number) % 2 == 0
                        (server.resume if watched else server.suspend)()
                        begin = time.time_ns()
                        time.sleep(TURN)
                        turns[watched].append((begin, time.time_ns()))
                finally:
                    server.resume()  # a stopped process would not end
                client.stop()
            flight.communicate()
            clock = time.time_ns() - time.monotonic_ns()
            host_delays = (
                [(since + clock, until + clock) for since, until in delays()] if delays else None
            )
            internals = read_run(run).tape["internals"]
        for kind, windows in {
            "without": turns[False],
            "with": turns[True],
            "start included": [(starts, joins), *turns[True]],
        }.items():
            tables[kind].append(figures_of_ticks(internals, host_delays, period_ns, windows))
        starting.append((joins - starts) / NANOSECONDS)
    names = tables["with"][0]
    by_kind: dict[str, Any] = {
        kind: {name: [figure[name] for figure in figures] for name in names}
        for kind, figures in tables.items()
    }
    for kind in ("with", "start included"):
        more = {name: np.subtract(by_kind[kind][name], by_kind["without"][name]) for name in names}
        by_kind[f"more {kind}"] = {name: float(np.median(values)) for name, values in more.items()}
        by_kind[f"interval {kind}"] = {name: interval(values) for name, values in more.items()}
        by_kind[f"probability {kind}"] = {
            name: probability(values) for name, values in more.items()
        }
    return by_kind | {"starting": starting}


def figures_of_ticks(
    internals: Signal,
    delays: Intervals | None,
    period_ns: int,
    windows: Intervals = ((0, 2**63 - 1),),
) -> dict[str, float]:
    """Return missed ticks, and the 99th percentile of their lateness, for deadlines inside windows.

    If host delays are known, also returns both figures without what these delays explain.
    """
    at = internals.stamp_ns + np.rint(internals["age"] * NANOSECONDS).astype(np.int64)
    due = at - np.rint(internals["late"] * NANOSECONDS).astype(np.int64)

    def inside(instants: NDArray[np.int64]) -> NDArray[np.bool_]:
        is_inside: NDArray[np.bool_] = np.any(
            [(instants >= first) & (instants <= last) for first, last in windows], axis=0
        )
        return is_inside

    deadlines = due[:-1] + period_ns  # unless the next tick has this deadline
    skipped = np.column_stack((deadlines, at[1:]))[
        (np.diff(due) > 1.5 * period_ns) & inside(deadlines)
    ]
    ticks = np.column_stack((due, at))[inside(due)]
    figures: dict[str, float] = {}
    for words, known in (("", ()), (", excluding host delays", delays)):
        if known is not None:
            figures["missed ticks" + words] = missed_excluding_delays(skipped, known, period_ns)
            late = excluding_delays(ticks, known)
            figures["late p99 (ms)" + words] = float(np.percentile(late, 99)) / 1e6
    return figures


def interval(differences: FloatArray) -> list[float]:
    """Return the 95 % confidence interval of the median, by order statistics.

    For ten values it goes from the second to the ninth.
    """
    ends: list[float] = np.array(quantile_test(differences).confidence_interval(0.95)).tolist()
    return ends


def probability(differences: FloatArray) -> float:
    """Return the probability of a mean difference this large or larger by chance.

    If watching has no effect, all signs of the pairs are equally likely. Exact permutation test of
    paired samples; Edgington, Randomization Tests, 4th edition, 5.
    """
    signs = np.array(list(itertools.product((1.0, -1.0), repeat=len(differences))))
    return float(np.mean(signs @ differences >= np.sum(differences) - 1e-12))


def main() -> None:
    """Measure, and print the figures as JSON."""
    parser = parser_of(__doc__)
    parser.add_argument(
        "parts", nargs="*", choices=["open", "live", "frozen", "flights", []], help="all by default"
    )
    parser.add_argument("--hours", type=float, default=1.0, help="length of the log")
    parser.add_argument("--seconds", type=float, default=30.0, help="length of the live flight")
    parser.add_argument("--count", type=int, default=10, help="flights whose ticks are compared")
    parser.add_argument(
        "--no-browser", action="store_true", help="measure without a browser on this machine"
    )
    parser.add_argument("--json", type=Path, help="file for the figures")
    arguments = parser.parse_args()
    os.environ.setdefault("ROS_DOMAIN_ID", str(1 + os.getpid() % 100))
    parts = arguments.parts or ["open", "live", "frozen", "flights"]
    browser = CHROMIUM is not None and not arguments.no_browser
    figures: dict[str, Any] = (
        {} if browser else {"to the screen": {"p50": None, "p99": None}, "recovered after": None}
    )
    if "open" in parts:
        figures["opened"] = open_log(arguments.hours)
    if "live" in parts:
        figures["live"] = live(arguments.seconds, browser=False)
        if browser:
            figures["live with a browser"] = live(arguments.seconds, browser=True)
    if "frozen" in parts and browser:
        figures["frozen"] = frozen()
    if "flights" in parts:
        figures["flights"] = flights(arguments.count, FLIGHT_SECONDS)
    text = json.dumps(figures, indent=2)
    print(text)
    if arguments.json is not None:
        arguments.json.write_text(text)


if __name__ == "__main__":
    main()
