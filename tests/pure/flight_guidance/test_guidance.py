# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test the equations of guidance by closed forms: attitude, altitude, course, paths, protection."""

import math

import numpy as np
import pytest
from numpy.polynomial import Polynomial
from pytest import approx
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation
from tests.conftest import refusing

from flight_core.channels import POSE
from flight_core.units import GRAVITY
from flight_core.vectors import FloatArray
from flight_guidance.guidance_state import Vertical
from flight_guidance.modes import modes
from flight_guidance.params import GuidanceConfig
from flight_guidance.steering import path, protection
from flight_guidance.steering.attitude import AttitudeParams, body_rates
from flight_guidance.steering.lateral import (
    PathError,
    PathParams,
    bank_for,
    course_acceleration,
    heading_estimate,
    least_period,
    least_radius,
    path_acceleration,
    slip_estimate,
)
from flight_guidance.steering.path import Arc, Line
from flight_guidance.steering.vertical import (
    VerticalParams,
    alpha_estimate,
    climb_for,
    path_lag,
    pitch_for,
    slewed,
)

SPEED = 40.0  # m/s
HOLD = AttitudeParams(k_phi=1.25, k_theta=1.0, roll_rate=0.3, load=0.5, n_alpha=1e9, k_beta=0.0)
CLIMB = VerticalParams(k_h=0.2, acceleration=1.0, climb=5.0, sink=4.0, alpha_time=2.0)
FOLLOW = PathParams(period=20.0, damping=0.75, capture=math.radians(30.0))


def loop_damping(gain: float, frequency: float, damping: float) -> float:
    """Return the damping of the slow poles of phi_dot = p.

    p is a second-order filter of gain (phi_c - phi).
    """
    poles = Polynomial([frequency**2 * gain, frequency**2, 2.0 * damping * frequency, 1.0]).roots()
    return float(np.min(-np.real(poles) / np.abs(poles)))


def test_bank_loop_has_damping_0_74() -> None:
    """The gain is a quarter of the bandwidth of p, which gives a damping of 0.74."""
    # Known values of the same cubic: 0.48 with k = 2, 0.31 with 3, unstable from 2 zeta w = 9 on
    # (Hurwitz).
    assert loop_damping(5.0 / 4.0, 5.0, 0.9) == approx(0.74, abs=0.01)
    assert loop_damping(2.0, 5.0, 0.9) == approx(0.48, abs=0.01)
    assert loop_damping(9.0, 5.0, 0.9) == approx(0.0, abs=1e-9)


@pytest.mark.parametrize("phi", [-0.9, 0.0, 0.5])
def test_held_bank_gives_level_turn_rates(phi: float) -> None:
    turn = GRAVITY * math.tan(phi) / SPEED
    rates = body_rates(phi, 0.0, phi, 0.0, turn * math.cos(phi), 0.0, SPEED, HOLD)
    assert rates == approx((0.0, turn * math.sin(phi), turn * math.cos(phi)), abs=1e-15)


def test_commanded_rates_turn_attitude_at_commanded_rates() -> None:
    # With r as commanded, a rotation by the body rates changes (phi, theta) by k times the errors
    # and psi by the level turn.
    phi, theta, phi_c, theta_c = 0.4, 0.1, 0.5, 0.15
    turn = GRAVITY * math.tan(phi) / SPEED
    r = turn * math.cos(phi) * math.cos(theta) - HOLD.k_theta * (theta_c - theta) * math.sin(phi)
    rates = body_rates(phi_c, theta_c, phi, theta, r, 0.0, SPEED, HOLD)
    dt = 1e-6
    assert rates.r == approx(r, rel=1e-12)
    after = Rotation.from_euler("ZYX", [0.0, theta, phi]) * Rotation.from_rotvec(
        np.array(rates) * dt
    )
    psi_after, theta_after, phi_after = after.as_euler("ZYX")
    assert (phi_after - phi) / dt == approx(HOLD.k_phi * (phi_c - phi), abs=1e-6)
    assert (theta_after - theta) / dt == approx(HOLD.k_theta * (theta_c - theta), abs=1e-6)
    assert psi_after / dt == approx(turn, abs=1e-6)


