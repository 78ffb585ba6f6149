# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Bound the structured singular value of a loop from above, over intervals of frequency.

mu(M) is the reciprocal of the size of the least Delta = diag(delta_i) for which det(I - M Delta) =
0, with delta_i real or complex. For any real t and G = diag(g), with g_i = 0 at complex channels,

    mu(M)^2 <= lambda_max(N* N + j (G N - N* G)),    N = exp(t) M exp(-t)

With X = exp(2 t), this inequality is M* X M + j (X G M - M* X G) <= mu^2 X. Every X and G gives a
valid bound, so a search that ends early only makes the bound larger. Source: M. K. H. Fan, A. L.
Tits, J. C. Doyle, IEEE Transactions on Automatic Control 36(1), 1991.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from flight_analysis.linear_loop.uncertain_loop import Channels, ComplexArray, IntArray
from flight_core.vectors import FloatArray
from rise_di_controller.law.linear_loop import SPECTRAL_RADIUS_TOLERANCE

RADIUS = 1.0 + SPECTRAL_RADIUS_TOLERANCE  # abs(z) at the limit of stability

BALANCE_ROUNDS = 6  # rounds of Osborne's iteration
LARGEST_G = 1e3  # limit of abs(g_i)
LEVELS = 40  # largest number of levels in the search for X and G
CENTRING = 6  # largest number of Newton steps at each level
LENGTHS = tuple(0.6**k for k in range(20))  # lengths of Newton's step that are tried
CENTRED = 0.5  # if the decrement of a Newton step is less than this, the point counts as the centre
FALL = 0.3  # fraction of the distance from the bound to the level that remains after a round
STALLED = 1e-3  # the search ends if the level exceeds the bound by less than this fraction of it

# Width of the narrowest interval, as a fraction of pi / T. It is less than the interval that
# LARGEST_G allows around a frequency at which M is real.
NARROWEST = 1e-8
# rad; if a frequency times T is less, the second Legendre coefficients change the bound by less
# than 0.1 %
MEANS_UP_TO = 0.3
TINY = 1e-30
# An eigenvalue of the pencil counts as on the circle if abs(log abs(z)) is less than this. If the
# crossing is spurious, it only makes the interval shorter.
ON_CIRCLE = 1e-7
# The bound is checked again at this many points of an interval, and of each of its decades, because
# rounding hides a crossing beside an integrator, where the pencil has multiple eigenvalues.
CHECKED = 8
DECADES = 6


class Scaling(NamedTuple):
    """The scalings of the bound: t = log(X) / 2 and g, the diagonal of G, each of shape (p,)."""

    t: FloatArray
    g: FloatArray


def balancing_t(M: ComplexArray, share: FloatArray | None = None) -> FloatArray:
    """Find t = log(X) / 2 such that the row and the column of each factor of X are about equal.

    t has the shape (p,). `share` maps the f factors of X to the p channels, (p, f). Without
    `share`, each channel has a factor of its own. The method is Osborne's iteration.
    """
    share = np.eye(len(M)) if share is None else share
    t = np.zeros(share.shape[1])
    sizes = share.T @ np.abs(M) ** 2 @ share
    np.fill_diagonal(sizes, 0.0)
    least = 1e-18 * sizes.sum() + 1e-300
    for _ in range(BALANCE_ROUNDS):
        for i in range(len(t)):
            factor = np.sqrt((sizes[i].sum() + least) / (sizes[:, i].sum() + least))
            sizes[i] /= factor
            sizes[:, i] *= factor
            t[i] -= 0.5 * np.log(factor)
    return np.asarray(share @ t)


def bound_at(M: ComplexArray, scaling: Scaling) -> FloatArray:
    """Evaluate the bound of matrices (..., p, p) for given X and G."""
    return np.asarray(np.sqrt(np.maximum(np.linalg.eigvalsh(_form(M, scaling))[..., -1], 0.0)))


