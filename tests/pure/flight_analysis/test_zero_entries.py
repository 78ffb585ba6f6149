# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test entries that are 0 in the file: their rows, their box, guarantee and certificate."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pytest import approx
from scipy.linalg import expm
from tests.conftest import invoke, refusing
from tests.pure.flight_analysis.test_altered_certificates import Alter, drop, put, times
from tests.pure.flight_analysis.test_certificate import Content, run, signed
from tests.pure.flight_analysis.test_guarantee import integrator

import rise_di
from aircraft_sim.airframes.airframe import Airframe, load_airframe
from aircraft_sim.uncertainty import Spread, row_sizes, sampled_matrices, with_entries
from flight_analysis.closed_loop.scenario_library import find_scenario
from flight_analysis.linear_loop.certificate import certificate, keep, kept_guarantee
from flight_analysis.linear_loop.guarantee import loop_guarantee, zeros_alone
from flight_analysis.linear_loop.loop_margins import LinearLoop, box_of, scenario_loop
from flight_analysis.linear_loop.uncertain_loop import plants_at
from flight_analysis.report.margin_figures import guarantee_text

K = 20.0  # 1/s, gain of the integrator
ROW = 40.0  # 1/s, row of its A[y,y], which is 0

FRAME: dict[str, Any] = {
    "name": "two inputs",
    "source": "a test",
    "speed": 20.0,
    "states": {"V": "m/s", "q": "deg/s", "theta": "deg"},
    "inputs": {
        "elevator": {"unit": "deg", "positive": "nose up"},
        "thrust": {"unit": "N", "positive": "more thrust", "no_thrust": -5.0},
    },
    "outputs": ["q", "V"],
    "A": [[-0.1, 0.0, 0.0], [0.0, -3.0, 0.0], [0.0, 1.0, 0.0]],
    "B": [[0.0, 0.4], [7.0, 0.0], [0.0, 0.0]],
    "gravity": [{"into": "V", "angle": "theta", "gain": -9.81}],
}


# One channel: B[alpha,elevator] is 0, and A[theta,q] is exact.
ONE_CHANNEL = FRAME | {
    "states": {"alpha": "rad", "q": "rad/s", "theta": "rad"},
    "inputs": {"elevator": {"unit": "rad", "positive": "nose up"}},
    "outputs": ["q"],
    "A": [[-0.9, 0.97, 0.0], [-2.6, -1.4, 0.0], [0.0, 1.0, 0.0]],
    "B": [[0.0], [7.0], [0.0]],
    "gravity": [],
}


def with_zero(part: float = 0.3, zero: float = 0.1) -> LinearLoop:
    """Return y_dot = a y + (1 + d) u with u = -K y.

    The entry a is 0 in the file, and uncertain by `zero` of ROW.
    """
    linear = integrator(K, part)
    assert linear.box is not None
    box = linear.box._replace(
        names=("B[y,u]", "A[y,y]"),
        part=np.array([part, zero]),
        E=np.ones((1, 2)),
        F=np.array([[0.0], [zero * ROW]]),
        G=np.array([[part], [0.0]]),
        zeros=("A[y,y]",),
    )
    return linear._replace(box=box)


@pytest.fixture(scope="module")
def content() -> Content:
    linear = with_zero()
    content: Content = json.loads(certificate(linear, loop_guarantee(linear), {}))
    return content


def test_row_is_what_the_largest_entry_of_a_row_does_at_the_sizes() -> None:
    """Row V has 0.4 N^-1 times a fifth of 5 N, and row q has 7 1/s^2 times 0.1 rad."""
    frame = Airframe.validate_mapping(FRAME, "frame")
    sizes = row_sizes(frame)
    V, q = 0.4 * 1.0, 7.0 * 0.1
    assert sizes["A"] == approx(np.array([[0.0, V / 0.1, 0.0], [q, 0.0, 0.0], [0.0, 0.0, 0.0]]))
    assert sizes["B"] == approx(np.array([[V / 0.1, 0.0], [0.0, q / 1.0], [0.0, 0.0]]))


