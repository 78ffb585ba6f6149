# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test that every command of every page exists.

`rise-di` parses it, `make` has the target, ROS 2 the executable, and Python the module. The quick
ones are run as they stand. tests/docs/test_pages.py runs all commands of the tutorials.
"""

import re
import runpy
import shlex
import shutil
import sys
from contextlib import suppress
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any
from unittest.mock import patch

import pytest
import typer
import typer.core
from tests import launch_stand_in
from tests.conftest import REPOSITORY, invoke

from flight_cli.cli import COMMANDS, application

FOLDERS = ("docs", "docker", "examples", "ros_ws/src")
PAGES = sorted(
    [
        *REPOSITORY.glob("*.md"),
        *(page for folder in FOLDERS for page in (REPOSITORY / folder).rglob("*.md")),
    ]
)
SHELL = re.compile(r"^```sh\n(.*?)^```$", re.MULTILINE | re.DOTALL)
INDENTED = re.compile(r"^    (?:\$ )?(\S.*)$", re.MULTILINE)
SPAN = re.compile(r"(?<!`)`rise-di (\w[\w-]*)([^`]*)`(?!`)")

SOURCES = REPOSITORY / "ros_ws" / "src"


@cache
def whole_command() -> typer.core.TyperGroup:
    """Return `rise-di` with every command, whose modules are imported here."""
    command = typer.main.get_command(application([*COMMANDS]))
    assert isinstance(command, typer.core.TyperGroup)
    return command


def rise_di(words: list[str]) -> None:
    """Check that the command and its options exist, and that their values have the right types."""
    command: Any = whole_command()
    name: str | None = "rise-di"
    rest = [*words]
    # --help and --version exit
    with suppress(typer.Exit):
        context = command.make_context(name, rest)
        while isinstance(command, typer.core.TyperGroup):  # a verb of `gains` follows it
            words_left = [*context._protected_args, *context.args]
            name, command, rest = command.resolve_command(context, words_left)
            context = command.make_context(name, rest, parent=context)


def make(words: list[str]) -> None:
    """Check that the target exists."""
    folder = REPOSITORY
    if words[:1] == ["-C"]:
        folder = folder / words[1]
        words = words[2:]
    rules = re.findall(r"^([\w. -]+):(?!=)", (folder / "Makefile").read_text(), re.MULTILINE)
    targets = " ".join(rules).split()
    asked = [word for word in words if "=" not in word]
    assert asked == [] or asked[0] in targets


def ros2(words: list[str]) -> None:
    """Check that the workspace has the executable, or the launch file with these arguments."""
    if words[0] == "run":
        assert f'"{words[2]} = ' in (SOURCES / words[1] / "setup.py").read_text()
    elif words[0] == "launch" and words[1].endswith(".launch.py"):
        assert words[2:] == [], "a launch file of the reader's own has arguments of its own"
    elif words[0] == "launch":
        with patch.dict(sys.modules, launch_stand_in.modules()):
            launch = runpy.run_path(str(SOURCES / words[1] / "launch" / words[2]))[
                "generate_launch_description"
            ]()
        known = {
            argument.name
            for argument in launch.entities
            if isinstance(argument, launch_stand_in.DeclareLaunchArgument)
        }
        assert {word.partition(":=")[0] for word in words[3:] if not word.startswith("--")} <= known
    else:
        assert words[0] in {"bag", "pkg", "security", "service", "topic"}


def python(words: list[str]) -> None:
    """Check that the module can be imported."""
    if words[0] == "-m":
        assert find_spec(words[1]) is not None
        assert all(Path(word).exists() for word in words[2:] if word.startswith("tests/"))


# a second or two each on a short run, and without ROS
QUICK = {"airframes", "replay", "report"}
CHECKS = {"rise-di": rise_di, "make": make, "ros2": ros2, "python": python, "python3": python}


def lines(page: Path) -> list[str]:
    """Return the lines in the blocks of a page.

    A line that ends with a backslash continues in the next one.
    """
    text = re.sub(r"\\\n *", "", page.read_text())
    return [
        *(line for block in SHELL.findall(text) for line in block.splitlines()),
        *INDENTED.findall(text),
    ]


def commands(line: str) -> list[list[str]]:
    """Return the words of each command of CHECKS in a line of shell."""
    lexer = shlex.shlex(line, posix=True, punctuation_chars=";&|<>()")
    lexer.whitespace_split = True
    found: list[list[str]] = []
    begins = True
    for word in lexer:
        if set(word) <= set(";&|<>()"):
            begins = True
        elif begins and "=" not in word:  # else a variable of its environment
            found.append([Path(word).name])
            begins = False
        elif not begins:
            found[-1].append(word)
    return [words for words in found if words[0] in CHECKS]


def test_commands_of_pages_exist() -> None:
    mistakes = [
        mistake for page in PAGES for line in lines(page) if (mistake := mistake_in(line, page))
    ]
    assert not mistakes, "\n".join(mistakes)


def mistake_in(line: str, page: Path) -> str:
    """Return page, line and error of a command that does not exist, or "" if all exist."""
    try:
        for name, *words in (
            commands(line) if any(f"{name} " in f"{line} " for name in CHECKS) else ()
        ):
            CHECKS[name](words)
    except Exception as error:
        return f"{page.relative_to(REPOSITORY)}: {line}: {error!r}"
    return ""


def test_options_in_the_text_of_pages_exist() -> None:
    unknown = []
    for page in PAGES:
        for name, rest in SPAN.findall(page.read_text()):
            command: Any = whole_command().commands[name]
            verb = rest.split()[:1]
            if isinstance(command, typer.core.TyperGroup) and verb:
                command = command.commands[verb[0]]
            known = {option for parameter in command.params for option in parameter.opts}
            if options := set(re.findall(r"(?<!\S)--[a-z-]+", rest)) - known:
                unknown.append(f"{page.relative_to(REPOSITORY)}: rise-di {name}: {options}")
    assert not unknown, "\n".join(unknown)


def test_quick_commands_of_pages_run_as_they_stand(
    recorded: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for run in ("latest", "A", "B", "module"):
        shutil.copytree(recorded, tmp_path / "runs" / run)
    monkeypatch.chdir(tmp_path)
    indented = [line for page in PAGES for line in INDENTED.findall(page.read_text())]
    found = {
        tuple(words[1:])
        for line in indented
        if "rise-di " in line
        for words in commands(line)
        if words[1:]
    }
    quick = sorted(words for words in found if words[0] in QUICK)
    assert {words[0] for words in quick} == QUICK
    for words in quick:
        done = invoke(*words)
        differs = words[0] == "replay" and "--set" in words  # status 1: other gains give another u
        assert done.exit_code == int(differs), f"{' '.join(words)}\n{done.output}"
