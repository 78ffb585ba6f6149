# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""The sampled loop of every aircraft of a box, with the uncertain entries of A and B pulled out.

    A + E diag(d) F,  B + E diag(d) G,  abs(d_i) <= 1
    zeta+ = A zeta + W w + U v,  z = Z zeta + D w + V v,  u = K zeta,  w = d z

z holds the first TERMS Legendre coefficients of F x + G u over a period, w those of the deviation.
The motion is exact in d but for the coefficients left out, an error of the order of (period
rate)^4. Source of the lifted loop: T. Chen, B. Francis, "Optimal Sampled-Data Control Systems",
chapter 10.

u may be late by an unknown time of 0 to `late`, s, another one at each tick and in each input; the
newest u that has arrived acts. The input of a period changes by

    w_0 + w_1 ROOT (2 s - 1),  w_0 = -sum_j a_j v_j,  w_1 = sum_j ROOT b_j v_j

with v_j = u_k-j - u_k-j-1. A shift by j + f periods, 0 <= f < 1, is a_i = 1 for i < j, a_j = f,
b_j = f (1 - f), 0 beyond. Each coefficient is a real d around the middle of its range, which may
change from tick to tick: the D of these channels is one for all frequencies, their G is 0.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from flight_core.vectors import FloatArray
from rise_di_controller.law.linear_loop import (
    ROOT,
    LinearLaw,
    LinearPlant,
    LoopTiming,
    SampledPlant,
    sampled_plant,
    zero_order_hold,
)

ComplexArray = NDArray[np.complex128]
IntArray = NDArray[np.intp]

TERMS = 2  # Legendre coefficients of a signal within a period
# singular value below which a direction of normalised vectors counts as none
NO_DIRECTION = 1e-9
# part of the sizes of row and column below which an entry of M counts as 0
NO_COUPLING = 1e-13
PATTERN_PARTS = (1e-3, 1e-2, 0.06, 0.25)  # of pi / T: where the pattern of M is taken


class Box(NamedTuple):
    """The k uncertain entries of a plant, d_i in [-1, 1].

    d_i changes A by E_i d_i F_i, and B by E_i d_i G_i.
    """

    names: tuple[str, ...]
    part: FloatArray  # (k,) relative deviation of the entry at d_i = 1
    E: FloatArray  # (n, k)
    F: FloatArray  # (k, n)
    G: FloatArray  # (k, m)


def plants_at(plant: LinearPlant, box: Box, d: FloatArray) -> LinearPlant:
    """The plants of some deviations d, (..., k)."""
    effect = box.E * d[..., None, :]
    return LinearPlant(plant.A + effect @ box.F, plant.B + effect @ box.G, plant.C)


class Late(NamedTuple):
    """l channels of a delay: W_l w, Z_l zeta + V_l v.

    The channels of w_0 come first, j by j with m inputs.
    """

    W: FloatArray  # (q, l)
    D: FloatArray  # (p, l) to the channels of the entries
    Z: FloatArray  # (l, q)
    V: FloatArray  # (l, m)


class UncertainLoop(NamedTuple):
    """The loop with the channels of k entries pulled out, TERMS k columns of W, and of m inputs."""

    A: FloatArray  # (q, q)
    W: FloatArray  # (q, p)
    Z: FloatArray  # (p, q)
    D: FloatArray  # (p, p)
    U: FloatArray  # (q, m)
    V: FloatArray  # (p, m)
    K: FloatArray  # (m, q)
    period: float  # s
    late: Late | None = None  # the channels of an unknown delay; None without one


