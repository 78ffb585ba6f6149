# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test that the report page draws in a browser without errors, in light and dark.

A zoom shows all samples.
"""

import base64
import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from tests.browser import CHROMIUM, Browser

from flight_analysis.closed_loop.scenario import Scenario
from flight_analysis.closed_loop.scenario_library import find_scenario
from flight_analysis.closed_loop.simulate import simulate
from flight_analysis.report.html import write_page
from flight_analysis.report.summary import RecordedFlight, summarise
from flight_core.tape import Signal, Tape

pytestmark = [pytest.mark.slow, pytest.mark.skipif(CHROMIUM is None, reason="needs Chromium")]
DRAWN = "Number(document.body?.dataset.drawn ?? 0)"  # counts the views of all figures
# of a value on the page: plotting.MANTISSA, and float32
RESOLUTION = 2.0**-13.9
PLOTS = "[...document.querySelectorAll('figure [data-plot]')]"


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    with Browser(tmp_path_factory.mktemp("profile")) as started:
        yield started


@pytest.fixture(scope="module")
def servo() -> RecordedFlight:
    """Return seven seconds with noise, and with commands from 2 s on.

    They have more samples than are drawn before a zoom.
    """
    scenario = find_scenario("osprey_servo", 7.0)
    return recorded("servo", scenario, simulate(scenario))


@pytest.fixture(scope="module")
def page(servo: RecordedFlight, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("page") / "report.html"
    write_page(path, [servo])
    return path


def recorded(name: str, scenario: Scenario | None, tape: Tape) -> RecordedFlight:
    return RecordedFlight(name, scenario, tape, summarise(tape, scenario))


def open_page(browser: Browser, path: Path, scheme: str = "light") -> None:
    browser.call(
        "Emulation.setEmulatedMedia", features=[{"name": "prefers-color-scheme", "value": scheme}]
    )
    browser.open(path)
    browser.wait_for(f"{DRAWN} === 1")


def zoom(browser: Browser, start: float, stop: float, plot: int = 0) -> None:
    """Zoom one figure, as dragging the mouse does, and wait for all figures."""
    before = browser.run(DRAWN)
    browser.run(
        f"Plotly.relayout({PLOTS}[{plot}], {{'xaxis.range': [{start}, {stop}]}}).then(() => 0)"
    )
    browser.wait_for(f"{DRAWN} > {before}")


def curve(
    browser: Browser, plot: int, name: str, channel: str = "q"
) -> tuple[list[float], list[float]]:
    """Return the instants and values of a drawn curve in the row of a channel."""
    layout = f"{PLOTS}[{plot}]._fullLayout"
    axis = (
        f"Object.keys({layout}).find(key => /^yaxis/.test(key) && {layout}[key].title.text"
        f".startsWith('{channel} ')).replace('axis', '')"
    )
    drawn = (
        f"{PLOTS}[{plot}]._fullData.find(trace => trace.name === '{name}' && trace.yaxis "
        f"=== {axis})"
    )
    x, y = browser.run(f"(trace => [[...trace.x], [...trace.y]])({drawn})")
    return x, y


def test_the_page_draws_all_figures_without_errors(browser: Browser, page: Path) -> None:
    open_page(browser, page)
    assert browser.console == []
    headings = browser.run(
        "[...document.querySelectorAll('section:has(> figure) > h2')].map(one => one.textContent)"
    )
    colours = browser.run(
        f"{PLOTS}.map(plot => plot.querySelectorAll('.scatterlayer .trace, .barlayer "
        ".trace').length)"
    )
    curves = dict(zip(headings, colours, strict=True))
    # For each of four channels: y over y_m; two errors and the noise floor; command, actuator and
    # limits.
    assert curves["Output y over the reference y_m"] == 8
    assert curves["Tracking error e = y - y_m"] == 12
    assert curves["Input u and the actuators"] >= 8
    assert curves["States"] == 8
    assert curves["Integrals of the law"] == 8
    assert curves["Spectrum of u"] == 4
    assert all(count > 0 for count in colours)


def test_page_of_guided_flight_in_wind_prints_without_errors(
    browser: Browser, tmp_path: Path
) -> None:
    """The arrows of the track are annotations without a text."""
    scenario = find_scenario("osprey_route", 5.0)
    write_page(tmp_path / "report.html", [recorded("route", scenario, simulate(scenario))])
    open_page(browser, tmp_path / "report.html")
    # after the outputs comes the track
    assert browser.run(f"{PLOTS}[1].layout.annotations.some(each => each.showarrow)")
    browser.run("void dispatchEvent(new Event('beforeprint'))")
    headings = browser.run(
        f"{PLOTS}.map(plot => plot.closest('section').querySelector('h2').textContent)"
    )
    heights = dict(
        zip(headings, browser.run(f"{PLOTS}.map(plot => plot.layout.height)"), strict=True)
    )
    # two on a sheet of letter, 11 in less margins of 12 mm, with 50 pixels of heading each; the
    # squares of Nyquist's plot take more
    del heights["Nyquist plot of the loop"]
    assert max(heights.values()) <= (11 * 96 - 2 * 12 * 96 / 25.4) / 2 - 50
    assert browser.console == []


def test_zoom_shows_every_sample_in_all_figures(
    browser: Browser, page: Path, servo: RecordedFlight
) -> None:
    open_page(browser, page)
    y = servo.tape["y"]
    samples, _ = curve(browser, 0, "y")
    assert len(samples) < len(y.stamp_ns)
    zoom(browser, 2.0, 2.1)
    for plot, name in ((0, "y"), (2, "measured")):
        x, _ = curve(browser, plot, name)
        inside = [t for t in x if 2.0 <= t <= 2.1]
        assert inside == pytest.approx(np.arange(51) * 0.002 + 2.0, abs=1e-9)  # 500 Hz
    t = servo.tape.time("y")
    x, values = curve(browser, 0, "y", "V")
    assert values == pytest.approx(np.interp(x, t, y["V"]), rel=RESOLUTION)
    assert (
        browser.run(f"{PLOTS}.slice(0, 3).map(plot => plot._fullLayout.xaxis4.range)")
        == [[2.0, 2.1]] * 3
    )
    zoom(browser, 0.0, 7.0, plot=2)
    again, _ = curve(browser, 0, "y")
    assert len(again) < len(t)
    assert [again[0], again[-1]] == pytest.approx([0.0, 7.0], abs=0.01)  # to a bin
    assert browser.console == []


def test_angles_are_shown_in_rad_by_choice(
    browser: Browser, page: Path, servo: RecordedFlight
) -> None:
    open_page(browser, page)
    zoom(browser, 2.0, 2.1)
    browser.run("void (document.querySelector('details.block').open = true)")
    table = (
        "[...document.querySelectorAll('.tables tbody :is(th, td)')].filter(one => "
        "one.checkVisibility())"
    )
    first = f"{table}.slice(0, 2).map(one => one.textContent.trim())"
    rms = servo.summary["errors"]["q"]["whole"]["rms"]
    assert browser.run(first) == ["q (deg/s)", f"{np.degrees(rms):#.3g}"]
    before = browser.run(DRAWN)
    browser.run(
        "void (document.getElementById('angles').value = 'rad', "
        "document.getElementById('angles').dispatchEvent(new Event('change')))"
    )
    browser.wait_for(f"{DRAWN} > {before}")
    assert browser.run(first) == ["q (rad/s)", f"{rms:#.3g}"]
    x, values = curve(browser, 0, "y")
    y = servo.tape["y"]
    expected = np.interp(x, servo.tape.time("y"), y["q"])
    assert values == pytest.approx(expected, rel=RESOLUTION, abs=1e-12)
    titles = browser.run(
        f"{PLOTS}.flatMap(plot => Object.entries(plot._fullLayout).filter(([key]) => "
        "/^yaxis/.test(key)).map(([, axis]) => axis.title.text))"
    )
    # the phase of the linear loop alone is in degrees
    assert {title for title in titles if "deg" in title} == {"phase (deg)"}
    assert {"q (rad/s)", "alpha (rad)", "V - 25 (m/s)", "elevator (rad/√Hz)"} <= set(titles)
    assert browser.console == []


def test_word_of_a_table_is_explained_by_keyboard_and_contents_open_what_is_folded(
    browser: Browser, page: Path
) -> None:
    open_page(browser, page)
    folded = "document.querySelector('details.block').open"
    assert browser.run(folded) is False
    browser.run("void (location.hash = '#all-figures')")
    browser.wait_for(folded)
    browser.run("void document.querySelector('.word[href=\"#word-settling-s\"]').focus()")
    tip = "document.getElementById('tip')"
    assert browser.run(f"{tip}.checkVisibility()")
    assert "the time until the error stays" in browser.run(f"{tip}.textContent")
    browser.run("void document.activeElement.blur()")
    assert not browser.run(f"{tip}.checkVisibility()")
    assert browser.console == []


def test_whole_flight_comes_back_after_a_zoom(browser: Browser, page: Path) -> None:
    open_page(browser, page)
    zoom(browser, 2.0, 2.1)
    before = browser.run(DRAWN)
    browser.run("void document.getElementById('whole').click()")
    browser.wait_for(f"{DRAWN} > {before}")
    assert browser.run(f"{PLOTS}[2]._fullLayout.xaxis4.range") == [0.0, 7.0]


def test_labels_of_intervals_are_apart_on_a_narrow_screen(
    browser: Browser, tmp_path: Path, servo: RecordedFlight
) -> None:
    """Two gusts are 6 s apart, which is a tenth of the width of the figure on a phone."""
    scenario = find_scenario("osprey_servo")
    tape = servo.tape["y"]
    stamps = np.arange(6000, dtype=np.int64) * 10_000_000
    still = Signal(stamps, tape.names, np.zeros((6000, 4)))
    # a simulated flight has `truth`
    truth = Signal(stamps, ("x.q",), np.zeros((6000, 1)))
    path = tmp_path / "gusts.html"
    tape_of_gusts = Tape({"y": still, "y_m": still, "truth": truth})
    write_page(path, [recorded("gusts", scenario, tape_of_gusts)])
    labels = (
        f"[...{PLOTS}[0].querySelectorAll('.annotation-text')].map(text => "
        "[text.textContent, text.getBoundingClientRect().left, "
        "text.getBoundingClientRect().right])"
    )
    screen = {"height": 800, "deviceScaleFactor": 1, "mobile": False}
    open_page(browser, path)
    assert [label[0] for label in browser.run(labels)] == ["vertical gust", "lateral gust"]
    browser.call("Emulation.setDeviceMetricsOverride", width=400, **screen)
    browser.wait_for(f"{labels}.length === 1")
    ((text, left, right),) = browser.run(labels)
    assert text == "vertical gust, lateral gust"
    assert left >= 0.0
    assert right <= 400.0
    assert browser.run("document.documentElement.scrollWidth") <= 400
    browser.call("Emulation.clearDeviceMetricsOverride")


def test_replay_shows_pose_and_surfaces_of_flight(
    browser: Browser, page: Path, servo: RecordedFlight
) -> None:
    open_page(browser, page)
    browser.wait_for("document.getElementById('replay').dataset.drawn === '0'")
    place = "document.getElementById('replay-time')"

    def seek(t: float) -> bytes:
        browser.run(f"void ({place}.value = {t}, {place}.dispatchEvent(new Event('input')))")
        browser.wait_for(f"Number(document.getElementById('replay').dataset.drawn) === {t}")
        return base64.b64decode(
            browser.run("document.getElementById('replay-horizon').toDataURL()").partition(",")[2]
        )

    assert seek(0.5) != seek(5.0)  # level, then in a roll
    assert "ENGAGED" in browser.run("document.getElementById('replay-now').textContent")
    assert "grid" in browser.run("document.getElementById('replay-legend').textContent")
    stored = page.read_text()
    topics, info = json.loads(
        stored.partition('id="replay-data">')[2].partition("</script>")[0]
    ).values()
    assert info["positive"]["rudder"] == "nose right"
    figures = stored.partition('id="replay-data">')[0] + stored.partition("replay-code")[2]
    # stored once, for the figure
    assert all(f'"v":"{place}"' in figures for place, _ in topics["truth"]["channels"].values())
    browser.run("void document.getElementById('replay-play').click()")
    browser.wait_for("Number(document.getElementById('replay').dataset.drawn) > 5.2")
    assert browser.console == []


def test_zoom_keeps_peaks_of_each_pixel(
    browser: Browser, tmp_path: Path, servo: RecordedFlight
) -> None:
    count = 40_000
    values = np.zeros((count, 4))
    values[30_001, 0], values[31_003, 0] = 5.0, -4.0  # one sample each, between 60 s and 62.1 s
    stamps = np.arange(count, dtype=np.int64) * 2_000_000
    zero = Signal(stamps, servo.tape["y"].names, np.zeros((count, 4)))
    path = tmp_path / "peaks.html"
    write_page(
        path,
        [recorded("peaks", servo.scenario, Tape({"y": replace(zero, values=values), "y_m": zero}))],
    )
    open_page(browser, path)
    for start, stop in ((0.0, 80.0), (50.0, 70.0), (60.0, 60.01)):
        zoom(browser, start, stop)
        _, y = curve(browser, 0, "y")
        # within half a view of each
        assert max(y) == pytest.approx(np.degrees(5.0), rel=RESOLUTION)
        assert len(y) < 5000


def test_dark_page_has_own_colours_and_follows_scheme(browser: Browser, page: Path) -> None:
    look = (
        f"[getComputedStyle(document.body).backgroundColor, {PLOTS}[0].data[1].line.color, "
        f"{PLOTS}[0].layout.font.color]"
    )
    open_page(browser, page, "dark")
    dark = browser.run(look)
    browser.call(
        "Emulation.setEmulatedMedia", features=[{"name": "prefers-color-scheme", "value": "light"}]
    )
    browser.wait_for(f"{DRAWN} === 2")
    light = browser.run(look)
    assert light[0] == "rgb(255, 255, 255)"
    assert all(
        dark_color != light_color for dark_color, light_color in zip(dark, light, strict=True)
    )
    assert browser.console == []
