# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test the report: figures, shaded intervals, tables, events, and the size of the page."""

import base64
import colorsys
import hashlib
import math
import re
import zlib
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from plotly.offline import get_plotlyjs
from tests.plots import drawn
from tests.recordings import EPOCH, MS, signal

from flight_analysis.closed_loop.scenario import Scenario
from flight_analysis.closed_loop.scenario_library import find_scenario
from flight_analysis.closed_loop.simulate import simulate
from flight_analysis.report import (
    comparison,
    figures,
    guided_figures,
    html,
    intervals,
    plotting,
)
from flight_analysis.report.display_units import DisplayUnit, display_units, state_units
from flight_analysis.report.disturbances import transients
from flight_analysis.report.html import write_page
from flight_analysis.report.plotting import Figure, PlotContext
from flight_analysis.report.spectra import spectra
from flight_analysis.report.summary import RecordedFlight, summarise
from flight_analysis.report.summary_rows import TIMING_COLUMNS, timing_rows
from flight_analysis.report.tables import events, metric_tables
from flight_analysis.report.timing import AgeMetrics, LatencyMetrics, TickMetrics
from flight_core.modes import Mode
from flight_core.outcome import COMPLETED, Outcome, ended_early
from flight_core.tape import Signal, Tape
from flight_core.vectors import FloatArray
from rise_di_controller.internals import Saturation

pytestmark = pytest.mark.slow

OUTPUTS = ("q", "V", "p", "r")
INPUTS = ("elevator", "aileron", "rudder", "thrust")
# headings on every page with a linear loop
OF_LOOP = ("Bode plot of the loop", "Nyquist plot of the loop")
TABLES = ("All figures", "Parameters other than the default, and those without one", "Words")
DEG = np.pi / 180.0


@pytest.fixture(scope="module")
def servo() -> Scenario:
    return find_scenario("osprey_servo")


def held(count: int = 101, /, **channels: Any) -> Signal:
    """Return channels at 100 Hz, most of which are constant. In a name, `__` stands for a dot."""
    return signal(
        [10.0 * k for k in range(count)],
        **{name.replace("__", "."): value for name, value in channels.items()},
    )


def ticks(count: int = 101, /, **channels: Any) -> Signal:
    """Return the internals of a controller at 100 Hz that was on time and never saturated.

    `channels` replaces some of them.
    """
    limits = {f"limited.{name}": Saturation.NO for name in INPUTS}
    integrals = {f"{group}.{name}": 0.0 for group in ("integral_e", "Pi") for name in OUTPUTS}
    return held(
        count,
        **(
            {"mode": Mode.ENGAGED, "dt": 0.01, "late": 0.0, "age": 0.0}
            | limits
            | integrals
            | channels
        ),
    )


def flight(count: int = 101, **signals: Signal) -> Tape:
    """Return a flight at 100 Hz whose outputs are zero, with the given signals."""
    zero = held(count, **dict.fromkeys(OUTPUTS, 0.0))
    return Tape({"y": zero, "y_m": zero, **signals}, EPOCH)


@pytest.fixture
def complete() -> Tape:
    """Return a flight with all signals of a simulation."""
    states = dict.fromkeys(("x__q", "x__V", "x__p", "x__r", "actuator__elevator"), 0.0)
    truth = held(**states, gust__vertical=2.0, noise__q=1e-3)
    return flight(u=held(**dict.fromkeys(INPUTS, 0.1)), internals=ticks(late=1e-3), truth=truth)


def context(tape: Tape, units: dict[str, DisplayUnit] | None = None) -> PlotContext:
    run = RecordedFlight("run", find_scenario("osprey_servo"), tape, {})
    return figures.plot_context([run])._replace(units=units or {})


def traces(figure: Figure | None, name: str) -> list[Any]:
    return [trace for trace in drawn(figure).data if trace.name == name]


