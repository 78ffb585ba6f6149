# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test the map `ardupilot` against ArduPlane's own DDS interface and its own log over MAVLink."""

import struct
import time
from collections.abc import Callable
from contextlib import AbstractContextManager, ExitStack
from typing import NamedTuple

import numpy as np
import pytest
from tests.conftest import REPOSITORY
from tests.ros.conftest import Process
from tests.sitl.kit import (
    ALTITUDE,
    MAX_AGE,
    OWN_MAP,
    OWN_SCENARIO,
    ArduPlane,
    burn,
    guided_scenario,
)

from autopilot_bridge.params import load_map
from flight_analysis.closed_loop.scenario_library import find_scenario
from flight_analysis.metrics.time_spans import is_in_spans
from flight_analysis.report.guided import BANDS, control_errors
from flight_log.stored_messages import stored_messages
from flight_log.tape_reader import read_run

SCENARIO = find_scenario(
    OWN_SCENARIO or str(REPOSITORY / "examples" / "arduplane" / "scenario.yaml")
)
# us, where the stick of the rudder is during an engagement, so that its return to the pilot shows
MARK = 1550
RC_PERIOD = 0.1  # s, of RC_CHANNELS in the autopilot's log
# s, for a busy host: commands of the pilot and of the log pass through several processes
LATE = 0.4
RC_OVERRIDE_TIME = 3.0  # s, the autopilot's default: without a new Joy the last one acts so long


def map_of(plane: ArduPlane, *, captured: bool = True) -> str:
    """Return the map of a rehearsal as it is, or the shipped one with longer ages."""
    changes = () if captured else (("captured: true", "captured: false"),)
    return OWN_MAP or plane.patient_map("ardupilot", *changes)


def engaged(plane: ArduPlane, duration: float) -> AbstractContextManager[Process]:
    """Return a flight of the stack, engaged from level flight with the sticks in trim."""
    return plane.engaged(SCENARIO.path, map_of(plane), duration)


def test_dry_run_measures_what_autopilot_logs(plane: ArduPlane) -> None:
    """In turns and climbs, rates and pose are those of the autopilot's own log.

    The slopes are 1 within 1 %, and for V within 5 %. V is the airspeed of its estimator, and
    VFR_HUD has the one of the sensor, an equivalent airspeed. In the autopilot they differ by 3 %.
    """
    plane.level()
    channel_map = map_of(plane, captured=False)  # V before an engagement too
    flight = plane.fly(SCENARIO.path, channel_map, 45.0)
    flight.wait_for("DISENGAGED")
    plane.wander(flight)
    compared = plane.compare()
    messages = list(stored_messages(plane.run))
    tape = read_run(plane.run).tape
    t_y = tape["y"].stamp_ns / 1e9
    t, equivalent = plane.log("VFR_HUD", "airspeed")
    inside = (t > t_y[0]) & (t < t_y[-1])
    # the last field of ardupilot_msgs/msg/Airspeed is true over equivalent airspeed
    ratio = np.mean(
        [
            struct.unpack("<f", message.data[-4:])[0]
            for message in messages
            if message.topic == "/ap/airspeed"
        ]
    )
    row = load_map(channel_map).outputs["V"]
    airspeed = (np.interp(t[inside], t_y, tape["y"]["V"]).mean() - row.offset) / (
        equivalent[inside].mean() * ratio
    )
    assert {name: fit.slope for name, fit in compared.items()} == pytest.approx(
        dict.fromkeys(compared, 1.0), abs=0.01
    )
    # rad/s, rad
    assert max(abs(compared[name].offset) for name in ("p", "q", "r", "phi", "theta", "psi")) < 0.01
    # m: home and the estimator's origin
    assert max(abs(compared[name].offset) for name in ("north", "east", "altitude")) < 2.0
    # a captured V is 0 in a dry run
    assert row.captured or airspeed == pytest.approx(1.0, abs=0.05)
    assert "sample refused" not in (plane.run / "log" / "bridge.log").read_text()
    assert "/ap/joy" not in {message.topic for message in messages}, "a dry run sends nothing"


