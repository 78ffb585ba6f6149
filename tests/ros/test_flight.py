# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""The end of a flight over topics: by Ctrl-C, with its command, with one of its nodes."""

import os
import pty
import signal
import subprocess
import sys
from pathlib import Path

import psutil
import pytest
from rosbags.highlevel import AnyReader
from tests.conftest import REPOSITORY
from tests.ros.conftest import DEFAULT_SIGHUP, Process, Start
from tests.ros.waiting import HANG, until

from flight_analysis.closed_loop.scenario import Scenario
from flight_log.tape_reader import read_run

pytestmark = pytest.mark.package("flight_bringup")

ENDED = 10.0  # s, until no process of a flight is left: about one on an idle host

Engaged = tuple[Process, list[psutil.Process]]


@pytest.fixture
def engaged(start: Start, tmp_path: Path) -> Engaged:
    """A flight whose controller has engaged, and its four processes."""
    flight = start("flight_cli.cli", "fly", "osprey_gust")
    flight.until(lambda: is_engaged(tmp_path), "a flight that has engaged")
    return flight, flight.children()


def is_engaged(folder: Path) -> bool:
    """Whether the controller of a flight below a folder has engaged."""
    return any("ENGAGED" in log.read_text(encoding="utf-8") for log in folder.glob("runs/*/log/controller.log"))


def test_interrupt_ends_all_processes_and_keeps_log(engaged: Engaged, tmp_path: Path) -> None:
    flight, nodes = engaged
    assert len(nodes) == 4
    flight.interrupt()
    assert not psutil.wait_procs(nodes, timeout=ENDED)[1]
    assert flight.end() == 130, flight.output
    assert "Traceback" not in flight.output
    assert "outcome: interrupted" in flight.output
    assert "q (mrad/s)" in flight.output
    run = (tmp_path / "runs" / "latest").resolve()
    assert (run / "metadata.yaml").is_file()
    assert read_run(run).tape.notes == ()  # the file is not truncated
    with AnyReader([run]) as reader:
        assert reader.message_count > 0
    for log in (run / "log").glob("*.log"):
        assert "Traceback" not in log.read_text(encoding="utf-8")


def test_second_interrupt_does_not_interrupt_shutdown(engaged: Engaged, tmp_path: Path) -> None:
    flight, nodes = engaged
    flight.interrupt()
    flight.interrupt()
    psutil.wait_procs(nodes[:1], timeout=ENDED)
    flight.interrupt()
    assert not psutil.wait_procs(nodes, timeout=ENDED)[1]
    flight.end()
    assert "Traceback" not in flight.output
    assert read_run(next((tmp_path / "runs").glob("*-osprey_gust"))).tape.notes == ()  # the recorder closed its file


def test_lost_terminal_ends_flight_with_log_and_report(tmp_path: Path) -> None:
    terminal, of_flight = pty.openpty()
    words = [*DEFAULT_SIGHUP, "setsid", "--ctty", sys.executable, "-m", "flight_cli.cli", "fly", "osprey_gust"]
    flight = subprocess.Popen(words, cwd=tmp_path, stdin=of_flight, stdout=of_flight, stderr=of_flight)
    os.close(of_flight)
    try:
        until(lambda: is_engaged(tmp_path), "a flight that has engaged")
        os.close(terminal)
        assert flight.wait(HANG) == 130
    finally:
        flight.kill()
        flight.wait()
    run = (tmp_path / "runs" / "latest").resolve()
    assert read_run(run).tape.notes == ()
    assert (run / "report.html").is_file()


@pytest.mark.parametrize("seconds", [0.3, 0.6])  # of processor time; an earlier interrupt stops the interpreter itself
def test_an_early_interrupt_causes_no_traceback(seconds: float, start: Start) -> None:
    flight = start("flight_cli.cli", "fly", "osprey_gust")
    used = psutil.Process(flight.popen.pid).cpu_times
    flight.until(lambda: used().user + used().system >= seconds, "the processor time of the interrupt")
    nodes = flight.children()
    flight.interrupt()
    assert flight.end() in {130, -signal.SIGINT}, flight.output
    assert "Traceback" not in flight.output
    assert not psutil.wait_procs(nodes, timeout=ENDED)[1]


def test_two_flights_on_one_domain_do_not_mix(start: Start, engaged: Engaged, tmp_path: Path) -> None:
    second = start("flight_cli.cli", "fly", "osprey_gust")
    assert second.end() == 2
    assert "a domain of its own for each flight: set ROS_DOMAIN_ID, or a namespace of its own" in second.output
    beside = start("flight_cli.cli", "fly", "osprey_gust", "--namespace", "uav2", "--duration", "0.5", "--runs", "beside")
    assert beside.end() in {0, 4}, beside.output  # 4: a busy host
    topics = read_run(next((tmp_path / "beside").glob("*-osprey_gust"))).topics
    assert {name for name in topics if name.endswith(("/y", "/y_m", "/u"))} == {"/uav2/y", "/uav2/y_m", "/uav2/u"}
    first, _ = engaged
    first.interrupt()
    assert first.end() == 130


def test_flight_in_one_process_with_wrong_sign_ends_when_it_diverges(
    start: Start, osprey_gust: Scenario, tmp_path: Path
) -> None:
    wrong = tmp_path / "wrong.yaml"
    text = osprey_gust.path.read_text(encoding="utf-8")
    wrong.write_text(text.replace("D: [1, 1, 1, 1]", "D: [-1, 1, 1, 1]"), encoding="utf-8")
    flight = start("flight_cli.cli", "fly", str(wrong), "--in-process")
    assert flight.end() == 3
    assert "outcome: diverged at t = " in flight.output


def test_killed_node_ends_flight_and_named(engaged: Engaged) -> None:
    flight, nodes = engaged
    flight.child("rise_di_controller.main").kill()
    assert flight.end() == 3
    assert "controller was killed by SIGKILL" in flight.output
    assert not psutil.wait_procs(nodes, timeout=ENDED)[1]


def test_nodes_end_when_command_itself_killed(engaged: Engaged, tmp_path: Path) -> None:
    flight, nodes = engaged
    flight.popen.kill()
    assert not psutil.wait_procs(nodes, timeout=ENDED)[1]
    # and the recorder closed its file
    assert read_run(next((tmp_path / "runs").glob("*-osprey_gust"))).tape.notes == ()


def test_process_under_test_ends_with_process_that_runs_tests() -> None:
    long = "Process('timeit', '-n', '1', 'import time; time.sleep(600)', cwd=Path())"
    program = f"from pathlib import Path; from tests.ros.conftest import Process; print({long}.popen.pid, flush=True)"
    with subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE, cwd=REPOSITORY, text=True) as tests:
        assert tests.stdout is not None
        process = psutil.Process(int(tests.stdout.readline()))
        until(lambda: "timeit" in process.cmdline()[:3], "the program: until then it is setpriv")
        tests.kill()
        process.wait(ENDED)
