# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test the attachments, metadata and provenance of a log.

They are sufficient to repeat the flight from the file alone.
"""

import math
import os
import shlex
import shutil
import subprocess
import sys
from importlib.metadata import version
from pathlib import Path

import numpy as np
import pytest
from tests.conftest import REPOSITORY, refusing
from tests.joint_states import vector

from aircraft_sim.airframes.airframe import load_airframe
from flight_analysis.closed_loop.scenario import (
    SCHEMAS,
    ParameterOverrides,
    Scenario,
    load_scenario,
)
from flight_analysis.closed_loop.scenario_library import find_scenario, scenarios
from flight_analysis.closed_loop.simulate import simulate
from flight_analysis.report.run_folder import attachments_for
from flight_analysis.report.summary import summarise
from flight_bringup.graph import ONE_PROCESS, RECORDER, parameter_overrides
from flight_log import columns
from flight_log.bag import BagWriter, LogAttachments
from flight_log.log_messages import MAX_TEXT, bounded
from flight_log.named_vectors import JOINT_STATE
from flight_log.provenance import STACK, revision
from flight_log.tape_reader import RecordedRun, read_run
from flight_log.tape_writer import write_run


@pytest.fixture(scope="module")
def recorded(osprey_gust: Scenario, tmp_path_factory: pytest.TempPathFactory) -> RecordedRun:
    """Return a flight in one process, read back.

    Its duration is not the one of the scenario file.
    """
    scenario = osprey_gust.vary(flight={"duration": 0.5})
    run = tmp_path_factory.mktemp("recorded")
    write_run(simulate(scenario), run, attachments_for(scenario, run))
    return read_run(run)


def stored(files: LogAttachments | RecordedRun, name: str, folder: Path) -> Path:
    """Return an attachment as a file."""
    if isinstance(files, RecordedRun):
        (folder / name).write_bytes(
            next(attachment.content for attachment in files.attachments if attachment.name == name)
        )
        return folder / name
    return next(path for path in files.files if path.name == name)


def recorder_attachments(scenario: Scenario, run: Path, *, one_process: bool) -> LogAttachments:
    node, prefix = (ONE_PROCESS, "recorder:") if one_process else (RECORDER, "")
    overrides: ParameterOverrides = parameter_overrides(node, scenario, run, 0.0, lockstep=True)
    attach = overrides[f"{prefix}attach"]
    metadata = overrides[f"{prefix}metadata_file"]
    assert isinstance(attach, list)
    return LogAttachments(scenario.path, tuple(map(Path, map(str, attach))), Path(str(metadata)))


def test_logged_parameters_are_scenario_of_that_flight(
    recorded: RecordedRun, osprey_gust: Scenario, tmp_path: Path
) -> None:
    again = load_scenario(stored(recorded, "parameters.yaml", tmp_path))
    assert again.flight.duration == 0.5  # that of the flight, not of the file
    for name in SCHEMAS:
        if name != "flight":
            assert getattr(again, name) == getattr(osprey_gust, name)
    assert recorded.scenario == ("osprey_gust.yaml", osprey_gust.path.read_bytes())


@pytest.mark.parametrize("name", scenarios())
def test_every_scenario_is_restored_from_its_parameters(name: str, tmp_path: Path) -> None:
    scenario = find_scenario(name)
    again = load_scenario(stored(attachments_for(scenario, tmp_path), "parameters.yaml", tmp_path))
    for section in SCHEMAS:
        assert getattr(again, section) == getattr(scenario, section)


def test_parameters_include_overrides_of_nodes(osprey_gust: Scenario, tmp_path: Path) -> None:
    for one_process in (False, True):
        files = recorder_attachments(osprey_gust, tmp_path, one_process=one_process)
        again = load_scenario(stored(files, "parameters.yaml", tmp_path))
        assert again.aircraft.lockstep
        assert again.reference_model.lockstep
        assert (again.aircraft.control_rate, again.aircraft.duration) == (100.0, 60.0)
        assert again.aircraft.recorded is not one_process
        assert again.controller.y_rate == 500.0
        assert again.recorder.directory == str(tmp_path)


def test_airframe_in_log_is_one_that_flew(
    recorded: RecordedRun, osprey_gust: Scenario, tmp_path: Path
) -> None:
    assert load_airframe(str(stored(recorded, "airframe.yaml", tmp_path))) == load_airframe(
        "osprey"
    )
    sampled = osprey_gust.vary(aircraft={"uncertainty": {"A": 0.3, "B": 0.1, "seed": 7}})
    again = load_airframe(
        str(stored(attachments_for(sampled, tmp_path), "airframe.yaml", tmp_path))
    )
    assert again.A == sampled.aircraft.sampled_airframe().A
    assert not np.array_equal(again.matrix_a(), load_airframe("osprey").matrix_a())


def test_the_metadata_hold_versions_command_and_host(recorded: RecordedRun) -> None:
    for name in ("numpy", "flight_recorder"):
        assert recorded.metadata["rise_di_versions"][name] == version(name)
    assert recorded.metadata["rise_di_flight"]["command"] == shlex.join(sys.argv)
    assert recorded.metadata["rise_di_flight"]["start"].endswith("+00:00")
    assert recorded.metadata["rise_di_host"]["kernel"] == os.uname().release
    assert recorded.metadata["rise_di_host"]["cores"] == str(os.cpu_count())


def test_versions_cover_all_packages_of_stack() -> None:
    assert set(STACK) == {
        path.parent.name for path in (REPOSITORY / "ros_ws" / "src").glob("*/package.xml")
    }


def test_revision_is_commit_and_marks_local_changes(tmp_path: Path) -> None:
    git = shutil.which("git")
    if git is None:
        pytest.skip("no git here")
    source = tmp_path / "source.py"
    source.write_text("a = 1\n")
    assert revision(source) == {}  # not in a checkout

    def run(*words: str) -> str:
        identity = ("-c", "user.name=tester", "-c", "user.email=tester@example.com")
        return subprocess.run(
            [git, "-C", str(tmp_path), *identity, *words],
            check=True,
            capture_output=True,
            text=True,
        ).stdout

    run("init")
    assert revision(source) == {}  # an untracked file inside a checkout
    run("add", "source.py")
    run("commit", "-m", "first")
    assert revision(source) == {"commit": run("rev-parse", "HEAD").strip(), "dirty": "false"}
    source.write_text("a = 2\n")
    assert revision(source)["dirty"] == "true"


def test_folder_that_cannot_be_written_is_one_sentence(
    osprey_gust: Scenario, tmp_path: Path
) -> None:
    with refusing(r"nowhere/parameters.yaml cannot be written \(No such file or directory\)"):
        attachments_for(osprey_gust, tmp_path / "nowhere")


def test_pose_whose_first_samples_lack_channel_read_with_it(tmp_path: Path) -> None:
    # The topics of an autopilot begin at different times: its first poses may be without climb.
    with BagWriter(tmp_path / "run") as bag:
        topic = bag.add_topic("/pose", JOINT_STATE, "")
        for k in range(1, 7):
            message = (
                vector(k, ["phi"], [0.1]) if k < 3 else vector(k, ["phi", "climb"], [0.1, float(k)])
            )
            bag.write(topic, k, k, k, message)
        # Of another publisher.
        for k in range(7, 17):
            bag.write(topic, k, k, k, vector(k, ["z"], [0.1]))
    tape = read_run(tmp_path / "run").tape
    assert tape["pose"]["climb"].tolist() == [3.0, 4.0, 5.0, 6.0]
    assert "pose: 12 samples refused: damaged, not finite, or of other channels" in tape.notes
    assert tape.refused == {"pose": 12}


def test_summary_of_log_whose_y_was_refused_names_the_refusal(
    tmp_path: Path, osprey_gust: Scenario
) -> None:
    with BagWriter(tmp_path / "run") as bag:
        for name, value in (("y", math.nan), ("y_m", 0.0)):
            topic = bag.add_topic(f"/{name}", JOINT_STATE, "")
            for k in range(1, 4):
                bag.write(topic, k, k, k, vector(k, ["q"], [value]))
    refused = (
        r"no sample of y \(y: 3 samples refused: damaged, not finite, or of other "
        r"channels\), expected"
    )
    with refusing(refused):
        summarise(read_run(tmp_path / "run").tape, osprey_gust)


@pytest.mark.parametrize("indexed", [True, False])
def test_long_topic_kept_in_file_has_bits_of_one_in_memory(
    recorded: RecordedRun, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, *, indexed: bool
) -> None:
    log = next(Path(str(recorded.path)).glob("*.mcap")).read_bytes()
    # Without its index a log does not tell the number of samples.
    (tmp_path / "log.mcap").write_bytes(log if indexed else log[: -len(log) // 20])
    plain = read_run(tmp_path / "log.mcap").tape
    monkeypatch.setattr(columns, "IN_MEMORY", 1000)
    tape = read_run(tmp_path / "log.mcap").tape
    for name, signal in plain.signals.items():
        in_file = tape[name]
        half_ns = int(signal.stamp_ns[len(signal.stamp_ns) // 2])
        assert in_file.values.tobytes("F") == signal.values.tobytes("F")
        assert in_file[signal.names[-1]].tobytes() == signal[signal.names[-1]].tobytes()
        assert in_file.until(half_ns).values.tobytes("F") == signal.until(half_ns).values.tobytes(
            "F"
        )
    assert tape["truth"].group("x").values.tobytes("F") == plain["truth"].group("x").values.tobytes(
        "F"
    )
    assert tape["truth"].group("x").names == plain["truth"].group("x").names
    assert not tape["truth"].values.flags.owndata  # mapped


def test_long_text_of_log_ends_with_mark_of_its_cut() -> None:
    # a number cut in its digits reads as another number
    assert bounded(f"omega = {'1' * MAX_TEXT}").endswith("11 ...")
    assert len(bounded("1" * (MAX_TEXT + 1))) == MAX_TEXT
    assert bounded("1" * MAX_TEXT) == "1" * MAX_TEXT
