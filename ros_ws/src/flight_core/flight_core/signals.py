# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Handle the signals after which a process of the stack ends in an orderly way."""

import signal
from typing import Any


def handle_shutdown(handler: Any) -> dict[signal.Signals, Any]:
    """Install a handler for SIGINT, SIGTERM and SIGHUP, and return the former handlers.

    A lost terminal or connection sends SIGHUP. SIGINT is handled even if it was ignored, as in a
    command that a shell starts in the background. An ignored SIGHUP stays ignored, so that nohup
    works.
    """
    ignored = signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
    numbers = [signal.SIGINT, signal.SIGTERM, *([] if ignored else [signal.SIGHUP])]
    return {number: signal.signal(number, handler) for number in numbers}
