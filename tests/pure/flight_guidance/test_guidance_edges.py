# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test guidance at its limits: bank 0, speed 0, a wind above V, and steps that fail."""

import math
from collections.abc import Callable
from dataclasses import replace
from itertools import product
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pytest import approx
from tests.closed_loop import calm_osprey as calm
from tests.conftest import REPOSITORY

from flight_analysis.closed_loop.guidance_replay import replay_guidance
from flight_analysis.closed_loop.scenario import Scenario
from flight_analysis.closed_loop.scenario_library import find_scenario
from flight_analysis.closed_loop.simulate import simulate
from flight_analysis.report.account import account
from flight_analysis.report.guided import guidance_notices
from flight_analysis.report.shortfalls import judge
from flight_analysis.report.summary import summarise
from flight_core.channels import POSE, SIDES, UNKNOWN
from flight_core.outcome import COMPLETED
from flight_core.vectors import Array, ChannelError, FloatArray, StampedVector
from flight_guidance import guidance as module
from flight_guidance.fence.fence import Motion, last_safe_turn, turn_clearance
from flight_guidance.fence.zones import Fence, Zone
from flight_guidance.guidance import Guidance
from flight_guidance.guidance_state import Begin, GuidanceMode
from flight_guidance.params import GuidanceConfig
from flight_guidance.reach import AUTHORITY
from flight_guidance.steering.attitude import AttitudeParams, body_rates, yaw_for_bank
from flight_guidance.steering.lateral import PathError, PathParams, path_acceleration
from flight_guidance.steering.protection import bank_limit
from flight_guidance.steering.vertical import path_angle

pytestmark = pytest.mark.slow

FIELD = Zone((-400.0, 1300.0, 1300.0, -400.0), (-500.0, -500.0, 500.0, 500.0))
FENCE = Fence((FIELD,), (200.0, 0.0))
WIDE = {"wide": {"north": [-6e3, 9e3, 9e3, -6e3], "east": [-6e3, -6e3, 6e3, 6e3]}}
SPEEDS = (-60.0, -1.0, 0.0, 1e-9, 12.0, 27.4999, 27.5, 27.5001, 40.0, 1e6)  # m/s; 1.1 V_s is 27.5
STALL = 25.0
NAMESPACES = pytest.mark.parametrize("asarray", [np.asarray, jnp.asarray], ids=["NumPy", "JAX"])


@NAMESPACES
def test_wings_are_level_at_a_speed_without_room_for_a_bank(
    asarray: Callable[[Any], Array],
) -> None:
    """There is no bank up to 1.1 V_s, at a standstill, or with a flow from behind.

    Floats and arrays give the same.
    """
    limits = np.asarray(bank_limit(0.5, STALL, asarray(SPEEDS)))
    assert limits == approx([float(bank_limit(0.5, STALL, speed)) for speed in SPEEDS], abs=1e-6)
    assert not limits[:6].any()
    assert limits[-2:] == approx([0.5, 0.5])
    assert (np.diff(limits) >= 0.0).all()


def motion(speed: Any, bank: Any, wind: tuple[float, float], phi: Any) -> Motion:
    """Return an aircraft that flies to the north, 1,300 m before the border."""
    zero = 0.0 * phi
    return Motion(
        north=zero,
        east=zero,
        phi=phi,
        heading=zero,
        speed=speed,
        wind=wind,
        bank=bank,
        roll_rate=0.6,
        lag=1.0,
    )


