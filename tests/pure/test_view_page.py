# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""The live page in a browser: a flight that grows, replay, signs of the scene, states, hostile names, phone and dark scheme."""

import asyncio
import json
import math
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.browser import CHROMIUM, Browser
from tests.joint_states import JOINT_STATE, vector
from tests.view_link import NodesInMemory, in_the_air

from flight_analysis.closed_loop.loop_margins import delay_margins
from flight_analysis.closed_loop.scenario import Scenario
from flight_analysis.closed_loop.scenario_library import find_scenario
from flight_analysis.closed_loop.simulate import simulate
from flight_analysis.report.run_folder import attachments_for
from flight_core.tape import Signal, Tape
from flight_log.bag import BagWriter, LogAttachments
from flight_log.disk import try_lock
from flight_log.tape_writer import write_run
from flight_view.control import Control
from flight_view.flight import Flight
from flight_view.server import Server

pytestmark = [
    pytest.mark.package("flight_view"),
    pytest.mark.slow,
    pytest.mark.skipif(CHROMIUM is None, reason="needs Chromium"),
]
TOKEN = "a-token"  # noqa: S105 - of a test
STATE = "document.getElementById('state')?.textContent"
DRAWN = "Number(document.body?.dataset.drawn ?? 0)"
TIME = "parseFloat(document.getElementById('time')?.textContent.slice(4))"


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    with Browser(tmp_path_factory.mktemp("profile")) as started:
        yield started


@contextmanager
def serving(*runs: Path, control: Callable[[Flight], Control] | None = None, fleet: bool = False) -> Iterator[str]:
    """Serve runs from a thread of this process; the address with the token."""
    ready, address = threading.Event(), ""
    loop = asyncio.new_event_loop()

    async def serve() -> None:
        nonlocal address
        flights = [Flight(run) for run in runs]
        server = Server(flights, TOKEN, control(flights[0]) if control else None, fleet=fleet)
        server.listen(0)
        address = f"http://127.0.0.1:{server.port}/#token={TOKEN}"
        ready.set()
        try:
            await server.follow()
        except asyncio.CancelledError:
            await server.close()

    task = loop.create_task(serve())
    thread = threading.Thread(target=loop.run_until_complete, args=(task,))
    thread.start()
    try:
        ready.wait()
        yield address
    finally:
        loop.call_soon_threadsafe(task.cancel)
        thread.join()
        loop.close()


@contextmanager
def shown(
    browser: Browser, *runs: Path, control: Callable[[Flight], Control] | None = None, fleet: bool = False
) -> Iterator[str]:
    """Serve finished runs and open the page; leave it before the server ends."""
    with serving(*runs, control=control, fleet=fleet) as address:
        try:
            browser.open(address)
            browser.wait_for(f"{DRAWN} > 1 && {STATE} === 'ENDED'")
            yield address
        finally:
            leave(browser)


def leave(browser: Browser) -> None:
    """Leave the page, which then logs no refused connection to a server that has ended."""
    browser.open("about:blank")
    browser.wait_for("location.href === 'about:blank'")


