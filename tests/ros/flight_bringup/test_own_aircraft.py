# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test that the shells of docs/ros.md that start single nodes run as they stand.

Each is a separate shell, and runs to its last command.
"""

import re
import signal
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest
from tests.conftest import REPOSITORY
from tests.ros.waiting import until

from flight_bringup.processes import end_with_parent
from flight_core.outcome import STATUS_ENDED_EARLY, STATUS_SHORTFALL
from flight_log.tape_reader import read_run

pytestmark = pytest.mark.timeout(240)

PAGE = (REPOSITORY / "docs" / "ros.md").read_text()
SAMPLES = 400  # of y: 4 s at 100 Hz
COMMAND = 0.1  # rad/s, abs of each pulse of q in osprey_servo
FIRST_CHUNKS = 100_000  # bytes of a log; the readers need a whole chunk


def shells(section: str) -> tuple[list[str], list[str]]:
    """Return the lines with which each shell of a section begins, and the commands.

    Each command has its own shell.
    """
    text = PAGE.partition(f"\n## {section}\n")[2].partition("\n## ")[0]
    text = re.sub(r"^```python\n.*?^```$", "", text, flags=re.MULTILINE | re.DOTALL)
    lines = re.findall(r"^    (\S.*)$", text, re.MULTILINE)
    common = [line for line in lines if re.match(r"export |\w+=", line)]
    return common, [line for line in lines if line not in common]


@pytest.fixture
def checkout(tmp_path: Path) -> Path:
    """Return a folder with what the commands of a page need from a checkout.

    It also has the programs of the page.
    """
    for name in (".venv", "ros_ws"):
        (tmp_path / name).symlink_to(REPOSITORY / name)
    programs = re.findall(r"^```python\n(.*?)^```$", PAGE, re.MULTILINE | re.DOTALL)
    for name, program in zip(("my_aircraft.py", "my_reference.py"), programs, strict=False):
        (tmp_path / name).write_text(program)
    return tmp_path


@pytest.fixture
def shell(checkout: Path) -> Iterator[list[subprocess.Popen[bytes]]]:
    """Yield the processes of a page. Those that still run at the end of the test are killed."""
    processes: list[subprocess.Popen[bytes]] = []
    yield processes
    for process in processes:
        process.kill()
        process.wait()


@pytest.mark.parametrize(
    "section, replaced",
    [
        ("Nodes one by one", ""),
        ("Your own aircraft", ""),
        ("Your own aircraft", "reference_model.main"),
    ],
)
def test_shells_of_page_run_to_the_last_command(
    section: str, replaced: str, checkout: Path, shell: list[subprocess.Popen[bytes]]
) -> None:
    """The section's command for a reference model replaces the command `replaced`."""
    common, commands = shells(section)
    if replaced:
        _, (own,) = shells("Your own reference model")
        commands = [own if replaced in command else command for command in commands]
        assert own in commands
    nodes = [command for command in commands if "rise-di " not in command]
    after = [command for command in commands if command not in nodes]
    assert "recorder" in nodes[-1]
    assert after
    for number, command in enumerate(nodes):
        with (checkout / f"{number}.txt").open("wb") as output:
            script = "\n".join([*common, f"exec {command}"])
            shell.append(
                subprocess.Popen(
                    [*end_with_parent(), "bash", "-c", script],
                    cwd=checkout,
                    stdout=output,
                    stderr=subprocess.STDOUT,
                )
            )
    recorder = shell[-1]

    def texts() -> str:
        return "\n".join(path.read_text() for path in sorted(checkout.glob("*.txt")))

    def flies() -> bool:
        assert [process.poll() for process in shell] == [None] * len(shell), texts()
        return "WAITING -> ENGAGED" in texts() and "[recorder]: ready" in texts()

    until(flies, "a controller that tracks, and a log")
    log = checkout / "runs" / "latest"

    def largest() -> tuple[int, float, float]:
        """Return the number of samples of y, and the largest abs(q) of y and of y_m."""
        tape = read_run(log).tape
        q, reference = (abs(tape[topic]["q"]) for topic in ("y", "y_m"))
        return len(q), max(q), max(reference)

    looked = 0

    def follows() -> bool:
        # y_m rises for a second. In a log that ends on the rise y is still behind, and in one that
        # ends before it the noise of q is all there is: so y_m has to have reached its command
        nonlocal looked
        size = sum(file.stat().st_size for file in log.glob("*.mcap"))
        # each look reads the whole log
        if size < looked + FIRST_CHUNKS:
            return False
        looked = size
        samples, q, reference = largest()
        return samples > SAMPLES and reference > 0.9 * COMMAND and q > 0.7 * reference

    until(follows, "a log with a command that y follows")
    recorder.send_signal(signal.SIGINT)
    assert recorder.wait(timeout=60) == 0
    assert "incompatible QoS" not in texts()  # of the first subscription of the recorder
    # of the recorder
    assert "[ERROR]" not in (checkout / f"{len(nodes) - 1}.txt").read_text(encoding="utf-8")
    for command in after:
        command_process = subprocess.run(
            ["/bin/bash", "-c", "\n".join([*common, command])],
            cwd=checkout,
            capture_output=True,
            text=True,
            timeout=120,
            check=False,
        )
        # this test ends the flight early; the recorder began after the controller
        statuses = {0, STATUS_ENDED_EARLY, STATUS_SHORTFALL}
        assert command_process.returncode in statuses, (
            command_process.stdout + command_process.stderr
        )
    samples, q, reference = largest()
    assert samples > SAMPLES
    assert reference > 0.9 * COMMAND
    assert q > 0.5 * reference  # without control q of the page's aircraft would stay 0
