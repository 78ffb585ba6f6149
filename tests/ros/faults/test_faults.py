# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Each fault is noticed in time, does to u what it may and no more, and leaves nothing behind."""

import time
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple
from zlib import crc32

import numpy as np
import pytest
from rcl_interfaces.msg import Log
from rclpy.serialization import deserialize_message
from tests.ros.faults.cases import BACK, CASES, SLACK, Case, Does
from tests.ros.faults.conftest import Hangar, Row
from tests.ros.faults.flight import HOLD, INPUTS, MAX_AGE, RAMP, SILENCE, TICK, Flight, logged

from rise_di_controller.guard import Mode

MOVES = 0.15
"""rad, 1: how far the law moves u in a steady flight with ticks that come late, and on the last of the way to it. One foreign
sample would move it twice as far: K e scale = 18 rad/s * 1 rad/s * 0.0178 rad s^2/rad = 0.3 rad."""

USUAL = 0.5
"""rad/s, m/s. No output of the steady flight is ever beyond; foreign samples have four channels, spread over -1 to 1."""

QUIET = 0.02
"""s. Where the machine held a process of the flight back for longer, the flight was a disturbed one without the fault too: then
what is judged is what no machine excuses, and times with what it held back on top."""

EXACT = 1e-12  # of what is only copied, or multiplied once

RESTS = 0.2  # s, after which what a fault has done to u has arrived


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_a_fault_is_noticed_contained_and_over(case: Case, hangar: Hangar, seeds: range, record: Callable[[Row], None]) -> None:
    for seed in seeds:
        flight = hangar.flight(own_clock=case.own_flight)
        flight.measured = {}
        row: Row = {"case": case.name, "seed": seed, "does": case.does.value, "expected": case.noticed is not None}
        try:
            case.inject(flight, np.random.default_rng((seed, crc32(case.name.encode()))))
            noticed, recovery, held_back = judge(case, flight)
        except BaseException as error:
            record(row | {"passed": False, "error": f"{type(error).__name__}: {str(error).splitlines()[:1]}"})
            hangar.scrap()
            raise
        flight.witness(f"{case.name}, seed {seed}", flight.begin)
        row |= {"passed": True, "reaction": noticed, "recovery": recovery, "held_back": held_back}
        record(row | flight.measured)


def test_the_log_holds_what_was_heard_during_each_fault(hangar: Hangar) -> None:
    """To the byte, also of a time without a recorder: publishers keep their last samples for the next one.

    Of a node that was killed, the log may end within UNREPEATED of its end: nobody is left to repeat what the recorder has
    missed. It may end there, but not leave out one and have the next.
    """
    hangar.scrap()
    for flight in hangar.flown:
        internals, said = heard_again(flight.runs)
        for case, witnessed in flight.witnessed.items():
            assert witnessed.internals <= internals, case
            assert witnessed.said <= said, case
            for last in witnessed.last:
                found = [one in internals for one in last]
                assert found == sorted(found, reverse=True), case


def heard_again(runs: list[Path]) -> tuple[set[bytes], set[tuple[str, str]]]:
    """All `internals`, and who said what, in some logs."""
    internals, said = set(), set()
    for one in (message for run in runs for message in logged(run)):
        if one.topic == "/internals":
            internals.add(one.data)
        elif one.topic == "/rosout":
            line = deserialize_message(one.data, Log)
            said.add((line.name, line.msg))
    return internals, said


