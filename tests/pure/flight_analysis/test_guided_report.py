# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test figures of merit and plots of a guided flight.

One log is written by hand, and another comes from a flight.
"""

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import ArrayLike
from pytest import approx
from tests.conftest import refusing
from tests.plots import drawn
from tests.recordings import EPOCH, signal

from flight_analysis.closed_loop.scenario_library import find_scenario
from flight_analysis.closed_loop.simulate import simulate
from flight_analysis.report import guided_figures
from flight_analysis.report.guided import guidance_summary, segments
from flight_analysis.report.html import write_page
from flight_analysis.report.recorded_flight import read_flight
from flight_analysis.report.summary import RecordedFlight, summarise
from flight_core.tape import Signal, Tape
from flight_core.vectors import FloatArray
from flight_guidance.fence.fence import Fence, Zone
from flight_guidance.guidance_log import names
from flight_guidance.guidance_state import GuidanceMode, Lateral, Vertical
from flight_guidance.steering.path import Arc, Line
from flight_log.bag import LogAttachments
from flight_log.tape_writer import write_run

pytestmark = pytest.mark.slow

T = np.arange(0.0, 40.0, 0.02)  # s
SPEED = 40.0  # m/s, trim


def log(**channels: ArrayLike) -> Tape:
    """Return 40 s of steady level flight to the north with other values in these channels.

    In their names, `_` stands for a dot.
    """
    replacements = {name.replace("__", "."): value for name, value in channels.items()}
    level: dict[str, Any] = dict.fromkeys(names(("q", "V", "p", "r")), 0.0) | {
        "mode": GuidanceMode.ENGAGED, "mode.lateral": Lateral.HEADING,
        "mode.vertical": Vertical.ALTITUDE,
        "V_c": SPEED, "pose.v_north": SPEED, "pose.north": SPEED * T,
    }  # fmt: skip
    assert set(replacements) <= set(level)
    return Tape({"guidance": signal((T * 1e3).tolist(), **level | replacements)}, EPOCH)


def near(*values: Any) -> Any:
    """Return numbers that are compared approximately."""
    return approx(values)


def after(instant: float, value: float) -> FloatArray:
    return np.where(instant <= T, value, 0.0)


def test_segment_ends_where_mode_command_or_leg_changes() -> None:
    lateral = np.where(T < 10.0, Lateral.HEADING, Lateral.ROUTE)
    result = segments(
        log(mode__lateral=lateral, leg=after(20.0, 1.0), target__altitude=after(30.0, 50.0))
    )
    assert [(segment.start, segment.stop) for segment in result] == [
        near(0.0, 10.0),
        near(10.0, 20.0),
        near(20.0, 30.0),
        near(30.0, 39.98),
    ]
    assert [segment.leg for segment in result] == [None, 0, 1, 1]
    assert [segment.lateral.quantity for segment in result] == [
        "heading",
        "xtrack",
        "xtrack",
        "xtrack",
    ]


def test_commands_less_than_second_apart_begin_one_segment() -> None:
    assert len(segments(log(target__heading=after(10.0, 0.5) + after(10.5, 0.1)))) == 2


def test_a_step_has_overshoot_and_settling() -> None:
    # 100 (1 - exp(-t/4) cos(t)) has its first maximum where tan(t) = -1/4, t = pi - atan(1/4) =
    # 2.897 s. It is 100 exp(-0.724) cos(2.897) = -47.0 beyond the command.
    t = np.maximum(T - 5.0, 0.0)
    altitude = 100.0 * (1.0 - np.exp(-t / 4.0) * np.cos(t))
    step = segments(log(target__altitude=after(5.0, 100.0), pose__altitude=altitude))[1].vertical
    assert step.quantity == "altitude"
    assert (step.max, step.overshoot) == approx((100.0, 47.0), abs=0.1)
    error = 100.0 * np.exp(-t / 4.0) * np.cos(t)  # the closed form
    last = T[np.flatnonzero(np.abs(error) * (T >= 5.0) > 5.0)[-1]]
    assert step.settling == approx(last + 0.02 - 5.0, abs=1e-6)


def test_what_begins_within_band_has_no_step() -> None:
    errors = segments(log(pose__altitude=3.0))[0].vertical
    assert (errors.rms, errors.max) == near(3.0, 3.0)
    assert (errors.overshoot, errors.settling) == (None, None)


def test_heading_error_is_that_of_shorter_side() -> None:
    errors = segments(log(pose__psi=math.radians(-179.0), target__heading=math.radians(179.0)))[
        0
    ].lateral
    assert errors.max == approx(math.radians(2.0))


def test_summary_names_bank_age_and_limited_commands() -> None:
    tape = log(
        pose__phi=after(10.0, -0.4), age__pose=after(39.0, 0.3), limited__bank=after(30.0, 1.0)
    )
    summary = guidance_summary(tape)
    assert summary is not None
    assert (summary["bank"], summary["age_pose"]) == (0.4, 0.3)
    assert summary["limited"]["bank"] == approx(0.25)
    assert summary["limited"]["slew"] == 0.0
    assert guidance_summary(Tape({}, EPOCH)) is None
    json.dumps(summary)


def test_wind_follows_from_velocities_over_ground_and_through_air() -> None:
    # To the east at 40 m/s through the air, climbing at 4 m/s, 3 m/s faster than trim, in a wind to
    # (1, -6).
    level = math.sqrt(43.0**2 - 4.0**2)
    tape = log(
        pose__psi=1.4,
        pose__beta=math.pi / 2.0 - 1.4,
        y__V=3.0,
        pose__climb=4.0,
        pose__v_north=1.0,
        pose__v_east=level - 6.0,
    )
    assert guided_figures.mean_wind(tape, SPEED, parts=2) == approx(
        np.array([[1.0, -6.0]] * 2), abs=1e-9
    )


@pytest.fixture(scope="module")
def flight() -> RecordedFlight:
    """Return the first seconds of the osprey's route, in which it captures the first leg."""
    scenario = find_scenario("osprey_route").vary(flight={"duration": 4.0})
    tape = simulate(scenario)
    return RecordedFlight("osprey_route", scenario, tape, summarise(tape, scenario))