def colours_of(browser: Browser, selector: str) -> int:
    """Number of different colours on a canvas."""
    script = f"""(canvas => {{
        const copy = new OffscreenCanvas(canvas.width, canvas.height).getContext('2d', {{willReadFrequently: true}});
        copy.drawImage(canvas, 0, 0);
        return new Set(new Uint32Array(copy.getImageData(0, 0, canvas.width, canvas.height).data.buffer)).size;
    }})(document.querySelector('{selector}'))"""
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
})"""


def pixels_of(browser: Browser, selector: str, name: str) -> int:
    """Number of pixels of a canvas that have nearly the colour of that name, as the middle of a line has."""
    return int(browser.run(f"{PIXELS}('{selector}', '{name}')"))


def set_camera(browser: Browser, camera: str) -> None:
    before = browser.run(DRAWN)
    browser.run(f"void document.querySelector('[data-camera={camera}]').click()")
    browser.wait_for(f"{DRAWN} > {before}")


def flown(scenario: Scenario, run: Path) -> Path:
    """The log of a flight, with its attachments."""
    run.mkdir()
    write_run(simulate(scenario), run, attachments_for(scenario, run))
    return run


def press(browser: Browser, key: str, shift: bool = False) -> None:
    options = f"{{key: '{key}', shiftKey: {str(shift).lower()}, bubbles: true}}"
    browser.run(f"void document.body.dispatchEvent(new KeyboardEvent('keydown', {options}))")


def test_recorded_flight_drawn_and_asks_no_other_host(browser: Browser, recorded: Path) -> None:
    with shown(browser, recorded) as address:
        titles = browser.run("[...document.querySelectorAll('#charts canvas')].map(one => one.getAttribute('aria-label'))")
        assert titles[:5] == ["q: y over y_m", "p: y over y_m", "r: y over y_m", "V: y over y_m", "q: error e"]
        assert {"elevator", "gust", "altitude", "ticks: lateness"} <= set(titles)
        for selector in ("#scene", "#horizon", "#timeline", "#charts canvas"):
            assert colours_of(browser, selector) > 5
        hosts = browser.run("[...new Set(performance.getEntriesByType('resource').map(one => new URL(one.name).host))]")
        assert hosts == [address.split("/")[2]]
        assert browser.run("document.getElementById('events').textContent") == "0.00 s  mode: ENGAGED"
        assert browser.run("location.href") == f"{address.partition('#')[0]}#"  # the token is not in the history
        assert browser.run("document.cookie") == ""
        browser.run("location.reload()")
        browser.wait_for(f"{DRAWN} > 1 && {STATE} === 'ENDED'")  # the tab has the token
        assert browser.console == []


CURVES = """(() => {
    const curves = window.curves = {}, {lineTo} = CanvasRenderingContext2D.prototype;
    CanvasRenderingContext2D.prototype.lineTo = function (x, y) {
        if (this.canvas.closest('#charts')) {
            const label = this.canvas.getAttribute('aria-label');
            const curve = curves[`${label} ${this.strokeStyle} ${this.lineWidth}`] ??= {count: 0, low: y, high: y};
            Object.assign(curve, {count: curve.count + 1, low: Math.min(curve.low, y), high: Math.max(curve.high, y)});
        }
        lineTo.call(this, x, y);
    };
})()"""


def test_noisy_flight_has_curves(browser: Browser, tmp_path: Path) -> None:
    """A flight with noise has a dozen curves that are not flat."""
    run = flown(find_scenario("osprey_servo").vary(flight={"duration": 2.0}), tmp_path / "run")
    with shown(browser, run) as address:
        browser.call("Emulation.setDeviceMetricsOverride", width=1280, height=4000, deviceScaleFactor=1, mobile=False)
        try:
            browser.run(CURVES)
            press(browser, "End")
            browser.wait_for("Object.keys(curves).some(name => name.startsWith('ticks: lateness'))")  # the last chart
            curves = browser.run("curves").values()
        finally:
            browser.call("Emulation.clearDeviceMetricsOverride")
        # A chart is 83 pixels high; its grid has 20 lines at most.
        assert len([curve for curve in curves if curve["count"] > 50 and curve["high"] - curve["low"] > 20.0]) >= 12
        assert browser.run("document.getElementById('mode').textContent") == "ENGAGED"
        hosts = browser.run("[...new Set(performance.getEntriesByType('resource').map(one => new URL(one.name).host))]")
        assert hosts == [address.split("/")[2]]
        assert browser.console == []


def test_keys_step_ticks_and_play(browser: Browser, recorded: Path, tape: Tape) -> None:
    """Keys step single ticks, jump to events, and play."""
    with shown(browser, recorded):
        assert browser.run(TIME) == 0.0
        for expected in (0.01, 0.02, 0.03):  # 100 Hz
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


def test_keys_step_seconds_and_choose_view(browser: Browser, osprey_gust: Scenario, tmp_path: Path) -> None:
    """Keys step seconds, jump to a command, and choose the window and the camera."""

    def chosen(selector: str) -> str:
        return f"[...document.querySelectorAll('{selector}')].find(one => one.ariaPressed === 'true').textContent"

    run = flown(osprey_gust.vary(flight={"duration": 2.5}), tmp_path / "run")  # its first command begins at 2 s
    with shown(browser, run):
        press(browser, "ArrowRight", shift=True)
        browser.wait_for(f"{TIME} === 1")
        press(browser, "]")
        browser.wait_for(f"{TIME} === 2")
        press(browser, "ArrowLeft", shift=True)
        browser.wait_for(f"{TIME} === 1")
        press(browser, "w")
        browser.wait_for(f"{chosen('#window, #whole')} === '20 s'")
        press(browser, "a")
        browser.wait_for(f"{chosen('#window, #whole')} === 'All'")
        for camera in ("Orbit", "Map", "Chase"):
            press(browser, "c")
            browser.wait_for(f"{chosen('#cameras button')} === '{camera}'")
        press(browser, "l")
        browser.wait_for(f"{TIME} === 2.5 && document.getElementById('live').ariaPressed === 'true'")
        assert browser.console == []


def test_slow_playback_takes_longer(browser: Browser, recorded: Path) -> None:
    """At a tenth of the speed a flight takes ten times as long."""
    with shown(browser, recorded):
        for _ in range(9):
            press(browser, "-")
        assert browser.run("document.getElementById('speed').value") == "0.1"
        begun = browser.run("performance.now()")
        press(browser, " ")
        browser.wait_for(f"{TIME} >= 0.2")
        # In ms. A browser that draws late takes longer, and none takes less but by the 0.005 s to which the time is rounded.
        assert browser.run("performance.now()") - begun > 1900.0


def test_recording_flight_followed_to_end(browser: Browser, recorded: Path, tmp_path: Path) -> None:
    content, path = (recorded / "run_0.mcap").read_bytes(), tmp_path / "run_0.mcap"
    with serving(tmp_path) as address:
        browser.open(address)
        browser.wait_for(f"{STATE} === 'WAITING'")
        with path.open("ab") as recorder:  # as a recorder, it never makes the file shorter
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


ASKS = """(() => {
    const {send} = WebSocket.prototype;
    WebSocket.prototype.send = function (text) { window.asks = true; send.call(this, text); };
})()"""


def test_hanging_server_is_no_server(browser: Browser, recorded: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A server that hangs counts as absent until the next answer."""
    runs, update = threading.Event(), Flight.update
    runs.set()
    monkeypatch.setattr(Flight, "update", lambda *given: runs.wait() and update(*given))
    with shown(browser, recorded):
        try:
            browser.run(ASKS)
            browser.wait_for("window.asks")
            runs.clear()
            browser.wait_for(f"{STATE} === 'NO SERVER'", limit=30.0)  # after 10 s
        finally:
            runs.set()
        browser.wait_for(f"{STATE} === 'ENDED'")


