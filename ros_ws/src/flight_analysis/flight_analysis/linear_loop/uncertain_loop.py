# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""The sampled loop of all aircraft of a box, with the uncertain entries of A and B pulled out.

    A + E diag(d) F,  B + E diag(d) G,  abs(d_i) <= 1
    zeta+ = A zeta + W w + U v,  z = Z zeta + D w + V v,  u = K zeta,  w = d z

z holds the first TERMS Legendre coefficients of F x + G u over a period, and w the coefficients of
the deviation d (F x + G u). The motion is exact in d except for the coefficients that are left out.
Their error is of the order of (T p)^4, for a period T and an eigenvalue p. Source of the lifted
loop: T. Chen, B. Francis, "Optimal Sampled-Data Control Systems", chapter 10.

u can be late by an unknown time from 0 to `late`, s, which differs from tick to tick and from input
to input. At each instant the newest u that has arrived acts. With s = 0 at the beginning of the
period of a u, the input then changes by

    -sum_j (1 + e_j(s)) / 2 v_j,  v_j = u_(k-j) - u_(k-j-1)

over the first p_j of the period, p_j = min(late / T - j, 1). e_j is 1 until u_(k-j) arrives, and -1
from then on. The middle, e_j = 0, belongs to the loop. e_j v_j is a function over p_j. The root
mean square of e_j v_j is abs(v_j) whatever e_j is, so all its Legendre coefficients together form a
full block of size 1 that reads v_j. The block can change from tick to tick, so it has one X for all
frequencies, and G = 0.
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
)

ComplexArray = NDArray[np.complex128]
IntArray = NDArray[np.intp]

TERMS = 2  # Legendre coefficients of a signal within a period
# An entry of M counts as 0 below this fraction of the geometric mean of its row's and its column's
# largest entries.
NO_COUPLING = 1e-13
# frequencies at which the pattern of M is sampled, as fractions of pi / T
PATTERN_PARTS = (1e-3, 1e-2, 0.06, 0.25)


class Box(NamedTuple):
    """The box of an uncertain plant: its k uncertain entries, each with a deviation d_i in [-1, 1].

    d_i changes A by E_i d_i F_i, and B by E_i d_i G_i. An entry is named A[STATE,STATE] or
    B[STATE,EFFECTOR]. T maps the m inputs of the law to the p effectors.
    """

    names: tuple[str, ...]
    # relative deviation of each entry at d_i = 1, (k,); a part of its row if it is 0 in the file
    part: FloatArray
    E: FloatArray  # (n, k)
    F: FloatArray  # (k, n)
    G: FloatArray  # (k, m)
    effectors: tuple[str, ...]
    T: FloatArray  # (p, m)
    zeros: tuple[str, ...] = ()  # names of the entries that are 0 in the file

    @property
    def largest(self) -> float:
        """Largest relative deviation of an entry in the box.

        Entries that are 0 in the airframe file have no relative deviation. If only such entries
        deviate, the result is a fraction of their `row_sizes`.
        """
        is_zero = np.isin(self.names, self.zeros)
        return float(np.max(self.part[~is_zero], initial=0.0)) or float(self.part.max())

    @property
    def largest_zero(self) -> float:
        """Largest deviation of entries that are 0 in the airframe file.

        It is a fraction of their `row_sizes`.
        """
        return float(np.max(self.part[np.isin(self.names, self.zeros)], initial=0.0))


def plants_at(plant: LinearPlant, box: Box, d: FloatArray) -> LinearPlant:
    """Return the plants at the deviations d, which has the shape (..., k)."""
    effect = box.E * d[..., None, :]
    return LinearPlant(plant.A + effect @ box.F, plant.B + effect @ box.G, plant.C)


