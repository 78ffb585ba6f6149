# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""The sentences on missing packages, in a checkout and with the wheel."""

import re
import tomllib
from pathlib import Path

import pytest
from tests.conftest import REPOSITORY

from flight_core import installation
from flight_core.installation import EXTRAS, TARGETS, missing, require_package
from flight_core.parameters import ParameterError

pytestmark = pytest.mark.package("flight_core")


def test_a_checkout_names_the_target_of_make() -> None:
    assert missing("jax") == "found no Python package jax, expected it: make setup-all"


def test_the_wheel_names_its_extra(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(installation, "CHECKOUT", tmp_path)
    assert missing("jax") == 'found no Python package jax, expected it: pip install "rise-di[campaign]"'
    expected = (
        "found no Python package px4_msgs, expected it: on a full ROS 2 install ros-jazzy-px4-msgs, or source a workspace"
    )
    assert missing("px4_msgs").startswith(expected)


def test_common_messages_come_with_rclpy(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(installation, "find_spec", lambda name: None)
    assert missing("sensor_msgs") == "found no Python package sensor_msgs, expected it: make setup"


def test_an_unknown_package_has_no_remedy() -> None:
    with pytest.raises(ParameterError, match=r"^found no Python package no_such_package, expected it; a remark$"):
        require_package("no_such_package", "; a remark")


def test_targets_and_extras_exist() -> None:
    targets = re.findall(r"^([\w -]+):", (REPOSITORY / "Makefile").read_text(encoding="utf-8"), re.MULTILINE)
    assert {target.removeprefix("make ") for target in TARGETS.values()} <= {word for line in targets for word in line.split()}
    extras = tomllib.loads((REPOSITORY / "pyproject.toml").read_text(encoding="utf-8"))["project"]["optional-dependencies"]
    assert {*TARGETS} == {*EXTRAS.values()} == extras.keys() - {"all"}
