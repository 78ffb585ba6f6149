# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""The report: its figures, shaded intervals, tables and events, and the size of the page."""

import base64
import hashlib
import json
import re
import zlib
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
from flight_analysis.metrics import mask_spans
from flight_analysis.report import comparison, figures, html, plotting, summary
from flight_analysis.report.figures import input_limits
from flight_analysis.report.html import Page, TableGroup, page_html, write_page
from flight_analysis.report.plotting import Figure, Interval, PlotContext, SampleStore
from flight_analysis.report.summary import DisplayUnit, RecordedFlight, mode_notes, summarise
from flight_analysis.report.tables import events
from flight_core.modes import Mode
from flight_core.outcome import COMPLETED
from flight_core.tape import Signal, Tape
from flight_core.vectors import FloatArray
from rise_di_controller.internals import Saturation

pytestmark = [pytest.mark.package("flight_analysis"), pytest.mark.slow]

OUTPUTS, INPUTS = ("q", "V", "p", "r"), ("elevator", "aileron", "rudder", "thrust")
OF_LOOP = ("Bode plot of the loop", "Nyquist plot of the loop")  # headings on every page with a linear loop
DEG = np.pi / 180.0


@pytest.fixture(scope="module")
def servo() -> Scenario:
    return find_scenario("osprey_servo")


def held(count: int = 101, /, **channels: Any) -> Signal:
    """Channels at 100 Hz, of which most hold a value; `__` in a name stands for a dot."""
    return signal([10.0 * k for k in range(count)], **{name.replace("__", "."): value for name, value in channels.items()})


def ticks(count: int = 101, /, **channels: Any) -> Signal:
    """Internals of a controller at 100 Hz that was on time and never saturated, except in the channels given."""
    limited = {f"limited.{name}": Saturation.NO for name in INPUTS}
    integrals = {f"{group}.{name}": 0.0 for group in ("integral_e", "Pi") for name in OUTPUTS}
    return held(count, **({"mode": Mode.ENGAGED, "dt": 0.01, "late": 0.0, "age": 0.0} | limited | integrals | channels))


def flight(count: int = 101, **signals: Signal) -> Tape:
    """A flight at 100 Hz whose outputs are zero, with the signals given."""
    zero = held(count, **dict.fromkeys(OUTPUTS, 0.0))
    return Tape({"y": zero, "y_m": zero, **signals}, EPOCH)


@pytest.fixture
def complete() -> Tape:
    """A flight with all signals of a simulation."""
    states = dict.fromkeys(("x__q", "x__V", "x__p", "x__r", "actuator__elevator"), 0.0)
    truth = held(**states, gust__vertical=2.0, noise__q=1e-3)
    return flight(u=held(**dict.fromkeys(INPUTS, 0.1)), internals=ticks(late=1e-3), truth=truth)


def context(tape: Tape, units: dict[str, DisplayUnit] | None = None) -> PlotContext:
    return figures.plot_context(tape, units or {}, {})


def traces(figure: Figure | None, name: str) -> list[Any]:
    return [trace for trace in drawn(figure).data if trace.name == name]


def titles(figure: Figure | None) -> list[str]:
    """Titles of the rows from top to bottom."""
    return [axis.title.text for axis in drawn(figure).select_yaxes()]


def page_of(tmp_path: Path, scenario: Scenario, tape: Tape, outcome: str = COMPLETED) -> str:
    path = tmp_path / "report.html"
    write_page(path, [recorded("run", scenario, tape, outcome)])
    return path.read_text(encoding="utf-8")


def recorded(name: str, scenario: Scenario, tape: Tape, outcome: str = COMPLETED) -> RecordedFlight:
    return RecordedFlight(name, scenario, tape, summarise(tape, scenario, outcome))


def headings(page: str) -> list[str]:
    return [part.partition("</h2>")[0] for part in page.split("<h2>")[1:]]


