# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Parameters of guidance.

What is left out follows by rule from the reference model, the throttle and the speeds.
"""

import math
from collections.abc import Sequence
from functools import partial
from typing import Annotated, Any, Literal

import numpy as np

from flight_core.channels import RATES_AND_SPEED, WITHOUT_RUDDER, vertical
from flight_core.fields import Field
from flight_core.parameters import (
    Names,
    NodeConfig,
    NonNegative,
    Number,
    Numbers,
    Positive,
    Positives,
    require,
    require_length,
)
from flight_core.rates import nanoseconds, period_ns
from flight_core.units import GRAVITY
from flight_guidance import reach
from flight_guidance.feasibility import Performance, as_route, flyable, require_inside, speeds
from flight_guidance.fence.fence import MARGIN, Motion, room_at_home
from flight_guidance.fence.zones import Fence, Zone, clearance, described
from flight_guidance.guidance_state import (
    MULTICOPTER,
    TARGETS,
    GuidanceParams,
    Home,
    Limits,
    MulticopterParams,
)
from flight_guidance.modes.landing import Lander, Landing, landing_at
from flight_guidance.modes.targets import reach_sentence, read_target
from flight_guidance.multicopter import multicopter_rules
from flight_guidance.multicopter.multicopter_rules import route_through
from flight_guidance.notices import Notices
from flight_guidance.routes.route_file import Waypoint
from flight_guidance.sections import HomeConfig, LandingConfig, RouteConfig, Steps, ZoneConfig
from flight_guidance.steering import protection
from flight_guidance.steering.attitude import AttitudeParams
from flight_guidance.steering.lateral import PathParams, largest_wind, least_period, least_radius
from flight_guidance.steering.path import Route
from flight_guidance.steering.vertical import VerticalParams, path_lag

BY_RULE = ("outputs", "natural_frequency", "speed", "throttle_authority", "roll_authority")
FLOOR_FRACTION = 0.8
"""Speed floor over the trim speed where no stall speed is known."""

FASTEST_ROLL = 0.35
"""rad/s, 20 deg/s."""

ALTITUDE_GAIN = 0.2
ALPHA_TIME = 2.0
"""1/s and s, for a flight path that follows the pitch within two seconds."""

TURN_LEAD = 2.4
"""r leads the bank by this over the frequency of the reference model of r: 1.8 is the lag of the
model with a damping of 0.9, the rest that of the sideslip in a roll of the osprey."""

RUDDERLESS = 1.5
"""Factor on the period without rudder: no lead makes up for the lag of the turn. The X8 cycled with
the period of an aircraft with rudder, and not with 1.4 times that."""

STEEPEST = 0.1
"""Largest climb and sink rate over the trim speed."""


class GuidanceConfig(NodeConfig):
    """Parameters of the guidance node."""

    rate: Annotated[float, Field(ge=1, le=1000)] = Field(
        default=50.0, description="the rate at which u_m is published, Hz"
    )
    start_time: float = Field(
        default=0.0,
        ge=-1,
        le=1e10,
        description="system time of t = 0, s since the epoch; 0: at once; -1: by the topic `start`",
    )
    y_rate: float = Field(default=0.0, ge=0, le=1000, description="in lockstep: the rate of y, Hz")
    authority_rate: float = Field(
        default=0.0, ge=0, le=1000, description="rate of `authority`, Hz; 0: of no learner"
    )
    outputs: Names = Field(default=RATES_AND_SPEED, description="the commands u_m in any order")
    natural_frequency: Positives = Field(
        description="those of the reference model, rad/s; `parameters.yaml` of a run has them"
    )
    speed: Positive = Field(description="the trim speed V0, m/s: airspeed is speed + V")
    throttle_authority: tuple[Positive, ...] = Field(
        default=(), description="deceleration and acceleration by throttle from trim, m/s^2"
    )
    roll_authority: Positive | None = Field(
        default=None, description="roll acceleration of full aileron, rad/s^2"
    )
    stall_speed: Positive | None = Field(default=None, description="V_s, true airspeed, m/s")
    speed_limit: Positive | None = Field(default=None, description="largest true airspeed, m/s")
    ceiling: Number | None = Field(default=None, description="largest altitude, m, as `pose`")
    altitude_floor: Number | None = Field(default=None, description="least altitude, m, as `pose`")
    wind: NonNegative = Field(default=0.0, description="the largest wind, m/s")
    drag: Positive | None = Field(
        default=None,
        description="of a multicopter: g tan(tilt) / V in steady flight, 1/s; none: an airplane",
    )

    bank: Annotated[float, Field(gt=0, le=math.radians(60.0))] = Field(
        default=math.radians(30.0), description="largest bank phi_max, rad"
    )
    roll_rate: Positive | None = Field(
        default=None,
        description="largest rate of the bank p_max, rad/s",
    )
    load: Positive = Field(default=0.3, description="largest change of the load factor by pitch, 1")
    pitch: Annotated[Numbers, Field(min_length=2, max_length=2)] = Field(
        default=(math.radians(-15.0), math.radians(25.0)),
        description="least and largest pitch, rad",
    )
    climb: Positive | None = Field(default=None, description="largest climb rate, m/s")
    sink: Positive | None = Field(default=None, description="largest sink rate, m/s")
    acceleration: Positive = Field(
        default=1.0, description="permitted vertical acceleration, m/s^2"
    )
    altitude_gain: Positive | None = Field(
        default=None, description="k_h, climb rate per altitude error, 1/s"
    )
    alpha_time: Positive | None = Field(
        default=None, description="time constant of the estimated angle of attack, s"
    )
    sideslip_gain: NonNegative | None = Field(
        default=None, description="k_beta, 1/s, with beta in `pose`"
    )
    period: Positive | None = Field(default=None, description="period of path following, s")
    damping: Annotated[float, Field(ge=0.5, le=1.0)] = Field(
        default=0.8, description="damping of path following, 1"
    )
    capture: Annotated[float, Field(gt=0, le=math.pi / 2.0)] = Field(
        default=math.radians(60.0), description="largest angle at which a path is approached, rad"
    )
    radius: Positive | None = Field(
        default=None, description="radius of fillets and of the last orbit, m"
    )
    profile: Literal["slope", "step"] = Field(
        default="slope", description="altitude changes along a leg, or at its begin"
    )
    max_age: Annotated[float, Field(gt=0, le=1e6)] = Field(
        default=0.2, description="the age at which y and pose are stale, s"
    )
    hold: Annotated[float, Field(ge=0, le=1e6)] = Field(
        default=10.0, description="how long dead reckoning replaces a stale pose, s"
    )
    origin: Annotated[Numbers, Field(min_length=3, max_length=3)] | None = Field(
        default=None,
        description="latitude, longitude (deg) and height above WGS84 (m) of the origin",
    )
    program: dict[str, Steps] = Field(default={}, description="targets over flight time by channel")
    route: RouteConfig | None = Field(
        default=None, description="the route, flown from the start on"
    )
    fence: dict[str, ZoneConfig] = Field(
        default={}, description="zones to stay in or to keep out of"
    )
    touchdown: ZoneConfig | None = Field(
        default=None, description="where a landing is to touch down; none: anywhere"
    )
    landing: LandingConfig | None = Field(
        default=None, description="a landing at a waypoint of the route"
    )
    home: HomeConfig = Field(
        default=HomeConfig(),
        description="where the aircraft goes at a fence",
    )

    def _check(self) -> None:
        period_ns(self.rate, "rate")
        climbs = vertical(self.outputs)
        expected = ("p", "q", "r", climbs) if climbs else RATES_AND_SPEED
        require(
            sorted(self.outputs) == sorted(expected)
            or (not climbs and sorted(self.outputs) == sorted(WITHOUT_RUDDER)),
            "outputs",
            ", ".join(self.outputs),
            f"{', '.join(RATES_AND_SPEED)}, or without r",
        )
        drag = "g tan(tilt) / V of a steady flight, 1/s" if climbs else "none: an airspeed is flown"
        require((self.drag is not None) == bool(climbs), "drag", self.drag, drag)
        require_length("natural_frequency", self.natural_frequency, self.outputs)
        if self.throttle_authority:
            require(
                len(self.throttle_authority) == 2,
                "throttle_authority",
                self.throttle_authority,
                "two: down and up",
            )
        require(
            self.pitch[0] < self.pitch[1], "pitch", list(self.pitch), "the least before the largest"
        )
        if self.lockstep:
            require(self.y_rate > 0, "y_rate", "0 Hz", "the rate of y in lockstep")
            divides = period_ns(self.rate, "rate") % period_ns(self.y_rate, "y_rate") == 0
            require(
                divides,
                "rate",
                f"{self.rate:g} Hz",
                f"a whole fraction of y_rate ({self.y_rate:g} Hz)",
            )
        lowest, highest = self.altitudes()
        require(
            lowest < highest, "ceiling", f"{highest:g} m", f"more than altitude_floor, {lowest:g} m"
        )
        if self.home.altitude is not None:
            is_between = lowest <= self.home.altitude <= highest
            band = f"{lowest:g} to {highest:g} m, of altitude_floor and ceiling"
            require(is_between, "home.altitude", f"{self.home.altitude:g} m", band)
        if climbs:
            self._check_multicopter()
        else:
            self._check_airplane()
        params = self.params()
        route = None if self.route is None else self.plan(self.waypoints())
        if self.landing is not None:
            require(route is not None, "landing", "no route", "one with its waypoint")
        if route is not None:
            self.landing_on(route)
        for start, target in self.program_steps():
            read_target(target, params, route, f"program at {start:g} s")

    def _check_multicopter(self) -> None:
        """What an airplane alone has, and home inside of the fence."""
        for key in ("stall_speed", "landing", "touchdown", "throttle_authority"):
            require(not getattr(self, key), key, getattr(self, key), "none of a multicopter")
        inside = self.fence_clearance(self.home.north, self.home.east)
        margin = self.fence_margin(self.speed)
        expected = f"at least {margin:.1f} m inside"
        require(inside >= margin, "home", f"home {described(inside)}", expected)

    def _check_airplane(self) -> None:
        floor = self._floor()
        require(
            floor < self.speed,
            "stall_speed",
            f"{self.stall_speed} m/s",
            f"a floor of 1.15 V_s below {self.speed:g} m/s",
        )
        least = math.ceil(self.least_period() * 10.0) / 10.0
        fits = self.period is None or self.period >= least
        rule = f"at least {least:g} s: max(14 s, 1.5 V0 / (g tan(bank)), 9.3 bank / roll_rate)"
        require(fits, "period", f"{self.period} s", rule)
        fastest = self._largest_speed()
        require(
            fastest > self.speed,
            "speed_limit",
            f"{fastest:g} m/s",
            f"more than the trim speed, {self.speed:g} m/s",
        )
        self._check_home()

    def _check_home(self) -> None:
        needed = math.ceil(self.least_radius()) + self.fence_margin(self.speed)
        inside = self.fence_clearance(self.home.north, self.home.east)
        expected = f"at least {needed:.0f} m inside, for the orbit round home"
        require(inside >= needed, "home", f"home {described(inside)}", expected)
        if (fence := self.fence_zones()) is None:
            return
        margin = self.fence_margin(self.speed)
        room = room_at_home(fence, self._at_home(), self.wind)
        if room < margin:
            turn = f"a turn from home onto the orbit that is {described(room)}"
            north, east = fence.home
            wide = Zone((north,), (east,), radius=20.0 * fence.radius)
            left = room_at_home(fence._replace(zones=(wide,)), self._at_home(), self.wind)
            reach = wide.radius - left
            size = f"with home {math.ceil(reach + margin)} m inside every turn fits"
            require(False, "home", turn, f"at least {margin:.0f} m inside; {size}")

    def _at_home(self) -> Motion:
        """The level aircraft over home, with the turns of the fence."""
        params = self.params()
        limits = params.limits
        bank = protection.bank_limit(limits.bank, limits.stall_speed, self.speed)
        lag = 0.5 / params.attitude.k_phi + params.turn_lag
        home = (self.home.north, self.home.east)
        return Motion(*home, 0.0, 0.0, self.speed, (0.0, 0.0), bank, params.attitude.roll_rate, lag)

    def fence_zones(self) -> Fence | None:
        """The fence of the equations; None without zones."""
        zones = tuple(zone.zone() for zone in self.fence.values())
        return (
            Fence(zones, (self.home.north, self.home.east), float(math.ceil(self.least_radius())))
            if zones
            else None
        )

    def fence_clearance(self, north: float, east: float) -> float:
        """Distance of a place from the fence, m, negative outside; infinite without a fence."""
        fence = self.fence_zones()
        return (
            math.inf
            if fence is None
            else float(clearance(fence.zones, np.array(north), np.array(east)))
        )

    def fence_margin(self, speed: float) -> float:
        """Least distance of a route from the fence at an airspeed, m.

        MARGIN of flight with the wind from behind.
        """
        return MARGIN * (speed + self.wind)

    def by_rule(self) -> list[tuple[str, Any]]:
        """Parameters by rule from the remaining sections of a scenario, for parameters left out."""
        return [(name, getattr(self, name)) for name in BY_RULE if getattr(self, name)]

    def _floor(self) -> float:
        return (
            FLOOR_FRACTION * self.speed
            if self.stall_speed is None
            else protection.speed_floor(self.stall_speed)
        )

    def _largest_speed(self) -> float:
        return self.speed_limit or protection.FASTEST * self.speed

    def altitudes(self) -> tuple[float, float]:
        """Least and largest altitude, m."""
        return (
            -math.inf if self.altitude_floor is None else self.altitude_floor,
            math.inf if self.ceiling is None else self.ceiling,
        )

    def largest_roll_rate(self) -> float:
        """Largest roll rate p_max, rad/s.

        0.35, or less where 0.4 w p_max, the largest p_m_dot after a step, is a third of the
        authority.
        """
        frequency = self._frequency()["p"]
        authority = math.inf if self.roll_authority is None else self.roll_authority
        return self.roll_rate or min(FASTEST_ROLL, reach.roll_rate(authority, frequency))

    def k_beta(self) -> float:
        """k_beta = min(0.5, k_chi V0 d / s), 1/s.

        A lateral gust of s = 1.5 m/s turns a held heading by d = 1 deg.
        """
        if self.sideslip_gain is not None:
            return self.sideslip_gain
        k_chi = self._frequency()["p"] / 14.0
        return min(0.5, k_chi * self.speed * math.radians(1.0) / 1.5)

    def least_period(self) -> float:
        """Least period of path following, s."""
        lag = 1.0 if "r" in self.outputs else RUDDERLESS
        return lag * least_period(self.speed, self.bank, self.largest_roll_rate())

    def least_radius(self) -> float:
        """Least radius of fillets and orbits, m."""
        return least_radius(self.speed, self.wind, self.bank)

    def notices(self) -> Notices:
        """What the notices of a flight depend on."""
        link_timeout = self.home.link_timeout or math.inf
        if self.drag is not None:
            strongest = GRAVITY * math.tan(self.bank) / self.drag
            return Notices(
                self.wind,
                self.max_age,
                lambda speed: strongest - speed,
                link_timeout,
                largest_tilt=self.bank,
            )
        reach_of = partial(reach_sentence, self.params())
        wind_of = partial(largest_wind, wind=self.wind, bank=self.bank)
        landing = None
        if self.landing is not None:
            landing = self.landing_on(self.plan(self.waypoints()))
        return Notices(self.wind, self.max_age, wind_of, link_timeout, reach_of, landing=landing)

    def climb_limits(self) -> tuple[float, float]:
        """Largest climb and sink rate, m/s.

        They are 0.7 and 0.5 of what full throttle gives, a V0 / g, and at most a tenth of V0. The
        rest of the throttle holds the airspeed. `protection.climb_range` takes the climb back where
        the rest is too little.
        """
        steepest = STEEPEST * self.speed
        down, up = self.throttle_authority or (math.inf, math.inf)
        climb, sink = reach.climb_rates(down, up, self.speed)
        return self.climb or min(climb, steepest), self.sink or min(sink, steepest)

    def params(self) -> GuidanceParams:
        """The numbers of the equations."""
        if self.drag is not None:
            return self._multicopter_params(self.drag)
        frequency = self._frequency()
        floor, (climb, sink) = self._floor(), self.climb_limits()
        roll = frequency["p"] / 4.0
        pitch = frequency["q"] / 4.0
        yaw = frequency.get("r", frequency["p"])  # without rudder the turn follows the roll
        lead = TURN_LEAD / yaw if "r" in frequency else 0.0
        turn = GRAVITY * math.tan(self.bank) / self.speed
        roll_rate = self.largest_roll_rate()
        slew = {
            "p": frequency["p"] * roll_rate,
            "q": frequency["q"] * (self.load * GRAVITY / self.speed + turn * math.sin(self.bank)),
            "r": yaw * turn,
            "V": 0.25 * frequency["V"],
        }
        return self._common(
            k_chi=roll / 3.5,
            attitude=AttitudeParams(roll, pitch, roll_rate, self.load, 20.0, self.k_beta(), lead),
            vertical=self._vertical(climb, sink),
            path=PathParams(self.period or self.least_period(), self.damping, self.capture),
            limits=Limits(
                self.bank,
                self.pitch[0],
                self.pitch[1],
                floor,
                floor / protection.FLOOR,
                self.least_radius(),
                self._largest_speed(),
                *self.altitudes(),
            ),
            slew=tuple(slew[name] for name in self.outputs),
            turn_lag=max(2.0 / yaw - lead, 0.0),
        )

    def _common(self, **numbers: Any) -> GuidanceParams:
        """The numbers of the equations, for every kind of aircraft."""
        return GuidanceParams(
            outputs=self.outputs,
            period_ns=period_ns(self.rate, "rate"),
            speed=self.speed,
            max_age_ns=nanoseconds(self.max_age),
            hold_ns=nanoseconds(self.hold),
            fence=self.fence_zones(),
            home=Home(self.home.north, self.home.east, self.home.altitude, self.home.after_loss),
            link_timeout_ns=nanoseconds(self.home.link_timeout or 0.0),
            **numbers,
        )

    def _frequency(self) -> dict[str, float]:
        """The natural frequency of the reference model by output, rad/s."""
        return dict(zip(self.outputs, self.natural_frequency, strict=True))

    def _gains(self, drag: float) -> MulticopterParams:
        return multicopter_rules.gains(
            self._frequency(), self.bank, drag, self.roll_authority or math.inf
        )

    def _multicopter_params(self, drag: float) -> GuidanceParams:
        """The numbers of the equations of a multicopter."""
        gains = self._gains(drag)
        frequency = self._frequency()
        climbs = vertical(self.outputs)
        rates = {"p": gains.tilt_rate, "q": gains.tilt_rate, "r": gains.yaw_rate}
        rates[climbs] = self.acceleration / frequency[climbs]
        climb = self.climb or multicopter_rules.CLIMB * self.speed
        sink = self.sink or multicopter_rules.SINK * self.speed
        gain = self.altitude_gain or frequency[climbs] / 4.0
        return self._common(
            k_chi=0.0,
            attitude=AttitudeParams(gains.k_tilt, gains.k_tilt, gains.tilt_rate, 0.0, 0.0, 0.0),
            vertical=VerticalParams(gain, self.acceleration, climb, sink, 0.0),
            path=PathParams(0.0, self.damping, self.capture),
            limits=Limits(
                self.bank,
                -self.bank,
                self.bank,
                0.0,
                0.0,
                0.0,
                self._largest_speed(),
                *self.altitudes(),
            ),
            slew=tuple(frequency[name] * rates[name] for name in self.outputs),
            channels=MULTICOPTER,
            multicopter=gains,
        )

    def _vertical(self, climb: float, sink: float) -> VerticalParams:
        """The altitude loop.

        Where the lag T_L of the flight path is known, T >= T_L and k_h <= 0.4 / T_L. The flight
        path then has a damping of 0.5 or more, and the altitude a gain margin of 2.5 by Routh's
        criterion.
        """
        lag = path_lag(self.stall_speed, self.speed) if self.stall_speed else 0.0
        gain = min(ALTITUDE_GAIN, 0.4 / lag) if lag else ALTITUDE_GAIN
        time = self.alpha_time or max(ALPHA_TIME, lag)
        return VerticalParams(self.altitude_gain or gain, self.acceleration, climb, sink, time)

    def waypoints(self) -> tuple[Waypoint, ...]:
        """The waypoints of the section's route; none without a route."""
        return () if self.route is None else self.route.waypoints()

    def plan(self, waypoints: Sequence[Waypoint]) -> Route:
        """Legs through waypoints. Raises ParameterError for a route that is not feasible."""
        if self.drag is None:
            route = self._airplane_route(waypoints)
        else:
            no_limits = (0.0,) * 4  # of roll, climb, sink and wind
            bounds = (self._largest_speed(), *self.altitudes())
            can = Performance(self.speed, 0.0, self.bank, *no_limits, *bounds)
            braking = self._gains(self.drag).braking
            route = route_through(waypoints, self.radius, braking, can)
        if (fence := self.fence_zones()) is not None:
            require_inside(route, fence, max(map(self.fence_margin, route.V)))
        return route

    def _airplane_route(self, waypoints: Sequence[Waypoint]) -> Route:
        floor, (climb, sink) = self._floor(), self.climb_limits()
        stall = floor / protection.FLOOR
        flown = speeds(waypoints, self.speed)
        roll_rate = self.largest_roll_rate()
        fastest = self._largest_speed()
        can = Performance(
            self.speed,
            stall,
            self.bank,
            roll_rate,
            climb,
            sink,
            self.wind,
            fastest,
            *self.altitudes(),
        )
        banks = [protection.bank_limit(self.bank, stall, max(speed, floor)) for speed in flown]
        # an empty route is refused below
        radius = max(
            (
                least_radius(speed, self.wind, bank)
                for speed, bank in zip(flown, banks, strict=True)
            ),
            default=0.0,
        )
        legs, waypoints, notes = flyable(
            tuple(waypoints),
            self.radius or math.ceil(radius),
            self.period or self.least_period(),
            can,
        )
        return as_route(legs, waypoints, self.speed, slopes=self.profile == "slope", notes=notes)

    def landing_on(self, route: Route) -> Landing | None:
        """The landing at the end of a line of a route; None without one.

        Raises ParameterError for a waypoint that no line leads to and none goes straight on from, a
        line that does not descend, and an airspeed out of bounds.
        """
        if (section := self.landing) is None:
            return None
        waypoints = self.waypoints()
        number = section.waypoint
        require(
            number < len(waypoints) - 1,
            "landing.waypoint",
            f"{number} of {len(waypoints)} waypoints",
            "one before the last, which is that of a go-around",
        )
        floor, fastest = self._floor(), self._largest_speed()
        if section.V is not None:
            expected = f"{floor:g} to {fastest:g} m/s"
            require(floor <= section.V <= fastest, "landing.V", f"{section.V:g} m/s", expected)
        box = None if self.touchdown is None else self.touchdown.zone()
        return landing_at(waypoints[number].point, route, section, box, self.params())

    def lander(self, route: Route | None) -> Lander | None:
        """What lands on the route of the parameters; None without a landing."""
        landing = None if route is None else self.landing_on(route)
        return None if landing is None else Lander(landing, self.params())

    def program_steps(self) -> list[tuple[float, dict[str, float]]]:
        """The targets of the program by instant, in order: (s, {channel: value})."""
        for name in self.program:
            require(name in TARGETS, f"program.{name}", "a channel", f"one of {', '.join(TARGETS)}")
        steps: dict[float, dict[str, float]] = {}
        for name, section in self.program.items():
            for start, value in zip(section.start, section.value, strict=True):
                steps.setdefault(start, {})[name] = value
        return sorted(steps.items())
