# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test the replay of flights over real DDS from their logs, bit by bit.

Logs with faults of the controller and of the recorder are replayed, too.
"""

import json
import time
from pathlib import Path
from typing import Any

from lifecycle_msgs.msg import Transition
from tests.conftest import invoke
from tests.ros.conftest import Start
from tests.ros.flight_bringup.test_lockstep import AT_200_HZ, both_cores_busy, scenario_file
from tests.ros.flight_recorder.test_recorder import recorded
from tests.ros.peer import Peer
from tests.ros.waiting import HostDelays

from flight_analysis.closed_loop.scenario import load_scenario
from flight_core.modes import Mode
from flight_core.outcome import STATUS_SHORTFALL
from flight_core.rates import NANOSECONDS, period_ns
from flight_ros.topics import publisher_qos

PEER_TOPICS = ("internals", "/diagnostics")


def replayed(run: Path, *settings: str, equal: bool = True) -> dict[str, Any]:
    """Return the JSON output of `rise-di replay`.

    Its exit status shows a log with less than 99 % of the ticks.
    """
    done = invoke("replay", run, "--json", *settings)
    output: dict[str, Any] = json.loads(done.output)
    assert output["equal"] is equal
    incomplete = output["checked"] < 0.99 * output["expected"]
    assert done.exit_code == ((STATUS_SHORTFALL if incomplete else 0) if equal else 1), done.output
    return output


def receive_more(peer_node: Peer, count: int) -> None:
    """Wait for further samples of `internals`."""
    enough = len(peer_node.received["internals"]) + count
    peer_node.until(lambda: len(peer_node.received["internals"]) >= enough, "further ticks")


def test_flight_in_real_time_replayed_with_parameter_changes_outages_and_busy_host(
    start: Start, tmp_path: Path, peer_node: Peer
) -> None:
    scenario = scenario_file(tmp_path, 1e4, "osprey_gust", **AT_200_HZ)
    flight = start("flight_cli.cli", "fly", str(scenario), "--real-time")  # ended below

    def modes() -> list[int]:
        return peer_node.modes()[-1:]

    peer_node.until(lambda: modes() == [Mode.ENGAGED], "the law engaged")
    assert peer_node.set_parameters(k_g=1.5, Lambda=[4.0, 4.0, 2.0, 0.4])
    receive_more(peer_node, 50)
    assert peer_node.set_parameters(upper=[0.01] * 4)
    with both_cores_busy():  # ticks are late, and some are missed
        receive_more(peer_node, 50)
    assert peer_node.transition(Transition.TRANSITION_DEACTIVATE)
    peer_node.until(lambda: modes() == [Mode.INACTIVE], "the law inactive")
    receive_more(peer_node, 20)
    assert peer_node.transition(Transition.TRANSITION_CLEANUP)
    # the law re-engages from its last u
    assert peer_node.transition(Transition.TRANSITION_CONFIGURE)
    assert peer_node.transition(Transition.TRANSITION_ACTIVATE)
    peer_node.until(lambda: modes() == [Mode.ENGAGED], "the law engaged again")
    receive_more(peer_node, 50)
    flight.interrupt()
    assert flight.end() == 130, flight.output
    run = tmp_path / "runs" / "latest"
    output = replayed(run)
    # the host can stop a tick half-way, which then publishes no u to compare
    unsent = [
        note.split()[0] for note in output["notes"] if "ticks have no sample on the topic u" in note
    ]
    assert output["ticks"] - sum(map(int, unsent)) == output["checked"] > 150, output["notes"]
    changes = [
        note.split(": ")[1]
        for note in output["notes"]
        if note.startswith("parameters changed before tick")
    ]
    assert changes == ["Lambda, k_g", "upper"]
    # a change of one bit in one gain is detected
    assert replayed(run, "--set", "controller.k_g=1.0000000000000002", equal=False)["open_loop"]


def test_late_recorder_leaves_first_tick_unchecked_and_notes_missing_samples(
    start: Start, tmp_path: Path, peer_node: Peer, host_delays: HostDelays
) -> None:
    scenario = scenario_file(tmp_path, 1e3, "osprey_gust", **AT_200_HZ)
    period = period_ns(load_scenario(scenario).controller.rate, "rate")
    parameters = ("--ros-args", "--params-file", str(scenario))
    for package in ("rise_di_controller", "aircraft_sim", "reference_model"):
        start(f"{package}.main", *parameters)
    more_than_history = publisher_qos(period).depth + 50
    peer_node.until(
        lambda: len(peer_node.received["internals"]) > more_than_history,
        "more ticks than the publishers keep",
    )
    begin = time.time()
    recorder = start(
        "flight_recorder.main",
        *parameters,
        "-p",
        f"scenario_file:={scenario}",
        "-p",
        "directory:=run",
    )
    recorder.wait_for("recording to")
    with_history = publisher_qos(period).depth + 50
    peer_node.until(
        lambda: min(recorded(peer_node, "/u"), recorded(peer_node, "/internals")) > with_history,
        "the history and more in the log",
    )
    recorder.interrupt().succeed()
    output = replayed(tmp_path / "run")
    assert output["checked"] < 0.99 * output["expected"]
    # the recorder is matched with one topic after the other: further first ticks may lack y or u, 7
    # on a busy host
    delayed = host_delays.since(begin) * NANOSECONDS / period
    assert 0 < output["ticks"] - output["checked"] < 50 + delayed
    assert output["checked"] > 150
    assert any(note.startswith("the log begins with sample ") for note in output["notes"])
