#!/usr/bin/env python3
# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Check a certificate of `rise-di gains guarantee --certificate FILE` with numpy alone.

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

A file with the member `limit` has an input that acts as a = phi(u), and w = u - a is cut off: phi
rises by 0 to 1 times the rise of u. a and w are a channel of their own. For taps h >= 0 at ticks j
that are not 0, whose sum of h abs(z)^-abs(j) is at most 1, the sum of w (a - h * a) over all ticks
is not negative (G. Zames, P. Falb, SIAM Journal on Control 6(1), 1968). With m = 1 - sum h e^-ijwT

    diag(1, ..., 1, 0) - N_d* N_d - Y N - N* Y* > 0,  Y = diag(j g, exp(-s) m)

is then what a step proves. N_d are the rows of z in N = diag(exp(t), 1) half M_c diag(exp(-t),
exp(-s)), whose last row is a. `slowest` is the lowest frequency of the proof. From 0 it proves at
abs(z) = SETTLING < 1 that every motion settles, since the modes outside are the integrators: they
are at 1 for each d and move no u. From above 0 it proves at abs(z) = 1 that no motion is periodic.

A file with the member `late` has inputs that are late by 0 to `time`, s, each by another time at
each tick. The newest u that has arrived acts. If that of a tick begins to act at s = 0 in time, the
input is less by (1 + e_j(s)) / 2 v_j over the first p_j = min(time / T - j, 1) of a period for each
j, with v_j = u_-j - u_-j-1, and e_j is 1 or -1. The loop is that of e_j = 0. Each e_j v_j over a
segment of the period is a channel whose row is v_j, and whose columns are its values at the nodes
of Gauss: a full block of size 1. It changes in time, so it has g = 0 and the t of the file in each
step. Then the gain from all e_j v_j to all v_j, scaled by exp(t), is below 1 for each d on abs(z) =
RADIUS. By small gain no motion grows by more than RADIUS a tick, whatever e_j is.
"""

import hashlib
import json
import os
import re
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

# OpenBLAS reads it with the next import. On matrices as small as these its threads wait for each
# other: beside other work two of them take seven times as long as one.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
from numpy.polynomial.legendre import Legendre, leggauss
from numpy.typing import NDArray

Array = NDArray[Any]
RADIUS = 1.0 + 1e-6  # a mode may grow by a millionth a tick: integrators have a mode at 1
SETTLING = 1.0 - 1e-5  # with a limit, a motion that settles falls by a part of 1e-5 a tick
ROUNDING = 1e-6  # left of the bound 1 for sums of 100 products whose sizes are up to 1e6
EPS = np.finfo(float).eps
TERMS = 4
ROUNDS = 4  # of the balance of coefficients
BASIS = [Legendre.basis(i, [0, 1]) * (2 * i + 1) ** 0.5 for i in range(TERMS)]
# exact to degree 23: for exponentials over a period, beyond rounding
GAUSS, WEIGHTS = leggauss(12)
FASTEST = 5.0  # of a rate times the period: up to there the nodes err by less than 1e-14
NARROWEST = 1e-6  # part of a frequency: an interval below it counts as not proved
MOST = 50_000  # bounds of a file
NEAR = 1.25  # from a frequency to another for which the same t balances
EQUAL = 1e-9  # part up to which two numbers that say the same may differ by rounding
FLOAT32 = 1e-6  # the same for constants in single precision
COVERED = """\
covered: deviations constant in time, in the linear loop with this period, delay and lags;
    no mode grows by more than 1e-6 a tick
not covered: entries that are 0 without a line above, limits and rates of the inputs, errors beyond
    the width of the softened sign, filters of sensors, actuators of another order, limits and
    fade-in of an observer, motion beyond the linear equations, other lags and delays, a late or
    missed tick, a schedule, deviations that change in time"""

COVERED_WITH_LATE = """\
covered: deviations constant in time, in the linear loop with this period, delay and lags, in which
    the newest u that has arrived acts, however late within this time each u comes; no motion grows
    by more than 1e-6 a tick
not covered: entries that are 0 without a line above, limits and rates of the inputs, errors beyond
    the width of the softened sign, filters of sensors, actuators of another order, limits and
    fade-in of an observer, motion beyond the linear equations, other lags, later or missing u, a
    late y or tick, a schedule, deviations that change in time"""

COVERED_WITH_LIMIT = """\
covered: deviations constant in time, in the loop with this period, delay and lags that is linear
    but for this input; any lower and upper limit of it, constant in time, and any other curve that
    never falls and rises by at most 1 per 1
