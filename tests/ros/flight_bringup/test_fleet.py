# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test fleets over topics: in lockstep they fly as single flights.

In real time no aircraft affects another.
"""

import re
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import psutil
from tests.ros.conftest import Start, is_closed

from flight_analysis.closed_loop.simulate import simulate
from flight_bringup.fleet import fly_fleet, new_runs, read_fleet
from flight_log.tape_reader import read_run


def test_lockstep_fleet_flies_as_each_aircraft_alone(tmp_path: Path) -> None:
    file = tmp_path / "fleet.yaml"
    file.write_text(
        "{lockstep: true, composed: true, duration: 0.6, aircraft: {one: {}, two: {start: "
        "{east: 90.0, heading: 1.0}}}}",
    )
    fleet = read_fleet(file)
    for flight in fly_fleet(fleet, new_runs(fleet, tmp_path / "runs"), lambda name, t, shown: None):
        assert str(flight.outcome) == "completed"
        recorded = read_run(flight.run)
        tape = simulate(flight.member.scenario)
        assert {
            topic.split("/")[1] for topic in recorded.topics if topic.endswith(("/y", "/u"))
        } == {flight.member.name}
        for name in ("y", "y_m", "u_m", "u", "pose"):
            of_log = recorded.tape[name]
            of_simulation = tape[name]
            assert len(of_log.stamp_ns) > 20
            assert of_log.stamp_ns.tobytes() == of_simulation.stamp_ns.tobytes()
            values = np.column_stack([of_log[channel] for channel in of_simulation.names])
            assert values.tobytes() == of_simulation.values.tobytes(), (flight.member.name, name)


def test_killed_aircraft_leaves_other_untouched_and_interrupt_ends_all(
    start: Start, tmp_path: Path
) -> None:
    (tmp_path / "fleet.yaml").write_text("{composed: true, aircraft: {one: {}, two: {}}}")
    fleet = start("flight_cli.cli", "fly", "fleet.yaml", "--real-time")

    def engaged(name: str) -> bool:
        return any(
            "OFF -> ENGAGED" in log.read_text()
            for log in tmp_path.glob(f"runs/*-{name}-*/log/one_process.log")
        )

    fleet.until(lambda: engaged("one") and engaged("two"), "both aircraft engaged")
    target = [sys.executable, "-m", "flight_cli.cli", "guide", "heading=90"]
    missing = subprocess.Popen(target, stderr=subprocess.PIPE, text=True)
    nodes = fleet.children()
    next(node for node in nodes if "__ns:=/one" in node.cmdline()).kill()
    commanded = subprocess.run(
        [*target, "--namespace", "two"], check=False, capture_output=True, text=True
    )
    assert commanded.returncode == 0, commanded.stderr
    assert re.search("aircraft fly in (/one, )?/two: --namespace", missing.communicate()[1])
    fleet.interrupt()
    assert fleet.end() == 130, fleet.output
    assert not psutil.wait_procs(nodes, timeout=10.0)[1]
    assert f"one_process was killed by {signal.SIGKILL.name}" in fleet.output
    assert "Traceback" not in fleet.output
    run = next(tmp_path.glob("runs/*-two-*"))
    assert is_closed(run)
    assert str(read_run(run).tape.outcome) == "interrupted"
