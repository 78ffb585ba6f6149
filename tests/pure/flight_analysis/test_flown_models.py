# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test that a flight that learned has the margins of each model that was used.

The margins are around the file and around the true aircraft.
"""

from pathlib import Path

import numpy as np
import pytest
from tests.plots import drawn

from aircraft_sim.uncertainty import as_yaml
from flight_analysis.closed_loop.scenario import Scenario
from flight_analysis.closed_loop.scenario_library import find_scenario
from flight_analysis.closed_loop.simulate import simulate
from flight_analysis.linear_loop.loop_margins import loop_margins, scenario_loop
from flight_analysis.report import figures
from flight_analysis.report.flown_models import (
    FILE,
    TRUE,
    FlownController,
    flown_controllers,
    flown_loops,
    learned_lines,
)
from flight_analysis.report.html import write_page
from flight_analysis.report.learned_figure import learned_figure
from flight_analysis.report.model_spans import model_names
from flight_analysis.report.summary import RecordedFlight, summarise
from flight_core.tape import Tape
from flight_design.learning.scenario_learner import learner

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def learns() -> Scenario:
    """Return a flight with the initial law until 4 s, and with the model of the file afterwards."""
    return find_scenario("osprey_learn").vary(
        flight={"duration": 11.0},
        aircraft={"rate": 100.0, "step": 0.005},
        reference_model={"rate": 100.0},
    )


@pytest.fixture(scope="module")
def flight(learns: Scenario) -> Tape:
    return simulate(learns, learn=learner(learns))


@pytest.fixture(scope="module")
def controllers(learns: Scenario, flight: Tape) -> tuple[FlownController, ...]:
    return flown_controllers(flight, learns.controller, flight.changes)


@pytest.mark.parametrize(
    "first, proposed, names",
    [
        ([0.0], [], ["start"]),
        ([0.0, 4.0, 19.0, 30.0], [15.0, 26.0], ["start", "file", "model 1", "model 2"]),
        ([0.0, 19.0], [15.0], ["start", "model 1"]),  # the file never flew
        ([0.0, 4.0], [15.0], ["start", "file"]),  # what was proposed later did not fly
    ],
)
def test_parameters_before_the_first_proposal_are_the_file(
    first: list[float], proposed: list[float], names: list[str]
) -> None:
    assert model_names(first, proposed) == names


def test_each_model_that_flew_has_its_times(controllers: tuple[FlownController, ...]) -> None:
    assert [(each.name, each.times) for each in controllers] == [
        ("start", "0.0 to 4.0"),
        ("file", "4.0 to 11.0"),
    ]


def test_margins_are_of_each_model_around_file_and_true_aircraft(
    learns: Scenario, flight: Tape, controllers: tuple[FlownController, ...], tmp_path: Path
) -> None:
    """The true aircraft is also built in another way, as a file with its matrices.

    The parameters of each model then fly around this file.
    """
    loops = flown_loops(flight, learns, controllers).loops
    assert [(each.name, each.aircraft) for each in loops] == [
        ("start", FILE),
        ("start", TRUE),
        ("file", FILE),
        ("file", TRUE),
    ]
    path = tmp_path / "true.yaml"
    path.write_text(as_yaml(learns.aircraft.sampled_airframe()))
    true = learns.vary(aircraft={"airframe": str(path), "uncertainty": {"A": 0.0, "B": 0.0}})
    phases = []
    for each, controller in zip(loops[1::2], controllers, strict=True):
        expected = loop_margins(scenario_loop(true, controller.controller)).nominal.phase
        phase = loop_margins(each.loop).nominal.phase
        assert phase == pytest.approx(expected)
        phases.append(phase)
    assert not np.allclose(phases[0], phases[1], rtol=0.05)  # the file flies less phase margin


def test_page_has_margins_and_curves_of_each_model(
    learns: Scenario, flight: Tape, controllers: tuple[FlownController, ...], tmp_path: Path
) -> None:
    summary = summarise(flight, learns)
    assert [span["name"] for span in summary["models"]] == ["start", "file"]
    write_page(
        tmp_path / "page.html",
        [RecordedFlight("learns", learns, flight, summary, controllers=controllers)],
    )
    page = (tmp_path / "page.html").read_text()
    assert "by the parameters in use" in page
    in_degrees = page.partition('data-angles="deg"')[2].partition('data-angles="rad"')[0]
    rows = [in_degrees.count(f'<th scope="row">{name}</th>') for name in ("start", "file")]
    assert rows == [3, 3]
    bode = page.partition("Bode plot")[2].partition("</section>")[0]
    assert '"name":"start"' in bode
    assert '"name":"file"' in bode


def test_what_was_learned_is_drawn_beside_true_value_and_file(
    learns: Scenario, flight: Tape
) -> None:
    """The value of the file is B[q, elevator] = 0.98 1/s^2 per deg."""
    lines = learned_lines(flight, learns)
    assert lines[FILE]["B[q, elevator]"] == pytest.approx(0.98 * 180.0 / np.pi, rel=1e-4)
    ratio = lines[TRUE]["B[q, elevator]"] / lines[FILE]["B[q, elevator]"]
    assert 0.7 <= ratio <= 1.3
    assert ratio != 1.0
    context = figures.plot_context([RecordedFlight("run", learns, flight, {})])
    names = {trace.name for trace in drawn(learned_figure(context, lines)).data}
    assert {FILE, TRUE} <= names