def test_roll_rate_and_load_are_limited() -> None:
    rates = body_rates(1.0, 1.0, 0.0, 0.0, 0.0, 0.0, SPEED, HOLD)
    assert (rates.p, rates.q) == approx((0.3, 0.5 * GRAVITY / SPEED))


def test_yaw_rate_leads_the_bank() -> None:
    led = HOLD._replace(turn_lead=0.5)
    ahead = 0.5 * HOLD.k_phi * 0.1
    flat = body_rates(0.1, 0.0, 0.0, 0.0, 0.0, 0.0, SPEED, led)
    assert flat.r == approx(GRAVITY * math.sin(ahead) / SPEED)


def test_sideslip_to_right_turns_nose_right() -> None:
    assert body_rates(0.0, 0.0, 0.0, 0.0, 0.0, 0.1, SPEED, HOLD._replace(k_beta=1.0)).r == approx(
        0.1
    )


def test_climb_rate_is_smooth_and_brakes() -> None:
    """The climb rate is continuous in value and slope, and decreases by half the acceleration."""
    free = CLIMB._replace(climb=1e3, sink=1e3)
    near = 1.0 / (2.0 * 0.2**2)
    step = 1e-6
    assert climb_for(near - step, free) == approx(climb_for(near + step, free), abs=1e-6)
    slope = (climb_for(near + 2.0 * step, free) - climb_for(near + step, free)) / step
    assert slope == approx(0.2, abs=1e-4)
    far = 100.0  # d(climb)/dt = -climb d(climb)/de = -a/2
    assert climb_for(far, free) * (
        climb_for(far + step, free) - climb_for(far, free)
    ) / step == approx(0.5, abs=1e-4)
    assert climb_for(-far, free) == -climb_for(far, free)
    assert (climb_for(far, CLIMB), climb_for(-far, CLIMB)) == (5.0, -4.0)


@pytest.mark.parametrize("stall_speed", [20.0, 60.0, 121.9, 133.0])
def test_altitude_loop_keeps_margin(stall_speed: float) -> None:
    """The altitude loop has a gain margin of 2.5 although the flight path lags the pitch."""
    # theta = gamma_c + low-pass of (theta - gamma), T_L gamma_dot = theta - gamma, h_dot = V gamma.
    # JSBSim's f16 at 154 m/s and 12 km, V_s = 121.9 m/s, fell into a limit cycle of 22 s with k_h =
    # 0.2 and T = 2 s.
    frequencies = (4.0, 1.2, 5.0, 4.0)
    loop = (
        GuidanceConfig(natural_frequency=frequencies, speed=154.0, stall_speed=stall_speed)
        .params()
        .vertical
    )
    lag = path_lag(stall_speed, 154.0)
    time = loop.alpha_time
    poles = Polynomial([1.0, time, lag * time]).roots()
    assert np.min(-np.real(poles) / np.abs(poles)) >= 0.5 - 1e-9  # the damping of the flight path
    # A gain margin of 2.5.
    assert np.max(np.real(Polynomial([2.49 * loop.k_h, 1.0, time, lag * time]).roots())) < 0.0


def test_pitch_settles_where_angle_of_attack_estimated() -> None:
    alpha = 0.0
    # 20 s, ten time constants: exp(-10).
    for _ in range(1000):
        alpha = alpha_estimate(alpha, 0.13, 2.0, SPEED, 0.02, CLIMB)
    assert alpha == approx(0.13 - math.asin(2.0 / SPEED), abs=1e-5)
    assert pitch_for(2.0, SPEED, alpha) == approx(0.13, abs=1e-5)
    assert slewed(1.0, 2.0, 0.5, 0.1) == approx(1.05)


def test_course_approached_on_shorter_side() -> None:
    """The course turns to the shorter side, and beyond 90 degrees at the largest rate."""
    # To the right, over south.
    assert course_acceleration(math.radians(-170.0), math.radians(170.0), SPEED, 0.4) > 0.0
    assert course_acceleration(math.radians(135.0), 0.0, SPEED, 0.4) == 0.4 * SPEED
    assert course_acceleration(math.radians(30.0), 0.0, SPEED, 0.4) == approx(0.2 * SPEED)
    assert bank_for(GRAVITY, 0.0, 1.0) == approx(math.pi / 4.0)
    assert bank_for(-1e3, 0.0, 0.6) == -0.6


