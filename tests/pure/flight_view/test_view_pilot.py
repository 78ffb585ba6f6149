# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test what a pilot does on the live page.

The tests cover the header, the map that takes targets, and the choice of charts.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.browser import CHROMIUM, Browser
from tests.view_link import NodesInMemory
from tests.view_page import DRAWN, a_control, flown, press, set_camera, shown, take

from flight_analysis.closed_loop.scenario import Scenario
from flight_analysis.closed_loop.scenario_library import find_scenario
from flight_core.tape import Signal, Tape
from flight_log.bag import LogAttachments
from flight_log.tape_writer import write_run
from flight_view.control import Control

pytestmark = [pytest.mark.slow, pytest.mark.skipif(CHROMIUM is None, reason="needs Chromium")]
PHONE = 400  # px, width of a small phone
TITLES = (
    "[...document.querySelectorAll('#charts canvas')].map(one => one.getAttribute('aria-label'))"
)
SCENARIO = LogAttachments(find_scenario("osprey_servo").path)
TEXTS = """(() => {
    const texts = window.texts = [], fillText = CanvasRenderingContext2D.prototype.fillText;
    CanvasRenderingContext2D.prototype.fillText = function (text, ...place) {
        texts.push([this.canvas.id || this.canvas.ariaLabel, text]);
        fillText.call(this, text, ...place);
    };
})()"""

POSTS = """(() => {
    const posts = window.posts = [], fetched = window.fetch;
    window.fetch = (address, options) => {
        if (options.body) posts.push(JSON.parse(options.body).do);
        return fetched(address, options);
    };
})()"""


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    with Browser(tmp_path_factory.mktemp("profile")) as started:
        yield started


@pytest.fixture(scope="module")
def route() -> Scenario:
    return find_scenario("osprey_route", 6.0)


