# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""The executable `recorder`, which starts the recorder's node."""

from flight_ros.startup import start_nodes

PARAMETERS = ("recorder", "flight_recorder.params:RecorderConfig")


def main() -> None:
    """Run the recorder."""
    # Do not start early. A recorder that matches a publisher receives its history, which delays a
    # flight by 10 to 35 ms, and by 20 to 70 ms while the recorder also loads its modules.
    start_nodes("flight_recorder.node:RecorderNode", early=False, lower_by=3, parameters=PARAMETERS)


if __name__ == "__main__":
    main()