def test_a_simulated_flight_has_every_figure(tmp_path: Path, servo: Scenario, complete: Tape) -> None:
    assert headings(page_of(tmp_path, servo, complete)) == [
        "Output y over the reference y_m",
        "Tracking error e = y - y_m",
        "Input u and the actuators",
        "Wind",
        "States",
        "Integrals of the law",
        "Error of the sensors",
        "Spectrum of u",
        "Ticks of the controller",
        "Timing of the ticks",
        *OF_LOOP,
    ]


def test_log_of_only_y_and_reference_has_report(tmp_path: Path, servo: Scenario) -> None:
    page = page_of(tmp_path, servo, flight())
    assert headings(page) == ["Output y over the reference y_m", "Tracking error e = y - y_m", *OF_LOOP]
    assert "Events" not in page


def test_pose_without_attitude_has_no_replay(tmp_path: Path, servo: Scenario) -> None:
    page = page_of(tmp_path, servo, flight(pose=held(101, climb=1.0)))
    assert headings(page) == ["Output y over the reference y_m", "Tracking error e = y - y_m", *OF_LOOP]


def test_flight_of_one_sample_has_report(tmp_path: Path, servo: Scenario) -> None:
    one = flight(1, u=held(1, **dict.fromkeys(INPUTS, 0.0)), internals=ticks(1), truth=held(1, x__q=0.0))
    assert len(headings(page_of(tmp_path, servo, one))) == 5 + len(OF_LOOP)  # y, e, u, states, integrals: no wind, no late tick


