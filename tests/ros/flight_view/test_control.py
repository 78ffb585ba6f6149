# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test the control of a real flight over the page's server.

Gains, faults, a gust and the controller are changed, are in the log, and are replayed.
"""

import json
import re
import urllib.request
from collections.abc import Callable
from http import HTTPStatus
from pathlib import Path
from typing import Any
from urllib.error import HTTPError

from tests.conftest import invoke
from tests.ros.conftest import Process, Start
from tests.ros.flight_bringup.test_lockstep import AT_200_HZ, scenario_file
from tests.ros.peer import Peer
from tests.ros.waiting import until

from flight_core.outcome import STATUS_SHORTFALL
from flight_log.stored_messages import parameter_changes
from flight_log.tape_reader import read_run
from flight_view.flight import Flight

PEER_TOPICS = ("truth",)


class Page:
    """A page that posts requests."""

    def __init__(self, address: str, key: str) -> None:
        self._base, _, token = address.partition("#token=")
        self._headers = {
            "Origin": self._base.rstrip("/"),
            "Content-Type": "application/json",
            "X-Control-Key": key,
        }
        self._headers["X-Page-Token"] = token

    def post(self, do: str, **request: Any) -> tuple[int, dict[str, Any]]:
        """Status and answer of a request, which is sent again where the server limits the rate."""
        status, content = until(
            lambda: self._answer(do, **request), "an answer within the rate limit"
        )
        self._headers["X-Control-Lease"] = content.get(
            "lease", self._headers.get("X-Control-Lease", "")
        )
        return status, content

    def _answer(self, do: str, **request: Any) -> tuple[int, dict[str, Any]] | None:
        body = json.dumps({"do": do, **request}).encode()
        try:
            http_request = urllib.request.Request(f"{self._base}control", body, self._headers)  # noqa: S310 - http of this host
            with urllib.request.urlopen(http_request) as response:  # noqa: S310 - as above
                return response.status, json.loads(response.read())
        except HTTPError as error:
            answer = error.code, json.loads(error.read())
            return None if error.code == HTTPStatus.TOO_MANY_REQUESTS else answer

    def until(self, flight: Process, **expected: Any) -> dict[str, Any]:
        """Request the state until it has these values."""
        return self._until(flight, lambda found: found | expected == found)

    def until_flown(self, flight: Process) -> dict[str, Any]:
        """Request the state until the log has the controller's digest that the page knows."""
        return self._until(
            flight, lambda found: "digest" in found and found["digest"] == found["logged"]
        )

    def _until(
        self, flight: Process, is_expected: Callable[[dict[str, Any]], bool]
    ) -> dict[str, Any]:
        state: dict[str, Any] = {}

        def as_expected() -> bool:
            nonlocal state
            state = self.post("state")[1]
            return is_expected(state)

        flight.until(as_expected, "the state that the page expects")
        return state


def test_flight_commanded_from_page_recorded_and_replayed(
    start: Start, tmp_path: Path, peer_node: Peer
) -> None:
    scenario = scenario_file(tmp_path, 1e4, "osprey_gust", **AT_200_HZ)
    flight = start("flight_cli.cli", "fly", str(scenario), "--real-time")  # ended below
    flight.wait_for_log(tmp_path / "runs", 20_000)
    run = next(
        path for path in (tmp_path / "runs").iterdir() if path.is_dir() and not path.is_symlink()
    )
    watch = start("flight_cli.cli", "watch", str(run), "--control", "--port", "0").wait_for(
        "http://"
    )
    key = next(line for line in watch.lines if line.startswith("control key: ")).rpartition(" ")[2]
    page = Page(next(line for line in watch.lines if line.startswith("http://")), key)
    page.until(flight, nodes=["aircraft", "controller"])
    state = page.until_flown(flight)
    k_g = next(gain["values"][0] for gain in state["gains"] if gain["name"] == "k_g")

    status, reply = page.post(
        "gains", digest=state["digest"], values={"k_g": [1.2 * k_g], "softening": [2.5]}
    )
    assert (status, reply["undo"]) == (200, 1), reply
    page.until(flight, logged=reply["digest"])  # the controller flies them
    assert page.post("gains", digest=state["digest"], values={"k_g": [k_g]})[0] == 409
    assert page.post("gains", digest=reply["digest"], values={"k_g": [3.0 * k_g]})[0] == 400
    status, undone = page.post("undo", digest=reply["digest"])
    assert (status, undone["digest"]) == (200, state["digest"])
    page.until(flight, logged=state["digest"])

    assert page.post("fault", values={"sensors.bias": [0.01, 0.0, 0.0, 0.0]})[0] == 200
    assert page.post("fault", values={"actuators.faults": ["rudder stuck 0"]})[0] == 200
    # 4 s: a pause of the host hides no gust
    assert page.post("gust", axis="vertical", speed=3.0, length=100.0)[0] == 200
    truth = peer_node.received["truth"]
    peer_node.until(
        lambda: any(
            message.position[message.name.index("gust.vertical")] > 2.0 for message in truth[-1:]
        ),
        "a gust in the truth",
    )
    status, reply = page.post("fault", values={"sensors.dropout": 2.0})
    assert (status, "sensors.dropout" in reply["refused"]) == (422, True)
    assert page.post("deactivate")[0] == 200
    assert page.post("activate")[0] == 200
    flight.interrupt()
    assert flight.end() == 130, flight.output
    assert watch.interrupt().end() == 0, watch.output

    changes = parameter_changes(
        run, "/aircraft", {"actuators": None, "sensors": None, "gusts": None}
    )
    assert [sorted(change) for change in changes[-3:]] == [
        ["sensors.bias"], ["actuators.faults"],
        ["gusts.vertical.length", "gusts.vertical.speed", "gusts.vertical.start"],
    ]  # fmt: skip
    log = Flight(run)
    log.update()
    requests = [event.text for event in log.events if event.kind == "control"]
    assert [(re.findall(r"'do': '(\w+)'", text)[0], "refused: " in text) for text in requests] == [
        ("gains", False), ("gains", True), ("gains", True), ("undo", False), ("fault", False),
        ("fault", False),
        ("gust", False), ("fault", True), ("deactivate", False), ("activate", False),
    ]  # fmt: skip
    tape = read_run(run).tape
    assert abs(tape["truth"]["gust.vertical"]).max() > 2.0
    assert abs(tape["truth"]["noise.q"][-1] - 0.01) < 1e-9
    replayed = invoke("replay", run, "--json")
    result = json.loads(replayed.output)
    assert result["equal"], replayed.output
    # On a busy host samples are missing, which the log says; every tick that is there is equal.
    is_starved = any(note.startswith("this host is too busy") for note in result["notes"])
    assert replayed.exit_code in {0, STATUS_SHORTFALL if is_starved else 0}, replayed.output