def is_below_one(M: ComplexArray, scaling: Scaling) -> NDArray[np.bool_]:
    """Return a mask of the matrices (N, p, p) whose bound is below 1.

    The bound is below 1 if I minus the matrix of `_form` is positive definite. Cholesky's
    factorisation of all these differences shows this in a fraction of the time that eigenvalues
    take. Eigenvalues are only computed if a difference has no such factorisation.
    """
    H = _form(M, scaling)
    try:
        if np.isfinite(np.linalg.cholesky(np.eye(M.shape[-1]) - H)).all():
            return np.ones(len(M), dtype=np.bool_)
    except np.linalg.LinAlgError:
        pass
    return np.asarray(np.linalg.eigvalsh(H)[..., -1] < 1.0)


def _form(M: ComplexArray, scaling: Scaling) -> ComplexArray:
    """Compute N* N + j (G N - N* G), the form whose largest eigenvalue is the bound squared."""
    N = np.exp(scaling.t)[:, None] * M * np.exp(-scaling.t)
    skew = 1j * scaling.g[:, None] * N
    adjoint = np.conj(np.swapaxes(N, -1, -2))
    return np.asarray(adjoint @ N + skew + np.conj(np.swapaxes(skew, -1, -2)))


def least_bound(
    M: ComplexArray,
    real_count: int,
    target: float,
    factors: IntArray | None = None,
    near: Scaling | None = None,
) -> tuple[float, Scaling]:
    """Search for the X and G with the least bound of M, (p, p), and return the bound, X and G.

    The first `real_count` channels are real. Channels that have the same number in `factors`, (p,),
    share one factor of X. `near` has the X and G of a similar matrix. The search begins at `near`
    if the bound there is smaller than at the balanced X, and at the balanced X if not.

    If the bound gets below `target`, the search ends with X and G in the middle of the set that
    reaches the target. The method of centres on the linear matrix inequality

        F = level X - N* X N - j (G N - N* G) > 0,  trace X = p,  X > 0,  abs(g_i) < LARGEST_G

    minimises -log det F - log det X - sum log(LARGEST_G^2 - g^2) by Newton's method while the level
    falls. Source: S. Boyd, L. El Ghaoui, Linear Algebra and its Applications 188, 1993.
    """
    number = np.arange(len(M)) if factors is None else np.unique(factors, return_inverse=True)[1]
    share = np.eye(int(number.max()) + 1)[number]
    t = balancing_t(M, share)
    g = np.zeros(len(M))
    if near is not None and bound_at(M, near) <= bound_at(M, Scaling(t, g)):
        t, g = near.t, np.clip(near.g, -LARGEST_G / 2.0, LARGEST_G / 2.0)
    N = np.exp(t)[:, None] * M * np.exp(-t)
    centre = Centre(np.ones(len(M)), g[:real_count], share)
    goal = target**2
    least = centre.bound(N)
    level = max(1.1 * least, goal)
    for _ in range(LEVELS):
        is_low_enough = level <= goal
        for _ in range(CENTRING):
            centre, decrement = centre.newton_step(N, level)
            if decrement < CENTRED:
                break
        least = min(centre.bound(N), level)
        if is_low_enough or level - least < STALLED * least:
            break
        level = max(least + FALL * (level - least), goal)
    g = np.r_[centre.g / centre.X[:real_count], np.zeros(len(M) - real_count)]
    return float(np.sqrt(max(least, 0.0))), Scaling(t + 0.5 * np.log(centre.X), g)


