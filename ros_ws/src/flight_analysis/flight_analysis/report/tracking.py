# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Whether a flight tracks the reference as the linear loop does.

The rms error over WINDOW, and over END at the end, may be

    FACTOR rms(e) + floor,  of an output with a command of its own at most
    COMMAND_PART rms(y_m) + FACTOR rms(e without commands) + floor

with e of the linear loop by `linear_flight.error_pair`. The floor is

- HARMLESS of the least errors of a divergence, 0.02 rad/s and 0.2 m/s, and the noise of a measured
  error;
- SPEED_PART of the trim speed where the model of the aircraft is unknown, and with it the drag;
- the least errors of a divergence, 0.1 rad/s and 1 m/s, where the wind is unknown.

`rise_di_controller.learning.divergence` keeps a learned model below the least errors.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from aircraft_sim.params import AircraftConfig
from flight_analysis.report.display_units import STATES, DisplayUnit, display_unit
from flight_analysis.report.linear_flight import AIRSPEED, ErrorPair, error_pair
from flight_core.modes import Mode
from flight_core.outcome import Aim, Shortfall
from flight_core.rates import seconds
from flight_core.tape import Signal, Tape
from flight_core.units import SPEED, quantity
from flight_core.vectors import FloatArray
from rise_di_controller.internals import Saturation
from rise_di_controller.learning.divergence import HARMLESS, LEAST, LEAST_RATE, WINDOW, period
from rise_di_controller.params import ControllerConfig

FACTOR = 2.0
"""Of the error of the linear loop: an input of half the effect doubles the error. Healthy flights
have at most 1.3."""

COMMAND_PART = 0.5
"""Of a command: a weak law, whose linear loop does not follow it either, is no success. An output
has a command of its own where no other one of its kind has twice as much."""

END = 1.0
"""s, length of the end of a flight: an error that grows is larger there than over WINDOW."""

SPEED_PART = 0.05
"""Of the trim speed. Beyond, `flight_guidance.steering.protection` keeps V by the climb."""

SATURATED = 0.5  # of the ticks: a stable loop of the osprey has 0.14 at most in moderate gusts
SIDE = 0.1  # of the ticks, on either side


class Excess(NamedTuple):
    """The rms error of an output over a part of a flight, beyond what is allowed, SI."""

    output: str
    start: float  # s
    stop: float  # s
    rms: float
    allowed: float


def tracking_shortfalls(
    tape: Tape, controller: ControllerConfig, aircraft: AircraftConfig | None
) -> list[Shortfall]:
    """The outputs with a larger error than allowed, with the worst part of the flight."""
    if not {"y", "y_m"} <= set(tape.signals):
        return []
    pair = error_pair(tape, controller, aircraft)
    if pair is None:
        return []
    if not _has_engaged(tape):
        return []
    if not pair.is_flown.any():
        sentence = "no error in the log while the law was engaged"
        return [Shortfall(aim=Aim.LOG, sentence=sentence)]
    speed = 0.0 if aircraft is None else aircraft.channels().speed
    units = {} if aircraft is None else aircraft.channels().outputs
    shortfalls = []
    if pair.not_numbers:
        sentence = f"{pair.not_numbers} ticks with an error that is not a number"
        shortfalls.append(Shortfall(aim=Aim.LOG, sentence=sentence))
    for i, name in enumerate(pair.names):
        unit = units.get(name, STATES.get(name, "rad/s"))
        group = [
            k for k, output in enumerate(pair.names) if (output == AIRSPEED) is (name == AIRSPEED)
        ]
        worst = _worst(pair, i, group, _floor(pair, i, speed, unit))
        if worst is not None:
            shortfalls.append(_shortfall(worst, pair, i, display_unit(unit)))
    return shortfalls


def _has_engaged(tape: Tape) -> bool:
    """Whether the law engaged."""
    return "internals" in tape and bool((tape["internals"]["mode"] == Mode.ENGAGED).any())


def _floor(pair: ErrorPair, i: int, speed: float, unit: str) -> float:
    """The floor of an output, SI; `speed`: V0, m/s; `unit`: of the output."""
    is_speed = quantity(unit).dimension == SPEED
    smallest = LEAST[AIRSPEED] if is_speed else LEAST_RATE
    if pair.knowledge.has_wind:
        smallest = HARMLESS * smallest
    if pair.names[i] == AIRSPEED and not pair.knowledge.has_model:
        smallest = max(smallest, SPEED_PART * speed)
    return smallest + FACTOR * float(pair.noise[i])


