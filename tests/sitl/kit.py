# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Control the kits of autopilots in software.

A kit is started, stopped and commanded, and flown by commands of the stack. The kits are not part
of this repository. RISE_DI_SITL names the folder of ArduPlane's, by default ../shared/sitl beside
the checkout. The folder px4 in it is PX4's. Their READMEs say what they need. PILOT_PYTHON is an
interpreter with pymavlink, by default python3.
"""

import csv
import json
import math
import os
import re
import shutil
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from threading import Event, Thread
from typing import Any, NamedTuple

import numpy as np
import psutil
import yaml
from tests.conftest import REPOSITORY
from tests.ros.conftest import Process
from tests.sitl.shared_link import STATION

from autopilot_bridge.params import find_map
from flight_analysis.closed_loop.scenario import load_scenario
from flight_analysis.metrics.time_spans import is_in_spans
from flight_core.tape import Signal, Tape
from flight_core.vectors import FloatArray
from flight_log.tape_reader import read_run

KIT = Path(os.environ.get("RISE_DI_SITL", REPOSITORY.parent / "shared" / "sitl"))
PROFILE = REPOSITORY / "ros_ws" / "src" / "flight_ros" / "flight_ros" / "loopback.xml"
PILOT_PYTHON = os.environ.get("PILOT_PYTHON", "python3")
# of a rehearsal
OWN_MAP = os.environ.get("RISE_DI_MAP")
OWN_SCENARIO = os.environ.get("RISE_DI_SCENARIO")
POLL = 0.1  # s, between two questions to the autopilot
ENGAGEMENTS = 4  # attempts: some seconds of level flight end the climb that a fault before has left
BOUNDED = 100.0  # s: a longer flight is engaged without the bound of the maps, 120 s
# s, in place of the shipped maps' 0.2 s: a busy host stops autopilot and agent for half a second
MAX_AGE = 1.0
OVERRIDE_TIME = 0.5  # s, RC_OVERRIDE_TIME: the map of MAVLink requires 1 s or less
OWN_SIGNALS = {
    **{
        name: ("ATTITUDE", f"{axis}speed")
        for name, axis in (("q", "pitch"), ("p", "roll"), ("r", "yaw"))
    },
    "V": ("VFR_HUD", "airspeed"),
}
"""Message and field of the autopilot's log for each channel of y."""

# us, as the kit begins; the throttle is closed
SAFE_STICKS = (1500, 1500, 1000, 1500, 1800, 1500, 1500)
# %, of the throttle: with the limits of the map around it, -20 and 30 %, within its range
CRUISE = (25.0, 65.0)
Program = Mapping[str, tuple[Sequence[float], Sequence[float]]]
"""Commands of guidance by channel: times, s, and values."""

TURN = 0.7  # rad, 40 deg
# m above the ground, of ArduPlane's flights: an open loop in turbulence loses some of it
ALTITUDE = 300.0


def missing() -> str:
    """Return why the kits cannot run here, or "" if they can."""
    for script in (KIT / "sitl", KIT / "px4" / "sitl"):
        if not script.is_file():
            return f"no {script}: RISE_DI_SITL names the folder of the kit"
    if os.geteuid() != 0:
        return "not root, and the kit makes a network namespace"
    if shutil.which("ip") is None:
        return "no ip here: apt-get install iproute2"
    environment = {**os.environ, "LD_LIBRARY_PATH": str(KIT / "lib")}
    ldd = (shutil.which("ldd") or "/usr/bin/ldd", str(KIT / "bin" / "MicroXRCEAgent"))
    libraries = subprocess.run(
        ldd, env=environment, capture_output=True, text=True, check=False
    ).stdout
    if absent := [line.split()[0] for line in libraries.splitlines() if "not found" in line]:
        return f"no {', '.join(absent)} here: the kit's README names its packages"
    if subprocess.run(
        [PILOT_PYTHON, "-c", "import pymavlink"], capture_output=True, check=False
    ).returncode:
        return f"no pymavlink in {PILOT_PYTHON}: PILOT_PYTHON names an interpreter that has it"
    return ""


