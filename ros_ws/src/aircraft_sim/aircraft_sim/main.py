# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""The entry point of the executable `aircraft`."""

from flight_ros.startup import start_nodes

PARAMETERS = ("aircraft", "aircraft_sim.params:AircraftConfig")


def main() -> None:
    """Start the node of the simulated aircraft."""
    start_nodes("aircraft_sim.node:AircraftNode", parameters=PARAMETERS)


if __name__ == "__main__":
    main()
