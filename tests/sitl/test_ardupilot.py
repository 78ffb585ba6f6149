# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""The map `ardupilot` against ArduPlane's own DDS interface and its own log over MAVLink."""

import json
import os
import struct
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from tests.conftest import REPOSITORY
from tests.ros.conftest import Process
from tests.sitl.kit import ArduPlane

from autopilot_bridge.params import LIBRARY, load_map
from flight_bringup.scenarios import find_scenario
from flight_core.vectors import FloatArray
from flight_log.stored_messages import stored_messages
from flight_log.tape_reader import read_run

SCENARIO = find_scenario(os.environ.get("RISE_DI_SCENARIO", str(REPOSITORY / "examples" / "arduplane" / "scenario.yaml")))
OWN_MAP = os.environ.get("RISE_DI_MAP")  # of a rehearsal
MAX_AGE = 0.5  # s, in place of the map's 0.2 s, for busy hosts
MARK = 1550  # us, where the stick of the rudder is during an engagement, so that its return to the pilot shows
RC_PERIOD = 0.1  # s, of RC_CHANNELS in the autopilot's log
LATE = 0.4  # s, for a busy host: commands of the pilot and of the log pass through several processes
RC_OVERRIDE_TIME = 3.0  # s, the autopilot's default: without a new Joy the last one acts so long


def run_of(plane: ArduPlane) -> Path:
    """The folder of the last flight."""
    return (plane.folder / "runs" / "latest").resolve()


def fly(plane: ArduPlane, duration: float, *options: str, captured: bool = True) -> Process:
    """Start a flight with the map of a rehearsal as it is, or the shipped one with longer ages."""
    own = OWN_MAP or str(plane.folder / "map.yaml")
    if OWN_MAP is None:
        text = (LIBRARY / "ardupilot.yaml").read_text(encoding="utf-8").replace("max_age: 0.2 ", f"max_age: {MAX_AGE} ")
        text = text if captured else text.replace("captured: true", "captured: false")
        Path(own).write_text(text, encoding="utf-8")
    flight = ("fly", str(SCENARIO.path), "--bridge", own, "--duration", f"{duration:g}", "--runs", str(plane.folder / "runs"))
    return plane.start(*flight, *options)


@contextmanager
def engaged(plane: ArduPlane, duration: float) -> Iterator[Process]:
    """A flight of the stack, engaged from level flight with the sticks in trim. Afterwards the autopilot flies in GUIDED."""
    plane.level()
    flight = fly(plane, duration, "--send")
    try:
        flight.wait_for("DISENGAGED")
        plane.hand_over()
        plane.start("engage").succeed()
        yield flight
    finally:
        if flight.popen.poll() is None:
            flight.interrupt()
            flight.end()
        plane.level()


def summary(plane: ArduPlane) -> dict[str, Any]:
    """The summary of the last flight: its outcome, and its engagements with start, stop, reason."""
    found: dict[str, Any] = json.loads((run_of(plane) / "summary.json").read_text(encoding="utf-8"))
    return found


def slope(t: FloatArray, logged: FloatArray, t_y: FloatArray, y: FloatArray) -> float:
    """Slope of y over the autopilot's log, at the delay between both with the smallest residual.

    By orthogonal regression: the instants of both jitter, so an ordinary one, with noise in y alone, would be low.
    """
    fits = []
    for delay in np.arange(-0.3, 0.3, 0.005):
        variances, directions = np.linalg.eigh(np.cov(logged, np.interp(t + delay, t_y, y)))
        fits.append((float(variances[0]), float(directions[1, 1] / directions[0, 1])))
    return min(fits)[1]


def test_a_dry_run_measures_what_the_autopilot_logs(plane: ArduPlane) -> None:
    """In turns and climbs the slopes of q, p and r over its ATTITUDE are 1 within 1 %, and V is its airspeed within 5 %.

    V is the airspeed of its estimator, VFR_HUD that of the sensor, an equivalent one. In the autopilot they differ by 3 %.
    """
    plane.level()
    flight = fly(plane, 32.0, captured=False)  # V before an engagement too
    flight.wait_for("DISENGAGED")
    heading = 0.0
    while flight.popen.poll() is None:
        heading += 140.0
        plane.say("goto", f"{100.0 + heading % 100.0:.0f}", f"{heading % 360.0:.0f}")
        plane.until(lambda state: abs(state["roll"]) > 0.5)  # rad, in the turn
        plane.until(lambda state: abs(state["roll"]) < 0.1)  # rad, out of it
    flight.succeed()
    messages = list(stored_messages(run_of(plane)))
    y = read_run(run_of(plane)).tape["y"]
    t_y = y.stamp_ns / 1e9
    t, rates = plane.log("ATTITUDE", "rollspeed", "pitchspeed", "yawspeed")
    inside = (t > t_y[0] + 0.5) & (t < t_y[-1] - 0.5)
    slopes = {name: slope(t[inside], logged, t_y, y[name]) for name, logged in zip("pqr", rates[inside].T, strict=True)}
    t, equivalent = plane.log("VFR_HUD", "airspeed")
    inside = (t > t_y[0]) & (t < t_y[-1])
    # the last field of ardupilot_msgs/msg/Airspeed is true over equivalent airspeed
    ratio = np.mean([struct.unpack("<f", one.data[-4:])[0] for one in messages if one.topic == "/ap/airspeed"])
    row = load_map(OWN_MAP or str(plane.folder / "map.yaml")).outputs["V"]
    airspeed = (np.interp(t[inside], t_y, y["V"]).mean() - row.offset) / (equivalent[inside].mean() * ratio)
    assert slopes == pytest.approx(dict.fromkeys("pqr", 1.0), abs=0.01)
    assert row.captured or airspeed == pytest.approx(1.0, abs=0.05)  # a captured V is 0 in a dry run
    assert "sample refused" not in (run_of(plane) / "log" / "bridge.log").read_text(encoding="utf-8")
    assert "/ap/joy" not in {one.topic for one in messages}, "a dry run sends nothing"


