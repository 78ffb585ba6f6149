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

# These start first, and say that they are ready before the others start: the whole flight is then in the log, and the
# aircraft is never without its controller. The recorder ends last.
FIRST = (RECORDER, CONTROLLER)
THEN = (AIRCRAFT, REFERENCE_MODEL)

READY = "]: ready"  # what a node says in its log when its loop begins


def start_lead(startup: float) -> float:
    """Time to leave from starting the second two nodes to t = 0, s, given how long the first two took to be ready.

    As long again, half of that for a machine that got busier, and half a second for the nodes to find each other.
    """
    return 0.5 + 1.5 * startup


def parameters(node: NodeSpec, scenario_file: Path, run: Path, start_time: float) -> dict[str, str | float]:
    """What a node is told beside its section of the scenario; those that start first are not told the instant of t = 0."""
    if node is RECORDER:
        return {"directory": str(run), "scenario_file": str(scenario_file)}
    return {"start_time": start_time} if node in THEN else {}