class Channels(NamedTuple):
    """A loop, or a part of one, with open channels: zeta+ = A zeta + W w, z = Z zeta + D w.

    A channel i leads from w_i to z_i, and a deviation closes it by w_i = delta_i z_i. The real
    channels of the entries come first, TERMS for each entry. The channels of a late u follow, and
    then disks in inputs. A disk adds v to u and reads u + v / 2, so that the transfer function from
    v to its reading is S - I / 2.
    """

    A: FloatArray
    W: FloatArray
    Z: FloatArray
    D: FloatArray
    entries: tuple[int, ...]  # indices of the entries in the box
    period: float  # s
    # Places of the channels of a delay among the channels of the whole loop: the means of e_j v_j,
    # then their second coefficients, which read nothing because a block has one row. Both groups
    # are ordered by j, with the m inputs for each j.
    late: tuple[int, ...] = ()

    @property
    def uncertain(self) -> int:
        """Number of the real channels: TERMS for each entry."""
        return TERMS * len(self.entries)

    @property
    def parameters(self) -> IntArray:
        """Index in `entries` of the entry to which each of the real channels belongs."""
        return np.tile(np.arange(len(self.entries)), TERMS)

    @property
    def disks(self) -> slice:
        """Indices of the channels that belong to disks."""
        return slice(self.uncertain + len(self.late), None)

    def some(self, channels: IntArray) -> "Channels":
        """Return the same loop with only some of its channels."""
        D = self.D[np.ix_(channels, channels)]
        return self._replace(W=self.W[:, channels], Z=self.Z[channels], D=D)

    def response(self, w: FloatArray | float, radius: float) -> ComplexArray:
        """Compute M(z), the transfer matrix from w to z, on the circle abs(z) = radius.

        The argument `w` has the frequencies, rad/s, in the shape (F,) or (). M has (F, p, p) or (p,
        p).
        """
        z = radius * np.exp(1j * np.asarray(w) * self.period)
        motion = z[..., None, None] * np.eye(len(self.A)) - self.A
        return np.asarray(self.Z @ np.linalg.solve(motion, self.W.astype(complex)) + self.D)

    def at(self, d: FloatArray) -> "Channels":
        """Return the channels centred on the aircraft with deviations d.

        In the result, w = 0 means this aircraft. d has the shape (..., k), for the k entries of
        this part of the loop.
        """
        c = np.zeros((*d.shape[:-1], len(self.D)))
        c[..., : self.uncertain] = np.tile(d, TERMS)
        return self.centred(c)

    def centred(self, c: FloatArray) -> "Channels":
        """Return the channels of the loop closed by w = diag(c) z.

        In the result, w = 0 means this closed loop. c has the shape (..., p), and its leading axes
        are a batch.
        """
        columns = c[..., None, :]
        inverse = np.linalg.inv(np.eye(len(self.D)) - self.D * columns)
        Z = inverse @ self.Z
        return self._replace(
            A=self.A + (self.W * columns) @ Z,
            W=self.W @ np.linalg.inv(np.eye(len(self.D)) - c[..., None] * self.D),
            Z=Z,
            D=inverse @ self.D,
        )


def uncertain_loop(
    plant: LinearPlant, law: LinearLaw, loop: LoopTiming, box: Box, late: float = 0.0
) -> Channels:
    """Build the loop of a plant, and pull out the entries of the box and a disk in each input.

    The plant has A (n, n). u is late by an unknown time from 0 to `late`, s.
    """
    n, m = plant.B.shape
    k = len(box.names)
    size = n + TERMS * k
    # Append to the states of the aircraft the integral of each z = F x + G u, and the integral of
    # this integral. They give the Legendre coefficients over a period.
    A = np.zeros((size, size))
    A[:n, :n] = plant.A
    A[n : n + k, :n] = box.F / loop.period
    A[n + k :, n : n + k] = np.eye(k) / loop.period
    B = np.vstack([plant.B, box.G / loop.period, np.zeros((k, m))])
    C = np.hstack([plant.C, np.zeros((len(plant.C), TERMS * k))])
    still = np.zeros(m)
    pulled = LinearPlant(A, B, C)
    by_tick = sampled_plant(pulled, loop, still)

    # w causes a motion over a period. It is constant or rising, and no actuator delays it.
    moved = LinearPlant(A, np.vstack([box.E, np.zeros((TERMS * k, k))]), C)
    direct = LoopTiming(np.zeros(k), 0.0, loop.period)
    by_w = [sampled_plant(moved, direct, np.zeros(k), rising=rising) for rising in (False, True)]
    drives = np.hstack([sampled.B[:size] for sampled in by_w])

    # The integrals are read at the end of a period, so they are no states of the loop.
    rows = np.r_[0:n, size : len(by_tick.A)]
    P = by_tick.A[np.ix_(rows, rows)]
    Pu = by_tick.B[rows]
    Q = _coefficients(by_tick.A, n, k)[:, rows]
    Qu = _coefficients(by_tick.B, n, k)
    C = by_tick.C[:, rows]
    W = np.zeros((len(rows) + len(law.A), TERMS * k + m))
    W[:n, : TERMS * k] = drives[:n]
    W[: len(rows), TERMS * k :] = Pu
    # Close the loop by the law.
    u = np.hstack([law.D @ C, law.C])
    exact = Channels(
        A=np.block([[P + Pu @ law.D @ C, Pu @ law.C], [law.B @ C, law.A]]),
        W=W,
        Z=np.vstack([np.hstack([Q + Qu @ law.D @ C, Qu @ law.C]), u]),
        D=_blocks(_coefficients(drives, n, k), Qu),
        entries=tuple(range(k)),
        period=loop.period,
    )
    # If u can be late, further channels are added.
    if late == 0.0:
        return exact
    ramps = sampled_plant(pulled, loop, still, rising=True)
    return _with_late(exact, late, ramps, n, k)


