# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test that a test in real time is run again if it fails during a pause of the host.

A test that fails without a pause fails.
"""

import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import psutil
import pytest
from tests.conftest import REPOSITORY
from tests.ros import waiting
from tests.ros.waiting import until

PLUGIN = """
import sys
from pathlib import Path
import pytest
from tests.ros import conftest

class Host:
    def is_alive(self): return True
    def longest(self, t): return {pause}

conftest.HOST, conftest.IN_REAL_TIME = Host(), Path({folder!r})
sys.exit(pytest.main(["-q", "-rs", "-c", "pytest.ini", {folder!r}], plugins=[conftest]))
"""
TESTS = """
import pytest
attempts = dict.fromkeys((1, 2, 3, 4), 0)
@pytest.mark.parametrize("attempt", attempts)
def test_passes_at(attempt):
    attempts[attempt] += 1
    assert attempts[attempt] == attempt, "abc"[attempts[attempt] - 1]
def test_fails_alike(): assert False
@pytest.mark.longest_pause(5.0)
def test_bears_more(): assert False
"""


def printed(folder: Path, pause: float) -> str:
    """Return what pytest prints for tests that pass at a later attempt.

    One of them tolerates a longer pause and fails.
    """
    (folder / "test_it.py").write_text(TESTS)
    (folder / "pytest.ini").write_text("[pytest]\nmarkers =\n  longest_pause(s): a test\n")
    program = PLUGIN.format(pause=pause, folder=str(folder))
    options = {"cwd": folder, "env": {"PYTHONPATH": str(REPOSITORY)}}
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=False, **options
    )  # type: ignore[call-overload]
    return str(done.stdout) + str(done.stderr)


def test_failure_beside_a_pause_is_run_again_at_most_twice(tmp_path: Path) -> None:
    shown = printed(tmp_path, pause=0.3)
    # the one that bears more, and the one that fails alike three times
    assert "2 failed, 3 passed, 1 skipped" in shown
    sentence = (
        "test_it.py::test_passes_at[{}]: the host paused for 0.30 s, the test bears 0.1 "
        "s, in attempt"
    )
    assert [shown.count(sentence.format(attempt)) for attempt in (1, 2, 3, 4)] == [0, 1, 2, 3]
    assert shown.count("inconclusive: the host paused for 0.30 s") == 1


def test_failure_without_a_pause_is_a_failure(tmp_path: Path) -> None:
    shown = printed(tmp_path, pause=0.05)
    assert "5 failed, 1 passed" in shown
    assert "inconclusive" not in shown


def test_until_returns_what_it_waited_for() -> None:
    looks: list[int] = []
    assert until(lambda: looks[2:], "three looks", lambda: looks.append(len(looks))) == [2]


def test_wait_without_its_condition_fails_with_output_of_processes(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    node = SimpleNamespace(arguments=("a.main",), output="waiting for /u")
    monkeypatch.setattr(waiting, "running", [node])
    with pytest.raises(AssertionError, match=r"not within 0 s: a u\na.main:\nwaiting for /u"):
        until(lambda: False, "a u", timeout=0.0)


def test_wait_is_longer_by_the_delays_of_the_host(monkeypatch: pytest.MonkeyPatch) -> None:
    looks: list[int] = []
    monkeypatch.setattr(
        waiting, "HOST", SimpleNamespace(since=lambda t: 1000.0 if len(looks) < 3 else 0.0)
    )
    with pytest.raises(AssertionError):
        until(lambda: False, "nothing", lambda: looks.append(1), timeout=0.0)
    assert len(looks) == 3


def test_process_under_test_ends_with_process_that_runs_tests() -> None:
    long = "Process('timeit', '-n', '1', 'import time; time.sleep(600)', cwd=Path())"
    program = (
        "from pathlib import Path; from tests.ros.conftest import Process; "
        f"print({long}.popen.pid, flush=True)"
    )
    with subprocess.Popen(
        [sys.executable, "-c", program], stdout=subprocess.PIPE, cwd=REPOSITORY, text=True
    ) as tests:
        assert tests.stdout is not None
        process = psutil.Process(int(tests.stdout.readline()))
        until(lambda: "timeit" in process.cmdline()[:3], "the program: until then it is setpriv")
        tests.kill()
        process.wait(10.0)
