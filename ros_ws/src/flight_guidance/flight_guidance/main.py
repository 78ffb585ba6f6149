# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""The entry point of the executable `guidance`."""

from flight_ros.startup import start_nodes


def main() -> None:
    """Start the guidance node."""
    start_nodes("flight_guidance.node:GuidanceNode", lower_by=2)


if __name__ == "__main__":
    main()
