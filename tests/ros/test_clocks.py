# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Clocks of nodes on other hosts: the estimate of offset and delay, and what a node says of a clock that differs."""

import random
import re
import struct
from functools import partial
from pathlib import Path

import pytest
from diagnostic_msgs.msg import DiagnosticArray
from tests.ros.conftest import Start, settable_clock
from tests.ros.peer import peer

from flight_core.rates import NANOSECONDS, nanoseconds
from flight_ros.clocks import Peers
from flight_ros.topics import DIAGNOSTICS

pytestmark = pytest.mark.package("flight_ros")


def exchanged(offset: float, there: float, back: float, jitter: float) -> Peers:
    """What a knows of b after six exchanges; the clock of b is ahead by the offset, s, and messages take there and back, s."""
    a, b, rng = Peers("/a"), Peers("/b"), random.Random(1)  # noqa: S311 - jitter
    for k in range(6):
        sent = 1000.0 + k
        arrived = sent + there + rng.uniform(0.0, jitter)
        b.receive("/a", nanoseconds(sent), nanoseconds(arrived + offset), a.differences())
        arrived = sent + 0.5 + back + rng.uniform(0.0, jitter)
        a.receive("/b", nanoseconds(sent + 0.5 + offset), nanoseconds(arrived), b.differences())
    return a


@pytest.mark.parametrize("offset", [-0.15, 0.0, 0.05, 3600.0])
def test_offset_and_delay_estimated_both_ways(offset: float) -> None:
    clock = exchanged(offset, 0.010, 0.010, 0.004).clocks()["/b"]
    assert clock.offset == pytest.approx(offset, abs=0.002)  # half of the jitter
    assert clock.delay == pytest.approx(0.010, abs=0.004)


def test_error_of_offset_is_half_of_difference_of_delays() -> None:
    assert exchanged(0.1, 0.002, 0.012, 0.0).clocks()["/b"].offset == pytest.approx(0.1 - 0.005, abs=1e-6)


def test_silent_node_forgotten() -> None:
    peers = exchanged(0.1, 0.001, 0.001, 0.0)
    peers.receive("/c", nanoseconds(1020.0), nanoseconds(1020.0), {})
    assert (peers.clocks(), set(peers.differences())) == ({}, {"/c"})


def test_refusal_names_clock_of_other_host(start_node: Start, tmp_path: Path) -> None:
    """The clock of the aircraft is 0.15 s behind, more than `max_age` of the controller, 0.1 s."""
    (step := tmp_path / "step").write_bytes(struct.pack("=q", -150 * NANOSECONDS // 1000))
    shifted = ("env", f"LD_PRELOAD={settable_clock(tmp_path)}", f"FAULTS_CLOCK={step}")
    controller = start_node("rise_di_controller")
    aircraft = start_node("aircraft_sim", within=shifted)
    name = f"/aircraft#{aircraft.popen.pid}"
    estimate = rf"the clock of {name} is (0\.\d+) s behind this one"

    def told(sentence: str) -> bool:  # the first estimate has the delays of a busy host, and one within 5 ms is not told again
        return any(float(offset) == pytest.approx(0.15, abs=0.01) for offset in re.findall(sentence, controller.output))

    controller.until(partial(told, f"{estimate}: synchronise the hosts"))
    controller.until(partial(told, f"old: {estimate}"))
    with peer(topics=()) as peer_node:
        found: list[float] = []

        def take(message: DiagnosticArray) -> None:
            values = {value.key: value.value for status in message.status for value in status.values}
            found.extend(float(values[key]) for key in [f"clock of {name} (s)"] if key in values)

        peer_node.node.create_subscription(DIAGNOSTICS.type, DIAGNOSTICS.name, take, 10)
        peer_node.until(lambda: any(offset == pytest.approx(-0.15, abs=0.002) for offset in found))