def test_input_of_unknown_size_has_no_part_in_a_row() -> None:
    """Without `no_thrust` a newton has no size.

    Then the zero of this input stays 0, and row V is the one of A.
    """
    thrust = {key: value for key, value in FRAME["inputs"]["thrust"].items() if key != "no_thrust"}
    inputs = FRAME["inputs"] | {"thrust": thrust}
    sizes = row_sizes(Airframe.validate_mapping(FRAME | {"inputs": inputs}, "frame"))
    assert sizes["B"][1, 1] == 0.0
    assert sizes["A"][0, 1] == approx(0.1 / 0.1)


def test_aircraft_of_a_corner_is_the_one_of_the_same_deviations() -> None:
    """The box, a file and a random draw agree on what a part of a row is."""
    frame, scenario = load_airframe("osprey"), find_scenario("osprey_servo")
    spread = Spread({"B[q,thrust]": 0.3}, "corners", zeros=0.2)
    box = box_of(frame, scenario.controller, 0.1, spread)
    assert (len(box.names), len(box.zeros)) == (60, 34)
    assert (box.largest, box.largest_zero) == (0.1, 0.3)
    d = np.where(np.arange(60) % 3 == 0, -1.0, 1.0)
    linear = scenario_loop(scenario, scenario.controller)
    boxed = plants_at(linear.nominal, box, d)
    written = with_entries(frame, dict(zip(box.names, d * box.part, strict=True)))
    assert boxed.A - frame.matrix_gravity() == approx(written.matrix_a(), rel=1e-12)
    columns = [list(frame.inputs).index(name) for name in scenario.controller.inputs]
    assert np.allclose(boxed.B, written.matrix_b()[:, columns], rtol=1e-12, atol=0.0)
    A, B = sampled_matrices(frame, 0.1, 0.1, 1, 0, 3, spread)
    sizes = row_sizes(frame)
    for drawn, published, size in zip(
        (A, B), (frame.matrix_a(), frame.matrix_b()), sizes.values(), strict=True
    ):
        parts = np.abs(drawn[:, size > 0.0] / size[size > 0.0])
        assert set(parts.ravel().round(12)) <= {0.2, 0.3}
        assert not drawn[:, (published == 0.0) & (size == 0.0)].any()
    # without zeros the draws are those that they were
    before = sampled_matrices(frame, 0.1, 0.1, 1, 0, 3, spread._replace(entries={}, zeros=0.0))
    assert np.array_equal(before[0][:, frame.matrix_a() != 0.0], A[:, frame.matrix_a() != 0.0])


def test_zero_alone_goes_up_to_the_closed_form() -> None:
    """With a held u, y_dot = a y - K y is unstable from a = K on, which is half of the row."""
    alone = zeros_alone(with_zero(part=0.0, zero=1.0))
    assert alone is not None
    limit = K / ROW
    assert 0.92 * limit < alone.stable < limit * (1.0 + 1e-4)
    assert alone.unstable is not None
    assert alone.unstable.deviation == approx(limit, rel=1e-2)


def test_kept_guarantee_says_how_far_zeros_go_alone() -> None:
    linear = integrator(K, 0.3)
    far = zeros_alone(with_zero(part=0.0, zero=1.0))
    assert far is not None
    assert far.unstable is not None
    late = far.unstable._replace(late=((True,), (False,)))
    guarantee = loop_guarantee(linear)._replace(zeros_alone=far, unstable=late)
    keep(guarantee)
    kept = kept_guarantee(linear)
    assert kept is not None
    assert kept.zeros_alone == far
    assert kept.unstable == late
    assert "entries that are 0, beside exact others: stable within 4" in guarantee_text(kept)[-1]


def test_zero_and_entry_go_in_proportion() -> None:
    """The loop is unstable from a = K (1 - d) on.

    With d = 0.3 s and a = 4 s, this is at s = 20 / 10.
    """
    guarantee = loop_guarantee(with_zero())
    size = K / (0.1 * ROW + 0.3 * K)
    assert guarantee.stable == approx(0.3 * size, rel=0.02)
    assert guarantee.zeros == approx(0.1 * size, rel=0.02)
    assert guarantee.zeros == approx(guarantee.stable / 3.0)
    said = guarantee_text(guarantee)
    assert "entries that are 0 within 19." in said[0]
    assert said[1].endswith("each other entry that is 0")