def uncertain_loop(
    plant: LinearPlant, law: LinearLaw, loop: LoopTiming, box: Box, late: float = 0.0
) -> UncertainLoop:
    """The loop of a plant, A (n, n), with the entries of a box pulled out.

    u is late by an unknown time of 0 to `late`, s.
    """
    n, m = plant.B.shape
    k = len(box.names)
    size = n + TERMS * k
    # The aircraft with two integrals of each z = F x + G u behind its states: the means over a
    # period.
    A = np.zeros((size, size))
    A[:n, :n] = plant.A
    A[n : n + k, :n] = box.F / loop.period
    A[n + k :, n : n + k] = np.eye(k) / loop.period
    B = np.vstack([plant.B, box.G / loop.period, np.zeros((k, m))])
    C = np.hstack([plant.C, np.zeros((len(plant.C), TERMS * k))])
    still = np.zeros(m)
    pulled = LinearPlant(A, B, C)
    by_tick = sampled_plant(pulled, loop, still)

    # The motion over a period by w, constant or rising, as the zero-order hold of a chain.
    steps = np.zeros((size + k, size + k))  # the states, then s from 0 to 1 over the period
    steps[:size, :size] = A
    steps[:n, size:] = box.E
    drive = np.zeros((size + k, 2 * k))
    drive[:n, :k] = box.E
    drive[size:, k:] = np.eye(k) / loop.period
    _, motion = zero_order_hold(steps, drive, loop.period)
    constant = motion[:size, :k]
    rising = motion[:size, k:]
    drives = np.hstack([constant, ROOT * (2.0 * rising - constant)])

    # The integrals are read at the end of a period, and are no states of the loop.
    rows = np.r_[0:n, size : len(by_tick.A)]
    P = by_tick.A[np.ix_(rows, rows)]
    Pu = by_tick.B[rows]
    Q = _coefficients(by_tick.A, n, k)[:, rows]
    Qu = _coefficients(by_tick.B, n, k)
    C = by_tick.C[:, rows]
    states = len(law.A)
    none = np.zeros((states, TERMS * k))
    W = np.zeros((len(rows), TERMS * k))
    W[:n] = drives[:n]
    # The law closes the loop.
    exact = UncertainLoop(
        A=np.block([[P + Pu @ law.D @ C, Pu @ law.C], [law.B @ C, law.A]]),
        W=np.vstack([W, none]),
        Z=np.hstack([Q + Qu @ law.D @ C, Qu @ law.C]),
        D=_coefficients(drives, n, k),
        U=np.vstack([Pu, np.zeros((states, m))]),
        V=Qu,
        K=np.hstack([law.D @ C, law.C]),
        period=loop.period,
    )
    # A delay is channels more.
    if late == 0.0:
        return exact
    ramps = sampled_plant(pulled, loop, still, rising=True)
    return _with_late(exact, late, ramps, n, k)


def _coefficients(matrix: FloatArray, n: int, k: int) -> FloatArray:
    """The Legendre coefficients of k channels.

    They come from the integrals of z behind n states, and the integrals of these.
    """
    once = matrix[n : n + k]
    twice = matrix[n + k : n + 2 * k]
    return np.concatenate([once, ROOT * (once - 2.0 * twice)])


def _with_late(
    exact: UncertainLoop, late: float, ramps: SampledPlant, n: int, k: int
) -> UncertainLoop:
    """A loop, n states of the aircraft and k entries, with the channels of a delay.

    The middle of the ranges is the delay of the loop. The channels come from the motion by w_1. The
    states of w_1 of earlier ticks, c of them, and u of earlier ticks follow its own.
    """
    m, q = exact.K.shape
    size = n + TERMS * k
    rows = np.r_[0:n, size : len(ramps.A)]
    effect = ramps.A[: size + m, size + m :]
    c = effect.shape[1]
    ticks = int(np.ceil(late / exact.period - 1e-9))
    parts = np.minimum(late / exact.period - np.arange(ticks), 1.0)
    width = ticks * m  # u of earlier ticks, the newest first
    # The states after the loop's own: u of earlier ticks, which a late u needs.
    now = np.hstack([exact.K, np.zeros((m, c + width))])
    before = np.eye(width, q + c + width, q + c)
    shifted = np.vstack([now, before[:-m]])
    # The channels of a delay read the step of u from a tick to the next, by their half ranges.
    halves = np.minimum(parts, 0.5)
    sizes = np.repeat([parts / 2.0, ROOT / 2.0 * halves * (1.0 - halves)], m, axis=1)
    Z = np.vstack([size[:, None] * (shifted - before) for size in sizes])
    V = np.zeros((2 * width, m))
    V[:m] = np.diag(sizes[0, :m])
    V[width : width + m] = np.diag(sizes[1, :m])
    # A channel acts as a constant u, or as a ramp over the period.
    held = np.vstack([exact.U, np.zeros((c + width, m))])
    ramp = np.zeros((q + c + width, m))
    ramp[np.r_[0 : n + m, q : q + c]] = ramps.B[rows]
    W = np.hstack([-held] * ticks + [ramp] * ticks)
    D = np.hstack([-exact.V] * ticks + [_coefficients(ramps.B, n, k)] * ticks)
    # The loop with the states more, its delay in the middle of the ranges.
    A = np.zeros((q + c + width, q + c + width))
    A[:q, :q] = exact.A
    A[: n + m, q : q + c] = effect[rows[: n + m]]
    A[q : q + c, q : q + c] = ramps.A[size + m :, size + m :]
    A[q + c :] = shifted
    U = held + W @ V
    U[q + c : q + c + m] += np.eye(m)
    reach = np.hstack([exact.Z, _coefficients(effect, n, k), np.zeros((len(exact.Z), width))])
    return exact._replace(
        A=A + W @ Z,
        W=np.vstack([exact.W, np.zeros((c + width, exact.W.shape[1]))]),
        Z=reach + D @ Z,
        U=U,
        V=exact.V + D @ V,
        K=now,
        late=Late(W, D, Z, V),
    )


