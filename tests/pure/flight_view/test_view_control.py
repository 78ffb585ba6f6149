# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test control from the page without ROS.

The tests cover who is refused, what is bounded, compare and set, undo, and the lease.
"""

import asyncio
import json
import threading
from collections.abc import Callable, Coroutine, Iterator, Mapping
from pathlib import Path
from typing import Any

import pytest
from tests.view_link import InTheAir, NodesInMemory
from tornado.httpclient import AsyncHTTPClient, HTTPResponse

from flight_analysis.closed_loop.scenario import Scenario
from flight_analysis.closed_loop.scenario_library import find_scenario
from flight_analysis.linear_loop.loop_margins import delay_margins
from flight_view.control import BURST, KEY_PERIOD, LEASE, Control, gains_of, new_key
from flight_view.request_values import RefusedError
from flight_view.server import TOKEN_HEADER, Server
from rise_di_controller.params import ControllerConfig

pytestmark = pytest.mark.slow

KEY, TOKEN = "ABCD-EFGH", "a-token"
ALL = ("aircraft", "controller", "guidance")


class Desk:
    """The control of a recorded flight, with nodes in memory and a time that the test sets."""

    def __init__(
        self, run: Path, scenario: Scenario, *names: str, dry_run: bool = True, real: bool = False
    ) -> None:
        self.time = 0.0
        self.flight, self.nodes = (
            InTheAir(run),
            NodesInMemory(scenario, *(names or ALL), dry_run=dry_run),
        )
        self.flight.update()
        self.control = Control(
            self.flight, self.nodes, KEY, real=real, assess=delay_margins, now=lambda: self.time
        )
        self.lease = ""

    async def ask(
        self, do: str, key: str = KEY, lease: str | None = None, **request: Any
    ) -> dict[str, Any]:
        """Return the answer to a request, one second after the last one."""
        self.time += 1.0
        result = await self.control.answer(
            {"do": do, **request}, key, self.lease if lease is None else lease
        )
        self.lease = result.get("lease", self.lease)
        return result

    async def refused(self, do: str, **request: Any) -> tuple[int, str]:
        """Return the status and the sentence of a refusal."""
        with pytest.raises(RefusedError) as caught:
            await self.ask(do, **request)
        return int(caught.value.status), caught.value.sentence


def with_desk(desk: Desk, steps: Callable[[Desk], Coroutine[Any, Any, None]]) -> None:
    """Run the steps of a test, and end the desk."""
    try:
        asyncio.run(asyncio.wait_for(steps(desk), 60.0))
    finally:
        desk.control.close()


@pytest.fixture
def desk(recorded: Path, osprey_gust: Scenario) -> Iterator[Desk]:
    made = Desk(recorded, osprey_gust)
    yield made
    made.control.close()


async def test_gains_set_together_seen_in_log_and_undone(desk: Desk, osprey_gust: Scenario) -> None:
    base = osprey_gust.controller

    state = await desk.ask("state")
    assert {gain["name"]: tuple(gain["values"]) for gain in state["gains"]}["beta"] == base.beta  # type: ignore[attr-defined]
    assert {gain["name"]: gain["ranges"] for gain in state["gains"]}["k_g"] == [
        [0.5 * base.k_g, 2.0 * base.k_g]  # type: ignore[attr-defined]
    ]
    assert state["digest"] == state["logged"] == f"{base.digest():012x}"
    changed = await desk.ask(
        "gains",
        digest=state["digest"],
        values={"k_g": [1.2 * base.k_g], "softening": [2.0]},  # type: ignore[attr-defined]
    )
    assert (changed["undo"], changed["logged"]) == (1, state["digest"])  # the log is that of before
    assert changed["digest"] != state["digest"]
    assert desk.nodes.values["controller"]["k_g"] == 1.2 * base.k_g  # type: ignore[attr-defined]
    assert desk.nodes.notes[-1].startswith("control: ")
    assert "k_g" in desk.nodes.notes[-1]
    undone = await desk.ask("undo", digest=changed["digest"])
    assert (undone["undo"], undone["digest"]) == (0, state["digest"])
    assert await desk.refused("undo", digest=undone["digest"]) == (422, "there is nothing to undo")


async def test_set_after_foreign_change_refused(desk: Desk) -> None:
    """Values cannot be set after another program has changed them."""
    digest = (await desk.ask("state"))["digest"]
    desk.nodes.values["controller"]["k_g"] *= 1.1
    status, sentence = await desk.refused("gains", digest=digest, values={"k_g": [1.0]})
    assert (status, sentence) == (
        409,
        "the parameters have been changed meanwhile: look at them, then apply again",
    )
    assert desk.nodes.notes == [
        f"control: {{'do': 'gains', 'values': {{'k_g': [1.0]}}}} refused: {sentence}"
    ]


async def test_invalid_gain_refused(desk: Desk, osprey_gust: Scenario) -> None:
    """A gain beyond the range, an unknown name and a value that is not a number are refused."""
    k_g = gains_of(osprey_gust.controller)["k_g"]

    digest = (await desk.ask("state"))["digest"]
    before = dict(desk.nodes.values["controller"])
    for values, expected in (
        ({"k_g": [2.1 * k_g]}, f"k_g: found {2.1 * k_g:g}, expected {0.5 * k_g:g} to {2 * k_g:g}"),
        ({"k_g": [-1.0]}, "k_g: found -1, expected"),
        ({"k_g": [True]}, "'k_g': found True, expected a number"),
        ({"k_g": [k_g, k_g]}, "k_g: found 2 values, expected 1"),
        ({"D": [1, 1, 1, 1]}, "'D': no gain, expected one of"),
        ({}, "values: expected values by name"),
    ):
        status, sentence = await desk.refused("gains", digest=digest, values=values)
        assert status == 400
        assert sentence.startswith(expected)
    assert desk.nodes.values["controller"] == before


async def test_wrong_key_refused_and_delays_next_one(desk: Desk) -> None:
    assert (await desk.refused("deactivate", key="ABCD-EFGX"))[0] == 403
    assert desk.nodes.notes == []  # who lacks the key does not fill the log
    desk.time -= 1.0  # the next request comes at the same time
    assert (await desk.refused("state"))[0] == 429
    assert await desk.ask("state", key="abcdefgh")  # as typed
    assert (await desk.refused("state", key="ABCD-EFGX", lease="another"))[0] == 403
    desk.time -= 1.0
    assert await desk.ask("state")  # the page that has control is not delayed
    assert len({new_key() for _ in range(100)}) == 100


async def test_one_page_controls_until_its_lease_ends(desk: Desk) -> None:
    first = (await desk.ask("state"))["lease"]
    assert (await desk.refused("state", lease="another"))[0] == 423
    assert (await desk.ask("hold"))["lease"] == first
    desk.time += LEASE
    assert (await desk.ask("state", lease="another"))["lease"] != first


async def test_commands_reach_guidance(desk: Desk) -> None:
    """Targets, routes and services reach guidance, and its refusals come back."""
    await desk.ask("target", values={"heading": 1.5, "altitude": 60})
    await desk.ask("route", points=[[0, 0, 50], [500, 0, 60.5]])
    await desk.ask("hold")
    assert desk.nodes.done == [
        ("target", {"heading": 1.5, "altitude": 60.0}),
        ("route", [[0.0, 0.0, 50.0], [500.0, 0.0, 60.5]]), ("hold", None),
    ]  # fmt: skip
    assert await desk.refused("skip") == (422, "no route with a further leg is flown")
    assert (await desk.refused("target", values={"bank": 1.0}))[0] == 400
    for points in (
        [[0, 0, 0]],
        [[0, 0], [1, 1]],
        "north",
        [["a", 0, 0], [0, 0, 0]],
        [[0, 0, None], [0, 0, 0]],
    ):
        assert (await desk.refused("route", points=points))[0] == 400
    assert (await desk.refused("fly"))[0] == 400


async def test_faults_and_gusts_become_parameters_of_aircraft(desk: Desk) -> None:
    state = await desk.ask("state")
    assert state["aircraft"]["axes"] == ["vertical", "lateral", "longitudinal"]
    stuck = ["elevator stuck 0"]
    changed = await desk.ask("fault", values={"actuators.faults": stuck, "sensors.dropout": 0.2})
    assert changed["faults"]["sensors.dropout"] == 0.2
    assert desk.nodes.values["aircraft"]["actuators.faults"] == stuck
    await desk.ask("fault", values={"actuators.faults": []})
    assert desk.nodes.values["aircraft"]["actuators.faults"] == []
    assert desk.nodes.values["aircraft"]["sensors.dropout"] == 0.2
    desk.nodes.values["aircraft"]["sensors.bias"] = [0.0, 0.0, 0.0, 0.3]  # by another program
    assert (await desk.ask("state"))["faults"]["sensors.bias"] == [0.0, 0.0, 0.0, 0.3]
    await desk.ask("gust", axis="lateral", speed=3, length=20)
    assert desk.nodes.values["aircraft"]["gusts.lateral.start"] == pytest.approx(
        desk.flight.end + 0.2
    )
    for do, request, expected in (
        ("fault", {"values": {"sensors.dropout": 2.0}}, 422),
        ("fault", {"values": {"rate": 100.0}}, 400),
        ("gust", {"axis": "sideways", "speed": 3, "length": 20}, 422),
        ("gust", {"axis": "\ud800", "speed": 3, "length": 20}, 400),
        ("gust", {"axis": "lateral", "speed": None, "length": 20}, 400),
    ):
        assert (await desk.refused(do, **request))[0] == expected


def test_gains_of_bridge_that_sends_need_further_option(
    recorded: Path, osprey_gust: Scenario
) -> None:
    async def steps(desk: Desk) -> None:
        state = await desk.ask("state")
        assert state["bridge"] == {"map": "plane", "sends": True}
        status, sentence = await desk.refused(
            "gains", digest=state["digest"], values={"k_g": [1.0]}
        )
        assert (status, sentence) == (
            403,
            "the bridge sends to an autopilot: gains need rise-di watch --control --real",
        )

    async def allowed(desk: Desk) -> None:
        state = await desk.ask("state")
        gain = desk.nodes.values["controller"]["k_g"]
        await desk.ask("gains", digest=state["digest"], values={"k_g": [0.9 * gain]})

    with_desk(Desk(recorded, osprey_gust, "bridge", "controller", dry_run=False), steps)
    with_desk(Desk(recorded, osprey_gust, "bridge", "controller", dry_run=True), allowed)
    with_desk(
        Desk(recorded, osprey_gust, "bridge", "controller", dry_run=False, real=True), allowed
    )


def test_bridge_engages_by_map_name(recorded: Path, osprey_gust: Scenario) -> None:
    """A request to engage can be withdrawn while it waits."""

    async def steps(desk: Desk) -> None:
        await desk.ask("state")
        assert (await desk.refused("engage", map="copter"))[0] == 400
        waiting = asyncio.ensure_future(desk.refused("engage", map="plane"))
        await asyncio.get_running_loop().run_in_executor(None, desk.nodes.blocked.wait, 20.0)
        await desk.ask("disengage")
        assert await waiting == (422, "cancelled by a later request")
        assert desk.nodes.done == [("disengage", None)]
        assert "cancelled by a later request" in desk.nodes.notes[-2]

    with_desk(Desk(recorded, osprey_gust, "bridge", "controller"), steps)


async def test_margins_do_not_delay_deactivation(desk: Desk) -> None:
    begun = threading.Event()
    end = threading.Event()

    def assess(scenario: Scenario, params: ControllerConfig) -> dict[str, Any]:
        begun.set()
        return {"in time": end.wait(20.0)}

    desk.control = Control(desk.flight, desk.nodes, KEY, assess=assess, now=lambda: desk.time)
    await desk.ask("state")
    margins = asyncio.ensure_future(desk.ask("check", values={"k_g": [1.0]}))
    await asyncio.get_running_loop().run_in_executor(None, begun.wait, 20.0)
    await desk.ask("deactivate")
    end.set()
    assert await margins == {"in time": True}
    assert desk.nodes.done == [("activate", False)]


# Actions by state

VALUES = {"k_g": [1.1 * find_scenario("osprey_gust").controller.k_g]}  # type: ignore[attr-defined]
REQUESTS: Mapping[str, Mapping[str, Any]] = {
    "state": {},
    "check": {"values": VALUES},
    "gains": {"values": VALUES},
    "undo": {},
    "fault": {"values": {"sensors.dropout": 0.2}},
    "gust": {"axis": "lateral", "speed": 3, "length": 20},
    "target": {"values": {"heading": 1.5}},
    "route": {"points": [[0, 0, 50], [500, 0, 60]]},
    "hold": {},
    "skip": {},
    "resume": {},
    "home": {},
    "activate": {},
    "deactivate": {},
    "engage": {"map": "plane"},
    "disengage": {},
}
OVER = ("ended", "interrupted")
ALLOWED_AFTER_END = ("state", "check", "deactivate", "disengage")
NOTHING_TO_DO = ("undo", "skip")  # 422: no change to undo, no further leg


@pytest.mark.parametrize("action", REQUESTS)
@pytest.mark.parametrize("state", ["reading", "recording", *OVER])
async def test_action_by_key_lease_rate_and_state(
    state: str, action: str, recorded: Path, osprey_gust: Scenario, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The table has a cell for who asks, for which action, in which state of the flight."""
    desk = Desk(
        recorded,
        osprey_gust,
        "aircraft",
        "controller",
        "guidance",
        *(["bridge"] if "engage" in action else []),
    )
    monkeypatch.setattr(desk.flight, "state", lambda: state)
    monkeypatch.setattr(desk.nodes, "engage", lambda: "")
    digest = ""

    async def status(key: str = KEY, lease: str = "") -> int:
        try:
            await desk.control.answer(
                {"do": action, "digest": digest, **REQUESTS[action]}, key, lease or desk.lease
            )
        except RefusedError as error:
            return int(error.status)
        return 200

    digest = (await desk.ask("state"))["digest"]
    refused = 409 if state in OVER and action not in ALLOWED_AFTER_END else 0
    assert await status(key="ABCD-EFGX") == 403
    desk.time += 5.0 * KEY_PERIOD
    desk.lease = (await desk.ask("state"))["lease"]
    assert await status(lease="another") == (refused or 423)
    assert desk.nodes.done == []
    desk.time += BURST
    for _ in range(int(BURST)):
        await desk.ask("state")
        desk.time -= 1.0
    assert await status() == (200 if action in {"deactivate", "disengage"} else 429)
    desk.time += 2.0
    assert await status() == (refused or (422 if action in NOTHING_TO_DO else 200))
    desk.control.close()


