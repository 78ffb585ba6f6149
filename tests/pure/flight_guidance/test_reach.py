# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test that guidance asks for no more than the inputs can do, by a model learned in flight."""

import math

import numpy as np
from pytest import approx

from flight_core.channels import POSE
from flight_core.units import GRAVITY
from flight_core.vectors import StampedVector
from flight_guidance.guidance import Guidance
from flight_guidance.guidance_state import (
    Begin,
    GuidanceState,
    Inputs,
    StepCommands,
)
from flight_guidance.modes import modes
from flight_guidance.modes.targets import reach_sentence, within_reach
from flight_guidance.notices import LEARNED, Notices
from flight_guidance.params import GuidanceConfig
from flight_guidance.reach import AUTHORITY, Authority, RollTest

SPEED = 25.0  # m/s
FREQUENCY = 5.0  # of p, rad/s
CONFIG = GuidanceConfig.validate_mapping(
    {
        "natural_frequency": [4.0, 1.2, FREQUENCY, 4.0],
        "speed": SPEED,
        "throttle_authority": [3.0, 3.0],
        "fence": {"field": {"north": [0.0], "east": [0.0], "radius": 5000.0}},
    },
    "guidance",
)
OWN = CONFIG.params()


def flown(
    target: dict[str, float], authority: Authority, **pose: float
) -> tuple[GuidanceState, StepCommands]:
    """Return the commands after 10 s at a constant pose, which is level except for `pose`."""
    values = dict.fromkeys(POSE, 0.0) | {"v_north": SPEED} | pose
    state = None
    for k in range(500):
        begin, given = (Begin.HOLD, target) if k == 0 else (Begin.NO, {})
        inputs = Inputs(
            t_ns=k * OWN.period_ns,
            begin=begin,
            pose=tuple(values[name] for name in POSE),
            pose_age_ns=0,
            y=(0.0,) * 4,
            commands=given,
            authority=authority,
        )
        state, commands = modes.step(state, inputs, None, OWN)
    assert state is not None
    return state, commands


def test_inputs_that_are_as_strong_as_known_change_no_limit() -> None:
    assert within_reach(OWN, Authority()) == OWN
    assert within_reach(OWN, Authority(q=29.0, p=40.0, down=6.0, up=6.0)) == OWN


def test_weak_throttle_limits_climb_and_sink_to_what_it_can_do() -> None:
    # In a steady climb the weight along the path is g h_dot / V: what is left of the throttle holds
    # the airspeed.
    vertical = within_reach(OWN, Authority(down=0.6, up=0.5)).vertical
    assert GRAVITY * vertical.climb / SPEED == approx(0.7 * 0.5)
    assert GRAVITY * vertical.sink / SPEED == approx(0.5 * 0.6)
    assert flown({"climb": 2.5}, Authority(up=0.5))[0].climb_c == vertical.climb


def test_weak_aileron_limits_roll_rate_and_the_bank_that_can_be_reversed() -> None:
    now = within_reach(OWN, Authority(p=1.2))
    # 0.37 is the largest w y_dot of a second-order step of damping 1, as of the rule, which counts
    # 0.4
    assert 0.37 * FREQUENCY * now.attitude.roll_rate < 1.2 / 3.0
    assert 9.3 * now.limits.bank / now.attitude.roll_rate == approx(now.path.period)
    assert now.limits.bank < OWN.limits.bank
    # An orbit at this bank needs V^2 / (g tan(0.8 bank))
    assert now.limits.radius == approx(SPEED**2 / (GRAVITY * math.tan(0.8 * now.limits.bank)))


def test_rudder_flies_the_bank_where_the_aileron_has_no_effect() -> None:
    state, commands = flown({"phi": 0.3}, Authority(p=0.0), phi=-0.05)
    u_m = dict(zip(OWN.outputs, state.u_m, strict=True))
    assert u_m["p"] == 0.0
    assert commands.is_bank_limited
    bank = math.radians(10.0)
    assert u_m["r"] == approx(GRAVITY * math.tan(2.0 * bank) / SPEED)  # at its limit
    # The sideslip of a turn by the rudder rolls until 1.6 times the bank of a coordinated turn.
    held, _ = flown({"phi": 0.3}, Authority(p=0.0), phi=1.6 * bank)
    assert held.u_m[OWN.outputs.index("r")] == approx(GRAVITY * math.tan(bank) / SPEED)
    radius = within_reach(OWN, Authority(p=0.0)).limits.radius
    orbit = {"north": 0.0, "east": radius, "radius": math.ceil(OWN.limits.radius)}
    assert flown(orbit, Authority(p=0.0))[1].xtrack == approx(0.0, abs=1e-6)
    # The fence, 5 km away, asks for a turn of the radius V^2 / (g tan(10 deg)), 361 m, which a bank
    # of 30 deg need not.
    assert [
        flown({"phi": 0.0}, able, north=4800.0)[0].fence != 0.0
        for able in (Authority(), Authority(p=0.0))
    ] == [
        False,
        True,
    ]


