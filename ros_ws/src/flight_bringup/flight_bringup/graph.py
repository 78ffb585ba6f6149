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


READY = "recording to"  # what the recorder says when it is ready


def start_lead(recorder_startup: float) -> float:
    """Time to leave from starting the other nodes to t = 0, s, given how long the recorder took to be ready.

    Half a second for them to find each other, and twice that long, as three processes start at once on two cores.
    """
    return 0.5 + 2.0 * recorder_startup


def recorder_parameters(scenario_file: Path, run: Path) -> dict[str, str | float]:
    """What the recorder is told beside its section of the scenario."""
    return {"directory": str(run), "scenario_file": str(scenario_file)}


def parameters(node: NodeSpec, start_time: float) -> dict[str, str | float]:
    """What another node is told beside its section: the instant of t = 0, which the controller need not know."""
    return {} if node is CONTROLLER else {"start_time": start_time}
