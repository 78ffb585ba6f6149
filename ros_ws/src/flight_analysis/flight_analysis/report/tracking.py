# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Judge whether a flight tracks the reference as well as the linear loop would.

The rms error of an output, over any WINDOW and over the last END of the flight, may be at most

    min(FACTOR rms(e by commands) + excuse, FACTOR rms(e)) + floor

Here e is the error of the linear loop from `linear_flight.error_pair`, and "e by commands" is the
part of e that the commands cause. For an output with a command of its own, the first term is at
most COMMAND_PART rms(y_m).

The excuse is FACTOR times the part of e that noise and wind cause, and at most MOST over a WINDOW.
If an aircraft shakes more than this, the flight is no success, whatever the cause.

The floor is the sum of

- the fraction HARMLESS of the least errors of a divergence, 0.02 rad/s for a rate and 0.2 m/s for
  the airspeed. If the wind is unknown, the whole of these least errors is taken, 0.1 rad/s and 1
  m/s;
- FACTOR times the noise of a measured error, at most MOST.

If the model of the aircraft is unknown, its drag is unknown as well. While V changes by its command
or by the wind, the floor of V is then at least the fraction SPEED_PART of the trim speed.

`rise_di_controller.learning.divergence` keeps a learned model below the least errors of a
divergence.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from aircraft_sim.params import AircraftConfig
from flight_analysis.report.display_units import (
    STATES,
    DisplayUnit,
    display_unit,
    plain_number,
    unlike_numbers,
)
from flight_analysis.report.linear_flight import AIRSPEED, ErrorPair, error_pair
from flight_analysis.report.starvation import Starvation
from flight_core.modes import Mode
from flight_core.outcome import Aim, Allowance, Shortfall
from flight_core.rates import seconds
from flight_core.tape import Signal, Tape
from flight_core.units import SPEED, quantity
from flight_core.vectors import FloatArray
from rise_di_controller.internals import Saturation
from rise_di_controller.learning.divergence import HARMLESS, LEAST, LEAST_RATE, WINDOW, period
from rise_di_controller.params import ControllerConfig

FACTOR = 2.0
"""Factor on the error of the linear loop. An input with half of its effect doubles the error, while
healthy flights have at most 1.3 times the error."""

COMMAND_PART = 0.5
"""Upper limit of the part of the allowed error that commands cause, as a fraction of rms(y_m). A
law is no success if it is so weak that even its linear loop does not follow the command. An output
counts as commanded if its rms(y_m) is more than twice the floor, and if no other output of its kind
has an rms(y_m) of more than twice this size."""

END = 1.0
"""Length of the end of a flight, s. An error that grows is larger there than over WINDOW."""

MOST = {"V": 6.0}
"""Largest excuse for noise and wind, m/s. In severe turbulence of MIL-F-8785C, sigma = 3.05 m/s at
4000 ft, V of a Cessna has an rms error of 3 m/s over a second, because its engine is too slow for
gusts. Twice this is allowed."""

MOST_RATE = 0.05
"""The same for a rate, rad/s (3 deg/s). In severe turbulence, 45 kt at 20 ft by MIL-F-8785C, the
osprey has an error of 0.024 rad/s. Twice this is allowed."""

SPEED_PART = 0.0075
"""Error due to the drag of an unknown polar, as a fraction of the trim speed, while V changes by a
few m/s. While V is constant, a law with an integral of e removes this error."""

SATURATED = 0.5  # share of the ticks; a stable osprey has at most 0.14 in moderate gusts
SIDE = 0.1  # share of the ticks at either limit


class Excess(NamedTuple):
    """The rms error of an output over a part of a flight, and the error allowed there, SI."""

    output: str
    start: float  # s
    stop: float  # s
    rms: float
    allowed: float
    excuse: float  # part of `allowed` that is for noise and wind
    is_noise: bool  # whether noise causes more of the excuse than wind


class TrackingVerdict(NamedTuple):
    """The verdict on the tracking errors of a flight."""

    shortfalls: list[Shortfall]
    allowances: list[Allowance]
    # the worst part of the flight for each output, whether its error is allowed or not
    worst: tuple[Excess, ...] = ()
    is_excused: bool = False  # whether an output is off only in spans with a busy host


def tracking_verdict(
    tape: Tape,
    controller: ControllerConfig,
    aircraft: AircraftConfig | None,
    *,
    may_pause: bool = True,
    starved: Starvation | None = None,
) -> TrackingVerdict:
    """Judge the tracking errors: return which of them are too large, and which are excused.

    Noise or wind can excuse an error. Each error is the error of one output in the worst part of
    the flight. If `may_pause` is True, ticks of an inactive controller are left out. The spans
    `starved`, in which the host was too busy, are left out as well.
    """
    nothing = TrackingVerdict([], [])
    if not {"y", "y_m"} <= set(tape.signals):
        return nothing
    pair = error_pair(tape, controller, aircraft, may_pause=may_pause)
    if pair is None or not _has_engaged(tape):
        return nothing
    verdict = _verdict(pair, aircraft)
    if starved is None or not starved.spans or not verdict.shortfalls:
        return verdict
    fed = pair._replace(is_flown=pair.is_flown & ~starved.is_starved(pair.t))
    remaining = _verdict(fed, aircraft) if fed.is_flown.any() else nothing
    is_excused = len(remaining.shortfalls) < len(verdict.shortfalls)
    return remaining._replace(is_excused=is_excused)


