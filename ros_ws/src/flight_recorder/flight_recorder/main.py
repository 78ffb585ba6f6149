# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""The executable `recorder`."""

from flight_ros.startup import start_nodes


def main() -> None:
    """Its entry point."""
    # It takes what publishers have kept: while it also loads, that holds the flight back by 20 to 70 ms, else by 10 to 35.
    start_nodes("flight_recorder.node:RecorderNode", early=False)


if __name__ == "__main__":
    main()
