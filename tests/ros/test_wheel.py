# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test that the wheel, installed among packages with its names, flies, reports and replays."""

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from tests.conftest import REPOSITORY
from tests.ros.waiting import HANG

PACKAGES = sorted(
    path.parent.name for path in (REPOSITORY / "ros_ws" / "src").glob("*/package.xml")
)
DECOY = "raise RuntimeError(f'{__name__} of a foreign package')\n"

Run = Callable[..., str]


def write_package(folder: Path, name: str) -> None:
    """Write a package that cannot be imported, and the metadata of its installation."""
    for path, text in {
        f"{name}/__init__.py": DECOY,
        f"{name}-9.9.dist-info/METADATA": f"Metadata-Version: 2.1\nName: {name}\nVersion: 9.9\n",
    }.items():
        (folder / path).parent.mkdir(parents=True)
        (folder / path).write_text(text)


@pytest.fixture
def installed(tmp_path: Path) -> Path:
    """Return the folder of the installed wheel, which also has a foreign package named guidance.

    PyPI has a package with this name.
    """
    built = tmp_path / "built"
    target = tmp_path / "installed"
    build = (
        sys.executable,
        "-m",
        "hatchling",
        "build",
        "--target",
        "wheel",
        "--directory",
        str(built),
    )
    subprocess.run(build, cwd=REPOSITORY, check=True, capture_output=True, timeout=HANG)
    (wheel,) = built.glob("*.whl")
    options = ("--quiet", "--no-index", "--no-deps", "--target", str(target))
    subprocess.run(
        (sys.executable, "-m", "pip", "install", *options, str(wheel)), check=True, timeout=HANG
    )
    write_package(target, "guidance")
    return target


@pytest.fixture
def run(installed: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Run:
    """Return a function that runs Python with the wheel.

    Foreign packages of all names are in the working folder, and behind the wheel on the path.
    """
    behind = tmp_path / "behind"
    working = tmp_path / "working"
    for name in PACKAGES:
        write_package(behind, name)
        write_package(working, name)
    monkeypatch.setenv("PYTHONPATH", f"{installed}{os.pathsep}{behind}")

    def run_python(*arguments: str) -> str:
        command = [sys.executable, *arguments]
        process = subprocess.run(
            command, cwd=working, capture_output=True, text=True, timeout=HANG, check=False
        )
        assert process.returncode == 0, process.stdout + process.stderr
        return process.stdout

    return run_python


def test_the_wheel_flies_beside_strangers(installed: Path, run: Run) -> None:
    """Every imported package comes from the wheel.

    In one process, and as four processes over DDS, the replay is equal to the bit.
    """
    code = (
        f"import importlib\nfor name in {PACKAGES}: print(importlib.import_module(name).__file__)"
    )
    assert run("-P", "-c", code).split() == [
        str(installed / name / "__init__.py") for name in PACKAGES
    ]
    assert [path.name for path in (installed / "bin").iterdir()] == ["rise-di"]
    rise_di = str(installed / "bin" / "rise-di")
    for option in ("--in-process", "--lockstep"):
        words = ("fly", "osprey_gust", "--duration", "0.5", option)
        assert "outcome: completed" in run(rise_di, *words)
        assert run(rise_di, "replay", "runs/latest") == "51 ticks, every bit equal\n"
    assert "outcome: completed" in run(rise_di, "report", "runs/latest")
