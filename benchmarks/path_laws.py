# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Compare three path laws in guidance: its own, L1, and L1 with the same lead of the curvature.

The osprey flies the same routes in the same loop with each of them.

    .venv/bin/python -m benchmarks.path_laws

The figures go to docs/evidence/guidance-laws.csv. L1 is that of ArduPilot (AP_L1_Control: lines by
update_waypoint, arcs by update_loiter) with the period and the damping of guidance, without the
lead and without the estimate of the slip; "L1 + lead" has both. A route is a rectangle of 3 radii;
its figures leave out the first radius of a leg that is joined. A capture begins beside a line, on
its course.
"""

import math
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any, NamedTuple
from unittest import mock

import numpy as np
from benchmarks import evidence
from benchmarks.routes import duration, errors

from flight_analysis.closed_loop.scenario import Scenario
from flight_analysis.closed_loop.scenario_library import find_scenario, with_route
from flight_analysis.closed_loop.simulate import simulate
from flight_guidance.modes import lateral_modes
from flight_guidance.modes.legs import course_and_speed
from flight_guidance.routes.route_file import Waypoint
from flight_guidance.steering.lateral import PathError, PathParams, bank_for
from flight_guidance.steering.vertical import path_angle

LAWS = ("guidance", "L1", "L1 + lead")
WINDS = (0.0, 0.2, 0.6)  # to the east, each a share of V0
OFFSETS = (0.3, 0.6, 0.9)  # distances of the start from the line, radii
WITHIN = 0.1  # cross-track error at which a line counts as captured, s of flight at V0
STEEPEST_L1 = math.sin(math.radians(45.0))


class Cell(NamedTuple):
    """A figure with its value for each of the three laws."""

    name: str
    unit: str
    values: Mapping[str, float]  # by law

    @property
    def figures(self) -> Iterator[evidence.Row]:
        """The rows of evidence."""
        for law, value in self.values.items():
            yield evidence.row(f"{law}: {self.name}", round(value, 2), self.unit)


def l1(error: PathError, course: Any, ground_speed: Any, params: PathParams) -> float:
    """Return the acceleration to the right of ArduPilot's L1, m/s^2.

    For lines it is K v^2 / L sin(nu), L = zeta P v / pi, K = 4 zeta^2. For circles it is w^2 d + 2
    zeta w d' + v_t^2 / r. Outside of a circle it is at most what the law of lines gives for a
    course to the centre. Source: ArduPilot, libraries/AP_L1_Control.
    """
    e, track, kappa = map(float, error)
    speed = float(ground_speed)
    along = math.remainder(float(course) - track, 2.0 * math.pi)
    length = max(params.damping * params.period * speed / math.pi, 0.1)
    gain = 4.0 * params.damping**2 * speed**2 / length
    if abs(kappa) < 1e-9:
        towards = math.asin(max(min(e / length, STEEPEST_L1), -STEEPEST_L1))
        return gain * math.sin(_within(-towards - along))
    side = math.copysign(1.0, kappa)
    radius = 1.0 / abs(kappa)
    outward = -e * side
    w = 2.0 * math.pi / params.period
    tangential = speed * math.cos(along)
    correction = w**2 * outward - 2.0 * params.damping * w * speed * math.sin(along) * side
    if tangential < 0.0:
        correction = max(correction, 0.0)
    turn = side * (correction + tangential**2 / max(0.5 * radius, radius + outward))
    centre = math.remainder(track + side * math.pi / 2.0 - float(course), 2.0 * math.pi)
    capture = gain * math.sin(_within(centre))
    return capture if outward > 0.0 and side * capture < side * turn else turn


def _within(angle: float) -> float:
    return max(min(angle, math.pi / 2.0), -math.pi / 2.0)


def without_lead(
    error: PathError, entry: Any, entered: Any, slip: Any, pose: Any, speed: Any, params: Any
) -> Any:
    """Do what `lateral_modes.follow` does, with L1 and without lead and estimate of the slip."""
    acceleration = l1(error, *course_and_speed(pose), params.path)
    return bank_for(acceleration, path_angle(pose["climb"], speed), lateral_modes.STEEPEST)


@contextmanager
def flying(law: str) -> Iterator[None]:
    """Let guidance fly by one of LAWS inside the context."""
    if law == LAWS[0]:
        yield
        return
    follow = lateral_modes.follow if "lead" in law else without_lead
    with mock.patch.multiple(lateral_modes, path_acceleration=l1, follow=follow):
        yield


def osprey(wind: float, places: list[tuple[float, float]], start: float = 0.0) -> Scenario:
    """Return the scenario of the osprey on a route in a steady wind to the east.

    `wind` is a share of V0. `places` are north and east of the waypoints in radii, and `start` is
    how far to the east the aircraft starts, radii.
    """
    base = find_scenario("osprey_route").vary(
        reference_model={"rate": 100.0},
        aircraft={"turbulence": None, "rate": 100.0, "step": 0.005, "wind": [0.0, 0.0]},
        guidance={"route": None, "wind": 0.0},
    )
    if base.guidance is None:
        raise ValueError("osprey_route has no guidance")
    speed = wind * base.guidance.speed
    section = base.guidance.model_copy(update={"wind": speed})
    radius = float(math.ceil(section.least_radius()))
    changes = {"wind": [0.0, speed], "start": {"north": 5.0, "east": start * radius}}
    waypoints = [Waypoint(north * radius, east * radius, 0.0) for north, east in places]
    return with_route(base.vary(aircraft=changes, guidance={"wind": speed}), waypoints)


def rectangle(law: str, wind: float) -> float:
    """Return the largest cross-track error on a rectangle, m."""
    scenario = osprey(wind, [(0, 0), (3, 0), (3, 3), (0, 3), (0, 0)])
    section = scenario.guidance
    assert section is not None  # noqa: S101 - of osprey
    route = section.plan(section.waypoints())
    lasts = float(math.ceil(duration(route, section)))
    with flying(law):
        tape = simulate(scenario.vary(flight={"duration": lasts}))
    return errors(tape, route)[0]


def capture(law: str, offset: float) -> tuple[float, float]:
    """Fly from beside a line onto it; return the time and the overshoot, m.

    `offset` is the distance of the start from the line, radii. The time ends when the cross-track
    error stays below WITHIN, s.
    """
    scenario = osprey(0.0, [(0, 0), (60, 0)], offset).vary(flight={"duration": 25.0})
    with flying(law):
        tape = simulate(scenario)
    assert scenario.guidance is not None  # noqa: S101 - of osprey
    error = tape["guidance"]["xtrack"]
    places = np.flatnonzero(np.abs(error) > WITHIN * scenario.guidance.speed)
    return float(tape.time("guidance")[places[-1]]), max(-float(np.min(error)), 0.0)


def cells() -> Iterator[Cell]:
    """Fly the captures and the rectangles, and yield their figures."""
    for offset in OFFSETS:
        captures = {law: capture(law, offset) for law in LAWS}
        title = f"capture from {offset:g} radii"
        yield Cell(f"{title}: time", "s", {law: time for law, (time, _) in captures.items()})
        yield Cell(f"{title}: overshoot", "m", {law: over for law, (_, over) in captures.items()})
    for wind in WINDS:
        title = f"rectangle, wind {wind:g} V0: cross-track, largest"
        yield Cell(title, "m", {law: rectangle(law, wind) for law in LAWS})


def main() -> None:
    """Fly, print the rows and store them."""
    start = evidence.origin("python -m benchmarks.path_laws")
    figures = list[evidence.Row]()
    for cell in cells():
        print(cell.name, dict(cell.values), flush=True)
        figures += cell.figures
    evidence.write("guidance-laws", figures, start)


if __name__ == "__main__":
    main()
