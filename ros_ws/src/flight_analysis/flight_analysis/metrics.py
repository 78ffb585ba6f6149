# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Compute metrics of a flight, each as a pure function of the tape (the signals) of the flight.

They are the error, the noise floor, the ultimate bound, settling, control effort, saturation and
how often the sign term switches.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from enum import StrEnum
from operator import attrgetter
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from flight_core.modes import Mode
from flight_core.parameters import require
from flight_core.rates import seconds
from flight_core.tape import Signal, Tape, as_tape
from flight_core.vectors import FloatArray, as_array
from rise_di_controller.internals import Saturation

Windows = Mapping[str, tuple[float, float]]

SETTLING_DWELL = 1.0
"""Time beyond its end for which a transient still counts, s. An error has settled if it has stayed
in the band for this time."""

SETTLING_BAND = 0.01  # half-width of the settling band as a fraction of the largest abs(y_m)

MIN_BAND_NOISE_FLOORS = 4.0
"""Least half-width of the settling band of a measured error, as a multiple of the noise floor. With
a probability of 97 %, 500 samples of normal noise stay within 4 noise floors."""

# A flight shows an entry if the entry's standard deviation, relative to its value, is below this
# number. The number is half of the deviation before the flight.
MAX_DEVIATION = 0.15

LONGEST_INTERVAL = 1.0
"""Longest time for which a sample stands, s. A longer interval is a gap in the log, and the rest of
the interval does not count."""

# names that `best_error` returns
TRUE_ERROR = "true error"
MEASURED_ERROR = "measured error"

TURN_BANK = math.radians(5.0)  # guidance turns if it commands more bank than this, rad
# Guidance captures if it commands a flight path that is steeper than CAPTURE_ANGLE, rad. It also
# captures if the path is farther away than the aircraft flies in CAPTURE_TIME, s.
CAPTURE_ANGLE = math.radians(1.0)
CAPTURE_TIME = 0.5

CALM = "calm"
UNKNOWN_AIR = "other"
AIRS = (CALM, "wind", "shear", "turbulence", "microburst", UNKNOWN_AIR)
"""The disturbances of the air except gusts. The part of a flight without gust, command and
engagement is named after this disturbance. UNKNOWN_AIR means that no simulated aircraft flew."""


class TransientKind(StrEnum):
    """What disturbs a flight. The word also names the part of the flight that it disturbs."""

    ENGAGEMENT = "engagement"
    COMMAND = "command"
    GUST = "gust"
    TURN = "turn"
    CAPTURE = "capture"


# In a guided flight, turns and captures replace commands. Their commands change until they end.
GUIDED = (TransientKind.CAPTURE, TransientKind.TURN)


@dataclass(frozen=True, kw_only=True)
class Transient:
    """A disturbance in a flight.

    `start` and `stop` are its first and its last instant, in s of flight time.
    """

    kind: TransientKind
    name: str  # name of the commanded channel or of the gust, or ""
    start: float
    stop: float

    def excites(self, channel: str) -> bool:
        """Return whether the transient excites a channel.

        A command excites only the channel that it commands. Every other transient excites all
        channels.
        """
        return self.kind is not TransientKind.COMMAND or self.name == channel


@dataclass(frozen=True, kw_only=True)
class ErrorMetrics:
    """Tracking error of a channel over some samples, in the unit of the channel."""

    rms: float
    max: float


@dataclass(frozen=True, kw_only=True)
class InputMetrics(ErrorMetrics):
    """Deviation of an input from trim over some samples, in the unit of the input.

    `rate` is the mean of abs(u_dot), in this unit per s.
    """

    rate: float


def best_pose(tape: Tape) -> Signal | None:
    """Return the true pose if the simulation has logged it, else the measured one, if any.

    The channels are `flight_core.channels.POSE`. The true pose is better, because errors of the
    sensors, or a pose from another publisher, change the measured pose but not the aircraft.
    """
    if "truth" in tape and len(tape["truth"].stamp_ns):
        pose = tape["truth"].group("pose")
        if pose.names:
            return pose
    if "pose" in tape and len(tape["pose"].stamp_ns):
        return tape["pose"]
    return None


