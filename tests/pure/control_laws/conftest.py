# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Install the law of the example for the tests of this folder."""

from collections.abc import Iterator

import pytest
from tests.other_laws import example_installed


@pytest.fixture(scope="module")
def example_law(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    with example_installed(tmp_path_factory.mktemp("installed")):
        yield
