# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test the live page without a browser.

The tests follow a flight, and check the answers of the server and which clients it refuses.
"""

import asyncio
import io
import json
import math
import re
import signal
import socket
import struct
import subprocess
import sys
import threading
import time
import tracemalloc
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import pytest
from numpy.typing import NDArray
from rich.console import Console
from tests.conftest import REPOSITORY, refusing
from tests.joint_states import JOINT_STATE, parameter_event, path, vector
from tornado.httpclient import AsyncHTTPClient, HTTPRequest, HTTPResponse
from tornado.websocket import WebSocketClientConnection, websocket_connect

from flight_analysis.closed_loop.scenario_library import find_scenario
from flight_analysis.metrics.settling import settling_bands
from flight_core.tape import Tape
from flight_guidance.routes.route_file import Origin, Waypoint
from flight_guidance.steering.path import route_outline
from flight_log.bag import BagWriter, LogAttachments
from flight_log.disk import try_lock
from flight_log.engagements import KEY_VALUE
from flight_log.log_messages import MAX_TEXT
from flight_log.named_vectors import typestore
from flight_log.stored_messages import PARAMETER_EVENT, PARAMETER_EVENTS
from flight_view import flight as followed_flight
from flight_view import server as http
from flight_view.background import read_background
from flight_view.flight import ROUTE_TYPE, Flight
from flight_view.series import Series
from flight_view.server import FILES, Server, answer
from flight_view.text import picture
from flight_view.watch import namespaces, newest_run, runs_in_recording, serve

pytestmark = pytest.mark.slow

TOKEN = "a-token"  # noqa: S105 - of a test
CORPUS = sorted((REPOSITORY / "tests" / "corpus" / "mcap").iterdir())
# Valid, and too large for a reader that allocates as it is told.
INTACT = {"zstd_of_fifty_thousand_messages"}


def decoded(
    content: bytes,
) -> tuple[dict[str, Any], dict[str, tuple[NDArray[np.float64], NDArray[np.float32]]]]:
    """Return the head of an answer, and times (N,) and values (N, k) of its topics."""
    (size,) = struct.unpack_from("<I", content)
    head = json.loads(content[4 : 4 + size])
    place = 4 + size
    columns = {}
    for topic in head["topics"]:
        count = topic["count"]
        k = len(topic["channels"])
        t = np.frombuffer(content, "<f8", count, place)
        place += 8 * count
        columns[topic["name"]] = (
            t,
            np.frombuffer(content, "<f4", count * k, place).reshape(k, count).T,
        )
        place += -(-4 * count * k // 8) * 8
    assert place == len(content)
    return head, columns


def followed(
    flight: Flight,
) -> tuple[dict[str, Any], dict[str, tuple[NDArray[np.float64], NDArray[np.float32]]]]:
    """Return all that a browser gets, request by request."""
    known: dict[str, str] = {}
    parts: dict[str, list[tuple[NDArray[np.float64], NDArray[np.float32]]]] = {}
    while True:
        head, columns = decoded(answer(flight, known))
        for name, part in columns.items():
            parts.setdefault(name, []).append(part)
        rows = {name: str(sum(len(t) for t, _ in pieces)) for name, pieces in parts.items()}
        known = {
            "epoch": head["epoch"],
            "state": head["state"],
            "described": str(head["described"]),
            **rows,
        }
        if not columns:
            return head, {
                name: tuple(map(np.concatenate, zip(*pieces, strict=True)))  # type: ignore[misc]
                for name, pieces in parts.items()
            }


def test_page_gets_ticks_of_flight_to_value(recorded: Path, tape: Tape) -> None:
    flight = Flight(recorded)
    assert flight.update()
    _, columns = followed(flight)
    t, values = columns["internals"]
    names = flight.samples["internals"].names
    assert t.tolist() == tape.time("internals").tolist()
    for k, name in enumerate(names):
        assert values[:, k].tolist() == tape["internals"][name].astype(np.float32).tolist()
    assert {"mode", "late", "y.q", "y_m.q", "e.q", "u.elevator", "limited.elevator"} <= set(names)
    t, values = columns["pose"]
    assert t.tolist() == tape.time("pose").tolist()
    assert values.tolist() == tape["pose"].values.astype(np.float32).tolist()
    assert np.diff(columns["truth"][0]) == pytest.approx(0.02)  # 50 Hz of 500


@pytest.mark.parametrize("piece", [1009, 30_000])
def test_followed_flight_equals_replayed_flight(piece: int, recorded: Path, tmp_path: Path) -> None:
    content = (recorded / "run_0.mcap").read_bytes()
    path = tmp_path / "run_0.mcap"
    live = Flight(tmp_path)
    late = Flight(recorded)
    late.update()
    for start in range(0, len(content), piece):
        with path.open("ab") as stream:
            stream.write(content[start : start + piece])
        live.update()
    (one, columns), (other, columns_late) = followed(live), followed(late)
    assert one | {"epoch": ""} == other | {"epoch": ""}
    assert columns.keys() == columns_late.keys()
    for name, (t, values) in columns.items():
        assert t.tobytes() == columns_late[name][0].tobytes()
        assert values.tobytes() == columns_late[name][1].tobytes()
    assert (live.state(), late.state()) == ("ended", "ended")


def test_description_holds_scenario(recorded: Path) -> None:
    """The description has the units, limits, gusts and commands of the scenario."""
    flight = Flight(recorded)
    flight.update()
    description = flight.description
    assert description["units"]["q"] == {"unit": "deg/s", "factor": pytest.approx(180.0 / math.pi)}
    assert description["modes"][""]["1"] == "ENGAGED"
    assert [name for name, *_ in description["gusts"]] == ["vertical", "lateral"]
    assert description["commands"][0][1] > 0.0
    json.dumps(description, allow_nan=False)
    assert [(event.kind, event.text) for event in flight.events] == [("mode", "ENGAGED")]
    assert set(flight.bands) == {"q", "V", "p", "r"}


def test_state_tells_slow_recorder_from_killed_one(recorded: Path, tmp_path: Path) -> None:
    now = 0.0
    path = tmp_path / "run_0.mcap"
    flight = Flight(tmp_path, now=lambda: now)
    flight.update()
    assert flight.state() == "waiting"
    content = (recorded / "run_0.mcap").read_bytes()
    path.write_bytes(content[: len(content) // 2])
    flight.update()
    assert flight.state() == "recording"
    now = 1.5
    with path.open("rb") as recorder:
        assert try_lock(recorder)
        assert flight.state() == "no data"
    assert flight.state() == "interrupted"
    path.write_bytes(content)
    flight.update()
    assert flight.state() == "ended"


@pytest.mark.parametrize("backlog, state", [(0, "reading"), (10**9, "recording")])
def test_long_logs_read_in_slices(
    backlog: int, state: str, recorded: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A short backlog still counts as live."""
    monkeypatch.setattr(followed_flight, "LIVE_BACKLOG", backlog)
    flight = Flight(recorded)
    slices = 0
    while flight.update(budget=0.0):
        slices += 1
        assert flight.state() in {state, "ended"} or not flight.samples
    assert slices > 10
    whole = Flight(recorded)
    whole.update()
    assert (
        followed(flight)[1]["internals"][1].tobytes()
        == followed(whole)[1]["internals"][1].tobytes()
    )


