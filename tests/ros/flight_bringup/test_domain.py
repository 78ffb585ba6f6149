# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test that a second flight in a domain is refused before any of its nodes starts."""

import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from tests.ros.conftest import Start
from tests.ros.peer import OUTPUTS, Peer, peer

from flight_core.outcome import STATUS_BAD_INPUT, STATUS_ENDED_EARLY
from flight_ros.messages import to_message

FLEET = "scenario: osprey_gust\naircraft: {uav1: {}}\n"


def publish(made: Peer, *topics: str) -> None:
    """Publish a sample of an aircraft and of a reference model of another flight."""
    for topic in topics:
        made.publish(topic, to_message(time.time_ns(), OUTPUTS, np.zeros(4), f"{topic}#1"))


@pytest.mark.parametrize(
    "words, topics, status",
    [
        (["fly", "osprey_gust"], ("/y", "/y_m", "/u"), STATUS_BAD_INPUT),
        (["fly", "osprey_gust", "--composed"], ("/y", "/y_m", "/u"), STATUS_BAD_INPUT),
        (["fly", "osprey_gust", "--lockstep"], ("/y", "/y_m", "/u"), STATUS_BAD_INPUT),
        (["fly", "osprey_gust", "--bridge", "ardupilot"], ("/y", "/y_m", "/u"), STATUS_BAD_INPUT),
        (
            ["fly", "osprey_gust", "--namespace", "uav1"],
            ("/uav1/y", "/uav1/y_m", "/uav1/u"),
            STATUS_BAD_INPUT,
        ),
        (["fly", "fleet.yaml"], ("/uav1/y", "/uav1/y_m", "/uav1/u"), STATUS_ENDED_EARLY),
    ],
    ids=["fly", "composed", "lockstep", "bridge", "namespace", "fleet"],
)
def test_second_flight_refused_before_its_controller_publishes_u(
    words: Sequence[str], topics: tuple[str, str, str], status: int, start: Start, tmp_path: Path
) -> None:
    """A user's aircraft without a publisher lock would fly the u of the second controller."""
    (tmp_path / "fleet.yaml").write_text(FLEET)
    y, y_m, u = topics
    with peer(topics=(u,)) as peer_node:
        second = start("flight_cli.cli", *words, "--duration", "2")
        peer_node.until(
            lambda: second.popen.poll() is not None,
            "the second flight is refused",
            each=lambda: publish(peer_node, y, y_m),
        )
        assert peer_node.received[u] == []
    assert second.end() == status
    assert "publishers of" in second.output
    assert not list(tmp_path.glob("runs/*/log")), "a log a node that has started"