def tracking_error(tape: Tape) -> Signal:
    """Return the measured error e = y - y_m, (N, m).

    It has a row for each sample of y within the time of y_m. Channels that y_m lacks are left out.
    y_m is interpolated linearly. The law controls this error, which contains the noise of the
    sensors.
    """
    names = _controlled(tape)
    return _minus_reference(
        Signal(tape["y"].stamp_ns, names, _columns(tape["y"], names)), tape["y_m"]
    )


def _controlled(tape: Tape) -> tuple[str, ...]:
    """Return the channels that y and y_m share. Raises ParameterError if there are none."""
    names = tuple(name for name in tape["y"].names if name in tape["y_m"].names)
    require(
        bool(names),
        "the log",
        f"y of {', '.join(tape['y'].names)}",
        f"a channel of y_m: {', '.join(tape['y_m'].names)}",
    )
    return names


def true_error(tape: Tape) -> Signal | None:
    """Return the true error C x - y_m, (N, m), which only a simulation logs.

    It has a row for each sample of the topic `truth` within the time of y_m. The channels are those
    of `tracking_error`. The noise and bias of the sensors do not enter this error, except through
    their effect on the flight. Returns None if `truth` lacks the state x.CHANNEL of one of the
    channels.
    """
    if "truth" not in tape:
        return None
    truth = tape["truth"]
    names = _controlled(tape)
    states = [f"x.{name}" for name in names]
    if not set(states) <= set(truth.names):
        return None
    return _minus_reference(Signal(truth.stamp_ns, names, _columns(truth, states)), tape["y_m"])


def best_error(tape: Tape) -> tuple[str, Signal]:
    """Return the name and the signal of the most accurate error e = y - y_m on a tape.

    This is the true error if the tape has it, else the measured one. The name is "true error" or
    "measured error". The signal has the shape (N, m) and is in SI. Raises ParameterError if the
    tape has no y and y_m.
    """
    error = true_error(as_tape(tape))
    return (MEASURED_ERROR, tracking_error(tape)) if error is None else (TRUE_ERROR, error)


def _minus_reference(y: Signal, y_m: Signal) -> Signal:
    if len(y.stamp_ns) == 0 or len(y_m.stamp_ns) == 0:
        return Signal(np.zeros(0, dtype=np.int64), y.names, np.zeros((0, len(y.names))))
    first = np.searchsorted(y.stamp_ns, y_m.stamp_ns[0])
    end = np.searchsorted(y.stamp_ns, y_m.stamp_ns[-1], side="right")
    stamps = y.stamp_ns[first:end]
    values = y.values[first:end]
    if np.array_equal(stamps, y_m.stamp_ns):
        return Signal(stamps, y.names, values - _columns(y_m, y.names))
    # float64 represents a stamp exactly if it is relative to the first one, but not if it counts ns
    # since the epoch.
    instants = (stamps - y_m.stamp_ns[0]).astype(float)
    knots = (y_m.stamp_ns - y_m.stamp_ns[0]).astype(float)
    reference = np.stack([np.interp(instants, knots, y_m[name]) for name in y.names]).T
    return Signal(stamps, y.names, values - reference)


def _columns(signal: Signal, names: Sequence[str]) -> FloatArray:
    return np.stack([signal[name] for name in names]).T


