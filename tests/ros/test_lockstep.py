# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Lockstep over real DDS: repeatable to the byte, equal to the loop in one process, and free of deadlocks."""

import json
import re
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from types import MappingProxyType

import pytest
import yaml
from mcap.records import Channel, Message
from mcap.stream_reader import StreamReader
from tests.ros.conftest import Process, Start

from flight_analysis.closed_loop.scenario import load_scenario
from flight_analysis.closed_loop.simulate import simulate
from flight_bringup.fly import fly_over_topics
from flight_bringup.scenarios import find_scenario
from flight_log.tape_reader import read_run

TOPICS = ("/y", "/y_m", "/u", "/internals", "/truth")

# All random inputs of a scenario, and late or lost samples: at their instants a message has no channels.
ROUGH = {
    "turbulence": {"altitude": 100.0, "wind": 7.7, "seed": 1},
    "uncertainty": {"A": 0.2, "B": 0.2, "seed": 7},
    "gusts": {"vertical": {"start": 0.5, "speed": 10.12, "length": 15.24}},
    "sensors": {"noise": [0.0017, 0.03, 0.0017, 0.0017], "drift": [0.0001] * 4, "delay": 0.01, "dropout": 0.2, "seed": 7},
}


def scenario_file(
    folder: Path, duration: float, name: str = "osprey_servo", aircraft: Mapping[str, object] = MappingProxyType({})
) -> Path:
    """A shortened scenario with changes to its aircraft."""
    tree = yaml.safe_load(find_scenario(name).path.read_text(encoding="utf-8"))
    tree["/**/flight"]["ros__parameters"]["duration"] = duration
    tree["/**/aircraft"]["ros__parameters"] |= aircraft
    path = folder / "rough.yaml"
    path.write_text(yaml.safe_dump(tree), encoding="utf-8")
    return path


def fly(start: Start, scenario: Path, runs: str, *options: str) -> Path:
    """Fly to the end; return the folder of the run."""
    process = start("flight_cli.cli", "fly", str(scenario), "--lockstep", "--runs", runs, *options)
    assert process.end(timeout=120) == 0, process.output
    return scenario.parent / runs / "latest"


def payloads(run: Path) -> dict[str, list[bytes]]:
    """The bytes of every message by topic, in the order of sending."""
    topics: dict[int, str] = {}
    by_topic: dict[str, list[tuple[int, bytes]]] = {}
    with min(run.glob("*.mcap")).open("rb") as stream:
        for record in StreamReader(stream).records:
            if isinstance(record, Channel):
                topics[record.id] = record.topic
            elif isinstance(record, Message):
                by_topic.setdefault(topics[record.channel_id], []).append((record.sequence, record.data))
    return {topic: [data for _, data in sorted(messages)] for topic, messages in by_topic.items()}


@contextmanager
def both_cores_busy() -> Iterator[None]:
    processes = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(2)]
    try:
        yield
    finally:
        for process in processes:
            process.kill()
            process.wait()


def test_runs_repeat_to_the_byte_on_a_busy_host_in_one_process_and_without_ros(start: Start, tmp_path: Path) -> None:
    scenario = scenario_file(tmp_path, 4.0, aircraft=ROUGH)
    first = payloads(fly(start, scenario, "idle"))
    with both_cores_busy():
        second = payloads(fly(start, scenario, "busy"))
    third = payloads(fly(start, scenario, "together", "--one-process"))
    for topic in TOPICS:
        assert first[topic] == second[topic] == third[topic], topic
    assert "airframe.yaml" in [path.name for path in (tmp_path / "idle" / "latest").iterdir()]  # the sampled matrices
    assert len(first["/y"]) == 4 * 500 + 1  # one at each instant, also without a sample
    assert len(first["/u"]) == 4 * 100 + 1
    tape, recorded = simulate(load_scenario(scenario)), read_run(tmp_path / "idle" / "latest").tape
    assert len(tape["y"].stamp_ns) < 4 * 500  # samples were lost
    for name, signal_ in tape.signals.items():
        assert signal_.names == recorded[name].names
        assert signal_.stamp_ns.tobytes() == recorded[name].stamp_ns.tobytes(), name
        assert signal_.values.tobytes() == recorded[name].values.tobytes(), name


