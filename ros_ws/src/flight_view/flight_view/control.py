# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Check and carry out the commands of a page to a flight, without ROS.

A `FlightLink` reaches the nodes. Only one page at a time has control, which it holds as a lease.
Requests run one after another on a separate thread. A request to deactivate the controller or to
disengage the bridge ends the request that is running.
"""

import asyncio
import hmac
import math
import secrets
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from functools import partial
from http import HTTPStatus
from pathlib import Path
from typing import Any, Protocol

from flight_analysis.closed_loop.scenario import Scenario
from flight_core.fields import short_repr
from flight_core.outcome import Refusal
from flight_core.parameters import ParameterError, flatten, nest
from flight_core.rates import NANOSECONDS
from flight_guidance.guidance_state import TARGETS
from flight_view.flight import Flight
from flight_view.request_values import (
    RefusedError,
    as_list,
    finite_number,
    finite_numbers,
    is_sentences,
    like_parameter,
    permitted_range,
    require_form,
    require_known,
    require_range,
    values_by_name,
)
from rise_di_controller.params import ControllerConfig

LEASE = 5.0  # time for which a page keeps control after its last request, s
RATE = 5.0  # permitted requests per second
BURST = 10.0  # permitted requests at once
KEY_PERIOD = 1.0  # least time between two wrong keys, s
MAX_WAYPOINTS = 200
AXES = ("north", "east", "altitude")  # coordinates of a waypoint
GUIDED = ("hold", "skip", "resume", "home")  # services of guidance without arguments
AT_ONCE = ("deactivate", "disengage")  # actions that do not wait for other requests
OVER = (
    "ended",
    "interrupted",
)  # states of a recording in which the flight can no longer be commanded
# Time from the request to the beginning of a gust, s. If a busy host is too late for the first
# value, the second is tried.
GUST_LEADS = (0.2, 1.0)
# Larger stamps come from the system clock. The stamps of a flight in lockstep begin at 0.
SYSTEM_TIME_NS = 10**17

Assess = Callable[[Scenario, ControllerConfig], dict[str, Any]]


class FlightLink(Protocol):
    """A link to the nodes of a flight.

    A method that commands something returns why it is refused, or None. All methods may raise
    ParameterError.
    """

    def nodes(self) -> list[str]:
        """Return the running nodes that can be commanded."""

    def parameters(self, node: str, names: Sequence[str]) -> dict[str, Any]:
        """Return the values of the node's parameters `names`, without those that are not set."""

    def set_parameters(self, node: str, values: Mapping[str, Any]) -> Refusal | None:
        """Set all of these parameters of a node, or none of them."""

    def activate(self, *, active: bool) -> Refusal | None:
        """Activate or deactivate the controller."""

    def send_target(self, values: Mapping[str, float]) -> Refusal | None:
        """Send a target to guidance, SI."""

    def send_route(self, points: Sequence[Sequence[float]]) -> Refusal | None:
        """Publish a route of waypoints, each with north, east and altitude in m."""

    def keep_link(self) -> None:
        """Tell guidance that the link to an operator still exists."""

    def guide(self, service: str) -> Refusal | None:
        """Call a service of guidance, which is one of GUIDED."""

    def engage(self) -> Refusal | None:
        """Engage the bridge."""

    def disengage(self) -> Refusal | None:
        """Disengage the bridge."""

    def cancel(self) -> None:
        """Interrupt the method that is waiting on the worker thread."""

    def resume(self) -> None:
        """Let methods wait again after `cancel`."""

    def note(self, text: str) -> None:
        """Write a line to the log of the flight."""


@contextmanager
def _refusing() -> Iterator[None]:
    """Turn a ParameterError in a block into a RefusedError."""
    try:
        yield
    except ParameterError as error:
        raise RefusedError(HTTPStatus.UNPROCESSABLE_ENTITY, str(error)) from None


def new_key() -> str:
    """Return a random key that can be typed by hand, with eight letters and digits, 40 bits."""
    text = "".join(secrets.choice("ABCDEFGHJKLMNPQRSTUVWXYZ23456789") for _ in range(8))
    return f"{text[:4]}-{text[4:]}"


