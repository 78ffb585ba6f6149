# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""The pictures of the live page in the documentation.

A flight in the air, a replay with a ghost, a guided flight.

.venv/bin/python -m benchmarks.view_pictures
"""

import base64
import tempfile
from collections.abc import Sequence
from io import BytesIO
from pathlib import Path

from benchmarks.view import flying, watching
from PIL import Image
from tests.browser import Browser

from flight_analysis.closed_loop.scenario import Scenario
from flight_analysis.closed_loop.scenario_library import find_scenario
from flight_analysis.closed_loop.simulate import simulate
from flight_analysis.report.run_folder import attachments_for
from flight_log.tape_writer import write_run

IMAGES = Path(__file__).resolve().parents[1] / "docs" / "images"
WIDTH, HEIGHT, COLOURS = 1280, 800, 64
DRAWN = "Number(document.body?.dataset.drawn ?? 0)"
STATE = "document.getElementById('state')?.textContent"
ENDED = f"{STATE} === 'ENDED'"
TIME = "parseFloat(document.getElementById('time').textContent.slice(4))"
# s: a roll, the vertical gust, the second leg of the route
LIVE_AT, GHOST_AT, GUIDED_AT = (12.0, 40.6, 60.0)


def flown(scenario: Scenario, folder: Path, name: str) -> Path:
    """A flight in one process, as a run."""
    run = folder / name
    run.mkdir()
    write_run(simulate(scenario), run, attachments_for(scenario, run))
    return run


def save(
    browser: Browser,
    runs: Sequence[Path],
    until: str,
    picture: str,
    *,
    at: str = "",
    clicks: Sequence[str] = (),
) -> None:
    """Open the page of runs, at an instant, click on elements, and save its picture.

    It is saved once a condition holds.
    """
    with watching(*runs) as (_, address):
        browser.open(f"{address}{at}")
        browser.wait_for(f"{DRAWN} > 2 && {until}", limit=60.0)
        for selector in clicks:
            before = browser.run(DRAWN)
            browser.run(f"void document.querySelector('{selector}').click()")
            browser.wait_for(f"{DRAWN} > {before}")
        shot = Image.open(BytesIO(base64.b64decode(browser.call("Page.captureScreenshot")["data"])))
        # a third of the size
        shot.convert("RGB").quantize(COLOURS).save(IMAGES / picture, optimize=True)
        browser.open("about:blank")


def main() -> None:
    """Write the pictures to docs/images."""
    with (
        tempfile.TemporaryDirectory() as temporary,
        Browser(Path(temporary) / "profile", WIDTH, HEIGHT) as browser,
    ):
        folder = Path(temporary)
        servo = find_scenario("osprey_servo")
        run = flown(servo, folder, "osprey_servo")
        weak = flown(servo.vary(controller={"k_g": 0.5}), folder, "half_the_gain")
        guided = flown(find_scenario("osprey_route"), folder, "osprey_route")
        save(browser, (run, weak), ENDED, "view_ghost.png", at=f"&t={GHOST_AT}", clicks=["#window"])
        save(
            browser,
            (guided,),
            ENDED,
            "view_guided.png",
            at=f"&t={GUIDED_AT}",
            clicks=["[data-camera=map]"],
        )
        (folder / "runs").mkdir()
        with flying(folder / "runs", LIVE_AT + 8.0) as (flight, live):
            save(browser, (live,), f"{STATE} === 'LIVE' && {TIME} > {LIVE_AT}", "view_live.png")
            flight.communicate()


if __name__ == "__main__":
    main()
