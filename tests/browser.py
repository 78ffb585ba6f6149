# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Control a headless Chromium over its DevTools pipe.

The pipe carries JSON that ends with a zero byte, on descriptors 3 and 4.
"""

import json
import os
import shutil
import subprocess
import time
from collections.abc import Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, Self

NAMES = ("chromium", "chromium-headless-shell", "chromium-browser", "google-chrome")
CHROMIUM = next(filter(None, map(shutil.which, NAMES)), None)
FLAGS = (
    "--headless=new",
    "--no-sandbox",
    "--disable-gpu",
    "--hide-scrollbars",
    "--remote-debugging-pipe",
)
LOOK = 0.1  # s, on an idle machine one look of `wait_for` takes a fifth of it
CONSOLE_EVENTS = {"Runtime.exceptionThrown", "Runtime.consoleAPICalled", "Log.entryAdded"}


class Browser:
    """A browser with one page.

    `console` has the exceptions and console messages of the page that was opened last.
    """

    def __init__(
        self, profile: Path, width: int = 1280, height: int = 900, flags: Sequence[str] = ()
    ) -> None:
        if CHROMIUM is None:
            raise FileNotFoundError("no Chromium on the path")
        commands, self._commands = os.pipe()
        self._responses, responses = os.pipe()
        ends = (commands, responses)
        null = subprocess.DEVNULL
        flags = [
            *FLAGS,
            *flags,
            f"--window-size={width},{height}",
            f"--user-data-dir={profile}",
            "about:blank",
        ]
        # The shell moves the ends of the pipes to the descriptors that Chromium uses.
        redirect = f'exec "$0" "$@" 3<&{commands} 4>&{responses}'
        command = ["/bin/bash", "-c", redirect, CHROMIUM, *flags]
        self._process = subprocess.Popen(command, pass_fds=ends, stdout=null, stderr=null)
        for end in ends:
            os.close(end)
        self._unread = b""
        self._number = 0
        self._events: list[dict[str, Any]] = []
        self._session: dict[str, str] = {}
        target = self.call("Target.createTarget", url="about:blank")["targetId"]
        self._session = {
            "sessionId": self.call("Target.attachToTarget", targetId=target, flatten=True)[
                "sessionId"
            ]
        }
        for domain in ("Page", "Runtime", "Log"):
            self.call(f"{domain}.enable")

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._process.terminate()
        self._process.wait()
        for end in (self._commands, self._responses):
            os.close(end)

    def call(self, method: str, **params: Any) -> Any:
        """Return the result of a command of the DevTools protocol.

        Raises RuntimeError with the error of the browser.
        """
        self._number += 1
        message = {"id": self._number, "method": method, "params": params} | self._session
        os.write(self._commands, json.dumps(message).encode() + b"\0")
        while (response := self._read()).get("id") != self._number:
            self._events.append(response)
        if "error" in response:
            raise RuntimeError(f"{method}: {response['error']}")
        return response["result"]

    def _read(self) -> dict[str, Any]:
        while b"\0" not in self._unread:
            if not (more := os.read(self._responses, 1 << 20)):
                raise EOFError("the browser has ended")
            self._unread += more
        message, _, self._unread = self._unread.partition(b"\0")
        return dict(json.loads(message))

    def open(self, page: Path | str) -> None:
        """Open a page from a file, or from an address."""
        self._events.clear()
        self.call("Page.navigate", url=page if isinstance(page, str) else page.as_uri())

    def run(self, expression: str) -> Any:
        """Return the value of a JavaScript expression, awaited.

        Raises RuntimeError with its exception.
        """
        result = self.call(
            "Runtime.evaluate", expression=expression, awaitPromise=True, returnByValue=True
        )
        if "exceptionDetails" in result:
            raise RuntimeError(json.dumps(result["exceptionDetails"]))
        return result["result"].get("value")

    def wait_for(self, expression: str, limit: float = 120.0) -> None:
        """Wait until an expression is true. Raises TimeoutError after `limit` seconds.

        Only time in which the browser answers is counted, at most LOOK for each look, because other
        work may keep the processor from both.
        """
        waited = 0.0
        before = time.monotonic()
        while not self._holds(expression):
            if waited > limit:
                raise TimeoutError(f"not true after {limit:g} s: {expression}; {self.console}")
            time.sleep(0.02)
            now = time.monotonic()
            waited = waited + min(now - before, LOOK)
            before = now

    def _holds(self, expression: str) -> bool:
        """Return whether an expression is true.

        On a page that the browser is leaving, it is not.
        """
        try:
            return bool(self.run(expression))
        except RuntimeError as error:
            if "navigated" in str(error):
                return False
            raise

    @property
    def pid(self) -> int:
        """Return the process id of the browser."""
        return self._process.pid

    @property
    def console(self) -> list[dict[str, Any]]:
        """Return exceptions, console messages and log entries of the page."""
        self.run("0")  # earlier events arrive before this result
        return [event["params"] for event in self._events if event.get("method") in CONSOLE_EVENTS]
