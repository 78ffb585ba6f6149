# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Implement `rise-di watch`, which shows a flight on a page or in the terminal."""

import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from flight_bringup.processes import end_with_parent
from flight_cli.log_options import REMAP, log_scenario, remaps_of, scenario_file
from flight_cli.route_options import parse_origin
from flight_cli.words import argument, option, rare_option, warn
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


@dataclass(frozen=True, kw_only=True)
class Watch:
    """See a flight on a page, live while it is recorded, or again later.

    The page has charts, a horizon, a scene and a timeline. It is served on this host alone, until
    Ctrl-C. Exit status: 0 ended, 2 bad input, 130 interrupted in the terminal.
    """

    run: list[Path] | None = argument(
        "Folder of a run, or an MCAP file; by default the run in progress, else the last one. A "
        "second run is shown as a ghost.",
        metavar="[RUN]...",
    )
    fleet: bool = option(
        "Show the aircraft of all RUNs on one map, where you choose one of them; by default the "
        "runs in progress.",
        default=False,
    )
    port: int | None = option(
        "Port on this host; 0 takes any free port.",
        min=0,
        max=65535,
        show_default=f"{DEFAULT_PORT}",
    )
    wait: bool = option("Wait for the log of RUN if there is none yet.", default=False)
    text: bool = option("Show the flight in the terminal, without a browser.", default=False)
    foxglove: bool = option(
        "Serve a flight in progress to Foxglove, Lichtblick and PlotJuggler instead.", default=False
    )
    control: bool = option(
        "Let the page command the flight, with a key that this command prints.", default=False
    )
    real: bool = rare_option(
        "As --control, but gains may also change while a bridge sends to an autopilot.",
        default=False,
    )
    scenario: str | None = log_scenario()
    namespace: str | None = option(
        "Namespace of the aircraft; by default the first in the log, with --control the root."
    )
    remap: list[str] | None = rare_option(REMAP, metavar="NAME:=TOPIC")
    background: Path | None = rare_option(
        "GeoJSON file with lines, polygons and points for the map; needs --origin.", metavar="FILE"
    )
    origin: str | None = rare_option(
        "Place where north and east are 0, for the background.", metavar="LAT,LON"
    )
    runs: Path = rare_option("Folder of the runs.", default=Path("runs"))

    def execute(self) -> None:
        """Serve the page, or show the flight in another way, until its end."""
        self._require_one_view()
        remaps = remaps_of(self.remap)
        file = scenario_file(self.scenario)
        runs = self.run or self._runs_in_progress()
        for folder in runs if not self.wait else ():
            require_log(folder, self.namespace, remaps)
        lines = []
        if self.background is not None:
            lines = read_background(self.background, parse_origin(self.origin))
        if self.foxglove:
            require(len(runs) == 1, "--foxglove", "a ghost beside it", "RUN alone")
            _serve_foxglove(runs[0], self.port)
            return
        scenario = None if file is None else stored_scenario(file)
        flights = [
            Flight(folder, namespace=name, scenario=scenario, background=lines, remaps=remaps)
            for folder in runs
            for name in (namespaces(folder) if self.fleet else (self.namespace,))
        ]
        if self.text:
            require(len(runs) == 1, "--text", "two runs", "one run")
            show(flights[0])
            return
        ports = (DEFAULT_PORT, 0) if self.port is None else (self.port,)
        if self.control or self.real:
            _serve_with_control(flights, ports, self.namespace or "", real=self.real)
        else:
            serve(flights, ports, _announce, fleet=self.fleet)

    def _require_one_view(self) -> None:
        """Check that the options ask for one view, and fit the number of runs.

        Raises ParameterError if not.
        """
        runs = len(self.run or ())
        controlled = self.control or self.real
        require(
            not self.wait or runs > 0,
            "--wait",
            "no RUN",
            "the folder of a run that will be recorded",
        )
        require(self.fleet or runs < 3, "RUN", f"{runs} runs", "a run and a ghost, or --fleet")
        contradiction = "--text, --foxglove or --control beside it"
        paged = not (self.text or self.foxglove or controlled)
        require(paged or not self.fleet, "--fleet", contradiction, "the page")
        has_two_aircraft = self.fleet and self.namespace is not None
        require(not has_two_aircraft, "--fleet", "--namespace beside it", "one of the two")
        can_draw = self.background is None or not (self.text or self.foxglove)
        require(can_draw, "background", "--text or --foxglove beside it", "the page")
        for name in ("text", "foxglove"):
            twice = getattr(self, name) and controlled
            require(not twice, f"--{name}", "--control beside it", "one of the two")

    def _runs_in_progress(self) -> list[Path]:
        """Return the runs to watch if the user did not name a run."""
        return _in_progress(self.runs) if self.fleet else [_newest(self.runs, self.namespace)]


def _in_progress(runs: Path) -> list[Path]:
    """Return the runs in recording, the oldest first. Raises ParameterError if there are none."""
    recording = runs_in_recording(runs)[::-1]
    require(bool(recording), f"--fleet: {runs}", "no run in recording", "each RUN by its name")
    return recording


def _newest(runs: Path, namespace: str | None) -> Path:
    """Return the newest run, and print which other aircraft fly at the same time."""
    run = newest_run(runs, namespace)
    others = [display_path(folder) for folder in runs_in_recording(runs) if folder != run]
    if others and namespace is None:
        warn(
            f"note: shows {display_path(run)}; also in flight: {', '.join(others)}: name "
            "one, or --namespace, or --fleet"
        )
    return run


def _announce(line: str) -> None:
    print(line, flush=True)


def _serve_foxglove(run: Path, port: int | None) -> None:
    try:
        from flight_view import foxglove_server  # noqa: PLC0415 - an extra
    except ModuleNotFoundError as error:
        if error.name != "foxglove":
            raise
        raise ParameterError(f"--foxglove: {missing(error.name)}") from None
    foxglove_server.serve_foxglove(
        run, foxglove_server.DEFAULT_PORT if port is None else port, _announce
    )


def _serve_with_control(
    flights: Sequence[Flight], ports: Sequence[int], namespace: str, *, real: bool
) -> None:
    from flight_analysis.linear_loop.loop_margins import delay_margins  # noqa: PLC0415 - loads scipy, which a page without control lacks
    from flight_analysis.linear_loop.told import FlightFacts  # noqa: PLC0415 - as above
    from flight_view.control import Control, new_key  # noqa: PLC0415 - as above

    require_ros_environment()
    from flight_view.control_client import ControlClient  # noqa: PLC0415 - loads rclpy, which a page without control lacks

    # The aircraft behind a bridge is not the aircraft of the scenario.
    assess = partial(delay_margins, flight=FlightFacts(is_simulated=not real))
    with ControlClient(namespace) as client:
        key = new_key()
        control = Control(flights[0], client, key, real=real, assess=assess)
        _announce(f"control key: {key}")
        try:
            serve(flights, ports, _announce, control)
        finally:
            control.close()


@contextmanager
def watched(*runs: Path, fleet: bool = False) -> Iterator[list[str]]:
    """Serve the page of runs that another process records during the block.

    Yields the lines to print for the user.
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
    # The page runs in a separate process group, so that Ctrl-C only reaches the flight, and the
    # page still shows the end of the flight.
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
