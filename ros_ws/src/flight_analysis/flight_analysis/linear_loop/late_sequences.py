# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Search for aircraft that a periodic sequence of delays makes unstable.

u of each tick and input is either in time or late by `late`, which is at most a period. At each
instant the newest u that has arrived acts. A tick begins when a u in time would arrive. Over a tick
the motion is exactly one of 2^m matrices, for m inputs: one for each choice of the inputs that are
late. A sequence of these choices makes the loop unstable if a mode of the product of its matrices
lies outside the unit circle.

The search changes the choices of a sequence. x_k and p_k are the right and left eigenvectors of the
product, carried to tick k. If tick k gets another matrix M, the mode changes to p_k+1 M x_k /
(p_k+1 x_k+1), to first order. So the best choice of each tick is known at once, and the ascent
takes as many of these choices as help together.
"""

from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np

from flight_analysis.linear_loop.structured_value import RADIUS
from flight_analysis.linear_loop.uncertain_loop import Box, IntArray, plants_at
from flight_core.vectors import FloatArray
from rise_di_controller.law.linear_loop import (
    LinearLaw,
    LinearPlant,
    LoopTiming,
    zero_order_hold,
)

LENGTHS = range(1, 25)  # numbers of ticks of the sequences that are tried
STARTS = 3  # number of random sequences of each length from which the ascent starts
ROUNDS = 12  # largest number of rounds of the ascent
GAIN = 1e-9  # a choice helps if the mode grows by more than this fraction
# A mode is too slow for a delay if u changes by less than this fraction in a tick.
SLOW = 0.03
AT_ONE = 1e-3  # a mode counts as an integrator if it is at most this far from 1
STEP = 0.005  # fraction by which the size of a box falls from one attack to the next
# Largest number of attacks. It ends the search if every aircraft, down to the nominal one, leaves.
STEPS = 60
COUPLED = 1e-12  # smallest entry of a matrix that couples two states


class Ticks(NamedTuple):
    """The motion of an aircraft over a tick: a matrix for each choice of the late inputs."""

    maps: FloatArray  # (2^m, s, s)
    u: IntArray  # places of u of this tick among the states
    u_before: IntArray  # and of u of the tick before


class Attack(NamedTuple):
    """A periodic sequence of delays, and the growth of the loop's fastest mode under it."""

    growth: float  # factor over the whole sequence
    frequency: float  # rad a tick
    choices: IntArray  # index into `Ticks.maps` of each tick

    @property
    def is_unstable(self) -> bool:
        """Whether the loop is unstable if the sequence is repeated."""
        return self.growth > RADIUS ** len(self.choices)


class Leaving(NamedTuple):
    """An aircraft that a periodic sequence of delays makes unstable."""

    d: FloatArray  # (k,)
    frequency: float  # rad a tick
    late: tuple[tuple[bool, ...], ...]  # which inputs are late, tick by tick


def ticks_of(plant: LinearPlant, law: LinearLaw, loop: LoopTiming, late: float) -> Ticks:
    """Compute the motion over a tick. `late` is at most a period, s.

    The states are, in this order, x and the actuators, u of this tick, u of the tick before, any
    further u that is on its way, and the states of the law. A tick begins at the instant at which
    its u arrives if this u is in time, so the next u is computed within the tick.
    """
    n, m = plant.B.shape
    q, T = len(law.A), loop.period
    has_lag = loop.lag > 0.0
    rate = np.diag(np.where(has_lag, 1.0 / np.where(has_lag, loop.lag, 1.0), 1.0))
    motion = np.block([[plant.A, plant.B * has_lag], [np.zeros((m, n)), -rate]])
    drive = np.vstack([plant.B * ~has_lag, rate * has_lag])
    whole = int(np.floor(loop.delay / T + 1e-9))
    reading = (whole + 1) * T - loop.delay
    size = n + m + (2 + whole) * m + q
    x, u, u_before, on_way, xi = np.split(np.eye(size), np.cumsum([n + m, m, m, whole * m]), axis=0)
    maps = []
    for choice in range(2**m):
        is_late = (choice >> np.arange(m) & 1).astype(bool)[:, None]
        now, read = x, None
        cuts = sorted({0.0, late, reading, T})
        for begin, end in pairwise(cuts):
            transition, effect = zero_order_hold(motion, drive, end - begin)
            acts = np.where(is_late & (begin < late), u_before, u)
            now = transition @ now + effect @ acts
            read = now if end == reading else read
        assert read is not None  # noqa: S101 - the reading is a cut
        y = plant.C @ read[:n]
        queue = np.vstack([on_way, law.D @ y + law.C @ xi])
        maps.append(np.vstack([now, queue[:m], u, queue[m:], law.B @ y + law.A @ xi]))
    places = np.arange(n + m, n + 3 * m).reshape(2, m)
    return Ticks(np.array(maps), *places)