def cross_track(e_0: float, times: FloatArray) -> FloatArray:
    """Return the cross-track error of a point with the acceleration of `path_acceleration`.

    It flies beside a line to the north.
    """

    def derivative(_: float, z: FloatArray) -> list[float]:
        e, course = z
        a = path_acceleration(PathError(float(e), 0.0, 0.0), float(course), SPEED, FOLLOW)
        return [SPEED * math.sin(course), a / SPEED]

    solution = solve_ivp(
        derivative, (0.0, times[-1]), [e_0, 0.0], t_eval=times, rtol=1e-9, atol=1e-9, max_step=0.5
    )
    return np.asarray(solution.y[0])


def test_error_near_line_is_second_order() -> None:
    # e'' + 2 zeta w e' + w^2 e = 0, w = 2 pi / P, from rest: its closed solution. 0.1 m is 1/6000
    # of v_g P zeta.
    times = np.linspace(0.0, 40.0, 81)
    zeta = 0.75
    w = 2.0 * math.pi / 20.0
    damped = w * math.sqrt(1.0 - zeta**2)
    exact = np.exp(-zeta * w * times) * (
        np.cos(damped * times) + zeta * w / damped * np.sin(damped * times)
    )
    assert cross_track(0.1, times) / 0.1 == approx(exact, abs=2e-3)


def test_line_captured_from_far_at_capture_angle() -> None:
    times = np.linspace(0.0, 200.0, 401)
    e = cross_track(2000.0, times)
    assert np.diff(e)[100] / 0.5 == approx(-SPEED * math.sin(FOLLOW.capture), rel=1e-3)
    assert abs(e[-1]) < 0.01
    # No limit cycle, small overshoot.
    assert e.min() > -0.05 * SPEED * FOLLOW.period * FOLLOW.damping


@pytest.mark.parametrize("away", [180.0, 179.9, -179.0, 170.0])
def test_opposite_course_gives_largest_turn(away: float) -> None:
    """On the opposite course, an aircraft turns with the largest acceleration."""
    full = 4.0 * math.pi * FOLLOW.damping / FOLLOW.period * SPEED
    turn = path_acceleration(PathError(0.0, 0.0, 0.0), math.radians(away), SPEED, FOLLOW)
    # A sine would leave 0.2 % of it at 179.9 deg.
    assert turn == approx(math.copysign(full, -away), rel=1e-9)


@pytest.mark.parametrize("radius", [300.0, -300.0])
def test_acceleration_on_circle_is_centripetal(radius: float) -> None:
    """On a circle the acceleration is centripetal, and it reduces an offset."""
    orbit = Arc((0.0, 0.0), radius)
    # To the north of the centre: east on a right turn, west on a left one.
    on = path.error(orbit, (300.0, 0.0))
    assert on == approx((0.0, math.copysign(math.pi / 2.0, radius), 1.0 / radius))
    assert path_acceleration(on, on.track, SPEED, FOLLOW) == approx(SPEED**2 / radius)
    outside = path.error(orbit, (320.0, 0.0))
    assert outside.e == approx(-math.copysign(20.0, radius))
    assert abs(path_acceleration(outside, outside.track, SPEED, FOLLOW)) > SPEED**2 / 320.0


def offset_from_a_circle(*, estimated: bool) -> float:
    """Return how much larger the flown radius is than the commanded one, m, with a slip.

    The slip makes the aircraft turn by a tenth less than its bank would.
    """
    speed, radius, dt = 50.0, 800.0, 0.05
    north = 0.0
    east = -radius
    course = 0.0
    slip = 0.0
    params = PathParams(20.0, 0.75, 0.5)
    for _ in range(6000):
        error = path.error(Arc((0.0, 0.0), radius), (north, east))
        phi = bank_for(path_acceleration(error, course, speed, params) + slip, 0.0, 1.0)
        course_dot = 0.9 * GRAVITY * math.tan(phi) / speed
        if estimated:
            slip = slip_estimate(slip, GRAVITY * math.tan(phi), speed * course_dot, 0.0, dt, 2.0)
        middle = course + dt * course_dot / 2.0
        north = north + dt * speed * math.cos(middle)
        east = east + dt * speed * math.sin(middle)
        course += dt * course_dot
    return math.hypot(north, east) - radius