class Autopilot:
    """An autopilot and its agent in their own network.

    It has the flights of the stack.
    """

    script: Path
    namespace: str  # of the network, as the kit names it
    engage_options: tuple[str, ...] = ()

    def __init__(self, folder: Path) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self.folder = folder
        self._processes: list[Process] = []
        self._restarted: list[subprocess.Popen[bytes]] = []  # processes of the kit

    def down(self) -> None:
        """Stop everything in its network."""
        self._call("down", timeout=30.0)
        for process in self._processes:
            process.end()
        for restarted in self._restarted:
            restarted.wait(10.0)

    def say(self, *words: str) -> str:
        """Return the answer to a command."""
        return self._call("say", *words, timeout=30.0)

    def _call(self, action: str, *words: str, timeout: float, **environment: str) -> str:
        command = [str(self.script), action, str(self.folder), *words]
        # Files, not pipes: what `up` starts would hold a pipe open.
        output = self.folder / f"{action}.txt"
        with output.open("w") as file:
            process = subprocess.run(
                command, env={**os.environ, "PILOT_PYTHON": PILOT_PYTHON, **environment},
                stdin=subprocess.DEVNULL,
                stdout=file, stderr=subprocess.STDOUT, timeout=timeout, check=False,
            )  # fmt: skip
        text = output.read_text()
        assert process.returncode == 0, f"{' '.join(command)}: {text}"
        return text.strip()

    def kill(self, *programs: str) -> Callable[[], None]:
        """Kill processes of the kit. The returned function starts them again as the kit did."""
        pids = [int(line) for line in (self.folder / "pids").read_text().split()]
        parents = [psutil.Process(pid) for pid in pids if psutil.pid_exists(pid)]

        def is_one(process: psutil.Process, program: str) -> bool:
            return any(
                Path(word).name == program
                for member in (process, *process.children())
                for word in member.cmdline()
            )

        options = [
            next(parent for parent in parents if is_one(parent, program)) for program in programs
        ]
        again = [
            (["ip", "netns", "exec", self.namespace, *process.cmdline()], process.environ())
            for process in options
        ]
        for parent in options:
            for process in (*parent.children(), parent):
                process.kill()

        def start() -> None:
            psutil.wait_procs(options)
            for program, (command, environment) in zip(programs, again, strict=True):
                with (self.folder / f"{program}_again.log").open("w") as log:
                    started = subprocess.Popen(
                        command,
                        env=environment,
                        cwd=self.folder,
                        stdin=subprocess.DEVNULL,
                        stdout=log,
                        stderr=log,
                    )
                self._restarted.append(started)
                with (self.folder / "pids").open("a") as file:
                    file.write(f"{started.pid}\n")

        return start

    def start(self, *arguments: str) -> Process:
        """Start a command of rise-di in the autopilot's network."""
        return self._module("flight_cli.cli", *arguments)

    def _module(self, *arguments: str, path: str = "") -> Process:
        """Start a Python module, with its arguments, in the autopilot's network."""
        prefix = ("env", f"PYTHONPATH={path}", str(self.script), "in", str(self.folder))
        self._processes.append(Process(*arguments, cwd=REPOSITORY, within=prefix))
        return self._processes[-1]

    def state(self) -> dict[str, Any]:
        """Return what the autopilot says about itself now."""
        raise NotImplementedError

    def until(
        self, condition: Callable[[dict[str, Any]], bool], timeout: float = 60.0
    ) -> dict[str, Any]:
        """Poll the state until a condition is true."""
        deadline = time.monotonic() + timeout
        while not condition(state := self.state()):
            assert time.monotonic() < deadline, f"not within {timeout} s; {state}"
            time.sleep(POLL)
        return state

    def level(self) -> None:
        """Fly straight and level in a mode of the autopilot."""
        raise NotImplementedError

    def hand_over(self) -> None:
        """Change to the mode in which the stack is engaged.

        This is needed if the bridge does not ask for it.
        """

    def patient_map(self, name: str, *changes: tuple[str, str]) -> str:
        """Return a copy of a map with longer ages, and with further changes of its text."""
        text = find_map(name).read_text()
        for old, new in (
            ("max_age: 0.2 ", f"max_age: {MAX_AGE} "),
            ("max_age: 0.35 ", f"max_age: {MAX_AGE} "),
            *changes,
        ):
            text = text.replace(old, new)
        path = self.folder / f"{Path(name).stem}.yaml"
        path.write_text(text)
        return str(path)

    def engage(self, *options: str) -> Process:
        """Start `rise-di engage`, by default with the options that the autopilot needs."""
        return self.start("engage", *(options or self.engage_options))

    def fly(self, scenario: Path, channel_map: str, duration: float, *options: str) -> Process:
        """Start a flight of the stack."""
        arguments = (
            str(scenario),
            "--bridge",
            channel_map,
            "--duration",
            f"{duration:g}",
            "--runs",
            str(self.folder / "runs"),
        )
        return self.start("fly", *arguments, *options)

    @contextmanager
    def engaged(
        self, scenario: Path, channel_map: str, duration: float, *, transmitter: bool = False
    ) -> Iterator[Process]:
        """Yield a flight of the stack, engaged from level flight.

        Afterwards the autopilot flies level in its own mode. `transmitter` says whether the bridge
        watches the transmitter.
        """
        self.level()
        flight = self.fly(scenario, channel_map, duration, "--send")
        try:
            flight.wait_for("DISENGAGED")
            blind = ("--blind",) if duration > BOUNDED else self.engage_options
            self._engage_level(*(() if transmitter else blind))
            yield flight
        finally:
            if flight.popen.poll() is None:
                flight.interrupt()
                flight.end()
            self.level()

    def requested(self, *options: str) -> Process:
        """Request `rise-di engage` until the rates of a MAVLink link are known, and return its end.

        They are known 2 s after its beginning.
        """
        for _ in range(ENGAGEMENTS):
            request = self.start("engage", *options)
            if request.end() == 0 or "not known yet" not in request.output:
                break
        return request

    def _engage_level(self, *options: str) -> None:
        """Engage, and do so again from level flight if the aircraft climbs or sinks then.

        It does so after a jammed surface.
        """
        for _ in range(ENGAGEMENTS):
            self.hand_over()
            request = self.requested(*options)
            if request.end() == 0 or "engage_if" not in request.output:
                break
            self.level()
        request.succeed()

    def experiment(self, *command: str) -> Process:
        """Fly the experiment of `identify bridge` to its end in the air.

        The arguments are those of the command.
        """
        self.level()
        excited = self.start(*command)
        excited.wait_for("DISENGAGED")
        self.hand_over()
        self.requested(*self.engage_options).succeed()
        excited.wait_for("log: ", 150.0)
        self.level()
        return excited

    @property
    def run(self) -> Path:
        """Return the folder of the last flight."""
        return (self.folder / "runs" / "latest").resolve()

    def summary(self) -> dict[str, Any]:
        """Return the summary of the last flight.

        It has the outcome, and the engagements with start, stop and reason.
        """
        figures: dict[str, Any] = json.loads((self.run / "summary.json").read_text())
        return figures


