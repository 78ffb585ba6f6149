# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Provide the fixtures of the tests of guarantees and certificates."""

from collections.abc import Iterator

import pytest

from flight_analysis.linear_loop import guarantee


@pytest.fixture
def coarse() -> Iterator[None]:
    """Prove half of the unstable size, and no disks.

    This is enough for tests of what a guarantee is used for.
    """
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(guarantee, "GAPS", (1.28,))
        patch.setattr(guarantee, "FEWER_BOXES", 2)
        yield
