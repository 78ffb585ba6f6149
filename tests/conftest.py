# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Provide the fixtures of all tests: the default scenario and the log of a flight."""

import asyncio
import gc
import os
import shutil
import subprocess
import tempfile
from collections.abc import Generator, Iterator
from contextlib import AbstractContextManager
from inspect import iscoroutinefunction, signature
from itertools import count
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, Phase, settings
from typer.testing import CliRunner, Result

from flight_analysis.closed_loop.scenario import Scenario
from flight_analysis.closed_loop.scenario_library import find_scenario
from flight_analysis.closed_loop.simulate import simulate
from flight_analysis.report.run_folder import attachments_for
from flight_analysis.report.summary import RecordedFlight, summarise
from flight_core.parameters import ParameterError
from flight_core.tape import Tape
from flight_log.tape_writer import write_run

# The time of an example depends on the host, not on the code under test.
settings.register_profile("flight", deadline=None)
settings.load_profile("flight")

few = settings(
    max_examples=30,
    derandomize=True,
    database=None,
    phases=(Phase.generate,),
    suppress_health_check=list(HealthCheck),
)
"""Deterministic examples of fuzzing. benchmarks/fuzz.py does long searches."""

_NUMBERS = count()
"""Of the tests that this process has run."""

REPOSITORY = Path(__file__).resolve().parents[1]


@pytest.fixture(scope="session", autouse=True)
def _empty_cache(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Use an empty cache.

    Reports, exports and campaigns show the guarantees that a user has computed, and here there are
    none.
    """
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.mktemp("cache")))
        yield


@pytest.fixture(autouse=True)
def _own_cache(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Give each test a cache folder of its own. It is not created until a test needs it."""
    before = os.environ["XDG_CACHE_HOME"]
    folder = tmp_path_factory.getbasetemp() / f"caches-{next(_NUMBERS)}"
    os.environ["XDG_CACHE_HOME"] = str(folder)
    yield
    os.environ["XDG_CACHE_HOME"] = before


def refusing(sentence: str) -> AbstractContextManager[pytest.ExceptionInfo[ParameterError]]:
    """Expect a ParameterError whose sentence matches the pattern."""
    return pytest.raises(ParameterError, match=sentence)


def invoke(*words: object, **options: Any) -> Result:
    """Run a command of rise-di in this process."""
    from flight_cli.cli import application  # noqa: PLC0415 - the tests of nodes need no command

    texts = [str(word) for word in words]
    return CliRunner().invoke(application(texts[:1]), texts, **options)


def pytest_configure(config: pytest.Config) -> None:
    """Let all processes of a session share the programs that JAX has compiled.

    Workers inherit the environment.
    """
    if not hasattr(config, "workerinput"):
        folder = tempfile.TemporaryDirectory(prefix="jax", ignore_cleanup_errors=True)
        os.environ["JAX_COMPILATION_CACHE_DIR"] = folder.name
        os.environ["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"] = "0.1"
        config.add_cleanup(folder.cleanup)


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Generator[None, object, object]:
    """Keep imported and collected objects out of the collection of garbage.

    There are half a million of them, and they stay until the end. Visiting them took a quarter of
    the processor time of the tests.
    """
    gc.disable()
    try:
        return (yield)
    finally:
        gc.freeze()
        gc.enable()


@pytest.hookimpl(tryfirst=True)
def pytest_pyfunc_call(pyfuncitem: pytest.Function) -> bool | None:
    """Run a coroutine, for at most a minute."""
    if not iscoroutinefunction(pyfuncitem.obj):
        return None
    names = signature(pyfuncitem.obj).parameters
    test = pyfuncitem.obj(**{name: pyfuncitem.funcargs[name] for name in names})
    asyncio.run(asyncio.wait_for(test, 60.0))
    return True


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Sort the quick tests to the end.

    So no worker computes long after the others have ended.
    """
    items.sort(
        key=lambda item: "pure" in item.path.parts and item.get_closest_marker("slow") is None
    )


@pytest.fixture(scope="session")
def osprey_gust() -> Scenario:
    """Return the default scenario."""
    return find_scenario("osprey_gust")


@pytest.fixture(scope="session")
def tape(osprey_gust: Scenario) -> Tape:
    """Return two seconds of the default scenario in one process."""
    return simulate(osprey_gust.vary(flight={"duration": 2.0}))


@pytest.fixture(scope="session")
def flight(osprey_gust: Scenario) -> RecordedFlight:
    """Return three seconds of the default scenario, as a report reads them."""
    scenario = osprey_gust.vary(flight={"duration": 3.0})
    tape = simulate(scenario)
    return RecordedFlight("run", scenario, tape, summarise(tape, scenario))


@pytest.fixture(scope="session")
def recorded(tape: Tape, osprey_gust: Scenario, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the log of `tape` with the attachments of a flight."""
    folder = tmp_path_factory.mktemp("recorded") / "run"
    folder.mkdir()
    write_run(tape, folder, attachments_for(osprey_gust.vary(flight={"duration": 2.0}), folder))
    return folder


@pytest.fixture
def run(recorded: Path, tmp_path: Path) -> Path:
    """Return a copy of `recorded` that may be damaged."""
    return Path(shutil.copytree(recorded, tmp_path / "run"))


def with_policy(*policy: str) -> list[str]:
    """Return a function that runs a command with a scheduling policy, given as options of chrt.

    The test is skipped if this is not permitted.
    """
    command = [shutil.which("chrt") or "", *policy]
    if (
        not command[0]
        or subprocess.run([*command, "true"], check=False, capture_output=True).returncode
    ):
        pytest.skip("needs chrt, and the right to a real-time priority")
    return command
