# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Count the false alarms of the learner over long flights of healthy aircraft.

    python -m benchmarks.learning_alarms --flights 4 --duration 300 --write FILE

Each aircraft is drawn by its seed, with A and B up to 30 % off the airframe file, and flies in each
of AIRS. A part with a learned model is tested for damage every `learn.check` seconds. Nothing is
damaged, so each change, each dead input and each fallback is a false alarm. Rows that the file has
already are not flown again.
"""

import csv
from pathlib import Path
from typing import Annotated, Any, NamedTuple
from unittest.mock import patch

import typer
from benchmarks.learning_flights import Cell, learning

from flight_analysis.closed_loop.simulate import simulate
from flight_core.outcome import COMPLETED
from flight_design.learning.change_test import Change, change_test
from flight_design.learning.scenario_learner import learner
from rise_di_controller.learning.proposals import Event, EventKind

AIRS = (
    "turbulence",
    "turbulence and gusts",
    "air that turns",
    "light turbulence",
    "severe turbulence",
)
UNCERTAINTY = 0.3


class Flight(NamedTuple):
    """What the learner told in a flight without damage."""

    air: str
    seed: int
    duration: float  # s
    completed: int  # 1 if the flight lasted to its end
    models: int  # proposals that flew, without the airframe file as it is
    tests: int  # tests of a part for damage
    doubts: int  # single tests after which an input might have had no effect
    changed: int  # times that a part was told to have changed
    dead: int  # times that an input was told to have no effect
    fallbacks: int  # times that the initial law took over
    largest_gain: float  # largest gain of log-likelihood by a loss of effect, over all tests
    second_gain: float  # second largest gain
    sentences: str  # what was told of damage and fallbacks


def fly(air: str, seed: int, duration: float) -> Flight:
    """Fly a healthy aircraft, and count what the learner and the controller say of damage."""
    chosen = learning(Cell("alarm", air, UNCERTAINTY), seed, duration)
    gains = [0.0, 0.0]
    tests = 0
    events = list[Event]()

    def watched(*arguments: Any) -> tuple[Change, ...]:
        nonlocal tests
        changes = change_test(*arguments)
        learned = arguments[3]
        gains.extend(change.gain for change in changes if change.outputs in learned)
        tests += len(learned)
        return changes

    with patch("flight_design.learning.learner.change_test", watched):
        tape = simulate(chosen, learn=learner(chosen), announce=events.append)
    gains.sort()
    words = ("no effect", "changed, log-likelihood")
    told = [
        event
        for event in events
        if event.kind is EventKind.FALLBACK or any(word in event.sentence for word in words)
    ]
    return Flight(
        air=air,
        seed=seed,
        duration=duration,
        completed=int(tape.outcome == COMPLETED),
        models=sum(event.kind is EventKind.FLIES for event in events) - 1,
        tests=tests,
        doubts=sum("may have no effect" in event.sentence for event in events),
        changed=sum("changed, log-likelihood" in event.sentence for event in events),
        dead=sum("has no effect" in event.sentence for event in events),
        fallbacks=sum(event.kind is EventKind.FALLBACK for event in events),
        largest_gain=round(gains[-1], 3),
        second_gain=round(gains[-2], 3),
        sentences=" | ".join(f"{event.stamp_ns / 1e9:g} s: {event.sentence}" for event in told),
    )


def read(path: Path) -> list[dict[str, str]]:
    """Return the rows of a file, or none if there is no such file."""
    if not path.exists():
        return []
    with path.open(newline="") as stream:
        return list(csv.DictReader(stream))


def main(
    write: Annotated[Path, typer.Option(help="File of the rows, one for each flight.")],
    flights: Annotated[int, typer.Option(min=1, help="Flights in each air.")] = 4,
    duration: Annotated[float, typer.Option(min=1.0, help="Length of a flight, s.")] = 300.0,
) -> None:
    """Fly what the file does not have yet, and write each flight when it has ended."""
    rows = read(write)
    known = {(row["air"], int(row["seed"])) for row in rows}
    for seed in range(1, flights + 1):
        for air in AIRS:
            if (air, seed) in known:
                continue
            rows.append(
                {key: str(value) for key, value in fly(air, seed, duration)._asdict().items()}
            )
            with write.open("w", newline="") as stream:
                writer = csv.DictWriter(stream, Flight._fields, lineterminator="\n")
                writer.writeheader()
                writer.writerows(rows)
            print(rows[-1], flush=True)


if __name__ == "__main__":
    typer.run(main)
