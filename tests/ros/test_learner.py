# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""The learner's node beside the controller: lockstep, proposals of others, and a learner that is killed and started again."""

import time
from collections.abc import Callable, Mapping
from pathlib import Path
from types import MappingProxyType

import numpy as np
import psutil
import pytest
from rcl_interfaces.srv import GetParameters
from tests.ros.conftest import Start
from tests.ros.peer import Peer, peer, stamp_ns
from tests.ros.test_controller import PERIOD_NS, HostDelay, missed
from tests.ros.waiting import HostDelays

from flight_analysis.closed_loop.guidance_replay import replay_guidance
from flight_analysis.closed_loop.replay import replay
from flight_analysis.closed_loop.scenario import Scenario
from flight_analysis.closed_loop.simulate import simulate
from flight_bringup.fly import fly_over_topics
from flight_bringup.scenarios import find_scenario, written
from flight_core.channels import UNKNOWN
from flight_core.modes import Mode
from flight_core.rates import nanoseconds
from flight_log.tape_reader import read_run
from flight_ros import reports
from flight_ros.messages import to_message
from flight_ros.reports import Report
from flight_ros.topics import INTERNALS, LEARNING, LOCKSTEP, PROPOSAL, PUBLISH, RECORD
from rise_di.learning import learner
from rise_di_controller.learning import Event, designed
from rise_di_controller.rise_di import RiseDiConfig

pytestmark = pytest.mark.package("flight_learner")

CHANNELS = (("y", "outputs"), ("u", "inputs"))  # of `internals`, and the parameter with their names


def scenario(folder: Path, **learn: object) -> Scenario:
    """osprey_learn at 100 Hz, with an aircraft that is that of the file: its search is the shortest."""
    chosen = find_scenario("osprey_learn").vary(
        flight={"duration": 11.0},
        aircraft={"rate": 100.0, "step": 0.005, "uncertainty": {"A": 0.0, "B": 0.0}},
        reference_model={"rate": 100.0},
        controller={"learn": {"updates": [10.0], "latency": 0.5} | learn},
    )
    return written(chosen, folder / "learn.yaml")


def test_lockstep_with_a_learner_is_equal_to_the_byte_to_one_process_and_replays_to_the_bit(tmp_path: Path) -> None:
    # the flight ends at the tick that waits for the second proposal, and that begins the third search
    guided = scenario(tmp_path, updates=[10.0, 10.5, 11.0]).vary(
        aircraft={"kinematics": "euler"},
        reference_model={"pulses": {}, "coordinated_turn": None, "live": {"speed": 25.0}},
        guidance={"program": {"heading": {"start": [1.0], "value": [0.5]}, "altitude": {"start": [1.0], "value": [20.0]}}},
    )
    chosen, events, lines = written(guided, tmp_path / "learn.yaml"), list[Event](), list[str]()
    run = tmp_path / "run"
    flown = fly_over_topics(chosen, run, lambda t, text: None, lockstep=True, announce=lines.append)
    assert flown == "completed"
    tape = simulate(chosen, learn=learner(chosen), announce=events.append)
    assert [event.stamp_ns for event in events] == [nanoseconds(10.5), nanoseconds(11.0)]
    assert events[0].change
    assert lines == [f"t = {event.stamp_ns / 1e9:.2f} s: {event.sentence}" for event in events]
    recorded = read_run(run).tape
    for name, signal in tape.signals.items():
        assert signal.stamp_ns.tobytes() == recorded[name].stamp_ns.tobytes(), name
        assert signal.values.tobytes() == recorded[name].values.tobytes(), name
    result = replay(run)
    assert result.equal()
    assert result.whole.all()
    steps = replay_guidance(recorded, chosen.guidance)
    assert steps.equal()
    assert steps.checked == steps.steps
    assert recorded["guidance"]["authority.p"].min() < UNKNOWN  # guidance knows what was learned