def least_bound_at(
    part: Channels, w: float, scaled: ComplexArray, near: Scaling | None
) -> tuple[float, Scaling]:
    """Bound a scaled M(w) of a part of the loop, and return the bound with its X and G.

    The search is the same as in `least_bound`, with the target 1. M(w) is scaled to the sizes of
    its channels. `near` has the X and G of a similar matrix.

    To save time, the search first has only the channels of the means over a period. The channels of
    the second Legendre coefficients get the X that balances their rows and columns. If the bound
    with this X and G is below 1, or if w is low, this bound is the result. If not, a second search
    has all channels.
    """
    k = len(part.entries)
    rows = np.r_[0:k, part.uncertain : len(scaled)]
    few = None if near is None else Scaling(near.t[rows], near.g[rows])
    # all channels of a delay share a factor: `levels_of` has scaled them
    factors = np.arange(len(scaled))
    factors[part.uncertain : part.disks.start] = part.uncertain
    _, means = least_bound(scaled[np.ix_(rows, rows)], k, 1.0, factors[rows], few)
    second = slice(k, part.uncertain)
    sizes = np.abs(scaled) ** 2 + TINY
    row = sizes[second, rows] @ np.exp(-2.0 * means.t)
    column = np.exp(2.0 * means.t) @ sizes[rows, second]
    scaling = Scaling(np.zeros(len(scaled)), np.zeros(len(scaled)))
    scaling.t[rows] = means.t
    scaling.g[rows] = means.g
    scaling.t[second] = np.log(column / row) / 4.0
    bound = float(bound_at(scaled, scaling))
    if bound < 1.0 or w * part.period < MEANS_UP_TO:
        return bound, scaling
    return least_bound(scaled, part.uncertain, 1.0, factors, near)


class Centre(NamedTuple):
    """A pair X and G on the way to the centre of the set that meets the linear matrix inequality.

    X and G refer to the scaled matrix N = exp(t) M exp(-t) of `least_bound`. So X = 1 means the
    scalings t with which the search begins.
    """

    X: FloatArray  # diagonal, (p,)
    g: FloatArray  # entries of G at the real channels, (real_count,)
    free: FloatArray  # map from f free factors to X, (p, f); equal factors share a column

    def inequality(self, N: ComplexArray, level: float) -> ComplexArray:
        """Compute F = level X - N* X N - j (G N - N* G), the matrix of the inequality F > 0."""
        skew = 1j * np.r_[self.g, np.zeros(len(N) - len(self.g))][:, None] * N
        right = (N.conj().T * self.X) @ N + skew + skew.conj().T
        return np.asarray(level * np.diag(self.X) - right)

    def bound(self, N: ComplexArray) -> float:
        """Return the least level for which F > 0 can hold with this X and G.

        This level is the bound squared.
        """
        root = np.sqrt(self.X)
        return -float(np.linalg.eigvalsh(self.inequality(N, 0.0) / root[:, None] / root)[0])

    def newton_step(self, N: ComplexArray, level: float) -> tuple["Centre", float]:
        """Take a Newton step of X and G, and return the result and the decrement of the step.

        The decrement is 0 at the centre.
        """
        real_count = len(self.g)
        P = np.linalg.inv(self.inequality(N, level))
        R = N @ P
        Q = R @ N.conj().T
        room = LARGEST_G**2 - self.g**2
        slope = np.r_[
            np.diag(Q).real - level * np.diag(P).real - 1.0 / self.X,
            2.0 * (self.g / room - np.diag(R).imag[:real_count]),
        ]
        sizes = np.abs(R) ** 2
        XX = level**2 * np.abs(P) ** 2 - level * (sizes + sizes.T) + np.abs(Q) ** 2
        Xg = 2.0 * (level * P * R.T - R * Q.T).imag[:, :real_count]
        gg = 2.0 * (Q * P.T - R * R.T).real[:real_count, :real_count]
        XX[np.diag_indices(len(N))] += 1.0 / self.X**2
        gg[np.diag_indices(real_count)] += 2.0 * (LARGEST_G**2 + self.g**2) / room**2
        free = self.free
        curvature = np.block([[free.T @ XX @ free, free.T @ Xg], [Xg.T @ free, gg]])
        slope = np.r_[slope[: len(N)] @ free, slope[len(N) :]]
        trace = np.r_[free.sum(axis=0), np.zeros(real_count)]
        down, along = np.linalg.solve(curvature, np.stack([slope, trace], axis=1)).T
        step = (trace @ down) / (trace @ along) * along - down
        decrement = float(np.sqrt(max(-slope @ step, 0.0)))
        for length in LENGTHS:
            longer = self.after(length * step)
            if longer.is_inside(N, level):
                return longer, decrement
        return self, 0.0  # no length helps: only rounding is left

    def after(self, step: FloatArray) -> "Centre":
        """Return X and G moved by a step, whose entries are the factors of X and then G."""
        f = self.free.shape[1]
        return Centre(self.X + self.free @ step[:f], self.g + step[f:], self.free)

    def is_inside(self, N: ComplexArray, level: float) -> bool:
        """Return whether F > 0, X > 0 and abs(g_i) < LARGEST_G hold, and all numbers are finite."""
        if not (self.X.min() > 0.0 and np.abs(self.g).max(initial=0.0) < LARGEST_G):
            return False
        F = self.inequality(N, level)
        try:
            # cholesky does not raise for a matrix with a NaN
            return bool(np.isfinite(F).all() and np.isfinite(np.linalg.cholesky(F)).all())
        except np.linalg.LinAlgError:
            return False


