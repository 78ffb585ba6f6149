# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test that each fault is detected in time, and changes u only by the failsafe.

After the recovery no effect remains.
"""

import math
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple
from zlib import crc32

import numpy as np
import pytest
from rcl_interfaces.msg import Log
from rclpy.serialization import deserialize_message
from tests.ros.conftest import logged
from tests.ros.flight_bringup.faults.cases import LEVEL, RESTART, SLACK, Case, Response
from tests.ros.flight_bringup.faults.conftest import Flights, Row, described
from tests.ros.flight_bringup.faults.draws import Draw, inject
from tests.ros.flight_bringup.faults.flight import HOLD, MAX_AGE, RAMP, TICK, U_MAX_AGE, Flight
from tests.ros.flight_bringup.faults.foreign import JUMP

from flight_analysis.closed_loop.scenario import load_scenario
from flight_core.modes import Mode

pytestmark = pytest.mark.alone

MOVES = 0.15
"""rad, 1: how far the law moves u in a steady flight with late ticks, and while u settles. One
sample of a conflicting publisher would move it twice as far: K e scale = 18 rad/s * 1 rad/s *
0.0178 rad s^2/rad = 0.3 rad."""

USUAL = 0.5
"""rad/s, m/s. Outputs of the steady flight are below it. The samples of conflicting publishers
spread over -1 to 1 in four channels."""

QUIET = 0.02
"""s. A longer host scheduling delay disturbs the flight also without a fault. Then only the checks
are made that hold under any delay, and the delay is added to the time limits."""

EXACT = 1e-12  # of values that are copied, or multiplied once
# topics through a fault that does not concern u
CONTINUING = ("y", "y_m", "u", "truth", "internals")
SETTLING = 0.2  # s, until the effect of a fault on u shows


def test_fault_is_detected_contained_and_recovered_from(
    case: Case, flights: Flights, seeds: range, record: Callable[[Row], None]
) -> None:
    for seed in seeds:
        row: Row = {"case": case.name, "seed": seed, "does": case.response.value}
        try:
            flight = flights.steady(case.kind)
            flight.measured = {}
            case.inject(flight, np.random.default_rng((seed, crc32(case.name.encode()))))
            reaction, recovery, host_delay = check(case, flight)
        except BaseException as error:
            record(row | {"passed": False, "error": described(error)})
            flights.close()
            raise
        flight.expect_in_log(f"{case.name}, seed {seed}")
        row |= {"passed": True, "reaction": reaction, "recovery": recovery, "held_back": host_delay}
        row["any_delay"] = host_delay > QUIET
        record(row | flight.measured)


def test_random_faults_detected_contained_and_recovered_from(
    flights: Flights, draws: Sequence[Draw], record: Callable[[Row], None]
) -> None:
    """If there are two faults at a time, each is detected by the right node.

    No process ends, and the flight becomes steady again.
    """
    failed = []
    for draw in draws:
        row: Row = {"case": draw.name, "seed": draw.seed}
        try:
            flight = flights.steady(draw.cases[0].kind)
            views = inject(flight, draw)
            if len(views) == 1:
                check(draw.cases[0], views[0])
            else:
                check_two(draw, views)
            for view in views:
                view.expect_in_log(f"{draw.name}, seed {draw.seed}")
        except (Exception, pytest.fail.Exception, pytest.skip.Exception) as error:
            failed.append(f"{draw.name}, seed {draw.seed}: {error}")
            record(row | {"passed": False, "error": described(error)})
            flights.close()
        else:
            record(row | {"passed": True})
    assert not failed, "\n".join(failed)


def check_two(draw: Draw, views: Sequence[Flight]) -> None:
    """Check what must be true of a fault, whatever the other one does."""
    for case, view in zip(draw.cases, views, strict=True):
        if case.detection is not None:
            view.until(
                lambda case=case, view=view: case.detection(view),  # type: ignore[misc]
                case.within + 3.0,
                f"{case.name}: detected",
            )
    flight = views[0]
    flight.until(lambda: engaged_for(SETTLING, flight), 10.0, "engaged again")
    check_processes(flight)
    flight.until_steady()


def test_log_holds_every_received_message_of_each_fault(flights: Flights) -> None:
    """The log is complete to the byte, also for a time without a recorder.

    Publishers keep their last samples for the next recorder. The last messages of a killed node,
    within NOT_RETRANSMITTED, may be missing, because no process is left to retransmit them. Those
    that are in the log have no gap.
    """
    flights.close()
    for flight in flights.all:
        internals, lines = contents(flight.runs)
        for case, expected in flight.expected_logs.items():
            assert expected.internals <= internals, case
            assert expected.lines <= lines, case
            for last in expected.last:
                in_log = [message in internals for message in last]
                assert in_log == sorted(in_log, reverse=True), case


def contents(runs: list[Path]) -> tuple[set[bytes], set[tuple[str, str]]]:
    """Return all `internals` of some logs, and all log lines with their nodes."""
    internals = set()
    lines = set()
    for topic, record in (message for run in runs for message in logged(run)):
        if topic == "/internals":
            internals.add(record.data)
        elif topic == "/rosout":
            line = deserialize_message(record.data, Log)
            lines.add((line.name, line.msg))
    return internals, lines


class Window(NamedTuple):
    """The re-engagement after a fault, the host's scheduling delay, and the allowed time, s."""

    engaged: float
    host_delay: float
    slack: float


