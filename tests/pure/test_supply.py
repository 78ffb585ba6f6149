# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""What the project takes from others: locked packages without an unexplained advisory, actions of a fixed commit."""

import re
from pathlib import Path
from typing import Any

import pytest
import yaml
from packaging.specifiers import SpecifierSet
from packaging.version import Version

ROOT = Path(__file__).parents[2]
ADVISORIES: list[dict[str, str]] = yaml.safe_load((ROOT / ".ci/advisories.yaml").read_text(encoding="utf-8"))
WORKFLOWS = sorted((ROOT / ".github/workflows").glob("*.yml"))
LOCKED = re.findall(r"^([a-z0-9][a-z0-9._-]*)==(\S+)", (ROOT / "requirements.lock").read_text(encoding="utf-8"), re.MULTILINE)


def affected(row: dict[str, str]) -> bool:
    """Whether a locked version is in one of the ranges, which "|" separates."""
    ranges = [SpecifierSet(text) for text in row["affected"].split("|")]
    return any(Version(version) in versions for name, version in LOCKED if name == row["package"] for versions in ranges)


@pytest.mark.parametrize("row", ADVISORIES, ids=[row["name"] for row in ADVISORIES])
def test_locked_package_has_no_advisory_without_reason(row: dict[str, str]) -> None:
    assert row["package"] in dict(LOCKED), "the package is not locked: remove the row"
    # a reason that outlives its advisory hides the next one
    assert affected(row) == ("accepted" in row)


@pytest.mark.parametrize("path", WORKFLOWS, ids=[path.stem for path in WORKFLOWS])
def test_workflow_is_of_fixed_commits_and_least_permissions(path: Path) -> None:
    text = path.read_text(encoding="utf-8")
    workflow: dict[str, Any] = yaml.safe_load(text)
    assert workflow["permissions"] == {"contents": "read"}
    for action in re.findall(r"uses: (?!\./)(.*)", text):
        # a tag can be moved to other code; the version beside the commit is for the reader and for updates
        assert re.fullmatch(r"[\w./-]+@[0-9a-f]{40} # v\d+\.\d+\.\d+", action), action
