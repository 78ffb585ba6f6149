# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Show the live page of a server in this process, with a control of nodes in memory."""

import asyncio
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from tests.browser import Browser
from tests.view_link import NodesInMemory, in_the_air

from flight_analysis.closed_loop.scenario import Scenario
from flight_analysis.closed_loop.simulate import simulate
from flight_analysis.linear_loop.loop_margins import delay_margins
from flight_analysis.report.run_folder import attachments_for
from flight_log.tape_writer import write_run
from flight_view.control import Control
from flight_view.flight import Flight
from flight_view.server import Server

TOKEN = "a-token"  # noqa: S105 - of a test
STATE = "document.getElementById('state')?.textContent"
DRAWN = "Number(document.body?.dataset.drawn ?? 0)"


@contextmanager
def serving(
    *runs: Path, control: Callable[[Flight], Control] | None = None, fleet: bool = False
) -> Iterator[str]:
    """Serve runs from a thread of this process, and yield the address with the token."""
    ready = threading.Event()
    address = ""
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
    browser: Browser,
    *runs: Path,
    control: Callable[[Flight], Control] | None = None,
    fleet: bool = False,
) -> Iterator[str]:
    """Serve finished runs, open the page, and leave it before the server ends."""
    with serving(*runs, control=control, fleet=fleet) as address:
        try:
            browser.open(address)
            browser.wait_for(f"{DRAWN} > 1 && {STATE} === 'ENDED'")
            yield address
        finally:
            leave(browser)


def leave(browser: Browser) -> None:
    """Leave the page, so that it does not log a refused connection to a server that has ended."""
    browser.open("about:blank")
    browser.wait_for("location.href === 'about:blank'")


def set_camera(browser: Browser, camera: str) -> None:
    before = browser.run(DRAWN)
    browser.run(f"void document.querySelector('[data-camera={camera}]').click()")
    browser.wait_for(f"{DRAWN} > {before}")


def flown(scenario: Scenario, run: Path) -> Path:
    """Return the log of a flight, with its attachments."""
    run.mkdir()
    write_run(simulate(scenario), run, attachments_for(scenario, run))
    return run


def a_control(flight: Flight, nodes: NodesInMemory, controls: list[Control]) -> Control:
    """Return a control of nodes in memory. It is kept, so that a test can close it."""
    controls.append(Control(in_the_air(flight), nodes, "ABCD-EFGH", assess=delay_margins))
    return controls[-1]


def take(browser: Browser, key: str = "abcd-efgh") -> None:
    """Take control when the page offers it."""
    browser.wait_for("!document.getElementById('control-key').hidden")
    browser.run(f"document.getElementById('control-typed').value = '{key}'")
    browser.run("void document.getElementById('control-take').click()")


def press(browser: Browser, key: str, shift: bool = False) -> None:
    options = f"{{key: '{key}', shiftKey: {str(shift).lower()}, bubbles: true}}"
    browser.run(f"void document.body.dispatchEvent(new KeyboardEvent('keydown', {options}))")
