# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test what the project takes from others.

Locked packages must have no advisory, and no package may change a release.
"""

import re
from pathlib import Path
from typing import Any

import pytest
import yaml
from packaging.specifiers import SpecifierSet
from packaging.version import Version
from tests.conftest import REPOSITORY

ADVISORIES: list[dict[str, str]] = yaml.safe_load((REPOSITORY / ".ci/advisories.yaml").read_text())
WORKFLOWS = sorted((REPOSITORY / ".github/workflows").glob("*.yml"))
LOCKED = re.findall(
    r"^([a-z0-9][a-z0-9._-]*)==(\S+)", (REPOSITORY / "requirements.lock").read_text(), re.MULTILINE
)


def affected(row: dict[str, str]) -> bool:
    """Return whether a locked version is in one of the ranges, which "|" separates."""
    ranges = [SpecifierSet(text) for text in row["affected"].split("|")]
    return any(
        Version(version) in versions
        for name, version in LOCKED
        if name == row["package"]
        for versions in ranges
    )


@pytest.mark.parametrize("row", ADVISORIES, ids=[row["name"] for row in ADVISORIES])
def test_locked_package_has_no_advisory_without_reason(row: dict[str, str]) -> None:
    assert row["package"] in dict(LOCKED), "the package is not locked: remove the row"
    # a reason that outlives its advisory hides the next one
    assert affected(row) == ("accepted" in row)


@pytest.mark.parametrize("path", WORKFLOWS, ids=[path.stem for path in WORKFLOWS])
def test_workflow_is_of_fixed_commits_and_least_permissions(path: Path) -> None:
    text = path.read_text()
    workflow: dict[str, Any] = yaml.safe_load(text)
    assert workflow["permissions"] == {"contents": "read"}
    for action in re.findall(r"uses: (?!\./)(.*)", text):
        # a tag can be moved to other code; the version beside the commit is for the reader and for
        # updates
        assert re.fullmatch(r"[\w./-]+@[0-9a-f]{40} # v\d+\.\d+\.\d+", action), action


JOBS = [
    (
        f"{path.stem}.{name}",
        job,
        job.get("permissions", yaml.safe_load(path.read_text())["permissions"]),
    )
    for path in WORKFLOWS
    for name, job in yaml.safe_load(path.read_text())["jobs"].items()
]
WITH_RIGHTS = [(name, job) for name, job, rights in JOBS if "write" in rights.values()]
RELEASE: dict[str, Any] = yaml.safe_load(
    (REPOSITORY / ".github/workflows/release.yml").read_text()
)["jobs"]
PROGRAM = re.compile(
    r"\.ci/|\b(pip|pipx|uv|uvx|npm|npx|yarn|conda|apt|apt-get|curl|wget|make|python[\d.]*|node|docker|git)\b"
)
INSTALL = re.compile(r"pip\S* install\b[^\n]*(?:\\\n[^\n]*)*")
UNLOCKED = {".ci/wheel": 2}
"""Installations of what PyPI has today, as a user gets it, by script."""


def test_one_job_has_rights() -> None:
    assert [name for name, _ in WITH_RIGHTS] == ["release.publish"]


@pytest.mark.parametrize("name, job", WITH_RIGHTS)
def test_job_with_rights_runs_no_program_of_others(name: str, job: dict[str, Any]) -> None:
    """A package that runs there could change what is published.

    It could also publish in the name of the project.
    """
    steps = job["steps"]
    actions = {step["uses"].partition("@")[0] for step in steps if "uses" in step}
    assert actions == {"actions/download-artifact", "pypa/gh-action-pypi-publish"}
    assert not [found[0] for step in steps if (found := PROGRAM.search(step.get("run", "")))]


def test_what_is_published_has_the_checksums_of_the_build() -> None:
    steps = RELEASE["publish"]["steps"]
    check = next(k for k, step in enumerate(steps) if "sha256sum --check" in step.get("run", ""))
    publishing = [
        k
        for k, step in enumerate(steps)
        if "gh release" in step.get("run", "") or "publish" in step.get("uses", "")
    ]
    assert check < min(publishing)
    assert steps[check]["env"] == {"SUMS": "${{ needs.build.outputs.sums }}"}
    assert set(RELEASE["publish"]["needs"]) == RELEASE.keys() - {"publish"}


def test_build_of_a_release_runs_one_script() -> None:
    """The next test checks what this script installs."""
    assert (
        next(step["run"] for step in RELEASE["build"]["steps"] if "run" in step)
        == '.ci/release "$GITHUB_REF_NAME"'
    )
    uploads = [
        k
        for k, step in enumerate(RELEASE["build"]["steps"])
        if "upload-artifact" in step.get("uses", "")
    ]
    assert uploads == [len(RELEASE["build"]["steps"]) - 1]
    assert ".ci/wheel" not in re.sub(r"#.*", "", (REPOSITORY / ".ci/release").read_text())


@pytest.mark.parametrize(
    "path",
    [
        "Makefile",
        *(f".ci/{p.name}" for p in sorted((REPOSITORY / ".ci").iterdir()) if not p.suffix),
    ],
)
def test_installation_is_of_locked_hashes(path: str) -> None:
    text = (REPOSITORY / path).read_text()
    unlocked = [
        line
        for line in INSTALL.findall(re.sub(r"^\s*#.*", "", text, flags=re.MULTILINE))
        if "--require-hashes" not in line and "--constraint requirements.lock" not in line
    ]
    assert len(unlocked) == UNLOCKED.get(path, 0), unlocked


@pytest.mark.parametrize(
    "path", sorted((REPOSITORY / ".ci").glob("*.txt")), ids=lambda path: path.stem
)
def test_list_of_a_script_has_a_hash_for_each_version(path: Path) -> None:
    text = path.read_text()
    rows = re.findall(
        r"^[\w.-]+==\S+(?: ;[^\n\\]*)?(?: \\\n    --hash=sha256:[0-9a-f]{64})+", text, re.MULTILINE
    )
    assert len(rows) == len(re.findall(r"^\w", text, re.MULTILINE)) > 0


def test_uv_is_that_of_the_makefile() -> None:
    version = re.search(
        r"^UV_VERSION := (\S+)", (REPOSITORY / "Makefile").read_text(), re.MULTILINE
    )
    assert version is not None
    assert f"uv=={version[1]} " in (REPOSITORY / ".ci/uv.txt").read_text()
