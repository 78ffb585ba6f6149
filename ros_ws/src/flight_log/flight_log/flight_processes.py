# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Find the processes of a flight in a log.

A line on /rosout tells when a process was ready, and its samples show how long it lived.
"""

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from rosbags.serde.errors import SerdeError

from flight_core.rates import NANOSECONDS
from flight_core.tape import Process, Signal
from flight_core.vectors import FloatArray
from flight_log.named_vectors import typestore

ROSOUT = "/rosout"
LOG = "rcl_interfaces/msg/Log"
# The text "ready" in CDR: the length with the final zero, then the bytes.
READY = b"\x06\x00\x00\x00ready\x00"
UNNAMED = "a publisher without a name"
INSTANCE = re.compile(r"(/.+)#\d+")  # name of a node, and the id of its process


@dataclass(frozen=True, kw_only=True, order=True)
class SampleSpan:
    """First and last stamp of the samples of a publisher, ns, and their number."""

    first_ns: int
    last_ns: int
    samples: int

    def joined(self, later: "SampleSpan") -> "SampleSpan":
        """Return a span from the first sample of this span to the last sample of a later one."""
        return SampleSpan(
            first_ns=min(self.first_ns, later.first_ns),
            last_ns=max(self.last_ns, later.last_ns),
            samples=self.samples + later.samples,
        )


def ready_times(lines: Iterable[bytes]) -> list[tuple[str, int]]:
    """Return which nodes logged "ready", and at which system time, ns, in the order of time."""
    times = []
    for data in lines:
        try:
            line: Any = typestore().deserialize_cdr(data, LOG)
        except SerdeError:
            continue
        if line.msg == "ready":
            times.append(
                (
                    f"/{line.name.replace('.', '/')}",
                    line.stamp.sec * NANOSECONDS + line.stamp.nanosec,
                )
            )
    return sorted(times, key=lambda time: time[1])


def flight_processes(
    spans: Mapping[str, SampleSpan], ready: Iterable[tuple[str, int]], namespace: str
) -> dict[str, Process]:
    """Return the processes by name, such as "/controller#4711", from the `spans` of publishers.

    A node that was restarted has several processes. `ready` has the times at which each node was
    ready. Such a time belongs to the process whose first sample follows, or came at most 1 s
    earlier. If several times belong to a process, the last one is taken. A node without samples,
    such as the recorder, has no process id in its name. In lockstep no node has a process id. If
    the log has nodes of this flight stack, every other publisher is listed as a process too, even
    `ros2 topic pub`, which has no name.
    """
    waiting: dict[str, list[int]] = {}
    for node, time_ns in ready:
        if node.rpartition("/")[0] == namespace:
            waiting.setdefault(node, []).append(time_ns)
    has_stack = any(INSTANCE.fullmatch(name) or name in waiting for name in spans)
    processes = {}
    for name, span in sorted(spans.items(), key=lambda item: item[1]):
        if (instance := INSTANCE.fullmatch(name)) is not None:
            before = [
                time_ns
                for time_ns in waiting.get(instance[1], [])
                if time_ns <= span.first_ns + NANOSECONDS
            ]
            processes[name] = Process(
                ready_ns=before[-1] if before else None,
                first_ns=span.first_ns,
                last_ns=span.last_ns,
                samples=span.samples,
            )
            waiting[instance[1]] = [
                time_ns for time_ns in waiting.get(instance[1], []) if time_ns not in before
            ]
        elif has_stack:
            ready_ns = max(waiting.pop(name, []), default=None)
            processes[name or UNNAMED] = Process(
                ready_ns=ready_ns,
                first_ns=span.first_ns,
                last_ns=span.last_ns,
                samples=span.samples,
            )
    return processes | {
        node: Process(ready_ns=times[-1], first_ns=None, last_ns=None)
        for node, times in waiting.items()
        if times
    }


# If a publisher is silent for this time, the nodes admit another one. It is the time of
# `aircraft.max_age`.
SILENT_NS = NANOSECONDS // 5
SILENT_PERIODS = 3  # least silence of a slow publisher that counts, in periods of its samples


def admitted(signal: Signal) -> Signal:
    """Return the samples that the nodes would have taken, if several publishers sent them.

    The nodes take samples from the first publisher. When this publisher is silent for too long,
    they take samples from the next one.
    """
    if signal.sender is None:
        return signal
    keep = np.zeros(len(signal.stamp_ns), dtype=np.bool_)
    begin = 0
    while begin < len(keep):
        places = begin + np.flatnonzero(signal.sender[begin:] == signal.sender[begin])
        intervals_ns = np.diff(signal.stamp_ns[places])
        usual_ns = int(np.median(intervals_ns)) if len(intervals_ns) else 0
        silent_ns = max(SILENT_NS, SILENT_PERIODS * usual_ns)
        silences = np.flatnonzero(intervals_ns > silent_ns)
        last = places[silences[0]] if len(silences) else places[-1]
        keep[places[places <= last]] = True
        begin = int(last) + 1
    return signal if keep.all() else signal.where(keep)


RESTART = 10  # if the number of ticks falls by more than this, another controller has started


def controller_starts(number: FloatArray) -> list[int]:
    """Return the indices at which a new controller begins, from the numbers of ticks, (N,).

    A new controller counts its ticks from the beginning, so the number falls. But two ticks of one
    instant may be stored in either order, and then the number falls a little. A fall to a number
    that has not occurred since the last start is therefore no new controller.
    """
    starts = []
    first = 0
    for place in (np.flatnonzero(np.diff(number) < 0.0) + 1).tolist():
        if number[place] < number[place - 1] - RESTART or number[place] in number[first:place]:
            starts.append(place)
            first = place
    return starts
