# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""The entry point of the executable `learner`."""

from flight_core.scheduling import leave_real_time_priority
from flight_ros.startup import start_nodes


def main() -> None:
    """Start the learner node."""
    leave_real_time_priority()
    start_nodes("flight_design.learning.node:LearnerNode")


if __name__ == "__main__":
    main()