def check(case: Case, flight: Flight) -> tuple[float | None, float, float]:
    """Check all that the case states.

    Returns the time of the detection, of the recovery, and the scheduling delay of the host, s.
    """
    reaction = None
    if case.detection is not None:
        detected = flight.until(lambda: case.detection(flight), case.within + 3.0, "detected")  # type: ignore[misc]
        # the message of the detection may overtake that of the fault
        reaction = max(detected - flight.begin, 0.0)
    engagement = flight.until(lambda: engaged_for(SETTLING, flight), 10.0, "engaged again")
    host_delay = flight.host_delay(flight.begin - 0.1, engagement + SETTLING)
    # there the delay is the fault
    slack = SLACK + case.host_delays * host_delay * (case.response is not Response.LATE)
    recovery = max(engagement - flight.end, 0.0)
    if reaction is not None:
        allowed = case.within + slack
        assert reaction <= allowed, f"detected after {reaction:.3f} s, allowed {allowed:.3f} s"
    # A node starts again, and catches up, in many shares of a busy processor: their delays add up.
    allowed = case.recovery + max(slack, SLACK + flight.waited(flight.end, engagement))
    # by the host, during the fault or later
    disturbed = case.response is Response.UNCHANGED and host_delay > QUIET
    assert recovery <= allowed or disturbed, (
        f"engaged {recovery:.3f} s after the fault, allowed {allowed:.3f} s"
    )
    for key in ("ready_to_traffic", "ready_to_caught_up"):
        duration = flight.measured.get(key, 0.0)
        assert duration <= RESTART + slack, (
            f"{key} {duration:.3f} s, allowed {RESTART + slack:.3f} s"
        )
    CHECKS[case.response](case, flight, Window(engagement, host_delay, slack))
    check_processes(flight)
    flight.until_steady()
    return reaction, recovery, host_delay


def check_processes(flight: Flight) -> None:
    """Check that no process has ended or raised an exception."""
    for role, process in flight.processes.items():
        assert process.popen.poll() is None, f"{role} has ended: {process.output}"
        assert "Traceback" not in process.output


def engaged_for(duration: float, flight: Flight) -> float | None:
    """Return since when the law has been engaged, once this is long enough after the fault."""
    since = flight.engaged_since(flight.begin)
    return since if since is not None and time.time() - max(since, flight.end) >= duration else None


def check_unchanged(case: Case, flight: Flight, window: Window) -> None:
    """Check that the law and the aircraft only used samples of the flight's own nodes.

    No topic may have paused beyond its age limit.
    """
    until = flight.end + SETTLING
    ticks, (_, applied) = (
        flight.ticks(flight.begin, until),
        flight.actuator_positions(flight.begin, until),
    )
    before = flight.ticks(flight.begin - 0.5, until)
    if Mode.TRIM not in ticks.modes:  # else the failsafe was over, and the publisher lock free
        assert not flight.foreign_y(flight.begin, until)
        assert np.abs(ticks.y_m).max() <= USUAL
    # by a storm that uses up the processors: the failsafe may act
    starved = window.host_delay > MAX_AGE
    assert starved or np.abs(ticks.y).max() <= USUAL
    # else the publisher lock of u was free
    if flight.first_line("aircraft", "failsafe", flight.begin - 0.1) is None:
        assert np.abs(applied).max() <= max(USUAL, np.abs(ticks.u).max())
    quiet = window.host_delay <= QUIET
    if quiet:  # else the failsafe of the aircraft may have moved u
        low = before.u.min(axis=0)
        high = before.u.max(axis=0)
        assert (applied >= low - MOVES / 10).all()
        assert (applied <= high + MOVES / 10).all()
    # The probe subscribes with best effort: in a storm its socket drops samples that the flight's
    # nodes receive again.
    flooded = case.name.removeprefix("storm on ")
    topics = tuple(topic for topic in CONTINUING if topic != flooded)
    pauses = check_pauses(flight, topics, until, window, limited=not starved)
    if quiet:
        assert ticks.modes == [Mode.ENGAGED], pauses
        # without the thrust, which may still settle after an earlier fault
        assert np.abs((ticks.u - before.u[0])[:, :-1]).max() <= MOVES


