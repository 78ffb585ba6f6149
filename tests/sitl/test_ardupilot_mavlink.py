# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test the map `ardupilot_mavlink` against ArduPlane's MAVLink.

The tests check what the bridge releases, refuses and flies through.
"""

import re
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager
from typing import NamedTuple

import pytest
from tests.conftest import REPOSITORY
from tests.ros.conftest import Process
from tests.sitl.kit import OVERRIDE_TIME, ArduPlane

from flight_analysis.closed_loop.scenario_library import find_scenario
from flight_log.tape_reader import read_run

SCENARIO = find_scenario(str(REPOSITORY / "examples" / "arduplane" / "scenario.yaml"))
LOITERS = 5.0  # s after a release, a guard: the request goes out at once
LATE = 0.5  # s, for a busy host: a parameter passes through several processes
SERVOS = {"aileron": 1, "elevator": 2, "thrust": 3, "rudder": 4}


@pytest.fixture(scope="module")
def plane(tmp_path_factory: pytest.TempPathFactory) -> Iterator[ArduPlane]:
    """Yield an ArduPlane in flight, with servos of 0.03 s and a short timeout of overrides."""
    autopilot = ArduPlane(tmp_path_factory.mktemp("run"))
    try:
        autopilot.up(SIM_SERVO_SPEED=0.03, RC_OVERRIDE_TIME=OVERRIDE_TIME)
        autopilot.take_off()
        yield autopilot
    finally:
        autopilot.down()


def engaged(
    plane: ArduPlane, duration: float, *changes: tuple[str, str]
) -> AbstractContextManager[Process]:
    """Return a flight of the stack, engaged from level flight with the sticks in trim."""
    return plane.engaged(SCENARIO.path, plane.mavlink_map(*changes), duration)


def test_engaged_flight_over_mavlink_tracks_its_commands(plane: ArduPlane) -> None:
    """While q and p are commanded, their errors stay below y_m, as over DDS.

    The errors are from the autopilot's log, and the ticks replay.
    """
    with engaged(plane, SCENARIO.flight.duration) as flight:
        flight.succeed(SCENARIO.flight.duration + 30.0)
    (engagement,) = plane.summary()["engagements"]
    assert engagement["stop"] is None, engagement["reason"]
    errors = plane.own_errors()
    # an aircraft that does not follow has 1 or more
    assert max(errors[name][0] / errors[name][1] for name in "qp") < 0.75
    plane.start("replay", str(plane.run)).succeed(60.0)


class Trouble(NamedTuple):
    """What fails, by parameters, and a pattern of the reason.

    The pattern is empty if the bridge flies on. The time for it is in s.
    """

    parameters: Sequence[tuple[str, float]]
    reason: str
    within: float


def stuck(surface: str, pulse: float) -> tuple[tuple[str, float], ...]:
    """Return parameters of a servo that stays at a pulse, us. Its ends are 2 us apart."""
    number = SERVOS[surface]
    return tuple(
        (f"SERVO{number}_{end}", pulse + shift)
        for end, shift in (("MIN", -1), ("MAX", 1), ("TRIM", 0))
    )


TROUBLE = {
    "elevator stuck in trim": Trouble(stuck("elevator", 1480), "^(climb|theta|elevator)", 45.0),
    "elevator stuck 60 us up": Trouble(stuck("elevator", 1540), "^(climb|theta|elevator|V)", 20.0),
    "aileron stuck 100 us away": Trouble(stuck("aileron", 1600), "^phi", 5.0),
    "rudder stuck 100 us away": Trouble(stuck("rudder", 1600), "^(phi|rudder)", 40.0),
    "engine failed": Trouble((("SIM_ENGINE_FAIL", 4),), "^(V|climb|theta)", 20.0),
    "airspeed sensor at 40 m/s": Trouble((("SIM_ARSPD_FAIL", 40),), "^V", 3.0),
    "airspeed sensor at 5 m/s": Trouble((("SIM_ARSPD_FAIL", 5),), "^V", 3.0),
    "GPS lost": Trouble((("SIM_GPS1_ENABLE", 0),), "", 15.0),
    "first gyro failed": Trouble((("SIM_GYR_FAIL_MSK", 1),), "", 15.0),
    "first accelerometer failed": Trouble((("SIM_ACC_FAIL_MSK", 1),), "", 15.0),
}
HEALTHY = {
    **{
        f"SERVO{n}_{end}": pulse
        for n in SERVOS.values()
        for end, pulse in (("MIN", 1100), ("MAX", 1900), ("TRIM", 1500))
    },
    **dict.fromkeys(
        ("SIM_ENGINE_FAIL", "SIM_ARSPD_FAIL", "SIM_GYR_FAIL_MSK", "SIM_ACC_FAIL_MSK"), 0
    ),
    "SIM_GPS1_ENABLE": 1,
}


@pytest.mark.parametrize("name", TROUBLE)
def test_bridge_releases_with_the_reason_of_a_trouble_or_flies_on(
    plane: ArduPlane, name: str, record_testsuite_property: Callable[[str, object], None]
) -> None:
    """A surface that does not move, or an engine or airspeed sensor that fails, ends the flight.

    A spare sensor takes over.
    """
    trouble = TROUBLE[name]
    with ExitStack() as afterwards, engaged(plane, 100.0) as flight:
        began = time.time()
        for parameter, value in trouble.parameters:
            plane.say("param", parameter, f"{value:g}")
            afterwards.callback(plane.say, "param", parameter, f"{HEALTHY[parameter]:g}")
        deadline = began + trouble.within + 5.0
        while time.time() < deadline and "RELEASE" not in flight.output:
            time.sleep(0.2)
        if trouble.reason:
            plane.until(lambda state: state["mode"] == "LOITER", timeout=LOITERS)
        afterwards.close()
        flight.interrupt()
        flight.end()
    (engagement,) = read_run(plane.run).engagements or []
    took = (
        "flies on"
        if engagement.stop_ns is None
        else f"{engagement.stop_ns / 1e9 - began:.2f} s: {engagement.reason}"
    )
    record_testsuite_property(f"ArduPlane over MAVLink, {name}", took)
    if trouble.reason:
        assert re.search(trouble.reason, engagement.reason), took
        assert (engagement.stop_ns or 0) / 1e9 - began < trouble.within + LATE
    else:
        assert engagement.stop_ns is None, took


@contextmanager
def waiting(
    plane: ArduPlane, sentence: str = "DISENGAGED", channel_map: str = ""
) -> Iterator[Process]:
    """Yield a flight of the stack that says a sentence and waits for an engagement."""
    plane.level()
    flight = plane.fly(SCENARIO.path, channel_map or plane.mavlink_map(), 100.0, "--send")
    try:
        flight.wait_for(sentence)
        yield flight
    finally:
        flight.interrupt()
        flight.end()
        plane.level()


def require_refusal(plane: ArduPlane, reason: str) -> None:
    request = plane.requested()
    assert request.end() != 0
    assert reason in request.output


def test_engagement_in_a_climb_is_refused(plane: ArduPlane) -> None:
    with waiting(plane):
        plane.say("goto", f"{plane.state()['alt'] - plane.home + 200.0:.0f}")
        plane.until(lambda state: state["climb"] > 3.0)
        plane.hand_over()
        require_refusal(plane, "climb")
    assert plane.summary()["engagements"] == []


def test_transmitter_lost_before_an_engagement_refuses_it_by_the_mode(plane: ArduPlane) -> None:
    """ArduPilot's own failsafe leaves MANUAL, and says so in HEARTBEAT."""
    with waiting(plane):
        plane.hand_over()
        with plane.without_transmitter():
            plane.until(lambda state: state["mode"] in {"CIRCLE", "RTL"}, timeout=10.0)
            require_refusal(plane, "the mode is not MANUAL")


