# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""How a flight ends: every way has a name."""

COMPLETED = "completed"
INTERRUPTED = "interrupted"


class FlightEnded(RuntimeError):  # noqa: N818 - how a flight ends is no error of the program
    """A flight that cannot go on. The message is one sentence for the user."""
