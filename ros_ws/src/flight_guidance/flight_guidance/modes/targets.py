# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Check the commands of an operator, and make the commands to hold and to fly home.

The limits of the commands follow from the parameters and from a learned model.
"""

import math
from collections.abc import Mapping

from flight_core.units import GRAVITY
from flight_core.vectors import ChannelError, SampleFault, Scalar, array_namespace
from flight_guidance import reach
from flight_guidance.guidance_state import (
    LARGEST,
    GuidanceParams,
)
from flight_guidance.reach import Authority
from flight_guidance.steering import path
from flight_guidance.steering.path import Route


def within_reach(params: GuidanceParams, authority: Authority) -> GuidanceParams:
    """Lower the limits in the parameters to what a model that was learned in flight allows.

    The limits of a multicopter stay. For an airplane, the same rules hold as for parameters that a
    file leaves out: climb and sink follow from the authority of the throttle, and the roll rate
    follows from the authority of the aileron. The bank is limited so that its reversals fit into
    the period of path following, and orbits have the radius for this bank. If the aileron has no
    effect, or p ignores its command, the largest bank is YAWED_BANK. If the throttle has no effect,
    the aircraft does not climb. The limit of the sink then stays, because the pitch holds the
    airspeed at its floor.
    """
    if authority == Authority() or params.multicopter is not None:
        return params
    rolls = min(authority.p, authority.roll) >= reach.LEAST
    dead = tuple(name for name in ("q", "p") if getattr(authority, name) < reach.LEAST)
    limits = params.limits
    attitude = params.attitude
    vertical = params.vertical
    climb, sink = reach.climb_rates(authority.down, authority.up, params.speed)
    vertical = vertical._replace(climb=min(vertical.climb, climb))
    if authority.down >= reach.LEAST:
        vertical = vertical._replace(sink=min(vertical.sink, sink))
    rate = attitude.roll_rate
    bank = min(limits.bank, reach.YAWED_BANK)
    if rolls:
        rate = min(rate, reach.roll_rate(authority.p, 4.0 * attitude.k_phi))
        bank = limits.bank * min(1.0, params.path.period / reach.least_period(limits.bank, rate))
    # The airspeed controls the climb here, so its command may change as fast as V follows.
    if "q" in dead:
        faster = tuple(
            4.0 * rate if name == "V" else rate
            for name, rate in zip(params.outputs, params.slew, strict=True)
        )
        params = params._replace(slew=faster)
    radius = limits.radius * (math.tan(0.8 * limits.bank) / math.tan(0.8 * bank))
    return params._replace(
        dead=dead,
        rolls=rolls,
        vertical=vertical,
        limits=limits._replace(bank=bank, radius=radius),
        attitude=attitude._replace(roll_rate=rate),
    )


def reach_sentence(params: GuidanceParams, authority: Authority) -> str | None:
    """Write a sentence with the limits that follow from a model learned in flight.

    Returns None if these limits are not below the limits in the parameters.
    """
    now = within_reach(params, authority)
    parts = [
        f"no {command}: {name} has no input with an effect"
        for name, command in DEAD.items()
        if name in now.dead
    ]
    if not authority.roll:
        parts.append("the yaw rate flies the bank: p ignores its command")
    if min(authority.down, authority.up) < reach.LEAST:
        parts.append("no climb: V has no input with an effect")
    for name, nominal, limit, unit in (
        ("bank", math.degrees(params.limits.bank), math.degrees(now.limits.bank), "deg"),
        (
            "roll rate",
            math.degrees(params.attitude.roll_rate),
            math.degrees(now.attitude.roll_rate),
            "deg/s",
        ),
        ("climb", params.vertical.climb, now.vertical.climb, "m/s"),
        ("sink", params.vertical.sink, now.vertical.sink, "m/s"),
    ):
        if 0.0 < limit < nominal:
            parts.append(f"{name} at most {limit:.2g} {unit}")
    return ", ".join(parts) if parts else None


DEAD = {"p": "roll rate", "q": "pitch rate"}
"""Commands that are no longer given if the input of the output has no effect, by output."""


ANGLES = ("phi", "heading", "course", "theta", "r")
"""Channels of Target in rad, and r in rad/s."""

UNITS = {"climb": "m/s", "altitude": "m", "V": "m/s"}


def read_target(
    values: Mapping[str, float],
    params: GuidanceParams,
    route: Route | None,
    what: str = "target",
    *,
    degrees: bool = False,
) -> None:
    """Check that guidance can fly the given commands. Raises ChannelError if not.

    A command is refused if it belongs to no mode or to two modes, if it names a leg that the route
    does not have, or if it is beyond the limits. With `degrees`, the message gives angles in
    degrees, as an operator types them, and otherwise in rad.
    """
    channels = params.channels
    lateral_modes = {mode for name, mode in channels.lateral.items() if name in values}
    vertical_modes = {mode for name, mode in channels.vertical.items() if name in values}
    channels_of_step = [name for name in channels.known() if name != "r" or "r" in params.outputs]
    unknown = [name for name in values if name not in channels_of_step]
    if unknown or not values:
        raise ChannelError(
            SampleFault.NAME,
            f"{what}: found {', '.join(unknown) or 'no channel'}, expected some of "
            f"{', '.join(channels_of_step)}",
        )
    if len(lateral_modes) > 1 or len(vertical_modes) > 1:
        raise ChannelError(
            SampleFault.NAME,
            f"{what}: found {', '.join(values)}, expected one lateral and one vertical command "
            "at most",
        )
    for mode in lateral_modes & channels.together.keys():
        *before, last = channels.together[mode]
        if not {*before, last} <= values.keys():
            group = f"{', '.join(before)} and {last} together"
            raise ChannelError(
                SampleFault.NAME, f"{what}: found {', '.join(values)}, expected {group}"
            )
    for name, partner in (("r", "phi"), ("along", "leg")):
        if name in values and partner not in values:
            raise ChannelError(
                SampleFault.NAME, f"{what}: found {name} without {partner}, expected {partner} too"
            )
    for name, value in values.items():
        if abs(value) > LARGEST:
            raise ChannelError(
                SampleFault.BOUNDS,
                f"{what}.{name}: found {value:g}, expected at most {LARGEST:g} either way",
            )
    _require_limits(values, params, what, degrees=degrees)
    limits = params.limits
    if "radius" in values and abs(values["radius"]) < limits.radius:
        expected = f"at least {math.ceil(limits.radius)} m either way"
        raise ChannelError(
            SampleFault.BOUNDS, f"{what}.radius: found {values['radius']:g} m, expected {expected}"
        )
    _read_leg(values, route, what)


def _require_limits(
    values: Mapping[str, float], params: GuidanceParams, what: str, *, degrees: bool
) -> None:
    """Check that an angle, a climb, an altitude and an airspeed are inside the limits.

    Raises ChannelError if not.
    """
    limits = params.limits
    vertical = params.vertical
    for name, least, largest in (
        ("phi", -limits.bank, limits.bank),
        ("r", -(turn := GRAVITY * math.tan(limits.bank) / params.speed), turn),
        ("theta", limits.least_pitch, limits.largest_pitch),
        ("climb", -vertical.sink, vertical.climb),
        ("altitude", limits.lowest, limits.highest),
        ("V", limits.floor, limits.largest_speed),
    ):
        if name in values and not least <= values[name] <= largest:
            factor = math.degrees(1.0) if degrees and name in ANGLES else 1.0
            unit = UNITS.get(name, "deg" if degrees else "rad") + "/s" * (name == "r")
            value_text = f"{values[name] * factor:.6g}"
            expected = f"{least * factor:.6g} to {largest * factor:.6g} {unit}"
            raise ChannelError(
                SampleFault.BOUNDS, f"{what}.{name}: found {value_text}, expected {expected}"
            )


def _read_leg(values: Mapping[str, float], route: Route | None, what: str) -> None:
    """Check that the route has the leg in the commands. Raises ChannelError if it does not."""
    if "leg" in values and route is None:
        raise ChannelError(SampleFault.BOUNDS, f"{what}.leg: found no route, expected one")
    if "leg" in values and route is not None and values["leg"] not in range(len(route.legs)):
        expected = f"a whole number from 0 to {len(route.legs) - 1}"
        raise ChannelError(
            SampleFault.BOUNDS, f"{what}.leg: found {values['leg']:g}, expected {expected}"
        )
    if (
        "along" in values
        and route is not None
        and not 0.0 <= values["along"] <= (longest := path.length(route.legs[int(values["leg"])]))
    ):
        expected = f"0 to {longest:.6g} m, the length of the leg; 0 for an arc"
        raise ChannelError(
            SampleFault.BOUNDS, f"{what}.along: found {values['along']:g} m, expected {expected}"
        )


def hold(pose: Mapping[str, Scalar], speed: Scalar, params: GuidanceParams) -> dict[str, Scalar]:
    """Return commands to hold the present heading, altitude and airspeed.

    The airspeed is kept within its limits.
    """
    return {
        "heading": pose["psi"],
        "altitude": pose["altitude"],
        "V": permitted_speed(speed, params),
    }


def permitted_speed(speed: Scalar, params: GuidanceParams) -> Scalar:
    """Limit an airspeed to the range that may be commanded, m/s."""
    xp = array_namespace(speed)
    return xp.minimum(xp.maximum(speed, params.limits.floor), params.limits.largest_speed)


def permitted(commands: Mapping[str, float], params: GuidanceParams) -> dict[str, float]:
    """Limit commands that were made from a pose to values that `read_target` accepts.

    An aircraft that holds or flies home may be above its highest altitude, and then descends to it.
    """
    limits = params.limits
    inside = {name: min(max(value, -LARGEST), LARGEST) for name, value in commands.items()}
    if "altitude" in inside:
        inside["altitude"] = min(max(inside["altitude"], limits.lowest), limits.highest)
    return inside


def home(pose: Mapping[str, float], params: GuidanceParams) -> dict[str, float]:
    """Return the commands of an orbit round home, or for a multicopter of a hover at home.

    The orbit is clockwise and has the least radius. Its altitude is the altitude of home, or the
    present altitude if home has none.
    """
    place = params.home
    altitude = pose["altitude"] if place.altitude is None else place.altitude
    over_home = {"north": place.north, "east": place.east, "altitude": altitude}
    if params.multicopter is not None:
        return over_home
    return over_home | {"radius": float(math.ceil(params.limits.radius))}
