# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""The topic `node_state`: readiness and completion of nodes, for late subscribers and for the process runner."""

import json
import time
from pathlib import Path
from types import SimpleNamespace

import pytest
from diagnostic_msgs.msg import KeyValue
from sensor_msgs.msg import JointState
from tests.ros.conftest import Start
from tests.ros.peer import Peer, peer, stamp_ns
from tests.ros.waiting import HANG

from flight_analysis.closed_loop.scenario import Scenario
from flight_bringup import processes
from flight_bringup.graph import ONE_PROCESS, NodeSpec, parameter_overrides
from flight_bringup.monitor import FlightMonitor
from flight_bringup.processes import FlightProcesses
from flight_core.parameters import ParameterError
from flight_ros.messages import instant
from flight_ros.topics import NODE_STATE, PUBLISH, START, STATE, STATES

pytestmark = pytest.mark.package("flight_bringup")

PEER_TOPICS = ("/y",)


def received_states(peer_node: Peer, topic: str = NODE_STATE.name) -> dict[str, str]:
    """The newest state by process, filled while the peer spins."""
    states: dict[str, str] = {}
    peer_node.node.create_subscription(KeyValue, topic, lambda message: states.update({message.key: message.value}), STATES)
    return states


def test_late_subscriber_gets_state_of_each_process(start_node: Start) -> None:
    packages = {"controller": "rise_di_controller", "aircraft": "aircraft_sim"}
    nodes = {name: start_node(package, "-r", "__ns:=/one") for name, package in packages.items()}
    for node in nodes.values():
        node.wait_for("ready")
    with peer(topics=()) as peer_node:
        states = received_states(peer_node, "/one/node_state")
        # The aircraft has the publisher of u; the controller lacks that of y_m.
        expected = {"controller": "ready", "aircraft": "matched"}
        peer_node.until(lambda: states == {f"/one/{name}#{node.popen.pid}": expected[name] for name, node in nodes.items()})


def test_aircraft_completes_lockstep_flight_and_process_has_id(
    start_node: Start, osprey_gust: Scenario, tmp_path: Path
) -> None:
    short = osprey_gust.vary(flight={"duration": 0.2})
    overrides = parameter_overrides(ONE_PROCESS, short, tmp_path, 0.0, lockstep=True)
    words = [word for name, value in overrides.items() for word in ("-p", f"{name}:={json.dumps(value)}")]
    flight = start_node("flight_bringup", *words).wait_for("flight completed at t = 0.2 s")
    with peer(topics=()) as peer_node:
        states = received_states(peer_node)
        roles = ("aircraft", "controller", "recorder", "reference_model")
        expected = {f"/{role}#{flight.popen.pid}": "completed" if role == "aircraft" else "ready" for role in roles}
        peer_node.until(lambda: states == expected)


def test_monitor_tells_node_from_one_of_another_flight(start_node: Start, osprey_gust: Scenario) -> None:
    node = start_node("rise_di_controller")
    with FlightMonitor(osprey_gust.controller.outputs, lockstep=True) as monitor:
        pid = node.popen.pid
        node.until(lambda: monitor.is_ready("controller", pid))
        assert not monitor.is_ready("controller", pid + 1)
        assert not monitor.is_ready("recorder", pid)


