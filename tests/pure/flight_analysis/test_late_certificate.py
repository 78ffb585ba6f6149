# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test the certificate of a guarantee with a late u, and sequences of delays."""

import copy
import json
from pathlib import Path

import numpy as np
import pytest
from numpy.polynomial.legendre import Legendre
from numpy.typing import NDArray
from pytest import approx
from scipy.linalg import expm
from tests.pure.flight_analysis.test_altered_certificates import both, drop, put, times
from tests.pure.flight_analysis.test_certificate import Content, _checker, loop_of, run, signed

from flight_analysis.linear_loop import guarantee as guarantee_module
from flight_analysis.linear_loop.certificate import certificate
from flight_analysis.linear_loop.guarantee import Guarantee, loop_guarantee
from flight_analysis.linear_loop.late_sequences import nearest_leaving, ticks_of
from flight_analysis.linear_loop.loop_margins import LinearLoop
from flight_analysis.linear_loop.structured_value import RADIUS
from flight_analysis.linear_loop.uncertain_loop import plants_at
from flight_core.vectors import FloatArray
from rise_di_controller.law.linear_loop import LinearPlant, closed_loop

pytestmark = pytest.mark.slow

LATE = 0.01  # s, a period
CORNER = np.array([-1, 1, 1, -1, -1, 1, 1, -1, *[0] * 9, -1, -1, -1, -1, 1, 0, 0, 0, 0])
"""Signs of an aircraft that a delay of all inputs by 10 ms makes unstable from 59.9 % on."""


@pytest.fixture(scope="module")
def observer() -> LinearLoop:
    return loop_of("osprey_observer")