not covered: entries that are 0 without a line above, limits of the other inputs, rates of all
    inputs, anti-windup, errors beyond the width of the softened sign, filters of sensors, actuators
    of another order, limits and fade-in of an observer, motion beyond the equations of the file,
    other lags and delays, a late or missed tick, a schedule, deviations that change in time"""

# The file. Everything that it may hold is stated here, with the range of each number.
LONGEST = 32_000_000  # bytes
LEAST = 1e-100  # magnitude of a number that is not 0: products of three do not vanish
NAME, HEX, TEXT = "a name", "64 digits of SHA-256", "a text"
TEXTS = {NAME: r"[!-~]{1,64}", HEX: r"[0-9a-f]{64}", TEXT: r"(?s).{1,1000000}"}


class Numbers(NamedTuple):
    """Finite numbers from `low` to `high`, in lists of the sizes `shape`."""

    shape: tuple[str, ...] = ()
    low: float = -1e9
    high: float = 1e9


class Names(NamedTuple):
    """A list of different names, whose number is the size `size`."""

    size: str
    most: int


FIELDS: dict[str, Any] = {
    "airframe": HEX,
    "scenario": HEX,
    "constants": TEXT,
    "states": Names("n", 64),
    "outputs": Names("o", 32),
    "inputs": Names("m", 32),
    "effectors": Names("p", 64),
    "names": Names("k", 512),
    "zeros": Names("z", 512),
    "A": Numbers(("n", "n")),
    "B": Numbers(("n", "m")),
    "C": Numbers(("o", "n")),
    "T": Numbers(("p", "m")),
    "E": Numbers(("n", "k")),
    "F": Numbers(("k", "n")),
    "G": Numbers(("k", "m")),
    "part": Numbers(("k",), 0.0, 1.0),
    "lag": Numbers(("m",), 0.0, 100.0),
    "delay": Numbers((), 0.0, 1.0),
    "period": Numbers((), 1e-4, 1.0),
    "size": Numbers((), 1e-9, 1e6),
    "law": {
        "A": Numbers(("q", "q")),
        "B": Numbers(("q", "o")),
        "C": Numbers(("m", "q")),
        "D": Numbers(("m", "o")),
    },
    "limit": {
        "input": NAME,
        "slowest": Numbers((), 0.0, 1e5),
        "lags": Numbers(("h",), -1000.0, 1000.0),
        "taps": Numbers(("h",), 0.0, 1.0),
    },
    "late": {"time": Numbers((), 1e-6, 1.0), "t": Numbers(("l", "m"), -100.0, 100.0)},
    "loop": HEX,
    "digest": HEX,
}
OPTIONAL = {"airframe", "scenario", "constants", "limit", "late", "zeros"}
MOST_OF = {"q": 512, "h": 1000, "l": 10, "steps": 50_000, "ticks": 100}
STEP = {"low": (0.0, 1e5), "high": (0.0, 1e5), "t": (-100.0, 100.0), "g": (-1e9, 1e9)}
LIMITED_STEP = STEP | {"s": (-100.0, 100.0)}


class Limit(NamedTuple):
    """An input that is cut off, and the multiplier of its inequality."""

    place: int  # of the input
    slowest: float  # rad/s
    lags: Array  # ticks
    taps: Array

    @property
    def radius(self) -> float:
        """abs(z) of the proof."""
        return 1.0 if self.slowest else SETTLING

    def at(self, turn: float) -> complex:
        """Return m at an angle w T."""
        return complex(1.0 - self.taps @ np.exp(-1j * self.lags * turn))


class Late(NamedTuple):
    """The channels of inputs that are late."""

    inputs: Array  # of each channel
    t: Array
    rest: Array  # norm of what each of these inputs adds to the rest of each z, beside the channels


class Segment(NamedTuple):
    """A part of a period in which the u of one tick acts, if it is in time."""

    begin: float
    end: float
    tick: int  # how many ticks before
    parts: list[float]  # p_j of each j that may be late here


class Loop(NamedTuple):
    """[[A, W, V], [Z, D, V_z], [S, 0]]: states, channels, and the rest at the nodes of Gauss.

    If an input is cut off, its channel is the first one. The channels of late inputs are the last.
    """

    big: Array
    K: Array  # squares of its norm from entry to entry
    states: int
    period: float
    late: Late
    radius: float = RADIUS
    limit: Limit | None = None

    @property
    def channels(self) -> slice:
        """The rows and columns of w and z."""
        size = (self.limit is not None) + TERMS * len(self.K) + len(self.late.t)
        return slice(self.states, self.states + size)


def once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """Return the members of an object. Raises ValueError if a name stands twice."""
    members = dict(pairs)
    if len(members) != len(pairs):
        names = [name for name, _ in pairs]
        twice = sorted({name for name in names if names.count(name) > 1})
        raise ValueError(f"found {shown(twice)} twice in an object, expected each member once")
    return members


def shown(value: Any) -> str:
    """Write a value of a file in printable ASCII, cut short."""
    text = ascii(value)
    return text if len(text) <= 60 else text[:57] + "..."


def require(holds: bool, where: str, found: Any, expected: str) -> None:
    """Raise ValueError in one sentence unless a condition holds."""
    if not holds:
        raise ValueError(f"{where}: found {shown(found)}, expected {expected}")


def integer(digits: str) -> int:
    """Return a whole number. Raises ValueError if it has more digits than any number here has."""
    require(len(digits) <= 20, "a number", len(digits), "at most 20 digits")
    return int(digits)


def no_number(word: str) -> float:
    """Raise ValueError for the words NaN and Infinity, which are no JSON."""
    raise ValueError(f"found {word}, expected finite numbers")


def numbers(value: Any, where: str, kind: Numbers, sizes: dict[str, int]) -> Array:
    """Return the array of a field. A size that is not known yet becomes known.

    Raises ValueError if the array does not fit.
    """

    def flat(part: Any, shape: tuple[str, ...]) -> list[float]:
        if not shape:
            is_number = type(part) in {int, float} and kind.low <= part <= kind.high
            is_number = is_number and (part == 0 or abs(part) >= LEAST)
            require(is_number, where, part, f"a number from {kind.low:g} to {kind.high:g}")
            return [float(part)]
        require(type(part) is list, where, part, "a list")
        size = sizes.setdefault(shape[0], min(len(part), MOST_OF.get(shape[0], 0)))
        require(len(part) == size, where, len(part), f"{size} values")
        return [number for inner in part for number in flat(inner, shape[1:])]

    return np.array(flat(value, kind.shape)).reshape([sizes[size] for size in kind.shape])


def matches(value: Any, kind: str) -> bool:
    """Return whether a value is a text of a kind."""
    return type(value) is str and re.fullmatch(TEXTS[kind], value) is not None


def members(value: Any, where: str, known: Sequence[str], optional: set[str]) -> dict[str, Any]:
    """Return an object that has these members and no other. Raises ValueError."""
    require(type(value) is dict, where, value, "an object")
    unknown = sorted(set(value) - {*known})
    require(not unknown, where, unknown, f"{', '.join(known)} alone")
    require({*known} - optional <= set(value), where, [*value], f"{', '.join(known)}")
    return dict(value)


def fields_of(value: Any, where: str, known: dict[str, Any], sizes: dict[str, int]) -> Any:
    """Return the fields of an object by their kinds, with arrays for lists. Raises ValueError."""
    content = {}
    for name, kind in known.items():
        if name not in value:
            continue
        part, place = value[name], f"{where}{name}"
        if isinstance(kind, dict):
            inner = members(part, place, [*kind], set())
            content[name] = fields_of(inner, f"{place}.", kind, sizes)
        elif isinstance(kind, Numbers):
            content[name] = numbers(part, place, kind, sizes)
        elif isinstance(kind, Names):
            require(type(part) is list and 0 < len(part) <= kind.most, place, part, "some names")
            for text in part:
                require(matches(text, NAME), place, text, f"{NAME} of printable ASCII")
            require(len({*part}) == len(part), place, part, "names that differ")
            content[name], sizes[kind.size] = part, len(part)
        else:
            require(matches(part, kind), place, part, kind)
            content[name] = part
    return content


def parts_from(
    value: Any, entries: int, period: float, *, has_limit: bool
) -> dict[tuple[int, ...], list[Any]]:
    """Return the steps of each part by its entries. Raises ValueError."""
    require(type(value) is list, "parts", value, "a list")
    parts: dict[tuple[int, ...], list[Any]] = {}
    taken: set[int] = set()
    total = 0
    for number, part in enumerate(value):
        where = f"parts {number}"
        members(part, where, ["entries", "steps"], set())
        places, steps = part["entries"], part["steps"]
        known = type(places) is list and all(type(i) is int and 0 <= i < entries for i in places)
        rises = known and places == sorted({*places})
        require(rises and len(places) > 0, f"{where} entries", places, "rising numbers of entries")
        require(not taken & {*places}, f"{where} entries", places, "entries of no other part")
        taken |= {*places}
        require(type(steps) is list, f"{where} steps", steps, "a list")
        total += len(steps)
        require(total <= MOST_OF["steps"], where, total, f"up to {MOST_OF['steps']} steps")
        for i, step in enumerate(steps):
            has_s = has_limit and type(step) is dict and "s" in step
            known_members = LIMITED_STEP if has_s else STEP
            check_step(step, f"{where} step {i}", len(places), np.pi / period, known_members)
        parts[tuple(places)] = steps
    return parts


def check_step(
    step: Any, where: str, entries: int, highest: float, known: dict[str, tuple[float, float]]
) -> None:
    """Raise ValueError unless a step has the members, sizes and ranges of one of the two kinds."""
    if type(step) is dict and "halve" in step:
        members(step, where, ["halve"], set())
        place = step["halve"]
        is_entry = type(place) is int and 0 <= place < entries
        require(is_entry, f"{where} halve", place, f"a number of an entry, 0 to {entries - 1}")
        return
    members(step, where, [*known], set())
    count = len(step["t"]) if type(step["t"]) is list else 0
    sizes = {"c": count}
    for name, (low, high) in known.items():
        shape = ("c",) if name in {"t", "g"} else ()
        numbers(step[name], f"{where} {name}", Numbers(shape, low, high), sizes)
    fits = count in {entries, 2 * entries, 3 * entries, TERMS * entries}
    require(fits, f"{where} t", count, f"1 to {TERMS} times {entries} values")
    rises = step["low"] < step["high"] <= highest
    require(rises, where, [step["low"], step["high"]], "0 <= low < high <= pi / period")


def read(path: Path) -> dict[str, Any]:
    """Return the content of a certificate: only known members, each of its type, size and range.

    Raises ValueError for anything else, and OSError if the file cannot be read.
    """
    text = path.read_bytes()
    require(len(text) <= LONGEST, "the file", len(text), f"up to {LONGEST} bytes")
    try:
        content = json.loads(
            text.decode("utf-8"),
            object_pairs_hook=once,
            parse_constant=no_number,
            parse_int=integer,
        )
    except RecursionError:
        raise ValueError("found lists in lists without an end, expected a certificate") from None
    members(content, "the file", [*FIELDS, "parts"], OPTIONAL)
    sizes: dict[str, int] = {}
    file: dict[str, Any] = fields_of(content, "", FIELDS, sizes)
    ticks = float(file["delay"] / file["period"])
    require(ticks <= MOST_OF["ticks"], "delay", ticks, f"up to {MOST_OF['ticks']} periods")
    has_limit = "limit" in file
    period = float(file["period"])
    file["parts"] = parts_from(content["parts"], len(file["names"]), period, has_limit=has_limit)
    rest = json.dumps({key: content[key] for key in content if key != "digest"}, sort_keys=True)
    if hashlib.sha256(rest.encode()).hexdigest() != file["digest"]:
        raise ValueError("the digest is not that of the content")
    return file


def limit_of(file: dict[str, Any]) -> Limit | None:
    """Return the limit of a certificate, if it has one. Raises ValueError."""
    if "limit" not in file:
        return None
    name, slowest, lags, taps = (file["limit"][k] for k in ("input", "slowest", "lags", "taps"))
    require(name in file["inputs"], "limit input", name, "an input of the file")
    is_ticks = bool((lags == np.round(lags)).all() and (lags != 0.0).all())
    require(is_ticks and len({*lags}) == len(lags), "limit lags", lags.tolist(), "ticks but 0")
    limit = Limit(file["inputs"].index(name), float(slowest), lags, taps)
    total = float(np.sum(taps * limit.radius ** -np.abs(lags))) * (1.0 + 1e-12)
    require(total <= 1.0, "limit taps", total, "a sum of at most 1")
    highest = np.pi / float(file["period"])
    require(limit.slowest < highest, "limit slowest", limit.slowest, f"below {highest:g}")
    return limit


def exponential(M: Array) -> Array:
    """Return exp of a matrix: the series of M / 2^k, whose norm is below 1/4, squared k times."""
    k = max(0, int(np.ceil(np.log2(max(np.abs(M).sum(axis=1).max(), 1e-300)))) + 2)
    term = total = np.eye(len(M))
    for i in range(1, 19):
        term = term @ M / (2.0**k * i)
        total = total + term
    return np.linalg.matrix_power(total, 2**k)


def parts_late(file: dict[str, Any]) -> list[float]:
    """Return p_j of a certificate: in how much of a period u of j ticks before may still act.

    Raises ValueError.
    """
    if "late" not in file:
        return []
    require("limit" not in file, "late", "a limit", "none beside it")
    periods = float(file["late"]["time"] / file["period"])
    count, rows = int(np.ceil(periods - 1e-9)), len(file["late"]["t"])
    require(rows == count, "late t", rows, f"a row for each of {count} periods")
    return [min(periods - j, 1.0) for j in range(count)]


def segments_of(split: float, ticks: int, parts: list[float]) -> list[Segment]:
    """Return the segments of a period at whose `split` the u of `ticks` before begins to act."""
    ends = [split + p - turn for p in parts for turn in (0.0, 1.0)]
    cuts = np.unique(np.round(np.clip([0.0, split, 1.0, *ends], 0.0, 1.0), 12))
    segments = []
    for begin, end in zip(cuts[:-1].tolist(), cuts[1:].tolist(), strict=True):
        middle = (begin + end) / 2.0
        late = [p for p in parts if p > (middle - split) % 1.0]
        segments.append(Segment(begin, end, ticks + int(middle < split), late))
    return segments


class Motion(NamedTuple):
    """Aircraft and actuators within a period, x' = motion x + drive u + E w, z = F x + G u."""

    chain: Array  # T times motion, and below it what integrates powers of the time
    drive: Array
    E: Array
    F: Array
    G: Array
    T: float

    def over(self, s: float) -> list[Array]:
        """Return X(s) = exp(motion T s), then int X(s - r) r^j / j! dr over r from 0 to s."""
        size = len(self.drive)
        return np.split(exponential(self.chain * s)[:size], TERMS + 1, axis=1)

    def after(self, s: float, x: Array, u: Array) -> Array:
        """Return x behind a part s of a period in which u is held."""
        X = self.over(s)
        return np.asarray(X[0] @ x + self.T * X[1] @ self.drive @ u)

    def struck(self, s: float, by: Array) -> Array:
        """Return x at the end and the coefficients of z by an impulse at s."""
        Y = self.over(1.0 - s)
        to_z = [sum((-1) ** j * p.deriv(j)(1.0) * Y[j + 1] for j in range(TERMS)) for p in BASIS]
        z = [self.F @ integral @ by for integral in to_z]
        return np.asarray(self.T * np.vstack([Y[0] @ by, *z]))

    def pushed(self, s: float) -> Array:
        """Return what `struck` does for an impulse of u, which acts on z at once too."""
        direct = [p(s) * self.G for p in BASIS]
        return np.asarray(self.struck(s, self.drive) + np.vstack([0.0 * self.drive, *direct]))

    def read(self, s: float) -> list[Array]:
        """Return z at s by the coefficients of w."""
        Y = self.over(s)
        drives = [sum(p.deriv(j)(0.0) * Y[j + 1] for j in range(TERMS)) for p in BASIS]
        return [self.T * self.F @ integral @ self.E for integral in drives]

    def kernel(self, by: Array) -> Array:
        """Return squares of the norm of the motion within a period, from entry to entry."""
        kernel = np.array([self.T * self.F @ self.over((1.0 + s) / 2.0)[0] @ by for s in GAUSS])
        return np.asarray(np.einsum("s,skc->kc", WEIGHTS * (1.0 - GAUSS) / 4.0, kernel**2))


