# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Figures of a flight: pure functions of a tape."""

from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from flight_core.rates import seconds
from flight_core.tape import Signal, Tape
from flight_core.vectors import FloatArray
from rise_di_controller.guard import Mode
from rise_di_controller.internals import Saturation

Windows = Mapping[str, tuple[float, float]]

SETTLE = 1.0
"""s. What a gust, the edge of a command or an engagement leaves behind is counted to it for as long after its end."""

BAND = 0.01
"""Half-width of the band to settle into, as a share of the largest abs(y_m)."""

NOISE_BAND = 4.0
"""Noise floors within which measured errors stay for SETTLE: of 500 samples of normal noise 97 % of the time."""

TRUE, MEASURED = "true error", "measured error"
"""What `known_error` may know."""

PARTS = (
    f"command: from an edge of a command to {SETTLE:g} s after its end; gust: from the entry of a gust to {SETTLE:g} s after"
    f" its end; calm: the rest, but for {SETTLE:g} s after engagement"
)
"""What the parts of the tables mean, for people."""

PART_NAMES = ("whole", "calm", "command", "gust")


class Transient(NamedTuple):
    """Something that throws the error off, from its first to its last instant in s of flight time."""

    kind: str  # "engagement", "command" or "gust"
    name: str  # of the commanded channel, or of the gust
    start: float
    stop: float

    def concerns(self, channel: str) -> bool:
        """Whether it is meant for a channel: a command for its own, all else for every one."""
        return self.kind != "command" or self.name == channel


class ErrorFigures(NamedTuple):
    """Tracking error of one channel over some samples, in its unit."""

    rms: float
    max: float


class InputFigures(NamedTuple):
    """What one input did over some samples: in its unit about trim, and in its unit / s."""

    rms: float
    max: float
    rate: float


class TickFigures(NamedTuple):
    """How regularly the controller ticked; times in s."""

    ticks: int
    without_new_y: int  # periods of the controller in which it took no step: no new y had come, or the tick was missed
    period_mean: float
    period_p99: float
    period_max: float
    jitter: float  # rms of how far the time between two ticks is from a whole number of periods
    late_p99: float
    late_max: float
    age_p99: float


class LatencyFigures(NamedTuple):
    """How long after a y was sent the u that answers it was, in s."""

    median: float
    p99: float
    max: float


def tracking_error(tape: Tape) -> Signal:
    """Error e = y - y_m at every y whose stamp y_m has too or spans (linear between samples), shape (N, m), channels of y.

    It is the error that the law sees: the sensors' noise is part of it.
    """
    return _minus_reference(tape["y"], tape["y_m"])


def true_error(tape: Tape) -> Signal | None:
    """True error C x - y_m at every sample of `truth` that y_m has too or spans, shape (N, m), channels of y.

    It is the error that the aircraft makes, without the sensors' own, and also at samples that were lost. None where the tape
    has no "x.output" in `truth` for each channel of y; only a simulation knows it.
    """
    if "truth" not in tape:
        return None
    x, names = tape["truth"].group("x"), tape["y"].names
    if not set(names) <= set(x.names):
        return None
    return _minus_reference(Signal(x.stamp_ns, names, np.column_stack([x[name] for name in names])), tape["y_m"])


def known_error(tape: Tape) -> tuple[str, Signal]:
    """The best error that a tape knows, after what it is called: TRUE, else MEASURED."""
    error = true_error(tape)
    return (MEASURED, tracking_error(tape)) if error is None else (TRUE, error)


def _minus_reference(y: Signal, y_m: Signal) -> Signal:
    if len(y.stamp_ns) == 0 or len(y_m.stamp_ns) == 0:
        return Signal(np.zeros(0, dtype=np.int64), y.names, np.zeros((0, len(y.names))))
    inside = (y.stamp_ns >= y_m.stamp_ns[0]) & (y.stamp_ns <= y_m.stamp_ns[-1])
    stamps = y.stamp_ns[inside]
    # Relative to the first stamp float64 is exact; the epoch in ns is not.
    at, knots = (stamps - y_m.stamp_ns[0]).astype(float), (y_m.stamp_ns - y_m.stamp_ns[0]).astype(float)
    reference = np.column_stack([np.interp(at, knots, y_m[name]) for name in y.names])
    return Signal(stamps, y.names, y.values[inside] - reference)


