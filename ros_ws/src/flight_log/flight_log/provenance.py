# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Where a flight comes from: versions, revision, machine, command. Named sets of strings, for the log's metadata."""

import os
import platform
import shlex
import shutil
import subprocess
import sys
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import psutil

STACK = (
    "aircraft_sim",
    "flight_analysis",
    "flight_bringup",
    "flight_core",
    "flight_recorder",
    "flight_ros",
    "reference_model",
    "rise_di_controller",
)
# What the numbers and the bytes of a flight depend on; the middleware under its names in the wheels.
DEPENDENCIES = (
    "jsbsim",
    "mcap",
    "numpy",
    "pydantic",
    "PyYAML",
    "rclpy",
    "ros-fastrtps",
    "ros-rmw-fastrtps-cpp",
    "scipy",
    "zstandard",
)

GIT_TIMEOUT = 5.0  # s


def provenance() -> dict[str, dict[str, str]]:
    """All of it, of this process now. What cannot be found is left out."""
    return {
        "rise_di_flight": {"start": datetime.now(UTC).isoformat(timespec="seconds"), "command": shlex.join(sys.argv)},
        "rise_di_versions": versions(),
        "rise_di_revision": revision(Path(__file__).resolve()),
        "rise_di_host": host(),
    }


def versions() -> dict[str, str]:
    """Versions of this stack's packages and of the main dependencies, of those that are installed."""
    found = {"python": platform.python_version()}
    for name in (*STACK, *DEPENDENCIES):
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            continue
    if distribution := os.environ.get("ROS_DISTRO"):
        found["ROS_DISTRO"] = distribution
    return found


def revision(source: Path) -> dict[str, str]:
    """The git commit of a source file, and "true" for `dirty` where a tracked file was changed; empty where there is none."""
    git = shutil.which("git")
    if git is None:
        return {}

    def said(*words: str) -> str:
        command = [git, "--no-optional-locks", "-C", str(source.parent), *words]
        return subprocess.run(command, capture_output=True, text=True, timeout=GIT_TIMEOUT, check=True).stdout.strip()  # noqa: S603

    try:
        said("ls-files", "--error-unmatch", source.name)  # an installed copy may lie in a checkout of something else
        commit = said("rev-parse", "HEAD")
        changed = said("status", "--porcelain", "--untracked-files=no")
    except (OSError, subprocess.SubprocessError):
        return {}
    return {"commit": commit, "dirty": "true" if changed else "false"}


def host() -> dict[str, str]:
    """The machine, without its name: system and kernel, processor, cores, memory."""
    return {
        "system": platform.system(),
        "kernel": platform.release(),
        "architecture": platform.machine(),
        "processor": _processor(),
        "cores": str(os.cpu_count()),
        "memory": f"{psutil.virtual_memory().total / 1e9:.1f} GB",
    }


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        return platform.processor()
    return next((line.partition(":")[2].strip() for line in lines if line.startswith("model name")), platform.processor())