def test_aircraft_that_slips_flies_on_circle() -> None:
    # Without the estimate e'' + 2 zeta w e' + w^2 e = 0.1 V^2 / R near the circle: an offset of 3.2
    # m; measured 3.5 m.
    assert offset_from_a_circle(estimated=False) == approx(
        0.1 * 50.0**2 / 800.0 / (2.0 * math.pi / 20.0) ** 2, rel=0.15
    )
    # m, of the integration in steps of 50 ms.
    assert abs(offset_from_a_circle(estimated=True)) < 0.01


def test_roll_is_no_sideslip() -> None:
    """In a roll the turn lags the bank, and the estimate of the sideslip is kept."""
    assert slip_estimate(0.5, 4.0, 0.0, 0.2, 0.02, 2.0) == 0.5
    assert slip_estimate(0.5, 4.0, 0.0, 0.1, 0.02, 2.0) == approx(
        0.5 + 0.5 * 3.5 * (1.0 - math.exp(-0.01)), rel=1e-12
    )


def test_gyro_bias_is_no_sideslip() -> None:
    """In straight flight, a bias of the gyro of r causes no sideslip estimate."""
    # R reads 1 mrad/s too much at 154 m/s: unbounded, 0.15 m/s^2 would hold the aircraft 6.5 m
    # beside a leg.
    slip = 0.0
    for _ in range(1000):
        slip = slip_estimate(slip, 0.0, 0.154, 0.0, 0.02, 2.0)
    assert slip == 0.0
    # A fifth of the turn of a bank to the left.
    assert slip_estimate(1.0, -2.0, -1.0, 0.0, 0.02, 2.0) == approx(0.4)


def test_heading_is_smoothed_without_lag_across_180_deg() -> None:
    """The time constant is 2 s, at 50 Hz.

    A low-pass reduces the sigma of white noise by sqrt(g / (2 - g)) with g = 1 - exp(-dt/T), from 1
    to 0.07 deg.
    """
    dt = 0.02
    noise = np.random.default_rng(1).normal(0.0, math.radians(1.0), 5000)
    psi = math.radians(170.0)
    off = []
    for k, error in enumerate(noise.tolist()):
        true = math.radians(170.0) + 0.06 * dt * (k + 1)  # a turn of 0.06 rad/s
        psi = heading_estimate(psi, math.remainder(true + error, 2.0 * math.pi), 0.06, dt)
        off.append(math.degrees(math.remainder(psi - true, 2.0 * math.pi)))
    g = 1.0 - math.exp(-dt / 2.0)
    assert np.std(off) == approx(math.sqrt(g / (2.0 - g)), rel=0.3)  # 50 independent values
    assert abs(np.mean(off)) < 0.05
    # A gyro that is 1 mrad/s off turns the heading by 2 mrad; without a pose it alone counts.
    held = 0.0
    for _ in range(2000):
        held = heading_estimate(held, 0.0, 1e-3, dt)
    assert held == approx(2e-3, rel=0.02)
    assert heading_estimate(0.1, None, 1.0, dt) == approx(0.12)


def test_error_of_line_is_positive_to_right() -> None:
    east = Line((0.0, 0.0), (0.0, 1000.0))
    assert path.error(east, (-7.0, 400.0)) == approx((7.0, math.pi / 2.0, 0.0))
    assert not path.is_passed(east, (50.0, 999.0))
    assert path.is_passed(east, (50.0, 1001.0))


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_a_fillet_touches_both_legs(side: float) -> None:
    corner = [(0.0, 0.0), (1000.0, 0.0), (1000.0, side * 1000.0), (3000.0, side * 1000.0)]
    first, arc, second, *_, orbit = path.route(corner, 200.0, 100.0)
    assert isinstance(arc, Arc)
    assert isinstance(orbit, Arc)
    assert first.end == approx((800.0, 0.0))  # a right angle cuts one radius
    assert arc.centre == approx((800.0, side * 200.0))
    assert arc.radius == side * 200.0
    assert arc.end == approx((1000.0, side * 200.0))
    assert isinstance(second, Line)
    assert second.start == approx(arc.end)
    assert path.course_of(second.start, second.end) == approx(side * math.pi / 2.0)
    assert path.error(arc, (800.0, 0.0)) == approx((0.0, 0.0, side / 200.0), abs=1e-12)
    assert path.end_course(arc) == approx(side * math.pi / 2.0)
    assert (orbit.centre, orbit.end) == (corner[3], None)
    assert not path.is_passed(orbit, (0.0, 0.0))


