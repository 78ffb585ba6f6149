# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Serve the page and the samples of flights to browsers on this host, over HTTP.

A browser asks for new data, and draws the answer before its next request, so that no answers queue
up for a slow browser. After the first answer the browser asks over a WebSocket, which takes two
fifths of the processor time of an HTTP request.

Only GET is answered, for a fixed list of names. The Host header must name this host, as a
protection against DNS rebinding. The files of the page contain no flight and need no token. Samples
need the token, as a protection against other users of this host. The token comes in a header, or as
the first message of a WebSocket, which must belong to the page. A cookie is not used, because it
would go to the servers on all ports of this host. With `Control` there is a single POST request,
which needs a second key and the origin of the page.
"""

import asyncio
import hmac
import json
import math
import socket
import struct
import time
from asyncio import Future
from collections.abc import Awaitable, Mapping, Sequence
from contextlib import suppress
from http import HTTPStatus
from importlib.resources import files
from pathlib import Path
from typing import Any, cast
from urllib.parse import parse_qsl

import numpy as np
from tornado.http1connection import HTTP1Connection
from tornado.httpserver import HTTPServer
from tornado.iostream import IOStream, StreamClosedError
from tornado.web import Application, HTTPError, RequestHandler
from tornado.websocket import WebSocketClosedError, WebSocketHandler, WebSocketProtocol

from flight_analysis.report.summary import finite_or_null
from flight_core.rates import NANOSECONDS
from flight_view.control import Control
from flight_view.fleet import FleetView
from flight_view.flight import Flight
from flight_view.request_values import RefusedError

ADDRESS = "127.0.0.1"
PAGE = Path(__file__).parent / "page"
SCENE = Path(str(files("flight_analysis.report"))) / "scene"  # shared with the report
TYPES = {".html": "text/html", ".css": "text/css", ".js": "text/javascript"}
FILES = {
    path.name: path for path in sorted([*PAGE.iterdir(), *SCENE.iterdir()]) if path.suffix in TYPES
}
HEADERS = {
    "Cache-Control": "no-store",
    "Content-Security-Policy": "default-src 'none'; script-src 'self'; style-src 'self'; "
    "connect-src 'self'; img-src data:;"
    " base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
}
MAX_CONNECTIONS = 64  # connections with the token, of which a browser has up to six
# Further connections, for requests of control and for the first request of a connection.
RESERVED = 8
# Time within which a request must arrive in full, the next request must begin, or the peer must
# take the answer, s.
REQUEST_TIMEOUT = 10.0
MAX_REQUEST_BYTES = 8192
MAX_WAIT = 2.0  # longest time for which a request waits for new samples, s
MAX_ROWS = 10_000  # largest number of rows of a topic in one answer
MAX_DIGITS = 18  # most digits of a number of rows, which keep it below 2^63
# Status codes of a closed WebSocket (RFC 6455, 7.4.1, and the registry of IANA).
POLICY_VIOLATION = 1008
TRY_AGAIN_LATER = 1013
TOKEN_HEADER = "X-Page-Token"  # noqa: S105 - a name
NO_TOKEN = "Open the whole address that rise-di watch printed"  # noqa: S105 - a sentence
FULL = f"{MAX_CONNECTIONS} connections are open"
REST = 0.09  # pause after a chunk of the log, s; the recorder writes one every 0.1 s
POLL_PERIOD = 0.03  # time between two attempts to read the next chunk, s
STATE_PERIOD = 0.25  # time between two checks of the state of the recording, s
BUDGET = 0.05  # longest time of reading between two answers, s


class Server:
    """The server of flights, which also follows their logs.

    A second flight is drawn for comparison, as a ghost. If `fleet` is given, each flight is an
    aircraft of this fleet. A browser asks for a flight by its number. The next number after the
    flights stands for the positions of all aircraft.
    """

    def __init__(
        self,
        flights: Sequence[Flight],
        token: str,
        control: Control | None = None,
        *,
        fleet: bool = False,
    ) -> None:
        self.followed = flights
        self.fleet = fleet
        self.flights: Sequence[Flight | FleetView] = (
            [*flights, FleetView(flights)] if fleet else flights
        )
        self.control = control
        self.token = token
        self.port = 0
        self.streams: set[_News] = set()  # open WebSockets
        self._news = asyncio.Event()
        names = [
            (r"/(|[a-z]+\.[a-z]+)", _File),
            (r"/data/([0-9]{1,3})", _Data),
            (r"/news/([0-9]{1,3})", _News),
        ]
        self.http = _LimitedServer(
            Application(
                [*names, *([(r"/control", _Control)] if control else [])],
                default_handler_class=_Handler,
                log_function=lambda handler: None,
                flight_server=self,
                websocket_max_message_size=MAX_REQUEST_BYTES,
            ),
            idle_connection_timeout=REQUEST_TIMEOUT,
            body_timeout=REQUEST_TIMEOUT,
            max_header_size=MAX_REQUEST_BYTES,
            max_body_size=MAX_REQUEST_BYTES,
        )

    def listen(self, port: int) -> None:
        """Listen for connections from this host only. Port 0 stands for any free port.

        Raises OSError if the port is taken.
        """
        listener = socket.create_server((ADDRESS, port), backlog=MAX_CONNECTIONS)
        listener.setblocking(False)
        self.port = listener.getsockname()[1]
        self.http.add_socket(listener)

    async def close(self) -> None:
        """Stop listening and close all connections."""
        self.http.stop()
        for stream in [*self.streams]:
            stream.close()
        await self.http.close_all_connections()

    def is_token(self, token: str | bytes) -> bool:
        """Return whether a token is the right one for this server."""
        return hmac.compare_digest(
            token.encode() if isinstance(token, str) else token, self.token.encode()
        )

    def is_own_name(self, host: str) -> bool:
        """Return whether a Host header is exactly the name of this server."""
        return host in {f"{name}:{self.port}" for name in (ADDRESS, "localhost", "[::1]")}

    async def follow(self) -> None:
        """Read the logs, and answer the WebSockets, until the task is cancelled.

        Raises ParameterError as `Flight.update` does.
        """
        last_look = -math.inf
        while True:
            has_changed = [flight.update(BUDGET) for flight in self.followed]
            pause = POLL_PERIOD
            if any(has_changed):
                self._news.set()
                self._news.clear()
                pause = (
                    0.0 if any(flight.state() == "reading" for flight in self.followed) else REST
                )
            if any(has_changed) or time.monotonic() > last_look + STATE_PERIOD:
                last_look = time.monotonic()
                for stream in [*self.streams]:
                    stream.look()
            await asyncio.sleep(pause)

    async def news(self, flight: Flight | FleetView, query: Mapping[str, str]) -> bytes:
        """Wait up to MAX_WAIT s for data that a browser lacks, and return it.

        `query` has, by topic, the number of rows that the browser has.
        """
        deadline = time.monotonic() + MAX_WAIT
        while not has_news(flight, query) and (remaining := deadline - time.monotonic()) > 0.0:
            with suppress(TimeoutError):
                await asyncio.wait_for(self._news.wait(), min(remaining, STATE_PERIOD))
        return self.answer(flight, query)

    def answer(self, flight: Flight | FleetView, query: Mapping[str, str]) -> bytes:
        """Return at once the data that a browser lacks.

        `query` has, by topic, the number of rows that the browser has. Raises HTTPError if a number
        is too long.
        """
        has_ghost = len(self.followed) > 1
        fleet = len(self.followed) if self.fleet else 0
        return answer(
            flight,
            query,
            ghost=has_ghost and not fleet,
            fleet=fleet,
            control=self.control is not None,
        )


def _epoch(flight: Flight | FleetView) -> str:
    """Return a text that changes whenever rows change that a browser already has.

    Rows change when they are thinned, or when the instant of flight time 0 changes.
    """
    return f"{flight.start_ns}.{sum(samples.thinned for samples in flight.samples.values())}"


def _first_rows(flight: Flight | FleetView, query: Mapping[str, str]) -> dict[str, int]:
    """Return, by topic, the index of the first row that a browser lacks.

    Raises HTTPError as `Server.answer` does.
    """
    is_same_epoch = query.get("epoch") == _epoch(flight)
    rows = {
        name: query.get(name, "") if is_same_epoch else "" for name in (*flight.samples, "events")
    }
    if any(len(text) > MAX_DIGITS for text in rows.values()):
        raise HTTPError(
            HTTPStatus.BAD_REQUEST, reason=f"A number of rows has more than {MAX_DIGITS} digits"
        )
    return {
        name: int(text) if text.isascii() and text.isdigit() else 0 for name, text in rows.items()
    }


def has_news(flight: Flight | FleetView, query: Mapping[str, str]) -> bool:
    """Return whether a browser lacks a row, an event, or the state."""
    first = _first_rows(flight, query)
    return (
        any(samples.count > first[name] for name, samples in flight.samples.items())
        or len(flight.events) > first["events"]
        or query.get("epoch") != _epoch(flight)
        or query.get("state") != flight.state()
    )


def answer(
    flight: Flight | FleetView,
    query: Mapping[str, str],
    *,
    ghost: bool = False,
    fleet: int = 0,
    control: bool = False,
) -> bytes:
    """Encode the data that a browser lacks: a head, then the columns of each topic that it names.

    `fleet` is the number of the data set with the positions of all aircraft, or 0 without a fleet.
    `ghost` says whether there is a second flight for comparison, and `control` whether the page has
    control.

    The head consists of the length of a JSON text, as uint32, and the text itself. It is little
    endian, and ends at a multiple of 8 bytes. A topic with `count` rows has as columns the flight
    time in s as float64, then the channels as float32, filled up to a multiple of 8 bytes. A topic
    has at most MAX_ROWS rows.
    """
    first = _first_rows(flight, query)
    topics = []
    columns = []
    for name, samples in flight.samples.items():
        rows = slice(first[name], min(samples.count, first[name] + MAX_ROWS))
        t = (samples.stamp_ns[rows] - flight.start_ns) / NANOSECONDS
        if len(t):
            topics.append(
                {"name": name, "channels": samples.names, "first": rows.start, "count": len(t)}
            )
            values = np.ascontiguousarray(samples.values[rows].T, dtype="<f4").tobytes()
            columns += [t.astype("<f8").tobytes(), values, bytes(-len(values) % 8)]
    events = [
        [(event.stamp_ns - flight.start_ns) / NANOSECONDS, event.kind, event.text]
        for event in flight.events[first["events"] :]
    ]
    head: dict[str, Any] = {
        "epoch": _epoch(flight),
        "state": flight.state(),
        "ghost": ghost,
        "fleet": fleet,
        "start": flight.start_ns / NANOSECONDS,
        "control": control,
        "faults": flight.faults(),
        "bands": finite_or_null(flight.bands),
        "models": flight.models,
        "topics": topics,
        "first_event": first["events"],
        "events": events,
        "described": flight.described,
    }
    if query.get("described") != str(flight.described) or query.get("epoch") != head["epoch"]:
        head["flight"] = finite_or_null(flight.description)
    text = json.dumps(head, allow_nan=False).encode()
    text += b" " * (-(len(text) + 4) % 8)
    return b"".join([struct.pack("<I", len(text)), text, *columns])


class _LimitedServer(HTTPServer):
    """A server with at most MAX_CONNECTIONS connections with the token, and RESERVED others.

    WebSockets are connections, too. If this number is reached, a new connection replaces the oldest
    one that has not shown the token.
    """

    def initialize(self, *args: Any, **kwargs: Any) -> None:
        super().initialize(*args, **kwargs)
        # Connections in the order of arrival, with whether each has shown the token and may stay.
        self._admitted: dict[IOStream, bool] = {}

    def handle_stream(self, stream: IOStream, address: tuple[Any, ...]) -> None:
        self._leave_out_closed()
        if len(self._admitted) >= MAX_CONNECTIONS + RESERVED:
            next(
                stream_without_token
                for stream_without_token, admitted in self._admitted.items()
                if not admitted
            ).close()
        self._admitted[stream] = False
        super().handle_stream(stream, address)

    def admit(self, stream: IOStream) -> bool:
        """Try to keep a connection that has shown the token, and return whether it is kept.

        If MAX_CONNECTIONS are kept already, a further connection is not.
        """
        self._leave_out_closed()
        if sum(self._admitted.values()) < MAX_CONNECTIONS:
            self._admitted[stream] = True
        return self._admitted.get(stream, False)

    def _leave_out_closed(self) -> None:
        self._admitted = {
            stream: admitted for stream, admitted in self._admitted.items() if not stream.closed()
        }


class _Handler(RequestHandler):
    """Checks the Host header and the token of a request.

    If no subclass answers, the answer is 404, not found. A connection without the token, or beyond
    MAX_CONNECTIONS, is closed after the answer. A connection is also closed if its peer does not
    take the answer within REQUEST_TIMEOUT.
    """

    _is_kept = False

    @property
    def server(self) -> Server:
        return self.settings["flight_server"]  # type: ignore[no-any-return]

    def set_default_headers(self) -> None:
        self.clear_header("Server")
        for name, value in HEADERS.items():
            self.set_header(name, value)

    @property
    def stream(self) -> IOStream:
        return cast("HTTP1Connection", self.request.connection).stream

    def prepare(self) -> None:
        if not self.server.is_own_name(self.request.host):
            raise HTTPError(HTTPStatus.FORBIDDEN)
        self.require_token()

    def require_token(self) -> None:
        """Raise HTTPError for a request without the token, or beyond MAX_CONNECTIONS."""
        if not self.server.is_token(self.request.headers.get(TOKEN_HEADER, "")):
            raise HTTPError(HTTPStatus.UNAUTHORIZED, reason=NO_TOKEN)
        self._is_kept = self.server.http.admit(self.stream)
        if not self._is_kept and not isinstance(self, _Control):
            raise HTTPError(HTTPStatus.SERVICE_UNAVAILABLE, reason=FULL)

    def finish(self, chunk: str | bytes | dict[str, Any] | None = None) -> "Future[None]":
        """Send the answer, and close the connection if it must not be kept."""
        stream = self.stream
        stays_open = self._is_kept or self.get_status() == HTTPStatus.SWITCHING_PROTOCOLS
        if not stays_open:
            self.set_header("Connection", "close")
        future = super().finish(chunk)
        timeout = asyncio.get_running_loop().call_later(REQUEST_TIMEOUT, stream.close)

        def end(_: "Future[None]") -> None:
            timeout.cancel()
            if not stays_open:
                stream.close()

        future.add_done_callback(end)
        return future

    def require_page(self) -> None:
        """Raise HTTPError if a request comes from another page."""
        if self.request.headers.get_list("Origin") != [f"http://{self.request.host}"]:
            raise HTTPError(HTTPStatus.FORBIDDEN, reason="A request of another page")

    def get(self, *_: str) -> Any:
        raise HTTPError(HTTPStatus.NOT_FOUND)

    def write_error(self, status_code: int, **kwargs: Any) -> None:
        self.set_header("Content-Type", "text/plain; charset=utf-8")
        self.finish(f"{status_code}: {self._reason}\n")

    def compute_etag(self) -> None:
        """Compute no hash of an answer, because browsers must not cache it."""

    def log_exception(self, *args: Any) -> None:
        if not isinstance(args[1], HTTPError):
            super().log_exception(*args)


class _File(_Handler):
    """Answers requests for the page and its files, which need no token."""

    def require_token(self) -> None:
        """Do nothing, because files need no token."""

    def get(self, *names: str) -> None:
        name = names[0] or "index.html"
        if name not in FILES:
            raise HTTPError(HTTPStatus.NOT_FOUND)
        self.set_header("Content-Type", f"{TYPES[FILES[name].suffix]}; charset=utf-8")
        self.finish(FILES[name].read_bytes())


class _Data(_Handler):
    """Answers a request for the samples of a flight.

    The query has, by topic, the number of rows that the browser has.
    """

    async def get(self, *names: str) -> None:
        number = int(names[0])
        if number >= len(self.server.flights):
            raise HTTPError(HTTPStatus.NOT_FOUND)
        query = {
            name: values[-1].decode("ascii", "replace")
            for name, values in self.request.query_arguments.items()
        }
        content = await self.server.news(self.server.flights[number], query)
        self.set_header("Content-Type", "application/octet-stream")
        # The browser has closed the connection.
        with suppress(StreamClosedError):
            await self.finish(content)


class _News(_Handler, WebSocketHandler):
    """Answers requests for the samples of a flight over a WebSocket.

    A message has a query as for `_Data`, and gets the same answer. The first message is the token,
    because a page cannot set a header of a WebSocket.
    """

    def require_token(self) -> None:
        """Do nothing, because the token comes in the first message."""

    async def get(self, *names: str) -> None:
        self.require_page()
        if int(names[0]) >= len(self.server.flights):
            raise HTTPError(HTTPStatus.NOT_FOUND)
        await WebSocketHandler.get(self, *names)

    def open(self, *names: str) -> None:
        self.flight = self.server.flights[int(names[0])]
        self._sending: Future[None] | None = None
        self._peer = cast("IOStream", cast("WebSocketProtocol", self.ws_connection).stream)
        self.server.streams.add(self)
        self._await_request()

    def _await_request(self) -> None:
        self._query: dict[str, str] | None = None  # query that waits for an answer
        self._since = time.monotonic()

    def on_message(self, message: str | bytes) -> Awaitable[None] | None:
        if not self._is_kept:
            if not self.server.is_token(message):
                self.close(POLICY_VIOLATION, NO_TOKEN)
            elif not self.server.http.admit(self._peer):
                self.close(TRY_AGAIN_LATER, FULL)
            else:
                self._is_kept = True
            return None
        self._query = dict(
            parse_qsl(message if isinstance(message, str) else "", keep_blank_values=True)
        )
        self._since = time.monotonic()
        # This is done as soon as the answer is in the buffers of the network.
        self._answered = asyncio.get_running_loop().create_future()
        self.look()
        # The next message is not read before the answer is sent.
        return self._answered

    def look(self) -> None:
        """Answer the waiting request if there is new data, or if it has waited for MAX_WAIT.

        Close the connection after REQUEST_TIMEOUT without a request, or if the peer does not take
        the answer.
        """
        waited = time.monotonic() - self._since
        if self._query is None:
            if waited > REQUEST_TIMEOUT:
                self.close()
                # The peer does not read the rest of the answer, either.
                if self._sending is not None and not self._sending.done():
                    self._peer.close()
            return
        try:
            if waited < MAX_WAIT and not has_news(self.flight, self._query):
                return
            content = self.server.answer(self.flight, self._query)
        except HTTPError as error:
            self.close(POLICY_VIOLATION, error.reason)
            content = b""  # no further content is sent
        self._await_request()
        self._sending = asyncio.ensure_future(self._send(content))

    async def _send(self, content: bytes) -> None:
        # The browser has left, or the stream is closed.
        with suppress(WebSocketClosedError):
            await self.write_message(content, binary=True)
        self._answered.set_result(None)

    def on_close(self) -> None:
        self.server.streams.discard(self)


class _Control(_Handler):
    """Answers requests of a page to command the flight.

    A request is JSON, must come from the origin of the page, and must have the key that the user
    typed.
    """

    def get(self, *_: str) -> None:
        raise HTTPError(HTTPStatus.METHOD_NOT_ALLOWED)

    async def post(self) -> None:
        self.require_page()
        if self.request.headers.get("Content-Type") != "application/json":
            raise HTTPError(HTTPStatus.UNSUPPORTED_MEDIA_TYPE)
        try:
            request = json.loads(self.request.body, parse_constant=_refuse_constant)
        except (ValueError, RecursionError):
            raise HTTPError(HTTPStatus.BAD_REQUEST, reason="Not JSON") from None
        headers = self.request.headers
        assert self.server.control is not None  # noqa: S101 - the route exists only with control
        try:
            result = await self.server.control.answer(
                request, headers.get("X-Control-Key", ""), headers.get("X-Control-Lease", "")
            )
        except RefusedError as error:
            self.set_status(error.status)
            result = {"refused": error.sentence}
        with suppress(StreamClosedError):
            await self.finish(finite_or_null(result))


def _refuse_constant(text: str) -> float:
    # NaN and Infinity are not JSON.
    raise ValueError(text)
