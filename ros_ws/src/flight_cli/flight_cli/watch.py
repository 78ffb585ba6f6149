# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""`rise-di watch`: see a flight on a page or in the terminal, live or recorded."""

import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated

import typer

from flight_bringup.processes import end_with_parent
from flight_cli.log_options import LogScenario, scenario_file
from flight_cli.route_options import parse_origin
from flight_cli.target import RemovedKeyFile
from flight_core.environment import require_ros_environment
from flight_core.files import display_path
from flight_core.installation import missing
from flight_core.parameters import ParameterError, require
from flight_log.tape_reader import StoredFile, stored_scenario
from flight_view.background import Line, read_background
from flight_view.flight import Flight
from flight_view.text import show
from flight_view.watch import DEFAULT_PORT, newest_run, require_log, runs_in_recording, serve


def watch(
    run: Annotated[
        Path | None, typer.Argument(help="Folder of a run, or an MCAP file; by default the run in progress, else the last one.")
    ] = None,
    ghost: Annotated[Path | None, typer.Argument(metavar="[RUN2]", help="A second run, shown as a ghost.")] = None,
    port: Annotated[
        int | None,
        typer.Option(min=0, max=65535, help="Port on this host; 0 takes any free one.", show_default=f"{DEFAULT_PORT}"),
    ] = None,
    wait: Annotated[bool, typer.Option("--wait", help="Wait for the log of RUN where there is none yet.")] = False,
    text: Annotated[bool, typer.Option("--text", help="Show the flight in the terminal, without a browser.")] = False,
    foxglove: Annotated[
        bool, typer.Option("--foxglove", help="Serve a flight in progress to Foxglove, Lichtblick and PlotJuggler instead.")
    ] = False,
    control: Annotated[
        bool, typer.Option("--control", help="Let the page command the flight, with a key that this command prints.")
    ] = False,
    control_real: Annotated[
        bool, typer.Option("--control-real", help="As --control, and gains also while a bridge sends to an autopilot.")
    ] = False,
    scenario: LogScenario = None,
    namespace: Annotated[
        str | None,
        typer.Option(help="Namespace of the aircraft: by default the first in the log, with --control the root."),
    ] = None,
    background: Annotated[
        Path | None, typer.Option(metavar="FILE", help="GeoJSON of lines, polygons and points for the map, with --origin.")
    ] = None,
    origin: Annotated[str | None, typer.Option(metavar="LAT,LON", help="Where north and east are 0, for --background.")] = None,
    _: RemovedKeyFile = None,
    runs: Annotated[Path, typer.Option(help="Folder of the runs.")] = Path("runs"),
) -> None:
    """See a flight on a page: charts, horizon, scene and timeline, live while it is recorded, or again later.

    The page is served on this host alone, until Ctrl-C. Exit status: 0 ended, 2 bad input, 130 interrupted in the terminal.
    """
    require(not wait or run is not None, "--wait", "no RUN", "the folder of a run that will be recorded")
    given = None if (file := scenario_file(scenario)) is None else stored_scenario(file)
    chosen = [_newest(runs, namespace) if run is None else run, *([ghost] if ghost is not None else [])]
    for folder in chosen:
        if not wait:
            require_log(folder, namespace)
    require(background is None or not (text or foxglove), "--background", "--text or --foxglove beside it", "the page")
    lines = [] if background is None else read_background(background, parse_origin(origin))
    ports = (DEFAULT_PORT, 0) if port is None else (port,)
    if text:
        require(ghost is None, "--text", "two runs", "one run")
        require(not (control or control_real), "--text", "--control beside it", "one of the two")
        show(Flight(chosen[0], namespace=namespace, scenario=given))
    elif foxglove:
        require(ghost is None and not (control or control_real), "--foxglove", "a ghost or --control beside it", "RUN alone")
        _serve_foxglove(chosen[0], port)
    elif control or control_real:
        _serve_with_control(chosen, ports, namespace or "", given, lines, real=control_real)
    else:
        serve(chosen, ports, _announce, None, namespace, given, lines)


def _newest(runs: Path, namespace: str | None) -> Path:
    """The run to watch without a RUN; a note names the other aircraft in flight."""
    chosen = newest_run(runs, namespace)
    beside = [display_path(folder) for folder in runs_in_recording(runs) if folder != chosen]
    if beside and namespace is None:
        print(
            f"note: shows {display_path(chosen)}; also in flight: {', '.join(beside)}: name one, or --namespace",
            file=sys.stderr,
        )
    return chosen


def _announce(line: str) -> None:
    print(line, flush=True)


def _serve_foxglove(run: Path, port: int | None) -> None:
    try:
        from flight_view import foxglove_server  # noqa: PLC0415 - an extra
    except ModuleNotFoundError as error:
        if error.name != "foxglove":
            raise
        raise ParameterError(f"--foxglove: {missing(error.name)}") from None
    foxglove_server.serve(run, foxglove_server.DEFAULT_PORT if port is None else port, _announce)


def _serve_with_control(
    runs: Sequence[Path],
    ports: Sequence[int],
    namespace: str,
    scenario: StoredFile | None,
    background: Sequence[Line],
    *,
    real: bool,
) -> None:
    from flight_analysis.closed_loop.margins import delay_margins  # noqa: PLC0415 - loads scipy, which a page without control lacks
    from flight_view.control import Control, new_key  # noqa: PLC0415 - as above

    require_ros_environment()
    from flight_view.control_client import ControlClient  # noqa: PLC0415 - loads rclpy, which a page without control lacks

    with ControlClient(namespace) as client:
        key, controls = new_key(), []

        def control(flight: Flight) -> Control:
            controls.append(Control(flight, client, key, real=real, assess=delay_margins))
            return controls[0]

        _announce(f"control key: {key}")
        try:
            serve(runs, ports, _announce, control, namespace or None, scenario, background)
        finally:
            for opened in controls:
                opened.close()


@contextmanager
def watched(run: Path) -> Iterator[list[str]]:
    """Serve the page of a run that will be recorded, by another process during the block. Yields its lines for the user."""
    command = [*end_with_parent(), sys.executable, "-P", "-m", "flight_cli.cli", "watch", str(run), "--wait"]
    # In a process group of its own: Ctrl-C reaches the flight alone, whose end the page still shows.
    with subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, text=True, process_group=0) as server:  # noqa: S603
        try:
            yield [line.rstrip() for line in (server.stdout.readline(), server.stdout.readline())] if server.stdout else []
        finally:
            server.terminate()
