# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Parameters of the guidance node: steering, commands, route, fence, landing and home."""

import math
from collections.abc import Sequence
from functools import partial

import numpy as np

from flight_core.channels import RATES_AND_SPEED, WITHOUT_RUDDER, vertical
from flight_core.fields import Field
from flight_core.parameters import (
    require,
    require_length,
)
from flight_core.rates import nanoseconds, period_ns
from flight_core.units import GRAVITY
from flight_guidance.feasibility import Performance, as_route, flyable, require_inside, speeds
from flight_guidance.fence.fence import MARGIN, Motion, room_at_home
from flight_guidance.fence.zones import Fence, Zone, clearance, clearance_text
from flight_guidance.guidance_state import (
    TARGETS,
    GuidanceParams,
    Home,
)
from flight_guidance.modes.landing import Lander, Landing, landing_at
from flight_guidance.modes.targets import reach_sentence, read_target
from flight_guidance.multicopter.multicopter_rules import route_through
from flight_guidance.notices import Notices
from flight_guidance.routes.route_file import Waypoint
from flight_guidance.sections import HomeConfig, LandingConfig, RouteConfig, Steps, ZoneConfig
from flight_guidance.steering import protection
from flight_guidance.steering.lateral import largest_wind, least_radius
from flight_guidance.steering.path import Route
from flight_guidance.steering_params import SteeringConfig


