# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test the sentences about missing packages, in a checkout and with the wheel."""

import re
import tomllib
from importlib.metadata import PackageNotFoundError
from pathlib import Path
from typing import NamedTuple

import pytest
from tests.conftest import REPOSITORY

from flight_core import installation
from flight_core.installation import EXTRAS, TARGETS, missing


def test_a_checkout_names_the_target_of_make() -> None:
    assert missing("jax") == "the Python package jax is not installed: make setup-all"


class Installed(NamedTuple):
    """An installed distribution."""

    origin: str | None

    def read_text(self, name: str) -> str | None:
        """Return the origin."""
        assert name == "direct_url.json"
        return self.origin


@pytest.mark.parametrize(
    "origin, command",
    [  # PEP 610
        ('{"url": "file:///home/user/rise-di", "dir_info": {}}',
        'pip install "rise-di[campaign] @ file:///home/user/rise-di"'),
        ('{"url": "file:///a/rise_di-0.4.0-py3-none-any.whl", "archive_info": {}}',
         'pip install "rise-di[campaign] @ file:///a/rise_di-0.4.0-py3-none-any.whl"'),
        ('{"url": "https://example.org/rise-di.git", "vcs_info": {"vcs": "git", "commit_id": "a"}}',
         'pip install "rise-di[campaign] @ git+https://example.org/rise-di.git"'),
        (None, 'pip install "rise-di[campaign]"'),
    ],
)  # fmt: skip
def test_installed_stack_names_what_it_came_from(
    origin: str | None, command: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """The sentence names the source of the installation, and not a package of an index.

    In an index, a foreign package may have this name.
    """
    monkeypatch.setattr(installation, "CHECKOUT", tmp_path)
    monkeypatch.setattr(installation, "distribution", lambda name: Installed(origin))
    assert missing("jax") == f"the Python package jax is not installed: {command}"


def test_workspace_names_a_checkout(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    def absent(name: str) -> Installed:
        raise PackageNotFoundError(name)

    monkeypatch.setattr(installation, "CHECKOUT", tmp_path)
    monkeypatch.setattr(installation, "distribution", absent)
    assert missing("jax").endswith(': pip install ".[campaign]" in a checkout of the stack')


def test_targets_and_extras_exist() -> None:
    targets = re.findall(r"^([\w -]+):", (REPOSITORY / "Makefile").read_text(), re.MULTILINE)
    assert {target.removeprefix("make ") for target in TARGETS.values()} <= {
        word for line in targets for word in line.split()
    }
    extras = tomllib.loads((REPOSITORY / "pyproject.toml").read_text())["project"][
        "optional-dependencies"
    ]
    assert {*TARGETS} == {*EXTRAS.values()} == extras.keys() - {"all"}