def _verdict(pair: ErrorPair, aircraft: AircraftConfig | None) -> TrackingVerdict:
    """Judge the errors in the ticks that `pair.is_flown` selects."""
    if not pair.is_flown.any():
        sentence = "no error in the log while the law was engaged"
        return TrackingVerdict([Shortfall(aim=Aim.LOG, sentence=sentence)], [])
    speed = 0.0 if aircraft is None else aircraft.channels().speed
    units = {} if aircraft is None else aircraft.channels().outputs
    shortfalls = []
    allowances = []
    worst_of_each = []
    if pair.not_numbers:
        sentence = f"{pair.not_numbers} ticks with an error that is not a number"
        shortfalls.append(Shortfall(aim=Aim.LOG, sentence=sentence))
    for i, name in enumerate(pair.names):
        unit = units.get(name, STATES.get(name, "rad/s"))
        group = [
            k for k, output in enumerate(pair.names) if (output == AIRSPEED) is (name == AIRSPEED)
        ]
        limits = _Limits(floor=_floor(pair, i, unit), most=_most(unit), drag=_drag(pair, i, speed))
        excesses = _excesses(pair, i, group, limits)
        worst = max(excesses, key=lambda excess: excess.rms / excess.allowed)
        worst_of_each.append(worst)
        if worst.rms > worst.allowed:
            shortfalls.append(_shortfall(worst, pair, i, display_unit(unit)))
            continue
        excused = max(excesses, key=lambda excess: excess.rms - excess.allowed + excess.excuse)
        if excused.rms > excused.allowed - excused.excuse:
            allowances.append(_allowance(excused, display_unit(unit)))
    return TrackingVerdict(shortfalls, allowances, tuple(worst_of_each))


class _Limits(NamedTuple):
    """Errors, SI, that an output may have in addition to the error of the linear loop."""

    floor: float
    most: float  # largest excuse for noise and wind
    drag: float  # floor while the output changes, if it is larger than `floor`


def _has_engaged(tape: Tape) -> bool:
    """Return whether the law engaged in any tick."""
    return "internals" in tape and bool((tape["internals"]["mode"] == Mode.ENGAGED).any())


def _floor(pair: ErrorPair, i: int, unit: str) -> float:
    """Return the floor of the allowed error of output i, SI: a part that is always allowed.

    `unit` is the unit of the output.
    """
    is_speed = quantity(unit).dimension == SPEED
    smallest = LEAST[AIRSPEED] if is_speed else LEAST_RATE
    if pair.knowledge.has_wind:
        smallest = HARMLESS * smallest
    return smallest + min(FACTOR * float(pair.noise[i]), _most(unit))


def _drag(pair: ErrorPair, i: int, speed: float) -> float:
    """Return the error, SI, that an unknown drag causes in output i while the output changes.

    `speed` is the trim speed V0, m/s.
    """
    is_known = pair.knowledge.has_model or pair.names[i] != AIRSPEED
    return 0.0 if is_known else SPEED_PART * speed


def _most(unit: str) -> float:
    """Return the largest excuse for noise and wind, SI, of an output with this unit."""
    return MOST[AIRSPEED] if quantity(unit).dimension == SPEED else MOST_RATE


def _excesses(pair: ErrorPair, i: int, group: list[int], limits: _Limits) -> list[Excess]:
    """Return the worst parts of the flight for output i.

    The result has up to two parts for each span in which the law was engaged, and two for the last
    END of the flight. Spans shorter than END are left out if there is a longer one. `group` holds
    the outputs of the same kind as output i. The kinds are the airspeed and the rates.
    """
    edges = np.flatnonzero(np.diff(np.concatenate([[False], pair.is_flown, [False]])))
    spans = list(zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True))
    longest = max(stop - start for start, stop in spans)
    shortest = min(_ticks(pair, END), longest)
    spans = [(start, stop) for start, stop in spans if stop - start >= shortest]
    start, stop = spans[-1]
    end = (max(start, stop - _ticks(pair, END)), stop)
    excesses = []
    for span in (*spans, end):
        excesses += _largest_excesses(pair, i, group, limits, span)
    return excesses


