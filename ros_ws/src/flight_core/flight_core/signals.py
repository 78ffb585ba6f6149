# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""The signals that end a process of the stack in order."""

import signal
from typing import Any


def handle_shutdown(handler: Any) -> dict[signal.Signals, Any]:
    """Handle SIGINT, SIGTERM, and SIGHUP of a lost terminal or connection.

    SIGINT is handled even if it was ignored, as in a command that a shell starts in the background.
    An ignored SIGHUP stays ignored, for nohup. Returns the handlers from before.
    """
    ignored = signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
    numbers = [signal.SIGINT, signal.SIGTERM, *([] if ignored else [signal.SIGHUP])]
    return {number: signal.signal(number, handler) for number in numbers}