class Control:
    """Answers the requests of the page that has control. Values are in SI."""

    def __init__(
        self,
        flight: Flight,
        link: FlightLink,
        key: str,
        *,
        real: bool = False,
        assess: Assess | None = None,
        now: Callable[[], float] = time.monotonic,
    ) -> None:
        self._flight = flight
        self._link = link
        self._key = key
        self._real = real
        self._assess = assess
        self._now = now
        self._worker = ThreadPoolExecutor(max_workers=1)
        self._assessor = ThreadPoolExecutor(max_workers=1)
        self._lease = ""
        self._lease_end = -math.inf
        self._wrong_key = -math.inf
        self._requests = BURST
        self._refilled = now()
        self._cancellations = 0
        self._undo: list[dict[str, Any]] = []  # earlier values, the most recent last
        self._digest = 0  # digest of the controller's parameters, 0 until it is known
        self._values: dict[str, Any] = {}  # values of the controller's tunable parameters
        self._faults: dict[str, Any] = {}  # values of the aircraft's parameters in `_faults_of`
        self._actions: Mapping[str, Callable[[Mapping[str, Any]], Refusal | None]] = {
            "state": self._refresh,
            "gains": self._set_gains,
            "undo": self._undo_gains,
            "fault": self._set_faults,
            "gust": self._begin_gust,
            "target": self._send_target,
            "route": self._send_route,
            **{name: partial(self._guide, name) for name in GUIDED},
            "activate": lambda _: self._activate(active=True),
            "deactivate": lambda _: self._activate(active=False),
            "engage": self._engage,
            "disengage": lambda _: self._link.disengage(),
        }

    def _guide(self, service: str, _: Mapping[str, Any]) -> Refusal | None:
        return self._link.guide(service)

    async def answer(self, request: Any, key: str, lease: str) -> dict[str, Any]:
        """Carry out a request and return the state. Raises RefusedError if it is refused."""
        action = request.get("do") if isinstance(request, dict) else None
        self._require_key(key, lease)
        if action not in AT_ONCE:
            self._require_rate()
        known = (*self._actions, "check")
        if not isinstance(action, str) or action not in known:
            raise RefusedError(
                HTTPStatus.BAD_REQUEST,
                f"do: found {short_repr(action)}, expected one of {', '.join(known)}",
            )
        # A later flight in this domain is a new flight, which has another page.
        if action not in {"state", "check", *AT_ONCE} and self._flight.state() in OVER:
            raise RefusedError(
                HTTPStatus.CONFLICT,
                "the flight of this page is over: rise-di watch --control shows a later one",
            )
        self._take_lease(lease)
        loop = asyncio.get_running_loop()
        # A check of margins takes a while, but does not reach a node.
        if action == "check":
            return await loop.run_in_executor(self._assessor, self._check, request)
        # A request in AT_ONCE overtakes requests that run or wait for their turn.
        if action in AT_ONCE:
            self._cancellations += 1
            self._link.cancel()
        return await loop.run_in_executor(
            self._worker, self._carry_out, action, request, self._cancellations
        )

    def close(self) -> None:
        """End the request that is running, and take no more requests."""
        self._link.cancel()
        for executor in (self._worker, self._assessor):
            executor.shutdown(cancel_futures=True)

    # Who may command

    def _require_key(self, key: str, lease: str) -> None:
        """Raise RefusedError if the key is wrong.

        For KEY_PERIOD after a wrong key, only the page that has control is accepted.
        """
        holds = bool(self._lease) and hmac.compare_digest(lease.encode(), self._lease.encode())
        if not holds and self._now() - self._wrong_key < KEY_PERIOD:
            raise RefusedError(
                HTTPStatus.TOO_MANY_REQUESTS, f"a wrong key less than {KEY_PERIOD:g} s ago"
            )
        if not hmac.compare_digest(_plain(key), _plain(self._key)):
            self._wrong_key = self._now()
            raise RefusedError(
                HTTPStatus.FORBIDDEN,
                "the control key is wrong: type the one that rise-di watch printed",
            )

    def _require_rate(self) -> None:
        now = self._now()
        self._requests = min(self._requests + RATE * (now - self._refilled), BURST)
        self._refilled = now
        if self._requests < 1.0:
            raise RefusedError(
                HTTPStatus.TOO_MANY_REQUESTS, f"more than {RATE:g} requests a second"
            )
        self._requests -= 1.0

    def _take_lease(self, lease: str) -> None:
        now = self._now()
        if now < self._lease_end and not hmac.compare_digest(lease.encode(), self._lease.encode()):
            raise RefusedError(
                HTTPStatus.LOCKED,
                f"another page controls the flight; its lease ends {LEASE:g} s after it is closed",
            )
        if now >= self._lease_end:
            self._lease = secrets.token_urlsafe(16)
        self._lease_end = now + LEASE

    # What may be commanded

    def _carry_out(
        self, action: str, request: Mapping[str, Any], cancellations: int
    ) -> dict[str, Any]:
        """Carry out a request and write a line to the log.

        `cancellations` is how many cancellations there had been when the request arrived. If there
        are more by now, the request is refused.
        """
        self._link.resume()
        self._link.keep_link()
        before = dict(self._values)
        what = {name: value for name, value in request.items() if name != "digest"}
        try:
            with _refusing():
                if cancellations != self._cancellations:
                    raise ParameterError("cancelled by a later request")
                if refusal := self._actions[action](request):
                    raise ParameterError(str(refusal))
        except RefusedError as error:
            if action != "state":
                self._link.note(f"control: {short_repr(what)} refused: {error.sentence}")
            raise
        if action != "state":
            changes = {
                name: f"{before.get(name)} -> {value}"
                for name, value in self._values.items()
                if before.get(name) != value
            }
            self._link.note(f"control: {short_repr(what | changes)}")
        with _refusing():
            return self.state()

    def state(self) -> dict[str, Any]:
        """Return what the page shows of the control.

        It is the lease, the nodes, the gains with their ranges, the digests, the faults and the
        bridge.
        """
        nodes = self._link.nodes()
        scenario = self._flight.scenario
        page_state: dict[str, Any] = {
            "lease": self._lease,
            "nodes": nodes,
            "undo": len(self._undo),
            "targets": list(TARGETS),
        }
        # Before the first refresh, the digest is 0 and the gains are unknown.
        are_gains_known = self._digest and "controller" in nodes
        if scenario is not None and are_gains_known and gains_of(scenario.controller):
            page_state |= {
                "gains": self._gains(scenario),
                "digest": f"{self._digest:012x}",
                "logged": f"{self._flight.digest:012x}",
            }
        if scenario is not None and "aircraft" in nodes:
            channels = scenario.aircraft.channels()
            truth = self._flight.samples.get("truth")
            names = () if truth is None else truth.names
            axes = [name.partition(".")[2] for name in names if name.startswith("gust.")]
            page_state["aircraft"] = {
                "outputs": list(channels.outputs),
                "inputs": list(channels.inputs),
                "axes": axes,
            }
            page_state["faults"] = self._faults
        if scenario is not None and scenario.guidance is not None and "guidance" in nodes:
            orbits = scenario.guidance.drag is None
            page_state["radius"] = math.ceil(scenario.guidance.least_radius()) if orbits else 0  # m
        if "bridge" in nodes:
            page_state["bridge"] = {"map": self._map(), "sends": self._is_sending()}
        return page_state

    def _controller(self) -> ControllerConfig:
        if self._flight.scenario is None:
            raise RefusedError(
                HTTPStatus.CONFLICT, "the log has no scenario, so the gains have no range"
            )
        return self._flight.scenario.controller

    def _gains(self, scenario: Scenario) -> list[dict[str, Any]]:
        gains = []
        for name, base in gains_of(scenario.controller).items():
            values = list(as_list(self._values.get(name, base)))
            gains.append(
                {
                    "name": name,
                    "values": values,
                    "ranges": [*map(permitted_range, as_list(base))],
                    "channels": _channels_of(len(values), scenario.controller),
                }
            )
        return gains

    def _refresh(self, request: Mapping[str, Any]) -> Refusal | None:
        """Read the faults from the aircraft, and if necessary the controller's parameters.

        The parameters are read at first, and whenever the digest in the log differs.
        """
        # Before the first tick, the digest of the flight is 0.
        is_stale = not self._digest or self._flight.digest not in {0, self._digest}
        scenario = self._flight.scenario
        nodes = self._link.nodes()
        if scenario is not None and "controller" in nodes and is_stale:
            self._read()
        if scenario is not None and "aircraft" in nodes:
            self._faults = self._link.parameters("aircraft", _faults_of(scenario))
        return None

    def _read(self) -> None:
        base = self._controller()
        names = sorted(base.tunable() | base.changed_by_node())
        self._values = self._link.parameters("controller", names)
        self._digest = self._with(self._values).digest()

    def _with(self, values: Mapping[str, Any]) -> ControllerConfig:
        """Return the controller's parameters with some values changed. May raise ParameterError."""
        base = self._controller()
        content = {**dict(flatten(base.model_dump(exclude_none=True))), **values}
        return type(base).validate_mapping(nest(content), "controller")

    def _set_gains(self, request: Mapping[str, Any]) -> Refusal | None:
        values = values_by_name(request, "values")
        gains = gains_of(self._controller())
        changes = {}
        for name, value in values.items():
            require_known(name, gains, "gain")
            changes[name] = like_parameter(name, gains[name], value)
            require_range(name, changes[name], gains[name])
        return self._apply(request, changes, undo=True)

    def _undo_gains(self, request: Mapping[str, Any]) -> Refusal | None:
        if not self._undo:
            return Refusal("there is nothing to undo")
        refusal = self._apply(request, self._undo[-1], undo=False)
        if refusal is None:
            self._undo.pop()
        return refusal

    def _apply(
        self, request: Mapping[str, Any], values: Mapping[str, Any], *, undo: bool
    ) -> Refusal | None:
        """Set new values of the controller's parameters. Returns why the node refuses them.

        Raises RefusedError if the parameters are no longer those that the page shows, or if the
        bridge sends to an autopilot and `--real` is missing. If `undo` is True, the earlier values
        are kept, so that this change can be undone.
        """
        self._require_simulated()
        self._read()
        if request.get("digest") != f"{self._digest:012x}":
            raise RefusedError(
                HTTPStatus.CONFLICT,
                "the parameters have been changed meanwhile: look at them, then apply again",
            )
        before = {name: self._values[name] for name in values if name in self._values}
        digest = self._with({**self._values, **values}).digest()
        if refusal := self._link.set_parameters("controller", values):
            return refusal
        self._values = {**self._values, **values}
        self._digest = digest
        if undo:
            self._undo.append(before)
        return None

    def _check(self, request: Mapping[str, Any]) -> dict[str, Any]:
        """Return the margins that the present gains would have with the changes of a request."""
        if self._assess is None or self._flight.scenario is None:
            return {}
        values = values_by_name(request, "values")
        gains = gains_of(self._controller())
        changes = {
            name: like_parameter(name, gains[name], value)
            for name, value in values.items()
            if name in gains
        }
        with _refusing():
            return self._assess(self._flight.scenario, self._with(self._values | changes))

    def _map(self) -> str:
        """Return the name of the channel map of the bridge."""
        return Path(str(self._link.parameters("bridge", ["map"]).get("map", ""))).stem

    def _is_sending(self) -> bool:
        """Return whether the bridge of the flight may send commands to an autopilot."""
        return self._link.parameters("bridge", ["dry_run"]).get("dry_run") is not True

    def _require_simulated(self) -> None:
        if not self._real and "bridge" in self._link.nodes() and self._is_sending():
            raise RefusedError(
                HTTPStatus.FORBIDDEN,
                "the bridge sends to an autopilot: gains need rise-di watch --control --real",
            )

    def _activate(self, *, active: bool) -> Refusal | None:
        """Activate or deactivate the controller.

        With a bridge this is refused, because the bridge activates the controller when it engages,
        and deactivates it when it disengages.
        """
        if "bridge" in self._link.nodes():
            return Refusal(
                "the bridge activates and deactivates the controller: engage or disengage it"
            )
        return self._link.activate(active=active)

    def _set_faults(self, request: Mapping[str, Any]) -> Refusal | None:
        if self._flight.scenario is None:
            return Refusal("the log has no scenario")
        fault_names = _faults_of(self._flight.scenario)
        values = values_by_name(request, "values")
        for name in values:
            require_known(name, fault_names, "fault")
        changes = {
            name: value if is_sentences(value) else finite_numbers(name, value)
            for name, value in values.items()
        }
        refusal = self._link.set_parameters("aircraft", changes)
        if refusal is None:
            self._faults |= changes
        return refusal

    def _begin_gust(self, request: Mapping[str, Any]) -> Refusal | None:
        axis = request.get("axis")
        # ROS does not accept half a surrogate pair in a name.
        require_form(
            isinstance(axis, str) and axis.isidentifier(),
            f"axis: found {short_repr(axis)}, expected the name of an axis",
        )
        speed, length = (finite_number(key, request.get(key)) for key in ("speed", "length"))
        flight = self._flight
        real = flight.start_ns > SYSTEM_TIME_NS
        refusal = None
        for lead in GUST_LEADS:
            now = (time.time_ns() - flight.start_ns) / NANOSECONDS if real else flight.end
            gust = {"start": now + lead, "speed": speed, "length": length}
            values = {f"gusts.{axis}.{key}": value for key, value in gust.items()}
            refusal = self._link.set_parameters("aircraft", values)
            if refusal is None:
                break
        return refusal

    def _send_target(self, request: Mapping[str, Any]) -> Refusal | None:
        values = values_by_name(request, "values")
        for name in values:
            require_known(name, TARGETS, "target")
        return self._link.send_target(
            {name: finite_number(name, value) for name, value in values.items()}
        )

    def _send_route(self, request: Mapping[str, Any]) -> Refusal | None:
        points = request.get("points")
        expected = f"points: expected 2 to {MAX_WAYPOINTS} of north, east, altitude"
        if not isinstance(points, list) or not 2 <= len(points) <= MAX_WAYPOINTS:
            raise RefusedError(HTTPStatus.BAD_REQUEST, expected)
        for point in points:
            require_form(isinstance(point, list) and len(point) == len(AXES), expected)
        coordinate = partial(finite_number, "points")
        return self._link.send_route([[*map(coordinate, point)] for point in points])

    def _engage(self, request: Mapping[str, Any]) -> Refusal | None:
        name = self._map()
        require_form(
            request.get("map") == name,
            f"map: found {short_repr(request.get('map'))}, expected {name}, the map of the bridge",
        )
        return self._link.engage()