def guided_scenario(scenario: Path, program: Program, speed: float) -> str:
    """Return the text of a scenario whose commands are replaced by guidance by rule.

    `program` has times, s, and values by channel. On a busy host, the poses may be MAX_AGE old.
    """
    content = yaml.safe_load(scenario.read_text())
    reference = content["/**/reference_model"]["ros__parameters"]
    nodes = {
        key: value for key, value in reference.items() if key not in {"pulses", "coordinated_turn"}
    }
    content["/**/reference_model"]["ros__parameters"] = nodes | {"live": {"speed": speed}}
    steps = {
        name: {"start": list(start), "value": list(value)}
        for name, (start, value) in program.items()
    }
    content["/**/guidance"] = {"ros__parameters": {"max_age": MAX_AGE, "program": steps}}
    return str(yaml.safe_dump(content))


def followed(tape: Tape, name: str, start: float, stop: float) -> float:
    """Return the part of y that follows y_m from start to stop, s, as a fraction of y_m.

    It is the largest one at a delay below 0.6 s.
    """
    y = tape["y"]
    y_m = tape["y_m"]
    t = tape.time("y")
    t_m = tape.time("y_m")
    inside = (t > start) & (t < stop)
    parts = []
    for delay in np.arange(0.0, 0.6, 0.05):
        reference = np.interp(t[inside] - delay, t_m, y_m[name])
        deviation = reference - reference.mean()
        parts.append(float(y[name][inside] @ deviation / (deviation @ deviation)))
    return max(parts)


