# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""The executable `recorder`."""

from flight_ros.start import start


def main() -> None:
    """Its entry point."""
    start("flight_recorder.node:RecorderNode")


if __name__ == "__main__":
    main()