def pictures_of(browser: Browser) -> list[str]:
    """All canvases of the page, in each camera."""
    found = []
    for camera in ("chase", "orbit", "map"):
        set_camera(browser, camera)
        found += browser.run("[...document.querySelectorAll('canvas')].map(one => one.toDataURL())")
    return found


def test_browser_without_webgl_draws_same_pixels(browser: Browser, recorded: Path, tmp_path: Path) -> None:
    with shown(browser, recorded):
        expected = pictures_of(browser)
    flags = ("--disable-software-rasterizer", "--disable-webgl", "--disable-webgl2", "--disable-3d-apis")
    with Browser(tmp_path / "profile", flags=flags) as other, shown(other, recorded):
        assert other.run("document.createElement('canvas').getContext('webgl') === null")
        assert pictures_of(other) == expected
        assert other.console == []
    assert len(set(expected)) > 10


def test_second_run_drawn_as_ghost(browser: Browser, recorded: Path, tape: Tape, tmp_path: Path) -> None:
    pose, y = tape["pose"], tape["y"]
    values = pose.values.copy()
    values[:, pose.names.index("east")] += 20.0 + 0.3 * pose["north"]  # m: aside, and not along the pixels
    ghost = {"pose": Signal(pose.stamp_ns, pose.names, values), "y": Signal(y.stamp_ns, y.names, y.values + 0.01)}
    write_run(Tape(ghost), tmp_path / "aside", LogAttachments())
    least = {"#scene": 20, "#charts canvas": 100}  # pixels; the mark of the ghost in a legend has 32
    for scheme in ("light", "dark"):
        browser.call("Emulation.setEmulatedMedia", features=[{"name": "prefers-color-scheme", "value": scheme}])
        try:
            with shown(browser, recorded):
                set_camera(browser, "map")
                for canvas in least:
                    assert pixels_of(browser, canvas, "--ghost") == 0  # no colour of the flight is mistaken for it
            with shown(browser, recorded, tmp_path / "aside"):
                browser.wait_for("document.getElementById('name').textContent === 'run and ghost aside'")
                set_camera(browser, "map")
                for canvas, count in least.items():
                    browser.wait_for(f"{PIXELS}('{canvas}', '--ghost') > {count}", limit=10.0)
                assert browser.console == []
        finally:
            browser.call("Emulation.setEmulatedMedia", features=[])


