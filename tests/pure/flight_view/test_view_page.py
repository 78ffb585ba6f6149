# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test the live page in a browser.

A flight grows and is replayed. The tests cover signs of the scene, states, hostile names, a phone
and the dark scheme.
"""

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.browser import CHROMIUM, Browser
from tests.joint_states import JOINT_STATE, vector
from tests.view_link import NodesInMemory
from tests.view_page import (
    DRAWN,
    STATE,
    a_control,
    leave,
    press,
    serving,
    set_camera,
    shown,
    take,
)

from flight_analysis.closed_loop.scenario import Scenario
from flight_analysis.closed_loop.scenario_library import find_scenario
from flight_core.tape import Signal, Tape
from flight_log.bag import BagWriter, LogAttachments
from flight_log.disk import try_lock
from flight_log.tape_writer import write_run
from flight_view.control import Control

pytestmark = [pytest.mark.slow, pytest.mark.skipif(CHROMIUM is None, reason="needs Chromium")]
TIME = "parseFloat(document.getElementById('time')?.textContent.slice(4))"


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    with Browser(tmp_path_factory.mktemp("profile")) as started:
        yield started


def colours_of(browser: Browser, selector: str) -> int:
    """Return the number of different colours on a canvas."""
    script = f"""(canvas => {{
        const copy = new OffscreenCanvas(canvas.width, canvas.height).getContext('2d', {{willReadFrequently: true}});
        copy.drawImage(canvas, 0, 0);
        return new Set(new Uint32Array(copy.getImageData(0, 0, canvas.width, canvas.height).data.buffer)).size;
    }})(document.querySelector('{selector}'))"""  # noqa: E501 - a text as it is written
    return int(browser.run(script))


PIXELS = """((selector, name) => {
    const canvas = document.querySelector(selector), copy = new OffscreenCanvas(canvas.width, canvas.height);
    const ctx = copy.getContext('2d', {willReadFrequently: true});
    ctx.fillStyle = getComputedStyle(document.documentElement).getPropertyValue(name).trim();
    ctx.fillRect(0, 0, 1, 1);
    const wanted = ctx.getImageData(0, 0, 1, 1).data;
    ctx.clearRect(0, 0, 1, 1);
    ctx.drawImage(canvas, 0, 0);
    const {data} = ctx.getImageData(0, 0, canvas.width, canvas.height);
    let found = 0;
    for (let k = 0; k < data.length; k += 4) {
        found += data[k + 3] > 200 && [0, 1, 2].every(i => Math.abs(data[k + i] - wanted[i]) < 40);
    }
    return found;
})"""  # noqa: E501 - a text as it is written


def pixels_of(browser: Browser, selector: str, name: str) -> int:
    """Return the number of pixels of a canvas that nearly have a named colour.

    The middle of a line has it.
    """
    return int(browser.run(f"{PIXELS}('{selector}', '{name}')"))


def test_recorded_flight_drawn_and_asks_no_other_host(browser: Browser, recorded: Path) -> None:
    with shown(browser, recorded) as address:
        titles = browser.run(
            "[...document.querySelectorAll('#charts canvas')].map(one => "
            "one.getAttribute('aria-label'))"
        )
        assert titles[:6] == [
            "altitude",
            "V: y over y_m",
            "q: y over y_m",
            "p: y over y_m",
            "r: y over y_m",
            "q: error e",
        ]
        assert {"elevator", "wind", "ticks: lateness"} <= set(titles)
        assert browser.run("document.getElementById('modes').textContent") == "ENGAGED"
        for selector in ("#scene", "#horizon", "#timeline", "#charts canvas"):
            assert colours_of(browser, selector) > 5
        hosts = browser.run(
            "[...new Set(performance.getEntriesByType('resource').map(one => new "
            "URL(one.name).host))]"
        )
        assert hosts == [address.split("/")[2]]
        assert (
            browser.run("document.getElementById('events').textContent") == "0.00 s  mode: ENGAGED"
        )
        # The token is not in the history.
        assert browser.run("location.href") == f"{address.partition('#')[0]}#"
        assert browser.run("document.cookie") == ""
        browser.run("location.reload()")
        browser.wait_for(f"{DRAWN} > 1 && {STATE} === 'ENDED'")  # the tab has the token
        assert browser.console == []


def test_keys_step_ticks_and_play(browser: Browser, recorded: Path, tape: Tape) -> None:
    """Keys step single ticks, jump to events, and play."""
    with shown(browser, recorded):
        assert browser.run(TIME) == 0.0
        # 100 Hz.
        for expected in (0.01, 0.02, 0.03):
            press(browser, "ArrowRight")
            browser.wait_for(f"{TIME} === {expected}")
        press(browser, "ArrowLeft")
        browser.wait_for(f"{TIME} === 0.02")
        press(browser, "End")
        browser.wait_for(f"{TIME} === {tape.time('y')[-1]:.2f}")
        press(browser, "[")
        browser.wait_for(f"{TIME} < 1")
        for _ in range(6):
            press(browser, "+")
        press(browser, "Home")
        press(browser, " ")
        browser.wait_for(f"{TIME} === {tape.time('y')[-1]:.2f}")  # 10 times
        assert browser.run("document.getElementById('speed').value") == "10"
        assert browser.console == []


def test_recording_flight_followed_to_end(browser: Browser, recorded: Path, tmp_path: Path) -> None:
    content = (recorded / "run_0.mcap").read_bytes()
    path = tmp_path / "run_0.mcap"
    with serving(tmp_path) as address:
        browser.open(address)
        browser.wait_for(f"{STATE} === 'WAITING'")
        assert browser.run(TIME) == 0
        # As a recorder, it never makes the file shorter.
        with path.open("ab") as recorder:
            recorder.write(content[: len(content) // 2])
            recorder.flush()
            assert try_lock(recorder)
            browser.wait_for(f"{STATE} === 'NO DATA'")  # after LIVE, which lasts a second
            half = browser.run(TIME)
            assert 0.2 < half < 1.9
            recorder.write(content[len(content) // 2 : len(content) * 3 // 4])
            recorder.flush()
            browser.wait_for(f"{TIME} > {half}")
        browser.wait_for(f"{STATE} === 'INTERRUPTED'")
        with path.open("ab") as recorder:
            recorder.write(content[len(content) * 3 // 4 :])
        browser.wait_for(f"{STATE} === 'ENDED' && {TIME} === 2")
        assert browser.console == []
    browser.wait_for(f"{STATE} === 'NO SERVER'")
    before = browser.run(DRAWN)
    press(browser, "Home")
    browser.wait_for(f"{DRAWN} > {before} && {TIME} === 0")  # the page keeps what it has
    leave(browser)


def test_names_that_are_html_shown_as_text(browser: Browser, tmp_path: Path) -> None:
    hostile = "<img src=x onerror=document.title=1>"
    with BagWriter(tmp_path / hostile.replace("/", "")) as bag:
        y = bag.add_topic("/y", JOINT_STATE, "")
        for k in range(200):
            bag.write(
                y,
                k * 10_000_000,
                k * 10_000_000,
                k,
                vector(k * 10_000_000, [hostile], [math.sin(k)]),
            )
    with shown(browser, tmp_path / hostile):
        assert browser.run("document.getElementById('name').textContent") == hostile
        assert browser.run("document.querySelectorAll('img').length") == 0
        assert (
            browser.run("document.querySelector('#charts canvas').getAttribute('aria-label')")
            == hostile
        )
        assert browser.console == []


# Signs of the scene: what a roll right, a nose up and a nose right do on the screen


def seen(browser: Browser, expression: str) -> Any:
    """Return the value of an expression with scene.js as `m`, and `at`.

    `at` is the place on the screen of a point of the body in a pose, seen from behind.
    """
    at = """const at = (point, phi, theta, psi) => m.project(m.camera([-10, 0, -3], [10, 0, 3]),
        m.toWorld(m.rotation(phi, theta, psi), point), 500, 400, 400).slice(0, 2);"""
    return browser.run(f"import('./scene.js').then(m => {{ {at} return {expression} }})")


@pytest.fixture(scope="module")
def page(browser: Browser, recorded: Path) -> Iterator[Browser]:
    with shown(browser, recorded):
        yield browser


def test_attitude_drawn_with_right_signs(page: Browser) -> None:
    nose, right, level = "[1, 0, 0]", "[0, 1, 0]", "0, 0, 0"
    (x, y), (x_level, y_level) = seen(page, f"[at({right}, 0.3, 0, 0), at({right}, {level})]")
    assert x_level > 200  # the right wing is on the right, seen from behind
    assert y > y_level  # roll right: the right wing goes down
    (_, y), (x_level, y_level) = seen(page, f"[at({nose}, 0, 0.3, 0), at({nose}, {level})]")
    assert y < y_level  # nose up
    (x, _), _ = seen(page, f"[at({nose}, 0, 0, 0.3), 0]")
    assert x > x_level  # nose right


def test_rotation_is_euler_sequence_of_textbook(page: Browser) -> None:
    # Stevens, Lewis, Aircraft Control and Simulation, eq. (1.3-20), here as a product of plane
    # rotations.
    phi = 0.7
    theta = -0.4
    psi = 2.1

    def plane(i: int, j: int, angle: float) -> Any:
        matrix = np.eye(3)
        matrix[i, i] = matrix[j, j] = math.cos(angle)
        matrix[i, j], matrix[j, i] = -math.sin(angle), math.sin(angle)
        return matrix

    expected = plane(0, 1, psi) @ plane(2, 0, theta) @ plane(1, 2, phi)
    assert np.array(seen(page, f"m.rotation({phi}, {theta}, {psi})")) == pytest.approx(
        expected, abs=1e-12
    )


def test_surfaces_deflect_in_sense_of_input(page: Browser) -> None:
    # The trailing edges are the last points of a surface. Down is +z, right is +y.
    edges = "m.aircraft({%s}).filter(one => one.part === 'surface').map(one => one.points[2])"
    still = np.array(seen(page, edges % ""))
    right_aileron, right_elevator, left_aileron, left_elevator, rudder = range(5)
    up = np.array(seen(page, edges % "elevator: 0.3")) - still
    assert up[right_elevator, 2] < 0 > up[left_elevator, 2]  # nose up: both go up
    roll = np.array(seen(page, edges % "aileron: 0.3")) - still
    # Roll right: the right one goes up, the left one down.
    assert roll[right_aileron, 2] < 0 < roll[left_aileron, 2]
    yaw = np.array(seen(page, edges % "rudder: 0.3")) - still
    assert yaw[rudder, 1] > 0  # nose right: it goes to the right


def test_horizon_moves_against_aircraft(page: Browser) -> None:
    """The horizon falls when the nose rises, and turns left in a roll to the right."""

    def sky(pose: str, x: float, y: float) -> bool:
        """Return whether a point of the instrument shows the sky.

        x and y are fractions of the radius, measured from the centre.
        """
        script = f"""import('./scene.js').then(m => {{
            const canvas = document.createElement('canvas');
            canvas.style = 'width: 200px; height: 200px';
            document.body.append(canvas);
            m.drawHorizon(canvas, {pose}, name => ({{'--sky': '#0000ff', '--ground': '#00ff00'}})[name] ?? '#888888');
            const [column, row] = [canvas.width * (1 + {x}) / 2, canvas.height * (1 + {y}) / 2];
            const [r, g, b] = canvas.getContext('2d').getImageData(column, row, 1, 1).data;
            canvas.remove();
            return b > g;
        }})"""  # noqa: E501 - a text as it is written
        return bool(page.run(script))

    level, up, roll = (
        f"{{attitude: true, phi: {phi}, theta: {theta}}}"
        for phi, theta in ((0, 0), (0, 0.2), (0.5, 0))
    )
    assert (sky(level, -0.6, -0.1), sky(level, -0.6, 0.1)) == (True, False)
    assert sky(up, -0.6, 0.1)
    # The horizon falls on the left and rises on the right.
    assert [sky(roll, -0.6, y) for y in (-0.1, 0.1)] == [True, True]
    assert [sky(roll, 0.6, y) for y in (-0.1, 0.1)] == [False, False]


POSE = ("phi", "theta", "psi", "north", "east", "altitude", "v_north", "v_east", "climb")


def test_guided_flight_shows_route_and_modes(browser: Browser, tmp_path: Path) -> None:
    names = (
        "mode",
        "mode.lateral",
        "mode.vertical",
        "leg",
        "xtrack",
        "to_go",
        "phi_c",
        "theta_c",
        "target.altitude",
        "y.V",
    )
    stamps = np.arange(200, dtype=np.int64) * 20_000_000
    guidance = Signal(
        stamps, names, np.tile([1.0, 4.0, 2.0, 3.0, -2.5, 100.0, 0.1, 0.0, 30.0, 0.0], (200, 1))
    )
    pose = np.tile([0.1, 0.02, 0.0, 0.0, 0.0, 30.0, 25.0, 0.0, 0.0], (200, 1))
    pose[:, POSE.index("north")] = 25.0 * stamps / 1e9
    pose[:, POSE.index("altitude")] += np.sin(stamps / 1e9)
    signals = {"guidance": guidance, "pose": Signal(stamps, POSE, pose)}
    write_run(Tape(signals), tmp_path / "run", LogAttachments(find_scenario("osprey_route").path))
    write_run(Tape(signals), tmp_path / "other", LogAttachments(find_scenario("osprey_servo").path))
    with shown(browser, tmp_path / "run"):
        readouts = browser.run("document.getElementById('readouts').innerText")
        # 100 m at 25 m/s
        for text in ("ENGAGED", "ROUTE, ALTITUDE", "3: 100 m, 0:04", "-2.5 m", "30.0 m"):
            assert text in readouts
        # A guided flight shows its map.
        assert browser.run("document.querySelector('[data-camera=map]').ariaPressed") == "true"
        browser.run(SAID)
        set_camera(browser, "map")
        assert {"H", "500 m", "altitude (m)"} <= set(browser.run("said"))
        browser.run("void (units.value = 'ft, kt', units.dispatchEvent(new Event('change')))")
        # 25 m/s and 30 m
        browser.wait_for("['V (kt)', '48.6', '98'].every(text => said.includes(text))")
        assert "98.4 ft" in browser.run("document.getElementById('readouts').innerText")
        # The altitude, and its command.
        for colour in ("--plant", "--reference"):
            assert pixels_of(browser, "[aria-label=altitude]", colour) > 300
        assert pixels_of(browser, "#scene", "--reference") > 100
        assert browser.console == []
    with shown(browser, tmp_path / "other"):
        set_camera(browser, "map")
        # A route has more than 100 pixels of its colour; the edge of another one may come near it.
        assert pixels_of(browser, "#scene", "--reference") < 50


SAID = """(() => {
    const said = window.said = [], fillText = CanvasRenderingContext2D.prototype.fillText;
    CanvasRenderingContext2D.prototype.fillText = function (text, ...place) {
        said.push(text);
        fillText.call(this, text, ...place);
    };
})()"""


# Control


def test_desk_has_parts_of_nodes_that_run(
    browser: Browser, recorded: Path, osprey_gust: Scenario
) -> None:
    nodes = NodesInMemory(osprey_gust, "controller")
    controls = list[Control]()

    with shown(browser, recorded, control=lambda flight: a_control(flight, nodes, controls)):
        take(browser)
        browser.wait_for("document.getElementById('control-gains') !== null")
        assert browser.run("document.getElementById('control-map') === null")
        nodes.names[:] = ["bridge"]
        browser.wait_for(
            "document.getElementById('control-map') !== null && "
            "document.getElementById('control-gains') === null"
        )
        assert browser.console == []
    controls[0].close()


def test_gains_are_pending_until_applied(
    browser: Browser, recorded: Path, osprey_gust: Scenario
) -> None:
    """Applied gains can be undone."""
    nodes = NodesInMemory(osprey_gust, "aircraft", "controller", "guidance")
    controls: list[Control] = []
    before = nodes.values["controller"]["k_g"]

    def said(text: str) -> str:
        return f"document.getElementById('control-said').textContent.includes('{text}')"

    with shown(browser, recorded, control=lambda flight: a_control(flight, nodes, controls)):
        browser.wait_for("!document.getElementById('control-key').hidden")
        assert browser.run("document.getElementById('control-desk').hidden")
        take(browser, "abcd-efgx")
        browser.wait_for(said("the control key is wrong"))
        # The next key is refused as long as this.
        browser.wait_for("new Promise(resume => setTimeout(() => resume(true), 1000))")
        take(browser)
        browser.wait_for("document.querySelectorAll('#control-gains tr').length > 10")
        slider = "document.querySelector('#control-gains [data-gain=k_g]')"
        browser.run(
            f"{slider}.value = {1.5 * before}; void {slider}.dispatchEvent(new Event('input'))"
        )
        browser.wait_for(
            "document.getElementById('control-margins').textContent.includes('pending: delay "
            "margin')"
        )
        assert browser.run("document.getElementById('control-apply').textContent") == "Apply 1"
        assert nodes.values["controller"]["k_g"] == before  # a slider sends nothing
        browser.run("void document.getElementById('control-apply').click()")
        browser.wait_for(said("applied"))
        # Three digits.
        assert nodes.values["controller"]["k_g"] == pytest.approx(1.5 * before, rel=0.01)
        # A recorded one.
        browser.wait_for(
            "document.getElementById('control-logged').textContent === 'not in the log yet'"
        )
        browser.run("void document.getElementById('control-undo').click()")
        browser.wait_for(said("undone"))
        assert nodes.values["controller"]["k_g"] == before
        browser.run("document.getElementById('control-target').value = 0.1")
        browser.run("void document.getElementById('control-command').click()")
        browser.wait_for(said("in force"))
        assert nodes.done == [("target", {"phi": pytest.approx(math.radians(0.1))})]
        browser.run("void document.getElementById('control-gust').click()")
        browser.wait_for(said("gust begins"))
        assert nodes.values["aircraft"]["gusts.vertical.speed"] == 3.0
        refused = [entry for entry in browser.console if "403" not in str(entry)]  # the wrong key
        assert refused == []
    controls[0].close()
