# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""What installs a missing Python package: make in a checkout, elsewhere pip with an extra of the wheel `rise-di`."""

from importlib.util import find_spec
from pathlib import Path

from flight_core.parameters import ParameterError

CHECKOUT = Path(__file__).resolve().parents[4]
"""The root of the repository, if this file is ros_ws/src/flight_core/flight_core/installation.py there."""

TARGETS = {
    "ros": "make setup",
    "campaign": "make setup-all",
    "foxglove": "make foxglove",
    "autopilot": "make autopilot",
    "tools": "make setup-all",
}
"""The targets of the Makefile by the extras of pyproject.toml."""

EXTRAS = {
    "rclpy": "ros",
    "cma": "campaign",
    "distributed": "campaign",
    "jax": "campaign",
    "foxglove": "foxglove",
    "pymavlink": "autopilot",
    "pyulog": "autopilot",
    "control": "tools",
    "gymnasium": "tools",
}
"""The extras of pyproject.toml by the packages that a command may lack."""

MESSAGE_SUFFIXES = ("_msgs", "_interfaces", "_srvs")


def require_package(package: str, remark: str = "") -> None:
    """Raise ParameterError, with the remark at the end of the sentence, where a Python package is not installed."""
    if find_spec(package) is None:
        raise ParameterError(missing(package) + remark)


def missing(package: str) -> str:
    """A sentence on a package that is not installed: "found no Python package jax, expected it: make setup-all"."""
    in_checkout = (CHECKOUT / "Makefile").is_file() and (CHECKOUT / "ros_ws").is_dir()
    of_messages = package.endswith(MESSAGE_SUFFIXES)
    extra = "ros" if of_messages and find_spec("rclpy") is None else EXTRAS.get(package)
    ways = ""
    if extra is not None:
        ways = f": {TARGETS[extra]}" if in_checkout else f': pip install "rise-di[{extra}]"'
    elif of_messages:
        build = f"make messages PACKAGE={package} SOURCE=FOLDER builds it from its sources; " if in_checkout else ""
        ways = f": {build}on a full ROS 2 install ros-jazzy-{package.replace('_', '-')}, or source a workspace with it"
    return f"found no Python package {package}, expected it{ways}"
