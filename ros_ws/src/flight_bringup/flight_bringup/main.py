# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""The four nodes of a flight in one process, in lockstep over the same topics."""

from flight_ros.startup import start_nodes


def main() -> None:
    """Run them."""
    start_nodes(
        "aircraft_sim.node:AircraftNode",
        "reference_model.node:ReferenceModelNode",
        "rise_di_controller.node:ControllerNode",
        "flight_recorder.node:RecorderNode",
    )


if __name__ == "__main__":
    main()