@pytest.mark.parametrize("compiled", [lambda step: step, jax.jit], ids=["NumPy", "JAX"])
def test_fence_has_a_number_at_every_edge(compiled: Callable[[Any], Any]) -> None:
    """The fence gives finite numbers for every previous action, bank, speed and wind.

    The inputs are arrays of a fleet, and also floats.
    """

    def escapes(speed: Array, bank: Array, wind: Array, action: Array) -> Any:
        return last_safe_turn(FENCE, action, motion(speed, bank, (wind, -wind), 0.0 * bank))

    grid = np.array([*product(SPEEDS, (0.0, 1e-12, 0.5), (0.0, 90.0), (0.0, 1.0, 2.0, 3.0))]).T
    escape = compiled(escapes)(*grid)
    assert all(np.isfinite(np.asarray(values)).all() for values in escape)
    assert np.isin(np.asarray(escape.action), (-1.0, 0.0, 1.0, 2.0, 3.0, 4.0)).all()
    single = motion(0.0, 0.0, (-90.0, 0.0), 0.0)
    assert all(np.isfinite(float(value)) for value in last_safe_turn(FENCE, 0.0, single))


@pytest.mark.parametrize("wind", [0.0, 30.0])
def test_turn_without_bank_is_the_straight_way(wind: float) -> None:
    """The aircraft flies away from home to the north at 20 m/s, over a square, in a west wind.

    Without a bank, the prediction is a straight line, and its end is farthest from the square.
    """
    straight = motion(20.0, 0.0, (0.0, wind), np.float64(0.0))._replace(north=500.0)
    right, left = map(float, turn_clearance(FENCE, straight))
    assert right == left  # no side is the better one
    # As long as nearly a full turn at 5 deg is predicted, with a fifth less turn.
    rate = 0.8 * 9.81 * math.tan(math.radians(5.0)) / 20.0
    longest = 1.0 + 1.95 * math.pi / rate
    north, east = 500.0 + 20.0 * longest, wind * longest
    assert right == approx(-math.hypot(north - 1300.0, max(east - 500.0, 0.0)), abs=1.0)


def test_speeds_that_divide_have_numbers() -> None:
    attitude = AttitudeParams(
        k_phi=1.0, k_theta=1.0, roll_rate=0.6, load=1.0, n_alpha=5.0, k_beta=0.5
    )
    path = PathParams(14.0, 0.7, 0.5)
    for speed, climb, e in product(SPEEDS, (-5.0, 0.0, 5.0), (-10.0, 0.0, 10.0)):
        rates = body_rates(0.5, 0.1, 0.2, 0.0, 0.0, 0.1, speed, attitude)
        error = PathError(e, 0.1, 0.001)
        values = [
            path_angle(climb, speed),
            *rates,
            yaw_for_bank(0.5, 0.2, speed),
            path_acceleration(error, 0.3, speed, path),
        ]
        assert np.isfinite(values).all()
    # With a flow from behind a climb is still one.
    assert path_angle(5.0, -20.0) > 0.0 > path_angle(-5.0, 0.0)


# Any finite y and pose


def fenced(scenario: Scenario, side: float) -> Scenario:
    field = {"north": [-side, 2 * side, 2 * side, -side], "east": [-side, -side, side, side]}
    return scenario.vary(guidance={"fence": {"in": field}})


LANDING = find_scenario("examples/scenarios/landing.yaml")
HEXAROTOR = find_scenario("examples/hexarotor/hexarotor_square.yaml")
FLIGHTS = {
    "osprey": find_scenario("osprey_route"),
    "osprey in a fence": fenced(find_scenario("osprey_route"), 3000.0),
    "c172p": find_scenario("jsbsim_c172p_route"),
    "landing": LANDING,
    "hexarotor": HEXAROTOR,
    "hexarotor in a fence": fenced(HEXAROTOR, 300.0),
}
EDGES = {  # by channel of the pose: a calm value, and those at the edge
    "phi": (0.1, math.pi / 2.0, -math.pi / 2.0, math.pi),
    "theta": (0.05, math.pi / 2.0, -math.pi / 2.0),
    "psi": (1.0, math.pi, -math.pi),
    "north": (10.0, 1e-300, 1e3, 9e6),
    "east": (0.0, -1e3, -9e6),
    "altitude": (0.0, -1e3, 1e3),
    "v_north": (20.0, 0.0, -80.0, 150.0, 1e3),
    "v_east": (0.0, 1e3),
    "climb": (0.0, 30.0, -1e3),
    "beta": (0.0, 0.3, -3.0),
}
CALM = 4  # of five values of a pose are calm, so that more than the first check is reached
POSES = st.fixed_dictionaries(
    {name: st.sampled_from([values[0]] * CALM + [*values]) for name, values in EDGES.items()}
)
# Share of the trim speed by which V is off, and further outputs, rad/s.
AIRSPEEDS = st.sampled_from([0.0, 0.02, -0.1, -0.3, -0.5, -0.9, -1.0, -1.5, 40.0])
RATES = st.sampled_from([0.0, 0.01, 0.1, -0.1, 1e-9, 3.0, -1e3])
REACHES = st.sampled_from([UNKNOWN, 0.0, 1e-3, 0.5])