def _largest_excesses(
    pair: ErrorPair, i: int, group: list[int], limits: _Limits, span: tuple[int, int]
) -> list[Excess]:
    """Return the two worst parts of a span of ticks for output i, each of the length WINDOW.

    The first part has the largest ratio of rms error to allowed error. The second part needs the
    largest excuse. If the span is shorter than WINDOW, its only part is the whole span.
    """
    start, stop = span
    count = min(_ticks(pair, WINDOW), stop - start)

    def rms(values: FloatArray, output: int = i) -> FloatArray:
        squares = _sums(values[start:stop, output] ** 2, count)
        return np.sqrt(np.maximum(squares, 0.0) / count)

    command = rms(pair.y_m)
    by_noise = rms(pair.linear.noise)
    by_wind = rms(pair.linear.wind)
    mean = _sums(pair.y_m[start:stop, i], count) / count
    change = np.sqrt(np.maximum(command**2 - mean**2, 0.0))
    is_changing = np.maximum(change, by_wind) > 0.5 * limits.floor
    floor = np.where(is_changing, np.maximum(limits.drag, limits.floor), limits.floor)
    others = np.max([rms(pair.y_m, output) for output in group], axis=0)
    has_command = (command >= 0.5 * others) & (command > 2.0 * floor)
    # Over a span that is shorter than WINDOW, a harmless gust has a larger rms.
    most = limits.most * math.sqrt(_ticks(pair, WINDOW) / count)
    excuse = np.minimum(FACTOR * np.hypot(by_noise, by_wind), most)
    by_command = FACTOR * rms(pair.linear.command)
    by_command = np.where(has_command, np.minimum(by_command, COMMAND_PART * command), by_command)
    allowed = np.minimum(by_command + excuse, FACTOR * rms(pair.linear.whole)) + floor
    error = rms(pair.e)
    return [
        Excess(
            output=pair.names[i],
            start=float(pair.t[start + k]),
            stop=float(pair.t[start + k + count - 1]),
            rms=float(error[k]),
            allowed=float(allowed[k]),
            excuse=float(max(allowed[k] - by_command[k] - floor[k], 0.0)),
            is_noise=bool(by_noise[k] > by_wind[k]),
        )
        for k in (int(np.argmax(error / allowed)), int(np.argmax(error - by_command)))
    ]


def _ticks(pair: ErrorPair, length: float) -> int:
    """Return the number of ticks in a time of `length` s, at least 1."""
    return max(round(length / (pair.t[1] - pair.t[0])), 1) if len(pair.t) > 1 else 1


def _sums(values: FloatArray, count: int) -> FloatArray:
    """Return the sum of every `count` successive values."""
    total = np.concatenate([[0.0], np.cumsum(values)])
    return np.asarray(total[count:] - total[:-count])


def _shortfall(excess: Excess, pair: ErrorPair, i: int, unit: DisplayUnit) -> Shortfall:
    """Return a shortfall for an error that is too large. It states the cycle of an oscillation."""
    rms, allowed = unlike_numbers(excess.rms * unit.factor, excess.allowed * unit.factor)
    brief = f"{excess.output} off by {rms} {unit.unit} rms, {allowed} allowed"
    sentence = f"{brief}, from t = {excess.start:.1f} to {excess.stop:.1f} s"
    rows = (pair.t >= excess.start) & (pair.t <= excess.stop)
    samples = period(pair.e[rows, i])
    if samples:
        sentence += f", a cycle of {samples * (pair.t[1] - pair.t[0]):.2g} s"
    return Shortfall(
        aim=Aim.ERROR,
        sentence=sentence,
        brief=brief,
        times=excess.rms / excess.allowed,
        figures=excess._asdict(),
    )


def _allowance(excess: Excess, unit: DisplayUnit) -> Allowance:
    """Return an allowance: a remark on an error that is allowed because of noise or wind."""
    rms = plain_number(excess.rms * unit.factor)
    cause = "sensor noise" if excess.is_noise else "wind"
    sentence = f"{excess.output} off by {rms} {unit.unit} rms, allowed for {cause}"
    return Allowance(sentence=sentence, figures=excess._asdict())


def saturation_notes(tape: Tape) -> list[str]:
    """Return sentences on inputs that jump between their two limits in most ticks of a WINDOW.

    Such an input is at a limit in at least the fraction SATURATED of the ticks, and at each of its
    two limits in at least the fraction SIDE. A throttle that is full in a climb is at one limit
    only, so there is no sentence on it. A limit of the rate is not examined, because noise drives a
    slow engine to both of its rate limits.
    """
    if "internals" not in tape:
        return []
    limits = tape["internals"].group("limited")
    u = tape["internals"].group("u")
    u_free = tape["internals"].group("u_free")
    notes = []
    for name in sorted({*limits.names} & {*u.names} & {*u_free.names}, key=limits.names.index):
        at_limit = limits[name] == Saturation.MAGNITUDE
        share_above = _windowed(limits, at_limit & (u_free[name] > u[name]))
        share_below = _windowed(limits, at_limit & (u_free[name] < u[name]))
        alternates = np.minimum(share_above, share_below) >= SIDE
        worst = np.where(alternates, share_above + share_below, 0.0).max(initial=0.0)
        if worst >= SATURATED:
            notes.append(
                f"{name} went from limit to limit in {100.0 * worst:.0f} % of {WINDOW:g} s: it has "
                "no effect, too little, or its loop is unstable"
            )
    return notes


def _windowed(signal: Signal, values: NDArray[np.generic]) -> FloatArray:
    """Return the mean of the values over every whole WINDOW of samples."""
    steps = np.diff(signal.stamp_ns)
    count = round(WINDOW / seconds(int(np.median(steps)))) if len(steps) else 1
    return _sums(values.astype(np.float64), count) / count if len(values) >= count else np.zeros(0)