def motion_of(file: dict[str, Any]) -> Motion:
    """Return the motion of aircraft and actuators from the numbers of a certificate."""
    A, B, E, F, G, lag = (file[key] for key in [*"ABEFG", "lag"])
    T, (n, m), k, has_lag = float(file["period"]), B.shape, E.shape[1], lag > 0.0
    rate = np.diag(1.0 / np.where(has_lag, lag, 1.0))
    chain = np.kron(np.eye(TERMS + 1, k=1), np.eye(n + m))
    chain[: n + m, : n + m] = T * np.block([[A, B * has_lag], [np.zeros((m, n)), -rate]])
    return Motion(
        chain=chain,
        drive=np.vstack([B * ~has_lag, rate * has_lag]),
        E=np.vstack([E, np.zeros((m, k))]),
        F=np.hstack([F, G * has_lag]),
        G=G * ~has_lag,
        T=T,
    )


def loop_of(file: dict[str, Any]) -> Loop:
    """Return the motion over a period from the numbers of a certificate."""
    C, law, T, motion = file["C"], file["law"], float(file["period"]), motion_of(file)
    (size, m), k = motion.drive.shape, len(motion.F)
    limit, parts = limit_of(file), parts_late(file)
    one = int(limit is not None)
    # The states are aircraft and actuators, u of earlier ticks, the newest first, and the law.
    ticks = int(np.floor(file["delay"] / T + 1e-9))
    segments = segments_of(max(file["delay"] / T - ticks, 0.0), ticks, parts)
    kept, own = (ticks + 1 + len(parts)) * m, len(law["A"])
    states = size + kept + own
    # What is cut off follows the states, and the channels follow it.
    cut = np.zeros((m, 0)) if limit is None else -np.eye(m)[:, [limit.place]]
    u_now = np.hstack([law["D"] @ C, np.zeros((m, m + kept)), law["C"], cut])
    inputs = np.vstack([u_now, np.eye(states + one)[size : size + kept]])
    x = np.eye(size, states + one)
    reads, ends, nodes, weights = [], [], [], []
    rows, columns = [np.zeros((0, states + one))], [np.zeros((size + TERMS * k, 0))]
    for begin, end, tick, late in segments:
        us = inputs.reshape(-1, m, states + one)[tick:]
        changes = us[: len(late)] - us[1 : len(late) + 1]
        u = us[0] - changes.sum(axis=0) / 2.0
        here, weight = begin + (end - begin) * (GAUSS + 1) / 2, (end - begin) * WEIGHTS / 2
        for s in here:  # z at s by (zeta, w), and (x, z) at the end by an impulse of w at s
            free = motion.F @ motion.after(s - begin, x, u) + motion.G @ u
            reads.append(np.hstack([free, *motion.read(s)]))
            ends.append(motion.struck(s, motion.E))
        for p, change in zip(late, changes, strict=True):
            by_u = np.array([motion.pushed(s) for s in here])
            by_e = np.einsum("s,sai->ais", -0.5 * np.sqrt(weight * p), by_u)
            columns.append(by_e.reshape(len(by_e), -1))
            rows.append(np.kron(np.sqrt((end - begin) / p) * change, np.eye(len(here), 1)))
        x = motion.after(end - begin, x, u)
        nodes += here.tolist()
        weights += weight.tolist()
    Z_late, W_late = np.vstack(rows), np.hstack(columns)
    values, root = np.array([p(np.array(nodes)) for p in BASIS]), np.sqrt(weights)[:, None, None]
    ZD, WV = (np.einsum("is,s,sab->iab", values, weights, f) for f in (reads, ends))
    S = (root * (reads - np.einsum("is,iab->sab", values, ZD))).reshape(len(nodes) * k, -1)
    V = np.hstack(list(root * (ends - np.einsum("is,iab->sab", values, WV))))
    still = np.zeros((own, one))
    law_motion = np.hstack([law["B"] @ C, np.zeros((own, m + kept)), law["A"], still])
    A = np.vstack([x, inputs[:kept], law_motion])
    W = np.hstack([*WV[:, :size], W_late[:size], V[:size]])
    z = np.hstack([np.vstack(list(ZD)), W_late[size:], V[size:]])
    # What follows the columns of each row is 0.
    blocks = [np.hstack([A, np.pad(W, ((0, kept + own), (0, 0)))]), -cut.T @ u_now, z, Z_late, S]
    wide = [np.pad(rows, ((0, 0), (0, z.shape[1] - rows.shape[1]))) for rows in blocks]
    return Loop(
        big=np.vstack(wide),
        K=motion.kernel(motion.E),
        states=states,
        period=T,
        late=late_of(file, segments, motion.kernel(motion.drive) ** 0.5 + np.abs(motion.G)),
        radius=RADIUS if limit is None else limit.radius,
        limit=limit,
    )


