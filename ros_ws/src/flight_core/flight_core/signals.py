# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""The signals that end a process of the stack in order."""

import signal
from typing import Any


def handle_shutdown(handler: Any) -> dict[signal.Signals, Any]:
    """Handle SIGINT, SIGTERM, and SIGHUP of a terminal or connection that is lost. Returns the handlers before.

    SIGINT is handled also where it is ignored, as in a command that a shell started in the background; SIGHUP stays ignored, as
    nohup wants it.
    """
    ignored = signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
    numbers = [signal.SIGINT, signal.SIGTERM, *([] if ignored else [signal.SIGHUP])]
    return {number: signal.signal(number, handler) for number in numbers}
