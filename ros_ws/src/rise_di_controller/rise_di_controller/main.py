# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""The executable `controller`."""

from flight_ros.startup import start_nodes


def main() -> None:
    """Start the controller node."""
    start_nodes("rise_di_controller.node:ControllerNode", lower_by=1)


if __name__ == "__main__":
    main()
