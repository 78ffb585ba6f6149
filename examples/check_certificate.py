#!/usr/bin/env python3
# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Check a certificate of `rise-di gains --guarantee --certificate FILE` with numpy alone.

    python check_certificate.py certificate.json [rise_di_parameters.h]

Aircraft x_dot = (A + E diag(d) F) x + (B + E diag(d) G) u_a, y = C x, abs(d_i) <= size; actuators
lag u_a_dot = u - u_a; u is held for a period and acts after `delay`; law xi+ = A xi + B y, u = C xi
+ D y. Over a period, s in [0, 1], w(s) = diag(d) z(s) with z = F x + G u_a. The channels are the
first TERMS Legendre coefficients of w and z. Of v, the rest of w, the norm is bounded:

    zeta+ = A zeta + W w + V v,    z = Z zeta + D w + V_z v,    rest of z = S (zeta, w) + K v

Theorem. Let d = 0 have no mode at abs(z) >= RADIUS, and no d of the box one at abs(z) = RADIUS.
Then no d of the box has one outside: modes are continuous in d. A box c + half delta, abs(delta)
<= 1, has none at z if there are real t and g with

    lambda_max(N* N + j (g N - N* g)) < 1,    N = exp(t) half M_c(z) exp(-t)

(M. Fan, A. Tits, J. Doyle, IEEE TAC 36(1), 1991). M_c is the transfer function from w to z around
c. A part r of z beside N w, norm(r) <= a norm(w), adds at most 2 norm((N - j g)* r) + a^2 to
the matrix. Along the frequency its largest eigenvalue is convex in what is linear; norms bound
what is left. Each step of the file halves a box, or proves it from `low` to `high`, rad/s.
"""

import hashlib
import json
import sys
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.polynomial.legendre import Legendre, leggauss
from numpy.typing import NDArray

Array = NDArray[Any]
RADIUS = 1.0 + 1e-6  # a mode may grow by a millionth a tick: integrators have a mode at 1
ROUNDING = 1e-6  # left of the bound 1 for sums of 100 products whose sizes are up to 1e6
EPS = np.finfo(float).eps
TERMS = 4
BASIS = [Legendre.basis(i, [0, 1]) * (2 * i + 1) ** 0.5 for i in range(TERMS)]
# exact to degree 23: for exponentials over a period, beyond rounding
GAUSS, WEIGHTS = leggauss(12)
FASTEST = 5.0  # of a rate times the period: up to there the nodes err by less than 1e-14
NARROWEST = 1e-6  # part of a frequency: an interval below it counts as not proved
MOST = 20_000  # intervals of a step
NEAR = 1.25  # from a frequency to another for which the same t balances
COVERED = """\
covered: deviations constant in time, in the linear loop with this period, delay and lags;
    no mode grows by more than 1e-6 a tick
