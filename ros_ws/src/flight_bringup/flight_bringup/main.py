# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Run the nodes of a flight in one process, over the same topics as separate processes.

Guidance and the learner also run if the arguments name them.
"""

import sys

from flight_ros.startup import start_nodes


def main() -> None:
    """Run the nodes until they end."""
    has_guidance = "guidance" in sys.argv
    learns = "learner" in sys.argv
    start_nodes(
        "aircraft_sim.node:AircraftNode",
        "reference_model.node:ReferenceModelNode",
        *(["flight_guidance.node:GuidanceNode"] if has_guidance else []),
        "rise_di_controller.node:ControllerNode",
        *(["flight_design.learning.node:LearnerNode"] if learns else []),
        "flight_recorder.node:RecorderNode",
    )


if __name__ == "__main__":
    main()
