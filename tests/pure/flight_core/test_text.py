# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test that no terminal control code in samples, scenarios or folders reaches a user."""

from pathlib import Path

import pytest
from tests.conftest import invoke, refusing
from tests.joint_states import JOINT_STATE, vector

from flight_core.files import display_path
from flight_core.outcome import FlightEnded
from flight_core.parameters import Config, ParameterError
from flight_core.text import MAX_LENGTH
from flight_core.vectors import ChannelError, SampleFault
from flight_log.bag import BagWriter
from flight_log.tape_reader import read_run

ESCAPES = "\x1b[2J\x1b]0;PWNED\x07\nall is well"


@pytest.mark.parametrize(
    "error",
    [
        ParameterError(ESCAPES + 9000 * "x"),
        FlightEnded(ESCAPES + 9000 * "x"),
        ChannelError(SampleFault.NAME, ESCAPES + 9000 * "x"),
    ],
)
def test_exceptions_are_printable_and_bounded(error: Exception) -> None:
    assert str(error).isprintable()
    assert str(error).startswith(r"\x1b[2J\x1b]0;PWNED\x07\nall is well")
    assert len(str(error)) < 2 * MAX_LENGTH


def test_unprintable_text_of_a_scenario_is_refused() -> None:
    class Named(Config):
        name: str

    with refusing(r"name: found .*, expected printable characters"):
        Named.validate_mapping({"name": ESCAPES}, "section")


def test_names_in_a_log_are_printable(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "run") as bag:
        for topic in ("/y", f"/{ESCAPES}"):
            channel = bag.add_topic(topic, JOINT_STATE, "")
            bag.write(channel, 1, 1, 1, vector(1, ("q", ESCAPES), (0.0, 0.0)))
    tape = read_run(tmp_path / "run").tape
    assert len(tape.signals) == 2
    assert all(
        name.isprintable()
        for topic, signal in tape.signals.items()
        for name in (topic, *signal.names)
    )


def test_shown_paths_are_printable() -> None:
    assert display_path(Path("/runs") / ESCAPES).isprintable()


@pytest.mark.parametrize("command", ["report"])
def test_command_prints_names_of_files_as_escapes(command: str, run: Path) -> None:
    name = ESCAPES.replace("\n", "")
    folder = run.rename(run.with_name(name))
    log = next(folder.glob("*.mcap")).rename(folder / f"{name}_0.mcap")
    log.write_bytes(log.read_bytes()[:-1000])
    output = invoke(command, str(folder)).output
    assert r"]0;PWNED\x07" in output
    assert "\x1b" not in output
    assert "\x07" not in output