not covered: limits and rates of the inputs, errors beyond the width of the softened sign,
    other lags and delays, a late or missed tick, a schedule, deviations that change in time"""


class Loop(NamedTuple):
    """[[A, W, V], [Z, D, V_z], [S, 0]]: states, channels, and the rest at the nodes of Gauss."""

    big: Array
    K: Array  # squares of its norm from entry to entry
    states: int
    period: float


def exponential(M: Array) -> Array:
    """Exp of a matrix: the series of M / 2^k, whose norm is below 1/4, then k squares."""
    k = max(0, int(np.ceil(np.log2(max(np.abs(M).sum(axis=1).max(), 1e-300)))) + 2)
    term = total = np.eye(len(M))
    for i in range(1, 19):
        term = term @ M / (2.0**k * i)
        total = total + term
    return np.linalg.matrix_power(total, 2**k)


def loop_of(file: dict[str, Any]) -> Loop:
    """The motion over a period from the numbers of a certificate."""
    A, B, C, E, F, G, lag = (np.array(file[key], float) for key in [*"ABCEFG", "lag"])
    law = {key: np.array(value, float) for key, value in file["law"].items()}
    T, (n, m), k = file["period"], B.shape, E.shape[1]
    size, has_lag = n + m, lag > 0.0
    rate = np.diag(1.0 / np.where(has_lag, lag, 1.0))
    drive = np.vstack([B * ~has_lag, rate * has_lag])
    E, F, G = np.vstack([E, np.zeros((m, k))]), np.hstack([F, G * has_lag]), G * ~has_lag
    chain = np.kron(np.eye(TERMS + 1, k=1), np.eye(size))
    chain[:size, :size] = T * np.block([[A, B * has_lag], [np.zeros((m, n)), -rate]])

    def over(s: float) -> list[Array]:
        """X(s) = exp(motion T s), then the integrals of X(s - r) r^j / j! over r from 0 to s."""
        return np.split(exponential(chain * s)[:size], TERMS + 1, axis=1)

    # The states are aircraft and actuators, u of earlier ticks, the newest first, and the law.
    ticks = int(np.floor(file["delay"] / T + 1e-9))
    split = max(file["delay"] / T - ticks, 0.0)
    kept, own = (ticks + 1) * m, len(law["A"])
    states, channels = size + kept + own, TERMS * k
    u_now = np.hstack([law["D"] @ C, np.zeros((m, m + kept)), law["C"]])
    inputs = np.vstack([u_now, np.eye(states)[size : size + kept]])
    new, old = inputs[ticks * m :][:m], inputs[(ticks + 1) * m :][:m]
    X, first = over(split), np.eye(size, states)
    second = X[0] @ first + T * X[1] @ drive @ old
    nodes = np.r_[split * (GAUSS + 1) / 2, split + (1 - split) * (GAUSS + 1) / 2]
    weights = np.r_[split * WEIGHTS, (1 - split) * WEIGHTS] / 2
    reads, ends = [], []
    for s in nodes:  # z at s by (zeta, w), and (x, z) at the end by an impulse of w at s
        Y = over(s)
        X, x, u = (over(s - split), second, new) if s >= split else (Y, first, old)
        drives = [sum(p.deriv(j)(0.0) * Y[j + 1] for j in range(TERMS)) for p in BASIS]
        free = F @ (X[0] @ x + T * X[1] @ drive @ u) + G @ u
        reads.append(np.hstack([free, *(T * F @ integral @ E for integral in drives)]))
        Y = over(1.0 - s)
        to_z = [sum((-1) ** j * p.deriv(j)(1.0) * Y[j + 1] for j in range(TERMS)) for p in BASIS]
        ends.append(T * np.vstack([Y[0] @ E, *(F @ integral @ E for integral in to_z)]))
    values, root = np.array([p(nodes) for p in BASIS]), np.sqrt(weights)[:, None, None]
    ZD, WV = (np.einsum("is,s,sab->iab", values, weights, f) for f in (reads, ends))
    S = (root * (reads - np.einsum("is,iab->sab", values, ZD))).reshape(-1, states + channels)
    V = np.hstack(list(root * (ends - np.einsum("is,iab->sab", values, WV))))
    kernel = np.array([T * F @ over((1.0 + s) / 2.0)[0] @ E for s in GAUSS])
    K = np.einsum("s,skc->kc", WEIGHTS * (1.0 - GAUSS) / 4.0, kernel**2)
    X = over(1.0 - split)
    motion = X[0] @ second + T * X[1] @ drive @ new
    law_motion = np.hstack([law["B"] @ C, np.zeros((own, m + kept)), law["A"]])
    A = np.vstack([motion, inputs[:kept], law_motion])
    below = np.zeros((kept + own, channels + V.shape[1]))
    WV = np.vstack([np.hstack([*WV[:, :size], V[:size]]), below])
    none = np.zeros((len(S), V.shape[1]))
    big = np.block([[A, WV], [np.vstack(list(ZD)), V[size:]], [S, none]])
    return Loop(big, K, states, T)


def parts_of(loop: Loop) -> list[tuple[tuple[int, ...], Loop]]:
    """The strongly connected parts and their entries: the modes of the loop are those of these."""
    n, k = loop.states, len(loop.K)
    total = n + k
    # of each row and column: the state, or the number of states + the entry
    node = np.r_[0:n, np.tile(np.arange(n, total), (len(loop.big) - n) // k)]
    reach = np.eye(total)
    np.add.at(reach, (node[:, None], node[None]), np.abs(loop.big) > 0.0)
    reach[n:, n:] += loop.K
    for _ in range(int(np.ceil(np.log2(total)))):
        reach = (reach @ reach > 0.0).astype(float)
    parts = []
    for member in np.unique(reach * reach.T > 0.0, axis=0):
        rows, entries = np.flatnonzero(member[node]), np.flatnonzero(member[n:])
        big, K = loop.big[np.ix_(rows, rows)], loop.K[np.ix_(entries, entries)]
        part = Loop(big, K, int(member[:n].sum()), loop.period)
        parts.append((tuple(entries.tolist()), part))
    return parts


def is_stable(A: Array) -> bool:
    """Whether every eigenvalue has abs(z) < RADIUS: P > 0 with P - A' P A / RADIUS^2 > 0."""
    P, power = np.eye(len(A)), A / RADIUS
    for _ in range(40):
        with np.errstate(over="ignore", invalid="ignore"):
            P, power = P + power.T @ P @ power, power @ power
    if not np.isfinite(P).all():
        return False
    left = P - A.T @ P @ A / RADIUS**2
    least = (np.min(np.linalg.eigvalsh(matrix), initial=1.0) for matrix in (P, left + left.T))
    return bool(min(least) > 0.5)