def judge(case: Case, flight: Flight) -> tuple[float | None, float, float]:
    """All that the case promises; when it was noticed, how long it took to be as before, what the machine held back, s."""
    begin, end = flight.begin, flight.end
    noticed = None
    if case.noticed is not None:
        noticed = flight.until(lambda: case.noticed(flight), case.within + 3.0, "noticed") - begin  # type: ignore[misc]
        noticed = max(noticed, 0.0)  # two messages, that of the fault and that which tells of it, may overtake each other
    # engaged again, and so for long enough that it is no accident
    since = flight.until(lambda: lasting(flight, begin, end), 10.0, "engaged again")
    held_back = 0.0 if case.does is Does.LATE else flight.held_back(begin - 0.1, since + RESTS)
    slack = SLACK + 2.0 * held_back  # that of two processes one after the other, of the node and of the probe
    window = Window(begin, end, since, held_back, slack)
    recovery = max(since - end, 0.0)
    if noticed is not None:
        allowed = case.within + slack
        assert noticed <= allowed, f"noticed after {noticed:.3f} s, allowed {allowed:.3f} s"
    allowed = case.recovers + slack
    disturbed = case.does is Does.FLIES and held_back > QUIET  # by the machine, then and later
    assert recovery <= allowed or disturbed, f"engaged {recovery:.3f} s after the fault, allowed {allowed:.3f} s"
    if (back := flight.measured.get("ready_to_traffic")) is not None:
        assert back <= BACK + slack, f"full traffic {back:.3f} s after it was ready"
    if (caught_up := flight.measured.get("ready_to_caught_up")) is not None:
        assert caught_up <= BACK + slack, f"what publishers had kept taken {caught_up:.3f} s after it was ready"
    CHECKS[case.does](case, flight, window)
    for role, process in flight.processes.items():
        assert process.popen.poll() is None, f"{role} has ended: {process.output}"
        assert "Traceback" not in process.output
    flight.until_steady()
    return noticed, recovery, held_back


def lasting(flight: Flight, begin: float, end: float) -> float | None:
    """Since when the law has flown without a break for RESTS after the fault."""
    since = flight.engaged(begin)
    return since if since is not None and time.time() - max(since, end) >= RESTS else None


class Window(NamedTuple):
    """When a fault began and ended, when the law flew again; what the machine held back, and what is allowed for it."""

    begin: float
    end: float
    since: float
    held_back: float
    slack: float


def flies(case: Case, flight: Flight, window: Window) -> None:
    """The law flew on, from samples of its own flight alone, and so did the aircraft; no link paused beyond its age limit."""
    until = window.end + RESTS
    flown, (_, moved) = flight.flown(window.begin, until), flight.moved(window.begin, until)
    before = flight.flown(window.begin - 0.5, until)
    if window.held_back < MAX_AGE + HOLD + RAMP:  # else the flight was over, and another aircraft might have taken over
        assert np.abs(flown.y).max() <= USUAL
        assert np.abs(flown.y_m).max() <= USUAL
    if window.held_back < SILENCE:  # else another controller might have taken over
        assert np.abs(moved).max() <= USUAL
    held_back = window.held_back > QUIET
    if not held_back:  # else the aircraft may have let go of u
        low, high = before.u.min(axis=0), before.u.max(axis=0)
        assert (moved >= low - MOVES / 10).all()
        assert (moved <= high + MOVES / 10).all()
    # The probe listens with best effort: of a topic in a storm its socket drops what the flight's own readers get again.
    stormed = case.name.removeprefix("storm on ")
    topics = tuple(topic for topic in ("y", "y_m", "u", "truth", "internals") if topic != stormed)
    found = survive(flight, topics, window.begin, until, window)
    if not held_back:
        assert flown.modes == [Mode.ENGAGED], found
        # not the thrust, which may still be on its way back from an earlier fault
        assert np.abs((flown.u - before.u[0])[:, : INPUTS.index("thrust")]).max() <= MOVES


def survive(flight: Flight, topics: tuple[str, ...], begin: float, end: float, window: Window) -> dict[str, float]:
    """No topic paused for longer than its age limit; the pauses, s."""
    found = {topic: flight.pause(topic, begin, end) for topic in topics}
    limits = {topic: (SILENCE if topic == "u" else MAX_AGE) + 2.0 * window.held_back for topic in topics}
    assert all(pause <= limits[topic] for topic, pause in found.items()), (found, window)
    flight.measured["longest_pause"] = max(found.values())
    return found