class Agreement(NamedTuple):
    """A signal of the stack over the autopilot's own.

    It is taken at the delay between them with the smallest residual.
    """

    # by orthogonal regression: the instants of both jitter, so an ordinary one, with noise in one
    # alone, is low
    slope: float
    offset: float  # difference of the means
    delay: float  # s


def agreement(t: FloatArray, logged: FloatArray, t_y: FloatArray, y: FloatArray) -> Agreement:
    """Return the agreement of y(t_y) with logged(t)."""
    fits = []
    for delay in np.arange(-0.3, 0.3, 0.005):
        delayed = np.interp(t + delay, t_y, y)
        variances, directions = np.linalg.eigh(np.cov(logged, delayed))
        best = Agreement(
            float(directions[1, 1] / directions[0, 1]),
            float(np.mean(delayed - logged)),
            float(delay),
        )
        fits.append((float(variances[0]), best))
    return min(fits)[1]


METRES = 111_318.845 * 1e-7  # per unit of GLOBAL_POSITION_INT.lat: ArduPilot's LATLON_TO_M
HOME = (-353_632_620, 1_491_652_370)  # 1e-7 deg, where the kit puts the aircraft
IN_METRES = {
    "north": (METRES, HOME[0]),
    "east": (METRES * float(np.cos(np.radians(HOME[0] * 1e-7))), HOME[1]),
    "altitude": (1e-3, 0.0),
    "v_north": (1e-2, 0.0),
    "v_east": (1e-2, 0.0),
    "climb": (-1e-2, 0.0),
}
"""What turns a value of GLOBAL_POSITION_INT into that of the pose: factor and the value at 0."""
LOGGED: tuple[tuple[str, str, dict[str, str]], ...] = (
    ("y", "ATTITUDE", {"p": "rollspeed", "q": "pitchspeed", "r": "yawspeed"}),
    ("pose", "ATTITUDE", {"phi": "roll", "theta": "pitch", "psi": "yaw"}),
    (
        "pose",
        "GLOBAL_POSITION_INT",
        {
            "north": "lat",
            "east": "lon",
            "altitude": "relative_alt",
            "v_north": "vx",
            "v_east": "vy",
            "climb": "vz",
        },
    ),
)
"""Topic, message of MAVLink, and its field for each channel."""


