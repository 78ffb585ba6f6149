# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Finds the run to watch and serves the run until SIGINT or SIGTERM."""

import asyncio
import os
import secrets
import signal
import socket
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path

from flight_core.files import is_folder
from flight_core.parameters import ParameterError, require
from flight_log.disk import is_locked
from flight_log.named_vectors import JOINT_STATE, full_name
from flight_log.open_log import log_files, log_topics
from flight_log.rosbag2_metadata import bag_files
from flight_log.tape_reader import A_FLIGHT, StoredFile, chosen_namespace, listed
from flight_view.background import Line
from flight_view.control import Control
from flight_view.flight import RATES, Flight
from flight_view.server import ADDRESS, Server

DEFAULT_PORT = 8077


def runs_in_recording(runs: Path, namespace: str | None = None) -> list[Path]:
    """The runs in recording, the newest first; with a namespace those that hold a topic of it."""
    folders = sorted((folder for folder in runs.iterdir() if is_folder(folder)), reverse=True) if is_folder(runs) else []
    found, prefix = [], f"/{(namespace or '').strip('/')}/".replace("//", "/")
    for folder in folders:
        with suppress(ParameterError, OSError):
            held = any(is_locked(file) for file in bag_files(folder))
            if held and (not namespace or any(topic.startswith(prefix) for topic in log_topics(folder))):
                found.append(folder)
    return found


def newest_run(runs: Path, namespace: str | None = None) -> Path:
    """The newest run in recording, with a namespace of that aircraft, else the last run flown. Raises ParameterError."""
    if recording := runs_in_recording(runs, namespace):
        return recording[0]
    latest = runs / "latest"
    require(is_folder(latest), str(runs), "no run", "the runs of `rise-di fly`, or a RUN by its name")
    return latest.resolve()


def require_log(run: Path, namespace: str | None = None) -> None:
    """Raise ParameterError unless a run has the log of a flight, or a log in recording, of an aircraft in the namespace."""
    with suppress(OSError):
        if any(is_locked(file) for file in log_files(run)):
            return
    topics = log_topics(run)
    aircraft = [topic for topic, name in topics.items() if full_name(name) == JOINT_STATE and topic.rpartition("/")[2] in RATES]
    has = f"no topic of a flight among {listed(topics)}" if topics else "no topic"
    require(bool(aircraft), str(run), has, A_FLIGHT)
    if namespace is not None:
        chosen_namespace(aircraft, namespace, str(run))


def serve(
    runs: Sequence[Path],
    ports: Sequence[int],
    announce: Callable[[str], None],
    control: Callable[[Flight], Control] | None = None,
    namespace: str | None = None,
    scenario: StoredFile | None = None,
    background: Sequence[Line] = (),
) -> None:
    """Serve a run, and a second run as a ghost, on the first free port, until SIGINT or SIGTERM.

    `announce` gets two lines for the user. `control` lets the page command the first flight. `namespace`, `scenario` and
    `background` as in `Flight`.

    Raises ParameterError where no port is free, or a log is unreadable.
    """
    flights = [Flight(run, namespace=namespace, scenario=scenario, background=background) for run in runs]
    asyncio.run(_serve(flights, ports, announce, control))


async def _serve(
    flights: Sequence[Flight],
    ports: Sequence[int],
    announce: Callable[[str], None],
    control: Callable[[Flight], Control] | None,
) -> None:
    server = Server(flights, secrets.token_urlsafe(16), None if control is None else control(flights[0]))
    for port in ports:
        try:
            server.listen(port)
        except OSError as error:
            reason = os.strerror(error.errno or 0)  # the sentence of `strerror` may hold the address
        else:
            break
    else:
        raise ParameterError(f"--port: {port} cannot be used ({reason}), expected a free port of this host")
    announce(f"http://{ADDRESS}:{server.port}/#token={server.token}")
    announce(f"from another machine first: ssh -L {server.port}:{ADDRESS}:{server.port} {socket.gethostname()}")
    follow = asyncio.ensure_future(server.follow())
    loop = asyncio.get_running_loop()
    for number in (signal.SIGINT, signal.SIGTERM):  # also when a shell started this in the background, with SIGINT ignored
        loop.add_signal_handler(number, follow.cancel)
    try:
        await follow
    except asyncio.CancelledError:
        pass
    finally:
        await server.close()