def test_fleet_on_one_map_with_choice_of_aircraft(browser: Browser, tmp_path: Path) -> None:
    """uav2 begins 2 s after uav1 and flies north, 300 m east of uav1: the choice of the other keeps the instant."""
    names = ["phi", "theta", "psi", "north", "east", "altitude"]
    for name, start_ns, east in (("uav1", 10_000_000_000, 0.0), ("uav2", 12_000_000_000, 300.0)):
        with BagWriter(tmp_path / name) as bag:
            pose = bag.add_topic(f"/{name}/pose", JOINT_STATE, "")
            for k in range(101):
                stamp_ns = start_ns + k * 100_000_000
                bag.write(pose, stamp_ns, stamp_ns, k, vector(stamp_ns, names, [0.0, 0.0, 0.0, 2.0 * k, east + 0.3 * k, 50.0]))
    place = "document.getElementById('aircraft')"
    with shown(browser, tmp_path / "uav1", tmp_path / "uav2", fleet=True) as address:
        browser.wait_for(f"{place}?.options.length === 2")
        assert browser.run(f"[...{place}.options].map(({{text}}) => text)") == ["uav1", "uav2"]
        browser.wait_for(f"{PIXELS}('#scene', '--ghost') > 20")
        browser.run(f"location.href = '{address.partition('#')[0]}#t=5'; location.reload()")
        browser.wait_for(f"{TIME} === 5 && {place}?.value === '0' && {place}.options.length === 2")
        browser.run(f"{place}.value = '1'; {place}.dispatchEvent(new Event('change'))")
        browser.wait_for(f"{TIME} === 3 && document.getElementById('name').textContent === 'uav2' && {place}?.value === '1'")
        browser.wait_for(f"{PIXELS}('#scene', '--ghost') > 20")
        assert browser.console == []


def test_names_that_are_html_shown_as_text(browser: Browser, tmp_path: Path) -> None:
    hostile = "<img src=x onerror=document.title=1>"
    with BagWriter(tmp_path / hostile.replace("/", "")) as bag:
        y = bag.add_topic("/y", JOINT_STATE, "")
        for k in range(200):
            bag.write(y, k * 10_000_000, k * 10_000_000, k, vector(k * 10_000_000, [hostile], [math.sin(k)]))
    with shown(browser, tmp_path / hostile):
        assert browser.run("document.getElementById('name').textContent") == hostile
        assert browser.run("document.querySelectorAll('img').length") == 0
        assert browser.run("document.querySelector('#charts canvas').getAttribute('aria-label')") == hostile
        assert browser.console == []


def test_phone_has_one_column(browser: Browser, recorded: Path) -> None:
    """The dark scheme has different colours."""
    with shown(browser, recorded):
        browser.call("Emulation.setDeviceMetricsOverride", width=390, height=800, deviceScaleFactor=2, mobile=True)
        browser.call("Emulation.setEmulatedMedia", features=[{"name": "prefers-color-scheme", "value": "dark"}])
        try:
            before = browser.run(DRAWN)
            browser.wait_for(f"{DRAWN} > {before}")
            assert browser.run("document.documentElement.scrollWidth <= innerWidth")
            assert browser.run("document.getElementById('charts').getBoundingClientRect().left") < 20
            assert browser.run("getComputedStyle(document.body).backgroundColor") == "rgb(27, 31, 36)"
            assert browser.run("document.getElementById('scene').width") == 2 * browser.run(
                "document.getElementById('scene').clientWidth"
            )
        finally:
            browser.call("Emulation.clearDeviceMetricsOverride")
            browser.call("Emulation.setEmulatedMedia", features=[])
        assert browser.console == []


