# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""The watchdog and failsafe of the aircraft's node when u times out, and its refusal of a conflicting publisher of u."""

import numpy as np
import pytest
from tests.ros.conftest import Start
from tests.ros.peer import Peer, stamp_ns

from flight_core.rates import NANOSECONDS

pytestmark = pytest.mark.package("aircraft_sim")

PEER_TOPICS = ("truth", "/diagnostics")


def command(peer_node: Peer, sender: str, aileron: float) -> None:
    peer_node.command(0.0, 0.0, aileron, 0.0, sender=sender)


def aileron(peer_node: Peer) -> list[float]:
    return [m.position[m.name.index("actuator.aileron")] for m in peer_node.received["truth"]]


def test_u_that_times_out_held_then_ramped_to_trim_and_may_return(start_node: Start, peer_node: Peer) -> None:
    process = start_node("aircraft_sim", "-p", "max_age:=0.1", "-p", "hold:=0.1", "-p", "ramp:=0.2")
    peer_node.until(lambda: aileron(peer_node)[-1:] == [0.01], each=lambda: command(peer_node, "first", 0.01))
    peer_node.received["truth"].clear()
    peer_node.until(lambda: aileron(peer_node)[-1:] == [0.0])  # no u is published any more
    positions, messages = aileron(peer_node), peer_node.received["truth"]
    assert (np.diff(positions) <= 0).all()
    # A ramp of 0.01 in 0.2 s. The host may skip ticks, which the stamps show, and delay one by 18 ms.
    stamps = np.array([stamp_ns(message) for message in messages]) / NANOSECONDS
    assert (np.abs(np.diff(positions)) <= 0.01 / 0.2 * (np.diff(stamps) + 0.018)).all()
    process.wait_for("waiting for /u")
    peer_node.until(lambda: aileron(peer_node)[-1:] == [0.02], each=lambda: command(peer_node, "second", 0.02))
    process.wait_for("receiving u from second")


def test_u_older_than_age_limit_does_not_end_failsafe(start_node: Start, peer_node: Peer) -> None:
    process = start_node("aircraft_sim", "-p", "max_age:=0.1", "-p", "hold:=0.0", "-p", "ramp:=0.0")
    peer_node.until(lambda: aileron(peer_node)[-1:] == [0.01], each=lambda: command(peer_node, "first", 0.01))
    # until the failsafe lasts: an aircraft that the host delayed starts it before it takes the u in its queue
    peer_node.until(lambda: len(aileron(peer_node)) > 100 and not any(aileron(peer_node)[-100:]))
    peer_node.received["truth"].clear()
    # As of a controller that was stopped while its middleware sent: longer than the age limit, newer than the last u.
    refused = "/u: sample refused: stamp 0.1"  # logged once in 2 s: a busy machine also delays a sample beyond the age limit
    peer_node.until(
        lambda: peer_node.counted("refused u: old") and process.has_logged(refused),
        each=lambda: peer_node.command(0.0, 0.0, 0.02, 0.0, age=0.15),
    )
    assert not any(aileron(peer_node))
    peer_node.until(lambda: aileron(peer_node)[-1:] == [0.02], each=lambda: command(peer_node, "first", 0.02))


def test_second_controller_ignored_while_first_one_publishes(start_node: Start, peer_node: Peer) -> None:
    process = start_node("aircraft_sim")
    peer_node.until(lambda: aileron(peer_node)[-1:] == [0.01], each=lambda: command(peer_node, "first", 0.01))

    def both() -> None:
        command(peer_node, "first", 0.01)
        command(peer_node, "second", -0.5)

    peer_node.until(lambda: peer_node.counted("refused u: sender", 5), each=both)
    process.wait_for("conflicting publisher second ignored: already receiving from first")
    assert min(aileron(peer_node)) == 0.0