def _worst(pair: ErrorPair, i: int, group: list[int], floor: float) -> Excess | None:
    """The part of a flight with the largest error over the allowed error; None within.

    `group`: the airspeed, or the rates.
    """
    edges = np.flatnonzero(np.diff(np.concatenate([[False], pair.is_flown, [False]])))
    spans = list(zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True))
    longest = max(stop - start for start, stop in spans)
    shortest = min(_ticks(pair, END), longest)
    spans = [(start, stop) for start, stop in spans if stop - start >= shortest]
    excesses = [_largest_excess(pair, i, group, floor, span) for span in spans]
    start, stop = spans[-1]
    end = (max(start, stop - _ticks(pair, END)), stop)
    excesses.append(_largest_excess(pair, i, group, floor, end))
    violations = [excess for excess in excesses if excess.rms > excess.allowed]
    return max(violations, key=lambda excess: excess.rms / excess.allowed, default=None)


def _largest_excess(
    pair: ErrorPair, i: int, group: list[int], floor: float, span: tuple[int, int]
) -> Excess:
    """The part of WINDOW in a span of ticks with the largest rms over the allowed error.

    A shorter span is a single part.
    """
    start, stop = span
    count = min(_ticks(pair, WINDOW), stop - start)

    def rms(values: FloatArray, output: int = i) -> FloatArray:
        squares = _sums(values[start:stop, output] ** 2, count)
        return np.sqrt(np.maximum(squares, 0.0) / count)

    command = rms(pair.y_m)
    others = np.max([rms(pair.y_m, output) for output in group], axis=0)
    has_command = (command >= 0.5 * others) & (command > 2.0 * floor)
    by_command = COMMAND_PART * command + FACTOR * rms(pair.wind_error)
    linear = FACTOR * rms(pair.linear)
    allowed = np.where(has_command, np.minimum(linear, by_command), linear) + floor
    error = rms(pair.e)
    k = int(np.argmax(error / allowed))
    return Excess(
        output=pair.names[i],
        start=float(pair.t[start + k]),
        stop=float(pair.t[start + k + count - 1]),
        rms=float(error[k]),
        allowed=float(allowed[k]),
    )


def _ticks(pair: ErrorPair, length: float) -> int:
    """The ticks of a length, s."""
    return max(round(length / (pair.t[1] - pair.t[0])), 1) if len(pair.t) > 1 else 1


def _sums(values: FloatArray, count: int) -> FloatArray:
    """Sums over each `count` values in a row."""
    total = np.concatenate([[0.0], np.cumsum(values)])
    return np.asarray(total[count:] - total[:-count])


def _shortfall(excess: Excess, pair: ErrorPair, i: int, unit: DisplayUnit) -> Shortfall:
    """The shortfall of an excess, with the period of a limit cycle."""
    rms = excess.rms * unit.factor
    allowed = excess.allowed * unit.factor
    sentence = (
        f"{excess.output} off by {rms:.2g} {unit.unit} rms from t = {excess.start:.1f} to "
        f"{excess.stop:.1f} s, {allowed:.2g} allowed"
    )
    rows = (pair.t >= excess.start) & (pair.t <= excess.stop)
    samples = period(pair.e[rows, i])
    if samples:
        sentence += f", a cycle of {samples * (pair.t[1] - pair.t[0]):.2g} s"
    return Shortfall(aim=Aim.ERROR, sentence=sentence, figures=excess._asdict())


def saturation_notes(tape: Tape) -> list[str]:
    """Sentences on inputs that went from limit to limit in SATURATED of the ticks of WINDOW.

    SIDE or more of these are on either side. A climb at full throttle stays on one side. A limit of
    the rate does not count: noise reaches the rate of a slow engine to either side.
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
    """Means over each whole WINDOW of samples."""
    steps = np.diff(signal.stamp_ns)
    count = round(WINDOW / seconds(int(np.median(steps)))) if len(steps) else 1
    return _sums(values.astype(np.float64), count) / count if len(values) >= count else np.zeros(0)