def test_an_engaged_flight_tracks_its_commands(plane: ArduPlane) -> None:
    """While q and p are commanded, their errors stay below y_m.

    Every tick of the log replays. An aircraft that does not follow has a ratio of 1 or more. Calm
    flights had 0.63 and 0.49, and with identified gains 0.43 and 0.17.
    """
    with engaged(plane, SCENARIO.flight.duration) as flight:
        flight.succeed(SCENARIO.flight.duration + 30.0)
        assert plane.state()["mode"] == "MANUAL"
    (one,) = plane.summary()["engagements"]
    tape = read_run(plane.run).tape
    y = tape["y"]
    y_m = tape["y_m"]
    t = (y.stamp_ns - tape.start_ns) / 1e9
    pulses = SCENARIO.reference_model.pulses
    assert one["start"] < min(pulse.start[0] for pulse in pulses.values()), (
        "engaged after the first command"
    )
    figures = {}
    for name in pulses.keys() & set("qp"):
        edges = zip(pulses[name].start, pulses[name].stop, strict=True)
        # elsewhere y_m is 0, and e is noise
        commanded = is_in_spans(t, [(start, stop + 1.0) for start, stop in edges])
        reference = np.interp(y.stamp_ns[commanded], y_m.stamp_ns, y_m[name])
        figures[name] = float(np.std(y[name][commanded] - reference) / np.std(reference))
    assert max(figures.values()) < 0.75
    plane.start("replay", str(plane.run)).succeed()


def test_turbulence_moves_aircraft_as_much_as_under_autopilots_own_law(plane: ArduPlane) -> None:
    """The rms of q while engaged is at most twice the one in GUIDED just before.

    It is taken from the autopilot's log, and the envelope may end the engagement. SIM_WIND_TURB 2
    moves q by 0.4 rad/s in GUIDED, which is far more than a command, so that an error would show
    the wind. The rms of 8 s differs from one time to the next. A law at its limit of stability has
    several times as much.
    """
    before = 8.0  # s in GUIDED
    with ExitStack() as afterwards:
        for name, value in (("SIM_WIND_SPD", 6.0), ("SIM_WIND_TURB", 1.0)):
            plane.say("param", name, f"{value:g}")
            afterwards.callback(plane.say, "param", name, "0")
        plane.level()
        with engaged(plane, SCENARIO.flight.duration) as flight:
            began = time.time()
            flight.succeed(SCENARIO.flight.duration + 30.0)
    (one,) = plane.summary()["engagements"]
    ended_at = began + (one["stop"] or SCENARIO.flight.duration) - one["start"]
    t, q = plane.log("ATTITUDE", "pitchspeed")
    gyro, law = (
        np.std(q[(t > start) & (t < stop)])
        for start, stop in ((began - before, began), (began, ended_at))
    )
    assert ended_at - began > before / 2.0, f"too short for an rms: {one['reason']}"
    assert law < 2.0 * gyro
    assert one["stop"] is None or "outside the envelope" in one["reason"]


@pytest.mark.parametrize(
    "turns", [1, pytest.param(10, marks=[pytest.mark.long, pytest.mark.timeout(1000)])]
)
def test_guidance_holds_heading_altitude_and_airspeed(plane: ArduPlane, turns: int) -> None:
    """The flight is engaged to its end, with a minute for each turn, climb and change of airspeed.

    All are held again after 45 s. The bands for altitude and airspeed are those in which a guided
    flight counts as settled, 5 m and 1 m/s. The gyro of the simulator drifts by up to b = 4.4
    mrad/s, which is SIM_DRIFT_SPEED 0.05 deg/s a minute for 5 minutes. So the heading is off by b g
    / (k_phi k_chi V), 2.6 deg for the bandwidth of p in the example. A settled heading may be off
    by 2 deg.
    """
    first, each = 15.0, 60.0  # s
    starts = (first + each * np.arange(turns)).tolist()
    program = plane.turns(starts, max(plane.state()["alt"] - plane.home, ALTITUDE), 24.0)
    scenario = plane.folder / "guided.yaml"
    scenario.write_text(guided_scenario(SCENARIO.path, program, 24.0))
    duration = first + each * turns
    with plane.engaged(scenario, map_of(plane), duration) as flight:
        flight.succeed(duration + 60.0)
    (one,) = plane.summary()["engagements"]
    assert one["stop"] is None, one["reason"]
    tape = read_run(plane.run).tape
    t = tape.time("guidance")
    errors = control_errors(tape)
    is_held = is_in_spans(t, [(start + 45.0, start + each) for start in starts])
    largest = {
        name: float(np.max(np.abs(errors[name][is_held]))) for name in ("heading", "altitude", "V")
    }
    bands = {name: BANDS[name] for name in largest} | {
        "heading": BANDS["heading"] + np.radians(2.6)
    }
    assert {name for name, error in largest.items() if error > bands[name]} == set(), largest
    plane.start("replay", str(plane.run)).succeed(120.0)