# Signs of the scene: what a roll right, a nose up and a nose right do on the screen


def seen(browser: Browser, expression: str) -> Any:
    """An expression with scene.js as `m`, and `at`: the place on the screen of a body point of a pose, seen from behind."""
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
    # Stevens, Lewis, Aircraft Control and Simulation, eq. (1.3-20), here as a product of plane rotations.
    phi, theta, psi = 0.7, -0.4, 2.1

    def plane(i: int, j: int, angle: float) -> Any:
        matrix = np.eye(3)
        matrix[i, i] = matrix[j, j] = math.cos(angle)
        matrix[i, j], matrix[j, i] = -math.sin(angle), math.sin(angle)
        return matrix

    expected = plane(0, 1, psi) @ plane(2, 0, theta) @ plane(1, 2, phi)
    assert np.array(seen(page, f"m.rotation({phi}, {theta}, {psi})")) == pytest.approx(expected, abs=1e-12)


def test_surfaces_deflect_in_sense_of_input(page: Browser) -> None:
    # The trailing edges are the last points of a surface. Down is +z, right is +y.
    edges = "m.aircraft({%s}).filter(one => one.part === 'surface').map(one => one.points[2])"
    still = np.array(seen(page, edges % ""))
    right_aileron, right_elevator, left_aileron, left_elevator, rudder = range(5)
    up = np.array(seen(page, edges % "elevator: 0.3")) - still
    assert up[right_elevator, 2] < 0 > up[left_elevator, 2]  # nose up: both go up
    roll = np.array(seen(page, edges % "aileron: 0.3")) - still
    assert roll[right_aileron, 2] < 0 < roll[left_aileron, 2]  # roll right: the right one goes up, the left one down
    yaw = np.array(seen(page, edges % "rudder: 0.3")) - still
    assert yaw[rudder, 1] > 0  # nose right: it goes to the right


@pytest.mark.parametrize(
    ("scenario", "senses"),
    [
        ("osprey_gust", {"elevator": 1, "aileron": 1, "rudder": 1}),
        ("jsbsim_c172p", {"elevator": -1, "aileron": 1, "rudder": -1}),  # positive is nose down, roll right, nose left
    ],
)
def test_surface_drawn_in_sense_that_aircraft_gives_input(
    page: Browser, tmp_path: Path, scenario: str, senses: dict[str, int]
) -> None:
    truth = Signal(np.array([0], dtype=np.int64), tuple(f"actuator.{name}" for name in senses), np.full((1, 3), 0.1))
    write_run(Tape({"truth": truth}), tmp_path / "run", LogAttachments(find_scenario(scenario).path))
    flight = Flight(tmp_path / "run")
    flight.update()
    found = seen(page, f"m.deflections({{info: {json.dumps(flight.description)}, get: () => ({{at: () => 0.1}})}}, 0)")
    assert {name: np.sign(angle) for name, angle in found.items()} == senses


def test_horizon_moves_against_aircraft(page: Browser) -> None:
    """The horizon falls when the nose rises, and turns left in a roll to the right."""

    def sky(pose: str, x: float, y: float) -> bool:
        """Whether a point of the instrument shows the sky; x and y in fractions of its radius from its centre."""
        script = f"""import('./scene.js').then(m => {{
            const canvas = document.createElement('canvas');
            canvas.style = 'width: 200px; height: 200px';
            document.body.append(canvas);
            m.drawHorizon(canvas, {pose}, name => ({{'--sky': '#0000ff', '--ground': '#00ff00'}})[name] ?? '#888888');
            const [column, row] = [canvas.width * (1 + {x}) / 2, canvas.height * (1 + {y}) / 2];
            const [r, g, b] = canvas.getContext('2d').getImageData(column, row, 1, 1).data;
            canvas.remove();
            return b > g;
        }})"""
        return bool(page.run(script))

    level, up, roll = (f"{{attitude: true, phi: {phi}, theta: {theta}}}" for phi, theta in ((0, 0), (0, 0.2), (0.5, 0)))
    assert (sky(level, -0.6, -0.1), sky(level, -0.6, 0.1)) == (True, False)
    assert sky(up, -0.6, 0.1)
    assert [sky(roll, -0.6, y) for y in (-0.1, 0.1)] == [True, True]  # the horizon falls on the left and rises on the right
    assert [sky(roll, 0.6, y) for y in (-0.1, 0.1)] == [False, False]


