# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""`rise-di layouts`: layouts of Foxglove and PlotJuggler for the runs of a scenario."""

from pathlib import Path
from typing import Annotated

import typer

from flight_analysis.report.layouts import channels_of, foxglove, plotjuggler
from flight_bringup.scenarios import find_scenario
from flight_core.files import write_file, writing


def layouts(
    scenario: Annotated[str, typer.Argument(help="Name of a scenario, or path of a scenario file (.yaml).")] = "osprey_servo",
    folder: Annotated[Path, typer.Option(help="Folder to write the two files to.")] = Path(),
) -> None:
    """Write layouts for Foxglove and PlotJuggler that plot the runs of a scenario."""
    chosen = find_scenario(scenario)
    channels = channels_of(chosen)
    for suffix, text in (("foxglove.json", foxglove(channels)), ("plotjuggler.xml", plotjuggler(channels))):
        path = folder / f"{chosen.name}.{suffix}"
        with writing("folder", folder, "a folder that can"):
            folder.mkdir(parents=True, exist_ok=True)
            write_file(path, text)
        print(path)