class Event(NamedTuple):
    """What ends an engagement, and the reason in the summary.

    The third field is when the sticks act again, s after the event.
    """

    act: Callable[[ArduPlane, Process], Callable[[], object] | None]
    reason: str
    sticks_act: tuple[float, float]
    change: tuple[str, str] | None = None  # of the text of the map


def override(plane: ArduPlane, _: Process) -> Callable[[], object]:
    plane.say("stick", "7", "1900")
    return lambda: plane.say("stick", "7", "1500")


def move_a_stick(plane: ArduPlane, _: Process) -> Callable[[], object]:
    plane.say("stick", "7", "1650")  # short of the threshold of the map's switch
    return lambda: plane.say("stick", "7", "1500")


def release(plane: ArduPlane, _: Process) -> None:
    plane.engage("--off").succeed()


def change_mode(plane: ArduPlane, _: Process) -> None:
    assert "ok" in plane.say("mode", "FBWA")


def disarm(plane: ArduPlane, _: Process) -> Callable[[], object]:
    plane.say("param", "RC6_OPTION", "81")  # ArduPilot: 81 disarms
    plane.say("stick", "6", "1900")

    def again() -> None:  # it does not arm in the air
        plane.restart()
        plane.take_off()

    return again


def kill(module: str) -> Callable[[ArduPlane, Process], None]:
    return lambda _, flight: flight.child(module).kill()


def kill_agent(plane: ArduPlane, _: Process) -> Callable[[], object]:
    return plane.kill("MicroXRCEAgent")


AT_ONCE = (-RC_PERIOD, RC_PERIOD + LATE)
AFTER_STATUS = (-RC_PERIOD, 1.5 + RC_PERIOD + LATE)  # a message of /ap/status every 0.5 s
AFTER_TIMEOUT = (0.0, MAX_AGE + RC_PERIOD + LATE)  # of u, by `silence.max_age`
# no release reaches the autopilot
AFTER_OVERRIDE_TIME = (RC_OVERRIDE_TIME - 0.5, RC_OVERRIDE_TIME + RC_PERIOD + LATE)

EVENTS = {
    "override by a switch": Event(override, "pilot override by switch", AT_ONCE),
    "override by a moved stick": Event(
        move_a_stick, "pilot override by switch", AT_ONCE, ("above: 1700.0", "moved: 100.0")
    ),
    "release": Event(release, "disengaged by request", AT_ONCE),
    "mode changed": Event(change_mode, "the mode is not MANUAL", AFTER_STATUS),
    "controller killed": Event(
        kill("rise_di_controller.main"), "controller was killed", AFTER_TIMEOUT
    ),
    "bridge killed": Event(kill("autopilot_bridge.main"), "bridge was killed", AFTER_OVERRIDE_TIME),
    "agent killed": Event(kill_agent, "s old", AFTER_OVERRIDE_TIME),
    "disarmed": Event(disarm, "the aircraft is not armed", AFTER_STATUS),
}


def test_sticks_that_bridge_overrides_do_not_show_and_do_not_act_before_release(
    plane: ArduPlane,
) -> None:
    """The autopilot shows Joy in channels 1 to 4.

    An override by one of these sticks would react to the law's own u.
    """
    with engaged(plane, 60.0) as flight:
        plane.say("stick", "4", str(MARK))
        time.sleep(2.0)
        assert plane.log("RC_CHANNELS", "chan4_raw")[1][-1, 0] != MARK
        assert "ENGAGED" in flight.output.splitlines()[-1]
        flight.interrupt()
        flight.end()


