# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Lets pytest run the tests of a package, in tests/, from the folder of the package.

`colcon test` starts it there.
"""

from pathlib import Path

import pytest

SOURCES = Path(__file__).resolve().parent
TESTS = SOURCES.parents[1] / "tests"


def files_of(package: str) -> list[Path]:
    """Return the test files of a package: those of tests/*/PACKAGE."""
    return sorted(TESTS.glob(f"*/{package}/**/test_*.py"))


def pytest_configure(config: pytest.Config) -> None:
    """Take the test files of the package in place of its folder."""
    folder = config.invocation_params.dir
    if folder.parent == SOURCES and config.args_source is config.ArgsSource.INVOCATION_DIR:
        config.args = [str(path) for path in files_of(folder.name)]