class ArduPlane(Autopilot):
    """ArduPlane, its agent and its transmitter."""

    script = KIT / "sitl"
    namespace = "rise_di_sitl"
    home = 584.0  # m, where the kit puts the aircraft
    throttle = CRUISE  # %, of level flight

    def up(self, **parameters: float) -> None:
        """Start agent, autopilot and transmitter, with parameters of the autopilot."""
        extra = self.folder / "extra.parm"
        extra.write_text("".join(f"{name} {value:g}\n" for name, value in parameters.items()))
        self._call("up", str(PROFILE), timeout=90.0, EXTRA_PARM=str(extra))

    def state(self) -> dict[str, Any]:
        """Return mode, attitude, speed, sticks and servos."""
        state: dict[str, Any] = json.loads(self.say("get"))
        return state

    def take_off(self) -> None:
        """Arm, and climb to ALTITUDE."""
        deadline = time.monotonic() + 120.0
        while "ok" not in self.say("mode", "TAKEOFF") or self.say("arm") != "True":
            assert time.monotonic() < deadline, self.say("text")
            time.sleep(1.0)
        self.until(lambda state: bool(state.get("alt", 0.0) > self.home + 60.0))
        self.level()

    def level(self) -> None:
        """Fly straight and level in GUIDED, at ALTITUDE or above."""
        for channel, position in enumerate(SAFE_STICKS, 1):
            self.say("stick", str(channel), str(position))
        assert "ok" in self.say("mode", "GUIDED"), self.say("text")
        target = max(self.state()["alt"] - self.home, ALTITUDE)
        self.say("goto", f"{target:.0f}")
        self.until(lambda state: bool(state["alt"] > self.home + target - 20.0), timeout=120.0)
        self.until(
            lambda state: (
                max(abs(state["roll"]), abs(state["climb"]) / 20.0, abs(state["pitchspeed"])) < 0.05
                and self.throttle[0] < state["throttle"] < self.throttle[1]
            )
        )

    @contextmanager
    def without_transmitter(self) -> Iterator[None]:
        """Lose the transmitter."""
        self.say("param", "SIM_RC_FAIL", "1")
        try:
            yield
        finally:
            self.say("param", "SIM_RC_FAIL", "0")

    def hand_over(self) -> None:
        """Change to MANUAL with the sticks where the servos are.

        So the aircraft stays in trim.
        """
        self.say("sticks_from_servos")
        assert "ok" in self.say("mode", "MANUAL")

    def restart(self) -> None:
        """End the autopilot and start it again, on the ground.

        Its ground station does not notice this in another way.
        """
        again = self.kill("pilot.py", "arduplane")
        (self.folder / "pilot.sock").unlink()
        again()
        deadline = time.monotonic() + 60.0
        while not (self.folder / "pilot.sock").exists():
            assert time.monotonic() < deadline, "no heartbeat of the restarted autopilot"
            time.sleep(POLL)

    def log(self, kind: str, *fields: str) -> tuple[FloatArray, FloatArray]:
        """Return the autopilot's own log over MAVLink.

        It has the times of arrival, s of the system clock, and the fields.
        """
        with (self.folder / "mavlink.csv").open(encoding="utf-8", newline="") as file:
            rows = [
                (float(row[0]), json.loads(row[2]))
                for row in csv.reader(file)
                if len(row) == 3 and row[1] == kind
            ]
        return np.array([t for t, _ in rows]), np.array(
            [[row[field] for field in fields] for _, row in rows]
        )

    def mavlink_map(self, *changes: tuple[str, str]) -> str:
        """Return the map `ardupilot_mavlink` with longer ages, on the second serial port.

        The ground station of the kit is connected, too.
        """
        return self.patient_map(
            "ardupilot_mavlink", ("url: udpin:127.0.0.1:14551", "url: tcp:127.0.0.1:5763"), *changes
        )

    def shared_map(self) -> str:
        """Return the map `ardupilot_mavlink` with longer ages, on the link of `shared_link`.

        It has the number of its station.
        """
        return self.patient_map(
            "ardupilot_mavlink", ("source_system: 255", f"source_system: {STATION}")
        )

    @contextmanager
    def shared_link(self) -> Iterator[Callable[[str], None]]:
        """Start `tests.sitl.shared_link`, whose station is the autopilot's.

        The returned function sends it a word.
        """
        path = str(self.folder / "link.sock")
        link = self._module("tests.sitl.shared_link", path)
        self.say("param", "MAV_GCS_SYSID", str(STATION))
        try:
            link.wait_for("ready")
            with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as control:

                def command(word: str) -> None:
                    control.sendto(word.encode(), path)

                yield command
        finally:
            link.popen.terminate()
            link.end()
            Path(path).unlink(missing_ok=True)
            self.say("param", "MAV_GCS_SYSID", "255")

    def dataflash(self) -> Path:
        """Return the newest log that the autopilot wrote itself."""
        return max((self.folder / "logs").glob("*.BIN"), key=lambda path: path.stat().st_mtime)

    def own_errors(self, ratio: float = 1.0) -> dict[str, tuple[float, float]]:
        """Return the rms of the autopilot's own log minus y_m, and of y_m, by channel.

        It covers the engaged time in which y_m is commanded. V is measured by the sensor, as a
        deviation from its value at the engagement, times `ratio`, which is the true over the
        equivalent airspeed.
        """
        log = read_run(self.run)
        (span,) = log.engagements or []
        y_m = log.tape["y_m"]
        pulses = load_scenario(self.run / "parameters.yaml").reference_model.pulses
        stop_ns = span.stop_ns or int(y_m.stamp_ns[-1])
        errors = {}
        for name, (kind, field) in OWN_SIGNALS.items():
            t, values = self.log(kind, field)
            speed = values[:, 0]
            if name == "V":
                speed = ratio * (speed - np.interp(span.start_ns / 1e9, t, speed))
            # r follows p in coordinated turns
            pulse = pulses.get(name, pulses["p"]) if name == "r" else pulses[name]
            edges = zip(pulse.start, pulse.stop, strict=True)
            begin = log.tape.start_ns / 1e9
            commanded = is_in_spans(
                t, [(begin + start, begin + stop + 1.0) for start, stop in edges]
            )
            commanded &= (t > span.start_ns / 1e9) & (t < stop_ns / 1e9)
            reference = np.interp(t[commanded], y_m.stamp_ns / 1e9, y_m[name])
            if commanded.any():
                errors[name] = (
                    float(np.sqrt(np.mean((speed[commanded] - reference) ** 2))),
                    float(np.sqrt(np.mean(reference**2))),
                )
        return errors

    def turns(
        self, starts: Sequence[float], altitude: float, speed: float
    ) -> dict[str, tuple[Sequence[float], Sequence[float]]]:
        """Return a program of guidance with manoeuvres at each start, s.

        They are the turn TURN, a climb or sink of 15 m, and a change of the airspeed by 1 m/s.
        """
        self.state()  # writes the log
        heading = float(self.log("ATTITUDE", "yaw")[1][-1, 0])
        numbers = range(1, len(starts) + 1)
        return {
            "heading": (
                starts,
                [math.remainder(heading + TURN * k, 2.0 * math.pi) for k in numbers],
            ),
            "altitude": (starts, [altitude + 15.0 * (k % 2) for k in numbers]),
            "V": (starts, [speed + k % 2 for k in numbers]),
        }

    def wander(self, flight: Process) -> None:
        """Fly turns and climbs until a flight of the stack ends by itself."""
        heading = 0.0
        while flight.popen.poll() is None:
            heading += 140.0
            self.say("goto", f"{ALTITUDE + heading % 100.0:.0f}", f"{heading % 360.0:.0f}")
            self.until(lambda state: abs(state["roll"]) > 0.5)  # rad, in the turn
            self.until(lambda state: abs(state["roll"]) < 0.1)  # rad, out of it
        flight.succeed()

    def compare(self) -> dict[str, Agreement]:
        """Compare the rates and the pose of the last flight with the autopilot's own log."""
        tape = read_run(self.run).tape
        compared = {}
        for topic, kind, rows in LOGGED:
            t, logged = self.log(kind, *rows.values())
            signal = tape[topic]
            t_y = signal.stamp_ns / 1e9
            inside = (t > t_y[0] + 0.5) & (t < t_y[-1] - 0.5)
            for name, values in zip(rows, logged[inside].T, strict=True):
                series = signal[name]
                if name == "psi":
                    series = np.unwrap(series)
                    values = np.unwrap(values)  # noqa: PLW2901 - the same angle
                elif name in IN_METRES:
                    scale, begin = IN_METRES[name]
                    values = scale * (values - begin)  # noqa: PLW2901 - the same position
                compared[name] = agreement(t[inside], values, t_y, series)
        return compared