def lets_go(case: Case, flight: Flight, window: Window) -> None:
    """HOLD: u to the last bit as it was; RAMP: a straight line to trim; TRIM: 0; then engaged without a jump."""
    flown = flight.flown(window.begin, window.since + RESTS)
    if window.held_back > QUIET:
        assert {Mode.TRIM} <= set(flown.modes) <= set(Mode) - {Mode.WAITING, Mode.INACTIVE}
        return
    assert [mode for mode in flown.modes if mode is not Mode.ENGAGED] == [Mode.HOLD, Mode.RAMP, Mode.TRIM], flown.modes
    mode, u = flown.mode, flown.u
    held, ramp = u[mode == Mode.HOLD], u[mode == Mode.RAMP]
    assert (held == held[0]).all()
    assert np.abs(held[0]).max() > 1e-4  # else nothing would be shown
    lost = flown.t[mode == Mode.HOLD][0]
    share = ramp @ held[0] / (held[0] @ held[0])
    assert np.abs(ramp - np.outer(share, held[0])).max() <= EXACT
    expected = 1.0 - (flown.t[mode == Mode.RAMP] - lost - HOLD) / RAMP
    assert np.abs(share - expected).max() <= window.slack / RAMP
    assert (np.diff(share) < 0).all()
    assert (u[mode == Mode.TRIM] == 0.0).all()
    engaged = np.flatnonzero((mode[1:] == Mode.ENGAGED) & (mode[:-1] != Mode.ENGAGED)) + 1
    assert (u[engaged] == u[engaged - 1]).all()
    # controllers have nothing new to say until y or y_m is stale; that is well within the aircraft's own limit
    survive(flight, ("u", "y_m") if "aircraft" in case.name else ("u", "y", "truth"), window.begin, window.since, window)


def is_let_go(case: Case, flight: Flight, window: Window) -> None:
    """The aircraft holds its last input for the age limit and HOLD, then ramps it to trim; and takes it up without a jump."""
    t, moved = flight.moved(window.begin, window.since + RESTS)
    before = flight.moved(window.begin - 0.5, window.begin + 0.05)[1][-1]
    assert np.abs(before).max() > 1e-4  # else nothing would be shown
    if window.held_back > QUIET:
        assert (moved == 0.0).all(axis=1).any()
        return
    share, after = moved @ before / (before @ before), t - window.begin
    assert np.abs(share[(after > 0.05) & (after < SILENCE + HOLD - 0.02)] - 1.0).max(initial=0.0) <= EXACT
    ramp = (after > SILENCE + HOLD) & (after < SILENCE + HOLD + RAMP)
    assert np.abs(share[ramp] - 1.0 + (after[ramp] - SILENCE - HOLD) / RAMP).max(initial=0.0) <= window.slack / RAMP
    gone = (after > SILENCE + HOLD + RAMP + window.slack) & (t < min(window.end, window.since) - 0.01)
    assert gone.any()
    assert (moved[gone] == 0.0).all()
    # taken up without a jump: what the controller first commands is what the aircraft has, and that it flies from there on;
    # from the log, for the probe may meet a new controller later than the aircraft does
    ticks = flight.until(lambda: flight.engaged_ticks(window.end, window.since + RESTS), 5.0, "the new ticks in the log")
    assert (ticks.u[0] == 0.0).all()
    taken_up = moved[(t > window.end) & (moved != 0.0).any(axis=1)][0]
    (number,) = np.flatnonzero((ticks.u == taken_up).all(axis=1))[:1]
    assert number <= 2 + window.slack / TICK
    survive(flight, ("y", "y_m", "truth"), window.begin, window.since, window)


def flies_late(case: Case, flight: Flight, window: Window) -> None:
    """The law flies, or u is held where samples came too late; u does not move more than it does in a steady flight."""
    flown = flight.flown(window.begin, window.end + RESTS)
    assert set(flown.modes) <= {Mode.ENGAGED, Mode.HOLD, Mode.RAMP}
    assert np.abs(flown.y).max() <= USUAL
    assert np.abs(flown.u).max() <= 10.0 * MOVES


CHECKS = {Does.FLIES: flies, Does.LETS_GO: lets_go, Does.IS_LET_GO: is_let_go, Does.LATE: flies_late}
