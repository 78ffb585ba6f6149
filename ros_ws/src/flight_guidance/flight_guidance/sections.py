# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Sections of guidance's parameters: commands over time, route, zones, home, landing."""

from typing import Annotated

from flight_core.fields import Field
from flight_core.parameters import (
    Config,
    NonNegative,
    Number,
    Numbers,
    Positive,
    require,
    require_length,
)
from flight_guidance.fence.zones import Zone
from flight_guidance.routes.route_file import Waypoint


class Steps(Config):
    """Commands of a channel of `target`, one after another in time."""

    start: Annotated[tuple[NonNegative, ...], Field(min_length=1)] = Field(description="times, s")
    value: Numbers = Field(description="values, in the channel's unit")

    def _check(self) -> None:
        require_length("value", self.value, [f"{start:g} s" for start in self.start])
        rises = all(
            later > earlier for earlier, later in zip(self.start, self.start[1:], strict=False)
        )
        require(rises, "start", list(self.start), "times in rising order")


class RouteConfig(Config):
    """A route by waypoints in the local tangent plane of `pose`."""

    north: Numbers = Field(description="distance to the north of the origin, m")
    east: Numbers = Field(description="distance to the east of the origin, m")
    altitude: Numbers = Field(description="altitude, m, as in `pose`")
    V: tuple[Positive, ...] = Field(
        default=(), description="airspeed to each waypoint, m/s; none: trim speed"
    )
    turns: tuple[NonNegative, ...] = Field(
        default=(), description="number of turns round each waypoint"
    )
    wait: tuple[NonNegative, ...] = Field(
        default=(), description="time on a circle round each waypoint, s"
    )
    leave: tuple[Number, ...] = Field(
        default=(),
        description="altitude at which the aircraft leaves the circle, m; none: `altitude`",
    )
    left: tuple[bool, ...] = Field(
        default=(), description="whether the circles are counter-clockwise; none: clockwise"
    )

    def _check(self) -> None:
        waypoints = [f"waypoint {k}" for k in range(len(self.north))]
        for key in (
            "east",
            "altitude",
            *(key for key in ("V", "turns", "wait", "leave", "left") if getattr(self, key)),
        ):
            require_length(key, getattr(self, key), waypoints)
        both = [
            k
            for k, (turns, wait) in enumerate(zip(self.turns, self.wait, strict=False))
            if turns and wait
        ]
        require(
            not both,
            "turns",
            f"turns and a wait at waypoint {both[0] if both else 0}",
            "one of the two",
        )

    def waypoints(self) -> tuple[Waypoint, ...]:
        """Return the waypoints as the equations of guidance use them."""
        count = len(self.north)
        columns = (
            self.V or (None,) * count,
            self.turns or (0.0,) * count,
            self.wait or (0.0,) * count,
            self.leave or (None,) * count,
            self.left or (None,) * count,
        )
        rows = zip(self.north, self.east, self.altitude, *columns, strict=True)
        return tuple(Waypoint(*row) for row in rows)


class ZoneConfig(Config):
    """A zone of the fence: a polygon of three or more corners, or a circle round a single point."""

    north: Numbers = Field(description="north coordinates of the corners, or of the centre, m")
    east: Numbers = Field(description="their east coordinates, m")
    radius: Positive | None = Field(
        default=None, description="radius of a circle, m; none for a polygon"
    )
    exclude: bool = Field(
        default=False, description="whether the aircraft must keep out of the zone instead of in it"
    )
    group: Annotated[int, Field(ge=0, le=255)] | None = Field(
        default=None,
        description="group of the zone: the aircraft stays in all zones of one group; none: a "
        "group of its own",
    )

    def _check(self) -> None:
        require_length("east", self.east, [f"corner {k}" for k in range(len(self.north))])
        fits = len(self.north) == 1 if self.radius else len(self.north) >= 3
        shape = f"{len(self.north)} points {'with' if self.radius else 'without'} a radius"
        require(fits, "north", shape, "three or more corners, or a centre with a radius")
        corners = list(zip(self.north, self.east, strict=True))
        twice = [
            k for k, corner in enumerate(corners) if len(corners) > 1 and corner == corners[k - 1]
        ]
        require(
            not twice,
            "north",
            f"the corner {corners[twice[0]] if twice else ''} twice in succession",
            "each corner once",
        )
        require(
            self.group is None or not self.exclude,
            "group",
            f"{self.group} of a zone to keep out of",
            "none",
        )

    def zone(self) -> Zone:
        """Return the zone as the equations of guidance use it."""
        return Zone(
            north=self.north,
            east=self.east,
            radius=self.radius or 0.0,
            exclude=self.exclude,
            group=self.group,
        )


class HomeConfig(Config):
    """The place to which the aircraft flies when the fence acts, or by the service `guidance/home`.

    The aircraft also flies there after the loss of the pose (`after_loss`) or of the operator's
    link (`link_timeout`).
    """

    north: Number = Field(default=0.0, description="distance to the north of the origin, m")
    east: Number = Field(default=0.0, description="distance to the east of the origin, m")
    altitude: Number | None = Field(
        default=None, description="altitude, m; none: the altitude when the aircraft turns home"
    )
    after_loss: bool = Field(
        default=False,
        description="whether to fly home when pose returns, instead of levelling the wings",
    )
    link_timeout: Positive | None = Field(
        default=None, description="time without an operator after which the aircraft flies home, s"
    )


class LandingConfig(Config):
    """A landing at a waypoint of the route. The line to the waypoint is the glide path.

    The next line must go straight on, because the aircraft flies along it in a go-around.
    """

    waypoint: Annotated[int, Field(ge=1, le=10_000)] = Field(
        description="number of the waypoint on the ground, from 0 on"
    )
    flare: Positive | None = Field(
        default=None, description="height at which the flare begins, m; none: 5 s of sink"
    )
    sink: Positive = Field(default=0.5, description="sink at the touch, m/s")
    decrab: NonNegative = Field(
        default=1.5, description="height below which the nose turns along the line, m; 0: never"
    )
    V: Positive | None = Field(
        default=None, description="airspeed from the flare on, m/s; none: the airspeed of the line"
    )
