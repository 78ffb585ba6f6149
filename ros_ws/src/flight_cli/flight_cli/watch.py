# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""`rise-di watch`: see a flight on a page or in the terminal, live or recorded."""

import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated

from flight_bringup.processes import end_with_parent
from flight_cli.flightgear import show_in_flightgear
from flight_cli.log_options import REMAP, LogScenario, remaps_of, scenario_file
from flight_cli.route_options import parse_origin
from flight_cli.words import argument, option, setting, warn
from flight_core.environment import require_ros_environment
from flight_core.files import display_path
from flight_core.installation import missing
from flight_core.parameters import ParameterError, require
from flight_log.tape_reader import stored_scenario
from flight_view.background import read_background
from flight_view.flight import Flight
from flight_view.text import show
from flight_view.watch import (
    DEFAULT_PORT,
    namespaces,
    newest_run,
    require_log,
    runs_in_recording,
    serve,
)


def watch(
    run: Annotated[
        list[Path] | None,
        argument(
            "Folder of a run, or an MCAP file; by default the run in progress, else the "
            "last one. The second is a ghost.",
            metavar="[RUN]...",
        ),
    ] = None,
    fleet: Annotated[
        bool,
        option(
            "Show the aircraft of each RUN on one map, and a choice of them; by default "
            "the runs in progress.",
            "--fleet",
        ),
    ] = False,
    port: Annotated[
        int | None,
        option(
            "Port on this host; 0 takes any free one.",
            min=0,
            max=65535,
            show_default=f"{DEFAULT_PORT}",
        ),
    ] = None,
    wait: Annotated[
        bool, option("Wait for the log of RUN where there is none yet.", "--wait")
    ] = False,
    text: Annotated[
        bool, option("Show the flight in the terminal, without a browser.", "--text")
    ] = False,
    foxglove: Annotated[
        bool,
        option(
            "Serve a flight in progress to Foxglove, Lichtblick and PlotJuggler instead.",
            "--foxglove",
        ),
    ] = False,
    flightgear: Annotated[
        str | None,
        option(
            "Send the pose of a flight in progress to FlightGear instead, as to "
            "127.0.0.1:5500, with --set origin.",
            metavar="HOST:PORT",
        ),
    ] = None,
    control: Annotated[
        bool,
        option(
            "Let the page command the flight, with a key that this command prints.", "--control"
        ),
    ] = False,
    control_real: Annotated[
        bool, setting("real", "As --control, and gains also while a bridge sends to an autopilot.")
    ] = False,
    scenario: LogScenario = None,
    namespace: Annotated[
        str | None,
        option(
            "Namespace of the aircraft: by default the first in the log, with --control the root."
        ),
    ] = None,
    remap: Annotated[list[str] | None, setting("remap", REMAP, metavar="NAME:=TOPIC")] = None,
    background: Annotated[
        Path | None,
        setting(
            "background",
            "GeoJSON of lines, polygons and points for the map, with --set origin.",
            metavar="FILE",
        ),
    ] = None,
    origin: Annotated[
        str | None,
        setting(
            "origin",
            "Where north and east are 0, for the background and FlightGear.",
            metavar="LAT,LON",
        ),
    ] = None,
    altitude: Annotated[
        float,
        setting(
            "altitude",
            "Altitude above sea of altitude 0 for FlightGear, m; 0 for an aircraft of JSBSim.",
        ),
    ] = 0.0,
    rate: Annotated[
        float, setting("rate", "Packets a second to FlightGear.", min=1.0, max=100.0)
    ] = 30.0,
    runs: Annotated[Path, setting("runs", "Folder of the runs.")] = Path("runs"),
) -> None:
    """See a flight on a page: charts, horizon, scene and timeline, live while it is recorded, or
    again later.

    The page is served on this host alone, until Ctrl-C. Exit status: 0 ended, 2 bad input, 130
    interrupted in the terminal.
    """
    if flightgear is not None:
        require(
            origin is not None,
            "flightgear",
            "no origin",
            "--set origin=LAT,LON beside it, where north and east are 0",
        )
        show_in_flightgear(flightgear, origin or "", altitude, namespace or "", rate)
        return
    require(not wait or bool(run), "--wait", "no RUN", "the folder of a run that will be recorded")
    require(
        fleet or len(run or ()) < 3,
        "RUN",
        f"{len(run or ())} runs",
        "a run and a ghost, or --fleet",
    )
    controlled = control or control_real
    require(
        not (fleet and (text or foxglove or controlled)),
        "--fleet",
        "--text, --foxglove or --control beside it",
        "the page",
    )
    require(
        not (fleet and namespace is not None), "--fleet", "--namespace beside it", "one of the two"
    )
    remaps = remaps_of(remap)
    shown_scenario = None if (file := scenario_file(scenario)) is None else stored_scenario(file)
    chosen = run or (_in_progress(runs) if fleet else [_newest(runs, namespace)])
    for folder in chosen:
        if not wait:
            require_log(folder, namespace, remaps)
    require(
        background is None or not (text or foxglove),
        "background",
        "--text or --foxglove beside it",
        "the page",
    )
    lines = [] if background is None else read_background(background, parse_origin(origin))
    ports = (DEFAULT_PORT, 0) if port is None else (port,)
    if text:
        require(len(chosen) == 1, "--text", "two runs", "one run")
        require(not controlled, "--text", "--control beside it", "one of the two")
    if foxglove:
        require(
            len(chosen) == 1 and not controlled,
            "--foxglove",
            "a ghost or --control beside it",
            "RUN alone",
        )
        _serve_foxglove(chosen[0], port)
        return
    aircraft: list[tuple[Path, str | None]] = []
    for folder in chosen:
        aircraft += [(folder, name) for name in (namespaces(folder) if fleet else (namespace,))]
    flights = [
        Flight(folder, namespace=name, scenario=shown_scenario, background=lines, remaps=remaps)
        for folder, name in aircraft
    ]
    if text:
        show(flights[0])
    elif controlled:
        _serve_with_control(flights, ports, namespace or "", real=control_real)
    else:
        serve(flights, ports, _announce, fleet=fleet)