def test_airspeed_flies_the_climb_where_the_elevator_has_no_effect() -> None:
    # At a constant angle of attack the lift goes with V^2, so that 1 m/s more of V accelerates
    # upwards with 2 g / V.
    sinks, _ = flown({"altitude": 0.0, "V": SPEED}, Authority(q=0.0), climb=-1.0)
    assert sinks.u_m[OWN.outputs.index("q")] == 0.0
    assert 2.0 * GRAVITY / SPEED * (sinks.V_c - SPEED) == approx(0.4 * 1.0)
    climbs, _ = flown({"altitude": 0.0, "V": SPEED}, Authority(q=0.0), climb=1.0)
    assert climbs.V_c - SPEED == approx(SPEED - sinks.V_c)
    # m/s^2, of 1.2 rad/s.
    assert within_reach(OWN, Authority(q=0.0)).slew[OWN.outputs.index("V")] == approx(1.2)


def test_limits_are_said_once_and_end_with_the_model() -> None:
    def of(authority: Authority) -> str | None:
        return reach_sentence(OWN, authority)

    assert of(Authority(q=29.0, p=40.0, down=6.0, up=6.0)) is None
    dead = "no roll rate: p has no input with an effect, bank at most 10 deg"
    assert of(Authority(p=0.0)) == dead
    assert (
        of(Authority(roll=0.0))
        == "the yaw rate flies the bank: p ignores its command, bank at most 10 deg"
    )
    assert of(Authority(up=0.5)) == "climb at most 0.89 m/s"
    assert of(Authority(down=0.0, up=0.0)) == "no climb: V has no input with an effect"
    quiet = dict.fromkeys((*Notices.CHANNELS, *LEARNED), 0.0)
    notices = Notices(0.0, 0.2, lambda speed: 99.0, reach=of)
    sentence = []
    for t, authority in enumerate([Authority(), Authority(p=0.0), Authority(p=0.0), Authority()]):
        sentence += notices.take(float(t), quiet | dict(zip(LEARNED, authority, strict=True)))
    assert [notice.text for notice in sentence] == [
        f"from now on {dead}",
        "from now on own limits again",
    ]


def test_authority_acts_from_the_next_step_on_and_is_logged() -> None:
    guidance = Guidance(CONFIG)
    channels = dict.fromkeys(AUTHORITY, 9.0) | {"up.p": 1.0, "up.V": 2.0}
    for k in range(2):
        now_ns = k * OWN.period_ns
        guidance.take_y(StampedVector(now_ns, np.zeros(4)), now_ns)
        pose = dict.fromkeys(POSE, 0.0) | {"v_north": SPEED, "north": float(k)}
        guidance.take_pose(StampedVector(now_ns, np.array([pose[name] for name in POSE])), now_ns)
        output = guidance.step(now_ns, now_ns)
        assert output is not None
        logged = dict(zip(guidance.names, output.log.tolist(), strict=True))
        assert Authority(*(logged[name] for name in LEARNED)) == (
            Authority(9.0, 1.0, 9.0, 2.0) if k else Authority()
        )
        guidance.take_authority(channels)


def rolled(share: float, test: RollTest) -> RollTest:
    """Return the test after 60 s with steps of the bank to either side.

    The aircraft rolls by a share of the command, 0.4 s late, in gusts.
    """
    dt = 0.02
    # rad/s, of which 0.05 rms are left: ten times those of an osprey in moderate turbulence.
    noise = np.random.default_rng(3).normal(0.0, 0.35, 3000)
    p = 0.0
    gust = 0.0
    for k in range(3000):
        command = 0.2 * math.copysign(1.0, math.sin(0.5 * k * dt))
        gust += 0.04 * (noise[k] - gust)  # a low-pass of 0.5 s
        p += dt / 0.4 * (share * command - p)
        test = test.after(dt, command, p + gust, 0.35)
    return test


def test_roll_rate_that_ignores_its_command_is_found_without_a_model() -> None:
    assert not rolled(0.7, RollTest()).is_ignored
    lost = rolled(0.0, RollTest())
    assert lost.is_ignored
    # The yaw alone rolls with up to half of the command: the aileron is not back.
    assert rolled(0.5, lost).is_ignored
    assert not rolled(1.0, lost).is_ignored
