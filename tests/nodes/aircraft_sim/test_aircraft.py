# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test the node of the aircraft when u times out: its watchdog and failsafe.

The tests also cover its refusals, and when its flight begins.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import pytest
from sensor_msgs.msg import JointState
from tests.nodes.world import INPUTS, World, diagnostics, parameters, world_of

from aircraft_sim.node import AircraftNode
from flight_analysis.closed_loop.scenario import Scenario
from flight_core.rates import NANOSECONDS

TICK = 0.002  # s
MAX_AGE, HOLD, RAMP = 0.1, 0.1, 0.2  # s


class Flight:
    """An aircraft and the publishers of its u."""

    def __init__(self, world: World) -> None:
        self.world = world
        self.node: Any = world.start(AircraftNode)

    def send(self, aileron: float, sender: str = "/first#1", age: float = 0.0) -> None:
        """Publish u."""
        self.world.send("/u", dict.fromkeys(INPUTS, 0.0) | {"aileron": aileron}, sender, age)

    def fly(self, aileron: float, duration: float = 0.3, sender: str = "/first#1") -> None:
        """Fly with u of a publisher."""
        self.world.run(duration, lambda: self.send(aileron, sender))

    def ailerons(self, begin: int = 0) -> np.ndarray[Any, np.dtype[np.float64]]:
        """Return the positions of the aileron from a sample on."""
        return np.array(
            [sample.channels["actuator.aileron"] for sample in self.world.vectors("/truth")[begin:]]
        )


@contextmanager
def flying(scenario: Scenario, **values: object) -> Iterator[Flight]:
    """Return an aircraft of a scenario with other parameters."""
    with world_of(
        "--params-file",
        str(scenario.path),
        *parameters({f"aircraft.{name}": value for name, value in values.items()}),
    ) as world:
        yield Flight(world)


def test_u_that_times_out_held_then_ramped_to_trim_and_may_return(osprey_gust: Scenario) -> None:
    with flying(osprey_gust, max_age=MAX_AGE, hold=HOLD, ramp=RAMP) as flight:
        flight.fly(0.01)
        last_ns = flight.world.vectors("/u")[-1].stamp_ns
        begin = len(flight.world.sent["/truth"])
        flight.world.run(MAX_AGE + HOLD + RAMP + 0.1)
        t = (
            np.array(
                [sample.stamp_ns - last_ns for sample in flight.world.vectors("/truth")[begin:]]
            )
            / NANOSECONDS
        )
        expected = 0.01 * np.clip(1.0 - (t - MAX_AGE - HOLD) / RAMP, 0.0, 1.0)
        # Ticks are 2 ms.
        assert flight.ailerons(begin) == pytest.approx(expected, abs=0.01 * 2 * TICK / RAMP)
        assert (
            sum(
                "[ERROR] failsafe: u from /first#1 timed out" in line
                for line in flight.node.log.lines
            )
            == 1
        )
        flight.world.run(3.0)
        assert any(
            "waiting for /u: no sample of its publisher arrives" in line
            for line in flight.node.log.lines
        )
        assert diagnostics(flight.world, "/aircraft")[0].startswith(
            "failsafe: u from /first#1 timed out"
        )
        flight.fly(0.02, sender="/second#2")
        assert flight.ailerons()[-1] == 0.02
        assert any("receiving u from /second#2" in line for line in flight.node.log.lines)


def test_u_older_than_age_limit_does_not_end_failsafe(osprey_gust: Scenario) -> None:
    """A controller was stopped while its middleware still sent messages.

    Its u is older than the age limit, and newer than the last u.
    """
    with flying(osprey_gust, max_age=MAX_AGE, hold=0.0, ramp=0.0) as flight:
        flight.fly(0.01)
        flight.world.run(0.2)
        begin = len(flight.world.sent["/truth"])
        flight.world.run(0.1, lambda: flight.send(0.02, age=0.15))
        assert not flight.ailerons(begin).any()
        assert flight.node.refusals.counts["u: old"] > 10
        assert any("/u: sample refused: stamp 0.15" in line for line in flight.node.log.lines)
        flight.fly(0.02)
        assert flight.ailerons()[-1] == 0.02


def test_second_controller_ignored_while_first_one_publishes(osprey_gust: Scenario) -> None:
    with flying(osprey_gust) as flight:
        flight.fly(0.01)

        def both() -> None:
            flight.send(0.01)
            flight.send(-0.5, "/second#2")

        flight.world.run(1.5, both)
        assert int(diagnostics(flight.world, "/aircraft")[1]["refused u: sender"]) > 100
        sentence = "conflicting publisher /second#2 ignored: already receiving from /first#1"
        assert f"[ERROR] /u: sample refused: {sentence}" in flight.node.log.lines
        assert diagnostics(flight.world, "/aircraft")[0] == f"/u: {sentence}"
        assert (np.diff(flight.ailerons()) >= 0.0).all()  # the rest of a bumpless transfer alone


def test_flight_begins_with_first_u_and_is_told(osprey_gust: Scenario) -> None:
    with flying(osprey_gust) as flight:
        flight.node.match()
        assert not flight.world.sent["/node_state"]
        flight.world.publisher(JointState, "/u")
        flight.node.match()
        flight.fly(0.01)
        assert [message.value for message in flight.world.messages("/node_state")] == [
            "matched",
            "flying",
        ]
