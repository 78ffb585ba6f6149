# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Collect the provenance of a flight for the metadata of a log, as named sets of strings.

The provenance consists of versions, revision, host and command.
"""

import os
import platform
import shlex
import shutil
import subprocess
import sys
from collections.abc import Mapping
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import psutil

from flight_core.arithmetic import ARITHMETIC

# All packages of the stack, as in ros_ws/src.
STACK = (
    "aircraft_sim",
    "autopilot_bridge",
    "c_export",
    "control_laws",
    "flight_analysis",
    "flight_bringup",
    "flight_campaign",
    "flight_cli",
    "flight_core",
    "flight_log",
    "flight_recorder",
    "flight_ros",
    "flight_view",
    "flight_guidance",
    "flight_design",
    "reference_model",
    "rise_di",
    "rise_di_controller",
)
# The dependencies that affect the numbers and the bytes of a flight. The middleware is listed by
# the names of its wheels.
DEPENDENCIES = (
    "jsbsim",
    "mcap",
    "numpy",
    "PyYAML",
    "rclpy",
    "ros-fastrtps",
    "ros-rmw-fastrtps-cpp",
    "scipy",
    "zstandard",
)

FLIGHT = "rise_di_flight"  # name of the metadata record with start and command
VERSIONS = "rise_di_versions"  # name of the versions in the metadata of a log
GIT_TIMEOUT = 5.0  # s


def provenance() -> dict[str, dict[str, str]]:
    """Return the provenance of this process now; values that cannot be determined are missing."""
    return {
        FLIGHT: {
            "start": datetime.now(UTC).isoformat(timespec="seconds"),
            "command": shlex.join(sys.argv),
        },
        VERSIONS: versions(),
        "rise_di_revision": revision(Path(__file__).resolve()),
        "rise_di_host": host(),
    }


def recorded_arithmetic(metadata: Mapping[str, Mapping[str, str]]) -> str:
    """Return the version of the arithmetic with which the u of a log was computed.

    If the log does not state it, return the present version.
    """
    return metadata.get(VERSIONS, {}).get("arithmetic", ARITHMETIC)


def versions() -> dict[str, str]:
    """Return the versions of Python, the arithmetic of u, the stack and its main dependencies.

    Only packages that are installed are listed.
    """
    installed = {"python": platform.python_version(), "arithmetic": ARITHMETIC}
    for name in (*STACK, *DEPENDENCIES):
        try:
            installed[name] = version(name)
        except PackageNotFoundError:
            continue
    if distribution := os.environ.get("ROS_DISTRO"):
        installed["ROS_DISTRO"] = distribution
    return installed


def revision(source: Path) -> dict[str, str]:
    """Return the git commit of a source file, and `dirty`: "true" if a tracked file has changed.

    The result is empty if the file is in no commit.
    """
    git = shutil.which("git")
    if git is None:
        return {}

    def output(*arguments: str) -> str:
        command = [git, "--no-optional-locks", "-C", str(source.parent), *arguments]
        return subprocess.run(  # noqa: S603
            command, capture_output=True, text=True, timeout=GIT_TIMEOUT, check=True
        ).stdout.strip()

    try:
        # An installed copy may lie inside the checkout of another project.
        output("ls-files", "--error-unmatch", source.name)
        commit = output("rev-parse", "HEAD")
        changes = output("status", "--porcelain", "--untracked-files=no")
    except (OSError, subprocess.SubprocessError):
        return {}
    return {"commit": commit, "dirty": "true" if changes else "false"}


def host() -> dict[str, str]:
    """Describe the host without its name: system and kernel, processor, cores, memory."""
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
    return next(
        (line.partition(":")[2].strip() for line in lines if line.startswith("model name")),
        platform.processor(),
    )
