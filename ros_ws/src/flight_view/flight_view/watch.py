# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Find the runs to watch, and serve flights until SIGINT or SIGTERM."""

import asyncio
import os
import secrets
import signal
import socket
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path

from flight_core.files import is_folder
from flight_core.parameters import ParameterError, require
from flight_log.bag import full_names
from flight_log.disk import is_locked
from flight_log.named_vectors import JOINT_STATE, full_name
from flight_log.open_log import log_files, log_topics
from flight_log.rosbag2_metadata import bag_files
from flight_log.tape_reader import A_FLIGHT, aircraft_namespaces, chosen_namespace, topics_text
from flight_view.control import Control
from flight_view.flight import Flight
from flight_view.page_topics import RATES
from flight_view.server import ADDRESS, Server

DEFAULT_PORT = 8077


def runs_in_recording(runs: Path, namespace: str | None = None) -> list[Path]:
    """Return the runs that are being recorded, the newest first.

    With a namespace, only runs with a topic in this namespace are returned.
    """
    if is_folder(runs):
        # The link `latest` points to one of the runs.
        folders = sorted(
            (folder for folder in runs.iterdir() if is_folder(folder) and not folder.is_symlink()),
            reverse=True,
        )
    else:
        folders = []
    recording = []
    prefix = f"/{(namespace or '').strip('/')}/".replace("//", "/")
    for folder in folders:
        with suppress(ParameterError, OSError):
            is_recording = any(is_locked(file) for file in bag_files(folder))
            if is_recording and (
                not namespace or any(topic.startswith(prefix) for topic in log_topics(folder))
            ):
                recording.append(folder)
    return recording


def newest_run(runs: Path, namespace: str | None = None) -> Path:
    """Return the newest run that is being recorded, else the run to which `latest` points.

    With a namespace, only recordings of this aircraft are considered, but `latest` always is.
    Raises ParameterError if there is no run.
    """
    if recording := runs_in_recording(runs, namespace):
        return recording[0]
    latest = runs / "latest"
    require(
        is_folder(latest), str(runs), "no run", "the runs of `rise-di fly`, or a RUN by its name"
    )
    return latest.resolve()


def namespaces(run: Path) -> list[str | None]:
    """Return the namespaces of the aircraft in the log of a run.

    If the log has no aircraft yet, the result is [None], which stands for the first aircraft that
    appears.
    """
    with suppress(ParameterError, OSError):
        return [*aircraft_namespaces(log_topics(run))] or [None]
    return [None]


def require_log(run: Path, namespace: str | None = None, remaps: Mapping[str, str] = {}) -> None:
    """Raise ParameterError if a run has no log of a flight and is not being recorded.

    With a namespace, the aircraft in this namespace must have flown.
    """
    with suppress(OSError):
        if any(is_locked(file) for file in log_files(run)):
            return
    topics = log_topics(run, full_names(remaps))
    aircraft = [
        topic
        for topic, name in topics.items()
        if full_name(name) == JOINT_STATE and topic.rpartition("/")[2] in RATES
    ]
    has = f"no topic of a flight among {topics_text(topics)}" if topics else "no topic"
    require(bool(aircraft), str(run), has, A_FLIGHT)
    if namespace is not None:
        chosen_namespace(aircraft, namespace, str(run))


def serve(
    flights: Sequence[Flight],
    ports: Sequence[int],
    announce: Callable[[str], None],
    control: Control | None = None,
    *,
    fleet: bool = False,
) -> None:
    """Serve flights, as `Server` does, on the first free port, until SIGINT or SIGTERM.

    `announce` gets two lines for the user. `control` lets the page command the first flight. Raises
    ParameterError if no port is free, or if a log is unreadable.
    """
    server = Server(flights, secrets.token_urlsafe(16), control, fleet=fleet)
    asyncio.run(_serve(server, ports, announce))


def _listen(server: Server, ports: Sequence[int]) -> None:
    """Let a server listen on the first free port. Raises ParameterError if none is free."""
    refusals = []
    for port in ports:
        try:
            server.listen(port)
        except OSError as error:
            # The address may already be in the text of `strerror`.
            refusals.append(f"{port} cannot be used ({os.strerror(error.errno or 0)})")
        else:
            return
    reason = ", ".join(refusals) or "found no port"
    raise ParameterError(f"--port: {reason}, expected a free port of this host")


async def _serve(server: Server, ports: Sequence[int], announce: Callable[[str], None]) -> None:
    _listen(server, ports)
    announce(f"http://{ADDRESS}:{server.port}/#token={server.token}")
    announce(
        f"from another machine first: ssh -L {server.port}:{ADDRESS}:{server.port} "
        f"{socket.gethostname()}"
    )
    follow = asyncio.ensure_future(server.follow())
    loop = asyncio.get_running_loop()
    # The signals also end the page if a shell started it in the background, where SIGINT is
    # ignored.
    for number in (signal.SIGINT, signal.SIGTERM):
        loop.add_signal_handler(number, follow.cancel)
    try:
        await follow
    except asyncio.CancelledError:
        pass
    finally:
        await server.close()
