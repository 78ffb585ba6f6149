# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""The executable `reference_model`, which starts the reference model node."""

from flight_ros.startup import start_nodes

PARAMETERS = ("reference_model", "reference_model.params:ReferenceModelConfig")


def main() -> None:
    """Start the reference model node."""
    start_nodes("reference_model.node:ReferenceModelNode", parameters=PARAMETERS)


if __name__ == "__main__":
    main()
