# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test the bridge without ROS: engagement, failsafe, pilot override, saturation, stamps.

The tests set the time.
"""

import signal
import time
from collections.abc import Callable
from contextlib import nullcontext, suppress
from types import SimpleNamespace
from typing import TYPE_CHECKING, cast

import numpy as np
import pytest
from pytest import approx
from tests.maps import MAP_FILES, named_map

from autopilot_bridge.bridge import Bridge, Phase, trim_key
from autopilot_bridge.channel_map import to_raw
from autopilot_bridge.params import ChannelMap, load_map
from flight_analysis.closed_loop.scenario_library import find_scenario
from flight_bringup import fly as flying
from flight_bringup.fly import _follow_real_time, _Span, run_to_end
from flight_bringup.interrupt import DeferredInterrupt, handle_signals, interrupt
from flight_bringup.processes import FIRST_U
from flight_core.outcome import Outcome, Refusal, ended_early
from flight_core.rates import nanoseconds
from flight_core.vectors import ChannelError, FloatArray, StampedVector

if TYPE_CHECKING:
    from flight_bringup.monitor import FlightMonitor
    from flight_bringup.processes import FlightProcesses

CHANNEL_MAP = named_map("ardupilot_2024")
OUTPUTS = tuple(CHANNEL_MAP.outputs)


def at(t: float) -> int:
    return nanoseconds(1000.0 + t)


def receive_outputs(
    bridge: Bridge, t: float, names: tuple[str, ...] = OUTPUTS, raw: float = 0.0
) -> None:
    for name in names:
        bridge.take_output(name, raw, at(t), at(t))


def receive_u(bridge: Bridge, t: float, u: float = 0.0, sender: str = "controller") -> None:
    """Take a u as the receiver of the node does."""
    bridge.u_lock.check(sender, at(t))
    bridge.take_u(StampedVector(at(t), np.full(4, u), sender), at(t))
    bridge.u_lock.refresh(sender, at(t))


def unlimited(name: str) -> ChannelMap:
    """Return a map of the library without its limits of the pose."""
    return load_map(name).model_copy(update={"envelope": {}, "engage_if": {}})


def new_bridge(channel_map: ChannelMap = CHANNEL_MAP, *, dry_run: bool = False) -> Bridge:
    return Bridge(channel_map, dry_run=dry_run)


def ready_bridge(
    u: float = 0.0, *, channel_map: ChannelMap = CHANNEL_MAP, dry_run: bool = False
) -> Bridge:
    """Return a bridge that has received y and u at t = 0."""
    bridge = new_bridge(channel_map, dry_run=dry_run)
    receive_outputs(bridge, 0.0)
    receive_u(bridge, 0.0, u)
    return bridge


def engage(bridge: Bridge, t: float = 0.0, *, blind: bool = False) -> None:
    assert bridge.engage(at(t), blind=blind) is None


def engaged_bridge(channel_map: ChannelMap = CHANNEL_MAP) -> Bridge:
    bridge = ready_bridge(channel_map=channel_map)
    engage(bridge)
    return bridge


def with_silence(neutral: float, release: float) -> ChannelMap:
    content = CHANNEL_MAP.model_dump()
    content["silence"] = {"max_age": 0.2, "neutral": neutral, "release": release}
    return ChannelMap.validate_mapping(content, "map")


def test_only_service_engages_and_only_with_fresh_y_and_u() -> None:
    bridge = new_bridge()
    for reason, receive in (
        ("q, p, r not received yet", receive_outputs),
        ("u not received yet", receive_u),
    ):
        assert reason in str(bridge.engage(at(0.0)))
        assert bridge.step(at(0.0)) is Phase.DISENGAGED
        receive(bridge, 0.0)
    assert bridge.step(at(0.0)) is Phase.DISENGAGED
    engage(bridge)
    assert bridge.step(at(0.0)) is Phase.ENGAGED


def test_engagement_with_stale_inputs_refused_with_reason() -> None:
    bridge = new_bridge()
    receive_outputs(bridge, 0.0)
    receive_u(bridge, 0.3)
    assert str(bridge.engage(at(0.3))).startswith("q, p, r are 0.30 s old (/ap/twist/filtered)")
    receive_outputs(bridge, 0.6)
    assert str(bridge.engage(at(0.6))) == "u is 0.30 s old"


def test_dry_run_computes_but_never_sends_or_engages() -> None:
    bridge = ready_bridge(0.1, dry_run=True)
    assert str(bridge.engage(at(0.0))).startswith("dry_run")
    assert not bridge.is_sent("joy", at(0.0))
    assert bridge.raw_u()[0] == approx(0.1 / 0.523599)


def test_dry_run_says_what_else_would_refuse_engagement() -> None:
    bridge = new_bridge(dry_run=True)
    receive_outputs(bridge, 0.0)
    assert (
        str(bridge.reason_against_engagement(at(0.0)))
        == "dry_run is true: nothing is sent; u not received yet"
    )
    receive_u(bridge, 0.0)
    assert str(bridge.reason_against_engagement(at(0.0))) == "dry_run is true: nothing is sent"


def test_engagement_with_u_away_from_trim_refused() -> None:
    bridge = ready_bridge(0.05)  # above a tenth of 0.26 rad
    assert str(bridge.engage(at(0.0))).startswith("u.elevator is 0.05 from trim")


def test_u_stays_inside_its_limits_around_trim() -> None:
    bridge = engaged_bridge()
    for u, limit in ((9.0, "upper"), (-9.0, "lower")):
        receive_u(bridge, 0.01, u)
        rows = CHANNEL_MAP.inputs.values()
        assert bridge.raw() == approx(
            [to_raw(row.trim + getattr(row, limit), row.conversion) for row in rows]
        )


def test_timeout_of_u_sends_neutral_then_release_values_then_nothing() -> None:
    bridge = engaged_bridge(with_silence(neutral=0.3, release=0.5))
    phases = []
    for t in np.arange(0.0, 1.2, 0.01).tolist():
        receive_outputs(bridge, t + 1e-3)
        phases.append((bridge.step(at(t + 1e-3)), t, bridge.raw(), bridge.is_sent("joy", at(t))))
    expected = {Phase.ENGAGED: 0.0, Phase.NEUTRAL: 0.2, Phase.RELEASE: 0.5, Phase.DISENGAGED: 1.0}
    starts = {phase: next(t for reached, t, *_ in phases if reached is phase) for phase in expected}
    assert starts == approx(expected, abs=0.011)  # a tick
    for phase, _, raw, sent in phases:
        assert sent == (phase is not Phase.DISENGAGED)
        if phase is Phase.NEUTRAL:
            assert raw.tolist() == [0.0, 0.0, 0.0, 0.0]
        if phase is Phase.RELEASE:
            assert np.isnan(raw).all()
    assert str(bridge.reason) == "u is 0.20 s old"


def test_bridge_does_not_re_engage_by_itself() -> None:
    bridge = engaged_bridge(with_silence(neutral=1.0, release=1.0))
    receive_outputs(bridge, 0.3)
    assert bridge.step(at(0.3)) is Phase.NEUTRAL
    receive_u(bridge, 0.31)
    assert bridge.step(at(0.32)) is Phase.NEUTRAL
    engage(bridge, 0.33)  # a request re-engages at any time
    assert bridge.step(at(0.33)) is Phase.ENGAGED


def test_a_timeout_of_y_releases_the_channels() -> None:
    bridge = engaged_bridge()
    receive_u(bridge, 0.25)
    assert bridge.step(at(0.25)) is Phase.RELEASE
    assert str(bridge.reason).startswith("q, p, r are 0.25 s old")
    assert bridge.step(at(0.76)) is Phase.DISENGAGED


def test_pilot_override_disengages_at_once_and_blocks_engagement() -> None:
    bridge = engaged_bridge()
    bridge.take_override("gamepad", 0.0, at(0.01))
    assert bridge.step(at(0.01)) is Phase.ENGAGED
    bridge.take_override("gamepad", 1.0, at(0.02))
    assert bridge.phase is Phase.RELEASE
    assert str(bridge.engage(at(0.03))) == "pilot override active: gamepad"
    bridge.take_override("gamepad", 0.0, at(0.04))
    engage(bridge, 0.05)


def test_times_of_zero_skip_neutral_and_release_values() -> None:
    bridge = engaged_bridge(with_silence(neutral=0.0, release=0.0))
    receive_outputs(bridge, 0.3)
    assert bridge.step(at(0.3)) is Phase.DISENGAGED


def test_conflicting_publisher_of_u_refused_until_first_one_times_out() -> None:
    bridge = new_bridge()
    receive_u(bridge, 0.0)
    with pytest.raises(
        ChannelError,
        match="conflicting publisher second ignored: already receiving from controller",
    ):
        receive_u(bridge, 0.1, sender="second")
    receive_u(bridge, 0.3, sender="second")


def test_while_engaged_no_other_publisher_of_u_takes_over_and_timeout_releases() -> None:
    # A hot standby: its u may be anywhere, and would move all surfaces at once.
    bridge = engaged_bridge()
    receive_outputs(bridge, 0.21)
    for sender in ("standby", "controller#2"):
        with pytest.raises(ChannelError, match="conflicting publisher"):
            receive_u(bridge, 0.21, 0.2, sender=sender)
    assert bridge.step(at(0.21)) is Phase.RELEASE
    assert str(bridge.reason) == "u is 0.21 s old"
    receive_u(bridge, 0.22, sender="standby")


def test_second_publisher_of_topic_of_autopilot_ends_engagement_and_blocks_another() -> None:
    bridge = engaged_bridge()
    bridge.conflict = Refusal("/ap/twist/filtered has 2 publishers")
    assert bridge.step(at(0.01)) is Phase.RELEASE
    assert bridge.reason == bridge.engage(at(0.02)) == bridge.conflict
    bridge.conflict = None
    engage(bridge, 0.03)


def test_engagement_says_which_pilot_override_has_no_effect() -> None:
    bridge = engaged_bridge()
    silent = "a pilot override has no effect: no message on /joy for 1 s; "
    assert str(bridge.reason).startswith(silent)
    for t, received in ((0.1, True), (1.2, False)):
        if received:
            bridge.take_override("gamepad", 0.0, at(t))
        receive_outputs(bridge, t)
        receive_u(bridge, t)
        assert bridge.step(at(t)) is Phase.ENGAGED
        assert str(bridge.reason).startswith(silent) is not received


def test_y_returned_once_per_rate_sample_and_only_while_all_channels_are_fresh() -> None:
    bridge = new_bridge()
    bridge.take_output("q", 0.5, at(0.0), at(0.01))
    assert bridge.y(at(0.01)) is None
    receive_outputs(bridge, 0.02)
    receive_outputs(bridge, 0.03, ("q",), 0.5)
    sample = bridge.y(at(0.03))
    assert sample is not None
    assert sample.stamp_ns == at(0.03)
    assert sample.value.tolist() == [-0.5, -25.0, 0.0, 0.0]
    assert bridge.y(at(0.04)) is None
    receive_outputs(bridge, 0.25, ("q",), 0.5)  # the others are 0.23 s old, above 0.2 s
    assert bridge.y(at(0.25)) is None


def test_held_channel_of_vane_is_repeated_and_ends_no_y() -> None:
    content = CHANNEL_MAP.model_dump()
    vane = content["outputs"]["q"] | {"held": True, "field": "twist.linear.y"}
    channel_map = ChannelMap.validate_mapping(
        content | {"outputs": content["outputs"] | {"alpha": vane}}, "map"
    )
    bridge = new_bridge(channel_map)
    receive_outputs(bridge, 0.0)
    assert bridge.y(at(0.0)) is None  # never received
    bridge.take_output("alpha", 0.1, at(0.0), at(0.0))
    for t in (0.0, 10.0):
        receive_outputs(bridge, t + 0.1)
        y = bridge.y(at(t + 0.1))
        assert y is not None
        assert abs(y.value[-1]) == approx(0.1)


def test_low_pass_answers_step_as_first_order_does_at_any_spacing_of_samples() -> None:
    content = CHANNEL_MAP.model_dump()
    content["outputs"]["q"]["low_pass"] = 0.05
    bridge = new_bridge(ChannelMap.validate_mapping(content, "map"))
    receive_outputs(bridge, 0.0)
    for t in (0.001, 0.02, 0.05, 0.1):
        receive_outputs(bridge, t, raw=1.0)
        sample = bridge.y(at(t))
        assert sample is not None
        # The row of q has sign -1, that of p no filter.
        step = np.abs(sample.value[[OUTPUTS.index("q"), OUTPUTS.index("p")]])
        assert step == approx([1.0 - np.exp(-t / 0.05), 1.0])


@pytest.mark.parametrize("name", MAP_FILES)
def test_stamps_of_autopilot_bounded_both_ways(name: str) -> None:
    channel_map = named_map(name)
    sources = {trim_key(name): row for name, row in channel_map.trims.items()}
    for key, row in (channel_map.outputs | channel_map.pose | sources).items():
        bridge = new_bridge(channel_map)
        limit = row.max_age
        for offset in (-10.0, -1.01 * limit, -0.99 * limit, 0.0, 0.99 * limit, 1.01 * limit, 10.0):
            side = "before" if offset < 0.0 else "after"
            expected = f"{key} is stamped {abs(offset):.3f} s {side} now"
            with (
                nullcontext()
                if abs(offset) <= limit
                else pytest.raises(ChannelError, match=expected)
            ):
                bridge.take_output(key, 0.0, at(offset), at(0.0))


def test_stamps_of_another_clock_and_samples_out_of_order_refused() -> None:
    content = CHANNEL_MAP.model_dump()
    content["outputs"]["q"]["stamp"] = "header"
    bridge = new_bridge(ChannelMap.validate_mapping(content, "map"))
    with pytest.raises(ChannelError, match="stamp: arrival") as error:
        bridge.take_output("q", 0.0, nanoseconds(12.0), at(0.0))  # time since boot
    assert error.value.reason == "stamp"
    bridge.take_output("q", 0.0, at(0.0), at(0.0))
    with pytest.raises(ChannelError, match="before the last one"):
        bridge.take_output("q", 0.0, at(0.0), at(0.01))


# Armed, in Hold, with a transmitter.
PX4_STATUS = {"armed": 2.0, "offboard": 4.0, "transmitter": 1.0}


def px4_bridge(t: float = 0.0, **status: float) -> Bridge:
    """Return a bridge with the map of PX4 in Hold that has received y and u."""
    bridge = new_bridge(unlimited("px4"))
    refresh(bridge, t, **status)
    return bridge


def refresh(bridge: Bridge, t: float, **status: float) -> None:
    """Send a new y, u and conditions."""
    receive_outputs(bridge, t, tuple(bridge.outputs), 20.0 if t == 0.0 else 21.0)
    receive_u(bridge, t)
    for name, raw in (PX4_STATUS | status).items():
        bridge.take_condition(name, raw, at(t))


def sent(bridge: Bridge, t: float) -> set[str]:
    return {name for name in bridge.channel_map.messages if bridge.is_sent(name, at(t))}


@pytest.mark.parametrize("lost", ["the mode is not offboard", "two autopilots"])
def test_neutral_values_end_with_lost_condition_or_conflicting_publisher(lost: str) -> None:
    content = unlimited("px4").model_dump()
    content["silence"] = {"max_age": 0.2, "neutral": 5.0, "release": 0.5}
    bridge = new_bridge(ChannelMap.validate_mapping(content, "map"))
    refresh(bridge, 0.0, offboard=14.0)
    engage(bridge)
    receive_outputs(bridge, 0.25, tuple(bridge.outputs), 21.0)
    assert bridge.step(at(0.25)) is Phase.NEUTRAL
    assert bridge.step(at(0.5)) is Phase.NEUTRAL
    if lost == "two autopilots":
        bridge.conflict = Refusal(lost)
    else:
        bridge.take_condition("offboard", 4.0, at(0.5))
    assert bridge.step(at(0.51)) is Phase.RELEASE
    assert lost in str(bridge.reason)


def test_engagement_requests_mode_sends_setpoints_in_it_and_requests_hold_after_it() -> None:
    bridge = px4_bridge()
    # No heartbeat comes before the request: without heartbeats PX4 leaves offboard.
    assert sent(bridge, 0.0) == set()
    engage(bridge)
    assert bridge.phase is Phase.ENGAGING
    assert str(bridge.reason) == "the mode is not offboard (nav_state is 4)"
    assert sent(bridge, 0.0) == {"offboard", "enter"}  # no setpoint beside those of PX4's own law
    refresh(bridge, 0.1, offboard=14.0)
    assert bridge.step(at(0.1)) is Phase.ENGAGED
    assert sent(bridge, 0.1) == {"offboard", "torque", "thrust"}
    bridge.disengage(Refusal("disengaged by request"), at(0.2))
    assert sent(bridge, 0.2) == {"leave"}  # heartbeats and setpoints end at once
    bridge.take_condition("offboard", 4.0, at(0.3))
    assert sent(bridge, 0.3) == set()  # the mode that the pilot chose stays
    assert bridge.step(at(0.71)) is Phase.DISENGAGED


def test_engagement_without_awaited_mode_ends_after_time_with_reason() -> None:
    bridge = px4_bridge()
    engage(bridge)
    refresh(bridge, 4.9)
    assert bridge.step(at(4.9)) is Phase.ENGAGING
    refresh(bridge, 5.1)
    assert bridge.step(at(5.1)) is Phase.RELEASE
    assert str(bridge.reason) == "the mode is not offboard (nav_state is 4), after 5 s"
    assert sent(bridge, 5.1) == set()


def test_engagement_refused_with_sentence_of_condition() -> None:
    bridge = new_bridge(unlimited("px4"))
    refused = (
        "armed: arming_state not received yet (/fmu/out/vehicle_status_v1); transmitter: "
        "valid not received yet"
    )
    assert str(bridge.engage(at(0.0))).startswith(refused)
    assert bridge.phase is Phase.DISENGAGED


@pytest.mark.parametrize(
    "status, reason",
    [
        ({"armed": 1.0}, "the aircraft is not armed (arming_state is 1)"),
        ({"offboard": 5.0}, "the mode is not offboard (nav_state is 5)"),
    ],
)
def test_lost_condition_ends_engagement_with_sentence(
    status: dict[str, float], reason: str
) -> None:
    bridge = px4_bridge(offboard=14.0)
    engage(bridge)
    assert bridge.phase is Phase.ENGAGED
    refresh(bridge, 0.1, **({"offboard": 14.0} | status))
    assert bridge.step(at(0.1)) is Phase.RELEASE
    assert str(bridge.reason) == reason


def test_condition_that_is_not_reported_any_more_ends_engagement() -> None:
    bridge = px4_bridge(offboard=14.0)
    engage(bridge)
    for t in np.arange(0.1, 1.7, 0.1).tolist():
        receive_outputs(bridge, t, tuple(bridge.outputs))
        receive_u(bridge, t)
        bridge.take_condition("transmitter", 1.0, at(t))
        assert (bridge.step(at(t)) is Phase.ENGAGED) == (t < 1.55), t
    assert str(bridge.reason).startswith("armed: arming_state is 1.60 s old")


def fly(bridge: Bridge, begin: float, end: float, **status: float) -> Phase:
    """Send inputs ten times a second, and return the phase at the end.

    A status of NaN is not received.
    """
    for t in np.arange(begin, end, 0.1).tolist():
        receive_outputs(bridge, t, tuple(bridge.outputs), 20.0)
        receive_u(bridge, t)
        for name, raw in (PX4_STATUS | {"offboard": 14.0} | status).items():
            if name in bridge.channel_map.conditions and not np.isnan(raw):
                bridge.take_condition(name, raw, at(t))
        bridge.step(at(t))
    return bridge.phase


@pytest.mark.parametrize(
    "valid, reason",
    [
        (0.0, "the transmitter is lost (valid is 0)"),
        (np.nan, "transmitter: valid is 0.90 s old (/fmu/out/manual_control_setpoint)"),
    ],
)
def test_lost_transmitter_releases_within_a_second(valid: float, reason: str) -> None:
    bridge = px4_bridge(offboard=14.0)
    engage(bridge)
    assert fly(bridge, 0.05, 3.0) is Phase.ENGAGED
    assert "the loss of the transmitter" not in str(bridge.reason)
    assert fly(bridge, 3.05, 3.96, transmitter=valid) in {Phase.RELEASE, Phase.DISENGAGED}
    assert str(bridge.reason) == reason


def test_blind_engagement_ignores_the_transmitter() -> None:
    bridge = px4_bridge(offboard=14.0, transmitter=0.0)
    assert str(bridge.engage(at(0.0))) == "the transmitter is lost (valid is 0)"
    engage(bridge, blind=True)
    assert fly(bridge, 0.05, 3.0, transmitter=0.0) is Phase.ENGAGED
    assert str(bridge.reason).endswith(
        "the loss of the transmitter is not watched (--blind), and the override by pilot has no "
        "effect then; released by a lost condition (armed, offboard), rise-di engage --off"
    )
    bridge.disengage(Refusal("disengaged by request"), at(3.0))
    # The bridge is blind for one engagement.
    assert str(bridge.engage(at(3.0))) == "the transmitter is lost (valid is 0)"


def test_unwatched_transmitter_needs_a_bound() -> None:
    bridge = ready_bridge(channel_map=CHANNEL_MAP.model_copy(update={"max_engaged": None}))
    refusal = (
        "the loss of the transmitter cannot be seen over this link: set max_engaged in "
        "the map, or engage with --blind"
    )
    assert str(bridge.engage(at(0.0))) == refusal
    engage(bridge, blind=True)
    assert bridge.phase is Phase.ENGAGED


def test_max_engaged_releases_after_a_warning() -> None:
    bridge = engaged_bridge(CHANNEL_MAP.model_copy(update={"max_engaged": 30.0}))
    blind = (
        "the loss of the transmitter cannot be seen over this link; "
        "released by the override by gamepad, rise-di engage --off, max_engaged after 30 s"
    )
    assert str(bridge.reason).endswith(blind)
    assert fly(bridge, 0.05, 19.96) is Phase.ENGAGED
    assert "max_engaged releases" not in str(bridge.reason)
    assert fly(bridge, 20.05, 29.96) is Phase.ENGAGED
    assert str(bridge.reason).startswith("max_engaged releases in 10 s, unless engaged again; ")
    engage(bridge, 30.0)
    assert fly(bridge, 30.05, 49.96) is Phase.ENGAGED
    assert str(bridge.reason).endswith(blind)
    assert fly(bridge, 50.05, 60.06) is Phase.RELEASE
    assert str(bridge.reason) == "engaged for 30 s, max_engaged of the map"


def test_blind_engagement_has_no_bound() -> None:
    bridge = ready_bridge(channel_map=CHANNEL_MAP.model_copy(update={"max_engaged": 5.0}))
    engage(bridge)
    engage(bridge, blind=True)
    assert fly(bridge, 0.05, 20.0) is Phase.ENGAGED
    assert "max_engaged" not in str(bridge.reason)


def test_captured_output_is_zero_until_engagement_and_then_change() -> None:
    bridge = px4_bridge(offboard=14.0)
    samples = [bridge.y(at(0.0))]
    engage(bridge)
    refresh(bridge, 0.1, offboard=14.0)  # V from 20 to 21 m/s
    samples.append(bridge.y(at(0.1)))
    place = bridge.outputs.index("V")
    assert [None if sample is None else sample.value[place] for sample in samples] == [0.0, 1.0]


STICKS = {"elevator": 1400.0, "thrust": 1450.0, "aileron": 1520.0, "rudder": 1490.0}  # us


def ardupilot_bridge(t: float = 0.0, sticks: dict[str, float] = STICKS) -> Bridge:
    """Return a bridge with the map of ArduPilot in MANUAL, with the sticks in these positions."""
    bridge = new_bridge(unlimited("ardupilot"))
    receive_outputs(bridge, t, tuple(bridge.outputs))
    receive_u(bridge, t)
    for name, raw in {"manual": 0.0, "armed": 1.0, "flying": 1.0}.items():
        bridge.take_condition(name, raw, at(t))
    for name, us in sticks.items():
        receive_outputs(bridge, t, (trim_key(name),), us)
    return bridge


def test_each_trim_captured_from_own_stick_at_engagement_and_kept() -> None:
    """-1 to 1 is 1000 to 2000 us, and at 1 there are 30 deg and half of the throttle."""
    bridge = ardupilot_bridge()
    engage(bridge)
    for name in STICKS:
        # While overridden, ArduPilot reports what it is sent.
        receive_outputs(bridge, 0.05, (trim_key(name),), 1900.0)
    assert bridge.raw() == approx([-0.2, -0.1, 0.04, -0.02], abs=1e-9)
    assert [bridge.trim(name) for name in STICKS] == approx(
        [-0.10472, 0.45, 0.020944, -0.010472], abs=1e-6
    )


@pytest.mark.parametrize(
    "condition, raw, sentence",
    [
        ("manual", 15.0, "the mode is not MANUAL (mode is 15)"),  # GUIDED
        ("armed", 0.0, "the aircraft is not armed (armed is 0)"),
        ("flying", 0.0, "the aircraft does not fly (flying is 0)"),
    ],
)
def test_ardupilot_engaged_in_manual_armed_and_flying_alone(
    condition: str, raw: float, sentence: str
) -> None:
    bridge = ardupilot_bridge()
    bridge.take_condition(condition, raw, at(0.0))
    assert str(bridge.engage(at(0.0))) == sentence


def test_ardupilot_is_not_engaged_while_pilots_switch_is_on() -> None:
    bridge = ardupilot_bridge()
    bridge.take_override("switch", 1800.0, at(0.0))
    assert str(bridge.engage(at(0.0))) == "pilot override active: switch"


def mavlink_bridge(override_time: float = 0.5, max_engaged: float = 120.0) -> Bridge:
    """Return a bridge with the map of ArduPilot over MAVLink, ready in MANUAL.

    The parameter RC_OVERRIDE_TIME is in s.
    """
    bridge = new_bridge(
        unlimited("ardupilot_mavlink").model_copy(update={"max_engaged": max_engaged})
    )
    bridge.take_parameter("RC_OVERRIDE_TIME", override_time)
    receive_mavlink(bridge, 0.0)
    for name, us in STICKS.items():
        receive_outputs(bridge, 0.0, (trim_key(name),), us)
    return bridge


def receive_mavlink(bridge: Bridge, t: float) -> None:
    """Receive y, u and the conditions of the map of ArduPilot over MAVLink.

    The aircraft is in MANUAL, armed and in the air.
    """
    receive_outputs(bridge, t, tuple(bridge.outputs))
    receive_u(bridge, t)
    for name, raw in {"manual": 0.0, "armed": 128.0, "flying": 2.0}.items():
        bridge.take_condition(name, raw, at(t))


def engaged_mavlink_bridge(max_engaged: float = 120.0) -> Bridge:
    bridge = mavlink_bridge(max_engaged=max_engaged)
    engage(bridge)
    assert sent(bridge, 0.0) == {"override"}
    return bridge


def stop(bridge: Bridge, how: str) -> None:
    """End an engagement in a way in which no pilot does."""
    if how == "y ends":
        receive_u(bridge, 0.25)
    elif how == "u ends":
        receive_outputs(bridge, 0.25, tuple(bridge.outputs))
    elif how == "conditions end":
        for t in np.arange(0.1, 1.65, 0.1).tolist():
            receive_outputs(bridge, t, tuple(bridge.outputs))
            receive_u(bridge, t)
            bridge.step(at(t))
    elif how == "another publisher":
        bridge.conflict = Refusal(how)
    elif how == "max_engaged":
        receive_mavlink(bridge, 1.0)
        bridge.step(at(1.0))
    else:
        bridge.disengage(Refusal(how), at(0.2))
    bridge.step(at(0.25))


@pytest.mark.parametrize(
    "how",
    ["y ends", "u ends", "conditions end", "another publisher", "max_engaged", "bridge shut down"],
)
def test_release_that_no_pilot_requested_asks_for_a_mode_that_flies_until_the_mode_changes(
    how: str,
) -> None:
    bridge = engaged_mavlink_bridge(1.0 if how == "max_engaged" else 120.0)
    stop(bridge, how)
    assert bridge.phase is Phase.RELEASE, bridge.reason
    assert sent(bridge, 0.3) == {"override", "mode_after"}
    bridge.take_condition("manual", 12.0, at(0.4))
    assert sent(bridge, 0.4) == {"override"}


@pytest.mark.parametrize("how", ["override", "request", "mode", "disarmed", "landed"])
def test_release_by_the_pilot_leaves_the_mode(how: str) -> None:
    bridge = engaged_mavlink_bridge()
    if how == "override":
        bridge.take_override("switch", 1900.0, at(0.1))
    elif how == "request":
        bridge.disengage(Refusal("disengaged by request"), at(0.1), by_pilot=True)
    else:
        name, raw = {
            "mode": ("manual", 2.0),
            "disarmed": ("armed", 0.0),
            "landed": ("flying", 1.0),
        }[how]
        bridge.take_condition(name, raw, at(0.1))
    assert bridge.step(at(0.1)) is Phase.RELEASE
    assert sent(bridge, 0.1) == {"override"}


def test_pilot_who_takes_over_during_a_release_keeps_the_mode() -> None:
    bridge = engaged_mavlink_bridge()
    bridge.disengage(Refusal("bridge shut down"), at(0.1))
    assert "mode_after" in sent(bridge, 0.1)
    bridge.take_override("switch", 1900.0, at(0.2))
    assert sent(bridge, 0.2) == {"override"}


def with_failsafe() -> Bridge:
    """Return a bridge with PX4's map that does not request Hold after a pilot's release."""
    content = unlimited("px4").model_dump()
    content["messages"]["leave"]["when"] = "failsafe"
    return new_bridge(ChannelMap.validate_mapping(content, "map"))


def test_mode_is_asked_for_after_each_engagement_and_not_after_one_that_did_not_begin() -> None:
    bridge = with_failsafe()
    refresh(bridge, 0.0)
    engage(bridge)
    bridge.disengage(Refusal("the controller ended"), at(0.1))
    assert bridge.phase is Phase.RELEASE
    bridge.take_condition("offboard", 14.0, at(0.1))
    assert sent(bridge, 0.1) == set()  # it waited for offboard
    for begin, by_pilot in ((1.0, False), (2.0, True), (3.0, False)):
        refresh(bridge, begin, offboard=14.0)
        bridge.step(at(begin))
        assert bridge.engage(at(begin)) is None
        bridge.disengage(Refusal("the flight ended"), at(begin + 0.1), by_pilot=by_pilot)
        assert sent(bridge, begin + 0.1) == (set() if by_pilot else {"leave"})


def test_lost_transmitter_asks_for_the_mode() -> None:
    """A condition that is not met is a choice of the pilot or the autopilot.

    The loss of the transmitter is not.
    """
    bridge = with_failsafe()
    refresh(bridge, 0.0, offboard=14.0)
    engage(bridge)
    bridge.take_condition("transmitter", 0.0, at(0.1))
    assert bridge.step(at(0.1)) is Phase.RELEASE
    assert sent(bridge, 0.1) == {"leave"}


OVERRIDE_TIME = (
    "where the link is cut the last u stands so long, and 0.5 s is enough: param "
    "set RC_OVERRIDE_TIME 0.5"
)


# Without end, without overrides, and ArduPilot's default.
@pytest.mark.parametrize("seconds", [-1.0, 0.0, 3.0])
def test_engagement_needs_a_short_timeout_of_overrides(seconds: float) -> None:
    bridge = mavlink_bridge(seconds)
    assert (
        str(bridge.engage(at(0.0)))
        == f"RC_OVERRIDE_TIME is {seconds:g}, expected 0.2 to 1: {OVERRIDE_TIME}"
    )
    bridge.take_parameter("RC_OVERRIDE_TIME", 0.5)
    engage(bridge)
    bridge.take_parameter("RC_OVERRIDE_TIME", seconds)
    assert bridge.step(at(0.0)) is Phase.ENGAGED  # a parameter refuses, and does not end


def test_engagement_without_an_answer_about_a_parameter_is_refused() -> None:
    bridge = mavlink_bridge()
    bridge._parameters.clear()
    unknown = (
        "RC_OVERRIDE_TIME not received yet: the autopilot does not answer, or has no such parameter"
    )
    assert str(bridge.engage(at(0.0))) == unknown


def test_problem_of_the_link_refuses_an_engagement_and_stands_beside_what_ends_it() -> None:
    bridge = mavlink_bridge()
    bridge.problem = Refusal("ATTITUDE comes at 4 Hz")
    assert str(bridge.engage(at(0.0))) == "ATTITUDE comes at 4 Hz"
    bridge.problem = None
    engage(bridge)
    bridge.problem = Refusal("ATTITUDE comes at 4 Hz")
    assert bridge.step(at(0.1)) is Phase.ENGAGED
    assert str(bridge.reason).startswith("ATTITUDE comes at 4 Hz; ")
    receive_u(bridge, 0.25)
    assert bridge.step(at(0.25)) is Phase.RELEASE
    assert str(bridge.reason).endswith("s old (mavlink/VFR_HUD); ATTITUDE comes at 4 Hz")


def test_engagement_needs_sources_of_trims() -> None:
    bridge = ardupilot_bridge(sticks=STICKS | {"thrust": 1450.0})
    receive_outputs(bridge, 0.6, tuple(bridge.outputs))
    receive_u(bridge, 0.6)
    assert str(bridge.engage(at(0.6))).startswith(
        "trim of elevator, trim of thrust, trim of aileron, trim of rudder are 0.60 s"
    )


def test_engagement_whose_limits_leave_range_around_trim_refused() -> None:
    # 90 % of throttle, upper limit 30 % above
    bridge = ardupilot_bridge(sticks=STICKS | {"thrust": 1900.0})
    assert (
        str(bridge.engage(at(0.0)))
        == "thrust: its trim is 0.9 now, and the limits [-0.2, 0.3] around it leave its range"
    )


def test_u_that_times_out_sends_captured_trim_where_map_says_so() -> None:
    content = unlimited("ardupilot").model_dump()
    content["silence"] = {"max_age": 0.2, "neutral": 0.3, "release": 0.5}
    bridge = ardupilot_bridge()
    bridge.channel_map = ChannelMap.validate_mapping(content, "map")
    engage(bridge)
    receive_outputs(bridge, 0.19, tuple(bridge.outputs))
    assert bridge.step(at(0.21)) is Phase.NEUTRAL
    assert bridge.raw() == approx([-0.2, -0.1, 0.04, -0.02], abs=1e-9)


@pytest.mark.parametrize("earlier", [0.7, 0.1], ids=["where it is", "elsewhere a minute ago"])
def test_override_by_stick_counts_way_since_engagement(earlier: float) -> None:
    content = CHANNEL_MAP.model_dump()
    content["overrides"]["gamepad"] |= {"above": None, "moved": 0.2}
    bridge = ready_bridge(channel_map=ChannelMap.validate_mapping(content, "map"))
    bridge.take_override("gamepad", earlier, at(0.0 if earlier == 0.7 else -60.0))
    engage(bridge)
    bridge.take_override("gamepad", 0.7, at(0.005))
    bridge.take_override("gamepad", 0.55, at(0.01))
    assert bridge.step(at(0.01)) is Phase.ENGAGED
    bridge.take_override("gamepad", 0.45, at(0.02))
    assert bridge.step(at(0.02)) is Phase.RELEASE
    assert str(bridge.reason) == "pilot override by gamepad"


def test_override_by_switch_in_bit_field_counts_own_bit_since_engagement() -> None:
    content = CHANNEL_MAP.model_dump()
    content["overrides"]["gamepad"] |= {"above": None, "moved": 0.5, "bits": 4}
    row = ChannelMap.validate_mapping(content, "map").overrides["gamepad"]
    assert [row.is_active(raw, at_engagement=5.0) for raw in (5.0, 6.0, 1.0)] == [
        False,
        False,
        True,
    ]


def test_override_whose_topic_has_ended_does_not_block_engagement() -> None:
    bridge = new_bridge()
    bridge.take_override("gamepad", 1.0, at(0.0))
    receive_outputs(bridge, 0.9)
    receive_u(bridge, 0.9)
    assert str(bridge.engage(at(0.9))) == "pilot override active: gamepad"
    engage(bridge, 1.05)


ENVELOPE = {"phi": [-0.8, 0.8], "theta": [-0.4, 0.5], "V": [-5.0, 8.0]}


def enveloped_bridge() -> Bridge:
    """Return an engaged bridge with ENVELOPE in level flight at trim speed."""
    bridge = new_bridge(
        ChannelMap.validate_mapping(CHANNEL_MAP.model_dump() | {"envelope": ENVELOPE}, "map")
    )
    receive_u(bridge, 0.0)
    receive_outputs(bridge, 0.0)
    assert str(bridge.engage(at(0.0))) == "phi, theta not received yet (/ap/pose/filtered)"
    receive_outputs(bridge, 0.0, ("phi", "theta"))
    assert str(bridge.engage(at(0.0))) == "V is -25, outside the envelope [-5, 8]"
    receive_outputs(bridge, 0.01, ("V",), raw=25.0)
    engage(bridge, 0.01)
    return bridge


@pytest.mark.parametrize(
    "name, raw, channel", [("phi", 0.81, 0.81), ("theta", 0.41, -0.41), ("V", 33.1, 8.1)]
)
def test_leaving_envelope_releases_channels_with_sentence(
    name: str, raw: float, channel: float
) -> None:
    bridge = enveloped_bridge()
    inside = {"phi": -0.79, "theta": -0.49, "V": 32.9}
    receive_outputs(bridge, 0.02, (name,), inside[name])
    assert bridge.step(at(0.02)) is Phase.ENGAGED
    receive_outputs(bridge, 0.03, (name,), raw)
    assert bridge.step(at(0.03)) is Phase.RELEASE
    lower, upper = ENVELOPE[name]
    assert (
        str(bridge.reason) == f"{name} is {channel:g}, outside the envelope [{lower:g}, {upper:g}]"
    )


def test_climb_refuses_an_engagement_and_does_not_end_one() -> None:
    content = CHANNEL_MAP.model_dump() | {
        "envelope": {"climb": [-8.0, 8.0]},
        "engage_if": {"climb": [-2.0, 2.0]},
    }
    bridge = new_bridge(ChannelMap.validate_mapping(content, "map"))
    receive_u(bridge, 0.0)
    receive_outputs(bridge, 0.0, (*OUTPUTS, "climb"), raw=2.1)
    assert str(bridge.engage(at(0.0))) == "climb is 2.1, outside engage_if [-2, 2]"
    receive_outputs(bridge, 0.01, ("climb",), raw=1.9)
    engage(bridge, 0.01)
    receive_outputs(bridge, 0.02, ("climb",), raw=7.9)
    assert bridge.step(at(0.02)) is Phase.ENGAGED
    # The sink of ArduPlane with a jammed elevator.
    receive_outputs(bridge, 0.03, ("climb",), raw=-8.4)
    assert bridge.step(at(0.03)) is Phase.RELEASE
    assert str(bridge.reason) == "climb is -8.4, outside the envelope [-8, 8]"


def test_surface_that_stays_at_its_limit_ends_the_engagement_and_thrust_does_not() -> None:
    content = CHANNEL_MAP.model_dump()
    for name in ("elevator", "aileron", "rudder"):
        content["inputs"][name]["at_limit"] = 0.1
    bridge = ready_bridge(channel_map=ChannelMap.validate_mapping(content, "map"))
    engage(bridge)
    lower, upper = (
        np.array([content["inputs"][name][key] for name in content["inputs"]])
        for key in ("lower", "upper")
    )

    def fly(t: float, u: FloatArray) -> Phase:
        receive_outputs(bridge, t)
        receive_u(bridge, t)
        bridge.take_u(StampedVector(at(t), u, "controller"), at(t))
        return bridge.step(at(t))

    aileron_inside = np.array([0.0, 1.0, 0.99, 0.0])
    assert fly(0.01, upper) is Phase.ENGAGED
    assert fly(0.10, upper * aileron_inside) is Phase.ENGAGED  # the time begins again
    assert fly(0.11, lower * [0.0, 1.0, 1.2, 0.0]) is Phase.ENGAGED
    assert fly(0.20, lower * [0.0, 1.0, 1.2, 0.0]) is Phase.ENGAGED
    assert fly(0.21, lower * [0.0, 1.0, 1.2, 0.0]) is Phase.RELEASE
    assert str(bridge.reason) == "aileron is at its limit for 0.1 s, p does not answer"


def test_large_u_that_rests_is_at_a_limit_of_the_law_narrower_than_that_of_the_map() -> None:
    content = CHANNEL_MAP.model_dump()
    limit = content["inputs"]["rudder"]["upper"]
    content["inputs"]["rudder"]["at_limit"] = 0.1
    for name in set(content["inputs"]) - {"rudder"}:
        content["inputs"][name]["at_limit"] = None
    bridge = ready_bridge(channel_map=ChannelMap.validate_mapping(content, "map"))
    engage(bridge)

    def fly(t: float, part: float) -> Phase:
        receive_outputs(bridge, t)
        receive_u(bridge, t, part * limit)
        return bridge.step(at(t))

    steps = np.arange(0.02, 0.2, 0.02)
    assert {fly(t, 0.4) for t in steps} == {Phase.ENGAGED}  # as the doublets of an experiment
    assert {fly(0.2 + t, 0.6 + t) for t in steps} == {Phase.ENGAGED}  # it moves
    assert [fly(0.4 + t, 0.9) for t in steps][-1] is Phase.RELEASE
    assert str(bridge.reason) == "rudder is at its limit for 0.1 s, r does not answer"


def test_envelope_whose_channel_is_stale_releases_channels() -> None:
    bridge = enveloped_bridge()
    receive_outputs(bridge, 0.15)
    receive_outputs(bridge, 0.16, ("V",), raw=25.0)
    receive_u(bridge, 0.15)
    assert bridge.step(at(0.25)) is Phase.RELEASE
    assert str(bridge.reason).startswith("phi, theta are 0.25 s old (/ap/pose/filtered)")


def test_pose_has_fresh_channels_and_stamp_of_first_row() -> None:
    bridge = new_bridge()
    receive_outputs(bridge, 0.0, ("theta", "climb"), 0.1)
    assert bridge.pose(at(0.0)) is None
    receive_outputs(bridge, 0.01, ("phi",), 0.2)
    names, pose = bridge.pose(at(0.02)) or ((), None)
    assert pose is not None
    assert dict(zip(names, pose.value.tolist(), strict=True)) == {
        "phi": 0.2,
        "theta": -0.1,
        "climb": 0.1,
    }
    assert pose.stamp_ns == at(0.01)
    assert bridge.pose(at(0.03)) is None  # each is published once
    receive_outputs(bridge, 0.3, ("phi",))
    names, _ = bridge.pose(at(0.3)) or ((), None)
    assert names == ("phi",)  # the others are 0.3 s old


def followed(
    processes: "FlightProcesses",
    monitor: "FlightMonitor",
    announce: Callable[[str], None] = lambda line: None,
    engaged_for: float = np.inf,
    must_begin: bool = False,
) -> Outcome:
    """Return the outcome of a flight of osprey_gust, 60 s.

    It is flown with an autopilot, or with an aircraft that must begin to fly.
    """
    scenario = find_scenario("osprey_gust")
    monotonic_ns = lambda: round(1e9 * vars(flying)["time"].monotonic())  # noqa: E731 - a stand-in
    vars(monitor)["clock"] = SimpleNamespace(monotonic_ns=monotonic_ns)
    vars(processes).update(scenario=scenario, monitor=monitor)
    span = _Span(scenario, processes, monitor, must_begin=must_begin)
    steps = _follow_real_time(processes, lambda t, text: None, announce, engaged_for, span)
    return run_to_end(steps, pause=vars(flying)["time"].sleep)


@pytest.mark.parametrize(
    "must_begin, until, end, outcome",
    [
        (False, 60.0, 60.0, "completed"),
        (False, 59.0, 64.0, "completed"),
        (False, None, 60.0, "completed"),
        (True, 60.0, 60.0, "completed"),
        (True, 58.0, 63.0, "ended early: the log holds y, y_m and u up to t = 58.000 of 60 s"),
        (True, None, 60.0, "ended early: the log does not hold y, y_m and u of 60 s"),
    ],
)
def test_flight_ends_once_log_holds_it(
    must_begin: bool, until: float | None, end: float, outcome: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A flight waits 5 s for a log that has stopped.

    With an autopilot (not `must_begin`), u may end or never begin.
    """
    now = [0.0]

    def sleep(period: float) -> None:
        now[0] += period

    monkeypatch.setattr(
        "flight_bringup.fly.time", SimpleNamespace(monotonic=lambda: now[0], sleep=sleep)
    )

    def recorded() -> float | None:
        return None if until is None else 1000.0 + min(now[0], until)

    processes = SimpleNamespace(
        pop_end_of_learner=lambda: None,
        started=0.0,
        start_time=1000.0,
        ended=lambda: None,
        is_flying=lambda: True,
    )
    monitor = SimpleNamespace(learned=list, engagement=list, newest=lambda: None, recorded=recorded)
    sentence = followed(
        cast("FlightProcesses", processes), cast("FlightMonitor", monitor), must_begin=must_begin
    )
    assert str(sentence) == outcome
    assert now[0] == approx(end, abs=0.1)


