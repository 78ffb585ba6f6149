# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test that a refused value of the command line gives one sentence with what was expected."""

import json
import re
from pathlib import Path

import pytest
from tests.conftest import invoke

from flight_core.parameters import ParameterError


@pytest.mark.parametrize(
    "words, sentence",
    [
        (
            ["campaign", "osprey_servo", "--engine", "ray"],
            "--engine: found ray, expected one of threads, dask",
        ),
        (["fly", "osprey", "--duration", "long"], "--duration: found long, expected a number"),
        (
            ["campaign", "osprey_servo", "--aircraft", "2.5"],
            "--aircraft: found 2.5, expected a whole number",
        ),
        (
            ["campaign", "osprey_servo", "--aircraft", "0"],
            "--aircraft: found 0, expected 1 or more",
        ),
        (
            ["fly", "osprey_route", "--simplify", "-1"],
            "--simplify: found -1, expected 0 or more",
        ),
        (
            ["campaign", "osprey_servo", "--entry", "lag=0.5,noise=0.5"],
            (
                "--entry: found 'lag=0.5,noise=0.5', expected a name and a number: "
                "A[q,alpha]=0.6; --entry again for each further one"
            ),
        ),
        (
            ["gains", "check", "osprey_servo"],
            (
                "airframe: found the scenario 'osprey_servo', expected the airframe that it "
                "flies, with `--scenario osprey_servo` beside it"
            ),
        ),
        (
            ["identify", "log", "runs/none", "--airframe", "osprey"],
            (
                "runs/none: found no such file or folder, expected the folder of a run, or an "
                "MCAP file"
            ),
        ),
    ],
)
def test_refused_value_is_one_sentence(words: list[str], sentence: str) -> None:
    error = invoke(*words).exception
    assert isinstance(error, ParameterError)
    assert str(error) == sentence


def test_unknown_entry_is_one_of_the_option_that_gave_it() -> None:
    error = str(invoke("campaign", "osprey_servo", "--entry", "nothing=0.5").exception)
    assert error.startswith("--entry: found nothing, expected a lag or a noise above 0: ")


def test_notes_of_a_plan_are_sentences_and_advise_nothing_that_is_given(tmp_path: Path) -> None:
    """A plan with a fence of its own is flown with it and without it.

    The home is a mapping without `north`.
    """
    mission = {
        "plannedHomePosition": [47.0, 8.0, 0.0],
        "items": [
            {
                "type": "SimpleItem",
                "frame": 3,
                "command": 16,
                "params": [0, 0, 0, None, *place, 60],
            }
            for place in ([47.0, 8.0], [0, 0], [47.01, 8.0])
        ],
    }
    corners = [[46.9, 7.9], [46.9, 8.1], [47.1, 8.1], [47.1, 7.9]]
    fence = {"polygons": [{"polygon": corners, "inclusion": True}], "circles": [], "version": 2}
    rally = {"points": [[47.0, 8.0, 100.0]]}
    plan = tmp_path / "own.plan"
    parts = {"fileType": "Plan", "mission": mission, "geoFence": fence, "rallyPoints": rally}
    plan.write_text(json.dumps(parts))
    words = ["fly", "osprey_route", "--in-process", "--duration", "0.1", "--route", plan]
    runs = ["--runs", tmp_path / "runs"]
    without = invoke(*words, *runs).stderr
    assert "note: the fence and the rally points of the plan are no part of the route" in without
    assert "NAV_WAYPOINT (item 2), at latitude and longitude 0" in without
    with_fence = invoke(*words, "--fence", plan, *runs).stderr
    assert "no part of the route" not in with_fence
    assert re.search(r"note: home by the fence file: north \S+ m, east \S+ m", with_fence)
    assert "{" not in with_fence
