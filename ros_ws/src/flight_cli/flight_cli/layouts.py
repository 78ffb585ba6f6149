# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""`rise-di layouts`: layouts of Foxglove and PlotJuggler for the runs of a scenario."""

from pathlib import Path
from typing import Annotated

import typer

from flight_analysis.report.layouts import channels_of, foxglove, plotjuggler
from flight_bringup.scenarios import find_scenario
from flight_core.parameters import ParameterError


def layouts(
    scenario: Annotated[str, typer.Argument(help="Name of a scenario, or path of a scenario file (.yaml).")] = "osprey_gust",
    folder: Annotated[Path, typer.Option(help="Folder to write the two files to.")] = Path(),
) -> None:
    """Write layouts for Foxglove and PlotJuggler that plot the runs of a scenario."""
    chosen = find_scenario(scenario)
    channels = channels_of(chosen)
    for suffix, text in (("foxglove.json", foxglove(channels)), ("plotjuggler.xml", plotjuggler(channels))):
        path = folder / f"{chosen.name}.{suffix}"
        try:
            folder.mkdir(parents=True, exist_ok=True)
            path.write_text(text, encoding="utf-8")
        except OSError as error:
            raise ParameterError(f"folder: {folder} cannot be written ({error.strerror}), expected a folder that can") from None
        print(path)
