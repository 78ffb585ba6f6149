# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Draw the pictures of the documentation again from today's code.

.venv/bin/python -m benchmarks.pictures                  # all; those of pages need a browser
.venv/bin/python -m benchmarks.pictures report.png nodes.svg
"""

import base64
import json
import sys
import tempfile
from collections.abc import Callable, Sequence
from io import BytesIO
from pathlib import Path
from typing import NamedTuple

from benchmarks import counterexample, diagrams, lyapunov
from benchmarks.tables import parser_of
from benchmarks.view import flying, watching
from PIL import Image
from PIL.PngImagePlugin import PngInfo
from tests.browser import CHROMIUM, Browser

from flight_analysis.closed_loop.scenario import Scenario
from flight_analysis.closed_loop.scenario_library import find_scenario
from flight_analysis.closed_loop.simulate import simulate
from flight_analysis.report.run_folder import REPORT, attachments_for
from flight_analysis.report.run_report import rewrite_report
from flight_log.tape_writer import write_run

IMAGES = Path(__file__).resolve().parents[1] / "docs" / "images"
TITLE = "Title"
"""Key of the text in a PNG that says what the picture shows."""
FIGURES = "Figures"
"""Key of the text in a PNG that has the figures of what it shows, as JSON."""
WIDTH, HEIGHT, COLOURS = 1280, 800, 64
SCREEN = {"width": WIDTH, "height": HEIGHT, "deviceScaleFactor": 1, "mobile": False}
DRAWN = "Number(document.body?.dataset.drawn ?? 0)"
STATE = "document.getElementById('state')?.textContent"
ENDED = f"{STATE} === 'ENDED'"
TIME = "parseFloat(document.getElementById('time').textContent.slice(4))"
# s: instants that the pictures show: a roll, the vertical gust, the second leg of the route
LIVE_AT, GHOST_AT, GUIDED_AT = (12.0, 40.6, 60.0)
LIVE_SECONDS = 60.0  # duration of the live flight, which is faster than real time, s
DEFAULT = "osprey_servo"
ROUTE = "osprey_route"


class Picture(NamedTuple):
    """A picture: the scenario or the table that it shows, and what draws it to a file.

    A picture without `draw` is written by the measurement that it belongs to.
    """

    shows: str
    draw: Callable[[Path, str], None] | None = None
    is_of_page: bool = False


def flown(scenario: Scenario, folder: Path, name: str) -> Path:
    """Fly a scenario in one process, and return the run."""
    run = folder / name
    run.mkdir()
    write_run(simulate(scenario), run, attachments_for(scenario, run))
    return run


# ---- Pages


def save(shot: str, path: Path, shows: str, figures: str = "") -> None:
    """Write a screenshot, which is given as base64, as a PNG of a third of its size.

    `figures` are those of the flight that it shows. The PNG keeps them as text, by which a test
    recognises a picture of another flight.
    """
    picture = Image.open(BytesIO(base64.b64decode(shot))).convert("RGB")
    info = PngInfo()
    info.add_text(TITLE, shows)
    info.add_text(FIGURES, figures)
    picture.quantize(COLOURS).save(path, optimize=True, pnginfo=info)


def save_view(
    runs: Sequence[Path],
    until: str,
    path: Path,
    shows: str,
    *,
    at: str = "",
    clicks: Sequence[str] = (),
) -> None:
    """Open the live page of runs, wait until a condition holds, click on elements, save a picture.

    `until` is the condition, in JavaScript; `at` ends the address of the page, such as with an
    instant. No picture is saved if the page shows a failsafe, because the host was too busy then.
    """
    with (
        tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile,
        Browser(Path(profile), WIDTH, HEIGHT) as browser,
        watching(*runs) as (_, address),
    ):
        browser.call("Emulation.setDeviceMetricsOverride", **SCREEN)
        browser.open(f"{address}{at}")
        browser.wait_for(f"{DRAWN} > 2 && {until}", limit=60.0)
        for selector in clicks:
            before = browser.run(DRAWN)
            browser.run(f"void document.querySelector('{selector}').click()")
            browser.wait_for(f"{DRAWN} > {before}")
        modes = browser.run("document.getElementById('modes').textContent")
        if modes == "ENGAGED":
            save(browser.call("Page.captureScreenshot")["data"], path, shows)
        else:
            print(f"{path.name}: left as it is, this host is too busy for its flight: {modes}")
        browser.open("about:blank")


def report(path: Path, shows: str) -> None:
    """Draw the first screen of the report of the default flight."""
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as temporary:
        run = flown(find_scenario(shows), Path(temporary), shows)
        errors = rewrite_report(run).flight.summary["errors"]
        figures = json.dumps({name: metrics["whole"]["rms"] for name, metrics in errors.items()})
        with Browser(Path(temporary) / "profile", WIDTH, HEIGHT) as browser:
            browser.call("Emulation.setDeviceMetricsOverride", **SCREEN)
            browser.open(run / REPORT)
            browser.wait_for(f"{DRAWN} === 1")
            save(browser.call("Page.captureScreenshot")["data"], path, shows, figures)


def view_ghost(path: Path, shows: str) -> None:
    """Draw the default flight in its gust, with half the gain as a ghost."""
    with tempfile.TemporaryDirectory() as folder:
        servo = find_scenario(shows)
        run = flown(servo, Path(folder), shows)
        weak = flown(servo.vary(controller={"k_g": 0.5}), Path(folder), "half_the_gain")
        save_view((run, weak), ENDED, path, shows, at=f"&t={GHOST_AT}", clicks=["#window"])


def view_guided(path: Path, shows: str) -> None:
    """Draw a guided flight on its second leg, on the map."""
    with tempfile.TemporaryDirectory() as folder:
        run = flown(find_scenario(shows), Path(folder), shows)
        clicks = ["[data-camera=map]"]
        save_view((run,), ENDED, path, shows, at=f"&t={GUIDED_AT}", clicks=clicks)


def view_live(path: Path, shows: str) -> None:
    """Draw the default flight over topics on the live page while it flies.

    It flies in lockstep, which other work on the host does not disturb.
    """
    with (
        tempfile.TemporaryDirectory() as folder,
        flying(Path(folder), LIVE_SECONDS, "--lockstep") as (flight, live),
    ):
        save_view((live,), f"{STATE} === 'LIVE' && {TIME} > {LIVE_AT}", path, shows)
        flight.communicate()


# ---- The pictures


def drawing(name: str) -> Callable[[Path, str], None]:
    """Return a function that writes a drawing of `benchmarks.diagrams` to a file."""

    def draw(path: Path, shows: str) -> None:
        diagrams.save_drawing(getattr(diagrams, name)(), path, shows)

    return draw


def plotted(main: Callable[[], object]) -> Callable[[Path, str], None]:
    """Return a function that runs a program which plots its own picture."""

    def draw(path: Path, shows: str) -> None:
        main()

    return draw


PICTURES = {
    "report.png": Picture(DEFAULT, report, is_of_page=True),
    "view_live.png": Picture(DEFAULT, view_live, is_of_page=True),
    "view_ghost.png": Picture(DEFAULT, view_ghost, is_of_page=True),
    "view_guided.png": Picture(ROUTE, view_guided, is_of_page=True),
    "leg.svg": Picture(diagrams.LEG_ROUTE, drawing("leg")),
    "effectors.svg": Picture(diagrams.WING, drawing("effectors")),
    "nodes.svg": Picture("flight_core.topics", drawing("nodes")),
    "bridge.svg": Picture("autopilot_bridge", drawing("bridge")),
    "packages.svg": Picture("tests/pure/imports.yaml", drawing("packages")),
    "laws.svg": Picture("docs/evidence/tables/experiments-laws.csv", drawing("laws")),
    "lyapunov.png": Picture("benchmarks.lyapunov", plotted(lyapunov.main)),
    "counterexample.png": Picture("benchmarks.counterexample", plotted(counterexample.main)),
    "learning.png": Picture("benchmarks.learning"),
}


def main() -> None:
    """Draw all pictures, or those that are named."""
    parser = parser_of(__doc__)
    parser.add_argument("names", nargs="*", metavar="NAME", help=", ".join(PICTURES))
    names = parser.parse_args().names
    if unknown := [name for name in names if name not in PICTURES]:
        sys.exit(f"names: found {', '.join(unknown)}, expected some of {', '.join(PICTURES)}")
    for name in names or PICTURES:
        picture = PICTURES[name]
        if picture.draw is None:
            print(f"{name}: {picture.shows} draws it")
        elif picture.is_of_page and CHROMIUM is None:
            print(f"{name}: left as it is, no browser is installed")
        else:
            picture.draw(IMAGES / name, picture.shows)
            print(f"{name}: {(IMAGES / name).stat().st_size / 1e3:.0f} kB, {picture.shows}")


if __name__ == "__main__":
    main()