def gains_of(controller: ControllerConfig) -> dict[str, Any]:
    """Return the numeric parameters of a law that can be tuned in flight, by name.

    A value is a number, or one number for each channel.
    """
    fields = type(controller).model_fields
    tunable = [
        name
        for name in fields
        if name not in ControllerConfig.model_fields and name in controller.tunable()
    ]
    values = {name: getattr(controller, name) for name in tunable}
    return {name: value for name, value in values.items() if _is_numeric(value)}


def _channels_of(count: int, controller: ControllerConfig) -> list[str]:
    """Return the names of the `count` values of a gain.

    A single value has no name. Several values have the names of the outputs, of all outputs except
    the last (`k_d`), or of the inputs. Otherwise they are numbered from 1.
    """
    if count == 1:
        return [""]
    for names in (controller.outputs, controller.outputs[:-1], controller.inputs):
        if len(names) == count:
            return list(names)
    return [f"[{k + 1}]" for k in range(count)]


def _is_numeric(value: object) -> bool:
    return all(isinstance(number, float) for number in as_list(value))


def _faults_of(scenario: Scenario) -> list[str]:
    """Return the aircraft's parameters that can change in flight, except gusts and drift."""
    return sorted(
        name for name in scenario.aircraft.tunable() if not name.startswith(("gusts.", "drift."))
    )


def _plain(key: str) -> bytes:
    return key.replace("-", "").strip().upper().encode()