def check_pauses(
    flight: Flight, topics: tuple[str, ...], end: float, window: Window, *, limited: bool = True
) -> dict[str, float]:
    """Check that no topic that is `limited` paused beyond its age limit. Return the pauses, s."""
    pauses = {topic: flight.pause(topic, flight.begin, end) for topic in topics}
    limits = {
        topic: (U_MAX_AGE if topic == "u" else MAX_AGE) + 2.0 * window.host_delay
        for topic in topics
    }
    assert not limited or all(pause <= limits[topic] for topic, pause in pauses.items()), (
        pauses,
        window,
    )
    flight.measured["longest_pause"] = max(pauses.values())
    return pauses


def check_controller_failsafe(case: Case, flight: Flight, window: Window) -> None:
    """Check u in the failsafe: constant in HOLD, a straight line in RAMP, 0 in TRIM.

    A bumpless re-engagement must follow.
    """
    ticks = flight.ticks(flight.begin, window.engaged + SETTLING)
    # the controller does not publish a new tick until y or y_m is stale: well within the aircraft's
    # age limit of u
    topics = ("u", "y_m") if "aircraft" in case.name else ("u", "y", "truth")
    check_pauses(flight, topics, window.engaged, window)
    if window.host_delay > QUIET:
        assert {Mode.TRIM} <= set(ticks.modes) <= set(Mode) - {Mode.WAITING, Mode.INACTIVE}
        return
    assert [mode for mode in ticks.modes if mode is not Mode.ENGAGED] == [
        Mode.HOLD,
        Mode.RAMP,
        Mode.TRIM,
    ], ticks.modes
    mode = ticks.mode
    u = ticks.u
    u_held = u[mode == Mode.HOLD]
    ramp = u[mode == Mode.RAMP]
    assert (u_held == u_held[0]).all()
    assert np.abs(u_held[0]).max() > 1e-4  # u = 0 would prove nothing
    stale = ticks.t[mode == Mode.HOLD][0]
    scale = ramp @ u_held[0] / (u_held[0] @ u_held[0])
    assert np.abs(ramp - np.outer(scale, u_held[0])).max() <= EXACT
    expected = 1.0 - (ticks.t[mode == Mode.RAMP] - stale - HOLD) / RAMP
    assert np.abs(scale - expected).max() <= window.slack / RAMP
    assert (np.diff(scale) < 0).all()
    assert (u[mode == Mode.TRIM] == 0.0).all()
    engagements = np.flatnonzero((mode[1:] == Mode.ENGAGED) & (mode[:-1] != Mode.ENGAGED)) + 1
    assert (u[engagements] == u[engagements - 1]).all()


def check_aircraft_failsafe(case: Case, flight: Flight, window: Window) -> None:
    """Check the failsafe of the aircraft: its last input, then a ramp to trim.

    The input is held for the age limit and HOLD. The next u must be applied without a jump.
    """
    t, applied = flight.actuator_positions(flight.begin, window.engaged + SETTLING)
    before = flight.actuator_positions(flight.begin - 0.5, flight.begin + 0.05)[1][-1]
    assert np.abs(before).max() > 1e-4  # u = 0 would prove nothing
    check_pauses(flight, ("y", "y_m", "truth"), window.engaged, window)
    if window.host_delay > QUIET:
        assert (applied == 0.0).all(axis=1).any()
        return
    scale = applied @ before / (before @ before)
    after = t - flight.begin
    assert (
        np.abs(scale[(after > 0.05) & (after < U_MAX_AGE + HOLD - 0.02)] - 1.0).max(initial=0.0)
        <= EXACT
    )
    ramp = (after > U_MAX_AGE + HOLD) & (after < U_MAX_AGE + HOLD + RAMP)
    assert (
        np.abs(scale[ramp] - 1.0 + (after[ramp] - U_MAX_AGE - HOLD) / RAMP).max(initial=0.0)
        <= window.slack / RAMP
    )
    trim = (after > U_MAX_AGE + HOLD + RAMP + window.slack) & (
        t < min(flight.end, window.engaged) - 0.01
    )
    assert trim.any()
    assert (applied[trim] == 0.0).all()
    # Bumpless: the first u of the controller is that of the aircraft, and the aircraft applies u
    # from the first ticks on. The ticks are those of the log, because the probe may discover a new
    # controller later than the aircraft does.
    ticks = flight.until(
        lambda: flight.engaged_ticks(flight.end, window.engaged + SETTLING),
        5.0,
        "the new ticks in the log",
    )
    assert (ticks.u[0] == 0.0).all()
    first = np.flatnonzero((t > flight.end) & (applied != 0.0).any(axis=1))[0]
    early = ticks.u[: math.ceil(3 + window.slack / TICK)]
    assert t[first] - ticks.t[0] <= 3 * TICK + window.slack
    assert (np.abs(applied[first]) <= np.abs(early).max(axis=0) + EXACT).all(), (
        "the applied u jumps"
    )