def late_of(file: dict[str, Any], segments: list[Segment], by_u: Array) -> Late:
    """Return the channels of late inputs. An input adds `by_u` times its norm to the rest of z."""
    parts = parts_late(file)
    if not parts:
        return Late(np.zeros(0, dtype=int), np.zeros(0), np.zeros((len(by_u), 0)))
    t = file["late"]["t"]
    each = [row for segment in segments for row in t[: len(segment.parts)]]
    sizes = np.sqrt(np.array(parts) @ np.exp(-2.0 * t)) / 2.0
    inputs = np.tile(np.arange(t.shape[1]), len(each))
    count = len(GAUSS)
    return Late(np.repeat(inputs, count), np.repeat(np.ravel(each), count), by_u * sizes)


def parts_of(loop: Loop) -> list[tuple[tuple[int, ...], Loop]]:
    """Return the strongly connected parts and their entries: these have the modes of the loop."""
    n, k, one, late = loop.states, len(loop.K), int(loop.limit is not None), loop.late
    # of each row and column: the state, or the number of states + what is cut off + the entry, or
    # the late input behind these
    first, behind = n + one, n + one + k
    total = behind + late.rest.shape[1]
    each = np.arange(first, behind)
    rest = (len(loop.big) - loop.channels.stop) // k
    node = np.r_[0:first, np.tile(each, TERMS), behind + late.inputs, np.tile(each, rest)]
    reach = np.eye(total)
    np.add.at(reach, (node[:, None], node[None]), np.abs(loop.big) > 0.0)
    reach[first:behind, first:] += np.hstack([loop.K, late.rest])
    for _ in range(int(np.ceil(np.log2(total)))):
        reach = (reach @ reach > 0.0).astype(float)
    parts = []
    for member in np.unique(reach * reach.T > 0.0, axis=0):
        rows, entries = np.flatnonzero(member[node]), np.flatnonzero(member[first:behind])
        big, K = loop.big[np.ix_(rows, rows)], loop.K[np.ix_(entries, entries)]
        limit = loop.limit if member[n:first].any() else None
        is_here, added = member[behind + late.inputs], late.rest[entries][:, member[behind:]]
        own = Late(late.inputs[is_here], late.t[is_here], added)
        part = loop._replace(big=big, K=K, states=int(member[:n].sum()), limit=limit, late=own)
        parts.append((tuple(entries.tolist()), part))
    return parts


def is_stable(A: Array, radius: float = RADIUS) -> bool:
    """Return whether abs(z) < radius for each eigenvalue: P > 0, P - A' P A / radius^2 > 0."""
    P, power = np.eye(len(A)), A / radius
    for _ in range(40):
        with np.errstate(over="ignore", invalid="ignore"):
            P, power = P + power.T @ P @ power, power @ power
    if not np.isfinite(P).all():
        return False
    left = P - A.T @ P @ A / radius**2
    least = (np.min(np.linalg.eigvalsh(matrix), initial=1.0) for matrix in (P, left + left.T))
    return bool(min(least) > 0.5)


def integrators(file: dict[str, Any]) -> int:
    """Return how many modes are at 1 in every aircraft, and move no u of the limited input.

    The loop rests where A x + B u = 0, B_l C x + (A_l - I) xi = 0 and D_l C x + C_l xi = u. These
    equations depend on each other, in each aircraft and for each gain of the limited input, if a
    row multiplied by them is 0 and multiplied by E and by this column of B too. Each such row
    leaves a direction in which the loop rests: a mode at 1. It is none of the transfer function
    from what is cut off to u, because no gain of this input moves it.
    """
    limit, (A, B, C, E), law = limit_of(file), (file[key] for key in "ABCE"), file["law"]
    require(limit is not None, "limit", None, "an input")
    assert limit is not None  # noqa: S101 - for mypy
    (n, m), q = B.shape, len(law["A"])
    varied = np.hstack([E, B[:, [limit.place]]])
    rows = np.block(
        [
            [A, B, np.zeros((n, q)), varied],
            [law["B"] @ C, np.zeros((q, m)), law["A"] - np.eye(q), np.zeros((q, varied.shape[1]))],
            [law["D"] @ C, -np.eye(m), law["C"], np.zeros((m, varied.shape[1]))],
        ]
    )
    sizes = np.linalg.norm(rows, axis=1)[:, None]
    return int(np.sum(np.linalg.svd(rows / np.where(sizes > 0.0, sizes, 1.0))[1] < EQUAL))


