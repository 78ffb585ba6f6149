# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""`rise-di layouts`: layouts of Foxglove, PlotJuggler and RViz for the runs of a scenario or of a
fleet.
"""

from dataclasses import dataclass
from pathlib import Path

from flight_analysis.closed_loop.scenario_library import find_scenario
from flight_analysis.report.layouts import channels_of, foxglove, plotjuggler, rviz, urdf
from flight_bringup.fleet import is_fleet, read_fleet
from flight_cli.words import argument, option
from flight_core.files import write_file, writing


@dataclass(frozen=True, kw_only=True)
class Layouts:
    """Write layouts for Foxglove and PlotJuggler with plots of the runs of a scenario, for RViz
    with guidance.
    """

    scenario: str = argument(
        "Name of a scenario, or path of a scenario file (.yaml) or of the file of a fleet.",
        default="osprey_servo",
    )
    folder: Path = option("Folder to write the files to.", default=Path())

    def execute(self) -> None:
        """Write the files, a line each."""
        if is_fleet(self.scenario):
            name = Path(self.scenario).stem
            members = read_fleet(self.scenario).members
            scenarios = {member.name: member.scenario for member in members}
        else:
            chosen = find_scenario(self.scenario)
            name = chosen.name
            scenarios = {"": chosen}
        aircraft = {namespace: channels_of(scenario) for namespace, scenario in scenarios.items()}
        files = {
            f"{name}.foxglove.json": foxglove(aircraft),
            f"{name}.plotjuggler.xml": plotjuggler(aircraft),
        }
        if guided := [
            namespace for namespace, scenario in scenarios.items() if scenario.guidance is not None
        ]:
            files |= {
                f"{name}.rviz": rviz(guided, (self.folder / "aircraft.urdf").absolute()),
                "aircraft.urdf": urdf(),
            }
        for file, text in files.items():
            with writing("folder", self.folder, "a folder that can"):
                self.folder.mkdir(parents=True, exist_ok=True)
                write_file(self.folder / file, text)
            print(self.folder / file)
