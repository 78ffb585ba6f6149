# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""`rise-di learn`: repeat the learner on the log of a flight, with other settings, and write the
model.
"""

from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.markup import escape

from flight_analysis.closed_loop.replay import recorded_scenario
from flight_analysis.metrics import errors_by_model
from flight_analysis.report.run_folder import log_account
from flight_analysis.report.summary import display_units
from flight_cli.log_options import LogNamespace, LogScenario, scenario_file, warn_of_lacks
from flight_cli.output import (
    LATEST,
    entries_as_json,
    entry_table,
    model_table,
    print_json,
    require_yaml,
    say,
    write_text,
)
from flight_cli.settings import Settings, with_settings
from flight_cli.words import WRITE, AsJson, argument, option
from flight_core.files import display_path
from flight_core.text import printable
from flight_design.learning.scenario_learner import learn_again, learned_yaml
from flight_log.tape_reader import read_run

NOTHING_LEARNED = 1


def learn(
    run: Annotated[Path, argument("Folder of a run, or an MCAP file.")] = LATEST,
    settings: Settings = None,
    write: Annotated[
        Path | None, option("File for the learned model, an airframe file.", *WRITE)
    ] = None,
    scenario: LogScenario = None,
    namespace: LogNamespace = None,
    as_json: AsJson = False,
) -> None:
    """Repeat the learner on the log of a flight, with the settings of its scenario or, by --set
    controller.learn.*, others.

    y and u are those of the log: a flight without a learner can be learned from too, if its
    controller has an observer. With --write the model becomes an airframe file, from which
    `controller.learn.prior` starts the next flight. Exit status: 0 a model, 1 none, 2 bad input.
    """
    if write is not None:
        require_yaml("--write", write)
    recorded = read_run(run, namespace, scenario_file(scenario))
    recorded.require()
    warn_of_lacks(recorded)
    flown = recorded_scenario(recorded)
    others = with_settings(flown, settings)
    console = Console(quiet=as_json)
    with console.status(f"learning from {printable(str(run))}"):
        result = learn_again(recorded.tape, others)
    for step in result.steps:
        lead = "" if step.proposed else "no model: "
        say(console, escape(f"t = {step.t:.2f} s: {lead}{step.sentence}"))
    account = log_account(recorded)
    over = "" if account is None else account.over("internals")
    part = f", {over}" if over else ""
    if result.entries:
        console.print(entry_table(f"A and B of the last identification{part}", result.entries))
    if models := [span._asdict() for span in errors_by_model(recorded.tape)]:
        console.print(model_table(models, display_units(flown), part))
    if result.model is not None and write is not None:
        write_text("--write", write, learned_yaml(result, str(run)))
        say(console, f"model: {escape(display_path(write))}")
    if as_json:
        steps = [step._asdict() for step in result.steps]
        path = None if result.model is None or write is None else str(write)
        print_json(
            {
                "steps": steps,
                "entries": entries_as_json(result.entries),
                "models": models,
                "model": path,
            }
        )
    raise typer.Exit(NOTHING_LEARNED if result.model is None else 0)