def _in_progress(runs: Path) -> list[Path]:
    """The runs in recording, in the order of their names. Raises ParameterError without one."""
    recording = runs_in_recording(runs)[::-1]
    require(bool(recording), f"--fleet: {runs}", "no run in recording", "each RUN by its name")
    return recording


def _newest(runs: Path, namespace: str | None) -> Path:
    """The run to watch without a RUN; a note names the other aircraft in flight."""
    chosen = newest_run(runs, namespace)
    others = [display_path(folder) for folder in runs_in_recording(runs) if folder != chosen]
    if others and namespace is None:
        warn(
            f"note: shows {display_path(chosen)}; also in flight: {', '.join(others)}: name "
            "one, or --namespace, or --fleet"
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
    flights: Sequence[Flight], ports: Sequence[int], namespace: str, *, real: bool
) -> None:
    from flight_analysis.closed_loop.loop_margins import delay_margins  # noqa: PLC0415 - loads scipy, which a page without control lacks
    from flight_view.control import Control, new_key  # noqa: PLC0415 - as above

    require_ros_environment()
    from flight_view.control_client import ControlClient  # noqa: PLC0415 - loads rclpy, which a page without control lacks

    with ControlClient(namespace) as client:
        key = new_key()
        control = Control(flights[0], client, key, real=real, assess=delay_margins)
        _announce(f"control key: {key}")
        try:
            serve(flights, ports, _announce, control)
        finally:
            control.close()


@contextmanager
def watched(*runs: Path, fleet: bool = False) -> Iterator[list[str]]:
    """Serve the page of runs that will be recorded, by another process during the block. Yields its
    lines for the user.
    """
    options = ["--wait", *(["--fleet"] if fleet else [])]
    command = [
        *end_with_parent(),
        sys.executable,
        "-P",
        "-m",
        "flight_cli.cli",
        "watch",
        *map(str, runs),
        *options,
    ]
    # In a process group of its own: Ctrl-C reaches the flight alone, whose end the page still
    # shows.
    with subprocess.Popen(  # noqa: S603
        command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, text=True, process_group=0
    ) as server:
        try:
            yield (
                [line.rstrip() for line in (server.stdout.readline(), server.stdout.readline())]
                if server.stdout
                else []
            )
        finally:
            server.terminate()