@pytest.fixture
def only_stage(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A first stage of one process: the module `fake.main`, whose file the test writes."""
    (tmp_path / "fake").mkdir()
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    monkeypatch.setattr(processes, "FIRST_STAGE", (NodeSpec("fake", "controller"),))
    monkeypatch.setattr(processes, "parameter_overrides", lambda *_, **__: {})
    monkeypatch.setattr(processes, "READY_TIMEOUT", 3.0)
    return tmp_path / "fake" / "main.py"


def start_stage(scenario: Scenario, run: Path) -> None:
    with (
        FlightMonitor(scenario.controller.outputs, lockstep=True) as monitor,
        FlightProcesses(scenario, run, monitor, lockstep=False, one_process=False),
    ):
        pass


def test_log_line_does_not_start_flight(only_stage: Path, osprey_gust: Scenario, tmp_path: Path) -> None:
    code = "import time\nprint('[INFO] [1.0] [controller]: ready', flush=True)\ntime.sleep(60)\n"
    only_stage.write_text(code, encoding="utf-8")
    with pytest.raises(ParameterError, match="timed out waiting for controller: not ready after 3 s; see the logs in "):
        start_stage(osprey_gust, tmp_path / "run")
    assert "[controller]: ready" in (tmp_path / "run" / "log" / "controller.log").read_text(encoding="utf-8")


def test_process_ending_while_others_wait_named_at_once(
    only_stage: Path, osprey_gust: Scenario, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(processes, "READY_TIMEOUT", HANG)
    only_stage.write_text("import sys\nprint('error: no such airframe')\nsys.exit(2)\n", encoding="utf-8")
    begin = time.monotonic()
    with pytest.raises(ParameterError, match=r"^controller ended with status 2: no such airframe$"):
        start_stage(osprey_gust, tmp_path / "run")
    assert time.monotonic() - begin < HANG / 2


def test_process_that_ends_named_with_fatal_line_not_last_one(only_stage: Path, osprey_gust: Scenario, tmp_path: Path) -> None:
    lines = "[FATAL] [1.0] [controller]: lost contact with aircraft", "[INFO] [1.1] [controller]: 3 messages in run"
    only_stage.write_text(f"import sys\nprint({chr(10).join(lines)!r})\nsys.exit(3)\n", encoding="utf-8")
    with pytest.raises(ParameterError, match=r"^controller ended with status 3: lost contact with aircraft$"):
        start_stage(osprey_gust, tmp_path / "run")


def test_flight_without_matched_nodes_never_begins(
    osprey_gust: Scenario, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(processes, "READY_TIMEOUT", 0.05)
    given: list[float] = []
    state = {"controller": {"ready"}, "aircraft": {"ready", "matched"}, "recorder": set[str]()}
    monitor = SimpleNamespace(
        is_ready=lambda name, _: "ready" in state[name], is_matched=lambda name, _: "matched" in state[name], start=given.append
    )
    flight = FlightProcesses(osprey_gust, tmp_path, monitor, lockstep=False, one_process=False)  # type: ignore[arg-type]
    popen = SimpleNamespace(pid=1, poll=lambda: None)
    flight.processes = [SimpleNamespace(node=NodeSpec("fake", name), popen=popen) for name in state]  # type: ignore[misc]
    late = "controller has an input without a publisher; recorder not ready after 0.05 s"
    assert flight.begin() == f"never flew: {late}"
    assert given == []
    state |= {name: {"ready", "matched"} for name in state}
    assert flight.begin() == ""
    assert given == [flight.start_time] == [pytest.approx(time.time() + 0.5, abs=0.4)]


def test_aircraft_waits_for_start(start_node: Start, peer_node: Peer) -> None:
    """It is matched with the publisher of u, and its y have stamps from t = 0 on."""
    aircraft = start_node("aircraft_sim", "-p", "start_time:=-1.0").wait_for("ready")
    states = received_states(peer_node)
    send = peer_node.node.create_publisher(START.type, START.name, STATE)
    peer_node.until(lambda: set(states.values()) == {"ready"})
    peer_node.node.create_publisher(JointState, "u", PUBLISH)
    peer_node.until(lambda: states[f"/aircraft#{aircraft.popen.pid}"] == "matched")
    assert peer_node.received["/y"] == []
    start_ns = time.time_ns() + 200_000_000
    send.publish(instant(start_ns))
    peer_node.until(lambda: bool(peer_node.received["/y"]))
    since_ns = stamp_ns(peer_node.received["/y"][0]) - start_ns  # whole periods of 2 ms: on a busy host not the first
    assert since_ns >= 0
    assert since_ns % 2_000_000 == 0


LOSES_CONTACT = "import sys\nprint('[FATAL] [1.0] [recorder]: lost contact with aircraft')\nsys.exit(3)\n"


@pytest.mark.parametrize(
    ("end", "cause"),
    [
        ("import os\nos.kill(os.getpid(), 9)\n", "aircraft was killed by SIGKILL"),
        ("import sys\nprint('[FATAL] [1.0] [aircraft]: diverged')\nsys.exit(3)\n", "aircraft ended with status 3: diverged"),
    ],
    ids=("killed", "diverged"),
)
def test_cause_named_when_recorder_that_lost_contact_has_ended_too(
    end: str, cause: str, only_stage: Path, osprey_gust: Scenario, tmp_path: Path
) -> None:
    only_stage.write_text(LOSES_CONTACT, encoding="utf-8")
    (tmp_path / "cause").mkdir()
    (tmp_path / "cause" / "main.py").write_text(end, encoding="utf-8")
    with FlightMonitor(osprey_gust.controller.outputs, lockstep=True) as monitor:
        flight = FlightProcesses(osprey_gust, tmp_path, monitor, lockstep=True, one_process=False)
        for node in (NodeSpec("fake", "recorder"), NodeSpec("cause", "aircraft")):
            flight.processes.append(processes.NodeProcess(node, osprey_gust.path, {}, tmp_path / f"{node.executable}.log"))
        for process in flight.processes:
            process.popen.wait()
        assert flight.ended_early() == cause
        flight.stop()


def test_state_of_node_in_another_flight_does_not_start_this_one(
    start_node: Start, only_stage: Path, osprey_gust: Scenario, tmp_path: Path
) -> None:
    other = start_node("rise_di_controller").wait_for("ready")
    only_stage.write_text("import time\ntime.sleep(60)\n", encoding="utf-8")
    with pytest.raises(ParameterError, match="timed out waiting for controller"):
        start_stage(osprey_gust, tmp_path / "run")
    assert other.popen.poll() is None


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
    executable: str, only_stage: Path, osprey_gust: Scenario, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, peer_node: Peer
) -> None:
    only_stage.write_text(CLOSES_SLOWLY, encoding="utf-8")
    node = NodeSpec("fake", executable)
    monkeypatch.setattr(processes, executable.upper(), node)
    monkeypatch.setattr(processes, "STOP_TIMEOUT", 0.1)  # of the other nodes
    with FlightMonitor(osprey_gust.controller.outputs, lockstep=True) as monitor:
        flight = FlightProcesses(osprey_gust, tmp_path, monitor, lockstep=False, one_process=False)
        process = processes.NodeProcess(node, osprey_gust.path, {}, tmp_path / "node.log")
        flight.processes.append(process)
        peer_node.until(lambda: "up" in process.lines)
        flight.stop()
    assert "closed" in process.lines
