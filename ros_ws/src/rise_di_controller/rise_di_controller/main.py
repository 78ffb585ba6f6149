# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""The executable `controller`."""

from flight_ros.start import start


def main() -> None:
    """Its entry point."""
    start("rise_di_controller.node:ControllerNode")


if __name__ == "__main__":
    main()
