# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""A headless Chromium, told what to do over its DevTools pipe: JSON that ends with a zero byte, on descriptors 3 and 4."""

import json
import os
import shutil
import subprocess
import time
from pathlib import Path
from types import TracebackType
from typing import Any, Self

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
FLAGS = ("--headless=new", "--no-sandbox", "--disable-gpu", "--hide-scrollbars", "--remote-debugging-pipe")
COMPLAINTS = {"Runtime.exceptionThrown", "Runtime.consoleAPICalled", "Log.entryAdded"}


class Browser:
    """One browser with one page. `complaints` is what its console has said of the page opened last."""

    def __init__(self, profile: Path, width: int = 1280, height: int = 900) -> None:
        if CHROMIUM is None:
            raise FileNotFoundError("no Chromium on the path")
        told, self._tell = os.pipe()
        self._answers, answers = os.pipe()
        flags = [*FLAGS, f"--window-size={width},{height}", f"--user-data-dir={profile}", "about:blank"]
        # The shell puts the pipe's ends where Chromium looks for them.
        moved = f'exec "$0" "$@" 3<&{told} 4>&{answers}'
        command = ["/bin/bash", "-c", moved, CHROMIUM, *flags]
        self._process = subprocess.Popen(
            command, pass_fds=(told, answers), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        )
        for end in (told, answers):
            os.close(end)
        self._unread = b""
        self._number = 0
        self._events: list[dict[str, Any]] = []
        self._session: dict[str, str] = {}
        target = self.call("Target.createTarget", url="about:blank")["targetId"]
        self._session = {"sessionId": self.call("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]}
        for domain in ("Page", "Runtime", "Log"):
            self.call(f"{domain}.enable")

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self._process.terminate()
        self._process.wait()
        for end in (self._tell, self._answers):
            os.close(end)

    def call(self, method: str, **params: Any) -> Any:
        """The result of a command of the DevTools protocol. Raises RuntimeError with what the browser refused."""
        self._number += 1
        message = {"id": self._number, "method": method, "params": params} | self._session
        os.write(self._tell, json.dumps(message).encode() + b"\0")
        while (answer := self._read()).get("id") != self._number:
            self._events.append(answer)
        if "error" in answer:
            raise RuntimeError(f"{method}: {answer['error']}")
        return answer["result"]

    def _read(self) -> dict[str, Any]:
        while b"\0" not in self._unread:
            if not (more := os.read(self._answers, 1 << 20)):
                raise EOFError("the browser has ended")
            self._unread += more
        message, _, self._unread = self._unread.partition(b"\0")
        return dict(json.loads(message))

    def open(self, path: Path) -> None:
        """Open a page from a file."""
        self._events.clear()
        self.call("Page.navigate", url=path.as_uri())

    def run(self, expression: str) -> Any:
        """The value of JavaScript, awaited. Raises RuntimeError with what it threw."""
        answer = self.call("Runtime.evaluate", expression=expression, awaitPromise=True, returnByValue=True)
        if "exceptionDetails" in answer:
            raise RuntimeError(json.dumps(answer["exceptionDetails"]))
        return answer["result"].get("value")

    def wait_for(self, expression: str, limit: float = 30.0) -> None:
        """Wait until an expression is true. Raises TimeoutError after `limit` seconds."""
        until = time.monotonic() + limit
        while not self.run(expression):
            if time.monotonic() > until:
                raise TimeoutError(f"not true after {limit:g} s: {expression}; {self.complaints}")
            time.sleep(0.02)

    @property
    def complaints(self) -> list[dict[str, Any]]:
        """Exceptions, console messages and log entries of the page."""
        self.run("0")  # what was said before has come by then
        return [event["params"] for event in self._events if event.get("method") in COMPLAINTS]