def crossings(part: Channels, scaling: Scaling, scale: FloatArray) -> FloatArray:
    """Find the frequencies, rad/s, at which the bound of diag(scale) M(z), given X and G, can be 1.

    At a z on abs(z) = RADIUS, N* N + j (G N - N* G) has the eigenvalue 1 exactly if z is an
    eigenvalue of a pencil with twice as many states. Source: S. Boyd, V. Balakrishnan, P. Kabamba,
    Mathematics of Control, Signals, and Systems 2, 1989, for the largest singular value.
    """
    from scipy.linalg import eigvals  # noqa: PLC0415 - a flight starts without it

    s = np.exp(scaling.t)
    A = part.A / RADIUS
    W = part.W / RADIUS / s
    Z = (s * scale)[:, None] * part.Z
    D = (s * scale)[:, None] * part.D / s
    n, p = W.shape
    G = 1j * np.diag(scaling.g)
    inner = D.T @ D - D.T @ G + G @ D - np.eye(p)
    x = -np.linalg.solve(inner, D.T @ Z + G @ Z)
    y = -np.linalg.solve(inner, W.T.astype(complex))
    H = D - G
    none = np.zeros((n, n))
    F = np.block([[A + W @ x, W @ y], [none, np.eye(n)]])
    E = np.block([[np.eye(n), none], [Z.T @ (Z + H @ x), A.T + Z.T @ H @ y]])
    z = eigvals(F, E)
    z = z[np.isfinite(z) & (np.abs(z) > 0.5) & (np.abs(z) < 2.0)]
    on_circle = np.abs(np.log(np.abs(z))) < ON_CIRCLE
    return np.asarray(np.sort(np.abs(np.angle(z[on_circle])))) / part.period


def interval_at(
    part: Channels, w: float, scaling: Scaling, scale: FloatArray
) -> tuple[float, float] | None:
    """Find the interval around w, rad/s, in which X and G keep the bound of diag(scale) M below 1.

    `scaling` has X and G, which were found at w. Returns None if there is no such interval.
    """
    highest = np.pi / part.period
    ends = crossings(part, scaling, scale)
    low = float(np.max(ends[ends <= w], initial=0.0))
    high = float(np.min(ends[ends > w], initial=highest))
    from_low = np.geomspace(10.0**-DECADES, 1.0, CHECKED * DECADES, endpoint=False)
    parts = np.r_[from_low, np.linspace(0.0, 1.0, CHECKED + 2)[1:-1]]
    inside = np.unique(np.r_[w, low + (high - low) * parts])
    holds = is_below_one(scale[:, None] * part.response(inside, RADIUS), scaling)
    fails = inside[~holds]
    below = float(np.max(fails[fails <= w], initial=-1.0))
    above = float(np.min(fails[fails > w], initial=2.0 * highest))
    held = inside[(inside > below) & (inside < above)]
    low = low if below < 0.0 else float(np.min(held, initial=highest))
    high = high if above > highest else float(np.max(held, initial=0.0))
    return (low, high) if high - low > NARROWEST * highest else None