@pytest.mark.parametrize(
    "published, outcome",
    [(False, "y did not reach the controller"), (True, "u did not reach the aircraft")],
)
def test_flight_that_does_not_begin_says_which_signal_is_missing(
    published: bool, outcome: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    now = [0.0]

    def sleep(period: float) -> None:
        now[0] += period

    monkeypatch.setattr(
        "flight_bringup.fly.time", SimpleNamespace(monotonic=lambda: now[0], sleep=sleep)
    )
    processes = SimpleNamespace(
        pop_end_of_learner=lambda: None,
        started=0.0,
        start_time=1000.0,
        ended=lambda: None,
        is_flying=lambda: False,
        last_words=lambda name: None,
    )
    monitor = SimpleNamespace(
        learned=list,
        engagement=list,
        newest=lambda: ("ENGAGED", np.zeros(4)) if published else None,
        recorded=lambda: None,
    )
    sentence = followed(
        cast("FlightProcesses", processes), cast("FlightMonitor", monitor), must_begin=True
    )
    assert str(sentence) == f"never flew: {outcome}"
    assert now[0] == approx(FIRST_U, abs=0.1)


def test_flight_announces_each_reason_once_without_those_in_which_number_alone_changes() -> None:
    reasons = [
        "would refuse: u not received yet",
        "u is 0.30 s old",
        "u is 0.41 s old",
        "not engaged yet",
        "not engaged yet",
    ]
    waiting = [("DISENGAGED", reason) for reason in reasons] + [("ENGAGED", "")]
    announced = list[str]()
    processes = SimpleNamespace(
        pop_end_of_learner=lambda: None,
        start_time=1000.0,
        started=time.monotonic(),
        ended=lambda: None if waiting else ended_early("the end"),
    )
    monitor = SimpleNamespace(
        learned=list,
        engagement=lambda: [waiting.pop(0)],
        newest=lambda: None,
        recorded=lambda: None,
    )
    nodes = cast("tuple[FlightProcesses, FlightMonitor]", (processes, monitor))
    assert followed(*nodes, announce=announced.append) == ended_early("the end")
    assert announced == [*(f"DISENGAGED: {reasons[i]}" for i in (0, 1, 3)), "ENGAGED"]


def test_experiment_without_engagement_ends_when_too_little_time_left() -> None:
    # osprey_gust has 60 s, of which the experiment needs 59.8; it began 0.3 s ago.
    processes = SimpleNamespace(
        pop_end_of_learner=lambda: None,
        start_time=1000.0,
        started=time.monotonic() - 0.3,
        ended=lambda: None,
    )
    monitor = SimpleNamespace(
        learned=list, engagement=list, newest=lambda: None, recorded=lambda: None
    )
    nodes = cast("tuple[FlightProcesses, FlightMonitor]", (processes, monitor))
    assert followed(*nodes, engaged_for=59.8) == ended_early("not engaged within 0.2 s")


def test_step_of_system_clock_does_not_end_flight(monkeypatch: pytest.MonkeyPatch) -> None:
    calls = iter([None, None, ended_early("the end")])
    processes = SimpleNamespace(
        pop_end_of_learner=lambda: None,
        start_time=1000.0,
        started=time.monotonic(),
        ended=lambda: next(calls),
    )
    monitor = SimpleNamespace(
        learned=list, engagement=list, newest=lambda: None, recorded=lambda: None
    )
    nodes = cast("tuple[FlightProcesses, FlightMonitor]", (processes, monitor))
    later = time.time() + 3600.0
    monkeypatch.setattr(time, "time", lambda: later)
    assert followed(*nodes) == ended_early("the end")


def test_second_signal_does_not_interrupt_clean_up_after_first() -> None:
    """`subprocess` releases a lock in a `finally`.

    A lock that stayed locked had made a flight wait for its nodes without end.
    """
    before = signal.getsignal(signal.SIGINT)
    clean = False
    with suppress(KeyboardInterrupt), handle_signals(interrupt):
        try:
            signal.raise_signal(signal.SIGINT)
        finally:
            signal.raise_signal(signal.SIGTERM)
            clean = True
    assert clean
    assert signal.getsignal(signal.SIGINT) is before


def test_signal_in_a_callback_of_a_module_in_c_waits_for_the_next_pause() -> None:
    """In a message that rclpy made, pybind11 had turned the KeyboardInterrupt into a TypeError."""

    def interrupted_key(value: int) -> int:
        signal.raise_signal(signal.SIGINT)
        return value

    handler = DeferredInterrupt(only_in_pauses=True)
    with handle_signals(handler):
        assert sorted([2, 1], key=interrupted_key) == [1, 2]
        with pytest.raises(KeyboardInterrupt):
            handler.pause(0.0)


def test_input_without_effect_by_the_probe_ends_an_engagement_with_its_name() -> None:
    bridge = engaged_bridge()
    bridge.take_effects(
        StampedVector(at(0.0), np.array([0.9, 0.41, 1e9, 1e9]), "controller"), at(0.0)
    )
    assert bridge.step(at(0.0)) is Phase.ENGAGED
    bridge.take_effects(
        StampedVector(at(0.0), np.array([0.9, 0.12, 1e9, 1e9]), "controller"), at(0.0)
    )
    assert bridge.step(at(0.0)) is Phase.RELEASE
    name = bridge.inputs[1]
    assert (
        str(bridge.reason) == f"{name} does not answer the probe: it has at most 12 % of its effect"
    )
