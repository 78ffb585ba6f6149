# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Find the disturbances of a flight, and the parts into which they divide it.

An engagement, a command, a gust, a turn and a capture disturb a flight. The rest of it is named
after the air.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from flight_analysis.metrics.time_spans import is_in_spans, mask_spans
from flight_core.modes import Mode
from flight_core.tape import Tape
from flight_core.vectors import FloatArray

SETTLING_DWELL = 1.0
"""Time beyond its end for which a transient still counts, s. An error has settled if it has stayed
in the band for this time."""

TURN_BANK = math.radians(5.0)  # guidance turns if it commands more bank than this, rad
# Guidance captures if it commands a flight path that is steeper than CAPTURE_ANGLE, rad. It also
# captures if the path is farther away than the aircraft flies in CAPTURE_TIME, s.
CAPTURE_ANGLE = math.radians(1.0)
CAPTURE_TIME = 0.5


class Air(StrEnum):
    """The disturbance of the air, except gusts, from the calmest to the most violent.

    The part of a flight without gust, command and engagement is named after it.
    """

    CALM = "calm"
    WIND = "wind"
    SHEAR = "shear"
    TURBULENCE = "turbulence"
    MICROBURST = "microburst"
    UNKNOWN = "other"  # no simulated aircraft flew


class TransientKind(StrEnum):
    """What disturbs a flight. The word also names the part of the flight that it disturbs."""

    ENGAGEMENT = "engagement"
    COMMAND = "command"
    GUST = "gust"
    TURN = "turn"
    CAPTURE = "capture"


# In a guided flight, turns and captures replace commands. Their commands change until they end.
GUIDED = (TransientKind.CAPTURE, TransientKind.TURN)


@dataclass(frozen=True, kw_only=True)
class Transient:
    """A disturbance in a flight: an engagement, a command, a gust, a turn or a capture.

    `start` and `stop` are its first and its last instant, in s of flight time.
    """

    kind: TransientKind
    name: str  # name of the commanded channel or of the gust, or ""
    start: float
    stop: float

    def is_excitation_of(self, channel: str) -> bool:
        """Return whether the transient excites a channel.

        A command excites only the channel that it commands. Every other transient excites all
        channels.
        """
        return self.kind is not TransientKind.COMMAND or self.name == channel


def engagements(tape: Tape) -> list[Transient]:
    """Return the instants of engagement as transients, from the modes in `internals`."""
    if "internals" not in tape:
        return []
    is_engaged = tape["internals"]["mode"] == Mode.ENGAGED
    begins = is_engaged & ~np.concatenate([[False], is_engaged[:-1]])
    return [
        Transient(kind=TransientKind.ENGAGEMENT, name="", start=float(t), stop=float(t))
        for t in tape.time("internals")[begins]
    ]


def live_commands(tape: Tape) -> list[Transient]:
    """Return the changes of the commands in the topic `u_m`, as transients.

    If two changes of a channel are at most SETTLING_DWELL apart, they belong to one transient.
    """
    if "u_m" not in tape:
        return []
    t = tape.time("u_m")
    u_m = tape["u_m"]
    commands: list[Transient] = []
    # Leave out the attitude, which never rests.
    attitude = () if "y_m" not in tape else set(u_m.names) - set(tape["y_m"].names)
    for name in [name for name in u_m.names if name not in attitude]:
        is_change = np.concatenate([u_m[name][:1] != 0.0, np.diff(u_m[name]) != 0.0])
        instants = t[is_change]
        groups = np.split(instants, np.flatnonzero(np.diff(instants) > SETTLING_DWELL) + 1)
        commands += [
            Transient(
                kind=TransientKind.COMMAND,
                name=name,
                start=float(group[0]),
                stop=float(group[-1]),
            )
            for group in groups
            if len(group)
        ]
    return sorted(commands, key=lambda command: command.start)


def guided_transients(tape: Tape) -> list[Transient]:
    """Return the turns and captures of a guided flight, from the commands in the topic `guidance`.

    In a turn, guidance commands more bank than TURN_BANK. In a capture, it climbs, descends,
    returns to its path or changes speed. `u_m` changes all the time in a guided flight, so it shows
    no transients. Transients of the same kind that are less than SETTLING_DWELL apart are joined to
    one.
    """
    if "guidance" not in tape:
        return []
    t = tape.time("guidance")
    commands = tape["guidance"]
    speed = commands["V_c"]
    turns = np.abs(commands["phi_c"]) > TURN_BANK
    captures = np.abs(commands["climb_c"]) > speed * math.sin(CAPTURE_ANGLE)
    captures |= np.abs(commands["xtrack"]) > CAPTURE_TIME * speed
    captures |= np.diff(speed, prepend=speed[:1]) != 0.0
    spans = {
        TransientKind.TURN: mask_spans(t, turns, SETTLING_DWELL),
        TransientKind.CAPTURE: mask_spans(t, captures & ~turns, SETTLING_DWELL),
    }
    transients = [
        Transient(kind=kind, name="", start=start, stop=stop)
        for kind, of_kind in spans.items()
        for start, stop in of_kind
    ]
    return sorted(transients, key=lambda transient: transient.start)


def part_masks(
    t: FloatArray,
    transients: Sequence[Transient],
    settle: float = SETTLING_DWELL,
    air: Air = Air.CALM,
) -> dict[str, NDArray[np.bool_]]:
    """Return a mask of the instants t, (N,), for each part of the flight.

    The parts are "whole", the part named by `air`, "command" and "gust". In a guided flight,
    "capture" and "turn" replace "command". Every instant is in "whole", and in at most one more
    part. During a transient this is the part of the transient. If transients overlap, it is the one
    whose part comes last in the order above. An instant with only an engagement is in no other
    part. An instant without any transient is in the part `air`.
    """
    kinds = {transient.kind for transient in transients}
    commands = (TransientKind.COMMAND,) if kinds.isdisjoint(GUIDED) else GUIDED
    parts = {}
    free = np.ones(len(t), dtype=bool)
    for kind in (TransientKind.GUST, *reversed(commands), TransientKind.ENGAGEMENT):
        spans = [
            (transient.start, transient.stop) for transient in transients if transient.kind is kind
        ]
        parts[kind] = is_in_spans(t, spans, settle) & free
        free &= ~parts[kind]
    return {
        "whole": np.ones(len(t), dtype=bool),
        air: free,
        **{kind: parts[kind] for kind in (*commands, TransientKind.GUST)},
    }
