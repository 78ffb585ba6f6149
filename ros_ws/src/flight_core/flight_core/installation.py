# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Tell how to install a missing Python package.

In a checkout, make installs it. Elsewhere, pip installs an extra of `rise-di` from the source of
the installed `rise-di`.
"""

import json
from importlib.metadata import PackageNotFoundError, distribution
from importlib.util import find_spec
from pathlib import Path

from flight_core.parameters import ParameterError

CHECKOUT = Path(__file__).resolve().parents[4]
"""The root of the repository, if this file lies in a repository."""

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
    """Raise ParameterError if a Python package is not installed.

    The sentence of the error ends with the remark.
    """
    if find_spec(package) is None:
        raise ParameterError(missing(package) + remark)


def missing(package: str) -> str:
    """Write a sentence about a package that is not installed.

    For example "the Python package jax is not installed: make setup-all".
    """
    in_checkout = (CHECKOUT / "Makefile").is_file() and (CHECKOUT / "ros_ws").is_dir()
    has_messages = package.endswith(MESSAGE_SUFFIXES)
    extra = "ros" if has_messages and find_spec("rclpy") is None else EXTRAS.get(package)
    ways = ""
    if extra is not None:
        ways = f": {TARGETS[extra] if in_checkout else _pip_command(extra)}"
    elif has_messages:
        build = (
            f"make messages PACKAGE={package} SOURCE=FOLDER builds it from its sources; "
            if in_checkout
            else ""
        )
        ways = (
            f": {build}on a full ROS 2 install ros-jazzy-{package.replace('_', '-')}, or "
            "source a workspace with it"
        )
    return f"the Python package {package} is not installed{ways}"


def _pip_command(extra: str) -> str:
    """Return the command that installs an extra of the stack from the stack's own source.

    The source is a checkout, a wheel, a repository or an index. An unreleased checkout must not
    send its user to an index, where somebody else can have published a package of this name.
    Source: PEP 610. An installation from an index has no direct_url.json.
    """
    try:
        origin = distribution("rise-di").read_text("direct_url.json")
    except PackageNotFoundError:  # a workspace of ROS 2
        return f'pip install ".[{extra}]" in a checkout of the stack'
    if origin is None:
        return f'pip install "rise-di[{extra}]"'
    place = json.loads(origin)
    vcs = f"{place['vcs_info']['vcs']}+" if "vcs_info" in place else ""
    return f'pip install "rise-di[{extra}] @ {vcs}{place["url"]}"'