class Proposer:
    """A peer that proposes the model of osprey_observer to a controller that starts with other parameters."""

    def __init__(self, peer_node: Peer, start: RiseDiConfig) -> None:
        self.peer, self.start = peer_node, start
        self.change = designed(self.start, find_scenario("osprey_observer").rise_di())
        self.told: list[Report] = []
        self._publish = peer_node.node.create_publisher(PROPOSAL.type, PROPOSAL.name, PUBLISH).publish
        peer_node.node.create_subscription(LEARNING.type, LEARNING.name, self._take, PUBLISH, raw=True)

    def _take(self, raw: bytes) -> None:
        self.told.append(reports.decode(raw))

    def propose(self, sender: str = "learner#1", change: Mapping[str, object] = MappingProxyType({})) -> None:
        """Publish a proposal whose window ended a tick or more ago."""
        values = {"start": self.start.digest(), "flown": self.start.digest(), **self.change, **change}
        self._publish(reports.encode(Report(time.time_ns() - nanoseconds(0.05), sender, "model", values), "proposal"))

    def answer(self, propose: Callable[[], None]) -> str:
        """What the controller says next, with y and y_m meanwhile."""
        count = len(self.told)
        propose()
        self.peer.until(lambda: len(self.told) > count, each=self.peer.send)
        return self.told[count].sentence


def test_controller_refuses_lies_and_storms_and_flies_a_certified_model(
    start: Start, tmp_path: Path, host_delays: HostDelays
) -> None:
    shipped = find_scenario("osprey_learn")
    model = shipped.rise_di().model_dump()["feedforward"] | {"gravity": None}  # a parameter that only the proposal has
    late = written(shipped.vary(controller={"feedforward": model, "max_age": 2.0}), tmp_path / "late.yaml")
    with peer(qos=RECORD) as peer_node:  # receives each tick, also where the host delays it
        controller = start("rise_di_controller.main", "--ros-args", "--params-file", str(late.path))
        proposer = Proposer(peer_node, late.rise_di())
        peer_node.until(lambda: peer_node.modes()[-1:] == [1], each=peer_node.send)
        flipped = [-value for value in proposer.change["observer.F"]]
        assert "spectral radius" in proposer.answer(lambda: proposer.propose(change={"observer.F": flipped}))
        time_of_refusal = time.monotonic()
        assert "after that of the last proposal" in proposer.answer(proposer.propose)
        peer_node.until(lambda: time.monotonic() > time_of_refusal + 2.5, each=peer_node.send)  # half of the least spacing
        assert proposer.answer(proposer.propose) == "flies model"
        flies_ns = proposer.told[-1].stamp_ns
        peer_node.until(lambda: get(peer_node) == 0.6, each=peer_node.send)
        flown = flown_at(peer_node)
        last_ns = max(at_ns for at_ns in flown if at_ns <= flies_ns)  # a tick to which the host brought no y has no output
        assert flown[last_ns] == proposer.start.digest()  # u of a tick does not wait for its certificate
        assert "sender" not in controller.output

        def burst() -> None:
            proposer.propose(change={"flown": None})
            for _ in range(20):
                proposer.propose(change={"start": 1})

        def storm() -> None:
            for _ in range(200):
                proposer.propose("second#2")
            proposer.propose(change={"start": 1})

        host_delay, begin_ns = HostDelay(controller, host_delays), time.time_ns()
        for several in (burst, storm):
            assert "found a proposal for the parameters 1" in proposer.answer(several)
        peer_node.until(lambda: peer_node.counted("refused proposal: sender", 100), each=peer_node.send)
        assert peer_node.counted("refused proposal: malformed")
        assert peer_node.counted("refused proposal: rate")  # a second one in a tick
        peer_node.until(lambda: len(missed(peer_node, begin_ns)) >= 2, each=peer_node.send)
        counts = list(missed(peer_node, begin_ns).values())
        assert (counts[-1] - counts[0]) * PERIOD_NS <= host_delay.limit_ns()  # a storm delays no tick