def noise_floor(tape: Tape) -> dict[str, float]:
    """Return the noise floor of y by channel, SI: the error below which the sensors tell nothing.

    A true error can be smaller than the floor. The floor is the rms of "noise.CHANNEL" of the topic
    `truth` if the tape has it. Otherwise it is estimated for white noise from the second
    differences d_k = y_(k+1) - 2 y_k + y_(k-1), as rms = median(abs(d)) / (0.6745 sqrt(6)). d has 6
    times the variance of the noise, and half of a normal distribution lies within 0.6745 rms. The
    floor is at least the rounding of the largest y.
    """
    noise = tape["truth"].group("noise") if "truth" in tape else None
    floor = {}
    for name in tape["y"].names:
        y = tape["y"][name]
        if noise is not None and name in noise.names:
            rms = float(np.sqrt(np.mean(noise[name] ** 2)))
        elif len(y) > 2:
            rms = float(np.median(np.abs(np.diff(y, 2)))) / (0.6745 * 6.0**0.5)
        else:
            rms = math.nan
        largest = np.max(np.abs(y), initial=0.0)
        floor[name] = max(rms, float(np.spacing(largest)) if largest > 0.0 else 0.0)
    return floor


def engagements(tape: Tape) -> list[Transient]:
    """Return the instants of engagement as transients, from the modes in `internals`."""
    if "internals" not in tape:
        return []
    is_engaged = tape["internals"]["mode"] == Mode.ENGAGED
    begins = is_engaged & ~np.concatenate([[False], is_engaged[:-1]])
    return [
        Transient(kind=TransientKind.ENGAGEMENT, name="", start=float(t), stop=float(t))
        for t in tape.time("internals")[begins]
    ]


def live_commands(tape: Tape) -> list[Transient]:
    """Return the changes of the commands in the topic `u_m`, as transients.

    If two changes of a channel are at most SETTLING_DWELL apart, they belong to one transient.
    """
    if "u_m" not in tape:
        return []
    t = tape.time("u_m")
    u_m = tape["u_m"]
    commands: list[Transient] = []
    # Leave out the attitude, which never rests.
    attitude = () if "y_m" not in tape else set(u_m.names) - set(tape["y_m"].names)
    for name in [name for name in u_m.names if name not in attitude]:
        is_change = np.concatenate([u_m[name][:1] != 0.0, np.diff(u_m[name]) != 0.0])
        instants = t[is_change]
        groups = np.split(instants, np.flatnonzero(np.diff(instants) > SETTLING_DWELL) + 1)
        commands += [
            Transient(
                kind=TransientKind.COMMAND,
                name=name,
                start=float(group[0]),
                stop=float(group[-1]),
            )
            for group in groups
            if len(group)
        ]
    return sorted(commands, key=lambda command: command.start)


def guided_transients(tape: Tape) -> list[Transient]:
    """Return the turns and captures of a guided flight, from the commands in the topic `guidance`.

    In a turn, guidance commands more bank than TURN_BANK. In a capture, it climbs, descends,
    returns to its path or changes speed. `u_m` changes all the time in a guided flight, so it shows
    no transients. Transients of the same kind that are less than SETTLING_DWELL apart count as one.
    """
    if "guidance" not in tape:
        return []
    t = tape.time("guidance")
    commands = tape["guidance"]
    speed = commands["V_c"]
    turns = np.abs(commands["phi_c"]) > TURN_BANK
    captures = np.abs(commands["climb_c"]) > speed * math.sin(CAPTURE_ANGLE)
    captures |= np.abs(commands["xtrack"]) > CAPTURE_TIME * speed
    captures |= np.diff(speed, prepend=speed[:1]) != 0.0
    spans = {
        TransientKind.TURN: mask_spans(t, turns, SETTLING_DWELL),
        TransientKind.CAPTURE: mask_spans(t, captures & ~turns, SETTLING_DWELL),
    }
    transients = [
        Transient(kind=kind, name="", start=start, stop=stop)
        for kind, of_kind in spans.items()
        for start, stop in of_kind
    ]
    return sorted(transients, key=lambda transient: transient.start)


