# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test lockstep over real DDS, which is repeatable to the byte.

It is equal to the loop in one process, and has no deadlocks.
"""

import json
import re
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from mcap.reader import make_reader
from tests import recordings
from tests.recordings import require_equal_bits
from tests.ros.conftest import Process, Start
from tests.ros.waiting import HostDelays

from aircraft_sim.airframes.airframe import load_airframe
from flight_analysis.closed_loop.replay import replay
from flight_analysis.closed_loop.scenario import load_scenario
from flight_analysis.closed_loop.scenario_library import find_scenario
from flight_analysis.closed_loop.simulate import simulate
from flight_bringup.fly import fly_over_topics
from flight_core.outcome import COMPLETED, STATUS_LOST_CONTACT, STATUS_SHORTFALL
from flight_core.parameters import flatten, nest
from flight_design.gains.feedforward_model import with_feedforward
from flight_log.tape_reader import read_run

TOPICS = ("/y", "/y_m", "/u", "/internals", "/truth")

# All random inputs of a scenario, and late or lost samples: at their instants a message has no
# channels.
ROUGH = {
    "turbulence": {"altitude": 100.0, "wind": 7.7, "seed": 1},
    "uncertainty": {"A": 0.2, "B": 0.2, "seed": 7},
    "gusts": {"vertical": {"start": 0.5, "speed": 10.12, "length": 15.24}},
    "sensors": {
        "noise": [0.0017, 0.03, 0.0017, 0.0017],
        "drift": [0.0001] * 4,
        "delay": 0.01,
        "dropout": 0.2,
        "seed": 7,
    },
}

AT_200_HZ: dict[str, dict[str, Any]] = {
    "aircraft": {"rate": 200.0, "step": 0.005},
    "reference_model": {"rate": 200.0},
}
"""Sections of a flight in real time that costs less than with y and y_m 500 times a second."""


def scenario_file(
    folder: Path, duration: float, name: str = "osprey_servo", **sections: Mapping[str, Any]
) -> Path:
    """Return a shortened scenario with changed sections."""
    return recordings.scenario_file(
        folder / "rough.yaml", find_scenario(name).path, flight={"duration": duration}, **sections
    )


def fly(start: Start, scenario: Path, runs: str, *options: str, status: int = 0) -> Path:
    """Fly to the end, and return the folder of the run."""
    command = start(
        "flight_cli.cli", "fly", str(scenario), "--lockstep", "--runs", str(runs), *options
    )
    assert command.end() == status, command.output
    return scenario.parent / runs / "latest"


def payloads(run: Path) -> dict[str, list[bytes]]:
    """Return the bytes of every message by topic, in the order of sending, by mcap's own reader."""
    by_topic: dict[str, list[tuple[int, bytes]]] = {}
    with min(run.glob("*.mcap")).open("rb") as stream:
        for _, channel, message in make_reader(stream).iter_messages():
            by_topic.setdefault(channel.topic, []).append((message.sequence, message.data))
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


def with_limits(path: Path) -> Path:
    """Return the scenario with feedforward, and with limits at which u saturates."""
    controller = with_feedforward(load_scenario(path).controller, load_airframe("osprey"))
    limits = {"lower": [-0.05] * 4, "upper": [0.01] * 4, "slew": [0.3] * 4}
    as_json = json.loads(json.dumps(nest(dict(flatten(controller.model_dump())))))
    return recordings.scenario_file(path, path, controller=as_json | limits)