def norm(X: Array) -> float:
    """The Frobenius norm, at least the largest singular value."""
    return float(np.linalg.norm(X))


def adjoint(X: Array) -> Array:
    """X*."""
    return np.asarray(X.conj().T)


def closed(big: Array, w: slice, c: Array) -> Array:
    """The system from w - c z in place of w, z = big[w] (x, w, v)."""
    z = np.linalg.solve(np.eye(len(c)) - big[w, w] * c, big[w])
    return np.asarray(big + big[:, w] @ (c[:, None] * z))


class System(NamedTuple):
    """A part around the middle of a box, scaled: x+ = A x + W w + V v, y = Z x + D w, rest S x."""

    A: Array
    W: Array
    V: Array
    Z: Array
    D: Array
    S: Array
    S_w: Array  # products of what x and w add to the rest
    g: Array
    y_by_v: list[float]  # norms of what acts within a period, by coefficient
    gy_by_v: float
    rest_by_w: float
    rest_by_v: float


def system_of(
    part: Loop, middle: Array, half: Array, step: dict[str, Any], frequency: float
) -> System:
    """The system of a step. t of the coefficients without one balances those before it."""
    n, k, known = part.states, len(part.K), len(step["t"])
    p = TERMS * k
    w, rest, c = slice(n, n + p), slice(n + p, None), np.tile(middle, TERMS)
    around = closed(part.big[: n + p], w, c)
    (A, W, V), (Z, D, y) = (np.split(side, [n, n + p], axis=1) for side in (around[:n], around[w]))
    wide = np.tile(half, TERMS)[:, None]
    R = np.linalg.inv(RADIUS * np.exp(1j * frequency * part.period) * np.eye(n) - A)
    sizes = np.abs(wide * (Z @ R @ W + D)) ** 2 + 1e-30
    t, g = (np.r_[step[key], np.zeros(p - known)] for key in "tg")
    for i in range(known, p, k):
        to = np.exp(2.0 * t[:i]) @ sizes[:i, i : i + k]
        t[i : i + k] = np.log(to / (sizes[i : i + k, :i] @ np.exp(-2.0 * t[:i]))) / 4.0
    # v of an entry is scaled as its last coefficient, and is at most `most` times the rest of z.
    scale, most, last = np.exp(t), np.abs(middle) + half, np.exp(t[-k:])
    nodes = (len(part.big) - n - p) // k
    S = np.tile(most * last, nodes)[:, None] * part.big[rest, : n + p]
    through = S[:, w] * c
    S = S + through @ around[w, : n + p]
    V, y = V / np.tile(last, nodes), y / np.tile(last, nodes)
    rest_by_v = norm(np.sqrt(part.K) * np.outer(most * last, 1.0 / last)) + norm(through) * norm(y)
    scaled = wide * scale[:, None]
    W, Z, D, y = W / scale, scaled * Z, scaled * D / scale, scaled * y
    # states of which what comes in is as large as what goes out make the norms small
    into, out = ((np.abs(X) ** 2).sum(axis=a) + 1e-30 for X, a in ((R @ W, 1), (Z @ R, 0)))
    f = (out / into) ** 0.25
    by_x, by_w = S[:, :n] / f, S[:, w] / scale
    return System(
        A=f[:, None] * A / f,
        W=f[:, None] * W,
        V=np.array(np.linalg.qr((f[:, None] * V).T, "r")).T,
        Z=Z / f,
        D=D,
        S=np.array(np.linalg.qr(by_x, "r")),
        S_w=by_x.T @ by_w,
        g=g,
        y_by_v=[norm(rows) for rows in np.split(y, TERMS)],
        gy_by_v=norm(g[:, None] * y),
        rest_by_w=norm(by_w),
        rest_by_v=rest_by_v,
    )


def is_positive(X: Array) -> bool:
    """Whether every eigenvalue is positive."""
    try:
        np.linalg.cholesky(X)
    except np.linalg.LinAlgError:
        return False
    return True