def _coefficients(matrix: FloatArray, n: int, k: int) -> FloatArray:
    """Return the rows that map the state to the Legendre coefficients of the k signals z.

    The coefficients follow from the integrals of z over a period, and from the integrals of these
    integrals. In `matrix`, the rows of the n states come first, and then the rows of the integrals.
    """
    once = matrix[n : n + k]
    twice = matrix[n + k : n + 2 * k]
    return np.concatenate([once, ROOT * (once - 2.0 * twice)])


def _blocks(D: FloatArray, V: FloatArray) -> FloatArray:
    """Append a disk in each input to D. V is the effect of the disks on the channels of D."""
    m = V.shape[1]
    return np.block([[D, V], [np.zeros((m, len(D))), np.eye(m) / 2.0]])


def _with_late(exact: Channels, late: float, ramps: SampledPlant, n: int, k: int) -> Channels:
    """Add the channels of a late u to a loop with n states of the aircraft and k entries.

    The loop with w = 0 becomes the loop with e_j = 0. `ramps` describes the motion caused by an
    input that rises linearly over the period. The loop gets further states: first the c states that
    the rising inputs of earlier ticks need, and then u of earlier ticks.
    """
    E, U, K = exact.W[:, : exact.uncertain], exact.W[:, exact.disks], exact.Z[exact.disks]
    m, q = K.shape
    size = n + TERMS * k
    rows = np.r_[0:n, size : len(ramps.A)]
    effect = ramps.A[: size + m, size + m :]
    c = effect.shape[1]
    ticks = int(np.ceil(late / exact.period - 1e-9))
    parts = np.minimum(late / exact.period - np.arange(ticks), 1.0)
    width = ticks * m  # u of earlier ticks, the newest first
    # Append u of earlier ticks, which a late u needs, to the loop's own states.
    now = np.hstack([K, np.zeros((m, c + width))])
    before = np.eye(width, q + c + width, q + c)
    shifted = np.vstack([now, before[:-m]])
    # The channels of a delay read the change of u from tick to tick.
    Z = np.vstack([shifted - before, np.zeros((width, q + c + width))])
    V = np.eye(2 * width, m)
    # Coefficients over p_j act as a constant u and as a ramp over the whole period.
    held = np.vstack([U, np.zeros((c + width, m))])
    ramp = np.zeros((q + c + width, m))
    ramp[np.r_[0 : n + m, q : q + c]] = ramps.B[rows]
    to_z = exact.D[: exact.uncertain]

    def over_parts(held: FloatArray, ramp: FloatArray) -> FloatArray:
        means = [ROOT * p * (1.0 - p) / 2.0 * ramp - p / 2.0 * held for p in parts]
        return np.hstack([*means, *(-p * p / 2.0 * ramp for p in parts)])

    W = over_parts(held, ramp)
    D = over_parts(to_z[:, exact.disks], _coefficients(ramps.B, n, k))
    # Build the loop with the additional states and with e_j = 0: the mean of 1 + e_j is 1.
    A = np.zeros((q + c + width, q + c + width))
    A[:q, :q] = exact.A
    A[: n + m, q : q + c] = effect[rows[: n + m]]
    A[q : q + c, q : q + c] = ramps.A[size + m :, size + m :]
    A[q + c :] = shifted
    U = held + W @ V
    U[q + c : q + c + m] += np.eye(m)
    reach = [exact.Z[:-m], _coefficients(effect, n, k), np.zeros((exact.uncertain, width))]
    none = np.zeros((2 * width, exact.uncertain + 2 * width))
    through = np.vstack([np.hstack([to_z[:, : exact.uncertain], D]), none])
    return exact._replace(
        A=A + W @ Z,
        W=np.hstack([np.vstack([E, np.zeros((c + width, E.shape[1]))]), W, U]),
        Z=np.vstack([np.hstack(reach) + D @ Z, Z, now]),
        D=_blocks(through, np.vstack([to_z[:, exact.disks] + D @ V, V])),
        late=tuple(range(2 * width)),
    )


