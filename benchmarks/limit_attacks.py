# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Fly aircraft inside or outside the box of a certificate with a limit, and count how each ends.

This program reads the numbers of the certificate and computes the motion without any code of the
stack. The limits of the input lie at random around the u at which the loop rests. Each flight
starts from a state for which the law asks for up to 300 times the width between the limits.

    python -m benchmarks.limit_attacks certificate.json --aircraft 2000
    python -m benchmarks.limit_attacks certificate.json --aircraft 2000 --size 0.4 --input thrust
"""

import argparse
import json
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm

Array = NDArray[Any]
BATCH = 250  # number of aircraft that fly at once
# s: duration of a flight, and time from one look at it to the next
LONGEST, LOOKED_AT = 600.0, 20.0
# a flight has settled if its state changes less than this between looks, as a part of the start's
SETTLED = 1e-2
DOUBLINGS = 21  # a linear loop rests after 2^21 ticks
GONE = 1e6  # a flight has left if its state is this many times that of the start
# a flight falls if its later excess over the limits is below this part of its earlier excess
FALLEN = 0.999
# changes of the exceeded limit in the last third of a flight, 200 s: an oscillation with a period
# of 126 s or less has at least so many
TURNS = 3
ENDS = ("settles", "falls", "swings more slowly", "oscillates", "leaves")


def loop_of(file: dict[str, Any], d: Array) -> tuple[Array, Array, Array]:
    """Return F (N, S, S), W (N, S) and K (S,) of s+ = F s - W w and u = K s, for each aircraft d.

    s has the states of aircraft and actuators, u of earlier ticks, and the states of the law. u is
    the command of the limited input, and w what the limits cut off from it.
    """
    A, B, C, E, F, G, lag = (np.array(file[key], float) for key in [*"ABCEFG", "lag"])
    law = {key: np.array(value, float) for key, value in file["law"].items()}
    (n, m), q, T = B.shape, len(law["A"]), file["period"]
    A = A + np.einsum("ik,Nk,kj->Nij", E, d, F)
    B = B + np.einsum("ik,Nk,kj->Nij", E, d, G)
    size, has_lag = n + m, lag > 0.0
    motion = np.zeros((len(d), size + m, size + m))
    motion[:, :n, :n], motion[:, :n, n:size], motion[:, :n, size:] = A, B * has_lag, B * ~has_lag
    rate = np.diag(np.where(has_lag, 1.0 / np.where(has_lag, lag, 1.0), 0.0))
    motion[:, n:size, n:size], motion[:, n:size, size:] = -rate, rate
    ticks = int(file["delay"] / T + 1e-9)
    early = file["delay"] - ticks * T
    first, second = (expm(motion * s)[:, :size] for s in (early, T - early))
    kept = (ticks + 1) * m
    now = np.hstack([law["D"] @ C, np.zeros((m, m + kept)), law["C"]])
    commands = np.vstack([now, np.eye(kept, size + kept + q, size)])
    old, new = commands[kept:], commands[ticks * m :][:m]
    x = np.eye(size, size + kept + q)
    middle = first[:, :, :size] @ x + first[:, :, size:] @ old
    end = second[:, :, :size] @ middle + second[:, :, size:] @ new
    below = np.vstack(
        [commands[:kept], np.hstack([law["B"] @ C, np.zeros((q, m + kept)), law["A"]])]
    )
    below = np.broadcast_to(below, (len(d), *below.shape))
    place = file["inputs"].index(file["limit"]["input"])
    W = np.zeros((len(d), size + kept + q))
    W[:, size + place] = 1.0
    if ticks == 0:
        W[:, :size] = second[:, :, size + place]
    return np.concatenate([end, below], axis=1), W, now[place]


def ends_of(file: dict[str, Any], d: Array, generator: np.random.Generator) -> Array:
    """Count how the flights of aircraft d (N, k) end, by ENDS."""
    F, W, K = loop_of(file, d)
    n = len(file["A"])
    s = np.zeros(W.shape)
    s[:, :n] = generator.normal(size=(len(d), n))
    # without the state at which it would rest, the loop comes back to u = 0 if there are no limits
    rests = F
    for _ in range(DOUBLINGS):
        rests = rests @ rests
    s -= (rests @ s[..., None])[..., 0]
    start, asked, linear = np.linalg.norm(s, axis=1), np.zeros(len(d)), s
    for _ in range(int(5.0 / file["period"])):
        asked = np.maximum(asked, np.abs(linear @ K))
        linear = (F @ linear[..., None])[..., 0]
    width = asked * 10.0 ** generator.uniform(-2.5, 0.0, len(d))
    trim = np.where(generator.random(len(d)) < 0.5, 0.5, generator.uniform(0.0, 1.0, len(d)))
    low, high = -trim * width, (1.0 - trim) * width
    counts = np.zeros(len(ENDS), dtype=int)
    peaks, turns, side = np.zeros((len(d), 0)), np.zeros((len(d), 0)), np.zeros(len(d))
    while len(s):
        before, peak, turned = s, np.zeros(len(s)), np.zeros(len(s))
        for _ in range(int(LOOKED_AT / file["period"])):
            u = s @ K
            w = u - np.clip(u, low, high)
            s = (F @ s[..., None])[..., 0] - W * w[:, None]
            peak = np.maximum(peak, np.abs(w) / width)
            turned += np.sign(w) * side < 0.0
            side = np.where(w != 0.0, np.sign(w), side)
        peaks, turns = np.column_stack([peaks, peak]), np.column_stack([turns, turned])
        far, moved = np.linalg.norm(s, axis=1), np.linalg.norm(s - before, axis=1)
        leaves = ~(far < GONE * start)
        settles = ~leaves & (peak == 0.0) & (moved < SETTLED * start)
        stays = ~leaves & ~settles
        counts += [settles.sum(), 0, 0, 0, leaves.sum()]
        if peaks.shape[1] * LOOKED_AT >= LONGEST:
            third = peaks.shape[1] // 3
            earlier, later = peaks[:, third:-third].max(axis=1), peaks[:, -third:].max(axis=1)
            falls = stays & ((later < FALLEN * earlier) | (later == 0.0))
            swings = stays & ~falls & (turns[:, -third:].sum(axis=1) >= TURNS)
            slow = stays & ~falls & ~swings
            counts += [0, falls.sum(), slow.sum(), swings.sum(), 0]
            break
        F, W, s, low, high, width, start, peaks, turns, side = (
            value[stays] for value in (F, W, s, low, high, width, start, peaks, turns, side)
        )
    return counts


def main() -> None:
    """Print how the flights end."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("certificate", type=Path)
    parser.add_argument("--aircraft", type=int, default=1000)
    parser.add_argument("--size", type=float, help="relative deviation in place of the file's")
    parser.add_argument("--input", help="limited input in place of the file's")
    parser.add_argument("--seed", type=int, default=7)
    options = parser.parse_args()
    file = json.loads(options.certificate.read_text())
    file["limit"]["input"] = options.input or file["limit"]["input"]
    generator = np.random.default_rng(options.seed)
    size = options.size / max(file["part"]) if options.size is not None else file["size"]
    counts = np.zeros(len(ENDS), dtype=int)
    for k in range(0, options.aircraft, BATCH):
        d = generator.uniform(-size, size, (min(BATCH, options.aircraft - k), len(file["part"])))
        d = np.where(generator.random((len(d), 1)) < 0.5, np.sign(d) * size, d)
        counts += ends_of(file, d, generator)
    ends = ", ".join(f"{count} {end}" for count, end in zip(counts, ENDS, strict=True))
    percent = 100.0 * size * max(file["part"])
    print(f"{file['limit']['input']}, {options.aircraft} within {percent:.1f} %: {ends}")


if __name__ == "__main__":
    main()