def is_proved(system: System, period: float, w: float, x: float) -> bool:
    """Whether the box has no mode at any frequency from w - x to w + x."""
    A, W, V, Z, D, S, S_w, g, y_by_v, gy_by_v, rest_by_w, rest_by_v = system
    n, p = W.shape
    z, delta = RADIUS * np.exp(1j * w * period), RADIUS * x * period
    pencil = z * np.eye(n) - A
    R = np.linalg.inv(pencil)
    # The resolvent up to z + delta is R (I + Y - slip)^-1, Y = delta R. Slip is what R as computed
    # leaves, with rounding entry by entry. (I + Y)^-1 = (I - Y) (I + Y^2) (I - Y^4)^-1.
    slip = np.abs(np.eye(n) - pencil @ R) + n * EPS * np.abs(pencil) @ np.abs(R)
    error, Y_2 = norm(slip), delta**2 * R @ R
    room = max(1.0 - norm(Y_2 @ Y_2), 0.0)
    inverse = (1.0 + delta * norm(R)) * (1.0 + norm(Y_2))
    if not 10.0 * error * inverse < room:
        return False
    inverse = inverse / (room - 3.0 * error * inverse)
    left, right = Z @ R, R @ W
    wrong = slip @ np.array(np.linalg.qr(np.abs(W).T, "r")).T
    wrong_right = error * norm(right) + norm(np.abs(R) @ wrong)
    bend = delta * inverse * (wrong_right + delta * (norm(R @ right) + norm(R) * wrong_right))

    def moved(side: Array) -> tuple[float, float]:
        """The norm of what is linear in the frequency of `side W`, and of what is left."""
        linear = delta * norm(side @ right)
        wrong_side = norm(np.abs(side) @ wrong) + 2.0 * error**2 * norm(side) * norm(W)
        return linear, x * period / 2.0 * linear + norm(side) * bend + wrong_side

    # The rest: v is at most `rest`, and adds `added` to y.
    x_by_v = inverse * (norm(R @ V) + 2.0 * inverse * error * norm(R) * norm(V))
    loop_gain = rest_by_v + norm(S) * x_by_v
    if not loop_gain < 0.9:
        return False
    square = norm(S @ right) ** 2 + 2.0 * float((S_w * right.real).sum()) + rest_by_w**2
    rest = (square**0.5 + sum(moved(S @ R))) / (1.0 - loop_gain)
    y_by_x = norm(left @ V) + norm(left) * (delta * x_by_v + 2.0 * error * norm(V))
    N = D + Z @ right
    added = (norm(np.array(y_by_v)) + y_by_x) * rest
    N_y = sum(norm(rows) * y for rows, y in zip(np.split(N, TERMS), y_by_v, strict=True))
    H_added = (N_y + gy_by_v + (norm(N) + np.abs(g).max()) * y_by_x) * rest
    gram, skew = adjoint(N) @ N, 1j * g[:, None] * N
    H_left = adjoint(N) @ left + 1j * g[:, None] * left
    change = -1j * period * z * (H_left @ right)
    change = x * (change + adjoint(change))
    lost = ROUNDING + 2.0 * (H_added + moved(H_left)[1]) + (sum(moved(left)) + added) ** 2
    room = (1.0 - lost) * np.eye(p) - gram - skew - adjoint(skew)
    return is_positive(room - change) and is_positive(room + change)


def prove(part: Loop, steps: list[dict[str, Any]], size: float) -> int:
    """Replay the steps from the whole box, 0 to pi / T; the number of bounds. Raises ValueError."""
    k, count = len(part.K), 0
    boxes = [(np.zeros(k), np.full(k, size), 0.0, np.pi / part.period)]
    for number, step in enumerate(steps):
        middle, half, low, high = boxes.pop()
        if "halve" in step:
            side = np.where(np.arange(k) == step["halve"], half / 2.0, 0.0)
            boxes += [(middle + turn * side, half - side, low, high) for turn in (-1.0, 1.0)]
            continue
        todo, most, balanced = [(step["low"], step["high"])], count + MOST, np.inf
        while todo:
            begin, end = todo.pop()
            w, x = (begin + end) / 2.0, 0.5000001 * (end - begin)
            if not balanced / NEAR < w < NEAR * balanced:
                system, balanced = system_of(part, middle, half, step, w), w
            count += 1
            if not is_proved(system, part.period, w, x):
                if x < NARROWEST * w or count > most:
                    raise ValueError(f"step {number}: not proved at {w:.6g} rad/s")
                todo += [(begin, w), (w, end)]
        boxes += [(middle, half, low, step["low"])] if step["low"] > low else []
        boxes += [(middle, half, step["high"], high)] if step["high"] < high else []
    if boxes:
        raise ValueError(f"{len(boxes)} boxes are not proved")
    return count