def settles(A: Array, count: int) -> bool:
    """Return whether all modes but `count` at 1 have abs(z) < SETTLING."""
    left, _, _ = np.linalg.svd(A - np.eye(len(A)))
    others, at_one = np.split(left, [len(A) - count], axis=1)
    is_exact = norm(at_one.T @ A - at_one.T) <= EQUAL
    return is_exact and is_stable(others.T @ A @ others, SETTLING)


def norm(X: Array) -> float:
    """Return the Frobenius norm, which is at least the largest singular value."""
    return float(np.linalg.norm(X))


def adjoint(X: Array) -> Array:
    """Return X*."""
    return np.asarray(X.conj().T)


def closed(big: Array, w: slice, c: Array) -> Array:
    """Return the system from w - c z in place of w, with z = big[w] (x, w, v)."""
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
    rest_by_late: float
    gain: float  # exp(-s) of the limited input


def system_of(
    part: Loop, middle: Array, half: Array, step: dict[str, Any], frequency: float
) -> System:
    """Return the system of a step. If t lacks coefficients, they balance those before them."""
    n, k, known = part.states, len(part.K), len(step["t"])
    one, p, w, late = int(part.limit is not None), TERMS * k, part.channels, part.late
    still = np.zeros(len(late.t))
    rest, c = slice(w.stop, None), np.r_[np.zeros(one), np.tile(middle, TERMS), still]
    around = closed(part.big[: w.stop], w, c)
    (A, W, V), (Z, D, y) = (np.split(side, [n, w.stop], axis=1) for side in (around[:n], around[w]))
    wide = np.r_[np.ones(one), np.tile(half, TERMS), still + 1.0][:, None]
    R = np.linalg.inv(part.radius * np.exp(1j * frequency * part.period) * np.eye(n) - A)
    sizes = (np.abs(wide * (Z @ R @ W + D)) ** 2 + 1e-30)[one:, one:]
    t, g = (
        np.r_[step[key], np.zeros(p - known), last]
        for key, last in zip("tg", (late.t, still), strict=True)
    )
    for i in range(known, p, k):
        before = np.r_[0:i, p : len(t)]
        to = (np.exp(t[before]) * (1.0 + np.abs(g[before]))) ** 2 @ sizes[before, i : i + k]
        out = sizes[i : i + k, before] @ np.exp(-2.0 * t[before])
        t[i : i + k] = np.log(to / out) / 4.0
    # Balance the coefficients that t lacks against all others, channel by channel (Osborne).
    np.fill_diagonal(sizes, 1e-30)
    weight = (1.0 + np.abs(g)) ** 2
    for i in np.tile(np.arange(known, p), ROUNDS):
        into = (weight * np.exp(2.0 * t)) @ sizes[:, i]
        t[i] = np.log(into / (sizes[i] @ np.exp(-2.0 * t))) / 4.0
    # v of an entry is scaled as its last coefficient, and is at most `most` times the rest of z.
    most, last = np.abs(middle) + half, np.exp(t[p - k : p])
    s = np.full(one, step.get("s", 0.0))
    out, scale = np.exp(np.r_[0.0 * s, t]), np.exp(np.r_[s, t])
    nodes = (len(part.big) - w.stop) // k
    S = np.tile(most * last, nodes)[:, None] * part.big[rest, : w.stop]
    through = S[:, w] * c
    S = S + through @ around[w, : w.stop]
    V, y = V / np.tile(last, nodes), y / np.tile(last, nodes)
    rest_by_v = norm(np.sqrt(part.K) * np.outer(most * last, 1.0 / last)) + norm(through) * norm(y)
    scaled = wide * out[:, None]
    W, Z, D, y = W / scale, scaled * Z, scaled * D / scale, (scaled * y)[one:]
    # states of which what comes in is as large as what goes out make the norms small
    into, leave = ((np.abs(X) ** 2).sum(axis=a) + 1e-30 for X, a in ((R @ W, 1), (Z @ R, 0)))
    f = (leave / into) ** 0.25
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
        y_by_v=[norm(rows) for rows in np.split(y[:p], TERMS)],
        gy_by_v=norm(g[:, None] * y),
        rest_by_w=norm(by_w),
        rest_by_v=rest_by_v,
        rest_by_late=norm((most * last)[:, None] * late.rest),
        gain=float(np.exp(-s[0])) if one else 0.0,
    )


def is_positive(X: Array) -> bool:
    """Return whether a matrix is finite and has a finite Cholesky factor: X > 0."""
    try:
        return bool(np.isfinite(X).all() and np.isfinite(np.linalg.cholesky(X)).all())
    except np.linalg.LinAlgError:
        return False


def is_proved(system: System, part: Loop, w: float, x: float) -> bool:
    """Return whether the box has no mode at any frequency from w - x to w + x."""
    A, W, V, Z, D, S, S_w, g, y_by_v, gy_by_v, rest_by_w, rest_by_v, rest_by_late, gain = system
    (n, p), period = W.shape, part.period
    one = p - len(g)
    z, delta = part.radius * np.exp(1j * w * period), part.radius * x * period
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
        """Return the norms of what is linear in the frequency of `side W`, and of the rest."""
        linear = delta * norm(side @ right)
        wrong_side = norm(np.abs(side) @ wrong) + 2.0 * error**2 * norm(side) * norm(W)
        return linear, x * period / 2.0 * linear + norm(side) * bend + wrong_side

    # The rest: v is at most `rest`, and adds `added` to y.
    x_by_v = inverse * (norm(R @ V) + 2.0 * inverse * error * norm(R) * norm(V))
    # With X = Y - slip, S R (I + X)^-1 V = S R V - S R (I + X)^-1 X V.
    through_R = inverse * norm(S @ R) * (delta * norm(R @ V) + error * norm(V))
    loop_gain = rest_by_v + min(norm(S) * x_by_v, norm(S @ R @ V) + through_R)
    if not loop_gain < 0.9:
        return False
    square = norm(S @ right) ** 2 + 2.0 * float((S_w * right.real).sum()) + rest_by_w**2
    rest = (square**0.5 + sum(moved(S @ R)) + rest_by_late) / (1.0 - loop_gain)
    y_by_x = norm(left @ V) + norm(left) * (delta * x_by_v + 2.0 * error * norm(V))
    N = D + Z @ right
    N_d, left_d = N[one:], left[one:]
    Y = 1j * g
    if part.limit is not None:
        Y = np.r_[gain * part.limit.at(w * period), Y]
    added = (norm(np.array(y_by_v)) + y_by_x) * rest
    by_term = np.split(N_d[: TERMS * len(part.K)], TERMS)
    N_y = sum(norm(rows) * y for rows, y in zip(by_term, y_by_v, strict=True))
    H_added = (N_y + gy_by_v + (norm(N_d) + np.abs(Y).max()) * y_by_x) * rest
    gram, skew = adjoint(N_d) @ N_d, Y[:, None] * N
    H_left = adjoint(N_d) @ left_d + Y[:, None] * left
    change = -1j * period * z * (H_left @ right)
    lost = ROUNDING + 2.0 * (H_added + moved(H_left)[1]) + (sum(moved(left_d)) + added) ** 2
    if part.limit is not None:
        # m moves too: what is linear joins `change`
        lags, taps = part.limit.lags, part.limit.taps
        slope = 1j * period * np.sum(lags * taps * np.exp(-1j * lags * w * period))
        change[0] += gain * slope * N[0]
        far, curved = (np.sum(taps * (x * period * np.abs(lags)) ** i) for i in (1, 2))
        lost += 2.0 * gain * (far * (sum(moved(left[:1])) + added) + curved / 2.0 * norm(N[0]))
    change = x * (change + adjoint(change))
    room = np.diag(np.r_[np.zeros(one), np.ones(p - one)] - lost) - gram - skew - adjoint(skew)
    return is_positive(room - change) and is_positive(room + change)


