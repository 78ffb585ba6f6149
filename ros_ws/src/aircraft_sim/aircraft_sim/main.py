# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""The executable `aircraft`."""

from flight_ros.start import start


def main() -> None:
    """Its entry point."""
    start("aircraft_sim.node:AircraftNode")


if __name__ == "__main__":
    main()
