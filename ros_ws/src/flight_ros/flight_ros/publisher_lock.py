# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Whom a node listens to on a topic that is to have one publisher. A message names its sender in `frame_id` alone."""

from flight_core.vectors import ChannelError

SENDER = "sender"  # the reason for which a sample of another one is refused


class PublisherLock:
    """The first one that is heard, until nothing was heard of it for longer than an age limit; then the next one.

    Not every next one is as good: a node that is started again comes under its name, a stranger may be made to wait longer.
    """

    def __init__(self) -> None:
        self.name: str | None = None
        self._heard_ns = 0

    def silence_ns(self, now_ns: int) -> int:
        """For how long nothing was heard of it."""
        return now_ns - self._heard_ns

    def silent(self, now_ns: int, max_age_ns: int) -> bool:
        """Whether there is nobody to listen to."""
        return self.name is None or self.silence_ns(now_ns) > max_age_ns

    def require(self, sender: str, now_ns: int, max_age_ns: int, strange_ns: int) -> None:
        """Raise ChannelError, "sender", for a sample of another one while the first is heard.

        Its silence has to be longer than `max_age_ns` for the same node in another process, `strange_ns` for another node.
        """
        if sender == self.name:
            return
        same = self.name is not None and sender.partition("#")[0] == self.name.partition("#")[0]
        if not self.silent(now_ns, max_age_ns if same else strange_ns):
            raise ChannelError(SENDER, f"{sender} publishes too, beside {self.name}")

    def hear(self, sender: str, now_ns: int) -> bool:
        """Called with each good sample; whether it comes from another one than before."""
        changes, self.name, self._heard_ns = sender != self.name, sender, now_ns
        return changes
