# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""The benchmark of guidance at a small size: one manoeuvre in calm air, and figures of a flight that is known."""

import math

import numpy as np
import pytest
from benchmarks import fence, routes
from benchmarks import guidance as benchmark
from benchmarks.evidence_data import Row, used
from benchmarks.guidance_grid import Point

from flight_core.tape import Signal, Tape

pytestmark = pytest.mark.slow


def test_step_of_bank_flown_within_limits() -> None:
    rows = list(benchmark.rows("osprey_servo", {"phi": benchmark.MANOEUVRES["phi"]}, seeds=0))
    assert [row.figure.name for row in rows][:2] == ["overshoot (%)", "settled to 1 deg (s)"]
    for row in rows:
        assert row.figure.value <= row.figure.limit, row


def test_known_step_has_figures_that_it_must_have() -> None:
    # 10 % beyond 20 deg from 1 s after the start, then exact from 3 s on.
    t = np.arange(0, 1000) * 0.02
    phi = benchmark.BANK * np.where(t < 6.0, 0.0, np.where(t < 8.0, 1.1, 1.0))
    signal = Signal((t * 1e9).round().astype(np.int64), ("pose.phi",), phi[:, None])
    section = benchmark.aircraft_of("osprey_servo").guidance
    assert section is not None
    overshoot, settled = benchmark.of_phi(Tape({"guidance": signal}), section, calm=True)
    assert overshoot.value == pytest.approx(10.0)
    assert settled.value == pytest.approx(3.0, abs=0.03)  # within 1 deg = 5 %
    assert math.isclose(benchmark.lap(section), 2.0 * math.pi * section.least_radius() / 25.0)


@pytest.mark.parametrize(
    ("pose", "stale"),
    [("5 Hz, 0.2 s late, noisy", 0.0), ("frozen for 8 s, new stamps", 7.8), ("jump", 0.0), ("one sample off", 0.0)],
)
def test_poor_pose_flown_across_180_deg_and_frozen_one_levels_wings(pose: str, stale: float) -> None:
    rows = list(benchmark.rows("osprey_servo", {f"pose: {pose}": benchmark.MANOEUVRES[f"pose: {pose}"]}, seeds=0))
    for row in rows:
        assert row.figure.value <= row.figure.limit, row
    assert {row.figure.name: row.figure.value for row in rows}["pose stale (s)"] == pytest.approx(stale)
    assert rows[0].figure.name == "heading (deg)"  # held again at the end


def test_rows_of_evidence() -> None:
    """A limit that is infinite is no goal, and what was lost is named."""
    flown = benchmark.Row("c172p", "heading", "turbulence, 5 seeds", benchmark.Figure("V (m/s)", 7.6, 5.0))
    assert benchmark.figure_row("heading", flown) == Row("heading, turbulence, 5 seeds: V", "7.6", "m/s", goal="<= 5")
    stale = benchmark.Row("c172p", "pose: jump", "calm", benchmark.Figure("pose stale (s)", 0.0, math.inf))
    assert benchmark.figure_row("pose: jump", stale) == Row("pose: jump, calm: pose stale", "0", "s")
    lost = Point("c172p", 300.0, 36.0, "lost", "diverged at t = 3.00 s")
    assert list(benchmark.grid_rows([Point("c172p", 300.0, 30.0, "ok", "altitude off by 1.0 m"), lost])) == [
        Row("points flown", "1"),
        Row("points lost", "1", goal="<= 0"),
        Row("altitude 300 m, airspeed 30 m/s", "ok"),
        Row("altitude 300 m, airspeed 36 m/s", "lost: diverged at t = 3.00 s"),
    ]


def test_rows_of_routes_and_fences_as_evidence() -> None:
    """A refusal has no goal; a missed leg misses the goal of the cross-track error."""
    flown, missed, refused = (
        routes.Row("f16", "eight", result, 0.2, 0.35, 1.0).figure for result in ("flown", "missed leg 2 by 90 m", "refused: V")
    )
    assert flown == Row("eight: cross-track", "0.2", "s", goal="<= 0.35")
    assert (missed.value, used(missed, {})) == ("missed leg 2 by 90 m", math.inf)
    assert (refused.value, refused.goal) == ("refused: V", "")
    beyond = fence.row_of("f16", "ell", "calm", [0.0, 3.5], [0.5, 0.5], 0, 0.52)
    assert {figure.name: (figure.value, figure.goal) for figure in beyond.figures()} == {
        "ell, calm: flights": ("2", ""),
        "ell, calm: flights outside": ("1", "<= 0"),
        "ell, calm: flights lost": ("0", "<= 0"),
        "ell, calm: farthest outside": ("3.5", ""),
    }


def test_route_that_wind_forbids_is_refused_and_helix_is_flown_longer() -> None:
    refused = routes.fly("osprey_servo", "wind 1.2 V", routes.CASES["wind 1.2 V"])
    assert refused.result.startswith("refused: guidance.route[0].V: found 25 m/s in a wind of 30 m/s")
    section = benchmark.aircraft_of("osprey_servo").guidance
    assert section is not None
    level, climbing = (
        routes.duration(section.plan(routes.of_radii((0, 0), (5, 0), altitudes=(0.0, up))(144.0)), section)
        for up in (0.0, 250.0)
    )
    # The climb on the circle round the first waypoint, and the circle once more for the exit.
    assert climbing - level > 250.0 / section.climb_limits()[0]
