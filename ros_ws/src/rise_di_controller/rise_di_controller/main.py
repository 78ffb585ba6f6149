# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""The executable `controller`, which starts the controller node."""

from flight_ros.startup import start_nodes

PARAMETERS = ("controller", "rise_di_controller.rise_di_config:RiseDiConfig")


def main() -> None:
    """Start the controller node."""
    start_nodes("rise_di_controller.node:ControllerNode", lower_by=1, parameters=PARAMETERS)


if __name__ == "__main__":
    main()