@pytest.mark.parametrize("name", [*FLIGHTS])
@given(data=st.data())
@settings(max_examples=40, deadline=None)
def test_any_finite_y_and_pose_give_a_finite_u_m_and_no_failed_step(
    name: str, data: st.DataObject
) -> None:
    """Authorities are learned, and the pose or y is late or lost."""
    section = FLIGHTS[name].guidance
    assert section is not None
    made = Guidance(section)
    t_ns = 0
    for k in range(6):
        t_ns += made.period_ns * data.draw(st.sampled_from([1, 1, 1, 40]))
        pose = data.draw(POSES)
        V = data.draw(AIRSPEEDS) * section.speed
        y = [V if channel == "V" else data.draw(RATES) for channel in section.outputs]
        try:
            if data.draw(st.sampled_from([True] * 5 + [False])):
                made.take_pose(StampedVector(t_ns, np.array([pose[c] for c in POSE])), t_ns)
            made.take_y(StampedVector(t_ns, np.array(y)), t_ns)
        except ChannelError:
            continue
        if k == 3 and section.drag is None:
            reaches = {f"{side}.{c}": data.draw(REACHES) for side in SIDES for c in "qpV"}
            made.take_authority({c: reaches.get(c, UNKNOWN) for c in AUTHORITY})
        output = made.step(t_ns, t_ns)
        assert made.failed == 0
        assert output is None or np.isfinite(output.u_m).all()


# A fault that takes the speed, in a fence


def test_lost_speed_in_a_fence_ends_with_an_outcome_and_a_report() -> None:
    """The airspeed falls below 1.1 V_s, so that no bank is left for the turn at the fence."""
    scenario = calm(8.0, fence=WIDE)
    faults = ["thrust hard_over 3 lower"]
    actuators = scenario.aircraft.actuators.model_dump() | {"faults": faults}
    scenario = scenario.vary(aircraft={"actuators": actuators})
    tape = simulate(scenario)
    section = scenario.guidance
    assert section is not None
    log = tape["guidance"]
    stall = section.params().limits.stall_speed
    assert (section.speed + log["y.V"]).min() < 1.1 * stall
    assert tape.outcome == COMPLETED
    sentence = judge(tape.outcome, tape, scenario, account(tape, scenario, tape.outcome))
    assert sentence.status == 4, "the airspeed is far below its command"
    assert log["failed"].max() == 0
    replayed = replay_guidance(tape, section)
    assert replayed.is_equal()
    assert replayed.checked == replayed.steps


# Steps that fail


class _Failing:
    """A `guidance.step` that fails at given instants. It raises an error, or returns NaN."""

    def __init__(self, kind: str, *failing_ns: range) -> None:
        self._kind = kind
        self._failing = failing_ns
        self._step = module.step

    def __call__(self, state: Any, inputs: Any, *further: Any) -> Any:
        after, commands = self._step(state, inputs, *further)
        if not any(inputs.t_ns in span for span in self._failing):
            return after, commands
        if self._kind == "raises":
            raise IndexError("index -2147483648\nis out of bounds")
        return after._replace(u_m=(math.nan, *after.u_m[1:])), commands


MS = 1_000_000  # ns
CAUSE = "IndexError index -2147483648 is out of bounds"