@pytest.fixture(scope="module")
def guarantee(observer: LinearLoop) -> Guarantee:
    """Return what is proved with a gap of a fifth, without disks and without finer steps."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(guarantee_module, "GAPS", (0.2,))
        patch.setattr(guarantee_module, "HALVINGS", 0)
        return loop_guarantee(observer, LATE)


@pytest.fixture(scope="module")
def content(observer: LinearLoop, guarantee: Guarantee) -> Content:
    found: Content = json.loads(certificate(observer, guarantee, {}))
    return found


def test_checker_proves_a_guarantee_with_a_late_u(
    content: Content, guarantee: Guarantee, tmp_path: Path
) -> None:
    done = run(content, tmp_path)
    assert done.returncode == 0, done.stderr
    assert f") {np.floor(1e3 * guarantee.stable) / 10.0:g} %" in done.stdout
    assert "late: each input by 0 to 0.01 s, by another time at each tick" in done.stdout
    assert "the newest u that has arrived acts" in done.stdout


def _until(change: float, begin: float, end: float, degrees: int) -> FloatArray:
    """Return the coefficients of a signal that is 1 before the time `change` and -1 after it."""
    part = np.clip((change - begin) / (end - begin), 0.0, 1.0)
    integrals = [Legendre.basis(i, [0, 1]).integ(lbnd=0) for i in range(degrees)]
    return np.array(
        [(2 * i + 1) * (2.0 * P(part) - P(1.0)) for i, P in enumerate(integrals)], dtype=np.float64
    )


@pytest.mark.parametrize("late", [0.003, 0.01, 0.012, 0.026])
@pytest.mark.parametrize("delay", [0.0, 0.003, 0.017])
def test_channels_of_the_checker_hold_each_delay_of_each_input(
    delay: float, late: float, observer: LinearLoop, tmp_path: Path
) -> None:
    """With constant delays that differ by input, the modes are those of the exact loop."""
    module, rng = _checker(), np.random.default_rng(4)
    linear = observer._replace(loop=observer.loop._replace(delay=delay))
    period, m = linear.loop.period, len(linear.inputs)
    places = range(m * int(np.ceil(late / period - 1e-9)))
    proof = [{"entries": [0], "steps": [], "levels": [(place, 0.0) for place in places]}]
    bare = guarantee_module._none(linear, late)._replace(stable=0.3, proof=proof)
    path = tmp_path / "certificate.json"
    path.write_text(certificate(linear, bare, {}))
    file = module.read(path)
    loop, parts = module.loop_of(file), module.parts_late(file)
    ticks = int(delay / period + 1e-9)
    split = delay / period - ticks
    w, n, k = loop.channels, loop.states, len(loop.K)
    assert linear.box is not None
    for f in (np.zeros(m), np.full(m, late), rng.uniform(0.0, late, m)):
        d = 0.3 / linear.box.part.max() * np.sign(rng.standard_normal(k))
        delta = np.zeros((w.stop - n, w.stop - n))
        delta[: module.TERMS * k, : module.TERMS * k] = np.diag(np.tile(d, module.TERMS))
        at = module.TERMS * k
        for segment in module.segments_of(split, ticks, parts):
            begin = round(segment.begin - split, 9) % 1.0
            length = segment.end - segment.begin
            for j in range(len(segment.parts)):
                for one in f:
                    e = _until(one / period - j, begin, begin + length, len(module.GAUSS))
                    values = Legendre(e, [-1, 1])(module.GAUSS) * np.sqrt(module.WEIGHTS / 2.0)
                    assert np.linalg.norm(values) <= 1.0 + 1e-9
                    delta[at : at + len(values), at] = values
                    at += len(values)
        big = loop.big[: w.stop, : w.stop]
        z = np.linalg.solve(np.eye(len(delta)) - big[w, w] @ delta, big[w, :n])
        found = np.linalg.eigvals(big[:n, :n] + big[:n, w] @ delta @ z)
        aircraft = plants_at(linear.nominal, linear.box, d)
        modes = np.linalg.eigvals(closed_loop(aircraft, linear.law, linear.loop, f))
        # integrators are modes at 1, several times, which rounding moves
        for mode in modes[(np.abs(modes) > 0.3) & (np.abs(modes - 1.0) > 1e-3)]:
            assert np.abs(found - mode).min() == approx(0.0, abs=1e-9)


ROWS = "a row for each of"
LATER = {
    "a time over a second period without its row": (put(0.0101, "late", "time"), ROWS),
    "two periods": (
        both(put(0.02, "late", "time"), put([[1.2, 0.8, -0.8, -1.2]] * 2, "late", "t")),
        "not proved at",
    ),
    "a row too many": (put([[1.2, 0.8, -0.8, -1.2]] * 2, "late", "t"), ROWS),
    "no row": (put([], "late", "t"), ROWS),
    "an input without t": (put([[1.2, 0.8, -0.8]], "late", "t"), "expected 4 values"),
    "an input weighed otherwise": (put(3.0, "late", "t", 0, 0), "not proved at"),
    "all inputs weighed otherwise": (put([[4.0] * 4], "late", "t"), "not proved at"),
    "a t that is not finite": (put(float("nan"), "late", "t", 0, 0), "found NaN"),
    "a t out of range": (put(1e3, "late", "t", 0, 0), "a number from -100 to 100"),
    "no time": (drop("late", "time"), "found ['t'], expected time, t"),
    "no t": (drop("late", "t"), "found ['time'], expected time, t"),
    "a time of 0": (put(0.0, "late", "time"), "a number from 1e-06 to 1"),
    "a negative time": (put(-0.01, "late", "time"), "a number from 1e-06 to 1"),
    "a time in words": (put("0.01", "late", "time"), "a number from 1e-06 to 1"),
    "an unknown member": (put(0.0, "late", "least"), "found ['least']"),
    "another t of the entries": (times(0.9, "parts", 0, "steps", 0, "t", 0), "not proved at"),
    "a larger box": (times(1.2, "size"), "not proved at"),
    "a longer delay": (put(0.01, "delay"), "not proved at"),
    "limits beside it": (
        put(
            {"input": "elevator", "slowest": 0.1, "lags": [1.0], "taps": [0.5]},
            "limit",
        ),
        "none beside it",
    ),
}


@pytest.mark.parametrize("name", LATER)
def test_altered_certificate_with_a_late_u_is_refused(
    name: str, content: Content, tmp_path: Path
) -> None:
    alter, reason = LATER[name]
    altered = copy.deepcopy(content)
    alter(altered)
    done = run(signed(altered), tmp_path)
    assert done.returncode == 1, done.stdout
    assert reason in done.stderr


def test_part_with_exact_entries_alone_has_no_certificate(
    observer: LinearLoop, guarantee: Guarantee
) -> None:
    """The checker proves steps of boxes, so a part without entries has no certificate."""
    proof = [*guarantee.proof, {"entries": [], "steps": [], "levels": [(0, 0.0)]}]
    with pytest.raises(ValueError, match="a part with exact entries alone"):
        certificate(observer, guarantee._replace(proof=proof), {})


class Ticks:
    """The motion of an aircraft from tick to tick, by exponentials, with each u late or in time.

    The states are x, the actuators, u of the last two ticks, and the law. A u in time acts 3 ms
    after its tick, and a late one acts a period later.
    """

    def __init__(self, plant: LinearPlant, linear: LinearLoop) -> None:
        n, m, q = len(plant.A), len(linear.inputs), len(linear.law.A)
        rate = np.diag(1.0 / linear.loop.lag)
        motion = np.block([[plant.A, plant.B], [np.zeros((m, n)), -rate]])
        drive = np.vstack([np.zeros((n, m)), rate])
        still = np.zeros((m, n + 2 * m))
        held = np.vstack([np.hstack([motion, drive]), still])
        delay, law = linear.loop.delay, linear.law
        self.before, self.behind = (expm(held * s) for s in (delay, linear.loop.period - delay))
        size = n + m
        self.x = np.eye(size, size + 2 * m + q)
        u_now = np.hstack([law.D @ plant.C, np.zeros((m, 3 * m)), law.C])
        self.u = [u_now, *np.split(np.eye(2 * m, size + 2 * m + q, size), 2)]
        xi = np.hstack([law.B @ plant.C, np.zeros((q, 3 * m)), law.A])
        self.rest = np.vstack([*self.u[:2], xi])

    def growth(self, is_late: NDArray[np.bool_]) -> float:
        """Return the spectral radius of a period of a sequence of ticks, (ticks, inputs)."""
        total = np.eye(self.x.shape[1])
        for now, last in zip(is_late, np.roll(is_late, 1, axis=0), strict=True):
            x = self.x
            for over, late, (new, old) in (
                (self.before, last, self.u[1:]),
                (self.behind, now, self.u[:2]),
            ):
                u = np.where(late[:, None], old, new)
                x = (over @ np.vstack([x, u]))[: len(x)]
            total = np.vstack([x, self.rest]) @ total
        return float(np.abs(np.linalg.eigvals(total)).max())


def test_sequences_of_delays_inside_a_certificate_are_stable_and_one_outside_leaves(
    observer: LinearLoop, guarantee: Guarantee
) -> None:
    """The sequence outside was found by a search.

    Its aircraft is stable for each constant delay.
    """
    rng, box = np.random.default_rng(6), observer.box
    assert box is not None
    for _ in range(300):
        d = guarantee.stable / box.largest * np.sign(rng.standard_normal(len(box.names)))
        ticks = Ticks(plants_at(observer.nominal, box, d), observer)
        sequence = rng.random((int(rng.integers(1, 9)), 4)) < rng.random()
        assert ticks.growth(sequence) <= RADIUS ** len(sequence)
    aircraft = plants_at(observer.nominal, box, 0.59 / box.largest * CORNER)
    leaving = np.zeros((23, 4), dtype=np.bool_)
    leaving[:, 0] = [late == "1" for late in "11011111011111011110111"]
    leaving[[5, 11], 3] = True
    ticks = Ticks(aircraft, observer)
    assert ticks.growth(leaving) > 1.04
    for late in np.ndindex(2, 2, 2, 2):
        assert ticks.growth(np.array([late]) > 0) <= RADIUS
    for delay in np.linspace(0.0, LATE, 5):
        exact = closed_loop(aircraft, observer.law, observer.loop, np.full(4, delay))
        assert np.abs(np.linalg.eigvals(exact)).max() <= RADIUS


@pytest.mark.parametrize(("delay", "late"), [(0.0, 0.01), (0.003, 0.01), (0.017, 0.006)])
def test_ticks_of_the_search_are_the_exact_loop(
    delay: float, late: float, observer: LinearLoop
) -> None:
    """If a choice of late inputs is kept, these inputs have a constant delay."""
    timing = observer.loop._replace(delay=delay)
    ticks = ticks_of(observer.nominal, observer.law, timing, late)
    assert len(ticks.maps) == 16
    for choice in (0, 1, 6, 15):
        extra = np.array([late * (choice >> i & 1) for i in range(4)], dtype=np.float64)
        modes = np.linalg.eigvals(closed_loop(observer.nominal, observer.law, timing, extra))
        found = np.linalg.eigvals(ticks.maps[choice])
        for mode in modes[(np.abs(modes) > 0.3) & (np.abs(modes - 1.0) > 1e-3)]:
            assert np.abs(found - mode).min() == approx(0.0, abs=1e-9)


def test_search_finds_a_sequence_that_leaves_below_each_constant_delay(
    observer: LinearLoop,
) -> None:
    """The sequence leaves by exponentials that were computed independently.

    For a slightly smaller deviation it stays.
    """
    box = observer.box
    assert box is not None
    d = 0.599 / box.largest * CORNER
    found = nearest_leaving(observer.nominal, observer.law, observer.loop, box, LATE, d)
    assert found is not None
    assert np.abs(found.d).max() * box.largest < 0.585
    sequence = np.array(found.late)
    ticks = Ticks(plants_at(observer.nominal, box, found.d), observer)
    assert ticks.growth(sequence) > RADIUS ** len(sequence)
    nearer = Ticks(plants_at(observer.nominal, box, 0.98 * found.d), observer)
    assert nearer.growth(sequence) <= RADIUS ** len(sequence)
    constant = np.array([[False] * 4, [True] * 4])
    assert all(ticks.growth(delay[None]) <= RADIUS for delay in constant)