def prove(part: Loop, steps: list[dict[str, Any]], size: float, slowest: float, count: int) -> int:
    """Replay the steps from the whole box, `slowest` to pi / T, after `count` bounds.

    Returns the number of bounds with these. Raises ValueError.
    """
    k = len(part.K)
    boxes = [(np.zeros(k), np.full(k, size), slowest, np.pi / part.period)]
    for number, step in enumerate(steps):
        if not boxes:
            raise ValueError(f"step {number}: the box is proved before it")
        middle, half, low, high = boxes.pop()
        if "halve" in step:
            side = np.where(np.arange(k) == step["halve"], half / 2.0, 0.0)
            boxes += [(middle + turn * side, half - side, low, high) for turn in (-1.0, 1.0)]
            continue
        if not low <= step["low"] < step["high"] <= high:
            raise ValueError(f"step {number}: not within {low:.6g} to {high:.6g} rad/s, its box")
        fits = ("s" in step) == (part.limit is not None)
        require(fits, f"step {number}", [*step], "s where an input is cut off")
        todo, balanced = [(step["low"], step["high"])], np.inf
        while todo:
            begin, end = todo.pop()
            w, x = (begin + end) / 2.0, 0.5000001 * (end - begin)
            if not balanced / NEAR < w < NEAR * balanced:
                system, balanced = system_of(part, middle, half, step, w), w
            count += 1
            if not is_proved(system, part, w, x):
                if not (x >= NARROWEST * w and count <= MOST):
                    raise ValueError(f"step {number}: not proved at {w:.6g} rad/s")
                todo += [(begin, w), (w, end)]
        boxes += [(middle, half, low, step["low"])] if step["low"] > low else []
        boxes += [(middle, half, step["high"], high)] if step["high"] < high else []
    if boxes:
        raise ValueError(f"{len(boxes)} boxes are not proved")
    return count


def require_range(file: dict[str, Any]) -> None:
    """Raise ValueError if the text above does not apply to a motion."""
    lags = file["lag"][file["lag"] > 0.0]
    fastest = np.max(np.r_[np.abs(np.linalg.eigvals(file["A"])), 1.0 / lags])
    if not fastest * file["period"] <= FASTEST:
        raise ValueError(f"found a motion of {fastest:.3g} rad/s, too fast for the nodes of Gauss")


def is_equal(found: Array, expected: Array, part: float = EQUAL) -> bool:
    """Return whether two arrays are the same up to a part of their largest number."""
    if found.shape != expected.shape:
        return False
    largest, apart = (np.max(np.abs(x), initial=0.0) for x in (expected, found - expected))
    return bool(apart <= part * largest)


def without_actuators(file: dict[str, Any]) -> dict[str, Any]:
    """Return the file with lags in place of the actuators that are states, u[INPUT], last.

    Raises ValueError unless such a state follows its input by one lag, 1/lag[INPUT] changes this
    lag alone by `part` of itself, and nothing else depends on both.
    """
    inputs, names = file["inputs"], file["names"]
    A, B, F, G, lag = (file[key].copy() for key in ["A", "B", "F", "G", "lag"])
    columns = {f"u[{name}]": j for j, name in enumerate(inputs)}
    n = sum(state not in columns for state in file["states"])
    found = set()
    for i, state in enumerate(file["states"][n:], n):
        require(state in columns, "states", file["states"], "actuators behind the others")
        j = columns[state]
        rate, entry = file["B"][i, j], f"1/lag[{inputs[j]}]"
        found.add(entry)
        own = {"A": -rate * np.eye(len(A))[i], "B": rate * np.eye(len(inputs))[j]}
        follows = rate > 0.0 and lag[j] == 0.0 and not file["B"][:n, j].any()
        follows = follows and all(np.array_equal(file[key][i], own[key]) for key in "AB")
        for k, name in enumerate(names):
            changes, part = file["E"][i, k] != 0.0, file["part"][k]
            follows = follows and changes == (name == entry)
            if not changes:
                follows = follows and not file["G"][k, j]
                continue
            follows = follows and np.array_equal(file["E"][:, k], np.eye(len(A))[i])
            follows = follows and is_equal(file["F"][k], part * own["A"])
            follows = follows and is_equal(file["G"][k], part * own["B"])
        require(bool(follows), state, file["A"][i].tolist(), f"the lag of {inputs[j]} alone")
        B[:, j], G[:, j], lag[j] = A[:, i], F[:, i], 1.0 / rate
    kept = [k for k, name in enumerate(names) if name not in found]
    return file | {
        "states": file["states"][:n],
        "names": [names[k] for k in kept],
        "part": file["part"][kept],
        "A": A[:n, :n],
        "B": B[:n],
        "E": file["E"][:n, kept],
        "F": F[kept, :n],
        "G": G[kept],
        "lag": lag,
    }


def exact_entries(file: dict[str, Any]) -> list[str]:
    """Return the entries of A and B that are the same number in every aircraft.

    Raises ValueError unless an entry NAME of `names` is one number of the aircraft: A[i,j] that is
    off by `part` of itself, or B[i,j] of an effector, whose row of T multiplies it. One of `zeros`
    is 0, and off by any number. Two names for one thing, or one for two, would make the lines that
    are printed false: an effector with the name of an input is moved by this input alone.
    """
    file = without_actuators(file)
    states, effectors, T = file["states"], file["effectors"], file["T"]
    zeros, own = file.get("zeros", []), effectors == file["inputs"]
    for name, row in zip(effectors, T, strict=True):
        if name in file["inputs"]:
            is_of_input = np.arange(len(row)) == file["inputs"].index(name)
            fits = np.array_equal(row != 0.0, is_of_input)
            require(fits, f"T of {name}", row.tolist(), "the input of this name alone")
    require({*zeros} <= {*file["names"]}, "zeros", zeros, "some of the names")
    rest = {"A": file["A"].copy(), "B": file["B"].copy()}
    places: dict[str, tuple[str, int, int]] = {}
    for i, state in enumerate(states):
        for letter, columns in (("A", states), ("B", effectors)):
            places |= {
                f"{letter}[{state},{name}]": (letter, i, j) for j, name in enumerate(columns)
            }
    for k, name in enumerate(file["names"]):
        require(name in places, "names", name, "A[STATE,STATE] or B[STATE,EFFECTOR] of the file")
        letter, i, j = places[name]
        part, unit = file["part"][k], np.zeros(len(states))
        unit[i] = 1.0
        along = np.eye(len(states))[j] if letter == "A" else T[j]
        changes = {"A": file["F"][k], "B": file["G"][k]}
        value = changes[letter] @ along / (part * (along @ along)) if part and along.any() else 0.0
        fits = np.array_equal(file["E"][:, k], unit) and bool(value) == bool(part)
        fits = fits and is_equal(changes[letter], part * value * along)
        fits = fits and not changes["B" if letter == "A" else "A"].any()
        require(fits, name, changes[letter].tolist(), f"{part:g} of this entry of the file alone")
        if name not in zeros:
            rest[letter][i] -= value * along
        elif own or letter == "A":
            require(file[letter][i, j] == 0.0, name, float(file[letter][i, j]), "0: it is in zeros")
    # Of each entry, either nothing is left or all of it.
    exact = []
    require(not own or np.array_equal(T, np.eye(len(T))), "T", T.tolist(), "1 and 0: its inputs")
    for letter, columns in (("A", states), ("B", file["inputs"])):
        size, left = np.abs(file[letter]), np.abs(rest[letter])
        if letter == "B" and not own:
            # a row is a sum over effectors, of which each may deviate
            require(bool((left <= EQUAL * size.max(axis=1)[:, None]).all()), "B", "a rest", "none")
            continue
        for i, j in np.argwhere(left > EQUAL * size):
            name, one = f"{letter}[{states[i]},{columns[j]}]", rest[letter][i, j]
            require(one == file[letter][i, j], name, float(one), "nothing or all exact")
            exact.append(name)
    return exact