@pytest.fixture(scope="module")
def routed(route: Scenario, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return flown(route, tmp_path_factory.mktemp("routed") / "route")


def wide(browser: Browser, width: int) -> None:
    """Give the page a width."""
    metrics: dict[str, Any] = {"height": 800, "deviceScaleFactor": 1, "mobile": False}
    browser.call("Emulation.setDeviceMetricsOverride", width=width, **metrics)


def texts(browser: Browser, canvas: str) -> list[str]:
    """Return the texts that the next picture writes on a canvas."""
    before = browser.run(DRAWN)
    browser.run("texts.length = 0; void dispatchEvent(new Event('resize'))")
    browser.wait_for(f"{DRAWN} > {before}")
    return [text for name, text in browser.run("texts") if name == canvas]


@pytest.mark.parametrize("width", [PHONE, 1400])
def test_nothing_is_off_the_screen(
    browser: Browser, routed: Path, route: Scenario, width: int
) -> None:
    nodes = NodesInMemory(route, "aircraft", "controller", "guidance")
    controls = list[Control]()
    wide(browser, width)
    with shown(browser, routed, control=lambda flight: a_control(flight, nodes, controls)):
        take(browser)
        browser.wait_for("document.getElementById('control-gains') !== null")
        browser.run("void (document.getElementById('choice-of-charts').open = true)")
        outside = """[...document.querySelectorAll('body *')]
            .filter(one => one.getClientRects().length && one.getBoundingClientRect().right > innerWidth + 1)
            .map(one => one.tagName + one.id)"""  # noqa: E501 - a text as it is written
        assert browser.run(outside) == []
        assert browser.run("document.documentElement.scrollWidth") == width
        gains = browser.run(
            "[...document.querySelectorAll('#control-gains td:first-child')].map(one => "
            "one.textContent)"
        )
        # k_d has a value per output but the last.
        assert {"k_g", "k_d q", "Lambda V", "beta p"} <= set(gains)
    controls[0].close()
    wide(browser, 1280)


def test_all_values_are_above_the_fold_of_a_small_laptop(browser: Browser, routed: Path) -> None:
    size = {"width": 1280, "height": 800, "deviceScaleFactor": 1, "mobile": False}
    browser.call("Emulation.setDeviceMetricsOverride", **size)
    with shown(browser, routed):
        box = "document.querySelector('{}').getBoundingClientRect()"
        fold = browser.run(f"{box.format('footer')}.top")
        assert fold < 800.0
        for part in ("#scene", "#airspeed", "#altitude", "#readouts", "#events"):
            assert 0.0 < browser.run(f"{box.format(part)}.bottom") <= fold, part
        titles = browser.run(
            f"[...document.querySelectorAll('#charts canvas')].filter(one => "
            f"one.getBoundingClientRect().bottom <= {fold}).map(one => "
            "one.getAttribute('aria-label'))"
        )
        assert titles[:2] == ["altitude", "V: y over y_m"]
    wide(browser, 1280)


def test_height_of_waypoints_at_one_place_is_written_once(browser: Browser, routed: Path) -> None:
    """The waypoints of osprey_route are 0, 0, 30, 30 and 0 m high.

    The last one is at the place of the first.
    """
    with shown(browser, routed):
        browser.run(TEXTS)
        browser.run("document.querySelector('[data-camera=map]').click()")
        written = texts(browser, "scene")
    assert sorted(text for text in written if text in {"0 m", "30 m"}) == [
        "0 m",
        "0 m",
        "30 m",
        "30 m",
    ]


def test_header_holds_flies_home_and_deactivates(
    browser: Browser, routed: Path, route: Scenario
) -> None:
    nodes = NodesInMemory(route, "controller", "guidance")
    controls = list[Control]()
    with shown(browser, routed, control=lambda flight: a_control(flight, nodes, controls)):
        assert browser.run("document.getElementById('pilot').hidden")
        take(browser)
        browser.wait_for("!document.getElementById('pilot').hidden")
        for button, said in (("hold", "holds"), ("home", "flies home"), ("stop", "deactivated")):
            browser.run(f"void document.querySelector('header #pilot-{button}').click()")
            browser.wait_for(f"document.getElementById('control-said').textContent === '{said}'")
        assert nodes.done == [("hold", None), ("home", None), ("activate", False)]
        assert browser.console == []
    controls[0].close()


def test_click_on_the_map_sends_a_target_at_once(
    browser: Browser, routed: Path, route: Scenario
) -> None:
    nodes = NodesInMemory(route, "guidance")
    controls = list[Control]()
    assert route.guidance is not None
    with shown(browser, routed, control=lambda flight: a_control(flight, nodes, controls)):
        take(browser)
        browser.wait_for("!document.getElementById('fly-to').hidden")
        set_camera(browser, "map")
        x, y = browser.run(
            "(({left, top, width, height}) => [left + width / 4, top + height / 4])"
            "(document.getElementById('scene').getBoundingClientRect())"
        )

        def click(**moved: float) -> None:
            place = {"x": x, "y": y, "button": "left", "clickCount": 1}
            browser.call("Input.dispatchMouseEvent", type="mousePressed", **place)
            if moved:
                browser.call("Input.dispatchMouseEvent", type="mouseMoved", **(place | moved))
            browser.call("Input.dispatchMouseEvent", type="mouseReleased", **(place | moved))

        browser.run(POSTS)
        click()
        assert "target" in browser.run("posts")  # sent by the click itself, with no wait
        browser.wait_for("document.getElementById('control-said').textContent.startsWith('flies')")
        [(kind, values)] = nodes.done
        assert kind == "target"
        assert set(values) == {"north", "east", "radius"}
        assert values["radius"] == pytest.approx(route.guidance.least_radius(), abs=1.0)
        click(x=x + 30.0, y=y)  # a drag moves the map
        browser.run("void document.getElementById('fly-to').click()")
        click()
        browser.run("new Promise(resume => setTimeout(() => resume(true), 200))")
        assert len(nodes.done) == 1
    controls[0].close()


def written(run: Path, modes: np.ndarray, stamps: np.ndarray) -> Path:
    """Return a log of ticks with a mode, y, and a y_m that is 0 except for its last bits."""
    y = np.sin(stamps / 1e9)
    values = np.column_stack([modes, y, 1e-33 * y])
    write_run(Tape({"internals": Signal(stamps, ("mode", "y.q", "y_m.q"), values)}), run, SCENARIO)
    return run


def test_failsafe_fills_the_header(browser: Browser, tmp_path: Path) -> None:
    stamps = np.arange(300, dtype=np.int64) * 10_000_000
    run = written(tmp_path / "run", np.where(stamps < 2_000_000_000, 1.0, 2.0), stamps)
    alarm = "document.body.classList.contains('alarm')"
    with shown(browser, run):
        mode = "document.getElementById('mode').textContent"
        assert (browser.run(mode), browser.run(alarm)) == ("ENGAGED", False)
        press(browser, "End")
        browser.wait_for(f"{alarm} && {mode} === 'HOLD'")
        assert browser.run("parseFloat(getComputedStyle(mode).fontSize)") >= 20.0  # px, from 2 m
        assert "flash" in browser.run(
            "getComputedStyle(document.querySelector('header')).animationName"
        )
        # A button is read in an alarm too.
        colours = "(({color, backgroundColor}) => color !== backgroundColor)"
        assert browser.run(f"{colours}(getComputedStyle(units))")
        wide(browser, PHONE)
        # The longest state.
        browser.run("void (document.getElementById('mode').textContent = 'ENGAGED DEAD RECKONING')")
        assert browser.run("document.documentElement.scrollWidth") == PHONE
        wide(browser, 1280)


def test_readouts_and_gaps(browser: Browser, tmp_path: Path) -> None:
    """A number below the noise reads 0, both cursors are read out, and a gap stays blank."""
    stamps = np.arange(4000, dtype=np.int64) * 10_000_000
    kept = (stamps < 10_000_000_000) | (stamps > 20_000_000_000)
    run = written(tmp_path / "run", np.ones(kept.sum()), stamps[kept])
    chart = "q: y over y_m"
    inked = """(([from, to]) => {
        const canvas = document.querySelector('#charts canvas'), copy = new OffscreenCanvas(canvas.width, canvas.height);
        const ctx = copy.getContext('2d', {willReadFrequently: true});
        ctx.drawImage(canvas, 0, 0);
        const wanted = getComputedStyle(document.documentElement).getPropertyValue('--plant').trim().slice(1);
        const [r, g, b] = [0, 2, 4].map(k => parseInt(wanted.slice(k, k + 2), 16));
        const {data} = ctx.getImageData(from * copy.width, 20, (to - from) * copy.width, copy.height - 24);
        let found = 0;
        for (let k = 0; k < data.length; k += 4) found += data[k + 3] > 150 && Math.abs(data[k] - r) + Math.abs(data[k + 1] - g) + Math.abs(data[k + 2] - b) < 60;
        return found;
    })"""  # noqa: E501 - a text as it is written
    with shown(browser, run):
        browser.run(TEXTS)
        assert any(text.startswith("y_m 0") for text in texts(browser, chart))
        press(browser, "a")
        assert texts(browser, chart)
        # The gap is from a quarter to a half of 40 s.
        assert browser.run(f"{inked}([0.32, 0.48])") == 0
        assert browser.run(f"{inked}([0.10, 0.25])") > 50
        browser.run(
            "void document.querySelector('#charts canvas').dispatchEvent(new "
            "PointerEvent('pointermove', {clientX: document.querySelector('#charts "
            "canvas').getBoundingClientRect().left + 300}))"
        )
        assert any(text.startswith("y ") and " | " in text for text in texts(browser, chart))
        assert " | " in browser.run("document.getElementById('time').textContent")


def test_charts_are_chosen_ordered_and_added(browser: Browser, routed: Path) -> None:
    box = "document.querySelectorAll('#choice-charts li')[0].querySelector('input')"
    down = "document.querySelectorAll('#choice-charts li')[0].querySelectorAll('button')[1]"
    with shown(browser, routed):
        first, second, *rest = browser.run(TITLES)
        browser.run(f"void {down}.click()")
        browser.wait_for(f"{TITLES}[0] === '{second}' && {TITLES}[1] === '{first}'")
        browser.run(f"void {box}.click()")
        browser.wait_for(f"{TITLES}[0] === '{first}'")
        browser.run("""(() => {
            const [one, two] = document.querySelectorAll('#choice-channels select');
            one.value = 'pose/altitude';
            two.value = 'guidance/xtrack';
            document.getElementById('choice-add').click();
        })()""")
        added = "pose/altitude, guidance/xtrack"
        browser.wait_for(f"{TITLES}.includes('{added}')")
        browser.run("window.before = true; location.reload()")
        # The browser keeps it.
        browser.wait_for(f"!window.before && {DRAWN} > 1 && {TITLES}.includes('{added}')")
        assert browser.run(TITLES) == [first, *rest, added]
        browser.run("void document.getElementById('choice-reset').click()")
        browser.wait_for(f"{TITLES}[0] === '{first}' && {TITLES}[1] === '{second}'")
        assert browser.run(TITLES) == [first, second, *rest]
        assert browser.console == []