def mask_spans(
    t: FloatArray, mask: NDArray[np.bool_], min_length: float = 0.0
) -> list[tuple[float, float]]:
    """Return the start and the stop, s, of each run of True in a mask of shape (N,).

    A run stops at the next False sample. If two spans are less than `min_length` apart, they are
    merged. If a span is shorter than `min_length`, it is lengthened to this length.
    """
    edges = np.flatnonzero(np.diff(np.concatenate([[False], mask, [False]])))
    spans: list[tuple[float, float]] = []
    for first, after in zip(edges[::2], edges[1::2], strict=True):
        start = float(t[first])
        stop = max(float(t[min(after, len(t) - 1)]), start + min_length)
        if spans and start - spans[-1][1] < min_length:
            start, _ = spans.pop()
        spans.append((start, stop))
    return spans


def in_spans(
    t: FloatArray, spans: Iterable[tuple[float, float]], settle: float = 0.0
) -> NDArray[np.bool_]:
    """Return a mask, (N,), of the instants that are in a span or up to `settle` s after it.

    The instants t, (N,), must ascend.
    """
    inside = np.zeros(len(t), dtype=bool)
    for start, stop in spans:
        inside[np.searchsorted(t, start) : np.searchsorted(t, stop + settle, side="right")] = True
    return inside


def part_masks(
    t: FloatArray,
    transients: Sequence[Transient],
    settle: float = SETTLING_DWELL,
    air: str = CALM,
) -> dict[str, NDArray[np.bool_]]:
    """Return a mask of the instants t, (N,), for each part of the flight.

    The parts are "whole", `air`, "command" and "gust". In a guided flight, "capture" and "turn"
    replace "command". Every instant is in "whole", and in at most one more part. During a transient
    this is the part of the transient, or the last one in the order above if transients overlap. An
    instant with only an engagement is in no other part, and one without any transient is in `air`.
    """
    kinds = {transient.kind for transient in transients}
    commands = (TransientKind.COMMAND,) if kinds.isdisjoint(GUIDED) else GUIDED
    parts = {}
    free = np.ones(len(t), dtype=bool)
    for kind in (TransientKind.GUST, *reversed(commands), TransientKind.ENGAGEMENT):
        spans = [
            (transient.start, transient.stop) for transient in transients if transient.kind is kind
        ]
        parts[kind] = in_spans(t, spans, settle) & free
        free &= ~parts[kind]
    return {
        "whole": np.ones(len(t), dtype=bool),
        air: free,
        **{kind: parts[kind] for kind in (*commands, TransientKind.GUST)},
    }


def sample_times(stamp_ns: NDArray[np.int64]) -> FloatArray:
    """Return the length of time that each sample represents, (N,), s.

    It is half the sum of the intervals to both neighbours, where an interval counts as at most
    LONGEST_INTERVAL. The first and the last sample represent a whole interval, so that equal
    intervals give equal times.
    """
    if len(stamp_ns) < 2:
        return np.ones(len(stamp_ns))
    intervals = np.minimum(np.diff(stamp_ns) / 1e9, LONGEST_INTERVAL)
    times: FloatArray = (
        np.concatenate([intervals[:1], intervals]) + np.concatenate([intervals, intervals[-1:]])
    ) / 2.0
    return times


def error_metrics(errors: ArrayLike, times: FloatArray | None = None) -> ErrorMetrics:
    """Compute the root mean square and the largest abs(e) of N samples.

    rms = sqrt(sum t e^2 / sum t) with the `times` t of the samples. If all times are equal, it is
    sqrt(mean e^2).

    Args:
        errors: Samples e of a channel, shape (N,), in any unit.
        times: Time that each sample stands for, shape (N,), s. If None, all times are equal.

    Returns:
        `rms` and `max`, in the unit of the errors. Both are NaN if N = 0.

    Raises:
        ParameterError: `errors` are no numbers of shape (N,).

    Examples:
        >>> rise_di.error_metrics([3.0, -4.0]).max
        4.0
    """
    e = as_array(errors, "errors", expected := "samples of one channel, (N,)")
    require(e.ndim == 1, "errors", f"an array of shape {e.shape}", expected)
    if len(e) == 0:
        return ErrorMetrics(rms=math.nan, max=math.nan)
    weighted = times is not None and np.ptp(times) > 0.0
    square = np.average(e**2, weights=times) if weighted else np.mean(e**2)
    return ErrorMetrics(rms=float(np.sqrt(square)), max=float(np.max(np.abs(e))))


