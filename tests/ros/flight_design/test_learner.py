# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test the learner's node and the controller: lockstep, foreign proposals, and a restart."""

from pathlib import Path

import psutil
from tests.recordings import require_equal_bits
from tests.ros.conftest import Start

from flight_analysis.closed_loop.guidance_replay import replay_guidance
from flight_analysis.closed_loop.replay import replay
from flight_analysis.closed_loop.scenario import Scenario
from flight_analysis.closed_loop.scenario_library import find_scenario, save_scenario
from flight_analysis.closed_loop.simulate import simulate
from flight_bringup.fly import fly_over_topics
from flight_core.channels import UNKNOWN
from flight_core.outcome import COMPLETED
from flight_core.rates import nanoseconds
from flight_design.learning.scenario_learner import learner
from flight_log.tape_reader import read_run
from rise_di_controller.learning.proposals import Event, EventKind


def scenario(folder: Path, **learn: object) -> Scenario:
    """Return osprey_learn at 100 Hz, with the aircraft of the file."""
    learning = find_scenario("osprey_learn").vary(
        flight={"duration": 11.0},
        aircraft={"rate": 100.0, "step": 0.005, "uncertainty": {"A": 0.0, "B": 0.0}},
        reference_model={"rate": 100.0},
        controller={"learn": {"updates": [10.0], "latency": 0.5} | learn},
    )
    return save_scenario(learning, folder / "learn.yaml")


def test_lockstep_with_a_learner_is_equal_to_the_byte_to_one_process_and_replays_to_the_bit(
    tmp_path: Path,
) -> None:
    """The aircraft is off by 30 %, and the flight has a fallback and then a model.

    It ends at the tick that waits for the second proposal, and in which the third search begins.
    """
    guided = scenario(tmp_path, updates=[10.0, 10.5]).vary(
        flight={"duration": 10.5},
        aircraft={"kinematics": "euler", "uncertainty": {"A": 0.3, "B": 0.3, "seed": 3}},
        reference_model={"pulses": {}, "coordinated_turn": None, "live": {"speed": 25.0}},
        guidance={
            "program": {
                "heading": {"start": [1.0, 4.0], "value": [0.5, -0.5]},
                "altitude": {"start": [1.0, 3.0], "value": [20.0, 0.0]},
            }
        },
    )
    flight_scenario = save_scenario(guided, tmp_path / "learn.yaml")
    events = list[Event]()
    lines = list[str]()
    run = tmp_path / "run"
    outcome = fly_over_topics(
        flight_scenario, run, lambda t, text: None, lockstep=True, announce=lines.append
    )
    assert outcome == COMPLETED
    tape = simulate(flight_scenario, learn=learner(flight_scenario), announce=events.append)
    proposals = [event for event in events if event.kind is not EventKind.FALLBACK]
    assert [event.stamp_ns for event in proposals] == [nanoseconds(t) for t in (0.5, 10.5)]
    # the airframe file, before there is a record, and a model
    assert all(event.change for event in proposals)
    assert lines == [f"t = {event.stamp_ns / 1e9:.2f} s: {event.sentence}" for event in events]
    recorded = read_run(run).tape
    require_equal_bits(recorded, tape)
    result = replay(run)
    assert result.is_equal()
    assert result.is_compared.all()
    steps = replay_guidance(recorded, flight_scenario.guidance)
    assert steps.is_equal()
    assert steps.checked == steps.steps
    assert recorded["guidance"]["authority.p"].min() < UNKNOWN  # guidance knows what was learned


def test_law_flies_on_without_its_learner_and_takes_another(start: Start, tmp_path: Path) -> None:
    # on a busy host the design of the airframe file, 2 s of a core at low priority, takes a minute
    killed_scenario = scenario(tmp_path, updates=[1.0, 2.5], window=600.0)
    command = start(
        "flight_cli.cli",
        "fly",
        str(killed_scenario.path),
        "--real-time",
        "--duration",
        "240",
        "--runs",
        "runs",
    )
    command.wait_for("flies the airframe osprey as it is, until a model is learned")
    learning = command.child("flight_design.main")
    learning.suspend()
    logged = sum(path.stat().st_size for path in (tmp_path / "runs").rglob("*.mcap"))
    # the flight goes on beside the stopped learner: half a second
    command.wait_for_log(tmp_path / "runs", logged + 100_000)
    learning.kill()
    command.wait_for("learner was killed by SIGKILL: the law continues with the model that it has")
    said = command.output.count("no model: record")
    start(
        "flight_design.main", "--ros-args", "-p", f"scenario_file:={killed_scenario.path}"
    ).wait_for("no model: record")
    command.until(
        lambda: command.output.count("no model: record") > said,
        "an identification of another learner",
    )
    # no byte more, as on a full disk: the write fails, and Python ignores SIGXFSZ
    command.child("flight_recorder.main").rlimit(psutil.RLIMIT_FSIZE, (0, 0))
    recorder_log = next((tmp_path / "runs").rglob("recorder.log"))
    command.until(lambda: "recording ended" in recorder_log.read_text(), "the end of the recording")
    said = command.output.count("t = ")
    command.until(lambda: command.output.count("t = ") > said, "a line of the flight")
    assert command.interrupt().end() == 130  # it flew on until then
