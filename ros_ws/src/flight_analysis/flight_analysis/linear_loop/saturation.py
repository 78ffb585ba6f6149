# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Prove that every aircraft of a box settles, whatever the limits of one input.

A box has an interval for each uncertain entry of A and B. The aircraft gets a = phi(u) instead of
u, so that w = u - a is cut off. phi can be any curve whose slope lies between 0 and 1. Take any
taps h_j >= 0 at earlier and later ticks j, whose sum is at most 1. Then

    sum over ticks k of w_k (a_k - sum_j h_j a_(k-j)) >= 0

(Zames-Falb). The loop has the sensitivity S at this input. Let m = 1 - sum_j h_j z^-j. If Re(m S) >
0 at each frequency, every aircraft settles. If this holds only above a lowest frequency, no
aircraft oscillates faster than this frequency. docs/theory.md has both theorems.

A linear program finds the taps for some aircraft. The box is then covered by regions with scalings
D and G of the entries, as in a proof without a limit. Within the frequencies of a step, the
inequality is only tried at samples. The check of the certificate proves it for all frequencies.
"""

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np

from flight_analysis.linear_loop.branch_and_bound import (
    DIGITS,
    Region,
    effects_of,
    frequency_in,
)
from flight_analysis.linear_loop.guarantee import SLACK
from flight_analysis.linear_loop.loop_margins import LinearLoop
from flight_analysis.linear_loop.structured_value import Scaling, least_bound_at
from flight_analysis.linear_loop.uncertain_loop import (
    Channels,
    ComplexArray,
    IntArray,
    parts_of,
    uncertain_loop,
)
from flight_core.parameters import require
from flight_core.vectors import FloatArray

# abs(z) of the circle on which a proof shows that every motion settles. Integrators have a mode at
# z = 1, which lies outside of this circle.
SETTLING = 1.0 - 1e-5
# Lowest frequency of a proof that nothing oscillates, rad/s
SLOWEST = 0.05
TRIED = (1.0, 0.8, 0.65, 0.5, 0.4, 0.3, 0.2)  # parts of the box that are tried, the whole box first

LAGS = np.unique(np.geomspace(1.0, 100.0, 30).round().astype(int))  # ticks
AIRCRAFT = 12  # random corners of the box in the linear program, and at which climbs start
SEED = 2
ROUNDS = 8  # largest number of linear programs
CLIMBERS = 3  # corners at which climbs start in each round
LONGEST_CLIMB = 12  # largest number of entries that a climb flips
# the search for taps ends if the worst corner has this fraction of the room in the program
ENOUGH = 0.5
LOWEST = 1e-6  # lowest frequency of the program, as a fraction of pi / T
# least room, Re(m S) / abs(S) as a fraction of `_expected`, that is worth a proof
LEAST_ROOM = 1e-3
KNEE = 3.0  # frequency below which less room is expected, rad/s
LEAST_TAP = 1e-9
WHOLE = 1.0 - 1e-8  # sum of the taps, so that rounding does not bring it above 1

# fraction of the bound 1 that a step leaves free, because a check between frequencies loses some
MARGIN = 0.02
MOST = 2000  # steps of a proof
# a region with less than this fraction of the half widths of the box is not halved again
NARROWEST = 1e-3
# largest distance from a sample of an interval to the next, as a fraction of its frequency
STRIDE = 0.1
TURN = 0.2  # largest angle by which z^-j of the farthest tap turns from a sample to the next, rad
BATCH = 200  # samples on each side of a frequency, at most


class LimitGuarantee(NamedTuple):
    """A guarantee for every aircraft of a box that holds whatever the limits of one input are."""

    input: str
    uncertainty: float  # largest relative deviation in the box
    size: float  # largest relative deviation for which the guarantee was found
    multiplier: "Multiplier"
    # "entries" and "steps" of each strongly connected part, as in `limit_proof`
    proof: list[dict[str, Any]]
    zeros: float = 0.0  # part of its row up to which an entry that is 0 in the file deviates

    @property
    def is_settling(self) -> bool:
        """Whether every motion settles. If not, the guarantee only excludes fast oscillations."""
        return not self.multiplier.slowest

    @property
    def is_proved(self) -> bool:
        """Whether the guarantee was found for the whole box."""
        return self.size >= self.uncertainty

    def as_json(self) -> dict[str, Any]:
        """Return the guarantee as a dict that JSON can hold, without the proof and the taps."""
        return {
            "input": self.input,
            "uncertainty": self.uncertainty,
            "within": self.size,
            "zeros": self.zeros,
            "settles": self.is_settling,
            "slowest": self.multiplier.slowest,
            "holds": self.is_proved,
        }


class Multiplier(NamedTuple):
    """The multiplier m = 1 - sum_j h_j z^-j of a proof, with taps h_j >= 0 at nonzero lags j."""

    slowest: float  # lowest frequency of the proof, rad/s
    lags: IntArray
    taps: FloatArray

    @property
    def radius(self) -> float:
        """Radius abs(z) at which the inequality of the proof is checked."""
        return 1.0 if self.slowest else SETTLING

    def at(self, turn: FloatArray) -> ComplexArray:
        """Compute m at the angles `turn` = w T of z, rad."""
        turned = np.exp(-1j * np.multiply.outer(turn, self.lags))
        return np.asarray(1.0 - turned @ self.taps.astype(complex))


def guarantee_with_limit(linear: LinearLoop, name: str) -> LimitGuarantee | None:
    """Find the largest scaled box in which every aircraft settles, or none oscillates.

    The box is scaled down until a guarantee is found. `name` is the input with the limits. Returns
    None if no guarantee is found. Raises ParameterError if the loop has no such input, or no box.
    """
    for part in TRIED:
        for slowest in (0.0, SLOWEST):
            guarantee = limit_guarantee(linear, name, part, slowest)
            if guarantee is not None:
                return guarantee
    return None


def limit_guarantee(
    linear: LinearLoop, name: str, part: float, slowest: float
) -> LimitGuarantee | None:
    """Prove the guarantee for the box scaled by the factor `part`, or return None without a proof.

    The proof covers the frequencies from `slowest`, rad/s, upwards. If `slowest` is 0, the proof
    shows that every aircraft settles. `name` is the input with the limits. Raises ParameterError as
    `guarantee_with_limit` does.
    """
    require(name in linear.inputs, "limit", name, f"an input: {', '.join(linear.inputs)}")
    box = linear.box
    require(box is not None, "uncertainty", "0", "an uncertainty above 0 for a guarantee")
    assert box is not None  # noqa: S101 - for mypy
    loop = uncertain_loop(linear.nominal, linear.law, linear.loop, box)
    limited = [_with_limit(each) for each in parts_of(loop, (linear.inputs.index(name),))]
    has_entries = len(limited) == 1 and bool(limited[0].entries)
    require(has_entries, "limit", name, "an input of a loop with entries that may deviate")
    others = [each for each in parts_of(loop) if each.entries != limited[0].entries]
    multiplier = multiplier_for(limited[0], part, slowest)
    if multiplier is None:
        return None
    proof = _proof(limited + others, multiplier, (1.0 + SLACK) * part)
    if proof is None:
        return None
    whole = box.largest
    zeros = part * box.largest_zero
    return LimitGuarantee(name, whole, part * whole, multiplier, proof, zeros)


def _proof(
    parts: list[Channels], multiplier: Multiplier, size: float
) -> list[dict[str, Any]] | None:
    """Prove each part of the loop for a size of the box, or return None if one proof fails.

    Only the first part contains the limited input.
    """
    proof = []
    for number, part in enumerate(parts):
        steps = limit_proof(part, multiplier, size, has_limit=number == 0)
        if steps is None:
            return None
        proof.append({"entries": list(part.entries), "steps": steps})
    return proof


def _with_limit(part: Channels) -> Channels:
    """Turn a part of the loop with a disk in one input into a part with a limit of that input.

    The inputs of the result are the inputs of the entries and, last, w: what the limit cuts off
    from u. The outputs are the outputs of the entries and, last, a = u - w: what is left of u.
    """
    W, D = part.W.copy(), part.D.copy()
    D[-1, -1] += 0.5
    W[:, -1] *= -1.0
    D[:, -1] *= -1.0
    return part._replace(W=W, D=D)


def sensitivity(part: Channels, w: FloatArray, radius: float) -> ComplexArray:
    """Compute S at the input with the limit, for the aircraft in the middle of the box.

    w has the frequencies, rad/s. S is computed on the circle abs(z) = radius.
    """
    last = np.array([len(part.D) - 1])
    return np.asarray(-part.some(last).response(w, radius)[:, 0, 0])


def multiplier_for(part: Channels, size: float, slowest: float) -> Multiplier | None:
    """Find taps with which the middle of a box and its worst corners meet the inequality.

    The room of an aircraft is the least Re(m S) / abs(S) over the frequencies, divided by
    `_expected`. If the room is positive, the aircraft meets the inequality. A corner is an aircraft
    with each entry at an end of its range. A linear program finds the taps for which the least room
    of some aircraft is largest. A search then adds the corners with the least room, until all of
    them have at least ENOUGH of the room in the program. Returns None if no taps leave room to all
    these aircraft.
    """
    k = len(part.entries)
    generator = np.random.default_rng(SEED)
    few = min(AIRCRAFT, 2**k)
    aircraft = np.vstack([np.zeros(k), generator.choice([-size, size], (few, k))])
    parts = np.r_[np.geomspace(1e-4, 1.0, 100), np.linspace(0.0, 0.3, 200)]
    w = np.unique(np.maximum(np.pi / part.period * parts, slowest))
    multiplier = None
    for _ in range(ROUNDS):
        multiplier, room = _program(part, aircraft, slowest)
        if multiplier is None:
            return None
        starts = generator.choice([-size, size], (few, k))
        found = _worst_corners(part, multiplier, starts, w)
        if _rooms(part, multiplier, found, w).min() > ENOUGH * room:
            break
        aircraft = np.vstack([aircraft, found])
    return multiplier


def _expected(slowest: float, w: FloatArray) -> FloatArray:
    """Return the Re(m S) / abs(S) that is taken as a room of 1 at the frequencies w, rad/s.

    If `slowest` is 0, the result is 1 at all frequencies. If not, the result falls below the
    frequency KNEE, because an integrator in the loop turns S away from the positive real axis
    towards 0 rad/s.
    """
    return np.minimum(w / KNEE, 1.0) ** 2 if slowest else np.ones(len(w))


def _rooms(part: Channels, multiplier: Multiplier, d: FloatArray, w: FloatArray) -> FloatArray:
    """Return the room of N aircraft, (N,): the least Re(m S) / (abs(S) `_expected`) over w, rad/s.

    The room is negative if the aircraft fails the inequality. d has the k deviations of each
    aircraft, (N, k).
    """
    S = np.array([sensitivity(part.at(each), w, multiplier.radius) for each in d])
    phases = (multiplier.at(w * part.period) * S).real / np.abs(S)
    return np.asarray((phases / _expected(multiplier.slowest, w)).min(axis=1))


def _worst_corners(
    part: Channels, multiplier: Multiplier, starts: FloatArray, w: FloatArray
) -> FloatArray:
    """Search for the corners of a box with the least `_rooms`, starting from N corners, (N, k).

    The search only uses the CLIMBERS starts with the least room. Each step changes the sign of the
    one deviation whose change makes the room least. The search ends when the room no longer
    shrinks, or after LONGEST_CLIMB steps.
    """
    flips = 1.0 - 2.0 * np.eye(len(part.entries))
    found = []
    for start in starts[np.argsort(_rooms(part, multiplier, starts, w))[:CLIMBERS]]:
        d, least = start, np.inf
        for _ in range(LONGEST_CLIMB):
            rooms = _rooms(part, multiplier, d * flips, w)
            if not rooms.min() < least:
                break
            least, d = float(rooms.min()), d * flips[int(np.argmin(rooms))]
        found.append(d)
    return np.unique(found, axis=0)


def _program(
    part: Channels, aircraft: FloatArray, slowest: float
) -> tuple[Multiplier | None, float]:
    """Find the taps that leave the most room, in the sense of `_rooms`, to the worst of N aircraft.

    Returns the taps and the room of the worst aircraft, or None and 0 if this room is too small.
    `aircraft` has the deviations of each aircraft, (N, k).
    """
    from scipy.optimize import linprog  # noqa: PLC0415 - a flight starts without it

    none = Multiplier(slowest, LAGS, np.zeros(len(LAGS)))
    parts = np.r_[np.geomspace(LOWEST, 1.0, 200), np.linspace(0.0, 1.0, 800)]
    w = np.unique(np.maximum(np.pi / part.period * parts, slowest))
    lags = np.r_[-LAGS[::-1], LAGS]
    turns = np.exp(-1j * np.outer(w * part.period, lags))
    rows: list[FloatArray] = []
    limits: list[FloatArray] = []
    for d in aircraft:
        S = sensitivity(part.at(d), w, none.radius)
        turn = S / np.abs(S)
        rows.append((turn[:, None] * turns).real)
        limits.append(turn.real)
    room = np.tile(_expected(slowest, w), len(rows))
    A = np.hstack([np.vstack(rows), room[:, None]])
    whole = np.r_[none.radius ** -np.abs(lags).astype(float), 0.0]
    found = linprog(
        np.r_[np.zeros(len(lags)), -1.0],
        A_ub=np.vstack([A, whole]),
        b_ub=np.r_[np.concatenate(limits), WHOLE],
        bounds=[(0.0, None)] * len(lags) + [(None, 1.0)],
        method="highs",
    )
    best = np.zeros(len(lags) + 1) if found.x is None else np.asarray(found.x)
    if best[-1] < LEAST_ROOM:
        return None, 0.0
    taps = np.round(best[:-1], 10)
    used = taps > LEAST_TAP
    return none._replace(lags=lags[used], taps=taps[used]), float(best[-1])


def inequality(M: ComplexArray, m: ComplexArray | None, step: dict[str, Any]) -> ComplexArray:
    """Compute, at F frequencies, the matrices that are positive definite if a step is valid.

    Each matrix is diag(1, ..., 1, 0) - N_d* N_d - Y N - N* Y*, where M has the shape (F, q, q) and
    m has (F,). t, g and s are the scalings of the step, with N = diag(e^t, 1) M diag(e^-t, e^-s)
    and Y = diag(j g, e^-s m). N_d has those rows of N that belong to t. If m is None, the part of
    the loop has no limit, and the matrices lack the last row and column.
    """
    t, g = np.array(step["t"]), np.array(step["g"])
    one = M.shape[-1] - len(t)
    N = np.exp(np.r_[t, np.zeros(one)])[:, None] * M
    N = N * np.exp(-np.r_[t, np.full(one, step.get("s", 0.0))])
    N_d = N[..., : len(t), :]
    Y = np.broadcast_to(1j * g, (len(M), len(t)))
    if m is not None:
        Y = np.hstack([Y, np.exp(-step["s"]) * m[:, None]])
    skew = Y[..., None] * N
    ones = np.diag(np.r_[np.ones(len(t)), np.zeros(one)])
    gram = np.conj(np.swapaxes(N_d, -1, -2)) @ N_d
    return np.asarray(ones - gram - skew - np.conj(np.swapaxes(skew, -1, -2)))


def limit_proof(
    part: Channels, multiplier: Multiplier, size: float, *, has_limit: bool
) -> list[dict[str, Any]] | None:
    """Find the steps that prove a part of the loop for abs(d_i) <= size, or return None.

    The steps have the form that `proof_of` describes. The proof is made at the radius of the
    multiplier and from its lowest frequency on. In the part with the limit, each step has a further
    scaling "s".
    """
    k, highest = len(part.entries), np.pi / part.period
    whole = Region(np.zeros(k), np.full(k, size), multiplier.slowest, highest)
    regions = [whole]
    steps: list[dict[str, Any]] = []
    while regions and len(steps) < MOST:
        region = regions.pop()
        around = part.at(region.centre)
        w = frequency_in(region, highest)
        scale = np.r_[region.half[part.parameters], np.ones(int(has_limit))]
        M = scale[:, None] * around.response(w, multiplier.radius)
        channel, factor = M, 1.0
        if has_limit:
            m = complex(multiplier.at(np.array(w * part.period)))
            # any positive factor of m proves the same, and this one brings m S to the size 1
            factor = 1.0 / abs(m * M[-1, -1])
            channel = _as_complex_channel(M, factor * m)
        bound, scaling = least_bound_at(around, w, channel, region.scaling)
        region = region._replace(scaling=scaling)
        interval = None
        if bound < 1.0:
            step = _step(scaling, -m * M[-1, -1], factor) if has_limit else _plain_step(scaling)
            interval = _interval(around, multiplier, step, region, w)
        if interval is None:
            entry = int(np.argmax(effects_of(part, channel, scaling)))
            if region.half[entry] < NARROWEST * size:
                return None
            steps.append({"halve": entry})
            regions += region.halves(entry)
        else:
            steps.append({"low": interval[0], "high": interval[1]} | step)
            regions += region.outside(*interval)
    return None if regions else steps


def _as_complex_channel(M: ComplexArray, m: complex) -> ComplexArray:
    """Return M with m a + w in place of a, and m a - w in place of w.

    Between these two signals the limit is a complex channel of size 1, so `least_bound_at` can
    bound it.
    """
    A, B, C, s = M[:-1, :-1], M[:-1, -1:], m * M[-1:, :-1], m * M[-1, -1]
    by_z, by_w = -C / (s - 1.0), 1.0 / (s - 1.0)
    above = np.hstack([A + B @ by_z, B * by_w])
    return np.vstack([above, np.hstack([C + (s + 1.0) * by_z, [[(s + 1.0) * by_w]]])])


def _rounded(values: FloatArray) -> list[float]:
    return [float(f"{x:.{DIGITS}g}") for x in values]


def _plain_step(scaling: Scaling) -> dict[str, Any]:
    return {"t": _rounded(scaling.t), "g": _rounded(scaling.g)}


def _step(scaling: Scaling, mS: complex, factor: float) -> dict[str, Any]:
    """Return the scalings t, g and s of a step. With s, Re(m S) is 1 in the middle of the box."""
    t = scaling.t[:-1] - scaling.t[-1] - np.log(2.0 * factor) / 2.0
    s = np.log(2.0 * max(mS.real, 1e-300)) / 2.0
    return {"t": _rounded(t), "g": _rounded(scaling.g[:-1]), "s": _rounded(np.array([s]))[0]}


def _interval(
    around: Channels, multiplier: Multiplier, step: dict[str, Any], region: Region, w: float
) -> tuple[float, float] | None:
    """Find the interval around w, rad/s, in which the inequality of a step holds with MARGIN.

    The inequality is tried at samples of the interval. Returns None if the inequality fails at w
    itself, or at the next samples on both sides.
    """
    has_limit = "s" in step
    farthest = (
        TURN / (around.period * float(np.abs(multiplier.lags).max())) if has_limit else np.inf
    )
    below = [*_samples(w, region.low, farthest)]
    points = np.array([*below[::-1], w, *_samples(w, region.high, farthest)])
    scale = np.r_[region.half[around.parameters], np.ones(int(has_limit))]
    M = scale[:, None] * around.response(points, multiplier.radius)
    m = multiplier.at(points * around.period) if has_limit else None
    least = np.linalg.eigvalsh(inequality(M, m, step))[:, 0]
    # A NaN is not at least MARGIN either.
    fails = np.flatnonzero(~(least >= MARGIN))
    place = len(below)
    if place in fails:
        return None
    first = int(np.max(fails[fails < place], initial=-1)) + 1
    last = int(np.min(fails[fails > place], initial=len(points))) - 1
    low, high = float(points[first]), float(points[last])
    return (low, high) if low < high else None


def _samples(w: float, end: float, farthest: float) -> Iterator[float]:
    """Yield at most BATCH frequencies from w to `end`, without w itself, rad/s.

    `farthest` is the largest distance between neighbours, rad/s.
    """
    side = float(np.sign(end - w))
    for _ in range(BATCH):
        if w == end:
            return
        w += side * max(min(STRIDE * w, farthest), LOWEST)
        w = end if side * (w - end) > 0.0 else w
        yield w