def known_entries(learned: Signal) -> list[str]:
    """Return the names of the entries of A and B that the flight has identified.

    `learned` has the samples of the topic `learned`. An entry counts as identified if, in a sample,
    its standard deviation is below MAX_DEVIATION times its value.
    """
    values = learned.group("value")
    deviations = learned.group("deviation")
    return [
        name
        for name in values.names
        if np.any(deviations[name] < MAX_DEVIATION * np.abs(values[name]))
    ]


def errors_by_part(
    tape: Tape,
    transients: Sequence[Transient],
    settle: float = SETTLING_DWELL,
    air: str = CALM,
) -> dict[str, dict[str, ErrorMetrics]]:
    """Return rms and maximum of `best_error` by channel and part of the flight.

    The maximum of the part "calm" is the ultimate bound. This is the largest abs(e) in calm air,
    later than `settle` s after the end of every transient.
    """
    _, error = best_error(tape)
    masks = part_masks((error.stamp_ns - tape.start_ns) / 1e9, transients, settle, air)
    times = sample_times(error.stamp_ns)
    by_channel = {}
    for name in error.names:
        by_channel[name] = {
            part: error_metrics(error[name][mask], times[mask]) for part, mask in masks.items()
        }
    return by_channel


def settling_bands(tape: Tape) -> dict[str, float]:
    """Return the half-width of the settling band by channel, SI: SETTLING_BAND max abs(y_m).

    If y_m is zero, max abs(e) replaces max abs(y_m). The half-width for a measured error is at
    least MIN_BAND_NOISE_FLOORS noise floors, because noise alone would leave a narrower band.
    """
    kind, error = best_error(tape)
    floors = noise_floor(tape) if kind == MEASURED_ERROR else {}

    def largest(values: FloatArray) -> float:
        return float(np.max(np.abs(values), initial=0.0))

    return {
        name: max(
            SETTLING_BAND * (largest(tape["y_m"][name]) or largest(error[name])),
            MIN_BAND_NOISE_FLOORS * floors.get(name, 0.0),
        )
        for name in error.names
    }


def settling_time(
    t: FloatArray, e: FloatArray, band: float, leaves: float, dwell: float = SETTLING_DWELL
) -> float | None:
    """Return the time, s, after which abs(e) stays in the band for `dwell` s or until the end.

    The time counts from t[0], and t and e have the shape (N,). `leaves` is the time, s, within
    which a transient moves e out of the band. If abs(e) stays in the band for this time, the result
    is 0, even if it leaves the band later. The result is None if abs(e) does not return to the
    band, or if there is no sample.
    """
    if len(t) == 0:
        return None
    above = np.flatnonzero(np.abs(e) > band)
    if len(above) == 0 or t[above[0]] - t[0] > leaves:
        return 0.0
    next_above = np.append(t[above[1:]], np.inf)
    back = above + 1 < len(t)
    begin = t[above[back] + 1]
    stays = begin[next_above[back] - begin >= dwell]
    return float(stays[0] - t[0]) if len(stays) else None


class Settling(NamedTuple):
    """How long each channel that a transient excites takes to settle."""

    transient: Transient
    until: dict[str, float]  # start of the next transient of the channel, or end of the flight, s
    time: dict[str, float | None]  # settling time, s, or None if not settled before `until`


