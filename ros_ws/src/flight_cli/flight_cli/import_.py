# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Implement `rise-di import`, which makes a bag of y, u and pose from an autopilot's log."""

from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import typer
from rich.console import Console

from autopilot_bridge.map_rows import UNITS
from autopilot_bridge.params import find_map, load_map
from flight_analysis.closed_loop.scenario import Scenario
from flight_analysis.closed_loop.scenario_library import find_scenario
from flight_analysis.report.run_folder import PROVENANCE, attachments_for
from flight_cli.output import new_table, print_table, say
from flight_cli.words import REQUIRED, argument, map_names, option, scenario_names, warn
from flight_core.files import display_path, dump_yaml, write_file, writing
from flight_core.outcome import End, Outcome
from flight_core.parameters import require
from flight_core.rates import NANOSECONDS
from flight_core.tape import Tape
from flight_design.identification.log_import import PARAMETERS, Window, imported, kind_of_map
from flight_design.identification.module_log import module_flight
from flight_design.identification.parameter_agreement import Agreement
from flight_log.bag import CHANNEL_UNITS, COMPARED, IMPORTED, LogAttachments
from flight_log.provenance import provenance
from flight_log.tape_writer import TapeWriter, write_run
from flight_log.vehicle_log import read_foreign_log
from flight_log.vehicle_tables import Choice


@dataclass(frozen=True, kw_only=True)
class Import:
    """Make a bag of y, u and pose from the log of an autopilot that the stack did not fly.

    By default it takes the longest stretch in the air. If u comes from the sticks, this stretch
    must be in MANUAL. `check --run`, `identify bridge`, `report` and `watch` read the bag. u is the
    deviation from the median of the stretch, and `commands` is the whole command. --scenario is for
    the log of a flight of export --px4. `replay` can then compute each of its ticks again.

    Exit status: 0, or 2 bad input.
    """

    log: Path = argument(
        "DataFlash log of ArduPilot (.bin, .log), tlog of MAVLink, or ULog of PX4.",
        default=REQUIRED,
    )
    map_name: str | None = option(
        "Channel map that has the channels of y and u, the trims and the scales.",
        "--map",
        metavar="MAP",
        autocompletion=map_names,
    )
    scenario: str | None = option(
        "Scenario of a module of export --px4 that flew, in place of --map; replay then computes "
        "its ticks again.",
        autocompletion=scenario_names,
    )
    output: Path | None = option(
        "Folder to create; by default the name of the log in runs/.", "--output", "--write"
    )
    start: float | None = option("Time to begin at, s since the beginning of the log.", "--from")
    stop: float | None = option("Time to end at, s since the beginning of the log.", "--until")
    servos: bool = option(
        "Take u from the servos of ArduPilot, in any mode; by default from the sticks in MANUAL.",
        default=False,
    )
    system: int | None = option(
        "MAVLink system, if a tlog has several; by default the one that flew."
    )
    instances: list[str] | None = option(
        "Sensor or instance to take, if there are several, as in IMU=1; may be repeated.",
        "--instance",
        metavar="MESSAGE=NUMBER",
    )

    def execute(self) -> None:
        """Read the log, write the bag, and print its topics."""
        for name, value in (("from", self.start), ("until", self.stop)):
            require(value is None or value >= 0.0, name, value, "0 s or more")
        if (self.map_name is None) == (self.scenario is None):
            raise typer.BadParameter("expected --map MAP or --scenario SCENARIO")
        folder = self.output or Path("runs") / self.log.stem
        existing_folder = f"{folder}, which exists"
        require(not folder.exists(), "--output", existing_folder, "the name of a new folder")
        if self.map_name is None:
            _import_module(self.log, find_scenario(self.scenario or ""), folder)
        else:
            self._import_by_map(self.map_name, folder)

    def _import_by_map(self, map_name: str, folder: Path) -> None:
        """Write y, u and pose of a log, which the rows of a channel map find in it."""
        channel_map = load_map(map_name)
        console = Console()
        choice = Choice(self.system, _numbers(self.instances or []), kind_of_map(channel_map))
        vehicle_log = read_foreign_log(self.log, choice)
        show = partial(_show_agreement, console)
        window = Window(self.start, self.stop)
        taken = imported(channel_map, vehicle_log, window, show, servos=self.servos)
        source = {"log": self.log.name, "kind": vehicle_log.kind, "map": channel_map.name}
        units = {name: UNITS[row.motion[0]] for name, row in channel_map.outputs.items()}
        records = {IMPORTED: {**source, COMPARED: "; ".join(taken.notes)}, CHANNEL_UNITS: units}
        with writing("--output", folder):
            folder.mkdir(parents=True)
            write_file(
                folder / PARAMETERS, dump_yaml(dict(sorted(taken.parameters.items())), flow=False)
            )
            write_file(folder / PROVENANCE, dump_yaml(provenance() | records, flow=False))
        files = (folder / PARAMETERS, find_map(map_name))
        bag = write_run(taken.tape, folder, LogAttachments(None, files, folder / PROVENANCE))
        for sentence in taken.notes:
            warn(f"warning: {sentence}")
        _show_topics(console, f"{self.log.name}, {vehicle_log.kind}", taken.tape)
        log_start_ns = vehicle_log.start_ns(channel_map.outputs[channel_map.instant].motion[0])
        begin = (taken.tape.start_ns - log_start_ns) / NANOSECONDS
        length = (int(taken.tape["y"].stamp_ns[-1]) - taken.tape.start_ns) / NANOSECONDS
        say(
            console,
            f"taken: {begin:.1f} to {begin + length:.1f} s of the log\nlog:   {display_path(bag)}",
        )