def sensitivity_slopes(
    loop: Channels, d: FloatArray, w: FloatArray
) -> tuple[ComplexArray, ComplexArray]:
    """Compute S and its slopes along d at the frequencies w, rad/s.

    S and the slopes refer to the aircraft with the deviations d, (k,). w has the shape (F,), S has
    (F, m, m), and the slopes have (F, k, m, m). The loop must have disks in all inputs, and no late
    u.
    """
    around = loop.at(d)
    p, k = loop.uncertain, len(d)
    z = np.exp(1j * w * loop.period)
    motion = z[:, None, None] * np.eye(len(around.A)) - around.A
    X = np.linalg.solve(motion, around.W.astype(complex))
    into = around.Z[p:] @ X[:, :, :p]  # (F, m, p)
    out = around.Z[:p] @ X[:, :, p:] + around.D[:p, p:]  # (F, p, m)
    m = out.shape[-1]
    each = np.einsum("Fic,Fcj->Fcij", into, out)
    S = np.eye(m) + around.Z[p:] @ X[:, :, p:]
    return np.asarray(S), np.asarray(each.reshape(len(w), TERMS, k, m, m).sum(axis=1))


def parts_of(loop: Channels, inputs: tuple[int, ...] = ()) -> list[Channels]:
    """Split the loop into its strongly connected parts, and reduce each part.

    If `inputs` are given, the loop keeps the disks in these inputs, and only parts with a disk are
    returned. It is enough to bound the parts, because the structured singular value of a block
    triangular matrix is the largest one of its blocks.
    """
    from scipy.sparse import csr_array  # noqa: PLC0415 - a flight starts without it
    from scipy.sparse.csgraph import connected_components  # noqa: PLC0415

    p = loop.disks.start
    every = loop.some(np.r_[0:p, p + np.array(inputs, dtype=int)])
    k = len(every.entries)
    m = len(loop.D) - p
    c = len(inputs)
    # Find which nodes are coupled at some frequencies. A node is an entry, a late input or a disk.
    late = np.tile(k + np.arange(m), len(every.late) // m)
    at = np.pi / loop.period * np.array(PATTERN_PARTS)
    sizes = np.abs(every.response(at, 1.0 + 1e-6)).max(axis=0)
    wide = sizes > NO_COUPLING * np.sqrt(np.outer(sizes.max(axis=1), sizes.max(axis=0)) + 1e-300)
    node = np.r_[np.tile(np.arange(k), TERMS), late, k + m + np.arange(c)]
    pattern = np.zeros((k + m + c, k + m + c), dtype=bool)
    np.logical_or.at(pattern, (node[:, None], node[None]), wide)
    count, label = connected_components(csr_array(pattern), directed=True, connection="strong")
    # A node that is coupled to no other and not to itself forms no loop, so it is left out.
    parts = []
    for number in range(count):
        nodes = np.flatnonzero(label == number)
        looped = len(nodes) > 1 or pattern[nodes[0], nodes[0]]
        if looped and (not inputs or nodes[-1] >= k + m):
            channels = np.flatnonzero(np.isin(node, nodes))
            entries = tuple(nodes[nodes < k].tolist())
            places = tuple(np.flatnonzero(np.isin(late, nodes)).tolist())
            parts.append(_reduced(every, channels)._replace(entries=entries, late=places))
    return parts


def _reduced(every: Channels, channels: IntArray) -> Channels:
    """Keep some channels, and the states that lie between the w and the z of these channels.

    The other states, which are constants, integrals and states of other parts of the loop, are left
    out.
    """
    part = every.some(channels)
    coupled = np.abs(part.A) > NO_COUPLING
    is_moved = (np.abs(part.W) > NO_COUPLING).any(axis=1)
    is_shown = (np.abs(part.Z) > NO_COUPLING).any(axis=0)
    for _ in range(len(coupled)):
        is_moved |= coupled[:, is_moved].any(axis=1)
        is_shown |= coupled[is_shown].any(axis=0)
    both = is_moved & is_shown
    return part._replace(A=part.A[np.ix_(both, both)], W=part.W[both], Z=part.Z[:, both])