def test_an_engaged_flight_tracks_its_commands(plane: ArduPlane) -> None:
    """The errors of q and p stay below what y_m commands, and every tick of the log replays.

    An aircraft that does not follow has a ratio of 1 or more. On two busy cores a calm flight had 0.62 and 0.48.
    """
    with engaged(plane, SCENARIO.flight.duration) as flight:
        flight.succeed(SCENARIO.flight.duration + 30.0)
        assert plane.state()["mode"] == "MANUAL"
    (one,) = summary(plane)["engagements"]
    tape = read_run(run_of(plane)).tape
    y, y_m = tape["y"], tape["y_m"]
    t = (y.stamp_ns - tape.start_ns) / 1e9
    pulses = SCENARIO.reference_model.pulses.values()
    first, last = min(pulse.start[0] for pulse in pulses), max(pulse.stop[-1] for pulse in pulses)
    assert one["start"] < first, "engaged after the first command"
    commanded = (t > first) & (t < last)
    figures = {}
    for name in "qp":
        reference = np.interp(y.stamp_ns[commanded], y_m.stamp_ns, y_m[name])
        figures[name] = float(np.std(y[name][commanded] - reference) / np.std(reference))
    assert max(figures.values()) < 0.75
    plane.start("replay", str(run_of(plane))).succeed()


class Event(NamedTuple):
    """What ends an engagement, the reason in the summary, and when the sticks act again, s after the event."""

    act: Callable[[ArduPlane, Process], Callable[[], object] | None]
    reason: str
    sticks_act: tuple[float, float]


def override(plane: ArduPlane, _: Process) -> Callable[[], object]:
    plane.say("stick", "7", "1900")
    return lambda: plane.say("stick", "7", "1500")


def release(plane: ArduPlane, _: Process) -> None:
    plane.start("engage", "--off").succeed()


def change_mode(plane: ArduPlane, _: Process) -> None:
    assert "ok" in plane.say("mode", "FBWA")


def kill(module: str) -> Callable[[ArduPlane, Process], None]:
    return lambda _, flight: flight.child(module).kill()


AT_ONCE = (-RC_PERIOD, RC_PERIOD + LATE)
AFTER_STATUS = (-RC_PERIOD, 1.5 + RC_PERIOD + LATE)  # a message of /ap/status every 0.5 s
AFTER_OVERRIDE_TIME = (RC_OVERRIDE_TIME - 0.5, RC_OVERRIDE_TIME + RC_PERIOD + LATE)  # no release reaches the autopilot

EVENTS = {
    "override by a switch": Event(override, "pilot override by switch", AT_ONCE),
    "release": Event(release, "disengaged by request", AT_ONCE),
    "mode changed": Event(change_mode, "the mode is not MANUAL", AFTER_STATUS),
    "bridge killed": Event(kill("autopilot_bridge.main"), "bridge was killed", AFTER_OVERRIDE_TIME),
}


@pytest.mark.parametrize("name", EVENTS)
def test_the_pilot_has_the_aircraft_again(plane: ArduPlane, name: str) -> None:
    """Within the time of the event the sticks act, and the log says why the engagement ended."""
    event = EVENTS[name]
    with ExitStack() as afterwards, engaged(plane, 60.0) as flight:
        plane.say("stick", "4", str(MARK))
        if (undo := event.act(plane, flight)) is not None:
            afterwards.callback(undo)
        until_sticks = sticks_act(plane, since=time.time())
        if "killed" not in name:  # without one of its nodes the flight ends by itself
            flight.interrupt()
        flight.end()
        afterwards.close()
    assert event.sticks_act[0] <= until_sticks <= event.sticks_act[1]
    flown = summary(plane)
    (one,) = flown["engagements"]
    assert event.reason in f"{one['reason']}; {flown['outcome']}"


def sticks_act(plane: ArduPlane, since: float) -> float:
    """Seconds until the rudder channel is where its stick is, and stays there for 0.5 s."""
    deadline = time.monotonic() + 10.0
    while time.monotonic() < deadline:
        plane.state()  # writes the log
        t, channels = plane.log("RC_CHANNELS", "chan4_raw")
        away = np.flatnonzero((np.abs(channels[:, 0] - MARK) > 1) & (t > since))
        last = t[away[-1]] if len(away) else since
        if t[-1] > last + 0.5:
            return float(last - since)
    pytest.fail("the sticks do not act")