def test_unstable_aircraft_of_the_issue_by_another_exponential() -> None:
    """With all others exact, the loop is unstable for B[q,thrust] at 19 % of its row.

    The loop is written out here with another exponential.
    """
    frame, scenario = load_airframe("osprey"), find_scenario("osprey_observer")
    linear = scenario_loop(scenario, scenario.controller)
    radii = []
    for part in (0.15, 0.19):
        plant = with_entries(frame, {"B[q,thrust]": part})
        columns = [list(frame.inputs).index(name) for name in scenario.controller.inputs]
        A, B = plant.matrix_a() + frame.matrix_gravity(), plant.matrix_b()[:, columns]
        n, m = B.shape
        rates = np.diag(1.0 / linear.loop.lag)
        none = np.zeros((m, n))
        motion = np.block([[A, B, 0.0 * B], [none, -rates, rates], [np.zeros((m, n + 2 * m))]])
        late, T = linear.loop.delay, linear.loop.period
        first, second = (expm(motion * t)[: n + m] for t in (late, T - late))
        law = linear.law
        q = len(law.A)
        C, keeps = linear.nominal.C, np.eye(n + 2 * m + q)
        u = np.hstack([law.D @ C, np.zeros((m, 2 * m)), law.C])
        x = first[:, : n + m] @ keeps[: n + m] + first[:, n + m :] @ keeps[n + m : n + 2 * m]
        x = second[:, : n + m] @ x + second[:, n + m :] @ u
        own = np.hstack([law.B @ C, np.zeros((q, 2 * m)), law.A])
        radii.append(np.abs(np.linalg.eigvals(np.vstack([x, u, own]))).max())
    assert radii[0] <= 1.0 + 1e-6 < radii[1]


def test_checker_proves_zeros_and_says_them_as_numbers(content: Content, tmp_path: Path) -> None:
    """The rows with a large g need a smaller remainder.

    Without this weight the checker had refused the certificate.
    """
    done = run(content, tmp_path)
    assert done.returncode == 0, done.stderr
    assert "B[y,u] (B 0, 0) 59." in done.stdout
    assert "A[y,y] (A 0, 0) 0 +- 7.9" in done.stdout
    assert "exact in every aircraft: no entry, and each other 0" in done.stdout


@pytest.mark.parametrize(
    ("alter", "reason"),
    [
        (drop("zeros"), "A[y,y]: found"),
        (put(["A[y,y]", "B[y,u]"], "zeros"), "B[y,u]: found 1.0, expected 0"),
        (put(["A[y,y]", "A[x,x]"], "zeros"), "expected some of the names"),
        (put([[-1.0]], "A"), "A[y,y]: found -1.0, expected 0"),
        (times(1.05, "F", 1), "not proved"),
        (put(0.0, "part", 1), "A[y,y]: found"),
    ],
    ids=["unmarked", "marked entry", "unknown", "no zero", "wider", "without part"],
)
def test_altered_zero_is_refused(
    alter: Alter, reason: str, content: Content, tmp_path: Path
) -> None:
    altered = json.loads(json.dumps(content))
    alter(altered)
    done = run(signed(altered), tmp_path)
    assert done.returncode == 1, done.stdout
    assert reason in done.stderr


def test_command_certifies_zeros(tmp_path: Path) -> None:
    frame, section = tmp_path / "one.yaml", tmp_path / "gains.yaml"
    path = tmp_path / "certificate.json"
    frame.write_text(json.dumps(ONE_CHANNEL))
    words = [str(frame), "--samples", "1"]
    invoke("gains", "select", *words, "--write", str(section))
    words += ["--scenario", str(section), "--zeros", "0.1", "--certificate", str(path)]
    said = " ".join(invoke("gains", "guarantee", *words).output.split())
    assert "% of their rows (certificate" in said
    assert "exact in every aircraft: A[theta,q], lags, delay, period, each other entry" in said
    content = json.loads(path.read_text())
    assert content["zeros"] == ["B[alpha,elevator]"]
    assert run(content, tmp_path).stdout.startswith("PROVED")
    with refusing("zeros: found 1.5"):
        rise_di.check_gains(frame, section, zeros=1.5)
