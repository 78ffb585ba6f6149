# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test the bridge over DDS: the unchanged controller flies a simulated autopilot.

The map is examples/maps/ardupilot_2024.yaml. tests/nodes/autopilot_bridge/test_bridge.py tests what
a bridge does with its messages. These tests are about the commands, the flight with a bridge, and
the ends of its process.
"""

import json
import math
import signal
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import Joy
from std_msgs.msg import UInt8
from tests.conftest import REPOSITORY, invoke
from tests.maps import MAP_FILES
from tests.ros.conftest import Process, Start
from tests.ros.peer import Peer, peer, stamp_ns
from tests.ros.waiting import HostDelays

from aircraft_sim.airframes.airframe import load_airframe
from flight_core.modes import Mode
from flight_core.outcome import STATUS_SHORTFALL
from flight_core.rates import NANOSECONDS
from flight_log.stored_messages import stored_messages
from flight_log.tape_reader import read_run

SCENARIO = REPOSITORY / "tests" / "ros" / "slow_autopilot.yaml"
BEST_EFFORT = QoSProfile(depth=100, reliability=ReliabilityPolicy.BEST_EFFORT)
RELEASE_AFTER = 2.0  # s, in place of the 3 s of RC_OVERRIDE_TIME, longer than MAX_AGE
NEUTRAL = 0.4  # s, in tests with neutral values
FULL = math.radians(30.0)  # full deflection of a surface in the map
PATIENT = 5.0  # s, of y and u, where a release by their age would hide another one
MAX_AGE, RELEASE = 1.5, 0.5  # s; MAX_AGE replaces the map's 0.2 s: a host pauses for up to a second
# s, scheduling delay of a host under load; without load a tick of 5 ms and a message period of 20
# ms
LATE = 0.2


class BridgeSetup:
    """The processes around a bridge, and a subscription to the messages for the autopilot."""

    def __init__(self, start: Start, peer_node: Peer, folder: Path) -> None:
        self._start = start
        self.map = str(folder / "ardupilot.yaml")
        Path(self.map).write_bytes(MAP_FILES["ardupilot_2024"].read_bytes())
        self.change_map(silence={"max_age": MAX_AGE})
        for name in ("q", "V", "p", "r"):
            self.change_map(outputs={name: {"max_age": MAX_AGE}})
        self.peer = peer_node
        # messages to the autopilot, and the axes of the last one
        self.sent, self.axes = (0, list[float]())
        peer_node.node.create_subscription(Joy, "/ap/joy", self._take, BEST_EFFORT)

    def _take(self, joy: Joy) -> None:
        self.sent, self.axes = self.sent + 1, list(joy.axes)

    def change_map(self, **changes: Any) -> None:
        """Change keys of the map. Of a mapping, only the given keys change."""
        content = yaml.safe_load(Path(self.map).read_text())
        Path(self.map).write_text(yaml.safe_dump(merged(content, changes), sort_keys=False))

    def autopilot(self) -> Process:
        """Start the simulated autopilot."""
        return self._start("tests.ros.autopilot", str(SCENARIO), str(RELEASE_AFTER))

    def bridge(self) -> Process:
        """Start a bridge that sends, and wait until it is ready."""
        arguments = ("--ros-args", "-p", f"map:={self.map}", "-p", "dry_run:=false")
        return self._start("autopilot_bridge.main", *arguments).wait_for("ready")

    def command(self, each: Callable[[], None] | None, *options: str) -> Process:
        """Run `rise-di engage` until it has ended, while u is published."""
        client = self._start("flight_cli.cli", "engage", *options)
        self.peer.until(
            lambda: client.popen.poll() is not None, "the end of the command", each=each
        )
        return client

    def send(self) -> None:
        """Publish u at trim."""
        self.peer.command(0.0, 0.0, 0.0, 0.0)


def merged(content: dict[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    """Return a map with changes.

    Merged keys of YAML share one object, which is not changed.
    """
    inner = {
        key: merged(content[key], value) if is_part(content, key, value) else value
        for key, value in changes.items()
    }
    return content | inner


def is_part(content: Mapping[str, Any], key: str, value: object) -> bool:
    """Return whether a change is of some keys of a mapping."""
    return isinstance(value, Mapping) and isinstance(content.get(key), Mapping)


@pytest.fixture
def setup(start: Start, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[BridgeSetup]:
    monkeypatch.setenv("PYTHONPATH", str(REPOSITORY))  # for tests.ros.autopilot
    with peer(topics=("u", "y", "y_m", "internals", "bridge/would_send")) as peer_node:
        yield BridgeSetup(start, peer_node, tmp_path)


def test_command_engages_withdraws_and_says_what_still_releases(
    setup: BridgeSetup, start: Start
) -> None:
    """A map without a bound needs `--blind`, and Ctrl-C withdraws a request that waits.

    A bridge that ends releases the autopilot. One that is killed leaves this to the autopilot.
    """
    condition = {
        "topic": "/ap/mode",
        "type": "std_msgs/msg/UInt8",
        "field": "data",
        "one_of": [15],
        "sentence": "the mode is not guided",
        "max_age": 1e3,
        "awaited": True,
        "source": "a test",
    }
    qos = {"reliability": "reliable", "durability": "volatile", "depth": 1}
    setup.change_map(max_engaged=None, engage_timeout=1e3, topics={"/ap/mode": qos})
    setup.change_map(conditions={"guided": condition})
    autopilot = setup.autopilot()
    bridge = setup.bridge()
    mode = setup.peer.node.create_publisher(UInt8, "/ap/mode", 1)

    def manual() -> None:
        setup.send()
        mode.publish(UInt8(data=10))

    def guided() -> None:
        setup.send()
        mode.publish(UInt8(data=15))

    setup.peer.until(
        lambda: setup.peer.last("y") and setup.peer.last("bridge/would_send"),
        "y and u",
        each=manual,
    )
    command = setup.command(manual)
    assert command.end() == 1
    assert (
        "not engaged: the loss of the transmitter cannot be seen over this link: set max_engaged"
        in command.output
    )
    client = start("flight_cli.cli", "engage", "--blind")
    waiting = "waiting: the mode is not guided (data is 10)"
    setup.peer.until(lambda: client.has_logged(waiting), "a request that waits", each=manual)
    client.interrupt()
    setup.peer.until(lambda: client.popen.poll() is not None, "the end of the command", each=manual)
    assert client.end() == 130, client.output
    setup.peer.until(
        lambda: bridge.has_logged("ENGAGING -> RELEASE: disengaged by request"),
        "a withdrawal",
        each=manual,
    )
    blind = setup.command(guided, "--blind").succeed()
    assert (
        "the loss of the transmitter cannot be seen over this link; released by the override by "
        "gamepad" in blind.output
    )
    assert setup.command(guided, "--off").end() == 0
    assert bridge.has_logged("ENGAGED -> RELEASE: disengaged by request")

    setup.command(guided, "--blind").succeed()
    setup.peer.until(
        lambda: setup.axes and not all(map(math.isnan, setup.axes)),
        "messages to the autopilot",
        each=guided,
    )
    bridge.popen.send_signal(signal.SIGHUP)  # a bridge that ends releases
    bridge.succeed()
    setup.peer.until(lambda: all(map(math.isnan, setup.axes)), "release values")
    killed = setup.bridge()
    setup.command(guided, "--blind").succeed()
    setup.peer.until(
        lambda: not all(map(math.isnan, setup.axes)), "messages to the autopilot", each=guided
    )
    timeouts = autopilot.lines.count("timeout")
    killed.popen.kill()  # one that is killed leaves it to the autopilot
    setup.peer.until(
        lambda: autopilot.lines.count("timeout") > timeouts, "the autopilot's own timeout"
    )


def test_rise_di_fly_starts_bridge_and_logs_autopilot_topics(
    setup: BridgeSetup, start: Start, tmp_path: Path
) -> None:
    setup.autopilot()
    flight = start(
        "flight_cli.cli", "fly", str(SCENARIO), "--bridge", setup.map, "--duration", "15", "--json"
    )
    setup.peer.until(lambda: setup.peer.received["bridge/would_send"], "a u through the bridge")
    request = start("flight_cli.cli", "engage")
    # The flight is so long that a busy host starts the command and answers it before the end.
    assert request.end() == 1, request.output
    setup.peer.until(lambda: flight.popen.poll() is not None, "the end of the flight")
    assert "error: not engaged: dry_run is true: nothing is sent" in request.output
    assert flight.end() in {0, STATUS_SHORTFALL}, flight.output  # incomplete: the host paused
    assert "request rejected" not in flight.output
    run = tmp_path / "runs" / "latest"
    log = read_run(run)
    assert {"y", "y_m", "u", "bridge/would_send"} <= log.tape.signals.keys()
    assert "truth" not in log.tape
    # the law is inactive from the start: its integrals would wind up
    assert "internals" not in log.tape
    u = log.tape["u"].values
    assert not u.any()  # what is sent at an engagement: the trim
    assert len(u) > 150  # of 750
    summary = json.loads((run / "summary.json").read_text())
    assert summary["outcome"]["sentence"].startswith("completed")
    assert summary["engagements"] == []
    assert summary["notes"][0].startswith("never engaged")
    assert Path(setup.map).read_bytes() in [file.content for file in log.attachments]
    counts = Counter(message.topic for message in stored_messages(run))
    assert counts["/ap/twist/filtered"] > 150  # of 750
    assert counts["/ap/joy"] == 0  # a dry run
    assert not setup.sent


def test_controller_is_active_only_while_engaged_and_summary_says_when_and_why(
    setup: BridgeSetup, start: Start, tmp_path: Path, host_delays: HostDelays
) -> None:
    begin = time.time()
    setup.autopilot()
    flight = start(
        "flight_cli.cli",
        "fly",
        str(SCENARIO),
        "--bridge",
        setup.map,
        "--send",
        "--duration",
        "10000",
        "--json",
    )
    # A busy host may start the bridge later than the 10 s for which the command waits for one.
    setup.peer.until(lambda: setup.peer.node.count_publishers("bridge/engagement"), "the bridge")
    request = start("flight_cli.cli", "engage")  # before all nodes run: it waits for the first u
    setup.peer.until(lambda: request.popen.poll() is not None, "the end of the command")
    request.succeed()
    setup.peer.until(
        lambda: any(any(u.position) for u in setup.peer.received["u"]), "a u away from trim"
    )
    off = start("flight_cli.cli", "engage", "--off")
    setup.peer.until(lambda: off.popen.poll() is not None, "the end of the command")
    off.succeed()
    end_ns = time.time_ns() + 3 * NANOSECONDS  # a second beyond what is checked
    setup.peer.until(
        lambda: (y := setup.peer.last("y")) and stamp_ns(y) > end_ns,
        "three seconds without an engagement",
    )
    flight.interrupt()
    setup.peer.until(lambda: flight.popen.poll() is not None, "the end of the flight")
    assert flight.end() == 130, flight.output
    run = tmp_path / "runs" / "latest"
    summary = json.loads((run / "summary.json").read_text())
    (engagement,) = summary["engagements"]
    assert engagement["reason"] == "disengaged by request"
    tape = read_run(run).tape
    mode = tape["internals"]["mode"]
    t = tape.time("internals")
    delay = host_delays.since(begin)
    flies = t[mode == Mode.ENGAGED]
    # the timeout of an activation, reported when it has answered
    assert abs(engagement["start"] - flies[0]) < 1.0 + delay
    assert engagement["stop"] - 0.1 - delay < flies[-1] < engagement["stop"] + LATE + delay
    u = tape["u"].values
    t_u = tape.time("u")
    assert not u[t_u < flies[0]].any()  # no integral before the engagement, none 2 s after it
    assert (t_u > engagement["stop"] + 2.0).any()
    assert not u[t_u > engagement["stop"] + 2.0].any()
    assert (
        summary["notes"][0]
        == f"engaged from {engagement['start']:.1f} s to {engagement['stop']:.1f} s: disengaged "
        "by request"
    )


def test_identify_excites_autopilot_and_writes_what_flies_it(
    setup: BridgeSetup, start: Start, tmp_path: Path
) -> None:
    # Roll alone, 11 s in place of 52 s for four inputs: the other axes of Joy are NaN, which leaves
    # them at trim.
    content = yaml.safe_load(Path(setup.map).read_text())
    content |= {
        "instant": "p",
        "outputs": {"p": content["outputs"]["p"]},
        "inputs": {"aileron": content["inputs"]["aileron"]},
    }
    del content["pose"], content["topics"]["/ap/airspeed"], content["topics"]["/ap/pose/filtered"]
    Path(setup.map).write_text(yaml.safe_dump(content, sort_keys=False))
    setup.autopilot()
    options = ("--speed", "25", "--amplitude", "0.3", "--write", "found", "--json")
    # 0.3 in place of 0.2: on a busy host, whose messages are late, it found Omega within 25 % and
    # refused it.
    identify = start("flight_cli.cli", "identify", "bridge", setup.map, *options)
    setup.peer.until(lambda: setup.peer.received["bridge/would_send"], "a u through the bridge")
    setup.command(None).succeed()
    setup.peer.until(lambda: identify.popen.poll() is not None, "the end of the command")
    identify.succeed()
    identification = json.loads(identify.lines[-1])
    assert identification["inputs"] == ["aileron"]
    channels = {name: np.squeeze(values) for name, values in identification["channels"].items()}
    airframe = load_airframe("osprey")
    p = list(airframe.states).index("p")
    aileron = list(airframe.inputs).index("aileron")
    s = 0.5j / (channels["lag"] + channels["delay"])  # where a loop by the rules crosses 1
    # lag of slow_autopilot.yaml
    true = airframe.matrix_b()[p, aileron] / (s - airframe.matrix_a()[p, p]) / (0.02 * s + 1.0)
    gain = channels["Omega"] / (s + channels["damping"]) / (channels["lag"] * s + 1.0)
    # The gain of the loop, since Omega and damping alone take each other's place where messages of
    # 20 ms are late. 40 %: a loop with a phase margin of 54 degrees bears a factor of 2.
    assert abs(gain) == pytest.approx(abs(true), rel=0.4)
    (folder,) = tmp_path.rglob("found")
    check = invoke("check", folder / "map.yaml", "--scenario", folder / "scenario.yaml")
    assert check.exit_code == 0, check.output