def test_a_zoomed_out_line_keeps_its_peaks(page: Browser) -> None:
    peaks = """(() => {
        const series = new d.Series(['a']);
        const t = Float64Array.from({length: 100000}, (_, k) => k / 100), a = new Float32Array(100000);
        a[12345] = 7; a[54321] = -5;
        series.append(t, [a]);
        const chosen = c.rows(series, series.column('a'), [0, 1000], 500);
        return [chosen.length, Math.max(...chosen.map(k => a[k])), Math.min(...chosen.map(k => a[k]))];
    })()"""
    count, largest, least = page.run(f"import('./series.js').then(d => import('./charts.js').then(c => {peaks}))")
    assert count <= 1000
    assert (largest, least) == (7, -5)


def test_log_without_pose_shows_attitude_of_truth(browser: Browser, tape: Tape, tmp_path: Path) -> None:
    stamps = np.arange(50, dtype=np.int64) * 20_000_000
    truth = Signal(stamps, ("t", "x.phi", "x.theta"), np.column_stack([stamps / 1e9, np.full(50, 0.5), np.full(50, -0.1)]))
    write_run(Tape({"truth": truth, "y": tape["y"]}), tmp_path / "run", LogAttachments())
    with shown(browser, tmp_path / "run"):
        text = browser.run("document.body.innerText")
        assert "no pose in the log: attitude of truth, no place" in text
        assert f"{math.degrees(0.5):.1f} deg" in text
        assert colours_of(browser, "#scene") > 20
        assert browser.console == []


POSE = ("phi", "theta", "psi", "north", "east", "altitude", "v_north", "v_east", "climb")


def test_guided_flight_shows_route_and_modes(browser: Browser, tmp_path: Path) -> None:
    names = ("mode", "mode.lateral", "mode.vertical", "leg", "xtrack", "to_go", "phi_c", "theta_c", "target.altitude", "y.V")
    stamps = np.arange(200, dtype=np.int64) * 20_000_000
    guidance = Signal(stamps, names, np.tile([1.0, 4.0, 2.0, 3.0, -2.5, 100.0, 0.1, 0.0, 30.0, 0.0], (200, 1)))
    pose = np.tile([0.1, 0.02, 0.0, 0.0, 0.0, 30.0, 25.0, 0.0, 0.0], (200, 1))
    pose[:, POSE.index("north")] = 25.0 * stamps / 1e9
    pose[:, POSE.index("altitude")] += np.sin(stamps / 1e9)
    flown = {"guidance": guidance, "pose": Signal(stamps, POSE, pose)}
    write_run(Tape(flown), tmp_path / "run", LogAttachments(find_scenario("osprey_route").path))
    write_run(Tape(flown), tmp_path / "other", LogAttachments(find_scenario("osprey_servo").path))
    with shown(browser, tmp_path / "run"):
        readouts = browser.run("document.getElementById('readouts').innerText")
        for text in ("ENGAGED", "ROUTE, ALTITUDE", "3: 100 m, 0:04", "-2.5 m", "30.0 m"):  # 100 m at 25 m/s
            assert text in readouts
        assert browser.run("document.querySelector('[data-camera=map]').ariaPressed") == "true"  # a guided flight shows its map
        browser.run(SAID)
        set_camera(browser, "map")
        said = set(browser.run("said"))
        assert {
            "N",
            "H",
            "0",
            "2",
            "3",
            "4",
            "6",
            "7",
            "500 m",
            "V (m/s)",
            "altitude (m)",
            "25.0",
            "30",
            "000",
        } <= said  # 3: the timeline
        browser.run("void (units.value = 'ft, kt', units.dispatchEvent(new Event('change')))")
        browser.wait_for("['V (kt)', '48.6', '98'].every(text => said.includes(text))")  # 25 m/s and 30 m
        assert "98.4 ft" in browser.run("document.getElementById('readouts').innerText")
        browser.run("void (units.value = 'm, m/s', units.dispatchEvent(new Event('change')))")
        titles = browser.run("[...document.querySelectorAll('#charts canvas')].map(one => one.getAttribute('aria-label'))")
        assert titles == ["phi over its command", "theta over its command", "cross-track", "altitude"]
        for colour in ("--plant", "--reference"):  # the altitude, and its command
            assert pixels_of(browser, "[aria-label=altitude]", colour) > 300
        set_camera(browser, "map")
        assert pixels_of(browser, "#scene", "--reference") > 100
        assert browser.console == []
    with shown(browser, tmp_path / "other"):
        set_camera(browser, "map")
        assert pixels_of(browser, "#scene", "--reference") == 0  # nothing but a route has its colour