def test_twenty_successive_flights_complete(tmp_path: Path) -> None:
    scenario = load_scenario(scenario_file(tmp_path, 0.5))
    for k in range(20):
        run = tmp_path / f"run{k}"
        assert fly_over_topics(scenario, run, lambda t, shown: None, lockstep=True, one_process=k % 4 == 3) == "completed"
        assert len(payloads(run)["/u"]) == 51


def nodes(start: Start, scenario: Path) -> dict[str, Process]:
    """The four nodes, started one by one as a user does, in an endless lockstep flight."""
    overrides = {
        "recorder": ("flight_recorder", ["directory:=run"]),
        "controller": ("rise_di_controller", ["y_rate:=500.0"]),
        "reference_model": ("reference_model", []),
        "aircraft": ("aircraft_sim", ["control_rate:=100.0", "recorded:=true"]),
    }
    return {
        role: start(
            f"{package}.main",
            *("--ros-args", "--params-file", str(scenario), "-p", "lockstep:=true"),
            *(word for item in items for word in ("-p", item)),
        )
        for role, (package, items) in overrides.items()
    }


def wait_until_recorded(folder: Path, process: Process) -> None:
    """Wait until the log has 1 MB. By then the liveliness monitor of every node is active."""
    deadline = time.monotonic() + 60.0
    while sum(path.stat().st_size for path in folder.rglob("*.mcap")) < 1_000_000:
        assert time.monotonic() < deadline, process.output
        assert process.popen.poll() is None, process.output
        time.sleep(0.01)  # nothing signals the growth of a file


@pytest.mark.parametrize("victim", ["aircraft", "reference_model", "controller", "recorder"])
def test_other_nodes_end_within_two_seconds_of_a_kill_and_name_the_lost_peer(victim: str, start: Start, tmp_path: Path) -> None:
    processes = nodes(start, scenario_file(tmp_path, 1e6))
    wait_until_recorded(tmp_path / "run", processes["aircraft"])
    processes[victim].popen.send_signal(signal.SIGKILL)
    killed = time.monotonic()
    for role, process in processes.items():
        if role != victim:
            assert process.end(timeout=10.0) == 3, process.output
            # The liveliness lease is one second; the other second is for a busy host.
            assert time.monotonic() - killed < 2.0, role
            assert f"lost contact with {victim}" in process.output, role
    assert len(read_run(tmp_path / "run").tape["y"].stamp_ns) > 100


def test_a_killed_node_ends_the_flight_with_its_name_in_the_summary(start: Start, tmp_path: Path) -> None:
    command = start("flight_cli.cli", "fly", str(scenario_file(tmp_path, 1e5)), "--lockstep", "--runs", "runs")
    wait_until_recorded(tmp_path / "runs", command)
    node = next(child for child in command.children() if "reference_model.main" in child.cmdline())
    node.send_signal(signal.SIGKILL)
    assert command.end() == 3
    outcome = json.loads((tmp_path / "runs" / "latest" / "summary.json").read_text(encoding="utf-8"))["outcome"]
    assert outcome == "reference_model was killed by SIGKILL"


def test_a_diverged_aircraft_ends_the_flight_with_the_reason_and_a_log(start: Start, tmp_path: Path) -> None:
    scenario = scenario_file(tmp_path, 60.0, "osprey_gust")  # it has no saturation that would limit the wrong input
    text = scenario.read_text(encoding="utf-8")
    wrong, count = re.subn(r"D: *\n( *- 1\n){4}", lambda match: match.group().replace("- 1", "- -1", 1), text)
    assert count == 1
    scenario.write_text(wrong, encoding="utf-8")
    command = start("flight_cli.cli", "fly", str(scenario), "--lockstep", "--runs", "runs")
    assert command.end(timeout=60) == 3, command.output
    summary = json.loads((tmp_path / "runs" / "latest" / "summary.json").read_text(encoding="utf-8"))
    assert re.fullmatch(r"aircraft ended with status 3: diverged at t = [\d.]+ s", summary["outcome"])
    assert summary["duration"] > 1.0