class GuidanceConfig(SteeringConfig):
    """Parameters of the guidance node."""

    program: dict[str, Steps] = Field(default={}, description="targets over flight time by channel")
    route: RouteConfig | None = Field(default=None, description="route, flown from the start")
    fence: dict[str, ZoneConfig] = Field(default={}, description="zones to stay in or keep out of")
    touchdown: ZoneConfig | None = Field(
        default=None, description="where a landing must touch down; none: anywhere"
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
        # Check the altitude limits, and that home is between them.
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
        # Check route, landing and program, which needs the numbers of the equations.
        params = self.params()
        route = None if self.route is None else self.plan(self.waypoints())
        if self.landing is not None:
            require(route is not None, "landing", "no route", "one with its waypoint")
        if route is not None:
            self.landing_on(route)
        for start, target in self.program_steps():
            read_target(target, params, route, f"program at {start:g} s")

    def _check_multicopter(self) -> None:
        """Check that a multicopter has no parameter for airplanes only, and a home in the fence.

        Raises ParameterError if not.
        """
        for key in ("stall_speed", "landing", "touchdown", "throttle_authority"):
            require(not getattr(self, key), key, getattr(self, key), "none of a multicopter")
        inside = self.fence_clearance(self.home.north, self.home.east)
        margin = self.fence_margin(self.speed)
        expected = f"at least {margin:.1f} m inside"
        require(inside >= margin, "home", f"home {clearance_text(inside)}", expected)

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
        least = math.ceil(self.least_radius()) + self.fence_margin(self.speed)
        inside = self.fence_clearance(self.home.north, self.home.east)
        expected = f"at least {least:.0f} m inside, for the orbit round home"
        require(inside >= least, "home", f"home {clearance_text(inside)}", expected)
        if (fence := self.fence_zones()) is None:
            return
        margin = self.fence_margin(self.speed)
        room = room_at_home(fence, self._at_home(), self.wind)
        if room < margin:
            turn = f"a turn from home onto the orbit that is {clearance_text(room)}"
            north, east = fence.home
            wide = Zone((north,), (east,), radius=20.0 * fence.radius)
            room_in_wide = room_at_home(fence._replace(zones=(wide,)), self._at_home(), self.wind)
            reach = wide.radius - room_in_wide
            size = f"with home {math.ceil(reach + margin)} m inside every turn fits"
            require(False, "home", turn, f"at least {margin:.0f} m inside; {size}")

    def _at_home(self) -> Motion:
        """Return the motion in level flight over home, from which the fence predicts turns."""
        params = self.params()
        limits = params.limits
        bank = protection.bank_limit(limits.bank, limits.stall_speed, self.speed)
        lag = 0.5 / params.attitude.k_phi + params.turn_lag
        return Motion(
            north=self.home.north,
            east=self.home.east,
            phi=0.0,
            heading=0.0,
            speed=self.speed,
            wind=(0.0, 0.0),
            bank=bank,
            roll_rate=params.attitude.roll_rate,
            lag=lag,
        )

    def fence_zones(self) -> Fence | None:
        """Return the fence as the equations of guidance use it, or None without zones."""
        zones = tuple(zone.zone() for zone in self.fence.values())
        if not zones:
            return None
        radius = float(math.ceil(self.least_radius()))
        return Fence(zones, (self.home.north, self.home.east), radius)

    def fence_clearance(self, north: float, east: float) -> float:
        """Return how far a place is from the fence, m: negative outside, infinite without one."""
        fence = self.fence_zones()
        if fence is None:
            return math.inf
        return float(clearance(fence.zones, np.array(north), np.array(east)))

    def fence_margin(self, speed: float) -> float:
        """Return the least distance that a route must keep from the fence at an airspeed, m.

        It is the distance flown in the time MARGIN with a tailwind.
        """
        return MARGIN * (speed + self.wind)

    def params(self) -> GuidanceParams:
        """Return the numbers that the equations of guidance use."""
        return GuidanceParams(
            outputs=self.outputs,
            period_ns=period_ns(self.rate, "rate"),
            speed=self.speed,
            max_age_ns=nanoseconds(self.max_age),
            hold_ns=nanoseconds(self.hold),
            fence=self.fence_zones(),
            home=Home(self.home.north, self.home.east, self.home.altitude, self.home.after_loss),
            link_timeout_ns=nanoseconds(self.home.link_timeout or 0.0),
            **self.guidance_constants(),
        )

    def notices(self) -> Notices:
        """Return the notices of a flight with these parameters."""
        link_timeout = self.home.link_timeout or math.inf
        if self.drag is not None:
            strongest = GRAVITY * math.tan(self.bank) / self.drag
            return Notices(
                wind=self.wind,
                max_age=self.max_age,
                largest_wind=lambda speed: strongest - speed,
                link_timeout=link_timeout,
                largest_tilt=self.bank,
            )
        reach_of = partial(reach_sentence, self.params())
        wind_of = partial(largest_wind, wind=self.wind, bank=self.bank)
        landing = None
        if self.landing is not None:
            landing = self.landing_on(self.plan(self.waypoints()))
        return Notices(
            wind=self.wind,
            max_age=self.max_age,
            largest_wind=wind_of,
            link_timeout=link_timeout,
            reach=reach_of,
            landing=landing,
        )

    def waypoints(self) -> tuple[Waypoint, ...]:
        """Return the waypoints of the section route, or none if there is no route."""
        return () if self.route is None else self.route.waypoints()

    def plan(self, waypoints: Sequence[Waypoint]) -> Route:
        """Plan legs through waypoints. Raises ParameterError if the route is not feasible."""
        if self.drag is None:
            route = self._airplane_route(waypoints)
        else:
            lowest, highest = self.altitudes()
            can = Performance(
                speed=self.speed,
                stall_speed=0.0,
                bank=self.bank,
                roll_rate=0.0,
                climb=0.0,
                sink=0.0,
                wind=0.0,
                largest_speed=self._largest_speed(),
                lowest=lowest,
                highest=highest,
            )
            braking = self._gains(self.drag).braking
            route = route_through(waypoints, self.radius, braking, can)
        if (fence := self.fence_zones()) is not None:
            require_inside(route, fence, max(map(self.fence_margin, route.V)))
        return route

    def _airplane_route(self, waypoints: Sequence[Waypoint]) -> Route:
        floor = self._floor()
        climb, sink = self.climb_limits()
        stall = self._stall_speed()
        leg_speeds = speeds(waypoints, self.speed)
        lowest, highest = self.altitudes()
        can = Performance(
            speed=self.speed,
            stall_speed=stall,
            bank=self.bank,
            roll_rate=self.largest_roll_rate(),
            climb=climb,
            sink=sink,
            wind=self.wind,
            largest_speed=self._largest_speed(),
            lowest=lowest,
            highest=highest,
        )
        banks = [protection.bank_limit(self.bank, stall, max(speed, floor)) for speed in leg_speeds]
        radii = [
            least_radius(speed, self.wind, bank)
            for speed, bank in zip(leg_speeds, banks, strict=True)
        ]
        # `flyable` refuses an empty route.
        radius = max(radii, default=0.0)
        flown = flyable(
            tuple(waypoints),
            self.radius or math.ceil(radius),
            self.period or self.least_period(),
            can,
        )
        return as_route(
            flown.legs,
            flown.waypoints,
            self.speed,
            slopes=self.profile == "slope",
            notes=flown.notes,
        )

    def landing_on(self, route: Route) -> Landing | None:
        """Return the landing on a route, or None without a section `landing`.

        Raises ParameterError if no line of the route leads to the landing's waypoint, if this line
        does not descend, if no line goes straight on from the waypoint, and for an airspeed out of
        bounds.
        """
        if (section := self.landing) is None:
            return None
        waypoints = self.waypoints()
        number = section.waypoint
        require(
            number < len(waypoints) - 1,
            "landing.waypoint",
            f"{number} of {len(waypoints)} waypoints",
            "one before the last, which is the leg of a go-around",
        )
        floor, fastest = self._floor(), self._largest_speed()
        if section.V is not None:
            expected = f"{floor:g} to {fastest:g} m/s"
            require(floor <= section.V <= fastest, "landing.V", f"{section.V:g} m/s", expected)
        box = None if self.touchdown is None else self.touchdown.zone()
        return landing_at(waypoints[number].point, route, section, box, self.params())

    def lander(self, route: Route | None) -> Lander | None:
        """Return what flies the landing on the route of the parameters.

        Returns None without a landing.
        """
        landing = None if route is None else self.landing_on(route)
        return None if landing is None else Lander(landing, self.params())

    def program_steps(self) -> list[tuple[float, dict[str, float]]]:
        """Return the commands of the program in order of time: (s, {channel: value})."""
        for name in self.program:
            require(name in TARGETS, f"program.{name}", "a channel", f"one of {', '.join(TARGETS)}")
        steps: dict[float, dict[str, float]] = {}
        for name, section in self.program.items():
            for start, value in zip(section.start, section.value, strict=True):
                steps.setdefault(start, {})[name] = value
        return sorted(steps.items())
