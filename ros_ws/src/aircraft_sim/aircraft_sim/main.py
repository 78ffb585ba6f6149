# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""The executable `aircraft`."""

from flight_ros.startup import start_nodes


def main() -> None:
    """Start the node."""
    start_nodes("aircraft_sim.node:AircraftNode")


if __name__ == "__main__":
    main()
