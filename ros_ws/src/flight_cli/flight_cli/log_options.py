# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""The options of every command that reads a log: the scenario of a log without a scenario, the aircraft of several."""

from pathlib import Path
from typing import Annotated

import typer

from flight_bringup.scenarios import find_scenario

LogNamespace = Annotated[str | None, typer.Option("--namespace", help="Namespace of the aircraft, if the log holds several.")]
LogScenario = Annotated[
    str | None, typer.Option("--scenario", help="Scenario of the flight, a name or a file; by default that in the log.")
]


def scenario_file(name: str | None) -> Path | None:
    """The file of a scenario by name or path; None without a name. Raises ParameterError for an invalid scenario."""
    return None if name is None else find_scenario(name).path