def test_step_that_fails_leaves_last_u_m_and_next_is_tried(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Three steps of a turn are not finite, and one step 20 s later.

    Both failures are told and counted.
    """
    scenario = calm(28.0, program={"course": {"start": [1.0], "value": [1.0]}})
    section = scenario.guidance
    assert section is not None
    first = range(2000 * MS, 2060 * MS)
    later = range(26_000 * MS, 26_020 * MS)
    with monkeypatch.context() as patch:
        patch.setattr(module, "step", _Failing("is not finite", first, later))
        tape = simulate(scenario)
    log, u_m = tape["guidance"], tape["u_m"]
    at = np.flatnonzero(np.diff(log["failed"], prepend=0.0) > 0.0)
    assert (log.stamp_ns[at] // MS).tolist() == [2000, 2020, 2040, 26_000]
    assert np.isfinite(u_m.values).all()
    assert np.array_equal(u_m.stamp_ns, log.stamp_ns)  # u_m goes on in every period
    assert (u_m.values[at[0] : at[2] + 1] == u_m.values[at[0] - 1]).all()
    assert (u_m.values[at[2] + 1] != u_m.values[at[2]]).any()
    notices = [text for text in guidance_notices(tape, section) if "failed" in text]
    said = "a step of guidance failed, the last u_m is repeated"
    assert notices == [f"guidance at t = {t} s: {said}" for t in ("2.0", "26.0")]
    assert summarise(tape)["guidance"]["failed"] == 4
    replayed = replay_guidance(tape, section)
    assert replayed.is_equal()
    assert replayed.checked == replayed.steps
    assert replayed.notes == ("4 steps of guidance failed: the last u_m went on",)
    # A u_m that did not go on is found.
    changed = u_m.values.copy()
    changed[at[1], 0] += 1e-9
    signals = {**tape.signals, "u_m": replace(u_m, values=changed)}
    assert replay_guidance(replace(tape, signals=signals), section).differing == 1


def banked(section: dict[str, Any]) -> Guidance:
    """Return guidance of an osprey in a bank, before its first step."""
    own = {"natural_frequency": [4.0, 1.2, 5.0, 4.0], "speed": 25.0}
    return Guidance(GuidanceConfig.validate_mapping(own | section, "guidance"))


def _feed(made: Guidance, t_ns: int) -> Any:
    """Make a step with a pose and a y of its instant."""
    pose = dict.fromkeys(POSE, 0.0) | {"north": 25e-9 * t_ns, "v_north": 25.0, "phi": 0.1}
    made.take_pose(StampedVector(t_ns, np.array([pose[name] for name in POSE])), t_ns)
    made.take_y(StampedVector(t_ns, np.zeros(4)), t_ns)
    return made.step(t_ns, t_ns)


def test_steps_that_fail_for_longer_than_the_age_limit_leave_no_u_m(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Without u_m the reference model levels the wings.

    Guidance says why, and begins again.
    """
    made = banked({"max_age": 0.2})
    monkeypatch.setattr(module, "step", _Failing("raises", range(1000 * MS, 5000 * MS)))
    outputs = {k: _feed(made, 20 * k * MS) for k in range(300)}
    held = [k for k in range(50, 250) if outputs[k] is not None]
    assert held == [*range(50, 60)]  # 0.2 s after the last step that did not fail, at 49
    said = [notice for k in held for notice in outputs[k].notices]
    assert said == [f"a step of guidance failed, the last u_m is repeated: {CAUSE}"]
    assert made.failed == 200
    assert outputs[250].u_m is not None
    assert made.mode is GuidanceMode.ENGAGED
    log = dict(zip(made.names, outputs[250].log.tolist(), strict=True))
    assert log["begin"] == Begin.AGAIN


def test_reason_of_failed_steps_is_said_where_no_u_m_comes(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The first step already fails, so there is no u_m that could be kept."""
    made = banked({})
    monkeypatch.setattr(module, "step", _Failing("raises", range(5000 * MS)))
    assert all(_feed(made, 20 * k * MS) is None for k in range(150))
    assert str(made.reason_to_wait(149 * 20 * MS)) == f"no u_m: a step of guidance failed: {CAUSE}"


def test_command_of_a_step_that_failed_waits_for_the_next(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    made = banked({})
    monkeypatch.setattr(module, "step", _Failing("raises", range(1000 * MS, 1060 * MS)))
    for k in range(50):
        _feed(made, 20 * k * MS)
    made.take_target({"climb": 1.5})
    for k in range(50, 53):
        _feed(made, 20 * k * MS)
        assert made.state is not None
        assert made.state.target.climb == 0.0
    _feed(made, 20 * 53 * MS)
    assert made.state is not None
    assert made.state.target.climb == 1.5


def test_pose_with_nan_refused() -> None:
    made = banked({})
    pose: FloatArray = np.full(len(POSE), np.nan)
    with pytest.raises(ChannelError, match="a value of nan"):
        made.take_pose(StampedVector(0, pose), 0)


AUTHORITIES = (0.0, 1e-9, 0.3, 10.0, UNKNOWN)  # rad/s^2 and m/s^2
MULTICOPTER = REPOSITORY / "examples" / "hexarotor" / "hexarotor_square.yaml"


def _fly(made: Guidance, k: int, altitude: float = 0.0, north: float = 0.0) -> Any:
    """Make a step of a slow motion, for an airplane or a multicopter."""
    t_ns = k * made.period_ns
    pose = dict.fromkeys(POSE, 1e-6 * k) | {"north": north, "altitude": altitude, "v_north": 3.0}
    made.take_pose(StampedVector(t_ns, np.array([pose[name] for name in POSE])), t_ns)
    made.take_y(StampedVector(t_ns, np.full(len(made._params.outputs), 1e-6 * k)), t_ns)
    return made.step(t_ns, t_ns)


def _section(kind: str, **changes: Any) -> GuidanceConfig:
    section = find_scenario(str(MULTICOPTER) if kind == "multicopter" else "osprey_route").guidance
    assert section is not None
    values = section.model_dump(exclude_unset=True) | changes
    return GuidanceConfig.validate_mapping(values, "guidance")


@pytest.mark.parametrize("kind", ["multicopter", "airplane"])
@pytest.mark.parametrize("authority", AUTHORITIES)
def test_aircraft_flies_home_whatever_authority_is_learned(kind: str, authority: float) -> None:
    """The aircraft also flies home by itself when the link is lost.

    An exception would make every step fail then.
    """
    made = Guidance(_section(kind, home={"link_timeout": 0.5}))
    for k in range(5):
        _fly(made, k)
    made.take_authority(dict.fromkeys(AUTHORITY, authority))
    assert made.home()
    assert made.hold()
    assert all(_fly(made, k) is not None for k in range(5, 100))
    assert made.failed == 0
    assert made.state is not None
    assert made.state.target.altitude == 0.0


@pytest.mark.parametrize("kind", ["multicopter", "airplane"])
@pytest.mark.parametrize("service", ["home", "hold", "lost link"])
@pytest.mark.parametrize("altitude, expected", [(900.0, 120.0), (-300.0, -20.0), (50.0, 50.0)])
def test_aircraft_beyond_its_altitudes_goes_to_the_nearest_permitted_one(
    kind: str, service: str, altitude: float, expected: float
) -> None:
    """An updraught may carry the aircraft beyond its altitudes.

    Then guidance may not command the present altitude.
    """
    changes: dict[str, Any] = {"ceiling": 120.0, "altitude_floor": -20.0}
    changes["home"] = {"link_timeout": 0.5}
    made = Guidance(_section(kind, **changes))
    made.keep_link()
    for k in range(5):
        _fly(made, k, altitude)
    if service != "lost link":
        assert getattr(made, service)()
    steps = range(5, 100 if service == "lost link" else 10)
    assert all(_fly(made, k, altitude) is not None for k in steps)
    assert made.failed == 0
    assert made.state is not None
    assert made.state.target.altitude == expected