def test_transmitter_lost_while_engaged_is_bounded_by_max_engaged(plane: ArduPlane) -> None:
    """No field shows the loss, and the override keeps the autopilot's own failsafe off.

    The failsafe acts after the release.
    """
    bound = 20.0
    with engaged(plane, 60.0, ("max_engaged: 120.0", f"max_engaged: {bound}")) as flight:
        assert "the loss of the transmitter cannot be seen over this link" in flight.output
        with plane.without_transmitter():
            flight.wait_for("RELEASE")
            plane.until(lambda state: state["mode"] in {"CIRCLE", "RTL"}, timeout=20.0)
        flight.interrupt()
        flight.end()
    (engagement,) = plane.summary()["engagements"]
    assert engagement["reason"] == f"engaged for {bound:g} s, max_engaged of the map"


def mode_after(plane: ArduPlane, change: Callable[[], object], seconds: float) -> set[str]:
    """Return the modes of the autopilot in the seconds after a change."""
    change()
    modes = set()
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        modes.add(plane.state()["mode"])
        time.sleep(0.2)
    return modes


FAILSAFE = (("FS_GCS_ENABL", 1.0), ("FS_LONG_TIMEOUT", 5.0))
SILENT = 8.0  # s, longer than the 5 s of FS_LONG_TIMEOUT and of station_silence, and a heartbeat


@pytest.fixture
def failsafe(plane: ArduPlane) -> Iterator[None]:
    """Let the autopilot change to RTL without its ground station."""
    for parameter, value in FAILSAFE:
        plane.say("param", parameter, f"{value:g}")
    yield
    plane.say("param", "FS_GCS_ENABL", "0")


