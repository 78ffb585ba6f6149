# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""When the bridge sends what: engagement, silence, the pilot, limits; on a clock of the test's own."""

import numpy as np
import pytest

from autopilot_bridge.bridge import Bridge, Phase
from autopilot_bridge.channel_map import to_raw
from autopilot_bridge.params import ChannelMap, load_map
from flight_core.rates import nanoseconds
from flight_core.vectors import ChannelError

CHANNEL_MAP = load_map("ardupilot")
OUTPUTS = tuple(CHANNEL_MAP.outputs)


def at(t: float) -> int:
    return nanoseconds(1000.0 + t)


def hear(bridge: Bridge, t: float, raw: float = 0.0) -> None:
    for name in OUTPUTS:
        bridge.take_output(name, raw, at(t), at(t))


def command(bridge: Bridge, t: float, u: float = 0.0, sender: str = "controller") -> None:
    bridge.take_u(np.full(4, u), sender, at(t))


def made(channel_map: ChannelMap = CHANNEL_MAP, *, dry_run: bool = False) -> Bridge:
    return Bridge(channel_map, dry_run=dry_run)


def engaged(channel_map: ChannelMap = CHANNEL_MAP) -> Bridge:
    bridge = made(channel_map)
    hear(bridge, 0.0)
    command(bridge, 0.0)
    assert bridge.engage(at(0.0)) == ""
    return bridge


def with_silence(neutral: float, release: float) -> ChannelMap:
    content = CHANNEL_MAP.model_dump()
    content["silence"] = {"max_age": 0.2, "neutral": neutral, "release": release}
    return ChannelMap.validate_mapping(content, "map")


def test_it_engages_by_the_service_alone_and_only_with_all_that_it_needs() -> None:
    bridge = made()
    for missing, bring in (("q not received yet", hear), ("u not received yet", command)):
        assert missing in bridge.engage(at(0.0))
        assert bridge.step(at(0.0)) is Phase.DISENGAGED
        bring(bridge, 0.0)
    assert bridge.step(at(0.0)) is Phase.DISENGAGED
    assert bridge.engage(at(0.0)) == ""
    assert bridge.step(at(0.0)) is Phase.ENGAGED


def test_it_refuses_what_is_old_and_says_which() -> None:
    bridge = made()
    hear(bridge, 0.0)
    command(bridge, 0.3)
    assert bridge.engage(at(0.3)).startswith("q is 0.30 s old (/ap/twist/filtered)")
    hear(bridge, 0.6)
    assert bridge.engage(at(0.6)) == "u is 0.30 s old"


def test_a_dry_run_computes_but_never_sends_or_engages() -> None:
    bridge = made(dry_run=True)
    hear(bridge, 0.0)
    command(bridge, 0.0, 0.1)
    assert bridge.engage(at(0.0)).startswith("dry_run")
    assert not bridge.sends("joy", at(0.0))
    assert bridge.raw_u()[0] == pytest.approx(0.1 / 0.523599)


def test_it_refuses_a_u_that_would_jump() -> None:
    bridge = made()
    hear(bridge, 0.0)
    command(bridge, 0.0, 0.05)  # beyond a tenth of 0.26 rad
    assert bridge.engage(at(0.0)).startswith("u.elevator is 0.05 from trim")


def test_u_stays_inside_its_limits_around_trim() -> None:
    bridge = engaged()
    command(bridge, 0.01, 9.0)
    rows = CHANNEL_MAP.inputs.values()
    assert bridge.raw() == pytest.approx([to_raw(row.trim + row.upper, row.line) for row in rows])
    command(bridge, 0.02, -9.0)
    assert bridge.raw() == pytest.approx([to_raw(row.trim + row.lower, row.line) for row in rows])


def test_silence_of_u_brings_neutral_then_released_values_then_nothing() -> None:
    bridge = engaged(with_silence(neutral=0.3, release=0.5))
    phases = []
    for t in np.arange(0.0, 1.2, 0.01).tolist():
        hear(bridge, t + 1e-3)
        phases.append((bridge.step(at(t + 1e-3)), t, bridge.raw(), bridge.sends("joy", at(t))))
    begins = {phase: next(t for one, t, *_ in phases if one is phase) for phase in Phase}
    assert begins == pytest.approx(
        {Phase.ENGAGED: 0.0, Phase.NEUTRAL: 0.2, Phase.RELEASE: 0.5, Phase.DISENGAGED: 1.0}, abs=0.011
    )  # a tick
    for phase, _, raw, sent in phases:
        assert sent == (phase is not Phase.DISENGAGED)
        if phase is Phase.NEUTRAL:
            assert raw.tolist() == [0.0, 0.0, 0.0, 0.0]
        if phase is Phase.RELEASE:
            assert np.isnan(raw).all()
    assert bridge.reason == "u is 0.20 s old"


