# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Lets pytest in the folder of a package, as `colcon test` starts it, run the files of tests/ that the package's mark names."""

from pathlib import Path

import pytest

SOURCES = Path(__file__).resolve().parent
TESTS = SOURCES.parents[1] / "tests"


def files_of(package: str) -> list[Path]:
    """The test files that are marked `pytest.mark.package("PACKAGE")`."""
    mark = f'pytest.mark.package("{package}")'
    return sorted(path for path in TESTS.rglob("test_*.py") if mark in path.read_text(encoding="utf-8"))


def pytest_configure(config: pytest.Config) -> None:
    """Take the test files of the package in place of its folder."""
    folder = config.invocation_params.dir
    if folder.parent == SOURCES and config.args_source is config.ArgsSource.INVOCATION_DIR:
        config.args = [str(path) for path in files_of(folder.name)]
