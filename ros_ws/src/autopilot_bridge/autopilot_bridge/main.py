# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""The entry point of the executable `bridge`."""

from flight_ros.startup import start_nodes


def main() -> None:
    """Start the bridge node."""
    start_nodes("autopilot_bridge.node:BridgeNode")


if __name__ == "__main__":
    main()
