# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Implement `rise-di play`, which publishes the topics of a recorded flight again.

They keep their timing, so that a node under test can receive them as in the flight.
"""

import math
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path

from flight_cli.log_options import log_namespace, warn_of_lacks_in
from flight_cli.output import CLOCK_COLUMNS, progress_bar
from flight_cli.words import REQUIRED, argument, option, warn
from flight_core.environment import require_ros_environment
from flight_core.parameters import require
from flight_core.text import printable
from flight_log.playback import SHARED, Playback, read_playback
from flight_log.tape_reader import topics_text


class Stamps(StrEnum):
    """Which stamps the played messages get."""

    NOW = "now"
    RECORDED = "recorded"


@dataclass(frozen=True, kw_only=True)
class Play:
    """Publish the topics of a recorded flight again with their timing.

    /clock has the time of the log. The messages have the bytes of the log, with new stamps. The
    command refuses to play if the domain already has a publisher on one of the topics. A warning
    names the topics that are skipped, because they are not in CDR or because their message type is
    not installed. Exit status: 0 played to the end, 2 bad input, 130 interrupted.
    """

    run: Path = argument("Folder of a run, or an MCAP file.", default=REQUIRED)
    topics: str = option(
        "Topics to play, as in y,y_m; by default all, except those that every node has.", default=""
    )
    rate: float = option("Speed as a multiple of real time.", default=1.0, min=0.01, max=100.0)
    start: float = option("Flight time to start at, s.", default=0.0, min=0.0)
    loop: bool = option("Repeat until Ctrl-C.", default=False)
    stamps: Stamps = option(
        "Stamps of the messages. now: moved to the present, as a controller in real time needs "
        "them; recorded: unchanged.",
        default=Stamps.NOW,
    )
    namespace: str | None = log_namespace()

    def execute(self) -> None:
        """Play until the end of the log, or until Ctrl-C."""
        for name, value in (("--rate", self.rate), ("--start", self.start)):
            # The ranges of the options do not refuse NaN.
            require(math.isfinite(value), name, value, "a number")
        names = [name.strip() for name in self.topics.split(",") if name.strip()]
        playback = read_playback(self.run, names, self.start, self.namespace)
        warn_of_lacks_in(self.run, self.namespace)
        require_ros_environment()
        from flight_bringup.player import Player  # noqa: PLC0415 - loads rclpy, which other commands do not need

        types = self._sendable(playback, every=not names)
        messages = [message for message in playback.messages if message.topic in types]
        end = playback.t(playback.messages[-1].due_ns)
        with Player(types, SHARED) as sender, progress_bar(*CLOCK_COLUMNS) as bar:
            description = f"{', '.join(types)}, stamps {self.stamps}"
            task = bar.add_task("play", total=end - self.start, clock="", shown=description)

            def progress(due_ns: int) -> None:
                t = playback.t(due_ns)
                clock = f"t = {t:5.1f} of {end:.1f} s, {self.rate:g} times"
                bar.update(task, completed=t - self.start, clock=clock)

            while True:
                now = self.stamps is Stamps.NOW
                sender.play(messages, self.rate, stamps_now=now, progress=progress)
                progress(playback.messages[-1].due_ns)
                if not self.loop:
                    break

    def _sendable(self, playback: Playback, *, every: bool) -> dict[str, str]:
        """Return the message types of the topics that can be sent, and warn of the others.

        If `every`, the user named no topic, and topics that cannot be sent are left out.
        Raises ParameterError if no topic can be sent.
        """
        from flight_bringup.player import unsendable  # noqa: PLC0415 - as above

        skipped_topics = {**playback.skipped, **(unsendable(playback.types) if every else {})}
        types = {
            topic: name for topic, name in playback.types.items() if topic not in skipped_topics
        }
        require(
            bool(types),
            str(self.run),
            f"no topic to play among {topics_text(skipped_topics)}",
            "a topic whose message type is installed",
        )
        if skipped_topics:
            warn(
                f"warning: {printable(topics_text(skipped_topics))} skipped: without CDR, or of a "
                "message type that is not installed"
            )
        return types