class Px4(Autopilot):
    """PX4 and its agent. There is no transmitter."""

    script = KIT / "px4" / "sitl"
    namespace = "rise_di_px4"
    engage_options = ("--blind",)
    tools = KIT / "px4" / "fly"
    home = 489.4  # m, where its simulator begins

    def up(self, **parameters: float) -> None:
        """Start agent and autopilot, with parameters of the autopilot."""
        self._call(
            "up",
            str(PROFILE),
            timeout=60.0,
            **{f"PX4_PARAM_{name}": f"{value:g}" for name, value in parameters.items()},
        )

    def listen(self, topic: str, *names: str) -> dict[str, float]:
        """Return fields of the newest message of a topic of uORB."""
        lines = [
            line.strip().partition(":")
            for line in self.say("listener", topic, "-n", "1").splitlines()
        ]
        numbers_as_text = {
            name: value.split() for name, _, value in lines if name in names and value.strip()
        }
        numbers = {
            name: float(words[0].removesuffix(",")) for name, words in numbers_as_text.items()
        }
        if "timestamp" in numbers_as_text:  # "308080000 (0.320000 seconds ago)"
            numbers["ago"] = float(numbers_as_text["timestamp"][1].removeprefix("("))
        return numbers

    def state(self) -> dict[str, Any]:
        """Return nav_state, arming_state, and the altitude above home."""
        state = self.listen("vehicle_status", "nav_state", "arming_state")
        height = self.listen("vehicle_local_position", "z", "vz")
        return {**state, "alt": -height.get("z", 0.0), "climb": -height.get("vz", 0.0)}

    def take_off(self) -> None:
        """Take off from the runway, into Hold.

        The airplane cannot hold its default speed of 15 m/s.
        """
        deadline = time.monotonic() + 60.0
        armed = False
        while not armed:
            assert time.monotonic() < deadline, "PX4 does not arm"
            time.sleep(1.0)
            # not running yet, or refused until its estimator is ready
            with suppress(AssertionError):
                self.say("commander", "takeoff")
                armed = self.state()["arming_state"] == ARMED

        def climbed(state: dict[str, Any]) -> bool:
            # armed before its estimator had a position
            if state["nav_state"] == HOLD and state["alt"] < 5.0:
                self.say("commander", "takeoff")
            return bool(state["alt"] > 20.0)

        self.until(climbed)
        self.say("param", "set", "FW_AIRSPD_MIN", "8")
        self.say("param", "set", "FW_AIRSPD_TRIM", "11.2")

    def level(self) -> None:
        """Fly straight ahead in Hold.

        The place ahead is 20 km to the north, 150 m above the ground.
        """
        # not before its agent is connected
        self.until(lambda _: self.tool("say", "away", "0", "20000", "150").end() == 0)
        self.until(
            lambda state: (
                state["nav_state"] == HOLD and state["alt"] > 100.0 and abs(state["climb"]) < 0.5
            ),
            timeout=120.0,
        )

    def tool(self, name: str, *arguments: str) -> Process:
        """Start a tool of the kit in the autopilot's network."""
        return self._module(name, *arguments, path=str(self.tools))

    def parameter(self, name: str) -> float:
        """Return the value of a parameter of PX4."""
        return float(self.say("param", "show", "-q", name).splitlines()[-1])

    def restart(self) -> None:
        """End PX4 and start it again, on the ground."""
        self.kill("px4")()

    @contextmanager
    def watching_truth(self) -> Iterator[Callable[[], Signal]]:
        """Ask the simulator for its own p, q, r ten times a second.

        The returned function gives them, rad/s, by the system clock.
        """
        samples: list[tuple[float, FloatArray]] = []  # s of the system clock; p, q, r
        has_ended = Event()

        def ask() -> None:
            command = (
                str(self.script),
                "say",
                str(self.folder),
                "listener",
                "vehicle_angular_velocity_groundtruth",
                "-n",
                "1",
            )
            while not has_ended.wait(POLL):
                answer = subprocess.run(
                    command, capture_output=True, text=True, timeout=30.0, check=False
                ).stdout
                # the client ends with the answer; most of its time goes by before the question
                now = time.time()
                match = re.search(r"timestamp: \d+ \(([\d.]+) .*xyz: \[(.*?)\]", answer, re.DOTALL)
                if match is not None:
                    samples.append(
                        (
                            now - float(match[1]),
                            np.array([float(coordinate) for coordinate in match[2].split(",")]),
                        )
                    )

        def truth() -> Signal:
            stamps = np.round(np.array([t for t, _ in samples]) * 1e9).astype(np.int64)
            return Signal(stamps, ("p", "q", "r"), np.array([rates for _, rates in samples]))

        asking = Thread(target=ask)
        asking.start()
        try:
            yield truth
        finally:
            has_ended.set()
            asking.join()

    def mode_changed(self) -> float:
        """Return when nav_state changed last, s of the monotonic clock."""
        status = self.listen("vehicle_status", "timestamp", "nav_state_timestamp")
        return (
            time.monotonic()
            - status["ago"]
            - 1e-6 * (status["timestamp"] - status["nav_state_timestamp"])
        )


