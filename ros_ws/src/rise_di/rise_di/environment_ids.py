# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Register the environments with gymnasium.

Since version 1.0 gymnasium has no entry point for them.
"""

ID = "rise_di/Flight-v0"


def register() -> None:
    """Register the identifiers of the environments once."""
    import gymnasium  # noqa: PLC0415 - an extra

    if ID not in gymnasium.registry:
        gymnasium.register(
            id=ID,
            entry_point="rise_di.flight_env:make_flight",
            vector_entry_point="rise_di.flight_env:make_flights",
        )
