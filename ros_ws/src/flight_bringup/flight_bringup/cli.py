# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""The `rise-di` command."""

import signal

# Until the command runs, Ctrl-C ends it without a word: the imports below take a second.
signal.signal(signal.SIGINT, signal.SIG_DFL)

import json
import sys
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn

from flight_analysis.scenario import Scenario
from flight_bringup import fly as flying
from flight_bringup.airframes_command import airframes
from flight_bringup.campaign_command import campaign
from flight_bringup.check_signs_command import check_signs, require_signs
from flight_bringup.compare_command import compare
from flight_bringup.engage_command import engage
from flight_bringup.gains_command import gains
from flight_bringup.graph import Autopilot, find_autopilot
from flight_bringup.identify_command import identify_aircraft
from flight_bringup.layouts_command import layouts
from flight_bringup.play_command import play
from flight_bringup.repair_command import repair_run
from flight_bringup.replay_command import replay_run
from flight_bringup.report_command import report, short, show
from flight_bringup.scenarios import find_scenario
from flight_core import outcome as ends
from flight_core.parameters import ParameterError, require

BAD_INPUT, ENDED_EARLY, INTERRUPTED = 2, 3, 130
STATUS = {ends.COMPLETED: 0, ends.INTERRUPTED: INTERRUPTED}

app = typer.Typer(
    help="Fly, record and analyse RISE dynamic inversion.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)


@app.command()
def fly(
    scenario: Annotated[str, typer.Argument(help="Name of a scenario, or path of a scenario file (.yaml).")] = "osprey_gust",
    duration: Annotated[float | None, typer.Option(help="Seconds to fly, in place of the scenario's.")] = None,
    in_process: Annotated[
        bool, typer.Option("--in-process", help="Fly in one process without ROS, as fast as it goes.")
    ] = False,
    lockstep: Annotated[
        bool, typer.Option("--lockstep", help="Over topics as fast as the machine allows, repeatable to the byte.")
    ] = False,
    one_process: Annotated[
        bool, typer.Option("--one-process", help="In lockstep, with all nodes as objects in one process.")
    ] = False,
    bridge: Annotated[
        str | None,
        typer.Option(
            metavar="MAP", help="Fly an autopilot in the aircraft's place, by a channel map; a dry run without --send."
        ),
    ] = None,
    send: Annotated[bool, typer.Option("--send", help="Send to the autopilot, once the bridge is told to engage.")] = False,
    runs: Annotated[Path, typer.Option(help="Folder that the run's folder is made in.")] = Path("runs"),
    as_json: Annotated[bool, typer.Option("--json", help="Print the summary as JSON, nothing else.")] = False,
) -> None:
    """Fly a scenario: aircraft, reference model, controller and recorder as processes over ROS 2 topics, in real time.

    Exit status: 0 flown to its end, 2 bad input, 3 ended early, 130 interrupted.
    """
    chosen = find_scenario(scenario)
    if duration is not None:
        chosen = chosen.vary(flight={"duration": duration})
    stepping = lockstep or one_process or chosen.flight.lockstep
    autopilot = None if bridge is None else _autopilot(chosen, bridge, send=send)
    require(not (send and bridge is None), "--send", "no --bridge", "the channel map of an autopilot: --bridge MAP")
    real_time = "a flight in real time over topics: an autopilot does not wait"
    require(autopilot is None or not (in_process or stepping), "--bridge", "a flight in lockstep or in one process", real_time)
    run = flying.new_run(chosen, runs)
    console = Console(stderr=True, quiet=as_json)
    columns = (TextColumn("{task.fields[clock]}"), BarColumn(), TextColumn("{task.fields[shown]}"))
    with Progress(*columns, console=console) as bar:
        task = bar.add_task("flight", total=chosen.flight.duration, clock="", shown="")

        def progress(t: float, shown: str) -> None:
            bar.update(task, completed=t, clock=f"t = {t:5.1f} of {chosen.flight.duration:g} s", shown=shown)

        if in_process:
            outcome = flying.fly_in_process(chosen, run, progress)
        else:
            outcome = flying.fly_over_topics(
                chosen, run, progress, lockstep=stepping, one_process=one_process, autopilot=autopilot
            )
        if outcome == "completed":
            progress(chosen.flight.duration, outcome)
    status = STATUS.get(outcome, ENDED_EARLY)
    try:
        flown = flying.conclude(run, outcome)
    except ParameterError:
        if status == 0:
            raise
        flying.conclude_unflown(run, chosen, outcome)
        print(f"error: {outcome}, before anything was flown; see {short(run)}", file=sys.stderr)
        raise typer.Exit(status) from None
    outcome = flown.flight.summary["outcome"]
    status = STATUS.get(outcome, ENDED_EARLY)
    if as_json:
        print(json.dumps(flown.flight.summary))
    else:
        show(Console(), flown.flight)
        print(f"outcome: {outcome}\nlog:     {short(flown.mcap)}\nreport:  {short(flown.report)}")
    raise typer.Exit(status)


def _autopilot(scenario: Scenario, map_name: str, *, send: bool) -> Autopilot:
    found = find_autopilot(map_name, dry_run=not send)
    require_signs(found.chart, scenario)
    return found


app.command()(report)
app.command()(gains)
app.command()(campaign)
app.command()(compare)
app.command()(airframes)
app.command("identify")(identify_aircraft)
app.command()(check_signs)
app.command()(engage)
app.command("replay")(replay_run)
app.command()(play)
app.command()(layouts)
app.command("repair")(repair_run)


def main() -> None:
    """Entry point: bad input is one sentence and exit status 2, Ctrl-C is quiet."""
    signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        app()
    except ParameterError as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(BAD_INPUT)
    except KeyboardInterrupt:
        sys.exit(INTERRUPTED)


if __name__ == "__main__":
    main()
