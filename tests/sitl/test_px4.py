# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test the map of `examples/px4_airplane` against PX4's own uXRCE-DDS client.

The tests change to offboard, and back to a mode of PX4 itself.
"""

import time
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager, ExitStack
from types import MappingProxyType
from typing import NamedTuple

import pytest
from tests.conftest import REPOSITORY
from tests.ros.conftest import Process
from tests.sitl.kit import HOLD, MAX_AGE, OFFBOARD, OWN_MAP, OWN_SCENARIO, Px4, burn, followed

from flight_analysis.closed_loop.scenario_library import find_scenario
from flight_log.tape_reader import read_run

EXAMPLE = REPOSITORY / "examples" / "px4_airplane"
SCENARIO = find_scenario(OWN_SCENARIO or str(EXAMPLE / "scenario.yaml"))
LATE = 0.4  # s, for a busy host: commands and questions start processes
OWN_LAW = 0.6  # s, from the event to a mode of PX4's own, where the bridge asks for it
LOSS = "COM_OF_LOSS_T"  # s: after the last heartbeat, where no request for a mode arrives
SHORT_LOSS = 0.3  # s: three heartbeats


def engaged(px4: Px4, duration: float) -> AbstractContextManager[Process]:
    """Return a flight of the stack, engaged from Hold, straight ahead."""
    return px4.engaged(
        SCENARIO.path, OWN_MAP or px4.patient_map(str(EXAMPLE / "map.yaml")), duration
    )


def test_engaged_flight_tracks_commands_in_offboard(px4: Px4) -> None:
    """The part of y that follows y_m has half to one and a half of its size.

    Thrust is not at its limits, and the ticks replay. The noise of the gyro is larger than the
    commands: it has an rms of 50 mrad/s in q and 104 in p, also in Hold. The part is uncertain by
    0.1. In a flight it was 1.04 in q, 0.93 in p, and 0.83 in V, 0.25 s after y_m.
    """
    with engaged(px4, SCENARIO.flight.duration) as flight:
        assert px4.state()["nav_state"] == OFFBOARD
        flight.succeed(SCENARIO.flight.duration + 30.0)
        px4.until(lambda state: state["nav_state"] == HOLD, timeout=OWN_LAW + LATE)
    summary = px4.summary()
    (one,) = summary["engagements"]  # to the end of the flight
    tape = read_run(px4.run).tape
    first = min(pulse.start[0] for pulse in SCENARIO.reference_model.pulses.values())
    assert one["start"] < first, "engaged after the first command"
    for name, pulse in SCENARIO.reference_model.pulses.items():
        assert 0.5 < followed(tape, name, pulse.start[0], pulse.stop[-1] + 1.0) < 1.5, name
    assert summary["inputs"]["thrust"]["limited"]["magnitude"] < 0.05  # of the time at its limits
    px4.start("replay", str(px4.run)).succeed()


class Event(NamedTuple):
    """What ends an engagement, and the reason in the summary.

    The third field is the time until a mode of PX4 itself flies, s.
    """

    act: Callable[[Px4, Process], Callable[[], object] | None]
    reason: str
    own_law: float | str  # s, or a parameter of PX4
    parameters: Mapping[str, float] = MappingProxyType({})


def release(px4: Px4, _: Process) -> None:
    px4.engage("--off").succeed()


def override(px4: Px4, _: Process) -> Callable[[], object]:
    """Move the stick to aux1 = 1 from 2 s on."""
    px4.say("param", "set", "COM_RC_IN_MODE", "1")
    stick = px4.tool("stick", "6", "2").wait_for("aux1 sent")

    def undo() -> None:
        stick.end()
        px4.say("param", "set", "COM_RC_IN_MODE", "4")

    return undo


def change_mode(px4: Px4, _: Process) -> None:
    px4.say("commander", "mode", "auto:loiter")


def kill(module: str) -> Callable[[Px4, Process], None]:
    return lambda _, flight: flight.child(module).kill()


def kill_agent(px4: Px4, _: Process) -> Callable[[], object]:
    return px4.kill("MicroXRCEAgent")


def disarm(px4: Px4, _: Process) -> Callable[[], object]:
    px4.say("commander", "disarm", "-f")

    def again() -> None:  # its motor is off: it begins on the ground again
        px4.restart()
        px4.take_off()

    return again


EVENTS = {
    "release": Event(release, "disengaged by request", OWN_LAW),
    "override by the stick": Event(override, "pilot override by pilot", OWN_LAW),
    "mode changed": Event(change_mode, "the mode is not offboard", OWN_LAW),
    "controller killed": Event(
        kill("rise_di_controller.main"), "controller was killed", MAX_AGE + OWN_LAW
    ),
    "bridge killed": Event(kill("autopilot_bridge.main"), "bridge was killed", LOSS),
    "bridge killed, short timeout": Event(
        kill("autopilot_bridge.main"), "bridge was killed", LOSS, {LOSS: SHORT_LOSS}
    ),
    "agent killed": Event(kill_agent, "s old", LOSS),
    "disarmed": Event(disarm, "the aircraft is not armed", OWN_LAW),
}


@pytest.mark.parametrize("name", EVENTS)
def test_px4_flies_by_its_own_law_again(
    px4: Px4, name: str, record_testsuite_property: Callable[[str, object], None]
) -> None:
    """Within the time of the event, PX4 leaves offboard or is disarmed.

    The log says why the engagement ended. The time of a release or an override is measured from the
    bridge's release in the log, because their commands take longer to start.
    """
    event = EVENTS[name]
    with ExitStack() as afterwards, engaged(px4, 90.0) as flight:
        for parameter, value in event.parameters.items():
            afterwards.callback(px4.say, "param", "set", parameter, f"{px4.parameter(parameter):g}")
            px4.say("param", "set", parameter, f"{value:g}")
        limit = px4.parameter(event.own_law) if isinstance(event.own_law, str) else event.own_law
        began = time.time()
        if (undo := event.act(px4, flight)) is not None:
            afterwards.callback(undo)
        px4.until(lambda state: state["nav_state"] != OFFBOARD, timeout=10.0)
        changed_at = px4.mode_changed() + time.time() - time.monotonic()
        # without one of its nodes the flight ends by itself
        if "killed" not in name or event.act is kill_agent:
            flight.wait_for("RELEASE").interrupt()
        flight.end()
        afterwards.close()
    summary, (engagement,) = px4.summary(), read_run(px4.run).engagements or []
    if event.act in (release, override):
        began = (engagement.stop_ns or 0) / 1e9
    record_testsuite_property(f"PX4, {name}", f"{changed_at - began:.3f}")
    assert changed_at - began <= limit + LATE
    (one,) = summary["engagements"]
    assert event.reason in f"{one['reason']}; {summary['outcome']['sentence']}"


def test_lost_transmitter_releases_within_a_second(
    px4: Px4, record_testsuite_property: Callable[[str, object], None]
) -> None:
    """PX4 would fly on in offboard, because COM_RCL_EXCEPT of the kit has the bit of offboard."""
    px4.say("param", "set", "COM_RC_IN_MODE", "1")
    stick = px4.tool("stick", "600", "600")
    try:
        channel_map = OWN_MAP or px4.patient_map(str(EXAMPLE / "map.yaml"))
        with px4.engaged(SCENARIO.path, channel_map, 90.0, transmitter=True) as flight:
            stick.popen.kill()
            lost_at = time.time()
            px4.until(lambda state: state["nav_state"] != OFFBOARD, timeout=10.0)
            flight.wait_for("RELEASE").interrupt()
            flight.end()
    finally:
        stick.popen.kill()
        px4.say("param", "set", "COM_RC_IN_MODE", "4")
    (engagement,) = read_run(px4.run).engagements or []
    released = (engagement.stop_ns or 0) / 1e9 - lost_at
    record_testsuite_property("PX4, transmitter lost", f"{released:.3f}")
    assert released <= 1.0
    assert "transmitter" in (engagement.reason or "")


def test_overloaded_machine_leaves_airplane_to_law_or_to_px4(px4: Px4) -> None:
    """With four busy processes per core for 3 s, the bridge stays engaged or says what was stale.

    PX4 flies in Hold then.
    """
    with engaged(px4, 60.0) as flight:
        for process in burn(3.0):
            process.wait()
        px4.engage("--off").succeed()
        px4.until(lambda state: state["nav_state"] == HOLD, timeout=OWN_LAW + LATE)
        flight.interrupt()
        flight.end()
    (one,) = px4.summary()["engagements"]
    assert (
        one["reason"] in {"disengaged by request", "the mode is not offboard (nav_state is 4)"}
        or "s old" in one["reason"]
    )


@pytest.mark.parametrize("what", ["agent", "autopilot"])
def test_the_stack_engages_again_after_a_restart(px4: Px4, what: str) -> None:
    """The same flight of the stack goes on.

    PX4's client connects again if it has noticed that the agent was away.
    """
    with engaged(px4, 400.0) as flight:
        if what == "agent":
            again = px4.kill("MicroXRCEAgent")
            flight.wait_for("s old")
            px4.until(lambda _: "disconnected" in px4.say("uxrce_dds_client", "status"))
            again()
        else:
            px4.restart()
            flight.wait_for("s old")
            px4.take_off()
            px4.level()
        px4.until(lambda _: px4.engage().end() == 0)
        flight.interrupt()
        flight.end()
    first, _ = px4.summary()["engagements"]
    assert "s old" in first["reason"]
