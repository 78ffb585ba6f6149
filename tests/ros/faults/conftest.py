# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Fixtures of the fault tests: one flight for all faults, replaced when a fault ended it."""

import json
import shutil
import subprocess
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path

import pytest
from tests.ros.conftest import reserved_domain
from tests.ros.faults.flight import Flight

from flight_analysis.closed_loop.scenario import Scenario
from flight_bringup.scenarios import find_scenario

Row = dict[str, str | int | float | bool | None]


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--faults-table", type=Path, default=None, help="append a row for each fault to this file of JSON lines")
    parser.addoption("--faults-seed", type=int, default=1, help="seed of the faults")
    parser.addoption("--faults-scenario", default="osprey_gust", help="scenario of the flight")
    parser.addoption("--faults-times", type=int, default=1, help="how often each fault is injected in a row; seeds count up")


@pytest.fixture(scope="module")
def flight_domain() -> Iterator[int]:
    with reserved_domain() as number:
        yield number


@pytest.fixture(autouse=True)
def domain(flight_domain: int, monkeypatch: pytest.MonkeyPatch) -> int:
    """One ROS domain for all fault tests: they share a flight."""
    monkeypatch.setenv("ROS_DOMAIN_ID", str(flight_domain))
    return flight_domain


@pytest.fixture(scope="session")
def seeds(pytestconfig: pytest.Config) -> range:
    """One for each injection of a fault."""
    first = int(pytestconfig.getoption("--faults-seed", 1))
    return range(first, first + int(pytestconfig.getoption("--faults-times", 1)))


@pytest.fixture(scope="session")
def record(pytestconfig: pytest.Config) -> Callable[[Row], None]:
    """Append a row to the table of `--faults-table`."""
    path = pytestconfig.getoption("--faults-table", None)

    def append(row: Row) -> None:
        if path is not None:
            with path.open("a", encoding="utf-8") as stream:
                stream.write(json.dumps(row) + "\n")

    return append


class Flights:
    """The flight under test, on the clock of the system or on one that can be set. One runs at a time."""

    def __init__(self, folder: Path, scenario: Scenario) -> None:
        self._folder, self._scenario = folder, scenario
        self._running: dict[bool, Flight] = {}
        self.all: list[Flight] = []  # including those that have ended

    def steady(self, *, own_clock: bool) -> Flight:
        """A flight that is steady and near trim: the running one, or a new one where a fault has upset that."""
        if own_clock in self._running:
            with suppress(AssertionError):
                self._running[own_clock].until_steady(20.0)
                assert self._running[own_clock].is_near_trim()
                return self._running[own_clock]
        flight = self._start(own_clock)
        try:
            flight.until_steady()
            with suppress(AssertionError):  # on a busy host it is never at rest
                flight.until(flight.is_at_rest, 15.0, "u at rest")
        except AssertionError:
            self.close()
            raise
        return flight

    def _start(self, own_clock: bool) -> Flight:
        self.close()
        folder = self._folder / f"flight{len(self.all) + 1}"
        folder.mkdir()
        flight = self._running[own_clock] = Flight(folder, self._scenario.path, _clock(folder) if own_clock else None)
        self.all.append(flight)
        return flight

    def close(self) -> None:
        """End the running flight."""
        for own_clock in list(self._running):
            self._running.pop(own_clock).close()


def _clock(folder: Path) -> Path:
    compiler = shutil.which("cc")
    if compiler is None:
        pytest.skip("no C compiler for a clock that can be set")
    library = folder / "clock.so"
    source = Path(__file__).with_name("clock.c")
    subprocess.run([compiler, "-shared", "-fPIC", "-O2", "-o", library, source, "-ldl", "-lpthread"], check=True)
    return library


@pytest.fixture(scope="module")
def flights(tmp_path_factory: pytest.TempPathFactory, pytestconfig: pytest.Config) -> Iterator[Flights]:
    scenario = find_scenario(str(pytestconfig.getoption("--faults-scenario", "osprey_gust")))
    made = Flights(tmp_path_factory.mktemp("faults"), scenario)
    yield made
    made.close()
