# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Options and warnings that the commands that read a log share.

Options name a scenario if the log has none, or one aircraft if the log has several. Warnings say
what the log lacks.
"""

from contextlib import suppress
from pathlib import Path
from typing import Any

from flight_analysis.closed_loop.replay import is_controller_alone, recorded_parameters
from flight_analysis.closed_loop.scenario_library import LIBRARY, find_scenario
from flight_analysis.report.recorded_flight import log_account
from flight_cli.words import option, scenario_names, warn
from flight_core.files import find_file
from flight_core.parameters import ParameterError, require
from flight_core.scenario_file import A_SCENARIO
from flight_log.bag import COMPARED, IMPORTED
from flight_log.tape_reader import RecordedRun, read_run, stored_scenario

REMAP = "Topic that a remapped node uses, as in y:=/sensors/y; may be repeated."


def log_namespace() -> Any:
    """Declare the option --namespace of a command that reads a log."""
    return option("Namespace of the aircraft, if the log holds several.")


def log_scenario() -> Any:
    """Declare the option --scenario of a command that reads a log."""
    text = "Name or file of the flight's scenario; by default that in the log."
    return option(text, autocompletion=scenario_names)


def remaps_of(words: list[str] | None) -> dict[str, str]:
    """Parse words of the form NAME:=/TOPIC into the topics of a log by their names in the stack.

    Raises ParameterError if a word has another form.
    """
    remaps = [word.partition(":=") for word in words or ()]
    for name, _, topic in remaps:
        require(
            bool(name) and topic.startswith("/"),
            "--remap",
            f"{name}:={topic}",
            "NAME:=/TOPIC, as in y:=/sensors/y",
        )
    return {name: topic for name, _, topic in remaps}


def scenario_file(name: str | None) -> Path | None:
    """Find the file of a scenario, or of only a controller, by name or path.

    Returns None without a name. Raises ParameterError if the scenario is invalid.
    """
    if name is None:
        return None
    path = find_file(name, LIBRARY, "scenario", A_SCENARIO)
    stored = stored_scenario(path)
    if is_controller_alone(stored):
        recorded_parameters(stored)
        return path
    return find_scenario(name).path


def warn_of_lacks(recorded_run: RecordedRun) -> None:
    """Print a warning on standard error for everything that a log lacks.

    Without it, users might believe that a result covers more than was recorded.
    """
    account = log_account(recorded_run)
    import_note = recorded_run.metadata.get(IMPORTED, {}).get(COMPARED, "")
    for sentence in (
        *recorded_run.tape.notes,
        *(() if account is None else account.notes()),
        *filter(None, [import_note]),
    ):
        warn(f"warning: {sentence}")


def warn_of_lacks_in(run: Path, namespace: str | None) -> None:
    """Print the warnings of `warn_of_lacks`, or nothing if the log has no flight."""
    with suppress(ParameterError):
        warn_of_lacks(read_run(run, namespace))