def settling_times(tape: Tape, transients: Sequence[Transient]) -> list[Settling]:
    """Return, for each transient, how long `best_error` takes to settle in the `settling_bands`.

    The time counts from the start of the transient. Only samples before the next transient that
    excites the channel count. Transients after the end of the flight are left out. Turns and
    captures are also left out, because their commands change until they end.
    """
    _, error = best_error(tape)
    t = (error.stamp_ns - tape.start_ns) / 1e9
    bands = settling_bands(tape)
    end = float(t[-1]) if len(t) else 0.0
    results = []
    events = [
        transient
        for transient in transients
        if transient.start <= end and transient.kind not in GUIDED
    ]
    for transient in sorted(events, key=attrgetter("start")):
        start = transient.start
        leaves = transient.stop + SETTLING_DWELL - transient.start
        until = {}
        times = {}
        for name in filter(transient.excites, error.names):
            until[name] = min(
                [later.start for later in transients if later.excites(name) and later.start > start]
                + [end]
            )
            inside = (t >= start) & ((t < until[name]) | (until[name] == end))
            times[name] = settling_time(t[inside], error[name][inside], bands[name], leaves)
        results.append(Settling(transient, until, times))
    return results


def inputs_by_part(
    tape: Tape,
    transients: Sequence[Transient],
    settle: float = SETTLING_DWELL,
    topic: str = "u",
    air: str = CALM,
) -> dict[str, dict[str, InputMetrics]]:
    """Return the control effort by input and part of the flight.

    The metrics are rms and max abs(u) about trim, and mean abs(u_dot), which is sum abs(u_k -
    u_(k-1)) / sum (t_k - t_(k-1)) over the steps that end in the part. This mean is NaN if there is
    no such step. If `topic` is "y", the metrics are those of y.
    """
    if topic not in tape:
        return {}
    u = tape[topic]
    t = tape.time(topic)
    masks = part_masks(t, transients, settle, air)
    times = sample_times(u.stamp_ns)

    def metrics(values: FloatArray, mask: NDArray[np.bool_]) -> InputMetrics:
        steps = mask[1:]
        time = float(np.diff(t)[steps].sum())
        rate = float(np.abs(np.diff(values))[steps].sum()) / time if time > 0 else float("nan")
        return InputMetrics(**asdict(error_metrics(values[mask], times[mask])), rate=rate)

    by_input = {}
    for name in u.names:
        by_input[name] = {part: metrics(u[name], mask) for part, mask in masks.items()}
    return by_input


def saturation_shares(tape: Tape) -> dict[str, dict[str, float]]:
    """Return the share of ticks with a saturated input, by input and kind of saturation.

    The kinds are "magnitude" and "rate".
    """
    limited = tape["internals"].group("limited") if "internals" in tape else None
    if limited is None or len(limited.stamp_ns) == 0:
        return {}
    kinds = (Saturation.MAGNITUDE, Saturation.RATE)
    shares = {}
    for name in limited.names:
        shares[name] = {kind.name.lower(): float(np.mean(limited[name] == kind)) for kind in kinds}
    return shares


def sign_switches(tape: Tape) -> dict[str, float]:
    """Return how often the sign term beta Sgn(e) switches, by output, 1/s.

    This is the number of changes of sign between successive nonzero increments of Pi, divided by
    the time of the ticks. If the tape has no topic `internals`, the changes of sign of the measured
    error are counted in their place.
    """
    if "internals" in tape:
        signal = tape["internals"].group("Pi")
        moves = np.diff(signal.values, axis=0)
    else:
        signal = tracking_error(tape)
        moves = signal.values
    time = seconds(int(np.ptp(signal.stamp_ns))) if len(signal.stamp_ns) else 0.0
    if time == 0.0:
        return {}
    signs = {
        name: np.sign(column[column != 0.0])
        for name, column in zip(signal.names, moves.T, strict=True)
    }
    return {name: float(np.count_nonzero(np.diff(sign))) / time for name, sign in signs.items()}