def test_what_returns_does_not_engage_again_by_itself() -> None:
    bridge = engaged(with_silence(neutral=1.0, release=1.0))
    hear(bridge, 0.3)
    assert bridge.step(at(0.3)) is Phase.NEUTRAL
    command(bridge, 0.31)
    assert bridge.step(at(0.32)) is Phase.NEUTRAL
    assert bridge.engage(at(0.33)) == ""  # but it may be told to, at any time
    assert bridge.step(at(0.33)) is Phase.ENGAGED


def test_an_autopilot_that_is_silent_is_given_its_channels_back() -> None:
    bridge = engaged()
    command(bridge, 0.25)
    assert bridge.step(at(0.25)) is Phase.RELEASE
    assert bridge.reason.startswith("q is 0.25 s old")
    assert bridge.step(at(0.76)) is Phase.DISENGAGED


def test_the_pilot_disengages_at_once_and_no_one_engages_over_him() -> None:
    bridge = engaged()
    bridge.take_override("gamepad", 0.0, at(0.01))
    assert bridge.step(at(0.01)) is Phase.ENGAGED
    bridge.take_override("gamepad", 1.0, at(0.02))
    assert bridge.phase is Phase.RELEASE
    assert bridge.engage(at(0.03)) == "pilot override active: gamepad"
    bridge.take_override("gamepad", 0.0, at(0.04))
    assert bridge.engage(at(0.05)) == ""


def test_of_a_set_of_bits_those_count_that_are_the_pilots() -> None:
    """ROSflight's rc_override: 0x01 to 0x20 are switches and sticks, 0x40 to 0x200 say that no command comes yet."""
    bridge = made(load_map("rosflight"))
    bridge.take_override("transmitter", float(0x40 | 0x80 | 0x100 | 0x200), at(0.0))
    assert not bridge.refusal(at(0.0)).startswith("pilot override")
    for bit in (0x01, 0x02, 0x04, 0x08, 0x10, 0x20):
        bridge.take_override("transmitter", float(0x40 | bit), at(0.0))
        assert bridge.refusal(at(0.0)) == "pilot override active: transmitter"


def test_zero_times_stop_at_once() -> None:
    bridge = engaged(with_silence(neutral=0.0, release=0.0))
    hear(bridge, 0.3)
    assert bridge.step(at(0.3)) is Phase.DISENGAGED


def test_a_second_controller_is_refused_until_the_first_is_silent() -> None:
    bridge = made()
    command(bridge, 0.0)
    with pytest.raises(ChannelError, match="conflicting publisher second ignored: already receiving from controller"):
        command(bridge, 0.1, sender="second")
    command(bridge, 0.3, sender="second")


def test_y_is_given_once_at_the_instant_of_its_rate_sample_and_only_while_all_are_fresh() -> None:
    bridge = made()
    bridge.take_output("q", 0.5, at(0.0), at(0.01))
    assert bridge.y(at(0.01)) is None
    hear(bridge, 0.02)
    bridge.take_output("q", 0.5, at(0.03), at(0.03))
    sample = bridge.y(at(0.03))
    assert sample is not None
    assert sample.stamp_ns == at(0.03)
    assert sample.value.tolist() == [-0.5, -25.0, 0.0, 0.0]
    assert bridge.y(at(0.04)) is None
    bridge.take_output("q", 0.5, at(0.25), at(0.25))  # the others are 0.23 s old, beyond 0.2 s
    assert bridge.y(at(0.25)) is None


def test_stamps_of_another_clock_and_samples_out_of_order_are_refused() -> None:
    bridge = made(load_map("mavros"))
    with pytest.raises(ChannelError, match="stamp: arrival") as refused:
        bridge.take_output("q", 0.0, nanoseconds(12.0), at(0.0))  # since boot
    assert refused.value.reason == "stamp"
    bridge.take_output("q", 0.0, at(0.0), at(0.0))
    with pytest.raises(ChannelError, match="before the last one"):
        bridge.take_output("q", 0.0, at(0.0), at(0.01))


def test_heartbeats_begin_before_engagement_and_end_with_u() -> None:
    bridge = made(load_map("px4"))
    assert not bridge.sends("offboard", at(0.0))
    hear(bridge, 0.0)
    command(bridge, 0.0)
    assert bridge.sends("offboard", at(0.0))
    assert not bridge.sends("torque", at(0.0))
    for name in OUTPUTS[:3]:
        bridge.take_output(name, 0.0, at(0.25), at(0.25))
    assert not bridge.sends("offboard", at(0.25))