def test_rates_that_a_ground_station_takes_refuse_an_engagement_and_come_back(
    plane: ArduPlane,
) -> None:
    sentence = "would refuse: the mode is not MANUAL"
    with plane.shared_link() as link, waiting(plane, sentence, plane.shared_map()) as flight:
        plane.hand_over()
        time.sleep(3.0)  # the rates are known 2 s after the first message
        link("take")
        time.sleep(1.0)  # the count of 2 s has fallen by a third
        require_refusal(plane, " Hz, requested are 40 Hz")
        assert "set streamrate -1" in flight.output
        flight.wait_for("less than 20 s ago")  # the rate has come back
    assert plane.summary()["engagements"] == []


@pytest.mark.parametrize("repeats", [1, 20])
def test_rates_that_a_ground_station_takes_while_engaged_are_requested_again_or_end_it(
    plane: ArduPlane, repeats: int
) -> None:
    """If they are taken once, the rates come back and the flight goes on.

    If they are taken again and again, the flight ends.
    """
    with (
        plane.shared_link() as link,
        plane.engaged(SCENARIO.path, plane.shared_map(), 100.0) as flight,
    ):
        for _ in range(repeats):
            link("take")
            time.sleep(0.3)
        if repeats > 1:
            plane.until(lambda state: state["mode"] == "LOITER", timeout=LOITERS)
        else:
            time.sleep(5.0)
        flight.interrupt()
        flight.end()
    (engagement,) = plane.summary()["engagements"]
    if repeats > 1:
        assert re.search(
            "ATTITUDE comes at .* Hz, requested are 40 Hz.* for 2 s", engagement["reason"]
        )
    else:
        assert engagement["stop"] is None, engagement["reason"]


def test_cut_cable_leaves_the_last_u_for_the_timeout_of_overrides_alone(plane: ArduPlane) -> None:
    """The release cannot arrive, and the autopilot stays in MANUAL."""
    with (
        plane.shared_link() as link,
        plane.engaged(SCENARIO.path, plane.shared_map(), 100.0) as flight,
    ):
        plane.say("stick", "4", "1550")
        time.sleep(1.0)
        cut_at = time.time()
        modes = mode_after(plane, lambda: link("cut"), 4.0)
        assert re.search(r"RELEASE: .* old \(mavlink/", flight.output)
        t, pulses = plane.log("RC_CHANNELS", "chan4_raw")
        acted = t[(t > cut_at) & (pulses[:, 0] == 1550.0)][0] - cut_at
        # RC_CHANNELS comes each 0.1 s
        assert OVERRIDE_TIME - 0.1 < acted < OVERRIDE_TIME + 0.1 + LATE
        assert modes == {"MANUAL"}


def test_silent_ground_station_ends_the_engagement_and_the_aircraft_loiters(
    plane: ArduPlane, failsafe: None
) -> None:
    """The overrides hide the silence from the autopilot.

    Its failsafe acts FS_LONG_TIMEOUT after the last of them.
    """
    with (
        plane.shared_link() as link,
        plane.engaged(SCENARIO.path, plane.shared_map(), 100.0) as flight,
    ):
        link("silence")
        flight.wait_for("is silent for 5 s", SILENT)
        plane.until(lambda state: state["mode"] == "LOITER", timeout=LOITERS)
        plane.until(lambda state: state["mode"] == "RTL", timeout=SILENT)
        link("speak")
        flight.interrupt()
        flight.end()


@pytest.mark.parametrize(
    "how, mode", [("switch", "MANUAL"), ("engage --off", "MANUAL"), ("Ctrl-C", "LOITER")]
)
def test_mode_after_a_release_is_the_pilots_or_one_that_flies(
    plane: ArduPlane, how: str, mode: str
) -> None:
    with engaged(plane, 100.0) as flight:
        if how == "switch":
            plane.say("stick", "7", "1900")
        elif how == "Ctrl-C":
            flight.interrupt()
        else:
            plane.engage("--off").succeed()
        time.sleep(1.0)  # the request goes out for 0.5 s
        modes = mode_after(plane, lambda: None, 2.0)
        plane.say("stick", "7", "1500")
        assert modes == {mode}


def test_long_timeout_of_overrides_refuses_an_engagement(plane: ArduPlane) -> None:
    plane.say("param", "RC_OVERRIDE_TIME", "3")
    try:
        with waiting(plane, "would refuse: the mode is not MANUAL"):
            plane.hand_over()
            require_refusal(plane, "RC_OVERRIDE_TIME is 3, expected 0.2 to 1")
    finally:
        plane.say("param", "RC_OVERRIDE_TIME", f"{OVERRIDE_TIME:g}")
