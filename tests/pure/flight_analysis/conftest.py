# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Fixtures of the tests of guarantees and certificates."""

from collections.abc import Iterator

import pytest

from flight_analysis.linear_loop import guarantee


@pytest.fixture
def coarse() -> Iterator[None]:
    """Prove half of what is unstable, and no disks: for tests of what is done with a guarantee."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(guarantee, "GAPS", (1.28,))
        patch.setattr(guarantee, "FEWER_BOXES", 2)
        yield
