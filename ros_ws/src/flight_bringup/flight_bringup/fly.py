# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Fly a scenario: over topics in real time, or in one process; then its summary and report."""

import json
import os
import signal
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, NamedTuple

from flight_analysis.bag_reader import StoredFile, read_run
from flight_analysis.bag_writer import write_run
from flight_analysis.latency import latency
from flight_analysis.recorded import Recorded
from flight_analysis.report import write_page
from flight_analysis.scenario import Scenario, load_scenario
from flight_analysis.simulate import simulate
from flight_analysis.summary import shown_units, summarise, summarise_unflown
from flight_bringup.graph import Autopilot, enclosed
from flight_bringup.processes import Flight
from flight_core.outcome import COMPLETED, INTERRUPTED
from flight_core.parameters import ParameterError, printable
from flight_core.tape import Tape
from flight_recorder.bag import bag_files

if TYPE_CHECKING:
    from flight_bringup.node import Monitor

SUMMARY = "summary.json"
POLL_PERIOD = 0.05  # s, of the progress bar

STUCK = 40.0
"""s. A lockstep flight in which nothing moves for as long ends; a peer that is gone ends it within two seconds."""

Progress = Callable[[float, str], None]  # flight time in s, and what to show beside it


class Concluded(NamedTuple):
    """A flight that has ended, however, and where it lies."""

    flight: Recorded
    mcap: Path
    report: Path


def new_run(scenario: Scenario, runs: Path, kind: str = "") -> Path:
    """Make the folder of a new run, runs/<UTC stamp>-<kind><scenario>. Raises ParameterError where that cannot be."""
    stem = f"{datetime.now(UTC):%Y%m%dT%H%M%SZ}-{kind}{scenario.name}"
    for name in (stem, *(f"{stem}-{k}" for k in range(2, 100))):
        run = (runs / name).absolute()
        try:
            run.mkdir(parents=True)
        except FileExistsError:
            continue
        except OSError as error:
            raise ParameterError(f"runs: {runs} cannot be written ({error.strerror}), expected a folder that can") from None
        return run
    raise ParameterError(f"runs: found a hundred runs of this second in {runs}, expected fewer")