def test_log_without_a_channel_of_guidance_is_refused(
    flight: RecordedFlight, tmp_path: Path
) -> None:
    guidance = flight.tape["guidance"]
    names = [name for name in guidance.names if name not in {"missed", "age.link"}]
    fewer = Signal(
        guidance.stamp_ns, tuple(names), np.column_stack([guidance[name] for name in names])
    )
    tape = replace(flight.tape, signals={**flight.tape.signals, "guidance": fewer})
    write_run(tape, tmp_path / "run", LogAttachments(find_scenario("osprey_route").path))
    with refusing("guidance: found a log without missed, age.link, expected all of its channels"):
        read_flight(tmp_path / "run")


def test_figures_of_flight_are_those_of_scenario(flight: RecordedFlight) -> None:
    (route,) = guided_figures.flown_routes(flight.scenario, flight.tape)
    assert isinstance(route.legs[0], Line)
    assert isinstance(route.legs[1], Arc)
    bounds = guided_figures.bounds_of(flight.scenario)
    assert bounds["V"] == (0.8 * 25.0, 1.4 * 25.0)  # by rule, without a stall speed and a limit
    # less turbulence
    assert guided_figures.mean_wind(flight.tape, 25.0) == approx(
        np.array([[3.0, 0.0]] * 8), abs=1.0
    )


def test_track_of_numbered_legs_and_fence_follows_outputs(
    flight: RecordedFlight, tmp_path: Path
) -> None:
    write_page(tmp_path / "page.html", [flight])
    page = (tmp_path / "page.html").read_text()
    places = [
        page.index(f">{title}</h2>")
        for title in ("Output y over the reference y_m", "Ground track")
    ]
    assert places == sorted(places)
    assert places[-1] < page.index("<table>")
    fence = Fence(
        (
            Zone((0.0, 900.0, 900.0), (0.0, 0.0, 900.0)),
            Zone((400.0,), (200.0,), 50.0, exclude=True),
        ),
        (300.0, 100.0),
    )
    routes = guided_figures.flown_routes(flight.scenario, flight.tape)
    figure = guided_figures.track_figure(flight.tape, routes, 25.0, fence)
    traces = {trace.name: trace for trace in drawn(figure).data}
    is_number = [each.get("name") == guided_figures.LEG for each in figure.layout["annotations"]]
    # the numbers lie over the arrows of the wind
    assert is_number == [False] * 8 + [True] * 8
    numbers = figure.layout["annotations"][8:]
    assert [number["text"] for number in numbers] == list("01234567")
    fillet = routes[0].legs[1]
    assert isinstance(fillet, Arc)
    place = numbers[1]["y"], numbers[1]["x"]
    assert math.dist(place, fillet.centre) == approx(abs(fillet.radius))
    assert (traces["start"].y[0], traces["start"].x[0]) == approx((0.0, 0.0), abs=1.0)
    # a text beside a mark would cover the number of a leg there
    assert all(trace.text is None or "text" not in trace.mode for trace in traces.values())
    assert np.asarray(traces["fence"].y).tolist() == [0.0, 900.0, 900.0, 0.0]
    assert np.hypot(traces["keep out"].y - 400.0, traces["keep out"].x - 200.0) == approx(
        np.full(73, 50.0)
    )
    assert (traces["home"].y[0], traces["home"].x[0]) == (300.0, 100.0)
