# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test a recorder that is killed: how much of the log is lost, and its repair."""

import json
import re
import signal
import subprocess
import time
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from tests.conftest import invoke
from tests.recordings import count_messages
from tests.ros.conftest import Recorder, Start, logged
from tests.ros.peer import Peer
from tests.ros.waiting import until

from flight_analysis.closed_loop.replay import recorded_scenario
from flight_analysis.closed_loop.scenario import Scenario, scenario_yaml
from flight_analysis.closed_loop.scenario_library import find_scenario
from flight_core.outcome import STATUS_ENDED_EARLY
from flight_core.rates import NANOSECONDS
from flight_log.tape_reader import read_run
from flight_ros.messages import stamp_of
from flight_ros.subscriptions import PolledSubscription
from flight_ros.topics import NEWEST_SAMPLES, Y

pytestmark = pytest.mark.alone

SIGNALS = ("/y", "/y_m", "/u", "/internals", "/truth")


def stamps_and_sequences(folder: Path) -> dict[str, tuple[list[int], list[int]]]:
    """Return stamps and sequences in the file of a recorder by topic.

    The recorder may still run.
    """
    by_topic: dict[str, tuple[list[int], list[int]]] = {}
    for topic, record in logged(folder):
        if topic in SIGNALS:
            stamps, sequences = by_topic.setdefault(topic, ([], []))
            stamps.append(stamp_of(record.data))
            sequences.append(record.sequence)
    return by_topic


def missing_seconds(folder: Path, witness: PolledSubscription) -> float:
    """Return how far a recorder's file is behind the messages of another process, s.

    The result is the largest delay of a topic. The messages are taken first, because the publishers
    continue while the file is read, and what they send then is not lost.
    """
    received = [stamp_of(message.message) for message in witness.take()]
    by_topic = stamps_and_sequences(folder)
    if not received or set(by_topic) != set(SIGNALS):
        return float("inf")
    return max(max(received) - stamps[-1] for stamps, _ in by_topic.values()) / NANOSECONDS


def is_up_to_date(folder: Path, witness: PolledSubscription) -> bool:
    """Return whether the file is at most 0.2 s behind."""
    return missing_seconds(folder, witness) <= 0.2


@pytest.mark.usefixtures("publisher")
def test_8_killed_recorders_lose_at_most_three_tenths_of_second(
    recorder: Recorder, tmp_path: Path, peer_node: Peer
) -> None:
    generator = np.random.default_rng(1)
    witness = PolledSubscription(peer_node.node, Y, NEWEST_SAMPLES, raw=True)
    missing = []
    following = recorder("run0")
    for k in range(8):
        process = following
        folder = tmp_path / f"run{k}"
        process.wait_for_log(folder, 50_000)
        # at first the recorder receives the history of 2 s that the publishers keep
        until(partial(is_up_to_date, folder, witness), "a log up to the newest samples")
        begin = {
            topic: sequences[-1] for topic, (_, sequences) in stamps_and_sequences(folder).items()
        }
        if k < 7:
            following = recorder(f"run{k + 1}")  # starts in the meantime
        # the random instant of the kill is the test case
        with pytest.raises(subprocess.TimeoutExpired):
            process.popen.wait(float(generator.uniform(0.0, 0.3)))
        process.popen.kill()
        missing.append(missing_seconds(folder, witness))
        assert process.end() == -signal.SIGKILL
        for topic, (_, sequences) in stamps_and_sequences(folder).items():
            since = [number for number in sequences if number >= begin[topic]]
            assert since == list(range(since[0], since[-1] + 1)), topic  # no gap before the end
        assert not (folder / "metadata.yaml").exists()
        tape = read_run(folder).tape
        end = max(tape.time(name)[-1] for name in tape.signals)
        note = f"run{k}_0.mcap is truncated: read up to its last complete chunk, t = {end:.3f} s"
        # A chunk that the kill has cut says in its head until when it was to last.
        cut = re.fullmatch(
            re.escape(note) + r"(; 0\.[012]\d\d s are missing after it)?", tape.notes[0]
        )
        assert cut, tape.notes[0]
        assert tape.notes[1] == f"metadata.yaml is missing: rise-di report --repair {folder}"
    print([round(duration, 3) for duration in missing])
    assert max(missing) < 0.3, missing


def test_log_of_killed_recorder_reported_and_repairable(
    start: Start, osprey_gust: Scenario, tmp_path: Path
) -> None:
    flight = start(
        "flight_cli.cli", "fly", str(osprey_gust.path), "--real-time", "--duration", "30"
    )
    flight.wait_for_log(tmp_path / "runs", 150_000)
    node = flight.child("flight_recorder.main")
    killed_ns = time.time_ns()
    node.kill()
    assert flight.end() == 3, flight.output
    assert "outcome: recorder was killed by SIGKILL" in flight.output
    run = (tmp_path / "runs" / "latest").resolve()
    before = read_run(run)
    assert (killed_ns - before.tape["y"].stamp_ns[-1]) / NANOSECONDS < 0.3
    flown = find_scenario(osprey_gust, 30.0)
    assert scenario_yaml(recorded_scenario(before)) == scenario_yaml(flown)
    assert {stored.name for stored in before.attachments} == {"parameters.yaml", "airframe.yaml"}
    filled = {name for name in before.metadata if before.metadata[name]}
    assert filled >= {"rise_di_flight", "rise_di_host", "rise_di_versions"}
    report = invoke("report", run)
    assert report.exit_code == STATUS_ENDED_EARLY, "the status of an archive is that of its flight"
    assert "is truncated: read up to its last complete chunk, t = " in " ".join(
        report.output.split()
    )
    assert (run / "report.html").stat().st_size > 10_000
    repair = invoke("report", "--repair", run)
    assert repair.exit_code == 0
    assert "of the 30 s of the scenario" in repair.output
    assert count_messages(run)["/y"] == len(before.tape["y"].stamp_ns)
    after = read_run(run)
    assert after.tape.notes == ()
    assert after.tape["y"].values.tobytes() == before.tape["y"].values.tobytes()
    outcome = json.loads((run / "summary.json").read_text())["outcome"]
    assert outcome["sentence"] == "recorder was killed by SIGKILL"