def test_page_of_minute_of_noise_is_below_five_megabytes(tmp_path: Path, servo: Scenario) -> None:
    # White noise on all channels at the rates of the scenario hardly compresses. plotly itself takes 0.5 MB. Measured 4.2 MB.
    random = np.random.default_rng(1)

    def noise(rate: int, *names: str) -> Signal:
        stamps = EPOCH + np.arange(60 * rate + 1, dtype=np.int64) * (1000 * MS // rate)
        return Signal(stamps, names, random.standard_normal((len(stamps), len(names))))

    states = ["V", "alpha", "q", "theta", "beta", "p", "r", "phi"]
    groups = {"x": states, "gust": ["a", "b", "c"], "actuator": INPUTS, "noise": OUTPUTS}
    signals = {"y": noise(500, *OUTPUTS), "y_m": noise(500, *OUTPUTS), "u": noise(100, *INPUTS)}
    signals["truth"] = noise(500, *(f"{group}.{name}" for group, names in groups.items() for name in names))
    page = page_of(tmp_path, servo, Tape(signals, EPOCH))
    assert len(page) < 5e6
    assert 'src="http' not in page


def test_page_of_default_flight_is_below_megabyte_and_half(tmp_path: Path, osprey_gust: Scenario) -> None:
    # With its replay; measured 1.495 MB, of which plotly takes 0.5 MB and the replay 0.02 MB.
    assert len(page_of(tmp_path, osprey_gust, simulate(osprey_gust))) < 1.5e6


def test_text_of_a_log_is_escaped(tmp_path: Path, servo: Scenario) -> None:
    page = page_of(tmp_path, servo, flight(), outcome="ended: <script>alert(1)</script>")
    assert "ended: &lt;script&gt;alert(1)&lt;/script&gt;" in page
    assert "<script>alert" not in page


def test_every_colour_of_page_has_dark_counterpart(tmp_path: Path, servo: Scenario, complete: Tape) -> None:
    # Colours of modes, saturations and gusts serve light and dark pages alike.
    shared = {*figures.MODE_COLOURS.values(), *figures.SATURATION_COLOURS.values(), figures.GUST}
    specifications = re.findall(r'<script type="application/json">(.*?)</script>', page_of(tmp_path, servo, complete))
    used = set(re.findall(r"#[0-9a-f]{6}", " ".join(specifications)))
    assert used - shared <= set(plotting.DARK | figures.DARK | comparison.DARK)
    assert len(used) > 5


def test_each_event_listed_once_in_order_of_start() -> None:
    modes = ((20, "ENGAGED"), (10, "HOLD"), (20, "ENGAGED"), (5, "HOLD"), (5, "RAMP"), (41, "ENGAGED"))
    mode = [Mode[name] for count, name in modes for _ in range(count)]
    rate = [Saturation.NO] * 2 + [Saturation.RATE] * 3 + [Saturation.NO] * 90 + [Saturation.RATE] + [Saturation.NO] * 5
    tape = flight(internals=ticks(mode=mode, limited__thrust=rate))
    listed = events(tape, {"lateral": (0.9, 2.0), "vertical": (5.0, 6.0)})
    assert [(event.name, round(event.start, 3), round(event.stop, 3), event.extent) for event in listed] == [
        ("thrust saturated: rate", 0.02, 0.95, "4 of 101 ticks"),
        ("hold", 0.2, 0.55, "0.15 s, 2 times"),  # 0.2 s to 0.3 s and 0.5 s to 0.55 s
        ("ramp", 0.55, 0.6, "0.05 s"),
        ("lateral gust", 0.9, 1.0, "0.10 s"),  # the flight ends during it, before the other gust
    ]


def test_span_ends_where_next_sample_begins() -> None:
    t = np.array([0.0, 1.0, 2.0, 4.0, 5.0])
    assert mask_spans(t, np.array([False, True, True, False, True])) == [(1.0, 4.0), (5.0, 5.0)]
    assert mask_spans(t, np.zeros(5, dtype=bool)) == []
    assert mask_spans(np.zeros(0), np.zeros(0, dtype=bool)) == []


def test_close_spans_merged_and_short_ones_lengthened() -> None:
    t = np.arange(10.0)
    mask = np.array([True, False, True, False, False, False, False, True, False, False])
    assert mask_spans(t, mask) == [(0.0, 1.0), (2.0, 3.0), (7.0, 8.0)]
    assert mask_spans(t, mask, min_length=1.5) == [(0.0, 3.5), (7.0, 8.5)]


def test_every_mode_but_engaged_is_interval_with_name() -> None:
    assert set(figures.MODE_COLOURS) == set(Mode) - {Mode.ENGAGED}
    assert set(figures.SATURATION_COLOURS) == set(Saturation) - {Saturation.NO}
    modes = [mode for mode in Mode for _ in range(10)]
    intervals = figures.mode_intervals(flight(60, internals=ticks(60, mode=modes)))
    assert {interval.label: (round(interval.start, 3), round(interval.stop, 3)) for interval in intervals} == {
        "waiting": (0.0, 0.1), "hold": (0.2, 0.3), "ramp": (0.3, 0.4), "trim": (0.4, 0.5), "inactive": (0.5, 0.59),
    }  # fmt: skip


def test_note_on_the_part_of_a_flight_without_the_law() -> None:
    """Any process of the host may deactivate a controller; the time before the first engagement does not count."""
    modes = [Mode.WAITING] * 50 + [Mode.ENGAGED] * 25 + [Mode.HOLD] * 5 + [Mode.INACTIVE] * 20
    (note,) = mode_notes(flight(100, internals=ticks(100, mode=modes)))
    assert note.startswith("the controller was HOLD in 10%, INACTIVE in 40% of the ticks: the figures are of the whole flight")
    for whole in ([Mode.WAITING] * 50 + [Mode.ENGAGED] * 50, [Mode.ENGAGED] * 99 + [Mode.HOLD]):
        assert mode_notes(flight(100, internals=ticks(100, mode=whole))) == []


def test_intervals_shaded_over_whole_height_of_figure() -> None:
    intervals = [Interval("hold", 0.2, 0.3, "#f2c230", False), Interval("a gust", 0.5, 0.6, "#7f7f7f", True)]
    figure = figures.tracking_figure(context(flight())._replace(intervals=intervals))
    layout = drawn(figure).layout
    shapes = [(shape.x0, shape.x1, shape.y0, shape.y1, shape.yref) for shape in layout.shapes]
    assert shapes == [(0.2, 0.3, 0, 1, "paper"), (0.5, 0.6, 0, 1, "paper")]
    assert [note.text for note in layout.annotations] == ["a gust"]
    assert len(traces(figure, "hold")) == 1  # in the legend


def input_flight(**limited: list[Saturation]) -> Tape:
    """The elevator at 2 deg, the other inputs at trim."""
    return flight(u=held(**dict.fromkeys(INPUTS, 0.0) | {"elevator": 2.0 * DEG}), internals=ticks(**limited))


def test_limits_near_input_are_in_view_and_far_ones_are_not(servo: Scenario) -> None:
    units = summary.display_units(servo)
    near = servo.vary(controller={"lower": [-3 * DEG, -1.0, -1.0, -1.0], "upper": [3 * DEG, 1.0, 1.0, 1.0]})
    for scenario, limit, inside in ((near, 3.0, True), (servo, 30.0, False)):
        tape = input_flight()
        figure = figures.input_figure(context(tape, units), input_limits(scenario, tape))
        lines = traces(figure, "limits of the controller")
        assert [line.y[0] for line in lines[:2]] == pytest.approx([-limit, limit])  # deg
        low, high = drawn(figure).layout.yaxis.range
        assert (low <= 2.0 <= high, low <= limit <= high) == (True, inside)


def test_end_stops_drawn_where_actuators_simulated(servo: Scenario) -> None:
    # End stops are in the airframe's order, u in the law's: only thrust has 50 %.
    assert set(input_limits(servo, input_flight())) == {"limits of the controller"}
    stops = input_limits(servo, flight(truth=held(actuator__elevator=0.0)))["end stops"]
    assert stops["thrust"] == (-0.5, 0.5)
    assert stops["elevator"] == pytest.approx((-30.0 * DEG, 30.0 * DEG), rel=1e-5)


def test_an_input_without_limits_has_no_lines(osprey_gust: Scenario) -> None:
    tape = input_flight()
    figure = figures.input_figure(context(tape), input_limits(osprey_gust, tape))
    assert not traces(figure, "limits of the controller")


def test_saturation_of_input_marked_in_row_alone() -> None:
    limited = [Saturation.NO] * 101
    limited[50:60], limited[80] = [Saturation.MAGNITUDE] * 10, Saturation.RATE
    figure = figures.input_figure(context(input_flight(limited__aileron=limited)), {})
    (magnitude,), (rate,) = traces(figure, "saturated: magnitude"), traces(figure, "saturated: rate")
    assert magnitude.yaxis == rate.yaxis == "y2"  # aileron is the second row
    assert magnitude.x[:2] == pytest.approx((0.5, 0.6))
    assert rate.x[:2] == pytest.approx((0.8, 0.81))


def test_actuator_drawn_over_command_by_name() -> None:
    lagging = flight(u=input_flight()["u"], truth=held(actuator__thrust=0.3, actuator__elevator=0.01))
    figure = figures.input_figure(context(lagging, {"elevator": DisplayUnit("deg", 1 / DEG)}), {})
    assert titles(figure) == ["elevator (deg)", "aileron", "rudder", "thrust"]
    by_axis = {trace.yaxis: trace.y[0] for trace in traces(figure, "actuator")}
    assert by_axis == {"y": pytest.approx(0.01 / DEG), "y4": pytest.approx(0.3)}
    assert len(traces(figure, "command u")) == 4


def test_all_states_drawn_in_unit_where_it_known() -> None:
    tape = flight(truth=held(x__q=0.25, x__altitude=1200.0))
    figure = figures.state_figure(context(tape, {"q": DisplayUnit("mrad/s", 1e3)}))
    assert titles(figure) == ["q (mrad/s)", "altitude"]
    assert [trace.y[0] for trace in traces(figure, "x")] == [250.0, 1200.0]


def test_ideal_sensors_and_still_air_have_no_figure() -> None:
    ideal = context(flight(truth=held(noise__q=0.0, gust__vertical=0.0, x__q=0.0)))
    assert figures.sensor_figure(ideal) is None
    assert figures.wind_figure(ideal) is None
    real = context(flight(truth=held(noise__q=0.0, noise__V=0.1, gust__vertical=0.0, gust__longitudinal=1.0)))
    assert titles(figures.sensor_figure(real)) == ["V"]
    assert titles(figures.wind_figure(real)) == ["longitudinal (m/s)"]


def test_range_that_is_no_number_left_to_page() -> None:
    figure = figures.input_figure(context(flight(u=held(**dict.fromkeys(INPUTS, np.nan)))), {})
    assert figure is not None
    assert json.loads(html.script_json(figure))["layout"]["yaxis"]["range"] == [None, None]


def test_true_error_drawn_over_measured_one_where_they_differ() -> None:
    states = {f"x__{name}": 0.5 for name in OUTPUTS}
    ideal = figures.error_figure(context(flight(truth=held(**states, noise__q=0.0))))
    assert {trace.name for trace in drawn(ideal).data} == {"e"}
    noisy = figures.error_figure(context(flight(truth=held(**states, noise__q=0.1))))
    assert [traces(noisy, name)[0].y[0] for name in ("measured", "true")] == [0.0, 0.5]


def test_ticks_have_figure_if_one_was_late_or_y_was_old_or_dt_changed() -> None:
    assert figures.tick_figure(context(flight(internals=ticks()))) is None
    for channel, values in (("late", [0.0] * 100 + [1e-4]), ("age", 2e-3), ("dt", [0.0] + [0.01] * 99 + [0.02])):
        figure = figures.tick_figure(context(flight(internals=ticks(**{channel: values}))))
        assert titles(figure) == ["late (ms)", "age (ms)", "dt (ms)"]


def test_visible_noise_floor_drawn_on_both_sides_of_zero() -> None:
    tape = flight(y=signal([0, 1000], **dict.fromkeys(OUTPUTS, (1.0, 0.0))))
    (floor,) = traces(figures.error_figure(context(tape), {"q": 0.5, "V": 1e-9}), "noise floor")
    assert (floor.yaxis, set(floor.y)) == ("y", {0.5, -0.5})  # only that of q is visible


def test_both_integrals_of_output_stand_side_by_side() -> None:
    tape = flight(internals=ticks(Pi__p=[0.0] * 100 + [3.0], integral_e__p=[0.0] * 100 + [2.0]))
    figure = figures.integral_figure(context(tape))
    assert titles(figure)[4:6] == ["∫e p", "Pi p"]
    assert [trace.y[-1] for trace in drawn(figure).data[4:6]] == [2.0, 3.0]


def test_spectrum_of_commanded_sine_has_peak_there() -> None:
    u = held(1001, elevator=np.sin(2.0 * np.pi * 5.0 * np.arange(1001) / 100.0), thrust=0.0)
    units = {"elevator": DisplayUnit("deg", 1 / DEG)}
    figure = figures.spectrum_figure({"u": (flight(u=u), 10 * MS)}, {"u": figures.PLANT}, units)
    assert titles(figure) == ["elevator (deg/√Hz)", "thrust (/√Hz)"]
    elevator = drawn(figure).data[0]
    assert elevator.x[np.argmax(elevator.y)] == pytest.approx(5.0, abs=0.2)
    assert figures.spectrum_figure({"u": (flight(u=u.until(EPOCH + 100 * MS)), 10 * MS)}, {}, {}) is None  # eleven samples


def test_timing_has_histogram_if_it_is_not_zero() -> None:
    assert figures.timing_figure({"": (flight(internals=ticks()), 10 * MS)}, {"": figures.PLANT}) is None
    delayed = flight(internals=ticks(), latency=signal([0, 10, 20], y_to_u=[1e-3, 1e-3, 3e-3]))
    figure = drawn(figures.timing_figure({"": (delayed, 10 * MS)}, {"": figures.PLANT}))
    assert [axis.title.text for axis in figure.select_xaxes()] == ["y sent to u sent (ms)"]
    assert [count for count in figure.data[0].y if count] == [2.0, 1.0]


@pytest.fixture(scope="module")
def pair(servo: Scenario) -> list[RecordedFlight]:
    """Two flights: the second has half the error in q, and no p."""
    y_m = signal([0, 1000], **dict.fromkeys(OUTPUTS, 1.0))
    first = flight(y=signal([0, 1000], q=1.2, V=1.0, p=1.0, r=1.0), y_m=y_m)
    second = flight(y=signal([0, 1000], r=1.0, V=1.0, q=1.1), y_m=y_m)
    return [recorded("a", servo, first), recorded("b", servo, second)]


def test_metrics_of_several_flights_compared_by_channel_name(pair: list[RecordedFlight]) -> None:
    compared = {table.caption: {row.name: row for row in table.rows} for table in comparison.error_tables(pair)}
    assert list(compared) == ["q (mrad/s)", "V (m/s)", "p (mrad/s)", "r (mrad/s)"]
    whole = compared["q (mrad/s)"]["rms whole"]
    assert whole.texts == ("200", "100")
    assert whole.ratios == pytest.approx((1.0, 0.5))
    assert compared["p (mrad/s)"]["rms whole"].texts == ("0.00", "-")
    assert compared["p (mrad/s)"]["rms whole"].ratios == (None, None)  # no ratio to 0
    assert "rms gust" not in compared["q (mrad/s)"]  # neither flight had one


def test_less_error_is_better_and_less_input_is_neither() -> None:
    def verdicts(lower_is_better: bool) -> list[str]:
        ratios = (0.5, 1.01, 2.0, None)
        rows = [comparison.ComparisonRow("rms", ("1", "2"), (1.0, ratio), lower_is_better) for ratio in ratios]
        group = TableGroup([comparison.ComparisonTable("q", tuple(rows))], colours=comparison.COLOURS[:2])
        return re.findall('class="(better|same|worse)"', page_html(Page("", [], [group], [], SampleStore())))

    assert verdicts(True) == ["better", "same", "worse", "same"]
    assert verdicts(False) == ["same"] * 4


def test_curves_of_several_flights_drawn_over_one_reference(pair: list[RecordedFlight]) -> None:
    figure = drawn(comparison.tracking_figure(comparison.plot_context(pair), pair))
    q = [trace for trace in figure.data if trace.yaxis == "y"]
    assert [trace.name for trace in q] == ["y_m", "a", "b"]
    assert [trace.y[0] for trace in q] == pytest.approx([1000.0, 1200.0, 1100.0])
    assert [trace.name for trace in figure.data if trace.yaxis == "y3"] == ["y_m", "a"]  # p
    errors = drawn(comparison.error_figure(comparison.plot_context(pair), pair))
    assert [trace.y[0] for trace in errors.data if trace.yaxis == "y"] == pytest.approx([200.0, 100.0])


def test_each_distinct_reference_is_drawn(pair: list[RecordedFlight], servo: Scenario) -> None:
    three = [*pair, recorded("c", servo, flight(y_m=signal([0, 1000], **dict.fromkeys(OUTPUTS, (0.0, 2.0)))))]
    figure = drawn(comparison.tracking_figure(comparison.plot_context(three), three))
    assert [trace.name for trace in figure.data if trace.yaxis == "y"] == ["y_m a", "y_m c", "a", "b", "c"]


def test_each_flight_is_in_legend_once_whatever_channels(servo: Scenario) -> None:
    def only(*names: str) -> Tape:
        y = held(**dict.fromkeys(names, 1.0))
        return Tape({"y": y, "y_m": y, "u": y, "latency": signal([0, 10], y_to_u=[1e-3, 2e-3])}, EPOCH)

    two = [recorded("a", servo, only("q", "V")), recorded("b", servo, only("V", "p"))]
    shared = comparison.plot_context(two)
    runs, colours = {flight.name: (flight.tape, flight.period_ns) for flight in two}, comparison.colours(two)
    spectrum = figures.spectrum_figure(runs, colours, shared.units)
    for figure in (comparison.error_figure(shared, two), spectrum, figures.timing_figure(runs, colours)):
        assert [trace.name for trace in drawn(figure).data if trace.showlegend] == ["a", "b"]


def test_flights_of_equal_names_are_numbered(pair: list[RecordedFlight]) -> None:
    assert comparison.labels([pair[0], pair[1], pair[0]]) == ["a (1)", "b", "a (3)"]


def test_a_comparison_is_a_page(tmp_path: Path, pair: list[RecordedFlight]) -> None:
    write_page(tmp_path / "comparison.html", pair)
    page = (tmp_path / "comparison.html").read_text(encoding="utf-8")
    assert "2 flights compared" in page
    assert '<td class="better">&times;0.500</td>' in page
    assert headings(page) == ["Tracking error", "Output y over the reference y_m", "Tracking error e = y - y_m"]


def test_commands_are_the_edges_of_pulses(osprey_gust: Scenario) -> None:
    pulses = {"q": {"start": [2.0, 6.0], "stop": [4.0, 8.0], "value": [0.1, -0.1]}}
    edges = summary.pulse_edges(osprey_gust.vary(reference_model={"pulses": pulses, "rise": 0.1}))
    assert [(edge.kind, edge.name, edge.start) for edge in edges] == [("command", "q", at) for at in (2.0, 4.0, 6.0, 8.0)]
    assert [edge.stop for edge in edges] == pytest.approx([2.1, 4.1, 6.1, 8.1])


def test_live_commands_replace_those_of_the_scenario(osprey_gust: Scenario) -> None:
    live = signal([5000, 5500], q=[0.0, 0.1])
    commands = [transient for transient in summary.transients(osprey_gust, flight(u_m=live)) if transient.kind == "command"]
    assert [command.start for command in commands] == [2.0, 4.0, 5.5]  # the scenario has q at 2, 4, 6 and 8 s, and more


def test_slowest_settling_marks_transient_after_which_error_did_not_settle() -> None:
    def settling(*times: float | None) -> str:
        entries = [{"kind": "gust", "start": 1.0, "until": {"q": 3.5}, "settling": {"q": time}} for time in times]
        return summary.slowest_settling({"transients": entries}, "q", "gust")

    assert settling() == "-"
    assert settling(0.5, 2.0) == "2.00"
    assert settling(0.5, None) == "> 2.50"


def test_values_have_three_digits() -> None:
    texts = {None: "-", 0.0: "0.00", 1.0: "1.00", 123.4: "123", 4.5678e-7: "4.57e-07"}
    assert [summary.format_value(value) for value in texts] == list(texts.values())


def test_curve_is_broken_at_gap_and_u_held() -> None:
    stamps = [10.0 * k for k in range(101) if not 30 <= k < 60]
    gapped, u = (signal(stamps, **dict.fromkeys(names, 1.0)) for names in (OUTPUTS, INPUTS))
    tape = flight(y=gapped, u=u)
    y: FloatArray = traces(figures.tracking_figure(context(tape)), "y")[0].y
    assert np.flatnonzero(np.isnan(y)).tolist() == [30]
    assert not np.isnan(traces(figures.input_figure(context(tape), {}), "u")[0].y).any()


def unpacked(text: str, kind: str) -> FloatArray:
    """Unpack samples as the page's script does."""
    shuffled = np.frombuffer(zlib.decompress(base64.b64decode(text)), dtype=np.uint8)
    return np.ascontiguousarray(shuffled.reshape(np.dtype(kind).itemsize, -1).T).view(kind)[:, 0]


def test_all_samples_of_long_curves_stored_once() -> None:
    count = 5000
    stamps = EPOCH + np.arange(count, dtype=np.int64) * 2 * MS
    y = Signal(stamps, OUTPUTS, np.random.default_rng(1).standard_normal((count, 4)))
    shared = context(Tape({"y": y, "y_m": Signal(stamps, OUTPUTS, np.zeros((count, 4)))}, EPOCH - 7))
    found = [*drawn(figures.tracking_figure(shared)).data, *drawn(figures.error_figure(shared)).data]
    q = [trace for trace in found if trace.yaxis == "y"]
    assert [trace.y for trace in q] == [None] * 3
    instants = np.cumsum(unpacked(shared.samples.packed[q[1].meta["t"]], "<f8"))
    assert instants.tolist() == (stamps - EPOCH + 7).tolist()  # to the nanosecond
    steps = unpacked(shared.samples.packed[q[1].meta["v"]], "<u4")
    stored = np.cumsum(steps, dtype=np.uint32).view(np.float32)
    np.testing.assert_allclose(stored, y["q"], rtol=2.0**-15.9)  # MANTISSA, and float32
    assert q[1].meta["v"] == q[2].meta["v"]  # y_m is 0, so e equals y
    assert len(shared.samples.packed) == 1 + 4 + 1  # one time, four y, and the zeros of all y_m


def test_extremes_are_least_greatest_and_first_gap_of_each_bin() -> None:
    nan = np.nan
    values = [1.0, 5.0, 0.0, 2.0, 7.0, nan, nan, 6.0, 3.0, 3.0, 3.0, 3.0, nan, nan, nan, nan, 8.0]  # four to a bin
    assert plotting.extremes(np.array(values), 10).tolist() == [1, 2, 4, 5, 7, 8, 12, 16]


def test_page_has_extremes_of_bins_of_very_long_curve(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of an hour the page had 141 MB. Bins of four samples, with a gap in the third."""
    monkeypatch.setattr(plotting, "MAX_STORED", 6)
    stamps = np.array([0, 1, 2, 3, 4, 5, 6, 7, 8, 100, 101], dtype=np.int64)
    values = np.array([1.0, 5.0, 0.0, 2.0, 7.0, 9.0, 8.0, 6.0, 3.0, 4.0, 5.0])
    shared = PlotContext(Tape({}), {}, [], 1.0, SampleStore())
    t, v = (shared.samples.packed[name] for name in plotting.stored(shared, Signal(stamps, ("q",), values[:, None]), "q", 1.0))
    assert np.cumsum(unpacked(t, "<f8")).tolist() == [0, 2, 4, 6, 8, 100]
    drawn = np.cumsum(unpacked(v, "<u4"), dtype=np.uint32).view(np.float32)
    np.testing.assert_array_equal(drawn, [5.0, 0.0, 9.0, 6.0, 3.0, np.nan])


def test_curve_of_few_samples_drawn_whole_and_not_stored() -> None:
    shared = context(flight())
    assert traces(figures.tracking_figure(shared), "y")[0].meta is None
    assert shared.samples.packed == {}


def test_overlapping_labels_of_intervals_are_merged() -> None:
    intervals = [Interval(name, start, start + 1.0, "#7f7f7f", True) for name, start in (("c", 50.0), ("a", 10.0), ("b", 12.0))]
    figure = figures.tracking_figure(context(flight(10_001))._replace(intervals=intervals))
    assert [(note.x, note.text) for note in drawn(figure).layout.annotations] == [(10.0, "a, b"), (50.0, "c")]


def test_time_axis_is_flight_time_whatever_stamps() -> None:
    y = traces(figures.tracking_figure(context(flight())), "y")[0]
    assert (y.x[0], y.x[-1]) == (0.0, 1.0)


def test_vendored_plotly_is_that_of_hash_and_of_release_of_python_package() -> None:
    vendor = Path(html.__file__).parent / "vendor"
    bundle = (vendor / "plotly-basic.min.js").read_bytes()
    assert hashlib.sha256(bundle).hexdigest() in (vendor / "README.md").read_text(encoding="utf-8")
    release = re.compile(r"plotly\.js (?:\(.*\) )?v(\S+)")
    ours, theirs = (release.search(text[:200]) for text in (bundle.decode(), get_plotlyjs()))
    assert ours is not None
    assert theirs is not None
    assert ours[1] == theirs[1]
