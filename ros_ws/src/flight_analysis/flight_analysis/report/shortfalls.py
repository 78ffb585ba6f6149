# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Judge whether a flight that was completed or landed did what it should.

A shortfall is something that the flight did not do. A flight succeeds if

- the law was engaged in at least the fraction ENGAGED of the ticks in which it should fly,
- y_m was the one that the scenario commands (`flown_reference`),
- the error of each output is at most what the linear loop allows (`tracking`),
- the airspeed stayed above the stall speed, and the aircraft above the ground and between the
  altitudes of guidance,
- the aircraft stayed inside the fence, flew every leg of the route and joined the last orbit,
- a landing ended in the touch-down zone,
- and the log holds the whole flight.

If the host was too busy for a flight in real time, the flight says nothing about the law. If the
busy host alone explains what is wrong, the flight has no shortfall, and its end is HOST.
"""

import math
from dataclasses import replace

import numpy as np

from aircraft_sim.params import AircraftConfig
from flight_analysis.closed_loop.scenario import Scenario
from flight_analysis.metrics.errors import best_pose
from flight_analysis.metrics.time_spans import mask_spans
from flight_analysis.report.account import Account
from flight_analysis.report.flown_reference import reference_shortfalls
from flight_analysis.report.guided import (
    altitude_excess,
    flown_legs,
    orbit_missed_by,
    time_outside,
    touched_beside,
    unflown_legs,
)
from flight_analysis.report.sample_counts import is_simulated
from flight_analysis.report.starvation import Starvation
from flight_analysis.report.tracking import TrackingVerdict, tracking_verdict
from flight_core.modes import Mode
from flight_core.outcome import Aim, End, Outcome, Shortfall, host_starved, never_flew
from flight_core.rates import seconds
from flight_core.tape import Tape
from flight_guidance.params import GuidanceConfig
from rise_di_controller.params import ControllerConfig

FED = Starvation()  # of a flight whose host was never too busy

ENGAGED = 0.9
"""Least share of the ticks in which the law must be engaged. If u is held or at trim for longer,
the metrics say nothing about the law."""


def judge(
    outcome: Outcome,
    tape: Tape,
    scenario: Scenario | None,
    account: Account,
    controller: ControllerConfig | None = None,
) -> Outcome:
    """Return the outcome of a flight with its shortfalls. A flight that ended early has none.

    If `scenario` is None and no `controller` is given, errors are not judged.
    """
    starved = account.starvation
    seems_unflown = outcome.end is End.NEVER_FLEW or account.late is not None
    if seems_unflown and starved.length > account.end / 2.0:
        return _never_flown_by_host(starved, account.end)
    if outcome.end is End.COMPLETED and account.late is not None:
        return never_flew(f"the first u came at t = {account.late:.3f} of {account.end:.3f} s")
    if outcome.end is End.COMPLETED and account.unguided:
        return never_flew(
            "guidance took no step; see the ages of pose and y against guidance.max_age"
        )
    if not outcome.has_reached_end and outcome.end is not End.UNKNOWN:
        return replace(outcome, shortfalls=(), allowances=(), errors=())
    aircraft: AircraftConfig | None = None
    section: GuidanceConfig | None = None
    if scenario is not None:
        controller = scenario.controller
        aircraft = scenario.aircraft
        section = scenario.guidance
    may_pause = _is_pause_allowed(tape, scenario)
    verdict = TrackingVerdict([], [])
    if controller is not None:
        verdict = tracking_verdict(tape, controller, aircraft, may_pause=may_pause, starved=starved)
    engagement = _engagement(tape, may_pause=may_pause, starved=starved)
    has_paused = bool(_engagement(tape, may_pause=may_pause)) and not engagement
    of_path = _height(tape, aircraft, section)
    if section is not None:
        of_path += _guided(tape, section, has_landed=outcome.end is End.LANDED)
    # A starved span changes the path of the aircraft, and this lasts long after the span.
    says_nothing_of_path = starved.length > (1.0 - ENGAGED) * account.end
    shortfalls = [
        # The log of one aircraft does not show where the others were, so these shortfalls are kept.
        *(each for each in outcome.shortfalls if each.aim is Aim.SEPARATION),
        *engagement,
        *([] if scenario is None else reference_shortfalls(tape, scenario)),
        *verdict.shortfalls,
        *([] if says_nothing_of_path else of_path),
        *(_incomplete(lack) for lack in account.lacks if lack not in account.host_lacks),
    ]
    judged = replace(
        outcome,
        shortfalls=tuple(shortfalls),
        allowances=tuple(verdict.allowances),
        errors=tuple(excess._asdict() for excess in verdict.worst),
    )
    is_excused = has_paused or verdict.is_excused or (says_nothing_of_path and bool(of_path))
    if not (is_excused or account.host_lacks):
        return judged
    silent = f"{starved.length:.0f} of {account.end:.0f} s say nothing about the law"
    return replace(judged, end=End.HOST, reason=f"this host was too busy for real time: {silent}")


def _incomplete(lack: str) -> Shortfall:
    """Return a shortfall for something that the log lacks."""
    brief = f"log incomplete: {lack.partition(',')[0]}"
    return Shortfall(aim=Aim.LOG, sentence=f"log incomplete: {lack}", brief=brief)


def _never_flown_by_host(starved: Starvation, end: float) -> Outcome:
    """Return the outcome of a flight of `end` s that never began because the host was busy."""
    return host_starved(
        f"never flew: this host was too busy for real time in {starved.length:.0f} of {end:.0f} s"
    )


def _is_pause_allowed(tape: Tape, scenario: Scenario | None) -> bool:
    """Return whether the law may be inactive at times, because somebody else activates it.

    Behind a bridge this is the autopilot. With `start_active: false` it is the user. In any other
    simulated flight, the law must fly from its first u to the end.
    """
    if scenario is None or not is_simulated(tape):
        return True
    return not (scenario.controller.autostart and scenario.controller.start_active)


def _engagement(tape: Tape, *, may_pause: bool, starved: Starvation = FED) -> list[Shortfall]:
    """Return a shortfall if the law was engaged in too few of the ticks.

    Ticks in the spans `starved`, in which the host was too busy, are left out.
    """
    if "internals" not in tape or "mode" not in tape["internals"].names:
        return []
    mode = tape["internals"]["mode"]
    is_asked = ~starved.is_starved(tape.time("internals"))
    if may_pause:
        is_asked &= mode != Mode.INACTIVE
    elif "u" in tape and len(tape["u"].stamp_ns):
        is_asked &= tape["internals"].stamp_ns >= tape["u"].stamp_ns[0]
    mode = mode[is_asked]
    if not len(mode):
        return []
    share = float(np.mean(mode == Mode.ENGAGED))
    if share >= ENGAGED:
        return []
    sentence = f"the law engaged in {100.0 * share:.0f} % of the ticks"
    return [Shortfall(aim=Aim.ENGAGEMENT, sentence=sentence, figures={"share": share})]


def _height(
    tape: Tape, aircraft: AircraftConfig | None, section: GuidanceConfig | None
) -> list[Shortfall]:
    """Return a shortfall if the aircraft was below the ground.

    The height of the ground comes from the scenario or, without one, from the landing. It is
    unknown for an aircraft of JSBSim.
    """
    ground = None if aircraft is None or aircraft.is_jsbsim else aircraft.ground()
    if ground is None and section is not None and not (aircraft and aircraft.is_jsbsim):
        landing = section.landing_on(section.plan(section.waypoints())) if section.landing else None
        ground = None if landing is None else landing.ground
    pose = best_pose(tape)
    if ground is None or pose is None or len(pose.stamp_ns) < 2:
        return []
    height = pose["altitude"] - ground
    below_s = seconds(int(np.sum(np.diff(pose.stamp_ns)[height[:-1] < 0.0])))
    if not below_s:
        return []
    deepest = -float(np.min(height))
    sentence = f"below the ground for {below_s:.1f} s, {deepest:.1f} m at most"
    figures = {"below_s": below_s, "deepest_m": deepest}
    return [Shortfall(aim=Aim.GROUND, sentence=sentence, figures=figures)]


def _guided(tape: Tape, section: GuidanceConfig, *, has_landed: bool) -> list[Shortfall]:
    """Return the shortfalls of a guided flight: stall, altitude, fence, route and touch-down."""
    shortfalls = [*_stall(tape, section)]
    altitude = altitude_excess(tape, section)
    if altitude is not None and altitude.outside_s:
        sentence = (
            f"outside of the altitudes of guidance for {altitude.outside_s:.1f} s, "
            f"{altitude.farthest_m:.0f} m at most"
        )
        figures = altitude._asdict()
        shortfalls.append(Shortfall(aim=Aim.ALTITUDE, sentence=sentence, figures=figures))
    outing = time_outside(tape, section)
    if outing is not None and outing.outside_s:
        sentence = (
            f"outside of the fence for {outing.outside_s:.1f} s, {outing.farthest_m:.0f} m at most"
        )
        shortfalls.append(Shortfall(aim=Aim.FENCE, sentence=sentence, figures=outing._asdict()))
    if "guidance" in tape and len(tape["guidance"].stamp_ns):
        shortfalls += _failed_steps(tape)
        shortfalls += _route(tape, section, has_landed=has_landed)
    touch_distance = touched_beside(tape, section) if has_landed else 0.0
    if touch_distance:
        sentence = f"outside of the touch-down zone by {touch_distance:.0f} m"
        figures = {"beside_m": touch_distance}
        shortfalls.append(Shortfall(aim=Aim.TOUCHDOWN, sentence=sentence, figures=figures))
    return shortfalls


def _failed_steps(tape: Tape) -> list[Shortfall]:
    """Return a shortfall if steps of guidance failed, so that earlier commands were kept."""
    count = int(tape["guidance"]["failed"].max())
    if not count:
        return []
    sentence = f"{count} steps of guidance failed"
    return [Shortfall(aim=Aim.GUIDANCE, sentence=sentence, figures={"failed": count})]


def _stall(tape: Tape, section: GuidanceConfig) -> list[Shortfall]:
    """Return a shortfall if V fell below the stall speed, except in the flare of a landing."""
    if section.stall_speed is None or "guidance" not in tape or section.drag is not None:
        return []
    log = tape["guidance"]
    if "y.V" not in log.names:
        return []
    t = tape.time("guidance")
    V = section.speed + log["y.V"]
    if "truth" in tape and "x.V" in tape["truth"].names:
        V = section.speed + np.interp(t, tape.time("truth"), tape["truth"]["x.V"])
    is_stalled = section.stall_speed > V
    if section.landing is not None:
        landing = section.landing_on(section.plan(section.waypoints()))
        if landing is not None:
            is_stalled &= log["pose.altitude"] > landing.ground + landing.flare
    spans = mask_spans(t, is_stalled)
    lasted = math.fsum(stop - start for start, stop in spans)
    if not lasted:
        return []
    least = float(np.min(V[is_stalled]))
    sentence = (
        f"V down to {least:.1f} m/s, below the stall speed of {section.stall_speed:g} m/s for "
        f"{lasted:.1f} s"
    )
    figures = {"least": least, "stall_speed": section.stall_speed, "below_s": lasted}
    return [Shortfall(aim=Aim.STALL, sentence=sentence, figures=figures)]


def _route(tape: Tape, section: GuidanceConfig, *, has_landed: bool) -> list[Shortfall]:
    """Return shortfalls for legs that were missed or not flown, and a last orbit not joined."""
    shortfalls = []
    for leg in flown_legs(tape):
        if leg.missed:
            sentence = f"missed leg {leg.leg} by {leg.missed:.0f} m"
            figures = {"leg": leg.leg, "missed_m": leg.missed}
            shortfalls.append(Shortfall(aim=Aim.ROUTE, sentence=sentence, figures=figures))
    unflown = list(unflown_legs(tape, section))
    if has_landed:
        # Legs after the landing are flown only in a go-around.
        landing = section.landing_on(section.plan(section.waypoints())) if section.landing else None
        unflown = [leg for leg in unflown if landing is None or leg < landing.leg]
    if unflown:
        first = unflown[0]
        last = unflown[-1]
        legs = f"leg {last}" if first == last else f"legs {first} to {last}"
        figures = {"first": first, "last": last}
        sentence = f"{legs} not flown"
        shortfalls.append(Shortfall(aim=Aim.ROUTE, sentence=sentence, figures=figures))
    distance = 0.0 if has_landed else orbit_missed_by(tape, section)
    if distance:
        sentence = f"the last orbit not joined: {distance:.0f} m"
        figures = {"distance_m": distance}
        shortfalls.append(Shortfall(aim=Aim.ORBIT, sentence=sentence, figures=figures))
    return shortfalls