def loops_of(ticks: Ticks) -> list[Ticks]:
    """Split the states into strongly connected parts, and return the parts that contain inputs."""
    from scipy.sparse import csr_array  # noqa: PLC0415 - a flight starts without it
    from scipy.sparse.csgraph import connected_components  # noqa: PLC0415

    pattern = np.abs(ticks.maps).max(axis=0) > COUPLED
    count, label = connected_components(
        csr_array(pattern.astype(float)), directed=True, connection="strong"
    )
    parts = []
    for number in range(count):
        states = np.flatnonzero(label == number)
        both = np.isin(ticks.u, states) & np.isin(ticks.u_before, states)
        if both.any():
            u, before = (np.searchsorted(states, x[both]) for x in (ticks.u, ticks.u_before))
            parts.append(Ticks(ticks.maps[:, states[:, None], states], u, before))
    return parts


def ascended(ticks: Ticks, choices: IntArray) -> Attack:
    """Improve a sequence of delays until its fastest mode grows no further.

    `choices` has the index of a matrix for each tick.
    """
    attack, values = _attack(ticks, choices)
    for _ in range(ROUNDS):
        best = values.argmax(axis=1)
        gains = values.max(axis=1) - attack.growth
        order = np.argsort(-gains)
        count = int(np.sum(gains > GAIN * attack.growth))
        while count:
            changed = attack.choices.copy()
            changed[order[:count]] = best[order[:count]]
            other, its_values = _attack(ticks, changed)
            if other.growth > (1.0 + GAIN) * attack.growth:
                attack, values = other, its_values
                break
            count //= 2
        else:
            break
    return attack


def _attack(ticks: Ticks, choices: IntArray) -> tuple[Attack, FloatArray]:
    """Compute the fastest mode of a sequence, and the effect of every other choice at each tick.

    The second result, (ticks, choices), has to first order the size of the fastest mode if tick k
    gets choice c.
    """
    from scipy.linalg import eig  # noqa: PLC0415 - a flight starts without it

    sequence = ticks.maps[choices]
    total = np.eye(len(sequence[0]))
    for each in sequence:
        total = each @ total
    modes: Any = eig(total, left=True)
    z, left, right = modes
    moved = np.linalg.norm(right[ticks.u] - right[ticks.u_before], axis=0)
    is_fast = (moved > SLOW * np.linalg.norm(right[ticks.u], axis=0)) & (np.abs(z - 1.0) > AT_ONE)
    fastest = int(np.argmax(np.where(is_fast, np.abs(z), 0.0)))
    forward, backward = [right[:, fastest]], [left[:, fastest].conj()]
    for each in sequence:
        forward.append(each @ forward[-1])
    for each in sequence[::-1]:
        backward.append(backward[-1] @ each)
    across = backward[0] @ forward[0]
    values = np.abs(
        np.einsum("ka,cab,kb->kc", backward[-2::-1], ticks.maps, forward[:-1], optimize=True)
        / across
    )
    turns = [np.angle(np.vdot(x, y)) for x, y in pairwise(forward)]
    growth = float(np.abs(z[fastest])) if is_fast[fastest] else 0.0
    return Attack(growth, float(np.abs(np.mean(turns))), choices), values


def attacked(ticks: Ticks, known: IntArray | None = None) -> Attack | None:
    """Search for a sequence of delays that makes the loop unstable, or return None.

    The search starts from the sequence `known`, if it is given, and then from random sequences.
    """
    rng = np.random.default_rng(0)
    choices, parts = len(ticks.maps), loops_of(ticks)
    known_first = [] if known is None else [ascended(part, known) for part in parts]
    for attack in known_first:
        if attack.is_unstable:
            return attack
    for part in parts:
        for length in LENGTHS:
            for _ in range(STARTS):
                of_two = rng.choice(choices, 2)
                start = of_two[(rng.random(length) < rng.random()).astype(int)]
                if (attack := ascended(part, start)).is_unstable:
                    return attack
    return None


def nearest_leaving(
    plant: LinearPlant, law: LinearLaw, loop: LoopTiming, box: Box, late: float, d: FloatArray
) -> Leaving | None:
    """Search for an aircraft that deviates less than d and is unstable with late inputs.

    The search looks for a periodic sequence of delays that makes the aircraft unstable. `late` is
    at most a period, s. The aircraft lies in the direction of d, or of d with some of its signs
    changed. Returns None if none is found.
    """

    def ticks_at(d: FloatArray) -> Ticks:
        return ticks_of(plants_at(plant, box, d), law, loop, late)

    found: Leaving | None = None
    known: IntArray | None = None
    is_turned = False
    for _ in range(STEPS):
        nearer = (1.0 - STEP) * d
        attack = attacked(ticks_at(nearer), known)
        if attack is not None:
            d, known, is_turned = nearer, attack.choices, False
            bits = (known[:, None] >> np.arange(plant.B.shape[1]) & 1).astype(bool)
            found = Leaving(d, attack.frequency, tuple(map(tuple, bits.tolist())))
        elif known is None or is_turned:
            break
        else:
            # another corner may be worse for a sequence
            is_turned = True
            growth = _growth(ticks_at(d), known)
            for i in np.flatnonzero(d):
                turned = np.where(np.arange(len(d)) == i, -d, d)
                if (other := _growth(ticks_at(turned), known)) > growth:
                    d, growth = turned, other
    return found


def _growth(ticks: Ticks, choices: IntArray) -> float:
    return max(_attack(part, choices)[0].growth for part in loops_of(ticks))
