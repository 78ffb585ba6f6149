# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Client of guidance, for `rise-di target` and the live page."""

import time
from collections.abc import Mapping
from contextlib import suppress

import numpy as np

from flight_core.parameters import ParameterError
from flight_core.vectors import ChannelError
from flight_guidance.modes import bits
from flight_ros.client import Client
from flight_ros.messages import Encoder, NamedDecoder
from flight_ros.subscriptions import PolledSubscription
from flight_ros.topics import GUIDANCE, NEWEST_SAMPLES, PUBLISH, TARGET

TARGET_TIMEOUT = 3.0  # s, in which guidance takes a target at its ticks
TARGET_PERIOD = 0.2  # s, between two equal targets


class TargetClient(Client):
    """Commands the guidance of a running flight."""

    def __init__(self, namespace: str = "", parent: Client | None = None) -> None:
        super().__init__("operator", namespace, parent)
        self._guidance, self._decoder = PolledSubscription(self._node, GUIDANCE, NEWEST_SAMPLES, raw=True), NamedDecoder()
        self._publisher = self._node.create_publisher(TARGET.type, TARGET.name, PUBLISH)
        self._sent = -TARGET_PERIOD  # monotonic time of the last target, s

    def send(self, values: Mapping[str, float]) -> str:
        """Publish commands by channel until guidance has them in force. Returns why they are not, or ""."""
        silent = f"{self._guidance.name}: not received, expected a flight with guidance in this domain"
        self._spin_until(lambda: bool(self._received()), silent)
        try:
            self._spin_until(lambda: self._published(values), "", TARGET_TIMEOUT)
        except ParameterError:
            if self._cancelled.is_set():
                raise
            return f"guidance did not take them in {TARGET_TIMEOUT:g} s; its log says why"
        return ""

    def _published(self, values: Mapping[str, float]) -> bool:
        if time.monotonic() - self._sent > TARGET_PERIOD:
            self._sent = time.monotonic()
            encoder = Encoder([*values], self._node.get_fully_qualified_name())
            self._publisher.publish(encoder.encode(time.time_ns(), np.array([*values.values()])))
        given = bits(values)
        return any(
            int(sample.get("given", 0.0)) & given == given
            and all(sample.get(f"target.{name}") == value for name, value in values.items())
            for sample in self._received()
        )

    def _received(self) -> list[dict[str, float]]:
        """The channels of the samples of `guidance` since the last call."""
        samples = []
        for received in self._guidance.take():
            with suppress(ChannelError):
                samples.append(self._decoder.decode(received.message).channels)
        return samples
