# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test a flight over topics in real time: its log, and its accuracy against one process."""

import json
import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbags.highlevel import AnyReader
from tests.ros.conftest import Start

from flight_analysis.closed_loop.scenario import Scenario, load_scenario
from flight_analysis.closed_loop.simulate import simulate
from flight_analysis.metrics.errors import tracking_error
from flight_core.modes import Mode
from flight_core.outcome import STATUS_HOST
from flight_core.vectors import FloatArray
from flight_log.tape_reader import read_run

pytestmark = pytest.mark.alone

DURATION = 8.0


@pytest.fixture
def short_scenario(osprey_gust: Scenario, tmp_path: Path) -> Path:
    """Return the default scenario with a command on each channel and both gusts within 8 s."""
    text = osprey_gust.path.read_text()
    for old, new in (
        ("duration: 60.0", f"duration: {DURATION}"),
        ("start: 40.0", "start: 4.0"),
        ("start: 46.0", "start: 6.0"),
        ("{start: [10.0], stop: [30.0]", "{start: [1.0], stop: [30.0]"),
        (
            "{start: [12.0, 17.0, 20.0, 24.0], stop: [13.5, 18.5,",
            "{start: [1.0, 4.0, 20.0, 24.0], stop: [2.0, 5.0,",
        ),
    ):
        assert old in text
        text = text.replace(old, new)
    path = tmp_path / "short.yaml"
    path.write_text(text)
    return path


RATES = {"/y": 500, "/y_m": 500, "/truth": 500, "/u": 100, "/internals": 100}  # Hz


def rms(error: FloatArray) -> FloatArray:
    figures: FloatArray = np.sqrt(np.mean(error**2, axis=0))
    return figures


def test_flight_over_topics_recorded_and_as_accurate_as_in_one_process(
    start: Start, short_scenario: Path, tmp_path: Path
) -> None:
    scenario = load_scenario(short_scenario)
    bound = 1.5 * rms(tracking_error(simulate(scenario)).values)
    # The bounds are for the loop, not for the host. Such a flight is repeated, at most three times.
    # Host delays count that made the controller late by more than a quarter of its period, or the
    # aircraft or the reference model by more than a sample. Those of u on its way to the aircraft
    # are in no topic, so that one flight beyond the bounds proves nothing. A flight that ends
    # with the status of a busy host is not judged at all, nor one in which the aircraft had not the
    # time to send each sample while more than twice as many threads ran as the host has cores.
    delays = []
    is_judged = False
    for _ in range(4):
        flight = start("flight_cli.cli", "fly", str(short_scenario), "--real-time")
        status = flight.end()
        is_crowded = os.getloadavg()[0] > 2.0 * (os.cpu_count() or 1)
        if status == STATUS_HOST or (is_crowded and "were never sent" in flight.output):
            delays.append(True)
            continue
        flight.succeed()
        is_judged = True
        run = (tmp_path / "runs" / "latest").resolve()
        tape = read_run(run).tape
        ticks = json.loads((run / "summary.json").read_text())["ticks"]
        gap = max(np.diff(tape[topic].stamp_ns).max() for topic in ("y", "y_m"))
        delays.append(
            bool(ticks["late_max"] >= 0.0025 or ticks["without_new_y"] > 1 or gap > 4_000_000)
        )
        errors = rms(tracking_error(tape).values)
        accurate = bool((errors <= bound).all())
        with AnyReader([run]) as reader:
            counts = {connection.topic: connection.msgcount for connection in reader.connections}
            connection, _, raw = next(
                reader.messages([c for c in reader.connections if c.topic == "/internals"])
            )
            internals: Any = reader.deserialize(raw, connection.msgtype)
        # 500 Hz and 100 Hz for 8 s and some tenths at the end; a few ticks may be missing at the
        # start
        missing = [
            topic for topic, rate in RATES.items() if not rate * DURATION * 0.98 <= counts[topic]
        ]
        if accurate and not missing:
            break
    if not is_judged:
        pytest.skip("inconclusive: the host was too busy for real time in each of four flights")
    assert all(counts[topic] <= rate * (DURATION + 2.0) for topic, rate in RATES.items()), counts
    assert counts["/diagnostics"] >= 4 * (DURATION - 1)
    assert internals.name[:2] == ["mode", "dt"]
    assert internals.header.frame_id.startswith("/controller#")
    assert tape["y"].stamp_ns[0] == tape.start_ns  # the log begins with the first sample
    assert delays[-1] or np.diff(tape["y"].stamp_ns).max() <= 20_000_000
    # Ticks are due 1 ms after whole periods of 10 ms, and y at whole 2 ms: a clock that is slewed
    # differs by less than 0.1 ms.
    logged = tape["internals"]
    due = logged["age"] - logged["late"] + (logged.stamp_ns % 10_000_000) / 1e9
    assert np.abs(due % 0.01 - 0.001).max() < 1e-4
    assert np.abs((tape["y"].stamp_ns + 1_000_000) % 2_000_000 - 1_000_000).max() < 1000  # ns
    # u carries the stamp of the y from which it was computed; one that is held on a busy host, that
    # of its tick
    failsafe_ns = tape["internals"].stamp_ns[tape["internals"]["mode"] != Mode.ENGAGED]
    assert set(tape["u"].stamp_ns.tolist()) - set(failsafe_ns.tolist()) <= set(
        tape["y"].stamp_ns.tolist()
    )
    if delays.count(False) <= 1 and (missing or not accurate):
        pytest.skip("host scheduling delayed a node in three flights of four or more")
    assert not missing, counts
    assert accurate, f"{errors} over topics, at most {bound}"
