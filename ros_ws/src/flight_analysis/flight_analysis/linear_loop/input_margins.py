# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Margins of the sampled linear loop of a law at the inputs of an aircraft.

The margins are phase margin, gain margin, sensitivity, disk margin and damping.

P(z) is the sampled aircraft from u to y, with actuators and delay, and K(z) the law from y to u:

    S(z) = (I - K P)^-1,    L_i(z) = 1 / S_ii(z) - 1  loop transfer function, input i alone open

on z = exp(j w T), 0 < w <= pi / T. Sources: K. J. Astrom, R. M. Murray, "Feedback Systems", chapter
10, for phase, gain and sensitivity. P. Seiler, A. Packard, P. Gahinet, "An Introduction to Disk
Margins", IEEE Control Systems 40(5), 2020.
"""

from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from flight_core.vectors import FloatArray
from rise_di_controller.law.linear_loop import (
    SPECTRAL_RADIUS_TOLERANCE,
    LinearLaw,
    LinearPlant,
    LoopTiming,
    closed_loop,
    sampled_plant,
)

ComplexArray = NDArray[np.complex128]
IntArray = NDArray[np.intp]

DECADES = 5
PER_DECADE = 40
"""Number of points per decade in the grid of frequencies, which covers DECADES below pi / T. The
frequencies of the modes, and eight points around every peak, are added to the grid."""

SLOW = np.pi / 2.0
"""A mode counts as slow if its natural frequency times T is below this, rad, so that a cycle has
more than four ticks. The gain margin and S show faster modes.
"""

# rad; if the frequency of an eigenvalue times T is less, it belongs to an integral or to a constant
# state, and is no mode
NO_MODE = 1e-6
# If abs(z) of an eigenvalue is less, it comes from a delayed input or from rounding. Such a motion
# ends within a period.
VANISHED = 1e-9
# S is exact to 1e-9 up to this condition number of the eigenvectors, in the Frobenius norm.
MOST_CONDITION = 1e6
BATCH = 16  # aircraft computed together: larger arrays leave the cache
# OpenBLAS starts no threads for a complex matrix with at most this many entries. Threads would only
# wait.
SERIAL_SIZE = 4000
# L counts as real at the lowest frequency if the phase of -L there is less than this, rad.
PHASE_AT_ZERO = 0.01
BALANCED_ROUNDS = 6  # rounds of Osborne's iteration
DESCENT_STEPS = 40  # steps of the descent in `scaled_norm`
MAX_REFINED = 40  # rounds of the search for the largest norm over the frequencies


class Margins(NamedTuple):
    """Margins at m inputs, shape (..., m), and margins of the loop as a whole, shape (...).

    For an unstable loop the gain margins are 1, the other margins 0, and the sensitivity infinite.
    """

    stable: NDArray[np.bool_]  # whether no eigenvalue lies outside the unit circle, (...)
    phase: FloatArray  # phase margin, rad, (..., m), infinite if abs(L_i) is never 1
    crossover: FloatArray  # frequency of the phase margin, rad/s, (..., m), 0 without one
    # factor below 1 at which the loop becomes unstable, (..., m), 0 without a limit
    gain_decrease: FloatArray
    gain_increase: FloatArray  # the same factor above 1, (..., m), infinite without one
    sensitivity: FloatArray  # largest abs(S_ii), (..., m)
    disk: FloatArray  # balanced disk margin of an input, 0 to 2, (..., m)
    # largest singular value of the diagonally scaled S for all inputs, (...)
    sensitivity_all: FloatArray
    disk_all: FloatArray  # balanced disk margin for independent disks in all inputs, (...)
    damping: FloatArray  # least damping ratio of a slow mode, 1 without one, (...)

    @property
    def gain(self) -> FloatArray:
        """Gain margin, (..., m): the smaller factor, up or down, as a number of at least 1."""
        with np.errstate(divide="ignore"):
            return np.minimum(self.gain_increase, 1.0 / self.gain_decrease)

    def at(self, place: int | slice) -> "Margins":
        """Return the margins of one or some of N aircraft. `place` is an index or a slice."""
        return Margins(**{name: value[place] for name, value in self._asdict().items()})

    def worst(self) -> "Margins":
        """Return the worst value of each margin among N aircraft.

        The margins of N aircraft have the shapes (N, m) and (N,), and the worst ones (m,) and ().
        The crossover of an input comes from the aircraft with the smallest phase margin.
        """
        least = {name: np.asarray(value.min(axis=0)) for name, value in self._asdict().items()}
        most = {
            name: np.asarray(getattr(self, name).max(axis=0))
            for name in ("gain_decrease", "sensitivity", "sensitivity_all")
        }
        least_phase = np.argmin(self.phase, axis=0)[None]
        return Margins(
            **least
            | most
            | {"crossover": np.take_along_axis(self.crossover, least_phase, axis=0)[0]}
        )


def disk_gain(disk: FloatArray) -> FloatArray:
    """Convert a balanced disk margin to the gain margin (2 + disk) / (2 - disk).

    The gain may be multiplied or divided by this factor.
    """
    with np.errstate(divide="ignore"):
        return np.asarray((2.0 + disk) / np.maximum(2.0 - disk, 0.0))


def disk_phase(disk: FloatArray) -> FloatArray:
    """Convert a balanced disk margin to a phase margin, rad: 2 atan(disk / 2)."""
    return np.asarray(2.0 * np.arctan(disk / 2.0))


class SlowModes(NamedTuple):
    """Oscillating modes of a closed loop whose cycle takes at least four ticks, slowest first."""

    frequency: FloatArray  # natural frequency, rad/s, (k,)
    damping: FloatArray  # damping ratio, (k,)


def slow_modes(plant: LinearPlant, law: LinearLaw, loop: LoopTiming) -> SlowModes:
    """Compute the slow modes of an aircraft under a law.

    With p = log(eigenvalue) / T, the frequency is abs(p) and the damping ratio -Re p / abs(p).
    """
    eigenvalues = np.linalg.eigvals(closed_loop(plant, law, loop, np.zeros(len(loop.lag))))
    return _slow_modes(eigenvalues.astype(np.complex128), loop.period)


def _slow_modes(eigenvalues: ComplexArray, period: float) -> SlowModes:
    turns = np.log(eigenvalues[np.abs(eigenvalues) > VANISHED])
    slow = turns[(turns.imag > NO_MODE) & (np.abs(turns) < SLOW)]
    slow = slow[np.argsort(np.abs(slow))]
    return SlowModes(np.abs(slow) / period, -slow.real / np.abs(slow))


def loop_transfer(
    plant: LinearPlant, law: LinearLaw, loop: LoopTiming, w: FloatArray
) -> ComplexArray:
    """Compute the loop transfer functions L_i, (F, m), at F frequencies w <= pi / T, rad/s."""
    form = schur_form(LinearPlant(plant.A[None], plant.B[None], plant.C), law, loop)
    S = _sensitivity(form, np.exp(1j * w * loop.period)[None])[0]
    return np.asarray(1.0 / np.einsum("...ii->...i", S) - 1.0)


def input_margins(
    plant: LinearPlant, law: LinearLaw, loop: LoopTiming, *, together: bool = True
) -> Margins:
    """Compute the margins of an aircraft, or of N aircraft.

    For N aircraft, the plant has A (N, n, n) and B (N, n, m), and the law is either common or one
    for each aircraft. Crossings that are found on the grid of frequencies are refined to rounding,
    and peaks to 1e-3 of their height. The phase margin is the smallest abs(angle(-L_i)) at abs(L_i)
    = 1. At real L_i < 0 a gain factor of 1 / abs(L_i) makes the loop pass through -1. The gain
    margins are the largest such factor below 1, and the smallest above 1. The disk margin of an
    input is 1 / max_w abs(S_ii - 1/2). With independent disks in all inputs at once, it is

        1 / max_w min_D norm(D (S - I/2) D^-1, 2),  D diagonal

    This value is exact for m <= 3. For more inputs the true disk margin can be larger. If
    `together` is False, `sensitivity_all` and `disk_all` are NaN, which saves a third of the time.
    """
    shape = _batch_shape(plant, law)
    parts = [
        _margins(schur_form(*batch, loop), loop.period, together=together)
        for batch in _batches(plant, law)
    ]
    return Margins(
        *(
            np.concatenate(values).reshape((*shape, *values[0].shape[1:]))
            for values in zip(*parts, strict=True)
        )
    )


def phase_margins(plant: LinearPlant, law: LinearLaw, loop: LoopTiming) -> FloatArray:
    """Compute only the phase margins of `input_margins`, (..., m), rad, to 1e-8.

    This is faster than `input_margins`, because there is no search for gain margins and peaks. If
    the modes of a loop are independent, S is evaluated as a sum over the modes.
    """
    parts = []
    for aircraft, its_law in _batches(plant, law):
        form, independent = _modal_form(aircraft, its_law, loop)
        phase = _phases(form, loop.period)
        if not independent.all():
            remainder = np.flatnonzero(~independent)
            few = aircraft._replace(A=aircraft.A[remainder], B=aircraft.B[remainder])
            few_laws = LinearLaw(*(matrix[remainder] for matrix in its_law))
            phase[remainder] = _phases(schur_form(few, few_laws, loop), loop.period)
        parts.append(phase)
    return np.concatenate(parts).reshape(*_batch_shape(plant, law), -1)


def _phases(form: "SchurForm", period: float) -> FloatArray:
    """Compute the phase margins of the aircraft of a batch, (N, m), rad."""
    w = _frequencies(form.eigenvalues, period)
    L = _loop_of_sensitivity(_sensitivity(form, np.exp(1j * w * period)))
    phase, _ = _phase_margins(form, w, L, period)
    return np.where(_is_stable(form)[:, None], phase, 0.0)


def _batch_shape(plant: LinearPlant, law: LinearLaw) -> tuple[int, ...]:
    return np.broadcast_shapes(*(matrix.shape[:-2] for matrix in (plant.A, plant.B, law.A)))


class SchurForm(NamedTuple):
    """The closed loop in Schur form, from a disturbance d of the inputs to v = d + u.

    v = d + L (z - T)^-1 R d.
    """

    T: ComplexArray  # upper triangular (N, k, k), or the diagonal alone (N, k)
    R: ComplexArray  # (N, k, m)
    L: ComplexArray  # (N, m, k)

    @property
    def eigenvalues(self) -> ComplexArray:
        """Eigenvalues of the closed loops, (N, k)."""
        return self.T if self.T.ndim == self.R.ndim - 1 else np.einsum("...ii->...i", self.T)


def _batches(plant: LinearPlant, law: LinearLaw) -> Iterator[tuple[LinearPlant, LinearLaw]]:
    """Split one or N aircraft into batches, and yield each batch with the laws of its aircraft."""
    shape = _batch_shape(plant, law)
    count = int(np.prod(shape))

    def each(matrix: FloatArray) -> FloatArray:
        return np.broadcast_to(matrix, (*shape, *matrix.shape[-2:])).reshape(
            count, *matrix.shape[-2:]
        )

    A = each(plant.A)
    B = each(plant.B)
    laws = [each(matrix) for matrix in law]
    for k in range(0, count, BATCH):
        batch = slice(k, k + BATCH)
        its_law = LinearLaw(*(matrix[batch] for matrix in laws))
        yield LinearPlant(A[batch], B[batch], plant.C), its_law


def schur_form(plant: LinearPlant, law: LinearLaw, loop: LoopTiming) -> SchurForm:
    """Bring the closed loops of N aircraft, with A (N, n, n) and B (N, n, m), into Schur form."""
    from scipy.linalg import schur  # noqa: PLC0415 - a controller without an observer starts without it

    A, B, K = _from_inputs_to_inputs(plant, law, loop)
    pairs = [schur(matrix, output="complex") for matrix in A]
    T, Q = (np.array(matrices, dtype=np.complex128) for matrices in zip(*pairs, strict=True))
    return SchurForm(T, Q.conj().swapaxes(1, 2) @ B, K @ Q)


def _modal_form(
    plant: LinearPlant, law: LinearLaw, loop: LoopTiming
) -> tuple[SchurForm, NDArray[np.bool_]]:
    """Return the loops as a `SchurForm` with a diagonal T, and a mask of the loops that permit it.

    A loop permits a diagonal T if its modes are independent, which means that the condition number
    of its eigenvectors is at most MOST_CONDITION.
    """
    A, B, K = _from_inputs_to_inputs(plant, law, loop)
    eigenvalues, modes = (part.astype(np.complex128) for part in np.linalg.eig(A))
    size = np.linalg.norm(modes, axis=(1, 2))
    try:
        inverse: ComplexArray = np.linalg.inv(modes).astype(np.complex128)
    except np.linalg.LinAlgError:  # two eigenvectors are equal to the last bit
        inverse = np.full_like(modes, np.inf)
    with np.errstate(over="ignore"):
        independent = size * np.linalg.norm(inverse, axis=(1, 2)) <= MOST_CONDITION
    inverse[~independent] = 0.0
    return SchurForm(eigenvalues, inverse @ B, K @ modes), np.asarray(independent)


def _from_inputs_to_inputs(
    plant: LinearPlant, law: LinearLaw, loop: LoopTiming
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return A, B and K of the closed loops of N aircraft, from a disturbance d of the inputs to u.

    z+ = A z + B d, u = K z
    """
    no_delay = np.zeros(len(loop.lag))
    N, _, m = plant.B.shape
    _, B, C = sampled_plant(plant, loop, no_delay)
    B = np.concatenate([B, np.zeros((N, law.A.shape[-1], m))], axis=1)
    K = np.concatenate([law.D @ C, np.broadcast_to(law.C, (N, *law.C.shape[-2:]))], axis=2)
    return closed_loop(plant, law, loop, no_delay), B, K


