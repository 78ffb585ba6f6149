# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""`rise-di play`: publish the topics of a recorded flight again with their timing, for a node under
test.
"""

import math
from enum import StrEnum
from pathlib import Path
from typing import Annotated

from flight_cli.log_options import LogNamespace, warn_of_lacks_in
from flight_cli.output import CLOCK_COLUMNS, progress_bar
from flight_cli.words import argument, option, warn
from flight_core.environment import require_ros_environment
from flight_core.parameters import require
from flight_core.text import printable
from flight_log.playback import SHARED, read_playback
from flight_log.tape_reader import listed


class Stamps(StrEnum):
    """Stamps of the messages."""

    NOW = "now"
    RECORDED = "recorded"


def play(
    run: Annotated[Path, argument("Folder of a run, or an MCAP file.")],
    topics: Annotated[
        str, option("Topics, as in y,y_m; by default all but those of every node.")
    ] = "",
    rate: Annotated[float, option("Factor to real time.", min=0.01, max=100.0)] = 1.0,
    start: Annotated[float, option("Flight time to start at, s.", min=0.0)] = 0.0,
    loop: Annotated[bool, option("Repeat until Ctrl-C.", "--loop")] = False,
    stamps: Annotated[
        Stamps,
        option(
            "now: moved to the present, as a controller in real time needs them; recorded: "
            "unchanged."
        ),
    ] = Stamps.NOW,
    namespace: LogNamespace = None,
) -> None:
    """Publish the topics of a recorded flight again with their timing, and /clock with the time of
    the log.

    The bytes of the log are sent, with new stamps. A domain with a publisher on a topic of the log
    is refused. A warning names the skipped topics: without CDR, or of a message type that is not
    installed. Exit status: 0 played to the end, 2 bad input, 130 interrupted.
    """
    for name, value in (("--rate", rate), ("--start", start)):
        require(math.isfinite(value), name, value, "a number")  # NaN passes the ranges above
    names = [name.strip() for name in topics.split(",") if name.strip()]
    playback = read_playback(run, names, start, namespace)
    warn_of_lacks_in(run, namespace)
    require_ros_environment()
    from flight_bringup.player import Player, unsendable  # noqa: PLC0415 - loads rclpy, which other commands do not need

    end = playback.t(playback.messages[-1].due_ns)
    skipped = {**playback.skipped, **({} if names else unsendable(playback.types))}
    types = {topic: name for topic, name in playback.types.items() if topic not in skipped}
    require(
        bool(types),
        str(run),
        f"no topic to play among {listed(skipped)}",
        "a topic whose message type is installed",
    )
    if skipped:
        warn(
            f"warning: {printable(listed(skipped))} skipped: without CDR, or of a message type "
            "that is not installed"
        )
    messages = [message for message in playback.messages if message.topic in types]
    with Player(types, SHARED) as sender, progress_bar(*CLOCK_COLUMNS) as bar:
        task = bar.add_task(
            "play", total=end - start, clock="", shown=f"{', '.join(types)}, stamps {stamps}"
        )

        def progress(due_ns: int) -> None:
            t = playback.t(due_ns)
            bar.update(
                task, completed=t - start, clock=f"t = {t:5.1f} of {end:.1f} s, {rate:g} times"
            )

        while True:
            sender.play(messages, rate, stamps_now=stamps is Stamps.NOW, progress=progress)
            progress(playback.messages[-1].due_ns)
            if not loop:
                break
