# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""The kit of autopilots in software: one is started and stopped, commanded, and flown by commands of the stack beside it.

The kit is no part of this repository. RISE_DI_SITL names its folder, by default ../shared/sitl beside the checkout; its README
says what it needs. PILOT_PYTHON is an interpreter with pymavlink, by default python3.
"""

import csv
import json
import os
import shutil
import subprocess
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from tests.conftest import REPOSITORY
from tests.ros.conftest import Process

from flight_core.vectors import FloatArray

KIT = Path(os.environ.get("RISE_DI_SITL", REPOSITORY.parent / "shared" / "sitl"))
PROFILE = REPOSITORY / "ros_ws" / "src" / "flight_ros" / "flight_ros" / "loopback.xml"
PILOT_PYTHON = os.environ.get("PILOT_PYTHON", "python3")
POLL = 0.1  # s, between two questions to the pilot
HOME_ALTITUDE = 584.0  # m, where the kit puts the aircraft
SAFE_STICKS = (1500, 1500, 1000, 1500, 1800, 1500, 1500)  # us, as the kit begins; the throttle is closed


def missing() -> str:
    """Why the kit cannot run here; empty where it can."""
    if not (KIT / "sitl").is_file():
        return f"no kit in {KIT}: RISE_DI_SITL names its folder"
    if os.geteuid() != 0:
        return "not root, and the kit makes a network namespace"
    if shutil.which("ip") is None:
        return "no ip here: apt-get install iproute2"
    environment = {**os.environ, "LD_LIBRARY_PATH": str(KIT / "lib")}
    ldd = (shutil.which("ldd") or "/usr/bin/ldd", str(KIT / "bin" / "MicroXRCEAgent"))
    libraries = subprocess.run(ldd, env=environment, capture_output=True, text=True, check=False).stdout
    if absent := [line.split()[0] for line in libraries.splitlines() if "not found" in line]:
        return f"no {', '.join(absent)} here: the kit's README names its packages"
    if subprocess.run([PILOT_PYTHON, "-c", "import pymavlink"], capture_output=True, check=False).returncode:
        return f"no pymavlink in {PILOT_PYTHON}: PILOT_PYTHON names an interpreter that has it"
    return ""


class ArduPlane:
    """ArduPlane, its agent and its transmitter, in a network of their own."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._script = str(KIT / "sitl")
        self._processes: list[Process] = []

    def up(self, **parameters: float) -> None:
        """Start agent, autopilot and transmitter, with parameters of the autopilot."""
        extra = self.folder / "extra.parm"
        self.folder.mkdir(parents=True, exist_ok=True)
        extra.write_text("".join(f"{name} {value:g}\n" for name, value in parameters.items()), encoding="utf-8")
        self._call("up", str(PROFILE), timeout=90.0, EXTRA_PARM=str(extra), PILOT_PYTHON=PILOT_PYTHON)

    def down(self) -> None:
        """Stop everything in its network."""
        self._call("down", timeout=30.0)
        for process in self._processes:
            process.end()

    def say(self, *words: str) -> str:
        """The answer of the pilot to a command."""
        return self._call("say", *words, timeout=30.0, PILOT_PYTHON=PILOT_PYTHON)

    def _call(self, action: str, *words: str, timeout: float, **environment: str) -> str:
        command = [self._script, action, str(self.folder), *words]
        # Files, not pipes: what `up` starts would hold a pipe open.
        output = self.folder / f"{action}.txt"
        with output.open("w", encoding="utf-8") as file:
            done = subprocess.run(
                command, env={**os.environ, **environment}, stdin=subprocess.DEVNULL, stdout=file, stderr=subprocess.STDOUT,
                timeout=timeout, check=False,
            )  # fmt: skip
        text = output.read_text(encoding="utf-8")
        assert done.returncode == 0, f"{' '.join(command)}: {text}"
        return text.strip()

    def start(self, *arguments: str) -> Process:
        """Start a command of rise-di in the autopilot's network."""
        within = (self._script, "in", str(self.folder))
        self._processes.append(Process("flight_cli.cli", *arguments, cwd=REPOSITORY, within=within))
        return self._processes[-1]

    def state(self) -> dict[str, Any]:
        """Mode, attitude, speed, sticks and servos."""
        state: dict[str, Any] = json.loads(self.say("get"))
        return state

    def until(self, condition: Callable[[dict[str, Any]], bool], timeout: float = 60.0) -> dict[str, Any]:
        """Poll the state until a condition holds."""
        deadline = time.monotonic() + timeout
        while not condition(state := self.state()):
            assert time.monotonic() < deadline, f"not within {timeout} s; {state}; {self.say('text')}"
            time.sleep(POLL)
        return state

    def take_off(self) -> None:
        """Arm and climb to 60 m above the ground."""
        deadline = time.monotonic() + 120.0
        while "ok" not in self.say("mode", "TAKEOFF") or self.say("arm") != "True":
            assert time.monotonic() < deadline, self.say("text")
            time.sleep(1.0)
        self.until(lambda state: bool(state.get("alt", 0.0) > HOME_ALTITUDE + 60.0))

    def level(self) -> None:
        """Fly straight and level in GUIDED."""
        for channel, position in enumerate(SAFE_STICKS, 1):
            self.say("stick", str(channel), str(position))
        assert "ok" in self.say("mode", "GUIDED")
        altitude = self.state()["alt"] - HOME_ALTITUDE
        self.say("goto", f"{altitude:.0f}")
        self.until(lambda state: max(abs(state["roll"]), abs(state["climb"]) / 20.0, abs(state["pitchspeed"])) < 0.05)

    def hand_over(self) -> None:
        """Change to MANUAL with the sticks where the servos are, so that the aircraft stays in trim."""
        self.say("sticks_from_servos")
        assert "ok" in self.say("mode", "MANUAL")

    def log(self, kind: str, *fields: str) -> tuple[FloatArray, FloatArray]:
        """The autopilot's own log over MAVLink: the times of arrival, s of the system clock, and the fields."""
        with (self.folder / "mavlink.csv").open(encoding="utf-8", newline="") as file:
            rows = [(float(row[0]), json.loads(row[2])) for row in csv.reader(file) if len(row) == 3 and row[1] == kind]
        return np.array([t for t, _ in rows]), np.array([[row[field] for field in fields] for _, row in rows])
