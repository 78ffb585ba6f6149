# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test the guarantee for every aircraft of a box against closed forms and corners.

Where it is installed, SLICOT is an independent reference.
"""

import itertools
import json
import os
import re
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from pytest import approx
from scipy.linalg import expm
from tests.conftest import invoke, refusing

from aircraft_sim.airframes.airframe import load_airframe
from flight_analysis.closed_loop.scenario_library import find_scenario
from flight_analysis.linear_loop import branch_and_bound
from flight_analysis.linear_loop import guarantee as guarantee_module
from flight_analysis.linear_loop.certificate import keep, kept_guarantee
from flight_analysis.linear_loop.guarantee import Guarantee, loop_guarantee, quick_guarantee
from flight_analysis.linear_loop.input_margins import input_margins
from flight_analysis.linear_loop.loop_margins import LinearLoop, box_of, margins, scenario_loop
from flight_analysis.linear_loop.structured_value import (
    Centre,
    Scaling,
    bound_at,
    is_below_one,
    least_bound,
)
from flight_analysis.linear_loop.uncertain_loop import (
    Box,
    plants_at,
    uncertain_loop,
)
from flight_analysis.linear_loop.worst_case import worst_in_box
from flight_analysis.report.html import write_loop_page
from flight_analysis.report.margin_figures import guarantee_text
from flight_cli import gains_guarantee
from flight_core.vectors import FloatArray
from rise_di_controller.law.linear_loop import LinearLaw, LinearPlant, LoopTiming, closed_loop

LIMIT = 1.0 + 1e-6  # abs(z) of the limit of stability
PERIOD = 0.01


def radii(linear: LinearLoop, d: FloatArray) -> FloatArray:
    """Return the spectral radii of the exact loops for some deviations, (N, k)."""
    assert linear.box is not None
    aircraft = plants_at(linear.nominal, linear.box, d)
    still = np.zeros(len(linear.inputs))
    matrices = closed_loop(aircraft, linear.law, linear.loop, still)
    return np.asarray(np.abs(np.linalg.eigvals(matrices)).max(axis=-1))


def boxed(name: str, uncertainty: float = 0.3) -> LinearLoop:
    scenario = find_scenario(name)
    frame = load_airframe(scenario.aircraft.airframe)
    linear = scenario_loop(scenario, scenario.controller)
    return linear._replace(box=box_of(frame, scenario.controller, uncertainty))


@cache
def servo_guarantee() -> Guarantee:
    return loop_guarantee(boxed("osprey_servo"))


def integrator(k: float, part: float) -> LinearLoop:
    """Return the loop of u = -k y around y_dot = (1 + d) u."""
    plant = LinearPlant(np.zeros((1, 1, 1)), np.ones((1, 1, 1)), np.eye(1))
    law = LinearLaw(np.zeros((0, 0)), np.zeros((0, 1)), np.zeros((1, 0)), np.array([[-k]]))
    box = Box(
        names=("B[y,u]",),
        part=np.array([part]),
        E=np.eye(1),
        F=np.zeros((1, 1)),
        G=np.array([[part]]),
        effectors=("u",),
        T=np.eye(1),
    )
    return LinearLoop(
        model="",
        states=("y",),
        outputs=("y",),
        inputs=("u",),
        plant=plant,
        law=law,
        loop=LoopTiming(np.zeros(1), 0.0, PERIOD),
        box=box,
    )


@pytest.mark.parametrize("k", [120.0, 150.0, 180.0])
def test_gain_of_integrator_may_rise_to_two_over_k_period(k: float) -> None:
    """The loop y+ = (1 - k T (1 + d)) y is unstable from d = 2 / (k T) - 1 on."""
    guarantee = loop_guarantee(integrator(k, 0.1))
    limit = 2.0 / (k * PERIOD) - 1.0
    # at most above by the 1e-6 of the limit of stability; below by the level's room of 0.4 %
    assert 0.99 * limit < guarantee.stable < limit * (1.0 + 1e-5)
    assert guarantee.unstable is not None
    assert guarantee.unstable.deviation == approx(limit, rel=1e-2)
    assert guarantee.unstable.frequency == approx(np.pi / PERIOD)


@pytest.mark.parametrize("most, proved", [(1e3, 10.0 / 3.0), (2.0, 2.0)])
def test_quick_proof_ends_below_the_limit_or_at_the_most_that_was_asked_for(
    most: float, proved: float
) -> None:
    """A quick proof ends below the limit, or at the size that was asked for.

    With k T = 1.5 the integrator is stable up to d = 1 / 3, which is 10 / 3 times its box of 0.1.
    """
    size = quick_guarantee(integrator(150.0, 0.1), most).stable / 0.1
    assert proved / (1.0 + guarantee_module.GAPS[0]) * 0.99 < size < proved * (1.0 + 1e-5)


def test_quick_proof_of_an_unstable_loop_is_none() -> None:
    assert quick_guarantee(integrator(250.0, 0.1), 1.0).stable == 0.0


def test_each_step_of_the_work_is_told() -> None:
    """Each size that is tried is told, and so the proved size is among them."""
    told: list[str] = []
    guarantee = loop_guarantee(integrator(150.0, 0.3), report=told.append)
    sizes = [float(text.split()[-2]) for text in told if text.startswith("proving every aircraft")]
    assert any(abs(size - 100.0 * guarantee.stable) <= 0.051 for size in sizes)
    assert told[0] == "searching for an unstable aircraft"
    assert told[-1].startswith("proving the disk margin of ")


def test_disk_margin_of_integrator_is_that_of_its_worst_gain() -> None:
    """The disk margin is the one of the largest gain.

    There S - 1/2 at pi / T is 1 / (1 - k T (1 + d) / 2) - 1/2, which is largest.
    """
    guarantee = loop_guarantee(integrator(120.0, 0.2))
    half = 120.0 * PERIOD * 1.2 / 2.0
    disk = 1.0 / (1.0 / (1.0 - half) - 0.5)
    assert 0.97 * disk < guarantee.disk["u"] < disk * (1.0 + 1e-5)
    assert guarantee.disk_all == approx(guarantee.disk["u"], rel=1e-9)


def test_unstable_nominal_loop_has_no_guarantee() -> None:
    guarantee = loop_guarantee(integrator(250.0, 0.1))
    assert not guarantee.is_proved
    assert guarantee.stable == 0.0
    assert not any(guarantee.disk.values())


def test_loop_without_box_is_refused() -> None:
    with refusing("uncertainty: found 0"):
        loop_guarantee(integrator(100.0, 0.1)._replace(box=None))


def test_bound_of_a_real_product_is_its_closed_form() -> None:
    """For real entries, mu of u v^T is sum abs(u_i v_i), because det = 1 - sum v_i delta_i u_i."""
    u = np.array([1.0, -2.0, 0.5, 3.0])
    v = np.array([0.3, 0.2, -4.0, 0.1])
    M = np.outer(u, v).astype(complex)
    value, scaling = least_bound(M, 4, 0.0)
    exact = float(np.abs(u * v).sum())
    assert (1.0 - 1e-12) * exact <= value < 1.003 * exact  # rounding of the eigenvalues
    assert value == approx(float(bound_at(M, scaling)), rel=1e-9)


def test_imaginary_scalar_has_no_real_perturbation() -> None:
    """det(1 - j delta) is never 0 for a real delta, and only G can show this."""
    M = np.array([[2j]])
    value, _ = least_bound(M, 1, 0.05)
    assert value < 0.05


def test_every_scaling_is_above_corners_of_small_matrices() -> None:
    """A corner for which M Delta has the eigenvalue 1 / size is a lower bound of mu."""
    rng = np.random.default_rng(4)
    signs = np.array(list(itertools.product((-1.0, 1.0), repeat=3)))
    for _ in range(20):
        M = rng.standard_normal((3, 3))
        values = np.linalg.eigvals(M * signs[:, None, :])
        real = np.abs(values[np.abs(values.imag) < 1e-12].real)
        value, _ = least_bound(M.astype(complex), 3, 0.0)
        assert value >= real.max(initial=0.0) * (1.0 - 1e-9)


def test_bound_below_one_is_that_of_the_eigenvalues() -> None:
    """The matrices have bounds around 1: all below it, all above it, or some of each."""
    rng = np.random.default_rng(4)
    M = rng.standard_normal((40, 5, 5)) + 1j * rng.standard_normal((40, 5, 5))
    scaling = Scaling(0.3 * rng.standard_normal(5), np.r_[rng.standard_normal(3), 0.0, 0.0])
    parts = np.asarray(np.linspace(0.0, 0.5, 40)[:, None, None] * M, dtype=np.complex128)
    expected = bound_at(parts, scaling) < 1.0
    assert 5 < expected.sum() < 35
    assert is_below_one(parts, scaling).tolist() == expected.tolist()
    for some in (expected, ~expected):
        assert is_below_one(parts[some], scaling).tolist() == expected[some].tolist()


def test_bound_is_that_of_slicot() -> None:
    slycot = pytest.importorskip("slycot", reason="GPL: an oracle where installed")
    rng = np.random.default_rng(7)
    for _ in range(5):
        M = rng.standard_normal((6, 6)) + 1j * rng.standard_normal((6, 6))
        kinds = np.array([1, 1, 1, 1, 2, 2])
        expected = slycot.ab13md(M, np.ones(6, int), kinds)[0]
        value, _ = least_bound(M, 4, 0.0)
        assert value < 1.005 * expected


@pytest.mark.parametrize("name", ["osprey_servo", "osprey_twin"])
def test_loop_with_entries_pulled_out_is_the_exact_loop(name: str) -> None:
    """Two Legendre coefficients neglect terms of the order (period rate)^4, which is 1e-5."""
    linear = boxed(name, 0.7)
    assert linear.box is not None
    d = np.sign(np.random.default_rng(1).standard_normal((20, len(linear.box.names))))
    uncertain = uncertain_loop(linear.nominal, linear.law, linear.loop, linear.box)
    pulled = uncertain.at(d).A
    sizes = np.abs(np.linalg.eigvals(pulled)).max(axis=-1)
    assert sizes == approx(radii(linear, d), abs=1e-5)


@pytest.mark.parametrize("late", [0.003, 0.012, 0.026])
def test_channels_of_a_delay_hold_each_constant_delay(late: float) -> None:
    """Any constant delay lies within the channels of the delay.

    For a delay of j + f periods, e_i is 1 for i < j, and e_j is 1 over the first f of a period. Two
    coefficients of each e_i are within its block, and the spectral radius is the one of the exact
    loop.
    """
    linear = boxed("osprey_servo", 0.5)
    assert linear.box is not None
    rng = np.random.default_rng(5)
    uncertain = uncertain_loop(linear.nominal, linear.law, linear.loop, linear.box, late)
    m, p = len(linear.inputs), uncertain.disks.start
    longest = late / linear.loop.period
    parts = np.minimum(longest - np.arange(np.ceil(longest)), 1.0)
    for delay in rng.uniform(0.0, longest, 5):
        f = np.clip(delay - np.arange(len(parts)), 0.0, parts) / parts
        mean, second = 2.0 * f - 1.0, -2.0 * np.sqrt(3.0) * f * (1.0 - f)
        assert (mean**2 + second**2 <= 1.0 + 1e-12).all()
        d = np.sign(rng.standard_normal(len(linear.box.names)))
        delta = np.diag(np.r_[np.tile(d, 2), np.repeat(mean, m), np.zeros(m * len(parts))])
        block = np.arange(uncertain.uncertain, uncertain.uncertain + m * len(parts))
        delta[block + len(block), block] = np.repeat(second, m)
        W, Z, D = uncertain.W[:, :p], uncertain.Z[:p], uncertain.D[:p, :p]
        pulled = uncertain.A + W @ delta @ np.linalg.solve(np.eye(p) - D @ delta, Z)
        loop = linear.loop._replace(delay=linear.loop.delay + delay * linear.loop.period)
        exact = radii(linear._replace(loop=loop), d[None])[0]
        # the pulse of a part of a period has further coefficients: their effect is of the order
        # (period rate)^2 of the delay alone
        assert np.abs(np.linalg.eigvals(pulled)).max() == approx(exact, abs=1e-4)


def test_guarantee_with_a_late_input_is_below_each_constant_delay() -> None:
    """No gain of the box and no delay within the limit makes the loop u = -k y unstable."""
    linear = integrator(60.0, 0.1)
    in_time = loop_guarantee(linear)
    guarantee = loop_guarantee(linear, 0.01)
    assert guarantee.is_proved
    assert guarantee.stable < in_time.stable
    assert guarantee.disk_all < in_time.disk_all
    assert guarantee.unstable is not None
    # z^2 - z + k T (1 + d) of a period of delay: 0.6 (1 + d) = 1
    assert guarantee.unstable.deviation == approx(1.0 / 0.6 - 1.0, rel=1e-2)
    d = np.linspace(-1.0, 1.0, 9)[:, None] * guarantee.stable / 0.1
    for delay in np.linspace(0.0, 0.01, 9):
        loop = linear.loop._replace(delay=linear.loop.delay + delay)
        assert (radii(linear._replace(loop=loop), d) <= LIMIT).all()
    # the D of what changes in time is one for all frequencies, which leaves a quarter
    assert guarantee.stable > guarantee.unstable.deviation / 1.37


def oscillator(law: tuple[float, float]) -> LinearLoop:
    """Return the loop of u = law y around an oscillator of 200 rad/s with a damping of 0.05.

    Its gain is uncertain by 1 %.
    """
    w = 200.0
    A = np.array([[0.0, 1.0], [-w * w, -0.1 * w]])
    plant = LinearPlant(A[None], np.array([[[0.0], [w * w]]]), np.eye(2))
    none = np.zeros((0, 0))
    gains = LinearLaw(none, np.zeros((0, 2)), np.zeros((1, 0)), np.array([law]))
    box = Box(
        names=("B[v,u]",),
        part=np.array([0.01]),
        E=np.array([[0.0], [1.0]]),
        F=np.zeros((1, 2)),
        G=np.array([[0.01 * w * w]]),
        effectors=("u",),
        T=np.eye(1),
    )
    return integrator(1.0, 0.01)._replace(
        states=("x", "v"), outputs=("x", "v"), plant=plant, law=gains, box=box
    )


def test_guarantee_with_a_late_input_holds_for_a_delay_that_changes() -> None:
    """A delay that changes can destabilise a loop that is stable for each constant delay.

    The delay alternates between 0 and a period, and the constant delays reach up to a period.
    """
    linear = oscillator((0.5446, 0.00031))
    for delay in np.linspace(0.0, PERIOD, 21):
        loop = linear.loop._replace(delay=delay)
        assert radii(linear._replace(loop=loop), np.zeros((1, 1)))[0] < 0.995
    # the motion over a tick, x and u before: with this u, and with that of the tick before
    plant = linear.plant
    step = expm(PERIOD * np.block([[plant.A[0], plant.B[0]], [np.zeros((1, 3))]]))
    law = linear.law.D
    this = np.block(
        [[step[:2, :2] + step[:2, 2:] @ law, np.zeros((2, 1))], [law, np.zeros((1, 1))]]
    )
    before = np.block([[step[:2]], [law, np.zeros((1, 1))]])
    sequence = (this, before, before, this, before, before, before)
    growth = np.abs(np.linalg.eigvals(np.linalg.multi_dot(sequence))).max()
    assert growth > 1.05
    assert loop_guarantee(linear, PERIOD).stable == 0.0
    # a fifth of the gains leaves the box stable
    assert loop_guarantee(oscillator((0.1089, 0.000062)), PERIOD).is_proved


def test_size_between_two_gaps_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    """Sizes up to 0.7 of the least unstable one can be proved here.

    The gaps of 0.32 and 0.64 alone would find 0.61.
    """
    monkeypatch.setattr(
        guarantee_module, "_proof", lambda _, size, *__, **___: [] if size <= 0.7 else None
    )
    proved, _ = guarantee_module._proved([], 1.0, disks=False)
    assert 0.69 < proved <= 0.7


def test_bound_from_zero_holds_where_a_delay_has_no_effect() -> None:
    """A constant delay has no effect at 0 rad/s, so the scaling for 0 does not treat its channels.

    For c172p with u up to 10 ms late, the proved limit had been 33 %, while the least unstable
    aircraft was at 76 %. If the delay may change at each tick, a search over delays of 0 and 10 ms
    finds one at 73.6 %.
    """
    c172p = find_scenario("jsbsim_c172p")
    guarantee = loop_guarantee(scenario_loop(c172p, c172p.controller, 1, 0.3), 0.01)
    assert guarantee.unstable is not None
    assert guarantee.unstable.deviation / 1.4 < guarantee.stable < guarantee.unstable.deviation


def test_no_corner_is_unstable_or_has_less_than_guaranteed() -> None:
    linear = boxed("osprey_servo")
    assert linear.box is not None
    guarantee = servo_guarantee()
    # SLICOT's bound of the whole box is 0.732; an unstable aircraft exists at 0.744
    assert 0.732 < guarantee.stable < 0.745
    assert guarantee.unstable is not None
    # a slow divergence at 0 rad/s, which a search by abs(z) alone misses
    assert guarantee.stable < guarantee.unstable.deviation < 1.02 * guarantee.stable
    corners = np.sign(np.random.default_rng(3).standard_normal((2000, len(linear.box.names))))
    assert (radii(linear, corners * guarantee.stable / 0.3) <= LIMIT).all()
    margins = input_margins(
        plants_at(linear.nominal, linear.box, corners[:40]), linear.law, linear.loop
    )
    assert (margins.disk >= list(guarantee.disk.values())).all()
    assert (margins.disk_all >= guarantee.disk_all).all()


@pytest.mark.usefixtures("coarse")
def test_first_unstable_aircraft_is_the_nearest_that_a_search_found() -> None:
    """An independent program found an unstable aircraft at 74.8 %.

    It follows the exponential of each aircraft uphill. A search that only uses slopes had ended at
    76.6 %.
    """
    linear = boxed("osprey_observer")
    guarantee = loop_guarantee(linear)
    assert guarantee.unstable is not None
    assert guarantee.unstable.deviation < 0.748
    assert linear.box is not None
    d = np.array([guarantee.unstable.entries.get(name, 0.0) for name in linear.box.names])
    assert radii(linear, (d / linear.box.part)[None])[0] > LIMIT


def test_guarantee_says_what_is_exact_in_every_aircraft() -> None:
    """The rows of the angles and gravity are exact, and the text says no more than is proved."""
    text = guarantee_text(servo_guarantee())
    assert "the linear loop is stable for every aircraft within 74." in text[0]
    kinematic = "A[V,theta], A[theta,q], A[beta,phi], A[phi,p], A[phi,r]"
    assert text[1].endswith(f"{kinematic}, lags, delay, period, each entry that is 0")
    assert "no mode grows by more than 1e-6 a tick" in text[1]
    late = guarantee_text(loop_guarantee(integrator(60.0, 0.1), 0.01))
    assert ", u up to 10 ms late (certificate " in late[0]


def test_factor_with_a_nan_is_not_inside() -> None:
    """A Cholesky factor of NaN raises no error, and every comparison with NaN is false."""
    N = np.diag([0.1 + 0.0j, 0.1])
    assert Centre(np.ones(2), np.zeros(2), np.eye(2)).is_inside(N, 1.0)
    for d, g in ((np.nan, 0.0), (1.0, np.nan)):
        assert not Centre(np.array([d, 1.0]), np.array([g, 0.0]), np.eye(2)).is_inside(N, 1.0)
    assert not Centre(np.ones(2), np.zeros(2), np.eye(2)).is_inside(N * complex("nan"), 1.0)


def test_search_is_at_or_below_corners() -> None:
    """The search finds figures at or below those of 150 corners.

    Its disk margin is the one of the bound.
    """
    linear = boxed("osprey_observer")
    assert linear.box is not None
    search = worst_in_box(linear.nominal, linear.law, linear.loop, linear.box)
    corners = np.sign(np.random.default_rng(8).standard_normal((150, len(linear.box.names))))
    samples = input_margins(
        plants_at(linear.nominal, linear.box, corners), linear.law, linear.loop
    ).worst()
    for name in ("phase", "gain", "disk", "disk_all", "damping"):
        # a walk may end at a corner beside the least one: by less than a printed digit
        assert (getattr(search.worst, name) <= 1.001 * getattr(samples, name)).all(), name
    # an aircraft of 29.6 deg, beside 29.62 at the least of 1,500 corners, lies within 30 %
    assert np.degrees(search.worst.phase.min()) == approx(29.61, abs=0.1)


def test_search_over_two_entries_is_brute_force() -> None:
    linear = integrator(100.0, 0.3)
    box = Box(
        names=("A[y,y]", "B[y,u]"),
        part=np.array([0.3, 0.3]),
        E=np.ones((1, 2)),
        F=np.array([[-0.6], [0.0]]),
        G=np.array([[0.0], [0.3]]),
        effectors=("u",),
        T=np.eye(1),
    )
    plant = LinearPlant(np.array([[-2.0]]), np.ones((1, 1)), np.eye(1))
    search = worst_in_box(plant, linear.law, linear.loop, box)
    grid = np.array(list(itertools.product(np.linspace(-1.0, 1.0, 9), repeat=2)))
    brute = input_margins(plants_at(plant, box, grid), linear.law, linear.loop).worst()
    assert search.worst.phase == approx(brute.phase, rel=1e-6)
    assert search.worst.disk == approx(brute.disk, rel=1e-3)


def test_report_shows_the_guarantee_that_was_computed_for_its_loop(tmp_path: Path) -> None:
    linear = integrator(150.0, 0.1)
    assert kept_guarantee(linear) is None
    guarantee = loop_guarantee(linear)
    keep(guarantee._replace(late=0.01))  # a report speaks of u in time
    assert kept_guarantee(linear) is None
    keep(guarantee)
    again = kept_guarantee(linear)
    assert again is not None
    assert guarantee_text(again) == guarantee_text(guarantee)
    write_loop_page(tmp_path / "loop.html", "loop", linear)
    assert guarantee_text(guarantee)[0] in (tmp_path / "loop.html").read_text()
    assert kept_guarantee(integrator(151.0, 0.1)) is None  # another gain
    box = linear.box
    assert box is not None
    half = box._replace(part=0.5 * box.part, F=0.5 * box.F, G=0.5 * box.G)
    assert kept_guarantee(linear._replace(box=half)) is not None  # the guarantee says its size
    skewed = box._replace(G=box.G * np.linspace(1.0, 2.0, len(box.G))[:, None] + 1.0)
    assert kept_guarantee(linear._replace(box=skewed)) is None  # other aircraft
    assert kept_guarantee(linear._replace(box=None)) is None
    (file,) = Path(os.environ["XDG_CACHE_HOME"], "rise-di", "guarantees").iterdir()
    file.write_text("{")
    assert kept_guarantee(linear) is None


@pytest.mark.usefixtures("coarse")
def test_command_fails_below_uncertainty_and_writes_unstable_aircraft(tmp_path: Path) -> None:
    """The nearest unstable aircraft is inside the box, and one 1.2 times as far off is outside."""
    folder = tmp_path / "first"
    arguments = ["gains", "guarantee", "osprey", "--uncertainty", "0.75"]
    arguments += ["--worst", str(folder), "--samples", "1"]
    result = invoke(*arguments)
    assert result.exit_code == 1, result.output
    said = " ".join(result.output.split())
    assert re.search(r"scenario\.yaml, 74\.\d % off, inside the 75 % of --uncertainty", said), said
    farther = r"farther_scenario\.yaml, 89\.\d % off, outside the 75 % of --uncertainty"
    assert re.search(farther, said), said
    assert not margins(find_scenario(str(folder / "farther_scenario.yaml"))).nominal.stable
    assert not margins(find_scenario(str(folder / "scenario.yaml"))).nominal.stable


def test_frequency_without_proof_leaves_no_guarantee_and_no_error(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Rounding can leave no interval around a frequency, as for a flying wing near its limit."""
    monkeypatch.setattr(branch_and_bound, "interval_at", lambda *_: None)
    monkeypatch.setattr(guarantee_module, "BOXES", 20)
    monkeypatch.setattr(guarantee_module, "FEWER_BOXES", 20)
    guarantee = loop_guarantee(integrator(150.0, 0.1))
    assert guarantee.stable == 0.0
    assert not guarantee.is_proved


def test_command_bounds_the_effectors_behind_an_allocation(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """An elevon acts on q and on p at the same time.

    The box of the airframe file is larger than the one of the law's inputs, so that an unstable
    aircraft is found at a smaller size.
    """
    asked: list[LinearLoop] = []

    def unproved(linear: LinearLoop, late: float, report: object) -> Guarantee:
        asked.append(linear)
        return guarantee_module._none(linear, late)

    monkeypatch.setattr(gains_guarantee, "loop_guarantee", unproved)
    words = ["gains", "guarantee", "x8_elevons", "--scenario", "x8_elevons", "--json"]
    run = invoke(*words, "--samples", "2")
    assert run.exit_code == 1
    assert not json.loads(run.output)["guarantee"]["holds"]
    assert kept_guarantee(boxed("x8_elevons")) is not None  # of the same loop and box
    assert asked[0].digest == boxed("x8_elevons").digest
