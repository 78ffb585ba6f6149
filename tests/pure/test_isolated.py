# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test the isolated process: what foreign code or a foreign file can reach from it.

What it returns is checked, too.
"""

import ctypes
import logging
import os
import socket
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import suppress
from enum import StrEnum
from functools import cache
from io import BytesIO
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
import pytest
from tests.conftest import refusing

from flight_core import confinement, isolated, notes
from flight_core.outcome import FlightEnded
from flight_core.parameters import ParameterError

TIMEOUT = 60.0  # s of processor time


class Kind(StrEnum):
    """A kind of result."""

    WHOLE = "whole"


class Found(NamedTuple):
    """A result."""

    table: dict[str, np.ndarray]
    fixed: MappingProxyType[str, int]
    kind: Kind = Kind.WHOLE
    none: None = None


class Evil:
    """An object that is pickled as a call of a function."""

    def __reduce__(self) -> Any:
        return (os.system, ("true",))


def call(function: Any, *arguments: Any, **limits: Any) -> Any:
    return isolated.call(function, *arguments, **{"timeout": TIMEOUT, **limits})


@pytest.fixture(autouse=True)
def of_this_folder(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Let the subprocess find this module."""
    monkeypatch.setenv(
        "PYTHONPATH",
        os.pathsep.join([str(Path(__file__).parents[2]), os.environ.get("PYTHONPATH", "")]),
    )
    notes.note.cache_clear()
    yield
    notes.note.cache_clear()


def values() -> Found:
    return Found(
        {"a": np.array([1, 2, 3]), "b": np.array([0.5, np.nan])}, MappingProxyType({"x": 1})
    )


def test_arrays_named_tuples_and_enums_come_back_bit_by_bit() -> None:
    back = call(values)
    assert isinstance(back, Found)
    assert back.kind is Kind.WHOLE
    assert back.table["a"].dtype == np.int64
    assert back.table["b"].tobytes() == np.array([0.5, np.nan]).tobytes()
    assert back.fixed == {"x": 1}


def test_result_that_names_a_function_is_refused() -> None:
    with pytest.raises(
        isolated.IsolatedCallError, match=r"^returned (posix|os)\.system, which is no plain value$"
    ):
        call(Evil)


def path() -> Path:
    return Path()


def test_result_of_another_module_is_refused() -> None:
    with pytest.raises(
        isolated.IsolatedCallError, match=r"^returned pathlib.*, which is no plain value$"
    ):
        call(path)


def test_class_that_the_module_only_imports_is_refused() -> None:
    """StrEnum itself could make new classes."""
    pickled = f"c{__name__}\nStrEnum\n.".encode()
    with pytest.raises(isolated.IsolatedCallError, match=r"\.StrEnum, which is no plain value$"):
        isolated._Reader(BytesIO(pickled), __name__).load()


def ends() -> None:
    raise FlightEnded("the aircraft does not trim")


def refuses() -> None:
    raise ParameterError("log: found nothing, expected a flight")


def test_sentence_of_the_function_is_raised_here() -> None:
    with pytest.raises(FlightEnded, match=r"^the aircraft does not trim$"):
        call(ends)
    with refusing(r"^log: found nothing, expected a flight$"):
        call(refuses)


def grows() -> int:
    return len(bytearray(1 << 30))


def test_memory_is_limited() -> None:
    with pytest.raises(isolated.IsolatedCallError, match="MemoryError"):
        call(grows, memory=512 << 20)
    assert call(grows, memory=2 << 30) == 1 << 30


@cache
def confines() -> bool:
    """Return whether this kernel permits all of it. A process that is then confined asks for it."""
    code = (
        "from pathlib import Path; from flight_core.confinement import confine; raise "
        "SystemExit(len(confine(Path())))"
    )
    return subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def reaches(port: int) -> str:
    try:
        socket.create_connection(("127.0.0.1", port), timeout=5.0).close()
    except OSError:
        return "no network"
    return "reached"


def test_no_network() -> None:
    if not confines():
        pytest.skip("this kernel permits no namespace or no landlock")
    with socket.create_server(("127.0.0.1", 0)) as server:
        assert call(reaches, server.getsockname()[1]) == "no network"


WAYS = ("write", "append", "cut", "remove", "replace", "beside", "link", "folder", "socket")


def changes(path: str) -> list[str]:
    """Write a file in the working folder. Return the ways in which a user's file was changed."""
    Path("own").write_text("own")
    file = Path(path)
    ways: dict[str, Callable[[], object]] = {
        "write": lambda: file.write_text(""),
        "append": lambda: file.open("a").close(),
        "cut": lambda: os.truncate(path, 0),
        "remove": file.unlink,
        "replace": lambda: Path("own").replace(file),
        "beside": lambda: file.with_name("new").touch(),
        "link": lambda: file.with_name("new").symlink_to(file),
        "folder": file.with_name("new").mkdir,
        "socket": lambda: socket.socket(socket.AF_UNIX).bind(str(file.with_name("new"))),
    }
    done = []
    for way in WAYS:
        with suppress(OSError):
            ways[way]()
            done.append(way)
    return done


def test_no_file_of_the_user_changes(tmp_path: Path) -> None:
    if not confines():
        pytest.skip("this kernel permits no namespace or no landlock")
    file = tmp_path / "file"
    file.write_text("precious")
    assert call(changes, str(file)) == []
    assert file.read_text() == "precious"
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


def test_kernel_that_refuses_confinement_is_said_once(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    class Kernel:
        """A kernel that refuses every call."""

        def __getattr__(self, name: str) -> Any:
            return lambda *_arguments: (ctypes.set_errno(1) and -1) or -1

    monkeypatch.setattr(confinement, "_LIBC", Kernel())
    sentences = confinement.confine(Path.cwd())
    assert len(sentences) == 2
    assert all(sentence.startswith("foreign files are read with ") for sentence in sentences)
    with caplog.at_level(logging.WARNING):
        for sentence in [*sentences, *sentences]:
            notes.note(sentence)
    assert caplog.messages == [f"note: {sentence}" for sentence in sentences]
