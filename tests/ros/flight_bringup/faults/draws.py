# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Draw random faults: any case at any instant, repeatable by a seed.

A tenth of them come in pairs.
"""

import threading
from copy import copy
from typing import NamedTuple
from zlib import crc32

import numpy as np
from tests.ros.flight_bringup.faults.cases import CASES, Case, pause
from tests.ros.flight_bringup.faults.flight import Flight, Kind

TWO = 0.1  # fraction of draws with two faults
LATER = 1.0  # s, the most between the beginnings of two faults


class Draw(NamedTuple):
    """One fault, or two at a time in one flight."""

    seed: int
    cases: tuple[Case, ...]

    @property
    def name(self) -> str:
        """Return the names of its cases."""
        return ", ".join(case.name for case in self.cases)


FOUND: tuple[tuple[int, tuple[str, ...]], ...] = (
    (2, ("guidance stopped",)),
    (7, ("pose stale",)),
    (10, ("storm on the live page",)),
    (11, ("controller stopped",)),
    (35, ("reference model stopped",)),
    (106, ("future stamps on u", "recorder killed under a live page")),
    (141, ("wrong length on y_m",)),
    (152, ("disk full",)),
    (651, ("storm on target",)),
)
"""Seeds and cases of failures that were mended. The campaign replays them too."""


def together(one: Case, other: Case) -> bool:
    """Return whether two faults leave a processor, and the nodes that the other one needs."""
    apart = all(
        a.victim not in (b.victim, *b.needs) for a, b in ((one, other), (other, one)) if a.victim
    )
    storms = one.name.startswith("storm") and other.name.startswith("storm")
    same = one.kind is other.kind and one.kind in {Kind.PLAIN, Kind.GUIDED} and one is not other
    return same and apart and not (one.alone or other.alone or storms)


def draw(seed: int) -> Draw:
    """Return the faults of a seed."""
    random = np.random.default_rng(seed)
    first = CASES[random.integers(len(CASES))]
    others = [case for case in CASES if together(first, case)]
    if random.random() >= TWO or not others:
        return Draw(seed, (first,))
    return Draw(seed, (first, others[random.integers(len(others))]))


def found() -> list[Draw]:
    """Return the draws of FOUND."""
    by_name = {case.name: case for case in CASES}
    return [Draw(seed, tuple(by_name[name] for name in names)) for seed, names in FOUND]


def inject(flight: Flight, draw: Draw) -> list[Flight]:
    """Inject the faults of a draw.

    Each fault has its own view of the flight, with its beginning, end and figures.
    """
    views = [copy(flight) for _ in draw.cases]
    errors: list[BaseException] = []

    def run(view: Flight, case: Case, later: float) -> None:
        random = np.random.default_rng((draw.seed, crc32(case.name.encode())))
        view.measured = {}
        try:
            pause(view, later)
            case.inject(view, random)
        except BaseException as error:
            errors.append(error)

    begins = (0.0, float(np.random.default_rng(draw.seed).uniform(0.0, LATER)))
    threads = [
        threading.Thread(target=run, args=(view, case, later))
        for view, case, later in zip(views, draw.cases, begins, strict=False)
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    if errors:
        raise errors[0]
    return views
