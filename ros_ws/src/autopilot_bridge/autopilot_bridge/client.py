# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Engage and disengage a running bridge, for `rise-di engage` and the live page."""

from collections.abc import Callable
from typing import Any

import rclpy
from std_srvs.srv import SetBool, Trigger

from flight_core.outcome import Refusal
from flight_core.text import bounded
from flight_ros.client import SERVICE_TIMEOUT, Client
from flight_ros.messages import NamedDecoder
from flight_ros.subscriptions import PolledSubscription
from flight_ros.topics import ENGAGEMENT, NEWEST_SAMPLES, PUBLISH, U

# The services of the bridge.
ENGAGE = "bridge/engage"
ENGAGE_BLIND = "bridge/engage_blind"
WITHDRAW_TIMEOUT = 1.0  # s
# s, longest wait for u while the nodes of a flight start. The autopilot may send its first messages
# late.
U_TIMEOUT = 30.0
TRIM_SAMPLES = 20  # number of successive equal samples of u that show that u has reached trim


class EngagementClient(Client):
    """Engages and disengages a running bridge without a jump of u (bumpless transfer)."""

    def __init__(self, namespace: str = "", parent: Client | None = None) -> None:
        super().__init__("engage", namespace, parent)
        self._u: list[tuple[float, ...]] = []
        self._phases: list[tuple[str, str]] = []
        self._waits_for = ""  # the last reason that was reported
        self._engagement_subscription = PolledSubscription(self._node, ENGAGEMENT, PUBLISH)
        self._u_subscription = PolledSubscription(self._node, U, NEWEST_SAMPLES, raw=True)

    def engage(self, progress: Callable[[str], None], *, blind: bool = False) -> Refusal | None:
        """Wait until u is at trim, and engage the bridge, which then activates the controller.

        Returns the reason if the bridge refuses. If the bridge is engaged already, it takes the
        request immediately, and starts the time of `max_engaged` again. If `blind` is True, the
        engagement ignores a loss of the transmitter. `progress` is called with sentences on what
        the bridge waits for, and on what the bridge warns of once it is engaged. If the caller
        stops waiting, for example after Ctrl-C, the request is withdrawn, so that the autopilot
        does not change its mode later.
        """
        self._spin_until(
            lambda: bool(self._received_phases()),
            "bridge/engagement: not received, expected a running bridge",
        )
        if self._phases[-1][0] != "ENGAGED":
            self._spin_until(
                lambda: bool(self._received_u()),
                "u: not received, expected a controller with y and y_m",
                U_TIMEOUT,
            )
            self._spin_until(
                self._is_at_rest,
                f"u: not at trim after {SERVICE_TIMEOUT:g} s, expected a ramp to trim",
            )
        self._received_phases().clear()
        try:
            if refusal := self._engage_blind() if blind else self._set_engaged(engaged=True):
                return refusal
            silent = "bridge/engagement: no change, expected ENGAGED or a reason"
            self._spin_until(lambda: self._is_settled(progress), silent, U_TIMEOUT)
        except BaseException:
            self._withdraw()
            raise
        phase, reason = self._phases[-1]
        if phase != "ENGAGED":
            return Refusal(reason)
        if reason:
            progress(f"warning: {reason}")
        return None

    def _engage_blind(self) -> Refusal | None:
        request = Trigger.Request()
        return _refusal_in(self._call(Trigger, ENGAGE_BLIND, request, "a flight with a bridge"))

    def disengage(self) -> Refusal | None:
        """Disengage the bridge, or return the reason if the bridge refuses."""
        return self._set_engaged(engaged=False)

    def _set_engaged(self, *, engaged: bool) -> Refusal | None:
        request = SetBool.Request(data=engaged)
        return _refusal_in(self._call(SetBool, ENGAGE, request, "a flight with a bridge"))

    def _withdraw(self) -> None:
        """Ask the bridge to disengage, and wait at most WITHDRAW_TIMEOUT for an answer.

        If the process of the bridge is suspended (SIGSTOP), the answer comes after it is resumed.
        """
        client = self._node.create_client(SetBool, ENGAGE)
        if client.wait_for_service(WITHDRAW_TIMEOUT):
            future = client.call_async(SetBool.Request(data=False))
            rclpy.spin_until_future_complete(self._node, future, timeout_sec=WITHDRAW_TIMEOUT)
        self._node.destroy_client(client)

    def _received_u(self) -> list[tuple[float, ...]]:
        samples = self._decoded(self._u_subscription, NamedDecoder().decode)
        self._u += [tuple(sample.channels.values()) for sample in samples]
        return self._u

    def _received_phases(self) -> list[tuple[str, str]]:
        """Return the phases of the bridge since the request, each with its reason."""
        self._phases += [
            (bounded(arrival.message.key), bounded(arrival.message.value))
            for arrival in self._engagement_subscription.take()
        ]
        return self._phases

    def _is_settled(self, progress: Callable[[str], None]) -> bool:
        """Return whether the bridge has engaged, or has stopped trying after it began to engage.

        Phases that the bridge reported before the request are ignored.
        """
        phases = [phase for phase, _ in self._received_phases()]
        while phases and phases[0] not in {"ENGAGING", "ENGAGED"}:
            del phases[0], self._phases[0]
        if phases and phases[-1] == "ENGAGING" and self._phases[-1][1] != self._waits_for:
            self._waits_for = self._phases[-1][1]
            progress(f"waiting: {self._waits_for}")
        return bool(phases) and phases[-1] != "ENGAGING"

    def _is_at_rest(self) -> bool:
        self._received_u()
        return len(self._u) >= TRIM_SAMPLES and len(set(self._u[-TRIM_SAMPLES:])) == 1


def _refusal_in(response: Any) -> Refusal | None:
    """Return the refusal in an answer of the bridge, or None if the answer has no message."""
    return Refusal(bounded(response.message)) if response.message else None