def test_runs_repeat_to_byte_on_busy_host_in_one_process_and_without_ros_and_are_replayed(
    start: Start, tmp_path: Path
) -> None:
    pulses = {"q": {"start": [0.2], "stop": [1.0], "value": [0.1]}}
    scenario = with_limits(
        scenario_file(tmp_path, 1.5, aircraft=ROUGH, reference_model={"pulses": pulses})
    )
    with both_cores_busy():
        busy = tmp_path / "busy"  # without the command, in the process of its caller
        assert (
            fly_over_topics(load_scenario(scenario), busy, lambda t, shown: None, lockstep=True)
            == COMPLETED
        )
    runs = [
        busy,
        # with its gust at the limits q is off by more than the linear loop
        fly(start, scenario, "idle", status=STATUS_SHORTFALL),
        fly(start, scenario, "together", "--composed", status=STATUS_SHORTFALL),
    ]
    first, *others = map(payloads, runs)
    for topic in TOPICS:
        assert all(first[topic] == payload[topic] for payload in others), topic
    assert "airframe.yaml" in [path.name for path in runs[1].iterdir()]  # the sampled matrices
    assert len(first["/y"]) == 750 + 1  # one at each instant, also without a sample
    assert len(first["/u"]) == 150 + 1
    tape = simulate(load_scenario(scenario))
    recorded = read_run(runs[1]).tape
    assert len(tape["y"].stamp_ns) < 750  # samples were lost
    require_equal_bits(recorded, tape)
    assert set(recorded["internals"].group("limited").values.ravel()) == {0.0, 1.0, 2.0}
    assert recorded["internals"].group("u_ff").values.any()
    for run in runs[1:]:
        result = replay(run)
        assert result.is_equal()
        assert result.is_compared.sum() == len(result.is_compared) > 100
        assert not result.notes


def nodes(start: Start, scenario: Path, run: str) -> dict[str, Process]:
    """Start the four nodes one by one, as a user does, in a lockstep flight without an end."""
    overrides = {
        "recorder": (
            "flight_recorder",
            ["-p", f"directory:={run}", "-p", f"scenario_file:={scenario}"],
        ),
        "controller": ("rise_di_controller", ["-p", "y_rate:=500.0"]),
        "reference_model": ("reference_model", []),
        "aircraft": ("aircraft_sim", ["-p", "control_rate:=100.0", "-p", "recorded:=true"]),
    }
    shared = ("--ros-args", "--params-file", str(scenario), "-p", "lockstep:=true")
    return {
        role: start(f"{package}.main", *shared, *words)
        for role, (package, words) in overrides.items()
    }


FIRST_CHUNKS = 100_000  # bytes of a log
LOG_SIZE = 1_000_000  # bytes; by then the liveliness monitor of every node is active


def test_other_nodes_end_within_three_seconds_of_kill_and_name_it(
    start: Start, tmp_path: Path, host_delays: HostDelays
) -> None:
    scenario = scenario_file(tmp_path, 1e6)
    for victim in ("aircraft", "controller", "reference_model", "recorder"):
        processes = nodes(start, scenario, victim)
        processes["aircraft"].wait_for_log(tmp_path / victim, LOG_SIZE)
        processes[victim].popen.kill()
        killed = time.time()
        for role, process in processes.items():
            if role != victim:
                assert process.end() == STATUS_LOST_CONTACT, process.output
                # The liveliness lease is 1.8 s; the rest is for a busy host.
                assert time.time() - killed < 3.0 + host_delays.since(killed), role
                assert f"lost contact with {victim}" in process.output, role
        log = read_run(tmp_path / victim)
        assert any("is truncated" in note for note in log.tape.notes) == (victim == "recorder")
        result = replay(log)
        assert result.is_equal()
        # the last complete chunk can end between the internals of a tick and its y
        assert result.is_compared.sum() >= len(result.is_compared) - 1 > 100


def test_diverged_aircraft_ends_flight_with_reason_and_log(start: Start, tmp_path: Path) -> None:
    wrong = {"D": [-1, 1, 1, 1]}
    # no saturation limits the wrong input
    scenario = scenario_file(tmp_path, 60.0, "osprey_gust", controller=wrong)
    command = start("flight_cli.cli", "fly", str(scenario), "--lockstep", "--runs", "runs")
    assert command.end() == 3, command.output
    summary = json.loads((tmp_path / "runs" / "latest" / "summary.json").read_text())
    assert re.fullmatch(
        r"aircraft ended with status 3: diverged at t = [\d.]+ s", summary["outcome"]["sentence"]
    )
    assert summary["duration"] > 1.0
