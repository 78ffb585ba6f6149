# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""A campaign on a cluster of dask that loses a worker, has a slow one, and whose scheduler starts again: the same bytes.

python -m benchmarks.cluster              # a scheduler and four workers, each a process with an address of its own; 5 min
"""

import json
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Annotated

import psutil
import typer
from benchmarks.sampling import new_table
from rich.console import Console

from flight_analysis.closed_loop.scenario_library import find_scenario
from flight_campaign import engines
from flight_campaign.campaign import CHUNKS, Campaign, Definition, define

PORT = 8790
ADDRESS = f"tcp://127.0.0.1:{PORT}"
WORKERS = 4
FAULTS = "worker killed, worker stopped for 10 s, scheduler killed and started with new workers"
STOPPED = 10.0  # s that a worker is stopped: longer than a chunk takes, shorter than its lease at the scheduler (300 s)


def _start(program: str, *options: str) -> "subprocess.Popen[bytes]":
    command = [sys.executable, "-m", f"distributed.cli.{program}", *options]
    return subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)  # noqa: S603 - the interpreter


class Cluster:
    """A scheduler and its workers, processes of this host."""

    def __init__(self, stack: ExitStack) -> None:
        self.scheduler, self.workers = self._scheduler(), [self._worker(k) for k in range(WORKERS)]
        stack.callback(self.close)

    def _scheduler(self) -> "subprocess.Popen[bytes]":
        options = ("--host", "127.0.0.1", "--port", str(PORT), "--no-dashboard")
        return _start("dask_scheduler", *options)

    def _worker(self, number: int) -> "subprocess.Popen[bytes]":
        options = ("--host", f"127.0.0.{2 + number}", "--nthreads", "1", "--no-dashboard", "--no-nanny")
        return _start("dask_worker", ADDRESS, *options)

    def lose_worker(self) -> None:
        """Kill a worker."""
        self.workers[0].kill()

    def slow_worker(self) -> None:
        """Stop a worker for a time."""
        process = psutil.Process(self.workers[1].pid)
        process.suspend()
        time.sleep(STOPPED)
        process.resume()

    def restart_scheduler(self) -> None:
        """Kill the scheduler; start one and workers in its place."""
        self.scheduler.kill()
        self.scheduler.wait()
        for worker in self.workers:
            worker.kill()
            worker.wait()
        self.scheduler, self.workers = self._scheduler(), [self._worker(k) for k in range(WORKERS)]

    def close(self) -> None:
        """End all processes."""
        for process in (*self.workers, self.scheduler):
            process.send_signal(signal.SIGKILL)
            process.wait()


def main(
    # the last fault comes after the 14th chunk
    aircraft: Annotated[int, typer.Option(min=800, help="Aircraft of the campaign, in chunks of 50.")] = 2000,
    json_file: Annotated[Path | None, typer.Option("--json", help="Write the results to a file.")] = None,
) -> None:
    """Fly a campaign in threads, then on the cluster with one fault after another, and compare the chunks."""
    definition = define(find_scenario("osprey_servo").vary(flight={"duration": 20.0}), aircraft, 0.3, 7, 50)
    with tempfile.TemporaryDirectory() as folder, ExitStack() as stack:
        expected = chunks_of(Path(folder) / "threads", definition, engines.threads(), {})
        cluster = Cluster(stack)
        faults = {3: cluster.lose_worker, 8: cluster.slow_worker, 14: cluster.restart_scheduler}
        found = chunks_of(Path(folder) / "dask", definition, engines.dask(WORKERS, ADDRESS), faults)
    same = sum(found.get(name) == content for name, content in expected.items())
    table = new_table(f"{aircraft} aircraft, {WORKERS} workers", ("figure", "value"), texts=1)
    table.add_row("faults", FAULTS)
    table.add_row("chunks with the bytes of one process", f"{same} of {len(expected)}")
    Console().print(table)
    if json_file is not None:
        result = {"faults": FAULTS, "workers": WORKERS, "aircraft": aircraft, "chunks": len(expected)}
        result["differing"] = len(expected) - same
        json_file.write_text(json.dumps(result), encoding="utf-8")
    if same != len(expected):
        raise typer.Exit(1)


def chunks_of(
    folder: Path, definition: Definition, engine: engines.Engine, faults: dict[int, Callable[[], None]]
) -> dict[str, bytes]:
    """The files of a campaign's chunks by name; a fault comes after so many chunks."""
    folder.mkdir()
    campaign = Campaign.begin(folder, definition)
    for count, _ in enumerate(campaign.fly(engine), 1):
        faults.get(count, lambda: None)()
    return {path.name: path.read_bytes() for path in (folder / CHUNKS).iterdir()}


if __name__ == "__main__":
    typer.run(main)