@contextmanager
def _signals_as_interrupt() -> Iterator[None]:
    # SIGINT too: a shell starts background commands with it ignored, and then Python leaves it so.
    def interrupt(number: int, frame: FrameType | None) -> None:
        raise KeyboardInterrupt

    before = {number: signal.signal(number, interrupt) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def fly_over_topics(
    scenario: Scenario,
    run: Path,
    progress: Progress,
    *,
    lockstep: bool = False,
    one_process: bool = False,
    autopilot: Autopilot | None = None,
) -> str:
    """Fly over topics, as separate processes, and record the bag into `run`. Returns the outcome.

    In real time, or in `lockstep` as fast as the machine allows; `one_process` holds all nodes in one process, for lockstep
    alone; `autopilot` flies in the aircraft's place, in real time alone. "completed", "interrupted" (Ctrl-C or SIGTERM), or a
    sentence naming the process that ended early.
    """
    from flight_bringup.node import Monitor  # noqa: PLC0415 - loads rclpy, which no other command needs

    try:
        with (
            _signals_as_interrupt(),
            Monitor(scenario.controller.outputs, lockstep=lockstep) as monitor,
            Flight(
                scenario,
                run,
                before_start=monitor.require_nobody_flies,
                lockstep=lockstep,
                one_process=one_process,
                autopilot=autopilot,
            ) as flight,
        ):
            follow = _follow_lockstep if lockstep else _follow_real_time
            return follow(scenario, flight, monitor, progress)
    except KeyboardInterrupt:
        return INTERRUPTED


def _follow_real_time(scenario: Scenario, flight: Flight, monitor: "Monitor", progress: Progress) -> str:
    units, outputs = shown_units(scenario), scenario.controller.outputs
    shown = "starting"
    while (t := time.time() - flight.start_time) < scenario.flight.duration:
        if (sentence := flight.ended_early()) is not None:
            return sentence
        if (seen := monitor.newest()) is not None:
            errors = ", ".join(f"{name} {value * units[name].factor:+.2f}" for name, value in zip(outputs, seen.e, strict=True))
            shown = f"{seen.mode}  e: {errors}"
        progress(max(t, 0.0), shown)
        time.sleep(POLL_PERIOD)
    return COMPLETED


def _follow_lockstep(scenario: Scenario, flight: Flight, monitor: "Monitor", progress: Progress) -> str:
    """The real-time factor shown is that since the first instant in the log."""
    end = scenario.flight.duration
    flown, first, moved, shown = 0.0, 0.0, time.monotonic(), "lockstep, starting"
    begin = moved
    # The last instant is the last whole period of the aircraft.
    while flown < end - 1.0 / scenario.aircraft.rate:
        if (sentence := flight.ended_early()) is not None:
            return sentence
        now = time.monotonic()
        if (recorded := monitor.recorded()) is not None:
            if moved == begin:
                begin, first = now, recorded
            flown, moved = recorded, now
            if now > begin:
                shown = f"lockstep, {(flown - first) / (now - begin):.1f} times real time"
        elif now > moved + STUCK:
            return f"stuck at t = {flown:g} s: nothing has moved for {STUCK:g} s"
        progress(flown, shown)
        time.sleep(POLL_PERIOD)
    return COMPLETED


def fly_in_process(scenario: Scenario, run: Path, progress: Progress) -> str:
    """Fly in one process without ROS, as fast as it goes, and write the bag into `run`. Returns the outcome."""
    with _signals_as_interrupt():
        tape = simulate(scenario, lambda t: progress(t, "in one process"))
    write_run(tape, run, enclosed(scenario, run))
    return tape.outcome


def read_flight(run: Path, outcome: str | None = None) -> Recorded:
    """A recorded flight with its summary; its scenario is written beside the log.

    Without an outcome, that of the run's summary is kept. Raises ParameterError where the log cannot be read, or holds no
    scenario.
    """
    recorded = read_run(run)
    if recorded.scenario is None:
        raise ParameterError(f"{run}: found a log without its scenario, expected a run that was flown from one")
    folder = _folder(run)
    scenario = _written(recorded.scenario, folder)
    waited = latency(run)
    signals = recorded.tape.signals if waited is None else {**recorded.tape.signals, "latency": waited}
    tape = _until_last_input(replace(recorded.tape, signals=signals))
    if outcome == COMPLETED and "internals" not in tape:
        outcome = "the controller never engaged"
    name = folder.name if run.is_dir() else run.stem
    return Recorded(name, scenario, tape, summarise(scenario, tape, outcome or _outcome_before(folder / SUMMARY)))


def recorded_scenario(run: Path, namespace: str | None = None) -> Scenario:
    """The scenario inside a log, which is written beside it. Raises ParameterError where the log holds none."""
    stored = read_run(run, namespace).scenario
    if stored is None:
        raise ParameterError(f"{run}: found a log without its scenario, expected a run that was flown from one")
    return _written(stored, _folder(run))


def _written(stored: StoredFile, folder: Path) -> Scenario:
    path = folder / stored.name
    with _writing(folder):
        path.write_bytes(stored.content)
    return load_scenario(path)


def conclude(run: Path, outcome: str | None = None) -> Concluded:
    """Read the bag back, write its scenario, summary.json and report.html beside it, point runs/latest at the run.

    Without an outcome it is the report of an old run that is written again. Raises ParameterError as `read_flight` does.
    """
    flight, folder = read_flight(run, outcome), _folder(run)
    with _writing(folder):
        (folder / SUMMARY).write_text(json.dumps(flight.summary, indent=2, allow_nan=False) + "\n", encoding="utf-8")
        write_page(folder / "report.html", [flight])
        if outcome is not None:
            _point_latest(folder)
    return Concluded(flight, min(bag_files(run), default=folder), folder / "report.html")


def conclude_unflown(run: Path, scenario: Scenario, outcome: str) -> Path:
    """Write summary.json of a flight that ended before its first sample; its path. The log, such as it is, stays."""
    path = run / SUMMARY
    path.write_text(json.dumps(summarise_unflown(scenario, outcome), indent=2) + "\n", encoding="utf-8")
    _point_latest(run)
    return path


def _folder(run: Path) -> Path:
    """The folder of a run, which may be named by its log; runs/latest is a link."""
    return run.resolve() if run.is_dir() else run.resolve().parent


@contextmanager
def _writing(folder: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise ParameterError(f"{folder}: cannot be written ({error.strerror}), expected a folder that can") from None


def _outcome_before(summary: Path) -> str:
    try:
        return printable(str(json.loads(summary.read_text(encoding="utf-8"))["outcome"]))
    except (OSError, ValueError, TypeError, KeyError):
        return "ended as its log does"


def _until_last_input(tape: Tape) -> Tape:
    """The tape up to the controller's last u: what the aircraft does while the processes are being ended is no flight."""
    if "u" not in tape:
        return tape
    end_ns = tape["u"].stamp_ns[-1]
    return replace(tape, signals={name: signal_.until(end_ns) for name, signal_ in tape.signals.items()})


def _point_latest(run: Path) -> None:
    latest, fresh = run.parent / "latest", run.parent / f".latest-{os.getpid()}"
    fresh.symlink_to(run.name)
    try:
        fresh.replace(latest)
    except OSError:
        fresh.unlink()
        raise
