# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test Monte Carlo campaigns: their statistics have a constant size.

Chunks do not depend on the engine or on their order. A campaign that is killed can be resumed.
"""

import io
import json
import math
import os
import shlex
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock

import numpy as np
import polars as pl
import psutil
import pytest
from distributed import LocalCluster
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from pytest import approx
from scipy.stats import spearmanr
from tests.closed_loop import error
from tests.conftest import invoke, refusing

from aircraft_sim.airframes.airframe import load_airframe
from aircraft_sim.uncertainty import Spread
from flight_analysis.closed_loop.learning_loop import Learn, LearnerResult
from flight_analysis.closed_loop.scenario import Scenario, load_scenario, scenario_yaml
from flight_analysis.closed_loop.scenario_library import find_scenario
from flight_analysis.closed_loop.simulate import simulate
from flight_analysis.linear_loop.input_margins import input_margins
from flight_analysis.linear_loop.loop_margins import linear_loop
from flight_analysis.report.guided import control_errors
from flight_analysis.report.run_folder import REPORT, SUMMARY
from flight_campaign import campaign, engines, equipment, single_flights
from flight_campaign.batch import device
from flight_campaign.campaign import CHUNKS, MonteCarlo, define, fly_chunk
from flight_campaign.campaign_report import figure_rows, overview, score_meaning
from flight_campaign.definition import Definition, Sweep
from flight_campaign.influence import rank_correlations
from flight_campaign.rows import Chunk, encode_chunk, entry_names, tally_of
from flight_campaign.statistics import WORST_KEPT, FigureStatistics, Tally, score, score_units
from flight_core.parameters import ParameterError
from flight_core.tape import Tape
from flight_core.vectors import FloatArray
from flight_design.identification.model_identification import identify_model
from flight_design.learning import scenario_learner
from rise_di import CampaignResult
from rise_di_controller.rise_di_config import RiseDiConfig

pytestmark = pytest.mark.slow

# 100 Hz and steps of 5 ms: what is shown of a campaign does not depend on them
SHORT = find_scenario("osprey_servo").vary(
    flight={"duration": 5.0},
    aircraft={"rate": 100.0, "step": 0.005},
    reference_model={"rate": 100.0},
)
VALUES = arrays(np.float64, st.integers(1, 60), elements=st.floats(1e-6, 1e4))


def definition(aircraft: int = 60, chunk: int = 20, sweep: Sweep | None = None) -> Definition:
    return define(SHORT, aircraft=aircraft, uncertainty=0.3, seed=7, chunk=chunk, sweep=sweep)


def fly_campaign(folder: Path, of: Definition) -> MonteCarlo:
    folder.mkdir()
    campaign = MonteCarlo.begin(folder, of)
    assert sum(campaign.fly(engines.threads(2))) == of.aircraft * of.cases
    return campaign


def test_meaning_of_the_score_has_the_units_of_the_tables() -> None:
    """The unit of the tables is deg/s, and 10 mrad/s is 0.573 deg/s."""
    sentence = score_meaning(find_scenario("osprey_servo"), {"r": 0.05})
    assert sentence.endswith("r 2.86 deg/s, 0.573 deg/s (p: 1.15) and 0.1 m/s")


@given(VALUES, st.data())
def test_figure_summed_from_parts_is_that_of_whole(values: FloatArray, data: st.DataObject) -> None:
    cut = data.draw(st.integers(0, len(values)))
    whole = FigureStatistics.from_values(values)
    parts = FigureStatistics.from_values(values[:cut]) + FigureStatistics.from_values(values[cut:])
    assert parts.count == len(values)
    assert parts.bins == whole.bins
    assert parts.largest == values.max()
    # Sums in another order: rounding alone.
    assert parts.mean == approx(float(np.mean(values)), rel=1e-12)
    assert parts.deviation == approx(
        float(np.std(values, ddof=1)) if len(values) > 1 else 0.0, rel=1e-9, abs=1e-9
    )


@given(VALUES, st.floats(0.01, 1.0))
def test_quantile_is_accurate_to_width_of_bin(values: FloatArray, share: float) -> None:
    # inverted_cdf: the smallest value that so many reach. A bin is 10^(1/100) wide.
    exact = float(np.quantile(values, share, method="inverted_cdf"))
    assert FigureStatistics.from_values(values).quantile(share) == approx(
        exact, rel=10 ** (1 / 100) - 1.0
    )


def test_worst_flights_kept_with_diverged_ones_first() -> None:
    scores = np.arange(30.0)
    diverged = scores == 4.0
    halves = [
        Tally.from_flights(
            first, diverged[first : first + 15], {"score": scores[first : first + 15]}
        )
        for first in (0, 15)
    ]
    total = halves[0] + halves[1]
    assert [flight.number for flight in total.worst] == [4, *range(29, 29 - WORST_KEPT + 1, -1)]
    assert total.worst[0].score is None
    assert (total.flights, total.diverged, total.lost) == (30, 1, 19)  # 11 to 29 are above 10
    assert total.figures["score"].count == 29


def test_share_of_diverged_flights_has_confidence_interval() -> None:
    # Clopper-Pearson: of 0 in n, the upper end is 1 - 0.025^(1/n).
    share, low, high = Tally(flights=100).share(0)
    assert (share, low) == (0.0, 0.0)
    assert high == approx(1.0 - 0.025 ** (1 / 100), rel=1e-9)
    # 7 of 50 by scipy.stats.binomtest, and all of 50
    assert Tally(flights=50).share(7)[1:] == approx((0.05819170033997342, 0.26739600249700846))
    assert Tally(flights=50).share(50) == approx((1.0, 0.025 ** (1 / 50), 1.0))


def test_a_score_counts_errors_in_their_units() -> None:
    rms = np.array([[0.010], [0.020], [0.010], [0.1]])
    units = {"q": "rad/s", "p": "rad/s", "r": "rad/s", "V": "m/s", "theta": "rad"}
    assert score(rms, score_units(("q", "p", "r", "V"), units)) == approx([4.0])
    with refusing(r"^outputs: found theta in rad, expected rad/s or m/s, or a unit of the score"):
        score_units(("q", "theta"), units)
    assert score_units(("q", "theta"), units, {"theta": 0.05, "q": 0.02}).tolist() == [0.02, 0.05]


def test_aircraft_with_entries_of_its_own_flies_again_with_same_score(tmp_path: Path) -> None:
    """Limits of single entries, of lags and noise, a late u and a unit of the score are kept."""
    units = {"V": 0.2}
    entries = {"B[V,thrust]": 0.6, "lag[thrust]": 0.2, "lag": 0.5, "noise[q]": 0.9, "delay": 0.035}
    of = define(
        SHORT,
        aircraft=4,
        uncertainty=0.2,
        seed=7,
        chunk=2,
        spread=Spread(entries, "corners"),
        units=units,
    )
    campaign = fly_campaign(tmp_path / "own", of)
    rows = campaign.rows().collect()
    airframe = load_airframe(SHORT.aircraft.airframe)
    thrust = (
        rows["B[V,thrust]"].to_numpy()
        / airframe.matrix_b()[airframe.index("V"), list(airframe.inputs).index("thrust")]
        - 1.0
    )
    assert np.abs(thrust) == approx(0.6)
    assert np.abs(
        rows["A[q,q]"].to_numpy() / airframe.matrix_a()[airframe.index("q"), airframe.index("q")]
        - 1.0
    ) == approx(0.2)
    for name, published, part in (
        ("lag[rudder]", 0.02, 0.5),
        ("lag[thrust]", 0.1, 0.2),
        ("noise[q]", 0.0017, 0.9),
    ):
        assert np.abs(rows[name].to_numpy() / published - 1.0) == approx(part)
    worst = campaign.tally(0).worst[0]
    path = tmp_path / "again.yaml"
    path.write_text(scenario_yaml(campaign.definition.aircraft_scenario(worst.number)))
    again = load_scenario(path)
    # Whole periods; +100 % of the reference is the largest.
    assert set(rows["delay"].to_list()) == {0.0, 0.03}
    assert 2.0 * equipment.references(SHORT, of.entries)["delay"] == 0.03
    assert again.aircraft.actuators.lag[-1] == rows["lag[rudder]"][worst.number]
    assert again.aircraft.actuators.delay == rows["delay"][worst.number] == 0.03
    true = error(simulate(again))
    outputs = again.controller.outputs
    at_ticks = true.stamp_ns % 10_000_000 == 0
    rms = np.array([[np.sqrt(np.mean(true[name][at_ticks] ** 2))] for name in outputs])
    unit = score_units(outputs, again.aircraft.channels().outputs, units)
    # Tests of fleets compare with single flights as closely.
    assert worst.score == approx(score(rms, unit)[0], rel=1e-3)


@pytest.mark.parametrize(
    "options, sentence",
    [
        (
            {"spread": Spread({"A[q,gamma]": 0.5})},
            r"entry: found A\[q,gamma\], expected an entry of the airframe",
        ),
        ({"spread": Spread({"A[q,q]": 1.5})}, "expected a part of each entry"),
        (
            {"spread": Spread({"delay": 0.004})},
            "delay 0.004 s, expected at least a period of the controller, 0.01 s",
        ),
        ({"units": {"theta": 0.1}}, "expected an output of the controller"),
    ],
)
def test_unknown_entry_and_unit_refused(options: dict[str, Any], sentence: str) -> None:
    with refusing(sentence):
        define(SHORT, aircraft=4, uncertainty=0.2, seed=7, chunk=4, **options)


ROUTE = find_scenario("osprey_route").vary(
    aircraft={"rate": 100.0, "step": 0.005}, reference_model={"rate": 100.0}
)
CORNER = ROUTE.vary(
    flight={"duration": 18.0},
    guidance={
        "route": {
            "north": [0.0, 300.0, 300.0],
            "east": [0.0, 0.0, 300.0],
            "altitude": [0.0, 5.0, 0.0],
        }
    },
)
"""A corner after 120 m: a change of leg, a bank to the limit, a climb."""


def test_figures_of_a_mission_are_those_of_its_flight_alone(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    flights = []

    def kept(scenario: Scenario, **options: Any) -> Tape:
        flights.append((scenario, simulate(scenario, **options)))
        return flights[-1][1]

    monkeypatch.setattr(single_flights, "simulate", kept)
    definition = define(CORNER, aircraft=2, uncertainty=0.3, seed=7, chunk=1)
    chunk = single_flights.fly_chunk_singly(definition, (0, 1))
    assert not chunk.diverged.any()
    figures = {key: values[0] for key, values in chunk.figures.items()}
    ((flown, tape),) = flights
    assert flown == definition.aircraft_scenario(1)  # it has an A and a B of its own
    log = tape["guidance"]
    errors = control_errors(tape)
    true = error(tape)
    assert log["leg"].max() == 2  # the fillet has been reached, the orbit has not
    xtrack = errors["xtrack"]
    expected = {
        "score": np.abs(xtrack).max() / 12.5,  # half a second of flight at 25 m/s
        "max.xtrack": np.abs(xtrack).max(),
        "rms.xtrack": np.sqrt(np.mean(xtrack**2)),
        "rms.altitude": np.sqrt(np.mean(errors["altitude"] ** 2)),
        "max.phi": np.abs(log["pose.phi"]).max(),
        "missed": 0.0,
        **{
            f"rms.{name}": np.sqrt(np.mean(true[name][true.stamp_ns % 10_000_000 == 0] ** 2))
            for name in ("q", "p", "r", "V")
        },
    }
    assert {key: figures[key] for key in expected} == approx(expected, rel=1e-9)
    assert "home" not in figures  # there is no fence


def test_figures_of_a_mission_leave_out_what_is_no_leg() -> None:
    """The last orbit begins at its centre, a radius away from its path.

    Outside of a fence the aircraft flies home, away from its leg.
    """
    route = {"north": [0.0, 100.0], "east": [0.0, 0.0], "altitude": [0.0, 0.0]}
    section = {"route": route, "home": {"north": -30.0}}
    fence = {
        "field": {"north": [-400.0, 400.0, 400.0, -400.0], "east": [-400.0, -400.0, 400.0, 400.0]}
    }
    fenced = ROUTE.vary(flight={"duration": 14.0}, guidance=section | {"fence": fence})
    tape = simulate(fenced)
    log = tape["guidance"]
    assert fenced.guidance is not None
    assert log["leg"][-1] == 1
    assert np.abs(log["xtrack"]).max() > 60.0
    figures = single_flights.mission_figures(tape, fenced.guidance)
    assert figures["max.xtrack"] < 5.0
    assert figures["max.breach"] == 0.0
    assert figures["home"] == approx(math.hypot(log["pose.north"][-1] + 30.0, log["pose.east"][-1]))


@pytest.mark.parametrize(
    "scenario, sentence",
    [
        (
            find_scenario("jsbsim_c172p_learn"),
            r"^airframe: found jsbsim:c172p, expected an airframe with matrices",
        ),
        (
            find_scenario("osprey_servo").vary(aircraft={"sensors": {"delay": 0.004}}),
            r"^sensors\.delay: found",
        ),
        (
            find_scenario("osprey_route").vary(guidance={"route": None}),
            r"^guidance\.route: found none, expected a route",
        ),
    ],
)
def test_scenario_that_campaign_cannot_fly_is_refused_before_its_folder(
    scenario: Scenario, sentence: str
) -> None:
    with refusing(sentence):
        define(scenario, aircraft=2, uncertainty=0.3, seed=7, chunk=2)


def learning(duration: float, **learn: object) -> Scenario:
    """Return an osprey that learns, with few ticks."""
    return find_scenario("osprey_learn").vary(
        flight={"duration": duration},
        aircraft={"rate": 100.0, "step": 0.005},
        controller={"learn": {"updates": [1.0], "latency": 0.5} | learn},
    )


def proposing(*proposals: RiseDiConfig) -> Callable[[Scenario], Learn]:
    """Return learners that propose the given models, one for each aircraft."""
    each = iter(proposals)

    def learner(_: Scenario) -> Learn:
        def made(_: RiseDiConfig) -> Any:
            # Nothing is known at the first tick.
            results = [LearnerResult(None, None), LearnerResult(next(each), "given")]
            return SimpleNamespace(take=lambda *_: None, propose=Mock(side_effect=results))

        return made

    return learner


def flown_rows(folder: Path, scenario: Scenario, learner: Any, count: int) -> MonteCarlo:
    folder.mkdir()
    campaign = MonteCarlo.begin(folder, define(scenario, aircraft=count, uncertainty=0.3, seed=7))
    assert list(campaign.fly(engines.threads(1), learner)) == [count]
    return campaign


def flown_alone(campaign: MonteCarlo, number: int, learner: Any) -> dict[str, float]:
    """Return figures of an aircraft of a campaign.

    It is flown by the loop of `rise-di fly --in-process`.
    """
    scenario = campaign.definition.aircraft_scenario(number)
    figures = single_flights.fly_single(scenario, learner).figures
    return {name: figures[name] for name in figures if name.startswith(("rms", "max", "slew"))}


def test_aircraft_that_learn_fly_as_in_single_process_simulation(tmp_path: Path) -> None:
    """The first learner proposes a model with an observer, and the second one without."""
    model = find_scenario("osprey_observer").rise_di()
    bare = model.model_copy(update={"observer": None})
    campaign = flown_rows(tmp_path / "learn", learning(2.0), proposing(model, bare), 2)
    rows = campaign.rows().collect()
    tally = campaign.tally(0)
    assert rows.select("first_model", "models", "refused", "fallbacks").rows() == [
        (1.5, 1, 0, 0),
        (None, 0, 1, 0),
    ]
    assert tally.without_model() == 1
    assert figure_rows(tally, {})[-4] == ["first model (s)", *["1.5"] * 5]
    for number, proposal in enumerate((model, bare)):
        single = flown_alone(campaign, number, proposing(proposal))
        row = rows.row(number, named=True)
        assert {name: row[name] for name in single} == single
    again = campaign.definition.aircraft_scenario(0)
    assert again.aircraft.sampled_airframe().matrix_b()[2, 0] == rows["B[q,elevator]"][0]


def test_quick_learner_of_campaign_finds_what_learner_of_node_finds(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    identified: list[Any] = []

    def kept(*arguments: Any, **options: Any) -> Any:
        assert options.pop("quick")
        identified.append(identify_model(*arguments, **options, quick=True))
        identified.append(identify_model(*arguments, **options))
        return identified[0]

    monkeypatch.setattr("flight_design.learning.learner.identify_model", kept)
    scenario = learning(10.1, updates=[10.0])
    flown_rows(tmp_path / "real", scenario, scenario_learner.quick_learner, 1)
    # The searches end within 0.3 of log-likelihood, which is up to sqrt(0.6) deviations apart.
    for near, thorough in zip(*(each.entries for each in identified), strict=True):
        assert near.error == approx(thorough.error, abs=0.4 * thorough.deviation)


def test_campaign_flies_effect_of_wind_that_definition_names(tmp_path: Path) -> None:
    gust = {"vertical": {"start": 2.0, "speed": 10.12, "length": 15.24}}
    gusty = SHORT.vary(flight={"duration": 4.0}, aircraft={"gusts": gust})
    published = gusty.vary(aircraft={"uncertainty": {"A": 0.9, "wind": "published"}})
    of = {
        "own": define(gusty, aircraft=20, uncertainty=0.5, seed=7, chunk=20),
        "published": define(
            gusty, aircraft=20, uncertainty=0.5, seed=7, chunk=20, wind="published"
        ),
        "scenario": define(published, aircraft=20, uncertainty=0.5, seed=7, chunk=20),
    }
    tallies = {
        name: fly_campaign(tmp_path / name, campaign).tally(0) for name, campaign in of.items()
    }
    # Half of Z_alpha with the whole force of the gust has a larger error.
    assert (
        tallies["own"].figures["score"].largest
        < 0.9 * tallies["published"].figures["score"].largest
    )
    assert tallies["scenario"] == tallies["published"]  # its own uncertain aircraft does not fly
    for name, wind in (("own", "air_relative"), ("published", "published")):
        assert of[name].aircraft_scenario(3).aircraft.uncertainty.wind == wind


def test_same_seed_gives_same_figures_in_any_order_and_engine(tmp_path: Path) -> None:
    first, second = (fly_campaign(tmp_path / name, definition()) for name in ("first", "second"))
    assert first.tally(0).model_dump_json() == second.tally(0).model_dump_json()

    def backwards(
        work: engines.Work, jobs: Iterable[engines.Job]
    ) -> Iterator[tuple[engines.Job, Any]]:
        return ((job, work(job)) for job in reversed(list(jobs)))

    (tmp_path / "third").mkdir()
    third = MonteCarlo.begin(tmp_path / "third", definition())
    list(third.fly(backwards))
    assert third.tally(0).model_dump_json() == first.tally(0).model_dump_json()
    other = fly_campaign(
        tmp_path / "other", define(SHORT, aircraft=60, uncertainty=0.3, seed=8, chunk=20)
    )
    assert other.tally(0).figures["score"].mean != first.tally(0).figures["score"].mean


def test_stopped_campaign_resumes_with_missing_chunks(tmp_path: Path) -> None:
    whole = fly_campaign(tmp_path / "whole", definition())
    (tmp_path / "part").mkdir()
    part = MonteCarlo.begin(tmp_path / "part", definition())
    next(part.fly(engines.threads(1)))
    resumed = MonteCarlo.resume(tmp_path / "part")
    assert 0 < len(resumed.missing()) < 3
    list(resumed.fly(engines.threads(1)))
    assert resumed.missing() == []
    assert resumed.tally(0) == whole.tally(0)


def test_row_of_aircraft_has_its_figures_outcome_and_drawn_entries(tmp_path: Path) -> None:
    campaign = fly_campaign(tmp_path / "one", definition(21, 20))
    table = campaign.rows().collect()
    assert table["number"].to_list() == list(range(21))
    assert set(table["seed"]) == {7}
    assert table["score"].max() == campaign.tally(0).figures["score"].largest
    frame = campaign.definition.aircraft_scenario(20).aircraft.sampled_airframe()
    A = frame.matrix_a()
    B = frame.matrix_b()
    row = table.row(20, named=True)
    assert row["A[q,alpha]"] == A[frame.index("q"), frame.index("alpha")]
    assert row["B[V,thrust]"] == B[frame.index("V"), list(frame.inputs).index("thrust")]
    assert "A[theta,q]" not in row  # kinematics are known
    spread = table.select(entry_names(table)).to_numpy()
    assert np.ptp(spread, axis=0).min() > 0.0


def test_figures_of_diverged_aircraft_are_null() -> None:
    score = np.array([1.0, np.inf, 11.0])
    chunk = Chunk(4, np.array([0.0, 1.0, 0.0]), {"score": score}, {"A[q,q]": np.ones(3)})
    table = pl.read_parquet(io.BytesIO(encode_chunk(chunk, 7, 1.0)))
    assert table["score"].to_list() == [1.0, None, 11.0]
    assert table["diverged"].to_list() == [False, True, False]
    assert table["lost"].to_list() == [False, False, True]
    assert tally_of(table) == Tally.from_flights(4, chunk.diverged, chunk.figures)


def test_rank_correlations_are_those_of_scipy() -> None:
    rng = np.random.default_rng(1)
    strong, weak = rng.uniform(1.0, 2.0, (2, 50))
    score = np.round(10.0 * strong + weak)  # with ties
    table = pl.DataFrame(
        {"score": score, "A[q,q]": -weak, "A[q,alpha]": -strong, "B[V,thrust]": np.ones(50)}
    )
    correlations = rank_correlations(
        table, {"A[q,q]": -1.5, "A[q,alpha]": -1.5, "B[V,thrust]": 1.0}
    )
    expected = {
        name: spearmanr(size, score).statistic
        for name, size in (("A[q,alpha]", strong), ("A[q,q]", weak))
    }
    # The strongest first, without the one that is not uncertain.
    assert list(correlations) == list(expected)
    assert correlations == approx(expected, rel=1e-12)
    lost = table.with_columns(
        pl.when(pl.col("score") < score.max()).then(pl.col("score")).alias("score")
    )
    # A diverged aircraft is the worst.
    assert rank_correlations(lost, {"A[q,q]": -1.5, "A[q,alpha]": -1.5}) == correlations
    assert rank_correlations(table.head(5), {}) == {}


def test_sweep_flies_every_aircraft_with_each_factor(tmp_path: Path) -> None:
    campaign = fly_campaign(
        tmp_path / "sweep", definition(20, 20, Sweep(parameter="beta", factors=(0.05, 1.0)))
    )
    weak, strong = (campaign.tally(case).figures["score"].mean for case in (0, 1))
    assert weak > 1.05 * strong  # beta far below the slew of the ideal control follows worse
    assert fly_campaign(tmp_path / "plain", definition(20, 20)).tally(0) == campaign.tally(1)


@pytest.mark.parametrize("channel, place", [("V", -1), ("thrust", -1), ("q", 0)])
def test_sweep_of_channel_multiplies_that_value_alone(channel: str, place: int) -> None:
    swept = definition(20, 20, Sweep(parameter=f"beta[{channel}]", factors=(1.0, 2.0)))
    own, double = (swept.scenario(case).controller.model_dump()["beta"] for case in range(2))
    assert own == SHORT.controller.model_dump()["beta"]
    expected = np.array(own)
    expected[SHORT.controller.outputs.index("V") if place else 0] *= 2.0
    assert double == tuple(expected)
    assert swept.label(1) == f"beta[{channel}] x 2"


def test_results_have_margins_beside_score(tmp_path: Path) -> None:
    campaign = fly_campaign(
        tmp_path / "swept", definition(6, 6, Sweep(parameter="softening", factors=(1.0, 4.0)))
    )
    result = [campaign.margins(case) for case in range(2)]
    tallies = [campaign.tally(case) for case in range(2)]
    rows = {name: cells for name, *cells in overview(campaign.definition, tallies, result).rows}
    narrow, wide = (float(cell.split()[0]) for cell in rows["phase margin, deg"])
    assert narrow < wide  # a wider sign integrates more slowly
    assert rows["score, mean"] == [f"{tally.figures['score'].mean:.3g}" for tally in tallies]
    scenarios = [campaign.definition.aircraft_scenario(number, 1) for number in range(6)]
    airframes = [scenario.aircraft.sampled_airframe() for scenario in scenarios]
    loops = [
        linear_loop(scenarios[0].controller, frame, frame.matrix_a()[None], frame.matrix_b()[None])
        for frame in airframes
    ]
    phases = [input_margins(loop.nominal, loop.law, loop.loop).phase.min() for loop in loops]
    assert result[1] is not None
    assert result[1].worst is not None
    # A search over the box is at or below each aircraft that flies.
    assert result[1].worst.phase.min() < min(phases)


@pytest.fixture
def flown(tmp_path: Path) -> MonteCarlo:
    """Return a campaign of one chunk with made-up figures."""
    campaign = MonteCarlo.begin(tmp_path, definition(20, 20))
    score = np.linspace(1.0, 2.0, 20)
    (tmp_path / CHUNKS / "0-000000.parquet").write_bytes(made_up(score))
    return campaign


def made_up(score: FloatArray) -> bytes:
    """Return the rows of a chunk with these scores."""
    return encode_chunk(
        Chunk(
            0, np.zeros(len(score)), {"score": score, "rms.q": score}, {"B[p,aileron]": 6.0 - score}
        ),
        7,
        1.0,
    )


def refusal(*words: str) -> str:
    """Return the sentence with which the command ends."""
    result = invoke("campaign", *words)
    assert isinstance(result.exception, ParameterError), result.exception
    return str(result.exception)


@pytest.mark.parametrize("content", [b"", made_up(np.ones(20))[:-9], made_up(np.ones(9))])
def test_damaged_chunk_or_chunk_of_another_campaign_named(
    flown: MonteCarlo, content: bytes
) -> None:
    path = flown.folder / CHUNKS / "0-000000.parquet"
    path.write_bytes(content)
    assert refusal(str(flown.folder)).startswith(
        f"{path}: found {'9' if content == made_up(np.ones(9)) else 'none'}, expected the figures"
    )


def test_results_name_entry_that_decides_score_and_its_worst_corner(flown: MonteCarlo) -> None:
    words = ["campaign", str(flown.folder)]
    output = invoke(*words).stdout
    assert "B[p,aileron]" in output
    ranked = json.loads((flown.folder / SUMMARY).read_text())["cases"][0]["influence"]
    published = find_scenario("osprey_servo").aircraft.load()[0].matrix_b()[5, 2]
    assert ranked["entries"] == [
        {
            "entry": "B[p,aileron]",
            "rank_correlation": approx(-1.0),
            "worst_aircraft": approx(4.0 / published - 1.0),
            "worst_corner": -0.3,
        }
    ]
    corner = load_scenario(flown.folder / "osprey_servo_corner.yaml").aircraft.load()[0]
    nominal = find_scenario("osprey_servo").aircraft.load()[0]
    ratio = np.ones((8, 4))
    ratio[5, 2] = 0.7
    np.testing.assert_allclose(corner.matrix_b(), ratio * nominal.matrix_b(), rtol=1e-15)
    np.testing.assert_allclose(corner.matrix_a(), nominal.matrix_a(), rtol=1e-15)
    assert shlex.split(ranked["command"])[:2] == ["rise-di", "fly"]
    assert "B[p,aileron]" in (flown.folder / REPORT).read_text()


def test_command_writes_rows_in_one_file(flown: MonteCarlo, tmp_path: Path) -> None:
    path = tmp_path / "rows.parquet"
    words = ["campaign", str(flown.folder), "--rows", str(path), "--json"]
    assert invoke(*words).exit_code == 0
    assert pl.read_parquet(path).equals(
        CampaignResult(flown.folder, flown.folder / REPORT, {}).rows()
    )
    sentence = refusal(str(flown.folder), "--rows", str(tmp_path / "none" / "rows.parquet"))
    assert sentence.startswith("--rows: found ")


def test_campaign_is_not_continued_with_another_definition(flown: MonteCarlo) -> None:
    sentence = refusal(str(flown.folder), "--aircraft", "1000")
    assert (
        sentence
        == "--aircraft: found the folder of a campaign beside it, expected none: the folder of a "
        "campaign holds its definition"
    )


def command(*arguments: str, cwd: Path, group: bool = False) -> "subprocess.Popen[str]":
    """Start the command. With `group` it has its own process group, as in a terminal."""
    program = [sys.executable, "-m", "flight_cli.cli", "campaign", *arguments, "--json"]
    return subprocess.Popen(
        program,
        cwd=cwd,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=group,
    )


def new(aircraft: int, *more: str) -> tuple[str, ...]:
    return (
        "osprey_servo",
        "--duration",
        "5",
        "--aircraft",
        str(aircraft),
        "--chunk",
        "20",
        "--seed",
        "7",
        *more,
    )


def figures(output: str) -> list[object]:
    """Return the figures that the command prints."""
    cases = json.loads(output)["cases"]
    for case in cases:
        del case["fly_again"], case["influence"]["command"]  # name the folder
    return list(cases)


def wait_for_chunks(runs: Path, count: int, process: "subprocess.Popen[str]") -> Path:
    """Wait until `count` chunks of the only campaign in `runs` are done, and return its folder."""
    while len(result := list(runs.glob(f"*/{CHUNKS}/*.parquet"))) < count:
        assert process.poll() is None, process.communicate()
        time.sleep(0.02)
    return result[0].parents[1]


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> list[object]:
    """Return the figures of an uninterrupted campaign of 10 chunks."""
    runs = tmp_path_factory.mktemp("whole")
    return figures(invoke("campaign", *new(200, "--runs", str(runs)), "--json").stdout)


def part_of_campaign(folder: Path, number: signal.Signals) -> tuple[Path, int, str]:
    """Return folder, status and output of a campaign of 10 chunks.

    A signal ends it after the first chunk.
    """
    stopped = command(*new(200, "--runs", "part", "--workers", "1"), cwd=folder)
    part = wait_for_chunks(folder / "part", 1, stopped)
    stopped.send_signal(number)
    output = "".join(stopped.communicate())
    assert 1 <= len(list((part / CHUNKS).glob("*.parquet"))) < 10, output
    return part, stopped.returncode, output


def test_campaign_ended_by_ctrl_c_resumes_to_figures_of_uninterrupted_one(
    whole: list[object], tmp_path: Path
) -> None:
    folder, status, output = part_of_campaign(tmp_path, signal.SIGINT)
    assert status == 130, output
    assert "Traceback" not in output
    assert f"continue with: rise-di campaign {folder.relative_to(tmp_path)}" in output
    assert figures(invoke("campaign", str(folder), "--json").stdout) == whole


def test_killed_campaign_resumes_to_figures_of_uninterrupted_one(
    whole: list[object], tmp_path: Path
) -> None:
    folder, status, _ = part_of_campaign(tmp_path, signal.SIGKILL)
    assert status == -signal.SIGKILL
    assert figures(invoke("campaign", str(folder), "--json").stdout) == whole


def test_ctrl_c_ends_the_processes_of_missions(tmp_path: Path) -> None:
    """A terminal sends the signal to the workers, too."""
    short = ("osprey_route", "--duration", "1", "--aircraft", "400", "--chunk", "1")
    stopped = command(*short, "--runs", "part", "--workers", "1", cwd=tmp_path, group=True)
    wait_for_chunks(tmp_path / "part", 1, stopped)
    workers = psutil.Process(stopped.pid).children(recursive=True)
    assert workers
    os.killpg(stopped.pid, signal.SIGINT)
    output, errors = stopped.communicate()
    assert stopped.returncode == 130, errors
    assert "continue with: rise-di campaign part/" in output + errors
    assert "Traceback" not in errors
    _, alive = psutil.wait_procs(workers, timeout=10.0)
    assert not alive


def square(job: engines.Job) -> int:
    time.sleep(0.02)  # so that some are underway when the scheduler is lost
    return job[0] ** 2


def test_campaign_goes_on_with_scheduler_that_is_back() -> None:
    def cluster(port: int) -> LocalCluster:
        where: dict[str, Any] = {
            "protocol": "tcp",
            "host": "127.0.0.1",
            "scheduler_port": port,
            "dashboard_address": ":0",
        }
        return LocalCluster(n_workers=2, threads_per_worker=1, processes=False, **where)

    with cluster(0) as first:
        address = first.scheduler_address
        chunks = engines.dask(2, address)(square, [(k,) for k in range(20)])
        results = [next(chunks) for _ in range(3)]
    with cluster(int(address.rsplit(":", 1)[1])):
        results += list(chunks)
    assert sorted(results) == [((k,), k**2) for k in range(20)]


@pytest.mark.parametrize(
    "error",
    [MemoryError(), RuntimeError("RESOURCE_EXHAUSTED: Out of memory allocating 640 bytes.")],
)
def test_chunk_beyond_memory_flies_in_halves_with_the_same_draws(
    error: Exception, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """The second text is from an error of JAX.

    Figures may differ in the order of sums, which depends on the vector width of the CPU.
    """
    part = define(
        SHORT.vary(flight={"duration": 0.5}), aircraft=30, uncertainty=0.3, seed=7, chunk=20
    ).model_dump_json()
    fits = campaign.fly_chunk_figures(part, (0, 0))
    fly_at_once = campaign._fly_at_once

    def small(text: str, case: int, first: int, count: int, size: int) -> Chunk:
        if size > 5:
            raise error
        return fly_at_once(text, case, first, count, size)

    monkeypatch.setattr(campaign, "_FITTING", {})
    monkeypatch.setattr(campaign, "_fly_at_once", small)
    halved = campaign.fly_chunk_figures(part, (0, 0))
    assert [record.message for record in caplog.records] == [
        f"chunk: {size} aircraft do not fit into memory: {size // 2} fly at once"
        for size in (20, 10)
    ]
    assert len(campaign.fly_chunk_figures(part, (0, 1)).diverged) == 10
    assert len(caplog.records) == 2  # the next chunk begins with the size that fits
    for name, values in fits.entries.items():
        assert (halved.entries[name] == values).all()
    for name, values in fits.figures.items():
        assert halved.figures[name] == approx(values, rel=1e-9)


def test_aircraft_beyond_memory_is_one_sentence(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(campaign, "_FITTING", {})
    monkeypatch.setattr(campaign, "_fly_at_once", Mock(side_effect=MemoryError()))
    with refusing(r"^chunk: found an aircraft that needs more memory than there is"):
        fly_chunk(definition().model_dump_json(), (0, 0))


def test_workers_of_a_local_cluster_have_devices_of_their_own_and_a_killed_one_repeats_its_job(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    killed = tmp_path / "killed"

    def two_devices() -> list[dict[str, str]]:
        return [{"CUDA_VISIBLE_DEVICES": name} for name in ("2", "5")]

    # A function in a function, so that the workers do not import this file.
    def device_of(job: engines.Job) -> str:
        if job == (0,) and not killed.exists():
            killed.touch()
            os.kill(os.getpid(), signal.SIGKILL)
        name = os.environ["CUDA_VISIBLE_DEVICES"]
        # A job takes no time: one worker would do all of them before the killed one is back.
        while not killed.exists():
            time.sleep(0.01)
        (tmp_path / f"device {name}").touch()
        while len(list(tmp_path.glob("device *"))) < 2:
            time.sleep(0.01)
        return name

    monkeypatch.setattr(engines, "_separate_devices", two_devices)
    devices = list(engines.dask()(device_of, [(k,) for k in range(12)]))
    assert sorted(job for job, _ in devices) == [(k,) for k in range(12)]
    assert {name for _, name in devices} == {"2", "5"}
    assert killed.exists()


def test_devices_of_a_process_are_shared_out(monkeypatch: pytest.MonkeyPatch) -> None:
    assert device.separate_devices() == []  # of a CPU
    client = SimpleNamespace(platform_version="PJRT C API\ncuda 13000")
    monkeypatch.setattr("jax.local_devices", lambda: 2 * [SimpleNamespace(client=client)])
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "2,5")
    assert device.separate_devices() == [
        {"CUDA_VISIBLE_DEVICES": "2"},
        {"CUDA_VISIBLE_DEVICES": "5"},
    ]


@pytest.mark.parametrize(
    "gibibytes, aircraft, chunk",
    [(60, 1_000_000, 250_000), (60, 300_000, 150_000), (1, 100_000, 50_000), (60, 7, 7)],
)
def test_chunks_of_a_device_are_equal_and_fit_into_its_memory(
    gibibytes: int, aircraft: int, chunk: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With 16 KiB for each aircraft, 1 GiB has room for 65,536."""
    holder = SimpleNamespace(memory_stats=lambda: {"bytes_limit": gibibytes * 2**30})
    monkeypatch.setattr(device, "is_cpu", lambda: False)
    monkeypatch.setattr("jax.devices", lambda: [holder])
    assert device.chunk_of_device(aircraft) == chunk


def test_workers_of_dask_give_same_figures(whole: list[object], tmp_path: Path) -> None:
    where: dict[str, Any] = {"protocol": "tcp", "host": "127.0.0.1", "dashboard_address": ":0"}
    with LocalCluster(n_workers=2, threads_per_worker=1, processes=False, **where) as cluster:
        words = new(200, "--engine", "dask", "--scheduler", cluster.scheduler_address)
        result = invoke("campaign", *words, "--runs", str(tmp_path), "--json")
    assert figures(result.stdout) == whole