def noise_floor(tape: Tape) -> dict[str, float]:
    """What no error of y can be told from, by channel, in its unit.

    The rms of "noise.channel" of `truth` where the tape knows it. Else of a white noise that moves y as it moves: with the
    second differences d_k = y_(k+1) - 2 y_k + y_(k-1) its rms is median(abs(d)) / (0.6745 sqrt(6)), for d has 6 times its
    variance and half of a normal distribution lies within 0.6745 of its own rms. At least one rounding of the largest y.
    """
    noise = tape["truth"].group("noise") if "truth" in tape else None
    floor = {}
    for name in tape["y"].names:
        y = tape["y"][name]
        if noise is not None and name in noise.names:
            rms = float(np.sqrt(np.mean(noise[name] ** 2)))
        else:
            rms = float(np.median(np.abs(np.diff(y, 2)))) / (0.6745 * 6.0**0.5) if len(y) > 2 else 0.0
        largest = np.max(np.abs(y), initial=0.0)
        floor[name] = max(rms, float(np.spacing(largest)) if largest > 0.0 else 0.0)
    return floor


def engagements(tape: Tape) -> list[Transient]:
    """When the controller engaged, by the modes of `internals`."""
    if "internals" not in tape:
        return []
    engaged = tape["internals"]["mode"] == Mode.ENGAGED
    begins = engaged & ~np.concatenate([[False], engaged[:-1]])
    return [Transient("engagement", "", float(t), float(t)) for t in tape.time("internals")[begins]]


def live_commands(tape: Tape) -> list[Transient]:
    """Where a live command moved, by the samples of `u_m`: changes of a channel closer than SETTLE are one."""
    if "u_m" not in tape:
        return []
    t, u_m = tape.time("u_m"), tape["u_m"]
    found: list[Transient] = []
    for name in u_m.names:
        moved = np.concatenate([u_m[name][:1] != 0.0, np.diff(u_m[name]) != 0.0])
        instants = t[moved]
        stretches = np.split(instants, np.flatnonzero(np.diff(instants) > SETTLE) + 1)
        found += [Transient("command", name, float(one[0]), float(one[-1])) for one in stretches if len(one)]
    return sorted(found, key=lambda one: one.start)


def in_spans(t: FloatArray, spans: Iterable[tuple[float, float]], settle: float = 0.0) -> NDArray[np.bool_]:
    """Which instants lie in a span or up to `settle` seconds after it, shape (N,)."""
    inside = np.zeros(len(t), dtype=bool)
    for start, stop in spans:
        inside |= (t >= start) & (t <= stop + settle)
    return inside


def part_masks(t: FloatArray, transients: Sequence[Transient], settle: float = SETTLE) -> dict[str, NDArray[np.bool_]]:
    """Which instants of shape (N,) belong to which of PART_NAMES.

    Those of a gust are no more those of a command, and those of an engagement, a command or a gust none of "calm".
    """
    inside = {
        kind: in_spans(t, [(one.start, one.stop) for one in transients if one.kind == kind], settle)
        for kind in ("engagement", "command", "gust")
    }
    return {
        "whole": np.ones(len(t), dtype=bool),
        "calm": ~(inside["engagement"] | inside["command"] | inside["gust"]),
        "command": inside["command"] & ~inside["gust"],
        "gust": inside["gust"],
    }


def error_figures(errors: FloatArray) -> ErrorFigures:
    """Root mean square sqrt(mean e^2) and max abs(e) of samples of shape (N,); NaN where N = 0."""
    if len(errors) == 0:
        return ErrorFigures(float("nan"), float("nan"))
    return ErrorFigures(float(np.sqrt(np.mean(errors**2))), float(np.max(np.abs(errors))))