class Quadrotor(Px4):
    """PX4's quadrotor and its agent, started by a copy of the kit's script with another model."""

    hover = 60.0  # m above home

    def __init__(self, folder: Path) -> None:
        super().__init__(folder)
        self.script = folder / "sitl"
        text = Px4.script.read_text()
        for pattern, value in (
            (r"^KIT=.*$", f"KIT={Px4.script.parent}"),
            (r"PX4_SIM_MODEL=\S+", "PX4_SIM_MODEL=sihsim_quadx"),
        ):
            text, count = re.subn(pattern, value, text, flags=re.MULTILINE)
            assert count == 1, f"{Px4.script}: {pattern}"
        self.script.write_text(text)
        self.script.chmod(0o755)

    def take_off(self) -> None:
        """Take off to hover in Hold."""
        deadline = time.monotonic() + 60.0
        while self.state().get("arming_state") != ARMED:
            assert time.monotonic() < deadline, "PX4 does not arm"
            time.sleep(1.0)
            # not running yet, or refused until its estimator is ready
            with suppress(AssertionError):
                self.say("commander", "takeoff")
        self.until(lambda state: state["alt"] > self.hover - 5.0, timeout=120.0)
        self.level()

    def level(self) -> None:
        """Hover in Hold."""
        self.say("commander", "mode", "auto:loiter")
        self.until(
            lambda state: (
                state["nav_state"] == HOLD and abs(state["climb"]) < 0.3 and state["alt"] > 15.0
            ),
            timeout=120.0,
        )


HOLD, OFFBOARD, ARMED = 4, 14, 2  # nav_state of PX4: AUTO_LOITER, OFFBOARD; its arming_state


def burn(seconds: float, per_core: int = 4) -> Sequence[subprocess.Popen[bytes]]:
    """Keep every core busy with several processes at once for a time."""
    code = f"import time; end = time.monotonic() + {seconds}\nwhile time.monotonic() < end: pass"
    return [
        subprocess.Popen([sys.executable, "-c", code])
        for _ in range(per_core * (os.cpu_count() or 1))
    ]
