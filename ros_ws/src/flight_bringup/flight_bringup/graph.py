# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""The graph of a flight: which nodes there are and what each is told. The launch file and the runner both read it here."""

from pathlib import Path
from typing import NamedTuple


class NodeSpec(NamedTuple):
    """One process of a flight."""

    package: str
    executable: str  # also the node's name, and its section in a scenario

    @property
    def module(self) -> str:
        """The Python module behind the executable."""
        return f"{self.package}.node"


RECORDER = NodeSpec("flight_recorder", "recorder")
AIRCRAFT = NodeSpec("aircraft_sim", "aircraft")
REFERENCE_MODEL = NodeSpec("reference_model", "reference_model")
CONTROLLER = NodeSpec("rise_di_controller", "controller")

# The recorder starts first and stops last, so that the whole flight is in the log.
NODES = (RECORDER, AIRCRAFT, REFERENCE_MODEL, CONTROLLER)

START_LEAD = 3.0  # s from the first process to t = 0; four processes on two busy cores are heard within 2 s

READY = "recording to"  # what the recorder says when it is ready


def parameters(node: NodeSpec, scenario_file: Path, run: Path, start_time: float) -> dict[str, str | float]:
    """What a node is told beside its section of the scenario."""
    if node is RECORDER:
        return {"directory": str(run), "scenario_file": str(scenario_file), "start_time": start_time}
    return {} if node is CONTROLLER else {"start_time": start_time}