def titles(figure: Figure | None) -> list[str]:
    """Return the titles of the rows from top to bottom."""
    return [axis.title.text for axis in drawn(figure).select_yaxes()]


def page_of(tmp_path: Path, scenario: Scenario, tape: Tape, outcome: Outcome = COMPLETED) -> str:
    path = tmp_path / "report.html"
    write_page(path, [recorded("run", scenario, tape, outcome)])
    return path.read_text()


def recorded(
    name: str, scenario: Scenario, tape: Tape, outcome: Outcome = COMPLETED
) -> RecordedFlight:
    return RecordedFlight(name, scenario, tape, summarise(tape, scenario, outcome))


def headings(page: str) -> list[str]:
    """Return the headings of the blocks in their order, without the headings of the tiles."""
    return re.findall(r'<h2 id="[^"]*">([^<]*)</h2>', page)


@pytest.mark.parametrize("columns", [2, 3, 4])
def test_labels_of_a_column_fit_beside_its_neighbour(columns: int) -> None:
    """An axis title and the longest labels, such as -0.025, take 65 pixels at 12 pixels per line.

    The figure fits into a sheet of 1100 pixels with a padding of 16 on each side.
    """
    figure = plotting.set_layout(Figure(columns, columns, 100))
    left = [x["domain"][0] for x in figure.x]
    right = [x["domain"][1] for x in figure.x]
    margin = figure.layout["margin"]
    wide = figure.least_width - margin["l"] - margin["r"]
    assert (
        min(wide * (after - before) for before, after in zip(right, left[1:], strict=False)) >= 65.0
    )
    assert figure.least_width <= 1100 - 2 * 16


def test_a_simulated_flight_has_every_figure(
    tmp_path: Path, servo: Scenario, complete: Tape
) -> None:
    assert headings(page_of(tmp_path, servo, complete)) == [
        "Output y over the reference y_m",
        "Input u and the actuators",
        "Tracking error e = y - y_m",
        "What holds for this flight",
        "Wind",
        "States",
        "Integrals of the law",
        "Error of the sensors",
        "Spectrum of u",
        *OF_LOOP,
        "Ticks of the controller",
        "Timing of the ticks",
        *TABLES,
    ]


def test_flight_of_one_sample_has_report(tmp_path: Path, servo: Scenario) -> None:
    one = flight(
        1, u=held(1, **dict.fromkeys(INPUTS, 0.0)), internals=ticks(1), truth=held(1, x__q=0.0)
    )
    # y, u, e, claims, states, integrals: no wind, no late tick
    assert len(headings(page_of(tmp_path, servo, one))) == 6 + len(OF_LOOP) + len(TABLES)