@pytest.mark.parametrize("name", EVENTS)
def test_the_pilot_has_the_aircraft_again(
    plane: ArduPlane, name: str, record_testsuite_property: Callable[[str, object], None]
) -> None:
    """The sticks act within the time of the event, and the log says why the engagement ended.

    The time of a release is measured from the release in the log, because `rise-di engage --off`
    takes half a second to start.
    """
    event = EVENTS[name]
    channel_map = (
        map_of(plane) if event.change is None else plane.patient_map("ardupilot", event.change)
    )
    with ExitStack() as afterwards, plane.engaged(SCENARIO.path, channel_map, 60.0) as flight:
        plane.say("stick", "4", str(MARK))
        began = time.time()
        if (undo := event.act(plane, flight)) is not None:
            afterwards.callback(undo)
        sticks_at = sticks_act(plane, began)
        # without one of its nodes the flight ends by itself
        if "killed" not in name or event.act is kill_agent:
            flight.interrupt()
        flight.end()
        afterwards.close()
    summary, (engagement,) = plane.summary(), read_run(plane.run).engagements or []
    if event.act is release:
        began = (engagement.stop_ns or 0) / 1e9
    record_testsuite_property(f"ArduPlane, {name}", f"{sticks_at - began:.3f}")
    assert event.sticks_act[0] <= sticks_at - began <= event.sticks_act[1]
    (one,) = summary["engagements"]
    assert event.reason in f"{one['reason']}; {summary['outcome']['sentence']}"


def sticks_act(plane: ArduPlane, since: float) -> float:
    """Return when the rudder channel begins to be where its stick is, s of the system clock.

    It must stay there for 0.5 s at least.
    """
    deadline = time.monotonic() + 10.0
    while time.monotonic() < deadline:
        plane.state()  # writes the log
        t, channels = plane.log("RC_CHANNELS", "chan4_raw")
        away = np.flatnonzero((np.abs(channels[:, 0] - MARK) > 1) & (t > since))
        last = t[away[-1]] if len(away) else since
        if t[-1] > last + 0.5:
            return float(last)
    pytest.fail("the sticks do not act")


def test_max_engaged_ends_an_engagement_without_transmitter(plane: ArduPlane) -> None:
    """No field shows the loss, and Joy keeps the autopilot's own RC failsafe off.

    The failsafe acts after the release.
    """
    bound = 20.0
    channel_map = plane.patient_map("ardupilot", ("max_engaged: 120.0", f"max_engaged: {bound}"))
    with plane.engaged(SCENARIO.path, channel_map, 60.0) as flight:
        assert "the loss of the transmitter cannot be seen over this link" in flight.output
        with plane.without_transmitter():
            flight.wait_for("max_engaged releases in 10 s")
            assert plane.state()["mode"] == "MANUAL"
            flight.wait_for("RELEASE")
            plane.until(lambda state: state["mode"] in {"CIRCLE", "RTL"}, timeout=10.0)
        flight.interrupt()
        flight.end()
    (engagement,) = plane.summary()["engagements"]
    assert engagement["reason"] == f"engaged for {bound:g} s, max_engaged of the map"
    assert engagement["stop"] - engagement["start"] == pytest.approx(bound, abs=LATE)


def test_overloaded_machine_leaves_aircraft_to_law_or_to_pilot(plane: ArduPlane) -> None:
    """With four busy processes per core for 3 s, the bridge stays engaged or says what was stale.

    A release then acts immediately.
    """
    with engaged(plane, 60.0) as flight:
        plane.say("stick", "4", str(MARK))
        for process in burn(3.0):
            process.wait()
        plane.engage("--off").succeed()
        released = time.time()
        assert sticks_act(plane, released) - released <= RC_PERIOD + LATE
        flight.interrupt()
        flight.end()
    (one,) = plane.summary()["engagements"]
    assert one["reason"] == "disengaged by request" or "s old" in one["reason"]


@pytest.mark.parametrize("what", ["agent", "autopilot"])
def test_the_stack_engages_again_after_a_restart(plane: ArduPlane, what: str) -> None:
    """The same flight of the stack goes on while the agent or the autopilot is away.

    The restarted aircraft takes off again.
    """
    with engaged(plane, 400.0) as flight:
        if what == "agent":
            again = plane.kill("MicroXRCEAgent")
            flight.wait_for("s old")
            again()
        else:
            plane.restart()
            plane.take_off()
        plane.hand_over()
        plane.until(lambda _: plane.engage().end() == 0)
        flight.interrupt()
        flight.end()
    first, _ = plane.summary()["engagements"]
    assert "s old" in first["reason"]
