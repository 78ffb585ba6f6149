# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test the learner's node, and the controller with a learner.

The tests cover proposals of other nodes, many proposals at once, and the record of a flight.
"""

from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from types import MappingProxyType

import numpy as np
import pytest
from sensor_msgs.msg import JointState
from tests.conftest import refusing
from tests.nodes.rise_di_controller.test_controller import Flight, missed
from tests.nodes.world import diagnostics, world_of

from flight_analysis.closed_loop.scenario_library import find_scenario, save_scenario
from flight_core.modes import Mode
from flight_core.rates import nanoseconds
from flight_design.learning.node import LearnerNode
from flight_ros import reports
from flight_ros.messages import Encoder
from flight_ros.reports import Report
from flight_ros.topics import PROPOSAL
from rise_di_controller.learning.proposals import design_changes
from rise_di_controller.rise_di_config import RiseDiConfig


class Proposer:
    """A node that proposes the model of osprey_observer to a controller with other parameters."""

    def __init__(self, flight: Flight, start: RiseDiConfig) -> None:
        self.flight = flight
        self.start = start
        self.change = design_changes(start, find_scenario("osprey_observer").rise_di())
        self._publisher = flight.world.publisher(PROPOSAL.type, "/proposal")

    def propose(
        self, sender: str = "learner#1", change: Mapping[str, object] = MappingProxyType({})
    ) -> None:
        """Publish a proposal whose window ended at least one tick ago."""
        values = {
            "start": self.start.digest(),
            "flown": self.start.digest(),
            **self.change,
            **change,
        }
        stamp_ns = self.flight.world.clock.time_ns() - nanoseconds(0.05)
        self._publisher.publish(
            reports.encode(Report(stamp_ns, sender, "model", values), "proposal")
        )

    def answer(self, propose: Callable[[], None]) -> Report:
        """Return what the controller says next."""
        messages = self.flight.world.sent["/learning"]
        count = len(messages)
        propose()
        self.flight.world.until(lambda: len(messages) > count, "an answer", self.flight.send)
        return reports.decode(messages[count][1])


@pytest.fixture
def proposer(tmp_path: Path) -> Iterator[Proposer]:
    shipped = find_scenario("osprey_learn")
    # a parameter that only the proposal has
    model = shipped.rise_di().model_dump()["feedforward"] | {"gravity": None}
    varied = save_scenario(shipped.vary(controller={"feedforward": model}), tmp_path / "learn.yaml")
    with world_of("--params-file", str(varied.path)) as world:
        flight = Flight(world)
        flight.y = 0.0
        yield Proposer(flight.engage(), varied.rise_di())


def test_controller_refuses_a_lie_and_a_hasty_proposal_and_flies_a_certified_model(
    proposer: Proposer,
) -> None:
    flight = proposer.flight
    flipped = [-value for value in proposer.change["observer.F"]]
    lie = proposer.answer(lambda: proposer.propose(change={"observer.F": flipped}))
    assert "spectral radius" in lie.sentence
    assert lie.values == {"event": "refused"}
    assert "after the window of the last proposal" in proposer.answer(proposer.propose).sentence
    flight.run(2.5)  # half of the least spacing
    flies = proposer.answer(proposer.propose)
    assert flies.sentence == "flies model"
    assert flies.values == {"event": "flies"}
    flight.run(0.1)
    assert flight.values("observer.part") == [0.6]  # its bound
    digests = dict(zip(flight.at().tolist(), flight.column("parameters").tolist(), strict=True))
    # u of a tick does not wait for its certificate
    assert digests[flies.stamp_ns] == proposer.start.digest()
    assert flight.column("parameters")[-1] != proposer.start.digest()


def test_storm_of_proposals_costs_one_decoding_a_tick_and_delays_none(proposer: Proposer) -> None:
    flight = proposer.flight

    def storm() -> None:
        for _ in range(100):
            proposer.propose("second#2")
        proposer.propose(change={"start": 1})

    sentence = "found a proposal for the parameters 1"
    # the publisher that is locked
    assert sentence in proposer.answer(lambda: proposer.propose(change={"start": 1})).sentence
    proposer.propose(change={"flown": None})
    for _ in range(20):
        proposer.propose(change={"start": 1})
    flight.run(0.1)
    assert len(flight.world.sent["/learning"]) == 1
    assert sentence in proposer.answer(storm).sentence
    counts = flight.node.refusals.counts
    assert counts["proposal: sender"] == 100
    assert counts["proposal: malformed"] == 1  # without the digest
    assert counts["proposal: rate"] == 20  # of the tick with the malformed one
    flight.run(1.0)
    assert missed(flight) == 0
    assert int(diagnostics(flight.world, "/controller")[1]["refused proposal: sender"]) == 100


def test_deactivated_law_ends_the_record(tmp_path: Path) -> None:
    """The times are counted from the next engagement, and the record before it is forgotten."""
    scenario = save_scenario(
        find_scenario("osprey_learn").vary(
            controller={"learn": {"updates": [3.0], "latency": 0.5}}
        ),
        tmp_path / "learn.yaml",
    )
    controller = scenario.rise_di()
    names = ("mode", "age", "parameters", *(f"y.{name}" for name in controller.outputs))
    names += tuple(f"u.{name}" for name in controller.inputs)
    encoder = Encoder(
        (*names, *(f"given_up.{name}" for name in controller.outputs)), "/controller#1"
    )
    with world_of("-p", f"scenario_file:={scenario.path}", "-p", "lockstep:=true") as world:
        learner = world.make(LearnerNode)
        publisher = world.publisher(JointState, "/internals")
        for t, mode in (
            (1, Mode.ENGAGED),
            (3, Mode.ENGAGED),
            (3.5, Mode.INACTIVE),
            (5, Mode.ENGAGED),
            (7, Mode.ENGAGED),
            (8, Mode.ENGAGED),
        ):
            zeros = np.zeros(2 * len(controller.outputs) + len(controller.inputs))
            publisher.publish(
                encoder.encode(
                    nanoseconds(t), np.array([float(mode), 0.0, float(controller.digest()), *zeros])
                )
            )
            learner.advance()
        learner.close()  # completes the search
        said = [reports.decode(raw).sentence for _, raw in world.sent["/proposal"]]
    rough = "the airframe osprey as it is, until a model is learned"
    assert said == [rough, rough, "record: found 3.01 s, expected 10 s"]  # from 5 to 8 s


def test_learner_refuses_a_scenario_that_does_not_learn() -> None:
    file = find_scenario("osprey_servo").path
    refusal = r"learner\.scenario_file: found a scenario without controller\.learn"
    with (
        world_of("-p", f"scenario_file:={file}") as world,
        refusing(refusal),
    ):
        world.make(LearnerNode)
