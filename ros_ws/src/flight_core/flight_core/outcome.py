# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Outcomes of a flight."""

from flight_core.text import bounded

COMPLETED = "completed"
INTERRUPTED = "interrupted"
INCOMPLETE = "log incomplete"  # after an outcome and a comma, before what the log lacks
MISSED = "missed"  # after an outcome and a comma, before the legs of a route that were missed
LOOP_LOST = "loop lost"  # after an outcome and a comma, before the inputs and outputs
OUTSIDE = "outside of the fence"  # after an outcome and a comma, before for how long and how far
# after an outcome, a comma and the legs of a route that were ahead at the end
NOT_FLOWN = "not flown"
NOT_JOINED = "the last orbit not joined"  # after an outcome and a comma, before how far away
BESIDE = "outside of the touch-down zone"  # after a landing and a comma, before how far
LANDED = " landed "  # in an outcome, between the aircraft and the time
IMPORT = "imported"  # of a log that an autopilot wrote
NEVER_FLEW = "never flew"  # before the reason
UNKNOWN = "unknown"  # on the tape of a log
STATUS_INTERRUPTED = 130  # exit statuses of a flight
STATUS_BAD_INPUT = 2  # also of a node
STATUS_ENDED_EARLY = 3  # 0 completed or landed
# completed with a loop lost, an incomplete log, a leg missed or not flown, an orbit not joined, or
# outside of the fence, or landed outside of the touch-down zone
STATUS_INCOMPLETE = 4
# before the name of the node lost: the end of a node that is not the cause
LOST_CONTACT = "lost contact with"


def ended_early(held: float, duration: float) -> str:
    """The outcome of a flight of `duration` s whose log holds y, y_m and u up to the flight time
    `held`, s; -inf: none.
    """
    if held < 0.0:
        return f"ended early: the log does not hold y, y_m and u of {duration:g} s"
    return f"ended early: the log holds y, y_m and u up to t = {held:.3f} of {duration:g} s"


def exit_status(outcome: str) -> int:
    """Exit status of a flight by the outcome."""
    if outcome.startswith(f"{COMPLETED}, ") or f", {OUTSIDE}" in outcome or BESIDE in outcome:
        return STATUS_INCOMPLETE
    if LANDED in outcome:
        return 0
    return {COMPLETED: 0, INTERRUPTED: STATUS_INTERRUPTED}.get(outcome, STATUS_ENDED_EARLY)


class FlightEnded(RuntimeError):  # noqa: N818 - the end of a flight is not a program error
    """A flight cannot continue. The message is one sentence for the user, printable and bounded."""

    def __init__(self, sentence: str) -> None:
        super().__init__(bounded(sentence))