def error_table(tape: Tape, transients: Sequence[Transient], settle: float = SETTLE) -> dict[str, dict[str, ErrorFigures]]:
    """Figures of `known_error` by channel and part of the flight.

    The max of "calm" is the ultimate bound: the largest abs(e) once what each transient left has had `settle` s to fade.
    """
    _, error = known_error(tape)
    masks = part_masks((error.stamp_ns - tape.start_ns) / 1e9, transients, settle)
    return {name: {part: error_figures(error[name][mask]) for part, mask in masks.items()} for name in error.names}


def settling_bands(tape: Tape) -> dict[str, float]:
    """Half-width of the band to settle into by channel, in its unit: BAND max abs(y_m), or of the error where y_m rests.

    Where only the measured error is known, at least NOISE_BAND noise floors: in a narrower one no measured error stays.
    """
    kind, error = known_error(tape)
    floors = noise_floor(tape) if kind == MEASURED else {}

    def largest(values: FloatArray) -> float:
        return float(np.max(np.abs(values), initial=0.0))

    return {
        name: max(BAND * (largest(tape["y_m"][name]) or largest(error[name])), NOISE_BAND * floors.get(name, 0.0))
        for name in error.names
    }


def settling_time(t: FloatArray, e: FloatArray, band: float, leaves: float, dwell: float = SETTLE) -> float | None:
    """How long after t[0] abs(e) <= band began to hold for `dwell` s, or to the end of the samples; s.

    0 where abs(e) does not leave the band within `leaves` s: what comes later has another cause. None where it never came
    back, or there is no sample. Shapes (N,).
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


class Settled(NamedTuple):
    """What came of a transient."""

    transient: Transient
    until: dict[str, float]  # when the next one of a channel began, or the flight ended, s; for each channel that it concerns
    time: dict[str, float | None]  # settling time, s; None: not before that


def settled(tape: Tape, transients: Sequence[Transient]) -> list[Settled]:
    """Settling time of `known_error` into `settling_bands` from the start of each transient on, for each channel it concerns.

    It is judged up to the next transient that concerns the channel. Those that the flight did not come to are left out.
    """
    _, error = known_error(tape)
    t, bands = (error.stamp_ns - tape.start_ns) / 1e9, settling_bands(tape)
    end = float(t[-1]) if len(t) else 0.0
    found = []
    for one in sorted((one for one in transients if one.start <= end), key=lambda one: one.start):
        until, times = {}, {}
        for name in filter(one.concerns, error.names):
            later = [other.start for other in transients if other.concerns(name) and other.start > one.start]
            until[name] = min([*later, end])
            inside = (t >= one.start) & ((t < until[name]) | (until[name] == end))
            times[name] = settling_time(t[inside], error[name][inside], bands[name], one.stop + SETTLE - one.start)
        found.append(Settled(one, until, times))
    return found


def input_table(tape: Tape, transients: Sequence[Transient], settle: float = SETTLE) -> dict[str, dict[str, InputFigures]]:
    """Control effort by input and part: rms and max abs(u) about trim, and mean abs(u_dot).

    mean abs(u_dot) = sum abs(u_k - u_(k-1)) / sum (t_k - t_(k-1)) over the steps that end in the part. NaN without one.
    """
    if "u" not in tape:
        return {}
    u, t = tape["u"], tape.time("u")
    masks = part_masks(t, transients, settle)

    def figures(values: FloatArray, mask: NDArray[np.bool_]) -> InputFigures:
        steps = mask[1:]
        time = float(np.diff(t)[steps].sum())
        rate = float(np.abs(np.diff(values))[steps].sum()) / time if time > 0 else float("nan")
        return InputFigures(*error_figures(values[mask]), rate)

    return {name: {part: figures(u[name], mask) for part, mask in masks.items()} for name in u.names}


def limited_shares(tape: Tape) -> dict[str, dict[str, float]]:
    """Share of the ticks in which an input was held back, by input and by what held it: "magnitude", "rate"."""
    limited = tape["internals"].group("limited") if "internals" in tape else None
    if limited is None or len(limited.stamp_ns) == 0:
        return {}
    kinds = (Saturation.MAGNITUDE, Saturation.RATE)
    return {name: {kind.name.lower(): float(np.mean(limited[name] == kind)) for kind in kinds} for name in limited.names}


def sign_switches(tape: Tape) -> dict[str, float]:
    """How often the sign term changed its direction, by output, 1/s.

    Changes of sign from one increment of Pi to the next that is not 0, over the time of the ticks. Where the controller's
    `internals` are not known: changes of the sign of the measured error.
    """
    if "internals" in tape:
        signal = tape["internals"].group("Pi")
        moves = np.diff(signal.values, axis=0)
    else:
        signal = tracking_error(tape)
        moves = signal.values
    if len(signal.stamp_ns) < 2:
        return {}
    time = seconds(int(signal.stamp_ns[-1] - signal.stamp_ns[0]))
    signs = {name: np.sign(column[column != 0.0]) for name, column in zip(signal.names, moves.T, strict=True)}
    return {name: float(np.count_nonzero(np.diff(of))) / time for name, of in signs.items()}


def spectra(signal: Signal, period_ns: int) -> tuple[FloatArray, dict[str, FloatArray]]:
    """Amplitude spectral density of each channel by Welch's method: frequencies in Hz, and values in unit / sqrt(Hz).

    Over Hann windows of a tenth of the flight, half overlapping, each without its mean; a signal that misses a sample is held
    over the gap. The square of the density, integrated over all frequencies, is the variance. Source: Welch 1967.
    """
    from scipy.signal import welch  # noqa: PLC0415 - half a second, which commands that draw nothing need not wait for

    places = np.round((signal.stamp_ns - signal.stamp_ns[0]) / period_ns).astype(np.int64)
    grid = np.arange(places[-1] + 1)
    held = signal.values[np.searchsorted(places, grid, side="right") - 1]
    window = max(len(grid) // 10, min(len(grid), 256))
    frequency, power = welch(held, fs=1e9 / period_ns, nperseg=window, axis=0)
    return frequency[1:], dict(zip(signal.names, np.sqrt(power[1:]).T, strict=True))


def tick_periods(tape: Tape) -> NDArray[np.int64]:
    """Time between successive ticks of the controller, ns, shape (N - 1,).

    The instant of a tick is stamp + "age", which is its deadline plus "late".
    """
    internals = tape["internals"]
    return np.diff(internals.stamp_ns + np.round(internals["age"] * 1e9).astype(np.int64))


def tick_figures(tape: Tape, period_ns: int) -> TickFigures | None:
    """Figures of the controller's ticks from `internals`, None where there are fewer than two.

    Only a tick with a new y is in `internals`, so a period without one is counted alike whether y did not come or the tick was
    missed.
    """
    internals = tape["internals"]
    if len(internals.stamp_ns) < 2:
        return None
    periods = tick_periods(tape)
    elapsed = round(float(periods.sum()) / period_ns)
    off = periods - period_ns * np.round(periods / period_ns)
    return TickFigures(
        ticks=len(internals.stamp_ns),
        without_new_y=max(elapsed - len(periods), 0),
        period_mean=seconds(int(periods.mean())),
        period_p99=seconds(int(np.percentile(periods, 99))),
        period_max=seconds(int(periods.max())),
        jitter=float(np.sqrt(np.mean(off**2))) / 1e9,
        late_p99=float(np.percentile(internals["late"], 99)),
        late_max=float(internals["late"].max()),
        age_p99=float(np.percentile(internals["age"], 99)),
    )


def latency_figures(tape: Tape) -> LatencyFigures | None:
    """Figures of the signal `latency`, None where the tape has none."""
    if "latency" not in tape or len(tape["latency"].stamp_ns) == 0:
        return None
    latency = tape["latency"].values[:, 0]
    return LatencyFigures(float(np.median(latency)), float(np.percentile(latency, 99)), float(latency.max()))