def flown_at(peer_node: Peer) -> dict[int, int]:
    """The digest of the parameters of each tick, by its instant, ns."""
    ticks = [dict(zip(message.name, message.position, strict=True)) for message in peer_node.received["internals"]]
    stamps = map(stamp_ns, peer_node.received["internals"])
    return {stamp + nanoseconds(tick["age"]): int(tick["parameters"]) for stamp, tick in zip(stamps, ticks, strict=True)}


def get(peer_node: Peer) -> float:
    """The bound of the observer, as the controller's parameter."""
    names = GetParameters.Request(names=["observer.part"])
    answer = peer_node.call(GetParameters, "controller/get_parameters", names, each=peer_node.send)
    return float(answer.values[0].double_value)


def test_law_flies_on_without_its_learner_and_takes_another(start: Start, tmp_path: Path) -> None:
    chosen = scenario(tmp_path, updates=[1.0, 2.5])
    command = start("flight_cli.cli", "fly", str(chosen.path), "--duration", "60", "--runs", "runs")
    command.wait_for("no model: record: found")
    learning = command.child("flight_learner.main")
    learning.suspend()
    logged = sum(path.stat().st_size for path in (tmp_path / "runs").rglob("*.mcap"))
    command.wait_for_log(tmp_path / "runs", logged + 100_000)  # the flight goes on beside the stopped learner: half a second
    learning.kill()
    command.wait_for("learner was killed by SIGKILL: the law flies on with the model that it has")
    said = command.output.count("no model: record")
    start("flight_learner.main", "--ros-args", "-p", f"scenario_file:={chosen.path}").wait_for("no model: record")
    command.until(lambda: command.output.count("no model: record") > said)
    # no byte more, as on a full disk: the write fails, and Python ignores SIGXFSZ
    command.child("flight_recorder.main").rlimit(psutil.RLIMIT_FSIZE, (0, 0))
    recorder_log = next((tmp_path / "runs").rglob("recorder.log"))
    command.until(lambda: "recording ended" in recorder_log.read_text())
    said = command.output.count("t = ")
    command.until(lambda: command.output.count("t = ") > said)
    assert command.interrupt().end() == 130  # it flew on until then


def test_deactivated_law_ends_the_record(start: Start, tmp_path: Path) -> None:
    """The times of the identifications count from the next engagement, and the record before is forgotten."""
    chosen, said = scenario(tmp_path, updates=[3.0]), list[str]()
    controller = chosen.rise_di()
    names = ("mode", "age", "parameters", *(f"{group}.{name}" for group, of in CHANNELS for name in getattr(controller, of)))

    with peer(topics=()) as peer_node:
        learning = ("--ros-args", "-p", f"scenario_file:={chosen.path}", "-p", "lockstep:=true")
        start("flight_learner.main", *learning).wait_for("learner")
        publish = peer_node.node.create_publisher(INTERNALS.type, INTERNALS.name, LOCKSTEP).publish
        peer_node.node.create_subscription(
            PROPOSAL.type, PROPOSAL.name, lambda raw: said.append(reports.decode(raw).sentence), LOCKSTEP, raw=True
        )
        peer_node.until(
            lambda: peer_node.node.count_subscribers(INTERNALS.name) and peer_node.node.count_publishers(PROPOSAL.name)
        )
        for t, mode in (
            (1, Mode.ENGAGED),
            (3, Mode.ENGAGED),
            (3.5, Mode.INACTIVE),
            (5, Mode.ENGAGED),
            (7, Mode.ENGAGED),
            (8, Mode.ENGAGED),
        ):
            values = np.array([float(mode), 0.0, float(controller.digest()), *np.zeros(len(names) - 3)])
            publish(to_message(nanoseconds(t), names, values, "controller#1"))
        peer_node.until(lambda: said)
    assert said == ["record: found 3.01 s, expected 10 s"]  # from 5 to 8 s


def test_learner_refuses_a_scenario_that_does_not_learn(start: Start) -> None:
    node = start("flight_learner.main", "--ros-args", "-p", f"scenario_file:={find_scenario('osprey_servo').path}")
    assert node.end() == 2
    assert "error: learner.scenario_file: found a scenario without controller.learn" in node.output