def _sensitivity(form: SchurForm, z: ComplexArray) -> ComplexArray:
    """Compute S at the points z by back substitution.

    z has the shape (N, F), and S has (N, F, m, m). Points are solved many at a time. If T is
    diagonal, S is a sum over the modes.
    """
    (N, k, m), F = form.R.shape, z.shape[1]
    if form.T.ndim == z.ndim:
        residues = form.L.swapaxes(1, 2)[..., None] * form.R[:, :, None]
        summed = 1.0 / (z[..., None] - form.T[:, None]) @ residues.reshape(N, k, m * m)
        return np.asarray(np.eye(m) + summed.reshape(N, F, m, m))
    size = min(max(SERIAL_SIZE // (k * m), 1), F)
    z = np.pad(z, ((0, 0), (0, -F % size)), mode="edge").reshape(N, -1, size)
    X = np.zeros((N, z.shape[1], k, size, m), dtype=np.complex128)
    flat = X.reshape(N, -1, k, size * m)
    for i in reversed(range(k)):
        coupled = (form.T[:, None, i, None, i + 1 :] @ flat[:, :, i + 1 :]).reshape(N, -1, size, m)
        X[:, :, i] = (form.R[:, None, i, None] + coupled) / (z - form.T[:, i, i, None, None])[
            ..., None
        ]
    product = (form.L[:, None] @ flat).reshape(N, -1, m, size, m)
    return np.asarray(np.eye(m) + product.swapaxes(2, 3).reshape(N, -1, m, m)[:, :F])


def _margins(form: SchurForm, period: float, *, together: bool) -> Margins:
    """Compute the margins of the aircraft of a batch, from their closed loops in Schur form."""
    stable = _is_stable(form)
    m = form.R.shape[-1]
    w, S = on_grid(form, period)
    near = _around_peaks(S, w)
    every = np.concatenate([S, _balanced(_sensitivity(form, np.exp(1j * near * period)))], axis=1)
    diagonal = np.einsum("NFii->NFi", every)
    norm = norm_half = np.full(len(every), np.nan)
    if together:
        norm = _largest_norm(every)
        norm_half = _largest_norm(np.asarray(every - np.eye(m) / 2.0))
    with np.errstate(divide="ignore"):
        disk = 1.0 / np.max(np.abs(diagonal - 0.5), axis=1)
        disk_all = 1.0 / norm_half
    L = _loop_of_sensitivity(S)
    phase, crossover = _phase_margins(form, w, L, period)
    decrease, increase = _gain_margins(form, w, L, period)
    each = stable[:, None]
    return Margins(
        stable=stable,
        phase=np.where(each, phase, 0.0),
        crossover=np.where(each, crossover, 0.0),
        gain_decrease=np.where(each, decrease, 1.0),
        gain_increase=np.where(each, increase, 1.0),
        sensitivity=np.where(each, np.max(np.abs(diagonal), axis=1), np.inf),
        disk=np.where(each, disk, 0.0),
        sensitivity_all=np.where(stable, norm, np.inf),
        disk_all=np.where(stable, disk_all, 0.0),
        damping=np.array(
            [min([1.0, *_slow_modes(row, period).damping]) for row in form.eigenvalues]
        ),
    )


def _is_stable(form: SchurForm) -> NDArray[np.bool_]:
    return np.asarray(np.max(np.abs(form.eigenvalues), axis=1) <= 1.0 + SPECTRAL_RADIUS_TOLERANCE)


def on_grid(form: SchurForm, period: float) -> tuple[FloatArray, ComplexArray]:
    """Return frequencies of each aircraft, (N, F), rad/s, and balanced S there, (N, F, m, m)."""
    w = _frequencies(form.eigenvalues, period)
    return w, _balanced(_sensitivity(form, np.exp(1j * w * period)))


def _loop_of_sensitivity(S: ComplexArray) -> ComplexArray:
    """Compute L_i = 1 / S_ii - 1, (N, F, m)."""
    with np.errstate(divide="ignore"):
        return np.asarray(1.0 / np.einsum("NFii->NFi", S) - 1.0)


def _frequencies(eigenvalues: ComplexArray, period: float) -> FloatArray:
    """Return the ascending frequencies at which each aircraft is evaluated, (N, F), rad/s.

    An aircraft has the frequencies of a common grid and the frequencies of its own modes.
    """
    highest = np.pi / period
    turns = np.log(np.where(np.abs(eigenvalues) > VANISHED, eigenvalues, VANISHED)) / period
    modes = np.where(turns.imag != 0.0, np.abs(turns.imag), np.abs(turns))
    grid = np.geomspace(highest / 10.0**DECADES, highest, DECADES * PER_DECADE + 1)
    common = np.broadcast_to(grid, (len(eigenvalues), len(grid)))
    return np.sort(np.concatenate([common, np.clip(modes, grid[0], grid[-1])], axis=1), axis=1)


def _around_peaks(S: ComplexArray, w: FloatArray) -> FloatArray:
    """Return four frequencies below and four above each peak, (N, G), rad/s.

    A peak is a maximum over frequency of abs(S_ii), of abs(S_ii - 1/2), or of the norm of the
    balanced S or S - I/2.
    """
    diagonal = np.einsum("NFii->NFi", S)
    half = S - np.eye(S.shape[-1]) / 2.0
    norms = [norm_bound(matrix)[..., None] for matrix in (S, half)]
    # (N, Q)
    peaks = np.argmax(
        np.concatenate([np.abs(diagonal), np.abs(diagonal - 0.5), *norms], axis=2), axis=1
    )
    first = np.maximum(peaks - 1, 0)
    last = np.minimum(peaks + 1, w.shape[1] - 1)
    rows = np.arange(len(w))[:, None]
    parts = (np.arange(1, 5) / 5.0)[:, None, None]
    sides = [
        low + parts * (high - low)
        for low, high in ((w[rows, first], w[rows, peaks]), (w[rows, peaks], w[rows, last]))
    ]
    return np.moveaxis(np.concatenate(sides), 0, 1).reshape(len(w), -1)


# Crossings


def _crossings(values: FloatArray) -> tuple[IntArray, IntArray, IntArray]:
    """Find the changes of sign along the second axis of `values`, (N, F, m).

    Returns three indices for each change: the index of the aircraft, of the last frequency before
    the change, and of the input.
    """
    return np.nonzero(np.signbit(values[:, :-1]) != np.signbit(values[:, 1:]))  # type: ignore[return-value]


def _refined(
    form: SchurForm,
    w: FloatArray,
    places: tuple[IntArray, IntArray, IntArray],
    values: FloatArray,
    period: float,
    residual: Callable[[ComplexArray], FloatArray],
) -> tuple[FloatArray, ComplexArray]:
    """Refine crossings to the frequencies where residual(L_i) = 0, and return L_i there as well.

    The method is regula falsi with the Illinois modification.
    """
    aircraft, place, channel = places
    # Keep only the row and the column of the input whose L_i crosses.
    forms = SchurForm(
        form.T[aircraft], form.R[aircraft, :, channel, None], form.L[aircraft, None, channel]
    )
    low = w[aircraft, place]
    high = w[aircraft, place + 1]
    at_low = values[aircraft, place, channel]
    at_high = values[aircraft, place + 1, channel]
    middle = low
    L = np.zeros(len(low), dtype=np.complex128)
    before = np.zeros(len(low))
    for _ in range(8 if len(low) else 0):
        gap = at_high - at_low
        middle = np.where(
            gap == 0.0, low, low - at_low * (high - low) / np.where(gap == 0.0, 1.0, gap)
        )
        S = _sensitivity(forms, np.exp(1j * middle * period)[:, None])[:, 0]
        L = 1.0 / S[:, 0, 0] - 1.0
        value = residual(L)
        side = np.where(np.signbit(value) == np.signbit(at_high), 1.0, -1.0)
        # If an end is kept twice in a row, its value is halved.
        share = np.where(side == before, 0.5, 1.0)
        low = np.where(side > 0.0, low, middle)
        high = np.where(side > 0.0, middle, high)
        at_low = np.where(side > 0.0, share * at_low, value)
        at_high = np.where(side > 0.0, value, share * at_high)
        before = side
    return middle, L


def _log_gain(L: ComplexArray) -> FloatArray:
    with np.errstate(divide="ignore"):
        return np.maximum(np.log(np.abs(L)), -700.0)  # L = 0 if no feedback acts


def _phase_margins(
    form: SchurForm, w: FloatArray, L: ComplexArray, period: float
) -> tuple[FloatArray, FloatArray]:
    """Find the smallest abs(angle(-L_i)) at abs(L_i) = 1, and its frequency, each (N, m)."""
    gains = _log_gain(L)
    places = _crossings(gains)
    frequency, crossing = _refined(form, w, places, gains, period, _log_gain)
    phase = np.full(gains[:, 0].shape, np.inf)
    crossover = np.zeros(gains[:, 0].shape)
    angle = np.abs(np.angle(-crossing))
    for k in np.argsort(-angle, kind="stable"):
        phase[places[0][k], places[2][k]] = angle[k]
        crossover[places[0][k], places[2][k]] = frequency[k]
    return phase, crossover


def _gain_margins(
    form: SchurForm, w: FloatArray, L: ComplexArray, period: float
) -> tuple[FloatArray, FloatArray]:
    """Find the gain factors next to 1, below and above, that make L_i = -1, each (N, m).

    L_i is also real at w = 0 and at pi / T, so both ends of the grid are tried as well.
    """
    imaginary = np.imag(L) / (1.0 + np.abs(L))
    imaginary[:, -1] = 0.0  # L is real at pi / T, except for rounding
    places = _crossings(imaginary)
    inside = places[1] < L.shape[1] - 2  # the last point is treated separately
    places = (places[0][inside], places[1][inside], places[2][inside])
    _, crossing = _refined(
        form, w, places, imaginary, period, lambda L: np.imag(L) / (1.0 + np.abs(L))
    )
    ends = np.concatenate(
        [np.where(np.abs(np.angle(-L[:, :1])) < PHASE_AT_ZERO, L[:, :1].real, 0.0), L[:, -1:].real],
        axis=1,
    )
    decrease = np.zeros(L[:, 0].shape)
    increase = np.full(L[:, 0].shape, np.inf)
    for row, channel, value in zip(places[0], places[2], crossing.real, strict=True):
        _narrow(decrease, increase, (row, channel), value)
    for row, end, channel in np.ndindex(ends.shape):
        _narrow(decrease, increase, (row, channel), ends[row, end, channel])
    return decrease, increase


def _narrow(decrease: FloatArray, increase: FloatArray, place: tuple[int, int], L: float) -> None:
    """Lower the gain margin of an input in place, given a value of L at which L is real.

    If L is negative, the loop passes through -1 at the gain factor 1 / abs(L). `place` is the index
    of the aircraft and of the input.
    """
    if L < 0.0:
        factor = -1.0 / L
        if factor > 1.0:
            increase[place] = min(increase[place], factor)
        else:
            decrease[place] = max(decrease[place], factor)


# Norms under diagonal scaling


def _balanced(matrices: ComplexArray) -> ComplexArray:
    """Return D M D^-1 with a diagonal D that makes the norms of row i and column i similar.

    The matrices have the shape (..., m, m). The method is Osborne's iteration.
    """
    M = matrices.copy()
    off_diagonal = ~np.eye(matrices.shape[-1], dtype=bool)
    least = 1e-9 * np.linalg.norm(M, axis=(-2, -1)) + 1e-300
    for _ in range(BALANCED_ROUNDS if len(off_diagonal) > 1 else 0):
        for i, places in enumerate(off_diagonal):
            row, column = (
                np.sqrt(np.sum(part.real**2 + part.imag**2, axis=-1))
                for part in (M[..., i, places], M[..., places, i])
            )
            factor = np.sqrt((row + least) / (column + least))[..., None]
            M[..., i, :] /= factor
            M[..., :, i] *= factor
    return M


def norm_bound(matrices: ComplexArray) -> FloatArray:
    """Compute the bound sqrt(norm(M, 1) norm(M, inf)) of norm(M, 2), over the last two axes."""
    sizes = np.abs(matrices)
    return np.asarray(np.sqrt(sizes.sum(axis=-1).max(axis=-1) * sizes.sum(axis=-2).max(axis=-1)))


def scaled_norm(matrices: ComplexArray) -> FloatArray:
    """Compute min_D norm(D M D^-1, 2) over diagonal D > 0, for each of P matrices M.

    `matrices` has the shape (P, m, m), and the result (P,). The result bounds the structured
    singular value. Osborne's iteration comes first, then a descent along d log norm / d log D_i =
    abs(u_i)^2 - abs(v_i)^2 with the singular vectors u and v. Any D gives an upper bound, so ending
    early is conservative. Source: A. Packard, J. Doyle, Automatica 29(1), 1993.
    """
    M = _balanced(matrices)
    best = np.full(len(M), np.inf)
    for step in range(DESCENT_STEPS):
        u, values, v = np.linalg.svd(M)
        best = np.minimum(best, values[:, 0])
        change = np.exp(-(np.abs(u[:, :, 0]) ** 2 - np.abs(v[:, 0]) ** 2) / (1.0 + step / 8.0))
        M = change[:, :, None] * M / change[:, None]
    return best


def _largest_norm(balanced: ComplexArray) -> FloatArray:
    """Return the largest `scaled_norm` over the second axis of (N, F, m, m), shape (N,).

    `norm_bound` first bounds the norm of every matrix. The largest bound of each aircraft is then
    replaced by the scaled norm of its matrix. This is repeated until the largest value of each
    aircraft is a scaled norm.
    """
    bounds = norm_bound(balanced)
    rows = np.arange(len(balanced))
    # D does not change the diagonal entries, so the largest diagonal entry is a lower bound.
    least = np.abs(np.einsum("NFii->NFi", balanced)).max(axis=(1, 2))
    near = bounds > least[:, None]
    bounds[near] = np.linalg.norm(balanced[near], ord=2, axis=(1, 2))
    refined = np.zeros(bounds.shape, dtype=bool)
    for _ in range(MAX_REFINED):
        peak = np.argmax(bounds, axis=1)
        todo = rows[~refined[rows, peak] & (bounds[rows, peak] > least)]
        if not len(todo):
            break
        bounds[todo, peak[todo]] = np.minimum(
            bounds[todo, peak[todo]], scaled_norm(balanced[todo, peak[todo]])
        )
        refined[todo, peak[todo]] = True
    return np.asarray(np.maximum(bounds.max(axis=1), least))