def check_late(case: Case, flight: Flight, window: Window) -> None:
    """Check that the law is engaged, or that u is held if samples came too late.

    If the host held processes back until a sample was stale, and for as long as the hold and the
    ramp last, u may end at trim. u must not move more than in a steady flight.
    """
    ticks = flight.ticks(flight.begin, flight.end + SETTLING)
    allowed = {Mode.ENGAGED, Mode.HOLD, Mode.RAMP}
    if window.host_delay > MAX_AGE + HOLD + RAMP:
        allowed.add(Mode.TRIM)
    assert set(ticks.modes) <= allowed
    assert np.abs(ticks.y).max() <= USUAL
    assert np.abs(ticks.u).max() <= 10.0 * MOVES


def check_released(case: Case, flight: Flight, window: Window) -> None:
    """Check that a controller that is not engaged is at trim and computes nothing.

    It must begin at trim, and y_m continues.
    """
    ticks = flight.ticks(flight.begin, window.engaged + SETTLING)
    disengaged = (ticks.t > flight.begin + case.within + window.slack) & (ticks.t < flight.end)
    assert not (ticks.mode[disengaged] == Mode.ENGAGED).any()
    assert (ticks.u[ticks.t >= window.engaged][0] == 0.0).all()
    check_pauses(flight, ("y_m",), window.engaged, window)


# of the ending of u_m, at any time and after LEVEL
MAX_BANK = np.radians(45.0)
MAX_LEVEL_BANK = np.radians(5.0)


def check_wings_levelled(case: Case, flight: Flight, window: Window) -> None:
    """Check that the law flies on, the bank stays bounded, and the wings are level in time.

    When guidance falls silent, the bank is only known by dead reckoning with y_m. While the host
    delays the controller or the aircraft, the roll rate is not the one of y_m. They differ at most
    by the change from a roll-in to one side to a roll-in to the other.
    """
    host_delay = flight.host_delay(flight.begin - 0.1, flight.begin + LEVEL)
    roll_rate = load_scenario(flight.scenario).reference_model.live.roll_rate
    # below it the law stays engaged
    untracked = 2.0 * roll_rate * host_delay if host_delay > MAX_AGE else 0.0
    t, phi = flight.bank(flight.begin, flight.begin + LEVEL)
    flight.measured["bank_deg"] = float(np.degrees(np.abs(phi).max()))
    flight.measured["last_bank_deg"] = float(np.degrees(np.abs(phi[-1])))
    assert np.abs(phi).max() <= MAX_BANK
    assert np.abs(phi[t >= flight.begin + LEVEL - 0.1]).max() <= MAX_LEVEL_BANK + untracked, (
        f"host delay {host_delay:.3f} s"
    )
    check_flies_on(flight, window)


def check_within_limits(case: Case, flight: Flight, window: Window) -> None:
    """Check that the law flies on, and that the bank stays within its limit and overshoot."""
    bank = np.abs(flight.bank(flight.begin)[1]).max()
    assert JUMP["phi"] / 2.0 <= bank <= MAX_GUIDED_BANK
    check_flies_on(flight, window)


MAX_GUIDED_BANK = np.radians(30.0 + 2.0)  # the default limit of guidance, and its overshoot


def check_flies_on(flight: Flight, window: Window) -> None:
    until = flight.end + SETTLING
    check_pauses(flight, CONTINUING, until, window)
    if window.host_delay <= QUIET:
        assert flight.ticks(flight.begin, until).modes == [Mode.ENGAGED]


CHECKS = {
    Response.UNCHANGED: check_unchanged,
    Response.CONTROLLER_FAILSAFE: check_controller_failsafe,
    Response.AIRCRAFT_FAILSAFE: check_aircraft_failsafe,
    Response.LATE: check_late,
    Response.RELEASED: check_released,
    Response.WINGS_LEVELLED: check_wings_levelled,
    Response.WITHIN_LIMITS: check_within_limits,
}
