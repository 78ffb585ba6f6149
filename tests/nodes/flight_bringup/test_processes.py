# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test the processes of a flight, each of which is a program of the test.

What ended a flight is named, and the log has time to be closed.
"""

import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from tests.conftest import refusing
from tests.ros.waiting import HANG, until

from flight_analysis.closed_loop.scenario import Scenario
from flight_bringup import processes
from flight_bringup.graph import NodeSpec
from flight_bringup.processes import FlightProcesses, NotReadyError
from flight_core.outcome import ended_early, never_flew
from flight_core.parameters import ParameterError

# A stand-in for a FlightMonitor.
SILENT_MONITOR: Any = SimpleNamespace(
    is_ready=lambda *_: False,
    is_matched=lambda *_: False,
    has_time=lambda: True,
    ahead=lambda lead: lead,
    clock=time,
    by_clock=False,
    end_of_clock=lambda: None,
    require_free_domain=lambda: None,
)


@pytest.fixture
def only_stage(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return a first stage of one process, the module `fake.main`, whose file the test writes."""
    (tmp_path / "fake").mkdir()
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    monkeypatch.setattr(processes, "FIRST_STAGE", (NodeSpec("fake", "controller"),))
    monkeypatch.setattr(processes, "parameter_overrides", lambda *_, **__: {})
    monkeypatch.setattr(processes, "READY_TIMEOUT", 3.0)
    return tmp_path / "fake" / "main.py"


def start_stage(scenario: Scenario, run: Path) -> None:
    with FlightProcesses(scenario, run, SILENT_MONITOR, lockstep=False, one_process=False):
        pass


def test_log_line_does_not_start_flight(
    only_stage: Path, osprey_gust: Scenario, tmp_path: Path
) -> None:
    code = "import time\nprint('[INFO] [1.0] [controller]: ready', flush=True)\ntime.sleep(60)\n"
    only_stage.write_text(code)
    with refusing("timed out waiting for controller: not ready after 3 s; see the logs in "):
        start_stage(osprey_gust, tmp_path / "run")
    assert "[controller]: ready" in (tmp_path / "run" / "log" / "controller.log").read_text(
        encoding="utf-8"
    )