@pytest.mark.parametrize(
    "waypoints, radius, sentence",
    [
        ([(0.0, 0.0)], 200.0, "route: found 1 waypoints, expected two or more"),
        ([(0.0, 0.0), (1000.0, 0.0)], 90.0, "guidance.radius: found 90 m, expected at least 100 m"),
        (
            [(0.0, 0.0), (150.0, 0.0), (150.0, 900.0)],
            200.0,
            r"route\[1\]: found 150 m .* expected more than 200 m",
        ),
        (
            [(0.0, 0.0), (900.0, 0.0), (900.0, 300.0), (0.0, 300.0)],
            200.0,
            r"route\[2\]: found 300 m .* more than 400 m",
        ),
    ],
)
def test_infeasible_route_refused_with_mend(
    waypoints: list[tuple[float, float]], radius: float, sentence: str
) -> None:
    """The sentence names a value with which the route can be flown."""
    with refusing(sentence):
        path.route(waypoints, radius, 100.0)


def test_rules_of_radius_and_period() -> None:
    bank = math.radians(30.0)
    # A circle of the least radius asks for 0.8 of the bank at the speed with the wind from behind.
    assert math.atan(56.0**2 / (GRAVITY * least_radius(46.0, 10.0, bank))) == approx(0.8 * bank)
    assert least_period(46.0, bank, 0.15) == approx(9.3 * bank / 0.15)
    assert least_period(25.0, bank, 1.0) == 14.0


def test_protection_follows_from_the_stall_speed() -> None:
    assert protection.bank_limit(1.2, 25.0, 40.0) == approx(math.acos((27.5 / 40.0) ** 2))
    assert protection.bank_limit(0.5, 25.0, 60.0) == 0.5
    assert protection.bank_limit(0.5, 25.0, 27.0) == 0.0  # below 1.1 V_s: wings level
    floor = protection.speed_floor(20.0)
    assert floor == approx(23.0)
    assert protection.climb_limit(4.0, 3.0, 30.0, floor) == 4.0
    assert protection.climb_limit(4.0, 3.0, 0.95 * floor, floor) == approx(0.5)
    assert protection.climb_limit(4.0, 3.0, 0.8 * floor, floor) == -3.0


@pytest.mark.parametrize("command", [{"climb": 3.0}, {"theta": 0.2}, {"altitude": 300.0}])
def test_ceiling_holds_in_every_vertical_mode(command: dict[str, float]) -> None:
    """A point mass that climbs as commanded reaches the ceiling and stays below it."""
    section = GuidanceConfig(natural_frequency=(4.0, 1.2, 5.0, 4.0), speed=SPEED, ceiling=300.0)
    params = section.params()
    altitude = 250.0
    dt = 0.02
    pose = {**dict.fromkeys(POSE, 0.0), "altitude": altitude, "v_north": SPEED}
    state = modes.holding(0, pose, SPEED, params)
    vertical = {"climb": Vertical.CLIMB, "theta": Vertical.THETA, "altitude": Vertical.ALTITUDE}[
        next(iter(command))
    ]
    state = state._replace(vertical=vertical, target=state.target._replace(**command))
    highest = altitude
    for _ in range(3000):
        state, commands = modes.command(
            state, pose, dict.fromkeys(section.outputs, 0.0), 0.0, dt, params
        )
        climb = SPEED * math.sin(commands.theta_c - state.alpha)
        altitude += dt * climb
        pose = pose | {"altitude": altitude, "climb": climb, "theta": commands.theta_c}
        state = state._replace(theta=commands.theta_c)
        highest = max(highest, altitude)
    assert highest < 300.1
    assert altitude == approx(300.0, abs=0.5)