def test_learned_entries_and_error_by_model_shown(browser: Browser, tmp_path: Path) -> None:
    k = np.arange(200)
    ticks = np.column_stack([np.ones(200), np.where(k < 100, 7.0, 8.0), np.where(k < 100, 0.1, 0.05)])
    stamps = 20_000_000 * k
    names = [f"{kind}.{entry}" for entry in ("B[p, aileron]", "A[q, q]") for kind in ("value", "deviation")]
    found = np.array([[0.0, 5.0, 0.5, -1.0, 0.9], [1.0, 4.0, 0.25, -1.0, 0.9]])  # A[q, q] is not known
    signals = {
        "internals": Signal(stamps, ("mode", "parameters", "e.q"), ticks),
        "learned": Signal(stamps[[50, 100]], ("proposed", *names), found),
    }
    write_run(Tape(signals), tmp_path / "run", LogAttachments(find_scenario("osprey_learn").path))
    with shown(browser, tmp_path / "run"):
        titles = browser.run("[...document.querySelectorAll('#charts canvas')].map(one => one.getAttribute('aria-label'))")
        assert [title for title in titles if "learned" in title] == ["B[p, aileron], learned"]
        rows = browser.run(
            "[...document.querySelectorAll('#models tr')].map(one => [...one.cells].map(cell => cell.textContent))"
        )
        assert rows == [  # 0.1 rad/s and half of it
            ["", "from (s)", "to (s)", "q (mrad/s)"],
            ["start", "0.0", "2.0", "100"],
            ["model 1", "2.0", "4.0", "50.0"],
        ]
        browser.run(SAID)
        press(browser, "End")
        browser.wait_for("said.includes('B[p, aileron] 4.000 +- 0.50')")
        assert pixels_of(browser, "[aria-label*=learned]", "--plant") > 100
        assert browser.console == []


SAID = """(() => {
    const said = window.said = [], fillText = CanvasRenderingContext2D.prototype.fillText;
    CanvasRenderingContext2D.prototype.fillText = function (text, ...place) {
        said.push(text);
        fillText.call(this, text, ...place);
    };
})()"""


@pytest.mark.parametrize(
    ("names", "expected"), [(("phi", "theta", "climb"), []), (("climb",), ["NO ATTITUDE IN THE LOG", "NO ATTITUDE"])]
)
def test_pose_of_bridge_drawn_where_it_has_attitude(
    names: tuple[str, ...], expected: list[str], browser: Browser, tmp_path: Path
) -> None:
    stamps, values = np.arange(50, dtype=np.int64) * 20_000_000, {"phi": 0.5, "theta": -0.1, "climb": 2.0}
    pose = Signal(stamps, names, np.tile([values[name] for name in names], (50, 1)))
    write_run(Tape({"pose": pose}), tmp_path / "run", LogAttachments())
    with shown(browser, tmp_path / "run"):
        browser.run(SAID)
        set_camera(browser, "orbit")
        said = browser.run("said")
        assert [text for text in said if text.startswith("NO ")] == expected
        readouts = browser.run("document.getElementById('readouts').innerText")
        assert "2.0 m/s" in readouts
        assert (f"{math.degrees(0.5):.1f} deg" in readouts) == (not expected)
        assert (pixels_of(browser, "#scene", "--plant") > 30) == bool(expected)  # a square of 64 in place of the aircraft
        assert (pixels_of(browser, "#horizon", "--sky") > 1000) == (not expected)
        assert browser.console == []


# Control


def a_control(flight: Flight, nodes: NodesInMemory, controls: list[Control]) -> Control:
    """A control of nodes in memory; kept, so that a test can close it."""
    controls.append(Control(in_the_air(flight), nodes, "ABCD-EFGH", assess=delay_margins))
    return controls[-1]