# The rows of RISE_DI_PARAMETERS in the order in which C reads them, by the size without which they
# are left out; = marks a number among the lists.
ROWS = (
    ("M", "digest= period_ns= max_age_ns= hold_ns= ramp_ns= slope_ns= deactivation_holds= sign="),
    ("P", "order"),
    ("M", "period= dt_least= dt_largest= K Lambda beta D input_scale omega eps y_max y_reach"),
    ("M", "limits.lower limits.upper limits.rate"),
    ("P", "T effect exchange stops.lower stops.upper stops.rate"),
    ("SCHEDULE", "speed= airspeed time= V_least= V_largest="),
    ("N", "A B C gravity inverse path_A path_gravity lead has_sine"),
    ("S", "Phi Gamma H L F observer_limits.lower observer_limits.upper observer_limits.rate"),
    ("S", "fade_rate="),
)
REAL = r"-?(?:0|[1-9]\d*)(?:\.\d+)?(?:e[+-]?\d+)?F?"
LIST = rf"\{{{REAL}(?:, {REAL})*\}}"
WORDS = r'"[^"\\?]*"(?:, "[^"\\?]*")*'
# The lines of rise_di_parameters.h behind its first comment.
LINES = "|".join(
    (
        r"|\}|#(?:ifndef|define) RISE_DI_PARAMETERS_H|#endif|#define RISE_DI_\w+ (?:\{ )?\\",
        rf"#define RISE_DI_\w+ (?:{REAL}|{LIST}|{WORDS})(?: /\* [^*/\\?]* \*/)?",
        rf"    /\* [\w.]+ \*/ (?:{REAL}|\{{?{LIST}\}}?),? \\",
        rf"    \{{{WORDS}(?:, {REAL})*\}}(?:, \\)?",
    )
)


def read_constants(constants: str) -> tuple[dict[str, str], dict[str, Array]]:
    """Return the macros of rise_di_parameters.h and its rows, by their names.

    Raises ValueError unless a C compiler reads the same: a second definition, a line that is left
    out, a row elsewhere, or a name that is not that of its row would be constants of another law.
    """
    comment, _, body = constants.partition("\n */\n")
    require("*/" not in comment, "constants", comment, "one comment before them")
    require("\\" not in comment and "??" not in comment, "constants", comment, "plain words")
    for line in body.split("\n"):
        require(re.fullmatch(LINES, line) is not None, "constants", line, "a line of an export")
    macros = re.findall(r"^#define (RISE_DI_\w+) ?(.*)$", body, re.MULTILINE)
    define = dict(macros)
    require(len(define) == len(macros), "constants", [*define], "each macro once")
    block = body.partition("#define RISE_DI_PARAMETERS { \\\n")[2].partition("\n}\n")[0]
    found = re.findall(r"^    /\* ([\w.]+) \*/ ([^\\]*?),? \\$", block, re.MULTILINE)
    expected, rows = [], []
    for size, names in ROWS:
        if define[f"RISE_DI_{size}"].split()[0] == "0":
            continue
        for name in names.split():
            is_list = not name.endswith("=")
            opened, closed = is_list + name.endswith(".lower"), is_list + name.endswith(".rate")
            expected.append((name.rstrip("="), opened, closed))
    for name, row in found:
        rows.append((name, row.count("{"), row.count("}")))
    require(rows == expected, "constants", [row[0] for row in rows], "the rows of rise_di.h")
    return define, {
        name: np.array([float(x.strip(" {}F")) for x in row.split(",")]) for name, row in found
    }


def law_of(constants: str, inputs: int, size: int) -> tuple[dict[str, Any], float]:
    """Return the law of rise_di_parameters.h near e = 0, and how exact its numbers are.

    I += T (e + e_1) / 2,  Pi += T beta e / eps, or e_hat / (T omega) of the implicit sign,
    u = -scale D (K (e - e_0 + Lambda I) + Pi) - F zc,  zc = z + L (e - H z),  z+ = Phi zc + Gamma u

    with the states e_0, e_1, I, Pi, and those of an observer, z, u_o and the fade-in, which has
    ended. Raises ValueError if the text lacks these constants, or has other sizes.
    """
    try:
        define, known = read_constants(constants)
        gains = [
            known[name] for name in ("K", "Lambda", "beta", "D", "input_scale", "omega", "eps")
        ]
        sizes = {len(gain) for gain in gains} | {int(define["RISE_DI_M"].split()[0])}
        require(len(sizes) == 1, "constants", sorted(sizes), "a value for each channel")
        K, Lambda, beta, D, scale, omega, eps = gains
        T, sign, m = known["period_ns"][0] / 1e9, known["sign"][0], len(K)
        s = int(define["RISE_DI_S"].split()[0])
        one = EQUAL if define["RISE_DI_FLOAT32"].startswith("0 ") else FLOAT32
        tail = s + m + 1 if s else 0
        require((m, 4 * m + tail) == (inputs, size), "constants", m, "the inputs of the law")
        steps = [known[name][0] for name in ("dt_least", "period", "dt_largest")]
        is_step = steps[0] <= T <= steps[2] and abs(steps[1] - T) <= one * T
        require(is_step, "constants", steps, "steps of one period")
        require(sign in {1, 2}, "constants sign", sign, "1 or 2, which are linear near e = 0")
        e_0, e_1, I_1, Pi, z, _, e = np.split(
            np.eye(4 * m + tail + m), np.cumsum([m, m, m, m, s, tail - s])
        )
        I_2 = I_1 + T / 2.0 * (e + e_1)
        if sign == 2:
            step = (T * beta / eps)[:, None] * e
        else:
            slope = (omega * K)[:, None] * (e - e_1 + Lambda[:, None] * (I_2 - I_1))
            step = (2.0 * e - e_1 - T * slope) / (T * omega)[:, None]
        rows = [e_0, e, I_2, Pi + step]
        u = -(scale * D)[:, None] * (K[:, None] * (e - e_0 + Lambda[:, None] * I_2) + rows[3])
        if s:
            Phi, Gamma, H, L, F = (
                known[name].reshape(shape)
                for name, shape in (
                    ("Phi", (s, s)), ("Gamma", (s, m)), ("H", (m, s)), ("L", (s, m)), ("F", (m, s)),
                )
            )  # fmt: skip
            zc = z + L @ (e - H @ z)
            u = u - F @ zc
            rows += [Phi @ zc + Gamma @ u, -F @ zc, 0.0 * e[:1]]
    except (KeyError, IndexError) as error:
        raise ValueError(f"constants: found no {error}, expected rise_di_parameters.h") from None
    M = np.vstack(rows)
    law: dict[str, Any] = {"A": M[:, :size], "B": M[:, size:], "C": u[:, :size], "D": u[:, size:]}
    law["period"] = np.array(T)
    for key, macro in (("outputs", "RISE_DI_OUTPUTS"), ("inputs", "RISE_DI_INPUTS")):
        law[key] = re.findall(r'"([^"]*)"', define.get(macro, ""))
    return law, one