def require_range(file: dict[str, Any], loop: Loop) -> None:
    """Raise ValueError for numbers to which the text above does not apply."""
    given = file["period"] > 0.0 and file["size"] > 0.0
    given = given and all(value >= 0.0 for value in (file["delay"], *file["lag"]))
    if not given or not np.isfinite(loop.big).all():
        raise ValueError(
            "found a negative or no number, expected period, size > 0, delay, lag >= 0"
        )
    lags = [lag for lag in file["lag"] if lag > 0.0]
    rates = [*np.abs(np.linalg.eigvals(np.array(file["A"]))), *(1.0 / lag for lag in lags)]
    if max(rates) * file["period"] > FASTEST:
        raise ValueError(
            f"found a motion of {max(rates):.3g} rad/s, too fast for the nodes of Gauss"
        )


def digest_of(file: dict[str, Any]) -> str:
    """SHA-256 of the loop in 10 digits, for a box whose largest part is 1."""
    size, law = np.max(file["part"]), [file["law"][key] for key in "ABCD"]
    loop = [*(file[key] for key in "ABC"), *law, *(file[key] for key in ("lag", "delay", "period"))]
    box = [np.array(file["part"]) / size, file["E"], *(np.array(file[key]) / size for key in "FG")]
    values = np.concatenate([np.ravel(array) for array in loop + box]) + 0.0
    return hashlib.sha256(" ".join(f"{value:.9e}" for value in values).encode()).hexdigest()


def check(file: dict[str, Any]) -> int:
    """The number of bounds that prove a certificate. Raises ValueError for one that does not."""
    if digest_of(file) != file["loop"]:
        raise ValueError("the loop is not the one that its name says")
    steps = {tuple(part["entries"]): part["steps"] for part in file["parts"]}
    loop, count = loop_of(file), 0
    require_range(file, loop)
    for entries, part in parts_of(loop):
        if not is_stable(part.big[: part.states, : part.states]):
            raise ValueError("the aircraft of the file, d = 0, is not stable")
        if entries and (
            part.big[part.states :, part.states :].any() or part.states or part.K.any()
        ):
            if entries not in steps:
                raise ValueError(f"no proof for {[file['names'][i] for i in entries]}")
            count += prove(part, steps[entries], file["size"])
    return count


def deviations(file: dict[str, Any]) -> list[str]:
    """What may deviate by how much, from the numbers: a part of one entry, or of a row of B."""
    texts = []
    for name, column, *changes in zip(
        file["names"], np.transpose(file["E"]), file["F"], file["G"], strict=True
    ):
        for letter, change in zip("AB", changes, strict=True):
            for i in np.flatnonzero(column) if np.any(change) else ():
                sizes = file["size"] * np.abs(column[i] * np.array(change))
                (j, *others), values = np.flatnonzero(change), np.abs(file[letter][i])
                if others or values[j] == 0.0:
                    texts.append(f"{name} (row {i} of {letter}) {np.round(sizes, 6).tolist()}")
                else:
                    percent = np.floor(1e3 * sizes[j] / values[j] + 1e-6) / 10.0
                    texts.append(f"{name} ({letter} {i}, {j}) {percent:g} %")
    return texts


def main() -> None:
    """Check a certificate, and the constants of an exported controller beside it."""
    if len(sys.argv) < 2:
        print(
            "expected: check_certificate.py certificate.json [rise_di_parameters.h]",
            file=sys.stderr,
        )
        sys.exit(2)
    try:
        file = json.loads(Path(sys.argv[1]).read_text())
        text = json.dumps({key: file[key] for key in file if key != "digest"}, sort_keys=True)
        if hashlib.sha256(text.encode()).hexdigest() != file["digest"]:
            raise ValueError("the digest is not that of the content")
        for header in sys.argv[2:]:
            if hashlib.sha256(Path(header).read_bytes()).hexdigest() != file["constants"]:
                raise ValueError(f"{header} holds other constants")
        count = check(file)
    except (ValueError, KeyError, TypeError, IndexError, OSError, np.linalg.LinAlgError) as error:
        sys.exit(f"REFUSED: {error}")
    print(
        f"PROVED by {count} bounds: stable for each deviation within", *deviations(file), sep="\n  "
    )
    print(f"certificate {file['loop'][:12]}")
    print(f"period {file['period']:g} s, delay {file['delay']:g} s, lags {file['lag']} s")
    print(COVERED)


if __name__ == "__main__":
    main()
