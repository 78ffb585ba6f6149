# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Provide fixtures of the fault tests.

One flight is used for all faults, and replaced when a fault has ended it.
"""

import json
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from pathlib import Path

import pytest
from tests.ros.conftest import reserved_domain, settable_clock
from tests.ros.flight_bringup.faults.cases import CASES, IN_SUITE
from tests.ros.flight_bringup.faults.draws import Draw, draw, found
from tests.ros.flight_bringup.faults.flight import Flight, Kind

from flight_analysis.closed_loop.scenario import Scenario
from flight_analysis.closed_loop.scenario_library import find_scenario, save_scenario

Row = dict[str, str | int | float | bool | None]
# of an error in a row: what failed, and the first output of a process that did not answer
LINES = 12


def described(error: BaseException) -> str:
    """Return an error in one line."""
    return f"{type(error).__name__}: {' | '.join(str(error).splitlines()[:LINES])}"


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption(
        "--faults-table",
        type=Path,
        default=None,
        help="append a row for each fault to this file of JSON lines",
    )
    parser.addoption("--faults-seed", type=int, default=1, help="seed of the faults")
    parser.addoption(
        "--faults-scenario", default="osprey_gust", help="scenario of the flight without guidance"
    )
    parser.addoption(
        "--faults-guided", default="osprey_route", help="scenario of the flight with guidance"
    )
    parser.addoption(
        "--faults-random",
        type=int,
        default=0,
        help="how many random faults are injected; seeds count up",
    )
    parser.addoption("--faults-lockstep", type=int, default=0, help="how many of lockstep flights")
    parser.addoption(
        "--faults-times",
        type=int,
        default=1,
        help="how often each fault is injected in a row; seeds count up",
    )


@pytest.fixture(scope="module")
def flight_domain() -> Iterator[int]:
    with reserved_domain() as number:
        yield number


@pytest.fixture(autouse=True)
def domain(flight_domain: int, monkeypatch: pytest.MonkeyPatch) -> int:
    """Return the ROS domain of all fault tests, which share a flight."""
    monkeypatch.setenv("ROS_DOMAIN_ID", str(flight_domain))
    return flight_domain


@pytest.fixture(scope="session")
def seeds(pytestconfig: pytest.Config) -> range:
    """Return a seed for each injection of a fault."""
    first = int(pytestconfig.getoption("--faults-seed", 1))
    return range(first, first + int(pytestconfig.getoption("--faults-times", 1)))


@pytest.fixture(scope="session")
def draws(pytestconfig: pytest.Config) -> list[Draw]:
    """Return earlier failures and random faults, ordered by kind of flight.

    Outside of the campaign there are none.
    """
    first, count = (
        int(pytestconfig.getoption(f"--faults-{name}", 0)) for name in ("seed", "random")
    )
    injections = [*found(), *map(draw, range(first, first + count))] if count else []
    return sorted(injections, key=lambda fault: fault.cases[0].kind.name)


@pytest.fixture(scope="session")
def lockstep_seeds(pytestconfig: pytest.Config) -> range:
    """Return a seed for each lockstep flight with a random fault."""
    first, count = (
        int(pytestconfig.getoption(f"--faults-{name}", 0)) for name in ("seed", "lockstep")
    )
    return range(first, first + count)


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    """Add the cases of the suite.

    benchmarks/faults.py runs all of them, with a table.
    """
    if "case" in metafunc.fixturenames:
        every = metafunc.config.getoption("--faults-table", None) is not None
        suite = [case for case in CASES if every or case.name in IN_SUITE]
        metafunc.parametrize("case", suite, ids=[case.name for case in suite])


CAMPAIGNS = {
    "test_random_faults_detected_contained_and_recovered_from": "--faults-random",
    "test_random_faults_of_lockstep_flights": "--faults-lockstep",
}
"""The tests of benchmarks/random_faults.py, with the options that ask for them."""


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Leave out the random faults unless an option asks for them."""
    alive = [
        item
        for item in items
        if item.name in CAMPAIGNS and not config.getoption(CAMPAIGNS[item.name], 0)
    ]
    config.hook.pytest_deselected(items=alive)
    items[:] = [item for item in items if item not in alive]


@pytest.fixture(scope="session")
def record(pytestconfig: pytest.Config) -> Callable[[Row], None]:
    """Append a row to the table of `--faults-table`."""
    path = pytestconfig.getoption("--faults-table", None)

    def append(row: Row) -> None:
        if path is not None:
            with path.open("a") as stream:
                stream.write(json.dumps(row) + "\n")

    return append


class Flights:
    """The flight under test, of one kind or another. Only one runs at a time."""

    def __init__(self, folder: Path, scenarios: Mapping[Kind, Scenario]) -> None:
        self._folder = folder
        self._scenarios = scenarios
        self._running: dict[Kind, Flight] = {}
        self.all: list[Flight] = []  # including those that have ended

    def steady(self, kind: Kind) -> Flight:
        """Return a flight that is steady and near trim.

        It is the running one, or a new one if a fault has upset it.
        """
        if kind in self._running:
            with suppress(AssertionError):
                self._running[kind].until_steady(20.0)
                assert self._running[kind].is_near_trim()
                return self._running[kind]
        flight = self._start(kind)
        try:
            flight.until_steady()
            with suppress(AssertionError):  # on a busy host it is never at rest
                flight.until(flight.is_at_rest, 15.0, "u at rest")
        except AssertionError:
            self.close()
            raise
        return flight

    def _start(self, kind: Kind) -> Flight:
        self.close()
        folder = self._folder / f"flight{len(self.all) + 1}"
        folder.mkdir()
        flight = self._running[kind] = Flight(
            folder,
            self._scenarios[kind].path,
            kind,
            settable_clock(folder) if kind is Kind.OWN_CLOCK else None,
        )
        self.all.append(flight)
        return flight

    def close(self) -> None:
        """End the running flight."""
        for kind in list(self._running):
            self._running.pop(kind).close()


@pytest.fixture(scope="module")
def flights(
    tmp_path_factory: pytest.TempPathFactory, pytestconfig: pytest.Config
) -> Iterator[Flights]:
    plain = find_scenario(str(pytestconfig.getoption("--faults-scenario", "osprey_gust")))
    guided = find_scenario(str(pytestconfig.getoption("--faults-guided", "osprey_route")))
    bridged = find_scenario("osprey_observer")
    # a proposal a second, from 3 s on
    learning = find_scenario("osprey_learn").vary(
        controller={"learn": {"updates": [3.0], "check": 1.0, "latency": 1.0}}
    )
    learning = save_scenario(learning, tmp_path_factory.mktemp("learning") / "learn.yaml")
    scenarios = {
        Kind.PLAIN: plain,
        Kind.OWN_CLOCK: plain,
        Kind.GUIDED: guided,
        Kind.BRIDGED: bridged,
        Kind.LEARNING: learning,
    }
    flights_of_suite = Flights(tmp_path_factory.mktemp("faults"), scenarios)
    yield flights_of_suite
    flights_of_suite.close()
