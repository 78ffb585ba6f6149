# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test lockstep flights with random faults.

A killed node is named as the cause, and a stopped one changes no byte of the log.
benchmarks/random_faults.py injects the faults, and the tests of lockstep cover single cases.
"""

import json
import time
from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path

import numpy as np
import psutil
import pytest
from tests.recordings import require_equal_bits
from tests.ros.conftest import Start
from tests.ros.flight_bringup.faults.conftest import Row, described
from tests.ros.flight_bringup.test_lockstep import ROUGH, both_cores_busy, scenario_file

from flight_analysis.closed_loop.scenario import load_scenario
from flight_analysis.closed_loop.simulate import simulate
from flight_core.outcome import STATUS_SHORTFALL
from flight_core.tape import Tape
from flight_log.tape_reader import read_run

MODULES = {
    "aircraft": "aircraft_sim.main",
    "reference_model": "reference_model.main",
    "guidance": "flight_guidance.main",
    "controller": "rise_di_controller.main",
    "recorder": "flight_recorder.main",
}
DURATION = 10.0  # s of flight time
FASTEST = 0.8  # s, in which no lockstep flight of this duration ends
# s; liveliness is never lost in a stop of 0.6 s, a third of its lease, and the rest is for a busy
# host
LONGEST_STOP = 0.4


def test_random_faults_of_lockstep_flights(
    start: Start, tmp_path: Path, lockstep_seeds: range, record: Callable[[Row], None]
) -> None:
    scenario = scenario_file(tmp_path, DURATION, "osprey_route", aircraft=ROUGH)
    expected = simulate(load_scenario(scenario))
    failed = []
    for seed in lockstep_seeds:
        random = np.random.default_rng(seed)
        role = random.choice(list(MODULES))
        kills = random.random() < 0.5
        busy = random.random() < 0.5
        name = (
            f"{role} {'killed' if kills else 'stopped'} in "
            f"lockstep{' on a busy host' if busy else ''}"
        )
        row: Row = {"case": name, "seed": seed}
        try:
            with both_cores_busy() if busy else nullcontext():
                fly_with_a_fault(
                    start, scenario, f"runs{seed}", str(role), random, expected, kills=kills
                )
        except (AssertionError, pytest.fail.Exception) as error:
            failed.append(f"{name}, seed {seed}: {error}")
            record(row | {"passed": False, "error": described(error)})
        else:
            record(row | {"passed": True})
    assert not failed, "\n".join(failed)


def fly_with_a_fault(
    start: Start,
    scenario: Path,
    runs: str,
    role: str,
    random: np.random.Generator,
    expected: Tape,
    *,
    kills: bool,
) -> None:
    """Fly in lockstep with a fault at a random instant."""
    command = start("flight_cli.cli", "fly", str(scenario), "--lockstep", "--runs", str(runs))
    folder = scenario.parent / runs
    # bytes: the flight has begun, and a chunk of the log is complete
    command.wait_for_log(folder, 200_000)
    time.sleep(random.uniform(0.0, FASTEST))  # the instant of the fault is anywhere in the flight
    victim = command.child(MODULES[role])
    if kills:
        victim.kill()
        assert command.end() == 3, command.output
        assert outcome(folder) == f"{role} was killed by SIGKILL"
        read_run(folder / "latest")
    else:
        stop(victim, random.uniform(0.02, LONGEST_STOP))
        assert command.end() == STATUS_SHORTFALL, command.output  # the route takes longer
        assert outcome(folder) == "completed, legs 0 to 6 not flown"
        require_equal_bits(read_run(folder / "latest").tape, expected)
    assert "Traceback" not in command.output


def stop(victim: psutil.Process, duration: float) -> None:
    """Stop a process with SIGSTOP, and continue it with SIGCONT."""
    victim.suspend()
    time.sleep(duration)  # the fault itself
    victim.resume()


def outcome(folder: Path) -> str:
    return str(json.loads((folder / "latest" / "summary.json").read_text())["outcome"]["sentence"])