class Channels(NamedTuple):
    """A part of a loop as zeta+ = A zeta + W w, z = Z zeta + D w; the k real channels first."""

    A: FloatArray
    W: FloatArray
    Z: FloatArray
    D: FloatArray
    entries: tuple[int, ...]  # places of the entries in the box
    period: float
    late: int = 0  # channels of a delay, behind the real ones of the entries; then disks

    @property
    def uncertain(self) -> int:
        """Number of the real channels, TERMS an entry."""
        return TERMS * len(self.entries)

    @property
    def parameters(self) -> IntArray:
        """The number of the entry of each of their channels."""
        return np.tile(np.arange(len(self.entries)), TERMS)

    def response(self, w: FloatArray | float, radius: float) -> ComplexArray:
        """M(z) at abs(z) = radius and the frequencies w, (F,) or (), rad/s: (F, p, p)."""
        z = radius * np.exp(1j * np.asarray(w) * self.period)
        motion = z[..., None, None] * np.eye(len(self.A)) - self.A
        return np.asarray(self.Z @ np.linalg.solve(motion, self.W.astype(complex)) + self.D)

    def closed(self, d: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """State matrices of the loops of deviations d, (N, k) of this part.

        The second and third are the matrices left and right of a change of d.
        """
        wide = np.tile(d, TERMS)
        p = self.uncertain
        inverse = np.linalg.inv(np.eye(p) - self.D[:p, :p] * wide[:, None, :])
        right = inverse @ self.Z[:p]
        left = self.W[:, :p] @ np.linalg.inv(np.eye(p) - wide[:, :, None] * self.D[:p, :p])
        return self.A + (self.W[:, :p] * wide[:, None, :]) @ right, left, right

    def centred(self, c: FloatArray) -> "Channels":
        """The channels around w = diag(c) z, (p,), in place of w = 0."""
        inverse = np.linalg.inv(np.eye(len(c)) - self.D * c)
        Z = inverse @ self.Z
        return self._replace(
            A=self.A + (self.W * c) @ Z,
            W=self.W @ np.linalg.inv(np.eye(len(c)) - c[:, None] * self.D),
            Z=Z,
            D=inverse @ self.D,
        )


def every_channel(loop: UncertainLoop, inputs: tuple[int, ...] = ()) -> Channels:
    """All entries of the box as channels, and disks in some inputs.

    A disk adds v to u and reads u + v / 2: S - I / 2 from v.
    """
    channels = list(inputs)
    q, p = loop.W.shape
    m = len(loop.K)
    c = len(channels)
    late = loop.late or Late(np.zeros((q, 0)), np.zeros((p, 0)), np.zeros((0, q)), np.zeros((0, m)))
    width = late.W.shape[1]
    D = np.zeros((p + width + c, p + width + c))
    D[:p, :p] = loop.D
    D[:p, p : p + width] = late.D
    D[:p, p + width :] = loop.V[:, channels]
    D[p : p + width, p + width :] = late.V[:, channels]
    D[p + width :, p + width :] = np.eye(c) / 2.0
    return Channels(
        A=loop.A,
        W=np.hstack([loop.W, late.W, loop.U[:, channels]]),
        Z=np.vstack([loop.Z, late.Z, loop.K[channels]]),
        D=D,
        entries=tuple(range(p // TERMS)),
        period=loop.period,
        late=width,
    )


def sensitivity_slopes(
    loop: UncertainLoop, d: FloatArray, w: FloatArray
) -> tuple[ComplexArray, ComplexArray]:
    """S, (F, m, m), of the aircraft of deviations d, (k,), and its slopes along d, (F, k, m, m).

    They are taken at frequencies w, rad/s.
    """
    A, left, right = every_channel(loop).closed(d[None])
    wide = np.tile(d, TERMS)
    through = np.linalg.solve(np.eye(len(wide)) - loop.D * wide, loop.V)
    U = loop.U + (loop.W * wide) @ through
    z = np.exp(1j * w * loop.period)
    k, m = len(d), U.shape[1]
    motion = z[:, None, None] * np.eye(len(U)) - A[0]
    X = np.linalg.solve(motion, np.hstack([left[0], U]).astype(complex))
    into = loop.K @ X[:, :, :-m]  # (F, m, TERMS k)
    out = right[0] @ X[:, :, -m:] + through  # (F, TERMS k, m)
    each = np.einsum("Fic,Fcj->Fcij", into, out)
    S = np.eye(m) + loop.K @ X[:, :, -m:]
    return np.asarray(S), np.asarray(each.reshape(len(w), TERMS, k, m, m).sum(axis=1))


def parts_of(loop: UncertainLoop, inputs: tuple[int, ...] = ()) -> list[Channels]:
    """The strongly connected parts of the loop, reduced.

    With disks in some inputs only parts with such inputs count. The structured singular value of a
    block triangular matrix is the largest of the blocks.
    """
    from scipy.sparse import csr_array  # noqa: PLC0415 - a flight starts without it
    from scipy.sparse.csgraph import connected_components  # noqa: PLC0415

    every = every_channel(loop, inputs)
    k = len(every.entries)
    m = len(loop.K)
    c = len(inputs)
    # The pattern of the couplings at some frequencies, an entry or a delay a node.
    late = np.tile(k + np.arange(m), every.late // m)
    at = np.pi / loop.period * np.array(PATTERN_PARTS)
    sizes = np.abs(every.response(at, 1.0 + 1e-6)).max(axis=0)
    wide = sizes > NO_COUPLING * np.sqrt(np.outer(sizes.max(axis=1), sizes.max(axis=0)) + 1e-300)
    node = np.r_[np.tile(np.arange(k), TERMS), late, k + m + np.arange(c)]
    pattern = np.zeros((k + m + c, k + m + c), dtype=bool)
    np.logical_or.at(pattern, (node[:, None], node[None]), wide)
    count, label = connected_components(csr_array(pattern), directed=True, connection="strong")
    # A part without a loop of its own bounds nothing.
    parts = []
    for number in range(count):
        nodes = np.flatnonzero(label == number)
        looped = len(nodes) > 1 or pattern[nodes[0], nodes[0]]
        if looped and (not inputs or nodes[-1] >= k + m):
            channels = np.flatnonzero(np.isin(node, nodes))
            entries = tuple(nodes[nodes < k].tolist())
            count_late = int(np.isin(late, nodes).sum())
            parts.append(_reduced(every, channels)._replace(entries=entries, late=count_late))
    return parts


def _reduced(every: Channels, channels: IntArray) -> Channels:
    """Some channels without the states that no w of these moves or no z of these shows.

    Such states are kept constants, integrals, and the rest of the loop.
    """
    A = every.A
    W = every.W[:, channels]
    Z = every.Z[channels]
    coupled = np.abs(A) > NO_COUPLING
    is_moved = (np.abs(W) > NO_COUPLING).any(axis=1)
    is_shown = (np.abs(Z) > NO_COUPLING).any(axis=0)
    for _ in range(len(A)):
        is_moved |= coupled[:, is_moved].any(axis=1)
        is_shown |= coupled[is_shown].any(axis=0)
    both = is_moved & is_shown
    A = A[np.ix_(both, both)]
    W = W[both]
    Z = Z[:, both]
    for _ in range(2):
        Q = _reached(A, W)
        W_turned = (Q.T @ W).T
        A = (Q.T @ A @ Q).T
        W = (Z @ Q).T
        Z = W_turned
    return every._replace(A=A, W=W, Z=Z, D=every.D[np.ix_(channels, channels)])


def _reached(A: FloatArray, W: FloatArray) -> FloatArray:
    """An orthonormal basis of the states that W reaches through A."""
    Q = np.zeros((len(A), 0))
    directions = W / np.maximum(np.linalg.norm(W, axis=0), 1e-300)
    while directions.shape[1]:
        for _ in range(2):  # twice: rounding
            directions = directions - Q @ (Q.T @ directions)
        left, values, _ = np.linalg.svd(directions, full_matrices=False)
        directions = left[:, values > NO_DIRECTION]
        Q = np.hstack([Q, directions])
        directions = A @ directions
    return Q