def check_constants(file: dict[str, Any]) -> None:
    """Raise ValueError unless the law is that of the constants beside it."""
    law, one = law_of(file["constants"], len(file["inputs"]), len(file["law"]["A"]))
    same = all(file[key] == law[key] for key in ("outputs", "inputs"))
    same = same and is_equal(file["period"], law["period"])
    if not (same and all(is_equal(file["law"][key], law[key], one) for key in "ABCD")):
        raise ValueError("the law is not that of the constants beside it")


def digest_of(file: dict[str, Any]) -> str:
    """Return SHA-256 of names and of the loop in 10 digits, for a box whose largest part is 1."""
    size, law = np.max(file["part"]), [file["law"][key] for key in "ABCD"]
    loop = [*(file[key] for key in "ABC"), *law, *(file[key] for key in ("lag", "delay", "period"))]
    box = [np.array(file["part"]) / size, file["E"], *(np.array(file[key]) / size for key in "FG")]
    values = np.concatenate([np.ravel(array) for array in loop + box]) + 0.0
    names = json.dumps([file[key] for key in ("states", "outputs", "inputs", "effectors", "names")])
    text = " ".join([names, *(f"{value:.9e}" for value in values)])
    return hashlib.sha256(text.encode()).hexdigest()


def check(file: dict[str, Any]) -> int:
    """Return how many bounds prove a certificate. Raises ValueError if they do not."""
    require(file["part"].max() > 0.0, "part", 0.0, "an entry that may deviate")
    if digest_of(file) != file["loop"]:
        raise ValueError("the loop is not the one that its name says")
    if "constants" in file:
        check_constants(file)
    exact_entries(file)
    require_range(file)
    loop, count, steps = loop_of(file), 0, dict(file["parts"])
    slowest = 0.0 if loop.limit is None else loop.limit.slowest
    if not np.isfinite(loop.big).all():
        raise ValueError("the motion over a period is not finite")
    if loop.radius == SETTLING and not settles(
        loop.big[: loop.states, : loop.states], integrators(file)
    ):
        raise ValueError("the aircraft of the file, d = 0, does not settle")
    for entries, part in parts_of(loop):
        motion = part.big[: part.states, : part.states]
        if not is_stable(motion):
            raise ValueError("the aircraft of the file, d = 0, is not stable")
        # a single state rests or decays; with more, modes at 1 are not told from an oscillation
        is_single = part.states == 1 and motion[0, 0] >= 0.0
        if slowest and not entries and not is_single and not is_stable(motion, SETTLING):
            raise ValueError("a part without entries may oscillate")
        require(part.limit is None or len(entries) > 0, "limit", "no entry", "a part with entries")
        is_late = len(part.late.t) > 0 and part.states > 0
        require(not is_late or len(entries) > 0, "late", "no entry", "parts with entries")
        if entries and (
            part.big[part.states :, part.states :].any() or part.states or part.K.any()
        ):
            if entries not in steps:
                raise ValueError(f"no proof for {[file['names'][i] for i in entries]}")
            count = prove(part, steps.pop(entries), float(file["size"]), slowest, count)
    require(not steps, "parts", [*steps], "the parts of the loop alone")
    return count


def rounded_down(x: float) -> str:
    """Write the first three digits of a positive number."""
    unit = 10.0 ** (np.floor(np.log10(x)) - 2.0)
    return f"{np.floor(x / unit + 1e-6) * unit:.3g}"


def claim_of(file: dict[str, Any]) -> str:
    """Return what is proved."""
    if "limit" not in file:
        return "stable"
    name, slowest = file["limit"]["input"], file["limit"]["slowest"]
    if slowest:
        period = np.floor(20.0 * np.pi / slowest) / 10.0
        return f"no periodic motion of up to {period:g} s, with any limits of {name},"
    return f"settles with any limits of {name} around where it settles,"


def report_of(file: dict[str, Any], count: int) -> str:
    """Return what a proved certificate says."""
    lines = [f"PROVED by {count} bounds: {claim_of(file)} for each deviation within"]
    for k in [k for k, name in enumerate(file["names"]) if name.startswith("1/lag")]:
        percent = np.floor(1e3 * file["size"] * file["part"][k] + 1e-6) / 10.0
        lines.append(f"  {file['names'][k]} {percent:g} %")
    exact = ", ".join(exact_entries(file)) or "no entry"
    file = without_actuators(file)
    for k, name in enumerate(file["names"]):
        if file["part"][k]:
            # a position beside the name: row and column from 0
            letter, row, column = re.split(r"[\[,]", name[:-1])
            side = file["states"] if letter == "A" else file["effectors"]
            i, j = file["states"].index(row), side.index(column)
            within = f"{np.floor(1e3 * file['size'] * file['part'][k] + 1e-6) / 10.0:g} %"
            if name in file.get("zeros", []):
                along = np.eye(len(side))[j] if letter == "A" else file["T"][j]
                change = file["F" if letter == "A" else "G"][k] @ along / (along @ along)
                within = f"0 +- {rounded_down(abs(change) * file['size'])}"
            lines.append(f"  {name} ({letter} {i}, {j}) {within}")
    lines.append(f"exact in every aircraft: {exact}, and each other 0")
    lines.append(f"certificate {file['loop'][:12]}")
    law = "of the constants in the file" if "constants" in file else "of no exported constants"
    lines.append(f"law: {law}")
    lags = ", ".join(f"{lag:g}" for lag in file["lag"])
    lines.append(f"period {file['period']:g} s, delay {file['delay']:g} s, lags [{lags}] s")
    covered = COVERED_WITH_LIMIT if "limit" in file else COVERED
    if "late" in file:
        time = np.floor(1e6 * file["late"]["time"] + 1e-6) / 1e6
        lines.append(f"late: each input by 0 to {time:g} s, by another time at each tick")
        covered = COVERED_WITH_LATE
    return "\n".join([*lines, covered])


def main() -> int:
    """Check a certificate, and the constants of an exported controller beside it.

    Returns the exit status: 0 proved, 1 refused, 2 a call or a file that cannot be read.
    """
    if len(sys.argv) not in {2, 3}:
        call = "check_certificate.py certificate.json [rise_di_parameters.h]"
        print(f"expected: {call}", file=sys.stderr)
        return 2
    try:
        file = read(Path(sys.argv[1]))
        for header in sys.argv[2:]:
            if Path(header).read_bytes().decode() != file.get("constants"):
                raise ValueError(f"{header} holds other constants")
        with np.errstate(all="ignore"):
            text = report_of(file, check(file))
    except (ValueError, np.linalg.LinAlgError) as error:
        print(f"REFUSED: {error}", file=sys.stderr)
        return 1
    except OSError as error:
        print(f"REFUSED: {error}", file=sys.stderr)
        return 2
    try:
        print(text, flush=True)
    except BrokenPipeError:
        # the reader has closed: nothing is left to say, and the status is that of the proof
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    return 0


if __name__ == "__main__":
    sys.exit(main())