# Over HTTP


async def post(server: Server, body: object, **headers: str) -> HTTPResponse:
    """Send a request of the page with some changed headers. An empty one is left out."""
    own = {
        TOKEN_HEADER: TOKEN,
        "Origin": f"http://127.0.0.1:{server.port}",
        "Content-Type": "application/json",
        "X-Control-Key": KEY,
    }
    given = {name: value for name, value in (own | headers).items() if value}
    return await AsyncHTTPClient(force_instance=True).fetch(
        f"http://127.0.0.1:{server.port}/control",
        method="POST",
        headers=given,
        body=body if isinstance(body, str) else json.dumps(body),
        raise_error=False,
        request_timeout=60.0,
    )


async def test_request_needs_token_origin_type_and_key(desk: Desk) -> None:
    server = Server([desk.flight], TOKEN, desk.control)
    server.listen(0)
    port = server.port
    state = {"do": "state"}
    try:
        for body, headers, expected in (
            (state, {TOKEN_HEADER: ""}, 401),
            (state, {"Origin": ""}, 403),
            (state, {"Origin": "null"}, 403),
            (state, {"Origin": f"http://127.0.0.1.evil.example:{port}"}, 403),
            (state, {"Origin": f"http://127.0.0.1:{port + 1}"}, 403),
            (state, {"Origin": f"https://127.0.0.1:{port}"}, 403),
            (state, {"Origin": f"http://localhost:{port}"}, 403),  # the page has the other name
            (state, {"Content-Type": "text/plain"}, 415),
            (state, {"Content-Type": "application/x-www-form-urlencoded"}, 415),
            ("{", {}, 400),
            ("[" * 5000, {}, 400),
            ('{"do": NaN}', {}, 400),
            ([], {}, 400),
            (state, {"X-Control-Key": ""}, 403),
        ):
            assert (await post(server, body, **headers)).code == expected, (body, headers)
        desk.time += 10.0
        good = await post(server, state)
        assert (good.code, json.loads(good.body)["nodes"]) == (200, list(ALL))
        held = await post(server, state)
        assert (held.code, "another page" in json.loads(held.body)["refused"]) == (423, True)
        assert (
            await post(server, state, **{"X-Control-Lease": json.loads(good.body)["lease"]})
        ).code == 200
    finally:
        await server.close()
