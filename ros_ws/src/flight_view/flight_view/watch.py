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
from flight_log.rosbag2_metadata import bag_files
from flight_view.control import Control
from flight_view.flight import Flight
from flight_view.server import ADDRESS, Server

DEFAULT_PORT = 8077


def newest_run(runs: Path) -> Path:
    """The newest run in recording, else the last run flown. Raises ParameterError without a run."""
    folders = sorted((folder for folder in runs.iterdir() if is_folder(folder)), reverse=True) if is_folder(runs) else []
    for folder in folders:
        with suppress(ParameterError, OSError):
            if any(is_locked(file) for file in bag_files(folder)):
                return folder
    latest = runs / "latest"
    require(is_folder(latest), str(runs), "no run", "the runs of `rise-di fly`, or a RUN by its name")
    return latest.resolve()


def require_log(run: Path) -> None:
    """Raise ParameterError unless a run has a log."""
    require(bool(bag_files(run)), str(run), "no .mcap file", "the folder of a run or an MCAP file")


def serve(
    runs: Sequence[Path],
    ports: Sequence[int],
    announce: Callable[[str], None],
    control: Callable[[Flight], Control] | None = None,
) -> None:
    """Serve a run, and a second run as a ghost, on the first free port, until SIGINT or SIGTERM.

    `announce` gets two lines for the user. `control` lets the page command the first flight.

    Raises ParameterError where no port is free, or a log is unreadable.
    """
    asyncio.run(_serve(runs, ports, announce, control))


async def _serve(
    runs: Sequence[Path],
    ports: Sequence[int],
    announce: Callable[[str], None],
    control: Callable[[Flight], Control] | None,
) -> None:
    flights = [Flight(run) for run in runs]
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
    announce(f"http://{ADDRESS}:{server.port}/?token={server.token}")
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
