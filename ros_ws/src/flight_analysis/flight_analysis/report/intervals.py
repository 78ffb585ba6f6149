# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Find the intervals that figures shade: gusts, modes, faults, a busy host and gaps."""

import numpy as np

from flight_analysis.metrics.time_spans import Windows, mask_spans
from flight_analysis.report.plotting import MIN_GAP_PERIODS, Interval
from flight_analysis.report.summary import RecordedFlight
from flight_core.modes import Mode
from flight_core.tape import Tape

GUST = "#7f7f7f"
NO_SAMPLE = "#5f6b73"
STARVED = "#c98a2b"
FAULT = "#c96a6a"
MODE_COLOURS = {
    Mode.WAITING: "#b0b0b0",
    Mode.HOLD: "#f2c230",
    Mode.RAMP: "#ef7d17",
    Mode.TRIM: "#8a63b8",
    Mode.INACTIVE: "#5f6b73",
}
SHOWN_GAP = 0.1  # least gap between samples of y that is shaded, s


def flight_end(tape: Tape) -> float:
    """Return the time of the last sample of any signal, s, or 0 for a tape without samples."""
    return max(
        (float(tape.time(topic)[-1]) for topic in tape.signals if len(tape[topic].stamp_ns)),
        default=0.0,
    )


def gust_intervals(tape: Tape, gusts: Windows) -> list[Interval]:
    """Return the gusts up to the end of the flight. All repetitions of a gust share a label."""
    end = flight_end(tape)
    return [
        Interval(
            label=f"{name.rstrip('0123456789 ')} gust",
            start=start,
            stop=min(stop, end),
            colour=GUST,
            is_labelled=True,
        )
        for name, (start, stop) in gusts.items()
        if start < end
    ]


def mode_intervals(tape: Tape, min_length: float = 0.0) -> list[Interval]:
    """Return the intervals in which the controller had a mode other than ENGAGED."""
    if "internals" not in tape:
        return []
    t = tape.time("internals")
    modes = tape["internals"]["mode"]
    intervals = []
    for mode, colour in MODE_COLOURS.items():
        spans = mask_spans(t, modes == mode, min_length)
        intervals += [
            Interval(
                label=mode.name.lower(), start=start, stop=stop, colour=colour, is_labelled=False
            )
            for start, stop in spans
        ]
    return intervals


def fault_intervals(flight: RecordedFlight, end: float) -> list[Interval]:
    """Return the faults that the scenario injects, each from its start to the time `end`, s."""
    if flight.scenario is None:
        return []
    return [
        Interval(label=fault.subject, start=fault.at, stop=end, colour=FAULT, is_labelled=True)
        for fault in flight.scenario.aircraft.actuators.read_faults()
        if fault.at < end
    ]


def starved_intervals(flight: RecordedFlight) -> list[Interval]:
    """Return the intervals in which the host was too busy to fly in real time."""
    spans = (flight.summary.get("account") or {}).get("starved", ())
    return [
        Interval(label="host too busy", start=start, stop=stop, colour=STARVED, is_labelled=False)
        for start, stop in spans
    ]


def gap_intervals(tape: Tape) -> list[Interval]:
    """Return the gaps: long intervals without a sample of y.

    A gap is longer than SHOWN_GAP, and longer than MIN_GAP_PERIODS times the median period of y.
    """
    if "y" not in tape or len(tape["y"].stamp_ns) < 2:
        return []
    t = tape.time("y")
    longest = max(MIN_GAP_PERIODS * float(np.median(np.diff(t))), SHOWN_GAP)
    return [
        Interval(
            label="no sample of y",
            start=float(t[before]),
            stop=float(t[before + 1]),
            colour=NO_SAMPLE,
            is_labelled=False,
        )
        for before in np.flatnonzero(np.diff(t) > longest)
    ]
