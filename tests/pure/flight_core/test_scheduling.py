# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test what a node asks of Linux's scheduler.

Each test has a process of its own, because the settings last, and reads /proc.
"""

import os
import platform
import re
import subprocess
import sys
from collections.abc import Sequence

import pytest
from tests.conftest import with_policy

from flight_core.scheduling import SLICE_NS, THREADS, TIMER_SLACK


def output(code: str, within: Sequence[str] = ()) -> str:
    """Return what a Python process prints that is started by the words `within`."""
    return subprocess.run(
        [*within, sys.executable, "-c", code], check=True, capture_output=True, text=True
    ).stdout


@pytest.mark.skipif(not TIMER_SLACK.exists(), reason="no Linux, or no /proc")
def test_timer_slack_of_thread_set_to_minimum() -> None:
    # the default of Linux is 50 us (prctl(2), PR_SET_TIMERSLACK)
    code = (
        "from flight_core.scheduling import *; disable_timer_slack(); "
        "print(TIMER_SLACK.read_text())"
    )
    assert int(output(code)) == 1


def kernel() -> tuple[int, ...]:
    return tuple(map(int, re.findall(r"\d+", platform.release())[:2]))


@pytest.mark.skipif(
    kernel() < (6, 12) or not (THREADS.parent / "sched").exists(),
    reason="needs Linux 6.12, CONFIG_SCHED_DEBUG",
)
@pytest.mark.skipif(
    os.sched_getscheduler(0) != os.SCHED_OTHER, reason="only the default policy has time slices"
)
def test_every_thread_of_node_has_short_time_slices() -> None:
    code = """
import threading, time
from flight_core.scheduling import *
threading.Thread(target=time.sleep, args=(0.1,)).start()
request_short_slices()
print([(one / "sched").read_text() for one in THREADS.iterdir()])
"""
    assert [int(slice_ns) for slice_ns in re.findall(r"se\.slice\s*:\s*(\d+)", output(code))] == [
        SLICE_NS,
        SLICE_NS,
    ]


@pytest.mark.parametrize(
    "policy, priority",
    [(("--fifo", "50"), 48), (("--rr", "50"), 48), (("--fifo", "2"), 1), (("--other", "0"), 0)],
    ids=["FIFO", "round robin", "no lower one", "default policy"],
)
def test_later_threads_inherit_lowered_priority(policy: tuple[str, str], priority: int) -> None:
    code = """
import os, threading
from flight_core.scheduling import lower_real_time_priority
before = os.sched_getscheduler(0)
lower_real_time_priority(2)
assert os.sched_getscheduler(0) == before
thread = threading.Thread(target=lambda: print(os.sched_getparam(0).sched_priority))
thread.start()
thread.join()
"""
    assert int(output(code, with_policy(*policy))) == priority


@pytest.mark.parametrize(
    "policy", [("--fifo", "50"), ("--batch", "0")], ids=["FIFO", "no real-time priority"]
)
def test_command_leaves_real_time_priority(policy: tuple[str, str]) -> None:
    """Every thread gives up the real-time priority, and another policy stays."""
    code = """
import os, threading
from flight_core.scheduling import *
ends = threading.Event()
threading.Thread(target=ends.wait).start()
leave_real_time_priority()
print(*(os.sched_getscheduler(int(one.name)) for one in THREADS.iterdir()))
ends.set()
"""
    left = os.SCHED_OTHER if "--fifo" in policy else os.SCHED_BATCH
    assert output(code, with_policy(*policy)).split() == 2 * [str(left)]


@pytest.mark.skipif(not THREADS.exists(), reason="no Linux, or no /proc")
@pytest.mark.skipif(os.cpu_count() == 1, reason="OpenBLAS has one thread on one processor")
@pytest.mark.parametrize("chosen", [None, "2"])
def test_command_computes_in_one_thread_unless_the_user_chose(
    chosen: str | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    """OpenBLAS starts its threads when NumPy is imported, and SciPy has a copy of its own."""
    monkeypatch.delenv("OPENBLAS_NUM_THREADS", raising=False)
    if chosen is not None:
        monkeypatch.setenv("OPENBLAS_NUM_THREADS", chosen)
    code = """
import os, sys
from flight_cli.cli import main
from flight_core.scheduling import THREADS
sys.argv = ["rise-di", "scenarios"]
try:
    main()
finally:
    assert "numpy" in sys.modules
    print("threads:", len(list(THREADS.iterdir())))
"""
    last = output(code).splitlines()[-1]
    assert (last == "threads: 1") == (chosen is None), last
