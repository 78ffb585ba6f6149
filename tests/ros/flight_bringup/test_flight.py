# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test how a flight over topics ends: by Ctrl-C, with its command, or with one of its nodes."""

import os
import pty
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import psutil
import pytest
from rosbags.highlevel import AnyReader
from tests.ros.conftest import DEFAULT_SIGHUP, Process, Start, is_closed
from tests.ros.waiting import HANG, until

from flight_log.tape_reader import read_run

ENDED = 10.0  # s, until no process of a flight is left: about one on an idle host

# y and y_m come 200 times a second in place of 500: the tests are of the ends of a flight.
SLOWER = ("aircraft.rate=200", "aircraft.step=0.005", "reference_model.rate=200")
FLY = (
    *("flight_cli.cli", "fly", "osprey_gust", "--real-time"),
    *(word for setting in SLOWER for word in ("--set", setting)),
)

Engaged = tuple[Process, list[psutil.Process]]


@pytest.fixture
def engaged(start: Start, tmp_path: Path) -> Engaged:
    """Return a flight whose controller has engaged, and its four processes."""
    flight = start(*FLY)
    flight.until(lambda: is_engaged(tmp_path), "a flight that has engaged")
    return flight, flight.children()


def is_engaged(folder: Path) -> bool:
    """Return whether the controller of a flight below a folder has engaged."""
    return any("ENGAGED" in log.read_text() for log in folder.glob("runs/*/log/controller.log"))


def test_flights_in_two_namespaces_do_not_mix_and_end_by_interrupts(
    start: Start, engaged: Engaged, tmp_path: Path
) -> None:
    """One interrupt ends the first flight, and three end the second.

    The later interrupts do not disturb its shutdown.
    """
    flight, nodes = engaged
    assert len(nodes) == 4
    second_flight = start(*FLY, "--namespace", "uav2", "--runs", "beside/runs")
    second_flight.until(
        lambda: is_engaged(tmp_path / "beside"), "a flight beside it that has engaged"
    )
    nodes_beside = second_flight.children()
    flight.interrupt()
    second_flight.interrupt()
    second_flight.interrupt()
    psutil.wait_procs(nodes_beside[:1], timeout=ENDED)
    second_flight.interrupt()
    assert not psutil.wait_procs(nodes + nodes_beside, timeout=ENDED)[1]
    assert flight.end() == 130, flight.output
    second_flight.end()
    assert "Traceback" not in flight.output + second_flight.output
    assert "outcome: interrupted" in flight.output
    assert "q (deg/s)" in flight.output
    run = (tmp_path / "runs" / "latest").resolve()
    assert (run / "metadata.yaml").is_file()
    assert is_closed(run)
    with AnyReader([run]) as reader:
        assert reader.message_count > 0
    for log in (run / "log").glob("*.log"):
        assert "Traceback" not in log.read_text()
    run_beside = next((tmp_path / "beside" / "runs").glob("*-osprey_gust"))
    assert is_closed(run_beside)
    vectors = {name for name in read_run(run_beside).topics if name.endswith(("/y", "/y_m", "/u"))}
    assert vectors == {"/uav2/y", "/uav2/y_m", "/uav2/u"}


def test_lost_terminal_ends_flight_with_log_and_report(tmp_path: Path) -> None:
    terminal, of_flight = pty.openpty()
    words = [
        *DEFAULT_SIGHUP,
        "setsid",
        "--ctty",
        sys.executable,
        "-m",
        *FLY,
    ]
    flight = subprocess.Popen(
        words, cwd=tmp_path, stdin=of_flight, stdout=of_flight, stderr=of_flight
    )
    os.close(of_flight)
    try:
        until(lambda: is_engaged(tmp_path), "a flight that has engaged")
        os.close(terminal)
        assert flight.wait(HANG) == 130
    finally:
        flight.kill()
        flight.wait()
    run = (tmp_path / "runs" / "latest").resolve()
    assert is_closed(run)
    assert (run / "report.html").is_file()


def test_an_early_interrupt_causes_no_traceback(start: Start) -> None:
    # Seconds of processor time; an earlier interrupt stops the interpreter itself.
    for seconds in (0.3, 0.6):
        flight = start(*FLY)
        processor_times = psutil.Process(flight.popen.pid).cpu_times

        def is_due(processor_times: Any = processor_times, seconds: float = seconds) -> bool:
            return bool(processor_times().user + processor_times().system >= seconds)

        flight.until(is_due, "the processor time of the interrupt")
        nodes = flight.children()
        flight.interrupt()
        assert flight.end() in {130, -signal.SIGINT}, flight.output
        assert "Traceback" not in flight.output
        assert not psutil.wait_procs(nodes, timeout=ENDED)[1]


def test_second_flight_is_refused_and_killed_node_ends_flight_and_killed_command_its_nodes(
    start: Start, engaged: Engaged, tmp_path: Path
) -> None:
    flight, nodes = engaged
    second_flight = start(*FLY, "--namespace", "uav2", "--runs", "beside/runs")
    second_flight.until(
        lambda: is_engaged(tmp_path / "beside"), "a flight beside it that has engaged"
    )
    nodes_beside = second_flight.children()
    third_flight = start(*FLY)
    assert third_flight.end() == 2
    assert (
        "a domain of its own for each flight: set ROS_DOMAIN_ID, or a namespace of its own"
        in third_flight.output
    )
    flight.child("rise_di_controller.main").kill()
    second_flight.popen.kill()
    assert not psutil.wait_procs(nodes + nodes_beside, timeout=ENDED)[1]
    assert flight.end() == 3
    assert "controller was killed by SIGKILL" in flight.output
    # and the recorder closed its file
    assert is_closed(next((tmp_path / "beside" / "runs").glob("*-osprey_gust")))
