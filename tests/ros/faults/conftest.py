# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""One flight for all faults, as long as it survives them."""

import json
import os
import shutil
import subprocess
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path

import pytest
from tests.ros.faults.flight import Flight

from flight_analysis.closed_loop.scenario import Scenario

Row = dict[str, str | int | float | bool | None]


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--faults-table", type=Path, default=None, help="append a row a case to this file of JSON lines")
    parser.addoption("--faults-seed", type=int, default=1, help="seed of the faults")
    parser.addoption("--faults-times", type=int, default=1, help="how often each fault is done in a row; seeds count up")


@pytest.fixture(autouse=True)
def domain(monkeypatch: pytest.MonkeyPatch) -> int:
    """One ROS domain for all of them, in place of one for each test: they share a flight."""
    number = 1 + os.getpid() % 100
    monkeypatch.setenv("ROS_DOMAIN_ID", str(number))
    return number


@pytest.fixture(scope="session")
def seeds(pytestconfig: pytest.Config) -> range:
    """One for each time that a fault is done."""
    first = int(pytestconfig.getoption("--faults-seed", 1))
    return range(first, first + int(pytestconfig.getoption("--faults-times", 1)))


@pytest.fixture(scope="session")
def record(pytestconfig: pytest.Config) -> Callable[[Row], None]:
    """Append a row to the table, where there is one."""
    path = pytestconfig.getoption("--faults-table", None)

    def append(row: Row) -> None:
        if path is not None:
            with path.open("a", encoding="utf-8") as stream:
                stream.write(json.dumps(row) + "\n")

    return append


class Hangar:
    """Keeps the flights: one on the system's clock, one on a clock that can be set. A flight that a fault ended is replaced."""

    def __init__(self, folder: Path, scenario: Scenario) -> None:
        self._folder, self._scenario, self._count = folder, scenario, 0
        self._flights: dict[bool, Flight] = {}
        self.flown: list[Flight] = []  # all that there were

    def flight(self, *, own_clock: bool) -> Flight:
        """A flight that is steady, and near its trim: one that a fault has thrown off, and that tracks again, shows less."""
        if own_clock in self._flights:
            with suppress(AssertionError):
                self._flights[own_clock].until_steady(20.0)
                assert self._flights[own_clock].is_near_trim()
                return self._flights[own_clock]
        self._flights[own_clock] = flight = self._fly(own_clock)
        try:
            flight.until_steady()
            with suppress(AssertionError):  # on a busy machine it never rests
                flight.until(flight.is_at_rest, 15.0, "u at rest")
        except AssertionError:
            self.scrap()
            raise
        return flight

    def _fly(self, own_clock: bool) -> Flight:
        for other in list(self._flights):  # one at a time
            self._flights.pop(other).close()
        self._count += 1
        folder = self._folder / f"flight{self._count}"
        folder.mkdir()
        self.flown.append(Flight(folder, self._scenario.path, _clock(folder) if own_clock else None))
        return self.flown[-1]

    def scrap(self) -> None:
        """End all flights."""
        for own_clock in list(self._flights):
            self._flights.pop(own_clock).close()


def _clock(folder: Path) -> Path:
    compiler = shutil.which("cc")
    if compiler is None:
        pytest.skip("no C compiler here for a clock that can be set")
    library = folder / "clock.so"
    source = Path(__file__).with_name("clock.c")
    subprocess.run([compiler, "-shared", "-fPIC", "-O2", "-o", library, source, "-ldl", "-lpthread"], check=True)
    return library


@pytest.fixture(scope="module")
def hangar(tmp_path_factory: pytest.TempPathFactory, osprey_gust: Scenario) -> Iterator[Hangar]:
    made = Hangar(tmp_path_factory.mktemp("faults"), osprey_gust)
    yield made
    made.scrap()