def take(browser: Browser, key: str = "abcd-efgh") -> None:
    """Take control, once the page offers it."""
    browser.wait_for("!document.getElementById('control').hidden")
    browser.run(f"document.getElementById('control-typed').value = '{key}'")
    browser.run("void document.getElementById('control-take').click()")


def test_desk_has_parts_of_nodes_that_run(browser: Browser, recorded: Path, osprey_gust: Scenario) -> None:
    nodes, controls = NodesInMemory(osprey_gust, "controller"), list[Control]()

    with shown(browser, recorded, control=lambda flight: a_control(flight, nodes, controls)):
        take(browser)
        browser.wait_for("document.getElementById('control-gains') !== null")
        assert browser.run("document.getElementById('control-map') === null")
        nodes.names[:] = ["bridge"]
        browser.wait_for("document.getElementById('control-map') !== null && document.getElementById('control-gains') === null")
        assert browser.console == []
    controls[0].close()


def test_desk_starts_from_aircraft_faults(browser: Browser, recorded: Path, osprey_gust: Scenario) -> None:
    """The desk keeps the faults of the aircraft."""
    nodes, controls = NodesInMemory(osprey_gust, "aircraft"), list[Control]()
    nodes.values["aircraft"] |= {"actuators.stuck_at": [math.inf, 3.5, math.inf, math.inf], "sensors.dropout": 0.25}

    with shown(browser, recorded, control=lambda flight: a_control(flight, nodes, controls)):
        take(browser)
        browser.wait_for("document.querySelectorAll('[data-actuator]').length === 4")
        chosen = "[...document.querySelectorAll('[data-actuator]')].map(one => one.value)"
        assert browser.run(chosen) == ["", "stuck", "", ""]
        assert browser.run("document.querySelector('[aria-label=\"Loss of samples\"]').value") == "0.25"
        last = "document.querySelector('[data-actuator=\"3\"]')"
        browser.run(f"{last}.value = 'lost'; void {last}.dispatchEvent(new Event('change'))")
        browser.wait_for("document.getElementById('control-said').textContent.includes('lost')")
        assert nodes.values["aircraft"]["actuators.stuck_at"] == [math.inf, 3.5, math.inf, math.inf]
        assert nodes.values["aircraft"]["actuators.lost_at"] == [math.inf, math.inf, math.inf, 0.0]
        assert browser.run(chosen) == ["", "stuck", "", "lost"]
        assert browser.console == []
    controls[0].close()


def test_gains_are_pending_until_applied(browser: Browser, recorded: Path, osprey_gust: Scenario) -> None:
    """Applied gains can be undone."""
    nodes = NodesInMemory(osprey_gust, "aircraft", "controller", "guidance")
    controls: list[Control] = []
    before = nodes.values["controller"]["k_g"]

    def said(text: str) -> str:
        return f"document.getElementById('control-said').textContent.includes('{text}')"

    with shown(browser, recorded, control=lambda flight: a_control(flight, nodes, controls)):
        browser.wait_for("!document.getElementById('control').hidden")
        assert browser.run("document.getElementById('control-desk').hidden")
        take(browser, "abcd-efgx")
        browser.wait_for(said("the control key is wrong"))
        browser.wait_for("new Promise(resume => setTimeout(() => resume(true), 1000))")  # as long as the next key is refused
        take(browser)
        browser.wait_for("document.querySelectorAll('#control-gains tr').length > 10")
        slider = "document.querySelector('#control-gains [data-gain=k_g]')"
        browser.run(f"{slider}.value = {1.5 * before}; void {slider}.dispatchEvent(new Event('input'))")
        browser.wait_for("document.getElementById('control-margins').textContent.includes('pending: delay margin')")
        assert browser.run("document.getElementById('control-apply').textContent") == "Apply 1"
        assert nodes.values["controller"]["k_g"] == before  # a slider sends nothing
        browser.run("void document.getElementById('control-apply').click()")
        browser.wait_for(said("applied"))
        assert nodes.values["controller"]["k_g"] == pytest.approx(1.5 * before, rel=0.01)  # three digits
        browser.wait_for("document.getElementById('control-logged').textContent === 'not in the log yet'")  # a recorded one
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