def _show_agreement(console: Console, rows: list[Agreement]) -> None:
    """Print the settings that both the log and the channel map state, side by side."""
    headings = ("", "what the log says", "what the map says")
    table = new_table("", headings, headings, headings)
    for row in rows:
        style = "bold red" if row.is_different else None
        table.add_row(row.what, row.logged or "not recorded", row.mapped, style=style)
    print_table(console, table)


def _import_module(log: Path, scenario: Scenario, folder: Path) -> None:
    """Write the ticks of a controller that was exported into PX4 as a run of its scenario."""
    module_log = read_foreign_log(log)
    flight = module_flight(module_log, scenario.controller)
    with writing("--output", folder):
        folder.mkdir(parents=True)
    attachments = attachments_for(scenario, folder)
    with TapeWriter(folder, attachments, flight.tape.start_ns) as writer:
        for change in flight.changes:
            writer.write_changes(change.stamp_ns, "/controller", change.values)
        writer.write(flight.tape.signals)
        writer.add_outcome(Outcome(End.IMPORTED))
    if flight.lost:
        warn(f"warning: {flight.lost} ticks after a gap of the log left out")
    console = Console()
    _show_topics(console, f"{log.name}, {module_log.kind}", flight.tape)
    ticks = len(flight.tape["internals"].stamp_ns)
    equality = f"{flight.equal} of {ticks} ticks have the u of Python to the bit"
    say(console, f"{equality}\nlog:   {display_path(writer.path)}")


def _show_topics(console: Console, title: str, tape: Tape) -> None:
    """Print the number, the rate and the longest gap of the samples of each topic."""
    table = new_table(title, ("topic", "samples", "Hz", "longest gap, s"))
    for topic, signal in tape.signals.items():
        gaps = np.diff(signal.stamp_ns) / NANOSECONDS
        rate = (len(signal.stamp_ns) - 1) / float(gaps.sum()) if len(gaps) else 0.0
        longest = float(gaps.max()) if len(gaps) else 0.0
        table.add_row(topic, str(len(signal.stamp_ns)), f"{rate:.3g}", f"{longest:.3g}")
    print_table(console, table)


def _numbers(instances: list[str]) -> dict[str, int]:
    """Parse texts of the form MESSAGE=NUMBER into numbers by message.

    Raises ParameterError if a text has another form.
    """
    numbers = {}
    for text in instances:
        message, _, number = text.partition("=")
        require(number.isdecimal(), "--instance", repr(text), "MESSAGE=NUMBER, as IMU=1")
        numbers[message] = int(number)
    return numbers
