# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Search a box for the worst aircraft, with the least unstable deviation or the least margins.

A box has an interval for each uncertain entry of A and B. The search walks over the corners of the
box. Each entry moves to the end of its interval at which a figure, such as a margin, is smaller.
The gradient of the figure shows this end. The gradient is computed from the loop whose entries are
pulled out as channels.
"""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from flight_analysis.linear_loop.input_margins import (
    NO_MODE,
    VANISHED,
    Margins,
    input_margins,
    norm_bound,
    on_grid,
    schur_form,
)
from flight_analysis.linear_loop.input_margins import SLOW as SLOW_TURN
from flight_analysis.linear_loop.structured_value import balancing_t
from flight_analysis.linear_loop.uncertain_loop import (
    Box,
    Channels,
    ComplexArray,
    plants_at,
    sensitivity_slopes,
    uncertain_loop,
)
from flight_core.vectors import FloatArray
from rise_di_controller.law.linear_loop import (
    SPECTRAL_RADIUS_TOLERANCE,
    LinearLaw,
    LinearPlant,
    LoopTiming,
)

SEED = 1  # seed of the random corners at which a search starts
STARTS = 24  # number of these corners
FEW_STARTS = 8  # number of random corners for a quick search
ROUNDS = 12  # largest number of moves to other corners
POLISHED = 4  # number of corners from which each flip of an entry is tried
CLIMBERS = 24  # number of further corners at which climbs start
LONGEST_CLIMB = 40  # largest number of flips in a climb
FALL = 0.005  # fraction by which the next size to try is smaller than the least found
RESOLUTION = 1e-4  # resolution of the size of an unstable deviation
NEAR = 2.5  # a mode counts as near a frequency if the two differ by at most this factor
SLOWEST = 0.05  # frequency, rad/s, below which a mode counts as one at 0 rad/s
REAL = 1e-9  # fraction of an eigenvalue up to which its imaginary part counts as rounding


def first_unstable(
    part: Channels, entries: int, largest: float, *, quick: bool = False
) -> list[FloatArray]:
    """Find unstable aircraft of a part of the loop, with deviations up to the size `largest`.

    The search looks for a divergence at 0 rad/s, and then for modes near one frequency after the
    other, up to pi / T. A `quick` search has FEW_STARTS and no climbs. The deviations of an
    aircraft have the shape (entries,). Each aircraft deviates less than the one before it.
    """
    highest = np.pi / part.period
    count = int(np.ceil(np.log(highest / SLOWEST) / (2.0 * np.log(NEAR))))
    windows = highest / NEAR ** (1.0 + 2.0 * np.arange(count))
    deviations = []
    least = largest
    for w in (0.0, *windows):
        size, corner = _oscillation(part, w, least, quick=quick) if w else _divergence(part)
        if size <= least:
            d = np.zeros(entries)
            d[list(part.entries)] = size * corner
            deviations.append(d)
            least = size
    return deviations


def _divergence(part: Channels) -> tuple[float, FloatArray]:
    """Find the least size of the box at which an eigenvalue leaves the circle at z = 1.

    Returns the size, and the corner of the box, (k,), at which this happens. The size is infinite
    if no eigenvalue leaves. At a corner s, the size is the reciprocal of the largest real
    eigenvalue of M diag(s), because det(I - size M diag(s)) = 0 there. From STARTS corners, each
    s_i moves to the side at which this eigenvalue is larger. Coefficients beyond the means over a
    period are left out.
    """
    k = len(part.entries)
    M = part.response(0.0, 1.0 + SPECTRAL_RADIUS_TOLERANCE)[:k, :k].real
    corners = np.where(np.random.default_rng(SEED).random((STARTS, k)) < 0.5, -1.0, 1.0)
    best = np.zeros(STARTS)
    best_corners = corners
    for _ in range(ROUNDS):
        values, X = np.linalg.eig(M * corners[:, None, :])
        sizes = np.abs(values)
        upward = np.where(np.abs(values.imag) <= REAL * sizes, values.real, 0.0)
        most = np.argmax(upward, axis=1)
        rows = np.arange(STARTS)
        rises = upward[rows, most] > best
        best_corners = np.where(rises[:, None], corners, best_corners)
        best = np.where(rises, upward[rows, most], best)
        if not rises.any():
            break
        # These are the slopes of the logarithm of the eigenvalue along each s_i, times s_i. A
        # negative one says that s_i should change its side.
        slopes = np.linalg.pinv(X)[rows, most] * X[rows, :, most]
        corners = np.where((slopes.real < 0.0) & rises[:, None], -corners, corners)
    first = int(np.argmax(best))
    return (1.0 / best[first] if best[first] > 0.0 else np.inf), best_corners[first]


def _oscillation(
    part: Channels, frequency: float, largest: float, *, quick: bool
) -> tuple[float, FloatArray]:
    """Find the least size of the box at which a mode near a frequency, rad/s, is unstable.

    Returns the size, infinite if none is found, and the corner of the box, (k,), at which this
    happens. From each of STARTS corners, the search grows the size until a mode near the frequency
    leaves abs(z) < 1. Then it moves to the corner towards which abs(z) rises. It repeats this until
    it finds no new corner, at most ROUNDS times. If the search is not `quick`, it finally climbs
    from further corners at a smaller size. It repeats this as long as one of the climbs ends at an
    unstable aircraft.
    """
    rng = np.random.default_rng(SEED)
    k = len(part.entries)
    corners = np.where(rng.random((FEW_STARTS if quick else STARTS, k)) < 0.5, -1.0, 1.0)
    begin = np.sign(_growth(part, np.zeros((1, k)), frequency))
    corners = np.concatenate([np.where(begin == 0.0, 1.0, begin), corners])
    size_by_corner: dict[tuple[float, ...], float] = {}
    for _ in range(ROUNDS):
        sizes = np.array([_limit(part, corner, frequency, largest) for corner in corners])
        size_by_corner.update(zip(map(tuple, corners), sizes, strict=True))
        at = np.minimum(sizes, largest)[:, None] * corners
        next_corners = np.where(_growth(part, at, frequency) < 0.0, -1.0, 1.0)
        fresh = [corner for corner in set(map(tuple, next_corners)) if corner not in size_by_corner]
        if not fresh:
            break
        corners = np.array(sorted(fresh))
    ranked = sorted(size_by_corner, key=lambda corner: (size_by_corner[corner], corner))
    least = size_by_corner[ranked[0]]
    if quick:
        return least, np.array(ranked[0])
    fresh_corners = np.where(rng.random((CLIMBERS, k)) < 0.5, -1.0, 1.0)
    starts = np.concatenate([np.array(ranked[:POLISHED]), fresh_corners])
    return _nearer(part, frequency, min(least, largest), starts, (least, np.array(ranked[0])))


def _nearer(
    part: Channels,
    frequency: float,
    level: float,
    starts: FloatArray,
    found: tuple[float, FloatArray],
) -> tuple[float, FloatArray]:
    """Find a smaller size by climbs a little below `level`, and return the size and its corner.

    If a climb ends at an unstable aircraft, the size of this aircraft is the next level. If no
    climb does, the function returns `found`, which is a size and its corner.
    """
    while True:
        corner, radius = _climbed(part, starts, frequency, (1.0 - FALL) * level)
        if radius <= 1.0 + SPECTRAL_RADIUS_TOLERANCE:
            return found
        level = _limit(part, corner, frequency, (1.0 - FALL) * level)
        found = level, corner
        starts = np.concatenate([corner[None], starts])


def _climbed(
    part: Channels, starts: FloatArray, frequency: float, size: float
) -> tuple[FloatArray, float]:
    """Climb from corners at a given size to the largest mode near a frequency.

    Returns the best corner, and abs(z) of its mode. A climb flips one entry at a time as long as
    abs(z) grows. At first it flips the entry with the steepest slope. From the POLISHED best
    corners, it then flips the entry that raises abs(z) most.
    """
    corners = starts.copy()
    radii = _radii(part, size * corners, frequency)
    climbing = np.arange(len(corners))
    for _ in range(LONGEST_CLIMB):
        around = corners[climbing]
        steepest = np.argmin(_growth(part, size * around, frequency) * around, axis=1)
        around[np.arange(len(around)), steepest] *= -1.0
        reached = _radii(part, size * around, frequency)
        rises = reached > radii[climbing]
        climbing = climbing[rises]
        corners[climbing], radii[climbing] = around[rises], reached[rises]
        if not len(climbing):
            break
    corners = corners[np.argsort(-radii)[:POLISHED]]
    flips = np.where(np.eye(corners.shape[1], dtype=bool), -1.0, 1.0)
    flips = np.concatenate([np.ones_like(flips[:1]), flips])
    for _ in range(LONGEST_CLIMB):
        trial = corners[:, None] * flips
        grown = _radii(part, size * trial, frequency)
        steepest = np.argmax(grown, axis=1)
        if not steepest.any():
            break
        corners = trial[np.arange(len(corners)), steepest]
    best = int(np.argmax(grown[:, 0]))
    return corners[best], float(grown[best, 0])


def _radii(part: Channels, d: FloatArray, frequency: float) -> FloatArray:
    """Return the largest abs(z) of a mode near a frequency for each d.

    `d` has the shape (..., k), and the result has the shape (...).
    """
    return np.asarray(_near(np.linalg.eigvals(part.at(d).A), frequency, part.period).max(axis=-1))


def _near(z: NDArray[Any], frequency: float, period: float) -> FloatArray:
    """Return abs(z) of the modes near a frequency, and 0 for the others."""
    w = np.abs(np.angle(z)) / period
    near = (w > frequency / NEAR) & (w <= frequency * NEAR * (1.0 + REAL))
    return np.asarray(np.where(near, np.abs(z), 0.0))


def _limit(part: Channels, corner: FloatArray, frequency: float, largest: float) -> float:
    """Find the size s at which a mode near a frequency, rad/s, becomes unstable.

    The deviations are s times `corner`. The result is infinite if no mode near the frequency
    becomes unstable up to the size `largest`.
    """

    def is_unstable(size: FloatArray) -> NDArray[np.bool_]:
        z = np.linalg.eigvals(part.at(size[:, None] * corner).A)
        largest_near = _near(z, frequency, part.period).max(axis=-1)
        return np.asarray(largest_near > 1.0 + SPECTRAL_RADIUS_TOLERANCE)

    low, high = 0.0, largest
    while high - low > RESOLUTION / 2.0:
        sizes = np.linspace(low, high, 9)
        outside = is_unstable(sizes[1:])
        if not outside.any():
            return np.inf
        place = int(np.argmax(outside))
        low, high = sizes[place : place + 2].tolist()
    return high


def _growth(part: Channels, d: FloatArray, frequency: float) -> FloatArray:
    """Compute the slopes d log abs(z) / d d_i of the largest mode near a frequency, (N, k).

    The slopes are evaluated at the deviations d, (N, k), one row for each of N aircraft.
    """
    around = part.at(d)
    z, X = np.linalg.eig(around.A)
    Y = np.linalg.inv(X)
    rows = np.arange(len(d))
    worst = np.argmax(_near(z, frequency, part.period), axis=-1)
    into = Y[rows, worst][:, None, :] @ around.W
    out = around.Z @ X[rows, :, worst][:, :, None]
    change = into[:, 0] * out[:, :, 0] / z[rows, worst][:, None]
    return np.asarray(change.real.reshape(len(d), -1, len(part.entries)).sum(axis=1))


# The least margins of a box

# number of random corners at the start of the walk. Others are those to which the slopes of the
# nominal aircraft point.
BEGUN = 16
FOLLOWED = 2  # number of corners with the least values of a figure from which the walk continues
WALKED = 6  # largest number of rounds of the walk over the corners


class WorstCase(NamedTuple):
    """The least margins that a search has found in a box.

    Each margin can belong to a different aircraft.
    """

    worst: Margins
    corners: FloatArray  # deviations of all aircraft that were tried, (N, k)
    margins: Margins  # margins of these N aircraft
    least_phase: FloatArray  # deviations with the smallest phase margin, (k,)


def worst_in_box(plant: LinearPlant, law: LinearLaw, loop: LoopTiming, box: Box) -> WorstCase:
    """Search the corners of a box around a plant, A (n, n), for the least margins.

    The search is made for each figure, such as the phase margin of an input. It starts at corners
    where the figure is least, and goes to the corner to which the slope of the figure points, until
    it finds no new corner. The margins are computed by `input_margins`.
    """
    rng = np.random.default_rng(SEED)
    k = len(box.names)
    uncertain = uncertain_loop(plant, law, loop, box)
    random_corners = np.where(rng.random((BEGUN, k)) < 0.5, -1.0, 1.0)
    slopes = _slopes(plant, law, loop, box, uncertain, np.zeros(k))
    corners = np.unique(np.concatenate([_corners(slopes), random_corners]), axis=0)
    margins = input_margins(plants_at(plant, box, corners), law, loop)
    walked: set[tuple[int, int]] = set()
    for _ in range(WALKED):
        least = np.argsort(_figures(margins), axis=0)[:FOLLOWED]
        steps = [(f, at) for row in least.tolist() for f, at in enumerate(row)]
        steps = [pair for pair in steps if pair not in walked]
        walked.update(steps)
        candidates = []
        for place in sorted({place for _, place in steps}):
            if margins.stable[place]:
                slopes = _slopes(plant, law, loop, box, uncertain, corners[place])
                candidates += [_corners(slopes[f]) for f, at in steps if at == place]
        fresh = [c for c in map(tuple, candidates) if not (corners == c).all(axis=1).any()]
        if not fresh:
            break
        fresh_corners = np.unique(fresh, axis=0)
        further = input_margins(plants_at(plant, box, fresh_corners), law, loop)
        corners = np.concatenate([corners, fresh_corners])
        margins = Margins(*(np.concatenate(pair) for pair in zip(margins, further, strict=True)))
    smallest = int(np.argmin(margins.phase.min(axis=1)))
    return WorstCase(margins.worst(), corners, margins, corners[smallest])


def _corners(slopes: FloatArray) -> FloatArray:
    """Return, for each figure, the corner of the box in whose direction the figure falls."""
    return np.asarray(np.where(slopes > 0.0, -1.0, 1.0))


def _figures(margins: Margins) -> FloatArray:
    """Arrange the margins of N aircraft as one row of figures each, (N, 4 m + 3).

    A smaller figure is a worse one. The figures have the order of the rows of `_slopes`.
    """
    all_inputs = (1.0 / margins.sensitivity_all, margins.disk_all, margins.damping)
    return np.concatenate(
        [
            margins.phase,
            margins.gain,
            1.0 / margins.sensitivity,
            margins.disk,
            np.stack(all_inputs, 1),
        ],
        axis=1,
    )


@np.errstate(divide="ignore", invalid="ignore")  # an input without feedback has no crossing: L = 0
def _slopes(
    plant: LinearPlant,
    law: LinearLaw,
    loop: LoopTiming,
    box: Box,
    uncertain: Channels,
    d: FloatArray,
) -> FloatArray:
    """Compute the slopes of `_figures` along the deviations at d, up to a positive factor.

    The result has the shape (4 m + 3, k). With a = d log L / d d_i and b = d log L / d w, the slope
    of the phase at abs(L) = 1 is Im a - Im b Re a / Re b, and the slope of the log of the gain at
    real L is Re a - Re b Im a / Im b. The slope of a peak of abs(S - c) is its slope at constant
    frequency.
    """
    at = plants_at(plant, box, d[None])
    form = schur_form(at, law, loop)
    w, S = (values[0] for values in on_grid(form, loop.period))
    m = S.shape[-1]
    diagonal = np.einsum("Fii->Fi", S)
    L = 1.0 / diagonal - 1.0
    log_gain = np.log(np.abs(L))
    # Find the frequencies of the margins: crossings, then peaks, of each input and of all at once.
    phase_distance = np.abs(np.angle(-L))
    half = S - np.eye(m) / 2.0
    phase_at, phase_rate = _crossed(w, L, log_gain, phase_distance[:-1])
    gain_at, gain_rate = _crossed(
        w, L, L.imag, np.where(L.real < 0.0, np.abs(log_gain), np.inf)[:-1]
    )
    peaks = [np.argmax(np.abs(matrix), axis=0) for matrix in (diagonal, diagonal - 0.5)]
    peaks += [[int(np.argmax(norm_bound(matrix)))] for matrix in (S, half)]
    frequencies = np.concatenate([phase_at, gain_at, w[np.concatenate(peaks)]])
    S_at, change = sensitivity_slopes(uncertain, d, frequencies)  # (4 m + 2, m, m), (.., k, m, m)
    # The slopes of the figures of an input, by the formulas above.
    rows = np.tile(np.arange(m), 4)
    derivative = change[np.arange(4 * m), :, rows, rows]
    x = S_at[np.arange(4 * m), rows, rows][:, None]
    a = -derivative / (x * (1.0 - x))
    b = np.concatenate([phase_rate, gain_rate, np.ones(2 * m)])[:, None]
    phase = a.imag - b.imag * a.real / b.real
    gain = a.real - b.real * a.imag / b.imag
    loop_at = 1.0 / x - 1.0
    peak = -(derivative * np.conj(x - np.repeat([0.0, 0.0, 0.0, 0.5], m)[:, None])).real
    kinds = np.repeat([0, 1, 2, 2], m)[:, None]
    falling = np.sign(np.log(np.abs(loop_at))) * gain
    each = np.where(
        kinds == 0, np.sign(np.angle(-loop_at)) * phase, np.where(kinds == 1, falling, peak)
    )
    # The slopes of the peaks of all inputs, by the singular vectors of the balanced matrix.
    together = []
    for centre, matrix, part in zip((0.0, 0.5), S_at[4 * m :], change[4 * m :], strict=True):
        t = np.exp(balancing_t(matrix))[:, None]
        left, _, right = np.linalg.svd(t * (matrix - centre * np.eye(m)) / t.T)
        turned = t * part / t.T
        together.append(-np.einsum("i,kij,j->k", left[:, 0].conj(), turned, right[0].conj()).real)
    slopes = np.concatenate([each, together, [_damping_slope(uncertain, d)]])
    return np.asarray(np.nan_to_num(slopes))


def _crossed(
    w: FloatArray, L: ComplexArray, values: FloatArray, distance: FloatArray
) -> tuple[FloatArray, ComplexArray]:
    """Find the zero of `values`, (F, m), with the least `distance`, (F - 1, m), for each input.

    Returns the frequency of this zero, rad/s, and d log L / d w at it, each (m,). If there is no
    zero, the lowest frequency is returned.
    """
    columns = np.arange(values.shape[1])
    crosses = np.signbit(values[:-1]) != np.signbit(values[1:])
    wide = np.diff(w)[:, None] > 0.0
    place = np.argmin(np.where(crosses & wide, distance, np.inf), axis=0)
    before = values[place, columns]
    after = values[place + 1, columns]
    step = w[place + 1] - w[place]
    share = np.clip(before / np.where(before == after, 1.0, before - after), 0.0, 1.0)
    rate = np.log(L[place + 1, columns] / L[place, columns]) / np.maximum(step, 1e-12)
    return np.asarray(w[place] + share * step), np.asarray(rate)


def _damping_slope(uncertain: Channels, d: FloatArray) -> FloatArray:
    """Compute the slope of the least damping ratio of a slow mode along the deviations, at d, (k,).

    The damping ratio is zeta = -cos(angle(log z)). The slope is known only up to a positive factor.
    """
    around = uncertain.at(d)
    z, X = np.linalg.eig(around.A)
    turn = np.log(np.where(np.abs(z) > VANISHED, z, VANISHED).astype(complex))
    slow = (turn.imag > NO_MODE) & (np.abs(turn) < SLOW_TURN)
    if not slow.any():
        return np.zeros(len(d))
    damping = np.where(slow, -turn.real / np.maximum(np.abs(turn), NO_MODE), np.inf)
    mode = int(np.argmin(damping))
    into = np.linalg.solve(X.T, np.eye(len(z))[mode]) @ around.W
    change = into * (around.Z @ X[:, mode]) / z[mode]  # slope of log z
    by_channel = (change / turn[mode]).imag[: uncertain.uncertain]
    angle = by_channel.reshape(-1, len(d)).sum(axis=0)
    return np.asarray(np.sin(np.angle(turn[mode])) * angle)