def test_page_of_minute_of_noise_is_below_five_megabytes(tmp_path: Path, servo: Scenario) -> None:
    # White noise on all channels at the rates of the scenario hardly compresses. plotly itself
    # takes 0.5 MB. Measured 4.2 MB.
    random = np.random.default_rng(1)

    def noise(rate: int, *names: str) -> Signal:
        stamps = EPOCH + np.arange(60 * rate + 1, dtype=np.int64) * (1000 * MS // rate)
        return Signal(stamps, names, random.standard_normal((len(stamps), len(names))))

    states = ["V", "alpha", "q", "theta", "beta", "p", "r", "phi"]
    groups = {"x": states, "gust": ["a", "b", "c"], "actuator": INPUTS, "noise": OUTPUTS}
    signals = {"y": noise(500, *OUTPUTS), "y_m": noise(500, *OUTPUTS), "u": noise(100, *INPUTS)}
    signals["truth"] = noise(
        500, *(f"{group}.{name}" for group, names in groups.items() for name in names)
    )
    page = page_of(tmp_path, servo, Tape(signals, EPOCH))
    assert len(page) < 5e6
    assert 'src="http' not in page


def test_text_of_a_log_is_escaped(tmp_path: Path, servo: Scenario) -> None:
    page = page_of(
        tmp_path, servo, flight(), outcome=ended_early("ended: <script>alert(1)</script>")
    )
    assert "nded: &lt;script&gt;alert(1)&lt;/script&gt;" in page
    assert "<script>alert" not in page


def test_every_colour_of_page_has_dark_counterpart(
    tmp_path: Path, servo: Scenario, complete: Tape
) -> None:
    # Colours of modes, saturations and gusts serve light and dark pages alike.
    shared = {
        *intervals.MODE_COLOURS.values(),
        *figures.SATURATION_COLOURS.values(),
        intervals.GUST,
    }
    specifications = re.findall(
        r'<script type="application/json">(.*?)</script>', page_of(tmp_path, servo, complete)
    )
    colours = set(re.findall(r"#[0-9a-f]{6}", " ".join(specifications)))
    assert colours - shared <= set(plotting.DARK | figures.DARK)
    assert len(colours) > 5


def test_each_event_listed_once_in_order_of_start() -> None:
    modes = (
        (20, "ENGAGED"),
        (10, "HOLD"),
        (20, "ENGAGED"),
        (5, "HOLD"),
        (5, "RAMP"),
        (41, "ENGAGED"),
    )
    mode = [Mode[name] for count, name in modes for _ in range(count)]
    rate = (
        [Saturation.NO] * 2
        + [Saturation.RATE] * 3
        + [Saturation.NO] * 90
        + [Saturation.RATE]
        + [Saturation.NO] * 5
    )
    tape = flight(internals=ticks(mode=mode, limited__thrust=rate))
    listed = events(tape, {"lateral": (0.9, 2.0), "vertical": (5.0, 6.0)})
    assert [
        (event.name, round(event.start, 3), round(event.stop, 3), event.extent) for event in listed
    ] == [
        ("thrust saturated: rate", 0.02, 0.95, "4 of 101 ticks"),
        ("hold", 0.2, 0.55, "0.15 s, 2 times"),  # 0.2 s to 0.3 s and 0.5 s to 0.55 s
        ("ramp", 0.55, 0.6, "0.05 s"),
        ("lateral gust", 0.9, 1.0, "0.10 s"),  # the flight ends during it, before the other gust
    ]


def test_faults_of_effectors_are_events_up_to_the_end(servo: Scenario) -> None:
    faults = ["rudder hard_over 0.2 upper", "thrust failed 0.4", "aileron lost 7"]
    flown = servo.vary(
        aircraft={"actuators": servo.aircraft.actuators.model_dump() | {"faults": faults}}
    )
    assert [tuple(event) for event in events(flight(101), {}, flown)] == [
        ("fault: rudder hard_over", 0.2, 1.0, "upper"),
        ("fault: thrust failed", 0.4, 1.0, ""),
    ]


def test_every_mode_but_engaged_is_interval_with_name() -> None:
    assert set(intervals.MODE_COLOURS) == set(Mode) - {Mode.ENGAGED}
    assert set(figures.SATURATION_COLOURS) == set(Saturation) - {Saturation.NO}
    modes = [mode for mode in Mode for _ in range(10)]
    found = intervals.mode_intervals(flight(60, internals=ticks(60, mode=modes)))
    assert {interval.label: (round(interval.start, 3),
    round(interval.stop, 3)) for interval in found} == {
        "waiting": (0.0, 0.1), "hold": (0.2, 0.3), "ramp": (0.3, 0.4), "trim": (0.4, 0.5),
        "inactive": (0.5, 0.59),
    }  # fmt: skip


@pytest.mark.parametrize("columns", [1, 2])
def test_legend_names_each_shade_and_message(columns: int) -> None:
    modes = [mode for mode in Mode for _ in range(10)]
    run = context(flight(60, internals=ticks(60, mode=modes)))._replace(messages=[0.1])
    y = plotting.Curve(run.tape["y"], figures.PLANT)
    figure = drawn(plotting.time_series_figure(run, {"y": y}, columns=columns))
    shades = {shape.fillcolor for shape in figure.layout.shapes if shape.type == "rect"}
    named = [trace for trace in figure.data if trace.showlegend]
    assert shades == set(intervals.MODE_COLOURS.values())
    assert {trace.marker.color for trace in named if trace.mode == "markers"} >= shades
    assert "message of the log" in {trace.name for trace in named}
    # plotly stacks the entries of a legend where the curve alone has a group
    assert {trace.legendgroup or "" for trace in figure.data} == {""}


def test_modes_of_guidance_and_controller_differ_in_colour() -> None:
    colours = [*intervals.MODE_COLOURS.values(), *guided_figures.MODE_SHADES.values()]
    assert len({*colours, intervals.GUST}) == len(colours) + 1


def test_spectrum_of_commanded_sine_has_peak_there() -> None:
    u = held(1001, elevator=np.sin(2.0 * np.pi * 5.0 * np.arange(1001) / 100.0), thrust=0.0)
    units = {"elevator": DisplayUnit(unit="deg", factor=1 / DEG)}
    figure = figures.spectrum_figure(context(flight(u=u), units))
    assert titles(figure) == ["elevator (deg/√Hz)", "thrust (/√Hz)"]
    elevator = drawn(figure).data[0]
    assert elevator.x[np.argmax(elevator.y)] == pytest.approx(5.0, abs=0.2)
    # eleven samples
    assert figures.spectrum_figure(context(flight(u=u.until(EPOCH + 100 * MS)))) is None


@pytest.fixture(scope="module")
def pair(servo: Scenario) -> list[RecordedFlight]:
    """Return two flights, the second with half the error in q and without p."""
    y_m = signal([0, 1000], **dict.fromkeys(OUTPUTS, 1.0))
    first = flight(y=signal([0, 1000], q=1.2, V=1.0, p=1.0, r=1.0), y_m=y_m)
    second = flight(y=signal([0, 1000], r=1.0, V=1.0, q=1.1), y_m=y_m)
    return [recorded("a", servo, first), recorded("b", servo, second)]


def test_metrics_of_several_flights_compared_by_channel_name(pair: list[RecordedFlight]) -> None:
    compared = {
        table.caption: {row.name: row for row in table.rows}
        for table in comparison.error_tables(pair)
    }
    assert list(compared) == ["q (deg/s)", "p (deg/s)", "r (deg/s)", "V (m/s)"]
    rms = compared["q (deg/s)"]["rms whole"]
    assert rms.texts == ("11.5", "5.73")  # 0.2 and 0.1 rad/s
    assert rms.ratios == pytest.approx((1.0, 0.5))
    assert compared["p (deg/s)"]["rms whole"].texts == ("0.00", "-")
    assert compared["p (deg/s)"]["rms whole"].ratios == (None, None)  # no ratio to 0
    assert "rms gust" not in compared["q (deg/s)"]  # neither flight had one


def test_a_comparison_is_a_page(tmp_path: Path, pair: list[RecordedFlight]) -> None:
    write_page(tmp_path / "comparison.html", pair)
    page = (tmp_path / "comparison.html").read_text()
    assert "2 flights compared" in page
    assert '<td class="better">&times;0.500</td>' in page
    assert headings(page) == [
        "Output y over the reference y_m",
        "Tracking error e = y - y_m",
        "All figures",
        "Differences of the signals from the first flight",
        "Words",
    ]


def test_figures_of_a_comparison_are_those_of_the_report(pair: list[RecordedFlight]) -> None:
    """Both flights have the same reference, which is drawn once.

    A flight has the same colour in all figures.
    """
    context_of_pair = figures.plot_context(pair)
    q = {trace.name: trace for trace in drawn(figures.tracking_figure(context_of_pair)).data[:3]}
    assert list(q) == ["y_m", "a", "b"]
    assert q["y_m"].line.color == figures.REFERENCE
    errors = {trace.name: trace for trace in drawn(figures.error_figure(context_of_pair)).data[:2]}
    assert errors["b"].y == pytest.approx([0.1 / DEG] * 2)  # deg/s
    assert [errors[name].line.color for name in "ab"] == [q[name].line.color for name in "ab"]
    assert len({trace.line.color for trace in q.values()}) == 3


def test_colour_of_the_reference_is_that_of_no_flight() -> None:
    """The hues differ by more than 20 deg, on light and dark pages.

    Red and orange differ by 30 deg.
    """

    def hue(colour: str) -> float:
        return colorsys.rgb_to_hsv(*(int(colour[k : k + 2], 16) for k in (1, 3, 5)))[0] * 360.0

    for palette in (dict(zip(figures.DARK, figures.DARK, strict=True)), figures.DARK):
        for colour in figures.COLOURS:
            apart = hue(palette[colour]) - hue(palette[figures.REFERENCE])
            assert abs(math.remainder(apart, 360.0)) > 20.0, colour


def test_every_time_of_the_summary_has_a_heading() -> None:
    """Each metric is declared once, and the tables leave out no metric of the timing."""
    kinds: dict[str, Any] = {
        "ticks": TickMetrics,
        "latency": LatencyMetrics,
        "age_of_u": AgeMetrics,
    }
    columns = [(topic, name) for topic, kind in kinds.items() for name in kind._fields]
    assert sorted(column.path for column in TIMING_COLUMNS) == sorted(columns)
    summary = {topic: dict.fromkeys(kind._fields, 0.0125) for topic, kind in kinds.items()}
    rows = {label: text for _, label, text in timing_rows(summary, is_timed=True)}
    assert rows["period mean / p99 / max (ms)"] == "12.500 / 12.500 / 12.500"
    assert len(rows) == len({column.group for column in TIMING_COLUMNS})
    # In simulated time a tick is neither late nor early.
    counts = [label for _, label, _ in timing_rows(summary, is_timed=False)]
    assert counts == ["ticks", "periods without a new y"]


WINDS: dict[str, dict[str, Any]] = {
    "calm": {"gusts": {}},
    "wind": {"gusts": {}, "wind": [5.0, 0.0]},
    "turbulence": {"gusts": {}, "wind": [5.0, 0.0], "turbulence": {"altitude": 100.0, "wind": 8.0}},
}


@pytest.mark.parametrize("air", WINDS)
def test_part_without_command_and_gust_is_named_by_what_was_in_the_air(
    air: str, servo: Scenario
) -> None:
    """Only calm air has an ultimate bound."""
    scenario = servo.vary(aircraft=WINDS[air], flight={"duration": 3.0})
    figures_of_q = summarise(simulate(scenario))["errors"]["q"]
    assert figures_of_q[air]["rms"] > 0.0
    assert {*figures_of_q} & {"calm", "wind", "turbulence", "other"} == {air}
    ultimate = figures_of_q[air]["max"] if air == "calm" else None
    assert figures_of_q["bound"] == ultimate


def test_wind_of_an_aircraft_of_another_maker_is_not_known(servo: Scenario) -> None:
    """Without truth in the log, the gusts of the scenario were not flown.

    The air has no name then.
    """
    y_m = signal([0, 1000], **dict.fromkeys(OUTPUTS, 1.0))
    tape = flight(y=y_m, y_m=y_m)
    assert summarise(tape, servo)["air"] == "other"
    assert {event.kind for event in transients(servo, tape)} == {"command"}


def test_gust_that_comes_again_is_a_gust_each_time(servo: Scenario) -> None:
    gust = {"start": 1.0, "speed": 4.0, "length": 15.0, "every": 3.0}
    scenario = servo.vary(aircraft={"gusts": {"lateral": gust}}, flight={"duration": 9.0})
    assert [start for start, _ in scenario.gust_windows().values()] == [1.0, 4.0, 7.0]
    listed = intervals.gust_intervals(simulate(scenario), scenario.gust_windows())
    assert [(each.label, each.start) for each in listed] == [
        ("lateral gust", 1.0),
        ("lateral gust", 4.0),
        ("lateral gust", 7.0),
    ]


@pytest.fixture(scope="module")
def unlike(servo: Scenario) -> list[RecordedFlight]:
    """Return a flight in a gust, one in turbulence, and one in the gust with other gains."""
    gust = {"vertical": {"start": 1.0, "speed": 4.0, "length": 15.0}}
    gusts = servo.vary(aircraft={"gusts": gust}, flight={"duration": 3.0})
    turbulence = servo.vary(aircraft=WINDS["turbulence"], flight={"duration": 3.0})
    gains = gusts.vary(controller={"delay": 0.02})
    return [
        recorded(name, scenario, simulate(scenario))
        for name, scenario in (("gusts", gusts), ("turbulence", turbulence), ("gains", gains))
    ]


def test_comparison_of_unlike_flights_begins_with_what_differs(
    unlike: list[RecordedFlight], tmp_path: Path
) -> None:
    """The listed parameters are those in which the three scenarios differ.

    A ratio between flights in different wind is neither better nor worse. One between different
    gains is.
    """
    listed = {each.key: each.texts for each in comparison.conditions(unlike)}
    assert listed["aircraft.turbulence.wind"] == ("none", "8", "none")
    assert listed["aircraft.gusts.vertical.speed"] == ("4", "none", "4")
    assert "controller.delay" in listed
    assert list(listed).index("controller.delay") == len(listed) - 1
    rows = [row for table in comparison.error_tables(unlike) for row in table.rows]
    assert {row.verdict(1) for row in rows} == {"same"}
    assert {row.verdict(2) for row in rows} > {"same"}
    write_page(tmp_path / "comparison.html", unlike)
    page = (tmp_path / "comparison.html").read_text()
    assert headings(page)[:2] == ["What differs", "Output y over the reference y_m"]
    assert comparison.UNLIKE in page


def test_gusts_of_one_flight_are_not_drawn_over_another(unlike: list[RecordedFlight]) -> None:
    gusts, turbulence, gains = unlike
    assert figures.plot_context([gusts, turbulence]).intervals == []
    labels = [each.label for each in figures.plot_context([gusts, gains]).intervals]
    assert labels == ["vertical gust"]


def test_ticks_of_another_time_are_neither_better_nor_worse(unlike: list[RecordedFlight]) -> None:
    """A flight in one process has no late tick, and tells nothing about a host in real time."""
    first = unlike[0]
    later = replace(first.tape, start_ns=EPOCH)
    pair = [first._replace(tape=later), first._replace(name="in one process")]
    assert comparison.has_same_conditions(pair) == (True, True)
    assert comparison.has_same_conditions(pair, timed=True) == (True, False)
    assert [each.key for each in comparison.conditions(pair)] == ["flown"]


def test_channels_of_page_and_tables_are_in_order_of_the_controller(servo: Scenario) -> None:
    """The y of the osprey has the order q, V, p, r, and the controller has q, p, r, V."""
    tape = simulate(servo.vary(flight={"duration": 1.0}))
    one = recorded("run", servo, tape)
    order = list(servo.controller.outputs)
    assert list(one.summary["errors"]) == order == ["q", "p", "r", "V"]
    assert list(one.summary["inputs"]) == list(servo.controller.inputs)
    context_of_one = figures.plot_context([one])
    labels = ["q (deg/s)", "p (deg/s)", "r (deg/s)", "V (m/s)"]
    assert titles(figures.tracking_figure(context_of_one)) == labels
    assert titles(figures.error_figure(context_of_one)) == labels
    integrals = ["∫e q (deg)", "∫e p (deg)", "∫e r (deg)", "∫e V (m)"]
    assert titles(figures.integral_figure(context_of_one))[::2] == integrals


def test_noise_floor_bounds_what_a_measured_error_tells_and_not_a_true_one(
    servo: Scenario,
) -> None:
    """The true error is y - y_m of the simulation, without the noise of the sensors."""
    tape = simulate(servo.vary(flight={"duration": 1.0}))
    without_truth = {name: each for name, each in tape.signals.items() if name != "truth"}
    behind_sensors = replace(tape, signals=without_truth)
    for one, expected in (
        (recorded("true", servo, tape), "true error: y - y_m without the noise"),
        (recorded("measured", servo, behind_sensors), "a smaller measured error cannot be"),
    ):
        table = next(
            each
            for each in metric_tables(one.summary, one.units)
            if each.caption.startswith("Tracking error")
        )
        assert expected in table.legend
        assert ("cannot be distinguished" in table.legend) == (one.name == "measured")


def test_jitter_says_what_it_is(servo: Scenario) -> None:
    one = recorded("run", servo, simulate(servo.vary(flight={"duration": 1.0})))
    # Only a flight in the time of its host has a jitter.
    one.summary["flight"] = {"start_ns": EPOCH, "started": None}
    ticks = next(
        table
        for table in metric_tables(one.summary, one.units)
        if table.caption.startswith("Ticks of the controller")
    )
    assert any("jitter" in row[0] for row in ticks.rows)
    assert "jitter: how far the time between two ticks is" in ticks.legend


def test_states_have_units_and_angles_are_in_degrees(servo: Scenario) -> None:
    """One degree of alpha is drawn as 1."""
    truth = held(x__alpha=DEG, x__theta=2.0 * DEG, x__q=3.0 * DEG, x__V=4.0)
    labels = {"V": "V - 25 (m/s)"}
    units = display_units(servo)
    figure = figures.state_figure(context(flight(truth=truth), units), state_units(servo), labels)
    curves = dict(zip(titles(figure), drawn(figure).data, strict=True))
    expected = {"q (deg/s)": 3.0, "V - 25 (m/s)": 4.0, "alpha (deg)": 1.0, "theta (deg)": 2.0}
    assert list(curves) == list(expected)  # outputs first, in their order
    assert {title: curve.y[0] for title, curve in curves.items()} == pytest.approx(expected)


def test_sentence_on_the_sign_stands_at_the_law(tmp_path: Path, servo: Scenario) -> None:
    """The sentence on the sign is in the section of the law, and not in the head of the page.

    The head has the aircraft and the flown time.
    """
    page = page_of(tmp_path, servo, simulate(servo.vary(flight={"duration": 1.0})))
    head, _, following = page.partition("<nav")
    assert "softened sign" not in head
    assert "osprey, control law rise_di · 1.0 s flown" in head
    law = following.partition("Integrals of the law</h2>")[2].partition("</section>")[0]
    assert "At 100 Hz with the softened sign" in law


def test_curve_is_broken_at_gap_and_u_held() -> None:
    stamps = [10.0 * k for k in range(101) if not 30 <= k < 60]
    gapped, u = (signal(stamps, **dict.fromkeys(names, 1.0)) for names in (OUTPUTS, INPUTS))
    tape = flight(y=gapped, u=u)
    y: FloatArray = traces(figures.tracking_figure(context(tape)), "y")[0].y
    assert np.flatnonzero(np.isnan(y)).tolist() == [30]
    assert not np.isnan(traces(figures.input_figure(context(tape), {}), "u")[0].y).any()


def unpacked(text: str, kind: str) -> FloatArray:
    """Unpack samples as the script of the page does."""
    shuffled = np.frombuffer(zlib.decompress(base64.b64decode(text)), dtype=np.uint8)
    return np.ascontiguousarray(shuffled.reshape(np.dtype(kind).itemsize, -1).T).view(kind)[:, 0]


def test_all_samples_of_long_curves_stored_once() -> None:
    count = 5000
    stamps = EPOCH + np.arange(count, dtype=np.int64) * 2 * MS
    y = Signal(stamps, OUTPUTS, np.random.default_rng(1).standard_normal((count, 4)))
    shared = context(
        Tape({"y": y, "y_m": Signal(stamps, OUTPUTS, np.zeros((count, 4)))}, EPOCH - 7)
    )
    ticks_found = [
        *drawn(figures.tracking_figure(shared)).data,
        *drawn(figures.error_figure(shared)).data,
    ]
    q = [trace for trace in ticks_found if trace.yaxis == "y"]
    assert [trace.y for trace in q] == [None] * 3
    instants = np.cumsum(unpacked(shared.samples.packed[q[1].meta["t"]], "<f8"))
    assert instants.tolist() == (stamps - EPOCH + 7).tolist()  # to the nanosecond
    steps = unpacked(shared.samples.packed[q[1].meta["v"]], "<u4")
    stored = np.cumsum(steps, dtype=np.uint32).view(np.float32)
    np.testing.assert_allclose(stored, y["q"], rtol=2.0**-13.9)  # MANTISSA, and float32
    assert q[1].meta["v"] == q[2].meta["v"]  # y_m is 0, so e equals y
    assert len(shared.samples.packed) == 1 + 4 + 1  # one time, four y, and the zeros of all y_m


def test_page_has_extremes_of_bins_of_very_long_curve(monkeypatch: pytest.MonkeyPatch) -> None:
    """A very long curve is stored as the extremes of bins.

    With all samples, the page of an hour had 141 MB. Here a bin has four samples, and the third has
    a gap.
    """
    monkeypatch.setattr(plotting, "MAX_STORED", 6)
    monkeypatch.setattr(plotting, "BINS", 3)
    stamps = np.array([0, 1, 2, 3, 4, 5, 6, 7, 8, 100, 101], dtype=np.int64)
    values = np.array([1.0, 5.0, 0.0, 2.0, 7.0, 9.0, 8.0, 6.0, 3.0, 4.0, 5.0])
    shared = context(Tape({}))
    t, v = (
        shared.samples.packed[name]
        for name in plotting.stored(shared, Signal(stamps, ("q",), values[:, None]), "q", 1.0)
    )
    assert np.cumsum(unpacked(t, "<f8")).tolist() == [0, 2, 4, 6, 8, 100]
    drawn = np.cumsum(unpacked(v, "<u4"), dtype=np.uint32).view(np.float32)
    np.testing.assert_array_equal(drawn, [5.0, 0.0, 9.0, 6.0, 3.0, np.nan])


def test_page_of_long_flight_does_not_grow_with_it() -> None:
    """The flight is 80 min of noise at 100 Hz, which cannot be compressed."""
    stamps = np.arange(480_000, dtype=np.int64) * 10 * MS
    u = Signal(stamps, ("u",), np.random.default_rng(1).standard_normal((480_000, 1)))
    shared = context(Tape({"u": u}))
    plotting.stored(shared, u, "u", 1.0)
    # at most 4 bytes a value, in base64
    assert sum(map(len, shared.samples.packed.values())) < 6 * plotting.MAX_STORED
    assert len(spectra(u, 10 * MS)[0]) == 4096  # half of the longest window


def test_vendored_plotly_is_that_of_hash_and_of_release_of_python_package() -> None:
    vendor = Path(html.__file__).parent / "vendor"
    bundle = (vendor / "plotly-basic.min.js").read_bytes()
    assert hashlib.sha256(bundle).hexdigest() in (vendor / "README.md").read_text()
    release = re.compile(r"plotly\.js (?:\(.*\) )?v(\S+)")
    ours, theirs = (release.search(text[:200]) for text in (bundle.decode(), get_plotlyjs()))
    assert ours is not None
    assert theirs is not None
    assert ours[1] == theirs[1]
