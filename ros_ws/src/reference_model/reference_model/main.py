# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""The executable `reference_model`."""

from flight_ros.start import start


def main() -> None:
    """Its entry point."""
    start("reference_model.node:ReferenceModelNode")


if __name__ == "__main__":
    main()