def test_late_row_kept_and_old_row_refused() -> None:
    """A row of a recovered overrun is kept in order, and a row from another time is refused."""
    samples = Series(("a",))
    for stamps in ([0, 50_000_000], [47_000_000, 60_000_000], [-3_000_000_000, 70_000_000]):
        samples.append(np.array(stamps, dtype=np.int64), np.ones((2, 1)))
    assert samples.stamp_ns.tolist() == [0, 50_000_000, 50_000_000, 60_000_000, 70_000_000]
    assert samples.refused == 1


def test_long_flight_becomes_coarser_in_place() -> None:
    """A flight of any length needs no large temporary arrays."""
    # 12 MB: tracemalloc counts what threads of other tests allocate meanwhile, up to 1 MB
    rows, channels = (100_000, 30)
    samples = Series(tuple(map(str, range(channels))), max_rows=rows)
    values = np.random.default_rng(1).normal(size=(rows, channels))
    samples.append(np.arange(rows), values)
    tracemalloc.start()
    samples.append(np.arange(rows, rows + 4), values[:4])
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    # A copy of all rows at once would take 1.5 times that.
    assert peak < values.astype(np.float32).nbytes / 2
    groups = values.astype(np.float32).reshape(-1, 4, channels)
    assert (samples.values[: rows // 2 : 2] == groups.min(axis=1)).all()
    assert (samples.values[1 : rows // 2 : 2] == groups.max(axis=1)).all()
    assert (samples.stamp_ns[: rows // 2] == np.arange(0, rows, 2)).all()


def test_settling_bands_grow_with_a_flight_that_became_coarser(
    recorded: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The number of rows does not show the duration of a flight.

    The rows are halved when they reach a limit.
    """
    ends = []

    def bands(tape: Tape) -> dict[str, float]:
        ends.append(int(tape["y"].stamp_ns[-1]))
        return settling_bands(tape)

    monkeypatch.setattr(followed_flight, "settling_bands", bands)
    monkeypatch.setattr(followed_flight, "Series", partial(Series, max_rows=72))
    content = (recorded / "run_0.mcap").read_bytes()
    live = Flight(tmp_path)
    for start in range(0, len(content), 1009):
        with (tmp_path / "run_0.mcap").open("ab") as stream:
            stream.write(content[start : start + 1009])
        live.update()
    samples = live.samples["internals"]
    first, last = samples.stamp_ns[[0, -1]].tolist()
    assert samples.thinned > 1
    assert ends[-1] - first > (last - first) / 1.2


def test_browser_gets_thinned_samples_again_from_start(recorded: Path) -> None:
    flight = Flight(recorded)
    flight.update()
    head, _ = decoded(answer(flight, {}))
    known = {"epoch": head["epoch"], "internals": "50", "y": "not a number", "u": "-3"}
    topics = {
        topic["name"]: topic["first"] for topic in decoded(answer(flight, known))[0]["topics"]
    }
    assert (topics["internals"], topics["y"], topics["u"]) == (50, 0, 0)
    flight.samples["internals"].thinned += 1
    topics = {
        topic["name"]: topic["first"] for topic in decoded(answer(flight, known))[0]["topics"]
    }
    assert topics["internals"] == 0


@pytest.mark.parametrize("case", CORPUS, ids=lambda path: path.name)
def test_hostile_log_shown_as_far_as_it_goes(case: Path, tmp_path: Path) -> None:
    path = tmp_path / "run_0.mcap"
    path.write_bytes(case.read_bytes())
    now = 0.0
    flight = Flight(path, now=lambda: now)
    with np.errstate(all="ignore"):
        flight.update()
        now = 1.5
        head, _ = decoded(answer(flight, {}))
    assert head["state"] in {"ended", "interrupted"}
    assert head["faults"] or head["state"] == "interrupted" or case.name in INTACT
    assert all(sentence.isprintable() for sentence in head["faults"])


def test_names_and_texts_of_log_bounded_and_printable(tmp_path: Path) -> None:
    hostile = "<img src=x onerror=alert(1)>\x1b[2J" + "a" * 5000
    with BagWriter(tmp_path / "run") as bag:
        y = bag.add_topic("/y", JOINT_STATE, "")
        other = bag.add_topic("/other/y", JOINT_STATE, "")
        for k in range(3):
            bag.write(y, k, k, k, vector(k, [hostile], [float("nan")]))
            bag.write(other, k, k, k, vector(k, ["q"], [1.0]))
    flight = Flight(tmp_path / "run")
    flight.update()
    head, _ = decoded(answer(flight, {}))
    assert head["topics"][0]["channels"][0].startswith("<img src=x onerror=alert(1)>\\x1b[2J")
    assert head["faults"] == [
        "another aircraft in the namespace /other is not shown: --namespace /other"
    ]
    assert max(map(len, head["topics"][0]["channels"])) <= MAX_TEXT


@pytest.mark.parametrize(("text", "raised"), [("after interpreter shutdown", 0), ("in use", 1)])
def test_end_of_the_process_while_samples_are_counted_is_silent(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, text: str, raised: int
) -> None:
    with BagWriter(tmp_path / "run") as bag:
        y = bag.add_topic("/y", JOINT_STATE, "")
        bag.write(y, 1, 1, 0, vector(1, ["q"], [0.0]))
    flight = Flight(tmp_path / "run")

    def ends(*_: object) -> None:
        # as concurrent.futures does once the interpreter shuts down
        raise RuntimeError(f"cannot schedule new futures {text}")

    errors: list[object] = []
    monkeypatch.setattr(followed_flight, "read_run", ends)
    monkeypatch.setattr(threading, "excepthook", errors.append)
    while flight.update():
        pass
    flight.counted()
    assert flight.state() == "ended"
    assert len(errors) == raised


def test_events_of_another_aircraft_are_not_shown(tmp_path: Path) -> None:
    store = typestore()
    with BagWriter(tmp_path / "run") as bag:
        events = bag.add_topic(PARAMETER_EVENTS, PARAMETER_EVENT, "")
        for number, name in enumerate(("one", "two")):
            bag.write(
                bag.add_topic(f"/{name}/y", JOINT_STATE, ""),
                number,
                number,
                0,
                vector(number, ["q"], [0.0]),
            )
            report = store.types[KEY_VALUE](key="ENGAGED", value=name)
            engagement = bag.add_topic(f"/{name}/bridge/engagement", KEY_VALUE, "")
            bag.write(engagement, number, number, 0, bytes(store.serialize_cdr(report, KEY_VALUE)))
            bag.write(
                events, number, number, number, parameter_event(f"/{name}/controller", {"k_g": 2.5})
            )
    flight = Flight(tmp_path / "run")
    flight.update()
    assert sorted((event.kind, event.text) for event in flight.events) == [
        ("bridge", "ENGAGED one"),
        ("parameter", "controller: k_g = 2.5"),
    ]


def test_route_in_flight_replaces_scenario_route(tmp_path: Path) -> None:
    scenario = find_scenario("osprey_route")
    points = [(0.0, 0.0, 50.0), (600.0, 0.0, 55.0), (600.0, 400.0, 55.0)]
    with BagWriter(tmp_path / "run") as bag:
        bag.add_attachments(LogAttachments(scenario.path), 0)
        route, other = (bag.add_topic(name, ROUTE_TYPE, "") for name in ("/route", "/other/route"))
        bag.write(route, 1, 1, 0, path(*points))
        bag.write(route, 2, 2, 1, path(points[0]))  # cannot be flown
        bag.write(route, 2, 2, 2, path(*points[:2], frame="odom"))  # a frame that guidance refuses
        bag.write(bag.add_topic("/y", JOINT_STATE, ""), 3, 3, 0, vector(3, ["q"], [0.0]))
        bag.write(other, 4, 4, 0, path(*points[:2]))
    flight = Flight(tmp_path / "run")
    flight.update()
    head, _ = decoded(answer(flight, {"described": "1"}))
    assert scenario.guidance is not None
    expected = route_outline(scenario.guidance.plan([Waypoint(*point) for point in points]))
    assert [tuple(vertex) for vertex in head["flight"]["route"]] == expected
    assert [(event.kind, event.text) for event in flight.events] == [("route", "3 waypoints")]
    known = {"described": str(head["described"]), "epoch": head["epoch"]}
    assert "flight" not in decoded(answer(flight, known))[0]


# The background of the map


def geojson(path: Path, *geometries: dict[str, Any], **members: Any) -> Path:
    path.write_text(json.dumps({"type": "GeometryCollection", "geometries": geometries} | members))
    return path


LINE = {"type": "LineString", "coordinates": [[8.50, 47.40], [8.50, 47.41]]}


def test_background_in_plane_of_flight(tmp_path: Path) -> None:
    ring = [[8.50, 47.40], [8.51, 47.40], [8.51, 47.41], [8.50, 47.40]]
    path = geojson(
        tmp_path / "field.geojson",
        LINE,
        {"type": "Polygon", "coordinates": [ring]},
        {"type": "MultiPoint", "coordinates": [[8.5, 47.4], [8.5, 47.41, 500.0]]},
    )
    line, polygon, *points = read_background(path, Origin(47.40, 8.50))
    # A minute of arc of a meridian at 47.4 deg is 1853.1 m (WGS84), one of the parallel there
    # 1258.1 m.
    assert line == pytest.approx(np.array([[0.0, 0.0], [1111.8, 0.0]]), abs=0.3)
    assert polygon[1] == pytest.approx((0.0, 754.9), abs=0.3)
    assert (len(polygon), [len(point) for point in points]) == (4, [1, 1])
    flight = Flight(tmp_path / "run", background=[line])
    assert flight.description["background"] == [line]


@pytest.mark.parametrize(
    "geometries, members, sentence",
    [
        (
            [LINE],
            {"crs": {"properties": {"name": "EPSG:2056"}}},
            "the coordinate system 'EPSG:2056', expected WGS84",
        ),
        (
            [{"type": "Circle", "coordinates": []}],
            {},
            "a geometry of the type 'Circle', expected one of Point",
        ),
        ([], {}, "no position, expected lines, polygons or points"),
        ([{"type": "Point", "coordinates": [47.4, 8.5]}], {}, "latitude and longitude exchanged"),
    ],
)
def test_background_that_is_no_map_refused(
    geometries: list[dict[str, Any]], members: dict[str, Any], sentence: str, tmp_path: Path
) -> None:
    with refusing(sentence):
        read_background(
            geojson(tmp_path / "file.geojson", *geometries, **members), Origin(47.40, 8.50)
        )


# The server


@asynccontextmanager
async def serving(*runs: Path) -> AsyncIterator[Server]:
    server = Server([Flight(run) for run in runs], TOKEN)
    server.listen(0)
    task = asyncio.ensure_future(server.follow())
    try:
        yield server
    finally:
        task.cancel()
        await server.close()


async def get(
    server: Server, path: str, method: str = "GET", token: str = TOKEN, **headers: str
) -> HTTPResponse:
    given = {http.TOKEN_HEADER: token} if token else {}
    return await AsyncHTTPClient(force_instance=True).fetch(
        f"http://127.0.0.1:{server.port}{path}",
        method=method,
        headers=given | headers,
        body=b"" if method in {"POST", "PUT", "PATCH"} else None,
        follow_redirects=False,
        raise_error=False,
        request_timeout=60.0,
    )


async def test_page_served_to_all_and_samples_with_token(recorded: Path) -> None:
    """The page loads nothing from another host."""
    async with serving(recorded) as server:
        # A browser sends no header with the address of a page.
        page = await get(server, "/", token="")
        assert (page.code, page.body) == (200, FILES["index.html"].read_bytes())
        assert page.headers["Content-Security-Policy"].startswith("default-src 'none'")
        assert "frame-ancestors 'none'" in page.headers["Content-Security-Policy"]
        assert page.headers["X-Content-Type-Options"] == "nosniff"
        assert page.headers["Referrer-Policy"] == "no-referrer"
        assert not {"Server", "Set-Cookie"} & set(page.headers)
        for name in FILES:
            assert (await get(server, f"/{name}", token="")).body == FILES[name].read_bytes()
        await whole_log(server)  # until then the epoch may change
        head, _ = decoded((await get(server, "/data/0")).body)
        assert (head["flight"]["name"], head["ghost"]) == ("run", False)
        assert (await get(server, "/data/1")).code == 404
        # More digits than Python converts.
        long = await get(server, f"/data/0?epoch={head['epoch']}&y={'9' * 4301}")
        assert (long.code, long.body) == (400, b"400: A number of rows has more than 18 digits\n")

    for file in FILES.values():
        text = file.read_text()
        assert "://" not in text
        assert "innerHTML" not in text


@pytest.mark.parametrize(
    "path, method, headers, expected",
    [
        ("/", "GET", {"Host": "evil.example"}, 403),
        ("/", "GET", {"Host": "127.0.0.1.evil.example"}, 403),
        ("/data/0", "GET", {"Host": "localhost"}, 403),
        ("/..%2f..%2fetc%2fpasswd", "GET", {}, 404),
        ("/server.py", "GET", {}, 404),
        ("/data/0", "PUT", {}, 405),
        ("/", "OPTIONS", {}, 405),
    ],
)
async def test_foreign_host_another_path_and_another_method_refused(
    path: str, method: str, headers: dict[str, str], expected: int, recorded: Path
) -> None:
    async with serving(recorded) as server:
        assert (await get(server, path, method, **headers)).code == expected


@pytest.mark.parametrize("path", ["/data/0", "/nothing", "/data/0?token=" + TOKEN])
@pytest.mark.parametrize(
    "headers",
    [{}, {"Cookie": f"token={TOKEN}"}, {http.TOKEN_HEADER: "another"}, {http.TOKEN_HEADER: "\xff"}],
)
async def test_no_sample_served_without_token(
    path: str, headers: dict[str, str], recorded: Path
) -> None:
    """Neither a query nor a cookie may carry the token.

    The query can appear in a log of addresses, and a cookie goes to all ports of a host.
    """
    async with serving(recorded) as server:
        response = await get(server, path, token="", **headers)
        assert (response.code, response.body) == (401, f"401: {http.NO_TOKEN}\n".encode())


Connection = tuple[asyncio.StreamReader, asyncio.StreamWriter]


async def connect(
    server: Server, request: bytes = b"", count: int = http.MAX_CONNECTIONS
) -> list[Connection]:
    """Open connections to a server, each of which sends the request."""
    connections = [
        await asyncio.open_connection("127.0.0.1", server.port, limit=1024) for _ in range(count)
    ]
    for _, writer in connections:
        writer.write(request)
    return connections


def end(*connections: Connection) -> None:
    for _, writer in connections:
        writer.close()


async def test_connections_without_token_leave_place(recorded: Path) -> None:
    """A new connection takes the place of the oldest connection without the token.

    The page is served at all times.
    """
    async with serving(recorded) as server:
        idle = await connect(server, count=1000)
        assert (await get(server, "/data/0")).code == 200
        limit = http.MAX_CONNECTIONS + http.RESERVED
        for reader, _ in idle[: len(idle) - limit]:
            assert await rest_of(reader) == b""  # closed
        assert not any(reader.at_eof() for reader, _ in idle[2 - limit :])
        end(*idle)


async def rest_of(reader: asyncio.StreamReader) -> bytes:
    """Return what arrives until the server closes.

    The server resets a connection if it leaves bytes unread.
    """
    try:
        return await reader.read()
    except ConnectionResetError:
        return b""


async def test_slow_or_long_request_closed(recorded: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(http, "REQUEST_TIMEOUT", 0.3)

    async with serving(recorded) as server:
        reader, writer = await asyncio.open_connection("127.0.0.1", server.port)

        async def drip() -> None:
            for byte in b"GET / HTTP/1.1\r\n" + b"X: y\r\n" * 10_000:
                writer.write(bytes([byte]))
                await asyncio.sleep(0.05)

        slow = asyncio.ensure_future(drip())
        assert await rest_of(reader) == b""
        slow.cancel()
        writer.close()
        reader, writer = await asyncio.open_connection("127.0.0.1", server.port)
        writer.write(b"GET /" + b"a" * (2 * http.MAX_REQUEST_BYTES) + b" HTTP/1.1\r\n")
        assert (await rest_of(reader))[:12] in {b"", b"HTTP/1.1 400"}
        writer.close()


async def test_browser_waits_for_next_samples(
    recorded: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A browser that knows all rows gets the next samples as the answer."""
    content = (recorded / "run_0.mcap").read_bytes()
    path = tmp_path / "run_0.mcap"
    path.write_bytes(content[: len(content) // 2])

    async with serving(tmp_path) as server:
        rows: dict[str, int] = {}
        head: dict[str, Any] = {}
        while head.get("state") != "ended":
            known = {"epoch": head.get("epoch", ""), "state": head.get("state", ""), **rows}
            query = "&".join(f"{name}={value}" for name, value in known.items())
            head, columns = decoded((await get(server, f"/data/0?{query}")).body)
            for name, (t, _) in columns.items():
                rows[name] = rows.get(name, 0) + len(t)
            path.write_bytes(content)
        assert rows == {name: samples.count for name, samples in server.flights[0].samples.items()}


async def stream(server: Server, token: str | bytes = TOKEN) -> WebSocketClientConnection:
    """Open a WebSocket as the page does."""
    address = f"127.0.0.1:{server.port}"
    opened = await websocket_connect(
        HTTPRequest(f"ws://{address}/news/0", headers={"Origin": f"http://{address}"})
    )
    await opened.write_message(token, binary=isinstance(token, bytes))
    return opened


async def whole_log(server: Server) -> None:
    """Wait until the server has read the log to its end."""
    while server.flights[0].state() != "ended":
        await asyncio.sleep(0.01)


async def left(server: Server) -> None:
    """Wait until all WebSockets are closed."""
    while server.streams:
        await asyncio.sleep(0.01)


UPGRADE = {
    "Connection": "Upgrade",
    "Upgrade": "websocket",
    "Sec-WebSocket-Key": "AAAAAAAAAAAAAAAAAAAAAA==",
}
UPGRADE |= {"Sec-WebSocket-Version": "13"}  # RFC 6455, 4.1


async def test_websocket_answers_and_waits_for_news(recorded: Path) -> None:
    """A message is answered in the same way as a request by HTTP."""
    async with serving(recorded) as server:
        await whole_log(server)  # else the second answer may have more rows than the first
        socket = await stream(server)
        await socket.write_message("")
        first = (await get(server, "/data/0")).body
        assert await socket.read_message() == first
        head, columns = decoded(first)
        rows = "&".join(f"{name}={len(t)}" for name, (t, _) in columns.items())
        state = "&".join(f"{key}={head[key]}" for key in ("epoch", "state", "described"))
        known = f"{state}&events={len(head['events'])}&{rows}"
        begin = time.monotonic()
        await socket.write_message(known)
        content = await socket.read_message()
        assert isinstance(content, bytes)
        head, columns = decoded(content)
        assert time.monotonic() - begin >= http.MAX_WAIT
        assert (columns, head["events"], "flight" in head) == ({}, [], False)
        socket.close()


@pytest.mark.parametrize(
    "path, headers, expected",
    [
        ("/news/0", {"Host": "evil.example"}, 403),
        ("/news/0", {"Origin": "http://evil.example"}, 403),
        ("/news/0", {"Origin": "http://["}, 403),
        ("/news/0", {"Origin": ""}, 403),  # none is sent
        ("/news/1", {}, 404),
    ],
)
async def test_foreign_websocket_refused(
    path: str, headers: dict[str, str], expected: int, recorded: Path
) -> None:
    """A WebSocket from a foreign page or host, or for an unknown flight, is refused."""
    async with serving(recorded) as server:
        given = UPGRADE | {"Origin": f"http://127.0.0.1:{server.port}"} | headers
        assert (
            await get(server, path, **{name: text for name, text in given.items() if text})
        ).code == expected


@pytest.mark.parametrize("token", ["", b"another", "epoch=&y=0"])
async def test_websocket_whose_first_message_is_not_the_token_closed(
    token: str | bytes, recorded: Path
) -> None:
    async with serving(recorded) as server:
        socket = await stream(server, token)
        await socket.write_message("")
        assert await socket.read_message() is None
        assert (socket.close_code, socket.close_reason) == (1008, http.NO_TOKEN)
        socket.close()


async def test_idle_or_surplus_websockets_closed(
    recorded: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """WebSockets without a request are closed, and so are WebSockets beyond the limit."""
    async with serving(recorded) as server:
        sockets = [await stream(server) for _ in range(http.MAX_CONNECTIONS)]
        surplus = await stream(server)
        assert await surplus.read_message() is None
        assert (surplus.close_code, surplus.close_reason) == (1013, http.FULL)
        surplus.close()
        for websocket in sockets:
            websocket.close()
        await left(server)
        monkeypatch.setattr(http, "REQUEST_TIMEOUT", 0.3)
        silent = await stream(server)
        assert await silent.read_message() is None
        await left(server)
        silent.close()


async def test_websocket_without_reader_gets_few_answers(
    recorded: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """A WebSocket sends requests and reads no answer.

    The server makes few answers, closes the WebSocket, and ends quietly.
    """
    made: list[bytes] = []

    def big(*_: object, **__: object) -> bytes:
        made.append(b"")
        return bytes(1 << 20)

    monkeypatch.setattr(http, "answer", big)

    browser = socket.socket()
    async with serving(recorded) as server:
        browser.connect(("127.0.0.1", server.port))
        address = f"127.0.0.1:{server.port}"
        head = {"Host": address, "Origin": f"http://{address}"} | UPGRADE
        browser.sendall(
            "\r\n".join(
                ["GET /news/0 HTTP/1.1", *(f"{k}: {v}" for k, v in head.items()), "", ""]
            ).encode()
        )
        browser.sendall(bytes([0x81, 0x80 | len(TOKEN), 0, 0, 0, 0]) + TOKEN.encode())
        # Empty texts with a mask, RFC 6455, 5.2.
        browser.sendall(bytes([0x81, 0x80, 0, 0, 0, 0]) * 10_000)
        while not made:
            await asyncio.sleep(0.01)
        before = -1
        while before < len(made):
            before = len(made)
            await asyncio.sleep(2.0 * http.STATE_PERIOD)
        assert len(made) <= 20  # of 1 MiB: what the buffers of the network hold
        monkeypatch.setattr(http, "REQUEST_TIMEOUT", 0.3)
        await left(server)

    browser.close()
    assert caplog.records == []


async def test_the_server_listens_on_this_host_alone(recorded: Path) -> None:
    async with serving(recorded) as server:
        with socket.socket() as other:
            other.settimeout(5.0)
            assert other.connect_ex(("127.0.0.2", server.port)) != 0
        with pytest.raises(OSError, match="in use"):
            Server([], TOKEN).listen(server.port)


# Which run


def test_recording_run_is_chosen_first(recorded: Path, tmp_path: Path) -> None:
    """If no run is being recorded, the last run is chosen."""
    for name in ("20260101T000000Z-a", "20260102T000000Z-b", "20260103T000000Z-c"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "run_0.mcap").write_bytes(b"")
    (tmp_path / "latest").symlink_to("20260101T000000Z-a")
    assert newest_run(tmp_path).name == "20260101T000000Z-a"
    with (tmp_path / "20260102T000000Z-b" / "run_0.mcap").open("rb") as recorder:
        assert try_lock(recorder)
        assert newest_run(tmp_path).name == "20260102T000000Z-b"
        with (tmp_path / "20260103T000000Z-c" / "run_0.mcap").open("rb") as second:
            assert try_lock(second)
            assert [folder.name[-1] for folder in runs_in_recording(tmp_path)] == ["c", "b"]
            assert runs_in_recording(tmp_path, "uav1") == []


def test_run_in_recording_counts_once_beside_its_link(tmp_path: Path) -> None:
    """The recorder of nodes that were started one by one links `latest` when it starts."""
    run = tmp_path / "20260101T000000Z-recording"
    run.mkdir()
    (run / "run_0.mcap").write_bytes(b"")
    (tmp_path / "latest").symlink_to(run.name)
    with (run / "run_0.mcap").open("rb") as recorder:
        assert try_lock(recorder)
        assert runs_in_recording(tmp_path) == [run]


def test_aircraft_of_one_log_are_a_fleet(tmp_path: Path) -> None:
    """One answer has the places of both aircraft.

    The page of the second one shows only its own samples, without a note.
    """
    with BagWriter(tmp_path) as bag:
        for name, east in (("uav1", 1.0), ("uav2", 2.0)):
            for topic, names in (("y", ["q", "V"]), ("pose", ["north", "east"])):
                bag.write(
                    bag.add_topic(f"/{name}/{topic}", JOINT_STATE, ""),
                    5,
                    5,
                    0,
                    vector(5, names, [0.0, east]),
                )
    flights = [Flight(tmp_path, namespace=name) for name in namespaces(tmp_path)]
    server = Server(flights, TOKEN, fleet=True)
    for flight in flights:
        flight.update()
    head, columns = decoded(server.answer(server.flights[2], {}))
    assert (head["flight"], head["start"]) == ({"aircraft": [["uav1", 5e-9], ["uav2", 5e-9]]}, 5e-9)
    assert {name: values[0, 1] for name, (_, values) in columns.items()} == {"0": 1.0, "1": 2.0}
    head, columns = decoded(server.answer(server.flights[1], {}))
    assert (head["fleet"], head["ghost"], head["faults"], columns["pose"][1][0, 1]) == (
        2,
        False,
        [],
        2.0,
    )


# The command


def command(*words: object) -> list[str]:
    return [sys.executable, "-m", "flight_cli.cli", *map(str, words)]


@pytest.mark.parametrize(
    "ignored", [False, True], ids=["in front", "in the background, with SIGINT ignored"]
)
def test_watch_prints_address_until_ctrl_c(recorded: Path, ignored: bool) -> None:
    """The command ends quietly with Ctrl-C."""
    before = ["/bin/sh", "-c", 'trap "" INT; exec "$@"', "sh"] if ignored else []
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    with subprocess.Popen([*before, *command("watch", recorded, "--port", 0)], **pipes) as process:  # type: ignore[call-overload]
        address = process.stdout.readline()
        tunnel = process.stdout.readline()
        assert re.fullmatch(r"http://127\.0\.0\.1:\d+/#token=[\w-]{20,}\n", address)
        port = address.split(":")[2].partition("/")[0]
        assert f"ssh -L {port}:127.0.0.1:{port} " in tunnel
        sockets = psutil.Process(process.pid).net_connections()
        # No UDP: no ROS.
        assert [(connection.type, connection.laddr.ip) for connection in sockets] == [
            (socket.SOCK_STREAM, "127.0.0.1")
        ]
        process.send_signal(signal.SIGINT)
        assert process.wait(20.0) == 0
        assert process.stderr.read() == ""


def test_terminal_shows_newest_values_in_units_of_report(recorded: Path, tape: Tape) -> None:
    console = Console(width=120, record=True, file=io.StringIO())
    flight = Flight(recorded)
    console.print(picture(flight))  # before there is a sample
    flight.update()
    console.print(picture(flight))
    text = console.export_text()
    assert "run  WAITING" in text
    assert "run  ENDED  ENGAGED  t = 2.0 s" in text
    rows = {
        line.split()[0]: line.split()[2:]
        for line in text.splitlines()
        if re.match(r" (q|elevator) ", line)
    }
    assert rows["q"][0] == f"{1e3 * tape['internals']['y.q'][-1]:.3f}"
    assert rows["elevator"][0] == f"{np.degrees(tape['internals']['u.elevator'][-1]):.3f}"
    assert "0.00 s  mode: ENGAGED" in text


def test_page_without_a_free_port_names_the_ports(tmp_path: Path) -> None:
    with socket.create_server((http.ADDRESS, 0)) as taken:
        port = taken.getsockname()[1]
        with refusing(
            rf"^--port: {port} cannot be used \(Address already in use\), expected a free port"
        ):
            serve([Flight(tmp_path)], [port], print)
    with refusing(r"^--port: found no port, expected a free port of this host$"):
        serve([Flight(tmp_path)], [], print)
