# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""The signals after which a process of the stack ends in an orderly way."""

import signal
from typing import Any


def handle_shutdown(handler: Any) -> dict[signal.Signals, Any]:
    """Handle SIGINT, SIGTERM, and SIGHUP, which a lost terminal or connection sends.

    SIGINT is handled even if it was ignored, as in a command that a shell starts in the background.
    An ignored SIGHUP stays ignored, so that nohup works. Returns the former handlers.
    """
    ignored = signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
    numbers = [signal.SIGINT, signal.SIGTERM, *([] if ignored else [signal.SIGHUP])]
    return {number: signal.signal(number, handler) for number in numbers}
