# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test the command line with random input.

Invalid input must give an exit status and one sentence, and no traceback or hang.
"""

import io
import signal
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path
from typing import NamedTuple
from unittest.mock import patch

import pytest
from hypothesis import given
from hypothesis import strategies as st
from tests.conftest import few
from tests.fuzz.targets import SEEDS

from flight_cli import cli


class CommandResult(NamedTuple):
    """The exit status and the output of a command."""

    status: int
    output: str
    errors: str


def rise_di(*arguments: str) -> CommandResult:
    """Run the command in this process.

    An exception other than SystemExit would be a traceback.
    """
    output = io.StringIO()
    errors = io.StringIO()
    status = 0
    handler = signal.getsignal(signal.SIGINT)
    with (
        patch("sys.argv", ["rise-di", *arguments]),
        redirect_stdout(output),
        redirect_stderr(errors),
    ):
        try:
            cli.main()
        except SystemExit as end:
            status = end.code if isinstance(end.code, int) else 1
        finally:
            signal.signal(signal.SIGINT, handler)
    return CommandResult(status, output.getvalue(), errors.getvalue())


def require_rejection(result: CommandResult) -> None:
    """Require exit status 2 and one sentence, or Typer's usage text for an invalid option."""
    assert result.status == 2, result
    assert "Traceback" not in result.errors
    sentences = [line for line in result.errors.splitlines() if line.startswith("error: ")]
    if sentences:
        assert len(sentences) == 1
        assert result.errors.splitlines()[-1] == sentences[0]
        assert len(sentences[0]) < 1100
    else:
        assert result.errors.startswith("Usage: "), result.errors


@pytest.fixture
def garbage(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Change to a folder of invalid files."""
    monkeypatch.chdir(tmp_path)
    contents = {"empty": b"", "zeros": bytes(4096), "text": b"not a log", "magic": b"\x89MCAP0\r\n"}
    for name, content in (contents | {"cut": SEEDS["mcap"]()[0][:700]}).items():
        (tmp_path / name).mkdir()
        (tmp_path / name / f"{name}_0.mcap").write_bytes(content)
        (tmp_path / f"{name}.yaml").write_bytes(content)
    for folder in ("folder.yaml", "nothing", "other"):
        (tmp_path / folder).mkdir()
    (tmp_path / "other" / "metadata.yaml").write_text("rosbag2_bagfile_information: 5\n")
    (tmp_path / "other" / "other.db3").write_bytes(b"SQLite format 3\x00" + bytes(200))
    return tmp_path


ODD = ["absent", "folder.yaml", "x" * 5000, ""]
FOLDERS = ["empty", "zeros", "text", "magic", "nothing", "other"]
RUNS = [*ODD, *FOLDERS, "other/other.db3", "text/text_0.mcap", "/dev/null", "a\x1b[2Jb"]


@pytest.mark.parametrize("run", RUNS, ids=range(len(RUNS)))
@pytest.mark.parametrize(
    "command",
    [["report"], ["replay"], ["report", "--repair"], ["play"], ["check", "px4", "--run"]],
    ids=str,
)
def test_an_invalid_run_is_rejected(command: list[str], run: str, garbage: Path) -> None:
    require_rejection(rise_di(*command, run))


FILE_NAMES = ["absent.yaml", "empty.yaml", "zeros.yaml", "text.yaml", "magic.yaml"]
FILES = [*ODD, *FILE_NAMES, "../../x", "x" * 5000 + ".yaml", "\x1b[2J"]


@pytest.mark.parametrize("name", FILES, ids=range(len(FILES)))
@pytest.mark.parametrize(
    "command",
    [
        ["fly", "--in-process"],
        ["fly"],
        ["gains", "select"],
        ["check"],
        ["gains", "check", "osprey", "--scenario"],
    ],
    ids=str,
)
def test_an_invalid_file_is_rejected(command: list[str], name: str, garbage: Path) -> None:
    require_rejection(rise_di(*command, name))


OPTIONS = {
    "fly osprey_gust --in-process --duration": ["nan", "inf", "0", "x", "1e7"],
    "gains select osprey --samples 0 --rate": ["nan", "1e9", "333.3"],
    "gains select osprey --uncertainty": ["nan", "2"],
    "gains select osprey --delay": ["inf", "-1"],
    "gains select osprey --gamma-2": ["nan"],
    "gains select osprey --lag": ["nan", "1,2", ","],
    "gains select osprey --samples 0 --inputs": ["rudder,x"],
    "gains select osprey --samples": ["-1", "1000000000"],
    "gains select osprey --seed": ["x"],
    "play cut --rate": ["nan", "0", "1e9"],
    "play cut --start": ["inf", "-1"],
    "play cut --topics": ["nothing", "\x1b"],
    "play cut --stamps": ["tomorrow"],
    "replay cut --namespace": ["/three", "\x1b[2J"],
    "replay cut --set": ["=", "controller.k_g", "controller.k_g=[", "controller.k_g=&a [*a]"],
    "report cut --png": ["/dev/null/x.png", "nowhere/x.png"],
    "report cut --csv": ["nowhere/x.csv"],
    "report cut --page": ["nowhere/x.html"],
    "check px4 --airframe": ["absent", "text.yaml"],
    "check px4 --scenario": ["absent"],
}


@pytest.mark.parametrize("command", OPTIONS)
def test_an_invalid_value_is_rejected(command: str, garbage: Path) -> None:
    for value in OPTIONS[command]:
        require_rejection(rise_di(*command.split(), value))


COMMANDS = ["fly", "report", "replay", "play", "gains", "check", "airframes", "identify"]
OTHERS = [
    "--json",
    "--set",
    "--in-process",
    "--duration",
    "--run",
    "--",
    "-",
    "--help",
    "--topics",
    "--rate",
    "--check",
]
VALUES = ["osprey", "px4", "cut", "text", "absent", "nan", "0", "y"]
WORDS = st.sampled_from(COMMANDS + OTHERS + VALUES) | st.text(
    st.characters(codec="utf-8", exclude_characters="\0"), max_size=5
)


@few
@given(st.lists(WORDS, max_size=5))
def test_no_arguments_end_in_a_traceback(garbage: Path, words: list[str]) -> None:
    if words[:1] == ["fly"]:
        words = ["fly", "absent", *words[1:]]  # do not fly a valid scenario
    result = rise_di(*words)
    assert result.status in (0, 1, 2)
    assert "Traceback" not in result.errors