def test_process_ending_while_others_wait_named_at_once(
    only_stage: Path, osprey_gust: Scenario, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(processes, "READY_TIMEOUT", HANG)
    only_stage.write_text("import sys\nprint('error: no such airframe')\nsys.exit(2)\n")
    begin = time.monotonic()
    with refusing(r"^controller ended with status 2: no such airframe$"):
        start_stage(osprey_gust, tmp_path / "run")
    assert time.monotonic() - begin < HANG / 2


@pytest.mark.parametrize(
    "end, flew_never, cause",
    [
        ("import os\nos.kill(os.getpid(), 9)\n", True, "controller was killed by SIGKILL"),
        ("", True, "controller was shut down"),
        ("import sys\nsys.exit(1)\n", True, "controller ended with status 1: no output"),
        (
            "import sys\nprint('error: no such airframe')\nsys.exit(2)\n",
            False,
            "controller ended with status 2: no such airframe",
        ),
    ],
    ids=["killed", "shut down", "exception", "bad input"],
)
def test_end_before_ready_is_bad_input_only_by_its_status(
    end: str, flew_never: bool, cause: str, only_stage: Path, osprey_gust: Scenario, tmp_path: Path
) -> None:
    """`rise-di fly` ends with status 3 for NotReadyError, and otherwise with 2."""
    only_stage.write_text(end)
    with refusing(f"^{cause}$") as caught:
        start_stage(osprey_gust, tmp_path / "run")
    assert isinstance(caught.value, NotReadyError) is flew_never


def test_process_that_ends_named_with_fatal_line_not_last_one(
    only_stage: Path, osprey_gust: Scenario, tmp_path: Path
) -> None:
    lines = (
        "[FATAL] [1.0] [controller]: lost contact with aircraft",
        "[INFO] [1.1] [controller]: 3 messages in run",
    )
    only_stage.write_text(f"import sys\nprint({chr(10).join(lines)!r})\nsys.exit(3)\n")
    with refusing(r"^controller ended with status 3: lost contact with aircraft$"):
        start_stage(osprey_gust, tmp_path / "run")


def test_cause_named_that_is_before_a_long_traceback(
    only_stage: Path, osprey_gust: Scenario, tmp_path: Path
) -> None:
    """A traceback of the stack has 25 lines or more, and must not displace its own cause."""
    fatal = "[FATAL] [1.0] [controller]: unexpected exception, the node ends: ValueError: broken"
    lines = [fatal, "Traceback (most recent call last):", *(f"  frame {k}" for k in range(100))]
    only_stage.write_text(f"import sys\nprint({chr(10).join(lines)!r})\nsys.exit(1)\n")
    cause = (
        "controller ended with status 1: unexpected exception, the node ends: ValueError: broken"
    )
    with refusing(f"^{cause}$"):
        start_stage(osprey_gust, tmp_path / "run")


def test_flight_without_matched_nodes_never_begins(
    osprey_gust: Scenario, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(processes, "READY_TIMEOUT", 0.05)
    given: list[float] = []
    state = {"controller": {"ready"}, "aircraft": {"ready", "matched"}, "recorder": set[str]()}
    monitor: Any = SimpleNamespace(**vars(SILENT_MONITOR))
    monitor.is_ready = lambda name, _: "ready" in state[name]
    monitor.is_matched = lambda name, _: "matched" in state[name]
    monitor.start = given.append
    flight = FlightProcesses(osprey_gust, tmp_path, monitor, lockstep=False, one_process=False)
    popen = SimpleNamespace(pid=1, poll=lambda: None)
    flight.processes = [SimpleNamespace(node=NodeSpec("fake", name), popen=popen) for name in state]  # type: ignore[misc]
    late = "controller has an input without a publisher; recorder not ready after 0.05 s"
    assert flight.begin() == never_flew(late)
    assert given == []
    state |= {name: {"ready", "matched"} for name in state}
    before = time.time()
    assert flight.begin() is None
    assert given == [flight.start_time]
    # half a second later, on a tenth of a second
    assert before + 0.4 <= flight.start_time <= time.time() + 0.6


def test_flight_by_a_clock_that_never_comes_is_told_so(
    only_stage: Path, osprey_gust: Scenario, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    only_stage.write_text("import time\ntime.sleep(60)\n")
    monkeypatch.setattr(processes, "READY_TIMEOUT", 0.5)
    monitor: Any = SimpleNamespace(**vars(SILENT_MONITOR))
    monitor.is_ready = lambda *_: True
    monitor.has_time = lambda: False
    expected = "/clock: no message of a simulator after 0.5 s"
    with (
        pytest.raises(NotReadyError, match=expected),
        FlightProcesses(osprey_gust, tmp_path, monitor, lockstep=False, one_process=False),
    ):
        pass


def test_no_node_starts_beside_another_flight(
    only_stage: Path, osprey_gust: Scenario, tmp_path: Path
) -> None:
    """A controller would engage on the y of the other flight before it is refused."""
    only_stage.write_text("import time\ntime.sleep(60)\n")

    def refuse() -> None:
        raise ParameterError("found 1 publishers of /y already")

    monitor: Any = SimpleNamespace(**vars(SILENT_MONITOR))
    monitor.require_free_domain = refuse
    with (
        refusing("^found 1 publishers of /y already$"),
        FlightProcesses(osprey_gust, tmp_path, monitor, lockstep=False, one_process=False),
    ):
        pass
    assert not (tmp_path / "log").exists(), "a log a node that has started"


LOSES_CONTACT = (
    "import sys\nprint('[FATAL] [1.0] [recorder]: lost contact with aircraft')\nsys.exit(6)\n"
)


@pytest.mark.parametrize(
    "end, cause",
    [
        ("import os\nos.kill(os.getpid(), 9)\n", "aircraft was killed by SIGKILL"),
        (
            "import sys\nprint('[FATAL] [1.0] [aircraft]: diverged')\nsys.exit(3)\n",
            "aircraft ended with status 3: diverged",
        ),
    ],
    ids=("killed", "diverged"),
)
def test_cause_named_when_recorder_that_lost_contact_has_ended_too(
    end: str, cause: str, only_stage: Path, osprey_gust: Scenario, tmp_path: Path
) -> None:
    only_stage.write_text(LOSES_CONTACT)
    (tmp_path / "cause").mkdir()
    (tmp_path / "cause" / "main.py").write_text(end)
    flight = FlightProcesses(
        osprey_gust, tmp_path, SILENT_MONITOR, lockstep=True, one_process=False
    )
    for node in (NodeSpec("fake", "recorder"), NodeSpec("cause", "aircraft")):
        flight.processes.append(
            processes.NodeProcess(node, osprey_gust.path, {}, tmp_path / f"{node.executable}.log")
        )
    for process in flight.processes:
        process.popen.wait()
    assert flight.ended() == ended_early(cause)
    flight.stop()


CLOSES_SLOWLY = """
import signal, time
signal.signal(signal.SIGTERM, signal.default_int_handler)
try:
    print("up", flush=True)
    time.sleep(60)
except KeyboardInterrupt:
    time.sleep(1.0)
    print("closed")
"""


@pytest.mark.parametrize("executable", ["recorder", "one_process"])
def test_process_that_closes_log_has_time_for_it(
    executable: str,
    only_stage: Path,
    osprey_gust: Scenario,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    only_stage.write_text(CLOSES_SLOWLY)
    node = NodeSpec("fake", executable)
    monkeypatch.setattr(processes, executable.upper(), node)
    monkeypatch.setattr(processes, "STOP_TIMEOUT", 0.1)  # of the other nodes
    flight = FlightProcesses(
        osprey_gust, tmp_path, SILENT_MONITOR, lockstep=False, one_process=False
    )
    process = processes.NodeProcess(node, osprey_gust.path, {}, tmp_path / "node.log")
    flight.processes.append(process)
    until(lambda: "up" in process.lines, "the process is up")
    flight.stop()
    assert "closed" in process.lines


IGNORES_THE_END = """
import signal, time
signal.signal(signal.SIGTERM, signal.SIG_IGN)
print("up", flush=True)
time.sleep(600)
"""


def test_processes_that_had_to_be_killed_are_counted_and_named(
    only_stage: Path, osprey_gust: Scenario, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    only_stage.write_text(IGNORES_THE_END)
    (tmp_path / "ends").mkdir()
    (tmp_path / "ends" / "main.py").write_text(
        "print('up', flush=True)\nimport time\ntime.sleep(600)"
    )
    monkeypatch.setattr(processes, "STOP_TIMEOUT", 0.5)
    lines: list[str] = []
    flight = FlightProcesses(
        osprey_gust,
        tmp_path,
        SILENT_MONITOR,
        lockstep=False,
        one_process=False,
        announce=lines.append,
    )
    for node in (NodeSpec("fake", "aircraft"), NodeSpec("ends", "guidance")):
        log = tmp_path / f"{node.executable}.log"
        flight.processes.append(processes.NodeProcess(node, osprey_gust.path, {}, log))
    for process in flight.processes:
        until(lambda process=process: "up" in process.lines, "the process is up")  # type: ignore[misc]  # bound in the loop
    flight.stop()
    assert lines == ["1 of 2 processes did not end and had to be killed: aircraft"]
    flight.stop()
    assert len(lines) == 1
