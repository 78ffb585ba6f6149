# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""The page of the evidence of guidance, from stored results."""

from benchmarks.guidance_grid import Point
from benchmarks.guidance_page import page


def test_the_page_marks_what_misses_its_limit_and_names_what_was_lost() -> None:
    flights = [("heading", "calm", "V (m/s)", 1.25, 2.0, 0), ("heading", "turbulence", "V (m/s)", 7.6, 5.0, 5)]
    grid = [Point("c172p", 300.0, 30.0, "ok"), Point("c172p", 300.0, 36.0, "lost", "diverged at t = 3.00 s")]
    dated = {
        name: {"date": "2026-01-01 00:00 UTC", "result": result}
        for name, result in {
            "flights c172p": flights,
            "grid c172p": grid,
            "rates": [("c172p", "calm", {"q": 0.9, "p": 1.6}, 1.5)],
        }.items()
    }
    lines = page(dated).splitlines()
    assert "| heading: V (m/s) | calm | 1.25 | 2 |" in lines
    assert "| heading: V (m/s) | turbulence, 5 seeds | *7.6* | 5 |" in lines
    assert "| 300 | ok | lost |" in lines
    assert "| c172p, calm | 0.90 | *1.60* | 1.5 |" in lines
    assert "1 of 2 points flown, 1 lost." in lines
    assert "- lost at 36 m/s and 300 m: diverged at t = 3.00 s" in lines
    again = page({"rates": dated["rates"] | {"result": [("737", "calm", {"q": 0.5}, 1.5)]}}, page(dated))
    assert "| 737, calm | 0.50 | 1.5 |" in again
    assert "| c172p, calm |" not in again
    assert again.splitlines()[: lines.index("## Errors of the rates")] == lines[: lines.index("## Errors of the rates")]
