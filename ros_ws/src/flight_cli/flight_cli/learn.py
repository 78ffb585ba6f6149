# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Implement `rise-di learn`, which runs the learner again on the log of a flight.

The settings of the learner may differ from those in the flight. The command can also write the
model, and a certificate of its loop.
"""

from dataclasses import dataclass
from pathlib import Path

import typer
from rich.console import Console

from flight_analysis.closed_loop.replay import recorded_scenario
from flight_analysis.closed_loop.scenario import Scenario
from flight_analysis.linear_loop.certificate import certificate
from flight_analysis.report.display_units import display_units
from flight_analysis.report.model_spans import errors_by_model
from flight_analysis.report.recorded_flight import log_account
from flight_analysis.report.summary_rows import stated_deviations
from flight_analysis.report.tables import model_table
from flight_cli.log_options import log_namespace, log_scenario, scenario_file, warn_of_lacks
from flight_cli.output import (
    LATEST,
    entries_as_json,
    entry_table,
    print_json,
    print_table,
    require_writable,
    require_yaml,
    say,
    show_table,
    write_text,
)
from flight_cli.settings import settings_option, with_settings
from flight_cli.words import argument, json_option, option, write_option
from flight_core.files import display_path
from flight_core.parameters import require
from flight_core.text import printable
from flight_design.learning.designs import LearnedLoop, deviations_covered
from flight_design.learning.scenario_learner import learn_again, learned_yaml
from flight_log.tape_reader import read_run
from rise_di.c_code import certificate_sources

NOTHING_LEARNED = 1


@dataclass(frozen=True, kw_only=True)
class Learn:
    """Run the learner again on the log of a flight.

    The settings come from the scenario in the log, unless --set controller.learn.* changes them. y
    and u come from the log. The flight may have been without a learner, if its controller has an
    observer. With --write, the model becomes an airframe file, and `controller.learn.prior` lets
    the next flight start from it. With --certificate, the last model that was proposed gets the
    proof of its guarantee. Exit status: 0 a model, 1 none, 2 bad input.
    """

    run: Path = argument("Folder of a run, or an MCAP file.", default=LATEST)
    settings: list[str] | None = settings_option()
    write: Path | None = write_option("Airframe file to write the learned model to.")
    certificate: Path | None = option(
        "File for the proof of the last model's guarantee (JSON), which "
        "examples/check_certificate.py checks with nothing but numpy."
    )
    scenario: str | None = log_scenario()
    namespace: str | None = log_namespace()
    as_json: bool = json_option()

    def execute(self) -> None:
        """Run the learner on the log, print its steps, and write the model."""
        if self.write is not None:
            require_yaml("--write", self.write)
        if self.certificate is not None:
            require_writable("certificate", self.certificate)
        recorded_run = read_run(self.run, self.namespace, scenario_file(self.scenario))
        recorded_run.require()
        warn_of_lacks(recorded_run)
        scenario = recorded_scenario(recorded_run)
        others = with_settings(scenario, self.settings)
        console = Console(quiet=self.as_json)
        with console.status(f"learning from {printable(str(self.run))}"):
            result = learn_again(recorded_run.tape, others)
        for step in result.steps:
            lead = "" if step.is_proposed else "no model: "
            say(console, f"t = {step.t:.2f} s: {lead}{step.sentence}")
        account = log_account(recorded_run)
        over = "" if account is None else account.over("internals")
        part = f", {over}" if over else ""
        if result.entries:
            print_table(
                console, entry_table(f"A and B of the last identification{part}", result.entries)
            )
        if models := [span._asdict() for span in errors_by_model(recorded_run.tape)]:
            show_table(console, model_table(models, display_units(scenario), part))
        if result.model is not None and self.write is not None:
            write_text("--write", self.write, learned_yaml(result, str(self.run)))
            say(console, f"model: {display_path(self.write)}")
        if self.certificate is not None:
            for line in _write_certificate(self.certificate, result.loop, others):
                say(console, line)
        if self.as_json:
            steps = [
                {"t": step.t, "proposed": step.is_proposed, "sentence": step.sentence}
                for step in result.steps
            ]
            path = None if result.model is None or self.write is None else str(self.write)
            print_json(
                {
                    "steps": steps,
                    "entries": entries_as_json(result.entries),
                    "models": models,
                    "model": path,
                    "certificate": None if self.certificate is None else str(self.certificate),
                }
            )
        raise typer.Exit(NOTHING_LEARNED if result.model is None else 0)


def _write_certificate(path: Path, learned: LearnedLoop | None, scenario: Scenario) -> list[str]:
    """Write the certificate of a learned model's guarantee, and say what it proves.

    Raises ParameterError if no model was proposed, or if nothing is proved.
    """
    require(learned is not None, "--certificate", "no proposal of a learned model", "one")
    assert learned is not None  # noqa: S101 - for mypy
    linear, proved = learned.proof()
    require(proved.stable > 0.0, "--certificate", "no stable box", "a loop with a guarantee")
    flown = scenario.vary(controller=learned.controller.model_copy(update={"learn": None}))
    sources = certificate_sources(learned.model, flown)
    write_text("--certificate", path, certificate(linear, proved, sources.texts))
    within = f"{stated_deviations(deviations_covered(proved))} stated deviations of the model"
    stable = f"the linear loop is stable for every aircraft within {within}"
    return [
        f"guarantee: {stable} (certificate {proved.certificate})",
        *sources.notes(),
        f"certificate: {display_path(path)}",
    ]
